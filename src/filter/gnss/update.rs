//! Bayes' rule for the matrix Fisher-Gaussian filters.
//!
//! A position measured at a lever arm `l`, `y = p + R l + noise`, leaves a residual that is linear
//! in `r = vec R` and in `x`. Integrating `x` out is exact and leaves, with the `J` of
//! [`LinearPosition`],
//!
//! ```text
//! log p(R | y) = tr(F^T R) - (e - J (r - E[r]))^T W (e - J (r - E[r]))/2 + const,
//! ```
//!
//! `F` being the prior's parameter. Of the three ways to a matrix
//! Fisher density for it, [`AttitudeUpdate`] chooses; given `R` the Kalman step is exact.

use nalgebra::{Matrix3, SMatrix, Vector3};
use serde::{Deserialize, Serialize};

use super::Innovation;
use super::belief::{
    JointMoments, NavigationBelief, POSITION, Regression, quaternion_products, solve_scaled,
};
use super::central::{CentralMoments, Matrix9, Vector9, mean_and_covariance};
use crate::alignment::{rotated_vector_by_rotation, vectorize};
use crate::distribution::matrix_fisher::MatrixFisher;
use crate::distribution::progressive::{ProgressiveConfig, progressive_update};
use crate::filter::{FilterError, PositionMeasurement};

/// How the attitude's posterior is brought to a matrix Fisher density.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AttitudeUpdate {
    /// The likelihood is applied gradually, each part replaced by its best linear function of `R`
    /// under the belief so far, with exact moments to order three: progressive updating in the
    /// limit of small steps. Where the attitude is concentrated, mode and curvature instead.
    #[default]
    Flow,
    /// Progressive reweighting of seven sigma points (W22 table 5.2).
    SigmaPoints,
}

/// Concentration `s2 + s3` from which mode and curvature are used: the relative error of the
/// curvature is about its inverse.
const CONCENTRATED: f64 = 1e4;
/// Error of one step of the flow, as the distance of two beliefs: the standardized shift of the
/// mean, in standard deviations.
const FLOW_TOLERANCE: f64 = 5e-3;
/// Evaluations of the flow before giving up; a fix that moves the belief by a hundred standard
/// deviations takes about 300.
const MAX_FLOW_STEPS: usize = 2000;
/// Smallest ratio of the likelihoods of two sigma points in one step (`tau` of W22 table 5.2; the
/// paper gives no value).
const SIGMA_POINT_RATIO: f64 = 0.05;
/// Share of its weight that the central sigma point keeps: three quarters of the likelihood's
/// information are added, see [`progressive_update`].
const CENTRAL_SHARE: f64 = 1.0 / 3.0;
const MAX_SIGMA_POINT_STEPS: usize = 10_000;
const MAX_NEWTON_STEPS: usize = 50;
/// A Newton step below this ends the search, rad.
const NEWTON_TOLERANCE: f64 = 1e-10;

/// Difference of a measured position from its prediction.
pub(super) fn innovation(
    belief: &NavigationBelief,
    position: &PositionMeasurement,
) -> Result<Innovation, FilterError> {
    Ok(LinearPosition::new(belief, position)?.innovation)
}

/// Conditions a belief on attitude evidence, the likelihood `exp(tr(F^T R))`. Exact.
pub(super) fn update_attitude(
    belief: &NavigationBelief,
    evidence: &Matrix3<f64>,
    regression: Regression,
) -> Result<NavigationBelief, FilterError> {
    let attitude = MatrixFisher::new(&(belief.attitude.parameter() + evidence))?;
    with_attitude(belief, attitude, regression)
}

/// Conditions a belief on a position.
pub(super) fn update_position(
    belief: &NavigationBelief,
    measured: &PositionMeasurement,
    method: AttitudeUpdate,
    regression: Regression,
) -> Result<NavigationBelief, FilterError> {
    let linear = LinearPosition::new(belief, measured)?;
    let likelihood = linear.likelihood(belief);
    let attitude = match method {
        AttitudeUpdate::Flow => likelihood.flow(belief.attitude)?,
        AttitudeUpdate::SigmaPoints => likelihood.sigma_points(&belief.attitude)?,
    };
    with_attitude(&linear.condition(belief), attitude, regression)
}

/// The residual of a position, linear in `q - E[q]` and in `x - E[x | R]`.
struct LinearPosition {
    /// `J`: derivative of the predicted position by `q`, regression included.
    by_q: SMatrix<f64, 3, 9>,
    /// `W`: inverse covariance of the position given `R`.
    weight: Matrix3<f64>,
    innovation: Innovation,
}

impl LinearPosition {
    fn new(belief: &NavigationBelief, measured: &PositionMeasurement) -> Result<Self, FilterError> {
        let svd = belief.attitude.svd();
        let (u, v) = (svd.u.matrix(), svd.v.matrix());
        let mut by_q = belief.slope.fixed_rows::<3>(POSITION).into_owned();
        let arm = v.transpose() * measured.lever_arm;
        for j in 0..3 {
            let mut columns = by_q.fixed_columns_mut::<3>(3 * j);
            columns += u * arm[j];
        }
        let predicted =
            belief.mean.fixed_rows::<3>(POSITION) + belief.attitude.mean() * measured.lever_arm;
        let given_rotation =
            belief.conditional.fixed_view::<3, 3>(POSITION, POSITION) + measured.covariance;
        let (_, q) = mean_and_covariance(belief.attitude.moments());
        let innovation = Innovation::new(
            measured.in_world - predicted,
            given_rotation + by_q * q * by_q.transpose(),
        )?;
        let weight = given_rotation
            .cholesky()
            .ok_or(FilterError::NotPositive("covariance of the position"))?
            .inverse();
        Ok(Self { by_q, weight, innovation })
    }

    /// What the position says about the attitude.
    fn likelihood(&self, prior: &NavigationBelief) -> AttitudeLikelihood {
        let svd = prior.attitude.svd();
        let rows = std::array::from_fn(|i| {
            let row: Vector9 = self.by_q.row(i).transpose();
            svd.u * Matrix3::from_column_slice(row.as_slice()) * svd.v.inverse()
        });
        AttitudeLikelihood {
            rows,
            weight: self.weight,
            residual: self.innovation.residual,
            origin: prior.attitude.mean(),
        }
    }

    /// The Euclidean part given the position and `R`; the attitude unchanged.
    fn condition(&self, belief: &NavigationBelief) -> NavigationBelief {
        let columns = belief.conditional.fixed_columns::<3>(POSITION).into_owned();
        let gain = columns * self.weight;
        NavigationBelief {
            attitude: belief.attitude,
            mean: belief.mean + gain * self.innovation.residual,
            slope: belief.slope - gain * self.by_q,
            conditional: belief.conditional - gain * columns.transpose(),
        }
    }
}

/// The same regression on `R` under another marginal distribution of the attitude.
pub(super) fn with_attitude(
    belief: &NavigationBelief,
    attitude: MatrixFisher,
    regression: Regression,
) -> Result<NavigationBelief, FilterError> {
    let (before, after) = (belief.attitude.svd(), attitude.svd());
    let turn_u = before.u.inverse() * after.u;
    let turn_v = before.v.inverse() * after.v;
    let (mean_q, q) = mean_and_covariance(attitude.moments());
    let (old_mean, _) = mean_and_covariance(belief.attitude.moments());
    // vec(U^T U+ Q V+^T V) = axes q.
    let axes = turn_v.matrix().kronecker(turn_u.matrix());
    let mean = belief.mean + belief.slope * (axes * mean_q - old_mean);
    let slope = belief.slope * axes;
    let cross = slope * q;
    let moments = JointMoments { x: belief.conditional + cross * slope.transpose(), cross, q };
    let identity = Matrix9::identity();
    let posterior =
        NavigationBelief::from_moments(attitude, mean, &moments, &identity, regression)?;
    if posterior.is_finite() { Ok(posterior) } else { Err(FilterError::NotFinite("posterior")) }
}

/// `log L(R) = -(e - J (r - r0))^T W (e - J (r - r0))/2`, with the rows of `J` as matrices: row `i`
/// times `r` is `tr(M_i^T R)`.
struct AttitudeLikelihood {
    rows: [Matrix3<f64>; 3],
    weight: Matrix3<f64>,
    residual: Vector3<f64>,
    origin: Matrix3<f64>,
}

impl AttitudeLikelihood {
    /// `e - J (r - r0)`.
    fn residual_at(&self, rotation: &Matrix3<f64>) -> Vector3<f64> {
        let shift = rotation - self.origin;
        Vector3::from_fn(|i, _| self.residual[i] - self.rows[i].dot(&shift))
    }

    fn log(&self, rotation: &Matrix3<f64>) -> f64 {
        let e = self.residual_at(rotation);
        -0.5 * e.dot(&(self.weight * e))
    }

    fn flow(&self, prior: MatrixFisher) -> Result<MatrixFisher, FilterError> {
        if concentration(&prior) > CONCENTRATED {
            return self.mode_and_curvature(&prior);
        }
        self.integrate(prior)
    }

    /// Integrates `dF/dl = Cov[r]^-1 Cov[r, log L]` from 0 to 1 (Bogacki-Shampine 3(2)).
    fn integrate(&self, prior: MatrixFisher) -> Result<MatrixFisher, FilterError> {
        let mut f = prior.parameter();
        let mut belief = prior;
        let mut slope = self.linearized(&belief)?;
        let (mut applied, mut step) = (0.0, 1.0);
        for _ in 0..MAX_FLOW_STEPS {
            let second = self.linearized(&MatrixFisher::new(&(f + slope * (0.5 * step)))?)?;
            let third = self.linearized(&MatrixFisher::new(&(f + second * (0.75 * step)))?)?;
            let change = (slope * 2.0 + second * 3.0 + third * 4.0) * (step / 9.0);
            let next = MatrixFisher::new(&(f + change))?;
            let fourth = self.linearized(&next)?;
            let error =
                (slope * (-5.0 / 72.0) + second / 12.0 + third / 9.0 - fourth * 0.125) * step;
            let size = distance(&belief, &error).max(distance(&next, &error));
            if size <= FLOW_TOLERANCE {
                applied += step;
                (f, belief, slope) = (f + change, next, fourth);
                if applied >= 1.0 {
                    return Ok(belief);
                }
            }
            let factor = 0.9 * (FLOW_TOLERANCE / size.max(1e-12)).cbrt();
            step = (step * factor.clamp(0.2, 4.0)).min(1.0 - applied);
        }
        Err(FilterError::NoConvergence("attitude update"))
    }

    /// The linear function of `R` nearest to `log L` under `belief`, as a matrix.
    fn linearized(&self, belief: &MatrixFisher) -> Result<Matrix3<f64>, FilterError> {
        let svd = belief.svd();
        let rows = self.rows.map(|m| vectorize(&(svd.u.inverse() * m * svd.v)));
        let j = SMatrix::<f64, 9, 3>::from_columns(&rows);
        let central = CentralMoments::of(belief.moments());
        let first = j * (self.weight * self.residual_at(&belief.mean()));
        let bent = central.with_quadratic(&(j * self.weight * j.transpose()));
        let products = quaternion_products();
        let covariance = products * central.covariance * products.transpose();
        let second = solve_scaled(&covariance, &(products * bent))
            .ok_or(FilterError::NotPositive("covariance of the attitude"))?;
        let slope = first - products.transpose() * second * 0.5;
        Ok(svd.u * Matrix3::from_column_slice(slope.as_slice()) * svd.v.inverse())
    }

    /// The matrix Fisher density with the mode and the curvature of the posterior.
    fn mode_and_curvature(&self, prior: &MatrixFisher) -> Result<MatrixFisher, FilterError> {
        let f = prior.parameter();
        let mut mode = prior.mode();
        for _ in 0..MAX_NEWTON_STEPS {
            let (gradient, exact, gauss_newton) = self.derivatives(&f, mode.matrix());
            // Away from the mode the exact Hessian may be indefinite.
            let factor = exact.cholesky().or_else(|| gauss_newton.cholesky());
            let step = factor
                .ok_or(FilterError::NotPositive("information about the attitude"))?
                .solve(&gradient);
            mode *= crate::so3::exp(&step);
            if step.norm() < NEWTON_TOLERANCE {
                mode.renormalize();
                let (_, information, _) = self.derivatives(&f, mode.matrix());
                return Ok(MatrixFisher::from_mode_and_information(mode, information)?);
            }
        }
        Err(FilterError::NoConvergence("mode of the attitude"))
    }

    /// Gradient of the log-posterior by the body-frame rotation vector, minus its Hessian, and the
    /// part of that which is positive for a concentrated prior.
    fn derivatives(
        &self,
        f: &Matrix3<f64>,
        at: &Matrix3<f64>,
    ) -> (Vector3<f64>, Matrix3<f64>, Matrix3<f64>) {
        let by_rotation = rotated_vector_by_rotation(at);
        let weighted = self.weight * self.residual_at(at);
        let mut slope = *f;
        let mut jacobian = Matrix3::zeros();
        for i in 0..3 {
            slope += self.rows[i] * weighted[i];
            let row = by_rotation.transpose() * vectorize(&self.rows[i]);
            jacobian.set_row(i, &row.transpose());
        }
        let bending = |slope: &Matrix3<f64>| {
            let in_body = at.transpose() * slope;
            Matrix3::identity() * in_body.trace() - (in_body + in_body.transpose()) * 0.5
        };
        let gauss_newton = jacobian.transpose() * self.weight * jacobian;
        let gradient = by_rotation.transpose() * vectorize(&slope);
        (gradient, gauss_newton + bending(&slope), gauss_newton + bending(f))
    }

    /// W22 table 5.2.
    fn sigma_points(&self, prior: &MatrixFisher) -> Result<MatrixFisher, FilterError> {
        let config = ProgressiveConfig {
            least_ratio: SIGMA_POINT_RATIO,
            central_share: CENTRAL_SHARE,
            max_steps: MAX_SIGMA_POINT_STEPS,
        };
        Ok(progressive_update(prior, |rotation| self.log(rotation.matrix()), &config)?)
    }
}

/// Concentration about the least known axis.
fn concentration(fisher: &MatrixFisher) -> f64 {
    fisher.svd().s[1] + fisher.svd().s[2]
}

/// The length of a change of `F` in the Fisher metric: to second order the square root of twice
/// the Kullback-Leibler divergence.
fn distance(belief: &MatrixFisher, change: &Matrix3<f64>) -> f64 {
    let svd = belief.svd();
    let central = vectorize(&(svd.u.inverse() * change * svd.v));
    let (_, covariance) = mean_and_covariance(belief.moments());
    central.dot(&(covariance * central)).max(0.0).sqrt()
}

#[cfg(test)]
mod tests {
    use super::super::tests::{diffuse_belief, sampled};
    use super::*;
    use crate::distribution::matrix_fisher_gaussian::Correlation;
    use crate::filter::gnss::belief::Euclidean;
    use nalgebra::Rotation3;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    const FULL: Regression = Regression::Full(Correlation::World);

    fn measured(belief: &NavigationBelief) -> PositionMeasurement {
        let predicted = belief.mean.fixed_rows::<3>(POSITION).into_owned();
        PositionMeasurement {
            in_world: predicted + Vector3::new(0.5, -0.4, 0.3),
            covariance: Matrix3::from_diagonal(&Vector3::new(0.09, 0.16, 0.25)),
            lever_arm: Vector3::new(0.3, -0.2, 0.1),
        }
    }

    /// Changes of `E[R]` and `E[x]` by the exact posterior: means of weighted samples of the prior
    /// less those of the samples themselves.
    fn exact_shifts(
        belief: &NavigationBelief,
        measured: &PositionMeasurement,
    ) -> (Matrix3<f64>, Euclidean) {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        let information = measured.covariance.try_inverse().unwrap();
        let samples = sampled(belief, 300_000, &mut rng);
        let mean = |weight: &dyn Fn(&Rotation3<f64>, &Euclidean) -> f64| {
            let (mut total, mut rotation, mut x) = (0.0, Matrix3::zeros(), Euclidean::zeros());
            for (r, sample) in &samples {
                let weight = weight(r, sample);
                total += weight;
                rotation += r.matrix() * weight;
                x += sample * weight;
            }
            (rotation / total, x / total)
        };
        let before = mean(&|_, _| 1.0);
        let after = mean(&|r, x| {
            let e = measured.in_world - x.fixed_rows::<3>(POSITION) - r * measured.lever_arm;
            (-0.5 * e.dot(&(information * e))).exp()
        });
        (after.0 - before.0, after.1 - before.1)
    }

    /// Errors of the shifts of `E[R]` and `E[x]`, as shares of the exact ones.
    fn errors(measured: &PositionMeasurement, method: AttitudeUpdate) -> (f64, f64) {
        let belief = diffuse_belief();
        let (rotation, x) = exact_shifts(&belief, measured);
        let posterior = update_position(&belief, measured, method, FULL).unwrap();
        let turned = posterior.attitude.mean() - belief.attitude.mean();
        let error = (turned - rotation).norm() / rotation.norm();
        (error, (posterior.mean - belief.mean - x).norm() / x.norm())
    }

    /// The only approximation of the flow is to take what is in between for matrix Fisher.
    #[test]
    fn the_flow_is_exact_for_a_weak_position_and_close_for_a_strong_one() {
        let strong = measured(&diffuse_belief());
        let weak = PositionMeasurement { covariance: strong.covariance * 100.0, ..strong };
        let (rotation, mean) = errors(&weak, AttitudeUpdate::Flow);
        assert!(rotation < 0.05 && mean < 0.05, "{rotation} {mean}");
        let flow = errors(&strong, AttitudeUpdate::Flow);
        let points = errors(&strong, AttitudeUpdate::SigmaPoints);
        assert!(flow.0 < 0.2 && flow.1 < 0.2, "{flow:?}");
        assert!(flow.0 < points.0 && flow.1 < points.1, "{flow:?} {points:?}");
    }

    #[test]
    fn both_ways_agree_where_the_attitude_is_concentrated() {
        let mut belief = diffuse_belief();
        let svd = belief.attitude.svd();
        let s = Vector3::new(2e4, 1.2e4, 5e3);
        belief.attitude = MatrixFisher::from_svd(crate::so3::ProperSvd { s, ..*svd }).unwrap();
        belief.slope *= 20.0;
        let linear = LinearPosition::new(&belief, &measured(&belief)).unwrap();
        let likelihood = linear.likelihood(&belief);
        let flow = likelihood.integrate(belief.attitude).unwrap();
        let mode = likelihood.mode_and_curvature(&belief.attitude).unwrap();
        let between = crate::so3::log(&(flow.mode().inverse() * mode.mode()));
        let sd = flow.rotation_covariance().diagonal().map(f64::sqrt);
        assert!(between.component_div(&sd).amax() < 0.02, "{between} {sd}");
        let prior = belief.attitude.information();
        let gained = (flow.information() - prior).norm();
        assert!(gained > 0.05 * prior.norm());
        assert!((flow.information() - mode.information()).norm() < 0.02 * gained);
    }

    #[test]
    fn the_regression_on_r_is_unchanged_by_evidence_about_r() {
        let belief = diffuse_belief();
        let evidence = Matrix3::new(3.0, 0.5, -0.2, 0.1, 2.0, 0.7, -0.4, 0.3, 1.0);
        let posterior = update_attitude(&belief, &evidence, FULL).unwrap();
        let sum = belief.attitude.parameter() + evidence;
        assert!((posterior.attitude.parameter() - sum).norm() < 1e-9);
        let given = |b: &NavigationBelief, r: &Matrix3<f64>| {
            let svd = b.attitude.svd();
            let q = svd.u.inverse() * r * svd.v;
            let (mean, _) = mean_and_covariance(b.attitude.moments());
            b.mean + b.slope * (vectorize(&q) - mean)
        };
        for turn in [Vector3::zeros(), Vector3::new(2.0, -1.0, 0.5)] {
            let r = *crate::so3::exp(&turn).matrix();
            assert!((given(&belief, &r) - given(&posterior, &r)).norm() < 1e-9);
        }
        assert!((belief.conditional - posterior.conditional).norm() < 1e-9);
    }
}
