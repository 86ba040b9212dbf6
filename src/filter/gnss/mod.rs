//! Loosely coupled IMU-GNSS estimators: attitude, velocity, position and both biases.
//!
//! The matrix Fisher-Gaussian filters (`mfgi`, `mfgb`; W22 5.1) carry the moments of the belief
//! through the kinematics ([`propagation`]) and condition it on positions, attitudes and
//! directions by Bayes' rule ([`update`]); nothing in them assumes that the attitude is known, so
//! that a heading may be unknown at the start. Their rival `mekf` linearises about its estimate.
//!
//! Where this differs from W22: biases are subtracted; acceleration acts along the attitude half-way
//! through the step; and the regression of the Euclidean state on `R` is kept whole while the
//! attitude is diffuse ([`Regression::Full`]). With an unknown heading that is not a refinement:
//! `s2 = s3 = 0` makes the first component of `v_R` vanish, so that a matrix Fisher-Gaussian
//! distribution cannot say how velocity and position depend on the heading.

mod belief;
mod central;
mod config;
mod consistency;
mod mekf;
mod mfg;
mod mixture;
mod navigation;
mod propagation;
mod start;
mod update;

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use super::{BayesFilter, Estimate, FilterError, PositionMeasurement, VectorEstimate};
use crate::distribution::matrix_fisher_gaussian::Correlation;
use crate::inertial::{Belief, ImuConfig, NavState, block};

pub use belief::Regression;
pub use config::{
    GnssConfig, GnssFilterConfig, ImuAxes, NavigationLogConfig, OutageConfig, OutputConfig,
    ReceiverConfig, StartConfig, WorldAxes,
};
pub use consistency::{Consistency, ConsistencyConfig};
pub use mekf::MekfGnss;
pub(crate) use mekf::moved as moved_state;
pub use mfg::{MfgGnss, MfgOptions};
pub(crate) use mixture::{combined_belief, combined_innovation};
pub use navigation::{
    Agreement, FixReport, FixUse, NavigationError, NavigationStep, NavigationSummary, OutageReport,
    navigate, navigate_with,
};
pub use start::InitialBelief;
pub use update::AttitudeUpdate;

/// The estimators by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum GnssFilterKind {
    /// Matrix Fisher-Gaussian, correlations with rotations in the world frame.
    Mfgi,
    /// Matrix Fisher-Gaussian, correlations with rotations in the body frame.
    Mfgb,
    /// Multiplicative extended Kalman filter.
    Mekf,
}

impl GnssFilterKind {
    pub const ALL: [Self; 3] = [Self::Mfgi, Self::Mfgb, Self::Mekf];

    pub fn name(self) -> &'static str {
        match self {
            Self::Mfgi => "mfgi",
            Self::Mfgb => "mfgb",
            Self::Mekf => "mekf",
        }
    }

    /// A filter of this kind that starts with `initial`.
    pub fn start(
        self,
        imu: &ImuConfig,
        update: AttitudeUpdate,
        initial: &InitialBelief,
    ) -> Result<Box<dyn GnssFilter>, FilterError> {
        let full = |correlation| MfgOptions {
            name: self.name(),
            regression: Regression::Full(correlation),
            update,
            divided: true,
        };
        Ok(match self {
            Self::Mfgi => Box::new(MfgGnss::new(imu, full(Correlation::World), initial)?),
            Self::Mfgb => Box::new(MfgGnss::new(imu, full(Correlation::Body), initial)?),
            Self::Mekf => Box::new(MekfGnss::new(imu, initial)?),
        })
    }
}

/// Difference of a measured position from the predicted one, m.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Innovation {
    pub residual: Vector3<f64>,
    pub covariance: Matrix3<f64>,
    /// Normalized innovation squared, chi-square with 3 degrees of freedom if the belief is right.
    pub nis: f64,
}

impl Innovation {
    fn new(residual: Vector3<f64>, covariance: Matrix3<f64>) -> Result<Self, FilterError> {
        let factor = covariance
            .cholesky()
            .ok_or(FilterError::NotPositive("covariance of the innovation"))?;
        let nis = residual.dot(&factor.solve(&residual));
        if nis.is_finite() {
            Ok(Self { residual, covariance, nis })
        } else {
            Err(FilterError::NotFinite("innovation"))
        }
    }

    /// Logarithm of the Gaussian density of the measurement, up to a constant.
    pub(crate) fn log_likelihood(&self) -> f64 {
        -0.5 * (self.nis + self.covariance.determinant().ln())
    }

    /// By what the covariance of the belief must be multiplied for the normalized innovation
    /// squared to come down to `bound`, the measurement's own noise being as it is.
    fn enlargement(&self, noise: &Matrix3<f64>, bound: f64) -> Result<f64, FilterError> {
        let predicted = self.covariance - noise;
        let (mut factor, mut nis) = (1.0, self.nis);
        // The covariance grows by less than the belief's, so that this comes from below.
        for _ in 0..MAX_ENLARGEMENTS {
            if nis <= bound * (1.0 + ENLARGEMENT_TOLERANCE) {
                return Ok(factor);
            }
            factor *= nis / bound;
            nis = Self::new(self.residual, predicted * factor + noise)?.nis;
        }
        Err(FilterError::NoConvergence("the enlargement of the belief"))
    }
}

const MAX_ENLARGEMENTS: usize = 1000;
/// Of the bound.
const ENLARGEMENT_TOLERANCE: f64 = 0.01;

/// A recursive estimator of attitude, velocity, position and biases.
pub trait GnssFilter: BayesFilter {
    /// Difference of a position from its prediction, without using it.
    fn innovation(&self, position: &PositionMeasurement) -> Result<Innovation, FilterError>;

    /// Adds an independent error of this variance (m^2) to each component of the position.
    fn loosen_position(&mut self, variance: f64);

    /// Whether what follows is propagated with the noise of a gap in the IMU's data.
    fn set_imu_gap(&mut self, in_gap: bool);

    /// Multiplies the covariance of the belief, about the same estimate.
    fn enlarge(&mut self, factor: f64) -> Result<(), FilterError>;

    /// The estimate, and the joint covariance of its error.
    fn belief(&self) -> Belief;

    /// The estimate alone, which is cheap.
    fn state(&self) -> NavState;

    /// `S` of the attitude's matrix Fisher distribution, if the filter has one.
    fn concentration(&self) -> Option<Vector3<f64>> {
        None
    }
}

/// A belief in the terms of all filters.
pub(crate) fn estimate(belief: &Belief, matrix_fisher_s: Option<Vector3<f64>>) -> Estimate {
    let Belief { state, covariance } = belief;
    let part = |mean: Vector3<f64>, start: usize| {
        let covariance = covariance.fixed_view::<3, 3>(start, start).into_owned();
        Some(VectorEstimate { mean, covariance })
    };
    Estimate {
        world_from_body: state.world_from_body.rotation.to_rotation_matrix(),
        rotation_covariance: covariance
            .fixed_view::<3, 3>(block::ROTATION, block::ROTATION)
            .into_owned(),
        matrix_fisher_s,
        gyro_bias: part(state.gyro_bias, block::GYRO_BIAS),
        velocity: part(state.velocity, block::VELOCITY),
        position: part(state.world_from_body.translation.vector, block::POSITION),
        accel_bias: part(state.accel_bias, block::ACCEL_BIAS),
    }
}

#[cfg(test)]
mod tests;
