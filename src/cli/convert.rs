use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::atomic::Ordering;

use super::info::Setup;
use super::terminal::{INTERRUPTED, catch_interrupts, print, progress};
use mfg_vio::dataset;

/// Write any readable log as MCAP with ROS 2 messages, which Rerun and Foxglove open.
///
/// Messages keep their content, header stamps and log times. Images whose encoding is only `8UC3`
/// are marked with their channel order (log.color_8uc3).
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  mfg-vio convert lab_bumper1.bag lab_bumper1.mcap\n  \
                        rerun lab_bumper1.mcap")]
pub struct Args {
    /// The log to read: a file or a folder.
    #[arg(value_name = "IN")]
    input: PathBuf,
    /// The log to write.
    #[arg(value_name = "OUT.mcap")]
    output: PathBuf,
    #[command(flatten)]
    setup: Setup,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    catch_interrupts()?;
    let config = args.setup.resolve(&args.input)?.config;
    let bar = progress(None, "messages");
    let (input, output) = (&args.input, &args.output);
    let written = dataset::convert(input, output, &config.log, &config.camera, || {
        bar.inc(1);
        match INTERRUPTED.load(Ordering::Relaxed) {
            true => ControlFlow::Break(()),
            false => ControlFlow::Continue(()),
        }
    })?;
    bar.finish_and_clear();
    let mut lines = String::new();
    for (topic, count) in &written.messages {
        lines.push_str(&format!("{topic:<40} {count:>9}\n"));
    }
    for (reason, count) in &written.skipped {
        lines.push_str(&format!("left out: {reason:<30} {count:>9}\n"));
    }
    print(&lines)?;
    anyhow::ensure!(
        !INTERRUPTED.load(Ordering::Relaxed),
        "interrupted; {} is complete up to there",
        output.display()
    );
    Ok(())
}
