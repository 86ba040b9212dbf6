use std::fmt::{self, Write};
use std::path::PathBuf;

use super::terminal::print;
use mfg_vio::config::Config;
use mfg_vio::dataset::{self, Assumed, Inspection, LogSummary, Severity, TopicInspection};
use mfg_vio::sensor::CameraConfig;

/// Tell what is in a log and whether it is fit for visual-inertial odometry.
///
/// Checks rates, gaps, order and clocks of all topics, units and sign of the IMU, channel order of
/// color, unit and validity of depth against the configuration with which the log would be
/// replayed, and ends in a verdict with the settings to change.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  mfg-vio info lab_bumper1.bag\n  \
                        mfg-vio info lab_bumper1.bag --json | jq .verdict")]
pub struct Args {
    /// The log: a file or a folder.
    log: PathBuf,
    #[command(flatten)]
    setup: Setup,
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
    pub fn config(&self, summary: &LogSummary) -> anyhow::Result<Config> {
        Ok(Config::for_log(summary, self.config.as_deref(), &self.overrides)?)
    }
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let summary = dataset::detect(&args.log)?;
    let config = args.setup.config(&summary)?;
    // A layout that is merely not known says nothing about the mounting of the camera.
    let is_known =
        args.setup.config.is_some() || summary.is_stereo() || summary.config_name == "vcu_rvi";
    let camera = summary.camera.as_ref().or(is_known.then_some(&config.camera));
    let body_from_camera = camera.and_then(CameraConfig::imu_from_camera);
    let assumed = Assumed { log: &config.log, imu: &config.imu, body_from_camera };
    let inspection = dataset::inspect(&args.log, &assumed)?;
    if args.json {
        return print(&serde_json::to_string_pretty(&inspection)?);
    }
    let name = match &args.setup.config {
        Some(path) => path.display().to_string(),
        None => format!("configs/{}.toml", summary.config_name),
    };
    let mut text = String::new();
    describe(&mut text, &inspection, &name)?;
    print(&text)
}

fn describe(out: &mut String, inspection: &Inspection, config: &str) -> fmt::Result {
    writeln!(out, "{}, {:.2} s; read with {config}", inspection.summary.kind, inspection.duration)?;
    for (role, source) in &inspection.summary.sources {
        writeln!(out, "  {role:<6} {source}")?;
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
