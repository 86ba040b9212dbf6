//! Whether the world's vertical is known, and whether what levelled it is still to be believed.

use super::report::Note;
use super::restart::BIAS_FACTOR;
use crate::filter::VisualInertialFilter;
use crate::inertial::{Belief, ImuConfig, block};
use crate::sensor::Stamp;

/// The levelling of a start.
#[derive(Debug, Clone)]
pub(super) struct Levelling {
    /// The start, until the vertical is known.
    sought_since: Option<Stamp>,
    /// Whether what is known of the accelerometer's bias is what was assumed at the start.
    counts: bool,
}

impl Levelling {
    pub fn of(filter: &dyn VisualInertialFilter, start: Stamp) -> Self {
        Self { sought_since: (!filter.knows_vertical()).then_some(start), counts: true }
    }

    /// Reopens the alignment with gravity where the accelerometer's bias proves to be none of its
    /// kind.
    pub fn reopen(&mut self, filter: &mut dyn VisualInertialFilter, stamp: Stamp, imu: &ImuConfig) {
        let accel_bias_sd = BIAS_FACTOR * imu.accel_bias_sd;
        let counted = std::mem::take(&mut self.counts);
        if counted && filter.point_state_mut().is_some_and(|s| s.reopen_gravity(accel_bias_sd)) {
            self.sought_since = Some(stamp);
        }
    }

    /// The levelling counts no more once the bias is known much better than at the start, or may
    /// have changed since.
    pub fn weigh(&mut self, belief: &Belief, contradicted: bool, imu: &ImuConfig) {
        let bias = belief.covariance.fixed_view::<3, 3>(block::ACCEL_BIAS, block::ACCEL_BIAS);
        let found = bias.diagonal().max().sqrt() < 0.5 * imu.accel_bias_sd;
        self.counts &= !found && !contradicted;
    }

    /// Notes that the vertical is known when it has become so.
    pub fn note(&mut self, filter: &dyn VisualInertialFilter, stamp: Stamp) -> Option<Note> {
        let since = self.sought_since.take_if(|_| filter.knows_vertical())?;
        let belief = filter.belief();
        let rotation = belief.state.world_from_body.rotation.to_rotation_matrix();
        let covariance = belief.covariance.fixed_view::<3, 3>(block::ROTATION, block::ROTATION);
        let in_world = rotation.matrix() * covariance * rotation.matrix().transpose();
        let sd = (0.5 * (in_world.m11 + in_world.m22)).sqrt().to_degrees();
        let seconds = stamp.seconds_since(since);
        let text =
            format!("attitude found after {seconds:.2} s: roll and pitch known to {sd:.1} deg");
        Some(Note::info(text))
    }
}
