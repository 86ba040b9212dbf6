//! Noise of an IMU from what it reads at rest: Allan deviation, coefficients, vibrations.

mod allan;
mod fit;
pub(crate) mod fourier;
mod rest;
mod spectrum;
#[cfg(test)]
mod tests;

use std::ops::Range;

use nalgebra::Vector6;
use serde::Serialize;

use super::ImuConfig;
use crate::sensor::ImuSample;
use fit::Observations;

pub use allan::{AllanPoint, allan_deviation};
pub use fit::{Coefficient, NoiseFit};
pub use spectrum::{Spectrum, Vibration};

/// Which part of an IMU.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum InertialSensor {
    Gyroscope,
    Accelerometer,
}

impl InertialSensor {
    /// Unit of its readings.
    pub fn unit(self) -> &'static str {
        match self {
            Self::Gyroscope => "rad/s",
            Self::Accelerometer => "m/s^2",
        }
    }
}

/// A span of a log at rest.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct RestSpan {
    /// Stamps of the first and the last sample, s.
    pub start: f64,
    pub end: f64,
}

impl RestSpan {
    pub fn seconds(&self) -> f64 {
        self.end - self.start
    }
}

/// Noise of one axis.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AxisNoise {
    pub sensor: InertialSensor,
    pub axis: char,
    pub unit: &'static str,
    /// Mean reading at rest: bias, and gravity in an accelerometer.
    pub mean: f64,
    /// Root mean square about the mean.
    pub rms: f64,
    pub white_noise: Coefficient,
    pub bias_instability: Coefficient,
    pub random_walk: Coefficient,
    /// White noise that an integration over a thirtieth of a second to a second sees, vibrations
    /// included, unit/sqrt(Hz): the largest `sqrt(tau AVAR(tau))` there.
    pub noise_in_use: f64,
    pub vibrations: Vec<Vibration>,
    pub allan: Vec<AllanPoint>,
    /// The model's deviation at each of them.
    pub model: Vec<f64>,
}

/// Noise of an IMU, from its longest rest.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ImuNoise {
    pub rest: RestSpan,
    /// All spans at rest.
    pub rests: Vec<RestSpan>,
    /// Samples a second.
    pub rate: f64,
    /// Samples in the rest, and how many of them stand for lost ones.
    pub samples: usize,
    pub interpolated: usize,
    /// x, y, z of the gyroscope, then of the accelerometer.
    pub axes: Vec<AxisNoise>,
}

/// Why no noise can be told.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum IdentificationError {
    #[error(
        "{samples} samples over {seconds:.3} s are too few: noise is measured on at least {needed} s \
         at rest, walks and instability on minutes to hours"
    )]
    TooFew { samples: usize, seconds: f64, needed: f64 },
    #[error(
        "the IMU is never at rest for {needed} s in the {seconds:.1} s of the log without a gap: noise \
         is measured on a body that lies still (motors may run); walks and instability need minutes \
         to hours"
    )]
    NoRest { seconds: f64, needed: f64 },
    #[error(
        "{sensor:?} {axis} reads the same value throughout the rest from {start:.3} s: no sensor, or \
         noise below its resolution"
    )]
    Constant { sensor: InertialSensor, axis: char, start: f64 },
}

/// Rest that is needed: ten averages of one second, s.
const LEAST_REST: f64 = 10.0;
/// A pause between two samples of more than this many intervals ends a span; in shorter ones the lost
/// samples are interpolated.
const LONGEST_PAUSE: f64 = 5.0;
/// A mean rate of more than this many standard deviations of the bias is motion.
const BIAS_LIMIT: f64 = 5.0;
/// Averaging times that an odometry integrates over, s: between two images, and until points have
/// told the velocity.
const IN_USE: [f64; 2] = [1.0 / 30.0, 1.0];

impl ImuNoise {
    /// Noise of the IMU whose samples (SI units) these are, in order of their stamps, from its
    /// longest rest.
    ///
    /// # Errors
    /// [`IdentificationError`] where there is too little rest, or an axis that reads nothing.
    pub fn identify(
        samples: &[ImuSample],
        config: &ImuConfig,
    ) -> Result<Self, IdentificationError> {
        let too_few = || IdentificationError::TooFew {
            samples: samples.len(),
            seconds: duration(samples),
            needed: LEAST_REST,
        };
        let interval = median_interval(samples).ok_or_else(too_few)?;
        if duration(samples) < LEAST_REST {
            return Err(too_few());
        }
        let mut rests = Vec::new();
        let mut longest: Option<(RestSpan, Vec<Vector6<f64>>, f64)> = None;
        for span in without_pauses(samples, interval) {
            let Some(uniform) = Uniform::new(&samples[span], interval) else { continue };
            let largest_rate = BIAS_LIMIT * config.gyro_bias_sd;
            for range in rest::spans_at_rest(&uniform.values, uniform.interval, largest_rate) {
                let rest = uniform.span(&range);
                if longest.as_ref().is_none_or(|(best, ..)| rest.seconds() > best.seconds()) {
                    longest = Some((rest, uniform.values[range].to_vec(), uniform.interval));
                }
                rests.push(rest);
            }
        }
        let (rest, values, interval) = longest.ok_or_else(|| IdentificationError::NoRest {
            seconds: duration(samples),
            needed: LEAST_REST,
        })?;
        let axes: Result<_, _> = (0..6).map(|k| axis_noise(k, &values, interval, &rest)).collect();
        let read = samples
            .iter()
            .map(|sample| sample.stamp.seconds())
            .filter(|t| (rest.start..=rest.end).contains(t))
            .count();
        Ok(Self {
            rest,
            rests,
            rate: 1.0 / interval,
            samples: values.len(),
            interpolated: values.len().saturating_sub(read),
            axes: axes?,
        })
    }

    /// The axes of a sensor.
    pub fn of(&self, sensor: InertialSensor) -> impl Iterator<Item = &AxisNoise> {
        self.axes.iter().filter(move |axis| axis.sensor == sensor)
    }

    /// White noise to estimate with: of the noisiest axis, as an integration sees it.
    pub fn white_noise(&self, sensor: InertialSensor) -> f64 {
        self.of(sensor).map(|axis| axis.noise_in_use).fold(0.0, f64::max)
    }

    /// Bias random walk to estimate with, of the axis that wanders most; `None` where the rest was too
    /// short to show one.
    pub fn bias_walk(&self, sensor: InertialSensor) -> Option<f64> {
        self.of(sensor).filter_map(AxisNoise::bias_walk).reduce(f64::max)
    }
}

impl AxisNoise {
    /// The random walk that stands for instability and walk together, whose Allan variance is the
    /// model's where the flicker meets the white noise: at `tau = N^2 / (c B^2)`, `c = 2 ln 2 / pi`,
    /// `K_e^2 = K^2 + 3 c^2 B^4 / N^2`.
    pub fn bias_walk(&self) -> Option<f64> {
        let seen = |c: &Coefficient| if c.significant { c.value.powi(2) } else { 0.0 };
        let flicker =
            std::f64::consts::LN_2 * std::f64::consts::FRAC_2_PI * seen(&self.bias_instability);
        let walk = seen(&self.random_walk);
        let square = walk + 3.0 * (flicker / self.white_noise.value).powi(2);
        (square > 0.0 && square.is_finite()).then(|| square.sqrt())
    }
}

fn duration(samples: &[ImuSample]) -> f64 {
    match samples {
        [first, .., last] => last.stamp.seconds_since(first.stamp),
        _ => 0.0,
    }
}

fn median_interval(samples: &[ImuSample]) -> Option<f64> {
    let mut intervals: Vec<f64> =
        samples.windows(2).map(|pair| pair[1].stamp.seconds_since(pair[0].stamp)).collect();
    intervals.sort_unstable_by(f64::total_cmp);
    intervals.get(intervals.len() / 2).copied().filter(|interval| *interval > 0.0)
}

/// Ranges without a pause between two samples, or an impossible one.
fn without_pauses(samples: &[ImuSample], interval: f64) -> Vec<Range<usize>> {
    let mut spans = Vec::new();
    let mut first = 0;
    for k in 0..samples.len() {
        let follows = samples.get(k + 1).is_some_and(|next| {
            let pause = next.stamp.seconds_since(samples[k].stamp);
            next.is_possible() && pause > 0.0 && pause <= LONGEST_PAUSE * interval
        });
        if !follows {
            if samples[first].is_possible() {
                spans.push(first..k + 1);
            }
            first = k + 1;
        }
    }
    spans
}

/// Readings (rad/s, m/s^2) at equal intervals.
struct Uniform {
    start: f64,
    interval: f64,
    values: Vec<Vector6<f64>>,
}

impl Uniform {
    /// Samples one after another, whatever their stamps' jitter, with interpolated ones where some
    /// were lost.
    fn new(samples: &[ImuSample], median: f64) -> Option<Self> {
        let first = samples.first()?;
        let mut values = vec![reading(first)];
        for pair in samples.windows(2) {
            let pause = pair[1].stamp.seconds_since(pair[0].stamp);
            let steps = (pause / median).round().max(1.0);
            let (before, after) = (reading(&pair[0]), reading(&pair[1]));
            values.extend((1..=steps as usize).map(|k| before.lerp(&after, k as f64 / steps)));
        }
        let interval = duration(samples) / (values.len() - 1) as f64;
        (interval > 0.0).then(|| Self { start: first.stamp.seconds(), interval, values })
    }

    fn span(&self, range: &Range<usize>) -> RestSpan {
        let at = |k: usize| self.start + k as f64 * self.interval;
        RestSpan { start: at(range.start), end: at(range.end.saturating_sub(1)) }
    }
}

fn reading(sample: &ImuSample) -> Vector6<f64> {
    let (rate, force) = (sample.angular_velocity, sample.specific_force);
    Vector6::new(rate.x, rate.y, rate.z, force.x, force.y, force.z)
}

fn axis_noise(
    k: usize,
    values: &[Vector6<f64>],
    interval: f64,
    rest: &RestSpan,
) -> Result<AxisNoise, IdentificationError> {
    let sensor = if k < 3 { InertialSensor::Gyroscope } else { InertialSensor::Accelerometer };
    let axis = ['x', 'y', 'z'][k % 3];
    let series: Vec<f64> = values.iter().map(|value| value[k]).collect();
    let constant = || IdentificationError::Constant { sensor, axis, start: rest.start };
    let mean = series.iter().sum::<f64>() / series.len() as f64;
    let variance = series.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / series.len() as f64;
    let allan = allan_deviation(&series, interval);
    if allan.iter().any(|point| point.deviation == 0.0) {
        return Err(constant());
    }
    let spectrum = Spectrum::welch(&series, interval).ok_or_else(constant)?;
    let (vibrations, power) = spectrum.vibrations();
    let vibration: Vec<f64> =
        allan.iter().map(|point| spectrum.allan_variance(&power, point.factor, interval)).collect();
    let observations = Observations {
        points: &allan,
        count: series.len(),
        vibration: &vibration,
        vibration_sd: spectrum.relative_sd(),
    };
    let fit = NoiseFit::new(&observations).ok_or_else(constant)?;
    let in_use = allan.iter().filter(|p| (IN_USE[0]..=IN_USE[1]).contains(&p.tau));
    Ok(AxisNoise {
        sensor,
        axis,
        unit: sensor.unit(),
        mean,
        rms: variance.sqrt(),
        white_noise: fit.white_noise,
        bias_instability: fit.bias_instability,
        random_walk: fit.random_walk,
        noise_in_use: in_use.map(|p| p.deviation * p.tau.sqrt()).fold(0.0, f64::max),
        vibrations,
        model: allan.iter().map(|point| fit.deviation(point)).collect(),
        allan,
    })
}
