//! Gyroscope and accelerometer that come apart, at rates of their own, to IMU samples.

use std::collections::BTreeMap;

use nalgebra::Vector3;

use super::ReadReport;
use super::merge::{Reading, ReadingSource};
use crate::inertial::ImuConfig;
use crate::sensor::{ImuSample, Stamp};

/// Readings of each looked at to tell which of the two is the faster one.
const SURVEYED: usize = 16;

/// Readings of one wait at most so long for the other, in number.
const LARGEST_QUEUE: usize = 4096;

/// Makes samples of gyroscope and accelerometer readings, at the stamps of whichever comes more
/// often: the other is interpolated linearly. Readings of both may arrive in any order.
///
/// Across more than the longest gap of an IMU nothing is interpolated: there is no sample then. At
/// the ends, and so near to a gap, the nearest reading counts.
#[derive(Debug)]
pub(super) struct ImuUniter {
    gyroscope: BTreeMap<Stamp, Vector3<f64>>,
    accelerometer: BTreeMap<Stamp, Vector3<f64>>,
    /// Known once enough readings have come.
    faster: Option<Half>,
    /// s.
    max_gap: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Half {
    Gyroscope,
    Accelerometer,
}

impl ImuUniter {
    pub fn new(imu: &ImuConfig) -> Self {
        Self {
            gyroscope: BTreeMap::new(),
            accelerometer: BTreeMap::new(),
            faster: None,
            max_gap: imu.max_gap,
        }
    }

    /// Takes halves and hands out whole samples; other readings pass through.
    pub fn add(&mut self, reading: Reading, ready: &mut Vec<Reading>, report: &mut ReadReport) {
        let (half, stamp, value) = match reading {
            Reading::Gyroscope(stamp, rate) => (Half::Gyroscope, stamp, rate),
            Reading::Accelerometer(stamp, force) => (Half::Accelerometer, stamp, force),
            other => return ready.push(other),
        };
        if self.queue(half).contains_key(&stamp) {
            report.skip_at("imu: repeated stamp", stamp);
            return;
        }
        self.queue(half).insert(stamp, value);
        let counts = (self.gyroscope.len(), self.accelerometer.len());
        if self.faster.is_none() && counts.0.min(counts.1) >= SURVEYED {
            self.faster = Some(self.faster_half());
        }
        if self.faster.is_some() || counts.0.max(counts.1) > LARGEST_QUEUE {
            self.unite(false, ready, report);
        }
    }

    /// Hands out what is left at the end.
    pub fn finish(&mut self, ready: &mut Vec<Reading>, report: &mut ReadReport) {
        self.unite(true, ready, report);
    }

    fn queue(&mut self, half: Half) -> &mut BTreeMap<Stamp, Vector3<f64>> {
        match half {
            Half::Gyroscope => &mut self.gyroscope,
            Half::Accelerometer => &mut self.accelerometer,
        }
    }

    fn faster_half(&self) -> Half {
        let intervals = (median_interval(&self.gyroscope), median_interval(&self.accelerometer));
        match intervals {
            (Some(gyroscope), Some(accelerometer)) if accelerometer < gyroscope => {
                Half::Accelerometer
            }
            _ => Half::Gyroscope,
        }
    }

    fn unite(&mut self, is_end: bool, ready: &mut Vec<Reading>, report: &mut ReadReport) {
        let faster = self.faster.unwrap_or_else(|| self.faster_half());
        let Self { gyroscope, accelerometer, max_gap, .. } = self;
        let (base, other) = match faster {
            Half::Gyroscope => (gyroscope, accelerometer),
            Half::Accelerometer => (accelerometer, gyroscope),
        };
        while let Some(entry) = base.first_entry() {
            let stamp = *entry.key();
            let is_due = other.last_key_value().is_some_and(|(last, _)| *last >= stamp);
            let is_overdue = is_end || base.len() > LARGEST_QUEUE;
            if !(is_due || is_overdue) {
                break;
            }
            let Some((_, value)) = base.pop_first() else { break };
            let Some(counterpart) = at(other, stamp, *max_gap) else {
                let reason = "imu: gyroscope and accelerometer not near enough in time";
                report.skip_at(reason, stamp);
                continue;
            };
            let (angular_velocity, specific_force) = match faster {
                Half::Gyroscope => (value, counterpart),
                Half::Accelerometer => (counterpart, value),
            };
            ready.push(Reading::Imu(ImuSample { stamp, angular_velocity, specific_force }));
            forget_before(other, stamp.offset_by(-*max_gap));
        }
        if base.is_empty() && other.len() > LARGEST_QUEUE {
            other.pop_first();
        }
    }
}

/// The value at `stamp` on the line between its neighbours, unless they are more than `max_gap`
/// apart; then, and at the ends, that of a neighbour within half of it.
fn at(values: &BTreeMap<Stamp, Vector3<f64>>, stamp: Stamp, max_gap: f64) -> Option<Vector3<f64>> {
    let before = values.range(..=stamp).next_back();
    let after = values.range(stamp..).next();
    if let (Some((from, first)), Some((to, second))) = (before, after) {
        let interval = to.seconds_since(*from);
        if interval <= 0.0 {
            return Some(*first);
        }
        if interval <= max_gap {
            return Some(first.lerp(second, stamp.seconds_since(*from) / interval));
        }
    }
    let distance = |near: &Stamp| stamp.seconds_since(*near).abs();
    let nearest = [before, after].into_iter().flatten();
    let nearest = nearest.min_by(|a, b| distance(a.0).total_cmp(&distance(b.0)));
    nearest.filter(|(near, _)| distance(near) <= max_gap / 2.0).map(|(_, value)| *value)
}

/// Drops all before `stamp` but the last, between which and the next one may be interpolated.
fn forget_before(values: &mut BTreeMap<Stamp, Vector3<f64>>, stamp: Stamp) {
    let Some(last) = values.range(..=stamp).next_back().map(|(stamp, _)| *stamp) else { return };
    while values.first_key_value().is_some_and(|(first, _)| *first < last) {
        values.pop_first();
    }
}

fn median_interval(values: &BTreeMap<Stamp, Vector3<f64>>) -> Option<f64> {
    let stamps: Vec<Stamp> = values.keys().copied().collect();
    let mut intervals: Vec<f64> =
        stamps.windows(2).map(|pair| pair[1].seconds_since(pair[0])).collect();
    intervals.sort_by(f64::total_cmp);
    intervals.get(intervals.len() / 2).copied()
}

/// Unites what a source yields in halves.
pub(super) struct UnitedSource<S> {
    source: S,
    uniter: ImuUniter,
    /// In reverse order.
    ready: Vec<Reading>,
    is_over: bool,
}

impl<S: ReadingSource> UnitedSource<S> {
    pub fn new(source: S, imu: &ImuConfig) -> Self {
        Self { source, uniter: ImuUniter::new(imu), ready: Vec::new(), is_over: false }
    }
}

impl<S: ReadingSource> ReadingSource for UnitedSource<S> {
    fn next_reading(&mut self, report: &mut ReadReport) -> Option<Reading> {
        loop {
            if let Some(reading) = self.ready.pop() {
                return Some(reading);
            }
            if self.is_over {
                return None;
            }
            match self.source.next_reading(report) {
                Some(reading) => self.uniter.add(reading, &mut self.ready, report),
                None => {
                    self.is_over = true;
                    self.uniter.finish(&mut self.ready, report);
                }
            }
            self.ready.reverse();
        }
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    fn at_millis(millis: f64) -> Stamp {
        Stamp::from_nanos((millis * 1e6).round() as i64)
    }

    /// A rate and a force that are linear in time, so that interpolation is exact.
    fn gyroscope(millis: f64) -> Reading {
        Reading::Gyroscope(at_millis(millis), Vector3::new(millis, 0.0, 1.0))
    }

    fn accelerometer(millis: f64) -> Reading {
        Reading::Accelerometer(at_millis(millis), Vector3::new(0.0, 2.0 * millis, 9.81))
    }

    fn united(readings: Vec<Reading>) -> (Vec<ImuSample>, ReadReport) {
        let mut uniter = ImuUniter::new(&ImuConfig::default());
        let (mut ready, mut report) = (Vec::new(), ReadReport::default());
        for reading in readings {
            uniter.add(reading, &mut ready, &mut report);
        }
        uniter.finish(&mut ready, &mut report);
        let sample = |reading: Reading| match reading {
            Reading::Imu(sample) => sample,
            other => panic!("{other:?}"),
        };
        (ready.into_iter().map(sample).collect(), report)
    }

    fn times(step: f64, until: f64) -> impl Iterator<Item = f64> {
        (0..).map(move |n| f64::from(n) * step).take_while(move |t| *t < until)
    }

    fn check(samples: &[ImuSample], inside: std::ops::Range<f64>) {
        for sample in samples {
            let millis = sample.stamp.seconds() * 1e3;
            if inside.contains(&millis) {
                assert_relative_eq!(sample.angular_velocity.x, millis, epsilon = 1e-6);
                assert_relative_eq!(sample.specific_force.y, 2.0 * millis, epsilon = 1e-6);
            }
        }
    }

    #[test]
    fn samples_have_the_stamps_of_the_faster_one_in_whichever_order_both_come() {
        for (gyro_step, accel_step) in [(5.0, 16.0), (5.0, 4.0), (2.5, 4.0), (16.0, 4.0)] {
            let gyro: Vec<_> = times(gyro_step, 1000.0).map(gyroscope).collect();
            let accel: Vec<_> = times(accel_step, 1000.0).map(|t| accelerometer(t + 1.3)).collect();
            let mut mixed = [gyro.clone(), accel.clone()].concat();
            mixed.sort_by_key(Reading::stamp);
            let first = united(mixed);
            let count = gyro.len().max(accel.len());
            assert!(first.1.skipped.is_empty() && first.0.len() == count, "{:?}", first.1);
            check(&first.0, 20.0..980.0);
            for order in [[gyro.clone(), accel.clone()], [accel, gyro]] {
                let other = united(order.concat());
                let same = |a: &ImuSample, b: &ImuSample| {
                    (a.angular_velocity - b.angular_velocity).norm() < 1e-9
                        && (a.specific_force - b.specific_force).norm() < 1e-9
                };
                assert_eq!(other.0.len(), count);
                assert!(first.0.iter().zip(&other.0).all(|(a, b)| same(a, b)));
            }
        }
    }

    #[test]
    fn nothing_is_made_up_across_a_gap() {
        let gyro = times(5.0, 2000.0).map(gyroscope);
        let accel = times(16.0, 2000.0).filter(|t| !(500.0..1000.0).contains(t)).map(accelerometer);
        let mut mixed: Vec<_> = gyro.chain(accel).collect();
        mixed.sort_by_key(Reading::stamp);
        let (samples, report) = united(mixed);
        let left_out = report.skipped["imu: gyroscope and accelerometer not near enough in time"];
        assert_eq!(samples.len() as u64 + left_out, 400);
        // 0.5 s without the accelerometer, less half of the longest gap at either end.
        assert!((78..=84).contains(&left_out), "{left_out}");
        check(&samples, 0.0..480.0);
        check(&samples, 1020.0..1980.0);
    }

    #[test]
    fn one_alone_makes_no_sample_and_takes_no_memory() {
        let (samples, report) = united(times(1.0, 20_000.0).map(gyroscope).collect());
        assert!(samples.is_empty() && report.skipped.values().sum::<u64>() == 20_000);
        let mut uniter = ImuUniter::new(&ImuConfig::default());
        for t in times(1.0, 20_000.0) {
            uniter.add(accelerometer(t), &mut Vec::new(), &mut ReadReport::default());
        }
        assert!(uniter.accelerometer.len() <= LARGEST_QUEUE + 1);
    }

    #[test]
    fn repeated_stamps_are_told() {
        let mut readings: Vec<_> = times(5.0, 500.0).map(gyroscope).collect();
        readings.extend(times(5.0, 500.0).map(accelerometer));
        readings.push(accelerometer(495.0));
        assert_eq!(united(readings).1.skipped["imu: repeated stamp"], 1);
    }
}
