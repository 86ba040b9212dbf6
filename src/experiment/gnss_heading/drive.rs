//! Simulated drives: what a car, a rover and a drone do, and what their sensors say of it.

use std::f64::consts::{PI, TAU};

use nalgebra::{Isometry3, Rotation3, UnitQuaternion, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use crate::inertial::{ImuConfig, NavState};
use crate::sensor::{ImuSample, PositionFix, Stamp};
use crate::so3::log;

/// IMU interval, s.
pub const STEP: f64 = 1.0 / 50.0;
/// Interval of differences, s.
const DIFFERENCE: f64 = 1e-3;
/// Largest gyroscope bias, rad/s.
pub const LARGEST_BIAS: f64 = 5.0 * PI / 180.0;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Vehicle {
    Car,
    Rover,
    Drone,
}

impl Vehicle {
    pub const ALL: [Self; 3] = [Self::Car, Self::Rover, Self::Drone];

    pub fn name(self) -> &'static str {
        match self {
            Self::Car => "car",
            Self::Rover => "rover",
            Self::Drone => "drone",
        }
    }

    /// Speed: mean, amplitude (m/s), period (s).
    fn speed(self) -> [f64; 3] {
        match self {
            Self::Car => [7.0, 6.0, 24.0],
            Self::Rover => [0.5, 0.4, 9.0],
            Self::Drone => [0.0, 2.0, 7.0],
        }
    }

    /// Heading: amplitude (rad), period (s).
    fn heading(self) -> [f64; 2] {
        match self {
            Self::Car => [1.3, 31.0],
            Self::Rover => [1.6, 21.0],
            Self::Drone => [0.8, 17.0],
        }
    }

    /// Roll and pitch of the ground: amplitude (rad), period (s).
    fn ground(self) -> [f64; 2] {
        match self {
            Self::Car => [0.03, 6.0],
            Self::Rover => [0.08, 4.0],
            Self::Drone => [0.0, 1.0],
        }
    }
}

/// What a drive's sensors say, and the truth at each IMU sample.
pub struct Drive {
    pub imu: Vec<ImuSample>,
    pub truth: Vec<NavState>,
    /// Positions at each IMU sample with the noise of a receiver of 1 m; see [`Self::fixes`].
    unit_noise: Vec<Vector3<f64>>,
}

/// A motion with phases and periods of its own.
struct Motion {
    vehicle: Vehicle,
    phases: [f64; 6],
    stretch: [f64; 6],
    initial_heading: f64,
}

impl Motion {
    fn new(vehicle: Vehicle, rng: &mut ChaCha8Rng) -> Self {
        Self {
            vehicle,
            phases: std::array::from_fn(|_| rng.random_range(0.0..TAU)),
            stretch: std::array::from_fn(|_| rng.random_range(0.8..1.25)),
            initial_heading: rng.random_range(0.0..TAU),
        }
    }

    fn wave(&self, k: usize, period: f64, t: f64) -> f64 {
        (TAU * t / (period * self.stretch[k]) + self.phases[k]).sin()
    }

    fn heading(&self, t: f64) -> f64 {
        let [amplitude, period] = self.vehicle.heading();
        self.initial_heading + amplitude * self.wave(0, period, t)
    }

    fn velocity(&self, t: f64) -> Vector3<f64> {
        let [mean, amplitude, period] = self.vehicle.speed();
        let wave = |k: usize| mean + amplitude * self.wave(k, period, t);
        match self.vehicle {
            Vehicle::Drone => Vector3::new(wave(1), wave(2), 0.4 * wave(3)),
            Vehicle::Car | Vehicle::Rover => {
                Rotation3::from_euler_angles(0.0, 0.0, self.heading(t)) * Vector3::x() * wave(1)
            }
        }
    }

    fn acceleration(&self, t: f64) -> Vector3<f64> {
        (self.velocity(t + DIFFERENCE) - self.velocity(t - DIFFERENCE)) / (2.0 * DIFFERENCE)
    }

    /// Along the road, or with the thrust along the body's z axis.
    fn attitude(&self, t: f64, gravity: f64) -> Rotation3<f64> {
        let heading = Rotation3::from_euler_angles(0.0, 0.0, self.heading(t));
        if self.vehicle == Vehicle::Drone {
            let thrust = self.acceleration(t) + Vector3::z() * gravity;
            let tilt = Rotation3::rotation_between(&Vector3::z(), &thrust).unwrap_or_default();
            return tilt * heading;
        }
        let [amplitude, period] = self.vehicle.ground();
        let [roll, pitch] = [4, 5].map(|k| amplitude * self.wave(k, period, t));
        heading * Rotation3::from_euler_angles(roll, pitch, 0.0)
    }
}

fn normal(rng: &mut ChaCha8Rng, sd: f64) -> Vector3<f64> {
    Vector3::from_fn(|_, _| sd * rng.sample::<f64, _>(StandardNormal))
}

impl Drive {
    /// A drive of `seconds` with a gyroscope bias of any direction, up to [`LARGEST_BIAS`] long.
    pub fn new(vehicle: Vehicle, imu: &ImuConfig, seconds: f64, rng: &mut ChaCha8Rng) -> Self {
        let motion = Motion::new(vehicle, rng);
        let direction = normal(rng, 1.0).normalize();
        let mut gyro_bias = direction * rng.random_range(0.0..LARGEST_BIAS);
        let mut accel_bias = normal(rng, imu.accel_bias_sd);
        let mut position = Vector3::zeros();
        let mut drive = Self { imu: Vec::new(), truth: Vec::new(), unit_noise: Vec::new() };
        let white = STEP.sqrt();
        for k in 0..=(seconds / STEP).round() as usize {
            let t = k as f64 * STEP;
            let attitude = motion.attitude(t, imu.gravity);
            let before = motion.attitude(t - DIFFERENCE, imu.gravity);
            let after = motion.attitude(t + DIFFERENCE, imu.gravity);
            let rate = log(&(before.inverse() * after)) / (2.0 * DIFFERENCE);
            let force = motion.acceleration(t) + Vector3::z() * imu.gravity;
            drive.truth.push(NavState {
                world_from_body: Isometry3::from_parts(
                    position.into(),
                    UnitQuaternion::from_rotation_matrix(&attitude),
                ),
                velocity: motion.velocity(t),
                gyro_bias,
                accel_bias,
            });
            drive.imu.push(ImuSample {
                stamp: stamp(t),
                angular_velocity: rate + gyro_bias + normal(rng, imu.gyro_noise / white),
                specific_force: attitude.inverse() * force
                    + accel_bias
                    + normal(rng, imu.accel_noise / white),
            });
            drive.unit_noise.push(normal(rng, 1.0));
            // Simpson's rule.
            position += (motion.velocity(t)
                + motion.velocity(t + 0.5 * STEP) * 4.0
                + motion.velocity(t + STEP))
                * (STEP / 6.0);
            gyro_bias += normal(rng, imu.gyro_bias_walk * white);
            accel_bias += normal(rng, imu.accel_bias_walk * white);
        }
        drive
    }

    /// Fixes at `rate` (Hz), each axis with the standard deviation `noise`, m.
    pub fn fixes(&self, rate: f64, noise: f64) -> Vec<PositionFix> {
        let every = (1.0 / (rate * STEP)).round() as usize;
        let fix = |k: usize| {
            let position = self.truth[k].world_from_body.translation.vector;
            PositionFix {
                stamp: self.imu[k].stamp,
                position: position + self.unit_noise[k] * noise,
                covariance: None,
            }
        };
        (0..self.truth.len()).step_by(every).map(fix).collect()
    }

    /// The truth at a stamp of a fix.
    pub fn truth_at(&self, stamp: Stamp) -> Option<&NavState> {
        self.truth.get((stamp.seconds() / STEP).round() as usize)
    }
}

fn stamp(t: f64) -> Stamp {
    Stamp::from_nanos((t * 1e9).round() as i64)
}
