use nalgebra::{Matrix4, SymmetricEigen, Vector3, Vector4};
use rand::Rng;
use rand_distr::Distribution;

use super::matrix_fisher::{
    MatrixFisher, MatrixFisherError, MatrixFisherSampler, s_from_quaternion_squares,
};
use crate::so3::{
    ProperSvd, isoclinic_decomposition, left_isoclinic, quaternion_from_rotation, right_isoclinic,
    rotation_from_quaternion,
};

/// Why a Bingham distribution cannot be made.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum BinghamError {
    #[error("the 4x4 matrix has an entry that is not finite")]
    NotFinite,
    /// The axes are not an orthogonal matrix.
    #[error("the axes of a Bingham distribution must be orthonormal")]
    Axes,
    /// Not `0 >= z1 >= z2 >= z3`.
    #[error("the exponents must satisfy 0 >= z1 >= z2 >= z3, not {0:?}")]
    Exponents([f64; 3]),
    #[error(transparent)]
    Fisher(#[from] MatrixFisherError),
}

/// The Bingham distribution of a unit quaternion, scalar first, with density
/// `exp(q^T A q)/c(A)` with respect to the uniform distribution on S^3 (2.24).
///
/// It is the matrix Fisher distribution of the quaternion's rotation (theorem 2.2), and computed
/// as such: with `A = M Z M^T`, `Z = diag(0, z1, z2, z3)`, the axes are `M = [u]_L [v^-1]_R` for
/// the quaternions of `U` and `V`, and `z_i = -2 (s_j + s_k)`. The constants agree up to the
/// shift of the exponents: `c_B(Z) = c_M(S) exp(-tr S)`.
///
/// ```
/// # use mfg_vio::distribution::Bingham;
/// # use nalgebra::{Matrix4, Vector4};
/// let a = Matrix4::from_diagonal(&Vector4::new(0.0, -10.0, -10.0, -500.0));
/// let bingham = Bingham::new(&a)?;
/// assert!((bingham.mode() - Vector4::x()).norm() < 1e-15);
/// let refit = Bingham::from_second_moment(&bingham.second_moment())?;
/// assert!((refit.parameter() - a).norm() < 1e-9);
/// # Ok::<(), mfg_vio::distribution::BinghamError>(())
/// ```
#[derive(Debug, Clone, Copy)]
pub struct Bingham {
    axes: Matrix4<f64>,
    z: Vector3<f64>,
    fisher: MatrixFisher,
}

impl Bingham {
    /// From the symmetric parameter `A`; a multiple of the identity does not matter.
    pub fn new(a: &Matrix4<f64>) -> Result<Self, BinghamError> {
        let (axes, values) = descending_eigenvectors(a)?;
        let z = Vector3::from_fn(|i, _| values[i + 1] - values[0]);
        Self::from_axes(axes, z)
    }

    /// From the axes `M`, mode first, and the exponents `0 >= z1 >= z2 >= z3` (2.25).
    pub fn from_axes(axes: Matrix4<f64>, z: Vector3<f64>) -> Result<Self, BinghamError> {
        if !(0.0 >= z[0] && z[0] >= z[1] && z[1] >= z[2]) {
            return Err(BinghamError::Exponents(z.into()));
        }
        // The sign of an axis is free, that of the determinant is not.
        let mut axes = axes;
        if axes.determinant() < 0.0 {
            axes.column_mut(3).neg_mut();
        }
        let (u, inverse_v) = isoclinic_decomposition(&axes).ok_or(BinghamError::Axes)?;
        let u = rotation_from_quaternion(&u);
        let v = rotation_from_quaternion(&inverse_v).inverse();
        let s = 0.25 * Vector3::new(z[0] - z[1] - z[2], z[1] - z[0] - z[2], z[2] - z[0] - z[1]);
        let fisher =
            MatrixFisher::from_svd(ProperSvd { u, s, v }).map_err(MatrixFisherError::from)?;
        Ok(Self { axes, z, fisher })
    }

    /// The distribution of the quaternions of `R` (theorem 2.2).
    pub fn from_matrix_fisher(fisher: &MatrixFisher) -> Self {
        let ProperSvd { u, s, v } = fisher.svd();
        let left = left_isoclinic(&quaternion_from_rotation(u));
        let right = right_isoclinic(&quaternion_from_rotation(&v.inverse()));
        let z = -2.0 * Vector3::new(s[1] + s[2], s[0] + s[2], s[0] + s[1]);
        Self { axes: left * right, z, fisher: *fisher }
    }

    /// The MLE from `E[q q^T]` (2.26).
    pub fn from_second_moment(moment: &Matrix4<f64>) -> Result<Self, BinghamError> {
        let (axes, d) = descending_eigenvectors(moment)?;
        let s = s_from_quaternion_squares(&Vector3::new(d[1], d[2], d[3]))
            .map_err(MatrixFisherError::from)?;
        Self::from_axes(axes, -2.0 * Vector3::new(s[1] + s[2], s[0] + s[2], s[0] + s[1]))
    }

    /// The distribution of the rotations.
    pub fn matrix_fisher(&self) -> &MatrixFisher {
        &self.fisher
    }

    /// `M`: the mode and the principal axes, as columns.
    pub fn axes(&self) -> &Matrix4<f64> {
        &self.axes
    }

    /// `(z1, z2, z3)`, minus the concentrations about the principal axes.
    pub fn exponents(&self) -> Vector3<f64> {
        self.z
    }

    /// `A = M Z M^T`.
    pub fn parameter(&self) -> Matrix4<f64> {
        let z = Vector4::new(0.0, self.z[0], self.z[1], self.z[2]);
        self.axes * Matrix4::from_diagonal(&z) * self.axes.transpose()
    }

    /// A mode; its opposite is the other.
    pub fn mode(&self) -> Vector4<f64> {
        self.axes.column(0).into_owned()
    }

    /// `M^T q`, the quaternion in principal axes.
    pub fn centred(&self, q: &Vector4<f64>) -> Vector4<f64> {
        self.axes.tr_mul(q)
    }

    /// Logarithm of the density at the unit quaternion `q`.
    pub fn log_density(&self, q: &Vector4<f64>) -> f64 {
        let x = self.centred(q);
        let exponent: f64 = (0..3).map(|i| self.z[i] * x[i + 1] * x[i + 1]).sum();
        exponent - self.fisher.moments().log_c_scaled()
    }

    /// `E[q q^T] = M D M^T` (2.26).
    pub fn second_moment(&self) -> Matrix4<f64> {
        let d = Matrix4::from_diagonal(&self.fisher.moments().quaternion_squares());
        self.axes * d * self.axes.transpose()
    }

    /// A sampler, prepared once for many draws.
    pub fn sampler(&self) -> BinghamSampler {
        BinghamSampler { axes: self.axes, central: self.fisher.sampler() }
    }
}

/// Exact sampler of a Bingham distribution.
///
/// ```
/// # use mfg_vio::distribution::Bingham;
/// # use nalgebra::{Matrix4, Vector3};
/// # use rand::{SeedableRng, distr::Distribution};
/// let bingham = Bingham::from_axes(Matrix4::identity(), Vector3::new(-20.0, -50.0, -90.0))?;
/// let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
/// let samples = bingham.sampler().sample_iter(&mut rng).take(1000);
/// let moment = samples.map(|q| q * q.transpose()).sum::<Matrix4<f64>>() / 1000.0;
/// assert!((moment - bingham.second_moment()).amax() < 0.01);
/// # Ok::<(), mfg_vio::distribution::BinghamError>(())
/// ```
#[derive(Debug, Clone, Copy)]
pub struct BinghamSampler {
    axes: Matrix4<f64>,
    central: MatrixFisherSampler,
}

impl Distribution<Vector4<f64>> for BinghamSampler {
    fn sample<R: Rng + ?Sized>(&self, rng: &mut R) -> Vector4<f64> {
        self.axes * self.central.sample_quaternion(rng)
    }
}

fn descending_eigenvectors(m: &Matrix4<f64>) -> Result<(Matrix4<f64>, Vector4<f64>), BinghamError> {
    if !m.iter().all(|x| x.is_finite()) {
        return Err(BinghamError::NotFinite);
    }
    let eigen = SymmetricEigen::new(0.5 * (m + m.transpose()));
    let mut order = [0, 1, 2, 3];
    order.sort_by(|&i, &j| eigen.eigenvalues[j].total_cmp(&eigen.eigenvalues[i]));
    let axes = Matrix4::from_columns(&order.map(|i| eigen.eigenvectors.column(i)));
    Ok((axes, Vector4::from(order.map(|i| eigen.eigenvalues[i]))))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::so3::exp;

    fn bingham() -> impl Strategy<Value = Bingham> {
        let angles = prop::array::uniform3(-3.0..3.0);
        let z = prop::array::uniform3(0.0..40.0f64);
        (angles.clone(), angles, z).prop_map(|(u, v, mut z)| {
            z.sort_by(f64::total_cmp);
            let quaternion = |a: [f64; 3]| quaternion_from_rotation(&exp(&Vector3::from(a)));
            let axes = left_isoclinic(&quaternion(u)) * right_isoclinic(&quaternion(v));
            Bingham::from_axes(axes, -Vector3::from(z)).unwrap()
        })
    }

    fn quaternion() -> impl Strategy<Value = Vector4<f64>> {
        prop::array::uniform4(-1.0..1.0f64)
            .prop_map(Vector4::from)
            .prop_filter("not zero", |q| q.norm() > 0.1)
            .prop_map(|q| q.normalize())
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// Theorem 2.2, as densities.
        #[test]
        fn it_is_the_matrix_fisher_distribution_of_the_rotation(b in bingham(), q in quaternion()) {
            let fisher = b.matrix_fisher().log_density(&rotation_from_quaternion(&q));
            prop_assert!((b.log_density(&q) - fisher).abs() < 1e-11);
            let back = Bingham::from_matrix_fisher(b.matrix_fisher());
            prop_assert!((back.parameter() - b.parameter()).norm() < 1e-11);
            let scale = b.parameter().trace();
            let exponent = q.dot(&(b.parameter() * q)) - b.matrix_fisher().moments().log_c_scaled();
            prop_assert!((b.log_density(&q) - exponent).abs() < 1e-12 * (1.0 + scale.abs()));
        }

        #[test]
        fn estimation_inverts_the_second_moment(b in bingham()) {
            let found = Bingham::from_second_moment(&b.second_moment()).unwrap();
            prop_assert!((found.parameter() - b.parameter()).norm() < 1e-9);
        }
    }

    /// (2.40): first moments of the rotation from those of the quaternion.
    #[test]
    fn quaternion_moments_are_those_of_the_rotation() {
        let z = Vector3::new(-1.0, -4.0, -9.0);
        let b = Bingham::from_axes(Matrix4::identity(), z).unwrap();
        let d = b.second_moment().diagonal();
        let first = b.matrix_fisher().moments().first();
        assert!((first[0] - (d[0] + d[1] - d[2] - d[3])).abs() < 1e-15);
        assert!((first[1] - (d[0] - d[1] + d[2] - d[3])).abs() < 1e-15);
        assert!((first[2] - (d[0] - d[1] - d[2] + d[3])).abs() < 1e-15);
    }

    #[test]
    fn samples_have_the_second_moment() {
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        let axes = left_isoclinic(&Vector4::new(0.5, 0.5, -0.5, 0.5));
        let b = Bingham::from_axes(axes, Vector3::new(-2.0, -2.0, -300.0)).unwrap();
        let n = 40_000;
        let mut moment = Matrix4::zeros();
        for q in b.sampler().sample_iter(&mut rng).take(n) {
            moment += q * q.transpose() / n as f64;
        }
        assert!((moment - b.second_moment()).amax() < 4.0 / (n as f64).sqrt(), "{moment}");
    }

    #[test]
    fn parameters_without_meaning_are_refused() {
        assert!(Bingham::new(&Matrix4::repeat(f64::NAN)).is_err());
        assert!(Bingham::from_axes(Matrix4::zeros(), Vector3::zeros()).is_err());
        let ascending = Vector3::new(-3.0, -2.0, -1.0);
        assert!(Bingham::from_axes(Matrix4::identity(), ascending).is_err());
        assert!(Bingham::from_second_moment(&Matrix4::from_diagonal(&Vector4::x())).is_err());
    }
}
