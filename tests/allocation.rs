//! Steps that run at the rate of the sensors do not allocate.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::hint::black_box;

use mfg_vio::alignment::PointPair;
use mfg_vio::filter::{FilterConfig, FilterKind};
use mfg_vio::inertial::{Belief, ImuConfig, ImuSample, NavCovariance, NavState, Propagator, Stamp};
use nalgebra::{Isometry3, Matrix3, Vector3};

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

fn allocations(work: impl FnOnce()) -> usize {
    let before = ALLOCATIONS.with(Cell::get);
    work();
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
fn updates_and_imu_steps_of_every_filter_do_not_allocate() {
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
    for kind in [FilterKind::Mfgd, FilterKind::Mfgr, FilterKind::Mekfd, FilterKind::Mekfr] {
        let mut filter = kind.start(&FilterConfig::default(), propagator.clone(), belief);
        // The first update makes room for its points.
        assert!(filter.update(&pairs).is_some());
        let step = allocations(|| assert!(filter.propagate(&sample(0), &sample(1))));
        let update = allocations(|| assert!(filter.update(&pairs).is_some()));
        assert_eq!((step, update), (0, 0), "{kind}");
    }
}
