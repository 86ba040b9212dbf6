//! One table of many runs.

use std::path::PathBuf;

use mfg_vio::evaluation::{self, Comparison, Run, Table};

use super::arguments::positive;
use super::presentation::{Output, Presentation};

pub(super) const HELP: &str = "\
A DIR is what `replay --out DIR` wrote from a log with a reference, or holds
several of these; then runs of the same name are compared in pairs.

Example:
  mfg-vio simulate --out sim.mcap --duration 10
  mfg-vio replay sim.mcap --filter mfgr --out mfgr && mfg-vio replay sim.mcap --filter mekfr --out mekfr
  mfg-vio evaluate compare mfgr mekfr --plot compare.svg";

#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// Directories of runs
    #[arg(value_name = "DIR", required = true)]
    directories: Vec<PathBuf>,
    /// Largest position RMSE of a run that counts as a success, m
    #[arg(long, value_name = "M", default_value_t = 1.0, value_parser = positive)]
    success: f64,
    #[command(flatten)]
    output: Output,
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let comparison = evaluation::compare(&args.directories, args.success)?;
    let mut tables =
        vec![("Methods".to_owned(), methods(&comparison)), ("Runs".to_owned(), runs(&comparison))];
    if !comparison.tests.is_empty() {
        tables.push(("Paired t-tests of the position RMSE".to_owned(), tests(&comparison)));
    }
    let groups = comparison.methods.iter().map(|method| {
        (method.name.clone(), method.runs.iter().filter_map(|run| run.position_rmse).collect())
    });
    let figure =
        evaluation::groups_figure("Position RMSE of the runs", "RMSE (m)", groups.collect());
    args.output.emit(&Presentation {
        title: "Comparison of runs".to_owned(),
        notes: vec![format!("success: position RMSE of at most {} m", args.success)],
        warnings: unfinished(&comparison),
        json: serde_json::to_value(&comparison)?,
        tables,
        figures: vec![figure],
    })
}

fn unfinished(comparison: &Comparison) -> Vec<String> {
    let runs = comparison.methods.iter().flat_map(|method| &method.runs);
    let warning = |run: &Run| {
        format!("{}: no metrics.json, so it did not finish: no success", run.directory.display())
    };
    runs.filter(|run| !run.finished).map(warning).collect()
}

fn methods(comparison: &Comparison) -> Table {
    let mut table = Table::new([
        "method",
        "runs",
        "success (%)",
        "mean rmse (m)",
        "mean rmse (deg)",
        "mean drift (%)",
    ]);
    for method in &comparison.methods {
        table.rows.push(vec![
            method.name.as_str().into(),
            method.runs.len().into(),
            (100.0 * method.success_rate).into(),
            method.mean_position_rmse.into(),
            method.mean_attitude_rmse.into(),
            method.mean_drift_percent.into(),
        ]);
    }
    table
}

fn runs(comparison: &Comparison) -> Table {
    let mut table = Table::new([
        "method",
        "run",
        "matched",
        "rmse (m)",
        "rmse (deg)",
        "drift (%)",
        "real-time factor",
    ]);
    for method in &comparison.methods {
        for run in &method.runs {
            table.rows.push(vec![
                method.name.as_str().into(),
                run.name.as_str().into(),
                run.matched.into(),
                run.position_rmse.into(),
                run.attitude_rmse.into(),
                run.drift_percent.into(),
                run.real_time_factor.into(),
            ]);
        }
    }
    table
}

fn tests(comparison: &Comparison) -> Table {
    let mut table = Table::new(["first", "second", "runs", "mean difference (m)", "p"]);
    for test in &comparison.tests {
        table.rows.push(vec![
            test.first.as_str().into(),
            test.second.as_str().into(),
            test.runs.into(),
            test.mean_difference.into(),
            test.p_value.into(),
        ]);
    }
    table
}
