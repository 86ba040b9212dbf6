//! Overlapping Allan variance.

use serde::Serialize;

/// Kinds of noise by the slope of their Allan variance.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum NoiseKind {
    White,
    Flicker,
    RandomWalk,
}

/// Allan variance of a series at one averaging time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct AllanPoint {
    /// Averaging time, s.
    pub tau: f64,
    /// Samples in an average.
    #[serde(skip)]
    pub(super) factor: usize,
    /// Root of the Allan variance, in the unit of the series.
    pub deviation: f64,
}

/// The least number of averages without overlap in the longest averaging time.
const FEWEST_AVERAGES: usize = 4;

/// Overlapping Allan variance (IEEE Std 952-1997, C.1; NIST SP 1065, (10)) of a series with a value
/// each `interval` seconds, at averaging times that double: there the estimates are those of a Haar
/// wavelet variance, nearly uncorrelated from one to the next (Percival and Walden, "Wavelet Methods
/// for Time Series Analysis", 8.6).
///
/// With the sums `s_k` of the first k values and averages of m:
/// `AVAR = sum_k (s_(k+2m) - 2 s_(k+m) + s_k)^2 / (2 m^2 (n - 2m + 1))`. O(n log n) for n values.
pub fn allan_deviation(values: &[f64], interval: f64) -> Vec<AllanPoint> {
    let mean = values.iter().sum::<f64>() / values.len().max(1) as f64;
    let mut sums = Vec::with_capacity(values.len() + 1);
    let mut sum = 0.0;
    sums.push(sum);
    for value in values {
        // Without the mean the sums stay small.
        sum += value - mean;
        sums.push(sum);
    }
    let factors = std::iter::successors(Some(1usize), |factor| factor.checked_mul(2));
    factors
        .take_while(|factor| factor * FEWEST_AVERAGES <= values.len())
        .map(|factor| {
            let differences = sums
                .iter()
                .zip(&sums[factor..])
                .zip(&sums[2 * factor..])
                .map(|((first, middle), last)| last - 2.0 * middle + first);
            let (squares, count) =
                differences.fold((0.0, 0.0), |(sum, count), d| (sum + d * d, count + 1.0));
            let variance = squares / (2.0 * count * (factor * factor) as f64);
            AllanPoint { tau: factor as f64 * interval, factor, deviation: variance.sqrt() }
        })
        .collect()
}

/// Equivalent degrees of freedom of the overlapping estimate from `n` values in averages of
/// `factor` (NIST SP 1065, table 5, whose N counts the n + 1 sums).
pub(super) fn degrees_of_freedom(kind: NoiseKind, n: usize, factor: usize) -> f64 {
    let (big_n, m) = ((n + 1) as f64, factor as f64);
    let freedom = match kind {
        NoiseKind::White => {
            (1.5 * (big_n - 1.0) / m - 2.0 * (big_n - 2.0) / big_n) * 4.0 * m * m
                / (4.0 * m * m + 5.0)
        }
        NoiseKind::Flicker if factor == 1 => 2.0 * (big_n - 2.0) / (2.3 * big_n - 4.9),
        NoiseKind::Flicker => 5.0 * big_n * big_n / (4.0 * m * (big_n + 3.0 * m)),
        NoiseKind::RandomWalk => {
            (big_n - 2.0) / m * ((big_n - 1.0).powi(2) - 3.0 * m * (big_n - 1.0) + 4.0 * m * m)
                / (big_n - 3.0).powi(2)
        }
    };
    freedom.max(1.0)
}

/// What of a power at the frequency `f` (Hz) the Allan variance of averages of `factor` values passes:
/// `2 sin^4(pi f tau) / (m sin(pi f interval))^2`, by which a one-sided spectral density is integrated.
pub(super) fn transfer(f: f64, factor: usize, interval: f64) -> f64 {
    let angle = std::f64::consts::PI * f * interval;
    let sine = (factor as f64 * angle).sin();
    let denominator = factor as f64 * angle.sin();
    if denominator.abs() < f64::EPSILON { 0.0 } else { 2.0 * sine.powi(4) / denominator.powi(2) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;

    /// The series of the NBS and its deviations (NIST SP 1065, tables 29 and 30).
    #[test]
    fn the_series_of_nine_values_agrees_with_the_handbook() {
        let values = [892.0, 809.0, 823.0, 798.0, 671.0, 644.0, 883.0, 903.0, 677.0];
        let points = allan_deviation(&values, 1.0);
        assert_eq!(points.len(), 2);
        assert_relative_eq!(points[0].deviation, 91.22945, epsilon = 1e-5);
        assert_relative_eq!(points[1].deviation, 85.95287, epsilon = 1e-5);
    }

    #[test]
    fn a_sine_passes_as_the_transfer_says() {
        let (f, interval, n) = (7.3, 0.005, 40_000);
        let phase = std::f64::consts::TAU * f * interval;
        let values: Vec<f64> = (0..n).map(|k| (phase * f64::from(k)).sin()).collect();
        for point in allan_deviation(&values, interval).iter().take(8) {
            let expected = (0.5 * transfer(f, point.factor, interval)).sqrt();
            assert_relative_eq!(point.deviation, expected, max_relative = 0.01, epsilon = 1e-4);
        }
        assert_eq!(transfer(0.0, 4, interval), 0.0);
    }
}
