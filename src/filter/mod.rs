//! Estimators: beliefs over attitude, velocity, position and biases, and how measurements
//! change them.

mod visual;

pub use visual::{
    FilterConfig, FilterKind, MapEstimate, MapTreatment, Mekf, MfgFilter, UpdateOutcome,
    VisualInertialFilter, point_by_pose,
};
