//! What sensors deliver and how they are mounted: time stamps, IMU samples, images, frames,
//! reference poses, the events of a log in order of time, and camera calibrations.
//!
//! Plain values: nothing here reads a file, estimates or draws.

mod camera;
mod event;
mod frame;
mod geodesy;
mod image;
mod imu;
mod stamp;

pub use camera::{CameraConfig, PinholeCamera};
pub use event::{Event, Stream, TruthPose};
pub use frame::RgbdFrame;
pub use geodesy::{Datum, Geodetic};
pub use image::{ColorImage, DepthImage, PixelFormat};
pub use imu::{ImuSample, PositionFix};
pub use stamp::Stamp;
