//! Poses, paths and cameras: what moves in space.

use nalgebra::{Isometry3, Vector3};
use rerun::components::{FillMode, Radius};
use rerun::{
    Ellipsoids3D, LineStrips3D, Pinhole, Quaternion, RecordingStream, RecordingStreamResult,
    TextLog, TextLogLevel, Transform3D, TransformAxes3D, ViewCoordinates,
};

use super::covariance::{diagonal_block, principal_axes};
use crate::inertial::block;
use crate::odometry::{Note, NoteLevel, StepReport};
use crate::sensor::{Camera, PinholeCamera};

pub(super) const WORLD: &str = "world";
pub(super) const IMAGE: &str = "world/estimate/body/camera/image";
pub(super) const COLOR: &str = "world/estimate/body/camera/image/color";
pub(super) const DEPTH: &str = "world/estimate/body/camera/image/depth";
pub(super) const KEYPOINTS: &str = "world/estimate/body/camera/image/keypoints";
pub(super) const TRAJECTORIES: [&str; 2] = [ESTIMATE_TRAJECTORY, TRUTH_TRAJECTORY];
pub(super) const ESTIMATE_BODY: &str = "world/estimate/body";
pub(super) const LOG: &str = "log";

const ESTIMATE_CAMERA: &str = "world/estimate/body/camera";
const ESTIMATE_TRAJECTORY: &str = "world/estimate/trajectory";
const COVARIANCE: &str = "world/estimate/covariance";
const TRUTH_BODY: &str = "world/truth/body";
const TRUTH_TRAJECTORY: &str = "world/truth/trajectory";
const TRUTH_CAMERA: &str = "world/truth/body/camera";
const TRUTH_FRUSTUM: &str = "world/truth/body/camera/frustum";

pub(super) const ESTIMATE_COLOR: [u8; 3] = [255, 160, 60];
pub(super) const TRUTH_COLOR: [u8; 3] = [120, 210, 255];

/// Length of the drawn axes of a body, m.
const AXES_LENGTH: f32 = 0.2;
/// Distance at which the image plane is drawn in space, m.
const IMAGE_PLANE_DISTANCE: f32 = 0.4;
/// Poses that make up one piece of a path. Pieces are never written again, so that the recording
/// grows in proportion to its duration.
const POSES_PER_PIECE: usize = 10;

/// Colors, radii and coordinate conventions, once for the whole recording.
pub(super) fn log_styles(stream: &RecordingStream) -> RecordingStreamResult<()> {
    stream.log_static(WORLD, &ViewCoordinates::RIGHT_HAND_Z_UP())?;
    for body in [ESTIMATE_BODY, TRUTH_BODY] {
        stream.log_static(body, &TransformAxes3D::new(AXES_LENGTH))?;
    }
    for (trajectory, color) in
        [(ESTIMATE_TRAJECTORY, ESTIMATE_COLOR), (TRUTH_TRAJECTORY, TRUTH_COLOR)]
    {
        let style = LineStrips3D::update_fields()
            .with_colors([color])
            .with_radii([Radius::new_ui_points(1.5)]);
        stream.log_static(trajectory, &style)?;
    }
    let style = Ellipsoids3D::update_fields()
        .with_colors([ESTIMATE_COLOR])
        .with_fill_mode(FillMode::TransparentFillMajorWireframe);
    stream.log_static(COVARIANCE, &style)
}

pub(super) fn log_camera(
    stream: &RecordingStream,
    camera: &Camera,
    imu_from_camera: &Isometry3<f64>,
    [width, height]: [usize; 2],
    truth: bool,
) -> RecordingStreamResult<()> {
    let PinholeCamera { fx, fy, cx, cy } = *camera.intrinsics();
    let [fx, fy, cx, cy] = [fx, fy, cx, cy].map(|x| x as f32);
    // Rerun's pixel coordinates are those of the top left corner of a pixel, ours of its centre.
    let columns = [[fx, 0.0, 0.0], [0.0, fy, 0.0], [cx + 0.5, cy + 0.5, 1.0]];
    let pinhole = Pinhole::new(columns)
        .with_resolution([width as f32, height as f32])
        .with_camera_xyz(rerun::components::ViewCoordinates::RDF)
        .with_image_plane_distance(IMAGE_PLANE_DISTANCE);
    stream.log_static(ESTIMATE_CAMERA, &transform(imu_from_camera))?;
    stream.log_static(IMAGE, &pinhole.clone().with_color(ESTIMATE_COLOR))?;
    if truth {
        stream.log_static(TRUTH_CAMERA, &transform(imu_from_camera))?;
        stream.log_static(TRUTH_FRUSTUM, &pinhole.with_color(TRUTH_COLOR))?;
    }
    Ok(())
}

/// What has to be remembered from one frame to the next.
#[derive(Default)]
pub(super) struct Scene {
    estimate: Path,
    truth: Path,
}

impl Scene {
    /// Poses, paths and covariance, at the stream's current time.
    pub(super) fn log_report(
        &mut self,
        stream: &RecordingStream,
        report: &StepReport,
        truth: Option<&Isometry3<f64>>,
    ) -> RecordingStreamResult<()> {
        let pose = &report.state.world_from_body;
        stream.log(ESTIMATE_BODY, &transform(pose))?;
        if let Some(piece) = self.estimate.extend(pose) {
            stream.log(ESTIMATE_TRAJECTORY, &strip(piece))?;
        }
        if let Some(pose) = truth {
            stream.log(TRUTH_BODY, &transform(pose))?;
            if let Some(piece) = self.truth.extend(pose) {
                stream.log(TRUTH_TRAJECTORY, &strip(piece))?;
            }
        }
        let covariance = diagonal_block(&report.covariance, block::POSITION);
        if let Some((deviations, rotation)) = principal_axes(&covariance) {
            let ellipsoid = Ellipsoids3D::update_fields()
                .with_half_sizes([point(&(3.0 * deviations))])
                .with_centers([point(&pose.translation.vector)])
                .with_quaternions([quaternion(&rotation)]);
            stream.log(COVARIANCE, &ellipsoid)?;
        }
        Ok(())
    }

    /// The pieces of the paths that are not yet complete, at the stream's current time.
    pub(super) fn log_rest(&mut self, stream: &RecordingStream) -> RecordingStreamResult<()> {
        for (path, entity) in
            [(&mut self.estimate, ESTIMATE_TRAJECTORY), (&mut self.truth, TRUTH_TRAJECTORY)]
        {
            if let Some(piece) = path.take() {
                stream.log(entity, &strip(piece))?;
            }
        }
        Ok(())
    }
}

/// A path that is written piece by piece, each beginning where the one before ended.
#[derive(Default)]
struct Path {
    points: Vec<[f32; 3]>,
}

impl Path {
    /// Appends a pose; returns a piece when one is complete.
    fn extend(&mut self, pose: &Isometry3<f64>) -> Option<Vec<[f32; 3]>> {
        self.points.push(point(&pose.translation.vector));
        (self.points.len() > POSES_PER_PIECE).then(|| self.take()).flatten()
    }

    /// The piece so far, if it has any length.
    fn take(&mut self) -> Option<Vec<[f32; 3]>> {
        let end = *self.points.last()?;
        (self.points.len() > 1).then(|| std::mem::replace(&mut self.points, vec![end]))
    }
}

pub(super) fn log_notes(stream: &RecordingStream, notes: &[Note]) -> RecordingStreamResult<()> {
    for note in notes {
        let level = match note.level {
            NoteLevel::Info => TextLogLevel::INFO,
            NoteLevel::Warning => TextLogLevel::WARN,
        };
        stream.log(LOG, &TextLog::new(note.text.as_str()).with_level(level))?;
    }
    Ok(())
}

pub(super) fn transform(a_from_b: &Isometry3<f64>) -> Transform3D {
    Transform3D::from_translation_rotation(
        point(&a_from_b.translation.vector),
        quaternion(&a_from_b.rotation),
    )
}

pub(super) fn quaternion(rotation: &nalgebra::UnitQuaternion<f64>) -> Quaternion {
    let q = rotation.coords.cast::<f32>();
    Quaternion::from_xyzw([q.x, q.y, q.z, q.w])
}

pub(super) fn point(vector: &Vector3<f64>) -> [f32; 3] {
    vector.cast::<f32>().into()
}

fn strip(piece: Vec<[f32; 3]>) -> LineStrips3D {
    LineStrips3D::update_fields().with_strips([piece])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_of_a_path_join_and_cover_it_once() {
        let mut path = Path::default();
        let poses: Vec<_> =
            (0..37).map(|i| Isometry3::translation(f64::from(i), 0.0, 0.0)).collect();
        let mut pieces: Vec<_> = poses.iter().filter_map(|pose| path.extend(pose)).collect();
        pieces.extend(path.take());
        assert_eq!(path.take(), None);
        let mut joined = vec![pieces[0][0]];
        for piece in &pieces {
            assert_eq!(joined.last(), piece.first());
            joined.extend(&piece[1..]);
        }
        let expected: Vec<_> = poses.iter().map(|pose| point(&pose.translation.vector)).collect();
        assert_eq!(joined, expected);
    }
}
