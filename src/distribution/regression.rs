//! Beliefs over SO(3) x R^n that keep the whole regression of the vector on the attitude.
//!
//! `log p(R) = f^T r - r^T G r / 2 + const`, `x | R ~ N(a + B r, Sigma)`, `r = vec R`. A matrix
//! Fisher-Gaussian distribution is of this form with `G = 0` and `B = P L` (three columns times
//! the regression of `v_R`). Measurements that are linear in `(r, x)` keep the form exactly; the
//! projection of `B` on `v_R` (W22 theorem 3.6) is needed only where an MFG is asked for.

use nalgebra::allocator::Allocator;
use nalgebra::{Const, DefaultAllocator, Dim, Matrix3, OMatrix, SMatrix, SVector, Vector3};

use super::matrix_fisher::MatrixFisher;
use super::matrix_fisher_gaussian::{
    ConditionalMoments, Correlation, MatrixFisherGaussian, MfgError,
};
use super::rotation_quadratic::{RotationMoments, RotationQuadratic};

/// A density of `(R, x)`, see the module.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RotationRegression<const N: usize> {
    /// The marginal density of `R`.
    pub attitude: RotationQuadratic,
    /// `a`.
    pub offset: SVector<f64, N>,
    /// `B`.
    pub slope: SMatrix<f64, N, 9>,
    /// `Cov[x | R]`.
    pub covariance: SMatrix<f64, N, N>,
}

/// A measurement of three consecutive components of `x`, linear in `r`, and of `r` itself:
/// `-2 log L = y^T information y - 2 vector^T y`, `y = (r, x[first..first + 3])`.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct JointInformation {
    pub rr: SMatrix<f64, 9, 9>,
    pub rx: SMatrix<f64, 9, 3>,
    pub xx: Matrix3<f64>,
    pub eta_r: SVector<f64, 9>,
    pub eta_x: Vector3<f64>,
}

impl<const N: usize> RotationRegression<N> {
    /// An attitude and a vector that is independent of it.
    pub fn independent(
        attitude: &MatrixFisher,
        mean: SVector<f64, N>,
        covariance: SMatrix<f64, N, N>,
    ) -> Self {
        Self {
            attitude: RotationQuadratic::matrix_fisher(&attitude.parameter()),
            offset: mean,
            slope: SMatrix::zeros(),
            covariance,
        }
    }

    /// `E[x]`, `Cov[x]` and `Cov[x, r]` for the moments of `r`.
    pub fn vector_moments(
        &self,
        rotation: &RotationMoments,
    ) -> (SVector<f64, N>, SMatrix<f64, N, N>, SMatrix<f64, N, 9>) {
        let cross = self.slope * rotation.covariance;
        let covariance = self.covariance + cross * self.slope.transpose();
        (self.offset + self.slope * rotation.mean, covariance, cross)
    }

    /// Mean and covariance of `R p + x[first..first + 3]`: with the position there, those of a
    /// point fixed in the body (5.84, 5.85).
    pub fn point_moments(
        &self,
        rotation: &RotationMoments,
        first: usize,
        in_body: &Vector3<f64>,
    ) -> (Vector3<f64>, Matrix3<f64>) {
        let mut by_rotation = self.slope.fixed_rows::<3>(first).into_owned();
        for column in 0..3 {
            for axis in 0..3 {
                by_rotation[(axis, 3 * column + axis)] += in_body[column];
            }
        }
        let mean = self.offset.fixed_rows::<3>(first) + by_rotation * rotation.mean;
        let covariance = by_rotation * rotation.covariance * by_rotation.transpose()
            + self.covariance.fixed_view::<3, 3>(first, first);
        (mean, covariance)
    }

    /// Bayes' rule with a measurement of `r` and `x[first..first + 3]`, exactly. `None` unless
    /// its information about those components is positive definite.
    pub fn conditioned(mut self, first: usize, measured: &JointInformation) -> Option<Self> {
        // Given R, the measurement is `by_offset + by_rotation r` with covariance `spread`.
        let spread = measured.xx.cholesky()?.inverse();
        let by_offset = spread * measured.eta_x;
        let by_rotation = -(spread * measured.rx.transpose());

        let columns = self.covariance.fixed_columns::<3>(first).into_owned();
        let prior = self.covariance.fixed_view::<3, 3>(first, first);
        let weight = (prior + spread).cholesky()?.inverse();
        let gain = columns * weight;
        let surprise = by_offset - self.offset.fixed_rows::<3>(first);
        let surprise_slope = by_rotation - self.slope.fixed_rows::<3>(first);

        // What the vector could not explain is evidence about R, and so is the part of the
        // measurement that does not depend on the vector.
        let weighted = weight * surprise_slope;
        self.attitude.quadratic +=
            measured.rr + measured.rx * by_rotation + surprise_slope.transpose() * weighted;
        self.attitude.linear +=
            measured.eta_r - measured.rx * by_offset - weighted.transpose() * surprise;
        self.offset += gain * surprise;
        self.slope += gain * surprise_slope;
        keep_rounding(&mut self.covariance);
        self.covariance -= gain * columns.transpose();
        self.covariance = (self.covariance + self.covariance.transpose()) * 0.5;
        Some(self)
    }

    /// The matrix Fisher-Gaussian distribution with the same mean attitude and the conditional
    /// moments of theorem 3.6.
    pub fn to_mfg(
        &self,
        rotation: &RotationMoments,
        correlation: Correlation,
    ) -> Result<MatrixFisherGaussian<Const<N>>, MfgError> {
        let attitude = MatrixFisher::from_mean(&rotation.mean_rotation())?;
        let deviation = correlation.regression(&attitude);
        let (mean, covariance, cross) = self.vector_moments(rotation);
        let moments = ConditionalMoments {
            mean,
            deviation_mean: deviation * rotation.mean,
            covariance,
            cross: cross * deviation.transpose(),
            deviation_covariance: deviation * rotation.covariance * deviation.transpose(),
        };
        MatrixFisherGaussian::from_moments(attitude, correlation, &moments)
    }
}

/// Adds to the variances of a covariance from which some is about to be subtracted what the
/// subtraction may be wrong by: `n` machine epsilons of each, since `|P_ij| <= sqrt(P_ii P_jj)`.
pub fn keep_rounding<N: Dim>(covariance: &mut OMatrix<f64, N, N>)
where
    DefaultAllocator: Allocator<N, N>,
{
    let factor = 1.0 + covariance.nrows() as f64 * f64::EPSILON;
    for k in 0..covariance.nrows() {
        covariance[(k, k)] *= factor;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::distribution::rotation_quadratic::vectorize;
    use approx::assert_relative_eq;
    use nalgebra::Rotation3;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    type Belief = RotationRegression<4>;

    fn random<const R: usize, const C: usize>(rng: &mut ChaCha8Rng) -> SMatrix<f64, R, C> {
        SMatrix::from_fn(|_, _| rng.random_range(-1.0..1.0))
    }

    fn positive<const R: usize>(rng: &mut ChaCha8Rng) -> SMatrix<f64, R, R> {
        let root: SMatrix<f64, R, R> = random(rng);
        root * root.transpose() + SMatrix::identity() * 0.2
    }

    fn belief(rng: &mut ChaCha8Rng) -> Belief {
        RotationRegression {
            attitude: RotationQuadratic { linear: random(rng), quadratic: positive(rng) },
            offset: random(rng),
            slope: random(rng),
            covariance: positive(rng),
        }
    }

    fn log_density(belief: &Belief, r: &Rotation3<f64>, x: &SVector<f64, 4>) -> f64 {
        let residual = x - belief.offset - belief.slope * vectorize(r.matrix());
        let vector = residual.dot(&belief.covariance.cholesky().unwrap().solve(&residual));
        belief.attitude.log_density(r) - 0.5 * vector
    }

    /// At any attitude and vector, however far from the mode.
    #[test]
    fn conditioning_is_bayes_rule() {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let before = belief(&mut rng);
        let information: SMatrix<f64, 12, 12> = positive(&mut rng);
        let measured = JointInformation {
            rr: information.fixed_view::<9, 9>(0, 0).into_owned(),
            rx: information.fixed_view::<9, 3>(0, 9).into_owned(),
            xx: information.fixed_view::<3, 3>(9, 9).into_owned(),
            eta_r: random(&mut rng),
            eta_x: random(&mut rng),
        };
        let after = before.conditioned(1, &measured).unwrap();
        let mut constant = None;
        for _ in 0..10 {
            let r = Rotation3::new(random::<3, 1>(&mut rng) * 2.0);
            let x: SVector<f64, 4> = random(&mut rng);
            let (v, y) = (vectorize(r.matrix()), x.fixed_rows::<3>(1).into_owned());
            let log_likelihood = measured.eta_r.dot(&v) + measured.eta_x.dot(&y)
                - 0.5 * v.dot(&(measured.rr * v))
                - v.dot(&(measured.rx * y))
                - 0.5 * y.dot(&(measured.xx * y));
            let difference =
                log_density(&after, &r, &x) - log_density(&before, &r, &x) - log_likelihood;
            assert_relative_eq!(difference, *constant.get_or_insert(difference), epsilon = 1e-9);
        }
    }

    /// An MFG survives the way through the regression and back.
    #[test]
    fn an_mfg_is_its_own_projection() {
        let attitude =
            MatrixFisher::new(&Matrix3::new(9.0, 1.0, 0.5, -2.0, 5.0, 0.3, 0.2, 1.0, 3.0));
        let attitude = attitude.unwrap();
        for correlation in [Correlation::World, Correlation::Body] {
            let p = SMatrix::<f64, 2, 3>::new(0.1, 0.02, -0.05, 0.03, 0.08, 0.01);
            let mfg = MatrixFisherGaussian::<Const<2>>::new(
                attitude,
                SVector::<f64, 2>::new(1.0, -2.0),
                SMatrix::identity(),
                p,
                correlation,
            )
            .unwrap();
            let regression = RotationRegression::<2> {
                slope: mfg.p() * mfg.regression(),
                offset: *mfg.mu(),
                ..RotationRegression::independent(
                    &attitude,
                    SVector::zeros(),
                    mfg.conditional_covariance(),
                )
            };
            let moments = regression.attitude.moments().unwrap();
            let back = regression.to_mfg(&moments, correlation).unwrap();
            assert!(back.is_equivalent(&mfg, 1e-8));
        }
    }

    #[test]
    fn point_moments_are_those_of_samples() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let attitude = MatrixFisher::new(&Matrix3::from_diagonal(&Vector3::new(2.0, 1.0, -0.5)));
        let mut belief = belief(&mut rng);
        belief.attitude = RotationQuadratic::matrix_fisher(&attitude.unwrap().parameter());
        let sampler = attitude.unwrap().sampler();
        let root = belief.covariance.cholesky().unwrap().l();
        let point = Vector3::new(0.5, -1.0, 2.0);
        let (mut mean, mut second) = (Vector3::zeros(), Matrix3::zeros());
        let n = 40_000;
        for _ in 0..n {
            use rand_distr::Distribution;
            let r: Rotation3<f64> = sampler.sample(&mut rng);
            let normal =
                SVector::<f64, 4>::from_fn(|_, _| rand_distr::StandardNormal.sample(&mut rng));
            let x = belief.offset + belief.slope * vectorize(r.matrix()) + root * normal;
            let seen = r * point + x.fixed_rows::<3>(1);
            mean += seen / f64::from(n);
            second += seen * seen.transpose() / f64::from(n);
        }
        let moments = belief.attitude.moments().unwrap();
        let (expected, covariance) = belief.point_moments(&moments, 1, &point);
        assert!((mean - expected).norm() < 0.05, "{mean} {expected}");
        let sampled = second - mean * mean.transpose();
        assert!((sampled - covariance).norm() < 0.04 * covariance.norm());
    }
}
