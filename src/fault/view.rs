//! The view: too dark, or partly covered.

use nalgebra::Point2;

use super::sequential::{Cusum, cusum_threshold};
use super::{Fault, FaultConfig, Monitor, Verdict};
use crate::sensor::Stamp;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewEvidence {
    /// Features detected in the image.
    pub features: usize,
    /// The usual time between images, s.
    pub interval: f64,
}

/// Tells an image with too few features to see by.
///
/// Their number is Poisson with mean `min_features` or more in a sound view and a sixth of that in one that
/// shows too little; features come in clusters, which divides the log-likelihood ratio
/// `n ln(m1/m0) + m0 - m1` by [`Self::CLUSTER`].
#[derive(Debug, Clone)]
pub struct Darkening {
    config: FaultConfig,
    sum: Cusum,
}

impl Darkening {
    const SHARE: f64 = 1.0 / 6.0;
    const CLUSTER: f64 = 5.0;

    pub fn new(config: &FaultConfig) -> Self {
        Self { config: config.clone(), sum: Cusum::default() }
    }
}

impl Monitor for Darkening {
    type Evidence = ViewEvidence;

    fn observe(&mut self, at: Stamp, view: &ViewEvidence) -> Verdict {
        let enough = self.config.min_features as f64;
        let seen = view.features as f64;
        let log_ratio = seen * Self::SHARE.ln() + enough * (1.0 - Self::SHARE);
        let threshold = cusum_threshold(self.config.false_alarms_per_hour, view.interval);
        let statistic = self.sum.add(at, log_ratio / Self::CLUSTER, threshold);
        Verdict::by(statistic, Fault::Darkness, self.sum.since().unwrap_or(at))
    }
}

/// What became of the points of the map in one part of an image.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Region {
    /// Seen just before, and predicted to be there now.
    pub expected: usize,
    /// Of those, seen now.
    pub found: usize,
    /// Features detected there.
    pub features: usize,
}

/// Tells a view that is partly covered.
///
/// A part of the image is blocked if points that were seen just before are expected there and neither one of
/// them nor any other feature is. `ln p1/p0` for each blocked part, `ln (1-p1)/(1-p0)` for each in which points
/// are found; where nothing is expected nothing is told: a wall without texture covers nothing.
#[derive(Debug, Clone)]
pub struct Obstruction {
    config: FaultConfig,
    sum: Cusum,
}

impl Obstruction {
    /// Parts of the image, across and down.
    pub const PARTS: (usize, usize) = (4, 3);
    /// Probabilities that a part is blocked in a sound view, and in one that is covered.
    const SOUND: f64 = 0.02;
    const COVERED: f64 = 0.4;
    /// Fewer points than this may be lost by chance.
    const LEAST: usize = 3;
    /// Most that one image may tell: blur takes features from many parts at once.
    const MOST: f64 = 6.0;

    pub fn new(config: &FaultConfig) -> Self {
        Self { config: config.clone(), sum: Cusum::default() }
    }

    /// The part of an image of this size (width, height, pixels) that a place is in.
    pub fn part(column: f64, row: f64, size: (usize, usize)) -> usize {
        let part = |at: f64, length: usize, parts: usize| {
            let part = (at / length.max(1) as f64 * parts as f64).max(0.0) as usize;
            part.min(parts - 1)
        };
        let (across, down) = Self::PARTS;
        part(row, size.1, down) * across + part(column, size.0, across)
    }

    /// The parts of an image of this size (pixels) by the features detected in it and the points that
    /// were expected, with whether each was found.
    pub fn regions(
        features: impl Iterator<Item = Point2<f64>>,
        expected: impl Iterator<Item = (Point2<f64>, bool)>,
        size: (usize, usize),
    ) -> Vec<Region> {
        let mut regions = vec![Region::default(); Self::parts()];
        for pixel in features {
            regions[Self::part(pixel.x, pixel.y, size)].features += 1;
        }
        for (pixel, found) in expected {
            let region = &mut regions[Self::part(pixel.x, pixel.y, size)];
            region.expected += 1;
            region.found += usize::from(found);
        }
        regions
    }

    pub const fn parts() -> usize {
        Self::PARTS.0 * Self::PARTS.1
    }
}

impl Monitor for Obstruction {
    /// The parts of one image, and the usual time between images, s.
    type Evidence = (Vec<Region>, f64);

    fn observe(&mut self, at: Stamp, (parts, interval): &Self::Evidence) -> Verdict {
        let expecting = parts.iter().filter(|part| part.expected >= Self::LEAST);
        let blocked = expecting.clone().filter(|part| part.features == 0).count() as f64;
        let open = expecting.filter(|part| part.found > 0).count() as f64;
        let log_ratio = blocked * (Self::COVERED / Self::SOUND).ln()
            + open * ((1.0 - Self::COVERED) / (1.0 - Self::SOUND)).ln();
        // A view without any open part is dark, not covered.
        let log_ratio = if open > 0.0 { log_ratio.min(Self::MOST) } else { 0.0 };
        let threshold = cusum_threshold(self.config.false_alarms_per_hour, *interval);
        let statistic = self.sum.add(at, log_ratio, threshold);
        Verdict::by(statistic, Fault::Occlusion, self.sum.since().unwrap_or(at))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const INTERVAL: f64 = 1.0 / 30.0;

    fn at(frame: usize) -> Stamp {
        Stamp::default().offset_by(frame as f64 * INTERVAL)
    }

    fn dark(features: impl Fn(usize) -> usize) -> Option<usize> {
        let mut monitor = Darkening::new(&FaultConfig::default());
        (0..300).find(|k| {
            let view = ViewEvidence { features: features(*k), interval: INTERVAL };
            monitor.observe(at(*k), &view).confirmed().is_some()
        })
    }

    #[test]
    fn darkness_is_told_within_a_fifth_of_a_second() {
        assert_eq!(dark(|k| if k < 200 { 300 } else { 0 }), Some(203));
        assert_eq!(dark(|k| if k % 10 == 0 { 0 } else { 40 }), None);
        assert_eq!(dark(|_| 30), None);
    }

    /// Frame from which on it is told that the left half is covered, `covered(frame)`.
    fn obstructed(
        covered: impl Fn(usize) -> bool,
        part: impl Fn(usize, usize) -> Region,
    ) -> Option<usize> {
        let mut monitor = Obstruction::new(&FaultConfig::default());
        (0..300).find(|frame| {
            let parts = (0..Obstruction::parts()).map(|k| {
                let seen = part(*frame, k);
                let left = k % Obstruction::PARTS.0 < Obstruction::PARTS.0 / 2;
                match left && covered(*frame) {
                    true => Region { found: 0, features: 0, ..seen },
                    false => seen,
                }
            });
            monitor.observe(at(*frame), &(parts.collect(), INTERVAL)).confirmed().is_some()
        })
    }

    #[test]
    fn a_covered_half_is_told_soon() {
        let usual = |_, _| Region { expected: 10, found: 7, features: 20 };
        assert_eq!(obstructed(|_| false, usual), None);
        let told = obstructed(|frame| frame >= 100, usual).unwrap();
        assert!((100..106).contains(&told), "{told}");
        // Some parts are bare, and have always been.
        let bare = |_, k: usize| match k % 3 {
            0 => Region::default(),
            _ => Region { expected: 6, found: 4, features: 9 },
        };
        assert!(obstructed(|frame| frame >= 100, bare).unwrap() < 108);
    }

    #[test]
    fn blur_and_bare_walls_cover_nothing() {
        // Every tenth image is blurred altogether; the lower row looks at a bare floor.
        let blurred = |frame: usize, k: usize| match (frame.is_multiple_of(10), k >= 8) {
            (true, _) => Region { expected: 10, found: 0, features: 0 },
            (_, true) => Region::default(),
            _ => Region { expected: 10, found: 7, features: 20 },
        };
        assert_eq!(obstructed(|_| false, blurred), None);
        // A step of the view onto a wall: a column of parts loses its points at once, now and then.
        let wall = |frame: usize, k: usize| match frame.is_multiple_of(10) && k.is_multiple_of(4) {
            true => Region { expected: 4, found: 0, features: 0 },
            false => Region { expected: 4, found: 3, features: 5 },
        };
        assert_eq!(obstructed(|_| false, wall), None);
    }

    #[test]
    fn places_are_in_their_parts() {
        let size = (640, 480);
        assert_eq!(Obstruction::part(0.0, 0.0, size), 0);
        assert_eq!(Obstruction::part(639.9, 479.9, size), 11);
        assert_eq!(Obstruction::part(-5.0, 1e9, size), 8);
        assert_eq!(Obstruction::part(f64::NAN, 0.0, (0, 0)), 0);
    }
}
