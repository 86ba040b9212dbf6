use std::fmt::Write;
use std::path::PathBuf;

use anyhow::Context;
use serde_json::json;

use super::terminal::print;
use mfg_vio::config::Resolved;
use mfg_vio::config::import::{ImportOptions, ImportedValue, import};
use mfg_vio::output::{self, Files};

/// Show and make configurations.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    Show(ShowArgs),
    Import(ImportArgs),
}

/// Print every setting with which a log would be replayed, and where it is from.
///
/// Origins, each counting more than those before: default; shipped file (chosen by the log's layout);
/// sensor class (noise of the device, by a table); log (CameraInfo, transforms, frames); file
/// (--config); command line (--set).
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Example:\n  mfg-vio config show lab_bumper1.bag --set imu.gyro_noise=1e-3\n  \
                        mfg-vio config show lab_bumper1.bag --json | jq '.settings[] | select(.origin == \"log\")'"
)]
struct ShowArgs {
    /// The log: a file or a folder.
    log: PathBuf,
    /// Configuration of the sensor set-up; by default chosen by the log's layout.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Override a key of the configuration; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// Make a configuration from the calibration of another program.
///
/// Reads Kalibr camchain and imu files, OpenVINS, VINS-Mono, VINS-Fusion, OpenCV and ORB-SLAM yaml;
/// several files complete each other, and files that one refers to are read with it. In the result
/// camera.imu_from_camera maps camera to IMU coordinates and camera.time_offset is added to camera
/// stamps (t_imu = t_camera + time_offset); what the files mean by theirs is said.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    mfg-vio config import camchain-imucam.yaml imu.yaml --out rig.toml\n  \
    mfg-vio config import euroc_mono_imu_config.yaml --imu-rate 200 --out rig.toml")]
struct ImportArgs {
    /// Calibration files.
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// The configuration to write (TOML).
    #[arg(long, value_name = "FILE.toml")]
    out: PathBuf,
    /// Samples of the IMU a second: turns VINS's noise of a sample into a density.
    #[arg(long, value_name = "HZ", value_parser = rate)]
    imu_rate: Option<f64>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

fn rate(text: &str) -> Result<f64, String> {
    let rate: f64 = text.parse().map_err(|_| "not a number".to_owned())?;
    if rate > 0.0 && rate.is_finite() { Ok(rate) } else { Err("must be positive".to_owned()) }
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    match &args.command {
        Command::Show(args) => show(args),
        Command::Import(args) => run_import(args),
    }
}

fn show(args: &ShowArgs) -> anyhow::Result<()> {
    let resolved = Resolved::of(&args.log, args.config.as_deref(), &args.overrides)?;
    let settings = resolved.settings();
    let problems = &resolved.summary.calibration.problems;
    if args.json {
        let object = json!({
            "log": args.log.display().to_string(),
            "config": resolved.file_name(),
            "device": resolved.summary.calibration.device,
            "settings": settings,
            "conflicts": resolved.conflicts,
            "missing": resolved.missing(),
            "problems": problems,
        });
        return print(&serde_json::to_string_pretty(&object)?);
    }
    let mut out = String::new();
    for setting in settings {
        let value = setting.value.to_string();
        writeln!(out, "{:<32} {value:<40} {}", setting.key, setting.origin)?;
    }
    for conflict in &resolved.conflicts {
        writeln!(out, "WARNING  {conflict}")?;
    }
    for problem in problems {
        writeln!(out, "WARNING  {problem}")?;
    }
    for key in resolved.missing() {
        writeln!(out, "MISSING  {key}")?;
    }
    print(out.trim_end())
}

fn run_import(args: &ImportArgs) -> anyhow::Result<()> {
    let import = import(&args.files, &ImportOptions { imu_rate: args.imu_rate })?;
    // Files may lead to others, which the command line does not name.
    let mut files = Files::new();
    for file in import.files() {
        files.reads("FILE", file);
    }
    files.writes("--out", &args.out).check()?;
    output::write(&args.out, import.to_toml())
        .with_context(|| format!("{}", args.out.display()))?;
    if args.json {
        let values = import.values();
        let values: Vec<_> =
            values.iter().map(|(key, imported)| value_json(key, imported)).collect();
        let object = json!({
            "out": args.out.display().to_string(),
            "values": values,
            "notes": import.notes(),
        });
        return print(&format!("{object:#}"));
    }
    let values = import.values().into_iter().map(|(key, imported)| {
        let file = imported.path.display();
        format!("{key} = {}    {file}: {}", imported.value, imported.source)
    });
    let conventions = [
        "camera.imu_from_camera maps camera to IMU coordinates.".to_owned(),
        "camera.time_offset is added to camera stamps: t_imu = t_camera + time_offset.".to_owned(),
    ];
    let notes = import.notes().iter().map(|note| format!("{note}."));
    let out = args.out.display();
    let end = format!("written to {out}; keys that no file has keep their defaults");
    let lines: Vec<_> = values.chain(conventions).chain(notes).chain([end]).collect();
    print(&lines.join("\n"))
}

fn value_json(key: &str, imported: &ImportedValue) -> serde_json::Value {
    let file = imported.path.display().to_string();
    json!({ "key": key, "value": imported.value, "file": file, "source": imported.source })
}
