//! Relative pose error.

use std::num::NonZeroUsize;

use anyhow::bail;
use clap::ValueEnum;
use mfg_vio::evaluation::{self, Delta, Relation, RpeOptions, Table, Trajectory};

use super::super::WrongUsage;
use super::arguments::{AlignArg, positive};
use super::estimates::{Compared, EstimateReport, Kind};
use super::inputs::Inputs;
use super::presentation::Output;

pub(super) const HELP: &str = "\
Example:
  printf '%s\\n' '0 0 0 0 0 0 0 1' '1 1 0 0 0 0 0 1' '2 1 1 0 0 0 0 1' > ref.txt
  printf '%s\\n' '0 0 0 0 0 0 0 1' '1 1 0 0 0 0 0 1' '2 1 1.1 0 0 0 0 1' > est.txt
  mfg-vio evaluate rpe ref.txt est.txt --delta 1 --unit m --all-pairs --lengths 1,2";

#[derive(Debug, clap::Args)]
pub(super) struct Args {
    #[command(flatten)]
    inputs: Inputs,
    /// What is taken from the estimate first; only the scale of sim3 matters
    #[arg(long, value_enum, default_value = "none")]
    align: AlignArg,
    /// Distance of the two poses, in units of --unit
    #[arg(long, value_name = "N", default_value_t = 1.0, value_parser = positive)]
    delta: f64,
    /// Frames, seconds, metres of path, or degrees
    #[arg(long, value_enum, default_value = "f")]
    unit: UnitArg,
    /// From every pose, not one pair after the other
    #[arg(long)]
    all_pairs: bool,
    /// Also the error over sub-trajectories of these lengths, m
    #[arg(long, value_name = "A,B,C", value_delimiter = ',', value_parser = positive)]
    lengths: Vec<f64>,
    #[command(flatten)]
    output: Output,
}

#[derive(Debug, Clone, Copy, PartialEq, ValueEnum)]
enum UnitArg {
    F,
    S,
    M,
    Deg,
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let inputs = &args.inputs;
    let delta = args.delta;
    let delta = match args.unit {
        UnitArg::F if delta.fract() == 0.0 => Delta::Frames(delta as usize),
        UnitArg::F => bail!(WrongUsage(format!("--delta {delta}: a number of frames is whole"))),
        UnitArg::S => Delta::Seconds(delta),
        UnitArg::M => Delta::Metres(delta),
        UnitArg::Deg if delta <= 180.0 => Delta::Degrees(delta),
        UnitArg::Deg => bail!(WrongUsage(format!("--delta {delta}: an angle is at most 180"))),
    };
    let relation = Relation::from(inputs.relation);
    let (unit, kind) = (relation.unit(), if args.all_pairs { "all" } else { "consecutive" });
    let title =
        format!("Relative pose error ({unit}) over {} {}, {kind} pairs", args.delta, delta.unit());
    let compare = |reference: &Trajectory, estimate: &Trajectory, association| {
        let options = RpeOptions {
            association,
            alignment: args.align.into(),
            align_n: inputs.matching.align_n.map(NonZeroUsize::get),
            relation,
            delta,
            all_pairs: args.all_pairs,
        };
        let result = evaluation::rpe(reference, estimate, &options)?;
        let lengths = evaluation::sub_trajectory_errors(&result.pairs, &args.lengths)?;
        let absent = |length: &&f64| !lengths.iter().any(|error| error.length == **length);
        let warn = |length: &f64| format!("the reference has no sub-trajectory of {length} m");
        let figure = || evaluation::relative_error_figure(&lengths);
        let draws = args.output.draws() && !lengths.is_empty();
        let stamps = result.links.iter().filter_map(|&(_, j)| result.pairs.stamps.get(j).copied());
        Ok(Compared {
            time_offset: association.time_offset,
            figures: draws.then(figure).into_iter().collect(),
            stamps: stamps.collect(),
            pairs: result.pairs,
            alignment: result.alignment,
            errors: result.errors,
            statistics: result.statistics,
            warnings: args.lengths.iter().filter(absent).map(warn).collect(),
            kind: Kind::Relative {
                pairs: result.links.len(),
                sub_trajectories: lengths.iter().map(Into::into).collect(),
            },
        })
    };
    let (mut presentation, reports) = inputs.compare(title, &args.output, compare)?;
    if !args.lengths.is_empty() {
        let table = sub_trajectory_table(&reports);
        presentation.tables.push(("Error over sub-trajectories".to_owned(), table));
    }
    args.output.emit(&presentation)
}

fn sub_trajectory_table(reports: &[EstimateReport]) -> Table {
    let mut table = Table::new([
        "file",
        "length (m)",
        "pairs",
        "mean (m)",
        "rmse (m)",
        "drift (%)",
        "mean (deg)",
        "rmse (deg)",
    ]);
    for report in reports {
        if let Kind::Relative { sub_trajectories, .. } = &report.kind {
            for sub in sub_trajectories {
                table.rows.push(vec![
                    report.file.as_str().into(),
                    sub.length.into(),
                    sub.pairs.into(),
                    sub.translation.mean.into(),
                    sub.translation.rmse.into(),
                    sub.drift_percent.into(),
                    sub.rotation_deg.mean.into(),
                    sub.rotation_deg.rmse.into(),
                ]);
            }
        }
    }
    table
}
