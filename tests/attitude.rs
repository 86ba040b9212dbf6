//! `attitude`: files, JSON, errors, and the estimates themselves on a small synthetic log.

mod support;

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

use nalgebra::{Matrix3, Quaternion, Rotation3, UnitQuaternion, Vector3};
use support::{json, lines, mfg_vio, recording, text};

const RATE: f64 = 100.0;
const SECONDS: f64 = 30.0;
const FILTERS: [&str; 12] = [
    "mfgia", "mfgiu", "mfgba", "mfgbu", "fnf-r", "fnf-l", "bf-mfd", "bf-amfd", "uae", "mekf",
    "iekf", "ukf",
];
/// Of the gyroscope, rad/s.
const BIAS: Vector3<f64> = Vector3::new(0.004, -0.006, 0.003);

/// Five seconds of rest, then a hand that turns and shakes the sensor.
fn attitude(t: f64) -> Rotation3<f64> {
    let t = (t - 5.0).max(0.0);
    Rotation3::from_euler_angles(
        2.5 + (1.3 * t).sin(),
        0.9 * (0.8 * t).sin(),
        2.0 * (0.5 * t).sin(),
    )
}

fn force(t: f64) -> Vector3<f64> {
    let t = (t - 5.0).max(0.0);
    Vector3::new(2.0 * (6.0 * t).sin(), 1.5 * (5.0 * t).sin(), 9.81 + (7.0 * t).sin())
}

/// A log in which iron is attached to the body half way.
fn synthetic(directory: &Path) -> PathBuf {
    let path = directory.join("imu.csv");
    let h = RATE.recip();
    let mut log = "t,gx,gy,gz,ax,ay,az,mx,my,mz\n".to_owned();
    for k in 1..(SECONDS * RATE) as usize {
        let t = k as f64 * h;
        let (before, now) = (attitude(t - h), attitude(t));
        let rate: Vector3<f64> = (before.inverse() * now).scaled_axis() / h + BIAS;
        let force: Vector3<f64> = now.inverse() * force(t);
        let iron = if t < 15.0 { 0.0 } else { 5e-5 };
        let earth = Vector3::new(0.0, 1.6e-5, -4.2e-5);
        let field: Vector3<f64> = now.inverse() * earth + Vector3::x() * iron;
        write!(log, "{t:.9}").unwrap();
        for value in rate.iter().chain(force.iter()).chain(field.iter()) {
            write!(log, ",{value:.9e}").unwrap();
        }
        log.push('\n');
    }
    std::fs::write(&path, log).unwrap();
    path
}

/// Standard deviations about the principal axes that a row of `attitude.csv` reports, degrees.
fn reported_sd(row: &[f64]) -> Vector3<f64> {
    let &[xx, xy, xz, yy, yz, zz] = &row[11..17] else { panic!("{row:?}") };
    let covariance = Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz);
    covariance.symmetric_eigenvalues().map(|variance| variance.max(0.0).sqrt().to_degrees())
}

/// Of each line of `attitude.csv` the time, the total error and the largest standard deviation that
/// is reported, degrees.
fn errors(directory: &Path) -> Vec<(f64, f64, f64)> {
    let table = lines(&directory.join("attitude.csv"));
    let header = "time,qx,qy,qz,qw,gyro_bias_x,gyro_bias_y,gyro_bias_z,s1,s2,s3,";
    assert!(table[0].starts_with(header), "{}", table[0]);
    let error = |line: &String| {
        let row: Vec<f64> = line.split(',').map(|field| field.parse().unwrap()).collect();
        let estimate = Quaternion::new(row[4], row[1], row[2], row[3]);
        let truth = UnitQuaternion::from_rotation_matrix(&attitude(row[0]));
        let error = truth.angle_to(&UnitQuaternion::from_quaternion(estimate));
        assert!(row[8] >= row[9] && row[9] >= row[10].abs());
        (row[0], error.to_degrees(), reported_sd(&row).max())
    };
    table[1..].iter().map(error).collect()
}

#[test]
fn every_filter_finds_the_attitude_from_nothing_and_keeps_it_when_iron_comes() {
    let folder = tempfile::tempdir().unwrap();
    let log = synthetic(folder.path());
    for name in FILTERS {
        let out = folder.path().join(name);
        let summary =
            json(&["attitude", text(&log), "--filter", name, "--out", text(&out), "--json"]);
        assert_eq!(summary["filter"], name);
        assert_eq!(summary["samples"], 2999);
        assert_eq!(summary["failed_steps"], 0, "{name}");
        assert!(summary["rest_seconds"].as_f64().unwrap() > 3.0, "{name}");
        let disturbed = summary["disturbed_seconds"].as_f64().unwrap();
        assert!((0.5..10.0).contains(&disturbed), "{name}: {disturbed}");
        let errors = errors(&out);
        assert!(errors.len() > 2980);
        let worst = errors.iter().map(|(_, error, _)| *error).fold(0.0, f64::max);
        // Iron that comes is learnt from a field that is believed to vary by 3 % (once 2 %), and
        // the approximate moments of `bf-amfd` add to that: 3.03 degrees.
        assert!(worst < 4.0, "{name}: {worst} degrees");
        let bias = summary["last"]["gyro_bias"].as_array().unwrap();
        for (found, expected) in bias.iter().zip(BIAS.iter()) {
            let error = found.as_f64().unwrap() - expected;
            assert!(error.abs() < 2e-3, "{name}: {error}");
        }
    }
}

#[test]
fn without_a_magnetometer_the_tilt_is_found_and_a_gap_is_survived() {
    let folder = tempfile::tempdir().unwrap();
    let log = synthetic(folder.path());
    let kept = lines(&log).into_iter().enumerate().filter(|(k, _)| !(800..1000).contains(k));
    let inertial: Vec<String> =
        kept.map(|(_, line)| line.split(',').take(7).collect::<Vec<_>>().join(",")).collect();
    std::fs::write(&log, inertial.join("\n")).unwrap();
    let out = text(folder.path());
    let summary = json(&["attitude", text(&log), "--filter", "fnf-r", "--out", out, "--json"]);
    assert_eq!((&summary["gaps"], &summary["magnetic_samples"]), (&1.into(), &0.into()));
    let table = lines(&folder.path().join("attitude.csv"));
    for line in &table[1..] {
        let row: Vec<f64> = line.split(',').map(|field| field.parse().unwrap()).collect();
        let estimate =
            UnitQuaternion::from_quaternion(Quaternion::new(row[4], row[1], row[2], row[3]));
        let up = estimate * (attitude(row[0]).inverse() * Vector3::z());
        let tilt = up.angle(&Vector3::z()).to_degrees();
        // At the end of the gap there is only what may have been missed, until 0.1 s of readings
        // show the tilt anew: wrong as it is, it must be said to be.
        if (9.995..10.095).contains(&row[0]) {
            let sd = reported_sd(&row).min();
            assert!(tilt < 2.0 * sd, "{tilt} degrees at {} s, reported {sd}", row[0]);
            continue;
        }
        // Just after the gap the force of the motion is all there is to go by: 2.5 of 8.8 m/s^2.
        let allowed = if (10.0..13.0).contains(&row[0]) { 16.0 } else { 3.0 };
        assert!(tilt < allowed, "{tilt} degrees at {} s", row[0]);
    }
}

/// Short gaps, a gyroscope that is clipped, a bias of a telephone: one setting for all.
#[test]
#[ignore = "fails: recording is not made good"]
fn what_sensors_leave_out_is_made_good() {
    let folder = tempfile::tempdir().unwrap();
    let log = synthetic(folder.path());
    let complete = lines(&log);
    let changed = |change: &dyn Fn(usize, f64) -> f64| -> Vec<String> {
        let values = |line: &String| {
            let fields = line.split(',').map(|field| field.parse::<f64>().unwrap());
            let changed = fields.enumerate().map(|(k, value)| change(k, value).to_string());
            changed.collect::<Vec<_>>().join(",")
        };
        complete.iter().take(1).cloned().chain(complete[1..].iter().map(values)).collect()
    };
    let gaps = complete.iter().enumerate().filter(|(k, _)| k % 400 < 340 || *k < 600);
    let gaps: Vec<String> = gaps.map(|(_, line)| line.clone()).collect();
    let clipped = changed(&|k, x| if (1..4).contains(&k) { x.clamp(-1.2, 1.2) } else { x });
    let biased = changed(&|k, x| if k == 2 { x + 0.12 } else { x });
    for (name, content, allowed) in
        [("gaps", gaps, 10.0), ("clipped", clipped, 8.0), ("biased", biased, 3.0)]
    {
        std::fs::write(&log, content.join("\n")).unwrap();
        let summary = json(&["attitude", text(&log), "--out", text(folder.path()), "--json"]);
        assert_eq!(summary["failed_steps"], 0, "{name}");
        let is_clipped = summary["clipped_samples"].as_u64().unwrap() > 50;
        assert_eq!(is_clipped, name == "clipped", "{}", summary["clipped_samples"]);
        assert_eq!(summary["gaps"].as_u64().unwrap() > 4, name == "gaps", "{}", summary["gaps"]);
        if is_clipped {
            assert!((summary["gyro_limit"].as_f64().unwrap() - 1.2).abs() < 1e-6);
        }
        let errors = errors(folder.path());
        if name == "gaps" {
            // After 0.6 s in which a hand like this may have turned by 28 degrees about each axis
            // the attitude is sought anew, first from the force of the motion, which is up to 16
            // degrees off and turns north by 2.6 times as much, as the field is steep: 40 degrees.
            // That is reported.
            for &(t, error, sd) in &errors {
                assert!(
                    error < f64::max(allowed, 3.0 * sd),
                    "{name}: {error} of {sd} degrees at {t} s"
                );
            }
            let good = errors.iter().filter(|(_, error, _)| *error < allowed).count();
            assert!(2 * good > errors.len(), "{good} of {}", errors.len());
            continue;
        }
        let worst = errors.iter().map(|(_, error, _)| *error).fold(0.0, f64::max);
        assert!(worst < allowed, "{name}: {worst} degrees");
    }
}

#[test]
fn settings_are_reached_and_shared_with_replay() {
    let folder = tempfile::tempdir().unwrap();
    let log = synthetic(folder.path());
    let config = folder.path().join("set-up.toml");
    std::fs::write(&config, "[imu]\ngyroscope_scale = 2.0\n[camera]\nfx = 400.0\n").unwrap();
    let bias = |arguments: &[&str]| {
        let summary = json(&[&["attitude", text(&log), "--json"], arguments].concat());
        summary["last"]["gyro_bias"][1].as_f64().unwrap()
    };
    let plain = bias(&[]);
    assert!(
        (bias(&["--config", text(&config), "--set", "imu.gyroscope_scale=1"]) - plain).abs() < 5e-3
    );
    assert!((bias(&["--config", text(&config)]) - plain).abs() > 5e-3);
    for (arguments, expected) in [
        (["--set", "imu.gyro_bias=1"], "did you mean `imu.gyro_bias_sd`"),
        (["--set", "rest.reading_sd=small"], "rest.reading_sd"),
        (["--config", "nowhere.toml"], "nowhere.toml"),
    ] {
        let output = mfg_vio(&[&["attitude", text(&log)], &arguments[..]].concat());
        let errors = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{errors}");
        assert!(errors.contains(expected), "{errors}");
    }
}

#[test]
fn logs_with_an_imu_are_read() {
    let log = support::simulated_log();
    let summary = json(&["attitude", text(log), "--filter", "mfgba", "--json"]);
    assert!(summary["samples"].as_u64().unwrap() > 250);
    assert!(summary["last"]["s"][2].as_f64().is_some());
}

#[test]
fn bad_input_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("imu.csv");
    for (content, expected) in [
        ("t,gx,gy,gz\n", "no column `ax`"),
        ("t,gx,gy,gz,ax,ay,az\n0,1,2,3,4,5,x\n", "line 2: `x` is no number"),
        ("t,gx,gy,gz,ax,ay,az\n", "no attitude: 0 samples"),
        ("0,0,0,0,0,0,nan\n0,0,0,0,0,0,9.8\n0,0,0,0,0,0,9.8\n", "2 of them refused"),
    ] {
        std::fs::write(&path, content).unwrap();
        let output = mfg_vio(&["attitude", text(&path), "--filter", "mekf"]);
        let errors = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{errors}");
        assert!(errors.contains(expected) && errors.contains("imu.csv"), "{errors}");
    }
    let wrong = mfg_vio(&["attitude", text(&path), "--filter", "best"]);
    assert_eq!(wrong.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&wrong.stderr).contains("mfgba"));
}

/// The comparison on real data takes a minute and a Python environment; here one trial is
/// converted and run, where the data and h5py are there.
#[test]
fn a_real_trial_is_followed_as_well_as_by_vqf() {
    let Some(trial) = recording("broad/32_disturbed_attached_magnet_1cm.hdf5") else { return };
    let folder = tempfile::tempdir().unwrap();
    let tool = Path::new(env!("CARGO_MANIFEST_DIR")).join("tools/broad/trial.py");
    let python = std::env::var_os("MFG_VIO_PYTHON").unwrap_or_else(|| "python3".into());
    let converted = Command::new(&python).args([&tool, &trial]).arg(folder.path()).output();
    if !converted.is_ok_and(|output| output.status.success()) {
        eprintln!("SKIPPED: {python:?} lacks h5py (set MFG_VIO_PYTHON)");
        return;
    }
    let log = folder.path().join("imu.csv");
    let out = text(folder.path());
    json(&["attitude", text(&log), "--filter", "fnf-r", "--out", out, "--json"]);
    let error = movement_error(folder.path());
    // vqf 2.1.2 with its defaults: 6.44 degrees.
    assert!(error < 6.44, "{error}");
}

/// RMS of the total error over the movement phase without the mean heading error, degrees.
fn movement_error(directory: &Path) -> f64 {
    let rows = |name: &str| {
        let parse = |line: &String| -> Vec<Option<f64>> {
            line.split(',').map(|field| field.parse().ok()).collect()
        };
        lines(&directory.join(name))[1..].iter().map(parse).collect::<Vec<_>>()
    };
    let quaternion = |row: &[Option<f64>]| {
        Some(UnitQuaternion::from_quaternion(Quaternion::new(row[4]?, row[1]?, row[2]?, row[3]?)))
    };
    let reference = rows("reference.csv");
    let mut errors = Vec::new();
    for row in rows("attitude.csv") {
        let k = reference.partition_point(|r| r[0].unwrap() < row[0].unwrap() - 1e-6);
        let Some(truth) = quaternion(&reference[k]).filter(|_| reference[k][5] == Some(1.0)) else {
            continue;
        };
        errors.push(quaternion(&row).unwrap() * truth.inverse());
    }
    assert!(errors.len() > 10_000);
    let heading = |e: &UnitQuaternion<f64>| 2.0 * e.k.atan2(e.w);
    let sum =
        errors.iter().map(|e| heading(e).sin_cos()).fold((0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1));
    let offset = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), -sum.0.atan2(sum.1));
    let squares: f64 = errors.iter().map(|e| (offset * e).angle().to_degrees().powi(2)).sum();
    (squares / errors.len() as f64).sqrt()
}
