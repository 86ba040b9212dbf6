//! The paper's own route from point pairs to a pose (W22 tables 5.6, 5.7, 5.12).

use nalgebra::{DMatrix, DVector, Matrix3, Rotation3, Vector3};

use super::posterior::{centroid, density};
use super::{AlignmentError, PointPair, PosePosterior};
use crate::distribution::VonMisesFisher;
use crate::distribution::matrix_fisher::MatrixFisher;
use crate::distribution::progressive::{ProgressiveConfig, progressive_update};
use crate::distribution::rotation_quadratic::{RotationQuadratic, RotationQuadraticError};

/// As [`align`](super::align), but with the attitude of table 5.6: the centred points as
/// directions with projected normal noise give a proposal (5.41), which is reweighted
/// progressively at seven sigma points. Kept to compare with the paper; it is slower and less
/// accurate.
///
/// In (5.40) the length of the *measured* vector must stand, `gamma = |r'_i| / (sqrt(d_i) sigma)`.
/// With the printed `|r_i|` the position errors of the paper's tables are missed by far more than
/// their Monte Carlo errors, with `|r'_i|` they are met.
pub fn align_progressively(
    pairs: &[PointPair],
    config: &ProgressiveConfig,
) -> Result<PosePosterior, AlignmentError> {
    let origin = centroid(pairs).ok_or(AlignmentError::NoPoints)?;
    let mut density = density(pairs, &Rotation3::identity(), &origin)?;
    let proposal = MatrixFisher::new(&proposal(pairs)).map_err(RotationQuadraticError::from)?;
    let proposed = RotationQuadratic::matrix_fisher(&proposal.parameter());
    let target = density.attitude;
    let ratio = |r: &Rotation3<f64>| target.log_density(r) - proposed.log_density(r);
    let attitude = progressive_update(&proposal, ratio, config)?;
    density.attitude = RotationQuadratic::matrix_fisher(&attitude.parameter());
    PosePosterior::new(origin, density)
}

/// `F` of (5.41): the sum over `N - 1` directions of their concentrations.
fn proposal(pairs: &[PointPair]) -> Matrix3<f64> {
    let n = pairs.len();
    let share = 1.0 / n as f64;
    let world: Vector3<f64> = pairs.iter().map(|pair| pair.in_world * share).sum();
    let body: Vector3<f64> = pairs.iter().map(|pair| pair.in_body * share).sum();
    let variances: Vec<f64> = pairs.iter().map(isotropic_variance).collect();
    let centred = |i: usize| (pairs[i].in_world - world, pairs[i].in_body - body);
    let count = n.saturating_sub(1);
    let equal = variances.iter().all(|v| (v - variances[0]).abs() <= 1e-12 * v);
    let mut f = Matrix3::zeros();
    if count == 0 {
        return f;
    }
    let mut add = |r: Vector3<f64>, measured: Vector3<f64>, variance: f64| {
        // A direction without length or noise of infinite size says nothing.
        let Ok(seen) = VonMisesFisher::from_projected_normal(measured, variance) else { return };
        if let Some(direction) = r.try_normalize(0.0) {
            f += direction * seen.mean().transpose() * seen.concentration();
        }
    };
    if equal {
        // Theorem 5.4: T T^T = I - 1 1^T / N; its eigenvectors decorrelate the centred points.
        let square = DMatrix::from_fn(count, count, |i, j| f64::from(i == j) - share);
        let eigen = square.symmetric_eigen();
        for (k, d) in eigen.eigenvalues.iter().enumerate() {
            let axis: DVector<f64> = eigen.eigenvectors.column(k).into_owned();
            let sum = |of: &dyn Fn(usize) -> Vector3<f64>| {
                (0..count).map(|i| of(i) * axis[i]).sum::<Vector3<f64>>()
            };
            add(sum(&|i| centred(i).0), sum(&|i| centred(i).1), d * variances[0]);
        }
    } else {
        // Diagonal blocks of T A T^T.
        let total: f64 = variances.iter().sum();
        for (i, variance) in variances.iter().enumerate().take(count) {
            let (q, measured) = centred(i);
            let own = variance * (1.0 - 2.0 * share) + total * share * share;
            add(q, measured, own);
        }
    }
    f
}

/// Mean variance of a coordinate of the residual.
fn isotropic_variance(pair: &PointPair) -> f64 {
    (pair.body_covariance.trace() + pair.world_covariance.trace()) / 3.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_single_point_leaves_the_attitude_uniform() {
        let pair = PointPair {
            in_body: Vector3::x(),
            body_covariance: Matrix3::identity() * 0.01,
            in_world: Vector3::y(),
            world_covariance: Matrix3::zeros(),
        };
        let found = align_progressively(&[pair], &ProgressiveConfig::default()).unwrap();
        assert!(found.pose.attitude().parameter().norm() < 1e-9);
        let nothing = align_progressively(&[], &ProgressiveConfig::default());
        assert_eq!(nothing.err(), Some(AlignmentError::NoPoints));
    }
}
