//! `mfg-vio evaluate`: trajectory error, consistency and comparison of runs.

use std::collections::BTreeSet;
use std::io::Write;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::{Args, Subcommand, ValueEnum};
use mfg_vio::evaluation::{
    self, Alignment, ApeOptions, AssociationOptions, AssociationRule, Cell, Delta, EvaluationError,
    Figure, NeesOptions, NeesSummary, PosePairs, Relation, Report, RpeOptions, Similarity,
    Statistics, SubTrajectoryError, Table, Trajectory, TrajectoryFile, TrajectoryFormat,
    write_html,
};
use rayon::prelude::*;
use serde::Serialize;

#[derive(Debug, Args)]
pub struct EvaluateArgs {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Absolute pose error: how far aligned estimates are from a reference
    #[command(after_help = APE_HELP)]
    Ape(ApeArgs),
    /// Relative pose error: how far the motion over a distance is off
    #[command(after_help = RPE_HELP)]
    Rpe(RpeArgs),
    /// Consistency: are the errors of a run as large as it believes?
    #[command(after_help = NEES_HELP)]
    Nees(NeesArgs),
    /// One table of many runs
    #[command(after_help = COMPARE_HELP)]
    Compare(CompareArgs),
}

const APE_HELP: &str = "\
Formats are guessed from the content: TUM (t x y z qx qy qz qw), EuRoC csv
(t_ns,x,y,z,qw,qx,qy,qz,...; also that of the VCU-RVI authors), KITTI (3x4).

Example:
  printf '%s\\n' '0 0 0 0 0 0 0 1' '1 1 0 0 0 0 0 1' '2 1 1 0 0 0 0 1' > ref.txt
  printf '%s\\n' '0 0 0 0 0 0 0 1' '1 1 0 0 0 0 0 1' '2 1 1.1 0 0 0 0 1' > est.txt
  mfg-vio evaluate ape ref.txt est.txt --align yaw --plot ape.svg";

const RPE_HELP: &str = "\
Example:
  printf '%s\\n' '0 0 0 0 0 0 0 1' '1 1 0 0 0 0 0 1' '2 1 1 0 0 0 0 1' > ref.txt
  printf '%s\\n' '0 0 0 0 0 0 0 1' '1 1 0 0 0 0 0 1' '2 1 1.1 0 0 0 0 1' > est.txt
  mfg-vio evaluate rpe ref.txt est.txt --delta 1 --unit m --all-pairs --lengths 1,2";

const NEES_HELP: &str = "\
DIR is what `replay --out DIR` wrote, or a state.csv. Worlds are aligned by heading
and position (where they are not both z-up: wholly) at the first matched pose whose
attitude is known, unless --align says otherwise; none if they are the same.

Example:
  mfg-vio simulate --out sim.mcap --duration 10 && mfg-vio replay sim.mcap --out run
  mfg-vio evaluate nees run/trajectory.tum run --report nees.html";

const COMPARE_HELP: &str = "\
A DIR is what `replay --out DIR` wrote from a log with a reference, or holds
several of these; then runs of the same name are compared in pairs.

Example:
  mfg-vio simulate --out sim.mcap --duration 10
  mfg-vio replay sim.mcap --filter mfgr --out mfgr && mfg-vio replay sim.mcap --filter mekfr --out mekfr
  mfg-vio evaluate compare mfgr mekfr --plot compare.svg";

pub fn run(args: EvaluateArgs) -> anyhow::Result<()> {
    match args.command {
        Command::Ape(args) => ape(&args),
        Command::Rpe(args) => rpe(&args),
        Command::Nees(args) => nees(&args),
        Command::Compare(args) => compare(&args),
    }
}

#[derive(Debug, Args)]
struct ApeArgs {
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

#[derive(Debug, Args)]
struct RpeArgs {
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

#[derive(Debug, Args)]
struct NeesArgs {
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

#[derive(Debug, Args)]
struct CompareArgs {
    /// Directories of runs
    #[arg(value_name = "DIR", required = true)]
    directories: Vec<PathBuf>,
    /// Largest position RMSE of a run that counts as a success, m
    #[arg(long, value_name = "M", default_value_t = 1.0, value_parser = positive)]
    success: f64,
    #[command(flatten)]
    output: Output,
}

/// What is compared with what.
#[derive(Debug, Args)]
struct Inputs {
    /// Reference trajectory (ground truth)
    #[arg(value_name = "REF")]
    reference: PathBuf,
    /// Estimated trajectories
    #[arg(value_name = "EST", required = true)]
    estimates: Vec<PathBuf>,
    #[command(flatten)]
    matching: Matching,
    /// Part of the pose error: translation (m) or rotation angle (degrees)
    #[arg(long, value_enum, default_value = "trans")]
    relation: RelationArg,
    /// Recording of the trajectories for the Rerun viewer
    #[arg(long, value_name = "FILE")]
    rrd: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct Matching {
    /// Align over the first N matched poses only
    #[arg(long, value_name = "N")]
    align_n: Option<NonZeroUsize>,
    /// Largest time difference of poses that are compared, s
    #[arg(long, value_name = "S", default_value_t = 0.01, value_parser = non_negative)]
    max_diff: f64,
    /// Which pose is compared with which
    #[arg(long, value_enum, default_value = "nearest")]
    association: AssociationArg,
    /// Added to the stamps of the estimate, s; auto: found from angular rates
    #[arg(
        long,
        value_name = "S|auto",
        default_value = "0",
        allow_negative_numbers = true,
        value_parser = time_offset
    )]
    time_offset: TimeOffset,
}

#[derive(Debug, Args)]
struct Output {
    /// One JSON object on standard output
    #[arg(long, conflicts_with_all = ["csv", "latex"])]
    json: bool,
    /// A CSV table on standard output
    #[arg(long, conflicts_with = "latex")]
    csv: bool,
    /// A LaTeX table (booktabs) on standard output
    #[arg(long)]
    latex: bool,
    /// Plot, as SVG or PNG
    #[arg(long, value_name = "FILE", value_parser = plot_file)]
    plot: Option<PathBuf>,
    /// Self-contained HTML report
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum AlignArg {
    /// Rotation and translation
    Se3,
    /// Rotation, translation and scale
    Sim3,
    /// Heading and translation
    Yaw,
    /// First pose on first pose
    Origin,
    /// Nothing
    None,
}

impl From<AlignArg> for Alignment {
    fn from(value: AlignArg) -> Self {
        match value {
            AlignArg::Se3 => Self::Se3,
            AlignArg::Sim3 => Self::Sim3,
            AlignArg::Yaw => Self::Yaw,
            AlignArg::Origin => Self::Origin,
            AlignArg::None => Self::None,
        }
    }
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum RelationArg {
    Trans,
    Angle,
}

impl From<RelationArg> for Relation {
    fn from(value: RelationArg) -> Self {
        match value {
            RelationArg::Trans => Self::Translation,
            RelationArg::Angle => Self::Angle,
        }
    }
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum AssociationArg {
    /// With the nearest in time, as evo does
    Nearest,
    /// With the nearest that no earlier pose has taken, as OpenVINS does
    Openvins,
}

impl From<AssociationArg> for AssociationRule {
    fn from(value: AssociationArg) -> Self {
        match value {
            AssociationArg::Nearest => Self::Nearest,
            AssociationArg::Openvins => Self::OpenVins,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, ValueEnum)]
enum UnitArg {
    F,
    S,
    M,
    Deg,
}

#[derive(Debug, Clone, Copy)]
enum TimeOffset {
    Fixed(f64),
    Auto,
}

fn time_offset(text: &str) -> Result<TimeOffset, String> {
    if text == "auto" { Ok(TimeOffset::Auto) } else { finite(text).map(TimeOffset::Fixed) }
}

/// Ends the program as clap does for what it can tell by itself.
fn wrong_usage(message: String) -> ! {
    clap::Error::raw(clap::error::ErrorKind::ValueValidation, message + "\n").exit()
}

fn finite(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        _ => Err("not a finite number".to_owned()),
    }
}

fn non_negative(text: &str) -> Result<f64, String> {
    finite(text).and_then(|x| if x >= 0.0 { Ok(x) } else { Err("must not be negative".to_owned()) })
}

fn positive(text: &str) -> Result<f64, String> {
    finite(text).and_then(|x| if x > 0.0 { Ok(x) } else { Err("must be above 0".to_owned()) })
}

fn plot_file(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
    match extension.as_deref() {
        Some("svg" | "png") => Ok(path),
        _ => Err("a plot is saved as .svg or .png".to_owned()),
    }
}

/// The JSON object of one estimate.
#[derive(Serialize)]
struct EstimateReport {
    file: String,
    matched: usize,
    reference_poses: usize,
    estimate_poses: usize,
    relation: &'static str,
    /// Of the statistics.
    unit: &'static str,
    #[serde(flatten)]
    statistics: Statistics,
    alignment: Similarity,
    /// Seconds added to the stamps of the estimate.
    time_offset: f64,
    #[serde(flatten)]
    kind: Kind,
    warnings: Vec<String>,
}

#[derive(Clone, Serialize)]
#[serde(untagged)]
enum Kind {
    Absolute {
        /// What Sim(3) alignment would find; only with `--scale-check`, null if undetermined.
        #[serde(skip_serializing_if = "Option::is_none")]
        scale_check: Option<Option<f64>>,
    },
    Relative {
        /// Number of relative errors.
        pairs: usize,
        #[serde(skip_serializing_if = "Vec::is_empty")]
        sub_trajectories: Vec<SubTrajectory>,
    },
}

#[derive(Clone, Serialize)]
struct SubTrajectory {
    length: f64,
    pairs: usize,
    translation: Statistics,
    rotation_deg: Statistics,
    drift_percent: f64,
}

impl From<&SubTrajectoryError> for SubTrajectory {
    fn from(error: &SubTrajectoryError) -> Self {
        Self {
            length: error.length,
            pairs: error.translation_errors.len(),
            translation: error.translation,
            rotation_deg: error.rotation,
            drift_percent: error.drift_percent(),
        }
    }
}

/// Everything that a command has to show, before it is known where.
struct Presentation {
    title: String,
    notes: Vec<String>,
    warnings: Vec<String>,
    json: serde_json::Value,
    /// The first one is what `--csv` and `--latex` print.
    tables: Vec<(String, Table)>,
    /// The first one is what `--plot` saves.
    figures: Vec<Figure>,
}

/// An estimate that was compared with the reference.
struct Compared {
    /// The matched poses, the estimate's aligned.
    pairs: PosePairs,
    alignment: Similarity,
    /// Stamps of the errors, s.
    stamps: Vec<f64>,
    errors: Vec<f64>,
    statistics: Statistics,
    kind: Kind,
    warnings: Vec<String>,
    /// To be shown before the error over time.
    figures: Vec<Figure>,
}

fn ape(args: &ApeArgs) -> anyhow::Result<()> {
    let inputs = &args.inputs;
    let alignment = Alignment::from(args.align);
    let relation = Relation::from(inputs.relation);
    let title = format!("Absolute pose error ({}), {alignment} alignment", relation.unit());
    let compare = |reference: &Trajectory, estimate: &Trajectory, association| {
        let align_n = inputs.matching.align_n.map(NonZeroUsize::get);
        let options = ApeOptions { association, alignment, align_n, relation };
        let pairs = evaluation::associate(reference, estimate, &association)?;
        let suspicions = evaluation::suspicions(reference, estimate, &pairs, &options);
        let scale_check = args.scale_check.then(|| evaluation::similarity_scale(&pairs));
        let result = evaluation::ape_of_pairs(pairs, alignment, align_n, relation)?;
        let figure =
            || evaluation::trajectory_figure(&result.pairs, &result.errors, relation.unit());
        Ok(Compared {
            figures: args.output.draws().then(figure).into_iter().collect(),
            stamps: result.pairs.stamps.clone(),
            pairs: result.pairs,
            alignment: result.alignment,
            errors: result.errors,
            statistics: result.statistics,
            kind: Kind::Absolute { scale_check },
            warnings: suspicions.iter().map(ToString::to_string).collect(),
        })
    };
    let (mut presentation, reports) = inputs.compare(title, &args.output, compare)?;
    if args.scale_check {
        presentation.tables.push(("Scale of Sim(3) alignment".to_owned(), scale_table(&reports)));
    }
    args.output.emit(&presentation)
}

fn rpe(args: &RpeArgs) -> anyhow::Result<()> {
    let inputs = &args.inputs;
    let delta = match args.unit {
        UnitArg::F if args.delta.fract() == 0.0 => Delta::Frames(args.delta as usize),
        UnitArg::F => wrong_usage(format!("--delta {}: a number of frames is whole", args.delta)),
        UnitArg::S => Delta::Seconds(args.delta),
        UnitArg::M => Delta::Metres(args.delta),
        UnitArg::Deg if args.delta <= 180.0 => Delta::Degrees(args.delta),
        UnitArg::Deg => wrong_usage(format!("--delta {}: an angle is at most 180", args.delta)),
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

impl Inputs {
    /// Compares every estimate with the reference, records and gathers what is to be shown.
    fn compare(
        &self,
        title: String,
        output: &Output,
        compare: impl Fn(
            &Trajectory,
            &Trajectory,
            AssociationOptions,
        ) -> Result<Compared, EvaluationError>,
    ) -> anyhow::Result<(Presentation, Vec<EstimateReport>)> {
        let relation = Relation::from(self.relation);
        let unit = relation.unit();
        let (reference, estimates) = self.read()?;
        let names = short_names(&self.estimates);
        let mut reports = Vec::new();
        let mut compared = Vec::new();
        for (path, estimate) in self.estimates.iter().zip(&estimates) {
            let association = self.matching.association(path, &reference, estimate)?;
            let file = path.display().to_string();
            let case = compare(&reference.trajectory, &estimate.trajectory, association)
                .with_context(|| file.clone())?;
            reports.push(EstimateReport {
                file,
                matched: case.pairs.len(),
                reference_poses: case.pairs.reference_poses,
                estimate_poses: case.pairs.estimate_poses,
                relation: relation.name(),
                unit,
                statistics: case.statistics,
                alignment: case.alignment,
                time_offset: association.time_offset,
                kind: case.kind.clone(),
                warnings: case.warnings.clone(),
            });
            compared.push((association.time_offset, case));
        }
        if let Some(path) = &self.rrd {
            let estimates = names.iter().zip(&compared);
            let estimates = estimates.map(|(name, (offset, case))| (name.as_str(), *offset, case));
            record(path, &title, unit, &reference.trajectory, estimates)?;
        }
        let mut figures = Vec::new();
        if output.draws() {
            let mut groups = Vec::new();
            for (name, (_, case)) in names.into_iter().zip(compared) {
                let over_time = evaluation::error_figure(&case.stamps, &case.errors, unit);
                let all = case.figures.into_iter().chain([over_time]);
                figures.extend(all.map(|figure| figure.titled(&name)));
                groups.push((name, case.errors));
            }
            if groups.len() > 1 {
                let label = format!("error ({unit})");
                figures.insert(0, evaluation::groups_figure(&title, &label, groups));
            }
        }
        Ok((present(title, &self.reference, &reports, figures)?, reports))
    }
}

#[cfg(feature = "viewer")]
fn record<'a>(
    path: &Path,
    title: &str,
    unit: &str,
    reference: &Trajectory,
    estimates: impl Iterator<Item = (&'a str, f64, &'a Compared)>,
) -> anyhow::Result<()> {
    use mfg_vio::viewer::{ComparedEstimate, record_comparison};

    let estimates: Vec<_> = estimates
        .map(|(name, time_offset, case)| {
            let Compared { pairs, stamps, errors, .. } = case;
            ComparedEstimate { name, pairs, time_offset, stamps, errors }
        })
        .collect();
    Ok(record_comparison(path, title, unit, reference, &estimates)?)
}

#[cfg(not(feature = "viewer"))]
fn record<'a>(
    path: &Path,
    _: &str,
    _: &str,
    _: &Trajectory,
    _: impl Iterator<Item = (&'a str, f64, &'a Compared)>,
) -> anyhow::Result<()> {
    bail!("{}: this program was built without the feature `viewer`", path.display())
}

fn present(
    title: String,
    reference: &Path,
    reports: &[EstimateReport],
    figures: Vec<Figure>,
) -> anyhow::Result<Presentation> {
    let json = match reports {
        [single] => serde_json::to_value(single)?,
        several => serde_json::json!({ "estimates": several }),
    };
    let mut notes = vec![format!("reference: {}", reference.display())];
    let mut warnings = Vec::new();
    for report in reports {
        let EstimateReport { file, matched, estimate_poses, time_offset, .. } = report;
        let offset = match time_offset {
            0.0 => String::new(),
            seconds => format!(", time offset {seconds:.4} s"),
        };
        notes.push(format!("{file}: matched {matched} of {estimate_poses} poses{offset}"));
        warnings.extend(report.warnings.iter().map(|warning| format!("{file}: {warning}")));
    }
    let tables = vec![("Errors".to_owned(), statistics_table(reports))];
    Ok(Presentation { title, notes, warnings, json, tables, figures })
}

fn statistics_table(reports: &[EstimateReport]) -> Table {
    let mut table =
        Table::new(["file", "matched", "of", "rmse", "mean", "median", "std", "min", "max", "sse"]);
    for report in reports {
        let mut row: Vec<Cell> =
            vec![report.file.as_str().into(), report.matched.into(), report.estimate_poses.into()];
        row.extend(report.statistics.entries().map(|(_, value)| value.into()));
        table.rows.push(row);
    }
    table
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

fn nees(args: &NeesArgs) -> anyhow::Result<()> {
    if matches!(args.align, Some(AlignArg::Sim3)) {
        wrong_usage("--align sim3: a belief has no scale".to_owned());
    }
    let reference = warn_of_order(&args.reference, evaluation::read_trajectory(&args.reference)?);
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
        .with_context(|| path.display().to_string())?;
    let mut warnings = Vec::new();
    if result.singular > 0 {
        let of = result.matched;
        warnings.push(format!("{} of {of} covariances are not positive definite", result.singular));
    }
    let parts =
        [("attitude", &result.attitude), ("position", &result.position), ("joint", &result.joint)];
    let mut table =
        Table::new(["part", "dof", "mean", "median", "band from", "to", "inside", "above"]);
    for (name, summary) in parts {
        let NeesSummary { dof, mean, median, band: [low, high], inside, above } = *summary;
        table.rows.push(vec![
            name.into(),
            dof.into(),
            mean.into(),
            median.into(),
            low.into(),
            high.into(),
            inside.into(),
            above.into(),
        ]);
    }
    let json = serde_json::json!({
        "file": path.display().to_string(),
        "matched": result.matched,
        "reference_poses": result.reference_poses,
        "estimate_poses": result.estimate_poses,
        "singular": result.singular,
        "time_offset": association.time_offset,
        "alignment": options.alignment.name(),
        "attitude": result.attitude,
        "position": result.position,
        "joint": result.joint,
        "warnings": warnings,
    });
    let figures = if args.output.draws() {
        vec![evaluation::belief_figure(&result), evaluation::nees_figure(&result)]
    } else {
        Vec::new()
    };
    args.output.emit(&Presentation {
        title: format!("NEES, {} alignment", options.alignment),
        notes: vec![
            format!("reference: {}", args.reference.display()),
            format!(
                "{}: matched {} of {} poses",
                path.display(),
                result.matched,
                result.estimate_poses
            ),
        ],
        warnings,
        json,
        tables: vec![("Consistency (95 % chi-square band)".to_owned(), table)],
        figures,
    })
}

fn compare(args: &CompareArgs) -> anyhow::Result<()> {
    let comparison = evaluation::compare(&args.directories, args.success)?;
    let mut methods = Table::new([
        "method",
        "runs",
        "success (%)",
        "mean rmse (m)",
        "mean rmse (deg)",
        "mean drift (%)",
    ]);
    let mut runs = Table::new([
        "method",
        "run",
        "matched",
        "rmse (m)",
        "rmse (deg)",
        "drift (%)",
        "real-time factor",
    ]);
    for method in &comparison.methods {
        methods.rows.push(vec![
            method.name.as_str().into(),
            method.runs.len().into(),
            (100.0 * method.success_rate).into(),
            method.mean_position_rmse.into(),
            method.mean_attitude_rmse.into(),
            method.mean_drift_percent.into(),
        ]);
        for run in &method.runs {
            runs.rows.push(vec![
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
    let mut tables = vec![("Methods".to_owned(), methods), ("Runs".to_owned(), runs)];
    if !comparison.tests.is_empty() {
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
        tables.push(("Paired t-tests of the position RMSE".to_owned(), table));
    }
    let groups = comparison.methods.iter().map(|method| {
        (method.name.clone(), method.runs.iter().filter_map(|run| run.position_rmse).collect())
    });
    let figure =
        evaluation::groups_figure("Position RMSE of the runs", "RMSE (m)", groups.collect());
    args.output.emit(&Presentation {
        title: "Comparison of runs".to_owned(),
        notes: vec![format!("success: position RMSE of at most {} m", args.success)],
        warnings: Vec::new(),
        json: serde_json::to_value(&comparison)?,
        tables,
        figures: vec![figure],
    })
}

impl Output {
    fn draws(&self) -> bool {
        self.plot.is_some() || self.report.is_some()
    }

    /// Prints and saves what was asked for; warnings and what has no place in a machine-readable
    /// answer go to standard error.
    fn emit(&self, presentation: &Presentation) -> anyhow::Result<()> {
        let Presentation { title, notes, warnings, json, tables, figures } = presentation;
        if let (Some(path), Some(figure)) = (&self.plot, figures.first()) {
            figure.save(path)?;
        }
        if let Some(path) = &self.report {
            let report = Report {
                title: title.clone(),
                notes: notes.clone(),
                warnings: warnings.clone(),
                tables: tables.clone(),
                figures: figures.clone(),
            };
            write_html(path, &report)?;
        }
        let first = tables.first().map(|(_, table)| table);
        let machine = match first {
            _ if self.json => Some(serde_json::to_string_pretty(json)? + "\n"),
            Some(table) if self.csv => Some(table.to_csv()),
            Some(table) if self.latex => Some(table.to_latex()),
            _ => None,
        };
        for warning in warnings {
            eprintln!("warning: {warning}");
        }
        let text = match machine {
            Some(text) => {
                for note in notes {
                    eprintln!("{note}");
                }
                text
            }
            None => {
                let mut text = format!("{title}\n{}\n", notes.join("\n"));
                for (heading, table) in tables {
                    text.push_str(&format!("\n{heading}\n{}", table.to_text()));
                }
                text
            }
        };
        // A reader that closes the pipe early is no error.
        match std::io::stdout().write_all(text.as_bytes()) {
            Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => Err(e.into()),
            _ => Ok(()),
        }
    }
}

impl Matching {
    fn association(
        &self,
        path: &Path,
        reference: &TrajectoryFile,
        estimate: &TrajectoryFile,
    ) -> anyhow::Result<AssociationOptions> {
        let without_stamps = estimate.format == TrajectoryFormat::Kitti;
        if without_stamps && matches!(self.time_offset, TimeOffset::Auto) {
            bail!("{}: KITTI poses have no stamps to find --time-offset from", path.display());
        }
        self.options(path, &reference.trajectory, &estimate.trajectory)
    }

    fn options(
        &self,
        path: &Path,
        reference: &Trajectory,
        estimate: &Trajectory,
    ) -> anyhow::Result<AssociationOptions> {
        let time_offset = match self.time_offset {
            TimeOffset::Fixed(seconds) => seconds,
            TimeOffset::Auto => {
                evaluation::estimate_clock_offset(reference, estimate)
                    .with_context(|| path.display().to_string())?
                    .seconds
            }
        };
        Ok(AssociationOptions {
            rule: self.association.into(),
            max_diff: self.max_diff,
            time_offset,
        })
    }
}

fn warn_of_order(path: &Path, file: TrajectoryFile) -> TrajectoryFile {
    if file.reordered > 0 {
        let count = file.reordered;
        eprintln!("warning: {}: {count} poses were out of order and sorted", path.display());
    }
    file
}

impl Inputs {
    /// The reference and the estimates, read side by side: parsing is most of the work.
    fn read(&self) -> anyhow::Result<(TrajectoryFile, Vec<TrajectoryFile>)> {
        let (reference, estimates) = rayon::join(
            || evaluation::read_trajectory(&self.reference),
            || self.estimates.par_iter().map(|path| evaluation::read_trajectory(path)).collect(),
        );
        let reference = warn_of_order(&self.reference, reference?);
        let estimates: Vec<Result<TrajectoryFile, EvaluationError>> = estimates;
        let mut checked = Vec::new();
        for (path, estimate) in self.estimates.iter().zip(estimates) {
            let estimate = warn_of_order(path, estimate?);
            check_comparable(path, &reference, &estimate)?;
            checked.push(estimate);
        }
        Ok((reference, checked))
    }
}

/// Both must have stamps, or neither and the same number of poses.
fn check_comparable(
    path: &Path,
    reference: &TrajectoryFile,
    estimate: &TrajectoryFile,
) -> anyhow::Result<()> {
    let without_stamps = |file: &TrajectoryFile| file.format == TrajectoryFormat::Kitti;
    let (theirs, ours) = (reference.trajectory.len(), estimate.trajectory.len());
    match (without_stamps(reference), without_stamps(estimate)) {
        (true, true) if theirs != ours => bail!(
            "{}: {ours} poses without stamps, the reference has {theirs}: which belong together?",
            path.display(),
        ),
        (true, false) | (false, true) => bail!(
            "{}: is {}, the reference is {}: only one of them has stamps",
            path.display(),
            estimate.format,
            reference.format
        ),
        _ => Ok(()),
    }
}

/// File names without extension; where they are not all different, the paths without what they
/// have in common at the front.
fn short_names(paths: &[PathBuf]) -> Vec<String> {
    let stem = |path: &PathBuf| path.file_stem().unwrap_or(path.as_os_str()).to_owned();
    let stems: BTreeSet<_> = paths.iter().map(stem).collect();
    if stems.len() == paths.len() {
        return paths.iter().map(|path| stem(path).to_string_lossy().into_owned()).collect();
    }
    let common = (0..)
        .take_while(|&depth| {
            let part =
                |path: &PathBuf| path.components().nth(depth).map(|c| c.as_os_str().to_owned());
            let first = paths.first().and_then(part);
            first.is_some() && paths.iter().all(|path| part(path) == first)
        })
        .count();
    let rest = |path: &PathBuf| path.components().skip(common).collect::<PathBuf>();
    paths.iter().map(|path| rest(path).display().to_string()).collect()
}
