//! Map points seen from an uncertain pose: how they are measured, inserted and refined.

use nalgebra::{Matrix3, Matrix6, Rotation3, SMatrix, Vector3};

use super::body_points::BodyPoints;
use super::config::MapTreatment;
use crate::alignment::{MapEstimate, PointPair, PoseInformation};
use crate::filter::core::FilterError;
use crate::inertial::{Belief, pose_covariance};

/// A new map point from its measurement in body coordinates (m, m^2), by W22 (5.84), (5.85):
/// `E[l] = E[R p' + p]`, `Cov[l] = Cov[R p' + p] + R A R^T`.
///
/// For [`MapTreatment::Fixed`] the covariance is that of the measurement alone.
pub(super) fn insert(
    belief: &Belief,
    body_points: &BodyPoints,
    treatment: MapTreatment,
    in_body: &Vector3<f64>,
    body_covariance: &Matrix3<f64>,
) -> MapEstimate {
    let rotation = belief.state.world_from_body.rotation.to_rotation_matrix();
    let measured = rotation.matrix() * body_covariance * rotation.matrix().transpose();
    let seen = body_points.at(in_body);
    let covariance = match treatment {
        MapTreatment::Fixed => measured,
        MapTreatment::Uncertain | MapTreatment::Correlated => measured + seen.covariance,
    };
    MapEstimate { position: seen.position, covariance }
}

/// Posteriors of map points given one pose, see [`MapEstimate::posterior`].
#[derive(Debug, Clone, Copy)]
pub struct MapRefinement {
    world_from_body: Rotation3<f64>,
    seen: BodyPoints,
}

impl MapRefinement {
    /// By the pose of a belief, which has points fixed in the body where `seen` says.
    pub(super) fn new(belief: &Belief, seen: BodyPoints) -> Self {
        let world_from_body = belief.state.world_from_body.rotation.to_rotation_matrix();
        Self { world_from_body, seen }
    }

    /// Posterior of the map point of `pair`; `None` if the pair has no positive definite
    /// covariance.
    pub fn posterior(&self, pair: &PointPair) -> Option<MapEstimate> {
        MapEstimate::posterior(pair, &self.world_from_body, &self.seen.at(&pair.in_body))
    }
}

/// Derivative of `R p' + t` by (body-frame rotation error, position): `[-R p'^, I]`, 3x6.
pub fn point_by_pose(rotation: &Matrix3<f64>, in_body: &Vector3<f64>) -> SMatrix<f64, 3, 6> {
    let mut j = SMatrix::<f64, 3, 6>::zeros();
    j.fixed_view_mut::<3, 3>(0, 0).copy_from(&-(rotation * in_body.cross_matrix()));
    j.fixed_view_mut::<3, 3>(0, 3).copy_from(&Matrix3::identity());
    j
}

/// Normalised innovation squared per degree of freedom of `information` against the prior:
/// `(r^T W r - b^T P (I + Lambda P)^-1 b) / 3N`, the matrix inversion lemma's form of
/// `r^T (W^-1 + H P H^T)^-1 r`, so that it costs the same for any number of points.
pub(super) fn normalized_innovation_squared(
    information: &PoseInformation,
    belief: &Belief,
) -> Result<f64, FilterError> {
    let pose = &belief.state.world_from_body;
    let rotation = pose.rotation.to_rotation_matrix();
    let (lambda, vector) = information.linearized(&rotation);
    let prior = pose_covariance(&belief.covariance);
    let inner = (Matrix6::identity() + lambda * prior).lu().solve(&vector);
    let explained = prior * inner.ok_or(FilterError::NotPositive("innovation covariance"))?;
    let total = information.cost(&rotation, &pose.translation.vector);
    let dof = 3.0 * information.points as f64;
    Ok((total - vector.dot(&explained)).max(0.0) / dof)
}
