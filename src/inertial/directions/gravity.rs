//! Up from the specific force.

use std::ops::{AddAssign, Div, Mul, Sub};

use nalgebra::Vector3;

use super::{CorrelatedNoise, InertialDirection, Interval};

/// How far the specific force is believed to show gravity.
#[derive(Debug, Clone, PartialEq)]
pub struct GravityConfig {
    /// Magnitude of gravity, m/s^2.
    pub gravity: f64,
    /// Time constant of each of the two low-passes, s.
    pub time_constant: f64,
    /// Share of the acceleration that the low-passes let through: `1/(1 + w^2 T^2)` at the
    /// frequency of the motion, here 0.75 Hz.
    pub surviving_share: f64,
    /// Standard deviation from misalignment, scale and bias of the accelerometer, rad.
    pub calibration_sd: f64,
    /// Relative error of the magnitude that calibration explains. More is an acceleration that
    /// lasts.
    pub magnitude_tolerance: f64,
    /// Correlation time of the error, s.
    pub correlation_time: f64,
}

impl Default for GravityConfig {
    fn default() -> Self {
        Self {
            gravity: 9.81,
            time_constant: 1.5,
            surviving_share: 0.02,
            calibration_sd: 0.4f64.to_radians(),
            magnitude_tolerance: 0.01,
            correlation_time: 0.5,
        }
    }
}

/// A low-pass of first order that starts from its first input.
#[derive(Debug, Clone, Copy, Default)]
struct LowPass<T> {
    /// Weighted sum of the inputs and the sum of the weights.
    sum: T,
    weight: f64,
}

impl<T> LowPass<T>
where
    T: Copy + AddAssign + Sub<Output = T> + Mul<f64, Output = T> + Div<f64, Output = T>,
{
    fn push(&mut self, input: T, gain: f64) -> T {
        self.sum += (input - self.sum) * gain;
        self.weight += (1.0 - self.weight) * gain;
        self.sum / self.weight
    }
}

/// Low-passes the specific force in inertial coordinates.
#[derive(Debug, Clone)]
pub(super) struct GravityFinder {
    config: GravityConfig,
    first: LowPass<Vector3<f64>>,
    second: LowPass<Vector3<f64>>,
    /// Mean square of the acceleration, m^2/s^4.
    acceleration: LowPass<f64>,
    noise: CorrelatedNoise,
}

impl GravityFinder {
    pub fn new(config: &GravityConfig) -> Self {
        Self {
            config: config.clone(),
            first: LowPass::default(),
            second: LowPass::default(),
            acceleration: LowPass::default(),
            noise: CorrelatedNoise::default(),
        }
    }

    pub fn measure(&mut self, mean: &Interval) -> Option<InertialDirection> {
        let config = &self.config;
        let gain = -(-mean.seconds / config.time_constant).exp_m1();
        let first = self.first.push(mean.inertial_specific_force, gain);
        let smooth = self.second.push(first, gain);
        let acceleration = (mean.inertial_specific_force - smooth).norm_squared();
        let acceleration = self.acceleration.push(acceleration, gain);
        let direction = smooth.try_normalize(0.1 * config.gravity)?;

        let surviving = config.surviving_share.powi(2) * acceleration / config.gravity.powi(2);
        // A lasting horizontal acceleration `a` makes the magnitude `g + a^2/(2 g)` and the tilt
        // `a/g`.
        let excess = (smooth.norm() / config.gravity - 1.0).abs() - config.magnitude_tolerance;
        let variance = config.calibration_sd.powi(2) + surviving + 2.0 * excess.max(0.0);
        let variance = self.noise.variance(variance, mean.seconds, config.correlation_time);
        Some(InertialDirection { direction, concentration: variance.recip() })
    }
}
