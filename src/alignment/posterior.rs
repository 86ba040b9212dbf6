//! The posterior of a pose without a prior, as a matrix Fisher-Gaussian distribution.

use nalgebra::{Const, Rotation3, Vector3};

use super::{MapEstimate, PointPair, PoseInformation, RobustKernel};
use crate::distribution::matrix_fisher_gaussian::{Correlation, MatrixFisherGaussian, MfgError};
use crate::distribution::regression::RotationRegression;
use crate::distribution::rotation_quadratic::{RotationMoments, RotationQuadraticError};
use crate::so3::{angle_between, proper_svd};

/// Times the weights of anisotropic measurements are renewed at most.
const MAX_RELINEARIZATIONS: usize = 20;
/// A mode that moves less than this needs no new weights, rad.
const SETTLED: f64 = 1e-6;

/// Why point pairs give no distribution of the pose.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum AlignmentError {
    /// Not one pair has finite coordinates and a positive definite covariance.
    #[error("no point pair with a positive definite covariance")]
    NoPoints,
    #[error(transparent)]
    Attitude(#[from] RotationQuadraticError),
    #[error(transparent)]
    Pose(#[from] MfgError),
    #[error(transparent)]
    Progressive(#[from] crate::distribution::progressive::ProgressiveError),
}

/// Distribution of the pose `(R, t)` of the body in the world, given point pairs.
#[derive(Debug, Clone)]
pub struct PosePosterior {
    /// World position that [`Self::density`] is relative to.
    pub origin: Vector3<f64>,
    /// Density of the attitude and the position relative to [`Self::origin`].
    pub density: RotationRegression<3>,
    /// Moments of the attitude.
    pub rotation: RotationMoments,
    /// The matrix Fisher-Gaussian distribution with these moments, relative to the origin of the
    /// world. The point estimates are the mode of its attitude and its `mu`.
    pub pose: MatrixFisherGaussian<Const<3>>,
}

/// The posterior of the pose (W22 tables 5.7 and 5.12 in one pass over the points).
///
/// Exact for isotropic measurement covariances, map covariances (`world_covariance`) included,
/// but for the projection of the density on an MFG; where `R A R^T + B` is isotropic for every
/// pair the attitude is matrix Fisher with
/// `F = sum w (p - p_c)(p' - p'_c)^T`, whose mode is the weighted Kabsch solution. Anisotropic
/// measurements enter with their weights at the mode. Points that do not determine the pose
/// (fewer than three, collinear) leave it broad. Pairs without a positive definite covariance are
/// left out.
///
/// ```
/// # use mfg_vio::alignment::{PointPair, align};
/// # use nalgebra::{Matrix3, Vector3};
/// let pair = |point: Vector3<f64>| PointPair {
///     in_body: point,
///     body_covariance: Matrix3::identity() * 0.01,
///     in_world: point + Vector3::x(),
///     world_covariance: Matrix3::zeros(),
/// };
/// let posterior = align(&[Vector3::x(), Vector3::y(), Vector3::z()].map(pair))?;
/// assert!(posterior.pose.attitude().mode().angle() < 1e-6);
/// assert!((posterior.pose.mu() - Vector3::x()).norm() < 0.02);
/// # Ok::<(), mfg_vio::alignment::AlignmentError>(())
/// ```
pub fn align(pairs: &[PointPair]) -> Result<PosePosterior, AlignmentError> {
    let origin = centroid(pairs).ok_or(AlignmentError::NoPoints)?;
    let mut attitude = isotropic_start(pairs, &origin);
    let mut previous: Option<Rotation3<f64>> = None;
    for _ in 0..MAX_RELINEARIZATIONS {
        let density = density(pairs, &attitude, &origin)?;
        let isotropic = pairs.iter().all(PointPair::is_isotropic_in_body);
        let (mode, _) = density.attitude.global_mode().ok_or(RotationQuadraticError::NotFinite)?;
        let settled = previous.is_some_and(|last| angle_between(&last, &mode) < SETTLED);
        (previous, attitude) = (Some(mode), mode);
        if isotropic || settled {
            return PosePosterior::new(origin, density);
        }
    }
    PosePosterior::new(origin, density(pairs, &attitude, &origin)?)
}

/// The density of the pose relative to `origin`, with the weights taken at `attitude`.
pub(super) fn density(
    pairs: &[PointPair],
    attitude: &Rotation3<f64>,
    origin: &Vector3<f64>,
) -> Result<RotationRegression<3>, AlignmentError> {
    let information = PoseInformation::accumulate(pairs, attitude, origin, RobustKernel::None);
    information.density().ok_or(AlignmentError::NoPoints)
}

/// Mean of the map points; `None` unless it is finite.
pub(super) fn centroid(pairs: &[PointPair]) -> Option<Vector3<f64>> {
    let sum: Vector3<f64> = pairs.iter().map(|pair| pair.in_world).sum();
    let mean = sum / pairs.len() as f64;
    mean.iter().all(|x| x.is_finite()).then_some(mean)
}

/// The most probable attitude for the mean variance of each pair in place of its covariance.
fn isotropic_start(pairs: &[PointPair], origin: &Vector3<f64>) -> Rotation3<f64> {
    let isotropic = |pair: &PointPair| {
        let variance = (pair.body_covariance.trace() + pair.world_covariance.trace()) / 3.0;
        PointPair {
            body_covariance: nalgebra::Matrix3::identity() * variance,
            world_covariance: nalgebra::Matrix3::zeros(),
            ..*pair
        }
    };
    let pairs: Vec<PointPair> = pairs.iter().map(isotropic).collect();
    density(&pairs, &Rotation3::identity(), origin)
        .ok()
        .and_then(|density| density.attitude.as_matrix_fisher())
        .and_then(|f| proper_svd(&f).ok())
        .map_or_else(Rotation3::identity, |svd| svd.rotation())
}

impl PosePosterior {
    /// The distribution with the given density of attitude and position relative to `origin`.
    pub(super) fn new(
        origin: Vector3<f64>,
        density: RotationRegression<3>,
    ) -> Result<Self, AlignmentError> {
        let rotation = density.attitude.moments()?;
        let absolute = RotationRegression { offset: density.offset + origin, ..density };
        let pose = absolute.to_mfg(&rotation, Correlation::World)?;
        Ok(Self { origin, density, rotation, pose })
    }

    /// Mean and covariance of the world position of a point that is fixed in the body.
    pub fn world_point(&self, in_body: &Vector3<f64>) -> MapEstimate {
        let (position, covariance) = self.density.point_moments(&self.rotation, 0, in_body);
        MapEstimate { position: self.origin + position, covariance }
    }

    /// Posterior of the map point of one of the pairs (W22 theorem 5.8).
    pub fn map_point(&self, pair: &PointPair) -> Option<MapEstimate> {
        MapEstimate::posterior(pair, &self.pose.attitude().mode(), &self.world_point(&pair.in_body))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::alignment::{LeastSquaresConfig, WeightedPair, optimize_pose, weighted_kabsch};
    use crate::distribution::rotation_quadratic::vectorize;
    use crate::so3::HaarQuadrature;
    use approx::assert_relative_eq;
    use nalgebra::{Matrix3, SMatrix};
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn random_vector(rng: &mut ChaCha8Rng, scale: f64) -> Vector3<f64> {
        Vector3::from_fn(|_, _| rng.random_range(-scale..scale))
    }

    fn covariance(rng: &mut ChaCha8Rng, sd: f64) -> Matrix3<f64> {
        let root = Matrix3::from_fn(|_, _| rng.random_range(-sd..sd));
        root * root.transpose() + Matrix3::identity() * (0.3 * sd).powi(2)
    }

    /// Pairs seen from a pose, body and map covariances as given.
    fn pairs(
        rng: &mut ChaCha8Rng,
        count: usize,
        sd: f64,
        covariances: impl Fn(&mut ChaCha8Rng) -> (Matrix3<f64>, Matrix3<f64>),
    ) -> Vec<PointPair> {
        let rotation = Rotation3::new(random_vector(rng, 1.5));
        let position = random_vector(rng, 20.0);
        let mut pair = || {
            let in_world = position + random_vector(rng, 1.0);
            let (body_covariance, world_covariance) = covariances(rng);
            let in_body = rotation.inverse() * (in_world - position) + random_vector(rng, sd);
            PointPair { in_body, body_covariance, in_world, world_covariance }
        };
        (0..count).map(|_| pair()).collect()
    }

    /// `E[R]`, `E[t]`, `Cov[t]` by quadrature over SO(3), `t` in closed form at each attitude.
    fn by_brute_force(pairs: &[PointPair]) -> (Matrix3<f64>, Vector3<f64>, Matrix3<f64>) {
        let origin = centroid(pairs).unwrap();
        let mut values = Vec::new();
        for (r, weight) in HaarQuadrature::of_degree(50).nodes() {
            let information = PoseInformation::accumulate(pairs, r, &origin, RobustKernel::None);
            let density = information.density().unwrap();
            let t = density.offset + density.slope * vectorize(r.matrix());
            let cost = information.cost(r, &(origin + t));
            values.push((*r, t, density.covariance, cost, *weight));
        }
        let least = values.iter().map(|v| v.3).fold(f64::INFINITY, f64::min);
        let (mut total, mut mean_r) = (0.0, Matrix3::zeros());
        let (mut mean, mut second) = (Vector3::zeros(), Matrix3::zeros());
        for (r, t, spread, cost, weight) in values {
            let weight = weight * (-0.5 * (cost - least)).exp() * spread.determinant().sqrt();
            total += weight;
            mean_r += r.matrix() * weight;
            mean += t * weight;
            second += (t * t.transpose() + spread) * weight;
        }
        let mean = mean / total;
        (mean_r / total, origin + mean, second / total - mean * mean.transpose())
    }

    #[test]
    fn isotropic_posteriors_are_exact() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for count in [1, 2, 3, 8] {
            let pairs = pairs(&mut rng, count, 0.5, |rng| {
                let variances = [rng.random_range(0.05..0.6), rng.random_range(0.0..0.6)];
                (Matrix3::identity() * variances[0], Matrix3::identity() * variances[1])
            });
            let found = align(&pairs).unwrap();
            let (rotation, position, spread) = by_brute_force(&pairs);
            assert_relative_eq!(found.pose.attitude().mean(), rotation, epsilon = 1e-6);
            assert_relative_eq!(*found.pose.mu(), position, epsilon = 1e-6);
            assert_relative_eq!(found.pose.moments().covariance, spread, epsilon = 1e-6);
        }
    }

    /// Anisotropic map points keep the likelihood quadratic in `vec R`.
    #[test]
    fn anisotropic_maps_are_exact_too() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        for count in [2, 5] {
            let pairs = pairs(&mut rng, count, 0.5, |rng| {
                (Matrix3::identity() * 0.1, covariance(rng, 0.6))
            });
            let found = align(&pairs).unwrap();
            let (rotation, position, spread) = by_brute_force(&pairs);
            assert_relative_eq!(found.pose.attitude().mean(), rotation, epsilon = 1e-5);
            assert_relative_eq!(*found.pose.mu(), position, epsilon = 1e-5);
            // The MFG has it only where the attitude is matrix Fisher.
            let (_, covariance, _) = found.density.vector_moments(&found.rotation);
            assert_relative_eq!(covariance, spread, epsilon = 1e-5);
        }
    }

    #[test]
    fn with_anisotropic_measurements_the_mode_is_that_of_least_squares() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let pairs = pairs(&mut rng, 30, 0.02, |rng| (covariance(rng, 0.05), covariance(rng, 0.02)));
        let found = align(&pairs).unwrap();
        let weighted = pairs.iter().map(|pair| WeightedPair {
            from: pair.in_body,
            to: pair.in_world,
            weight: 1.0,
        });
        let start = weighted_kabsch(weighted).unwrap();
        let optimum = optimize_pose(
            &pairs,
            &start.rotation.to_rotation_matrix(),
            &start.translation.vector,
            &LeastSquaresConfig::default(),
        )
        .unwrap();
        assert!(found.pose.attitude().mode().angle_to(&optimum.rotation) < 1e-4);
        let covariance = optimum.covariance().unwrap();
        let attitude = found.pose.attitude().rotation_covariance();
        let rivals = covariance.fixed_view::<3, 3>(0, 0).into_owned();
        assert!((attitude - rivals).norm() < 0.05 * rivals.norm());
        let spread = found.pose.moments().covariance;
        let rivals = covariance.fixed_view::<3, 3>(3, 3).into_owned();
        assert!((spread - rivals).norm() < 0.05 * rivals.norm());
    }

    /// Theorem 5.8 against samples of the joint posterior.
    #[test]
    fn map_points_have_their_posterior_moments() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let pairs = pairs(&mut rng, 4, 0.4, |rng| {
            (Matrix3::identity() * 0.2, Matrix3::identity() * rng.random_range(0.1..0.9))
        });
        let found = align(&pairs).unwrap();
        let sampler = found.pose.attitude().sampler();
        let root = found.density.covariance.cholesky().unwrap().l();
        let pair = &pairs[0];
        let gain = pair.world_covariance
            * (pair.body_covariance + pair.world_covariance).try_inverse().unwrap();
        let rest = ((Matrix3::identity() - gain) * pair.world_covariance).cholesky().unwrap().l();
        let mut normal = {
            use rand_distr::Distribution;
            let mut rng = ChaCha8Rng::seed_from_u64(5);
            move || Vector3::from_fn(|_, _| rand_distr::StandardNormal.sample(&mut rng))
        };
        let n = 20_000;
        let (mut mean, mut second) = (Vector3::zeros(), Matrix3::zeros());
        for _ in 0..n {
            use rand_distr::Distribution;
            let r: Rotation3<f64> = sampler.sample(&mut rng);
            let t = found.origin
                + found.density.offset
                + found.density.slope * vectorize(r.matrix())
                + root * normal();
            let seen = r * pair.in_body + t;
            let point =
                pair.in_world + gain * (seen - pair.in_world) + rest * normal() - found.origin;
            mean += point / f64::from(n);
            second += point * point.transpose() / f64::from(n);
        }
        let estimate = found.map_point(pair).unwrap();
        assert!((estimate.position - found.origin - mean).norm() < 0.02);
        let sampled = second - mean * mean.transpose();
        assert!((estimate.covariance - sampled).norm() < 0.05 * sampled.norm());
    }

    #[test]
    fn degenerate_points_leave_a_broad_belief() {
        let pair = |in_body: Vector3<f64>| PointPair {
            in_body,
            body_covariance: Matrix3::identity() * 1e-4,
            in_world: in_body + Vector3::new(100.0, 0.0, 0.0),
            world_covariance: Matrix3::zeros(),
        };
        let line: Vec<_> =
            (0..9).map(|i| pair(Vector3::new(1.0, 2.0, -1.0) * f64::from(i))).collect();
        let plane: Vec<_> =
            (0..9).map(|i| pair(Vector3::new(f64::from(i % 3), f64::from(i / 3), 0.0))).collect();
        let s = |pairs: &[PointPair]| align(pairs).unwrap().pose.attitude().svd().s;
        assert_relative_eq!(s(&line[..1]), Vector3::zeros(), epsilon = 1e-9);
        for pairs in [&line[..], &line[..2]] {
            let s = s(pairs);
            assert!(s[0] > 1e4 && (s[1] + s[2]).abs() < 1e-6 * s[0], "{s}");
        }
        let s = s(&plane);
        assert!(s[1] + s[2] > 1e4, "{s}");
        assert_eq!(align(&[]).err(), Some(AlignmentError::NoPoints));
        let broken = PointPair { in_body: Vector3::repeat(f64::NAN), ..pair(Vector3::x()) };
        assert!(align(&[broken]).is_err());
        let singular = PointPair { body_covariance: SMatrix::zeros(), ..pair(Vector3::x()) };
        assert_eq!(align(&[singular]).err(), Some(AlignmentError::NoPoints));
    }
}
