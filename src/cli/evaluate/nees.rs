//! Consistency of a run: normalised estimation error squared.

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use mfg_vio::evaluation::{self, NeesOptions, NeesResult, NeesSummary, Table};

use super::super::WrongUsage;
use super::arguments::{AlignArg, Matching};
use super::inputs::with_warnings;
use super::presentation::{Output, Presentation};

pub(super) const HELP: &str = "\
DIR is what `replay --out DIR` wrote, or a state.csv. Worlds are aligned by heading
and position (where they are not both z-up: wholly) at the first matched pose whose
attitude is known, unless --align says otherwise; none if they are the same.

Errors of one run are alike from frame to frame: `independent` is how many independent errors tell as
much, and the mean of a consistent filter lies between `mean from` and `mean to` in 95 % of runs.

Example:
  mfg-vio simulate --out sim.mcap --duration 10 && mfg-vio replay sim.mcap --out run
  mfg-vio evaluate nees run/trajectory.tum run --report nees.html";

#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// Reference trajectory (ground truth)
    #[arg(value_name = "REF")]
    reference: PathBuf,
    /// Directory of a run
    #[arg(value_name = "DIR")]
    directory: PathBuf,
    #[command(flatten)]
    matching: Matching,
    /// How the reference's world is put on the estimate's; by default heading and position of the
    /// first poses where both worlds are z-up, the whole first poses (origin) elsewhere
    #[arg(long, value_enum)]
    align: Option<AlignArg>,
    #[command(flatten)]
    output: Output,
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    if matches!(args.align, Some(AlignArg::Sim3)) {
        bail!(WrongUsage("--align sim3: a belief has no scale".to_owned()));
    }
    let reference = with_warnings(&args.reference, evaluation::read_trajectory(&args.reference)?);
    let path = match args.directory.is_dir() {
        true => args.directory.join("state.csv"),
        false => args.directory.clone(),
    };
    let estimate = evaluation::read_believed_trajectory(&path)?;
    let association = args.matching.options(&path, &reference.trajectory, &estimate.trajectory)?;
    let options = match args.align {
        Some(align) => NeesOptions {
            association,
            alignment: align.into(),
            align_n: args.matching.align_n.map(NonZeroUsize::get),
            ..Default::default()
        },
        None => NeesOptions::levelled(&reference.trajectory, &estimate.trajectory, association)?,
    };
    let result = evaluation::nees(&reference.trajectory, &estimate, &options)
        .with_context(|| format!("{} against {}", path.display(), args.reference.display()))?;
    let figures = match args.output.draws() {
        true => vec![evaluation::belief_figure(&result), evaluation::nees_figure(&result)],
        false => Vec::new(),
    };
    let (matched, poses) = (result.matched, result.estimate_poses);
    let warnings = warnings(&result);
    let mut json = json(&path, &result, &options);
    json["warnings"] = serde_json::to_value(&warnings)?;
    args.output.emit(&Presentation {
        title: format!("NEES, {} alignment", options.alignment),
        notes: vec![
            format!("reference: {}", args.reference.display()),
            format!("{}: matched {matched} of {poses} poses", path.display()),
        ],
        warnings,
        json,
        tables: vec![("Consistency (95 % chi-square bands, two-sided)".to_owned(), table(&result))],
        figures,
    })
}

fn warnings(result: &NeesResult) -> Vec<String> {
    let NeesResult { singular, matched, .. } = result;
    let warning = format!("{singular} of {matched} covariances are not positive definite");
    if *singular > 0 { vec![warning] } else { vec![] }
}

fn table(result: &NeesResult) -> Table {
    let parts =
        [("attitude", &result.attitude), ("position", &result.position), ("joint", &result.joint)];
    let mut table = Table::new([
        "part",
        "dof",
        "mean",
        "median",
        "band from",
        "to",
        "inside",
        "above",
        "independent",
        "mean from",
        "mean to",
        "verdict",
    ]);
    for (name, summary) in parts {
        let NeesSummary { dof, mean, median, band: [low, high], inside, above, run } = *summary;
        table.rows.push(vec![
            name.into(),
            dof.into(),
            mean.into(),
            median.into(),
            low.into(),
            high.into(),
            inside.into(),
            above.into(),
            run.map(|run| run.effective_samples).into(),
            run.map(|run| run.mean_band[0]).into(),
            run.map(|run| run.mean_band[1]).into(),
            run.map(|run| run.verdict.name()).into(),
        ]);
    }
    table
}

fn json(path: &Path, result: &NeesResult, options: &NeesOptions) -> serde_json::Value {
    serde_json::json!({
        "file": path.display().to_string(),
        "matched": result.matched,
        "reference_poses": result.reference_poses,
        "estimate_poses": result.estimate_poses,
        "singular": result.singular,
        "time_offset": options.association.time_offset,
        "alignment": options.alignment.name(),
        "attitude": result.attitude,
        "position": result.position,
        "joint": result.joint,
    })
}
