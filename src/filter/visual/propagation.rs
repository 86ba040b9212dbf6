//! Carrying a visual-inertial belief through one interval of inertial data.

use nalgebra::Vector3;

use crate::filter::core::{FilterError, InertialStep};
use crate::inertial::{Belief, MotionModel, NavCovariance, Propagator};

/// Moves a belief on; gives the derivative of its error after the interval by that before it. On an
/// error nothing changes.
pub(super) fn advance(
    propagator: &Propagator,
    belief: &mut Belief,
    step: &InertialStep,
) -> Result<NavCovariance, FilterError> {
    let (gyro, accel) = interval_means(propagator, step)?;
    propagator
        .advance_with_transition(belief, &gyro, &accel, step.seconds)
        .ok_or(FilterError::NotFinite("propagated belief"))
}

/// Mean angular velocity (rad/s) and specific force (m/s^2) of an interval, body coordinates; zeros
/// for a model of motion that measures nothing.
pub(super) fn interval_means(
    propagator: &Propagator,
    step: &InertialStep,
) -> Result<(Vector3<f64>, Vector3<f64>), FilterError> {
    step.check()?;
    match propagator.model() {
        MotionModel::ConstantVelocity => Ok((Vector3::zeros(), Vector3::zeros())),
        MotionModel::Inertial => {
            let force = step.specific_force.ok_or(FilterError::NoSpecificForce)?;
            Ok((step.angular_velocity, force))
        }
    }
}
