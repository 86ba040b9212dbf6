//! Runs over tables: attitude from IMU and magnetometer, IMU with GNSS positions.

use std::ops::ControlFlow;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use super::error::BenchError;
use super::figures::NeesMeans;
use super::record::Outcome;
use crate::evaluation::NeesSummary;
use crate::filter::attitude::AttitudeFilterKind;
use crate::filter::gnss::{GnssConfig, GnssFilterKind, OutageConfig, navigate};
use crate::replay::{
    AttitudeRequest, NavigationInput, NavigationLogs, NavigationSource, replay_attitude,
};

/// Attitude RMSE of a trial of BROAD over its movement phase, after taking out the mean heading
/// error: filters differ in what they call north. The files of the run go to `work`.
pub(super) fn attitude(
    imu: &Path,
    reference: &Path,
    filter: &str,
    work: &Path,
    stop: &AtomicBool,
) -> Result<Outcome, BenchError> {
    let filter: AttitudeFilterKind = filter
        .parse()
        .map_err(|reason: String| BenchError::Format { path: imu.to_owned(), reason })?;
    let request = AttitudeRequest {
        log: imu.to_owned(),
        filter,
        config: None,
        overrides: Vec::new(),
        topic: None,
        out: Some(work.to_owned()),
        stop,
    };
    let metrics = replay_attitude(&request, || {})?;
    let estimate = attitudes(&work.join("attitude.csv"), &["time"])?;
    let truth = attitudes(reference, &["time", "movement"])?;
    let moving: Vec<_> = truth.iter().filter(|row| row.movement).collect();
    let mut pairs = Vec::new();
    for row in &moving {
        let k = estimate.partition_point(|other| other.time < row.time - SAME_SAMPLE);
        let estimate = estimate.get(k).filter(|e| e.time <= row.time + SAME_SAMPLE);
        if let (Some(e), Some(r)) = (estimate.and_then(|e| e.attitude), row.attitude) {
            pairs.push((e, r));
        }
    }
    let known = moving.iter().filter(|row| row.attitude.is_some()).count();
    Ok(Outcome {
        frames: metrics.samples,
        matched: pairs.len(),
        coverage: pairs.len() as f64 / known.max(1) as f64,
        attitude_deg: attitude_rmse(&pairs),
        failure: pairs.is_empty().then(|| "no estimate in the movement phase".to_owned()),
        ..Outcome::default()
    })
}

/// Stamps of the same sample differ by their rounding only, s.
const SAME_SAMPLE: f64 = 1e-4;

/// Degrees; `None` where there are no pairs.
fn attitude_rmse(pairs: &[(UnitQuaternion<f64>, UnitQuaternion<f64>)]) -> Option<f64> {
    let errors: Vec<_> = pairs.iter().map(|(e, r)| e * r.inverse()).collect();
    let heading = |q: &UnitQuaternion<f64>| 2.0 * q.k.atan2(q.w);
    let (sin, cos) = errors.iter().fold((0.0, 0.0), |(sin, cos), error| {
        let (s, c) = heading(error).sin_cos();
        (sin + s, cos + c)
    });
    let offset = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), -sin.atan2(cos));
    let squares: f64 = errors.iter().map(|error| (offset * error).angle().powi(2)).sum();
    (!errors.is_empty()).then(|| (squares / errors.len() as f64).sqrt().to_degrees())
}

struct AttitudeRow {
    time: f64,
    /// `None` where the markers were lost.
    attitude: Option<UnitQuaternion<f64>>,
    movement: bool,
}

/// The columns `time`, `qx` to `qw` and, where there is one, `movement` of a CSV file.
fn attitudes(path: &Path, needed: &[&str]) -> Result<Vec<AttitudeRow>, BenchError> {
    let format = |reason: String| BenchError::Format { path: path.to_owned(), reason };
    let text = std::fs::read_to_string(path)
        .map_err(|source| BenchError::Io { path: path.to_owned(), source })?;
    let mut lines = text.lines().zip(1..);
    let header: Vec<&str> =
        lines.next().map(|(line, _)| line.split(',').map(str::trim).collect()).unwrap_or_default();
    let column = |name: &str| header.iter().position(|column| *column == name);
    for name in needed.iter().chain(&["qx", "qy", "qz", "qw"]) {
        column(name).ok_or_else(|| format(format!("has no column {name}")))?;
    }
    let mut rows = Vec::new();
    for (line, number) in lines.filter(|(line, _)| !line.trim().is_empty()) {
        let fields: Vec<&str> = line.split(',').map(str::trim).collect();
        let value = |name: &str| -> Option<f64> {
            fields.get(column(name)?)?.parse().ok().filter(|x: &f64| x.is_finite())
        };
        let time = value("time").ok_or_else(|| format(format!("line {number}: no time")))?;
        let attitude = match (value("qw"), value("qx"), value("qy"), value("qz")) {
            (Some(w), Some(x), Some(y), Some(z)) => {
                UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 0.5)
            }
            _ => None,
        };
        rows.push(AttitudeRow { time, attitude, movement: value("movement") == Some(1.0) });
    }
    Ok(rows)
}

/// Positions are withheld for 30 s, from 60 s after the first on, again every 100 s.
const OUTAGE: OutageConfig = OutageConfig { start: 60.0, length: 30.0, period: 100.0 };
const CONFIDENCE: f64 = 0.95;

/// Error at withheld GNSS positions, and the consistency of the innovations at the others.
pub(super) fn navigation(
    imu: &Path,
    gps: &Path,
    filter: &str,
    settings: &[String],
    stop: &AtomicBool,
) -> Result<Outcome, BenchError> {
    let kind = GnssFilterKind::ALL.into_iter().find(|kind| kind.name() == filter);
    let kind = kind.ok_or_else(|| BenchError::Format {
        path: imu.to_owned(),
        reason: format!("no filter {filter}"),
    })?;
    let config = GnssConfig { outage: OUTAGE, ..GnssConfig::shipped("kitti", settings)? };
    let source = NavigationSource::Tables { imu: imu.to_owned(), gnss: gps.to_owned() };
    let input = NavigationLogs::read(source, &config).and_then(|logs| logs.prepare(&config));
    let NavigationInput { imu: samples, fixes, .. } = input
        .map_err(|error| BenchError::Format { path: imu.to_owned(), reason: error.to_string() })?;
    let summary =
        navigate(kind, &config, &samples, &fixes, |_| match stop.load(Ordering::Relaxed) {
            true => ControlFlow::Break(()),
            false => ControlFlow::Continue(()),
        });
    let summary = match summary {
        Ok(summary) => summary,
        Err(error) => {
            return Ok(Outcome { failure: Some(error.to_string()), ..Outcome::default() });
        }
    };
    let withheld: usize = summary.outages.iter().map(|outage| outage.fixes).sum();
    let squares: f64 = summary.outages.iter().map(|o| o.rms.powi(2) * o.fixes as f64).sum();
    let rms = (squares / withheld.max(1) as f64).sqrt();
    let nis: Vec<f64> = summary.nis.iter().map(|(_, nis)| *nis).collect();
    let consistency = NeesSummary::of(&nis, 3, CONFIDENCE);
    let (first, last) = (fixes.first(), fixes.last());
    let share = first.zip(last).map(|(first, last)| {
        last.stamp.seconds_since(summary.start)
            / last.stamp.seconds_since(first.stamp).max(f64::MIN_POSITIVE)
    });
    Ok(Outcome {
        frames: (summary.used + summary.rejected + withheld) as u64,
        matched: withheld,
        coverage: share.unwrap_or(0.0).clamp(0.0, 1.0),
        ape_m: (withheld > 0 && rms.is_finite()).then_some(rms),
        nees: consistency.map(|summary| NeesMeans {
            position: Some(summary.mean),
            inside_95: Some(summary.inside),
            ..NeesMeans::default()
        }),
        ..Outcome::default()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;

    #[test]
    fn a_common_heading_is_no_error() {
        let attitude = |t: f64| UnitQuaternion::from_euler_angles(0.3 * t.sin(), 0.2, t);
        let north = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 1.1);
        let tilt = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), 0.02);
        let pairs = |error: UnitQuaternion<f64>| -> Vec<_> {
            (0..50).map(|k| attitude(0.1 * f64::from(k))).map(|q| (error * q, q)).collect()
        };
        assert_relative_eq!(attitude_rmse(&pairs(north)).unwrap(), 0.0, epsilon = 1e-6);
        let expected = 0.02_f64.to_degrees();
        assert_relative_eq!(attitude_rmse(&pairs(north * tilt)).unwrap(), expected, epsilon = 1e-3);
        assert_eq!(attitude_rmse(&[]), None);
    }

    #[test]
    fn lost_markers_are_no_reference() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("reference.csv");
        std::fs::write(&path, "time,qx,qy,qz,qw,movement\n0.0,0,0,0,1,1\n0.1,,,,,1\n").unwrap();
        let rows = attitudes(&path, &["time", "movement"]).unwrap();
        assert!(rows[0].attitude.is_some() && rows[1].attitude.is_none() && rows[1].movement);
        let error = attitudes(&path, &["stamp"]).err().unwrap().to_string();
        assert!(error.contains("no column stamp"), "{error}");
    }
}
