//! Rotations: exponential and logarithm, Jacobians, proper singular values, quaternions,
//! Haar sampling and quadrature on SO(3).
//!
//! A rotation is a [`nalgebra::Rotation3<f64>`]. Its tangent vectors are rotation vectors in
//! radians, `hat` maps them to skew-symmetric matrices, and perturbations multiply on the right
//! (body frame) unless a function says otherwise. Equation numbers are those of W22 (Wang's
//! dissertation of 2022 on the matrix Fisher-Gaussian distribution).
//!
//! Two things here need more care than textbooks give them. The logarithm goes through the unit
//! quaternion, which keeps all digits near the half turn, where the trace formula loses half of
//! them. The [proper singular value decomposition](ProperSvd) is a one-sided Jacobi iteration: it
//! always ends, its factors are orthogonal to rounding whatever the singular values, and it needs
//! no case distinction for repeated ones.

mod exponential;
mod haar;
mod polar;
mod proper_svd;
mod quaternion;

pub use exponential::{
    exp, hat, left_jacobian, left_jacobian_inverse, log, right_jacobian, right_jacobian_inverse,
    vee,
};
pub use haar::{HaarQuadrature, sample_haar};
pub use polar::proper_polar;
pub use proper_svd::{NotFinite, ProperSvd, project_to_so3, proper_svd};
pub use quaternion::{
    isoclinic_decomposition, left_isoclinic, quaternion_from_rotation, quaternion_product,
    right_isoclinic, rotation_from_quaternion,
};
