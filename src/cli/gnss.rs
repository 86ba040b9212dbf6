use std::fmt::{self, Write};
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::atomic::Ordering;

use anyhow::Context;
use clap::{Args, ValueEnum};
use serde::Serialize;

use super::terminal::{INTERRUPTED, catch_interrupts, print, progress};
use mfg_vio::dataset::{read_imu_table, read_position_table};
use mfg_vio::evaluation::{NeesSummary, Table};
use mfg_vio::filter::gnss::{
    GnssConfig, GnssFilterKind, NavigationStep, NavigationSummary, OutageConfig, navigate,
};
use mfg_vio::replay::NavigationOutputs;
use mfg_vio::sensor::{ImuSample, PositionFix};

/// Share of a chi-square distribution within the bounds that are printed.
const CONFIDENCE: f64 = 0.95;

/// Estimate attitude, velocity, position and biases from IMU and GNSS.
///
/// Tables are text; the first line names the columns (comma or blank separated): `Time`, `omegaX
/// omegaY omegaZ` (rad/s), `accelX accelY accelZ` (specific force, m/s^2) and `Time`, `X Y Z` (m, z
/// up), or shorter names such as `t gx gy gz ax ay az`, `t x y z`.
#[derive(Debug, Args)]
#[command(after_help = "Example:\n  mfg-vio gnss --imu KittiEquivBiasedImu.txt \
    --gps KittiGps_converted.txt --filter mfgi --outage 60,30,100 --out runs/kitti")]
pub struct GnssArgs {
    /// IMU samples.
    #[arg(long, value_name = "IMU.csv")]
    imu: PathBuf,
    /// Position fixes.
    #[arg(long, value_name = "GPS.csv")]
    gps: PathBuf,
    /// The estimator.
    #[arg(long, value_enum, default_value_t = FilterName::Mfgi)]
    filter: FilterName,
    /// Noise, receiver and start; configs/kitti.toml if not given.
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

/// What `--json` prints.
#[derive(Debug, Serialize)]
struct Report {
    filter: &'static str,
    config: String,
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
    /// s after the first fix; null where the heading never was that well known.
    heading_converged_s: Option<f64>,
    nis: Option<Consistency>,
    nis_after_convergence: Option<Consistency>,
    outages: Vec<OutageLine>,
    /// The same outages under the Gaussian rival; why it has none, if it failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    mekf: Option<Rival>,
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
    let mut config = match &args.config {
        Some(path) => GnssConfig::load(path, &args.overrides)?,
        None => GnssConfig::shipped(&args.overrides)?,
    };
    if let Some(Outage(outage)) = &args.outage {
        config.outage = outage.clone();
    }
    let imu = read_imu_table(&args.imu)?;
    let fixes = read_position_table(&args.gps)?;
    catch_interrupts()?;
    let kind = GnssFilterKind::from(args.filter);
    let mut outputs = args.out.as_deref().map(NavigationOutputs::create).transpose()?;
    let mut failure = None;
    let summary = observed(kind, &config, &imu, &fixes, |step| {
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
    if let Some(error) = failure {
        return Err(error.into());
    }
    let summary = summary.with_context(|| {
        format!("{} with {} and {}", kind.name(), args.imu.display(), args.gps.display())
    })?;
    let compared = kind != GnssFilterKind::Mekf && !summary.outages.is_empty();
    let rival = compared.then(|| {
        let run =
            observed(GnssFilterKind::Mekf, &config, &imu, &fixes, |_| ControlFlow::Continue(()));
        match run {
            Ok(rival) => Rival::Finished {
                outages: outage_lines(&rival),
                heading_converged_s: rival.heading_converged,
            },
            Err(error) => Rival::Failed { error: error.to_string() },
        }
    });
    let report = report(args, kind, &summary, rival);
    if args.json {
        print(&serde_json::to_string(&report)?)
    } else {
        print(&text(&report, &config)?)
    }
}

/// A run with a progress bar that ends when interrupted.
fn observed(
    kind: GnssFilterKind,
    config: &GnssConfig,
    imu: &[ImuSample],
    fixes: &[PositionFix],
    mut observe: impl FnMut(&NavigationStep) -> ControlFlow<()>,
) -> anyhow::Result<NavigationSummary> {
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
    args: &GnssArgs,
    kind: GnssFilterKind,
    summary: &NavigationSummary,
    mekf: Option<Rival>,
) -> Report {
    let since = |start: f64| -> Vec<f64> {
        summary.nis.iter().filter(|(t, _)| *t > start).map(|(_, nis)| *nis).collect()
    };
    let config = args.config.as_ref();
    Report {
        filter: kind.name(),
        config: config.map_or("configs/kitti.toml".to_owned(), |path| path.display().to_string()),
        start: summary.start.seconds(),
        imu_samples: summary.imu_samples,
        gaps: summary.gaps,
        interpolated: summary.interpolated,
        fixes_used: summary.used,
        fixes_rejected: summary.rejected,
        surprises: summary.surprises,
        heading_converged_s: summary.heading_converged,
        nis: Consistency::of(&since(0.0)),
        nis_after_convergence: summary
            .heading_converged
            .and_then(|start| Consistency::of(&since(start))),
        outages: outage_lines(summary),
        mekf,
    }
}

fn text(report: &Report, config: &GnssConfig) -> Result<String, fmt::Error> {
    let mut out = String::new();
    writeln!(out, "filter                {} ({})", report.filter, report.config)?;
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
    let limit = config.start.converged_heading_sd;
    match report.heading_converged_s {
        Some(t) => {
            writeln!(out, "heading               within {limit} deg (1 sigma) after {t:.2} s")?;
        }
        None => writeln!(out, "heading               never within {limit} deg (1 sigma)")?,
    }
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
