//! What the targets have in common: bytes as a log, read in every way there is.

use std::ops::ControlFlow;
use std::path::Path;

use mfg_vio::dataset::{Assumed, LogConfig, convert, inspect, open};
use mfg_vio::inertial::ImuConfig;
use mfg_vio::sensor::CameraConfig;

/// Writes `bytes` to a file, after `magic` where they do not begin so, and reads it.
pub fn file(magic: &[u8], bytes: &[u8]) {
    let folder = tempfile::tempdir().expect("a temporary directory");
    let path = folder.path().join("log");
    let prefix = if bytes.starts_with(magic) { &[][..] } else { magic };
    std::fs::write(&path, [prefix, bytes].concat()).expect("a temporary file");
    read(&path);
}

/// Opens, inspects and converts a log.
pub fn read(path: &Path) {
    let (config, imu) = (LogConfig::default(), ImuConfig::default());
    let without_images = LogConfig {
        color_topic: "none".to_owned(),
        depth_topic: "none".to_owned(),
        ..LogConfig::default()
    };
    for config in [&config, &without_images] {
        if let Ok(mut log) = open(path, config, &imu) {
            let mut last = None;
            while let Some(event) = log.next_event() {
                assert!(Some(event.stamp()) >= last, "events out of order");
                last = Some(event.stamp());
            }
        }
    }
    let assumed = Assumed { log: &config, imu: &imu, body_from_camera: None };
    let _ = inspect(path, &assumed);
    let output = path.with_extension("mcap.out");
    let go_on = || ControlFlow::Continue(());
    let _ = convert(path, &output, &config, &CameraConfig::default(), go_on);
}
