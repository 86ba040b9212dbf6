//! Estimators: beliefs over attitude, velocity, position and biases, and how measurements
//! change them.

pub mod attitude;
mod bayes;
pub mod gnss;
mod visual;

pub use crate::alignment::MapEstimate;
pub use bayes::{
    AttitudeMeasurement, BayesFilter, Estimate, FilterError, Frame, InertialStep,
    PositionMeasurement, VectorEstimate, VectorMeasurement,
};
pub use visual::{
    FilterConfig, FilterKind, MapTreatment, Mekf, MfgFilter, Screening, UpdateMethod,
    UpdateOutcome, VisualInertialFilter, point_by_pose, pose_covariance,
};
