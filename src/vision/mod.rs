//! Images, cameras and depth; with the feature `vision`, the ORB front end.
//!
//! OpenCV is mentioned only inside the feature-gated part of this module.

mod camera;
mod depth;
mod image;

pub use camera::{CameraConfig, PinholeCamera};
pub use depth::DepthConfig;
pub use image::{ColorImage, DepthImage, PixelFormat};
