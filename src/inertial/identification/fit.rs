//! Noise coefficients by maximum likelihood from an Allan deviation.

use nalgebra::{DMatrix, DVector, Matrix3, Vector3};
use serde::Serialize;

use super::allan::{AllanPoint, NoiseKind, degrees_of_freedom, transfer};

/// A coefficient of the noise model with its uncertainty.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Coefficient {
    /// Zero if there is none to be seen.
    pub value: f64,
    /// Standard deviation; of a value that is not significant that of its square, as a root.
    pub sd: f64,
    /// Whether the data tell it from zero (its square by two standard deviations).
    pub significant: bool,
    /// Its 95 % limit from above.
    pub at_most: f64,
}

/// `AVAR(tau) = N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3` (IEEE Std 952-1997, annex C).
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct NoiseFit {
    /// N, unit/sqrt(Hz): a value each h seconds has the standard deviation `N / sqrt(h)`.
    pub white_noise: Coefficient,
    /// B, in the unit of the series.
    pub bias_instability: Coefficient,
    /// K, unit sqrt(Hz).
    pub random_walk: Coefficient,
}

/// Standard normal quantiles: of significance, and of a limit at 95 % from one side.
const SIGNIFICANT: f64 = 2.0;
const ONE_SIDED_95: f64 = 1.645;
/// Steps of the scoring; it converges in about ten.
const STEPS: usize = 100;

impl Coefficient {
    /// Of the square's estimate and its standard deviation.
    fn of_square(square: f64, sd: f64) -> Self {
        let significant = square > SIGNIFICANT * sd;
        let value = square.sqrt();
        let spread = if significant { sd / (2.0 * value) } else { sd.sqrt() };
        Self { value, sd: spread, significant, at_most: (square + ONE_SIDED_95 * sd).sqrt() }
    }
}

/// The squares of the coefficients in the Allan variance of averages of `factor` values. A random
/// walk of sums has the further `1 + 1 / (2 m^2)`.
fn design(point: &AllanPoint) -> Vector3<f64> {
    let m = point.factor as f64;
    Vector3::new(
        1.0 / point.tau,
        std::f64::consts::LN_2 * std::f64::consts::FRAC_2_PI,
        point.tau / 3.0 * (1.0 + 0.5 / (m * m)),
    )
}

/// Allan variances and what of them is not noise of the model.
pub(super) struct Observations<'a> {
    pub points: &'a [AllanPoint],
    /// Values in the series.
    pub count: usize,
    /// Variance that vibrations contribute at each point, and its relative standard deviation.
    pub vibration: &'a [f64],
    pub vibration_sd: f64,
}

impl NoiseFit {
    /// Fits the coefficients: each Allan variance is taken for a chi-square variable about the
    /// model's with the degrees of freedom of the noise that prevails there, so that the maximum of
    /// the likelihood is the fixed point of least squares weighted by the model (scoring). Squares
    /// are not negative. `None` where the points do not determine three coefficients.
    pub(super) fn new(observations: &Observations) -> Option<Self> {
        let rows: Vec<Vector3<f64>> = observations.points.iter().map(design).collect();
        let values: Vec<f64> =
            observations.points.iter().map(|point| point.deviation.powi(2)).collect();
        let mut squares = Vector3::zeros();
        let mut model = values.clone();
        let mut weights = Vec::new();
        for _ in 0..STEPS {
            weights = observations.weights(&rows, &squares, &model);
            let next = non_negative_least_squares(&rows, &values, observations, &weights)?;
            let change = (next - squares).component_div(&next.add_scalar(f64::MIN_POSITIVE));
            squares = next;
            model = rows
                .iter()
                .zip(observations.vibration)
                .map(|(row, vibration)| row.dot(&squares) + vibration)
                .collect();
            if change.amax() < 1e-9 {
                break;
            }
        }
        let covariance = observations.covariance(&rows, &squares, &weights)?;
        let sd = covariance.diagonal().map(f64::sqrt);
        let coefficient = |k: usize| Coefficient::of_square(squares[k], sd[k]);
        Some(Self {
            white_noise: coefficient(0),
            bias_instability: coefficient(1),
            random_walk: coefficient(2),
        })
    }

    /// The model's Allan deviation, without vibrations.
    pub fn deviation(&self, point: &AllanPoint) -> f64 {
        let coefficients = [self.white_noise, self.bias_instability, self.random_walk];
        let squares = Vector3::from(coefficients.map(|c| c.value * c.value));
        design(point).dot(&squares).sqrt()
    }
}

impl Observations<'_> {
    /// Inverse variance of each Allan variance under the model.
    fn weights(&self, rows: &[Vector3<f64>], squares: &Vector3<f64>, model: &[f64]) -> Vec<f64> {
        let kinds = [NoiseKind::White, NoiseKind::Flicker, NoiseKind::RandomWalk];
        let points = self.points.iter().zip(rows).zip(model.iter().zip(self.vibration));
        points
            .map(|((point, row), (model, vibration))| {
                let shares = row.component_mul(squares);
                let freedom = degrees_of_freedom(kinds[shares.imax()], self.count, point.factor);
                let variance =
                    2.0 * model * model / freedom + (self.vibration_sd * vibration).powi(2);
                1.0 / variance
            })
            .collect()
    }
}

/// Frequencies a decade at which spectra are integrated: many for what oscillates along them.
const PER_DECADE: f64 = 300.0;

impl Observations<'_> {
    /// Covariance of the squares of the coefficients: that of a weighted mean of Allan variances that
    /// are correlated, `G^-1 (sum w_i w_j a_i a_j^T C_ij) G^-1` with `G = sum w_i a_i a_i^T`.
    fn covariance(
        &self,
        rows: &[Vector3<f64>],
        squares: &Vector3<f64>,
        weights: &[f64],
    ) -> Option<Matrix3<f64>> {
        let correlation = self.correlation(squares);
        let information: Matrix3<f64> =
            rows.iter().zip(weights).map(|(row, weight)| row * row.transpose() * *weight).sum();
        let inverse = scaled_inverse(&information)?;
        let mut spread = Matrix3::zeros();
        for (i, (a, wa)) in rows.iter().zip(weights).enumerate() {
            for (j, (b, wb)) in rows.iter().zip(weights).enumerate() {
                // w_i w_j C_ij, where C_ii = 1 / w_i.
                spread += a * b.transpose() * (wa.sqrt() * wb.sqrt() * correlation[(i, j)]);
            }
        }
        Some(inverse * spread * inverse)
    }

    /// Correlations of the Allan variances under the model. With the spectral density S and the
    /// transfers G of two averaging times their covariance is `1/T int S^2 G_i G_j df`.
    fn correlation(&self, squares: &Vector3<f64>) -> DMatrix<f64> {
        let interval = self.points.first().map_or(1.0, |point| point.tau / point.factor as f64);
        let (low, high) = (0.1 / (interval * self.count as f64), 0.5 / interval);
        let steps = (PER_DECADE * (high / low).log10()).ceil() as usize;
        let root_density = |f: f64| {
            let flicker = squares[1] / (std::f64::consts::PI * f);
            let walk = 2.0 * squares[2] / (std::f64::consts::TAU * f).powi(2);
            // The step of a logarithmic axis is proportional to f.
            (2.0 * squares[0] + flicker + walk) * f.sqrt()
        };
        let passed = DMatrix::from_fn(self.points.len(), steps, |i, k| {
            let f = low * (high / low).powf((k as f64 + 0.5) / steps as f64);
            transfer(f, self.points[i].factor, interval) * root_density(f)
        });
        let covariance = &passed * passed.transpose();
        let sd = covariance.diagonal().map(f64::sqrt);
        DMatrix::from_fn(sd.len(), sd.len(), |i, j| covariance[(i, j)] / (sd[i] * sd[j]))
    }
}

/// The inverse of a matrix whose rows may differ in scale by many orders of magnitude.
fn scaled_inverse(information: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    let scale = information.diagonal().map(|x| 1.0 / x.sqrt());
    let scale = Matrix3::from_diagonal(&scale);
    let inverse = (scale * information * scale).try_inverse()?;
    let inverse = scale * inverse * scale;
    inverse.iter().all(|x| x.is_finite()).then_some(inverse)
}

/// The best of the solutions on each subset of the unknowns, none of them negative: three unknowns
/// have seven subsets.
fn non_negative_least_squares(
    rows: &[Vector3<f64>],
    values: &[f64],
    observations: &Observations,
    weights: &[f64],
) -> Option<Vector3<f64>> {
    let targets: Vec<f64> =
        values.iter().zip(observations.vibration).map(|(value, v)| value - v).collect();
    let mut best: Option<(f64, Vector3<f64>)> = None;
    for subset in 1..8_u32 {
        let columns: Vec<usize> = (0..3).filter(|k| subset >> k & 1 == 1).collect();
        let root = |i: usize| weights[i].sqrt();
        let a = DMatrix::from_fn(rows.len(), columns.len(), |i, k| root(i) * rows[i][columns[k]]);
        let b = DVector::from_fn(rows.len(), |i, _| root(i) * targets[i]);
        let norms: Vec<f64> = a.column_iter().map(|column| column.norm()).collect();
        let scaled = DMatrix::from_fn(a.nrows(), a.ncols(), |i, k| a[(i, k)] / norms[k]);
        let Some(solution) = scaled.clone().svd(true, true).solve(&b, 1e-12).ok() else { continue };
        if solution.iter().any(|x| *x < 0.0 || x.is_nan()) {
            continue;
        }
        let cost = (&scaled * &solution - &b).norm_squared();
        if best.as_ref().is_none_or(|(least, _)| cost < *least) {
            let mut squares = Vector3::zeros();
            for (k, column) in columns.iter().enumerate() {
                squares[*column] = solution[k] / norms[k];
            }
            best = Some((cost, squares));
        }
    }
    best.map(|(_, squares)| squares)
}
