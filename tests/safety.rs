//! No output harms an input, and what a run leaves tells the truth about it.

#![cfg(all(feature = "vision", unix))]

mod support;

use std::collections::BTreeMap;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use support::{json, lines, simulated_log, succeed, text};

/// A folder of inputs: `log.mcap`, `ref.tum`, `est.tum`, `imu.csv`, `gps.csv`, `conf.toml`, the
/// folder `rec` of a recording and the folder `run` of results.
fn scene() -> tempfile::TempDir {
    let scene = tempfile::tempdir().unwrap();
    let path = |name: &str| scene.path().join(name);
    std::fs::copy(simulated_log(), path("log.mcap")).unwrap();
    let (mut tum, mut imu) = (String::new(), "t,gx,gy,gz,ax,ay,az\n".to_owned());
    for i in 0..400 {
        let t = f64::from(i) * 0.01;
        if i % 10 == 0 {
            tum += &format!("{t} {} {} 0 0 0 0 1\n", t.sin(), t.cos());
        }
        imu += &format!("{t},0,0,0,0,0,9.81\n");
    }
    for name in ["ref.tum", "est.tum"] {
        std::fs::write(path(name), &tum).unwrap();
    }
    std::fs::write(path("imu.csv"), imu).unwrap();
    std::fs::write(path("gps.csv"), "t,x,y,z\n0,0,0,0\n1,0,0,0\n2,0,0,0\n").unwrap();
    std::fs::write(path("conf.toml"), "[imu]\ngyro_noise = 0.001\n").unwrap();
    std::fs::write(path("scene.toml"), "[trajectory]\nfile = \"ref.tum\"\n").unwrap();
    std::fs::create_dir_all(path("rec/rgb")).unwrap();
    for name in ["rec/rgb.txt", "rec/depth.txt", "rec/rgb/1.png"] {
        std::fs::write(path(name), "# nothing\n").unwrap();
    }
    std::fs::create_dir(path("run")).unwrap();
    std::fs::write(path("run/state.csv"), "time,px\n").unwrap();
    std::fs::write(path("run/metrics.json"), "{}\n").unwrap();
    scene
}

fn run(folder: &Path, line: &str) -> Output {
    let program = env!("CARGO_BIN_EXE_mfg-vio");
    Command::new(program).args(line.split(' ')).current_dir(folder).output().unwrap()
}

/// Content of every file below `folder`, and where links lead.
fn snapshot(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_symlink() {
            files.insert(path.clone(), text(&path.read_link().unwrap()).as_bytes().to_vec());
        } else if path.is_dir() {
            files.insert(path.clone(), Vec::new());
            files.extend(snapshot(&path));
        } else {
            files.insert(path.clone(), std::fs::read(&path).unwrap());
        }
    }
    files
}

/// The line ends as wrong usage, in one line, and every file is what it was.
#[track_caller]
fn refused(folder: &Path, line: &str) {
    let before = snapshot(folder);
    let output = run(folder, line);
    let errors = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{line}: {errors}");
    assert_eq!(errors.lines().count(), 1, "{line}: {errors}");
    assert!(output.stdout.is_empty(), "{line}");
    assert!(before == snapshot(folder), "{line}: files changed");
}

/// `NAME=ORIGINAL` before a command: the input by the name that the output has, too.
fn refused_as(cases: &[(&str, &str, &str)]) {
    for (original, name, line) in cases {
        let scene = scene();
        std::fs::rename(scene.path().join(original), scene.path().join(name)).unwrap();
        refused(scene.path(), line);
    }
}

#[test]
fn no_command_writes_over_what_it_reads() {
    refused_as(&[
        ("log.mcap", "log.mcap", "convert log.mcap log.mcap"),
        ("log.mcap", "log.mcap", "replay log.mcap --rrd log.mcap"),
        ("log.mcap", "run.rrd", "replay run.rrd --out ."),
        ("log.mcap", "run.rrd", "replay run.rrd --no-recording --out ."),
        ("log.mcap", "log.mcap", "replay log.mcap --out log.mcap"),
        ("ref.tum", "trajectory.tum", "replay log.mcap --truth trajectory.tum --out ."),
        ("ref.tum", "ref.tum", "replay log.mcap --truth ref.tum --rrd ref.tum"),
        ("conf.toml", "conf.toml", "replay log.mcap --config conf.toml --rrd conf.toml"),
        ("conf.toml", "metrics.json", "replay log.mcap --config metrics.json --out ."),
        ("est.tum", "e.svg", "evaluate ape ref.tum e.svg --plot e.svg"),
        ("ref.tum", "r.png", "evaluate ape r.png est.tum --plot r.png"),
        ("est.tum", "est.tum", "evaluate ape ref.tum est.tum --report est.tum"),
        ("est.tum", "est.tum", "evaluate ape ref.tum ref.tum est.tum --rrd est.tum"),
        ("ref.tum", "ref.tum", "evaluate rpe ref.tum est.tum --report ref.tum"),
        ("ref.tum", "ref.tum", "evaluate nees ref.tum run --report ref.tum"),
        ("ref.tum", "ref.tum", "evaluate nees ref.tum run --report run/state.csv"),
        ("ref.tum", "ref.tum", "evaluate compare run --report run/metrics.json"),
        ("imu.csv", "attitude.csv", "attitude attitude.csv --out ."),
        ("imu.csv", "state.csv", "gnss --imu state.csv --gps gps.csv --out ."),
        ("gps.csv", "trajectory.tum", "gnss --imu imu.csv --gps trajectory.tum --out ."),
        ("conf.toml", "state.csv", "gnss --imu imu.csv --gps gps.csv --config state.csv --out ."),
        ("ref.tum", "ref.tum", "simulate --trajectory ref.tum --out ref.tum"),
        ("conf.toml", "conf.toml", "simulate --config conf.toml --out conf.toml"),
        ("ref.tum", "ref.tum", "simulate --config scene.toml --out ref.tum"),
    ]);
}

#[test]
fn links_and_detours_lead_to_the_same_file() {
    let scene = scene();
    let path = |name: &str| scene.path().join(name);
    symlink("log.mcap", path("link.mcap")).unwrap();
    symlink("link.mcap", path("link_to_link.mcap")).unwrap();
    symlink(".", path("here")).unwrap();
    std::fs::hard_link(path("log.mcap"), path("hard.mcap")).unwrap();
    std::fs::create_dir(path("out")).unwrap();
    std::fs::hard_link(path("log.mcap"), path("out/state.csv")).unwrap();
    symlink("../rec/rgb/1.png", path("out/map.ply")).unwrap();
    for output in
        ["link.mcap", "link_to_link.mcap", "here/log.mcap", "run/../log.mcap", "hard.mcap"]
    {
        refused(scene.path(), &format!("convert log.mcap {output}"));
        refused(scene.path(), &format!("convert {output} log.mcap"));
        refused(scene.path(), &format!("replay log.mcap --rrd {output}"));
    }
    refused(scene.path(), "replay hard.mcap --no-recording --out out");
    refused(scene.path(), "replay rec --out out");
}

#[test]
fn nothing_is_written_into_a_recording() {
    let scene = scene();
    symlink("rec", scene.path().join("link")).unwrap();
    for line in [
        "replay rec --out rec",
        "replay rec --out rec/run",
        "replay rec --out link/run",
        "replay link --rrd rec/x.rrd",
        "convert rec rec/new.mcap",
        "convert rec rec/rgb/1.png",
        "faults rec --out rec",
        "attitude rec --out rec",
    ] {
        refused(scene.path(), line);
    }
    let nested = scene.path().join("faults/none");
    std::fs::create_dir_all(&nested).unwrap();
    std::fs::rename(scene.path().join("log.mcap"), nested.join("run.rrd")).unwrap();
    refused(scene.path(), "faults faults/none/run.rrd --out faults");
}

#[test]
fn outputs_have_names_of_their_own() {
    let scene = scene();
    symlink("a.svg", scene.path().join("b.svg")).unwrap();
    for line in [
        "evaluate ape ref.tum est.tum --plot a.svg --report a.svg",
        "evaluate ape ref.tum est.tum --plot a.svg --report b.svg",
        "evaluate ape ref.tum est.tum --rrd x --report ./x",
        "replay log.mcap --rrd new/state.csv --out new",
        "replay log.mcap --rrd new --out new",
    ] {
        refused(scene.path(), line);
    }
}

#[test]
fn what_is_beside_an_input_may_be_written() {
    let scene = scene();
    let path = |name: &str| scene.path().join(name);
    for line in [
        "evaluate ape ref.tum est.tum --align none --plot ape.svg --report ape.html",
        "evaluate compare run --report run/compare.html",
        "attitude imu.csv --out .",
        "replay log.mcap --no-recording --truth ref.tum --duration 0.5 --out .",
    ] {
        let output = run(scene.path(), line);
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{line}: {errors}");
    }
    for name in ["ape.svg", "ape.html", "run/compare.html", "attitude.csv", "trajectory.tum"] {
        assert!(path(name).metadata().unwrap().len() > 0, "{name}");
    }
    let hidden: Vec<_> =
        snapshot(scene.path()).into_keys().filter(|p| text(p).ends_with(".partial")).collect();
    assert!(hidden.is_empty(), "{hidden:?}");
}

#[test]
fn a_failed_run_leaves_nothing_of_the_run_before() {
    let scene = scene();
    let path = |name: &str| scene.path().join(name);
    succeed(&["replay", text(&path("log.mcap")), "--out", text(&path("out")), "--no-recording"]);
    std::fs::write(path("out/notes.txt"), "mine").unwrap();
    std::fs::write(path("out/run.rrd"), "of an earlier run").unwrap();
    let before = snapshot(&path("out"));

    // Wrong usage and an absent log are no run.
    assert_eq!(run(scene.path(), "replay absent.mcap --out out").status.code(), Some(1));
    assert_eq!(run(scene.path(), "replay log.mcap --out out --seed x").status.code(), Some(2));
    assert!(before == snapshot(&path("out")));

    std::fs::write(path("empty.mcap"), "").unwrap();
    for line in ["replay empty.mcap --out out", "replay log.mcap --start 100 --out out"] {
        std::fs::write(path("out/metrics.json"), "{}").unwrap();
        assert_eq!(run(scene.path(), line).status.code(), Some(1), "{line}");
        assert!(!path("out/metrics.json").exists(), "{line}");
        let poses = std::fs::read_to_string(path("out/trajectory.tum")).unwrap_or_default();
        assert!(poses.is_empty(), "{line}");
        assert_ne!(std::fs::read(path("out/run.rrd")).unwrap_or_default(), b"of an earlier run");
    }
    assert_eq!(std::fs::read(path("out/notes.txt")).unwrap(), b"mine");
}

#[test]
fn a_run_without_metrics_is_no_success() {
    let scene = scene();
    let path = |name: &str| scene.path().join(name);
    for (name, rmse) in [("a", 0.1), ("b", 0.2)] {
        std::fs::create_dir_all(path("method").join(name)).unwrap();
        let statistics = format!(
            r#"{{"rmse":{rmse},"mean":{rmse},"median":{rmse},"std":0,"min":0,"max":1,"sse":1}}"#
        );
        let metrics = format!(
            r#"{{"evaluation":{{"matched":3,"ape_translation":{statistics},"ape_rotation_deg":{statistics}}}}}"#
        );
        std::fs::write(path("method").join(name).join("metrics.json"), metrics).unwrap();
    }
    let success = || {
        json(&["evaluate", "compare", text(&path("method")), "--json"])["methods"][0]
            ["success_rate"]
            .as_f64()
            .unwrap()
    };
    assert_eq!(success(), 1.0);
    std::fs::create_dir(path("method/c")).unwrap();
    assert_eq!(success(), 1.0);
    std::fs::write(path("method/c/trajectory.tum"), "").unwrap();
    assert!((success() - 2.0 / 3.0).abs() < 1e-12);
}

/// A replay that has written some frames, but not all.
fn running_replay(out: &Path) -> Child {
    let mut child = Command::new(env!("CARGO_BIN_EXE_mfg-vio"))
        .args(["replay", text(simulated_log()), "--no-recording", "--threads", "1", "--out"])
        .arg(out)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let begun = || std::fs::metadata(out.join("state.csv")).is_ok_and(|found| found.len() > 8192);
    while !begun() && child.try_wait().unwrap().is_none() {
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    child
}

#[test]
fn a_signal_ends_a_run_with_what_is_done_on_the_disk() {
    for (signal, status) in [("INT", 130), ("TERM", 143), ("HUP", 129)] {
        let directory = tempfile::tempdir().unwrap();
        let mut child = running_replay(directory.path());
        let id = child.id().to_string();
        assert!(Command::new("kill").args(["-s", signal, &id]).status().unwrap().success());
        assert_eq!(child.wait().unwrap().code(), Some(status), "SIG{signal}");
        let metrics = std::fs::read_to_string(directory.path().join("metrics.json")).unwrap();
        let metrics: serde_json::Value = serde_json::from_str(&metrics).unwrap();
        assert_eq!(metrics["interrupted"], true);
        let frames = metrics["frames_processed"].as_u64().unwrap() as usize;
        assert!((1..91).contains(&frames), "{frames}");
        let (poses, states) = (
            lines(&directory.path().join("trajectory.tum")),
            lines(&directory.path().join("state.csv")),
        );
        assert_eq!((poses.len(), states.len()), (frames, frames + 1));
        assert!(poses.iter().all(|line| line.split(' ').count() == 8));
        assert!(directory.path().join("map.ply").is_file());
    }
}

#[test]
fn an_interrupted_log_is_whole_up_to_there() {
    let directory = tempfile::tempdir().unwrap();
    let out = directory.path().join("long.mcap");
    let mut child = Command::new(env!("CARGO_BIN_EXE_mfg-vio"))
        .args(["simulate", "--duration", "600", "--out", text(&out)])
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let begun = || std::fs::metadata(&out).is_ok_and(|found| found.len() > 8 << 20);
    while !begun() && child.try_wait().unwrap().is_none() {
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    let id = child.id().to_string();
    assert!(Command::new("kill").args(["-s", "TERM", &id]).status().unwrap().success());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(143));
    let errors = String::from_utf8(output.stderr).unwrap();
    assert!(errors.contains("complete up to there"), "{errors}");
    let info = json(&["info", text(&out), "--json"]);
    assert!(info["pairs"]["frames"].as_u64().unwrap() > 0, "{info}");
}
