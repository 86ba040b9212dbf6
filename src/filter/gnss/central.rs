//! Central moments of `q = vec Q` to order three, as sparse tensors.

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

/// Mean, covariance and third central moments of `q = vec Q`, `Q ~ M(S)`.
pub(super) struct CentralMoments {
    pub mean: Vector9,
    pub covariance: Matrix9,
    third: [f64; TRIPLES],
}

impl CentralMoments {
    pub fn of(moments: &Moments) -> Self {
        let (mean, covariance) = mean_and_covariance(moments);
        let entry = |position: usize| (position % 3, position / 3);
        let third = TABLE.map(|[a, b, c]| {
            moments.third(entry(a), entry(b), entry(c))
                - mean[a] * covariance[(b, c)]
                - mean[b] * covariance[(a, c)]
                - mean[c] * covariance[(a, b)]
                - mean[a] * mean[b] * mean[c]
        });
        Self { mean, covariance, third }
    }

    /// `E[(w^T q~) q~ q~^T]`, `q~ = q - E[q]`.
    pub fn weighted(&self, w: &Vector9) -> Matrix9 {
        let mut sum = Matrix9::zeros();
        for [a, b, c, row] in ORDERED {
            sum[(a, b)] += self.third[row] * w[c];
        }
        sum
    }

    /// `E[(q~^T g q~) q~]` of a symmetric `g`.
    pub fn with_quadratic(&self, g: &Matrix9) -> Vector9 {
        let mut sum = Vector9::zeros();
        for [a, b, c, row] in ORDERED {
            sum[a] += self.third[row] * g[(b, c)];
        }
        sum
    }
}

/// `E[q]` and `Cov[q]`.
pub(super) fn mean_and_covariance(moments: &Moments) -> (Vector9, Matrix9) {
    let d = moments.first();
    let mut mean = Vector9::zeros();
    let mut covariance = moments.second_matrix();
    // The covariance of the diagonal is of second order in the dispersion: not by differences.
    let diagonal = moments.diagonal_covariance();
    for i in 0..3 {
        mean[4 * i] = d[i];
        for j in 0..3 {
            covariance[(4 * i, 4 * j)] = diagonal[(i, j)];
        }
    }
    (mean, covariance)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::distribution::matrix_fisher::MatrixFisher;
    use approx::assert_relative_eq;
    use nalgebra::{Matrix3, Vector3};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::Distribution;

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

    #[test]
    fn contractions_agree_with_samples() {
        let s = Vector3::new(6.0, 2.5, -1.0);
        let fisher = MatrixFisher::new(&Matrix3::from_diagonal(&s)).unwrap();
        let moments = CentralMoments::of(fisher.moments());
        let w = Vector9::from_fn(|i, _| ((3 * i + 1) % 7) as f64 - 3.0);
        let g = Matrix9::from_fn(|i, j| ((i * j + i + j) % 5) as f64 - 2.0);
        let sampler = fisher.sampler();
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let (mut weighted, mut quadratic) = (Matrix9::zeros(), Vector9::zeros());
        let samples = 400_000;
        for _ in 0..samples {
            let q = sampler.sample(&mut rng);
            let turned = fisher.centred(&q);
            let centred = Vector9::from_column_slice(turned.matrix().as_slice()) - moments.mean;
            weighted += centred * centred.transpose() * (w.dot(&centred) / samples as f64);
            quadratic += centred * (centred.dot(&(g * centred)) / samples as f64);
        }
        // The largest Monte Carlo standard deviation is about 0.006.
        assert_relative_eq!(moments.weighted(&w), weighted, epsilon = 0.025);
        assert_relative_eq!(moments.with_quadratic(&g), quadratic, epsilon = 0.025);
        assert!(moments.weighted(&w).amax() > 0.3 && moments.with_quadratic(&g).amax() > 0.3);
    }
}
