use nalgebra::{Matrix3, Vector3};

use super::Stamp;

/// rad/s.
const MOST_RATE: f64 = 1e5;
/// m/s^2.
const MOST_FORCE: f64 = 1e8;

/// One reading of the inertial measurement unit, in SI units, biases and noise included.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImuSample {
    pub stamp: Stamp,
    /// Angular velocity of the body in body coordinates, rad/s.
    pub angular_velocity: Vector3<f64>,
    /// Specific force `R^T (a - g)` in body coordinates, m/s^2.
    pub specific_force: Vector3<f64>,
}

impl ImuSample {
    /// The reading at `stamp` on the line between two samples; the later one where they are not
    /// apart.
    pub fn between(from: &Self, to: &Self, stamp: Stamp) -> Self {
        let interval = to.stamp.seconds_since(from.stamp);
        let fraction =
            if interval > 0.0 { stamp.seconds_since(from.stamp) / interval } else { 1.0 };
        Self {
            stamp,
            angular_velocity: from.angular_velocity.lerp(&to.angular_velocity, fraction),
            specific_force: from.specific_force.lerp(&to.specific_force, fraction),
        }
    }

    /// Whether a sensor may have read this, in whatever unit: finite, and below ten times what
    /// ultracentrifuges reach. What is not is no measurement, and its squares would overflow.
    pub fn is_possible(&self) -> bool {
        let within = |v: &Vector3<f64>, most: f64| v.iter().all(|x| x.abs() <= most);
        within(&self.angular_velocity, MOST_RATE) && within(&self.specific_force, MOST_FORCE)
    }
}

/// A position measured by a GNSS receiver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PositionFix {
    pub stamp: Stamp,
    /// World coordinates (local, z up), m.
    pub position: Vector3<f64>,
    /// Of the position, m^2; `None` where the log tells none.
    pub covariance: Option<Matrix3<f64>>,
}
