//! Where a belief has the points that are fixed in the body.

use nalgebra::{Matrix3, SMatrix, Vector3};

use super::euclidean::{EUCLIDEAN, POSITION};
use crate::alignment::{MapEstimate, PointQuadratic};
use crate::distribution::regression::RotationRegression;
use crate::distribution::rotation_quadratic::RotationMoments;
use crate::inertial::{Belief, pose_covariance};

/// Mean and covariance of `R p' + t` for any `p'`, W22 (5.84), (5.85): polynomials in `p'`, whose
/// coefficients are the same for all points of a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BodyPoints {
    /// Factors of the numbers `u = (p', 1)`.
    mean: [Vector3<f64>; 4],
    covariance: PointQuadratic,
}

impl BodyPoints {
    /// To first order in the rotation error.
    pub fn of_belief(belief: &Belief) -> Self {
        let pose = &belief.state.world_from_body;
        let rotation = pose.rotation.to_rotation_matrix();
        let columns: [Vector3<f64>; 3] =
            std::array::from_fn(|k| rotation.matrix().column(k).into());
        // R (p' + e x p') + t by (e, t).
        let by_pose = |by_rotation: Matrix3<f64>, by_position: Matrix3<f64>| {
            let mut map = SMatrix::<f64, 3, 6>::zeros();
            map.fixed_columns_mut::<3>(0).copy_from(&by_rotation);
            map.fixed_columns_mut::<3>(3).copy_from(&by_position);
            map
        };
        let lever = |axis: Vector3<f64>| -(rotation.matrix() * axis.cross_matrix());
        let turned = |axis| by_pose(lever(axis), Matrix3::zeros());
        let maps = [
            turned(Vector3::x()),
            turned(Vector3::y()),
            turned(Vector3::z()),
            by_pose(Matrix3::zeros(), Matrix3::identity()),
        ];
        Self {
            mean: [columns[0], columns[1], columns[2], pose.translation.vector],
            covariance: PointQuadratic::mapped(&maps, &pose_covariance(&belief.covariance)),
        }
    }

    /// Exactly, for an attitude with the given moments.
    pub fn of_density(density: &RotationRegression<EUCLIDEAN>, attitude: &RotationMoments) -> Self {
        // R p' + t by (vec R, what is left of t given R).
        let column = |k: usize| {
            let mut map = SMatrix::<f64, 3, 12>::zeros();
            map.fixed_columns_mut::<3>(3 * k).fill_with_identity();
            map
        };
        let slope = density.slope.fixed_rows::<3>(POSITION);
        let mut position = SMatrix::<f64, 3, 12>::zeros();
        position.fixed_columns_mut::<9>(0).copy_from(&slope);
        position.fixed_columns_mut::<3>(9).fill_with_identity();
        let mut covariance = SMatrix::<f64, 12, 12>::zeros();
        covariance.fixed_view_mut::<9, 9>(0, 0).copy_from(&attitude.covariance);
        covariance
            .fixed_view_mut::<3, 3>(9, 9)
            .copy_from(&density.covariance.fixed_view::<3, 3>(POSITION, POSITION));
        let rotation = attitude.mean_rotation();
        let mean = density.offset.fixed_rows::<3>(POSITION) + slope * attitude.mean;
        Self {
            mean: [
                rotation.column(0).into(),
                rotation.column(1).into(),
                rotation.column(2).into(),
                mean,
            ],
            covariance: PointQuadratic::mapped(
                &[column(0), column(1), column(2), position],
                &covariance,
            ),
        }
    }

    /// Mean and covariance (world, m and m^2) of the point at `in_body`.
    pub fn at(&self, in_body: &Vector3<f64>) -> MapEstimate {
        let covariance = self.covariance.at(in_body).matrix();
        MapEstimate { position: self.position(in_body), covariance }
    }

    pub(super) fn position(&self, in_body: &Vector3<f64>) -> Vector3<f64> {
        let [x, y, z, origin] = &self.mean;
        x * in_body.x + y * in_body.y + z * in_body.z + origin
    }

    pub(super) fn covariance(&self) -> &PointQuadratic {
        &self.covariance
    }
}

#[cfg(test)]
mod tests {
    use super::super::map_points::point_by_pose;
    use super::*;
    use crate::distribution::matrix_fisher::MatrixFisher;
    use crate::inertial::{NavCovariance, NavState};
    use approx::assert_relative_eq;
    use nalgebra::{Isometry3, SVector};
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn random<const R: usize, const C: usize>(rng: &mut ChaCha8Rng) -> SMatrix<f64, R, C> {
        SMatrix::from_fn(|_, _| rng.random_range(-1.0..1.0))
    }

    #[test]
    fn the_polynomials_are_those_of_each_point() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        for _ in 0..20 {
            let root: NavCovariance = random(&mut rng);
            let state = NavState {
                world_from_body: Isometry3::new(random(&mut rng), random(&mut rng)),
                velocity: Vector3::zeros(),
                gyro_bias: Vector3::zeros(),
                accel_bias: Vector3::zeros(),
            };
            let belief = Belief { state, covariance: root * root.transpose() };
            let (points, in_body) = (BodyPoints::of_belief(&belief), random(&mut rng));
            let pose = &belief.state.world_from_body;
            let j = point_by_pose(pose.rotation.to_rotation_matrix().matrix(), &in_body);
            let spread = j * pose_covariance(&belief.covariance) * j.transpose();
            let found = points.at(&in_body);
            let seen = pose * nalgebra::Point3::from(in_body);
            assert_relative_eq!(found.position, seen.coords, epsilon = 1e-12);
            assert_relative_eq!(found.covariance, spread, epsilon = 1e-12);
        }
    }

    #[test]
    fn so_are_those_of_a_broad_belief() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        for _ in 0..20 {
            let attitude = MatrixFisher::new(&(random::<3, 3>(&mut rng) * 5.0)).unwrap();
            let root: SMatrix<f64, EUCLIDEAN, EUCLIDEAN> = random(&mut rng);
            let mean: SVector<f64, EUCLIDEAN> = random(&mut rng);
            let mut density =
                RotationRegression::independent(&attitude, mean, root * root.transpose());
            density.slope = random(&mut rng);
            let moments = RotationMoments::of_matrix_fisher(&attitude);
            let in_body = random(&mut rng);
            let found = BodyPoints::of_density(&density, &moments).at(&in_body);
            let (position, covariance) = density.point_moments(&moments, POSITION, &in_body);
            assert_relative_eq!(found.position, position, epsilon = 1e-12);
            assert_relative_eq!(found.covariance, covariance, epsilon = 1e-12);
        }
    }
}
