//! `metrics.json`: what a run read, did, cost and achieved.

use std::collections::BTreeMap;

use serde::Serialize;

use super::Evaluation;
use crate::dataset::ReadReport;
use crate::fault::Fault;
use crate::filter::Calibration;
use crate::odometry::{HealthSummary, NoteLevel, OdometryStats, StageTimes};

#[derive(Debug, Clone, Serialize)]
pub struct Metrics {
    pub log: String,
    pub log_kind: String,
    pub config: String,
    pub filter: String,
    pub init: String,
    pub seed: u64,
    pub threads: usize,
    pub sources: BTreeMap<String, String>,
    pub has_imu: bool,
    pub read: ReadReport,
    #[serde(flatten)]
    pub odometry: OdometryStats,
    pub interrupted: bool,
    /// Length of the replayed part by its stamps, s.
    pub log_seconds: f64,
    pub wall_seconds: f64,
    pub cpu_seconds: f64,
    /// `log_seconds / wall_seconds`.
    pub real_time_factor: f64,
    /// Largest resident set of the process, bytes; `null` where the system does not tell.
    pub peak_memory_bytes: Option<u64>,
    /// Wall time of each stage of a frame.
    pub stages: BTreeMap<&'static str, StageSummary>,
    /// Length of the estimated path, m.
    pub path_length: f64,
    /// The camera's calibration at the end, where it was estimated.
    pub calibration: Option<CalibrationSummary>,
    /// With a reference: how far the run is from it.
    pub evaluation: Option<Evaluation>,
    /// Why there is a reference but no evaluation.
    pub evaluation_failure: Option<String>,
    /// What happened, in order of time.
    pub notes: Vec<LogEntry>,
}

/// Something that happened.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LogEntry {
    /// Stamp of the frame, or of the message that was left out, s.
    pub seconds: f64,
    pub level: NoteLevel,
    /// The fault that it tells of, if it does.
    pub fault: Option<Fault>,
    pub text: String,
}

/// Calibration between camera and IMU with standard deviations.
#[derive(Debug, Clone, Serialize)]
pub struct CalibrationSummary {
    /// Rows, as `camera.imu_from_camera`.
    pub imu_from_camera: [[f64; 4]; 4],
    /// As `camera.time_offset`, s.
    pub time_offset: f64,
    /// About the axes of the IMU, degrees.
    pub rotation_sd_deg: [f64; 3],
    /// m.
    pub translation_sd: [f64; 3],
    /// s.
    pub time_offset_sd: f64,
}

impl From<&Calibration> for CalibrationSummary {
    fn from(calibration: &Calibration) -> Self {
        let [a, b, c, translation_sd @ .., time_offset_sd] = calibration.standard_deviations();
        Self {
            imu_from_camera: calibration.body_from_camera.to_homogeneous().transpose().into(),
            time_offset: calibration.time_offset,
            rotation_sd_deg: [a, b, c].map(f64::to_degrees),
            translation_sd,
            time_offset_sd,
        }
    }
}

impl Metrics {
    /// The figures that matter most, named and formatted.
    pub fn summary(&self) -> Vec<(&'static str, String)> {
        let mut rows = vec![
            ("log", format!("{} ({})", self.log, self.log_kind)),
            ("configuration, filter", format!("{}, {}", self.config, self.filter)),
            ("initialisation", self.odometry.initialization.clone().unwrap_or_default()),
            (
                "frames",
                format!(
                    "{} processed, {} before initialisation, {} without update",
                    self.odometry.frames_processed,
                    self.odometry.frames_before_initialization,
                    self.odometry.frames_without_update
                ),
            ),
            ("IMU samples, gaps", format!("{}, {}", self.read.imu_samples, self.odometry.imu_gaps)),
            ("messages skipped", format!("{}", self.read.skipped.values().sum::<u64>())),
            ("health", self.health()),
            (
                "time",
                format!(
                    "{:.2} s for {:.2} s of log: {:.2} x real time",
                    self.wall_seconds, self.log_seconds, self.real_time_factor
                ),
            ),
        ];
        if let Some(total) = self.stages.get("total") {
            let text = format!("median {:.1} ms, p99 {:.1} ms", total.median_ms, total.p99_ms);
            rows.push(("time a frame", text));
        }
        if let Some(bytes) = self.peak_memory_bytes {
            rows.push(("peak memory", format!("{:.0} MB", bytes as f64 / 1e6)));
        }
        if let Some(calibration) = &self.calibration {
            let (offset, sd) = (calibration.time_offset, calibration.time_offset_sd);
            let text = format!("time offset {:.2} ms, sd {:.2} ms", 1e3 * offset, 1e3 * sd);
            rows.push(("calibration of the camera", text));
        }
        rows.push(("path length", format!("{:.3} m", self.path_length)));
        if let Some(evaluation) = &self.evaluation {
            let matched = format!("{} of {}", evaluation.matched, evaluation.estimate_poses);
            rows.push(("matched with reference", matched));
            let position = evaluation.ape_translation.rmse;
            rows.push(("APE RMSE, SE(3) aligned", format!("{position:.4} m")));
            let attitude = evaluation.ape_rotation_deg.rmse;
            rows.push(("attitude error RMSE", format!("{attitude:.3} deg")));
            if let Some(rpe) = &evaluation.rpe {
                let (position, attitude) = (rpe.translation.rmse, rpe.rotation_deg.rmse);
                let text = format!("{position:.4} m, {attitude:.3} deg");
                rows.push(("RPE RMSE over 1 s", text));
            }
            if let Some(nees) = &evaluation.nees {
                for (name, part) in
                    [("NEES, attitude", &nees.attitude), ("NEES, position", &nees.position)]
                {
                    rows.push((name, part.to_string()));
                }
            }
        }
        if let Some(reason) = &self.evaluation_failure {
            rows.push(("no evaluation", reason.clone()));
        }
        rows
    }
}

impl Metrics {
    fn health(&self) -> String {
        let HealthSummary {
            seconds_without_vision,
            longest_without_vision,
            seconds_at_rest,
            divergences,
            reinitializations,
        } = &self.odometry.health;
        let warnings = self.notes.iter().filter(|note| note.level == NoteLevel::Warning).count();
        let mut text = format!(
            "{seconds_without_vision:.2} s without vision (longest {longest_without_vision:.2} s), \
             {seconds_at_rest:.2} s at rest, {warnings} warnings"
        );
        if !divergences.is_empty() {
            let (last, count) = (divergences.last().map_or("", String::as_str), divergences.len());
            text += &format!(
                ", diverged {count} times, re-initialised {reinitializations} times; last: {last}"
            );
        }
        text
    }
}

/// Milliseconds a frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct StageSummary {
    pub median_ms: f64,
    pub p95_ms: f64,
    pub p99_ms: f64,
    pub max_ms: f64,
}

/// Of each stage and of their sum, over the `frames`.
pub fn stage_summaries(frames: &[StageTimes]) -> BTreeMap<&'static str, StageSummary> {
    let names = StageTimes::default().stages().map(|(name, _)| name);
    let of_stage = |k: usize| frames.iter().map(|times| times.stages()[k].1).collect();
    let total = |times: &StageTimes| times.stages().iter().map(|(_, seconds)| seconds).sum();
    let stages = names.into_iter().enumerate().map(|(k, name)| (name, of_stage(k)));
    let total = ("total", frames.iter().map(total).collect());
    stages.chain([total]).map(|(name, seconds)| (name, StageSummary::of(seconds))).collect()
}

impl StageSummary {
    fn of(mut seconds: Vec<f64>) -> Self {
        seconds.sort_unstable_by(f64::total_cmp);
        // Nearest rank.
        let quantile = |q: f64| {
            let rank = (q * seconds.len() as f64).ceil().max(1.0) as usize - 1;
            1e3 * seconds.get(rank).copied().unwrap_or(0.0)
        };
        Self {
            median_ms: quantile(0.5),
            p95_ms: quantile(0.95),
            p99_ms: quantile(0.99),
            max_ms: quantile(1.0),
        }
    }
}

/// Largest resident set of this process, bytes (Linux).
pub fn peak_memory_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    let kibibytes: u64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(kibibytes * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_of_nearest_rank() {
        let frame = |k| StageTimes { update: f64::from(k) * 1e-3, ..StageTimes::default() };
        let summaries = stage_summaries(&(1..=100).map(frame).collect::<Vec<_>>());
        let update = summaries["update"];
        let rounded = |x: f64| (x * 1e3).round() / 1e3;
        assert_eq!(rounded(update.median_ms), 50.0);
        assert_eq!(rounded(update.p95_ms), 95.0);
        assert_eq!(rounded(update.max_ms), 100.0);
        assert_eq!(rounded(summaries["total"].p99_ms), 99.0);
    }
}
