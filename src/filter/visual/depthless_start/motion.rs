//! Poses as the IMU tells them, and what is sought beside.

use nalgebra::{Matrix3, OMatrix, SVector, U3, U12, Vector3};

use super::start_block;
use crate::filter::core::{FilterError, InertialStep};
use crate::so3;

/// Pose of a frame in the first body's frame as far as the IMU tells it, with its derivatives.
#[derive(Debug, Clone, Copy)]
pub(super) struct Motion {
    pub rotation: Matrix3<f64>,
    /// s since the first frame.
    pub time: f64,
    /// Without initial velocity and gravity, m and m/s.
    place: Vector3<f64>,
    pub speed: Vector3<f64>,
    /// Of the rotation vector at `rotation` by the gyroscope's bias.
    turn_by_gyro: Matrix3<f64>,
    place_by_gyro: Matrix3<f64>,
    speed_by_gyro: Matrix3<f64>,
    place_by_accel: Matrix3<f64>,
    speed_by_accel: Matrix3<f64>,
}

/// Velocity, gravity and biases, by [`start_block`].
pub(super) type Sought = SVector<f64, 12>;
pub(super) type BySought = OMatrix<f64, U3, U12>;

pub(super) fn part(sought: &Sought, start: usize) -> Vector3<f64> {
    sought.fixed_rows::<3>(start).into_owned()
}

impl Motion {
    pub const START: Self = {
        let (zero, none) =
            (Matrix3::new(0., 0., 0., 0., 0., 0., 0., 0., 0.), Vector3::new(0., 0., 0.));
        Self {
            rotation: Matrix3::new(1., 0., 0., 0., 1., 0., 0., 0., 1.),
            time: 0.0,
            place: none,
            speed: none,
            turn_by_gyro: zero,
            place_by_gyro: zero,
            speed_by_gyro: zero,
            place_by_accel: zero,
            speed_by_accel: zero,
        }
    };

    /// The same after a step of the IMU, as [`Propagator`](crate::inertial::Propagator) takes it.
    pub fn after(&self, step: &InertialStep, sought: &Sought) -> Result<Self, FilterError> {
        step.check()?;
        let h = step.seconds;
        let force = step.specific_force.ok_or(FilterError::NoSpecificForce)?
            - part(sought, start_block::ACCEL_BIAS);
        let turn = (step.angular_velocity - part(sought, start_block::GYRO_BIAS)) * h;
        let half = turn * 0.5;
        let middle = self.rotation * so3::exp(&half).matrix();
        let acceleration = middle * force;
        // The error half-way is `exp(-turn/2) e - (h/2) J_r(turn/2) db`.
        let half_way =
            so3::exp(&-half).matrix() * self.turn_by_gyro - so3::right_jacobian(&half) * (0.5 * h);
        let by_gyro = -(middle * force.cross_matrix()) * half_way;
        Ok(Self {
            rotation: self.rotation * so3::exp(&turn).matrix(),
            time: self.time + h,
            place: self.place + self.speed * h + acceleration * (0.5 * h * h),
            speed: self.speed + acceleration * h,
            turn_by_gyro: so3::exp(&-turn).matrix() * self.turn_by_gyro
                - so3::right_jacobian(&turn) * h,
            place_by_gyro: self.place_by_gyro + self.speed_by_gyro * h + by_gyro * (0.5 * h * h),
            speed_by_gyro: self.speed_by_gyro + by_gyro * h,
            place_by_accel: self.place_by_accel + self.speed_by_accel * h - middle * (0.5 * h * h),
            speed_by_accel: self.speed_by_accel - middle * h,
        })
    }

    /// `p_k = v t + g t^2/2 + (double integral of R f)`.
    pub fn position(&self, sought: &Sought) -> Vector3<f64> {
        let (velocity, gravity) =
            (part(sought, start_block::VELOCITY), part(sought, start_block::GRAVITY));
        self.place + velocity * self.time + gravity * (0.5 * self.time * self.time)
    }

    /// Derivative of `R_k^T (l - p_k)`, a point at `in_body`, by what is sought.
    pub fn point_by_sought(&self, in_body: &Vector3<f64>) -> BySought {
        let to_body = self.rotation.transpose();
        let mut by = BySought::zeros();
        let mut set = |start: usize, value: Matrix3<f64>| {
            by.fixed_view_mut::<3, 3>(0, start).copy_from(&value);
        };
        set(start_block::VELOCITY, to_body * -self.time);
        set(start_block::GRAVITY, to_body * (-0.5 * self.time * self.time));
        set(start_block::ACCEL_BIAS, -(to_body * self.place_by_accel));
        let turned = in_body.cross_matrix() * self.turn_by_gyro;
        set(start_block::GYRO_BIAS, turned - to_body * self.place_by_gyro);
        by
    }
}
