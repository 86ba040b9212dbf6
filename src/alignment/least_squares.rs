//! Levenberg-Marquardt on the sum of squared residuals: the conventional point estimate.

use nalgebra::{Matrix6, Rotation3, Vector3, Vector6};

use super::{PointPair, PoseInformation, RobustKernel};
use crate::so3::exp;

/// Settings of [`optimize_pose`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LeastSquaresConfig {
    pub max_iterations: usize,
    /// Damping of the first step, relative to the diagonal of the normal matrix.
    pub damping: f64,
    /// A step below this ends the iteration, rad and m.
    pub tolerance: f64,
}

impl Default for LeastSquaresConfig {
    fn default() -> Self {
        Self { max_iterations: 200, damping: 1e-3, tolerance: 1e-10 }
    }
}

/// Factor on the damping after a step that did, or did not, lower the cost.
const DAMPING_FACTOR: f64 = 10.0;
/// Damping beyond which no step helps.
const MAX_DAMPING: f64 = 1e12;

/// A minimum of the sum of squared residuals.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LeastSquaresPose {
    pub rotation: Rotation3<f64>,
    /// World coordinates, m.
    pub position: Vector3<f64>,
    /// Information `J^T J` of (body-frame rotation vector, position) there; its inverse is the
    /// covariance (W22 5.2.1) where the pose is determined.
    pub information: Matrix6<f64>,
    /// The minimum.
    pub cost: f64,
    pub iterations: usize,
}

impl LeastSquaresPose {
    /// `(J^T J)^-1`; `None` where the points do not determine the pose.
    pub fn covariance(&self) -> Option<Matrix6<f64>> {
        Some(self.information.cholesky()?.inverse())
    }
}

/// The pose that is downhill from the given one in
/// `sum |R p' + t - p|^2_W`, `W = (R A R^T + B)^-1` renewed at every step. `None` without a pair
/// of positive definite covariance or if the start is not finite.
///
/// The map points of the full problem are eliminated in closed form, which has the same minimum.
pub fn optimize_pose(
    pairs: &[PointPair],
    rotation: &Rotation3<f64>,
    position: &Vector3<f64>,
    config: &LeastSquaresConfig,
) -> Option<LeastSquaresPose> {
    let normal = |rotation: &Rotation3<f64>, position: &Vector3<f64>| {
        let form = PoseInformation::accumulate(pairs, rotation, position, RobustKernel::None);
        let cost = form.cost(rotation, position);
        (form.points > 0 && cost.is_finite()).then(|| (form.linearized(rotation), cost))
    };
    let (mut rotation, mut position) = (*rotation, *position);
    let ((mut information, mut vector), mut cost) = normal(&rotation, &position)?;
    let mut damping = config.damping;
    let mut iterations = 0;
    while iterations < config.max_iterations && damping < MAX_DAMPING {
        iterations += 1;
        let step = damped(&information, damping).cholesky()?.solve(&vector);
        let turned = rotation * exp(&step.fixed_rows::<3>(0).into_owned());
        let moved = position + step.fixed_rows::<3>(3);
        match normal(&turned, &moved) {
            Some((equations, lower)) if lower <= cost => {
                (rotation, position, cost) = (turned, moved, lower);
                (information, vector) = equations;
                damping /= DAMPING_FACTOR;
            }
            _ => damping *= DAMPING_FACTOR,
        }
        if step.norm() < config.tolerance {
            break;
        }
    }
    rotation.renormalize();
    Some(LeastSquaresPose { rotation, position, information, cost, iterations })
}

/// The normal matrix with its diagonal raised, and kept positive where the pose is undetermined.
fn damped(information: &Matrix6<f64>, damping: f64) -> Matrix6<f64> {
    let diagonal = information.diagonal();
    let floor = diagonal.amax() * f64::EPSILON;
    let raised = diagonal.map(|d| damping * d + floor);
    information + Matrix6::from_diagonal(&Vector6::from(raised))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::alignment::{WeightedPair, weighted_kabsch};
    use nalgebra::Matrix3;

    fn pair(in_body: Vector3<f64>, error: Vector3<f64>) -> PointPair {
        let rotation = Rotation3::new(Vector3::new(0.4, -0.2, 0.9));
        PointPair {
            in_body,
            body_covariance: Matrix3::identity() * 0.01,
            in_world: rotation * in_body + Vector3::new(5.0, 1.0, -2.0) + error,
            world_covariance: Matrix3::identity() * 0.02,
        }
    }

    #[test]
    fn it_finds_the_closed_form_from_afar() {
        let pairs: Vec<_> = (0..8u32)
            .map(|i| {
                let phase = f64::from(i);
                let point = Vector3::new(phase.sin(), (2.0 * phase).cos(), 0.3 * phase);
                pair(point, Vector3::repeat(0.1 * (5.0 * phase).sin()))
            })
            .collect();
        let weighted = pairs.iter().map(|pair| WeightedPair {
            from: pair.in_body,
            to: pair.in_world,
            weight: 1.0,
        });
        let closed = weighted_kabsch(weighted).unwrap();
        let config = LeastSquaresConfig::default();
        let found =
            optimize_pose(&pairs, &Rotation3::identity(), &Vector3::zeros(), &config).unwrap();
        let apart = closed.rotation.to_rotation_matrix().angle_to(&found.rotation);
        assert!(apart < 1e-7, "{apart}");
        assert!((closed.translation.vector - found.position).norm() < 1e-7);
        assert!(found.covariance().is_some() && found.iterations < 50);
    }

    #[test]
    fn an_undetermined_pose_has_a_minimum_and_no_covariance() {
        let line = [0.0, 1.0, 2.0].map(|x| pair(Vector3::new(x, 0.0, 0.0), Vector3::zeros()));
        let config = LeastSquaresConfig::default();
        let found =
            optimize_pose(&line, &Rotation3::identity(), &Vector3::zeros(), &config).unwrap();
        assert!(found.cost < 1e-12, "{}", found.cost);
        let spread = found.covariance().map_or(f64::INFINITY, |covariance| covariance.amax());
        assert!(spread > 1e6, "{spread}");
        assert_eq!(optimize_pose(&[], &found.rotation, &found.position, &config), None);
    }
}
