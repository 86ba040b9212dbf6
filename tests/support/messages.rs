//! Logs made of other logs: messages left out, added and changed as other recorders would have them.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

/// A message of an MCAP file with ROS 2 messages.
#[derive(Debug, Clone)]
pub struct Message {
    pub topic: String,
    /// Name and text of the type.
    pub schema: (String, String),
    /// ns
    pub time: u64,
    /// CDR with its head of four bytes.
    pub data: Vec<u8>,
}

pub fn read(log: &Path) -> Vec<Message> {
    let bytes = std::fs::read(log).expect("a readable log");
    let messages = mcap::MessageStream::new(&bytes).expect("an MCAP file");
    let message = |message: mcap::McapResult<mcap::Message>| {
        let message = message.expect("a whole message");
        let schema = message.channel.schema.clone().expect("a schema");
        Message {
            topic: message.channel.topic.clone(),
            schema: (schema.name.clone(), String::from_utf8_lossy(&schema.data).into_owned()),
            time: message.log_time,
            data: message.data.into_owned(),
        }
    };
    messages.map(message).collect()
}

/// Writes messages in the order of their times, without the notes of whoever wrote them first.
pub fn write(log: &Path, mut messages: Vec<Message>) {
    messages.sort_by_key(|message| message.time);
    let file = std::io::BufWriter::new(std::fs::File::create(log).expect("a writable file"));
    let mut writer = mcap::Writer::new(file).expect("an MCAP file");
    let mut channels = BTreeMap::new();
    for (sequence, message) in messages.into_iter().enumerate() {
        let number = channels.len() as u16;
        let channel = channels.entry(message.topic.clone()).or_insert_with(|| {
            let schema = mcap::Schema {
                id: number + 1,
                name: message.schema.0.clone(),
                encoding: "ros2msg".to_owned(),
                data: Cow::Owned(message.schema.1.clone().into_bytes()),
            };
            Arc::new(mcap::Channel {
                id: number,
                topic: message.topic.clone(),
                schema: Some(Arc::new(schema)),
                message_encoding: "cdr".to_owned(),
                metadata: BTreeMap::new(),
            })
        });
        let message = mcap::Message {
            channel: Arc::clone(channel),
            sequence: sequence as u32,
            log_time: message.time,
            publish_time: message.time,
            data: Cow::Owned(message.data),
        };
        writer.write(&message).expect("a written message");
    }
    writer.finish().expect("a finished log");
}

/// A copy of a log, each of whose messages `change` may change or leave out.
pub fn changed(log: &Path, copy: &Path, mut change: impl FnMut(&mut Message) -> bool) {
    let kept =
        read(log).into_iter().filter_map(|mut message| change(&mut message).then_some(message));
    write(copy, kept.collect());
}

impl Message {
    pub fn is(&self, kind: &str) -> bool {
        self.schema.0.ends_with(kind)
    }

    /// The last bytes of `sensor_msgs/Imu` are: rates, their covariance, accelerations, theirs.
    pub fn rates(&self) -> [f64; 3] {
        self.numbers(192)
    }

    pub fn accelerations(&self) -> [f64; 3] {
        self.numbers(96)
    }

    pub fn set_imu(&mut self, rates: [f64; 3], accelerations: [f64; 3]) {
        self.set_numbers(192, rates);
        self.set_numbers(96, accelerations);
    }

    fn numbers(&self, from_end: usize) -> [f64; 3] {
        let start = self.data.len() - from_end;
        std::array::from_fn(|k| {
            let bytes = &self.data[start + 8 * k..start + 8 * k + 8];
            f64::from_le_bytes(bytes.try_into().expect("eight bytes"))
        })
    }

    fn set_numbers(&mut self, from_end: usize, values: [f64; 3]) {
        let start = self.data.len() - from_end;
        for (k, value) in values.iter().enumerate() {
            self.data[start + 8 * k..start + 8 * k + 8].copy_from_slice(&value.to_le_bytes());
        }
    }

    /// Adds to the stamp of the header, which comes first, s.
    pub fn delay(&mut self, seconds: i32) {
        let stamp = i32::from_le_bytes(self.data[4..8].try_into().expect("four bytes"));
        self.data[4..8].copy_from_slice(&(stamp + seconds).to_le_bytes());
    }
}
