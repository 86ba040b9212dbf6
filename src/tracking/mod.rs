//! From the features of a frame to observations of the map: points are predicted, matched near
//! their predictions, placed to a fraction of a pixel, verified by RANSAC, and those of the
//! filter's state that were not detected are sought where the agreed pose has them.
//!
//! Everything comes in and goes out as plain values; nothing here changes a belief or the map.

mod association;
mod config;
mod pose;
mod search;
mod shutter;
mod view;

pub use association::{Association, first_reference, in_body, reference};
pub use config::{SearchConfig, TrackingConfig};
pub use search::{FrameTracker, InView, Tracks};
pub use shutter::Shutter;
pub use view::{FrontEndFrame, Prediction, View};
