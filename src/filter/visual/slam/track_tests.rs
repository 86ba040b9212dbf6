//! Laws of the window and of the update by tracks.

use super::pose_clone::CLONE;
use super::triangulation::PlacedTrack;
use super::*;
use crate::filter::FilterKind;
use crate::inertial::{ImuConfig, NavState};
use crate::sensor::{Camera, CameraConfig, CameraModel, ImuSample, PinholeCamera, Stamp};
use nalgebra::{DMatrix, DVector, Matrix2, Point3, UnitQuaternion};
use proptest::prelude::*;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The filters whose state holds poses and points.
const KINDS: [FilterKind; 3] = [FilterKind::Mfgs, FilterKind::Iekfs, FilterKind::Mekfs];

fn vector(rng: &mut ChaCha8Rng, scale: f64) -> Vector3<f64> {
    Vector3::from_fn(|_, _| rng.random_range(-scale..=scale))
}

fn gravity() -> Vector3<f64> {
    Vector3::z() * ImuConfig::default().gravity
}

/// A filter of a kind from a belief, that refuses no track.
pub(super) fn filter_from(kind: FilterKind, config: &FilterConfig, belief: Belief) -> SlamFilter {
    let propagator = Propagator::inertial(&ImuConfig::default());
    let error = match kind {
        FilterKind::Mekfs => ErrorState::So3xRn,
        FilterKind::Iekfs => ErrorState::RightInvariant { density: AttitudeDensity::Gaussian },
        _ => ErrorState::RightInvariant { density: AttitudeDensity::MatrixFisher },
    };
    SlamFilter::new(kind, config, error, propagator, belief)
}

/// A filter with a window of `poses` poses, 0.2 s apart on a curve, and every correlation.
fn with_window(kind: FilterKind, seed: u64, poses: usize, spread: f64) -> SlamFilter {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut covariance = NavCovariance::identity() * 1e-4;
    covariance.fixed_view_mut::<3, 3>(0, 0).fill_diagonal(spread * spread);
    covariance.fixed_view_mut::<3, 3>(block::GYRO_BIAS, block::GYRO_BIAS).fill_diagonal(1e-2);
    let state = NavState {
        world_from_body: Isometry3::new(vector(&mut rng, 3.0), vector(&mut rng, 0.5)),
        velocity: vector(&mut rng, 0.6),
        gyro_bias: vector(&mut rng, 0.01),
        accel_bias: vector(&mut rng, 0.05),
    };
    let config = FilterConfig { track_false_alarm: 0.0, ..FilterConfig::default() };
    let mut filter = filter_from(kind, &config, Belief { state, covariance });
    for k in 0..poses {
        assert!(filter.clone_pose(0.0).is_ok());
        let seconds = if k + 1 < poses { 0.2 } else { 0.05 };
        propagate(&mut filter, seconds, &vector(&mut rng, 1.0), &vector(&mut rng, 1.5));
    }
    filter
}

/// Turns and accelerates the body, in its own coordinates, for a while.
fn propagate(filter: &mut SlamFilter, seconds: f64, rate: &Vector3<f64>, accel: &Vector3<f64>) {
    let steps = (seconds / 0.005).round() as i64;
    for k in 0..steps {
        let state = &filter.state.belief.state;
        let force = accel + state.world_from_body.rotation.inverse() * gravity();
        let sample = |nanos| ImuSample {
            stamp: Stamp::from_nanos(nanos),
            angular_velocity: rate + state.gyro_bias,
            specific_force: force + state.accel_bias,
        };
        let step = InertialStep::between(&sample(k * 5_000_000), &sample((k + 1) * 5_000_000));
        assert!(filter.propagate(&step).is_ok());
    }
}

/// Two cameras that look forward, the second a decimetre to the right and turned a little.
fn cameras() -> [MountedCamera; 2] {
    let intrinsics = PinholeCamera { fx: 450.0, fy: 455.0, cx: 320.0, cy: 240.0 };
    let camera = Camera::pinhole(intrinsics);
    let forward = UnitQuaternion::from_euler_angles(-1.57, 0.0, -1.57);
    let left = Isometry3::from_parts(Vector3::new(0.05, 0.03, -0.02).into(), forward);
    let right = left * Isometry3::new(Vector3::x() * 0.1, Vector3::new(0.02, -0.03, 0.01));
    [left, right].map(|body_from_camera| MountedCamera { camera, body_from_camera })
}

/// A point `range` in front of the middle of the window.
fn point_in_front(filter: &SlamFilter, rng: &mut ChaCha8Rng, range: f64) -> Vector3<f64> {
    let pose = filter.state.clones[filter.state.clones.len() / 2].world_from_body;
    let in_camera = Vector3::new(0.0, 0.0, range) + vector(rng, 0.1 * range);
    (pose * cameras()[0].body_from_camera * Point3::from(in_camera)).coords
}

/// What the poses of the window see of a point, with errors of `noise` px (and so many cm); the depth
/// where `with_depth`.
fn track(
    filter: &SlamFilter,
    id: u64,
    point: &Vector3<f64>,
    noise: f64,
    with_depth: bool,
    rng: &mut ChaCha8Rng,
) -> Track {
    let views = filter.state.clones.iter().flat_map(|clone| {
        cameras().into_iter().enumerate().map(move |(camera, mounted)| (clone, camera, mounted))
    });
    let views = views.filter_map(|(clone, camera, mounted)| {
        let from_world = (clone.world_from_body * mounted.body_from_camera).inverse();
        let in_camera = (from_world * Point3::from(*point)).coords;
        let pixel = mounted.camera.project(&in_camera)? + vector(rng, noise).xy();
        let depth = (with_depth && camera == 0).then(|| TrackDepth {
            depth: in_camera.z + 0.01 * rng.random_range(-noise..=noise),
            variance: 1e-4,
            common_variance: 4e-4,
        });
        let pixel_covariance = Matrix2::new(0.3, 0.05, 0.05, 0.2);
        Some(TrackView { clone: clone.id, camera, pixel, pixel_covariance, depth })
    });
    Track { id, views: views.collect(), purpose: TrackUse::Eliminate }
}

/// A camera of each model, with the distortion of a real one.
fn camera_of(model: CameraModel) -> Camera {
    let distortion = match model {
        CameraModel::RadialTangential => vec![-0.283, 0.0739, 0.00019, 1.76e-05],
        CameraModel::Rational => vec![0.52, -2.6, 0.0008, -0.0003, 1.4, 0.4, -2.4, 1.3],
        CameraModel::Equidistant => vec![0.0035, 0.0007, -0.0021, 0.0002],
        CameraModel::DoubleSphere => vec![-0.2996, 0.5941],
        CameraModel::Omnidirectional => vec![1.62, -0.12, 0.031, 0.0011, -0.0006],
    };
    let intrinsics =
        CameraConfig { fx: 190.98, fy: 190.97, cx: 254.93, cy: 256.9, ..CameraConfig::default() };
    Camera::new(&CameraConfig { model, distortion, ..intrinsics }).unwrap()
}

/// A calibration of a camera that is uncertain in all its parts.
fn calibration_of(mounted: &MountedCamera) -> Calibration {
    let config = FilterConfig {
        camera_rotation_sd_deg: 1.0,
        camera_translation_sd: 0.02,
        camera_time_offset_sd: 0.01,
        ..FilterConfig::default()
    };
    Calibration::prior(&config, &mounted.body_from_camera, 0.0).unwrap()
}

/// Cameras that have moved with the first one's estimated mounting.
fn moved_cameras(
    mounted: &[MountedCamera],
    before: &JointState,
    after: &JointState,
) -> Vec<MountedCamera> {
    let by = before
        .calibration
        .zip(after.calibration)
        .map_or(Isometry3::identity(), |(before, after)| {
            after.body_from_camera * before.body_from_camera.inverse()
        });
    let moved =
        |m: &MountedCamera| MountedCamera { body_from_camera: by * m.body_from_camera, ..*m };
    mounted.iter().map(moved).collect()
}

fn angle(a: &UnitQuaternion<f64>, b: &UnitQuaternion<f64>) -> f64 {
    so3::angle_between(&a.to_rotation_matrix(), &b.to_rotation_matrix())
}

fn inverse(matrix: &DMatrix<f64>) -> DMatrix<f64> {
    let scale = matrix.diagonal().map(|variance| variance.sqrt().recip());
    let scale = DMatrix::from_diagonal(&scale);
    let scaled = &scale * matrix * &scale;
    &scale * scaled.cholesky().unwrap().inverse() * &scale
}

/// The largest entry of a difference between covariances, relative to the deviations in `of`.
fn scaled(difference: &DMatrix<f64>, of: &DMatrix<f64>) -> f64 {
    let sd = of.diagonal().map(f64::sqrt);
    let relative = |(i, j): (usize, usize)| (difference[(i, j)] / (sd[i] * sd[j])).abs();
    let n = difference.ncols();
    (0..n * n).map(|k| relative((k / n, k % n))).fold(0.0, f64::max)
}

/// The same belief in a world that is turned about gravity and moved.
fn in_another_world(mut filter: SlamFilter, there: &Isometry3<f64>) -> SlamFilter {
    let state = &mut filter.state;
    state.synchronize();
    state.turn_world(&there.rotation);
    let by = there.translation.vector;
    state.belief.state.world_from_body.translation.vector += by;
    state.clones.iter_mut().for_each(|clone| clone.world_from_body.translation.vector += by);
    state.points.iter_mut().for_each(|point| point.position += by);
    filter
}

/// Every kind of update, with measurements that are far from what is expected, in a world.
fn run_every_update(kind: FilterKind, seed: u64, there: &Isometry3<f64>) -> SlamFilter {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut filter = in_another_world(with_window(kind, seed, 5, 0.02), there);
    let points = [2.0, 3.0, 5.0].map(|range| point_in_front(&filter, &mut rng, range));
    let mut tracks: Vec<_> =
        (0..3).map(|k| track(&filter, k as u64, &points[k], 3.0, k == 1, &mut rng)).collect();
    tracks[2].purpose = TrackUse::Admit;
    let update = filter.update_tracks(&tracks, &cameras()).unwrap();
    assert_eq!(update.outcomes[2], TrackOutcome::Admitted);
    propagate(&mut filter, 0.1, &vector(&mut rng, 1.0), &vector(&mut rng, 1.0));
    let rest = ZeroVelocity { rate: vector(&mut rng, 0.1), velocity_sd: 0.1, rate_sd: 0.01 };
    assert!(filter.update_zero_velocity(&rest).is_ok());
    let fresh = filter.clone_pose(0.01).unwrap();
    let mut held = track(&filter, 2, &points[2], 3.0, false, &mut rng);
    held.views.retain(|view| view.clone == fresh);
    assert!(filter.update_tracks(&[held], &cameras()).is_ok());
    let body = filter.state.belief.state.world_from_body;
    let in_body = body.inverse_transform_point(&filter.state.points[0].position.into());
    let body_covariance = Matrix3::from_diagonal(&Vector3::new(1e-4, 2e-4, 9e-4));
    let in_body = in_body.coords + vector(&mut rng, 0.01);
    let seen = PointObservation { id: 2, in_body, body_covariance };
    assert!(filter.update_state_points(&[seen]).is_ok());
    let oldest = filter.clones()[0];
    assert!(filter.drop_clone(oldest) && !filter.drop_clone(oldest));
    filter
}

/// The whole covariance, up to date.
fn covariance(filter: &SlamFilter) -> DMatrix<f64> {
    let mut state = filter.state.clone();
    state.synchronize();
    state.covariance
}

/// The state's error where body, window and points turn by `turn` about the origin and move by
/// `shift`, to first order.
fn gauge(state: &JointState, turn: &Vector3<f64>, shift: &Vector3<f64>) -> DVector<f64> {
    let mut error = DVector::zeros(state.covariance.ncols());
    let mut set = |row: usize, value: Vector3<f64>| {
        error.fixed_rows_mut::<3>(row).copy_from(&value);
    };
    let NavState { world_from_body, velocity, .. } = &state.belief.state;
    set(block::ROTATION, world_from_body.rotation.inverse() * turn);
    set(block::VELOCITY, turn.cross(velocity));
    set(block::POSITION, turn.cross(&world_from_body.translation.vector) + shift);
    for (slot, clone) in state.clones.iter().enumerate() {
        let (row, pose) = (state.row(Block::Clone(slot)), &clone.world_from_body);
        set(row, pose.rotation.inverse() * turn);
        set(row + 3, turn.cross(&pose.translation.vector) + shift);
    }
    for (slot, point) in state.points.iter().enumerate() {
        set(state.row(Block::Point(slot)), turn.cross(&point.position) + shift);
    }
    error
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    /// For every camera model: by central differences of poses, points and mounting.
    #[test]
    fn rows_are_the_derivatives_of_what_is_seen(
        seed: u64, lens in 0..CameraModel::ALL.len(), calibrates: bool,
    ) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut filter = with_window(FilterKind::Mfgs, seed, 3, 0.01);
        let mut mounted = cameras();
        mounted.iter_mut().for_each(|mounted| mounted.camera = camera_of(CameraModel::ALL[lens]));
        if calibrates {
            let calibration = calibration_of(&mounted[0]);
            assert!(filter.calibrate(&calibration).is_ok());
        }
        let point = point_in_front(&filter, &mut rng, 3.0);
        let mut track = track(&filter, 1, &point, 0.0, true, &mut rng);
        track.views.retain(|view| {
            let slot = filter.state.clone_slot(view.clone).unwrap();
            let from_world = (filter.state.clones[slot].world_from_body
                * mounted[view.camera].body_from_camera).inverse();
            mounted[view.camera].camera.project(&(from_world * Point3::from(point)).coords).is_some()
        });
        prop_assume!(track.views.len() >= 3);
        let placed = PlacedTrack::new(&track, &filter.state, &mounted, true).unwrap();
        let rows = placed.linearized(&point).unwrap();
        let residual = |state: &JointState, mounted: &[MountedCamera], point: &Vector3<f64>| {
            PlacedTrack::new(&track, state, mounted, true).unwrap().linearized(point).unwrap().residual
        };
        let step = 1e-6;
        for axis in 0..3 {
            let by = Vector3::ith(axis, step);
            let column = (residual(&filter.state, &mounted, &(point - by))
                - residual(&filter.state, &mounted, &(point + by))) / (2.0 * step);
            let expected = rows.by_point.column(axis);
            prop_assert!((&column - expected).norm() < 1e-5 * (1.0 + column.norm()), "{column} {expected}");
        }
        for column in 0..rows.jacobian.ncols() {
            let row = placed.blocks()[column / 3] + column % 3;
            let at = |by: f64| {
                let mut change = DVector::zeros(filter.state.covariance.ncols());
                change[row] = by;
                let mut state = filter.state.clone();
                state.shift(&change);
                let moved = moved_cameras(&mounted, &filter.state, &state);
                residual(&state, &moved, &point)
            };
            let numeric = (at(-step) - at(step)) / (2.0 * step);
            let expected = rows.jacobian.column(column);
            prop_assert!(
                (&numeric - expected).norm() < 1e-5 * (1.0 + numeric.norm()),
                "row {row}: {numeric} {expected}"
            );
        }
    }

    /// Elimination is the update with the point in a diffuse prior, of (1000 m)^2.
    #[test]
    fn elimination_is_a_point_of_which_nothing_is_known(seed: u64, with_depth: bool) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let filter = with_window(FilterKind::Iekfs, seed, 6, 0.02);
        let point = point_in_front(&filter, &mut rng, 3.0);
        let seen = track(&filter, 1, &point, 0.5, with_depth, &mut rng);
        let cameras = cameras();
        let placed = PlacedTrack::new(&seen, &filter.state, &cameras, true).unwrap();
        let found = placed.triangulate().unwrap().estimate.position;
        let rows = placed.linearized(&found).unwrap();
        let prior = covariance(&filter);
        let (n, m) = (prior.ncols(), rows.residual.len());
        let mut whole = DMatrix::zeros(m, n + 3);
        for (k, block) in placed.blocks().iter().enumerate() {
            whole.columns_mut(*block, 3).copy_from(&rows.jacobian.columns(3 * k, 3));
        }
        whole.columns_mut(n, 3).copy_from(&rows.by_point);
        let mut information = DMatrix::identity(n + 3, n + 3) * 1e-6;
        information.view_mut((0, 0), (n, n)).copy_from(&inverse(&prior));
        information += whole.transpose() * &whole;
        let joint = inverse(&information);
        let expected_change = (&joint * whole.transpose() * &rows.residual).rows(0, n).into_owned();
        let expected = joint.view((0, 0), (n, n)).into_owned();

        let rest = rows.eliminate(placed.blocks()).unwrap().rest;
        let mut h = DMatrix::zeros(rest.len(), n);
        for (k, block) in rest.blocks.iter().enumerate() {
            h.columns_mut(*block, 3).copy_from(&rest.jacobian.columns(3 * k, 3));
        }
        let posterior = inverse(&(inverse(&prior) + h.transpose() * &h));
        let change = &posterior * h.transpose() * &rest.residual;
        let off = scaled(&(&posterior - &expected), &prior);
        prop_assert!(off < 1e-6, "{off}");
        prop_assert!((&change - &expected_change).norm() < 1e-6 * expected_change.norm().max(1e-6));
    }

    /// Elimination, and admission of the point followed by its marginalisation, are the same.
    #[test]
    fn elimination_is_admission_and_marginalisation(seed: u64, with_depth: bool, kind in 0usize..3) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let filter = with_window(KINDS[kind], seed, 6, 0.02);
        let point = point_in_front(&filter, &mut rng, 3.0);
        let seen = track(&filter, 7, &point, 0.3, with_depth, &mut rng);
        let (mut eliminating, mut admitting) = (filter.clone(), filter);
        eliminating.config.relinearizations = 0;
        admitting.config.relinearizations = 0;
        let outcome = eliminating.update_tracks(std::slice::from_ref(&seen), &cameras()).unwrap();
        prop_assert!(matches!(outcome.outcomes[0], TrackOutcome::Used { .. }), "{outcome:?}");
        let long = Track { purpose: TrackUse::Admit, ..seen };
        let outcome = admitting.update_tracks(&[long], &cameras()).unwrap();
        prop_assert_eq!(outcome.outcomes[0], TrackOutcome::Admitted);
        prop_assert!(admitting.release(7));
        let (a, b) = (covariance(&eliminating), covariance(&admitting));
        let off = scaled(&(&a - &b), &a);
        prop_assert!(off < 1e-9, "{off}");
        let (a, b) = (eliminating.belief().state, admitting.belief().state);
        prop_assert!(angle(&a.world_from_body.rotation, &b.world_from_body.rotation) < 1e-9);
        prop_assert!((a.velocity - b.velocity).norm() < 1e-9);
    }

    /// In another world, turned about gravity and moved, everything is the same but turned and moved.
    #[test]
    fn no_update_depends_on_heading_and_place(seed: u64, kind in 0usize..3, heading in -3.0..3.0f64) {
        let there = Isometry3::new(Vector3::new(4.0, -7.0, 2.0), Vector3::z() * heading);
        let here = run_every_update(KINDS[kind], seed, &Isometry3::identity());
        let moved = run_every_update(KINDS[kind], seed, &there);
        let (a, b) = (here.belief().state, moved.belief().state);
        let expected = there * a.world_from_body;
        let turned = angle(&expected.rotation, &b.world_from_body.rotation);
        prop_assert!(turned < 1e-9, "{turned}");
        prop_assert!((expected.translation.vector - b.world_from_body.translation.vector).norm() < 1e-9);
        prop_assert!((there.rotation * a.velocity - b.velocity).norm() < 1e-9);
        let (turned, b) = (covariance(&in_another_world(here, &there)), covariance(&moved));
        let off = scaled(&(&turned - &b), &b);
        prop_assert!(off < 1e-9, "{off}");
    }

    /// No update says anything of a turn about gravity and of a shift, at any linearisation point: its
    /// rows change nothing along them.
    #[test]
    fn no_rows_see_a_common_turn_or_shift(seed: u64, kind in 0usize..2, with_depth: bool) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut filter = with_window(KINDS[kind], seed, 6, 0.1);
        let point = point_in_front(&filter, &mut rng, 3.0);
        let long = track(&filter, 3, &point, 0.3, with_depth, &mut rng);
        let outcome = filter
            .update_tracks(&[Track { purpose: TrackUse::Admit, ..long }], &cameras())
            .unwrap();
        prop_assert_eq!(outcome.outcomes[0], TrackOutcome::Admitted);
        propagate(&mut filter, 0.2, &vector(&mut rng, 1.0), &vector(&mut rng, 1.0));
        assert!(filter.clone_pose(0.0).is_ok());
        propagate(&mut filter, 0.05, &vector(&mut rng, 1.0), &vector(&mut rng, 1.0));
        let other = point_in_front(&filter, &mut rng, 2.0);
        let fresh = filter.clones()[6];
        let mut held = track(&filter, 3, &point, 3.0, false, &mut rng);
        held.views.retain(|view| view.clone == fresh);
        let short = track(&filter, 4, &other, 3.0, with_depth, &mut rng);
        let rest = ZeroVelocity { rate: vector(&mut rng, 0.1), velocity_sd: 0.1, rate_sd: 0.01 };
        for (turn, shift) in [(Vector3::z(), Vector3::zeros()), (Vector3::zeros(), vector(&mut rng, 1.0))] {
            let mut filter = filter.clone();
            let known = |filter: &SlamFilter| {
                information(&covariance(filter), &gauge(&filter.state, &turn, &shift))
            };
            let before = known(&filter);
            for track in [&held, &short] {
                assert!(filter.update_tracks(std::slice::from_ref(track), &cameras()).is_ok());
                let change = known(&filter) / before - 1.0;
                prop_assert!(change.abs() < 1e-9, "track {}: {change:e}", track.id);
            }
            assert!(filter.update_zero_velocity(&rest).is_ok());
            let change = known(&filter) / before - 1.0;
            prop_assert!(change.abs() < 1e-9, "standing still: {change:e}");
        }
    }
}

/// Information along a vector, `v^T P^-1 v`.
fn information(covariance: &DMatrix<f64>, along: &DVector<f64>) -> f64 {
    let scale = covariance.diagonal().map(|variance| variance.sqrt().recip());
    let scaled = DMatrix::from_diagonal(&scale) * covariance * DMatrix::from_diagonal(&scale);
    let along = scale.component_mul(along);
    scaled.cholesky().unwrap().l().solve_lower_triangular(&along).unwrap().norm_squared()
}

/// With a heading known to half a radian, thirty updates by tracks say nothing of it. The textbook's
/// reset of the covariance by the left Jacobian of each pose's own correction does.
#[test]
fn updates_say_nothing_of_the_heading_but_the_naive_reset_does() {
    for kind in [FilterKind::Iekfs, FilterKind::Mfgs] {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        let mut filter = with_window(kind, 11, 6, 0.5);
        let turn = Vector3::z();
        let (mut worst, mut reset) = (0.0f64, 1.0);
        for id in 0..30 {
            propagate(&mut filter, 0.1, &vector(&mut rng, 1.0), &vector(&mut rng, 1.0));
            assert!(filter.clone_pose(0.0).is_ok());
            propagate(&mut filter, 0.05, &vector(&mut rng, 1.0), &vector(&mut rng, 1.0));
            let oldest = filter.clones()[0];
            filter.drop_clone(oldest);
            let range = rng.random_range(1.0..5.0);
            let point = point_in_front(&filter, &mut rng, range);
            let drifting = in_drift(filter.clone(), &vector(&mut rng, 0.02));
            let seen = track(&drifting, id, &point, 1.0, false, &mut rng);
            let before = filter.state.clone();
            let update = filter.update_tracks(&[seen], &cameras()).unwrap();
            assert!(update.rows > 0, "{update:?}");
            let none = Vector3::zeros();
            let mut state = before.clone();
            state.synchronize();
            let first = information(&state.covariance, &gauge(&state, &turn, &none));
            let along = gauge(&filter.state, &turn, &none);
            let last = information(&filter.state.covariance, &along);
            worst = worst.max((last / first - 1.0).abs());
            reset *= information(&naively_reset(&before, &filter.state), &along) / first;
        }
        assert!(worst < 1e-9, "{kind}: {worst}");
        assert!(reset > 1.1, "{kind}: {reset}");
    }
}

/// The window where each pose is turned by so much more than the one before it.
fn in_drift(mut filter: SlamFilter, drift: &Vector3<f64>) -> SlamFilter {
    for (k, clone) in filter.state.clones.iter_mut().enumerate() {
        clone.world_from_body.rotation *= UnitQuaternion::new(drift * k as f64);
    }
    filter
}

/// What the covariance after an update would be if each pose's rotation error were moved to its new
/// mean by the left Jacobian of its own correction.
fn naively_reset(before: &JointState, after: &JointState) -> DMatrix<f64> {
    let mut covariance = after.covariance.clone();
    let mut reset = |row: usize, from: &Isometry3<f64>, to: &Isometry3<f64>| {
        let correction = (to.rotation * from.rotation.inverse()).scaled_axis();
        let rotation = to.rotation.to_rotation_matrix();
        let by =
            rotation.matrix().transpose() * so3::left_jacobian(&correction) * rotation.matrix();
        let rows = by * covariance.fixed_rows::<3>(row);
        covariance.fixed_rows_mut::<3>(row).copy_from(&rows);
        let columns = covariance.fixed_columns::<3>(row) * by.transpose();
        covariance.fixed_columns_mut::<3>(row).copy_from(&columns);
    };
    let pose = |state: &JointState| state.belief.state.world_from_body;
    reset(0, &pose(before), &pose(after));
    for (slot, (from, to)) in before.clones.iter().zip(&after.clones).enumerate() {
        let row = after.row(Block::Clone(slot));
        reset(row, &from.world_from_body, &to.world_from_body);
    }
    covariance
}

#[test]
fn a_row_is_used_once() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut filter = with_window(FilterKind::Mfgs, 3, 5, 0.02);
    let point = point_in_front(&filter, &mut rng, 3.0);
    let seen = track(&filter, 1, &point, 0.3, false, &mut rng);
    let refused = |update: &TrackUpdate, k: usize| match update.outcomes[k] {
        TrackOutcome::Refused(error) => Some(error),
        _ => None,
    };
    let twice = Some(FilterError::RowUsedTwice { track: 1, clone: 0 });
    // Twice in a call, twice in a track, in two calls.
    let update = filter.update_tracks(&[seen.clone(), seen.clone()], &cameras()).unwrap();
    assert!(matches!(update.outcomes[0], TrackOutcome::Used { .. }));
    assert_eq!(refused(&update, 1), twice);
    let (before, known) = (*filter.belief(), covariance(&filter));
    let one = Track { views: vec![seen.views[2], seen.views[0], seen.views[3]], ..seen.clone() };
    let update = filter.update_tracks(&[seen.clone(), one], &cameras()).unwrap();
    assert_eq!(refused(&update, 0), twice);
    assert_eq!(refused(&update, 1), Some(FilterError::RowUsedTwice { track: 1, clone: 1 }));
    let other = Track { id: 2, views: vec![seen.views[0]; 3], ..seen.clone() };
    let update = filter.update_tracks(&[other], &cameras()).unwrap();
    assert_eq!(refused(&update, 0), Some(FilterError::RowUsedTwice { track: 2, clone: 0 }));
    assert_eq!(update.rows, 0);
    // Another point at the same poses is new, and a pose that has left can no longer be used.
    let fresh = Track { id: 2, ..seen.clone() };
    assert!(filter.drop_clone(CloneId(0)));
    let update = filter.update_tracks(std::slice::from_ref(&fresh), &cameras()).unwrap();
    assert_eq!(refused(&update, 0), Some(FilterError::UnknownClone(0)));
    assert_eq!((*filter.belief(), covariance(&filter).ncols() + CLONE), (before, known.ncols()));
    let views = fresh.views.iter().filter(|view| view.clone != CloneId(0)).copied().collect();
    let update = filter.update_tracks(&[Track { views, ..fresh }], &cameras()).unwrap();
    assert!(matches!(update.outcomes[0], TrackOutcome::Used { .. }), "{update:?}");
}

/// The rows of one update are limited; the rest waits, and is as good in the next.
#[test]
fn rows_beyond_the_limit_wait() {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut filter = with_window(FilterKind::Mfgs, 5, 6, 0.02);
    filter.config.track_rows = 60;
    let tracks: Vec<_> = (0..6)
        .map(|id| {
            let point = point_in_front(&filter, &mut rng, 3.0);
            track(&filter, id, &point, 0.3, false, &mut rng)
        })
        .collect();
    let update = filter.update_tracks(&tracks, &cameras()).unwrap();
    let waiting: Vec<_> = tracks
        .iter()
        .zip(&update.outcomes)
        .filter(|(_, outcome)| **outcome == TrackOutcome::Deferred)
        .map(|(track, _)| track.clone())
        .collect();
    assert!(update.rows <= 60 && !waiting.is_empty(), "{update:?}");
    let update = filter.update_tracks(&waiting, &cameras()).unwrap();
    assert!(matches!(update.outcomes[0], TrackOutcome::Used { .. }), "{update:?}");
}

/// A clone is a copy: it has the errors of the body, completely correlated, and stays when the body
/// moves on.
#[test]
fn a_clone_is_a_copy() {
    for kind in KINDS {
        let mut filter = with_window(kind, 7, 2, 0.05);
        let belief = *filter.belief();
        assert_eq!(filter.clone_pose(0.0), Ok(CloneId(2)));
        let state = &filter.state;
        let clone = &state.clones[2];
        let pose = belief.state.world_from_body;
        assert!(angle(&clone.world_from_body.rotation, &pose.rotation) < 1e-12);
        assert_eq!(clone.world_from_body.translation, pose.translation);
        let row = state.row(Block::Clone(2));
        for (own, of_clone) in [(block::ROTATION, row), (block::POSITION, row + 3)] {
            for (a, b) in [(own, own), (own, of_clone), (of_clone, of_clone)] {
                let a = state.covariance.fixed_view::<3, 3>(own, own)
                    - state.covariance.fixed_view::<3, 3>(a, b);
                assert!(a.norm() < 1e-15, "{a}");
            }
        }
        let before = filter.cloned_pose(CloneId(2)).unwrap();
        propagate(&mut filter, 0.3, &Vector3::x(), &Vector3::y());
        assert_eq!(filter.cloned_pose(CloneId(2)).unwrap(), before);
    }
}

/// A pose of another time is that of the body, propagated there.
#[test]
fn a_clone_of_another_time_is_moved_in_its_body() {
    let filter = with_window(FilterKind::Mfgs, 9, 1, 0.05);
    let later = 0.005;
    let (mut moved, mut cloned) = (filter.clone(), filter);
    let (rate, none) = (Vector3::new(0.8, -0.5, 1.1), Vector3::zeros());
    propagate(&mut cloned, 0.005, &rate, &none);
    let at = cloned.clone_pose(later).unwrap();
    propagate(&mut moved, 0.01, &rate, &none);
    let (a, b) = (cloned.cloned_pose(at).unwrap(), moved.belief().state.world_from_body);
    assert!(angle(&a.world_from_body.rotation, &b.rotation) < 1e-9);
    assert!((a.world_from_body.translation.vector - b.translation.vector).norm() < 1e-6);
    let expected = crate::inertial::pose_covariance(&moved.belief().covariance);
    assert!((a.covariance - expected).norm() < 1e-2 * expected.norm());
}

/// Rubbish is refused and changes nothing.
#[test]
fn nothing_that_is_not_finite_enters() {
    let mut rng = ChaCha8Rng::seed_from_u64(13);
    for kind in KINDS {
        let mut filter = with_window(kind, 13, 4, 0.02);
        let point = point_in_front(&filter, &mut rng, 3.0);
        let good = track(&filter, 1, &point, 0.3, true, &mut rng);
        let before = covariance(&filter);
        let spoilt = |spoil: &dyn Fn(&mut TrackView)| {
            let mut track = good.clone();
            spoil(&mut track.views[2]);
            track
        };
        let mut bad = vec![Track { views: Vec::new(), ..good.clone() }];
        bad.push(Track { views: good.views[1..2].to_vec(), ..good.clone() });
        bad.push(spoilt(&|view| view.camera = 2));
        for value in [f64::NAN, f64::INFINITY, -f64::INFINITY, 1e300] {
            bad.push(spoilt(&|view| view.pixel.x = value));
            bad.push(spoilt(&|view| view.depth.as_mut().unwrap().depth = value));
            if value != 1e300 {
                bad.push(spoilt(&|view| view.pixel_covariance = Matrix2::repeat(value)));
                bad.push(spoilt(&|view| view.depth.as_mut().unwrap().variance = value));
                bad.push(spoilt(&|view| view.depth.as_mut().unwrap().common_variance = value));
            }
        }
        bad.push(spoilt(&|view| view.depth.as_mut().unwrap().variance = -1.0));
        filter.config.track_false_alarm = 1e-3;
        filter.track_gate = TrackGate::new(1e-3);
        for track in bad {
            let update = filter.update_tracks(std::slice::from_ref(&track), &cameras()).unwrap();
            assert!(
                matches!(update.outcomes[0], TrackOutcome::Refused(_)),
                "{:?} {update:?}",
                track.views.get(2)
            );
            assert_eq!(covariance(&filter), before);
        }
        assert!(filter.update_tracks(&[], &cameras()).is_ok());
        assert_eq!(covariance(&filter), before);
    }
}

/// Depth errors that all views share are not averaged away: of `m` depths along one line the variance
/// is `sigma_b^2 + sigma_w^2 / m`.
#[test]
fn depths_that_err_alike_are_worth_one() {
    let mut rng = ChaCha8Rng::seed_from_u64(17);
    let mut filter = with_window(FilterKind::Iekfs, 17, 1, 1e-3);
    let none = Vector3::zeros();
    filter.state.belief.state.velocity = none;
    assert!(filter.drop_clone(CloneId(0)));
    for _ in 0..8 {
        assert!(filter.clone_pose(0.0).is_ok());
        propagate(&mut filter, 0.1, &none, &none);
    }
    let point = point_in_front(&filter, &mut rng, 3.0);
    let mut seen = track(&filter, 1, &point, 0.0, true, &mut rng);
    seen.views.retain(|view| view.camera == 0);
    let cameras = cameras();
    let axis = filter.state.clones[4].world_from_body.rotation
        * (cameras[0].body_from_camera.rotation * Vector3::z());
    for (white, common) in [(8e-3, 0.0), (8e-3, 20e-3)] {
        for view in &mut seen.views {
            let depth = view.depth.as_mut().unwrap();
            (depth.variance, depth.common_variance) = (white * white, common * common);
        }
        let found = filter.triangulate(&seen, &cameras).unwrap();
        let variance = axis.dot(&(found.covariance * axis));
        let expected: f64 = common * common + white * white / seen.views.len() as f64;
        assert!((variance / expected - 1.0).abs() < 1e-3, "{variance} {expected}");
    }
}

/// A gyroscope that read wrongly since the last frame: the tracks that the present pose sees show it,
/// and the pose is found again. A few wrong tracks are just refused.
#[test]
fn a_prediction_that_most_tracks_contradict_was_the_imus_fault() {
    for kind in KINDS {
        let mut rng = ChaCha8Rng::seed_from_u64(21);
        let mut filter = with_window(kind, 21, 6, 0.01);
        filter.track_gate = TrackGate::new(1e-3);
        propagate(&mut filter, 0.05, &Vector3::zeros(), &Vector3::zeros());
        assert!(filter.clone_pose(0.0).is_ok());
        let truth = filter.belief().state.world_from_body;
        let tracks: Vec<_> = (0..20)
            .map(|id| {
                let point = point_in_front(&filter, &mut rng, 3.0);
                track(&filter, id, &point, 0.3, false, &mut rng)
            })
            .collect();
        // The same with the present pose turned by three degrees.
        let off = UnitQuaternion::new(Vector3::new(0.03, -0.04, 0.02));
        filter.state.belief.state.world_from_body.rotation *= off;
        filter.state.clones[6].world_from_body.rotation *= off;
        filter.state.synchronize();
        let few = filter.clone().update_tracks(&tracks[..4], &cameras()).unwrap();
        assert!(!few.contradicted && few.improbable() == 4, "{kind}: {few:?}");
        let update = filter.update_tracks(&tracks, &cameras()).unwrap();
        assert!(update.contradicted && update.rows > 100, "{kind}: {update:?}");
        let turned = angle(&filter.belief().state.world_from_body.rotation, &truth.rotation);
        assert!(turned < 0.01, "{kind}: {turned}");
    }
}
