use nalgebra::{Matrix3, Rotation3, Vector3};

/// Sweeps of the Jacobi iteration; it converges quadratically and needs 3 to 6.
const MAX_SWEEPS: usize = 30;

/// Columns count as orthogonal when their cosine is below this.
const ORTHOGONAL: f64 = 1e-16;

/// A matrix with an entry that is infinite or not a number.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("the 3x3 matrix has an entry that is not finite: {0:?}")]
pub struct NotFinite(pub Matrix3<f64>);

/// `U S V^T` with rotations `U`, `V` and `s1 >= s2 >= |s3|` (definition 2.1).
///
/// Unlike the ordinary decomposition, both factors lie in SO(3) and `s3` carries the sign of the
/// determinant. Where singular values repeat, `U` and `V` are one of many choices; `U S V^T` is
/// the same for all of them.
///
/// ```
/// # use mfg_vio::so3::proper_svd;
/// # use nalgebra::{Matrix3, Vector3};
/// let mirror = Matrix3::from_diagonal(&Vector3::new(1.0, 2.0, -3.0));
/// let svd = proper_svd(&mirror)?;
/// assert_eq!(svd.s, Vector3::new(3.0, 2.0, -1.0));
/// # Ok::<(), mfg_vio::so3::NotFinite>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProperSvd {
    pub u: Rotation3<f64>,
    pub s: Vector3<f64>,
    pub v: Rotation3<f64>,
}

impl ProperSvd {
    /// `U S V^T`.
    pub fn matrix(&self) -> Matrix3<f64> {
        self.u.matrix() * Matrix3::from_diagonal(&self.s) * self.v.matrix().transpose()
    }

    /// `U V^T`, the rotation closest to [`matrix`](Self::matrix) in the Frobenius norm.
    pub fn rotation(&self) -> Rotation3<f64> {
        self.u * self.v.inverse()
    }
}

/// The proper singular value decomposition of `m` (2.17, 2.18), by one-sided Jacobi rotations.
///
/// Any finite matrix is admissible: singular, of negative determinant, with repeated singular
/// values, of any scale. `U` and `V` are orthogonal to rounding and the result depends on `m`
/// alone.
pub fn proper_svd(m: &Matrix3<f64>) -> Result<ProperSvd, NotFinite> {
    let scale = m.amax();
    if !m.iter().all(|x| x.is_finite()) {
        return Err(NotFinite(*m));
    }
    if scale == 0.0 {
        let identity = Rotation3::identity();
        return Ok(ProperSvd { u: identity, s: Vector3::zeros(), v: identity });
    }
    let (columns, v) = orthogonalize_columns(m / scale);
    let (columns, v) = sort_columns(columns, v);
    let (u, s) = frame_of_columns(&columns);
    Ok(ProperSvd {
        u: Rotation3::from_matrix_unchecked(u),
        s: s * scale,
        v: Rotation3::from_matrix_unchecked(v),
    })
}

/// The rotation closest to `m` in the Frobenius norm: the proper polar factor `U V^T`.
///
/// Unique unless `s2 + s3 = 0`; then one of the closest rotations.
pub fn project_to_so3(m: &Matrix3<f64>) -> Result<Rotation3<f64>, NotFinite> {
    proper_svd(m).map(|svd| svd.rotation())
}

/// `(a V, V)` with a rotation `V` that makes the columns of `a V` orthogonal.
fn orthogonalize_columns(mut a: Matrix3<f64>) -> (Matrix3<f64>, Matrix3<f64>) {
    let mut v = Matrix3::identity();
    for _ in 0..MAX_SWEEPS {
        let mut converged = true;
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if let Some((cosine, sine)) = jacobi_rotation(&a, p, q) {
                rotate_columns(&mut a, p, q, cosine, sine);
                rotate_columns(&mut v, p, q, cosine, sine);
                converged = false;
            }
        }
        if converged {
            break;
        }
    }
    (a, v)
}

/// Cosine and sine that make columns `p` and `q` orthogonal; `None` if they are.
fn jacobi_rotation(a: &Matrix3<f64>, p: usize, q: usize) -> Option<(f64, f64)> {
    let (first, second) = (a.column(p), a.column(q));
    let product = first.dot(&second);
    let (alpha, beta) = (first.norm_squared(), second.norm_squared());
    if product.abs() <= ORTHOGONAL * (alpha * beta).sqrt() {
        return None;
    }
    let zeta = (beta - alpha) / (2.0 * product);
    let tangent = zeta.signum() / (zeta.abs() + (1.0 + zeta * zeta).sqrt());
    let cosine = 1.0 / (1.0 + tangent * tangent).sqrt();
    (tangent != 0.0).then_some((cosine, cosine * tangent))
}

pub(super) fn rotate_columns(m: &mut Matrix3<f64>, p: usize, q: usize, cosine: f64, sine: f64) {
    for row in 0..3 {
        let (x, y) = (m[(row, p)], m[(row, q)]);
        m[(row, p)] = cosine * x - sine * y;
        m[(row, q)] = sine * x + cosine * y;
    }
}

/// Columns in descending order of length, by exchanges that negate one column and so keep the
/// determinants.
fn sort_columns(mut columns: Matrix3<f64>, mut v: Matrix3<f64>) -> (Matrix3<f64>, Matrix3<f64>) {
    for (p, q) in [(0, 1), (1, 2), (0, 1)] {
        if columns.column(p).norm_squared() < columns.column(q).norm_squared() {
            for m in [&mut columns, &mut v] {
                m.swap_columns(p, q);
                m.column_mut(q).neg_mut();
            }
        }
    }
    (columns, v)
}

/// The right-handed frame of orthogonal columns and their signed lengths in it.
fn frame_of_columns(columns: &Matrix3<f64>) -> (Matrix3<f64>, Vector3<f64>) {
    let [first, second, third] = [0, 1, 2].map(|i| columns.column(i).into_owned());
    let x = first.normalize();
    let y = unit_orthogonal_to(&x, &second);
    let z = x.cross(&y);
    let s1 = first.norm();
    let s2 = second.dot(&y).clamp(0.0, s1);
    let s3 = third.dot(&z).clamp(-s2, s2);
    (Matrix3::from_columns(&[x, y, z]), Vector3::new(s1, s2, s3))
}

/// The direction of `v` orthogonal to the unit vector `x`; any such where `v` has none.
fn unit_orthogonal_to(x: &Vector3<f64>, v: &Vector3<f64>) -> Vector3<f64> {
    // Where rounding has left `v` along `x`, its orthogonal part is noise that a second
    // projection may find to be parallel again; an axis far from `x` has no such trouble.
    let reject = |v: Vector3<f64>| v - x * x.dot(&v);
    let rejected = reject(*v);
    let direction = if rejected.norm() > 0.5 * v.norm() && v.norm() > f64::MIN_POSITIVE.sqrt() {
        rejected / rejected.norm()
    } else {
        reject(Vector3::ith(x.iamin(), 1.0)).normalize()
    };
    reject(direction).normalize()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::so3::exp;

    fn check(m: &Matrix3<f64>) {
        let ProperSvd { u, s, v } = proper_svd(m).unwrap();
        for r in [u, v] {
            let r = r.matrix();
            assert!((r.transpose() * r - Matrix3::identity()).amax() < 3e-15, "{m}: {r}");
            assert!((r.determinant() - 1.0).abs() < 3e-15, "{m}: {r}");
        }
        assert!(s[0] >= s[1] && s[1] >= s[2].abs(), "{m}: {s}");
        let back = ProperSvd { u, s, v }.matrix();
        assert!((back - m).amax() <= 4e-15 * m.amax(), "{m}: {back}");
    }

    fn rotation() -> impl Strategy<Value = Rotation3<f64>> {
        prop::array::uniform3(-3.0..3.0).prop_map(|v| exp(&Vector3::from(v)))
    }

    proptest! {
        #[test]
        fn any_matrix_is_decomposed(entries in prop::array::uniform9(-1.0..1.0), e in -150.0..150.0f64) {
            check(&(Matrix3::from_iterator(entries) * 10f64.powf(e)));
        }

        #[test]
        fn singular_values_are_recovered_over_many_scales(
            u in rotation(), v in rotation(),
            exponents in prop::array::uniform3(-20.0..20.0f64), negative: bool,
        ) {
            let mut s = exponents.map(|e| 10f64.powf(e));
            s.sort_by(|a, b| b.total_cmp(a));
            s[2] *= if negative { -1.0 } else { 1.0 };
            let m = ProperSvd { u, s: Vector3::from(s), v }.matrix();
            check(&m);
            let found = proper_svd(&m).unwrap().s;
            for i in 0..3 {
                prop_assert!((found[i] - s[i]).abs() <= 4e-15 * s[0], "{found} {s:?}");
            }
        }

        #[test]
        fn projection_returns_the_rotation_of_a_stretched_one(r in rotation(), u in rotation(), s in prop::array::uniform3(0.1..5.0f64)) {
            let stretch = u.matrix() * Matrix3::from_diagonal(&Vector3::from(s)) * u.matrix().transpose();
            let found = project_to_so3(&(r.matrix() * stretch)).unwrap();
            prop_assert!((found.matrix() - r.matrix()).norm() < 1e-13);
        }
    }

    #[test]
    fn degenerate_matrices_are_decomposed() {
        let r = *exp(&Vector3::new(0.4, -0.9, 2.1)).matrix();
        let diagonals = [
            [0.0, 0.0, 0.0],
            [1.0, 0.0, 0.0],
            [0.0, 0.0, -2.0],
            [1.0, 1.0, 0.0],
            [1.0, 1.0, 1.0],
            [-1.0, -1.0, -1.0],
            [1.0, 1.0, -1.0],
            [1.0, 1e-17, 1e-17],
            [1.0, 1e-170, -1e-170],
            [1e300, 1e300, 1e-300],
            [5e-324, 0.0, 0.0],
        ];
        for d in diagonals {
            let d = Matrix3::from_diagonal(&Vector3::from(d));
            for m in [d, r * d, d * r, r * d * r] {
                check(&m);
            }
        }
        check(&Matrix3::repeat(1.0));
    }

    #[test]
    fn a_reflection_has_a_negative_third_value() {
        let svd = proper_svd(&-Matrix3::identity()).unwrap();
        assert_eq!(svd.s, Vector3::new(1.0, 1.0, -1.0));
    }

    #[test]
    fn matrices_that_are_not_finite_are_refused() {
        for bad in [f64::NAN, f64::INFINITY] {
            let m = Matrix3::repeat(bad);
            assert!(proper_svd(&m).is_err());
            assert!(project_to_so3(&m).is_err());
        }
    }
}
