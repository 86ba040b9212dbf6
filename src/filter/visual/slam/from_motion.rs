//! From a start without depth to a filter.

use nalgebra::{DMatrix, DVector, Isometry3, Matrix3, Vector3};

use super::rows::StateRows;
use super::state::Block;
use super::track::{CloneId, MountedCamera, PoseWindow, Track, TrackOutcome, TrackUse, TrackView};
use super::{ErrorState, SlamFilter};
use crate::filter::core::{BayesFilter, FilterError, InertialStep, VectorEstimate};
use crate::filter::visual::config::FilterConfig;
use crate::filter::visual::depthless_start::{StartInput, StartPrior, StartSolution, StartTrack};
use crate::filter::visual::estimator::VisualInertialFilter;
use crate::filter::visual::kind::FilterKind;
use crate::inertial::{Belief, NavCovariance, NavState, Propagator, block};

/// Standard deviation of the pose of the first body in its own frame, rad and m: what is certain by
/// definition, and what rounding needs.
const OWN_FRAME_SD: f64 = 1e-5;
/// Standard deviation of a velocity of which nothing is known, m/s, and that much more than it is.
const VELOCITY_SD: f64 = 10.0;
/// By so much more the biases' priors are spread around what was found of them, until they are used.
const SPREAD: f64 = 3.0;

/// A filter that has started without depth.
pub struct StartedFilter {
    pub filter: Box<dyn VisualInertialFilter>,
    /// The poses of its window, with the frames that they are of.
    pub clones: Vec<(usize, CloneId)>,
    /// For each track what became of it. Views at frames without a pose were not used.
    pub outcomes: Vec<TrackOutcome>,
    /// Standard deviation of the logarithm of the scale, the IMU's white noise included; infinite
    /// where no point has entered the state.
    pub scale_sd: f64,
    /// Logarithm of what the filter has changed the scale of the [`StartSolution`] by: it was
    /// linearised there.
    pub scale_change: f64,
}

impl StartedFilter {
    /// Whether the scale is known well enough to go on with this filter: to 5 %, and the filter was
    /// linearised where it has come to. Else the start is to be made again with the next frame.
    pub fn is_ready(&self) -> bool {
        const SCALE_SD: f64 = 0.05;
        const SCALE_CHANGE: f64 = 0.1;
        self.scale_sd < SCALE_SD && self.scale_change.abs() < SCALE_CHANGE
    }
}

impl SlamFilter {
    /// Runs a filter over the frames of a start: from what was found, but knowing no more than
    /// before, so that nothing is used twice. It clones the poses of the frames `kept`, and takes the
    /// points into its state that the last of them sees, as far as there are slots.
    ///
    /// # Errors
    /// Those of propagation and update; [`FilterError::NoMeasurement`] without two frames kept.
    pub fn from_motion(
        kind: FilterKind,
        error: ErrorState,
        config: &FilterConfig,
        propagator: Propagator,
        input: &StartInput<'_>,
        found: &StartSolution,
        kept: &[usize],
    ) -> Result<StartedFilter, FilterError> {
        let StartInput { frames, tracks, cameras, prior } = input;
        let belief = diffuse_belief(prior, found);
        let mut filter =
            Self::new(kind, config, error, propagator, belief).with_unknown_gravity(prior.gravity);
        filter.expect_gravity(found.gravity);
        let clones = filter.clone_frames(frames, kept)?;
        if clones.len() < 2 {
            return Err(FilterError::NoMeasurement);
        }
        let tracks: Vec<_> = tracks.iter().map(|track| seen_by(track, &clones)).collect();
        let outcomes = filter.use_all(&tracks, cameras)?;
        filter.use_bias_priors(prior, found)?;
        let scale_sd = filter.scale_sd().unwrap_or(f64::INFINITY);
        let scale_change = filter.scale_change(found);
        Ok(StartedFilter { filter: Box::new(filter), clones, outcomes, scale_sd, scale_change })
    }

    /// Takes the mean of the unknown gravity for this.
    fn expect_gravity(&mut self, mean: Vector3<f64>) {
        if let Some(gravity) = &mut self.state.gravity {
            gravity.mean = mean;
        }
        self.propagator.set_gravity(mean);
    }

    fn clone_frames(
        &mut self,
        frames: &[Vec<InertialStep>],
        kept: &[usize],
    ) -> Result<Vec<(usize, CloneId)>, FilterError> {
        let mut clones = Vec::with_capacity(kept.len());
        for (frame, steps) in frames.iter().enumerate() {
            for step in steps {
                self.propagate(step)?;
            }
            if kept.contains(&frame) {
                clones.push((frame, self.clone_pose(0.0)?));
            }
        }
        Ok(clones)
    }

    /// Updates by all tracks, as many at once as an update takes.
    fn use_all(
        &mut self,
        tracks: &[Track],
        cameras: &[MountedCamera],
    ) -> Result<Vec<TrackOutcome>, FilterError> {
        let mut outcomes = vec![TrackOutcome::Deferred; tracks.len()];
        loop {
            let waiting: Vec<usize> =
                (0..tracks.len()).filter(|k| outcomes[*k] == TrackOutcome::Deferred).collect();
            if waiting.is_empty() {
                return Ok(outcomes);
            }
            let offered: Vec<Track> = waiting.iter().map(|k| tracks[*k].clone()).collect();
            let update = self.update_tracks(&offered, cameras)?;
            for (k, outcome) in waiting.into_iter().zip(update.outcomes) {
                outcomes[k] = outcome;
            }
        }
    }

    /// Turns the spread of the biases around what was found into their prior: with
    /// `P' = SPREAD^2 P` around `b^` the measurement that makes `N(b_0, P)` of it has the covariance
    /// `R = (P^-1 - P'^-1)^-1` and the mean `R (P^-1 b_0 - P'^-1 b^)`.
    fn use_bias_priors(
        &mut self,
        prior: &StartPrior,
        found: &StartSolution,
    ) -> Result<(), FilterError> {
        let state = &self.state.belief.state;
        let factor = 1.0 / (1.0 - SPREAD.powi(-2));
        let parts: Vec<_> = [
            (block::GYRO_BIAS, &prior.gyro_bias, found.gyro_bias, state.gyro_bias),
            (block::ACCEL_BIAS, &prior.accel_bias, found.accel_bias, state.accel_bias),
        ]
        .into_iter()
        .map(|(row, prior, found, now)| {
            let mean = (prior.mean - found * SPREAD.powi(-2)) * factor;
            let root = (prior.covariance * factor).cholesky()?.l().try_inverse()?;
            let residual = root * (mean - now);
            Some(StateRows {
                blocks: vec![row],
                jacobian: DMatrix::from_fn(3, 3, |i, j| root[(i, j)]),
                residual: DVector::from_fn(3, |i, _| residual[i]),
            })
        })
        .collect::<Option<_>>()
        .ok_or(FilterError::NotPositive("covariance of a bias"))?;
        self.update_rows_as_seen(StateRows::stack(parts.iter())).map(|_| ())
    }

    /// Logarithm of the ratio of how far the points of the state are from each other to how far they
    /// were found to be; 0 without points.
    fn scale_change(&self, found: &StartSolution) -> f64 {
        let held = |id: u64| self.state.slot(id).map(|slot| self.state.points[slot].position);
        let pairs = found.points.iter().filter_map(|(id, before)| Some((*before, held(*id)?)));
        let (before, after): (Vec<_>, Vec<_>) = pairs.unzip();
        if before.len() < 2 { 0.0 } else { (spread(&after) / spread(&before)).ln() }
    }

    /// Of the mean logarithm of the points' ranges from the body.
    fn scale_sd(&self) -> Option<f64> {
        let state = &self.state;
        let count = state.points.len() as f64;
        let place = state.belief.state.world_from_body.translation.vector;
        let mut mean = DVector::zeros(state.covariance.ncols());
        for (slot, point) in state.points.iter().enumerate() {
            let by = (point.position - place) / (point.position - place).norm_squared() / count;
            let mut of_point = mean.fixed_rows_mut::<3>(state.row(Block::Point(slot)));
            of_point += by;
            let mut of_body = mean.fixed_rows_mut::<3>(block::POSITION);
            of_body -= by;
        }
        let variance = mean.dot(&(&state.covariance * &mean));
        (count > 0.0).then(|| variance.sqrt())
    }
}

/// Root of the mean squared distance of points from their centre, m.
fn spread(points: &[Vector3<f64>]) -> f64 {
    let count = points.len().max(1) as f64;
    let centre = points.iter().sum::<Vector3<f64>>() / count;
    (points.iter().map(|point| (point - centre).norm_squared()).sum::<f64>() / count).sqrt()
}

/// What was found, as unsure as before: in the frame of the first body pose and place are certain.
fn diffuse_belief(prior: &StartPrior, found: &StartSolution) -> Belief {
    let mut covariance = NavCovariance::identity() * OWN_FRAME_SD.powi(2);
    let velocity_sd = VELOCITY_SD + found.velocity.norm();
    let mut set = |row: usize, value: Matrix3<f64>| {
        covariance.fixed_view_mut::<3, 3>(row, row).copy_from(&value);
    };
    let spread = |bias: &VectorEstimate| bias.covariance * SPREAD.powi(2);
    set(block::VELOCITY, Matrix3::identity() * velocity_sd.powi(2));
    set(block::GYRO_BIAS, spread(&prior.gyro_bias));
    set(block::ACCEL_BIAS, spread(&prior.accel_bias));
    let state = NavState {
        world_from_body: Isometry3::identity(),
        velocity: found.velocity,
        gyro_bias: found.gyro_bias,
        accel_bias: found.accel_bias,
    };
    Belief { state, covariance }
}

/// A track's views at the poses of a window.
fn seen_by(track: &StartTrack, clones: &[(usize, CloneId)]) -> Track {
    let views = track.views.iter().filter_map(|view| {
        let (_, clone) = clones.iter().find(|(frame, _)| *frame == view.frame)?;
        Some(TrackView {
            clone: *clone,
            camera: view.camera,
            pixel: view.pixel,
            pixel_covariance: view.pixel_covariance,
            depth: None,
        })
    });
    let views: Vec<TrackView> = views.collect();
    let last = clones.last().map(|(_, clone)| *clone);
    let lives = views.iter().any(|view| Some(view.clone) == last);
    let purpose = if lives { TrackUse::Admit } else { TrackUse::Eliminate };
    Track { id: track.id, views, purpose }
}
