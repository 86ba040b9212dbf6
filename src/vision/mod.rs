//! Depth, features, their matching and the search for a consistent pose;
//! with the feature `vision`, the ORB front end.
//!
//! OpenCV is mentioned only inside the feature-gated part of this module.

mod depth;
mod feature;
#[cfg(feature = "vision")]
mod front_end;
mod mask;
mod matching;
#[cfg(feature = "vision")]
mod orb;
pub mod patch;
mod pyramid;
pub mod ransac;
mod registration;
#[cfg(feature = "vision")]
mod select;
mod stereo;
mod tracker;

pub use depth::{DepthConfig, DepthReading};
pub use feature::{
    Descriptor, Extraction, Feature, FeatureConfig, PointMeasurement, TrackedFeature,
};
#[cfg(feature = "vision")]
pub use front_end::VisualFrontEnd;
pub use mask::{Mask, MaskConfig, MaskError};
pub use matching::{Match, MatchingConfig, Prediction, match_descriptors, match_guided};
#[cfg(feature = "vision")]
pub use orb::{OrbExtractor, VisionError};
pub use patch::{PATCH_RADIUS, Patch, PatchConfig};
pub use pyramid::{Glimpse, Pyramid};
pub use ransac::{Correspondence, RansacConfig, agree_near, agreeing, estimate_pose};
pub use registration::DepthRegistration;
pub use stereo::{StereoError, StereoRig, rectified_camera};
#[cfg(feature = "vision")]
pub use tracker::Tracker;
pub use tracker::TrackerConfig;
