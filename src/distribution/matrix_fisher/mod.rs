//! The matrix Fisher distribution on SO(3).
//!
//! # Definition
//!
//! `R ~ M(F)` has the density, with respect to the normalized Haar measure (2.16),
//!
//! ```math
//! p(R) = \frac{\exp(\tr(F^\top R))}{c(F)}, \qquad
//! c(F) = \int_{\mathrm{SO}(3)} \exp(\tr(F^\top R)) \, dR .
//! ```
//!
//! With the proper singular value decomposition (2.17)
//!
//! ```math
//! F = U S V^\top, \qquad S = \diag(s_1, s_2, s_3), \qquad s_1 \ge s_2 \ge |s_3|,
//! ```
//!
//! the rotation `Q = U^T R V ~ M(S)` is centred at the identity; `U V^T` is the mode and the mean
//! attitude, the columns of `U` are the principal axes in the world and those of `V` in the body
//! frame, and `s_j + s_k` is the concentration about the `i`-th of them (2.21).
//!
//! # Moments
//!
//! The constant generates them: for any matrix `T` (2.43), (2.19), (2.20), (2.44)
//!
//! ```math
//! E[\exp(\tr(T^\top Q))] &= \frac{c(S + T)}{c(S)} , \\
//! E[R] &= U D V^\top, \qquad d_i = E[Q_{ii}] = \frac{\partial \log c(S)}{\partial s_i} , \\
//! E[Q_{i_1 j_1} \cdots Q_{i_n j_n}] &=
//!   \frac{1}{c(S)} \frac{\partial^n c(S + T)}{\partial T_{i_1 j_1} \cdots \partial T_{i_n j_n}} .
//! ```
//!
//! A moment vanishes unless each of the indices 1, 2, 3 occurs an even number of times among all
//! rows and columns (corollary 2.1). `E[R]` is a sufficient statistic: the maximum likelihood
//! estimate solves `d(S) = d` for the singular values `d` of the mean of samples.
//!
//! # Information
//!
//! Fisher information of the mean attitude (4.22), measure of observability (4.24), entropy, and
//! divergence between two of them, in the forms that keep their digits at any concentration:
//!
//! ```math
//! I(R^*) &= \frac{1}{2} \diag((d_2 + d_3)(s_2 + s_3), (d_1 + d_3)(s_1 + s_3), (d_1 + d_2)(s_1 + s_2)) , \\
//! \rho &= (d_1 + d_2)(d_1 + d_3)(d_2 + d_3) , \\
//! H &= \log(c(S) e^{-\tr S}) + \sum_i s_i (1 - d_i) .
//! ```
//!
//! # How it is computed
//!
//! The unit quaternion `x` of `Q` has the density `exp(-2 sum_i (s_j + s_k) x_i^2)`: a Bingham
//! distribution (theorem 2.2) whose exponents are sums of singular values, never differences. One
//! pass over it gives the exponentially scaled constant `c(S) exp(-tr S)` (L-AMF 19) and all
//! moments to order three ([`Moments`], with measured errors). Three routines share the plane of
//! concentrations:
//!
//! | where | routine |
//! | --- | --- |
//! | `s1 + s2 <= 1/64` | power series of `c` in `S` with exact Haar moments |
//! | `s2 + s3 >= 25` | asymptotic series in `1/(s_j + s_k)`, all of whose terms are positive |
//! | elsewhere | Gauss-Legendre panels over both scales of a one-dimensional integral |
//!
//! The integral has `u = x_2^2 + x_3^2` for its variable; on the two circles that remain, exponents
//! are linear in a cosine and integrate to scaled Bessel functions `I_0(t) exp(-t)`:
//!
//! ```math
//! c(S) e^{-\tr S} = \int_0^1 e^{-2 (s_1 + s_3) u} \,
//!   I_0^e((s_2 + s_3)(1 - u)) \, I_0^e((s_2 - s_3) u) \, du .
//! ```
//!
//! The series of the concentrated regime starts at (2.59) and is, for `r^2 = x_1^2 + x_2^2 +
//! x_3^2`,
//!
//! ```math
//! c(S) e^{-\tr S} = \frac{E[(1 - r^2)^{-1/2}]}{\sqrt{8 \pi (s_1 + s_2)(s_1 + s_3)(s_2 + s_3)}} ,
//!   \qquad x_i \sim \mathcal{N}(0, \frac{1}{4 (s_j + s_k)}) .
//! ```
//!
//! The inverse, `S` from `E[R]` ([`s_from_d`], [`MatrixFisher::from_mean`]), is Newton's method on
//! a form of the likelihood equations that is almost linear where the distribution is
//! concentrated. `1 - d` is the primary quantity: at `s = 1e8` it holds all the information
//! ([`Moments::complement`], [`s_from_complement`]).
//!
//! # A tour
//!
//! - [`MatrixFisher`]: density, mode, mean, second moments, information and covariance of the
//!   rotation vector, sampling, Bayes' rule.
//! - [`Moments`]: central moments by index. [`HigherMoments`]: any order, by the recursion of
//!   theorems 2.3-2.5.
//! - [`ApproximateMoments`]: the closed-form limits (2.59-2.64, L-AMF 33-39), for comparison.
//! - [`SubsetConcentration`]: mean angle and concentration about one axis (FNF section III).
//! - [`canonical_axes`]: the freedom of the principal axes, used up.
//!
//! # Misprints in the sources
//!
//! Found while checking every formula against quadrature on SO(3):
//!
//! - L-AMF (22): the second derivative needs `(u-1)^2`.
//! - L-UAE (7): the sum is that of the *proper* singular values of the 2x2 block; square roots of
//!   eigenvalues are wrong where its determinant is negative.
//! - W22 section 2.3.3: `c_M(S) = c_B(Z)` holds for exponents shifted to the trace zero; with
//!   `z0 = 0` it is `c_B(Z) = c_M(S) exp(-tr S)`.
//! - W22 (2.50): the second equation is that of `V'`.
//! - W22 theorem 2.7: `eta_1` is the von Mises variable, not `eta_3`.
//! - W22 (B.7), (B.8): the first lines are `E[Q_ii Q_jk Q_jk]` and `E[Q_jj Q_jk Q_jk]`. (B.9b) has
//!   wrong signs. All are replaced here; note that `E[Q12 Q31 Q32] : E[Q12 Q13 Q23] :
//!   E[Q12 Q13 Q32] = s1 : s2 : s3`.
//! - W22 (3.3): the labels of `v_R` are exchanged against those of section 3.1.3; definition 3.2
//!   orders the exponents `z1 >= z3 >= z2`, theorem 2.2 `z1 >= z2 >= z3`.
//! - W22 (3.9), (3.10) drop a term that is of the order of the correlation; see
//!   [`attitude_given`](super::matrix_fisher_gaussian::MatrixFisherGaussian::attitude_given).
//! - W22 (5.40): `gamma` has the length of the measured `r'_i`, not of `r_i`; see
//!   [`align_progressively`](crate::alignment::align_progressively).
//! - W22 theorem A.1 leaves its integer open; it is `a(n) = (2n)! binomial(1/2, n)`.
#![doc = include_str!("../../../docs/math.html")]

mod approximation;
mod axes;
mod concentrated;
mod engine;
mod first;
mod forms;
mod information;
mod mle;
mod moments;
mod near_uniform;
mod quadrature;
mod recursion;
mod sampler;
mod subset;
mod sums;

use nalgebra::{Matrix3, Rotation3, SMatrix, Vector3};
use rand::Rng;
use rand_distr::Distribution;

use crate::so3::{NotFinite, ProperSvd, principal_axes, proper_svd, quaternion_from_rotation};
use sums::Sums;

pub use approximation::{ApproximateMoments, s_concentrated, s_near_uniform};
pub use axes::canonical_axes;
pub use first::FirstMoments;
pub use mle::{
    MomentError, s_from_complement, s_from_complement_near, s_from_d, s_from_quaternion_squares,
};
pub use moments::Moments;
pub use recursion::{HigherMomentError, HigherMoments, MAX_ORDER};
pub use sampler::MatrixFisherSampler;
pub use subset::SubsetConcentration;

/// Largest singular value; beyond it products of concentrations overflow.
const MAX_SINGULAR_VALUE: f64 = 1e100;

/// An information matrix whose smallest eigenvalue is negative by more than this fraction of the
/// largest is refused; less is rounding.
const NEGATIVE_INFORMATION: f64 = 1e-12;

/// `S` that are not proper singular values of any matrix, or too large to compute with.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("proper singular values must satisfy 1e100 >= s1 >= s2 >= |s3|, not {0:?}")]
pub struct InvalidSingularValues(pub [f64; 3]);

/// Why a matrix Fisher distribution cannot be made.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum MatrixFisherError {
    #[error(transparent)]
    NotFinite(#[from] NotFinite),
    #[error(transparent)]
    SingularValues(#[from] InvalidSingularValues),
    #[error(transparent)]
    Moments(#[from] MomentError),
    /// The attitude given as the mode is a saddle or minimum.
    #[error("the rotation information must not be negative: its smallest eigenvalue is {0}")]
    NegativeInformation(f64),
}

/// The matrix Fisher distribution `M(F)` on SO(3), with its moments.
///
/// Construction costs one pass for the moments; densities and moments are then cheap.
///
/// ```
/// # use mfg_vio::distribution::matrix_fisher::MatrixFisher;
/// # use nalgebra::{Matrix3, Vector3};
/// let prior = MatrixFisher::new(&Matrix3::from_diagonal(&Vector3::new(20.0, 5.0, -1.0)))?;
/// // Its mean determines it: E[R] is a sufficient statistic.
/// let fitted = MatrixFisher::from_mean(&prior.mean())?;
/// assert!((fitted.parameter() - prior.parameter()).norm() < 1e-11);
/// // Independent beliefs about the same attitude multiply: their parameters add.
/// let posterior = prior.fuse(&fitted)?;
/// assert!(posterior.log_density(&posterior.mode()) > prior.log_density(&prior.mode()));
/// # Ok::<(), mfg_vio::distribution::matrix_fisher::MatrixFisherError>(())
/// ```
#[derive(Debug, Clone, Copy)]
pub struct MatrixFisher {
    svd: ProperSvd,
    moments: Moments,
}

impl MatrixFisher {
    /// The uniform distribution, `F = 0`.
    pub fn uniform() -> Self {
        let identity = Rotation3::identity();
        let s = Vector3::zeros();
        let moments = Moments::of_ordered(&s);
        Self { svd: ProperSvd { u: identity, s, v: identity }, moments }
    }

    /// `M(F)`.
    pub fn new(f: &Matrix3<f64>) -> Result<Self, MatrixFisherError> {
        Ok(Self::from_svd(proper_svd(f)?)?)
    }

    /// `M(U S V^T)` with these principal axes, which the matrix `F` alone does not determine
    /// where singular values repeat.
    pub fn from_svd(svd: ProperSvd) -> Result<Self, InvalidSingularValues> {
        Ok(Self { svd, moments: Moments::new(&svd.s)? })
    }

    /// The distribution whose mean `E[R]` is `mean`: the MLE from the mean of samples.
    pub fn from_mean(mean: &Matrix3<f64>) -> Result<Self, MatrixFisherError> {
        let svd = proper_svd(mean)?;
        let s = s_from_d(&svd.s)?;
        Ok(Self::from_svd(ProperSvd { s, ..svd })?)
    }

    /// The same, sought from a neighbour such as the belief a step before.
    pub fn from_mean_near(
        mean: &Matrix3<f64>,
        neighbour: &Self,
    ) -> Result<Self, MatrixFisherError> {
        let svd = proper_svd(mean)?;
        let s = s_from_complement_near(&svd.s.map(|d| 1.0 - d), &neighbour.moments)?;
        Ok(Self::from_svd(ProperSvd { s, ..svd })?)
    }

    /// The distribution with the given mode and, at the mode, the given Hessian of minus the
    /// log-density with respect to the body-frame rotation vector `e` of `mode exp(e^)`, 1/rad^2.
    ///
    /// `F = M (tr(H)/2 I - H)`, the map of FNF (31). `H` must be symmetric and not negative.
    pub fn from_mode_and_information(
        mode: Rotation3<f64>,
        information: Matrix3<f64>,
    ) -> Result<Self, MatrixFisherError> {
        if !information.iter().all(|x| x.is_finite()) {
            return Err(NotFinite(information).into());
        }
        let symmetric = 0.5 * (information + information.transpose());
        let (axes, negated) = principal_axes(&-symmetric);
        let h = -negated;
        if h[0] < -NEGATIVE_INFORMATION * h[2] || h[2] < 0.0 {
            return Err(MatrixFisherError::NegativeInformation(h[0]));
        }
        let s = Sums::new([h[0].max(0.0), h[1].max(0.0), h[2]]).singular_values();
        Ok(Self::from_svd(ProperSvd { u: mode * axes, s, v: axes })?)
    }

    /// `U`, `S`, `V` of the parameter.
    pub fn svd(&self) -> &ProperSvd {
        &self.svd
    }

    /// `F = U S V^T`.
    pub fn parameter(&self) -> Matrix3<f64> {
        self.svd.matrix()
    }

    /// The most probable attitude `U V^T`, which is also the mean attitude in the Frobenius
    /// metric.
    pub fn mode(&self) -> Rotation3<f64> {
        self.svd.rotation()
    }

    /// Constant and central moments, those of `Q = U^T R V`.
    pub fn moments(&self) -> &Moments {
        &self.moments
    }

    /// `Q = U^T R V`, the attitude relative to the mode in principal axes.
    pub fn centred(&self, r: &Rotation3<f64>) -> Rotation3<f64> {
        self.svd.u.inverse() * r * self.svd.v
    }

    /// Logarithm of the density at `r` with respect to the normalized Haar measure.
    pub fn log_density(&self, r: &Rotation3<f64>) -> f64 {
        // tr(S Q) - tr S = -2 sum a_i x_i^2 keeps its digits where the trace has lost them.
        let x = quaternion_from_rotation(&self.centred(r));
        let a = Sums::of_singular_values(&self.svd.s).a;
        let exponent: f64 = a.iter().enumerate().map(|(i, a)| a * x[i + 1] * x[i + 1]).sum();
        -2.0 * exponent - self.moments.log_c_scaled()
    }

    /// `E[R] = U D V^T` (2.19).
    pub fn mean(&self) -> Matrix3<f64> {
        self.in_world(&self.moments.first())
    }

    /// `U V^T - E[R]`, to full relative accuracy at any concentration.
    pub fn mean_complement(&self) -> Matrix3<f64> {
        self.in_world(&self.moments.complement())
    }

    /// `E[vec R (vec R)^T]`, columns stacked.
    pub fn second_moment(&self) -> SMatrix<f64, 9, 9> {
        let rotation = self.svd.v.matrix().kronecker(self.svd.u.matrix());
        rotation * self.moments.second_matrix() * rotation.transpose()
    }

    /// Hessian of minus the log-density at the mode with respect to the body-frame rotation
    /// vector, `V (tr(S) I - S) V^T`, 1/rad^2: the inverse of
    /// [`from_mode_and_information`](Self::from_mode_and_information).
    pub fn information(&self) -> Matrix3<f64> {
        self.in_body(&Sums::of_singular_values(&self.svd.s).a)
    }

    /// Covariance of the body-frame rotation vector `log(M^T R)`, rad^2.
    ///
    /// In the concentrated regime a series whose leading term is the inverse of
    /// [`information`](Self::information) (theorem 2.6); elsewhere a quadrature, good to 1e-9, so
    /// that the result is finite and right for any attitude uncertainty.
    pub fn rotation_covariance(&self) -> Matrix3<f64> {
        let sums = Sums::of_singular_values(&self.svd.s);
        self.in_body(&engine::rotation_vector_variances(&sums))
    }

    /// The posterior of two independent beliefs about the same attitude: `M(F + F')`.
    pub fn fuse(&self, other: &Self) -> Result<Self, MatrixFisherError> {
        Self::new(&(self.parameter() + other.parameter()))
    }

    /// A sampler, prepared once for many draws.
    pub fn sampler(&self) -> MatrixFisherSampler {
        MatrixFisherSampler::new(&self.svd)
    }

    /// One exact sample.
    pub fn sample<R: Rng + ?Sized>(&self, rng: &mut R) -> Rotation3<f64> {
        self.sampler().sample(rng)
    }

    fn in_world(&self, diagonal: &Vector3<f64>) -> Matrix3<f64> {
        ProperSvd { s: *diagonal, ..self.svd }.matrix()
    }

    fn in_body(&self, diagonal: &[f64; 3]) -> Matrix3<f64> {
        let v = self.svd.v;
        ProperSvd { u: v, s: Vector3::from(*diagonal), v }.matrix()
    }
}

/// `s2 + s3, s1 + s3, s1 + s2`: the concentrations about the principal axes.
pub(super) fn sums_of_singular_values(s: &Vector3<f64>) -> [f64; 3] {
    Sums::of_singular_values(s).a
}

fn check_singular_values(s: &Vector3<f64>) -> Result<(), InvalidSingularValues> {
    let valid = s[0] <= MAX_SINGULAR_VALUE && s[0] >= s[1] && s[1] >= s[2].abs();
    valid.then_some(()).ok_or(InvalidSingularValues((*s).into()))
}

#[cfg(test)]
mod tests;
