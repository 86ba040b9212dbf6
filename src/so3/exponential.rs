use nalgebra::{Matrix3, Rotation3, Vector3};

use super::quaternion::quaternion_from_rotation;

/// Below this squared angle the coefficients come from their Taylor series: closed forms would
/// lose more than a digit to cancellation.
const SERIES_SQUARED_ANGLE: f64 = 0.25;

/// Sine of half an angle below which the angle is proportional to it to rounding.
const SMALL_SINE: f64 = 1e-9;

/// The skew-symmetric matrix of `v`: `hat(v) w = v x w` (2.4).
pub fn hat(v: &Vector3<f64>) -> Matrix3<f64> {
    v.cross_matrix()
}

/// The vector of the skew-symmetric part of `a`: the inverse of [`hat`] on skew matrices (2.4).
pub fn vee(a: &Matrix3<f64>) -> Vector3<f64> {
    0.5 * Vector3::new(a.m32 - a.m23, a.m13 - a.m31, a.m21 - a.m12)
}

/// Rotation by the angle `|v|` (rad) about `v`: Rodrigues' formula (2.6).
///
/// ```
/// # use mfg_vio::so3;
/// # use nalgebra::Vector3;
/// let v = Vector3::new(0.3, -1.0, 2.0);
/// assert!((so3::log(&so3::exp(&v)) - v).norm() < 1e-15);
/// ```
pub fn exp(v: &Vector3<f64>) -> Rotation3<f64> {
    let squared = v.norm_squared();
    let skew = hat(v);
    let matrix = Matrix3::identity() + skew * sinc(squared) + skew * skew * versine(squared);
    Rotation3::from_matrix_unchecked(matrix)
}

/// Rotation vector (rad) of `r`, of length at most pi.
///
/// Accurate to rounding from the identity to the half turn; at exactly pi one of the two
/// opposite vectors is returned.
pub fn log(r: &Rotation3<f64>) -> Vector3<f64> {
    let q = quaternion_from_rotation(r);
    let imaginary = Vector3::new(q[1], q[2], q[3]);
    let sine = imaginary.norm();
    if sine < SMALL_SINE {
        // The arc equals its tangent to rounding, and squares may have underflowed.
        return imaginary * (2.0 / q[0]);
    }
    imaginary * (2.0 * sine.atan2(q[0]) / sine)
}

/// Angle (rad, at most pi) of the turn between two rotations.
///
/// Accurate to rounding for equal rotations too, where the arc cosine of the trace (that of
/// `Rotation3::angle_to`) is off by 1e-8 or undefined.
pub fn angle_between(a: &Rotation3<f64>, b: &Rotation3<f64>) -> f64 {
    log(&(a.inverse() * b)).norm()
}

/// `J_l(v)`: `exp(v + d) = exp(J_l(v) d) exp(v)` to first order in `d`.
pub fn left_jacobian(v: &Vector3<f64>) -> Matrix3<f64> {
    let squared = v.norm_squared();
    let skew = hat(v);
    Matrix3::identity() + skew * versine(squared) + skew * skew * angle_excess(squared)
}

/// `J_r(v) = J_l(-v)`: `exp(v + d) = exp(v) exp(J_r(v) d)` to first order in `d`.
pub fn right_jacobian(v: &Vector3<f64>) -> Matrix3<f64> {
    left_jacobian(&-v)
}

/// Inverse of [`left_jacobian`] for `|v| < 2 pi`, where it exists.
pub fn left_jacobian_inverse(v: &Vector3<f64>) -> Matrix3<f64> {
    let skew = hat(v);
    Matrix3::identity() - skew * 0.5 + skew * skew * half_cotangent(v.norm_squared())
}

/// Inverse of [`right_jacobian`] for `|v| < 2 pi`, where it exists.
pub fn right_jacobian_inverse(v: &Vector3<f64>) -> Matrix3<f64> {
    left_jacobian_inverse(&-v)
}

/// `sin(t)/t` of the squared angle `t^2`.
fn sinc(squared: f64) -> f64 {
    if squared < SERIES_SQUARED_ANGLE {
        alternating_series(squared, 1.0, 2)
    } else {
        let angle = squared.sqrt();
        angle.sin() / angle
    }
}

/// `(1 - cos t)/t^2` of the squared angle.
fn versine(squared: f64) -> f64 {
    0.5 * sinc(0.25 * squared).powi(2)
}

/// `(t - sin t)/t^3` of the squared angle.
fn angle_excess(squared: f64) -> f64 {
    if squared < SERIES_SQUARED_ANGLE {
        alternating_series(squared, 1.0 / 6.0, 4)
    } else {
        let angle = squared.sqrt();
        (angle - angle.sin()) / (squared * angle)
    }
}

/// `(1 - (t/2) cot(t/2))/t^2` of the squared angle.
fn half_cotangent(squared: f64) -> f64 {
    // Bernoulli numbers |B_2k|/(2k)!, k = 1..8.
    const COEFFICIENTS: [f64; 8] = [
        1.0 / 12.0,
        1.0 / 720.0,
        1.0 / 30_240.0,
        1.0 / 1_209_600.0,
        1.0 / 47_900_160.0,
        691.0 / 1_307_674_368_000.0,
        1.0 / 74_724_249_600.0,
        3_617.0 / 10_670_622_842_880_000.0,
    ];
    if squared < SERIES_SQUARED_ANGLE {
        COEFFICIENTS.iter().rev().fold(0.0, |sum, c| sum * squared + c)
    } else {
        let half = 0.5 * squared.sqrt();
        (1.0 - half / half.tan()) / squared
    }
}

/// `first - first x/(k (k+1)) + ...`: the tail of a sine series that starts at `first`, each
/// term dividing by the next two integers from `k`.
fn alternating_series(x: f64, first: f64, k: u32) -> f64 {
    let (mut term, mut sum) = (first, first);
    for step in 0..8 {
        let n = f64::from(k + 2 * step);
        term *= -x / (n * (n + 1.0));
        sum += term;
    }
    sum
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use proptest::prelude::*;
    use std::f64::consts::PI;

    use super::*;

    fn vector(bound: f64) -> impl Strategy<Value = Vector3<f64>> {
        prop::array::uniform3(-bound..bound).prop_map(Vector3::from)
    }

    fn direction() -> impl Strategy<Value = Vector3<f64>> {
        vector(1.0).prop_filter("not zero", |v| v.norm() > 1e-3).prop_map(|v| v.normalize())
    }

    proptest! {
        #[test]
        fn log_inverts_exp_at_every_scale(axis in direction(), exponent in -300.0..0.0f64) {
            let v = axis * (PI * 10f64.powf(exponent));
            prop_assert!((log(&exp(&v)) - v).amax() <= 1e-15 * v.amax());
        }

        #[test]
        fn log_keeps_its_digits_near_the_half_turn(axis in direction(), exponent in -14.0..-1.0f64) {
            let v = axis * (PI - 10f64.powf(exponent));
            prop_assert!((log(&exp(&v)) - v).norm() < 4e-15);
        }

        #[test]
        fn angles_between_near_rotations_are_exact(
            v in vector(3.0), axis in direction(), exponent in -12.0..0.0f64,
        ) {
            let (r, angle) = (exp(&v), 10f64.powf(exponent));
            let apart = angle_between(&r, &(r * exp(&(axis * angle))));
            prop_assert!((apart - angle).abs() < 1e-15, "{} {}", apart, angle);
            prop_assert!(angle_between(&r, &r) < 1e-15);
        }

        #[test]
        fn exp_is_a_rotation(v in vector(20.0)) {
            let r = exp(&v).into_inner();
            prop_assert!((r.transpose() * r - Matrix3::identity()).norm() < 2e-14);
            prop_assert!((r.determinant() - 1.0).abs() < 2e-14);
        }

        #[test]
        fn jacobians_invert_each_other(axis in direction(), angle in 1e-9..6.0f64) {
            let v = axis * angle;
            let left = left_jacobian(&v) * left_jacobian_inverse(&v) - Matrix3::identity();
            let right = right_jacobian(&v) * right_jacobian_inverse(&v) - Matrix3::identity();
            prop_assert!(left.norm() < 1e-13 && right.norm() < 1e-13);
            prop_assert!((left_jacobian(&v) - exp(&v).matrix() * right_jacobian(&v)).norm() < 1e-14);
        }

        #[test]
        fn jacobians_are_derivatives_of_exp(v in vector(3.0), d in direction()) {
            let h = 1e-5;
            let plus = exp(&(v + d * h));
            let minus = exp(&(v - d * h));
            let left = log(&(plus * minus.inverse())) / (2.0 * h);
            let right = log(&(minus.inverse() * plus)) / (2.0 * h);
            prop_assert!((left - left_jacobian(&v) * d).norm() < 1e-8);
            prop_assert!((right - right_jacobian(&v) * d).norm() < 1e-8);
        }

        #[test]
        fn vee_inverts_hat(v in vector(10.0)) {
            prop_assert_eq!(vee(&hat(&v)), v);
        }
    }

    #[test]
    fn a_half_turn_about_each_axis_is_recognised() {
        for axis in [Vector3::x(), Vector3::y(), Vector3::z()] {
            let matrix = 2.0 * axis * axis.transpose() - Matrix3::identity();
            let v = log(&Rotation3::from_matrix_unchecked(matrix));
            assert_relative_eq!(v.abs(), axis * PI, epsilon = 1e-15);
        }
    }

    #[test]
    fn series_and_closed_forms_meet() {
        let below = SERIES_SQUARED_ANGLE * (1.0 - 1e-15);
        for f in [sinc, versine, angle_excess, half_cotangent] {
            assert_relative_eq!(f(below), f(SERIES_SQUARED_ANGLE), max_relative = 3e-14);
        }
    }
}
