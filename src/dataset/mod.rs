//! Logs in and out. Every reader yields the same time-ordered [`Event`]s behind [`Log`].

mod event;

pub use event::{Event, Log, LogConfig, LogError, LogSummary, ReadReport, RgbdFrame, TruthPose};
