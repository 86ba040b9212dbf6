//! Filters that keep map points in the state, with all correlations (`mfgs`, `mekfs`).

use nalgebra::{
    DMatrix, DVector, Dyn, Isometry3, Matrix3, OMatrix, Point3, SVector, U3, UnitQuaternion,
    Vector3,
};

use super::calibration::{BodyMotion, Calibration};
use super::gate::Gate;
use super::gravity::UnknownGravity;
use super::regression::{
    CALIBRATION_BLOCKS, Coordinates, Expansion, Measurement, Posterior, Regression, Target,
};
use super::{
    FilterConfig, MotionSpread, PointState, Rest, SeenPoint, UpdateOutcome, VisualInertialFilter,
    point_by_pose,
};
use crate::alignment::{MapEstimate, PointPair};
use crate::inertial::{Belief, NavCovariance, Propagator, block};
use crate::sensor::ImuSample;
use crate::so3::{self, ProperSvd};

/// Size of the navigation part of the state.
const NAVIGATION: usize = 15;

/// A map point of the state.
#[derive(Debug, Clone, Copy, PartialEq)]
struct StatePoint {
    id: u64,
    /// World coordinates, m.
    position: Vector3<f64>,
}

/// Visual-inertial filter whose Euclidean state is `(v, p, b_g, b_a, l_1 ... l_M)`, after `b_a` the
/// [`Calibration`] where it is estimated.
///
/// A point `l` of the state measured at `p'` in the body frame is `0 = R p' + p - l + noise`.
/// Between updates the belief is the mode and the covariance of the error around it, as in
/// [`Belief`], points in world coordinates; an update works on the regression of the Euclidean
/// part on the rotation ([`Regression`]), in one of two [`Coordinates`]. Where the calibration is part
/// of the state, an update works on points as the camera sees them, which a turn of the mounting
/// carries along: from a place that does not change nothing is measured of the calibration, however
/// pose and points are corrected.
///
/// With `n = 15 + 3 M` an update with `m` points costs `O(n^2 m)`, a propagation step `O(15^3)`:
/// what it does to the correlations with the points is gathered and done at the next update.
#[derive(Debug, Clone)]
pub struct SlamFilter {
    config: FilterConfig,
    coordinates: Coordinates,
    propagator: Propagator,
    belief: Belief,
    /// In the order of their rows.
    points: Vec<StatePoint>,
    /// Covariance of (navigation, points). Its navigation rows and columns date from the last
    /// update; [`Self::synchronize`] brings them up to date.
    covariance: DMatrix<f64>,
    /// Derivative of the navigation error now by that at the last update.
    transition: NavCovariance,
    /// Gravity as part of the state, its block following the navigation part, until its direction
    /// is known well enough for the world to be turned upright.
    gravity: Option<UnknownGravity>,
    /// The camera's calibration as part of the state, following gravity, if it is uncertain. Its
    /// covariance is that of the last update.
    calibration: Option<Calibration>,
    /// By which the present pose is timed.
    timed_by: Option<Calibration>,
    /// Angular velocity as last measured, rad/s.
    measured_rate: Vector3<f64>,
    /// Time that the IMU has carried the belief since points last corrected it, s.
    carried: f64,
    /// Whether the heading is that of an arbitrary world: uniform, and independent of all else.
    heading_is_free: bool,
    gate: Gate,
    /// For each point offered to the last update whether it passed the gate.
    passed: Vec<bool>,
    /// Turn of the world since it was last asked for.
    world_turn: Option<UnitQuaternion<f64>>,
}

impl SlamFilter {
    pub fn new(
        config: &FilterConfig,
        coordinates: Coordinates,
        propagator: Propagator,
        belief: Belief,
    ) -> Self {
        let covariance = DMatrix::from_fn(NAVIGATION, NAVIGATION, |i, j| belief.covariance[(i, j)]);
        Self {
            config: config.clone(),
            coordinates,
            propagator,
            belief,
            points: Vec::with_capacity(config.state_points),
            covariance,
            transition: NavCovariance::identity(),
            gravity: None,
            calibration: None,
            timed_by: None,
            measured_rate: Vector3::zeros(),
            carried: 0.0,
            heading_is_free: false,
            gate: Gate::new(config),
            passed: Vec::new(),
            world_turn: None,
        }
    }

    /// The same, in a world whose heading is arbitrary: its distribution is uniform.
    pub fn with_free_heading(mut self) -> Self {
        self.heading_is_free = true;
        self
    }

    /// The same, in the body's frame at the start, in which `belief` must be given: gravity of
    /// the given magnitude (m/s^2) has any direction, so that the attitude in an upright world is
    /// uniformly distributed.
    pub fn with_unknown_gravity(mut self, magnitude: f64) -> Self {
        let gravity = UnknownGravity::new(magnitude);
        self.propagator.set_gravity(gravity.mean);
        let mut covariance = DMatrix::zeros(NAVIGATION + 3, NAVIGATION + 3);
        covariance.view_mut((0, 0), (NAVIGATION, NAVIGATION)).copy_from(&self.covariance);
        covariance.fixed_view_mut::<3, 3>(NAVIGATION, NAVIGATION).copy_from(&gravity.covariance);
        self.covariance = covariance;
        self.gravity = Some(gravity);
        self.with_free_heading()
    }

    /// First row of what follows gravity.
    fn after_gravity(&self) -> usize {
        NAVIGATION + if self.gravity.is_some() { 3 } else { 0 }
    }

    /// Rows of the calibration.
    fn calibration_rows(&self) -> std::ops::Range<usize> {
        let start = self.after_gravity();
        start..start + if self.calibration.is_some() { 3 * CALIBRATION_BLOCKS } else { 0 }
    }

    /// First row of the points.
    fn base(&self) -> usize {
        self.calibration_rows().end
    }

    fn motion(&self) -> BodyMotion {
        let state = &self.belief.state;
        BodyMotion {
            angular_velocity: self.measured_rate - state.gyro_bias,
            velocity: state.world_from_body.rotation.inverse() * state.velocity,
        }
    }

    /// Derivative of a point of the world as measured in the body by the blocks of the
    /// calibration.
    fn by_calibration(&self, point: &Vector3<f64>) -> Option<[Matrix3<f64>; CALIBRATION_BLOCKS]> {
        let pose = &self.belief.state.world_from_body;
        let in_body = pose.inverse_transform_point(&Point3::from(*point)).coords;
        Some(self.calibration.as_ref()?.derivatives(&in_body, &self.motion()))
    }

    /// The covariance with points as the camera sees them in place of points of the world
    /// (`sign` -1), or back (1): they differ by what the calibration moves them.
    fn with_camera(&self, mut covariance: DMatrix<f64>, sign: f64) -> DMatrix<f64> {
        let rotation = self.belief.state.world_from_body.rotation.to_rotation_matrix();
        let calibration = self.calibration_rows();
        for (slot, point) in self.points.iter().enumerate() {
            let (row, Some(by_calibration)) =
                (self.row(slot), self.by_calibration(&point.position))
            else {
                continue;
            };
            for (from, by_block) in calibration.clone().step_by(3).zip(by_calibration) {
                let by_block = rotation * by_block * sign;
                let moved = by_block * covariance.fixed_rows::<3>(from);
                let mut rows = covariance.fixed_rows_mut::<3>(row);
                rows += moved;
                let moved = covariance.fixed_columns::<3>(from) * by_block.transpose();
                let mut columns = covariance.fixed_columns_mut::<3>(row);
                columns += moved;
            }
        }
        covariance
    }

    /// A point measured in the body, where it is by what is known of the clock since the pose was
    /// timed.
    fn retimed(&self, in_body: &Vector3<f64>) -> Vector3<f64> {
        let calibrations = self.calibration.as_ref().zip(self.timed_by.as_ref());
        calibrations.map_or(*in_body, |(now, then)| {
            let timed = Calibration { time_offset: then.time_offset, ..*now };
            now.reread(&timed, in_body, &self.motion())
        })
    }

    fn synchronize(&mut self) {
        let n = self.covariance.ncols() - NAVIGATION;
        let mut cross = self.transition * self.covariance.view((0, NAVIGATION), (NAVIGATION, n));
        if let Some(gravity) = &mut self.gravity {
            cross += gravity.transition * self.covariance.view((NAVIGATION, NAVIGATION), (3, n));
            gravity.transition.fill(0.0);
        }
        self.covariance.view_mut((0, NAVIGATION), (NAVIGATION, n)).copy_from(&cross);
        self.covariance.view_mut((NAVIGATION, 0), (n, NAVIGATION)).copy_from(&cross.transpose());
        self.covariance
            .view_mut((0, 0), (NAVIGATION, NAVIGATION))
            .copy_from(&self.belief.covariance);
        self.transition = NavCovariance::identity();
    }

    fn slot(&self, id: u64) -> Option<usize> {
        self.points.iter().position(|point| point.id == id)
    }

    /// Mean of the Euclidean part in the order of the covariance's rows after the rotation.
    fn euclidean(&self) -> Vec<Vector3<f64>> {
        let state = &self.belief.state;
        let mut blocks = vec![Vector3::zeros(); NAVIGATION / 3 - 1];
        blocks[block::VELOCITY / 3 - 1] = state.velocity;
        blocks[block::POSITION / 3 - 1] = state.world_from_body.translation.vector;
        blocks[block::GYRO_BIAS / 3 - 1] = state.gyro_bias;
        blocks[block::ACCEL_BIAS / 3 - 1] = state.accel_bias;
        blocks.extend(self.gravity.as_ref().map(|gravity| gravity.mean));
        blocks.extend(self.calibration.iter().flat_map(Calibration::blocks));
        blocks.extend(self.points.iter().map(|point| point.position));
        blocks
    }

    /// Conditions the belief on points. A prediction that they contradict is the IMU's fault: it
    /// is made as uncertain as it takes, unless they are so few that they may be wrong themselves.
    /// What is reported is how far off it was.
    fn condition(&mut self, measurements: &[Measurement]) -> Option<UpdateOutcome> {
        if measurements.is_empty() {
            return None;
        }
        self.synchronize();
        let first = self.conditioned(measurements)?;
        let (innovation, certain) = (first.outcome.innovation, self.belief.covariance);
        let distrust = self.propagator.distrust(self.carried);
        let few = first.outcome.points < FEW_POINTS;
        let mut latest = first;
        for variance in if few { &[1.0][..] } else { &[1.0, 16.0, 256.0] } {
            let Some(distrust) = distrust.filter(|_| latest.contradicts()) else { break };
            self.belief.covariance = certain + distrust * *variance;
            self.synchronize();
            let Some(widened) = self.conditioned(measurements) else { break };
            latest = widened;
        }
        let astray = latest.turns_too_far || few && latest.contradicts();
        let Conditioned { posterior, outcome, .. } = latest;
        if astray || self.accept(posterior).is_none() {
            self.belief.covariance = certain;
            self.synchronize();
            return None;
        }
        self.carried = 0.0;
        self.settle_gravity();
        Some(UpdateOutcome { innovation, ..outcome })
    }

    /// What the belief becomes by points, the covariance being up to date.
    fn conditioned(&mut self, measurements: &[Measurement]) -> Option<Conditioned> {
        let prior = self.belief.state.world_from_body.rotation.to_rotation_matrix();
        let means = self.euclidean();
        let calibration = self.calibration.map(|_| self.after_gravity() / 3 - 1);
        let seen = calibration.map(|_| self.with_camera(self.covariance.clone(), -1.0));
        let covariance = seen.as_ref().unwrap_or(&self.covariance);
        let of_prior =
            || Regression::of_prior(self.coordinates, &prior, &means, calibration, covariance);
        let mut regression = of_prior()?;
        let screening = self.gate.judge(regression.squared_distances(measurements)?.into_iter());
        let passed = measurements.iter().zip(self.gate.passed()).filter(|(_, passed)| **passed);
        let accepted: Vec<_> = passed.map(|(measurement, _)| *measurement).collect();
        let mut expansion = Expansion::of_prior(&prior, means.len());
        let mut renewals = self.config.relinearizations;
        let mut first = None;
        let posterior = loop {
            let found = regression.condition(&accepted, &expansion, self.config.huber)?;
            first.get_or_insert(found);
            let posterior = regression.posterior()?;
            let turned = so3::angle_between(&expansion.mode, &posterior.expansion.mode);
            if turned < RELINEARIZE_ABOVE || renewals == 0 {
                break posterior;
            }
            renewals -= 1;
            expansion = posterior.expansion;
            regression = of_prior()?;
        };
        let innovation = first?;
        let turn = so3::log(&(prior.inverse() * posterior.expansion.mode));
        let explained = 3.0 * accepted.len() as f64 * innovation;
        let turns_too_far = self.turn_distance(&turn)? > MOST_TURN * explained.max(NOISE_TURN);
        let outcome = UpdateOutcome { innovation, points: accepted.len(), screening };
        Some(Conditioned { posterior, outcome, turns_too_far })
    }

    /// Squared Mahalanobis distance of a turn of the body from the belief.
    fn turn_distance(&self, turn: &Vector3<f64>) -> Option<f64> {
        let covariance = self.covariance.fixed_view::<3, 3>(block::ROTATION, block::ROTATION);
        Some(turn.dot(&covariance.cholesky()?.solve(turn)))
    }

    fn accept(&mut self, posterior: Posterior) -> Option<()> {
        let Posterior { means, covariance, expansion: Expansion { mode, .. } } = posterior;
        let mean = |start: usize| means.get(start / 3 - 1).copied();
        let mut belief = self.belief;
        let state = &mut belief.state;
        state.world_from_body.rotation = UnitQuaternion::from_rotation_matrix(&mode);
        state.world_from_body.translation.vector = mean(block::POSITION)?;
        state.velocity = mean(block::VELOCITY)?;
        state.gyro_bias = mean(block::GYRO_BIAS)?;
        state.accel_bias = mean(block::ACCEL_BIAS)?;
        belief.covariance = covariance.fixed_view::<NAVIGATION, NAVIGATION>(0, 0).into_owned();
        let finite = |sound: bool, x: &f64| sound & x.is_finite();
        let sound = means.iter().flatten().fold(belief.is_finite(), finite);
        if !covariance.iter().fold(sound, finite) {
            return None;
        }
        let (motion, before) = (self.motion(), self.calibration);
        self.belief = belief;
        if let (Some(gravity), Some(mean)) = (&mut self.gravity, means.get(NAVIGATION / 3 - 1)) {
            gravity.mean = *mean;
            gravity.follow(&covariance);
            self.propagator.set_gravity(*mean);
        }
        let rows = self.calibration_rows();
        if let (Some(calibration), Some([turn, translation, offset])) =
            (&mut self.calibration, means.get(rows.start / 3 - 1..rows.end / 3 - 1))
        {
            *calibration = calibration.moved([*turn, *translation, *offset]);
            calibration.covariance =
                covariance.fixed_view::<7, 7>(rows.start, rows.start).into_owned();
        }
        let (pose, base) = (belief.state.world_from_body, self.base() / 3 - 1);
        for (point, position) in self.points.iter_mut().zip(means.iter().skip(base)) {
            point.position = *position;
            if let Some((now, before)) = self.calibration.as_ref().zip(before.as_ref()) {
                let in_body = pose.inverse_transform_point(&Point3::from(*position)).coords;
                let reread = now.reread(before, &in_body, &motion);
                point.position = (pose * Point3::from(reread)).coords;
            }
        }
        self.covariance = self.with_camera(covariance, 1.0);
        Some(())
    }

    /// Adds a point whose covariance with the state is `rows`. False, and no change, if it is not
    /// finite.
    fn append(
        &mut self,
        id: u64,
        position: Vector3<f64>,
        rows: &OMatrix<f64, U3, Dyn>,
        own: &Matrix3<f64>,
    ) -> bool {
        let finite = position.iter().chain(rows.iter()).chain(own.iter()).all(|x| x.is_finite());
        if !finite {
            return false;
        }
        let n = self.covariance.ncols();
        let mut covariance = std::mem::take(&mut self.covariance).resize(n + 3, n + 3, 0.0);
        covariance.view_mut((n, 0), (3, n)).copy_from(rows);
        covariance.view_mut((0, n), (n, 3)).copy_from(&rows.transpose());
        covariance.view_mut((n, n), (3, 3)).copy_from(&((own + own.transpose()) * 0.5));
        self.covariance = covariance;
        self.points.push(StatePoint { id, position });
        true
    }

    /// Row of a point's block in the covariance.
    fn row(&self, slot: usize) -> usize {
        self.base() + 3 * slot
    }
}

impl SlamFilter {
    /// Turns the world so that the mean of gravity points down; once its direction is known well,
    /// what is uncertain of it becomes uncertainty of the attitude, and gravity leaves the state.
    fn settle_gravity(&mut self) {
        let Some(turn) = self.gravity.as_ref().and_then(UnknownGravity::levelling_turn) else {
            return;
        };
        self.turn_world(&turn);
        if self.gravity.as_ref().is_some_and(UnknownGravity::is_settled) {
            self.use_magnitude_of_gravity();
            self.fix_gravity();
        }
    }

    /// Turns everything in world coordinates; the covariance is up to date.
    fn turn_world(&mut self, turn: &UnitQuaternion<f64>) {
        let matrix = turn.to_rotation_matrix().into_inner();
        let calibration = self.calibration_rows();
        let world_blocks = [block::VELOCITY, block::POSITION]
            .into_iter()
            .chain((NAVIGATION..self.covariance.ncols()).step_by(3))
            .filter(|row| !calibration.contains(row));
        for row in world_blocks {
            let rows = matrix * self.covariance.rows(row, 3);
            self.covariance.rows_mut(row, 3).copy_from(&rows);
            let columns = self.covariance.columns(row, 3) * matrix.transpose();
            self.covariance.columns_mut(row, 3).copy_from(&columns);
        }
        let state = &mut self.belief.state;
        state.world_from_body = turn * state.world_from_body;
        state.velocity = turn * state.velocity;
        for point in &mut self.points {
            point.position = turn * point.position;
        }
        if let Some(gravity) = &mut self.gravity {
            gravity.mean = turn * gravity.mean;
            gravity.follow(&self.covariance);
            self.propagator.set_gravity(gravity.mean);
        }
        self.belief.covariance =
            self.covariance.fixed_view::<NAVIGATION, NAVIGATION>(0, 0).into_owned();
        self.world_turn = Some(turn * self.world_turn.unwrap_or_default());
    }

    /// Conditions the state on the magnitude of gravity, to first order.
    fn use_magnitude_of_gravity(&mut self) {
        let Some(gravity) = &self.gravity else { return };
        let Some((error, direction)) = gravity.magnitude_error() else { return };
        let by_magnitude = self.covariance.columns(NAVIGATION, 3) * direction;
        let variance = direction.dot(&by_magnitude.fixed_rows::<3>(NAVIGATION))
            + gravity.magnitude_sd().powi(2);
        self.covariance.ger(-1.0 / variance, &by_magnitude, &by_magnitude, 1.0);
        self.shift(&(by_magnitude * (error / variance)));
    }

    /// Moves the means of navigation part, points and calibration by a change of the whole state;
    /// the covariance is that after it.
    fn shift(&mut self, change: &DVector<f64>) {
        let part = |start: usize| change.fixed_rows::<3>(start).into_owned();
        let covariance = std::mem::take(&mut self.covariance);
        let covariance = self.with_camera(covariance, -1.0);
        let navigation = change.fixed_rows::<NAVIGATION>(0).into_owned();
        self.belief.state = self.belief.state.corrected_by(&navigation);
        let base = self.base();
        for (slot, point) in self.points.iter_mut().enumerate() {
            point.position += part(base + 3 * slot);
        }
        let row = self.calibration_rows().start;
        if let Some(calibration) = &mut self.calibration {
            let blocks = calibration.blocks();
            let moved = std::array::from_fn(|k| blocks[k] + part(row + 3 * k));
            *calibration = calibration.moved(moved);
            calibration.covariance = covariance.fixed_view::<7, 7>(row, row).into_owned();
        }
        self.covariance = self.with_camera(covariance, 1.0);
    }

    /// The Kalman filter's update, to first order in the rotation.
    fn condition_on_rest(&mut self, rest: &Rest) -> Option<()> {
        self.synchronize();
        let (residual, by_state, noise) = rest.linearized(&self.belief.state);
        let by_measurement = self.covariance.columns(0, NAVIGATION) * by_state.transpose();
        let spread = by_state * by_measurement.fixed_rows::<NAVIGATION>(0) + noise;
        let factor = spread.cholesky()?;
        let whitened = by_measurement * factor.l().try_inverse()?.transpose();
        let change = &whitened * factor.l().solve_lower_triangular(&residual)?;
        if !change.iter().chain(whitened.iter()).all(|x| x.is_finite()) {
            return None;
        }
        self.covariance.gemm(-1.0, &whitened, &whitened.transpose(), 1.0);
        self.belief.covariance =
            self.covariance.fixed_view::<NAVIGATION, NAVIGATION>(0, 0).into_owned();
        self.shift(&change);
        if let Some(gravity) = &mut self.gravity {
            gravity.mean += change.fixed_rows::<3>(NAVIGATION);
            gravity.follow(&self.covariance);
            self.propagator.set_gravity(gravity.mean);
        }
        self.settle_gravity();
        Some(())
    }

    /// Gravity becomes `(0, 0, -g)`, and its error a turn of everything in the world.
    fn fix_gravity(&mut self) {
        let Some(gravity) = self.gravity.take() else { return };
        let n = self.covariance.ncols();
        let mut by_old = DMatrix::zeros(n - 3, n);
        for k in 0..n - 3 {
            by_old[(k, if k < NAVIGATION { k } else { k + 3 })] = 1.0;
        }
        let state = &self.belief.state;
        let mut set = |row: usize, value: Matrix3<f64>| {
            by_old.fixed_view_mut::<3, 3>(row, NAVIGATION).copy_from(&value);
        };
        let position = &state.world_from_body.translation.vector;
        set(block::ROTATION, gravity.rotation_by_gravity(&state.world_from_body.rotation));
        set(block::VELOCITY, gravity.vector_by_gravity(&state.velocity));
        set(block::POSITION, gravity.vector_by_gravity(position));
        let base = self.base();
        for (slot, point) in self.points.iter().enumerate() {
            set(base + 3 * slot, gravity.vector_by_gravity(&point.position));
        }
        self.covariance = &by_old * &self.covariance * by_old.transpose();
        self.belief.covariance =
            self.covariance.fixed_view::<NAVIGATION, NAVIGATION>(0, 0).into_owned();
        self.propagator.set_gravity(gravity.upright());
    }

    /// Inverse of the mean variance of roll and pitch, 1/rad^2.
    fn tilt_concentration(&self) -> f64 {
        let rotation = self.belief.state.world_from_body.rotation.to_rotation_matrix();
        let covariance =
            self.belief.covariance.fixed_view::<3, 3>(block::ROTATION, block::ROTATION);
        let in_world = rotation.matrix() * covariance * rotation.matrix().transpose();
        2.0 / (in_world.m11 + in_world.m22)
    }

    /// The matrix Fisher parameter of rank one of a von Mises-Fisher distributed vertical and a
    /// uniform heading: `kappa e_z (R^T e_z)^T`.
    fn of_vertical(&self, kappa: f64) -> Option<ProperSvd> {
        let rotation = self.belief.state.world_from_body.rotation.to_rotation_matrix();
        let up = Vector3::z() * Vector3::z().transpose() * rotation.matrix();
        so3::proper_svd(&(up * kappa)).ok()
    }
}

/// Fewer points than this may all be mismatched.
const FEW_POINTS: usize = 8;

/// What an update would make of the belief.
struct Conditioned {
    posterior: Posterior,
    outcome: UpdateOutcome,
    /// Whether it would turn the body much further than its innovations allow.
    turns_too_far: bool,
}

impl Conditioned {
    /// Whether it is the prediction that is wrong: a few points may be wrong themselves.
    fn contradicts(&self) -> bool {
        const MANY_POINTS: usize = 30;
        self.outcome.contradicts() || self.turns_too_far && self.outcome.points >= MANY_POINTS
    }
}

/// An attitude that moved further than this in an update is found anew with the terms of second
/// order, and the weights, of where it came to, rad.
const RELINEARIZE_ABOVE: f64 = 0.02;
/// In a linear system an update turns the body by a squared Mahalanobis distance of at most that
/// of the innovations. Beyond so many times that, the concentrated form has found the density's
/// mode where it does not hold, and wrong matches have led it there.
const MOST_TURN: f64 = 4.0;
/// Innovations smaller than this are taken for as much: the 99.9 % quantile of chi-square with
/// three degrees of freedom.
const NOISE_TURN: f64 = 16.3;

impl VisualInertialFilter for SlamFilter {
    fn belief(&self) -> &Belief {
        &self.belief
    }

    fn propagate(&mut self, from: &ImuSample, to: &ImuSample) -> bool {
        let step = self.propagator.propagate_with_transition(&mut self.belief, from, to);
        if let Some(step) = step {
            self.measured_rate = to.angular_velocity;
            self.timed_by = self.calibration;
            self.carried += to.stamp.seconds_since(from.stamp).max(0.0);
            self.transition = step * self.transition;
            if let Some(gravity) = &mut self.gravity {
                gravity.propagate(&mut self.belief, &step, to.stamp.seconds_since(from.stamp));
            }
        }
        step.is_some()
    }

    fn set_imu_gap(&mut self, in_gap: bool) {
        self.propagator.set_imu_gap(in_gap);
    }

    fn coast(&mut self, seconds: f64) {
        self.transition = self.propagator.coast(&mut self.belief, seconds) * self.transition;
    }

    fn update(&mut self, pairs: &[PointPair]) -> Option<UpdateOutcome> {
        let measurements: Vec<_> = pairs
            .iter()
            .map(|pair| {
                let (position, covariance) = (pair.in_world, pair.world_covariance);
                Measurement {
                    in_body: self.retimed(&pair.in_body),
                    body_covariance: pair.body_covariance,
                    target: Target::Known { position, covariance },
                }
            })
            .collect();
        let outcome = self.condition(&measurements)?;
        self.passed = self.gate.passed().to_vec();
        Some(outcome)
    }

    fn rest(&mut self, rest: &Rest) -> bool {
        self.condition_on_rest(rest).is_some()
    }

    /// Gravity enters the state with an error that the accelerometer's bias makes up for.
    fn doubt_levelling(&mut self, accel_bias_sd: f64) -> bool {
        let mean = *self.propagator.gravity();
        let doubtful = self.coordinates == Coordinates::Group && self.gravity.is_none();
        if !doubtful || mean.norm() == 0.0 {
            return false;
        }
        self.synchronize();
        let variance = accel_bias_sd.powi(2);
        let rotation = self.belief.state.world_from_body.rotation.to_rotation_matrix();
        let covariance = std::mem::take(&mut self.covariance);
        let mut covariance =
            covariance.insert_rows(NAVIGATION, 3, 0.0).insert_columns(NAVIGATION, 3, 0.0);
        let mut add = |row: usize, column: usize, value: Matrix3<f64>| {
            let mut part = covariance.fixed_view_mut::<3, 3>(row, column);
            part += value * variance;
        };
        add(NAVIGATION, NAVIGATION, Matrix3::identity());
        add(block::ACCEL_BIAS, block::ACCEL_BIAS, Matrix3::identity());
        add(NAVIGATION, block::ACCEL_BIAS, *rotation.matrix());
        add(block::ACCEL_BIAS, NAVIGATION, rotation.matrix().transpose());
        self.belief.covariance = covariance.fixed_view::<NAVIGATION, NAVIGATION>(0, 0).into_owned();
        self.gravity = Some(UnknownGravity::around(mean, &covariance));
        self.covariance = covariance;
        true
    }

    fn passed(&self) -> &[bool] {
        &self.passed
    }

    fn matrix_fisher(&self) -> Option<ProperSvd> {
        match (self.coordinates, &self.gravity) {
            (Coordinates::Additive, _) => None,
            (Coordinates::Group, Some(gravity)) if self.heading_is_free => {
                self.of_vertical(gravity.concentration())
            }
            (Coordinates::Group, None) if self.heading_is_free => {
                self.of_vertical(self.tilt_concentration())
            }
            (Coordinates::Group, _) => {
                let covariance = self.reported_covariance();
                let upright = Belief { covariance, ..self.belief };
                upright.attitude().map(|attitude| *attitude.svd())
            }
        }
    }

    fn reported_covariance(&self) -> NavCovariance {
        match &self.gravity {
            Some(gravity) => gravity.upright_covariance(&self.belief),
            None => self.belief.covariance,
        }
    }

    fn knows_vertical(&self) -> bool {
        self.gravity.is_none()
    }

    fn take_world_turn(&mut self) -> Option<UnitQuaternion<f64>> {
        self.world_turn.take()
    }

    fn point_state(&mut self) -> Option<&mut dyn PointState> {
        Some(self)
    }

    fn calibrate(&mut self, prior: &Calibration) -> bool {
        if self.calibration.is_some() {
            return false;
        }
        self.synchronize();
        let row = self.after_gravity();
        let covariance = std::mem::take(&mut self.covariance);
        let mut covariance = covariance
            .insert_rows(row, 3 * CALIBRATION_BLOCKS, 0.0)
            .insert_columns(row, 3 * CALIBRATION_BLOCKS, 0.0);
        covariance.fixed_view_mut::<7, 7>(row, row).copy_from(&prior.covariance);
        self.covariance = covariance;
        self.calibration = Some(*prior);
        true
    }

    fn calibration(&self) -> Option<&Calibration> {
        self.calibration.as_ref()
    }
}

impl PointState for SlamFilter {
    fn free_slots(&self) -> usize {
        self.config.state_points.saturating_sub(self.points.len())
    }

    fn ids(&self) -> Vec<u64> {
        self.points.iter().map(|point| point.id).collect()
    }

    fn estimate(&self, id: u64) -> Option<MapEstimate> {
        let slot = self.slot(id)?;
        let row = self.row(slot);
        Some(MapEstimate {
            position: self.points[slot].position,
            covariance: self.covariance.fixed_view::<3, 3>(row, row).into_owned(),
        })
    }

    fn measure(&mut self, seen: &[SeenPoint]) -> Option<UpdateOutcome> {
        let measurement = |point: &SeenPoint| {
            let slot = self.slot(point.id)?;
            Some(Measurement {
                in_body: self.retimed(&point.in_body),
                body_covariance: point.body_covariance,
                target: Target::State { block: self.base() / 3 - 1 + slot },
            })
        };
        let measurements: Vec<_> = seen.iter().filter_map(measurement).collect();
        let outcome = self.condition(&measurements)?;
        let mut judged = self.gate.passed().iter();
        let passes =
            |point: &SeenPoint| self.slot(point.id).is_none() || judged.next() == Some(&true);
        self.passed = seen.iter().map(passes).collect();
        Some(outcome)
    }

    /// The point's error is exactly that of the pose, moved to the point, that of the calibration
    /// and that of the measurement.
    fn admit(&mut self, point: &SeenPoint) -> bool {
        if self.free_slots() == 0 || self.slot(point.id).is_some() {
            return false;
        }
        self.synchronize();
        let pose = self.belief.state.world_from_body;
        let rotation = pose.rotation.to_rotation_matrix();
        let in_body = self.retimed(&point.in_body);
        let j = point_by_pose(rotation.matrix(), &in_body);
        let (by_rotation, by_position) = (j.fixed_columns::<3>(0), j.fixed_columns::<3>(3));
        let n = self.covariance.ncols();
        let position = rotation * in_body + pose.translation.vector;
        let calibration = self.by_calibration(&position).into_iter().flatten();
        let terms: Vec<(usize, Matrix3<f64>)> = [
            (block::ROTATION, by_rotation.into_owned()),
            (block::POSITION, by_position.into_owned()),
        ]
        .into_iter()
        .chain((self.after_gravity()..).step_by(3).zip(calibration.map(|by| rotation * by)))
        .collect();
        let mut rows = OMatrix::<f64, U3, Dyn>::zeros(n);
        for (row, by_block) in &terms {
            rows += by_block * self.covariance.fixed_rows::<3>(*row);
        }
        let mut own = rotation.matrix() * point.body_covariance * rotation.matrix().transpose();
        for (row, by_block) in &terms {
            own += rows.fixed_view::<3, 3>(0, *row) * by_block.transpose();
        }
        self.append(point.id, position, &rows, &own)
    }

    fn admit_known(&mut self, id: u64, estimate: &MapEstimate) -> bool {
        if self.free_slots() == 0 || self.slot(id).is_some() {
            return false;
        }
        let independent = OMatrix::<f64, U3, Dyn>::zeros(self.covariance.ncols());
        self.append(id, estimate.position, &independent, &estimate.covariance)
    }

    fn release(&mut self, id: u64) -> bool {
        let Some(slot) = self.slot(id) else { return false };
        let row = self.row(slot);
        self.points.remove(slot);
        let covariance = std::mem::take(&mut self.covariance);
        self.covariance = covariance.remove_fixed_rows::<3>(row).remove_fixed_columns::<3>(row);
        true
    }

    fn blur_time(&mut self, sd: f64) {
        let mut moves = SVector::<f64, NAVIGATION>::zeros();
        moves.fixed_rows_mut::<3>(block::ROTATION).copy_from(&self.motion().angular_velocity);
        moves.fixed_rows_mut::<3>(block::POSITION).copy_from(&self.belief.state.velocity);
        self.belief.covariance += moves * moves.transpose() * sd.powi(2);
    }

    fn carry_off(&mut self, way: &Isometry3<f64>, spread: &MotionSpread) {
        let rotation = self.belief.state.world_from_body.rotation.to_rotation_matrix();
        let mut step = NavCovariance::identity();
        let mut set = |row: usize, column: usize, value: Matrix3<f64>| {
            step.fixed_view_mut::<3, 3>(row, column).copy_from(&value);
        };
        let turned = way.rotation.to_rotation_matrix().into_inner().transpose();
        let lever = way.translation.vector.cross_matrix();
        set(block::ROTATION, block::ROTATION, turned);
        set(block::POSITION, block::ROTATION, -(rotation * lever));
        set(block::VELOCITY, block::VELOCITY, Matrix3::zeros());
        self.transition = step * self.transition;
        let covariance = &mut self.belief.covariance;
        *covariance = step * *covariance * step.transpose();
        for (row, sd) in [
            (block::ROTATION, spread.turn),
            (block::POSITION, spread.shift),
            (block::VELOCITY, spread.velocity),
        ] {
            (row..row + 3).for_each(|k| covariance[(k, k)] += sd * sd);
        }
        self.belief.state.world_from_body *= way;
        self.belief.state.velocity = Vector3::zeros();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::filter::FilterKind;
    use crate::inertial::{ImuConfig, NavState, attitude_from_gravity};
    use crate::sensor::Stamp;
    use approx::assert_relative_eq;
    use nalgebra::Translation3;
    use proptest::prelude::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    fn vector(rng: &mut ChaCha8Rng, scale: f64) -> Vector3<f64> {
        Vector3::from_fn(|_, _| rng.random_range(-scale..scale))
    }

    fn normal(rng: &mut ChaCha8Rng) -> Vector3<f64> {
        Vector3::from_fn(|_, _| StandardNormal.sample(rng))
    }

    /// A belief with every correlation present and a rotation spread of about `spread` rad.
    fn belief(rng: &mut ChaCha8Rng, spread: f64) -> Belief {
        let root = NavCovariance::from_fn(|i, _| {
            (if i < 3 { spread } else { 0.1 }) * rng.random_range(-0.5..0.5)
        });
        let mut covariance = root * root.transpose();
        for k in 0..15 {
            covariance[(k, k)] += if k < 3 { 0.1 * spread * spread } else { 0.01 };
        }
        let state = NavState {
            world_from_body: Isometry3::new(vector(rng, 3.0), vector(rng, 1.5)),
            velocity: vector(rng, 1.0),
            gyro_bias: vector(rng, 0.1),
            accel_bias: vector(rng, 0.1),
        };
        Belief { state, covariance }
    }

    fn filter(kind: FilterKind, belief: Belief) -> Box<dyn VisualInertialFilter> {
        let config = FilterConfig { huber: 0.0, ..FilterConfig::default() };
        kind.start(&config, Propagator::inertial(&ImuConfig::default()), belief)
    }

    /// A calibration that is uncertain in all its parts.
    fn uncertain_calibration() -> Calibration {
        let config = FilterConfig {
            camera_rotation_sd_deg: 1.0,
            camera_translation_sd: 0.02,
            camera_time_offset_sd: 0.01,
            ..FilterConfig::default()
        };
        let mounting = Isometry3::new(Vector3::new(0.1, 0.0, -0.05), Vector3::new(0.3, -1.2, 0.4));
        Calibration::prior(&config, &mounting, 0.0).unwrap()
    }

    fn seen(id: u64, in_body: Vector3<f64>, body_covariance: Matrix3<f64>) -> SeenPoint {
        SeenPoint { id, in_body, body_covariance }
    }

    /// Admits 20 points and measures them 30 times from where they were first seen, with noise
    /// of the given standard deviations along random axes of each measurement.
    fn measure_without_moving(
        filter: &mut dyn VisualInertialFilter,
        deviations: &Vector3<f64>,
        rng: &mut ChaCha8Rng,
    ) {
        let exact: Vec<_> = (0..20).map(|_| vector(rng, 3.0)).collect();
        for round in 0..=30 {
            let points: Vec<_> = exact
                .iter()
                .enumerate()
                .map(|(id, in_body)| {
                    let axes = UnitQuaternion::new(vector(rng, 2.0)).to_rotation_matrix();
                    let noise = axes * normal(rng).component_mul(deviations);
                    let variances = deviations.component_mul(deviations);
                    let covariance = axes.matrix()
                        * Matrix3::from_diagonal(&variances)
                        * axes.matrix().transpose();
                    seen(id as u64, in_body + noise, covariance)
                })
                .collect();
            let state = filter.point_state().unwrap();
            if round == 0 {
                assert!(points.iter().all(|point| state.admit(point)));
            } else {
                assert!(state.measure(&points).is_some());
            }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(8))]

        /// What turns and moves body and map together cannot be observed, so that the attitude
        /// and the position keep their covariance, whatever the spread and the noise.
        #[test]
        fn measuring_again_without_motion_tells_nothing_of_the_pose(
            seed: u64, spread in 0.01..0.3f64, anisotropy in 1.0..10.0f64, calibrates: bool,
        ) {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let prior = belief(&mut rng, spread);
            let mut mfgs = filter(FilterKind::Mfgs, prior);
            if calibrates {
                assert!(mfgs.calibrate(&uncertain_calibration()));
            }
            let deviations = Vector3::new(0.02, 0.02, 0.02 * anisotropy);
            measure_without_moving(mfgs.as_mut(), &deviations, &mut rng);
            let (before, after) = (prior.covariance, mfgs.belief().covariance);
            let change = (after - before).norm() / before.norm();
            prop_assert!(change < 1e-9, "{change}");
            let turned = mfgs.belief().state.world_from_body.rotation;
            let turned = turned.angle_to(&prior.state.world_from_body.rotation);
            prop_assert!(turned < 1e-7, "{turned}");
        }
    }

    /// A turn about the vertical at an uncertain time: by finite differences.
    #[test]
    fn a_blurred_time_moves_the_body_along() {
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        let prior = belief(&mut rng, 0.02);
        let mut mfgs = filter(FilterKind::Mfgs, prior);
        let sample = |nanos| ImuSample {
            stamp: Stamp::from_nanos(nanos),
            angular_velocity: Vector3::new(0.4, -0.2, 0.7),
            specific_force: Vector3::zeros(),
        };
        assert!(mfgs.propagate(&sample(0), &sample(1000)));
        let before = *mfgs.belief();
        mfgs.point_state().unwrap().blur_time(0.002);
        let added = mfgs.belief().covariance - before.covariance;
        assert!(mfgs.propagate(&sample(0), &sample(1_000_000)));
        let (from, to) = (before.state.world_from_body, mfgs.belief().state.world_from_body);
        let turn = from.rotation.rotation_to(&to.rotation);
        let turn = (from.rotation.inverse() * turn * from.rotation).scaled_axis() * 2.0;
        let shift = (to.translation.vector - from.translation.vector) * 2.0;
        let expected = turn * turn.transpose();
        assert_relative_eq!(
            added.fixed_view::<3, 3>(0, 0).into_owned(),
            expected,
            max_relative = 0.01
        );
        let expected = turn * shift.transpose();
        let cross = added.fixed_view::<3, 3>(block::ROTATION, block::POSITION).into_owned();
        assert_relative_eq!(cross, expected, epsilon = 0.02 * expected.norm());
    }

    /// By its map a body that was carried off is found again, as unsure of the world as the map is.
    #[test]
    fn a_body_that_is_carried_off_is_found_by_its_map() {
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let prior = belief(&mut rng, 0.02);
        let mut mfgs = filter(FilterKind::Mfgs, prior);
        let start = prior.state.world_from_body;
        let way = Isometry3::new(Vector3::new(0.5, -0.3, 0.1), Vector3::new(0.1, 0.4, -0.2));
        let elsewhere = start * way;
        let noise = Matrix3::identity() * 1e-4;
        let places: Vec<_> = (0..20).map(|_| vector(&mut rng, 3.0)).collect();
        let state = mfgs.point_state().unwrap();
        assert!((0..).zip(&places).all(|(id, place)| state.admit(&seen(id, *place, noise))));
        // The matches were a degree and some centimetres off.
        let found = way * Isometry3::new(Vector3::repeat(0.03), Vector3::repeat(0.01));
        state.carry_off(&found, &MotionSpread { turn: 0.2, shift: 0.5, velocity: 1.0 });
        let again: Vec<_> = (0..)
            .zip(&places)
            .map(|(id, place)| {
                seen(id, way.inverse_transform_point(&(*place).into()).coords, noise)
            })
            .collect();
        let outcome = state.measure(&again).unwrap();
        assert!(outcome.points == 20 && outcome.innovation < 1.0, "{outcome:?}");
        let after = mfgs.belief();
        let pose = after.state.world_from_body;
        let shift = pose.inv_mul(&elsewhere).translation.vector.norm();
        assert!(shift < 1e-3, "{shift} m");
        assert!(pose.rotation.angle_to(&elsewhere.rotation) < 1e-3);
        // Of a standard deviation of 0.1; it is correlated with the pose, hence with the map.
        assert_relative_eq!(after.state.accel_bias, prior.state.accel_bias, epsilon = 1e-5);
        let in_world = |belief: &Belief| {
            let rotation = belief.state.world_from_body.rotation.to_rotation_matrix();
            let covariance = belief.covariance.fixed_view::<3, 3>(0, 0);
            rotation.matrix() * covariance * rotation.matrix().transpose()
        };
        let known = in_world(&prior);
        assert_relative_eq!(in_world(after), known, epsilon = 0.02 * known.norm());
    }

    /// The body rests for a second, levelled by an accelerometer with a bias of ten times its
    /// standard deviation, and then swings about two axes, which tells gravity from the bias.
    #[test]
    fn a_doubted_levelling_stays_uncertain_until_the_body_turns() {
        let run = |doubts: bool| {
            let mut rng = ChaCha8Rng::seed_from_u64(29);
            let gravity = ImuConfig::default().gravity;
            let bias = Vector3::new(1.0, -1.0, 1.0);
            let axis = |t: f64| if t < 2.0 { Vector3::y() } else { Vector3::z() };
            let phase = |t: f64| std::f64::consts::TAU * (t - 1.0).max(0.0);
            let turn = |t: f64| UnitQuaternion::new(axis(t) * (0.4 - 0.4 * phase(t).cos()));
            let start = UnitQuaternion::new(Vector3::new(0.3, -0.8, 0.2));
            let up = |t: f64| (start * turn(t)).inverse() * Vector3::z();
            let sample = |t: f64| ImuSample {
                stamp: Stamp::default().offset_by(t),
                angular_velocity: axis(t) * (0.4 * std::f64::consts::TAU * phase(t).sin()),
                specific_force: up(t) * gravity + bias,
            };
            let levelled = attitude_from_gravity(&sample(0.0).specific_force).unwrap();
            let state = NavState {
                world_from_body: Isometry3::from_parts(Translation3::identity(), levelled),
                velocity: Vector3::zeros(),
                gyro_bias: Vector3::zeros(),
                accel_bias: Vector3::zeros(),
            };
            let mut covariance = NavCovariance::identity() * 1e-4;
            covariance.fixed_view_mut::<3, 3>(0, 0).fill_diagonal(0.087f64.powi(2));
            covariance.fixed_view_mut::<3, 3>(12, 12).fill_diagonal(0.01);
            let mut mfgs = filter(FilterKind::Mfgs, Belief { state, covariance });
            let landmarks: Vec<_> = (0..15).map(|_| vector(&mut rng, 3.0)).collect();
            let noise = Matrix3::identity() * 0.005f64.powi(2);
            let mut measure = |t: f64| -> Vec<SeenPoint> {
                let see =
                    |(id, l)| seen(id, turn(t).inverse() * l + normal(&mut rng) * 0.005, noise);
                (0..).zip(&landmarks).map(see).collect()
            };
            for point in measure(0.0) {
                assert!(mfgs.point_state().unwrap().admit(&point));
            }
            let mut tilts = Vec::new();
            for frame in 0..60 {
                let t = |step: usize| (frame * 10 + step) as f64 * 0.005;
                for step in 0..10 {
                    assert!(mfgs.propagate(&sample(t(step)), &sample(t(step + 1))));
                }
                assert!(mfgs.point_state().unwrap().measure(&measure(t(10))).is_some());
                if doubts && frame == 3 {
                    assert!(mfgs.doubt_levelling(1.0) && !mfgs.doubt_levelling(1.0));
                }
                let axis = mfgs.belief().state.world_from_body.rotation.inverse() * Vector3::z();
                let error = axis.cross(&up(t(10)));
                let covariance = mfgs.reported_covariance().fixed_view::<3, 3>(0, 0).into_owned();
                tilts.push((error, covariance));
            }
            (mfgs.knows_vertical(), mfgs.belief().state.accel_bias - bias, tilts)
        };
        let squared = |(error, covariance): &(Vector3<f64>, Matrix3<f64>)| {
            error.dot(&(covariance.cholesky().unwrap().inverse() * error))
        };
        let (_, _, tilts) = run(false);
        assert!(squared(&tilts[19]) > 40.0, "{}", squared(&tilts[19]));

        let (known, bias_error, tilts) = run(true);
        let (doubt, at_rest) = (2.0 / ImuConfig::default().gravity.powi(2), tilts[19].1.trace());
        assert!(at_rest > 0.999 * doubt, "{at_rest}");
        assert!(tilts.iter().skip(4).all(|tilt| squared(tilt) < 14.0));
        let error = tilts[59].0.norm();
        assert!(known && bias_error.norm() < 0.1 && error < 0.01, "{known} {bias_error} {error}");
    }

    /// The rival's linearisation follows its estimates of the points and so finds information
    /// where there is none.
    #[test]
    fn the_kalman_filter_believes_that_it_learns_by_measuring_again() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let prior = belief(&mut rng, 0.2);
        let mut mekfs = filter(FilterKind::Mekfs, prior);
        measure_without_moving(mekfs.as_mut(), &Vector3::repeat(0.05), &mut rng);
        let trace = |b: &Belief| b.covariance.fixed_view::<3, 3>(0, 0).trace();
        assert!(trace(mekfs.belief()) < 0.9 * trace(&prior));
    }

    /// Both filters are the Kalman filter of the linearised system where everything is small.
    #[test]
    fn both_filters_agree_with_a_dense_kalman_filter_in_the_limit() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut prior = belief(&mut rng, 1e-3);
        prior.covariance *= 1e-4;
        prior.state.velocity = Vector3::zeros();
        let at_rest = |nanos| ImuSample {
            stamp: Stamp::from_nanos(nanos),
            angular_velocity: prior.state.gyro_bias,
            specific_force: prior.state.accel_bias
                + prior.state.world_from_body.rotation.inverse()
                    * Vector3::new(0.0, 0.0, ImuConfig::default().gravity),
        };
        let noise = Matrix3::from_diagonal(&Vector3::new(1e-6, 2e-6, 5e-6));
        let exact: Vec<_> = (0..7).map(|_| vector(&mut rng, 3.0)).collect();
        let again: Vec<_> = exact.iter().map(|p| p + vector(&mut rng, 1e-3)).collect();
        let mut results = Vec::new();
        for kind in [FilterKind::Mfgs, FilterKind::Mekfs] {
            let mut filter = filter(kind, prior);
            let points = filter.point_state().unwrap();
            for (id, in_body) in exact.iter().enumerate() {
                assert!(points.admit(&seen(id as u64, *in_body, noise)));
            }
            assert!(filter.propagate(&at_rest(0), &at_rest(20_000_000)));
            let again: Vec<_> =
                again.iter().enumerate().map(|(id, p)| seen(id as u64, *p, noise)).collect();
            let points = filter.point_state().unwrap();
            assert!(points.measure(&again).is_some());
            let positions: Vec<_> = (0..7).map(|id| points.estimate(id).unwrap()).collect();
            results.push((*filter.belief(), positions));
        }

        let mut moved = prior;
        let step = Propagator::inertial(&ImuConfig::default())
            .propagate_with_transition(&mut moved, &at_rest(0), &at_rest(20_000_000))
            .unwrap();
        let rotation = prior.state.world_from_body.rotation.to_rotation_matrix();
        let n = 15 + 21;
        let mut by_start = DMatrix::zeros(n, n);
        by_start.view_mut((0, 0), (15, 15)).fill_with_identity();
        let mut start = DMatrix::zeros(n, n);
        start.view_mut((0, 0), (15, 15)).copy_from(&prior.covariance);
        let world_noise = rotation.matrix() * noise * rotation.matrix().transpose();
        let mut h = DMatrix::zeros(21, n);
        let mut noises = DMatrix::zeros(21, 21);
        let mut residual = DMatrix::zeros(21, 1);
        for i in 0..7 {
            let (row, at) = (3 * i, 15 + 3 * i);
            let j = point_by_pose(rotation.matrix(), &exact[i]);
            for (from, to) in [(0, block::ROTATION), (3, block::POSITION)] {
                let part = j.fixed_columns::<3>(from);
                by_start.fixed_view_mut::<3, 3>(at, to).copy_from(&part);
                h.fixed_view_mut::<3, 3>(row, to).copy_from(&part);
            }
            by_start.fixed_view_mut::<3, 3>(at, at).fill_with_identity();
            start.fixed_view_mut::<3, 3>(at, at).copy_from(&world_noise);
            h.fixed_view_mut::<3, 3>(row, at).copy_from(&-Matrix3::identity());
            noises.fixed_view_mut::<3, 3>(row, row).copy_from(&world_noise);
            residual.fixed_view_mut::<3, 1>(row, 0).copy_from(&(rotation * (exact[i] - again[i])));
        }
        let mut prior_covariance = &by_start * start * by_start.transpose();
        let cross = step * prior_covariance.view((0, 15), (15, 21));
        prior_covariance.view_mut((0, 15), (15, 21)).copy_from(&cross);
        prior_covariance.view_mut((15, 0), (21, 15)).copy_from(&cross.transpose());
        prior_covariance.view_mut((0, 0), (15, 15)).copy_from(&moved.covariance);
        let innovation = &h * &prior_covariance * h.transpose() + noises;
        let gain = &prior_covariance * h.transpose() * innovation.try_inverse().unwrap();
        let posterior = &prior_covariance - &gain * &h * &prior_covariance;
        let change = gain * residual;
        for (belief, points) in &results {
            let expected = posterior.fixed_view::<15, 15>(0, 0);
            assert!((belief.covariance - expected).norm() < 1e-4 * expected.norm());
            let expected = change.fixed_view::<3, 1>(block::VELOCITY, 0);
            let error = (belief.state.velocity - expected).norm();
            assert!(error < 1e-2 * expected.norm(), "{error} {expected}");
            for (i, point) in points.iter().enumerate() {
                let start = rotation * exact[i] + prior.state.world_from_body.translation.vector;
                let expected = start + change.fixed_view::<3, 1>(15 + 3 * i, 0);
                assert!((point.position - expected).norm() < 1e-5);
                let expected = posterior.fixed_view::<3, 3>(15 + 3 * i, 15 + 3 * i);
                assert!((point.covariance - expected).norm() < 1e-3 * expected.norm());
            }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(16))]

        /// A start from motion: tilt and velocity are known badly, heading well, points to
        /// millimetres, and the first frames are what the belief allows for.
        #[test]
        fn precise_points_never_make_the_attitude_less_certain(seed: u64) {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let axes = UnitQuaternion::new(vector(&mut rng, 1.5)).to_rotation_matrix();
            let by_block = [[0.1, 0.1, 0.01], [1.0; 3], [1e-3; 3], [0.01; 3], [0.1; 3]];
            let deviations = SVector::<f64, NAVIGATION>::from_iterator(by_block.concat());
            let mut covariance =
                NavCovariance::from_diagonal(&deviations.component_mul(&deviations));
            let rotation = covariance.fixed_view::<3, 3>(0, 0).into_owned();
            let in_body = axes.matrix().transpose() * rotation * axes.matrix();
            covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&in_body);
            let state = NavState {
                world_from_body: Isometry3::from_parts(Vector3::zeros().into(), axes.into()),
                velocity: Vector3::zeros(),
                gyro_bias: Vector3::zeros(),
                accel_bias: Vector3::zeros(),
            };
            let mut error = deviations.map(|sd| {
                let drawn: f64 = StandardNormal.sample(&mut rng);
                sd * drawn
            });
            let turned = axes.matrix().transpose() * error.fixed_rows::<3>(0);
            error.fixed_rows_mut::<3>(0).copy_from(&turned);
            let mut truth = state.corrected_by(&error);

            let spread = |b: &Belief| b.covariance.fixed_view::<3, 3>(0, 0).trace();
            let mut mfgs = filter(FilterKind::Mfgs, Belief { state, covariance });
            let noise_sd = 0.003;
            let landmarks: Vec<_> = (0..90)
                .map(|_| truth.world_from_body * Point3::from(vector(&mut rng, 2.0)))
                .collect();
            let mut see = |truth: &NavState| -> Vec<SeenPoint> {
                let noise = Matrix3::identity() * (noise_sd * noise_sd);
                let exact = |l: &Point3<f64>| truth.world_from_body.inverse_transform_point(l);
                let see = |(id, l)| {
                    seen(id as u64, exact(l).coords + normal(&mut rng) * noise_sd, noise)
                };
                landmarks.iter().enumerate().map(see).collect()
            };
            for point in see(&truth) {
                mfgs.point_state().unwrap().admit(&point);
            }
            let gravity = Vector3::z() * ImuConfig::default().gravity;
            let sample = |truth: &NavState, nanos| ImuSample {
                stamp: Stamp::from_nanos(nanos),
                angular_velocity: truth.gyro_bias,
                specific_force: truth.accel_bias
                    + truth.world_from_body.rotation.inverse() * gravity,
            };
            for frame in 0..6 {
                let (from, to) = (frame * 33_000_000, (frame + 1) * 33_000_000);
                assert!(mfgs.propagate(&sample(&truth, from), &sample(&truth, to)));
                truth.world_from_body.translation.vector += truth.velocity * 0.033;
                let before = spread(mfgs.belief());
                assert!(mfgs.point_state().unwrap().measure(&see(&truth)).is_some());
                let after = spread(mfgs.belief());
                prop_assert!(after < 1.02 * before, "frame {frame}: {before} became {after}");
            }
            let error = mfgs.belief().state.world_from_body.rotation.inverse()
                * truth.world_from_body.rotation;
            let covariance = mfgs.belief().covariance.fixed_view::<3, 3>(0, 0).into_owned();
            let error = error.scaled_axis();
            let nees = error.dot(&covariance.cholesky().unwrap().solve(&error));
            prop_assert!(nees < 21.1, "{nees} (99.99 %)");
        }
    }

    /// Lets the body seem to turn by 3.5 degrees before each of 20 frames in which it rests among
    /// 30 points, as where the IMU's data have a gap.
    fn turn_without_the_map(mfgs: &mut dyn VisualInertialFilter, prior: &NavState) {
        let mut rng = ChaCha8Rng::seed_from_u64(31);
        let noise = Matrix3::identity() * 0.002f64.powi(2);
        let points: Vec<_> = (0..30).map(|id| seen(id, vector(&mut rng, 2.0), noise)).collect();
        let state = mfgs.point_state().unwrap();
        assert!(points.iter().all(|point| state.admit(point)));
        mfgs.set_imu_gap(true);
        let up = prior.world_from_body.rotation.inverse() * Vector3::z();
        for frame in 0..20 {
            let sample = |k: i64| ImuSample {
                stamp: Stamp::from_nanos((frame + k) * 33_000_000),
                angular_velocity: Vector3::new(1.5, -1.0, 0.5) + prior.gyro_bias,
                specific_force: up * ImuConfig::default().gravity + prior.accel_bias,
            };
            assert!(mfgs.propagate(&sample(0), &sample(1)));
            assert!(mfgs.point_state().unwrap().measure(&points).is_some());
        }
    }

    /// Turns that the map does not share leave both where they are, however far from the world's
    /// origin.
    #[test]
    fn a_turn_without_the_map_moves_neither() {
        let mut rng = ChaCha8Rng::seed_from_u64(29);
        let mut prior = belief(&mut rng, 0.01);
        prior.covariance *= 1e-4;
        prior.state.velocity = Vector3::zeros();
        prior.state.world_from_body.translation.vector = Vector3::new(10.0, -6.0, 2.0);
        let mut mfgs = filter(FilterKind::Mfgs, prior);
        turn_without_the_map(mfgs.as_mut(), &prior.state);
        let (before, after) = (prior.state.world_from_body, mfgs.belief().state.world_from_body);
        let moved = (after.translation.vector - before.translation.vector).norm();
        assert!(moved < 2e-3, "{moved} m");
        assert!(before.rotation.angle_to(&after.rotation) < 2e-3);
    }

    /// Nor do they tell the heading.
    #[test]
    fn a_turn_without_the_map_tells_nothing_of_the_heading() {
        let mut rng = ChaCha8Rng::seed_from_u64(37);
        let mut prior = belief(&mut rng, 0.2);
        prior.state.velocity = Vector3::zeros();
        // A heading that is correlated with nothing else that could be learnt.
        prior.covariance.rows_mut(0, 3).fill(0.0);
        prior.covariance.columns_mut(0, 3).fill(0.0);
        prior.covariance.view_mut((0, 0), (3, 3)).fill_diagonal(0.04);
        let variance = |b: &Belief| {
            let vertical = b.state.world_from_body.rotation.inverse() * Vector3::z();
            vertical.dot(&(b.covariance.fixed_view::<3, 3>(0, 0) * vertical))
        };
        let mut mfgs = filter(FilterKind::Mfgs, prior);
        turn_without_the_map(mfgs.as_mut(), &prior.state);
        let (before, after) = (variance(&prior), variance(mfgs.belief()));
        assert!(after > before * (1.0 - 1e-9), "{before} became {after}");
    }

    #[test]
    fn releasing_a_point_leaves_the_rest_as_it_was() {
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        let prior = belief(&mut rng, 0.1);
        let mut mfgs = filter(FilterKind::Mfgs, prior);
        measure_without_moving(mfgs.as_mut(), &Vector3::repeat(0.1), &mut rng);
        let before = *mfgs.belief();
        let points = mfgs.point_state().unwrap();
        let kept: Vec<_> = (0..20).filter(|id| *id != 7).map(|id| points.estimate(id)).collect();
        assert!(points.release(7) && !points.release(7));
        let after: Vec<_> = (0..20).filter(|id| *id != 7).map(|id| points.estimate(id)).collect();
        assert_eq!(kept, after);
        assert_eq!(points.estimate(7), None);
        assert_eq!(points.ids().len(), 19);
        assert_eq!(*mfgs.belief(), before);
    }

    /// The correlation of points with the pose is carried by the product of the steps.
    #[test]
    fn correlations_follow_the_motion() {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        let prior = belief(&mut rng, 0.05);
        let mut mfgs = filter(FilterKind::Mfgs, prior);
        let point = seen(0, vector(&mut rng, 2.0), Matrix3::identity() * 1e-4);
        assert!(mfgs.point_state().unwrap().admit(&point));
        let position = |f: &dyn VisualInertialFilter| f.belief().covariance;
        let before = position(mfgs.as_ref());
        let sample = |nanos| ImuSample {
            stamp: Stamp::from_nanos(nanos),
            angular_velocity: Vector3::new(0.3, -0.5, 0.2),
            specific_force: Vector3::new(0.5, 0.1, 9.8),
        };
        for k in 0..20 {
            assert!(mfgs.propagate(&sample(k * 5_000_000), &sample((k + 1) * 5_000_000)));
        }
        assert!((position(mfgs.as_ref()) - before).norm() > 1e-3);
        // Measured very precisely, the point fixes the body relative to it: the spread of the
        // position that is left is that of the point and of the lever to it.
        let point = mfgs.point_state().unwrap().estimate(0).unwrap().position;
        let exact = mfgs.belief().state.world_from_body.inverse_transform_point(&point.into());
        let again = seen(0, exact.coords, Matrix3::identity() * 1e-10);
        assert!(mfgs.point_state().unwrap().measure(&[again]).is_some());
        let belief = mfgs.belief();
        let rotation = belief.state.world_from_body.rotation.to_rotation_matrix();
        let j = point_by_pose(rotation.matrix(), &exact.coords);
        let seen_spread = j * crate::inertial::pose_covariance(&belief.covariance) * j.transpose();
        let spread = mfgs.point_state().unwrap().estimate(0).unwrap().covariance;
        assert!((seen_spread - spread).norm() < 1e-3 * spread.norm());
    }

    /// Seen from one place, a wrong mounting moves all points alike and cannot be told from their
    /// places: neither its mean nor its covariance moves.
    #[test]
    fn a_camera_that_does_not_move_tells_nothing_of_its_mounting() {
        let mut rng = ChaCha8Rng::seed_from_u64(23);
        let prior = belief(&mut rng, 0.01);
        let calibration = uncertain_calibration();
        let mut mfgs = filter(FilterKind::Mfgs, prior);
        assert!(mfgs.calibrate(&calibration) && !mfgs.calibrate(&calibration));
        measure_without_moving(mfgs.as_mut(), &Vector3::repeat(0.02), &mut rng);
        let after = mfgs.calibration().unwrap();
        let change = (after.covariance - calibration.covariance).norm();
        assert!(change < 1e-9 * calibration.covariance.norm(), "{change}");
        let (before, after) = (calibration.body_from_camera, after.body_from_camera);
        assert!(before.rotation.angle_to(&after.rotation) < 1e-9);
        assert!((before.translation.vector - after.translation.vector).norm() < 1e-9);
        assert!(!filter(FilterKind::Mfgr, prior).calibrate(&calibration));
    }

    /// Nor at rest while tilt, velocity and biases are being found, and rest is measured as well:
    /// all that is left is of second order in the velocity of the first frames.
    #[test]
    fn at_rest_the_calibration_stays_as_it_was() {
        let mut rng = ChaCha8Rng::seed_from_u64(29);
        let imu = ImuConfig::default();
        let mut covariance = NavCovariance::identity() * 1e-6;
        for (start, sd) in [(0, 0.03), (3, 0.1), (9, imu.gyro_bias_sd), (12, imu.accel_bias_sd)] {
            (start..start + 3).for_each(|k| covariance[(k, k)] = sd * sd);
        }
        let state = NavState {
            world_from_body: Isometry3::rotation(normal(&mut rng) * 0.03),
            velocity: normal(&mut rng) * 0.1,
            gyro_bias: Vector3::zeros(),
            accel_bias: Vector3::zeros(),
        };
        let gravity = Vector3::new(0.0, 0.0, imu.gravity);
        let sample = |step: i64, rng: &mut ChaCha8Rng| ImuSample {
            stamp: Stamp::from_nanos(step * 5_000_000),
            angular_velocity: normal(rng) * (imu.gyro_noise / 0.005f64.sqrt()),
            specific_force: gravity + normal(rng) * (imu.accel_noise / 0.005f64.sqrt()),
        };
        for kind in [FilterKind::Mfgs, FilterKind::Mekfs] {
            let mut rng = rng.clone();
            let prior = uncertain_calibration();
            let mut filter = filter(kind, Belief { state, covariance });
            assert!(filter.calibrate(&prior));
            let in_camera: Vec<_> =
                (0..25).map(|_| vector(&mut rng, 1.5) + Vector3::new(0.0, 0.0, 2.5)).collect();
            let noise = Matrix3::identity() * 0.01f64.powi(2);
            let mut last = sample(0, &mut rng);
            for frame in 0..90 {
                for step in 1..=7 {
                    let next = sample(7 * frame + step, &mut rng);
                    assert!(filter.propagate(&last, &next));
                    last = next;
                }
                let mounting = filter.calibration().unwrap().body_from_camera;
                let see = |(id, exact): (usize, &Vector3<f64>), rng: &mut ChaCha8Rng| {
                    let point = mounting * Point3::from(exact + normal(rng) * 0.01);
                    seen(id as u64, point.coords, noise)
                };
                let points: Vec<_> =
                    in_camera.iter().enumerate().map(|p| see(p, &mut rng)).collect();
                let state = filter.point_state().unwrap();
                match frame {
                    0 => assert!(points.iter().all(|point| state.admit(point))),
                    _ => assert!(state.measure(&points).is_some()),
                }
                let rest = Rest { rate: Vector3::zeros(), velocity_sd: 0.02, rate_sd: 0.02 };
                assert!(frame < 30 || filter.rest(&rest));
            }
            let found = filter.calibration().unwrap();
            for (k, sd) in found.standard_deviations().into_iter().enumerate() {
                let before = prior.standard_deviations()[k];
                assert!((sd / before - 1.0).abs() < 0.02, "{kind} {k}: {before} {sd}");
            }
            let turned = found.body_from_camera.rotation.angle_to(&prior.body_from_camera.rotation);
            assert!(turned < 0.2 * prior.standard_deviations()[0], "{kind}: {turned}");
        }
    }

    #[test]
    fn nothing_that_is_not_finite_enters() {
        let mut rng = ChaCha8Rng::seed_from_u64(13);
        let prior = belief(&mut rng, 0.05);
        for kind in [FilterKind::Mfgs, FilterKind::Mekfs] {
            let mut filter = filter(kind, prior);
            let points = filter.point_state().unwrap();
            let good = seen(0, Vector3::x(), Matrix3::identity());
            for bad in [f64::NAN, f64::INFINITY] {
                assert!(!points.admit(&seen(1, Vector3::repeat(bad), Matrix3::identity())));
                assert!(!points.admit(&seen(1, Vector3::x(), Matrix3::repeat(bad))));
            }
            assert!(points.admit(&good) && !points.admit(&good));
            for bad in [f64::NAN, f64::INFINITY, 1e300] {
                let _ = points.measure(&[seen(0, Vector3::repeat(bad), Matrix3::identity())]);
                let _ = points.measure(&[seen(0, Vector3::x(), Matrix3::repeat(bad))]);
            }
            assert!(points.measure(&[]).is_none());
            assert!(filter.belief().is_finite());
        }
    }

    /// A body that moves among points with its attitude unknown: gravity makes roll and pitch
    /// converge to what they are, and `S` grows from zero.
    #[test]
    fn gravity_is_found_from_any_attitude() {
        let mut rng = ChaCha8Rng::seed_from_u64(17);
        for _ in 0..4 {
            let world_from_start = UnitQuaternion::new(vector(&mut rng, 3.0));
            let rate = Vector3::new(0.4, -0.3, 0.6);
            let acceleration = |t: f64| {
                Vector3::new(1.5 * (4.0 * t).cos(), 2.0 * (5.0 * t).sin(), (3.0 * t).cos())
            };
            let body = |t: f64| world_from_start * UnitQuaternion::new(rate * t);
            let place = |t: f64| {
                Vector3::new(
                    -1.5 / 16.0 * (4.0 * t).cos(),
                    -2.0 / 25.0 * (5.0 * t).sin(),
                    -(3.0 * t).cos() / 9.0,
                )
            };
            let gravity = ImuConfig::default().gravity;
            let sample = |t: f64| ImuSample {
                stamp: Stamp::default().offset_by(t),
                angular_velocity: rate,
                specific_force: body(t).inverse() * (acceleration(t) + Vector3::z() * gravity),
            };
            let mut covariance = NavCovariance::identity() * 1e-4;
            covariance.fixed_view_mut::<3, 3>(block::VELOCITY, block::VELOCITY).fill_diagonal(1.0);
            let state = NavState {
                world_from_body: Isometry3::identity(),
                velocity: Vector3::zeros(),
                gyro_bias: Vector3::zeros(),
                accel_bias: Vector3::zeros(),
            };
            let known = super::super::KnownAttitude::Nothing { gravity };
            let mut filter = FilterKind::Mfgs.start_knowing(
                known,
                &FilterConfig::default(),
                Propagator::inertial(&ImuConfig::default()),
                Belief { state, covariance },
            );
            assert_eq!(filter.matrix_fisher().map(|f| f.s), Some(Vector3::zeros()));
            let landmarks: Vec<_> = (0..15).map(|_| vector(&mut rng, 3.0)).collect();
            let measure = |t: f64, rng: &mut ChaCha8Rng| -> Vec<SeenPoint> {
                let exact = |l: &Vector3<f64>| body(t).inverse() * (l - place(t));
                let noise = Matrix3::identity() * 0.005f64.powi(2);
                let see = |(id, l)| seen(id as u64, exact(l) + normal(rng) * 0.005, noise);
                landmarks.iter().enumerate().map(see).collect()
            };
            for point in measure(0.0, &mut rng) {
                assert!(filter.point_state().unwrap().admit(&point));
            }
            let mut kappa = 0.0;
            for frame in 0..30 {
                let t = |step: usize| (frame * 10 + step) as f64 * 0.005;
                for step in 0..10 {
                    assert!(filter.propagate(&sample(t(step)), &sample(t(step + 1))));
                }
                let points = measure(t(10), &mut rng);
                assert!(filter.point_state().unwrap().measure(&points).is_some());
                if frame == 3 {
                    kappa = filter.matrix_fisher().unwrap().s.x;
                }
            }
            let state = &filter.belief().state;
            let up = state.world_from_body.rotation.inverse() * Vector3::z();
            let true_up = body(1.5).inverse() * Vector3::z();
            let tilt = up.angle(&true_up);
            let s = filter.matrix_fisher().unwrap().s;
            assert!(tilt < 0.01, "{tilt}");
            assert!(s.x > 10.0 * kappa && kappa > 0.0 && s.y.abs() < 1e-9 * s.x, "{s} {kappa}");
            assert!(tilt < 5.0 / s.x.sqrt());
            let speed = (body(1.5).inverse() * velocity(1.5)).norm();
            assert_relative_eq!(state.velocity.norm(), speed, epsilon = 0.05);
        }
    }

    /// Derivative of the motion of `gravity_is_found_from_any_attitude`.
    fn velocity(t: f64) -> Vector3<f64> {
        Vector3::new(
            1.5 / 4.0 * (4.0 * t).sin(),
            -2.0 / 5.0 * (5.0 * t).cos(),
            (3.0 * t).sin() / 3.0,
        )
    }
}
