//! Up from the specific force.

use nalgebra::{Matrix3, Matrix3x4, Vector3};
use serde::{Deserialize, Serialize};

use super::{CorrelatedError, InertialDirection, Interval, Prediction};
use crate::so3::hat;

/// How far the specific force is believed to show gravity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GravityConfig {
    /// Time constant of each of the two low-passes, s.
    pub time_constant: f64,
    /// Share of the acceleration that the low-passes let through at least: `1/(1 + w^2 T^2)` at
    /// the frequency of the motion.
    pub surviving_share: f64,
    /// Frequency of the motion, rad/s: of what is averaged over `t` seconds, `1/(1 + (w t/2)^2)`
    /// survives.
    pub motion_frequency: f64,
    /// Acceleration before any was measured, m/s^2.
    pub initial_acceleration: f64,
    /// Standard deviation from misalignment, scale and bias of the accelerometer, rad.
    pub calibration_sd: f64,
    /// Relative error of the magnitude that calibration explains. More is an acceleration that
    /// lasts.
    pub magnitude_tolerance: f64,
    /// Correlation time of these errors, s.
    pub correlation_time: f64,
    /// Correlation time of what accelerations leave that last, s.
    pub acceleration_time: f64,
    /// Time over which the deviation from the expected direction is averaged, s.
    pub memory: f64,
    /// A deviation that stays the same for so long is no acceleration, s.
    pub longest_acceleration: f64,
}

impl Default for GravityConfig {
    fn default() -> Self {
        Self {
            time_constant: 1.5,
            surviving_share: 0.02,
            motion_frequency: 2.0,
            initial_acceleration: 1.0,
            calibration_sd: 0.4f64.to_radians(),
            magnitude_tolerance: 0.01,
            correlation_time: 0.5,
            acceleration_time: 3.0,
            memory: 5.0,
            longest_acceleration: 40.0,
        }
    }
}

/// Share of the initial acceleration in the mean of the first one, as the weight of a low-pass.
const INITIAL_WEIGHT: f64 = 0.5;

/// A vector in inertial coordinates, and in the further columns its derivative by the bias of the
/// gyroscope that carried it there, from the start of the frame on.
type Carried = Matrix3x4<f64>;

/// A low-pass of first order that starts from its first input.
#[derive(Debug, Clone, Copy, Default)]
struct LowPass {
    /// Weighted sum of the inputs and the sum of the weights.
    sum: Carried,
    weight: f64,
}

impl LowPass {
    fn push(&mut self, input: &Carried, gain: f64) -> Carried {
        self.sum += (input - self.sum) * gain;
        self.weight += (1.0 - self.weight) * gain;
        self.sum / self.weight
    }

    /// The bias changes, and the frame keeps its place at its end, up to which it would have been
    /// turned by `turn`.
    fn change_bias(&mut self, change: &Vector3<f64>, turn: &Vector3<f64>) {
        let vector = self.sum.column(0) + self.sum.fixed_columns::<3>(1) * change;
        self.sum.set_column(0, &(vector - vector.cross(turn)));
    }
}

/// Low-passes the specific force in inertial coordinates.
#[derive(Debug, Clone)]
pub(super) struct GravityFinder {
    config: GravityConfig,
    /// m/s^2.
    gravity: f64,
    first: LowPass,
    second: LowPass,
    /// Time since the low-passes were empty, s.
    filled: f64,
    /// Mean square of the acceleration, m^2/s^4, as the sum and the weight of a low-pass.
    acceleration: (f64, f64),
    /// Deviation of the direction from the expected one: what lasts of it, rad, and the mean square
    /// about each axis of what does not and is not expected either, rad^2.
    lasting: Vector3<f64>,
    unexpected: f64,
    error: CorrelatedError,
    /// Variance of the direction that was found last, rad^2.
    variance: f64,
}

impl GravityFinder {
    pub fn new(config: &GravityConfig, gravity: f64) -> Self {
        let initial = config.initial_acceleration.powi(2) * INITIAL_WEIGHT;
        Self {
            config: config.clone(),
            gravity,
            first: LowPass::default(),
            second: LowPass::default(),
            filled: 0.0,
            acceleration: (initial, INITIAL_WEIGHT),
            lasting: Vector3::zeros(),
            unexpected: 0.0,
            error: CorrelatedError::default(),
            variance: 1.0,
        }
    }

    /// What was read before counts less: it was carried here with this variance.
    pub fn doubt_turn(&mut self, variance: f64) {
        let kept = self.variance / (self.variance + variance);
        for low_pass in [&mut self.first, &mut self.second] {
            low_pass.sum *= kept;
            low_pass.weight *= kept;
        }
        self.filled *= kept;
        self.error.lose(variance);
    }

    /// Begins to average anew; how the body accelerates is kept.
    pub fn forget_direction(&mut self) {
        (self.first, self.second) = (LowPass::default(), LowPass::default());
        self.filled = 0.0;
        self.lasting = Vector3::zeros();
        self.error = CorrelatedError::default();
    }

    pub fn change_bias(&mut self, change: &Vector3<f64>, turn_by_bias: &Matrix3<f64>) {
        let turn = turn_by_bias * change;
        self.first.change_bias(change, &turn);
        self.second.change_bias(change, &turn);
    }

    pub fn measure(
        &mut self,
        mean: &Interval,
        turn_by_bias: &Matrix3<f64>,
        prediction: &Prediction,
        expected: Option<&InertialDirection>,
    ) -> Option<InertialDirection> {
        let gain = -(-mean.seconds / self.config.time_constant).exp_m1();
        self.filled += mean.seconds;
        let force = mean.inertial_specific_force;
        let mut carried = Carried::zeros();
        carried.set_column(0, &force);
        carried.fixed_columns_mut::<3>(1).copy_from(&(hat(&force) * turn_by_bias));
        let first = self.first.push(&carried, gain);
        let second = self.second.push(&first, gain);
        let smooth = second.column(0).into_owned();
        let (sum, weight) = &mut self.acceleration;
        *sum += ((force - smooth).norm_squared() - *sum) * gain;
        *weight += (1.0 - *weight) * gain;
        let acceleration = *sum / *weight / self.gravity.powi(2);
        let direction = smooth.try_normalize(0.1 * self.gravity)?;

        // What was read some time ago was turned by a bias that is not known exactly.
        let by_bias = second.fixed_columns::<3>(1) - hat(&smooth) * turn_by_bias;
        let turned = by_bias * prediction.gyro_bias_covariance * by_bias.transpose();
        let carried_variance = 0.5 * turned.trace() / smooth.norm_squared();

        let excess = (smooth.norm() / self.gravity - 1.0).abs();
        let averaged = self.averaged_variance(acceleration);
        // A lasting horizontal acceleration `a` makes the magnitude `g + a^2/(2 g)` and the tilt
        // `a/g`; no more than that and what moves can the deviation be.
        let lasting = match expected {
            None => 2.0 * (excess - self.config.magnitude_tolerance).max(0.0),
            Some(expected) => self
                .unexpected(&direction, expected, carried_variance, mean.seconds)
                .min(acceleration + 2.0 * excess),
        };
        let config = &self.config;
        let correlation_time = (averaged * config.correlation_time
            + lasting * config.acceleration_time)
            / (averaged + lasting);
        let variance = averaged + lasting + carried_variance;
        self.variance = variance;
        let concentration = self.error.added(variance, mean.seconds, correlation_time);
        Some(InertialDirection { direction, variance, concentration })
    }

    /// What calibration and averaging leave of this mean square acceleration, in units of gravity.
    fn averaged_variance(&self, acceleration: f64) -> f64 {
        let config = &self.config;
        let phase = 0.5 * config.motion_frequency * self.filled;
        let share = config.surviving_share.max((1.0 + phase * phase).recip());
        config.calibration_sd.powi(2) + share.powi(2) * acceleration
    }

    /// Mean square deviation from the expected direction beyond what is expected of it.
    fn unexpected(
        &mut self,
        direction: &Vector3<f64>,
        expected: &InertialDirection,
        carried_variance: f64,
        seconds: f64,
    ) -> f64 {
        let deviation = direction - expected.direction;
        let gain = |time: f64| -(-seconds / time).exp_m1();
        self.lasting += (deviation - self.lasting) * gain(self.config.longest_acceleration);
        let square = 0.5 * (deviation - self.lasting).norm_squared();
        let now = square - expected.variance - carried_variance;
        self.unexpected += (now - self.unexpected) * gain(self.config.memory);
        self.unexpected.max(now).max(0.0)
    }
}
