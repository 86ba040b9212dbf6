//! The pipeline that joins front end, map and filter.

mod association;
mod clock;
mod gyroscope;
mod health;
mod init;
mod pipeline;
mod recognition;
mod report;
mod rest;
mod restart;
mod runner;
mod shutter;
mod state_points;
mod truth;
mod watch;

use serde::{Deserialize, Serialize};

use crate::filter::FilterConfig;
use crate::inertial::{ImuConfig, StandstillConfig};
use crate::map::MapConfig;
use crate::sensor::CameraConfig;
use crate::vision::{DepthConfig, MatchingConfig, PatchConfig, RansacConfig};

pub use health::{DivergencePolicy, HealthConfig, HealthSummary};
pub use init::{InitConfig, InitMode};
pub use pipeline::{FrontEndFrame, Odometry, OdometryStats};
pub use report::{
    KeypointRole, KeypointView, MapPointView, Note, NoteLevel, StageTimes, StepCounts, StepReport,
};
pub use runner::{FrontEnd, Observation, RunOptions, run};
pub use state_points::renew_state_points;
pub use truth::{TruthConfig, TruthTrack, Up, z_up_from_reference};

/// Where in the image a map point is looked for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SearchConfig {
    /// Radius around the predicted pixel when the prediction is certain, pixels; three standard
    /// deviations of the prediction are added.
    pub min_radius: f64,
    /// Largest radius, pixels.
    pub max_radius: f64,
    /// With fewer matches than this the search is repeated with the largest radius.
    pub min_matches: usize,
    /// Use matched features without depth too: they measure a direction.
    pub without_depth: bool,
    /// Look for points of the filter's state at their predicted places too, where no corner was
    /// detected or none was recognised.
    pub seek_state_points: bool,
}

impl Default for SearchConfig {
    fn default() -> Self {
        Self {
            min_radius: 8.0,
            max_radius: 120.0,
            min_matches: 30,
            without_depth: false,
            seek_state_points: true,
        }
    }
}

/// The settings of the pipeline behind the front end.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct OdometryConfig {
    pub imu: ImuConfig,
    pub camera: CameraConfig,
    pub depth: DepthConfig,
    pub search: SearchConfig,
    pub matching: MatchingConfig,
    pub patch: PatchConfig,
    pub ransac: RansacConfig,
    pub map: MapConfig,
    pub filter: FilterConfig,
    pub init: InitConfig,
    pub standstill: StandstillConfig,
    pub truth: TruthConfig,
    pub health: HealthConfig,
}
