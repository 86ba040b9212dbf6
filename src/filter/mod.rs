//! Estimators: beliefs over attitude, velocity, position and biases, and how measurements
//! change them.

mod gaussian;
mod matrix_fisher_gaussian;
mod visual;

pub use gaussian::Mekf;
pub use matrix_fisher_gaussian::MfgFilter;
pub use visual::{
    FilterConfig, FilterKind, MapEstimate, MapTreatment, UpdateOutcome, VisualInertialFilter,
    point_by_pose,
};
