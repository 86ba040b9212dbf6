//! Chapter 2 of W22: the recursive moments against samples, and the concentrated approximations.

use nalgebra::{Matrix3, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::Distribution;
use serde::Serialize;

use crate::distribution::matrix_fisher::{
    ApproximateMoments, HigherMomentError, HigherMoments, MatrixFisher, MatrixFisherError, Moments,
};

/// Chapter 2.
pub const STUDIES: &[super::Study] = &[];

/// Why a study of the matrix Fisher distribution could not be run.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MatrixFisherStudyError {
    #[error(transparent)]
    Distribution(#[from] MatrixFisherError),
    #[error(transparent)]
    Moment(#[from] HigherMomentError),
    #[error("a Monte Carlo study needs at least one sample")]
    NoSamples,
}

/// Largest differences between the moments of samples and those of the recursion for one `S`, a
/// row of table 2.1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MomentComparison {
    pub s: [f64; 3],
    pub samples: usize,
    /// Largest absolute difference of the vanishing moments of orders 2, 3, 4.
    pub zero: [f64; 3],
    /// Largest relative difference of the other moments of orders 2, 3, 4, in percent.
    pub nonzero_percent: [f64; 3],
    /// Of `E[Q23 Q32 Q12 Q23 Q31]`, in percent.
    pub fifth_percent: f64,
    /// Of `E[Q11 Q23 Q32 Q12 Q23 Q31]`, in percent.
    pub sixth_percent: f64,
}

/// The paper's row with 1e8 samples; Monte Carlo differences scale with `1/sqrt(samples)`.
pub const TABLE_2_1: [MomentComparison; 2] = [
    MomentComparison {
        s: [25.0, 10.0, 5.0],
        samples: 100_000_000,
        zero: [3.21e-5, 3.06e-5, 2.92e-5],
        nonzero_percent: [0.04, 0.42, 0.47],
        fifth_percent: 0.06,
        sixth_percent: 0.06,
    },
    MomentComparison {
        s: [25.0, 10.0, -5.0],
        samples: 100_000_000,
        zero: [6.69e-5, 6.33e-5, 6.00e-5],
        nonzero_percent: [0.03, 0.22, 0.37],
        fifth_percent: 0.002,
        sixth_percent: 0.004,
    },
];

type Entry = (usize, usize);

const FIFTH: [Entry; 5] = [(1, 2), (2, 1), (0, 1), (1, 2), (2, 0)];
const SIXTH: [Entry; 6] = [(0, 0), (1, 2), (2, 1), (0, 1), (1, 2), (2, 0)];

/// Table 2.1 for each `S` of the paper.
pub fn table_2_1(
    samples: usize,
    seed: u64,
) -> Result<Vec<MomentComparison>, MatrixFisherStudyError> {
    TABLE_2_1.iter().map(|row| compare_moments(row.s, samples, seed)).collect()
}

/// One row: `samples` exact samples against the recursion.
pub fn compare_moments(
    s: [f64; 3],
    samples: usize,
    seed: u64,
) -> Result<MomentComparison, MatrixFisherStudyError> {
    let products = all_products();
    let means = sample_means(s, &products, samples, seed)?;
    let recursion = HigherMoments::new(&Vector3::from(s))?;
    let mut row = MomentComparison {
        s,
        samples,
        zero: [0.0; 3],
        nonzero_percent: [0.0; 3],
        fifth_percent: 0.0,
        sixth_percent: 0.0,
    };
    for (entries, mean) in products.iter().zip(means) {
        let moment = recursion.moment(entries)?;
        let difference = (mean - moment).abs();
        let percent = 100.0 * difference / moment.abs();
        match entries.len() {
            6 => row.sixth_percent = percent,
            5 => row.fifth_percent = percent,
            n if moment == 0.0 => row.zero[n - 2] = row.zero[n - 2].max(difference),
            n => row.nonzero_percent[n - 2] = row.nonzero_percent[n - 2].max(percent),
        }
    }
    Ok(row)
}

/// Products of two, three and four entries, each once, and the two of higher order.
fn all_products() -> Vec<Vec<Entry>> {
    let mut products = Vec::new();
    let mut level: Vec<Vec<usize>> = vec![vec![]];
    for order in 1..=4 {
        let extend = |product: &Vec<usize>| {
            let from = product.last().copied().unwrap_or(0);
            let longer = |e| product.iter().copied().chain([e]).collect();
            (from..9).map(longer).collect::<Vec<Vec<usize>>>()
        };
        level = level.iter().flat_map(extend).collect();
        if order >= 2 {
            let entries = |product: &Vec<usize>| product.iter().map(|e| (e / 3, e % 3)).collect();
            products.extend(level.iter().map(entries));
        }
    }
    products.extend([FIFTH.to_vec(), SIXTH.to_vec()]);
    products
}

fn sample_means(
    s: [f64; 3],
    products: &[Vec<Entry>],
    samples: usize,
    seed: u64,
) -> Result<Vec<f64>, MatrixFisherStudyError> {
    if samples == 0 {
        return Err(MatrixFisherStudyError::NoSamples);
    }
    let fisher = MatrixFisher::new(&Matrix3::from_diagonal(&Vector3::from(s)))?;
    let sampler = fisher.sampler();
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut sums = vec![0.0; products.len()];
    for _ in 0..samples {
        let q = sampler.sample(&mut rng).into_inner();
        for (sum, entries) in sums.iter_mut().zip(products) {
            *sum += entries.iter().map(|&e| q[e]).product::<f64>();
        }
    }
    Ok(sums.into_iter().map(|sum| sum / samples as f64).collect())
}

/// A curve of a figure.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Curve {
    pub label: &'static str,
    pub points: Vec<(f64, f64)>,
}

/// A figure as plain values; both axes are logarithmic.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Figure {
    /// The paper's number, such as `2.2`.
    pub number: &'static str,
    pub title: &'static str,
    pub x_label: &'static str,
    pub y_label: &'static str,
    pub curves: Vec<Curve>,
}

/// Abscissas of a curve.
const POINTS: usize = 121;

/// Figure 2.1: largest relative difference from the exact moments of order 3, and from samples of
/// order 4, as `s3` approaches `s2`, for `s1 = 25`, `s2 = 10`.
///
/// The paper compares with samples throughout; the one-pass moments, which do not degrade, show
/// the recursion's own error below the Monte Carlo floor.
pub fn figure_2_1(samples: usize, seed: u64) -> Result<Figure, MatrixFisherStudyError> {
    let products = all_products();
    let mut recursion = vec![Vec::new(); 2];
    let mut pass = Vec::new();
    for exponent in 0..9 {
        let gap = 10f64.powi(-exponent);
        let s = [25.0, 10.0, 10.0 - gap];
        let means = sample_means(s, &products, samples, seed)?;
        let higher = HigherMoments::new(&Vector3::from(s))?;
        let exact = Moments::new(&Vector3::from(s)).map_err(MatrixFisherError::from)?;
        let (mut against_pass, mut against_samples, mut pass_against_samples) = (0.0, 0.0, 0.0);
        for (entries, mean) in products.iter().zip(means) {
            let moment = higher.moment(entries)?;
            if moment == 0.0 {
                continue;
            }
            if let &[a, b, c] = entries.as_slice() {
                let third = exact.third(a, b, c);
                against_pass = f64::max(against_pass, ((moment - third) / third).abs());
                pass_against_samples =
                    f64::max(pass_against_samples, ((mean - third) / third).abs());
            } else if entries.len() == 4 {
                against_samples = f64::max(against_samples, ((moment - mean) / mean).abs());
            }
        }
        recursion[0].push((gap, against_pass));
        recursion[1].push((gap, against_samples));
        pass.push((gap, pass_against_samples));
    }
    let [third, fourth] = [recursion.remove(0), recursion.remove(0)];
    Ok(Figure {
        number: "2.1",
        title: "Recursive moments as s3 approaches s2 (s1 = 25, s2 = 10)",
        x_label: "s2 - s3",
        y_label: "largest relative difference",
        curves: vec![
            Curve { label: "recursion, order 3, against the pass", points: third },
            Curve { label: "recursion, order 4, against samples", points: fourth },
            Curve { label: "pass, order 3, against samples", points: pass },
        ],
    })
}

/// Figures 2.2 to 2.6: exact constant and first moments beside their approximations (2.59, 2.60),
/// "approx 1", and (2.62-2.64), "approx 2".
pub fn figures_2_2_to_2_6() -> Result<Vec<Figure>, MatrixFisherStudyError> {
    const ISOTROPIC: (f64, f64) = (0.1, 100.0);
    let isotropic = |s: f64| Vector3::repeat(s);
    let one_axis = |s: f64| Vector3::new(s.max(0.1), 0.1, 0.1);
    Ok(vec![
        figure("2.2", "Normalizing constant, S = s I", "c(S)", ISOTROPIC, isotropic, constant)?,
        figure("2.3", "First moment, S = s I", "1 - d1", ISOTROPIC, isotropic, |m| {
            m.complement[0]
        })?,
        figure(
            "2.4",
            "Normalizing constant, S = diag(s, 0.1, 0.1)",
            "c(S)",
            ISOTROPIC,
            one_axis,
            constant,
        )?,
        figure("2.5", "First moment, S = diag(s, 0.1, 0.1)", "1 - d1", ISOTROPIC, one_axis, |m| {
            m.complement[0]
        })?,
        figure(
            "2.6",
            "First moment, S = diag(s, 0.1, 0.1)",
            "1 - d2",
            (10.0, 1e4),
            one_axis,
            |m| m.complement[1],
        )?,
    ])
}

/// What a figure shows of a distribution.
struct Shown {
    log_c: f64,
    complement: Vector3<f64>,
}

fn constant(shown: &Shown) -> f64 {
    shown.log_c.exp()
}

fn figure(
    number: &'static str,
    title: &'static str,
    y_label: &'static str,
    (from, to): (f64, f64),
    s_of: impl Fn(f64) -> Vector3<f64>,
    quantity: impl Fn(&Shown) -> f64,
) -> Result<Figure, MatrixFisherStudyError> {
    let mut curves = ["exact", "approx 1", "approx 2"].map(|label| Curve { label, points: vec![] });
    for i in 0..POINTS {
        let x = from * (to / from).powf(i as f64 / (POINTS - 1) as f64);
        let s = s_of(x);
        let exact = Moments::new(&s).map_err(MatrixFisherError::from)?;
        let approximate = |m: ApproximateMoments| Shown {
            log_c: m.log_c_scaled + s.sum(),
            complement: m.complement,
        };
        let three = ApproximateMoments::concentrated(&s).map_err(MatrixFisherError::from)?;
        let two =
            ApproximateMoments::concentrated_about_two_axes(&s).map_err(MatrixFisherError::from)?;
        let exact = Shown { log_c: exact.log_c(), complement: exact.complement() };
        let shown = [exact, approximate(three), approximate(two)];
        for (curve, shown) in curves.iter_mut().zip(shown) {
            curve.points.push((x, quantity(&shown)));
        }
    }
    Ok(Figure { number, title, x_label: "s", y_label, curves: curves.into() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_agree_with_the_recursion_as_in_table_2_1() {
        let samples = 20_000;
        for (row, paper) in table_2_1(samples, 1).unwrap().iter().zip(TABLE_2_1) {
            // Monte Carlo error scales with the root of the ratio of sample sizes; three times
            // the paper's own draw.
            let scale = 3.0 * (paper.samples as f64 / samples as f64).sqrt();
            for order in 0..3 {
                assert!(row.zero[order] < scale * 6.69e-5, "{row:?}");
                assert!(row.nonzero_percent[order] < scale * 0.5, "{row:?}");
            }
        }
    }

    #[test]
    fn approximations_meet_the_exact_curves_where_the_paper_says() {
        let figures = figures_2_2_to_2_6().unwrap();
        let last = |figure: &Figure, curve: usize| figure.curves[curve].points[POINTS - 1].1;
        for (figure, curve) in [(0, 1), (1, 1), (2, 2), (3, 2), (4, 2)] {
            let (exact, approximate) = (last(&figures[figure], 0), last(&figures[figure], curve));
            assert!((approximate / exact - 1.0).abs() < 0.01, "{}", figures[figure].number);
        }
    }

    #[test]
    fn the_recursion_degrades_and_the_pass_does_not() {
        let figure = figure_2_1(2000, 1).unwrap();
        let [recursion, _, pass] = &figure.curves[..] else { panic!("three curves") };
        assert!(recursion.points[0].1 < 1e-9 && recursion.points[8].1 > 1e-4);
        let (near, far) = (pass.points[8].1, pass.points[0].1);
        assert!(near < 10.0 * far, "{near} {far}");
    }
}
