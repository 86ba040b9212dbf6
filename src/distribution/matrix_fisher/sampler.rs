use nalgebra::{Rotation3, Vector4};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

use super::sums::Sums;
use crate::so3::{ProperSvd, rotation_from_quaternion};

/// Dimension of the quaternion's space.
const DIMENSION: f64 = 4.0;

/// Exact sampler of a matrix Fisher distribution.
///
/// Rejection on the unit quaternion with an angular central Gaussian envelope (Kent, Ganeiber and
/// Mardia, 2018); more than two of five proposals are accepted at any concentration.
///
/// ```
/// # use mfg_vio::distribution::matrix_fisher::MatrixFisher;
/// # use nalgebra::Matrix3;
/// # use rand::{SeedableRng, distr::Distribution};
/// let fisher = MatrixFisher::new(&(50.0 * Matrix3::identity()))?;
/// let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
/// let mean: f64 =
///     fisher.sampler().sample_iter(&mut rng).take(1000).map(|r| r.angle()).sum::<f64>() / 1000.0;
/// assert!((mean - 0.16).abs() < 0.01);
/// # Ok::<(), mfg_vio::distribution::matrix_fisher::MatrixFisherError>(())
/// ```
#[derive(Debug, Clone, Copy)]
pub struct MatrixFisherSampler {
    u: Rotation3<f64>,
    v: Rotation3<f64>,
    /// Exponents `l` of the density `exp(-sum l_a x_a^2)`.
    exponents: Vector4<f64>,
    /// Diagonal of the envelope's precision, `1 + 2 l/b`.
    precisions: Vector4<f64>,
    log_bound: f64,
}

impl MatrixFisherSampler {
    pub(super) fn new(svd: &ProperSvd) -> Self {
        let [a1, a2, a3] = Sums::of_singular_values(&svd.s).a;
        let exponents = Vector4::new(0.0, 2.0 * a1, 2.0 * a2, 2.0 * a3);
        let b = envelope_parameter(&exponents);
        Self {
            u: svd.u,
            v: svd.v,
            exponents,
            precisions: exponents.map(|l| 1.0 + 2.0 * l / b),
            log_bound: 0.5 * (b - DIMENSION) + 0.5 * DIMENSION * (DIMENSION / b).ln(),
        }
    }

    /// A unit quaternion of `Q = U^T R V`, scalar first, of random sign.
    pub fn sample_quaternion<R: Rng + ?Sized>(&self, rng: &mut R) -> Vector4<f64> {
        loop {
            let proposal = Vector4::from_fn(|a, _| {
                let normal: f64 = StandardNormal.sample(rng);
                normal / self.precisions[a].sqrt()
            });
            let Some(x) = proposal.try_normalize(0.0) else { continue };
            let squares = x.component_mul(&x);
            let log_ratio = 0.5 * DIMENSION * self.precisions.dot(&squares).ln()
                - self.exponents.dot(&squares)
                - self.log_bound;
            if rng.random::<f64>().ln() < log_ratio {
                return x;
            }
        }
    }
}

impl Distribution<Rotation3<f64>> for MatrixFisherSampler {
    fn sample<R: Rng + ?Sized>(&self, rng: &mut R) -> Rotation3<f64> {
        self.u * rotation_from_quaternion(&self.sample_quaternion(rng)) * self.v.inverse()
    }
}

/// The root of `sum 1/(b + 2 l_a) = 1`, for which the envelope is tightest; between 1 and 4.
fn envelope_parameter(exponents: &Vector4<f64>) -> f64 {
    // The sum is convex and decreasing: Newton's method from the left never passes the root.
    let mut b = 1.0;
    for _ in 0..50 {
        let terms = exponents.map(|l| 1.0 / (b + 2.0 * l));
        let step = (terms.sum() - 1.0) / terms.norm_squared();
        b += step;
        if step <= 1e-12 {
            break;
        }
    }
    b
}
