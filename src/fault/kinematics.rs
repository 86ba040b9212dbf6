//! Poses that no body reaches by itself.

use nalgebra::{Isometry3, Vector3};

use super::FaultConfig;
use crate::sensor::Stamp;

/// A pose that the map is seen from, after one that nothing spoke against.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseStep {
    pub before: Isometry3<f64>,
    /// Of the body before, world coordinates, m/s.
    pub velocity: Vector3<f64>,
    /// When that was.
    pub before_at: Stamp,
    pub after: Isometry3<f64>,
    /// Whether the body was not seen on its way.
    pub unseen: bool,
}

/// What moves a body: bounds on its way, whatever the IMU says, which may be what is wrong.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Envelope {
    /// A pose of few matches may be off by so much, m and rad.
    pub slack: (f64, f64),
    /// Largest acceleration, m/s^2, and rate, rad/s.
    pub acceleration: f64,
    pub rate: f64,
    /// Forces as large last no longer than an impact, s, or the body would have been seen on its way.
    pub impact: f64,
}

impl Envelope {
    pub fn new(config: &FaultConfig) -> Self {
        Self {
            slack: (0.1, 0.1),
            acceleration: config.max_force,
            rate: config.max_rate,
            impact: 0.034,
        }
    }

    /// How far beyond what moves a body a step is: above 1 none gets there by itself.
    pub fn excess(&self, step: &PoseStep, at: Stamp) -> f64 {
        let seconds = at.seconds_since(step.before_at).max(0.0);
        let pushed = if step.unseen { seconds } else { seconds.min(self.impact) };
        let way = step.before.inv_mul(&step.after);
        let coasting = step.velocity.norm() * seconds;
        let reach = self.slack.0 + coasting + 0.5 * self.acceleration * pushed.powi(2);
        let turn = self.slack.1 + self.rate * pushed;
        (way.translation.vector.norm() / reach).max(way.rotation.angle() / turn)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_no_body_reaches_is_a_jump() {
        let step = |shift: f64, turn: f64, unseen: bool, seconds: f64| {
            let step = PoseStep {
                before: Isometry3::identity(),
                velocity: Vector3::x(),
                before_at: Stamp::default(),
                after: Isometry3::new(Vector3::y() * shift, Vector3::z() * turn),
                unseen,
            };
            let envelope = Envelope::new(&FaultConfig::default());
            envelope.excess(&step, Stamp::default().offset_by(seconds)) > 1.0
        };
        assert!(!step(0.2, 0.3, false, 0.033) && step(0.5, 0.0, false, 0.033));
        assert!(step(0.0, 1.0, false, 0.033) && !step(0.0, 1.0, true, 0.2));
        // In the dark it may have been thrown.
        assert!(!step(10.0, 0.0, true, 0.5) && step(10.0, 0.0, false, 0.5));
        assert!(!step(1.0, 0.0, false, 1.0));
    }
}
