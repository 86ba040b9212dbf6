//! ROS 1 bags, read record by record from the start; an index only tells the topics beforehand.
//!
//! Format: <http://wiki.ros.org/Bags/Format/2.0>.

use std::collections::BTreeMap;
use std::io::{self, BufRead, BufReader};

use super::ReadReport;
use super::message::{MessageType, Serialization};
use super::ros::{Channel, MessageSource, Visitor};
use super::section::{Chunk, LogFile, Section, fill, invalid, read_array, skip};

pub(super) const MAGIC: &[u8] = b"#ROSBAG V2.0\n";

/// A record header larger than this is taken for damage, bytes.
const LARGEST_HEADER: u32 = 1 << 20;

/// Values of the header field `op`.
mod op {
    pub const MESSAGE: u8 = 0x02;
    pub const BAG: u8 = 0x03;
    pub const CHUNK: u8 = 0x05;
    pub const CONNECTION: u8 = 0x07;
}

/// The messages of a bag.
pub(super) struct Bag {
    file: LogFile,
    records: BufReader<Section>,
    /// Where `records` is in the file.
    position: u64,
    chunk: Option<Chunk>,
    connections: BTreeMap<u32, Channel>,
    is_indexed: bool,
    only: Option<Vec<String>>,
    header: Vec<u8>,
    data: Vec<u8>,
}

impl Bag {
    /// `file` must begin with [`MAGIC`].
    pub fn new(file: LogFile) -> Self {
        let start = MAGIC.len() as u64;
        let mut bag = Self {
            records: file.records(start),
            position: start,
            file,
            chunk: None,
            connections: BTreeMap::new(),
            is_indexed: false,
            only: None,
            header: Vec::new(),
            data: Vec::new(),
        };
        bag.is_indexed = bag.read_index().unwrap_or(false) && !bag.connections.is_empty();
        bag
    }

    /// Reads the connections listed at the end; `false` if the bag was not closed properly.
    fn read_index(&mut self) -> io::Result<bool> {
        let mut records = self.file.records(self.position);
        read_head(&mut records, &mut self.header)?;
        let header = (number(&self.header, b"op"), number(&self.header, b"index_pos"));
        let (Some([op::BAG]), Some(position)) = header else { return Ok(false) };
        let position = u64::from_le_bytes(position);
        if position <= self.position || position >= self.file.size() {
            return Ok(false);
        }
        let mut records = self.file.records(position);
        while let Some(length) = read_head(&mut records, &mut self.header)? {
            if number(&self.header, b"op") != Some([op::CONNECTION]) {
                break;
            }
            fill(&mut records, length.into(), &mut self.data)?;
            add_connection(&mut self.connections, &self.header, &self.data);
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
        let Some(length) = read_head(&mut self.records, &mut self.header)? else {
            return Ok(None);
        };
        let data_start = start + 8 + self.header.len() as u64;
        self.position = data_start + u64::from(length);
        if number(&self.header, b"op") == Some([op::CHUNK]) {
            self.open_chunk(start, data_start, report);
            self.records = self.file.records(self.position);
            return Ok(Some(Outcome::Other));
        }
        let Self { records, header, data, connections, only, .. } = self;
        read_body(records, length, (&*header, data), (connections, only), report, visitor).map(Some)
    }

    fn open_chunk(&mut self, start: u64, data_start: u64, report: &mut ReadReport) {
        let compression = field(&self.header, b"compression").unwrap_or(b"none");
        let compression = String::from_utf8_lossy(compression);
        match self.file.chunk(&compression, (data_start, self.position), None) {
            Ok(content) => self.chunk = Some(Chunk { content, start }),
            Err(error) => report.skip(DAMAGED, format_args!("chunk at byte {start}: {error}")),
        }
        if self.position > self.file.size() {
            report.skip(CUT, format_args!("at byte {}", self.file.size()));
        }
    }

    /// Reads the next record of the open chunk; `None` at its end.
    fn read_inner(
        &mut self,
        report: &mut ReadReport,
        visitor: &mut Visitor,
    ) -> Option<Result<Outcome, (u64, io::Error)>> {
        let Self { chunk, header, data, connections, only, .. } = self;
        let Chunk { content, start } = chunk.as_mut()?;
        let length = match read_head(content, header) {
            Ok(length) => length?,
            Err(error) => return Some(Err((*start, error))),
        };
        let read =
            read_body(content, length, (&*header, data), (connections, only), report, visitor);
        Some(read.map_err(|error| (*start, error)))
    }
}

const CUT: &str = "bag: cut short";
const DAMAGED: &str = "bag: chunk damaged or cut short";

impl MessageSource for Bag {
    fn channels(&self) -> Vec<&Channel> {
        self.connections.values().collect()
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
                    // Without the length of this record the next one cannot be found.
                    self.position = self.file.size();
                    self.records = self.file.records(self.position);
                }
            }
        }
    }
}

enum Outcome {
    Message,
    Other,
}

/// Reads a record's header and the length of its data; `None` at the end.
fn read_head(reader: &mut impl BufRead, header: &mut Vec<u8>) -> io::Result<Option<u32>> {
    header.clear();
    if reader.fill_buf()?.is_empty() {
        return Ok(None);
    }
    let length = u32::from_le_bytes(read_array(reader)?);
    if length > LARGEST_HEADER {
        return Err(invalid(format!("a record header of {length} bytes")));
    }
    fill(reader, length.into(), header)?;
    Ok(Some(u32::from_le_bytes(read_array(reader)?)))
}

/// Reads the data of a record that is no chunk.
fn read_body(
    reader: &mut impl BufRead,
    length: u32,
    (header, data): (&[u8], &mut Vec<u8>),
    (connections, only): (&mut BTreeMap<u32, Channel>, &Option<Vec<String>>),
    report: &mut ReadReport,
    visitor: &mut Visitor,
) -> io::Result<Outcome> {
    let length = u64::from(length);
    match number(header, b"op") {
        Some([op::CONNECTION]) => {
            fill(reader, length, data)?;
            add_connection(connections, header, data);
        }
        Some([op::MESSAGE]) => {
            let connection = number(header, b"conn").map(u32::from_le_bytes);
            let channel = connection.and_then(|id| connections.get(&id));
            if channel.is_none() {
                let reason = "bag: message of an unknown connection";
                report.skip(reason, format_args!("{connection:?}"));
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

fn add_connection(connections: &mut BTreeMap<u32, Channel>, header: &[u8], data: &[u8]) {
    let id = number(header, b"conn").map(u32::from_le_bytes);
    let (Some(id), Some(topic), Some(schema)) = (id, field(header, b"topic"), field(data, b"type"))
    else {
        return;
    };
    connections.entry(id).or_insert_with(|| {
        let schema = String::from_utf8_lossy(schema).into_owned();
        let kind = MessageType::from_name(&schema).map(|kind| (kind, Serialization::Ros1));
        Channel { topic: String::from_utf8_lossy(topic).into_owned(), schema, kind }
    });
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
