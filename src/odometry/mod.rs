//! The pipeline that joins front end, tracking, filter and map.

mod back_end;
mod buffer;
mod config;
mod health;
#[cfg(test)]
mod hostile_events;
mod init;
mod levelling;
mod pipeline;
mod recognition;
mod report;
mod rest;
mod restart;
mod run;
mod runner;
mod state_points;
mod supervisor;
mod track_window;
#[cfg(test)]
mod track_window_tests;
mod truth;
mod window;

pub use back_end::{BackEnd, FrameObservations};
pub use config::OdometryConfig;
pub use health::{DivergencePolicy, HealthConfig, HealthSummary};
pub use init::{InitConfig, InitMode};
pub use pipeline::{Odometry, OdometryStats};
pub use report::{
    KeypointRole, KeypointView, MapPointView, Note, NoteLevel, StageTimes, StepCounts, StepReport,
};
pub use runner::{FrontEnd, Observation, RunOptions, run};
pub use truth::{TruthConfig, TruthTrack, Up, z_up_from_reference};
pub use window::{ImuCursor, ImuGap, ImuInterval, ImuWindow};
