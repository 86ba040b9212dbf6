//! The progressive sigma-point update of a matrix Fisher distribution (W22 tables 5.2, 5.6, 5.8).

use nalgebra::Rotation3;

use super::matrix_fisher::MatrixFisher;
use super::unscented::{UnscentedError, WeightedRotation, bingham_points, mean_rotation};

/// Settings of [`progressive_update`]. The paper does not print its values; the default has those
/// of the program that its author published with the filter of section 5.1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProgressiveConfig {
    /// Smallest ratio `tau` of two likelihoods within one step, in (0, 1).
    pub least_ratio: f64,
    /// Share of its weight that the central sigma point keeps, in (0, 1]; it decides how much a
    /// likelihood adds to the concentration, see [`progressive_update`].
    pub central_share: f64,
    /// Steps before giving up.
    pub max_steps: usize,
}

impl Default for ProgressiveConfig {
    fn default() -> Self {
        Self { least_ratio: 0.3, central_share: 0.1, max_steps: 1000 }
    }
}

/// Why a progressive update gives no distribution.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum ProgressiveError {
    #[error(transparent)]
    Points(#[from] UnscentedError),
    #[error("the logarithm of the likelihood is not finite at a sigma point")]
    NotFinite,
    #[error("the likelihood was not used up after {0} steps")]
    Steps(usize),
}

/// The matrix Fisher distribution that seven sigma points make of `prior` times a likelihood.
///
/// The likelihood is applied in powers so small that no two points differ by more than
/// `least_ratio`; after each, new points are chosen from the mean of the old ones.
///
/// The points lie on the principal axes, so that correlations that the likelihood makes between
/// rotations about them are not seen, and their fourth moments are not those of the distribution.
/// For small angles, short steps, a variance `v` about each axis and a likelihood of information
/// `h`, points at `a^2 = v/w` with the weight `w = (1 - central_share)/3` a pair change the
/// variance by
///
/// ```text
/// dv/dlambda = -(h/2) Cov[x_i^2, |x|^2] = -k h v^2,    k = (1/w - 3)/2.
/// ```
///
/// So `k h` is added to the information `1/v` instead of `h`, and of the distance to the optimum
/// remains `(1 + k h v)^(-1/k)` instead of `1/(1 + h v)`. A `central_share` of 0.4 has `k = 1`; the
/// default has `k = 1/6` and comes out too broad.
pub fn progressive_update(
    prior: &MatrixFisher,
    log_likelihood: impl Fn(&Rotation3<f64>) -> f64,
    config: &ProgressiveConfig,
) -> Result<MatrixFisher, ProgressiveError> {
    let mut mean = prior.mean();
    let mut remaining = 1.0;
    for _ in 0..config.max_steps {
        let mut points = bingham_points(&mean, config.central_share)?;
        let logs = points.map(|point| log_likelihood(&point.attitude));
        if !logs.iter().all(|log| log.is_finite()) {
            return Err(ProgressiveError::NotFinite);
        }
        let highest = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let lowest = logs.iter().copied().fold(f64::INFINITY, f64::min);
        let power = remaining_or(-config.least_ratio.ln() / (highest - lowest), remaining);
        reweight(&mut points, &logs.map(|log| power * (log - highest)));
        mean = mean_rotation(&points);
        remaining -= power;
        if remaining <= 0.0 {
            return Ok(MatrixFisher::from_mean(&mean).map_err(UnscentedError::from)?);
        }
    }
    Err(ProgressiveError::Steps(config.max_steps))
}

/// The power of the next step, which is all that remains where the points hardly differ.
fn remaining_or(power: f64, remaining: f64) -> f64 {
    if power < remaining { power } else { remaining }
}

fn reweight(points: &mut [WeightedRotation; 7], log_factors: &[f64; 7]) {
    for (point, log_factor) in points.iter_mut().zip(log_factors) {
        point.weight *= log_factor.exp();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix3, Vector3};

    /// The law of [`progressive_update`].
    #[test]
    fn seven_points_add_a_multiple_of_the_information() {
        let (s, ratio) = (1e5, 2.0);
        let prior = MatrixFisher::new(&(Matrix3::identity() * s)).unwrap();
        let turn = Rotation3::new(Vector3::new(1e-3, -5e-4, 2e-3));
        let likelihood = turn.matrix() * (ratio * s);
        for (central_share, k) in [(0.1, 1.0 / 6.0), (0.4, 1.0), (0.5, 1.5)] {
            let config = ProgressiveConfig { least_ratio: 0.99, central_share, max_steps: 100_000 };
            let found =
                progressive_update(&prior, |r| likelihood.dot(r.matrix()), &config).unwrap();
            let remaining = found.mode().angle_to(&turn) / turn.angle();
            let expected = (1.0 + k * ratio).powf(-1.0 / k);
            assert!((remaining / expected - 1.0).abs() < 0.02, "{k}: {remaining} {expected}");
            let gain = (found.svd().s.mean() / s - 1.0) / ratio;
            assert!((gain / k - 1.0).abs() < 0.02, "{k}: {gain}");
        }
    }

    /// Where the exact posterior is matrix Fisher, the points that add the right information find
    /// it but for its principal axes.
    #[test]
    fn a_share_of_two_fifths_comes_near_the_product_of_two_distributions() {
        let prior = MatrixFisher::new(&Matrix3::from_diagonal(&Vector3::new(9.0, 6.0, 4.0)));
        let turn = Rotation3::new(Vector3::new(0.04, -0.02, 0.06));
        let likelihood = turn.matrix() * Matrix3::from_diagonal(&Vector3::new(20.0, 15.0, 12.0));
        let prior = prior.unwrap();
        let exact = MatrixFisher::new(&(prior.parameter() + likelihood)).unwrap();
        let config =
            ProgressiveConfig { least_ratio: 0.9, central_share: 0.4, ..Default::default() };
        let found = progressive_update(&prior, |r| likelihood.dot(r.matrix()), &config).unwrap();
        let moved = prior.mode().angle_to(&exact.mode());
        let apart = found.mode().angle_to(&exact.mode()) / moved;
        let ratio = found.svd().s.component_div(&exact.svd().s);
        assert!(apart < 0.03 && ratio.add_scalar(-1.0).amax() < 0.05, "{apart} {ratio}");
    }

    #[test]
    fn a_flat_likelihood_changes_nothing_and_a_broken_one_is_refused() {
        let prior = MatrixFisher::new(&Matrix3::from_diagonal_element(3.0)).unwrap();
        let config = ProgressiveConfig::default();
        let same = progressive_update(&prior, |_| 7.0, &config).unwrap();
        assert!((same.parameter() - prior.parameter()).norm() < 1e-9);
        let broken = progressive_update(&prior, |_| f64::NAN, &config);
        assert_eq!(broken.err(), Some(ProgressiveError::NotFinite));
    }
}
