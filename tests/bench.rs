//! `bench` end to end: miniature copies of the data sets, runs that are kept, the regression guard.

#![cfg(feature = "vision")]

#[path = "support/layouts.rs"]
mod layouts;
mod support;

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use serde_json::Value;
use support::{fail, json, mfg_vio, recording, succeed, text};

/// `bench` with its runs and logs in `cache`.
fn bench(cache: &Path, arguments: &[&str]) -> Value {
    json(&[&["bench"], arguments, &["--json", "--cache", text(cache)]].concat())
}

fn row<'a>(report: &'a Value, sequence: &str) -> &'a Value {
    let rows = report["rows"].as_array().unwrap();
    rows.iter().find(|row| row["sequence"] == sequence).unwrap_or_else(|| panic!("{report:#}"))
}

fn number(row: &Value, keys: &[&str]) -> f64 {
    let value = keys.iter().fold(row, |value, key| &value[*key]);
    value.as_f64().unwrap_or_else(|| panic!("{keys:?}: {row:#}"))
}

/// The report without the one figure that differs from run to run.
fn without_times(mut report: Value) -> Value {
    for row in report["rows"].as_array_mut().unwrap() {
        row.as_object_mut().unwrap().remove("cpu_ms_per_frame");
    }
    report
}

const SHORT: [&str; 9] =
    ["sim", "--sequences", "lab-simple", "--duration", "2.5", "--seeds", "1", "--threads", "2"];

#[test]
fn a_report_has_the_keys_of_the_contract_and_is_the_same_twice() {
    let folder = tempfile::tempdir().unwrap();
    let [a, b, out] = ["a", "b", "out"].map(|name| folder.path().join(name));
    let first = bench(&a, &[&SHORT[..], &["--out", text(&out)]].concat());
    assert_eq!(first["dataset"], "sim");
    let row = row(&first, "lab-simple");
    for key in ["median", "min", "max"] {
        assert!(number(row, &["ape_m", key]) < 0.01, "{row:#}");
        assert!(number(row, &["attitude_deg", key]).is_finite());
        assert!(number(row, &["rpe_1s_m", key]) < 0.01);
    }
    for key in ["attitude", "position", "velocity", "inside_95"] {
        assert!(number(row, &["nees", key]).is_finite());
    }
    assert_eq!(number(row, &["coverage"]), 1.0);
    assert!(number(row, &["cpu_ms_per_frame"]) > 0.0);
    assert_eq!(row["false_alarms"], 0, "{row:#}");
    assert!(row["published"].is_object() && row["filter"] == "mfgs" && row["seeds"] == 1);
    for file in ["results.json", "results.csv", "results.tex", "results.html"] {
        assert!(out.join(file).is_file(), "{file}");
    }
    let saved: Value =
        serde_json::from_slice(&std::fs::read(out.join("results.json")).unwrap()).unwrap();
    assert_eq!(saved, first);

    // From nothing the figures are the same bit for bit; from finished runs all of it.
    assert_eq!(without_times(bench(&b, &SHORT)), without_times(first.clone()));
    let again = Instant::now();
    assert_eq!(bench(&a, &[&SHORT[..], &["--out", text(&out)]].concat()), first);
    assert!(again.elapsed() < Duration::from_secs(20));
    assert_eq!(std::fs::read_dir(a.join("logs")).unwrap().count(), 0, "a log was left");
}

#[test]
fn a_killed_bench_goes_on_where_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let cache = folder.path();
    let arguments =
        ["bench", "sim", "--sequences", "lab-simple", "--duration", "2", "--seeds", "2"];
    let mut child = Command::new(env!("CARGO_BIN_EXE_mfg-vio"))
        .args(arguments)
        .args(["--json", "--cache", text(cache)])
        .stdout(std::process::Stdio::null())
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap();
    let finished = || -> Vec<_> {
        let entries = std::fs::read_dir(cache.join("runs")).into_iter().flatten().flatten();
        let files = entries.map(|entry| entry.path());
        files.filter(|path| path.extension().is_some_and(|e| e == "json")).collect()
    };
    let deadline = Instant::now() + Duration::from_secs(120);
    while finished().is_empty() && Instant::now() < deadline {
        std::thread::sleep(Duration::from_millis(20));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    let [first] = &finished()[..] else { panic!("one run was to be finished: {:?}", finished()) };
    let before = std::fs::metadata(first).unwrap().modified().unwrap();
    let report = bench(cache, &arguments[1..]);
    assert_eq!(
        (&report["rows"][0]["seeds"], &report["rows"][0]["failures"]),
        (&2.into(), &0.into())
    );
    assert_eq!(std::fs::metadata(first).unwrap().modified().unwrap(), before, "run again");
    assert_eq!(finished().len(), 2);
}

#[test]
fn a_sweep_has_a_row_for_each_value_and_a_plot() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let sweep = ["--sweep", "imu.gyro_noise=1e-3,1e-2", "--out", text(&out)];
    let report = bench(folder.path(), &[&SHORT[..], &sweep].concat());
    let values: Vec<_> = report["rows"]
        .as_array()
        .unwrap()
        .iter()
        .map(|r| &r["settings"]["imu.gyro_noise"])
        .collect();
    assert_eq!(values, ["1e-3", "1e-2"]);
    // More assumed noise widens the belief, but the estimate that trusts the gyroscope less errs
    // more, too: their ratio may go either way in so short a run. It is not the same, though.
    let nees = |k: usize| number(&report["rows"][k], &["nees", "attitude"]);
    assert!((nees(1) / nees(0)).ln().abs() > 1e-3, "{} {}: no effect", nees(0), nees(1));
    assert!(std::fs::read_to_string(out.join("sweep.svg")).unwrap().contains("imu.gyro_noise"));
}

#[test]
fn the_guard_passes_what_it_stored_and_refuses_what_is_worse() {
    let folder = tempfile::tempdir().unwrap();
    let (cache, file) = (folder.path().join("cache"), folder.path().join("figures.json"));
    let run = |more: &[&str]| {
        let short =
            ["bench", "sim", "--sequences", "lab-simple", "--duration", "2", "--seeds", "2"];
        mfg_vio(&[&short[..], &["--cache", text(&cache)], more].concat())
    };
    assert!(run(&["--write-guard", text(&file)]).status.success());
    assert!(run(&["--guard", text(&file)]).status.success());
    let mut stored: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    // Two seeds have one degree of freedom: at a level of 0.01/14 on two sides Student's t is 890,
    // so that errors which spread by a third would have to grow by exp(890 * 0.3). Those stored
    // spread by a thousandth (standard deviation of the logarithms 7e-4): the limit is exp(0.63).
    let better = stored["rows"][0]["figures"]["ape_m"].as_array_mut().unwrap();
    assert_eq!(better.len(), 2);
    let least = better[0].as_f64().unwrap() / 1e6;
    *better = vec![least.into(), (least * 1.001).into()];
    std::fs::write(&file, stored.to_string()).unwrap();
    let refused = run(&["--guard", text(&file)]);
    let message = String::from_utf8(refused.stderr).unwrap();
    assert_eq!(refused.status.code(), Some(1));
    assert!(message.contains("WORSE") && message.contains("ape_m"), "{message}");
}

#[test]
fn wrong_usage_is_told_before_anything_runs() {
    let cases: [(&[&str], i32, &str); 8] = [
        (&["bench", "eurok", "."], 2, "euroc"),
        (&["bench", "euroc"], 2, "ROOT"),
        (&["bench", "sim", "--filters", "mfgx"], 2, "mfgx"),
        (&["bench", "sim", "--sequences", "lab"], 2, "lab-simple"),
        (&["bench", "sim", "--sweep", "gyro_noise=1"], 2, "SECTION.KEY"),
        (&["bench", "sim", "--set", "imu.gyro_nois=1"], 2, "imu.gyro_noise"),
        (&["bench", "euroc", "/nonexistent"], 1, "/nonexistent"),
        (&["bench", "sim", "--guard", "/nonexistent/f.json"], 1, "/nonexistent/f.json"),
    ];
    for (arguments, status, part) in cases {
        let output = mfg_vio(arguments);
        let message = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(status), "{arguments:?}: {message}");
        assert!(message.contains(part) && output.stdout.is_empty(), "{message}");
    }
    let empty = tempfile::tempdir().unwrap();
    let message = fail(&["bench", "tum-vi", text(empty.path())]);
    assert!(message.contains("dataset-room1_512_16") && message.contains("datasets/tum-vi.md"));
    let plan = succeed(&["bench", "sim", "--sequences", "hall", "--dry-run"]);
    assert_eq!(
        plan.lines().collect::<Vec<_>>(),
        ["hall, mfgs, seed 1", "hall, mfgs, seed 2", "hall, mfgs, seed 3"]
    );
}

const SIZE: [usize; 2] = [320, 240];
const INTRINSICS: [f64; 4] = [230.0, 230.0, 159.5, 119.5];
const SMALL: &str = "[room]\ntexel = 0.01\n[image]\nwidth = 320\nheight = 240\nrate = 20.0\n";

#[test]
fn euroc_with_late_truth() {
    let root = tempfile::tempdir().unwrap();
    let mounts = [0.0, 0.11].map(layouts::forward_mount);
    let [left, right] = mounts.map(|mount| {
        let camera = layouts::camera_section(&mount, INTRINSICS);
        layouts::render(&format!("duration = 3.0\n{SMALL}{camera}"))
    });
    let cameras = mounts.map(|mount| layouts::sensor_yaml(&mount, SIZE, INTRINSICS));
    let cameras = [cameras[0].as_str(), &cameras[1]];
    let folder = root.path().join("vicon_room1/V1_01_easy");
    layouts::euroc(&folder, &left, &right, cameras, 1.2);
    let report = bench(&root.path().join("cache"), &["euroc", text(root.path()), "--seeds", "1"]);
    let row = row(&report, "V1_01_easy");
    assert_eq!(row["published"]["OKVIS2"], 0.043);
    assert!(number(row, &["coverage"]) > 0.99, "{row:#}");
    assert!(number(row, &["ape_m", "median"]) < 0.02, "{row:#}");
    assert_eq!(report["missing"].as_array().unwrap().len(), 10);
}

#[test]
fn vcu_rvi_with_its_clocks_and_worlds() {
    let root = tempfile::tempdir().unwrap();
    let scene = format!(
        "duration = 6.0\nstart_time = 5645.18\n{SMALL}[motion]\nkind = \"lab-motion\"\n[imu]\nrate = 100.0\n"
    );
    // The configuration's camera, at half of its size.
    let camera = layouts::camera_section(
        &layouts::simulated_mount(),
        [229.6785, 229.882, 166.0975, 129.249],
    );
    let recording = layouts::render(&format!("{scene}{camera}"));
    layouts::vcu_rvi(root.path(), "lab_motion1", &recording, 0.14, [2.0, 3.0]);
    let halved = [
        "--set",
        "camera.fx=229.6785",
        "--set",
        "camera.fy=229.882",
        "--set",
        "camera.cx=166.0975",
        "--set",
        "camera.cy=129.249",
        "--seeds",
        "1",
    ];
    let report =
        bench(&root.path().join("cache"), &[&["vcu-rvi", text(root.path())], &halved[..]].concat());
    let row = row(&report, "lab_motion1");
    assert_eq!(row["published"]["DUI-VIO"], 0.287);
    assert!(number(row, &["coverage"]) > 0.95, "{row:#}");
    // Uncorrected, 0.14 s of this motion are centimetres and tens of degrees.
    assert!(number(row, &["ape_m", "median"]) < 0.02, "{row:#}");
    assert!(number(row, &["attitude_deg", "median"]) < 2.0, "{row:#}");
}

#[test]
fn tum_rgbd_with_the_camera_of_its_folder() {
    let root = tempfile::tempdir().unwrap();
    let mount = layouts::simulated_mount();
    let camera = layouts::camera_section(&mount, [535.4, 539.2, 320.1, 247.6]);
    let scene = "duration = 2.5\n[image]\nrate = 20.0\n[motion]\nstandstill = 0.5\n";
    let recording = layouts::render(&format!("{scene}{camera}"));
    layouts::tum_rgbd(&root.path().join("rgbd_dataset_freiburg3_mini"), &recording, &mount);
    let arguments = ["tum-rgbd", text(root.path()), "--filters", "mfgr", "--seeds", "1"];
    let report = bench(&root.path().join("cache"), &arguments);
    let row = row(&report, "rgbd_dataset_freiburg3_mini");
    assert!(number(row, &["coverage"]) > 0.95, "{row:#}");
    assert!(number(row, &["ape_m", "median"]) < 0.02, "{row:#}");
}

#[test]
fn seven_scenes_without_stamps() {
    let root = tempfile::tempdir().unwrap();
    let mount = layouts::simulated_mount();
    let camera = layouts::camera_section(&mount, [585.0, 585.0, 320.0, 240.0]);
    let scene = "duration = 2.0\n[motion]\nstandstill = 0.5\n";
    let recording = layouts::render(&format!("{scene}{camera}"));
    layouts::seven_scenes(&root.path().join("chess/seq-01"), &recording, &mount);
    let arguments = ["seven-scenes", text(root.path()), "--filters", "mfgr", "--seeds", "1"];
    let report = bench(&root.path().join("cache"), &arguments);
    let row = row(&report, "chess-seq-01");
    assert!(number(row, &["coverage"]) > 0.95, "{row:#}");
    assert!(number(row, &["ape_m", "median"]) < 0.02, "{row:#}");
}

#[test]
fn openloris_with_its_split_imu() {
    let root = tempfile::tempdir().unwrap();
    let mount = layouts::forward_mount(0.0);
    let camera = layouts::camera_section(&mount, INTRINSICS);
    let recording = layouts::render(&format!("duration = 3.0\n{SMALL}{camera}"));
    layouts::openloris(&root.path().join("office1-1"), &recording, &mount, INTRINSICS);
    let report =
        bench(&root.path().join("cache"), &["openloris", text(root.path()), "--seeds", "1"]);
    let row = row(&report, "office1-1");
    assert!(number(row, &["coverage"]) > 0.95, "{row:#}");
    assert!(number(row, &["ape_m", "median"]) < 0.02, "{row:#}");
    assert_eq!(report["missing"].as_array().unwrap().len(), 21);
}

/// Recordings of the development data as far as they go.
#[test]
fn real_recordings() {
    let cases: [(&str, &str, &[&str], f64); 4] = [
        ("euroc", "euroc_v101", &[], 0.05),
        ("tum-rgbd", "tum_fr1_rpy", &["--filters", "mfgr", "--duration", "3"], 0.1),
        ("seven-scenes", "seven_scenes_redkitchen", &["--filters", "mfgr", "--duration", "2"], 0.1),
        ("kitti-imu-gps", "kitti_imu_gps", &[], 20.0),
    ];
    let cache = tempfile::tempdir().unwrap();
    for (dataset, folder, more, limit) in cases {
        let Some(root) = recording(folder) else { return };
        let arguments = [&[dataset, text(&root), "--seeds", "1"], more].concat();
        let report = bench(cache.path(), &arguments);
        let row = &report["rows"][0];
        assert!(number(row, &["coverage"]) > 0.9, "{row:#}");
        assert!(number(row, &["ape_m", "median"]) < limit, "{row:#}");
    }
}
