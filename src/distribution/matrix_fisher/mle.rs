//! The inverse problem: singular values from moments.
//!
//! The moments `m_i = E[x_i^2]` of the quaternion are, where the distribution is concentrated,
//! close to `1/(4 a_i)`. Newton's method on `1/(4 m_i(a)) = 1/(4 m_i)` is therefore almost linear
//! there, and well scaled everywhere: in the unknowns `eta_i = m_i da_i` its matrix is the
//! correlation `Cov[x_i^2, x_j^2]/(m_i m_j)`. From the guess below it took at most 9 steps for each of
//! 20,000 random admissible moments, down to 1e-14 and with ties of every kind.

use nalgebra::{Matrix3, Vector3};

use super::first::FirstMoments;
use super::moments::Moments;
use super::sums::Sums;

/// Steps before giving up; at most 9 were ever needed.
const MAX_STEPS: usize = 40;
/// An error below this, relative to the scale of each unknown, ends the iteration.
const SMALL_ERROR: f64 = 1e-14;
/// Steps below this are taken to converge quadratically, with the constant of the last two.
const QUADRATIC: f64 = 0.1;
/// Moments that differ by less, in the wrong order, count as equal.
const TIE: f64 = 1e-14;
/// Smaller moments belong to concentrations that overflow.
const MIN_SQUARE: f64 = 1e-100;
/// A sum above one is not reduced by more than this factor in one step.
const MIN_RATIO: f64 = 0.1;

/// Why no matrix Fisher distribution has the given moments.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum MomentError {
    /// A moment is not finite.
    #[error("moments must be finite, not {0:?}")]
    NotFinite([f64; 3]),
    /// Not `d1 >= d2 >= |d3|`.
    #[error("moments must satisfy d1 >= d2 >= |d3|, not {0:?}")]
    NotOrdered([f64; 3]),
    /// On or outside the boundary of the tetrahedron of moments, `1 + d3 > d1 + d2`.
    #[error("no distribution has the moments {0:?}: 1 - d1 - d2 + d3 must be positive")]
    NotAdmissible([f64; 3]),
    /// The iteration ended without reaching its tolerance.
    #[error("no singular values found for the moments {moments:?}: last step {step:e}")]
    NotConverged { moments: [f64; 3], step: f64 },
}

/// `S` with `E[Q] = diag(d)`, for `d1 >= d2 >= |d3|` (the MLE of the concentrations, 2.20).
///
/// Where `d` is close to one, use [`s_from_complement`], which does not lose the digits of
/// `1 - d`.
///
/// ```
/// # use mfg_vio::distribution::matrix_fisher::{Moments, s_from_d};
/// # use nalgebra::Vector3;
/// let s = Vector3::new(30.0, 4.0, -2.0);
/// let found = s_from_d(&Moments::new(&s)?.first())?;
/// assert!((found - s).norm() < 1e-11);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn s_from_d(d: &Vector3<f64>) -> Result<Vector3<f64>, MomentError> {
    s_from_complement(&d.map(|d| 1.0 - d))
}

/// `S` with `1 - E[Q_ii] = g_i`, for `g1 <= g2 <= min(g3, 2 - g3)`.
pub fn s_from_complement(g: &Vector3<f64>) -> Result<Vector3<f64>, MomentError> {
    let target = squares_of_complement(g)?;
    solve(&target, initial(&target))
        .map(|sums| sums.singular_values())
        .map_err(|error| error.with_moments(g.map(|g| 1.0 - g).into()))
}

/// `E[x_i^2]` from `1 - d`, checked.
fn squares_of_complement(g: &Vector3<f64>) -> Result<[f64; 3], MomentError> {
    let d = g.map(|g| 1.0 - g);
    if !g.iter().all(|x| x.is_finite()) {
        return Err(MomentError::NotFinite(d.into()));
    }
    // Compared in the complement, where close moments keep their order; ties up to rounding.
    if !(g[0] <= g[1] + TIE && g[1] <= g[2] + TIE && g[1] + g[2] <= 2.0 + TIE) {
        return Err(MomentError::NotOrdered(d.into()));
    }
    let squares = [g[1] + g[2] - g[0], g[0] + g[2] - g[1], g[0] + g[1] - g[2]].map(|m| 0.25 * m);
    if !squares.iter().all(|&m| m > MIN_SQUARE) {
        return Err(MomentError::NotAdmissible(d.into()));
    }
    Ok(squares)
}

impl FirstMoments {
    /// `S` with `1 - E[Q_ii] = g_i`, for `g1 <= g2 <= min(g3, 2 - g3)`: as
    /// [`s_from_complement`](super::s_from_complement) finds it, with the first of Newton's steps
    /// from here, for which everything is known.
    pub fn neighbour(&self, g: &Vector3<f64>) -> Result<Vector3<f64>, MomentError> {
        s_from_complement_at(g, *self)
    }
}

impl MomentError {
    fn with_moments(self, d: [f64; 3]) -> Self {
        match self {
            Self::NotConverged { step, .. } => Self::NotConverged { moments: d, step },
            other => other,
        }
    }
}

/// `S` from `E[x_i^2]`, `i = 1, 2, 3`, of the unit quaternion of `Q`: in descending order and
/// none above `E[x_0^2]`. The best conditioned form of the problem: each moment may be accurate
/// in relative terms.
pub fn s_from_quaternion_squares(squares: &Vector3<f64>) -> Result<Vector3<f64>, MomentError> {
    let target: [f64; 3] = (*squares).into();
    if !target.iter().all(|m| m.is_finite()) {
        return Err(MomentError::NotFinite(target));
    }
    let scalar = 1.0 - squares.sum();
    let ordered = target[0] <= scalar + TIE && target.is_sorted_by(|a, b| *b <= a + TIE);
    if !ordered {
        return Err(MomentError::NotOrdered(target));
    }
    if !target.iter().all(|&m| m > MIN_SQUARE) {
        return Err(MomentError::NotAdmissible(target));
    }
    solve(&target, initial(&target)).map(|sums| sums.singular_values())
}

/// [`s_from_complement`] started from a neighbouring solution, as a filter has it from its last
/// step with all moments that Newton's first step needs; falls back to the cold start where that
/// fails.
pub fn s_from_complement_near(
    g: &Vector3<f64>,
    neighbour: &Moments,
) -> Result<Vector3<f64>, MomentError> {
    s_from_complement_at(g, neighbour.up_to_second())
}

/// The same from moments up to the second order.
pub(super) fn s_from_complement_at(
    g: &Vector3<f64>,
    neighbour: FirstMoments,
) -> Result<Vector3<f64>, MomentError> {
    let target = squares_of_complement(g)?;
    solve(&target, neighbour)
        .or_else(|_| solve(&target, initial(&target)))
        .map(|sums| sums.singular_values())
        .map_err(|error| error.with_moments(g.map(|g| 1.0 - g).into()))
}

/// A guess that is exact to leading order at the uniform and at the concentrated end of each
/// degree of freedom; for one degree it is the usual `k = A (2 - A^2)/(1 - A^2)` of the circle.
fn initial(target: &[f64; 3]) -> FirstMoments {
    let scalar = 1.0 - target.iter().sum::<f64>();
    let guess = target.map(|m| {
        let contrast = ((scalar - m) / (scalar + m)).max(0.0);
        let spread = (1.0 - contrast * contrast).powi(2);
        (scalar - m).max(0.0) / (4.0 * m * scalar) * (1.0 + 2.0 * scalar * spread)
    });
    FirstMoments::of(Sums::new(ordered(guess)))
}

/// Raises entries to their predecessors.
fn ordered([a1, a2, a3]: [f64; 3]) -> [f64; 3] {
    let a2 = a2.max(a1);
    [a1, a2, a3.max(a2)]
}

fn solve(target: &[f64; 3], start: FirstMoments) -> Result<Sums, MomentError> {
    let mut at = start;
    let mut size = f64::INFINITY;
    for _ in 0..MAX_STEPS {
        let Some(step) = newton_step(target, &at) else { break };
        let previous = std::mem::replace(&mut size, step.amax);
        let next = ordered(std::array::from_fn(|i| limited_step(at.sums.a[i], step.da[i])));
        if error_after(size, previous) < SMALL_ERROR {
            return Ok(Sums::new(next));
        }
        at = FirstMoments::of(Sums::new(next));
    }
    Err(MomentError::NotConverged { moments: *target, step: size })
}

/// What a step leaves behind: its square, or less where the one before shows it.
fn error_after(step: f64, previous: f64) -> f64 {
    let constant = if previous < QUADRATIC { step / (previous * previous) } else { 1.0 };
    constant.min(1.0) * step * step
}

/// Sums are not negative, and one step does not leap from concentrated to diffuse.
fn limited_step(a: f64, da: f64) -> f64 {
    let floor = if a > 1.0 { MIN_RATIO * a } else { 0.0 };
    (a + da).max(floor)
}

struct Step {
    da: [f64; 3],
    /// Largest component relative to the scale `1/m_i` of its unknown.
    amax: f64,
}

fn newton_step(target: &[f64; 3], at: &FirstMoments) -> Option<Step> {
    let m = at.squares;
    let correlation = Matrix3::from_fn(|i, j| at.products[i][j] / (m[i] * m[j]) - 1.0);
    let residual = Vector3::from_fn(|i, _| 0.5 * (m[i] / target[i] - 1.0));
    let eta = correlation.cholesky()?.solve(&residual);
    Some(Step { da: std::array::from_fn(|i| eta[i] / m[i]), amax: eta.amax() })
}
