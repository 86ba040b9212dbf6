use std::fmt::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;

use super::terminal::print;
use mfg_vio::config::Resolved;
use mfg_vio::dataset::{self, Assumed, Inspection, Severity, TopicInspection};
use mfg_vio::output;
#[cfg(feature = "vision")]
use mfg_vio::replay::{Tried, try_out as try_out_log};

/// Tell what is in a log and whether it is fit for visual-inertial odometry.
///
/// Checks rates, gaps, order and clocks of all topics, units, sign and axes of the IMU (by gravity
/// and by turns that images and gyroscope both see), channel order of color, unit and validity of
/// depth against the configuration with which the log would be replayed, starts the estimator, and
/// ends in a verdict with the settings to change.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  mfg-vio info lab_bumper1.bag --write-config own.toml\n  \
                        mfg-vio replay lab_bumper1.bag --config own.toml\n  \
                        mfg-vio info lab_bumper1.bag --json | jq .verdict")]
pub struct Args {
    /// The log: a file or a folder.
    log: PathBuf,
    #[command(flatten)]
    setup: Setup,
    /// Write the configuration for this log, with everything that was found, to a file for
    /// --config.
    #[arg(long, value_name = "FILE")]
    write_config: Option<PathBuf>,
    /// Print everything as one JSON object.
    #[arg(long)]
    json: bool,
}

/// The configuration against which a log is read.
#[derive(Debug, clap::Args)]
pub struct Setup {
    /// Configuration of the sensor set-up; by default chosen by the log's layout.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Override a key of the configuration; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
}

impl Setup {
    pub fn resolve(&self, log: &Path) -> anyhow::Result<Resolved> {
        Ok(Resolved::of(log, self.config.as_deref(), &self.overrides)?)
    }
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let resolved = args.setup.resolve(&args.log)?;
    let config = &resolved.config;
    let assumed = Assumed {
        log: &config.log,
        imu: &config.imu,
        body_from_camera: resolved
            .has_mounting()
            .then(|| config.camera.imu_from_camera())
            .flatten(),
        time_offset: config.camera.time_offset,
        missing: resolved.missing(),
    };
    let inspection = dataset::inspect(&args.log, &assumed)?;
    let inspection = try_out(args, inspection, &resolved, &assumed)?;
    if let Some(file) = &args.write_config {
        write_config(file, &resolved, &inspection)?;
    }
    if args.json {
        return print(&serde_json::to_string_pretty(&inspection)?);
    }
    let mut text = String::new();
    describe(&mut text, &inspection, &resolved.file_name())?;
    if let Some(file) = &args.write_config {
        writeln!(text, "configuration: {}", file.display())?;
    }
    print(&text)
}

/// Starts the estimator on the log; its own messages would only confuse.
#[cfg(feature = "vision")]
fn try_out(
    args: &Args,
    inspection: Inspection,
    resolved: &Resolved,
    assumed: &Assumed,
) -> anyhow::Result<Inspection> {
    let Setup { config, overrides } = &args.setup;
    let tried = Tried { log: &args.log, file: config.as_deref(), overrides };
    let quiet = tracing::subscriber::NoSubscriber::default();
    let done = tracing::subscriber::with_default(quiet, || {
        try_out_log(inspection, tried, resolved, assumed)
    });
    Ok(done?)
}

#[cfg(not(feature = "vision"))]
fn try_out(
    _: &Args,
    inspection: Inspection,
    _: &Resolved,
    _: &Assumed,
) -> anyhow::Result<Inspection> {
    Ok(inspection)
}

/// Writes the configuration of the log with everything that was found.
fn write_config(file: &Path, resolved: &Resolved, inspection: &Inspection) -> anyhow::Result<()> {
    let findings = inspection.findings.iter();
    let found = findings.filter_map(|finding| {
        let (key, value) = finding.setting.as_deref()?.split_once('=')?;
        Some((key.to_owned(), value.to_owned(), finding.message.clone()))
    });
    let text = resolved.to_toml(&found.collect::<Vec<_>>())?;
    output::write(file, text).with_context(|| format!("{}", file.display()))?;
    Ok(())
}

fn describe(out: &mut String, inspection: &Inspection, config: &str) -> fmt::Result {
    writeln!(out, "{}, {:.2} s; read with {config}", inspection.summary.kind, inspection.duration)?;
    for (role, source) in &inspection.summary.sources {
        let others = inspection.summary.others.get(role).map(|others| others.join(", "));
        let others = others.map(|others| format!("  (not {others}: log.{role}_topic)"));
        writeln!(out, "  {role:<6} {source}{}", others.unwrap_or_default())?;
    }
    writeln!(
        out,
        "\n{:<28} {:<30} {:>8} {:>9} {:>6} {:>8} {:>8} {:>10}",
        "topic", "type", "messages", "Hz", "gaps", "disorder", "repeated", "encoding"
    )?;
    for (name, topic) in &inspection.topics {
        row(out, name, topic)?;
    }
    writeln!(out)?;
    for finding in &inspection.findings {
        let mark = match finding.severity {
            Severity::Ok => "ok",
            Severity::Note => "note",
            Severity::Warning => "WARNING",
            Severity::Error => "ERROR",
        };
        writeln!(out, "{mark:<8} {:<7} {}", finding.subject, finding.message)?;
    }
    writeln!(out, "\nverdict: {}", inspection.verdict.text)
}

fn row(out: &mut String, name: &str, topic: &TopicInspection) -> fmt::Result {
    let timing = topic.timing.as_ref();
    let rate = timing.and_then(|t| t.rate).map_or("-".to_owned(), |rate| format!("{rate:.2}"));
    let count = |of: fn(&dataset::Timing) -> usize| {
        timing.map_or("-".to_owned(), |timing| of(timing).to_string())
    };
    let encoding = match (&topic.encoding, topic.size) {
        (Some(encoding), Some((width, height))) => format!("{encoding} {width}x{height}"),
        (Some(encoding), None) => encoding.clone(),
        (None, Some((width, height))) => format!("{width}x{height}"),
        (None, None) => String::new(),
    };
    writeln!(
        out,
        "{name:<28} {:<30} {:>8} {rate:>9} {:>6} {:>8} {:>8}   {encoding}",
        topic.schema,
        topic.messages,
        count(|t| t.gaps),
        count(|t| t.out_of_order),
        count(|t| t.duplicates),
    )
}
