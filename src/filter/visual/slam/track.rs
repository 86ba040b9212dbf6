//! Tracks: what one physical point showed to a window of past poses, and what an update made of it.

use nalgebra::{Isometry3, Matrix2, Matrix6, Point2, Vector3};

use crate::alignment::MapEstimate;
use crate::filter::core::FilterError;
use crate::filter::visual::frame_change::FrameChange;
use crate::sensor::Camera;

/// A pose of the window. Never given twice by one filter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct CloneId(pub(super) u64);

/// A camera of the body. Its error, where the filter estimates the camera's calibration, is that of
/// [`VisualInertialFilter::calibration`](crate::filter::VisualInertialFilter::calibration): all
/// cameras move with the first one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MountedCamera {
    /// Projection of points in camera coordinates.
    pub camera: Camera,
    /// Camera to body coordinates.
    pub body_from_camera: Isometry3<f64>,
}

impl MountedCamera {
    /// The one of this index.
    pub(in crate::filter::visual) fn among(
        cameras: &[Self],
        camera: usize,
    ) -> Result<&Self, FilterError> {
        cameras.get(camera).ok_or(FilterError::UnknownCamera { camera, cameras: cameras.len() })
    }
}

/// Depth of a point in one view, by whatever measures it other than the pixels of the track.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackDepth {
    /// What [`Camera::depth_of`] means, m.
    pub depth: f64,
    /// Variance of what differs from view to view, m^2.
    pub variance: f64,
    /// Variance of what is alike in all views of the track (warp of the sensor, registration, edge of
    /// the footprint), m^2: two views' depths have the covariance `sqrt(v_1 v_2)`.
    pub common_variance: f64,
}

/// What one camera showed of a point from one pose of the window.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackView {
    pub clone: CloneId,
    /// Index into the cameras given with the tracks.
    pub camera: usize,
    /// In the image as taken, px.
    pub pixel: Point2<f64>,
    /// px^2. Zero for the view that defines the point, as a patch does to which later ones are
    /// aligned: it has no error of its own.
    pub pixel_covariance: Matrix2<f64>,
    pub depth: Option<TrackDepth>,
}

/// What becomes of a track's point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrackUse {
    /// The point is eliminated: what its rows say of the poses is used, and nothing is kept of it.
    Eliminate,
    /// The point enters the state, where a slot is free; else it is eliminated.
    Admit,
}

/// What one physical point showed since its rows were last used.
///
/// A track whose id is that of a point of the state measures that point; the depths of its views are
/// not used then, as the point has them in it already. Any other is a point of its own: one that is
/// found again after its rows were used is a new point.
#[derive(Debug, Clone, PartialEq)]
pub struct Track {
    pub id: u64,
    pub views: Vec<TrackView>,
    pub purpose: TrackUse,
}

/// What an update made of a track.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TrackOutcome {
    /// Its rows were used, and must not be offered again. For prediction alone: where its point was
    /// found to be (world coordinates before the update's [`FrameChange`], m).
    Used { position: Vector3<f64> },
    /// So were its rows, and the point is part of the state
    /// ([`PointState`](crate::filter::PointState)) under the track's id.
    Admitted,
    /// The update had rows enough: nothing of the track was used. It may be offered again as long as
    /// its poses are in the window.
    Deferred,
    /// Nothing of the track was used.
    Refused(FilterError),
}

impl TrackOutcome {
    /// Whether the track's residual was improbable.
    pub fn is_improbable(&self) -> bool {
        matches!(self, Self::Refused(FilterError::ImprobableTrack { .. }))
    }
}

/// What an update by tracks did, besides changing the belief.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TrackUpdate {
    /// One for each track offered, in their order.
    pub outcomes: Vec<TrackOutcome>,
    /// Rows that entered, after elimination of the points.
    pub rows: usize,
    /// Normalised innovation squared (NIS) per row that entered; about 1 when consistent, 0
    /// without rows.
    pub nis: f64,
    /// Whether most of the tracks that the present pose sees contradicted the prediction: its
    /// covariance was inflated by what an IMU may do wrong, unless even that did not help.
    pub contradicted: bool,
    pub frame: FrameChange,
}

impl TrackUpdate {
    /// How many tracks were left out because their residual was improbable.
    pub fn improbable(&self) -> usize {
        self.outcomes.iter().filter(|outcome| outcome.is_improbable()).count()
    }
}

/// A pose of the window as the filter believes it now.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClonedPose {
    pub world_from_body: Isometry3<f64>,
    /// Of the rotation vector at the estimate (body coordinates, rad) and of the position (world
    /// coordinates, m).
    pub covariance: Matrix6<f64>,
}

/// A window of cloned poses as part of a filter's state, and tracks of points seen from them.
///
/// A frame of a pipeline: propagate to the frame, [`Self::clone_pose`], [`Self::update_tracks`] with
/// the tracks that ended, that are long enough to enter, and that show points of the state, then
/// [`Self::drop_clone`] of the poses that are to leave. Before a pose leaves, tracks whose rows at it
/// are to count must have been used.
pub trait PoseWindow {
    /// Takes an exact copy of the present pose into the state: of the pose `later` seconds after it
    /// (negative: before), to which the body is moved at its present angular velocity and velocity.
    /// Zero for the pose as it is.
    fn clone_pose(&mut self, later: f64) -> Result<CloneId, FilterError>;

    /// The poses of the window, oldest first.
    fn clones(&self) -> Vec<CloneId>;

    /// A pose of the window; `None` if it has left.
    fn cloned_pose(&self, id: CloneId) -> Option<ClonedPose>;

    /// Marginalises a pose out: what the belief learned by it stays, rows at it can no longer be
    /// used. False if it has left already.
    fn drop_clone(&mut self, id: CloneId) -> bool;

    /// Where a track's point is (world coordinates), given the poses of the window and `cameras`,
    /// with the covariance that the track's own errors leave: for prediction and to choose tracks. It
    /// changes nothing and uses no row.
    fn triangulate(
        &self,
        track: &Track,
        cameras: &[MountedCamera],
    ) -> Result<MapEstimate, FilterError>;

    /// Conditions the belief on tracks, in the order given until the rows of one update
    /// (`filter.track_rows`) are reached; the others are [`TrackOutcome::Deferred`].
    ///
    /// A row (a view of a track) is used once: offered again, its track is refused with
    /// [`FilterError::RowUsedTwice`]. An error of the whole update leaves the belief, and what
    /// counts as used, as it was; that nothing entered is no error.
    fn update_tracks(
        &mut self,
        tracks: &[Track],
        cameras: &[MountedCamera],
    ) -> Result<TrackUpdate, FilterError>;
}
