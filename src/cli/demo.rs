use std::path::PathBuf;

use anyhow::Context;

use super::replay::{Plan, Settings, Target, print_summary};
use super::simulate::render;
use super::terminal::catch_interrupts;
use mfg_vio::config::Config;
use mfg_vio::dataset;
use mfg_vio::evaluation::write_html;
use mfg_vio::replay::{figures, report};
use mfg_vio::simulation::SceneConfig;

/// Simulate a short log, replay it, evaluate it and draw it: the main job with no data at hand.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  mfg-vio demo --out demo\n  rerun demo/run.rrd")]
pub struct Args {
    /// Directory for the log, the results, the recording and the report.
    #[arg(long, value_name = "DIR", default_value = "demo")]
    out: PathBuf,
    #[command(flatten)]
    settings: Settings,
}

const DEMO_SECONDS: f64 = 10.0;

pub fn run(args: &Args) -> anyhow::Result<()> {
    catch_interrupts()?;
    std::fs::create_dir_all(&args.out).with_context(|| format!("{}", args.out.display()))?;
    let log = args.out.join("demo.mcap");
    render(SceneConfig { duration: DEMO_SECONDS, ..SceneConfig::default() }, &log)?;

    let config_name = "sim".to_owned();
    let config = Config::shipped(&config_name, args.settings.overrides())?;
    let plan = Plan {
        log: &log,
        settings: &args.settings,
        config,
        config_origin: config_name,
        out: Some(args.out.clone()),
        truth: None,
        start: 0.0,
        duration: f64::INFINITY,
        summary: dataset::detect(&log)?,
        recording: Target::files(&args.out),
        faults: vec![],
    };
    let replayed = plan.execute()?;
    write_html(&args.out.join("report.html"), &report(&replayed))?;
    for (name, figure) in figures(&replayed) {
        figure.save(&args.out.join(name).with_extension("png"))?;
    }
    print_summary(&replayed.metrics, Some(&args.out))
}
