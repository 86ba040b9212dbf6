//! Unit quaternions as 4-vectors, scalar first, and their action on R^4.

use nalgebra::{Matrix3, Matrix4, Rotation3, Vector4};

/// The homomorphism from unit quaternions `(q0, q1, q2, q3)`, scalar first, to SO(3) (2.33).
///
/// `q` and `-q` give the same rotation. A quaternion that is not of unit length is not
/// normalized.
pub fn rotation_from_quaternion(q: &Vector4<f64>) -> Rotation3<f64> {
    let (w, x, y, z) = (q[0], q[1], q[2], q[3]);
    Rotation3::from_matrix_unchecked(Matrix3::new(
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    ))
}

/// The unit quaternion of `r`, scalar first, with a scalar part that is not negative.
///
/// Divides by the largest of the four components, so that no rotation is ill-conditioned.
pub fn quaternion_from_rotation(r: &Rotation3<f64>) -> Vector4<f64> {
    let m = r.matrix();
    let diagonal = [m.m11, m.m22, m.m33];
    let trace: f64 = diagonal.iter().sum();
    let largest = (0..3).fold(0, |best, i| if diagonal[i] > diagonal[best] { i } else { best });
    let q = if trace >= diagonal[largest] {
        Vector4::new(1.0 + trace, m.m32 - m.m23, m.m13 - m.m31, m.m21 - m.m12)
    } else {
        let (i, j, k) = (largest, (largest + 1) % 3, (largest + 2) % 3);
        let mut q = Vector4::zeros();
        q[0] = m[(k, j)] - m[(j, k)];
        q[i + 1] = 1.0 + m[(i, i)] - m[(j, j)] - m[(k, k)];
        q[j + 1] = m[(i, j)] + m[(j, i)];
        q[k + 1] = m[(i, k)] + m[(k, i)];
        q
    };
    q * (q[0].signum() / q.norm())
}

/// The quaternion product `p (x) q` (2.28).
pub fn quaternion_product(p: &Vector4<f64>, q: &Vector4<f64>) -> Vector4<f64> {
    left_isoclinic(p) * q
}

/// `[p]_L`, with `p (x) q = [p]_L q` (2.30).
pub fn left_isoclinic(p: &Vector4<f64>) -> Matrix4<f64> {
    let (a, b, c, d) = (p[0], p[1], p[2], p[3]);
    Matrix4::new(a, -b, -c, -d, b, a, -d, c, c, d, a, -b, d, -c, b, a)
}

/// `[q]_R`, with `p (x) q = [q]_R p` (2.31).
pub fn right_isoclinic(q: &Vector4<f64>) -> Matrix4<f64> {
    let (a, b, c, d) = (q[0], q[1], q[2], q[3]);
    Matrix4::new(a, -b, -c, -d, b, a, d, -c, c, -d, a, b, d, c, -b, a)
}

/// A matrix whose distance from the nearest isoclinic product exceeds this is not a rotation.
const ISOCLINIC_TOLERANCE: f64 = 1e-6;

/// Unit quaternions `(p, q)` with `m = [p]_L [q]_R`, unique up to their common sign (2.32).
///
/// `None` if `m` is not a rotation of R^4 to within 1e-6, such as a reflection.
pub fn isoclinic_decomposition(m: &Matrix4<f64>) -> Option<(Vector4<f64>, Vector4<f64>)> {
    // The sixteen products [e_i]_L [e_j]_R are orthogonal of squared norm 4, so the inner
    // products with `m` give the outer product p q^T.
    let outer = Matrix4::from_fn(|i, j| {
        let (p, q) = (Vector4::ith(i, 1.0), Vector4::ith(j, 1.0));
        0.25 * (left_isoclinic(&p) * right_isoclinic(&q)).dot(m)
    });
    let largest = outer.iamax_full().0;
    let q = outer.row(largest).transpose().try_normalize(ISOCLINIC_TOLERANCE)?;
    let p = (outer * q).try_normalize(ISOCLINIC_TOLERANCE)?;
    let residual = (outer - p * q.transpose()).norm();
    (residual < ISOCLINIC_TOLERANCE).then_some((p, q))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn quaternion() -> impl Strategy<Value = Vector4<f64>> {
        prop::array::uniform4(-1.0..1.0f64)
            .prop_map(Vector4::from)
            .prop_filter("not zero", |q| q.norm() > 0.1)
            .prop_map(|q| q.normalize())
    }

    proptest! {
        #[test]
        fn products_map_to_products(p in quaternion(), q in quaternion()) {
            let product = rotation_from_quaternion(&quaternion_product(&p, &q));
            let rotations = rotation_from_quaternion(&p) * rotation_from_quaternion(&q);
            prop_assert!((product.matrix() - rotations.matrix()).norm() < 1e-14);
            prop_assert!((right_isoclinic(&q) * p - quaternion_product(&p, &q)).norm() < 1e-15);
        }

        /// (2.34)
        #[test]
        fn trace_measures_the_angle_between_quaternions(p in quaternion(), q in quaternion()) {
            let (a, b) = (rotation_from_quaternion(&p), rotation_from_quaternion(&q));
            let trace = (a.matrix() * b.matrix().transpose()).trace();
            prop_assert!((trace + 1.0 - 4.0 * p.dot(&q).powi(2)).abs() < 1e-14);
        }

        #[test]
        fn a_quaternion_survives_the_matrix(q in quaternion()) {
            let back = quaternion_from_rotation(&rotation_from_quaternion(&q));
            prop_assert!(back[0] >= 0.0);
            prop_assert!((back - q * q[0].signum()).norm() < 1e-15 * 4.0);
        }

        #[test]
        fn isoclinic_factors_are_found(p in quaternion(), q in quaternion()) {
            let m = left_isoclinic(&p) * right_isoclinic(&q);
            let (a, b) = isoclinic_decomposition(&m).unwrap();
            prop_assert!((left_isoclinic(&a) * right_isoclinic(&b) - m).norm() < 1e-14);
            let sign = a.dot(&p).signum();
            prop_assert!((a * sign - p).norm() < 1e-14 && (b * sign - q).norm() < 1e-14);
        }
    }

    #[test]
    fn what_is_no_rotation_has_no_isoclinic_factors() {
        let mut reflection = Matrix4::identity();
        reflection[(3, 3)] = -1.0;
        for m in [reflection, Matrix4::zeros(), Matrix4::repeat(f64::NAN)] {
            assert_eq!(isoclinic_decomposition(&m), None);
        }
    }
}
