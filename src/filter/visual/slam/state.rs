//! The error state: which rows are whose, the joint covariance, and what may be done to both.
//!
#![doc = include_str!("../../../../docs/theory/state.md")]
#![doc = include_str!("../../../../docs/math.html")]

use std::ops::Range;

use nalgebra::{
    DMatrix, DVector, Dyn, Isometry3, Matrix3, OMatrix, Point3, U3, UnitQuaternion, Vector3,
};

use super::error_state::{BIASES, ErrorState};
use super::gravity::UnknownGravity;
use super::pose_clone::{CLONE, PoseClone};
use crate::filter::visual::calibration::{BodyMotion, CALIBRATION_BLOCKS, Calibration};
use crate::filter::visual::estimator::PoseSpread;
use crate::inertial::{Belief, NavCovariance, block};

/// Size of the navigation part of the state.
pub(super) const NAVIGATION: usize = 15;

/// A part of the error state that follows the navigation part (see [`crate::inertial::block`]): three
/// rows of the covariance.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Block {
    Gravity,
    /// The camera's rotation, translation and, in the first row, clock offset.
    Calibration(usize),
    /// A cloned pose, by its place in the window: three rows of its rotation, three of its position.
    Clone(usize),
    /// A map point, by its place in the order of admission.
    Point(usize),
}

/// A map point of the state.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct StatePoint {
    pub id: u64,
    /// World coordinates, m.
    pub position: Vector3<f64>,
}

/// Mean and covariance of navigation part, gravity and calibration (where they are estimated),
/// cloned poses and map points, in this order.
#[derive(Debug, Clone)]
pub(super) struct JointState {
    pub belief: Belief,
    /// The window of past poses, in the order of their rows, oldest first.
    pub clones: Vec<PoseClone>,
    /// How many poses have been cloned so far.
    pub clones_taken: u64,
    /// Whether the last of them is a copy of the present pose.
    pub is_cloned: bool,
    /// In the order of their rows.
    pub points: Vec<StatePoint>,
    /// Its navigation rows and columns date from the last update; [`Self::synchronize`] brings them
    /// up to date.
    pub covariance: DMatrix<f64>,
    /// Derivative of the navigation error now by that at the last update.
    pub transition: NavCovariance,
    /// Gravity, until its direction is known well enough for the world to be turned upright.
    pub gravity: Option<UnknownGravity>,
    /// The camera's calibration, if it is uncertain. Its covariance is that of the last update.
    pub calibration: Option<Calibration>,
    /// Angular velocity as last measured, rad/s.
    pub measured_rate: Vector3<f64>,
}

impl JointState {
    pub fn new(belief: Belief, points: usize) -> Self {
        Self {
            belief,
            clones: Vec::new(),
            clones_taken: 0,
            is_cloned: false,
            points: Vec::with_capacity(points),
            covariance: DMatrix::from_fn(NAVIGATION, NAVIGATION, |i, j| belief.covariance[(i, j)]),
            transition: NavCovariance::identity(),
            gravity: None,
            calibration: None,
            measured_rate: Vector3::zeros(),
        }
    }

    /// First row of a block; of one that is not part of the state, where it would be.
    pub fn row(&self, block: Block) -> usize {
        let after_gravity = NAVIGATION + if self.gravity.is_some() { 3 } else { 0 };
        let calibration = if self.calibration.is_some() { 3 * CALIBRATION_BLOCKS } else { 0 };
        match block {
            Block::Gravity => NAVIGATION,
            Block::Calibration(k) => after_gravity + 3 * k,
            Block::Clone(slot) => after_gravity + calibration + CLONE * slot,
            Block::Point(slot) => {
                after_gravity + calibration + CLONE * self.clones.len() + 3 * slot
            }
        }
    }

    /// Index of a block among those of the Euclidean part, which is all but the rotation.
    pub fn euclidean_index(&self, block: Block) -> usize {
        self.row(block) / 3 - 1
    }

    pub fn calibration_rows(&self) -> Range<usize> {
        self.row(Block::Calibration(0))..self.row(Block::Clone(0))
    }

    /// Blocks of the Euclidean part that are no vectors of the world: calibration and cloned poses.
    pub fn unturned_blocks(&self) -> Range<usize> {
        self.euclidean_index(Block::Calibration(0))..self.euclidean_index(Block::Point(0))
    }

    /// Whether a block of the Euclidean part is a vector of the world.
    pub fn turns(&self, block: usize) -> bool {
        !BIASES.contains(&block) && !self.unturned_blocks().contains(&block)
    }

    pub fn slot(&self, id: u64) -> Option<usize> {
        self.points.iter().position(|point| point.id == id)
    }

    /// Mean of the Euclidean part in the order of the covariance's rows after the rotation; that of
    /// the error for poses.
    pub fn euclidean(&self) -> Vec<Vector3<f64>> {
        let state = &self.belief.state;
        let mut blocks = vec![Vector3::zeros(); NAVIGATION / 3 - 1];
        blocks[block::VELOCITY / 3 - 1] = state.velocity;
        blocks[block::POSITION / 3 - 1] = state.world_from_body.translation.vector;
        blocks[block::GYRO_BIAS / 3 - 1] = state.gyro_bias;
        blocks[block::ACCEL_BIAS / 3 - 1] = state.accel_bias;
        blocks.extend(self.gravity.as_ref().map(|gravity| gravity.mean));
        blocks.extend(self.calibration.iter().flat_map(Calibration::blocks));
        blocks.extend(std::iter::repeat_n(Vector3::zeros(), CLONE / 3 * self.clones.len()));
        blocks.extend(self.points.iter().map(|point| point.position));
        blocks
    }

    pub fn motion(&self) -> BodyMotion {
        let state = &self.belief.state;
        BodyMotion {
            angular_velocity: self.measured_rate - state.gyro_bias,
            velocity: state.world_from_body.rotation.inverse() * state.velocity,
        }
    }

    /// Carries the correlations of the navigation part with all else to the present.
    pub fn synchronize(&mut self) {
        let n = self.covariance.ncols() - NAVIGATION;
        let mut cross = self.transition * self.covariance.view((0, NAVIGATION), (NAVIGATION, n));
        if let Some(gravity) = &mut self.gravity {
            cross += gravity.transition * self.covariance.view((NAVIGATION, NAVIGATION), (3, n));
            gravity.transition.fill(0.0);
        }
        self.covariance.view_mut((0, NAVIGATION), (NAVIGATION, n)).copy_from(&cross);
        self.covariance.view_mut((NAVIGATION, 0), (n, NAVIGATION)).copy_from(&cross.transpose());
        self.covariance
            .view_mut((0, 0), (NAVIGATION, NAVIGATION))
            .copy_from(&self.belief.covariance);
        self.transition = NavCovariance::identity();
    }

    /// Takes the navigation part of the covariance for that of the belief.
    pub fn renew_belief_covariance(&mut self) {
        self.belief.covariance =
            self.covariance.fixed_view::<NAVIGATION, NAVIGATION>(0, 0).into_owned();
    }

    /// Makes room for `rows` that are independent of all else, their covariance zero.
    pub fn augment(&mut self, row: usize, rows: usize) {
        let covariance = std::mem::take(&mut self.covariance);
        self.covariance = covariance.insert_rows(row, rows, 0.0).insert_columns(row, rows, 0.0);
    }

    /// Adds a point whose covariance with the state is `rows`. False, and no change, if it is not
    /// finite.
    pub fn append(
        &mut self,
        point: StatePoint,
        rows: &OMatrix<f64, U3, Dyn>,
        own: &Matrix3<f64>,
    ) -> bool {
        let values = point.position.iter().chain(rows.iter()).chain(own.iter());
        if !values.into_iter().all(|x| x.is_finite()) {
            return false;
        }
        let n = self.covariance.ncols();
        let mut covariance = std::mem::take(&mut self.covariance).resize(n + 3, n + 3, 0.0);
        covariance.view_mut((n, 0), (3, n)).copy_from(rows);
        covariance.view_mut((0, n), (n, 3)).copy_from(&rows.transpose());
        covariance.view_mut((n, n), (3, 3)).copy_from(&((own + own.transpose()) * 0.5));
        self.covariance = covariance;
        self.points.push(point);
        true
    }

    /// Marginalises a point out.
    pub fn remove(&mut self, slot: usize) {
        let row = self.row(Block::Point(slot));
        self.points.remove(slot);
        let covariance = std::mem::take(&mut self.covariance);
        self.covariance = covariance.remove_fixed_rows::<3>(row).remove_fixed_columns::<3>(row);
    }

    /// Derivative of a point of the world as measured in the body by the blocks of the
    /// calibration.
    pub fn by_calibration(
        &self,
        point: &Vector3<f64>,
    ) -> Option<[Matrix3<f64>; CALIBRATION_BLOCKS]> {
        let pose = &self.belief.state.world_from_body;
        let in_body = pose.inverse_transform_point(&Point3::from(*point)).coords;
        Some(self.calibration.as_ref()?.derivatives(&in_body, &self.motion()))
    }

    /// The covariance with points as the camera sees them in place of points of the world
    /// (`sign` -1), or back (1): they differ by what the calibration moves them.
    pub fn with_camera(&self, mut covariance: DMatrix<f64>, sign: f64) -> DMatrix<f64> {
        let rotation = self.belief.state.world_from_body.rotation.to_rotation_matrix();
        let calibration = self.calibration_rows();
        for (slot, point) in self.points.iter().enumerate() {
            let (row, Some(by_calibration)) =
                (self.row(Block::Point(slot)), self.by_calibration(&point.position))
            else {
                continue;
            };
            for (from, by_block) in calibration.clone().step_by(3).zip(by_calibration) {
                let by_block = rotation * by_block * sign;
                let moved = by_block * covariance.fixed_rows::<3>(from);
                let mut rows = covariance.fixed_rows_mut::<3>(row);
                rows += moved;
                let moved = covariance.fixed_columns::<3>(from) * by_block.transpose();
                let mut columns = covariance.fixed_columns_mut::<3>(row);
                columns += moved;
            }
        }
        covariance
    }

    /// Turns everything in world coordinates; the covariance is up to date.
    pub fn turn_world(&mut self, turn: &UnitQuaternion<f64>) {
        let matrix = turn.to_rotation_matrix().into_inner();
        let (calibration, clones) = (self.calibration_rows(), self.row(Block::Clone(0)));
        let points = self.row(Block::Point(0));
        let turns = |row: &usize| {
            let of_pose = (clones..points).contains(row);
            !(calibration.contains(row) || of_pose && (row - clones).is_multiple_of(CLONE))
        };
        let world_blocks = [block::VELOCITY, block::POSITION]
            .into_iter()
            .chain((NAVIGATION..self.covariance.ncols()).step_by(3))
            .filter(turns);
        for row in world_blocks {
            let rows = matrix * self.covariance.rows(row, 3);
            self.covariance.rows_mut(row, 3).copy_from(&rows);
            let columns = self.covariance.columns(row, 3) * matrix.transpose();
            self.covariance.columns_mut(row, 3).copy_from(&columns);
        }
        let state = &mut self.belief.state;
        state.world_from_body = turn * state.world_from_body;
        state.velocity = turn * state.velocity;
        for clone in &mut self.clones {
            clone.world_from_body = turn * clone.world_from_body;
        }
        for point in &mut self.points {
            point.position = turn * point.position;
        }
        if let Some(gravity) = &mut self.gravity {
            gravity.mean = turn * gravity.mean;
            gravity.follow(&self.covariance);
        }
        self.renew_belief_covariance();
    }

    /// Moves the means of all parts by a change of the whole state; the covariance is that after
    /// it.
    pub fn shift(&mut self, change: &DVector<f64>) {
        let part = |start: usize| change.fixed_rows::<3>(start).into_owned();
        let covariance = std::mem::take(&mut self.covariance);
        let covariance = self.with_camera(covariance, -1.0);
        let navigation = change.fixed_rows::<NAVIGATION>(0).into_owned();
        self.belief.state = self.belief.state.corrected_by(&navigation);
        let base = self.row(Block::Clone(0));
        for (slot, clone) in self.clones.iter_mut().enumerate() {
            let row = base + CLONE * slot;
            clone.shift(ErrorState::So3xRn, &part(row), &part(row + 3));
        }
        let base = self.row(Block::Point(0));
        for (slot, point) in self.points.iter_mut().enumerate() {
            point.position += part(base + 3 * slot);
        }
        let row = self.row(Block::Calibration(0));
        if let Some(calibration) = &mut self.calibration {
            let blocks = calibration.blocks();
            let moved = std::array::from_fn(|k| blocks[k] + part(row + 3 * k));
            *calibration = calibration.moved(moved);
            calibration.covariance = covariance.fixed_view::<7, 7>(row, row).into_owned();
        }
        self.covariance = self.with_camera(covariance, 1.0);
        self.renew_belief_covariance();
        if let Some(gravity) = &mut self.gravity {
            gravity.mean += part(NAVIGATION);
            gravity.follow(&self.covariance);
        }
    }

    /// Takes the calibration into the state.
    pub fn add_calibration(&mut self, prior: &Calibration) {
        self.synchronize();
        let row = self.row(Block::Calibration(0));
        self.augment(row, 3 * CALIBRATION_BLOCKS);
        self.covariance.fixed_view_mut::<7, 7>(row, row).copy_from(&prior.covariance);
        self.calibration = Some(*prior);
    }

    /// Adds the noise of a time stamp with this standard deviation (s): pose errors along the motion.
    pub fn add_stamp_jitter(&mut self, sd: f64) {
        let mut moves = nalgebra::SVector::<f64, NAVIGATION>::zeros();
        moves.fixed_rows_mut::<3>(block::ROTATION).copy_from(&self.motion().angular_velocity);
        moves.fixed_rows_mut::<3>(block::POSITION).copy_from(&self.belief.state.velocity);
        self.belief.covariance += moves * moves.transpose() * sd.powi(2);
    }

    /// Moves the body by `way`, in body coordinates, as uncertain as `spread` says, and leaves it at
    /// rest there.
    pub fn reset_pose(&mut self, way: &Isometry3<f64>, spread: &PoseSpread) {
        let rotation = self.belief.state.world_from_body.rotation.to_rotation_matrix();
        let mut step = NavCovariance::identity();
        let mut set = |row: usize, column: usize, value: Matrix3<f64>| {
            step.fixed_view_mut::<3, 3>(row, column).copy_from(&value);
        };
        let turned = way.rotation.to_rotation_matrix().into_inner().transpose();
        let lever = way.translation.vector.cross_matrix();
        set(block::ROTATION, block::ROTATION, turned);
        set(block::POSITION, block::ROTATION, -(rotation * lever));
        set(block::VELOCITY, block::VELOCITY, Matrix3::zeros());
        self.transition = step * self.transition;
        let covariance = &mut self.belief.covariance;
        *covariance = step * *covariance * step.transpose();
        for (row, sd) in [
            (block::ROTATION, spread.turn),
            (block::POSITION, spread.shift),
            (block::VELOCITY, spread.velocity),
        ] {
            (row..row + 3).for_each(|k| covariance[(k, k)] += sd * sd);
        }
        self.belief.state.world_from_body *= way;
        self.belief.state.velocity = Vector3::zeros();
    }
}
