//! ROS 2 messages and their containers as drivers and recorders write them, for tests of what is
//! read: the fixtures are made of a simulated log.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use mfg_vio::dataset::{LogConfig, open};
use mfg_vio::inertial::ImuConfig;
use mfg_vio::sensor::{Event, ImuSample, RgbdFrame, Stamp};
use nalgebra::Vector3;

use super::simulated_log;

/// A message as it is logged, in CDR.
#[derive(Debug, Clone)]
pub struct Message {
    pub topic: String,
    /// As `sensor_msgs/msg/Imu`.
    pub schema: String,
    /// Log time, ns.
    pub time: i64,
    pub body: Vec<u8>,
}

impl Message {
    pub fn new(topic: &str, schema: &str, stamp: Stamp, body: Body) -> Self {
        let (topic, schema) = (topic.to_owned(), format!("sensor_msgs/msg/{schema}"));
        Self { topic, schema, time: stamp.nanos(), body: body.finish() }
    }
}

/// Fields of a message one after the other, in little-endian CDR.
pub struct Body(Vec<u8>);

impl Body {
    /// Begins with a header.
    pub fn new(stamp: Stamp, frame: &str) -> Self {
        let nanos = stamp.nanos();
        Self(Vec::new())
            .number((nanos.div_euclid(1_000_000_000) as i32).to_le_bytes())
            .number((nanos.rem_euclid(1_000_000_000) as u32).to_le_bytes())
            .text(frame)
    }

    pub fn number<const N: usize>(mut self, bytes: [u8; N]) -> Self {
        self.0.resize(self.0.len().next_multiple_of(N), 0);
        self.0.extend(bytes);
        self
    }

    pub fn numbers(self, numbers: impl IntoIterator<Item = f64>) -> Self {
        numbers.into_iter().fold(self, |body, number| body.number(number.to_le_bytes()))
    }

    pub fn bytes(self, bytes: &[u8]) -> Self {
        let mut body = self.number((bytes.len() as u32).to_le_bytes());
        body.0.extend(bytes);
        body
    }

    pub fn text(self, text: &str) -> Self {
        self.bytes(format!("{text}\0").as_bytes())
    }

    fn finish(self) -> Vec<u8> {
        [&[0, 1, 0, 0], self.0.as_slice()].concat()
    }
}

pub fn image(
    topic: &str,
    stamp: Stamp,
    encoding: &str,
    (width, height): (usize, usize),
    data: &[u8],
) -> Message {
    let body = Body::new(stamp, "camera")
        .number((height as u32).to_le_bytes())
        .number((width as u32).to_le_bytes())
        .text(encoding)
        .number([0])
        .number(((data.len() / height) as u32).to_le_bytes())
        .bytes(data);
    Message::new(topic, "Image", stamp, body)
}

pub fn compressed(topic: &str, stamp: Stamp, format: &str, data: &[u8]) -> Message {
    let body = Body::new(stamp, "camera").text(format).bytes(data);
    Message::new(topic, "CompressedImage", stamp, body)
}

/// `sensor_msgs/CameraInfo` of a pinhole camera (fx, fy, cx, cy) without distortion.
pub fn camera_info(
    topic: &str,
    stamp: Stamp,
    (width, height): (usize, usize),
    [fx, fy, cx, cy]: [f64; 4],
) -> Message {
    let body = Body::new(stamp, "camera")
        .number((height as u32).to_le_bytes())
        .number((width as u32).to_le_bytes())
        .text("plumb_bob")
        .number(0_u32.to_le_bytes())
        .numbers([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])
        .numbers([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
        .numbers([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]);
    // Binning and region of interest.
    let body = (0..6).fold(body, |body, _| body.number(0_u32.to_le_bytes())).number([0]);
    Message::new(topic, "CameraInfo", stamp, body)
}

/// `sensor_msgs/Imu`; the first number of each half's covariance marks what is not measured.
pub fn imu(
    topic: &str,
    stamp: Stamp,
    (rate, rate_covariance): (Vector3<f64>, f64),
    (force, force_covariance): (Vector3<f64>, f64),
) -> Message {
    let covariance = |first: f64| [first, 0.0, 0.0, 0.0, first.abs(), 0.0, 0.0, 0.0, first.abs()];
    let body = Body::new(stamp, "imu")
        .numbers([0.0, 0.0, 0.0, 1.0])
        .numbers(covariance(-1.0))
        .numbers(rate.iter().copied())
        .numbers(covariance(rate_covariance))
        .numbers(force.iter().copied())
        .numbers(covariance(force_covariance));
    Message::new(topic, "Imu", stamp, body)
}

/// A simulated recording in pieces.
pub struct Recording {
    pub frames: Vec<RgbdFrame>,
    pub imu: Vec<ImuSample>,
    /// Its other messages: calibration, transforms, reference.
    pub rest: Vec<Message>,
}

/// The pieces of [`simulated_log`].
pub fn recording() -> &'static Recording {
    static RECORDING: OnceLock<Recording> = OnceLock::new();
    RECORDING.get_or_init(|| {
        let mut log = open(simulated_log(), &LogConfig::default(), &ImuConfig::default()).unwrap();
        let (mut frames, mut imu) = (Vec::new(), Vec::new());
        while let Some(event) = log.next_event() {
            match event {
                Event::Frame(frame) => frames.push(*frame),
                Event::Imu(sample) => imu.push(sample),
                Event::Repeated(..) => {}
                Event::Truth(_) => {}
            }
        }
        let bytes = std::fs::read(simulated_log()).unwrap();
        let messages = mcap::MessageStream::new(&bytes).unwrap().map(|message| {
            let message = message.unwrap();
            let schema = message.channel.schema.as_ref().unwrap().name.clone();
            let topic = message.channel.topic.clone();
            Message { topic, schema, time: message.log_time as i64, body: message.data.to_vec() }
        });
        let is_stream = |schema: &str| schema.ends_with("/Image") || schema.ends_with("/Imu");
        let rest = messages.filter(|message| !is_stream(&message.schema)).collect();
        Recording { frames, imu, rest }
    })
}

impl Recording {
    /// All messages, with its streams written by other functions.
    pub fn messages(
        &self,
        mut color: impl FnMut(&RgbdFrame) -> Message,
        mut depth: impl FnMut(&RgbdFrame) -> Message,
        imu: impl FnMut(&ImuSample) -> Vec<Message>,
    ) -> Vec<Message> {
        let images = self.frames.iter().flat_map(|frame| [color(frame), depth(frame)]);
        let imu = self.imu.iter().flat_map(imu);
        let mut messages: Vec<Message> =
            images.chain(imu).chain(self.rest.iter().cloned()).collect();
        messages.sort_by_key(|message| message.time);
        messages
    }
}

pub fn plain_color(frame: &RgbdFrame) -> Message {
    let color = &frame.color;
    image("/cam0/color", frame.stamp, "rgb8", (color.width(), color.height()), color.data())
}

pub fn depth_bytes(frame: &RgbdFrame) -> Vec<u8> {
    frame.depth.data().iter().flat_map(|raw| raw.to_le_bytes()).collect()
}

pub fn plain_depth(frame: &RgbdFrame) -> Message {
    let size = (frame.depth.width(), frame.depth.height());
    image("/cam0/depth", frame.stamp, "16UC1", size, &depth_bytes(frame))
}

pub fn plain_imu(sample: &ImuSample) -> Vec<Message> {
    let ImuSample { stamp, angular_velocity, specific_force } = *sample;
    vec![imu("/imu", stamp, (angular_velocity, 0.0), (specific_force, 0.0))]
}

pub fn mcap_bytes(messages: &[Message]) -> Vec<u8> {
    let options = mcap::WriteOptions::new().compression(Some(mcap::Compression::Zstd));
    let mut writer = options.create(Cursor::new(Vec::new())).unwrap();
    let mut channels: BTreeMap<&str, u16> = BTreeMap::new();
    for (sequence, message) in messages.iter().enumerate() {
        let id = channels.entry(message.topic.as_str()).or_insert_with(|| {
            let schema = writer.add_schema(&message.schema, "ros2msg", b"").unwrap();
            writer.add_channel(schema, &message.topic, "cdr", &BTreeMap::new()).unwrap()
        });
        let time = message.time as u64;
        let header = mcap::records::MessageHeader {
            channel_id: *id,
            sequence: sequence as u32,
            log_time: time,
            publish_time: time,
        };
        writer.write_to_known_channel(&header, &message.body).unwrap();
    }
    writer.finish().unwrap();
    writer.into_inner().into_inner()
}

pub fn write_mcap(path: &Path, messages: &[Message]) -> PathBuf {
    std::fs::write(path, mcap_bytes(messages)).unwrap();
    path.to_owned()
}

/// A database of the first version of the format.
pub fn write_db3(path: &Path, messages: &[Message]) -> PathBuf {
    let mut database = rusqlite::Connection::open(path).unwrap();
    let tables = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, \
                  serialization_format TEXT NOT NULL);\
                  CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, \
                  timestamp INTEGER NOT NULL, data BLOB NOT NULL);";
    database.execute_batch(tables).unwrap();
    let transaction = database.transaction().unwrap();
    let mut topics: BTreeMap<&str, i64> = BTreeMap::new();
    for message in messages {
        let next = topics.len() as i64 + 1;
        let topic = *topics.entry(message.topic.as_str()).or_insert_with(|| {
            let row = (next, &message.topic, &message.schema);
            transaction.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr')", row).unwrap();
            next
        });
        let row = (topic, message.time, &message.body);
        let insert = "INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)";
        transaction.execute(insert, row).unwrap();
    }
    transaction.commit().unwrap();
    path.to_owned()
}
