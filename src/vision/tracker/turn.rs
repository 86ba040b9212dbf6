//! The turn of the camera between two frames, by the gyroscope.

use std::collections::VecDeque;

use nalgebra::{UnitQuaternion, Vector3};

use crate::inertial::ImuConfig;
use crate::sensor::{CameraConfig, ImuSample, Stamp};

/// Samples older than this before the latest one are forgotten, s.
const MEMORY: f64 = 2.0;
/// What consumer gyroscopes are off in scale and axes, as a share of the turn.
const SCALE_ERROR: f64 = 0.01;

/// A turn, and how well it is known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Turn {
    /// Maps directions in the camera at the former frame to those at the latter.
    pub rotation: UnitQuaternion<f64>,
    /// Standard deviation of each component, rad.
    pub sigma: f64,
    /// Angular velocity (camera coordinates, rad/s) at the former and at the latter frame.
    pub rates: [Vector3<f64>; 2],
}

/// Integrates the gyroscope, its bias taken for zero.
pub(super) struct Gyroscope {
    samples: VecDeque<(Stamp, Vector3<f64>)>,
    camera_from_body: UnitQuaternion<f64>,
    time_offset: f64,
    imu: ImuConfig,
}

impl Gyroscope {
    pub fn new(camera: &CameraConfig, imu: &ImuConfig) -> Option<Self> {
        Some(Self {
            samples: VecDeque::new(),
            camera_from_body: camera.imu_from_camera()?.rotation.inverse(),
            time_offset: camera.time_offset,
            imu: imu.clone(),
        })
    }

    /// Samples come in order of time; one that does not begins anew.
    pub fn push(&mut self, sample: &ImuSample) {
        let rate = self.camera_from_body * sample.angular_velocity;
        if !rate.iter().all(|x| x.is_finite()) {
            return;
        }
        if self.samples.back().is_some_and(|(stamp, _)| *stamp >= sample.stamp) {
            self.samples.clear();
        }
        self.samples.push_back((sample.stamp, rate));
        let is_old = |(stamp, _): &(Stamp, _)| sample.stamp.seconds_since(*stamp) > MEMORY;
        while self.samples.front().is_some_and(is_old) {
            self.samples.pop_front();
        }
    }

    /// From the frame stamped `from` to that stamped `to`; `None` unless samples without a gap reach
    /// from the one to the other. The rate is that of the nearest samples; it is held for as long as
    /// a gap may be where samples do not quite reach the latter frame.
    pub fn turn(&self, from: Stamp, to: Stamp) -> Option<Turn> {
        let (from, to) = (from.offset_by(self.time_offset), to.offset_by(self.time_offset));
        let duration = to.seconds_since(from);
        if duration <= 0.0 {
            return None;
        }
        // The last sample before the interval, or the first one of all.
        let start = self.samples.partition_point(|(stamp, _)| *stamp <= from).saturating_sub(1);
        let mut rotation = UnitQuaternion::identity();
        let (mut stamp, mut rate) = *self.samples.get(start)?;
        if stamp.seconds_since(from) > self.imu.max_gap {
            return None;
        }
        let mut at = from;
        let mut rates = [rate; 2];
        for (next, next_rate) in self.samples.range(start + 1..) {
            if next.seconds_since(stamp) > self.imu.max_gap {
                return None;
            }
            let mean = 0.5 * (rate + next_rate);
            let until = (*next).min(to);
            rotation *= UnitQuaternion::from_scaled_axis(mean * until.seconds_since(at).max(0.0));
            if at == from {
                rates[0] = mean;
            }
            (at, stamp, rate, rates[1]) = (until.max(from), *next, *next_rate, mean);
            if stamp >= to {
                break;
            }
        }
        let missing = to.seconds_since(at);
        if missing > self.imu.max_gap {
            return None;
        }
        rotation *= UnitQuaternion::from_scaled_axis(rate * missing);
        let white = self.imu.gyro_noise * duration.sqrt();
        let bias = self.imu.gyro_bias_sd * duration;
        let scale = SCALE_ERROR * rotation.angle();
        let sigma = white.hypot(bias).hypot(scale);
        Some(Turn { rotation: rotation.inverse(), sigma, rates })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;

    fn at(seconds: f64) -> Stamp {
        Stamp::default().offset_by(seconds)
    }

    fn sample(seconds: f64, rate: Vector3<f64>) -> ImuSample {
        ImuSample { stamp: at(seconds), angular_velocity: rate, specific_force: Vector3::zeros() }
    }

    fn gyroscope(time_offset: f64) -> Gyroscope {
        let camera = CameraConfig { time_offset, ..CameraConfig::default() };
        Gyroscope::new(&camera, &ImuConfig::default()).unwrap()
    }

    #[test]
    fn a_direction_turns_against_the_camera() {
        let mut gyroscope = gyroscope(0.0);
        (0..100).for_each(|k| gyroscope.push(&sample(0.01 * f64::from(k), Vector3::y() * 0.8)));
        let turn = gyroscope.turn(at(0.333), at(0.366)).unwrap();
        // Turned to the right about y, which points down, things ahead move to the left.
        assert_relative_eq!(turn.rotation.angle(), 0.8 * 0.033, epsilon = 1e-9);
        assert!((turn.rotation * Vector3::z()).x < 0.0);
        assert_relative_eq!(turn.rates[1], Vector3::y() * 0.8);
        assert!(turn.sigma > 0.01 * 0.033 && turn.sigma < 0.002);
    }

    #[test]
    fn changing_rates_are_integrated_over_the_interval_alone() {
        let mut gyroscope = gyroscope(0.1);
        let angle = |t: f64| 0.5 * t * t;
        (0..300).for_each(|k| {
            let t = 0.005 * f64::from(k);
            gyroscope.push(&sample(t, Vector3::z() * t));
        });
        for (from, to) in [(0.2, 0.24), (0.203, 0.2413), (0.9, 1.2)] {
            let turn = gyroscope.turn(at(from), at(to)).unwrap();
            let expected = angle(to + 0.1) - angle(from + 0.1);
            assert!((turn.rotation.angle() - expected).abs() < 2e-5, "{from} {to}");
        }
    }

    #[test]
    fn without_samples_there_is_no_turn() {
        let mut gyroscope = gyroscope(0.0);
        assert_eq!(gyroscope.turn(at(0.0), at(0.03)), None);
        (0..20).for_each(|k| gyroscope.push(&sample(0.01 * f64::from(k), Vector3::x())));
        assert!(gyroscope.turn(at(0.1), at(0.25)).is_some(), "the rate is held");
        assert_eq!(gyroscope.turn(at(0.1), at(0.4)), None);
        assert_eq!(gyroscope.turn(at(0.1), at(0.1)), None);
        gyroscope.push(&sample(1.0, Vector3::x()));
        assert_eq!(gyroscope.turn(at(0.15), at(0.95)), None, "a gap");
        gyroscope.push(&sample(0.5, Vector3::x()));
        assert_eq!(gyroscope.turn(at(0.1), at(0.15)), None, "the clock was set back");
    }
}
