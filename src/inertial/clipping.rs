//! Gyroscopes that turn faster than they can measure.

use nalgebra::{Rotation3, Vector3};

use crate::so3::{exp, log};

/// Readings in a row that make a flat top.
const FLAT_TOP: usize = 3;
/// Readings that differ by less than this share are the same; noise and quantisation of a reading
/// within the range are larger.
const SAME: f64 = 1e-6;
/// The smallest range of gyroscopes for moving bodies, 50 deg/s, with some margin, rad/s.
const LEAST_RANGE: f64 = 0.8;
/// Standard deviation of the rate beyond the range, as a share of the range.
const EXCESS_SHARE: f64 = 0.15;
/// Readings before and after a flat top that give its slopes.
const MARGIN: usize = 2;
/// Readings that are kept within the range: when the end of a range is found, the first ones of the
/// flat top are among them.
const KEPT: usize = MARGIN + FLAT_TOP - 1;
/// Readings of one clipped turn that are kept at most, at 200 Hz five seconds.
const LONGEST: usize = 1000;

/// One sample's worth of what clipped readings hide.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Clipped {
    /// Axes that read the end of their range.
    pub axes: [bool; 3],
    /// Rotation vector, in the body frame of this sample, by which the body has turned further than
    /// the readings of a clipped turn that has just ended, rad.
    pub missed: Vector3<f64>,
    /// Variance of the angle about each axis, rad^2.
    pub variance: Vector3<f64>,
}

impl Clipped {
    pub fn any(&self) -> bool {
        self.axes.contains(&true)
    }
}

/// Watches for flat tops at the edge of the range: readings that are the largest so far and the
/// same several times in a row. A larger one refutes them.
///
/// The range need not be known, nor be the same for the axes and signs. What a flat top cuts off is
/// taken for a cubic that goes on with the slopes before and after it, and the turn is known once
/// all axes are back within their ranges: until then the axes that are clipped are uncertain.
#[derive(Debug, Clone, Default)]
pub struct ClippingMonitor {
    /// For the positive and the negative end of each axis.
    ends: [[End; 2]; 3],
    /// The last readings, and all of a clipped turn that has not ended.
    readings: Vec<Reading>,
    /// Readings since the last clipped one; only of a clipped turn.
    calm: Option<usize>,
}

#[derive(Debug, Clone, Copy)]
struct Reading {
    /// rad/s.
    rate: Vector3<f64>,
    /// s.
    seconds: f64,
    clipped: [bool; 3],
}

#[derive(Debug, Clone, Copy, Default)]
struct End {
    /// rad/s.
    highest: f64,
    is_limit: bool,
    /// Readings in a row at the highest value, and for how long, s.
    run: usize,
    seconds: f64,
}

impl ClippingMonitor {
    /// Takes a reading, rad/s, that holds for the `seconds` before it.
    pub fn observe(&mut self, rate: &Vector3<f64>, seconds: f64) -> Clipped {
        let mut axes = [false; 3];
        let mut variance = Vector3::zeros();
        for (axis, ends) in self.ends.iter_mut().enumerate() {
            for (end, sign) in ends.iter_mut().zip([1.0, -1.0]) {
                let was_limit = end.is_limit;
                if let Some(added) = end.observe(sign * rate[axis], seconds) {
                    axes[axis] = true;
                    if !was_limit {
                        // The readings of the flat top by which it was found are clipped, too.
                        for reading in self.readings.iter_mut().rev().take(FLAT_TOP - 1) {
                            reading.clipped[axis] = true;
                        }
                    }
                    variance[axis] += added;
                }
            }
        }
        self.readings.push(Reading { rate: *rate, seconds, clipped: axes });
        self.calm = match self.calm {
            _ if axes.contains(&true) => Some(0),
            calm => calm.map(|calm| calm + 1),
        };
        let mut missed = Vector3::zeros();
        if self.calm.is_some_and(|calm| calm >= MARGIN) {
            missed = missed_turn(&self.readings);
            self.calm = None;
            // What has been made good is not made good again.
            self.readings.drain(..self.readings.len().saturating_sub(MARGIN));
        }
        if self.calm.is_none() || self.readings.len() > LONGEST {
            self.readings.drain(..self.readings.len().saturating_sub(KEPT));
        }
        Clipped { axes, missed, variance }
    }

    /// Passes over a gap: ranges are kept.
    pub fn pass_gap(&mut self) {
        self.readings.clear();
        self.calm = None;
    }

    /// The smallest end of a range that was found, rad/s.
    pub fn limit(&self) -> Option<f64> {
        let limits = self.ends.iter().flatten().filter(|end| end.is_limit);
        limits.map(|end| end.highest).min_by(f64::total_cmp)
    }
}

impl End {
    /// The variance of the angle that this reading adds; `None` within the range.
    fn observe(&mut self, rate: f64, seconds: f64) -> Option<f64> {
        if rate > self.highest * (1.0 + SAME) {
            *self = Self { highest: rate, run: 1, seconds, is_limit: false };
            return None;
        }
        if rate < self.highest * (1.0 - SAME) {
            (self.run, self.seconds) = (0, 0.0);
            return None;
        }
        self.run += 1;
        let (from, to) = (self.seconds, self.seconds + seconds);
        self.seconds = to;
        self.is_limit |= self.run >= FLAT_TOP && self.highest > LEAST_RANGE;
        // The excess of a flat top is one unknown, so that its angle grows with the time.
        let variance = (EXCESS_SHARE * self.highest).powi(2) * (to * to - from * from);
        self.is_limit.then_some(variance)
    }
}

/// By how much the body has turned further than what was read, in its frame at the end.
fn missed_turn(readings: &[Reading]) -> Vector3<f64> {
    let mut rates: Vec<Vector3<f64>> = readings.iter().map(|reading| reading.rate).collect();
    for axis in 0..3 {
        let mut from = 0;
        while from < readings.len() {
            let same =
                |r: &Reading| r.clipped[axis] && r.rate[axis] * readings[from].rate[axis] > 0.0;
            let length = readings[from..].iter().take_while(|reading| same(reading)).count();
            if length > 0 {
                round_off(readings, axis, from, from + length, &mut rates);
            }
            from += length.max(1);
        }
    }
    let turn = |rates: &mut dyn Iterator<Item = Vector3<f64>>| {
        let steps = rates.zip(readings).map(|(rate, reading)| exp(&(rate * reading.seconds)));
        steps.fold(Rotation3::identity(), |turn, step| turn * step)
    };
    let read = turn(&mut readings.iter().map(|reading| reading.rate));
    log(&(read.inverse() * turn(&mut rates.into_iter())))
}

/// Adds to the clipped readings `from..to` of an axis the cubic with the slopes of its sides.
fn round_off(
    readings: &[Reading],
    axis: usize,
    from: usize,
    to: usize,
    rates: &mut [Vector3<f64>],
) {
    let sign = readings[from].rate[axis].signum();
    let slope = |first: usize| {
        let [first, second] = readings.get(first..first + 2)? else { return None };
        let slope = sign * (second.rate[axis] - first.rate[axis]) / second.seconds;
        (!first.clipped[axis] && !second.clipped[axis]).then_some(slope)
    };
    // The step into the flat top and the one out of it are cut off themselves.
    let before = from.checked_sub(2).and_then(slope).map(|slope| slope.max(0.0));
    let after = slope(to).map(|slope| (-slope).max(0.0));
    let (before, after) = (before.or(after).unwrap_or(0.0), after.or(before).unwrap_or(0.0));
    let seconds: f64 = readings[from..to].iter().map(|reading| reading.seconds).sum();
    let mut passed = 0.0;
    for k in from..to {
        let share = (passed + 0.5 * readings[k].seconds) / seconds;
        passed += readings[k].seconds;
        let excess = share * (1.0 - share) * (before * (1.0 - share) + after * share);
        rates[k][axis] += sign * seconds * excess;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::so3::angle_between;

    const H: f64 = 0.01;

    /// A body that turns about all axes at once, with noise that no reading repeats.
    fn rate(t: f64) -> Vector3<f64> {
        let noise = Vector3::new((997.0 * t).sin(), (893.0 * t).sin(), (787.0 * t).sin()) * 1e-3;
        Vector3::new(5.0 * (6.0 * t).sin(), 4.0 * (5.0 * t + 1.0).sin(), (9.0 * t).cos()) + noise
    }

    /// After 4.8 s, when all axes are within their ranges again: what a flat top hides is made good
    /// only at its end.
    fn angle_lost(limit: f64, make_good: bool) -> f64 {
        let mut monitor = ClippingMonitor::default();
        let (mut turned, mut read) = (Rotation3::identity(), Rotation3::identity());
        for k in 1..=480 {
            let rate = rate(f64::from(k) * H);
            let clipped = rate.map(|x| x.clamp(-limit, limit));
            let found = monitor.observe(&clipped, H);
            // Ranges are known from the third reading at their end on.
            if k > 250 {
                for axis in 0..3 {
                    assert_eq!(found.axes[axis], clipped[axis] != rate[axis]);
                    assert_eq!(found.variance[axis] > 0.0, found.axes[axis]);
                }
            }
            turned *= exp(&(rate * H));
            read *=
                exp(&(clipped * H)) * exp(&if make_good { found.missed } else { Vector3::zeros() });
        }
        assert_eq!(monitor.limit(), (limit < 4.0).then_some(limit));
        angle_between(&turned, &read)
    }

    #[test]
    fn flat_tops_are_found_and_what_they_hide_is_made_good() {
        let (as_read, made_good) = (angle_lost(3.5, false), angle_lost(3.5, true));
        assert!(as_read > 0.5 && made_good < 0.1 * as_read, "{as_read} {made_good}");
        assert!(angle_lost(10.0, true) < 1e-9);
    }

    #[test]
    fn a_larger_reading_refutes_a_flat_top_and_a_slow_turn_makes_none() {
        let mut monitor = ClippingMonitor::default();
        for _ in 0..5 {
            monitor.observe(&Vector3::new(0.0, 6.0, 0.0), H);
        }
        assert_eq!(monitor.limit(), Some(6.0));
        assert!(!monitor.observe(&Vector3::new(0.0, 7.0, 0.0), H).any());
        assert_eq!(monitor.limit(), None);
        let mut monitor = ClippingMonitor::default();
        assert!((0..9).all(|_| !monitor.observe(&Vector3::new(0.5, 0.0, 0.0), H).any()));
    }
}
