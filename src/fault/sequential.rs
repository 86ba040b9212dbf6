//! Sequential tests: thresholds from error rates, and the usual level of a value with its uncertainty.
//!
//! Both tests add up the log-likelihood ratio `ln p1(x)/p0(x)` of fault against no fault.
//!
//! - [`Cusum`] (Page 1954) starts anew whenever the sum falls below 0, and so finds a change at any time:
//!   `S <- max(0, S + ln p1/p0)`. Without a fault the mean number of observations until `S >= h` is at
//!   least `e^h` (Lorden 1971, theorem 2; for increments that are log-likelihood ratios), from which
//!   [`cusum_threshold`] has `h`; after a change it takes about `h / E1[ln p1/p0]` observations.
//! - [`Sprt`] (Wald 1945) decides once between two hypotheses, with the error probabilities that
//!   its two thresholds follow from.

use crate::sensor::Stamp;

/// Seconds an hour.
const HOUR: f64 = 3600.0;

/// Threshold of a [`Cusum`] that is given an observation every `interval` seconds, for a mean time
/// between false alarms of at least `1 / false_alarms_per_hour` hours.
pub fn cusum_threshold(false_alarms_per_hour: f64, interval: f64) -> f64 {
    (HOUR / (false_alarms_per_hour * interval)).max(std::f64::consts::E).ln()
}

/// A cumulative sum of log-likelihood ratios.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Cusum {
    score: f64,
    since: Option<Stamp>,
}

impl Cusum {
    /// Most that the sum exceeds its threshold by: a fault that has lasted for long is over as
    /// soon as one that has just been found.
    const LARGEST: f64 = 1.5;

    /// Adds an observation; gives the sum as a multiple of `threshold`.
    pub fn add(&mut self, at: Stamp, log_ratio: f64, threshold: f64) -> f64 {
        let score = self.score + log_ratio;
        if score <= 0.0 || !score.is_finite() {
            *self = Self::default();
            return 0.0;
        }
        self.since.get_or_insert(at);
        self.score = score.min(Self::LARGEST * threshold);
        self.score / threshold
    }

    /// The most likely time of the change: when the sum last left 0.
    pub fn since(&self) -> Option<Stamp> {
        self.since
    }

    pub fn is_zero(&self) -> bool {
        self.score == 0.0
    }

    pub fn reset(&mut self) {
        *self = Self::default();
    }
}

/// What a sequential probability ratio test has decided.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Decided {
    Fault,
    Sound,
}

/// A sequential probability ratio test between two simple hypotheses.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sprt {
    score: f64,
    upper: f64,
    lower: f64,
}

impl Sprt {
    /// Thresholds by Wald's approximations: `ln((1 - miss)/false_alarm)` and
    /// `ln(miss/(1 - false_alarm))`, for probabilities in (0, 1/2).
    pub fn new(false_alarm: f64, miss: f64) -> Self {
        let inside = |p: f64| p.clamp(1e-12, 0.499);
        let (alpha, beta) = (inside(false_alarm), inside(miss));
        Self { score: 0.0, upper: ((1.0 - beta) / alpha).ln(), lower: (beta / (1.0 - alpha)).ln() }
    }

    /// Adds an observation.
    pub fn add(&mut self, log_ratio: f64) -> Option<Decided> {
        if log_ratio.is_finite() {
            self.score += log_ratio;
        }
        self.decided()
    }

    pub fn decided(&self) -> Option<Decided> {
        match self.score {
            score if score >= self.upper => Some(Decided::Fault),
            score if score <= self.lower => Some(Decided::Sound),
            _ => None,
        }
    }

    /// The sum as a multiple of the threshold for the fault.
    pub fn statistic(&self) -> f64 {
        self.score / self.upper
    }

    /// Forgets what has spoken against the fault: it may begin only now.
    pub fn forget_against(&mut self) {
        self.score = self.score.max(0.0);
    }
}

/// Student's t distribution with a place and a scale.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StudentT {
    pub mean: f64,
    pub scale: f64,
    pub dof: f64,
}

impl StudentT {
    /// Logarithm of the density, but for a constant of the degrees of freedom.
    fn log_density(&self, x: f64) -> f64 {
        let z = (x - self.mean) / self.scale;
        -0.5 * (self.dof + 1.0) * (z * z / self.dof).ln_1p() - self.scale.ln()
    }

    /// `ln p1(x)/p0(x)`, where `p0` is this distribution and `p1` the one whose place is `shift`
    /// higher, give or take `spread`. Values below the place count as the place: the wider one of two
    /// distributions is no sign of a shift up.
    pub fn shift_log_ratio(&self, x: f64, shift: f64, spread: f64) -> f64 {
        let shifted =
            Self { mean: self.mean + shift, scale: self.scale.hypot(spread), dof: self.dof };
        let x = x.max(self.mean);
        shifted.log_density(x) - self.log_density(x)
    }
}

/// The usual level of a value, learned while nothing speaks for a fault.
///
/// Mean and variance have a normal-inverse-gamma distribution, that of the next value is a
/// [`StudentT`] (e.g. Murphy 2007, eq. 110): little learned means a wide one. Old values are forgotten
/// at the rate `1/memory`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Baseline {
    mean: f64,
    variance: f64,
    /// Values that the mean and the variance are worth.
    mean_count: f64,
    variance_count: f64,
    memory: f64,
}

impl Baseline {
    /// Values that the assumed deviation is worth.
    const PRIOR: f64 = 4.0;

    /// Of which nothing is known but that values scatter by about `sd`.
    pub fn new(sd: f64, memory: f64) -> Self {
        let variance_count = Self::PRIOR;
        Self { mean: 0.0, variance: sd * sd, mean_count: 0.0, variance_count, memory }
    }

    /// Values learned so far, but for those that are forgotten.
    pub fn count(&self) -> f64 {
        self.mean_count
    }

    pub fn mean(&self) -> f64 {
        self.mean
    }

    pub fn learn(&mut self, x: f64) {
        if !x.is_finite() {
            return;
        }
        self.mean_count = (self.mean_count + 1.0).min(self.memory);
        let before = x - self.mean;
        self.mean += before / self.mean_count;
        if self.mean_count > 1.0 {
            self.variance_count = (self.variance_count + 1.0).min(self.memory);
            let square = before * (x - self.mean);
            self.variance += (square - self.variance) / self.variance_count;
        }
    }

    /// Distribution of the next value; `None` before the first.
    pub fn predictive(&self) -> Option<StudentT> {
        let spread = self.variance * (1.0 + 1.0 / self.mean_count);
        (self.mean_count >= 1.0 && spread > 0.0).then(|| StudentT {
            mean: self.mean,
            scale: spread.sqrt(),
            dof: self.variance_count,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    fn normal(rng: &mut ChaCha8Rng) -> f64 {
        StandardNormal.sample(rng)
    }

    /// Alarms an hour, by 40 hours of observations every 0.1 s, of the CUSUM for `log_ratio`.
    fn alarms_per_hour(mut log_ratio: impl FnMut(&mut ChaCha8Rng) -> f64, threshold: f64) -> f64 {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let (mut cusum, mut alarms) = (Cusum::default(), 0);
        for k in 0..40 * 36_000 {
            if cusum.add(Stamp::from_nanos(k), log_ratio(&mut rng), threshold) >= 1.0 {
                alarms += 1;
                cusum.reset();
            }
        }
        f64::from(alarms) / 40.0
    }

    /// Lorden's bound holds, and is not so far off as to be of no use.
    #[test]
    fn cusum_raises_no_more_false_alarms_than_asked() {
        for asked in [60.0, 6.0] {
            let threshold = cusum_threshold(asked, 0.1);
            let shift = |rng: &mut ChaCha8Rng| normal(rng) - 0.5;
            let losses = |rng: &mut ChaCha8Rng| match rng.random::<f64>() < 0.01 {
                true => (0.2f64 / 0.01).ln(),
                false => (0.8f64 / 0.99).ln(),
            };
            for rate in [alarms_per_hour(shift, threshold), alarms_per_hour(losses, threshold)] {
                assert!(rate <= asked && rate > 0.01 * asked, "{rate} of {asked}");
            }
        }
    }

    #[test]
    fn cusum_finds_a_change_as_soon_as_its_information_allows() {
        let threshold = cusum_threshold(0.01, 0.1);
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let runs = 2000;
        let mut total = 0.0;
        for _ in 0..runs {
            let mut cusum = Cusum::default();
            let delay = (1..).find(|k| {
                cusum.add(Stamp::from_nanos(*k), normal(&mut rng) + 0.5, threshold) >= 1.0
            });
            total += delay.unwrap() as f64;
        }
        // By a shift of one standard deviation: half a nat an observation, and what overshoots.
        let delay = total / f64::from(runs);
        assert!((threshold / 0.5..threshold / 0.5 + 5.0).contains(&delay), "{delay} {threshold}");
    }

    #[test]
    fn cusum_knows_when_the_change_was_and_forgets_a_fault_that_is_over() {
        let mut cusum = Cusum::default();
        for k in 0..100 {
            cusum.add(Stamp::from_nanos(k), if k < 50 { -1.0 } else { 1.0 }, 10.0);
        }
        assert_eq!(cusum.since(), Some(Stamp::from_nanos(50)));
        let over = (100..).find(|k| cusum.add(Stamp::from_nanos(*k), -1.0, 10.0) == 0.0);
        assert_eq!(over, Some(114));
        assert_eq!(cusum.add(Stamp::from_nanos(200), f64::NAN, 10.0), 0.0);
    }

    #[test]
    fn sprt_errs_as_seldom_as_asked() {
        let (false_alarm, miss) = (0.05, 0.02);
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut error_rate = |mean: f64, wrong: Decided| {
            let runs = 20_000;
            let errors = (0..runs).filter(|_| {
                let mut test = Sprt::new(false_alarm, miss);
                loop {
                    if let Some(decided) = test.add(0.5 * (normal(&mut rng) + mean)) {
                        break decided == wrong;
                    }
                }
            });
            errors.count() as f64 / f64::from(runs)
        };
        // ln p1/p0 of a shift by a half is x/2 - 1/8.
        let (sound, faulty) = (error_rate(-0.25, Decided::Fault), error_rate(0.25, Decided::Sound));
        assert!(sound <= false_alarm && sound > 0.4 * false_alarm, "{sound}");
        assert!(faulty <= miss && faulty > 0.4 * miss, "{faulty}");
    }

    /// Of a level that is learned from few values no more alarms are raised than of a known one.
    #[test]
    fn a_learned_level_raises_no_more_false_alarms() {
        let threshold = cusum_threshold(60.0, 0.1);
        let mut baseline = Baseline::new(1.0, 30.0);
        let mut count = 0;
        let rate = alarms_per_hour(
            |rng| {
                let x = 3.0 + 0.2 * normal(rng);
                count += 1;
                let ratio = baseline.predictive().map(|t| t.shift_log_ratio(x, 1.0, 0.2));
                baseline.learn(x);
                // Learned anew every 20 values.
                if count % 20 == 0 {
                    baseline = Baseline::new(1.0, 30.0);
                }
                ratio.unwrap_or(0.0)
            },
            threshold,
        );
        assert!(rate <= 60.0, "{rate}");
    }

    #[test]
    fn a_baseline_converges_to_mean_and_deviation() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut baseline = Baseline::new(1.0, 1000.0);
        assert!(baseline.predictive().is_none());
        (0..5000).for_each(|_| baseline.learn(5.0 + 0.3 * normal(&mut rng)));
        let t = baseline.predictive().unwrap();
        assert!((t.mean - 5.0).abs() < 0.05 && (t.scale - 0.3).abs() < 0.03, "{t:?}");
        baseline.learn(f64::NAN);
        assert_eq!(baseline.predictive(), Some(t));
    }
}
