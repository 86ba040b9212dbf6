//! How far the mean NEES of one run may lie from its expectation, whose errors are alike from one
//! moment to the next.

use nalgebra::{Complex, SVector};
use serde::Serialize;
use statrs::distribution::{ChiSquared, ContinuousCDF};

use crate::inertial::identification::fourier;

/// What the mean NEES of a run says of the covariances.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum ConsistencyVerdict {
    Consistent,
    /// Errors larger than claimed.
    Overconfident,
    /// Errors smaller than claimed.
    TooCautious,
}

impl ConsistencyVerdict {
    pub fn name(self) -> &'static str {
        match self {
            Self::Consistent => "consistent",
            Self::Overconfident => "overconfident",
            Self::TooCautious => "too cautious",
        }
    }
}

/// The band in which the mean NEES of one consistent run lies.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct RunBand {
    /// Independent errors that would tell as much as all of this run.
    pub effective_samples: f64,
    /// Two-sided band of the mean.
    pub mean_band: [f64; 2],
    pub verdict: ConsistencyVerdict,
}

/// The sum of squared correlations is cut off at this many times itself (A. Sokal, "Monte Carlo
/// Methods in Statistical Mechanics", 1996, section 3): beyond is only noise.
const CUT_OFF: f64 = 5.0;

impl RunBand {
    /// Of errors at equal steps, each in units of its covariance's root (`L^-1 e`, `P = L L^T`) and in
    /// a frame in which it lasts. `None` without errors.
    ///
    /// Errors of unit covariance whose correlation after k steps is `r_k` have a NEES of mean N whose
    /// covariance after k steps is `2 N r_k^2`; so the mean over n steps has the variance
    /// `2 N / n_e`, `n_e = n / (1 + 2 sum_k (1 - k/n) r_k^2)`, and is about chi-square with `N n_e`
    /// degrees of freedom over `n_e`. The correlations are measured on the errors about zero, so that
    /// they do not depend on the scale that is to be judged. O(n log n).
    pub fn of<const N: usize>(whitened: &[SVector<f64, N>], confidence: f64) -> Option<Self> {
        let mean = whitened.iter().map(SVector::norm_squared).sum::<f64>() / whitened.len() as f64;
        let effective_samples = effective_samples(whitened)?;
        let freedom = N as f64 * effective_samples;
        let distribution = ChiSquared::new(freedom).ok()?;
        let tail = 0.5 * (1.0 - confidence);
        let quantile = |p: f64| distribution.inverse_cdf(p) / effective_samples;
        let mean_band = [quantile(tail), quantile(1.0 - tail)];
        let verdict = match mean {
            mean if mean > mean_band[1] => ConsistencyVerdict::Overconfident,
            mean if mean < mean_band[0] => ConsistencyVerdict::TooCautious,
            _ => ConsistencyVerdict::Consistent,
        };
        Some(Self { effective_samples, mean_band, verdict })
    }
}

/// At least one; `None` without errors.
fn effective_samples<const N: usize>(whitened: &[SVector<f64, N>]) -> Option<f64> {
    let n = whitened.len();
    let covariance = autocovariance(whitened);
    let variance = *covariance.first().filter(|variance| **variance > 0.0)?;
    let mut sum = 1.0;
    for (k, covariance) in covariance.iter().enumerate().skip(1) {
        // Of n - k products, where the variance is of n.
        let share = 1.0 - k as f64 / n as f64;
        sum += 2.0 * (covariance / variance).powi(2) / share;
        if k as f64 >= CUT_OFF * sum {
            break;
        }
    }
    Some((n as f64 / sum).max(1.0))
}

/// `sum_t u_t . u_(t+k)` for all k, in units of some constant: the transform of the power spectrum of
/// the series followed by as many zeros.
fn autocovariance<const N: usize>(series: &[SVector<f64, N>]) -> Vec<f64> {
    let length = (2 * series.len()).next_power_of_two();
    let zero = Complex::new(0.0, 0.0);
    let mut power = vec![zero; length];
    for component in 0..N {
        let mut transformed = vec![zero; length];
        for (entry, value) in transformed.iter_mut().zip(series) {
            entry.re = value[component];
        }
        fourier::transform(&mut transformed);
        for (sum, value) in power.iter_mut().zip(&transformed) {
            sum.re += value.norm_sqr();
        }
    }
    fourier::transform(&mut power);
    power.iter().take(series.len()).map(|value| value.re).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;
    use rayon::prelude::*;

    /// Errors of unit covariance with the correlation `phi` from one step to the next.
    fn autoregressive(n: usize, phi: f64, seed: u64) -> Vec<Vector3<f64>> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = || Vector3::from_fn(|_, _| rng.sample::<f64, _>(StandardNormal));
        let mut state = normal();
        let drive = (1.0 - phi * phi).sqrt();
        (0..n)
            .map(|_| {
                let now = state;
                state = phi * state + drive * normal();
                now
            })
            .collect()
    }

    /// A random walk from zero, in units of the deviation that it has reached: dead reckoning.
    fn dead_reckoning(n: usize, seed: u64) -> Vec<Vector3<f64>> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut sum = Vector3::zeros();
        (1..=n)
            .map(|k| {
                sum += Vector3::from_fn(|_, _| rng.sample::<f64, _>(StandardNormal));
                sum / (k as f64).sqrt()
            })
            .collect()
    }

    /// Shares of the runs below and above the band.
    fn outside(runs: impl Fn(u64) -> Vec<Vector3<f64>> + Sync) -> [f64; 2] {
        let count = 2000;
        let verdicts: Vec<_> = (0..count)
            .into_par_iter()
            .map(|seed| RunBand::of(&runs(seed), 0.95).unwrap().verdict)
            .collect();
        [ConsistencyVerdict::TooCautious, ConsistencyVerdict::Overconfident]
            .map(|v| verdicts.iter().filter(|x| **x == v).count() as f64 / count as f64)
    }

    #[test]
    fn the_band_holds_its_rate_on_correlated_errors() {
        // Of 2000 runs 5 % are outside to within a standard deviation of half a per cent.
        for (n, phi) in [(1000, 0.0), (1000, 0.5), (1000, 0.9), (1000, 0.99)] {
            let [below, above] = outside(|seed| autoregressive(n, phi, seed));
            assert!((0.035..0.07).contains(&(below + above)), "{n} {phi}: {below} {above}");
        }
        // The errors of a run that is no longer than they last are nearly a single one, whose
        // correlation the run itself does not tell well.
        for (n, phi) in [(300, 0.99), (1000, 0.999)] {
            let [below, above] = outside(|seed| autoregressive(n, phi, seed));
            assert!((0.03..0.11).contains(&(below + above)), "{n} {phi}: {below} {above}");
        }
        let [below, above] = outside(|seed| dead_reckoning(1000, seed));
        assert!((0.03..0.11).contains(&(below + above)), "{below} {above}");
    }

    #[test]
    fn the_effective_number_is_that_of_the_theory() {
        for phi in [0.0, 0.5, 0.9, 0.97] {
            let expected = 20_000.0 * (1.0 - phi * phi) / (1.0 + phi * phi);
            let found = effective_samples(&autoregressive(20_000, phi, 3)).unwrap();
            assert!((found / expected - 1.0).abs() < 0.12, "{phi}: {found} {expected}");
        }
        assert_eq!(effective_samples::<3>(&[]), None);
        assert_eq!(effective_samples(&[Vector3::zeros(); 5]), None);
    }

    #[test]
    fn wrong_scales_are_told() {
        let verdict = |factor: f64| {
            let errors: Vec<_> =
                autoregressive(2000, 0.9, 1).into_iter().map(|e| e * factor).collect();
            RunBand::of(&errors, 0.95).unwrap().verdict
        };
        assert_eq!(verdict(1.0), ConsistencyVerdict::Consistent);
        assert_eq!(verdict(1.5), ConsistencyVerdict::Overconfident);
        assert_eq!(verdict(0.6), ConsistencyVerdict::TooCautious);
    }
}
