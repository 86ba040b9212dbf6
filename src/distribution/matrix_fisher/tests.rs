use approx::assert_relative_eq;
use nalgebra::{Matrix3, Rotation3, SMatrix, Vector3};
use proptest::prelude::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::Distribution;

use super::*;
use crate::so3::{HaarQuadrature, exp, log};

fn moments(s: [f64; 3]) -> Moments {
    Moments::new(&Vector3::from(s)).unwrap()
}

/// Lines of a reference file without comments and header, or `None` with a notice.
fn reference_lines(name: &str) -> Option<Vec<Vec<f64>>> {
    let folder = std::env::var("MFG_VIO_DATA")
        .unwrap_or_else(|_| concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/data").into());
    let path = format!("{folder}/matrix_fisher/{name}");
    let Ok(text) = std::fs::read_to_string(&path) else {
        eprintln!("SKIPPED: no reference values at {path}");
        return None;
    };
    let data = text.lines().filter(|line| line.starts_with(|c: char| c.is_ascii_digit()));
    Some(data.map(|line| line.split(',').map(|x| x.parse().unwrap()).collect()).collect())
}

#[test]
fn constants_and_first_moments_agree_with_the_reference() {
    for row in reference_lines("reference.csv").into_iter().flatten() {
        let m = moments([row[0], row[1], row[2]]);
        assert_relative_eq!(m.c_scaled(), row[3], max_relative = 1e-12);
        assert_relative_eq!(m.log_c(), row[4], epsilon = 1e-12);
        for i in 0..3 {
            assert!((m.first()[i] - row[5 + i]).abs() <= 1e-12, "{row:?} {}", m.first());
        }
    }
}

#[test]
fn second_moments_agree_with_the_reference() {
    const COLUMNS: [&str; 12] = [
        "1111", "2222", "3333", "1122", "1133", "2233", "1212", "1221", "1313", "1331", "2323",
        "2332",
    ];
    for row in reference_lines("second_moments.csv").into_iter().flatten() {
        let m = moments([row[0], row[1], row[2]]);
        for (name, value) in COLUMNS.into_iter().zip(&row[3..]) {
            assert!((named_moment(&m, name) - value).abs() <= 1e-10, "{row:?} {name}");
        }
    }
}

/// Relative, of every moment, also of those that nearly vanish; the constant's logarithm is
/// compared in absolute terms.
#[test]
fn moments_agree_with_multiple_precision() {
    let mut lines = include_str!("golden.csv").lines().filter(|line| !line.starts_with('#'));
    let header: Vec<&str> = lines.next().unwrap().split(',').collect();
    for line in lines {
        let row: Vec<f64> = line.split(',').map(|x| x.parse().unwrap()).collect();
        let m = moments([row[0], row[1], row[2]]);
        assert!((m.log_c_scaled() - row[3]).abs() < 1e-11, "{line}");
        for (found, value) in m.complement().iter().zip(&row[4..7]) {
            assert_relative_eq!(*found, *value, max_relative = 1e-11);
        }
        for (name, value) in header.iter().zip(&row).skip(7) {
            let found = named_moment(&m, name);
            assert!((found - value).abs() <= 1e-11 * value.abs(), "{name} {found} {value} {line}");
        }
    }
}

/// The moment whose name lists the indices of its factors: `1221` is `E[Q12 Q21]`.
fn named_moment(m: &Moments, name: &str) -> f64 {
    let digits: Vec<usize> = name.bytes().map(|b| usize::from(b - b'1')).collect();
    let entry = |n: usize| (digits[2 * n], digits[2 * n + 1]);
    match digits.len() {
        2 => m.first()[digits[0]],
        4 => m.second(entry(0), entry(1)),
        _ => m.third(entry(0), entry(1), entry(2)),
    }
}

/// The exact Haar quadrature of the density itself: no quaternion, no Bessel function.
#[test]
fn moments_agree_with_quadrature_on_the_group() {
    let grid = HaarQuadrature::of_degree(40);
    let entries: Vec<(usize, usize)> = (0..9).map(|n| (n / 3, n % 3)).collect();
    for s in [[0.3, 0.2, -0.1], [2.0, 2.0, 2.0], [4.0, 3.0, -3.0], [6.0, 0.0, 0.0]] {
        let m = moments(s);
        let trace = |r: &Rotation3<f64>| s[0] * r[(0, 0)] + s[1] * r[(1, 1)] + s[2] * r[(2, 2)];
        let c = grid.integrate(|r| trace(r).exp());
        assert_relative_eq!(m.log_c(), c.ln(), epsilon = 1e-12);
        for &a in &entries {
            for &b in &entries {
                let second = grid.integrate(|r| trace(r).exp() * r[a] * r[b]) / c;
                assert!((m.second(a, b) - second).abs() < 1e-12);
                let third = grid.integrate(|r| trace(r).exp() * r[a] * r[b] * r[(1, 2)]) / c;
                assert!((m.third(a, b, (1, 2)) - third).abs() < 1e-12, "{a:?} {b:?}");
            }
        }
    }
}

/// Composite Gauss-Legendre nodes on `[0, end]` whose panels halve down to `finest`.
fn graded_nodes(end: f64, finest: f64) -> Vec<(f64, f64)> {
    let rule = gauss_quad::legendre::GaussLegendre::new(std::num::NonZeroUsize::new(12).unwrap());
    let mut nodes = Vec::new();
    let mut panel_end = end;
    while panel_end > 0.0 {
        let start = if panel_end > finest { 0.5 * panel_end } else { 0.0 };
        let half = 0.5 * (panel_end - start);
        nodes.extend(rule.iter().map(|(x, w)| (start + half * (1.0 + x), half * w)));
        panel_end = start;
    }
    nodes
}

/// `E[w^n exp(-2 t w)]` for `n = 0..3` and `w = sin^2(phi/2)`, `phi` uniform on the circle.
fn circle_integrals(t: f64) -> [f64; 4] {
    let mut sums = [0.0; 4];
    for (phi, weight) in graded_nodes(std::f64::consts::PI, 0.5 / (1.0 + t).sqrt()) {
        let w = (0.5 * phi).sin().powi(2);
        let density = weight * (-2.0 * t * w).exp() / std::f64::consts::PI;
        for (n, sum) in sums.iter_mut().enumerate() {
            *sum += density * w.powi(n as i32);
        }
    }
    sums
}

/// The constant and the moments `E[y1^p y2^q y3^r]` of the squared quaternion components by
/// brute force: plain quadrature over all three coordinates of the sphere.
fn brute_force(s: &Vector3<f64>) -> (f64, [f64; 20]) {
    let Sums { a, difference } = Sums::of_singular_values(s);
    let mut constant = 0.0;
    let mut cubics = [0.0; 20];
    for (v, weight) in graded_nodes(1.0, 0.1 / (1.0 + a[2]).sqrt()) {
        let u = v * v;
        let (first, second) =
            (circle_integrals(a[0] * (1.0 - u)), circle_integrals(difference * u));
        let density = 2.0 * v * weight * (-2.0 * a[1] * u).exp();
        constant += density * first[0] * second[0];
        for (cubic, [_, p, q, r]) in cubics.iter_mut().zip(forms::MONOMIALS) {
            // y1 = (1 - u) w, y2 = u (1 - z), y3 = u z; (1 - z)^q z^r by the binomial theorem.
            let beta = match q {
                0 => second[r],
                1 => second[r] - second[r + 1],
                2 => second[r] - 2.0 * second[r + 1] + second[r + 2],
                _ => second[0] - 3.0 * second[1] + 3.0 * second[2] - second[3],
            };
            *cubic += density * (1.0 - u).powi(p as i32) * first[p] * u.powi((q + r) as i32) * beta;
        }
    }
    (constant, cubics.map(|c| c / constant))
}

/// The whole plane of concentrations, with repetitions, opposites and zeros.
fn grid() -> Vec<Vector3<f64>> {
    const LEVELS: [f64; 10] = [0.0, 1e-6, 1e-4, 1e-2, 0.5, 3.0, 20.0, 500.0, 1e5, 1e8];
    let mut grid = Vec::new();
    for (i, &s1) in LEVELS.iter().enumerate() {
        for (j, &s2) in LEVELS.iter().enumerate().take(i + 1) {
            for &s3 in &LEVELS[..=j] {
                grid.extend([s3, -s3].map(|s3| Vector3::new(s1, s2, s3)));
            }
        }
    }
    grid
}

/// Moments of `Q` against the scale of their factors, so that one that vanishes by symmetry is
/// not asked for more than double precision holds.
#[test]
fn moments_agree_with_brute_force_over_the_plane_of_concentrations() {
    let (mut worst_first, mut worst_third, mut worst_products) = (0.0_f64, 0.0_f64, 0.0_f64);
    for s in grid() {
        let found = Moments::new(&s).unwrap();
        let (c_scaled, cubics) = brute_force(&s);
        let values = forms::evaluate(forms::Basis::Squares, &cubics);
        let value = |entries: &[(usize, usize)]| forms::row(entries).map_or(0.0, |n| values[n]);
        worst_first = worst_first.max((found.c_scaled() / c_scaled - 1.0).abs());
        for i in 0..3 {
            let complement = values[forms::complement_row(i)];
            worst_first = worst_first.max((found.complement()[i] / complement - 1.0).abs());
            for (j, k) in [(0, 0), (0, 1), (1, 2), (2, 2)] {
                let product = forms::complement_product(forms::Basis::Squares, &cubics, [i, j, k]);
                let ratio = found.complement_third(i, j, k) / product;
                worst_products = worst_products.max((ratio - 1.0).abs());
            }
        }
        let entries: Vec<_> = (0..9).map(|n| (n / 3, n % 3)).collect();
        let size = |a: (usize, usize)| value(&[a, a]).sqrt();
        for &a in &entries {
            for &b in &entries {
                let error = (found.second(a, b) - value(&[a, b])).abs() / (size(a) * size(b));
                worst_third = worst_third.max(error);
                for &c in &entries {
                    let error = (found.third(a, b, c) - value(&[a, b, c])).abs();
                    worst_third = worst_third.max(error / (size(a) * size(b) * size(c)));
                }
            }
        }
    }
    assert!(worst_first < 1e-12 && worst_third < 1e-12, "{worst_first:e} {worst_third:e}");
    // Products of three complements are as small as 1e-24 of their terms' scale.
    assert!(worst_products < 1e-10, "{worst_products:e}");
}

fn singular_values() -> impl Strategy<Value = Vector3<f64>> {
    let exponent = -6.0..10.0f64;
    (prop::array::uniform3(exponent), any::<bool>(), 0..4u8).prop_map(|(e, negative, ties)| {
        let mut s = e.map(|e| 10f64.powf(e));
        s.sort_by(|a, b| b.total_cmp(a));
        if ties & 1 != 0 {
            s[1] = s[0];
        }
        if ties & 2 != 0 {
            s[2] = s[1];
        }
        Vector3::new(s[0], s[1], if negative { -s[2] } else { s[2] })
    })
}

fn rotation() -> impl Strategy<Value = Rotation3<f64>> {
    prop::array::uniform3(-3.0..3.0).prop_map(|v| exp(&Vector3::from(v)))
}

fn sums(s: &Vector3<f64>) -> Vector3<f64> {
    Vector3::from(Sums::of_singular_values(s).a)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(100))]

    /// The conditioning: a rounding error of `1 - d_i` moves `a_j` by `1e-16 a_max/a_j` of itself.
    #[test]
    fn estimation_inverts_moments(s in singular_values()) {
        let found = s_from_complement(&moments(s.into()).complement()).unwrap();
        let (a, b) = (sums(&s), sums(&found));
        let condition = 1.0 + a[2] / (1.0 + a[0]);
        for i in 0..3 {
            prop_assert!((a[i] - b[i]).abs() <= 1e-12 * condition * (1.0 + a[i]), "{s} {found}");
        }
    }

    #[test]
    fn rows_of_a_rotation_are_unit_vectors(s in singular_values()) {
        let m = moments(s.into());
        let second: f64 = (0..3).map(|j| m.second((0, j), (0, j))).sum();
        prop_assert!((second - 1.0).abs() < 1e-13);
        let third: f64 = (0..3).map(|j| m.third((1, 1), (j, 2), (j, 2))).sum();
        prop_assert!((third - m.first()[1]).abs() < 1e-13);
        // Cofactors: Q33 = Q11 Q22 - Q12 Q21.
        let cofactor = m.second((0, 0), (1, 1)) - m.second((0, 1), (1, 0));
        prop_assert!((cofactor - m.first()[2]).abs() < 1e-13);
    }

    /// Exchanging axes 1 and 2, or negating both: the same distribution in other coordinates.
    #[test]
    fn moments_move_with_the_group(s in singular_values(), left in rotation(), right in rotation()) {
        let s = s / (1.0 + s[0] / 100.0);
        let fisher = MatrixFisher::new(&Matrix3::from_diagonal(&s)).unwrap();
        let moved = MatrixFisher::new(&(left.matrix() * fisher.parameter() * right.matrix())).unwrap();
        let mean = left.matrix() * fisher.mean() * right.matrix();
        prop_assert!((moved.mean() - mean).norm() < 1e-12);
        let r = exp(&Vector3::new(0.1, 0.4, -0.3));
        let (p, q) = (fisher.log_density(&r), moved.log_density(&(left * r * right)));
        prop_assert!((p - q).abs() < 1e-11 * (1.0 + p.abs()));
    }

    #[test]
    fn information_is_inverted(s in singular_values(), mode in rotation(), axes in rotation()) {
        let s = s / (1.0 + s[0] / 1e6);
        let fisher = MatrixFisher::from_svd(ProperSvd { u: mode * axes, s, v: axes }).unwrap();
        let h = fisher.information();
        let back = MatrixFisher::from_mode_and_information(mode, h).unwrap();
        prop_assert!((back.parameter() - fisher.parameter()).norm() <= 1e-13 * (1.0 + s[0]));
    }
}

/// Random points of the simplex of moments, its boundary and its ties included.
#[test]
fn every_admissible_moment_has_a_distribution() {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    for n in 0..1000 {
        let mut y: [f64; 4] = std::array::from_fn(|_| match n % 3 {
            0 => -rand::Rng::random::<f64>(&mut rng).ln(),
            1 => 10f64.powf(rand::Rng::random_range(&mut rng, -10.0..0.0)),
            _ => 1.0 + 10f64.powf(rand::Rng::random_range(&mut rng, -12.0..-3.0)),
        });
        for i in 1..4 {
            if rand::Rng::random_range(&mut rng, 0..4) == 0 {
                y[i] = y[i - 1];
            }
        }
        y.sort_by(|a, b| b.total_cmp(a));
        let total: f64 = y.iter().sum();
        let target = Vector3::new(y[1], y[2], y[3]) / total;
        let s = s_from_quaternion_squares(&target).unwrap();
        let found = Moments::new(&s).unwrap().quaternion_squares();
        // Sums of singular values round to the last place of the largest.
        let tolerance = 1e-11 + 1e-15 * s[0];
        for i in 0..3 {
            assert!((found[i + 1] - target[i]).abs() <= tolerance * target[i], "{target} {s}");
        }
    }
}

#[test]
fn derivatives_of_the_log_constant_are_the_moments() {
    let s = Vector3::new(7.0, 3.0, -1.0);
    let covariance = moments(s.into()).diagonal_covariance();
    let h = 1e-4;
    for i in 0..3 {
        let mut step = Vector3::zeros();
        step[i] = h;
        let (plus, minus) = (moments((s + step).into()), moments((s - step).into()));
        let slope = (plus.log_c() - minus.log_c()) / (2.0 * h);
        assert!((slope - moments(s.into()).first()[i]).abs() < 1e-8);
        let curvature = (plus.first() - minus.first()) / (2.0 * h);
        assert!((curvature - covariance.column(i)).norm() < 1e-8);
    }
}

#[test]
fn derivatives_of_the_scaled_constant_are_moments_of_the_complement() {
    let s = Vector3::new(7.0, 3.0, -1.0);
    let h = 1e-4;
    for i in 0..3 {
        let mut step = Vector3::zeros();
        step[i] = h;
        let (plus, minus) = (moments((s + step).into()), moments((s - step).into()));
        let middle = moments(s.into());
        let slope = |f: &dyn Fn(&Moments) -> f64| {
            let scaled = |m: &Moments| m.c_scaled() * f(m);
            (scaled(&plus) - scaled(&minus)) / (2.0 * h * middle.c_scaled())
        };
        assert!((slope(&|_| 1.0) + middle.complement()[i]).abs() < 1e-7);
        for j in 0..3 {
            let second = slope(&|m| m.complement()[j]);
            assert!((second + middle.complement_second(i, j)).abs() < 1e-7);
            for k in 0..3 {
                let third = slope(&|m| m.complement_second(j, k));
                assert!((third + middle.complement_third(i, j, k)).abs() < 1e-7);
            }
        }
    }
}

/// (2.43): the moment generating function `E[exp(tr(T^T Q))] = c(S + T)/c(S)`.
#[test]
fn generating_function_is_the_ratio_of_constants() {
    let grid = HaarQuadrature::of_degree(40);
    let t = Matrix3::new(0.5, -1.0, 0.3, 0.2, 0.4, -0.6, -0.9, 0.1, 0.7);
    for s in [[0.0; 3], [2.0, 1.0, -1.0], [5.0, 3.0, 2.0]] {
        let fisher = MatrixFisher::new(&Matrix3::from_diagonal(&Vector3::from(s))).unwrap();
        let shifted = MatrixFisher::new(&(fisher.parameter() + t)).unwrap();
        let ratio = (shifted.moments().log_c() - fisher.moments().log_c()).exp();
        let growth = |r: &Rotation3<f64>| t.dot(r.matrix()).exp();
        let exact = grid.integrate(|r| fisher.log_density(r).exp() * growth(r));
        assert_relative_eq!(exact, ratio, max_relative = 1e-11);
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        let n = 40_000;
        let values: Vec<f64> =
            fisher.sampler().sample_iter(&mut rng).take(n).map(|r| growth(&r)).collect();
        let mean = values.iter().sum::<f64>() / n as f64;
        let square = values.iter().map(|x| x * x).sum::<f64>() / n as f64;
        let deviation = ((square - mean * mean) / n as f64).sqrt();
        assert!((mean - ratio).abs() < 5.0 * deviation, "{mean} {ratio} {deviation}");
    }
}

/// The 24 signed permutations of determinant one map a diagonal parameter to another.
#[test]
fn moments_are_permuted_and_signed_with_the_parameter() {
    let s = [9.0, 4.0, -1.5];
    let reference = MatrixFisher::new(&Matrix3::from_diagonal(&Vector3::from(s))).unwrap();
    let orders = [[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [2, 1, 0], [1, 0, 2]];
    for order in orders {
        for signs in [[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]] {
            let permuted = Vector3::from_fn(|i, _| signs[i] * s[order[i]]);
            let fisher = MatrixFisher::new(&Matrix3::from_diagonal(&permuted)).unwrap();
            assert_relative_eq!(
                fisher.moments().log_c(),
                reference.moments().log_c(),
                max_relative = 1e-14
            );
            let mean = fisher.mean();
            for i in 0..3 {
                let expected = signs[i] * reference.mean()[(order[i], order[i])];
                assert_relative_eq!(mean[(i, i)], expected, max_relative = 1e-13);
            }
            // Odd permutations mirror both sides: second moments move all the same.
            let second = fisher.second_moment()[(1, 3)];
            let (i, j) = (order[0], order[1]);
            let expected = signs[0] * signs[1] * reference.moments().second((i, j), (j, i));
            assert_relative_eq!(second, expected, max_relative = 1e-12, epsilon = 1e-14);
        }
    }
}

#[test]
fn samples_have_the_moments() {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let (left, right) = (exp(&Vector3::new(1.0, 0.2, -2.0)), exp(&Vector3::new(-0.3, 1.2, 0.4)));
    let n = 20_000;
    for s in
        [[0.0, 0.0, 0.0], [1.0, 0.5, -0.2], [50.0, 50.0, -50.0], [100.0, 2.0, 1.0], [1e6, 1e5, 1e3]]
    {
        let svd = ProperSvd { u: left, s: Vector3::from(s), v: right };
        let fisher = MatrixFisher::from_svd(svd).unwrap();
        let sampler = fisher.sampler();
        let mut mean = Matrix3::zeros();
        let mut second = SMatrix::<f64, 9, 9>::zeros();
        for _ in 0..n {
            let q = fisher.centred(&sampler.sample(&mut rng)).into_inner();
            let vec = SMatrix::<f64, 9, 1>::from_column_slice(q.as_slice());
            mean += q / f64::from(n);
            second += vec * vec.transpose() / f64::from(n);
        }
        let expected = fisher.moments().second_matrix();
        for i in 0..3 {
            let d = fisher.moments().first()[i];
            let sd = (fisher.moments().diagonal_covariance()[(i, i)] / f64::from(n)).sqrt();
            assert!((mean[(i, i)] - d).abs() < 5.0 * sd, "{s:?}");
        }
        for a in 0..9 {
            for b in 0..9 {
                // |X| <= E[X^2]^(1/2) scale of a product of two entries.
                let scale = (expected[(a, a)] * expected[(b, b)]).sqrt();
                let tolerance = 9.0 * scale / f64::from(n).sqrt();
                assert!((second[(a, b)] - expected[(a, b)]).abs() < tolerance, "{s:?} {a} {b}");
            }
        }
    }
}

#[test]
fn rotation_covariance_is_right_in_every_regime() {
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    for s in [[0.0, 0.0, 0.0], [5.0, 1.0, -0.5], [30.0, 20.0, 6.0], [500.0, 300.0, 100.0]] {
        let mode = exp(&Vector3::new(1.0, 0.2, -2.0));
        let axes = exp(&Vector3::new(-0.3, 1.2, 0.4));
        let svd = ProperSvd { u: mode * axes, s: Vector3::from(s), v: axes };
        let fisher = MatrixFisher::from_svd(svd).unwrap();
        let sampler = fisher.sampler();
        let n = 40_000;
        let mut covariance = Matrix3::zeros();
        for _ in 0..n {
            let e = log(&(mode.inverse() * sampler.sample(&mut rng)));
            covariance += e * e.transpose() / f64::from(n);
        }
        let expected = fisher.rotation_covariance();
        let tolerance = 6.0 * expected.trace() / f64::from(n).sqrt();
        assert!((covariance - expected).amax() < tolerance, "{covariance} {expected}");
    }
    // The uniform distribution: E[eta_i^2] = (pi^2/3 + 2)/3.
    let uniform = MatrixFisher::uniform().rotation_covariance();
    let exact = (std::f64::consts::PI.powi(2) / 3.0 + 2.0) / 3.0;
    assert!((uniform - Matrix3::identity() * exact).amax() < 1e-12, "{uniform} {exact}");
}

#[test]
fn the_two_covariance_routines_meet() {
    let sums = Sums::of_singular_values(&Vector3::new(60.0, 20.0, 5.001));
    let (series, quadrature) = (
        concentrated::rotation_vector_variances(&sums),
        quadrature::rotation_vector_variances(&sums),
    );
    for (a, b) in series.iter().zip(quadrature) {
        assert_relative_eq!(*a, b, max_relative = 1e-12);
    }
}

#[test]
fn what_no_distribution_has_is_refused() {
    assert!(Moments::new(&Vector3::new(1.0, 2.0, 0.0)).is_err());
    assert!(Moments::new(&Vector3::new(f64::NAN, 0.0, 0.0)).is_err());
    assert!(Moments::new(&Vector3::new(f64::INFINITY, 0.0, 0.0)).is_err());
    assert!(matches!(s_from_d(&Vector3::repeat(1.0)), Err(MomentError::NotAdmissible(_))));
    assert!(matches!(s_from_d(&Vector3::new(0.9, 0.9, 0.7)), Err(MomentError::NotAdmissible(_))));
    assert!(matches!(s_from_d(&Vector3::new(0.1, 0.2, 0.0)), Err(MomentError::NotOrdered(_))));
    assert!(matches!(s_from_d(&Vector3::repeat(f64::NAN)), Err(MomentError::NotFinite(_))));
    let point = Vector3::new(1e-300, 1e-310, f64::MIN_POSITIVE);
    assert!(matches!(s_from_quaternion_squares(&point), Err(MomentError::NotAdmissible(_))));
    let saddle = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -1.0));
    let refused = MatrixFisher::from_mode_and_information(Rotation3::identity(), saddle);
    assert!(matches!(refused, Err(MatrixFisherError::NegativeInformation(_))));
    assert!(MatrixFisher::new(&Matrix3::repeat(f64::NAN)).is_err());
}
