//! What an update changes of the world that is kept outside of a filter.

use nalgebra::{Isometry3, UnitQuaternion};

/// How an update changed what is kept in world coordinates outside of the filter: first the world
/// turns, then the map follows the camera.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct FrameChange {
    /// Turn of the world about its origin, where gravity was levelled.
    pub world_turn: Option<UnitQuaternion<f64>>,
    /// What the camera's estimated mounting has moved by, in body coordinates: points that were
    /// placed by it from about here move with it.
    pub camera_moved: Option<Isometry3<f64>>,
}
