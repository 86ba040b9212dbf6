use nalgebra::Vector3;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use rayon::prelude::*;

use super::*;
use crate::sensor::Stamp;

const INTERVAL: f64 = 0.01;

/// Coefficients of a series to be made.
#[derive(Debug, Clone, Copy)]
struct Truth {
    white: f64,
    flicker: f64,
    walk: f64,
    /// Amplitude of a sine of 31.4 Hz.
    vibration: f64,
}

/// Flicker as a sum of first-order Gauss-Markov processes, two a decade of correlation time, whose
/// spectrum is `B^2 / (2 pi f)` between their corners to a few per cent.
fn series(truth: Truth, n: usize, seed: u64) -> Vec<f64> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut normal = move || rng.sample::<f64, _>(StandardNormal);
    let per_decade = 2.0;
    let mut processes: Vec<(f64, f64, f64)> = (-6..=12)
        .map(|k| {
            let time = 10_f64.powf(f64::from(k) / per_decade);
            // Equal variances a logarithmic step: B^2 / (2 pi) * ln(10) / per_decade * 2.
            let variance = truth.flicker.powi(2) * 10_f64.ln() / per_decade / std::f64::consts::PI;
            let keep = (-INTERVAL / time).exp();
            (normal() * variance.sqrt(), keep, (variance * (1.0 - keep * keep)).sqrt())
        })
        .collect();
    let mut walk = 0.0;
    (0..n)
        .map(|k| {
            let phase = std::f64::consts::TAU * 31.4 * k as f64 * INTERVAL;
            walk += truth.walk * INTERVAL.sqrt() * normal();
            let mut value = truth.white / INTERVAL.sqrt() * normal() + walk;
            for (state, keep, drive) in &mut processes {
                *state = *state * *keep + *drive * normal();
                value += *state;
            }
            value + truth.vibration * phase.sin()
        })
        .collect()
}

fn fit(truth: Truth, n: usize, seed: u64) -> AxisNoise {
    let values: Vec<_> = series(truth, n, seed)
        .into_iter()
        .map(|x| Vector6::new(x, 0.0, 0.0, 0.0, 0.0, 0.0))
        .collect();
    let rest = RestSpan { start: 0.0, end: n as f64 * INTERVAL };
    axis_noise(0, &values, INTERVAL, &rest).unwrap()
}

/// Mean and standard deviation.
fn moments(values: &[f64]) -> (f64, f64) {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let variance = values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / values.len() as f64;
    (mean, variance.sqrt())
}

/// Errors of a coefficient's square in units of the deviation that is claimed for it, of all fits
/// whether significant or not.
fn errors(fits: &[AxisNoise], of: fn(&AxisNoise) -> Coefficient, truth: f64) -> Vec<f64> {
    let error = |c: Coefficient| {
        let square = c.value.powi(2);
        (square - truth.powi(2)) / ((c.at_most.powi(2) - square) / 1.645)
    };
    fits.iter().map(of).map(error).collect()
}

#[test]
fn coefficients_and_their_uncertainty_are_right_over_many_seeds() {
    let kinds = [
        Truth { white: 2e-3, flicker: 0.0, walk: 3e-4, vibration: 0.0 },
        Truth { white: 2e-3, flicker: 1e-3, walk: 0.0, vibration: 0.0 },
        Truth { white: 2e-3, flicker: 0.0, walk: 3e-4, vibration: 0.05 },
    ];
    for truth in kinds {
        let fits: Vec<_> = (0..100).into_par_iter().map(|seed| fit(truth, 100_000, seed)).collect();
        let (slow, of): (f64, fn(&AxisNoise) -> Coefficient) = match truth.walk > 0.0 {
            true => (truth.walk, |a| a.random_walk),
            false => (truth.flicker, |a| a.bias_instability),
        };
        for errors in [errors(&fits, |a| a.white_noise, truth.white), errors(&fits, of, slow)] {
            // Beside a vibration, whose power has an error of its own, the claim is cautious.
            // A coefficient that is not there is bounded by zero, which pulls those beside it by up to
            // 0.4 of a deviation each; so the claim is judged by what it covers.
            let covered = errors.iter().filter(|e| e.abs() < 2.0).count();
            let (mean, sd) = moments(&errors);
            let told = format!("{truth:?}: {covered} covered, mean {mean:.2}, sd {sd:.2}");
            assert!(covered >= 88 && (0.6..1.3).contains(&sd), "{told}");
        }
        let significant = fits.iter().filter(|a| of(a).significant).count();
        assert!(significant >= 75, "{truth:?}: {significant}");
        let found = fits.iter().filter(|a| !a.vibrations.is_empty()).count();
        assert_eq!(found, if truth.vibration > 0.0 { 100 } else { 0 }, "{truth:?}");
    }
}

#[test]
fn what_a_short_rest_does_not_show_is_not_claimed() {
    let truth = Truth { white: 2e-3, flicker: 0.0, walk: 0.0, vibration: 0.0 };
    let fits: Vec<_> = (0..200).into_par_iter().map(|seed| fit(truth, 6_000, seed)).collect();
    for of in [|a: &AxisNoise| a.bias_instability, |a: &AxisNoise| a.random_walk] {
        let claimed = fits.iter().filter(|a| of(a).significant).count();
        // 2.3 % of a normal distribution lie beyond two deviations, one-sided.
        assert!(claimed <= 16, "{claimed} of 200");
    }
}

#[test]
fn a_vibration_is_found_with_its_frequency_and_size() {
    let truth = Truth { white: 2e-3, flicker: 1e-4, walk: 0.0, vibration: 0.02 };
    let noise = fit(truth, 30_000, 4);
    let [line] = noise.vibrations[..] else { panic!("{:?}", noise.vibrations) };
    assert!((line.frequency - 31.4).abs() < 0.1, "{line:?}");
    assert!((line.rms / (0.02 * 0.5_f64.sqrt()) - 1.0).abs() < 0.05, "{line:?}");
    assert!((noise.white_noise.value / 2e-3 - 1.0).abs() < 0.05, "{:?}", noise.white_noise);
}

/// A log at 100 Hz that rests from `rest.0` to `rest.1` (s).
fn log(seconds: f64, rest: (f64, f64), lost: impl Fn(usize) -> bool) -> Vec<ImuSample> {
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    let mut normal = |sd: f64| Vector3::from_fn(|_, _| sd * rng.sample::<f64, _>(StandardNormal));
    let samples = (0..(seconds / INTERVAL) as usize).map(|k| {
        let t = k as f64 * INTERVAL;
        let moves = if (rest.0..rest.1).contains(&t) { 0.0 } else { (2.0 * t).sin() };
        let sample = ImuSample {
            stamp: Stamp::default().offset_by(100.0 + t),
            angular_velocity: normal(0.01) + Vector3::new(0.3 * moves, 0.01, 0.0),
            specific_force: normal(0.05) + Vector3::new(0.0, 0.5 * moves, 9.81),
        };
        (k, sample)
    });
    samples.filter(|(k, _)| !lost(*k)).map(|(_, sample)| sample).collect()
}

#[test]
fn the_longest_rest_of_a_log_is_measured() {
    let config = ImuConfig::default();
    let noise = ImuNoise::identify(&log(90.0, (20.0, 70.0), |k| k % 97 == 5), &config).unwrap();
    assert!((noise.rest.start - 120.5).abs() < 1.0 && (noise.rest.end - 169.5).abs() < 1.0);
    assert!((noise.rate - 100.0).abs() < 0.1 && (45..60).contains(&noise.interpolated));
    let gyro = noise.white_noise(InertialSensor::Gyroscope);
    assert!((gyro / (0.01 * INTERVAL.sqrt()) - 1.0).abs() < 0.15, "{gyro}");
    let accel = noise.of(InertialSensor::Accelerometer).last().unwrap();
    assert!((accel.mean - 9.81).abs() < 0.01 && accel.axis == 'z', "{accel:?}");
}

#[test]
fn too_little_rest_is_refused_with_what_there_is() {
    let config = ImuConfig::default();
    let refused = |samples: &[ImuSample]| ImuNoise::identify(samples, &config).unwrap_err();
    let error = refused(&log(60.0, (20.0, 26.0), |_| false));
    assert!(matches!(error, IdentificationError::NoRest { .. }), "{error}");
    // A pause in the midst of a rest leaves two that are too short.
    let error = refused(&log(18.0, (0.0, 18.0), |k| (900..960).contains(&k)));
    assert!(matches!(error, IdentificationError::NoRest { .. }), "{error}");
    for samples in [&log(5.0, (0.0, 5.0), |_| false)[..], &[]] {
        let error = refused(samples);
        assert!(matches!(error, IdentificationError::TooFew { .. }), "{error}");
    }
    let mut still = log(30.0, (0.0, 30.0), |_| false);
    still.iter_mut().for_each(|sample| sample.angular_velocity.y = 0.01);
    let error = refused(&still);
    assert!(error.to_string().contains("Gyroscope y"), "{error}");
    still.iter_mut().for_each(|sample| sample.specific_force.x = f64::NAN);
    assert!(matches!(refused(&still), IdentificationError::NoRest { .. }));
}
