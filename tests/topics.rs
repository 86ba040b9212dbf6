//! Which of several topics of a type is taken, and that it is said.
#![cfg(feature = "vision")]

mod support;

use std::path::Path;

use serde_json::Value;
use support::messages::{self, Message};
use support::{json, mfg_vio, text};

fn info(log: &Path) -> Value {
    json(&["info", text(log), "--json"])
}

/// A copy of the simulated log with messages added to it.
fn with_added(copy: &Path, add: impl Fn(&Message, usize) -> Vec<Message>) {
    let mut all = messages::read(support::simulated_log());
    let added: Vec<_> = all.iter().enumerate().flat_map(|(k, message)| add(message, k)).collect();
    all.extend(added);
    messages::write(copy, all);
}

fn named(message: &Message, topic: &str) -> Message {
    Message { topic: topic.to_owned(), ..message.clone() }
}

#[test]
fn goals_and_estimates_are_no_reference() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("log.mcap");
    with_added(&log, |message, _| match message.topic.as_str() {
        "/truth/pose" => {
            ["/goal_pose", "/a/slam/pose", "/a/cmd/pose"].map(|t| named(message, t)).into()
        }
        _ => vec![],
    });
    assert_eq!(info(&log)["sources"]["truth"], "/truth/pose");
    // Without the reference there is none.
    let bare = folder.path().join("bare.mcap");
    messages::changed(&log, &bare, |message| {
        message.topic != "/truth/pose" && message.topic != "/tf"
    });
    let found = info(&bare);
    assert_eq!(
        (&found["sources"]["truth"], &found["has_truth"]),
        (&Value::Null, &Value::from(false))
    );
}

#[test]
fn the_faster_imu_is_taken_and_the_other_one_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("log.mcap");
    with_added(&log, |message, number| match message.topic.as_str() {
        "/imu" if number % 4 == 0 => vec![named(message, "/a_imu")],
        _ => vec![],
    });
    let found = info(&log);
    assert_eq!(found["sources"]["imu"], "/imu");
    assert!(found["others"]["imu"][0].as_str().unwrap().starts_with("/a_imu ("), "{found:#}");
    let output = mfg_vio(&["replay", text(&log), "--no-recording", "--duration", "0.5"]);
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    let line = told.lines().find(|line| line.contains("not /a_imu")).unwrap_or_default();
    assert!(line.contains("/imu (200 Hz)") && line.contains("(log.imu_topic)"), "{told}");
    // Said otherwise, the other one is taken.
    let chosen = json(&["info", text(&log), "--json", "--set", "log.imu_topic=/a_imu"]);
    assert_eq!(chosen["sources"]["imu"], "/a_imu");
}

#[test]
fn images_that_were_drawn_on_are_not_looked_at() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("log.mcap");
    with_added(&log, |message, _| match message.topic.as_str() {
        "/cam0/color" => {
            ["/a/debug/image", "/a/infra1/image_raw"].map(|t| named(message, t)).into()
        }
        "/cam0/depth" => vec![named(message, "/a/confidence/map")],
        _ => vec![],
    });
    let sources = &info(&log)["sources"];
    assert_eq!(sources["color"], "/cam0/color");
    assert_eq!(sources["depth"], "/cam0/depth");
}
