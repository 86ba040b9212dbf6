use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};
use statrs::distribution::{ChiSquared, ContinuousCDF};

use super::{AttitudeUpdate, ConsistencyConfig};
use crate::filter::PositionMeasurement;
use crate::inertial::ImuConfig;
use crate::sensor::PositionFix;

/// Everything an IMU-GNSS run can be told, by section.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GnssConfig {
    pub log: NavigationLogConfig,
    pub imu: ImuConfig,
    pub receiver: ReceiverConfig,
    pub start: StartConfig,
    pub filter: GnssFilterConfig,
    pub consistency: ConsistencyConfig,
    pub outage: OutageConfig,
    pub output: OutputConfig,
}

/// Where samples and fixes are in a log, and in which axes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NavigationLogConfig {
    /// Topic of the IMU in a bag or MCAP file; empty: chosen by message type.
    pub imu_topic: String,
    /// Topic of the fixes likewise.
    pub gnss_topic: String,
    pub imu_axes: ImuAxes,
    pub world_axes: WorldAxes,
}

impl Default for NavigationLogConfig {
    fn default() -> Self {
        Self {
            imu_topic: String::new(),
            gnss_topic: String::new(),
            imu_axes: ImuAxes::Auto,
            world_axes: WorldAxes::Auto,
        }
    }
}

/// Axes of the IMU; outputs are in forward, left, up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ImuAxes {
    /// Forward, right, down if the specific force points along -z, else as they are.
    Auto,
    /// Forward, left, up, or any others that are to stay.
    Flu,
    /// Forward, right, down.
    Frd,
}

/// Axes of positions in a local frame; outputs are in east, north, up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum WorldAxes {
    /// By the names of the columns; z up where they tell nothing.
    Auto,
    /// East, north, up.
    Enu,
    /// North, east, down.
    Ned,
}

/// The GNSS receiver and how its fixes are trusted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ReceiverConfig {
    /// Standard deviation of a fix along each horizontal axis, m, where the log tells none.
    pub horizontal_noise: f64,
    /// Standard deviation of a fix along the vertical, m, where the log tells none.
    pub vertical_noise: f64,
    /// Whether the covariance that a log tells of a fix counts.
    pub use_log_covariance: bool,
    /// By what the standard deviations of fixes are multiplied, told or configured.
    pub noise_scale: f64,
    /// Standard deviation, m, of what is added to each axis of a fix that lies within a stretch of
    /// interpolated IMU samples, because such a log has interpolated positions, too.
    pub interpolated_noise: f64,
    /// The antenna in body coordinates, m.
    pub lever_arm: [f64; 3],
    /// A fix is rejected if its normalized innovation squared exceeds the chi-square bound of this
    /// probability (3 degrees of freedom); 1 accepts every fix.
    pub gate_probability: f64,
    /// After so many rejections in a row the next fix is used. The position is taken to have jumped:
    /// it is given up, the rest of the state being kept, unless
    /// [`surprise_probability`](GnssFilterConfig::surprise_probability) says that all of it is to
    /// be less certain.
    pub max_rejected: usize,
}

impl Default for ReceiverConfig {
    fn default() -> Self {
        Self {
            horizontal_noise: 1.0,
            vertical_noise: 2.0,
            use_log_covariance: true,
            noise_scale: 1.0,
            interpolated_noise: 0.0,
            lever_arm: [0.0; 3],
            gate_probability: 1.0,
            max_rejected: 5,
        }
    }
}

impl ReceiverConfig {
    /// The measurement that is a fix, `interpolated` with the IMU's samples around it or not. Its
    /// noise is what the log tells of it, else that of the configuration.
    pub(super) fn measurement(&self, fix: &PositionFix, interpolated: bool) -> PositionMeasurement {
        let added = if interpolated { self.interpolated_noise.powi(2) } else { 0.0 };
        let (horizontal, vertical) = (self.horizontal_noise.powi(2), self.vertical_noise.powi(2));
        let configured = Matrix3::from_diagonal(&Vector3::new(horizontal, horizontal, vertical));
        let told = fix.covariance.filter(|_| self.use_log_covariance);
        PositionMeasurement {
            in_world: fix.position,
            covariance: told.unwrap_or(configured) * self.noise_scale.powi(2)
                + Matrix3::from_diagonal_element(added),
            lever_arm: Vector3::from(self.lever_arm),
        }
    }

    /// Largest acceptable normalized innovation squared.
    pub(super) fn gate(&self) -> f64 {
        bound(self.gate_probability)
    }
}

/// What a normalized innovation squared exceeds with the probability that is left.
fn bound(probability: f64) -> f64 {
    match ChiSquared::new(3.0) {
        Ok(distribution) if probability < 1.0 => distribution.inverse_cdf(probability.max(0.0)),
        _ => f64::INFINITY,
    }
}

/// What is known of the motion at the first fix. The position starts from that fix.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StartConfig {
    /// Length of the window after the first fix over which the IMU is levelled, s.
    pub window: f64,
    /// Standard deviation of roll and pitch so found, deg.
    pub tilt_sd: f64,
    /// Whether `heading` is known; else every heading is as likely as any other.
    pub heading_known: bool,
    /// Rotation about the vertical after levelling, deg.
    pub heading: f64,
    /// Its standard deviation, deg.
    pub heading_sd: f64,
    /// Standard deviation of each component of the velocity about zero, m/s.
    pub velocity_sd: f64,
    /// The heading counts as converged once its standard deviation is below this, deg.
    pub converged_heading_sd: f64,
}

impl Default for StartConfig {
    fn default() -> Self {
        Self {
            window: 1.0,
            tilt_sd: 5.0,
            heading_known: false,
            heading: 0.0,
            heading_sd: 5.0,
            velocity_sd: 10.0,
            converged_heading_sd: 5.0,
        }
    }
}

/// How the filters update.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GnssFilterConfig {
    /// `flow` or `sigma-points` (W22 table 5.2); for the matrix Fisher-Gaussian filters.
    pub attitude_update: AttitudeUpdate,
    /// A fix beyond the chi-square bound of this probability shows that the belief was too sure of
    /// itself: its covariance is multiplied until the fix lies on the bound. 1 leaves it alone.
    pub surprise_probability: f64,
}

impl Default for GnssFilterConfig {
    fn default() -> Self {
        Self { attitude_update: AttitudeUpdate::default(), surprise_probability: 1.0 }
    }
}

impl GnssFilterConfig {
    /// Largest normalized innovation squared that the belief is taken to allow for.
    pub(super) fn surprise(&self) -> f64 {
        bound(self.surprise_probability)
    }
}

/// Artificial outages: fixes in them are withheld and compared with the prediction.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct OutageConfig {
    /// Start of the first outage after the first fix, s.
    pub start: f64,
    /// Length of each outage, s; 0 for none.
    pub length: f64,
    /// From one start to the next, s; 0 for a single outage.
    pub period: f64,
}

impl OutageConfig {
    /// Number of the outage in which the time `elapsed` (s) after the first fix lies.
    pub fn index_at(&self, elapsed: f64) -> Option<usize> {
        let since = elapsed - self.start;
        if !(self.length > 0.0 && since >= 0.0) {
            return None;
        }
        let number = if self.period > 0.0 { (since / self.period).floor() } else { 0.0 };
        (since - number * self.period < self.length).then_some(number as usize)
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct OutputConfig {
    /// Shortest time between two lines that are no fix, s.
    pub interval: f64,
}

impl Default for OutputConfig {
    fn default() -> Self {
        Self { interval: 0.1 }
    }
}

impl GnssConfig {
    /// The first key whose value has no meaning, and what it must be.
    pub(super) fn first_mistake(&self) -> Option<(&'static str, &'static str)> {
        const POSITIVE: &str = "a finite positive number";
        const NOT_NEGATIVE: &str = "a finite number that is not negative";
        let positive = [
            ("imu.gyro_bias_sd", self.imu.gyro_bias_sd),
            ("imu.accel_bias_sd", self.imu.accel_bias_sd),
            ("imu.max_gap", self.imu.max_gap),
            ("receiver.horizontal_noise", self.receiver.horizontal_noise),
            ("receiver.vertical_noise", self.receiver.vertical_noise),
            ("receiver.noise_scale", self.receiver.noise_scale),
            ("start.tilt_sd", self.start.tilt_sd),
            ("start.heading_sd", self.start.heading_sd),
            ("start.velocity_sd", self.start.velocity_sd),
        ];
        let not_negative = [
            ("imu.gyro_noise", self.imu.gyro_noise),
            ("imu.accel_noise", self.imu.accel_noise),
            ("imu.gyro_bias_walk", self.imu.gyro_bias_walk),
            ("imu.accel_bias_walk", self.imu.accel_bias_walk),
            ("imu.gap_gyro_noise", self.imu.gap_gyro_noise),
            ("imu.gap_accel_noise", self.imu.gap_accel_noise),
            ("receiver.interpolated_noise", self.receiver.interpolated_noise),
            ("receiver.gate_probability", self.receiver.gate_probability),
            ("filter.surprise_probability", self.filter.surprise_probability),
            ("consistency.false_alarm_probability", self.consistency.false_alarm_probability),
            ("start.window", self.start.window),
            ("start.converged_heading_sd", self.start.converged_heading_sd),
            ("outage.start", self.outage.start),
            ("outage.length", self.outage.length),
            ("outage.period", self.outage.period),
            ("output.interval", self.output.interval),
        ];
        let finite = [
            ("imu.accelerometer_scale", self.imu.accelerometer_scale),
            ("imu.gyroscope_scale", self.imu.gyroscope_scale),
            ("imu.gravity", self.imu.gravity),
            ("receiver.lever_arm", self.receiver.lever_arm.iter().sum()),
            ("start.heading", self.start.heading),
        ];
        let mistakes = positive.into_iter().filter(|(_, x)| !(x.is_finite() && *x > 0.0));
        let mistakes = mistakes.map(|(key, _)| (key, POSITIVE));
        let negative = not_negative.into_iter().filter(|(_, x)| !(x.is_finite() && *x >= 0.0));
        let infinite = finite.into_iter().filter(|(_, x)| !x.is_finite());
        mistakes
            .chain(negative.map(|(key, _)| (key, NOT_NEGATIVE)))
            .chain(infinite.map(|(key, _)| (key, "finite")))
            .next()
    }
}
