//! Attitude along a log of inertial and magnetic data: the library behind `attitude`.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use serde::Serialize;

use super::ReplayError;
use super::outputs::OutputFile;
use crate::config::Config;
use crate::dataset::{
    self, ImuCsv, ImuRow, LogError, LogSummary, NavigationTopics, read_navigation,
};
use crate::distribution::matrix_fisher::MatrixFisher;
use crate::filter::attitude::{AdaptiveAttitude, AdaptiveConfig, AttitudeFilterKind, AttitudeStep};
use crate::filter::{Estimate, FilterError};
use crate::sensor::{ImuSample, MagneticSample, Stamp};

/// What is asked for.
pub struct AttitudeRequest<'a> {
    pub log: PathBuf,
    pub filter: AttitudeFilterKind,
    /// Configuration file [default: `configs/attitude.toml`, units by the log's layout].
    pub config: Option<PathBuf>,
    /// `section.key=value`.
    pub overrides: Vec<String>,
    /// Of the IMU; `None`: chosen by message type.
    pub topic: Option<String>,
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
    /// Gaps in the data, and the time in them, s.
    pub gaps: u64,
    pub gap_seconds: f64,
    /// Samples in which an axis of the gyroscope was at the end of its range, and that end, rad/s.
    pub clipped_samples: u64,
    pub gyro_limit: Option<f64>,
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
    /// Upper triangle of its covariance, row by row, rad^2.
    pub rotation_covariance: [f64; 6],
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
        let p = estimate.rotation_covariance;
        let variance = p.diagonal();
        let upper = [p[(0, 0)], p[(0, 1)], p[(0, 2)], p[(1, 1)], p[(1, 2)], p[(2, 2)]];
        let quaternion = nalgebra::UnitQuaternion::from_rotation_matrix(&estimate.world_from_body);
        Some(Self {
            time: stamp.seconds(),
            quaternion: quaternion.coords.into(),
            rotation_sd_deg: variance.map(|v| v.sqrt().to_degrees()).into(),
            rotation_covariance: upper,
            gyro_bias: estimate.gyro_bias?.mean.into(),
            s: s.into(),
        })
    }

    fn line(&self, stamp: Stamp) -> String {
        let [q, b, s] = [&self.quaternion[..], &self.gyro_bias, &self.s];
        let fixed = q.iter().map(|x| format!("{x:.9}"));
        let floating =
            b.iter().chain(s).chain(&self.rotation_covariance).map(|x| format!("{x:.9e}"));
        let fields: Vec<String> = fixed.chain(floating).collect();
        format!("{stamp},{}", fields.join(","))
    }
}

const COLUMNS: &str = "time,qx,qy,qz,qw,gyro_bias_x,gyro_bias_y,gyro_bias_z,s1,s2,s3,\
                       rotation_cov_xx,rotation_cov_xy,rotation_cov_xz,rotation_cov_yy,\
                       rotation_cov_yz,rotation_cov_zz";

/// Runs a filter over a log. `attitude.csv` is valid whenever this returns, also when it was
/// stopped.
///
/// # Errors
/// If the log cannot be read or nothing in it shows an attitude, or a file cannot be written.
pub fn replay_attitude(
    request: &AttitudeRequest,
    mut progress: impl FnMut(),
) -> Result<AttitudeMetrics, ReplayError> {
    let (rows, config) = request.inertial().open()?;
    let mut output = request.out.as_deref().map(create).transpose()?;
    let mut metrics = AttitudeMetrics {
        log: request.log.display().to_string(),
        filter: request.filter.to_string(),
        ..AttitudeMetrics::default()
    };
    let mut estimator = AdaptiveAttitude::new(request.filter, &config);
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
        metrics.count(&row, &step);
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
    metrics.clipped_samples = estimator.clipped_samples();
    metrics.gyro_limit = estimator.gyro_limit();
    metrics.log_seconds = span.map_or(0.0, |(first, last)| last.seconds_since(first));
    metrics.wall_seconds = clock.elapsed().as_secs_f64();
    metrics.step_time_ns = stepping.as_secs_f64() * 1e9 / metrics.samples.max(1) as f64;
    metrics.last = reached;
    if metrics.estimates == 0 && !metrics.interrupted {
        return Err(metrics.without_estimate(request));
    }
    Ok(metrics)
}

impl AttitudeMetrics {
    fn without_estimate(&self, request: &AttitudeRequest) -> ReplayError {
        let Self { samples, log_seconds, refused, failed_steps, .. } = self;
        ReplayError::NoAttitude {
            log: request.log.clone(),
            reason: format!(
                "{samples} samples over {log_seconds:.3} s, {refused} of them refused (not finite, \
                 or not later than the one before), {failed_steps} steps failed; accelerometer \
                 readings in m/s^2 over 0.1 s without a gap are needed"
            ),
        }
    }

    fn count(&mut self, row: &ImuRow, step: &Result<AttitudeStep, FilterError>) {
        self.samples += 1;
        self.magnetic_samples += u64::from(row.magnetic_field.is_some());
        match step {
            Ok(AttitudeStep::Refused) => self.refused += 1,
            Ok(AttitudeStep::Gap(seconds)) => {
                self.gaps += 1;
                self.gap_seconds += seconds;
            }
            Ok(AttitudeStep::Started | AttitudeStep::Propagated) => {}
            Ok(AttitudeStep::Updated(directions)) => {
                let if_so = |so: bool| if so { directions.seconds } else { 0.0 };
                self.rest_seconds += if_so(directions.resting_rate.is_some());
                self.disturbed_seconds += if_so(directions.disturbed);
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

pub(super) type Rows = Box<dyn Iterator<Item = Result<ImuRow, LogError>>>;

/// A log of which the inertial and magnetic data are wanted, and how they are read.
#[derive(Debug, Clone, Copy)]
pub struct InertialInput<'a> {
    pub log: &'a Path,
    /// Configuration file [default: `configs/attitude.toml`, units by the log's layout].
    pub config: Option<&'a Path>,
    /// `section.key=value`.
    pub overrides: &'a [String],
    /// Of the IMU; `None`: chosen by message type.
    pub topic: Option<&'a str>,
}

impl AttitudeRequest<'_> {
    fn inertial(&self) -> InertialInput<'_> {
        InertialInput {
            log: &self.log,
            config: self.config.as_deref(),
            overrides: &self.overrides,
            topic: self.topic.as_deref(),
        }
    }
}

impl InertialInput<'_> {
    /// The samples of a log with an IMU, or else of a CSV file, in SI units, and the settings.
    ///
    /// # Errors
    /// If the log or the configuration cannot be read, or the log has no IMU.
    pub(super) fn open(&self) -> Result<(Rows, AdaptiveConfig), ReplayError> {
        let path = self.log;
        let summary = match dataset::detect(path) {
            Ok(summary) => Some(summary),
            Err(LogError::UnknownFormat { .. }) if path.is_file() => None,
            Err(error) => return Err(error.into()),
        };
        let config = configuration(self, summary.as_ref())?;
        let Some(summary) = summary else {
            let imu = config.imu.clone();
            let rows = ImuCsv::open(path)?
                .map(move |row| row.map(|row| ImuRow { imu: imu.in_si_units(&row.imu), ..row }));
            return Ok((Box::new(rows), config));
        };
        let topics = NavigationTopics {
            imu: self.topic.unwrap_or_default().to_owned(),
            gnss: "none".to_owned(),
            magnetic: String::new(),
        };
        let log = read_navigation(path, &topics, &config.imu)?;
        if log.imu.is_empty() {
            let available = summary.sources.values().cloned().collect::<Vec<_>>().join(", ");
            let role = "IMU";
            return Err(LogError::MissingStream { path: path.to_owned(), role, available }.into());
        }
        for (role, source) in &log.sources {
            tracing::info!("{role}: {source}");
        }
        let rows = with_magnetic_field(&log.imu, &log.magnetic);
        Ok((Box::new(rows.into_iter().map(Ok)), config))
    }
}

/// Gives every sample the last reading of the magnetometer since the sample before.
fn with_magnetic_field(imu: &[ImuSample], magnetic: &[MagneticSample]) -> Vec<ImuRow> {
    let mut readings = magnetic.iter().peekable();
    let row = |sample: &ImuSample| {
        let mut magnetic_field = None;
        while let Some(reading) = readings.next_if(|reading| reading.stamp <= sample.stamp) {
            magnetic_field = Some(reading.field);
        }
        ImuRow { imu: *sample, magnetic_field }
    };
    imu.iter().map(row).collect()
}

/// That of the file, or the shipped one in the units of the log's layout.
fn configuration(
    request: &InertialInput,
    summary: Option<&LogSummary>,
) -> Result<AdaptiveConfig, ReplayError> {
    if let Some(path) = request.config {
        return Ok(AdaptiveConfig::load(path, request.overrides)?);
    }
    let mut overrides = Vec::new();
    if let Some(summary) = summary {
        let name = &summary.config_name;
        let imu = Config::shipped(name, &[])?.imu;
        overrides.push(format!("imu.accelerometer_scale={}", imu.accelerometer_scale));
        overrides.push(format!("imu.gyroscope_scale={}", imu.gyroscope_scale));
        tracing::info!("{}: IMU in the units of the shipped configuration `{name}`", summary.kind);
    }
    overrides.extend(request.overrides.iter().cloned());
    Ok(AdaptiveConfig::shipped(&overrides)?)
}
