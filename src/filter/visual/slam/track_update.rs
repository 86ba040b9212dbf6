//! The update by tracks: elimination of their points, gating, admission, one update.
//!
#![doc = include_str!("../../../../docs/theory/tracks.md")]
#![doc = include_str!("../../../../docs/math.html")]

use nalgebra::{DMatrix, Vector3};

use super::SlamFilter;
use super::pose_clone::CloneErrors;
use super::regression::{Expansion, Posterior, Regression};
use super::rows::{Eliminated, StateRows, UpdateRows};
use super::state::{Block, JointState};
use super::track::{
    CloneId, ClonedPose, MountedCamera, PoseWindow, Track, TrackOutcome, TrackUpdate, TrackUse,
    TrackView,
};
use super::triangulation::{PlacedTrack, Triangulated};
use super::update::{FEW_POINTS, INFLATIONS, NO_POSTERIOR, Points, RELINEARIZE_ABOVE};
use crate::alignment::MapEstimate;
use crate::filter::core::{BayesFilter, FilterError};
use crate::filter::visual::estimator::PointState;

/// A point whose range is known worse than this, relative to it, does not enter the state: there its
/// error is Gaussian along the ray, which that of an inverse range is not.
const WORST_RANGE: f64 = 0.2;

/// A track that enters an update.
struct Accepted<'a> {
    track: &'a Track,
    kind: Kind,
    /// Linearised at the prediction.
    rows: StateRows,
    /// Of its point, world coordinates.
    position: Vector3<f64>,
}

/// What becomes of an accepted track's point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// It is eliminated.
    Eliminated,
    /// It has entered the state by other rows of the track.
    Admitted,
    /// It was part of the state.
    Held,
}

/// What came of looking at all tracks.
struct Judged<'a> {
    outcomes: Vec<TrackOutcome>,
    accepted: Vec<Accepted<'a>>,
    /// Whether the prediction was contradicted, and has been inflated.
    contradicted: bool,
}

/// What an update makes of the belief.
struct Moved {
    state: JointState,
    nis: f64,
    rows: usize,
}

impl Accepted<'_> {
    fn outcome(&self) -> TrackOutcome {
        match self.kind {
            Kind::Admitted => TrackOutcome::Admitted,
            Kind::Eliminated | Kind::Held => TrackOutcome::Used { position: self.position },
        }
    }

    /// Its rows linearised at another state; those of an admitted point stay as they are.
    fn rows_at(
        &self,
        state: &JointState,
        cameras: &[MountedCamera],
    ) -> Result<StateRows, FilterError> {
        match self.kind {
            Kind::Admitted => Ok(self.rows.clone()),
            Kind::Eliminated => Ok(eliminated(self.track, state, cameras)?.1.rest),
            Kind::Held => {
                let slot = state.slot(self.track.id).ok_or(FilterError::NoPoint(self.track.id))?;
                held(self.track, slot, state, cameras)
            }
        }
    }

    /// The pose of a row that is also one of another track.
    fn shared_view(&self, other: &Track) -> Option<CloneId> {
        let place = |view: &TrackView| (view.clone, view.camera);
        let shares = |view: &&TrackView| other.views.iter().any(|v| place(v) == place(view));
        let same = self.track.id == other.id;
        Some(self.track.views.iter().filter(|_| same).find(shares)?.clone)
    }
}

/// A track's point and its rows without it.
fn eliminated(
    track: &Track,
    state: &JointState,
    cameras: &[MountedCamera],
) -> Result<(Triangulated, Eliminated), FilterError> {
    let placed = PlacedTrack::new(track, state, cameras, true)?;
    let too_few = FilterError::TooFewRows { track: track.id, rows: placed.rows() };
    if placed.rows() < 3 {
        return Err(too_few);
    }
    let found = placed.triangulate()?;
    let rows = placed.linearized(&found.estimate.position).ok_or(FilterError::NoPoint(track.id))?;
    Ok((found, rows.eliminate(placed.blocks()).ok_or(too_few)?))
}

/// What a track says of a point of the state. Its depths say nothing new: what is alike in all of
/// them has entered with the point.
fn held(
    track: &Track,
    slot: usize,
    state: &JointState,
    cameras: &[MountedCamera],
) -> Result<StateRows, FilterError> {
    let placed = PlacedTrack::new(track, state, cameras, false)?;
    let rows = placed.linearized(&state.points[slot].position);
    let rows = rows.ok_or(FilterError::NoPoint(track.id))?;
    Ok(rows.of_state_point(placed.blocks(), state.row(Block::Point(slot))))
}

impl SlamFilter {
    /// Looks at all tracks. If most of those that are seen from the present pose are improbable, it is
    /// the IMU that was wrong since the last update: its pose is made less certain, as much as it
    /// takes. Where nothing helps, the tracks stay refused.
    fn judged_until_sound<'a>(
        &mut self,
        tracks: &'a [Track],
        cameras: &[MountedCamera],
    ) -> Judged<'a> {
        let certain = self.state.clone();
        let first = self.judged(tracks, cameras);
        let inflation = self.propagator.inflation(self.carried);
        let (Some(inflation), true) = (inflation, self.contradicts(tracks, &first.outcomes)) else {
            return first;
        };
        for factor in INFLATIONS {
            self.state = certain.clone();
            self.state.inflate_present(&(inflation * factor));
            let judged = self.judged(tracks, cameras);
            if !self.contradicts(tracks, &judged.outcomes) {
                return Judged { contradicted: true, ..judged };
            }
        }
        self.state = certain;
        Judged { contradicted: true, ..self.judged(tracks, cameras) }
    }

    fn judged<'a>(&mut self, tracks: &'a [Track], cameras: &[MountedCamera]) -> Judged<'a> {
        let mut accepted = Vec::new();
        let outcomes =
            tracks.iter().map(|track| self.consider(track, cameras, &mut accepted)).collect();
        Judged { outcomes, accepted, contradicted: false }
    }

    /// Whether all but a quarter of the tracks that the present pose sees are improbable, and they
    /// are not so few that they may all be mismatched.
    fn contradicts(&self, tracks: &[Track], outcomes: &[TrackOutcome]) -> bool {
        let Some(present) = self.state.present_clone() else { return false };
        let sees = |track: &Track| track.views.iter().any(|view| view.clone == present);
        let (mut seen, mut improbable) = (0, 0);
        for (_, outcome) in tracks.iter().zip(outcomes).filter(|(track, _)| sees(track)) {
            seen += usize::from(*outcome != TrackOutcome::Deferred);
            improbable += usize::from(outcome.is_improbable());
        }
        seen >= FEW_POINTS && 4 * improbable > 3 * seen
    }

    /// Looks at a track as long as there is room for its rows, and takes it into what is accepted.
    fn consider<'a>(
        &mut self,
        track: &'a Track,
        cameras: &[MountedCamera],
        accepted: &mut Vec<Accepted<'a>>,
    ) -> TrackOutcome {
        let used: usize = accepted.iter().map(|accepted| accepted.rows.len()).sum();
        let room = self.config.track_rows.saturating_sub(used);
        if let Some(clone) = accepted.iter().find_map(|other| other.shared_view(track)) {
            let twice = FilterError::RowUsedTwice { track: track.id, clone: clone.0 };
            return TrackOutcome::Refused(twice);
        }
        match self.judge(track, cameras, room, used > 0) {
            Ok(Some(entering)) => {
                let outcome = entering.outcome();
                accepted.push(entering);
                outcome
            }
            Ok(None) => TrackOutcome::Deferred,
            Err(error) => TrackOutcome::Refused(error),
        }
    }

    /// A track that passes its gate, its point admitted if it is to be; `None` where there is no room
    /// for its rows and it `may_wait`.
    fn judge<'a>(
        &mut self,
        track: &'a Track,
        cameras: &[MountedCamera],
        room: usize,
        may_wait: bool,
    ) -> Result<Option<Accepted<'a>>, FilterError> {
        if let Some(slot) = self.state.slot(track.id) {
            let rows = held(track, slot, &self.state, cameras)?;
            if may_wait && rows.len() > room {
                return Ok(None);
            }
            self.gate_track(track.id, &rows)?;
            let position = self.state.points[slot].position;
            return Ok(Some(Accepted { track, kind: Kind::Held, rows, position }));
        }
        let (found, eliminated) = eliminated(track, &self.state, cameras)?;
        let enters = track.purpose == TrackUse::Admit
            && self.free_slots() > 0
            && found.relative_range_sd < WORST_RANGE;
        let too_few = FilterError::TooFewRows { track: track.id, rows: 3 + eliminated.rest.len() };
        if eliminated.rest.len() == 0 && !enters {
            return Err(too_few);
        }
        if may_wait && eliminated.rest.len() > room {
            return Ok(None);
        }
        self.gate_track(track.id, &eliminated.rest)?;
        let position = found.estimate.position;
        let admitted = enters && eliminated.admit(track.id, &position, &mut self.state);
        if eliminated.rest.len() == 0 && !admitted {
            return Err(too_few);
        }
        let kind = if admitted { Kind::Admitted } else { Kind::Eliminated };
        Ok(Some(Accepted { track, kind, rows: eliminated.rest, position }))
    }

    /// Refuses a track whose residual is improbable.
    fn gate_track(&mut self, track: u64, rows: &StateRows) -> Result<(), FilterError> {
        let squared = rows
            .squared_distance(&self.state.covariance)
            .ok_or(FilterError::NotPositive("innovation covariance"))?;
        // Not a number is improbable, too.
        if squared <= self.track_gate.threshold(rows.len()) {
            return Ok(());
        }
        Err(FilterError::ImprobableTrack { track, squared, rows: rows.len() })
    }

    /// The state conditioned on accepted tracks, all points that they admit being part of it.
    ///
    /// Where it moves far, the tracks are linearised again where it came to and it is conditioned
    /// again from the prediction, with the same formula. What admitted points left stays as it is: at
    /// another place it would be mixed with the rows by which they have entered.
    fn moved_by_tracks(
        &self,
        accepted: &[Accepted<'_>],
        cameras: &[MountedCamera],
    ) -> Result<Moved, FilterError> {
        let count = accepted.iter().map(|accepted| accepted.rows.len()).sum();
        let prior = self.expansion_of_prior();
        let rows_of = |admitted: bool| {
            let chosen = accepted.iter().filter(|track| (track.kind == Kind::Admitted) == admitted);
            self.update_rows(chosen.map(|accepted| &accepted.rows), &self.state)
        };
        let (fixed, mut rows) = (rows_of(true), rows_of(false));
        let mut latest: Option<JointState> = None;
        let mut expansion = prior.clone();
        let covariance = self.state.covariance.clone();
        let covariance =
            self.state.with_clone_errors(self.error, covariance, CloneErrors::ForUpdate);
        let mut renewals = self.config.relinearizations;
        let mut first = None;
        loop {
            let parts = [(&fixed, &prior), (&rows, &expansion)];
            let (squared, posterior) = self.posterior_by_rows(&covariance, &parts)?;
            let nis = *first.get_or_insert(squared / f64::max(count as f64, 1.0));
            let next = posterior.expansion.clone();
            let state = self.moved(posterior, Points::InWorld)?;
            let turned = self.seen_turn(latest.as_ref().unwrap_or(&self.state), &state, accepted);
            let again = (turned >= RELINEARIZE_ABOVE && renewals > 0)
                .then(|| self.rows_at(&state, accepted, cameras))
                .and_then(Result::ok);
            let Some(again) = again else { return Ok(Moved { state, nis, rows: count }) };
            renewals -= 1;
            (rows, expansion, latest) = (again, next, Some(state));
        }
    }

    /// Bayes' rule for rows, each linearised where its expansion came to, against a covariance in the
    /// coordinates of an update. Gives the squared Mahalanobis distance of the innovations, too.
    pub(super) fn posterior_by_rows(
        &self,
        covariance: &DMatrix<f64>,
        parts: &[(&UpdateRows, &Expansion)],
    ) -> Result<(f64, Posterior), FilterError> {
        let (prior, means) = (self.attitude(), self.state.euclidean());
        let unturned = self.state.unturned_blocks();
        let of_prior = Regression::of_prior(self.error, &prior, &means, unturned, covariance);
        let mut regression = of_prior.ok_or(FilterError::NotPositive("rotation covariance"))?;
        let mut squared = 0.0;
        for (rows, expansion) in parts {
            squared = regression.condition_rows(rows, expansion).ok_or(NO_POSTERIOR)?;
        }
        let beyond: f64 = parts.iter().map(|(rows, _)| rows.remainder).sum();
        Ok((squared + beyond, regression.posterior().ok_or(NO_POSTERIOR)?))
    }

    pub(super) fn expansion_of_prior(&self) -> Expansion {
        Expansion::of_prior(&self.attitude(), self.state.euclidean().len())
    }

    /// Rows that were linearised at `state`, as one measurement in the coordinates of an update.
    fn update_rows<'a>(
        &self,
        parts: impl Iterator<Item = &'a StateRows> + Clone,
        state: &JointState,
    ) -> UpdateRows {
        StateRows::stack(parts).for_update(state, self.error, &self.attitude()).compressed()
    }

    /// The rows of all tracks that admit no point, linearised at another state.
    fn rows_at(
        &self,
        state: &JointState,
        accepted: &[Accepted<'_>],
        cameras: &[MountedCamera],
    ) -> Result<UpdateRows, FilterError> {
        let parts: Vec<_> = accepted
            .iter()
            .filter(|accepted| accepted.kind != Kind::Admitted)
            .map(|accepted| accepted.rows_at(state, cameras))
            .collect::<Result<_, _>>()?;
        Ok(self.update_rows(parts.iter(), state))
    }

    /// By what angle, at most, what the poses of the window see of the tracks' points turned, relative
    /// to each other: a common turn and shift changes nothing of it.
    fn seen_turn(&self, from: &JointState, to: &JointState, accepted: &[Accepted<'_>]) -> f64 {
        let place = &self.state.belief.state.world_from_body.translation.vector;
        let ranges = accepted.iter().map(|accepted| (accepted.position - place).norm());
        let nearest = ranges.fold(f64::INFINITY, f64::min);
        let relative = |state: &JointState, slot: usize| {
            let body = state.belief.state.world_from_body;
            body.inverse() * state.clones[slot].world_from_body
        };
        (0..self.state.clones.len())
            .map(|slot| relative(from, slot).inverse() * relative(to, slot))
            .map(|moved| moved.rotation.angle().max(moved.translation.vector.norm() / nearest))
            .fold(0.0, f64::max)
    }

    /// Notes that the rows of accepted tracks have been used, and that the present pose is corrected if
    /// it has rows among them.
    fn mark_used(&mut self, accepted: &[Accepted<'_>]) {
        for Accepted { track, .. } in accepted {
            for view in &track.views {
                if let Some(slot) = self.state.clone_slot(view.clone) {
                    self.state.clones[slot].mark_used(track.id, view.camera);
                }
            }
        }
        let present = self.state.present_clone();
        let mut views = accepted.iter().flat_map(|accepted| &accepted.track.views);
        if views.any(|view| Some(view.clone) == present) {
            self.carried = 0.0;
        }
    }
}

impl PoseWindow for SlamFilter {
    fn clone_pose(&mut self, later: f64) -> Result<CloneId, FilterError> {
        self.state.clone_pose(later).ok_or(FilterError::NotFinite("pose of the window"))
    }

    fn clones(&self) -> Vec<CloneId> {
        self.state.clones.iter().map(|clone| clone.id).collect()
    }

    fn cloned_pose(&self, id: CloneId) -> Option<ClonedPose> {
        Some(self.state.cloned_pose(self.state.clone_slot(id)?))
    }

    fn drop_clone(&mut self, id: CloneId) -> bool {
        let slot = self.state.clone_slot(id);
        if let Some(slot) = slot {
            self.state.remove_clone(slot);
        }
        slot.is_some()
    }

    fn triangulate(
        &self,
        track: &Track,
        cameras: &[MountedCamera],
    ) -> Result<MapEstimate, FilterError> {
        Ok(PlacedTrack::new(track, &self.state, cameras, true)?.triangulate()?.estimate)
    }

    fn update_tracks(
        &mut self,
        tracks: &[Track],
        cameras: &[MountedCamera],
    ) -> Result<TrackUpdate, FilterError> {
        self.state.synchronize();
        let before = self.state.clone();
        let judged = self.judged_until_sound(tracks, cameras);
        if judged.accepted.is_empty() {
            self.state = before;
            return Ok(TrackUpdate { outcomes: judged.outcomes, ..TrackUpdate::default() });
        }
        let moved = self.moved_by_tracks(&judged.accepted, cameras);
        let conditioned = moved.and_then(|moved| {
            let frame = self.replace_state(moved.state)?;
            let Judged { outcomes, contradicted, .. } = &judged;
            let (outcomes, contradicted) = (outcomes.clone(), *contradicted);
            Ok(TrackUpdate { outcomes, rows: moved.rows, nis: moved.nis, contradicted, frame })
        });
        match &conditioned {
            Ok(_) => self.mark_used(&judged.accepted),
            Err(_) => self.state = before,
        }
        conditioned
    }
}
