use nalgebra::{Rotation3, Vector3};

use super::belief::POSITION;
use super::mixture::Mixture;
use super::propagation::MomentPropagator;
use super::{AttitudeUpdate, GnssFilter, InitialBelief, Innovation, Regression};
use crate::filter::{
    AttitudeMeasurement, BayesFilter, Estimate, FilterError, InertialStep, PositionMeasurement,
    VectorMeasurement,
};
use crate::inertial::{Belief, ImuConfig, NavState};

/// What distinguishes the matrix Fisher-Gaussian filters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MfgOptions {
    pub name: &'static str,
    pub regression: Regression,
    pub update: AttitudeUpdate,
    /// Whether a belief that is broad in heading is divided into several, so that a gyroscope bias
    /// may be as unknown; the paper's filters carry one.
    pub divided: bool,
}

/// The matrix Fisher-Gaussian filter for IMU and GNSS (W22 5.1).
#[derive(Debug, Clone)]
pub struct MfgGnss {
    options: MfgOptions,
    propagator: MomentPropagator,
    belief: Mixture,
}

impl MfgGnss {
    pub fn new(
        imu: &ImuConfig,
        options: MfgOptions,
        initial: &InitialBelief,
    ) -> Result<Self, FilterError> {
        let MfgOptions { regression, divided, .. } = options;
        let belief = Mixture::new(initial.matrix_fisher_gaussian()?, regression, divided)?;
        Ok(Self { options, propagator: MomentPropagator::new(imu), belief })
    }

    /// Number of matrix Fisher-Gaussian densities that make up the belief.
    pub fn components(&self) -> usize {
        self.belief.components().len()
    }
}

impl BayesFilter for MfgGnss {
    fn name(&self) -> &'static str {
        self.options.name
    }

    fn propagate(&mut self, step: &InertialStep) -> Result<(), FilterError> {
        step.check()?;
        let force = step.specific_force.ok_or(FilterError::NoSpecificForce)?;
        self.belief.propagate(&self.propagator, &step.angular_velocity, &force, step.seconds)
    }

    fn update_attitude(&mut self, measured: &AttitudeMeasurement) -> Result<(), FilterError> {
        measured.check()?;
        self.belief.update_attitude(&measured.parameter())
    }

    fn update_directions(&mut self, measured: &[VectorMeasurement]) -> Result<(), FilterError> {
        self.belief.update_attitude(&VectorMeasurement::joint_parameter(measured)?)
    }

    fn update_position(&mut self, measured: &PositionMeasurement) -> Result<(), FilterError> {
        self.belief.update_position(measured, self.options.update)
    }

    fn attitude(&self) -> Rotation3<f64> {
        self.state().world_from_body.rotation.to_rotation_matrix()
    }

    fn estimate(&self) -> Estimate {
        super::estimate(&self.belief(), self.concentration())
    }

    fn gyro_bias(&self) -> Option<Vector3<f64>> {
        Some(self.state().gyro_bias)
    }
}

impl GnssFilter for MfgGnss {
    fn innovation(&self, position: &PositionMeasurement) -> Result<Innovation, FilterError> {
        self.belief.innovation(position)
    }

    fn loosen_position(&mut self, variance: f64) {
        for belief in self.belief.components_mut() {
            (POSITION..POSITION + 3).for_each(|k| belief.conditional[(k, k)] += variance);
        }
    }

    fn set_imu_gap(&mut self, in_gap: bool) {
        self.propagator.set_imu_gap(in_gap);
    }

    fn enlarge(&mut self, factor: f64) -> Result<(), FilterError> {
        self.belief.enlarge(factor)
    }

    fn belief(&self) -> Belief {
        self.belief.summary()
    }

    fn state(&self) -> NavState {
        self.belief.state()
    }

    fn concentration(&self) -> Option<Vector3<f64>> {
        Some(self.belief.concentration())
    }
}
