use nalgebra::{Matrix3, Rotation3, Vector3};

use super::proper_svd::rotate_columns;

/// Sweeps of the Jacobi iteration; it converges quadratically and needs 2 to 5.
const MAX_SWEEPS: usize = 30;
/// Square of the correlation below which two axes count as uncorrelated.
const UNCORRELATED: f64 = 1e-32;

/// `V` and `s1 >= s2 >= s3` with `m = V diag(s) V^T` of a symmetric matrix, by Jacobi rotations:
/// small eigenvalues keep their digits where the matrix is scaled, and entries that are not finite
/// make a result that is not finite.
///
/// ```
/// # use mfg_vio::so3::principal_axes;
/// # use nalgebra::{Matrix3, Vector3};
/// let m = Matrix3::new(2.0, 1.0, 0.0, 1.0, 2.0, 0.0, 0.0, 0.0, 5.0);
/// let (v, s) = principal_axes(&m);
/// assert!((s - Vector3::new(5.0, 3.0, 1.0)).norm() < 1e-15);
/// assert!((v.matrix().transpose() * m * v.matrix() - Matrix3::from_diagonal(&s)).norm() < 1e-15);
/// ```
pub fn principal_axes(m: &Matrix3<f64>) -> (Rotation3<f64>, Vector3<f64>) {
    let (mut m, mut v) = (*m, Matrix3::identity());
    for _ in 0..MAX_SWEEPS {
        let turns = [(0, 1, 2), (0, 2, 1), (1, 2, 0)].map(|axes| decorrelate(&mut m, &mut v, axes));
        if turns == [false; 3] {
            break;
        }
    }
    let mut s = m.diagonal();
    for (p, q) in [(0, 1), (1, 2), (0, 1)] {
        if s[p] < s[q] {
            s.swap_rows(p, q);
            // Exchanged and one of them negated, axes stay right-handed.
            v.swap_columns(p, q);
            v.column_mut(q).neg_mut();
        }
    }
    (Rotation3::from_matrix_unchecked(v), s)
}

/// Turns axes `p` and `q` so that `m[(p, q)]` vanishes; whether they had to be turned.
fn decorrelate(
    m: &mut Matrix3<f64>,
    v: &mut Matrix3<f64>,
    (p, q, other): (usize, usize, usize),
) -> bool {
    let (first, second, product) = (m[(p, p)], m[(q, q)], m[(p, q)]);
    if product == 0.0 || product * product <= UNCORRELATED * (first * second).abs() {
        return false;
    }
    let zeta = (second - first) / (2.0 * product);
    let root = (1.0 + zeta * zeta).sqrt();
    let tangent = zeta.signum() / (zeta.abs() + root);
    if tangent == 0.0 {
        return false;
    }
    // `1/sqrt(1 + tangent^2)`, without waiting for the tangent.
    let cosine = ((root + zeta.abs()) / (2.0 * root)).sqrt();
    let sine = cosine * tangent;
    (m[(p, p)], m[(q, q)]) = (first - tangent * product, second + tangent * product);
    (m[(p, q)], m[(q, p)]) = (0.0, 0.0);
    let (x, y) = (m[(other, p)], m[(other, q)]);
    let (x, y) = (cosine * x - sine * y, sine * x + cosine * y);
    (m[(other, p)], m[(p, other)]) = (x, x);
    (m[(other, q)], m[(q, other)]) = (y, y);
    rotate_columns(v, p, q, cosine, sine);
    true
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::exp;
    use super::*;

    proptest! {
        #[test]
        fn eigenvalues_and_axes_are_recovered(
            axes in prop::array::uniform3(-3.0..3.0f64),
            s in prop::array::uniform3(-1.0..1.0f64),
            tie in prop::bool::ANY,
            exponent in -100.0..100.0f64,
        ) {
            let mut s = s;
            if tie { s[1] = s[0] }
            s.sort_by(|a, b| b.total_cmp(a));
            let s = Vector3::from(s) * 10f64.powf(exponent);
            let v = exp(&Vector3::from(axes));
            let m = v.matrix() * Matrix3::from_diagonal(&s) * v.matrix().transpose();
            let m = 0.5 * (m + m.transpose());
            let (found, values) = principal_axes(&m);
            prop_assert!((values - s).amax() <= 4e-15 * s.amax());
            let defect = found.matrix().transpose() * found.matrix() - Matrix3::identity();
            prop_assert!(defect.amax() < 4e-15 && found.matrix().determinant() > 0.0);
            let again =
                found.matrix() * Matrix3::from_diagonal(&values) * found.matrix().transpose();
            prop_assert!((again - m).amax() <= 8e-15 * s.amax());
        }
    }

    /// A graded matrix, as a belief has that is sharp about one axis only.
    #[test]
    fn small_eigenvalues_keep_their_digits() {
        let scale = Matrix3::from_diagonal(&Vector3::new(1.0, 1e-6, 1e-12));
        let well = Matrix3::new(2.0, 0.5, 0.3, 0.5, 3.0, 0.2, 0.3, 0.2, 1.0);
        let (_, s) = principal_axes(&(scale * well * scale));
        let product = well.determinant() * 1e-36;
        assert!((s.product() / product - 1.0).abs() < 1e-13, "{s}");
        assert!(!principal_axes(&Matrix3::from_element(f64::NAN)).1.iter().all(|x| x.is_finite()));
    }
}
