use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::sensor::ImuSample;
use crate::so3;

/// When an IMU counts as standing still.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StandstillConfig {
    /// Length of the window that is judged, s.
    pub window: f64,
    /// Largest root mean square of the angular velocity about its mean, rad/s.
    pub max_gyro_deviation: f64,
    /// Largest root mean square of the specific force about its mean, m/s^2.
    pub max_accel_deviation: f64,
    /// Largest magnitude of the mean angular velocity (what a bias may explain), rad/s.
    pub max_gyro_mean: f64,
    /// Use rest in the course of a run as a measurement of velocity and gyro bias.
    pub update: bool,
    /// Largest speed at which the features seem to move at rest, m/s.
    pub max_feature_speed: f64,
    /// Standard deviation of each component of the velocity at rest, m/s.
    pub velocity_sd: f64,
    /// Standard deviation of the angular velocity at rest, averaged over a frame, rad/s.
    pub rate_sd: f64,
}

impl Default for StandstillConfig {
    fn default() -> Self {
        Self {
            window: 0.5,
            max_gyro_deviation: 0.015,
            max_accel_deviation: 0.1,
            max_gyro_mean: 0.05,
            update: true,
            max_feature_speed: 0.01,
            velocity_sd: 0.02,
            rate_sd: 0.01,
        }
    }
}

/// Measured values of a window beside the thresholds they are held against.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StandstillCheck {
    pub samples: usize,
    /// Root mean square about the mean, all axes together, rad/s.
    pub gyro_deviation: f64,
    /// Root mean square about the mean, all axes together, m/s^2.
    pub accel_deviation: f64,
    /// Mean angular velocity, rad/s: the gyro bias when standing still.
    pub gyro_mean: Vector3<f64>,
    /// Mean specific force, m/s^2.
    pub accel_mean: Vector3<f64>,
}

impl StandstillCheck {
    /// `None` for fewer than two samples.
    pub fn measure(samples: &[ImuSample]) -> Option<Self> {
        if samples.len() < 2 {
            return None;
        }
        let n = samples.len() as f64;
        let mean = |value: fn(&ImuSample) -> Vector3<f64>| {
            samples.iter().map(value).sum::<Vector3<f64>>() / n
        };
        let deviation = |value: fn(&ImuSample) -> Vector3<f64>, mean: Vector3<f64>| {
            let sum: f64 = samples.iter().map(|s| (value(s) - mean).norm_squared()).sum();
            (sum / n).sqrt()
        };
        let (gyro, accel) = (|s: &ImuSample| s.angular_velocity, |s: &ImuSample| s.specific_force);
        let (gyro_mean, accel_mean) = (mean(gyro), mean(accel));
        Some(Self {
            samples: samples.len(),
            gyro_deviation: deviation(gyro, gyro_mean),
            accel_deviation: deviation(accel, accel_mean),
            gyro_mean,
            accel_mean,
        })
    }

    pub fn stands_still(&self, config: &StandstillConfig) -> bool {
        self.gyro_deviation <= config.max_gyro_deviation
            && self.accel_deviation <= config.max_accel_deviation
            && self.gyro_mean.norm() <= config.max_gyro_mean
    }

    /// Statistic of the generalised likelihood ratio test for rest (Skog, Handel, Nilsson and
    /// Rantakokko, IEEE Trans. Biomed. Eng. 57, 2010, (11)): mean squared deviation from a
    /// constant force of the magnitude of `gravity` (m/s^2) and from a rate of zero, each in
    /// units of its limit. Biases (rad/s, m/s^2) are taken off first. Up to about 1 at rest.
    pub fn likelihood_ratio(
        &self,
        gyro_bias: &Vector3<f64>,
        accel_bias: &Vector3<f64>,
        gravity: f64,
        config: &StandstillConfig,
    ) -> f64 {
        // The deviation about a constant splits into that about the mean and the mean's own.
        let rate = self.gyro_deviation.powi(2) + (self.gyro_mean - gyro_bias).norm_squared();
        let excess = (self.accel_mean - accel_bias).norm() - gravity;
        let force = self.accel_deviation.powi(2) + excess.powi(2);
        rate / config.max_gyro_deviation.powi(2) + force / config.max_accel_deviation.powi(2)
    }

    /// One line that holds every measured value against its threshold.
    pub fn explain(&self, config: &StandstillConfig) -> String {
        let verdict = |value: f64, limit: f64| if value <= limit { "ok" } else { "too large" };
        format!(
            "gyro deviation {:.4} rad/s (limit {:.4}, {}), accelerometer deviation {:.3} m/s^2 \
             (limit {:.3}, {}), mean rate {:.4} rad/s (limit {:.4}, {})",
            self.gyro_deviation,
            config.max_gyro_deviation,
            verdict(self.gyro_deviation, config.max_gyro_deviation),
            self.accel_deviation,
            config.max_accel_deviation,
            verdict(self.accel_deviation, config.max_accel_deviation),
            self.gyro_mean.norm(),
            config.max_gyro_mean,
            verdict(self.gyro_mean.norm(), config.max_gyro_mean),
        )
    }
}

/// Attitude with the given "up" in body coordinates and heading zero (the shortest rotation);
/// `None` if `up_in_body` has no direction.
pub fn attitude_from_gravity(up_in_body: &Vector3<f64>) -> Option<UnitQuaternion<f64>> {
    let up = up_in_body.try_normalize(1e-6)?;
    let half_turn = || UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    Some(UnitQuaternion::rotation_between(&up, &Vector3::z()).unwrap_or_else(half_turn))
}

/// Attitude at the first sample and how well it is known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InitialAttitude {
    pub world_from_body: UnitQuaternion<f64>,
    pub gyro_bias: Vector3<f64>,
    /// Covariance of the body-frame rotation error, rad^2.
    pub covariance: Matrix3<f64>,
}

impl InitialAttitude {
    /// Levels the body by the mean of `samples`, each turned back to the first by the gyroscope.
    ///
    /// The mean acceleration over the window is the error; it has the standard deviation
    /// `velocity_change / duration` when the velocity changes by `velocity_change` (m/s) in it.
    /// The heading is zero by definition and given the standard deviation `heading_sd` (rad).
    pub fn level(
        samples: &[ImuSample],
        gyro_bias: Vector3<f64>,
        tilt_sd: f64,
        heading_sd: f64,
    ) -> Option<Self> {
        let first = samples.first()?;
        let mut first_from_now = Rotation3::identity();
        let mut up = first.specific_force;
        for pair in samples.windows(2) {
            let h = pair[1].stamp.seconds_since(pair[0].stamp);
            let rate = (pair[0].angular_velocity + pair[1].angular_velocity) * 0.5 - gyro_bias;
            first_from_now *= so3::exp(&(rate * h));
            up += first_from_now * pair[1].specific_force;
        }
        let world_from_body = attitude_from_gravity(&up)?;
        let up = up.try_normalize(1e-6)?;
        let vertical = up * up.transpose();
        let covariance =
            (Matrix3::identity() - vertical) * tilt_sd.powi(2) + vertical * heading_sd.powi(2);
        Some(Self { world_from_body, gyro_bias, covariance })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::Stamp;
    use approx::assert_relative_eq;

    fn samples(rate: Vector3<f64>, up: impl Fn(f64) -> Vector3<f64>) -> Vec<ImuSample> {
        (0..100)
            .map(|k| {
                let stamp = Stamp::from_nanos(k * 10_000_000);
                let specific_force = up(stamp.seconds());
                ImuSample { stamp, angular_velocity: rate, specific_force }
            })
            .collect()
    }

    #[test]
    fn a_resting_imu_stands_still_and_a_shaken_one_does_not() {
        let config = StandstillConfig::default();
        let rest = samples(Vector3::new(0.01, 0.0, 0.0), |_| Vector3::new(0.0, 0.0, 9.81));
        let check = StandstillCheck::measure(&rest).unwrap();
        assert!(check.stands_still(&config));
        assert_relative_eq!(check.gyro_mean, Vector3::new(0.01, 0.0, 0.0), epsilon = 1e-12);

        let shaken = samples(Vector3::zeros(), |t| Vector3::new((9.0 * t).sin(), 0.0, 9.81));
        let check = StandstillCheck::measure(&shaken).unwrap();
        assert!(!check.stands_still(&config));
        assert!(check.explain(&config).contains("too large"), "{}", check.explain(&config));
        assert!(StandstillCheck::measure(&rest[..1]).is_none());

        let ratio = |samples: &[ImuSample], bias: f64| {
            let check = StandstillCheck::measure(samples).unwrap();
            let bias = Vector3::new(bias, 0.0, 0.0);
            check.likelihood_ratio(&bias, &Vector3::zeros(), 9.81, &config)
        };
        assert!(ratio(&rest, 0.01) < 1e-9);
        // A rate of 0.01 against a limit of 0.015 rad/s, squared.
        assert_relative_eq!(ratio(&rest, 0.0), 4.0 / 9.0, epsilon = 1e-9);
        // A sine of amplitude 1 has the variance 1/2; its limit is 0.1 m/s^2.
        assert!(ratio(&shaken, 0.0) > 40.0);
    }

    #[test]
    fn levelling_undoes_the_rotation_of_the_window() {
        let rate = Vector3::new(0.3, -0.8, 0.5);
        let world_from_first = Rotation3::from_euler_angles(0.4, -0.3, 0.0);
        let turned = samples(rate, |t| {
            let world_from_body = world_from_first * so3::exp(&(rate * t));
            world_from_body.inverse() * Vector3::new(0.0, 0.0, 9.81)
        });
        let level = InitialAttitude::level(&turned, Vector3::zeros(), 0.01, 0.1).unwrap();
        let up = level.world_from_body * (world_from_first.inverse() * Vector3::z());
        assert_relative_eq!(up, Vector3::z(), epsilon = 1e-6);
    }

    #[test]
    fn upside_down_is_levelled_too_and_free_fall_is_refused() {
        let turned = attitude_from_gravity(&Vector3::new(0.0, 0.0, -9.81)).unwrap();
        assert_relative_eq!(turned * -Vector3::z(), Vector3::z(), epsilon = 1e-12);
        assert!(attitude_from_gravity(&Vector3::zeros()).is_none());
    }
}
