//! Whether a pose at which the map is seen again, far from where the body can be, is to be believed.

use crate::filter::{FilterConfig, PoseSpread};
use crate::tracking::InView;

/// Of the points of the state that a pose puts in view this share must be seen there. Matches that
/// look alike by chance agree on poses, too, but there the other points are not seen.
const SHARE_SEEN: f64 = 0.5;
/// Fewer points of the state in view than this tell nothing; then so many matches must agree.
const TELLING: usize = 8;
const MANY_AGREE: usize = 30;

/// Whether so much is seen that a pose is the right one.
pub(super) fn confirms(seen: &InView) -> bool {
    if seen.expected >= TELLING {
        seen.seen as f64 >= SHARE_SEEN * seen.expected as f64
    } else {
        seen.agreeing >= MANY_AGREE
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

    #[test]
    fn few_points_and_few_of_many_confirm_nothing() {
        let confirms =
            |agreeing, expected, seen| super::confirms(&InView { agreeing, expected, seen });
        assert!(confirms(8, 8, 4) && confirms(12, 60, 30) && confirms(30, 7, 0));
        assert!(!confirms(29, 7, 7) && !confirms(100, 60, 29) && !confirms(8, 0, 0));
    }
}
