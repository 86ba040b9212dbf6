//! Rerun recordings; everything that mentions `rerun` is here.
