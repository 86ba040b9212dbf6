//! What the routines of the pass take and give.

use super::forms::{Basis, CUBICS};

/// Sums of the proper singular values: half the concentrations about the principal axes of the
/// quaternion; `0 <= a[0] <= a[1] <= a[2]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sums {
    /// `s2 + s3, s1 + s3, s1 + s2`.
    pub a: [f64; 3],
    /// `s2 - s3 = a[2] - a[1]`.
    pub difference: f64,
}

impl Sums {
    pub fn of_singular_values(s: &nalgebra::Vector3<f64>) -> Self {
        Self { a: [s[1] + s[2], s[0] + s[2], s[0] + s[1]], difference: s[1] - s[2] }
    }

    pub fn new(a: [f64; 3]) -> Self {
        Self { a, difference: a[2] - a[1] }
    }

    /// `S` from its sums, in order also where rounding would have it otherwise.
    pub fn singular_values(&self) -> nalgebra::Vector3<f64> {
        let [a1, a2, a3] = self.a;
        let s1 = 0.5 * (a2 - a1) + 0.5 * a3;
        let s2 = (0.5 * (a1 + self.difference)).min(s1);
        let s3 = (0.5 * (a1 - self.difference)).clamp(-s2, s2);
        nalgebra::Vector3::new(s1, s2, s3)
    }
}

/// Moments of the squared quaternion components; `ORDER` 2 or 3.
#[derive(Debug, Clone, Copy)]
pub(super) struct EvenMoments {
    /// Logarithm of `c(S) exp(-tr S)`; to be relied on with the cubic moments only.
    pub log_c_scaled: f64,
    /// `E[x_i^2]`, `i = 1, 2, 3`, each accurate in relative terms.
    pub squares: [f64; 3],
    /// `E[x_i^2 x_j^2]`, `i, j = 1, 2, 3`, each accurate in relative terms.
    pub products: [[f64; 3]; 3],
    /// Cubic moments of `basis`; zero unless they were asked for.
    pub cubics: [f64; CUBICS],
    pub basis: Basis,
}
