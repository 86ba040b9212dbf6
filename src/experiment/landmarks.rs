//! Simulated landmarks in the place of images: they go into the back end that `replay` drives.

use std::collections::{BTreeMap, VecDeque};

use nalgebra::{Matrix3, Vector3};

use crate::filter::{
    Calibration, FilterConfig, FilterKind, MapEstimate, PointObservation, VisualInertialFilter,
};
use crate::map::{Map, MapConfig, Sighting};
use crate::odometry::{BackEnd, FrameObservations, ImuCursor};
use crate::sensor::{ImuSample, Stamp};
use crate::vision::{Descriptor, RansacConfig};

/// A landmark seen in a frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Seen {
    pub landmark: usize,
    /// Body coordinates, m.
    pub in_body: Vector3<f64>,
    /// Body coordinates, m^2.
    pub body_covariance: Matrix3<f64>,
}

/// The back end, the IMU data that wait for it, and which landmark is which point of its map.
pub(super) struct LandmarkRun {
    pub back_end: BackEnd,
    imu: VecDeque<ImuSample>,
    cursor: ImuCursor,
    points: BTreeMap<usize, u64>,
    frame: u64,
}

impl LandmarkRun {
    /// From the first of `imu` on, of which there must be one.
    pub fn start(
        kind: FilterKind,
        filter: Box<dyn VisualInertialFilter>,
        config: &FilterConfig,
        map: &MapConfig,
        imu: &[ImuSample],
        max_gap: f64,
    ) -> Self {
        let mut imu: VecDeque<_> = imu.iter().copied().collect();
        let start = imu.front().map_or_else(Stamp::default, |sample| sample.stamp);
        let cursor = ImuCursor::at(start, &mut imu, max_gap);
        let least = RansacConfig::default().min_inliers;
        let back_end = BackEnd::new(kind, filter, config, map, least);
        Self { back_end, imu, cursor, points: BTreeMap::new(), frame: 0 }
    }

    /// Adds a landmark that is known beforehand.
    pub fn know(&mut self, landmark: usize, estimate: &MapEstimate) {
        let anywhere = sighting(0, estimate.position - Vector3::x());
        let id = self.back_end.add_prior_point(estimate, &anywhere);
        self.points.extend(id.map(|id| (landmark, id)));
    }

    /// Carries the belief to `time`; false if it is past that.
    pub fn propagate_to(&mut self, time: Stamp) -> bool {
        if time > self.cursor.time {
            let window = self.cursor.window_until(time, &mut self.imu);
            self.back_end.propagate(&window);
        }
        time == self.cursor.time
    }

    /// Takes a frame, `measure` being what it shows by the calibration that the back end has.
    pub fn see(&mut self, measure: impl Fn(&BackEnd) -> Vec<Seen>) {
        let (again, _) = self.sorted(&measure(&self.back_end));
        // A frame without a known landmark corrects nothing.
        let _ = self.back_end.update(self.frame, &again, false);
        let (again, fresh) = self.sorted(&measure(&self.back_end));
        let camera = self.back_end.belief().state.world_from_body.translation.vector;
        let sighting = sighting(self.frame, camera);
        let landmarks: Vec<_> = fresh.iter().map(|seen| seen.landmark).collect();
        let seen = again.into_iter().map(|point| (point, sighting.clone())).collect();
        let new = fresh.iter().map(|seen| (observation(0, seen), sighting.clone())).collect();
        let inserted = self.back_end.maintain(self.frame, FrameObservations { seen, new });
        let inserted = landmarks.into_iter().zip(inserted);
        self.points.extend(inserted.filter_map(|(landmark, id)| Some((landmark, id?))));
        self.frame += 1;
    }

    /// Landmarks that the map has, and others.
    fn sorted(&self, seen: &[Seen]) -> (Vec<PointObservation>, Vec<Seen>) {
        let (mut again, mut fresh) = (Vec::new(), Vec::new());
        for seen in seen {
            match self.point(seen.landmark) {
                Some(id) => again.push(observation(id, seen)),
                None => fresh.push(*seen),
            }
        }
        (again, fresh)
    }

    fn point(&self, landmark: usize) -> Option<u64> {
        let id = self.points.get(&landmark)?;
        self.back_end.map().get(*id).map(|point| point.id)
    }

    /// The camera's calibration as estimated, if it is.
    pub fn calibration(&self) -> Option<&Calibration> {
        self.back_end.filter().calibration()
    }

    /// Where the map has a landmark, m.
    pub fn position(&self, landmark: usize) -> Option<Vector3<f64>> {
        let map: &Map = self.back_end.map();
        map.get(self.point(landmark)?).map(|point| point.position)
    }
}

fn observation(id: u64, seen: &Seen) -> PointObservation {
    PointObservation { id, in_body: seen.in_body, body_covariance: seen.body_covariance }
}

/// From a place, of something without looks.
fn sighting(frame: u64, camera: Vector3<f64>) -> Sighting {
    let descriptor = Descriptor::from_bytes(&[0; Descriptor::BYTES]);
    Sighting { frame, camera, descriptor, reference: None }
}
