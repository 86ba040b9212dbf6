//! What is drawn and plotted of a covariance.

use nalgebra::{Matrix3, Rotation3, SymmetricEigen, UnitQuaternion, Vector3};

use crate::inertial::NavCovariance;

/// The block of three that starts at `block`.
pub(super) fn diagonal_block(covariance: &NavCovariance, block: usize) -> Matrix3<f64> {
    covariance.fixed_view::<3, 3>(block, block).into_owned()
}

/// Standard deviations along the axes of the block of three that starts at `block`.
pub(super) fn standard_deviations(covariance: &NavCovariance, block: usize) -> Vector3<f64> {
    Vector3::from_fn(|axis, _| covariance[(block + axis, block + axis)].max(0.0).sqrt())
}

/// Standard deviations along the principal axes of a covariance, and the rotation whose columns
/// are these axes; `None` if it is not finite.
pub(super) fn principal_axes(
    covariance: &Matrix3<f64>,
) -> Option<(Vector3<f64>, UnitQuaternion<f64>)> {
    const MAX_ITERATIONS: usize = 100;
    // The iteration need not end on values that are not finite.
    if !covariance.iter().all(|value| value.is_finite()) {
        return None;
    }
    let eigen = SymmetricEigen::try_new(*covariance, f64::EPSILON, MAX_ITERATIONS)?;
    let mut axes = eigen.eigenvectors;
    if axes.determinant() < 0.0 {
        axes.set_column(2, &-axes.column(2).into_owned());
    }
    let rotation = Rotation3::from_matrix_unchecked(axes);
    let deviations = eigen.eigenvalues.map(|variance| variance.max(0.0).sqrt());
    Some((deviations, UnitQuaternion::from_rotation_matrix(&rotation)))
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    #[test]
    fn principal_axes_rebuild_the_covariance() {
        let root = Matrix3::new(0.3, 0.0, 0.0, 0.1, 0.2, 0.0, -0.4, 0.05, 0.01);
        let expected = root * root.transpose();
        let (deviations, rotation) = principal_axes(&expected).unwrap();
        let r = rotation.to_rotation_matrix();
        let variances = Matrix3::from_diagonal(&deviations.component_mul(&deviations));
        assert_relative_eq!(
            r.matrix() * variances * r.matrix().transpose(),
            expected,
            epsilon = 1e-12
        );
    }

    #[test]
    fn a_covariance_that_is_not_finite_has_no_axes() {
        assert!(principal_axes(&Matrix3::from_element(f64::NAN)).is_none());
        assert!(principal_axes(&Matrix3::identity()).is_some());
    }
}
