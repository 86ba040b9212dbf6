//! Truth, gyroscope and measurements of the attitude studies.

use nalgebra::{Matrix3, Rotation3, Vector3};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::filter::{AttitudeMeasurement, InertialStep, VectorMeasurement};
use crate::so3::{exp, log};

/// What is measured at one instant, as the matrix Fisher filters and as the Gaussian filters
/// model it: concentrations and covariances matched to the same noise.
#[derive(Debug, Clone)]
pub(super) enum Measured {
    Directions { fisher: Vec<VectorMeasurement>, gaussian: Vec<VectorMeasurement> },
    Attitude { fisher: Box<AttitudeMeasurement>, gaussian: Box<AttitudeMeasurement> },
}

impl Measured {
    /// Directions that both model alike.
    pub fn directions(vectors: Vec<VectorMeasurement>) -> Self {
        Self::Directions { gaussian: vectors.clone(), fisher: vectors }
    }

    /// An attitude that both model alike.
    pub fn attitude(measured: AttitudeMeasurement) -> Self {
        Self::Attitude { fisher: Box::new(measured), gaussian: Box::new(measured) }
    }

    /// The measurement as the filters of one kind model it.
    pub fn of(&self, is_gaussian: bool) -> Modelled<'_> {
        match self {
            Self::Directions { gaussian, .. } if is_gaussian => Modelled::Directions(gaussian),
            Self::Directions { fisher, .. } => Modelled::Directions(fisher),
            Self::Attitude { gaussian, .. } if is_gaussian => Modelled::Attitude(gaussian),
            Self::Attitude { fisher, .. } => Modelled::Attitude(fisher),
        }
    }
}

/// A measurement with one model of its noise.
#[derive(Debug, Clone, Copy)]
pub(super) enum Modelled<'a> {
    Directions(&'a [VectorMeasurement]),
    Attitude(&'a AttitudeMeasurement),
}

/// One run: interval `k` leads to `truth[k]` and ends in `measured[k]`.
#[derive(Debug, Clone, Default)]
pub(super) struct Scene {
    pub truth: Vec<Rotation3<f64>>,
    /// rad/s.
    pub bias: Vec<Vector3<f64>>,
    pub steps: Vec<InertialStep>,
    pub measured: Vec<Option<Measured>>,
}

/// A motion known at equal intervals.
#[derive(Debug, Clone)]
pub(super) struct Motion {
    /// Interval, s.
    pub interval: f64,
    /// At the start and after each interval.
    pub attitudes: Vec<Rotation3<f64>>,
    /// What an ideal gyroscope reads in each interval, rad/s, body frame.
    pub rates: Vec<Vector3<f64>>,
}

/// When a gyroscope reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Sampling {
    /// It integrates over the interval.
    Mean,
    /// It samples the angular velocity at the end of the interval.
    End,
}

impl Motion {
    /// The motion `attitude(t)`; the gyroscope integrates over each interval.
    pub fn of(interval: f64, count: usize, attitude: impl Fn(f64) -> Rotation3<f64>) -> Self {
        let attitudes: Vec<_> = (0..=count).map(|k| attitude(k as f64 * interval)).collect();
        let rates = mean_rates(&attitudes, interval);
        Self { interval, attitudes, rates }
    }
}

/// The constant rate that leads from each attitude to the next.
fn mean_rates(attitudes: &[Rotation3<f64>], interval: f64) -> Vec<Vector3<f64>> {
    let turns = attitudes.windows(2).map(|pair| log(&(pair[0].inverse() * pair[1])));
    turns.map(|turn| turn / interval).collect()
}

/// The noise of a gyroscope, rad/sqrt(s) about each axis and rad/s/sqrt(s).
#[derive(Debug, Clone, Copy)]
pub(super) struct GyroNoise {
    pub white: Vector3<f64>,
    pub bias_walk: f64,
    pub initial_bias: Vector3<f64>,
}

/// Drives a gyroscope along `motion`; after every `every` intervals `measure` gets the number of
/// the interval, counted from zero, and the attitude at its end.
pub(super) fn simulate<R: Rng>(
    motion: &Motion,
    noise: &GyroNoise,
    every: usize,
    rng: &mut R,
    mut measure: impl FnMut(usize, &Rotation3<f64>, &mut R) -> Measured,
) -> Scene {
    let h = motion.interval;
    let mut scene = Scene::default();
    let mut bias = noise.initial_bias;
    for (k, (rate, truth)) in motion.rates.iter().zip(&motion.attitudes[1..]).enumerate() {
        let white = noise.white.component_mul(&normal(rng)) / h.sqrt();
        scene.steps.push(InertialStep::turning(rate + bias + white, h));
        bias += normal(rng) * (noise.bias_walk * h.sqrt());
        scene.truth.push(*truth);
        scene.bias.push(bias);
        scene.measured.push(((k + 1) % every == 0).then(|| measure(k, truth, rng)));
    }
    scene
}

/// Three standard normal numbers.
pub(super) fn normal<R: Rng>(rng: &mut R) -> Vector3<f64> {
    Vector3::from_fn(|_, _| Distribution::<f64>::sample(&StandardNormal, rng))
}

/// The 3D pendulum of Lee, Chaturvedi, Sanyal, Leok and McClamroch (2007), the motion of L-UAE,
/// L-AMF and FNF: an elliptic cylinder of 1 kg that hangs from a pivot 0.3 m off its centre.
pub(super) fn pendulum(interval: f64, count: usize, sampling: Sampling) -> Motion {
    const INERTIA: [f64; 3] = [0.13, 0.28, 0.17];
    const MASS: f64 = 1.0;
    const ARM: f64 = 0.3;
    const GRAVITY: f64 = 9.81;
    let torque = |r: &Rotation3<f64>| {
        let gravity = r.inverse() * Vector3::z() * (MASS * GRAVITY);
        (Vector3::z() * ARM).cross(&gravity)
    };
    rigid_body(INERTIA, torque, Vector3::repeat(4.14), interval, count, sampling)
}

/// A rigid body with these principal moments of inertia, kg m^2, under a torque in the body frame,
/// N m, that depends on its attitude; it starts at the identity with the angular velocity `rate`,
/// rad/s, in the body frame.
pub(super) fn rigid_body(
    inertia: [f64; 3],
    torque: impl Fn(&Rotation3<f64>) -> Vector3<f64>,
    rate: Vector3<f64>,
    interval: f64,
    count: usize,
    sampling: Sampling,
) -> Motion {
    /// Integration steps in each interval.
    const SUBSTEPS: usize = 20;
    let inertia = Vector3::from(inertia);
    let acceleration = |r: &Rotation3<f64>, w: &Vector3<f64>| {
        (torque(r) - w.cross(&inertia.component_mul(w))).component_div(&inertia)
    };
    let (mut r, mut w) = (Rotation3::identity(), rate);
    let h = interval / SUBSTEPS as f64;
    let (mut attitudes, mut samples) = (vec![r], Vec::new());
    for _ in 0..count {
        for _ in 0..SUBSTEPS {
            // The midpoint rule on the group: of second order, 1e-7 rad a step.
            let middle = r * exp(&(w * (0.5 * h)));
            let w_middle = w + acceleration(&r, &w) * (0.5 * h);
            let next = w + acceleration(&middle, &w_middle) * h;
            r *= exp(&(w_middle * h));
            w = next;
        }
        attitudes.push(r);
        samples.push(w);
    }
    let rates = match sampling {
        Sampling::Mean => mean_rates(&attitudes, interval),
        Sampling::End => samples,
    };
    Motion { interval, attitudes, rates }
}

/// The Euler angles (3-2-1) of W22 4.2.4: sinusoids at 0.35 Hz with amplitudes pi, pi/2 and pi.
pub(super) fn tumbling(interval: f64, count: usize) -> Motion {
    use std::f64::consts::{FRAC_PI_2, PI, TAU};
    Motion::of(interval, count, |t| {
        let phase = (TAU * 0.35 * t).sin();
        let about = |axis: usize, angle: f64| exp(&Vector3::ith(axis, angle * phase));
        about(2, PI) * about(1, FRAC_PI_2) * about(0, PI)
    })
}

/// `diag(v)`.
pub(super) fn diagonal(v: [f64; 3]) -> Matrix3<f64> {
    Matrix3::from_diagonal(&Vector3::from(v))
}
