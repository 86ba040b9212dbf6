//! Attitude filters on the papers' scenes: W22 tables 4.2, 4.6, 4.7, 4.8, FNF tables II to V,
//! L-AMF table II and L-UAE cases I and II.
//!
//! A [`Scene`] is the truth and what the sensors said, drawn once; every filter of a case runs on
//! the same one. Of each filter its consistency is reported beside its errors: `nees_...` of the
//! belief, and `nis` of the measurements against what the filter predicts of them, both taken at
//! [`CONSISTENCY_INSTANTS`] instants of the second half and scaled to three degrees of freedom.

mod consistency;
mod fnf;
mod lee;
mod magnetometer;
mod orbit;
mod scene;
mod wang;

use cpu_time::ThreadTime;
use nalgebra::{Rotation3, Vector3};

use super::{Observation, StepTime, Study, Trial};
use crate::filter::attitude::{AttitudeFilterKind, AttitudePrior, GyroModel, wahba};
use crate::filter::{BayesFilter, FilterError, Frame};
use crate::so3::log;
use consistency::{normalized, normalized_innovation};
use scene::{Measured, Modelled, Scene};

/// The studies of this module, in the order of the list.
pub const STUDIES: [&[Study]; 4] =
    [wang::STUDIES, magnetometer::STUDIES, fnf::STUDIES, lee::STUDIES];

/// Instants of the second half of a run at which normalised errors and innovations are taken.
const CONSISTENCY_INSTANTS: usize = 50;

type AnyError = Box<dyn std::error::Error + Send + Sync>;

/// A filter that could not take a step.
#[derive(Debug, thiserror::Error)]
#[error("{filter}, case {case}, step {step}: {source}")]
struct CaseError {
    filter: &'static str,
    case: &'static str,
    step: usize,
    source: FilterError,
}

/// What is reported of each filter.
#[derive(Debug, Clone, Copy, Default)]
struct Quantities<'a> {
    /// The direction of which only the error counts: known in this frame, after each step or,
    /// where it is fixed, once.
    partial: Option<(Frame, &'a [Vector3<f64>])>,
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
    quantities: Quantities<'a>,
}

impl Case<'_> {
    /// Runs each kind over the scene and appends its figures to the trial.
    fn run(&self, trial: &mut Trial, kinds: &[AttitudeFilterKind]) -> Result<(), AnyError> {
        kinds.iter().try_for_each(|&kind| self.run_as(trial, kind, kind.name()))
    }

    /// The same for one kind under another name.
    fn run_as(
        &self,
        trial: &mut Trial,
        kind: AttitudeFilterKind,
        filter: &'static str,
    ) -> Result<(), AnyError> {
        let Case { label: case, ref gyro, ref prior, scene, quantities } = *self;
        let mut running = kind.start(gyro, prior)?;
        let log = follow(running.as_mut(), scene).map_err(|(step, source)| CaseError {
            filter,
            case,
            step,
            source,
        })?;
        let mut push = |quantity, value| {
            trial.observations.push(Observation { case, filter, quantity, value });
        };
        let counted = || scene.truth.iter().zip(&log.attitudes).skip(quantities.settling);
        push(
            "attitude_deg",
            mean(counted().map(|(truth, found)| angle(truth, found).to_degrees())),
        );
        if let Some((frame, directions)) = quantities.partial {
            let seen = |r: &Rotation3<f64>, direction: &Vector3<f64>| match frame {
                Frame::World => r.inverse() * direction,
                Frame::Body => r * direction,
            };
            let directions = directions.iter().cycle().skip(quantities.settling);
            let errors = counted().zip(directions).map(|((truth, found), direction)| {
                let (a, b) = (seen(truth, direction), seen(found, direction));
                a.cross(&b).norm().atan2(a.dot(&b)).to_degrees()
            });
            push("partial_attitude_deg", mean(errors));
        }
        if quantities.bias && kind.has_bias() {
            let errors =
                scene.bias.iter().zip(&log.biases).map(|(a, b)| (a - b).norm().to_degrees());
            push("gyro_bias_deg_s", mean(errors));
        }
        push("nis", mean(log.nis.iter().copied()));
        push("nees_attitude", mean(log.attitude_nees.iter().copied()));
        if quantities.bias && kind.has_bias() {
            push("nees_gyro_bias", mean(log.bias_nees.iter().copied()));
        }
        let nanoseconds = log.seconds * 1e9 / log.timed_steps as f64;
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
#[derive(Debug, Default)]
struct Log {
    /// After each step; so are the biases, rad/s.
    attitudes: Vec<Rotation3<f64>>,
    biases: Vec<Vector3<f64>>,
    attitude_nees: Vec<f64>,
    bias_nees: Vec<f64>,
    nis: Vec<f64>,
    /// CPU time of propagation, update and the estimate of the timed steps, s.
    seconds: f64,
    timed_steps: usize,
}

/// Steps between two readings of the clock, which itself takes time.
const TIMED_BLOCK: usize = 64;

/// Runs a filter over a scene; an error comes with the number of the step.
fn follow(filter: &mut dyn BayesFilter, scene: &Scene) -> Result<Log, (usize, FilterError)> {
    let count = scene.steps.len();
    // Written to before the clock runs, or the first filter would pay for its pages.
    let mut log = Log {
        attitudes: vec![Rotation3::identity(); count],
        biases: vec![Vector3::zeros(); count],
        ..Log::default()
    };
    let interval = (count / 2 / CONSISTENCY_INSTANTS).max(TIMED_BLOCK);
    let mut k = 0;
    while k < count {
        let (start, clock) = (k, ThreadTime::now());
        while k < count.min(start + TIMED_BLOCK) {
            log.advance(filter, scene, k, |_| ()).map_err(|error| (k, error))?;
            k += 1;
        }
        log.seconds += clock.elapsed().as_secs_f64();
        log.timed_steps += k - start;
        if 2 * k > count && k / interval > start / interval {
            log.record_errors(filter, &scene.truth[k - 1], &scene.bias[k - 1]);
            let mut nis = None;
            while k < count && nis.is_none() {
                let observe = |filter: &dyn BayesFilter| {
                    nis = scene.measured[k].as_ref().map(|measured| {
                        let measured = measured.of(filter.is_gaussian());
                        normalized_innovation(&filter.estimate(), measured)
                    });
                };
                log.advance(filter, scene, k, observe).map_err(|error| (k, error))?;
                k += 1;
            }
            log.nis.extend(nis.flatten());
        }
    }
    Ok(log)
}

impl Log {
    /// Step `k` of the scene; `before_update` sees the filter between propagation and update.
    fn advance(
        &mut self,
        filter: &mut dyn BayesFilter,
        scene: &Scene,
        k: usize,
        before_update: impl FnOnce(&dyn BayesFilter),
    ) -> Result<(), FilterError> {
        filter.propagate(&scene.steps[k])?;
        before_update(&*filter);
        match scene.measured[k].as_ref().map(|measured| measured.of(filter.is_gaussian())) {
            Some(Modelled::Directions(vectors)) => filter.update_directions(vectors)?,
            Some(Modelled::Attitude(attitude)) => filter.update_attitude(attitude)?,
            None => {}
        }
        self.attitudes[k] = filter.attitude();
        self.biases[k] = filter.gyro_bias().unwrap_or_default();
        Ok(())
    }

    fn record_errors(
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
        report.row(case, filter, quantity).unwrap()
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
        let error = |case, quantity| row(&report, case, "bf-mfd", quantity).mean;
        let observable = ["AVI_RVI", "AVB_RVB"].map(|case| error(case, "attitude_deg"));
        assert!(observable.iter().all(|error| *error < 10.0), "{observable:?}");
        for case in ["AVI_RVB", "AVB_RVI"] {
            // About the direction any attitude is a mode, so that this error is as arbitrary as
            // the one that is named.
            assert!(error(case, "attitude_deg") > 20.0, "{case}");
            assert!(error(case, "partial_attitude_deg") < 5.0, "{case}");
        }
    }
}
