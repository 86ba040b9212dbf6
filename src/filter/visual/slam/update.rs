//! The update by points: gating, conditioning, iteration, and what is refused.
//!
//! A point `l` measured at `p'` in the body frame is `0 = R p' + p - l + noise`, with `l` part of the
//! state or known apart from it. [`Regression`] has the equations.
//!
#![doc = include_str!("../../../../docs/theory/points.md")]
#![doc = include_str!("../../../../docs/math.html")]

use nalgebra::{Const, DMatrix, Point3, UnitQuaternion, Vector3};

use super::SlamFilter;
use super::gravity::UnknownGravity;
use super::pose_clone::{CLONE, CloneErrors, PoseClone};
use super::regression::{Expansion, Measurement, Posterior, Regression};
use super::rows::StateRows;
use super::state::{Block, JointState, NAVIGATION};
use crate::filter::core::{BayesFilter, FilterError};
use crate::filter::linear::LinearMeasurement;
use crate::filter::visual::estimator::{Gating, PointUpdate, contradicts};
use crate::filter::visual::frame_change::FrameChange;
use crate::inertial::block;
use crate::so3;

/// Fewer points than this may all be mismatched.
pub(super) const FEW_POINTS: usize = 8;
/// An attitude that moved further than this in an update is found anew with the terms of second
/// order, and the weights, of where it came to, rad.
pub(super) const RELINEARIZE_ABOVE: f64 = 0.02;
/// In a linear system an update turns the body by a squared Mahalanobis distance of at most that
/// of the innovations. Beyond so many times that, the concentrated form has found the density's
/// mode where it does not hold, and wrong matches have led it there.
const MOST_TURN: f64 = 4.0;
/// Innovations smaller than this are taken for as much: the 99.9 % quantile of chi-square with
/// three degrees of freedom.
const NOISE_TURN: f64 = 16.3;
/// Factors on the covariance that the IMU's fault is given, one after the other, until the points
/// are no longer contradicted.
pub(super) const INFLATIONS: [f64; 3] = [1.0, 16.0, 256.0];

/// What a posterior refuses that has no mode.
pub(super) const NO_POSTERIOR: FilterError = FilterError::NotPositive("posterior information");

/// Which points of the state an update has worked on, where the calibration is part of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Points {
    /// As the camera sees them, mounted as estimated.
    AsSeen,
    /// Those of the world.
    InWorld,
}

/// What an update would make of the belief.
struct Conditioned {
    posterior: Posterior,
    nis: f64,
    points: usize,
    gating: Gating,
    /// Whether it would turn the body much further than its innovations allow.
    turns_too_far: bool,
}

impl Conditioned {
    /// Whether it is the prediction that is wrong: a few points may be wrong themselves.
    fn contradicts(&self) -> bool {
        const MANY_POINTS: usize = 30;
        self.points_contradict() || self.turns_too_far && self.points >= MANY_POINTS
    }

    fn points_contradict(&self) -> bool {
        contradicts(self.nis, self.points)
    }
}

impl SlamFilter {
    /// Conditions the belief on points. A prediction that they contradict is the IMU's fault: its
    /// covariance is inflated as much as it takes, unless the points are so few that they may be
    /// wrong themselves. The NIS reported is that before.
    pub(super) fn condition(
        &mut self,
        measurements: &[Measurement],
    ) -> Result<PointUpdate, FilterError> {
        if measurements.is_empty() {
            return Err(FilterError::NoMeasurement);
        }
        self.state.synchronize();
        let certain = self.state.belief.covariance;
        let first = self.conditioned(measurements)?;
        let nis = first.nis;
        let latest = self.inflated_until_sound(measurements, first);
        let (points, gating) = (latest.points, latest.gating);
        let accepted = match Self::refusal(&latest) {
            Some(refusal) => Err(refusal),
            None => {
                let moved = self.moved(latest.posterior, Points::AsSeen);
                moved.and_then(|moved| self.replace_state(moved))
            }
        };
        match accepted {
            Ok(frame) => {
                self.carried = 0.0;
                Ok(PointUpdate { nis, points, gating, refused: self.gate.refused(), frame })
            }
            Err(error) => {
                self.state.belief.covariance = certain;
                self.state.synchronize();
                Err(error)
            }
        }
    }

    /// Conditions anew, with the prediction's covariance inflated by what an IMU may do wrong, while
    /// many points contradict it.
    fn inflated_until_sound(
        &mut self,
        measurements: &[Measurement],
        first: Conditioned,
    ) -> Conditioned {
        let certain = self.state.belief.covariance;
        let inflation = self.propagator.inflation(self.carried);
        let factors = if first.points < FEW_POINTS { &INFLATIONS[..1] } else { &INFLATIONS[..] };
        let mut latest = first;
        for factor in factors {
            let Some(inflation) = inflation.filter(|_| latest.contradicts()) else { break };
            self.state.belief.covariance = certain + inflation * *factor;
            self.state.synchronize();
            let Ok(inflated) = self.conditioned(measurements) else { break };
            latest = inflated;
        }
        latest
    }

    /// Why an update is not to be believed.
    fn refusal(update: &Conditioned) -> Option<FilterError> {
        let points = update.points;
        if update.turns_too_far {
            Some(FilterError::TurnsTooFar { points })
        } else if points < FEW_POINTS && update.contradicts() {
            Some(FilterError::FewContradict { points, nis: update.nis })
        } else {
            None
        }
    }

    /// What the belief becomes by points, the covariance being up to date.
    fn conditioned(&mut self, measurements: &[Measurement]) -> Result<Conditioned, FilterError> {
        let state = &self.state;
        let prior = state.belief.state.world_from_body.rotation.to_rotation_matrix();
        let means = state.euclidean();
        let changed = self.changed_coordinates();
        let covariance = changed.as_ref().unwrap_or(&state.covariance);
        let unturned = state.unturned_blocks();
        let of_prior =
            || Regression::of_prior(self.error, &prior, &means, unturned.clone(), covariance);
        let mut regression = of_prior().ok_or(FilterError::NotPositive("rotation covariance"))?;
        let distances = regression.squared_distances(measurements).ok_or(NO_POSTERIOR)?;
        let gating = self.gate.judge(distances.into_iter());
        let passed = measurements.iter().zip(self.gate.passed()).filter(|(_, passed)| **passed);
        let accepted: Vec<_> = passed.map(|(measurement, _)| *measurement).collect();
        let mut expansion = Expansion::of_prior(&prior, means.len());
        let mut renewals = self.config.relinearizations;
        let mut first = None;
        let posterior = loop {
            let found = regression
                .condition(&accepted, &expansion, self.config.huber)
                .ok_or(NO_POSTERIOR)?;
            first.get_or_insert(found);
            let posterior = regression.posterior().ok_or(NO_POSTERIOR)?;
            let turned = so3::angle_between(&expansion.mode, &posterior.expansion.mode);
            if turned < RELINEARIZE_ABOVE || renewals == 0 {
                break posterior;
            }
            renewals -= 1;
            expansion = posterior.expansion;
            regression = of_prior().ok_or(NO_POSTERIOR)?;
        };
        let (nis, points) = (first.unwrap_or_default(), accepted.len());
        let turn = so3::log(&(prior.inverse() * posterior.expansion.mode));
        let explained = 3.0 * points as f64 * nis;
        let distance = self.turn_distance(&turn).ok_or(NO_POSTERIOR)?;
        let turns_too_far = distance > MOST_TURN * explained.max(NOISE_TURN);
        Ok(Conditioned { posterior, nis, points, gating, turns_too_far })
    }

    /// Conditions the belief on a measurement of the navigation part in the coordinates of an update,
    /// so that a common turn of body and window stays as uncertain as it is.
    pub(super) fn update_linear(
        &mut self,
        measurement: &LinearMeasurement<Const<6>, Const<NAVIGATION>>,
    ) -> Result<FrameChange, FilterError> {
        let rows = StateRows::of_navigation(measurement);
        self.update_rows_as_seen(rows.ok_or(FilterError::NotPositive("measurement covariance"))?)
    }

    /// The same with rows that depend on no point of the state.
    pub(super) fn update_rows_as_seen(
        &mut self,
        rows: StateRows,
    ) -> Result<FrameChange, FilterError> {
        let rows = rows.for_update(&self.state, self.error, &self.attitude());
        let changed = self.changed_coordinates();
        let covariance = changed.as_ref().unwrap_or(&self.state.covariance);
        let parts = [(&rows, &self.expansion_of_prior())];
        let (_, posterior) = self.posterior_by_rows(covariance, &parts)?;
        let moved = self.moved(posterior, Points::AsSeen)?;
        self.replace_state(moved)
    }

    /// The covariance in the coordinates in which points condition it, where they are not those of
    /// the state.
    fn changed_coordinates(&self) -> Option<DMatrix<f64>> {
        let state = &self.state;
        if state.calibration.is_none() && state.clones.is_empty() {
            return None;
        }
        let seen = state.with_camera(state.covariance.clone(), -1.0);
        Some(state.with_clone_errors(self.error, seen, CloneErrors::ForUpdate))
    }

    /// Squared Mahalanobis distance of a turn of the body from the belief.
    fn turn_distance(&self, turn: &Vector3<f64>) -> Option<f64> {
        let covariance = self.state.covariance.fixed_view::<3, 3>(block::ROTATION, block::ROTATION);
        Some(turn.dot(&covariance.cholesky()?.solve(turn)))
    }

    /// The state with the means and the covariance of a posterior.
    pub(super) fn moved(
        &self,
        posterior: Posterior,
        points: Points,
    ) -> Result<JointState, FilterError> {
        let Posterior { means, covariance, expansion } = posterior;
        let not_finite = FilterError::NotFinite("posterior");
        let mean = |start: usize| means.get(start / 3 - 1).copied().ok_or(not_finite);
        let mut belief = self.state.belief;
        let state = &mut belief.state;
        state.world_from_body.rotation = UnitQuaternion::from_rotation_matrix(&expansion.mode);
        state.world_from_body.translation.vector = mean(block::POSITION)?;
        state.velocity = mean(block::VELOCITY)?;
        state.gyro_bias = mean(block::GYRO_BIAS)?;
        state.accel_bias = mean(block::ACCEL_BIAS)?;
        let entries = means.iter().flatten().chain(covariance.iter());
        if !belief.state.is_finite() || !entries.into_iter().all(|x| x.is_finite()) {
            return Err(not_finite);
        }
        let mut gravity = self.state.gravity.clone();
        if let Some(gravity) = &mut gravity {
            gravity.mean = mean(self.state.row(Block::Gravity))?;
            gravity.follow(&covariance);
        }
        let rows = self.state.calibration_rows();
        let mut calibration = self.state.calibration;
        if let (Some(calibration), Some([turn, translation, offset])) =
            (&mut calibration, means.get(rows.start / 3 - 1..rows.end / 3 - 1))
        {
            *calibration = calibration.moved([*turn, *translation, *offset]);
            calibration.covariance =
                covariance.fixed_view::<7, 7>(rows.start, rows.start).into_owned();
        }
        let mut moved = JointState {
            belief,
            clones: self.moved_clones(&means),
            clones_taken: self.state.clones_taken,
            is_cloned: self.state.is_cloned,
            points: self.state.points.clone(),
            covariance: DMatrix::zeros(0, 0),
            transition: self.state.transition,
            gravity,
            calibration,
            measured_rate: self.state.measured_rate,
        };
        self.place_points(&mut moved, &means, points);
        let covariance = moved.with_clone_errors(self.error, covariance, CloneErrors::Stored);
        moved.covariance = match points {
            Points::AsSeen => moved.with_camera(covariance, 1.0),
            Points::InWorld => covariance,
        };
        moved.renew_belief_covariance();
        Ok(moved)
    }

    /// The poses of the window, each moved by its own error.
    fn moved_clones(&self, means: &[Vector3<f64>]) -> Vec<PoseClone> {
        let mut clones = self.state.clones.clone();
        let first = self.state.euclidean_index(Block::Clone(0));
        let errors = means[first..].chunks_exact(CLONE / 3);
        for (clone, errors) in clones.iter_mut().zip(errors) {
            clone.shift(self.error, &errors[0], &errors[1]);
        }
        clones
    }

    /// Points where they were found, or where the camera, as it is mounted now, sees what was.
    fn place_points(&self, moved: &mut JointState, means: &[Vector3<f64>], points: Points) {
        let motion = self.state.motion();
        let base = moved.euclidean_index(Block::Point(0));
        let pose = moved.belief.state.world_from_body;
        let now = moved.calibration.filter(|_| points == Points::AsSeen);
        for (point, position) in moved.points.iter_mut().zip(means.iter().skip(base)) {
            point.position = *position;
            if let Some((now, before)) = now.as_ref().zip(self.state.calibration.as_ref()) {
                let in_body = pose.inverse_transform_point(&Point3::from(*position)).coords;
                let reread = now.reread(before, &in_body, &motion);
                point.position = (pose * Point3::from(reread)).coords;
            }
        }
    }

    /// Takes an updated state, its world levelled by what is known of gravity now. On an error
    /// nothing changes.
    pub(super) fn replace_state(
        &mut self,
        mut state: JointState,
    ) -> Result<FrameChange, FilterError> {
        let upright = state.gravity.as_ref().map(UnknownGravity::upright);
        let world_turn = state.settle_gravity()?;
        match (&state.gravity, upright) {
            (Some(gravity), _) => self.propagator.set_gravity(gravity.mean),
            (None, Some(upright)) => self.propagator.set_gravity(upright),
            (None, None) => {}
        }
        let mountings = self.state.calibration.zip(state.calibration);
        let camera_moved =
            mountings.map(|(before, now)| now.body_from_camera * before.body_from_camera.inverse());
        self.state = state;
        Ok(FrameChange { world_turn, camera_moved })
    }
}
