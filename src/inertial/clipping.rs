//! Gyroscopes that turn faster than they can measure.

use nalgebra::Vector3;

/// Readings in a row that make a flat top.
const FLAT_TOP: usize = 3;
/// Readings that differ by less than this share are the same; noise and quantisation of a reading
/// within the range are larger.
const SAME: f64 = 1e-6;
/// The smallest range of gyroscopes for moving bodies, 50 deg/s, with some margin, rad/s.
const LEAST_RANGE: f64 = 0.8;
/// Standard deviation of the rate beyond the range, as a share of the range.
const EXCESS_SHARE: f64 = 0.15;

/// One sample's worth of what clipped readings hide.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Clipped {
    /// Axes that read the end of their range.
    pub axes: [bool; 3],
    /// Angle about each axis that a flat top which has just ended has probably cut off, rad.
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
/// taken for a parabola that goes on with the slope before it: over `T` seconds it turns by
/// `slope T^2/6`.
#[derive(Debug, Clone, Copy, Default)]
pub struct ClippingMonitor {
    /// For the positive and the negative end of each axis.
    ends: [[End; 2]; 3],
}

#[derive(Debug, Clone, Copy, Default)]
struct End {
    /// rad/s.
    highest: f64,
    is_limit: bool,
    /// Readings in a row at the highest value, and for how long, s.
    run: usize,
    seconds: f64,
    /// Of the readings before the run, rad/s^2.
    slope: f64,
    previous: f64,
}

impl ClippingMonitor {
    /// Takes a reading, rad/s, that holds for the `seconds` before it.
    pub fn observe(&mut self, rate: &Vector3<f64>, seconds: f64) -> Clipped {
        let mut clipped = Clipped::default();
        for (axis, ends) in self.ends.iter_mut().enumerate() {
            for (end, sign) in ends.iter_mut().zip([1.0, -1.0]) {
                let (missed, variance) = end.observe(sign * rate[axis], seconds);
                clipped.axes[axis] |= end.is_limit && end.run > 0;
                clipped.missed[axis] += sign * missed;
                clipped.variance[axis] += variance;
            }
        }
        clipped
    }

    /// The smallest end of a range that was found, rad/s.
    pub fn limit(&self) -> Option<f64> {
        let limits = self.ends.iter().flatten().filter(|end| end.is_limit);
        limits.map(|end| end.highest).min_by(f64::total_cmp)
    }
}

impl End {
    /// The angle that has been missed, once it is known, and the variance that this reading adds.
    fn observe(&mut self, rate: f64, seconds: f64) -> (f64, f64) {
        let before = std::mem::replace(&mut self.previous, rate);
        if rate > self.highest * (1.0 + SAME) {
            *self = Self {
                highest: rate,
                run: 1,
                slope: (rate - before) / seconds,
                previous: rate,
                ..Self::default()
            };
            return (0.0, 0.0);
        }
        if rate < self.highest * (1.0 - SAME) {
            let missed = if self.is_limit { self.slope * self.seconds.powi(2) / 6.0 } else { 0.0 };
            (self.run, self.seconds) = (0, 0.0);
            return (missed.max(0.0), 0.0);
        }
        if self.run == 0 {
            self.slope = (rate - before) / seconds;
        }
        self.run += 1;
        let (from, to) = (self.seconds, self.seconds + seconds);
        self.seconds = to;
        self.is_limit |= self.run >= FLAT_TOP && self.highest > LEAST_RANGE;
        let variance = (EXCESS_SHARE * self.highest).powi(2) * (to * to - from * from);
        (0.0, if self.is_limit { variance } else { 0.0 })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const H: f64 = 0.01;

    /// A swing about the second axis through a gyroscope with this range, rad/s.
    fn swing(limit: f64) -> Vec<(f64, f64)> {
        (1..400)
            .map(|k| {
                let t = f64::from(k) * H;
                // Noise that no reading within the range repeats.
                let rate = 5.0 * (6.0 * t).sin() + 1e-3 * (997.0 * t).sin();
                (rate, rate.clamp(-limit, limit))
            })
            .collect()
    }

    #[test]
    fn flat_tops_are_found_at_both_ends_and_what_they_hide_is_made_good() {
        let mut monitor = ClippingMonitor::default();
        let (mut lost, mut regained, mut found, mut missing) = (0.0, 0.0, 0, 0);
        for (k, (rate, read)) in swing(4.0).into_iter().enumerate() {
            let clipped = monitor.observe(&Vector3::new(0.1, read, 0.0), H);
            assert_eq!((clipped.axes[0], clipped.axes[2]), (false, false));
            // The first top at either end is known only from its third reading on.
            if k > 110 {
                found += usize::from(clipped.axes[1]);
                missing += usize::from((rate != read) != clipped.axes[1]);
                lost += (rate - read).abs() * H;
                regained += clipped.missed[1].abs();
                assert_eq!(clipped.variance[1] > 0.0, clipped.axes[1]);
            }
        }
        assert!(found > 50 && missing < 6, "{found} {missing}");
        assert!((regained - lost).abs() < 0.4 * lost, "{regained} {lost}");
        assert_eq!(monitor.limit(), Some(4.0));
    }

    #[test]
    fn a_peak_within_the_range_is_none_and_a_larger_reading_refutes() {
        let mut monitor = ClippingMonitor::default();
        for (_, read) in swing(10.0) {
            assert!(!monitor.observe(&Vector3::new(0.0, read, 0.0), H).any());
        }
        for _ in 0..5 {
            monitor.observe(&Vector3::new(0.0, 6.0, 0.0), H);
        }
        assert_eq!(monitor.limit(), Some(6.0));
        assert!(!monitor.observe(&Vector3::new(0.0, 7.0, 0.0), H).any());
        assert_eq!(monitor.limit(), None);
        // A slow turn that repeats its reading is none either.
        let mut monitor = ClippingMonitor::default();
        assert!((0..9).all(|_| !monitor.observe(&Vector3::new(0.5, 0.0, 0.0), H).any()));
    }
}
