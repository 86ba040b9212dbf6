//! The first-order matrix Fisher filter (L-AMF table I) with three ways from moments to
//! parameters and back.

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::super::core::{
    AttitudeMeasurement, BayesFilter, Estimate, FilterError, Frame, InertialStep, VectorMeasurement,
};
use super::GyroModel;
use super::mean::PrincipalMean;
use crate::distribution::matrix_fisher::{
    FirstMoments, MatrixFisher, MatrixFisherError, s_concentrated, s_near_uniform,
};
use crate::distribution::unscented::{matrix_fisher_of_seven, mean_rotation, seven_points};
use crate::so3::{ProperSvd, exp, principal_axes, proper_polar};

/// Spread of the seven sigma points, `sigma` of L-UAE.
const SEVEN_POINT_SPREAD: f64 = 0.9;
/// Below this largest `E[Q_ii]` the near-uniform approximation applies (L-AMF section V).
const NEAR_UNIFORM_MOMENT: f64 = 0.1;
/// Above it the concentrated one does.
const CONCENTRATED_MOMENT: f64 = 0.9;

/// How a matrix Fisher belief and its mean determine each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MomentMap {
    /// By the exact first moments (`bf-mfd`).
    Exact,
    /// As published: exact moments, and parameters by (35), (39) of L-AMF where the distribution
    /// is broad or concentrated, after every step (`bf-amfd`).
    Approximate,
    /// By the mean of seven sigma points (`uae`, L-UAE proposition 3).
    SevenPoints,
}

/// A matrix Fisher belief that is propagated by its mean and multiplied with the likelihoods of
/// attitudes and directions, which are conjugate to it.
#[derive(Debug, Clone, Copy)]
pub struct BayesFisher {
    map: MomentMap,
    gyro: GyroModel,
    mean: PrincipalMean,
    /// Those of the posterior of the last measurement, where the next inversion starts.
    last: FirstMoments,
}

impl BayesFisher {
    /// The filter that starts from `prior`.
    pub fn new(
        map: MomentMap,
        gyro: &GyroModel,
        prior: &MatrixFisher,
    ) -> Result<Self, FilterError> {
        let (mean, last) = map.mean(prior.svd())?;
        Ok(Self { map, gyro: *gyro, mean, last })
    }

    /// The belief as a distribution.
    pub fn belief(&self) -> Result<MatrixFisher, FilterError> {
        let svd = self.map.parameter(&self.mean, &self.last)?;
        Ok(MatrixFisher::from_svd(svd).map_err(MatrixFisherError::from)?)
    }

    /// `F + added`.
    fn fuse(&mut self, added: &Matrix3<f64>) -> Result<(), FilterError> {
        let prior = self.map.parameter(&self.mean, &self.last)?;
        let (mode, k) = proper_polar(&(prior.matrix() + added))?;
        let (v, s) = principal_axes(&k);
        let posterior = ProperSvd { u: mode * v, s: in_order(&s), v };
        (self.mean, self.last) = self.map.mean(&posterior)?;
        Ok(())
    }
}

impl MomentMap {
    fn mean(self, fisher: &ProperSvd) -> Result<(PrincipalMean, FirstMoments), FilterError> {
        let first = FirstMoments::new(&fisher.s).map_err(MatrixFisherError::from)?;
        let g = match self {
            Self::Exact | Self::Approximate => first.complement(),
            Self::SevenPoints => {
                let fisher = MatrixFisher::from_svd(*fisher).map_err(MatrixFisherError::from)?;
                let mean = mean_rotation(&seven_points(&fisher, SEVEN_POINT_SPREAD)?);
                let svd = fisher.svd();
                let centred = svd.u.matrix().transpose() * mean * svd.v.matrix();
                centred.diagonal().map(|d| 1.0 - d)
            }
        };
        Ok((PrincipalMean::new(fisher, g), first))
    }

    fn parameter(
        self,
        mean: &PrincipalMean,
        near: &FirstMoments,
    ) -> Result<ProperSvd, FilterError> {
        if self == Self::SevenPoints {
            return Ok(*matrix_fisher_of_seven(&mean.matrix(), SEVEN_POINT_SPREAD)?.svd());
        }
        let g = mean.complement;
        let approximate = || match 1.0 - g[0] {
            d if d < NEAR_UNIFORM_MOMENT => Some(s_near_uniform(&g.map(|g| 1.0 - g))),
            d if d > CONCENTRATED_MOMENT => s_concentrated(&g),
            _ => None,
        };
        let s = match self {
            Self::Approximate => approximate(),
            _ => None,
        };
        let s = match s {
            Some(s) => in_order(&s),
            None => near.neighbour(&g).map_err(MatrixFisherError::from)?,
        };
        Ok(ProperSvd { u: mean.axes_in_world, s, v: mean.axes_in_body() })
    }
}

/// Singular values in order also where the rounding of almost equal ones has exchanged them.
fn in_order(s: &Vector3<f64>) -> Vector3<f64> {
    let s1 = s[0].max(0.0);
    let s2 = s[1].clamp(0.0, s1);
    Vector3::new(s1, s2, s[2].clamp(-s2, s2))
}

impl BayesFilter for BayesFisher {
    fn name(&self) -> &'static str {
        match self.map {
            MomentMap::Exact => "bf-mfd",
            MomentMap::Approximate => "bf-amfd",
            MomentMap::SevenPoints => "uae",
        }
    }

    fn propagate(&mut self, step: &InertialStep) -> Result<(), FilterError> {
        step.check()?;
        let turn = exp(&(step.angular_velocity * step.seconds));
        let q = || self.gyro.angle_covariance(step);
        let mean = match (self.gyro.isotropic_variance(step), self.gyro.frame) {
            (Some(variance), _) => self.mean.diffused(variance),
            (None, Frame::Body) => self.mean.polar().diffused_in_body(&q())?.principal(),
            (None, Frame::World) => self.mean.polar().diffused_in_world(&q())?.principal(),
        };
        let mean = match self.gyro.frame {
            Frame::Body => mean.turned(&turn),
            Frame::World => mean.turned_in_world(&turn),
        };
        super::finite_belief(&mean.mode, mean.complement.as_slice())?;
        if self.map == MomentMap::Approximate {
            let svd = self.map.parameter(&mean, &self.last)?;
            (self.mean, self.last) = self.map.mean(&svd)?;
        } else {
            self.mean = mean;
        }
        Ok(())
    }

    fn update_attitude(&mut self, measured: &AttitudeMeasurement) -> Result<(), FilterError> {
        measured.check()?;
        self.fuse(&measured.parameter())
    }

    fn update_directions(&mut self, measured: &[VectorMeasurement]) -> Result<(), FilterError> {
        self.fuse(&VectorMeasurement::joint_parameter(measured)?)
    }

    fn attitude(&self) -> Rotation3<f64> {
        self.mean.mode
    }

    fn estimate(&self) -> Estimate {
        match self.belief() {
            Ok(belief) => Estimate::of_matrix_fisher(&belief),
            // A mean at the edge of what a distribution can have: the mode is still right.
            Err(_) => Estimate::of_attitude(
                self.mean.mode,
                Matrix3::from_diagonal_element(super::UNIFORM_VARIANCE),
            ),
        }
    }
}
