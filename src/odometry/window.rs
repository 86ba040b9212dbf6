//! The IMU data between two frames.

use std::collections::VecDeque;

use crate::sensor::{ImuSample, Stamp};

/// An interval between two samples, as the belief is carried through it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImuInterval {
    pub from: ImuSample,
    pub to: ImuSample,
    /// Whether its samples only stand in for what the IMU did not measure.
    pub is_bridged: bool,
    /// Whether `to` is a sample of the IMU itself, not one interpolated at a frame.
    pub is_measured: bool,
}

/// A stretch without samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImuGap {
    /// The last sample before it.
    pub after: Stamp,
    /// s.
    pub length: f64,
}

/// All IMU data from the time of the belief to a frame's.
#[derive(Debug, Clone, PartialEq)]
pub struct ImuWindow {
    pub end: Stamp,
    /// From the time of the belief to the end, s.
    pub seconds: f64,
    /// Empty without an IMU.
    pub intervals: Vec<ImuInterval>,
    /// Gaps met here for the first time.
    pub gaps: Vec<ImuGap>,
}

/// How far the IMU's data are used up.
#[derive(Debug, Clone)]
pub struct ImuCursor {
    /// Time of the belief.
    pub time: Stamp,
    /// Last sample used, its stamp being the time of the belief (interpolated at frames).
    pub last: Option<ImuSample>,
    /// Last sample of the IMU itself, not interpolated.
    pub last_measured: Option<Stamp>,
    /// The sample before the gap that was reported last.
    reported_gap_after: Option<Stamp>,
    /// A longer interval is a gap, s.
    max_gap: f64,
}

impl ImuCursor {
    /// At `time`, after the last of the samples that `imu` has until then, which are used up.
    pub fn at(time: Stamp, imu: &mut VecDeque<ImuSample>, max_gap: f64) -> Self {
        let mut last = None;
        while let Some(sample) = imu.pop_front_if(|sample| sample.stamp <= time) {
            last = Some(sample);
        }
        Self {
            time,
            last: last.map(|sample| ImuSample { stamp: time, ..sample }),
            last_measured: last.map(|sample| sample.stamp),
            reported_gap_after: None,
            max_gap,
        }
    }

    /// The data up to `end`, which are used up.
    pub fn window_until(&mut self, end: Stamp, imu: &mut VecDeque<ImuSample>) -> ImuWindow {
        // After the belief has been timed anew some are behind it.
        while let Some(sample) = imu.pop_front_if(|sample| sample.stamp <= self.time) {
            self.last = Some(sample);
            self.last_measured = Some(sample.stamp);
        }
        let seconds = end.seconds_since(self.time);
        let mut window = ImuWindow { end, seconds, intervals: Vec::new(), gaps: Vec::new() };
        let Some(mut from) = self.last.or_else(|| imu.front().copied()) else {
            self.time = end;
            return window;
        };
        from.stamp = self.time;
        loop {
            let next = imu.front().copied();
            let gap = self.gap_before(next.map_or(end, |sample| sample.stamp));
            window.gaps.extend(gap.filter(|gap| self.reports(gap)));
            let reached = next.filter(|sample| sample.stamp <= end);
            let to = match (reached, next) {
                (Some(sample), _) => sample,
                (None, Some(next)) => ImuSample::between(&from, &next, end),
                (None, None) => ImuSample { stamp: end, ..from },
            };
            let (is_bridged, is_measured) = (gap.is_some(), reached.is_some());
            window.intervals.push(ImuInterval { from, to, is_bridged, is_measured });
            from = to;
            if reached.is_none() {
                break;
            }
            imu.pop_front();
            self.last_measured = Some(to.stamp);
        }
        self.last = Some(from);
        self.time = end;
        window
    }

    fn gap_before(&self, until: Stamp) -> Option<ImuGap> {
        let after = self.last_measured?;
        let length = until.seconds_since(after);
        (length > self.max_gap).then_some(ImuGap { after, length })
    }

    /// Whether a gap is met for the first time.
    fn reports(&mut self, gap: &ImuGap) -> bool {
        self.reported_gap_after.replace(gap.after) != Some(gap.after)
    }
}
