//! Gravity as part of the state: its direction is opened, found, and leaves the state again.
//!
#![doc = include_str!("../../../../docs/theory/gravity.md")]
#![doc = include_str!("../../../../docs/math.html")]

use nalgebra::{DMatrix, Matrix3, UnitQuaternion, Vector3};

use super::gravity::UnknownGravity;
use super::pose_clone::CLONE;
use super::state::{Block, JointState, NAVIGATION};
use crate::filter::core::FilterError;
use crate::filter::linear::LinearMeasurement;
use crate::inertial::block;

impl JointState {
    /// Takes gravity of the given magnitude (m/s^2) and any direction into the state.
    pub fn add_unknown_gravity(&mut self, magnitude: f64) {
        let gravity = UnknownGravity::new(magnitude);
        self.augment(NAVIGATION, 3);
        self.covariance
            .fixed_view_mut::<3, 3>(NAVIGATION, NAVIGATION)
            .copy_from(&gravity.covariance);
        self.gravity = Some(gravity);
    }

    /// Takes gravity, of which `mean` was thought certain, into the state with an error that the
    /// accelerometer's bias, of this standard deviation (m/s^2), makes up for: `e_g = R e_ba`.
    pub fn reopen_gravity(&mut self, mean: Vector3<f64>, accel_bias_sd: f64) {
        self.synchronize();
        let variance = accel_bias_sd.powi(2);
        let rotation = self.belief.state.world_from_body.rotation.to_rotation_matrix();
        self.augment(NAVIGATION, 3);
        let mut add = |row: usize, column: usize, value: Matrix3<f64>| {
            let mut part = self.covariance.fixed_view_mut::<3, 3>(row, column);
            part += value * variance;
        };
        add(NAVIGATION, NAVIGATION, Matrix3::identity());
        add(block::ACCEL_BIAS, block::ACCEL_BIAS, Matrix3::identity());
        add(NAVIGATION, block::ACCEL_BIAS, *rotation.matrix());
        add(block::ACCEL_BIAS, NAVIGATION, rotation.matrix().transpose());
        self.renew_belief_covariance();
        self.gravity = Some(UnknownGravity::around(mean, &self.covariance));
    }

    /// Turns the world so that the mean of gravity points down; once its direction is known well,
    /// what is uncertain of it becomes uncertainty of the attitude, and gravity leaves the state.
    /// Gives the turn, if there was one.
    pub fn settle_gravity(&mut self) -> Result<Option<UnitQuaternion<f64>>, FilterError> {
        let turn = self.gravity.as_ref().and_then(UnknownGravity::levelling_turn);
        let Some(turn) = turn else { return Ok(None) };
        self.turn_world(&turn);
        if self.gravity.as_ref().is_some_and(UnknownGravity::is_settled) {
            self.use_magnitude_of_gravity()?;
            self.fix_gravity();
        }
        Ok(Some(turn))
    }

    /// Conditions the state on the magnitude of gravity, `|g| = g^T g / |g| + noise`, to first order.
    fn use_magnitude_of_gravity(&mut self) -> Result<(), FilterError> {
        let Some(gravity) = &self.gravity else { return Ok(()) };
        let Some((error, direction)) = gravity.magnitude_error() else { return Ok(()) };
        let measurement = LinearMeasurement {
            residual: nalgebra::Vector1::new(error),
            jacobian: direction.transpose(),
            first: self.row(Block::Gravity),
            noise: nalgebra::Matrix1::new(gravity.magnitude_sd().powi(2)),
        };
        let correction = measurement.condition(&self.covariance)?;
        correction.reduce(&mut self.covariance);
        self.shift(&correction.change);
        Ok(())
    }

    /// Gravity becomes `(0, 0, -g)`, and its error a turn of everything in the world.
    fn fix_gravity(&mut self) {
        let Some(gravity) = self.gravity.take() else { return };
        let n = self.covariance.ncols();
        let mut by_old = DMatrix::zeros(n - 3, n);
        for k in 0..n - 3 {
            by_old[(k, if k < NAVIGATION { k } else { k + 3 })] = 1.0;
        }
        let state = &self.belief.state;
        let mut set = |row: usize, value: Matrix3<f64>| {
            by_old.fixed_view_mut::<3, 3>(row, NAVIGATION).copy_from(&value);
        };
        let position = &state.world_from_body.translation.vector;
        set(block::ROTATION, gravity.rotation_by_gravity(&state.world_from_body.rotation));
        set(block::VELOCITY, gravity.vector_by_gravity(&state.velocity));
        set(block::POSITION, gravity.vector_by_gravity(position));
        let base = self.row(Block::Clone(0));
        for (slot, clone) in self.clones.iter().enumerate() {
            let (row, pose) = (base + CLONE * slot, &clone.world_from_body);
            set(row, gravity.rotation_by_gravity(&pose.rotation));
            set(row + 3, gravity.vector_by_gravity(&pose.translation.vector));
        }
        let base = self.row(Block::Point(0));
        for (slot, point) in self.points.iter().enumerate() {
            set(base + 3 * slot, gravity.vector_by_gravity(&point.position));
        }
        self.covariance = &by_old * &self.covariance * by_old.transpose();
        self.renew_belief_covariance();
    }
}
