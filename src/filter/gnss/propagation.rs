//! Moments of attitude and motion carried through the IMU kinematics.
//!
//! With `E0 = exp(h (w - E[b_g])^)`, `Q = U^T R V` and `d` the angular velocity error in principal
//! axes, one step turns `Q` into `Q' = Q (I + h d^ + ...) N`, `R+ = U Q' V^T E0`, where `N` is the
//! isotropic gyroscope noise. As `d` is linear in `q = vec Q` and Gaussian given `R`, both `q'` and
//! the Euclidean state after the step are *quadratic* in `q`: an affine part, whose covariance is
//! carried exactly, and centred bilinear terms of order `h`, whose products with the affine part
//! are contractions of the third central moments of `Q`. What is dropped is the covariance of
//! the bilinear terms with each other, of order `h^2`. This replaces theorems 4.5, 4.6, 5.1, F.1
//! and F.2 of W22, for the bias convention `measured = true + bias + noise`.

use nalgebra::{Matrix3, SMatrix, Vector3};

use super::belief::{
    ACCEL_BIAS, EUCLIDEAN, Euclidean, EuclideanCovariance, GYRO_BIAS, JointMoments,
    NavigationBelief, POSITION, Regression, Slope, VELOCITY,
};
use super::central::{CentralMoments, Matrix9, Vector9};
use crate::alignment::vectorize;
use crate::distribution::matrix_fisher::{MatrixFisher, MatrixFisherError, s_from_complement_near};
use crate::filter::FilterError;
use crate::inertial::{DrivingNoise, ImuConfig};
use crate::so3::{ProperSvd, exp, hat, left_jacobian, proper_svd};

/// Gravity and the noise densities of an IMU.
#[derive(Debug, Clone)]
pub(super) struct MomentPropagator {
    gravity: Vector3<f64>,
    noise: DrivingNoise,
}

/// Moments after a step, in the principal axes before it.
struct Moved {
    mean_q: Vector9,
    mean_x: Euclidean,
    moments: JointMoments,
}

impl MomentPropagator {
    pub fn new(imu: &ImuConfig) -> Self {
        Self { gravity: Vector3::new(0.0, 0.0, -imu.gravity), noise: DrivingNoise::inertial(imu) }
    }

    pub fn set_imu_gap(&mut self, in_gap: bool) {
        self.noise.set_imu_gap(in_gap);
    }

    /// The belief `h` seconds later, `rate` and `force` being the measured angular velocity and
    /// specific force, averaged over the step.
    pub fn step(
        &self,
        belief: &NavigationBelief,
        rate: &Vector3<f64>,
        force: &Vector3<f64>,
        h: f64,
        regression: Regression,
    ) -> Result<NavigationBelief, FilterError> {
        let turn = (rate - belief.mean.fixed_rows::<3>(GYRO_BIAS)) * h;
        let moved = self.moments(belief, &turn, force, h);
        let mean = Matrix3::from_column_slice(moved.mean_q.as_slice());
        let svd = proper_svd(&mean).map_err(MatrixFisherError::from)?;
        let before = belief.attitude.svd();
        let s = s_from_complement_near(&svd.s.map(|d| 1.0 - d), belief.attitude.moments())
            .map_err(MatrixFisherError::from)?;
        let attitude = MatrixFisher::from_svd(ProperSvd {
            u: before.u * svd.u,
            s,
            v: exp(&-turn) * before.v * svd.v,
        })
        .map_err(MatrixFisherError::from)?;
        let axes = svd.v.matrix().kronecker(svd.u.matrix());
        let belief = NavigationBelief::from_moments(
            attitude,
            moved.mean_x,
            &moved.moments,
            &axes,
            regression,
        )?;
        if belief.is_finite() {
            Ok(belief)
        } else {
            Err(FilterError::NotFinite("propagated belief"))
        }
    }

    fn moments(
        &self,
        belief: &NavigationBelief,
        turn: &Vector3<f64>,
        force: &Vector3<f64>,
        h: f64,
    ) -> Moved {
        let svd = belief.attitude.svd();
        let (u, v) = (svd.u.matrix(), svd.v.matrix());
        let central = CentralMoments::of(belief.attitude.moments());
        let covariance = &central.covariance;
        let conditional = &belief.conditional;
        let half = *exp(&(turn * 0.5)).matrix();
        let force = force - belief.mean.fixed_rows::<3>(ACCEL_BIAS);
        let mean_rotation = belief.attitude.mean();

        // Angular velocity error in principal axes: d = by_q (q - E[q]) + by_bias (b_g - E[b_g|R]).
        let by_bias = -(v.transpose() * left_jacobian(turn));
        let by_q = by_bias * belief.slope.fixed_rows::<3>(GYRO_BIAS);
        let bias_covariance = conditional.fixed_view::<3, 3>(GYRO_BIAS, GYRO_BIAS).into_owned();

        // q' = affine + bilinear + noise.
        let noise = self.noise.white().gyro.powi(2) * h;
        let shrink = mean_of_noise(noise);
        let turned_mean = SMatrix::<f64, 9, 3>::from_columns(&[
            turned(0, &central.mean),
            turned(1, &central.mean),
            turned(2, &central.mean),
        ]) * h;
        let affine = Matrix9::identity() * shrink + turned_mean * by_q;
        let bias_gain = turned_mean * by_bias;
        let rate_covariance =
            by_q * covariance * by_q.transpose() + by_bias * bias_covariance * by_bias.transpose();
        let mut mean_q = central.mean * shrink;
        let mut bilinear_q = Matrix9::zeros();
        let mut noise_q = Matrix9::zeros();
        let second = covariance + central.mean * central.mean.transpose();
        for k in 0..3 {
            let row = by_q.row(k).transpose();
            mean_q += turned(k, &(covariance * row)) * h;
            bilinear_q += turned(k, &central.weighted(&row)) * (h * shrink);
            noise_q += turned(k, &turned(k, &second).transpose()) * noise;
        }
        // E[(h d)^ (h d)^]/2, the second order of the exponential map.
        let second_order = rate_covariance - Matrix3::identity() * rate_covariance.trace();
        let diagonal = Matrix3::from_column_slice(central.mean.as_slice());
        mean_q += vectorize(&(diagonal * second_order)) * (0.5 * h * h);

        // x' likewise; specific force acts along `arm` in principal axes.
        let transition = transition(&mean_rotation, &half, &force, h);
        let arm = v.transpose() * half * force;
        let mut by_attitude = SMatrix::<f64, 3, 9>::zeros();
        for j in 0..3 {
            by_attitude.fixed_columns_mut::<3>(3 * j).copy_from(&(u * arm[j]));
        }
        let mut slope = transition * belief.slope;
        add_acceleration(&mut slope, &by_attitude, h);

        let by_accel_bias = -(v.transpose() * half * belief.slope.fixed_rows::<3>(ACCEL_BIAS));
        let mut mean_bilinear = Vector3::zeros();
        let mut bilinear = SMatrix::<f64, 3, 9>::zeros();
        for b in 0..3 {
            let row = by_accel_bias.row(b).transpose();
            mean_bilinear += (covariance * row).fixed_rows::<3>(3 * b);
            bilinear += central.weighted(&row).fixed_rows::<3>(3 * b);
        }
        let mut bilinear_x = Slope::zeros();
        add_acceleration(&mut bilinear_x, &(u * bilinear), h);

        let mean_acceleration = self.gravity + mean_rotation * half * force + u * mean_bilinear;
        let mut mean_x = belief.mean;
        let velocity = belief.mean.fixed_rows::<3>(VELOCITY) * h;
        let mut position = mean_x.fixed_rows_mut::<3>(POSITION);
        position += velocity + mean_acceleration * (0.5 * h * h);
        let mut velocity = mean_x.fixed_rows_mut::<3>(VELOCITY);
        velocity += mean_acceleration * h;

        let bias_columns = conditional.fixed_columns::<3>(GYRO_BIAS);
        let cross = slope * (covariance * affine.transpose() + bilinear_q.transpose())
            + transition * bias_columns * bias_gain.transpose()
            + bilinear_x * shrink;
        let product = bilinear_x * slope.transpose();
        let x = slope * covariance * slope.transpose()
            + transition * conditional * transition.transpose()
            + self.added_covariance(h)
            + product
            + product.transpose();
        let q = affine * covariance * affine.transpose()
            + bias_gain * bias_covariance * bias_gain.transpose()
            + bilinear_q
            + bilinear_q.transpose()
            + noise_q;
        Moved { mean_q, mean_x, moments: JointMoments { x, cross, q } }
    }

    /// Covariance that white noises add to the Euclidean state over a step.
    fn added_covariance(&self, h: f64) -> EuclideanCovariance {
        let accel = self.noise.white().accel.powi(2);
        let mut q = EuclideanCovariance::zeros();
        for k in 0..3 {
            let (v, p) = (VELOCITY + k, POSITION + k);
            q[(v, v)] = accel * h;
            q[(p, p)] = accel * h.powi(3) / 3.0;
            q[(v, p)] = accel * h * h / 2.0;
            q[(p, v)] = q[(v, p)];
            q[(GYRO_BIAS + k, GYRO_BIAS + k)] = self.noise.gyro_bias_walk.powi(2) * h;
            q[(ACCEL_BIAS + k, ACCEL_BIAS + k)] = self.noise.accel_bias_walk.powi(2) * h;
        }
        q
    }
}

/// `E[exp(w^)] = mean_of_noise I` for `w ~ N(0, variance I)`, exactly.
fn mean_of_noise(variance: f64) -> f64 {
    (1.0 + 2.0 * (1.0 - variance) * (-0.5 * variance).exp()) / 3.0
}

/// `vec(Q e_k^)` for each column `vec Q`.
fn turned<const N: usize>(k: usize, columns: &SMatrix<f64, 9, N>) -> SMatrix<f64, 9, N> {
    let (i, j) = ((k + 1) % 3, (k + 2) % 3);
    let mut turned = SMatrix::<f64, 9, N>::zeros();
    turned.fixed_rows_mut::<3>(3 * i).copy_from(&columns.fixed_rows::<3>(3 * j));
    turned.fixed_rows_mut::<3>(3 * j).copy_from(&-columns.fixed_rows::<3>(3 * i));
    turned
}

/// Adds the effect of an acceleration over the step to velocity and position.
fn add_acceleration(slope: &mut Slope, acceleration: &SMatrix<f64, 3, 9>, h: f64) {
    for (row, factor) in [(VELOCITY, h), (POSITION, 0.5 * h * h)] {
        let mut rows = slope.fixed_rows_mut::<3>(row);
        rows += acceleration * factor;
    }
}

/// Derivative of the Euclidean state after the step by that before it, at the mean attitude.
fn transition(
    mean_rotation: &Matrix3<f64>,
    half: &Matrix3<f64>,
    force: &Vector3<f64>,
    h: f64,
) -> SMatrix<f64, EUCLIDEAN, EUCLIDEAN> {
    let middle = mean_rotation * half;
    let by_gyro_bias = middle * hat(force) * (0.5 * h);
    let mut f = EuclideanCovariance::identity();
    for (row, factor) in [(VELOCITY, h), (POSITION, 0.5 * h * h)] {
        f.fixed_view_mut::<3, 3>(row, GYRO_BIAS).copy_from(&(by_gyro_bias * factor));
        f.fixed_view_mut::<3, 3>(row, ACCEL_BIAS).copy_from(&(-middle * factor));
    }
    f.fixed_view_mut::<3, 3>(POSITION, VELOCITY).copy_from(&(Matrix3::identity() * h));
    f
}

#[cfg(test)]
mod tests {
    use super::super::tests::{diffuse_belief, imu, sampled};
    use super::*;
    use crate::distribution::matrix_fisher_gaussian::Correlation;
    use nalgebra::{Rotation3, SVector};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    const STEP: f64 = 0.05;

    fn normal(rng: &mut ChaCha8Rng, sd: f64) -> Vector3<f64> {
        Vector3::from_fn(|_, _| sd * Distribution::<f64>::sample(&StandardNormal, rng))
    }

    /// The kinematics of one sample, noise included.
    fn moved(
        imu: &ImuConfig,
        r: &Rotation3<f64>,
        x: &Euclidean,
        rate: &Vector3<f64>,
        force: &Vector3<f64>,
        rng: &mut ChaCha8Rng,
    ) -> (Rotation3<f64>, Euclidean) {
        let part = |start: usize| x.fixed_rows::<3>(start).into_owned();
        let white = STEP.sqrt();
        let turn = (rate - part(GYRO_BIAS)) * STEP;
        let noise = normal(rng, imu.gyro_noise * white);
        let middle = r * exp(&(turn * 0.5));
        let acceleration = middle * (force - part(ACCEL_BIAS)) - Vector3::z() * imu.gravity;
        let kick = normal(rng, imu.accel_noise * white);
        let lag = normal(rng, imu.accel_noise * STEP * white / 12.0_f64.sqrt());
        let mut next = *x;
        let mut add = |start: usize, change: Vector3<f64>| {
            let mut rows = next.fixed_rows_mut::<3>(start);
            rows += change;
        };
        add(POSITION, part(VELOCITY) * STEP + acceleration * (0.5 * STEP * STEP));
        add(POSITION, kick * (0.5 * STEP) + lag);
        add(VELOCITY, acceleration * STEP + kick);
        add(GYRO_BIAS, normal(rng, imu.gyro_bias_walk * white));
        add(ACCEL_BIAS, normal(rng, imu.accel_bias_walk * white));
        (r * exp(&noise) * exp(&turn), next)
    }

    /// A diffuse attitude, biases that depend on it, a long step: every moment against samples
    /// that go through the kinematics themselves.
    #[test]
    fn moments_agree_with_samples() {
        let (imu, belief) = (imu(), diffuse_belief());
        let (rate, force) = (Vector3::new(0.5, -0.8, 1.1), Vector3::new(1.5, -2.0, 8.0));
        let turn = (rate - belief.mean.fixed_rows::<3>(GYRO_BIAS)) * STEP;
        let found = MomentPropagator::new(&imu).moments(&belief, &turn, &force, STEP);

        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let svd = *belief.attitude.svd();
        let back = exp(&-turn) * svd.v;
        let pairs: Vec<SVector<f64, 21>> = sampled(&belief, 300_000, &mut rng)
            .iter()
            .map(|(r, x)| {
                let (r, x) = moved(&imu, r, x, &rate, &force, &mut rng);
                let q = svd.u.inverse() * r * back;
                let mut pair = SVector::<f64, 21>::zeros();
                pair.fixed_rows_mut::<9>(0).copy_from_slice(q.matrix().as_slice());
                pair.fixed_rows_mut::<12>(9).copy_from(&x);
                pair
            })
            .collect();
        let n = pairs.len() as f64;
        let mean = pairs.iter().sum::<SVector<f64, 21>>() / n;
        let covariance = pairs
            .iter()
            .map(|pair| (pair - mean) * (pair - mean).transpose())
            .sum::<SMatrix<f64, 21, 21>>()
            / n;
        let mut expected = SMatrix::<f64, 21, 21>::zeros();
        let JointMoments { x, cross, q } = &found.moments;
        expected.fixed_view_mut::<9, 9>(0, 0).copy_from(q);
        expected.fixed_view_mut::<12, 9>(9, 0).copy_from(cross);
        expected.fixed_view_mut::<9, 12>(0, 9).copy_from(&cross.transpose());
        expected.fixed_view_mut::<12, 12>(9, 9).copy_from(x);
        for i in 0..21 {
            let sd = expected[(i, i)].sqrt();
            let from_kernel = if i < 9 { found.mean_q[i] } else { found.mean_x[i - 9] };
            let tolerance = 5.0 / n.sqrt();
            assert!((from_kernel - mean[i]).abs() < tolerance * sd, "mean {i}");
            for j in 0..=i {
                // Products of bilinear terms, which are dropped, are of the order of 2e-3.
                let scale = sd * expected[(j, j)].sqrt();
                let difference = (expected[(i, j)] - covariance[(i, j)]) / scale;
                assert!(difference.abs() < 2.0 * tolerance + 3e-3, "({i}, {j}): {difference}");
            }
        }
    }

    /// Moments of functions that are linear in `q` are kept by the regression on all of them, and
    /// those of `v_R` by the projection.
    #[test]
    fn regressions_keep_what_they_promise() {
        let (imu, belief) = (imu(), diffuse_belief());
        let propagator = MomentPropagator::new(&imu);
        let (rate, force) = (Vector3::new(0.5, -0.8, 1.1), Vector3::new(1.5, -2.0, 8.0));
        for correlation in [Correlation::World, Correlation::Body] {
            let step =
                |regression| propagator.step(&belief, &rate, &force, 0.01, regression).unwrap();
            let full = step(Regression::Full(correlation));
            let projected = step(Regression::Projected(correlation));
            assert!((full.mean - projected.mean).norm() < 1e-12);
            let difference = full.joint_moments().x - projected.joint_moments().x;
            assert!(difference.amax() < 0.01 * full.joint_moments().x.amax());
            // The projection cannot explain more of x than the full regression does.
            let lost = (projected.conditional - full.conditional).symmetric_eigenvalues();
            assert!(lost.min() > -1e-3 && lost.max() > 1e-3, "{lost}");
        }
    }
}
