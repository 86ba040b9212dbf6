//! Rest and the gyro bias that it shows.

use nalgebra::Vector3;

use super::{Interval, independent_share};

/// Intervals that must all be alike for the body to be at rest: 1.5 s of the default ones.
const INTERVALS: usize = 15;

/// When the body is at rest, and what the gyroscope then says of its bias.
///
/// The means of short intervals are compared, which the white noise of the sensors hardly moves;
/// a standing start is judged by single samples ([`super::super::StandstillConfig`]).
#[derive(Debug, Clone, PartialEq)]
pub struct RestConfig {
    /// Largest deviation of an interval's rate from the mean of all, rad/s.
    pub max_rate_deviation: f64,
    /// Largest deviation of an interval's specific force from the mean of all, m/s^2.
    pub max_force_deviation: f64,
    /// Largest mean rate (what a bias may explain), rad/s.
    pub max_rate: f64,
    /// Standard deviation of one independent reading of the bias at rest, rad/s.
    pub reading_sd: f64,
    /// Correlation time of the readings, s.
    pub correlation_time: f64,
    /// Standard deviation of the bias at the start, rad/s.
    pub bias_sd: f64,
    /// Random walk of the bias, rad/s/sqrt(s).
    pub bias_walk: f64,
}

impl Default for RestConfig {
    fn default() -> Self {
        Self {
            max_rate_deviation: 2f64.to_radians(),
            max_force_deviation: 0.5,
            max_rate: 3f64.to_radians(),
            reading_sd: 5e-4,
            correlation_time: 0.5,
            bias_sd: 1f64.to_radians(),
            bias_walk: 2e-5,
        }
    }
}

/// Watches the last intervals, and keeps the bias with one variance for all axes.
#[derive(Debug, Clone)]
pub(super) struct RestFinder {
    config: RestConfig,
    /// Rate and specific force of the last intervals, in no order.
    recent: [(Vector3<f64>, Vector3<f64>); INTERVALS],
    seen: usize,
    bias: Vector3<f64>,
    variance: f64,
}

impl RestFinder {
    pub fn new(config: &RestConfig) -> Self {
        Self {
            config: config.clone(),
            recent: Default::default(),
            seen: 0,
            bias: Vector3::zeros(),
            variance: config.bias_sd.powi(2),
        }
    }

    pub fn forget_motion(&mut self) {
        self.seen = 0;
    }

    pub fn bias(&self) -> (Vector3<f64>, f64) {
        (self.bias, self.variance)
    }

    /// At rest: the reading of the bias and its variance, which the bias here has then taken in.
    pub fn measure(&mut self, mean: &Interval) -> Option<(Vector3<f64>, f64)> {
        self.variance += self.config.bias_walk.powi(2) * mean.seconds;
        if let Some(oldest) = self.recent.get_mut(self.seen % INTERVALS) {
            *oldest = (mean.rate, mean.specific_force);
        }
        self.seen += 1;
        if self.seen < INTERVALS || !self.is_at_rest() {
            return None;
        }
        let share = independent_share(mean.seconds, self.config.correlation_time);
        let variance = self.config.reading_sd.powi(2) / share;
        let gain = self.variance / (self.variance + variance);
        self.bias += (mean.rate - self.bias) * gain;
        self.variance *= 1.0 - gain;
        Some((mean.rate, variance))
    }

    fn is_at_rest(&self) -> bool {
        let of_all = (INTERVALS as f64).recip();
        let rate = self.recent.iter().map(|r| r.0).sum::<Vector3<f64>>() * of_all;
        let force = self.recent.iter().map(|r| r.1).sum::<Vector3<f64>>() * of_all;
        let RestConfig { max_rate_deviation, max_force_deviation, max_rate, .. } = self.config;
        rate.norm() < max_rate
            && self.recent.iter().all(|r| (r.0 - rate).norm() < max_rate_deviation)
            && self.recent.iter().all(|r| (r.1 - force).norm() < max_force_deviation)
    }
}
