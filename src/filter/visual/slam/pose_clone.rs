//! A cloned pose by itself.

use nalgebra::{Isometry3, Matrix6, UnitQuaternion, Vector3};

use super::error_state::ErrorState;
use super::track::CloneId;
use crate::so3;

/// Rows of a cloned pose: rotation, then position.
pub(super) const CLONE: usize = 6;

/// A past pose of the body as part of the state.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct PoseClone {
    pub id: CloneId,
    pub world_from_body: Isometry3<f64>,
    /// Track and camera of the rows at this pose that have been used, ascending.
    used: Vec<(u64, usize)>,
}

impl PoseClone {
    pub fn new(id: CloneId, world_from_body: Isometry3<f64>) -> Self {
        Self { id, world_from_body, used: Vec::new() }
    }

    pub fn has_used(&self, track: u64, camera: usize) -> bool {
        self.used.binary_search(&(track, camera)).is_ok()
    }

    pub fn mark_used(&mut self, track: u64, camera: usize) {
        if let Err(place) = self.used.binary_search(&(track, camera)) {
            self.used.insert(place, (track, camera));
        }
    }

    /// Moves the pose by a change of its error in the coordinates of `error`.
    pub fn shift(&mut self, error: ErrorState, turn: &Vector3<f64>, shift: &Vector3<f64>) {
        let pose = &mut self.world_from_body;
        let by = UnitQuaternion::from_scaled_axis(*turn);
        let position = &mut pose.translation.vector;
        let rotation = if error.is_invariant() {
            *position = by * *position + so3::left_jacobian(turn) * shift;
            by * pose.rotation
        } else {
            *position += shift;
            pose.rotation * by
        };
        pose.rotation = UnitQuaternion::new_normalize(rotation.into_inner());
    }
}

/// Direction of a change of coordinates.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum CloneErrors {
    /// From those between updates to those of an update.
    ForUpdate,
    /// And back.
    Stored,
}

/// Derivative of the error of a pose in one kind of coordinates by that in the other.
pub(super) fn clone_errors(pose: &Isometry3<f64>, direction: CloneErrors) -> Matrix6<f64> {
    let rotation = pose.rotation.to_rotation_matrix().into_inner();
    let lever = pose.translation.vector.cross_matrix();
    let (turn, position) = match direction {
        CloneErrors::ForUpdate => (rotation, lever * rotation),
        CloneErrors::Stored => (rotation.transpose(), -lever),
    };
    let mut by = Matrix6::identity();
    by.fixed_view_mut::<3, 3>(0, 0).copy_from(&turn);
    by.fixed_view_mut::<3, 3>(3, 0).copy_from(&position);
    by
}
