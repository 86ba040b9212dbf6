//! Linear measurements of the whole error: how points are eliminated from them, how improbable they
//! are, and how several become one.

use std::collections::BTreeSet;

use nalgebra::{Const, DMatrix, DVector, Dyn, Matrix3, OMatrix, Rotation3, U3, Vector3};
use statrs::distribution::{ChiSquared, ContinuousCDF};

use super::error_state::ErrorState;
use super::pose_clone::{CLONE, CloneErrors, clone_errors};
use super::state::{Block, JointState, NAVIGATION, StatePoint};
use super::triangulation::TrackRows;
use crate::filter::linear::LinearMeasurement;
use crate::inertial::block;

/// A measurement `residual = jacobian e + noise` of the errors as they are between updates, its noise
/// white with variance one.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct StateRows {
    /// First rows in the state of the blocks of three that it depends on, in the order of the
    /// columns; the two of a cloned pose follow each other.
    pub blocks: Vec<usize>,
    pub jacobian: DMatrix<f64>,
    pub residual: DVector<f64>,
}

/// The same in the coordinates of an update.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct UpdateRows {
    /// By the body-frame rotation error, the rest being as it is.
    pub by_rotation: OMatrix<f64, Dyn, U3>,
    /// Blocks of the Euclidean part.
    pub blocks: Vec<usize>,
    pub jacobian: DMatrix<f64>,
    pub residual: DVector<f64>,
    /// Sum of the squares of residuals that nothing of the state changes.
    pub remainder: f64,
}

/// A track's rows turned so that its point is in three of them alone.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Eliminated {
    /// What the point is by the state: `root e_l = residual - jacobian e + noise`.
    pub point: StateRows,
    pub root: Matrix3<f64>,
    /// What is left: rows that say nothing of the point.
    pub rest: StateRows,
}

impl TrackRows {
    /// Turns the rows by `Q^T`, `by_point = Q [root; 0]`: white noise stays white. `None` with fewer
    /// than three.
    pub fn eliminate(self, blocks: &[usize]) -> Option<Eliminated> {
        let Self { mut residual, mut jacobian, by_point } = self;
        let more = by_point.nrows().checked_sub(3)?;
        let factors = by_point.qr();
        factors.q_tr_mul(&mut residual);
        factors.q_tr_mul(&mut jacobian);
        let part = |first: usize, rows: usize| StateRows {
            blocks: blocks.to_vec(),
            jacobian: jacobian.rows(first, rows).into_owned(),
            residual: residual.rows(first, rows).into_owned(),
        };
        let root = factors.r().fixed_view::<3, 3>(0, 0).into_owned();
        Some(Eliminated { point: part(0, 3), root, rest: part(3, more) })
    }

    /// The rows as a measurement of a point that is part of the state, from this row on.
    pub fn of_state_point(self, blocks: &[usize], point: usize) -> StateRows {
        let columns = self.jacobian.ncols();
        let mut jacobian = self.jacobian.resize_horizontally(columns + 3, 0.0);
        jacobian.fixed_columns_mut::<3>(columns).copy_from(&self.by_point);
        let blocks = blocks.iter().copied().chain([point]).collect();
        StateRows { blocks, jacobian, residual: self.residual }
    }
}

impl Eliminated {
    /// Takes the point, found at `position`, into the state. False, and no change, if its rows do not
    /// determine it.
    pub fn admit(&self, id: u64, position: &Vector3<f64>, state: &mut JointState) -> bool {
        let Some(inverse) = self.root.try_inverse() else { return false };
        let by_state = inverse * &self.point.jacobian * -1.0;
        let mut rows = OMatrix::<f64, U3, Dyn>::zeros(state.covariance.ncols());
        for (k, block) in self.point.blocks.iter().enumerate() {
            rows += by_state.fixed_columns::<3>(3 * k) * state.covariance.fixed_rows::<3>(*block);
        }
        let mut own = inverse * inverse.transpose();
        for (k, block) in self.point.blocks.iter().enumerate() {
            let by_block = by_state.fixed_columns::<3>(3 * k).into_owned();
            own += rows.fixed_columns::<3>(*block) * by_block.transpose();
        }
        let position = position + inverse * &self.point.residual;
        state.append(StatePoint { id, position }, &rows, &own)
    }
}

impl StateRows {
    /// A measurement of the navigation part; `None` if its noise is not positive definite.
    pub fn of_navigation<const M: usize>(
        measurement: &LinearMeasurement<Const<M>, Const<NAVIGATION>>,
    ) -> Option<Self> {
        let root = measurement.noise.cholesky()?.l();
        let residual = root.solve_lower_triangular(&measurement.residual)?;
        let jacobian = root.solve_lower_triangular(&measurement.jacobian)?;
        Some(Self {
            blocks: (0..NAVIGATION).step_by(3).collect(),
            jacobian: DMatrix::from_fn(M, NAVIGATION, |i, j| jacobian[(i, j)]),
            residual: DVector::from_fn(M, |i, _| residual[i]),
        })
    }

    pub fn len(&self) -> usize {
        self.residual.len()
    }

    /// Squared Mahalanobis distance of the residual, `r^T (H P H^T + I)^-1 r`.
    pub fn squared_distance(&self, covariance: &DMatrix<f64>) -> Option<f64> {
        let n = 3 * self.blocks.len();
        let prior = DMatrix::from_fn(n, n, |i, j| {
            covariance[(self.blocks[i / 3] + i % 3, self.blocks[j / 3] + j % 3)]
        });
        let mut spread = &self.jacobian * prior * self.jacobian.transpose();
        (0..self.len()).for_each(|k| spread[(k, k)] += 1.0);
        let whitened = spread.cholesky()?.l().solve_lower_triangular(&self.residual)?;
        Some(whitened.norm_squared())
    }

    /// All rows of several measurements whose noises are independent.
    pub fn stack<'a>(parts: impl Iterator<Item = &'a Self> + Clone) -> Self {
        let blocks: BTreeSet<usize> =
            parts.clone().flat_map(|part| &part.blocks).copied().collect();
        let blocks: Vec<usize> = blocks.into_iter().collect();
        let rows = parts.clone().map(Self::len).sum();
        let mut stacked = Self {
            jacobian: DMatrix::zeros(rows, 3 * blocks.len()),
            residual: DVector::zeros(rows),
            blocks,
        };
        let mut first = 0;
        for part in parts {
            stacked.residual.rows_mut(first, part.len()).copy_from(&part.residual);
            for (from, block) in part.blocks.iter().enumerate() {
                let Ok(to) = stacked.blocks.binary_search(block) else { continue };
                let columns = part.jacobian.columns(3 * from, 3);
                stacked.jacobian.view_mut((first, 3 * to), (part.len(), 3)).copy_from(&columns);
            }
            first += part.len();
        }
        stacked
    }

    /// The same rows, linearised at `state`, in the coordinates of an update from `prior`. Where errors
    /// are right-invariant, with `e = R^T t`, a vector of the world has the error `u - y x t`, and a
    /// cloned pose `e_k = R_k^T t_k`, `e_pk = u_k - p_k x t_k`; the rotation of an update is
    /// `R_prior^T t`.
    pub fn for_update(
        mut self,
        state: &JointState,
        error: ErrorState,
        prior: &Rotation3<f64>,
    ) -> UpdateRows {
        let mut by_rotation = OMatrix::<f64, Dyn, U3>::zeros(self.len());
        if let Some(k) = self.blocks.iter().position(|row| *row == block::ROTATION) {
            by_rotation += self.jacobian.fixed_columns::<3>(3 * k);
            self.blocks.remove(k);
            self.jacobian = self.jacobian.remove_fixed_columns::<3>(3 * k);
        }
        if error.is_invariant() {
            self.clone_columns_for_update(state);
            let rotation = state.belief.state.world_from_body.rotation.to_rotation_matrix();
            let by_turn = by_rotation * rotation.matrix().transpose();
            by_rotation = (by_turn - self.by_turn_of_vectors(state)) * prior.matrix();
        }
        UpdateRows {
            by_rotation,
            blocks: self.blocks.iter().map(|row| row / 3 - 1).collect(),
            jacobian: self.jacobian,
            residual: self.residual,
            remainder: 0.0,
        }
    }

    fn clone_columns_for_update(&mut self, state: &JointState) {
        let clones = state.row(Block::Clone(0))..state.row(Block::Point(0));
        for (k, row) in self.blocks.iter().enumerate() {
            if clones.contains(row) && (row - clones.start).is_multiple_of(CLONE) {
                let pose = &state.clones[(row - clones.start) / CLONE].world_from_body;
                let by = clone_errors(pose, CloneErrors::Stored);
                let columns = self.jacobian.fixed_columns::<CLONE>(3 * k) * by;
                self.jacobian.fixed_columns_mut::<CLONE>(3 * k).copy_from(&columns);
            }
        }
    }

    /// `sum H y^` over the vectors of the world.
    fn by_turn_of_vectors(&self, state: &JointState) -> OMatrix<f64, Dyn, U3> {
        let means = state.euclidean();
        let mut by_turn = OMatrix::<f64, Dyn, U3>::zeros(self.len());
        for (k, row) in self.blocks.iter().enumerate() {
            if state.turns(row / 3 - 1) {
                let columns = self.jacobian.fixed_columns::<3>(3 * k);
                by_turn += columns * means[row / 3 - 1].cross_matrix();
            }
        }
        by_turn
    }
}

impl UpdateRows {
    /// As many rows as there are columns at most, that say the same of the state.
    pub fn compressed(mut self) -> Self {
        let columns = self.jacobian.ncols() + 3;
        if self.residual.len() <= columns {
            return self;
        }
        let mut whole = DMatrix::zeros(self.residual.len(), columns);
        whole.columns_mut(0, 3).copy_from(&self.by_rotation);
        whole.columns_mut(3, columns - 3).copy_from(&self.jacobian);
        let factors = whole.qr();
        factors.q_tr_mul(&mut self.residual);
        let triangle = factors.r();
        let left = self.residual.rows(columns, self.residual.len() - columns);
        self.remainder += left.norm_squared();
        self.by_rotation = triangle.fixed_columns::<3>(0).into_owned();
        self.jacobian = triangle.columns(3, columns - 3).into_owned();
        self.residual = self.residual.rows(0, columns).into_owned();
        self
    }
}

/// Beyond what squared distance a track is improbable.
#[derive(Debug, Clone)]
pub(super) struct TrackGate {
    /// Probability with which a track that fits is refused; 0: never.
    false_alarm: f64,
    /// For 1, 2, ... rows, as far as they were asked for.
    thresholds: Vec<f64>,
}

impl TrackGate {
    pub fn new(false_alarm: f64) -> Self {
        Self { false_alarm, thresholds: Vec::new() }
    }

    /// Quantile of chi-square with so many degrees of freedom.
    pub fn threshold(&mut self, rows: usize) -> f64 {
        if !(self.false_alarm > 0.0 && self.false_alarm < 1.0) {
            return f64::INFINITY;
        }
        while self.thresholds.len() < rows {
            let distribution = ChiSquared::new((self.thresholds.len() + 1) as f64);
            let quantile = distribution.map(|chi2| chi2.inverse_cdf(1.0 - self.false_alarm));
            self.thresholds.push(quantile.unwrap_or(f64::INFINITY));
        }
        rows.checked_sub(1).map_or(0.0, |k| self.thresholds[k])
    }
}
