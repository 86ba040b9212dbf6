use nalgebra::{Matrix3, Rotation3};

use super::proper_svd::{NotFinite, proper_svd};

/// Halley steps for the largest eigenvalue; as all roots are real they converge from above, and the
/// error is that before to the third power.
const MAX_STEPS: usize = 20;
/// Relative step after which the eigenvalue counts as found: what is left is its third power, times
/// at most `(0.75/CONDITION)^2`.
const CONVERGED: f64 = 1e-7;
/// Smallest `(s1 + s2)(s2 + s3)(s1 + s3)` relative to `(tr S)^3` for which the closed form is
/// used.
const CONDITION: f64 = 1e-3;

/// `m = R K` with a rotation `R` and a symmetric `K` such that `tr(K) I - K >= 0`: the proper
/// polar decomposition, `R = U V^T`, `K = V S V^T` of the proper singular value decomposition.
///
/// In closed form given `tr S`, the largest root of a quartic (Markley's FOAM algorithm, 1993),
/// and then a third of the cost of the singular values; where the rotation is close to not being
/// unique, by these.
pub fn proper_polar(m: &Matrix3<f64>) -> Result<(Rotation3<f64>, Matrix3<f64>), NotFinite> {
    let rotation = match closed_form(m) {
        Some(rotation) => rotation,
        None => proper_svd(m)?.rotation(),
    };
    let k = rotation.matrix().transpose() * m;
    Ok((rotation, 0.5 * (k + k.transpose())))
}

/// The cofactors of a matrix: its determinant times the transpose of its inverse.
pub(crate) fn cofactors(m: &Matrix3<f64>) -> Matrix3<f64> {
    let minor = |i: usize, j: usize| {
        let (a, b, c, d) = ((i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3);
        m[(a, c)] * m[(b, d)] - m[(a, d)] * m[(b, c)]
    };
    Matrix3::new(
        minor(0, 0),
        minor(0, 1),
        minor(0, 2),
        minor(1, 0),
        minor(1, 1),
        minor(1, 2),
        minor(2, 0),
        minor(2, 1),
        minor(2, 2),
    )
}

fn closed_form(m: &Matrix3<f64>) -> Option<Rotation3<f64>> {
    let scale = m.amax();
    if !(scale > 0.0 && scale.is_finite()) {
        return None;
    }
    let b = m * scale.recip();
    let cofactors = cofactors(&b);
    let (squared, determinant) = (b.norm_squared(), b.column(0).dot(&cofactors.column(0)));
    let minors = cofactors.norm_squared();
    // tr S is the largest root of (l^2 - |b|^2)^2 - 8 l det b - 4 |cof b|^2.
    let mut l = (3.0 * squared).sqrt();
    let converged = (0..MAX_STEPS).any(|_| {
        let excess = l * l - squared;
        let value = excess * excess - 8.0 * l * determinant - 4.0 * minors;
        let slope = 4.0 * l * excess - 8.0 * determinant;
        let half_bend = 2.0 * (excess + 2.0 * l * l);
        let step = value * slope / (slope * slope - value * half_bend);
        l -= step;
        // Not a number where the slope vanishes: then never converged.
        step.abs() <= CONVERGED * l
    });
    let kappa = 0.5 * (l * l - squared);
    let zeta = kappa * l - determinant;
    if !(converged && zeta > CONDITION * l * l * l) {
        return None;
    }
    let r = (b * (kappa + squared) + cofactors * l - b * (b.transpose() * b)) * zeta.recip();
    // Restores orthogonality to rounding.
    let r = r * (Matrix3::from_diagonal_element(1.5) - 0.5 * (r.transpose() * r));
    Some(Rotation3::from_matrix_unchecked(r))
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use proptest::prelude::*;

    use super::super::exp;
    use super::*;

    proptest! {
        #[test]
        fn polar_factors_are_those_of_the_singular_values(
            u in prop::array::uniform3(-3.0..3.0f64),
            v in prop::array::uniform3(-3.0..3.0f64),
            s in prop::array::uniform3(0.0..1.0f64),
            sign in prop::bool::ANY,
            exponent in -100.0..100.0f64,
        ) {
            let mut s = s;
            s.sort_by(|a, b| b.total_cmp(a));
            if sign { s[2] = -s[2] }
            let (u, v) = (exp(&Vector3::from(u)), exp(&Vector3::from(v)));
            let s = Vector3::from(s) * 10f64.powf(exponent);
            let m = u.matrix() * Matrix3::from_diagonal(&s) * v.matrix().transpose();
            let (r, k) = proper_polar(&m).unwrap();
            let defect = r.matrix().transpose() * r.matrix() - Matrix3::identity();
            prop_assert!(defect.amax() < 4e-15);
            prop_assert!((r.matrix() * k - m).amax() < 1e-11 * m.amax());
            let gap = (s[1] + s[2]) / s[0];
            let expected = u * v.inverse();
            prop_assert!((r.matrix() - expected.matrix()).amax() * gap < 1e-11);
        }
    }

    #[test]
    fn repeated_opposite_and_vanishing_singular_values_have_a_rotation() {
        for s in [[0.0; 3], [1.0; 3], [1.0, 1.0, -1.0], [1.0, 0.0, 0.0], [2.0, 1.0, -1.0]] {
            let (r, _) = proper_polar(&Matrix3::from_diagonal(&Vector3::from(s))).unwrap();
            assert!((r.matrix().determinant() - 1.0).abs() < 1e-14, "{s:?}");
        }
        assert!(proper_polar(&Matrix3::from_element(f64::NAN)).is_err());
    }
}
