//! Moments of any order by differentiation of the constant (W22 theorems 2.3-2.5).
//!
//! The moment `E[Q_i1j1 ... Q_injn]` is the derivative of `c(S + T)/c(S)` with respect to the
//! entries `T_i1j1, ..., T_injn` at `T = 0` (2.44). Give each factor an infinitesimal of its own;
//! then every quantity is a table over the subsets of the factors, Leibniz's rule (2.52) is the
//! subset convolution, and the recursion of theorem 2.4 through the derivatives of the proper
//! singular value decomposition fills the tables in `O(3^n)` steps, where the printed recursion
//! visits partitions again and again.
//!
//! A fourth-order moment takes well below a millisecond from nothing and one of order six little
//! more (W22 2.4.4: 0.2 s and 2 min); see `benches/distribution.rs`.
//!
//! It divides by differences of squared singular values: `s1, s2, |s3|` must be distinct, and
//! digits are lost as they approach each other, the more the higher the order. For orders up to
//! three [`Moments`](super::Moments) has neither limitation; this is the check on it, and the way
//! to higher orders.

use nalgebra::Vector3;

use super::{InvalidSingularValues, Moments};

/// Moments of more factors are refused: the tables grow like `2^n`, the time like `3^n`.
pub const MAX_ORDER: usize = 12;

/// Why a moment of arbitrary order cannot be computed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum HigherMomentError {
    #[error(transparent)]
    SingularValues(#[from] InvalidSingularValues),
    /// The recursion divides by the differences.
    #[error("the recursion needs distinct |s1|, |s2|, |s3|, not {0:?}")]
    Repeated([f64; 3]),
    #[error("a moment of order {0} exceeds the limit of {MAX_ORDER}")]
    Order(usize),
    /// An entry outside of the 3x3 matrix.
    #[error("Q has no entry {0:?}; rows and columns are 0, 1, 2")]
    Entry((usize, usize)),
}

/// Moments of any order of `Q ~ M(S)`, for distinct `s1, s2, |s3|`.
///
/// ```
/// # use mfg_vio::distribution::matrix_fisher::HigherMoments;
/// # use nalgebra::Vector3;
/// let moments = HigherMoments::new(&Vector3::new(25.0, 10.0, 5.0))?;
/// // Table 2.1: E[Q23 Q32 Q12 Q23 Q31].
/// let fifth = moments.moment(&[(1, 2), (2, 1), (0, 1), (1, 2), (2, 0)])?;
/// assert!(fifth < 0.0);
/// # Ok::<(), mfg_vio::distribution::matrix_fisher::HigherMomentError>(())
/// ```
#[derive(Debug, Clone)]
pub struct HigherMoments {
    s: Vector3<f64>,
    first: Vector3<f64>,
}

impl HigherMoments {
    pub fn new(s: &Vector3<f64>) -> Result<Self, HigherMomentError> {
        let first = Moments::new(s)?.first();
        if s[0] == s[1] || s[1] == s[2].abs() {
            return Err(HigherMomentError::Repeated((*s).into()));
        }
        Ok(Self { s: *s, first })
    }

    /// The expected product of the entries of `Q`, each `(row, column)` from 0 to 2.
    pub fn moment(&self, entries: &[(usize, usize)]) -> Result<f64, HigherMomentError> {
        if entries.len() > MAX_ORDER {
            return Err(HigherMomentError::Order(entries.len()));
        }
        if let Some(&entry) = entries.iter().find(|(i, j)| *i > 2 || *j > 2) {
            return Err(HigherMomentError::Entry(entry));
        }
        // Corollary 2.1.
        let indices = || entries.iter().flat_map(|&(i, j)| [i, j]);
        if (0..3).any(|k| indices().filter(|&i| i == k).count() % 2 == 1) {
            return Ok(0.0);
        }
        let derivatives = self.diagonal_derivatives(highest_derivative(entries));
        Ok(self.expand(entries, &derivatives))
    }

    /// Derivatives of `c/c(S)` with respect to `s` up to `order` (theorem 2.5).
    fn diagonal_derivatives(&self, order: usize) -> Derivatives {
        let mut table = Derivatives::new(order);
        table.set([0, 0, 0], 1.0);
        for n in 1..=order {
            for p in 0..=n {
                for q in 0..=n - p {
                    let exponents = [p, q, n - p - q];
                    let value = self.diagonal_derivative(exponents, &table);
                    table.set(exponents, value);
                }
            }
        }
        table
    }

    /// One derivative from those of lower order: (2.57) where a singular value repeats, (2.58)
    /// where none does.
    fn diagonal_derivative(&self, exponents: [usize; 3], lower: &Derivatives) -> f64 {
        let order: usize = exponents.iter().sum();
        if order == 1 {
            return (0..3).filter(|&i| exponents[i] == 1).map(|i| self.first[i]).sum();
        }
        let mut rest = exponents;
        let repeated = (0..3).find(|&i| exponents[i] >= 2);
        if let Some(i) = repeated {
            rest[i] -= 2;
            let row = |j: usize| self.expand(&with_diagonal(&[(i, j), (i, j)], rest), lower);
            return lower.get(rest) - row((i + 1) % 3) - row((i + 2) % 3);
        }
        // Two different indices are left, and the third where the order is three.
        let i = if exponents[0] == 1 { 0 } else { 1 };
        let j = if exponents[1] == 1 && i == 0 { 1 } else { 2 };
        let k = 3 - i - j;
        rest[i] -= 1;
        rest[j] -= 1;
        let mut cofactor = rest;
        cofactor[k] += 1;
        lower.get(cofactor) + self.expand(&with_diagonal(&[(i, j), (j, i)], rest), lower)
    }

    /// The derivative of `c(S + T)/c(S)` with respect to all entries (theorem 2.3).
    ///
    /// The coefficient of the product of all infinitesimals in the Taylor series of `c` about `S`
    /// in the increments of the singular values.
    fn expand(&self, entries: &[(usize, usize)], derivatives: &Derivatives) -> f64 {
        let order = highest_derivative(entries);
        let all = (1 << entries.len()) - 1;
        let powers = singular_value_jets(&self.s, entries).map(|jet| divided_powers(&jet, order));
        let mut total = 0.0;
        for p in 0..=order {
            for q in 0..=order - p {
                let product = multiply(&powers[0][p], &powers[1][q]);
                for (r, third) in powers[2].iter().enumerate().take(order - p - q + 1) {
                    let coefficient = convolve(all, |m| product[m], |m| third[m]);
                    total += coefficient * derivatives.get([p, q, r]);
                }
            }
        }
        total
    }
}

/// The highest derivative of `c` that a product of entries involves: an off-diagonal entry moves
/// singular values only together with another (lemma 2.2).
fn highest_derivative(entries: &[(usize, usize)]) -> usize {
    let diagonal = entries.iter().filter(|(i, j)| i == j).count();
    diagonal + (entries.len() - diagonal) / 2
}

/// Derivatives by exponents.
#[derive(Debug, Clone)]
struct Derivatives {
    size: usize,
    values: Vec<f64>,
}

impl Derivatives {
    fn new(order: usize) -> Self {
        let size = order + 1;
        Self { size, values: vec![0.0; size * size * size] }
    }

    fn position(&self, [p, q, r]: [usize; 3]) -> usize {
        (p * self.size + q) * self.size + r
    }

    fn get(&self, exponents: [usize; 3]) -> f64 {
        self.values[self.position(exponents)]
    }

    fn set(&mut self, exponents: [usize; 3], value: f64) {
        let position = self.position(exponents);
        self.values[position] = value;
    }
}

/// Entries followed by diagonal ones.
fn with_diagonal(entries: &[(usize, usize)], exponents: [usize; 3]) -> Vec<(usize, usize)> {
    let diagonal = (0..3).flat_map(|i| std::iter::repeat_n((i, i), exponents[i]));
    entries.iter().copied().chain(diagonal).collect()
}

/// A polynomial in infinitesimals whose squares vanish: one coefficient for each subset.
type Jet = Vec<f64>;

/// `jet^p/p!` for `p` up to `order`.
fn divided_powers(jet: &Jet, order: usize) -> Vec<Jet> {
    let mut unit = vec![0.0; jet.len()];
    unit[0] = 1.0;
    let mut powers = vec![unit];
    for p in 1..=order {
        let product = multiply(&powers[p - 1], jet);
        powers.push(product.into_iter().map(|c| c / p as f64).collect());
    }
    powers
}

fn multiply(a: &Jet, b: &Jet) -> Jet {
    (0..a.len()).map(|mask| convolve(mask, |m| a[m], |m| b[m])).collect()
}

/// Sum of `a(m) b(mask \ m)` over the subsets `m` of `mask`: Leibniz's rule (2.52).
fn convolve(mask: usize, a: impl Fn(usize) -> f64, b: impl Fn(usize) -> f64) -> f64 {
    let mut sum = 0.0;
    let mut subset = mask;
    loop {
        sum += a(subset) * b(mask & !subset);
        if subset == 0 {
            return sum;
        }
        subset = (subset - 1) & mask;
    }
}

/// `S' - S` of the proper decomposition of `S + T`, as jets in the entries of `T` (theorem 2.4).
fn singular_value_jets(s: &Vector3<f64>, entries: &[(usize, usize)]) -> [Jet; 3] {
    let mut jets = DecompositionJets::new(s, entries.len());
    for mask in 1..1usize << entries.len() {
        let lowest = mask.trailing_zeros() as usize;
        jets.differentiate(mask, mask & (mask - 1), entries[lowest]);
    }
    let mut increments = jets.s;
    for jet in &mut increments {
        jet[0] = 0.0;
    }
    increments
}

/// Pairs of indices of a skew matrix.
const PAIRS: [(usize, usize); 3] = [(0, 1), (0, 2), (1, 2)];

/// Derivatives of the proper singular value decomposition of `S + T`, by subset of entries.
struct DecompositionJets {
    s: [Jet; 3],
    u: [[Jet; 3]; 3],
    v: [[Jet; 3]; 3],
    /// The skew matrices of (2.50) that belong to the lowest entry of a subset, differentiated
    /// with respect to the others, by pair.
    omega_u: [Jet; 3],
    omega_v: [Jet; 3],
}

impl DecompositionJets {
    fn new(s: &Vector3<f64>, n: usize) -> Self {
        let zero = || vec![0.0; 1 << n];
        let constant = |value: f64| {
            let mut jet = zero();
            jet[0] = value;
            jet
        };
        let identity = || {
            std::array::from_fn(|i| {
                std::array::from_fn(|j| constant(if i == j { 1.0 } else { 0.0 }))
            })
        };
        Self {
            s: std::array::from_fn(|i| constant(s[i])),
            u: identity(),
            v: identity(),
            omega_u: std::array::from_fn(|_| zero()),
            omega_v: std::array::from_fn(|_| zero()),
        }
    }

    /// Fills the coefficient of `mask`, whose lowest entry is `(i, j)` and whose others are
    /// `rest`; all smaller subsets are known.
    fn differentiate(&mut self, mask: usize, rest: usize, (i, j): (usize, usize)) {
        let lowest = mask & !rest;
        self.differentiate_omega(mask, rest, lowest, (i, j));
        // (2.53)
        for alpha in 0..3 {
            let (u, v) = (&self.u[i][alpha], &self.v[j][alpha]);
            self.s[alpha][mask] = convolve(rest, |m| u[m], |m| v[m]);
        }
        // (2.54)
        for k in 0..3 {
            for l in 0..3 {
                let (mut du, mut dv) = (0.0, 0.0);
                for (pair, &(a, b)) in PAIRS.iter().enumerate() {
                    let (other, sign) = match l {
                        l if l == b => (a, 1.0),
                        l if l == a => (b, -1.0),
                        _ => continue,
                    };
                    let (omega_u, omega_v) = (&self.omega_u[pair], &self.omega_v[pair]);
                    let (u, v) = (&self.u[k][other], &self.v[k][other]);
                    du += sign * convolve(rest, |m| u[m], |m| omega_u[m | lowest]);
                    dv -= sign * convolve(rest, |m| v[m], |m| omega_v[m | lowest]);
                }
                self.u[k][l][mask] = du;
                self.v[k][l][mask] = dv;
            }
        }
    }

    /// Solves (2.55) for the skew matrices of the lowest entry.
    fn differentiate_omega(
        &mut self,
        mask: usize,
        rest: usize,
        lowest: usize,
        (i, j): (usize, usize),
    ) {
        for (pair, &(k, l)) in PAIRS.iter().enumerate() {
            let product = |a: &Jet, b: &Jet| convolve(rest, |m| a[m], |m| b[m]);
            // Leibniz terms without the unknown, whose coefficient is the empty subset's.
            let known = |s: &Jet, omega: &Jet| {
                let increment = |m: usize| if m == 0 { 0.0 } else { s[m] };
                convolve(rest, increment, |m| omega[m | lowest])
            };
            let (sk, sl) = (&self.s[k], &self.s[l]);
            let (ou, ov) = (&self.omega_u[pair], &self.omega_v[pair]);
            let x = product(&self.u[i][k], &self.v[j][l]) - known(sl, ou) - known(sk, ov);
            let y = -product(&self.u[i][l], &self.v[j][k]) - known(sk, ou) - known(sl, ov);
            let (sk, sl) = (sk[0], sl[0]);
            let determinant = (sl - sk) * (sl + sk);
            self.omega_u[pair][mask] = (sl * x - sk * y) / determinant;
            self.omega_v[pair][mask] = (sl * y - sk * x) / determinant;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::so3::HaarQuadrature;
    use nalgebra::Rotation3;

    #[test]
    fn it_agrees_with_the_one_pass_moments() {
        for s in [[25.0, 10.0, 5.0], [25.0, 10.0, -5.0], [3.0, 1.0, -0.5], [200.0, 90.0, 30.0]] {
            let s = Vector3::from(s);
            let (recursion, pass) = (HigherMoments::new(&s).unwrap(), Moments::new(&s).unwrap());
            let entries: Vec<_> = (0..9).map(|e| (e / 3, e % 3)).collect();
            for &a in &entries {
                for &b in &entries {
                    let second = recursion.moment(&[a, b]).unwrap();
                    assert!((second - pass.second(a, b)).abs() < 1e-11, "{s} {a:?} {b:?}");
                    for &c in &entries {
                        let third = recursion.moment(&[a, b, c]).unwrap();
                        let error = (third - pass.third(a, b, c)).abs();
                        assert!(error < 1e-10, "{s} {a:?} {b:?} {c:?} {third} {error}");
                    }
                }
            }
        }
    }

    #[test]
    fn higher_moments_agree_with_quadrature_on_the_group() {
        let s = Vector3::new(6.0, 3.0, -1.5);
        let grid = HaarQuadrature::of_degree(48);
        let density =
            |r: &Rotation3<f64>| (0..3).map(|i| s[i] * (r[(i, i)] - 1.0)).sum::<f64>().exp();
        let c = grid.integrate(density);
        let moments = HigherMoments::new(&s).unwrap();
        let fourth = [(0, 0), (1, 1), (0, 1), (1, 0)];
        let fifth = [(1, 2), (2, 1), (0, 1), (1, 2), (2, 0)];
        let sixth = [(0, 0), (1, 2), (2, 1), (0, 1), (1, 2), (2, 0)];
        for entries in [&fourth[..], &fifth[..], &sixth[..]] {
            let product = |r: &Rotation3<f64>| entries.iter().map(|&e| r[e]).product::<f64>();
            let expected = grid.integrate(|r| density(r) * product(r)) / c;
            let found = moments.moment(entries).unwrap();
            assert!(
                (found - expected).abs() < 1e-8 * expected.abs().max(1e-3),
                "{found} {expected}"
            );
        }
    }

    /// Theorem A.1. Its integer is `a(n) = (2n)! binomial(1/2, n)`: for an entry `t` at `(i, j)`
    /// alone `s_i + s_j` becomes the square root of `(s_i + s_j)^2 + t^2`, and so the difference.
    #[test]
    fn repeated_entries_move_singular_values_as_in_the_closed_form() {
        let s = Vector3::new(5.0, 3.0, -1.0);
        for (i, j) in [(0, 1), (1, 0), (0, 2), (2, 1)] {
            let mut integer = 1.0;
            for n in 1..=4 {
                let k = f64::from(n);
                integer *= 2.0 * k * (2.0 * k - 1.0) * (1.5 - k) / k;
                let entries = vec![(i, j); 2 * n as usize];
                let jets = singular_value_jets(&s, &entries);
                let derivative = |axis: usize| jets[axis][(1 << (2 * n)) - 1];
                for sign in [1.0, -1.0] {
                    let found = derivative(i) + sign * derivative(j);
                    let expected = integer / (s[i] + sign * s[j]).powi(2 * n - 1);
                    assert!((found / expected - 1.0).abs() < 1e-10, "{i} {j} {n} {found}");
                }
            }
        }
    }

    #[test]
    fn what_the_recursion_cannot_do_is_refused() {
        let repeated = HigherMoments::new(&Vector3::new(2.0, 1.0, -1.0));
        assert!(matches!(repeated, Err(HigherMomentError::Repeated(_))));
        let moments = HigherMoments::new(&Vector3::new(3.0, 2.0, 1.0)).unwrap();
        assert!(matches!(moments.moment(&[(0, 0); 13]), Err(HigherMomentError::Order(13))));
        assert!(matches!(moments.moment(&[(0, 3)]), Err(HigherMomentError::Entry((0, 3)))));
        assert_eq!(moments.moment(&[(0, 1), (1, 2), (0, 0)]), Ok(0.0));
        assert_eq!(moments.moment(&[]), Ok(1.0));
    }
}
