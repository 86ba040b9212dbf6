//! What `ros2 bag record` leaves: a folder with one or more files of messages, whole or compressed,
//! and mostly a `metadata.yaml`, which is needed for nothing but the order of the files.

use std::io::{self, Read};
use std::path::{Path, PathBuf};

use super::message::Serialization;
use super::ros::{Channel, Message, MessageSource, Visitor};
use super::section::invalid;
use super::{LogError, ReadReport};

/// Names of files of messages end so, perhaps with one of [`COMPRESSED`] after it.
const STORED: [&str; 2] = ["mcap", "db3"];
const COMPRESSED: [&str; 2] = ["zstd", "zst"];

const METADATA: &str = "metadata.yaml";

/// The first bytes of what zstd compressed.
pub(super) const ZSTD_MAGIC: &[u8] = &[0x28, 0xb5, 0x2f, 0xfd];

/// A compressed message may become so large, bytes.
const LARGEST_MESSAGE: u64 = 256 << 20;

/// A file of messages: its name without what tells storage, compression and its number.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Part {
    recording: String,
    storage: &'static str,
    number: u64,
    path: PathBuf,
}

impl Part {
    fn of(path: PathBuf) -> Option<Self> {
        let name = path.file_name()?.to_str()?;
        let plain = COMPRESSED.iter().find_map(|end| name.strip_suffix(end)?.strip_suffix('.'));
        let plain = plain.unwrap_or(name);
        let (stem, storage) = STORED
            .iter()
            .find_map(|end| Some((plain.strip_suffix(end)?.strip_suffix('.')?, *end)))?;
        let (recording, number) = match stem.rsplit_once('_') {
            Some((before, digits)) => match digits.parse() {
                Ok(number) => (before, number),
                Err(_) => (stem, 0),
            },
            None => (stem, 0),
        };
        Some(Self { recording: recording.to_owned(), storage, number, path })
    }
}

/// Whether a folder may be a ROS 2 bag.
pub(super) fn is_rosbag2(folder: &Path) -> bool {
    folder.join(METADATA).is_file() || !parts(folder).is_empty()
}

fn parts(folder: &Path) -> Vec<Part> {
    let Ok(files) = std::fs::read_dir(folder) else { return Vec::new() };
    let mut parts: Vec<Part> = files.flatten().filter_map(|file| Part::of(file.path())).collect();
    parts.sort();
    parts
}

/// The files of a folder in the order of the recording.
///
/// # Errors
/// [`LogError::UnknownFormat`] if there are none, or those of several recordings.
pub(super) fn list(folder: &Path) -> Result<Vec<PathBuf>, LogError> {
    let told = told_files(folder);
    if !told.is_empty() && told.iter().all(|path| path.is_file()) {
        return Ok(told);
    }
    let unknown =
        |reason: String| Err(LogError::UnknownFormat { path: folder.to_path_buf(), reason });
    let parts = parts(folder);
    let Some(first) = parts.first() else {
        return unknown("a ROS 2 bag folder without a file of messages (.mcap, .db3)".to_owned());
    };
    let of_first =
        |part: &&Part| (&part.recording, part.storage) == (&first.recording, first.storage);
    if let Some(other) = parts.iter().find(|part| !of_first(part)) {
        let names = [first, other]
            .map(|part| part.path.file_name().unwrap_or_default().display().to_string());
        let [first, other] = names;
        return unknown(format!("files of several recordings; name one, as {first} or {other}"));
    }
    if !told.is_empty() {
        tracing::warn!(
            "{}: not the files that {METADATA} names; all there are are read",
            folder.display()
        );
    }
    Ok(parts.into_iter().map(|part| part.path).collect())
}

/// The list `relative_file_paths` of the metadata, whose entries are plain names.
fn told_files(folder: &Path) -> Vec<PathBuf> {
    let Ok(text) = std::fs::read_to_string(folder.join(METADATA)) else { return Vec::new() };
    let lines = text.lines().map(str::trim).skip_while(|line| *line != "relative_file_paths:");
    let names = lines.skip(1).map_while(|line| line.strip_prefix("- "));
    // Early versions write the path from where the recorder was started.
    let names = names.map(|name| name.trim().trim_matches(['"', '\'']));
    names.filter_map(|name| Some(folder.join(Path::new(name).file_name()?))).collect()
}

/// Files of messages one after the other.
pub(super) struct Chain {
    sources: Vec<Box<dyn MessageSource>>,
    current: usize,
}

impl Chain {
    pub fn new(sources: Vec<Box<dyn MessageSource>>) -> Self {
        Self { sources, current: 0 }
    }
}

impl MessageSource for Chain {
    fn channels(&self) -> Vec<&Channel> {
        self.sources.iter().flat_map(|source| source.channels()).collect()
    }

    fn is_indexed(&self) -> bool {
        self.sources.iter().all(|source| source.is_indexed())
    }

    fn only(&mut self, topics: Vec<String>) {
        for source in &mut self.sources {
            source.only(topics.clone());
        }
    }

    fn visit_next(&mut self, report: &mut ReadReport, visitor: &mut Visitor) -> bool {
        while let Some(source) = self.sources.get_mut(self.current) {
            if source.visit_next(report, visitor) {
                return true;
            }
            self.current += 1;
        }
        false
    }
}

/// Decompresses messages that were compressed one by one (`compression_mode: MESSAGE`).
pub(super) struct Unpacked {
    source: Box<dyn MessageSource>,
    buffer: Vec<u8>,
}

impl Unpacked {
    pub fn new(source: Box<dyn MessageSource>) -> Self {
        Self { source, buffer: Vec::new() }
    }
}

impl MessageSource for Unpacked {
    fn channels(&self) -> Vec<&Channel> {
        self.source.channels()
    }

    fn is_indexed(&self) -> bool {
        self.source.is_indexed()
    }

    fn only(&mut self, topics: Vec<String>) {
        self.source.only(topics);
    }

    fn visit_next(&mut self, report: &mut ReadReport, visitor: &mut Visitor) -> bool {
        let Self { source, buffer } = self;
        source.visit_next(report, &mut |message, report| {
            // CDR begins with a zero.
            let is_packed = message.channel.serialization == Some(Serialization::Cdr)
                && message.data.starts_with(ZSTD_MAGIC);
            if !is_packed {
                return visitor(message, report);
            }
            match unpack(message.data, buffer) {
                Ok(()) => visitor(&Message { data: buffer, ..*message }, report),
                Err(error) => report.skip(
                    "message: cannot be decompressed",
                    format_args!("{}, {}: {error}", message.channel.topic, message.place),
                ),
            }
        })
    }
}

fn unpack(data: &[u8], buffer: &mut Vec<u8>) -> io::Result<()> {
    buffer.clear();
    let count = zstd::Decoder::with_buffer(data)?.take(LARGEST_MESSAGE + 1).read_to_end(buffer)?;
    match count as u64 > LARGEST_MESSAGE {
        true => Err(invalid(format!("more than {LARGEST_MESSAGE} bytes"))),
        false => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(names: &[&str], metadata: Option<&str>) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for name in names {
            std::fs::write(folder.path().join(name), b"").unwrap();
        }
        if let Some(text) = metadata {
            std::fs::write(folder.path().join(METADATA), text).unwrap();
        }
        folder
    }

    fn listed(names: &[&str], metadata: Option<&str>) -> Result<Vec<String>, String> {
        let folder = folder(names, metadata);
        let paths = list(folder.path()).map_err(|error| error.to_string())?;
        let name = |path: &PathBuf| path.file_name().unwrap().to_str().unwrap().to_owned();
        Ok(paths.iter().map(name).collect())
    }

    #[test]
    fn parts_follow_one_another_by_number() {
        let names = ["rec_10.mcap", "rec_2.mcap", "rec_0.mcap", "notes.txt"];
        assert_eq!(listed(&names, None).unwrap(), ["rec_0.mcap", "rec_2.mcap", "rec_10.mcap"]);
        assert_eq!(listed(&["a_0.db3.zstd"], None).unwrap(), ["a_0.db3.zstd"]);
        assert_eq!(listed(&["a.mcap.zst"], None).unwrap(), ["a.mcap.zst"]);
    }

    #[test]
    fn the_metadata_decide_where_their_files_are_there() {
        let metadata =
            "bag:\n  relative_file_paths:\n    - b_1.db3\n    - \"sub/b_0.db3\"\n  duration: 1\n";
        let names = ["b_0.db3", "b_1.db3", "b.mcap"];
        assert_eq!(listed(&names, Some(metadata)).unwrap(), ["b_1.db3", "b_0.db3"]);
        assert_eq!(listed(&["c_0.mcap"], Some(metadata)).unwrap(), ["c_0.mcap"]);
    }

    #[test]
    fn folders_of_several_recordings_or_of_none_are_refused() {
        for names in [["a.mcap", "b.mcap"], ["a.db3", "a.mcap"]] {
            let error = listed(&names, None).unwrap_err();
            let expected = format!("name one, as {} or {}", names[0], names[1]);
            assert!(error.contains(&expected) || names[0].ends_with("db3"), "{error}");
        }
        let error = listed(&[], Some("")).unwrap_err();
        assert!(error.contains("without a file of messages"), "{error}");
    }
}
