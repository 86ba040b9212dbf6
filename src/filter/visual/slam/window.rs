//! Cloned poses as blocks of the state.
//!
//! Between updates the error of a cloned pose is that of a pose in the belief: the rotation vector
//! `e` of `R_k exp(e^)` in body coordinates, and the position's in world coordinates. An update works
//! in the coordinates of its [`ErrorState`]; see [`JointState::with_clone_errors`].

use nalgebra::{DMatrix, DMatrixView, Isometry3, Matrix3, Matrix6, UnitQuaternion, Vector3};

use super::error_state::ErrorState;
use super::pose_clone::{CLONE, CloneErrors, PoseClone, clone_errors};
use super::state::{Block, JointState, NAVIGATION};
use super::track::{CloneId, ClonedPose};
use crate::inertial::{NavCovariance, block};
use crate::so3;

/// Derivative of three rows of a new pose's error by three of the state: the row of the former
/// in the pose, that of the latter in the state.
type CloneTerm = (usize, usize, Matrix3<f64>);

impl JointState {
    /// The slot of a pose of the window.
    pub fn clone_slot(&self, id: CloneId) -> Option<usize> {
        self.clones.binary_search_by_key(&id, |clone| clone.id).ok()
    }

    /// Takes a copy of the pose `later` seconds after the present one, to which the body moves as it
    /// does now, into the state, with the error that [`Self::clone_terms`] says. `None`, and no
    /// change, if it is not finite.
    pub fn clone_pose(&mut self, later: f64) -> Option<CloneId> {
        self.synchronize();
        let state = &self.belief.state;
        let turn = (self.measured_rate - state.gyro_bias) * later;
        let position = state.world_from_body.translation.vector + state.velocity * later;
        let rotation = state.world_from_body.rotation * UnitQuaternion::from_scaled_axis(turn);
        let terms = self.clone_terms(later, &turn);
        let mut rows = DMatrix::zeros(CLONE, self.covariance.ncols());
        for (to, from, by) in &terms {
            let mut part = rows.fixed_rows_mut::<3>(*to);
            part += by * self.covariance.fixed_rows::<3>(*from);
        }
        let mut own = Matrix6::zeros();
        for (to, from, by) in &terms {
            let mut part = own.fixed_columns_mut::<3>(*to);
            part += rows.fixed_columns::<3>(*from) * by.transpose();
        }
        let entries = position.iter().chain(rotation.coords.iter()).chain(rows.iter());
        if !entries.chain(own.iter()).all(|x| x.is_finite()) {
            return None;
        }
        let id = CloneId(self.clones_taken);
        self.clones_taken += 1;
        self.is_cloned = true;
        let world_from_body = Isometry3::from_parts(position.into(), rotation);
        self.insert_clone(PoseClone::new(id, world_from_body), &rows, &own);
        Some(id)
    }

    /// The pose of the window that is a copy of the present one.
    pub fn present_clone(&self) -> Option<CloneId> {
        self.clones.last().filter(|_| self.is_cloned).map(|clone| clone.id)
    }

    /// Adds a covariance to that of the body, and as much to its copy in the window; the covariance is
    /// up to date.
    pub fn inflate_present(&mut self, by: &NavCovariance) {
        let last = self.clones.len().saturating_sub(1);
        let copies = self.present_clone().map(|_| self.row(Block::Clone(last)));
        let copies =
            copies.into_iter().flat_map(|row| [(row, block::ROTATION), (row + 3, block::POSITION)]);
        let rows: Vec<(usize, usize)> =
            (0..NAVIGATION).step_by(3).map(|row| (row, row)).chain(copies).collect();
        for (to_row, row) in &rows {
            for (to_column, column) in &rows {
                let mut part = self.covariance.fixed_view_mut::<3, 3>(*to_row, *to_column);
                part += by.fixed_view::<3, 3>(*row, *column);
            }
        }
        self.renew_belief_covariance();
    }

    /// The error of a pose `R_k = R exp(w h)`, `p_k = p + v h`:
    ///
    /// `e_k = exp(-w h) e - h J_r(w h) e_bg + w e_tau`, `e_pk = e_p + h e_v + v e_tau`,
    ///
    /// `e_tau` that of the camera's clock where it is estimated, by which the pose was timed.
    fn clone_terms(&self, later: f64, turn: &Vector3<f64>) -> Vec<CloneTerm> {
        let by_turn = so3::exp(&-turn).into_inner();
        let by_bias = so3::right_jacobian(turn) * -later;
        let mut terms = vec![
            (0, block::ROTATION, by_turn),
            (0, block::GYRO_BIAS, by_bias),
            (3, block::POSITION, Matrix3::identity()),
            (3, block::VELOCITY, Matrix3::from_diagonal_element(later)),
        ];
        if self.calibration.is_some() {
            let motion = self.motion().beyond_noise();
            let column =
                |v: Vector3<f64>| Matrix3::from_columns(&[v, Vector3::zeros(), Vector3::zeros()]);
            let rotation = self.belief.state.world_from_body.rotation;
            let clock = self.row(Block::Calibration(2));
            terms.push((0, clock, column(motion.angular_velocity)));
            terms.push((3, clock, column(rotation * motion.velocity)));
        }
        terms
    }

    fn insert_clone(&mut self, clone: PoseClone, rows: &DMatrix<f64>, own: &Matrix6<f64>) {
        let row = self.row(Block::Clone(self.clones.len()));
        let after = rows.ncols() - row;
        self.augment(row, CLONE);
        let mut set = |column: usize, part: DMatrixView<'_, f64>| {
            let shape = (CLONE, part.ncols());
            self.covariance.view_mut((row, column), shape).copy_from(&part);
            let transposed = part.transpose();
            self.covariance.view_mut((column, row), (shape.1, CLONE)).copy_from(&transposed);
        };
        set(0, rows.columns(0, row).as_view());
        set(row + CLONE, rows.columns(row, after).as_view());
        let own = (own + own.transpose()) * 0.5;
        self.covariance.fixed_view_mut::<CLONE, CLONE>(row, row).copy_from(&own);
        self.clones.push(clone);
    }

    /// Marginalises a pose of the window out.
    pub fn remove_clone(&mut self, slot: usize) {
        let row = self.row(Block::Clone(slot));
        self.clones.remove(slot);
        let covariance = std::mem::take(&mut self.covariance);
        self.covariance =
            covariance.remove_fixed_rows::<CLONE>(row).remove_fixed_columns::<CLONE>(row);
    }

    /// A pose of the window.
    pub fn cloned_pose(&self, slot: usize) -> ClonedPose {
        let row = self.row(Block::Clone(slot));
        ClonedPose {
            world_from_body: self.clones[slot].world_from_body,
            covariance: self.covariance.fixed_view::<CLONE, CLONE>(row, row).into_owned(),
        }
    }

    /// The covariance with the errors of cloned poses in the coordinates of an update: where they
    /// are right-invariant `t_k` of `R_k = exp(t_k^) R^_k` and `u_k` of
    /// `p_k = exp(t_k^) p^_k + J(t_k) u_k`, to first order
    ///
    /// `t_k = R^_k e_k`, `u_k = e_pk + p^_k x t_k`.
    pub fn with_clone_errors(
        &self,
        error: ErrorState,
        mut covariance: DMatrix<f64>,
        direction: CloneErrors,
    ) -> DMatrix<f64> {
        if !error.is_invariant() {
            return covariance;
        }
        for (slot, clone) in self.clones.iter().enumerate() {
            let row = self.row(Block::Clone(slot));
            let by = clone_errors(&clone.world_from_body, direction);
            let rows = by * covariance.fixed_rows::<CLONE>(row);
            covariance.fixed_rows_mut::<CLONE>(row).copy_from(&rows);
            let columns = covariance.fixed_columns::<CLONE>(row) * by.transpose();
            covariance.fixed_columns_mut::<CLONE>(row).copy_from(&columns);
        }
        covariance
    }
}
