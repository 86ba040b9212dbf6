//! The map of points: storage, queries, ageing (W22, section 5.2.5).

mod frustum;
mod index;
mod point;

use nalgebra::{Isometry3, Matrix3, Point3, Vector3};
use serde::{Deserialize, Serialize};

use crate::sensor::Camera;
use frustum::Frustum;
use index::SpatialIndex;

pub use point::{MapPoint, ReferenceView, Sighting};

/// Which points of the map are looked for in a frame, and how long they live. Defaults are those
/// of W22 where it gives any.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MapConfig {
    /// Points closer to the predicted camera than this are not looked for, m.
    pub min_distance: f64,
    /// Points further from the predicted camera than this are not looked for, m.
    pub max_distance: f64,
    /// Points seen from a direction further than this from the one they were last seen from are
    /// not looked for, degrees.
    pub max_view_angle_deg: f64,
    /// Points predicted outside the image by more than this are not looked for, pixels.
    pub view_margin: f64,
    /// Points not seen for more than this many frames are deleted.
    pub max_unseen_frames: u64,
    /// Most points kept. Above it go those unseen for longest, among them those with the fewest
    /// observations, among them the oldest.
    pub max_points: usize,
}

impl Default for MapConfig {
    fn default() -> Self {
        Self {
            min_distance: 0.5,
            max_distance: 5.0,
            max_view_angle_deg: 60.0,
            view_margin: 20.0,
            max_unseen_frames: 10,
            max_points: 2000,
        }
    }
}

/// Points in order of their ids.
#[derive(Debug, Default)]
pub struct Map {
    config: MapConfig,
    /// Ascending by id.
    points: Vec<MapPoint>,
    next_id: u64,
    index: SpatialIndex,
}

impl Map {
    pub fn new(config: &MapConfig) -> Self {
        Self { config: config.clone(), ..Self::default() }
    }

    pub fn len(&self) -> usize {
        self.points.len()
    }

    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// Ascending by id.
    pub fn points(&self) -> &[MapPoint] {
        &self.points
    }

    pub fn get(&self, id: u64) -> Option<&MapPoint> {
        self.slot(id).map(|slot| &self.points[slot])
    }

    /// Adds a point and gives its id; `None`, and no change, if it is not finite or lies at the
    /// camera.
    pub fn insert(
        &mut self,
        position: Vector3<f64>,
        covariance: Matrix3<f64>,
        sighting: &Sighting,
    ) -> Option<u64> {
        let view_direction = direction(&sighting.camera, &position)?;
        if !covariance.iter().all(|x| x.is_finite()) {
            return None;
        }
        let id = self.next_id;
        self.next_id += 1;
        self.points.push(MapPoint {
            id,
            position,
            covariance,
            descriptor: sighting.descriptor,
            reference: sighting.reference.clone(),
            view_direction,
            first_seen: sighting.frame,
            last_seen: sighting.frame,
            observations: 1,
            held: false,
        });
        self.index.invalidate();
        Some(id)
    }

    /// Renews a point that was seen again. False if there is no such point (or the camera is at
    /// the point).
    pub fn observe(&mut self, id: u64, sighting: &Sighting) -> bool {
        let Some(slot) = self.slot(id) else { return false };
        let point = &mut self.points[slot];
        let Some(view_direction) = direction(&sighting.camera, &point.position) else {
            return false;
        };
        point.view_direction = view_direction;
        point.descriptor = sighting.descriptor;
        if sighting.reference.is_some() {
            point.reference.clone_from(&sighting.reference);
        }
        point.last_seen = sighting.frame;
        point.observations = point.observations.saturating_add(1);
        true
    }

    /// Replaces what is known of a point's place. False, and no change, if there is no such
    /// point or the values are not finite.
    pub fn relocate(&mut self, id: u64, position: Vector3<f64>, covariance: Matrix3<f64>) -> bool {
        let finite = position.iter().chain(covariance.iter()).all(|x| x.is_finite());
        let Some(slot) = self.slot(id).filter(|_| finite) else { return false };
        self.points[slot].position = position;
        self.points[slot].covariance = covariance;
        self.index.invalidate();
        true
    }

    /// Keeps a point from being pruned, or no longer. False if there is no such point.
    pub fn hold(&mut self, id: u64, held: bool) -> bool {
        let Some(slot) = self.slot(id) else { return false };
        self.points[slot].held = held;
        true
    }

    /// Moves all points, and the views that they were seen from, by a motion of the world.
    pub fn carry(&mut self, motion: &Isometry3<f64>) {
        let matrix = motion.rotation.to_rotation_matrix().into_inner();
        for point in &mut self.points {
            point.position = (motion * Point3::from(point.position)).coords;
            point.view_direction = motion.rotation * point.view_direction;
            point.covariance = matrix * point.covariance * matrix.transpose();
            if let Some(reference) = &mut point.reference {
                reference.world_from_camera = motion * reference.world_from_camera;
            }
        }
        self.index.invalidate();
    }

    /// Deletes a point; false if there is none of this id.
    pub fn remove(&mut self, id: u64) -> bool {
        let Some(slot) = self.slot(id) else { return false };
        self.points.remove(slot);
        self.index.invalidate();
        true
    }

    /// Deletes points not seen for too long as of `frame`, then those above the size limit (see
    /// [`MapConfig`]), those held last. Gives the number deleted.
    pub fn prune(&mut self, frame: u64) -> usize {
        let before = self.points.len();
        let oldest = frame.saturating_sub(self.config.max_unseen_frames);
        self.points.retain(|point| point.held || point.last_seen >= oldest);
        let excess = self.points.len().saturating_sub(self.config.max_points);
        if excess > 0 {
            let worth = |p: &MapPoint| (p.held, p.last_seen, p.observations, p.id);
            let mut order: Vec<_> = self.points.iter().map(worth).collect();
            order.sort_unstable();
            let mut doomed: Vec<_> = order[..excess].iter().map(|worth| worth.3).collect();
            doomed.sort_unstable();
            self.points.retain(|point| doomed.binary_search(&point.id).is_err());
        }
        let deleted = before - self.points.len();
        if deleted > 0 {
            self.index.invalidate();
        }
        deleted
    }

    /// Ids, ascending, of the points that should be visible from a predicted pose: within the
    /// distances, within the view angle, and inside the image and its margin.
    pub fn candidates(
        &self,
        world_from_camera: &Isometry3<f64>,
        camera: &Camera,
        width: usize,
        height: usize,
    ) -> Vec<u64> {
        let eye = world_from_camera.translation.vector;
        let Some(frustum) = Frustum::new(camera, width, height, self.config.view_margin) else {
            return vec![];
        };
        let camera_from_world = world_from_camera.inverse();
        let min_cos = self.config.max_view_angle_deg.to_radians().cos();
        let visible = |point: &MapPoint| {
            let ray = point.position - eye;
            let distance = ray.norm();
            distance >= self.config.min_distance
                && distance <= self.config.max_distance
                && ray.dot(&point.view_direction) >= min_cos * distance
                && frustum.contains(&(camera_from_world * Point3::from(point.position)))
        };
        let (centre, radius) = frustum.bounding_sphere(self.config.max_distance);
        let centre = (world_from_camera * centre).coords;
        let near = self.index.within(&self.points, &centre, radius);
        let visible = near.into_iter().map(|slot| &self.points[slot]).filter(|p| visible(p));
        let mut ids: Vec<_> = visible.map(|point| point.id).collect();
        ids.sort_unstable();
        ids
    }

    fn slot(&self, id: u64) -> Option<usize> {
        self.points.binary_search_by_key(&id, |point| point.id).ok()
    }
}

/// Unit vector between two finite points that are apart.
fn direction(from: &Vector3<f64>, to: &Vector3<f64>) -> Option<Vector3<f64>> {
    (to - from).try_normalize(1e-9).filter(|d| d.iter().all(|x| x.is_finite()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::PinholeCamera;
    use crate::vision::Descriptor;
    use nalgebra::UnitQuaternion;
    use proptest::prelude::*;

    const PINHOLE: PinholeCamera = PinholeCamera { fx: 500.0, fy: 500.0, cx: 320.0, cy: 240.0 };
    const CAMERA: Camera = Camera::pinhole(PINHOLE);

    fn descriptor(byte: u8) -> Descriptor {
        Descriptor::from_bytes(&[byte; 32])
    }

    fn seen_from_origin(frame: u64) -> Sighting {
        Sighting { frame, camera: Vector3::zeros(), descriptor: descriptor(0), reference: None }
    }

    fn map_of(points: &[Vector3<f64>]) -> Map {
        let mut map = Map::new(&MapConfig::default());
        for point in points {
            map.insert(*point, Matrix3::identity(), &seen_from_origin(0)).unwrap();
        }
        map
    }

    fn from(map: &Map, pose: &Isometry3<f64>) -> Vec<u64> {
        map.candidates(pose, &CAMERA, 640, 480)
    }

    #[test]
    fn distance_rule_holds_at_its_borders() {
        let z = [0.499, 0.5, 0.501, 4.999, 5.0, 5.001];
        let map = map_of(&z.map(|z| Vector3::z() * z));
        assert_eq!(from(&map, &Isometry3::identity()), [1, 2, 3, 4]);
    }

    #[test]
    fn view_angle_rule_holds_at_its_border() {
        let point = Vector3::z() * 2.0;
        let map = map_of(&[point]);
        for (degrees, visible) in [(59.9f64, true), (60.1, false), (-59.9, true), (-60.1, false)] {
            // A camera that circles the point and looks at it.
            let turn = UnitQuaternion::new(Vector3::y() * degrees.to_radians());
            let pose = Isometry3::from_parts((point - turn * point).into(), turn);
            assert_eq!(from(&map, &pose).len(), usize::from(visible), "{degrees}");
        }
    }

    #[test]
    fn points_outside_the_image_and_its_margin_are_left_out() {
        let pixels = [(-19.0, 240.0), (-22.0, 240.0), (658.0, 240.0), (661.0, 240.0)];
        let pixels = pixels.into_iter().chain([(320.0, -19.0), (320.0, -22.0), (320.0, 501.0)]);
        let at = |(x, y)| PINHOLE.unproject(nalgebra::Point2::new(x, y), 2.0);
        let mut points: Vec<_> = pixels.map(at).collect();
        points.push(Vector3::z() * -2.0);
        assert_eq!(from(&map_of(&points), &Isometry3::identity()), [0, 2, 4]);
    }

    #[test]
    fn a_point_dies_in_the_eleventh_frame_unseen() {
        let mut map = map_of(&[Vector3::z(), Vector3::z() * 2.0]);
        assert!(map.observe(1, &seen_from_origin(1)));
        assert_eq!(map.prune(10), 0);
        assert_eq!(map.prune(11), 1);
        assert!(map.get(0).is_none() && map.get(1).is_some());
        assert_eq!(map.prune(12), 1);
        assert!(map.is_empty());
    }

    #[test]
    fn the_least_useful_points_make_room() {
        let mut map = Map::new(&MapConfig { max_points: 2, ..MapConfig::default() });
        for _ in 0..4 {
            map.insert(Vector3::z(), Matrix3::identity(), &seen_from_origin(0)).unwrap();
        }
        assert!(map.observe(0, &seen_from_origin(3)));
        assert!(map.observe(2, &seen_from_origin(0)));
        assert_eq!(map.prune(3), 2);
        let left: Vec<_> = map.points().iter().map(|p| p.id).collect();
        assert_eq!(left, [0, 2], "0 was seen last, 2 more often than 1 and 3");
    }

    #[test]
    fn observing_renews_what_a_point_looks_like() {
        let mut map = map_of(&[Vector3::z() * 2.0]);
        let camera = Vector3::new(2.0, 0.0, 2.0);
        assert!(map.observe(
            0,
            &Sighting { frame: 7, camera, descriptor: descriptor(9), reference: None }
        ));
        let point = map.get(0).unwrap();
        assert_eq!((point.first_seen, point.last_seen, point.observations), (0, 7, 2));
        assert_eq!(point.descriptor, descriptor(9));
        assert!((point.view_direction + Vector3::x()).norm() < 1e-12);
        assert!(!map.observe(5, &seen_from_origin(8)));
    }

    #[test]
    fn moved_and_removed_points_are_found_where_they_are() {
        let mut map = map_of(&[Vector3::z() * 2.0, Vector3::z() * 3.0]);
        let pose = Isometry3::identity();
        assert_eq!(from(&map, &pose), [0, 1]);
        assert!(map.relocate(0, Vector3::z() * 9.0, Matrix3::zeros()));
        assert_eq!(from(&map, &pose), [1]);
        assert!(map.remove(1) && !map.remove(1));
        assert!(from(&map, &pose).is_empty());
        map.insert(Vector3::z(), Matrix3::zeros(), &seen_from_origin(1)).unwrap();
        assert_eq!(from(&map, &pose), [2], "ids are not used again");
    }

    #[test]
    fn what_is_not_finite_stays_out() {
        let mut map = map_of(&[Vector3::z()]);
        let nan = Vector3::repeat(f64::NAN);
        let sighting = seen_from_origin(0);
        assert_eq!(map.insert(nan, Matrix3::zeros(), &sighting), None);
        assert_eq!(map.insert(Vector3::z(), Matrix3::repeat(f64::NAN), &sighting), None);
        assert_eq!(map.insert(Vector3::zeros(), Matrix3::zeros(), &sighting), None);
        assert!(!map.relocate(0, nan, Matrix3::zeros()));
        let lost = Isometry3::translation(f64::NAN, 0.0, 0.0);
        assert!(from(&map, &lost).is_empty());
        assert_eq!(map.len(), 1);
    }

    fn vector(range: f64) -> impl Strategy<Value = Vector3<f64>> {
        [-range..range, -range..range, -range..range].prop_map(Vector3::from)
    }

    proptest! {
        /// The rules written out over all points, without index and frustum; points within 0.01
        /// px of the image's border may go either way.
        #[test]
        fn candidates_are_those_of_a_plain_scan(
            points in prop::collection::vec(vector(6.0), 0..200),
            position in vector(2.0), axis_angle in vector(2.0),
        ) {
            let points: Vec<_> = points.into_iter().filter(|p| p.norm() > 0.1).collect();
            let map = map_of(&points);
            let rotation = UnitQuaternion::new(axis_angle);
            let pose = Isometry3::from_parts(position.into(), rotation);
            let scan = |margin: f64| {
                let visible = |point: &&MapPoint| {
                    let ray = point.position - position;
                    let angle = ray.angle(&point.view_direction).to_degrees();
                    let inside = CAMERA.project(&(rotation.inverse() * ray)).is_some_and(|pixel| {
                        (-0.5 - margin..639.5 + margin).contains(&pixel.x)
                            && (-0.5 - margin..479.5 + margin).contains(&pixel.y)
                    });
                    (0.5..=5.0).contains(&ray.norm()) && angle <= 60.0 && inside
                };
                map.points().iter().filter(visible).map(|p| p.id).collect::<Vec<_>>()
            };
            let found = from(&map, &pose);
            let (sure, possible) = (scan(20.0 - 0.01), scan(20.0 + 0.01));
            prop_assert!(sure.iter().all(|id| found.contains(id)));
            prop_assert!(found.iter().all(|id| possible.contains(id)));
            prop_assert!(found.is_sorted());
        }
    }
}
