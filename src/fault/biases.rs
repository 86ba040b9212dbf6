//! Biases that are none of the sensor's.

use nalgebra::Vector3;
use statrs::distribution::{ContinuousCDF, Normal};

use super::{Fault, FaultConfig, Finding, Monitor, Verdict};
use crate::sensor::Stamp;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BiasEvidence {
    /// As estimated, with the standard deviation of the prior: rad/s or m/s^2.
    pub bias: Vector3<f64>,
    pub prior_sd: f64,
}

/// Tells a bias that is none of this sensor.
///
/// Its prior is normal; a component beyond the quantile that false alarms leave, estimates being independent
/// of each other [`Self::MEMORY`] seconds apart, is none by chance. While the estimate settles it may be there
/// for a moment.
#[derive(Debug, Clone, Copy)]
pub struct Biases {
    deviations: f64,
    since: Option<Stamp>,
}

impl Biases {
    const MEMORY: f64 = 10.0;
    /// Components of both biases.
    const COMPONENTS: f64 = 6.0;
    /// s.
    const SETTLES: f64 = 0.15;

    pub fn new(config: &FaultConfig) -> Self {
        let chance = config.false_alarms_per_hour * Self::MEMORY / 3600.0 / Self::COMPONENTS;
        let deviations = -Normal::standard().inverse_cdf((0.5 * chance).clamp(1e-300, 0.25));
        Self { deviations, since: None }
    }

    /// The time from which on the bias has been none of the sensor's.
    pub fn since(&self) -> Option<Stamp> {
        self.since
    }
}

impl Monitor for Biases {
    type Evidence = BiasEvidence;

    fn observe(&mut self, at: Stamp, evidence: &BiasEvidence) -> Verdict {
        let statistic = evidence.bias.amax() / (self.deviations * evidence.prior_sd);
        if !(evidence.prior_sd > 0.0 && statistic >= 1.0) {
            self.since = None;
            return Verdict::Nominal;
        }
        let since = *self.since.get_or_insert(at);
        let finding = Finding { fault: Fault::BiasStep, since, statistic };
        match at.seconds_since(since) >= Self::SETTLES {
            true => Verdict::Confirmed(finding),
            false => Verdict::Suspected(finding),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(frame: usize) -> Stamp {
        Stamp::default().offset_by(frame as f64 / 30.0)
    }

    #[test]
    fn a_bias_is_unusual_by_its_prior() {
        let first = |bias: fn(usize) -> f64| {
            let mut monitor = Biases::new(&FaultConfig::default());
            (0..100).find(|k| {
                let evidence = BiasEvidence { bias: Vector3::y() * bias(*k), prior_sd: 0.01 };
                monitor.observe(at(*k), &evidence).confirmed().is_some()
            })
        };
        assert_eq!(first(|_| 0.04), None);
        assert_eq!(first(|_| -0.1), Some(5));
        assert_eq!(first(|k| if k % 5 == 0 { 0.0 } else { 0.1 }), None);
    }
}
