//! Costs of projecting a point, its derivative, and the direction of a pixel, by camera model; a
//! normalization of a vector in the same run as the unit: `cargo bench --bench camera`.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use mfg_vio::sensor::{Camera, CameraConfig, CameraModel};
use nalgebra::{Point2, Vector3};

/// A calibration of each model, and a pinhole.
fn cameras() -> Vec<(&'static str, Camera)> {
    let plain = CameraConfig::default();
    let named = |model: CameraModel, distortion: &[f64]| {
        let config = CameraConfig { model, distortion: distortion.to_vec(), ..plain.clone() };
        Camera::new(&config).map(|camera| (model.name(), camera))
    };
    [
        Ok(("pinhole", Camera::pinhole(plain.intrinsics()))),
        named(CameraModel::RadialTangential, &[-0.28, 0.074, 2e-4, 2e-5, 0.0]),
        named(CameraModel::Rational, &[0.52, -2.6, 8e-4, -3e-4, 1.4, 0.4, -2.4, 1.3]),
        named(CameraModel::Equidistant, &[0.0035, 0.0007, -0.002, 0.0002]),
        named(CameraModel::DoubleSphere, &[-0.3, 0.59]),
        named(CameraModel::Omnidirectional, &[1.62, -0.12, 0.031, 1e-3, -6e-4]),
    ]
    .into_iter()
    .filter_map(Result::ok)
    .collect()
}

fn models(c: &mut Criterion) {
    let point = Vector3::new(0.4, -0.3, 1.7);
    c.bench_function("camera/unit/normalize", |b| b.iter(|| black_box(point).normalize()));
    for (name, camera) in cameras() {
        let pixel = camera.project(&point).unwrap_or(Point2::origin());
        let id = |what: &str| format!("camera/{what}/{name}");
        c.bench_function(&id("project"), |b| {
            b.iter(|| camera.project(black_box(&point)));
        });
        c.bench_function(&id("jacobian"), |b| {
            b.iter(|| camera.project_with_jacobian(black_box(&point)));
        });
        c.bench_function(&id("bearing"), |b| {
            b.iter(|| camera.bearing(black_box(pixel)));
        });
    }
}

criterion_group!(camera, models);
criterion_main!(camera);
