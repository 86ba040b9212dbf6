//! Bayes' rule for a Gaussian and a measurement that is linear in its error: the update of every
//! extended Kalman filter of this module.

use nalgebra::allocator::Allocator;
use nalgebra::{DefaultAllocator, Dim, OMatrix, OVector};

use super::core::FilterError;
use crate::distribution::regression::keep_rounding;

/// A measurement `z = h(x) + noise`, linearised at the estimate: `residual = jacobian e + noise`
/// with the errors `e` that start at row `first` of the state; all others have no part in it.
#[derive(Debug, Clone, PartialEq)]
pub struct LinearMeasurement<M: Dim, K: Dim>
where
    DefaultAllocator: Allocator<M> + Allocator<M, K> + Allocator<M, M>,
{
    /// `z - h(estimate)`, of length m.
    pub residual: OVector<f64, M>,
    /// m x k.
    pub jacobian: OMatrix<f64, M, K>,
    pub first: usize,
    /// Covariance of the noise, m x m.
    pub noise: OMatrix<f64, M, M>,
}

/// What is learned of a state by a measurement.
#[derive(Debug, Clone, PartialEq)]
pub struct Correction<N: Dim, M: Dim>
where
    DefaultAllocator: Allocator<N> + Allocator<N, M>,
{
    /// To be added to the mean of the error, of length n.
    pub change: OVector<f64, N>,
    /// `W` (n x m), where the covariance becomes `P - W W^T`.
    pub gain_root: OMatrix<f64, N, M>,
}

impl<M: Dim, K: Dim> LinearMeasurement<M, K>
where
    DefaultAllocator: Allocator<M>
        + Allocator<M, K>
        + Allocator<K, M>
        + Allocator<M, M>
        + Allocator<nalgebra::Const<1>, M>,
{
    /// Bayes' rule against an error of this covariance (n x n): with `S = H P H^T + R = L L^T` and
    /// `W = P H^T L^-T` the change is `W L^-1 r`. `O(n m (k + m))`.
    pub fn condition<N: Dim>(
        &self,
        covariance: &OMatrix<f64, N, N>,
    ) -> Result<Correction<N, M>, FilterError>
    where
        DefaultAllocator:
            Allocator<N> + Allocator<N, N> + Allocator<N, M> + Allocator<M, N> + Allocator<K, M>,
    {
        let k = self.jacobian.shape_generic().1;
        let by_state = self.jacobian.transpose();
        let by_measurement = covariance.columns_generic(self.first, k) * &by_state;
        let innovation = &self.jacobian * by_measurement.rows_generic(self.first, k) + &self.noise;
        let not_positive = FilterError::NotPositive("innovation covariance");
        let root = innovation.cholesky().ok_or(not_positive)?.unpack();
        let whitened = root.solve_lower_triangular(&self.residual).ok_or(not_positive)?;
        let gain_root =
            root.solve_lower_triangular(&by_measurement.transpose()).ok_or(not_positive)?;
        let gain_root = gain_root.transpose();
        let change = &gain_root * whitened;
        if !change.iter().chain(gain_root.iter()).all(|x| x.is_finite()) {
            return Err(FilterError::NotFinite("correction"));
        }
        Ok(Correction { change, gain_root })
    }
}

impl<N: Dim, M: Dim> Correction<N, M>
where
    DefaultAllocator: Allocator<N> + Allocator<N, N> + Allocator<N, M> + Allocator<M, N>,
{
    /// Subtracts what was learned from the covariance that it was learned against. What rounding may
    /// take away with it stays: a variance that was known to nothing may be known to a fraction of it
    /// afterwards, and must not become negative.
    pub fn reduce(&self, covariance: &mut OMatrix<f64, N, N>) {
        keep_rounding(covariance);
        covariance.gemm(-1.0, &self.gain_root, &self.gain_root.transpose(), 1.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;
    use nalgebra::{DMatrix, DVector, Matrix1, Vector1};
    use proptest::prelude::*;

    fn matrix(rows: usize, columns: usize) -> impl Strategy<Value = DMatrix<f64>> {
        proptest::collection::vec(-1.0..1.0f64, rows * columns)
            .prop_map(move |values| DMatrix::from_vec(rows, columns, values))
    }

    proptest! {
        /// Against the information form, `P+^-1 = P^-1 + H^T R^-1 H`, which shares no step with it.
        #[test]
        fn information_adds_up(
            root in matrix(6, 6), jacobian in matrix(2, 3), noise in matrix(2, 2),
            residual in proptest::collection::vec(-1.0..1.0f64, 2), first in 0usize..4,
        ) {
            let covariance = &root * root.transpose() + DMatrix::identity(6, 6) * 0.1;
            let noise = &noise * noise.transpose() + DMatrix::identity(2, 2) * 0.1;
            let residual = DVector::from_vec(residual);
            let measurement = LinearMeasurement { residual, jacobian, first, noise };
            let correction = measurement.condition(&covariance).unwrap();
            let mut posterior = covariance.clone();
            correction.reduce(&mut posterior);

            let mut whole = DMatrix::zeros(2, 6);
            whole.columns_mut(first, 3).copy_from(&measurement.jacobian);
            let weight = measurement.noise.clone().try_inverse().unwrap();
            let information = covariance.clone().try_inverse().unwrap()
                + whole.transpose() * &weight * &whole;
            let expected = information.try_inverse().unwrap();
            assert_relative_eq!(posterior, expected, epsilon = 1e-9);
            let change = &expected * whole.transpose() * weight * &measurement.residual;
            assert_relative_eq!(correction.change, change, epsilon = 1e-9);
        }
    }

    #[test]
    fn what_is_not_positive_or_not_finite_is_refused() {
        let refused = |noise: f64, residual: f64| {
            let (residual, noise) = (Vector1::new(residual), Matrix1::new(noise));
            let jacobian = Matrix1::new(1.0);
            let measurement = LinearMeasurement { residual, jacobian, first: 0, noise };
            measurement.condition(&Matrix1::new(1.0)).unwrap_err()
        };
        assert_eq!(refused(-2.0, 1.0), FilterError::NotPositive("innovation covariance"));
        assert_eq!(refused(1.0, f64::NAN), FilterError::NotFinite("correction"));
    }
}
