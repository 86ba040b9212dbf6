//! Messages, progress and interruption.

use std::io::IsTerminal;
use std::sync::atomic::{AtomicBool, Ordering};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use tracing_subscriber::EnvFilter;

/// Sends log messages to stderr, warnings and chosen sources by default.
pub fn start_messages(verbosity: u8) {
    let level = match verbosity {
        0 => "warn,mfg_vio=info",
        1 => "info,mfg_vio=debug",
        _ => "debug,mfg_vio=trace",
    };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal())
        .with_target(false)
        .without_time()
        .init();
}

/// Raised by Ctrl-C; long work looks at it and ends with valid files.
pub static INTERRUPTED: AtomicBool = AtomicBool::new(false);

/// From now on Ctrl-C raises [`INTERRUPTED`]; a second one ends the process.
pub fn catch_interrupts() -> anyhow::Result<()> {
    ctrlc::set_handler(|| {
        if INTERRUPTED.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
    })?;
    Ok(())
}

/// A bar over `length` steps (a counter if unknown); hidden unless stderr is a terminal.
pub fn progress(length: Option<u64>, what: &str) -> ProgressBar {
    let bar = match length {
        Some(length) => ProgressBar::new(length)
            .with_style(style("{msg} {wide_bar} {pos}/{len} ({per_sec}, {eta} left)")),
        None => ProgressBar::new_spinner().with_style(style("{spinner} {msg} {pos} ({per_sec})")),
    };
    if !std::io::stderr().is_terminal() {
        bar.set_draw_target(ProgressDrawTarget::hidden());
    }
    bar.with_message(what.to_owned())
}

fn style(template: &str) -> ProgressStyle {
    ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar())
}
