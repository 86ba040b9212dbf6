//! Trajectory error and consistency.
