//! A belief whose attitude is too uncertain for a covariance: any matrix Fisher distribution, and
//! a Euclidean part with its whole regression on the attitude.

use nalgebra::{Isometry3, Matrix3, Rotation3, SMatrix, SVector, UnitQuaternion, Vector3};

use super::body_points::BodyPoints;
use super::euclidean::{EUCLIDEAN, FIRST, NavRegression, POSITION};
use super::zero_velocity::ZeroVelocity;
use crate::alignment::{PointPair, PoseInformation, RobustKernel};
use crate::distribution::matrix_fisher::MatrixFisher;
use crate::distribution::progressive::{ProgressiveConfig, progressive_update};
use crate::distribution::regression::{JointInformation, keep_rounding};
use crate::distribution::rotation_quadratic::{
    RotationMoments, RotationQuadratic, rotated_vector_by_rotation,
};
use crate::inertial::{Belief, NavCovariance, NavState, Propagator, block, symmetrize};

/// First component of the velocity within the Euclidean part, and of the biases.
const VELOCITY: usize = block::VELOCITY - FIRST;
const BIASES: usize = block::GYRO_BIAS - FIRST;

/// A belief with a matrix Fisher attitude, beside its first two moments.
#[derive(Debug, Clone)]
pub struct BroadBelief {
    attitude: MatrixFisher,
    rotation: RotationMoments,
    /// Position relative to the origin of the world.
    density: NavRegression,
}

impl BroadBelief {
    /// An attitude that is independent of the Euclidean part of `belief`.
    pub fn independent(belief: &Belief, attitude: &MatrixFisher) -> Self {
        let covariance =
            belief.covariance.fixed_view::<EUCLIDEAN, EUCLIDEAN>(FIRST, FIRST).into_owned();
        let mean = euclidean(&belief.state);
        Self::new(*attitude, NavRegression::independent(attitude, mean, covariance))
    }

    /// The matrix Fisher-Gaussian distribution that `belief` approximates (W22 theorem 3.4
    /// backwards).
    pub fn of_belief(belief: &Belief) -> Option<Self> {
        let density = of_belief(belief, &Vector3::zeros())?;
        let attitude = MatrixFisher::new(&density.attitude.as_matrix_fisher()?).ok()?;
        Some(Self::new(attitude, density))
    }

    fn new(attitude: MatrixFisher, density: NavRegression) -> Self {
        Self { attitude, rotation: RotationMoments::of_matrix_fisher(&attitude), density }
    }

    /// The marginal distribution of the attitude.
    pub fn attitude(&self) -> &MatrixFisher {
        &self.attitude
    }

    /// Where points are that are fixed in the body.
    pub fn body_points(&self) -> BodyPoints {
        BodyPoints::of_density(&self.density, &self.rotation)
    }

    /// Mode, mean and covariance. The covariance of the rotation is that of the rotation vector
    /// from the mode, however broad; its correlations are those of `(M^T R - R^T M)^v / 2`, the
    /// sine of that vector.
    pub fn summary(&self) -> Belief {
        let mode = self.attitude.mode();
        let (x, covariance, by_r) = self.density.vector_moments(&self.rotation);
        let rotation_covariance = self.attitude.rotation_covariance();
        let sine = gradient_coordinate(mode.matrix()) * 0.5;
        let axes = self.attitude.svd().v;
        let in_axes = axes.matrix().transpose()
            * (sine * self.rotation.covariance * sine.transpose())
            * axes.matrix();
        let angle_in_axes = axes.matrix().transpose() * rotation_covariance * axes.matrix();
        let scale = Vector3::from_fn(|i, _| {
            let variance = in_axes[(i, i)];
            if variance > 0.0 { (angle_in_axes[(i, i)] / variance).sqrt() } else { 0.0 }
        });
        let to_angle = axes.matrix() * Matrix3::from_diagonal(&scale) * axes.matrix().transpose();
        let cross = by_r * sine.transpose() * to_angle.transpose();
        Belief {
            state: nav_state(&mode, &x),
            covariance: assemble(&rotation_covariance, &cross, &covariance),
        }
    }

    /// Carries the belief through the mean inertial reading of `h` seconds.
    ///
    /// The relative motion over the interval (rotation, velocity and position in the frame of the
    /// body at its start) is Gaussian and all but exact, whatever the attitude; what depends on
    /// the attitude is linear in `r`. The error of the relative rotation is convolved with the
    /// attitude to second order; its correlation with the rest enters the regression as
    /// `E[y | R] = E[y] - Cov[y, e] grad log p(R)`. Expectations over the attitude are exact.
    /// `None`, and no change, if nothing finite comes out.
    pub fn propagate(
        &mut self,
        propagator: &Propagator,
        gyro: &Vector3<f64>,
        accel: &Vector3<f64>,
        h: f64,
    ) -> Option<()> {
        let (mean, covariance, _) = self.density.vector_moments(&self.rotation);
        let biases = nav_state(&Rotation3::identity(), &mean);
        let bias_covariance = covariance.fixed_view::<6, 6>(BIASES, BIASES).into_owned();
        let (motion, transition) =
            propagator.relative_motion(gyro, accel, &biases, &bias_covariance, h)?;
        let errors = MotionErrors {
            motion: &motion,
            by_bias: transition.fixed_columns::<6>(block::GYRO_BIAS).into_owned(),
            bias_covariance: &bias_covariance,
            turn: motion.state.world_from_body.rotation.to_rotation_matrix(),
        };
        let moved = self.composed(&errors, propagator.gravity(), h)?;
        let finite = moved.rotation.mean.iter().all(|x| x.is_finite())
            && moved.density.offset.iter().all(|x| x.is_finite())
            && moved.density.covariance.iter().all(|x| x.is_finite());
        if finite {
            *self = moved;
        }
        finite.then_some(())
    }

    fn composed(&self, errors: &MotionErrors, gravity: &Vector3<f64>, h: f64) -> Option<Self> {
        let MotionErrors { motion, by_bias, turn, .. } = errors;
        let rotation_error =
            motion.covariance.fixed_view::<3, 3>(block::ROTATION, block::ROTATION).into_owned();
        let blur = mean_turn(&rotation_error);
        let drift_of_attitude = self.mean_drift(by_bias, turn);
        let mean = self.attitude.mean() * turn.matrix() * blur + drift_of_attitude;
        let attitude = MatrixFisher::from_mean(&mean).ok()?;

        // x1 = A x0 + (what the motion adds, linear in r0), then r0 = (turn (x) I) r1.
        let drift = drift(h);
        let mut density = NavRegression {
            attitude: RotationQuadratic::matrix_fisher(&attitude.parameter()),
            offset: drift * self.density.offset,
            slope: drift * self.density.slope,
            covariance: self.density.covariance,
        };
        let position = motion.state.world_from_body.translation.vector;
        for (first, added, fall) in
            [(VELOCITY, motion.state.velocity, h), (POSITION, position, 0.5 * h * h)]
        {
            let mut offset = density.offset.fixed_rows_mut::<3>(first);
            offset += gravity * fall;
            for column in 0..3 {
                for axis in 0..3 {
                    density.slope[(first + axis, 3 * column + axis)] += added[column];
                }
            }
        }
        let x = density.offset + density.slope * self.rotation.mean;
        density.slope *= turn.matrix().kronecker(&Matrix3::identity());
        self.add_errors(&mut density, errors, &drift)?;
        let mut moved = Self::new(attitude, density);
        // The regression is of first order in the errors, the mean is exact.
        moved.density.offset = x - moved.density.slope * moved.rotation.mean;
        Some(moved)
    }

    /// What the part of the gyroscope bias that depends on the attitude adds to `E[R]`.
    fn mean_drift(&self, by_bias: &SMatrix<f64, 15, 6>, turn: &Rotation3<f64>) -> Matrix3<f64> {
        let rotation_by_r =
            by_bias.fixed_rows::<3>(block::ROTATION) * self.density.slope.fixed_rows::<6>(BIASES);
        let products = self.rotation.covariance * rotation_by_r.transpose();
        let about = |k: usize| {
            let product = Matrix3::from_column_slice(products.column(k).as_slice());
            product * turn.matrix() * Vector3::ith(k, 1.0).cross_matrix()
        };
        about(0) + about(1) + about(2)
    }

    /// Errors of the relative motion, in covariance and regression.
    fn add_errors(
        &self,
        density: &mut NavRegression,
        errors: &MotionErrors,
        drift: &SMatrix<f64, EUCLIDEAN, EUCLIDEAN>,
    ) -> Option<()> {
        let MotionErrors { motion, by_bias, bias_covariance, turn } = errors;
        let noise = motion.covariance - by_bias * *bias_covariance * by_bias.transpose();
        let mut motion_by_bias = *by_bias;
        motion_by_bias.fixed_rows_mut::<6>(block::GYRO_BIAS).fill(0.0);

        let map_at = |before: Matrix3<f64>| error_map(&before, turn, &density.slope);
        let mut mean_map = map_at(self.rotation.mean_rotation());
        mean_map.fixed_view_mut::<6, 6>(BIASES, block::GYRO_BIAS).fill_with_identity();
        let deviations = self.rotation.deviations().map(map_at);
        let mut advance = *drift;
        let mut bias_columns = advance.fixed_columns_mut::<6>(BIASES);
        bias_columns += mean_map * motion_by_bias;

        let prior = self.density.covariance;
        density.covariance =
            advance * prior * advance.transpose() + mean_map * noise * mean_map.transpose();
        for map in &deviations {
            density.covariance += map * motion.covariance * map.transpose();
        }

        let rotation_by_bias = motion_by_bias.fixed_rows::<3>(block::ROTATION);
        let with_rotation =
            advance * prior.fixed_columns::<6>(BIASES) * rotation_by_bias.transpose()
                + mean_map * noise.fixed_columns::<3>(block::ROTATION);
        let parameter = Matrix3::from_column_slice(density.attitude.linear.as_slice());
        let rotation = density.attitude.moments().ok()?;
        let regression = explicable(
            with_rotation * gradient_coordinate(&parameter),
            &rotation.covariance,
            &density.covariance,
        );
        // Biases that are known to depend on the attitude act accordingly.
        let slope_of_bias = density.slope.fixed_rows::<6>(BIASES).into_owned();
        density.slope += mean_map * motion_by_bias * slope_of_bias;
        density.slope += regression;
        // What the attitude tells is no longer unknown.
        keep_rounding(&mut density.covariance);
        density.covariance -= regression * rotation.covariance * regression.transpose();
        symmetrize(&mut density.covariance);
        Some(())
    }

    /// Conditions the belief on points by the paper's progressive update, weighted as at the mode.
    pub fn update_by_sigma_points(&self, information: &PoseInformation) -> Option<Self> {
        let origin = &information.origin;
        let mut density =
            shifted(self.density, &-origin).conditioned(POSITION, &information.joint)?;
        let (prior, posterior) = (self.density.attitude, density.attitude);
        let log_likelihood = |r: &Rotation3<f64>| posterior.log_density(r) - prior.log_density(r);
        let config = ProgressiveConfig::default();
        let attitude = progressive_update(&self.attitude, log_likelihood, &config).ok()?;
        density.attitude = RotationQuadratic::matrix_fisher(&attitude.parameter());
        Some(Self::new(attitude, shifted(density, origin)))
    }

    /// Conditions the belief on rest, exactly.
    pub fn condition_on_zero_velocity(&self, rest: &ZeroVelocity) -> Option<BroadUpdate> {
        let measured = |mean: Vector3<f64>, sd: f64| JointInformation {
            xx: Matrix3::identity() / sd.powi(2),
            eta_x: mean / sd.powi(2),
            ..JointInformation::default()
        };
        let mut density = self
            .density
            .conditioned(VELOCITY, &measured(Vector3::zeros(), rest.velocity_sd))?
            .conditioned(BIASES, &measured(rest.rate, rest.rate_sd))?;
        density.attitude = density.attitude.reduced();
        let (mode, curvature) = density.attitude.global_mode()?;
        let least_information = curvature.symmetric_eigenvalues().min();
        Some(BroadUpdate { density, mode, least_information, points: 0 })
    }

    /// Information about the rotation axis that is known least, 1/rad^2.
    pub fn least_information(&self) -> f64 {
        self.attitude.information().symmetric_eigenvalues().min()
    }

    /// Conditions the belief on points, with the weights of anisotropic measurements and of the
    /// kernel renewed `relinearizations` times at the mode.
    pub fn update<'a>(
        &self,
        pairs: impl IntoIterator<Item = &'a PointPair> + Clone,
        kernel: RobustKernel,
        relinearizations: usize,
    ) -> Option<BroadUpdate> {
        let mut mode = self.attitude.mode();
        // Residuals at an attitude that may be wrong by any angle tell nothing of outliers.
        let mut kernel_now = RobustKernel::None;
        let (mean, _, _) = self.density.vector_moments(&self.rotation);
        let mut origin = mean.fixed_rows::<3>(POSITION).into_owned();
        let mut updated = None;
        for _ in 0..=relinearizations {
            let information =
                PoseInformation::accumulate(pairs.clone(), &mode, &origin, kernel_now);
            if information.points == 0 {
                return None;
            }
            let mut density =
                shifted(self.density, &-origin).conditioned(POSITION, &information.joint)?;
            density.attitude = density.attitude.reduced();
            let (found, curvature) = density.attitude.global_mode()?;
            let r = crate::alignment::vectorize(found.matrix());
            mode = found;
            let here = density.offset + density.slope * r;
            let moved = origin + here.fixed_rows::<3>(POSITION);
            updated = Some(BroadUpdate {
                density: shifted(density, &origin),
                mode,
                least_information: curvature.symmetric_eigenvalues().min(),
                points: information.points,
            });
            (origin, kernel_now) = (moved, kernel);
        }
        updated
    }
}

/// `E[exp(e^)]` of an error that accrues as Brownian motion does, of this covariance; of second order
/// for any other (`E[e^ e^] = C - tr(C) I`). However large the error, it leads to no turn.
fn mean_turn(covariance: &Matrix3<f64>) -> Matrix3<f64> {
    let rate = (covariance - Matrix3::identity() * covariance.trace()) * 0.5;
    let eigen = rate.symmetric_eigen();
    let axes = eigen.eigenvectors;
    axes * Matrix3::from_diagonal(&eigen.eigenvalues.map(f64::exp)) * axes.transpose()
}

/// A regression on `r` by which no more is told of `x` than there is of `covariance`: `regression`, or
/// as much of it as that allows. Stein's identity holds where the error is small beside the spread of
/// the attitude; an attitude that has become uncertain by it alone would seem to tell more.
fn explicable(
    regression: SMatrix<f64, EUCLIDEAN, 9>,
    of_r: &SMatrix<f64, 9, 9>,
    covariance: &SMatrix<f64, EUCLIDEAN, EUCLIDEAN>,
) -> SMatrix<f64, EUCLIDEAN, 9> {
    let eigen = covariance.symmetric_eigen();
    let least = eigen.eigenvalues.max() * f64::EPSILON;
    let scale =
        eigen.eigenvalues.map(|value| value.max(least).max(f64::MIN_POSITIVE).sqrt().recip());
    let whitened = SMatrix::from_diagonal(&scale) * eigen.eigenvectors.transpose() * regression;
    let told = (whitened * of_r * whitened.transpose()).symmetric_eigenvalues().max();
    if told > 1.0 { regression / told.sqrt() } else { regression }
}

/// Errors of a relative motion: `by_bias * (bias error at its start) + noise`.
struct MotionErrors<'a> {
    motion: &'a Belief,
    by_bias: SMatrix<f64, 15, 6>,
    /// The covariance of the biases that the motion was given.
    bias_covariance: &'a SMatrix<f64, 6, 6>,
    turn: Rotation3<f64>,
}

/// The posterior of a [`BroadBelief`] before it is given one of the two forms.
pub struct BroadUpdate {
    /// Position relative to the origin of the world.
    pub density: NavRegression,
    pub mode: Rotation3<f64>,
    /// Information about the rotation axis that is known least, 1/rad^2.
    pub least_information: f64,
    pub points: usize,
}

impl BroadUpdate {
    /// The belief with the matrix Fisher attitude of the same mean; the regression of the rest on
    /// the attitude stays as it is.
    pub fn into_belief(self) -> Option<BroadBelief> {
        let moments = self.density.attitude.moments().ok()?;
        let attitude = MatrixFisher::from_mean(&moments.mean_rotation()).ok()?;
        let density = NavRegression {
            attitude: RotationQuadratic::matrix_fisher(&attitude.parameter()),
            ..self.density
        };
        Some(BroadBelief::new(attitude, density))
    }
}

/// The same density with the position moved by `by`.
fn shifted(mut density: NavRegression, by: &Vector3<f64>) -> NavRegression {
    let mut position = density.offset.fixed_rows_mut::<3>(POSITION);
    position += by;
    density
}

/// The MFG with the mode and covariance of `belief` (W22 theorem 3.4 backwards), the position
/// relative to `origin`.
pub fn of_belief(belief: &Belief, origin: &Vector3<f64>) -> Option<NavRegression> {
    let mode = belief.state.world_from_body.rotation.to_rotation_matrix();
    let rotation_covariance =
        belief.covariance.fixed_view::<3, 3>(block::ROTATION, block::ROTATION).into_owned();
    let cross = belief.covariance.fixed_view::<EUCLIDEAN, 3>(FIRST, block::ROTATION).into_owned();
    let information = rotation_covariance.cholesky()?.inverse();
    let parameter =
        mode.matrix() * (Matrix3::identity() * (0.5 * information.trace()) - information);
    let mut covariance =
        belief.covariance.fixed_view::<EUCLIDEAN, EUCLIDEAN>(FIRST, FIRST).into_owned();
    keep_rounding(&mut covariance);
    let density = NavRegression {
        attitude: RotationQuadratic::matrix_fisher(&parameter),
        offset: euclidean(&belief.state),
        slope: cross * gradient_coordinate(&parameter),
        covariance: covariance - cross * information * cross.transpose(),
    };
    Some(shifted(density, &-origin))
}

/// The 3x9 matrix `L` with `L vec(R) = (F^T R - R^T F)^v`, minus the gradient of `tr(F^T R)` by
/// the body-frame rotation: `v_R` of MFGB (W22 3.3b) in body coordinates. It is zero at the mode.
pub fn gradient_coordinate(f: &Matrix3<f64>) -> SMatrix<f64, 3, 9> {
    // Component k is column i of F times column j of R minus the reverse.
    let mut l = SMatrix::<f64, 3, 9>::zeros();
    for (k, i, j) in [(0, 2, 1), (1, 0, 2), (2, 1, 0)] {
        for a in 0..3 {
            l[(k, 3 * j + a)] = f[(a, i)];
            l[(k, 3 * i + a)] = -f[(a, j)];
        }
    }
    l
}

/// How the Euclidean part moves by itself: the position by the velocity.
fn drift(h: f64) -> SMatrix<f64, EUCLIDEAN, EUCLIDEAN> {
    let mut drift = SMatrix::<f64, EUCLIDEAN, EUCLIDEAN>::identity();
    for k in 0..3 {
        drift[(POSITION + k, VELOCITY + k)] = h;
    }
    drift
}

/// Effect on velocity and position of errors of the relative motion, ordered as in a
/// [`NavCovariance`], given the attitude `before` it, in which it is linear.
fn error_map(
    before: &Matrix3<f64>,
    turn: &Rotation3<f64>,
    slope: &SMatrix<f64, EUCLIDEAN, 9>,
) -> SMatrix<f64, EUCLIDEAN, 15> {
    let mut map = SMatrix::<f64, EUCLIDEAN, 15>::zeros();
    // The attitude before is that after, turned back by too little or too much.
    let by_rotation = -(slope * rotated_vector_by_rotation(&(before * turn.matrix())));
    map.fixed_columns_mut::<3>(block::ROTATION).copy_from(&by_rotation);
    map.fixed_view_mut::<3, 3>(VELOCITY, block::VELOCITY).copy_from(before);
    map.fixed_view_mut::<3, 3>(POSITION, block::POSITION).copy_from(before);
    map
}

/// (velocity, position, gyro bias, accelerometer bias).
fn euclidean(state: &NavState) -> SVector<f64, EUCLIDEAN> {
    let mut x = SVector::<f64, EUCLIDEAN>::zeros();
    x.fixed_rows_mut::<3>(VELOCITY).copy_from(&state.velocity);
    x.fixed_rows_mut::<3>(POSITION).copy_from(&state.world_from_body.translation.vector);
    x.fixed_rows_mut::<3>(BIASES).copy_from(&state.gyro_bias);
    x.fixed_rows_mut::<3>(block::ACCEL_BIAS - FIRST).copy_from(&state.accel_bias);
    x
}

/// The state with the given attitude and Euclidean part.
pub fn nav_state(rotation: &Rotation3<f64>, x: &SVector<f64, EUCLIDEAN>) -> NavState {
    let part = |start: usize| x.fixed_rows::<3>(start - FIRST).into_owned();
    NavState {
        world_from_body: Isometry3::from_parts(
            part(block::POSITION).into(),
            UnitQuaternion::from_rotation_matrix(rotation),
        ),
        velocity: part(block::VELOCITY),
        gyro_bias: part(block::GYRO_BIAS),
        accel_bias: part(block::ACCEL_BIAS),
    }
}

/// The covariance of a belief from its blocks; `cross` is `Cov[x, e]`.
pub fn assemble(
    rotation: &Matrix3<f64>,
    cross: &SMatrix<f64, EUCLIDEAN, 3>,
    euclidean: &SMatrix<f64, EUCLIDEAN, EUCLIDEAN>,
) -> NavCovariance {
    let mut covariance = NavCovariance::zeros();
    covariance.fixed_view_mut::<3, 3>(block::ROTATION, block::ROTATION).copy_from(rotation);
    covariance.fixed_view_mut::<EUCLIDEAN, 3>(FIRST, block::ROTATION).copy_from(cross);
    covariance.fixed_view_mut::<3, EUCLIDEAN>(block::ROTATION, FIRST).copy_from(&cross.transpose());
    covariance.fixed_view_mut::<EUCLIDEAN, EUCLIDEAN>(FIRST, FIRST).copy_from(euclidean);
    symmetrize(&mut covariance);
    covariance
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::alignment::vectorize;
    use crate::inertial::ImuConfig;
    use nalgebra::Matrix6;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    fn noisy() -> Propagator {
        Propagator::inertial(&ImuConfig {
            gyro_noise: 0.05,
            accel_noise: 0.3,
            gyro_bias_walk: 0.02,
            accel_bias_walk: 0.05,
            ..ImuConfig::default()
        })
    }

    fn belief(parameter: &Matrix3<f64>) -> BroadBelief {
        let attitude = MatrixFisher::new(parameter).unwrap();
        let state = NavState {
            world_from_body: Isometry3::translation(1.0, -2.0, 0.5),
            velocity: Vector3::new(0.4, 0.1, -0.2),
            gyro_bias: Vector3::new(0.02, -0.01, 0.03),
            accel_bias: Vector3::new(0.1, 0.0, -0.2),
        };
        let mut covariance = NavCovariance::identity() * 0.04;
        for k in 0..3 {
            covariance[(block::GYRO_BIAS + k, block::GYRO_BIAS + k)] = 0.01;
        }
        BroadBelief::independent(&Belief { state, covariance }, &attitude)
    }

    const GYRO: Vector3<f64> = Vector3::new(0.5, -0.8, 1.1);
    const ACCEL: Vector3<f64> = Vector3::new(1.0, 0.5, 9.0);

    fn normal<const N: usize>(rng: &mut ChaCha8Rng) -> SVector<f64, N> {
        SVector::from_fn(|_, _| StandardNormal.sample(rng))
    }

    /// `(r, x)` of samples carried one by one.
    fn sampled(start: &BroadBelief, steps: usize, h: f64, samples: usize) -> Vec<SVector<f64, 21>> {
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let sampler = start.attitude.sampler();
        let root = start.density.covariance.cholesky().unwrap().l();
        let propagator = noisy();
        let mut carried = Vec::with_capacity(samples);
        for _ in 0..samples {
            let r: Rotation3<f64> = sampler.sample(&mut rng);
            let x = start.density.offset
                + start.density.slope * vectorize(r.matrix())
                + root * normal(&mut rng);
            let mut state = nav_state(&r, &x);
            for _ in 0..steps {
                // The motion's error drawn from its covariance, biases walking with it.
                let (motion, _) = propagator
                    .relative_motion(&GYRO, &ACCEL, &state, &Matrix6::zeros(), h)
                    .unwrap();
                let spread = motion.covariance + NavCovariance::identity() * 1e-18;
                let error = spread.cholesky().unwrap().l() * normal::<15>(&mut rng);
                let part = |first: usize| error.fixed_rows::<3>(first).into_owned();
                let before = state.world_from_body.rotation;
                let pose = &mut state.world_from_body;
                pose.translation.vector += state.velocity * h
                    + propagator.gravity() * (0.5 * h * h)
                    + before
                        * (motion.state.world_from_body.translation.vector + part(block::POSITION));
                pose.rotation = before
                    * motion.state.world_from_body.rotation
                    * UnitQuaternion::new(part(block::ROTATION));
                state.velocity += propagator.gravity() * h
                    + before * (motion.state.velocity + part(block::VELOCITY));
                state.gyro_bias += part(block::GYRO_BIAS);
                state.accel_bias += part(block::ACCEL_BIAS);
            }
            let mut y = SVector::<f64, 21>::zeros();
            let rotation = state.world_from_body.rotation.to_rotation_matrix();
            y.fixed_rows_mut::<9>(0).copy_from(&vectorize(rotation.matrix()));
            y.fixed_rows_mut::<12>(9).copy_from(&euclidean(&state));
            carried.push(y);
        }
        carried
    }

    fn mean_of<'a>(values: impl Iterator<Item = f64> + Clone + 'a) -> (f64, f64) {
        let n = values.clone().count() as f64;
        let mean = values.clone().sum::<f64>() / n;
        let variance = values.map(|value| (value - mean).powi(2)).sum::<f64>() / n;
        (mean, (variance / n).sqrt())
    }

    #[test]
    fn propagation_keeps_the_moments_of_samples() {
        let (steps, h, samples) = (10, 0.02, 6000);
        for parameter in [
            Matrix3::identity() * 0.01,
            Matrix3::new(4.0, 1.0, 0.0, -1.0, 3.0, 0.5, 0.2, 0.0, 1.0),
            Matrix3::from_diagonal(&Vector3::new(20.0, 15.0, -12.0)),
        ] {
            let start = belief(&parameter);
            let carried = sampled(&start, steps, h, samples);
            let mut moved = start;
            for _ in 0..steps {
                moved.propagate(&noisy(), &GYRO, &ACCEL, h).unwrap();
            }
            let (x, spread, cross) = moved.density.vector_moments(&moved.rotation);
            let mut found = SVector::<f64, 21>::zeros();
            found.fixed_rows_mut::<9>(0).copy_from(&moved.rotation.mean);
            found.fixed_rows_mut::<12>(9).copy_from(&x);
            let mut joint = SMatrix::<f64, 21, 21>::zeros();
            joint.fixed_view_mut::<9, 9>(0, 0).copy_from(&moved.rotation.covariance);
            joint.fixed_view_mut::<12, 12>(9, 9).copy_from(&spread);
            joint.fixed_view_mut::<12, 9>(9, 0).copy_from(&cross);
            joint.fixed_view_mut::<9, 12>(0, 9).copy_from(&cross.transpose());
            // Five standard errors of the samples: they do not see what linearisation costs.
            for i in 0..21 {
                let (mean, error) = mean_of(carried.iter().map(|y| y[i]));
                let off = (mean - found[i]).abs();
                assert!(off < 5.0 * error, "{parameter} mean {i}: {off} {error}");
                for j in 0..21 {
                    let product = |y: &SVector<f64, 21>| (y[i] - found[i]) * (y[j] - found[j]);
                    let (value, error) = mean_of(carried.iter().map(product));
                    let off = (value - joint[(i, j)]).abs();
                    assert!(off < 5.0 * error, "{parameter} covariance {i} {j}: {off} {error}");
                }
            }
        }
    }

    #[test]
    fn a_concentrated_belief_is_carried_as_by_the_linearised_propagator() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let root = NavCovariance::from_fn(|i, _| {
            let scale = if i < 3 { 0.003 } else { 0.01 };
            scale * rng.random_range(-1.0..1.0)
        });
        let state = NavState {
            world_from_body: Isometry3::new(
                Vector3::new(1.0, 2.0, 3.0),
                Vector3::new(0.4, -0.9, 1.3),
            ),
            velocity: Vector3::new(0.5, -1.0, 0.2),
            gyro_bias: Vector3::new(0.01, -0.02, 0.03),
            accel_bias: Vector3::new(-0.1, 0.2, 0.05),
        };
        let covariance = root * root.transpose() + NavCovariance::identity() * 1e-6;
        let mut linear = Belief { state, covariance };
        let mut broad = BroadBelief::of_belief(&linear).unwrap();
        let propagator = Propagator::inertial(&ImuConfig::default());
        for _ in 0..40 {
            propagator.advance(&mut linear, &GYRO, &ACCEL, 0.005);
            broad.propagate(&propagator, &GYRO, &ACCEL, 0.005).unwrap();
        }
        let found = broad.summary();
        let apart =
            found.state.world_from_body.rotation.angle_to(&linear.state.world_from_body.rotation);
        assert!(apart < 1e-4, "{apart}");
        assert!((found.state.velocity - linear.state.velocity).norm() < 1e-3);
        for i in 0..15 {
            for j in 0..15 {
                let scale = (linear.covariance[(i, i)] * linear.covariance[(j, j)]).sqrt();
                let off = (found.covariance[(i, j)] - linear.covariance[(i, j)]).abs() / scale;
                assert!(off < 0.03, "{i} {j}: {off}");
            }
        }
    }

    #[test]
    fn points_make_a_uniform_attitude_certain() {
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        let broad = belief(&Matrix3::zeros());
        let truth = Isometry3::new(Vector3::new(1.1, -2.1, 0.4), Vector3::new(2.0, 1.0, -1.5));
        let pairs: Vec<PointPair> = (0..12)
            .map(|_| {
                let in_body = normal::<3>(&mut rng);
                PointPair {
                    in_body,
                    body_covariance: Matrix3::from_diagonal(&Vector3::new(1e-4, 1e-4, 9e-4)),
                    in_world: (truth * nalgebra::Point3::from(in_body)).coords,
                    world_covariance: Matrix3::identity() * 1e-4,
                }
            })
            .collect();
        let update = broad.update(&pairs, RobustKernel::Huber { scale: 2.0 }, 3).unwrap();
        assert!(update.mode.angle_to(&truth.rotation.to_rotation_matrix()) < 0.01);
        assert!(update.least_information > 1e3);
        // Two points leave the turn about their line.
        let update = broad.update(&pairs[..2], RobustKernel::None, 3).unwrap();
        assert!(update.least_information < 25.0);
        let belief = update.into_belief().unwrap();
        let s = belief.attitude().svd().s;
        assert!(s[0] > 50.0 && s[1] + s[2] < 10.0, "{s}");
        assert!(belief.summary().is_finite());
        assert!(belief.summary().covariance.cholesky().is_some());
    }
}
