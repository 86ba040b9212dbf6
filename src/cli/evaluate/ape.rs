//! Absolute pose error.

use std::num::NonZeroUsize;

use mfg_vio::evaluation::{self, Alignment, ApeOptions, Relation, Table, Trajectory};

use super::arguments::AlignArg;
use super::estimates::{Compared, EstimateReport, Kind};
use super::inputs::Inputs;
use super::presentation::Output;

pub(super) const HELP: &str = "\
Formats are guessed from the content: TUM (t x y z qx qy qz qw), EuRoC csv
(t_ns,x,y,z,qw,qx,qy,qz,...; also that of the VCU-RVI authors), KITTI (3x4).

Example:
  printf '%s\\n' '0 0 0 0 0 0 0 1' '1 1 0 0 0 0 0 1' '2 1 1 0 0 0 0 1' > ref.txt
  printf '%s\\n' '0 0 0 0 0 0 0 1' '1 1 0 0 0 0 0 1' '2 1 1.1 0 0 0 0 1' > est.txt
  mfg-vio evaluate ape ref.txt est.txt --align yaw --plot ape.svg";

#[derive(Debug, clap::Args)]
pub(super) struct Args {
    #[command(flatten)]
    inputs: Inputs,
    /// What is taken from the estimate before it is compared
    #[arg(long, value_enum, default_value = "se3")]
    align: AlignArg,
    /// Report the scale that Sim(3) alignment would find
    #[arg(long)]
    scale_check: bool,
    #[command(flatten)]
    output: Output,
}

pub(super) fn run(args: &Args) -> anyhow::Result<()> {
    let inputs = &args.inputs;
    let alignment = Alignment::from(args.align);
    let relation = Relation::from(inputs.relation);
    let title = format!("Absolute pose error ({}), {alignment} alignment", relation.unit());
    let compare = |reference: &Trajectory, estimate: &Trajectory, association| {
        let align_n = inputs.matching.align_n.map(NonZeroUsize::get);
        let mut options = ApeOptions { association, alignment, align_n, relation };
        if inputs.matching.seeks_offset() && relation == Relation::Translation {
            let start = options.association.time_offset;
            options.association.time_offset =
                evaluation::best_clock_offset(reference, estimate, start, &options)?;
        }
        let association = options.association;
        let pairs = evaluation::associate(reference, estimate, &association)?;
        let suspicions = evaluation::suspicions(reference, estimate, &pairs, &options);
        let scale_check = args.scale_check.then(|| evaluation::similarity_scale(&pairs));
        let result = evaluation::ape_of_pairs(pairs, alignment, align_n, relation)?;
        let borrowed = result.by_positions.map(|rmse| {
            format!(
                "the rotation of the alignment is taken from the attitudes: the positions lie on \
                 a line or in a point, and would leave an error of {rmse:.1} deg"
            )
        });
        let figure =
            || evaluation::trajectory_figure(&result.pairs, &result.errors, relation.unit());
        Ok(Compared {
            time_offset: association.time_offset,
            figures: args.output.draws().then(figure).into_iter().collect(),
            stamps: result.pairs.stamps.clone(),
            pairs: result.pairs,
            alignment: result.alignment,
            errors: result.errors,
            statistics: result.statistics,
            kind: Kind::Absolute { scale_check },
            warnings: suspicions.iter().map(ToString::to_string).chain(borrowed).collect(),
        })
    };
    let (mut presentation, reports) = inputs.compare(title, &args.output, compare)?;
    if args.scale_check {
        presentation.tables.push(("Scale of Sim(3) alignment".to_owned(), scale_table(&reports)));
    }
    args.output.emit(&presentation)
}

fn scale_table(reports: &[EstimateReport]) -> Table {
    let mut table = Table::new(["file", "scale"]);
    for report in reports {
        if let Kind::Absolute { scale_check: Some(scale) } = report.kind {
            table.rows.push(vec![report.file.as_str().into(), scale.into()]);
        }
    }
    table
}
