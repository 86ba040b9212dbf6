//! Which deviation of the attitude the Euclidean part is correlated with.

use nalgebra::{Rotation3, SMatrix, Vector3};

use crate::distribution::matrix_fisher::MatrixFisher;
use crate::so3::ProperSvd;

/// The frame whose rotations `x` is correlated with.
///
/// ```
/// # use mfg_vio::distribution::matrix_fisher_gaussian::Correlation;
/// # use mfg_vio::so3::exp;
/// # use nalgebra::Vector3;
/// // A small turn about the first principal axis, as either variant measures it: s2 + s3 times
/// // its angle.
/// let (s, q) = (Vector3::new(30.0, 20.0, 10.0), exp(&(1e-3 * Vector3::x())));
/// for correlation in [Correlation::World, Correlation::Body] {
///     let v = correlation.deviation(&q, &s);
///     assert!((v - Vector3::new(0.030, 0.0, 0.0)).norm() < 1e-8);
/// }
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Correlation {
    /// MFGI: rotations act on the left, in the world (inertial) frame (3.3a).
    World,
    /// MFGB: rotations act on the right, in the body frame (3.3b).
    Body,
}

impl Correlation {
    /// `v_R` of `Q = U^T R V` (3.3).
    pub fn deviation(self, q: &Rotation3<f64>, s: &Vector3<f64>) -> Vector3<f64> {
        let q = q.matrix();
        Vector3::from_fn(|i, _| {
            let (j, k) = ((i + 1) % 3, (i + 2) % 3);
            let (kj, jk) = self.weights(s, j, k);
            kj * q[(k, j)] - jk * q[(j, k)]
        })
    }

    /// The 3x9 matrix `L` with `v_R = L vec R` for this distribution of the attitude.
    pub fn regression(self, attitude: &MatrixFisher) -> SMatrix<f64, 3, 9> {
        let ProperSvd { u, s, v } = attitude.svd();
        let central = v.matrix().transpose().kronecker(&u.matrix().transpose());
        self.central_regression(s) * central
    }

    /// The 3x9 matrix `L` with `v_R = L vec Q`, columns stacked.
    pub fn central_regression(self, s: &Vector3<f64>) -> SMatrix<f64, 3, 9> {
        let mut l = SMatrix::zeros();
        for (i, j, k) in [(0, 1, 2), (1, 2, 0), (2, 0, 1)] {
            let (kj, jk) = self.weights(s, j, k);
            l[(i, k + 3 * j)] = kj;
            l[(i, j + 3 * k)] = -jk;
        }
        l
    }

    /// Component `i` of `v_R` is the first times `Q_kj` less the second times `Q_jk`.
    fn weights(self, s: &Vector3<f64>, j: usize, k: usize) -> (f64, f64) {
        match self {
            Self::World => (s[j], s[k]),
            Self::Body => (s[k], s[j]),
        }
    }
}
