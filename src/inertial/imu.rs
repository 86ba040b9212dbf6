use serde::{Deserialize, Serialize};

use crate::sensor::ImuSample;

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

impl ImuConfig {
    /// A reading as logged, in SI units.
    pub fn in_si_units(&self, logged: &ImuSample) -> ImuSample {
        ImuSample {
            stamp: logged.stamp,
            angular_velocity: logged.angular_velocity * self.gyroscope_scale,
            specific_force: logged.specific_force * self.accelerometer_scale,
        }
    }
}
