//! Noise of gyroscope and accelerometer.

use nalgebra::Vector3;

use super::sequential::{Baseline, Cusum, cusum_threshold};
use super::{Fault, FaultConfig, Monitor, SUSPICIOUS, Verdict};
use crate::sensor::Stamp;

/// One reading of a sensor with three axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reading {
    pub value: Vector3<f64>,
    /// The usual time between two, s.
    pub interval: f64,
    /// Standard deviation of an axis that the configuration says, in the units of `value`.
    pub configured_sd: f64,
}

/// Tells a burst of white noise.
///
/// The level of noise over [`Self::BLOCK`] seconds is by the median of second differences,
/// `s^2 = median |x(k) - 2 x(k-1) + x(k-2)|^2 / (6 * 2.366)`: white noise of variance `s^2` an axis gives
/// `6 s^2` times chi-square with three degrees of freedom, whose median is 2.366. Motion all but cancels, and a
/// step, of a bias or of units, is in two of them only. Its logarithm has a usual value and scatter, which are learned:
/// a body that vibrates has a high and restless one from the start. A fault raises the larger one of
/// the usual and the configured level by [`Self::RAISED`].
#[derive(Debug, Clone)]
pub struct NoiseBurst {
    config: FaultConfig,
    last: [Vector3<f64>; 2],
    seen: usize,
    started: Option<Stamp>,
    squares: Vec<f64>,
    level: Baseline,
    sum: Cusum,
    statistic: f64,
}

impl NoiseBurst {
    /// Time over which a level is measured, s, and the least number of samples in it.
    const BLOCK: f64 = 0.08;
    const LEAST: usize = 6;
    /// Most that a block may tell, as a share of the threshold: it takes more than one.
    const MOST: f64 = 0.6;
    /// Median of chi-square with three degrees of freedom.
    const MEDIAN: f64 = 2.366;
    /// What a fault adds to the logarithm of the level: a factor of 8, give or take 2.
    const RAISED: f64 = 2.08;
    const SPREAD: f64 = 0.7;
    /// Of the logarithm of a level of some 20 values, and of a body that is moved about.
    const USUAL_SD: f64 = 0.3;
    /// Blocks that the usual level is learned from, some 2.5 s: vibration swells over seconds, a fault is
    /// there at once. The first of them are learned in any case.
    const MEMORY: f64 = 30.0;
    const FIRST: f64 = 5.0;

    pub fn new(config: &FaultConfig) -> Self {
        Self {
            config: config.clone(),
            last: [Vector3::zeros(); 2],
            seen: 0,
            started: None,
            squares: Vec::new(),
            level: Baseline::new(Self::USUAL_SD, Self::MEMORY),
            sum: Cusum::default(),
            statistic: 0.0,
        }
    }

    /// Forgets the last readings: the next one does not follow them.
    pub fn interrupt(&mut self) {
        (self.seen, self.started) = (0, None);
        self.squares.clear();
    }

    fn block(&mut self, at: Stamp, seconds: f64, configured_sd: f64) {
        let middle = self.squares.len() / 2;
        let (_, median, _) = self.squares.select_nth_unstable_by(middle, f64::total_cmp);
        let level = (*median / (6.0 * Self::MEDIAN)).sqrt().max(1e-12).ln();
        self.squares.clear();
        if self.level.count() < Self::FIRST {
            self.level.learn(level);
            return;
        }
        let Some(mut usual) = self.level.predictive() else { return };
        usual.mean = usual.mean.max(configured_sd.max(1e-12).ln());
        usual.scale = usual.scale.max(Self::USUAL_SD);
        let log_ratio = usual.shift_log_ratio(level, Self::RAISED, Self::SPREAD);
        let threshold = cusum_threshold(self.config.false_alarms_per_hour, seconds);
        let most = Self::MOST * threshold;
        self.statistic = self.sum.add(at, log_ratio.min(most), threshold);
        if self.statistic <= SUSPICIOUS {
            self.level.learn(level);
        }
    }
}

impl Monitor for NoiseBurst {
    type Evidence = Reading;

    fn observe(&mut self, at: Stamp, reading: &Reading) -> Verdict {
        let [before, last] = self.last;
        self.last = [last, reading.value];
        self.seen += 1;
        if self.seen >= 3 && reading.value.iter().all(|x| x.is_finite()) {
            let started = *self.started.get_or_insert(at);
            self.squares.push((reading.value - 2.0 * last + before).norm_squared());
            let seconds = at.seconds_since(started) + reading.interval;
            if seconds >= Self::BLOCK && self.squares.len() >= Self::LEAST {
                self.block(started, seconds, reading.configured_sd);
                self.started = None;
            }
        }
        Verdict::by(self.statistic, Fault::ImuNoise, self.sum.since().unwrap_or(at))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    /// Time of the first alarm in `seconds` of readings whose noise is `sd(t)`, on the turns of a hand
    /// that moves.
    fn alarm(seed: u64, rate: f64, seconds: f64, sd: impl Fn(f64) -> f64) -> Option<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut monitor = NoiseBurst::new(&FaultConfig::default());
        (0..(seconds * rate) as usize).map(|k| k as f64 / rate).find(|t| {
            let motion = Vector3::new((2.0 * t).sin(), (3.1 * t).cos(), (0.7 * t).sin()) * 1.5;
            let noise = Vector3::from_fn(|_, _| {
                let normal: f64 = StandardNormal.sample(&mut rng);
                sd(*t) * normal
            });
            let reading =
                Reading { value: motion + noise, interval: 1.0 / rate, configured_sd: 0.01 };
            monitor.observe(Stamp::default().offset_by(*t), &reading).confirmed().is_some()
        })
    }

    #[test]
    fn a_burst_is_told_soon_at_any_rate() {
        for rate in [100.0, 200.0, 500.0] {
            let burst = |t: f64| if t >= 6.0 { 0.1 } else { 0.01 };
            let after = alarm(1, rate, 10.0, burst).unwrap() - 6.0;
            assert!((0.0..0.4).contains(&after), "{rate} {after}");
        }
    }

    #[test]
    fn vibration_and_its_changes_are_usual() {
        for seed in 0..5 {
            // From the start, ten times what is configured, and swelling.
            assert_eq!(alarm(seed, 100.0, 120.0, |t| 0.1 * (1.0 + 0.8 * (0.6 * t).sin())), None);
            // Twice what is configured, at once.
            assert_eq!(alarm(seed, 100.0, 120.0, |t| if t > 5.0 { 0.02 } else { 0.003 }), None);
        }
    }
}
