//! Rotations: exponential and logarithm, Jacobians, proper singular values, quaternions,
//! Haar sampling and quadrature on SO(3).
//!
//! A rotation is a [`nalgebra::Rotation3<f64>`]. Its tangent vectors are rotation vectors in
//! radians, `hat` maps them to skew-symmetric matrices, and perturbations multiply on the right
//! (body frame) unless a function says otherwise. Equation numbers are those of W22 (Wang's
//! dissertation of 2022 on the matrix Fisher-Gaussian distribution).
//!
//! # Exponential map
//!
//! Rodrigues' formula (2.6) for a rotation vector `v` of length `t`, and the Jacobian that carries
//! small changes of `v` to rotations on the left:
//!
//! ```math
//! \exp(\hat v) &= I + \frac{\sin t}{t} \hat v + \frac{1 - \cos t}{t^2} \hat v^2 , \\
//! \exp((v + \delta)^\wedge) &\approx \exp((J_l(v) \delta)^\wedge) \exp(\hat v) , \\
//! J_l(v) &= I + \frac{1 - \cos t}{t^2} \hat v + \frac{t - \sin t}{t^3} \hat v^2 , \qquad
//! J_r(v) = J_l(-v) .
//! ```
//!
//! # Proper singular values
//!
//! Definition 2.1: factors in SO(3), the sign of the determinant in the third singular value. The
//! rotation closest to `F` is the proper polar factor `U V^T`.
//!
//! ```math
//! F = U S V^\top , \qquad U, V \in \mathrm{SO}(3) , \qquad s_1 \ge s_2 \ge |s_3| .
//! ```
//!
//! # Quaternions
//!
//! The homomorphism (2.33) of a unit quaternion with scalar part `q_0` and vector part `w`, and how
//! traces measure angles between quaternions (2.34):
//!
//! ```math
//! R(q) = (q_0^2 - w^\top w) I + 2 w w^\top + 2 q_0 \hat w , \qquad
//! \tr(R(p) R(q)^\top) = 4 (p^\top q)^2 - 1 .
//! ```
//!
//! # Uniform distribution
//!
//! [`sample_haar`] draws from it and [`HaarQuadrature`] integrates with respect to it, exactly for
//! polynomials in the entries of `R`:
//!
//! ```math
//! \int_{\mathrm{SO}(3)} f(R) \, dR = \frac{1}{8 \pi^2} \int_0^{2 \pi} \int_0^{\pi} \int_0^{2 \pi}
//!   f(R_z(\alpha) R_y(\beta) R_z(\gamma)) \sin \beta \, d\alpha \, d\beta \, d\gamma .
//! ```
//!
//! # Numerics
//!
//! Two things here need more care than textbooks give them. The logarithm goes through the unit
//! quaternion, which keeps all digits near the half turn, where the trace formula loses half of
//! them. The [proper singular value decomposition](ProperSvd) is a one-sided Jacobi iteration: it
//! always ends, its factors are orthogonal to rounding whatever the singular values, and it needs
//! no case distinction for repeated ones.
#![doc = include_str!("../../docs/math.html")]

mod exponential;
mod haar;
mod polar;
mod principal_axes;
mod proper_svd;
mod quaternion;

pub use exponential::{
    angle_between, exp, hat, left_jacobian, left_jacobian_inverse, log, right_jacobian,
    right_jacobian_inverse, vee,
};
pub use haar::{HaarQuadrature, sample_haar};
pub(crate) use polar::cofactors;
pub use polar::proper_polar;
pub use principal_axes::principal_axes;
pub use proper_svd::{NotFinite, ProperSvd, project_to_so3, proper_svd};
pub use quaternion::{
    isoclinic_decomposition, left_isoclinic, quaternion_from_rotation, quaternion_product,
    right_isoclinic, rotation_from_quaternion,
};
