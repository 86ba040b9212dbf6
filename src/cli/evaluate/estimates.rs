//! Estimates against their reference: the part that `ape` and `rpe` have in common.

use std::path::Path;

use anyhow::Context;
use mfg_vio::evaluation::{
    self, AssociationOptions, Cell, EvaluationError, Figure, PosePairs, Relation, Similarity,
    Statistics, SubTrajectoryError, Table, Trajectory,
};
use serde::Serialize;

use super::inputs::{Inputs, short_names};
use super::presentation::{Output, Presentation};

/// The JSON object of one estimate.
#[derive(Serialize)]
pub(super) struct EstimateReport {
    pub(super) file: String,
    pub(super) matched: usize,
    pub(super) reference_poses: usize,
    pub(super) estimate_poses: usize,
    pub(super) relation: &'static str,
    /// Of the statistics.
    pub(super) unit: &'static str,
    #[serde(flatten)]
    pub(super) statistics: Statistics,
    pub(super) alignment: Similarity,
    /// Seconds added to the stamps of the estimate.
    pub(super) time_offset: f64,
    #[serde(flatten)]
    pub(super) kind: Kind,
    pub(super) warnings: Vec<String>,
}

#[derive(Clone, Serialize)]
#[serde(untagged)]
pub(super) enum Kind {
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
pub(super) struct SubTrajectory {
    pub(super) length: f64,
    pub(super) pairs: usize,
    pub(super) translation: Statistics,
    pub(super) rotation_deg: Statistics,
    pub(super) drift_percent: f64,
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

/// An estimate that was compared with the reference.
pub(super) struct Compared {
    /// Seconds added to the stamps of the estimate.
    pub(super) time_offset: f64,
    /// The matched poses, the estimate's aligned.
    pub(super) pairs: PosePairs,
    pub(super) alignment: Similarity,
    /// Stamps of the errors, s.
    pub(super) stamps: Vec<f64>,
    pub(super) errors: Vec<f64>,
    pub(super) statistics: Statistics,
    pub(super) kind: Kind,
    pub(super) warnings: Vec<String>,
    /// To be shown before the error over time.
    pub(super) figures: Vec<Figure>,
}

impl Inputs {
    /// Compares every estimate with the reference, records and gathers what is to be shown.
    pub(super) fn compare(
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
                .with_context(|| format!("{file} against {}", self.reference.display()))?;
            reports.push(EstimateReport {
                file,
                matched: case.pairs.len(),
                reference_poses: case.pairs.reference_poses,
                estimate_poses: case.pairs.estimate_poses,
                relation: relation.name(),
                unit,
                statistics: case.statistics,
                alignment: case.alignment,
                time_offset: case.time_offset,
                kind: case.kind.clone(),
                warnings: case.warnings.clone(),
            });
            compared.push((case.time_offset, case));
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
    use mfg_vio::output::NewFile;
    use mfg_vio::viewer::{ComparedEstimate, record_comparison};

    let estimates: Vec<_> = estimates
        .map(|(name, time_offset, case)| {
            let Compared { pairs, stamps, errors, .. } = case;
            ComparedEstimate { name, pairs, time_offset, stamps, errors }
        })
        .collect();
    let io = || path.display().to_string();
    let file = NewFile::create(path).with_context(io)?;
    record_comparison(file.path(), title, unit, reference, &estimates)?;
    file.finish().with_context(io)
}

#[cfg(not(feature = "viewer"))]
fn record<'a>(
    path: &Path,
    _: &str,
    _: &str,
    _: &Trajectory,
    _: impl Iterator<Item = (&'a str, f64, &'a Compared)>,
) -> anyhow::Result<()> {
    anyhow::bail!("{}: this program was built without the feature `viewer`", path.display())
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
