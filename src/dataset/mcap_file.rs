//! MCAP files, read record by record from the start; an index only tells the topics beforehand.
//!
//! Format: <https://mcap.dev/spec>. The readers of the crate `mcap` want the whole file mapped or
//! overflow on damaged lengths; of it, only the records are used here.

use std::collections::BTreeMap;
use std::io::{self, BufRead, BufReader};

use mcap::records::{Record, op};

use super::ReadReport;
use super::message::{MessageType, Serialization};
use super::ros::{Channel, MessageSource, Visitor};
use super::section::{Chunk, LogFile, Section, fill, invalid, read_array, skip};

pub(super) const MAGIC: &[u8] = mcap::MAGIC;

/// Opcode and length of a record, bytes.
const HEAD_SIZE: u64 = 9;

/// Channel, sequence number and two times before the content of a message, bytes.
const MESSAGE_HEADER_SIZE: u64 = 22;

/// A footer record and the magic that follows it, bytes.
const FOOTER_SIZE: u64 = HEAD_SIZE + 20 + MAGIC.len() as u64;

/// The messages of an MCAP file.
pub(super) struct McapFile {
    file: LogFile,
    records: BufReader<Section>,
    /// Where `records` is in the file.
    position: u64,
    chunk: Option<Chunk>,
    channels: Channels,
    is_indexed: bool,
    only: Option<Vec<String>>,
    data: Vec<u8>,
}

#[derive(Default)]
struct Channels {
    schemas: BTreeMap<u16, String>,
    channels: BTreeMap<u16, Channel>,
}

impl Channels {
    /// Takes note of a schema or channel record.
    fn add(&mut self, opcode: u8, data: &[u8]) -> io::Result<()> {
        match mcap::parse_record(opcode, data).map_err(io::Error::other)? {
            Record::Schema { header, .. } => {
                self.schemas.entry(header.id).or_insert(header.name);
            }
            Record::Channel(channel) => {
                let schema = self.schemas.get(&channel.schema_id).cloned().unwrap_or_default();
                let serialization = match channel.message_encoding.as_str() {
                    "ros1" => Some(Serialization::Ros1),
                    "cdr" => Some(Serialization::Cdr),
                    _ => None,
                };
                let kind = MessageType::from_name(&schema).zip(serialization);
                let topic = channel.topic;
                self.channels.entry(channel.id).or_insert(Channel { topic, schema, kind });
            }
            _ => {}
        }
        Ok(())
    }
}

impl McapFile {
    /// `file` must begin with [`MAGIC`].
    pub fn new(file: LogFile) -> Self {
        let start = MAGIC.len() as u64;
        let mut reader = Self {
            records: file.records(start),
            position: start,
            file,
            chunk: None,
            channels: Channels::default(),
            is_indexed: false,
            only: None,
            data: Vec::new(),
        };
        reader.is_indexed =
            reader.read_summary().unwrap_or(false) && !reader.channels.channels.is_empty();
        reader
    }

    /// Reads the channels listed at the end; `false` if the file was not closed properly.
    fn read_summary(&mut self) -> io::Result<bool> {
        let Some(footer_start) = self.file.size().checked_sub(FOOTER_SIZE) else {
            return Ok(false);
        };
        let mut footer = self.file.records(footer_start);
        let Some((op::FOOTER, 20)) = read_head(&mut footer)? else { return Ok(false) };
        let summary_start = u64::from_le_bytes(read_array(&mut footer)?);
        if summary_start <= self.position || summary_start >= footer_start {
            return Ok(false);
        }
        let mut summary = self.file.records(summary_start);
        while let Some((opcode, length)) = read_head(&mut summary)? {
            match opcode {
                op::FOOTER => break,
                op::SCHEMA | op::CHANNEL => {
                    fill(&mut summary, length, &mut self.data)?;
                    self.channels.add(opcode, &self.data)?;
                }
                _ => skip(&mut summary, length)?,
            }
        }
        Ok(true)
    }

    /// Reads the next record outside chunks; `None` at the end.
    fn read_outer(
        &mut self,
        report: &mut ReadReport,
        visitor: &mut Visitor,
    ) -> io::Result<Option<Outcome>> {
        let start = self.position;
        let Some((opcode, length)) = read_head(&mut self.records)? else {
            report.skip(CUT, format_args!("no end record before byte {start}"));
            return Ok(None);
        };
        self.position = (start + HEAD_SIZE).saturating_add(length);
        match opcode {
            op::DATA_END | op::FOOTER => return Ok(None),
            op::CHUNK => {
                let header = read_chunk_header(&mut self.records)?;
                self.open_chunk(start, &header, report);
            }
            op::SCHEMA | op::CHANNEL | op::MESSAGE => {
                let Self { records, channels, only, data, .. } = self;
                let record = (opcode, length);
                return read_body(records, record, data, (channels, only), report, visitor)
                    .map(Some);
            }
            _ if self.position > self.file.size() => {
                return Err(io::ErrorKind::UnexpectedEof.into());
            }
            _ => {}
        }
        self.records = self.file.records(self.position);
        Ok(Some(Outcome::Other))
    }

    fn open_chunk(&mut self, start: u64, header: &ChunkHeader, report: &mut ReadReport) {
        let ChunkHeader { checksum, compression, length } = header;
        let from = start + HEAD_SIZE + CHUNK_HEADER_SIZE + compression.len() as u64;
        let to = from.saturating_add(*length).min(self.position);
        match self.file.chunk(compression, (from, to), *checksum) {
            Ok(content) => self.chunk = Some(Chunk { content, start }),
            Err(error) => report.skip(DAMAGED, format_args!("chunk at byte {start}: {error}")),
        }
    }

    /// Reads the next record of the open chunk; `None` at its end.
    fn read_inner(
        &mut self,
        report: &mut ReadReport,
        visitor: &mut Visitor,
    ) -> Option<Result<Outcome, (u64, io::Error)>> {
        let Self { chunk, channels, only, data, .. } = self;
        let Chunk { content, start } = chunk.as_mut()?;
        let record = match read_head(content) {
            Ok(record) => record?,
            Err(error) => return Some(Err((*start, error))),
        };
        let read = read_body(content, record, data, (channels, only), report, visitor);
        Some(read.map_err(|error| (*start, error)))
    }
}

const CUT: &str = "mcap: cut short";
const DAMAGED: &str = "mcap: chunk damaged or cut short";

impl MessageSource for McapFile {
    fn channels(&self) -> Vec<&Channel> {
        self.channels.channels.values().collect()
    }

    fn is_indexed(&self) -> bool {
        self.is_indexed
    }

    fn only(&mut self, topics: Vec<String>) {
        self.only = Some(topics);
    }

    fn visit_next(&mut self, report: &mut ReadReport, visitor: &mut Visitor) -> bool {
        loop {
            match self.read_inner(report, visitor) {
                Some(Ok(Outcome::Message)) => return true,
                Some(Ok(Outcome::Other)) => continue,
                Some(Err((start, error))) => {
                    report.skip(DAMAGED, format_args!("chunk at byte {start}: {error}"));
                    self.chunk = None;
                }
                None => self.chunk = None,
            }
            let start = self.position;
            match self.read_outer(report, visitor) {
                Ok(Some(Outcome::Message)) => return true,
                Ok(Some(Outcome::Other)) => {}
                Ok(None) => return false,
                Err(error) => {
                    report.skip(CUT, format_args!("record at byte {start}: {error}"));
                    return false;
                }
            }
        }
    }
}

enum Outcome {
    Message,
    Other,
}

/// Reads opcode and length of a record; `None` at the end.
fn read_head(reader: &mut impl BufRead) -> io::Result<Option<(u8, u64)>> {
    if reader.fill_buf()?.is_empty() {
        return Ok(None);
    }
    let [opcode] = read_array(reader)?;
    Ok(Some((opcode, u64::from_le_bytes(read_array(reader)?))))
}

/// Size of a chunk's fields before its records without the name of the compression, bytes.
const CHUNK_HEADER_SIZE: u64 = 8 + 8 + 8 + 4 + 4 + 8;

/// Names of compressions longer than this are taken for damage, bytes.
const LARGEST_NAME: u32 = 64;

struct ChunkHeader {
    /// CRC-32 of the decompressed records.
    checksum: Option<u32>,
    compression: String,
    /// Of the compressed records, bytes.
    length: u64,
}

fn read_chunk_header(reader: &mut impl BufRead) -> io::Result<ChunkHeader> {
    let _times_and_size: [u8; 24] = read_array(reader)?;
    let checksum = u32::from_le_bytes(read_array(reader)?);
    let name_length = u32::from_le_bytes(read_array(reader)?);
    if name_length > LARGEST_NAME {
        return Err(invalid(format!("a compression name of {name_length} bytes")));
    }
    let mut compression = Vec::new();
    fill(reader, name_length.into(), &mut compression)?;
    let compression = String::from_utf8(compression).map_err(io::Error::other)?;
    let length = u64::from_le_bytes(read_array(reader)?);
    Ok(ChunkHeader { checksum: (checksum != 0).then_some(checksum), compression, length })
}

/// Reads the data of a record that is no chunk.
fn read_body(
    reader: &mut impl BufRead,
    (opcode, length): (u8, u64),
    data: &mut Vec<u8>,
    (channels, only): (&mut Channels, &Option<Vec<String>>),
    report: &mut ReadReport,
    visitor: &mut Visitor,
) -> io::Result<Outcome> {
    match opcode {
        op::SCHEMA | op::CHANNEL => {
            fill(reader, length, data)?;
            channels.add(opcode, data)?;
        }
        op::MESSAGE => {
            let header: [u8; MESSAGE_HEADER_SIZE as usize] = read_array(reader)?;
            let length = length
                .checked_sub(MESSAGE_HEADER_SIZE)
                .ok_or_else(|| invalid(format!("a message record of {length} bytes")))?;
            let id = u16::from_le_bytes([header[0], header[1]]);
            let channel = channels.channels.get(&id);
            if channel.is_none() {
                report.skip("mcap: message of an unknown channel", id);
            }
            let is_used = |topic: &String| only.as_ref().is_none_or(|only| only.contains(topic));
            if let Some(channel) = channel.filter(|channel| is_used(&channel.topic)) {
                fill(reader, length, data)?;
                visitor(channel, data, report);
                return Ok(Outcome::Message);
            }
            skip(reader, length)?;
        }
        _ => skip(reader, length)?,
    }
    Ok(Outcome::Other)
}
