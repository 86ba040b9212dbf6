use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

use anyhow::Context;

use super::replay::{Plan, Settings};
use super::results::Results;
use super::terminal::{INTERRUPTED, catch_interrupts, print};
use mfg_vio::config::Resolved;
use mfg_vio::dataset::Fault;
use mfg_vio::evaluation::Table;
use mfg_vio::replay::{FaultOutcome, confusion, fault_grid};

/// Replay a log under one fault after another and tell what became of the estimate.
///
/// The table says of each fault whether it was named as what it is, and when; whether poses and
/// covariances stayed valid; how long vision was lost; and error and NEES from a second after its
/// end on (3 is consistent), heading and position of the first poses of run and reference being put
/// on each other. Without a fault anything that is named is a false alarm. How often each kind was
/// named what is the confusion matrix below it.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  mfg-vio simulate --out lab.mcap --duration 15\n  \
                        mfg-vio faults lab.mcap --at 5\n  \
                        mfg-vio faults lab.mcap --fault black:4:2 --fault imu-noise:6:1:20")]
pub struct FaultsArgs {
    /// The log, with a reference.
    log: PathBuf,
    #[command(flatten)]
    settings: Settings,
    /// Configuration of the sensor set-up; by default chosen by the log's layout.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// When the faults happen, s after the log's first message.
    #[arg(long, value_name = "S", default_value_t = 5.0)]
    at: f64,
    /// Only this fault, KIND:START:LENGTH[:AMOUNT] (repeatable); see `replay --fault`.
    #[arg(long = "fault", value_name = "SPEC")]
    faults: Vec<Fault>,
    /// Use only this much of the log, s.
    #[arg(long, value_name = "S", default_value_t = f64::INFINITY, hide_default_value = true)]
    duration: f64,
    /// Reference trajectory (TUM, EuRoC, KITTI or VCU-RVI format) instead of the log's.
    #[arg(long, value_name = "TRAJ")]
    truth: Option<PathBuf>,
    /// Directory for the outputs of each run, in folders named by the fault.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &FaultsArgs) -> anyhow::Result<()> {
    catch_interrupts()?;
    let faults = match args.faults.is_empty() {
        true => fault_grid(args.at),
        false => args.faults.clone(),
    };
    let runs = std::iter::once(None).chain(faults.iter().map(Some));
    let mut outcomes = Vec::new();
    for fault in runs {
        let outcome = outcome(args, fault)?;
        if INTERRUPTED.load(Ordering::Relaxed) {
            break;
        }
        if fault.is_none() {
            check_within(&faults, outcome.seconds)?;
        }
        outcomes.push(outcome);
    }
    let output = match args.json {
        true => serde_json::to_string(&serde_json::json!({
            "log": args.log.display().to_string(),
            "outcomes": outcomes,
            "confusion": confusion(&outcomes),
        }))?,
        false => format!("{}\n\n{}", table(&outcomes).to_text().trim_end(), confused(&outcomes)),
    };
    print(&output)
}

/// An error if there is a fault that never happens.
fn check_within(faults: &[Fault], seconds: f64) -> anyhow::Result<()> {
    let late: Vec<_> =
        faults.iter().filter(|f| f.start >= seconds).map(|f| format!("`{f}`")).collect();
    anyhow::ensure!(
        late.is_empty(),
        "the replayed part of the log ends after {seconds:.2} s, before {} begins",
        late.join(", ")
    );
    Ok(())
}

/// A failed run is an outcome; what prevents all of them is an error.
fn outcome(args: &FaultsArgs, fault: Option<&Fault>) -> anyhow::Result<FaultOutcome> {
    let file = args.config.as_deref();
    let resolved = Resolved::of(&args.log, file, args.settings.overrides())?;
    resolved.require_calibration()?;
    let config_origin = resolved.name();
    let Resolved { config, summary, .. } = resolved;
    let out = args.out.as_deref().map(|out| folder(out, fault));
    out.as_deref().map_or(Ok(()), |out| Results::of("replay").remove(out))?;
    let plan = Plan {
        log: &args.log,
        settings: &args.settings,
        config,
        config_origin,
        out,
        truth: args.truth.clone(),
        start: 0.0,
        duration: args.duration,
        summary,
        recording: vec![],
        faults: fault.copied().into_iter().collect(),
    };
    let replayed = plan.execute();
    match (replayed, fault) {
        (Ok(replayed), _) => Ok(FaultOutcome::of(fault, &replayed)),
        (Err(error), Some(_)) => Ok(FaultOutcome::failed(fault, format!("{error:#}"))),
        (Err(error), None) => Err(error).context("the run without a fault"),
    }
}

fn folder(out: &Path, fault: Option<&Fault>) -> PathBuf {
    out.join(fault.map_or_else(|| "none".to_owned(), |fault| fault.to_string().replace(':', "_")))
}

/// How often each kind was named what.
fn confused(outcomes: &[FaultOutcome]) -> String {
    let mut table = Table::new(["injected", "named", "runs"]);
    for (injected, named, runs) in confusion(outcomes) {
        table.push([injected.to_owned(), named.to_owned(), runs.to_string()]);
    }
    let right = outcomes.iter().filter(|outcome| outcome.right == Some(true)).count();
    let all = outcomes.iter().filter(|outcome| outcome.right.is_some()).count();
    format!("{}\nnamed as what it is: {right} of {all}", table.to_text().trim_end())
}

fn table(outcomes: &[FaultOutcome]) -> Table {
    let mut table = Table::new([
        "fault",
        "valid",
        "right",
        "named after, s",
        "blind, s",
        "diverged",
        "error, m",
        "error, deg",
        "NEES att.",
        "NEES pos.",
        "named as",
    ]);
    for outcome in outcomes {
        let number = |value: Option<f64>, digits: usize| {
            value.map_or_else(|| "-".to_owned(), |value| format!("{value:.digits$}"))
        };
        let after = outcome.recovered;
        let name = outcome.named.as_ref();
        table.push([
            outcome.fault.clone().unwrap_or_else(|| "none".to_owned()),
            if outcome.valid { "yes" } else { "NO" }.to_owned(),
            outcome.right.map_or("-", |right| if right { "yes" } else { "NO" }).to_owned(),
            number(name.map(|name| name.delay), 2),
            format!("{:.2}", outcome.seconds_without_vision),
            outcome.divergences.to_string(),
            number(after.map(|r| r.position), 4),
            number(after.map(|r| r.attitude_deg), 2),
            number(after.map(|r| r.attitude_nees), 1),
            number(after.map(|r| r.position_nees), 1),
            outcome
                .failure
                .clone()
                .or_else(|| name.map(|name| name.fault.to_string()))
                .unwrap_or_else(|| "-".to_owned()),
        ]);
    }
    table
}
