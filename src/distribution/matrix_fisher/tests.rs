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
    const COLUMNS: [[usize; 4]; 12] = [
        [0, 0, 0, 0],
        [1, 1, 1, 1],
        [2, 2, 2, 2],
        [0, 0, 1, 1],
        [0, 0, 2, 2],
        [1, 1, 2, 2],
        [0, 1, 0, 1],
        [0, 1, 1, 0],
        [0, 2, 0, 2],
        [0, 2, 2, 0],
        [1, 2, 1, 2],
        [1, 2, 2, 1],
    ];
    for row in reference_lines("second_moments.csv").into_iter().flatten() {
        let m = moments([row[0], row[1], row[2]]);
        for (column, [i, j, k, l]) in COLUMNS.into_iter().enumerate() {
            let found = m.second((i, j), (k, l));
            assert!((found - row[3 + column]).abs() <= 1e-10, "{row:?} {column} {found}");
        }
    }
}

/// 80-digit arithmetic by a one-dimensional integral over another pair of circles: `s`,
/// `log(c exp(-tr S))`, `1 - d`, `E[Q12 Q21]`, `E[Q11 Q22]`, `E[Q12 Q23 Q31]`.
const GOLDEN: [[f64; 10]; 15] = [
    [
        100.0,
        100.0,
        10.0,
        -8.9588095161417147e0,
        7.0590730800129389e-3,
        7.0590730800129389e-3,
        9.111835633600001e-3,
        -4.9439480254003061e-3,
        9.8594421634099971e-1,
        8.5975817388321419e-5,
    ],
    [
        3.0,
        9.9999999999999995e-7,
        9.9999999999999995e-7,
        -1.7942432985962906e0,
        3.2836351001957315e-1,
        9.9999927612117001e-1,
        9.9999927612117001e-1,
        -1.6666666666659852e-7,
        5.5721216332661708e-7,
        1.1193941499668378e-1,
    ],
    [
        1.0e8,
        10000.0,
        3.0,
        -2.4638124134333989e1,
        9.9994999249931295e-9,
        4.9991253373963591e-5,
        4.9991253873763594e-5,
        -9.9985001874612623e-9,
        9.9994999874762602e-1,
        9.9965011370901388e-13,
    ],
    [
        1.0e8,
        1.0,
        0.0156,
        -1.9886506909958431e1,
        9.9999999770530025e-9,
        5.4810953977796695e-1,
        5.4810953977796695e-1,
        -4.5189045022203322e-9,
        4.5189045570312852e-1,
        4.4494925189250988e-9,
    ],
    [
        1.0e8,
        10.0,
        -3.0,
        -2.0986335041823086e1,
        9.9999996760637788e-9,
        7.4467794224501768e-2,
        7.446779422450242e-2,
        -9.2553210577550844e-9,
        9.2553219652017649e-1,
        1.3221888653935721e-9,
    ],
    [
        10000.0,
        10.0,
        -10.0,
        -9.903487052535878e0,
        1.000001000001e-4,
        9.9999994999995001e-1,
        1.0000000500000501e0,
        9.9985099970099959e-8,
        4.9985049970049957e-8,
        4.999504998005184e-5,
    ],
    [
        10000.0,
        25.0,
        3.0,
        -1.2485354410904062e1,
        9.9862832662268996e-5,
        1.8072504837918148e-2,
        1.8072614536224735e-2,
        -9.7943386628082774e-5,
        9.8182944207714717e-1,
        3.50688084340666e-6,
    ],
    [
        14.9,
        10.0,
        0.1,
        -5.7024954701307555e0,
        5.4256527404914663e-2,
        7.1221650068507419e-2,
        8.4876395312058331e-2,
        -3.5909865486668191e-2,
        8.7921373920127344e-1,
        6.0641413065677819e-3,
    ],
    [
        1.0e8,
        40.0,
        40.0,
        -2.2222207777218721e1,
        9.9999960250807008e-9,
        6.269785287230348e-3,
        6.269785287230348e-3,
        -9.9372981471293258e-9,
        9.9373020477547147e-1,
        1.2421627683907607e-10,
    ],
    [
        25.0,
        3.0,
        -0.1,
        -5.3508029587833228e0,
        3.8376371982365702e-2,
        2.1639134000498475e-1,
        2.1866670962486776e-1,
        -2.7119067558153374e-2,
        7.5421422281697892e-1,
        1.0782534873369051e-2,
    ],
    [
        1.0e8,
        10000.0,
        -40.0,
        -2.4635969877175594e1,
        9.9995020749939383e-9,
        5.0207062899773737e-5,
        5.0207063401723747e-5,
        -9.9984980293659816e-9,
        9.9994978293810022e-1,
        1.0039656555989902e-12,
    ],
    [
        10000.0,
        10000.0,
        -0.001,
        -1.5774138509974854e1,
        7.5001567703413896e-5,
        7.5001567703413896e-5,
        1.000025103443183e-4,
        -4.999374979609291e-5,
        9.9985000373985955e-1,
        9.9990014747592532e-9,
    ],
    [
        1.0e8,
        1.0,
        -1.0,
        -1.9113827924512311e1,
        1.0e-8,
        1.0e0,
        1.0e0,
        9.9999998500000006e-17,
        4.9999998500000007e-17,
        4.9999999500000001e-9,
    ],
    [
        10000.0,
        100.0,
        -0.001,
        -1.3128700024750938e1,
        9.950743742624023e-5,
        5.0621840630141685e-3,
        5.0626791422155133e-3,
        -9.8503731474283436e-5,
        9.9483881712631017e-1,
        9.9494727132048577e-7,
    ],
    [
        1.0e6,
        1.0e6,
        -9.9999999999999995e-7,
        -2.2681924828489798e1,
        7.5000015625070317e-7,
        7.5000015625070317e-7,
        1.0000002500013438e-6,
        -4.9999937499979686e-7,
        9.9999850000037505e-1,
        9.9999900000125007e-13,
    ],
];

#[test]
fn moments_agree_with_multiple_precision() {
    for [s1, s2, s3, log_c, g1, g2, g3, cross, diagonal, cycle] in GOLDEN {
        let m = moments([s1, s2, s3]);
        assert_relative_eq!(m.log_c_scaled(), log_c, max_relative = 1e-14);
        for (found, value) in m.complement().iter().zip([g1, g2, g3]) {
            assert_relative_eq!(*found, value, max_relative = 1e-12);
        }
        assert_relative_eq!(m.second((0, 1), (1, 0)), cross, max_relative = 1e-12);
        assert_relative_eq!(m.second((0, 0), (1, 1)), diagonal, max_relative = 1e-12);
        assert_relative_eq!(m.third((0, 1), (1, 2), (2, 0)), cycle, max_relative = 1e-12);
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

fn singular_values() -> impl Strategy<Value = Vector3<f64>> {
    let exponent = -4.0..6.0f64;
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
    let saddle = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -1.0));
    let refused = MatrixFisher::from_mode_and_information(Rotation3::identity(), saddle);
    assert!(matches!(refused, Err(MatrixFisherError::NegativeInformation(_))));
    assert!(MatrixFisher::new(&Matrix3::repeat(f64::NAN)).is_err());
}
