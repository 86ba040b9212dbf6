//! Attitude along a log of inertial and magnetic data: the library behind `attitude`.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use serde::Serialize;

use super::ReplayError;
use super::outputs::OutputFile;
use crate::config::Config;
use crate::dataset::{self, ImuCsv, ImuRow, Log, LogConfig, LogError};
use crate::distribution::matrix_fisher::MatrixFisher;
use crate::filter::Estimate;
use crate::filter::attitude::{AdaptiveAttitude, AdaptiveConfig, AttitudeFilterKind, AttitudeStep};
use crate::sensor::{Event, Stamp};

/// What is asked for.
pub struct AttitudeRequest<'a> {
    pub log: PathBuf,
    pub filter: AttitudeFilterKind,
    pub config: AdaptiveConfig,
    /// Directory for `attitude.csv`.
    pub out: Option<PathBuf>,
    pub stop: &'a AtomicBool,
}

/// Counts, times and the last belief of a run.
#[derive(Debug, Clone, Default, Serialize)]
pub struct AttitudeMetrics {
    pub log: String,
    pub filter: String,
    pub samples: u64,
    /// Samples with a reading of the magnetometer.
    pub magnetic_samples: u64,
    /// Samples left out: not finite, or not later than the one before.
    pub refused: u64,
    /// Gaps after which the attitude was sought anew.
    pub gaps: u64,
    /// Steps that the filter could not take, after which its belief was what it had been.
    pub failed_steps: u64,
    /// Lines of `attitude.csv`.
    pub estimates: u64,
    pub log_seconds: f64,
    pub rest_seconds: f64,
    /// Time in which the magnetic field was not trusted.
    pub disturbed_seconds: f64,
    pub wall_seconds: f64,
    /// Mean time of the estimator for one sample.
    pub step_time_ns: f64,
    pub interrupted: bool,
    /// The belief at the end.
    pub last: Option<Reached>,
}

/// A belief in plain numbers.
#[derive(Debug, Clone, Serialize)]
pub struct Reached {
    /// Stamp of the sample, s.
    pub time: f64,
    /// `world_from_body` as x, y, z, w.
    pub quaternion: [f64; 4],
    /// Standard deviation of the body-frame rotation vector, degrees.
    pub rotation_sd_deg: [f64; 3],
    /// rad/s.
    pub gyro_bias: [f64; 3],
    /// Proper singular values of the matrix Fisher parameter.
    pub s: [f64; 3],
}

impl Reached {
    /// A Gaussian belief is given the matrix Fisher parameter with its information (FNF 31).
    fn new(stamp: Stamp, estimate: &Estimate) -> Option<Self> {
        let s = estimate.matrix_fisher_s.or_else(|| {
            let information = estimate.rotation_covariance.try_inverse()?;
            let mode = estimate.world_from_body;
            let fisher = MatrixFisher::from_mode_and_information(mode, information).ok()?;
            Some(fisher.svd().s)
        })?;
        let variance = estimate.rotation_covariance.diagonal();
        let quaternion = nalgebra::UnitQuaternion::from_rotation_matrix(&estimate.world_from_body);
        Some(Self {
            time: stamp.seconds(),
            quaternion: quaternion.coords.into(),
            rotation_sd_deg: variance.map(|v| v.sqrt().to_degrees()).into(),
            gyro_bias: estimate.gyro_bias?.mean.into(),
            s: s.into(),
        })
    }

    fn line(&self, stamp: Stamp) -> String {
        let [q, b, s] = [&self.quaternion[..], &self.gyro_bias, &self.s];
        let fixed = q.iter().map(|x| format!("{x:.9}"));
        let floating = b.iter().chain(s).map(|x| format!("{x:.9e}"));
        let fields: Vec<String> = fixed.chain(floating).collect();
        format!("{stamp},{}", fields.join(","))
    }
}

const COLUMNS: &str = "time,qx,qy,qz,qw,gyro_bias_x,gyro_bias_y,gyro_bias_z,s1,s2,s3";

/// Runs a filter over a log. `attitude.csv` is valid whenever this returns, also when it was
/// stopped.
///
/// # Errors
/// If the log cannot be read or nothing in it shows an attitude, or a file cannot be written.
pub fn replay_attitude(
    request: &AttitudeRequest,
    mut progress: impl FnMut(),
) -> Result<AttitudeMetrics, ReplayError> {
    let rows = rows(&request.log)?;
    let mut output = request.out.as_deref().map(create).transpose()?;
    let mut metrics = AttitudeMetrics {
        log: request.log.display().to_string(),
        filter: request.filter.to_string(),
        ..AttitudeMetrics::default()
    };
    let mut estimator = AdaptiveAttitude::new(request.filter, &request.config);
    let (clock, mut stepping) = (Instant::now(), Duration::ZERO);
    let mut span: Option<(Stamp, Stamp)> = None;
    let mut reached = None;
    for row in rows {
        if request.stop.load(Ordering::Relaxed) {
            metrics.interrupted = true;
            break;
        }
        let row = match row {
            Ok(row) => row,
            Err(error) => {
                finish(output)?;
                return Err(error.into());
            }
        };
        let stamp = row.imu.stamp;
        let before = Instant::now();
        let step = estimator.step(&row.imu, row.magnetic_field.as_ref());
        stepping += before.elapsed();
        metrics.count(&row, &step, request.config.directions.interval);
        progress();
        if matches!(step, Ok(AttitudeStep::Refused)) {
            continue;
        }
        span = Some((span.map_or(stamp, |(first, _)| first), stamp));
        let Some(now) = estimator.estimate().and_then(|e| Reached::new(stamp, &e)) else {
            continue;
        };
        if let Some(file) = &mut output {
            file.line(&now.line(stamp))?;
        }
        metrics.estimates += 1;
        reached = Some(now);
    }
    finish(output)?;
    metrics.log_seconds = span.map_or(0.0, |(first, last)| last.seconds_since(first));
    metrics.wall_seconds = clock.elapsed().as_secs_f64();
    metrics.step_time_ns = stepping.as_secs_f64() * 1e9 / metrics.samples.max(1) as f64;
    metrics.last = reached;
    if metrics.estimates == 0 && !metrics.interrupted {
        return Err(ReplayError::NoAttitude {
            log: request.log.clone(),
            reason: format!(
                "{} samples over {:.3} s, {} of them refused (not finite, or not later than the \
                 one before), {} steps failed; accelerometer readings in m/s^2 over {} s without a \
                 gap are needed",
                metrics.samples,
                metrics.log_seconds,
                metrics.refused,
                metrics.failed_steps,
                request.config.directions.interval
            ),
        });
    }
    Ok(metrics)
}

impl AttitudeMetrics {
    fn count(
        &mut self,
        row: &ImuRow,
        step: &Result<AttitudeStep, crate::filter::FilterError>,
        interval: f64,
    ) {
        self.samples += 1;
        self.magnetic_samples += u64::from(row.magnetic_field.is_some());
        match step {
            Ok(AttitudeStep::Refused) => self.refused += 1,
            Ok(AttitudeStep::Started) => self.gaps += u64::from(self.samples > 1),
            Ok(AttitudeStep::Propagated) => {}
            Ok(AttitudeStep::Updated(directions)) => {
                self.rest_seconds +=
                    interval * f64::from(u8::from(directions.resting_rate.is_some()));
                self.disturbed_seconds += interval * f64::from(u8::from(directions.disturbed));
            }
            Err(error) => {
                self.failed_steps += 1;
                if self.failed_steps == 1 {
                    let stamp = row.imu.stamp;
                    tracing::warn!("{stamp}: {error}; further failed steps are only counted");
                }
            }
        }
    }
}

fn create(directory: &Path) -> Result<OutputFile, ReplayError> {
    std::fs::create_dir_all(directory)
        .map_err(|source| ReplayError::Write { path: directory.to_owned(), source })?;
    let mut file = OutputFile::create(directory.join("attitude.csv"))?;
    file.line(COLUMNS)?;
    Ok(file)
}

fn finish(output: Option<OutputFile>) -> Result<(), ReplayError> {
    output.map_or(Ok(()), OutputFile::finish)
}

type Rows = Box<dyn Iterator<Item = Result<ImuRow, LogError>>>;

/// The samples of a log of images and IMU, or else of a CSV file.
fn rows(path: &Path) -> Result<Rows, ReplayError> {
    let summary = match dataset::detect(path) {
        Ok(summary) => summary,
        Err(LogError::UnknownFormat { .. }) if path.is_file() => {
            return Ok(Box::new(ImuCsv::open(path)?));
        }
        Err(error) => return Err(error.into()),
    };
    let name = &summary.config_name;
    let config = Config::shipped(name, &[]).map_err(|error| ReplayError::NoAttitude {
        log: path.to_owned(),
        reason: error.to_string(),
    })?;
    let none = || "none".to_owned();
    let imu_only =
        LogConfig { color_topic: none(), depth_topic: none(), truth_topic: none(), ..config.log };
    if !summary.has_imu {
        let available = summary.sources.values().cloned().collect::<Vec<_>>().join(", ");
        let role = "IMU";
        return Err(LogError::MissingStream { path: path.to_owned(), role, available }.into());
    }
    tracing::info!("{}: IMU in the units of the shipped configuration `{name}`", summary.kind);
    Ok(Box::new(ImuOfLog(dataset::open(path, &imu_only, &config.imu)?)))
}

struct ImuOfLog(Box<dyn Log>);

impl Iterator for ImuOfLog {
    type Item = Result<ImuRow, LogError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            if let Event::Imu(imu) = self.0.next_event()? {
                return Some(Ok(ImuRow { imu, magnetic_field: None }));
            }
        }
    }
}
