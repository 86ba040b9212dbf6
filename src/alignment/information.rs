use nalgebra::{Matrix3, Matrix6, Rotation3, SMatrix, SVector, Vector3, Vector6};

use super::symmetric::{PointQuadratic, Symmetric3};
use crate::distribution::regression::{JointInformation, RotationRegression};
use crate::distribution::rotation_quadratic::{
    RotationQuadratic, rotated_vector_by_rotation, vectorize,
};

/// A point measured in the body frame and the map point it was matched to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointPair {
    /// Measured position in body coordinates, m.
    pub in_body: Vector3<f64>,
    /// Covariance `A` of the measurement in body coordinates, m^2.
    pub body_covariance: Matrix3<f64>,
    /// Position in the map, world coordinates, m.
    pub in_world: Vector3<f64>,
    /// Covariance `B` of the map point in world coordinates, m^2 (zero: known exactly).
    pub world_covariance: Matrix3<f64>,
}

impl PointPair {
    /// Whether the measurement's covariance is the same whatever the attitude, up to rounding.
    pub fn is_isotropic_in_body(&self) -> bool {
        let a = &self.body_covariance;
        (a - Matrix3::identity() * a[(0, 0)]).amax() <= 1e-12 * a[(0, 0)]
    }

    /// `R A R^T + B`.
    pub(crate) fn covariance(&self, world_from_body: &Matrix3<f64>) -> Symmetric3 {
        Symmetric3::turned(&self.body_covariance, world_from_body)
            + Symmetric3::of(&self.world_covariance)
    }

    /// `(R A R^T + B)^-1`; `None` if that covariance is not positive definite.
    pub(crate) fn weight(&self, world_from_body: &Matrix3<f64>) -> Option<Symmetric3> {
        self.covariance(world_from_body).inverse_of_positive()
    }
}

/// A pair as it looks from a pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct WeightedResidual {
    in_body: Vector3<f64>,
    /// The map point relative to the position of the body, m.
    target: Vector3<f64>,
    /// Inverse of the residual's covariance, the pose being exact.
    pub weight: Symmetric3,
    /// Squared Mahalanobis distance.
    distance: f64,
}

impl WeightedResidual {
    /// `None` without a positive definite covariance or finite coordinates.
    pub fn at(
        pair: &PointPair,
        world_from_body: &Rotation3<f64>,
        position: &Vector3<f64>,
    ) -> Option<Self> {
        let weight = pair.weight(world_from_body.matrix())?;
        let target = pair.in_world - position;
        let distance = weight.quadratic(&(world_from_body * pair.in_body - target));
        let residual = Self { in_body: pair.in_body, target, weight, distance };
        distance.is_finite().then_some(residual)
    }
}

/// Down-weighting of residuals that the Gaussian model does not explain.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RobustKernel {
    /// Every residual counts in full.
    None,
    /// Huber: the weight falls as `scale / m` beyond a Mahalanobis distance `m` of `scale`.
    Huber { scale: f64 },
}

impl RobustKernel {
    fn weight(self, mahalanobis_squared: f64) -> f64 {
        match self {
            Self::Huber { scale } if mahalanobis_squared > scale * scale => {
                scale / mahalanobis_squared.sqrt()
            }
            _ => 1.0,
        }
    }
}

/// The Gaussian likelihood of a pose given point pairs, as one quadratic form in
/// `r = vec(R)` (columns stacked) and `t` (position of the body relative to [`Self::origin`]):
///
/// `-2 log L = sum_i |J_i (r, t) - p_i|^2_{W_i}`, `J_i = [p'_i^T (x) I, I]`,
/// `W_i = (R A_i R^T + B_i)^-1` at the attitude it was linearised at (exact if `A_i` is
/// isotropic). It is the sum (5.66) of W22 without its `O(N^2)` terms: one pass over the points,
/// and nothing after it depends on their number.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseInformation {
    /// World position that `t` is relative to; near the body, so that far-off worlds cost no
    /// digits.
    pub origin: Vector3<f64>,
    /// Information matrix and vector of `(r, t)`.
    pub joint: JointInformation,
    /// The form at `r = 0`, `t = 0`.
    pub constant: f64,
    /// Number of pairs that entered.
    pub points: usize,
}

impl PoseInformation {
    /// Accumulates `pairs` with the weights taken at the pose (`world_from_body`, `position`).
    ///
    /// Pairs without a positive definite covariance or finite coordinates are left out. `O(N)`, no allocation.
    pub fn accumulate<'a>(
        pairs: impl IntoIterator<Item = &'a PointPair>,
        world_from_body: &Rotation3<f64>,
        position: &Vector3<f64>,
        kernel: RobustKernel,
    ) -> Self {
        let residuals = pairs
            .into_iter()
            .filter_map(|pair| WeightedResidual::at(pair, world_from_body, position));
        Self::sum(residuals, position, kernel)
    }

    /// The same of residuals at one pose with the given position.
    pub(crate) fn sum(
        residuals: impl IntoIterator<Item = WeightedResidual>,
        position: &Vector3<f64>,
        kernel: RobustKernel,
    ) -> Self {
        let mut sums = PointSums::default();
        for residual in residuals {
            sums.add(&residual, kernel.weight(residual.distance));
        }
        sums.form(*position)
    }

    /// The form's value, i.e. the weighted sum of squared residuals, at a pose.
    pub fn cost(&self, world_from_body: &Rotation3<f64>, position: &Vector3<f64>) -> f64 {
        let r = vectorize(world_from_body.matrix());
        let t = position - self.origin;
        r.dot(&(self.joint.rr * r))
            + 2.0 * r.dot(&(self.joint.rx * t))
            + t.dot(&(self.joint.xx * t))
            - 2.0 * (self.joint.eta_r.dot(&r) + self.joint.eta_x.dot(&t))
            + self.constant
    }

    /// The density of `(R, t)` that the likelihood is without a prior (W22 theorem 5.3): the
    /// marginal of `R`, and `t | R`. Isotropic weights make the marginal matrix Fisher, exactly.
    /// `None` without points.
    pub fn density(&self) -> Option<RotationRegression<3>> {
        let joint = &self.joint;
        let covariance = joint.xx.cholesky()?.inverse();
        let offset = covariance * joint.eta_x;
        let slope = -(covariance * joint.rx.transpose());
        let attitude = RotationQuadratic {
            linear: joint.eta_r - joint.rx * offset,
            quadratic: joint.rr + joint.rx * slope,
        };
        Some(RotationRegression { attitude, offset, slope, covariance })
    }

    /// Information matrix and vector of `(e, t)` with `R = world_from_body exp(e^)`, linearised
    /// at `e = 0` and `t = 0`: what an extended Kalman filter makes of the likelihood.
    pub fn linearized(&self, world_from_body: &Rotation3<f64>) -> (Matrix6<f64>, Vector6<f64>) {
        let r = vectorize(world_from_body.matrix());
        let d = rotated_vector_by_rotation(world_from_body.matrix());
        let mut information = Matrix6::<f64>::zeros();
        let et = d.transpose() * self.joint.rx;
        information.fixed_view_mut::<3, 3>(0, 0).copy_from(&(d.transpose() * self.joint.rr * d));
        information.fixed_view_mut::<3, 3>(0, 3).copy_from(&et);
        information.fixed_view_mut::<3, 3>(3, 0).copy_from(&et.transpose());
        information.fixed_view_mut::<3, 3>(3, 3).copy_from(&self.joint.xx);
        let mut vector = Vector6::zeros();
        vector
            .fixed_rows_mut::<3>(0)
            .copy_from(&(d.transpose() * (self.joint.eta_r - self.joint.rr * r)));
        vector
            .fixed_rows_mut::<3>(3)
            .copy_from(&(self.joint.eta_x - self.joint.rx.transpose() * r));
        (information, vector)
    }
}

/// What a quadratic form in `(r, t)` needs of its points: each weight matrix has six different
/// entries and each `J_i` consists of the numbers `u = (p', 1)`, which makes 60 sums instead of the
/// 144 of the information matrix.
#[derive(Default)]
struct PointSums {
    /// Sums of `u_a u_b W`.
    weights: PointQuadratic,
    /// Sums of `u_a W p`.
    targets: [Vector3<f64>; 4],
    /// Sum of `p^T W p`.
    constant: f64,
    points: usize,
}

impl PointSums {
    fn add(&mut self, residual: &WeightedResidual, factor: f64) {
        let WeightedResidual { in_body, target, .. } = residual;
        let weight = residual.weight * factor;
        self.weights.add(in_body, &weight);
        let weighted = weight * target;
        for (sum, u) in self.targets.iter_mut().zip([in_body.x, in_body.y, in_body.z, 1.0]) {
            *sum += weighted * u;
        }
        self.constant += target.dot(&weighted);
        self.points += 1;
    }

    fn form(&self, origin: Vector3<f64>) -> PoseInformation {
        let mut joint = JointInformation {
            rr: SMatrix::zeros(),
            rx: SMatrix::zeros(),
            xx: Matrix3::zeros(),
            eta_r: SVector::zeros(),
            eta_x: self.targets[3],
        };
        for ((a, b), sum) in self.weights.coefficients() {
            let block = sum.matrix();
            match (a, b) {
                (3, _) => joint.xx = block,
                (_, 3) => joint.rx.fixed_view_mut::<3, 3>(3 * a, 0).copy_from(&block),
                _ => {
                    joint.rr.fixed_view_mut::<3, 3>(3 * a, 3 * b).copy_from(&block);
                    joint.rr.fixed_view_mut::<3, 3>(3 * b, 3 * a).copy_from(&block);
                }
            }
        }
        for a in 0..3 {
            joint.eta_r.fixed_rows_mut::<3>(3 * a).copy_from(&self.targets[a]);
        }
        PoseInformation { origin, joint, constant: self.constant, points: self.points }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;
    use proptest::prelude::*;

    fn vector(range: f64) -> impl Strategy<Value = Vector3<f64>> {
        [-range..range, -range..range, -range..range].prop_map(|v| Vector3::new(v[0], v[1], v[2]))
    }

    fn covariance() -> impl Strategy<Value = Matrix3<f64>> {
        (vector(1.0), vector(1.0), vector(1.0)).prop_map(|(a, b, c)| {
            let m = Matrix3::from_columns(&[a, b, c]);
            m * m.transpose() + Matrix3::identity() * 0.1
        })
    }

    fn pair() -> impl Strategy<Value = PointPair> {
        (vector(5.0), covariance(), vector(5.0), covariance()).prop_map(|(p, a, q, b)| PointPair {
            in_body: p,
            body_covariance: a,
            in_world: q,
            world_covariance: b,
        })
    }

    /// The sum of squared residuals with weights frozen at `at`, written out point by point.
    fn direct_cost(
        pairs: &[PointPair],
        at: &Rotation3<f64>,
        rotation: &Rotation3<f64>,
        position: &Vector3<f64>,
    ) -> f64 {
        let cost = |pair: &PointPair| {
            let covariance = at.matrix() * pair.body_covariance * at.matrix().transpose()
                + pair.world_covariance;
            let residual = rotation * pair.in_body + position - pair.in_world;
            residual.dot(&(covariance.try_inverse().unwrap() * residual))
        };
        pairs.iter().map(cost).sum()
    }

    proptest! {
        #[test]
        fn the_form_is_the_sum_of_squared_residuals(
            pairs in proptest::collection::vec(pair(), 0..8),
            at in vector(2.0), turn in vector(2.0), origin in vector(50.0), shift in vector(1.0),
        ) {
            let (at, rotation) = (Rotation3::new(at), Rotation3::new(turn));
            let form = PoseInformation::accumulate(&pairs, &at, &origin, RobustKernel::None);
            let position = origin + shift;
            let direct = direct_cost(&pairs, &at, &rotation, &position);
            prop_assert!((form.cost(&rotation, &position) - direct).abs() < 1e-9 * (1.0 + form.constant));
        }

        #[test]
        fn the_linearisation_is_the_gradient(
            pairs in proptest::collection::vec(pair(), 1..8), at in vector(2.0),
        ) {
            let at = Rotation3::new(at);
            let origin = Vector3::new(1.0, 2.0, 3.0);
            let form = PoseInformation::accumulate(&pairs, &at, &origin, RobustKernel::None);
            let (information, vector) = form.linearized(&at);
            let h = 1e-5;
            for k in 0..6 {
                let cost = |step: f64| {
                    let mut delta = Vector6::zeros();
                    delta[k] = step;
                    let turned = at * Rotation3::new(delta.fixed_rows::<3>(0).into_owned());
                    form.cost(&turned, &(origin + delta.fixed_rows::<3>(3)))
                };
                let slope = -(cost(h) - cost(-h)) / (4.0 * h);
                let scale = 1.0 + form.constant + information.norm();
                prop_assert!((slope - vector[k]).abs() < 1e-6 * scale, "{k}: {slope} {}", vector[k]);
            }
            prop_assert!((information - information.transpose()).norm() < 1e-9 * information.norm());
        }
    }

    #[test]
    fn huber_leaves_small_residuals_and_tames_large_ones() {
        let kernel = RobustKernel::Huber { scale: 2.0 };
        assert_relative_eq!(kernel.weight(3.9), 1.0);
        assert_relative_eq!(kernel.weight(100.0), 0.2);
        assert_relative_eq!(RobustKernel::None.weight(100.0), 1.0);
    }
}
