use nalgebra::Isometry3;

use super::EvaluationError;

/// Poses over time: at least one, finite, in the order of their stamps.
///
/// Stamps are seconds in a `f64`: 0.24 us on an epoch clock, well below any tolerance of
/// association, and the number that `evo` compares, so that ties fall the same way.
#[derive(Debug, Clone, PartialEq)]
pub struct Trajectory {
    stamps: Vec<f64>,
    poses: Vec<Isometry3<f64>>,
}

impl Trajectory {
    /// `poses[i]` maps body to world coordinates at `stamps[i]` (s). Equal stamps may follow each
    /// other; a stamp before its predecessor is an error.
    pub fn new(stamps: Vec<f64>, poses: Vec<Isometry3<f64>>) -> Result<Self, EvaluationError> {
        if stamps.len() != poses.len() {
            return Err(EvaluationError::LengthMismatch {
                stamps: stamps.len(),
                poses: poses.len(),
            });
        }
        if stamps.is_empty() {
            return Err(EvaluationError::Empty);
        }
        let finite = |(stamp, pose): (&f64, &Isometry3<f64>)| {
            stamp.is_finite()
                && pose.translation.vector.iter().all(|x| x.is_finite())
                && pose.rotation.coords.iter().all(|x| x.is_finite())
        };
        if let Some(index) = stamps.iter().zip(&poses).position(|pair| !finite(pair)) {
            return Err(EvaluationError::NotFinite { index });
        }
        if let Some(index) = stamps.windows(2).position(|w| w[1] < w[0]) {
            return Err(EvaluationError::Unordered { index: index + 1 });
        }
        Ok(Self { stamps, poses })
    }

    /// Seconds.
    pub fn stamps(&self) -> &[f64] {
        &self.stamps
    }

    /// `world_from_body` at each stamp.
    pub fn poses(&self) -> &[Isometry3<f64>] {
        &self.poses
    }

    /// Never 0.
    #[allow(clippy::len_without_is_empty)]
    pub fn len(&self) -> usize {
        self.poses.len()
    }

    /// First and last stamp, s.
    pub fn range(&self) -> [f64; 2] {
        [self.stamps[0], self.stamps[self.stamps.len() - 1]]
    }

    /// Median time between neighbours (s); `None` for a single pose or where most stamps are
    /// equal.
    pub fn median_interval(&self) -> Option<f64> {
        let mut intervals: Vec<f64> = self.stamps.windows(2).map(|w| w[1] - w[0]).collect();
        let middle = intervals.len() / 2;
        if intervals.is_empty() {
            return None;
        }
        let (_, median, _) = intervals.select_nth_unstable_by(middle, f64::total_cmp);
        Some(*median).filter(|median| *median > 0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_trajectory_is_refused() {
        let pose = Isometry3::identity();
        let broken = Isometry3::translation(f64::NAN, 0.0, 0.0);
        assert!(matches!(Trajectory::new(vec![], vec![]), Err(EvaluationError::Empty)));
        assert!(matches!(
            Trajectory::new(vec![0.0], vec![]),
            Err(EvaluationError::LengthMismatch { stamps: 1, poses: 0 })
        ));
        assert!(matches!(
            Trajectory::new(vec![0.0, 1.0, 0.5], vec![pose; 3]),
            Err(EvaluationError::Unordered { index: 2 })
        ));
        assert!(matches!(
            Trajectory::new(vec![0.0, 1.0], vec![pose, broken]),
            Err(EvaluationError::NotFinite { index: 1 })
        ));
        assert!(Trajectory::new(vec![0.0, 0.0], vec![pose; 2]).is_ok());
    }
}
