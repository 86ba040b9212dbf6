//! Poses, paths, map and images: everything in space.

use nalgebra::{Isometry3, Vector3};
use rerun::components::{FillMode, Radius};
use rerun::{
    Color, Ellipsoids3D, LineStrips2D, LineStrips3D, Pinhole, Points2D, Points3D, Quaternion,
    RecordingStream, RecordingStreamResult, TextLog, TextLogLevel, Transform3D, TransformAxes3D,
    ViewCoordinates,
};

use super::covariance::principal_axes;
use crate::inertial::block;
use crate::odometry::{KeypointRole, KeypointView, MapPointView, Note, NoteLevel, StepReport};
use crate::vision::PinholeCamera;

pub(super) const WORLD: &str = "world";
pub(super) const MAP: &str = "world/map";
pub(super) const IMAGE: &str = "world/estimate/body/camera/image";
pub(super) const COLOR: &str = "world/estimate/body/camera/image/color";
pub(super) const DEPTH: &str = "world/estimate/body/camera/image/depth";
pub(super) const KEYPOINTS: &str = "world/estimate/body/camera/image/keypoints";
pub(super) const TRAJECTORIES: [&str; 2] = [ESTIMATE_TRAJECTORY, TRUTH_TRAJECTORY];
pub(super) const LOG: &str = "log";

const ESTIMATE_BODY: &str = "world/estimate/body";
const ESTIMATE_CAMERA: &str = "world/estimate/body/camera";
const ESTIMATE_TRAJECTORY: &str = "world/estimate/trajectory";
const COVARIANCE: &str = "world/estimate/covariance";
const TRUTH_BODY: &str = "world/truth/body";
const TRUTH_TRAJECTORY: &str = "world/truth/trajectory";
const MATCHES: &str = "world/estimate/body/camera/image/keypoints/matches";

const ESTIMATE_COLOR: [u8; 3] = [255, 160, 60];
const TRUTH_COLOR: [u8; 3] = [120, 210, 255];
const INLIER_COLOR: [u8; 3] = [80, 230, 100];
const OUTLIER_COLOR: [u8; 3] = [255, 70, 70];

/// Role, name of the entity below [`KEYPOINTS`], color, radius in points of the user interface.
const KEYPOINT_STYLES: [(KeypointRole, &str, [u8; 3], f32); 5] = [
    (KeypointRole::Inlier, "inliers", INLIER_COLOR, 2.5),
    (KeypointRole::Outlier, "outliers", OUTLIER_COLOR, 2.5),
    (KeypointRole::New, "new", [80, 190, 255], 2.0),
    (KeypointRole::Unmatched, "unmatched", [200, 200, 200], 1.5),
    (KeypointRole::NoDepth, "no_depth", [150, 120, 60], 1.5),
];

/// Length of the drawn axes of a body, m.
const AXES_LENGTH: f32 = 0.2;
/// Distance at which the image plane is drawn in space, m.
const IMAGE_PLANE_DISTANCE: f32 = 0.4;
/// Poses that make up one piece of a path. Pieces are never written again, so that the recording
/// grows in proportion to its duration.
const POSES_PER_PIECE: usize = 10;
/// A map of so many points is written at every request, a larger one at proportionally fewer.
const MAP_POINTS_PER_REQUEST: usize = 10_000;
/// Standard deviations (m) at the two ends of the map's color scale.
const MAP_SIGMA_RANGE: [f32; 2] = [0.003, 0.3];

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
    stream.log_static(COVARIANCE, &style)?;
    let style = Points3D::update_fields().with_radii([Radius::new_ui_points(1.5)]);
    stream.log_static(MAP, &style)?;
    for (_, name, color, radius) in KEYPOINT_STYLES {
        let style = Points2D::update_fields()
            .with_colors([color])
            .with_radii([Radius::new_ui_points(radius)]);
        stream.log_static(format!("{KEYPOINTS}/{name}"), &style)?;
    }
    let style = LineStrips2D::update_fields().with_radii([Radius::new_ui_points(0.75)]);
    stream.log_static(MATCHES, &style)
}

pub(super) fn log_camera(
    stream: &RecordingStream,
    camera: &PinholeCamera,
    imu_from_camera: &Isometry3<f64>,
    [width, height]: [usize; 2],
) -> RecordingStreamResult<()> {
    let [fx, fy, cx, cy] = [camera.fx, camera.fy, camera.cx, camera.cy].map(|x| x as f32);
    // Rerun's pixel coordinates are those of the top left corner of a pixel, ours of its centre.
    let columns = [[fx, 0.0, 0.0], [0.0, fy, 0.0], [cx + 0.5, cy + 0.5, 1.0]];
    let pinhole = Pinhole::new(columns)
        .with_resolution([width as f32, height as f32])
        .with_camera_xyz(rerun::components::ViewCoordinates::RDF)
        .with_image_plane_distance(IMAGE_PLANE_DISTANCE)
        .with_color(ESTIMATE_COLOR);
    stream.log_static(ESTIMATE_CAMERA, &transform(imu_from_camera))?;
    stream.log_static(IMAGE, &pinhole)
}

/// What has to be remembered from one frame to the next.
#[derive(Default)]
pub(super) struct Scene {
    estimate: Path,
    truth: Path,
    maps_to_skip: usize,
}

impl Scene {
    /// Poses, paths, covariance and map, at the stream's current time.
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
        if let Some((deviations, rotation)) = principal_axes(&report.covariance, block::POSITION) {
            let ellipsoid = Ellipsoids3D::update_fields()
                .with_half_sizes([point(&(3.0 * deviations))])
                .with_centers([point(&pose.translation.vector)])
                .with_quaternions([quaternion(&rotation)]);
            stream.log(COVARIANCE, &ellipsoid)?;
        }
        match &report.map {
            Some(_) if self.maps_to_skip > 0 => self.maps_to_skip -= 1,
            Some(map) => {
                self.maps_to_skip = map.len() / MAP_POINTS_PER_REQUEST;
                log_map(stream, map)?;
            }
            None => {}
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

/// Key points and the lines from where their map points were predicted.
pub(super) fn log_keypoints(
    stream: &RecordingStream,
    keypoints: &[KeypointView],
) -> RecordingStreamResult<()> {
    for (role, name, ..) in KEYPOINT_STYLES {
        let of_role = keypoints.iter().filter(|keypoint| keypoint.role == role);
        let points =
            Points2D::update_fields().with_positions(of_role.map(|keypoint| pixel(keypoint.pixel)));
        stream.log(format!("{KEYPOINTS}/{name}"), &points)?;
    }
    let (strips, colors): (Vec<_>, Vec<_>) = keypoints
        .iter()
        .filter_map(|keypoint| {
            let strip = [pixel(keypoint.predicted?), pixel(keypoint.pixel)];
            let outlier = keypoint.role == KeypointRole::Outlier;
            Some((strip, if outlier { OUTLIER_COLOR } else { INLIER_COLOR }))
        })
        .unzip();
    let matches = LineStrips2D::update_fields().with_strips(strips).with_colors(colors);
    stream.log(MATCHES, &matches)
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

fn log_map(stream: &RecordingStream, map: &[MapPointView]) -> RecordingStreamResult<()> {
    let points = Points3D::update_fields()
        .with_positions(map.iter().map(|point| point.position))
        .with_colors(map.iter().map(|point| sigma_color(point.sigma)));
    stream.log(MAP, &points)
}

/// From green (well known) over yellow to magenta, in proportion to the logarithm.
fn sigma_color(sigma: f32) -> Color {
    const SCALE: [[f32; 3]; 3] = [[60.0, 220.0, 120.0], [250.0, 210.0, 70.0], [230.0, 60.0, 160.0]];
    let [low, high] = MAP_SIGMA_RANGE;
    let position = (sigma / low).ln() / (high / low).ln();
    // A sigma of zero or none at all falls to one of the ends.
    let position = if position.is_nan() { 1.0 } else { position.clamp(0.0, 1.0) };
    let [from, to, share] = if position < 0.5 {
        [SCALE[0], SCALE[1], [2.0 * position; 3]]
    } else {
        [SCALE[1], SCALE[2], [2.0 * position - 1.0; 3]]
    };
    let [r, g, b] = std::array::from_fn(|i| (from[i] + share[i] * (to[i] - from[i])).round() as u8);
    Color::from_rgb(r, g, b)
}

fn transform(a_from_b: &Isometry3<f64>) -> Transform3D {
    Transform3D::from_translation_rotation(
        point(&a_from_b.translation.vector),
        quaternion(&a_from_b.rotation),
    )
}

fn quaternion(rotation: &nalgebra::UnitQuaternion<f64>) -> Quaternion {
    let q = rotation.coords.cast::<f32>();
    Quaternion::from_xyzw([q.x, q.y, q.z, q.w])
}

fn point(vector: &Vector3<f64>) -> [f32; 3] {
    vector.cast::<f32>().into()
}

/// Rerun's pixel coordinates of ours (see [`log_camera`]).
fn pixel([column, row]: [f32; 2]) -> [f32; 2] {
    [column + 0.5, row + 0.5]
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

    #[test]
    fn colors_of_the_map_are_defined_for_every_sigma() {
        let ends = MAP_SIGMA_RANGE.map(sigma_color);
        assert_ne!(ends[0], ends[1]);
        for (sigma, expected) in [
            (0.0, ends[0]),
            (-0.0, ends[0]),
            (1e-9, ends[0]),
            (1e9, ends[1]),
            (f32::INFINITY, ends[1]),
            (f32::NAN, ends[1]),
        ] {
            assert_eq!(sigma_color(sigma), expected, "{sigma}");
        }
    }
}
