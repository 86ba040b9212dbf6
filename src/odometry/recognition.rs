//! Whether a pose at which the map is seen again, far from where the body can be, is to be believed.

use nalgebra::Isometry3;

use super::report::{Note, NoteLevel};
use super::watch::{MAX_FORCE, MAX_RATE};
use crate::filter::{FilterConfig, PoseSpread};
use crate::inertial::NavState;
use crate::sensor::Stamp;
use crate::tracking::InView;

/// A pose of few matches may be off by so much, m and rad.
const SLACK: (f64, f64) = (0.1, 0.1);
/// Of the points of the state that a pose puts in view this share must be seen there. Matches that
/// look alike by chance agree on poses, too, but there the other points are not seen.
const SHARE_SEEN: f64 = 0.5;
/// Fewer points of the state in view than this tell nothing; then so many matches must agree.
const TELLING: usize = 8;
const MANY_AGREE: usize = 30;
/// Forces as large last no longer than an impact, s.
const FRAME: f64 = 0.034;

/// Whether so much is seen that a pose is the right one.
pub(super) fn confirms(seen: &InView) -> bool {
    if seen.expected >= TELLING {
        seen.seen as f64 >= SHARE_SEEN * seen.expected as f64
    } else {
        seen.agreeing >= MANY_AGREE
    }
}

/// A way that no body goes by itself: it was carried off while the sensors were silent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Jump {
    /// m.
    shift: f64,
    /// rad.
    turn: f64,
}

impl Jump {
    /// From `before` to `world_from_body` in `seconds`; `None` if what moves a body can bring it
    /// there. The IMU is not asked: it may be what is wrong. If it was not `in_the_dark` meanwhile,
    /// forces have acted for the time of a frame only, or it would have been seen on its way.
    pub fn between(
        before: &NavState,
        world_from_body: &Isometry3<f64>,
        seconds: f64,
        in_the_dark: bool,
    ) -> Option<Self> {
        let unseen = if in_the_dark { seconds } else { seconds.min(FRAME) };
        let way = before.world_from_body.inv_mul(world_from_body);
        let (shift, turn) = (way.translation.vector.norm(), way.rotation.angle());
        let coasting = before.velocity.norm() * seconds;
        let within = shift <= SLACK.0 + coasting + 0.5 * MAX_FORCE * unseen.powi(2)
            && turn <= SLACK.1 + MAX_RATE * unseen;
        (!within).then_some(Self { shift, turn })
    }

    pub fn note(&self, stamp: Stamp, seen: InView) -> Note {
        let text = format!(
            "carried off at {stamp} s: the map is seen from {:.2} m and {:.0} deg away ({} matches \
             agree; of {} points that should be in view {} are)",
            self.shift,
            self.turn.to_degrees(),
            seen.agreeing,
            seen.expected,
            seen.seen
        );
        Note { level: NoteLevel::Warning, text }
    }
}

/// What is unknown of a body that has been carried off, at a pose that matches agree on: far more than
/// they leave open, so that what they tell is not told twice.
pub(super) fn spread_of_recognition(config: &FilterConfig) -> PoseSpread {
    PoseSpread { turn: 0.2, shift: 0.5, velocity: config.moving_velocity_sd }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn few_points_and_few_of_many_confirm_nothing() {
        let confirms =
            |agreeing, expected, seen| super::confirms(&InView { agreeing, expected, seen });
        assert!(confirms(8, 8, 4) && confirms(12, 60, 30) && confirms(30, 7, 0));
        assert!(!confirms(29, 7, 7) && !confirms(100, 60, 29) && !confirms(8, 0, 0));
    }

    #[test]
    fn no_force_explains_a_jump() {
        let zero = Vector3::zeros();
        let state = NavState {
            world_from_body: Isometry3::new(Vector3::x(), Vector3::y()),
            velocity: Vector3::x(),
            gyro_bias: zero,
            accel_bias: zero,
        };
        let jumps = |shift: f64, turn: f64, seconds: f64, in_the_dark: bool| {
            let way = Isometry3::new(Vector3::x() * shift, Vector3::y() * turn);
            Jump::between(&state, &(state.world_from_body * way), seconds, in_the_dark).is_some()
        };
        // A quick hand, and a gyroscope's full range.
        assert!(!jumps(0.0, 0.0, 0.033, false) && !jumps(0.2, 0.7, 0.033, false));
        assert!(jumps(0.4, 0.0, 0.033, false) && jumps(0.0, 0.9, 0.033, false));
        // In a second of darkness it may have gone anywhere.
        assert!(!jumps(5.0, 3.0, 1.0, true) && jumps(5.0, 3.0, 1.0, false));
    }
}
