//! The matrix Fisher-Gaussian filter of attitude and gyro bias (W22 tables 4.3 to 4.5).

use nalgebra::{Matrix3, Rotation3, U3, Vector3};

use super::super::core::{
    AttitudeMeasurement, BayesFilter, Estimate, FilterError, InertialStep, VectorEstimate,
    VectorMeasurement,
};
use super::mfg_propagation::{Belief, deviation_forms, first_vector, propagate, turned_forms};
use super::{AttitudePrior, GyroModel};
use crate::distribution::matrix_fisher::MatrixFisher;
use crate::distribution::matrix_fisher_gaussian::{
    ConditionalMoments, Correlation, WeightedSample,
};
use crate::distribution::unscented::UnscentedError;
use crate::so3::{ProperSvd, exp};

/// Weight of the sigma points that turn the attitude, `w_M`: the broader the belief, the more they
/// need, up to one for the uniform distribution.
const ATTITUDE_WEIGHT: f64 = 0.9;
/// Weight of the sigma points that move the bias, `w_G`.
const BIAS_WEIGHT: f64 = 0.08;
/// Least cosine of the turn of a sigma point.
///
/// Beyond a right angle a further turn makes `v_R = (tr(S) I - S) sin t` smaller instead of larger,
/// so that the correlation of bias and attitude, which is negative, feeds on itself: its rate is
/// `dP/dt = P^2 (s_j + s_k) cos t` at the points, and for the distribution, damping,
/// `P^2 (s_j + s_k) E[sin^2 t cos t]/E[sin^2 t]`. Within minutes the bias was thrown out to infinity
/// (table 4.7 with `sigma2 = 200`).
const LEAST_COSINE: f64 = 0.0;

/// How the belief is carried through the kinematics.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MfgPropagation {
    /// By its moments (table 4.3).
    Moments,
    /// By 13 sigma points, each with six of the noise (table 4.4); by moments where the belief is
    /// so broad that they would lie more than a right angle from the mode.
    SigmaPoints,
}

/// Attitude and gyro bias as one matrix Fisher-Gaussian distribution: correlated in the inertial
/// frame (`mfgia`, `mfgiu`) or in the body frame (`mfgba`, `mfgbu`).
#[derive(Debug, Clone)]
pub struct AttitudeMfg {
    propagation: MfgPropagation,
    gyro: GyroModel,
    belief: Belief,
}

impl AttitudeMfg {
    /// The filter that starts from `prior`, attitude and bias uncorrelated.
    pub fn new(
        correlation: Correlation,
        propagation: MfgPropagation,
        gyro: &GyroModel,
        prior: &AttitudePrior,
    ) -> Result<Self, FilterError> {
        let belief = Belief::new(
            prior.attitude,
            prior.gyro_bias,
            prior.gyro_bias_covariance,
            Matrix3::zeros(),
            correlation,
        )?;
        Self::from_belief(propagation, gyro, belief)
    }

    /// The filter that starts from any belief.
    pub fn from_belief(
        propagation: MfgPropagation,
        gyro: &GyroModel,
        belief: Belief,
    ) -> Result<Self, FilterError> {
        super::requires_body_rate(gyro)?;
        Ok(Self { propagation, gyro: *gyro, belief })
    }

    /// The belief.
    pub fn belief(&self) -> &Belief {
        &self.belief
    }

    /// Theorem 4.9 with the parameter `added` of the likelihood. The regression of the bias on
    /// the prior's `v_R` is linear in `vec(Q)` of the posterior, so that its moments are those of
    /// second order.
    fn fuse(&mut self, added: &Matrix3<f64>) -> Result<(), FilterError> {
        let (prior, correlation) = (&self.belief, self.belief.correlation());
        let ProperSvd { u, s, v } = *prior.attitude().svd();
        let attitude = MatrixFisher::new(&(prior.attitude().parameter() + added))?;
        let posterior = attitude.svd();
        let moments = attitude.moments();
        let (turn_u, turn_v) = (posterior.u.inverse() * u, posterior.v.inverse() * v);
        let forms =
            turned_forms(&deviation_forms(correlation, &s), turn_u.matrix(), turn_v.matrix());
        let first = first_vector(moments);
        let second = moments.second_matrix();
        let mean = forms.transpose() * first;
        let variance = forms.transpose() * (second - first * first.transpose()) * forms;
        let cross = forms.transpose() * second * deviation_forms(correlation, &posterior.s);
        let p = prior.p();
        let scaled = posterior.s.component_mul(&moments.first());
        let deviation = Vector3::from_fn(|i, _| scaled[(i + 1) % 3] + scaled[(i + 2) % 3]);
        let conditional = ConditionalMoments::<U3> {
            mean: prior.mu() + p * mean,
            deviation_mean: Vector3::zeros(),
            covariance: prior.conditional_covariance() + p * variance * p.transpose(),
            cross: p * cross,
            deviation_covariance: Matrix3::from_diagonal(&deviation),
        };
        self.belief = Belief::from_moments(attitude, correlation, &conditional)?;
        Ok(())
    }

    /// Table 4.4.
    fn propagated_points(&self, step: &InertialStep) -> Result<Belief, FilterError> {
        let h = step.seconds;
        let factor = self.gyro.angle_covariance(step).cholesky();
        let spread = factor.map_or_else(Matrix3::zeros, |factor| factor.l() * 3f64.sqrt());
        let points = self.belief.sigma_points(ATTITUDE_WEIGHT, BIAS_WEIGHT)?;
        let back = self.belief.attitude().mode().inverse();
        let cosine = |r: &Rotation3<f64>| 0.5 * ((back * r).matrix().trace() - 1.0);
        if points.iter().any(|point| cosine(&point.attitude) < LEAST_COSINE) {
            return Err(UnscentedError::TooBroad(ATTITUDE_WEIGHT).into());
        }
        let mut propagated = Vec::with_capacity(6 * points.len());
        for point in &points {
            let angle = (step.angular_velocity - point.x) * h;
            for column in spread.column_iter() {
                for sign in [1.0, -1.0] {
                    let turn = exp(&(angle + column * sign));
                    let attitude = point.attitude * turn;
                    propagated.push(WeightedSample {
                        weight: point.weight / 6.0,
                        attitude,
                        x: point.x,
                    });
                }
            }
        }
        let belief = Belief::from_sigma_points(&propagated, &self.belief)?;
        Ok(belief.add_independent(&Vector3::zeros(), &(self.gyro.bias_walk * h))?)
    }
}

impl BayesFilter for AttitudeMfg {
    fn name(&self) -> &'static str {
        match (self.belief.correlation(), self.propagation) {
            (Correlation::World, MfgPropagation::Moments) => "mfgia",
            (Correlation::World, MfgPropagation::SigmaPoints) => "mfgiu",
            (Correlation::Body, MfgPropagation::Moments) => "mfgba",
            (Correlation::Body, MfgPropagation::SigmaPoints) => "mfgbu",
        }
    }

    fn propagate(&mut self, step: &InertialStep) -> Result<(), FilterError> {
        step.check()?;
        self.belief = match self.propagation {
            MfgPropagation::Moments => propagate(&self.belief, &self.gyro, step)?,
            MfgPropagation::SigmaPoints => match self.propagated_points(step) {
                Err(FilterError::SigmaPoints(UnscentedError::TooBroad(_))) => {
                    propagate(&self.belief, &self.gyro, step)?
                }
                propagated => propagated?,
            },
        };
        Ok(())
    }

    fn update_attitude(&mut self, measured: &AttitudeMeasurement) -> Result<(), FilterError> {
        measured.check()?;
        self.fuse(&measured.parameter())
    }

    fn update_directions(&mut self, measured: &[VectorMeasurement]) -> Result<(), FilterError> {
        self.fuse(&VectorMeasurement::joint_parameter(measured)?)
    }

    /// Given the attitude, bias and measurement are Gaussian, and what is left of the likelihood is
    /// `exp(pull^T v_R - v_R^T weight v_R/2)`. The first term adds to the matrix Fisher parameter;
    /// the second one is taken at the mode, where `v_R = (tr(S) I - S) e`, as information on `e`.
    fn update_gyro_bias(&mut self, measured: &VectorEstimate) -> Result<(), FilterError> {
        let (prior, correlation) = (&self.belief, self.belief.correlation());
        let conditional = prior.conditional_covariance();
        let inverse = (conditional + measured.covariance).try_inverse();
        let inverse = inverse.ok_or(FilterError::NotPositive("innovation covariance"))?;
        let (p, residual) = (prior.p(), measured.mean - prior.mu());
        let (pull, weight) = (p.transpose() * inverse * residual, p.transpose() * inverse * p);

        let ProperSvd { u, s, v } = *prior.attitude().svd();
        let forms = deviation_forms(correlation, &s);
        let linear = Matrix3::from_column_slice((forms * pull).as_slice());
        let tangent = Matrix3::from_diagonal(&prior.tangent_information());
        let information = tangent * weight * tangent;
        let half_trace = Matrix3::from_diagonal_element(0.5 * information.trace());
        let added = u.matrix() * (linear + half_trace - information) * v.matrix().transpose();

        let gain = conditional * inverse;
        let kept = Matrix3::identity() - gain;
        let belief = Belief::from_conditional(
            *prior.attitude(),
            prior.mu() + gain * residual,
            kept * conditional * kept.transpose() + gain * measured.covariance * gain.transpose(),
            kept * p,
            correlation,
        )?;
        let mut updated = Self { belief, ..self.clone() };
        updated.fuse(&added)?;
        *self = updated;
        Ok(())
    }

    fn attitude(&self) -> Rotation3<f64> {
        self.belief.attitude().mode()
    }

    fn gyro_bias(&self) -> Option<Vector3<f64>> {
        Some(*self.belief.mu())
    }

    fn estimate(&self) -> Estimate {
        let moments = self.belief.moments();
        Estimate {
            gyro_bias: Some(VectorEstimate { mean: moments.mean, covariance: moments.covariance }),
            ..Estimate::of_matrix_fisher(self.belief.attitude())
        }
    }
}
