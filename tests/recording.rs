//! Recordings end to end: what is in them, whether they are whole, whatever ended the run.

#![cfg(all(feature = "vision", feature = "viewer"))]

mod support;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use rerun::external::re_log_encoding::{Decodable as _, DecoderApp, StreamFooter};
use rerun::log::{Chunk, LogMsg};
use support::{mfg_vio, simulated_log, succeed, text};

/// Entities of a recording and the timelines that they have data on.
type Entities = BTreeMap<String, BTreeSet<String>>;

fn messages(path: &Path) -> Vec<LogMsg> {
    let file = std::io::BufReader::new(std::fs::File::open(path).unwrap());
    DecoderApp::decode_eager(file).unwrap().map(|message| message.unwrap()).collect()
}

fn entities(path: &Path) -> Entities {
    let mut entities = Entities::new();
    for message in messages(path) {
        let LogMsg::ArrowMsg(store, data) = message else { continue };
        if store.is_recording() {
            let chunk = Chunk::from_arrow_msg(&data).unwrap();
            let timelines = chunk.timelines().keys().map(ToString::to_string);
            entities.entry(chunk.entity_path().to_string()).or_default().extend(timelines);
        }
    }
    entities
}

/// The layouts that come with a recording, as far as they are text.
fn blueprint(path: &Path) -> String {
    let mut text = String::new();
    for message in messages(path) {
        let LogMsg::ArrowMsg(store, data) = message else { continue };
        if !store.is_recording() {
            text += &format!("{}\n", Chunk::from_arrow_msg(&data).unwrap());
        }
    }
    text
}

/// Whether the file ends as a recording does that was closed.
fn is_complete(path: &Path) -> bool {
    let bytes = std::fs::read(path).unwrap();
    let end = bytes.len().saturating_sub(StreamFooter::ENCODED_SIZE_BYTES);
    StreamFooter::from_rrd_bytes(&bytes[end..]).is_ok()
}

/// Checks a recording with the viewer's own command, where it is installed in the right version.
fn verify(path: &Path) {
    let version = rerun::build_info().version.to_string();
    let ours = Command::new("rerun").arg("--version").output();
    let found = ours.map(|output| String::from_utf8_lossy(&output.stdout).into_owned());
    if !found.is_ok_and(|found| found.contains(&version)) {
        eprintln!("SKIPPED: no `rerun` {version} on the path to verify {}", path.display());
        return;
    }
    let output = Command::new("rerun").args(["rrd", "verify", text(path)]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn a_replay_records_every_entity_on_both_timelines() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("run.rrd");
    succeed(&["replay", text(simulated_log()), "--rrd", text(&path), "--json"]);
    assert!(is_complete(&path));
    verify(&path);
    let entities = entities(&path);
    let image = "/world/estimate/body/camera/image";
    let of_frames = [
        "/world/estimate/body",
        "/world/estimate/trajectory",
        "/world/estimate/covariance",
        "/world/truth/body",
        "/world/truth/trajectory",
        "/world/map",
        "/world/map/ellipsoids",
        "/belief/attitude/density",
        "/belief/attitude/estimate",
        "/belief/attitude/truth",
        "/belief/correlation/image",
        "/plots/error/position",
        "/plots/error/attitude",
        "/plots/nees",
        "/plots/sigma/position",
        "/plots/sigma/attitude",
        "/plots/sigma/velocity",
        "/plots/matrix_fisher/s",
        "/plots/innovation",
        "/plots/gate/accepted",
        "/plots/counts/features",
        "/plots/counts/map",
        "/plots/velocity",
        "/plots/bias/gyro",
        "/plots/bias/accel",
        "/plots/timing",
        "/log",
    ];
    let below_image = ["color", "depth"].map(|name| format!("{image}/{name}"));
    let keypoints = ["inliers", "outliers", "new", "unmatched", "no_depth", "matches", "tracks"]
        .map(|name| format!("{image}/keypoints/{name}"));
    let both = BTreeSet::from(["frame".to_owned(), "time".to_owned()]);
    for entity in
        of_frames.iter().map(|name| (*name).to_owned()).chain(below_image).chain(keypoints)
    {
        let timelines = entities.get(&entity).unwrap_or_else(|| panic!("no {entity}"));
        assert_eq!(*timelines, both, "{entity}");
    }
    for (entity, timelines) in [
        ("/world", &[][..]),
        (image, &[]),
        ("/world/truth/body/camera/frustum", &[]),
        // Samples fall between frames.
        ("/plots/imu/gyro", &["time"]),
        ("/plots/imu/accel", &["time"]),
    ] {
        let expected: BTreeSet<_> = timelines.iter().map(|name| (*name).to_owned()).collect();
        assert_eq!(entities[entity], expected, "{entity}");
    }
}

#[test]
fn a_recording_opens_with_the_chosen_purpose() {
    let directory = tempfile::tempdir().unwrap();
    let recorded = |arguments: &[&str]| {
        let path = directory.path().join(format!("{}.rrd", arguments.concat()));
        let log = ["replay", text(simulated_log()), "--duration", "1", "--rrd", text(&path)];
        succeed(&[&log[..], arguments].concat());
        blueprint(&path)
    };
    let pages = [
        recorded(&["--blueprint", "overview"]),
        recorded(&["--set", "recording.blueprint=uncertainty"]),
        recorded(&["--blueprint", "timing"]),
    ];
    for page in &pages {
        for title in ["Overview", "Uncertainty", "Timing"] {
            assert!(page.contains(title), "{title}");
        }
    }
    assert_ne!(pages[0], pages[1]);
    assert_ne!(pages[1], pages[2]);
    let wrong = mfg_vio(&["replay", text(simulated_log()), "--blueprint", "pretty"]);
    assert_eq!(wrong.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&wrong.stderr).contains("overview, uncertainty, timing"));
}

#[test]
#[cfg(unix)]
fn an_interrupted_run_leaves_a_complete_recording() {
    let directory = tempfile::tempdir().unwrap();
    let mut child = Command::new(env!("CARGO_BIN_EXE_mfg-vio"))
        .args(["replay", text(simulated_log()), "--out", text(directory.path()), "--threads", "1"])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let state = directory.path().join("state.csv");
    let begun = || std::fs::metadata(&state).is_ok_and(|file| file.len() > 0);
    while !begun() && child.try_wait().unwrap().is_none() {
        std::thread::sleep(Duration::from_millis(5));
    }
    let interrupt = Command::new("kill").args(["-INT", &child.id().to_string()]).status();
    assert!(interrupt.unwrap().success());
    let status = child.wait().unwrap().code();
    let path = directory.path().join("run.rrd");
    assert!(is_complete(&path));
    verify(&path);
    assert!(entities(&path).contains_key("/world/estimate/body"));
    let metrics = std::fs::read(directory.path().join("metrics.json")).unwrap();
    let metrics: serde_json::Value = serde_json::from_slice(&metrics).unwrap();
    let processed = metrics["frames_processed"].as_u64().unwrap();
    assert!(processed > 0);
    // The signal may come when all is done.
    let interrupted = processed < 91;
    assert_eq!(metrics["interrupted"], interrupted);
    assert_eq!(status, Some(if interrupted { 130 } else { 0 }));
}

#[test]
fn compared_trajectories_are_recorded() {
    let directory = tempfile::tempdir().unwrap();
    let file = |name: &str, off: f64| {
        let line = |i: u32| {
            let t = f64::from(i) * 0.1;
            format!("{t} {} {} 0.1 0 0 0 1\n", t.cos() + off * t, t.sin())
        };
        let path = directory.path().join(name);
        std::fs::write(&path, (0..50).map(line).collect::<String>()).unwrap();
        path
    };
    let (reference, a, b) = (file("ref.txt", 0.0), file("a.txt", 0.01), file("b.txt", 0.02));
    for command in ["ape", "rpe"] {
        let path = directory.path().join(command).with_extension("rrd");
        let trajectories = [text(&reference), text(&a), text(&b)];
        succeed(&[&["evaluate", command], &trajectories[..], &["--rrd", text(&path)]].concat());
        assert!(is_complete(&path));
        verify(&path);
        let entities = entities(&path);
        let time = BTreeSet::from(["time".to_owned()]);
        for entity in ["/world/reference/body", "/world/a/body", "/world/b/body", "/plots/error/a"]
        {
            assert_eq!(entities[entity], time, "{entity}");
        }
        assert!(entities.contains_key("/world/b/trajectory"));
    }
    let unwritable = ["evaluate", "ape", text(&reference), text(&a), "--rrd", "/nonexistent/a.rrd"];
    let output = mfg_vio(&unwritable);
    assert_eq!(output.status.code(), Some(1));
    let message = String::from_utf8(output.stderr).unwrap();
    assert!(message.contains("/nonexistent/a.rrd") && message.lines().count() == 1, "{message}");
}
