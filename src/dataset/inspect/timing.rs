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
    /// Times that the stamps jumped back and went on from there, as where a clock is set.
    pub set_back: usize,
    /// By how much, at most, s.
    pub largest_set_back: f64,
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
        let disorder = Disorder::of(stamps);
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
            out_of_order: disorder.messages,
            largest_disorder: disorder.largest,
            set_back: disorder.set_back,
            largest_set_back: disorder.largest_set_back,
            duplicates: count - stamps.len(),
            log_clock: log_clock(self.offsets),
        })
    }
}

/// Stamps that are lower than one before.
#[derive(Debug, Default)]
struct Disorder {
    messages: usize,
    largest: f64,
    set_back: usize,
    largest_set_back: f64,
}

/// As many messages in a row that are behind, and go on to where the stamps were before without a
/// gap or to the end, are of a clock that was set.
const SET_BACK: usize = 5;

impl Disorder {
    /// Of stamps in order of arrival.
    fn of(stamps: &[Stamp]) -> Self {
        let step = |pair: &[Stamp]| pair[1].nanos().saturating_sub(pair[0].nanos());
        let mut steps: Vec<i64> = stamps.windows(2).map(step).filter(|step| *step > 0).collect();
        steps.sort_unstable();
        let usual = steps.get(steps.len() / 2).map_or(0.0, |step| *step as f64 * 1e-9);
        let mut found = Self::default();
        let Some(mut latest) = stamps.first().copied() else { return found };
        let mut next = 1;
        while let Some(&stamp) = stamps.get(next) {
            let behind = latest.seconds_since(stamp);
            if behind <= 0.0 {
                latest = stamp;
                next += 1;
                continue;
            }
            let run = run_behind(&stamps[next..], latest);
            let last = stamps[next + run - 1];
            let arrives = latest.seconds_since(last) <= GAP * usual || next + run == stamps.len();
            if run >= SET_BACK && arrives {
                found.set_back += 1;
                found.largest_set_back = found.largest_set_back.max(behind);
                latest = last;
            } else {
                found.messages += run;
                found.largest = found.largest.max(behind);
            }
            next += run;
        }
        found
    }
}

/// How many of the first stamps ascend and are not beyond `latest`; at least 1.
fn run_behind(stamps: &[Stamp], latest: Stamp) -> usize {
    let ascends = |pair: &&[Stamp]| pair[0] < pair[1] && pair[1] <= latest;
    1 + stamps.windows(2).take_while(ascends).count()
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
    fn a_clock_that_is_set_back_is_no_disorder() {
        let clock = |n: i64| if n < 50 { 10 * n } else { 10 * n - 300 };
        let set = timing(&(0..100).map(clock).collect::<Vec<_>>(), 0);
        assert_eq!((set.out_of_order, set.set_back), (0, 1));
        assert!((set.largest_set_back - 0.29).abs() < 1e-9, "{set:?}");
        // Ten late messages in a row, after which the others go on.
        let mut late: Vec<i64> =
            (0..100).filter(|n| !(40..50).contains(n)).map(|n| 10 * n).collect();
        late.splice(70..70, (40..50).map(|n| 10 * n));
        let late = timing(&late, 0);
        assert_eq!((late.out_of_order, late.set_back), (10, 0));
    }

    #[test]
    fn few_messages_have_no_rate() {
        assert!(Times::default().evaluate().is_none());
        assert_eq!(timing(&[5], 0).rate, None);
        assert_eq!(timing(&[5, 5], 0).rate, None);
    }
}
