use std::f64::consts::{PI, TAU};

use nalgebra::{Cholesky, Const, Matrix3, Rotation3, Vector3};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

use super::matrix_fisher::{MatrixFisher, MatrixFisherError, SubsetConcentration};
use crate::so3::{exp, log};

/// Turns of the rotation vector that are added up on either side; with a standard deviation of
/// pi the next ones weigh below 1e-16.
const TURNS: i32 = 6;
/// A mean attitude farther than this (rad) from a one-parameter subset does not lie in it.
const ON_SUBSET: f64 = 1e-9;

/// The covariance of a rotation vector must be positive definite.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("the covariance of the rotation vector is not positive definite: {0:?}")]
pub struct NotPositiveDefinite(pub Matrix3<f64>);

/// The wrapped Gaussian on SO(3): `R = M exp(e^)` with `e ~ N(0, C)` in the body frame.
///
/// Where it is concentrated it is the concentrated Gaussian of filters on Lie groups, and the
/// limit of the matrix Fisher distribution (theorem 2.6).
///
/// ```
/// # use mfg_vio::distribution::ConcentratedGaussian;
/// # use nalgebra::{Matrix3, Rotation3};
/// let gaussian = ConcentratedGaussian::new(Rotation3::identity(), Matrix3::identity() * 1e-4)?;
/// let fisher = gaussian.to_matrix_fisher()?;
/// assert!((fisher.svd().s[0] - 5000.0).abs() < 1e-8);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, Copy)]
pub struct ConcentratedGaussian {
    mean: Rotation3<f64>,
    covariance: Matrix3<f64>,
    factor: Cholesky<f64, Const<3>>,
}

impl ConcentratedGaussian {
    /// `covariance` of the body-frame rotation vector, rad^2.
    pub fn new(
        mean: Rotation3<f64>,
        covariance: Matrix3<f64>,
    ) -> Result<Self, NotPositiveDefinite> {
        let finite = covariance.iter().all(|x| x.is_finite());
        let factor = Cholesky::new(covariance).filter(|_| finite);
        Ok(Self { mean, covariance, factor: factor.ok_or(NotPositiveDefinite(covariance))? })
    }

    /// The concentrated limit of a matrix Fisher distribution (theorem 2.6); an error where it is
    /// not concentrated about all axes, `s2 + s3 = 0`.
    pub fn from_matrix_fisher(fisher: &MatrixFisher) -> Result<Self, NotPositiveDefinite> {
        let information = fisher.information();
        let inverse = Cholesky::new(information).map(|factor| factor.inverse());
        Self::new(fisher.mode(), inverse.ok_or(NotPositiveDefinite(information))?)
    }

    /// The matrix Fisher distribution with the same information at the mode (FNF 31).
    pub fn to_matrix_fisher(&self) -> Result<MatrixFisher, MatrixFisherError> {
        MatrixFisher::from_mode_and_information(self.mean, self.factor.inverse())
    }

    pub fn mean(&self) -> Rotation3<f64> {
        self.mean
    }

    /// Covariance of the body-frame rotation vector, rad^2.
    pub fn covariance(&self) -> &Matrix3<f64> {
        &self.covariance
    }

    /// Logarithm of the density with respect to the normalized Haar measure: the Gaussian density
    /// of every rotation vector of `M^T R`, each divided by the density
    /// `(1 - cos t)/(4 pi^2 t^2)` of the Haar measure there.
    pub fn log_density(&self, r: &Rotation3<f64>) -> f64 {
        let e = log(&(self.mean.inverse() * r));
        let angle = e.norm();
        let log_det = self.factor.l_dirty().diagonal().map(f64::ln).sum();
        let log_gauss = -1.5 * TAU.ln() - log_det;
        if angle == 0.0 {
            return log_gauss + (8.0 * PI * PI).ln();
        }
        let axis = e / angle;
        let squared = axis.dot(&self.factor.solve(&axis));
        let haar = 2.0 * (0.5 * angle).sin().powi(2) / (4.0 * PI * PI);
        // Relative to the shortest vector, which dominates.
        let sum: f64 = (-TURNS..=TURNS)
            .map(|turn| {
                let t = angle + TAU * f64::from(turn);
                t * t / haar * (-0.5 * squared * (t * t - angle * angle)).exp()
            })
            .sum();
        log_gauss - 0.5 * squared * angle * angle + sum.ln()
    }

    /// The distribution along `origin exp(theta axis^)`, a subset through the mean attitude (FNF
    /// theorem III.2); `None` if the mean attitude does not lie in it.
    pub fn on_subset(
        &self,
        origin: &Rotation3<f64>,
        axis: &Vector3<f64>,
    ) -> Option<SubsetConcentration> {
        let offset = log(&(origin.inverse() * self.mean));
        let mean_angle = offset.dot(axis);
        let concentration = axis.dot(&self.factor.solve(axis));
        ((offset - axis * mean_angle).norm() < ON_SUBSET)
            .then_some(SubsetConcentration { mean_angle, concentration })
    }
}

impl Distribution<Rotation3<f64>> for ConcentratedGaussian {
    fn sample<R: Rng + ?Sized>(&self, rng: &mut R) -> Rotation3<f64> {
        let normal = Vector3::from_fn(|_, _| StandardNormal.sample(rng));
        self.mean * exp(&(self.factor.l() * normal))
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::so3::HaarQuadrature;

    fn gaussian(scale: f64) -> ConcentratedGaussian {
        let covariance = Matrix3::new(1.0, 0.3, 0.1, 0.3, 0.8, -0.2, 0.1, -0.2, 1.5) * scale;
        ConcentratedGaussian::new(exp(&Vector3::new(0.4, 1.0, -0.3)), covariance).unwrap()
    }

    #[test]
    fn density_integrates_to_one_even_when_wrapped() {
        let grid = HaarQuadrature::of_degree(40);
        for (scale, tolerance) in [(0.1, 1e-3), (0.3, 1e-3), (2.0, 1e-2)] {
            let integral = grid.integrate(|r| gaussian(scale).log_density(r).exp());
            assert!((integral - 1.0).abs() < tolerance, "{scale} {integral}");
        }
    }

    #[test]
    fn samples_have_the_covariance() {
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let gaussian = gaussian(1e-3);
        let n = 20_000;
        let mut covariance = Matrix3::zeros();
        for r in gaussian.sample_iter(&mut rng).take(n) {
            let e = log(&(gaussian.mean().inverse() * r));
            covariance += e * e.transpose() / n as f64;
        }
        assert!((covariance - gaussian.covariance()).amax() < 1e-4);
    }

    #[test]
    fn matrix_fisher_is_its_concentrated_counterpart() {
        let gaussian = gaussian(1e-6);
        let fisher = gaussian.to_matrix_fisher().unwrap();
        let back = ConcentratedGaussian::from_matrix_fisher(&fisher).unwrap();
        assert!((back.covariance() - gaussian.covariance()).amax() < 1e-17);
        let r = gaussian.mean() * exp(&Vector3::new(1e-3, -5e-4, 2e-4));
        assert!((gaussian.log_density(&r) - fisher.log_density(&r)).abs() < 1e-4);
    }

    #[test]
    fn a_subset_without_the_mean_is_refused() {
        let gaussian = gaussian(0.01);
        let axis = Vector3::new(1.0, 2.0, 2.0) / 3.0;
        let origin = gaussian.mean() * exp(&(axis * -0.5));
        let subset = gaussian.on_subset(&origin, &axis).unwrap();
        assert!((subset.mean_angle - 0.5).abs() < 1e-12);
        assert!(gaussian.on_subset(&origin, &Vector3::x()).is_none());
        // FNF remark III.1: the two concentrations agree where tails are small.
        let fisher = gaussian.to_matrix_fisher().unwrap().on_subset(&origin, &axis);
        assert!((fisher.concentration / subset.concentration - 1.0).abs() < 1e-12);
        assert!((fisher.mean_angle - 0.5).abs() < 1e-12);
        let fused = fisher.fuse_fisher(&fisher);
        let precise = subset.fuse_gaussian(&subset);
        assert!((fused.concentration / precise.concentration - 1.0).abs() < 1e-12);
    }
}
