use std::sync::Arc;

use nalgebra::{Isometry3, Matrix3, Vector2, Vector3};

use crate::vision::{Descriptor, Patch};

/// A point of the world and what it looks like.
#[derive(Debug, Clone, PartialEq)]
pub struct MapPoint {
    /// Unique in its map; later points have higher ids.
    pub id: u64,
    /// World coordinates, m.
    pub position: Vector3<f64>,
    /// Covariance of `position` in world coordinates, m^2.
    pub covariance: Matrix3<f64>,
    /// As last seen.
    pub descriptor: Descriptor,
    /// What later views are aligned with.
    pub reference: Option<ReferenceView>,
    /// Unit vector from the camera that last saw it to the point, world coordinates.
    pub view_direction: Vector3<f64>,
    /// Frame numbers.
    pub first_seen: u64,
    pub last_seen: u64,
    /// Frames that it was seen in.
    pub observations: u32,
    /// Whether it stays however long it is not seen: the filter's state refers to it.
    pub held: bool,
}

/// How a point looked from one place.
#[derive(Debug, Clone, PartialEq)]
pub struct ReferenceView {
    pub patch: Arc<Patch>,
    /// The point relative to the centre of the patch, pixels of the patch's level.
    pub offset: Vector2<f64>,
    /// Pixels of the full image a pixel of that level.
    pub scale: f64,
    /// Pose of the camera as it was believed to be.
    pub world_from_camera: Isometry3<f64>,
}

/// A sighting of a point in one frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Sighting {
    /// Frame number.
    pub frame: u64,
    /// Position of the camera in world coordinates, m.
    pub camera: Vector3<f64>,
    pub descriptor: Descriptor,
    /// To be kept for the alignment of later views; `None` keeps the one there is.
    pub reference: Option<ReferenceView>,
}
