use nalgebra::{Matrix3, Rotation3, SMatrix, SVector, UnitQuaternion, Vector3};

use super::{GnssFilter, InitialBelief, Innovation};
use crate::filter::{
    AttitudeMeasurement, BayesFilter, Estimate, FilterError, Frame, InertialStep,
    PositionMeasurement, VectorMeasurement,
};
use crate::inertial::{Belief, ImuConfig, NavCovariance, NavState, Propagator, block, symmetrize};
use crate::so3::{hat, log};

/// Derivative of a measurement of three numbers by the error of the state.
type Jacobian = SMatrix<f64, 3, 15>;

/// The multiplicative extended Kalman filter, attitude error in the body frame.
#[derive(Debug, Clone)]
pub struct MekfGnss {
    propagator: Propagator,
    belief: Belief,
}

impl MekfGnss {
    pub fn new(imu: &ImuConfig, initial: &InitialBelief) -> Result<Self, FilterError> {
        Ok(Self::with_belief(imu, initial.gaussian()?))
    }

    /// A filter that goes on from a belief.
    pub fn with_belief(imu: &ImuConfig, belief: Belief) -> Self {
        Self { propagator: Propagator::inertial(imu), belief }
    }
}

/// A measurement linearised at the estimate.
struct Linear {
    residual: Vector3<f64>,
    jacobian: Jacobian,
    covariance: Matrix3<f64>,
}

impl Linear {
    fn of_position(state: &NavState, measured: &PositionMeasurement) -> Self {
        let rotation = *state.world_from_body.rotation.to_rotation_matrix().matrix();
        let predicted = state.world_from_body.translation.vector + rotation * measured.lever_arm;
        let mut jacobian = Jacobian::zeros();
        jacobian
            .fixed_columns_mut::<3>(block::ROTATION)
            .copy_from(&(-rotation * hat(&measured.lever_arm)));
        jacobian.fixed_columns_mut::<3>(block::POSITION).fill_with_identity();
        Self { residual: measured.in_world - predicted, jacobian, covariance: measured.covariance }
    }

    fn of_attitude(state: &NavState, measured: &AttitudeMeasurement) -> Result<Self, FilterError> {
        measured.check()?;
        let rotation = state.world_from_body.rotation.to_rotation_matrix();
        let noise = (measured.noise + measured.noise.transpose()) * 0.5;
        let information = Matrix3::identity() * noise.trace() - noise;
        let factor = information.cholesky().ok_or(FilterError::NotPositive("measurement noise"))?;
        let mut jacobian = Jacobian::zeros();
        jacobian.fixed_columns_mut::<3>(block::ROTATION).fill_with_identity();
        let residual = log(&(rotation.inverse() * measured.world_from_body));
        Ok(Self { residual, jacobian, covariance: factor.inverse() })
    }

    fn of_vector(state: &NavState, measured: &VectorMeasurement) -> Result<Self, FilterError> {
        measured.check()?;
        let rotation = state.world_from_body.rotation.to_rotation_matrix();
        let in_body = rotation.inverse() * measured.in_world;
        let (residual, by_rotation) = match measured.measured_in {
            Frame::Body => (measured.in_body - in_body, hat(&in_body)),
            Frame::World => (
                measured.in_world - rotation * measured.in_body,
                -(rotation.matrix() * hat(&measured.in_body)),
            ),
        };
        let mut jacobian = Jacobian::zeros();
        jacobian.fixed_columns_mut::<3>(block::ROTATION).copy_from(&by_rotation);
        Ok(Self { residual, jacobian, covariance: measured.covariance })
    }

    fn innovation(&self, prior: &NavCovariance) -> Result<Innovation, FilterError> {
        let covariance = self.jacobian * prior * self.jacobian.transpose() + self.covariance;
        Innovation::new(self.residual, covariance)
    }

    /// The belief after the measurement, its covariance in Joseph's form.
    fn correct(&self, belief: &Belief) -> Result<Belief, FilterError> {
        let prior = &belief.covariance;
        let innovation = self.innovation(prior)?;
        let factor = innovation
            .covariance
            .cholesky()
            .ok_or(FilterError::NotPositive("covariance of the innovation"))?;
        let gain = factor.solve(&(self.jacobian * prior)).transpose();
        let kept = NavCovariance::identity() - gain * self.jacobian;
        let mut covariance =
            kept * prior * kept.transpose() + gain * self.covariance * gain.transpose();
        symmetrize(&mut covariance);
        let corrected = Belief { state: moved(&belief.state, &(gain * self.residual)), covariance };
        if corrected.is_finite() { Ok(corrected) } else { Err(FilterError::NotFinite("posterior")) }
    }
}

/// The state corrected by an error.
pub(crate) fn moved(state: &NavState, error: &SVector<f64, 15>) -> NavState {
    let part = |start: usize| error.fixed_rows::<3>(start).into_owned();
    let mut moved = *state;
    let turn = UnitQuaternion::from_scaled_axis(part(block::ROTATION));
    let turned = state.world_from_body.rotation * turn;
    moved.world_from_body.rotation = UnitQuaternion::new_normalize(turned.into_inner());
    moved.world_from_body.translation.vector += part(block::POSITION);
    moved.velocity += part(block::VELOCITY);
    moved.gyro_bias += part(block::GYRO_BIAS);
    moved.accel_bias += part(block::ACCEL_BIAS);
    moved
}

impl BayesFilter for MekfGnss {
    fn name(&self) -> &'static str {
        "mekf"
    }

    fn propagate(&mut self, step: &InertialStep) -> Result<(), FilterError> {
        step.check()?;
        let force = step.specific_force.ok_or(FilterError::NoSpecificForce)?;
        let rate = &step.angular_velocity;
        let finite = self.propagator.advance(&mut self.belief, rate, &force, step.seconds);
        if finite { Ok(()) } else { Err(FilterError::NotFinite("propagated belief")) }
    }

    fn update_attitude(&mut self, measured: &AttitudeMeasurement) -> Result<(), FilterError> {
        self.belief = Linear::of_attitude(&self.belief.state, measured)?.correct(&self.belief)?;
        Ok(())
    }

    fn update_directions(&mut self, measured: &[VectorMeasurement]) -> Result<(), FilterError> {
        let mut belief = self.belief;
        for direction in measured {
            belief = Linear::of_vector(&belief.state, direction)?.correct(&belief)?;
        }
        self.belief = belief;
        Ok(())
    }

    fn update_position(&mut self, measured: &PositionMeasurement) -> Result<(), FilterError> {
        self.belief = Linear::of_position(&self.belief.state, measured).correct(&self.belief)?;
        Ok(())
    }

    fn attitude(&self) -> Rotation3<f64> {
        self.belief.state.world_from_body.rotation.to_rotation_matrix()
    }

    fn estimate(&self) -> Estimate {
        super::estimate(&self.belief, None)
    }

    fn gyro_bias(&self) -> Option<Vector3<f64>> {
        Some(self.belief.state.gyro_bias)
    }

    fn is_gaussian(&self) -> bool {
        true
    }
}

impl GnssFilter for MekfGnss {
    fn innovation(&self, position: &PositionMeasurement) -> Result<Innovation, FilterError> {
        Linear::of_position(&self.belief.state, position).innovation(&self.belief.covariance)
    }

    fn loosen_position(&mut self, variance: f64) {
        for k in block::POSITION..block::POSITION + 3 {
            self.belief.covariance[(k, k)] += variance;
        }
    }

    fn set_imu_gap(&mut self, in_gap: bool) {
        self.propagator.set_imu_gap(in_gap);
    }

    fn enlarge(&mut self, factor: f64) -> Result<(), FilterError> {
        self.belief.covariance *= factor;
        Ok(())
    }

    fn belief(&self) -> Belief {
        self.belief
    }

    fn state(&self) -> NavState {
        self.belief.state
    }
}
