use nalgebra::{Point3, Vector3};
use parry3d::math::Vector;
use parry3d::query::PointQuery;
use parry3d::shape::HalfSpace;

use crate::sensor::{Camera, PinholeCamera};

/// What an image shows, without near and far limits.
pub(super) enum Frustum<'a> {
    Pinhole(Pyramid),
    /// Any other lens: what it images onto pixels between two corners.
    Lens {
        camera: &'a Camera,
        /// Left and right, top and bottom, pixels.
        columns: [f64; 2],
        rows: [f64; 2],
    },
}

/// What a pinhole camera shows: four half-spaces through the camera's centre, in camera coordinates.
pub(super) struct Pyramid {
    sides: [HalfSpace; 4],
    /// Cosine of the angle between the optical axis and the furthest corner of the image.
    cos_half_angle: f64,
}

impl<'a> Frustum<'a> {
    /// Of an image widened by `margin` px on each side; `None` if that is not finite.
    pub fn new(camera: &'a Camera, width: usize, height: usize, margin: f64) -> Option<Self> {
        if !margin.is_finite() {
            return None;
        }
        // Pixels are squares around integer coordinates.
        let columns = [-0.5 - margin, width as f64 - 0.5 + margin];
        let rows = [-0.5 - margin, height as f64 - 0.5 + margin];
        Some(if camera.is_pinhole() {
            Self::Pinhole(Pyramid::new(camera.intrinsics(), columns, rows))
        } else {
            Self::Lens { camera, columns, rows }
        })
    }

    /// Centre (camera coordinates, m) and radius of a sphere around what is in view within
    /// `distance` (m) of the camera, a hair wider than need be.
    pub fn bounding_sphere(&self, distance: f64) -> (Point3<f64>, f64) {
        match self {
            Self::Pinhole(pyramid) => pyramid.bounding_sphere(distance),
            Self::Lens { .. } => (Point3::origin(), distance * (1.0 + 1e-6)),
        }
    }

    /// Whether a point in camera coordinates (m) is in view.
    pub fn contains(&self, point: &Point3<f64>) -> bool {
        match self {
            Self::Pinhole(pyramid) => pyramid.contains(point),
            Self::Lens { camera, columns, rows } => {
                camera.project(&point.coords).is_some_and(|pixel| {
                    (columns[0]..=columns[1]).contains(&pixel.x)
                        && (rows[0]..=rows[1]).contains(&pixel.y)
                })
            }
        }
    }
}

impl Pyramid {
    fn new(camera: &PinholeCamera, [left, right]: [f64; 2], [top, bottom]: [f64; 2]) -> Self {
        let PinholeCamera { fx, fy, cx, cy } = *camera;
        // A point is left of the column `left` where fx x + (cx - left) z < 0, and so on.
        let outward = [
            Vector3::new(-fx, 0.0, left - cx),
            Vector3::new(fx, 0.0, cx - right),
            Vector3::new(0.0, -fy, top - cy),
            Vector3::new(0.0, fy, cy - bottom),
        ];
        let tan_x = (cx - left).abs().max((right - cx).abs()) / fx;
        let tan_y = (cy - top).abs().max((bottom - cy).abs()) / fy;
        Self {
            sides: outward.map(|normal| HalfSpace::new(single(&normal.normalize()))),
            cos_half_angle: (1.0 + tan_x * tan_x + tan_y * tan_y).sqrt().recip(),
        }
    }

    /// For views narrower than 90 degrees the sphere passes through the camera's centre and the rim
    /// of the spherical cap; for wider ones the rim is its great circle.
    fn bounding_sphere(&self, distance: f64) -> (Point3<f64>, f64) {
        let cos = self.cos_half_angle;
        let (depth, radius) = if 2.0 * cos * cos > 1.0 {
            (distance / (2.0 * cos), distance / (2.0 * cos))
        } else {
            (distance * cos, distance * (1.0 - cos * cos).sqrt())
        };
        (Point3::new(0.0, 0.0, depth), radius * (1.0 + 1e-6))
    }

    /// In single precision, about 1e-4 px.
    fn contains(&self, point: &Point3<f64>) -> bool {
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
    use crate::sensor::{CameraConfig, CameraModel};
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_sphere_holds_all_that_is_in_view(
            f in 50.0..800.0f64, cx in 0.0..640.0f64, wide: bool,
            x in -1.0..1.0f64, y in -1.0..1.0f64, z in -0.5..1.0f64, distance in 0.0..=5.0f64,
        ) {
            let model = match wide {
                true => CameraModel::Equidistant,
                false => CameraModel::RadialTangential,
            };
            let distortion = if wide { vec![0.01, 0.0, 0.0, 0.0] } else { Vec::new() };
            let config = CameraConfig {
                fx: f, fy: f, cx, cy: 240.0, model, distortion, ..CameraConfig::default()
            };
            let camera = Camera::new(&config).unwrap();
            let frustum = Frustum::new(&camera, 640, 480, 20.0).unwrap();
            let point = Point3::from(Vector3::new(x, y, z).normalize() * distance);
            let (centre, radius) = frustum.bounding_sphere(5.0);
            prop_assert!(!frustum.contains(&point) || (point - centre).norm() <= radius);
        }
    }
}
