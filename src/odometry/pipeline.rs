use std::collections::{HashSet, VecDeque};
use std::time::Instant;

use nalgebra::{Isometry3, Matrix3, Point2, Point3, Translation3, UnitQuaternion, Vector3};

use super::association::{
    Association, View, first_reference, in_body, place, point_pair, reference, seek, seen_point,
};
use super::clock::ClockWatch;
use super::gyroscope::GyroscopeWatch;
use super::health::{Divergence, Health, HealthSummary, Sight};
use super::init::{Attempt, Evidence, Initializer};
use super::recognition::{InView, Jump, spread_of_recognition};
use super::report::{
    KeypointRole, KeypointView, MapPointView, Note, NoteLevel, StageTimes, StepCounts, StepReport,
};
use super::rest::RestDetector;
use super::restart::{BIAS_FACTOR, Legacy, Spread};
use super::shutter::{Shutter, given_pose};
use super::truth::TruthTrack;
use super::watch::{Agreement, SensorWatch};
use super::{OdometryConfig, renew_state_points};
use crate::alignment::PointPair;
use crate::filter::{
    Calibration, FilterConfig, FilterKind, KnownAttitude, MapTreatment, PointState, SeenPoint,
    UpdateOutcome, VisualInertialFilter, point_by_pose,
};
use crate::inertial::{Belief, ImuConfig, NavCovariance, Propagator, block};
use crate::map::{Map, MapPoint, Sighting};
use crate::sensor::{ImuSample, PinholeCamera, RgbdFrame, Stamp, TruthPose};
use crate::so3::ProperSvd;
use crate::vision::{
    Correspondence, Extraction, Feature, Match, Prediction, agree_near, agreeing, estimate_pose,
    match_guided, ransac,
};

/// A frame after the front end.
#[derive(Debug)]
pub struct FrontEndFrame {
    pub frame: Box<RgbdFrame>,
    pub extraction: Extraction,
    /// Wall time that it took, s.
    pub seconds: f64,
}

/// Visual-inertial odometry: IMU samples, frames and reference poses go in, in order of time;
/// one [`StepReport`] a frame comes out of [`Self::step`], as soon as IMU and reference have reached it.
///
/// A step costs `O(F + M)` in features and map points; the belief is of fixed size.
pub struct Odometry {
    config: OdometryConfig,
    kind: FilterKind,
    seed: u64,
    camera: PinholeCamera,
    body_from_camera: Isometry3<f64>,
    initializer: Initializer,
    has_imu: bool,
    ended: bool,
    imu: VecDeque<ImuSample>,
    frames: VecDeque<(u64, FrontEndFrame)>,
    truth: TruthTrack,
    frames_in: u64,
    now: Option<Stamp>,
    running: Option<Running>,
    /// What the estimate that is to be started anew has left.
    legacy: Option<Legacy>,
    /// The last belief that nothing spoke against, and its time.
    sound: Option<(Stamp, Belief)>,
    watch: SensorWatch,
    clock: ClockWatch,
    gyroscope: GyroscopeWatch,
    /// Of the next frame.
    notes: Vec<Note>,
    last_imu: Option<Stamp>,
    last_frame: Option<Stamp>,
    waiting_reason: Option<String>,
    map_every: u64,
    health: Health,
    stats: OdometryStats,
}

/// Counts over the run, for `metrics.json`.
#[derive(Debug, Clone, Default, PartialEq, serde::Serialize)]
pub struct OdometryStats {
    pub frames_processed: u64,
    /// Frames left out before the filter was initialised.
    pub frames_before_initialization: u64,
    /// Frames without enough matched points for an update.
    pub frames_without_update: u64,
    pub imu_gaps: u64,
    /// Frames and IMU samples left out since they were no later than the one before.
    pub out_of_order: u64,
    /// How the run was initialised; `None` if it never was.
    pub initialization: Option<String>,
    /// Why it was not, when it was not.
    pub waiting_reason: Option<String>,
    pub health: HealthSummary,
}

/// How long a frame waits for the IMU to reach it before the gap is bridged, and for the reference,
/// s.
const PATIENCE: f64 = 1.0;

/// Fewer matches than this may agree on a pose by chance.
const FEW_ASTRAY: usize = 30;

/// Frames after which the points of a new map lie where they are, so that others move.
const SETTLED: u64 = 30;

/// What exists once the filter has started.
struct Running {
    filter: Box<dyn VisualInertialFilter>,
    map: Map,
    /// Last sample used, its stamp being the time of the belief (interpolated at frames).
    last_imu: Option<ImuSample>,
    time: Stamp,
    /// Whether the map had points to match before this frame.
    expects_matches: bool,
    /// Frames so far, those in which vision was lost left out: by them the map ages, so that it is
    /// still there when vision comes back.
    seeing_frames: u64,
    /// Frames in a row that showed enough but nothing of the map.
    blind_frames: u64,
    /// Last sample of the IMU itself, not interpolated.
    last_sample: Option<Stamp>,
    /// The sample before the gap that was told of last.
    told_gap_after: Option<Stamp>,
    /// The start, until the vertical is known.
    vertical_sought_since: Option<Stamp>,
    /// Whether what is known of the accelerometer's bias is what was assumed at the start.
    levelling_counts: bool,
    rest: RestDetector,
    /// What is not known of where this start is in the world of the first one. It is no part of
    /// the belief: nothing that is measured can tell of it.
    spread: Spread,
}

impl Odometry {
    /// `None` if `camera.imu_from_camera` is no rigid
    /// motion.
    pub fn new(
        config: &OdometryConfig,
        kind: FilterKind,
        seed: u64,
        has_imu: bool,
    ) -> Option<Self> {
        let body_from_camera =
            if has_imu { config.camera.imu_from_camera()? } else { Isometry3::identity() };
        let initializer = Initializer {
            init: config.init.clone(),
            standstill: config.standstill.clone(),
            truth: config.truth.clone(),
            imu: config.imu.clone(),
            filter: config.filter.clone(),
            level_without_imu: camera_looking_ahead(),
        };
        Some(Self {
            config: config.clone(),
            kind,
            seed,
            camera: PinholeCamera::from(&config.camera),
            body_from_camera,
            initializer,
            has_imu,
            ended: false,
            imu: VecDeque::new(),
            frames: VecDeque::new(),
            truth: TruthTrack::default(),
            frames_in: 0,
            now: None,
            running: None,
            legacy: None,
            sound: None,
            watch: SensorWatch::new(&config.imu),
            clock: ClockWatch::default(),
            gyroscope: GyroscopeWatch::default(),
            notes: Vec::new(),
            last_imu: None,
            last_frame: None,
            waiting_reason: None,
            map_every: 0,
            health: Health::new(&config.health),
            stats: OdometryStats::default(),
        })
    }

    /// Reports carry a copy of the map every `n` frames; 0: never.
    pub fn report_map_every(&mut self, n: u64) {
        self.map_every = n;
    }

    pub fn push_imu(&mut self, sample: ImuSample) {
        if self.health.stops() {
            return;
        }
        self.advance(sample.stamp);
        if self.follows(self.last_imu, sample.stamp) {
            self.last_imu = Some(sample.stamp);
            self.notes.extend(self.watch.imu(&sample));
            self.clock.imu(sample);
            self.imu.push_back(sample);
        }
    }

    /// Whether a stamp is later than the last one of its stream; counted if not.
    fn follows(&mut self, last: Option<Stamp>, stamp: Stamp) -> bool {
        let follows = last.is_none_or(|last| stamp > last);
        self.stats.out_of_order += u64::from(!follows);
        follows
    }

    pub fn push_truth(&mut self, pose: TruthPose) {
        let stamp = pose.stamp.offset_by(self.config.truth.time_offset);
        self.advance(stamp);
        self.truth.push(TruthPose { stamp, ..pose });
    }

    pub fn push_frame(&mut self, frame: FrontEndFrame) {
        if self.health.stops() {
            return;
        }
        self.advance(frame.frame.stamp.offset_by(self.config.camera.time_offset));
        if self.follows(self.last_frame, frame.frame.stamp) {
            self.last_frame = Some(frame.frame.stamp);
            if self.has_imu {
                self.clock.frame(self.frame_time(&frame));
            }
            self.frames.push_back((self.frames_in, frame));
        }
        self.frames_in += 1;
    }

    /// No more data will come: what waits is processed with what there is.
    pub fn end(&mut self) {
        self.ended = true;
    }

    pub fn stats(&self) -> OdometryStats {
        OdometryStats {
            waiting_reason: self.waiting_reason.clone(),
            health: self.health_summary(),
            ..self.stats.clone()
        }
    }

    fn health_summary(&self) -> HealthSummary {
        let rest = self.running.as_ref().map_or(0.0, |running| running.rest.seconds());
        let summary = self.health.summary();
        HealthSummary { seconds_at_rest: summary.seconds_at_rest + rest, ..summary.clone() }
    }

    pub fn truth(&self) -> &TruthTrack {
        &self.truth
    }

    /// The map as it stands, in order of insertion.
    pub fn map(&self) -> Vec<MapPointView> {
        self.running
            .as_ref()
            .map(|running| map_views(&running.map, running.seeing_frames))
            .unwrap_or_default()
    }

    fn advance(&mut self, stamp: Stamp) {
        self.now = Some(self.now.map_or(stamp, |now| now.max(stamp)));
    }

    /// Processes the oldest waiting frame if everything up to its time is there. The frame comes
    /// back with its report.
    pub fn step(&mut self) -> Option<(StepReport, Box<RgbdFrame>)> {
        if self.health.stops() {
            return None;
        }
        while self.running.is_none() {
            let note = self.try_start()?;
            self.notes.extend(note);
        }
        let (_, front) = self.frames.front()?;
        let stamp = self.frame_time(front);
        let late = self.now.is_some_and(|now| now.seconds_since(stamp) > PATIENCE);
        if !self.has_reached(stamp) && !self.ended && !late {
            return None;
        }
        let (number, mut front) = self.frames.pop_front()?;
        let report = self.process(number, &mut front, stamp)?;
        if let Some(divergence) = self.health.restarts() {
            self.leave_off(divergence, stamp);
        }
        Some((report, front.frame))
    }

    /// Whether the IMU has, and the reference, which is compared with the estimate at every frame.
    fn has_reached(&self, stamp: Stamp) -> bool {
        let imu = self.imu.back().is_some_and(|sample| sample.stamp >= stamp);
        let reference = self.truth.newest().is_none_or(|newest| newest >= stamp);
        (imu || !self.has_imu) && reference
    }

    /// When a frame was taken by the IMU's clock, as far as is known.
    fn frame_time(&self, frame: &FrontEndFrame) -> Stamp {
        let estimated = self.calibration().map(|calibration| calibration.time_offset);
        let offset = estimated.unwrap_or(self.config.camera.time_offset);
        frame.frame.stamp.offset_by(offset + self.clock.offset())
    }

    /// The camera's calibration as estimated, if it is.
    pub fn calibration(&self) -> Option<&Calibration> {
        self.running.as_ref()?.filter.calibration()
    }

    fn body_from_camera(&self) -> Isometry3<f64> {
        self.calibration().map_or(self.body_from_camera, |estimate| estimate.body_from_camera)
    }

    /// One attempt to start at the oldest frame; `None` if there is nothing to do now.
    fn try_start(&mut self) -> Option<Option<Note>> {
        let (_, front) = self.frames.front()?;
        let first_frame = self.frame_time(front);
        self.imu.make_contiguous();
        let evidence = Evidence {
            imu: self.has_imu.then_some(self.imu.as_slices().0),
            truth: &self.truth,
            first_frame,
            now: self.now?,
            ended: self.ended,
            attitude: self.legacy.as_ref().map(|legacy| legacy.attitude),
        };
        let attempt = match self.legacy {
            Some(_) => self.initializer.anew().attempt(&evidence),
            None => self.initializer.attempt(&evidence),
        };
        match attempt {
            Attempt::Wait => None,
            Attempt::NextFrame(reason) => {
                // The first reason tells most: later ones may only say that the log has ended.
                self.waiting_reason.get_or_insert_with(|| {
                    tracing::warn!("not initialised at {first_frame} s: {reason}; waiting");
                    reason
                });
                self.frames.pop_front();
                self.stats.frames_before_initialization += 1;
                Some(None)
            }
            Attempt::Ready { belief, known, how } => {
                self.waiting_reason = None;
                let text = match self.legacy.take() {
                    Some(legacy) => {
                        let kept = legacy.map.is_some();
                        let map = if kept { "kept" } else { "dropped, heading and place unknown" };
                        let text = format!("re-initialised at {first_frame} s: {how}; map {map}");
                        self.start_anew(*belief, legacy, first_frame);
                        text
                    }
                    None => {
                        let text = format!("initialised at {first_frame} s: {how}");
                        self.stats.initialization = Some(how);
                        self.start(*belief, known, first_frame);
                        text
                    }
                };
                Some(Some(Note { level: NoteLevel::Info, text }))
            }
        }
    }

    fn start(&mut self, belief: Belief, known: KnownAttitude, time: Stamp) {
        let filter = &self.config.filter;
        let propagator = if self.has_imu {
            Propagator::inertial(&self.config.imu)
        } else {
            Propagator::constant_velocity(filter.angular_acceleration, filter.acceleration)
        };
        let mut last_imu = None;
        while self.imu.front().is_some_and(|sample| sample.stamp <= time) {
            last_imu = self.imu.pop_front();
        }
        let mut estimator = self.kind.start_knowing(known, filter, propagator, belief);
        let offset = self.config.camera.time_offset;
        if let Some(prior) = Calibration::prior(filter, &self.body_from_camera, offset)
            && !(self.has_imu && estimator.calibrate(&prior))
        {
            tracing::warn!("only mfgs and mekfs with an IMU estimate the camera's calibration");
        }
        self.running = Some(Running {
            vertical_sought_since: (!estimator.knows_vertical()).then_some(time),
            filter: estimator,
            map: Map::new(&self.config.map),
            last_imu: last_imu.map(|sample| ImuSample { stamp: time, ..sample }),
            time,
            expects_matches: false,
            seeing_frames: 0,
            blind_frames: 0,
            last_sample: last_imu.map(|sample| sample.stamp),
            told_gap_after: None,
            levelling_counts: true,
            rest: RestDetector::new(&self.config.standstill, &self.config.imu),
            spread: Spread::default(),
        });
    }

    /// Gives the estimate up; the next frame is the first one of another.
    fn leave_off(&mut self, divergence: Divergence, stamp: Stamp) {
        let Some(running) = self.running.take() else { return };
        self.health.rested(running.rest.seconds());
        let belief = *running.filter.belief();
        self.legacy = Some(Legacy {
            sound: self.sound.unwrap_or((stamp, belief)),
            attitude: belief.state.world_from_body.rotation,
            map: Legacy::keeps_map(divergence).then_some(running.map),
            spread: running.spread,
            seeing_frames: running.seeing_frames,
            last_sample: running.last_sample,
        });
    }

    fn start_anew(&mut self, belief: Belief, legacy: Legacy, time: Stamp) {
        let belief = legacy.place(belief, time, self.has_imu, &self.config.filter);
        let spread = legacy.spread(self.config.health.max_position_sd);
        self.health.restarted(&belief);
        self.start(belief, KnownAttitude::All, time);
        if let Some(running) = &mut self.running {
            running.spread = spread;
            running.last_sample = running.last_sample.or(legacy.last_sample);
            if let Some(map) = legacy.map {
                running.expects_matches = !map.is_empty();
                running.seeing_frames = legacy.seeing_frames;
                running.map = map;
            }
        }
    }

    fn process(
        &mut self,
        number: u64,
        front: &mut FrontEndFrame,
        stamp: Stamp,
    ) -> Option<StepReport> {
        let body_from_camera = self.body_from_camera();
        let running = self.running.as_mut()?;
        let mut notes = std::mem::take(&mut self.notes);
        let size = (front.frame.color.width(), front.frame.color.height());
        let lost = self.health.is_lost();
        let mut laps = StageClock::start(front.seconds);
        self.stats.imu_gaps += running.propagate_to(
            stamp,
            &mut self.imu,
            &mut self.gyroscope,
            self.watch.is_noisy(stamp) || self.clock.is_in_doubt(),
            &self.config,
            &mut notes,
        );
        if let Some(points) = running.filter.point_state().filter(|_| self.has_imu) {
            points.blur_time(self.clock.jitter());
        }
        let mut view = View {
            config: &self.config,
            camera: &self.camera,
            body_from_camera: &body_from_camera,
            size,
            shutter: running.shutter(&self.config, size, &body_from_camera, None),
            seed: self.seed.wrapping_add(number),
            lost,
        };
        laps.lap(|times| &mut times.propagation);

        let features = &front.extraction.features;
        let detected = features.len();
        let with_depth = features.iter().filter(|feature| feature.depth.is_some()).count();
        notes.extend(self.watch.frame(front.frame.stamp, features, view.size));
        let in_sight = self.health.is_lost_in_sight();
        let sound = self.sound.as_ref();
        let mut found = running.locate(front, &mut view, sound, stamp, in_sight, &mut laps);
        notes.extend(found.note.take());
        let attitude = found.pose.map(|pose| pose.rotation * body_from_camera.rotation.inverse());
        if let Some(attitude) = attitude.filter(|_| self.has_imu) {
            notes.extend(self.gyroscope.attitude(stamp, attitude));
        }
        let bias = running.filter.belief().state.gyro_bias;
        let retimed = self.clock.attitude(stamp, attitude, &bias);
        let Found { candidates, mut matches, pose, mut inliers, others, .. } = found;

        if let Some(pose) = pose.filter(|_| view.shutter.is_rolling()) {
            let known = Some(&pose);
            let shutter = running.shutter(view.config, view.size, &body_from_camera, known);
            let before = std::mem::replace(&mut view.shutter, shutter);
            matches.iter_mut().for_each(|m| m.reread(features, &before, &view));
        }
        if let Some(pose) = pose.filter(|_| view.config.search.seek_state_points) {
            running.seek_state_points(&pose, front, &mut matches, &mut inliers, &view);
        }
        let features = &front.extraction.features;

        let treatment = self.kind.map_treatment();
        let updated = running.update(&matches, &inliers, treatment, &view);
        if updated.is_none() && running.expects_matches {
            self.stats.frames_without_update += 1;
        }
        notes.extend(running.tell_vertical(stamp));
        let visible = with_depth >= view.config.search.min_matches;
        let sight = Sight {
            expected: std::mem::replace(&mut running.expects_matches, true),
            visible,
            features: detected,
            matches: matches.len(),
            inliers: inliers.len(),
            updated: updated.is_some(),
        };
        notes.extend(self.health.see(stamp, sight));
        notes.extend(running.judge_rest(stamp, &matches, &inliers, &view));
        let belief = running.filter.belief();
        let agreement = Agreement {
            matches: matches.len(),
            inliers: inliers.len(),
            others,
            contradicted: updated.is_some_and(|outcome| outcome.contradicts()),
        };
        notes.extend(self.watch.agreement(stamp, agreement));
        notes.extend(self.watch.gyro_bias(stamp, &belief.state));
        notes.extend(self.watch.accel_bias(stamp, &belief.state));
        if self.watch.accel_bias_lasts(stamp) && !self.watch.is_noisy(stamp) {
            running.doubt_levelling(stamp, &self.config.imu);
        }
        running.weigh_levelling(agreement.contradicted, &self.config.imu);
        let belief = running.filter.belief();
        let innovation = updated.map(|outcome| outcome.innovation);
        notes.extend(self.health.judge(stamp, belief, innovation));
        if self.health.is_sound(innovation) {
            self.sound = Some((stamp, *belief));
        }
        laps.lap(|times| &mut times.update);

        if !self.health.is_lost() {
            running.seeing_frames += 1;
        }
        if running.gives_up_map(visible, updated.is_some(), &view) {
            notes.push(self.health.map_given_up(stamp));
        }
        let lost = self.health.is_lost();
        let estimate = running.filter.calibration().map(|estimate| estimate.body_from_camera);
        let body_from_camera = estimate.unwrap_or(body_from_camera);
        let shutter = running.shutter(view.config, view.size, &body_from_camera, None);
        let view = View { body_from_camera: &body_from_camera, shutter, ..view };
        let fates = running.grow_map(features, &matches, &inliers, treatment, lost, &view);
        laps.lap(|times| &mut times.map);

        if let Some((offset, note)) = retimed {
            notes.push(note);
            running.time = running.time.offset_by(offset);
            self.imu = self.clock.samples().copied().collect();
            self.sound = self.sound.map(|(time, belief)| (time.offset_by(offset), belief));
        }

        self.stats.frames_processed += 1;
        let wants_map = self.map_every > 0 && number.is_multiple_of(self.map_every);
        let belief = running.filter.belief();
        let count = |role| fates.iter().filter(|fate| fate.role == role).count();
        Some(StepReport {
            frame: number,
            stamp: front.frame.stamp,
            state: belief.state,
            covariance: running.reported_covariance(),
            world_from_camera: running.world_from_camera(&view),
            calibration: running.filter.calibration().copied(),
            matrix_fisher: running.matrix_fisher(),
            innovation,
            screening: updated.map(|outcome| outcome.screening),
            counts: StepCounts {
                features: detected,
                with_depth,
                candidates,
                matches: matches.len(),
                inliers: inliers.len(),
                new_points: count(KeypointRole::New),
                map_points: running.map.len(),
            },
            times: laps.times,
            keypoints: keypoint_views(features, &fates),
            map: wants_map.then(|| map_views(&running.map, running.seeing_frames)),
            notes,
        })
    }
}

/// What was found of the map in a frame.
struct Found {
    /// Map points looked for.
    candidates: usize,
    matches: Vec<Association>,
    /// World from camera, as the inliers agree.
    pose: Option<Isometry3<f64>>,
    /// Indices into the matches.
    inliers: Vec<usize>,
    /// Matches that agree on another pose.
    others: usize,
    /// That the body was carried off.
    note: Option<Note>,
}

/// What became of a feature.
#[derive(Debug, Clone, Copy)]
struct Fate {
    role: KeypointRole,
    /// Id of the map point it was matched to, and where that was predicted.
    matched: Option<(u64, Point2<f64>)>,
}

impl Fate {
    fn of(role: KeypointRole) -> Self {
        Self { role, matched: None }
    }
}

impl Running {
    /// Carries the belief to `stamp`, trusting `noisy` samples no more than those that stand in for
    /// a gap; gives the number of gaps in the IMU data on the way.
    fn propagate_to(
        &mut self,
        stamp: Stamp,
        imu: &mut VecDeque<ImuSample>,
        gyroscope: &mut GyroscopeWatch,
        noisy: bool,
        config: &OdometryConfig,
        notes: &mut Vec<Note>,
    ) -> u64 {
        // After the belief has been timed anew some are behind it.
        while let Some(sample) = imu.pop_front_if(|sample| sample.stamp <= self.time) {
            self.last_imu = Some(sample);
            self.last_sample = Some(sample.stamp);
        }
        let Some(mut last) = self.last_imu.or_else(|| imu.front().copied()) else {
            self.filter.coast(stamp.seconds_since(self.time));
            self.time = stamp;
            return 0;
        };
        last.stamp = self.time;
        let mut gaps = 0;
        loop {
            let next = imu.front().copied();
            let until = next.map_or(stamp, |sample| sample.stamp);
            let gap = self.gap_before(until, config.imu.max_gap);
            gaps += u64::from(self.tell_gap(gap, notes));
            self.filter.set_imu_gap(gap.is_some() || noisy || gyroscope.is_wrong());
            let reached = next.filter(|sample| sample.stamp <= stamp);
            let to = match (reached, next) {
                (Some(sample), _) => sample,
                (None, Some(next)) => ImuSample::between(&last, &next, stamp),
                (None, None) => ImuSample { stamp, ..last },
            };
            let bias = self.filter.belief().state.gyro_bias;
            let measured = to;
            let to = gyroscope.reading(to, to.stamp.seconds_since(last.stamp), &bias);
            if !self.filter.propagate(&last, &to) {
                let text = format!("IMU samples up to {} s left out: no finite belief", to.stamp);
                notes.push(Note { level: NoteLevel::Warning, text });
            }
            last = to;
            if reached.is_none() {
                break;
            }
            imu.pop_front();
            self.last_sample = Some(to.stamp);
            self.rest.push_imu(measured);
        }
        self.last_imu = Some(last);
        self.time = stamp;
        gaps
    }

    /// Length of the interval without samples up to `until`, if it is a gap, s.
    fn gap_before(&self, until: Stamp, max_gap: f64) -> Option<f64> {
        let interval = until.seconds_since(self.last_sample?);
        (interval > max_gap).then_some(interval)
    }

    /// Tells of a gap when it is first met: true.
    fn tell_gap(&mut self, gap: Option<f64>, notes: &mut Vec<Note>) -> bool {
        let (Some(length), Some(after)) = (gap, self.last_sample) else { return false };
        if self.told_gap_after == self.last_sample {
            return false;
        }
        self.told_gap_after = self.last_sample;
        let text = format!("IMU gap of {length:.3} s after {after} s: bridged by vision");
        notes.push(Note { level: NoteLevel::Warning, text });
        true
    }

    /// Doubts the levelling by an accelerometer whose bias proves to be none of its kind.
    fn doubt_levelling(&mut self, stamp: Stamp, imu: &ImuConfig) {
        let accel_bias_sd = BIAS_FACTOR * imu.accel_bias_sd;
        if std::mem::take(&mut self.levelling_counts) && self.filter.doubt_levelling(accel_bias_sd)
        {
            self.vertical_sought_since = Some(stamp);
        }
    }

    /// The levelling counts no more once the bias is known much better than at the start, or may
    /// have changed since.
    fn weigh_levelling(&mut self, contradicted: bool, imu: &ImuConfig) {
        let covariance = &self.filter.belief().covariance;
        let bias = covariance.fixed_view::<3, 3>(block::ACCEL_BIAS, block::ACCEL_BIAS);
        let found = bias.diagonal().max().sqrt() < 0.5 * imu.accel_bias_sd;
        self.levelling_counts &= !found && !contradicted;
    }

    /// Tells that the vertical is known when it has become so.
    fn tell_vertical(&mut self, stamp: Stamp) -> Option<Note> {
        let since = self.vertical_sought_since.take_if(|_| self.filter.knows_vertical())?;
        let rotation = self.filter.belief().state.world_from_body.rotation.to_rotation_matrix();
        let covariance = self.filter.pose_covariance().fixed_view::<3, 3>(0, 0).into_owned();
        let in_world = rotation.matrix() * covariance * rotation.matrix().transpose();
        let sd = (0.5 * (in_world.m11 + in_world.m22)).sqrt().to_degrees();
        let seconds = stamp.seconds_since(since);
        let text =
            format!("attitude found after {seconds:.2} s: roll and pitch known to {sd:.1} deg");
        Some(Note { level: NoteLevel::Info, text })
    }

    /// How the camera moves while it takes an image: as the belief has it, or would have it if the
    /// camera were at `pose`.
    fn shutter(
        &self,
        config: &OdometryConfig,
        size: (usize, usize),
        body_from_camera: &Isometry3<f64>,
        pose: Option<&Isometry3<f64>>,
    ) -> Shutter {
        let belief = self.filter.belief();
        let given = pose.and_then(|pose| given_pose(belief, &(pose * body_from_camera.inverse())));
        let state = given.unwrap_or(belief.state);
        let rate = self.last_imu.map_or_else(Vector3::zeros, |sample| sample.angular_velocity);
        Shutter::new(&config.camera, size.1, body_from_camera, &state, &rate)
    }

    fn world_from_camera(&self, view: &View) -> Isometry3<f64> {
        self.filter.belief().state.world_from_body * view.body_from_camera
    }

    /// Of the error in the world of the first start, whose vertical is up.
    fn reported_covariance(&self) -> NavCovariance {
        let state = &self.filter.belief().state;
        self.filter.reported_covariance() + self.spread.covariance(state)
    }

    fn matrix_fisher(&self) -> Option<ProperSvd> {
        let known = self.filter.matrix_fisher()?;
        if self.spread == Spread::default() {
            return Some(known);
        }
        let state = self.filter.belief().state;
        let reported = Belief { state, covariance: self.reported_covariance() };
        reported.attitude().map(|attitude| *attitude.svd())
    }

    /// Looks for the map in a frame. A pose further from `sound`, the last one that nothing spoke
    /// against, than a body moves, or found when vision was lost `in_sight`, must show what should be
    /// in view there. Then the body is put there, and all is looked for again.
    fn locate(
        &mut self,
        front: &FrontEndFrame,
        view: &mut View,
        sound: Option<&(Stamp, Belief)>,
        stamp: Stamp,
        in_sight: bool,
        laps: &mut StageClock,
    ) -> Found {
        let features = &front.extraction.features;
        let mut found = self.look(features, view, laps);
        let Some((pose, (before, sound))) = found.pose.zip(sound) else { return found };
        if !self.filter.knows_vertical() || self.filter.point_state().is_none() {
            return found;
        }
        let world_from_body = pose * view.body_from_camera.inverse();
        let after = stamp.seconds_since(*before);
        let in_the_dark = view.lost && !in_sight;
        let jump = Jump::between(&sound.state, &world_from_body, after, in_the_dark);
        if !in_sight && jump.is_none() {
            return found;
        }
        let seen = self.in_view(&pose, front, &found, view);
        if !seen.confirms() {
            tracing::debug!("at {stamp} s {seen:?} do not confirm a pose");
            return Found { pose: None, inliers: Vec::new(), ..found };
        }
        if let Some(jump) = jump {
            self.carry_off(&world_from_body, &view.config.filter);
            view.shutter = self.shutter(view.config, view.size, view.body_from_camera, None);
            found = self.look(features, view, laps);
            found.note = Some(jump.note(stamp, seen));
        }
        found
    }

    /// Looks for the map in a frame; where nothing of it agrees near the prediction, everywhere.
    fn look(&self, features: &[Feature], view: &View, laps: &mut StageClock) -> Found {
        let (mut candidates, mut matches) = self.find_matches(features, view);
        laps.lap(|times| &mut times.matching);
        let (mut agreement, mut others) = self.find_pose(&matches, view);
        if agreement.is_none() && candidates < self.map.len() {
            let anywhere = self.match_everywhere(features, view);
            let (agreeing, moving) = self.find_pose(&anywhere, view);
            if agreeing.is_some() {
                (candidates, matches) = (self.map.len(), anywhere);
                (agreement, others) = (agreeing, moving);
            }
        }
        laps.lap(|times| &mut times.ransac);
        Found {
            candidates,
            matches,
            pose: agreement.as_ref().map(|agreement| agreement.model),
            inliers: agreement.map(|agreement| agreement.inliers).unwrap_or_default(),
            others,
            note: None,
        }
    }

    /// Number of map points that should be visible, and the features that look like one.
    fn find_matches(&self, features: &[Feature], view: &View) -> (usize, Vec<Association>) {
        let world_from_camera = self.world_from_camera(view);
        let ids = self.map.candidates(&world_from_camera, view.camera, view.size.0, view.size.1);
        let enough = view.config.search.min_matches;
        let mut associations = self.match_candidates(&ids, features, view, None);
        if associations.len() < enough {
            let radius = Some(view.config.search.max_radius);
            associations = self.match_candidates(&ids, features, view, radius);
        }
        if associations.len() < enough && view.lost {
            // The prediction has been without correction: everything may be anywhere.
            return (self.map.len(), self.match_everywhere(features, view));
        }
        (ids.len(), associations)
    }

    fn match_everywhere(&self, features: &[Feature], view: &View) -> Vec<Association> {
        let ids: Vec<_> = self.map.points().iter().map(|point| point.id).collect();
        self.match_candidates(&ids, features, view, Some(f64::INFINITY))
    }

    /// What is seen of the points of the state that a camera at `world_from_camera` has in view.
    fn in_view(
        &self,
        world_from_camera: &Isometry3<f64>,
        front: &FrontEndFrame,
        found: &Found,
        view: &View,
    ) -> InView {
        let matched: HashSet<_> =
            found.inliers.iter().filter_map(|&i| found.matches.get(i)).map(|m| m.point).collect();
        let (width, height) = view.size;
        let mut in_view = InView { agreeing: found.inliers.len(), expected: 0, seen: 0 };
        for id in self.map.candidates(world_from_camera, view.camera, width, height) {
            let Some(point) = self.map.get(id).filter(|point| point.held) else { continue };
            let seen =
                matched.contains(&id) || seek(point, world_from_camera, front, view).is_some();
            in_view.expected += 1;
            in_view.seen += usize::from(seen);
        }
        in_view
    }

    /// Puts the body at a pose that the map is seen from.
    fn carry_off(&mut self, world_from_body: &Isometry3<f64>, config: &FilterConfig) {
        let way = self.filter.belief().state.world_from_body.inv_mul(world_from_body);
        if let Some(points) = self.filter.point_state() {
            points.carry_off(&way, &spread_of_recognition(config));
        }
    }

    /// Looks for map points near where they are predicted: within their uncertainty, or within
    /// `radius` (px) where one is given.
    fn match_candidates(
        &self,
        ids: &[u64],
        features: &[Feature],
        view: &View,
        radius: Option<f64>,
    ) -> Vec<Association> {
        let world_from_camera = self.world_from_camera(view);
        let search = &view.config.search;
        let pose_covariance = self.filter.pose_covariance();
        let rotation = self.filter.belief().state.world_from_body.rotation;
        let predict = |point: &MapPoint| -> Option<Prediction> {
            let in_camera =
                world_from_camera.inverse_transform_point(&Point3::from(point.position)).coords;
            let pixel = view.project(&in_camera)?;
            // Spread of the prediction in the image: turning by `e` moves it by about `f e`,
            // moving by `d` by `f d / z`.
            let in_body = (view.body_from_camera * Point3::from(in_camera)).coords;
            let by_pose = point_by_pose(rotation.to_rotation_matrix().matrix(), &in_body);
            let spread = by_pose * pose_covariance * by_pose.transpose() + point.covariance;
            let sigma = view.camera.fx * spread.trace().max(0.0).sqrt() / in_camera.z;
            let likely = (search.min_radius + 3.0 * sigma).min(search.max_radius);
            let radius = radius.unwrap_or(likely);
            Some(Prediction { descriptor: point.descriptor, pixel, radius })
        };
        let (points, predictions): (Vec<_>, Vec<_>) = ids
            .iter()
            .filter_map(|id| self.map.get(*id))
            .filter_map(|point| Some((point, predict(point)?)))
            .unzip();
        let associate = |m: Match| {
            let (point, prediction) = (points.get(m.query)?, predictions.get(m.query)?);
            let feature = features.get(m.train)?;
            let placed = place(feature, point, &world_from_camera, view)?;
            Some(Association::new(m.train, point, prediction.pixel, placed))
        };
        let matches = match_guided(&predictions, features, &view.config.matching);
        matches.into_iter().filter_map(associate).collect()
    }

    /// The pose of the camera and the indices into `matches` that agree on it, and how many agree on
    /// another: that of something that moves.
    ///
    /// Most may lie on what moves. Of two motions that have nothing in common, the camera's is
    /// the one that the IMU predicts, if more of the points that have long been seen follow it.
    fn find_pose(
        &self,
        matches: &[Association],
        view: &View,
    ) -> (Option<ransac::Agreement<Isometry3<f64>>>, usize) {
        let correspondences: Vec<_> = matches.iter().map(|m| m.correspondence).collect();
        let predicted = self.world_from_camera(view);
        let config = &view.config.ransac;
        let agree = |among: &[Correspondence]| {
            estimate_pose(among, view.camera, Some(&predicted.rotation), config, view.seed)
        };
        let Some(mut found) = agree(&correspondences) else { return (None, 0) };
        if self.last_imu.is_some()
            && !view.lost
            && 10 * found.inliers.len() < 9 * matches.len()
            && let Some(expected) = agree_near(&correspondences, view.camera, &predicted, config)
        {
            let shared = expected.inliers.iter().filter(|i| found.inliers.binary_search(i).is_ok());
            let apart = 2 * shared.count() < expected.inliers.len();
            let proven = |inliers: &[usize]| {
                let observations =
                    |i: &usize| self.map.get(matches[*i].point).map(|point| point.observations);
                let least = view.config.filter.state_min_observations;
                inliers.iter().filter(|i| observations(i) >= Some(least)).count()
            };
            if apart && proven(&expected.inliers) > proven(&found.inliers) {
                found = expected;
            }
        }
        // What is a little off follows the camera, only not as well as it should.
        let near = agreeing(&correspondences, view.camera, &found.model, 3.0, config);
        let astray: Vec<_> = (correspondences.iter().zip(membership(&near, matches.len())))
            .filter_map(|(correspondence, near)| (!near).then_some(*correspondence))
            .collect();
        let suspect = self.seeing_frames >= SETTLED
            && astray.len() >= FEW_ASTRAY
            && 4 * astray.len() > matches.len();
        let others = agree(if suspect { &astray } else { &[] });
        (Some(found), others.map_or(0, |others| others.inliers.len()))
    }

    /// Looks for the points of the filter's state that `inliers` lack where `world_from_camera`
    /// has them; adds what is found to the features of the frame, to `matches` and to `inliers`.
    fn seek_state_points(
        &self,
        world_from_camera: &Isometry3<f64>,
        front: &mut FrontEndFrame,
        matches: &mut Vec<Association>,
        inliers: &mut Vec<usize>,
        view: &View,
    ) {
        let (width, height) = view.size;
        let found: HashSet<_> =
            inliers.iter().filter_map(|&i| matches.get(i)).map(|m| m.point).collect();
        for id in self.map.candidates(world_from_camera, view.camera, width, height) {
            let Some(point) = self.map.get(id).filter(|p| p.held && !found.contains(&p.id)) else {
                continue;
            };
            if let Some((feature, m)) = seek(point, world_from_camera, front, view) {
                front.extraction.features.push(feature);
                inliers.push(matches.len());
                matches.push(m);
            }
        }
    }

    /// Conditions belief and map on the inliers; `None` if there were none.
    fn update(
        &mut self,
        matches: &[Association],
        inliers: &[usize],
        treatment: MapTreatment,
        view: &View,
    ) -> Option<UpdateOutcome> {
        let pairs: Vec<_> = inliers
            .iter()
            .filter_map(|&i| matches.get(i))
            .map(|m| (m.point, point_pair(&m.correspondence, view)))
            .collect();
        let calibration = self.filter.calibration().copied();
        let held =
            |points: &dyn PointState| pairs.iter().any(|(id, _)| points.estimate(*id).is_some());
        let outcome = match self.filter.point_state() {
            Some(points) if held(points) => {
                let seen: Vec<_> = pairs.iter().map(|(id, pair)| seen_point(*id, pair)).collect();
                points.measure(&seen)?
            }
            Some(_) => {
                let outcome = self.find_back(&pairs, view)?;
                self.follow_camera(calibration);
                return Some(outcome);
            }
            None => {
                let only_pairs: Vec<_> = pairs.iter().map(|(_, pair)| *pair).collect();
                self.filter.update(&only_pairs)?
            }
        };
        let moved = self.follow_world() | self.follow_camera(calibration);
        if !moved && treatment != MapTreatment::Fixed {
            let refinement = self.filter.map_refinement();
            let passed = self.filter.passed().iter();
            for ((id, pair), _) in pairs.iter().zip(passed).filter(|(_, passed)| **passed) {
                if let Some(refined) = refinement.posterior(pair) {
                    self.map.relocate(*id, refined.position, refined.covariance);
                }
            }
        }
        Some(outcome)
    }

    /// Leads a filter none of whose points is seen back to the map, by points that were there
    /// before vision was lost: their errors are treated as independent of the belief's.
    fn find_back(&mut self, pairs: &[(u64, PointPair)], view: &View) -> Option<UpdateOutcome> {
        let old =
            |id: u64| self.map.get(id).is_some_and(|point| point.first_seen < self.seeing_frames);
        let known: Vec<_> =
            pairs.iter().filter(|(id, _)| old(*id)).map(|(_, pair)| *pair).collect();
        let enough = known.len() >= view.config.ransac.min_inliers;
        let outcome = if enough { self.filter.update(&known)? } else { return None };
        self.follow_world();
        Some(outcome)
    }

    /// Turns the map if the filter has turned the world; true if so.
    fn follow_world(&mut self) -> bool {
        let turn = self.filter.take_world_turn();
        if let Some(turn) = turn {
            self.map.carry(&Isometry3::from_parts(Translation3::identity(), turn));
        }
        turn.is_some()
    }

    /// Moves the map with the camera where the calibration is another than `before`: from about
    /// here its points were placed by it, and those of the state have moved so. True if it was
    /// moved by more than what points are measured to.
    fn follow_camera(&mut self, before: Option<Calibration>) -> bool {
        let Some((before, now)) = before.zip(self.filter.calibration()) else { return false };
        let in_body = now.body_from_camera * before.body_from_camera.inverse();
        let world_from_body = self.filter.belief().state.world_from_body;
        self.map.carry(&(world_from_body * in_body * world_from_body.inverse()));
        in_body.rotation.angle() > 1e-4 || in_body.translation.vector.norm() > 1e-4
    }

    /// Conditions the belief on rest if the body is at rest; a note where that begins or ends.
    fn judge_rest(
        &mut self,
        stamp: Stamp,
        matches: &[Association],
        inliers: &[usize],
        view: &View,
    ) -> Option<Note> {
        let seen = inliers
            .iter()
            .filter_map(|&i| matches.get(i))
            .map(|m| (m.point, in_body(&m.correspondence.measurement, view).0))
            .collect();
        let (rest, note) = self.rest.judge(stamp, &self.filter.belief().state, seen);
        if let Some(rest) = rest.filter(|_| view.config.standstill.update) {
            self.filter.rest(&rest);
            self.follow_world();
        }
        note
    }

    /// Empties the map and the state's part of it when nothing there has been found again for as
    /// many frames as the configuration allows, though there was enough to see; true if so.
    fn gives_up_map(&mut self, visible: bool, updated: bool, view: &View) -> bool {
        self.blind_frames = if updated { 0 } else { self.blind_frames + u64::from(visible) };
        let patience = view.config.map.max_unseen_frames;
        let Some(points) = self.filter.point_state().filter(|_| self.blind_frames > patience)
        else {
            return false;
        };
        for id in points.ids() {
            points.release(id);
        }
        self.map = Map::new(&view.config.map);
        self.blind_frames = 0;
        true
    }

    /// Renews the points seen, inserts new ones, forgets old ones. What became of each feature
    /// comes back in the order of `features`.
    fn grow_map(
        &mut self,
        features: &[Feature],
        matches: &[Association],
        inliers: &[usize],
        treatment: MapTreatment,
        lost: bool,
        view: &View,
    ) -> Vec<Fate> {
        let number = self.seeing_frames;
        // Points placed by a prediction that drifts would hide the map that is looked for.
        let searching = lost && !self.map.is_empty() && self.filter.point_state().is_some();
        let world_from_camera = self.world_from_camera(view);
        let sighting = |feature: &Feature, reference| Sighting {
            frame: number,
            camera: world_from_camera.translation.vector,
            descriptor: feature.descriptor,
            reference,
        };
        let unmatched = |feature: &Feature| match feature.depth {
            Some(_) => KeypointRole::Unmatched,
            None => KeypointRole::NoDepth,
        };
        let mut fates: Vec<_> = features.iter().map(|f| Fate::of(unmatched(f))).collect();
        let mut seen = Vec::new();
        for (m, accepted) in matches.iter().zip(membership(inliers, matches.len())) {
            let role = if accepted { KeypointRole::Inlier } else { KeypointRole::Outlier };
            fates[m.feature] = Fate { role, matched: Some((m.point, m.predicted)) };
            if accepted {
                let (feature, point) = (&features[m.feature], self.map.get(m.point));
                let reference = point
                    .filter(|_| m.renews_reference)
                    .and_then(|point| reference(feature, point, &world_from_camera, view));
                self.map.observe(m.point, &sighting(feature, reference));
                if feature.depth.is_some() {
                    seen.push(seen_point(m.point, &point_pair(&m.correspondence, view)));
                }
            }
        }
        for (feature, fate) in features.iter().zip(&mut fates) {
            if searching || fate.role != KeypointRole::Unmatched {
                continue;
            }
            let Some(measurement) = feature.measurement(view.camera) else { continue };
            let measurement = view.at_stamp(feature.pixel, measurement);
            let (in_body, covariance) = in_body(&measurement, view);
            let estimate = self.filter.insert(treatment, &in_body, &covariance);
            let reference = first_reference(feature, &world_from_camera);
            let sighting = sighting(feature, reference);
            let inserted = self.map.insert(estimate.position, estimate.covariance, &sighting);
            if let Some(id) = inserted {
                fate.role = KeypointRole::New;
                seen.push(SeenPoint { id, in_body, body_covariance: covariance });
            }
        }
        if let Some(points) = self.filter.point_state() {
            renew_state_points(points, &mut self.map, &seen, number, &view.config.filter);
        }
        self.map.prune(number);
        fates
    }
}

/// For each of `count` items whether its index is in the ascending list `chosen`.
fn membership(chosen: &[usize], count: usize) -> impl Iterator<Item = bool> + '_ {
    (0..count).map(|i| chosen.binary_search(&i).is_ok())
}

fn keypoint_views(features: &[Feature], fates: &[Fate]) -> Vec<KeypointView> {
    let pixel = |p: &Point2<f64>| [p.x as f32, p.y as f32];
    features
        .iter()
        .zip(fates)
        .map(|(feature, fate)| KeypointView {
            pixel: pixel(&feature.pixel),
            predicted: fate.matched.as_ref().map(|(_, predicted)| pixel(predicted)),
            point: fate.matched.map(|(point, _)| point),
            role: fate.role,
        })
        .collect()
}

fn map_views(map: &Map, frame: u64) -> Vec<MapPointView> {
    let view = |point: &MapPoint| MapPointView {
        position: [point.position.x as f32, point.position.y as f32, point.position.z as f32],
        covariance: point.covariance.cast(),
        age: frame.saturating_sub(point.first_seen).try_into().unwrap_or(u32::MAX),
    };
    map.points().iter().map(view).collect()
}

/// Attitude of a camera that looks along the world's x axis with its rows horizontal.
fn camera_looking_ahead() -> UnitQuaternion<f64> {
    let world_from_camera = Matrix3::from_columns(&[-Vector3::y(), -Vector3::z(), Vector3::x()]);
    UnitQuaternion::from_matrix(&world_from_camera)
}

/// Wall time of the stages of a frame.
struct StageClock {
    last: Instant,
    times: StageTimes,
}

impl StageClock {
    /// After a front end that has taken `features` seconds.
    fn start(features: f64) -> Self {
        let times = StageTimes { features, ..StageTimes::default() };
        Self { last: Instant::now(), times }
    }

    /// Counts the time since the last lap for a stage.
    fn lap(&mut self, stage: impl Fn(&mut StageTimes) -> &mut f64) {
        let now = Instant::now();
        *stage(&mut self.times) += (now - self.last).as_secs_f64();
        self.last = now;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::{ColorImage, DepthImage, PixelFormat};

    fn at(seconds: f64) -> Stamp {
        Stamp::from_seconds(1_305_031_229.0 + seconds).unwrap()
    }

    fn truth(seconds: f64) -> TruthPose {
        TruthPose { stamp: at(seconds), world_from_body: Isometry3::identity() }
    }

    fn frame(seconds: f64) -> FrontEndFrame {
        let color = ColorImage::new(8, 8, PixelFormat::Rgb8, vec![0; 192]).unwrap();
        let depth = DepthImage::new(8, 8, 0.001, vec![0; 64]).unwrap();
        let frame = Box::new(RgbdFrame { stamp: at(seconds), color, depth });
        FrontEndFrame { frame, extraction: Extraction::default(), seconds: 0.0 }
    }

    #[test]
    fn a_frame_waits_for_the_reference_pose_after_it() {
        let config = OdometryConfig::default();
        let mut odometry = Odometry::new(&config, FilterKind::Mfgr, 1, false).unwrap();
        odometry.push_truth(truth(0.0));
        odometry.push_frame(frame(0.005));
        assert!(odometry.step().is_none());
        odometry.push_truth(truth(0.01));
        let (report, _) = odometry.step().unwrap();
        assert!(odometry.truth().at(report.stamp, config.truth.max_gap).is_some());

        // A reference that has ended holds nothing up for long.
        odometry.push_frame(frame(0.04));
        assert!(odometry.step().is_none());
        odometry.push_frame(frame(0.04 + 1.1 * PATIENCE));
        assert_eq!(odometry.step().unwrap().0.stamp, at(0.04));
        assert!(odometry.step().is_none());
        odometry.end();
        assert!(odometry.step().is_some());
    }
}
