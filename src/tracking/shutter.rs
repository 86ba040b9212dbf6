//! Rolling shutters: rows of an image are exposed one after the other while the camera moves.

use nalgebra::{Isometry3, SMatrix, SVector, Vector3};

use crate::inertial::{Belief, NavState, block};
use crate::sensor::CameraConfig;

/// Delay of the rows of one image against its stamp, and the motion of the camera meanwhile.
///
/// A point at `p` in camera coordinates at the stamp is at `p - d (w x p + v)` when a row delayed
/// by `d` is exposed, to first order: the camera turns with `w` and moves with `v`. The default is
/// without delay.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Shutter {
    /// s a row.
    row_time: f64,
    middle_row: f64,
    /// Camera coordinates, rad/s.
    angular_velocity: Vector3<f64>,
    /// Camera coordinates, m/s.
    velocity: Vector3<f64>,
}

impl Shutter {
    /// Of an image with `rows` rows, taken from a body in `state` with a gyroscope that reads
    /// `measured_rate` (rad/s).
    pub fn new(
        config: &CameraConfig,
        rows: usize,
        body_from_camera: &Isometry3<f64>,
        state: &NavState,
        measured_rate: &Vector3<f64>,
    ) -> Self {
        let camera_from_body = body_from_camera.rotation.inverse();
        let angular_velocity = measured_rate - state.gyro_bias;
        let velocity = state.world_from_body.rotation.inverse() * state.velocity
            + angular_velocity.cross(&body_from_camera.translation.vector);
        Self {
            row_time: config.readout_time / rows.max(1) as f64,
            middle_row: 0.5 * rows as f64,
            angular_velocity: camera_from_body * angular_velocity,
            velocity: camera_from_body * velocity,
        }
    }

    pub fn is_rolling(&self) -> bool {
        self.row_time != 0.0
    }

    fn delay(&self, row: f64) -> f64 {
        self.row_time * (row - self.middle_row)
    }

    fn motion_of(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.angular_velocity.cross(point) + self.velocity
    }

    /// Where a point is at the stamp that is at `point` (camera coordinates, m) when `row` is exposed.
    pub fn at_stamp(&self, point: &Vector3<f64>, row: f64) -> Vector3<f64> {
        point + self.motion_of(point) * self.delay(row)
    }

    /// Where a point is when `row` is exposed that is at `point` (camera coordinates, m) at the stamp.
    pub fn at_row(&self, point: &Vector3<f64>, row: f64) -> Vector3<f64> {
        point - self.motion_of(point) * self.delay(row)
    }
}

/// The state with the pose `world_from_body`, and the rest of it what `belief` then expects of it.
/// `None` if the belief has no pose covariance that is positive definite.
pub(super) fn given_pose(belief: &Belief, world_from_body: &Isometry3<f64>) -> Option<NavState> {
    let pose = &belief.state.world_from_body;
    let turn = (pose.rotation.inverse() * world_from_body.rotation).scaled_axis();
    let shift = world_from_body.translation.vector - pose.translation.vector;
    let error = SVector::<f64, 6>::from_fn(|i, _| if i < 3 { turn[i] } else { shift[i - 3] });
    let row = |i: usize| if i < 3 { block::ROTATION + i } else { block::POSITION + i - 3 };
    let with_pose = SMatrix::<f64, 15, 6>::from_fn(|i, j| belief.covariance[(i, row(j))]);
    let of_pose = SMatrix::<f64, 6, 6>::from_fn(|i, j| belief.covariance[(row(i), row(j))]);
    let state = belief.state.corrected_by(&(with_pose * of_pose.cholesky()?.solve(&error)));
    state.is_finite().then_some(state)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::inertial::{NavCovariance, Propagator};
    use nalgebra::{UnitQuaternion, Vector3};

    const ROWS: usize = 480;

    fn state() -> NavState {
        NavState {
            world_from_body: Isometry3::new(
                Vector3::new(0.3, -0.2, 1.0),
                Vector3::new(0.4, 0.1, -0.8),
            ),
            velocity: Vector3::new(0.5, -0.3, 0.2),
            gyro_bias: Vector3::new(-0.9, 0.4, 0.6),
            accel_bias: Vector3::zeros(),
        }
    }

    /// Against the motion itself, whose second order is 0.1 mm here.
    #[test]
    fn points_are_where_the_moving_camera_sees_them() {
        let config = CameraConfig { readout_time: 0.025, ..CameraConfig::default() };
        let body_from_camera =
            Isometry3::new(Vector3::new(0.05, 0.02, -0.1), Vector3::new(-0.3, 1.0, 0.2));
        let state = state();
        let measured = Vector3::new(0.1, -0.1, 0.2);
        let shutter = Shutter::new(&config, ROWS, &body_from_camera, &state, &measured);
        let at = |time: f64| {
            let turn = UnitQuaternion::from_scaled_axis((measured - state.gyro_bias) * time);
            let pose = &state.world_from_body;
            let position = pose.translation.vector + state.velocity * time;
            Isometry3::from_parts(position.into(), pose.rotation * turn) * body_from_camera
        };
        let point = nalgebra::Point3::new(0.4, -0.6, 2.0);
        for row in [0.0, 100.0, 240.0, 479.0] {
            let time = 0.025 * (row - 240.0) / ROWS as f64;
            let seen = at(time).inverse_transform_point(&(at(0.0) * point)).coords;
            assert!((shutter.at_stamp(&seen, row) - point.coords).norm() < 5e-4);
            assert!((shutter.at_row(&point.coords, row) - seen).norm() < 5e-4);
            assert!(row == 240.0 || (seen - point.coords).norm() > 5e-3);
        }
    }

    #[test]
    fn a_pose_tells_the_motion_that_led_to_it() {
        let mut belief = Belief { state: state(), covariance: NavCovariance::identity() * 1e-10 };
        for k in 0..3 {
            belief.covariance[(block::VELOCITY + k, block::VELOCITY + k)] = 1.0;
            belief.covariance[(block::GYRO_BIAS + k, block::GYRO_BIAS + k)] = 1.0;
        }
        let interval = 0.01;
        let mut there = belief.state;
        there.velocity += Vector3::new(0.2, -0.1, 0.3);
        there.gyro_bias += Vector3::new(0.1, 0.2, -0.1);
        let moved = |state: NavState| {
            let mut belief = Belief { state, ..belief };
            Propagator::constant_velocity(0.0, 0.0).coast(&mut belief, interval);
            belief
        };
        let arrived = moved(there).state;
        let expected = given_pose(&moved(belief.state), &arrived.world_from_body).unwrap();
        assert!((expected.velocity - arrived.velocity).norm() < 5e-3);
        assert!((expected.gyro_bias - arrived.gyro_bias).norm() < 5e-3);
    }
}
