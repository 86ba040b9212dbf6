//! Boxes, rays that meet them and the color seen there.

use nalgebra::{Isometry3, Matrix3, Vector3};

use super::light::LIGHT_CELL;
use crate::simulation::lens::Ray;
use crate::simulation::texture::{Color, Grain, Texture};

/// Width of the lens's and the color filter's blur spot, pixels.
const SPOT: f32 = 1.5;

/// One painted and lit face of a box.
#[derive(Debug)]
pub(in crate::simulation) struct Face {
    pub texture: Texture,
    /// Received light by cells of [`LIGHT_CELL`], square-root coded; rows along `v`.
    pub light: Vec<f32>,
    pub light_columns: usize,
    pub light_rows: usize,
    /// Offset of the fine grain, m, and its contrast.
    pub grain_offset: [f32; 2],
    pub grain_depth: f32,
}

impl Face {
    #[inline]
    fn light_at(&self, u: f32, v: f32) -> f32 {
        let x = (u / LIGHT_CELL - 0.5).clamp(0.0, (self.light_columns - 1) as f32);
        let y = (v / LIGHT_CELL - 0.5).clamp(0.0, (self.light_rows - 1) as f32);
        let (i, j) = (x as usize, y as usize);
        let (fx, fy) = (x - i as f32, y - j as f32);
        let (i1, j1) = ((i + 1).min(self.light_columns - 1), (j + 1).min(self.light_rows - 1));
        let at = |i: usize, j: usize| self.light[j * self.light_columns + i];
        let upper = at(i, j) + (at(i1, j) - at(i, j)) * fx;
        let lower = at(i, j1) + (at(i1, j1) - at(i, j1)) * fx;
        upper + (lower - upper) * fy
    }
}

/// A box, or the room seen from inside.
#[derive(Debug)]
pub(in crate::simulation) struct Solid {
    pub world_from_box: Isometry3<f32>,
    pub half: Vector3<f32>,
    /// Rays see the inner faces.
    pub inside_out: bool,
    /// By axis and sign: `-x +x -y +y -z +z`.
    pub faces: Vec<Face>,
}

/// A ray seen from one box: constant parts for a whole image.
#[derive(Debug, Clone, Copy)]
pub(in crate::simulation) struct View {
    origin: Vector3<f32>,
    /// Box coordinates of the camera's axes.
    axes: Matrix3<f32>,
}

/// Where a ray meets a box.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::simulation) struct Hit {
    /// In lengths of the ray's direction.
    pub distance: f32,
    /// Index of the face, 0 to 5.
    pub face: usize,
}

impl Solid {
    pub fn view(&self, world_from_camera: &Isometry3<f32>) -> View {
        let box_from_camera = self.world_from_box.inv_mul(world_from_camera);
        View {
            origin: box_from_camera.translation.vector,
            axes: box_from_camera.rotation.to_rotation_matrix().into_inner(),
        }
    }

    /// First surface beyond `near` along `direction` (box coordinates).
    #[inline]
    pub fn hit(&self, origin: &Vector3<f32>, direction: &Vector3<f32>, near: f32) -> Option<Hit> {
        let mut entry = (f32::MIN, 0);
        let mut exit = (f32::MAX, 0);
        for k in 0..3 {
            let d = direction[k];
            let inverse = if d.abs() < 1e-9 { 1e9_f32.copysign(d) } else { 1.0 / d };
            let low = (-self.half[k] - origin[k]) * inverse;
            let high = (self.half[k] - origin[k]) * inverse;
            let (first, last, flip) = if d < 0.0 { (high, low, 1) } else { (low, high, 0) };
            if first > entry.0 {
                entry = (first, 2 * k + flip);
            }
            if last < exit.0 {
                exit = (last, 2 * k + 1 - flip);
            }
        }
        let (distance, face) = if self.inside_out { exit } else { entry };
        (entry.0 < exit.0 && distance > near).then_some(Hit { distance, face })
    }

    #[inline]
    pub fn hit_in_view(&self, view: &View, ray: &Ray, near: f32) -> Option<Hit> {
        let direction = view.axes * ray.direction;
        self.hit(&view.origin, &direction, near)
    }

    /// Color of a hit in a view.
    #[inline]
    pub fn color(&self, view: &View, hit: Hit, ray: &Ray, grain: &Grain) -> Color {
        let direction = view.axes * ray.direction;
        let point = view.origin + direction * hit.distance;
        let (axis, u, v) = face_axes(hit.face);
        // The footprint of a pixel on the face: its edges, carried along the face's plane.
        let along = direction[axis];
        let along = if along.abs() < 1e-6 { 1e-6_f32.copysign(along) } else { along };
        let mut edges = [[0.0; 2]; 2];
        for (side, edge) in edges.iter_mut().enumerate() {
            let e = view.axes * (ray.across[side] * SPOT * hit.distance);
            let slide = e[axis] / along;
            *edge = [e[u] - direction[u] * slide, e[v] - direction[v] * slide];
        }
        let [dx, dy] = edges;
        let (s, t) = (point[u] + self.half[u], point[v] + self.half[v]);
        let face = &self.faces[hit.face];
        let base = face.texture.sample(s, t, dx, dy);
        let mut factor = face.light_at(s, t);
        let spread = (dx[0] * dy[1] - dx[1] * dy[0]).abs().sqrt();
        if spread < Grain::LIMIT {
            let [ds, dt] = face.grain_offset;
            factor *= 1.0 + face.grain_depth * (grain.factor(s + ds, t + dt, spread) - 1.0);
        }
        base.map(|c| c * factor)
    }

    /// Distance of the camera of a view from the box, m; 0 inside.
    pub fn distance(&self, view: &View) -> f32 {
        (view.origin.abs() - self.half).map(|beyond| beyond.max(0.0)).norm()
    }

    /// Corners in world coordinates.
    pub fn corners(&self) -> [Vector3<f32>; 8] {
        std::array::from_fn(|i| {
            let sign = |bit: usize| if i >> bit & 1 == 1 { 1.0 } else { -1.0 };
            let corner = Vector3::new(sign(0), sign(1), sign(2)).component_mul(&self.half);
            self.world_from_box * nalgebra::Point3::from(corner)
        })
        .map(|p| p.coords)
    }

    /// Cosine between the ray and the normal of the face it hits.
    pub fn incidence(view: &View, hit: Hit, ray: &Ray) -> f32 {
        let direction = view.axes * ray.direction;
        direction[hit.face / 2].abs() / direction.norm()
    }
}

/// Normal axis and the two axes of a face's coordinates; `v` is vertical on upright faces.
pub(super) fn face_axes(face: usize) -> (usize, usize, usize) {
    match face / 2 {
        0 => (0, 1, 2),
        1 => (1, 0, 2),
        _ => (2, 0, 1),
    }
}

#[cfg(test)]
mod tests {
    use parry3d::query::{Ray, RayCast};
    use parry3d::shape::Cuboid;
    use proptest::prelude::*;

    use super::*;

    fn vector(size: f32) -> impl Strategy<Value = Vector3<f32>> {
        [-size..size, -size..size, -size..size].prop_map(Vector3::from)
    }

    proptest! {
        /// The box test of this module, which is made for images, and that of a geometry library.
        #[test]
        fn rays_meet_boxes_where_parry_says(
            half in vector(1.0),
            origin in vector(4.0),
            target in vector(1.2),
        ) {
            let half = half.abs().add_scalar(0.1);
            let direction = target.component_mul(&half) - origin;
            let solid = Solid {
                world_from_box: Isometry3::identity(),
                half,
                inside_out: false,
                faces: Vec::new(),
            };
            let inside = origin.abs() < half;
            let ray = Ray::new(origin.into(), direction.into());
            let expected = Cuboid::new(half.into()).cast_local_ray_and_get_normal(&ray, 1e3, false);
            let solid = Solid { inside_out: inside, ..solid };
            let found = solid.hit(&origin, &direction, 0.0);
            match (found, expected) {
                (Some(hit), Some(expected)) => {
                    let tolerance = 1e-4 * (1.0 + expected.time_of_impact);
                    prop_assert!((hit.distance - expected.time_of_impact).abs() < tolerance);
                }
                (None, None) => {}
                // At an edge rounding decides.
                (found, expected) => {
                    let distance = found.map(|hit| hit.distance);
                    let distance = distance.or(expected.map(|hit| hit.time_of_impact));
                    let place = origin + direction * distance.unwrap_or_default();
                    let beyond = (place.abs() - half).map(f32::abs);
                    let edges = beyond.iter().filter(|x| **x < 1e-3).count();
                    prop_assert!(edges >= 2, "{found:?} {:?}", expected.map(|h| h.time_of_impact));
                }
            }
        }
    }
}
