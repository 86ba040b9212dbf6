//! Filters that keep map points in the state, with all correlations (`mfgs`, `iekfs`, `mekfs`).

mod error_state;
mod from_motion;
mod gravity;
mod levelling;
mod pose_clone;
mod regression;
mod rows;
mod state;
#[cfg(test)]
mod tests;
mod track;
#[cfg(test)]
mod track_lab;
#[cfg(test)]
mod track_tests;
mod track_update;
mod triangulation;
mod update;
mod window;

use nalgebra::{Dyn, Isometry3, Matrix3, OMatrix, Rotation3, U3, Vector3};

use super::calibration::Calibration;
use super::config::FilterConfig;
use super::estimator::{
    PointObservation, PointState, PointUpdate, PoseSpread, VisualInertialFilter,
};
use super::frame_change::FrameChange;
use super::gate::Gate;
use super::kind::FilterKind;
use super::map_points::point_by_pose;
use super::propagation::advance;
use super::zero_velocity::ZeroVelocity;
use crate::alignment::{MapEstimate, PointPair};
use crate::filter::core::{BayesFilter, Estimate, FilterError, InertialStep};
use crate::inertial::{Belief, NavCovariance, Propagator, block};
use crate::so3::{self, ProperSvd};
use regression::{Measurement, Target};
use rows::TrackGate;
use state::{Block, JointState, StatePoint};

/// Variance of each component of the rotation vector of a uniform rotation, rad^2:
/// `(pi^2 / 3 + 2) / 3`.
pub(super) const UNIFORM_VARIANCE: f64 = 1.763_289_378_698_817_6;
pub use error_state::{AttitudeDensity, ErrorState};
pub use from_motion::StartedFilter;
pub use track::{
    CloneId, ClonedPose, MountedCamera, PoseWindow, Track, TrackDepth, TrackOutcome, TrackUpdate,
    TrackUse, TrackView,
};

/// Visual-inertial filter whose Euclidean state is `(v, p, b_g, b_a, l_1 ... l_M)`, after `b_a`
/// gravity while its direction is unknown and the [`Calibration`] where it is estimated.
///
/// Between updates the belief is the mode and the covariance of the error around it, as in
/// [`Belief`], points in world coordinates; an update works on the regression of the Euclidean
/// part on the rotation, in the coordinates of an [`ErrorState`]. Where the calibration is part of
/// the state, an update works on points as the camera sees them, which a turn of the mounting
/// carries along: from a place that does not change nothing is measured of the calibration, however
/// pose and points are corrected.
///
/// With `n = 15 + 3 M` an update with `m` points costs `O(n^2 m)`, a propagation step `O(15^3)`:
/// what it does to the correlations with the points is gathered and done at the next update.
#[derive(Debug, Clone)]
pub struct SlamFilter {
    kind: FilterKind,
    config: FilterConfig,
    error: ErrorState,
    propagator: Propagator,
    state: JointState,
    /// By which the present pose is timed.
    timed_by: Option<Calibration>,
    /// Time that the IMU has carried the belief since points last corrected it, s.
    carried: f64,
    /// Whether the heading is that of an arbitrary world: uniform, and independent of all else.
    heading_is_free: bool,
    gate: Gate,
    track_gate: TrackGate,
}

impl SlamFilter {
    pub fn new(
        kind: FilterKind,
        config: &FilterConfig,
        error: ErrorState,
        propagator: Propagator,
        belief: Belief,
    ) -> Self {
        Self {
            kind,
            config: config.clone(),
            error,
            propagator,
            state: JointState::new(belief, config.state_points),
            timed_by: None,
            carried: 0.0,
            heading_is_free: false,
            gate: Gate::new(config),
            track_gate: TrackGate::new(config.track_false_alarm),
        }
    }

    /// The same, in a world whose heading is arbitrary: its distribution is uniform.
    pub fn with_free_heading(mut self) -> Self {
        self.heading_is_free = true;
        self
    }

    /// The same, in the body's frame at the start, in which the belief must be given: gravity of
    /// the given magnitude (m/s^2) has any direction, so that the attitude in an upright world is
    /// uniformly distributed.
    pub fn with_unknown_gravity(mut self, magnitude: f64) -> Self {
        self.state.add_unknown_gravity(magnitude);
        self.propagator.set_gravity(Vector3::zeros());
        self.with_free_heading()
    }

    /// A point measured in the body, where it is by what is known of the clock since the pose was
    /// timed.
    fn retimed(&self, in_body: &Vector3<f64>) -> Vector3<f64> {
        let calibrations = self.state.calibration.as_ref().zip(self.timed_by.as_ref());
        calibrations.map_or(*in_body, |(now, then)| {
            let timed = Calibration { time_offset: then.time_offset, ..*now };
            now.reread(&timed, in_body, &self.state.motion())
        })
    }

    /// Inverse of the mean variance of roll and pitch, 1/rad^2.
    fn tilt_concentration(&self) -> f64 {
        let belief = &self.state.belief;
        let rotation = belief.state.world_from_body.rotation.to_rotation_matrix();
        let covariance = belief.covariance.fixed_view::<3, 3>(block::ROTATION, block::ROTATION);
        let in_world = rotation.matrix() * covariance * rotation.matrix().transpose();
        2.0 / (in_world.m11 + in_world.m22)
    }

    /// The matrix Fisher parameter of rank one of a von Mises-Fisher distributed vertical and a
    /// uniform heading: `kappa e_z (R^T e_z)^T`.
    fn of_vertical(&self, kappa: f64) -> Option<ProperSvd> {
        let up = Vector3::z() * Vector3::z().transpose() * self.attitude().matrix();
        so3::proper_svd(&(up * kappa)).ok()
    }

    /// Covariance with the state, and its own, of a point seen at `in_body` (m, m^2): `l = R p' + p`,
    /// so that its error is exactly that of the pose, moved to the point, that of the calibration and
    /// that of the measurement.
    fn covariance_of_new_point(
        &self,
        position: &Vector3<f64>,
        in_body: &Vector3<f64>,
        body_covariance: &Matrix3<f64>,
    ) -> (OMatrix<f64, U3, Dyn>, Matrix3<f64>) {
        let state = &self.state;
        let rotation = self.attitude();
        let j = point_by_pose(rotation.matrix(), in_body);
        let calibration = state.by_calibration(position).into_iter().flatten();
        let first = state.row(Block::Calibration(0));
        let terms: Vec<(usize, Matrix3<f64>)> = [
            (block::ROTATION, j.fixed_columns::<3>(0).into_owned()),
            (block::POSITION, j.fixed_columns::<3>(3).into_owned()),
        ]
        .into_iter()
        .chain((first..).step_by(3).zip(calibration.map(|by| rotation * by)))
        .collect();
        let mut rows = OMatrix::<f64, U3, Dyn>::zeros(state.covariance.ncols());
        for (row, by_block) in &terms {
            rows += by_block * state.covariance.fixed_rows::<3>(*row);
        }
        let mut own = rotation.matrix() * body_covariance * rotation.matrix().transpose();
        for (row, by_block) in &terms {
            own += rows.fixed_view::<3, 3>(0, *row) * by_block.transpose();
        }
        (rows, own)
    }
}

impl BayesFilter for SlamFilter {
    fn name(&self) -> &'static str {
        self.kind.name()
    }

    fn propagate(&mut self, step: &InertialStep) -> Result<(), FilterError> {
        let transition = advance(&self.propagator, &mut self.state.belief, step)?;
        self.state.measured_rate = step.angular_velocity;
        self.state.is_cloned = false;
        self.timed_by = self.state.calibration;
        self.carried += step.seconds;
        self.state.transition = transition * self.state.transition;
        if let Some(gravity) = &mut self.state.gravity {
            gravity.propagate(&mut self.state.belief, &transition, step.seconds);
        }
        Ok(())
    }

    fn attitude(&self) -> Rotation3<f64> {
        self.state.belief.state.world_from_body.rotation.to_rotation_matrix()
    }

    fn estimate(&self) -> Estimate {
        Estimate::of_belief(&self.state.belief, self.matrix_fisher().map(|svd| svd.s))
    }

    fn gyro_bias(&self) -> Option<Vector3<f64>> {
        Some(self.state.belief.state.gyro_bias)
    }

    fn is_gaussian(&self) -> bool {
        !self.error.is_matrix_fisher()
    }
}

impl VisualInertialFilter for SlamFilter {
    fn belief(&self) -> &Belief {
        &self.state.belief
    }

    fn set_imu_gap(&mut self, in_gap: bool) {
        self.propagator.set_imu_gap(in_gap);
    }

    fn update_map_points(&mut self, pairs: &[PointPair]) -> Result<PointUpdate, FilterError> {
        let measurement = |pair: &PointPair| {
            let (position, covariance) = (pair.in_world, pair.world_covariance);
            Measurement {
                in_body: self.retimed(&pair.in_body),
                body_covariance: pair.body_covariance,
                target: Target::Known { position, covariance },
            }
        };
        let measurements: Vec<_> = pairs.iter().map(measurement).collect();
        self.condition(&measurements)
    }

    fn update_zero_velocity(&mut self, rest: &ZeroVelocity) -> Result<FrameChange, FilterError> {
        self.state.synchronize();
        let measurement = rest.linearized(&self.state.belief.state);
        if !self.state.clones.is_empty() {
            return self.update_linear(&measurement);
        }
        let correction = measurement.condition(&self.state.covariance)?;
        let mut state = self.state.clone();
        correction.reduce(&mut state.covariance);
        state.shift(&correction.change);
        self.replace_state(state)
    }

    fn matrix_fisher(&self) -> Option<ProperSvd> {
        match &self.state.gravity {
            _ if !self.error.is_matrix_fisher() => None,
            Some(gravity) if self.heading_is_free => self.of_vertical(gravity.concentration()),
            None if self.heading_is_free => self.of_vertical(self.tilt_concentration()),
            _ => {
                let covariance = self.reported_covariance();
                let upright = Belief { covariance, ..self.state.belief };
                upright.attitude().map(|attitude| *attitude.svd())
            }
        }
    }

    fn reported_covariance(&self) -> NavCovariance {
        match &self.state.gravity {
            Some(gravity) => gravity.upright_covariance(&self.state.belief),
            None => self.state.belief.covariance,
        }
    }

    fn knows_vertical(&self) -> bool {
        self.state.gravity.is_none()
    }

    fn point_state(&self) -> Option<&dyn PointState> {
        Some(self)
    }

    fn point_state_mut(&mut self) -> Option<&mut dyn PointState> {
        Some(self)
    }

    fn pose_window(&self) -> Option<&dyn PoseWindow> {
        Some(self)
    }

    fn pose_window_mut(&mut self) -> Option<&mut dyn PoseWindow> {
        Some(self)
    }

    fn calibrate(&mut self, prior: &Calibration) -> Result<(), FilterError> {
        if self.state.calibration.is_some() {
            return Err(FilterError::AlreadyEstimated("camera calibration"));
        }
        self.state.add_calibration(prior);
        Ok(())
    }

    fn calibration(&self) -> Option<&Calibration> {
        self.state.calibration.as_ref()
    }
}

impl PointState for SlamFilter {
    fn free_slots(&self) -> usize {
        self.config.state_points.saturating_sub(self.state.points.len())
    }

    fn ids(&self) -> Vec<u64> {
        self.state.points.iter().map(|point| point.id).collect()
    }

    fn estimate(&self, id: u64) -> Option<MapEstimate> {
        let slot = self.state.slot(id)?;
        let row = self.state.row(Block::Point(slot));
        Some(MapEstimate {
            position: self.state.points[slot].position,
            covariance: self.state.covariance.fixed_view::<3, 3>(row, row).into_owned(),
        })
    }

    fn update_state_points(
        &mut self,
        seen: &[PointObservation],
    ) -> Result<PointUpdate, FilterError> {
        let measurement = |(index, point): (usize, &PointObservation)| {
            let block = self.state.euclidean_index(Block::Point(self.state.slot(point.id)?));
            let measurement = Measurement {
                in_body: self.retimed(&point.in_body),
                body_covariance: point.body_covariance,
                target: Target::State { block },
            };
            Some((index, measurement))
        };
        let (indices, measurements): (Vec<_>, Vec<_>) =
            seen.iter().enumerate().filter_map(measurement).unzip();
        let mut update = self.condition(&measurements)?;
        update.refused = update.refused.into_iter().map(|refused| indices[refused]).collect();
        Ok(update)
    }

    fn admit(&mut self, point: &PointObservation) -> bool {
        if self.free_slots() == 0 || self.state.slot(point.id).is_some() {
            return false;
        }
        self.state.synchronize();
        let in_body = self.retimed(&point.in_body);
        let pose = &self.state.belief.state.world_from_body;
        let position = self.attitude() * in_body + pose.translation.vector;
        let (rows, own) = self.covariance_of_new_point(&position, &in_body, &point.body_covariance);
        self.state.append(StatePoint { id: point.id, position }, &rows, &own)
    }

    fn admit_known(&mut self, id: u64, estimate: &MapEstimate) -> bool {
        if self.free_slots() == 0 || self.state.slot(id).is_some() {
            return false;
        }
        let independent = OMatrix::<f64, U3, Dyn>::zeros(self.state.covariance.ncols());
        let point = StatePoint { id, position: estimate.position };
        self.state.append(point, &independent, &estimate.covariance)
    }

    fn release(&mut self, id: u64) -> bool {
        let slot = self.state.slot(id);
        if let Some(slot) = slot {
            self.state.remove(slot);
        }
        slot.is_some()
    }

    fn reopen_gravity(&mut self, accel_bias_sd: f64) -> bool {
        let mean = *self.propagator.gravity();
        let reopens = self.state.gravity.is_none() && mean.norm() > 0.0;
        if reopens {
            self.state.reopen_gravity(mean, accel_bias_sd);
        }
        reopens
    }

    fn add_stamp_jitter(&mut self, sd: f64) {
        self.state.add_stamp_jitter(sd);
    }

    fn reset_pose(&mut self, way: &Isometry3<f64>, spread: &PoseSpread) {
        self.state.reset_pose(way, spread);
    }
}
