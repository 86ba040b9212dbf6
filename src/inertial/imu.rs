use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::Stamp;

/// One reading of the inertial measurement unit, in SI units, biases and noise included.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImuSample {
    pub stamp: Stamp,
    /// Angular velocity of the body in body coordinates, rad/s.
    pub angular_velocity: Vector3<f64>,
    /// Specific force `R^T (a - g)` in body coordinates, m/s^2.
    pub specific_force: Vector3<f64>,
}

impl ImuSample {
    /// A reading as logged, in SI units.
    pub fn scaled(&self, config: &ImuConfig) -> Self {
        Self {
            stamp: self.stamp,
            angular_velocity: self.angular_velocity * config.gyroscope_scale,
            specific_force: self.specific_force * config.accelerometer_scale,
        }
    }

    /// The reading at `stamp` on the line between two samples; the later one where they are not
    /// apart.
    pub fn between(from: &Self, to: &Self, stamp: Stamp) -> Self {
        let interval = to.stamp.seconds_since(from.stamp);
        let fraction =
            if interval > 0.0 { stamp.seconds_since(from.stamp) / interval } else { 1.0 };
        Self {
            stamp,
            angular_velocity: from.angular_velocity.lerp(&to.angular_velocity, fraction),
            specific_force: from.specific_force.lerp(&to.specific_force, fraction),
        }
    }

    pub fn is_finite(&self) -> bool {
        let finite = |v: &Vector3<f64>| v.iter().all(|x| x.is_finite());
        finite(&self.angular_velocity) && finite(&self.specific_force)
    }
}

/// A position measured by a GNSS receiver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PositionFix {
    pub stamp: Stamp,
    /// World coordinates (local, z up), m.
    pub position: Vector3<f64>,
}

/// Units and noise of the IMU. Noise densities are continuous-time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ImuConfig {
    /// Factor that turns the logged accelerometer reading into specific force in m/s^2
    /// (-9.81 for VCU-RVI, which logs g with the sign inverted).
    pub accelerometer_scale: f64,
    /// Factor that turns the logged gyroscope reading into rad/s.
    pub gyroscope_scale: f64,
    /// Gyroscope white noise, rad/s/sqrt(Hz).
    pub gyro_noise: f64,
    /// Accelerometer white noise, m/s^2/sqrt(Hz).
    pub accel_noise: f64,
    /// Gyroscope bias random walk, rad/s^2/sqrt(Hz).
    pub gyro_bias_walk: f64,
    /// Accelerometer bias random walk, m/s^3/sqrt(Hz).
    pub accel_bias_walk: f64,
    /// Standard deviation of each gyroscope bias at the start, rad/s.
    pub gyro_bias_sd: f64,
    /// Standard deviation of each accelerometer bias at the start, m/s^2.
    pub accel_bias_sd: f64,
    /// Magnitude of gravity, m/s^2.
    pub gravity: f64,
    /// An interval between two samples longer than this counts as a gap, s.
    pub max_gap: f64,
    /// White noise that stands for what the gyroscope missed in a gap, rad/s/sqrt(Hz).
    pub gap_gyro_noise: f64,
    /// The same for the accelerometer, m/s^2/sqrt(Hz).
    pub gap_accel_noise: f64,
}

impl Default for ImuConfig {
    fn default() -> Self {
        Self {
            accelerometer_scale: 1.0,
            gyroscope_scale: 1.0,
            gyro_noise: 1.0e-3,
            accel_noise: 1.0e-2,
            gyro_bias_walk: 1.0e-4,
            accel_bias_walk: 1.0e-3,
            gyro_bias_sd: 1.0e-2,
            accel_bias_sd: 1.0e-1,
            gravity: 9.80665,
            max_gap: 0.1,
            gap_gyro_noise: 0.3,
            gap_accel_noise: 1.0,
        }
    }
}
