//! Readings that are none of a body on earth: wrong units, or a broken sensor.

use nalgebra::Vector3;

use super::sequential::{Cusum, cusum_threshold};
use super::{Fault, FaultConfig, Monitor, Verdict};
use crate::sensor::Stamp;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ForceEvidence {
    /// m/s^2, as read.
    pub specific_force: Vector3<f64>,
    /// The usual time between two readings, s.
    pub interval: f64,
}

/// Tells an accelerometer in other units.
///
/// `x = ln(|mean specific force over a block| / gravity)` scatters about 0 by the body's accelerations,
/// with the tails of a t distribution; in other units it is at least [`Self::FACTOR`] away, on either side.
#[derive(Debug, Clone)]
pub struct Units {
    config: FaultConfig,
    gravity: f64,
    started: Option<Stamp>,
    total: Vector3<f64>,
    count: f64,
    low: Cusum,
    high: Cusum,
    statistic: f64,
}

impl Units {
    /// s; accelerations of a hand that shakes all but cancel over it.
    const BLOCK: f64 = 0.15;
    /// Standard deviation of `x`: 2.5 m/s^2 over a block.
    const USUAL_SD: f64 = 0.25;
    const DOF: f64 = 4.0;
    /// In other units by a factor of about 9 (g: 9.81; feet: 3.3; milli-g: 102), `ln 9` give or take.
    const FACTOR: f64 = 2.2;
    const SPREAD: f64 = 0.8;

    /// `gravity`: m/s^2, positive.
    pub fn new(config: &FaultConfig, gravity: f64) -> Self {
        Self {
            config: config.clone(),
            gravity,
            started: None,
            total: Vector3::zeros(),
            count: 0.0,
            low: Cusum::default(),
            high: Cusum::default(),
            statistic: 0.0,
        }
    }

    fn block(&mut self, at: Stamp) {
        let x = (self.total.norm() / self.count / self.gravity).max(1e-6).ln();
        let usual =
            super::sequential::StudentT { mean: 0.0, scale: Self::USUAL_SD, dof: Self::DOF };
        let threshold = cusum_threshold(self.config.false_alarms_per_hour, Self::BLOCK);
        let ratio = |x: f64| usual.shift_log_ratio(x, Self::FACTOR, Self::SPREAD);
        let low = self.low.add(at, ratio(-x), threshold);
        let high = self.high.add(at, ratio(x), threshold);
        self.statistic = low.max(high);
    }
}

impl Monitor for Units {
    type Evidence = ForceEvidence;

    fn observe(&mut self, at: Stamp, evidence: &ForceEvidence) -> Verdict {
        let force = evidence.specific_force;
        if self.gravity > 0.0 && force.iter().all(|x| x.is_finite()) {
            let started = *self.started.get_or_insert(at);
            self.total += force;
            self.count += 1.0;
            if at.seconds_since(started) + evidence.interval >= Self::BLOCK {
                self.block(started);
                (self.started, self.total, self.count) = (None, Vector3::zeros(), 0.0);
            }
        }
        let since = self.low.since().max(self.high.since());
        Verdict::by(self.statistic, Fault::AccelUnit, since.unwrap_or(at))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Time of the first alarm in 20 s of readings scaled by `scale(t)` on a body that is thrown about.
    fn alarm(scale: impl Fn(f64) -> f64) -> Option<f64> {
        let mut monitor = Units::new(&FaultConfig::default(), 9.81);
        (0..2000).map(|k| f64::from(k) * 0.01).find(|t| {
            let shaken = Vector3::new(12.0 * (9.0 * t).sin(), 8.0 * (6.0 * t).cos(), 0.0);
            // Half a second of free fall and of three times the weight now and then do not last.
            let weight = if t.rem_euclid(5.0) < 0.25 { 0.5 } else { 9.81 };
            let specific_force = (Vector3::z() * weight + shaken) * scale(*t);
            let evidence = ForceEvidence { specific_force, interval: 0.01 };
            monitor.observe(Stamp::default().offset_by(*t), &evidence).confirmed().is_some()
        })
    }

    #[test]
    fn other_units_are_told_and_motion_is_not() {
        assert_eq!(alarm(|_| 1.0), None);
        for (scale, soon) in [(1.0 / 9.81, 1.0), (9.81, 1.0), (101.9, 1.0), (3.28, 2.0), (0.3, 3.0)]
        {
            let from_start = alarm(|_| scale).unwrap();
            assert!(from_start < soon, "{scale} {from_start}");
            let later = alarm(|t| if t < 7.0 { 1.0 } else { scale }).unwrap() - 7.0;
            assert!((0.0..soon).contains(&later), "{scale} {later}");
        }
    }
}
