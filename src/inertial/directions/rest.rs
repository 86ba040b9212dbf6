//! Rest and the gyro bias that it shows.

use nalgebra::{SVector, Vector3};
use serde::{Deserialize, Serialize};

use super::{Interval, Prediction, independent_share};

/// Intervals in the window that is judged, 1.5 s, in blocks.
const BLOCKS: usize = 3;
const BLOCK: usize = 5;
const INTERVALS: usize = BLOCKS * BLOCK;

/// When the body is at rest, and what the gyroscope then says of its bias.
///
/// The means of short intervals are compared, which the white noise of the sensors hardly moves.
/// There is no limit on the rate itself, which may be all bias: a slow and steady turn betrays
/// itself by how it changes within the window, by the direction of the specific force and of the
/// magnetic field, and by a bias that is known to be another.
///
/// A standing start is judged by single samples ([`super::super::StandstillConfig`]).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RestConfig {
    /// Largest root mean square deviation of the intervals' rates from their mean, rad/s.
    pub max_rate_deviation: f64,
    /// The same of the specific force, m/s^2.
    pub max_force_deviation: f64,
    /// The same of the magnetic field, relative to it.
    pub max_field_deviation: f64,
    /// Standard deviation of one independent reading of the bias at rest, rad/s.
    pub reading_sd: f64,
    /// How much more a motion may hide in the window than it shows, as a factor on the variance of
    /// the means of its thirds.
    pub hidden_motion: f64,
    /// Correlation time of the readings, s.
    pub correlation_time: f64,
    /// Squared deviation from the known bias, in standard deviations, beyond which the body turns.
    pub turning_above: f64,
}

impl Default for RestConfig {
    fn default() -> Self {
        Self {
            max_rate_deviation: 1f64.to_radians(),
            max_force_deviation: 0.5,
            max_field_deviation: 0.05,
            reading_sd: 5e-4,
            hidden_motion: 2.0,
            correlation_time: 0.5,
            turning_above: 25.0,
        }
    }
}

/// Rate, specific force and magnetic field of an interval.
type Reading = SVector<f64, 9>;

/// Watches the last intervals.
#[derive(Debug, Clone)]
pub(super) struct RestFinder {
    config: RestConfig,
    /// The last intervals; the next one takes the place of the oldest.
    recent: [Reading; INTERVALS],
    seen: usize,
}

impl RestFinder {
    pub fn new(config: &RestConfig) -> Self {
        Self { config: config.clone(), recent: [Reading::zeros(); INTERVALS], seen: 0 }
    }

    pub fn forget_motion(&mut self) {
        self.seen = 0;
    }

    /// At rest: the interval's reading of the bias and its variance.
    pub fn measure(
        &mut self,
        mean: &Interval,
        prediction: &Prediction,
    ) -> Option<(Vector3<f64>, f64)> {
        let mut reading = Reading::zeros();
        for (start, value) in [mean.rate, mean.specific_force, mean.field].iter().enumerate() {
            reading.fixed_rows_mut::<3>(3 * start).copy_from(value);
        }
        if let Some(oldest) = self.recent.get_mut(self.seen % INTERVALS) {
            *oldest = reading;
        }
        self.seen += 1;
        if self.seen < INTERVALS {
            return None;
        }
        let variance = self.variance_at_rest(prediction)?;
        let share = independent_share(mean.seconds, self.config.correlation_time);
        Some((mean.rate, variance / share))
    }

    /// Variance of the mean rate of the window as a bias per axis; `None` unless at rest.
    fn variance_at_rest(&self, prediction: &Prediction) -> Option<f64> {
        let of_all = (INTERVALS as f64).recip();
        let mean: Reading = self.recent.iter().sum::<Reading>() * of_all;
        let mut squares = [0.0; 3];
        for reading in &self.recent {
            for (kind, square) in squares.iter_mut().enumerate() {
                let deviation = reading.fixed_rows::<3>(3 * kind) - mean.fixed_rows::<3>(3 * kind);
                *square += deviation.norm_squared() * of_all;
            }
        }
        let [rate, force, field] = squares;
        let config = &self.config;
        let known_field = mean.fixed_rows::<3>(6).norm_squared();
        let steady = rate < config.max_rate_deviation.powi(2)
            && force < config.max_force_deviation.powi(2)
            && field <= config.max_field_deviation.powi(2) * known_field;
        let gravity = mean.fixed_rows::<3>(3).norm_squared();
        if !steady || gravity == 0.0 {
            return None;
        }
        let seconds = super::INTERVAL * INTERVALS as f64;
        let tilting = force / (gravity * seconds.powi(2));
        let hidden = config.hidden_motion * (self.variance_of_blocks(&mean) + tilting);
        let variance = config.reading_sd.powi(2) + hidden;
        let surprise = (mean.fixed_rows::<3>(0) - prediction.gyro_bias).norm_squared();
        let expected = prediction.bias_variance() + variance;
        (surprise < config.turning_above * expected).then_some(variance)
    }

    /// Variance of the mean rates of the window's thirds, all axes together.
    fn variance_of_blocks(&self, mean: &Reading) -> f64 {
        let square = |block: usize| {
            let intervals = (0..BLOCK).map(|i| (self.seen + block * BLOCK + i) % INTERVALS);
            let sum: Vector3<f64> =
                intervals.map(|i| self.recent[i].fixed_rows::<3>(0).into_owned()).sum();
            (sum / BLOCK as f64 - mean.fixed_rows::<3>(0)).norm_squared()
        };
        (0..BLOCKS).map(square).sum::<f64>() / (BLOCKS - 1) as f64
    }
}
