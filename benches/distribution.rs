//! Costs of the distributions, with a 3x3 singular value decomposition in the same run as the
//! unit: `cargo bench --bench distribution --no-default-features`.

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use mfg_vio::distribution::matrix_fisher::{
    HigherMoments, MatrixFisher, Moments, s_from_complement, s_from_complement_near,
};
use mfg_vio::distribution::matrix_fisher_gaussian::{Correlation, MatrixFisherGaussian};
use mfg_vio::so3::{exp, proper_svd};
use nalgebra::{Const, Matrix3, OMatrix, OVector, U3, Vector3};

/// From the uniform distribution through the transitions to the concentration of odometry.
const CASES: [(&str, [f64; 3]); 8] = [
    ("near-uniform", [1e-3, 1e-4, 1e-5]),
    ("isotropic", [1.0, 1.0, 1.0]),
    ("diffuse", [14.9, 10.0, 3.0]),
    ("one-axis-free", [500.0, 3.0, 2.0]),
    ("two-axes-free", [1e6, 1e6, -1e6]),
    ("two-scales", [1e8, 1e8, -1e8]),
    ("transition", [60.0, 30.0, -4.0]),
    ("odometry", [3e5, 2e5, 1e5]),
];

fn unit(c: &mut Criterion) {
    let m = exp(&Vector3::new(0.3, -1.0, 2.0)).into_inner()
        * Matrix3::new(0.9, 0.1, 0.2, -0.3, 0.8, 0.1, 0.2, 0.1, 0.7);
    c.bench_function("svd/nalgebra", |b| b.iter(|| black_box(&m).svd(true, true)));
    c.bench_function("svd/proper", |b| b.iter(|| proper_svd(black_box(&m))));
}

fn moments(c: &mut Criterion) {
    for (name, s) in CASES {
        let s = Vector3::from(s);
        c.bench_with_input(BenchmarkId::new("moments-to-order-3", name), &s, |b, s| {
            b.iter(|| Moments::new(black_box(s)));
        });
    }
}

fn inversion(c: &mut Criterion) {
    for (name, s) in CASES {
        let s = Vector3::from(s);
        let Ok(moments) = Moments::new(&s) else { continue };
        let g = moments.complement();
        c.bench_with_input(BenchmarkId::new("inversion-cold", name), &g, |b, g| {
            b.iter(|| s_from_complement(black_box(g)));
        });
        // One step of inertial data changes the concentration by about a part in a thousand.
        let Ok(neighbour) = Moments::new(&(s * 1.001)) else { continue };
        c.bench_with_input(BenchmarkId::new("inversion-near", name), &g, |b, g| {
            b.iter(|| s_from_complement_near(black_box(g), black_box(&neighbour)));
        });
    }
}

fn conditional_estimation<const N: usize>(c: &mut Criterion) {
    let Ok(attitude) = MatrixFisher::new(&Matrix3::from_diagonal(&Vector3::new(3e5, 2e5, 1e5)))
    else {
        return;
    };
    let p = OMatrix::<f64, Const<N>, U3>::from_fn(|i, j| 1e-5 * ((i + 2 * j) % 5) as f64);
    let belief = MatrixFisherGaussian::new(
        attitude,
        OVector::<f64, Const<N>>::zeros(),
        OMatrix::<f64, Const<N>, Const<N>>::identity(),
        p,
        Correlation::World,
    );
    let Ok(belief) = belief else { return };
    let moments = belief.conditional_moments();
    c.bench_function(&format!("conditional-mle/n={N}"), |b| {
        b.iter(|| {
            MatrixFisherGaussian::from_moments(attitude, Correlation::World, black_box(&moments))
        });
    });
}

fn recursion(c: &mut Criterion) {
    let Ok(moments) = HigherMoments::new(&Vector3::new(25.0, 10.0, 5.0)) else { return };
    let fourth = [(0, 0), (1, 1), (0, 1), (1, 0)];
    let sixth = [(0, 0), (1, 2), (2, 1), (0, 1), (1, 2), (2, 0)];
    c.bench_function("recursion/order-4", |b| b.iter(|| moments.moment(black_box(&fourth))));
    c.bench_function("recursion/order-6", |b| b.iter(|| moments.moment(black_box(&sixth))));
}

criterion_group!(
    distribution,
    unit,
    moments,
    inversion,
    conditional_estimation::<3>,
    conditional_estimation::<12>,
    conditional_estimation::<15>,
    recursion
);
criterion_main!(distribution);
