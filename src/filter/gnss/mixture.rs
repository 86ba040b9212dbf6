//! A belief as a small mixture of matrix Fisher-Gaussian densities, divided by heading.
//!
//! # What one density loses
//!
//! Under an error `d` of the gyroscope's bias about the vertical the heading *now* says little of
//! the headings before, through which specific force became velocity. Given the attitude `R` now,
//!
//! ```text
//! v = R g0 + R g1 d + ...,    Cov[v, d | R] = R g1 Var[d | R],
//! ```
//!
//! with vectors `g0`, `g1` that only the IMU's readings enter (the position likewise). The first
//! term is linear in `R`, and the regression of a belief on `R` holds it for any attitude. The
//! covariance turns with the heading, but `Cov[x | R]` of a belief is one matrix for all `R`: the
//! mean of `R g1` over the headings, which is zero where the heading is unknown. Fixes then no
//! longer tell the bias, the bias turns the heading while the belief narrows, and the belief ends up
//! sure of a wrong one: heading and bias lie on a bent strip (a "banana") that one density cuts off.
//!
//! # The cure
//!
//! Over the width of one component `R g1` hardly turns. Windows over the heading divide a density
//! *exactly*: with the mode `M`, `P = diag(1, 1, 0)`, `e3` the vertical and
//! `E_k = (kappa/2) (P R_z(phi_k) - e3 e3^T) M`,
//!
//! ```text
//! tr(E_k^T R) = (kappa/2) ((1 + cos t) cos(psi - phi_k) - cos t),
//! sum_k exp(tr(E_k^T R)) = const,
//! ```
//!
//! for an attitude at the heading `psi` and the tilt `t` from `M`: the sum is even but for a ripple
//! `2 I_K(kappa)/I_0(kappa)` (3e-4 for the constants here) and, in `t`, a factor
//! `(1 + cos t)^(-1/2)`. As `tr(E_k^T R)` is linear in `R`, each part `M(F + E_k)` is matrix Fisher
//! again, with the weight `c(F + E_k)/c(F)` and the same regression on `R`. Where the belief
//! concentrates, components are merged by their moments (Runnalls 2007, (16)) until one is left;
//! where a component becomes broad, it is divided again, which divides the bias, too: by then it
//! goes with the heading.

use nalgebra::{Matrix2, Matrix3, Rotation3, SVector, Vector2, Vector3};

use super::belief::{
    ACCEL_BIAS, EUCLIDEAN, Euclidean, EuclideanCovariance, GYRO_BIAS, JointMoments,
    NavigationBelief, POSITION, Regression, Slope, VELOCITY,
};
use super::central::{Matrix9, Vector9};
use super::propagation::MomentPropagator;
use super::update;
use super::{AttitudeUpdate, Innovation};
use crate::alignment::vectorize;
use crate::distribution::matrix_fisher::MatrixFisher;
use crate::filter::{FilterError, PositionMeasurement};
use crate::inertial::{Belief, NavCovariance, NavState, block, symmetrize};
use crate::so3::{exp, log, right_jacobian_inverse};

/// Windows on the circle and the standard deviation of one, rad: so wide that their sum is even.
const WINDOWS: usize = 36;
const WINDOW_SD: f64 = 20.0 / 3.0 * DEGREE;
/// A component is divided beyond this standard deviation of its heading: twice that of a window.
const DIVIDED_SD: f64 = 2.0 * WINDOW_SD;
/// Components are not merged to one that is broader, unless there are too many of them.
const MERGED_SD: f64 = 1.5 * WINDOW_SD;
/// Below this standard deviation of the whole heading one component is enough: a correlation that
/// turns by it keeps all but `1 - cos` of itself, 0.4 %.
const SINGLE_SD: f64 = 5.0 * DEGREE;
/// A component of a smaller weight is dropped.
const LEAST_WEIGHT: f64 = 1e-6;
/// Two components are merged if the mixture's Kullback-Leibler divergence grows by less, nats.
const MERGING_LOSS: f64 = 0.01;
/// The two that lose least are merged until there are no more than these.
const MAX_COMPONENTS: usize = 96;
const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// A density with its share of the whole.
#[derive(Debug, Clone)]
pub(super) struct Component {
    pub weight: f64,
    pub belief: NavigationBelief,
}

/// Components whose weights add up to one; at least one.
#[derive(Debug, Clone)]
pub(super) struct Mixture {
    components: Vec<Component>,
    /// Room for the beliefs of a step, which replace all or none.
    moved: Vec<NavigationBelief>,
    regression: Regression,
    /// Whether broad components are divided.
    divided: bool,
}

impl Mixture {
    pub fn new(
        belief: NavigationBelief,
        regression: Regression,
        divided: bool,
    ) -> Result<Self, FilterError> {
        let components = vec![Component { weight: 1.0, belief }];
        let mut mixture = Self { components, moved: Vec::new(), regression, divided };
        mixture.divide()?;
        Ok(mixture)
    }

    pub fn components(&self) -> &[Component] {
        &self.components
    }

    pub fn components_mut(&mut self) -> impl Iterator<Item = &mut NavigationBelief> {
        self.components.iter_mut().map(|component| &mut component.belief)
    }

    /// The belief `h` seconds later, the measured rates averaged over the step.
    pub fn propagate(
        &mut self,
        propagator: &MomentPropagator,
        rate: &Vector3<f64>,
        force: &Vector3<f64>,
        h: f64,
    ) -> Result<(), FilterError> {
        self.moved.clear();
        for Component { belief, .. } in &self.components {
            self.moved.push(propagator.step(belief, rate, force, h, self.regression)?);
        }
        self.exchange();
        let divided = self.divide();
        if divided.is_err() {
            self.exchange();
        }
        divided
    }

    /// Exchanges the beliefs for those in waiting.
    fn exchange(&mut self) {
        for (component, moved) in self.components.iter_mut().zip(&mut self.moved) {
            std::mem::swap(&mut component.belief, moved);
        }
    }

    /// Conditions on attitude evidence, the likelihood `exp(tr(F^T R))`.
    pub fn update_attitude(&mut self, evidence: &Matrix3<f64>) -> Result<(), FilterError> {
        self.condition(|belief, regression| {
            let posterior = update::update_attitude(belief, evidence, regression)?;
            let gained = log_constant(&posterior.attitude) - log_constant(&belief.attitude);
            Ok((gained, posterior))
        })
    }

    /// Conditions on a position; the evidence of a component is Gaussian in its innovation.
    pub fn update_position(
        &mut self,
        measured: &PositionMeasurement,
        method: AttitudeUpdate,
    ) -> Result<(), FilterError> {
        self.condition(|belief, regression| {
            let evidence = update::innovation(belief, measured)?.log_likelihood();
            Ok((evidence, update::update_position(belief, measured, method, regression)?))
        })
    }

    /// Replaces each component by its posterior, its weight by that times its evidence.
    fn condition(
        &mut self,
        posterior: impl Fn(
            &NavigationBelief,
            Regression,
        ) -> Result<(f64, NavigationBelief), FilterError>,
    ) -> Result<(), FilterError> {
        let regression = self.regression;
        let parts = self.components.iter().map(|Component { weight, belief }| {
            let (evidence, belief) = posterior(belief, regression)?;
            Ok((weight.ln() + evidence, belief))
        });
        let parts = parts.collect::<Result<Vec<_>, FilterError>>()?;
        let mut next = Self { components: weighted(parts)?, ..self.empty() };
        next.reduce()?;
        *self = Self { moved: std::mem::take(&mut self.moved), ..next };
        Ok(())
    }

    fn empty(&self) -> Self {
        let (regression, divided) = (self.regression, self.divided);
        Self { components: Vec::new(), moved: Vec::new(), regression, divided }
    }

    /// The mixture with all covariances multiplied by `factor`: each density to the power of
    /// `1/factor`, and the weights likewise.
    pub fn enlarge(&mut self, factor: f64) -> Result<(), FilterError> {
        let parts = self.components.iter().map(|Component { weight, belief }| {
            Ok((weight.ln() / factor, belief.enlarged(factor)?))
        });
        let parts = parts.collect::<Result<Vec<_>, FilterError>>()?;
        self.components = weighted(parts)?;
        self.divide()
    }

    /// Difference of a position from its prediction, with the covariance of the whole mixture.
    pub fn innovation(&self, measured: &PositionMeasurement) -> Result<Innovation, FilterError> {
        let parts = self.components.iter().map(|Component { weight, belief }| {
            Ok((*weight, update::innovation(belief, measured)?))
        });
        let parts = parts.collect::<Result<Vec<_>, FilterError>>()?;
        combined_innovation(&parts)
    }

    /// The mode of the matrix Fisher density with the mixture's `E[R]`.
    fn mean_attitude(&self) -> Rotation3<f64> {
        match &self.components[..] {
            [single] => single.belief.attitude.mode(),
            all => {
                let mean: Matrix3<f64> =
                    all.iter().map(|part| part.belief.attitude.mean() * part.weight).sum();
                crate::so3::project_to_so3(&mean).unwrap_or_default()
            }
        }
    }

    fn mean_vector(&self) -> Euclidean {
        self.components.iter().map(|part| part.belief.mean * part.weight).sum()
    }

    /// Mean attitude and mean of the rest.
    pub fn state(&self) -> NavState {
        if let [single] = &self.components[..] {
            return single.belief.state();
        }
        NavigationBelief::state_of(&self.mean_attitude(), &self.mean_vector())
    }

    /// `S` of the matrix Fisher density with the mixture's `E[R]`.
    pub fn concentration(&self) -> Vector3<f64> {
        if let [single] = &self.components[..] {
            return single.belief.attitude.svd().s;
        }
        let mean = self.components.iter().map(|part| part.belief.attitude.mean() * part.weight);
        MatrixFisher::from_mean(&mean.sum()).map_or_else(|_| Vector3::zeros(), |m| m.svd().s)
    }

    /// The mean and the covariance of the error about it.
    pub fn summary(&self) -> Belief {
        if let [single] = &self.components[..] {
            return single.belief.summary();
        }
        let parts = self.components.iter().map(|part| (part.weight, part.belief.summary()));
        combined_belief(&parts.collect::<Vec<_>>(), &self.mean_attitude())
    }

    /// Divides what has become broad.
    fn divide(&mut self) -> Result<(), FilterError> {
        let broad = |part: &Component| heading_variance(&part.belief.attitude) > DIVIDED_SD.powi(2);
        if !self.divided || !self.components.iter().any(broad) {
            return Ok(());
        }
        let mut parts = Vec::new();
        for component in &self.components {
            if broad(component) {
                divide_by_heading(component, self.regression, &mut parts)?;
            } else {
                parts.push((component.weight.ln(), component.belief.clone()));
            }
        }
        let mut next = Self { components: weighted(parts)?, ..self.empty() };
        next.reduce()?;
        *self = Self { moved: std::mem::take(&mut self.moved), ..next };
        Ok(())
    }

    /// Merges components that are alike, or too many.
    fn reduce(&mut self) -> Result<(), FilterError> {
        if self.components.len() == 1 {
            return Ok(());
        }
        let mut marginals: Vec<Marginal> = self.components.iter().map(Marginal::of).collect();
        let whole = marginals.iter().skip(1).fold(marginals[0], |all, part| all.merged(part));
        if whole.covariance[(0, 0)] < SINGLE_SD.powi(2) {
            let belief = merged(&self.components, self.regression)?;
            self.components = vec![Component { weight: 1.0, belief }];
            return Ok(());
        }
        while let Some((i, j)) = self.alike(&marginals) {
            let (second, first) = (self.components.swap_remove(j), self.components[i].clone());
            let weight = first.weight + second.weight;
            let belief = merged(&[first, second], self.regression)?;
            self.components[i] = Component { weight, belief };
            marginals.swap_remove(j);
            marginals[i] = Marginal::of(&self.components[i]);
        }
        Ok(())
    }

    /// The pair that loses least, if it is to be merged; `i < j`.
    fn alike(&self, marginals: &[Marginal]) -> Option<(usize, usize)> {
        let crowded = marginals.len() > MAX_COMPONENTS;
        let mut best: Option<(f64, usize, usize)> = None;
        for (j, second) in marginals.iter().enumerate() {
            for (i, first) in marginals[..j].iter().enumerate() {
                let whole = first.merged(second);
                let loss = first.loss(second, &whole);
                let allowed = crowded
                    || (loss < MERGING_LOSS && whole.covariance[(0, 0)] < MERGED_SD.powi(2));
                if allowed && best.is_none_or(|(least, ..)| loss < least) {
                    best = Some((loss, i, j));
                }
            }
        }
        best.map(|(_, i, j)| (i, j))
    }
}

/// The residual of the mean of weighted predictions, with the covariance of them all.
pub(crate) fn combined_innovation(parts: &[(f64, Innovation)]) -> Result<Innovation, FilterError> {
    if let [(_, innovation)] = parts {
        return Ok(*innovation);
    }
    let residual: Vector3<f64> = parts.iter().map(|(w, part)| part.residual * *w).sum();
    let about = |part: &Innovation| {
        let apart = part.residual - residual;
        part.covariance + apart * apart.transpose()
    };
    let covariance = parts.iter().map(|(w, part)| about(part) * *w).sum();
    Innovation::new(residual, covariance)
}

/// The mean of weighted beliefs, `attitude` standing for that of their attitudes, and the
/// covariance of the error about it. A part at the rotation `d` from that attitude adds to the error
/// of its own, `e`: `log(exp(d) exp(e)) = d + J_r(d)^-1 e`.
pub(crate) fn combined_belief(parts: &[(f64, Belief)], attitude: &Rotation3<f64>) -> Belief {
    let vector = |belief: &Belief| {
        let NavState { world_from_body, velocity, gyro_bias, accel_bias } = &belief.state;
        let mut x = Euclidean::zeros();
        x.fixed_rows_mut::<3>(VELOCITY).copy_from(velocity);
        x.fixed_rows_mut::<3>(POSITION).copy_from(&world_from_body.translation.vector);
        x.fixed_rows_mut::<3>(GYRO_BIAS).copy_from(gyro_bias);
        x.fixed_rows_mut::<3>(ACCEL_BIAS).copy_from(accel_bias);
        x
    };
    let mean: Euclidean = parts.iter().map(|(weight, part)| vector(part) * *weight).sum();
    let mut covariance = NavCovariance::zeros();
    for (weight, part) in parts {
        let own = part.state.world_from_body.rotation.to_rotation_matrix();
        let apart = log(&(attitude.inverse() * own));
        let mut transport = NavCovariance::identity();
        transport.fixed_view_mut::<3, 3>(0, 0).copy_from(&right_jacobian_inverse(&apart));
        let mut shift = SVector::<f64, 15>::zeros();
        shift.fixed_rows_mut::<3>(block::ROTATION).copy_from(&apart);
        shift.fixed_rows_mut::<EUCLIDEAN>(3).copy_from(&(vector(part) - mean));
        let own = transport * part.covariance * transport.transpose();
        covariance += (own + shift * shift.transpose()) * *weight;
    }
    symmetrize(&mut covariance);
    Belief { state: NavigationBelief::state_of(attitude, &mean), covariance }
}

/// Heading and bias about the vertical, the two in which a belief is bent.
#[derive(Debug, Clone, Copy)]
struct Marginal {
    weight: f64,
    /// To which headings are relative.
    mode: Rotation3<f64>,
    /// Heading from the mode (rad), bias (rad/s).
    mean: Vector2<f64>,
    covariance: Matrix2<f64>,
}

impl Marginal {
    fn of(component: &Component) -> Self {
        let Belief { state, covariance } = component.belief.summary();
        let up = state.world_from_body.rotation.inverse() * Vector3::z();
        let part =
            |row: usize, column: usize| up.dot(&(covariance.fixed_view::<3, 3>(row, column) * up));
        let cross = part(block::ROTATION, block::GYRO_BIAS);
        Self {
            weight: component.weight,
            mode: component.belief.attitude.mode(),
            mean: Vector2::new(0.0, up.dot(&state.gyro_bias)),
            covariance: Matrix2::new(
                part(block::ROTATION, block::ROTATION),
                cross,
                cross,
                part(block::GYRO_BIAS, block::GYRO_BIAS),
            ),
        }
    }

    /// Both by their moments, at the mode of the first.
    fn merged(&self, other: &Self) -> Self {
        let turn = log(&(other.mode * self.mode.inverse())).z;
        let second = Vector2::new(turn, 0.0) + other.mean;
        let weight = self.weight + other.weight;
        let [p, q] = [self.weight / weight, other.weight / weight];
        let apart = second - self.mean;
        Self {
            weight,
            mode: self.mode,
            mean: self.mean * p + second * q,
            covariance: self.covariance * p
                + other.covariance * q
                + apart * apart.transpose() * (p * q),
        }
    }

    /// Bound of the divergence that merging to `whole` adds (Runnalls 2007, (21)).
    fn loss(&self, other: &Self, whole: &Self) -> f64 {
        let part = |m: &Self| m.weight * m.covariance.determinant().max(f64::MIN_POSITIVE).ln();
        0.5 * (part(whole) - part(self) - part(other))
    }
}

/// Variance of the heading, rad^2: exact for a heading that is wrapped normal and independent of a
/// small tilt. With `T = E[R] M^T`: `E[cos psi] E[(1 + cos t)/2]` is the mean of `T11`, `T22`, and
/// `E[cos t]` is `T33`.
fn heading_variance(attitude: &MatrixFisher) -> f64 {
    let from_mode = attitude.mean() * attitude.mode().inverse();
    let cosine = (from_mode[(0, 0)] + from_mode[(1, 1)]) / (1.0 + from_mode[(2, 2)]);
    if cosine > 0.0 { -2.0 * cosine.min(1.0).ln() } else { f64::INFINITY }
}

/// Adds the parts of a component, with the logarithms of their weights.
fn divide_by_heading(
    component: &Component,
    regression: Regression,
    parts: &mut Vec<(f64, NavigationBelief)>,
) -> Result<(), FilterError> {
    let Component { weight, belief } = component;
    let mode = *belief.attitude.mode().matrix();
    let half = 0.5 * WINDOW_SD.powi(-2);
    let before = log_constant(&belief.attitude);
    let mut own = Vec::with_capacity(WINDOWS);
    for k in 0..WINDOWS {
        let phi = std::f64::consts::TAU * k as f64 / WINDOWS as f64;
        let mut window = *exp(&(Vector3::z() * phi)).matrix();
        window[(2, 2)] = -1.0;
        let attitude = MatrixFisher::new(&(belief.attitude.parameter() + window * mode * half))?;
        // Relative to the height of the window.
        let share = log_constant(&attitude) - before - half;
        if share > LEAST_WEIGHT.ln() {
            own.push((share, update::with_attitude(belief, attitude, regression)?));
        }
    }
    let total: f64 = own.iter().map(|(share, _)| share.exp()).sum();
    parts.extend(own.into_iter().map(|(share, part)| (weight.ln() + share - total.ln(), part)));
    Ok(())
}

/// `log c(F)`.
fn log_constant(attitude: &MatrixFisher) -> f64 {
    attitude.moments().log_c_scaled() + attitude.svd().s.sum()
}

/// Components of the logarithms of weights, normalised; those that do not count are dropped.
fn weighted(parts: Vec<(f64, NavigationBelief)>) -> Result<Vec<Component>, FilterError> {
    let largest = parts.iter().map(|(log, _)| *log).fold(f64::NEG_INFINITY, f64::max);
    if !largest.is_finite() {
        return Err(FilterError::NotFinite("weights of the mixture"));
    }
    let relative = |log: f64| (log - largest).exp();
    let kept = parts.into_iter().filter(|(log, _)| relative(*log) > LEAST_WEIGHT);
    let mut components: Vec<Component> =
        kept.map(|(log, belief)| Component { weight: relative(log), belief }).collect();
    let total: f64 = components.iter().map(|part| part.weight).sum();
    components.iter_mut().for_each(|part| part.weight /= total);
    Ok(components)
}

/// The belief with the moments of `R` and `x` of all components. They are added up in the principal
/// axes of the new attitude: there the components of `q` have their own scales, which rounding keeps.
fn merged(
    components: &[Component],
    regression: Regression,
) -> Result<NavigationBelief, FilterError> {
    let total: f64 = components.iter().map(|part| part.weight).sum();
    let (mut mean_r, mut mean_x) = (Matrix3::zeros(), Euclidean::zeros());
    for Component { weight, belief } in components {
        mean_r += belief.attitude.mean() * (weight / total);
        mean_x += belief.mean * (weight / total);
    }
    let attitude = MatrixFisher::from_mean(&mean_r)?;
    let (u, v) = (attitude.svd().u.inverse(), attitude.svd().v.inverse());
    let mut moments = JointMoments {
        x: EuclideanCovariance::zeros(),
        cross: Slope::zeros(),
        q: Matrix9::zeros(),
    };
    for Component { weight, belief } in components {
        let svd = belief.attitude.svd();
        let axes = (v * svd.v).matrix().kronecker((u * svd.u).matrix());
        let own = belief.joint_moments();
        let share = weight / total;
        let apart = u * (belief.attitude.mean() - mean_r) * v.inverse();
        let q: Vector9 = vectorize(&apart);
        let x = belief.mean - mean_x;
        moments.q += (axes * own.q * axes.transpose() + q * q.transpose()) * share;
        moments.cross += (own.cross * axes.transpose() + x * q.transpose()) * share;
        moments.x += (own.x + x * x.transpose()) * share;
    }
    let identity = Matrix9::identity();
    let belief = NavigationBelief::from_moments(attitude, mean_x, &moments, &identity, regression)?;
    if belief.is_finite() { Ok(belief) } else { Err(FilterError::NotFinite("merged belief")) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::distribution::matrix_fisher_gaussian::Correlation;
    use crate::filter::gnss::InitialBelief;
    use crate::inertial::ImuConfig;
    use nalgebra::Isometry3;

    const FULL: Regression = Regression::Full(Correlation::World);

    fn initial(heading_sd: Option<f64>) -> NavigationBelief {
        let state = NavState {
            world_from_body: Isometry3::rotation(Vector3::new(0.2, -0.1, 0.7)),
            velocity: Vector3::new(1.0, 0.5, 0.0),
            gyro_bias: Vector3::zeros(),
            accel_bias: Vector3::zeros(),
        };
        let initial = InitialBelief {
            state,
            tilt_sd: 0.05,
            heading_sd,
            velocity_sd: 0.02,
            position_sd: 0.1,
            gyro_bias_sd: 0.05,
            accel_bias_sd: 0.01,
        };
        initial.matrix_fisher_gaussian().unwrap()
    }

    fn divided(belief: NavigationBelief) -> Mixture {
        Mixture::new(belief, FULL, true).unwrap()
    }

    /// The density itself, at any heading and where the tilt is likely.
    #[test]
    fn windows_divide_a_density_exactly() {
        for heading_sd in [None, Some(0.5)] {
            let whole = initial(heading_sd);
            // Not yet merged, which changes the flanks by half a percent.
            let undivided = Component { weight: 1.0, belief: whole.clone() };
            let mut parts = Vec::new();
            divide_by_heading(&undivided, FULL, &mut parts).unwrap();
            let parts = weighted(parts).unwrap();
            assert!(parts.len() >= 10, "{}", parts.len());
            let mode = whole.attitude.mode();
            let nearby = if heading_sd.is_some() { 0.25 } else { 1.0 };
            for k in 0..12 {
                let heading = nearby * (0.5 * f64::from(k) - 3.0);
                let tilt = 0.1 * Vector3::new((1.3 * heading).cos(), (1.3 * heading).sin(), 0.0);
                let r = exp(&(Vector3::z() * heading)) * exp(&tilt) * mode;
                let density: f64 = parts
                    .iter()
                    .map(|part| part.weight * part.belief.attitude.log_density(&r).exp())
                    .sum();
                let ratio = density / whole.attitude.log_density(&r).exp();
                assert!((ratio - 1.0).abs() < 5e-3, "{heading_sd:?} {heading}: {ratio}");
            }
        }
    }

    #[test]
    fn merged_components_have_the_moments_of_all() {
        let whole = initial(Some(0.5));
        let parts = divided(whole.clone());
        let merged = merged(parts.components(), FULL).unwrap();
        assert!((merged.attitude.mean() - whole.attitude.mean()).amax() < 2e-3);
        let turned = parts.summary();
        let one = whole.summary();
        assert!((merged.mean - whole.mean).amax() < 1e-9);
        for k in 0..15 {
            let ratio = turned.covariance[(k, k)] / one.covariance[(k, k)];
            assert!((ratio - 1.0).abs() < 0.03, "{k}: {ratio}");
        }
    }

    /// `Cov[v, d | R]` for the horizontal velocity across the specific force, with the variances of
    /// the two.
    fn moments_across(belief: &NavigationBelief, force: &Vector3<f64>) -> (f64, [f64; 2]) {
        let mode = belief.attitude.mode();
        let across = Vector3::z().cross(&(mode * force)).normalize();
        let up = mode.inverse() * Vector3::z();
        let block = |row: usize, column: usize| {
            belief.conditional.fixed_view::<3, 3>(row, column).into_owned()
        };
        let cross = across.dot(&(block(VELOCITY, GYRO_BIAS) * up));
        let variances = [
            across.dot(&(block(VELOCITY, VELOCITY) * across)),
            up.dot(&(block(GYRO_BIAS, GYRO_BIAS) * up)),
        ];
        (cross, variances)
    }

    /// What a vertical bias does to the velocity turns with the heading; one density averages it to
    /// nothing, the components keep it.
    #[test]
    fn components_keep_what_turns_with_the_heading() {
        let config = ImuConfig { gyro_noise: 1e-4, accel_noise: 1e-3, ..ImuConfig::default() };
        let propagator = MomentPropagator::new(&config);
        let mut single = Mixture::new(initial(None), FULL, false).unwrap();
        let mut parts = divided(initial(None));
        let level = single.components()[0].belief.attitude.mode();
        let acceleration = Vector3::new(1.5, 0.0, 0.0);
        let force = level.inverse() * (acceleration + Vector3::z() * config.gravity);
        for _ in 0..150 {
            for mixture in [&mut single, &mut parts] {
                mixture.propagate(&propagator, &Vector3::zeros(), &force, 0.02).unwrap();
            }
        }
        let push = level.inverse() * acceleration;
        // Relative to `|R g1| Var[d]` with `|R g1| = a t^2/2`. Not as a correlation: horizontal
        // biases `b` tilt gravity, and so add `(g t^2/2)^2 Var[b | R]` to the variance of the
        // velocity, ten times what `d` does.
        let slope = 0.5 * 1.5 * 3.0_f64.powi(2);
        let (cross, variances) = moments_across(&single.components()[0].belief, &push);
        let lost = cross / (slope * 0.05_f64.powi(2));
        assert!(lost.abs() < 0.1, "{lost} {variances:?}");
        for part in parts.components().iter().filter(|part| part.weight > 0.02) {
            let (cross, variances) = moments_across(&part.belief, &push);
            let kept = cross / (slope * variances[1]);
            assert!((0.9..1.1).contains(&kept.abs()), "{kept} {variances:?}");
        }
    }

    #[test]
    fn components_are_merged_once_the_heading_is_known() {
        let config = ImuConfig { gyro_noise: 1e-4, accel_noise: 1e-3, ..ImuConfig::default() };
        let propagator = MomentPropagator::new(&config);
        let mut mixture = divided(initial(None));
        let heading = exp(&(Vector3::z() * 2.0));
        let truth = heading
            * Rotation3::from(
                Isometry3::rotation(Vector3::new(0.2, -0.1, 0.7)).rotation.to_rotation_matrix(),
            );
        let (mut position, mut velocity) = (Vector3::zeros(), Vector3::new(1.0, 0.5, 0.0));
        let h = 0.02;
        for k in 1..=250 {
            let acceleration = truth * Vector3::new((0.03 * f64::from(k)).cos(), 0.8, 0.0);
            let force = truth.inverse() * (acceleration + Vector3::z() * config.gravity);
            mixture.propagate(&propagator, &Vector3::zeros(), &force, h).unwrap();
            position += velocity * h + acceleration * (0.5 * h * h);
            velocity += acceleration * h;
            if k % 10 == 0 {
                let fix = PositionMeasurement {
                    in_world: position,
                    covariance: Matrix3::identity() * 0.01_f64.powi(2),
                    lever_arm: Vector3::zeros(),
                };
                mixture.update_position(&fix, AttitudeUpdate::Flow).unwrap();
            }
        }
        assert_eq!(mixture.components().len(), 1);
        let error =
            log(&(mixture.state().world_from_body.rotation.to_rotation_matrix() * truth.inverse()));
        assert!(error.z.abs() < 0.05, "{error}");
    }
}
