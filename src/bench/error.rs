use std::path::PathBuf;

use crate::config::ConfigError;
use crate::dataset::{LogError, WriteError};
use crate::evaluation::{EvaluationError, PlotError};
use crate::replay::ReplayError;
use crate::simulation::SceneError;

/// Why a bench cannot be run. A run that fails is a figure of its row, not one of these.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    #[error(
        "{root}: no sequence of {dataset}; expected {expected} (datasets/{dataset}.md says where to get them)"
    )]
    NothingFound { dataset: &'static str, root: PathBuf, expected: &'static str },
    #[error("{dataset} needs the folder of its sequences: mfg-vio bench {dataset} ROOT")]
    NoRoot { dataset: &'static str },
    #[error("no sequence `{name}` in {dataset}; there are: {available}")]
    UnknownSequence { dataset: &'static str, name: String, available: String },
    #[error(
        "{dataset}: `{name}` is absent under {root} (datasets/{dataset}.md says where to get it)"
    )]
    Absent { dataset: &'static str, name: String, root: PathBuf },
    #[error("unknown filter `{name}`; {dataset} takes: {available}")]
    UnknownFilter { dataset: &'static str, name: String, available: String },
    #[error("`--sweep {text}` is not of the form SECTION.KEY=VALUE,VALUE")]
    Sweep { text: String },
    #[error("{path}: {source}")]
    Io { path: PathBuf, source: std::io::Error },
    #[error("{path}: {reason}")]
    Format { path: PathBuf, reason: String },
    #[error(transparent)]
    Config(#[from] ConfigError),
    #[error(transparent)]
    Log(#[from] LogError),
    #[error(transparent)]
    Evaluation(#[from] EvaluationError),
    #[error(transparent)]
    Replay(#[from] ReplayError),
    #[error(transparent)]
    Scene(#[from] SceneError),
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error(transparent)]
    Plot(#[from] PlotError),
    #[error(
        "interrupted; {finished} of {planned} runs are kept, the same command goes on from there"
    )]
    Interrupted { finished: usize, planned: usize },
}

impl BenchError {
    /// Whether the command line is at fault.
    pub fn is_usage(&self) -> bool {
        matches!(
            self,
            Self::NoRoot { .. }
                | Self::UnknownSequence { .. }
                | Self::UnknownFilter { .. }
                | Self::Sweep { .. }
                | Self::Config(ConfigError::Override { .. } | ConfigError::UnknownKey { .. })
        )
    }
}
