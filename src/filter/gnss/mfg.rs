use nalgebra::{Matrix3, Rotation3, Vector3};

use super::belief::{NavigationBelief, POSITION};
use super::propagation::MomentPropagator;
use super::update::{innovation, update_attitude, update_position};
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
}

/// The matrix Fisher-Gaussian filter for IMU and GNSS (W22 5.1).
#[derive(Debug, Clone)]
pub struct MfgGnss {
    options: MfgOptions,
    propagator: MomentPropagator,
    belief: NavigationBelief,
}

impl MfgGnss {
    pub fn new(
        imu: &ImuConfig,
        options: MfgOptions,
        initial: &InitialBelief,
    ) -> Result<Self, FilterError> {
        let belief = initial.matrix_fisher_gaussian()?;
        Ok(Self { options, propagator: MomentPropagator::new(imu), belief })
    }

    fn add_evidence(&mut self, parameter: &Matrix3<f64>) -> Result<(), FilterError> {
        self.belief = update_attitude(&self.belief, parameter, self.options.regression)?;
        Ok(())
    }
}

impl BayesFilter for MfgGnss {
    fn name(&self) -> &'static str {
        self.options.name
    }

    fn propagate(&mut self, step: &InertialStep) -> Result<(), FilterError> {
        step.check()?;
        let force = step.specific_force.ok_or(FilterError::NoSpecificForce)?;
        let rate = &step.angular_velocity;
        let regression = self.options.regression;
        self.belief = self.propagator.step(&self.belief, rate, &force, step.seconds, regression)?;
        Ok(())
    }

    fn update_attitude(&mut self, measured: &AttitudeMeasurement) -> Result<(), FilterError> {
        measured.check()?;
        self.add_evidence(&measured.parameter())
    }

    fn update_directions(&mut self, measured: &[VectorMeasurement]) -> Result<(), FilterError> {
        self.add_evidence(&VectorMeasurement::joint_parameter(measured)?)
    }

    fn update_position(&mut self, measured: &PositionMeasurement) -> Result<(), FilterError> {
        let MfgOptions { regression, update, .. } = self.options;
        self.belief = update_position(&self.belief, measured, update, regression)?;
        Ok(())
    }

    fn attitude(&self) -> Rotation3<f64> {
        self.belief.attitude.mode()
    }

    fn estimate(&self) -> Estimate {
        super::estimate(&self.belief(), Some(self.belief.attitude.svd().s))
    }

    fn gyro_bias(&self) -> Option<Vector3<f64>> {
        Some(self.state().gyro_bias)
    }
}

impl GnssFilter for MfgGnss {
    fn innovation(&self, position: &PositionMeasurement) -> Result<Innovation, FilterError> {
        innovation(&self.belief, position)
    }

    fn loosen_position(&mut self, variance: f64) {
        for k in POSITION..POSITION + 3 {
            self.belief.conditional[(k, k)] += variance;
        }
    }

    fn set_imu_gap(&mut self, in_gap: bool) {
        self.propagator.set_imu_gap(in_gap);
    }

    fn enlarge(&mut self, factor: f64) -> Result<(), FilterError> {
        self.belief = self.belief.enlarged(factor)?;
        Ok(())
    }

    fn belief(&self) -> Belief {
        self.belief.summary()
    }

    fn state(&self) -> NavState {
        self.belief.state()
    }
}
