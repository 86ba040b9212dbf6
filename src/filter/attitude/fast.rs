//! The fast nonlinear filters FNF-R and FNF-L (FNF algorithms 1, 2).

use nalgebra::{Matrix3, Rotation3};

use super::super::core::{
    AttitudeMeasurement, BayesFilter, Estimate, FilterError, Frame, InertialStep, VectorMeasurement,
};
use super::invariant::conjugated;
use super::{GyroModel, gaussian_covariance, information_of};
use crate::distribution::matrix_fisher::MatrixFisher;
use crate::so3::{cofactors, exp, hat, proper_polar};

/// Concentration, relative to the others, below which an axis of the solution of Wahba's problem
/// counts as unknown.
const UNSOLVABLE: f64 = 1e-6;
/// Concentration at which a belief about an axis counts as none; its covariance stays finite.
const LEAST_INFORMATION: f64 = 1e-9;

/// A matrix Fisher belief whose propagation and likelihood are those of the linearised invariant
/// error, and whose posterior is Bayes' rule on SO(3).
///
/// The covariance is carried between measurements and the parameter formed only for Bayes' rule, by
/// (31); polar decompositions, no singular values. It is the same for both filters, as `P_R = R P_L
/// R^T`: all that tells them apart is when the noise enters, (37) before the turn and (49) after
/// it, and only anisotropic noise knows the difference. It is resolved in the frame in which the
/// turns that the gyroscope measures leave it alone, the world for a gyroscope of the body's rate.
/// Vectors of any length with any covariance are admissible; weights in Wahba's problem are the
/// inverse mean variances. Where that problem has no unique solution (a single direction) the
/// likelihood is that of the direction, as in W22 (4.14).
#[derive(Debug, Clone, Copy)]
pub struct FastNonlinear {
    /// Frame of the invariant error that is linearised: the world's for FNF-R, the body's for
    /// FNF-L.
    error: Frame,
    gyro: GyroModel,
    mode: Rotation3<f64>,
    /// Covariance of the error in the frame that is not the gyroscope's, rad^2.
    covariance: Matrix3<f64>,
}

impl FastNonlinear {
    /// The filter that starts from `prior` with its error in the frame `error`.
    pub fn new(error: Frame, gyro: &GyroModel, prior: &MatrixFisher) -> Self {
        let in_body = covariance_of(&prior.information(), || gaussian_covariance(prior));
        let mode = prior.mode();
        Self { error, gyro: *gyro, mode, covariance: carried(gyro.frame, &mode, &in_body) }
    }

    /// Parameter of the belief: `R N` with (31) of the covariance in the body frame, `N R` in the
    /// world frame.
    fn parameter(&self) -> Result<Matrix3<f64>, FilterError> {
        let n = parameter_of_covariance(&self.covariance)?;
        Ok(match self.gyro.frame {
            Frame::Body => n * self.mode.matrix(),
            Frame::World => self.mode.matrix() * n,
        })
    }

    fn covariance_in_body(&self) -> Matrix3<f64> {
        match self.gyro.frame {
            Frame::Body => conjugated(&self.mode.inverse(), &self.covariance),
            Frame::World => self.covariance,
        }
    }

    /// Bayes' rule with the likelihood `exp(tr(added^T R))`.
    fn fuse(&mut self, added: &Matrix3<f64>) -> Result<(), FilterError> {
        let (mode, k) = proper_polar(&(self.parameter()? + added))?;
        let information = information_of(&k);
        let covariance = covariance_of(&information, || {
            let eigen = information.symmetric_eigen();
            let variance = eigen.eigenvalues.map(|a| a.max(LEAST_INFORMATION).recip());
            eigen.eigenvectors * Matrix3::from_diagonal(&variance) * eigen.eigenvectors.transpose()
        });
        super::finite("posterior", covariance.as_slice())?;
        (self.mode, self.covariance) = (mode, carried(self.gyro.frame, &mode, &covariance));
        Ok(())
    }

    /// The covariance after a turn by which the attitude becomes `next`, and the noise of it.
    fn propagated(&self, next: &Rotation3<f64>, step: &InertialStep) -> Matrix3<f64> {
        if let Some(variance) = self.gyro.isotropic_variance(step) {
            return self.covariance + Matrix3::from_diagonal_element(variance);
        }
        let q = self.gyro.angle_covariance(step);
        let entered = if self.error == self.gyro.frame { next } else { &self.mode };
        self.covariance
            + match self.gyro.frame {
                Frame::Body => conjugated(entered, &q),
                Frame::World => conjugated(&entered.inverse(), &q),
            }
    }

    /// The parameter of the likelihood of `measured` by the linearised Wahba problem, (44)/(51).
    fn likelihood(&self, measured: &[VectorMeasurement]) -> Result<Matrix3<f64>, FilterError> {
        let mut profile = Matrix3::zeros();
        for m in measured {
            m.check()?;
            profile += m.in_world * m.in_body.transpose() * weight(m);
        }
        let (solution, k) = proper_polar(&profile)?;
        let bend = information_of(&k);
        if bend.determinant() <= UNSOLVABLE * bend.trace().powi(3) {
            return VectorMeasurement::joint_parameter(measured);
        }
        let mut gradient = Matrix3::zeros();
        for m in measured {
            let known_in_body = match m.measured_in {
                Frame::Body => solution.inverse_transform_vector(&m.in_world),
                Frame::World => m.in_body,
            };
            let noise_in_body = match m.measured_in {
                Frame::Body => m.covariance,
                Frame::World => conjugated(&solution.inverse(), &m.covariance),
            };
            let slope = hat(&known_in_body) * weight(m);
            gradient += slope * noise_in_body * slope.transpose();
        }
        // The solution's covariance is `bend^-1 gradient bend^-1`.
        let weight = inverse_of_symmetric(&gradient, 0.0)
            .ok_or(FilterError::NotPositive("measurement covariance"))?;
        Ok(solution.matrix() * parameter_of_information(&(bend * weight * bend)))
    }
}

/// A covariance resolved in the body frame, in the frame that is not the gyroscope's.
fn carried(gyro: Frame, mode: &Rotation3<f64>, in_body: &Matrix3<f64>) -> Matrix3<f64> {
    match gyro {
        Frame::Body => conjugated(mode, in_body),
        Frame::World => *in_body,
    }
}

fn weight(m: &VectorMeasurement) -> f64 {
    3.0 / m.covariance.trace()
}

/// `N = tr(P^-1)/2 I - P^-1` (31).
fn parameter_of_covariance(p: &Matrix3<f64>) -> Result<Matrix3<f64>, FilterError> {
    let information = inverse_of_symmetric(p, 0.0).ok_or(FilterError::NotPositive("covariance"))?;
    Ok(parameter_of_information(&information))
}

fn parameter_of_information(information: &Matrix3<f64>) -> Matrix3<f64> {
    Matrix3::from_diagonal_element(0.5 * information.trace()) - information
}

/// The inverse of a symmetric matrix whose determinant exceeds `least` times the cube of its trace.
fn inverse_of_symmetric(m: &Matrix3<f64>, least: f64) -> Option<Matrix3<f64>> {
    let cofactors = cofactors(m);
    let determinant = m.column(0).dot(&cofactors.column(0));
    let inverse = cofactors * determinant.recip();
    (determinant > least * m.trace().powi(3)).then_some(inverse)
}

/// The inverse of an information matrix (30), or `fallback` where it is singular.
fn covariance_of(
    information: &Matrix3<f64>,
    fallback: impl FnOnce() -> Matrix3<f64>,
) -> Matrix3<f64> {
    let inverse = inverse_of_symmetric(information, LEAST_INFORMATION);
    let known = information.trace() > LEAST_INFORMATION;
    inverse.filter(|_| known).unwrap_or_else(fallback)
}

impl BayesFilter for FastNonlinear {
    fn name(&self) -> &'static str {
        match self.error {
            Frame::World => "fnf-r",
            Frame::Body => "fnf-l",
        }
    }

    fn propagate(&mut self, step: &InertialStep) -> Result<(), FilterError> {
        step.check()?;
        let turn = exp(&(step.angular_velocity * step.seconds));
        let next = match self.gyro.frame {
            Frame::Body => self.mode * turn,
            Frame::World => turn * self.mode,
        };
        let covariance = self.propagated(&next, step);
        super::finite_belief(&next, covariance.as_slice())?;
        (self.mode, self.covariance) = (next, covariance);
        Ok(())
    }

    fn update_attitude(&mut self, measured: &AttitudeMeasurement) -> Result<(), FilterError> {
        measured.check()?;
        self.fuse(&measured.parameter())
    }

    fn update_directions(&mut self, measured: &[VectorMeasurement]) -> Result<(), FilterError> {
        let added = self.likelihood(measured)?;
        self.fuse(&added)
    }

    fn attitude(&self) -> Rotation3<f64> {
        self.mode
    }

    fn estimate(&self) -> Estimate {
        let in_body = self.covariance_in_body();
        let information = in_body.try_inverse();
        let fisher =
            information.and_then(|h| MatrixFisher::from_mode_and_information(self.mode, h).ok());
        fisher.map_or_else(
            || Estimate::of_attitude(self.mode, super::wrapped(in_body)),
            |fisher| Estimate::of_matrix_fisher(&fisher),
        )
    }
}
