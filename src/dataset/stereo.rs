//! Pairs of images of two cameras to color and depth, the right one beside them.

use std::collections::VecDeque;

use super::merge::{Reading, ReadingSource};
use super::pair::{Paired, Pairer};
use super::{LogConfig, ReadReport};
use crate::sensor::{ColorImage, Stamp};
use crate::vision::StereoRig;

/// Replaces the left image by the rectified one and its depth; the right one stays as taken, with the
/// stamp of the left one.
pub(super) struct StereoSource<S> {
    source: S,
    rig: StereoRig,
    pairs: Pairer<ColorImage, ColorImage>,
    /// How long an image waits for its partner, ns.
    patience: i64,
    latest: Stamp,
    ready: VecDeque<Reading>,
    is_over: bool,
}

impl<S: ReadingSource> StereoSource<S> {
    pub fn new(source: S, rig: StereoRig, config: &LogConfig) -> Self {
        let limit = (config.max_pair_difference * 1e9).round() as i64;
        Self {
            source,
            rig,
            pairs: Pairer::new(limit),
            patience: limit.saturating_mul(2),
            latest: Stamp::from_nanos(i64::MIN),
            ready: VecDeque::new(),
            is_over: false,
        }
    }

    fn settle(&mut self, until: Stamp, report: &mut ReadReport) {
        let Self { pairs, rig, ready, .. } = self;
        pairs.settle(until, |paired| match paired {
            Paired::Pair(stamp, left, right) => match rig.measure(&left, &right) {
                Some((color, depth)) => {
                    ready.push_back(Reading::Right(stamp, right));
                    ready.push_back(Reading::Color(stamp, color));
                    ready.push_back(Reading::Depth(stamp, depth));
                }
                None => report.skip(
                    "stereo images: not of the size of the calibration",
                    format_args!("at {stamp} s"),
                ),
            },
            Paired::LoneColor(stamp, _) => {
                report.skip("left image: no right image near enough in time", stamp);
            }
            Paired::LoneDepth(stamp, _) => {
                report.skip("right image: no left image near enough in time", stamp);
            }
        });
    }
}

impl<S: ReadingSource> ReadingSource for StereoSource<S> {
    fn next_reading(&mut self, report: &mut ReadReport) -> Option<Reading> {
        loop {
            if let Some(reading) = self.ready.pop_front() {
                return Some(reading);
            }
            if self.is_over {
                return None;
            }
            let Some(reading) = self.source.next_reading(report) else {
                self.is_over = true;
                self.settle(Stamp::from_nanos(i64::MAX), report);
                continue;
            };
            let stamp = reading.stamp();
            let is_new = match reading {
                Reading::Color(stamp, left) => self.pairs.add_color(stamp, left),
                Reading::Right(stamp, right) => self.pairs.add_depth(stamp, right),
                other => {
                    self.ready.push_back(other);
                    true
                }
            };
            if !is_new {
                report.skip("stereo images: repeated stamp", stamp);
            }
            self.latest = self.latest.max(stamp);
            let until = self.latest.nanos().saturating_sub(self.patience);
            self.settle(Stamp::from_nanos(until), report);
        }
    }
}
