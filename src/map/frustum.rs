use nalgebra::{Point3, Vector3};
use parry3d::math::Vector;
use parry3d::query::PointQuery;
use parry3d::shape::HalfSpace;

use crate::sensor::PinholeCamera;

/// What an image shows, without near and far limits: four half-spaces through the camera's
/// centre, in camera coordinates.
pub(super) struct Frustum {
    sides: [HalfSpace; 4],
    /// Cosine of the angle between the optical axis and the furthest corner of the image.
    cos_half_angle: f64,
}

impl Frustum {
    /// Of an image widened by `margin` px on each side; `None` for cameras without a positive
    /// focal length or with anything that is not finite.
    pub fn new(camera: &PinholeCamera, width: usize, height: usize, margin: f64) -> Option<Self> {
        let PinholeCamera { fx, fy, cx, cy } = *camera;
        let finite = [fx, fy, cx, cy, margin].iter().all(|x| x.is_finite());
        if !(finite && fx > 0.0 && fy > 0.0) {
            return None;
        }
        // Pixels are squares around integer coordinates. A point is left of the column `left`
        // where fx x + (cx - left) z < 0, and so on.
        let (left, right) = (-0.5 - margin, width as f64 - 0.5 + margin);
        let (top, bottom) = (-0.5 - margin, height as f64 - 0.5 + margin);
        let outward = [
            Vector3::new(-fx, 0.0, left - cx),
            Vector3::new(fx, 0.0, cx - right),
            Vector3::new(0.0, -fy, top - cy),
            Vector3::new(0.0, fy, cy - bottom),
        ];
        let tan_x = (cx - left).abs().max((right - cx).abs()) / fx;
        let tan_y = (cy - top).abs().max((bottom - cy).abs()) / fy;
        Some(Self {
            sides: outward.map(|normal| HalfSpace::new(single(&normal.normalize()))),
            cos_half_angle: (1.0 + tan_x * tan_x + tan_y * tan_y).sqrt().recip(),
        })
    }

    /// Centre (camera coordinates, m) and radius of a sphere around what is in view within
    /// `distance` (m) of the camera, a hair wider than need be.
    ///
    /// For views narrower than 90 degrees it passes through the camera's centre and the rim of
    /// the spherical cap; for wider ones the rim is its great circle.
    pub fn bounding_sphere(&self, distance: f64) -> (Point3<f64>, f64) {
        let cos = self.cos_half_angle;
        let (depth, radius) = if 2.0 * cos * cos > 1.0 {
            (distance / (2.0 * cos), distance / (2.0 * cos))
        } else {
            (distance * cos, distance * (1.0 - cos * cos).sqrt())
        };
        (Point3::new(0.0, 0.0, depth), radius * (1.0 + 1e-6))
    }

    /// Whether a point in camera coordinates (m) is in view; single precision, about 1e-4 px.
    pub fn contains(&self, point: &Point3<f64>) -> bool {
        let local = single(&point.coords);
        point.z > 0.0 && self.sides.iter().all(|side| side.contains_local_point(local))
    }
}

fn single(v: &Vector3<f64>) -> Vector {
    Vector::new(v.x as f32, v.y as f32, v.z as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_sphere_holds_all_that_is_in_view(
            f in 50.0..800.0f64, cx in 0.0..640.0f64,
            x in -1.0..1.0f64, y in -1.0..1.0f64, z in 0.01..1.0f64, distance in 0.0..=5.0f64,
        ) {
            let camera = PinholeCamera { fx: f, fy: f, cx, cy: 240.0 };
            let frustum = Frustum::new(&camera, 640, 480, 20.0).unwrap();
            let point = Point3::from(Vector3::new(x, y, z).normalize() * distance);
            let (centre, radius) = frustum.bounding_sphere(5.0);
            prop_assert!(!frustum.contains(&point) || (point - centre).norm() <= radius);
        }
    }
}
