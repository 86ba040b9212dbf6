//! Small logs for tests, written by the book.

use std::io::Write;
use std::path::PathBuf;

use super::{Event, Log};

/// A message as it is logged.
#[derive(Debug, Clone)]
pub struct Sample {
    pub topic: &'static str,
    pub schema: &'static str,
    pub body: Vec<u8>,
}

pub const COLOR: &str = "/cam0/color";
pub const DEPTH: &str = "/cam0/depth";
pub const IMU: &str = "/imu";
pub const TRUTH: &str = "/truth";

/// Writes fields one after the other, as ROS 1 or little-endian CDR.
struct Body {
    bytes: Vec<u8>,
    cdr: bool,
}

impl Body {
    fn new(cdr: bool, millis: i64) -> Self {
        let mut body = Self { bytes: Vec::new(), cdr };
        if !cdr {
            body.number(7_u32.to_le_bytes());
        }
        body.number(((millis / 1000) as u32).to_le_bytes());
        body.number(((millis % 1000 * 1_000_000) as u32).to_le_bytes());
        body.text("frame");
        body
    }

    fn number<const N: usize>(&mut self, bytes: [u8; N]) {
        if self.cdr {
            self.bytes.resize(self.bytes.len().next_multiple_of(N), 0);
        }
        self.bytes.extend(bytes);
    }

    fn numbers(&mut self, numbers: &[f64]) {
        numbers.iter().for_each(|number| self.number(number.to_le_bytes()));
    }

    fn sequence(&mut self, bytes: &[u8]) {
        self.number((bytes.len() as u32).to_le_bytes());
        self.bytes.extend(bytes);
    }

    fn text(&mut self, text: &str) {
        let end = if self.cdr { "\0" } else { "" };
        self.sequence(format!("{text}{end}").as_bytes());
    }

    fn finish(self) -> Vec<u8> {
        if self.cdr { [vec![0, 1, 0, 0], self.bytes].concat() } else { self.bytes }
    }
}

/// An image of 4x2 pixels, filled with `value`.
pub fn image(
    cdr: bool,
    topic: &'static str,
    encoding: &str,
    pixel_size: u32,
    millis: i64,
    value: u8,
) -> Sample {
    let mut body = Body::new(cdr, millis);
    body.number(2_u32.to_le_bytes());
    body.number(4_u32.to_le_bytes());
    body.text(encoding);
    body.number([0]);
    body.number((4 * pixel_size).to_le_bytes());
    body.sequence(&vec![value; (8 * pixel_size) as usize]);
    Sample { topic, schema: "sensor_msgs/Image", body: body.finish() }
}

pub fn imu(cdr: bool, millis: i64, acceleration: f64) -> Sample {
    let mut body = Body::new(cdr, millis);
    body.numbers(&[0.0; 13]);
    body.numbers(&[0.1, 0.2, 0.3]);
    body.numbers(&[0.0; 9]);
    body.numbers(&[0.0, 0.0, acceleration]);
    body.numbers(&[0.0; 9]);
    Sample { topic: IMU, schema: "sensor_msgs/Imu", body: body.finish() }
}

pub fn pose(cdr: bool, millis: i64, x: f64) -> Sample {
    let mut body = Body::new(cdr, millis);
    body.numbers(&[x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
    Sample { topic: TRUTH, schema: "geometry_msgs/PoseStamped", body: body.finish() }
}

/// Five frames at 10 Hz, the IMU in g at 100 Hz, truth at 20 Hz.
pub fn recording(cdr: bool) -> Vec<Sample> {
    let mut samples = Vec::new();
    for millis in (1000..1500).step_by(10) {
        samples.push(imu(cdr, millis, -1.0));
        if millis % 50 == 0 {
            samples.push(pose(cdr, millis, millis as f64));
        }
        if millis % 100 == 0 {
            let value = (millis / 100) as u8;
            samples.push(image(cdr, DEPTH, "16UC1", 2, millis + 1, value));
            samples.push(image(cdr, COLOR, "8UC3", 3, millis, value));
        }
    }
    samples
}

fn record(fields: &[(&str, &[u8])], data: &[u8]) -> Vec<u8> {
    let header = fields.iter().flat_map(|(name, value)| {
        let field = [name.as_bytes(), b"=", value].concat();
        [&(field.len() as u32).to_le_bytes()[..], &field].concat()
    });
    let header: Vec<u8> = header.collect();
    [&(header.len() as u32).to_le_bytes()[..], &header, &(data.len() as u32).to_le_bytes(), data]
        .concat()
}

fn connection(id: u32, sample: &Sample) -> Vec<u8> {
    let fields = [("type", sample.schema.as_bytes()), ("md5sum", b"*"), ("topic", b"")];
    let data = record(&fields, &[]);
    let data = &data[4..data.len() - 4];
    let id = id.to_le_bytes();
    record(&[("op", &[7]), ("conn", &id), ("topic", sample.topic.as_bytes())], data)
}

/// A ROS 1 bag with `per_chunk` messages a chunk, and where each message ends in it (of use
/// only without compression).
pub fn bag(
    samples: &[Sample],
    compression: &str,
    per_chunk: usize,
    indexed: bool,
) -> (Vec<u8>, Vec<usize>) {
    let header = |index: u64| {
        let fields: [(&str, &[u8]); 4] = [
            ("op", &[3]),
            ("index_pos", &index.to_le_bytes()),
            ("conn_count", &4_u32.to_le_bytes()),
            ("chunk_count", &1_u32.to_le_bytes()),
        ];
        [b"#ROSBAG V2.0\n".to_vec(), record(&fields, &[b' '; 100])].concat()
    };
    let mut topics: Vec<&Sample> = Vec::new();
    let (mut bytes, mut ends) = (header(0), Vec::new());
    for group in samples.chunks(per_chunk) {
        let (mut chunk, mut chunk_ends) = (Vec::new(), Vec::new());
        for sample in group {
            let known = topics.iter().position(|known| known.topic == sample.topic);
            let id = known.unwrap_or(topics.len()) as u32;
            if known.is_none() {
                topics.push(sample);
                chunk.extend(connection(id, sample));
            }
            let (id, time) = (id.to_le_bytes(), [0; 8]);
            chunk.extend(record(&[("op", &[2]), ("conn", &id), ("time", &time)], &sample.body));
            chunk_ends.push(chunk.len());
        }
        let size = (chunk.len() as u32).to_le_bytes();
        let content = compress(compression, &chunk);
        let fields: [(&str, &[u8]); 3] =
            [("op", &[5]), ("compression", compression.as_bytes()), ("size", &size)];
        let chunk = record(&fields, &content);
        let start = bytes.len() + chunk.len() - content.len();
        ends.extend(chunk_ends.iter().map(|end| start + end));
        bytes.extend(chunk);
        bytes.extend(record(&[("op", &[4]), ("ver", &[1, 0, 0, 0])], &[0; 24]));
    }
    if indexed {
        let start = header(bytes.len() as u64);
        bytes[..start.len()].copy_from_slice(&start);
        let connections = topics.iter().enumerate();
        connections.for_each(|(id, sample)| bytes.extend(connection(id as u32, sample)));
        bytes.extend(record(&[("op", &[6])], &[0; 8]));
    }
    (bytes, ends)
}

fn compress(compression: &str, data: &[u8]) -> Vec<u8> {
    match compression {
        "bz2" => {
            let mut encoder = bzip2::write::BzEncoder::new(Vec::new(), Default::default());
            encoder.write_all(data).unwrap();
            encoder.finish().unwrap()
        }
        "lz4" => {
            let mut encoder = lz4::EncoderBuilder::new().build(Vec::new()).unwrap();
            encoder.write_all(data).unwrap();
            encoder.finish().0
        }
        _ => data.to_vec(),
    }
}

/// An MCAP file; `encoding` is `"ros1"` or `"cdr"`.
pub fn mcap(samples: &[Sample], encoding: &str, options: mcap::WriteOptions) -> Vec<u8> {
    let mut writer = options.create(std::io::Cursor::new(Vec::new())).unwrap();
    let mut channels = std::collections::BTreeMap::new();
    for (number, sample) in samples.iter().enumerate() {
        let channel_id = *channels.entry(sample.topic).or_insert_with(|| {
            let schema = match encoding {
                "cdr" => sample.schema.replace('/', "/msg/"),
                _ => sample.schema.to_owned(),
            };
            let schema = writer.add_schema(&schema, "ros1msg", b"").unwrap();
            writer.add_channel(schema, sample.topic, encoding, &Default::default()).unwrap()
        });
        let time = number as u64;
        let sequence = number as u32;
        let header = mcap::records::MessageHeader {
            channel_id,
            sequence,
            log_time: time,
            publish_time: time,
        };
        writer.write_to_known_channel(&header, &sample.body).unwrap();
    }
    writer.finish().unwrap();
    writer.into_inner().into_inner()
}

/// A file that lives as long as the folder.
pub fn file(folder: &tempfile::TempDir, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    path
}

/// All events of a log of one run; checks their order and the report's counts.
pub fn read_all(log: &mut dyn Log) -> Vec<Event> {
    let events = read_runs(log);
    assert!(events.windows(2).all(|pair| pair[0].stamp() <= pair[1].stamp()));
    events
}

/// All events of a log whose clocks may be set back, where a new run begins; checks the report's
/// counts.
pub fn read_runs(log: &mut dyn Log) -> Vec<Event> {
    let events: Vec<_> = std::iter::from_fn(|| log.next_event()).collect();
    let report = log.report();
    let count = |is: fn(&Event) -> bool| events.iter().filter(|event| is(event)).count() as u64;
    assert_eq!(report.frames, count(|event| matches!(event, Event::Frame(_))));
    assert_eq!(report.imu_samples, count(|event| matches!(event, Event::Imu(_))));
    assert_eq!(report.truth_poses, count(|event| matches!(event, Event::Truth(_))));
    events
}

/// A folder of the real recordings; says so where it is absent.
pub fn data(name: &str) -> Option<PathBuf> {
    let default = concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/data");
    let root = std::env::var_os("MFG_VIO_DATA").unwrap_or_else(|| default.into());
    let path = PathBuf::from(root).join(name);
    if !path.is_dir() {
        eprintln!("SKIPPED: no real data at {}", path.display());
        return None;
    }
    Some(path)
}
