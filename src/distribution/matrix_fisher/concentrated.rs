//! The pass where all three degrees of freedom are concentrated.
//!
//! In the chart `(x1, x2, x3)` the uniform measure of the sphere is `d^3x / (pi^2 sqrt(1 - r^2))`
//! and the density is Gaussian, so
//!
//! ```text
//! c(S) exp(-tr S) = (8 pi a1 a2 a3)^(-1/2) E[(1 - r^2)^(-1/2)],   x_i ~ N(0, 1/(4 a_i)).
//! ```
//!
//! Expanded in powers of `r^2`, every term of every moment is positive: no cancellation. The
//! leading terms are (2.59) and (2.60); the series is asymptotic, its smallest term
//! `exp(-2 a1)`.

use super::forms::{Basis, CUBICS, MONOMIALS};
use super::sums::{EvenMoments, Sums};

/// The series serves `s2 + s3` from here on: its smallest term is then below 1e-21.
pub(super) const MIN_SUM: f64 = 25.0;

/// Bound on the number of terms; 25 are needed at [`MIN_SUM`].
const MAX_TERMS: usize = 28;
/// Terms below this fraction of the sum are left out.
const NEGLIGIBLE: f64 = 1e-18;

/// A moment `E[x1^2i x2^2j x3^2k]` and the moment that it extends by one factor.
#[derive(Debug, Clone, Copy)]
struct Step {
    exponents: [usize; 3],
    parent: usize,
    axis: usize,
}

/// Moments in an order in which each comes after its parent; those up to order two come first.
const STEPS: [Step; CUBICS] = steps();
/// Number of moments up to order two.
const UP_TO_SECOND: usize = 10;

const fn steps() -> [Step; CUBICS] {
    let mut list = [Step { exponents: [0; 3], parent: 0, axis: 0 }; CUBICS];
    let (mut next, mut order) = (1, 1);
    while order <= 3 {
        let mut i = 0;
        while i <= order {
            let mut j = 0;
            while j <= order - i {
                let exponents = [i, j, order - i - j];
                let axis = if i > 0 {
                    0
                } else if j > 0 {
                    1
                } else {
                    2
                };
                let mut lower = exponents;
                lower[axis] -= 1;
                list[next] = Step { exponents, parent: position(&list, next, lower), axis };
                next += 1;
                j += 1;
            }
            i += 1;
        }
        order += 1;
    }
    list
}

const fn position(list: &[Step; CUBICS], len: usize, exponents: [usize; 3]) -> usize {
    let mut n = 0;
    while n < len {
        let e = list[n].exponents;
        if e[0] == exponents[0] && e[1] == exponents[1] && e[2] == exponents[2] {
            return n;
        }
        n += 1;
    }
    len
}

/// Position of each cubic monomial of [`Basis::Squares`] among the steps.
const CUBIC_STEPS: [usize; CUBICS] = cubic_steps();

const fn cubic_steps() -> [usize; CUBICS] {
    let mut list = [0; CUBICS];
    let mut n = 0;
    while n < CUBICS {
        let m = MONOMIALS[n];
        list[n] = step_of([m[1], m[2], m[3]]);
        n += 1;
    }
    list
}

/// Positions of `E[x_i^2]` and `E[x_i^2 x_j^2]` among the steps.
const FIRST_STEPS: [usize; 3] = [step_of([1, 0, 0]), step_of([0, 1, 0]), step_of([0, 0, 1])];
const SECOND_STEPS: [[usize; 3]; 3] = [
    [step_of([2, 0, 0]), step_of([1, 1, 0]), step_of([1, 0, 1])],
    [step_of([1, 1, 0]), step_of([0, 2, 0]), step_of([0, 1, 1])],
    [step_of([1, 0, 1]), step_of([0, 1, 1]), step_of([0, 0, 2])],
];

const fn step_of(exponents: [usize; 3]) -> usize {
    position(&STEPS, CUBICS, exponents)
}

pub(super) fn pass<const THIRD: bool>(sums: &Sums) -> EvenMoments {
    let moments = if THIRD { series::<CUBICS>(sums) } else { series::<UP_TO_SECOND>(sums) };
    let scale = moments[0].recip();
    EvenMoments {
        log_c_scaled: if THIRD { log_constant(sums, moments[0]) } else { 0.0 },
        squares: FIRST_STEPS.map(|n| moments[n] * scale),
        products: SECOND_STEPS.map(|row| row.map(|n| moments[n] * scale)),
        cubics: if THIRD { CUBIC_STEPS.map(|n| moments[n] * scale) } else { [0.0; CUBICS] },
        basis: Basis::Squares,
    }
}

/// `log(c(S) exp(-tr S))` from `E[(1 - r^2)^(-1/2)]`.
fn log_constant(sums: &Sums, expectation: f64) -> f64 {
    let log_gauss: f64 = sums.a.iter().map(|a| a.ln()).sum();
    expectation.ln() - 0.5 * ((8.0 * std::f64::consts::PI).ln() + log_gauss)
}

/// `E[x^(2 e) (1 - r^2)^(-1/2)]` for the first `N` steps, the rest zero.
///
/// `E[x^(2e) exp(t r^2)] = prod (1/2)_e v^e (1 - v t)^(-1/2 - e)` with `v_i = 1/(2 a_i)`: each
/// further exponent divides the generating function by `1 - v t`, a running sum.
fn series<const N: usize>(sums: &Sums) -> [f64; CUBICS] {
    let v = sums.a.map(|a| 0.5 / a);
    let terms = number_of_terms(v[0]);
    let gauss = gaussian_coefficients(&v, terms);
    let mut running = [0.0; N];
    let mut totals = [0.0; CUBICS];
    let mut weight = 1.0;
    for (n, coefficient) in gauss.iter().take(terms).enumerate() {
        running[0] = *coefficient;
        totals[0] += weight * coefficient;
        // Of constant length, so that it is unrolled and the table folded into the code.
        for (m, step) in (1..).zip(&STEPS[1..N]) {
            running[m] = running[step.parent] + v[step.axis] * running[m];
            totals[m] += weight * running[m];
        }
        weight *= n as f64 + 0.5;
    }
    let mut scale = [1.0; CUBICS];
    for (m, step) in (1..).zip(&STEPS[1..N]) {
        let factor = step.exponents[step.axis] as f64 - 0.5;
        scale[m] = scale[step.parent] * factor * v[step.axis];
        totals[m] *= scale[m];
    }
    totals
}

/// `1/(2n)`.
const HALVES: [f64; MAX_TERMS] = halves();

const fn halves() -> [f64; MAX_TERMS] {
    let mut list = [0.0; MAX_TERMS];
    let mut n = 1;
    while n < MAX_TERMS {
        list[n] = 0.5 / n as f64;
        n += 1;
    }
    list
}

/// Terms until they are negligible for the highest moment, from the ratio of successive terms
/// along the broadest axis.
fn number_of_terms(broadest: f64) -> usize {
    let mut term = 1.0;
    for n in 0..MAX_TERMS {
        term *= (n as f64 + 3.5) * broadest;
        if term < NEGLIGIBLE {
            return n + 1;
        }
    }
    MAX_TERMS
}

/// Coefficients in `t` of `prod (1 - v_i t)^(-1/2)`.
fn gaussian_coefficients(v: &[f64; 3], terms: usize) -> [f64; MAX_TERMS] {
    let mut powers = *v;
    let mut power_sums = [0.0; MAX_TERMS];
    let mut g = [0.0; MAX_TERMS];
    g[0] = 1.0;
    for sum in &mut power_sums[1..terms] {
        *sum = powers.iter().sum();
        for (power, v) in powers.iter_mut().zip(v) {
            *power *= v;
        }
    }
    for (n, half) in HALVES.iter().enumerate().take(terms).skip(1) {
        // The newest factor last: only the end of the sum waits for it.
        let factors = g[..n].iter().zip(power_sums[1..=n].iter().rev());
        g[n] = half * factors.map(|(g, p)| g * p).sum::<f64>();
    }
    g
}

/// `E[eta_i^2]` of the rotation vector `eta = log Q`: the same series with `4 (asin(r)/r)^2` in
/// the integrand, for `|eta| = 2 asin r`.
pub(super) fn rotation_vector_variances(sums: &Sums) -> [f64; 3] {
    let v = sums.a.map(|a| 0.5 / a);
    let terms = number_of_terms(v[0]);
    let gauss = gaussian_coefficients(&v, terms);
    let mut running = [0.0; 3];
    let (mut totals, mut constant) = ([0.0; 3], 0.0);
    let (mut factorial, mut weight) = (1.0, 1.0);
    // Coefficients of 4 (asin(r)/r)^2 and of (1 - r^2)^(-1/2) in r^2.
    let (mut angle, mut density) = ([0.0; MAX_TERMS], [0.0; MAX_TERMS]);
    (angle[0], density[0]) = (4.0, 1.0);
    for (n, coefficient) in gauss.iter().take(terms).enumerate() {
        let product: f64 = (0..=n).map(|m| angle[m] * density[n - m]).sum();
        for i in 0..3 {
            running[i] = coefficient + v[i] * running[i];
            totals[i] += 0.5 * v[i] * factorial * product * running[i];
        }
        constant += weight * coefficient;
        let k = n as f64 + 1.0;
        (factorial, weight) = (factorial * k, weight * (k - 0.5));
        if n + 1 < terms {
            angle[n + 1] = angle[n] * 2.0 * k * k / ((k + 1.0) * (2.0 * k + 1.0));
            density[n + 1] = density[n] * (k - 0.5) / k;
        }
    }
    totals.map(|t| t / constant)
}
