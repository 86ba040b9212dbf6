//! Pose of one point set relative to another, with known correspondences (W22 5.2.1, 5.2.3).
//!
//! [`PoseInformation`] is the likelihood of a pose as one quadratic form in 12 numbers, whatever
//! the number of points. [`align`] makes a matrix Fisher-Gaussian distribution of it, and
//! [`align_progressively`] does so in the paper's way, by sigma points. [`optimize_pose`]
//! (Levenberg-Marquardt) and [`weighted_kabsch`] are the rivals that give a point estimate.

mod information;
mod kabsch;
mod least_squares;
mod map_point;
mod posterior;
mod progressive;
mod symmetric;

pub use crate::distribution::rotation_quadratic::{rotated_vector_by_rotation, vectorize};
pub(crate) use information::WeightedResidual;
pub use information::{PointPair, PoseInformation, RobustKernel};
pub use kabsch::{WeightedPair, weighted_kabsch};
pub use least_squares::{LeastSquaresConfig, LeastSquaresPose, optimize_pose};
pub use map_point::MapEstimate;
pub use posterior::{AlignmentError, PosePosterior, align};
pub use progressive::align_progressively;
pub(crate) use symmetric::PointQuadratic;
