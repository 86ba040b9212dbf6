//! Reference poses as they arrive: looked up by time, brought to a z-up world.

use std::collections::VecDeque;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::inertial::attitude_from_gravity;
use crate::sensor::{Stamp, TruthPose};

/// How the reference is to be read.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TruthConfig {
    /// Direction of "up" in the reference's world: a vector, or `"auto"` for the mean specific
    /// force that the IMU feels there.
    pub up: Up,
    /// Added to the reference's stamps to bring them to the sensors' clock, s.
    pub time_offset: f64,
    /// Reference poses further apart than this are not interpolated between, s.
    pub max_gap: f64,
}

impl Default for TruthConfig {
    fn default() -> Self {
        Self { up: Up::Vector([0.0, 0.0, 1.0]), time_offset: 0.0, max_gap: 0.1 }
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "a vector of three numbers or \"auto\"")]
pub enum Up {
    Vector([f64; 3]),
    Auto(Auto),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Auto {
    #[serde(rename = "auto")]
    Auto,
}

/// The reference poses seen so far.
#[derive(Debug, Clone, Default)]
pub struct TruthTrack {
    poses: VecDeque<TruthPose>,
}

/// Reference poses older than this behind the newest are dropped, s.
const KEPT: f64 = 30.0;

impl TruthTrack {
    /// Appends a pose; one that does not advance the time is ignored.
    pub fn push(&mut self, pose: TruthPose) {
        if self.poses.back().is_none_or(|last| last.stamp < pose.stamp) {
            self.poses.push_back(pose);
        }
        while let (Some(first), Some(last)) = (self.poses.front(), self.poses.back()) {
            if last.stamp.seconds_since(first.stamp) <= KEPT {
                break;
            }
            self.poses.pop_front();
        }
    }

    pub fn newest(&self) -> Option<Stamp> {
        self.poses.back().map(|pose| pose.stamp)
    }

    /// The pose at `stamp`, interpolated (linearly, and along the geodesic of SO(3)) between
    /// neighbours at most `max_gap` seconds apart.
    pub fn at(&self, stamp: Stamp, max_gap: f64) -> Option<Isometry3<f64>> {
        let after = self.poses.partition_point(|pose| pose.stamp < stamp);
        let next = self.poses.get(after)?;
        if next.stamp == stamp {
            return Some(next.world_from_body);
        }
        let previous = self.poses.get(after.checked_sub(1)?)?;
        let gap = next.stamp.seconds_since(previous.stamp);
        if gap > max_gap {
            return None;
        }
        let fraction = stamp.seconds_since(previous.stamp) / gap;
        let (a, b) = (previous.world_from_body, next.world_from_body);
        let turn = (a.rotation.inverse() * b.rotation).scaled_axis() * fraction;
        let position = a.translation.vector.lerp(&b.translation.vector, fraction);
        let rotation = a.rotation * UnitQuaternion::from_scaled_axis(turn);
        Some(Isometry3::from_parts(Translation3::from(position), rotation))
    }

    /// Velocity at `stamp` in the reference's world (m/s), by a difference over `span` seconds.
    pub fn velocity(&self, stamp: Stamp, span: f64, max_gap: f64) -> Option<Vector3<f64>> {
        let at = |offset: f64| self.at(stamp.offset_by(offset), max_gap);
        let (from, from_time) = match at(-0.5 * span) {
            Some(pose) => (pose, -0.5 * span),
            None => (at(0.0)?, 0.0),
        };
        let (to, to_time) = match at(0.5 * span) {
            Some(pose) => (pose, 0.5 * span),
            None => (at(0.0)?, 0.0),
        };
        let time = to_time - from_time;
        (time > 0.0).then(|| (to.translation.vector - from.translation.vector) / time)
    }
}

/// Rotation that makes the z axis point along `up` of the reference's world, by the shortest
/// way; `None` if `up` has no direction.
pub fn z_up_from_reference(up: &Vector3<f64>) -> Option<UnitQuaternion<f64>> {
    attitude_from_gravity(up)
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;

    fn track() -> TruthTrack {
        let mut track = TruthTrack::default();
        for k in 0..10 {
            let t = f64::from(k) * 0.01;
            let pose = Isometry3::new(Vector3::new(t, 0.0, 2.0 * t), Vector3::z() * (3.0 * t));
            track.push(TruthPose {
                stamp: Stamp::from_nanos(k as i64 * 10_000_000),
                world_from_body: pose,
            });
        }
        track
    }

    #[test]
    fn poses_and_velocity_are_interpolated() {
        let track = track();
        let pose = track.at(Stamp::from_nanos(25_000_000), 0.1).unwrap();
        assert_relative_eq!(
            pose.translation.vector,
            Vector3::new(0.025, 0.0, 0.05),
            epsilon = 1e-12
        );
        assert_relative_eq!(pose.rotation.angle(), 0.075, epsilon = 1e-12);
        for nanos in [0, 40_000_000, 90_000_000] {
            let velocity = track.velocity(Stamp::from_nanos(nanos), 0.02, 0.1).unwrap();
            assert_relative_eq!(velocity, Vector3::new(1.0, 0.0, 2.0), epsilon = 1e-9);
        }
    }

    #[test]
    fn nothing_is_made_up_outside_or_in_gaps() {
        let mut track = track();
        assert!(track.at(Stamp::from_nanos(-1), 0.1).is_none());
        assert!(track.at(Stamp::from_nanos(91_000_000), 0.1).is_none());
        track.push(TruthPose {
            stamp: Stamp::from_nanos(1_000_000_000),
            world_from_body: Isometry3::identity(),
        });
        assert!(track.at(Stamp::from_nanos(500_000_000), 0.1).is_none());
        assert!(track.at(Stamp::from_nanos(500_000_000), 1.0).is_some());
    }
}
