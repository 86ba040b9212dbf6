//! Tracks through a window of past poses: what each point showed, and when that is used.
//!
//! Poses are copied into the filter's state at intervals. What a tracked point shows at such a pose
//! waits until the track has ended, or its oldest pose leaves the window; then all of it enters one
//! update, which eliminates the point (`docs/theory/tracks.md`), and a point that is still followed
//! begins anew as another one. So every view is used once.

use std::collections::{BTreeMap, VecDeque};

use nalgebra::{Matrix2, Point2};

use super::back_end::BackEnd;
use crate::filter::{
    CloneId, FilterConfig, MountedCamera, Track, TrackDepth, TrackOutcome, TrackUpdate, TrackUse,
    TrackView,
};
use crate::sensor::Stamp;

/// What one camera shows of a tracked point in a frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct PointSight {
    /// The track's.
    pub id: u64,
    /// Index into the cameras.
    pub camera: usize,
    /// Where it would be if all rows were exposed at the stamp, px.
    pub pixel: Point2<f64>,
    pub pixel_covariance: Matrix2<f64>,
    pub depth: Option<TrackDepth>,
}

/// What a frame shows of tracked points.
#[derive(Debug, Clone)]
pub(super) struct FrameSights {
    pub time: Stamp,
    pub points: Vec<PointSight>,
    pub cameras: Vec<MountedCamera>,
}

/// The poses that the filter's state holds copies of, and what was seen from them and is not used
/// yet.
#[derive(Debug, Clone)]
pub(super) struct TrackWindow {
    /// Most poses; 0: none is taken.
    size: usize,
    /// Least time between them, s.
    spacing: f64,
    poses: VecDeque<CloneId>,
    last: Option<Stamp>,
    /// By track, in order of time.
    waiting: BTreeMap<u64, Vec<TrackView>>,
}

impl TrackWindow {
    pub fn new(config: &FilterConfig) -> Self {
        Self {
            size: config.track_poses,
            spacing: config.track_spacing,
            poses: VecDeque::new(),
            last: None,
            waiting: BTreeMap::new(),
        }
    }

    /// Takes a copy of the present pose, if it is time for one, and uses the tracks that have ended or
    /// whose oldest pose is to leave. `None` where nothing was offered to the filter, or it keeps no
    /// such poses. `O(V)` in the views that wait, beside the update.
    pub fn advance(&mut self, back_end: &mut BackEnd, seen: &FrameSights) -> Option<TrackUpdate> {
        let is_due = self.last.is_none_or(|last| seen.time.seconds_since(last) >= self.spacing);
        let is_idle = seen.points.is_empty() && self.waiting.is_empty();
        if self.size == 0 || is_idle || !is_due {
            return None;
        }
        let taken = back_end.filter_mut().pose_window_mut()?.clone_pose(0.0);
        let pose = taken.inspect_err(|error| tracing::debug!("no pose taken: {error}")).ok()?;
        self.last = Some(seen.time);
        self.poses.push_back(pose);
        self.add_views(pose, &seen.points);

        let leaving = self.poses.front().copied().filter(|_| self.poses.len() > self.size);
        let offered = self.to_use(pose, leaving);
        let update = self.use_tracks(back_end, &offered, &seen.cameras);
        self.drop_poses(back_end, pose, leaving);
        update
    }

    /// Forgets all poses and what was seen from them: the body was moved by what no sensor saw.
    pub fn clear(&mut self, back_end: &mut BackEnd) {
        if let Some(window) = back_end.filter_mut().pose_window_mut() {
            for pose in self.poses.drain(..) {
                window.drop_clone(pose);
            }
        }
        self.waiting.clear();
    }

    fn add_views(&mut self, pose: CloneId, points: &[PointSight]) {
        for point in points {
            let PointSight { id, camera, pixel, pixel_covariance, depth } = *point;
            let view = TrackView { clone: pose, camera, pixel, pixel_covariance, depth };
            self.waiting.entry(id).or_default().push(view);
        }
    }

    /// The tracks that `pose`, the present one, does not see, and those that the leaving one sees: of
    /// the views of one pose alone nothing is learned. The most views come first.
    fn to_use(&self, pose: CloneId, leaving: Option<CloneId>) -> Vec<Track> {
        let ends = |views: &[TrackView]| {
            views.last().is_some_and(|view| view.clone != pose)
                || views.first().is_some_and(|view| Some(view.clone) == leaving)
        };
        let spans = |views: &[TrackView]| {
            let (first, last) = (views.first(), views.last());
            first.zip(last).is_some_and(|(first, last)| first.clone != last.clone)
        };
        let mut tracks: Vec<Track> = self
            .waiting
            .iter()
            .filter(|(_, views)| ends(views) && spans(views))
            .map(|(id, views)| Track {
                id: *id,
                views: views.clone(),
                purpose: TrackUse::Eliminate,
            })
            .collect();
        tracks.sort_by_key(|track| std::cmp::Reverse(track.views.len()));
        tracks
    }

    /// What is used or refused waits no more; what is deferred does.
    fn use_tracks(
        &mut self,
        back_end: &mut BackEnd,
        offered: &[Track],
        cameras: &[MountedCamera],
    ) -> Option<TrackUpdate> {
        if offered.is_empty() {
            return None;
        }
        let update = back_end.update_tracks(offered, cameras);
        let update = update.inspect_err(|error| tracing::debug!("no use of tracks: {error}")).ok();
        for (k, track) in offered.iter().enumerate() {
            let outcome = update.as_ref().and_then(|update| update.outcomes.get(k));
            if outcome != Some(&TrackOutcome::Deferred) {
                self.waiting.remove(&track.id);
            }
        }
        update
    }

    /// Drops the pose that leaves, with what was seen from it, tracks that ended unused, and poses from
    /// which nothing waits any more.
    fn drop_poses(&mut self, back_end: &mut BackEnd, present: CloneId, leaving: Option<CloneId>) {
        let Some(window) = back_end.filter_mut().pose_window_mut() else { return };
        self.waiting.retain(|_, views| {
            let has_ended = views.last().is_none_or(|view| view.clone != present);
            views.retain(|view| Some(view.clone) != leaving);
            let spans = views.first().map(|view| view.clone) != views.last().map(|view| view.clone);
            !views.is_empty() && (spans || !has_ended)
        });
        let waiting = &self.waiting;
        let is_needed = |pose: CloneId| waiting.values().flatten().any(|view| view.clone == pose);
        self.poses.retain(|pose| {
            let keeps = *pose == present || is_needed(*pose);
            if !keeps {
                window.drop_clone(*pose);
            }
            keeps
        });
    }
}
