//! A step and an update of each IMU-GNSS filter, with a 3x3 singular value decomposition in the
//! same run as the unit: `cargo bench --bench gnss --no-default-features`.

#[path = "../tests/support/navigation.rs"]
mod navigation;

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use mfg_vio::filter::PositionMeasurement;
use mfg_vio::filter::gnss::{AttitudeUpdate, GnssFilter, GnssFilterKind};
use mfg_vio::inertial::ImuConfig;
use mfg_vio::so3::{exp, proper_svd};
use nalgebra::{Matrix3, Vector3};
use navigation::{initial, step};

/// Each filter after a second, its attitude concentrated or its heading unknown.
fn filters() -> Vec<(String, Box<dyn GnssFilter>)> {
    let mut filters = Vec::new();
    for (case, heading_sd) in [("concentrated", Some(0.02)), ("unknown-heading", None)] {
        for kind in GnssFilterKind::ALL {
            let started =
                kind.start(&ImuConfig::default(), AttitudeUpdate::Flow, &initial(heading_sd));
            let Ok(mut filter) = started else { continue };
            if (0..100).all(|_| filter.propagate(&step()).is_ok()) {
                filters.push((format!("{}/{case}", kind.name()), filter));
            }
        }
    }
    filters
}

fn unit(c: &mut Criterion) {
    let m = exp(&Vector3::new(0.3, -1.0, 2.0)).into_inner()
        * Matrix3::new(0.9, 0.1, 0.2, -0.3, 0.8, 0.1, 0.2, 0.1, 0.7);
    c.bench_function("svd/proper", |b| b.iter(|| proper_svd(black_box(&m))));
}

fn propagation(c: &mut Criterion) {
    for (name, mut filter) in filters() {
        c.bench_function(&format!("propagate/{name}"), |b| {
            b.iter(|| filter.propagate(black_box(&step())));
        });
    }
}

fn update(c: &mut Criterion) {
    for (name, mut filter) in filters() {
        c.bench_function(&format!("propagate-and-update/{name}"), |b| {
            b.iter(|| {
                // A step between updates, so that they do not sharpen the belief without end.
                filter.propagate(&step())?;
                let position = filter.state().world_from_body.translation.vector;
                filter.update_position(black_box(&PositionMeasurement {
                    in_world: position + Vector3::new(0.2, -0.1, 0.1),
                    covariance: Matrix3::identity(),
                    lever_arm: Vector3::zeros(),
                }))
            });
        });
    }
}

criterion_group!(gnss, unit, propagation, update);
criterion_main!(gnss);
