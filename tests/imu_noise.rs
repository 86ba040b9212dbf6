//! `imu-noise`: from a file of inertial data to coefficients, plot and configuration.

mod support;

use std::fmt::Write;
use std::path::{Path, PathBuf};

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use support::{fail, json, mfg_vio, recording, succeed, text};

/// Seconds at 200 Hz of an IMU that moves until `rest` and then lies still: white noise of
/// 1e-3 rad/s/sqrt(Hz) and 1e-2 m/s^2/sqrt(Hz), a vibration of 40 Hz on the accelerometer.
fn table(folder: &Path, rest: f64, seconds: f64) -> PathBuf {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    let mut normal = |sd: f64| -> f64 { sd * rng.sample::<f64, _>(StandardNormal) };
    let per_sample = 200_f64.sqrt();
    let mut lines = String::from("t,gx,gy,gz,ax,ay,az\n");
    for k in 0..(seconds * 200.0) as u32 {
        let t = f64::from(k) / 200.0;
        let moved = if t < rest { (3.0 * t).sin() } else { 0.0 };
        let wave = 0.3 * (std::f64::consts::TAU * 40.0 * t).sin();
        write!(lines, "{t:.4}").unwrap();
        for value in [0.01 + 0.5 * moved, -0.02, 0.005] {
            write!(lines, ",{:.9}", value + normal(1e-3 * per_sample)).unwrap();
        }
        for value in [0.2 + wave, moved, 9.8] {
            write!(lines, ",{:.9}", value + normal(1e-2 * per_sample)).unwrap();
        }
        lines.push('\n');
    }
    let path = folder.join("imu.csv");
    std::fs::write(&path, lines).unwrap();
    path
}

#[test]
fn noise_of_a_table_is_measured_drawn_and_written() {
    let folder = tempfile::tempdir().unwrap();
    let log = table(folder.path(), 20.0, 140.0);
    let (plot, config) = (folder.path().join("allan.svg"), folder.path().join("own.toml"));
    let options = ["--plot", text(&plot), "--write-config", text(&config)];
    let found = json(&[&["imu-noise", text(&log), "--json"][..], &options].concat());
    let rest = &found["rest"];
    assert!((20.0..22.5).contains(&rest["start"].as_f64().unwrap()), "{rest}");
    let axes = found["axes"].as_array().unwrap();
    assert_eq!(axes.len(), 6);
    for (axis, truth) in axes.iter().zip([1e-3, 1e-3, 1e-3, 1e-2, 1e-2, 1e-2]) {
        let white = &axis["white_noise"];
        let (value, sd) = (white["value"].as_f64().unwrap(), white["sd"].as_f64().unwrap());
        assert!((value - truth).abs() < 4.0 * sd && sd < 0.05 * truth, "{axis}");
        let walk = &axis["random_walk"];
        let (value, sd) = (walk["value"].as_f64().unwrap(), walk["sd"].as_f64().unwrap());
        assert!(value < 3.0 * sd, "a walk that is not there: {axis}");
    }
    let vibrations = axes[3]["vibrations"].as_array().unwrap();
    assert_eq!(vibrations.len(), 1, "{vibrations:?}");
    assert!((vibrations[0]["frequency"].as_f64().unwrap() - 40.0).abs() < 0.2);
    assert!((vibrations[0]["rms"].as_f64().unwrap() - 0.212).abs() < 0.02);
    assert!(
        axes.iter().enumerate().all(|(k, axis)| {
            k == 3 || axis["vibrations"].as_array().is_some_and(Vec::is_empty)
        })
    );
    let gyro = found["settings"]["imu.gyro_noise"].as_f64().unwrap();
    assert!((0.9e-3..1.5e-3).contains(&gyro), "{gyro}");
    assert!(std::fs::read_to_string(&plot).unwrap().starts_with("<svg"));

    // The file that it writes is one that the program reads.
    let told = succeed(&["imu-noise", text(&log), "--config", text(&config)]);
    assert!(told.contains("[imu]") && told.contains("vibration: accelerometer x"), "{told}");
}

#[test]
fn too_little_rest_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let log = table(folder.path(), 30.0, 36.0);
    let told = fail(&["imu-noise", text(&log)]);
    assert!(told.contains("imu.csv") && told.contains("never at rest for 10 s"), "{told}");
    assert_eq!(told.lines().count(), 1, "{told}");
    let told = fail(&["imu-noise", text(&log), "--start", "32"]);
    assert!(told.contains("too few"), "{told}");
    let wrong = mfg_vio(&["imu-noise", text(&log), "--start", "-1"]);
    assert_eq!(wrong.status.code(), Some(2));
    // Neither the log nor two outputs at one place are overwritten.
    let wrong = mfg_vio(&["imu-noise", text(&log), "--write-config", text(&log)]);
    assert_eq!(wrong.status.code(), Some(2));
}

/// A rotorcraft that stands for some seconds with its rotors on is no rest of ten seconds, and flight
/// is none at all.
#[test]
fn flight_is_no_rest() {
    let Some(log) = recording("euroc_v101") else { return };
    let told = fail(&["imu-noise", text(&log)]);
    assert!(told.contains("never at rest"), "{told}");
}
