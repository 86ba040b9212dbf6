//! Recordings for the Rerun viewer: what the pipeline reports, to a file or to a running viewer.
//!
//! Nothing outside of this module mentions Rerun. The layout of a recording:
//!
//! | entity | holds |
//! | --- | --- |
//! | `world` | z-up view coordinates |
//! | `world/estimate/body` | estimated pose of the IMU; below it `camera` (mounting) and `camera/image` (pinhole) |
//! | `.../image/color`, `.../image/depth` | JPEG; 16-bit PNG |
//! | `.../image/keypoints/{inliers,outliers,new,unmatched,no_depth}` | key points by [role](crate::odometry::KeypointRole) |
//! | `.../image/keypoints/matches` | lines from the predicted to the measured pixel |
//! | `world/estimate/trajectory`, `world/estimate/covariance` | path; 3 sigma ellipsoid of the position |
//! | `world/truth/body`, `world/truth/trajectory` | the reference |
//! | `world/map` | map points, colored by their standard deviation |
//! | `plots/...` | errors, standard deviations, biases, counts, times, ... |
//! | `log` | the pipeline's notes |
//!
//! Timelines: `time` (the sensors' clock: a duration where it counts from a device's start, a
//! date where it counts from 1970) and `frame` (number of the camera frame).

#[cfg(feature = "viewer")]
mod blueprint;
mod config;
#[cfg(feature = "viewer")]
mod covariance;
#[cfg(feature = "viewer")]
mod error;
#[cfg(feature = "viewer")]
mod image;
#[cfg(feature = "viewer")]
mod plots;
#[cfg(feature = "viewer")]
mod recorder;
#[cfg(feature = "viewer")]
mod scene;
#[cfg(all(test, feature = "viewer"))]
mod tests;
#[cfg(feature = "viewer")]
mod timeline;

pub use config::{Contents, RecordingConfig};
#[cfg(feature = "viewer")]
pub use error::ViewerError;
#[cfg(feature = "viewer")]
pub use recorder::{Recorder, Sink};
