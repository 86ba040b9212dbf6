//! What sensors deliver and how they are mounted: time stamps, IMU samples, satellite fixes, images,
//! frames, reference poses, the events of a log in order of time, and camera calibrations.
//!
//! Plain values: nothing here reads a file, estimates or draws.

mod camera;
mod event;
mod frame;
mod geodesy;
mod gnss;
mod image;
mod imu;
mod magnetic;
mod stamp;

pub use camera::{Camera, CameraConfig, CameraError, CameraModel, DepthAlong, PinholeCamera};
pub use event::{Event, Stream, TruthPose};
pub use frame::RgbdFrame;
pub use geodesy::{Datum, Geodetic};
pub use gnss::{FixQuality, GnssFix};
pub use image::{ColorImage, DepthImage, PixelFormat};
pub use imu::{ImuSample, PositionFix};
pub use magnetic::MagneticSample;
pub use stamp::Stamp;
