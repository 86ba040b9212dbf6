use nalgebra::{Matrix3, Rotation3, Vector3};

use super::PointPair;

/// Position of a map point and its covariance, world coordinates (m, m^2).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapEstimate {
    pub position: Vector3<f64>,
    pub covariance: Matrix3<f64>,
}

impl MapEstimate {
    /// Posterior of the map point of `pair` when the posterior of the pose puts the measured
    /// point, taken as exact, at `seen`: with `K = B (R A R^T + B)^-1`
    ///
    /// `E[p] = (I - K) p + K E[R p' + t]`, `Cov[p] = (I - K) B + K Cov[R p' + t] K^T`,
    ///
    /// which is W22 theorem 5.8 and (G.6)-(G.8) without their sums over pairs of points. `None`
    /// if `R A R^T + B` is singular.
    pub fn posterior(
        pair: &PointPair,
        world_from_body: &Rotation3<f64>,
        seen: &MapEstimate,
    ) -> Option<Self> {
        let gain = pair.world_covariance * pair.weight(world_from_body.matrix())?.matrix();
        let covariance = (Matrix3::identity() - gain) * pair.world_covariance
            + gain * seen.covariance * gain.transpose();
        Some(Self {
            position: pair.in_world + gain * (seen.position - pair.in_world),
            covariance: (covariance + covariance.transpose()) * 0.5,
        })
    }
}
