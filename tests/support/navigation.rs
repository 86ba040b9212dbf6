//! An IMU-GNSS filter's start and a step of it, for tests and benches of what a step costs.

use mfg_vio::filter::InertialStep;
use mfg_vio::filter::gnss::InitialBelief;
use mfg_vio::inertial::NavState;
use nalgebra::{Isometry3, Vector3};

/// Levelled and moving; the heading unknown without `heading_sd`, rad.
pub fn initial(heading_sd: Option<f64>) -> InitialBelief {
    InitialBelief {
        state: NavState {
            world_from_body: Isometry3::rotation(Vector3::new(0.1, 0.2, 1.0)),
            velocity: Vector3::new(5.0, 3.0, 0.0),
            gyro_bias: Vector3::zeros(),
            accel_bias: Vector3::zeros(),
        },
        tilt_sd: 0.01,
        heading_sd,
        velocity_sd: 1.0,
        position_sd: 1.0,
        gyro_bias_sd: 1e-3,
        accel_bias_sd: 1e-2,
    }
}

pub fn step() -> InertialStep {
    InertialStep {
        seconds: 0.01,
        angular_velocity: Vector3::new(0.1, -0.05, 0.3),
        specific_force: Some(Vector3::new(0.5, 1.0, 9.8)),
        angle_covariance: nalgebra::Matrix3::zeros(),
    }
}
