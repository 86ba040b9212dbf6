//! Looking for the map in a frame.

use std::collections::BTreeSet;
use std::time::Instant;

use nalgebra::{Isometry3, Point2, Point3};

use super::association::{Association, place, seek};
use super::pose::{Agreement, find_pose};
use super::view::{FrontEndFrame, Prediction, View};
use crate::inertial::pose_covariance;
use crate::map::{Map, MapPoint};
use crate::vision::{Feature, Match, match_guided};

/// A point that was seen in one of so many frames before, and in so many in all, is expected to be seen
/// again.
const RECENT_FRAMES: u64 = 2;
const RECENT_OBSERVATIONS: u32 = 3;

/// Looks for a map in one frame, from one prediction.
#[derive(Debug)]
pub struct FrameTracker<'a> {
    pub view: View<'a>,
    pub map: &'a Map,
    pub prediction: &'a Prediction,
}

/// What was found of the map in a frame.
#[derive(Debug, Clone, Default)]
pub struct Tracks {
    /// Map points looked for.
    pub candidates: usize,
    pub matches: Vec<Association>,
    /// World from camera, as the inliers agree.
    pub pose: Option<Isometry3<f64>>,
    /// Indices into the matches, ascending.
    pub inliers: Vec<usize>,
    /// Matches that agree on another pose.
    pub second_motion: usize,
    /// Wall times of matching and of the search for a pose, s.
    pub matching_seconds: f64,
    pub ransac_seconds: f64,
}

impl Tracks {
    /// The matches that agree on the pose.
    pub fn agreeing(&self) -> impl Iterator<Item = &Association> {
        self.inliers.iter().filter_map(|&i| self.matches.get(i))
    }

    /// The same matches, of which nothing is believed.
    pub fn without_pose(self) -> Self {
        Self { pose: None, inliers: Vec::new(), ..self }
    }

    /// Appends a match that agrees.
    pub fn append(&mut self, association: Association) {
        self.inliers.push(self.matches.len());
        self.matches.push(association);
    }
}

/// What is seen of the filter's points at a pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct InView {
    /// Matches that agree on the pose.
    pub agreeing: usize,
    /// Points of the filter's state that should be in view, and those of them that are seen.
    pub expected: usize,
    pub seen: usize,
}

impl FrameTracker<'_> {
    /// Looks for the map near the prediction; where nothing of it agrees there, everywhere.
    pub fn track(&self, features: &[Feature]) -> Tracks {
        let start = Instant::now();
        let (mut candidates, mut matches) = self.find_matches(features);
        let matched = Instant::now();
        let agree =
            |matches: &[Association]| find_pose(matches, &self.view, self.map, self.prediction);
        let mut agreement = agree(&matches);
        if agreement.pose.is_none() && candidates < self.map.len() {
            let anywhere = self.match_everywhere(features);
            let agreeing = agree(&anywhere);
            if agreeing.pose.is_some() {
                (candidates, matches, agreement) = (self.map.len(), anywhere, agreeing);
            }
        }
        let Agreement { pose, inliers, second_motion } = agreement;
        Tracks {
            candidates,
            matches,
            pose,
            inliers,
            second_motion,
            matching_seconds: (matched - start).as_secs_f64(),
            ransac_seconds: matched.elapsed().as_secs_f64(),
        }
    }

    /// Number of map points that should be visible, and the features that look like one.
    fn find_matches(&self, features: &[Feature]) -> (usize, Vec<Association>) {
        let (width, height) = self.view.size;
        let world_from_camera = self.prediction.world_from_camera();
        let ids = self.map.candidates(&world_from_camera, self.view.camera, width, height);
        let search = &self.view.config.search;
        let mut associations = self.match_candidates(&ids, features, None);
        if associations.len() < search.min_matches {
            associations = self.match_candidates(&ids, features, Some(search.max_radius));
        }
        if associations.len() < search.min_matches && self.prediction.vision_lost {
            // The prediction has been without correction: everything may be anywhere.
            return (self.map.len(), self.match_everywhere(features));
        }
        (ids.len(), associations)
    }

    fn match_everywhere(&self, features: &[Feature]) -> Vec<Association> {
        let ids: Vec<_> = self.map.points().iter().map(|point| point.id).collect();
        self.match_candidates(&ids, features, Some(f64::INFINITY))
    }

    /// Looks for map points near where they are predicted: within their uncertainty, or within
    /// `radius` (px) where one is given.
    fn match_candidates(
        &self,
        ids: &[u64],
        features: &[Feature],
        radius: Option<f64>,
    ) -> Vec<Association> {
        let world_from_camera = self.prediction.world_from_camera();
        let (points, predictions): (Vec<_>, Vec<_>) = ids
            .iter()
            .filter_map(|id| self.map.get(*id))
            .filter_map(|point| Some((point, self.predict(point, radius)?)))
            .unzip();
        let associate = |m: Match| {
            let (point, prediction) = (points.get(m.query)?, predictions.get(m.query)?);
            let feature = features.get(m.train)?;
            let placed = place(feature, point, &world_from_camera, &self.view)?;
            Some(Association::new(m.train, point, prediction.pixel, placed))
        };
        let matches = match_guided(&predictions, features, &self.view.config.matching);
        matches.into_iter().filter_map(associate).collect()
    }

    /// Where a point is looked for. Turning by `e` moves it in the image by about `f e`, moving by
    /// `d` by `f d / z`.
    fn predict(&self, point: &MapPoint, radius: Option<f64>) -> Option<crate::vision::Prediction> {
        let search = &self.view.config.search;
        let belief = &self.prediction.belief;
        let camera_pose = self.prediction.world_from_camera();
        let in_camera = camera_pose.inverse_transform_point(&Point3::from(point.position)).coords;
        let pixel = self.view.project(&in_camera)?;
        let in_body = (self.view.body_from_camera * Point3::from(in_camera)).coords;
        let rotation = belief.state.world_from_body.rotation.to_rotation_matrix();
        let by_pose = crate::filter::point_by_pose(rotation.matrix(), &in_body);
        let spread =
            by_pose * pose_covariance(&belief.covariance) * by_pose.transpose() + point.covariance;
        let sigma = self.view.camera.pixels_across(spread.trace().max(0.0).sqrt(), &in_camera);
        let likely = (search.min_radius + 3.0 * sigma).min(search.max_radius);
        let radius = radius.unwrap_or(likely);
        Some(crate::vision::Prediction { descriptor: point.descriptor, pixel, radius })
    }

    /// The points of the filter's state that a camera at `world_from_camera` has in view.
    fn state_points_in_view(
        &self,
        world_from_camera: &Isometry3<f64>,
    ) -> impl Iterator<Item = &MapPoint> {
        let (width, height) = self.view.size;
        let ids = self.map.candidates(world_from_camera, self.view.camera, width, height);
        ids.into_iter().filter_map(|id| self.map.get(id)).filter(|point| point.held)
    }

    /// Where the points that were seen in the last frames are predicted now, pixels, and whether the
    /// inliers of `tracks` have them.
    pub fn recent_points(&self, tracks: &Tracks) -> Vec<(Point2<f64>, bool)> {
        let found: BTreeSet<_> = tracks.agreeing().map(|m| m.point).collect();
        let world_from_camera = self.prediction.world_from_camera();
        let (width, height) = self.view.size;
        let ids = self.map.candidates(&world_from_camera, self.view.camera, width, height);
        let seen = |point: &&MapPoint| {
            point.last_seen + RECENT_FRAMES >= self.prediction.seeing_frames
                && point.observations >= RECENT_OBSERVATIONS
        };
        let place = |point: &MapPoint| {
            let position = Point3::from(point.position);
            let in_camera = world_from_camera.inverse_transform_point(&position).coords;
            Some((self.view.project(&in_camera)?, found.contains(&point.id)))
        };
        ids.iter().filter_map(|id| self.map.get(*id)).filter(seen).filter_map(place).collect()
    }

    /// What is seen of the points of the state that the pose of `tracks` puts in view.
    pub fn in_view(&self, tracks: &Tracks, front: &FrontEndFrame) -> Option<InView> {
        let pose = tracks.pose.as_ref()?;
        let matched: BTreeSet<_> = tracks.agreeing().map(|m| m.point).collect();
        let mut in_view = InView { agreeing: tracks.inliers.len(), expected: 0, seen: 0 };
        for point in self.state_points_in_view(pose) {
            let seen =
                matched.contains(&point.id) || seek(point, pose, front, &self.view).is_some();
            in_view.expected += 1;
            in_view.seen += usize::from(seen);
        }
        Some(in_view)
    }

    /// Looks for the points of the filter's state that the inliers lack where the pose of `tracks`
    /// has them; what is found is appended to them and to the features of the frame.
    pub fn seek_state_points(&self, tracks: &mut Tracks, front: &mut FrontEndFrame) {
        let Some(pose) = tracks.pose else { return };
        let found: BTreeSet<_> = tracks.agreeing().map(|m| m.point).collect();
        for point in self.state_points_in_view(&pose).filter(|point| !found.contains(&point.id)) {
            if let Some((feature, association)) = seek(point, &pose, front, &self.view) {
                front.extraction.features.push(feature);
                tracks.append(association);
            }
        }
    }
}
