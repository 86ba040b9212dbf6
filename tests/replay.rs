//! `replay` end to end, on a simulated log: outputs, determinism, failures.

#![cfg(feature = "vision")]

mod support;

use std::path::Path;

use support::{fail, json, lines, mfg_vio, recording, simulated_log, succeed, text};

const FILTERS: [&str; 4] = ["mfgd", "mfgr", "mekfd", "mekfr"];
/// With map points in the state; for logs with an IMU.
const CORRELATED: [&str; 2] = ["mfgs", "mekfs"];

fn rmse(metrics: &serde_json::Value) -> f64 {
    metrics["evaluation"]["ape_translation"]["rmse"].as_f64().expect("an evaluation")
}

fn notes(metrics: &serde_json::Value) -> Vec<&str> {
    let notes = metrics["notes"].as_array().unwrap();
    notes.iter().map(|note| note["text"].as_str().unwrap()).collect()
}

#[test]
fn every_filter_follows_the_simulated_room() {
    for filter in FILTERS {
        let arguments = ["replay", text(simulated_log()), "--filter", filter, "--json"];
        let metrics = json(&arguments);
        assert_eq!(metrics["frames_processed"], metrics["read"]["frames"], "{filter}");
        assert!(metrics["initialization"].as_str().unwrap().starts_with("standing still"));
        assert!(rmse(&metrics) < 0.005, "{filter}: {}", rmse(&metrics));
        let attitude = metrics["evaluation"]["ape_rotation_deg"]["rmse"].as_f64().unwrap();
        assert!(attitude < 1.0, "{filter}: {attitude}");
    }
}

/// The attitude after alignment says little here: the camera moves by millimetres.
#[test]
fn filters_with_correlated_points_know_how_wrong_they_are() {
    for filter in CORRELATED {
        let arguments = ["replay", text(simulated_log()), "--filter", filter, "--json"];
        let metrics = json(&arguments);
        assert!(rmse(&metrics) < 0.005, "{filter}: {}", rmse(&metrics));
        for part in ["attitude", "position"] {
            let nees = metrics["evaluation"]["nees"][part]["mean"].as_f64().unwrap();
            assert!(nees < 4.0, "{filter} {part}: {nees}");
        }
    }
}

#[test]
fn all_files_are_written_and_agree() {
    let directory = tempfile::tempdir().unwrap();
    let out = directory.path();
    let metrics = json(&["replay", text(simulated_log()), "--out", text(out), "--json"]);
    let written = std::fs::read_to_string(out.join("metrics.json")).unwrap();
    assert_eq!(serde_json::from_str::<serde_json::Value>(&written).unwrap(), metrics);

    let frames = metrics["frames_processed"].as_u64().unwrap() as usize;
    let trajectory = lines(&out.join("trajectory.tum"));
    let state = lines(&out.join("state.csv"));
    assert_eq!(trajectory.len(), frames);
    assert_eq!(state.len(), frames + 1);
    let columns = state[0].split(',').count();
    for (pose, row) in trajectory.iter().zip(&state[1..]) {
        let pose: Vec<f64> = pose.split(' ').map(|x| x.parse().unwrap()).collect();
        let row: Vec<&str> = row.split(',').collect();
        assert_eq!((pose.len(), row.len()), (8, columns));
        assert!(pose.iter().all(|x| x.is_finite()));
        for k in 0..8 {
            let value: f64 = row[k].parse().unwrap();
            assert!((value - pose[k]).abs() < 1e-6 * (1.0 + pose[k].abs()));
        }
    }
    let map = lines(&out.join("map.ply"));
    assert_eq!((map[0].as_str(), map[1].as_str()), ("ply", "format ascii 1.0"));
    let recording = std::fs::read(out.join("run.rrd")).unwrap_or_default();
    assert_eq!(!recording.is_empty(), cfg!(feature = "viewer"));

    let evaluated =
        json(&["evaluate", "nees", text(&out.join("trajectory.tum")), text(out), "--json"]);
    assert!(evaluated.is_object());
}

#[test]
fn runs_and_thread_counts_give_the_same_bytes() {
    let run = |threads: &str| {
        let directory = tempfile::tempdir().unwrap();
        let out = text(directory.path());
        let log = text(simulated_log());
        succeed(&["replay", log, "--out", out, "--threads", threads, "--no-recording"]);
        std::fs::read(directory.path().join("trajectory.tum")).unwrap()
    };
    let first = run("2");
    assert!(!first.is_empty());
    assert!(first == run("2"), "two runs differ");
    assert!(first == run("1"), "one and two threads differ");
    assert!(first == run("5"), "two and five threads differ");
}

#[test]
fn a_part_of_the_log_can_be_replayed() {
    let arguments = ["replay", text(simulated_log()), "--start", "1", "--duration", "1", "--json"];
    let metrics = json(&arguments);
    let seconds = metrics["log_seconds"].as_f64().unwrap();
    assert!((0.9..=1.0).contains(&seconds), "{seconds}");
}

#[test]
fn initialisation_modes_say_what_they_did() {
    let log = text(simulated_log());
    let from_truth = json(&["replay", log, "--init", "truth", "--json"]);
    assert!(from_truth["initialization"].as_str().unwrap().contains("reference pose"));
    assert!(rmse(&from_truth) < 0.005);

    // In motion a static start does not fire: the measured values stand beside the thresholds.
    let output = mfg_vio(&["replay", log, "--init", "static", "--start", "2"]);
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(message.contains("limit") && message.contains("too large"), "{message}");

    let moving = json(&["replay", log, "--init", "auto", "--start", "2", "--json"]);
    assert!(moving["initialization"].as_str().unwrap().starts_with("moving"));

    let unknown = json(&["replay", log, "--init", "unknown", "--json"]);
    let found: Vec<_> =
        notes(&unknown).into_iter().filter(|text| text.starts_with("attitude found")).collect();
    assert_eq!(found.len(), 1, "{:?}", notes(&unknown));
    assert!(found[0].contains("roll and pitch known to"), "{found:?}");
}

#[test]
fn a_reference_can_be_given() {
    let directory = tempfile::tempdir().unwrap();
    let out = text(directory.path());
    let log = text(simulated_log());
    succeed(&["replay", log, "--out", out, "--no-recording"]);
    let own = directory.path().join("trajectory.tum");
    let metrics = json(&["replay", log, "--truth", text(&own), "--json"]);
    assert!(rmse(&metrics) < 1e-9, "{}", rmse(&metrics));
}

#[test]
fn failures_are_one_line_and_usage_errors_are_told_apart() {
    let missing = mfg_vio(&["replay", "/nonexistent/log.bag"]);
    let message = String::from_utf8(missing.stderr).unwrap();
    assert_eq!(missing.status.code(), Some(1));
    assert_eq!(message.lines().count(), 1, "{message}");
    assert!(message.contains("/nonexistent/log.bag"), "{message}");

    let directory = tempfile::tempdir().unwrap();
    let garbage = directory.path().join("garbage.mcap");
    std::fs::write(&garbage, b"this is no log").unwrap();
    assert_eq!(mfg_vio(&["replay", text(&garbage)]).status.code(), Some(1));

    let log = text(simulated_log());
    for wrong in [
        &["replay", log, "--filter", "ukf"][..],
        &["replay", log, "--init", "magic"],
        &["replay", log, "--threads", "0"],
        &["replay"],
        &["fly"],
    ] {
        let output = mfg_vio(wrong);
        assert_eq!(output.status.code(), Some(2), "{wrong:?}");
        assert!(output.stdout.is_empty());
    }
    let typo = mfg_vio(&["replay", log, "--set", "imu.gyro_nois=1"]);
    let message = String::from_utf8(typo.stderr).unwrap();
    assert_eq!(typo.status.code(), Some(1));
    assert!(message.contains("did you mean `imu.gyro_noise`"), "{message}");
}

#[test]
fn a_cut_log_is_replayed_up_to_the_cut() {
    let directory = tempfile::tempdir().unwrap();
    let cut = directory.path().join("cut.mcap");
    let whole = std::fs::read(simulated_log()).unwrap();
    std::fs::write(&cut, &whole[..whole.len() * 2 / 3]).unwrap();
    let metrics = json(&["replay", text(&cut), "--json"]);
    let frames = metrics["frames_processed"].as_u64().unwrap();
    assert!((40..91).contains(&frames), "{frames}");
}

/// An interrupted run leaves complete files.
#[test]
#[cfg(unix)]
fn an_interrupted_run_leaves_valid_files() {
    let directory = tempfile::tempdir().unwrap();
    let mut child = std::process::Command::new(env!("CARGO_BIN_EXE_mfg-vio"))
        .args(["replay", text(simulated_log()), "--out", text(directory.path()), "--threads", "1"])
        .stdout(std::process::Stdio::null())
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap();
    let trajectory = directory.path().join("state.csv");
    while !trajectory.exists() && child.try_wait().unwrap().is_none() {
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    let interrupt =
        std::process::Command::new("kill").args(["-INT", &child.id().to_string()]).status();
    assert!(interrupt.unwrap().success());
    child.wait().unwrap();
    for line in lines(&directory.path().join("trajectory.tum")) {
        assert_eq!(line.split(' ').count(), 8);
    }
}

/// Both kinds of filter process every frame of real recordings, with errors below those of two
/// frame-to-frame peers (`tools/compare_peers`): OpenCV ORB + PnP and Open3D's hybrid term.
#[test]
fn real_recordings_are_followed_better_than_by_frame_to_frame_peers() {
    for (name, frames, best_peer) in
        [("tum_fr1_rpy", 270, 0.108), ("seven_scenes_redkitchen", 150, 0.023)]
    {
        let Some(log) = recording(name) else { continue };
        for filter in FILTERS.into_iter().chain(["mfgs"]) {
            let metrics = json(&["replay", text(&log), "--filter", filter, "--json"]);
            assert_eq!(metrics["frames_processed"], frames, "{name} {filter}");
            assert!(rmse(&metrics) < best_peer, "{name} {filter}: {}", rmse(&metrics));
        }
    }
}

/// Along real motion of the data set that the program is for, simulated as its own recordings
/// are (units, signs, encodings), with the configuration shipped for it.
#[test]
fn the_quirks_of_vcu_rvi_are_configuration() {
    let directory = tempfile::tempdir().unwrap();
    let scene = directory.path().join("scene.toml");
    std::fs::write(&scene, "[log]\nquirks = \"vcu-rvi\"\n").unwrap();
    let log = directory.path().join("vcu.mcap");
    succeed(&["simulate", "--config", text(&scene), "--duration", "2", "--out", text(&log)]);
    let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/vcu_rvi.toml");
    let arguments = ["replay", text(&log), "--config", text(&config), "--json"];
    let metrics = json(&arguments);
    assert!(rmse(&metrics) < 0.005, "{}", rmse(&metrics));
    let guessed = json(&["replay", text(&log), "--json"]);
    assert_eq!(guessed["config"], "vcu_rvi");
}

/// In the middle of a log, each by itself: it is named at once, and all that is written is valid.
#[test]
fn faults_are_named_and_survived() {
    let log = text(simulated_log());
    let mut arguments = vec!["faults", log, "--json"];
    let faults = ["black:1.8:0.3", "imu-gap:1.8:0.3", "covered:1.8:0.5", "imu-noise:1.8:0.3"];
    faults.iter().for_each(|fault| arguments.extend(["--fault", fault]));
    let report = json(&arguments);
    let outcomes = report["outcomes"].as_array().unwrap();
    assert_eq!(outcomes.len(), 1 + faults.len());
    let names = ["darkness", "imu-gap", "occlusion", "imu-noise"];
    for ((outcome, fault), name) in outcomes.iter().skip(1).zip(faults).zip(names) {
        assert_eq!(outcome["fault"], fault);
        assert_eq!((&outcome["valid"], &outcome["frames"]), (&true.into(), &91.into()), "{fault}");
        let named = &outcome["named"];
        assert_eq!((&named["kind"], &outcome["right"]), (&name.into(), &true.into()), "{fault}");
        let delay = named["delay"].as_f64().unwrap_or_else(|| panic!("{fault}"));
        assert!((-0.05..0.5).contains(&delay), "{fault}: {delay}");
    }
    // Without a fault none is named in the whole run.
    assert_eq!(outcomes[0]["all_named"], serde_json::json!([]));
    let wrong = mfg_vio(&["replay", log, "--fault", "blak:1:1"]);
    assert_eq!(wrong.status.code(), Some(2));
    assert!(fail(&["faults", log, "--fault", "black:20:1"]).contains("before `black:20:1` begins"));
}

/// What a carried body, a clock, a unit or a bias does to the estimate is undone, or known to it: squared
/// errors below the 99 % quantile of chi-square (the errors of one run are alike).
#[test]
fn what_the_sensors_did_does_not_stay() {
    let directory = tempfile::tempdir().unwrap();
    let log = directory.path().join("room.mcap");
    succeed(&["simulate", "--duration", "7", "--out", text(&log)]);
    let mut arguments = vec!["faults", text(&log), "--json"];
    let faults = ["kidnapped:4:0.5", "imu-stamps:3:1", "gyro-unit:0:inf", "bias:0:inf"];
    faults.iter().for_each(|fault| arguments.extend(["--fault", fault]));
    let report = json(&arguments);
    let outcomes = report["outcomes"].as_array().unwrap();
    assert_eq!(outcomes.len(), 1 + faults.len());
    for outcome in outcomes {
        let recovered = &outcome["recovered"];
        assert!(recovered["position"].as_f64().unwrap() < 0.015, "{outcome}");
        for nees in ["attitude_nees", "position_nees"] {
            assert!(recovered[nees].as_f64().unwrap() < 11.3, "{outcome}");
        }
    }
}

/// The log begins with a second and a half of rest.
#[test]
fn rest_is_found_and_told() {
    let metrics = json(&["replay", text(simulated_log()), "--json"]);
    let rest = metrics["health"]["seconds_at_rest"].as_f64().unwrap();
    assert!((0.5..2.0).contains(&rest), "{rest}");
    let notes = notes(&metrics);
    assert!(notes.iter().any(|text| text.starts_with("at rest")), "{notes:?}");
    assert!(notes.iter().any(|text| text.starts_with("moving again")), "{notes:?}");
}

/// Rest goes on in darkness. Without it being measured the errors of the biases carry the body away.
#[test]
fn rest_holds_the_position_in_darkness() {
    let directory = tempfile::tempdir().unwrap();
    let (scene, log) = (directory.path().join("rest.toml"), directory.path().join("rest.mcap"));
    std::fs::write(&scene, "duration = 6.0\n[motion]\nstandstill = 6.0\n").unwrap();
    succeed(&["simulate", "--config", text(&scene), "--out", text(&log)]);
    let drift = |update: &str| {
        let out = directory.path().join(update);
        let update = format!("standstill.update={update}");
        let arguments =
            ["--fault", "black:1:inf", "--set", &update, "--out", text(&out), "--no-recording"];
        succeed(&[&["replay", text(&log)], &arguments[..]].concat());
        let poses = lines(&out.join("trajectory.tum"));
        let last = poses.iter().rfind(|line| !line.starts_with('#')).unwrap();
        let place = last.split(' ').skip(1).take(3).map(|x| x.parse::<f64>().unwrap().powi(2));
        place.sum::<f64>().sqrt()
    };
    let (held, adrift) = (drift("true"), drift("false"));
    assert!(held < 0.01 && adrift > 5.0 * held, "{held} {adrift}");
}

/// A divergence that never was, by an absurd limit: the estimate starts anew again and again, its
/// outputs stay in order, and it is told.
#[test]
fn a_new_start_keeps_the_outputs_valid() {
    let run = |policy: &str| {
        let policy = format!("health.on_divergence={policy}");
        let limit = "health.max_speed=0.15";
        json(&["replay", text(simulated_log()), "--set", &policy, "--set", limit, "--json"])
    };
    let metrics = run("reinitialize");
    assert!(metrics["health"]["reinitializations"].as_u64().unwrap() > 0);
    // No frame is left out, not even at the end, where the data are too few to be levelled by.
    assert_eq!(metrics["frames_processed"], metrics["read"]["frames"]);
    assert!(rmse(&metrics) < 0.1, "{}", rmse(&metrics));
    let stopped = run("stop");
    assert!(stopped["frames_processed"].as_u64() < metrics["frames_processed"].as_u64());
}
