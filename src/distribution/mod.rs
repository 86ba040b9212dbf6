//! Probability distributions on SO(3) and SO(3) x R^n.
//!
//! A short course, in the order in which to read it:
//!
//! 1. [`matrix_fisher`]: the "Gaussian" of attitudes, exact from the uniform distribution to the
//!    limits of double precision.
//! 2. [`Bingham`]: the same distribution, written on unit quaternions.
//! 3. [`VonMisesFisher`]: measured directions; [`ConcentratedGaussian`]: the Gaussian of rotation
//!    vectors, wrapped around SO(3).
//! 4. [`matrix_fisher_gaussian`]: attitude and vector together, correlated;
//!    [`BinghamGaussian`] is its twin on quaternions.
//! 5. [`rotation_quadratic`], [`regression`]: what Gaussian measurements make of these.
//! 6. [`unscented`]: a handful of weighted points that stand for any of these; [`progressive`]
//!    updates with them.
//!
//! What they look like, up to constants, for a rotation `R`, a unit quaternion `q`, a direction `y`
//! and a vector `x`:
//!
//! ```math
//! \text{matrix Fisher} \quad & \exp(\tr(F^\top R)) & (2.16) \\
//! \text{Bingham} \quad & \exp(q^\top A q) & (2.24) \\
//! \text{von Mises-Fisher} \quad & \exp(\kappa m^\top y) & (4.3) \\
//! \text{matrix Fisher-Gaussian} \quad & \exp(\tr(F^\top R) -
//!   \frac{1}{2} (x - \mu - P v_R)^\top \Sigma_c^{-1} (x - \mu - P v_R)) & (3.1)
//! ```
//!
//! Densities are with respect to the uniform distribution on the rotations (spheres) and to
//! Lebesgue measure on vectors. Short names of sources: **W22**, W. Wang, *Matrix Fisher-Gaussian
//! distribution* (dissertation, 2022); **L-UAE**, T. Lee, *Global unscented attitude estimation
//! via the matrix Fisher distributions on SO(3)*; **L-AMF**, T. Lee, *Bayesian attitude estimation
//! with approximate matrix Fisher distributions on SO(3)*; **FNF**, Wang, Gui, Zhong on fast
//! nonlinear filtering. Bare numbers in parentheses are equations of W22.
#![doc = include_str!("../../docs/math.html")]

mod bingham;
mod bingham_gaussian;
mod circle;
mod concentrated_gaussian;
pub mod matrix_fisher;
pub mod matrix_fisher_gaussian;
pub mod progressive;
pub mod regression;
pub mod rotation_quadratic;
pub mod unscented;
mod von_mises_fisher;

pub use bingham::{Bingham, BinghamError, BinghamSampler};
pub use bingham_gaussian::{BinghamGaussian, BinghamGaussianError};
pub use concentrated_gaussian::{ConcentratedGaussian, NotPositiveDefinite};
pub use von_mises_fisher::{VonMisesFisher, VonMisesFisherError};
