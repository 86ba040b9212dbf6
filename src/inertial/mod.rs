//! Sensor time, IMU samples and their noise.

mod imu;
mod stamp;

pub use imu::{ImuConfig, ImuSample};
pub use stamp::Stamp;
