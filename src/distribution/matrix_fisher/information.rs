//! Information measures: Fisher information, observability, entropy, divergence, dispersion.

use nalgebra::{Matrix3, SMatrix, Vector3};

use super::MatrixFisher;
use super::engine::Sums;
use crate::so3::hat;

impl MatrixFisher {
    /// Fisher information of `(U, S, V)`, the 9x9 matrix (4.21); variations are `U u^`, `s`,
    /// `V v^`.
    pub fn fisher_information(&self) -> SMatrix<f64, 9, 9> {
        let (s, d) = (self.svd().s, self.moments().first());
        let product = s.component_mul(&d);
        let diagonal = Matrix3::from_diagonal(&product.map(|p| product.sum() - p));
        let d = Matrix3::from_diagonal(&d);
        let mixed: Matrix3<f64> = (0..3)
            .map(|i| {
                let axis = hat(&Vector3::ith(i, 1.0));
                axis * d * axis * s[i]
            })
            .sum();
        let mut information = SMatrix::<f64, 9, 9>::zeros();
        information.fixed_view_mut::<3, 3>(0, 0).copy_from(&diagonal);
        information.fixed_view_mut::<3, 3>(6, 6).copy_from(&diagonal);
        information.fixed_view_mut::<3, 3>(0, 6).copy_from(&mixed);
        information.fixed_view_mut::<3, 3>(6, 0).copy_from(&mixed);
        let concentration = self.moments().diagonal_covariance();
        information.fixed_view_mut::<3, 3>(3, 3).copy_from(&concentration);
        information
    }

    /// Diagonal of the Fisher information of the mean attitude in principal axes (4.22).
    pub fn mean_attitude_information(&self) -> Vector3<f64> {
        let a = Sums::of_singular_values(&self.svd().s).a;
        self.observability_axes().component_mul(&Vector3::from(a)) * 0.5
    }

    /// Diagonal of `tr(D) I - D` in principal axes: the attitude is stochastically observable if
    /// all are positive (4.23).
    pub fn observability_axes(&self) -> Vector3<f64> {
        let d = self.moments().first();
        Vector3::new(d[1] + d[2], d[0] + d[2], d[0] + d[1])
    }

    /// The measure of observability `(d1 + d2)(d1 + d3)(d2 + d3)`, between 0 and 8 (4.24).
    pub fn observability(&self) -> f64 {
        self.observability_axes().product()
    }

    /// Differential entropy with respect to the normalized Haar measure, nats: 0 for the uniform
    /// distribution, negative for all others.
    pub fn entropy(&self) -> f64 {
        // -E[log p] = log c - sum s d = log(c exp(-tr S)) + sum s (1 - d).
        self.moments().log_c_scaled() + self.svd().s.dot(&self.moments().complement())
    }

    /// Kullback-Leibler divergence of `other` from `self`, `E[log p - log p']` under `self`,
    /// nats.
    pub fn divergence(&self, other: &Self) -> f64 {
        // log p' averages to tr(F'^T E[R]) - log c'.
        let cross = other.parameter().dot(&self.mean_complement());
        let alignment = other.svd().s.sum() - other.parameter().dot(self.mode().matrix());
        let log_other = -cross - alignment - other.moments().log_c_scaled();
        -self.entropy() - log_other
    }

    /// Root mean square rotation angle between `R` and the mode, rad.
    pub fn angular_dispersion(&self) -> f64 {
        self.rotation_covariance().trace().sqrt()
    }
}
