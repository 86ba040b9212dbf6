//! The estimator started on the beginning of a log, to say whether a replay will do.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use super::{ReplayError, Replayed, Request, replay};
use crate::config::{Config, ConfigError, Resolved};
use crate::dataset::{Assumed, Inspection, TURN_SPAN, Trial};
use crate::filter::FilterKind;
use crate::sensor::TruthPose;

/// Length of the part of the log that the estimator is started on, s.
const TRIAL_SPAN: f64 = 5.0;
/// Before the liveliest part, so that its turns begin in a map that exists, s.
const RUN_UP: f64 = 1.0;

/// The log to try and how it is configured.
#[derive(Debug, Clone, Copy)]
pub struct Tried<'a> {
    pub log: &'a Path,
    /// Of the user.
    pub file: Option<&'a Path>,
    pub overrides: &'a [String],
}

/// Adds to an inspection what its images say of the IMU, and whether the estimator starts with the
/// settings that are then advised.
///
/// # Errors
/// Those of a configuration that the advised settings spoil.
pub fn try_out(
    inspection: Inspection,
    tried: Tried,
    resolved: &Resolved,
    assumed: &Assumed,
) -> Result<Inspection, ConfigError> {
    let mut inspection = inspection;
    let knows_camera = resolved.missing().iter().all(|key| key.ends_with("imu_from_camera"));
    let has_frames = inspection.pairs.frames > 0;
    if !(knows_camera && has_frames) {
        return Ok(inspection);
    }
    if inspection.summary.has_imu
        && let Some(track) = camera_track(&inspection, tried.log, &resolved.config)
    {
        inspection = inspection.with_camera_track(&track, assumed);
    }
    let advised = inspection.verdict.settings.clone();
    let overrides = [tried.overrides, advised.as_slice()].concat();
    let config = Resolved::of(tried.log, tried.file, &overrides)?.config;
    Ok(inspection.with_trial(start(tried.log, config, advised), assumed))
}

/// Poses of the camera by its images alone, over the part of the log with the most turns.
fn camera_track(inspection: &Inspection, log: &Path, config: &Config) -> Option<Vec<TruthPose>> {
    let imu = inspection.imu.as_ref()?;
    let roles = ["color", "depth", "imu"].into_iter();
    let first = roles.filter_map(|role| Some(inspection.topic(role)?.timing.as_ref()?.first));
    let first = first.fold(f64::INFINITY, f64::min);
    let mut config = config.clone();
    "none".clone_into(&mut config.log.imu_topic);
    "none".clone_into(&mut config.log.truth_topic);
    let start = (imu.liveliest - first - RUN_UP).max(0.0);
    let replayed = run(log, config, (start, TURN_SPAN + RUN_UP)).ok()?;
    Some(replayed.trajectory().to_vec())
}

fn start(log: &Path, config: Config, settings: Vec<String>) -> Trial {
    match run(log, config, (0.0, TRIAL_SPAN)) {
        Ok(replayed) => Trial {
            frames: replayed.metrics.read.frames,
            processed: replayed.metrics.odometry.frames_processed,
            reason: None,
            settings,
        },
        Err(error) => {
            let reason = match error {
                ReplayError::NothingProcessed { reason, .. } => reason,
                other => other.to_string(),
            };
            Trial { frames: 0, processed: 0, reason: Some(reason), settings }
        }
    }
}

fn run(log: &Path, config: Config, (start, duration): (f64, f64)) -> Result<Replayed, ReplayError> {
    let failed = |error: &dyn std::fmt::Display| ReplayError::FrontEnd(error.to_string());
    let kind = FilterKind::default();
    let mut front_end = config.front_end(kind).map_err(|error| failed(&error))?;
    let request = Request {
        log: log.to_owned(),
        config,
        config_origin: String::new(),
        filter: kind,
        seed: 1,
        // All on this thread, whose messages the caller may silence.
        threads: 1,
        start,
        duration,
        out: None,
        truth: None,
        faults: Vec::new(),
        stop: &AtomicBool::new(false),
    };
    replay(&request, &mut front_end, &mut [])
}
