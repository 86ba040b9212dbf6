//! What every study shares: Monte Carlo over seeds, and the statistics of its runs.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};

use nalgebra::{Matrix3, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::Serialize;

use crate::evaluation::{Figure, paired_t_test};

/// A numerical study of one of the papers, or of our own.
#[derive(Debug, Clone, Copy)]
pub struct Study {
    /// As on the command line, such as `wang-4.7`.
    pub name: &'static str,
    pub title: &'static str,
    /// Monte Carlo runs of the full-size study, as in the paper.
    pub runs: usize,
    pub run: fn(&Request) -> Result<Report, StudyError>,
}

/// How a study is to be run.
pub struct Request<'a> {
    pub runs: usize,
    pub seed: u64,
    /// Raised to end early: the report then holds the runs finished until then.
    pub stop: &'a AtomicBool,
    /// Called after each run, from any thread.
    pub finished_run: &'a (dyn Fn() + Sync),
}

#[derive(Debug, thiserror::Error)]
pub enum StudyError {
    #[error("run {run}: {source}")]
    Run { run: usize, source: Box<dyn std::error::Error + Send + Sync> },
    #[error("a study needs at least one run")]
    NoRuns,
    #[error("interrupted before the first run was finished")]
    Interrupted,
    #[error(transparent)]
    MatrixFisher(#[from] super::matrix_fisher::MatrixFisherStudyError),
}

/// One figure of one run.
#[derive(Debug, Clone, PartialEq)]
pub struct Observation {
    /// The paper's label of the case, such as `N=20`.
    pub case: &'static str,
    pub filter: &'static str,
    /// Name with its unit, such as `attitude_deg`.
    pub quantity: &'static str,
    pub value: f64,
}

/// CPU time of one step of a filter in one run.
#[derive(Debug, Clone, PartialEq)]
pub struct StepTime {
    pub case: &'static str,
    pub filter: &'static str,
    pub nanoseconds: f64,
}

/// Everything one run measured; every run of a study lists the same observations in the same
/// order.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Trial {
    pub observations: Vec<Observation>,
    pub step_times: Vec<StepTime>,
}

/// A figure printed in a paper: the mean over its runs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PaperValue {
    pub case: &'static str,
    pub filter: &'static str,
    pub quantity: &'static str,
    pub mean: f64,
}

/// A line of a study's table.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    pub case: String,
    pub filter: String,
    pub quantity: String,
    /// Over the runs, of each run's average over time.
    pub mean: f64,
    /// Sample standard deviation over the runs; 0 for a single run.
    pub sd: f64,
    /// The paper's mean; `None` where it has none.
    pub paper: Option<f64>,
    /// Two-sided p-value of the paired t-test against each other filter of the case; absent where
    /// the runs do not differ.
    pub p_vs: BTreeMap<String, f64>,
    /// CPU time of one step, ns; `None` where it was not measured.
    pub step_time_ns: Option<f64>,
}

impl Row {
    /// A number without statistics.
    pub fn of_value(case: &str, filter: &str, quantity: &str, value: f64) -> Self {
        Self {
            case: case.to_owned(),
            filter: filter.to_owned(),
            quantity: quantity.to_owned(),
            mean: value,
            sd: 0.0,
            paper: None,
            p_vs: BTreeMap::new(),
            step_time_ns: None,
        }
    }
}

/// The result of a study.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    pub name: String,
    /// Finished runs.
    pub runs: usize,
    pub seed: u64,
    pub rows: Vec<Row>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub figures: Vec<Figure>,
    /// What a reader must know beside the numbers.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub notes: Vec<String>,
}

/// Runs `trial` for each run on the threads of the current pool.
///
/// Run `i` draws from stream `i` of the seed, so that the result does not depend on the number of
/// threads and a longer study begins with the runs of a shorter one.
pub fn monte_carlo<E>(
    request: &Request,
    trial: impl Fn(&mut ChaCha8Rng) -> Result<Trial, E> + Sync,
) -> Result<Vec<Trial>, StudyError>
where
    E: Into<Box<dyn std::error::Error + Send + Sync>>,
{
    if request.runs == 0 {
        return Err(StudyError::NoRuns);
    }
    let one = |run: usize| {
        if request.stop.load(Ordering::Relaxed) {
            return Ok(None);
        }
        let mut rng = ChaCha8Rng::seed_from_u64(request.seed);
        rng.set_stream(run as u64);
        let trial = trial(&mut rng).map_err(|e| StudyError::Run { run, source: e.into() })?;
        (request.finished_run)();
        Ok(Some(trial))
    };
    let trials: Vec<Option<Trial>> =
        (0..request.runs).into_par_iter().map(one).collect::<Result<_, StudyError>>()?;
    let trials: Vec<Trial> = trials.into_iter().flatten().collect();
    if trials.is_empty() { Err(StudyError::Interrupted) } else { Ok(trials) }
}

impl Report {
    /// The table of `trials`, beside the values of the paper.
    pub fn of(name: &str, seed: u64, trials: &[Trial], paper: &[PaperValue]) -> Self {
        let rows = trials.first().map_or_else(Vec::new, |first| {
            (0..first.observations.len()).map(|index| row(trials, index, paper)).collect()
        });
        let name = name.to_owned();
        Self { name, runs: trials.len(), seed, rows, figures: Vec::new(), notes: Vec::new() }
    }

    /// The first row of that kind.
    pub fn row(&self, case: &str, filter: &str, quantity: &str) -> Option<&Row> {
        let key = (case, filter, quantity);
        self.rows.iter().find(|row| (&*row.case, &*row.filter, &*row.quantity) == key)
    }
}

fn row(trials: &[Trial], index: usize, paper: &[PaperValue]) -> Row {
    let observations = &trials[0].observations;
    let Observation { case, filter, quantity, .. } = observations[index];
    let values = |index: usize| trials.iter().map(move |trial| trial.observations[index].value);
    let (mean, sd) = mean_and_deviation(values(index));
    let rivals = observations.iter().enumerate().filter(|(other, observation)| {
        *other != index && observation.case == case && observation.quantity == quantity
    });
    let p_vs = rivals.filter_map(|(other, observation)| {
        let differences: Vec<f64> = values(index).zip(values(other)).map(|(a, b)| a - b).collect();
        Some((observation.filter.to_owned(), paired_t_test(&differences)?))
    });
    let times = trials.iter().flat_map(|trial| &trial.step_times);
    let mut times = times.filter(|t| t.case == case && t.filter == filter).peekable();
    let printed = paper
        .iter()
        .find(|value| (value.case, value.filter, value.quantity) == (case, filter, quantity));
    Row {
        case: case.to_owned(),
        filter: filter.to_owned(),
        quantity: quantity.to_owned(),
        mean,
        sd,
        paper: printed.map(|value| value.mean),
        p_vs: p_vs.collect(),
        step_time_ns: times
            .peek()
            .is_some()
            .then(|| mean_and_deviation(times.map(|time| time.nanoseconds)).0),
    }
}

/// NEES of a 3-vector; infinite if the covariance is not positive definite.
pub(super) fn normalized_square(error: &Vector3<f64>, covariance: &Matrix3<f64>) -> f64 {
    covariance.cholesky().map_or(f64::INFINITY, |factor| error.dot(&factor.solve(error)))
}

fn mean_and_deviation(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let values: Vec<f64> = values.collect();
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let sum_of_squares: f64 = values.iter().map(|x| (x - mean).powi(2)).sum();
    (mean, (sum_of_squares / (n - 1.0).max(1.0)).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::Rng;
    use std::convert::Infallible;

    fn trial(rng: &mut ChaCha8Rng) -> Result<Trial, Infallible> {
        let observation =
            |filter, value| Observation { case: "small", filter, quantity: "attitude_deg", value };
        let error: f64 = rng.random();
        let mut trial = Trial::default();
        trial.observations.push(observation("mekf", error + 0.1 + 0.01 * rng.random::<f64>()));
        trial.observations.push(observation("mfgi", error));
        Ok(trial)
    }

    fn run(threads: usize, runs: usize) -> Vec<Trial> {
        let stop = AtomicBool::new(false);
        let request = Request { runs, seed: 3, stop: &stop, finished_run: &|| () };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| monte_carlo(&request, trial)).unwrap()
    }

    #[test]
    fn runs_do_not_depend_on_threads_nor_on_their_number() {
        let long = run(1, 40);
        assert_eq!(long, run(3, 40));
        assert_eq!(long[..7], run(2, 7));
    }

    #[test]
    fn a_small_steady_difference_is_significant_in_pairs() {
        let paper =
            [PaperValue { case: "small", filter: "mfgi", quantity: "attitude_deg", mean: 0.5 }];
        let report = Report::of("test", 3, &run(2, 40), &paper);
        let [mekf, mfgi] = &report.rows[..] else { panic!("two rows") };
        assert!(mekf.mean > mfgi.mean && mekf.sd > 0.1);
        assert!(mekf.p_vs["mfgi"] < 1e-6 && mfgi.p_vs["mekf"] < 1e-6);
        assert_eq!((mekf.paper, mfgi.paper), (None, Some(0.5)));
    }

    #[test]
    fn an_interrupted_study_keeps_what_is_finished() {
        let stop = AtomicBool::new(false);
        let finished = std::sync::atomic::AtomicUsize::new(0);
        let after_third = || {
            if finished.fetch_add(1, Ordering::Relaxed) == 2 {
                stop.store(true, Ordering::Relaxed);
            }
        };
        let request = Request { runs: 10, seed: 3, stop: &stop, finished_run: &after_third };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        assert_eq!(pool.install(|| monte_carlo(&request, trial)).unwrap().len(), 3);
        stop.store(true, Ordering::Relaxed);
        assert!(matches!(monte_carlo(&request, trial), Err(StudyError::Interrupted)));
    }
}
