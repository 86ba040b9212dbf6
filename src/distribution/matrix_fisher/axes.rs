//! Principal axes: canonical choice, and the marginal distribution of each body axis.

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::super::circle::CircleMoments;
use super::MatrixFisher;
use crate::so3::ProperSvd;

/// Singular values closer than this fraction of the largest count as equal.
const REPEATED: f64 = 1e-10;
/// Components below this have no sign.
const NEGLIGIBLE_COMPONENT: f64 = 1e-9;

/// The proper singular value decomposition of the same `F` in which the freedom of the axes
/// (theorems 3.1, C.1) is used up: the first component of each free sign in `V` is positive, and
/// planes of repeated or opposite singular values are spanned by the coordinate axis closest to
/// them; a multiple of an orthogonal matrix has `V = I`.
pub fn canonical_axes(svd: &ProperSvd) -> ProperSvd {
    let s = svd.s;
    let equal = |a: f64, b: f64| (a - b).abs() <= REPEATED * s[0];
    let [v1, _, v3] = [0, 1, 2].map(|i| svd.v.matrix().column(i).into_owned());
    let v = if equal(s[0], s[1]) && equal(s[1], s[2].abs()) {
        Matrix3::identity()
    } else if equal(s[0], s[1]) {
        let z = positive(v3);
        let x = closest_axis_orthogonal_to(&z);
        Matrix3::from_columns(&[x, z.cross(&x), z])
    } else if equal(s[1], s[2].abs()) {
        frame_of(&positive(v1))
    } else {
        let (x, z) = (positive(v1), positive(v3));
        Matrix3::from_columns(&[x, z.cross(&x), z])
    };
    let v = Rotation3::from_matrix_unchecked(v);
    ProperSvd { u: left_axes(svd, &v), s, v }
}

/// `U'` with `U' S V'^T = U S V^T`.
fn left_axes(svd: &ProperSvd, v: &Rotation3<f64>) -> Rotation3<f64> {
    let s = svd.s;
    let image = svd.u.matrix() * Matrix3::from_diagonal(&s) * (svd.v.inverse() * v).matrix();
    let column = |i: usize| image.column(i).into_owned();
    let u = if s[0] <= 0.0 {
        Matrix3::identity()
    } else if s[1] <= REPEATED * s[0] {
        frame_of(&column(0).normalize())
    } else {
        let x = column(0).normalize();
        let y = column(1);
        let y = (y - x * x.dot(&y)).normalize();
        Matrix3::from_columns(&[x, y, x.cross(&y)])
    };
    Rotation3::from_matrix_unchecked(u)
}

fn positive(v: Vector3<f64>) -> Vector3<f64> {
    let leading = v.iter().find(|x| x.abs() > NEGLIGIBLE_COMPONENT);
    if leading.is_some_and(|x| *x < 0.0) { -v } else { v }
}

/// The right-handed frame with first axis `x`.
fn frame_of(x: &Vector3<f64>) -> Matrix3<f64> {
    let y = closest_axis_orthogonal_to(x);
    Matrix3::from_columns(&[*x, y, x.cross(&y)])
}

/// The coordinate axis closest to the plane orthogonal to `x`, projected onto it.
fn closest_axis_orthogonal_to(x: &Vector3<f64>) -> Vector3<f64> {
    let axis = Vector3::ith(x.iamin(), 1.0);
    (axis - x * x.dot(&axis)).normalize()
}

impl MatrixFisher {
    /// Logarithm of the marginal density of the body axis `axis` (0, 1, 2), resolved in the
    /// world, at the unit vector `r` and with respect to the uniform distribution on the sphere
    /// (L-UAE proposition 2).
    ///
    /// The sum of square roots in L-UAE (7) must be that of the *proper* singular values of the
    /// 2x2 block, one of which is negative where its determinant is.
    pub fn log_axis_density(&self, axis: usize, r: &Vector3<f64>) -> f64 {
        let f = self.parameter();
        let column = |i: usize| f.column(i % 3).into_owned();
        let (f1, f2, f3) = (column(axis), column(axis + 1), column(axis + 2));
        let y = closest_axis_orthogonal_to(r);
        let z = r.cross(&y);
        // max over SO(2) of tr(A^T Z), the sum of proper singular values of A.
        let concentration = (y.dot(&f2) + z.dot(&f3)).hypot(z.dot(&f2) - y.dot(&f3));
        let scaled_i0 = CircleMoments::new(concentration).scaled_i0;
        // The exponent relative to its maximum over SO(3), tr S.
        let exponent = f1.dot(r) + concentration - self.svd().s.sum();
        exponent + scaled_i0.ln() - self.moments().log_c_scaled()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::so3::{HaarQuadrature, exp};

    /// The first column of a uniform rotation is uniform on the sphere: integrals and moments of
    /// the marginal density against those of the distribution itself.
    #[test]
    fn axis_densities_are_the_marginals() {
        let grid = HaarQuadrature::of_degree(40);
        let (u, v) = (exp(&Vector3::new(0.4, -1.0, 0.7)), exp(&Vector3::new(-2.0, 0.3, 0.1)));
        for s in [[3.0, 2.0, -1.0], [4.0, 4.0, -4.0], [5.0, 0.0, 0.0], [6.0, 3.0, 2.0]] {
            let fisher = MatrixFisher::from_svd(ProperSvd { u, s: Vector3::from(s), v }).unwrap();
            let second = fisher.second_moment();
            for axis in 0..3 {
                let marginal = |f: &dyn Fn(&Vector3<f64>) -> f64| {
                    grid.integrate(|r| {
                        let r = r.matrix().column(0).into_owned();
                        fisher.log_axis_density(axis, &r).exp() * f(&r)
                    })
                };
                assert!((marginal(&|_| 1.0) - 1.0).abs() < 1e-9, "{s:?}");
                for i in 0..3 {
                    let mean = marginal(&|r| r[i]);
                    assert!((mean - fisher.mean()[(i, axis)]).abs() < 1e-9, "{s:?}");
                    let square = marginal(&|r| r[i] * r[(i + 1) % 3]);
                    let expected = second[(3 * axis + i, 3 * axis + (i + 1) % 3)];
                    assert!((square - expected).abs() < 1e-9, "{s:?}");
                }
            }
        }
    }

    #[test]
    fn canonical_axes_are_a_decomposition_of_the_same_matrix() {
        let (u, v) = (exp(&Vector3::new(0.4, -1.0, 0.7)), exp(&Vector3::new(-2.0, 0.3, 0.1)));
        for s in [[3.0, 2.0, -1.0], [4.0, 4.0, -4.0], [5.0, 0.0, 0.0], [2.0, 2.0, 1.0], [0.0; 3]] {
            let svd = ProperSvd { u, s: Vector3::from(s), v };
            let canonical = canonical_axes(&svd);
            assert!((canonical.matrix() - svd.matrix()).norm() < 1e-13, "{s:?}");
            let again = canonical_axes(&canonical);
            assert!((again.u.matrix() - canonical.u.matrix()).norm() < 1e-13, "{s:?}");
        }
    }
}
