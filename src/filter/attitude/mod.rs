//! Attitude estimators of the four papers and their rivals, behind [`BayesFilter`].
//!
//! | name | belief | source |
//! | --- | --- | --- |
//! | `bf-mfd` | matrix Fisher, exact first moments | L-AMF table I, L-UAE |
//! | `bf-amfd` | the same, with approximate solution logic | L-AMF section V |
//! | `uae` | matrix Fisher, carried by seven sigma points | L-UAE section III |
//! | `fnf-r`, `fnf-l` | matrix Fisher, linearised propagation and likelihood | FNF algorithms 1, 2 |
//! | `mfgia`, `mfgba` | matrix Fisher-Gaussian with gyro bias, moments | W22 tables 4.3, 4.5 |
//! | `mfgiu`, `mfgbu` | the same, with sigma points | W22 tables 4.4, 4.5 |
//! | `iekf`, `iekf-l` | Gaussian, right- and left-invariant error | FNF reference 21 |
//! | `mekf`, `mekf-i` | Gaussian with gyro bias, error in the body and inertial frame | W22 (1.3), (1.4) |
//! | `ukf` | Gaussian with gyro bias, sigma points | W22 4.2.4 |
//!
//! Single-direction estimation (W22 4.1) is `bf-mfd` with the angular velocity resolved in either
//! frame ([`GyroModel::frame`]) and directions measured in either.
//!
//! # What is said of them here and not in the papers
//!
//! - The first-order filter needs its parameter only where a measurement arrives; in between its
//!   mean is propagated in closed form, which is the same filter.
//! - `fnf-r` and `fnf-l` are one filter in two coordinates: `P_R = R P_L R^T` is kept by (37) and
//!   (49) for isotropic gyro noise, by the likelihoods (44) and (51), and by the posteriors (47)
//!   and (53). Differences between the columns of FNF tables III to V are therefore not
//!   properties of the filters.
//! - The seven equally weighted points of L-UAE carry the parameter but not the first moment, so
//!   that process noise enters `uae` with a weight that depends on the concentration; the
//!   weighted points of W22 definition 4.3 (`mfgiu`, `mfgbu`) do not have this defect.

mod adaptive;
mod bayes_fisher;
mod fast;
mod gaussian;
mod invariant;
mod mean;
mod mfg;
mod mfg_propagation;
mod sigma_point_kalman;
mod wahba;

#[cfg(test)]
mod tests;

use std::fmt;
use std::str::FromStr;

use nalgebra::{Matrix3, Rotation3, SymmetricEigen, Vector3};

use super::core::{BayesFilter, FilterError, Frame, InertialStep, finite};
use crate::distribution::matrix_fisher::MatrixFisher;
use crate::distribution::matrix_fisher_gaussian::Correlation;

pub use adaptive::{AdaptiveAttitude, AdaptiveConfig, AttitudeStep, CarryingConfig};
pub use bayes_fisher::{BayesFisher, MomentMap};
pub use fast::FastNonlinear;
pub use gaussian::AttitudeMekf;
pub use invariant::InvariantKalman;
pub use mfg::{AttitudeMfg, MfgPropagation};
pub use sigma_point_kalman::AttitudeUkf;
pub use wahba::wahba;

/// Variance of each component of the rotation vector of a uniformly distributed rotation, rad^2:
/// `(pi^2/3 + 2)/3`.
pub const UNIFORM_VARIANCE: f64 = (std::f64::consts::PI * std::f64::consts::PI / 3.0 + 2.0) / 3.0;

/// Variance of an angle that is uniform on the circle, rad^2: `pi^2/3`.
const UNIFORM_ANGLE_VARIANCE: f64 = std::f64::consts::PI * std::f64::consts::PI / 3.0;

/// The gyroscope: `measured = true + bias + white noise`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GyroModel {
    /// In which frame the angular velocity and its noise are resolved: the body's for a
    /// gyroscope, (4.2); the world's for (4.1). Filters with a bias know only the former.
    pub frame: Frame,
    /// Density of the white noise, rad^2/s.
    pub noise: Matrix3<f64>,
    /// Density of the bias random walk, rad^2/s^3.
    pub bias_walk: Matrix3<f64>,
}

impl GyroModel {
    /// A gyroscope with the same noise about every axis, rad/sqrt(s) and rad/s/sqrt(s).
    pub fn isotropic(noise: f64, bias_walk: f64) -> Self {
        Self {
            frame: Frame::Body,
            noise: Matrix3::from_diagonal_element(noise * noise),
            bias_walk: Matrix3::from_diagonal_element(bias_walk * bias_walk),
        }
    }

    fn check(&self) -> Result<(), FilterError> {
        finite("gyro noise", self.noise.as_slice())?;
        finite("gyro bias walk", self.bias_walk.as_slice())
    }

    /// The covariance of the angle over a step.
    fn angle_covariance(&self, step: &InertialStep) -> Matrix3<f64> {
        self.noise * step.seconds + step.angle_covariance
    }

    /// The variance of the angle over a step, if it is the same about every axis.
    fn isotropic_variance(&self, step: &InertialStep) -> Option<f64> {
        let covariance = self.angle_covariance(step);
        let variance = covariance[(0, 0)];
        (covariance == Matrix3::from_diagonal_element(variance)).then_some(variance)
    }
}

/// What a filter believes before the first measurement.
#[derive(Debug, Clone, Copy)]
pub struct AttitudePrior {
    pub attitude: MatrixFisher,
    /// Covariance of the body-frame rotation vector, rad^2, that the Gaussian filters start
    /// from instead of [`gaussian_covariance`]; `None`: that.
    pub rotation_covariance: Option<Matrix3<f64>>,
    /// rad/s.
    pub gyro_bias: Vector3<f64>,
    /// rad^2/s^2.
    pub gyro_bias_covariance: Matrix3<f64>,
}

impl AttitudePrior {
    /// `M(f)`, with a bias known to be zero.
    pub fn matrix_fisher(f: &Matrix3<f64>) -> Result<Self, FilterError> {
        Ok(Self {
            attitude: MatrixFisher::new(f)?,
            rotation_covariance: None,
            gyro_bias: Vector3::zeros(),
            gyro_bias_covariance: Matrix3::from_diagonal_element(1e-12),
        })
    }

    fn gaussian(&self) -> Result<(Rotation3<f64>, Matrix3<f64>), FilterError> {
        let covariance =
            self.rotation_covariance.unwrap_or_else(|| gaussian_covariance(&self.attitude));
        finite("prior covariance", covariance.as_slice())?;
        finite("prior bias", self.gyro_bias.as_slice())?;
        finite("prior bias covariance", self.gyro_bias_covariance.as_slice())?;
        Ok((self.attitude.mode(), covariance))
    }
}

/// The inverse of the information at the mode (FNF 30), no axis broader than the uniform
/// distribution.
pub fn gaussian_covariance(attitude: &MatrixFisher) -> Matrix3<f64> {
    let eigen = SymmetricEigen::new(attitude.information());
    let variance = eigen.eigenvalues.map(|a| a.max(UNIFORM_VARIANCE.recip()).recip());
    eigen.eigenvectors * Matrix3::from_diagonal(&variance) * eigen.eigenvectors.transpose()
}

/// The filters of `attitude --filter`, and the rivals that only studies use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum AttitudeFilterKind {
    BfMfd,
    BfAmfd,
    Uae,
    FnfR,
    FnfL,
    Mfgia,
    Mfgiu,
    Mfgba,
    Mfgbu,
    Iekf,
    IekfL,
    Mekf,
    MekfI,
    Ukf,
}

impl AttitudeFilterKind {
    pub const ALL: [Self; 14] = [
        Self::Mfgia,
        Self::Mfgiu,
        Self::Mfgba,
        Self::Mfgbu,
        Self::FnfR,
        Self::FnfL,
        Self::BfMfd,
        Self::BfAmfd,
        Self::Uae,
        Self::Mekf,
        Self::MekfI,
        Self::Iekf,
        Self::IekfL,
        Self::Ukf,
    ];

    pub fn name(self) -> &'static str {
        match self {
            Self::BfMfd => "bf-mfd",
            Self::BfAmfd => "bf-amfd",
            Self::Uae => "uae",
            Self::FnfR => "fnf-r",
            Self::FnfL => "fnf-l",
            Self::Mfgia => "mfgia",
            Self::Mfgiu => "mfgiu",
            Self::Mfgba => "mfgba",
            Self::Mfgbu => "mfgbu",
            Self::Iekf => "iekf",
            Self::IekfL => "iekf-l",
            Self::Mekf => "mekf",
            Self::MekfI => "mekf-i",
            Self::Ukf => "ukf",
        }
    }

    /// Whether the filter estimates the gyro bias.
    pub fn has_bias(self) -> bool {
        matches!(
            self,
            Self::Mfgia
                | Self::Mfgiu
                | Self::Mfgba
                | Self::Mfgbu
                | Self::Mekf
                | Self::MekfI
                | Self::Ukf
        )
    }

    /// A filter of this kind.
    pub fn start(
        self,
        gyro: &GyroModel,
        prior: &AttitudePrior,
    ) -> Result<Box<dyn BayesFilter>, FilterError> {
        use MfgPropagation::{Moments, SigmaPoints};
        gyro.check()?;
        let first_order = |map| -> Result<Box<dyn BayesFilter>, FilterError> {
            Ok(Box::new(BayesFisher::new(map, gyro, &prior.attitude)?))
        };
        let mfg = |correlation, propagation| -> Result<Box<dyn BayesFilter>, FilterError> {
            Ok(Box::new(AttitudeMfg::new(correlation, propagation, gyro, prior)?))
        };
        Ok(match self {
            Self::BfMfd => first_order(MomentMap::Exact)?,
            Self::BfAmfd => first_order(MomentMap::Approximate)?,
            Self::Uae => first_order(MomentMap::SevenPoints)?,
            Self::FnfR => Box::new(FastNonlinear::new(Frame::World, gyro, &prior.attitude)),
            Self::FnfL => Box::new(FastNonlinear::new(Frame::Body, gyro, &prior.attitude)),
            Self::Mfgia => mfg(Correlation::World, Moments)?,
            Self::Mfgiu => mfg(Correlation::World, SigmaPoints)?,
            Self::Mfgba => mfg(Correlation::Body, Moments)?,
            Self::Mfgbu => mfg(Correlation::Body, SigmaPoints)?,
            Self::Iekf => Box::new(InvariantKalman::new(Frame::World, gyro, prior)?),
            Self::IekfL => Box::new(InvariantKalman::new(Frame::Body, gyro, prior)?),
            Self::Mekf => Box::new(AttitudeMekf::new(Frame::Body, gyro, prior)?),
            Self::MekfI => Box::new(AttitudeMekf::new(Frame::World, gyro, prior)?),
            Self::Ukf => Box::new(AttitudeUkf::new(gyro, prior)?),
        })
    }
}

impl fmt::Display for AttitudeFilterKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for AttitudeFilterKind {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Self::ALL.into_iter().find(|kind| kind.name() == text).ok_or_else(|| {
            let names: Vec<_> = Self::ALL.iter().map(|kind| kind.name()).collect();
            format!("unknown filter `{text}`; there are: {}", names.join(", "))
        })
    }
}

/// Refuses a belief of an attitude and a covariance that are not finite.
fn finite_belief(attitude: &Rotation3<f64>, covariance: &[f64]) -> Result<(), FilterError> {
    finite("propagated attitude", attitude.matrix().as_slice())?;
    finite("propagated covariance", covariance)
}

/// The covariance of the rotation vector of a Gaussian belief, no axis broader than a uniform
/// angle. A Gaussian counts the turns that may have been made; of an attitude, which does not, its
/// variance about an axis says nothing beyond this.
fn wrapped(covariance: Matrix3<f64>) -> Matrix3<f64> {
    if covariance.trace() <= UNIFORM_ANGLE_VARIANCE {
        return covariance;
    }
    let eigen = SymmetricEigen::new(covariance);
    let variance = eigen.eigenvalues.map(|v| v.min(UNIFORM_ANGLE_VARIANCE));
    eigen.eigenvectors * Matrix3::from_diagonal(&variance) * eigen.eigenvectors.transpose()
}

/// Refuses an angular velocity in world coordinates, for filters with a bias.
fn requires_body_rate(gyro: &GyroModel) -> Result<(), FilterError> {
    let in_body = gyro.frame == Frame::Body;
    in_body.then_some(()).ok_or(FilterError::WorldRate)
}

fn symmetric(m: &Matrix3<f64>) -> Matrix3<f64> {
    0.5 * (m + m.transpose())
}

/// `M(F)`'s information `tr(K) I - K` from the symmetric part `K` of its polar form.
fn information_of(k: &Matrix3<f64>) -> Matrix3<f64> {
    Matrix3::from_diagonal_element(k.trace()) - k
}
