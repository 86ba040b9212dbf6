use std::collections::BTreeMap;
use std::fmt::{self, Write};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

use anyhow::Context;
use clap::{Args, ValueEnum};
use serde::Serialize;

use super::terminal::{INTERRUPTED, catch_interrupts, print, progress};
use mfg_vio::evaluation::{NeesSummary, Table};
use mfg_vio::filter::gnss::{
    Agreement, GnssConfig, GnssFilterKind, NavigationStep, NavigationSummary, OutageConfig,
    navigate,
};
use mfg_vio::replay::{NavigationInput, NavigationLogs, NavigationOutputs, NavigationSource};

/// Share of a chi-square distribution within the bounds that are printed.
const CONFIDENCE: f64 = 0.95;

/// Estimate attitude, velocity, position and biases from IMU and GNSS.
///
/// A log is a ROS 1 bag, a ROS 2 bag, an MCAP file or a folder with an IMU and `NavSatFix` or NMEA
/// messages. Tables are text; the first line names the columns (comma or blank separated): `t gx gy
/// gz ax ay az` (s, rad/s, m/s^2) and `t x y z` (m, z up), `t north east down`, `t latitude longitude
/// height` or `t ecef_x ecef_y ecef_z`; --gps also takes a file of NMEA sentences. Positions are in
/// east, north, up; the place of their origin is printed where the fixes tell it.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  mfg-vio gnss drive.mcap --topic imu=/imu/data --topic gnss=/fix \
    --out runs/drive\n  mfg-vio gnss --imu KittiEquivBiasedImu.txt --gps KittiGps_converted.txt \
    --outage 60,30,100 --out runs/kitti"
)]
pub struct GnssArgs {
    /// A log with both streams, in place of --imu and --gps.
    #[arg(value_name = "LOG", required_unless_present = "imu", conflicts_with_all = ["imu", "gps"])]
    log: Option<PathBuf>,
    /// IMU samples.
    #[arg(long, value_name = "IMU.csv", requires = "gps")]
    imu: Option<PathBuf>,
    /// Position fixes.
    #[arg(long, value_name = "GPS.csv", requires = "imu")]
    gps: Option<PathBuf>,
    /// Topic of the IMU (`imu=TOPIC` or `TOPIC`) or of the fixes (`gnss=TOPIC`) in a log [default:
    /// chosen by message type].
    #[arg(long = "topic", value_name = "[imu=|gnss=]TOPIC", requires = "log")]
    topics: Vec<Topic>,
    /// The estimator.
    #[arg(long, value_enum, default_value_t = FilterName::Mfgi)]
    filter: FilterName,
    /// Noise, receiver and start; if not given, the one shipped for the layout, which is said.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Override a key of the configuration.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Withhold fixes for LENGTH s from START s after the first fix, again every PERIOD s.
    #[arg(long, value_name = "START,LENGTH[,PERIOD]")]
    outage: Option<Outage>,
    /// Write `trajectory.tum` and `state.csv` here.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum FilterName {
    Mfgi,
    Mfgb,
    Mekf,
}

impl From<FilterName> for GnssFilterKind {
    fn from(name: FilterName) -> Self {
        match name {
            FilterName::Mfgi => Self::Mfgi,
            FilterName::Mfgb => Self::Mfgb,
            FilterName::Mekf => Self::Mekf,
        }
    }
}

#[derive(Debug, Clone)]
struct Outage(OutageConfig);

impl std::str::FromStr for Outage {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let numbers: Result<Vec<f64>, _> = text.split(',').map(|x| x.trim().parse()).collect();
        let numbers = numbers.ok().filter(|n| n.iter().all(|x: &f64| x.is_finite() && *x >= 0.0));
        match numbers.as_deref() {
            Some(&[start, length]) => Ok(Self(OutageConfig { start, length, period: 0.0 })),
            Some(&[start, length, period]) => Ok(Self(OutageConfig { start, length, period })),
            _ => Err("expected two or three numbers that are not negative: 60,30 or 60,30,100"),
        }
    }
}

#[derive(Debug, Clone)]
enum Topic {
    Imu(String),
    Gnss(String),
}

impl std::str::FromStr for Topic {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text.split_once('=') {
            Some(("imu", topic)) if !topic.is_empty() => Ok(Self::Imu(topic.to_owned())),
            Some(("gnss", topic)) if !topic.is_empty() => Ok(Self::Gnss(topic.to_owned())),
            None if !text.is_empty() => Ok(Self::Imu(text.to_owned())),
            _ => Err("expected TOPIC, imu=TOPIC or gnss=TOPIC"),
        }
    }
}

/// What `--json` prints.
#[derive(Debug, Serialize)]
struct Report {
    filter: &'static str,
    config: String,
    /// Topic or file of the samples and of the fixes.
    sources: [String; 2],
    /// Latitude, longitude (deg) and height (m) of the local frame's origin, if the fixes tell it.
    datum: Option<[f64; 3]>,
    /// Values of keys that nothing but the shipped configuration tells.
    assumed: BTreeMap<&'static str, f64>,
    remarks: Vec<String>,
    /// Stamp of the first fix used, s.
    start: f64,
    imu_samples: usize,
    gaps: usize,
    /// Gaps that were filled in by interpolation.
    interpolated: usize,
    fixes_used: usize,
    fixes_rejected: usize,
    /// Fixes that enlarged the belief.
    surprises: usize,
    /// s after the first fix; null where the heading never was that well known, or where the
    /// innovations contradict it.
    heading_converged_s: Option<f64>,
    heading: HeadingClaim,
    nis: Option<Consistency>,
    nis_after_convergence: Option<Consistency>,
    outages: Vec<OutageLine>,
    /// The same outages under the Gaussian rival; why it has none, if it failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    mekf: Option<Rival>,
}

/// Whether what the belief says of the heading is to be trusted.
#[derive(Debug, Serialize)]
struct HeadingClaim {
    /// Whether the belief agreed with its innovations at most fixes since it was narrow.
    consistent: bool,
    fixes: usize,
    /// Of these, fixes at which the last innovations contradicted the belief.
    withheld: usize,
    mean_nis: Option<f64>,
    /// The settings to look at, if it is not consistent.
    #[serde(skip_serializing_if = "Option::is_none")]
    advice: Option<String>,
}

impl HeadingClaim {
    fn of(agreement: &Agreement) -> Self {
        let consistent = agreement.holds();
        Self {
            consistent,
            fixes: agreement.fixes,
            withheld: agreement.larger + agreement.smaller,
            mean_nis: (agreement.fixes > 0).then(|| agreement.mean_nis()),
            advice: (!consistent).then(|| advice(agreement)),
        }
    }
}

/// Where the noise of the fixes makes up most of the innovations, it is the first to doubt.
fn advice(agreement: &Agreement) -> String {
    let factor = (agreement.mean_nis() / 3.0).sqrt();
    let too = if factor > 1.0 { "small" } else { "large" };
    if agreement.noise_share() > 0.5 {
        format!(
            "the noise of the fixes is set too {too}: receiver.noise_scale={factor:.2}, or \
             receiver.horizontal_noise and receiver.vertical_noise"
        )
    } else {
        format!(
            "the noise of the IMU is set too {too}, by about {factor:.1}: imu.gyro_noise, \
             imu.accel_noise, imu.gyro_bias_sd, imu.accel_bias_sd, or a scale"
        )
    }
}

#[derive(Debug, Serialize)]
#[serde(untagged)]
enum Rival {
    Finished { outages: Vec<OutageLine>, heading_converged_s: Option<f64> },
    Failed { error: String },
}

/// Normalized innovations squared against the chi-square distribution with 3 degrees of freedom.
#[derive(Debug, Serialize)]
struct Consistency {
    fixes: usize,
    mean: f64,
    /// Bounds of the mean if the filter is consistent.
    mean_bounds: [f64; 2],
    median: f64,
    /// Bounds of a single value.
    bounds: [f64; 2],
    inside: f64,
    above: f64,
}

#[derive(Debug, Clone, Serialize)]
struct OutageLine {
    start_s: f64,
    fixes: usize,
    rms_m: f64,
    max_m: f64,
    /// Mean normalized square, 3 if the belief is right.
    nis: f64,
    last_m: f64,
}

impl Consistency {
    fn of(values: &[f64]) -> Option<Self> {
        let single = NeesSummary::of(values, 3, CONFIDENCE)?;
        // The sum of n values has 3 n degrees of freedom.
        let n = values.len();
        let sum = NeesSummary::of(&[values.iter().sum()], 3 * n, CONFIDENCE)?;
        Some(Self {
            fixes: n,
            mean: single.mean,
            mean_bounds: sum.band.map(|bound| bound / n as f64),
            median: single.median,
            bounds: single.band,
            inside: single.inside,
            above: single.above,
        })
    }
}

pub fn run(args: &GnssArgs) -> anyhow::Result<()> {
    let (logs, mut config, origin) = read(args)?;
    if let Some(Outage(outage)) = &args.outage {
        config.outage = outage.clone();
    }
    let input = logs.prepare(&config)?;
    catch_interrupts()?;
    let kind = GnssFilterKind::from(args.filter);
    let summary = written(kind, &config, &input, args.out.as_deref())
        .with_context(|| format!("{} with {}", kind.name(), input.names.join(" and ")))?;
    let compared = kind != GnssFilterKind::Mekf && !summary.outages.is_empty();
    let rival = compared.then(|| {
        match observed(GnssFilterKind::Mekf, &config, &input, |_| ControlFlow::Continue(())) {
            Ok(rival) => Rival::Finished {
                outages: outage_lines(&rival),
                heading_converged_s: rival.heading_converged,
            },
            Err(error) => Rival::Failed { error: error.to_string() },
        }
    });
    let mut report = report(kind, &summary, rival, &input);
    report.assumed = assumed(args, &config, &input);
    report.config = origin;
    if args.json {
        print(&serde_json::to_string(&report)?)
    } else {
        print(&text(&report, &config)?)
    }
}

/// The log with its configuration and where that comes from.
fn read(args: &GnssArgs) -> anyhow::Result<(NavigationLogs, GnssConfig, String)> {
    let mut overrides = args.overrides.clone();
    overrides.extend(args.topics.iter().map(|topic| match topic {
        Topic::Imu(topic) => format!("log.imu_topic={topic}"),
        Topic::Gnss(topic) => format!("log.gnss_topic={topic}"),
    }));
    let load = |name: &str| match &args.config {
        Some(path) => GnssConfig::load(path, &overrides),
        None => GnssConfig::shipped(name, &overrides),
    };
    let source = match (&args.log, &args.imu, &args.gps) {
        (Some(log), ..) => NavigationSource::Log(log.clone()),
        (None, Some(imu), Some(gnss)) => {
            NavigationSource::Tables { imu: imu.clone(), gnss: gnss.clone() }
        }
        _ => anyhow::bail!("a log, or --imu and --gps"),
    };
    // How it is to be read is the same in all that are shipped.
    let logs = NavigationLogs::read(source, &load("gnss")?)?;
    let (name, reason) = logs.config_name();
    let origin = match &args.config {
        Some(path) => path.display().to_string(),
        None => format!("configs/{name}.toml, {reason}"),
    };
    Ok((logs, load(name)?, origin))
}

/// Settings of the sensors that neither the user nor the log tells.
fn assumed(
    args: &GnssArgs,
    config: &GnssConfig,
    input: &NavigationInput,
) -> BTreeMap<&'static str, f64> {
    if args.config.is_some() {
        return BTreeMap::new();
    }
    let mut assumed = BTreeMap::from([
        ("imu.gyro_noise", config.imu.gyro_noise),
        ("imu.accel_noise", config.imu.accel_noise),
        ("imu.gyro_bias_sd", config.imu.gyro_bias_sd),
        ("imu.accel_bias_sd", config.imu.accel_bias_sd),
    ]);
    if !input.noise_told {
        assumed.insert("receiver.horizontal_noise", config.receiver.horizontal_noise);
        assumed.insert("receiver.vertical_noise", config.receiver.vertical_noise);
    }
    let told = |key: &str| {
        let keys = args.overrides.iter().filter_map(|text| text.split_once('='));
        keys.into_iter().any(|(told, _)| told.trim() == key)
    };
    assumed.retain(|key, _| !told(key));
    assumed
}

/// A run whose steps go to files.
fn written(
    kind: GnssFilterKind,
    config: &GnssConfig,
    input: &NavigationInput,
    out: Option<&Path>,
) -> anyhow::Result<NavigationSummary> {
    let mut outputs = out.map(NavigationOutputs::create).transpose()?;
    let mut failure = None;
    let summary = observed(kind, config, input, |step| {
        if let Some(outputs) = &mut outputs
            && let Err(error) = outputs.step(step)
        {
            failure = Some(error);
            return ControlFlow::Break(());
        }
        ControlFlow::Continue(())
    });
    if let Some(outputs) = outputs {
        outputs.finish()?;
    }
    match failure {
        Some(error) => Err(error.into()),
        None => summary,
    }
}

/// A run with a progress bar that ends when interrupted.
fn observed(
    kind: GnssFilterKind,
    config: &GnssConfig,
    input: &NavigationInput,
    mut observe: impl FnMut(&NavigationStep) -> ControlFlow<()>,
) -> anyhow::Result<NavigationSummary> {
    let NavigationInput { imu, fixes, .. } = input;
    let bar = progress(Some(fixes.len() as u64), kind.name());
    let summary = navigate(kind, config, imu, fixes, |step| {
        if step.fix.is_some() {
            bar.inc(1);
        }
        if INTERRUPTED.load(Ordering::Relaxed) {
            return ControlFlow::Break(());
        }
        observe(step)
    })?;
    bar.finish_and_clear();
    Ok(summary)
}

fn outage_lines(summary: &NavigationSummary) -> Vec<OutageLine> {
    let line = |o: &mfg_vio::filter::gnss::OutageReport| OutageLine {
        start_s: o.start,
        fixes: o.fixes,
        rms_m: o.rms,
        max_m: o.max,
        nis: o.nis,
        last_m: o.last,
    };
    summary.outages.iter().map(line).collect()
}

fn report(
    kind: GnssFilterKind,
    summary: &NavigationSummary,
    mekf: Option<Rival>,
    input: &NavigationInput,
) -> Report {
    let since = |start: f64| -> Vec<f64> {
        summary.nis.iter().filter(|(t, _)| *t > start).map(|(_, nis)| *nis).collect()
    };
    let heading = HeadingClaim::of(&summary.agreement);
    let converged = summary.heading_converged.filter(|_| heading.consistent);
    Report {
        filter: kind.name(),
        config: String::new(),
        sources: input.names.clone(),
        datum: input.datum.map(|datum| {
            let place = datum.place();
            [place.latitude, place.longitude, place.height]
        }),
        assumed: BTreeMap::new(),
        remarks: input.remarks.clone(),
        start: summary.start.seconds(),
        imu_samples: summary.imu_samples,
        gaps: summary.gaps,
        interpolated: summary.interpolated,
        fixes_used: summary.used,
        fixes_rejected: summary.rejected,
        surprises: summary.surprises,
        heading_converged_s: converged,
        heading,
        nis: Consistency::of(&since(0.0)),
        nis_after_convergence: converged.and_then(|start| Consistency::of(&since(start))),
        outages: outage_lines(summary),
        mekf,
    }
}

fn text(report: &Report, config: &GnssConfig) -> Result<String, fmt::Error> {
    let mut out = String::new();
    writeln!(out, "filter                {} ({})", report.filter, report.config)?;
    writeln!(out, "IMU, fixes            {}", report.sources.join(", "))?;
    if let Some([latitude, longitude, height]) = report.datum {
        writeln!(
            out,
            "origin                {latitude:.8} deg, {longitude:.8} deg, {height:.3} m"
        )?;
    }
    for (key, value) in &report.assumed {
        writeln!(out, "assumed               {key} = {value} (--set {key}=VALUE, or --config)")?;
    }
    for remark in &report.remarks {
        writeln!(out, "note                  {remark}")?;
    }
    writeln!(out, "first fix             {:.3} s", report.start)?;
    writeln!(
        out,
        "IMU samples, gaps     {}, {} and {} filled in",
        report.imu_samples, report.gaps, report.interpolated
    )?;
    writeln!(
        out,
        "fixes                 {} used, {} rejected, {} a surprise",
        report.fixes_used, report.fixes_rejected, report.surprises
    )?;
    write_heading(&mut out, report, config.start.converged_heading_sd)?;
    for (what, nis) in [("NIS", &report.nis), ("NIS, heading known", &report.nis_after_convergence)]
    {
        let Some(nis) = nis else { continue };
        writeln!(
            out,
            "{what:<22}mean {:.2} (95 % bounds {:.2} to {:.2}), median {:.2}, {:.1} % of {} in [{:.2}, {:.2}], {:.1} % above",
            nis.mean,
            nis.mean_bounds[0],
            nis.mean_bounds[1],
            nis.median,
            100.0 * nis.inside,
            nis.fixes,
            nis.bounds[0],
            nis.bounds[1],
            100.0 * nis.above,
        )?;
    }
    if !report.outages.is_empty() {
        if let Some(Rival::Failed { error }) = &report.mekf {
            writeln!(out, "mekf failed: {error}")?;
        }
        out.push_str(&outage_table(report).to_text());
    }
    Ok(out)
}

fn write_heading(out: &mut String, report: &Report, limit: f64) -> fmt::Result {
    let claim = &report.heading;
    match (report.heading_converged_s, &claim.advice, claim.mean_nis) {
        (Some(t), ..) => {
            writeln!(out, "heading               within {limit} deg (1 sigma) after {t:.2} s")?;
            if claim.withheld > 0 {
                writeln!(
                    out,
                    "                      withheld at {} of {} fixes since: the innovations \
                     disagree",
                    claim.withheld, claim.fixes
                )?;
            }
            Ok(())
        }
        (None, Some(advice), Some(nis)) => writeln!(
            out,
            "heading               not told: NIS is {nis:.1} in the mean where 3 is expected; \
             {advice}"
        ),
        _ => writeln!(out, "heading               never within {limit} deg (1 sigma)"),
    }
}

fn outage_table(report: &Report) -> Table {
    let mut table = Table::new([
        "outage from, s",
        "filter",
        "fixes",
        "position RMS, m",
        "max, m",
        "last, m",
        "NIS",
    ]);
    let mut add = |filter: &str, lines: &[OutageLine]| {
        for line in lines {
            table.push([
                format!("{:.1}", line.start_s),
                filter.to_owned(),
                line.fixes.to_string(),
                format!("{:.2}", line.rms_m),
                format!("{:.2}", line.max_m),
                format!("{:.2}", line.last_m),
                format!("{:.1}", line.nis),
            ]);
        }
    };
    add(report.filter, &report.outages);
    if let Some(Rival::Finished { outages, .. }) = &report.mekf {
        add("mekf", outages);
    }
    table
}
