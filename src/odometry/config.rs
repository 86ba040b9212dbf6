use super::health::HealthConfig;
use super::init::InitConfig;
use super::truth::TruthConfig;
use crate::fault::FaultConfig;
use crate::filter::FilterConfig;
use crate::inertial::{ImuConfig, StandstillConfig};
use crate::map::MapConfig;
use crate::sensor::{Camera, CameraConfig, CameraError};
use crate::tracking::{SearchConfig, TrackingConfig};
use crate::vision::{DepthConfig, MatchingConfig, PatchConfig, RansacConfig};
use serde::{Deserialize, Serialize};

/// The settings of the pipeline behind the front end.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct OdometryConfig {
    pub imu: ImuConfig,
    pub camera: CameraConfig,
    /// Further cameras of the body, by their index less one, whose images as taken come with those of
    /// `camera`; a log without such images does not use them.
    pub others: Vec<CameraConfig>,
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
    pub faults: FaultConfig,
}

impl OdometryConfig {
    /// The part that tracking depends on.
    ///
    /// # Errors
    /// See [`CameraConfig::validate`].
    pub fn tracking(&self) -> Result<TrackingConfig, CameraError> {
        Ok(TrackingConfig {
            lens: Camera::new(&self.camera)?.with_depth(self.depth.along),
            camera: self.camera.clone(),
            depth: self.depth.clone(),
            search: self.search.clone(),
            matching: self.matching.clone(),
            patch: self.patch.clone(),
            ransac: self.ransac.clone(),
            measurement_inflation: self.filter.measurement_inflation,
            proven_observations: self.filter.state_min_observations,
        })
    }
}
