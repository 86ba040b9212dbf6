//! Estimators: beliefs over attitude, velocity, position and biases, and how measurements
//! change them.

pub mod attitude;
mod bayes;
pub mod gnss;
mod visual;

pub use bayes::{
    AttitudeMeasurement, BayesFilter, Estimate, FilterError, Frame, InertialStep,
    PositionMeasurement, VectorEstimate, VectorMeasurement,
};
pub use visual::{
    FilterConfig, FilterKind, MapEstimate, MapTreatment, Mekf, MfgFilter, UpdateOutcome,
    VisualInertialFilter, point_by_pose, pose_covariance,
};
