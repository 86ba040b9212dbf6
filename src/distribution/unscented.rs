//! Unscented transforms: weighted points that carry a distribution through a nonlinear map.
//!
//! All of them are the mode and six turns, by plus and minus an angle about each principal axis:
//!
//! ```math
//! R_0 = U V^\top , \qquad R_{i\pm} = U \exp(\pm \theta_i \hat e_i) V^\top .
//! ```
//!
//! | points | angles | weights | determined by |
//! | --- | --- | --- | --- |
//! | [`seven_points`] (L-UAE 11, 12) | the log-density falls by `1 - sigma` of its way to zero | equal | `F` |
//! | [`weighted_points`] (4.45-4.47) | of one density | such that `E[R]` is exact | `F` |
//! | [`bingham_points`] (after theorem 4.7) | such that `E[R]` is exact | by axis | `E[R]` alone |
//!
//! The angles and weights of the second kind satisfy, with the spread fixed by the total weight,
//!
//! ```math
//! 1 - \cos \theta_i = \frac{\sigma}{s_j + s_k} , \qquad
//! w_i = \frac{E[x_i^2]}{1 - \cos \theta_i} .
//! ```
//!
//! A matrix Fisher-Gaussian distribution adds `2n` points along the columns of the root of the
//! covariance of `x` given `R`, at the mode
//! ([`sigma_points`](MatrixFisherGaussian::sigma_points)).
#![doc = include_str!("../../docs/math.html")]

use nalgebra::allocator::Allocator;
use nalgebra::{DefaultAllocator, Dim, Matrix3, OVector, Rotation3, U1, U3, Vector3};

use super::matrix_fisher::{MatrixFisher, MatrixFisherError, sums_of_singular_values};
use super::matrix_fisher_gaussian::{MatrixFisherGaussian, WeightedSample};
use crate::so3::{ProperSvd, exp, proper_svd};

/// Steps of the bisections for the spread and for the inverse.
const BISECTIONS: usize = 200;

/// Why sigma points cannot be chosen, or do not determine a distribution.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum UnscentedError {
    /// Weights are shares of one.
    #[error(
        "the weights of attitude and vector must be positive and sum to at most 1, not {0} and {1}"
    )]
    Weights(f64, f64),
    /// The spread parameter of L-UAE.
    #[error("the spread must satisfy 0 <= sigma < 1, not {0}")]
    Spread(f64),
    /// With so little weight, no rotation is large enough to give the dispersion.
    #[error("an attitude weight of {0} is too small for so broad a distribution")]
    TooBroad(f64),
    /// The mean is not one of seven such points.
    #[error("no distribution has these sigma points")]
    NoSource,
    #[error(transparent)]
    Attitude(#[from] MatrixFisherError),
}

/// An attitude with its weight.
///
/// ```
/// # use mfg_vio::distribution::matrix_fisher::MatrixFisher;
/// # use mfg_vio::distribution::unscented::{
/// #     WeightedRotation, bingham_points, matrix_fisher_of_seven, mean_rotation, seven_points,
/// #     weighted_points,
/// # };
/// # use nalgebra::{Matrix3, Rotation3, Vector3};
/// let fisher = MatrixFisher::new(&Matrix3::from_diagonal(&Vector3::new(30.0, 9.0, 4.0)))?;
/// // Two ways to carry E[R] in seven points.
/// for points in [weighted_points(&fisher, 0.7)?, bingham_points(&fisher.mean(), 0.5)?] {
///     assert!((mean_rotation(&points) - fisher.mean()).norm() < 1e-12);
/// }
/// // Those of equal weight are inverted; a turn of all of them is a turn of the distribution.
/// let turn = Rotation3::from_scaled_axis(Vector3::new(0.1, 0.2, 0.3));
/// let turned = seven_points(&fisher, 0.9)?
///     .map(|p| WeightedRotation { attitude: turn * p.attitude, ..p });
/// let found = matrix_fisher_of_seven(&mean_rotation(&turned), 0.9)?;
/// assert!((found.parameter() - turn.matrix() * fisher.parameter()).norm() < 1e-8);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, Copy)]
pub struct WeightedRotation {
    pub weight: f64,
    pub attitude: Rotation3<f64>,
}

/// The weighted mean of rotations, `sum w R / sum w`.
pub fn mean_rotation(points: &[WeightedRotation]) -> Matrix3<f64> {
    let total: f64 = points.iter().map(|p| p.weight).sum();
    points.iter().map(|p| p.attitude.matrix() * (p.weight / total)).sum()
}

/// The seven equally weighted points of L-UAE (11), (12): the mode, and turns about each
/// principal axis to where the log-density has fallen by `1 - sigma` of the way from its maximum
/// to zero.
///
/// They carry the distribution: [`matrix_fisher_of_seven`] recovers it from their mean.
pub fn seven_points(
    fisher: &MatrixFisher,
    sigma: f64,
) -> Result<[WeightedRotation; 7], UnscentedError> {
    if !(0.0..1.0).contains(&sigma) {
        return Err(UnscentedError::Spread(sigma));
    }
    let fall = -(1.0 - sigma) * fisher.moments().log_c_scaled();
    let a = sums_of_singular_values(&fisher.svd().s);
    // Where a turn by pi does not lower the density that much, pi is the farthest there is.
    let versines = a.map(|a| if fall < 2.0 * a { fall / a } else { 2.0 });
    Ok(points_about_axes(fisher.svd(), &versines, [1.0 / 7.0; 3], 1.0 / 7.0))
}

/// The distribution whose [`seven_points`] have the given mean (L-UAE proposition 3).
///
/// With `1 - cos t_i` known from the mean, `s_j + s_k = (1 - sigma) L/(1 - cos t_i)` for
/// `L = -log(c(S) exp(-tr S))`, which leaves one equation for `L`.
pub fn matrix_fisher_of_seven(
    mean: &Matrix3<f64>,
    sigma: f64,
) -> Result<MatrixFisher, UnscentedError> {
    if !(0.0..1.0).contains(&sigma) {
        return Err(UnscentedError::Spread(sigma));
    }
    let svd = proper_svd(mean).map_err(MatrixFisherError::from)?;
    // 1 - d_i = (2/7)(v_j + v_k) of the versines v.
    let g = svd.s.map(|d| 1.0 - d);
    let versines = [g[1] + g[2] - g[0], g[0] + g[2] - g[1], g[0] + g[1] - g[2]].map(|v| 1.75 * v);
    if !versines.iter().all(|v| *v > 0.0 && *v < 2.0) {
        return Err(UnscentedError::NoSource);
    }
    let candidate = |fall: f64| {
        let a = versines.map(|v| (1.0 - sigma) * fall / v);
        let s = Vector3::new(a[1] + a[2] - a[0], a[0] + a[2] - a[1], a[0] + a[1] - a[2]) * 0.5;
        MatrixFisher::from_svd(ProperSvd { s, ..svd }).map_err(MatrixFisherError::from)
    };
    // -log c falls short of L below the root and exceeds it above: the difference is convex.
    let excess = |fall: f64| candidate(fall).map(|m| fall + m.moments().log_c_scaled());
    let (mut low, mut high) = (0.0, 1.0);
    while excess(high)? < 0.0 {
        (low, high) = (high, 2.0 * high);
        if high > 1e3 {
            return Err(UnscentedError::NoSource);
        }
    }
    for _ in 0..BISECTIONS {
        let middle = 0.5 * (low + high);
        if middle <= low || middle >= high {
            break;
        }
        if excess(middle)? < 0.0 { low = middle } else { high = middle }
    }
    if high < 1e-9 {
        return Err(UnscentedError::NoSource);
    }
    Ok(candidate(high)?)
}

/// The weighted points of definition 4.3: six turns of equal density that share the weight
/// `attitude_weight` and carry `E[R]` exactly, and the mode with the rest.
pub fn weighted_points(
    fisher: &MatrixFisher,
    attitude_weight: f64,
) -> Result<[WeightedRotation; 7], UnscentedError> {
    if !(attitude_weight > 0.0 && attitude_weight <= 1.0) {
        return Err(UnscentedError::Weights(attitude_weight, 0.0));
    }
    let (versines, weights) = weighted_turns(fisher, attitude_weight)?;
    Ok(points_about_axes(fisher.svd(), &versines, weights, 1.0 - attitude_weight))
}

/// Points that need only the mean `E[R]`, not the parameter: those of the Bingham distribution on
/// the quaternions by Gilitschenski et al. (2016), W22 after theorem 4.7.
///
/// Each pair has the weight of its axis plus a third of `(1 - central_share)` of that of the mode,
/// so that no quaternion is turned by more than a right angle however broad the distribution;
/// `0 < central_share <= 1`.
pub fn bingham_points(
    mean: &Matrix3<f64>,
    central_share: f64,
) -> Result<[WeightedRotation; 7], UnscentedError> {
    if !(central_share > 0.0 && central_share <= 1.0) {
        return Err(UnscentedError::Weights(central_share, 0.0));
    }
    let svd = proper_svd(mean).map_err(MatrixFisherError::from)?;
    let g = svd.s.map(|d| 1.0 - d);
    let squares = Vector3::new(g[1] + g[2] - g[0], g[0] + g[2] - g[1], g[0] + g[1] - g[2]) * 0.25;
    let squares = squares.map(|y| y.max(0.0));
    let scalar = 1.0 - squares.sum();
    let pairs = squares.map(|y| y + (1.0 - central_share) * scalar / 3.0);
    // x_i^2 = sin^2 of half the turn = (1 - cos t)/2.
    let versine = |i: usize| if pairs[i] > 0.0 { 2.0 * squares[i] / pairs[i] } else { 0.0 };
    let versines = [versine(0), versine(1), versine(2)];
    let weights = (pairs * 0.5).into();
    Ok(points_about_axes(&svd, &versines, weights, central_share * scalar))
}

impl<D: Dim> MatrixFisherGaussian<D>
where
    DefaultAllocator:
        Allocator<D> + Allocator<D, D> + Allocator<D, U3> + Allocator<U3, D> + Allocator<U1, D>,
{
    /// The `7 + 2n` points of definition 4.3: `attitude_weight` on the six turns,
    /// `vector_weight` on pairs along the columns of the root of `Sigma_c`, the rest on the mean.
    ///
    /// The marginal-conditional MLE of the points is the distribution itself (theorem 4.7).
    ///
    /// ```
    /// # use mfg_vio::distribution::matrix_fisher::MatrixFisher;
    /// # use mfg_vio::distribution::matrix_fisher_gaussian::{Correlation, MatrixFisherGaussian};
    /// # use nalgebra::{Matrix3, Vector3};
    /// let attitude = MatrixFisher::new(&Matrix3::from_diagonal(&Vector3::new(30.0, 9.0, 2.0)))?;
    /// let belief = MatrixFisherGaussian::new(
    ///     attitude,
    ///     Vector3::zeros(),
    ///     Matrix3::identity(),
    ///     Matrix3::from_diagonal_element(0.05),
    ///     Correlation::World,
    /// )?;
    /// let points = belief.sigma_points(0.5, 0.3)?;
    /// assert_eq!(points.len(), 13);
    /// let refit = MatrixFisherGaussian::from_samples(&points, Correlation::World)?;
    /// assert!(refit.is_equivalent(&belief, 1e-9));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn sigma_points(
        &self,
        attitude_weight: f64,
        vector_weight: f64,
    ) -> Result<Vec<WeightedSample<D>>, UnscentedError> {
        let total = attitude_weight + vector_weight;
        if !(attitude_weight > 0.0 && vector_weight > 0.0 && total <= 1.0) {
            return Err(UnscentedError::Weights(attitude_weight, vector_weight));
        }
        let (versines, weights) = weighted_turns(self.attitude(), attitude_weight)?;
        let svd = self.attitude().svd();
        let turns = points_about_axes(svd, &versines, weights, 1.0 - total);
        let n = self.mu().len();
        let mut points = Vec::with_capacity(7 + 2 * n);
        points.extend(turns.iter().map(|turn| WeightedSample {
            weight: turn.weight,
            attitude: turn.attitude,
            x: self.conditional_mean(&turn.attitude),
        }));
        let spread = (n as f64 / vector_weight).sqrt();
        let weight = 0.5 * vector_weight / n as f64;
        for column in self.conditional_factor().column_iter() {
            for sign in [spread, -spread] {
                let x: OVector<f64, D> = self.mu() + column * sign;
                points.push(WeightedSample { weight, attitude: self.attitude().mode(), x });
            }
        }
        Ok(points)
    }
}

/// The mode with `centre`, and each pair of turns about the principal axes with twice its weight.
fn points_about_axes(
    svd: &ProperSvd,
    versines: &[f64; 3],
    weights: [f64; 3],
    centre: f64,
) -> [WeightedRotation; 7] {
    let turned = |angle: Vector3<f64>| svd.u * exp(&angle) * svd.v.inverse();
    std::array::from_fn(|n| {
        if n == 6 {
            return WeightedRotation { weight: centre, attitude: svd.rotation() };
        }
        let (axis, sign) = (n / 2, if n % 2 == 0 { 1.0 } else { -1.0 });
        // 1 - cos t = 2 sin^2(t/2) keeps small angles.
        let angle = 2.0 * (0.5 * versines[axis]).clamp(0.0, 1.0).sqrt().asin();
        WeightedRotation {
            weight: weights[axis],
            attitude: turned(Vector3::ith(axis, sign * angle)),
        }
    })
}

/// `1 - cos t_i` and the weight of each of a pair of points (4.46, 4.47), such that the six
/// weights sum to `attitude_weight`.
fn weighted_turns(
    fisher: &MatrixFisher,
    attitude_weight: f64,
) -> Result<([f64; 3], [f64; 3]), UnscentedError> {
    let squares = fisher.moments().quaternion_squares();
    let versines = |spread: f64| turn_versines(fisher, spread);
    // Each of a pair has the weight E[x_i^2]/(1 - cos t_i).
    let weights = |v: &[f64; 3]| -> [f64; 3] { std::array::from_fn(|i| squares[i + 1] / v[i]) };
    let total = |spread: f64| 2.0 * weights(&versines(spread)).iter().sum::<f64>();
    // Turns grow and weights fall with the spread 1 - sigma.
    let (mut low, mut high) = (0.0, 1.0);
    while total(high) > attitude_weight {
        (low, high) = (high, 2.0 * high);
        if high > 1e6 {
            return Err(UnscentedError::TooBroad(attitude_weight));
        }
    }
    for _ in 0..BISECTIONS {
        let middle = 0.5 * (low + high);
        if middle <= low || middle >= high {
            break;
        }
        if total(middle) > attitude_weight { low = middle } else { high = middle }
    }
    let found = versines(high);
    if found.iter().any(|v| *v > 2.0) {
        return Err(UnscentedError::TooBroad(attitude_weight));
    }
    Ok((found, weights(&found)))
}

/// `1 - cos t_i` of (4.46) for the spread `1 - sigma`; above 2 where no turn is that large.
fn turn_versines(fisher: &MatrixFisher, spread: f64) -> [f64; 3] {
    let fall = -fisher.moments().log_c_scaled();
    let (s, log_c) = (fisher.svd().s, fisher.moments().log_c());
    let a = sums_of_singular_values(&s);
    std::array::from_fn(|i| {
        if a[i] >= 1.0 {
            spread * fall / a[i]
        } else {
            1.5 - a[i] * (1.5 - spread * (1.0 - (log_c - s[i])))
        }
    })
}

#[cfg(test)]
mod tests {
    use nalgebra::{Const, OMatrix};
    use proptest::prelude::*;

    use super::super::matrix_fisher_gaussian::Correlation;
    use super::*;

    fn fisher(s: [f64; 3]) -> MatrixFisher {
        let (u, v) = (exp(&Vector3::new(0.4, -1.0, 0.7)), exp(&Vector3::new(-2.0, 0.3, 0.1)));
        MatrixFisher::from_svd(ProperSvd { u, s: Vector3::from(s), v }).unwrap()
    }

    const CASES: [[f64; 3]; 8] = [
        [5.0, 5.0, 5.0],
        [25.0, 5.0, 1.0],
        [100.0, 60.0, 40.0],
        [1e6, 1e5, 1e4],
        [10.0, 3.0, -1.0],
        [2.0, 1.0, 0.5],
        [0.5, 0.3, 0.1],
        [50.0, 0.2, 0.1],
    ];

    #[test]
    fn weighted_points_carry_the_mean() {
        for s in CASES {
            let fisher = fisher(s);
            for weight in [0.6, 0.9] {
                let Ok(points) = weighted_points(&fisher, weight) else {
                    assert!(s[0] < 3.0 || s[1] < 1.0, "{s:?} {weight}");
                    continue;
                };
                let total: f64 = points.iter().map(|p| p.weight).sum();
                assert!((total - 1.0).abs() < 1e-12);
                assert!((mean_rotation(&points) - fisher.mean()).amax() < 1e-12, "{s:?}");
                let turned: f64 = points[..6].iter().map(|p| p.weight).sum();
                assert!((turned - weight).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn bingham_points_carry_any_mean() {
        for s in CASES {
            let fisher = fisher(s);
            for share in [0.2, 0.5, 1.0] {
                let points = bingham_points(&fisher.mean(), share).unwrap();
                assert!((mean_rotation(&points) - fisher.mean()).amax() < 1e-14, "{s:?}");
                assert!(points.iter().all(|p| p.weight >= 0.0));
            }
        }
        assert!(bingham_points(&Matrix3::zeros(), 0.5).is_ok());
    }

    #[test]
    fn seven_points_have_one_density_and_are_inverted() {
        for s in [[5.0, 5.0, 5.0], [25.0, 5.0, 1.0], [100.0, 60.0, 40.0], [1e4, 1e3, 100.0]] {
            let fisher = fisher(s);
            let points = seven_points(&fisher, 0.9).unwrap();
            let densities = points[..6].iter().map(|p| fisher.log_density(&p.attitude));
            let first = fisher.log_density(&points[0].attitude);
            assert!(densities.into_iter().all(|d| (d - first).abs() < 1e-9 * (1.0 + first.abs())));
            let mean = mean_rotation(&points);
            let found = matrix_fisher_of_seven(&mean, 0.9).unwrap();
            let error = (found.parameter() - fisher.parameter()).norm();
            assert!(error < 1e-9 * s[0], "{s:?} {error}");
        }
    }

    #[test]
    fn what_cannot_be_spread_is_refused() {
        let fisher = fisher([5.0, 5.0, 5.0]);
        assert!(seven_points(&fisher, 1.0).is_err());
        assert!(weighted_points(&fisher, 0.0).is_err());
        assert!(bingham_points(&fisher.mean(), 0.0).is_err());
        assert!(matrix_fisher_of_seven(&Matrix3::identity(), 0.9).is_err());
        let uniform = MatrixFisher::uniform();
        assert!(matches!(weighted_points(&uniform, 0.1), Err(UnscentedError::TooBroad(_))));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(50))]

        /// Theorem 4.7.
        #[test]
        fn points_of_a_matrix_fisher_gaussian_are_inverted(
            exponent in 0.7..5.0f64, p in prop::array::uniform9(-0.1..0.1f64),
        ) {
            let scale = 10f64.powf(exponent);
            let attitude = fisher([3.0 * scale, 2.0 * scale, scale]);
            let p = OMatrix::<f64, Const<3>, U3>::from_column_slice(&p) / scale.sqrt();
            for correlation in [Correlation::World, Correlation::Body] {
                let belief = MatrixFisherGaussian::new(
                    attitude, Vector3::new(1.0, 2.0, 3.0), Matrix3::identity(), p, correlation,
                ).unwrap();
                let points = belief.sigma_points(0.5, 0.4).unwrap();
                prop_assert_eq!(points.len(), 13);
                let found = MatrixFisherGaussian::from_samples(&points, correlation).unwrap();
                prop_assert!((found.mu() - belief.mu()).norm() < 1e-10);
                prop_assert!((found.sigma() - belief.sigma()).norm() < 1e-9);
                let f = belief.attitude().parameter();
                prop_assert!((found.attitude().parameter() - f).norm() < 1e-10 * scale * f.norm());
            }
        }
    }
}
