//! ROS 1 bags. Format: <http://wiki.ros.org/Bags/Format/2.0>.

use std::collections::BTreeMap;
use std::io::{self, BufRead, Read};

use super::message::{MessageType, Serialization};
use super::records::{ChunkHead, Format, MessageHead, RecordHead, RecordKind, Records};
use super::ros::Channel;
use super::section::{LogFile, fill, invalid, read_array};
use crate::sensor::Stamp;

/// The messages of a bag.
pub(super) type Bag = Records<BagFormat>;

/// A record header larger than this is taken for damage, bytes.
const LARGEST_HEADER: u32 = 1 << 20;

/// Values of the header field `op`.
mod op {
    pub const MESSAGE: u8 = 0x02;
    pub const BAG: u8 = 0x03;
    pub const CHUNK: u8 = 0x05;
    pub const CONNECTION: u8 = 0x07;
}

#[derive(Default)]
pub(super) struct BagFormat {
    connections: BTreeMap<u32, Channel>,
    /// Fields of the record read last.
    header: Vec<u8>,
}

impl Format for BagFormat {
    const MAGIC: &'static [u8] = b"#ROSBAG V2.0\n";
    const CUT: &'static str = "bag: cut short";
    const DAMAGED: &'static str = "bag: chunk damaged or cut short";
    const UNKNOWN_CHANNEL: &'static str = "bag: message of an unknown connection";
    const HAS_END: bool = false;

    fn read_head(&mut self, reader: &mut impl BufRead) -> io::Result<Option<RecordHead>> {
        if reader.fill_buf()?.is_empty() {
            return Ok(None);
        }
        let size = u32::from_le_bytes(read_array(reader)?);
        if size > LARGEST_HEADER {
            return Err(invalid(format!("a record header of {size} bytes")));
        }
        fill(reader, size.into(), &mut self.header)?;
        let length = u32::from_le_bytes(read_array(reader)?);
        let kind = match number(&self.header, b"op") {
            Some([op::CHUNK]) => RecordKind::Chunk,
            Some([op::MESSAGE]) => RecordKind::Message,
            Some([op::CONNECTION]) => RecordKind::Declaration,
            _ => RecordKind::Other,
        };
        Ok(Some(RecordHead { kind, size: 8 + u64::from(size), length: length.into() }))
    }

    fn read_chunk_head(&mut self, _reader: &mut impl Read, length: u64) -> io::Result<ChunkHead> {
        let compression = field(&self.header, b"compression").unwrap_or(b"none");
        let compression = String::from_utf8_lossy(compression).into_owned();
        Ok(ChunkHead { size: 0, length, compression, checksum: None })
    }

    fn read_message_head(&mut self, _reader: &mut impl Read) -> io::Result<MessageHead> {
        let [seconds, nanos] = match number::<8>(&self.header, b"time") {
            Some([a, b, c, d, e, f, g, h]) => [[a, b, c, d], [e, f, g, h]],
            None => return Err(invalid("a message without a time".to_owned())),
        }
        .map(|part| i64::from(u32::from_le_bytes(part)));
        let channel = number(&self.header, b"conn").map(u32::from_le_bytes);
        Ok(MessageHead { channel, log_time: Stamp::from_parts(seconds, nanos), size: 0 })
    }

    fn declare(&mut self, body: &[u8]) -> io::Result<()> {
        let id = number(&self.header, b"conn").map(u32::from_le_bytes);
        let text = |value: &[u8]| String::from_utf8_lossy(value).into_owned();
        if let (Some(id), Some(topic), Some(schema)) =
            (id, field(&self.header, b"topic"), field(body, b"type"))
        {
            self.connections.entry(id).or_insert_with(|| Channel {
                topic: text(topic),
                schema: text(schema),
                definition: field(body, b"message_definition").map(text).unwrap_or_default(),
                kind: MessageType::from_name(&text(schema)),
                serialization: Some(Serialization::Ros1),
                metadata: BTreeMap::new(),
            });
        }
        Ok(())
    }

    fn read_index(&mut self, file: &LogFile) -> io::Result<bool> {
        let start = Self::MAGIC.len() as u64;
        self.read_head(&mut file.records(start))?;
        let header = (number(&self.header, b"op"), number(&self.header, b"index_pos"));
        let (Some([op::BAG]), Some(position)) = header else { return Ok(false) };
        let position = u64::from_le_bytes(position);
        if position <= start || position >= file.size() {
            return Ok(false);
        }
        let mut records = file.records(position);
        let mut body = Vec::new();
        while let Some(RecordHead { kind: RecordKind::Declaration, length, .. }) =
            self.read_head(&mut records)?
        {
            fill(&mut records, length, &mut body)?;
            self.declare(&body)?;
        }
        Ok(true)
    }

    fn channels(&self) -> &BTreeMap<u32, Channel> {
        &self.connections
    }
}

/// The value of a field of a header: a sequence of `length name=value`.
fn field<'a>(mut header: &'a [u8], name: &[u8]) -> Option<&'a [u8]> {
    while let Some((length, rest)) = header.split_first_chunk() {
        let (entry, rest) = rest.split_at_checked(u32::from_le_bytes(*length) as usize)?;
        if let Some(value) = entry.strip_prefix(name).and_then(|v| v.strip_prefix(b"=")) {
            return Some(value);
        }
        header = rest;
    }
    None
}

fn number<const N: usize>(header: &[u8], name: &[u8]) -> Option<[u8; N]> {
    field(header, name)?.try_into().ok()
}
