//! MCAP files on their way to the disk.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use mcap::records::MessageHeader;

use super::WriteError;
use crate::sensor::Stamp;

/// A chunk is written when its messages reach this size, bytes.
const CHUNK_SIZE: u64 = 4 << 20;

/// Writes ROS 2 messages; a file that is not finished lacks its index and its last chunk.
pub(super) struct McapOutput {
    path: PathBuf,
    mcap: mcap::Writer<BufWriter<File>>,
    /// Messages written, by channel.
    counts: BTreeMap<u16, u32>,
}

impl McapOutput {
    /// `level` of the zstd compression: 1 (quick) to 19 (small).
    pub fn create(path: &Path, level: u32) -> Result<Self, WriteError> {
        let io = |source| WriteError::Io { path: path.to_owned(), source };
        let file = BufWriter::new(File::create(path).map_err(io)?);
        let mcap = mcap::WriteOptions::new()
            .profile("ros2")
            .chunk_size(Some(CHUNK_SIZE))
            .compression_level(level)
            .compression_threads(1)
            .create(file)
            .map_err(|source| WriteError::Mcap { path: path.to_owned(), source })?;
        Ok(Self { path: path.to_owned(), mcap, counts: BTreeMap::new() })
    }

    /// Declares a topic of messages of the type `schema`.
    pub fn channel(
        &mut self,
        topic: &str,
        (schema, definition): (&str, &str),
        metadata: &BTreeMap<String, String>,
    ) -> Result<u16, WriteError> {
        self.mcap
            .add_schema(schema, "ros2msg", definition.as_bytes())
            .and_then(|schema| self.mcap.add_channel(schema, topic, "cdr", metadata))
            .map_err(|source| WriteError::Mcap { path: self.path.clone(), source })
    }

    pub fn write(&mut self, channel: u16, log_time: Stamp, body: &[u8]) -> Result<(), WriteError> {
        let log_time = u64::try_from(log_time.nanos())
            .map_err(|_| WriteError::BeforeOrigin { path: self.path.clone(), time: log_time })?;
        let count = self.counts.entry(channel).or_default();
        let (channel_id, sequence) = (channel, *count);
        let header = MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
        *count = count.wrapping_add(1);
        self.mcap
            .write_to_known_channel(&header, body)
            .map_err(|source| WriteError::Mcap { path: self.path.clone(), source })
    }

    /// Writes the index.
    pub fn finish(mut self) -> Result<(), WriteError> {
        let finished = self.mcap.finish();
        finished.map_err(|source| WriteError::Mcap { path: self.path.clone(), source })?;
        let written = self.mcap.into_inner().into_inner();
        written.map_err(|error| WriteError::Io { path: self.path, source: error.into_error() })?;
        Ok(())
    }
}
