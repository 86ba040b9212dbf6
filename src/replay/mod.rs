//! One replay from a log to its files and figures: the library behind `replay` and `demo`.

mod attitude;
mod error;
mod evaluation;
mod faults;
mod imu_noise;
mod metrics;
mod navigation;
mod navigation_input;
mod outputs;
mod report;
#[cfg(feature = "vision")]
mod trial;
mod units;

use std::iter::Peekable;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use nalgebra::{Isometry3, Matrix6, UnitQuaternion, Vector3};

pub use attitude::{AttitudeMetrics, AttitudeRequest, InertialInput, Reached, replay_attitude};
pub use evaluation::{Consistency, Evaluated, Evaluation, RelativeErrors, evaluate};
pub use faults::{FaultOutcome, Naming, Recovered, confusion, expected_name, fault_grid};
pub use imu_noise::{NoiseSettings, inertial_samples, noise_of_log};
pub use metrics::{LogEntry, Metrics, StageSummary};
pub use navigation::NavigationOutputs;
pub use navigation_input::{
    NavigationInput, NavigationInputError, NavigationLogs, NavigationSource,
};
pub use outputs::{RESULTS, state_columns};
pub use report::{Series, figures, report};
#[cfg(feature = "vision")]
pub use trial::{Tried, try_out};
pub use units::UnitError;

use crate::config::Config;
use crate::dataset::{self, Fault, Log, LogSummary, ReadReport};
use crate::evaluation::{Similarity, Trajectory, is_vertical, read_trajectory};
use crate::filter::FilterKind;
use crate::inertial::pose_covariance;
use crate::odometry::{FrontEnd, NoteLevel, Observation, Odometry, RunOptions, StepReport, run};
use crate::output;
use crate::sensor::{Event, ImuSample, RgbdFrame, Stamp, TruthPose};
use metrics::{peak_memory_bytes, stage_summaries};
use outputs::Outputs;

pub use error::ReplayError;

/// What a replay is asked for.
pub struct Request<'a> {
    pub log: PathBuf,
    pub config: Config,
    /// File or shipped name that `config` came from.
    pub config_origin: String,
    pub filter: FilterKind,
    pub seed: u64,
    pub threads: usize,
    /// Part of the log, s.
    pub start: f64,
    pub duration: f64,
    /// Directory for the output files.
    pub out: Option<PathBuf>,
    /// Reference trajectory that replaces the log's.
    pub truth: Option<PathBuf>,
    /// Injected into the log, and into the reference poses in it.
    pub faults: Vec<Fault>,
    pub stop: &'a AtomicBool,
}

/// Sees every frame with its report while a replay runs.
pub trait Observer {
    /// `truth` is the reference pose at the frame, its world moved so that it starts where the
    /// estimate starts; where both worlds are z-up without tilting it.
    fn frame(&mut self, report: &StepReport, frame: &RgbdFrame, truth: Option<&Isometry3<f64>>);

    /// A sample as it is read, biases and noise included.
    fn imu(&mut self, _sample: &ImuSample) {}

    /// Every how many frames a report should carry the map; 0: never.
    fn map_every(&self) -> u64 {
        0
    }
}

/// A replay's figures and the series that reports are drawn from.
pub struct Replayed {
    pub metrics: Metrics,
    pub series: Series,
    /// With a reference.
    pub evaluated: Option<Evaluated>,
    /// Stamp of the log's first event, s.
    pub first_seconds: f64,
    /// Stamps of the first and the last frame of the replayed part, s.
    pub frame_span: Option<[f64; 2]>,
    reference: Option<Trajectory>,
    estimate: Vec<TruthPose>,
    covariances: Vec<Matrix6<f64>>,
}

impl Replayed {
    /// The reference, its clock corrected by `truth.time_offset`; `None` where there is none.
    pub fn reference(&self) -> Option<&Trajectory> {
        self.reference.as_ref()
    }

    /// The estimated poses of the body.
    pub fn trajectory(&self) -> &[TruthPose] {
        &self.estimate
    }

    /// Whether stamps increase, poses are finite and covariances positive definite.
    pub fn is_valid(&self) -> bool {
        let pose = |pose: &TruthPose| {
            let Isometry3 { translation, rotation } = pose.world_from_body;
            translation.vector.iter().chain(rotation.coords.iter()).all(|x| x.is_finite())
        };
        self.estimate.windows(2).all(|pair| pair[0].stamp < pair[1].stamp)
            && self.estimate.iter().all(pose)
            && self.covariances.iter().all(|covariance| covariance.cholesky().is_some())
    }
}

/// Replays a log. Files in `request.out` are valid whenever it returns, also when it was stopped.
pub fn replay(
    request: &Request,
    front_end: &mut dyn FrontEnd,
    observers: &mut [&mut dyn Observer],
) -> Result<Replayed, ReplayError> {
    let config = &request.config;
    let faults = &request.faults;
    let mut log = dataset::open_with_faults(&request.log, &config.log, &config.imu, faults)?;
    let summary = log.summary().clone();
    for (role, source) in &summary.sources {
        tracing::info!("{role}: {source}");
    }
    let mut odometry = odometry(request, summary.has_imu, observers)?;
    let mut session = Session::start(request, summary.has_imu)?;
    let mut truth = Vec::new();
    let given = request.truth.as_deref().map(given_truth).transpose()?;
    let options = RunOptions {
        threads: request.threads,
        start: request.start,
        duration: request.duration,
        stop: request.stop,
    };

    let (clock, cpu_clock) = (Instant::now(), cpu_time::ProcessTime::now());
    let given = given.map(Iterator::peekable);
    let (mut first, mut frame_span) = (None, Span::default());
    let events = EventSource {
        log: log.as_mut(),
        given,
        pending: None,
        body_from_camera: camera_in_reference(config, summary.has_imu),
        truth: &mut truth,
        faults,
        first: &mut first,
        part: [request.start, request.start + request.duration],
        frames: &mut frame_span,
    };
    let mut span = Span::default();
    run(events, front_end, &mut odometry, options, |observation| match observation {
        Observation::Imu(sample) => observers.iter_mut().for_each(|o| o.imu(sample)),
        Observation::Frame { report, frame, odometry } => {
            span.extend(report.stamp);
            session.step(report, frame, odometry, observers);
        }
    });
    let wall_seconds = clock.elapsed().as_secs_f64();
    let cpu_seconds = cpu_clock.elapsed().as_secs_f64();

    session.finish_outputs(&odometry)?;
    let times = RunTimes { log_seconds: span.seconds(), wall_seconds, cpu_seconds };
    let read = log.report().clone();
    let mut replayed = conclude(request, summary, read, &odometry, session, &truth, times)?;
    replayed.first_seconds = first.unwrap_or_default().seconds();
    replayed.frame_span = frame_span.0.map(|(first, last)| [first.seconds(), last.seconds()]);
    if let Some(directory) = &request.out {
        write_metrics(directory, &replayed.metrics)?;
    }
    Ok(replayed)
}

/// The odometry of a run, which reports its map as often as the most eager observer asks for it.
fn odometry(
    request: &Request,
    has_imu: bool,
    observers: &[&mut dyn Observer],
) -> Result<Odometry, ReplayError> {
    let config = request.config.odometry();
    let mut odometry = Odometry::new(&config, request.filter, request.seed, has_imu)
        .ok_or(ReplayError::Extrinsics)?;
    let map_every = observers.iter().map(|observer| observer.map_every()).filter(|n| *n > 0).min();
    odometry.report_map_every(map_every.unwrap_or(0));
    Ok(odometry)
}

/// How long a run took, s.
struct RunTimes {
    log_seconds: f64,
    wall_seconds: f64,
    cpu_seconds: f64,
}

/// Evaluates a run that is over and sums it up.
fn conclude(
    request: &Request,
    summary: LogSummary,
    read: ReadReport,
    odometry: &Odometry,
    session: Session,
    truth: &[TruthPose],
    times: RunTimes,
) -> Result<Replayed, ReplayError> {
    let config = &request.config;
    let stats = odometry.stats();
    let estimate = trajectory(&session.estimate);
    let reference = trajectory(&shifted(truth, config.truth.time_offset));
    let Some(estimate) = estimate else {
        let reason = stats.waiting_reason.unwrap_or_else(|| "the log has none".to_owned());
        return Err(ReplayError::NothingProcessed { log: request.log.clone(), reason });
    };
    let evaluated = reference
        .as_ref()
        .map(|reference| evaluate(reference, &estimate, &session.covariances, summary.has_imu));
    let (evaluated, evaluation_failure) = match evaluated.transpose() {
        Ok(evaluated) => (evaluated, None),
        Err(error) => (None, Some(error.to_string())),
    };
    let metrics = Metrics {
        log: request.log.display().to_string(),
        log_kind: summary.kind,
        config: request.config_origin.clone(),
        filter: request.filter.to_string(),
        init: config.init.mode.to_string(),
        seed: request.seed,
        threads: request.threads,
        sources: summary.sources,
        has_imu: summary.has_imu,
        notes: with_skipped(session.notes, &read),
        read,
        odometry: stats,
        interrupted: request.stop.load(std::sync::atomic::Ordering::Relaxed),
        log_seconds: times.log_seconds,
        wall_seconds: times.wall_seconds,
        cpu_seconds: times.cpu_seconds,
        real_time_factor: times.log_seconds / times.wall_seconds.max(1e-9),
        peak_memory_bytes: peak_memory_bytes(),
        stages: stage_summaries(&session.series.times),
        path_length: path_length(&session.estimate),
        calibration: odometry.calibration().map(Into::into),
        evaluation: evaluated.as_ref().map(|evaluated| evaluated.summary.clone()),
        evaluation_failure,
    };
    Ok(Replayed {
        metrics,
        series: session.series,
        evaluated,
        first_seconds: 0.0,
        frame_span: None,
        reference,
        estimate: session.estimate,
        covariances: session.covariances,
    })
}

/// The notes and, in order of time, what the reader left out.
fn with_skipped(mut notes: Vec<LogEntry>, read: &ReadReport) -> Vec<LogEntry> {
    notes.extend(read.first_skipped.iter().map(|(reason, stamp)| LogEntry {
        fault: None,
        seconds: stamp.seconds(),
        level: NoteLevel::Warning,
        text: format!(
            "skipped from {stamp} s on: {reason} ({} in all)",
            read.skipped.get(reason).copied().unwrap_or_default()
        ),
    }));
    notes.sort_by(|a, b| a.seconds.total_cmp(&b.seconds));
    notes
}

fn given_truth(path: &Path) -> Result<std::vec::IntoIter<TruthPose>, ReplayError> {
    let trajectory = read_trajectory(path)?.trajectory;
    let poses: Vec<_> = trajectory
        .stamps()
        .iter()
        .zip(trajectory.poses())
        .filter_map(|(seconds, pose)| {
            Some(TruthPose { stamp: Stamp::from_seconds(*seconds)?, world_from_body: *pose })
        })
        .collect();
    Ok(poses.into_iter())
}

fn shifted(poses: &[TruthPose], seconds: f64) -> Vec<TruthPose> {
    poses.iter().map(|pose| TruthPose { stamp: pose.stamp.offset_by(seconds), ..*pose }).collect()
}

/// `None` if there are no poses.
fn trajectory(poses: &[TruthPose]) -> Option<Trajectory> {
    let stamps = poses.iter().map(|pose| pose.stamp.seconds()).collect();
    Trajectory::new(stamps, poses.iter().map(|pose| pose.world_from_body).collect()).ok()
}

fn path_length(poses: &[TruthPose]) -> f64 {
    let position = |pose: &TruthPose| pose.world_from_body.translation.vector;
    poses.windows(2).map(|pair| (position(&pair[1]) - position(&pair[0])).norm()).sum()
}

fn write_metrics(directory: &Path, metrics: &Metrics) -> Result<(), ReplayError> {
    let path = directory.join("metrics.json");
    let text = serde_json::to_string_pretty(metrics).map_err(std::io::Error::other);
    text.and_then(|text| output::write(&path, text + "\n"))
        .map_err(|source| ReplayError::Write { path, source })
}

/// First and last stamp seen.
#[derive(Debug, Clone, Copy, Default)]
struct Span(Option<(Stamp, Stamp)>);

impl Span {
    fn extend(&mut self, stamp: Stamp) {
        self.0 = Some(self.0.map_or((stamp, stamp), |(first, last)| (first, last.max(stamp))));
    }

    fn seconds(self) -> f64 {
        self.0.map_or(0.0, |(first, last)| last.seconds_since(first))
    }
}

/// Where in the body of the reference the camera is, if the estimate is of the camera: without an
/// IMU.
fn camera_in_reference(config: &Config, has_imu: bool) -> Isometry3<f64> {
    let mounting = config.camera.imu_from_camera().filter(|_| !has_imu);
    mounting.unwrap_or_else(Isometry3::identity)
}

/// The log's events; the reference poses among them are noted, or replaced by given ones.
struct EventSource<'a> {
    log: &'a mut dyn Log,
    given: Option<Peekable<std::vec::IntoIter<TruthPose>>>,
    /// The log's next event, while given poses go before it.
    pending: Option<Event>,
    /// From the frame whose poses are estimated to that of the reference.
    body_from_camera: Isometry3<f64>,
    truth: &'a mut Vec<TruthPose>,
    faults: &'a [Fault],
    /// Stamp of the first event.
    first: &'a mut Option<Stamp>,
    /// Start and end of the replayed part, s after the first event.
    part: [f64; 2],
    /// Of the frames in that part.
    frames: &'a mut Span,
}

impl EventSource<'_> {
    fn next_of_log(&mut self) -> Option<Event> {
        let replaced = self.given.is_some();
        std::iter::from_fn(|| self.log.next_event())
            .find(|event| !(replaced && matches!(event, Event::Truth(_))))
    }

    /// Reading may be ahead of what is replayed, so only the part itself counts.
    fn note_frame(&mut self, stamp: Stamp) {
        let seconds = self.first.map_or(0.0, |first| stamp.seconds_since(first));
        if (self.part[0]..=self.part[1]).contains(&seconds) {
            self.frames.extend(stamp);
        }
    }
}

impl Iterator for EventSource<'_> {
    type Item = Event;

    fn next(&mut self) -> Option<Event> {
        let event = match self.pending.take() {
            Some(event) => event,
            None => self.next_of_log()?,
        };
        if self.first.is_none() {
            *self.first = Some(event.stamp());
            let given = self.given.take();
            self.given = given.map(|poses| faulty(poses, self.faults, event.stamp()).peekable());
        }
        let due = |pose: &TruthPose| pose.stamp <= event.stamp();
        let given = self.given.as_mut().and_then(|poses| poses.next_if(due));
        let event = match given {
            Some(pose) => {
                self.pending = Some(event);
                Event::Truth(pose)
            }
            None => event,
        };
        let event = match event {
            Event::Truth(pose) => Event::Truth(TruthPose {
                world_from_body: pose.world_from_body * self.body_from_camera,
                ..pose
            }),
            other => other,
        };
        // A new run may go through stamps that an earlier one had.
        let is_new =
            |pose: &TruthPose| self.truth.last().is_none_or(|last| last.stamp < pose.stamp);
        match &event {
            Event::Truth(pose) if is_new(pose) => self.truth.push(*pose),
            Event::Frame(frame) => self.note_frame(frame.stamp),
            Event::Truth(_) | Event::Imu(_) | Event::Repeated(..) => {}
        }
        Some(event)
    }
}

/// Given poses further before the log than this say nothing of it, s.
const EARLIEST_REFERENCE: f64 = 1.0;

/// Given poses by the clocks of a log with faults, the first event of which is at `first`, but for
/// those long before it.
fn faulty(
    poses: impl Iterator<Item = TruthPose>,
    faults: &[Fault],
    first: Stamp,
) -> std::vec::IntoIter<TruthPose> {
    let by_clock = |pose: TruthPose| {
        let stamp = faults.iter().try_fold(pose.stamp, |stamp, fault| {
            let seconds = stamp.seconds_since(first);
            Some(stamp.offset_by(fault.clock(seconds)? - seconds))
        });
        Some(TruthPose { stamp: stamp?, ..pose })
    };
    let is_near = |pose: &TruthPose| first.seconds_since(pose.stamp) < EARLIEST_REFERENCE;
    poses.filter_map(by_clock).filter(is_near).collect::<Vec<_>>().into_iter()
}

/// What is gathered while the frames go by.
struct Session {
    outputs: Option<Outputs>,
    failure: Option<ReplayError>,
    series: Series,
    notes: Vec<LogEntry>,
    estimate: Vec<TruthPose>,
    /// Of (rotation, position), one a pose of `estimate`.
    covariances: Vec<Matrix6<f64>>,
    /// Moves the reference to where the estimate starts; fixed at the first frame that has both.
    estimate_from_reference: Option<Isometry3<f64>>,
    truth_max_gap: f64,
    /// Whether gravity makes the estimate's world z-up.
    levelled: bool,
}

/// Puts the reference's world on the estimate's by a pose of both: heading and position where both
/// are z-up, since the tilt of the estimate is then an error of its own, else the whole pose.
fn estimate_from_reference(
    estimate: &Isometry3<f64>,
    reference: &Isometry3<f64>,
    levelled: bool,
) -> Isometry3<f64> {
    let whole = estimate * reference.inverse();
    if !(levelled && is_vertical(&(whole.rotation * Vector3::z()))) {
        return whole;
    }
    let turn = Similarity { rotation: whole.rotation, ..Similarity::identity() };
    let heading = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn.yaw());
    let position = estimate.translation.vector - heading * reference.translation.vector;
    Isometry3::from_parts(position.into(), heading)
}

impl Session {
    fn start(request: &Request, has_imu: bool) -> Result<Self, ReplayError> {
        Ok(Self {
            outputs: request.out.as_deref().map(Outputs::create).transpose()?,
            failure: None,
            series: Series::default(),
            notes: Vec::new(),
            estimate: Vec::new(),
            covariances: Vec::new(),
            estimate_from_reference: None,
            truth_max_gap: request.config.truth.max_gap,
            levelled: has_imu,
        })
    }

    fn step(
        &mut self,
        report: &StepReport,
        frame: &RgbdFrame,
        odometry: &Odometry,
        observers: &mut [&mut dyn Observer],
    ) {
        for note in &report.notes {
            match note.level {
                NoteLevel::Info => tracing::info!("{}", note.text),
                NoteLevel::Warning => tracing::warn!("{}", note.text),
            }
            let (seconds, text) = (report.stamp.seconds(), note.text.clone());
            let (level, fault) = (note.level, note.fault);
            self.notes.push(LogEntry { seconds, level, fault, text });
        }
        if self.estimate.last().is_some_and(|last| report.stamp <= last.stamp) {
            // A new run, at stamps that an earlier one had.
            return;
        }
        self.series.push(report);
        let estimate = report.state.world_from_body;
        self.estimate.push(TruthPose { stamp: report.stamp, world_from_body: estimate });
        self.covariances.push(pose_covariance(&report.covariance));
        if let (Some(outputs), None) = (&mut self.outputs, &self.failure) {
            self.failure = outputs.step(report).err();
        }
        let reference = odometry.truth().at(report.stamp, self.truth_max_gap);
        if let (Some(reference), None) = (reference, self.estimate_from_reference) {
            self.estimate_from_reference =
                Some(estimate_from_reference(&estimate, &reference, self.levelled));
        }
        let moved = self.estimate_from_reference.zip(reference).map(|(by, pose)| by * pose);
        for observer in observers {
            observer.frame(report, frame, moved.as_ref());
        }
    }

    fn finish_outputs(&mut self, odometry: &Odometry) -> Result<(), ReplayError> {
        if let Some(failure) = self.failure.take() {
            return Err(failure);
        }
        match self.outputs.take() {
            Some(outputs) => outputs.finish(&odometry.map(), &odometry.faults()),
            None => Ok(()),
        }
    }
}
