//! Points followed from frame to frame.
//!
//! A point is sought where the turn of the camera (by the gyroscope) and its own last motion put it, by
//! aligning its first view, coarse to fine ([`alignment`]); the first view stays the reference, so that
//! nothing drifts. What is found must lead back to where the point was, and move with most others as a
//! rigid scene does ([`epipolar`]). Cells of the image that hold no point get a new one ([`corners`]).
//! In the images of further cameras it is sought on its epipolar line ([`across`]).

mod config;

#[cfg(feature = "vision")]
mod across;
#[cfg(feature = "vision")]
mod alignment;
#[cfg(feature = "vision")]
mod corners;
#[cfg(feature = "vision")]
mod epipolar;
#[cfg(feature = "vision")]
mod levels;
#[cfg(feature = "vision")]
mod motion;
#[cfg(feature = "vision")]
mod pipeline;
#[cfg(feature = "vision")]
mod track;
#[cfg(feature = "vision")]
mod turn;

#[cfg(all(test, feature = "vision"))]
mod tests;

pub use config::TrackerConfig;
#[cfg(feature = "vision")]
pub(super) use levels::make_grey;
#[cfg(feature = "vision")]
pub use pipeline::Tracker;
