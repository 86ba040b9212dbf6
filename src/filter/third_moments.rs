//! Third moments of `q = vec Q` as a sparse tensor, for the filters that propagate moments.

use nalgebra::{SMatrix, SVector};

use crate::distribution::matrix_fisher::Moments;

/// `vec` of a 3x3 matrix, columns stacked.
pub(super) type Vector9 = SVector<f64, 9>;
/// Covariances and linear maps of [`Vector9`].
pub(super) type Matrix9 = SMatrix<f64, 9, 9>;

/// Unordered triples of entries of `Q` whose expected product does not vanish.
const TRIPLES: usize = 45;
/// The same with order.
const ORDERED_TRIPLES: usize = 183;

/// `a <= b <= c`, positions in `vec Q`.
const TABLE: [[usize; 3]; TRIPLES] = triples();
/// `(a, b, c)` in every order, and the row of the triple in [`TABLE`].
const ORDERED: [[usize; 4]; ORDERED_TRIPLES] = ordered_triples();

/// Half turns about the axes change the signs of `Q_ij` by a character: 0 for the diagonal, else
/// the number 1 to 3 of the axis that is neither `i` nor `j`.
const fn character(position: usize) -> usize {
    let (i, j) = (position % 3, position / 3);
    if i == j { 0 } else { 4 - i - j }
}

/// Expectations are unchanged by half turns, so a product survives if its characters cancel.
const fn survives(a: usize, b: usize, c: usize) -> bool {
    character(a) ^ character(b) ^ character(c) == 0
}

const fn triples() -> [[usize; 3]; TRIPLES] {
    let mut table = [[0; 3]; TRIPLES];
    let (mut next, mut code) = (0, 0);
    while code < 729 {
        let (a, b, c) = (code / 81, code / 9 % 9, code % 9);
        if a <= b && b <= c && survives(a, b, c) {
            table[next] = [a, b, c];
            next += 1;
        }
        code += 1;
    }
    table
}

const fn ordered_triples() -> [[usize; 4]; ORDERED_TRIPLES] {
    let mut table = [[0; 4]; ORDERED_TRIPLES];
    let (mut next, mut code) = (0, 0);
    while code < 729 {
        let (a, b, c) = (code / 81, code / 9 % 9, code % 9);
        if survives(a, b, c) {
            table[next] = [a, b, c, row_of(a, b, c)];
            next += 1;
        }
        code += 1;
    }
    table
}

const fn row_of(a: usize, b: usize, c: usize) -> usize {
    let mut row = 0;
    while row < TRIPLES {
        let [x, y, z] = TABLE[row];
        let same_sum = a + b + c == x + y + z;
        let same_squares = a * a + b * b + c * c == x * x + y * y + z * z;
        let same_product = (a + 1) * (b + 1) * (c + 1) == (x + 1) * (y + 1) * (z + 1);
        if same_sum && same_squares && same_product {
            return row;
        }
        row += 1;
    }
    row
}

/// `E[q_a q_b q_c]`, `Q ~ M(S)`, or the same of `q - E[q]`.
pub(super) struct ThirdMoments([f64; TRIPLES]);

impl ThirdMoments {
    pub fn of(moments: &Moments) -> Self {
        let entry = |position: usize| (position % 3, position / 3);
        Self(TABLE.map(|[a, b, c]| moments.third(entry(a), entry(b), entry(c))))
    }

    /// About the mean of `q`, given with its covariance.
    pub fn central(moments: &Moments, mean: &Vector9, covariance: &Matrix9) -> Self {
        let mut third = Self::of(moments);
        for (moment, [a, b, c]) in third.0.iter_mut().zip(TABLE) {
            *moment -= mean[a] * covariance[(b, c)]
                + mean[b] * covariance[(a, c)]
                + mean[c] * covariance[(a, b)]
                + mean[a] * mean[b] * mean[c];
        }
        third
    }

    /// `E[(w^T q) q q^T]`.
    pub fn weighted(&self, w: &Vector9) -> Matrix9 {
        let mut sum = Matrix9::zeros();
        for [a, b, c, row] in ORDERED {
            sum[(a, b)] += self.0[row] * w[c];
        }
        sum
    }

    /// `E[(q^T g q) q]` of a symmetric `g`.
    pub fn with_quadratic(&self, g: &Matrix9) -> Vector9 {
        let mut sum = Vector9::zeros();
        for [a, b, c, row] in ORDERED {
            sum[a] += self.0[row] * g[(b, c)];
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_list_each_surviving_product_once() {
        assert_eq!(TABLE.iter().filter(|t| t[0] <= t[1] && t[1] <= t[2]).count(), TRIPLES);
        assert!(TABLE.windows(2).all(|pair| pair[0] < pair[1]));
        for [a, b, c, row] in ORDERED {
            let mut sorted = [a, b, c];
            sorted.sort_unstable();
            assert_eq!(TABLE[row], sorted);
        }
        assert!(ORDERED.windows(2).all(|pair| pair[0][..3] < pair[1][..3]));
    }
}
