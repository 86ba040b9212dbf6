use std::io;
use std::path::PathBuf;
use std::time::Duration;

use rerun::RecordingStreamError;
use rerun::sink::SinkFlushError;

/// Why a recording could not be begun, or is not whole.
#[derive(Debug, thiserror::Error)]
pub enum ViewerError {
    #[error("recording.{key} = {value} is out of range: give {expected}")]
    Config { key: &'static str, value: u64, expected: &'static str },
    #[error("no file and no viewer given to record into")]
    NoSink,
    #[error("{path}: cannot be created: {source}")]
    Create { path: PathBuf, source: io::Error },
    #[error("{url:?} is not the address of a Rerun viewer: give rerun+http://HOST:PORT/proxy")]
    Address { url: String },
    #[error("no Rerun viewer answers at {url} within {} s", patience.as_secs())]
    Unreachable { url: String, patience: Duration },
    #[error(
        "no `rerun` executable of the viewer found: install version {version} \
         (pip install rerun-sdk=={version}) or record into a file"
    )]
    NoViewer { version: String },
    #[error("the Rerun viewer did not start: {0}")]
    Spawn(io::Error),
    #[error("no thread for the recording: {0}")]
    Thread(io::Error),
    #[error("the thread that writes the recording has panicked")]
    Panicked,
    #[error("recording: {0}")]
    Stream(#[source] Box<RecordingStreamError>),
    #[error("{kind} image of frame {frame} ({width}x{height}) cannot be encoded: {source}")]
    Image {
        kind: &'static str,
        frame: u64,
        width: usize,
        height: usize,
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    #[error("the recording was not written to its end: {0}")]
    Flush(#[from] SinkFlushError),
    #[error("{path}: the recording is cut short (is the disk full?)")]
    CutShort { path: PathBuf },
}

impl From<RecordingStreamError> for ViewerError {
    fn from(error: RecordingStreamError) -> Self {
        Self::Stream(Box::new(error))
    }
}
