use std::path::PathBuf;

use crate::config::ConfigError;
use crate::dataset::LogError;
use crate::evaluation::EvaluationError;
use crate::inertial::identification::IdentificationError;

/// Why a log could not be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    #[error(transparent)]
    Log(#[from] LogError),
    #[error(transparent)]
    Evaluation(#[from] EvaluationError),
    #[error("{path}: {source}")]
    Write { path: PathBuf, source: std::io::Error },
    #[error(
        "`camera.imu_from_camera` is no rigid motion (rotation and translation, row-major 4x4)"
    )]
    Extrinsics,
    #[error(transparent)]
    Config(#[from] ConfigError),
    #[error("{log}: no attitude: {reason}")]
    NoAttitude { log: PathBuf, reason: String },
    #[error("{log}: {source}")]
    Noise { log: PathBuf, source: IdentificationError },
    #[error("the front end cannot start: {0}")]
    FrontEnd(String),
    #[error("the recording failed: {0}")]
    Recording(String),
    #[error("{log}: no frame was processed: {reason}")]
    NothingProcessed { log: PathBuf, reason: String },
}
