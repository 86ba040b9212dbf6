//! Quintic smoothing splines: four continuous derivatives through noisy, uneven samples.

use nalgebra::SVector;

const DEGREE: usize = 5;

/// A uniform B-spline of degree 5 in `D` dimensions.
#[derive(Debug, Clone)]
pub(super) struct Spline<const D: usize> {
    start: f64,
    /// Distance of the knots, s.
    step: f64,
    coefficients: Vec<SVector<f64, D>>,
}

/// How closely a spline follows its samples.
#[derive(Debug, Clone, Copy)]
pub(super) struct Smoothing {
    /// Distance of the knots, s.
    pub step: f64,
    /// Frequency above which motion is taken for noise, Hz.
    pub cutoff: f64,
    /// Samples farther than this from the curve lose weight, in the unit of the samples.
    pub tolerance: f64,
}

impl<const D: usize> Spline<D> {
    /// Fits samples ordered by time; `None` if there are too few, or if they are not finite.
    ///
    /// Penalised least squares with third differences (Eilers and Marx, 1996), reweighted against
    /// outliers.
    pub fn fit(times: &[f64], values: &[SVector<f64, D>], how: Smoothing) -> Option<Self> {
        const ROUNDS: usize = 4;
        let (start, end) = (*times.first()?, *times.last()?);
        let finite = values.iter().all(|v| v.iter().all(|x| x.is_finite()));
        if times.len() < 2 * DEGREE || times.len() != values.len() || end <= start || !finite {
            return None;
        }
        let intervals = ((end - start) / how.step).ceil().max(1.0);
        let step = (end - start) / intervals;
        let count = intervals as usize + DEGREE;
        let mut spline = Self { start, step, coefficients: vec![SVector::zeros(); count] };
        let density = times.len() as f64 / intervals;
        let response = 2.0 * (std::f64::consts::PI * (how.cutoff * step).min(0.5)).sin();
        let penalty = density / response.powi(6);
        let mut weights = vec![1.0; times.len()];
        for _ in 0..ROUNDS {
            let mut system = Banded::<D>::new(count);
            for ((&t, value), &weight) in times.iter().zip(values).zip(&weights) {
                let (first, u) = spline.locate(t);
                system.add(first, &basis::<6>(u), value, weight);
            }
            for first in 0..count - 3 {
                system.add(first, &[-1.0, 3.0, -3.0, 1.0], &SVector::zeros(), penalty);
            }
            spline.coefficients = system.solve()?;
            for ((&t, value), weight) in times.iter().zip(values).zip(&mut weights) {
                let residual = (spline.at(t)[0] - value).norm();
                *weight = (how.tolerance / residual.max(how.tolerance)).powi(2);
            }
        }
        Some(spline)
    }

    /// Value and first two derivatives; outside of the samples' span, those of its nearest end.
    pub fn at(&self, t: f64) -> [SVector<f64, D>; 3] {
        let (first, u) = self.locate(t);
        let c = |j: usize| self.coefficients[first + j];
        let sum = |weights: &[f64], term: &dyn Fn(usize) -> SVector<f64, D>| {
            weights.iter().enumerate().fold(SVector::zeros(), |sum, (j, w)| sum + term(j) * *w)
        };
        [
            sum(&basis::<6>(u), &c),
            sum(&basis::<5>(u), &|j| c(j + 1) - c(j)) / self.step,
            sum(&basis::<4>(u), &|j| c(j + 2) - c(j + 1) * 2.0 + c(j)) / (self.step * self.step),
        ]
    }

    /// First coefficient of the interval that holds `t`, and the position in it.
    fn locate(&self, t: f64) -> (usize, f64) {
        let last = self.coefficients.len() - DEGREE - 1;
        let x = ((t - self.start) / self.step).clamp(0.0, (last + 1) as f64);
        let first = (x as usize).min(last);
        (first, x - first as f64)
    }
}

/// Values of the `N` uniform B-splines of degree `N - 1` that are not zero at `u` in `[0, 1]`.
fn basis<const N: usize>(u: f64) -> [f64; N] {
    let mut weights = [0.0; N];
    weights[0] = 1.0;
    for degree in 1..N {
        let k = degree as f64;
        for j in (0..=degree).rev() {
            let older = if j > 0 { weights[j - 1] } else { 0.0 };
            let position = u + k - j as f64;
            weights[j] = (position * older + (k + 1.0 - position) * weights[j]) / k;
        }
    }
    weights
}

/// Normal equations whose matrix is zero beyond [`DEGREE`] places from the diagonal.
struct Banded<const D: usize> {
    /// Row `i` holds the entries at columns `i, i - 1, ..., i - DEGREE`.
    rows: Vec<[f64; DEGREE + 1]>,
    right: Vec<SVector<f64, D>>,
}

impl<const D: usize> Banded<D> {
    fn new(count: usize) -> Self {
        Self { rows: vec![[0.0; DEGREE + 1]; count], right: vec![SVector::zeros(); count] }
    }

    /// Adds the equation `sum_j weights[j] c[first + j] = value`.
    fn add(&mut self, first: usize, weights: &[f64], value: &SVector<f64, D>, precision: f64) {
        for (i, wi) in weights.iter().enumerate() {
            self.right[first + i] += value * (wi * precision);
            for (j, wj) in weights[..=i].iter().enumerate() {
                self.rows[first + i][i - j] += wi * wj * precision;
            }
        }
    }

    /// By Cholesky decomposition; `None` if the matrix is not positive definite.
    fn solve(mut self) -> Option<Vec<SVector<f64, D>>> {
        let n = self.rows.len();
        for i in 0..n {
            let reach = i.min(DEGREE);
            for k in (0..=reach).rev() {
                let j = i - k;
                let shared: f64 =
                    (k + 1..=reach).map(|m| self.rows[i][m] * self.rows[j][m - k]).sum();
                let rest = self.rows[i][k] - shared;
                self.rows[i][k] = if k > 0 { rest / self.rows[j][0] } else { rest.sqrt() };
            }
            let pivot = self.rows[i][0];
            if pivot.is_nan() || pivot <= 0.0 {
                return None;
            }
            let known = (1..=reach).map(|m| self.right[i - m] * self.rows[i][m]);
            let known = known.fold(SVector::zeros(), |sum: SVector<f64, D>, x| sum + x);
            self.right[i] = (self.right[i] - known) / pivot;
        }
        for i in (0..n).rev() {
            self.right[i] /= self.rows[i][0];
            let solved = self.right[i];
            for m in 1..=i.min(DEGREE) {
                self.right[i - m] -= solved * self.rows[i][m];
            }
        }
        Some(self.right)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector2;

    use super::*;

    const HOW: Smoothing = Smoothing { step: 0.05, cutoff: 6.0, tolerance: 0.01 };

    fn curve(t: f64) -> Vector2<f64> {
        Vector2::new((1.7 * t).sin(), 0.3 * t * t - (0.9 * t).cos())
    }

    fn fitted(noise: impl Fn(usize) -> f64) -> Spline<2> {
        let times: Vec<f64> = (0..1200).map(|k| 5.0 + f64::from(k) / 120.0).collect();
        let value = |(k, t): (usize, &f64)| curve(*t) + Vector2::repeat(noise(k));
        let values: Vec<Vector2<f64>> = times.iter().enumerate().map(value).collect();
        Spline::fit(&times, &values, HOW).unwrap()
    }

    #[test]
    fn smooth_motion_is_followed_with_its_derivatives() {
        let spline = fitted(|_| 0.0);
        for k in 0..80 {
            let t = 5.5 + 0.11 * f64::from(k);
            let [value, first, second] = spline.at(t);
            assert!((value - curve(t)).norm() < 1e-5, "{t}");
            let velocity = Vector2::new(1.7 * (1.7 * t).cos(), 0.6 * t + 0.9 * (0.9 * t).sin());
            assert!((first - velocity).norm() < 1e-3, "{t}");
            let acceleration = Vector2::new(-2.89 * (1.7 * t).sin(), 0.6 + 0.81 * (0.9 * t).cos());
            assert!((second - acceleration).norm() < 2e-2, "{t} {second} {acceleration}");
        }
    }

    #[test]
    fn derivatives_are_those_of_the_value() {
        let spline = fitted(|k| if k % 2 == 0 { 1e-3 } else { -1e-3 });
        let h = 1e-5;
        for k in 0..50 {
            let t = 5.2 + 0.17 * f64::from(k);
            let (before, now, after) = (spline.at(t - h), spline.at(t), spline.at(t + h));
            for d in 0..2 {
                let difference = (after[d] - before[d]) / (2.0 * h);
                assert!((difference - now[d + 1]).norm() < 1e-5 * (1.0 + now[d + 1].norm()));
            }
        }
    }

    #[test]
    fn outliers_and_noise_are_smoothed_away() {
        let spline = fitted(|k| if k % 97 == 3 { 0.2 } else { 0.0 });
        for k in 0..80 {
            let t = 5.5 + 0.11 * f64::from(k);
            assert!((spline.at(t)[0] - curve(t)).norm() < 5e-4, "{t}");
        }
    }

    #[test]
    fn too_few_samples_are_refused() {
        assert!(Spline::fit(&[0.0, 1.0], &[Vector2::zeros(); 2], HOW).is_none());
        let times: Vec<f64> = (0..50).map(f64::from).collect();
        assert!(Spline::fit(&times, &[Vector2::repeat(f64::NAN); 50], HOW).is_none());
    }
}
