//! The zero-velocity update: that the body stands still.
//!
#![doc = include_str!("../../../docs/theory/zero_velocity.md")]
#![doc = include_str!("../../../docs/math.html")]

use nalgebra::{Const, Matrix3, Matrix6, SMatrix, Vector3, Vector6};

use crate::filter::core::FilterError;
use crate::filter::linear::LinearMeasurement;
use crate::inertial::{Belief, NavState, block, symmetrize};

/// That the body stands still, as a measurement of its velocity and of the gyro bias.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ZeroVelocity {
    /// Mean reading of the gyroscope over the interval that the measurement is for, rad/s.
    pub rate: Vector3<f64>,
    /// Standard deviation of each component of the velocity, m/s.
    pub velocity_sd: f64,
    /// Standard deviation of each component of `rate` about the bias, rad/s.
    pub rate_sd: f64,
}

impl ZeroVelocity {
    /// Linearised at a state whose error's first 15 rows are those of the navigation part.
    ///
    /// In world coordinates a velocity that is not yet estimated to be zero would seem to tell
    /// the heading, which standing still does not.
    pub(super) fn linearized(&self, state: &NavState) -> LinearMeasurement<Const<6>, Const<15>> {
        let body_from_world = state.world_from_body.rotation.inverse();
        let velocity = body_from_world * state.velocity;
        let mut residual = Vector6::zeros();
        residual.fixed_rows_mut::<3>(0).copy_from(&-velocity);
        residual.fixed_rows_mut::<3>(3).copy_from(&(self.rate - state.gyro_bias));
        let mut jacobian = SMatrix::<f64, 6, 15>::zeros();
        let mut set = |row: usize, column: usize, value: &Matrix3<f64>| {
            jacobian.fixed_view_mut::<3, 3>(row, column).copy_from(value);
        };
        set(0, block::ROTATION, &velocity.cross_matrix());
        set(0, block::VELOCITY, body_from_world.to_rotation_matrix().matrix());
        set(3, block::GYRO_BIAS, &Matrix3::identity());
        let (velocity, rate) = (self.velocity_sd.powi(2), self.rate_sd.powi(2));
        let noise = Vector6::new(velocity, velocity, velocity, rate, rate, rate);
        LinearMeasurement { residual, jacobian, first: 0, noise: Matrix6::from_diagonal(&noise) }
    }

    /// Conditions a belief, to first order in the rotation. On an error nothing changes.
    pub(super) fn condition(&self, belief: &mut Belief) -> Result<(), FilterError> {
        *belief = corrected(belief, &self.linearized(&belief.state))?;
        Ok(())
    }
}

/// A belief conditioned on a measurement of its error.
pub(super) fn corrected<const M: usize, const K: usize>(
    belief: &Belief,
    measurement: &LinearMeasurement<Const<M>, Const<K>>,
) -> Result<Belief, FilterError> {
    let correction = measurement.condition(&belief.covariance)?;
    let mut covariance = belief.covariance;
    correction.reduce(&mut covariance);
    symmetrize(&mut covariance);
    let posterior = Belief { state: belief.state.corrected_by(&correction.change), covariance };
    posterior.is_finite().then_some(posterior).ok_or(FilterError::NotFinite("posterior"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::filter::{FilterConfig, FilterKind};
    use crate::inertial::{ImuConfig, NavCovariance, Propagator};
    use approx::assert_relative_eq;
    use nalgebra::{Isometry3, SVector};
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    const AT_REST: ZeroVelocity =
        ZeroVelocity { rate: Vector3::new(0.02, -0.01, 0.03), velocity_sd: 0.02, rate_sd: 0.004 };

    /// A moving belief with every correlation present.
    fn belief() -> Belief {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut vector = |scale: f64| Vector3::from_fn(|_, _| rng.random_range(-scale..scale));
        let state = NavState {
            world_from_body: Isometry3::new(vector(3.0), vector(1.5)),
            velocity: vector(0.1),
            gyro_bias: vector(0.05),
            accel_bias: vector(0.1),
        };
        let root = NavCovariance::from_fn(|_, _| rng.random_range(-0.02..0.02));
        Belief { state, covariance: root * root.transpose() + NavCovariance::identity() * 1e-5 }
    }

    #[test]
    fn the_derivative_is_that_of_the_residual() {
        let state = belief().state;
        let measurement = AT_REST.linearized(&state);
        for k in 0..15 {
            let step = SVector::<f64, 15>::from_fn(|i, _| if i == k { 1e-6 } else { 0.0 });
            // A true state that is off by `step` would have measured this much more.
            let there = AT_REST.linearized(&state.corrected_by(&step)).residual;
            assert_relative_eq!(
                (measurement.residual - there) * 1e6,
                measurement.jacobian.column(k).into_owned(),
                epsilon = 1e-5
            );
        }
    }

    #[test]
    fn every_filter_is_the_kalman_filter_in_the_limit() {
        let prior = belief();
        let mut expected = prior;
        AT_REST.condition(&mut expected).unwrap();
        assert!(expected.state.velocity.norm() < 0.5 * prior.state.velocity.norm());
        let error = |belief: &Belief| (belief.state.gyro_bias - AT_REST.rate).norm();
        assert!(error(&expected) < 0.5 * error(&prior));
        for kind in FilterKind::ALL {
            let propagator = Propagator::inertial(&ImuConfig::default());
            let mut filter = kind.start(&FilterConfig::default(), propagator, prior);
            filter.update_zero_velocity(&AT_REST).unwrap();
            let found = filter.belief();
            assert_relative_eq!(found.covariance, expected.covariance, epsilon = 1e-12);
            assert_relative_eq!(found.state.velocity, expected.state.velocity, epsilon = 1e-12);
        }
    }

    /// Turning the world changes nothing that is measured, so that its spread stays.
    #[test]
    fn standing_still_does_not_tell_the_heading() {
        let mut belief = belief();
        let state = belief.state;
        let mut turn = SVector::<f64, 15>::zeros();
        let up = state.world_from_body.rotation.inverse() * Vector3::z();
        turn.fixed_rows_mut::<3>(block::ROTATION).copy_from(&up);
        turn.fixed_rows_mut::<3>(block::VELOCITY).copy_from(&Vector3::z().cross(&state.velocity));
        let position = state.world_from_body.translation.vector;
        turn.fixed_rows_mut::<3>(block::POSITION).copy_from(&Vector3::z().cross(&position));
        belief.covariance = NavCovariance::identity() * 1e-6 + turn * turn.transpose() * 0.1;
        let spread = |belief: &Belief| {
            let information = belief.covariance.try_inverse().unwrap();
            1.0 / turn.dot(&(information * turn))
        };
        let before = spread(&belief);
        AT_REST.condition(&mut belief).unwrap();
        assert_relative_eq!(spread(&belief), before, max_relative = 1e-9);
    }
}
