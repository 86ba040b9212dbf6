//! Pose of one point set relative to another.
