//! What is read: a reference and its estimates.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::bail;
use clap::Args;
use mfg_vio::evaluation::{self, EvaluationError, TrajectoryFile, TrajectoryFormat};
use rayon::prelude::*;

use super::super::terminal::tell;
use super::arguments::{Matching, RelationArg};

/// What is compared with what.
#[derive(Debug, Args)]
pub(super) struct Inputs {
    /// Reference trajectory (ground truth)
    #[arg(value_name = "REF")]
    pub(super) reference: PathBuf,
    /// Estimated trajectories
    #[arg(value_name = "EST", required = true)]
    pub(super) estimates: Vec<PathBuf>,
    #[command(flatten)]
    pub(super) matching: Matching,
    /// Part of the pose error: translation (m) or rotation angle (degrees)
    #[arg(long, value_enum, default_value = "trans")]
    pub(super) relation: RelationArg,
    /// Recording of the trajectories for the Rerun viewer
    #[arg(long, value_name = "FILE")]
    pub(super) rrd: Option<PathBuf>,
}

/// Says what of a file was not as it should be, though it could be read.
pub(super) fn with_warnings(path: &Path, file: TrajectoryFile) -> TrajectoryFile {
    let warn = |text: String| tell(&format!("warning: {}: {text}", path.display()));
    if file.reordered > 0 {
        warn(format!("{} poses were out of order and sorted", file.reordered));
    }
    if file.repeated > 0 {
        warn(format!("{} poses repeat another one and were left out", file.repeated));
    }
    if let Some(line) = file.first_contradiction {
        let count = file.contradicting;
        warn(format!("{count} poses have the stamp of another pose, first in line {line}"));
    }
    file
}

impl Inputs {
    /// The reference and the estimates, read side by side: parsing is most of the work.
    pub(super) fn read(&self) -> anyhow::Result<(TrajectoryFile, Vec<TrajectoryFile>)> {
        let (reference, estimates) = rayon::join(
            || evaluation::read_trajectory(&self.reference),
            || self.estimates.par_iter().map(|path| evaluation::read_trajectory(path)).collect(),
        );
        let reference = with_warnings(&self.reference, reference?);
        let estimates: Vec<Result<TrajectoryFile, EvaluationError>> = estimates;
        let mut checked = Vec::new();
        for (path, estimate) in self.estimates.iter().zip(estimates) {
            let estimate = with_warnings(path, estimate?);
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
pub(super) fn short_names(paths: &[PathBuf]) -> Vec<String> {
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
