//! The multiplicative extended Kalman filter of attitude and gyro bias, and the belief that it
//! shares with the unscented one.

use nalgebra::{Matrix3, Matrix6, Matrix6x3, Rotation3, Vector3, Vector6};

use super::super::core::{
    AttitudeMeasurement, BayesFilter, Estimate, FilterError, Frame, InertialStep, VectorEstimate,
    VectorMeasurement,
};
use super::invariant::{conjugated, linearized_attitude, linearized_directions};
use super::{AttitudePrior, GyroModel};
use crate::so3::{exp, left_jacobian, right_jacobian};

/// A Gaussian of a rotation vector, which acts on an attitude, and of the gyro bias.
#[derive(Debug, Clone, Copy)]
pub(super) struct GaussianBelief {
    /// Frame in which the rotation vector acts.
    pub error: Frame,
    pub attitude: Rotation3<f64>,
    /// rad/s.
    pub bias: Vector3<f64>,
    /// Of (rotation vector, bias).
    pub covariance: Matrix6<f64>,
}

impl GaussianBelief {
    pub fn new(error: Frame, prior: &AttitudePrior) -> Result<Self, FilterError> {
        let (attitude, in_body) = prior.gaussian()?;
        let rotation = match error {
            Frame::World => conjugated(&attitude, &in_body),
            Frame::Body => in_body,
        };
        let covariance = joint_covariance(&rotation, &prior.gyro_bias_covariance);
        covariance.cholesky().ok_or(FilterError::NotPositive("prior covariance"))?;
        Ok(Self { error, attitude, bias: prior.gyro_bias, covariance })
    }

    /// Moves the mean.
    pub fn apply(&mut self, correction: &Vector6<f64>) {
        let turn = exp(&correction.fixed_rows::<3>(0).into_owned());
        self.attitude = match self.error {
            Frame::World => turn * self.attitude,
            Frame::Body => self.attitude * turn,
        };
        self.bias += correction.fixed_rows::<3>(3);
    }

    /// Carries the belief through an interval, linearised at the mean.
    pub fn propagate(&mut self, gyro: &GyroModel, step: &InertialStep) -> Result<(), FilterError> {
        let h = step.seconds;
        let Self { error, attitude, bias, covariance } = self;
        let angle = (step.angular_velocity - *bias) * h;
        let turn = exp(&angle);
        // Body: e+ = E^T e - h J_r b - n. World: e+ = e - R (h J_l b + E n).
        let noise = gyro.angle_covariance(step);
        let (by_error, by_bias, q) = match error {
            Frame::Body => (turn.inverse().into_inner(), right_jacobian(&angle) * -h, noise),
            Frame::World => (
                Matrix3::identity(),
                attitude.matrix() * left_jacobian(&angle) * -h,
                conjugated(&(*attitude * turn), &noise),
            ),
        };
        let mut transition = Matrix6::identity();
        transition.fixed_view_mut::<3, 3>(0, 0).copy_from(&by_error);
        transition.fixed_view_mut::<3, 3>(0, 3).copy_from(&by_bias);
        let noise = joint_covariance(&q, &(gyro.bias_walk * h));
        let covariance = transition * *covariance * transition.transpose() + noise;
        let attitude = *attitude * turn;
        super::finite_belief(&attitude, covariance.as_slice())?;
        (self.attitude, self.covariance) = (attitude, covariance);
        Ok(())
    }

    /// Conditions on a measured bias, in Joseph's form.
    pub fn condition_on_bias(&mut self, measured: &VectorEstimate) -> Result<(), FilterError> {
        let residual = measured.mean - self.bias;
        let innovation = self.covariance.fixed_view::<3, 3>(3, 3) + measured.covariance;
        let inverse = innovation.try_inverse();
        let gain = self.covariance.fixed_columns::<3>(3)
            * inverse.ok_or(FilterError::NotPositive("innovation covariance"))?;
        let mut kept = Matrix6::identity();
        let mut right = kept.fixed_columns_mut::<3>(3);
        right -= gain;
        let posterior = kept * self.covariance * kept.transpose()
            + gain * measured.covariance * gain.transpose();
        let correction = gain * residual;
        super::finite("correction", &[correction.norm_squared()])?;
        super::finite("posterior", posterior.as_slice())?;
        self.covariance = 0.5 * (posterior + posterior.transpose());
        self.apply(&correction);
        Ok(())
    }

    pub fn estimate(&self) -> Estimate {
        let rotation = self.covariance.fixed_view::<3, 3>(0, 0).into_owned();
        let in_body = match self.error {
            Frame::World => conjugated(&self.attitude.inverse(), &rotation),
            Frame::Body => rotation,
        };
        let covariance = self.covariance.fixed_view::<3, 3>(3, 3).into_owned();
        Estimate {
            gyro_bias: Some(VectorEstimate { mean: self.bias, covariance }),
            ..Estimate::of_attitude(self.attitude, super::wrapped(in_body))
        }
    }
}

/// The filter that linearises; the rotation vector acts in the body frame (`mekf`, W22 1.3) or in
/// the inertial frame (`mekf-i`, 1.4).
#[derive(Debug, Clone, Copy)]
pub struct AttitudeMekf {
    gyro: GyroModel,
    belief: GaussianBelief,
}

impl AttitudeMekf {
    /// The filter that starts from `prior` with its error in the frame `error`.
    pub fn new(error: Frame, gyro: &GyroModel, prior: &AttitudePrior) -> Result<Self, FilterError> {
        super::requires_body_rate(gyro)?;
        Ok(Self { gyro: *gyro, belief: GaussianBelief::new(error, prior)? })
    }

    /// Conditions on `information e = vector` for the rotation error `e`, in Joseph's form.
    fn correct(
        &mut self,
        information: &Matrix3<f64>,
        vector: &Vector3<f64>,
    ) -> Result<(), FilterError> {
        let prior = &self.belief.covariance;
        let rotation = prior.fixed_view::<3, 3>(0, 0).into_owned();
        let columns = prior.fixed_columns::<3>(0).into_owned();
        let factor = (Matrix3::identity() + information * rotation).try_inverse();
        let gain: Matrix6x3<f64> =
            columns * factor.ok_or(FilterError::NotPositive("innovation covariance"))?;
        let mut kept = Matrix6::identity();
        let mut left = kept.fixed_columns_mut::<3>(0);
        left -= gain * information;
        let covariance = kept * prior * kept.transpose() + gain * information * gain.transpose();
        let correction = gain * vector;
        super::finite("correction", &[correction.norm_squared()])?;
        super::finite("posterior", covariance.as_slice())?;
        self.belief.covariance = 0.5 * (covariance + covariance.transpose());
        self.belief.apply(&correction);
        Ok(())
    }
}

/// Rotation and bias, uncorrelated.
pub(super) fn joint_covariance(rotation: &Matrix3<f64>, bias: &Matrix3<f64>) -> Matrix6<f64> {
    let mut covariance = Matrix6::zeros();
    covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(rotation);
    covariance.fixed_view_mut::<3, 3>(3, 3).copy_from(bias);
    covariance
}

impl BayesFilter for AttitudeMekf {
    fn name(&self) -> &'static str {
        match self.belief.error {
            Frame::World => "mekf-i",
            Frame::Body => "mekf",
        }
    }

    fn propagate(&mut self, step: &InertialStep) -> Result<(), FilterError> {
        step.check()?;
        self.belief.propagate(&self.gyro, step)
    }

    fn update_attitude(&mut self, measured: &AttitudeMeasurement) -> Result<(), FilterError> {
        let GaussianBelief { error, attitude, .. } = &self.belief;
        let (information, vector) = linearized_attitude(measured, *error, attitude)?;
        self.correct(&information, &vector)
    }

    fn update_directions(&mut self, measured: &[VectorMeasurement]) -> Result<(), FilterError> {
        let GaussianBelief { error, attitude, .. } = &self.belief;
        let (information, vector) = linearized_directions(measured, *error, attitude)?;
        self.correct(&information, &vector)
    }

    fn update_gyro_bias(&mut self, measured: &VectorEstimate) -> Result<(), FilterError> {
        self.belief.condition_on_bias(measured)
    }

    fn attitude(&self) -> Rotation3<f64> {
        self.belief.attitude
    }

    fn gyro_bias(&self) -> Option<Vector3<f64>> {
        Some(self.belief.bias)
    }

    fn is_gaussian(&self) -> bool {
        true
    }

    fn estimate(&self) -> Estimate {
        self.belief.estimate()
    }
}
