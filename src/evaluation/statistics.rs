use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF, StudentsT};

/// Summary of a series of errors, in the unit of the errors (`sse` in its square).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Statistics {
    pub rmse: f64,
    pub mean: f64,
    /// Mean of the two middle values where their number is even.
    pub median: f64,
    /// Of the population: divided by `n`, not `n - 1`.
    pub std: f64,
    pub min: f64,
    pub max: f64,
    /// Sum of squared errors.
    pub sse: f64,
}

impl Statistics {
    /// `None` for an empty series.
    pub fn of(errors: &[f64]) -> Option<Self> {
        let mut sorted = errors.to_vec();
        sorted.sort_unstable_by(f64::total_cmp);
        let (&min, &max) = (sorted.first()?, sorted.last()?);
        let n = errors.len() as f64;
        let sse: f64 = errors.iter().map(|e| e * e).sum();
        let mean = errors.iter().sum::<f64>() / n;
        let variance = errors.iter().map(|e| (e - mean) * (e - mean)).sum::<f64>() / n;
        Some(Self {
            rmse: (sse / n).sqrt(),
            mean,
            median: quantile(&sorted, 0.5),
            std: variance.sqrt(),
            min,
            max,
            sse,
        })
    }

    /// Names and values in the order of the fields.
    pub fn entries(&self) -> [(&'static str, f64); 7] {
        [
            ("rmse", self.rmse),
            ("mean", self.mean),
            ("median", self.median),
            ("std", self.std),
            ("min", self.min),
            ("max", self.max),
            ("sse", self.sse),
        ]
    }
}

/// Two-sided p-value of the paired t-test that `differences` have mean zero; `None` for fewer than
/// two of them or if they are all equal.
pub fn paired_t_test(differences: &[f64]) -> Option<f64> {
    let statistics = Statistics::of(differences)?;
    let degrees = differences.len() as f64 - 1.0;
    let standard_error = statistics.std / degrees.sqrt();
    if !(standard_error > 0.0 && standard_error.is_finite()) {
        return None;
    }
    let t = StudentsT::new(0.0, 1.0, degrees).ok()?;
    Some(2.0 * t.sf((statistics.mean / standard_error).abs()))
}

/// Quantile `p` in [0, 1] of values in ascending order, linear between them; NaN where there are
/// none.
pub(super) fn quantile(sorted: &[f64], p: f64) -> f64 {
    let position = p * sorted.len().saturating_sub(1) as f64;
    let low = position.floor() as usize;
    match (sorted.get(low), sorted.get(low + 1)) {
        (Some(a), Some(b)) => a + (b - a) * (position - low as f64),
        (Some(a), None) => *a,
        _ => f64::NAN,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;

    #[test]
    fn statistics_of_a_known_series() {
        let s = Statistics::of(&[3.0, 1.0, 2.0, 6.0]).unwrap();
        assert_relative_eq!(s.rmse, 12.5_f64.sqrt());
        assert_relative_eq!(s.mean, 3.0);
        assert_relative_eq!(s.median, 2.5);
        assert_relative_eq!(s.std, 3.5_f64.sqrt());
        assert_eq!((s.min, s.max, s.sse), (1.0, 6.0, 50.0));
        assert_eq!(Statistics::of(&[4.0]).unwrap().median, 4.0);
        assert_eq!(Statistics::of(&[]), None);
    }
}
