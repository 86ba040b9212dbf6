//! Every camera model from the simulator through the estimator.

#![cfg(feature = "vision")]

mod support;

use std::path::Path;

use support::{fail, json, succeed, text};

/// `[camera]` of lenses that fill an image of 320 by 240 pixels: model, focal length, coefficients,
/// the last three with views of 180 degrees and more.
const LENSES: [(&str, f64, &str); 6] = [
    ("radial-tangential", 230.0, "[]"),
    ("radial-tangential", 230.0, "[-0.28, 0.07, 2e-4, -1e-4, 0.0]"),
    ("rational", 230.0, "[0.4, -0.1, 2e-4, -1e-4, 0.0, 0.7, 0.0, 0.0]"),
    ("equidistant", 101.9, "[0.0035, 0.0007, -0.002, 0.0002]"),
    ("double-sphere", 80.0, "[-0.2, 0.59]"),
    ("omnidirectional", 180.0, "[1.2, -0.02, 0.003, 1e-4, -1e-4]"),
];

const KEYS: [(&str, &str); 2] = [("cx", "159.5"), ("cy", "119.5")];

/// RMS error of the position (m) over a simulated log of a camera.
fn error(folder: &Path, (model, focal, distortion): (&str, f64, &str)) -> f64 {
    let mut scene = "duration = 5.0\n[room]\ntexel = 0.01\n[motion]\nstandstill = 1.0\n[image]\n\
                     width = 320\nheight = 240\n[camera]\n"
        .to_owned();
    let mut keys: Vec<(&str, String)> = vec![
        ("model", format!("\"{model}\"")),
        ("fx", focal.to_string()),
        ("fy", focal.to_string()),
        ("distortion", distortion.to_owned()),
    ];
    keys.extend(KEYS.map(|(key, value)| (key, value.to_owned())));
    let (config, log) = (folder.join("scene.toml"), folder.join("log.mcap"));
    let mut arguments = vec!["replay".to_owned(), text(&log).to_owned(), "--json".to_owned()];
    for (key, value) in keys {
        scene += &format!("{key} = {value}\n");
        arguments.extend(["--set".to_owned(), format!("camera.{key}={value}")]);
    }
    std::fs::write(&config, scene).unwrap();
    succeed(&["simulate", "--config", text(&config), "--out", text(&log)]);
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let metrics = json(&arguments);
    assert_eq!(metrics["frames_processed"], metrics["read"]["frames"], "{model}");
    metrics["evaluation"]["ape_translation"]["rmse"].as_f64().unwrap()
}

#[test]
fn every_model_is_as_good_as_a_pinhole_of_as_many_pixels() {
    let folder = tempfile::tempdir().unwrap();
    let [pinhole, others @ ..] = LENSES;
    let reference = error(folder.path(), pinhole);
    assert!(reference < 0.01, "{reference}");
    for lens in others {
        let error = error(folder.path(), lens);
        assert!(error < 2.0 * reference, "{lens:?}: {error} m, a pinhole {reference} m");
    }
}

#[test]
fn a_calibration_of_no_camera_is_refused_with_its_key() {
    let log = support::simulated_log();
    for (set, words) in [
        ("camera.distortion=[0.1, 0.2]", ["camera.distortion", "k1 k2 p1 p2"]),
        ("camera.model=\"fisheye\"", ["camera.model", "equidistant"]),
        ("camera.fx=0", ["camera.fx", "positive"]),
        ("depth.along=\"up\"", ["depth.along", "axis"]),
    ] {
        let message = fail(&["replay", text(log), "--set", set]);
        assert!(words.iter().all(|word| message.contains(word)), "{set}: {message}");
        assert_eq!(message.lines().count(), 1, "{message}");
    }
}
