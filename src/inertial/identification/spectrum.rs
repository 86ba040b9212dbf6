//! Power spectral density and the vibrations that stand out of it.

use std::f64::consts::PI;

use nalgebra::Complex;
use serde::Serialize;
use statrs::distribution::{ChiSquared, ContinuousCDF};

use super::allan::transfer;
use super::fourier;

/// A vibration: power about a frequency that the spectrum beside it does not have.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Vibration {
    /// Centre of its power, Hz. What vibrates faster than half the sampling rate appears mirrored
    /// below it.
    pub frequency: f64,
    /// Width of the band in which it is, Hz.
    pub width: f64,
    /// Root mean square, in the unit of the series.
    pub rms: f64,
}

/// One-sided power spectral density.
#[derive(Debug, Clone, PartialEq)]
pub struct Spectrum {
    /// Distance of the frequencies, Hz; the first is zero.
    pub resolution: f64,
    /// unit^2/Hz.
    pub density: Vec<f64>,
    /// Equivalent degrees of freedom of each density.
    freedom: f64,
}

/// Resolution that is aimed for, Hz, and the least number of segments that are averaged.
const RESOLUTION: f64 = 0.4;
const FEWEST_SEGMENTS: usize = 8;
/// Probability that noise is taken for a vibration somewhere in a spectrum.
const FALSE_ALARM: f64 = 1e-3;
/// One-sided probability that a bin at the foot of a vibration is still noise.
const FOOT: f64 = 0.05;
/// Correlation of neighbouring periodograms at half overlap under a Hann window.
const OVERLAP_CORRELATION: f64 = 1.0 / 36.0;
/// Bins over which the window spreads a line, left out beside it.
const GUARD: usize = 4;
/// Part of all bins that makes the spectrum beside a frequency, on each side.
const NEIGHBOURHOOD: usize = 6;
/// Fewer bins than this have no median.
const FEWEST_NEIGHBOURS: usize = 8;

impl Spectrum {
    /// Welch's estimate: averaged periodograms of segments that overlap by half, under a Hann window,
    /// without their means. `None` for fewer values than eight segments of 32. O(n log n).
    pub fn welch(values: &[f64], interval: f64) -> Option<Self> {
        let aimed = (1.0 / (RESOLUTION * interval)).log2().round() as u32;
        let longest = (2 * values.len() / (FEWEST_SEGMENTS + 1)).checked_ilog2()?;
        let length = 1_usize << aimed.min(longest);
        if length < 32 {
            return None;
        }
        let window: Vec<f64> =
            (0..length).map(|k| (PI * (k as f64 + 0.5) / length as f64).sin().powi(2)).collect();
        let power: f64 = window.iter().map(|w| w * w).sum();
        let mut transformed = vec![Complex::new(0.0, 0.0); length];
        let mut density = vec![0.0; length / 2 + 1];
        let mut segments = 0.0;
        for segment in values.windows(length).step_by(length / 2) {
            let mean = segment.iter().sum::<f64>() / length as f64;
            for (entry, (value, weight)) in transformed.iter_mut().zip(segment.iter().zip(&window))
            {
                *entry = Complex::new((value - mean) * weight, 0.0);
            }
            fourier::transform(&mut transformed);
            for (sum, value) in density.iter_mut().zip(&transformed) {
                *sum += value.norm_sqr();
            }
            segments += 1.0;
        }
        let last = density.len() - 1;
        for (k, sum) in density.iter_mut().enumerate() {
            let sides = if k == 0 || k == last { 1.0 } else { 2.0 };
            *sum *= sides * interval / (power * segments);
        }
        Some(Self {
            resolution: 1.0 / (length as f64 * interval),
            density,
            freedom: 2.0 * segments / (1.0 + 2.0 * OVERLAP_CORRELATION),
        })
    }

    /// Relative standard deviation of a density.
    pub fn relative_sd(&self) -> f64 {
        (2.0 / self.freedom).sqrt()
    }

    /// The vibrations, and the power (unit^2) of each bin that belongs to them.
    ///
    /// A bin stands out where its density is above the medians on *both* sides of it, so that no
    /// slope of the spectrum (flicker, a low-pass filter of the sensor) is taken for a vibration.
    pub fn vibrations(&self) -> (Vec<Vibration>, Vec<f64>) {
        let bins = self.density.len();
        let mut power = vec![0.0; bins];
        let Ok(distribution) = ChiSquared::new(self.freedom) else { return (Vec::new(), power) };
        let times = |tail: f64| distribution.inverse_cdf(1.0 - tail) / self.freedom;
        let reach = bins / NEIGHBOURHOOD;
        // The medians have errors, too: three standard deviations are allowed for.
        let median_sd = 1.25 * self.relative_sd() / (reach.max(1) as f64).sqrt();
        let (limit, foot) =
            (times(FALSE_ALARM / bins as f64) * (1.0 + 3.0 * median_sd), times(FOOT));
        let background: Vec<f64> = (0..bins).map(|k| self.background(k, reach)).collect();
        let above = |k: usize, limit: f64| self.density[k] > limit * background[k];
        let mut vibrations = Vec::new();
        let mut k = 0;
        while k < bins {
            let length = (k..bins).take_while(|j| above(*j, foot)).count();
            let band = k..k + length;
            k += length.max(1);
            if !band.clone().any(|j| above(j, limit)) {
                continue;
            }
            let (mut sum, mut moment) = (0.0, 0.0);
            for j in band.clone() {
                power[j] = (self.density[j] - background[j]) * self.resolution;
                sum += power[j];
                moment += power[j] * j as f64;
            }
            vibrations.push(Vibration {
                frequency: moment / sum * self.resolution,
                width: band.len() as f64 * self.resolution,
                rms: sum.sqrt(),
            });
        }
        (vibrations, power)
    }

    /// The larger of the medians on both sides; infinite where a side has too few bins.
    fn background(&self, k: usize, reach: usize) -> f64 {
        let bins = self.density.len();
        // The mean is taken off bin 0, and the window spreads that to bin 1.
        let left = k.saturating_sub(reach).max(2)..k.saturating_sub(GUARD).max(2);
        // At the upper end the mirrored spectrum goes on.
        let right = k + GUARD + 1..k + reach + 1;
        if left.len() < FEWEST_NEIGHBOURS.min(reach.saturating_sub(GUARD)) || left.is_empty() {
            return f64::INFINITY;
        }
        let last = bins - 1;
        let mirrored = |j: usize| if j > last { (2 * last).saturating_sub(j) } else { j };
        let right = right.map(mirrored).filter(|j| j.abs_diff(k) > GUARD);
        let left = median(left.filter_map(|j| self.density.get(j).copied()).collect());
        let right = median(right.filter_map(|j| self.density.get(j).copied()).collect());
        // A density's median lies below its mean (Wilson and Hilferty).
        let bias = (1.0 - 2.0 / (9.0 * self.freedom)).powi(3);
        left.unwrap_or(f64::INFINITY).max(right.unwrap_or(0.0)) / bias
    }

    /// What `power` contributes to the Allan variance of averages of `factor` values.
    pub fn allan_variance(&self, power: &[f64], factor: usize, interval: f64) -> f64 {
        let bins = power.iter().enumerate().filter(|(_, power)| **power > 0.0);
        bins.map(|(k, power)| {
            // Over the width of the bin, as the transfer oscillates for long averages.
            let part = |x: f64| transfer((k as f64 + x) * self.resolution, factor, interval);
            power * (0..16).map(|i| part((f64::from(i) + 0.5) / 16.0 - 0.5)).sum::<f64>() / 16.0
        })
        .sum()
    }
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}
