//! Steps that run at the rate of the sensors do not allocate.

#[path = "support/navigation.rs"]
mod navigation;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::hint::black_box;

use mfg_vio::alignment::PointPair;
use mfg_vio::distribution::matrix_fisher::{
    MatrixFisher, Moments, s_from_complement, s_from_complement_near,
};
use mfg_vio::distribution::matrix_fisher_gaussian::{Correlation, MatrixFisherGaussian};
use mfg_vio::filter::attitude::{AttitudeFilterKind, AttitudePrior, GyroModel};
use mfg_vio::filter::gnss::{AttitudeUpdate, GnssFilterKind};
use mfg_vio::filter::{FilterConfig, FilterKind, InertialStep, MapTreatment};
use mfg_vio::inertial::{Belief, ImuConfig, NavCovariance, NavState, Propagator};
use mfg_vio::sensor::{ImuSample, Stamp};
use mfg_vio::so3::{exp, log, proper_svd};
use nalgebra::{Const, Isometry3, Matrix3, OMatrix, OVector, Rotation3, U3, Vector3};
use navigation::{initial, step};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::Distribution;

struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<usize> = const { Cell::new(0) };
}

// SAFETY: every request is passed on to the system allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.with(|count| count.set(count.get() + 1));
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn allocations<T>(work: impl FnOnce() -> T) -> usize {
    let before = ALLOCATIONS.with(Cell::get);
    black_box(work());
    ALLOCATIONS.with(Cell::get) - before
}

fn pairs() -> Vec<PointPair> {
    let pair = |i: u32| {
        let phase = f64::from(i);
        let in_body = Vector3::new(phase.sin(), (1.7 * phase).cos(), 2.0 + (0.3 * phase).sin());
        PointPair {
            in_body,
            body_covariance: Matrix3::from_diagonal(&Vector3::new(1e-5, 1e-5, 1e-4)),
            in_world: in_body + Vector3::repeat(1e-3 * (2.3 * phase).sin()),
            world_covariance: Matrix3::identity() * 1e-5,
        }
    };
    (0..500).map(pair).collect()
}

#[test]
fn imu_steps_of_every_filter_and_updates_of_fixed_size_do_not_allocate() {
    let belief = Belief {
        state: NavState {
            world_from_body: Isometry3::rotation(Vector3::new(0.01, -0.02, 0.01)),
            velocity: Vector3::zeros(),
            gyro_bias: Vector3::zeros(),
            accel_bias: Vector3::zeros(),
        },
        covariance: NavCovariance::identity() * 1e-3,
    };
    let sample = |k: i64| ImuSample {
        stamp: Stamp::from_nanos(k * 5_000_000),
        angular_velocity: Vector3::new(0.1, 0.2, -0.1),
        specific_force: Vector3::new(0.0, 0.1, 9.8),
    };
    let pairs = pairs();
    let propagator = Propagator::inertial(&ImuConfig::default());
    assert!(allocations(|| drop(black_box(Box::new(3)))) > 0, "allocations are counted");
    let interval = InertialStep::between(&sample(0), &sample(1));
    for kind in FilterKind::ALL {
        let mut filter = kind.start(&FilterConfig::default(), propagator.clone(), belief);
        // The first update makes room for its points.
        filter.update_map_points(&pairs).unwrap();
        let step = allocations(|| filter.propagate(&interval).unwrap());
        assert_eq!(step, 0, "{kind}");
        if kind.map_treatment() != MapTreatment::Correlated {
            let update = allocations(|| filter.update_map_points(&pairs).unwrap());
            assert_eq!(update, 0, "{kind}");
        }
    }
}

/// Unscented filters make a list of their sigma points.
#[test]
fn steps_of_attitude_and_navigation_filters_do_not_allocate() {
    let step = step();
    let prior = AttitudePrior::matrix_fisher(&Matrix3::from_diagonal_element(30.0)).unwrap();
    let gyro = GyroModel::isotropic(0.01, 1e-4);
    let unscented = [AttitudeFilterKind::Mfgiu, AttitudeFilterKind::Mfgbu];
    for kind in AttitudeFilterKind::ALL.into_iter().filter(|kind| !unscented.contains(kind)) {
        let mut filter = kind.start(&gyro, &prior).unwrap();
        // The first steps fill tables that all later ones share.
        filter.propagate(&step).unwrap();
        assert_eq!(allocations(|| filter.propagate(&step).unwrap()), 0, "{kind}");
    }
    for heading_sd in [None, Some(0.01)] {
        let initial = initial(heading_sd);
        for kind in GnssFilterKind::ALL {
            let imu = ImuConfig::default();
            let mut filter = kind.start(&imu, AttitudeUpdate::Flow, &initial).unwrap();
            filter.propagate(&step).unwrap();
            let count = allocations(|| filter.propagate(&step).unwrap());
            assert_eq!(count, 0, "{} {heading_sd:?}", kind.name());
        }
    }
}

/// One triple for each routine of the pass.
const REGIMES: [[f64; 3]; 4] =
    [[1e-3, 1e-4, -1e-5], [14.0, 10.0, -3.0], [1e6, 1e6, -1e6], [3e5, 2e5, 1e5]];

#[test]
fn moments_inversion_and_sampling_allocate_nothing() {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let r = exp(&Vector3::new(0.1, 0.2, 0.3));
    for s in REGIMES.map(Vector3::from) {
        // The first calls fill tables that all later ones share.
        let g = Moments::new(&s).unwrap().complement();
        let neighbour = Moments::new(&(s * 1.001)).unwrap();
        MatrixFisher::uniform().rotation_covariance();
        assert_eq!(allocations(|| Moments::new(&s)), 0, "{s}");
        assert_eq!(allocations(|| s_from_complement(&g)), 0, "{s}");
        assert_eq!(allocations(|| s_from_complement_near(&g, &neighbour)), 0, "{s}");
        let fisher = MatrixFisher::new(&(r.matrix() * Matrix3::from_diagonal(&s))).unwrap();
        let mean = fisher.mean();
        assert_eq!(allocations(|| MatrixFisher::from_mean(&mean)), 0, "{s}");
        assert_eq!(allocations(|| fisher.fuse(&fisher)), 0, "{s}");
        assert_eq!(allocations(|| fisher.log_density(&r)), 0, "{s}");
        assert_eq!(allocations(|| fisher.rotation_covariance()), 0, "{s}");
        assert_eq!(allocations(|| fisher.sampler().sample(&mut rng)), 0, "{s}");
    }
    assert_eq!(allocations(|| log(&exp(&Vector3::x()))), 0);
    assert_eq!(allocations(|| proper_svd(r.matrix())), 0);
}

#[test]
fn a_matrix_fisher_gaussian_of_fixed_size_allocates_nothing() {
    type Fifteen = Const<15>;
    for s in REGIMES.map(Vector3::from) {
        let attitude = MatrixFisher::new(&Matrix3::from_diagonal(&s)).unwrap();
        let belief = MatrixFisherGaussian::new(
            attitude,
            OVector::<f64, Fifteen>::zeros(),
            OMatrix::<f64, Fifteen, Fifteen>::identity(),
            OMatrix::<f64, Fifteen, U3>::repeat(1e-5),
            Correlation::World,
        )
        .unwrap();
        let moments = belief.conditional_moments();
        let estimate =
            || MatrixFisherGaussian::from_moments(attitude, Correlation::World, &moments);
        assert_eq!(allocations(estimate), 0, "{s}");
        let r = Rotation3::identity();
        assert_eq!(allocations(|| belief.log_density(&r, belief.mu())), 0, "{s}");
        assert_eq!(allocations(|| belief.moments()), 0, "{s}");
        assert_eq!(allocations(|| belief.attitude_given(belief.mu())), 0, "{s}");
    }
}
