//! One estimate from its start to its end: the stages of a frame.

use nalgebra::{Isometry3, Matrix3, Point2, Vector3};

use super::back_end::{BackEnd, FrameObservations};
use super::config::OdometryConfig;
use super::levelling::Levelling;
use super::recognition::spread_of_recognition;
use super::report::{KeypointRole, KeypointView, Note, StageTimes, StepCounts, StepReport};
use super::rest::RestDetector;
use super::restart::Spread;
use super::supervisor::{Followed, FrameEvidence, PoseVerdict, Supervisor};
use super::track_window::{TrackFrame, TrackWindow};
use super::window::{ImuCursor, ImuWindow};
use crate::fault::Obstruction;
use crate::filter::{Calibration, FilterConfig, MountedCamera, PointObservation, PointUpdate};
use crate::inertial::{Belief, NavCovariance};
use crate::map::{ReferenceView, Sighting};
use crate::sensor::Stamp;
use crate::so3::ProperSvd;
use crate::tracking::{
    FrameTracker, FrontEndFrame, Prediction, Tracks, View, first_reference, in_body, reference,
};
use crate::vision::Feature;

/// What exists once the filter has started.
pub(super) struct Run {
    pub back_end: BackEnd,
    pub cursor: ImuCursor,
    pub rest: RestDetector,
    pub levelling: Levelling,
    pub track_window: TrackWindow,
    /// What is not known of where this start is in the world of the first one. It is no part of
    /// the belief: nothing that is measured can tell of it.
    pub gauge: Spread,
    /// Of the camera in the body, as configured.
    pub configured_mounting: Isometry3<f64>,
    /// Whether the map had points to match before this frame.
    pub expects_matches: bool,
    /// Frames so far, those in which vision was lost left out: by them the map ages, so that it is
    /// still there when vision comes back.
    pub seeing_frames: u64,
    /// Frames in a row that showed enough but nothing of the map.
    pub blind_frames: u64,
}

/// What became of a feature.
#[derive(Debug, Clone, Copy)]
pub(super) struct Assignment {
    pub role: KeypointRole,
    /// Id of the map point it was matched to, and where that was predicted, pixels.
    pub matched: Option<(u64, Point2<f64>)>,
}

impl Run {
    pub fn belief(&self) -> &Belief {
        self.back_end.belief()
    }

    pub fn calibration(&self) -> Option<&Calibration> {
        self.back_end.filter().calibration()
    }

    /// The camera's mounting as estimated, or as configured.
    fn body_from_camera(&self) -> Isometry3<f64> {
        self.calibration().map_or(self.configured_mounting, |estimate| estimate.body_from_camera)
    }

    pub fn prediction(&self, vision_lost: bool) -> Prediction {
        let last = self.cursor.last;
        Prediction {
            belief: *self.belief(),
            measured_rate: last.map_or_else(Vector3::zeros, |sample| sample.angular_velocity),
            body_from_camera: self.body_from_camera(),
            is_inertial: last.is_some(),
            vision_lost,
            seeing_frames: self.seeing_frames,
        }
    }

    /// Carries the belief through a window, as it is trusted.
    pub fn propagate(&mut self, window: &ImuWindow, supervisor: &mut Supervisor, has_imu: bool) {
        let bias = self.belief().state.gyro_bias;
        let trusted = supervisor.trusted(window, &bias);
        for (until, error) in self.back_end.propagate(&trusted) {
            supervisor.warn(format!("IMU samples up to {until} s left out: {error}"));
        }
        self.cursor.last =
            trusted.intervals.last().map(|interval| interval.to).or(self.cursor.last);
        for interval in window.intervals.iter().filter(|interval| interval.is_measured) {
            self.rest.push_imu(interval.to);
        }
        if let Some(points) = self.back_end.filter_mut().point_state_mut().filter(|_| has_imu) {
            points.add_stamp_jitter(supervisor.stamp_jitter());
        }
    }

    /// Looks for the map in a frame. Where that shows that the body was carried off, it is put there,
    /// and all is looked for again.
    pub fn track(
        &mut self,
        front: &FrontEndFrame,
        view: &mut View,
        prediction: &mut Prediction,
        stamp: Stamp,
        supervisor: &mut Supervisor,
        filter: &FilterConfig,
    ) -> Tracks {
        let features = &front.extraction.features;
        let tracker = FrameTracker { view: *view, map: self.back_end.map(), prediction };
        let tracks = tracker.track(features);
        let expected = tracker.recent_points(&tracks).into_iter();
        let pixels = features.iter().map(|feature| feature.pixel);
        supervisor.observe_regions(stamp, Obstruction::regions(pixels, expected, view.size));
        let Some(pose) = tracks.pose else { return tracks };
        if !self.back_end.filter().knows_vertical() || !self.back_end.holds_points() {
            return tracks;
        }
        let world_from_body = pose * prediction.body_from_camera.inverse();
        let in_view = || tracker.in_view(&tracks, front);
        match supervisor.judge_pose(stamp, &world_from_body, in_view) {
            PoseVerdict::Consistent => tracks,
            PoseVerdict::Unconfirmed => tracks.without_pose(),
            PoseVerdict::Kidnapped => {
                let way = self.belief().state.world_from_body.inv_mul(&world_from_body);
                self.track_window.reset(self.back_end.filter_mut());
                if let Some(points) = self.back_end.filter_mut().point_state_mut() {
                    points.reset_pose(&way, &spread_of_recognition(filter));
                }
                supervisor.observe_kidnapping(stamp);
                prediction.belief = *self.belief();
                view.shutter = prediction.shutter(view.config, view.size.1, None);
                let again = FrameTracker { view: *view, map: self.back_end.map(), prediction }
                    .track(features);
                Tracks {
                    matching_seconds: again.matching_seconds + tracks.matching_seconds,
                    ransac_seconds: again.ransac_seconds + tracks.ransac_seconds,
                    ..again
                }
            }
        }
    }

    /// Measures what the frame's tracks show by the pose that they agree on: the camera's motion while
    /// rows are exposed follows from it, and points of the state are sought where it has them.
    pub fn refine_tracks(
        &self,
        tracks: &mut Tracks,
        front: &mut FrontEndFrame,
        view: &mut View,
        prediction: &Prediction,
    ) {
        let Some(pose) = tracks.pose else { return };
        if view.shutter.is_rolling() {
            let shutter = prediction.shutter(view.config, view.size.1, Some(&pose));
            let before = std::mem::replace(&mut view.shutter, shutter);
            let features = &front.extraction.features;
            tracks.matches.iter_mut().for_each(|m| m.reread(features, &before, view));
        }
        if view.config.search.seek_state_points {
            let tracker = FrameTracker { view: *view, map: self.back_end.map(), prediction };
            tracker.seek_state_points(tracks, front);
        }
    }

    /// Conditions belief and map on the tracks that agree; `None` if there were none, or they were
    /// refused.
    pub fn update(&mut self, tracks: &Tracks, view: &View) -> Option<PointUpdate> {
        let seen: Vec<_> = tracks
            .agreeing()
            .map(|m| observation(m.point, in_body(&m.correspondence.measurement, view)))
            .collect();
        let updated = self.back_end.update(self.seeing_frames, &seen, self.is_tied(view));
        updated.inspect_err(|error| tracing::debug!("no update: {error}")).ok()
    }

    /// Whether enough followed points tie the last frame to past poses.
    fn is_tied(&self, view: &View) -> bool {
        self.track_window.connected() >= view.config.ransac.min_inliers
    }

    /// Conditions the belief on points that were followed through past poses, as far as they are due.
    pub fn use_followed(
        &mut self,
        front: &FrontEndFrame,
        tracks: &Tracks,
        view: &View,
        time: Stamp,
    ) -> Followed {
        let features = &front.extraction.features;
        let measured: Vec<_> =
            tracks.agreeing().filter_map(|m| Some(features.get(m.feature)?.pixel)).collect();
        let body_from_camera = self.body_from_camera();
        let frame = TrackFrame {
            time,
            seen: &front.extraction.tracks,
            measured: &measured,
            cameras: &[MountedCamera { camera: *view.camera, body_from_camera }],
            view,
        };
        let updated = self.back_end.update_tracks(&mut self.track_window, &frame);
        let updated = updated.inspect_err(|error| tracing::debug!("no use of tracks: {error}"));
        let ties = self.is_tied(view);
        Followed { update: updated.ok().flatten(), ties }
    }

    /// Compares the turns that the images and the gyroscope see. Gives how much the clocks turn out
    /// to differ, where that has changed, s.
    pub fn compare_turns(
        &self,
        tracks: &Tracks,
        prediction: &Prediction,
        stamp: Stamp,
        supervisor: &mut Supervisor,
        has_imu: bool,
    ) -> Option<f64> {
        let body_from_camera = &prediction.body_from_camera;
        let pose = tracks.pose.filter(|_| has_imu).map(|pose| pose * body_from_camera.inverse());
        let bias = self.belief().state.gyro_bias;
        supervisor.observe_attitude(stamp, pose.as_ref(), &bias)
    }

    /// Judges what a frame showed and what was made of it, and reacts.
    pub fn watch(
        &mut self,
        seen: &FrameEvidence,
        view: &View,
        supervisor: &mut Supervisor,
        config: &OdometryConfig,
    ) {
        let stamp = seen.stamp;
        if let Some(note) = self.levelling.note(self.back_end.filter(), stamp) {
            supervisor.note(note);
        }
        supervisor.observe_sight(seen);
        self.observe_rest(seen, view, config.standstill.update, supervisor);
        if supervisor.observe_update(seen, self.belief()) {
            self.levelling.reopen(self.back_end.filter_mut(), stamp, &config.imu);
        }
        self.levelling.weigh(self.back_end.belief(), seen.contradicts(), &config.imu);
        supervisor.observe_world_turn(seen.update.and_then(|update| update.frame.world_turn));
        supervisor
            .observe_world_turn(seen.followed.update.as_ref().and_then(|u| u.frame.world_turn));
        supervisor.judge_belief(stamp, self.belief(), seen.nis());
        self.seeing_frames += u64::from(!supervisor.is_lost());
        if self.gives_up_map(seen.visible, seen.update.is_some(), config.map.max_unseen_frames) {
            supervisor.observe_map_loss(stamp);
        }
        supervisor.name_fault(stamp);
    }

    /// Conditions the belief on rest if the body is at rest and `updates`; notes where that begins
    /// or ends.
    fn observe_rest(
        &mut self,
        seen: &FrameEvidence,
        view: &View,
        updates: bool,
        supervisor: &mut Supervisor,
    ) {
        let stamp = seen.stamp;
        let seen = seen
            .tracks
            .agreeing()
            .map(|m| (m.point, in_body(&m.correspondence.measurement, view).0))
            .collect();
        let (rest, note) = self.rest.judge(stamp, &self.back_end.belief().state, seen);
        let change = rest.filter(|_| updates).map(|rest| self.back_end.rest(&rest));
        match change {
            Some(Ok(change)) => supervisor.observe_world_turn(change.world_turn),
            Some(Err(error)) => tracing::debug!("rest at {stamp} s was refused: {error}"),
            None => {}
        }
        if let Some(note) = note {
            supervisor.note(note);
        }
    }

    /// Gives the map up when nothing of it has been found again for as many frames as `patience`
    /// allows, though there was enough to see; true if so.
    pub fn gives_up_map(&mut self, visible: bool, updated: bool, patience: u64) -> bool {
        self.blind_frames = if updated { 0 } else { self.blind_frames + u64::from(visible) };
        let gives_up = self.blind_frames > patience && self.back_end.holds_points();
        if gives_up {
            self.back_end.clear_map();
            self.blind_frames = 0;
        }
        gives_up
    }

    /// Renews the points seen, inserts new ones, forgets old ones. What became of each feature
    /// comes back in the order of the frame's.
    pub fn maintain(
        &mut self,
        front: &FrontEndFrame,
        tracks: &Tracks,
        vision_lost: bool,
        view: &View,
    ) -> Vec<Assignment> {
        let features = &front.extraction.features;
        let mut assignments = assign(front, tracks);
        let mut observed = FrameObservations::default();
        for m in tracks.agreeing() {
            let feature = &features[m.feature];
            let point = self.back_end.map().get(m.point).filter(|_| m.renews_reference);
            let renewed = point
                .and_then(|point| reference(feature, point, &self.world_from_camera(view), view));
            let sighting = self.sighting(feature, renewed, view);
            let measured = observation(m.point, in_body(&m.correspondence.measurement, view));
            observed.seen.push((measured, sighting));
        }
        // Points placed by a prediction that drifts would hide the map that is looked for.
        let searching =
            vision_lost && !self.back_end.map().is_empty() && self.back_end.holds_points();
        let mut fresh = Vec::new();
        for (index, feature) in features.iter().enumerate().filter(|_| !searching) {
            if assignments[index].role != KeypointRole::Unmatched {
                continue;
            }
            let Some(measured) = feature.measurement(view.camera) else { continue };
            let measured = view.at_stamp(feature.pixel, measured);
            let first = first_reference(feature, &self.world_from_camera(view));
            observed.new.push((
                observation(0, in_body(&measured, view)),
                self.sighting(feature, first, view),
            ));
            fresh.push(index);
        }
        let inserted = self.back_end.maintain(self.seeing_frames, observed);
        for (index, _) in fresh.into_iter().zip(inserted).filter(|(_, id)| id.is_some()) {
            assignments[index].role = KeypointRole::New;
        }
        assignments
    }

    /// What the frame came to; number, times, what was detected and the map are the caller's to add.
    pub fn report(
        &self,
        front: &FrontEndFrame,
        tracks: &Tracks,
        update: Option<&PointUpdate>,
        assignments: &[Assignment],
        notes: Vec<Note>,
    ) -> StepReport {
        let new_points = assignments.iter().filter(|a| a.role == KeypointRole::New).count();
        let counts = StepCounts {
            candidates: tracks.candidates,
            matches: tracks.matches.len(),
            inliers: tracks.inliers.len(),
            new_points,
            map_points: self.back_end.map().len(),
            ..StepCounts::default()
        };
        StepReport {
            frame: 0,
            stamp: front.frame.stamp,
            state: self.belief().state,
            covariance: self.reported_covariance(),
            world_from_camera: self.belief().state.world_from_body * self.body_from_camera(),
            calibration: self.calibration().copied(),
            matrix_fisher: self.matrix_fisher(),
            nis: update.map(|update| update.nis),
            gating: update.map(|update| update.gating),
            counts,
            times: StageTimes::default(),
            keypoints: keypoint_views(&front.extraction.features, assignments),
            map: None,
            notes,
        }
    }

    fn sighting(
        &self,
        feature: &Feature,
        reference: Option<ReferenceView>,
        view: &View,
    ) -> Sighting {
        Sighting {
            frame: self.seeing_frames,
            camera: self.world_from_camera(view).translation.vector,
            descriptor: feature.descriptor,
            reference,
        }
    }

    pub fn world_from_camera(&self, view: &View) -> Isometry3<f64> {
        self.belief().state.world_from_body * view.body_from_camera
    }

    /// Of the error in the world of the first start, whose vertical is up.
    pub fn reported_covariance(&self) -> NavCovariance {
        let state = &self.belief().state;
        self.back_end.filter().reported_covariance() + self.gauge.covariance(state)
    }

    pub fn matrix_fisher(&self) -> Option<ProperSvd> {
        let known = self.back_end.filter().matrix_fisher()?;
        if self.gauge == Spread::default() {
            return Some(known);
        }
        let state = self.belief().state;
        let reported = Belief { state, covariance: self.reported_covariance() };
        reported.attitude().map(|attitude| *attitude.svd())
    }
}

fn observation(
    id: u64,
    (in_body, body_covariance): (Vector3<f64>, Matrix3<f64>),
) -> PointObservation {
    PointObservation { id, in_body, body_covariance }
}

/// What became of each feature before new points are made.
fn assign(front: &FrontEndFrame, tracks: &Tracks) -> Vec<Assignment> {
    let unmatched = |feature: &Feature| match feature.depth {
        Some(_) => KeypointRole::Unmatched,
        None => KeypointRole::NoDepth,
    };
    let mut assignments: Vec<_> = front
        .extraction
        .features
        .iter()
        .map(|feature| Assignment { role: unmatched(feature), matched: None })
        .collect();
    for (i, m) in tracks.matches.iter().enumerate() {
        let accepted = tracks.inliers.binary_search(&i).is_ok();
        let role = if accepted { KeypointRole::Inlier } else { KeypointRole::Outlier };
        assignments[m.feature] = Assignment { role, matched: Some((m.point, m.predicted)) };
    }
    assignments
}

fn keypoint_views(features: &[Feature], assignments: &[Assignment]) -> Vec<KeypointView> {
    let pixel = |p: &Point2<f64>| [p.x as f32, p.y as f32];
    features
        .iter()
        .zip(assignments)
        .map(|(feature, assignment)| KeypointView {
            pixel: pixel(&feature.pixel),
            predicted: assignment.matched.as_ref().map(|(_, predicted)| pixel(predicted)),
            point: assignment.matched.map(|(point, _)| point),
            role: assignment.role,
        })
        .collect()
}
