use super::relative::{nearest_after, path_lengths, relative_error};
use super::{EvaluationError, PosePairs, Relation, Statistics};

/// Relative error over all sub-trajectories of one length.
#[derive(Debug, Clone, PartialEq)]
pub struct SubTrajectoryError {
    /// Path length along the reference, m.
    pub length: f64,
    /// One a sub-trajectory, m.
    pub translation_errors: Vec<f64>,
    /// One a sub-trajectory, degrees.
    pub rotation_errors: Vec<f64>,
    pub translation: Statistics,
    pub rotation: Statistics,
}

impl SubTrajectoryError {
    /// Mean translation error as a percentage of the length.
    pub fn drift_percent(&self) -> f64 {
        100.0 * self.translation.mean / self.length
    }
}

/// The end of a sub-trajectory may miss its length by this fraction of it (the default of
/// Zhang and Scaramuzza's toolbox).
const LENGTH_TOLERANCE: f64 = 0.2;

/// Relative error over sub-trajectories (Zhang and Scaramuzza 2018, as in OpenVINS): from every
/// matched pose to the one whose distance along the reference is nearest to `length`.
///
/// Lengths (m) that the reference does not cover are left out of the result.
pub fn sub_trajectory_errors(
    pairs: &PosePairs,
    lengths: &[f64],
) -> Result<Vec<SubTrajectoryError>, EvaluationError> {
    let path = path_lengths(&pairs.reference);
    let mut results = Vec::new();
    for &length in lengths {
        if !(length > 0.0 && length.is_finite()) {
            let (name, expected) = ("lengths", "above 0");
            return Err(EvaluationError::Option { name, expected, value: length });
        }
        let differences: Vec<_> = (0..path.len())
            .filter_map(|i| {
                let j = nearest_after(&path, i, length, LENGTH_TOLERANCE * length)?;
                Some(relative_error(pairs, (i, j)))
            })
            .collect();
        let errors = |relation: Relation| -> Vec<f64> {
            differences.iter().map(|difference| relation.of(difference)).collect()
        };
        let translation_errors = errors(Relation::Translation);
        let rotation_errors = errors(Relation::Angle);
        let statistics = (Statistics::of(&translation_errors), Statistics::of(&rotation_errors));
        if let (Some(translation), Some(rotation)) = statistics {
            results.push(SubTrajectoryError {
                length,
                translation_errors,
                rotation_errors,
                translation,
                rotation,
            });
        }
    }
    Ok(results)
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;
    use nalgebra::Isometry3;

    /// A straight path of 10 m in steps of 0.1 m that the estimate takes for 1 % longer.
    fn pairs() -> PosePairs {
        let path = |scale: f64| -> Vec<_> {
            (0..=100)
                .map(|i| Isometry3::translation(scale * f64::from(i) * 0.1, 0.0, 0.0))
                .collect()
        };
        PosePairs {
            stamps: (0..=100).map(f64::from).collect(),
            reference: path(1.0),
            estimate: path(1.01),
            reference_poses: 101,
            estimate_poses: 101,
            shared: 0,
        }
    }

    #[test]
    fn a_scale_error_of_one_percent_drifts_by_one_percent() {
        let errors = sub_trajectory_errors(&pairs(), &[1.0, 5.0, 50.0]).unwrap();
        assert_eq!(errors.len(), 2);
        for error in &errors {
            // Sub-trajectories at the end are up to a fifth shorter, and so is their error.
            assert_relative_eq!(error.translation.max, 0.01 * error.length, epsilon = 1e-9);
            assert!((0.95..=1.0 + 1e-9).contains(&error.drift_percent()));
            assert!(error.rotation.max < 1e-9);
        }
        assert!(sub_trajectory_errors(&pairs(), &[-1.0]).is_err());
    }
}
