//! Noise of the IMU of a log: the library behind `imu-noise`.

use super::ReplayError;
use super::attitude::InertialInput;
use crate::config::Resolved;
use crate::dataset;
use crate::filter::attitude::AdaptiveConfig;
use crate::inertial::identification::{ImuNoise, InertialSensor};
use crate::sensor::ImuSample;

/// Settings of the section `[imu]` that were measured, each with what it is from.
#[derive(Debug, Clone, PartialEq)]
pub struct NoiseSettings(Vec<(String, f64, String)>);

/// Measures the noise of a log's IMU in its longest rest between `start` and `start + duration`
/// (seconds from its first sample).
///
/// # Errors
/// If the log cannot be read or has too little rest.
pub fn noise_of_log(
    input: &InertialInput,
    start: f64,
    duration: f64,
) -> Result<ImuNoise, ReplayError> {
    let (mut samples, config) = samples_of(input)?;
    let first = samples.first().map(|sample| sample.stamp);
    samples.retain(|sample| {
        let since = first.map_or(0.0, |first| sample.stamp.seconds_since(first));
        since >= start && since <= start + duration
    });
    ImuNoise::identify(&samples, &config.imu)
        .map_err(|source| ReplayError::Noise { log: input.log.to_owned(), source })
}

/// The samples of a log's IMU, SI units.
///
/// # Errors
/// If the log cannot be read or has no IMU.
pub fn inertial_samples(input: &InertialInput) -> Result<Vec<ImuSample>, ReplayError> {
    Ok(samples_of(input)?.0)
}

fn samples_of(input: &InertialInput) -> Result<(Vec<ImuSample>, AdaptiveConfig), ReplayError> {
    let (rows, config) = input.open()?;
    let samples: Result<Vec<_>, _> = rows.map(|row| row.map(|row| row.imu)).collect();
    Ok((samples?, config))
}

impl NoiseSettings {
    /// White noise as an integration sees it; walks only where the rest was long enough to show one.
    pub fn of(noise: &ImuNoise) -> Self {
        let sensors = [
            (InertialSensor::Gyroscope, "imu.gyro_noise", "imu.gyro_bias_walk"),
            (InertialSensor::Accelerometer, "imu.accel_noise", "imu.accel_bias_walk"),
        ];
        let rest = format!("measured over {:.0} s at rest", noise.rest.seconds());
        let mut settings = Vec::new();
        for (sensor, white, walk) in sensors {
            settings.push((white.to_owned(), noise.white_noise(sensor), rest.clone()));
            if let Some(value) = noise.bias_walk(sensor) {
                settings.push((walk.to_owned(), value, rest.clone()));
            }
        }
        Self(settings)
    }

    /// Key (`section.key`) and value.
    pub fn values(&self) -> impl Iterator<Item = (&str, f64)> {
        self.0.iter().map(|(key, value, _)| (key.as_str(), *value))
    }

    /// The section `[imu]`.
    pub fn section(&self) -> String {
        let line = |(path, value, why): &(String, f64, String)| {
            let key = path.trim_start_matches("imu.");
            format!("# {why}\n{key} = {value:.3e}\n")
        };
        format!("[imu]\n{}", self.0.iter().map(line).collect::<String>())
    }

    /// The configuration of the log with these settings, or the section alone for a table of inertial
    /// data.
    ///
    /// # Errors
    /// If the configuration cannot be read.
    pub fn configuration(&self, input: &InertialInput) -> Result<String, ReplayError> {
        if dataset::detect(input.log).is_err() {
            return Ok(format!("# {}\n{}", input.log.display(), self.section()));
        }
        let resolved = Resolved::of(input.log, input.config, input.overrides)?;
        let found = self
            .0
            .iter()
            .map(|(key, value, why)| (key.clone(), format!("{value:.3e}"), why.clone()));
        Ok(resolved.to_toml(&found.collect::<Vec<_>>())?)
    }
}
