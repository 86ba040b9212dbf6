use nalgebra::{Matrix3, Matrix4, SMatrix, Vector3, Vector4};

use super::engine;
use super::first::FirstMoments;
use super::forms::{self, Basis, CUBICS, FORMS};
use super::sums::Sums;
use super::{InvalidSingularValues, check_singular_values};

/// Normalizing constant and all moments up to order three of `Q = U^T R V ~ M(S)`, from one pass.
///
/// Largest errors measured against 80-digit arithmetic on 264 triples with `s1, s2, |s3|` from
/// 1e-6 to 1e8, both signs of `s3`, repetitions and opposites included:
///
/// | quantity | largest error |
/// | --- | --- |
/// | `log_c_scaled`, absolute | 5.4e-15 |
/// | `complement`, relative | 6.0e-14 |
/// | `first`, relative | 3.3e-13 |
/// | `second`, each moment, relative | 3.6e-13 |
/// | `third`, each moment, relative | 3.8e-13 |
///
/// Relative errors hold for every moment by itself, also for one that is far below its natural
/// scale because it vanishes with a singular value. Nothing is allocated.
///
/// Moments are derivatives of the constant (lemma 2.5): `c` has the first, second and third
/// derivatives `c E[Q_ii]`, `c E[Q_ii Q_jj]`, `c E[Q_ii Q_jj Q_kk]` with respect to `s`, `log c`
/// has the gradient [`first`](Self::first) and the Hessian
/// [`diagonal_covariance`](Self::diagonal_covariance), and the exponentially scaled constant `C`
/// has `-C E[1 - Q_ii]`, `C E[(1 - Q_ii)(1 - Q_jj)]`, `-C E[(1 - Q_ii)(1 - Q_jj)(1 - Q_kk)]`
/// ([`complement`](Self::complement), [`complement_second`](Self::complement_second),
/// [`complement_third`](Self::complement_third)).
///
/// ```
/// # use mfg_vio::distribution::matrix_fisher::Moments;
/// # use nalgebra::Vector3;
/// let moments = Moments::new(&Vector3::new(3.0, 2.0, 1.0))?;
/// // E[Q11], E[Q12 Q21] and, vanishing by symmetry, E[Q12].
/// assert!((moments.first()[0] - 0.751896581065).abs() < 1e-12);
/// assert!((moments.second((0, 1), (1, 0)) + 0.1178468848).abs() < 1e-10);
/// // What is lost from one is kept to full precision at any concentration:
/// let sharp = Moments::new(&Vector3::repeat(1e8))?;
/// assert!((sharp.complement()[0] - 0.5e-8).abs() < 1e-16);
/// # Ok::<(), mfg_vio::distribution::matrix_fisher::InvalidSingularValues>(())
/// ```
#[derive(Debug, Clone, Copy)]
pub struct Moments {
    s: Vector3<f64>,
    log_c_scaled: f64,
    squares: [f64; 3],
    products: [[f64; 3]; 3],
    forms: [f64; FORMS],
    cubics: [f64; CUBICS],
    basis: Basis,
}

impl Moments {
    /// The pass for `S = diag(s)` with `s1 >= s2 >= |s3|`.
    pub fn new(s: &Vector3<f64>) -> Result<Self, InvalidSingularValues> {
        check_singular_values(s)?;
        Ok(Self::of_ordered(s))
    }

    /// The pass for `s` known to be valid.
    pub(super) fn of_ordered(s: &Vector3<f64>) -> Self {
        let pass = engine::pass::<true>(&Sums::of_singular_values(s));
        let mut forms = forms::evaluate(pass.basis, &pass.cubics);
        restore_proportional_moments(s, &mut forms);
        Self {
            s: *s,
            log_c_scaled: pass.log_c_scaled,
            squares: pass.squares,
            products: pass.products,
            forms,
            cubics: pass.cubics,
            basis: pass.basis,
        }
    }

    /// What the inversion starts from.
    pub(super) fn up_to_second(&self) -> FirstMoments {
        let sums = Sums::of_singular_values(&self.s);
        FirstMoments { sums, squares: self.squares, products: self.products }
    }

    /// The proper singular values `S`.
    pub fn singular_values(&self) -> Vector3<f64> {
        self.s
    }

    /// `log c(S)`.
    pub fn log_c(&self) -> f64 {
        self.log_c_scaled + self.s.sum()
    }

    /// `c(S) exp(-tr S)`, the exponentially scaled constant (L-AMF 19).
    pub fn c_scaled(&self) -> f64 {
        self.log_c_scaled.exp()
    }

    /// `log(c(S) exp(-tr S))`, which does not underflow.
    pub fn log_c_scaled(&self) -> f64 {
        self.log_c_scaled
    }

    /// `d = (E[Q11], E[Q22], E[Q33])` (2.20); [`complement`](Self::complement) holds more digits
    /// where `d` is close to one.
    pub fn first(&self) -> Vector3<f64> {
        Vector3::from_fn(|i, _| self.form(&[(i, i)]))
    }

    /// `1 - d`, to full relative accuracy.
    pub fn complement(&self) -> Vector3<f64> {
        Vector3::from_fn(|i, _| self.forms[forms::complement_row(i)])
    }

    /// `E[(1 - Q_ii)(1 - Q_jj)]`, to full relative accuracy; indices from 0 to 2.
    pub fn complement_second(&self, i: usize, j: usize) -> f64 {
        let terms = small(i).map(|k| small(j).map(|l| self.products[k][l]));
        4.0 * terms.iter().flatten().sum::<f64>()
    }

    /// `E[(1 - Q_ii)(1 - Q_jj)(1 - Q_kk)]`, to 2e-11 in relative terms; indices from 0 to 2.
    pub fn complement_third(&self, i: usize, j: usize, k: usize) -> f64 {
        forms::complement_product(self.basis, &self.cubics, [i, j, k])
    }

    /// `E[Q_ij Q_kl]` for the entries `(i, j)` and `(k, l)`, indices from 0 to 2.
    pub fn second(&self, a: (usize, usize), b: (usize, usize)) -> f64 {
        self.form(&[a, b])
    }

    /// The expected product of three entries of `Q`, indices from 0 to 2.
    pub fn third(&self, a: (usize, usize), b: (usize, usize), c: (usize, usize)) -> f64 {
        self.form(&[a, b, c])
    }

    /// `E[vec Q (vec Q)^T]`, columns stacked.
    pub fn second_matrix(&self) -> SMatrix<f64, 9, 9> {
        SMatrix::from_fn(|a, b| self.second((a % 3, a / 3), (b % 3, b / 3)))
    }

    /// `Cov[Q_ii, Q_jj]`: the Hessian of `log c` with respect to `s`.
    ///
    /// Computed from the small quantities `1 - Q_ii = 2 (x_j^2 + x_k^2)`.
    pub fn diagonal_covariance(&self) -> Matrix3<f64> {
        let covariance = self.square_covariance();
        Matrix3::from_fn(|i, j| {
            let terms = small(i).map(|k| small(j).map(|l| covariance[(k, l)]));
            4.0 * terms.iter().flatten().sum::<f64>()
        })
    }

    /// `E[x_a^2]` of the unit quaternion of `Q`, scalar first: the Bingham moments (2.26).
    pub fn quaternion_squares(&self) -> Vector4<f64> {
        let [y1, y2, y3] = self.squares;
        Vector4::new(1.0 - y1 - y2 - y3, y1, y2, y3)
    }

    /// `E[x_a^2 x_b^2]` of the unit quaternion of `Q`, scalar first.
    pub fn quaternion_products(&self) -> Matrix4<f64> {
        let y = self.quaternion_squares();
        let mut products = Matrix4::zeros();
        for i in 0..3 {
            for j in 0..3 {
                products[(i + 1, j + 1)] = self.products[i][j];
            }
            let with_scalar = y[i + 1] - self.products[i].iter().sum::<f64>();
            products[(0, i + 1)] = with_scalar;
            products[(i + 1, 0)] = with_scalar;
        }
        products[(0, 0)] = y[0] - products[(0, 1)] - products[(0, 2)] - products[(0, 3)];
        products
    }

    /// `Cov[x_i^2, x_j^2]`, `i, j = 1, 2, 3`.
    fn square_covariance(&self) -> Matrix3<f64> {
        Matrix3::from_fn(|i, j| self.products[i][j] - self.squares[i] * self.squares[j])
    }

    fn form(&self, entries: &[(usize, usize)]) -> f64 {
        forms::row(entries).map_or(0.0, |row| self.forms[row])
    }
}

/// Indices of the components in `1 - Q_ii = 2 (x_j^2 + x_k^2)`.
fn small(i: usize) -> [usize; 2] {
    [(i + 1) % 3, (i + 2) % 3]
}

/// Third moments that vanish with a single singular value.
///
/// `E[Q12 Q31 Q32] : E[Q12 Q13 Q23] : E[Q12 Q13 Q32] = s1 : s2 : s3`, so that the first, which is
/// well conditioned, gives the others to full relative accuracy.
fn restore_proportional_moments(s: &Vector3<f64>, forms: &mut [f64; FORMS]) {
    const PROPORTIONAL: [[(usize, usize); 3]; 3] =
        [[(0, 1), (2, 0), (2, 1)], [(0, 1), (0, 2), (1, 2)], [(0, 1), (0, 2), (2, 1)]];
    let rows = PROPORTIONAL.map(|entries| forms::row(&entries));
    if let [Some(first), Some(second), Some(third)] = rows
        && s[0] > 0.0
    {
        forms[second] = forms[first] * (s[1] / s[0]);
        forms[third] = forms[first] * (s[2] / s[0]);
    }
}
