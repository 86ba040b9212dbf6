use super::state::NAVIGATION;
use super::*;
use crate::filter::FilterKind;
use crate::inertial::{ImuConfig, NavState, attitude_from_gravity};
use crate::sensor::{ImuSample, Stamp};
use approx::assert_relative_eq;
use nalgebra::{DMatrix, Point3, SVector, Translation3, UnitQuaternion};
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

fn seen(id: u64, in_body: Vector3<f64>, body_covariance: Matrix3<f64>) -> PointObservation {
    PointObservation { id, in_body, body_covariance }
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
                let covariance =
                    axes.matrix() * Matrix3::from_diagonal(&variances) * axes.matrix().transpose();
                seen(id as u64, in_body + noise, covariance)
            })
            .collect();
        let state = filter.point_state_mut().unwrap();
        if round == 0 {
            assert!(points.iter().all(|point| state.admit(point)));
        } else {
            assert!(state.update_state_points(&points).is_ok());
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
            assert!(mfgs.calibrate(&uncertain_calibration()).is_ok());
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
    assert!(mfgs.propagate(&InertialStep::between(&sample(0), &sample(1000))).is_ok());
    let before = *mfgs.belief();
    mfgs.point_state_mut().unwrap().add_stamp_jitter(0.002);
    let added = mfgs.belief().covariance - before.covariance;
    assert!(mfgs.propagate(&InertialStep::between(&sample(0), &sample(1_000_000))).is_ok());
    let (from, to) = (before.state.world_from_body, mfgs.belief().state.world_from_body);
    let turn = from.rotation.rotation_to(&to.rotation);
    let turn = (from.rotation.inverse() * turn * from.rotation).scaled_axis() * 2.0;
    let shift = (to.translation.vector - from.translation.vector) * 2.0;
    let expected = turn * turn.transpose();
    assert_relative_eq!(added.fixed_view::<3, 3>(0, 0).into_owned(), expected, max_relative = 0.01);
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
    let state = mfgs.point_state_mut().unwrap();
    assert!((0..).zip(&places).all(|(id, place)| state.admit(&seen(id, *place, noise))));
    // The matches were a degree and some centimetres off.
    let found = way * Isometry3::new(Vector3::repeat(0.03), Vector3::repeat(0.01));
    state.reset_pose(&found, &PoseSpread { turn: 0.2, shift: 0.5, velocity: 1.0 });
    let again: Vec<_> = (0..)
        .zip(&places)
        .map(|(id, place)| seen(id, way.inverse_transform_point(&(*place).into()).coords, noise))
        .collect();
    let outcome = state.update_state_points(&again).unwrap();
    assert!(outcome.points == 20 && outcome.nis < 1.0, "{outcome:?}");
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
        let mut measure = |t: f64| -> Vec<PointObservation> {
            let see = |(id, l)| seen(id, turn(t).inverse() * l + normal(&mut rng) * 0.005, noise);
            (0..).zip(&landmarks).map(see).collect()
        };
        for point in measure(0.0) {
            assert!(mfgs.point_state_mut().unwrap().admit(&point));
        }
        let mut tilts = Vec::new();
        for frame in 0..60 {
            let t = |step: usize| (frame * 10 + step) as f64 * 0.005;
            for step in 0..10 {
                assert!(
                    mfgs.propagate(&InertialStep::between(&sample(t(step)), &sample(t(step + 1))))
                        .is_ok()
                );
            }
            assert!(mfgs.point_state_mut().unwrap().update_state_points(&measure(t(10))).is_ok());
            if doubts && frame == 3 {
                assert!(
                    mfgs.point_state_mut().unwrap().reopen_gravity(1.0)
                        && !mfgs.point_state_mut().unwrap().reopen_gravity(1.0)
                );
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
        let points = filter.point_state_mut().unwrap();
        for (id, in_body) in exact.iter().enumerate() {
            assert!(points.admit(&seen(id as u64, *in_body, noise)));
        }
        assert!(
            filter.propagate(&InertialStep::between(&at_rest(0), &at_rest(20_000_000))).is_ok()
        );
        let again: Vec<_> =
            again.iter().enumerate().map(|(id, p)| seen(id as u64, *p, noise)).collect();
        let points = filter.point_state_mut().unwrap();
        assert!(points.update_state_points(&again).is_ok());
        let positions: Vec<_> = (0..7).map(|id| points.estimate(id).unwrap()).collect();
        results.push((*filter.belief(), positions));
    }

    let mut moved = prior;
    let step = Propagator::inertial(&ImuConfig::default())
        .advance_with_transition(
            &mut moved,
            &at_rest(0).angular_velocity,
            &at_rest(0).specific_force,
            0.02,
        )
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
        let mut see = |truth: &NavState| -> Vec<PointObservation> {
            let noise = Matrix3::identity() * (noise_sd * noise_sd);
            let exact = |l: &Point3<f64>| truth.world_from_body.inverse_transform_point(l);
            let see = |(id, l)| {
                seen(id as u64, exact(l).coords + normal(&mut rng) * noise_sd, noise)
            };
            landmarks.iter().enumerate().map(see).collect()
        };
        for point in see(&truth) {
            mfgs.point_state_mut().unwrap().admit(&point);
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
            assert!(mfgs.propagate(&InertialStep::between(&sample(&truth, from), &sample(&truth, to))).is_ok());
            truth.world_from_body.translation.vector += truth.velocity * 0.033;
            let before = spread(mfgs.belief());
            assert!(mfgs.point_state_mut().unwrap().update_state_points(&see(&truth)).is_ok());
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
    let state = mfgs.point_state_mut().unwrap();
    assert!(points.iter().all(|point| state.admit(point)));
    mfgs.set_imu_gap(true);
    let up = prior.world_from_body.rotation.inverse() * Vector3::z();
    for frame in 0..20 {
        let sample = |k: i64| ImuSample {
            stamp: Stamp::from_nanos((frame + k) * 33_000_000),
            angular_velocity: Vector3::new(1.5, -1.0, 0.5) + prior.gyro_bias,
            specific_force: up * ImuConfig::default().gravity + prior.accel_bias,
        };
        assert!(mfgs.propagate(&InertialStep::between(&sample(0), &sample(1))).is_ok());
        assert!(mfgs.point_state_mut().unwrap().update_state_points(&points).is_ok());
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
    let points = mfgs.point_state_mut().unwrap();
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
    assert!(mfgs.point_state_mut().unwrap().admit(&point));
    let position = |f: &dyn VisualInertialFilter| f.belief().covariance;
    let before = position(mfgs.as_ref());
    let sample = |nanos| ImuSample {
        stamp: Stamp::from_nanos(nanos),
        angular_velocity: Vector3::new(0.3, -0.5, 0.2),
        specific_force: Vector3::new(0.5, 0.1, 9.8),
    };
    for k in 0..20 {
        assert!(
            mfgs.propagate(&InertialStep::between(
                &sample(k * 5_000_000),
                &sample((k + 1) * 5_000_000)
            ))
            .is_ok()
        );
    }
    assert!((position(mfgs.as_ref()) - before).norm() > 1e-3);
    // Measured very precisely, the point fixes the body relative to it: the spread of the
    // position that is left is that of the point and of the lever to it.
    let point = mfgs.point_state_mut().unwrap().estimate(0).unwrap().position;
    let exact = mfgs.belief().state.world_from_body.inverse_transform_point(&point.into());
    let again = seen(0, exact.coords, Matrix3::identity() * 1e-10);
    assert!(mfgs.point_state_mut().unwrap().update_state_points(&[again]).is_ok());
    let belief = mfgs.belief();
    let rotation = belief.state.world_from_body.rotation.to_rotation_matrix();
    let j = point_by_pose(rotation.matrix(), &exact.coords);
    let seen_spread = j * crate::inertial::pose_covariance(&belief.covariance) * j.transpose();
    let spread = mfgs.point_state_mut().unwrap().estimate(0).unwrap().covariance;
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
    assert!(mfgs.calibrate(&calibration).is_ok() && mfgs.calibrate(&calibration).is_err());
    measure_without_moving(mfgs.as_mut(), &Vector3::repeat(0.02), &mut rng);
    let after = mfgs.calibration().unwrap();
    let change = (after.covariance - calibration.covariance).norm();
    assert!(change < 1e-9 * calibration.covariance.norm(), "{change}");
    let (before, after) = (calibration.body_from_camera, after.body_from_camera);
    assert!(before.rotation.angle_to(&after.rotation) < 1e-9);
    assert!((before.translation.vector - after.translation.vector).norm() < 1e-9);
    assert!(filter(FilterKind::Mfgr, prior).calibrate(&calibration).is_err());
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
        assert!(filter.calibrate(&prior).is_ok());
        let in_camera: Vec<_> =
            (0..25).map(|_| vector(&mut rng, 1.5) + Vector3::new(0.0, 0.0, 2.5)).collect();
        let noise = Matrix3::identity() * 0.01f64.powi(2);
        let mut last = sample(0, &mut rng);
        for frame in 0..90 {
            for step in 1..=7 {
                let next = sample(7 * frame + step, &mut rng);
                assert!(filter.propagate(&InertialStep::between(&last, &next)).is_ok());
                last = next;
            }
            let mounting = filter.calibration().unwrap().body_from_camera;
            let see = |(id, exact): (usize, &Vector3<f64>), rng: &mut ChaCha8Rng| {
                let point = mounting * Point3::from(exact + normal(rng) * 0.01);
                seen(id as u64, point.coords, noise)
            };
            let points: Vec<_> = in_camera.iter().enumerate().map(|p| see(p, &mut rng)).collect();
            let state = filter.point_state_mut().unwrap();
            match frame {
                0 => assert!(points.iter().all(|point| state.admit(point))),
                _ => assert!(state.update_state_points(&points).is_ok()),
            }
            let rest = ZeroVelocity { rate: Vector3::zeros(), velocity_sd: 0.02, rate_sd: 0.02 };
            assert!(frame < 30 || filter.update_zero_velocity(&rest).is_ok());
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
        let points = filter.point_state_mut().unwrap();
        let good = seen(0, Vector3::x(), Matrix3::identity());
        for bad in [f64::NAN, f64::INFINITY] {
            assert!(!points.admit(&seen(1, Vector3::repeat(bad), Matrix3::identity())));
            assert!(!points.admit(&seen(1, Vector3::x(), Matrix3::repeat(bad))));
        }
        assert!(points.admit(&good) && !points.admit(&good));
        for bad in [f64::NAN, f64::INFINITY, 1e300] {
            let _ =
                points.update_state_points(&[seen(0, Vector3::repeat(bad), Matrix3::identity())]);
            let _ = points.update_state_points(&[seen(0, Vector3::x(), Matrix3::repeat(bad))]);
        }
        assert!(points.update_state_points(&[]).is_err());
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
        let acceleration =
            |t: f64| Vector3::new(1.5 * (4.0 * t).cos(), 2.0 * (5.0 * t).sin(), (3.0 * t).cos());
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
        let known = crate::filter::KnownAttitude::Nothing { gravity };
        let mut filter = FilterKind::Mfgs.start_knowing(
            known,
            &FilterConfig::default(),
            Propagator::inertial(&ImuConfig::default()),
            Belief { state, covariance },
        );
        assert_eq!(filter.matrix_fisher().map(|f| f.s), Some(Vector3::zeros()));
        let landmarks: Vec<_> = (0..15).map(|_| vector(&mut rng, 3.0)).collect();
        let measure = |t: f64, rng: &mut ChaCha8Rng| -> Vec<PointObservation> {
            let exact = |l: &Vector3<f64>| body(t).inverse() * (l - place(t));
            let noise = Matrix3::identity() * 0.005f64.powi(2);
            let see = |(id, l)| seen(id as u64, exact(l) + normal(rng) * 0.005, noise);
            landmarks.iter().enumerate().map(see).collect()
        };
        for point in measure(0.0, &mut rng) {
            assert!(filter.point_state_mut().unwrap().admit(&point));
        }
        let mut kappa = 0.0;
        for frame in 0..30 {
            let t = |step: usize| (frame * 10 + step) as f64 * 0.005;
            for step in 0..10 {
                assert!(
                    filter
                        .propagate(&InertialStep::between(&sample(t(step)), &sample(t(step + 1))))
                        .is_ok()
                );
            }
            let points = measure(t(10), &mut rng);
            assert!(filter.point_state_mut().unwrap().update_state_points(&points).is_ok());
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
    Vector3::new(1.5 / 4.0 * (4.0 * t).sin(), -2.0 / 5.0 * (5.0 * t).cos(), (3.0 * t).sin() / 3.0)
}
