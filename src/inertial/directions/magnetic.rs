//! North from the magnetic field, with the iron of the device told apart from it.

use nalgebra::{Matrix3, Rotation3, SMatrix, SVector, Vector3};
use serde::{Deserialize, Serialize};

use super::{CorrelatedError, InertialDirection, Interval};
use crate::so3::angle_between;

/// How far the magnetometer is believed to show north. Fields are relative to the magnitude of
/// the first one measured.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MagneticConfig {
    /// Standard deviation of what varies in the field from place to place and is not modelled.
    pub noise: f64,
    /// Its correlation time, s.
    pub noise_correlation_time: f64,
    /// Random walk of the field in inertial coordinates, which also drift, 1/sqrt(s). What is not
    /// known of the gyroscope's bias is added.
    pub field_walk: f64,
    /// Standard deviation of the iron that calibration has left.
    pub iron_sd: f64,
    /// Random walk of the iron, 1/sqrt(rad): soft iron, which is not modelled, looks like iron that
    /// changes as the body turns. While it does not turn, iron cannot be told from the field, and
    /// does not change.
    pub iron_walk: f64,
    /// Turn from which on the soft iron looks like another, rad.
    pub iron_turn: f64,
    /// Standard deviation of the iron when some has come or gone.
    pub new_iron_sd: f64,
    /// Standard deviation of the delay of the magnetometer behind the gyroscope, s.
    pub delay_sd: f64,
    /// Squared Mahalanobis distance (three degrees of freedom) beyond which iron has come or gone.
    pub disturbed_above: f64,
    /// The field is trusted again when the distance has stayed below this ...
    pub calm_below: f64,
    /// ... for so long, s.
    pub calm_time: f64,
    /// If iron has not explained the disturbance after so long, the field itself is learnt anew, s.
    pub patience: f64,
    /// Standard deviation of the heading that the field shows where there is no iron in sight:
    /// buildings bend it. rad.
    pub heading_sd: f64,
    /// Correlation time of that error, s.
    pub heading_correlation_time: f64,
    /// Factor on the standard deviation of the heading while disturbed.
    pub disturbed_factor: f64,
}

impl Default for MagneticConfig {
    fn default() -> Self {
        Self {
            noise: 0.03,
            noise_correlation_time: 3.0,
            field_walk: 1e-3,
            iron_sd: 0.04,
            iron_walk: 1.2e-2,
            iron_turn: 0.5,
            new_iron_sd: 2.0,
            delay_sd: 0.01,
            disturbed_above: 25.0,
            calm_below: 8.0,
            calm_time: 1.0,
            patience: 20.0,
            heading_sd: 3f64.to_radians(),
            heading_correlation_time: 4.0,
            disturbed_factor: 10.0,
        }
    }
}

/// Field (0 to 2), iron (3 to 5), delay (6).
type State = SVector<f64, 7>;
type Covariance = SMatrix<f64, 7, 7>;

/// An unknown bias turns the field steadily; to the filter, which follows within this time, it is a
/// random walk, s.
const BIAS_MEMORY: f64 = 1.0;

const FIELD: usize = 0;
const IRON: usize = 3;
const DELAY: usize = 6;

/// Kalman filter of `reading = field + inertial_from_body iron + delay field_rate`, in inertial
/// coordinates.
#[derive(Debug, Clone)]
pub(super) struct MagneticFinder {
    config: MagneticConfig,
    /// Magnitude of the first field, in the magnetometer's unit; 0 before.
    magnitude: f64,
    state: State,
    covariance: Covariance,
    field_error: CorrelatedError,
    heading_error: CorrelatedError,
    /// `inertial_from_body` when the soft iron was last another.
    iron_attitude: Rotation3<f64>,
    disturbed: bool,
    /// Time since the reading was last far from the expected one, s.
    calm: f64,
    /// Time since the field was last trusted, s.
    unexplained: f64,
}

impl MagneticFinder {
    pub fn new(config: &MagneticConfig) -> Self {
        let mut covariance = Covariance::zeros();
        set_block(&mut covariance, IRON, config.iron_sd.powi(2));
        covariance[(DELAY, DELAY)] = config.delay_sd.powi(2);
        Self {
            config: config.clone(),
            magnitude: 0.0,
            state: State::zeros(),
            covariance,
            field_error: CorrelatedError::default(),
            heading_error: CorrelatedError::default(),
            iron_attitude: Rotation3::identity(),
            disturbed: false,
            calm: 0.0,
            unexplained: 0.0,
        }
    }

    pub fn is_disturbed(&self) -> bool {
        self.disturbed
    }

    pub fn iron(&self) -> Vector3<f64> {
        self.state.fixed_rows::<3>(IRON) * self.magnitude
    }

    /// The body has turned by an angle that is known to this variance, rad^2: so has the field.
    pub fn pass_gap(&mut self, variance: f64) {
        for i in 0..3 {
            self.covariance[(FIELD + i, FIELD + i)] += variance;
        }
        self.heading_error.lose(variance);
    }

    /// Horizontal direction towards north, given the vertical one and the variance of the
    /// gyroscope's bias, rad^2/s^2.
    pub fn measure(
        &mut self,
        mean: &Interval,
        up: &InertialDirection,
        inertial_from_body: &Rotation3<f64>,
        bias_variance: f64,
    ) -> Option<InertialDirection> {
        if self.magnitude == 0.0 {
            self.magnitude = mean.inertial_field.norm();
            // Wide beside any field, so that the first reading decides.
            forget_block(&mut self.covariance, FIELD, 100.0);
        }
        // A sensor that reads nothing shows no direction.
        if self.magnitude == 0.0 {
            return None;
        }
        let reading = mean.inertial_field / self.magnitude;
        let field_rate = mean.field_rate / self.magnitude;
        self.let_time_pass(mean.seconds, inertial_from_body, bias_variance);
        self.take_in(&reading, &field_rate, &mean.turn, mean.seconds)?;

        let iron = self.state.fixed_rows::<3>(IRON).into_owned();
        let field = reading - mean.turn * iron - field_rate * self.state[DELAY];
        let vertical = field.dot(&up.direction);
        let horizontal = field - up.direction * vertical;
        let length = horizontal.norm();
        let direction = horizontal.try_normalize(1e-6)?;
        let east = direction.cross(&up.direction);
        let iron_covariance = self.covariance.fixed_view::<3, 3>(IRON, IRON);
        let iron_along_east = mean.turn.transpose() * east;
        let config = &self.config;
        let across = (iron_along_east.transpose() * iron_covariance * iron_along_east)[0]
            + config.noise.powi(2);
        let mut variance = across / length.powi(2) + config.heading_sd.powi(2);
        if self.disturbed {
            variance *= config.disturbed_factor.powi(2);
        }
        // A tilt moves the vertical part of the field into the horizontal plane.
        variance += up.variance * (vertical / length).powi(2);
        let correlation_time = config.heading_correlation_time;
        let concentration = self.heading_error.added(variance, mean.seconds, correlation_time);
        Some(InertialDirection { direction, variance, concentration })
    }

    /// The field drifts with the gyroscope, and soft iron becomes another as the body turns.
    fn let_time_pass(
        &mut self,
        seconds: f64,
        inertial_from_body: &Rotation3<f64>,
        bias_variance: f64,
    ) {
        let config = &self.config;
        let drift = config.field_walk.powi(2) + bias_variance * BIAS_MEMORY;
        let turned = angle_between(&self.iron_attitude, inertial_from_body);
        let has_turned = turned > config.iron_turn;
        let changed = if has_turned { config.iron_walk.powi(2) * turned } else { 0.0 };
        for i in 0..3 {
            self.covariance[(FIELD + i, FIELD + i)] += drift * seconds;
            self.covariance[(IRON + i, IRON + i)] += changed;
        }
        if has_turned {
            self.iron_attitude = *inertial_from_body;
        }
    }

    /// Conditions the Kalman filter on a reading; `None` where that cannot be computed.
    fn take_in(
        &mut self,
        reading: &Vector3<f64>,
        field_rate: &Vector3<f64>,
        turn: &Matrix3<f64>,
        seconds: f64,
    ) -> Option<()> {
        let MagneticConfig { noise, noise_correlation_time, .. } = self.config;
        let mut h = SMatrix::<f64, 3, 7>::zeros();
        h.fixed_view_mut::<3, 3>(0, FIELD).fill_with_identity();
        h.fixed_view_mut::<3, 3>(0, IRON).copy_from(turn);
        h.set_column(DELAY, field_rate);
        let innovation = reading - h * self.state;
        let noise = noise.powi(2);
        let expected = h * self.covariance * h.transpose() + Matrix3::from_diagonal_element(noise);
        let distance = innovation.dot(&(expected.try_inverse()? * innovation));
        self.judge(distance, seconds);

        let correlated = self.field_error.added(noise, seconds, noise_correlation_time).recip();
        let expected =
            h * self.covariance * h.transpose() + Matrix3::from_diagonal_element(correlated);
        let gain = self.covariance * h.transpose() * expected.try_inverse()?;
        self.state += gain * innovation;
        let kept = Covariance::identity() - gain * h;
        let covariance =
            kept * self.covariance * kept.transpose() + gain * gain.transpose() * correlated;
        self.covariance = 0.5 * (covariance + covariance.transpose());
        Some(())
    }

    /// Decides whether the field is to be trusted, with hysteresis.
    fn judge(&mut self, distance: f64, seconds: f64) {
        let config = &self.config;
        if distance > config.disturbed_above {
            self.disturbed = true;
            self.calm = 0.0;
            forget_block(&mut self.covariance, IRON, config.new_iron_sd.powi(2));
            self.field_error = CorrelatedError::default();
        } else if distance < config.calm_below {
            self.calm += seconds;
            self.disturbed &= self.calm <= config.calm_time;
        } else {
            self.calm = 0.0;
        }
        self.unexplained = if self.disturbed { self.unexplained + seconds } else { 0.0 };
        if self.unexplained > config.patience {
            self.unexplained = 0.0;
            forget_block(&mut self.covariance, FIELD, 1.0);
            self.field_error = CorrelatedError::default();
        }
    }
}

fn set_block(covariance: &mut Covariance, start: usize, variance: f64) {
    let block = Matrix3::from_diagonal_element(variance);
    covariance.fixed_view_mut::<3, 3>(start, start).copy_from(&block);
}

/// Makes three components independent of the rest.
fn forget_block(covariance: &mut Covariance, start: usize, variance: f64) {
    covariance.fixed_rows_mut::<3>(start).fill(0.0);
    covariance.fixed_columns_mut::<3>(start).fill(0.0);
    set_block(covariance, start, variance);
}
