//! Whether a filter's own uncertainty agrees with its innovations, while it runs.
//!
//! The normalised innovations squared (NIS) of a consistent filter are independent and chi-square
//! with 3 degrees of freedom; the sum of the last `n` has `3 n`. Both tails are evidence: a sum above
//! the band says that the belief is too sure of itself, one below it that a noise is set too large.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};
use statrs::distribution::{ChiSquared, ContinuousCDF};

/// Degrees of freedom of one position.
const DEGREES: f64 = 3.0;

/// The running test of the innovations.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ConsistencyConfig {
    /// Fixes whose innovations are judged together.
    pub window: usize,
    /// Fewer fixes than this are not judged.
    pub least: usize,
    /// Probability that the innovations of a consistent filter lie outside the band, both tails
    /// together.
    pub false_alarm_probability: f64,
}

impl Default for ConsistencyConfig {
    fn default() -> Self {
        Self { window: 40, least: 3, false_alarm_probability: 1e-4 }
    }
}

/// What the last innovations say.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Consistency {
    pub fixes: usize,
    /// Of the normalised innovations squared, 3 if the filter is consistent.
    pub mean: f64,
    /// Within which the mean of a consistent filter lies.
    pub band: [f64; 2],
}

impl Consistency {
    /// Whether the belief agrees with its innovations.
    pub fn holds(&self) -> bool {
        self.mean >= self.band[0] && self.mean <= self.band[1]
    }

    /// Whether the innovations are larger than the belief allows for.
    pub fn overconfident(&self) -> bool {
        self.mean > self.band[1]
    }
}

/// Two-sided chi-square test of the last normalised innovations squared.
#[derive(Debug, Clone)]
pub(super) struct ConsistencyMonitor {
    window: usize,
    least: usize,
    /// Bands of the sum of 1, 2, ... innovations.
    bands: Vec<[f64; 2]>,
    recent: VecDeque<f64>,
}

impl ConsistencyMonitor {
    pub fn new(config: &ConsistencyConfig) -> Self {
        let tail = 0.5 * config.false_alarm_probability;
        let band = |n: usize| match ChiSquared::new(DEGREES * n as f64) {
            Ok(sum) if tail > 0.0 => [sum.inverse_cdf(tail), sum.inverse_cdf(1.0 - tail)],
            _ => [0.0, f64::INFINITY],
        };
        Self {
            window: config.window.max(1),
            least: config.least.max(1),
            bands: (1..=config.window.max(1)).map(band).collect(),
            recent: VecDeque::with_capacity(config.window.max(1)),
        }
    }

    pub fn add(&mut self, nis: f64) {
        if self.recent.len() == self.window {
            self.recent.pop_front();
        }
        self.recent.push_back(nis);
    }

    /// What the innovations so far say; `None` while there are too few.
    pub fn verdict(&self) -> Option<Consistency> {
        let fixes = self.recent.len();
        if fixes < self.least {
            return None;
        }
        let count = fixes as f64;
        let mean = self.recent.iter().sum::<f64>() / count;
        let band = self.bands.get(fixes - 1)?.map(|bound| bound / count);
        Some(Consistency { fixes, mean, band })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::Distribution;

    /// Share of the verdicts that doubt innovations `scale` times as large as they should be.
    fn doubted(scale: f64, config: &ConsistencyConfig) -> f64 {
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let chi_square = rand_distr::ChiSquared::new(DEGREES).unwrap();
        let mut monitor = ConsistencyMonitor::new(config);
        let mut doubts = 0;
        let steps = 40_000;
        for _ in 0..steps {
            monitor.add(scale * scale * chi_square.sample(&mut rng));
            doubts += usize::from(monitor.verdict().is_some_and(|v| !v.holds()));
        }
        f64::from(doubts as u32) / f64::from(steps)
    }

    #[test]
    fn a_consistent_filter_is_doubted_as_often_as_said() {
        let config = ConsistencyConfig { false_alarm_probability: 0.02, ..Default::default() };
        let share = doubted(1.0, &config);
        assert!(share > 0.01 && share < 0.04, "{share}");
    }

    #[test]
    fn noise_that_is_wrong_by_a_half_is_found_either_way() {
        let config = ConsistencyConfig::default();
        assert!(doubted(1.6, &config) > 0.95 && doubted(0.6, &config) > 0.95);
    }

    #[test]
    fn a_few_innovations_are_no_evidence() {
        let mut monitor = ConsistencyMonitor::new(&ConsistencyConfig::default());
        monitor.add(50.0);
        monitor.add(50.0);
        assert_eq!(monitor.verdict(), None);
        monitor.add(50.0);
        assert!(monitor.verdict().unwrap().overconfident());
    }
}
