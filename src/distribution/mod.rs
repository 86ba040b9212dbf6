//! Probability distributions on SO(3) and SO(3) x R^n.

mod circle;
pub mod matrix_fisher;
