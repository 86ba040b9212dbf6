//! Pose of one point set relative to another: the likelihood of a pose given matched points.

mod information;
mod kabsch;

pub use information::{
    PointPair, PoseInformation, RobustKernel, rotated_vector_by_rotation, vectorize,
};
pub use kabsch::{WeightedPair, weighted_kabsch};
