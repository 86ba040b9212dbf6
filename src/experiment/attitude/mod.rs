//! Attitude filters on the papers' scenes: W22 tables 4.2, 4.6, 4.7, FNF tables II to V, L-AMF
//! table II and L-UAE cases I and II.
//!
//! A [`Scene`] is the truth and what the sensors said, drawn once; every filter of a case runs on
//! the same one.

mod fnf;
mod lee;
mod scene;
mod wang;

use cpu_time::ThreadTime;
use nalgebra::{Matrix3, Rotation3, Vector3};

use super::{Observation, StepTime, Study, Trial};
use crate::filter::attitude::{AttitudeFilterKind, AttitudePrior, GyroModel, wahba};
use crate::filter::{BayesFilter, FilterError, Frame};
use crate::so3::log;
use scene::{Measured, Scene};

/// The studies of this module, in the order of the list.
pub const STUDIES: [&[Study]; 3] = [wang::STUDIES, fnf::STUDIES, lee::STUDIES];

/// Instants of the second half of a run at which the normalised error is taken.
const CONSISTENCY_INSTANTS: usize = 50;

/// What is reported of each filter.
#[derive(Debug, Clone, Copy, Default)]
struct Quantities {
    /// The direction of which only the error counts: known in this frame.
    partial: Option<(Frame, Vector3<f64>)>,
    bias: bool,
    /// Steps at the beginning that do not count.
    settling: usize,
}

/// A column of a table: one scene and what all filters know of it.
struct Case<'a> {
    label: &'static str,
    gyro: GyroModel,
    prior: AttitudePrior,
    scene: &'a Scene,
    quantities: Quantities,
}

impl Case<'_> {
    /// Runs each kind over the scene and appends its figures to the trial.
    fn run(&self, trial: &mut Trial, kinds: &[AttitudeFilterKind]) -> Result<(), FilterError> {
        kinds.iter().try_for_each(|&kind| self.run_as(trial, kind, kind.name()))
    }

    /// The same for one kind under another name.
    fn run_as(
        &self,
        trial: &mut Trial,
        kind: AttitudeFilterKind,
        filter: &'static str,
    ) -> Result<(), FilterError> {
        let Case { label: case, ref gyro, ref prior, scene, quantities } = *self;
        let mut running = kind.start(gyro, prior)?;
        let log = follow(running.as_mut(), scene)?;
        let mut push = |quantity, value| {
            trial.observations.push(Observation { case, filter, quantity, value });
        };
        let counted = || scene.truth.iter().zip(&log.attitudes).skip(quantities.settling);
        push(
            "attitude_deg",
            mean(counted().map(|(truth, found)| angle(truth, found).to_degrees())),
        );
        if let Some((frame, direction)) = quantities.partial {
            let seen = |r: &Rotation3<f64>| match frame {
                Frame::World => r.inverse() * direction,
                Frame::Body => r * direction,
            };
            let errors = counted().map(|(truth, found)| {
                let (a, b) = (seen(truth), seen(found));
                a.cross(&b).norm().atan2(a.dot(&b)).to_degrees()
            });
            push("partial_attitude_deg", mean(errors));
        }
        if quantities.bias && kind.has_bias() {
            let errors =
                scene.bias.iter().zip(&log.biases).map(|(a, b)| (a - b).norm().to_degrees());
            push("gyro_bias_deg_s", mean(errors));
        }
        push("nees_attitude", mean(log.attitude_nees.iter().copied()));
        if quantities.bias && kind.has_bias() {
            push("nees_gyro_bias", mean(log.bias_nees.iter().copied()));
        }
        let nanoseconds = log.seconds * 1e9 / scene.steps.len() as f64;
        trial.step_times.push(StepTime { case, filter, nanoseconds });
        Ok(())
    }
}

/// The mean error of attitudes solved from the measurements of one instant each.
fn run_memoryless(trial: &mut Trial, case: &'static str, scene: &Scene) -> Result<(), FilterError> {
    let mut errors = Vec::new();
    for (truth, measured) in scene.truth.iter().zip(&scene.measured) {
        let found = match measured {
            Some(Measured::Directions { fisher, .. }) => wahba(fisher)?,
            Some(Measured::Attitude { fisher, .. }) => fisher.world_from_body,
            None => continue,
        };
        errors.push(angle(truth, &found).to_degrees());
    }
    let value = mean(errors.into_iter());
    let (filter, quantity) = ("wahba", "attitude_deg");
    trial.observations.push(Observation { case, filter, quantity, value });
    Ok(())
}

/// What a filter said on its way through a scene.
struct Log {
    attitudes: Vec<Rotation3<f64>>,
    biases: Vec<Vector3<f64>>,
    attitude_nees: Vec<f64>,
    bias_nees: Vec<f64>,
    /// CPU time of propagation, update and the estimate of each step, s.
    seconds: f64,
}

/// Steps between two readings of the clock, which itself takes time.
const TIMED_BLOCK: usize = 64;

fn follow(filter: &mut dyn BayesFilter, scene: &Scene) -> Result<Log, FilterError> {
    let count = scene.steps.len();
    let mut log = Log {
        attitudes: Vec::with_capacity(count),
        biases: Vec::with_capacity(count),
        attitude_nees: Vec::new(),
        bias_nees: Vec::new(),
        seconds: 0.0,
    };
    let instants = (count / 2 / CONSISTENCY_INSTANTS).max(TIMED_BLOCK);
    let gaussian = filter.is_gaussian();
    for start in (0..count).step_by(TIMED_BLOCK) {
        let clock = ThreadTime::now();
        let end = (start + TIMED_BLOCK).min(count);
        for (step, measured) in scene.steps[start..end].iter().zip(&scene.measured[start..end]) {
            filter.propagate(step)?;
            match measured {
                Some(Measured::Directions { fisher, gaussian: other }) => {
                    filter.update_directions(if gaussian { other } else { fisher })?;
                }
                Some(Measured::Attitude { fisher, gaussian: other }) => {
                    filter.update_attitude(if gaussian { other } else { fisher })?;
                }
                None => {}
            }
            log.attitudes.push(filter.attitude());
            log.biases.push(filter.gyro_bias().unwrap_or_default());
        }
        log.seconds += clock.elapsed().as_secs_f64();
        let due = end / instants > start / instants;
        if end > count / 2 && due {
            let last = end - 1;
            log.record_consistency(filter, &scene.truth[last], &scene.bias[last]);
        }
    }
    Ok(log)
}

impl Log {
    fn record_consistency(
        &mut self,
        filter: &dyn BayesFilter,
        truth: &Rotation3<f64>,
        bias: &Vector3<f64>,
    ) {
        let estimate = filter.estimate();
        let error = log(&(estimate.world_from_body.inverse() * truth));
        self.attitude_nees.extend(normalized(&error, &estimate.rotation_covariance));
        if let Some(found) = estimate.gyro_bias {
            self.bias_nees.extend(normalized(&(found.mean - bias), &found.covariance));
        }
    }
}

/// `e^T P^-1 e`; none where `P` has no inverse.
fn normalized(error: &Vector3<f64>, covariance: &Matrix3<f64>) -> Option<f64> {
    covariance.cholesky().map(|factor| error.dot(&factor.solve(error)))
}

fn angle(a: &Rotation3<f64>, b: &Rotation3<f64>) -> f64 {
    log(&(a.inverse() * b)).norm()
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0usize), |(sum, count), x| (sum + x, count + 1));
    if count > 0 { sum / count as f64 } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use super::super::{Report, Request, Row, find};

    /// A study with few runs.
    fn few(name: &str, runs: usize) -> Report {
        let stop = AtomicBool::new(false);
        let request = Request { runs, seed: 1, stop: &stop, finished_run: &|| () };
        (find(name).unwrap().run)(&request).unwrap()
    }

    fn row<'a>(report: &'a Report, case: &str, filter: &str, quantity: &str) -> &'a Row {
        let key = (case, filter, quantity);
        let found = |row: &&Row| (&*row.case, &*row.filter, &*row.quantity) == key;
        report.rows.iter().find(found).unwrap()
    }

    /// The paper's second line for the matrix Fisher distribution does not follow from its first.
    #[test]
    fn fnf_2_is_the_papers_table_but_for_one_line() {
        let report = few("fnf-2", 1);
        for row in &report.rows {
            let paper = row.paper.unwrap();
            let agrees = (row.mean - paper).abs() < 0.006 * paper.max(1.0);
            assert_eq!(agrees, (&*row.case, &*row.filter) != ("t=2", "matrix-fisher"), "{row:?}");
        }
        let found = |quantity| row(&report, "t=2", "matrix-fisher", quantity).mean;
        let (x, y) = (42.62f64.to_radians().cos(), 42.62f64.to_radians().sin());
        let (x, y) = (120.0 + 14.16 * x, 14.16 * y);
        assert!((found("concentration") - x.hypot(y)).abs() < 0.02);
        assert!((found("mean_angle_deg") - y.atan2(x).to_degrees()).abs() < 0.02);
    }

    #[test]
    fn a_large_initial_error_costs_the_invariant_filter_dearly() {
        let report = few("fnf-4", 1);
        let error = |filter| row(&report, "ii", filter, "attitude_deg").mean;
        assert!(error("fnf-r") < 5.0 && error("bf-mfd") < 5.0);
        assert!(error("iekf") > 2.0 * error("bf-mfd"));
        assert!((error("fnf-r") - error("fnf-l")).abs() < 1e-6);
        let time = row(&report, "ii", "bf-mfd", "attitude_deg").step_time_ns;
        assert!(time.is_some_and(|time| time > 0.0));
    }

    #[test]
    fn observability_is_that_of_table_4_1() {
        let report = few("wang-4.2", 1);
        for case in ["AVI_RVI", "AVB_RVB"] {
            assert!(row(&report, case, "bf-mfd", "attitude_deg").mean < 15.0, "{case}");
        }
        for case in ["AVI_RVB", "AVB_RVI"] {
            assert!(row(&report, case, "bf-mfd", "attitude_deg").mean > 60.0, "{case}");
            assert!(row(&report, case, "bf-mfd", "partial_attitude_deg").mean < 5.0, "{case}");
        }
    }
}
