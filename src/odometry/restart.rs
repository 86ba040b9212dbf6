use nalgebra::{Matrix3, SVector, UnitQuaternion, Vector3};

use crate::fault::Divergence;
use crate::filter::FilterConfig;
use crate::inertial::{Belief, NavCovariance, NavState, block};
use crate::map::Map;
use crate::sensor::Stamp;

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
    pub spread: Spread,
}

/// What is unknown of where a start stands in the world of an earlier one: a turn about the
/// vertical through some place, and a shift.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Spread {
    place: Vector3<f64>,
    /// rad^2.
    heading: f64,
    /// m^2.
    position: Matrix3<f64>,
}

impl Spread {
    /// Variance of a uniformly distributed heading, rad^2.
    const ANY_HEADING: f64 = std::f64::consts::PI * std::f64::consts::PI / 3.0;

    /// What it adds to the covariance of a state's error.
    pub fn covariance(&self, state: &NavState) -> NavCovariance {
        let up = Vector3::z();
        let pose = &state.world_from_body;
        let mut turn = SVector::<f64, 15>::zeros();
        for (start, by_turn) in [
            (block::ROTATION, pose.rotation.inverse() * up),
            (block::VELOCITY, up.cross(&state.velocity)),
            (block::POSITION, up.cross(&(pose.translation.vector - self.place))),
        ] {
            turn.fixed_rows_mut::<3>(start).copy_from(&by_turn);
        }
        let mut covariance = turn * turn.transpose() * self.heading;
        let mut position = covariance.fixed_view_mut::<3, 3>(block::POSITION, block::POSITION);
        position += self.position;
        covariance
    }
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

    /// Of the new start. Without the map nothing connects it with the old one: the body was
    /// carried off, or the gyroscope that would have kept its heading may be what is wrong. It is then
    /// taken to be within `reach` (m, a standard deviation) of where the old one was last sound.
    pub fn spread(&self, reach: f64) -> Spread {
        if self.map.is_some() {
            return self.spread;
        }
        let (_, sound) = &self.sound;
        let before = self.spread.covariance(&sound.state) + sound.covariance;
        let position = before.fixed_view::<3, 3>(block::POSITION, block::POSITION);
        Spread {
            place: sound.state.world_from_body.translation.vector,
            heading: Spread::ANY_HEADING,
            position: position + Matrix3::identity() * reach.powi(2),
        }
    }

    /// The first belief of the new start, moved to where the old one was last sound and turned to
    /// its heading. In the map that it keeps it has moved since then at about `moving_velocity_sd`;
    /// the biases may be what went wrong. Without an IMU (`levelled` false) the whole attitude is the old one.
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
        if self.map.is_some() {
            add(block::ROTATION, up * up.transpose() * heading_variance);
            let position = sound.covariance.fixed_view::<3, 3>(block::POSITION, block::POSITION);
            add(block::POSITION, position + Matrix3::identity() * moved.powi(2));
        }
        if levelled {
            let first = block::GYRO_BIAS;
            let mut biases = start.covariance.fixed_view_mut::<6, 6>(first, first);
            biases *= BIAS_FACTOR.powi(2);
        }
        start
    }
}

/// On the standard deviation of the biases of a start, where they are found to be none of the sensor's.
pub(super) const BIAS_FACTOR: f64 = 10.0;

/// The turn about the vertical that brings `from` closest to `to`.
fn heading_between(to: &UnitQuaternion<f64>, from: &UnitQuaternion<f64>) -> UnitQuaternion<f64> {
    let between = (to * from.inverse()).to_rotation_matrix();
    let angle = f64::atan2(between[(1, 0)] - between[(0, 1)], between[(0, 0)] + between[(1, 1)]);
    UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::MapConfig;
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
        let mut legacy = Legacy {
            sound,
            attitude: old.rotation,
            map: Some(Map::new(&MapConfig::default())),
            seeing_frames: 0,
            last_sample: None,
            spread: Spread::default(),
        };
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
        assert_eq!(legacy.spread(3.0), Spread::default());

        // Without the map the start is as certain of itself as any, and lost in the old world.
        legacy.map = None;
        let alone = legacy.place(belief(level, 1e-4), time, true, &config);
        assert_relative_eq!(alone.covariance[(block::POSITION, block::POSITION)], 1e-4);
        let spread = legacy.spread(3.0).covariance(&placed.state);
        let heading = up.dot(&(spread.fixed_view::<3, 3>(0, 0) * up)).sqrt().to_degrees();
        assert_relative_eq!(heading, 103.9, epsilon = 0.1);
        let position = spread[(block::POSITION, block::POSITION)];
        assert_relative_eq!(position, 9.01, epsilon = 1e-9);
    }

    /// A turn of the world, made large, by finite differences.
    #[test]
    fn a_spread_heading_turns_the_whole_state() {
        let pose = Isometry3::new(Vector3::new(1.0, 2.0, 3.0), Vector3::new(0.2, -0.1, 1.5));
        let velocity = Vector3::new(0.4, -0.2, 0.1);
        let state = NavState { velocity, ..belief(pose, 1.0).state };
        let place = Vector3::new(0.5, 1.0, -1.0);
        let angle = 1e-6;
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle);
        let position = place + turn * (pose.translation.vector - place);
        let turned = turn * pose.rotation;
        let mut error = SVector::<f64, 15>::zeros();
        for (start, part) in [
            (block::ROTATION, (pose.rotation.inverse() * turned).scaled_axis()),
            (block::VELOCITY, turn * velocity - velocity),
            (block::POSITION, position - pose.translation.vector),
        ] {
            error.fixed_rows_mut::<3>(start).copy_from(&(part / angle));
        }
        let spread = Spread { place, heading: 2.0, position: Matrix3::zeros() };
        let expected = error * error.transpose() * 2.0;
        assert_relative_eq!(spread.covariance(&state), expected, epsilon = 1e-5);
    }
}
