//! Symmetric 3x3 matrices by their six entries, and quadratic polynomials of a point made of them.

use std::ops::{Add, Mul};

use nalgebra::{Matrix3, SMatrix, Vector3};

/// A symmetric 3x3 matrix: its upper triangle row by row.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Symmetric3([f64; 6]);

impl Symmetric3 {
    /// The matrix with the upper triangle of `m`.
    pub fn of(m: &Matrix3<f64>) -> Self {
        Self([m.m11, m.m12, m.m13, m.m22, m.m23, m.m33])
    }

    /// `r m r^T` of a symmetric `m`.
    pub fn turned(m: &Matrix3<f64>, r: &Matrix3<f64>) -> Self {
        let half = r * m;
        let entry = |i: usize, j: usize| {
            half[(i, 0)] * r[(j, 0)] + half[(i, 1)] * r[(j, 1)] + half[(i, 2)] * r[(j, 2)]
        };
        let diagonal = [entry(0, 0), entry(1, 1), entry(2, 2)];
        Self([diagonal[0], entry(0, 1), entry(0, 2), diagonal[1], entry(1, 2), diagonal[2]])
    }

    pub fn matrix(&self) -> Matrix3<f64> {
        let [a, b, c, d, e, f] = self.0;
        Matrix3::new(a, b, c, b, d, e, c, e, f)
    }

    /// The inverse, by cofactors; `None` unless the matrix is positive definite.
    pub fn inverse_of_positive(&self) -> Option<Self> {
        let [a, b, c, d, e, f] = self.0;
        let (aa, ab, ac) = (d * f - e * e, c * e - b * f, b * e - c * d);
        let (bb, bc, cc) = (a * f - c * c, b * c - a * e, a * d - b * b);
        let determinant = a * aa + b * ab + c * ac;
        // An infinite or undefined entry makes one of these false.
        let positive = a > 0.0 && cc > 0.0 && determinant > 0.0 && determinant.is_finite();
        let inverse = Self([aa, ab, ac, bb, bc, cc]) * determinant.recip();
        (positive && inverse.0.iter().all(|x| x.is_finite())).then_some(inverse)
    }

    /// `v^T m v`.
    pub fn quadratic(&self, v: &Vector3<f64>) -> f64 {
        v.dot(&(*self * v))
    }
}

impl Add for Symmetric3 {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self(std::array::from_fn(|k| self.0[k] + other.0[k]))
    }
}

impl Mul<f64> for Symmetric3 {
    type Output = Self;

    fn mul(self, factor: f64) -> Self {
        Self(self.0.map(|entry| entry * factor))
    }
}

impl Mul<&Vector3<f64>> for Symmetric3 {
    type Output = Vector3<f64>;

    fn mul(self, v: &Vector3<f64>) -> Vector3<f64> {
        let [a, b, c, d, e, f] = self.0;
        Vector3::new(
            a * v.x + b * v.y + c * v.z,
            b * v.x + d * v.y + e * v.z,
            c * v.x + e * v.y + f * v.z,
        )
    }
}

/// One symmetric matrix for each product `u_a u_b`, `a <= b`, of the four numbers `u = (p, 1)` of
/// a point `p`: a symmetric matrix that is quadratic in `p` ([`Self::at`]), or the sum of what
/// many points contribute to such ([`Self::add`]).
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PointQuadratic([Symmetric3; Self::PRODUCTS.len()]);

impl PointQuadratic {
    const PRODUCTS: [(usize, usize); 10] =
        [(0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 3)];

    /// `M(p) C M(p)^T` with `M(p) = sum u_a M_a`, for the covariance `C` of a vector that is mapped
    /// linearly in a way that depends on the point.
    pub fn mapped<const K: usize>(
        maps: &[SMatrix<f64, 3, K>; 4],
        covariance: &SMatrix<f64, K, K>,
    ) -> Self {
        let spread = maps.map(|map| map * covariance);
        Self(Self::PRODUCTS.map(|(a, b)| {
            let product = spread[a] * maps[b].transpose();
            let mirrored = if a == b { Matrix3::zeros() } else { product.transpose() };
            Symmetric3::of(&(product + mirrored))
        }))
    }

    /// `sum u_a u_b S_ab`.
    pub fn at(&self, point: &Vector3<f64>) -> Symmetric3 {
        let u = [point.x, point.y, point.z, 1.0];
        let mut sum = Symmetric3::default();
        for (coefficient, (a, b)) in self.0.iter().zip(Self::PRODUCTS) {
            sum = sum + *coefficient * (u[a] * u[b]);
        }
        sum
    }

    /// Adds `u_a u_b m` to every coefficient.
    pub fn add(&mut self, point: &Vector3<f64>, m: &Symmetric3) {
        let u = [point.x, point.y, point.z, 1.0];
        for (coefficient, (a, b)) in self.0.iter_mut().zip(Self::PRODUCTS) {
            *coefficient = *coefficient + *m * (u[a] * u[b]);
        }
    }

    /// The coefficients with their indices `(a, b)`.
    pub fn coefficients(&self) -> impl Iterator<Item = ((usize, usize), &Symmetric3)> {
        Self::PRODUCTS.into_iter().zip(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;
    use proptest::prelude::*;

    fn matrix() -> impl Strategy<Value = Matrix3<f64>> {
        proptest::array::uniform9(-1.0..1.0).prop_map(|m| Matrix3::from_row_slice(&m))
    }

    fn covariance() -> impl Strategy<Value = Matrix3<f64>> {
        matrix().prop_map(|m| m * m.transpose() + Matrix3::identity() * 0.1)
    }

    proptest! {
        #[test]
        fn six_entries_are_the_whole_matrix(m in covariance(), r in matrix()) {
            let found = Symmetric3::of(&m);
            assert_relative_eq!(found.matrix(), m, epsilon = 1e-15);
            let inverse = found.inverse_of_positive().unwrap().matrix();
            prop_assert!((inverse * m - Matrix3::identity()).norm() < 1e-10);
            let turned = Symmetric3::turned(&m, &r).matrix();
            prop_assert!((turned - r * m * r.transpose()).norm() < 1e-14);
            let v = r.column(0).into_owned();
            prop_assert!((found.quadratic(&v) - v.dot(&(m * v))).abs() < 1e-14);
        }

        #[test]
        fn the_quadratic_of_maps_is_their_product(
            maps in proptest::array::uniform4(matrix()), m in covariance(), p in matrix(),
        ) {
            let point = p.column(0).into_owned();
            let map = maps[0] * point.x + maps[1] * point.y + maps[2] * point.z + maps[3];
            let found = PointQuadratic::mapped(&maps, &m).at(&point).matrix();
            prop_assert!((found - map * m * map.transpose()).norm() < 1e-13);
        }

        /// `sum u_a u_b S_ab : T` is the same whether the point enters with `S` or with `T`.
        #[test]
        fn adding_is_the_transpose_of_evaluating(
            maps in proptest::array::uniform4(matrix()), m in covariance(), p in matrix(),
        ) {
            let point = p.column(0).into_owned();
            let polynomial = PointQuadratic::mapped(&maps, &m);
            let mut sum = PointQuadratic::default();
            sum.add(&point, &Symmetric3::of(&m));
            let pairs = polynomial.coefficients().zip(sum.coefficients());
            let through_sum: f64 = pairs.map(|((_, c), (_, s))| c.matrix().dot(&s.matrix())).sum();
            let direct = polynomial.at(&point).matrix().dot(&m);
            prop_assert!((through_sum - direct).abs() < 1e-12);
        }
    }

    #[test]
    fn what_is_not_positive_definite_has_no_inverse() {
        let broken = [
            Matrix3::zeros(),
            Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -1.0)),
            Matrix3::from_diagonal(&Vector3::new(-1.0, -1.0, 1.0)),
            Matrix3::identity() * f64::NAN,
            Matrix3::identity() * f64::INFINITY,
        ];
        for m in broken {
            assert_eq!(Symmetric3::of(&m).inverse_of_positive(), None);
        }
    }
}
