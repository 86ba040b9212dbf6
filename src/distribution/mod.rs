//! Probability distributions on SO(3) and SO(3) x R^n.

mod bingham;
mod bingham_gaussian;
mod circle;
mod concentrated_gaussian;
pub mod matrix_fisher;
pub mod matrix_fisher_gaussian;
pub mod unscented;
mod von_mises_fisher;

pub use bingham::{Bingham, BinghamError, BinghamSampler};
pub use bingham_gaussian::{BinghamGaussian, BinghamGaussianError};
pub use concentrated_gaussian::{ConcentratedGaussian, NotPositiveDefinite};
pub use von_mises_fisher::{VonMisesFisher, VonMisesFisherError};
