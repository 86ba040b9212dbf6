//! The matrix Fisher-Gaussian filter.

use nalgebra::{Matrix3, Rotation3, SMatrix, SVector, UnitQuaternion, Vector3};

use super::{FilterConfig, UpdateOutcome, VisualInertialFilter, normalized_innovation};
use crate::alignment::{PointPair, PoseInformation, rotated_vector_by_rotation, vectorize};
use crate::inertial::{Belief, ImuSample, NavCovariance, NavState, Propagator, block, symmetrize};
use crate::so3::ProperSvd;

/// Euclidean part of the state: (velocity, position, gyro bias, accelerometer bias).
const EUCLIDEAN: usize = 12;
/// First of the Euclidean components in a belief's covariance.
const FIRST: usize = block::VELOCITY;
/// First component of the position within the Euclidean part.
const POSITION: usize = block::POSITION - FIRST;
/// Newton steps from the predicted attitude to the mode; it converges quadratically in 2 to 4.
const MAX_NEWTON_STEPS: usize = 20;
/// A Newton step below this ends the search, rad.
const NEWTON_TOLERANCE: f64 = 1e-10;

/// Filter whose belief is an MFG distribution (W22 chapter 3, body-frame variant MFGB).
///
/// Between updates the belief is carried in the concentrated form of W22 Theorem 3.4. An update
/// is made with the densities themselves: matrix Fisher prior, Euclidean part regressed on the
/// rotation matrix, and a likelihood that is quadratic in both (`PoseInformation`). The
/// Euclidean part is integrated out exactly; the marginal `log p(R)` is brought to its mode by
/// Newton's method on SO(3) and matched there by a matrix Fisher density with the same mode and
/// curvature, `F = M (tr(H)/2 I - H)`.
#[derive(Debug, Clone)]
pub struct MfgFilter {
    config: FilterConfig,
    propagator: Propagator,
    belief: Belief,
}

impl MfgFilter {
    pub fn new(config: &FilterConfig, propagator: Propagator, belief: Belief) -> Self {
        Self { config: config.clone(), propagator, belief }
    }
}

impl VisualInertialFilter for MfgFilter {
    fn belief(&self) -> &Belief {
        &self.belief
    }

    fn propagate(&mut self, from: &ImuSample, to: &ImuSample) -> bool {
        self.propagator.propagate(&mut self.belief, from, to)
    }

    fn coast(&mut self, seconds: f64) {
        self.propagator.coast(&mut self.belief, seconds);
    }

    fn update(&mut self, pairs: &[PointPair]) -> Option<UpdateOutcome> {
        let kernel = self.config.kernel();
        let pose = self.belief.state.world_from_body;
        let (mut rotation, mut position) =
            (pose.rotation.to_rotation_matrix(), pose.translation.vector);
        let mut innovation = None;
        let mut posterior = None;
        let mut points = 0;
        for _ in 0..=self.config.relinearizations {
            let information = PoseInformation::accumulate(pairs, &rotation, &position, kernel);
            if information.points == 0 {
                return None;
            }
            if innovation.is_none() {
                innovation = Some(normalized_innovation(&information, &self.belief)?);
            }
            points = information.points;
            let joint = Joint::of_prior(&self.belief, &position)?.conditioned(&information)?;
            let belief = joint.concentrate(&rotation)?;
            rotation = belief.state.world_from_body.rotation.to_rotation_matrix();
            position = belief.state.world_from_body.translation.vector;
            posterior = Some(belief);
        }
        self.belief = posterior.filter(Belief::is_finite)?;
        Some(UpdateOutcome { innovation: innovation?, points })
    }

    fn matrix_fisher(&self) -> Option<ProperSvd> {
        self.belief.attitude().map(|attitude| *attitude.svd())
    }
}

/// Density of `r = vec(R)` and the Euclidean part `x`, with the position relative to `origin`:
/// `log p(R) = linear^T r - r^T quadratic r / 2 + const`, `x | R ~ N(offset + slope r, covariance)`.
///
/// Matrix Fisher-Gaussian densities have this form with `quadratic = 0`; point likelihoods keep
/// it.
struct Joint {
    origin: Vector3<f64>,
    linear: SVector<f64, 9>,
    quadratic: SMatrix<f64, 9, 9>,
    offset: SVector<f64, EUCLIDEAN>,
    slope: SMatrix<f64, EUCLIDEAN, 9>,
    covariance: SMatrix<f64, EUCLIDEAN, EUCLIDEAN>,
}

impl Joint {
    /// The MFG with the mode and covariance of `belief` (W22 Theorem 3.4, backwards).
    fn of_prior(belief: &Belief, origin: &Vector3<f64>) -> Option<Self> {
        let state = &belief.state;
        let mode = state.world_from_body.rotation.to_rotation_matrix();
        let rotation_covariance =
            belief.covariance.fixed_view::<3, 3>(block::ROTATION, block::ROTATION).into_owned();
        let cross =
            belief.covariance.fixed_view::<EUCLIDEAN, 3>(FIRST, block::ROTATION).into_owned();
        let information = rotation_covariance.cholesky()?.inverse();
        let concentration = Matrix3::identity() * (0.5 * information.trace()) - information;

        let mut offset = SVector::<f64, EUCLIDEAN>::zeros();
        offset.fixed_rows_mut::<3>(0).copy_from(&state.velocity);
        let position = state.world_from_body.translation.vector - origin;
        offset.fixed_rows_mut::<3>(POSITION).copy_from(&position);
        offset.fixed_rows_mut::<3>(block::GYRO_BIAS - FIRST).copy_from(&state.gyro_bias);
        offset.fixed_rows_mut::<3>(block::ACCEL_BIAS - FIRST).copy_from(&state.accel_bias);
        Some(Self {
            origin: *origin,
            linear: vectorize(&(mode.matrix() * concentration)),
            quadratic: SMatrix::zeros(),
            offset,
            slope: cross * tangent_coordinate(mode.matrix(), &concentration),
            covariance: belief
                .covariance
                .fixed_view::<EUCLIDEAN, EUCLIDEAN>(FIRST, FIRST)
                .into_owned()
                - cross * information * cross.transpose(),
        })
    }

    /// Bayes' rule with a point likelihood about the same origin. Exact.
    fn conditioned(mut self, points: &PoseInformation) -> Option<Self> {
        debug_assert_eq!(self.origin, points.origin);
        // Given R, the points measure the position as `measured + by_rotation r` with covariance
        // `spread`.
        let spread = points.tt.cholesky()?.inverse();
        let measured = spread * points.eta_t;
        let by_rotation = -(spread * points.rt.transpose());

        let position_columns = self.covariance.fixed_columns::<3>(POSITION).into_owned();
        let position_covariance = self.covariance.fixed_view::<3, 3>(POSITION, POSITION);
        let weight = (position_covariance + spread).cholesky()?.inverse();
        let gain = position_columns * weight;
        let surprise = measured - self.offset.fixed_rows::<3>(POSITION);
        let surprise_slope = by_rotation - self.slope.fixed_rows::<3>(POSITION);

        // What the position could not explain is evidence about R, and so is the part of the
        // point likelihood that does not depend on the position.
        self.quadratic += points.rr
            + points.rt * by_rotation
            + surprise_slope.transpose() * weight * surprise_slope;
        self.linear +=
            points.eta_r - points.rt * measured - surprise_slope.transpose() * (weight * surprise);
        self.offset += gain * surprise;
        self.slope += gain * surprise_slope;
        self.covariance -= gain * position_columns.transpose();
        symmetrize(&mut self.covariance);
        Some(self)
    }

    /// Mode of `log p(R)` and minus its Hessian there, in body-frame rotation coordinates.
    fn mode(&self, start: &Rotation3<f64>) -> Option<(Rotation3<f64>, Matrix3<f64>)> {
        let mut mode = *start;
        for _ in 0..MAX_NEWTON_STEPS {
            let (gradient, information) = self.derivatives(&mode);
            // Away from the mode the exact Hessian may be indefinite; the Gauss-Newton part of
            // it never is.
            let step = match information.cholesky() {
                Some(cholesky) => cholesky.solve(&gradient),
                None => self.curvature(&mode).cholesky()?.solve(&gradient),
            };
            mode *= Rotation3::new(step);
            if step.norm() < NEWTON_TOLERANCE {
                break;
            }
        }
        mode.renormalize();
        let (_, information) = self.derivatives(&mode);
        information.iter().all(|x| x.is_finite()).then_some((mode, information))
    }

    /// Gradient of `log p(R exp(e^))` by `e`, and minus its Hessian.
    fn derivatives(&self, at: &Rotation3<f64>) -> (Vector3<f64>, Matrix3<f64>) {
        let d = rotated_vector_by_rotation(at.matrix());
        let slope = self.linear - self.quadratic * vectorize(at.matrix());
        let in_body = at.matrix().transpose() * Matrix3::from_column_slice(slope.as_slice());
        let second = (in_body + in_body.transpose()) * 0.5 - Matrix3::identity() * in_body.trace();
        (d.transpose() * slope, d.transpose() * self.quadratic * d - second)
    }

    fn curvature(&self, at: &Rotation3<f64>) -> Matrix3<f64> {
        let d = rotated_vector_by_rotation(at.matrix());
        d.transpose() * self.quadratic * d
    }

    /// The belief with this density's mode and moments, to second order in the rotation error.
    fn concentrate(&self, start: &Rotation3<f64>) -> Option<Belief> {
        let (mode, information) = self.mode(start)?;
        let rotation_covariance = information.cholesky()?.inverse();
        // E[R] = M (I + E[e^ e^] / 2).
        let shrink =
            (rotation_covariance - Matrix3::identity() * rotation_covariance.trace()) * 0.5;
        let mean = mode.matrix() * (Matrix3::identity() + shrink);
        let x = self.offset + self.slope * vectorize(&mean);
        let by_rotation = self.slope * rotated_vector_by_rotation(mode.matrix());
        let cross = by_rotation * rotation_covariance;

        let mut covariance = NavCovariance::zeros();
        covariance
            .fixed_view_mut::<3, 3>(block::ROTATION, block::ROTATION)
            .copy_from(&rotation_covariance);
        covariance.fixed_view_mut::<EUCLIDEAN, 3>(FIRST, block::ROTATION).copy_from(&cross);
        covariance
            .fixed_view_mut::<3, EUCLIDEAN>(block::ROTATION, FIRST)
            .copy_from(&cross.transpose());
        covariance
            .fixed_view_mut::<EUCLIDEAN, EUCLIDEAN>(FIRST, FIRST)
            .copy_from(&(self.covariance + cross * by_rotation.transpose()));
        symmetrize(&mut covariance);

        let part = |start: usize| x.fixed_rows::<3>(start - FIRST).into_owned();
        let position: Vector3<f64> = self.origin + part(block::POSITION);
        let state = NavState {
            world_from_body: nalgebra::Isometry3::from_parts(
                position.into(),
                UnitQuaternion::from_rotation_matrix(&mode),
            ),
            velocity: part(block::VELOCITY),
            gyro_bias: part(block::GYRO_BIAS),
            accel_bias: part(block::ACCEL_BIAS),
        };
        Some(Belief { state, covariance })
    }
}

/// The 3x9 matrix `L` with `L vec(R) = (K M^T R - R^T M K)^vee`: the `v_R` of MFGB (W22 3.2) in
/// body coordinates. It is zero at the mode `M` and grows there as `(tr(K) I - K) e`.
fn tangent_coordinate(mode: &Matrix3<f64>, concentration: &Matrix3<f64>) -> SMatrix<f64, 3, 9> {
    let left = concentration * mode.transpose();
    let mut l = SMatrix::zeros();
    for (component, (i, j)) in [(2, 1), (0, 2), (1, 0)].into_iter().enumerate() {
        for k in 0..3 {
            l[(component, 3 * j + k)] += left[(i, k)];
            l[(component, 3 * i + k)] -= left[(j, k)];
        }
    }
    l
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::alignment::RobustKernel;
    use approx::assert_relative_eq;
    use nalgebra::Isometry3;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn random_vector(rng: &mut ChaCha8Rng, scale: f64) -> Vector3<f64> {
        Vector3::from_fn(|_, _| rng.random_range(-scale..scale))
    }

    /// A belief with every correlation present and a rotation spread of about `spread` rad.
    fn belief(rng: &mut ChaCha8Rng, spread: f64) -> Belief {
        let root = NavCovariance::from_fn(|i, _| {
            let scale = if i < 3 { spread } else { 0.2 };
            scale * rng.random_range(-0.5..0.5)
        });
        let state = NavState {
            world_from_body: Isometry3::new(random_vector(rng, 3.0), random_vector(rng, 1.5)),
            velocity: random_vector(rng, 1.0),
            gyro_bias: random_vector(rng, 0.1),
            accel_bias: random_vector(rng, 0.1),
        };
        let mut covariance = root * root.transpose();
        for k in 0..15 {
            covariance[(k, k)] += if k < 3 { spread * spread * 0.1 } else { 0.01 };
        }
        Belief { state, covariance }
    }

    /// Points around the body, measured with isotropic noise, matched to a slightly wrong map.
    fn pairs(rng: &mut ChaCha8Rng, state: &NavState, sigma: f64, count: usize) -> Vec<PointPair> {
        (0..count)
            .map(|_| {
                let in_body = random_vector(rng, 3.0);
                let seen = state.world_from_body * nalgebra::Point3::from(in_body);
                PointPair {
                    in_body,
                    body_covariance: Matrix3::identity() * sigma.powi(2),
                    in_world: seen.coords + random_vector(rng, sigma),
                    world_covariance: Matrix3::identity() * (0.5 * sigma).powi(2),
                }
            })
            .collect()
    }

    fn log_density(joint: &Joint, r: &Rotation3<f64>, x: &SVector<f64, EUCLIDEAN>) -> f64 {
        let v = vectorize(r.matrix());
        let residual = x - joint.offset - joint.slope * v;
        let euclidean = residual.dot(&joint.covariance.cholesky().unwrap().solve(&residual));
        joint.linear.dot(&v) - 0.5 * v.dot(&(joint.quadratic * v)) - 0.5 * euclidean
    }

    #[test]
    fn the_tangent_coordinate_is_v_r() {
        let mode = Rotation3::new(Vector3::new(0.3, -1.2, 0.7));
        let turn = Rotation3::new(Vector3::new(-0.4, 0.5, 0.9));
        let k = Matrix3::new(5.0, 0.3, -0.2, 0.3, 4.0, 0.5, -0.2, 0.5, 2.0);
        let rotation = mode * turn;
        let skew = k * turn.matrix() - turn.matrix().transpose() * k;
        let expected = Vector3::new(skew[(2, 1)], skew[(0, 2)], skew[(1, 0)]);
        let l = tangent_coordinate(mode.matrix(), &k);
        assert_relative_eq!(l * vectorize(rotation.matrix()), expected, epsilon = 1e-12);
        assert_relative_eq!(l * vectorize(mode.matrix()), Vector3::zeros(), epsilon = 1e-12);
    }

    /// Bayes' rule holds at any attitude and state, however far from the mode.
    #[test]
    fn conditioning_is_exact() {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        for _ in 0..20 {
            let prior = belief(&mut rng, 0.8);
            let pairs = pairs(&mut rng, &prior.state, 0.3, 6);
            let at = prior.state.world_from_body;
            let (rotation, origin) = (at.rotation.to_rotation_matrix(), at.translation.vector);
            let likelihood =
                PoseInformation::accumulate(&pairs, &rotation, &origin, RobustKernel::None);
            let before = Joint::of_prior(&prior, &origin).unwrap();
            let after = Joint::of_prior(&prior, &origin).unwrap().conditioned(&likelihood).unwrap();
            let mut constant = None;
            for _ in 0..10 {
                let r = Rotation3::new(random_vector(&mut rng, 2.0));
                let x = SVector::<f64, EUCLIDEAN>::from_fn(|_, _| rng.random_range(-2.0..2.0));
                let t = origin + x.fixed_rows::<3>(POSITION);
                let bayes = log_density(&before, &r, &x) - 0.5 * likelihood.cost(&r, &t);
                let difference = log_density(&after, &r, &x) - bayes;
                let constant = *constant.get_or_insert(difference);
                assert_relative_eq!(difference, constant, epsilon = 1e-6 * (1.0 + bayes.abs()));
            }
        }
    }

    #[test]
    fn the_prior_has_the_moments_it_was_made_from() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let prior = belief(&mut rng, 0.02);
        let at = prior.state.world_from_body;
        let joint = Joint::of_prior(&prior, &at.translation.vector).unwrap();
        let back = joint.concentrate(&at.rotation.to_rotation_matrix()).unwrap();
        assert_relative_eq!(back.covariance, prior.covariance, epsilon = 1e-4);
        assert_relative_eq!(back.state.velocity, prior.state.velocity, epsilon = 1e-3);
    }

    #[test]
    fn derivatives_are_those_of_the_density() {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        let prior = belief(&mut rng, 0.5);
        let pairs = pairs(&mut rng, &prior.state, 0.3, 5);
        let at = prior.state.world_from_body;
        let (rotation, origin) = (at.rotation.to_rotation_matrix(), at.translation.vector);
        let likelihood =
            PoseInformation::accumulate(&pairs, &rotation, &origin, RobustKernel::None);
        let joint = Joint::of_prior(&prior, &origin).unwrap().conditioned(&likelihood).unwrap();
        let value = |e: Vector3<f64>| {
            let r = vectorize((rotation * Rotation3::new(e)).matrix());
            joint.linear.dot(&r) - 0.5 * r.dot(&(joint.quadratic * r))
        };
        let (gradient, information) = joint.derivatives(&rotation);
        let h = 1e-4;
        for i in 0..3 {
            let step = Vector3::ith(i, h);
            let slope = (value(step) - value(-step)) / (2.0 * h);
            assert_relative_eq!(slope, gradient[i], epsilon = 1e-4, max_relative = 1e-4);
            let second = (value(step) + value(-step) - 2.0 * value(Vector3::zeros())) / (h * h);
            assert_relative_eq!(-second, information[(i, i)], max_relative = 1e-3);
        }
    }

    /// Where everything is small, the extended Kalman filter and this one are the same.
    #[test]
    fn it_agrees_with_the_kalman_filter_in_the_limit() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut prior = belief(&mut rng, 1e-3);
        prior.covariance *= 1e-4;
        let pairs = pairs(&mut rng, &prior.state, 1e-4, 30);
        let config = FilterConfig { huber: 0.0, ..FilterConfig::default() };
        let propagator = Propagator::constant_velocity(1.0, 1.0);
        let mut mfg = MfgFilter::new(&config, propagator.clone(), prior);
        let mut mekf = super::super::Mekf::new(&config, propagator, prior);
        let (a, b) = (mfg.update(&pairs).unwrap(), mekf.update(&pairs).unwrap());
        assert_relative_eq!(a.innovation, b.innovation, max_relative = 1e-9);
        let (a, b) = (mfg.belief(), mekf.belief());
        let apart = a.state.world_from_body.rotation.angle_to(&b.state.world_from_body.rotation);
        assert!(apart < 1e-8, "{apart}");
        assert_relative_eq!(a.state.velocity, b.state.velocity, epsilon = 1e-6);
        assert_relative_eq!(a.covariance, b.covariance, epsilon = 1e-9);
    }

    #[test]
    fn degenerate_points_broaden_and_never_break() {
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        let prior = belief(&mut rng, 0.1);
        let all = pairs(&mut rng, &prior.state, 0.01, 3);
        for count in 0..=3 {
            let mut filter = MfgFilter::new(
                &FilterConfig::default(),
                Propagator::constant_velocity(1.0, 1.0),
                prior,
            );
            let outcome = filter.update(&all[..count]);
            assert_eq!(outcome.is_some(), count > 0);
            assert!(filter.belief().is_finite());
            assert!(filter.belief().covariance.cholesky().is_some());
        }
    }
}
