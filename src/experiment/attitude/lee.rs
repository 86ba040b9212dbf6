//! L-AMF table II, L-UAE cases I and II.

use std::f64::consts::PI;

use nalgebra::{Matrix3, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_distr::Distribution;

use super::super::{PaperValue, Report, Request, Study, StudyError, Trial, monte_carlo};
use super::scene::{GyroNoise, Measured, Sampling, diagonal, pendulum, simulate};
use super::{AnyError, Case, Quantities, run_memoryless};
use crate::distribution::matrix_fisher::MatrixFisher;
use crate::filter::attitude::{AttitudeFilterKind, AttitudePrior, GyroModel};
use crate::filter::{AttitudeMeasurement, Frame};
use crate::so3::exp;

pub(super) const STUDIES: &[Study] = &[
    Study {
        name: "lee-amf-2",
        title: "L-AMF table II: Newton's iteration against approximate solutions",
        runs: 50,
        run: table_2,
    },
    Study {
        name: "lee-uae-1",
        title: "L-UAE case I: confident of an attitude that is 180 degrees wrong",
        runs: 50,
        run: case_1,
    },
    Study {
        name: "lee-uae-2",
        title: "L-UAE case II: large initial uncertainty",
        runs: 50,
        run: case_2,
    },
];

const INTERVAL: f64 = 0.02;
const EVERY: usize = 5;
const CASE: &str = "s=40,50,35";

/// A pendulum with an attitude sensor at 10 Hz.
struct Pendulum {
    /// Gyroscope white noise, rad/sqrt(s), and what the filters take it for.
    white: Vector3<f64>,
    modelled: Vector3<f64>,
    /// Intervals.
    steps: usize,
    prior: Matrix3<f64>,
    /// Steps that do not count.
    settling: usize,
    kinds: &'static [AttitudeFilterKind],
}

impl Pendulum {
    fn run(
        &self,
        name: &str,
        request: &Request,
        paper: &[PaperValue],
    ) -> Result<Report, StudyError> {
        let motion = pendulum(INTERVAL, self.steps, Sampling::Mean);
        let noise = diagonal([40.0, 50.0, 35.0]);
        let trial = |rng: &mut ChaCha8Rng| -> Result<Trial, AnyError> {
            let sampler = MatrixFisher::new(&noise)?.sampler();
            let white =
                GyroNoise { white: self.white, bias_walk: 0.0, initial_bias: Vector3::zeros() };
            let scene = simulate(&motion, &white, EVERY, rng, |_, truth, rng| {
                let world_from_body = truth * sampler.sample(rng);
                Measured::attitude(AttitudeMeasurement { world_from_body, noise })
            });
            let gyro = GyroModel {
                frame: Frame::Body,
                noise: Matrix3::from_diagonal(&self.modelled.map(|sd| sd * sd)),
                bias_walk: Matrix3::zeros(),
            };
            let prior = AttitudePrior::matrix_fisher(&self.prior)?;
            let quantities = Quantities { settling: self.settling, ..Quantities::default() };
            let mut trial = Trial::default();
            let case = Case { label: CASE, gyro, prior, scene: &scene, quantities };
            case.run(&mut trial, self.kinds)?;
            run_memoryless(&mut trial, CASE, &scene)?;
            Ok(trial)
        };
        let trials = monte_carlo(request, trial)?;
        Ok(Report::of(name, request.seed, &trials, paper))
    }
}

const fn error(filter: &'static str, mean: f64) -> PaperValue {
    PaperValue { case: CASE, filter, quantity: "attitude_deg", mean }
}

/// Diagonal of `H` of L-AMF: the noise of the gyroscope is `H dW`.
const H: Vector3<f64> = Vector3::new(1.8, 1.6, 2.4);

fn table_2(request: &Request) -> Result<Report, StudyError> {
    use AttitudeFilterKind::{BfAmfd, BfMfd, FnfR, Iekf};
    let pendulum = Pendulum {
        white: H * INTERVAL,
        modelled: H * INTERVAL.sqrt(),
        steps: 3000,
        prior: Matrix3::zeros(),
        settling: 0,
        kinds: &[BfMfd, BfAmfd, FnfR, Iekf],
    };
    let paper = [error("bf-mfd", 6.48), error("bf-amfd", 6.51), error("wahba", 10.45)];
    let mut report = pendulum.run("lee-amf-2", request, &paper)?;
    report.notes.push(
        "The paper's mean error of the angular velocity, 0.45 rad/s, is that of readings with the \
         deviations H sqrt(h), as if H dW were a rate; its attitude error is that of filters that \
         take H sqrt(h) for the density of the noise, seven times too much. With a density of H \
         degrees, rightly modelled, bf-mfd has 3.36 deg."
            .into(),
    );
    Ok(report)
}

/// Deviations of each reading of L-UAE, rad/s, at 50 Hz.
const READING_SD: [f64; 3] = [0.5, 0.8, 1.0];

fn unscented(prior: Matrix3<f64>, settling: usize) -> Pendulum {
    use AttitudeFilterKind::{BfMfd, FnfR, Iekf, Uae};
    let white = Vector3::from(READING_SD) * INTERVAL.sqrt();
    Pendulum {
        white,
        modelled: white,
        steps: 3000,
        prior,
        settling,
        kinds: &[Uae, BfMfd, FnfR, Iekf],
    }
}

fn case_1(request: &Request) -> Result<Report, StudyError> {
    let prior = 100.0 * exp(&Vector3::new(PI, 0.0, 0.0)).matrix();
    // The paper averages from the third measurement on.
    let paper = [error("uae", 5.6), error("wahba", 10.46)];
    unscented(prior, 3 * EVERY).run("lee-uae-1", request, &paper)
}

fn case_2(request: &Request) -> Result<Report, StudyError> {
    let turn = exp(&Vector3::new(0.5 * PI, 0.0, 0.0));
    let prior = diagonal([2.0, 1.0, 0.5]) * turn.matrix();
    unscented(prior, 0).run("lee-uae-2", request, &[error("wahba", 10.46)])
}
