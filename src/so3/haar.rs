use std::f64::consts::TAU;
use std::num::NonZeroUsize;

use gauss_quad::legendre::GaussLegendre;
use nalgebra::{Rotation3, Vector4};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

use super::quaternion::rotation_from_quaternion;

/// A rotation drawn from the uniform (Haar) distribution on SO(3).
pub fn sample_haar<R: Rng + ?Sized>(rng: &mut R) -> Rotation3<f64> {
    loop {
        let normal = Vector4::from_fn(|_, _| StandardNormal.sample(rng));
        if let Some(q) = normal.try_normalize(1e-9) {
            return rotation_from_quaternion(&q);
        }
    }
}

/// A deterministic grid on SO(3) whose weighted sums are Haar integrals.
///
/// In Euler angles `R = Rz(alpha) Ry(beta) Rz(gamma)` the Haar measure is
/// `d alpha d(cos beta) d gamma / (8 pi^2)`: equal steps in `alpha` and `gamma` and Gauss-Legendre
/// nodes in `cos beta` integrate every polynomial in the entries of `R` up to the chosen degree
/// exactly.
///
/// ```
/// # use mfg_vio::so3::HaarQuadrature;
/// let grid = HaarQuadrature::of_degree(4);
/// let mean = |f: fn(f64) -> f64| grid.integrate(|r| f(r[(0, 1)]));
/// assert!((mean(|x| x.powi(2)) - 1.0 / 3.0).abs() < 1e-14);
/// assert!((mean(|x| x.powi(4)) - 1.0 / 5.0).abs() < 1e-14);
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct HaarQuadrature {
    nodes: Vec<(Rotation3<f64>, f64)>,
}

impl HaarQuadrature {
    /// The grid that is exact for polynomials in the entries of `R` up to `degree`; about
    /// `degree^3 / 2` nodes.
    pub fn of_degree(degree: usize) -> Self {
        let turns = degree + 1;
        let heights = GaussLegendre::new(NonZeroUsize::MIN.saturating_add(degree / 2));
        let step = TAU / turns as f64;
        let mut nodes = Vec::with_capacity(turns * turns * (degree / 2 + 1));
        for &(height, weight) in heights.iter() {
            let (rho, weight) = (0.5 * (1.0 + height), 0.5 * weight / (turns * turns) as f64);
            for i in 0..turns {
                for j in 0..turns {
                    nodes.push((zyz(rho, step * i as f64, step * j as f64), weight));
                }
            }
        }
        Self { nodes }
    }

    /// Rotations and their weights; the weights are positive and sum to one.
    pub fn nodes(&self) -> &[(Rotation3<f64>, f64)] {
        &self.nodes
    }

    /// The integral of `f` with respect to the normalized Haar measure.
    pub fn integrate(&self, mut f: impl FnMut(&Rotation3<f64>) -> f64) -> f64 {
        self.nodes.iter().map(|(r, weight)| weight * f(r)).sum()
    }
}

/// `Rz(alpha) Ry(beta) Rz(gamma)` with `rho = cos^2(beta/2)`.
fn zyz(rho: f64, alpha: f64, gamma: f64) -> Rotation3<f64> {
    let (cosine, sine) = (rho.sqrt(), (1.0 - rho).sqrt());
    let (sum, difference) = (0.5 * (alpha + gamma), 0.5 * (gamma - alpha));
    rotation_from_quaternion(&Vector4::new(
        cosine * sum.cos(),
        sine * difference.sin(),
        sine * difference.cos(),
        cosine * sum.sin(),
    ))
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn zyz_is_the_product_of_its_turns() {
        let (alpha, beta, gamma) = (0.3f64, 1.1f64, -2.0f64);
        let about = |axis, angle| Rotation3::from_axis_angle(&axis, angle);
        let expected = about(Vector3::z_axis(), alpha)
            * about(Vector3::y_axis(), beta)
            * about(Vector3::z_axis(), gamma);
        let found = zyz((0.5 * beta).cos().powi(2), alpha, gamma);
        assert!((found.matrix() - expected.matrix()).norm() < 1e-14);
    }

    #[test]
    fn quadrature_is_exact_to_its_degree() {
        // E[R_ij^4] = 1/5, E[R11 R22 R33] = 1/6, E[R11^2 R22^2] = 2/15; all odd ones vanish.
        let grid = HaarQuadrature::of_degree(4);
        let values = [
            (grid.integrate(|_| 1.0), 1.0),
            (grid.integrate(|r| r[(1, 1)].powi(4)), 1.0 / 5.0),
            (grid.integrate(|r| r[(2, 0)].powi(4)), 1.0 / 5.0),
            (grid.integrate(|r| r[(0, 0)] * r[(1, 1)] * r[(2, 2)]), 1.0 / 6.0),
            (grid.integrate(|r| (r[(0, 0)] * r[(1, 1)]).powi(2)), 2.0 / 15.0),
            (grid.integrate(|r| r[(0, 1)]), 0.0),
            (grid.integrate(|r| r[(0, 1)] * r[(1, 0)] * r[(2, 2)]), -1.0 / 6.0),
        ];
        for (found, expected) in values {
            assert!((found - expected).abs() < 1e-14, "{found} {expected}");
        }
    }

    #[test]
    fn samples_are_uniform() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let n = 100_000;
        let (mut mean, mut square) = (Matrix3::zeros(), Matrix3::zeros());
        for _ in 0..n {
            let r = sample_haar(&mut rng).into_inner();
            mean += r / f64::from(n);
            square += r.component_mul(&r) / f64::from(n);
        }
        // Standard deviations 1/sqrt(3 n) = 0.0018 and sqrt(4/45/n) = 0.00094.
        assert!(mean.amax() < 0.008, "{mean}");
        assert!((square.add_scalar(-1.0 / 3.0)).amax() < 0.004, "{square}");
    }
}
