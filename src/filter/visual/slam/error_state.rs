//! In what coordinates the filters have their errors.

use std::ops::Range;

/// Blocks of the Euclidean part that are no vectors of the world but of the body.
pub(super) const BIASES: Range<usize> = 2..4;

/// In what coordinates a filter has its errors.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ErrorState {
    /// The right-invariant error, that of common turns and moves: with `R = exp(t^) R_hat` a world
    /// vector is `y = exp(t^) y_hat + J(t) (B t + noise)`, `J` the left Jacobian of SO(3). A common
    /// turn of body and map is `t` alone, under which this form keeps its parameters: turning what
    /// cannot be observed changes nothing that is measured. A vector that does not turn with the
    /// body has `B t = y_hat x t` and, by `J(t) t^ = exp(t^) - I`, stays exactly where it is.
    RightInvariant { density: AttitudeDensity },
    /// The error on SO(3) x R^n, as an extended Kalman filter has it: the rotation vector `e` at the
    /// estimate, and `y = y_hat + B e + noise`.
    So3xRn,
}

/// What the density of the rotation is where the error is right-invariant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AttitudeDensity {
    /// Matrix Fisher; the Euclidean part is regressed on the sine of `t`, which is linear in `R`.
    MatrixFisher,
    /// Gaussian in `t`, on which the Euclidean part is regressed.
    Gaussian,
}

impl ErrorState {
    /// Whether a common turn of body and map is an error of the rotation alone.
    pub fn is_invariant(self) -> bool {
        matches!(self, Self::RightInvariant { .. })
    }

    /// Whether the rotation has a matrix Fisher density.
    pub fn is_matrix_fisher(self) -> bool {
        matches!(self, Self::RightInvariant { density: AttitudeDensity::MatrixFisher })
    }
}
