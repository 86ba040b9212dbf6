//! Spans at rest in a log, under vibration as well.

use std::ops::Range;

use nalgebra::Vector6;

/// Length of the windows that are judged and distance of their beginnings, s.
const WINDOW: f64 = 10.0;
const STEP: f64 = 1.0;
/// Averaging times that are compared, s.
const SHORT: f64 = 0.1;
const LONG: f64 = 1.0;
/// At rest the Allan variance falls as 1 / tau from the short to the long averaging time; vibration
/// faster than 10 Hz falls faster. Ten windows of a second give about 13 degrees of freedom: 4 is
/// exceeded by white noise once in 10^5, and leaves room for a flicker three times as strong as
/// white noise at one second.
const LIMIT: f64 = 4.0;

/// Ranges of samples at rest, in order: six series (rad/s, m/s^2), one sample each `interval` s.
///
/// The test compares the sensor with itself and needs no threshold in units: a body that is moved
/// changes its rate or its force over a second by more than its noise averages out. What an IMU
/// alone cannot tell from rest, motion at constant velocity, is taken for it; a mean rate above
/// `largest_rate` (rad/s), which no bias explains, is not.
pub(super) fn spans_at_rest(
    series: &[Vector6<f64>],
    interval: f64,
    largest_rate: f64,
) -> Vec<Range<usize>> {
    let samples = |seconds: f64| ((seconds / interval).round() as usize).max(1);
    let (window, step) = (samples(WINDOW), samples(STEP));
    let mut spans: Vec<Range<usize>> = Vec::new();
    let mut first = 0;
    while let Some(values) = series.get(first..first + window) {
        if is_rest(values, samples(SHORT), samples(LONG), largest_rate) {
            match spans.last_mut() {
                Some(last) if last.end >= first => last.end = first + window,
                _ => spans.push(first..first + window),
            }
        }
        first += step;
    }
    spans
}

fn is_rest(values: &[Vector6<f64>], short: usize, long: usize, largest_rate: f64) -> bool {
    let mean = values.iter().sum::<Vector6<f64>>() / values.len() as f64;
    let short_variance = allan_variance(values, short);
    let long_variance = allan_variance(values, long);
    let ratio = long as f64 / short as f64;
    let white = short_variance.zip_map(&long_variance, |short, long| long * ratio <= LIMIT * short);
    white.iter().all(|is| *is) && mean.fixed_rows::<3>(0).norm() <= largest_rate
}

/// Overlapping Allan variance of each series.
fn allan_variance(values: &[Vector6<f64>], factor: usize) -> Vector6<f64> {
    let mut sums = vec![Vector6::zeros()];
    let first = values.first().copied().unwrap_or_default();
    let mut sum = Vector6::zeros();
    for value in values {
        sum += value - first;
        sums.push(sum);
    }
    let (mut squares, mut count) = (Vector6::zeros(), 0.0);
    for k in 0..sums.len().saturating_sub(2 * factor) {
        let difference = sums[k + 2 * factor] - 2.0 * sums[k + factor] + sums[k];
        squares += difference.component_mul(&difference);
        count += 1.0;
    }
    squares / (2.0 * count * (factor * factor) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    const INTERVAL: f64 = 0.005;

    /// `motion(t)` with white noise.
    fn series(seed: u64, seconds: f64, motion: impl Fn(f64) -> [f64; 6]) -> Vec<Vector6<f64>> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let sd = Vector6::new(2e-3, 2e-3, 2e-3, 3e-2, 3e-2, 3e-2);
        (0..(seconds / INTERVAL) as usize)
            .map(|k| {
                let noise = Vector6::from_fn(|_, _| rng.sample::<f64, _>(StandardNormal));
                Vector6::from(motion(k as f64 * INTERVAL)) + sd.component_mul(&noise)
            })
            .collect()
    }

    #[test]
    fn rest_is_found_between_motions_also_when_it_vibrates() {
        let still = [0.01, -0.01, 0.005, 0.1, 0.2, 9.8];
        for shake in [0.0, 3.0] {
            let motion = |t: f64| {
                let vibration = shake * (std::f64::consts::TAU * 43.7 * t).sin();
                let mut value = still;
                value[3] += vibration;
                value[1] += 0.1 * vibration;
                if !(20.0..60.0).contains(&t) {
                    value[0] += 0.3 * (1.1 * t).sin();
                    value[4] += 0.5 * (2.3 * t).sin();
                }
                value
            };
            let spans = spans_at_rest(&series(3, 80.0, motion), INTERVAL, 0.05);
            assert_eq!(spans.len(), 1, "{spans:?}");
            let seconds = [spans[0].start, spans[0].end].map(|k| k as f64 * INTERVAL);
            assert!((20.0..=22.0).contains(&seconds[0]), "{seconds:?}");
            assert!((58.0..=60.01).contains(&seconds[1]), "{seconds:?}");
        }
    }

    #[test]
    fn slow_motions_and_turns_at_constant_rate_are_no_rest() {
        // Held as still as a hand can: a tremor and a slow drift of the tilt.
        let held = |t: f64| {
            let tilt = 0.01 * (0.9 * t).sin() + 0.0005 * (57.0 * t).sin();
            [0.009 * (0.9 * t).cos(), 0.0, 0.0, 9.8 * tilt, 0.0, 9.8]
        };
        assert!(spans_at_rest(&series(5, 60.0, held), INTERVAL, 0.05).is_empty());
        let turning = |_: f64| [0.0, 0.0, 0.2, 0.0, 0.0, 9.8];
        assert!(spans_at_rest(&series(6, 60.0, turning), INTERVAL, 0.05).is_empty());
    }

    #[test]
    fn noise_alone_is_rest_throughout() {
        for seed in 0..20 {
            let spans = spans_at_rest(&series(seed, 60.0, |_| [0.0; 6]), INTERVAL, 0.05);
            assert!(spans.len() == 1 && spans[0] == (0..12_000), "seed {seed}: {spans:?}");
        }
    }
}
