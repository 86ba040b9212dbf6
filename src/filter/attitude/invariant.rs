//! The invariant extended Kalman filter of the attitude alone.

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::super::core::{
    AttitudeMeasurement, BayesFilter, Estimate, FilterError, Frame, InertialStep, VectorMeasurement,
};
use super::{AttitudePrior, GyroModel, information_of, symmetric};
use crate::so3::{exp, hat, left_jacobian_inverse, log};

/// A Gaussian of the rotation vector in the world frame (right-invariant error, `iekf`) or in the
/// body frame (left-invariant error, `iekf-l`); FNF's rival.
///
/// Updates are in information form: one inverse of a 3x3 matrix before the measurements and one
/// after, however many they are.
#[derive(Debug, Clone, Copy)]
pub struct InvariantKalman {
    /// Frame of the error.
    error: Frame,
    gyro: GyroModel,
    attitude: Rotation3<f64>,
    /// Covariance of the error, rad^2.
    covariance: Matrix3<f64>,
}

impl InvariantKalman {
    /// The filter that starts from `prior` with its error in the frame `error`.
    pub fn new(error: Frame, gyro: &GyroModel, prior: &AttitudePrior) -> Result<Self, FilterError> {
        let (attitude, in_body) = prior.gaussian()?;
        in_body.cholesky().ok_or(FilterError::NotPositive("prior covariance"))?;
        let covariance = match error {
            Frame::World => conjugated(&attitude, &in_body),
            Frame::Body => in_body,
        };
        Ok(Self { error, gyro: *gyro, attitude, covariance })
    }

    /// Conditions on `information e = vector` for the error `e` in the filter's frame.
    fn correct(
        &mut self,
        information: &Matrix3<f64>,
        vector: &Vector3<f64>,
    ) -> Result<(), FilterError> {
        const SINGULAR: FilterError = FilterError::NotPositive("posterior information");
        let prior = self.covariance.try_inverse().ok_or(SINGULAR)?;
        let covariance = symmetric(&(prior + information).try_inverse().ok_or(SINGULAR)?);
        let correction = covariance * vector;
        super::finite("correction", &[correction.norm_squared()])?;
        self.covariance = covariance;
        self.attitude = match self.error {
            Frame::World => exp(&correction) * self.attitude,
            Frame::Body => self.attitude * exp(&correction),
        };
        Ok(())
    }
}

/// `R m R^T`.
pub(super) fn conjugated(r: &Rotation3<f64>, m: &Matrix3<f64>) -> Matrix3<f64> {
    r.matrix() * m * r.matrix().transpose()
}

/// The covariance of the error in `error` after a turn `turn` and noise `q`, both resolved in
/// `rate`, at the attitude `attitude` before the turn.
fn propagated_covariance(
    covariance: &Matrix3<f64>,
    (error, rate): (Frame, Frame),
    attitude: &Rotation3<f64>,
    turn: &Rotation3<f64>,
    q: &Matrix3<f64>,
) -> Matrix3<f64> {
    match (error, rate) {
        (Frame::World, Frame::Body) => covariance + conjugated(attitude, q),
        (Frame::Body, Frame::Body) => conjugated(&turn.inverse(), covariance) + q,
        (Frame::World, Frame::World) => conjugated(turn, covariance) + q,
        (Frame::Body, Frame::World) => covariance + conjugated(&attitude.inverse(), q),
    }
}

/// Information and its vector of the error in `error` from vectors, linearised at `attitude`.
pub(super) fn linearized_directions(
    measured: &[VectorMeasurement],
    error: Frame,
    attitude: &Rotation3<f64>,
) -> Result<(Matrix3<f64>, Vector3<f64>), FilterError> {
    let (mut information, mut vector) = (Matrix3::zeros(), Vector3::zeros());
    for m in measured {
        m.check()?;
        let weight = inverse(&m.covariance)?;
        // In the frame of the measurement the error turns the prediction p: z - p = -+ p^ e.
        let (predicted, sign) = match m.measured_in {
            Frame::Body => (attitude.inverse_transform_vector(&m.in_world), 1.0),
            Frame::World => (attitude * m.in_body, -1.0),
        };
        let h = sign * hat(&predicted);
        // The error in the measurement's frame as a function of that in the filter's.
        let h = match (m.measured_in, error) {
            (Frame::Body, Frame::World) => h * attitude.matrix().transpose(),
            (Frame::World, Frame::Body) => h * attitude.matrix(),
            _ => h,
        };
        let weighted = h.transpose() * weight;
        information += weighted * h;
        vector += weighted * (m.measured() - predicted);
    }
    Ok((information, vector))
}

/// The same from a measured attitude. Its residual `z` is a rotation vector, and its derivative is
/// taken where it is, `log(exp(-e) exp(z)) = z - J_l^-1(z) e`: where the noise is large about some
/// axis (FNF section V.C), that at zero sends the errors about one of the others to the third.
pub(super) fn linearized_attitude(
    measured: &AttitudeMeasurement,
    error: Frame,
    attitude: &Rotation3<f64>,
) -> Result<(Matrix3<f64>, Vector3<f64>), FilterError> {
    measured.check()?;
    let residual = log(&(attitude.inverse() * measured.world_from_body));
    let by_error = left_jacobian_inverse(&residual);
    let weighted = by_error.transpose() * information_of(&symmetric(&measured.noise));
    let (information, vector) = (weighted * by_error, weighted * residual);
    Ok(match error {
        Frame::Body => (information, vector),
        Frame::World => (conjugated(attitude, &information), attitude * vector),
    })
}

fn inverse(covariance: &Matrix3<f64>) -> Result<Matrix3<f64>, FilterError> {
    let inverse = covariance.try_inverse();
    inverse.ok_or(FilterError::NotPositive("measurement covariance"))
}

impl BayesFilter for InvariantKalman {
    fn name(&self) -> &'static str {
        match self.error {
            Frame::World => "iekf",
            Frame::Body => "iekf-l",
        }
    }

    fn propagate(&mut self, step: &InertialStep) -> Result<(), FilterError> {
        step.check()?;
        let turn = exp(&(step.angular_velocity * step.seconds));
        let q = self.gyro.angle_covariance(step);
        let frames = (self.error, self.gyro.frame);
        let covariance = propagated_covariance(&self.covariance, frames, &self.attitude, &turn, &q);
        let attitude = match self.gyro.frame {
            Frame::Body => self.attitude * turn,
            Frame::World => turn * self.attitude,
        };
        super::finite_belief(&attitude, covariance.as_slice())?;
        (self.attitude, self.covariance) = (attitude, covariance);
        Ok(())
    }

    fn update_attitude(&mut self, measured: &AttitudeMeasurement) -> Result<(), FilterError> {
        let (information, vector) = linearized_attitude(measured, self.error, &self.attitude)?;
        self.correct(&information, &vector)
    }

    fn update_directions(&mut self, measured: &[VectorMeasurement]) -> Result<(), FilterError> {
        let (information, vector) = linearized_directions(measured, self.error, &self.attitude)?;
        self.correct(&information, &vector)
    }

    fn attitude(&self) -> Rotation3<f64> {
        self.attitude
    }

    fn is_gaussian(&self) -> bool {
        true
    }

    fn estimate(&self) -> Estimate {
        let in_body = match self.error {
            Frame::World => conjugated(&self.attitude.inverse(), &self.covariance),
            Frame::Body => self.covariance,
        };
        Estimate::of_attitude(self.attitude, super::wrapped(in_body))
    }
}
