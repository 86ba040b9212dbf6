//! What calibration leaves wrong with sensors.

use std::f64::consts::{SQRT_2, TAU};

use nalgebra::{Matrix3, Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use crate::sensor::{DepthImage, ImuSample};

/// How large the errors are that calibration leaves; zero: none. Errors that a device has for good
/// are standard deviations: the scene's seed draws a device of that class.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ImperfectionConfig {
    /// Scale of each axis of the gyroscope, as a fraction, and its misalignment from each other axis,
    /// rad.
    pub gyro_scale: f64,
    pub gyro_axes: f64,
    /// The same of the accelerometer.
    pub accel_scale: f64,
    pub accel_axes: f64,
    /// Least step of the readings, rad/s and m/s^2.
    pub gyro_quantum: f64,
    pub accel_quantum: f64,
    /// What the IMU feels of motors, engine and wheels.
    pub vibrations: Vec<VibrationConfig>,
    /// Depth: scale as a fraction, offset in m, and a smooth warp over the image as a fraction (its
    /// root mean square).
    pub depth_scale: f64,
    pub depth_offset: f64,
    pub depth_warp: f64,
    /// By which the depth image is shifted against the color image, in each direction, pixels.
    pub registration: f64,
    /// By which the stamps of the frames are late (not a deviation) and by how much they tremble, s.
    pub stamp_delay: f64,
    pub stamp_jitter: f64,
}

/// A line of a vibration's spectrum.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct VibrationConfig {
    /// Hz; faster than half the IMU's rate it appears mirrored, as in a sensor without filter.
    pub frequency: f64,
    /// Root mean square of each axis, rad/s and m/s^2.
    pub gyro: f64,
    pub accel: f64,
}

impl ImperfectionConfig {
    /// Keys and values that must be zero or more.
    pub(super) fn sizes(&self) -> Vec<(&'static str, f64)> {
        let mut sizes = vec![
            ("imperfections.gyro_scale", self.gyro_scale),
            ("imperfections.gyro_axes", self.gyro_axes),
            ("imperfections.accel_scale", self.accel_scale),
            ("imperfections.accel_axes", self.accel_axes),
            ("imperfections.gyro_quantum", self.gyro_quantum),
            ("imperfections.accel_quantum", self.accel_quantum),
            ("imperfections.depth_scale", self.depth_scale),
            ("imperfections.depth_offset", self.depth_offset),
            ("imperfections.depth_warp", self.depth_warp),
            ("imperfections.registration", self.registration),
            ("imperfections.stamp_delay", self.stamp_delay),
            ("imperfections.stamp_jitter", self.stamp_jitter),
        ];
        for vibration in &self.vibrations {
            sizes.push(("imperfections.vibrations.frequency", vibration.frequency));
            sizes.push(("imperfections.vibrations.gyro", vibration.gyro));
            sizes.push(("imperfections.vibrations.accel", vibration.accel));
        }
        sizes
    }
}

/// A device of its class.
#[derive(Debug, Clone, PartialEq)]
pub struct Imperfections {
    config: ImperfectionConfig,
    seed: u64,
    /// `measured = matrix true + ...`.
    pub gyro_matrix: Matrix3<f64>,
    pub accel_matrix: Matrix3<f64>,
    /// Phases of each vibration by axis: gyroscope, accelerometer.
    phases: Vec<[Vector3<f64>; 2]>,
    /// `measured = scale (1 + warp) true + offset` (m).
    pub depth_scale: f64,
    pub depth_offset: f64,
    /// Phases of the warp along columns and rows.
    warp_phases: Vector2<f64>,
    /// Of the depth image, pixels.
    pub registration: Vector2<f64>,
}

/// Waves of the warp across the image.
const WARP_WAVES: f64 = 0.5;

impl Imperfections {
    /// Draws a device. The draws do not depend on the sizes: a larger size makes the same errors
    /// larger.
    pub fn draw(config: ImperfectionConfig, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let mut matrix = |scale: f64, axes: f64| {
            Matrix3::from_fn(|i, j| {
                let error = normal();
                if i == j { 1.0 + scale * error } else { axes * error }
            })
        };
        let gyro_matrix = matrix(config.gyro_scale, config.gyro_axes);
        let accel_matrix = matrix(config.accel_scale, config.accel_axes);
        let depth_scale = 1.0 + config.depth_scale * normal();
        let depth_offset = config.depth_offset * normal();
        let registration = Vector2::from_fn(|_, _| config.registration * normal());
        let mut phase = || TAU * rng.random::<f64>();
        let warp_phases = Vector2::from_fn(|_, _| phase());
        let phases = config
            .vibrations
            .iter()
            .map(|_| [Vector3::from_fn(|_, _| phase()), Vector3::from_fn(|_, _| phase())])
            .collect();
        Self {
            config,
            seed,
            gyro_matrix,
            accel_matrix,
            phases,
            depth_scale,
            depth_offset,
            warp_phases,
            registration,
        }
    }

    /// What the IMU feels and reads of `sample`, whose values are true, at `t` seconds from the start;
    /// biases and noise come later.
    pub fn felt(&self, t: f64, mut sample: ImuSample) -> ImuSample {
        for (vibration, [gyro, accel]) in self.config.vibrations.iter().zip(&self.phases) {
            let angle = TAU * vibration.frequency * t;
            let wave = |phases: &Vector3<f64>| phases.map(|phase| SQRT_2 * (angle + phase).sin());
            sample.angular_velocity += wave(gyro) * vibration.gyro;
            sample.specific_force += wave(accel) * vibration.accel;
        }
        if self.gyro_matrix != Matrix3::identity() {
            sample.angular_velocity = self.gyro_matrix * sample.angular_velocity;
        }
        if self.accel_matrix != Matrix3::identity() {
            sample.specific_force = self.accel_matrix * sample.specific_force;
        }
        sample
    }

    /// A reading, biases and noise included, in the steps of the sensor.
    pub fn quantised(&self, mut sample: ImuSample) -> ImuSample {
        let round = |value: f64, step: f64| (value / step).round() * step;
        let ImperfectionConfig { gyro_quantum, accel_quantum, .. } = self.config;
        if gyro_quantum > 0.0 {
            sample.angular_velocity.apply(|x| *x = round(*x, gyro_quantum));
        }
        if accel_quantum > 0.0 {
            sample.specific_force.apply(|x| *x = round(*x, accel_quantum));
        }
        sample
    }

    /// By how much the stamp of a frame is late, s.
    pub fn stamp_delay(&self, frame: u64) -> f64 {
        let ImperfectionConfig { stamp_delay, stamp_jitter, .. } = self.config;
        if stamp_jitter == 0.0 {
            return stamp_delay;
        }
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(frame.wrapping_add(1));
        let error: f64 = StandardNormal.sample(&mut rng);
        stamp_delay + stamp_jitter * error
    }

    /// The depth image that the sensor gives in place of the true one.
    pub fn depth(&self, image: DepthImage) -> DepthImage {
        let ImperfectionConfig { depth_scale, depth_offset, depth_warp, registration, .. } =
            self.config;
        if [depth_scale, depth_offset, depth_warp, registration].iter().all(|size| *size == 0.0) {
            return image;
        }
        let (width, height) = (image.width(), image.height());
        let offset = self.depth_offset / f64::from(image.scale());
        let shift = self.registration.map(|x| x.round() as i64);
        let mut data = Vec::with_capacity(width * height);
        for row in 0..height {
            for column in 0..width {
                let from = |place: usize, shift: i64| {
                    usize::try_from(i64::try_from(place).ok()? - shift).ok()
                };
                let source = from(column, shift.x).zip(from(row, shift.y));
                let raw = source
                    .filter(|(column, row)| *column < width && *row < height)
                    .and_then(|(column, row)| image.data().get(row * width + column));
                data.push(match raw {
                    None | Some(0) => 0,
                    Some(raw) => {
                        let place = [column as f64 / width as f64, row as f64 / height as f64];
                        let factor = self.depth_scale * (1.0 + self.warp(place));
                        (f64::from(*raw) * factor + offset).round().clamp(1.0, 65535.0) as u16
                    }
                });
            }
        }
        DepthImage::new(width, height, image.scale(), data).unwrap_or(image)
    }

    /// Relative error of the depth at a place of the image (0 to 1 in each direction).
    pub fn warp(&self, place: [f64; 2]) -> f64 {
        let wave = |k: usize| (TAU * WARP_WAVES * place[k] + self.warp_phases[k]).sin();
        // A product of two waves has a quarter of their squared amplitudes for its mean square.
        2.0 * self.config.depth_warp * wave(0) * wave(1)
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;
    use crate::sensor::Stamp;

    fn sample() -> ImuSample {
        ImuSample {
            stamp: Stamp::default(),
            angular_velocity: Vector3::new(0.1, -0.25, 0.3),
            specific_force: Vector3::new(0.5, 9.7, -1.1),
        }
    }

    fn wall() -> DepthImage {
        DepthImage::new(
            40,
            30,
            0.001,
            (0..1200).map(|k| if k % 7 == 0 { 0 } else { 2000 }).collect(),
        )
        .unwrap()
    }

    #[test]
    fn no_imperfections_change_nothing() {
        let none = Imperfections::draw(ImperfectionConfig::default(), 3);
        assert_eq!(none.quantised(none.felt(0.7, sample())), sample());
        assert_eq!(none.depth(wall()), wall());
        assert_eq!(none.stamp_delay(5), 0.0);
    }

    #[test]
    fn devices_of_a_class_have_its_spread() {
        let config = ImperfectionConfig {
            gyro_scale: 0.005,
            accel_axes: 0.003,
            depth_scale: 0.008,
            ..ImperfectionConfig::default()
        };
        let devices: Vec<_> =
            (0..2000).map(|seed| Imperfections::draw(config.clone(), seed)).collect();
        let spread = |of: fn(&Imperfections) -> f64| {
            (devices.iter().map(|d| of(d).powi(2)).sum::<f64>() / devices.len() as f64).sqrt()
        };
        assert_relative_eq!(spread(|d| d.gyro_matrix[(1, 1)] - 1.0), 0.005, max_relative = 0.06);
        assert_relative_eq!(spread(|d| d.accel_matrix[(0, 2)]), 0.003, max_relative = 0.06);
        assert_relative_eq!(spread(|d| d.depth_scale - 1.0), 0.008, max_relative = 0.06);
        assert!(devices.iter().all(|d| d.gyro_matrix[(0, 1)] == 0.0 && d.depth_offset == 0.0));
        // Three times the size makes the same device three times as wrong.
        let tripled =
            Imperfections::draw(ImperfectionConfig { depth_scale: 0.024, ..config.clone() }, 17);
        let error = devices[17].depth_scale - 1.0;
        assert_relative_eq!(tripled.depth_scale - 1.0, 3.0 * error, max_relative = 1e-9);
    }

    #[test]
    fn vibrations_have_their_size_and_readings_their_steps() {
        let vibrations = vec![VibrationConfig { frequency: 83.0, gyro: 0.02, accel: 0.7 }];
        let config =
            ImperfectionConfig { vibrations, accel_quantum: 0.02, ..ImperfectionConfig::default() };
        let device = Imperfections::draw(config, 1);
        let n = 20_000;
        let mean_square = (0..n)
            .map(|k| {
                let felt = device.felt(f64::from(k) * 0.005, sample());
                (felt.specific_force - sample().specific_force).norm_squared()
            })
            .sum::<f64>()
            / f64::from(n);
        assert_relative_eq!(mean_square, 3.0 * 0.7 * 0.7, max_relative = 0.01);
        let read = device.quantised(device.felt(0.1, sample())).specific_force / 0.02;
        assert!(read.iter().all(|x| (x - x.round()).abs() < 1e-9), "{read}");
    }

    #[test]
    fn depth_is_scaled_shifted_and_warped() {
        let config = ImperfectionConfig {
            depth_scale: 0.01,
            depth_offset: 0.004,
            registration: 1.5,
            ..ImperfectionConfig::default()
        };
        let device = Imperfections::draw(config, 6);
        let expected = 2000.0 * device.depth_scale + 1000.0 * device.depth_offset;
        let image = device.depth(wall());
        let values: Vec<u16> = image.data().iter().copied().filter(|raw| *raw > 0).collect();
        assert!(!values.is_empty() && values.iter().all(|v| *v == expected.round() as u16));
        let shift = device.registration.map(|x| x.round() as i64);
        assert!(shift != Vector2::zeros());
        for (row, column) in [(12_i64, 14_i64), (15, 20), (20, 11)] {
            let raw = |image: &DepthImage, row: i64, column: i64| {
                image.data()[(row * 40 + column) as usize] > 0
            };
            assert_eq!(raw(&image, row + shift.y, column + shift.x), raw(&wall(), row, column));
        }
        let config = ImperfectionConfig { depth_warp: 0.006, ..ImperfectionConfig::default() };
        let square = (0..300)
            .map(|seed| Imperfections::draw(config.clone(), seed).warp([0.3, 0.8]).powi(2) / 300.0);
        assert_relative_eq!(square.sum::<f64>().sqrt(), 0.006, max_relative = 0.15);
    }

    #[test]
    fn stamps_are_late_and_tremble() {
        let config = ImperfectionConfig {
            stamp_delay: 0.004,
            stamp_jitter: 0.0005,
            ..ImperfectionConfig::default()
        };
        let device = Imperfections::draw(config, 2);
        let delays: Vec<f64> = (0..1000).map(|frame| device.stamp_delay(frame)).collect();
        let mean = delays.iter().sum::<f64>() / 1000.0;
        let variance = delays.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / 1000.0;
        assert!((mean - 0.004).abs() < 5e-5 && (variance.sqrt() / 5e-4 - 1.0).abs() < 0.07);
        assert_eq!(device.stamp_delay(7), delays[7]);
    }
}
