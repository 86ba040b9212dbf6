//! Key points by what became of them, where they were predicted, and how they moved.

use std::collections::BTreeMap;

use rerun::components::Radius;
use rerun::{LineStrips2D, Points2D, RecordingStream, RecordingStreamResult};

use super::scene::KEYPOINTS;
use crate::odometry::{KeypointRole, KeypointView};

/// Where matched points have gone since the image before; the viewer shows the last quarter of a second.
pub(super) const TRACKS: &str = "world/estimate/body/camera/image/keypoints/tracks";
const MATCHES: &str = "world/estimate/body/camera/image/keypoints/matches";

const INLIER_COLOR: [u8; 3] = [80, 230, 100];
const OUTLIER_COLOR: [u8; 3] = [255, 70, 70];
const TRACK_COLOR: [u8; 4] = [255, 225, 90, 200];

/// Role, name of the entity below [`KEYPOINTS`], color, radius in points of the user interface.
const STYLES: [(KeypointRole, &str, [u8; 3], f32); 5] = [
    (KeypointRole::Inlier, "inliers", INLIER_COLOR, 2.5),
    (KeypointRole::Outlier, "outliers", OUTLIER_COLOR, 2.5),
    (KeypointRole::New, "new", [80, 190, 255], 2.0),
    (KeypointRole::Unmatched, "unmatched", [200, 200, 200], 1.5),
    (KeypointRole::NoDepth, "no_depth", [150, 120, 60], 1.5),
];

pub(super) fn log_styles(stream: &RecordingStream) -> RecordingStreamResult<()> {
    for (_, name, color, radius) in STYLES {
        let style = Points2D::update_fields()
            .with_colors([color])
            .with_radii([Radius::new_ui_points(radius)]);
        stream.log_static(format!("{KEYPOINTS}/{name}"), &style)?;
    }
    let style = LineStrips2D::update_fields().with_radii([Radius::new_ui_points(0.75)]);
    stream.log_static(MATCHES, &style)?;
    stream.log_static(TRACKS, &style.with_colors([TRACK_COLOR]))
}

/// Where the points of the last image were, by the id of the map point.
#[derive(Default)]
pub(super) struct Tracks(BTreeMap<u64, [f32; 2]>);

impl Tracks {
    /// Pieces of the tracks from the last image to this one, whose inliers are `keypoints`.
    fn extend(&mut self, keypoints: &[KeypointView]) -> Vec<[[f32; 2]; 2]> {
        let inliers = keypoints.iter().filter(|keypoint| keypoint.role == KeypointRole::Inlier);
        let now: BTreeMap<_, _> =
            inliers.filter_map(|keypoint| Some((keypoint.point?, pixel(keypoint.pixel)))).collect();
        let before = std::mem::replace(&mut self.0, now);
        let piece = |(id, to): (&u64, &[f32; 2])| before.get(id).map(|from| [*from, *to]);
        self.0.iter().filter_map(piece).collect()
    }
}

pub(super) fn log(
    stream: &RecordingStream,
    keypoints: &[KeypointView],
    tracks: &mut Tracks,
) -> RecordingStreamResult<()> {
    for (role, name, ..) in STYLES {
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
    stream.log(MATCHES, &matches)?;
    stream.log(TRACKS, &LineStrips2D::update_fields().with_strips(tracks.extend(keypoints)))
}

/// Rerun's pixel coordinates are those of the top left corner of a pixel, ours of its centre.
fn pixel([column, row]: [f32; 2]) -> [f32; 2] {
    [column + 0.5, row + 0.5]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn inlier(point: u64, pixel: [f32; 2]) -> KeypointView {
        KeypointView { pixel, predicted: None, point: Some(point), role: KeypointRole::Inlier }
    }

    #[test]
    fn tracks_join_sightings_of_the_same_point() {
        let mut tracks = Tracks::default();
        assert!(tracks.extend(&[inlier(3, [1.0, 1.0]), inlier(7, [5.0, 5.0])]).is_empty());
        let outlier = KeypointView { role: KeypointRole::Outlier, ..inlier(3, [9.0, 9.0]) };
        let pieces = tracks.extend(&[inlier(7, [6.0, 5.0]), outlier, inlier(8, [0.0, 0.0])]);
        assert_eq!(pieces, [[[5.5, 5.5], [6.5, 5.5]]]);
        // A point that was out of sight begins anew.
        assert!(tracks.extend(&[inlier(3, [2.0, 2.0])]).is_empty());
    }
}
