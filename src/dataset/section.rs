//! Bytes of a log file, read as a stream: never more in memory than asked for.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom, Write};
use std::path::Path;
use std::sync::Arc;

use bzip2::bufread::BzDecoder;
use crc32fast::Hasher;

use super::LogError;

/// Size of the reads of a chunk, bytes. Larger reads go past the buffer.
const CHUNK_READ_SIZE: usize = 256 << 10;

/// Size of the reads between chunks, where small records are met and most are passed over.
const RECORD_READ_SIZE: usize = 4 << 10;

/// A record to be held in memory that is larger than this is taken for damage, bytes.
const LARGEST_RECORD: u64 = 256 << 20;

/// An open log file and its size when it was opened.
#[derive(Debug, Clone)]
pub(super) struct LogFile {
    file: Arc<File>,
    size: u64,
}

impl LogFile {
    pub fn open(path: &Path) -> Result<Self, LogError> {
        let failed = |source| LogError::Io { path: path.to_path_buf(), source };
        Self::of(File::open(path).map_err(failed)?, path)
    }

    /// A file that is open; `path` for the error that its size cannot be told.
    pub fn of(file: File, path: &Path) -> Result<Self, LogError> {
        let failed = |source| LogError::Io { path: path.to_path_buf(), source };
        let size = file.metadata().map_err(failed)?.len();
        Ok(Self { file: Arc::new(file), size })
    }

    pub fn size(&self) -> u64 {
        self.size
    }

    /// The bytes from `start` to the end.
    pub fn records(&self, start: u64) -> BufReader<Section> {
        BufReader::with_capacity(RECORD_READ_SIZE, self.section(start, self.size))
    }

    /// The content of a chunk, compressed from `start` to `end`.
    ///
    /// If the content differs from `checksum` (CRC-32), an error takes the place of its end.
    pub fn chunk(
        &self,
        compression: &str,
        (start, end): (u64, u64),
        checksum: Option<u32>,
    ) -> io::Result<Box<dyn BufRead + Send>> {
        let compressed = self.section(start, end);
        let content: Box<dyn Read + Send> = match compression {
            "" | "none" => Box::new(compressed),
            "bz2" => Box::new(BzDecoder::new(buffered(compressed))),
            "lz4" => Box::new(lz4::Decoder::new(buffered(compressed))?),
            "zstd" => Box::new(zstd::Decoder::with_buffer(buffered(compressed))?),
            _ => return Err(invalid(format!("unknown compression `{compression}`"))),
        };
        Ok(match checksum {
            Some(expected) => {
                Box::new(buffered(Checked { content, hasher: Hasher::new(), expected }))
            }
            None => Box::new(buffered(content)),
        })
    }

    fn section(&self, start: u64, end: u64) -> Section {
        Section { file: self.clone(), position: start, end: end.min(self.size) }
    }
}

fn buffered<R: Read>(reader: R) -> BufReader<R> {
    BufReader::with_capacity(CHUNK_READ_SIZE, reader)
}

struct Checked<R> {
    content: R,
    hasher: Hasher,
    expected: u32,
}

impl<R: Read> Read for Checked<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.content.read(buffer)?;
        self.hasher.update(&buffer[..count]);
        if count == 0 && !buffer.is_empty() && self.hasher.clone().finalize() != self.expected {
            return Err(invalid("the checksum is wrong".to_owned()));
        }
        Ok(count)
    }
}

/// A range of a file, with a position of its own.
#[derive(Debug)]
pub(super) struct Section {
    file: LogFile,
    position: u64,
    end: u64,
}

impl Read for Section {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let left = usize::try_from(self.end.saturating_sub(self.position)).unwrap_or(usize::MAX);
        let length = buffer.len().min(left);
        let mut file = &*self.file.file;
        file.seek(SeekFrom::Start(self.position))?;
        let count = file.read(&mut buffer[..length])?;
        self.position += count as u64;
        Ok(count)
    }
}

/// Enough to tell the format of a file.
const FIRST_BYTES: u64 = 64;

/// Writes what `path`, compressed by zstd, contains. What is damaged or cut ends it early, as a log
/// that is cut does.
pub(super) fn decompress(path: &Path, output: &mut File) -> Result<(), LogError> {
    let failed = |source| LogError::Io { path: path.to_path_buf(), source };
    let mut input = zstd::Decoder::new(File::open(path).map_err(failed)?).map_err(failed)?;
    tracing::info!("{}: decompressing it to a temporary file", path.display());
    let mut buffer = vec![0; CHUNK_READ_SIZE];
    loop {
        let count = match input.read(&mut buffer) {
            Ok(0) => return Ok(()),
            Ok(count) => count,
            Err(error) => {
                tracing::warn!("{}: damaged or cut short: {error}", path.display());
                return Ok(());
            }
        };
        output.write_all(&buffer[..count]).map_err(failed)?;
    }
}

/// The start of a file, as much as is needed to guess its format.
pub(super) fn first_bytes(path: &Path) -> Result<Vec<u8>, LogError> {
    let failed = |source| LogError::Io { path: path.to_path_buf(), source };
    let mut start = Vec::new();
    let file = File::open(path).map_err(failed)?;
    file.take(FIRST_BYTES).read_to_end(&mut start).map_err(failed)?;
    Ok(start)
}

pub(super) fn invalid(what: String) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, what)
}

fn require(complete: bool) -> io::Result<()> {
    let ended = || io::Error::new(io::ErrorKind::UnexpectedEof, "the data ends within a record");
    complete.then_some(()).ok_or_else(ended)
}

/// Replaces the content of `buffer` by the next `length` bytes.
///
/// Memory grows with what is there, not with `length`.
pub(super) fn fill(reader: &mut impl Read, length: u64, buffer: &mut Vec<u8>) -> io::Result<()> {
    if length > LARGEST_RECORD {
        return Err(invalid(format!("a record of {length} bytes")));
    }
    buffer.clear();
    let count = reader.take(length).read_to_end(buffer)?;
    require(count as u64 == length)
}

/// Passes over `length` bytes.
pub(super) fn skip(reader: &mut impl Read, length: u64) -> io::Result<()> {
    require(io::copy(&mut reader.take(length), &mut io::sink())? == length)
}

pub(super) fn read_array<const N: usize>(reader: &mut impl Read) -> io::Result<[u8; N]> {
    let mut bytes = [0; N];
    reader.read_exact(&mut bytes)?;
    Ok(bytes)
}
