//! The papers' numerical studies, as functions that return plain values.

pub mod matrix_fisher;
