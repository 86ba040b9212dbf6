//! Messages, progress and interruption.

use std::io::{IsTerminal, Write};
use std::sync::atomic::{AtomicBool, AtomicI32, Ordering};

use anyhow::Context;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use nix::sys::signal::{SigSet, Signal};
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
        // It would be told on stderr, too, which is what failed.
        .log_internal_errors(false)
        .init();
}

/// A line on stderr; one that cannot be written is lost.
pub fn tell(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Standard output refused what was to be printed.
#[derive(Debug, thiserror::Error)]
#[error("standard output: {0}")]
pub struct OutputRefused(std::io::Error);

/// Prints `text`, whose last line is ended, on standard output.
///
/// # Errors
/// [`OutputRefused`] where standard output is closed or full.
pub fn print(text: &str) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    let end = if text.ends_with('\n') { "" } else { "\n" };
    let written = write!(out, "{text}{end}").and_then(|()| out.flush());
    Ok(written.map_err(OutputRefused)?)
}

/// A signal asked for the end; long work looks at it and ends with valid files.
pub static INTERRUPTED: AtomicBool = AtomicBool::new(false);
/// Number of that signal; 0: none came.
static SIGNAL: AtomicI32 = AtomicI32::new(0);

/// From now on SIGINT, SIGTERM and SIGHUP raise [`INTERRUPTED`]; a second one ends the process.
/// To be called before there are other threads.
pub fn catch_interrupts() -> anyhow::Result<()> {
    let signals: SigSet = [Signal::SIGINT, Signal::SIGTERM, Signal::SIGHUP].into_iter().collect();
    // Threads inherit it, so that the signals wait for the one below.
    signals.thread_block().context("signals cannot be caught")?;
    std::thread::spawn(move || {
        while let Ok(signal) = signals.wait() {
            SIGNAL.store(signal as i32, Ordering::Relaxed);
            if INTERRUPTED.swap(true, Ordering::Relaxed) {
                std::process::exit(128 + signal as i32);
            }
        }
    });
    Ok(())
}

/// 128 + n after signal n.
pub fn interruption_status() -> Option<u8> {
    let signal = SIGNAL.load(Ordering::Relaxed);
    u8::try_from(128 + signal).ok().filter(|_| signal > 0)
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
