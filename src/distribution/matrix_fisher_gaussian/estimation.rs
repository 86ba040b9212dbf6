//! Estimates of matrix Fisher-Gaussian parameters: from samples, from moments, from a Gaussian.

use nalgebra::allocator::Allocator;
use nalgebra::{DefaultAllocator, Dim, Matrix3, OMatrix, OVector, Rotation3, U1, U3, Vector3};

use super::{
    Correlation, MatrixFisherGaussian, MfgError, scale_columns, symmetric, tangent_information,
};
use crate::distribution::matrix_fisher::MatrixFisher;
use crate::so3::{ProperSvd, proper_svd};

/// Moments that determine the conditional part once the attitude's distribution is known
/// (3.24-3.26).
///
/// ```
/// # use mfg_vio::distribution::matrix_fisher::MatrixFisher;
/// # use mfg_vio::distribution::matrix_fisher_gaussian::{
/// #     ConditionalMoments, Correlation, MatrixFisherGaussian,
/// # };
/// # use nalgebra::{Matrix1, Matrix1x3, Matrix3, Vector1, Vector3};
/// // As a filter has them after a step: moments of a bias and its correlation with the attitude.
/// let attitude = MatrixFisher::new(&Matrix3::from_diagonal_element(10.0))?;
/// let moments = ConditionalMoments {
///     mean: Vector1::new(0.5),
///     deviation_mean: Vector3::zeros(),
///     covariance: Matrix1::new(1.0),
///     cross: Matrix1x3::new(1.7, 0.0, 0.0),
///     deviation_covariance: Matrix3::from_diagonal_element(19.0),
/// };
/// let belief = MatrixFisherGaussian::from_moments(attitude, Correlation::Body, &moments)?;
/// assert!((belief.p()[0] - 1.7 / 19.0).abs() < 1e-15);
/// # Ok::<(), mfg_vio::distribution::matrix_fisher_gaussian::MfgError>(())
/// ```
#[derive(Debug, Clone)]
pub struct ConditionalMoments<D: Dim>
where
    DefaultAllocator: Allocator<D> + Allocator<D, D> + Allocator<D, U3>,
{
    /// `E[x]`.
    pub mean: OVector<f64, D>,
    /// `E[v_R]`.
    pub deviation_mean: Vector3<f64>,
    /// `Cov[x]`.
    pub covariance: OMatrix<f64, D, D>,
    /// `Cov[x, v_R]`.
    pub cross: OMatrix<f64, D, U3>,
    /// `Cov[v_R]`.
    pub deviation_covariance: Matrix3<f64>,
}

/// A sample of the attitude and the vector with its weight.
///
/// ```
/// # use mfg_vio::distribution::matrix_fisher_gaussian::{
/// #     Correlation, MatrixFisherGaussian, MfgError, WeightedSample,
/// # };
/// # use mfg_vio::so3::exp;
/// # use nalgebra::{Const, Vector1, Vector3};
/// // x follows rotations about the first axis; rotations about the others are unrelated to it.
/// let turns = [0.2, -0.2].into_iter().flat_map(|angle| {
///     (0..3).map(move |axis| WeightedSample {
///         weight: 1.0,
///         attitude: exp(&Vector3::ith(axis, angle)),
///         x: Vector1::new([5.0 * angle, 0.1, -0.1][axis]),
///     })
/// });
/// let samples: Vec<WeightedSample<Const<1>>> = turns.collect();
/// let belief = MatrixFisherGaussian::from_samples(&samples, Correlation::Body)?;
/// let x = |axis| belief.conditional_mean(&exp(&Vector3::ith(axis, 0.2)))[0];
/// assert!((x(0) - 1.0).abs() < 0.01 && x(1) < 0.11);
/// # Ok::<(), MfgError>(())
/// ```
#[derive(Debug, Clone)]
pub struct WeightedSample<D: Dim>
where
    DefaultAllocator: Allocator<D>,
{
    pub weight: f64,
    pub attitude: Rotation3<f64>,
    pub x: OVector<f64, D>,
}

/// The Gaussian of `x` and the body-frame rotation vector `e` of `mode exp(e^)`, in which a
/// concentrated matrix Fisher-Gaussian distribution ends (3.15).
///
/// ```
/// # use mfg_vio::distribution::matrix_fisher_gaussian::{
/// #     Correlation, MatrixFisherGaussian, MfgError, TangentGaussian,
/// # };
/// # use nalgebra::{Matrix1, Matrix1x3, Matrix3, Rotation3, Vector1};
/// // What an error-state Kalman filter holds, as a distribution on the group and back.
/// let gaussian = TangentGaussian {
///     mode: Rotation3::identity(),
///     mean: Vector1::new(0.0),
///     covariance: Matrix1::new(1.0),
///     cross: Matrix1x3::new(0.0, 0.002, 0.0),
///     rotation: Matrix3::from_diagonal_element(1e-4),
/// };
/// let belief = MatrixFisherGaussian::from_gaussian(&gaussian, Correlation::World)?;
/// let back = belief.to_gaussian()?;
/// assert!((back.cross - gaussian.cross).norm() < 1e-15);
/// assert!((back.rotation - gaussian.rotation).norm() < 1e-15);
/// # Ok::<(), MfgError>(())
/// ```
#[derive(Debug, Clone)]
pub struct TangentGaussian<D: Dim>
where
    DefaultAllocator: Allocator<D> + Allocator<D, D> + Allocator<D, U3>,
{
    /// The mode of the attitude.
    pub mode: Rotation3<f64>,
    /// `E[x]`.
    pub mean: OVector<f64, D>,
    /// `Cov[x]`.
    pub covariance: OMatrix<f64, D, D>,
    /// `Cov[x, e]`.
    pub cross: OMatrix<f64, D, U3>,
    /// `Cov[e]`, rad^2.
    pub rotation: Matrix3<f64>,
}

impl<D: Dim> MatrixFisherGaussian<D>
where
    DefaultAllocator:
        Allocator<D> + Allocator<D, D> + Allocator<D, U3> + Allocator<U3, D> + Allocator<U1, D>,
{
    /// The conditional MLE (theorem 3.6) for a given attitude distribution; `v_R` of the moments
    /// must be that of `attitude` and `correlation`.
    ///
    /// Directions of `v_R` without variance, those of an attitude distribution that does not
    /// depend on them, get no correlation.
    pub fn from_moments(
        attitude: MatrixFisher,
        correlation: Correlation,
        moments: &ConditionalMoments<D>,
    ) -> Result<Self, MfgError> {
        let p = regress(&moments.cross, &moments.deviation_covariance)?;
        let mu = &moments.mean - &p * moments.deviation_mean;
        let conditional = &moments.covariance - &p * moments.cross.transpose();
        Self::from_conditional(attitude, mu, symmetric(conditional), p, correlation)
    }

    /// The marginal-conditional MLE from weighted samples: the attitude from their mean `E[R]`,
    /// then theorem 3.6.
    pub fn from_samples(
        samples: &[WeightedSample<D>],
        correlation: Correlation,
    ) -> Result<Self, MfgError> {
        let mean = mean_rotation(samples.iter().map(|s| (s.weight, s.attitude)))?;
        Self::from_samples_about(MatrixFisher::from_mean(&mean)?, samples, correlation)
    }

    /// The same where the samples are sigma points of a belief that have moved a step on: its
    /// concentrations are sought from those of `before`.
    pub fn from_sigma_points(
        points: &[WeightedSample<D>],
        before: &Self,
    ) -> Result<Self, MfgError> {
        let mean = mean_rotation(points.iter().map(|s| (s.weight, s.attitude)))?;
        let attitude = MatrixFisher::from_mean_near(&mean, before.attitude())?;
        Self::from_samples_about(attitude, points, before.correlation())
    }

    /// Theorem 3.6 for samples whose mean `E[R]` is that of `attitude`.
    fn from_samples_about(
        attitude: MatrixFisher,
        samples: &[WeightedSample<D>],
        correlation: Correlation,
    ) -> Result<Self, MfgError> {
        let first = samples.first().ok_or(MfgError::NoSamples)?;
        let total: f64 = samples.iter().map(|s| s.weight).sum();
        let mut moments = ConditionalMoments {
            mean: &first.x * 0.0,
            // Linear in the mean of Q, which is diagonal.
            deviation_mean: Vector3::zeros(),
            covariance: &first.x * first.x.transpose() * 0.0,
            cross: &first.x * Vector3::zeros().transpose(),
            deviation_covariance: Matrix3::zeros(),
        };
        for sample in samples {
            let weight = sample.weight / total;
            moments.mean += &sample.x * weight;
        }
        for sample in samples {
            let weight = sample.weight / total;
            let x = &sample.x - &moments.mean;
            let v = correlation.deviation(&attitude.centred(&sample.attitude), &attitude.svd().s);
            moments.covariance += &x * x.transpose() * weight;
            moments.cross += &x * v.transpose() * weight;
            moments.deviation_covariance += v * v.transpose() * weight;
        }
        Self::from_moments(attitude, correlation, &moments)
    }

    /// The distribution that a concentrated Gaussian approximates (theorem 3.4 read backwards,
    /// with FNF 31 for the attitude).
    pub fn from_gaussian(
        gaussian: &TangentGaussian<D>,
        correlation: Correlation,
    ) -> Result<Self, MfgError> {
        let factor = gaussian.rotation.cholesky().ok_or(MfgError::RotationCovariance)?;
        let attitude = MatrixFisher::from_mode_and_information(gaussian.mode, factor.inverse())?;
        let p = &gaussian.cross * attitude.svd().v.matrix();
        Self::new(attitude, gaussian.mean.clone(), gaussian.covariance.clone(), p, correlation)
    }

    /// The Gaussian that approximates a concentrated distribution (3.15); an error unless the
    /// attitude is concentrated about all axes, `s2 + s3 > 0`.
    pub fn to_gaussian(&self) -> Result<TangentGaussian<D>, MfgError> {
        let v = self.attitude().svd().v;
        let factor = self.attitude().information().cholesky();
        Ok(TangentGaussian {
            mode: self.attitude().mode(),
            mean: self.mu().clone(),
            covariance: self.sigma(),
            cross: self.p() * v.matrix().transpose(),
            rotation: factor.ok_or(MfgError::RotationCovariance)?.inverse(),
        })
    }

    /// The moments of the conditional part that [`from_moments`](Self::from_moments) inverts.
    pub fn conditional_moments(&self) -> ConditionalMoments<D> {
        let moments = self.moments();
        ConditionalMoments {
            mean: moments.mean,
            deviation_mean: Vector3::zeros(),
            covariance: moments.covariance,
            cross: moments.cross,
            deviation_covariance: diagonal(&moments.deviation),
        }
    }

    /// Diagonal of `tr(S) I - S`: the inverse covariance of the rotation vector in principal
    /// axes.
    pub fn tangent_information(&self) -> Vector3<f64> {
        tangent_information(self.attitude())
    }
}

/// `E[R]` of weighted attitudes.
fn mean_rotation(
    samples: impl Iterator<Item = (f64, Rotation3<f64>)>,
) -> Result<Matrix3<f64>, MfgError> {
    let (mut total, mut sum) = (0.0, Matrix3::zeros());
    for (weight, attitude) in samples {
        total += weight;
        sum += attitude.matrix() * weight;
    }
    if total > 0.0 { Ok(sum / total) } else { Err(MfgError::NoSamples) }
}

fn diagonal(v: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::from_diagonal(v)
}

/// Singular values of a correlation matrix below this count as zero.
const SINGULAR: f64 = 1e-12;

/// `cross covariance^-1`, with the covariance scaled to unit diagonal: its entries may differ by
/// the square of the ratio of concentrations.
fn regress<D: Dim>(
    cross: &OMatrix<f64, D, U3>,
    covariance: &Matrix3<f64>,
) -> Result<OMatrix<f64, D, U3>, MfgError>
where
    DefaultAllocator: Allocator<D, U3>,
{
    let scale = inverse_deviations(covariance);
    let inverse = correlation_inverse(covariance, &diagonal(&scale))?;
    Ok(scale_columns(&(scale_columns(cross, &scale) * inverse), &scale))
}

fn inverse_deviations(covariance: &Matrix3<f64>) -> Vector3<f64> {
    covariance.diagonal().map(|v| if v > 0.0 { v.sqrt().recip() } else { 0.0 })
}

fn correlation_inverse(
    covariance: &Matrix3<f64>,
    scaling: &Matrix3<f64>,
) -> Result<Matrix3<f64>, MfgError> {
    let svd = proper_svd(&(scaling * covariance * scaling))
        .map_err(|_| MfgError::NotFinite("Cov[v_R]"))?;
    let inverse = svd.s.map(|s| if s.abs() > SINGULAR { s.recip() } else { 0.0 });
    Ok(ProperSvd { u: svd.v, s: inverse, v: svd.u }.matrix())
}
