use nalgebra::{
    Const, DMatrix, DVector, Dyn, Matrix3, Matrix3x2, OMatrix, Rotation3, SMatrix, SVector,
    Vector2, Vector3,
};
use proptest::prelude::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::Distribution;

use super::*;
use crate::so3::HaarQuadrature;

const VARIANTS: [Correlation; 2] = [Correlation::World, Correlation::Body];

fn attitude(s: [f64; 3]) -> MatrixFisher {
    let u = exp(&Vector3::new(0.4, -1.0, 0.7));
    let v = exp(&Vector3::new(-2.0, 0.3, 0.1));
    MatrixFisher::from_svd(ProperSvd { u, s: Vector3::from(s), v }).unwrap()
}

/// Two components, correlated with all three rotations.
fn belief(s: [f64; 3], correlation: Correlation) -> MatrixFisherGaussian<Const<2>> {
    let attitude = attitude(s);
    let a = tangent_information(&attitude).map(|a| 1.0 / (1.0 + a.sqrt()));
    let p = Matrix3x2::new(0.3, -0.1, 0.2, 0.4, -0.3, 0.1).transpose() * Matrix3::from_diagonal(&a);
    let sigma = OMatrix::<f64, Const<2>, Const<2>>::new(1.0, 0.2, 0.2, 0.8);
    MatrixFisherGaussian::new(attitude, Vector2::new(0.5, -1.0), sigma, p, correlation).unwrap()
}

#[test]
fn deviation_is_linear_in_the_attitude() {
    let r = exp(&Vector3::new(1.0, 2.0, -0.5));
    for correlation in VARIANTS {
        let belief = belief([5.0, 2.0, -1.0], correlation);
        let vec = SVector::<f64, 9>::from_column_slice(r.matrix().as_slice());
        assert!((belief.regression() * vec - belief.deviation(&r)).norm() < 1e-13);
        let (s, s1) = (belief.attitude().svd().s, 5.0);
        let q = belief.attitude().centred(&r);
        let paper = match correlation {
            Correlation::World => s[1] * q[(2, 1)] - s[2] * q[(1, 2)],
            Correlation::Body => s[2] * q[(2, 1)] - s[1] * q[(1, 2)],
        };
        assert!((belief.deviation(&r)[0] - paper).abs() < 1e-13);
        assert!(belief.deviation(&belief.attitude().mode()).norm() < 1e-14 * s1);
    }
}

#[test]
fn density_integrates_to_one_with_the_stated_moments() {
    // Exact quadrature over the group; over x the density is Gaussian, so that integrating it
    // against 1, x, x x^T is checked through the conditional mean.
    let grid = HaarQuadrature::of_degree(40);
    for correlation in VARIANTS {
        let belief = belief([3.0, 2.0, -1.0], correlation);
        let moments = belief.moments();
        let density = |r: &Rotation3<f64>| belief.attitude().log_density(r).exp();
        assert!((grid.integrate(density) - 1.0).abs() < 1e-12);
        let mean = |f: &dyn Fn(&Rotation3<f64>) -> f64| grid.integrate(|r| density(r) * f(r));
        for i in 0..3 {
            for j in 0..3 {
                let v = |r: &Rotation3<f64>| belief.deviation(r);
                let product = mean(&|r| v(r)[i] * v(r)[j]);
                let expected = if i == j { moments.deviation[i] } else { 0.0 };
                assert!((product - expected).abs() < 1e-11, "{i} {j} {product} {expected}");
            }
        }
        for i in 0..2 {
            let first = mean(&|r| belief.conditional_mean(r)[i]);
            assert!((first - moments.mean[i]).abs() < 1e-12);
            for j in 0..2 {
                let of_mean = mean(&|r| {
                    let m = belief.conditional_mean(r) - moments.mean;
                    m[i] * m[j]
                });
                let total = of_mean + belief.conditional_covariance()[(i, j)];
                assert!((total - moments.covariance[(i, j)]).abs() < 1e-11);
            }
        }
    }
}

/// Theorem 3.2: the distribution is a Gaussian in the ambient space `R^9 x R^n`, conditioned on
/// `R` being a rotation; its regression and its conditional covariance are those of the Gaussian.
#[test]
fn it_is_a_gaussian_of_the_ambient_space_restricted_to_rotations() {
    let vec = |m: Matrix3<f64>| SVector::<f64, 9>::from_column_slice(m.as_slice());
    let r = *exp(&Vector3::new(1.0, 2.0, -0.5)).matrix();
    for s in [[5.0, 2.0, -1.0], [30.0, 4.0, 2.0]] {
        for correlation in VARIANTS {
            let belief = belief(s, correlation);
            let ProperSvd { u, s, v } = *belief.attitude().svd();
            let m = *belief.attitude().mode().matrix();
            let diagonal = Matrix3::from_diagonal(&s);
            let tangent = |i: usize| m * crate::so3::hat(&v.matrix().column(i).into_owned());
            let (deviation, k, t) = match correlation {
                Correlation::World => (
                    vec((r - m).transpose()),
                    v.matrix() * diagonal * v.matrix().transpose(),
                    [0, 1, 2].map(|i| vec(tangent(i).transpose())),
                ),
                Correlation::Body => (
                    vec(r - m),
                    u.matrix() * diagonal * u.matrix().transpose(),
                    [0, 1, 2].map(|i| vec(tangent(i))),
                ),
            };
            let information = Matrix3::<f64>::identity().kronecker(&k);
            let t = SMatrix::<f64, 9, 3>::from_columns(&t);
            let v_r = t.transpose() * information * deviation;
            let attitude = Rotation3::from_matrix_unchecked(r);
            assert!((v_r - belief.deviation(&attitude)).norm() < 1e-12, "{correlation:?}");
            let removed = t.transpose() * information * t;
            let expected = Matrix3::from_diagonal(&belief.tangent_information());
            assert!((removed - expected).norm() < 1e-12, "{correlation:?}");
        }
    }
}

#[test]
fn log_density_is_that_of_the_two_parts() {
    let belief = belief([3.0, 2.0, 1.0], Correlation::World);
    let r = exp(&Vector3::new(0.1, 0.2, 0.3)) * belief.attitude().mode();
    let x = Vector2::new(0.3, 0.9);
    let residual = x - belief.conditional_mean(&r);
    let covariance = belief.conditional_covariance();
    let gaussian = -0.5 * residual.dot(&(covariance.try_inverse().unwrap() * residual))
        - 0.5 * (covariance * std::f64::consts::TAU).determinant().ln();
    let expected = belief.attitude().log_density(&r) + gaussian;
    assert!((belief.log_density(&r, &x) - expected).abs() < 1e-12);
}

/// The general form by quadrature of the score of the conditional density, and theorem 3.7.
#[test]
fn concentration_information_is_that_of_both_parts() {
    let grid = HaarQuadrature::of_degree(40);
    for correlation in VARIANTS {
        let belief = belief([3.0, 2.0, -1.0], correlation);
        let inverse = belief.conditional_covariance().try_inverse().unwrap();
        let [marginal, conditional] = belief.concentration_information();
        for i in 0..3 {
            let unit = Vector3::ith(i, 1.0);
            let expectation = |f: &dyn Fn(&Rotation3<f64>) -> f64| {
                grid.integrate(|r| belief.attitude().log_density(r).exp() * f(r))
            };
            let of_x = expectation(&|r| {
                let q = belief.attitude().centred(r);
                let slope = belief.p() * correlation.deviation(&q, &unit);
                slope.dot(&(inverse * slope))
            });
            assert!((conditional[i] - of_x).abs() < 1e-11 * of_x.max(1.0), "{of_x}");
            let d = belief.attitude().moments().first();
            let of_r = expectation(&|r| (belief.attitude().centred(r)[(i, i)] - d[i]).powi(2));
            assert!((marginal[i] - of_r).abs() < 1e-11);
        }

        let (s, rho, sigma) = (4.0, 0.3, 1.7);
        let attitude = attitude([s; 3]);
        let p = OMatrix::<f64, Const<1>, U3>::repeat(rho * sigma / (2.0 * s).sqrt());
        let (mu, variance) = (SVector::<f64, 1>::zeros(), SMatrix::<f64, 1, 1>::new(sigma * sigma));
        let belief = MatrixFisherGaussian::new(attitude, mu, variance, p, correlation).unwrap();
        let [marginal, conditional] = belief.concentration_information();
        let moments = belief.attitude().moments();
        let (d, dd) = (moments.first()[0], moments.second((0, 0), (0, 0)));
        let ratio = (1.0 - 3.0 * rho * rho) / (rho * rho) * 2.0 * s * (dd - d * d) / (1.0 - dd);
        assert!((marginal[0] / conditional[0] / ratio - 1.0).abs() < 1e-12, "{ratio}");
    }
}

#[test]
fn canonical_variables_invert() {
    let belief = belief([30.0, 2.0, 1.0], Correlation::Body);
    let (r, x) = (exp(&Vector3::new(1.0, -0.4, 0.3)), Vector2::new(2.0, -3.0));
    let (q, y) = belief.to_canonical(&r, &x);
    let (r2, x2) = belief.from_canonical(&q, &y);
    assert!((r.matrix() - r2.matrix()).norm() < 1e-14 && (x - x2).norm() < 1e-13);
}

#[test]
fn estimation_inverts_moments() {
    for correlation in VARIANTS {
        for s in
            [[20.0, 5.0, 3.0], [2.0, 2.0, 2.0], [9.0, 4.0, -4.0], [1e6, 1e5, 10.0], [7.0, 0.0, 0.0]]
        {
            let belief = belief(s, correlation);
            let found = MatrixFisherGaussian::from_moments(
                *belief.attitude(),
                correlation,
                &belief.conditional_moments(),
            )
            .unwrap();
            assert!((found.mu() - belief.mu()).norm() < 1e-12);
            assert!((found.sigma() - belief.sigma()).norm() < 1e-10);
            assert!(found.is_equivalent(&belief, 1e-10), "{s:?}");
        }
    }
}

#[test]
fn samples_give_the_parameters_back() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    for correlation in VARIANTS {
        let belief = belief([12.0, 6.0, 2.0], correlation);
        let n = 40_000;
        let samples: Vec<_> = belief
            .sampler()
            .sample_iter(&mut rng)
            .take(n)
            .map(|(attitude, x)| WeightedSample { weight: 2.0, attitude, x })
            .collect();
        let found = MatrixFisherGaussian::from_samples(&samples, correlation).unwrap();
        let f = belief.attitude().parameter();
        assert!((found.attitude().parameter() - f).norm() < 0.03 * f.norm());
        assert!((found.mu() - belief.mu()).norm() < 0.03);
        assert!((found.sigma() - belief.sigma()).norm() < 0.05);
        let slope = |m: &MatrixFisherGaussian<Const<2>>| m.p() * m.regression();
        let difference = (slope(&found) - slope(&belief)).norm();
        assert!(difference < 0.05 * slope(&belief).norm(), "{difference}");
    }
}

#[test]
fn gaussian_approximation_works_both_ways() {
    let belief = belief([3e4, 2e4, 1e4], Correlation::World);
    let gaussian = belief.to_gaussian().unwrap();
    let found = MatrixFisherGaussian::from_gaussian(&gaussian, Correlation::World).unwrap();
    assert!(found.is_equivalent(&belief, 1e-9));
    // And it is the limit: Cov[x, e] of the distribution itself.
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let n = 40_000;
    let mode = belief.attitude().mode();
    let mut sampled = SMatrix::<f64, 2, 3>::zeros();
    for (r, x) in belief.sampler().sample_iter(&mut rng).take(n) {
        let e = crate::so3::log(&(mode.inverse() * r));
        sampled += (x - belief.mu()) * e.transpose() / n as f64;
    }
    let scale = (belief.sigma()[(0, 0)] * gaussian.rotation.trace() / n as f64).sqrt();
    let cross = gaussian.cross;
    assert!((sampled - cross).amax() < 5.0 * scale, "{sampled} {cross}");
}

/// Theorem C.1, with an arbitrary element of the freedom in each case.
#[test]
fn equivalent_parameters_share_a_representative() {
    let turn = |v: [f64; 3]| exp(&Vector3::from(v));
    let mirror = |t: Rotation3<f64>| {
        let l = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -1.0));
        Rotation3::from_matrix_unchecked(l * t.matrix() * l)
    };
    let general = turn([0.3, -0.8, 1.9]);
    let (about_x, other_x, about_z) =
        (turn([0.7, 0.0, 0.0]), turn([-1.1, 0.0, 0.0]), turn([0.0, 0.0, 2.0]));
    let half_turn = turn([0.0, std::f64::consts::PI, 0.0]);
    let cases = [
        ([0.0, 0.0, 0.0], general, other_x),
        ([4.0, 0.0, 0.0], about_x, other_x),
        ([4.0, 4.0, 4.0], general, general),
        ([4.0, 2.0, 2.0], about_x, about_x),
        ([4.0, 4.0, 2.0], about_z, about_z),
        ([4.0, 4.0, -2.0], about_z, about_z),
        ([4.0, 3.0, 2.0], half_turn, half_turn),
        ([4.0, 4.0, -4.0], general, mirror(general)),
        ([4.0, 2.0, -2.0], about_x, about_x.inverse()),
    ];
    for correlation in VARIANTS {
        for (s, left, right) in cases {
            let belief = belief(s, correlation);
            let ProperSvd { u, s, v } = *belief.attitude().svd();
            let other = belief.with_axes(ProperSvd { u: u * left, s, v: v * right }).unwrap();
            assert!(other.is_equivalent(&belief, 1e-12), "{s}");
            let r = exp(&Vector3::new(0.2, 1.0, -0.4));
            assert!((other.conditional_mean(&r) - belief.conditional_mean(&r)).norm() < 1e-12);
            let [a, b] = [&belief, &other].map(|m| m.canonical_representative().unwrap());
            assert!(a.is_equivalent(&belief, 1e-12), "{s}");
            let axes = |m: &MatrixFisherGaussian<Const<2>>| {
                (*m.attitude().svd().u.matrix(), *m.attitude().svd().v.matrix())
            };
            assert!((axes(&a).0 - axes(&b).0).norm() < 1e-9, "{s} {} {}", axes(&a).0, axes(&b).0);
            assert!((axes(&a).1 - axes(&b).1).norm() < 1e-9, "{s}");
            assert!((a.p() - b.p()).norm() < 1e-9, "{s}");
        }
    }
}

#[test]
fn a_marginal_is_the_distribution_of_its_components() {
    let belief = belief([5.0, 3.0, 1.0], Correlation::World);
    let select = SMatrix::<f64, 1, 2>::new(0.0, 1.0);
    let marginal = belief.affine(&select, &SVector::<f64, 1>::zeros()).unwrap();
    let (all, some) = (belief.moments(), marginal.moments());
    assert!((some.mean[0] - all.mean[1]).abs() < 1e-15);
    assert!((some.covariance[(0, 0)] - all.covariance[(1, 1)]).abs() < 1e-14);
    assert!((some.cross.row(0) - all.cross.row(1)).norm() < 1e-14);
    let sum = belief
        .add_independent(
            &Vector2::new(1.0, 2.0),
            &(Matrix3::identity().fixed_view::<2, 2>(0, 0) * 0.3),
        )
        .unwrap();
    let expected = all.covariance + Matrix3::identity().fixed_view::<2, 2>(0, 0) * 0.3;
    assert!((sum.moments().covariance - expected).norm() < 1e-14);
}

#[test]
fn dynamic_sizes_agree_with_fixed_ones() {
    let fixed = belief([5.0, 3.0, 1.0], Correlation::Body);
    let p = OMatrix::<f64, Dyn, U3>::from_column_slice(fixed.p().as_slice());
    let dynamic = MatrixFisherGaussian::<Dyn>::new(
        *fixed.attitude(),
        DVector::from_column_slice(fixed.mu().as_slice()),
        DMatrix::from_column_slice(2, 2, fixed.sigma().as_slice()),
        p,
        Correlation::Body,
    )
    .unwrap();
    let r = exp(&Vector3::new(0.2, 1.0, -0.4));
    let x = Vector2::new(0.1, 0.2);
    let log_density = dynamic.log_density(&r, &DVector::from_column_slice(x.as_slice()));
    assert_eq!(log_density, fixed.log_density(&r, &x));
}

#[test]
fn parameters_that_are_no_distribution_are_refused() {
    let good = belief([5.0, 3.0, 1.0], Correlation::Body);
    let build = |sigma: f64, p: f64| {
        let sigma = OMatrix::<f64, Const<2>, Const<2>>::identity() * sigma;
        let p = OMatrix::<f64, Const<2>, U3>::repeat(p);
        MatrixFisherGaussian::new(*good.attitude(), *good.mu(), sigma, p, Correlation::Body)
    };
    assert!(build(1.0, 0.0).is_ok());
    assert_eq!(build(1.0, 1.0).unwrap_err(), MfgError::ConditionalCovariance);
    assert_eq!(build(-1.0, 0.0).unwrap_err(), MfgError::ConditionalCovariance);
    assert_eq!(build(1.0, f64::NAN).unwrap_err(), MfgError::NotFinite("P"));
    let none: [WeightedSample<Const<2>>; 0] = [];
    let refused = MatrixFisherGaussian::from_samples(&none, Correlation::Body);
    assert_eq!(refused.unwrap_err(), MfgError::NoSamples);
}

proptest! {
    /// (3.9), (3.10): close to the means the conditional density of R is that of the turned
    /// distribution, to second order.
    #[test]
    fn attitude_given_x_turns_the_mode(x in prop::array::uniform2(-1e-3..1e-3f64)) {
        for correlation in VARIANTS {
            let belief = belief([500.0, 400.0, 300.0], correlation);
            let x = belief.mu() + Vector2::from(x);
            let given = belief.attitude_given(&x).unwrap();
            let slope = |r: &Rotation3<f64>| {
                let h = 1e-5;
                Vector3::from_fn(|i, _| {
                    let e = exp(&(Vector3::ith(i, h)));
                    belief.log_density(&(r * e), &x) - belief.log_density(&(r * e.inverse()), &x)
                }) / (2.0 * h)
            };
            let before = slope(&belief.attitude().mode()).norm();
            prop_assert!(slope(&given.mode()).norm() < 0.1 * before + 1e-6);
        }
    }
}
