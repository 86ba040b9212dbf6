//! What moves in the view.

use super::sequential::{Cusum, cusum_threshold};
use super::{Fault, FaultConfig, Monitor, Verdict};
use crate::sensor::Stamp;

/// What the tracks of one image agree on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackEvidence {
    pub matches: usize,
    /// Of those, the ones that agree on the camera's pose.
    pub inliers: usize,
    /// Of the others, the ones that agree on a second motion.
    pub second: usize,
    /// The usual time between images, s.
    pub interval: f64,
}

/// Tells a scene of which a large part moves by itself.
///
/// A second motion is seen in a frame if at least [`Self::MANY`] tracks agree on it, and a share of all that
/// do not follow the camera: with probability `p0` in a scene at rest, where calibration and depth are a little
/// wrong, `p1` with something that moves.
#[derive(Debug, Clone)]
pub struct SceneMotion {
    config: FaultConfig,
    sum: Cusum,
}

impl SceneMotion {
    /// Fewer tracks agree on some motion by chance.
    const MANY: usize = 30;
    const SHARE: f64 = 0.2;
    const AT_REST: f64 = 0.02;
    const MOVING: f64 = 0.7;

    pub fn new(config: &FaultConfig) -> Self {
        Self { config: config.clone(), sum: Cusum::default() }
    }
}

impl Monitor for SceneMotion {
    type Evidence = TrackEvidence;

    fn observe(&mut self, at: Stamp, tracks: &TrackEvidence) -> Verdict {
        let astray = tracks.matches.saturating_sub(tracks.inliers) as f64;
        let moves = tracks.second >= Self::MANY && tracks.second as f64 >= Self::SHARE * astray;
        let log_ratio = match moves {
            true => (Self::MOVING / Self::AT_REST).ln(),
            false => ((1.0 - Self::MOVING) / (1.0 - Self::AT_REST)).ln(),
        };
        let threshold = cusum_threshold(self.config.false_alarms_per_hour, tracks.interval);
        let statistic = self.sum.add(at, log_ratio, threshold);
        Verdict::by(statistic, Fault::DynamicScene, self.sum.since().unwrap_or(at))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn something_that_moves_is_told_soon_and_a_few_outliers_are_not() {
        let told = |second: fn(usize) -> usize| {
            let mut monitor = SceneMotion::new(&FaultConfig::default());
            (0..300).find(|k| {
                let tracks = TrackEvidence {
                    matches: 300,
                    inliers: 200,
                    second: second(*k),
                    interval: 0.033,
                };
                let at = Stamp::default().offset_by(*k as f64 * 0.033);
                monitor.observe(at, &tracks).confirmed().is_some()
            })
        };
        assert!((100..108).contains(&told(|k| if k >= 100 { 60 } else { 5 }).unwrap()));
        assert_eq!(told(|k| if k % 4 == 0 { 60 } else { 12 }), None);
        assert_eq!(told(|_| 19), None);
    }
}
