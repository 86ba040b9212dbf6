//! `metrics.json`: what a run read, did, cost and achieved.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::dataset::ReadReport;
use crate::evaluation::{ApeResult, Statistics};
use crate::odometry::{OdometryStats, StageTimes};

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
    /// With a reference: trajectory error after SE(3) alignment.
    pub evaluation: Option<Evaluation>,
    /// Why there is a reference but no evaluation.
    pub evaluation_failure: Option<String>,
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
        rows.push(("path length", format!("{:.3} m", self.path_length)));
        if let Some(evaluation) = &self.evaluation {
            let matched = format!("{} of {}", evaluation.matched, evaluation.estimate_poses);
            rows.push(("matched with reference", matched));
            let position = evaluation.ape_translation.rmse;
            rows.push(("APE RMSE, SE(3) aligned", format!("{position:.4} m")));
            let attitude = evaluation.ape_rotation_deg.rmse;
            rows.push(("attitude error RMSE", format!("{attitude:.3} deg")));
        }
        if let Some(reason) = &self.evaluation_failure {
            rows.push(("no evaluation", reason.clone()));
        }
        rows
    }
}

#[derive(Debug, Clone, Serialize)]
pub struct Evaluation {
    pub matched: usize,
    pub reference_poses: usize,
    pub estimate_poses: usize,
    /// Absolute position error, m.
    pub ape_translation: Statistics,
    /// Absolute attitude error, degrees.
    pub ape_rotation_deg: Statistics,
}

impl Evaluation {
    pub fn new(translation: &ApeResult, rotation: &ApeResult) -> Self {
        Self {
            matched: translation.pairs.len(),
            reference_poses: translation.pairs.reference_poses,
            estimate_poses: translation.pairs.estimate_poses,
            ape_translation: translation.statistics,
            ape_rotation_deg: rotation.statistics,
        }
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

/// Times of every frame, by stage.
#[derive(Debug, Clone, Default)]
pub struct StageLog {
    seconds: BTreeMap<&'static str, Vec<f32>>,
}

impl StageLog {
    pub fn push(&mut self, times: &StageTimes) {
        let total = times.stages().iter().map(|(_, seconds)| seconds).sum();
        for (stage, seconds) in times.stages().into_iter().chain([("total", total)]) {
            self.seconds.entry(stage).or_default().push(seconds as f32);
        }
    }

    pub fn summary(&self) -> BTreeMap<&'static str, StageSummary> {
        let summarize = |values: &Vec<f32>| {
            let mut sorted = values.clone();
            sorted.sort_by(f32::total_cmp);
            // Nearest rank.
            let quantile = |q: f64| {
                let rank = (q * sorted.len() as f64).ceil().max(1.0) as usize - 1;
                1e3 * f64::from(sorted.get(rank).copied().unwrap_or(0.0))
            };
            StageSummary {
                median_ms: quantile(0.5),
                p95_ms: quantile(0.95),
                p99_ms: quantile(0.99),
                max_ms: quantile(1.0),
            }
        };
        self.seconds.iter().map(|(stage, values)| (*stage, summarize(values))).collect()
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
        let mut log = StageLog::default();
        for k in 1..=100 {
            log.push(&StageTimes { update: f64::from(k) * 1e-3, ..StageTimes::default() });
        }
        let update = log.summary()["update"];
        let rounded = |x: f64| (x * 1e3).round() / 1e3;
        assert_eq!(rounded(update.median_ms), 50.0);
        assert_eq!(rounded(update.p95_ms), 95.0);
        assert_eq!(rounded(update.max_ms), 100.0);
        assert_eq!(rounded(log.summary()["total"].p99_ms), 99.0);
    }
}
