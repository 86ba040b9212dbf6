//! The pose that matches agree on.

use nalgebra::Isometry3;

use super::association::Association;
use super::view::{Prediction, View};
use crate::map::Map;
use crate::vision::{Correspondence, agree_near, agreeing, estimate_pose};

/// Fewer matches than this may agree on a second pose by chance.
const MIN_SECOND_MOTION: usize = 30;
/// Frames after which the points of a new map lie where they are, so that others move.
const SETTLED_FRAMES: u64 = 30;
/// Matches within this many times the tolerance of RANSAC follow the camera, only not as well as they
/// should.
const NEAR: f64 = 3.0;

/// On what matches agree.
#[derive(Debug, Clone, Default)]
pub(super) struct Agreement {
    /// World from camera.
    pub pose: Option<Isometry3<f64>>,
    /// Indices into the matches, ascending.
    pub inliers: Vec<usize>,
    /// Matches that agree on another pose: that of something that moves.
    pub second_motion: usize,
}

/// The pose of the camera that matches agree on.
///
/// Most may lie on what moves. Of two motions that have nothing in common, the camera's is
/// the one that the IMU predicts, if more of the points that have long been seen follow it.
pub(super) fn find_pose(
    matches: &[Association],
    view: &View,
    map: &Map,
    prediction: &Prediction,
) -> Agreement {
    let correspondences: Vec<_> = matches.iter().map(|m| m.correspondence).collect();
    let predicted = prediction.world_from_camera();
    let config = &view.config.ransac;
    let agree = |among: &[Correspondence]| {
        estimate_pose(among, view.camera, Some(&predicted.rotation), config, view.seed)
    };
    let Some(mut found) = agree(&correspondences) else { return Agreement::default() };
    if prediction.is_inertial
        && !prediction.vision_lost
        && 10 * found.inliers.len() < 9 * matches.len()
        && let Some(expected) = agree_near(&correspondences, view.camera, &predicted, config)
    {
        let shared = expected.inliers.iter().filter(|i| found.inliers.binary_search(i).is_ok());
        let apart = 2 * shared.count() < expected.inliers.len();
        let proven = |inliers: &[usize]| {
            let observations = |i: &usize| map.get(matches[*i].point).map(|p| p.observations);
            let least = view.config.proven_observations;
            inliers.iter().filter(|i| observations(i) >= Some(least)).count()
        };
        if apart && proven(&expected.inliers) > proven(&found.inliers) {
            found = expected;
        }
    }
    let near = agreeing(&correspondences, view.camera, &found.model, NEAR, config);
    let astray: Vec<_> = (0..matches.len())
        .filter(|i| near.binary_search(i).is_err())
        .map(|i| correspondences[i])
        .collect();
    let suspect = prediction.seeing_frames >= SETTLED_FRAMES
        && astray.len() >= MIN_SECOND_MOTION
        && 4 * astray.len() > matches.len();
    let others = agree(if suspect { &astray } else { &[] });
    Agreement {
        pose: Some(found.model),
        inliers: found.inliers,
        second_motion: others.map_or(0, |others| others.inliers.len()),
    }
}
