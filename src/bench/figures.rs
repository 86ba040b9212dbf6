//! Rows of results: the runs of a sequence with one filter and setting, over their seeds.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::dataset::Dataset;
use super::plan::PlannedRun;
use super::published::of_sequence;
use super::record::{Outcome, RunRecord};

/// Mean NEES of a run, 3 for a consistent estimate of three components; `null` where the truth
/// does not tell.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct NeesMeans {
    pub attitude: Option<f64>,
    pub position: Option<f64>,
    pub velocity: Option<f64>,
    /// Share of the joint errors of attitude and position inside their 95 % band.
    pub inside_95: Option<f64>,
}

/// Values over seeds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    pub median: f64,
    pub min: f64,
    pub max: f64,
}

/// The results of one sequence, filter and setting.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    pub sequence: String,
    pub filter: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub init: Option<String>,
    /// The settings that a sweep varies.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub settings: BTreeMap<String, String>,
    pub seeds: usize,
    /// Seeds whose run gave no error figures, and why the first one did not.
    pub failures: usize,
    pub failure: Option<String>,
    /// Mean over seeds of the share of the truth's duration with an estimate; a failed run has 0.
    pub coverage: f64,
    /// Position RMSE, m.
    pub ape_m: Option<Spread>,
    /// Attitude RMSE, degrees.
    pub attitude_deg: Option<Spread>,
    /// Position RMSE of the motion over 1 s, m.
    pub rpe_1s_m: Option<Spread>,
    /// Means over seeds.
    pub nees: NeesMeans,
    /// Median over seeds; the only figure that differs from run to run.
    pub cpu_ms_per_frame: Option<f64>,
    /// Sum over seeds.
    pub false_alarms: u64,
    /// What was warned of in any seed.
    pub faults: Vec<String>,
    /// Injected faults that a seed did not name.
    pub faults_missed: Vec<String>,
    /// Position RMSE of other estimators, m.
    pub published: BTreeMap<String, f64>,
}

impl Spread {
    /// `None` where there are no values.
    pub fn of(values: impl Iterator<Item = f64>) -> Option<Self> {
        let mut sorted: Vec<f64> = values.collect();
        sorted.sort_unstable_by(f64::total_cmp);
        let (min, max) = (*sorted.first()?, *sorted.last()?);
        let middle = sorted.len() / 2;
        let median = match sorted.len() % 2 {
            0 => 0.5 * (sorted[middle - 1] + sorted[middle]),
            _ => sorted[middle],
        };
        Some(Self { median, min, max })
    }
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, count) = values.fold((0.0, 0_usize), |(sum, n), value| (sum + value, n + 1));
    (count > 0).then(|| sum / count as f64)
}

/// One row for each run of neighbours that differ by their seed only.
pub fn rows(dataset: Dataset, runs: &[(PlannedRun, RunRecord)]) -> Vec<Row> {
    runs.chunk_by(|(a, _), (b, _)| a.is_seed_of(b)).filter_map(|runs| row(dataset, runs)).collect()
}

fn row(dataset: Dataset, runs: &[(PlannedRun, RunRecord)]) -> Option<Row> {
    let (first, _) = runs.first()?;
    let outcomes = || runs.iter().map(|(_, record)| &record.outcome);
    let spread = |value: &dyn Fn(&Outcome) -> Option<f64>| Spread::of(outcomes().filter_map(value));
    let nees = |value: &dyn Fn(&NeesMeans) -> Option<f64>| {
        mean(outcomes().filter_map(|outcome| value(outcome.nees.as_ref()?)))
    };
    let distinct = |texts: &dyn Fn(&Outcome) -> &Vec<String>| {
        let mut all: Vec<String> = outcomes().flat_map(|o| texts(o).iter().cloned()).collect();
        all.sort();
        all.dedup();
        all
    };
    let failed = |outcome: &&Outcome| outcome.ape_m.is_none() && outcome.attitude_deg.is_none();
    Some(Row {
        sequence: first.sequence.name.clone(),
        filter: first.filter.clone(),
        init: first.init.map(|mode| mode.name().to_owned()),
        settings: first.swept.iter().cloned().collect(),
        seeds: runs.len(),
        failures: outcomes().filter(failed).count(),
        failure: outcomes().filter(failed).find_map(|outcome| outcome.failure.clone()),
        coverage: mean(outcomes().map(|outcome| outcome.coverage)).unwrap_or(0.0),
        ape_m: spread(&|outcome| outcome.ape_m),
        attitude_deg: spread(&|outcome| outcome.attitude_deg),
        rpe_1s_m: spread(&|outcome| outcome.rpe_1s_m),
        nees: NeesMeans {
            attitude: nees(&|nees| nees.attitude),
            position: nees(&|nees| nees.position),
            velocity: nees(&|nees| nees.velocity),
            inside_95: nees(&|nees| nees.inside_95),
        },
        cpu_ms_per_frame: Spread::of(
            runs.iter().filter_map(|(_, record)| record.times.cpu_ms_per_frame),
        )
        .map(|spread| spread.median),
        false_alarms: outcomes().map(|outcome| outcome.false_alarms).sum(),
        faults: distinct(&|outcome| &outcome.faults),
        faults_missed: distinct(&|outcome| &outcome.faults_missed),
        published: of_sequence(dataset, &first.sequence.name),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_spread_has_the_median_of_an_even_number() {
        let spread = Spread::of([4.0, 1.0, 3.0, 2.0].into_iter()).unwrap();
        assert_eq!(spread, Spread { median: 2.5, min: 1.0, max: 4.0 });
        assert_eq!(Spread::of(std::iter::empty()), None);
    }
}
