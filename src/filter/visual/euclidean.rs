//! The Euclidean part of the navigation state, as densities order it.

use crate::distribution::regression::RotationRegression;
use crate::inertial::block;

/// Euclidean part of the state: (velocity, position, gyro bias, accelerometer bias).
pub const EUCLIDEAN: usize = 12;
/// First of the Euclidean components in a belief's covariance.
pub const FIRST: usize = block::VELOCITY;
/// First component of the position within the Euclidean part.
pub const POSITION: usize = block::POSITION - FIRST;

/// Density of the attitude and the Euclidean part.
pub type NavRegression = RotationRegression<EUCLIDEAN>;
