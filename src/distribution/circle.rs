//! Moments of the von Mises distribution on the circle: ratios of exponentially scaled Bessel
//! functions without cancellation.

use std::sync::LazyLock;

/// Up to this concentration the moments come from the table, above it from asymptotic series,
/// whose smallest term there is `exp(-2 t) < 1e-20`.
const TABLE_END: f64 = 24.0;
/// Nodes of the table for each unit of concentration.
const NODES_PER_UNIT: f64 = 16.0;
const NODES: usize = 385;
/// Taylor terms at each node: `(2/32)^n / n!` is below rounding for `n = 9`.
const TAYLOR: usize = 9;
/// Terms of the asymptotic series at the end of the table.
const ASYMPTOTIC: usize = 30;

/// Moments of an angle `phi` with density proportional to `exp(t cos phi)`, `t >= 0`.
#[derive(Debug, Clone, Copy)]
pub(super) struct CircleMoments {
    /// `exp(-t) I_0(t)`.
    pub scaled_i0: f64,
    /// `E[cos^n phi]` for `n = 0..3`; the odd ones are accurate in relative terms as `t -> 0`.
    pub cosine: [f64; 4],
    /// `E[w]` and `E[w^2]` of `w = (1 - cos phi)/2`, accurate in relative terms as `t -> inf`.
    pub half_versine: [f64; 2],
}

impl CircleMoments {
    /// One evaluation of all moments; `t` finite and not negative.
    pub fn new(t: f64) -> Self {
        Self::up_to::<true>(t)
    }

    /// The moments, without the third of the cosine unless `THIRD`.
    pub fn up_to<const THIRD: bool>(t: f64) -> Self {
        if t == 0.0 {
            Self::UNIFORM
        } else if t < TABLE_END {
            Self::from_table::<THIRD>(t)
        } else {
            Self::from_asymptotics(t)
        }
    }

    const UNIFORM: Self =
        Self { scaled_i0: 1.0, cosine: [1.0, 0.0, 0.5, 0.0], half_versine: [0.5, 0.375] };

    fn from_table<const THIRD: bool>(t: f64) -> Self {
        let node = ((t * NODES_PER_UNIT + 0.5) as usize).min(NODES - 1);
        let offset = node as f64 / NODES_PER_UNIT - t;
        let [i0, i1_over_t, i2_over_t2] = &TABLE[node];
        let series = |f: &[f64; TAYLOR]| f.iter().rev().fold(0.0, |sum, c| sum * offset + c);
        let i0 = series(i0);
        let squared_sine = series(i1_over_t) / i0;
        let mean = t * squared_sine;
        let versine = 1.0 - mean;
        let third = if THIRD { mean - t * series(i2_over_t2) / i0 } else { 0.0 };
        Self {
            scaled_i0: i0,
            cosine: [1.0, mean, 1.0 - squared_sine, third],
            half_versine: [0.5 * versine, 0.25 * (2.0 * versine - squared_sine)],
        }
    }

    fn from_asymptotics(t: f64) -> Self {
        let terms = match t {
            t if t < 32.0 => ASYMPTOTIC,
            t if t < 64.0 => 20,
            t if t < 256.0 => 14,
            t if t < 4096.0 => 9,
            _ => 5,
        };
        let x = 0.5 / t;
        let series =
            |s: &[f64; ASYMPTOTIC]| s[..terms].iter().rev().fold(0.0, |sum, c| sum * x + c);
        let [a0, a1, a2] = [&SERIES[0], &SERIES[1], &SERIES[2]].map(series);
        let first = 0.5 * x * a1 / a0;
        let second = 0.75 * x * x * a2 / a0;
        let mean = 1.0 - 2.0 * first;
        let squared_sine = mean / t;
        Self {
            scaled_i0: a0 * (x * std::f64::consts::FRAC_1_PI).sqrt(),
            cosine: [1.0, mean, 1.0 - squared_sine, mean - (1.0 - 2.0 * squared_sine) / t],
            half_versine: [first, second],
        }
    }
}

/// Taylor coefficients in `(node - t)` of `exp(-t) I_0(t)`, `exp(-t) I_1(t)/t` and
/// `exp(-t) I_2(t)/t^2`, all of one sign.
static TABLE: LazyLock<[[[f64; TAYLOR]; 3]; NODES]> =
    LazyLock::new(|| std::array::from_fn(|node| taylor_coefficients(node as f64 / NODES_PER_UNIT)));

/// Trapezoidal rule on the circle for `E[g (1 - cos)^n exp(-t (1 - cos))]/n!` with `g = 1, sin^2,
/// sin^4/3`: its error falls like `I_64(t)`.
fn taylor_coefficients(t: f64) -> [[f64; TAYLOR]; 3] {
    const POINTS: usize = 64;
    let mut functions = [[0.0; TAYLOR]; 3];
    for point in 0..POINTS {
        let half_angle = std::f64::consts::PI * point as f64 / POINTS as f64;
        let versine = 2.0 * half_angle.sin().powi(2);
        let squared_sine = (2.0 * half_angle).sin().powi(2);
        let weight = (-t * versine).exp() / POINTS as f64;
        let factors = [1.0, squared_sine, squared_sine * squared_sine / 3.0];
        for (function, factor) in functions.iter_mut().zip(factors) {
            let mut term = weight * factor;
            for (n, coefficient) in function.iter_mut().enumerate() {
                *coefficient += term;
                term *= versine / (n as f64 + 1.0);
            }
        }
    }
    functions
}

/// `(1/2)_k (n + 1/2)_k / k!` for `n = 0, 1, 2`: the expansions in `1/(2t)` of
/// `E[w^n exp(-2 t w)]` relative to their leading terms.
static SERIES: LazyLock<[[f64; ASYMPTOTIC]; 3]> = LazyLock::new(|| {
    std::array::from_fn(|n| {
        let mut term = 1.0;
        std::array::from_fn(|k| {
            let (current, k) = (term, k as f64);
            term *= (k + 0.5) * (k + n as f64 + 0.5) / (k + 1.0);
            current
        })
    })
});

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    /// The trapezoidal rule with as many points as `t` asks for.
    fn brute_force(t: f64) -> ([f64; 4], [f64; 2], f64) {
        let n = 200 + 40 * t.sqrt() as usize;
        let (mut cosine, mut half, mut total) = ([0.0; 4], [0.0; 2], 0.0);
        for k in 0..n {
            let w = (std::f64::consts::PI * k as f64 / n as f64).sin().powi(2);
            let weight = (-2.0 * t * w).exp() / n as f64;
            total += weight;
            for (p, c) in cosine.iter_mut().enumerate() {
                *c += weight * (1.0 - 2.0 * w).powi(p as i32);
            }
            half[0] += weight * w;
            half[1] += weight * w * w;
        }
        (cosine.map(|c| c / total), half.map(|h| h / total), total)
    }

    #[test]
    fn moments_agree_with_brute_force_at_every_scale() {
        for t in [0.0, 1e-3, 0.1, 0.24, 0.26, 1.0, 5.7, 12.0, 23.7, 24.0, 31.0, 65.0, 300.0, 5e3] {
            let found = CircleMoments::new(t);
            let (cosine, half, total) = brute_force(t);
            assert_relative_eq!(found.scaled_i0, total, max_relative = 2e-14);
            for (a, b) in found.cosine.iter().zip(cosine) {
                assert_relative_eq!(*a, b, max_relative = 2e-14, epsilon = 1e-15);
            }
            for (a, b) in found.half_versine.iter().zip(half) {
                assert_relative_eq!(*a, b, max_relative = 2e-12);
            }
        }
    }

    #[test]
    fn limits_keep_their_digits() {
        let small = CircleMoments::new(1e-9);
        assert_relative_eq!(small.cosine[1], 0.5e-9, max_relative = 1e-15);
        assert_relative_eq!(small.cosine[3], 0.375e-9, max_relative = 1e-15);
        let large = CircleMoments::new(1e12);
        assert_relative_eq!(large.half_versine[0], 0.25e-12, max_relative = 1e-11);
        assert_relative_eq!(large.half_versine[1], 3.0 / 16.0 * 1e-24, max_relative = 1e-11);
    }

    /// Values of 30-digit arithmetic.
    #[test]
    fn bessel_functions_agree_with_multiple_precision() {
        for (t, i0, i1) in [
            (1.0, 0.465_759_607_593_640_4, 0.207_910_415_349_708_46),
            (5.0, 0.183_540_812_609_328_34, 0.163_972_266_944_542_34),
            (10.0, 0.127_833_337_163_428_6, 0.121_262_681_384_455_5),
        ] {
            let found = CircleMoments::new(t);
            assert_relative_eq!(found.scaled_i0, i0, max_relative = 1e-15);
            assert_relative_eq!(found.scaled_i0 * found.cosine[1], i1, max_relative = 1e-15);
        }
    }
}
