//! Central moments of `q = vec Q` to order three.

use super::super::third_moments::ThirdMoments;
pub(super) use super::super::third_moments::{Matrix9, Vector9};
use crate::distribution::matrix_fisher::Moments;

/// Mean, covariance and third central moments of `q = vec Q`, `Q ~ M(S)`.
pub(super) struct CentralMoments {
    pub mean: Vector9,
    pub covariance: Matrix9,
    third: ThirdMoments,
}

impl CentralMoments {
    pub fn of(moments: &Moments) -> Self {
        let (mean, covariance) = mean_and_covariance(moments);
        let third = ThirdMoments::central(moments, &mean, &covariance);
        Self { mean, covariance, third }
    }

    /// `E[(w^T q~) q~ q~^T]`, `q~ = q - E[q]`.
    pub fn weighted(&self, w: &Vector9) -> Matrix9 {
        self.third.weighted(w)
    }

    /// `E[(q~^T g q~) q~]` of a symmetric `g`.
    pub fn with_quadratic(&self, g: &Matrix9) -> Vector9 {
        self.third.with_quadratic(g)
    }
}

/// `E[q]` and `Cov[q]`.
pub(super) fn mean_and_covariance(moments: &Moments) -> (Vector9, Matrix9) {
    let d = moments.first();
    let mut mean = Vector9::zeros();
    let mut covariance = moments.second_matrix();
    // The covariance of the diagonal is of second order in the dispersion: not by differences.
    let diagonal = moments.diagonal_covariance();
    for i in 0..3 {
        mean[4 * i] = d[i];
        for j in 0..3 {
            covariance[(4 * i, 4 * j)] = diagonal[(i, j)];
        }
    }
    (mean, covariance)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::distribution::matrix_fisher::MatrixFisher;
    use approx::assert_relative_eq;
    use nalgebra::{Matrix3, Vector3};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::Distribution;

    #[test]
    fn contractions_agree_with_samples() {
        let s = Vector3::new(6.0, 2.5, -1.0);
        let fisher = MatrixFisher::new(&Matrix3::from_diagonal(&s)).unwrap();
        let moments = CentralMoments::of(fisher.moments());
        let w = Vector9::from_fn(|i, _| ((3 * i + 1) % 7) as f64 - 3.0);
        let g = Matrix9::from_fn(|i, j| ((i * j + i + j) % 5) as f64 - 2.0);
        let sampler = fisher.sampler();
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let (mut weighted, mut quadratic) = (Matrix9::zeros(), Vector9::zeros());
        let samples = 400_000;
        for _ in 0..samples {
            let q = sampler.sample(&mut rng);
            let turned = fisher.centred(&q);
            let centred = Vector9::from_column_slice(turned.matrix().as_slice()) - moments.mean;
            weighted += centred * centred.transpose() * (w.dot(&centred) / samples as f64);
            quadratic += centred * (centred.dot(&(g * centred)) / samples as f64);
        }
        // The largest Monte Carlo standard deviation is about 0.006.
        assert_relative_eq!(moments.weighted(&w), weighted, epsilon = 0.025);
        assert_relative_eq!(moments.with_quadratic(&g), quadratic, epsilon = 0.025);
        assert!(moments.weighted(&w).amax() > 0.3 && moments.with_quadratic(&g).amax() > 0.3);
    }
}
