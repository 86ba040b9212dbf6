use nalgebra::allocator::Allocator;
use nalgebra::{DefaultAllocator, Dim, OMatrix, OVector, U1, U3, Vector3, Vector4};

use super::bingham::{Bingham, BinghamError};
use super::matrix_fisher_gaussian::{Correlation, MatrixFisherGaussian, MfgError};
use crate::so3::rotation_from_quaternion;

/// Why a Bingham-Gaussian distribution cannot be made.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum BinghamGaussianError {
    #[error(transparent)]
    Quaternion(#[from] BinghamError),
    #[error(transparent)]
    Gaussian(#[from] MfgError),
}

/// The Bingham-Gaussian distribution of a unit quaternion and a vector (definition 3.2).
///
/// It is the matrix Fisher-Gaussian distribution of the quaternion's rotation and the vector with
/// the same `mu`, `Sigma`, `P` (theorem 3.3), and holds it: moments, estimation and conditionals
/// are those of [`matrix_fisher_gaussian`](Self::matrix_fisher_gaussian).
///
/// ```
/// # use mfg_vio::distribution::{Bingham, BinghamGaussian};
/// # use mfg_vio::distribution::matrix_fisher_gaussian::Correlation;
/// # use nalgebra::{Matrix1, Matrix1x3, Matrix4, Vector1, Vector3};
/// let bingham = Bingham::from_axes(Matrix4::identity(), Vector3::new(-8.0, -20.0, -40.0))?;
/// let belief = BinghamGaussian::new(
///     bingham,
///     Vector1::new(0.0),
///     Matrix1::new(1.0),
///     Matrix1x3::new(0.1, 0.0, 0.0),
///     Correlation::Body,
/// )?;
/// let q = bingham.mode();
/// assert_eq!(belief.log_density(&q, &Vector1::new(0.3)), belief.log_density(&-q, &Vector1::new(0.3)));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone)]
pub struct BinghamGaussian<D: Dim>
where
    DefaultAllocator: Allocator<D> + Allocator<D, D> + Allocator<D, U3>,
{
    bingham: Bingham,
    gaussian: MatrixFisherGaussian<D>,
}

impl<D: Dim> BinghamGaussian<D>
where
    DefaultAllocator:
        Allocator<D> + Allocator<D, D> + Allocator<D, U3> + Allocator<U3, D> + Allocator<U1, D>,
{
    /// From the parameters; `Sigma + P diag(z) P^T/2` must be positive definite (3.12).
    pub fn new(
        bingham: Bingham,
        mu: OVector<f64, D>,
        sigma: OMatrix<f64, D, D>,
        p: OMatrix<f64, D, U3>,
        correlation: Correlation,
    ) -> Result<Self, BinghamGaussianError> {
        let fisher = *bingham.matrix_fisher();
        let gaussian = MatrixFisherGaussian::new(fisher, mu, sigma, p, correlation)?;
        Ok(Self { bingham, gaussian })
    }

    /// The distribution of the quaternions and the vector (theorem 3.3).
    pub fn from_matrix_fisher_gaussian(gaussian: MatrixFisherGaussian<D>) -> Self {
        Self { bingham: Bingham::from_matrix_fisher(gaussian.attitude()), gaussian }
    }

    /// The marginal distribution of the quaternion.
    pub fn bingham(&self) -> &Bingham {
        &self.bingham
    }

    /// The distribution of the rotation and the vector.
    pub fn matrix_fisher_gaussian(&self) -> &MatrixFisherGaussian<D> {
        &self.gaussian
    }

    /// `v_q`, the deviation of the quaternion from the mode (3.13, 3.14).
    pub fn deviation(&self, q: &Vector4<f64>) -> Vector3<f64> {
        let p = self.bingham.centred(q);
        let z = self.bingham.exponents();
        let sign = match self.gaussian.correlation() {
            Correlation::World => 1.0,
            Correlation::Body => -1.0,
        };
        Vector3::from_fn(|i, _| {
            let (j, k) = ((i + 1) % 3, (i + 2) % 3);
            sign * (z[j] - z[k]) * p[j + 1] * p[k + 1] - z[i] * p[0] * p[i + 1]
        })
    }

    /// `E[x | q] = mu + P v_q`.
    pub fn conditional_mean(&self, q: &Vector4<f64>) -> OVector<f64, D> {
        self.gaussian.mu() + self.gaussian.p() * self.deviation(q)
    }

    /// Logarithm of the density (3.11) with respect to the uniform distribution on S^3 and
    /// Lebesgue measure.
    pub fn log_density(&self, q: &Vector4<f64>, x: &OVector<f64, D>) -> f64 {
        self.gaussian.log_density(&rotation_from_quaternion(q), x)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Const, Matrix2x3, Matrix3};
    use proptest::prelude::*;

    use super::*;
    use crate::so3::{left_isoclinic, right_isoclinic};

    fn quaternion() -> impl Strategy<Value = Vector4<f64>> {
        prop::array::uniform4(-1.0..1.0f64)
            .prop_map(Vector4::from)
            .prop_filter("not zero", |q| q.norm() > 0.1)
            .prop_map(|q| q.normalize())
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// Theorem 3.3: the printed v_q is v_R, the density that of its definition.
        #[test]
        fn it_is_the_matrix_fisher_gaussian_of_the_rotation(
            u in quaternion(), v in quaternion(), q in quaternion(),
        ) {
            let axes = left_isoclinic(&u) * right_isoclinic(&v);
            let z = Vector3::new(-3.0, -5.0, -12.0);
            let bingham = Bingham::from_axes(axes, z).unwrap();
            let p = Matrix2x3::new(0.1, -0.05, 0.1, 0.02, 0.1, -0.03);
            let sigma = OMatrix::<f64, Const<2>, Const<2>>::identity();
            let mu = OVector::<f64, Const<2>>::new(1.0, -2.0);
            for correlation in [Correlation::World, Correlation::Body] {
                let belief = BinghamGaussian::new(bingham, mu, sigma, p, correlation).unwrap();
                let gaussian = belief.matrix_fisher_gaussian();
                let deviation = gaussian.deviation(&rotation_from_quaternion(&q));
                prop_assert!((belief.deviation(&q) - deviation).norm() < 1e-12);

                let x = OVector::<f64, Const<2>>::new(0.3, 0.4);
                let covariance = sigma + p * Matrix3::from_diagonal(&z) * p.transpose() * 0.5;
                let residual = x - belief.conditional_mean(&q);
                let exponent = residual.dot(&(covariance.try_inverse().unwrap() * residual));
                let expected = bingham.log_density(&q)
                    - 0.5 * exponent
                    - 0.5 * (covariance * std::f64::consts::TAU).determinant().ln();
                prop_assert!((belief.log_density(&q, &x) - expected).abs() < 1e-11);

                let back = BinghamGaussian::from_matrix_fisher_gaussian(gaussian.clone());
                prop_assert!((back.log_density(&q, &x) - expected).abs() < 1e-11);
                prop_assert!((back.bingham().parameter() - bingham.parameter()).norm() < 1e-11);
            }
        }
    }
}
