//! The multiplicative extended Kalman filter: the Gaussian rival of the MFG filters.

use nalgebra::{Matrix6, SMatrix, SVector};

use super::gate::Gate;
use super::{FilterConfig, Rest, UpdateOutcome, VisualInertialFilter, normalized_innovation};
use crate::alignment::{PointPair, PoseInformation};
use crate::inertial::{Belief, Propagator, block, symmetrize};
use crate::sensor::ImuSample;
use crate::so3::ProperSvd;

/// Attitude error in the body frame, one linearisation an update, at the predicted state.
#[derive(Debug, Clone)]
pub struct Mekf {
    propagator: Propagator,
    belief: Belief,
    gate: Gate,
}

impl Mekf {
    pub fn new(config: &FilterConfig, propagator: Propagator, belief: Belief) -> Self {
        Self { propagator, belief, gate: Gate::new(config) }
    }

    fn corrected(&self, information: &PoseInformation) -> Option<Belief> {
        let rotation = self.belief.state.world_from_body.rotation.to_rotation_matrix();
        let (lambda, vector) = information.linearized(&rotation);

        // Information form of the gain, so that the cost does not depend on the number of points
        // and degenerate geometry needs no special case.
        let prior = self.belief.covariance;
        let mut by_pose = SMatrix::<f64, 15, 6>::zeros();
        by_pose.fixed_columns_mut::<3>(0).copy_from(&prior.fixed_columns::<3>(block::ROTATION));
        by_pose.fixed_columns_mut::<3>(3).copy_from(&prior.fixed_columns::<3>(block::POSITION));
        let pose = crate::inertial::pose_covariance(&prior);
        let inner = (Matrix6::identity() + lambda * pose).try_inverse()?;
        let correction: SVector<f64, 15> = by_pose * (inner * vector);
        let mut covariance = prior - by_pose * (inner * lambda) * by_pose.transpose();
        symmetrize(&mut covariance);
        let state = self.belief.state.corrected_by(&correction);
        Some(Belief { state, covariance })
    }
}

impl VisualInertialFilter for Mekf {
    fn belief(&self) -> &Belief {
        &self.belief
    }

    fn propagate(&mut self, from: &ImuSample, to: &ImuSample) -> bool {
        self.propagator.propagate(&mut self.belief, from, to)
    }

    fn set_imu_gap(&mut self, in_gap: bool) {
        self.propagator.set_imu_gap(in_gap);
    }

    fn coast(&mut self, seconds: f64) {
        self.propagator.coast(&mut self.belief, seconds);
    }

    fn update(&mut self, pairs: &[PointPair]) -> Option<UpdateOutcome> {
        let pose = &self.belief.state.world_from_body;
        let (screening, information) = self.gate.screen(pairs, pose, &self.body_points());
        if information.points == 0 {
            return None;
        }
        let innovation = normalized_innovation(&information, &self.belief)?;
        self.belief = self.corrected(&information).filter(Belief::is_finite)?;
        Some(UpdateOutcome { innovation, points: information.points, screening })
    }

    fn rest(&mut self, rest: &Rest) -> bool {
        rest.condition(&mut self.belief)
    }

    fn passed(&self) -> &[bool] {
        self.gate.passed()
    }

    fn matrix_fisher(&self) -> Option<ProperSvd> {
        None
    }
}
