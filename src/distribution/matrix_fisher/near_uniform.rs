//! The pass near the uniform distribution: the power series of `c(S)`.
//!
//! `c(S) = sum m_ijk s1^i s2^j s3^k / (i! j! k!)` with the Haar moments `m_ijk = E[Q11^i Q22^j
//! Q33^k]`, which vanish unless `i, j, k` have the same parity. Derivatives of the series give
//! moments that vanish with `S` to full relative accuracy, where a quadrature would leave the
//! rounding error of a sum of order one.

use std::num::NonZeroUsize;
use std::sync::LazyLock;

use gauss_quad::legendre::GaussLegendre;

use super::forms::{Basis, CUBICS, MONOMIALS};
use super::sums::{EvenMoments, Sums};

/// The series serves `s1 + s2` up to this.
pub(super) const MAX_SUM: f64 = 1.0 / 64.0;

/// Degree of the series. The first term left out of a third derivative is below
/// `(3/128)^8/8! < 3e-18` of the leading one.
const DEGREE: usize = 10;
/// Order of the derivatives.
const ORDER: usize = 3;

/// Exponents and Haar moment of each term.
static TERMS: LazyLock<Vec<([usize; 3], f64)>> = LazyLock::new(haar_moments);

pub(super) fn pass(sums: &Sums) -> EvenMoments {
    let s = sums.singular_values();
    let cubics = derivatives(&s.into());
    let c = cubics[CONSTANT];
    let cubics = cubics.map(|d| d / c);
    // x_i^2 = (1 + Q_ii - Q_jj - Q_kk)/4
    let sign = |i: usize, j: usize| if i == j { 1.0 } else { -1.0 };
    let first = |i: usize| -> f64 { (0..3).map(|j| sign(i, j) * cubics[FIRST[j]]).sum() };
    let second = |i: usize, j: usize| -> f64 {
        let pairs = (0..3).flat_map(|k| (0..3).map(move |l| (k, l)));
        pairs.map(|(k, l)| sign(i, k) * sign(j, l) * cubics[SECOND[k][l]]).sum()
    };
    let squares = std::array::from_fn(|i| 0.25 * (1.0 + first(i)));
    let products = std::array::from_fn(|i| {
        std::array::from_fn(|j| (1.0 + first(i) + first(j) + second(i, j)) / 16.0)
    });
    let log_c_scaled = c.ln() - s.sum();
    EvenMoments { log_c_scaled, squares, products, cubics, basis: Basis::Diagonal }
}

/// Positions of the constant, of `E[Q_ii]` and of `E[Q_ii Q_jj]` among the cubic moments.
const CONSTANT: usize = position([0, 0, 0]);
const FIRST: [usize; 3] = [position([1, 0, 0]), position([0, 1, 0]), position([0, 0, 1])];
const SECOND: [[usize; 3]; 3] = [
    [position([2, 0, 0]), position([1, 1, 0]), position([1, 0, 1])],
    [position([1, 1, 0]), position([0, 2, 0]), position([0, 1, 1])],
    [position([1, 0, 1]), position([0, 1, 1]), position([0, 0, 2])],
];

/// Positions of all derivatives by their exponents; unused ones are zero.
const POSITIONS: [[[usize; ORDER + 1]; ORDER + 1]; ORDER + 1] = positions();

const fn position(exponents: [usize; 3]) -> usize {
    let mut n = 0;
    while n < CUBICS {
        let m = MONOMIALS[n];
        if m[1] == exponents[0] && m[2] == exponents[1] && m[3] == exponents[2] {
            return n;
        }
        n += 1;
    }
    CUBICS
}

const fn positions() -> [[[usize; ORDER + 1]; ORDER + 1]; ORDER + 1] {
    let mut table = [[[0; ORDER + 1]; ORDER + 1]; ORDER + 1];
    let mut n = 0;
    while n < CUBICS {
        let m = MONOMIALS[n];
        table[m[1]][m[2]][m[3]] = n;
        n += 1;
    }
    table
}

/// `d^n c / ds1^i ds2^j ds3^k` for `n <= 3`.
fn derivatives(s: &[f64; 3]) -> [f64; CUBICS] {
    // Powers over factorials, with zeros for the negative exponents that differentiation of a
    // constant asks for.
    let powers = s.map(|s| {
        let mut power = [0.0; DEGREE + ORDER + 1];
        power[ORDER] = 1.0;
        for n in 1..=DEGREE {
            power[ORDER + n] = power[ORDER + n - 1] * s / n as f64;
        }
        power
    });
    let mut sums = [0.0; CUBICS];
    for ([i, j, k], moment) in TERMS.iter() {
        for p in 0..=ORDER {
            let first = moment * powers[0][i + ORDER - p];
            for q in 0..=ORDER - p {
                let second = first * powers[1][j + ORDER - q];
                for r in 0..=ORDER - p - q {
                    sums[POSITIONS[p][q][r]] += second * powers[2][k + ORDER - r];
                }
            }
        }
    }
    sums
}

fn haar_moments() -> Vec<([usize; 3], f64)> {
    let mut terms = Vec::new();
    for i in 0..=DEGREE {
        for j in 0..=DEGREE - i {
            for k in 0..=DEGREE - i - j {
                if i % 2 == j % 2 && j % 2 == k % 2 {
                    terms.push(([i, j, k], haar_moment(i, j, k)));
                }
            }
        }
    }
    terms
}

/// `E[Q11^i Q22^j Q33^k]` under the Haar measure, exactly: `Q11 = 1 - 2u`, `Q22, Q33 =
/// (1 - u) cos 2 alpha +- u cos 2 beta` with `u` uniform on `[0, 1]`.
fn haar_moment(i: usize, j: usize, k: usize) -> f64 {
    const POINTS: usize = 2 * DEGREE;
    let cosines: [f64; POINTS] =
        std::array::from_fn(|n| (std::f64::consts::TAU * n as f64 / POINTS as f64).cos());
    let rule = GaussLegendre::new(NonZeroUsize::MIN.saturating_add(DEGREE / 2));
    rule.integrate(0.0, 1.0, |u| {
        let mut sum = 0.0;
        for c in cosines {
            for e in cosines {
                let (x, y) = ((1.0 - u) * c, u * e);
                sum += (x + y).powi(j as i32) * (x - y).powi(k as i32);
            }
        }
        (1.0 - 2.0 * u).powi(i as i32) * sum / (POINTS * POINTS) as f64
    })
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    #[test]
    fn haar_moments_have_their_known_values() {
        let known = [
            ([0, 0, 0], 1.0),
            ([2, 0, 0], 1.0 / 3.0),
            ([0, 2, 0], 1.0 / 3.0),
            ([1, 1, 1], 1.0 / 6.0),
            ([4, 0, 0], 1.0 / 5.0),
            ([0, 2, 2], 2.0 / 15.0),
            ([2, 0, 2], 2.0 / 15.0),
        ];
        for ([i, j, k], value) in known {
            assert_relative_eq!(haar_moment(i, j, k), value, max_relative = 1e-14);
        }
    }
}
