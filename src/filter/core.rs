//! What recursive Bayesian filters over SO(3) x R^n share: one interval of inertial data to
//! propagate through, typed measurements to condition on, and the belief as plain values.
//!
//! Sensors follow `measured = true + bias + noise`. Noise densities are continuous-time: over
//! `h` seconds a density `D` (rad^2/s) gives the angle a covariance `D h`.

use nalgebra::{Matrix3, Rotation3, Vector3};

use crate::distribution::matrix_fisher::{MatrixFisher, MatrixFisherError};
use crate::distribution::matrix_fisher_gaussian::MfgError;
use crate::distribution::progressive::ProgressiveError;
use crate::distribution::unscented::UnscentedError;
use crate::inertial::{Belief, block};
use crate::sensor::ImuSample;
use crate::so3::NotFinite;

/// A recursive estimator of the attitude and of whatever vectors it carries beside it.
///
/// A study is a list of these on the same stream. A call that returns an error leaves the belief
/// as it was; no call makes it infinite or NaN.
pub trait BayesFilter: Send {
    /// As on the command line, such as `bf-mfd`.
    fn name(&self) -> &'static str;

    /// Moves the belief on through one interval of inertial data.
    fn propagate(&mut self, step: &InertialStep) -> Result<(), FilterError>;

    /// Conditions the belief on a measured attitude.
    fn update_attitude(&mut self, _measured: &AttitudeMeasurement) -> Result<(), FilterError> {
        Err(self.cannot_use("attitude"))
    }

    /// Conditions the belief on directions or vectors measured at the same time, their noises
    /// independent of each other.
    fn update_directions(&mut self, _measured: &[VectorMeasurement]) -> Result<(), FilterError> {
        Err(self.cannot_use("direction"))
    }

    /// Conditions the belief on a measured gyro bias: what a gyroscope shows that stands still.
    fn update_gyro_bias(&mut self, _measured: &VectorEstimate) -> Result<(), FilterError> {
        Err(self.cannot_use("gyro bias"))
    }

    /// Conditions the belief on a measured position.
    fn update_position(&mut self, _measured: &PositionMeasurement) -> Result<(), FilterError> {
        Err(self.cannot_use("position"))
    }

    /// The most probable attitude, `world_from_body`.
    fn attitude(&self) -> Rotation3<f64>;

    /// The belief with its covariances, which may cost more than a step of the filter.
    fn estimate(&self) -> Estimate;

    /// The mean gyro bias, rad/s, of a filter that estimates it.
    fn gyro_bias(&self) -> Option<Vector3<f64>> {
        None
    }

    /// Whether the filter models noise as Gaussian vectors rather than by distributions on the
    /// sphere and on SO(3); where both descriptions of a sensor are at hand, it takes the former.
    fn is_gaussian(&self) -> bool {
        false
    }

    /// The error of a filter that has no use for such measurements.
    fn cannot_use(&self, measurement: &'static str) -> FilterError {
        FilterError::Unsupported { filter: self.name(), measurement }
    }
}

/// The frame in which something is resolved.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Frame {
    World,
    Body,
}

/// The mean of the inertial sensors' readings over one interval, biases included.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InertialStep {
    /// Length of the interval, the difference of two stamps, s.
    pub seconds: f64,
    /// Angular velocity, rad/s, in body coordinates unless the filter was told otherwise.
    pub angular_velocity: Vector3<f64>,
    /// Specific force `R^T (a - g)` in body coordinates, m/s^2; pure attitude filters do not look
    /// at it.
    pub specific_force: Option<Vector3<f64>>,
    /// Covariance of the angle over the interval beyond the noise that the filter knows of its
    /// gyroscope, rad^2, in the frame of the angular velocity: what a gap or a clipped reading
    /// leaves open.
    pub angle_covariance: Matrix3<f64>,
}

impl InertialStep {
    /// An interval of which only the angular velocity is known.
    pub fn turning(angular_velocity: Vector3<f64>, seconds: f64) -> Self {
        Self { seconds, angular_velocity, specific_force: None, angle_covariance: Matrix3::zeros() }
    }

    /// The same interval with an angle that is known less well.
    pub fn with_angle_covariance(self, angle_covariance: Matrix3<f64>) -> Self {
        Self { angle_covariance, ..self }
    }

    /// The interval between two samples, with the averages of both ends.
    pub fn between(from: &ImuSample, to: &ImuSample) -> Self {
        Self {
            seconds: to.stamp.seconds_since(from.stamp),
            angular_velocity: (from.angular_velocity + to.angular_velocity) * 0.5,
            specific_force: Some((from.specific_force + to.specific_force) * 0.5),
            angle_covariance: Matrix3::zeros(),
        }
    }

    /// An interval in which nothing was measured, for models of motion that need no IMU.
    pub fn unmeasured(seconds: f64) -> Self {
        Self::turning(Vector3::zeros(), seconds)
    }

    /// Refuses an interval that is not positive, and readings that are not finite.
    pub fn check(&self) -> Result<(), FilterError> {
        if !(self.seconds > 0.0 && self.seconds.is_finite()) {
            return Err(FilterError::Interval(self.seconds));
        }
        finite("angular velocity", self.angular_velocity.as_slice())?;
        finite("angle covariance", self.angle_covariance.as_slice())?;
        self.specific_force.map_or(Ok(()), |f| finite("specific force", f.as_slice()))
    }
}

/// A measured attitude `Z = R N` with `N ~ M(noise)`, so that `p(Z | R)` is proportional to
/// `exp(tr((Z noise^T)^T R))` (L-AMF 14).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AttitudeMeasurement {
    /// `Z`, `world_from_body`.
    pub world_from_body: Rotation3<f64>,
    /// Parameter of the matrix Fisher distribution of the error in the body frame.
    pub noise: Matrix3<f64>,
}

impl AttitudeMeasurement {
    /// A measurement whose error is a rotation vector in the body frame with this covariance,
    /// rad^2: `noise = tr(H)/2 I - H` with the information `H` (FNF 31).
    pub fn from_covariance(
        world_from_body: Rotation3<f64>,
        covariance: &Matrix3<f64>,
    ) -> Result<Self, FilterError> {
        finite("measurement covariance", covariance.as_slice())?;
        let factor = covariance.cholesky();
        let factor = factor.ok_or(FilterError::NotPositive("measurement covariance"))?;
        let information = factor.inverse();
        let half_trace = Matrix3::from_diagonal_element(0.5 * information.trace());
        Ok(Self { world_from_body, noise: half_trace - information })
    }

    /// The parameter that the likelihood adds to a matrix Fisher belief, `Z noise^T`.
    pub fn parameter(&self) -> Matrix3<f64> {
        self.world_from_body.matrix() * self.noise.transpose()
    }

    /// Refuses values that are not finite.
    pub fn check(&self) -> Result<(), FilterError> {
        finite("measured attitude", self.world_from_body.matrix().as_slice())?;
        finite("measurement noise", self.noise.as_slice())
    }
}

/// A vector known in one frame and measured in the other; a direction where both have length one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VectorMeasurement {
    /// The vector in world coordinates.
    pub in_world: Vector3<f64>,
    /// The vector in body coordinates.
    pub in_body: Vector3<f64>,
    /// The frame in which it was measured; in the other one it is known.
    pub measured_in: Frame,
    /// Covariance of the measured vector in that frame, in its units squared.
    pub covariance: Matrix3<f64>,
}

impl VectorMeasurement {
    /// A direction known in the world (W22 4.3) and measured in the body frame with von
    /// Mises-Fisher noise of this concentration.
    pub fn of_world_direction(
        in_world: Vector3<f64>,
        in_body: Vector3<f64>,
        concentration: f64,
    ) -> Self {
        let covariance = Matrix3::from_diagonal_element(concentration.recip());
        Self { in_world, in_body, measured_in: Frame::Body, covariance }
    }

    /// A direction fixed to the body (W22 4.4) and measured in the world with von Mises-Fisher
    /// noise of this concentration.
    pub fn of_body_direction(
        in_body: Vector3<f64>,
        in_world: Vector3<f64>,
        concentration: f64,
    ) -> Self {
        let covariance = Matrix3::from_diagonal_element(concentration.recip());
        Self { in_world, in_body, measured_in: Frame::World, covariance }
    }

    /// The known vector.
    pub fn known(&self) -> Vector3<f64> {
        match self.measured_in {
            Frame::World => self.in_body,
            Frame::Body => self.in_world,
        }
    }

    /// The measured vector.
    pub fn measured(&self) -> Vector3<f64> {
        match self.measured_in {
            Frame::World => self.in_world,
            Frame::Body => self.in_body,
        }
    }

    /// Concentration of the von Mises-Fisher distribution that stands for the direction of the
    /// noisy vector, `3 |mu|^2/tr(covariance)` (FNF 55).
    pub fn concentration(&self) -> f64 {
        3.0 * self.known().norm_squared() / self.covariance.trace()
    }

    /// The parameter that the likelihood of the direction adds to a matrix Fisher belief,
    /// `concentration in_world in_body^T` of unit vectors (W22 4.17).
    pub fn parameter(&self) -> Result<Matrix3<f64>, FilterError> {
        self.check()?;
        let unit = |v: &Vector3<f64>| v.try_normalize(0.0).ok_or(FilterError::ZeroVector);
        let (world, body) = (unit(&self.in_world)?, unit(&self.in_body)?);
        Ok(world * body.transpose() * self.concentration())
    }

    /// The parameter of the likelihood of several directions.
    pub fn joint_parameter(measured: &[Self]) -> Result<Matrix3<f64>, FilterError> {
        measured.iter().map(Self::parameter).sum()
    }

    /// Refuses values that are not finite, and covariances that are not positive.
    pub fn check(&self) -> Result<(), FilterError> {
        finite("measured vector", self.in_world.as_slice())?;
        finite("measured vector", self.in_body.as_slice())?;
        finite("measurement covariance", self.covariance.as_slice())?;
        let positive = self.covariance.trace() > 0.0;
        positive.then_some(()).ok_or(FilterError::NotPositive("measurement covariance"))
    }
}

/// A measured position of a point of the body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PositionMeasurement {
    /// World coordinates, m.
    pub in_world: Vector3<f64>,
    /// World coordinates, m^2.
    pub covariance: Matrix3<f64>,
    /// The point in body coordinates, m; zero for the body's origin.
    pub lever_arm: Vector3<f64>,
}

/// A vector's mean and covariance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VectorEstimate {
    pub mean: Vector3<f64>,
    pub covariance: Matrix3<f64>,
}

/// A filter's belief as plain values; vectors that it does not carry are `None`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// The most probable attitude.
    pub world_from_body: Rotation3<f64>,
    /// Covariance of the body-frame rotation vector `log(estimate^T R)` under the belief, rad^2.
    pub rotation_covariance: Matrix3<f64>,
    /// Proper singular values of the matrix Fisher parameter, where the belief has one.
    pub matrix_fisher_s: Option<Vector3<f64>>,
    /// rad/s.
    pub gyro_bias: Option<VectorEstimate>,
    /// m/s, world coordinates.
    pub velocity: Option<VectorEstimate>,
    /// m, world coordinates.
    pub position: Option<VectorEstimate>,
    /// m/s^2.
    pub accel_bias: Option<VectorEstimate>,
}

impl Estimate {
    /// The belief of a filter that knows nothing but the attitude.
    pub fn of_attitude(world_from_body: Rotation3<f64>, rotation_covariance: Matrix3<f64>) -> Self {
        Self {
            world_from_body,
            rotation_covariance,
            matrix_fisher_s: None,
            gyro_bias: None,
            velocity: None,
            position: None,
            accel_bias: None,
        }
    }

    /// The belief of a filter of the whole navigation state.
    pub fn of_belief(belief: &Belief, matrix_fisher_s: Option<Vector3<f64>>) -> Self {
        let Belief { state, covariance } = belief;
        let block = |start: usize| covariance.fixed_view::<3, 3>(start, start).into_owned();
        let part = |mean: Vector3<f64>, start: usize| {
            Some(VectorEstimate { mean, covariance: block(start) })
        };
        Self {
            world_from_body: state.world_from_body.rotation.to_rotation_matrix(),
            rotation_covariance: block(block::ROTATION),
            matrix_fisher_s,
            gyro_bias: part(state.gyro_bias, block::GYRO_BIAS),
            velocity: part(state.velocity, block::VELOCITY),
            position: part(state.world_from_body.translation.vector, block::POSITION),
            accel_bias: part(state.accel_bias, block::ACCEL_BIAS),
        }
    }

    /// The same for a matrix Fisher belief.
    pub fn of_matrix_fisher(belief: &MatrixFisher) -> Self {
        Self {
            matrix_fisher_s: Some(belief.svd().s),
            ..Self::of_attitude(belief.mode(), belief.rotation_covariance())
        }
    }
}

/// Why a filter did not take a step. The belief is then what it was before.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum FilterError {
    #[error("the filter {filter} cannot use {measurement} measurements")]
    Unsupported { filter: &'static str, measurement: &'static str },
    #[error("an interval must be positive and finite, not {0} s")]
    Interval(f64),
    #[error("the {0} is not finite")]
    NotFinite(&'static str),
    #[error("the {0} is not positive definite")]
    NotPositive(&'static str),
    #[error("{0} did not converge")]
    NoConvergence(&'static str),
    #[error("a vector of length zero has no direction")]
    ZeroVector,
    #[error("nothing was measured that can be used")]
    NoMeasurement,
    #[error(
        "{points} points contradict the prediction (NIS {nis:.1} per degree of freedom): too few to be believed"
    )]
    FewContradict { points: usize, nis: f64 },
    #[error("{points} points would turn the body much further than their innovations allow")]
    TurnsTooFar { points: usize },
    #[error("the window has no pose {0}: it has been dropped, or never was")]
    UnknownClone(u64),
    #[error("there is no camera {camera}: {cameras} are given")]
    UnknownCamera { camera: usize, cameras: usize },
    #[error("the row of track {track} at pose {clone} has been used already")]
    RowUsedTwice { track: u64, clone: u64 },
    #[error("{rows} rows of track {track} say nothing beyond where its point is")]
    TooFewRows { track: u64, rows: usize },
    #[error("no point in front of the cameras fits track {0}")]
    NoPoint(u64),
    #[error("track {track} is improbable: squared distance {squared:.1} in {rows} rows")]
    ImprobableTrack { track: u64, squared: f64, rows: usize },
    #[error("the {0} is part of the state already")]
    AlreadyEstimated(&'static str),
    #[error("this filter needs the specific force")]
    NoSpecificForce,
    #[error("a filter with a gyro bias needs the angular velocity in the body frame")]
    WorldRate,
    #[error(transparent)]
    Attitude(#[from] MatrixFisherError),
    #[error(transparent)]
    Belief(#[from] MfgError),
    #[error(transparent)]
    SigmaPoints(#[from] UnscentedError),
    #[error(transparent)]
    Progressive(#[from] ProgressiveError),
    #[error(transparent)]
    Matrix(#[from] NotFinite),
}

/// Refuses entries that are not finite.
pub(super) fn finite(what: &'static str, entries: &[f64]) -> Result<(), FilterError> {
    let all = entries.iter().all(|x| x.is_finite());
    all.then_some(()).ok_or(FilterError::NotFinite(what))
}
