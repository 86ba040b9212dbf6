use nalgebra::{Matrix3, UnitQuaternion, Vector3};

use super::health::Divergence;
use crate::filter::FilterConfig;
use crate::inertial::{Belief, Stamp, block};
use crate::map::Map;

/// What an estimate that has diverged leaves to the one that starts in its place.
pub(super) struct Legacy {
    /// The last belief that nothing spoke against, and its time.
    pub sound: (Stamp, Belief),
    /// Attitude in the end. The gyroscope has carried its heading, whatever went wrong.
    pub attitude: UnitQuaternion<f64>,
    /// Kept unless the belief contradicts it.
    pub map: Option<Map>,
    pub seeing_frames: u64,
    pub last_sample: Option<Stamp>,
}

impl Legacy {
    /// Whether an estimate that diverged so takes its map along: not if one of the two is wrong
    /// and nobody knows which, nor if it was searched in vain.
    pub fn keeps_map(divergence: Divergence) -> bool {
        match divergence {
            Divergence::Speed | Divergence::Position => true,
            Divergence::Innovation | Divergence::View => false,
        }
    }

    /// The first belief of the new start, moved to where the old one was last sound and turned to
    /// its heading. Since then the body has moved at about `moving_velocity_sd`; the biases may be
    /// what went wrong. Without an IMU (`levelled` false) the whole attitude is the old one.
    pub fn place(
        &self,
        mut start: Belief,
        time: Stamp,
        levelled: bool,
        config: &FilterConfig,
    ) -> Belief {
        let (sound_at, sound) = &self.sound;
        let pose = &mut start.state.world_from_body;
        pose.rotation = match levelled {
            true => heading_between(&self.attitude, &pose.rotation) * pose.rotation,
            false => self.attitude,
        };
        pose.translation = sound.state.world_from_body.translation;
        let up = pose.rotation.inverse() * Vector3::z();
        let heading_variance = config.moving_tilt_sd_deg.to_radians().powi(2);
        let moved = config.moving_velocity_sd * time.seconds_since(*sound_at);
        let mut add = |start_row: usize, variance: Matrix3<f64>| {
            let mut part = start.covariance.fixed_view_mut::<3, 3>(start_row, start_row);
            part += variance;
        };
        add(block::ROTATION, up * up.transpose() * heading_variance);
        let sound_position = sound.covariance.fixed_view::<3, 3>(block::POSITION, block::POSITION);
        add(block::POSITION, sound_position + Matrix3::identity() * moved.powi(2));
        if levelled {
            let first = block::GYRO_BIAS;
            let mut biases = start.covariance.fixed_view_mut::<6, 6>(first, first);
            biases *= BIAS_FACTOR.powi(2);
        }
        start
    }
}

/// On the standard deviation of the biases of a start.
const BIAS_FACTOR: f64 = 10.0;

/// The turn about the vertical that brings `from` closest to `to`.
fn heading_between(to: &UnitQuaternion<f64>, from: &UnitQuaternion<f64>) -> UnitQuaternion<f64> {
    let between = (to * from.inverse()).to_rotation_matrix();
    let angle = f64::atan2(between[(1, 0)] - between[(0, 1)], between[(0, 0)] + between[(1, 1)]);
    UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::inertial::{NavCovariance, NavState};
    use approx::assert_relative_eq;
    use nalgebra::Isometry3;

    fn belief(world_from_body: Isometry3<f64>, variance: f64) -> Belief {
        let zero = Vector3::zeros();
        let state = NavState { world_from_body, velocity: zero, gyro_bias: zero, accel_bias: zero };
        Belief { state, covariance: NavCovariance::identity() * variance }
    }

    #[test]
    fn a_new_start_goes_on_where_the_old_one_was_sound() {
        let old = Isometry3::new(Vector3::new(1.0, 2.0, 3.0), Vector3::new(0.2, -0.1, 1.5));
        let sound = (Stamp::default(), belief(old, 0.01));
        let (map, seeing_frames, last_sample) = (None, 0, None);
        let legacy = Legacy { sound, attitude: old.rotation, map, seeing_frames, last_sample };
        // Levelled rightly, with another heading.
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), -2.3);
        let level = Isometry3::from_parts(Vector3::zeros().into(), turn * old.rotation);
        let config = FilterConfig::default();
        let time = Stamp::default().offset_by(2.0);
        let placed = legacy.place(belief(level, 1e-4), time, true, &config);
        assert_relative_eq!(placed.state.world_from_body, old, epsilon = 1e-12);
        let position = placed.covariance[(block::POSITION, block::POSITION)];
        let moved = 2.0 * config.moving_velocity_sd;
        assert_relative_eq!(position, 1e-4 + 0.01 + moved.powi(2), epsilon = 1e-12);
        let rotation = placed.covariance.fixed_view::<3, 3>(0, 0);
        let up = old.rotation.inverse() * Vector3::z();
        let heading = up.dot(&(rotation * up)).sqrt().to_degrees();
        assert_relative_eq!(heading, config.moving_tilt_sd_deg, max_relative = 0.01);
    }
}
