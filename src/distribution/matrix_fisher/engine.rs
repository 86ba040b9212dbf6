//! One pass for the normalizing constant and all even moments of the unit quaternion.
//!
//! With `a_1 = s2 + s3`, `a_2 = s1 + s3`, `a_3 = s1 + s2` the density of the quaternion `x` of
//! `Q ~ M(S)` is proportional to `exp(-2 (a_1 x1^2 + a_2 x2^2 + a_3 x3^2))`. Three routines share
//! the plane of concentrations; none divides by differences of singular values, so repeated and
//! opposite ones are not special.

use super::sums::{EvenMoments, Sums};
use super::{concentrated, near_uniform, quadrature};

/// The pass: with the cubic moments if `THIRD`, else only up to the second order in `x_i^2`.
pub(super) fn pass<const THIRD: bool>(sums: &Sums) -> EvenMoments {
    if sums.a[0] >= concentrated::MIN_SUM {
        concentrated::pass::<THIRD>(sums)
    } else if sums.a[2] <= near_uniform::MAX_SUM {
        near_uniform::pass(sums)
    } else {
        quadrature::pass::<THIRD>(sums)
    }
}

/// `E[eta_i^2]` of the rotation vector `eta = log Q`.
pub(super) fn rotation_vector_variances(sums: &Sums) -> [f64; 3] {
    if sums.a[0] >= concentrated::MIN_SUM {
        concentrated::rotation_vector_variances(sums)
    } else {
        quadrature::rotation_vector_variances(sums)
    }
}
