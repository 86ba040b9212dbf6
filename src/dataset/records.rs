//! Files of records, some of them in compressed chunks, read one by one from the start: what ROS 1
//! bags and MCAP have in common. An index only tells the topics beforehand.

use std::collections::BTreeMap;
use std::io::{self, BufRead, BufReader, Read};

use super::ReadReport;
use super::ros::{Channel, Message, MessageSource, Place, Visitor};
use super::section::{LogFile, Section, fill, skip};
use crate::sensor::Stamp;

/// What a record is to the reader.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum RecordKind {
    Chunk,
    Message,
    /// A connection, schema or channel.
    Declaration,
    /// The last record that is of use.
    End,
    Other,
}

/// The start of a record.
#[derive(Debug, Clone, Copy)]
pub(super) struct RecordHead {
    pub kind: RecordKind,
    /// Bytes before the body.
    pub size: u64,
    /// Bytes of the body.
    pub length: u64,
}

/// The start of a chunk's body.
#[derive(Debug)]
pub(super) struct ChunkHead {
    /// Bytes before the compressed records.
    pub size: u64,
    /// Bytes of the compressed records.
    pub length: u64,
    pub compression: String,
    /// CRC-32 of the decompressed records, where there is one.
    pub checksum: Option<u32>,
}

/// The start of a message's body.
#[derive(Debug, Clone, Copy)]
pub(super) struct MessageHead {
    pub channel: Option<u32>,
    pub log_time: Stamp,
    /// Bytes before the content.
    pub size: u64,
}

/// What tells one container format from another. An implementation remembers the head that it
/// read last and the channels declared so far.
pub(super) trait Format: Default + Send {
    const MAGIC: &'static [u8];
    /// Reasons under which faults are counted.
    const CUT: &'static str;
    const DAMAGED: &'static str;
    const UNKNOWN_CHANNEL: &'static str;
    /// Whether a file that was closed has an end record.
    const HAS_END: bool;

    /// Reads a record up to its body; `None` at the end.
    fn read_head(&mut self, reader: &mut impl BufRead) -> io::Result<Option<RecordHead>>;

    fn read_chunk_head(&mut self, reader: &mut impl Read, length: u64) -> io::Result<ChunkHead>;

    fn read_message_head(&mut self, reader: &mut impl Read) -> io::Result<MessageHead>;

    /// Takes note of the body of a declaration.
    fn declare(&mut self, body: &[u8]) -> io::Result<()>;

    /// Takes note of the channels listed at the end; `false` if the file was not closed properly.
    fn read_index(&mut self, file: &LogFile) -> io::Result<bool>;

    fn channels(&self) -> &BTreeMap<u32, Channel>;
}

/// The messages of a file.
pub(super) struct Records<F> {
    format: F,
    file: LogFile,
    reader: BufReader<Section>,
    /// Where `reader` is in the file.
    position: u64,
    chunk: Option<OpenChunk>,
    is_indexed: bool,
    is_over: bool,
    only: Option<Vec<String>>,
    data: Vec<u8>,
}

struct OpenChunk {
    content: Box<dyn BufRead + Send>,
    /// Offset of its record in the file.
    start: u64,
    /// Number of its records read so far.
    records: u64,
}

impl<F: Format> Records<F> {
    /// `file` must begin with the format's magic bytes.
    pub fn new(file: LogFile) -> Self {
        let position = F::MAGIC.len() as u64;
        let mut format = F::default();
        let is_indexed = format.read_index(&file).unwrap_or(false) && !format.channels().is_empty();
        Self {
            format,
            reader: file.records(position),
            position,
            file,
            chunk: None,
            is_indexed,
            is_over: false,
            only: None,
            data: Vec::new(),
        }
    }

    /// Reads the next record outside chunks; `false` if it was no message that was asked for.
    fn read_outer(&mut self, report: &mut ReadReport, visitor: &mut Visitor) -> io::Result<bool> {
        let start = self.position;
        let Some(head) = self.format.read_head(&mut self.reader)? else {
            self.is_over = true;
            // A chunk that lacks its end has been reported.
            if F::HAS_END && start <= self.file.size() {
                report.skip(F::CUT, format_args!("no end record before byte {start}"));
            }
            return Ok(false);
        };
        self.position = start.saturating_add(head.size).saturating_add(head.length);
        match head.kind {
            RecordKind::End => {
                self.is_over = true;
                return Ok(false);
            }
            RecordKind::Chunk => self.open_chunk(start, head, report)?,
            RecordKind::Message | RecordKind::Declaration => {
                let Self { format, reader, only, data, .. } = self;
                let body = Body { head, place: Place::Record(start) };
                return body.read(reader, format, (&*only, data), report, visitor);
            }
            RecordKind::Other if self.position > self.file.size() => {
                return Err(io::ErrorKind::UnexpectedEof.into());
            }
            RecordKind::Other => {}
        }
        self.reader = self.file.records(self.position);
        Ok(false)
    }

    fn open_chunk(
        &mut self,
        start: u64,
        head: RecordHead,
        report: &mut ReadReport,
    ) -> io::Result<()> {
        let chunk = self.format.read_chunk_head(&mut self.reader, head.length)?;
        let from = start + head.size + chunk.size;
        let to = from.saturating_add(chunk.length).min(self.position);
        match self.file.chunk(&chunk.compression, (from, to), chunk.checksum) {
            Ok(content) => self.chunk = Some(OpenChunk { content, start, records: 0 }),
            Err(error) => report.skip(F::DAMAGED, format_args!("chunk at byte {start}: {error}")),
        }
        if self.position > self.file.size() {
            report.skip(F::CUT, format_args!("at byte {}", self.file.size()));
        }
        Ok(())
    }

    /// Reads the next record of the open chunk; `None` at its end.
    fn read_inner(
        &mut self,
        report: &mut ReadReport,
        visitor: &mut Visitor,
    ) -> Option<Result<bool, (Place, io::Error)>> {
        let Self { chunk, format, only, data, .. } = self;
        let OpenChunk { content, start, records } = chunk.as_mut()?;
        *records += 1;
        let place = Place::Chunk(*start, *records);
        let head = match format.read_head(content) {
            Ok(head) => head?,
            Err(error) => return Some(Err((place, error))),
        };
        let read = Body { head, place }.read(content, format, (&*only, data), report, visitor);
        Some(read.map_err(|error| (place, error)))
    }
}

impl<F: Format> MessageSource for Records<F> {
    fn channels(&self) -> Vec<&Channel> {
        self.format.channels().values().collect()
    }

    fn is_indexed(&self) -> bool {
        self.is_indexed
    }

    fn only(&mut self, topics: Vec<String>) {
        self.only = Some(topics);
    }

    fn visit_next(&mut self, report: &mut ReadReport, visitor: &mut Visitor) -> bool {
        while !self.is_over {
            match self.read_inner(report, visitor) {
                Some(Ok(true)) => return true,
                Some(Ok(false)) => continue,
                Some(Err((place, error))) => {
                    report.skip(F::DAMAGED, format_args!("{place}: {error}"));
                    self.chunk = None;
                }
                None => self.chunk = None,
            }
            let start = self.position;
            match self.read_outer(report, visitor) {
                Ok(true) => return true,
                Ok(false) => {}
                Err(error) => {
                    report.skip(F::CUT, format_args!("record at byte {start}: {error}"));
                    // Without the length of this record the next one cannot be found.
                    self.is_over = true;
                }
            }
        }
        false
    }
}

/// A record that is no chunk, of which the head has been read.
struct Body {
    head: RecordHead,
    place: Place,
}

impl Body {
    /// `false` if it was no message that was asked for.
    fn read<F: Format>(
        &self,
        reader: &mut impl BufRead,
        format: &mut F,
        (only, data): (&Option<Vec<String>>, &mut Vec<u8>),
        report: &mut ReadReport,
        visitor: &mut Visitor,
    ) -> io::Result<bool> {
        let length = self.head.length;
        match self.head.kind {
            RecordKind::Declaration => {
                fill(reader, length, data)?;
                format.declare(data)?;
            }
            RecordKind::Message => {
                let message = format.read_message_head(reader)?;
                let length = length.checked_sub(message.size).ok_or_else(|| {
                    super::section::invalid(format!("a message record of {length} bytes"))
                })?;
                let channel = message.channel.and_then(|id| format.channels().get(&id));
                if channel.is_none() {
                    let detail = format_args!("{:?}, {}", message.channel, self.place);
                    report.skip(F::UNKNOWN_CHANNEL, detail);
                }
                let is_used =
                    |topic: &String| only.as_ref().is_none_or(|only| only.contains(topic));
                if let Some(channel) = channel.filter(|channel| is_used(&channel.topic)) {
                    fill(reader, length, data)?;
                    let (log_time, place) = (message.log_time, self.place);
                    visitor(&Message { channel, log_time, data, place }, report);
                    return Ok(true);
                }
                skip(reader, length)?;
            }
            RecordKind::Chunk | RecordKind::End | RecordKind::Other => skip(reader, length)?,
        }
        Ok(false)
    }
}
