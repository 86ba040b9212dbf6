//! Attitude from vectors measured at one time, without memory.

use nalgebra::Rotation3;

use super::super::core::{FilterError, VectorMeasurement};
use crate::so3::project_to_so3;

/// The rotation that maximises the likelihood of unit directions, Wahba's problem by singular
/// values (FNF lemma IV.1): the memoryless baseline of the studies.
///
/// With fewer than two independent directions one of the solutions.
pub fn wahba(measured: &[VectorMeasurement]) -> Result<Rotation3<f64>, FilterError> {
    Ok(project_to_so3(&VectorMeasurement::joint_parameter(measured)?)?)
}
