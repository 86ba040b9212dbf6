use nalgebra::{Isometry3, SMatrix, Vector3};

/// Covariance of (rotation, velocity, position, gyro bias, accelerometer bias): the rotation
/// error is the rotation vector `e` of `R_true = R_est exp(e^)` (body frame, rad), velocity
/// (m/s) and position (m) are in world coordinates, biases (rad/s, m/s^2) in the body's.
pub type NavCovariance = SMatrix<f64, 15, 15>;

/// First index of each block of three in a [`NavCovariance`].
pub mod block {
    pub const ROTATION: usize = 0;
    pub const VELOCITY: usize = 3;
    pub const POSITION: usize = 6;
    pub const GYRO_BIAS: usize = 9;
    pub const ACCEL_BIAS: usize = 12;
}

/// Point estimate of what a visual-inertial filter believes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NavState {
    pub world_from_body: Isometry3<f64>,
    /// Velocity of the body in world coordinates, m/s.
    pub velocity: Vector3<f64>,
    /// Gyroscope bias, rad/s: `measured = true + bias + noise`.
    pub gyro_bias: Vector3<f64>,
    /// Accelerometer bias, m/s^2.
    pub accel_bias: Vector3<f64>,
}

impl NavState {
    pub fn is_finite(&self) -> bool {
        let pose = &self.world_from_body;
        let vectors = [pose.translation.vector, self.velocity, self.gyro_bias, self.accel_bias];
        pose.rotation.coords.iter().chain(vectors.iter().flatten()).all(|x| x.is_finite())
    }
}

/// A concentrated belief: the mode and the covariance of the error around it.
///
/// This is the Gaussian that W22 Theorem 3.4 makes of a matrix Fisher-Gaussian distribution
/// (and back), so that it is the common ground of both filter families between updates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Belief {
    pub state: NavState,
    pub covariance: NavCovariance,
}

impl Belief {
    pub fn is_finite(&self) -> bool {
        self.state.is_finite() && self.covariance.iter().all(|x| x.is_finite())
    }
}
