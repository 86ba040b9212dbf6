//! Tracks at work: which poses the window holds, what the tracks showed to them, and when that is
//! used.
//!
//! A pose is cloned where tracks have moved on since the last one that was kept, so that the window
//! holds parallax however slowly the body moves. What a track showed is used once: when the track has
//! ended, when its oldest pose is to leave, or at once where its point is part of the state. A track
//! that goes on after that is a new one.
//!
//! A track whose place the map measures in the same frame gives nothing at that pose: the same corner
//! would count twice, with one error of its pixel. So where texture and depth are good, the map says
//! all, and tracks what it does not hold.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use nalgebra::{Matrix2, Point2};

use crate::filter::{
    CloneId, FilterConfig, FilterError, MountedCamera, Track, TrackDepth, TrackOutcome,
    TrackUpdate, TrackUse, TrackView, VisualInertialFilter,
};
use crate::sensor::Stamp;
use crate::tracking::View;
use crate::vision::{PATCH_RADIUS, TrackedFeature};

/// Ids of tracks, among those of points that a filter holds, have this bit; those of the map do not.
const OF_TRACK: u64 = 1 << 63;

/// What a frame showed, to be used by tracks.
pub struct TrackFrame<'a> {
    /// When it was taken, by the IMU's clock.
    pub time: Stamp,
    /// In order of id and camera.
    pub seen: &'a [TrackedFeature],
    /// Where the map was measured.
    pub measured: &'a [Point2<f64>],
    pub cameras: &'a [MountedCamera],
    pub view: &'a View<'a>,
}

/// A track from when its rows were last used.
#[derive(Debug, Clone, Default)]
struct Followed {
    views: Vec<TrackView>,
    /// Where the first camera saw it at the last pose kept, px.
    at_key: Option<Point2<f64>>,
    has_ended: bool,
}

/// The poses that a filter's window holds, and what tracks showed to them.
#[derive(Debug)]
pub struct TrackWindow {
    config: FilterConfig,
    /// Kept ones, oldest first.
    poses: VecDeque<CloneId>,
    last_kept: Option<Stamp>,
    tracks: BTreeMap<u64, Followed>,
    /// Tracks of the last frame that go on from a pose of the window.
    connected: usize,
}

impl TrackWindow {
    pub fn new(config: &FilterConfig) -> Self {
        Self {
            config: config.clone(),
            poses: VecDeque::new(),
            last_kept: None,
            tracks: BTreeMap::new(),
            connected: 0,
        }
    }

    /// Tracks of the last frame that tie it to a pose of the window; none where they contradict what was
    /// predicted.
    pub fn connected(&self) -> usize {
        self.connected
    }

    /// Forgets all poses and tracks: between them and what comes now the body went an unknown way.
    pub fn reset(&mut self, filter: &mut dyn VisualInertialFilter) {
        if let Some(window) = filter.pose_window_mut() {
            self.poses.iter().for_each(|pose| {
                window.drop_clone(*pose);
            });
        }
        release(filter, |_| true);
        *self = Self::new(&self.config);
    }

    /// Conditions the belief on what tracks showed, as far as it is due; `None` if nothing was.
    ///
    /// Costs what the filter's update does, `O(T log T)` in tracks and `O(T M)` in tracks and points
    /// that the map measured.
    ///
    /// # Errors
    /// Those of the update. The rows offered are lost then.
    pub fn update(
        &mut self,
        filter: &mut dyn VisualInertialFilter,
        frame: &TrackFrame<'_>,
    ) -> Result<Option<TrackUpdate>, FilterError> {
        let idle = frame.seen.is_empty() && self.tracks.is_empty();
        if idle || self.config.track_poses < 2 || filter.pose_window().is_none() {
            return Ok(None);
        }
        let lives = self.follow(frame);
        let held = held(filter);
        let keeps = self.keeps(frame);
        let sees_held = held.iter().any(|id| lives.contains(id));
        let present = if keeps || sees_held { clone_pose(filter)? } else { None };
        if let Some(present) = present {
            let wanted = |id: u64| keeps || held.contains(&id);
            self.see(frame, present, wanted);
        }
        if let Some(present) = present.filter(|_| keeps) {
            self.keep(present, frame);
        }
        let leaving =
            self.poses.front().copied().filter(|_| self.poses.len() > self.config.track_poses);
        let offered = self.offers(&held, leaving, present);
        let updated = match filter.pose_window_mut() {
            Some(window) if !offered.is_empty() => {
                window.update_tracks(&offered, frame.cameras).map(Some)
            }
            _ => Ok(None),
        };
        self.settle(&offered, updated.as_ref().ok().and_then(Option::as_ref));
        self.leave(filter, leaving, present.filter(|_| !keeps));
        let wrong = improbable(&offered, updated.as_ref().ok().and_then(Option::as_ref));
        release(filter, |id| !lives.contains(&id) || wrong.contains(&id));
        let contradicts = |update: &Option<TrackUpdate>| {
            update.as_ref().is_some_and(|update| update.contradicted)
        };
        self.connected = match &updated {
            Ok(update) if !contradicts(update) => self.ties(&lives, &held, present),
            _ => 0,
        };
        updated
    }

    /// Notes which tracks go on; gives those that the frame shows.
    fn follow(&mut self, frame: &TrackFrame<'_>) -> BTreeSet<u64> {
        let lives: BTreeSet<u64> = frame.seen.iter().map(|seen| seen.id).collect();
        for (id, track) in &mut self.tracks {
            track.has_ended = !lives.contains(id);
        }
        self.tracks.retain(|_, track| !(track.has_ended && track.views.is_empty()));
        lives
    }

    /// How many of the frame's tracks go on from a pose before the present one, or show a point of the
    /// state.
    fn ties(&self, lives: &BTreeSet<u64>, held: &BTreeSet<u64>, present: Option<CloneId>) -> usize {
        let is_older = |view: &TrackView| Some(view.clone) != present;
        let goes_on = |id: &u64| {
            self.tracks.get(id).and_then(|track| track.views.first()).is_some_and(is_older)
        };
        lives.iter().filter(|id| held.contains(id) || goes_on(id)).count()
    }

    /// Whether the pose of this frame is to be kept: tracks have moved on since the last one, most of
    /// those that it saw are gone, or it was long ago.
    fn keeps(&self, frame: &TrackFrame<'_>) -> bool {
        let Some(last) = self.last_kept else { return !frame.seen.is_empty() };
        if frame.seen.is_empty() {
            return false;
        }
        if frame.time.seconds_since(last) >= self.config.track_interval {
            return true;
        }
        let mut shifts: Vec<f64> = frame
            .seen
            .iter()
            .filter(|seen| seen.camera == 0)
            .filter_map(|seen| Some((seen.pixel - self.tracks.get(&seen.id)?.at_key?).norm()))
            .collect();
        let of_last = self.tracks.values().filter(|track| track.at_key.is_some()).count();
        if 2 * shifts.len() <= of_last {
            return true;
        }
        let middle = shifts.len() / 2;
        let (_, median, _) = shifts.select_nth_unstable_by(middle, f64::total_cmp);
        *median >= self.config.track_shift
    }

    /// Adds what the frame showed of the tracks that are wanted to their views.
    fn see(&mut self, frame: &TrackFrame<'_>, clone: CloneId, wanted: impl Fn(u64) -> bool) {
        for seen in frame.seen.iter().filter(|seen| wanted(seen.id)) {
            if seen.camera >= frame.cameras.len() || is_of_map(seen, frame.measured) {
                continue;
            }
            if let Some(view) = view(seen, clone, frame.view) {
                self.tracks.entry(seen.id).or_default().views.push(view);
            }
        }
    }

    fn keep(&mut self, present: CloneId, frame: &TrackFrame<'_>) {
        self.poses.push_back(present);
        self.last_kept = Some(frame.time);
        self.tracks.values_mut().for_each(|track| track.at_key = None);
        for seen in frame.seen.iter().filter(|seen| seen.camera == 0) {
            self.tracks.entry(seen.id).or_default().at_key = Some(seen.pixel);
        }
    }

    /// The tracks whose rows are due: of points of the state, of tracks that have ended, and of those
    /// whose oldest pose is to leave. Longer ones first, as an update takes so many rows only.
    fn offers(
        &self,
        held: &BTreeSet<u64>,
        leaving: Option<CloneId>,
        present: Option<CloneId>,
    ) -> Vec<Track> {
        let mut room = self.config.track_points.saturating_sub(held.len());
        let mut due: Vec<_> = self
            .tracks
            .iter()
            .filter_map(|(id, track)| {
                let first = track.views.first()?.clone;
                let is_held = held.contains(id);
                let is_due = is_held || track.has_ended || leaving == Some(first);
                is_due.then_some((is_held, *id, track))
            })
            .collect();
        due.sort_by_key(|(is_held, id, track)| (!is_held, usize::MAX - track.views.len(), *id));
        due.into_iter()
            .map(|(is_held, id, track)| {
                let sees_now = track.views.last().map(|view| view.clone) == present;
                let enters = !is_held && !track.has_ended && sees_now && room > 0;
                room -= usize::from(enters);
                let purpose = if enters { TrackUse::Admit } else { TrackUse::Eliminate };
                Track { id: id | OF_TRACK, views: track.views.clone(), purpose }
            })
            .collect()
    }

    /// Forgets the views that were used, or were of no use. What waits for room keeps its views.
    fn settle(&mut self, offered: &[Track], update: Option<&TrackUpdate>) {
        for (k, track) in offered.iter().enumerate() {
            let outcome = update.and_then(|update| update.outcomes.get(k));
            if matches!(outcome, Some(TrackOutcome::Deferred)) {
                continue;
            }
            if let Some(followed) = self.tracks.get_mut(&(track.id & !OF_TRACK)) {
                followed.views.clear();
            }
        }
        self.tracks.retain(|_, track| !(track.has_ended && track.views.is_empty()));
    }

    /// Lets poses go, and the rows at them; so with poses at which no row waits.
    fn leave(
        &mut self,
        filter: &mut dyn VisualInertialFilter,
        oldest: Option<CloneId>,
        passing: Option<CloneId>,
    ) {
        for pose in [oldest, passing].into_iter().flatten() {
            if let Some(window) = filter.pose_window_mut() {
                window.drop_clone(pose);
            }
            self.poses.retain(|kept| *kept != pose);
            self.tracks
                .values_mut()
                .for_each(|track| track.views.retain(|view| view.clone != pose));
        }
        let waiting = self.tracks.values().flat_map(|track| &track.views);
        let needed: BTreeSet<CloneId> = waiting.map(|view| view.clone).collect();
        if let Some(window) = filter.pose_window_mut() {
            self.poses.retain(|pose| {
                let is_needed = needed.contains(pose);
                if !is_needed {
                    window.drop_clone(*pose);
                }
                is_needed
            });
        }
    }
}

/// The tracks whose rows contradict what is believed of their points, or of the body.
fn improbable(offered: &[Track], update: Option<&TrackUpdate>) -> BTreeSet<u64> {
    let outcomes = update.into_iter().flat_map(|update| &update.outcomes);
    let refused = offered.iter().zip(outcomes).filter(|(_, outcome)| outcome.is_improbable());
    refused.map(|(track, _)| track.id & !OF_TRACK).collect()
}

/// Whether the same grey values are measured as a point of the map.
fn is_of_map(seen: &TrackedFeature, measured: &[Point2<f64>]) -> bool {
    let near = |pixel: &Point2<f64>| (seen.pixel - pixel).amax() <= PATCH_RADIUS as f64;
    seen.camera == 0 && measured.iter().any(near)
}

/// The tracks whose points are part of the state.
fn held(filter: &dyn VisualInertialFilter) -> BTreeSet<u64> {
    let ids = filter.point_state().map(|points| points.ids()).unwrap_or_default();
    ids.into_iter().filter(|id| id & OF_TRACK != 0).map(|id| id & !OF_TRACK).collect()
}

/// Takes points of tracks out of the state.
fn release(filter: &mut dyn VisualInertialFilter, goes: impl Fn(u64) -> bool) {
    for id in held(filter).into_iter().filter(|id| goes(*id)) {
        if let Some(points) = filter.point_state_mut() {
            points.release(id | OF_TRACK);
        }
    }
}

fn clone_pose(filter: &mut dyn VisualInertialFilter) -> Result<Option<CloneId>, FilterError> {
    filter.pose_window_mut().map(|window| window.clone_pose(0.0)).transpose()
}

/// What a camera showed of a track, at the stamp of the frame; `None` for what is outside of the lens's
/// image or not finite.
fn view(seen: &TrackedFeature, clone: CloneId, view: &View<'_>) -> Option<TrackView> {
    let inflation = view.config.measurement_inflation;
    let (pixel, unsure) = at_stamp(seen, view)?;
    let pixel_covariance = seen.pixel_covariance * inflation + unsure;
    // What differs from frame to frame, and what repeats: a sensor's noise and its warp are of one
    // size.
    let depth = seen.depth.map(|reading| {
        let common_variance = reading.standard_deviation.powi(2) * inflation;
        let by_pixel = reading.slope.dot(&(pixel_covariance * reading.slope));
        TrackDepth { depth: reading.depth, variance: common_variance + by_pixel, common_variance }
    });
    let camera = seen.camera;
    Some(TrackView { clone, camera, pixel, pixel_covariance, depth })
}

/// Where a point that a row of the image shows is at the stamp, and the covariance of what is not known
/// of that: without depth the shift by the camera's way while rows are exposed.
fn at_stamp(seen: &TrackedFeature, view: &View<'_>) -> Option<(Point2<f64>, Matrix2<f64>)> {
    /// Taken for infinite, m.
    const FAR: f64 = 1e4;
    if seen.camera != 0 || !view.shutter.is_rolling() {
        return Some((seen.pixel, Matrix2::zeros()));
    }
    let row = view.row(seen.pixel);
    let moved = |point| view.camera.project(&view.shutter.at_stamp(&point, row));
    if let Some(depth) = seen.depth {
        let pixel = moved(view.camera.unproject(seen.pixel, depth.depth)?)?;
        return Some((pixel, Matrix2::zeros()));
    }
    let bearing = view.camera.bearing(seen.pixel)?.into_inner();
    let far = moved(bearing * FAR)?;
    let near = moved(bearing * view.config.depth.max)?;
    Some((far, (near - far) * (near - far).transpose()))
}
