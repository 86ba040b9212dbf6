//! Estimators: beliefs over attitude, velocity, position and biases, and how measurements
//! change them.

mod state;

pub use state::{NavCovariance, NavState, block};
