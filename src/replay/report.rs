//! Tables and figures of one replay.

use super::Replayed;
use crate::evaluation::Report;
use crate::evaluation::{
    ApeOptions, Cell, EvaluationError, Figure, Table, ape, counts_figure, error_figure,
    stage_times_figure, trajectory_figure,
};
use crate::odometry::{StageTimes, StepReport};

/// Values of every frame that reports are drawn from.
#[derive(Debug, Clone, Default)]
pub struct Series {
    /// s.
    pub stamps: Vec<f64>,
    pub features: Vec<f64>,
    pub matches: Vec<f64>,
    pub inliers: Vec<f64>,
    pub map_points: Vec<f64>,
    /// Three standard deviations of the position (root of the covariance's trace), m.
    pub position_three_sigma: Vec<f64>,
    /// Wall times, s.
    pub times: Vec<StageTimes>,
}

impl Series {
    pub(super) fn push(&mut self, report: &StepReport) {
        self.stamps.push(report.stamp.seconds());
        self.features.push(report.counts.features as f64);
        self.matches.push(report.counts.matches as f64);
        self.inliers.push(report.counts.inliers as f64);
        self.map_points.push(report.counts.map_points as f64);
        let first = crate::inertial::block::POSITION;
        let variance: f64 = (first..first + 3).map(|k| report.covariance[(k, k)]).sum();
        self.position_three_sigma.push(3.0 * variance.max(0.0).sqrt());
        self.times.push(report.times);
    }

    fn stages(&self) -> Vec<(&'static str, Vec<f64>)> {
        let stage =
            |k: usize, name| (name, self.times.iter().map(|times| times.stages()[k].1).collect());
        let names = StageTimes::default().stages().map(|(name, _)| name);
        names.into_iter().enumerate().map(|(k, name)| stage(k, name)).collect()
    }
}

/// Report of a replay: figures of the run and, with a reference, of its error.
pub fn report(replayed: &Replayed) -> Result<Report, EvaluationError> {
    let series = &replayed.series;
    let metrics = &replayed.metrics;
    let mut report = Report {
        title: format!("{}, {}", metrics.log, metrics.filter),
        tables: vec![("Result".to_owned(), result_table(replayed))],
        ..Report::default()
    };
    report.figures.extend(error_figures(replayed)?);
    let counts = [
        ("features", series.features.clone()),
        ("matches", series.matches.clone()),
        ("inliers", series.inliers.clone()),
    ];
    report.figures.push(counts_figure(&series.stamps, &counts));
    report.figures.push(stage_times_figure(&series.stages()));
    Ok(report)
}

fn error_figures(replayed: &Replayed) -> Result<Vec<Figure>, EvaluationError> {
    let (Some(reference), Some(estimate)) = (&replayed.reference, &replayed.estimate) else {
        return Ok(vec![]);
    };
    if replayed.metrics.evaluation.is_none() {
        return Ok(vec![]);
    }
    let result = ape(reference, estimate, &ApeOptions::default())?;
    Ok(vec![
        trajectory_figure(&result.pairs, &result.errors, "m"),
        error_figure(&result.pairs.stamps, &result.errors, "m", None),
    ])
}

fn result_table(replayed: &Replayed) -> Table {
    let metrics = &replayed.metrics;
    let mut table = Table::new(["quantity", "value"]);
    let mut row = |what: &str, value: String| {
        table.rows.push(vec![Cell::Text(what.to_owned()), Cell::Text(value)]);
    };
    for (what, value) in metrics.summary() {
        row(what, value);
    }
    table
}
