//! Probability distributions on SO(3) and SO(3) x R^n.
