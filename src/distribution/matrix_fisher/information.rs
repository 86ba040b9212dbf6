//! Information measures: Fisher information, observability, entropy, divergence, dispersion.

use nalgebra::{Matrix3, SMatrix, Vector3};

use super::MatrixFisher;
use super::sums::Sums;
use crate::so3::{hat, quaternion_from_rotation};

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
        // tr(S' (I - Q)) at the mode, by the quaternion of Q: `1 - Q_ii = 2 (|x|^2 - x_i^2)`.
        let q = quaternion_from_rotation(&other.centred(&self.mode()));
        let x = q.fixed_rows::<3>(1).component_mul(&q.fixed_rows::<3>(1));
        let alignment = 2.0 * other.svd().s.dot(&(Vector3::repeat(x.sum()) - x));
        let log_other = -cross - alignment - other.moments().log_c_scaled();
        -self.entropy() - log_other
    }

    /// Root mean square rotation angle between `R` and the mode, rad.
    pub fn angular_dispersion(&self) -> f64 {
        self.rotation_covariance().trace().sqrt()
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::{Rotation3, SVector};

    use super::*;
    use crate::so3::{HaarQuadrature, ProperSvd, exp, proper_svd, vee};

    fn fisher(s: [f64; 3]) -> MatrixFisher {
        let (u, v) = (exp(&Vector3::new(0.4, -1.0, 0.7)), exp(&Vector3::new(-2.0, 0.3, 0.1)));
        MatrixFisher::from_svd(ProperSvd { u, s: Vector3::from(s), v }).unwrap()
    }

    fn expectation(
        fisher: &MatrixFisher,
        grid: &HaarQuadrature,
        f: impl Fn(&Rotation3<f64>) -> f64,
    ) -> f64 {
        grid.integrate(|r| fisher.log_density(r).exp() * f(r))
    }

    /// `E[score score^T]`, the score that of the proof of lemma 4.2.
    #[test]
    fn fisher_information_is_the_covariance_of_the_score() {
        let grid = HaarQuadrature::of_degree(36);
        for s in [[3.0, 2.0, -1.0], [2.0, 2.0, 2.0], [4.0, 0.0, 0.0]] {
            let fisher = fisher(s);
            let (diagonal, d) = (Matrix3::from_diagonal(&fisher.svd().s), fisher.moments().first());
            let score = |r: &Rotation3<f64>| {
                let q = fisher.centred(r).into_inner();
                let u = 2.0 * vee(&(q * diagonal));
                let v = 2.0 * vee(&(q.transpose() * diagonal));
                let s = q.diagonal() - d;
                SVector::<f64, 9>::from_iterator(u.iter().chain(&s).chain(&v).copied())
            };
            let information = fisher.fisher_information();
            for i in 0..9 {
                for j in 0..9 {
                    let found = expectation(&fisher, &grid, |r| score(r)[i] * score(r)[j]);
                    assert!((found - information[(i, j)]).abs() < 1e-11, "{s:?} {i} {j} {found}");
                }
            }
        }
    }

    /// (4.22) from (4.21), and its limit: the information of the concentrated Gaussian.
    #[test]
    fn mean_attitude_information_is_that_of_opposite_variations() {
        let difference = |s: [f64; 3], i: usize| {
            let information = fisher(s).fisher_information();
            let mut direction = SVector::<f64, 9>::zeros();
            (direction[i], direction[i + 6]) = (0.5, -0.5);
            direction.dot(&(information * direction))
        };
        for s in [[30.0, 20.0, -10.0], [1.0, 0.5, 0.2]] {
            let found = fisher(s).mean_attitude_information();
            for i in 0..3 {
                assert_relative_eq!(found[i], difference(s, i), max_relative = 1e-12);
            }
        }
        let sharp = fisher([3e6, 2e6, 1e6]);
        let limit = sharp.information().trace();
        assert_relative_eq!(sharp.mean_attitude_information().sum(), limit, max_relative = 1e-6);
    }

    #[test]
    fn entropy_and_divergence_are_their_integrals() {
        let grid = HaarQuadrature::of_degree(36);
        let turned = |s: [f64; 3]| {
            let turn = exp(&Vector3::new(0.3, 0.2, -0.9)).into_inner();
            MatrixFisher::new(&(turn * Matrix3::from_diagonal(&Vector3::from(s)))).unwrap()
        };
        let all = [fisher([3.0, 2.0, -1.0]), turned([2.0, 2.0, 2.0]), turned([0.0; 3])];
        for p in &all {
            let entropy = -expectation(p, &grid, |r| p.log_density(r));
            assert_relative_eq!(p.entropy(), entropy, epsilon = 1e-11);
            for other in &all {
                let ratio = |r: &Rotation3<f64>| p.log_density(r) - other.log_density(r);
                let divergence = expectation(p, &grid, ratio);
                assert_relative_eq!(p.divergence(other), divergence, epsilon = 1e-11);
            }
        }
    }

    /// A filter compares beliefs that differ little and are sharp.
    #[test]
    fn divergence_of_sharp_neighbours_keeps_its_digits() {
        let turn = 1e-4;
        let s = [3e8, 2e8, 1e8];
        let p = fisher(s);
        let u = exp(&Vector3::new(turn, 0.0, 0.0)) * p.svd().u;
        let moved = MatrixFisher::from_svd(ProperSvd { u, ..*p.svd() }).unwrap();
        let axis = p.svd().u.inverse() * Vector3::x();
        let a = Vector3::new(s[1] + s[2], s[0] + s[2], s[0] + s[1]);
        let expected = 0.5 * turn * turn * a.dot(&axis.component_mul(&axis));
        assert_relative_eq!(p.divergence(&moved), expected, max_relative = 1e-6);
        assert!(p.divergence(&p).abs() < 1e-12);
    }

    #[test]
    fn observability_is_the_determinant_that_defines_it() {
        for s in [[30.0, 5.0, -2.0], [7.0, 7.0, -7.0], [5.0, 0.0, 0.0]] {
            let fisher = fisher(s);
            let d = Matrix3::from_diagonal(&proper_svd(&fisher.mean()).unwrap().s);
            let determinant = (Matrix3::identity() * d.trace() - d).determinant();
            assert!((fisher.observability() - determinant).abs() < 1e-12);
            // Lemma 2.1: observable exactly where the mode is unique.
            assert_eq!(fisher.observability() > 1e-9, s[1] + s[2] > 0.0);
        }
    }
}
