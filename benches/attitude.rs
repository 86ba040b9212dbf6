//! Costs of the attitude filters, with a 3x3 singular value decomposition in the same run as the
//! unit: `cargo bench --bench attitude --no-default-features`.

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use mfg_vio::filter::attitude::{AttitudeFilterKind, AttitudePrior, GyroModel};
use mfg_vio::filter::{BayesFilter, InertialStep, VectorMeasurement};
use mfg_vio::so3::{exp, proper_polar, proper_svd};
use nalgebra::{Matrix3, Rotation3, Vector3};

fn unit(c: &mut Criterion) {
    let m = exp(&Vector3::new(0.3, -1.0, 2.0)).into_inner()
        * Matrix3::new(0.9, 0.1, 0.2, -0.3, 0.8, 0.1, 0.2, 0.1, 0.7);
    c.bench_function("svd/nalgebra", |b| b.iter(|| black_box(&m).svd(true, true)));
    c.bench_function("svd/proper", |b| b.iter(|| proper_svd(black_box(&m))));
    c.bench_function("svd/polar", |b| b.iter(|| proper_polar(black_box(&m))));
}

/// A filter at the concentration of the papers' pendulum.
fn settled(kind: AttitudeFilterKind) -> Option<Box<dyn BayesFilter>> {
    let prior = AttitudePrior::matrix_fisher(&Matrix3::from_diagonal_element(10.0)).ok()?;
    let mut filter = kind.start(&GyroModel::isotropic(0.017, 1e-4), &prior).ok()?;
    for _ in 0..100 {
        for _ in 0..5 {
            filter.propagate(&step()).ok()?;
        }
        filter.update_directions(&vectors(&filter.attitude())).ok()?;
    }
    Some(filter)
}

fn step() -> InertialStep {
    InertialStep::turning(Vector3::new(1.0, -2.0, 0.5), 0.02)
}

fn vectors(attitude: &Rotation3<f64>) -> [VectorMeasurement; 3] {
    let off = exp(&Vector3::new(0.02, -0.01, 0.03));
    [Vector3::x(), Vector3::y(), Vector3::z()].map(|in_world| {
        let in_body = attitude.inverse() * (off * in_world);
        VectorMeasurement::of_world_direction(in_world, in_body, 25.0)
    })
}

fn steps(c: &mut Criterion) {
    for kind in AttitudeFilterKind::ALL {
        let Some(filter) = settled(kind) else { continue };
        let mut running = filter;
        c.bench_with_input(BenchmarkId::new("propagate", kind), &step(), |b, step| {
            b.iter(|| running.propagate(black_box(step)));
        });
        let Some(mut running) = settled(kind) else { continue };
        // Five intervals and an update by three vectors: a fifth of this is a step at 50 Hz.
        c.bench_function(&format!("cycle/{kind}"), |b| {
            b.iter(|| {
                for _ in 0..5 {
                    running.propagate(black_box(&step()))?;
                }
                running.update_directions(&vectors(&running.attitude()))
            });
        });
    }
}

criterion_group!(attitude, unit, steps);
criterion_main!(attitude);
