//! Turns of the body by the gyroscope, and by images.

use std::collections::VecDeque;

use nalgebra::{UnitQuaternion, Vector3};

use super::Turn;
use crate::sensor::{ImuSample, Stamp};

/// The last samples of the IMU.
#[derive(Debug, Clone, Default)]
pub struct GyroscopeTrack {
    samples: VecDeque<ImuSample>,
}

impl GyroscopeTrack {
    /// Samples that are kept, s: a frame waits for the IMU for at most a second.
    const MEMORY: f64 = 2.0;

    pub fn push(&mut self, sample: ImuSample) {
        let old = |s: &ImuSample| sample.stamp.seconds_since(s.stamp) > Self::MEMORY;
        while self.samples.front().is_some_and(old) {
            self.samples.pop_front();
        }
        self.samples.push_back(sample);
    }

    pub fn samples(&self) -> impl Iterator<Item = &ImuSample> {
        self.samples.iter()
    }

    pub fn newest(&self) -> Option<Stamp> {
        self.samples.back().map(|sample| sample.stamp)
    }

    /// Readings between two times with the lengths of their intervals, s; `None` if the samples do not
    /// cover them.
    fn readings(
        &self,
        from: Stamp,
        to: Stamp,
    ) -> Option<impl Iterator<Item = (Vector3<f64>, f64)> + '_> {
        let covered = self.samples.front()?.stamp <= from && self.samples.back()?.stamp >= to;
        let first = self.samples.partition_point(|sample| sample.stamp <= from).saturating_sub(1);
        let readings = (self.samples.range(first..))
            .zip(self.samples.range(first..).skip(1))
            .take_while(move |(before, _)| before.stamp < to)
            .filter_map(move |(before, after)| {
                let (start, end) = (before.stamp.max(from), after.stamp.min(to));
                let seconds = end.seconds_since(start);
                let middle = || ImuSample::between(before, after, start.offset_by(0.5 * seconds));
                (seconds > 0.0).then(|| (middle().angular_velocity, seconds))
            });
        covered.then_some(readings)
    }

    /// The turn between two times, as a rotation.
    pub fn turned(
        &self,
        from: Stamp,
        to: Stamp,
        bias: &Vector3<f64>,
    ) -> Option<UnitQuaternion<f64>> {
        let step = |turn, (rate, seconds): (Vector3<f64>, f64)| {
            turn * UnitQuaternion::from_scaled_axis((rate - bias) * seconds)
        };
        Some(self.readings(from, to)?.fold(UnitQuaternion::identity(), step))
    }

    /// The integral of the readings, rad: that of a gyroscope in other units may be several turns.
    pub fn integral(&self, from: Stamp, to: Stamp, bias: &Vector3<f64>) -> Option<Vector3<f64>> {
        Some(self.readings(from, to)?.map(|(rate, seconds)| (rate - bias) * seconds).sum())
    }

    /// The reading nearest to a time within the samples.
    pub fn rate(&self, at: Stamp) -> Option<Vector3<f64>> {
        let after = self.samples.partition_point(|sample| sample.stamp < at);
        self.samples.get(after).map(|sample| sample.angular_velocity)
    }
}

/// Attitudes that images show one after the other.
#[derive(Debug, Clone, Copy, Default)]
pub struct AttitudeTrack {
    last: Option<(Stamp, UnitQuaternion<f64>)>,
    rate: Vector3<f64>,
}

impl AttitudeTrack {
    /// Frames further apart are not compared, s: a wrong gyroscope may have turned any number of times.
    const LONGEST: f64 = 0.2;

    /// The turn since the last image that showed an attitude, by images and gyroscope.
    pub fn turn(
        &mut self,
        at: Stamp,
        world_from_body: UnitQuaternion<f64>,
        gyroscope: &GyroscopeTrack,
        bias: &Vector3<f64>,
    ) -> Option<Turn> {
        let (from, before) = self.last.replace((at, world_from_body))?;
        let seconds = at.seconds_since(from);
        if !(seconds > 0.0 && seconds <= Self::LONGEST) {
            return None;
        }
        let seen = (before.inverse() * world_from_body).scaled_axis();
        self.rate = seen / seconds;
        Some(Turn {
            seconds,
            seen,
            felt: gyroscope.integral(from, at, bias)?,
            rate_change: gyroscope.rate(at)? - gyroscope.rate(from)?,
        })
    }

    /// Angular velocity of the body between the last two images that were compared, rad/s.
    pub fn rate(&self) -> Vector3<f64> {
        self.rate
    }

    /// The world has been turned: attitudes before are others in it.
    pub fn turn_world(&mut self, turn: &UnitQuaternion<f64>) {
        self.last = self.last.map(|(at, attitude)| (at, turn * attitude));
    }

    /// The next attitude does not follow the last one: the map has been turned, or the clock set.
    pub fn interrupt(&mut self) {
        self.last = None;
    }
}
