//! MCAP files. Format: <https://mcap.dev/spec>.
//!
//! The readers of the crate `mcap` want the whole file mapped, overflow on damaged lengths or
//! reserve as much memory as these claim; of it, only names of records are used here.

use std::collections::BTreeMap;
use std::io::{self, BufRead, Read};

use mcap::records::op;

use super::message::{MessageType, Serialization};
use super::records::{ChunkHead, Format, MessageHead, RecordHead, RecordKind, Records};
use super::ros::Channel;
use super::section::{LogFile, fill, invalid, read_array, skip};
use crate::sensor::Stamp;

/// The messages of an MCAP file.
pub(super) type McapFile = Records<McapFormat>;

/// Opcode and length of a record, bytes.
const HEAD_SIZE: u64 = 9;

/// Channel, sequence number and two times before the content of a message, bytes.
const MESSAGE_HEAD_SIZE: u64 = 22;

/// A chunk's fields before its records without the name of the compression, bytes.
const CHUNK_HEAD_SIZE: u64 = 8 + 8 + 8 + 4 + 4 + 8;

/// Names of compressions longer than this are taken for damage, bytes.
const LARGEST_NAME: u32 = 64;

#[derive(Default)]
pub(super) struct McapFormat {
    /// Name and definition.
    schemas: BTreeMap<u16, (String, String)>,
    channels: BTreeMap<u32, Channel>,
    /// Of the record read last.
    opcode: u8,
}

impl Format for McapFormat {
    const MAGIC: &'static [u8] = mcap::MAGIC;
    const CUT: &'static str = "mcap: cut short";
    const DAMAGED: &'static str = "mcap: chunk damaged or cut short";
    const UNKNOWN_CHANNEL: &'static str = "mcap: message of an unknown channel";
    const HAS_END: bool = true;

    fn read_head(&mut self, reader: &mut impl BufRead) -> io::Result<Option<RecordHead>> {
        if reader.fill_buf()?.is_empty() {
            return Ok(None);
        }
        [self.opcode] = read_array(reader)?;
        let length = u64::from_le_bytes(read_array(reader)?);
        let kind = match self.opcode {
            op::CHUNK => RecordKind::Chunk,
            op::MESSAGE => RecordKind::Message,
            op::SCHEMA | op::CHANNEL => RecordKind::Declaration,
            op::DATA_END | op::FOOTER => RecordKind::End,
            _ => RecordKind::Other,
        };
        Ok(Some(RecordHead { kind, size: HEAD_SIZE, length }))
    }

    fn read_chunk_head(&mut self, reader: &mut impl Read, _length: u64) -> io::Result<ChunkHead> {
        let _times_and_size: [u8; 24] = read_array(reader)?;
        let checksum = u32::from_le_bytes(read_array(reader)?);
        let name_length = u32::from_le_bytes(read_array(reader)?);
        if name_length > LARGEST_NAME {
            return Err(invalid(format!("a compression name of {name_length} bytes")));
        }
        let mut compression = Vec::new();
        fill(reader, name_length.into(), &mut compression)?;
        let compression = String::from_utf8(compression).map_err(io::Error::other)?;
        Ok(ChunkHead {
            size: CHUNK_HEAD_SIZE + u64::from(name_length),
            length: u64::from_le_bytes(read_array(reader)?),
            compression,
            checksum: (checksum != 0).then_some(checksum),
        })
    }

    fn read_message_head(&mut self, reader: &mut impl Read) -> io::Result<MessageHead> {
        let channel = u16::from_le_bytes(read_array(reader)?);
        let _sequence: [u8; 4] = read_array(reader)?;
        let log_time = u64::from_le_bytes(read_array(reader)?);
        let _publish_time: [u8; 8] = read_array(reader)?;
        Ok(MessageHead {
            channel: Some(channel.into()),
            log_time: Stamp::from_nanos(i64::try_from(log_time).unwrap_or(i64::MAX)),
            size: MESSAGE_HEAD_SIZE,
        })
    }

    fn declare(&mut self, mut body: &[u8]) -> io::Result<()> {
        let body = &mut body;
        let id = u16::from_le_bytes(read_array(body)?);
        if self.opcode == op::SCHEMA {
            let (name, _encoding) = (text(body)?, text(body)?);
            let definition = String::from_utf8_lossy(sized(body)?).into_owned();
            self.schemas.entry(id).or_insert((name, definition));
            return Ok(());
        }
        let schema = self.schemas.get(&u16::from_le_bytes(read_array(body)?)).cloned();
        let (schema, definition) = schema.unwrap_or_default();
        let (topic, encoding) = (text(body)?, text(body)?);
        let serialization = match encoding.as_str() {
            "ros1" => Some(Serialization::Ros1),
            "cdr" => Some(Serialization::Cdr),
            _ => None,
        };
        let mut notes = sized(body)?;
        let mut metadata = BTreeMap::new();
        while !notes.is_empty() {
            metadata.insert(text(&mut notes)?, text(&mut notes)?);
        }
        let kind = MessageType::from_name(&schema);
        self.channels.entry(id.into()).or_insert(Channel {
            topic,
            schema,
            definition,
            kind,
            serialization,
            metadata,
        });
        Ok(())
    }

    fn read_index(&mut self, file: &LogFile) -> io::Result<bool> {
        /// A footer record and the magic that follows it, bytes.
        const FOOTER_SIZE: u64 = HEAD_SIZE + 20 + mcap::MAGIC.len() as u64;

        let Some(footer_start) = file.size().checked_sub(FOOTER_SIZE) else { return Ok(false) };
        let mut footer = file.records(footer_start);
        let head = self.read_head(&mut footer)?;
        if self.opcode != op::FOOTER || head.is_none_or(|head| head.length != 20) {
            return Ok(false);
        }
        let summary_start = u64::from_le_bytes(read_array(&mut footer)?);
        if summary_start <= Self::MAGIC.len() as u64 || summary_start >= footer_start {
            return Ok(false);
        }
        let mut summary = file.records(summary_start);
        let mut body = Vec::new();
        while let Some(RecordHead { kind, length, .. }) = self.read_head(&mut summary)? {
            match kind {
                RecordKind::End => break,
                RecordKind::Declaration => {
                    fill(&mut summary, length, &mut body)?;
                    self.declare(&body)?;
                }
                _ => skip(&mut summary, length)?,
            }
        }
        Ok(true)
    }

    fn channels(&self) -> &BTreeMap<u32, Channel> {
        &self.channels
    }
}

/// A sequence of bytes after its length.
fn sized<'a>(body: &mut &'a [u8]) -> io::Result<&'a [u8]> {
    let length = u32::from_le_bytes(read_array(body)?);
    body.split_off(..length as usize)
        .ok_or_else(|| invalid(format!("{length} bytes in a record that has {}", body.len())))
}

fn text(body: &mut &[u8]) -> io::Result<String> {
    std::str::from_utf8(sized(body)?).map(str::to_owned).map_err(io::Error::other)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn declared(opcode: u8, body: &[u8]) -> Result<McapFormat, String> {
        let mut format = McapFormat { opcode, ..McapFormat::default() };
        format.declare(body).map(|()| format).map_err(|error| error.to_string())
    }

    #[test]
    fn channels_are_declared_with_their_notes() {
        let body = b"\x07\0\0\0\x02\0\0\0/a\x03\0\0\0cdr\x0a\0\0\0\x01\0\0\0k\x01\0\0\0v";
        let format = declared(op::CHANNEL, body).unwrap();
        let channel = &format.channels[&7];
        assert_eq!(
            (channel.topic.as_str(), channel.serialization),
            ("/a", Some(Serialization::Cdr))
        );
        assert_eq!(channel.metadata, BTreeMap::from([("k".to_owned(), "v".to_owned())]));
    }

    /// A fuzzer found a length for which the crate `mcap` reserved 4 GB.
    #[test]
    fn lengths_beyond_the_record_take_no_memory() {
        let error = declared(op::SCHEMA, b"\x01\0\xfe\xff\xff\xffsensor_msgs/Image").err();
        assert_eq!(error.unwrap(), "4294967294 bytes in a record that has 17");
        let cut = declared(op::CHANNEL, b"\x07\0\0\0\x02\0\0\0/a\x03\0\0\0cdr\xff\0\0\0k").err();
        assert_eq!(cut.unwrap(), "255 bytes in a record that has 1");
    }
}
