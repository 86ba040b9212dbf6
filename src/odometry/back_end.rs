//! Filter and map together: what `replay` and the studies drive, the one from images, the others
//! from simulated points.

use std::collections::BTreeSet;

use nalgebra::{Isometry3, Matrix3, Translation3, Vector3};

use super::state_points::renew_state_points;
use super::track_window::{TrackFrame, TrackWindow};
use super::window::ImuWindow;
use crate::alignment::PointPair;
use crate::filter::{
    FilterConfig, FilterError, FilterKind, FrameChange, InertialStep, MapEstimate, MapTreatment,
    PointObservation, PointUpdate, TrackUpdate, VisualInertialFilter, ZeroVelocity,
};
use crate::inertial::Belief;
use crate::map::{Map, MapConfig, Sighting};
use crate::sensor::Stamp;

/// A moved camera below this carries the map, but leaves its points where they were measured, rad
/// and m: less than what points are measured to.
const CAMERA_MOVED: f64 = 1e-4;

/// A visual-inertial filter and the map that it refers to.
pub struct BackEnd {
    filter: Box<dyn VisualInertialFilter>,
    treatment: MapTreatment,
    config: FilterConfig,
    map_config: MapConfig,
    map: Map,
    /// So many points must agree to lead a lost filter back to its map.
    least_to_relocate: usize,
    /// Points that are known independently of the belief, which has not seen them yet.
    prior_points: BTreeSet<u64>,
}

/// Points of the map that a frame showed again, and what may become new ones.
#[derive(Debug, Clone, Default)]
pub struct FrameObservations {
    pub seen: Vec<(PointObservation, Sighting)>,
    /// Of no known point; the ids are not looked at.
    pub new: Vec<(PointObservation, Sighting)>,
}

impl BackEnd {
    pub fn new(
        kind: FilterKind,
        filter: Box<dyn VisualInertialFilter>,
        config: &FilterConfig,
        map: &MapConfig,
        least_to_relocate: usize,
    ) -> Self {
        Self {
            filter,
            treatment: kind.map_treatment(),
            config: config.clone(),
            map_config: map.clone(),
            map: Map::new(map),
            least_to_relocate,
            prior_points: BTreeSet::new(),
        }
    }

    pub fn belief(&self) -> &Belief {
        self.filter.belief()
    }

    pub fn filter(&self) -> &dyn VisualInertialFilter {
        self.filter.as_ref()
    }

    pub fn filter_mut(&mut self) -> &mut dyn VisualInertialFilter {
        self.filter.as_mut()
    }

    pub fn map(&self) -> &Map {
        &self.map
    }

    /// Takes a map that another estimate has left.
    pub fn adopt_map(&mut self, map: Map) {
        self.map = map;
    }

    pub fn take_map(self) -> Map {
        self.map
    }

    /// Adds a point that is known independently of the belief.
    pub fn add_prior_point(&mut self, known: &MapEstimate, sighting: &Sighting) -> Option<u64> {
        let id = self.map.insert(known.position, known.covariance, sighting)?;
        self.prior_points.insert(id);
        Some(id)
    }

    /// Carries the belief through the IMU data of a window, or without any through its length.
    /// Gives the intervals that were left out since no finite belief follows from them.
    pub fn propagate(&mut self, window: &ImuWindow) -> Vec<(Stamp, FilterError)> {
        let mut refused = Vec::new();
        for interval in &window.intervals {
            self.filter.set_imu_gap(interval.is_bridged);
            let step = InertialStep::between(&interval.from, &interval.to);
            if step.seconds > 0.0
                && let Err(error) = self.filter.propagate(&step)
            {
                refused.push((interval.to.stamp, error));
            }
        }
        if window.intervals.is_empty() && window.seconds > 0.0 {
            let step = InertialStep::unmeasured(window.seconds);
            if let Err(error) = self.filter.propagate(&step) {
                refused.push((window.end, error));
            }
        }
        refused
    }

    /// Conditions belief and map on points of the map that were seen in a frame.
    ///
    /// A belief that `is_tied` to past poses by points that were followed from there is not lost, even
    /// if none of its points is seen. It must not be led back to the map: that takes the map's errors for
    /// independent of its own, which they are only after a loss.
    pub fn update(
        &mut self,
        frame: u64,
        seen: &[PointObservation],
        is_tied: bool,
    ) -> Result<PointUpdate, FilterError> {
        self.admit_prior_points(seen);
        let pairs: Vec<_> = seen.iter().filter_map(|point| self.pair(point)).collect();
        let update = match self.filter.point_state_mut() {
            Some(points) if seen.iter().any(|point| points.estimate(point.id).is_some()) => {
                points.update_state_points(seen)?
            }
            Some(_) if is_tied => return Err(FilterError::NoMeasurement),
            Some(_) => return self.find_back(frame, seen),
            None => self.filter.update_map_points(&pairs)?,
        };
        let moved = self.follow(&update.frame);
        if self.treatment == MapTreatment::Correlated && !self.holds_points() {
            // A filter that is to hold its points holds none yet, while its attitude is broad. What
            // was known of these is in its pose now, and would count twice.
            seen.iter().for_each(|point| self.forget(point.id));
        } else if !moved && self.treatment != MapTreatment::Fixed {
            self.refine(seen, &pairs, &update.refused);
        }
        Ok(update)
    }

    /// Points that are known beforehand enter the state when they are first seen.
    fn admit_prior_points(&mut self, seen: &[PointObservation]) {
        let Some(points) = self.filter.point_state_mut() else { return };
        for point in seen {
            let Some(known) = self.map.get(point.id) else { continue };
            let estimate = MapEstimate { position: known.position, covariance: known.covariance };
            if self.prior_points.contains(&point.id) && points.admit_known(point.id, &estimate) {
                self.prior_points.remove(&point.id);
                self.map.hold(point.id, true);
            }
        }
    }

    /// Leads a filter none of whose points is seen back to the map, by points that were there
    /// before vision was lost: their errors are treated as independent of the belief's.
    fn find_back(
        &mut self,
        frame: u64,
        seen: &[PointObservation],
    ) -> Result<PointUpdate, FilterError> {
        let old = |id: u64| self.map.get(id).is_some_and(|point| point.first_seen < frame);
        let known: Vec<_> =
            seen.iter().filter(|point| old(point.id)).filter_map(|p| self.pair(p)).collect();
        if known.len() < self.least_to_relocate {
            return Err(FilterError::NoMeasurement);
        }
        let update = self.filter.update_map_points(&known)?;
        self.follow(&update.frame);
        Ok(update)
    }

    fn pair(&self, point: &PointObservation) -> Option<PointPair> {
        let known = self.map.get(point.id)?;
        Some(PointPair {
            in_body: point.in_body,
            body_covariance: point.body_covariance,
            in_world: known.position,
            world_covariance: known.covariance,
        })
    }

    fn refine(&mut self, seen: &[PointObservation], pairs: &[PointPair], refused: &[usize]) {
        let refinement = self.filter.map_refinement();
        for (index, (point, pair)) in seen.iter().zip(pairs).enumerate() {
            if refused.binary_search(&index).is_err()
                && let Some(refined) = refinement.posterior(pair)
            {
                self.map.relocate(point.id, refined.position, refined.covariance);
            }
        }
    }

    fn forget(&mut self, id: u64) {
        self.map.remove(id);
        self.prior_points.remove(&id);
    }

    /// Conditions the belief on rest.
    pub fn rest(&mut self, rest: &ZeroVelocity) -> Result<FrameChange, FilterError> {
        let change = self.filter.update_zero_velocity(rest)?;
        if let Some(turn) = change.world_turn {
            self.map.carry(&Isometry3::from_parts(Translation3::identity(), turn));
        }
        Ok(change)
    }

    /// Conditions the belief on what tracks showed to the poses of the window; `None` if nothing of it
    /// was due.
    pub fn update_tracks(
        &mut self,
        tracks: &mut TrackWindow,
        frame: &TrackFrame<'_>,
    ) -> Result<Option<TrackUpdate>, FilterError> {
        let update = tracks.update(self.filter.as_mut(), frame)?;
        if let Some(update) = &update {
            self.follow(&update.frame);
        }
        Ok(update)
    }

    /// Moves the map as an update changed the world: turned, or with the camera, by which its points
    /// from about here were placed. True if it was moved by more than what points are measured to.
    fn follow(&mut self, change: &FrameChange) -> bool {
        if let Some(turn) = change.world_turn {
            self.map.carry(&Isometry3::from_parts(Translation3::identity(), turn));
        }
        let Some(in_body) = change.camera_moved else { return change.world_turn.is_some() };
        let world_from_body = self.filter.belief().state.world_from_body;
        self.map.carry(&(world_from_body * in_body * world_from_body.inverse()));
        change.world_turn.is_some()
            || in_body.rotation.angle() > CAMERA_MOVED
            || in_body.translation.vector.norm() > CAMERA_MOVED
    }

    /// Renews the points seen, inserts new ones and forgets old ones. For each of the new ones its id
    /// in the map, if it was inserted.
    pub fn maintain(&mut self, frame: u64, observed: FrameObservations) -> Vec<Option<u64>> {
        let FrameObservations { seen, new } = observed;
        let mut measured: Vec<PointObservation> = Vec::with_capacity(seen.len() + new.len());
        for (point, sighting) in seen {
            self.map.observe(point.id, &sighting);
            measured.push(point);
        }
        // A filter that is to hold its points, and cannot yet, must not take them for a map apart.
        let inserts = self.treatment != MapTreatment::Correlated || self.holds_points();
        let mut inserted = Vec::with_capacity(new.len());
        for (point, sighting) in new {
            let id = inserts
                .then_some(())
                .and_then(|()| self.insert(&point.in_body, &point.body_covariance, &sighting));
            measured.extend(id.map(|id| PointObservation { id, ..point }));
            inserted.push(id);
        }
        if let Some(points) = self.filter.point_state_mut() {
            renew_state_points(points, &mut self.map, &measured, frame, &self.config);
        }
        self.map.prune(frame);
        inserted
    }

    fn insert(
        &mut self,
        in_body: &Vector3<f64>,
        body_covariance: &Matrix3<f64>,
        sighting: &Sighting,
    ) -> Option<u64> {
        let estimate = self.filter.insert(self.treatment, in_body, body_covariance);
        self.map.insert(estimate.position, estimate.covariance, sighting)
    }

    /// Whether the filter's state holds its points.
    pub fn holds_points(&self) -> bool {
        self.filter.point_state().is_some()
    }

    /// Gives the map up, and the state's part of it.
    pub fn clear_map(&mut self) {
        if let Some(points) = self.filter.point_state_mut() {
            for id in points.ids() {
                points.release(id);
            }
        }
        self.map = Map::new(&self.map_config);
    }
}
