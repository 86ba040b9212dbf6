//! Estimators: beliefs over attitude, velocity, position and biases, and how measurements
//! change them.

pub mod attitude;
mod bayes;
pub mod gnss;
mod third_moments;
mod visual;

pub use crate::alignment::MapEstimate;
pub use bayes::{
    AttitudeMeasurement, BayesFilter, Estimate, FilterError, Frame, InertialStep,
    PositionMeasurement, VectorEstimate, VectorMeasurement,
};
pub use visual::{
    BodyPoints, Calibration, Candidate, Coordinates, FilterConfig, FilterKind, KnownAttitude,
    MapRefinement, MapTreatment, Mekf, MfgFilter, MotionSpread, PointState, Rest, Screening,
    SeenPoint, SlamFilter, UpdateMethod, UpdateOutcome, VisualInertialFilter, calibration_block,
    choose_points, point_by_pose,
};
