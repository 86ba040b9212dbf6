//! When the messages of a topic were stamped and logged.

use serde::Serialize;

use crate::sensor::Stamp;

/// Messages of a topic beyond this number are counted, but their times are not kept.
const MOST_TIMES: usize = 2 << 20;

/// An interval this many times the median is a gap.
const GAP: f64 = 1.6;

/// Log and header clock are the same if they differ by less than this, s.
const SAME_CLOCK: f64 = 1.0;

/// Times of a topic's messages, in order of arrival.
#[derive(Debug, Default)]
pub(super) struct Times {
    header: Vec<Stamp>,
    log: Vec<Stamp>,
    /// Log time minus header stamp, ns.
    offsets: Vec<i64>,
}

/// Rate and faults of a topic, by its header stamps (by log times if it has none).
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Timing {
    /// `"header"` or `"log"`: whose stamps these are.
    pub clock: &'static str,
    /// s
    pub first: f64,
    /// s
    pub last: f64,
    /// Inverse of the median interval, Hz; absent for fewer than two different stamps.
    pub rate: Option<f64>,
    /// Intervals of more than 1.6 times the median.
    pub gaps: usize,
    /// Messages that fit into the gaps.
    pub missing: u64,
    pub longest_gap: Option<Gap>,
    /// Messages stamped before one that arrived earlier.
    pub out_of_order: usize,
    /// By how much, at most, s.
    pub largest_disorder: f64,
    /// Messages stamped as another one.
    pub duplicates: usize,
    /// Log time minus header stamp, where there are both.
    pub log_clock: Option<LogClock>,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Gap {
    /// Stamp before the gap, s.
    pub after: f64,
    /// s
    pub seconds: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LogClock {
    /// Median of log time minus header stamp, s.
    pub offset: f64,
    /// Between the 5th and the 95th percentile, s: delay of the transport, drift of the clocks.
    pub spread: f64,
    /// Whether both count from the same origin.
    pub same: bool,
}

impl Times {
    pub fn add(&mut self, header: Option<Stamp>, log: Option<Stamp>) {
        if self.header.len().max(self.log.len()) >= MOST_TIMES {
            return;
        }
        self.header.extend(header);
        self.log.extend(log);
        if let (Some(header), Some(log)) = (header, log) {
            self.offsets.push(log.nanos().saturating_sub(header.nanos()));
        }
    }

    /// Sorts the times: nothing may be added afterwards. `None` without any.
    pub fn evaluate(mut self) -> Option<Timing> {
        let (clock, stamps) = match self.header.is_empty() {
            true => ("log", &mut self.log),
            false => ("header", &mut self.header),
        };
        let (mut out_of_order, mut largest_disorder, mut latest) = (0, 0.0_f64, None);
        for stamp in stamps.iter() {
            let behind = latest.map_or(0.0, |latest: Stamp| latest.seconds_since(*stamp));
            if behind > 0.0 {
                out_of_order += 1;
                largest_disorder = largest_disorder.max(behind);
            }
            latest = latest.max(Some(*stamp));
        }
        let count = stamps.len();
        stamps.sort_unstable();
        stamps.dedup();
        let (first, last) = (stamps.first()?.seconds(), stamps.last()?.seconds());
        let mut intervals: Vec<(i64, Stamp)> = stamps
            .windows(2)
            .map(|pair| (pair[1].nanos().saturating_sub(pair[0].nanos()), pair[0]))
            .collect();
        intervals.sort_unstable();
        let median = intervals.get(intervals.len() / 2).map(|(length, _)| *length as f64);
        let limit = median.map_or(f64::INFINITY, |median| GAP * median);
        let gaps = &intervals[intervals.partition_point(|(length, _)| *length as f64 <= limit)..];
        let fitting = |length: i64| (length as f64 / median.unwrap_or(1.0)).round() as u64 - 1;
        Some(Timing {
            clock,
            first,
            last,
            rate: median.map(|median| 1e9 / median),
            gaps: gaps.len(),
            missing: gaps.iter().map(|(length, _)| fitting(*length)).sum(),
            longest_gap: gaps.last().map(|(length, after)| Gap {
                after: after.seconds(),
                seconds: *length as f64 * 1e-9,
            }),
            out_of_order,
            largest_disorder,
            duplicates: count - stamps.len(),
            log_clock: log_clock(self.offsets),
        })
    }
}

fn log_clock(mut offsets: Vec<i64>) -> Option<LogClock> {
    offsets.sort_unstable();
    let at =
        |part: usize| offsets.get(offsets.len() * part / 100).map(|nanos| *nanos as f64 * 1e-9);
    let (low, median, high) = (at(5)?, at(50)?, at(95)?);
    Some(LogClock { offset: median, spread: high - low, same: median.abs() < SAME_CLOCK })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn timing(millis: &[i64], log_offset: i64) -> Timing {
        let mut times = Times::default();
        for t in millis {
            let stamp = |t: i64| Some(Stamp::from_nanos(t * 1_000_000));
            times.add(stamp(*t), stamp(*t + log_offset));
        }
        times.evaluate().unwrap()
    }

    #[test]
    fn gaps_are_counted_with_what_is_missing() {
        let all: Vec<i64> =
            (0..100).filter(|n| !(20..25).contains(n) && *n != 70).map(|n| n * 10).collect();
        let timing = timing(&all, 5);
        assert_eq!(timing.rate, Some(100.0));
        assert_eq!((timing.gaps, timing.missing), (2, 6));
        let longest = timing.longest_gap.unwrap();
        assert!((longest.after - 0.19).abs() < 1e-9 && (longest.seconds - 0.06).abs() < 1e-9);
        assert_eq!((timing.out_of_order, timing.duplicates), (0, 0));
        assert!(timing.log_clock.unwrap().same);
    }

    #[test]
    fn disorder_and_repetition_are_no_gaps() {
        let timing = timing(&[0, 10, 30, 20, 40, 40, 50, 60, 70], 2_000_000);
        assert_eq!((timing.out_of_order, timing.duplicates, timing.gaps), (1, 1, 0));
        assert!((timing.largest_disorder - 0.01).abs() < 1e-9);
        let clock = timing.log_clock.unwrap();
        assert!(!clock.same && (clock.offset - 2000.0).abs() < 1e-9 && clock.spread == 0.0);
    }

    #[test]
    fn few_messages_have_no_rate() {
        assert!(Times::default().evaluate().is_none());
        assert_eq!(timing(&[5], 0).rate, None);
        assert_eq!(timing(&[5, 5], 0).rate, None);
    }
}
