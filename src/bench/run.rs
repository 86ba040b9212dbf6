//! Makes the runs of a plan that are not there yet.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use cpu_time::ProcessTime;
use nalgebra::{Isometry3, Matrix3, Matrix6, Vector3};

use super::dataset::Source;
use super::error::BenchError;
use super::judge::{Estimated, Judging, judge};
use super::key::{RunKey, input_digest, program_fingerprint};
use super::plan::{Plan, PlannedRun};
use super::recipe::{SeededScene, remove};
use super::record::{Outcome, RunRecord, Store, Times};
use super::tables;
use crate::config::Resolved;
use crate::dataset::Fault;
use crate::evaluation::Trajectory;
use crate::filter::FilterKind;
use crate::inertial::{block, pose_covariance};
use crate::odometry::{NoteLevel, StepReport};
use crate::replay::{LogEntry, Observer, Replayed, Request, replay};
use crate::sensor::RgbdFrame;

/// Sees what goes on.
pub trait Progress {
    /// A run, or the rendering of its log, begins: what it is, and how many frames it has.
    fn begin(&mut self, label: &str, done: usize, planned: usize, frames: Option<u64>);

    fn frame(&mut self);
}

/// Where things lie, and how much of the machine a run may use.
#[derive(Debug, Clone)]
pub struct Workshop<'a> {
    pub store: &'a Store,
    /// Folder of rendered logs.
    pub cache: &'a Path,
    /// Keep rendered logs after the last run that needs them.
    pub keep_logs: bool,
    /// Threads of a run; the figures do not depend on it.
    pub threads: usize,
    pub stop: &'a AtomicBool,
}

/// A run with its key and, where its log is rendered, its scene.
struct Job {
    index: usize,
    key: RunKey,
    scene: Option<SeededScene>,
}

/// Makes what is not there yet, one run after the other, and returns all in the order of the plan.
/// A run that fails has its reason for a figure.
///
/// # Errors
/// [`BenchError::Interrupted`] if stopped, with what is finished kept; otherwise only for what
/// makes every run impossible, such as a folder that cannot be written to.
pub fn execute(
    plan: &Plan,
    workshop: &Workshop,
    progress: &mut dyn Progress,
) -> Result<Vec<(PlannedRun, RunRecord)>, BenchError> {
    let program = program_fingerprint()?;
    let mut records: Vec<Option<RunRecord>> = Vec::new();
    let mut jobs = Vec::new();
    let mut inputs = BTreeMap::new();
    for (index, run) in plan.runs.iter().enumerate() {
        let job = job(plan, index, run, &program, &mut inputs)?;
        let record = workshop.store.get(&job.key)?;
        if record.is_none() {
            jobs.push(job);
        }
        records.push(record);
    }
    group_by_log(&mut jobs, &plan.runs);
    let planned = plan.runs.len();
    while !jobs.is_empty() {
        let job = jobs.remove(0);
        let done = planned - jobs.len() - 1;
        let record = make(&plan.runs[job.index], &job, plan, workshop, (done, planned), progress)?;
        let Some(record) = record else {
            return Err(BenchError::Interrupted { finished: done, planned });
        };
        records[job.index] = Some(workshop.store.put(&record)?);
        if let (Some(scene), false) = (&job.scene, workshop.keep_logs) {
            let mut others = jobs.iter().filter_map(|other| other.scene.as_ref());
            if !others.any(|other| other.digest() == scene.digest()) {
                remove(&scene.log(workshop.cache));
            }
        }
    }
    Ok(plan.runs.iter().cloned().zip(records.into_iter().flatten()).collect())
}

fn job(
    plan: &Plan,
    index: usize,
    run: &PlannedRun,
    program: &str,
    inputs: &mut BTreeMap<String, String>,
) -> Result<Job, BenchError> {
    let (scene, faults) = match &run.sequence.source {
        Source::Recipe { recipe, trajectory } => {
            let duration = run.duration.unwrap_or(0.0);
            let name = &run.sequence.name;
            let scene = recipe.scene(name, run.seed, duration, trajectory.as_deref(), program)?;
            (Some(scene), recipe.faults.iter().map(|fault| (*fault).to_owned()).collect())
        }
        _ => (None, Vec::new()),
    };
    let input = match (&scene, inputs.get(&run.sequence.name)) {
        (Some(scene), _) => scene.digest().to_owned(),
        (None, Some(known)) => known.clone(),
        (None, None) => {
            let input = input_digest(&run.sequence)?;
            inputs.insert(run.sequence.name.clone(), input.clone());
            input
        }
    };
    let key = RunKey {
        program: program.to_owned(),
        dataset: plan.dataset.name().to_owned(),
        sequence: run.sequence.name.clone(),
        input,
        filter: run.filter.clone(),
        seed: run.seed,
        init: run.init.map(|mode| mode.name().to_owned()),
        config: plan.config.as_ref().map(|(_, text)| text.clone()),
        settings: run.settings.clone(),
        faults,
        duration: run.duration,
    };
    Ok(Job { index, key, scene })
}

/// Jobs that share a rendered log one after the other, in the order of the first of each, so that
/// few logs are there at a time.
fn group_by_log(jobs: &mut [Job], runs: &[PlannedRun]) {
    let mut first = BTreeMap::new();
    for job in jobs.iter() {
        let log = job.scene.as_ref().map(|scene| scene.digest().to_owned());
        let name = log.unwrap_or_else(|| runs[job.index].sequence.name.clone());
        first.entry(name).or_insert(job.index);
    }
    jobs.sort_by_key(|job| {
        let log = job.scene.as_ref().map(|scene| scene.digest().to_owned());
        let name = log.unwrap_or_else(|| runs[job.index].sequence.name.clone());
        (first.get(&name).copied(), job.index)
    });
}

/// `None` if it was stopped.
fn make(
    run: &PlannedRun,
    job: &Job,
    plan: &Plan,
    workshop: &Workshop,
    (done, planned): (usize, usize),
    progress: &mut dyn Progress,
) -> Result<Option<RunRecord>, BenchError> {
    let (clock, cpu_clock) = (Instant::now(), ProcessTime::now());
    let label = run.label();
    let made = match &run.sequence.source {
        Source::Log { log, truth } => {
            let part = Part { run, plan, log, truth: truth.as_deref(), faults: &job.key.faults };
            part.replay(workshop, progress, (done, planned))
        }
        Source::Recipe { .. } => {
            let Some(scene) = &job.scene else { return Ok(None) };
            let frames = run.duration.map(|s| (s * scene.frame_rate()) as u64);
            progress.begin(&format!("rendering for {label}"), done, planned, frames);
            let rendered = scene.render(workshop.cache, workshop.stop, &mut || progress.frame())?;
            let std::ops::ControlFlow::Continue(log) = rendered else { return Ok(None) };
            let part = Part { run, plan, log: &log, truth: None, faults: &job.key.faults };
            part.replay(workshop, progress, (done, planned))
        }
        Source::Attitude { imu, reference } => {
            progress.begin(&label, done, planned, None);
            let work = work_folder(&job.key)?;
            let outcome = tables::attitude(imu, reference, &run.filter, &work, workshop.stop);
            remove(&work);
            outcome.map(|outcome| (outcome, None))
        }
        Source::Navigation { imu, gps } => {
            progress.begin(&label, done, planned, None);
            let outcome = tables::navigation(imu, gps, &run.filter, &run.settings, workshop.stop);
            outcome.map(|outcome| (outcome, None))
        }
    };
    if workshop.stop.load(Ordering::Relaxed) {
        return Ok(None);
    }
    let (outcome, of_replay) = made.unwrap_or_else(|error| {
        let failure = Some(error.to_string());
        (Outcome { failure, ..Outcome::default() }, None)
    });
    let of_all = || cpu_clock.elapsed().as_secs_f64();
    let cpu_seconds = of_replay.unwrap_or_else(of_all);
    let times = Times {
        cpu_ms_per_frame: (outcome.frames > 0).then(|| 1e3 * cpu_seconds / outcome.frames as f64),
        wall_seconds: clock.elapsed().as_secs_f64(),
    };
    Ok(Some(RunRecord { key: job.key.clone(), outcome, times }))
}

/// For files that a run leaves behind and the bench does not keep.
fn work_folder(key: &RunKey) -> Result<PathBuf, BenchError> {
    let name = format!("mfg-vio-bench-{}-{}", std::process::id(), key.digest()?);
    Ok(std::env::temp_dir().join(name))
}

/// A replay of a log as part of a bench.
struct Part<'a> {
    run: &'a PlannedRun,
    plan: &'a Plan,
    log: &'a Path,
    truth: Option<&'a Path>,
    faults: &'a [String],
}

impl Part<'_> {
    /// The figures and the processor time of the replay, s.
    fn replay(
        &self,
        workshop: &Workshop,
        progress: &mut dyn Progress,
        (done, planned): (usize, usize),
    ) -> Result<(Outcome, Option<f64>), BenchError> {
        let resolved = self.resolve()?;
        let config_origin = resolved.name();
        let Resolved { config, summary, .. } = resolved;
        let filter = self.run.filter.parse::<FilterKind>();
        let filter =
            filter.map_err(|reason| BenchError::Format { path: self.log.to_owned(), reason })?;
        let mut front_end = config.front_end(filter).map_err(|error| BenchError::Format {
            path: self.log.to_owned(),
            reason: error.to_string(),
        })?;
        let faults = self.faults.iter().filter_map(|fault| fault.parse().ok()).collect();
        progress.begin(&self.run.label(), done, planned, summary.frames);
        let request = Request {
            log: self.log.to_owned(),
            config,
            config_origin,
            filter,
            seed: self.run.seed,
            threads: workshop.threads,
            start: 0.0,
            duration: self.run.duration.unwrap_or(f64::INFINITY),
            out: None,
            truth: self.truth.map(Path::to_owned),
            faults,
            stop: workshop.stop,
        };
        let mut gathered = Gathered::new(progress);
        let replayed = replay(&request, &mut front_end, &mut [&mut gathered])?;
        let outcome = self.outcome(&replayed, gathered, &request.faults);
        Ok((outcome, Some(replayed.metrics.cpu_seconds)))
    }

    fn resolve(&self) -> Result<Resolved, BenchError> {
        let file = self.plan.config.as_ref().map(|(path, _)| path.as_path());
        let mut resolved = Resolved::of(self.log, file, &self.run.settings)?;
        resolved.require_calibration()?;
        if let Some(mode) = self.run.init {
            resolved.config.init.mode = mode;
        }
        Ok(resolved)
    }

    fn outcome(&self, replayed: &Replayed, gathered: Gathered, faults: &[Fault]) -> Outcome {
        let metrics = &replayed.metrics;
        let others =
            ["right", "depth"].into_iter().find(|role| metrics.sources.contains_key(*role));
        if let (true, Some(role)) = (self.run.sequence.one_camera, others) {
            let failure = format!("the {role} images were used: no run with one camera alone");
            return Outcome { failure: Some(failure), ..Outcome::default() };
        }
        let mut outcome = Outcome {
            initialization: metrics.odometry.initialization.clone(),
            frames: metrics.odometry.frames_processed,
            ..self.alarms(&metrics.notes, replayed.first_seconds, faults)
        };
        let judging = Judging {
            clock: self.run.sequence.clock,
            levelled: metrics.has_imu,
            exact: matches!(self.run.sequence.source, Source::Recipe { .. }),
            span: replayed.frame_span,
        };
        let estimated = gathered.estimated();
        let judged = match (replayed.reference(), estimated) {
            (Some(truth), Ok(estimated)) => judge(truth, &estimated, &judging),
            (None, _) => {
                outcome.failure = Some("no truth: neither in the log nor beside it".to_owned());
                return outcome;
            }
            (_, Err(error)) => Err(error),
        };
        match judged {
            Ok(judged) => {
                outcome.matched = judged.matched;
                outcome.coverage = judged.coverage;
                outcome.ape_m = finite(judged.ape_m);
                outcome.attitude_deg = finite(judged.attitude_deg);
                outcome.rpe_1s_m = judged.rpe_1s_m.and_then(finite);
                outcome.nees = judged.nees;
                outcome.clock_offset = judged.clock_offset;
            }
            Err(error) => outcome.failure = Some(error.to_string()),
        }
        outcome
    }

    /// What was warned of, where nothing was wrong, and what was not.
    fn alarms(&self, notes: &[LogEntry], start: f64, faults: &[Fault]) -> Outcome {
        let lasting = |fault: &Fault| [fault.start - EARLY, fault.end() + SETTLING];
        let windows: Vec<[f64; 2]> =
            faults.iter().map(lasting).chain(self.run.sequence.disturbed.iter().copied()).collect();
        let warnings: Vec<(f64, &str)> = notes
            .iter()
            .filter(|note| note.level == NoteLevel::Warning && !note.text.starts_with(SKIPPED))
            .map(|note| (note.seconds - start, note.text.as_str()))
            .collect();
        let within = |t: f64, [from, to]: [f64; 2]| from <= t && t <= to;
        let is_false = |t: f64| !windows.iter().any(|window| within(t, *window));
        let missed = |fault: &&Fault| !warnings.iter().any(|(t, _)| within(*t, lasting(fault)));
        let mut named: Vec<String> = warnings.iter().map(|(_, text)| (*text).to_owned()).collect();
        named.sort();
        named.dedup();
        Outcome {
            false_alarms: warnings.iter().filter(|(t, _)| is_false(*t)).count() as u64,
            faults: named,
            faults_missed: faults.iter().filter(missed).map(Fault::to_string).collect(),
            ..Outcome::default()
        }
    }
}

/// A frame may carry a note of what happened just before a fault, s.
const EARLY: f64 = 0.05;
/// A fault may be told, and what it did to the estimate, until so long after its end, s.
const SETTLING: f64 = 2.0;
/// How notes of messages that a reader left out begin.
const SKIPPED: &str = "skipped from";

fn finite(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

/// Poses and beliefs of the frames that go by.
struct Gathered<'a> {
    progress: &'a mut dyn Progress,
    stamps: Vec<f64>,
    poses: Vec<Isometry3<f64>>,
    covariances: Vec<Matrix6<f64>>,
    velocities: Vec<(Vector3<f64>, Matrix3<f64>)>,
}

impl Observer for Gathered<'_> {
    fn frame(&mut self, report: &StepReport, _: &RgbdFrame, _: Option<&Isometry3<f64>>) {
        self.progress.frame();
        let velocity = block::VELOCITY;
        let covariance = report.covariance.fixed_view::<3, 3>(velocity, velocity).into_owned();
        self.stamps.push(report.stamp.seconds());
        self.poses.push(report.state.world_from_body);
        self.covariances.push(pose_covariance(&report.covariance));
        self.velocities.push((report.state.velocity, covariance));
    }
}

impl<'a> Gathered<'a> {
    fn new(progress: &'a mut dyn Progress) -> Self {
        Self {
            progress,
            stamps: Vec::new(),
            poses: Vec::new(),
            covariances: Vec::new(),
            velocities: Vec::new(),
        }
    }

    fn estimated(self) -> Result<Estimated, crate::evaluation::EvaluationError> {
        Ok(Estimated {
            trajectory: Trajectory::new(self.stamps, self.poses)?,
            covariances: self.covariances,
            velocities: self.velocities,
        })
    }
}
