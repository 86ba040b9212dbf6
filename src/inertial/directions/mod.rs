//! Up and north as directions in the body frame, from an accelerometer that also feels the motion
//! and a magnetometer that also feels iron, each with a concentration that follows the evidence.
//!
//! Both sensors are read in a frame that the gyroscope alone carries along, which is inertial but
//! for the gyroscope's slow drift. There gravity and the earth's field stand still, so that what
//! moves is disturbance:
//!
//! - **Specific force** ([`gravity`]). The acceleration of a body that stays in its place averages
//!   out; two low-passes in series let through `1/(1 + w^2 T^2)` of a motion at the frequency `w`.
//!   What is left of it is measured against the attitude that the filter expects, and lowers the
//!   concentration.
//! - **Magnetic field** ([`magnetic`]). `m = R^T field + iron + delay R^T-rate`: a Kalman filter
//!   tells the field, which stands still, from the iron of the device, which turns with the body,
//!   and from the delay of the magnetometer. A reading far from what it expects means that iron
//!   has come or gone; the iron is then unknown until the body's turning reveals it anew.
//! - **Rest** ([`rest`]). A gyroscope that stands still shows its bias.
//!
//! The bias that is taken off the gyroscope is that of the filter behind the directions
//! ([`Prediction`]): whenever it changes, what the low-passes hold is turned as if it had been known
//! before.
//!
//! What disturbs is correlated in time: samples closer together than the correlation time `T` say
//! the same thing again. A Gauss-Markov error carries one independent sample every `2 T`, so a
//! measurement every `h` seconds is given `h/(2 T)` of the concentration that it would deserve
//! alone, and the first one all of it.

mod gravity;
mod magnetic;
mod rest;

use nalgebra::{Matrix3, Rotation3, Vector3};
use serde::{Deserialize, Serialize};

pub use gravity::GravityConfig;
pub use magnetic::MagneticConfig;
pub use rest::RestConfig;

use crate::sensor::ImuSample;
use crate::so3;
use gravity::GravityFinder;
use magnetic::MagneticFinder;
use rest::RestFinder;

/// Time between two measurements, over which the readings are averaged, s.
const INTERVAL: f64 = 0.1;

/// How directions are found. The defaults are for sensors of consumer grade in hand-held motion.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DirectionConfig {
    pub gravity: GravityConfig,
    pub magnetic: MagneticConfig,
    pub rest: RestConfig,
}

/// What the filter behind the directions believes before they come.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prediction {
    /// rad/s.
    pub gyro_bias: Vector3<f64>,
    /// rad^2/s^2.
    pub gyro_bias_covariance: Matrix3<f64>,
    /// Up in body coordinates and its variance about each perpendicular axis, rad^2; `None` while
    /// the attitude is sought.
    pub up: Option<(Vector3<f64>, f64)>,
}

impl Prediction {
    fn bias_variance(&self) -> f64 {
        self.gyro_bias_covariance.trace() / 3.0
    }
}

/// A unit vector in body coordinates and the concentration of its von Mises-Fisher error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BodyDirection {
    pub in_body: Vector3<f64>,
    /// What it adds to the readings before: inverse of a variance about each perpendicular axis,
    /// rad^-2.
    pub concentration: f64,
    /// Variance of the direction if nothing else is known, rad^2.
    pub variance: f64,
}

/// What is known at the end of an interval.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Directions {
    /// Length of the interval, s.
    pub seconds: f64,
    /// Against gravity; `None` in free fall.
    pub up: Option<BodyDirection>,
    /// Horizontal, towards magnetic north; `None` without a magnetometer or where the field is
    /// vertical.
    pub north: Option<BodyDirection>,
    /// Whether iron has come or gone and the field is not trusted.
    pub disturbed: bool,
    /// Mean reading of the gyroscope over the interval and its variance per axis as a measurement
    /// of the bias, rad/s and rad^2/s^2; `None` while the body moves.
    pub resting_rate: Option<(Vector3<f64>, f64)>,
}

/// Means over one interval. `inertial` is the frame that the gyroscope carries along.
#[derive(Debug, Clone, Copy, Default)]
struct Interval {
    /// s.
    seconds: f64,
    /// Readings of the gyroscope, bias included, rad/s.
    rate: Vector3<f64>,
    /// m/s^2.
    specific_force: Vector3<f64>,
    /// m/s^2, inertial coordinates.
    inertial_specific_force: Vector3<f64>,
    /// `inertial_from_body` where the field was read; a mean of rotations is not one itself.
    turn: Matrix3<f64>,
    /// Magnetic field in body coordinates.
    field: Vector3<f64>,
    /// Magnetic field in inertial coordinates.
    inertial_field: Vector3<f64>,
    /// `inertial_from_body (w x m)` with the field `m` that is not the iron's: by how much a delay
    /// of one second would change the reading.
    field_rate: Vector3<f64>,
}

/// Finds the directions in a stream of samples.
#[derive(Debug, Clone)]
pub struct DirectionFinder {
    inertial_from_body: Rotation3<f64>,
    /// Integral of `inertial_from_body`, s: by this much of a bias the frame would have turned.
    turn_by_bias: Matrix3<f64>,
    /// The bias that is taken off, rad/s.
    gyro_bias: Vector3<f64>,
    /// The interval that is being filled: sums until it is complete.
    interval: Interval,
    samples: usize,
    field_samples: usize,
    gravity: GravityFinder,
    magnetic: MagneticFinder,
    rest: RestFinder,
}

impl DirectionFinder {
    /// A finder where gravity has this magnitude, m/s^2.
    pub fn new(config: &DirectionConfig, gravity: f64) -> Self {
        Self {
            inertial_from_body: Rotation3::identity(),
            turn_by_bias: Matrix3::zeros(),
            gyro_bias: Vector3::zeros(),
            interval: Interval::default(),
            samples: 0,
            field_samples: 0,
            gravity: GravityFinder::new(&config.gravity, gravity),
            magnetic: MagneticFinder::new(&config.magnetic),
            rest: RestFinder::new(&config.rest),
        }
    }

    /// Field of the iron that turns with the body, in body coordinates and in the magnetometer's
    /// unit.
    pub fn iron(&self) -> Vector3<f64> {
        self.magnetic.iron()
    }

    /// Passes over a gap in which the body turned by the rotation vector `angle`, give or take the
    /// `variance` about each axis, rad and rad^2.
    pub fn pass_gap(&mut self, angle: &Vector3<f64>, variance: f64) {
        self.inertial_from_body *= so3::exp(angle);
        self.interval = Interval::default();
        (self.samples, self.field_samples) = (0, 0);
        self.gravity.forget_direction();
        self.magnetic.pass_gap(variance);
        self.rest.forget_motion();
    }

    /// The body has turned by an angle that is known to this variance only, rad^2.
    pub fn doubt_turn(&mut self, variance: f64) {
        self.gravity.doubt_turn(variance);
        self.magnetic.pass_gap(variance);
    }

    /// Takes a sample whose reading of the gyroscope holds for the `seconds` before it.
    ///
    /// Numbers must be finite, `seconds` positive. The magnetic field may be in any unit and
    /// missing at any sample. Yields directions, in the body frame of this sample, whenever an
    /// interval is complete.
    pub fn push(
        &mut self,
        sample: &ImuSample,
        field: Option<&Vector3<f64>>,
        seconds: f64,
        prediction: &Prediction,
    ) -> Option<Directions> {
        self.set_gyro_bias(&prediction.gyro_bias);
        let rate = sample.angular_velocity - self.gyro_bias;
        self.inertial_from_body *= so3::exp(&(rate * seconds));
        self.turn_by_bias += self.inertial_from_body.matrix() * seconds;
        let (turn, sums) = (self.inertial_from_body, &mut self.interval);
        sums.seconds += seconds;
        sums.rate += sample.angular_velocity;
        sums.specific_force += sample.specific_force;
        sums.inertial_specific_force += turn * sample.specific_force;
        self.samples += 1;
        if let Some(field) = field {
            sums.turn += turn.matrix();
            sums.field += field;
            sums.inertial_field += turn * field;
            sums.field_rate += turn * rate.cross(&(field - self.magnetic.iron()));
            self.field_samples += 1;
        }
        (sums.seconds > INTERVAL - 0.5 * seconds).then(|| self.complete_interval(prediction))
    }

    /// Turns what was read before as this bias would have had it, in the frame of the last sample.
    fn set_gyro_bias(&mut self, bias: &Vector3<f64>) {
        let change = bias - self.gyro_bias;
        if change != Vector3::zeros() {
            self.gyro_bias = *bias;
            self.gravity.change_bias(&change, &self.turn_by_bias);
        }
    }

    fn complete_interval(&mut self, prediction: &Prediction) -> Directions {
        let field_was_read = self.field_samples > 0;
        let mean = self.take_mean();
        self.inertial_from_body.renormalize();
        let inertial_from_body = self.inertial_from_body;
        let in_inertial = |(up, variance): (Vector3<f64>, f64)| {
            InertialDirection::new(inertial_from_body * up, variance)
        };
        let expected = prediction.up.map(in_inertial);
        let up = self.gravity.measure(&mean, &self.turn_by_bias, prediction, expected.as_ref());
        let best = match (up, expected) {
            (Some(found), Some(expected)) if expected.variance < found.variance => Some(expected),
            (found, _) => found,
        };
        let north = best.filter(|_| field_was_read).and_then(|up| {
            self.magnetic.measure(&mean, &up, &inertial_from_body, prediction.bias_variance())
        });
        let in_body = |found: InertialDirection| BodyDirection {
            in_body: inertial_from_body.inverse() * found.direction,
            concentration: found.concentration,
            variance: found.variance,
        };
        Directions {
            seconds: mean.seconds,
            up: up.map(in_body),
            north: north.map(in_body),
            disturbed: self.magnetic.is_disturbed(),
            resting_rate: self.rest.measure(&mean, prediction),
        }
    }

    /// The means of the interval, and room for the next one.
    fn take_mean(&mut self) -> Interval {
        let sums = std::mem::take(&mut self.interval);
        let of_all = (self.samples as f64).recip();
        let of_fields = (self.field_samples.max(1) as f64).recip();
        (self.samples, self.field_samples) = (0, 0);
        Interval {
            seconds: sums.seconds,
            rate: sums.rate * of_all,
            specific_force: sums.specific_force * of_all,
            inertial_specific_force: sums.inertial_specific_force * of_all,
            turn: sums.turn * of_fields,
            field: sums.field * of_fields,
            inertial_field: sums.inertial_field * of_fields,
            field_rate: sums.field_rate * of_fields,
        }
    }
}

/// A direction in inertial coordinates.
#[derive(Debug, Clone, Copy)]
struct InertialDirection {
    direction: Vector3<f64>,
    /// Variance about each perpendicular axis, rad^2.
    variance: f64,
    /// What it adds to the readings before, rad^-2.
    concentration: f64,
}

impl InertialDirection {
    fn new(direction: Vector3<f64>, variance: f64) -> Self {
        Self { direction, variance, concentration: variance.recip() }
    }
}

/// Share of an independent sample that a measurement after `seconds` carries if its error has the
/// correlation time `correlation_time`, s.
fn independent_share(seconds: f64, correlation_time: f64) -> f64 {
    (0.5 * seconds / correlation_time).min(1.0)
}

/// The information of readings whose errors are correlated in time: the first one counts in full,
/// each further one for its share of an independent sample, and a better one for what it is better.
#[derive(Debug, Clone, Copy, Default)]
struct CorrelatedError {
    /// Information within the last correlation time: inverse of a variance.
    given: f64,
}

impl CorrelatedError {
    /// The information that a reading of this variance adds.
    fn added(&mut self, variance: f64, seconds: f64, correlation_time: f64) -> f64 {
        let share = independent_share(seconds, correlation_time);
        let added = (share / variance).max(variance.recip() - self.given);
        self.given = self.given * (1.0 - share) + added;
        added
    }

    /// The state that was measured has since changed by something of this variance.
    fn lose(&mut self, variance: f64) {
        self.given /= 1.0 + self.given * variance;
    }
}

#[cfg(test)]
mod tests;
