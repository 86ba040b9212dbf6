//! Which of several topics of a type is meant.
//!
//! What a topic holds counts most (its encoding, whether an IMU is whole); then what its name says
//! it is not; then whether it belongs to the camera that was chosen (frame, transforms, name
//! space); then its rate. The alphabet decides only between equals.

use std::cmp::Reverse;

use super::calibration::Observed;

/// How well a topic suits a role, smaller being better, by all but its name in the alphabet.
pub(super) type Preference = (u32, u32, u32, Reverse<i64>);

/// Words for images that were drawn on, or that show something else than the scene.
const DRAWN: [&str; 12] = [
    "debug",
    "overlay",
    "annotated",
    "visualization",
    "viz",
    "marker",
    "mask",
    "segmentation",
    "heatmap",
    "thermal",
    "confidence",
    "disparity",
];

/// Words for infrared images, in which a projector's dots move with the camera.
const INFRARED: [&str; 4] = ["infra", "infra1", "infra2", "ir"];

/// Words for poses that somebody wants, not has.
const COMMANDED: [&str; 14] = [
    "goal",
    "cmd",
    "command",
    "target",
    "setpoint",
    "desired",
    "plan",
    "waypoint",
    "nav",
    "initialpose",
    "clicked",
    "reference_trajectory",
    "mission",
    "teleop",
];

/// Words for poses that were estimated on board.
const ESTIMATED: [&str; 20] = [
    "odom",
    "odometry",
    "slam",
    "vio",
    "vo",
    "estimate",
    "estimated",
    "est",
    "ekf",
    "ukf",
    "amcl",
    "rtabmap",
    "orb",
    "zed",
    "filtered",
    "fused",
    "localization",
    "tag",
    "fiducial",
    "t265",
];

/// Words for reference poses.
const REFERENCE: [&str; 12] = [
    "truth",
    "groundtruth",
    "gt",
    "mocap",
    "vicon",
    "optitrack",
    "qualisys",
    "leica",
    "motion",
    "capture",
    "marker",
    "rigid",
];

/// Whether a name has one of `words` as a part: between `/`, `_`, `-`.
fn names(topic: &str, words: &[&str]) -> bool {
    let lower = topic.to_lowercase();
    let mut parts = lower.split(|c: char| !c.is_ascii_alphanumeric());
    parts.any(|part| words.contains(&part))
}

/// Whether a topic of poses says that it is a reference.
pub(super) fn is_reference(topic: &str) -> bool {
    names(topic, &REFERENCE)
}

/// Whether the poses of a topic cannot be a reference: commanded, or estimated on board.
pub(super) fn is_no_reference(topic: &str) -> bool {
    let lower = topic.to_lowercase();
    let commanded =
        names(topic, &COMMANDED) || ["goal", "setpoint"].iter().any(|w| lower.contains(w));
    commanded || names(topic, &ESTIMATED) && !is_reference(topic)
}

/// Rates within a fifth of one another count as equal.
fn rate_step(observed: &Observed, topic: &str) -> Reverse<i64> {
    Reverse(observed.rate(topic).map_or(i64::MIN, |rate| (5.0 * rate.ln()).round() as i64))
}

/// A color image of the format `rank`: not drawn on, not infrared, of a frame that a depth image
/// shares, calibrated, rectified.
pub(super) fn color(observed: &Observed, topic: &str, rank: u32, depths: &[&str]) -> Preference {
    let shares_frame = depths.iter().any(|depth| same_frame(observed, depth, topic));
    let kind = sum(&[(2, names(topic, &DRAWN)), (1, names(topic, &INFRARED))]);
    let fitting = sum(&[
        (4, !shares_frame),
        (2, observed.info_of(topic).is_none()),
        (1, !topic.contains("image_rect")),
    ]);
    (kind, rank, fitting, rate_step(observed, topic))
}

/// A depth image of the format `rank`: of the frame of the color image, or by its name registered
/// to it.
pub(super) fn depth(
    observed: &Observed,
    topic: &str,
    rank: u32,
    color: Option<&str>,
) -> Preference {
    let shares_frame = color.is_some_and(|color| same_frame(observed, topic, color));
    let registered = ["aligned", "registered", "depth_to_rgb", "depth_to_color"];
    let lower = topic.to_lowercase();
    let is_registered = registered.iter().any(|word| lower.contains(word));
    let fitting = sum(&[(4, names(topic, &DRAWN)), (2, !shares_frame), (1, !is_registered)]);
    (fitting, rank, 0, rate_step(observed, topic))
}

/// An IMU, whole by its `rank`: fixed to the camera, else of its name space.
pub(super) fn imu(observed: &Observed, topic: &str, rank: u32, color: Option<&str>) -> Preference {
    let connected = color.is_some_and(|color| observed.are_connected(topic, color));
    let near = color.is_some_and(|color| first_part(color) == first_part(topic));
    (rank, sum(&[(2, !connected), (1, !near)]), 0, rate_step(observed, topic))
}

/// Reference poses: called so; of the message type `rank`.
pub(super) fn truth(observed: &Observed, topic: &str, rank: u32) -> Preference {
    (u32::from(!is_reference(topic)), rank, 0, rate_step(observed, topic))
}

fn sum(malus: &[(u32, bool)]) -> u32 {
    malus.iter().filter(|(_, applies)| *applies).map(|(weight, _)| weight).sum()
}

fn same_frame(observed: &Observed, a: &str, b: &str) -> bool {
    observed.frame(a).is_some_and(|frame| observed.frame(b) == Some(frame))
}

/// `camera` of `/camera/imu`.
fn first_part(topic: &str) -> Option<&str> {
    let (first, _) = topic.strip_prefix('/').unwrap_or(topic).split_once('/')?;
    Some(first)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_tell_what_poses_are() {
        for topic in
            ["/goal_pose", "/move_base_simple/goal", "/mavros/setpoint_position/local", "/cmd_pose"]
        {
            assert!(is_no_reference(topic), "{topic}");
        }
        for topic in ["/zed/zed_node/pose", "/slam/pose", "/vio/pose", "/rtabmap/localization_pose"]
        {
            assert!(is_no_reference(topic), "{topic}");
        }
        for topic in
            ["/mocap/pose", "/vrpn_client_node/body/pose", "/truth/pose", "/gt/odom", "/pose"]
        {
            assert!(!is_no_reference(topic), "{topic}");
        }
        assert!(is_reference("/motion_capture/body") && is_reference("/vicon/firefly/firefly"));
        // A part of a longer word is no word.
        assert!(!is_reference("/length/pose") && !is_no_reference("/navio/pose"));
    }

    #[test]
    fn name_spaces_are_compared_by_their_first_part() {
        assert_eq!(first_part("/camera/imu"), Some("camera"));
        assert_eq!(first_part("/imu"), None);
    }
}
