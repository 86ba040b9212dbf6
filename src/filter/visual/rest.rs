use nalgebra::{Matrix3, Matrix6, SMatrix, Vector3, Vector6};

use crate::inertial::{Belief, NavState, block, symmetrize};

/// That the body stands still, as a measurement of its velocity and of the gyro bias.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rest {
    /// Mean reading of the gyroscope over the interval that the measurement is for, rad/s.
    pub rate: Vector3<f64>,
    /// Standard deviation of each component of the velocity, m/s.
    pub velocity_sd: f64,
    /// Standard deviation of each component of `rate` about the bias, rad/s.
    pub rate_sd: f64,
}

impl Rest {
    /// Residual of (velocity in body coordinates, gyro bias), its derivative by the error of the
    /// state, and its noise.
    ///
    /// In world coordinates a velocity that is not yet estimated to be zero would seem to tell
    /// the heading, which standing still does not.
    pub(super) fn linearized(
        &self,
        state: &NavState,
    ) -> (Vector6<f64>, SMatrix<f64, 6, 15>, Matrix6<f64>) {
        let body_from_world = state.world_from_body.rotation.inverse();
        let velocity = body_from_world * state.velocity;
        let mut residual = Vector6::zeros();
        residual.fixed_rows_mut::<3>(0).copy_from(&-velocity);
        residual.fixed_rows_mut::<3>(3).copy_from(&(self.rate - state.gyro_bias));
        let mut by_state = SMatrix::<f64, 6, 15>::zeros();
        let mut set = |row: usize, column: usize, value: &Matrix3<f64>| {
            by_state.fixed_view_mut::<3, 3>(row, column).copy_from(value);
        };
        set(0, block::ROTATION, &velocity.cross_matrix());
        set(0, block::VELOCITY, body_from_world.to_rotation_matrix().matrix());
        set(3, block::GYRO_BIAS, &Matrix3::identity());
        let (velocity, rate) = (self.velocity_sd.powi(2), self.rate_sd.powi(2));
        let noise = Vector6::new(velocity, velocity, velocity, rate, rate, rate);
        (residual, by_state, Matrix6::from_diagonal(&noise))
    }

    /// The Kalman filter's update, to first order in the rotation. False, and no change, if
    /// nothing finite follows.
    pub(super) fn condition(&self, belief: &mut Belief) -> bool {
        let (residual, by_state, noise) = self.linearized(&belief.state);
        let by_measurement = belief.covariance * by_state.transpose();
        let Some(spread) = (by_state * by_measurement + noise).cholesky() else { return false };
        let gain = spread.solve(&by_measurement.transpose()).transpose();
        let mut covariance = belief.covariance - gain * by_measurement.transpose();
        symmetrize(&mut covariance);
        let state = belief.state.corrected_by(&(gain * residual));
        let updated = Belief { state, covariance };
        let finite = updated.is_finite();
        if finite {
            *belief = updated;
        }
        finite
    }
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

    const REST: Rest =
        Rest { rate: Vector3::new(0.02, -0.01, 0.03), velocity_sd: 0.02, rate_sd: 0.004 };

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
        let (residual, by_state, _) = REST.linearized(&state);
        for k in 0..15 {
            let step = SVector::<f64, 15>::from_fn(|i, _| if i == k { 1e-6 } else { 0.0 });
            // A true state that is off by `step` would have measured this much more.
            let there = REST.linearized(&state.corrected_by(&step)).0;
            assert_relative_eq!(
                (residual - there) * 1e6,
                by_state.column(k).into_owned(),
                epsilon = 1e-5
            );
        }
    }

    #[test]
    fn every_filter_is_the_kalman_filter_in_the_limit() {
        let prior = belief();
        let mut expected = prior;
        assert!(REST.condition(&mut expected));
        assert!(expected.state.velocity.norm() < 0.5 * prior.state.velocity.norm());
        let error = |belief: &Belief| (belief.state.gyro_bias - REST.rate).norm();
        assert!(error(&expected) < 0.5 * error(&prior));
        for kind in FilterKind::ALL {
            let propagator = Propagator::inertial(&ImuConfig::default());
            let mut filter = kind.start(&FilterConfig::default(), propagator, prior);
            assert!(filter.rest(&REST), "{kind}");
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
        assert!(REST.condition(&mut belief));
        assert_relative_eq!(spread(&belief), before, max_relative = 1e-9);
    }
}
