//! Closed-form approximations of the constant and the first moments.
//!
//! They are the textbook limits of the exact pass, kept for comparison and for the figures of
//! W22 chapter 2; the pass is fast enough that nothing else here needs them.

use nalgebra::Vector3;

use super::super::circle::CircleMoments;
use super::sums::Sums;
use super::{InvalidSingularValues, check_singular_values};

/// An approximate constant and approximate first moments of `M(S)`.
///
/// Largest relative errors of `c` and of `1 - d_i` (near the uniform distribution: absolute error
/// of `d_i`), measured against [`Moments`](super::Moments) on grids over each range:
///
/// | approximation | range | `c` | `1 - d_i` |
/// | --- | --- | --- | --- |
/// | [`near_uniform`](Self::near_uniform) | `s1 <= 0.1` | 1.3e-5 | 1.8e-4 |
/// | | `s1 <= 0.5` | 0.0085 | 0.023 |
/// | | `s1 <= 1` | 0.12 | 0.14 |
/// | [`concentrated`](Self::concentrated) | `s2 + s3 >= 5` | 0.089 | 0.075 |
/// | | `s2 + s3 >= 20` | 0.02 | 0.014 |
/// | | `s2 + s3 >= 100` | 0.0038 | 0.0026 |
/// | | `s2 + s3 >= 1000` | 3.8e-4 | 2.6e-4 |
/// | [`concentrated_about_two_axes`](Self::concentrated_about_two_axes) | `s1 + s3 >= 20` | 0.016 | 0.026 |
/// | | `s1 + s3 >= 100` | 0.0031 | 0.0051 |
/// | | `s1 + s3 >= 1000` | 3.1e-4 | 5.1e-4 |
/// | [`saddle_point`](Self::saddle_point) | everywhere | 0.065 | 0.057 |
/// | | `s2 + s3 >= 5` | 0.02 | 0.012 |
/// | | `s2 + s3 >= 20` | 0.014 | 4.8e-5 |
/// | | `s2 + s3 >= 100` | 0.014 | 2.8e-7 |
///
/// So none replaces the exact pass where four digits count, save in their limits, and there the
/// pass costs no more.
///
/// ```
/// # use mfg_vio::distribution::matrix_fisher::{ApproximateMoments, Moments};
/// # use nalgebra::Vector3;
/// let s = Vector3::new(300.0, 200.0, 100.0);
/// let (exact, limit) = (Moments::new(&s)?, ApproximateMoments::concentrated(&s)?);
/// assert!((limit.complement.component_div(&exact.complement()) - Vector3::repeat(1.0)).amax() < 0.002);
/// # Ok::<(), mfg_vio::distribution::matrix_fisher::InvalidSingularValues>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ApproximateMoments {
    /// `log(c(S) exp(-tr S))`.
    pub log_c_scaled: f64,
    /// `1 - d`.
    pub complement: Vector3<f64>,
}

impl ApproximateMoments {
    /// Near the uniform distribution, `s1 << 1` (L-AMF 33, 34).
    pub fn near_uniform(s: &Vector3<f64>) -> Result<Self, InvalidSingularValues> {
        check_singular_values(s)?;
        let products = Vector3::new(s[1] * s[2], s[0] * s[2], s[0] * s[1]);
        let c = 1.0 + s.norm_squared() / 6.0 + s.product() / 6.0;
        let d = (s / 3.0 + products / 6.0) / c;
        Ok(Self { log_c_scaled: c.ln() - s.sum(), complement: d.map(|d| 1.0 - d) })
    }

    /// Concentrated about all three axes, `s2 + s3 >> 1` (2.59, 2.60; L-AMF 37, 38).
    pub fn concentrated(s: &Vector3<f64>) -> Result<Self, InvalidSingularValues> {
        check_singular_values(s)?;
        let a = Vector3::from(Sums::of_singular_values(s).a);
        let logs: f64 = a.iter().map(|a| a.ln()).sum();
        let variance = a.map(f64::recip);
        let complement = variance.map(|v| 0.5 * (variance.sum() - v));
        let log_c_scaled = -0.5 * ((8.0 * std::f64::consts::PI).ln() + logs);
        Ok(Self { log_c_scaled, complement })
    }

    /// Concentrated about two axes, `s1 + s3 >> 1`, with any dispersion about the first
    /// (2.62-2.64).
    pub fn concentrated_about_two_axes(s: &Vector3<f64>) -> Result<Self, InvalidSingularValues> {
        check_singular_values(s)?;
        let [a1, a2, a3] = Sums::of_singular_values(s).a;
        let circle = CircleMoments::new(a1);
        let versine = 2.0 * circle.half_versine[0];
        let complement = Vector3::new(0.5 / a3 + 0.5 / a2, versine + 0.5 / a3, versine + 0.5 / a2);
        // exp(s1) I0(s2 + s3)/(2 sqrt(a2 a3)), times exp(-tr S).
        let log_c_scaled = circle.scaled_i0.ln() - (2.0 * (a2 * a3).sqrt()).ln();
        Ok(Self { log_c_scaled, complement })
    }

    /// The saddle-point approximation of second order of the Bingham constant (Kume and Wood,
    /// *Saddlepoint approximations for the Bingham and Fisher-Bingham normalising constants*,
    /// 2005; moments as ratios of constants, 2007), to which the figures of W22 compare.
    pub fn saddle_point(s: &Vector3<f64>) -> Result<Self, InvalidSingularValues> {
        check_singular_values(s)?;
        let sums = Sums::of_singular_values(s).a;
        let log_c_scaled = log_saddle_point(&sums, [1.0; 4]);
        // E[x_i^2] is the constant with the i-th exponent three times over, on S^5, by 4 c.
        let square = |i: usize| {
            let mut multiplicities = [1.0; 4];
            multiplicities[i + 1] = 3.0;
            0.25 * (log_saddle_point(&sums, multiplicities) - log_c_scaled).exp()
        };
        let squares = [square(0), square(1), square(2)];
        let complement =
            Vector3::from_fn(|i, _| 2.0 * (squares[(i + 1) % 3] + squares[(i + 2) % 3]));
        Ok(Self { log_c_scaled, complement })
    }
}

/// Logarithm of the saddle-point approximation of `E[exp(-sum l_a |x_a|^2)]` on the sphere, where
/// `l = (0, 2 a)` and the block `x_a` has `multiplicities[a]` components.
fn log_saddle_point(sums: &[f64; 3], multiplicities: [f64; 4]) -> f64 {
    let exponents = [0.0, 2.0 * sums[0], 2.0 * sums[1], 2.0 * sums[2]];
    let power_sum = |b: f64, power: i32| -> f64 {
        exponents.iter().zip(multiplicities).map(|(l, m)| m * (b + l).powi(-power)).sum()
    };
    // K'(t) = 1 at t = -b. The sum is convex and decreasing: Newton's method from the left of the
    // root never passes it.
    let mut b = 0.5 * multiplicities[0];
    for _ in 0..50 {
        let step = (power_sum(b, 1) - 2.0) / power_sum(b, 2);
        b += step;
        if step <= 1e-15 * b {
            break;
        }
    }
    // Cumulants of the squared radius of the tilted Gaussian.
    let [k2, k3, k4] = [0.5 * power_sum(b, 2), power_sum(b, 3), 3.0 * power_sum(b, 4)];
    let correction = k4 / (8.0 * k2 * k2) - 5.0 * k3 * k3 / (24.0 * k2 * k2 * k2);
    let logs: f64 = exponents.iter().zip(multiplicities).map(|(l, m)| m * (b + l).ln()).sum();
    let dimension: f64 = multiplicities.iter().sum();
    let log_gamma = statrs::function::gamma::ln_gamma(0.5 * dimension);
    log_gamma - 0.5 * ((std::f64::consts::TAU * k2).ln() + logs) + b + correction
}

/// `S = 3 D`, the estimate near the uniform distribution (L-AMF 35).
pub fn s_near_uniform(d: &Vector3<f64>) -> Vector3<f64> {
    3.0 * d
}

/// The estimate for a concentrated distribution from `1 - d` (L-AMF 39): `s_j + s_k` is the
/// inverse of `(1 - d_j) + (1 - d_k) - (1 - d_i)`.
///
/// `None` if one of these is not positive.
pub fn s_concentrated(complement: &Vector3<f64>) -> Option<Vector3<f64>> {
    let g = complement;
    let a = [g[1] + g[2] - g[0], g[0] + g[2] - g[1], g[0] + g[1] - g[2]];
    a.iter().all(|m| *m > 0.0).then(|| Sums::new(a.map(f64::recip)).singular_values())
}

#[cfg(test)]
mod tests {
    use super::super::Moments;
    use super::*;

    type Approximation = fn(&Vector3<f64>) -> Result<ApproximateMoments, InvalidSingularValues>;

    /// Largest errors of `c` and of `1 - d` over a grid; of `d` where `absolute`.
    fn largest_errors(f: Approximation, grid: &[Vector3<f64>], absolute: bool) -> [f64; 2] {
        grid.iter().fold([0.0; 2], |[c, d], s| {
            let (found, exact) = (f(s).unwrap(), Moments::new(s).unwrap());
            let of_c = (found.log_c_scaled - exact.log_c_scaled()).exp_m1().abs();
            let difference = found.complement - exact.complement();
            let scale = if absolute { Vector3::repeat(1.0) } else { exact.complement() };
            [f64::max(c, of_c), f64::max(d, difference.component_div(&scale).amax())]
        })
    }

    const FACTORS: [f64; 7] = [1.0, 1.2, 2.0, 5.0, 30.0, 1e3, 1e6];

    fn products(factors: &[f64], others: &[f64]) -> Vec<(f64, f64)> {
        factors.iter().flat_map(|&f| others.iter().map(move |&g| (f, g))).collect()
    }

    /// `s2 + s3 >= least`.
    fn concentrated_grid(least: f64) -> Vec<Vector3<f64>> {
        let pairs = products(&FACTORS, &FACTORS);
        let sums = |f: f64| pairs.iter().map(move |(g, h)| [f, f * g, f * g * h]);
        let all = FACTORS.iter().flat_map(|&f| sums(f));
        all.map(|a| Sums::new(a.map(|a| least * a)).singular_values()).collect()
    }

    /// `s1 + s3 >= least`.
    fn two_axes_grid(least: f64) -> Vec<Vector3<f64>> {
        let shares = [0.0, 1e-3, 0.05, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0];
        let pairs = products(&FACTORS, &FACTORS);
        let sums = |(f, h): (f64, f64)| {
            shares.iter().map(move |share| [share * f * least, f * least, f * h * least])
        };
        pairs.into_iter().flat_map(sums).map(|a| Sums::new(a).singular_values()).collect()
    }

    /// `s1 = most`.
    fn near_uniform_grid(most: f64) -> Vec<Vector3<f64>> {
        let ratios = [1.0, 0.9, 0.5, 0.1, 1e-3, 0.0];
        let signed: Vec<f64> = ratios.iter().flat_map(|r| [*r, -r]).collect();
        let pairs = products(&ratios, &signed);
        pairs.into_iter().map(|(r, q)| Vector3::new(most, most * r, most * r * q)).collect()
    }

    /// The table of [`ApproximateMoments`]: its figures hold and are not idle.
    #[test]
    fn errors_are_those_stated() {
        let check = |f: Approximation, grid: Vec<Vector3<f64>>, absolute, stated: [f64; 2]| {
            let found = largest_errors(f, &grid, absolute);
            for (found, stated) in found.into_iter().zip(stated) {
                assert!(found <= stated && found > 0.8 * stated, "{found} {stated}");
            }
        };
        let near = ApproximateMoments::near_uniform;
        for (most, stated) in [(0.1, [1.3e-5, 1.8e-4]), (0.5, [0.0085, 0.023]), (1.0, [0.12, 0.14])]
        {
            check(near, near_uniform_grid(most), true, stated);
        }
        let three = ApproximateMoments::concentrated;
        for (least, stated) in [
            (5.0, [0.089, 0.075]),
            (20.0, [0.02, 0.014]),
            (100.0, [0.0038, 0.0026]),
            (1000.0, [3.8e-4, 2.6e-4]),
        ] {
            check(three, concentrated_grid(least), false, stated);
        }
        let two = ApproximateMoments::concentrated_about_two_axes;
        for (least, stated) in
            [(20.0, [0.016, 0.026]), (100.0, [0.0031, 0.0051]), (1000.0, [3.1e-4, 5.1e-4])]
        {
            check(two, two_axes_grid(least), false, stated);
        }
        let saddle = ApproximateMoments::saddle_point;
        for (least, stated) in
            [(5.0, [0.02, 0.012]), (20.0, [0.014, 4.8e-5]), (100.0, [0.014, 2.8e-7])]
        {
            check(saddle, concentrated_grid(least), false, stated);
        }
        let scales = [1e-3, 0.1, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 100.0];
        let everywhere = scales.into_iter().flat_map(two_axes_grid).collect();
        check(saddle, everywhere, false, [0.065, 0.057]);
    }

    /// L-AMF (35) and (39) invert the moments of their limits.
    #[test]
    fn estimates_invert_the_moments_of_their_limits() {
        let s = Vector3::new(3e-4, 2e-4, -1e-4);
        let found = s_near_uniform(&Moments::new(&s).unwrap().first());
        assert!((found - s).amax() < 1e-7);
        let s = Vector3::new(300.0, 200.0, -100.0);
        let limit = ApproximateMoments::concentrated(&s).unwrap();
        let found = s_concentrated(&limit.complement).unwrap();
        assert!((found - s).amax() < 1e-10 * s[0]);
        assert_eq!(s_concentrated(&Vector3::new(0.1, 0.1, 0.3)), None);
    }
}
