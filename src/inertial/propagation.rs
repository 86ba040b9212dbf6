use nalgebra::{Isometry3, Matrix3, Matrix6, SMatrix, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use super::{Belief, DrivingNoise, ImuConfig, NavCovariance, NavState, block};
use crate::so3;

/// What carries the belief between two camera frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MotionModel {
    /// Angular velocity and specific force are measured.
    Inertial,
    /// No IMU: angular velocity and velocity change only by white accelerations. The angular
    /// velocity (body frame) is held in the gyro bias with the sign reversed, which makes a
    /// gyroscope that always reads zero right; the accelerometer bias stays zero.
    ConstantVelocity,
}

/// Propagates a [`Belief`] over the interval between two IMU samples.
///
/// The mean follows the strapdown equations with the averages of the samples at both ends; the
/// covariance follows the error of [`NavCovariance`] to first order in the error and second
/// order in the interval, with continuous-time noise densities. `O(15^3)` a step, no allocation.
#[derive(Debug, Clone)]
pub struct Propagator {
    model: MotionModel,
    gravity: Vector3<f64>,
    noise: DrivingNoise,
    /// Standard deviations of the biases of a start; 0 without an IMU.
    gyro_bias_sd: f64,
    accel_bias_sd: f64,
}

impl Propagator {
    pub fn inertial(config: &ImuConfig) -> Self {
        Self {
            model: MotionModel::Inertial,
            gravity: Vector3::new(0.0, 0.0, -config.gravity),
            noise: DrivingNoise::inertial(config),
            gyro_bias_sd: config.gyro_bias_sd,
            accel_bias_sd: config.accel_bias_sd,
        }
    }

    /// `angular_acceleration` in rad/s^2/sqrt(Hz), `acceleration` in m/s^2/sqrt(Hz): white
    /// noise densities.
    pub fn constant_velocity(angular_acceleration: f64, acceleration: f64) -> Self {
        Self {
            model: MotionModel::ConstantVelocity,
            gravity: Vector3::zeros(),
            noise: DrivingNoise::constant_velocity(angular_acceleration, acceleration),
            gyro_bias_sd: 0.0,
            accel_bias_sd: 0.0,
        }
    }

    /// Sets gravity as a vector in world coordinates, m/s^2.
    pub fn set_gravity(&mut self, gravity: Vector3<f64>) {
        self.gravity = gravity;
    }

    /// Says whether the next samples only stand in for those of a gap in the IMU's data.
    pub fn set_imu_gap(&mut self, in_gap: bool) {
        self.noise.set_imu_gap(in_gap);
    }

    pub fn model(&self) -> MotionModel {
        self.model
    }

    /// Moves `belief` over `h > 0` seconds with the measured angular velocity and specific force
    /// averaged over them; false, and no change, where no finite belief follows.
    pub fn advance(
        &self,
        belief: &mut Belief,
        angular_velocity: &Vector3<f64>,
        specific_force: &Vector3<f64>,
        h: f64,
    ) -> bool {
        self.advance_with_transition(belief, angular_velocity, specific_force, h).is_some()
    }

    /// Like [`Self::advance`]; gives the derivative of the error after the step by the error before
    /// it, for whoever carries correlations of the belief with something else.
    pub fn advance_with_transition(
        &self,
        belief: &mut Belief,
        angular_velocity: &Vector3<f64>,
        specific_force: &Vector3<f64>,
        h: f64,
    ) -> Option<NavCovariance> {
        let mut moved = *belief;
        let transition = self.step(&mut moved, angular_velocity, specific_force, h);
        moved.is_finite().then(|| {
            *belief = moved;
            transition
        })
    }

    /// Carries `belief` over `h` seconds without measurements (constant velocity model).
    /// Gives the derivative of the error as [`Self::advance_with_transition`] does.
    pub fn coast(&self, belief: &mut Belief, h: f64) -> NavCovariance {
        if h > 0.0 {
            self.step(belief, &Vector3::zeros(), &Vector3::zeros(), h)
        } else {
            NavCovariance::identity()
        }
    }

    /// Motion of the body over the interval relative to its pose at the start and without
    /// gravity, its error being caused by the noises and by biases of the given means and
    /// covariance: what a start at the identity, at rest, would lead to, and the derivative of its
    /// error by that of the start, the biases among it. `None` if it is not finite.
    pub fn relative_motion(
        &self,
        gyro: &Vector3<f64>,
        accel: &Vector3<f64>,
        biases: &NavState,
        bias_covariance: &Matrix6<f64>,
        h: f64,
    ) -> Option<(Belief, NavCovariance)> {
        let state = NavState {
            world_from_body: Isometry3::identity(),
            velocity: Vector3::zeros(),
            ..*biases
        };
        let mut covariance = NavCovariance::zeros();
        covariance
            .fixed_view_mut::<6, 6>(block::GYRO_BIAS, block::GYRO_BIAS)
            .copy_from(bias_covariance);
        let mut motion = Belief { state, covariance };
        let weightless = Self { gravity: Vector3::zeros(), ..self.clone() };
        let transition = weightless.step(&mut motion, gyro, accel, h);
        motion.is_finite().then_some((motion, transition))
    }

    /// World coordinates, m/s^2; zero for the constant velocity model.
    pub fn gravity(&self) -> &Vector3<f64> {
        &self.gravity
    }

    /// Covariance of what the error of the last `h` seconds is beyond that of the model, where the
    /// IMU turns out to be wrong: as that of a gap, and of biases that have changed by several
    /// times their standard deviations at a start. `None` without an IMU.
    pub fn inflation(&self, h: f64) -> Option<NavCovariance> {
        const BIAS_CHANGE: f64 = 3.0;
        if self.model != MotionModel::Inertial {
            return None;
        }
        let mut in_gap = self.noise;
        in_gap.set_imu_gap(true);
        let mut covariance = added_covariance(&in_gap, h);
        for (start, sd) in
            [(block::GYRO_BIAS, self.gyro_bias_sd), (block::ACCEL_BIAS, self.accel_bias_sd)]
        {
            (start..start + 3).for_each(|k| covariance[(k, k)] += (BIAS_CHANGE * sd).powi(2));
        }
        Some(covariance)
    }

    fn step(
        &self,
        belief: &mut Belief,
        gyro: &Vector3<f64>,
        accel: &Vector3<f64>,
        h: f64,
    ) -> NavCovariance {
        let state = &mut belief.state;
        let turn = (gyro - state.gyro_bias) * h;
        let force = accel - state.accel_bias;
        let start = state.world_from_body.rotation.to_rotation_matrix();
        let middle = *(start * so3::exp(&(turn * 0.5))).matrix();
        let acceleration = middle * force + self.gravity;

        let transition = transition(&middle, &turn, &force, h);
        belief.covariance = transition * belief.covariance * transition.transpose()
            + added_covariance(&self.noise, h);
        symmetrize(&mut belief.covariance);

        let position = state.world_from_body.translation.vector
            + state.velocity * h
            + acceleration * (0.5 * h * h);
        let rotation = state.world_from_body.rotation * UnitQuaternion::from_scaled_axis(turn);
        state.velocity += acceleration * h;
        state.world_from_body = Isometry3::from_parts(
            Translation3::from(position),
            UnitQuaternion::new_normalize(rotation.into_inner()),
        );
        transition
    }
}

/// Covariance of the error that the white noises add over a step of `h` seconds.
fn added_covariance(noise: &DrivingNoise, h: f64) -> NavCovariance {
    let mut q = NavCovariance::zeros();
    let white = noise.white();
    let (gyro, accel) = (white.gyro.powi(2), white.accel.powi(2));
    let walk = noise.gyro_bias_walk.powi(2);
    for k in 0..3 {
        let mut add = |row: usize, column: usize, value: f64| {
            q[(row + k, column + k)] += value;
            if row != column {
                q[(column + k, row + k)] += value;
            }
        };
        add(block::ROTATION, block::ROTATION, gyro * h + walk * h.powi(3) / 3.0);
        add(block::ROTATION, block::GYRO_BIAS, -walk * h * h / 2.0);
        add(block::GYRO_BIAS, block::GYRO_BIAS, walk * h);
        add(block::VELOCITY, block::VELOCITY, accel * h);
        add(block::VELOCITY, block::POSITION, accel * h * h / 2.0);
        add(block::POSITION, block::POSITION, accel * h.powi(3) / 3.0);
        add(block::ACCEL_BIAS, block::ACCEL_BIAS, noise.accel_bias_walk.powi(2) * h);
    }
    q
}

/// Derivative of the error of [`NavCovariance`] after a step by the error before it, `middle`
/// being the attitude half-way.
fn transition(
    middle: &Matrix3<f64>,
    turn: &Vector3<f64>,
    force: &Vector3<f64>,
    h: f64,
) -> NavCovariance {
    let mut f = NavCovariance::identity();
    let mut set = |row: usize, column: usize, value: Matrix3<f64>| {
        f.fixed_view_mut::<3, 3>(row, column).copy_from(&value);
    };
    // Half-way the rotation error is `exp(-turn/2) e - (h/2) J_r(turn/2) db`.
    let by_middle = -(middle * so3::hat(force));
    let by_rotation = by_middle * so3::exp(&(turn * -0.5)).matrix();
    let by_gyro_bias = -by_middle * so3::right_jacobian(&(turn * 0.5)) * (0.5 * h);
    set(block::ROTATION, block::ROTATION, so3::exp(&-turn).into_inner());
    set(block::ROTATION, block::GYRO_BIAS, -so3::right_jacobian(turn) * h);
    for (row, factor) in [(block::VELOCITY, h), (block::POSITION, 0.5 * h * h)] {
        set(row, block::ROTATION, by_rotation * factor);
        set(row, block::GYRO_BIAS, by_gyro_bias * factor);
        set(row, block::ACCEL_BIAS, -middle * factor);
    }
    set(block::POSITION, block::VELOCITY, Matrix3::identity() * h);
    f
}

/// Removes the asymmetry that rounding leaves.
pub(crate) fn symmetrize<const N: usize>(matrix: &mut SMatrix<f64, N, N>) {
    for i in 0..N {
        for j in 0..i {
            let mean = 0.5 * (matrix[(i, j)] + matrix[(j, i)]);
            matrix[(i, j)] = mean;
            matrix[(j, i)] = mean;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::{ImuSample, Stamp};
    use nalgebra::SVector;
    use proptest::prelude::*;

    fn state() -> NavState {
        NavState {
            world_from_body: Isometry3::new(
                Vector3::new(1.0, 2.0, 3.0),
                Vector3::new(0.4, -0.9, 1.3),
            ),
            velocity: Vector3::new(0.5, -1.0, 0.2),
            gyro_bias: Vector3::new(0.01, -0.02, 0.03),
            accel_bias: Vector3::new(-0.1, 0.2, 0.05),
        }
    }

    fn propagator() -> Propagator {
        Propagator::inertial(&ImuConfig::default())
    }

    /// Over the interval between two samples, with the averages of both ends.
    fn propagate(
        propagator: &Propagator,
        belief: &mut Belief,
        from: &ImuSample,
        to: &ImuSample,
    ) -> bool {
        let rate = (from.angular_velocity + to.angular_velocity) * 0.5;
        let force = (from.specific_force + to.specific_force) * 0.5;
        let h = to.stamp.seconds_since(from.stamp);
        propagator.advance(belief, &rate, &force, h)
    }

    fn perturbed(state: &NavState, error: &SVector<f64, 15>) -> NavState {
        let part = |start: usize| error.fixed_rows::<3>(start).into_owned();
        let turn = UnitQuaternion::from_scaled_axis(part(block::ROTATION));
        NavState {
            world_from_body: Isometry3::from_parts(
                Translation3::from(
                    state.world_from_body.translation.vector + part(block::POSITION),
                ),
                state.world_from_body.rotation * turn,
            ),
            velocity: state.velocity + part(block::VELOCITY),
            gyro_bias: state.gyro_bias + part(block::GYRO_BIAS),
            accel_bias: state.accel_bias + part(block::ACCEL_BIAS),
        }
    }

    fn error(from: &NavState, to: &NavState) -> SVector<f64, 15> {
        let mut error = SVector::<f64, 15>::zeros();
        let mut set =
            |start, value: Vector3<f64>| error.fixed_rows_mut::<3>(start).copy_from(&value);
        let turn = from.world_from_body.rotation.inverse() * to.world_from_body.rotation;
        set(block::ROTATION, turn.scaled_axis());
        set(block::VELOCITY, to.velocity - from.velocity);
        let position = |state: &NavState| state.world_from_body.translation.vector;
        set(block::POSITION, position(to) - position(from));
        set(block::GYRO_BIAS, to.gyro_bias - from.gyro_bias);
        set(block::ACCEL_BIAS, to.accel_bias - from.accel_bias);
        error
    }

    fn stepped(state: NavState, rate: &Vector3<f64>, force: &Vector3<f64>, h: f64) -> NavState {
        let mut belief = Belief { state, covariance: NavCovariance::zeros() };
        propagator().step(&mut belief, rate, force, h);
        belief.state
    }

    proptest! {
        #[test]
        fn the_transition_is_the_derivative_of_the_step(
            rate in [-6.0..6.0f64, -6.0..6.0, -6.0..6.0], force in [-20.0..20.0f64, -20.0..20.0, -20.0..20.0],
            h in 0.001..0.05f64,
        ) {
            let (rate, force) = (Vector3::from(rate), Vector3::from(force));
            let start = state();
            let turn = (rate - start.gyro_bias) * h;
            let middle = *(start.world_from_body.rotation.to_rotation_matrix()
                * so3::exp(&(turn * 0.5))).matrix();
            let analytic = transition(&middle, &turn, &(force - start.accel_bias), h);
            let step = 1e-6;
            for k in 0..15 {
                let mut delta = SVector::<f64, 15>::zeros();
                delta[k] = step;
                let (plus, minus) = (perturbed(&start, &delta), perturbed(&start, &-delta));
                let column = error(
                    &stepped(minus, &rate, &force, h),
                    &stepped(plus, &rate, &force, h),
                ) / (2.0 * step);
                prop_assert!((column - analytic.column(k)).norm() < 1e-7, "column {k}");
            }
        }
    }

    #[test]
    fn a_body_at_rest_stays_and_a_falling_one_falls() {
        let rest = NavState {
            world_from_body: Isometry3::identity(),
            velocity: Vector3::zeros(),
            gyro_bias: Vector3::zeros(),
            accel_bias: Vector3::zeros(),
        };
        let felt = Vector3::new(0.0, 0.0, ImuConfig::default().gravity);
        let still = stepped(rest, &Vector3::zeros(), &felt, 0.1);
        assert!(error(&rest, &still).norm() < 1e-12);
        let falling = stepped(rest, &Vector3::zeros(), &Vector3::zeros(), 0.1);
        assert!((falling.velocity.z + 0.1 * felt.z).abs() < 1e-12);
    }

    #[test]
    fn samples_without_a_finite_outcome_change_nothing() {
        let before = Belief { state: state(), covariance: NavCovariance::identity() };
        let sample = |nanos, rate| ImuSample {
            stamp: Stamp::from_nanos(nanos),
            angular_velocity: Vector3::repeat(rate),
            specific_force: Vector3::zeros(),
        };
        let mut belief = before;
        for rate in [f64::NAN, f64::INFINITY, 1e308] {
            let moved = propagate(&propagator(), &mut belief, &sample(0, rate), &sample(9, rate));
            assert!(!moved && belief == before, "{rate}");
        }
    }

    #[test]
    fn a_gap_costs_certainty() {
        let start = Belief { state: state(), covariance: NavCovariance::zeros() };
        let sample = |nanos| ImuSample {
            stamp: Stamp::from_nanos(nanos),
            angular_velocity: Vector3::zeros(),
            specific_force: Vector3::zeros(),
        };
        let spread = |in_gap| {
            let (mut propagator, mut belief) = (propagator(), start);
            propagator.set_imu_gap(in_gap);
            assert!(propagate(&propagator, &mut belief, &sample(0), &sample(500_000_000)));
            belief.covariance
        };
        let (measured, missed) = (spread(false), spread(true));
        for k in 0..9 {
            assert!(missed[(k, k)] > 100.0 * measured[(k, k)], "{k}");
        }
    }

    #[test]
    fn noise_adds_up_whatever_the_step() {
        let quiet = Belief { state: state(), covariance: NavCovariance::zeros() };
        let sample = |nanos| ImuSample {
            stamp: Stamp::from_nanos(nanos),
            angular_velocity: quiet.state.gyro_bias,
            specific_force: Vector3::new(0.0, 0.0, 9.8),
        };
        let run = |steps: i64| {
            let mut belief = quiet;
            let length = 200_000_000 / steps;
            for k in 0..steps {
                propagate(
                    &propagator(),
                    &mut belief,
                    &sample(k * length),
                    &sample((k + 1) * length),
                );
            }
            belief.covariance
        };
        let (coarse, fine) = (run(20), run(200));
        for k in 0..15 {
            assert!((coarse[(k, k)] / fine[(k, k)] - 1.0).abs() < 0.02, "{k}");
        }
    }
}
