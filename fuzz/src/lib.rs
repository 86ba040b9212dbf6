//! What the targets have in common: bytes as a log, read in every way there is.

use std::collections::BTreeMap;
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
    let assumed = Assumed::new(&config, &imu);
    let _ = inspect(path, &assumed);
    let output = path.with_extension("mcap.out");
    let go_on = || ControlFlow::Continue(());
    let _ = convert(path, &output, &config, &CameraConfig::default(), go_on);
}

/// Fields of a message in little-endian CDR, after a header.
pub struct Body(Vec<u8>);

impl Default for Body {
    fn default() -> Self {
        Self(vec![0; 8]).text("frame")
    }
}

impl Body {
    pub fn new() -> Self {
        Self::default()
    }

    pub fn number(mut self, number: u32) -> Self {
        self.0.resize(self.0.len().next_multiple_of(4), 0);
        self.0.extend(number.to_le_bytes());
        self
    }

    pub fn byte(mut self, byte: u8) -> Self {
        self.0.push(byte);
        self
    }

    pub fn bytes(self, bytes: &[u8]) -> Self {
        let mut body = self.number(bytes.len() as u32);
        body.0.extend(bytes);
        body
    }

    pub fn text(self, text: &str) -> Self {
        self.bytes(format!("{text}\0").as_bytes())
    }
}

/// Reads a log of one message as color and as depth.
pub fn one_message(schema: &str, body: Body) {
    let file = tempfile::NamedTempFile::new().expect("a temporary file");
    let handle = file.reopen().expect("the same file");
    let options = mcap::WriteOptions::new().compression(None);
    let mut writer = options.create(std::io::BufWriter::new(handle)).expect("a log");
    let schema = writer.add_schema(schema, "ros2msg", b"").expect("a schema");
    let data = [&[0, 1, 0, 0], body.0.as_slice()].concat();
    for topic in ["/color", "/depth"] {
        let channel = writer.add_channel(schema, topic, "cdr", &BTreeMap::new()).expect("a channel");
        let header = mcap::records::MessageHeader {
            channel_id: channel,
            sequence: 0,
            log_time: 0,
            publish_time: 0,
        };
        writer.write_to_known_channel(&header, &data).expect("a message");
    }
    writer.finish().expect("a log");
    drop(writer);
    read(file.path());
}
