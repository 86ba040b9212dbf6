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
//! | `.../image/keypoints/tracks` | lines from where inliers were in the image before |
//! | `world/estimate/trajectory`, `world/estimate/covariance` | path; 3 sigma ellipsoid of the position |
//! | `world/truth/body`, `world/truth/trajectory` | the reference |
//! | `world/map` | map points, colored by [`MapColor`] |
//! | `world/map/ellipsoids` | their 3 sigma ellipsoids; to be switched on in `overview` |
//! | `belief/attitude/density` | points on the unit sphere of the world's directions, colored by the marginal matrix Fisher density of each body axis |
//! | `belief/attitude/{estimate,truth}` | the body axes |
//! | `belief/correlation` | correlation coefficients of (rotation, position) |
//! | `plots/...` | errors, standard deviations, NEES, innovations, biases, counts, times, ... |
//! | `log` | the pipeline's notes |
//!
//! Timelines: `time` (the sensors' clock: a duration where it counts from a device's start, a
//! date where it counts from 1970) and `frame` (number of the camera frame).
//!
//! A recording opens with the page of one [`Purpose`]; the others are tabs beside it.

#[cfg(feature = "viewer")]
mod belief;
#[cfg(feature = "viewer")]
mod blueprint;
#[cfg(feature = "viewer")]
mod comparison;
mod config;
#[cfg(feature = "viewer")]
mod covariance;
#[cfg(feature = "viewer")]
mod display;
#[cfg(feature = "viewer")]
mod error;
#[cfg(feature = "viewer")]
mod image;
#[cfg(feature = "viewer")]
mod keypoints;
#[cfg(feature = "viewer")]
mod layout;
#[cfg(feature = "viewer")]
mod map;
#[cfg(feature = "viewer")]
mod plots;
#[cfg(feature = "viewer")]
mod recorder;
#[cfg(feature = "viewer")]
mod scene;
#[cfg(feature = "viewer")]
mod sphere;
#[cfg(all(test, feature = "viewer"))]
mod tests;
#[cfg(feature = "viewer")]
mod timeline;

#[cfg(feature = "viewer")]
pub use comparison::{ComparedEstimate, record_comparison};
pub use config::{Contents, MapColor, Purpose, RecordingConfig};
#[cfg(feature = "viewer")]
pub use error::ViewerError;
#[cfg(feature = "viewer")]
pub use recorder::{Recorder, Sink};
