//! `info` on every kind of log: what it finds, advises and concludes.

mod support;

use std::path::{Path, PathBuf};

use serde_json::Value;
use support::{json, messages, mfg_vio, recording, succeed, text};

/// Small images: what is checked are numbers, stamps and labels.
const SMALL: &str = "
[room]
texel = 0.02
clutter = 8
[image]
width = 160
height = 120
[camera]
fx = 115.0
fy = 115.0
cx = 79.5
cy = 59.5
";

/// The habits of VCU-RVI's recordings, without a reference.
const VCU_RVI: &str = "
start_time = 5645.18
duration = 3.0
[imu]
rate = 100.0
[truth]
rate = 0.0
[log]
quirks = \"vcu-rvi\"
log_time_offset = 1.55e9
";

/// The log of a scene file of both texts.
fn simulated(folder: &Path, scene: &str) -> PathBuf {
    let (config, log) = (folder.join("scene.toml"), folder.join("log.mcap"));
    std::fs::write(&config, format!("{scene}{SMALL}")).unwrap();
    succeed(&["simulate", "--config", text(&config), "--out", text(&log)]);
    log
}

fn info(log: &Path, more: &[&str]) -> Value {
    json(&[&["info", text(log), "--json"], more].concat())
}

/// Messages of the findings about a subject that contain a text, with their severities.
fn findings<'a>(info: &'a Value, subject: &str, part: &str) -> Vec<(&'a str, &'a str)> {
    let all = info["findings"].as_array().unwrap().iter();
    all.filter(|finding| finding["subject"] == subject)
        .map(|finding| {
            (finding["severity"].as_str().unwrap(), finding["message"].as_str().unwrap())
        })
        .filter(|(_, message)| message.contains(part))
        .collect()
}

fn settings(info: &Value) -> Vec<&str> {
    let settings = info["verdict"]["settings"].as_array().unwrap();
    settings.iter().map(|setting| setting.as_str().unwrap()).collect()
}

#[test]
fn the_traps_of_vcu_rvi_are_found() {
    let folder = tempfile::tempdir().unwrap();
    let log = simulated(folder.path(), VCU_RVI);
    let found = info(&log, &[]);
    assert_eq!(found["config_name"], "vcu_rvi");
    let gravity = findings(&found, "imu", "g, sign inverted");
    assert_eq!(gravity.len(), 1, "{found:#}");
    assert!(gravity[0].1.contains("`imu.accelerometer_scale = -9.81` is set"), "{gravity:?}");
    assert!(gravity[0].1.contains("at rest") && gravity[0].1.contains("mounting"), "{gravity:?}");
    assert_eq!(found["imu"]["accelerometer_unit"], "g");
    for subject in ["color", "depth", "imu"] {
        assert_eq!(findings(&found, subject, "different clocks (1550000000.000").len(), 1);
    }
    assert_eq!(found["topics"]["/cam0/color"]["encoding"], "8UC3");
    assert_eq!(findings(&found, "color", "`8UC3`").len(), 1);
    assert_eq!(findings(&found, "depth", "millimetres")[0].0, "ok");
    assert_eq!(found["verdict"]["text"], "fit for VIO");

    // With a configuration that takes the log at its word, it says what to set.
    let naive = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/sim.toml");
    let found = info(&log, &["--config", text(&naive)]);
    let gravity = findings(&found, "imu", "g, sign inverted")[0];
    assert!(gravity.1.contains(", set `imu.accelerometer_scale = -9.81`"), "{gravity:?}");
    assert_eq!(settings(&found), ["imu.accelerometer_scale=-9.81"]);
    assert!(found["verdict"]["fit"].as_bool().unwrap());
}

#[test]
fn a_log_in_order_is_fit_as_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let log = simulated(folder.path(), "duration = 6.0");
    let found = info(&log, &[]);
    assert_eq!(found["verdict"]["text"], "fit for VIO");
    assert_eq!(found["imu"]["accelerometer_unit"], "m/s^2");
    assert_eq!(found["imu"]["gravity_sign"], "regular");
    assert_eq!(found["imu"]["sign_from"], "truth");
    assert_eq!(found["imu"]["at_rest"], true);
    let up = found["imu"]["truth_up"][2].as_f64().unwrap();
    assert!(up > 0.999, "{up}");
    assert_eq!(found["pairs"]["frames"], 181);
    let rate = found["topics"]["/imu"]["timing"]["rate"].as_f64().unwrap();
    assert!((rate - 200.0).abs() < 0.01, "{rate}");
    let severe = |f: &&Value| f["severity"] == "warning" || f["severity"] == "error";
    assert_eq!(found["findings"].as_array().unwrap().iter().filter(severe).count(), 0);
    // The text for people ends in the verdict.
    let printed = succeed(&["info", text(&log)]);
    assert_eq!(printed.lines().last(), Some("verdict: fit for VIO"));
    assert!(printed.contains("/cam0/color") && printed.contains("rgb8 160x120"), "{printed}");
}

#[test]
fn gaps_and_darkness_are_found() {
    let folder = tempfile::tempdir().unwrap();
    let scene = "duration = 3.0\n[light]\nkeys = [[2.0, 1.0], [2.2, 0.0]]\n";
    let log = simulated(
        folder.path(),
        &format!("{scene}[imu]\ngaps = [[1.0, 0.3]]\n[truth]\nrate = 50.0\n"),
    );
    let found = info(&log, &[]);
    let gap = findings(&found, "imu", "60 samples missing in 1 gap (200.0 Hz)");
    assert_eq!((gap.len(), gap[0].0), (1, "warning"), "{found:#}");
    assert!(gap[0].1.contains("of 0.305 s after 100.995 s"), "{gap:?}");
    assert_eq!(findings(&found, "color", "of the images are dark").len(), 1);
}

#[test]
fn dropped_frames_are_counted() {
    let folder = tempfile::tempdir().unwrap();
    let (config, log) = (folder.path().join("scene.toml"), folder.path().join("log.mcap"));
    let scene =
        format!("duration = 3.0\n{}", SMALL.replace("[image]", "[image]\ngaps = [[1.0, 0.19]]"));
    std::fs::write(&config, scene).unwrap();
    succeed(&["simulate", "--config", text(&config), "--out", text(&log)]);
    let found = info(&log, &[]);
    let dropped = findings(&found, "color", "6 frames dropped in 1 gap (30.0 Hz)");
    assert_eq!(dropped.len(), 1, "{found:#}");
    assert_eq!(found["pairs"]["frames"], 85);
}

#[test]
fn a_cut_log_is_told_to_be_cut() {
    let folder = tempfile::tempdir().unwrap();
    let log = simulated(folder.path(), "duration = 1.0");
    let whole = std::fs::read(&log).unwrap();
    std::fs::write(&log, &whole[..whole.len() / 2]).unwrap();
    let found = info(&log, &[]);
    assert!(!findings(&found, "log", "cut short").is_empty(), "{found:#}");
    assert!(found["pairs"]["frames"].as_u64().unwrap() > 5);
}

#[test]
fn a_tum_folder_is_fit_without_an_imu() {
    let Some(folder) = recording("tum_fr1_rpy") else { return };
    let found = info(&folder, &[]);
    assert_eq!(found["config_name"], "tum_rgbd");
    assert_eq!(found["verdict"]["text"], "fit for RGB-D odometry (it has no IMU)");
    assert_eq!(findings(&found, "depth", "1/5000 m")[0].0, "ok");
    assert_eq!(found["pairs"]["frames"], 270);
    assert!(found["depth"]["median"].as_f64().unwrap() > 0.5);

    let found = info(&folder, &["--set", "log.depth_scale=0.001"]);
    assert_eq!(settings(&found), ["log.depth_scale=0.0002"]);
}

#[test]
fn a_seven_scenes_folder_is_in_millimetres() {
    let Some(folder) = recording("seven_scenes_redkitchen") else { return };
    let found = info(&folder, &[]);
    assert_eq!(found["config_name"], "seven_scenes");
    assert_eq!(findings(&found, "depth", "millimetres")[0].0, "ok");
    assert_eq!(found["verdict"]["fit"], true);
}

#[test]
fn what_is_no_log_is_refused_in_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("notes.txt");
    std::fs::write(&path, "hello").unwrap();
    let output = mfg_vio(&["info", text(&path)]);
    assert_eq!(output.status.code(), Some(1));
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(message.lines().count(), 1);
    assert!(message.contains("notes.txt") && message.contains("it begins with `hello`"));
    assert_eq!(mfg_vio(&["info"]).status.code(), Some(2));
}

/// A hand-held motion of 8 s, large enough images for the estimator, and a copy of it each of whose
/// messages is changed.
fn moved(folder: &Path, change: impl FnMut(&mut messages::Message) -> bool) -> PathBuf {
    static LOG: std::sync::OnceLock<(tempfile::TempDir, PathBuf)> = std::sync::OnceLock::new();
    let (_, log) = LOG.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let scene = "duration = 8.0\n[motion]\nkind = \"lab-motion\"\n[room]\ntexel = 0.01\n[image]\n\
                     width = 320\nheight = 240\nrate = 20.0\n[camera]\nfx = 229.7\nfy = 229.9\n\
                     cx = 166.1\ncy = 129.2\n";
        let (config, log) = (folder.path().join("scene.toml"), folder.path().join("log.mcap"));
        std::fs::write(&config, scene).unwrap();
        succeed(&["simulate", "--config", text(&config), "--out", text(&log)]);
        (folder, log)
    });
    let copy = folder.join("copy.mcap");
    messages::changed(log, &copy, change);
    copy
}

/// Changes the rates and the accelerations of every IMU message.
fn with_imu(
    folder: &Path,
    change: impl Fn([f64; 3], [f64; 3]) -> ([f64; 3], [f64; 3]),
    keeps_truth: bool,
) -> PathBuf {
    moved(folder, |message| {
        if message.is("Imu") {
            let (rates, accelerations) = change(message.rates(), message.accelerations());
            message.set_imu(rates, accelerations);
        }
        keeps_truth || message.topic != "/truth/pose"
    })
}

#[cfg(feature = "vision")]
#[test]
fn turned_axes_are_found_and_the_written_configuration_mends_them() {
    let folder = tempfile::tempdir().unwrap();
    // Turned by half about z, without a reference.
    let turn = |[x, y, z]: [f64; 3]| [-x, -y, z];
    let log = with_imu(folder.path(), |g, a| (turn(g), turn(a)), false);
    let own = folder.path().join("own.toml");
    let found = info(&log, &["--write-config", text(&own)]);
    let axes = findings(&found, "imu", "turned by 180 degrees");
    assert_eq!(axes.len(), 1, "{:#}", found["findings"]);
    assert!(axes[0].1.contains("x = -x, y = -y, z = z"), "{axes:?}");
    assert_eq!(found["verdict"]["fit"], true);
    let metrics = json(&["replay", text(&log), "--config", text(&own), "--no-recording", "--json"]);
    assert!(metrics["frames_processed"].as_u64().unwrap() > 150, "{metrics}");
    let again = info(&log, &["--config", text(&own)]);
    assert_eq!(findings(&again, "imu", "turn alike").len(), 1, "{:#}", again["findings"]);
}

#[cfg(feature = "vision")]
#[test]
fn left_handed_axes_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let swap = |[x, y, z]: [f64; 3]| [y, x, z];
    let log = with_imu(folder.path(), |g, a| (swap(g), swap(a)), false);
    let found = info(&log, &[]);
    assert_eq!(findings(&found, "imu", "left-handed").len(), 1, "{:#}", found["findings"]);
    assert_eq!(found["verdict"]["fit"], false);
    assert!(found["verdict"]["text"].as_str().unwrap().ends_with("fit for attitude"));
}

#[cfg(feature = "vision")]
#[test]
fn units_are_found_by_the_images_alone() {
    let folder = tempfile::tempdir().unwrap();
    let degrees = |g: [f64; 3]| g.map(f64::to_degrees);
    let log = with_imu(folder.path(), |g, a| (degrees(g), a), false);
    let found = info(&log, &[]);
    assert_eq!(findings(&found, "imu", "deg/s (by the turns of the images)").len(), 1);
    assert_eq!(settings(&found), ["imu.gyroscope_scale=0.017453292519943295"]);
}

#[test]
fn accelerometers_of_all_kinds_are_told_apart() {
    let folder = tempfile::tempdir().unwrap();
    let scaled = |factor: f64| move |a: [f64; 3]| a.map(|x| factor * x);
    let in_g = with_imu(folder.path(), |g, a| (g, scaled(1.0 / 9.80665)(a)), true);
    let found = info(&in_g, &[]);
    assert!(findings(&found, "imu", ": g, sign regular")[0].1.contains("is set"), "{found:#}");
    for (factor, part) in [(1.04, "% too large"), (1.17, "% too large"), (0.93, "% too small")] {
        let log = with_imu(folder.path(), |g, a| (g, scaled(factor)(a)), true);
        let found = info(&log, &[]);
        let off = findings(&found, "imu", part);
        assert_eq!(off.len(), 1, "{factor}: {:#}", found["findings"]);
        let advised = settings(&found)[0].strip_prefix("imu.accelerometer_scale=").unwrap();
        let advised: f64 = advised.parse().unwrap();
        assert!((advised * factor - 1.0).abs() < 0.01, "{factor}: {advised}");
    }
    let log = with_imu(folder.path(), |g, _| (g, [0.0; 3]), true);
    let found = info(&log, &[]);
    assert_eq!(findings(&found, "imu", "reads zero throughout").len(), 1, "{found:#}");
    assert_eq!(found["has_imu"], false);
    let verdict = found["verdict"]["text"].as_str().unwrap();
    assert!(verdict.contains("it has no IMU"), "{verdict}");
}

#[test]
fn clocks_that_do_not_overlap_are_told_with_their_spans() {
    let folder = tempfile::tempdir().unwrap();
    let log = moved(folder.path(), |message| {
        if message.is("Imu") {
            message.delay(1000);
        }
        true
    });
    let found = info(&log, &[]);
    let spans = findings(&found, "imu", "stamps of /imu cover 1100.000 to 1108.000 s");
    assert!(spans[0].1.contains("of /cam0/color 100.000 to 108.000 s"), "{found:#}");
    assert_eq!(found["verdict"]["fit"], false);
}

#[test]
fn missing_calibration_is_no_fit_log() {
    let folder = tempfile::tempdir().unwrap();
    let log = moved(folder.path(), |message| !message.is("CameraInfo"));
    let found = info(&log, &[]);
    assert_eq!(findings(&found, "color", "no calibration of the camera").len(), 1);
    assert_eq!(found["verdict"]["fit"], false);
    assert_eq!(found["verdict"]["fit_for"][0], "attitude");
}
