//! The matrix Fisher-Gaussian filter.

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::body_points::BodyPoints;
use super::broad::{BroadBelief, BroadUpdate, assemble, nav_state, of_belief};
use super::config::{FilterConfig, UpdateMethod};
use super::estimator::{PointUpdate, VisualInertialFilter};
use super::euclidean::{EUCLIDEAN, NavRegression, POSITION};
use super::frame_change::FrameChange;
use super::gate::Gate;
use super::kind::FilterKind;
use super::map_points::normalized_innovation_squared;
use super::propagation::{advance, interval_means};
use super::zero_velocity::ZeroVelocity;
use crate::alignment::{PointPair, PoseInformation, rotated_vector_by_rotation, vectorize};
use crate::distribution::matrix_fisher::MatrixFisher;
use crate::filter::core::{BayesFilter, Estimate, FilterError, InertialStep};
use crate::inertial::{Belief, Propagator, block};
use crate::so3::{ProperSvd, angle_between};

/// Least information about a rotation axis from which on the attitude is carried by its mode and
/// covariance, 1/rad^2.
const CONCENTRATED: f64 = 25.0;
/// Sum of the variances of a rotation above which it is carried as a matrix Fisher distribution,
/// rad^2; beyond the reach of [`CONCENTRATED`], so that beliefs do not go back and forth.
const BROAD: f64 = 0.2;
/// An attitude that moves less than this in an update needs no new weights, rad.
const SETTLED: f64 = 1e-3;

/// Filter whose belief is an MFG distribution (W22 chapter 3).
///
/// A concentrated belief is carried by its mode and covariance (W22 theorem 3.4), a broad one as
/// a matrix Fisher distribution and a regression on the whole rotation matrix. An update is made
/// with the densities themselves: matrix Fisher prior, Euclidean part regressed on `R`, and a
/// likelihood that is quadratic in both (`PoseInformation`). The Euclidean part is integrated out
/// exactly. If the marginal `log p(R)` is concentrated it is matched by a matrix Fisher density
/// with the same mode and curvature, `F = M (tr(H)/2 I - H)`; otherwise by the one with the same
/// mean `E[R]`.
#[derive(Debug, Clone)]
pub struct MfgFilter {
    kind: FilterKind,
    config: FilterConfig,
    propagator: Propagator,
    /// The belief, or its summary while it is broad.
    belief: Belief,
    broad: Option<Box<BroadBelief>>,
    gate: Gate,
}

impl MfgFilter {
    pub fn new(
        kind: FilterKind,
        config: &FilterConfig,
        propagator: Propagator,
        belief: Belief,
    ) -> Self {
        let gate = Gate::new(config);
        let config = config.clone();
        let mut filter = Self { kind, config, propagator, belief, broad: None, gate };
        filter.broaden();
        filter
    }

    /// Starts from a broad attitude that is independent of the rest of `belief`.
    pub fn broad(
        kind: FilterKind,
        config: &FilterConfig,
        propagator: Propagator,
        belief: Belief,
        attitude: &MatrixFisher,
    ) -> Self {
        let broad = BroadBelief::independent(&belief, attitude);
        let belief = broad.summary();
        let gate = Gate::new(config);
        let (config, broad) = (config.clone(), Some(Box::new(broad)));
        Self { kind, config, propagator, belief, broad, gate }
    }

    /// Whether the attitude is too uncertain for a covariance.
    pub(super) fn is_broad(&self) -> bool {
        self.broad.is_some()
    }

    /// Changes the form of a belief that has become too uncertain for a covariance.
    fn broaden(&mut self) {
        let rotation = self.belief.covariance.fixed_view::<3, 3>(block::ROTATION, block::ROTATION);
        if rotation.trace() > BROAD {
            self.broad = BroadBelief::of_belief(&self.belief).map(Box::new);
        }
    }

    fn update_broad(
        &mut self,
        broad: &BroadBelief,
        pairs: &[PointPair],
    ) -> Result<usize, FilterError> {
        let pairs = self.gate.accepted(pairs);
        let update = broad
            .update(pairs, self.config.kernel(), self.config.relinearizations)
            .ok_or(NO_POSTERIOR)?;
        let points = update.points;
        self.accept_broad(update)?;
        Ok(points)
    }

    fn accept_broad(&mut self, update: BroadUpdate) -> Result<(), FilterError> {
        if update.least_information > CONCENTRATED {
            let belief = concentrate(&update.density, &update.mode, &Vector3::zeros());
            self.belief = belief.filter(Belief::is_finite).ok_or(NO_POSTERIOR)?;
            self.broad = None;
        } else {
            let broad = update.into_belief().ok_or(NO_POSTERIOR)?;
            let summary = Some(broad.summary()).filter(Belief::is_finite);
            self.belief = summary.ok_or(NO_POSTERIOR)?;
            self.broad = Some(Box::new(broad));
        }
        Ok(())
    }

    fn update_by_sigma_points(
        &mut self,
        information: &PoseInformation,
    ) -> Result<usize, FilterError> {
        let prior = match self.broad.as_deref() {
            Some(broad) => Some(broad.clone()),
            None => BroadBelief::of_belief(&self.belief),
        };
        let posterior = prior.and_then(|prior| prior.update_by_sigma_points(information));
        let posterior = posterior.ok_or(NO_POSTERIOR)?;
        let summary = Some(posterior.summary()).filter(Belief::is_finite);
        self.belief = summary.ok_or(NO_POSTERIOR)?;
        self.broad = (posterior.least_information() <= CONCENTRATED).then(|| Box::new(posterior));
        Ok(information.points)
    }

    /// `information` is that of the accepted points at the predicted pose.
    fn update_concentrated(
        &mut self,
        mut information: PoseInformation,
        pairs: &[PointPair],
    ) -> Option<usize> {
        let mut rotation = self.belief.state.world_from_body.rotation.to_rotation_matrix();
        let mut renewals = self.config.relinearizations;
        let posterior = loop {
            let origin = information.origin;
            let prior = of_belief(&self.belief, &origin)?;
            let joint = prior.conditioned(POSITION, &information.joint)?;
            let posterior = concentrate(&joint, &rotation, &origin)?;
            let pose = &posterior.state.world_from_body;
            let found = pose.rotation.to_rotation_matrix();
            if renewals == 0 || angle_between(&found, &rotation) < SETTLED {
                break posterior;
            }
            renewals -= 1;
            rotation = found;
            let (pairs, kernel) = (self.gate.accepted(pairs), self.config.kernel());
            let position = &pose.translation.vector;
            information = PoseInformation::accumulate(pairs, &rotation, position, kernel);
        };
        self.belief = Some(posterior).filter(Belief::is_finite)?;
        Some(information.points)
    }
}

/// What an update refuses that has no mode, or no finite one.
const NO_POSTERIOR: FilterError = FilterError::NotPositive("posterior information");

impl BayesFilter for MfgFilter {
    fn name(&self) -> &'static str {
        self.kind.name()
    }

    fn propagate(&mut self, step: &InertialStep) -> Result<(), FilterError> {
        match &mut self.broad {
            None => drop(advance(&self.propagator, &mut self.belief, step)?),
            Some(broad) => {
                let (gyro, accel) = interval_means(&self.propagator, step)?;
                broad
                    .propagate(&self.propagator, &gyro, &accel, step.seconds)
                    .ok_or(FilterError::NotFinite("propagated belief"))?;
                self.belief = broad.summary();
                return Ok(());
            }
        }
        self.broaden();
        Ok(())
    }

    fn attitude(&self) -> Rotation3<f64> {
        self.belief.state.world_from_body.rotation.to_rotation_matrix()
    }

    fn estimate(&self) -> Estimate {
        Estimate::of_belief(&self.belief, self.matrix_fisher().map(|svd| svd.s))
    }

    fn gyro_bias(&self) -> Option<Vector3<f64>> {
        Some(self.belief.state.gyro_bias)
    }
}

impl VisualInertialFilter for MfgFilter {
    fn belief(&self) -> &Belief {
        &self.belief
    }

    fn set_imu_gap(&mut self, in_gap: bool) {
        self.propagator.set_imu_gap(in_gap);
    }

    fn update_map_points(&mut self, pairs: &[PointPair]) -> Result<PointUpdate, FilterError> {
        let pose = &self.belief.state.world_from_body;
        let (gating, information) = self.gate.screen(pairs, pose, &self.body_points());
        if information.points == 0 {
            return Err(FilterError::NoMeasurement);
        }
        let nis = normalized_innovation_squared(&information, &self.belief)?;
        let points = match (self.config.update_method, self.broad.clone()) {
            (UpdateMethod::SigmaPoints, _) => self.update_by_sigma_points(&information)?,
            (UpdateMethod::Exact, Some(broad)) => self.update_broad(&broad, pairs)?,
            (UpdateMethod::Exact, None) => {
                self.update_concentrated(information, pairs).ok_or(NO_POSTERIOR)?
            }
        };
        let refused = self.gate.refused();
        Ok(PointUpdate { nis, points, gating, refused, frame: FrameChange::default() })
    }

    fn update_zero_velocity(&mut self, rest: &ZeroVelocity) -> Result<FrameChange, FilterError> {
        match &self.broad {
            Some(broad) => {
                let update = broad.condition_on_zero_velocity(rest).ok_or(NO_POSTERIOR)?;
                self.accept_broad(update)?;
            }
            None => rest.condition(&mut self.belief)?,
        }
        Ok(FrameChange::default())
    }

    fn matrix_fisher(&self) -> Option<ProperSvd> {
        match &self.broad {
            Some(broad) => Some(*broad.attitude().svd()),
            None => self.belief.attitude().map(|attitude| *attitude.svd()),
        }
    }

    fn body_points(&self) -> BodyPoints {
        match &self.broad {
            Some(broad) => broad.body_points(),
            None => BodyPoints::of_belief(&self.belief),
        }
    }
}

/// The belief with the mode of a density, position relative to `origin`, and its moments to
/// second order in the rotation error.
fn concentrate(
    density: &NavRegression,
    start: &Rotation3<f64>,
    origin: &Vector3<f64>,
) -> Option<Belief> {
    let (mode, information) = density.attitude.mode(start)?;
    let rotation_covariance = information.cholesky()?.inverse();
    // E[R] = M (I + E[e^ e^] / 2).
    let shrink = (rotation_covariance - Matrix3::identity() * rotation_covariance.trace()) * 0.5;
    let mean = mode.matrix() * (Matrix3::identity() + shrink);
    let mut x = density.offset + density.slope * vectorize(&mean);
    let mut position = x.fixed_rows_mut::<3>(POSITION);
    position += origin;
    let by_rotation = density.slope * rotated_vector_by_rotation(mode.matrix());
    let cross = by_rotation * rotation_covariance;
    let euclidean: nalgebra::SMatrix<f64, EUCLIDEAN, EUCLIDEAN> =
        density.covariance + cross * by_rotation.transpose();
    Some(Belief {
        state: nav_state(&mode, &x),
        covariance: assemble(&rotation_covariance, &cross, &euclidean),
    })
}

#[cfg(test)]
mod tests {
    use super::super::broad::gradient_coordinate;
    use super::*;
    use crate::inertial::{NavCovariance, NavState};
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

    #[test]
    fn the_tangent_coordinate_is_v_r() {
        let mode = Rotation3::new(Vector3::new(0.3, -1.2, 0.7));
        let turn = Rotation3::new(Vector3::new(-0.4, 0.5, 0.9));
        let k = Matrix3::new(5.0, 0.3, -0.2, 0.3, 4.0, 0.5, -0.2, 0.5, 2.0);
        let rotation = mode * turn;
        let skew = k * turn.matrix() - turn.matrix().transpose() * k;
        let expected = Vector3::new(skew[(2, 1)], skew[(0, 2)], skew[(1, 0)]);
        let l = gradient_coordinate(&(mode.matrix() * k));
        assert_relative_eq!(l * vectorize(rotation.matrix()), expected, epsilon = 1e-12);
        assert_relative_eq!(l * vectorize(mode.matrix()), Vector3::zeros(), epsilon = 1e-12);
    }

    #[test]
    fn the_prior_has_the_moments_it_was_made_from() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let prior = belief(&mut rng, 0.02);
        let at = prior.state.world_from_body;
        let origin = at.translation.vector;
        let density = of_belief(&prior, &origin).unwrap();
        let back = concentrate(&density, &at.rotation.to_rotation_matrix(), &origin).unwrap();
        assert_relative_eq!(back.covariance, prior.covariance, epsilon = 1e-4);
        assert_relative_eq!(back.state.velocity, prior.state.velocity, epsilon = 1e-3);
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
        let mut mfg = MfgFilter::new(FilterKind::Mfgr, &config, propagator.clone(), prior);
        let mut mekf = super::super::Mekf::new(FilterKind::Mekfr, &config, propagator, prior);
        let (a, b) =
            (mfg.update_map_points(&pairs).unwrap(), mekf.update_map_points(&pairs).unwrap());
        assert_relative_eq!(a.nis, b.nis, max_relative = 1e-9);
        let (a, b) = (mfg.belief(), mekf.belief());
        let apart = a.state.world_from_body.rotation.angle_to(&b.state.world_from_body.rotation);
        assert!(apart < 1e-8, "{apart}");
        assert_relative_eq!(a.state.velocity, b.state.velocity, epsilon = 1e-6);
        assert_relative_eq!(a.covariance, b.covariance, epsilon = 1e-9);
    }

    /// Where a frame tells little, sigma points move the mode as the exact update does and leave
    /// the covariance too broad: see `progressive_update` for how much.
    #[test]
    fn sigma_points_move_the_mode_and_learn_a_sixth_of_the_information() {
        let state = NavState {
            world_from_body: Isometry3::identity(),
            velocity: Vector3::zeros(),
            gyro_bias: Vector3::zeros(),
            accel_bias: Vector3::zeros(),
        };
        let prior = Belief { state, covariance: NavCovariance::identity() * 2e-3 };
        let turn = Rotation3::new(Vector3::new(0.008, -0.005, 0.01));
        let variance = 0.1;
        let pair = |in_body: Vector3<f64>| PointPair {
            in_body,
            body_covariance: Matrix3::identity() * variance,
            in_world: turn * in_body,
            world_covariance: Matrix3::zeros(),
        };
        let axes = [Vector3::x(), Vector3::y(), Vector3::z()];
        let pairs: Vec<_> = axes.iter().flat_map(|axis| [pair(*axis), pair(-axis)]).collect();
        let update = |update_method| {
            let config = FilterConfig { huber: 0.0, update_method, ..FilterConfig::default() };
            let propagator = Propagator::constant_velocity(1.0, 1.0);
            let mut filter = MfgFilter::new(FilterKind::Mfgr, &config, propagator, prior);
            filter.update_map_points(&pairs).unwrap();
            *filter.belief()
        };
        let (exact, points) = (update(UpdateMethod::Exact), update(UpdateMethod::SigmaPoints));
        let rotation = |belief: &Belief| belief.state.world_from_body.rotation;
        let information =
            |belief: &Belief| 3.0 / belief.covariance.fixed_view::<3, 3>(0, 0).trace();
        let moved = rotation(&exact).angle_to(&rotation(&prior));
        let apart = rotation(&points).angle_to(&rotation(&exact));
        // Four of the six points have a lever of 1 m about each axis.
        let added = 4.0 / variance;
        let before = information(&prior);
        let expected = turn.angle() * added / (before + added);
        assert!((moved / expected - 1.0).abs() < 0.02, "{moved} {expected}");
        // One step is of first order in the information.
        assert!(apart < 1.2 * moved * added / before, "{apart} of {moved}");
        let gain = |belief: &Belief| information(belief) - before;
        assert!((gain(&exact) - added).abs() < 0.05 * added, "{}", gain(&exact));
        assert!((gain(&points) - added / 6.0).abs() < 0.05 * added, "{}", gain(&points));
    }

    #[test]
    fn degenerate_points_broaden_and_never_break() {
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        let prior = belief(&mut rng, 0.1);
        let all = pairs(&mut rng, &prior.state, 0.01, 3);
        for count in 0..=3 {
            let mut filter = MfgFilter::new(
                FilterKind::Mfgr,
                &FilterConfig::default(),
                Propagator::constant_velocity(1.0, 1.0),
                prior,
            );
            let outcome = filter.update_map_points(&all[..count]);
            assert_eq!(outcome.is_ok(), count > 0);
            assert!(filter.belief().is_finite());
            assert!(filter.belief().covariance.cholesky().is_some());
        }
    }
}
