//! What a run is made of, and how its input is recognised.

use std::io::Read;
use std::path::Path;
use std::sync::OnceLock;
use std::time::UNIX_EPOCH;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::dataset::{Sequence, Source};
use super::error::BenchError;

/// Everything that the figures of a run depend on. Equal keys have equal figures.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunKey {
    /// See [`program_fingerprint`].
    pub program: String,
    pub dataset: String,
    pub sequence: String,
    /// Digest of the input: scene and seed, or names, sizes and times of change of the files.
    pub input: String,
    pub filter: String,
    pub seed: u64,
    /// `init.mode` where it was asked for.
    pub init: Option<String>,
    /// Text of a configuration file, where one was given.
    pub config: Option<String>,
    /// `SECTION.KEY=VALUE` in the order in which they apply.
    pub settings: Vec<String>,
    /// Faults injected, as [`Fault`](crate::dataset::Fault) is written.
    pub faults: Vec<String>,
    /// Part of the log that is used, s; `None`: all of it.
    pub duration: Option<f64>,
}

impl RunKey {
    /// The first 128 bits of the digest of all of it, in hexadecimal.
    ///
    /// # Errors
    /// [`BenchError::Format`] if a field cannot be written.
    pub fn digest(&self) -> Result<String, BenchError> {
        let text = serde_json::to_string(self).map_err(|error| BenchError::Format {
            path: self.sequence.clone().into(),
            reason: error.to_string(),
        })?;
        Ok(digest(text.as_bytes()))
    }
}

/// The first 128 bits of SHA-256, in hexadecimal.
pub(super) fn digest(bytes: &[u8]) -> String {
    hexadecimal(Sha256::digest(bytes).as_slice())
}

fn hexadecimal(bytes: &[u8]) -> String {
    bytes.iter().take(16).map(|byte| format!("{byte:02x}")).collect()
}

/// Digest of the running program's file: what was computed by another build is computed anew.
///
/// # Errors
/// [`BenchError::Io`] if the program cannot be read.
pub fn program_fingerprint() -> Result<String, BenchError> {
    static FINGERPRINT: OnceLock<String> = OnceLock::new();
    if let Some(known) = FINGERPRINT.get() {
        return Ok(known.clone());
    }
    let path = std::env::current_exe()
        .map_err(|source| BenchError::Io { path: "the program".into(), source })?;
    let io = |source| BenchError::Io { path: path.clone(), source };
    let mut file = std::fs::File::open(&path).map_err(io)?;
    let mut hash = Sha256::new();
    let mut block = vec![0; 1 << 20];
    loop {
        let length = file.read(&mut block).map_err(io)?;
        if length == 0 {
            break;
        }
        hash.update(&block[..length]);
    }
    let digest = hexadecimal(hash.finalize().as_slice());
    Ok(FINGERPRINT.get_or_init(|| digest).clone())
}

/// Digest of what a recording is: names, sizes and times of change of its files.
pub(super) fn input_digest(sequence: &Sequence) -> Result<String, BenchError> {
    let paths: Vec<&Path> = match &sequence.source {
        Source::Log { log, truth } => [Some(log), truth.as_ref()].into_iter().flatten().collect(),
        Source::Attitude { imu, reference } => vec![imu, reference],
        Source::Navigation { imu, gps } => vec![imu, gps],
        // The scene and its seed tell all; see `recipe`.
        Source::Recipe { .. } => Vec::new(),
    }
    .into_iter()
    .map(AsRef::as_ref)
    .collect();
    let mut hash = Sha256::new();
    for path in paths {
        add_files(path, path, FOLDERS, &mut hash)?;
    }
    Ok(hexadecimal(hash.finalize().as_slice()))
}

/// Folders in folders of a log that count.
const FOLDERS: usize = 4;

fn add_files(root: &Path, path: &Path, depth: usize, hash: &mut Sha256) -> Result<(), BenchError> {
    let io = |source| BenchError::Io { path: path.to_owned(), source };
    let metadata = std::fs::metadata(path).map_err(io)?;
    if metadata.is_dir() {
        if depth == 0 {
            return Ok(());
        }
        let entries = std::fs::read_dir(path).map_err(io)?;
        let mut children =
            entries.map(|e| Ok(e.map_err(io)?.path())).collect::<Result<Vec<_>, BenchError>>()?;
        children.sort();
        return children.iter().try_for_each(|child| add_files(root, child, depth - 1, hash));
    }
    let changed = metadata.modified().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
    let name = path.strip_prefix(root).unwrap_or(path).to_string_lossy();
    let nanos = changed.map_or(0, |time| time.as_nanos());
    hash.update(format!("{name}\0{}\0{nanos}\n", metadata.len()));
    Ok(())
}
