//! ROS 2 bags in SQLite (`.db3`), of all versions of the format.
//!
//! Tables: <https://github.com/ros2/rosbag2/blob/rolling/docs/storage_plugins_sqlite3.md>. Only
//! `topics` and `messages` are needed; the definitions of messages came later.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rusqlite::{Connection, OpenFlags, params_from_iter};
use tempfile::TempPath;

use super::message::{MessageType, Serialization};
use super::ros::{Channel, Message, MessageSource, Place, Visitor};
use super::{LogError, ReadReport};
use crate::sensor::Stamp;

pub(super) const MAGIC: &[u8] = b"SQLite format 3\0";

/// A message larger than this is taken for damage, bytes.
const LARGEST_MESSAGE: usize = 256 << 20;

/// Where a database is; one that was decompressed is deleted with the last of its readers.
#[derive(Debug, Clone)]
pub(super) enum DatabaseFile {
    Given(PathBuf),
    Decompressed(Arc<TempPath>),
}

impl DatabaseFile {
    /// # Errors
    /// [`LogError::Corrupt`] if it is no database of messages, or damaged where it lists topics.
    pub fn open(path: &Path) -> Result<Self, LogError> {
        Self::check(Self::Given(path.to_path_buf()), path)
    }

    /// A database that was decompressed from `origin`.
    ///
    /// # Errors
    /// As [`Self::open`], naming `origin`.
    pub fn temporary(file: TempPath, origin: &Path) -> Result<Self, LogError> {
        Self::check(Self::Decompressed(Arc::new(file)), origin)
    }

    fn check(file: Self, origin: &Path) -> Result<Self, LogError> {
        file.connect().and_then(|connection| channels(&connection)).map_err(|error| {
            let reason = format!("no ROS 2 bag that can be read: {error}");
            LogError::Corrupt { path: origin.to_path_buf(), reason }
        })?;
        Ok(file)
    }

    fn path(&self) -> &Path {
        match self {
            Self::Given(path) => path,
            Self::Decompressed(path) => path,
        }
    }

    fn connect(&self) -> rusqlite::Result<Connection> {
        let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let mut wal = self.path().as_os_str().to_owned();
        wal.push("-wal");
        let has_journal = std::fs::metadata(&wal).is_ok_and(|journal| journal.len() > 0);
        // What a recorder that was killed left in its journal belongs to the bag. Without one nothing
        // but the file itself is touched, so that it may lie where nothing can be written.
        if has_journal && let Ok(connection) = Connection::open_with_flags(self.path(), flags) {
            return Ok(connection);
        }
        Connection::open_with_flags(immutable(self.path()), flags | OpenFlags::SQLITE_OPEN_URI)
    }

    /// The messages from the start.
    pub fn messages(&self) -> Database {
        let opened = self.connect().and_then(|connection| {
            let channels = channels(&connection)?;
            Ok((connection, channels))
        });
        let (connection, channels, failure) = match opened {
            Ok((connection, channels)) => (Some(connection), channels, None),
            Err(error) => (None, BTreeMap::new(), Some(error.to_string())),
        };
        Database { _file: self.clone(), connection, channels, failure, only: None, last_row: None }
    }
}

/// A URI by which nothing beside the file is looked for.
fn immutable(path: &Path) -> String {
    let mut uri = "file:".to_owned();
    for byte in path.as_os_str().as_encoded_bytes() {
        match byte {
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'/' | b'.' | b'_' | b'-' => {
                uri.push(char::from(*byte));
            }
            other => uri.push_str(&format!("%{other:02x}")),
        }
    }
    uri + "?mode=ro&immutable=1"
}

/// The messages of a database in the order in which they were stored.
pub(super) struct Database {
    /// Kept while it is read.
    _file: DatabaseFile,
    connection: Option<Connection>,
    channels: BTreeMap<i64, Channel>,
    failure: Option<String>,
    only: Option<Vec<i64>>,
    last_row: Option<i64>,
}

fn channels(connection: &Connection) -> rusqlite::Result<BTreeMap<i64, Channel>> {
    let definitions = definitions(connection).unwrap_or_default();
    let mut topics =
        connection.prepare("SELECT id, name, type, serialization_format FROM topics")?;
    let channel = |row: &rusqlite::Row| {
        let schema: String = row.get(2)?;
        let format: String = row.get(3)?;
        let channel = Channel {
            topic: row.get(1)?,
            definition: definitions.get(&schema).cloned().unwrap_or_default(),
            kind: MessageType::from_name(&schema),
            serialization: (format == "cdr").then_some(Serialization::Cdr),
            metadata: BTreeMap::new(),
            schema,
        };
        Ok((row.get(0)?, channel))
    };
    topics.query_map([], channel)?.collect()
}

/// Texts by message type, in versions of the format that have them.
fn definitions(connection: &Connection) -> rusqlite::Result<BTreeMap<String, String>> {
    let mut definitions = connection.prepare(
        "SELECT topic_type, encoded_message_definition FROM message_definitions \
         WHERE encoding = 'ros2msg'",
    )?;
    definitions.query_map([], |row| Ok((row.get(0)?, row.get(1)?)))?.collect()
}

impl Database {
    fn read_next(
        &mut self,
        report: &mut ReadReport,
        visitor: &mut Visitor,
    ) -> rusqlite::Result<bool> {
        let Some(connection) = &self.connection else { return Ok(false) };
        // One look-up a message: a query that stays open would borrow the connection.
        let topics = self.only.as_ref().map_or(String::new(), |topics| {
            let topics: Vec<String> = topics.iter().map(i64::to_string).collect();
            format!("AND topic_id IN ({})", topics.join(","))
        });
        let mut next = connection.prepare_cached(&format!(
            "SELECT rowid, topic_id, timestamp, data FROM messages WHERE rowid > ? {topics} \
             ORDER BY rowid LIMIT 1"
        ))?;
        let mut rows = next.query(params_from_iter([self.last_row.unwrap_or(i64::MIN)]))?;
        let Some(row) = rows.next()? else { return Ok(false) };
        let number: i64 = row.get(0)?;
        self.last_row = Some(number);
        let topic: i64 = row.get(1)?;
        let place = Place::Row(number);
        let data = row.get_ref(3)?.as_blob().unwrap_or_default();
        match self.channels.get(&topic) {
            Some(channel) if data.len() <= LARGEST_MESSAGE => {
                let log_time = Stamp::from_nanos(row.get(2)?);
                visitor(&Message { channel, log_time, data, place }, report);
            }
            Some(_) => {
                report.skip("db3: absurd size", format_args!("{} bytes, {place}", data.len()))
            }
            None => {
                report.skip("db3: message of an unknown topic", format_args!("{topic}, {place}"));
            }
        }
        Ok(true)
    }
}

impl MessageSource for Database {
    fn channels(&self) -> Vec<&Channel> {
        self.channels.values().collect()
    }

    fn is_indexed(&self) -> bool {
        self.failure.is_none()
    }

    fn only(&mut self, topics: Vec<String>) {
        let wanted = self.channels.iter().filter(|(_, channel)| topics.contains(&channel.topic));
        self.only = Some(wanted.map(|(id, _)| *id).collect());
    }

    fn visit_next(&mut self, report: &mut ReadReport, visitor: &mut Visitor) -> bool {
        if let Some(failure) = self.failure.take() {
            report.skip("db3: cannot be read", failure);
        }
        match self.read_next(report, visitor) {
            Ok(more) => more,
            Err(error) => {
                let after =
                    self.last_row.map_or("the start".to_owned(), |row| format!("row {row}"));
                report.skip("db3: damaged or cut short", format_args!("after {after}: {error}"));
                self.connection = None;
                false
            }
        }
    }
}
