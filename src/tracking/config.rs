use serde::{Deserialize, Serialize};

use crate::sensor::{Camera, CameraConfig};
use crate::vision::{DepthConfig, MatchingConfig, PatchConfig, RansacConfig};

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

/// The settings that tracking depends on.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackingConfig {
    pub lens: Camera,
    pub camera: CameraConfig,
    pub depth: DepthConfig,
    pub search: SearchConfig,
    pub matching: MatchingConfig,
    pub patch: PatchConfig,
    pub ransac: RansacConfig,
    /// Factor on the covariance of every measured point.
    pub measurement_inflation: f64,
    /// Observations from which on a point counts as proven to stand still.
    pub proven_observations: u32,
}
