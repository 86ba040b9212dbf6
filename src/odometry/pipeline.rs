//! Visual-inertial odometry: events in, a report a frame out.

use std::time::Instant;

use nalgebra::{Isometry3, Matrix3, UnitQuaternion, Vector3};

use super::back_end::BackEnd;
use super::buffer::EventBuffer;
use super::config::OdometryConfig;
use super::health::HealthSummary;
use super::init::{Attempt, Evidence, Initializer};
use super::levelling::Levelling;
use super::report::{MapPointView, Note, StageTimes, StepReport, map_views};
use super::rest::RestDetector;
use super::restart::{Legacy, Spread};
use super::run::Run;
use super::supervisor::{FrameEvidence, Supervisor};
use super::track_window::TrackWindow;
use super::truth::TruthTrack;
use super::window::{ImuCursor, ImuWindow};
use crate::fault::{Divergence, Episode};
use crate::filter::{Calibration, FilterKind, KnownAttitude};
use crate::inertial::{Belief, Propagator};
use crate::sensor::{ImuSample, RgbdFrame, Stamp, Stream, TruthPose};
use crate::tracking::{FrontEndFrame, TrackingConfig, Tracks, View};
use crate::vision::Feature;

/// Visual-inertial odometry: IMU samples, frames and reference poses go in, in order of time;
/// one [`StepReport`] a frame comes out of [`Self::step`], as soon as IMU and reference have reached it.
///
/// A step costs `O(F + M)` in features and map points; the belief is of fixed size.
pub struct Odometry {
    config: OdometryConfig,
    tracking: TrackingConfig,
    kind: FilterKind,
    seed: u64,
    /// As configured.
    body_from_camera: Isometry3<f64>,
    initializer: Initializer,
    buffer: EventBuffer,
    run: Option<Run>,
    /// What the estimate that is to be started anew has left.
    legacy: Option<Legacy>,
    supervisor: Supervisor,
    map_every: u64,
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

impl OdometryStats {
    /// Counts a frame and the IMU data before it.
    fn count(&mut self, seen: &FrameEvidence, window: &ImuWindow) {
        self.frames_processed += 1;
        self.frames_without_update += u64::from(seen.update.is_none() && seen.expected);
        self.imu_gaps += window.gaps.len() as u64;
    }
}

impl Odometry {
    /// `None` if `camera` is no possible calibration or its mounting no rigid motion.
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
            tracking: config.tracking().ok()?,
            kind,
            seed,
            body_from_camera,
            initializer,
            buffer: EventBuffer::new(has_imu, &config.truth),
            run: None,
            legacy: None,
            supervisor: Supervisor::new(&config.faults, &config.imu, &config.health, has_imu),
            map_every: 0,
            stats: OdometryStats::default(),
        })
    }

    /// Reports carry a copy of the map every `n` frames; 0: never.
    pub fn report_map_every(&mut self, n: u64) {
        self.map_every = n;
    }

    pub fn push_imu(&mut self, sample: ImuSample) {
        if !self.supervisor.stops() && self.buffer.push_imu(sample) {
            self.supervisor.observe_imu(&sample);
        }
    }

    /// A message that came again, and was left out.
    pub fn push_repeated(&mut self, stream: Stream, stamp: Stamp) {
        self.supervisor.observe_repeated(stream, stamp);
    }

    pub fn push_truth(&mut self, pose: TruthPose) {
        self.buffer.push_truth(pose);
    }

    pub fn push_frame(&mut self, frame: FrontEndFrame) {
        if self.supervisor.stops() {
            return;
        }
        self.buffer.push_frame(frame, self.config.camera.time_offset);
    }

    /// No more data will come: what waits is processed with what there is.
    pub fn end(&mut self) {
        self.buffer.end();
    }

    /// What comes now is of another run, as `reason` says: all clocks were set, or all sensors
    /// paused. What waits must have been processed ([`Self::end`], [`Self::step`]).
    pub fn begin_new_run(&mut self, reason: String) {
        let time = self.buffer.now().unwrap_or_default();
        self.abandon(Divergence::View, time);
        if let Some(legacy) = &mut self.legacy {
            legacy.last_sample = None;
        }
        self.buffer.begin_anew();
        self.supervisor.begin_anew();
        self.supervisor.warn(reason);
    }

    pub fn stats(&self) -> OdometryStats {
        let rest = self.run.as_ref().map_or(0.0, |run| run.rest.seconds());
        let summary = self.supervisor.health();
        let seconds_at_rest = summary.seconds_at_rest + rest;
        let health = HealthSummary { seconds_at_rest, ..summary.clone() };
        OdometryStats { out_of_order: self.buffer.out_of_order, health, ..self.stats.clone() }
    }

    /// Faults so far, those that go on last.
    pub fn faults(&self) -> Vec<Episode> {
        self.supervisor.episodes()
    }

    pub fn truth(&self) -> &TruthTrack {
        self.buffer.truth()
    }

    /// The map as it stands, in order of insertion.
    pub fn map(&self) -> Vec<MapPointView> {
        let run = self.run.as_ref();
        run.map(|run| map_views(run.back_end.map(), run.seeing_frames)).unwrap_or_default()
    }

    /// The camera's calibration as estimated, if it is.
    pub fn calibration(&self) -> Option<&Calibration> {
        self.run.as_ref()?.calibration()
    }

    /// When a frame was taken by the IMU's clock, as far as is known.
    fn frame_time(&self, stamp: Stamp) -> Stamp {
        let estimated = self.calibration().map(|calibration| calibration.time_offset);
        let offset = estimated.unwrap_or(self.config.camera.time_offset);
        stamp.offset_by(offset + self.supervisor.clock_offset())
    }

    /// Processes the oldest waiting frame if everything up to its time is there. The frame comes
    /// back with its report.
    pub fn step(&mut self) -> Option<(StepReport, Box<RgbdFrame>)> {
        if self.supervisor.stops() {
            return None;
        }
        while self.run.is_none() {
            self.try_start()?;
        }
        let time = self.frame_time(self.buffer.first_frame()?);
        if !self.buffer.is_complete_until(time) {
            return None;
        }
        let (number, mut front) = self.buffer.pop_frame()?;
        let report = self.process(number, &mut front, time)?;
        if let Some(divergence) = self.supervisor.restarts() {
            self.abandon(divergence, time);
        }
        Some((report, front.frame))
    }

    /// The stages of a frame, taken at `time` by the IMU's clock.
    fn process(
        &mut self,
        number: u64,
        front: &mut FrontEndFrame,
        time: Stamp,
    ) -> Option<StepReport> {
        let Self { config, tracking, buffer, run, supervisor, stats, .. } = self;
        let run = run.as_mut()?;
        let mut laps = StageClock::start(front.seconds);
        let detected = Detected::of(&front.extraction.features);
        supervisor.observe_frame(time, detected.features);

        let window = run.cursor.window_until(time, &mut buffer.imu);
        run.propagate(&window, supervisor, buffer.has_imu());
        let mut prediction = run.prediction(supervisor.is_lost());
        let seed = self.seed.wrapping_add(number);
        let mut view = View::predicted(tracking, &prediction, front.size(), seed);
        laps.lap(|times| &mut times.propagation);

        let mut tracks =
            run.track(front, &mut view, &mut prediction, time, supervisor, &config.filter);
        laps.lap(|times| &mut times.matching);
        laps.split_matching(&tracks);
        let clock_change =
            run.compare_turns(&tracks, &prediction, time, supervisor, buffer.has_imu());
        run.refine_tracks(&mut tracks, front, &mut view, &prediction);

        let update = run.update(&tracks, &view);
        let followed = run.use_followed(front, &tracks, &view, time);
        let seen = FrameEvidence {
            stamp: time,
            expected: std::mem::replace(&mut run.expects_matches, true),
            visible: detected.with_depth >= config.search.min_matches,
            features: detected.features,
            tracks: &tracks,
            update: update.as_ref(),
            followed: &followed,
        };
        stats.count(&seen, &window);
        run.watch(&seen, &view, supervisor, config);
        laps.lap(|times| &mut times.update);

        let prediction = run.prediction(supervisor.is_lost());
        let view = View::predicted(tracking, &prediction, front.size(), seed);
        let assignments = run.maintain(front, &tracks, supervisor.is_lost(), &view);
        laps.lap(|times| &mut times.map);
        if let Some(offset) = clock_change {
            run.cursor.time = run.cursor.time.offset_by(offset);
            buffer.imu = supervisor.retime(offset).collect();
        }

        let notes = supervisor.take_notes();
        let mut report = run.report(front, &tracks, update.as_ref(), &assignments, notes);
        (report.frame, report.times) = (number, laps.times);
        (report.counts.features, report.counts.with_depth) =
            (detected.features, detected.with_depth);
        let wants_map = self.map_every > 0 && number.is_multiple_of(self.map_every);
        report.map = wants_map.then(|| self.map());
        Some(report)
    }

    /// One attempt to start at the oldest frame; `None` if there is nothing to do now.
    fn try_start(&mut self) -> Option<()> {
        let first_frame = self.frame_time(self.buffer.first_frame()?);
        let has_imu = self.buffer.has_imu();
        let now = self.buffer.now()?;
        let ended = self.buffer.has_ended();
        self.buffer.imu.make_contiguous();
        let evidence = Evidence {
            imu: has_imu.then_some(self.buffer.imu.as_slices().0),
            truth: self.buffer.truth(),
            first_frame,
            now,
            ended,
            attitude: self.legacy.as_ref().map(|legacy| legacy.attitude),
        };
        let attempt = match self.legacy {
            Some(_) => self.initializer.anew().attempt(&evidence),
            None => self.initializer.attempt(&evidence),
        };
        match attempt {
            Attempt::Wait => return None,
            Attempt::NextFrame(reason) => {
                // The first reason tells most: later ones may only say that the log has ended.
                self.stats.waiting_reason.get_or_insert_with(|| {
                    tracing::warn!("not initialised at {first_frame} s: {reason}; waiting");
                    reason
                });
                self.buffer.pop_frame();
                self.stats.frames_before_initialization += 1;
            }
            Attempt::Ready { belief, known, how } => {
                self.stats.waiting_reason = None;
                let text = match self.legacy.take() {
                    Some(legacy) => {
                        let kept = legacy.map.is_some();
                        let map = if kept { "kept" } else { "dropped, heading and place unknown" };
                        self.start_anew(*belief, legacy, first_frame);
                        format!("re-initialised at {first_frame} s: {how}; map {map}")
                    }
                    None => {
                        self.start(*belief, known, first_frame);
                        let text = format!("initialised at {first_frame} s: {how}");
                        self.stats.initialization = Some(how);
                        text
                    }
                };
                self.supervisor.note(Note::info(text));
            }
        }
        Some(())
    }

    fn start(&mut self, belief: Belief, known: KnownAttitude, time: Stamp) -> &mut Run {
        let OdometryConfig { filter, imu, .. } = &self.config;
        let has_imu = self.buffer.has_imu();
        let propagator = if has_imu {
            Propagator::inertial(imu)
        } else {
            Propagator::constant_velocity(filter.angular_acceleration, filter.acceleration)
        };
        let cursor = ImuCursor::at(time, &mut self.buffer.imu, imu.max_gap);
        let mut estimator = self.kind.start_knowing(known, filter, propagator, belief);
        let offset = self.config.camera.time_offset;
        if let Some(prior) = Calibration::prior(filter, &self.body_from_camera, offset)
            && !(has_imu && estimator.calibrate(&prior).is_ok())
        {
            tracing::warn!(
                "only filters with map points in the state and an IMU estimate the camera's calibration"
            );
        }
        let levelling = Levelling::of(estimator.as_ref(), time);
        let least = self.config.ransac.min_inliers;
        self.run.insert(Run {
            back_end: BackEnd::new(self.kind, estimator, filter, &self.config.map, least),
            cursor,
            rest: RestDetector::new(&self.config.standstill, imu),
            levelling,
            track_window: TrackWindow::new(filter),
            gauge: Spread::default(),
            configured_mounting: self.body_from_camera,
            expects_matches: false,
            seeing_frames: 0,
            blind_frames: 0,
        })
    }

    fn start_anew(&mut self, belief: Belief, legacy: Legacy, time: Stamp) {
        let belief = legacy.place(belief, time, self.buffer.has_imu(), &self.config.filter);
        let gauge = legacy.spread(self.config.health.max_position_sd);
        self.supervisor.restarted(&belief);
        let run = self.start(belief, KnownAttitude::All, time);
        run.gauge = gauge;
        run.cursor.last_measured = run.cursor.last_measured.or(legacy.last_sample);
        if let Some(map) = legacy.map {
            run.expects_matches = !map.is_empty();
            run.seeing_frames = legacy.seeing_frames;
            run.back_end.adopt_map(map);
        }
    }

    /// Gives the estimate up; the next frame is the first one of another.
    fn abandon(&mut self, divergence: Divergence, time: Stamp) {
        let Some(run) = self.run.take() else { return };
        self.supervisor.rested(run.rest.seconds());
        let belief = *run.belief();
        let sound = self.supervisor.last_sound().copied().unwrap_or((time, belief));
        let Run { back_end, cursor, gauge, seeing_frames, .. } = run;
        self.legacy = Some(Legacy {
            sound,
            attitude: belief.state.world_from_body.rotation,
            map: Legacy::keeps_map(divergence).then(|| back_end.take_map()),
            spread: gauge,
            seeing_frames,
            last_sample: cursor.last_measured,
        });
    }
}

/// What the front end found in a frame.
#[derive(Debug, Clone, Copy)]
struct Detected {
    features: usize,
    with_depth: usize,
}

impl Detected {
    fn of(features: &[Feature]) -> Self {
        let with_depth = features.iter().filter(|feature| feature.depth.is_some()).count();
        Self { features: features.len(), with_depth }
    }
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

    /// Divides the time of tracking as the tracker says.
    fn split_matching(&mut self, tracks: &Tracks) {
        self.times.ransac = tracks.ransac_seconds;
        self.times.matching = (self.times.matching - tracks.ransac_seconds).max(0.0);
    }
}

#[cfg(test)]
mod tests {
    use super::super::buffer::PATIENCE;
    use super::*;
    use crate::sensor::{ColorImage, DepthImage, PixelFormat};
    use crate::vision::Extraction;

    fn at(seconds: f64) -> Stamp {
        Stamp::from_seconds(1_305_031_229.0 + seconds).unwrap()
    }

    fn truth(seconds: f64) -> TruthPose {
        TruthPose { stamp: at(seconds), world_from_body: Isometry3::identity() }
    }

    fn frame(seconds: f64) -> FrontEndFrame {
        let color = ColorImage::new(8, 8, PixelFormat::Rgb8, vec![0; 192]).unwrap();
        let depth = DepthImage::new(8, 8, 0.001, vec![0; 64]).unwrap();
        let frame = Box::new(RgbdFrame { stamp: at(seconds), color, depth, others: Vec::new() });
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
