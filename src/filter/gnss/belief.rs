//! The belief of the matrix Fisher-Gaussian filters and its projections.

use nalgebra::{Matrix3, Rotation3, SMatrix, SVector, Vector3};

use super::central::{Matrix9, mean_and_covariance};
use crate::distribution::matrix_fisher::{MatrixFisher, MatrixFisherError};
use crate::distribution::matrix_fisher_gaussian::Correlation;
use crate::filter::FilterError;
use crate::inertial::{Belief, NavCovariance, NavState, block, symmetrize};
use crate::so3::ProperSvd;

/// Dimension of the Euclidean part: velocity, position, gyroscope bias, accelerometer bias, in
/// the order of [`NavCovariance`].
pub(super) const EUCLIDEAN: usize = 12;
/// First components of the blocks within the Euclidean part.
pub(super) const VELOCITY: usize = block::VELOCITY - 3;
pub(super) const POSITION: usize = block::POSITION - 3;
pub(super) const GYRO_BIAS: usize = block::GYRO_BIAS - 3;
pub(super) const ACCEL_BIAS: usize = block::ACCEL_BIAS - 3;

pub(super) type Euclidean = SVector<f64, EUCLIDEAN>;
pub(super) type EuclideanCovariance = SMatrix<f64, EUCLIDEAN, EUCLIDEAN>;
pub(super) type Slope = SMatrix<f64, EUCLIDEAN, 9>;

/// Above this concentration `s2 + s3` the functions of `Q` that are of second order in its angle
/// carry nothing that three numbers `v_R` do not.
const FULL_REGRESSION_LIMIT: f64 = 1e3;
/// A feature of `Q` with a smaller variance does not vary but for rounding: entries of `Q` are at
/// most one.
const MIN_VARIANCE: f64 = 1e-30;

/// What of the regression of the Euclidean state on the rotation matrix a filter keeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Regression {
    /// Its projection on the three numbers `v_R` of a matrix Fisher-Gaussian distribution (W22
    /// theorem 3.6).
    Projected(Correlation),
    /// All nine columns while the attitude is diffuse; where it is concentrated
    /// (`s2 + s3 > 1000`), the projection, which then loses nothing.
    Full(Correlation),
}

/// `R ~ M(F)` and `x | R ~ N(mean + slope (q - E[q]), conditional)` with `q = vec(U^T R V)`.
///
/// A matrix Fisher-Gaussian distribution is the case `slope = P L`, `v_R = L q`.
#[derive(Debug, Clone)]
pub(super) struct NavigationBelief {
    pub attitude: MatrixFisher,
    /// `E[x]`.
    pub mean: Euclidean,
    pub slope: Slope,
    /// `Cov[x | R]`.
    pub conditional: EuclideanCovariance,
}

/// Second moments of `x` and of some `q`, from which a regression is made.
pub(super) struct JointMoments {
    pub x: EuclideanCovariance,
    pub cross: Slope,
    pub q: Matrix9,
}

impl NavigationBelief {
    /// Second moments of the belief in its own principal axes.
    pub fn joint_moments(&self) -> JointMoments {
        let (_, q) = mean_and_covariance(self.attitude.moments());
        let cross = self.slope * q;
        JointMoments { x: self.conditional + cross * self.slope.transpose(), cross, q }
    }

    /// The belief with these moments, whose `q` are `axes` times those of the new attitude.
    ///
    /// `axes` is `(V^T V+) (x) (U^T U+)`: it maps `q` of the attitude to the `q` of the moments.
    pub fn from_moments(
        attitude: MatrixFisher,
        mean: Euclidean,
        moments: &JointMoments,
        axes: &Matrix9,
        regression: Regression,
    ) -> Result<Self, FilterError> {
        let s = attitude.svd().s;
        let (slope, conditional) = match regression {
            Regression::Full(_) if s[1] + s[2] <= FULL_REGRESSION_LIMIT => {
                regress(moments, axes, &quaternion_products())?
            }
            Regression::Full(correlation) | Regression::Projected(correlation) => {
                regress(moments, axes, &correlation.central_regression(&s))?
            }
        };
        Ok(Self { attitude, mean, slope, conditional })
    }

    /// The belief with all covariances multiplied by `factor`, to leading order in the dispersion of
    /// the attitude.
    pub fn enlarged(&self, factor: f64) -> Result<Self, FilterError> {
        let svd = self.attitude.svd();
        let svd = ProperSvd { s: svd.s / factor, ..*svd };
        let attitude = MatrixFisher::from_svd(svd).map_err(MatrixFisherError::from)?;
        Ok(Self { attitude, conditional: self.conditional * factor, ..self.clone() })
    }

    pub fn is_finite(&self) -> bool {
        self.mean.iter().chain(self.conditional.iter()).all(|x| x.is_finite())
    }

    /// Mode and covariance. That of the rotation is the covariance of the rotation vector, however
    /// diffuse; its correlations with the rest are those of the antisymmetric part of `Q`, which is
    /// the rotation vector to first order.
    pub fn summary(&self) -> Belief {
        let moments = self.joint_moments();
        let antisymmetric = Correlation::Body.central_regression(&Vector3::repeat(0.5));
        let cross = moments.cross * antisymmetric.transpose();
        let variances = (antisymmetric * moments.q * antisymmetric.transpose()).diagonal();
        let rotation = self.attitude.rotation_covariance();
        let v = *self.attitude.svd().v.matrix();
        let in_axes = (v.transpose() * rotation * v).diagonal();
        let scale = Vector3::from_fn(|i, _| {
            if variances[i] > 0.0 { (in_axes[i] / variances[i]).sqrt() } else { 0.0 }
        });
        let cross = cross * Matrix3::from_diagonal(&scale) * v.transpose();
        let mut covariance = NavCovariance::zeros();
        covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
        covariance.fixed_view_mut::<EUCLIDEAN, 3>(3, 0).copy_from(&cross);
        covariance.fixed_view_mut::<3, EUCLIDEAN>(0, 3).copy_from(&cross.transpose());
        covariance.fixed_view_mut::<EUCLIDEAN, EUCLIDEAN>(3, 3).copy_from(&moments.x);
        symmetrize(&mut covariance);
        Belief { state: self.state(), covariance }
    }

    /// Mode of the attitude and mean of the rest.
    pub fn state(&self) -> NavState {
        Self::state_of(&self.attitude.mode(), &self.mean)
    }

    /// An attitude and a Euclidean part as plain values.
    pub fn state_of(attitude: &Rotation3<f64>, mean: &Euclidean) -> NavState {
        let part = |start: usize| mean.fixed_rows::<3>(start).into_owned();
        NavState {
            world_from_body: nalgebra::Isometry3::from_parts(
                part(POSITION).into(),
                nalgebra::UnitQuaternion::from_rotation_matrix(attitude),
            ),
            velocity: part(VELOCITY),
            gyro_bias: part(GYRO_BIAS),
            accel_bias: part(ACCEL_BIAS),
        }
    }
}

/// The 9x9 matrix that turns `q` into products of components of the unit quaternion, up to a
/// constant: `x_0 x_i`, `x_j x_k` and `x_i^2`. Unlike the entries of `Q` these are almost
/// uncorrelated where the attitude is concentrated, each on its own scale.
pub(super) fn quaternion_products() -> Matrix9 {
    let mut t = Matrix9::zeros();
    for (i, j, k) in [(0, 1, 2), (1, 2, 0), (2, 0, 1)] {
        let (kj, jk) = (k + 3 * j, j + 3 * k);
        t[(i, kj)] = 0.25;
        t[(i, jk)] = -0.25;
        t[(3 + i, kj)] = 0.25;
        t[(3 + i, jk)] = 0.25;
        t[(6 + i, 4 * i)] = 0.25;
        t[(6 + i, 4 * j)] = -0.25;
        t[(6 + i, 4 * k)] = -0.25;
    }
    t
}

/// Regresses `x` on the features `f = features q`: slope on `q` and covariance given `f`.
fn regress<const M: usize>(
    moments: &JointMoments,
    axes: &Matrix9,
    features: &SMatrix<f64, M, 9>,
) -> Result<(Slope, EuclideanCovariance), FilterError> {
    let old_features = features * axes.transpose();
    let covariance = old_features * moments.q * old_features.transpose();
    let cross = moments.cross * old_features.transpose();
    let gain = solve_scaled(&covariance, &cross.transpose())
        .ok_or(FilterError::NotPositive("covariance of the attitude"))?
        .transpose();
    let mut conditional = moments.x - gain * cross.transpose();
    symmetrize(&mut conditional);
    Ok((gain * features, conditional))
}

/// `covariance^-1 right`, with the covariance scaled to a unit diagonal; rows without variance
/// give zero.
pub(super) fn solve_scaled<const M: usize, const N: usize>(
    covariance: &SMatrix<f64, M, M>,
    right: &SMatrix<f64, M, N>,
) -> Option<SMatrix<f64, M, N>> {
    let scale =
        covariance.diagonal().map(|v| if v > MIN_VARIANCE { v.sqrt().recip() } else { 0.0 });
    let mut scaled = *covariance;
    let mut solution = *right;
    for i in 0..M {
        for j in 0..M {
            scaled[(i, j)] *= scale[i] * scale[j];
        }
        scaled[(i, i)] = 1.0;
        solution.row_mut(i).scale_mut(scale[i]);
    }
    scaled.cholesky()?.solve_mut(&mut solution);
    for (mut row, scale) in solution.row_iter_mut().zip(scale.iter()) {
        row.scale_mut(*scale);
    }
    Some(solution)
}
