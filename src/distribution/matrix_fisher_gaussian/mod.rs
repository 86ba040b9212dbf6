//! The matrix Fisher-Gaussian distribution on SO(3) x R^n.
//!
//! # Definition
//!
//! `(R, x) ~ MG(mu, Sigma, P, U, S, V)` if `R ~ M(U S V^T)` and, given `R`, `x` is Gaussian
//! (definition 3.1):
//!
//! ```math
//! x | R &\sim \mathcal{N}(\mu + P v_R, \Sigma_c), \qquad
//!   \Sigma_c = \Sigma - P (\tr(S) I - S) P^\top , \\
//! v_R &= (Q S - S Q^\top)^\vee \quad \text{(world, MFGI)} , \\
//! v_R &= (S Q - Q^\top S)^\vee \quad \text{(body, MFGB)} , \qquad Q = U^\top R V .
//! ```
//!
//! It is a Gaussian on the ambient space `R^9 x R^n`, conditioned on `R` being a rotation (theorem
//! 3.2).
//!
//! `P` (n x 3) holds the linear correlation of `x` with rotations about the principal axes: it is
//! the covariance of `x` with the rotation vector in those axes where the attitude is
//! concentrated (theorem 3.4). The two variants differ in the frame in which that rotation acts:
//! the world's ([`Correlation::World`], multiplied on the left) or the body's
//! ([`Correlation::Body`], on the right). They coincide for `S = s I`.
//!
//! The vector `v_R` is linear in `vec R`, so that everything here is: [`regression`] gives the
//! 3x9 matrix, and conditional mean, moments and estimates follow by linear algebra.
//!
//! # Moments and estimation
//!
//! `E[v_R] = 0`, and `v_R` has a diagonal covariance (theorem 3.5):
//!
//! ```math
//! E[x] &= \mu , \qquad E[v_R v_R^\top] = \tr(S D) I - S D = \Delta , \\
//! \mathrm{Cov}[x, v_R] &= P \Delta , \qquad \mathrm{Cov}[x] = \Sigma_c + P \Delta P^\top .
//! ```
//!
//! Estimation goes backwards: the attitude from `E[R]`, then `P`, `mu` and `Sigma` by regression on
//! `v_R` (theorem 3.6), from samples ([`from_samples`]) or from moments ([`from_moments`]). What
//! this two-step estimate gives away is [`concentration_information`] (theorem 3.7).
//!
//! The dimension `n` is a type: fixed (`Const<15>`) or dynamic (`Dyn`).
//!
//! [`regression`]: MatrixFisherGaussian::regression
//! [`from_samples`]: MatrixFisherGaussian::from_samples
//! [`from_moments`]: MatrixFisherGaussian::from_moments
//! [`concentration_information`]: MatrixFisherGaussian::concentration_information
#![doc = include_str!("../../../docs/math.html")]

mod correlation;
mod estimation;

use nalgebra::allocator::Allocator;
use nalgebra::{
    Cholesky, DefaultAllocator, Dim, Matrix3, OMatrix, OVector, Rotation3, SMatrix, U1, U3, Vector3,
};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

use super::matrix_fisher::{
    MatrixFisher, MatrixFisherError, MatrixFisherSampler, sums_of_singular_values,
};
use crate::so3::{ProperSvd, exp};

pub use correlation::Correlation;
pub use estimation::{ConditionalMoments, TangentGaussian, WeightedSample};

/// Why a matrix Fisher-Gaussian distribution cannot be made.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum MfgError {
    #[error(transparent)]
    Attitude(#[from] MatrixFisherError),
    /// A parameter of the Gaussian part is infinite or not a number.
    #[error("{0} has an entry that is not finite")]
    NotFinite(&'static str),
    /// `Sigma - P (tr(S) I - S) P^T` is not positive definite.
    #[error("the covariance of x given the attitude is not positive definite")]
    ConditionalCovariance,
    /// The covariance or information of the rotation vector is not positive definite.
    #[error("the covariance of the rotation vector is not positive definite")]
    RotationCovariance,
    /// Samples or weights that determine nothing.
    #[error("no samples of positive total weight")]
    NoSamples,
}

/// The matrix Fisher-Gaussian distribution of an attitude and a vector of dimension `D`.
///
/// ```
/// # use mfg_vio::distribution::matrix_fisher::MatrixFisher;
/// # use mfg_vio::distribution::matrix_fisher_gaussian::{Correlation, MatrixFisherGaussian};
/// # use nalgebra::{Matrix1, Matrix1x3, Matrix3, Rotation3, Vector1};
/// // A gyroscope bias (1 component) correlated with rotations about the first principal axis.
/// let attitude = MatrixFisher::new(&Matrix3::from_diagonal_element(10.0))?;
/// let belief = MatrixFisherGaussian::new(
///     attitude,
///     Vector1::new(0.0),
///     Matrix1::new(1.0),
///     Matrix1x3::new(0.14, 0.0, 0.0),
///     Correlation::Body,
/// )?;
/// let tilted = Rotation3::from_scaled_axis(nalgebra::Vector3::x() * 0.1);
/// assert!(belief.conditional_mean(&tilted)[0] > 0.25);
/// # Ok::<(), mfg_vio::distribution::matrix_fisher_gaussian::MfgError>(())
/// ```
#[derive(Debug, Clone)]
pub struct MatrixFisherGaussian<D: Dim>
where
    DefaultAllocator: Allocator<D> + Allocator<D, D> + Allocator<D, U3>,
{
    attitude: MatrixFisher,
    correlation: Correlation,
    mu: OVector<f64, D>,
    p: OMatrix<f64, D, U3>,
    /// Cholesky factor of `Sigma_c`.
    conditional: Cholesky<f64, D>,
}

/// First and second moments of `(R, x)` (theorem 3.5).
///
/// ```
/// # use mfg_vio::distribution::matrix_fisher::MatrixFisher;
/// # use mfg_vio::distribution::matrix_fisher_gaussian::{Correlation, MatrixFisherGaussian};
/// # use nalgebra::{Matrix1, Matrix1x3, Matrix3, Vector1};
/// let attitude = MatrixFisher::new(&Matrix3::from_diagonal_element(10.0))?;
/// let (mu, sigma) = (Vector1::new(0.5), Matrix1::new(1.0));
/// let p = Matrix1x3::new(0.1, 0.0, 0.0);
/// let belief = MatrixFisherGaussian::new(attitude, mu, sigma, p, Correlation::Body)?;
/// let moments = belief.moments();
/// assert_eq!(moments.mean, mu);
/// // Close to the parameter where the attitude is concentrated, below it elsewhere.
/// assert!((0.98..1.0).contains(&moments.covariance[(0, 0)]));
/// # Ok::<(), mfg_vio::distribution::matrix_fisher_gaussian::MfgError>(())
/// ```
#[derive(Debug, Clone)]
pub struct MfgMoments<D: Dim>
where
    DefaultAllocator: Allocator<D> + Allocator<D, D> + Allocator<D, U3>,
{
    /// `E[R]` (3.16).
    pub attitude: Matrix3<f64>,
    /// `E[x] = mu` (3.17).
    pub mean: OVector<f64, D>,
    /// `Cov[x]` (3.19).
    pub covariance: OMatrix<f64, D, D>,
    /// `E[x v_R^T] = Cov[x, v_R]` (3.20).
    pub cross: OMatrix<f64, D, U3>,
    /// Diagonal of `E[v_R v_R^T]` (3.21).
    pub deviation: Vector3<f64>,
}

impl<D: Dim> MatrixFisherGaussian<D>
where
    DefaultAllocator:
        Allocator<D> + Allocator<D, D> + Allocator<D, U3> + Allocator<U3, D> + Allocator<U1, D>,
{
    /// From the parameters of definition 3.1, checked: `Sigma_c` must be positive definite.
    pub fn new(
        attitude: MatrixFisher,
        mu: OVector<f64, D>,
        sigma: OMatrix<f64, D, D>,
        p: OMatrix<f64, D, U3>,
        correlation: Correlation,
    ) -> Result<Self, MfgError> {
        let conditional = sigma - scaled_outer(&p, &tangent_information(&attitude));
        Self::from_conditional(attitude, mu, conditional, p, correlation)
    }

    /// From the conditional covariance `Sigma_c` in place of `Sigma`.
    pub fn from_conditional(
        attitude: MatrixFisher,
        mu: OVector<f64, D>,
        conditional: OMatrix<f64, D, D>,
        p: OMatrix<f64, D, U3>,
        correlation: Correlation,
    ) -> Result<Self, MfgError> {
        let finite = |entries: &[f64]| entries.iter().all(|x| x.is_finite());
        if !finite(mu.as_slice()) {
            return Err(MfgError::NotFinite("mu"));
        }
        if !finite(p.as_slice()) {
            return Err(MfgError::NotFinite("P"));
        }
        if !finite(conditional.as_slice()) {
            return Err(MfgError::NotFinite("Sigma"));
        }
        let conditional = Cholesky::new(symmetric(conditional));
        let conditional = conditional.ok_or(MfgError::ConditionalCovariance)?;
        Ok(Self { attitude, correlation, mu, p, conditional })
    }

    /// The marginal distribution of `R`.
    pub fn attitude(&self) -> &MatrixFisher {
        &self.attitude
    }

    pub fn correlation(&self) -> Correlation {
        self.correlation
    }

    /// `mu = E[x]`.
    pub fn mu(&self) -> &OVector<f64, D> {
        &self.mu
    }

    /// The correlation parameter `P`.
    pub fn p(&self) -> &OMatrix<f64, D, U3> {
        &self.p
    }

    /// The parameter `Sigma`; [`covariance`](MfgMoments::covariance) of `x` only to leading
    /// order.
    pub fn sigma(&self) -> OMatrix<f64, D, D> {
        self.conditional_covariance() + scaled_outer(&self.p, &tangent_information(&self.attitude))
    }

    /// `Sigma_c`, the covariance of `x` given `R` (3.4).
    pub fn conditional_covariance(&self) -> OMatrix<f64, D, D> {
        let l = self.conditional_factor();
        &l * l.transpose()
    }

    /// The Cholesky factor `L` of `Sigma_c = L L^T`.
    pub fn conditional_factor(&self) -> OMatrix<f64, D, D> {
        self.conditional.l()
    }

    /// `v_R` (3.3).
    pub fn deviation(&self, r: &Rotation3<f64>) -> Vector3<f64> {
        self.correlation.deviation(&self.attitude.centred(r), &self.attitude.svd().s)
    }

    /// The 3x9 matrix `L` with `v_R = L vec R`, columns stacked.
    pub fn regression(&self) -> SMatrix<f64, 3, 9> {
        self.correlation.regression(&self.attitude)
    }

    /// `E[x | R] = mu + P v_R` (3.2).
    pub fn conditional_mean(&self, r: &Rotation3<f64>) -> OVector<f64, D> {
        &self.mu + &self.p * self.deviation(r)
    }

    /// Logarithm of the density (3.1) with respect to the normalized Haar and Lebesgue measures.
    pub fn log_density(&self, r: &Rotation3<f64>, x: &OVector<f64, D>) -> f64 {
        let y = self.whiten(x - self.conditional_mean(r));
        let l = self.conditional.l_dirty();
        let log_det: f64 = (0..l.nrows()).map(|i| l[(i, i)].ln()).sum();
        let dimension = self.mu.len() as f64;
        self.attitude.log_density(r)
            - 0.5 * y.norm_squared()
            - log_det
            - 0.5 * dimension * std::f64::consts::TAU.ln()
    }

    /// The approximate distribution of `R` given `x`, for `x` near its mean (3.9, 3.10): the
    /// marginal turned about the axis `v(x)` in the frame of the correlation.
    ///
    /// The paper drops the term quadratic in `P v_R`, which holds only for weak correlation. It
    /// is kept here to the order of theorem 3.4: `v(x) = P^T Sigma^-1 (x - mu)`, and the
    /// information about the attitude grows from `A = tr(S) I - S` to
    /// `A + A P^T Sigma_c^-1 P A`.
    pub fn attitude_given(&self, x: &OVector<f64, D>) -> Result<MatrixFisher, MfgError> {
        let ProperSvd { u, v, .. } = *self.attitude.svd();
        let tangent = tangent_information(&self.attitude);
        let slope = scale_columns(&self.p, &tangent);
        let mut weighted_slope = slope.clone();
        self.conditional.solve_mut(&mut weighted_slope);
        let gain = slope.transpose() * weighted_slope;
        let mut residual = x - &self.mu;
        self.conditional.solve_mut(&mut residual);
        let posterior = TangentPosterior::new(&tangent, &gain, &(slope.transpose() * residual))?;
        let f = match self.correlation {
            Correlation::World => u.matrix() * posterior.turn * posterior.concentration,
            Correlation::Body => u.matrix() * posterior.concentration * posterior.turn,
        };
        Ok(MatrixFisher::new(&(f * v.matrix().transpose()))?)
    }

    /// The canonical variables `(Q, y) ~ MG(0, I, 0, I, S, I)` of `(R, x)` (lemma 4.4), with the
    /// Cholesky factor of `Sigma_c` as its root.
    pub fn to_canonical(
        &self,
        r: &Rotation3<f64>,
        x: &OVector<f64, D>,
    ) -> (Rotation3<f64>, OVector<f64, D>) {
        (self.attitude.centred(r), self.whiten(x - self.conditional_mean(r)))
    }

    /// `(R, x)` of canonical variables `(Q, y)`: the inverse of
    /// [`to_canonical`](Self::to_canonical).
    pub fn from_canonical(
        &self,
        q: &Rotation3<f64>,
        y: &OVector<f64, D>,
    ) -> (Rotation3<f64>, OVector<f64, D>) {
        let ProperSvd { u, s, v } = self.attitude.svd();
        let mean = &self.mu + &self.p * self.correlation.deviation(q, s);
        (u * q * v.inverse(), mean + self.conditional.l() * y)
    }

    /// The moments of theorem 3.5.
    pub fn moments(&self) -> MfgMoments<D> {
        let deviation = self.deviation_moments();
        let cross = scale_columns(&self.p, &deviation);
        MfgMoments {
            attitude: self.attitude.mean(),
            mean: self.mu.clone(),
            covariance: self.conditional_covariance() + scaled_outer(&self.p, &deviation),
            cross,
            deviation,
        }
    }

    /// The diagonal of `E[v_R v_R^T]`, `s_j d_j + s_k d_k` (3.21).
    pub fn deviation_moments(&self) -> Vector3<f64> {
        let (s, d) = (self.attitude.svd().s, self.attitude.moments().first());
        let products = s.component_mul(&d);
        Vector3::from_fn(|i, _| products[(i + 1) % 3] + products[(i + 2) % 3])
    }

    /// Fisher information of each concentration `s_i`, `Sigma_c` being given: what the attitude
    /// alone holds, and what `x` adds to it given the attitude. The estimate of the attitude from
    /// `E[R]` gives the second part away; their ratio is (3.31) where `S = s I`.
    ///
    /// ```
    /// # use mfg_vio::distribution::matrix_fisher::MatrixFisher;
    /// # use mfg_vio::distribution::matrix_fisher_gaussian::{Correlation, MatrixFisherGaussian};
    /// # use nalgebra::{Matrix1, Matrix1x3, Matrix3, Vector1};
    /// let attitude = MatrixFisher::new(&Matrix3::from_diagonal_element(10.0))?;
    /// let (mu, sigma) = (Vector1::new(0.0), Matrix1::new(1.0));
    /// let p = Matrix1x3::new(0.02, 0.02, 0.02);
    /// let belief = MatrixFisherGaussian::new(attitude, mu, sigma, p, Correlation::Body)?;
    /// let [marginal, conditional] = belief.concentration_information();
    /// // A correlation coefficient of 0.09 is worth less than two parts in a hundred.
    /// assert!(conditional[0] < 0.02 * marginal[0]);
    /// # Ok::<(), mfg_vio::distribution::matrix_fisher_gaussian::MfgError>(())
    /// ```
    pub fn concentration_information(&self) -> [Vector3<f64>; 2] {
        let moments = self.attitude.moments();
        // P^T Sigma_c^-1 P.
        let mut weighted = self.p.clone();
        self.conditional.solve_mut(&mut weighted);
        let gain = self.p.transpose() * weighted;
        // Component i of v_R is s_j Q_kj - s_k Q_jk, or s_k Q_kj - s_j Q_jk in the body frame: s_i
        // moves the other two, by entries whose product vanishes on average.
        let square = |row: usize, column: usize| moments.second((row, column), (row, column));
        let conditional = Vector3::from_fn(|i, _| {
            let (j, k) = ((i + 1) % 3, (i + 2) % 3);
            gain[(j, j)] * square(k, i) + gain[(k, k)] * square(j, i)
        });
        [moments.diagonal_covariance().diagonal(), conditional]
    }

    /// The distribution of `(R, x + x')` for an independent `x' ~ N(mu', Sigma')` (theorem 4.8).
    pub fn add_independent(
        &self,
        mean: &OVector<f64, D>,
        covariance: &OMatrix<f64, D, D>,
    ) -> Result<Self, MfgError> {
        Self::from_conditional(
            self.attitude,
            &self.mu + mean,
            self.conditional_covariance() + covariance,
            self.p.clone(),
            self.correlation,
        )
    }

    /// The distribution of `(R, A x + b)`, exactly; `A` must keep `Sigma_c` positive definite.
    ///
    /// With rows of the identity in `A` it is the marginal distribution of the attitude and the
    /// components that they select.
    pub fn affine<E: Dim>(
        &self,
        a: &OMatrix<f64, E, D>,
        b: &OVector<f64, E>,
    ) -> Result<MatrixFisherGaussian<E>, MfgError>
    where
        DefaultAllocator: Allocator<E>
            + Allocator<E, E>
            + Allocator<E, D>
            + Allocator<D, E>
            + Allocator<E, U3>
            + Allocator<U3, E>
            + Allocator<U1, E>,
    {
        MatrixFisherGaussian::<E>::from_conditional(
            self.attitude,
            a * &self.mu + b,
            a * self.conditional_covariance() * a.transpose(),
            a * &self.p,
            self.correlation,
        )
    }

    /// Whether both are the same distribution (lemma 3.1): the same `F`, the same conditional
    /// mean for every `R` and the same conditional covariance, entries compared relative to the
    /// largest of each matrix.
    pub fn is_equivalent(&self, other: &Self, tolerance: f64) -> bool {
        let close = |a: &[f64], b: &[f64]| {
            let scale = a.iter().chain(b).fold(0.0, |m: f64, x| m.max(x.abs()));
            a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() <= tolerance * scale)
        };
        let slope = |m: &Self| {
            let mut slope = Vec::with_capacity(9 * m.mu.len());
            for column in m.regression().column_iter() {
                slope.extend((&m.p * column).iter());
            }
            slope
        };
        close(self.attitude.parameter().as_slice(), other.attitude.parameter().as_slice())
            && close(self.mu.as_slice(), other.mu.as_slice())
            && close(&slope(self), &slope(other))
            && close(
                self.conditional_covariance().as_slice(),
                other.conditional_covariance().as_slice(),
            )
    }

    /// The equivalent parameters whose principal axes are `svd`, another proper decomposition of
    /// the same `F` (theorems 3.1 and C.1).
    ///
    /// `P` is carried over by its regression on `vec R`, which needs no case distinction:
    /// `P' = P L L'^T (L' L'^T)^-1`, columns without influence (`s_j = s_k = 0`) being zero.
    pub fn with_axes(&self, svd: ProperSvd) -> Result<Self, MfgError> {
        let attitude = MatrixFisher::from_svd(svd).map_err(MatrixFisherError::from)?;
        let target = Self { attitude, ..self.clone() };
        let regression = target.regression();
        let gram = regression * regression.transpose();
        let projection = self.regression() * regression.transpose();
        let p = scale_columns(
            &(&self.p * projection),
            &Vector3::from_fn(|i, _| if gram[(i, i)] > 0.0 { 1.0 / gram[(i, i)] } else { 0.0 }),
        );
        Self::from_conditional(
            attitude,
            self.mu.clone(),
            self.conditional_covariance(),
            p,
            self.correlation,
        )
    }

    /// The representative of its equivalence class with the axes of
    /// [`canonical_axes`](super::matrix_fisher::canonical_axes).
    pub fn canonical_representative(&self) -> Result<Self, MfgError> {
        self.with_axes(super::matrix_fisher::canonical_axes(self.attitude.svd()))
    }

    /// A sampler, prepared once for many draws.
    pub fn sampler(&self) -> MfgSampler<'_, D> {
        MfgSampler { belief: self, attitude: self.attitude.sampler() }
    }

    /// `L^-1 y` for the Cholesky factor `L` of `Sigma_c`.
    fn whiten(&self, mut y: OVector<f64, D>) -> OVector<f64, D> {
        // The diagonal of a Cholesky factor is positive: the substitution cannot fail.
        self.conditional.l_dirty().solve_lower_triangular_mut(&mut y);
        y
    }
}

/// Exact sampler of a matrix Fisher-Gaussian distribution.
///
/// ```
/// # use mfg_vio::distribution::matrix_fisher::MatrixFisher;
/// # use mfg_vio::distribution::matrix_fisher_gaussian::{Correlation, MatrixFisherGaussian};
/// # use nalgebra::{Matrix3, Vector3};
/// # use rand::{SeedableRng, distr::Distribution};
/// let attitude = MatrixFisher::new(&Matrix3::from_diagonal_element(10.0))?;
/// let (mu, sigma) = (Vector3::new(1.0, 2.0, 3.0), Matrix3::identity());
/// let p = Matrix3::from_diagonal_element(0.1);
/// let belief = MatrixFisherGaussian::new(attitude, mu, sigma, p, Correlation::World)?;
/// let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
/// let samples = belief.sampler().sample_iter(&mut rng).take(1000);
/// let mean = samples.map(|(_, x)| x).sum::<Vector3<f64>>() / 1000.0;
/// assert!((mean - mu).norm() < 0.1);
/// # Ok::<(), mfg_vio::distribution::matrix_fisher_gaussian::MfgError>(())
/// ```
#[derive(Debug, Clone)]
pub struct MfgSampler<'a, D: Dim>
where
    DefaultAllocator: Allocator<D> + Allocator<D, D> + Allocator<D, U3>,
{
    belief: &'a MatrixFisherGaussian<D>,
    attitude: MatrixFisherSampler,
}

impl<D: Dim> Distribution<(Rotation3<f64>, OVector<f64, D>)> for MfgSampler<'_, D>
where
    DefaultAllocator:
        Allocator<D> + Allocator<D, D> + Allocator<D, U3> + Allocator<U3, D> + Allocator<U1, D>,
{
    fn sample<R: Rng + ?Sized>(&self, rng: &mut R) -> (Rotation3<f64>, OVector<f64, D>) {
        let r = self.attitude.sample(rng);
        let mean = self.belief.conditional_mean(&r);
        let normal = mean.map(|_| StandardNormal.sample(rng));
        (r, mean + self.belief.conditional.l() * normal)
    }
}

/// What a measurement of `x` makes of the attitude in the tangent space of principal axes.
struct TangentPosterior {
    turn: Matrix3<f64>,
    /// `tr(H)/2 I - H` of the posterior information `H`.
    concentration: Matrix3<f64>,
}

impl TangentPosterior {
    /// Solves `(A + G) v = g`, which is `v = P^T Sigma^-1 (x - mu)` without `A^-1`.
    fn new(
        tangent: &Vector3<f64>,
        gain: &Matrix3<f64>,
        gradient: &Vector3<f64>,
    ) -> Result<Self, MfgError> {
        let information = gain + Matrix3::from_diagonal(tangent);
        let factor = information.cholesky().ok_or(MfgError::RotationCovariance)?;
        let half_trace = Matrix3::from_diagonal_element(0.5 * information.trace());
        Ok(Self {
            turn: exp(&factor.solve(gradient)).into_inner(),
            concentration: half_trace - information,
        })
    }
}

/// The diagonal of `tr(S) I - S`.
fn tangent_information(attitude: &MatrixFisher) -> Vector3<f64> {
    Vector3::from(sums_of_singular_values(&attitude.svd().s))
}

/// `P diag(w) P^T`.
fn scaled_outer<D: Dim>(p: &OMatrix<f64, D, U3>, weights: &Vector3<f64>) -> OMatrix<f64, D, D>
where
    DefaultAllocator: Allocator<D, D> + Allocator<D, U3> + Allocator<U3, D>,
{
    scale_columns(p, weights) * p.transpose()
}

/// `P diag(w)`.
fn scale_columns<D: Dim>(p: &OMatrix<f64, D, U3>, weights: &Vector3<f64>) -> OMatrix<f64, D, U3>
where
    DefaultAllocator: Allocator<D, U3>,
{
    let mut scaled = p.clone();
    for (mut column, weight) in scaled.column_iter_mut().zip(weights.iter()) {
        column *= *weight;
    }
    scaled
}

fn symmetric<D: Dim>(m: OMatrix<f64, D, D>) -> OMatrix<f64, D, D>
where
    DefaultAllocator: Allocator<D, D>,
{
    (&m + m.transpose()) * 0.5
}

#[cfg(test)]
mod tests;
