//! Densities on SO(3) whose exponent is quadratic in the entries of `R`.
//!
//! `p(R) ~ exp(f^T r - r^T G r / 2)`, `r = vec R` (columns stacked): what Gaussian likelihoods of
//! points, vectors and positions make of a matrix Fisher prior once everything Euclidean is
//! integrated out. Of the 45 quadratic forms in `r` 11 are constant on SO(3) (`M (x) I` and
//! `I (x) M`, since `R^T R = R R^T = I`) and 9 are linear there (the 2x2 minors of a rotation are
//! its entries, `cof R = R`). [`RotationQuadratic::reduced`] removes both; where nothing is left
//! the density is matrix Fisher, exactly.

use std::f64::consts::{PI, TAU};
use std::num::NonZeroUsize;

use gauss_quad::legendre::GaussLegendre;
use nalgebra::{Matrix3, Rotation3, SMatrix, SVector, SymmetricEigen, Vector3, Vector4};

use super::matrix_fisher::{MatrixFisher, MatrixFisherError};
use crate::so3::{exp, proper_svd, rotation_from_quaternion};

/// The 3x3 matrix whose stacked columns are given.
fn matrix(stacked: &SVector<f64, 9>) -> Matrix3<f64> {
    Matrix3::from_column_slice(stacked.as_slice())
}

/// `vec(R)`: the columns of a matrix, stacked.
pub fn vectorize(matrix: &Matrix3<f64>) -> SVector<f64, 9> {
    SVector::from_column_slice(matrix.as_slice())
}

/// Derivative of `vec(R exp(e^))` by `e` at `e = 0` (9x3).
pub fn rotated_vector_by_rotation(rotation: &Matrix3<f64>) -> SMatrix<f64, 9, 3> {
    let r = rotation;
    let mut derivative = SMatrix::<f64, 9, 3>::zeros();
    // Column b of R e_k^ is R (e_k x e_b).
    for (k, (i, j)) in [(0, (1, 2)), (1, (2, 0)), (2, (0, 1))] {
        derivative.fixed_view_mut::<3, 1>(3 * i, k).copy_from(&r.column(j));
        derivative.fixed_view_mut::<3, 1>(3 * j, k).copy_from(&-r.column(i));
    }
    derivative
}

/// Newton steps to a mode; it converges quadratically in 2 to 5 from a good start.
const MAX_NEWTON_STEPS: usize = 50;
/// A Newton step below this ends the search, rad.
const NEWTON_TOLERANCE: f64 = 1e-10;
/// Newton steps are shortened to this angle, rad.
const MAX_STEP: f64 = 1.0;
/// A remainder of the quadratic form below this fraction of its norm is rounding.
const NEGLIGIBLE: f64 = 1e-12;
/// Where the least information about a rotation axis (1/rad^2) exceeds this, the matrix Fisher
/// density with the same mode and curvature stands for the density; its moments are off by about
/// the inverse.
const CONCENTRATED: f64 = 100.0;

/// A density `exp(linear^T r - r^T quadratic r / 2)` on SO(3), up to its constant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RotationQuadratic {
    pub linear: SVector<f64, 9>,
    /// Symmetric.
    pub quadratic: SMatrix<f64, 9, 9>,
}

/// Mean and covariance of `r = vec R`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RotationMoments {
    pub mean: SVector<f64, 9>,
    pub covariance: SMatrix<f64, 9, 9>,
}

impl RotationMoments {
    /// Exact, to the digits that `E[r r^T] - E[r] E[r]^T` leaves, or from the covariance of the
    /// rotation vector where it leaves too few.
    pub fn of_matrix_fisher(fisher: &MatrixFisher) -> Self {
        /// Least information from which on the second moments have lost more than the tangent
        /// space approximates, 1/rad^2.
        const CANCELLED: f64 = 1e6;
        let mean = vectorize(&fisher.mean());
        let information = fisher.information();
        let least = information.symmetric_eigenvalues().min();
        let tangent = (least > CANCELLED).then(|| information.cholesky()).flatten();
        let covariance = match tangent {
            Some(information) => {
                let d = rotated_vector_by_rotation(fisher.mode().matrix());
                d * information.inverse() * d.transpose()
            }
            None => fisher.second_moment() - mean * mean.transpose(),
        };
        Self { mean, covariance }
    }

    /// `E[R]`.
    pub fn mean_rotation(&self) -> Matrix3<f64> {
        matrix(&self.mean)
    }

    /// Nine matrices `D_k` with `Cov[r] = sum vec(D_k) vec(D_k)^T`: the average of what is
    /// quadratic in `R` is its value at `E[R]` plus that of its quadratic part at each of them.
    pub fn deviations(&self) -> [Matrix3<f64>; 9] {
        let eigen = SymmetricEigen::new(self.covariance);
        std::array::from_fn(|k| {
            let root = eigen.eigenvalues[k].max(0.0).sqrt();
            matrix(&(eigen.eigenvectors.column(k) * root))
        })
    }
}

impl RotationQuadratic {
    /// The matrix Fisher density with parameter `f`.
    pub fn matrix_fisher(f: &Matrix3<f64>) -> Self {
        Self { linear: vectorize(f), quadratic: SMatrix::zeros() }
    }

    /// Logarithm of the density up to its constant.
    pub fn log_density(&self, rotation: &Rotation3<f64>) -> f64 {
        let r = vectorize(rotation.matrix());
        self.linear.dot(&r) - 0.5 * r.dot(&(self.quadratic * r))
    }

    /// The same density with the constant forms removed and the linear ones moved to `linear`.
    /// What remains is traceless and symmetric in its world and in its body indices: 25 numbers.
    pub fn reduced(&self) -> Self {
        let g = |a: usize, i: usize, b: usize, j: usize| self.quadratic[(3 * i + a, 3 * j + b)];
        let mut linear = self.linear;
        for c in 0..3 {
            for k in 0..3 {
                let (a, b, i, j) = ((c + 1) % 3, (c + 2) % 3, (k + 1) % 3, (k + 2) % 3);
                linear[3 * k + c] -= 0.5 * (g(a, i, b, j) - g(b, i, a, j));
            }
        }
        let symmetric = |a, i, b, j| 0.5 * (g(a, i, b, j) + g(b, i, a, j));
        let over_world = |i, j| (0..3).map(|c| symmetric(c, i, c, j)).sum::<f64>() / 3.0;
        let over_body = |a, b| (0..3).map(|k| symmetric(a, k, b, k)).sum::<f64>() / 3.0;
        let over_both = (0..3).map(|i| over_world(i, i)).sum::<f64>() / 3.0;
        let delta = |a: usize, b: usize| if a == b { 1.0 } else { 0.0 };
        let quadratic = SMatrix::<f64, 9, 9>::from_fn(|row, column| {
            let (i, a, j, b) = (row / 3, row % 3, column / 3, column % 3);
            symmetric(a, i, b, j) - delta(a, b) * over_world(i, j) - over_body(a, b) * delta(i, j)
                + delta(a, b) * delta(i, j) * over_both
        });
        Self { linear, quadratic }
    }

    /// The matrix Fisher parameter if the density is one, up to rounding.
    pub fn as_matrix_fisher(&self) -> Option<Matrix3<f64>> {
        let reduced = self.reduced();
        let exact = reduced.quadratic.norm() <= NEGLIGIBLE * self.quadratic.norm();
        exact.then(|| matrix(&reduced.linear))
    }

    /// Gradient of the log-density of `R exp(e^)` by `e`, and minus its Hessian.
    pub fn derivatives(&self, at: &Rotation3<f64>) -> (Vector3<f64>, Matrix3<f64>) {
        let d = rotated_vector_by_rotation(at.matrix());
        let slope = self.linear - self.quadratic * vectorize(at.matrix());
        let in_body = at.matrix().transpose() * matrix(&slope);
        let second = (in_body + in_body.transpose()) * 0.5 - Matrix3::identity() * in_body.trace();
        (d.transpose() * slope, d.transpose() * (self.quadratic * d) - second)
    }

    /// The mode that is uphill from `start` and minus the Hessian there, in body-frame rotation
    /// coordinates; `None` if anything is not finite.
    pub fn mode(&self, start: &Rotation3<f64>) -> Option<(Rotation3<f64>, Matrix3<f64>)> {
        let mut mode = *start;
        for _ in 0..MAX_NEWTON_STEPS {
            let (gradient, information) = self.derivatives(&mode);
            let mut step = match information.cholesky() {
                Some(cholesky) => cholesky.solve(&gradient),
                None => uphill(&gradient, &information)?,
            };
            let size = step.norm();
            if size > MAX_STEP {
                step *= MAX_STEP / size;
            }
            mode *= exp(&step);
            if size < NEWTON_TOLERANCE {
                break;
            }
        }
        mode.renormalize();
        let (_, information) = self.derivatives(&mode);
        information.iter().all(|x| x.is_finite()).then_some((mode, information))
    }

    /// The highest mode found from that of the linear part and from half turns of it.
    pub fn global_mode(&self) -> Option<(Rotation3<f64>, Matrix3<f64>)> {
        let reduced = self.reduced();
        let svd = proper_svd(&matrix(&reduced.linear)).ok()?;
        let starts = [Vector3::zeros(), Vector3::x(), Vector3::y(), Vector3::z()];
        let modes = starts.iter().filter_map(|axis| {
            let turned = svd.u * exp(&(axis * PI)) * svd.v.inverse();
            reduced.mode(&turned)
        });
        modes.max_by(|a, b| reduced.log_density(&a.0).total_cmp(&reduced.log_density(&b.0)))
    }

    /// Mean and covariance of `vec R`.
    ///
    /// Exact where the density is matrix Fisher; elsewhere those of the matrix Fisher density of
    /// the same mode and curvature where it is concentrated about every axis, and a quadrature
    /// over SO(3) in the principal axes of the curvature where it is not.
    pub fn moments(&self) -> Result<RotationMoments, RotationQuadraticError> {
        if let Some(f) = self.as_matrix_fisher() {
            return Ok(RotationMoments::of_matrix_fisher(&MatrixFisher::new(&f)?));
        }
        let reduced = self.reduced();
        let (mode, information) = reduced.global_mode().ok_or(RotationQuadraticError::NotFinite)?;
        if information.symmetric_eigenvalues().min() > CONCENTRATED {
            let fisher = MatrixFisher::from_mode_and_information(mode, information)?;
            return Ok(RotationMoments::of_matrix_fisher(&fisher));
        }
        reduced.quadrature(&mode, &information)
    }

    /// `x = (sqrt(1-u) e^(i alpha), sqrt(u) e^(i beta))` is the quaternion of the turn from the
    /// mode in the principal axes of its curvature, weakest first; the Haar measure is
    /// `du dalpha dbeta`.
    fn quadrature(
        &self,
        mode: &Rotation3<f64>,
        information: &Matrix3<f64>,
    ) -> Result<RotationMoments, RotationQuadraticError> {
        let eigen = SymmetricEigen::new(*information);
        let mut order = [0, 1, 2];
        order.sort_by(|&i, &j| eigen.eigenvalues[i].total_cmp(&eigen.eigenvalues[j]));
        let axis = |i: usize| eigen.eigenvectors.column(order[i]).into_owned();
        let (x, y) = (axis(0), axis(1));
        let axes = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, y, x.cross(&y)]));
        let nodes = SwingTwistNodes::new(order.map(|i| eigen.eigenvalues[i].max(0.0)));

        let peak = self.log_density(mode);
        let (mut total, mut mean) = (0.0, SVector::<f64, 9>::zeros());
        let mut second = SMatrix::<f64, 9, 9>::zeros();
        let centre = vectorize(mode.matrix());
        nodes.for_each(|quaternion, weight| {
            let turn = axes * rotation_from_quaternion(&quaternion) * axes.inverse();
            let r = vectorize((mode * turn).matrix());
            let exponent = self.linear.dot(&r) - 0.5 * r.dot(&(self.quadratic * r)) - peak;
            let weight = weight * exponent.exp();
            let deviation = r - centre;
            total += weight;
            mean += deviation * weight;
            second.ger(weight, &deviation, &deviation, 1.0);
        });
        let finite = total > 0.0 && total.is_finite();
        if !finite {
            return Err(RotationQuadraticError::NotFinite);
        }
        let deviation = mean / total;
        let covariance = second / total - deviation * deviation.transpose();
        Ok(RotationMoments { mean: centre + deviation, covariance })
    }
}

/// A step along the gradient in the directions in which the density is not concave, and Newton's
/// in the others.
fn uphill(gradient: &Vector3<f64>, information: &Matrix3<f64>) -> Option<Vector3<f64>> {
    if !information.iter().chain(gradient.iter()).all(|x| x.is_finite()) {
        return None;
    }
    let eigen = SymmetricEigen::new(*information);
    let scale = eigen.eigenvalues.amax().max(f64::MIN_POSITIVE);
    let along = eigen.eigenvectors.transpose() * gradient;
    let step = along.zip_map(&eigen.eigenvalues, |g, h| g / h.abs().max(1e-6 * scale));
    Some(eigen.eigenvectors * step)
}

/// Nodes over SO(3) that resolve a density whose information about three axes ascends.
struct SwingTwistNodes {
    /// Gauss-Legendre nodes of `u` with their weights.
    swing: Vec<(f64, f64)>,
    turns_about: usize,
    turns_within: usize,
}

impl SwingTwistNodes {
    /// Fewest nodes over `alpha`.
    const ABOUT: usize = 36;
    /// Standard deviations of `alpha`, `1 / (2 sqrt(weak))`, from node to node where it is narrow.
    const STEP: f64 = 0.8;
    /// Nodes over half a turn of `beta` for equal strength of the other two axes.
    const WITHIN: usize = 36;
    const MAX_WITHIN: usize = 192;
    /// Gauss-Legendre nodes a panel of the swing.
    const SWING: usize = 20;
    /// Exponent at which the density is cut off.
    const CUT: f64 = 40.0;

    fn new([weak, middle, strong]: [f64; 3]) -> Self {
        // The density falls as exp(-2 u (middle cos^2 + strong sin^2)) and more.
        let end = (Self::CUT / (2.0 * middle).max(1e-9)).min(1.0);
        let split = (Self::CUT / (2.0 * strong).max(1e-9)).min(1.0);
        let rule = GaussLegendre::new(NonZeroUsize::MIN.saturating_add(Self::SWING - 1));
        let mut swing = Vec::new();
        for (low, high) in [(0.0, split), (split, end)] {
            let half = 0.5 * (high - low);
            if half > 0.0 {
                swing.extend(rule.iter().map(|(x, w)| (low + half * (1.0 + x), half * w)));
            }
        }
        let ratio = (end / split).sqrt();
        let turns_within = ((Self::WITHIN as f64 * ratio) as usize).min(Self::MAX_WITHIN);
        let turns_about = (2.0 * TAU / Self::STEP * weak.sqrt()) as usize;
        Self { swing, turns_about: turns_about.max(Self::ABOUT), turns_within }
    }

    fn for_each(&self, mut visit: impl FnMut(Vector4<f64>, f64)) {
        for &(u, weight) in &self.swing {
            let (near, far) = ((1.0 - u).sqrt(), u.sqrt());
            for i in 0..self.turns_about {
                let (sine, cosine) = (TAU * i as f64 / self.turns_about as f64).sin_cos();
                for j in 0..self.turns_within {
                    // Opposite quaternions are the same rotation: half a turn suffices.
                    let (up, right) = (PI * j as f64 / self.turns_within as f64).sin_cos();
                    visit(Vector4::new(near * cosine, near * sine, far * right, far * up), weight);
                }
            }
        }
    }
}

/// Why a density has no moments.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum RotationQuadraticError {
    #[error(transparent)]
    MatrixFisher(#[from] MatrixFisherError),
    /// The coefficients are infinite, not a number, or too large to compute with.
    #[error("the exponent on SO(3) is not finite")]
    NotFinite,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::so3::{HaarQuadrature, sample_haar};
    use approx::assert_relative_eq;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn random(rng: &mut ChaCha8Rng, linear: f64, quadratic: f64) -> RotationQuadratic {
        let root = SMatrix::<f64, 9, 9>::from_fn(|_, _| rng.random_range(-1.0..1.0));
        RotationQuadratic {
            linear: SVector::from_fn(|_, _| linear * rng.random_range(-1.0..1.0)),
            quadratic: root * root.transpose() * (quadratic / 9.0),
        }
    }

    #[test]
    fn reduction_changes_the_density_by_a_constant_only() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for _ in 0..10 {
            let density = random(&mut rng, 3.0, 5.0);
            let reduced = density.reduced();
            let difference = |r: &Rotation3<f64>| density.log_density(r) - reduced.log_density(r);
            let constant = difference(&Rotation3::identity());
            for _ in 0..10 {
                assert_relative_eq!(difference(&sample_haar(&mut rng)), constant, epsilon = 1e-11);
            }
            // Traceless and symmetric in either pair of indices.
            let g =
                |a: usize, i: usize, b: usize, j: usize| reduced.quadratic[(3 * i + a, 3 * j + b)];
            for i in 0..3 {
                for j in 0..3 {
                    assert!((0..3).map(|a| g(a, i, a, j)).sum::<f64>().abs() < 1e-12);
                    assert!((0..3).map(|k| g(i, k, j, k)).sum::<f64>().abs() < 1e-12);
                    assert_relative_eq!(g(0, i, 1, j), g(1, i, 0, j), epsilon = 1e-12);
                }
            }
        }
    }

    #[test]
    fn isotropic_weights_are_matrix_fisher() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let mut density = random(&mut rng, 2.0, 0.0);
        let m = Matrix3::from_fn(|_, _| rng.random_range(-1.0..1.0));
        density.quadratic = (m * m.transpose()).kronecker(&Matrix3::identity());
        let f = density.as_matrix_fisher().unwrap();
        assert_relative_eq!(f, matrix(&density.linear), epsilon = 1e-12);
        assert!(random(&mut rng, 1.0, 1.0).as_matrix_fisher().is_none());
    }

    #[test]
    fn derivatives_are_those_of_the_density() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let density = random(&mut rng, 3.0, 5.0);
        let at = sample_haar(&mut rng);
        let value = |e: Vector3<f64>| density.log_density(&(at * exp(&e)));
        let (gradient, information) = density.derivatives(&at);
        let h = 1e-4;
        for i in 0..3 {
            let step = Vector3::ith(i, h);
            let slope = (value(step) - value(-step)) / (2.0 * h);
            assert_relative_eq!(slope, gradient[i], epsilon = 1e-6);
            let second = (value(step) + value(-step) - 2.0 * value(Vector3::zeros())) / (h * h);
            assert_relative_eq!(-second, information[(i, i)], epsilon = 1e-5);
        }
    }

    fn by_brute_force(density: &RotationQuadratic, degree: usize) -> RotationMoments {
        let peak = density.log_density(&density.global_mode().unwrap().0);
        let mut total = 0.0;
        let (mut mean, mut second) = (SVector::<f64, 9>::zeros(), SMatrix::<f64, 9, 9>::zeros());
        for (r, weight) in HaarQuadrature::of_degree(degree).nodes() {
            let weight = weight * (density.log_density(r) - peak).exp();
            let r = vectorize(r.matrix());
            total += weight;
            mean += r * weight;
            second += r * r.transpose() * weight;
        }
        let mean = mean / total;
        RotationMoments { mean, covariance: second / total - mean * mean.transpose() }
    }

    #[test]
    fn moments_are_those_of_brute_force() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        for (linear, quadratic) in [(0.1, 0.5), (1.0, 3.0), (5.0, 5.0), (0.0, 8.0), (9.0, 12.0)] {
            let density = random(&mut rng, linear, quadratic);
            let (found, expected) = (density.moments().unwrap(), by_brute_force(&density, 60));
            assert_relative_eq!(found.mean, expected.mean, epsilon = 1e-6);
            assert_relative_eq!(found.covariance, expected.covariance, epsilon = 1e-6);
        }
    }

    /// One axis free, the others sharp: what two points leave.
    #[test]
    fn a_free_axis_is_integrated_over() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let turn = sample_haar(&mut rng).into_inner();
        let mut density = RotationQuadratic::matrix_fisher(
            &(turn * Matrix3::from_diagonal(&Vector3::new(40.0, 0.5, 0.2))),
        );
        let fisher = RotationMoments::of_matrix_fisher(
            &MatrixFisher::new(&matrix(&density.linear)).unwrap(),
        );
        // The smallest quadratic term leads away from the exact route.
        density.quadratic[(0, 0)] += 1e-9;
        let found = density.moments().unwrap();
        assert_relative_eq!(found.mean, fisher.mean, epsilon = 1e-6);
        assert_relative_eq!(found.covariance, fisher.covariance, epsilon = 1e-6);
    }

    #[test]
    fn concentrated_moments_approach_those_of_brute_force() {
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        let mode = sample_haar(&mut rng);
        let mut density = random(&mut rng, 0.0, 30.0);
        density.linear += density.quadratic * vectorize(mode.matrix())
            + vectorize(&(mode.matrix() * Matrix3::from_diagonal(&Vector3::new(70.0, 60.0, 50.0))));
        let (found, expected) = (density.moments().unwrap(), by_brute_force(&density, 120));
        assert!((found.mean - expected.mean).norm() < 2e-3);
        assert!(
            (found.covariance - expected.covariance).norm() < 0.05 * expected.covariance.norm()
        );
    }

    #[test]
    fn what_is_not_finite_is_refused() {
        let mut density = RotationQuadratic::matrix_fisher(&Matrix3::identity());
        density.quadratic[(1, 1)] = f64::NAN;
        assert!(density.moments().is_err());
    }
}
