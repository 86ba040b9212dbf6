//! Noise and biases of the IMU, and how a belief about the motion of the body is carried through
//! the kinematics.

mod clipping;
mod coverage;
mod directions;
pub mod identification;
mod imu;
mod initial;
mod noise;
mod propagation;
mod sensor_class;
mod state;

pub use clipping::{Clipped, ClippingMonitor};
pub use coverage::Coverage;
pub use directions::{
    BodyDirection, DirectionConfig, DirectionFinder, Directions, GravityConfig, MagneticConfig,
    Prediction, RestConfig,
};
pub use imu::ImuConfig;
pub use initial::{InitialAttitude, StandstillCheck, StandstillConfig, attitude_from_gravity};
pub(crate) use noise::DrivingNoise;
pub(crate) use propagation::symmetrize;
pub use propagation::{MotionModel, Propagator};
pub use sensor_class::{INFLATION, SensorClass};
pub use state::{Belief, NavCovariance, NavState, block, pose_covariance};
