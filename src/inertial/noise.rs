//! Noise of an IMU, and of what stands in for it where its data have a gap.

use super::ImuConfig;

/// Densities of white noises.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct WhiteNoise {
    /// rad/s/sqrt(Hz).
    pub gyro: f64,
    /// m/s^2/sqrt(Hz).
    pub accel: f64,
}

/// The noises that drive the error of a belief.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct DrivingNoise {
    sampled: WhiteNoise,
    in_gaps: WhiteNoise,
    /// rad/s^2/sqrt(Hz).
    pub gyro_bias_walk: f64,
    /// m/s^3/sqrt(Hz).
    pub accel_bias_walk: f64,
    in_gap: bool,
}

impl DrivingNoise {
    pub fn inertial(config: &ImuConfig) -> Self {
        Self {
            sampled: WhiteNoise { gyro: config.gyro_noise, accel: config.accel_noise },
            in_gaps: WhiteNoise { gyro: config.gap_gyro_noise, accel: config.gap_accel_noise },
            gyro_bias_walk: config.gyro_bias_walk,
            accel_bias_walk: config.accel_bias_walk,
            in_gap: false,
        }
    }

    /// Of a body whose velocities change at random, where the biases stand for them.
    pub fn constant_velocity(angular_acceleration: f64, acceleration: f64) -> Self {
        let white = WhiteNoise { gyro: 0.0, accel: acceleration };
        Self {
            sampled: white,
            in_gaps: white,
            gyro_bias_walk: angular_acceleration,
            accel_bias_walk: 0.0,
            in_gap: false,
        }
    }

    /// Says whether the next samples only stand in for those of a gap in the IMU's data.
    pub fn set_imu_gap(&mut self, in_gap: bool) {
        self.in_gap = in_gap;
    }

    pub fn white(&self) -> WhiteNoise {
        if self.in_gap { self.in_gaps } else { self.sampled }
    }
}
