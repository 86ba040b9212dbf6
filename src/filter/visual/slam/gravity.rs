//! Gravity of unknown direction: what an unknown attitude comes to where nothing else tells it.
//!
//! Without a map or a compass the world may be the body's frame at the start: the attitude there
//! is known, and what is unknown is where gravity points. Everything measured is linear in it, so
//! that a Gaussian in R^3 carries any uncertainty without approximation, up to its magnitude,
//! which is used once the direction is known well. In an upright world the belief is the matrix
//! Fisher distribution of rank one that a von Mises-Fisher distribution of the vertical is:
//! `S = (kappa, 0, 0)`, heading uniform. Points seen meanwhile are points of the state.

use nalgebra::{DMatrix, Matrix3, SMatrix, UnitQuaternion, Vector3};

use super::UNIFORM_VARIANCE;
use crate::inertial::{Belief, NavCovariance, attitude_from_gravity, block, symmetrize};

/// Navigation error by gravity.
type ByGravity = SMatrix<f64, 15, 3>;

/// Mean and covariance of gravity (m/s^2) in the world of the filter.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct UnknownGravity {
    magnitude: f64,
    pub mean: Vector3<f64>,
    pub covariance: Matrix3<f64>,
    /// Covariance of the navigation error with it.
    cross: ByGravity,
    /// Derivative of the navigation error by it since the last update.
    pub transition: ByGravity,
}

impl UnknownGravity {
    /// Standard deviation of the direction about any axis below which it counts as known, rad. Of
    /// what a larger one makes of second order, a precise bias would know more than there is.
    pub const SETTLED: f64 = 0.02;

    /// The mean and covariance of a vector of the given magnitude and any direction.
    pub fn new(magnitude: f64) -> Self {
        Self {
            magnitude,
            mean: Vector3::zeros(),
            covariance: Matrix3::identity() * (magnitude * magnitude / 3.0),
            cross: ByGravity::zeros(),
            transition: ByGravity::zeros(),
        }
    }

    /// Around a mean that has been taken for certain, with the covariances that [`Self::follow`]
    /// takes.
    pub fn around(mean: Vector3<f64>, covariance: &DMatrix<f64>) -> Self {
        let mut gravity = Self { mean, ..Self::new(mean.norm()) };
        gravity.follow(covariance);
        gravity
    }

    /// Takes its covariances from that of the whole state, where it follows the navigation part.
    pub fn follow(&mut self, covariance: &DMatrix<f64>) {
        self.cross = covariance.fixed_view::<15, 3>(0, 15).into_owned();
        self.covariance = covariance.fixed_view::<3, 3>(15, 15).into_owned();
    }

    /// Adds to a belief that was propagated over `h` seconds with the mean of gravity, by the
    /// transition `step`, what the uncertainty of gravity adds to its covariance.
    pub fn propagate(&mut self, belief: &mut Belief, step: &NavCovariance, h: f64) {
        let mut by_gravity = ByGravity::zeros();
        by_gravity.fixed_view_mut::<3, 3>(block::VELOCITY, 0).fill_diagonal(h);
        by_gravity.fixed_view_mut::<3, 3>(block::POSITION, 0).fill_diagonal(0.5 * h * h);
        let carried = step * self.cross;
        let mixed = carried * by_gravity.transpose();
        belief.covariance +=
            mixed + mixed.transpose() + by_gravity * self.covariance * by_gravity.transpose();
        symmetrize(&mut belief.covariance);
        self.cross = carried + by_gravity * self.covariance;
        self.transition = step * self.transition + by_gravity;
    }

    /// The turn of the world that makes the mean point down; `None` while it has no direction.
    pub fn levelling_turn(&self) -> Option<UnitQuaternion<f64>> {
        attitude_from_gravity(&-self.mean)
    }

    pub fn upright(&self) -> Vector3<f64> {
        Vector3::new(0.0, 0.0, -self.magnitude)
    }

    /// Mean variance of the two components of gravity across its mean, (m/s^2)^2.
    fn variance_across(&self) -> f64 {
        let along = self.mean.try_normalize(0.0).map_or(0.0, |u| u.dot(&(self.covariance * u)));
        0.5 * (self.covariance.trace() - along).max(0.0)
    }

    pub fn is_settled(&self) -> bool {
        let across = self
            .mean
            .try_normalize(0.0)
            .map_or_else(Matrix3::identity, |up| Matrix3::identity() - up * up.transpose());
        let largest = (across * self.covariance * across).symmetric_eigenvalues().max();
        largest.sqrt() < Self::SETTLED * self.magnitude
    }

    /// Of the attitude in an upright world: the concentration of the von Mises-Fisher density
    /// that a Gaussian of this variance across its mean makes on the sphere of the magnitude.
    pub fn concentration(&self) -> f64 {
        self.magnitude * self.mean.norm() / self.variance_across()
    }

    /// Standard deviation of what the magnitude of the mean tells of that of gravity, m/s^2: a
    /// direction off by `a` shortens it by `a^2 / 2`.
    pub fn magnitude_sd(&self) -> f64 {
        self.variance_across() / self.magnitude + 1e-3 * self.magnitude
    }

    /// Difference between the true magnitude and that of the mean, and the mean's direction.
    pub fn magnitude_error(&self) -> Option<(f64, Vector3<f64>)> {
        let direction = self.mean.try_normalize(1e-6)?;
        Some((self.magnitude - self.mean.norm(), direction))
    }

    /// Derivative by gravity's error of the turn of an upright world that makes up for it.
    fn tilt(&self) -> Matrix3<f64> {
        Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0) / self.magnitude
    }

    /// Derivative by gravity's error of a block of the error in the upright world: the body's
    /// rotation.
    pub fn rotation_by_gravity(&self, world_from_body: &UnitQuaternion<f64>) -> Matrix3<f64> {
        world_from_body.inverse().to_rotation_matrix().matrix() * self.tilt()
    }

    /// The same of a vector of the world.
    pub fn vector_by_gravity(&self, vector: &Vector3<f64>) -> Matrix3<f64> {
        -vector.cross_matrix() * self.tilt()
    }

    /// Covariance of the navigation error in the upright world, the heading being that which the
    /// world has; the mean of gravity points down.
    pub fn upright_covariance(&self, belief: &Belief) -> NavCovariance {
        let state = &belief.state;
        let mut by_gravity = ByGravity::zeros();
        let mut set = |row: usize, value: Matrix3<f64>| {
            by_gravity.fixed_view_mut::<3, 3>(row, 0).copy_from(&value);
        };
        set(block::ROTATION, self.rotation_by_gravity(&state.world_from_body.rotation));
        set(block::VELOCITY, self.vector_by_gravity(&state.velocity));
        set(block::POSITION, self.vector_by_gravity(&state.world_from_body.translation.vector));
        let mixed = self.cross * by_gravity.transpose();
        let mut covariance = belief.covariance
            + mixed
            + mixed.transpose()
            + by_gravity * self.covariance * by_gravity.transpose();
        symmetrize(&mut covariance);
        if self.levelling_turn().is_none() {
            covariance
                .fixed_view_mut::<3, 3>(block::ROTATION, block::ROTATION)
                .copy_from(&(Matrix3::identity() * UNIFORM_VARIANCE));
        }
        covariance
    }
}
