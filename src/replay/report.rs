//! Tables and figures of one replay.

use super::Replayed;
use crate::evaluation::Report;
use crate::evaluation::{
    ApeResult, Cell, Figure, Table, belief_figure, counts_figure, error_figure, nees_figure,
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
    /// Wall times, s.
    pub times: Vec<StageTimes>,
}

impl Series {
    pub(super) fn push(&mut self, report: &StepReport) {
        self.stamps.push(report.stamp.seconds());
        self.features.push(report.counts.features as f64);
        self.matches.push(report.counts.matches as f64);
        self.inliers.push(report.counts.inliers as f64);
        self.times.push(report.times);
    }

    fn stages(&self) -> Vec<(&'static str, Vec<f64>)> {
        let stage =
            |k: usize, name| (name, self.times.iter().map(|times| times.stages()[k].1).collect());
        let names = StageTimes::default().stages().map(|(name, _)| name);
        names.into_iter().enumerate().map(|(k, name)| stage(k, name)).collect()
    }
}

/// Report of a replay: its figures and the table of results.
pub fn report(replayed: &Replayed) -> Report {
    let metrics = &replayed.metrics;
    Report {
        title: format!("{}, {}", metrics.log, metrics.filter),
        tables: vec![("Result".to_owned(), result_table(replayed))],
        figures: figures(replayed).into_iter().map(|(_, figure)| figure).collect(),
        ..Report::default()
    }
}

/// Names and figures of a replay: of the run and, with a reference, of its error and of how large
/// that was believed to be.
pub fn figures(replayed: &Replayed) -> Vec<(&'static str, Figure)> {
    let mut figures = Vec::new();
    if let Some(evaluated) = &replayed.evaluated {
        let ApeResult { pairs, errors, .. } = &evaluated.translation;
        figures.push(("trajectory", trajectory_figure(pairs, errors, "m")));
        figures.push(("error", error_figure(&pairs.stamps, errors, "m")));
        if let Some(result) = &evaluated.consistency {
            figures.push(("belief", belief_figure(result)));
            figures.push(("nees", nees_figure(result)));
        }
    }
    let series = &replayed.series;
    let counts = [
        ("features", series.features.clone()),
        ("matches", series.matches.clone()),
        ("inliers", series.inliers.clone()),
    ];
    figures.push(("features", counts_figure(&series.stamps, &counts)));
    figures.push(("timing", stage_times_figure(&series.stages())));
    figures
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
