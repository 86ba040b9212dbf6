//! Costs of a visual-inertial step, with a 3x3 singular value decomposition and a weighted Kabsch
//! fit in the same run as the units: `cargo bench --bench visual --no-default-features`.

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use mfg_vio::alignment::{PointPair, WeightedPair, align, weighted_kabsch};
use mfg_vio::filter::{
    FilterConfig, FilterKind, InertialStep, MapEstimate, MountedCamera, Track, TrackUse, TrackView,
    VisualInertialFilter,
};
use mfg_vio::inertial::{Belief, ImuConfig, NavCovariance, NavState, Propagator};
use mfg_vio::sensor::{Camera, PinholeCamera};
use mfg_vio::so3::exp;
use nalgebra::{Isometry3, Matrix2, Matrix3, Point3, UnitQuaternion, Vector2, Vector3};

const POINTS: [usize; 3] = [125, 500, 2000];

fn world_from_body() -> Isometry3<f64> {
    Isometry3::new(Vector3::new(1.0, -2.0, 0.5), Vector3::new(0.3, -0.4, 1.2))
}

/// Points of an RGB-D camera: depth noise grows with the square of the depth.
fn pairs(count: usize) -> Vec<PointPair> {
    let pose = world_from_body();
    let pair = |i: usize| {
        let phase = i as f64;
        let z = 1.5 + (0.7 * phase).sin();
        let in_body = Vector3::new(0.4 * z * (1.3 * phase).sin(), 0.3 * z * phase.cos(), z);
        let noise = Vector3::new((3.0 * phase).sin(), (5.0 * phase).cos(), (7.0 * phase).sin());
        let depth_variance = (2.5e-3 * z * z).powi(2);
        let variances = Vector3::new(9e-6 * z * z, 9e-6 * z * z, depth_variance);
        PointPair {
            in_body,
            body_covariance: Matrix3::from_diagonal(&variances),
            in_world: (pose * Point3::from(in_body)).coords + noise * 3e-3,
            world_covariance: Matrix3::identity() * 1e-5,
        }
    };
    (0..count).map(pair).collect()
}

fn belief() -> Belief {
    let state = NavState {
        world_from_body: world_from_body() * Isometry3::rotation(Vector3::new(4e-3, -2e-3, 3e-3)),
        velocity: Vector3::new(0.5, 0.2, -0.1),
        gyro_bias: Vector3::zeros(),
        accel_bias: Vector3::zeros(),
    };
    Belief { state, covariance: NavCovariance::identity() * 1e-4 }
}

fn units(c: &mut Criterion) {
    let m = exp(&Vector3::new(0.3, -1.0, 2.0)).into_inner()
        * Matrix3::new(0.9, 0.1, 0.2, -0.3, 0.8, 0.1, 0.2, 0.1, 0.7);
    c.bench_function("unit/svd", |b| b.iter(|| black_box(&m).svd(true, true)));
    for count in POINTS {
        let pairs = pairs(count);
        let weighted: Vec<WeightedPair> = pairs
            .iter()
            .map(|pair| WeightedPair {
                from: pair.in_body,
                to: pair.in_world,
                weight: 3.0 / (pair.body_covariance + pair.world_covariance).trace(),
            })
            .collect();
        c.bench_with_input(BenchmarkId::new("unit/kabsch", count), &weighted, |b, weighted| {
            b.iter(|| weighted_kabsch(black_box(weighted).iter().copied()));
        });
    }
}

fn updates(c: &mut Criterion) {
    let propagator = Propagator::inertial(&ImuConfig::default());
    for kind in [FilterKind::Mfgr, FilterKind::Mekfr] {
        for count in POINTS {
            let pairs = pairs(count);
            let mut filter = kind.start(&FilterConfig::default(), propagator.clone(), belief());
            // Repeated updates let the belief settle, as that of a running filter is.
            c.bench_with_input(
                BenchmarkId::new(format!("update/{kind}"), count),
                &pairs,
                |b, pairs| b.iter(|| filter.update_map_points(black_box(pairs))),
            );
        }
    }
    for count in POINTS {
        let pairs = pairs(count);
        c.bench_with_input(BenchmarkId::new("align", count), &pairs, |b, pairs| {
            b.iter(|| align(black_box(pairs)).is_ok());
        });
    }
}

fn map(c: &mut Criterion) {
    let propagator = Propagator::inertial(&ImuConfig::default());
    let filter = FilterKind::Mfgr.start(&FilterConfig::default(), propagator, belief());
    let pairs = pairs(500);
    c.bench_function("refine/500", |b| {
        b.iter(|| {
            let refinement = filter.map_refinement();
            pairs.iter().filter_map(|pair| refinement.posterior(black_box(pair))).count()
        });
    });
}

fn propagation(c: &mut Criterion) {
    let propagator = Propagator::inertial(&ImuConfig::default());
    let interval = InertialStep {
        seconds: 0.005,
        angular_velocity: Vector3::new(0.1, -0.2, 0.3),
        specific_force: Some(Vector3::new(0.3, -0.2, 9.8)),
        angle_covariance: Matrix3::zeros(),
    };
    for kind in [FilterKind::Mfgr, FilterKind::Mekfr] {
        c.bench_function(&format!("imu-step/{kind}"), |b| {
            b.iter_batched(
                || kind.start(&FilterConfig::default(), propagator.clone(), belief()),
                |mut filter| {
                    filter.propagate(black_box(&interval)).unwrap();
                    filter
                },
                criterion::BatchSize::SmallInput,
            );
        });
    }
}

/// A camera that looks along x.
fn camera() -> MountedCamera {
    let intrinsics = PinholeCamera { fx: 450.0, fy: 450.0, cx: 320.0, cy: 240.0 };
    let axes = Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0);
    let rotation = UnitQuaternion::from_matrix(&axes);
    let body_from_camera = Isometry3::from_parts(Vector3::zeros().into(), rotation);
    MountedCamera { camera: Camera::pinhole(intrinsics), body_from_camera }
}

/// A filter with a window of poses a decimetre apart and points in its state.
fn with_window(kind: FilterKind, poses: usize, points: u64) -> Box<dyn VisualInertialFilter> {
    let propagator = Propagator::inertial(&ImuConfig::default());
    let mut filter = kind.start(&FilterConfig::default(), propagator, belief());
    for _ in 0..poses {
        for _ in 0..6 {
            let rotation = filter.belief().state.world_from_body.rotation;
            let step = InertialStep {
                seconds: 0.03,
                angular_velocity: Vector3::new(0.1, -0.2, 0.3),
                specific_force: Some(rotation.inverse() * Vector3::new(0.5, 0.3, 9.80665)),
                angle_covariance: Matrix3::zeros(),
            };
            filter.propagate(&step).unwrap();
        }
        filter.pose_window_mut().unwrap().clone_pose(0.0).unwrap();
    }
    for id in 0..points {
        let estimate = MapEstimate { position: place(id), covariance: Matrix3::identity() * 1e-3 };
        assert!(filter.point_state_mut().unwrap().admit_known(id, &estimate));
    }
    filter
}

/// In front of all poses of the window.
fn place(id: u64) -> Vector3<f64> {
    let phase = id as f64;
    let in_body = Vector3::new(4.0 + phase.sin(), (1.7 * phase).sin(), (2.3 * phase).cos());
    (world_from_body() * Point3::from(in_body)).coords
}

/// What the window's last `poses` poses see of a point, a third of a pixel off.
fn track(filter: &dyn VisualInertialFilter, id: u64, poses: usize) -> Track {
    let (window, camera) = (filter.pose_window().unwrap(), camera());
    let clones = window.clones();
    let last = clones.len() - poses;
    let views = (last..clones.len()).filter_map(|k| {
        let clone = &clones[k];
        let body = window.cloned_pose(*clone)?.world_from_body;
        let in_body = body.inverse_transform_point(&Point3::from(place(id)));
        let in_camera = camera.body_from_camera.inverse_transform_point(&in_body).coords;
        let phase = id as f64 + 1.3 * k as f64;
        let off = Vector2::new(phase.sin(), (1.7 * phase).cos());
        Some(TrackView {
            clone: *clone,
            camera: 0,
            pixel: camera.camera.project(&in_camera)? + off * 0.3,
            pixel_covariance: Matrix2::identity() * 0.1,
            depth: None,
        })
    });
    Track { id, views: views.collect(), purpose: TrackUse::Eliminate }
}

/// One update by tracks that have just ended and by the points of the state that are seen, as of a
/// frame of a running filter.
fn tracks(c: &mut Criterion) {
    let cameras = [camera()];
    for kind in [FilterKind::Mfgs, FilterKind::Iekfs, FilterKind::Mekfs] {
        for (poses, points, ended) in [(11, 0, 8), (11, 25, 6), (11, 50, 4), (20, 50, 4)] {
            let setup = || {
                let filter = with_window(kind, poses, points);
                let held = (0..points).map(|id| track(filter.as_ref(), id, 1));
                let ended = (100..100 + ended).map(|id| track(filter.as_ref(), id, 11));
                let tracks: Vec<_> = held.chain(ended).collect();
                (filter, tracks)
            };
            let name = format!("tracks/{kind}/{poses} poses, {points} points, {ended} ended");
            c.bench_function(&name, |b| {
                b.iter_batched(
                    setup,
                    |(mut filter, tracks)| {
                        let window = filter.pose_window_mut().unwrap();
                        let update = window.update_tracks(&tracks, &cameras).unwrap();
                        assert!(update.rows > 100, "{update:?}");
                        filter
                    },
                    criterion::BatchSize::LargeInput,
                );
            });
        }
    }
}

criterion_group!(visual, units, updates, map, propagation, tracks);
criterion_main!(visual);
