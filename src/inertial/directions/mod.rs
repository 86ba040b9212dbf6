//! Up and north as directions in the body frame, from an accelerometer that also feels the motion
//! and a magnetometer that also feels iron, each with a concentration that follows the evidence.
//!
//! Both sensors are read in a frame that the gyroscope alone carries along, which is inertial but
//! for the gyroscope's slow drift. There gravity and the earth's field stand still, so that what
//! moves is disturbance:
//!
//! - **Specific force** ([`gravity`]). The acceleration of a body that stays in its place averages
//!   out; two low-passes in series let through `1/(1 + w^2 T^2)` of a motion at the frequency `w`.
//!   Its momentary strength is measured and lowers the concentration.
//! - **Magnetic field** ([`magnetic`]). `m = R^T field + iron + delay R^T-rate`: a Kalman filter
//!   tells the field, which stands still, from the iron of the device, which turns with the body,
//!   and from the delay of the magnetometer. A reading far from what it expects means that iron
//!   has come or gone; the iron is then unknown until the body's turning reveals it anew.
//! - **Rest** ([`rest`]). A gyroscope that stands still shows its bias.
//!
//! What disturbs is correlated in time: samples closer together than the correlation time `T` say
//! the same thing again. A Gauss-Markov error carries one independent sample every `2 T`, so a
//! measurement every `h` seconds is given `h/(2 T)` of the concentration that it would deserve
//! alone, and the first one all of it.

mod gravity;
mod magnetic;
mod rest;

use nalgebra::{Matrix3, Rotation3, Vector3};

pub use gravity::GravityConfig;
pub use magnetic::MagneticConfig;
pub use rest::RestConfig;

use crate::sensor::ImuSample;
use crate::so3;
use gravity::GravityFinder;
use magnetic::MagneticFinder;
use rest::RestFinder;

/// How directions are found. The defaults are for sensors of consumer grade in hand-held motion.
#[derive(Debug, Clone, PartialEq)]
pub struct DirectionConfig {
    /// Time between two measurements, over which the readings are averaged, s.
    pub interval: f64,
    /// After a gap longer than this everything but iron, delay and gyro bias is forgotten, s.
    pub max_gap: f64,
    pub gravity: GravityConfig,
    pub magnetic: MagneticConfig,
    pub rest: RestConfig,
}

impl Default for DirectionConfig {
    fn default() -> Self {
        Self {
            interval: 0.1,
            max_gap: 1.0,
            gravity: GravityConfig::default(),
            magnetic: MagneticConfig::default(),
            rest: RestConfig::default(),
        }
    }
}

/// A unit vector in body coordinates and the concentration of its von Mises-Fisher error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BodyDirection {
    pub in_body: Vector3<f64>,
    /// Inverse of the variance about each perpendicular axis, rad^-2.
    pub concentration: f64,
}

/// What is known at the end of an interval.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Directions {
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
    /// Magnetic field in inertial coordinates.
    inertial_field: Vector3<f64>,
    /// `inertial_from_body (w x m)` with the field `m` that is not the iron's: by how much a delay
    /// of one second would change the reading.
    field_rate: Vector3<f64>,
}

/// Finds the directions in a stream of samples.
#[derive(Debug, Clone)]
pub struct DirectionFinder {
    config: DirectionConfig,
    inertial_from_body: Rotation3<f64>,
    /// The interval that is being filled: sums until it is complete.
    interval: Interval,
    samples: usize,
    field_samples: usize,
    gravity: GravityFinder,
    magnetic: MagneticFinder,
    rest: RestFinder,
}

impl DirectionFinder {
    pub fn new(config: &DirectionConfig) -> Self {
        Self {
            config: config.clone(),
            inertial_from_body: Rotation3::identity(),
            interval: Interval::default(),
            samples: 0,
            field_samples: 0,
            gravity: GravityFinder::new(&config.gravity),
            magnetic: MagneticFinder::new(&config.magnetic),
            rest: RestFinder::new(&config.rest),
        }
    }

    /// Forgets what a gap in the data makes worthless.
    pub fn forget_attitude(&mut self) {
        self.interval = Interval::default();
        (self.samples, self.field_samples) = (0, 0);
        self.gravity = GravityFinder::new(&self.config.gravity);
        self.magnetic.forget_field();
        self.rest.forget_motion();
    }

    /// Gyro bias as seen at rest and its variance per axis, rad/s and rad^2/s^2.
    pub fn gyro_bias(&self) -> (Vector3<f64>, f64) {
        self.rest.bias()
    }

    /// Field of the iron that turns with the body, in body coordinates and in the magnetometer's
    /// unit.
    pub fn iron(&self) -> Vector3<f64> {
        self.magnetic.iron()
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
    ) -> Option<Directions> {
        let rate = sample.angular_velocity - self.rest.bias().0;
        self.inertial_from_body *= so3::exp(&(rate * seconds));
        let (turn, sums) = (self.inertial_from_body, &mut self.interval);
        sums.seconds += seconds;
        sums.rate += sample.angular_velocity;
        sums.specific_force += sample.specific_force;
        sums.inertial_specific_force += turn * sample.specific_force;
        self.samples += 1;
        if let Some(field) = field {
            sums.turn += turn.matrix();
            sums.inertial_field += turn * field;
            sums.field_rate += turn * rate.cross(&(field - self.magnetic.iron()));
            self.field_samples += 1;
        }
        (sums.seconds > self.config.interval - 0.5 * seconds).then(|| self.complete_interval())
    }

    fn complete_interval(&mut self) -> Directions {
        let field_was_read = self.field_samples > 0;
        let mean = self.take_mean();
        self.inertial_from_body.renormalize();
        let body_from_inertial = self.inertial_from_body.inverse();
        let up = self.gravity.measure(&mean);
        let north = up
            .filter(|_| field_was_read)
            .and_then(|up| self.magnetic.measure(&mean, &up.direction));
        let in_body = |found: InertialDirection| BodyDirection {
            in_body: body_from_inertial * found.direction,
            concentration: found.concentration,
        };
        Directions {
            up: up.map(in_body),
            north: north.map(in_body),
            disturbed: self.magnetic.is_disturbed(),
            resting_rate: self.rest.measure(&mean),
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
            inertial_field: sums.inertial_field * of_fields,
            field_rate: sums.field_rate * of_fields,
        }
    }
}

/// A direction in inertial coordinates and its concentration.
#[derive(Debug, Clone, Copy)]
struct InertialDirection {
    direction: Vector3<f64>,
    concentration: f64,
}

/// Share of an independent sample that a measurement after `seconds` carries if its error has the
/// correlation time `correlation_time`, s.
fn independent_share(seconds: f64, correlation_time: f64) -> f64 {
    (0.5 * seconds / correlation_time).min(1.0)
}

/// The variance that stands for correlated noise of the variance given: the first measurement
/// counts in full, each further one for its share of an independent sample.
#[derive(Debug, Clone, Copy, Default)]
struct CorrelatedNoise {
    measured_before: bool,
}

impl CorrelatedNoise {
    fn variance(&mut self, variance: f64, seconds: f64, correlation_time: f64) -> f64 {
        let first = !std::mem::replace(&mut self.measured_before, true);
        if first { variance } else { variance / independent_share(seconds, correlation_time) }
    }
}

#[cfg(test)]
mod tests;
