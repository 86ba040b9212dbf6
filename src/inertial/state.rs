use nalgebra::{Isometry3, Matrix6, SMatrix, SVector, UnitQuaternion, Vector3};

use crate::distribution::matrix_fisher::MatrixFisher;

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

/// The (rotation, position) blocks of a [`NavCovariance`].
pub fn pose_covariance(covariance: &NavCovariance) -> Matrix6<f64> {
    let mut pose = Matrix6::zeros();
    let starts = [block::ROTATION, block::POSITION];
    for (i, from_row) in starts.into_iter().enumerate() {
        for (j, from_column) in starts.into_iter().enumerate() {
            pose.fixed_view_mut::<3, 3>(3 * i, 3 * j)
                .copy_from(&covariance.fixed_view::<3, 3>(from_row, from_column));
        }
    }
    pose
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
    /// The state whose error, in the coordinates of [`NavCovariance`], this one had.
    pub fn corrected_by(&self, error: &SVector<f64, 15>) -> Self {
        let part = |start: usize| error.fixed_rows::<3>(start).into_owned();
        let turn = UnitQuaternion::from_scaled_axis(part(block::ROTATION));
        let rotation = self.world_from_body.rotation * turn;
        let position = self.world_from_body.translation.vector + part(block::POSITION);
        Self {
            world_from_body: Isometry3::from_parts(
                position.into(),
                UnitQuaternion::new_normalize(rotation.into_inner()),
            ),
            velocity: self.velocity + part(block::VELOCITY),
            gyro_bias: self.gyro_bias + part(block::GYRO_BIAS),
            accel_bias: self.accel_bias + part(block::ACCEL_BIAS),
        }
    }

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

    /// The matrix Fisher distribution with the same mode and the same curvature there as the
    /// Gaussian of the rotation error: `F = M (tr(H)/2 I - H)` with `H` its inverse covariance.
    /// `None` if that covariance is not positive definite.
    pub fn attitude(&self) -> Option<MatrixFisher> {
        let mode = self.state.world_from_body.rotation.to_rotation_matrix();
        let rotation = self.covariance.fixed_view::<3, 3>(block::ROTATION, block::ROTATION);
        let information = rotation.into_owned().cholesky()?.inverse();
        MatrixFisher::from_mode_and_information(mode, information).ok()
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Matrix3;

    use super::*;

    #[test]
    fn the_attitude_has_the_mode_and_the_curvature_of_the_covariance() {
        let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(0.4, -1.1, 0.7));
        let state = NavState {
            world_from_body: Isometry3::from_parts(Vector3::zeros().into(), rotation),
            velocity: Vector3::zeros(),
            gyro_bias: Vector3::zeros(),
            accel_bias: Vector3::zeros(),
        };
        let root = Matrix3::new(0.01, 0.0, 0.0, 0.004, 0.02, 0.0, -0.003, 0.001, 0.1);
        let mut covariance = NavCovariance::identity();
        covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&(root * root.transpose()));
        let mut belief = Belief { state, covariance };
        let attitude = belief.attitude().unwrap();
        let mode = rotation.to_rotation_matrix();
        assert_relative_eq!(attitude.mode().matrix(), mode.matrix(), epsilon = 1e-12);
        assert_relative_eq!(
            attitude.information() * root * root.transpose(),
            Matrix3::identity(),
            epsilon = 1e-9
        );
        belief.covariance.fixed_view_mut::<3, 3>(0, 0).fill(0.0);
        assert!(belief.attitude().is_none());
    }
}
