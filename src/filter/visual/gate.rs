//! Which points an update may use.

use nalgebra::{Isometry3, Rotation3, Vector3};
use statrs::distribution::{ChiSquared, ContinuousCDF};

use super::body_points::BodyPoints;
use super::config::FilterConfig;
use super::estimator::Gating;
use crate::alignment::{PointPair, PoseInformation, RobustKernel, WeightedResidual};

/// Coordinates of a point.
const DEGREES_OF_FREEDOM: f64 = 3.0;

/// Leaves out points whose innovation is improbable.
///
/// If all but a quarter of the points fail, it is the prediction that is wrong and not they: then
/// all pass, to be weighed by the robust kernel alone. (Half of them may lie on something that
/// moves.)
#[derive(Debug, Clone)]
pub struct Gate {
    /// Squared Mahalanobis distance.
    threshold: f64,
    kernel: RobustKernel,
    /// The pairs last offered as the predicted pose sees them, `None` if they are unusable. Kept
    /// between updates, so that they do not allocate.
    residuals: Vec<Option<WeightedResidual>>,
    /// For each pair offered whether it was accepted.
    passed: Vec<bool>,
}

impl Gate {
    pub fn new(config: &FilterConfig) -> Self {
        let distribution = ChiSquared::new(DEGREES_OF_FREEDOM).ok();
        let threshold = distribution
            .filter(|_| config.has_gate())
            .map_or(f64::INFINITY, |chi_squared| chi_squared.inverse_cdf(config.gate_probability));
        let kernel = config.kernel();
        Self { threshold, kernel, residuals: Vec::new(), passed: Vec::new() }
    }

    /// Sorts out the points, and sums up what those that passed tell of the pose, weighted as at
    /// `pose`; `predicted` says where the belief has them.
    pub fn screen(
        &mut self,
        pairs: &[PointPair],
        pose: &Isometry3<f64>,
        predicted: &BodyPoints,
    ) -> (Gating, PoseInformation) {
        let (rotation, position) = (pose.rotation.to_rotation_matrix(), &pose.translation.vector);
        let mut residuals = std::mem::take(&mut self.residuals);
        residuals.clear();
        residuals.extend(pairs.iter().map(|pair| WeightedResidual::at(pair, &rotation, position)));
        let (threshold, mut largest) = (self.threshold, 0.0_f64);
        let distance = |(pair, residual): (&PointPair, &Option<WeightedResidual>)| {
            // Unusable pairs are no evidence against the prediction.
            let Some(residual) = residual else { return 0.0 };
            let innovation = pair.in_world - predicted.position(&pair.in_body);
            // Were the pose exact the distance would be larger: most points need no more.
            let bound = residual.weight.quadratic(&innovation);
            if bound <= threshold.min(largest) {
                return bound;
            }
            let exact = squared_distance(pair, &rotation, predicted, &innovation);
            largest = largest.max(exact);
            exact
        };
        let gating = self.judge(pairs.iter().zip(&residuals).map(distance));
        for (passed, residual) in self.passed.iter_mut().zip(&residuals) {
            *passed &= residual.is_some();
        }
        let passed = residuals.iter().zip(&self.passed).filter(|(_, passed)| **passed);
        let entering = passed.filter_map(|(residual, _)| *residual);
        let information = PoseInformation::sum(entering, position, self.kernel);
        self.residuals = residuals;
        (gating, information)
    }

    /// Says of points at these squared Mahalanobis distances from their predictions which pass.
    pub fn judge(&mut self, distances: impl Iterator<Item = f64>) -> Gating {
        let mut largest: f64 = 0.0;
        self.passed.clear();
        for distance in distances {
            largest = largest.max(distance);
            self.passed.push(distance <= self.threshold);
        }
        let rejected = self.passed.iter().filter(|passed| !**passed).count();
        if 4 * rejected > 3 * self.passed.len() {
            self.passed.fill(true);
            return Gating { largest, threshold: f64::INFINITY, rejected: 0 };
        }
        Gating { largest, threshold: self.threshold, rejected }
    }

    /// For each pair last offered whether it passed.
    pub fn passed(&self) -> &[bool] {
        &self.passed
    }

    /// Indices of the pairs last offered that did not pass. (An empty list does not allocate.)
    pub fn refused(&self) -> Vec<usize> {
        (0..self.passed.len()).filter(|i| !self.passed[*i]).collect()
    }

    /// Those of the pairs last offered that passed.
    pub fn accepted<'a>(
        &'a self,
        pairs: &'a [PointPair],
    ) -> impl Iterator<Item = &'a PointPair> + Clone {
        pairs.iter().zip(&self.passed).filter(|(_, passed)| **passed).map(|(pair, _)| pair)
    }
}

/// Of an innovation against its covariance, that of the belief included. Zero if that is not
/// positive definite.
fn squared_distance(
    pair: &PointPair,
    world_from_body: &Rotation3<f64>,
    predicted: &BodyPoints,
    innovation: &Vector3<f64>,
) -> f64 {
    let covariance =
        pair.covariance(world_from_body.matrix()) + predicted.covariance().at(&pair.in_body);
    covariance.inverse_of_positive().map_or(0.0, |weight| weight.quadratic(innovation))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::inertial::{Belief, NavCovariance, NavState};
    use approx::assert_relative_eq;
    use nalgebra::{Matrix3, UnitQuaternion};
    use proptest::prelude::*;

    fn belief(pose: Isometry3<f64>, covariance: NavCovariance) -> Belief {
        let state = NavState {
            world_from_body: pose,
            velocity: Vector3::zeros(),
            gyro_bias: Vector3::zeros(),
            accel_bias: Vector3::zeros(),
        };
        Belief { state, covariance }
    }

    fn pair(error: f64) -> PointPair {
        PointPair {
            in_body: Vector3::x(),
            body_covariance: Matrix3::identity() * 0.01,
            in_world: Vector3::new(1.0, error, 0.0),
            world_covariance: Matrix3::identity() * 0.02,
        }
    }

    /// At the origin, where a point is known with a variance of 0.01.
    fn screen(gate: &mut Gate, pairs: &[PointPair]) -> Gating {
        let mut covariance = NavCovariance::zeros();
        covariance.fixed_view_mut::<3, 3>(6, 6).copy_from(&(Matrix3::identity() * 0.01));
        let predicted = BodyPoints::of_belief(&belief(Isometry3::identity(), covariance));
        gate.screen(pairs, &Isometry3::identity(), &predicted).0
    }

    #[test]
    fn improbable_points_stay_out() {
        let mut gate = Gate::new(&FilterConfig::default());
        // Variance 0.04, distance 1.2 is 36 = 6 standard deviations squared.
        let pairs = [pair(0.1), pair(-0.2), pair(1.2)];
        let found = screen(&mut gate, &pairs);
        assert_eq!((found.rejected, gate.accepted(&pairs).count()), (1, 2));
        assert!((found.largest - 36.0).abs() < 1e-9 && (found.threshold - 30.7).abs() < 0.1);
    }

    #[test]
    fn a_wrong_prediction_opens_the_gate() {
        let mut gate = Gate::new(&FilterConfig::default());
        let pairs = [pair(3.0), pair(2.0), pair(2.5), pair(2.0), pair(0.0)];
        let found = screen(&mut gate, &pairs);
        assert_eq!((found.rejected, gate.accepted(&pairs).count()), (0, 5));
        assert_eq!(found.threshold, f64::INFINITY);
        let mut none =
            Gate::new(&FilterConfig { gate_probability: 0.0, ..FilterConfig::default() });
        assert_eq!(screen(&mut none, &[pair(0.0), pair(9.0)]).rejected, 0);
    }

    #[test]
    fn what_is_undefined_never_passes() {
        let mut gate = Gate::new(&FilterConfig::default());
        let undefined = PointPair { in_world: Vector3::repeat(f64::NAN), ..pair(0.0) };
        let singular = PointPair {
            body_covariance: Matrix3::zeros(),
            world_covariance: Matrix3::zeros(),
            ..pair(0.0)
        };
        let closed = vec![pair(0.0), undefined, singular];
        let opened = vec![pair(9.0), pair(8.0), pair(7.0), pair(8.0), undefined];
        for pairs in [closed, opened] {
            let found = screen(&mut gate, &pairs);
            assert!(found.largest.is_finite());
            let usable = |pair: &PointPair| pair.in_world.x.is_finite() && *pair != singular;
            assert_eq!(gate.passed(), pairs.iter().map(usable).collect::<Vec<_>>());
            assert!(gate.accepted(&pairs).all(usable));
        }
    }

    fn vector(range: f64) -> impl Strategy<Value = Vector3<f64>> {
        proptest::array::uniform3(-range..range).prop_map(Vector3::from)
    }

    fn covariance() -> impl Strategy<Value = Matrix3<f64>> {
        proptest::array::uniform9(-0.2..0.2).prop_map(|root| {
            let root = Matrix3::from_row_slice(&root);
            root * root.transpose() + Matrix3::identity() * 1e-3
        })
    }

    proptest! {
        /// Points judged by the bound are judged as by their distances, and the sums are those of
        /// the points that passed.
        #[test]
        fn the_bound_changes_nothing(
            points in proptest::collection::vec(
                (vector(3.0), covariance(), vector(1.0), covariance()), 1..12),
            turn in vector(1.5), position in vector(5.0), spread in 0.0..0.3,
        ) {
            let pose = Isometry3::from_parts(
                position.into(), UnitQuaternion::from_scaled_axis(turn));
            let predicted = BodyPoints::of_belief(
                &belief(pose, NavCovariance::identity() * (spread * spread)));
            let pairs: Vec<_> = points.into_iter().map(|(in_body, a, off, b)| PointPair {
                in_body,
                body_covariance: a,
                in_world: (pose * nalgebra::Point3::from(in_body)).coords + off,
                world_covariance: b,
            }).collect();
            let config = FilterConfig { gate_probability: 0.9, ..FilterConfig::default() };
            let rotation = pose.rotation.to_rotation_matrix();
            let slow = |pair: &PointPair| {
                let seen = predicted.at(&pair.in_body);
                let turned = rotation.matrix() * pair.body_covariance
                    * rotation.matrix().transpose();
                let covariance = turned + pair.world_covariance + seen.covariance;
                let innovation = pair.in_world - seen.position;
                innovation.dot(&(covariance.try_inverse().unwrap() * innovation))
            };
            let (mut fast_gate, mut slow_gate) = (Gate::new(&config), Gate::new(&config));
            let (fast, information) = fast_gate.screen(&pairs, &pose, &predicted);
            let expected = slow_gate.judge(pairs.iter().map(slow));
            prop_assert_eq!(fast_gate.passed(), slow_gate.passed());
            assert_relative_eq!(fast.largest, expected.largest, max_relative = 1e-9);
            prop_assert_eq!(fast.rejected, expected.rejected);
            let apart = PoseInformation::accumulate(
                fast_gate.accepted(&pairs), &rotation, &position, config.kernel());
            prop_assert_eq!(information, apart);
        }
    }
}
