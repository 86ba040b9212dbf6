//! Calibration from the log: what `config show` finds, what `replay` does with it, and refusals.
#![cfg(feature = "vision")]

mod support;

use std::path::{Path, PathBuf};

use serde_json::Value;
use support::{fail, json, messages, mfg_vio, succeed, text};

/// A camera and a mounting that are those of no configuration that comes with the program.
const CAMERA: &str = "
[image]
width = 320
height = 240
[camera]
fx = 231.5
fy = 232.25
cx = 158.0
cy = 121.5
imu_from_camera = [
    [0.0, -0.2, 0.9797958971132712, 0.021],
    [-1.0, 0.0, 0.0, -0.013],
    [0.0, -0.9797958971132712, -0.2, 0.034],
    [0.0, 0.0, 0.0, 1.0],
]
";

const LAYOUTS: [(&str, &str, &str); 5] = [
    ("d435i", "RealSense D400", "BMI055"),
    ("oak-d", "OAK-D", "BMI270"),
    ("zed", "ZED", "MEMS"),
    ("azure-kinect", "Azure Kinect", "LSM6DSM"),
    ("structure-core", "Structure Core", "BMI055"),
];

fn simulated(folder: &Path, layout: &str, seconds: f64) -> PathBuf {
    let (scene, log) = (folder.join("scene.toml"), folder.join(format!("{layout}.mcap")));
    let head =
        format!("duration = {seconds}\n[log]\nlayout = \"{layout}\"\n[room]\ntexel = 0.01\n");
    std::fs::write(&scene, format!("{head}{CAMERA}")).unwrap();
    succeed(&["simulate", "--config", text(&scene), "--out", text(&log)]);
    log
}

/// A setting of `config show --json`: value, origin and detail.
fn setting<'a>(shown: &'a Value, key: &str) -> (&'a Value, &'a str, &'a str) {
    let all = shown["settings"].as_array().unwrap();
    let found = all.iter().find(|setting| setting["key"] == key).unwrap();
    let detail = found["detail"].as_str().unwrap_or_default();
    (&found["value"], found["origin"].as_str().unwrap(), detail)
}

fn show(log: &Path, more: &[&str]) -> Value {
    json(&[&["config", "show", text(log), "--json"], more].concat())
}

#[test]
fn recordings_of_common_devices_bring_their_calibration() {
    let folder = tempfile::tempdir().unwrap();
    for (layout, device, chip) in LAYOUTS {
        let shown = show(&simulated(folder.path(), layout, 0.4), &[]);
        assert_eq!(shown["device"], device);
        assert_eq!(shown["missing"].as_array().unwrap().len(), 0, "{layout}");
        let (focal, origin, detail) = setting(&shown, "camera.fx");
        assert_eq!((focal.as_f64(), origin), (Some(231.5), "log"), "{layout}");
        assert!(detail.ends_with("camera_info"), "{layout}: {detail}");
        let (mounting, origin, detail) = setting(&shown, "camera.imu_from_camera");
        assert_eq!(origin, "log", "{layout}");
        assert!(detail.starts_with("transform from"), "{layout}: {detail}");
        let expected = [[0.0, -0.2, 0.9797958971132712, 0.021], [-1.0, 0.0, 0.0, -0.013]];
        for (row, values) in expected.iter().enumerate() {
            for (column, value) in values.iter().enumerate() {
                let found = mounting[row][column].as_f64().unwrap();
                assert!((found - value).abs() < 1e-12, "{layout}: {mounting}");
            }
        }
        let (_, origin, detail) = setting(&shown, "imu.gyro_noise");
        assert_eq!(origin, "sensor class", "{layout}");
        assert!(detail.contains(chip), "{layout}: {detail}");
        assert_eq!(setting(&shown, "map.max_points").1, "shipped file");
    }
}

#[test]
fn every_origin_can_be_printed_and_the_later_one_counts() {
    let folder = tempfile::tempdir().unwrap();
    let log = simulated(folder.path(), "d435i", 0.4);
    let own = folder.path().join("own.toml");
    std::fs::write(&own, "[camera]\nfx = 500.0\n[imu]\ngyro_noise = 0.002\n").unwrap();
    let shown = show(&log, &["--config", text(&own), "--set", "imu.gyro_noise=0.003"]);
    let (focal, origin, _) = setting(&shown, "camera.fx");
    assert_eq!((focal.as_f64(), origin), (Some(500.0), "file"));
    assert_eq!(setting(&shown, "imu.gyro_noise").1, "command line");
    assert_eq!(setting(&shown, "imu.accel_noise").1, "sensor class");
    assert_eq!(setting(&shown, "camera.fy").1, "log");
    assert_eq!(setting(&shown, "map.max_points").1, "default");
    let conflicts = shown["conflicts"].as_array().unwrap();
    assert_eq!(conflicts.len(), 1, "{conflicts:?}");
    assert_eq!(conflicts[0]["key"], "camera.fx");
    // The text says which one is used and why.
    let printed = succeed(&["config", "show", text(&log), "--config", text(&own)]);
    let warning = printed.lines().find(|line| line.starts_with("WARNING")).unwrap();
    for part in ["camera.fx: 500", "is used", "231.5", "camera_info"] {
        assert!(warning.contains(part), "{warning}");
    }
}

/// Root mean square of the absolute errors of a replay, m.
fn error(log: &Path, more: &[&str]) -> f64 {
    let metrics = json(&[&["replay", text(log), "--no-recording", "--json"], more].concat());
    metrics["evaluation"]["ape_translation"]["rmse"].as_f64().unwrap()
}

#[test]
fn replay_without_options_is_as_good_as_with_ones_own_configuration() {
    let folder = tempfile::tempdir().unwrap();
    let own = folder.path().join("own.toml");
    let camera = CAMERA.split("[camera]").nth(1).unwrap();
    let imu = "[imu]\ngyro_noise = 1.2e-3\naccel_noise = 7.4e-3\ngravity = 9.81\n";
    std::fs::write(&own, format!("{imu}[camera]{camera}")).unwrap();
    for (layout, ..) in [LAYOUTS[0], LAYOUTS[2]] {
        let log = simulated(folder.path(), layout, 4.0);
        let (plain, with_own) = (error(&log, &[]), error(&log, &["--config", text(&own)]));
        assert!(plain < 1.1 * with_own, "{layout}: {plain} m, with its own {with_own} m");
    }
}

#[test]
fn without_calibration_from_anywhere_it_says_what_to_do() {
    let folder = tempfile::tempdir().unwrap();
    let log = simulated(folder.path(), "d435i", 0.4);
    let bare = folder.path().join("bare.mcap");
    messages::changed(&log, &bare, |message| !message.is("CameraInfo"));
    let message = fail(&["replay", text(&bare), "--no-recording"]);
    assert_eq!(message.lines().last().unwrap().matches("camera.fx").count(), 2, "{message}");
    for part in ["bare.mcap", "camera.cy", "--config FILE", "mfg-vio info"] {
        assert!(message.contains(part), "{message}");
    }
    // A configuration that has a part of it is told what it lacks.
    let own = folder.path().join("own.toml");
    std::fs::write(&own, "[camera]\nfx = 231.5\nfy = 232.25\n").unwrap();
    let message = fail(&["replay", text(&bare), "--no-recording", "--config", text(&own)]);
    assert!(message.contains("own.toml lacks camera.cx, camera.cy and"), "{message}");
    // Without the mounting the images alone will do.
    let loose = folder.path().join("loose.mcap");
    messages::changed(&log, &loose, |message| !message.is("TFMessage") && !message.is("Imu"));
    let output = mfg_vio(&["replay", text(&loose), "--no-recording"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn frames_of_one_device_tell_the_axes_where_transforms_are_not_recorded() {
    let folder = tempfile::tempdir().unwrap();
    let log = simulated(folder.path(), "d435i", 0.4);
    let loose = folder.path().join("loose.mcap");
    messages::changed(&log, &loose, |message| !message.is("TFMessage"));
    let shown = show(&loose, &[]);
    let (mounting, origin, detail) = setting(&shown, "camera.imu_from_camera");
    assert_eq!((origin, mounting[0][0].as_f64()), ("log", Some(1.0)));
    assert!(detail.contains("camera_imu_optical_frame"), "{detail}");
    assert_eq!(setting(&shown, "filter.camera_translation_sd").1, "log");
    // The frames of other drivers follow no convention.
    let log = simulated(folder.path(), "oak-d", 0.4);
    messages::changed(&log, &loose, |message| !message.is("TFMessage"));
    let shown = show(&loose, &[]);
    assert_eq!(shown["missing"][0], "camera.imu_from_camera");
    let message = fail(&["replay", text(&loose), "--no-recording"]);
    assert!(message.contains("--write-config FILE") && message.contains("--set"), "{message}");
}

#[test]
fn a_calibration_is_that_of_one_device() {
    let folder = tempfile::tempdir().unwrap();
    let log = support::simulated_log();
    // The same camera under other names: without this program's notes and without transforms.
    let other = folder.path().join("other.mcap");
    messages::changed(log, &other, |message| {
        message.topic = format!("/rig{}", message.topic);
        !message.is("TFMessage")
    });
    let shown = show(&other, &[]);
    assert_eq!(shown["config"], "configs/sim.toml");
    assert_eq!(setting(&shown, "camera.imu_from_camera").1, "shipped file");
}
