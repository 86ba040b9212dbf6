//! Streams that end, fill up or jump: standard output, clocks, sensors that go on alone.

#![cfg(all(feature = "vision", unix))]

mod support;

use std::fs::File;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use serde_json::Value;
use support::{json, lines, mfg_vio, simulated_log, succeed, text};

/// The simulated log with `clock` (s to s) applied to all header stamps; messages stay in the order
/// in which they were logged. What `keep` refuses (by topic and s) is left out.
fn restamped(path: &Path, clock: impl Fn(f64) -> f64, keep: impl Fn(&str, f64) -> bool) {
    let bytes = std::fs::read(simulated_log()).unwrap();
    let mut writer =
        mcap::Writer::new(std::io::BufWriter::new(File::create(path).unwrap())).unwrap();
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let mut message = message.unwrap();
        if message.channel.topic.starts_with("/tf") {
            continue;
        }
        // CDR: four bytes of encapsulation, then the seconds and nanoseconds of the header.
        let part = |at: usize| <[u8; 4]>::try_from(&message.data[at..at + 4]).unwrap();
        let seconds =
            f64::from(i32::from_le_bytes(part(4))) + f64::from(u32::from_le_bytes(part(8))) * 1e-9;
        if !keep(&message.channel.topic, seconds) {
            continue;
        }
        let nanos = (clock(seconds) * 1e9).round() as i64;
        let mut data = message.data.to_vec();
        let whole = nanos.div_euclid(1_000_000_000) as i32;
        data[4..8].copy_from_slice(&whole.to_le_bytes());
        let rest = nanos.rem_euclid(1_000_000_000) as u32;
        data[8..12].copy_from_slice(&rest.to_le_bytes());
        message.data = data.into();
        writer.write(&message).unwrap();
    }
    writer.finish().unwrap();
}

/// Stamp of the simulated log's first frame, s.
fn start() -> f64 {
    let info = json(&["info", text(simulated_log()), "--json"]);
    info["topics"]["/cam0/color"]["timing"]["first"].as_f64().expect("a first stamp")
}

fn notes(metrics: &Value) -> Vec<&str> {
    let notes = metrics["notes"].as_array().unwrap();
    notes.iter().map(|note| note["text"].as_str().unwrap()).collect()
}

/// A folder with what each command reads.
fn scene() -> tempfile::TempDir {
    let scene = tempfile::tempdir().unwrap();
    let path = |name: &str| scene.path().join(name);
    std::fs::hard_link(simulated_log(), path("log.mcap"))
        .or_else(|_| std::fs::copy(simulated_log(), path("log.mcap")).map(|_| ()))
        .unwrap();
    let (mut tum, mut imu, mut gps) =
        (String::new(), "t,gx,gy,gz,ax,ay,az\n".to_owned(), "t,x,y,z\n".to_owned());
    for i in 0..400 {
        let t = f64::from(i) * 0.01;
        imu += &format!("{t},0,0,0,0,0,9.81\n");
        if i % 10 == 0 {
            tum += &format!("{t} {} {} 0 0 0 0 1\n", t.sin(), t.cos());
            gps += &format!("{t},0,0,0\n");
        }
    }
    for (name, content) in [("ref.tum", &tum), ("imu.csv", &imu), ("gps.csv", &gps)] {
        std::fs::write(path(name), content).unwrap();
    }
    scene
}

const COMMANDS: [&str; 17] = [
    "info log.mcap",
    "info log.mcap --json",
    "replay log.mcap --no-recording --duration 0.5",
    "replay log.mcap --no-recording --duration 0.5 --json",
    "convert log.mcap copy.mcap",
    "simulate --duration 0.1 --out new.mcap",
    "attitude imu.csv",
    "attitude imu.csv --json",
    "gnss --imu imu.csv --gps gps.csv",
    "gnss --imu imu.csv --gps gps.csv --json",
    "evaluate ape ref.tum ref.tum",
    "evaluate ape ref.tum ref.tum --json",
    "evaluate rpe ref.tum ref.tum --csv",
    "fisher 20 5 1",
    "experiment --list",
    "--help",
    "replay --help",
];

fn run(folder: &Path, line: &str, stdout: Stdio, stderr: Stdio) -> Output {
    Command::new(env!("CARGO_BIN_EXE_mfg-vio"))
        .args(line.split(' '))
        .current_dir(folder)
        .stdout(stdout)
        .stderr(stderr)
        .output()
        .unwrap()
}

/// The writing end of a pipe that nobody reads.
fn closed_pipe() -> Stdio {
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    writer.into()
}

fn full_device() -> Stdio {
    File::options().write(true).open("/dev/full").unwrap().into()
}

#[test]
fn a_standard_output_that_takes_nothing_is_a_failure_in_one_line() {
    let scene = scene();
    for line in COMMANDS {
        for (what, stdout) in [("closed", closed_pipe()), ("full", full_device())] {
            let output = run(scene.path(), line, stdout, Stdio::piped());
            let errors = String::from_utf8(output.stderr).unwrap();
            assert_eq!(output.status.code(), Some(1), "{line}, {what}: {errors}");
            let said: Vec<_> = errors.lines().filter(|line| line.contains("mfg-vio:")).collect();
            assert!(said.len() <= 1 && !errors.contains("panicked"), "{line}, {what}: {errors}");
        }
    }
}

#[test]
fn messages_that_nobody_reads_are_no_failure() {
    let scene = scene();
    for line in
        ["replay log.mcap --no-recording --duration 0.5", "evaluate ape ref.tum ref.tum --csv"]
    {
        for stderr in [closed_pipe(), full_device()] {
            let output = run(scene.path(), line, Stdio::piped(), stderr);
            assert_eq!(output.status.code(), Some(0), "{line}");
            assert!(!output.stdout.is_empty(), "{line}");
        }
    }
    for stderr in [closed_pipe(), full_device()] {
        let output = run(scene.path(), "replay absent.mcap", Stdio::piped(), stderr);
        assert_eq!(output.status.code(), Some(1));
    }
}

/// One new run, told once; the estimate does not believe the time in between.
#[test]
fn a_jump_of_all_stamps_begins_a_new_run_and_is_told() {
    let (folder, start) = (tempfile::tempdir().unwrap(), start());
    for (jump, told) in [(-1.0, "back by"), (-1800.0, "back by"), (3600.0, "ahead by 3600.")] {
        let log = folder.path().join("jump.mcap");
        let clock = |t: f64| if t > start + 1.8 { t + jump } else { t };
        // Stamps before the clock's origin are none that a log has.
        let origin = if jump < -100.0 { 5000.0 } else { 0.0 };
        restamped(&log, |t| clock(t) + origin, |_, _| true);
        let out = folder.path().join("out");
        let metrics =
            json(&["replay", text(&log), "--no-recording", "--json", "--out", text(&out)]);
        let told = notes(&metrics).into_iter().filter(|note| note.contains(told)).count();
        assert_eq!(told, 1, "{jump}: {:?}", notes(&metrics));
        assert_eq!(metrics["health"]["divergences"], serde_json::json!([]), "{jump}");
        let path = metrics["path_length"].as_f64().unwrap();
        let error = metrics["evaluation"]["ape_translation"]["rmse"].as_f64().unwrap();
        assert!(path < 1.0 && error < 0.05, "{jump}: {path} m, {error} m");
        let stamps: Vec<f64> = lines(&out.join("trajectory.tum"))
            .iter()
            .map(|line| line.split(' ').next().unwrap().parse().unwrap())
            .collect();
        assert!(stamps.windows(2).all(|pair| pair[0] < pair[1]), "{jump}");
        assert!(stamps.len() >= 54, "{jump}: {}", stamps.len());

        let info = json(&["info", text(&log), "--json"]);
        let settings = info["verdict"]["settings"].as_array().unwrap();
        let useless = |setting: &&Value| setting.as_str().unwrap().contains("reorder_window");
        assert_eq!(settings.iter().find(useless), None, "{jump}");
    }
}

#[test]
fn an_advised_setting_is_printed_once_and_helps() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("late.mcap");
    let (start, mut late) = (start(), false);
    // Twenty milliseconds of every stream logged 0.7 s late.
    let bytes = std::fs::read(simulated_log()).unwrap();
    let mut messages: Vec<_> =
        mcap::MessageStream::new(&bytes).unwrap().map(|message| message.unwrap()).collect();
    for message in &mut messages {
        let time = message.log_time as f64 * 1e-9 - start;
        if (1.0..1.07).contains(&time) && !message.channel.topic.starts_with("/tf") {
            message.log_time += 700_000_000;
            late = true;
        }
    }
    assert!(late);
    messages.sort_by_key(|message| message.log_time);
    let file = std::io::BufWriter::new(File::create(&log).unwrap());
    let mut writer = mcap::Writer::new(file).unwrap();
    messages.iter().for_each(|message| writer.write(message).unwrap());
    writer.finish().unwrap();
    drop(writer);

    let info = json(&["info", text(&log), "--json"]);
    let settings: Vec<_> = info["verdict"]["settings"]
        .as_array()
        .unwrap()
        .iter()
        .map(|setting| setting.as_str().unwrap())
        .filter(|setting| setting.contains("reorder_window"))
        .collect();
    let [setting] = settings[..] else { panic!("{settings:?}") };
    let frames = |more: &[&str]| {
        let arguments = [&["replay", text(&log), "--no-recording", "--json"], more].concat();
        json(&arguments)["read"]["frames"].as_u64().unwrap()
    };
    assert!(frames(&["--set", setting]) > frames(&[]));
    let printed = succeed(&["info", text(&log)]);
    assert_eq!(printed.matches("`log.reorder_window = ").count(), 1, "{printed}");
}

#[test]
fn an_imu_that_goes_on_alone_changes_nothing() {
    let (folder, start) = (tempfile::tempdir().unwrap(), start());
    let (short, long) = (folder.path().join("short.mcap"), folder.path().join("long.mcap"));
    let frames_until = |topic: &str, t: f64| topic == "/imu" || t < start + 1.0;
    restamped(&short, |t| t, |topic, t| frames_until(topic, t) && t < start + 1.2);
    restamped(&long, |t| t, frames_until);
    let run = |log: &Path| {
        let out = folder.path().join("out");
        succeed(&["replay", text(log), "--no-recording", "--out", text(&out)]);
        std::fs::read(out.join("trajectory.tum")).unwrap()
    };
    assert!(run(&short) == run(&long));
}

#[test]
fn the_reference_of_an_imu_serves_a_run_without_it() {
    let metrics = json(&[
        "replay",
        text(simulated_log()),
        "--set",
        "log.imu_topic=none",
        "--no-recording",
        "--json",
    ]);
    assert_eq!(metrics["has_imu"], false);
    let attitude = metrics["evaluation"]["ape_rotation_deg"]["rmse"].as_f64().unwrap();
    let position = metrics["evaluation"]["ape_translation"]["rmse"].as_f64().unwrap();
    assert!(attitude < 3.0 && position < 0.02, "{attitude} deg, {position} m");
}

#[test]
fn help_is_printed_and_wrong_usage_is_told_apart() {
    assert!(succeed(&["--help"]).contains("Usage"));
    assert!(succeed(&["--version"]).starts_with("mfg-vio "));
    assert_eq!(mfg_vio(&["--nonsense"]).status.code(), Some(2));
    assert_eq!(mfg_vio(&[]).status.code(), Some(2));
}
