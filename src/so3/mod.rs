//! Rotations: exponential and logarithm, Jacobians, proper decompositions.
