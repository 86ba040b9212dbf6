//! The multiplicative extended Kalman filter: the Gaussian rival of the MFG filters.

use nalgebra::{Const, Matrix6, Rotation3, SMatrix, Vector3, Vector6};

use super::config::FilterConfig;
use super::estimator::{PointUpdate, VisualInertialFilter};
use super::frame_change::FrameChange;
use super::gate::Gate;
use super::kind::FilterKind;
use super::map_points::normalized_innovation_squared;
use super::propagation::advance;
use super::zero_velocity::{ZeroVelocity, corrected};
use crate::alignment::{PointPair, PoseInformation};
use crate::filter::core::{BayesFilter, Estimate, FilterError, InertialStep};
use crate::filter::linear::LinearMeasurement;
use crate::inertial::{Belief, Propagator, block};
use crate::so3::ProperSvd;

/// Attitude error in the body frame, one linearisation an update, at the predicted state.
#[derive(Debug, Clone)]
pub struct Mekf {
    kind: FilterKind,
    propagator: Propagator,
    belief: Belief,
    gate: Gate,
}

impl Mekf {
    pub fn new(
        kind: FilterKind,
        config: &FilterConfig,
        propagator: Propagator,
        belief: Belief,
    ) -> Self {
        Self { kind, propagator, belief, gate: Gate::new(config) }
    }

    /// The points as one measurement of the pose: with the information `V D V^T` and the vector
    /// `b = sum J^T W r` it is `D^-1/2 V^T b = D^1/2 V^T e + noise(I)`; directions that the points
    /// leave open measure nothing. So the cost does not depend on the number of points.
    fn measured_pose(
        &self,
        information: &PoseInformation,
    ) -> LinearMeasurement<Const<6>, Const<POSE_END>> {
        /// Information this many times smaller than the largest is rounding.
        const ROUNDING: f64 = 1e-14;
        let rotation = self.belief.state.world_from_body.rotation.to_rotation_matrix();
        let (lambda, vector): (Matrix6<f64>, _) = information.linearized(&rotation);
        let eigen = lambda.symmetric_eigen();
        let least = ROUNDING * eigen.eigenvalues.max();
        let mut residual = Vector6::zeros();
        let mut jacobian = SMatrix::<f64, 6, POSE_END>::zeros();
        for k in (0..6).filter(|k| eigen.eigenvalues[*k] > least) {
            let (axis, root) = (eigen.eigenvectors.column(k), eigen.eigenvalues[k].sqrt());
            residual[k] = axis.dot(&vector) / root;
            for i in 0..3 {
                jacobian[(k, block::ROTATION + i)] = root * axis[i];
                jacobian[(k, block::POSITION + i)] = root * axis[3 + i];
            }
        }
        LinearMeasurement { residual, jacobian, first: 0, noise: Matrix6::identity() }
    }
}

/// The errors up to the end of the position's, of which the pose is a part.
const POSE_END: usize = block::POSITION + 3;

impl BayesFilter for Mekf {
    fn name(&self) -> &'static str {
        self.kind.name()
    }

    fn propagate(&mut self, step: &InertialStep) -> Result<(), FilterError> {
        advance(&self.propagator, &mut self.belief, step).map(drop)
    }

    fn attitude(&self) -> Rotation3<f64> {
        self.belief.state.world_from_body.rotation.to_rotation_matrix()
    }

    fn estimate(&self) -> Estimate {
        Estimate::of_belief(&self.belief, None)
    }

    fn gyro_bias(&self) -> Option<Vector3<f64>> {
        Some(self.belief.state.gyro_bias)
    }

    fn is_gaussian(&self) -> bool {
        true
    }
}

impl VisualInertialFilter for Mekf {
    fn belief(&self) -> &Belief {
        &self.belief
    }

    fn set_imu_gap(&mut self, in_gap: bool) {
        self.propagator.set_imu_gap(in_gap);
    }

    fn update_map_points(&mut self, pairs: &[PointPair]) -> Result<PointUpdate, FilterError> {
        let pose = &self.belief.state.world_from_body;
        let (gating, information) = self.gate.screen(pairs, pose, &self.body_points());
        if information.points == 0 {
            return Err(FilterError::NoMeasurement);
        }
        let nis = normalized_innovation_squared(&information, &self.belief)?;
        self.belief = corrected(&self.belief, &self.measured_pose(&information))?;
        let (points, refused) = (information.points, self.gate.refused());
        Ok(PointUpdate { nis, points, gating, refused, frame: FrameChange::default() })
    }

    fn update_zero_velocity(&mut self, rest: &ZeroVelocity) -> Result<FrameChange, FilterError> {
        rest.condition(&mut self.belief)?;
        Ok(FrameChange::default())
    }

    fn matrix_fisher(&self) -> Option<ProperSvd> {
        None
    }
}
