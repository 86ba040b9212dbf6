//! Chapter 2 of W22: the recursive moments, and the concentrated approximations.

use nalgebra::{Matrix3, Rotation3, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::Distribution;
use rayon::prelude::*;
use std::sync::atomic::Ordering;

use super::{Report, Request, Row, Study, StudyError};
use crate::distribution::matrix_fisher::{
    ApproximateMoments, HigherMomentError, HigherMoments, MatrixFisher, MatrixFisherError, Moments,
};
use crate::evaluation::{Curve, Figure, Panel};
use crate::so3::HaarQuadrature;

/// Chapter 2.
pub const STUDIES: &[Study] = &[
    Study {
        name: "wang-2.1",
        title: "Table 2.1: recursive moments of orders 2 to 6 against samples (runs: samples)",
        runs: 100_000_000,
        run: table_2_1,
    },
    Study {
        name: "wang-fig-2.1",
        title: "Figure 2.1: error of the recursion as s3 approaches s2",
        runs: 1,
        run: |request| figure_2_1(request).map_err(Into::into),
    },
    Study {
        name: "wang-fig-2.2",
        title: "Figure 2.2: approximations of c(S), S = s I",
        runs: 1,
        run: |request| approximations(request, &FIGURES[0]).map_err(Into::into),
    },
    Study {
        name: "wang-fig-2.3",
        title: "Figure 2.3: approximations of 1 - d1, S = s I",
        runs: 1,
        run: |request| approximations(request, &FIGURES[1]).map_err(Into::into),
    },
    Study {
        name: "wang-fig-2.4",
        title: "Figure 2.4: approximations of c(S), S = diag(s, 0.1, 0.1)",
        runs: 1,
        run: |request| approximations(request, &FIGURES[2]).map_err(Into::into),
    },
    Study {
        name: "wang-fig-2.5",
        title: "Figure 2.5: approximations of 1 - d1, S = diag(s, 0.1, 0.1)",
        runs: 1,
        run: |request| approximations(request, &FIGURES[3]).map_err(Into::into),
    },
    Study {
        name: "wang-fig-2.6",
        title: "Figure 2.6: approximations of 1 - d2, S = diag(s, 0.1, 0.1)",
        runs: 1,
        run: |request| approximations(request, &FIGURES[4]).map_err(Into::into),
    },
];

/// Why a study of the matrix Fisher distribution could not be run.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MatrixFisherStudyError {
    #[error(transparent)]
    Distribution(#[from] MatrixFisherError),
    #[error(transparent)]
    Moment(#[from] HigherMomentError),
}

/// Largest differences between the moments of samples and those of the recursion, as the paper
/// has them with 1e8 samples.
struct PrintedDifferences {
    case: &'static str,
    s: [f64; 3],
    /// Largest absolute difference of the vanishing moments of orders 2, 3, 4.
    zero: [f64; 3],
    /// Largest relative difference of the other moments, in percent: of orders 2, 3, 4, of
    /// [`FIFTH`] and of [`SIXTH`].
    percent: [f64; 5],
}

const PRINTED_SAMPLES: f64 = 1e8;
const TABLE_2_1: [PrintedDifferences; 2] = [
    PrintedDifferences {
        case: "S=25,10,5",
        s: [25.0, 10.0, 5.0],
        zero: [3.21e-5, 3.06e-5, 2.92e-5],
        percent: [0.04, 0.42, 0.47, 0.06, 0.06],
    },
    PrintedDifferences {
        case: "S=25,10,-5",
        s: [25.0, 10.0, -5.0],
        zero: [6.69e-5, 6.33e-5, 6.00e-5],
        percent: [0.03, 0.22, 0.37, 0.002, 0.004],
    },
];
const ZERO_NAMES: [&str; 3] = ["zero_moments_2", "zero_moments_3", "zero_moments_4"];
const PERCENT_NAMES: [&str; 5] =
    ["moments_2_percent", "moments_3_percent", "moments_4_percent", "Q5_percent", "Q6_percent"];

fn table_2_1(request: &Request) -> Result<Report, StudyError> {
    if request.runs == 0 {
        return Err(StudyError::NoRuns);
    }
    let products = Products::new();
    let (mut rows, mut samples) = (Vec::new(), request.runs);
    for (stream, printed) in TABLE_2_1.iter().enumerate() {
        let means = sample_means(printed.s, &products, request, stream as u64)?;
        samples = samples.min(means.samples);
        rows.extend(compare(printed, &products, &means.values)?);
    }
    let factor = (PRINTED_SAMPLES / samples as f64).sqrt();
    let note = format!(
        "The differences are those of Monte Carlo; with {samples} samples they are {factor:.1} \
         times the paper's, which took 1e8. Step: CPU time of one moment by the recursion (paper: \
         0.2 s for order 4, 2 min for order 6)."
    );
    let name = "wang-2.1".to_owned();
    let (figures, notes) = (Vec::new(), vec![note]);
    Ok(Report { name, runs: samples, seed: request.seed, rows, figures, notes })
}

/// The rows of one `S`: means of samples against the recursion.
fn compare(
    printed: &PrintedDifferences,
    products: &Products,
    means: &[f64],
) -> Result<Vec<Row>, MatrixFisherStudyError> {
    let recursion = HigherMoments::new(&Vector3::from(printed.s))?;
    let (mut zero, mut percent) = ([0.0; 3], [0.0; 5]);
    let (mut times, mut counts) = ([0.0; 5], [0.0; 5]);
    for (entries, mean) in products.of_order_two_or_more().zip(&means[FIRST_OF_ORDER_TWO..]) {
        let start = cpu_time::ThreadTime::now();
        let moment = recursion.moment(entries)?;
        let elapsed = start.elapsed();
        let difference = (mean - moment).abs();
        let order = entries.len() - 2;
        if moment == 0.0 {
            zero[order] = f64::max(zero[order], difference);
        } else {
            percent[order] = f64::max(percent[order], 100.0 * difference / moment.abs());
            times[order] += elapsed.as_nanos() as f64;
            counts[order] += 1.0;
        }
    }
    let row = |quantity: &str, value: f64, paper: f64, step_time_ns| Row {
        paper: Some(paper),
        step_time_ns,
        ..Row::of_value(printed.case, "recursion", quantity, value)
    };
    let zeros = (0..3).map(|n| row(ZERO_NAMES[n], zero[n], printed.zero[n], None));
    let others = (0..5)
        .map(|n| row(PERCENT_NAMES[n], percent[n], printed.percent[n], Some(times[n] / counts[n])));
    Ok(zeros.chain(others).collect())
}

type Entry = (usize, usize);

/// `E[Q23 Q32 Q12 Q23 Q31]`, in the order of entries.
const FIFTH: [usize; 5] = [1, 5, 5, 6, 7];
/// `E[Q11 Q23 Q32 Q12 Q23 Q31]`.
const SIXTH: [usize; 6] = [0, 1, 5, 5, 6, 7];
/// The empty product and the nine entries come first.
const FIRST_OF_ORDER_TWO: usize = 10;

/// Products of up to four entries of `Q`, each once, and the two of higher order; each is a
/// shorter one times an entry.
struct Products {
    entries: Vec<Vec<Entry>>,
    /// Position of the shorter product, and the entry.
    steps: Vec<(usize, Entry)>,
}

impl Products {
    fn new() -> Self {
        let mut numbers: Vec<Vec<usize>> = vec![vec![]];
        let mut parents = vec![0];
        let mut level = 0..1;
        for _ in 1..=4 {
            for parent in level.clone() {
                let from = numbers[parent].last().copied().unwrap_or(0);
                for entry in from..9 {
                    numbers.push(numbers[parent].iter().copied().chain([entry]).collect());
                    parents.push(parent);
                }
            }
            level = level.end..numbers.len();
        }
        let fourth = numbers.iter().position(|n| n[..] == FIFTH[..4]).unwrap_or_default();
        parents.extend([fourth, numbers.len()]);
        numbers.extend([FIFTH.to_vec(), SIXTH.to_vec()]);
        let entry = |n: usize| (n / 3, n % 3);
        // Of the sixth-order product the first entry is the new one.
        let last = |n: &Vec<usize>| {
            let number = if n[..] == SIXTH { n.first() } else { n.last() };
            entry(number.copied().unwrap_or_default())
        };
        let steps = parents.into_iter().zip(numbers.iter().map(last)).collect();
        let entries = numbers.iter().map(|n| n.iter().map(|&e| entry(e)).collect()).collect();
        Self { entries, steps }
    }

    fn of_order_two_or_more(&self) -> impl Iterator<Item = &[Entry]> {
        self.entries[FIRST_OF_ORDER_TWO..].iter().map(Vec::as_slice)
    }

    /// Adds `weight` times each product to `sums`.
    fn add(&self, q: &Rotation3<f64>, weight: f64, values: &mut [f64], sums: &mut [f64]) {
        values[0] = weight;
        for (n, &(parent, entry)) in self.steps.iter().enumerate().skip(1) {
            values[n] = values[parent] * q[entry];
            sums[n] += values[n];
        }
    }
}

struct SampleMeans {
    samples: usize,
    values: Vec<f64>,
}

/// Samples drawn from one stream of random numbers.
const CHUNK: usize = 100_000;

/// Means of exact samples, the same at any number of threads.
fn sample_means(
    s: [f64; 3],
    products: &Products,
    request: &Request,
    stream: u64,
) -> Result<SampleMeans, StudyError> {
    let fisher = MatrixFisher::new(&Matrix3::from_diagonal(&Vector3::from(s)))
        .map_err(MatrixFisherStudyError::from)?;
    let sampler = fisher.sampler();
    let size = products.steps.len();
    let chunk = |first: usize| {
        if request.stop.load(Ordering::Relaxed) {
            return (0, Vec::new());
        }
        let mut rng = ChaCha8Rng::seed_from_u64(request.seed);
        rng.set_stream((stream << 32) | (first / CHUNK) as u64);
        let samples = CHUNK.min(request.runs - first);
        let (mut values, mut sums) = (vec![0.0; size], vec![0.0; size]);
        for q in sampler.sample_iter(&mut rng).take(samples) {
            products.add(&q, 1.0, &mut values, &mut sums);
            (request.finished_run)();
        }
        (samples, sums)
    };
    let firsts: Vec<usize> = (0..request.runs).step_by(CHUNK).collect();
    let chunks: Vec<_> = firsts.into_par_iter().map(chunk).collect();
    let samples: usize = chunks.iter().map(|(samples, _)| samples).sum();
    if samples == 0 {
        return Err(StudyError::Interrupted);
    }
    let mut values = vec![0.0; size];
    for (_, sums) in &chunks {
        for (value, sum) in values.iter_mut().zip(sums) {
            *value += sum / samples as f64;
        }
    }
    Ok(SampleMeans { samples, values })
}

/// Degree of the quadrature that stands for the truth in figure 2.1.
const DEGREE: usize = 64;

/// Figure 2.1: largest relative error of the recursion as `s3` approaches `s2`, for `s1 = 25`,
/// `s2 = 10`.
///
/// The paper compares with samples; quadrature on SO(3), to twelve digits, shows the error itself
/// below the floor of Monte Carlo, and that the one-pass moments have none.
fn figure_2_1(request: &Request) -> Result<Report, MatrixFisherStudyError> {
    const ORDERS: [usize; 4] = [2, 3, 4, 6];
    let products = Products::new();
    let grid = HaarQuadrature::of_degree(DEGREE);
    let mut curves = ORDERS.map(|order| curve(&format!("recursion, order {order}")));
    let mut pass = curve("one pass, order 3");
    for exponent in 0..9 {
        let gap = 10f64.powi(-exponent);
        let s = Vector3::new(25.0, 10.0, 10.0 - gap);
        let exact = quadrature_means(&s, &products, &grid);
        let higher = HigherMoments::new(&s)?;
        let one_pass = Moments::new(&s).map_err(MatrixFisherError::from)?;
        let mut largest = [0.0; ORDERS.len()];
        let mut largest_of_pass = 0.0;
        for (entries, exact) in products.of_order_two_or_more().zip(&exact[FIRST_OF_ORDER_TWO..]) {
            let moment = higher.moment(entries)?;
            let error = |found: f64| ((found - exact) / exact).abs();
            if moment == 0.0 {
                continue;
            }
            if let Some(n) = ORDERS.iter().position(|&order| order == entries.len()) {
                largest[n] = f64::max(largest[n], error(moment));
            }
            if let &[a, b, c] = entries {
                largest_of_pass = f64::max(largest_of_pass, error(one_pass.third(a, b, c)));
            }
        }
        for (curve, error) in curves.iter_mut().zip(largest) {
            curve.points.push([gap, error]);
        }
        pass.points.push([gap, largest_of_pass]);
    }
    let curves: Vec<Curve> = curves.into_iter().chain([pass]).collect();
    let title = "Moments as s3 approaches s2 (s1 = 25, s2 = 10)";
    let figure = Figure::logarithmic(title, "s2 - s3", "largest relative error", curves);
    let rows = rows_of(&figure, "gap", "relative_error", 2);
    Ok(report("wang-fig-2.1", request, rows, figure))
}

/// Means of the products under `M(diag(s))` by quadrature on the group.
fn quadrature_means(s: &Vector3<f64>, products: &Products, grid: &HaarQuadrature) -> Vec<f64> {
    let size = products.steps.len();
    let (mut values, mut sums, mut total) = (vec![0.0; size], vec![0.0; size], 0.0);
    for (q, weight) in grid.nodes() {
        let exponent: f64 = (0..3).map(|i| s[i] * (q[(i, i)] - 1.0)).sum();
        let density = weight * exponent.exp();
        total += density;
        products.add(q, density, &mut values, &mut sums);
    }
    sums.into_iter().map(|sum| sum / total).collect()
}

/// One of figures 2.2 to 2.6.
struct Approximated {
    name: &'static str,
    title: &'static str,
    label: &'static str,
    /// Name in the table.
    quantity: &'static str,
    range: (f64, f64),
    s_of: fn(f64) -> Vector3<f64>,
    value_of: fn(f64, &Vector3<f64>) -> f64,
}

/// From `log c` and `1 - d`.
const FIGURES: [Approximated; 5] = [
    Approximated {
        name: "wang-fig-2.2",
        title: "Normalizing constant, S = s I",
        label: "c(S)",
        quantity: "log_c",
        range: (0.1, 100.0),
        s_of: |s| Vector3::repeat(s),
        value_of: |log_c, _| log_c.exp(),
    },
    Approximated {
        name: "wang-fig-2.3",
        title: "First moment, S = s I",
        label: "1 - d1",
        quantity: "1-d1",
        range: (0.1, 100.0),
        s_of: |s| Vector3::repeat(s),
        value_of: |_, complement| complement[0],
    },
    Approximated {
        name: "wang-fig-2.4",
        title: "Normalizing constant, S = diag(s, 0.1, 0.1)",
        label: "c(S)",
        quantity: "log_c",
        range: (0.1, 100.0),
        s_of: one_axis,
        value_of: |log_c, _| log_c.exp(),
    },
    Approximated {
        name: "wang-fig-2.5",
        title: "First moment, S = diag(s, 0.1, 0.1)",
        label: "1 - d1",
        quantity: "1-d1",
        range: (0.1, 100.0),
        s_of: one_axis,
        value_of: |_, complement| complement[0],
    },
    Approximated {
        name: "wang-fig-2.6",
        title: "First moment, S = diag(s, 0.1, 0.1)",
        label: "1 - d2",
        quantity: "1-d2",
        range: (10.0, 1e4),
        s_of: one_axis,
        value_of: |_, complement| complement[1],
    },
];

fn one_axis(s: f64) -> Vector3<f64> {
    Vector3::new(s.max(0.1), 0.1, 0.1)
}

/// Abscissas of a decade.
const PER_DECADE: usize = 40;

/// Figures 2.2 to 2.6: exact constant and first moments beside the saddle-point approximation and
/// (2.59, 2.60), "approx 1", and (2.62-2.64), "approx 2".
fn approximations(
    request: &Request,
    shown: &Approximated,
) -> Result<Report, MatrixFisherStudyError> {
    let (from, to) = shown.range;
    let mut curves = ["exact", "saddle point", "approx 1", "approx 2"].map(curve);
    let points = ((to / from).log10() * PER_DECADE as f64).round() as usize;
    for n in 0..=points {
        let x = from * (to / from).powf(n as f64 / points as f64);
        let s = (shown.s_of)(x);
        let exact = Moments::new(&s).map_err(MatrixFisherError::from)?;
        let approximate = [
            ApproximateMoments::saddle_point(&s),
            ApproximateMoments::concentrated(&s),
            ApproximateMoments::concentrated_about_two_axes(&s),
        ];
        curves[0].points.push([x, (shown.value_of)(exact.log_c(), &exact.complement())]);
        for (curve, moments) in curves[1..].iter_mut().zip(approximate) {
            let moments = moments.map_err(MatrixFisherError::from)?;
            let value = (shown.value_of)(moments.log_c_scaled + s.sum(), &moments.complement);
            curve.points.push([x, value]);
        }
    }
    let figure = Figure::logarithmic(shown.title, "s", shown.label, curves.into());
    let mut rows = rows_of(&figure, "s", shown.quantity, PER_DECADE);
    if shown.quantity == "log_c" {
        rows.iter_mut().for_each(|row| row.mean = row.mean.ln());
    }
    Ok(report(shown.name, request, rows, figure))
}

fn curve(name: &str) -> Curve {
    Curve { name: name.to_owned(), points: Vec::new() }
}

/// Each curve at every `stride`-th abscissa.
fn rows_of(figure: &Figure, variable: &str, quantity: &str, stride: usize) -> Vec<Row> {
    let curves = figure.panels.iter().flat_map(|panel| match panel {
        Panel::Curves(panel) => panel.curves.as_slice(),
        _ => &[],
    });
    let row = |curve: &Curve, point: &[f64; 2]| {
        // Six digits, so that a power of ten is written as one.
        let abscissa: f64 = format!("{:.5e}", point[0]).parse().unwrap_or(point[0]);
        let case = format!("{variable}={abscissa}");
        Row::of_value(&case, &curve.name, quantity, point[1])
    };
    curves.flat_map(|c| c.points.iter().step_by(stride).map(move |p| row(c, p))).collect()
}

fn report(name: &str, request: &Request, rows: Vec<Row>, figure: Figure) -> Report {
    (request.finished_run)();
    let (name, figures) = (name.to_owned(), vec![figure.titled(name)]);
    Report { name, runs: 1, seed: request.seed, rows, figures, notes: Vec::new() }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use super::*;

    fn run(name: &str, runs: usize) -> Report {
        let stop = AtomicBool::new(false);
        let request = Request { runs, seed: 1, stop: &stop, finished_run: &|| () };
        (super::super::find(name).unwrap().run)(&request).unwrap()
    }

    fn curves(report: &Report) -> &[Curve] {
        let [Panel::Curves(panel)] = &report.figures[0].panels[..] else { panic!("one panel") };
        &panel.curves
    }

    #[test]
    fn samples_agree_with_the_recursion_as_in_table_2_1() {
        let samples = 20_000;
        let report = run("wang-2.1", samples);
        assert_eq!(report.rows.len(), 16);
        // Monte Carlo error scales with the root of the ratio of sample sizes; three times the
        // paper's own draw, taken as its largest over the orders.
        let scale = 3.0 * (PRINTED_SAMPLES / samples as f64).sqrt();
        for row in &report.rows {
            let paper = if row.quantity.ends_with("percent") { 0.5 } else { 6.69e-5 };
            assert!(row.mean > 0.0 && row.mean < scale * paper, "{row:?}");
        }
    }

    #[test]
    fn means_do_not_depend_on_threads() {
        let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let values = |report: Report| report.rows.into_iter().map(|r| r.mean).collect::<Vec<_>>();
        let alone = one.install(|| values(run("wang-2.1", 150_000)));
        assert_eq!(alone, values(run("wang-2.1", 150_000)));
    }

    #[test]
    fn approximations_meet_the_exact_curves_where_the_paper_says() {
        let good = [
            ("wang-fig-2.2", &[1, 2, 3][..]),
            ("wang-fig-2.3", &[1, 2, 3][..]),
            ("wang-fig-2.4", &[1, 3][..]),
            ("wang-fig-2.5", &[1, 2, 3][..]),
            ("wang-fig-2.6", &[1, 3][..]),
        ];
        for (name, good) in good {
            let report = run(name, 1);
            let last: Vec<f64> =
                curves(&report).iter().map(|c| c.points[c.points.len() - 1][1]).collect();
            for (n, value) in last.iter().enumerate().skip(1) {
                let close = (value / last[0] - 1.0).abs() < 0.05;
                assert_eq!(close, good.contains(&n), "{name} {n} {last:?}");
            }
        }
    }

    #[test]
    fn the_recursion_degrades_and_the_pass_does_not() {
        let report = run("wang-fig-2.1", 1);
        let [_, third, .., pass] = curves(&report) else { panic!("five curves") };
        assert!(third.points[0][1] < 1e-9 && third.points[8][1] > 1e-4);
        assert!(pass.points.iter().all(|p| p[1] < 1e-11), "{pass:?}");
    }
}
