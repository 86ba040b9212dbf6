//! Worlds, motions and sensors.

mod config;
mod imperfections;
mod inertial;
mod landmarks;
mod lens;
mod measured;
mod motion;
mod render;
mod sensors;
mod spline;
mod texture;
mod trajectory;
mod world;

pub use config::{ImuSensorConfig, LightConfig, SceneConfig, SceneError, TruthConfig};
pub use imperfections::{ImperfectionConfig, Imperfections, VibrationConfig};
pub use inertial::ImuSimulator;
pub use landmarks::{LandmarkFrame, LandmarkScene, LandmarkSceneConfig, LandmarkSighting};
pub use measured::{MeasuredImu, MeasuredImuError};
pub use motion::{BodyState, Motion, MotionConfig, MotionKind};
pub use render::{DropoutConfig, ImageConfig, Renderer, Shot};
pub use sensors::Simulation;
pub use trajectory::{Carrier, TrajectoryConfig, TrajectoryError};
pub use world::{PeopleConfig, RoomConfig, World};
