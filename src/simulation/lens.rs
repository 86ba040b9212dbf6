//! The rays of the pixels, for any camera model.

use nalgebra::{Matrix2, Point2, Vector2, Vector3};

use crate::sensor::{Camera, DepthAlong};

/// What a pixel looks along.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Ray {
    /// Camera coordinates; `z` is 1 for a pinhole, the length is 1 for other lenses.
    pub direction: Vector3<f32>,
    /// How `direction` changes from column to column and from row to row.
    pub across: [Vector3<f32>; 2],
}

/// The rays of an image.
#[derive(Debug, Clone)]
pub(super) struct Lens {
    /// Principal point (pixels), and the size of a pixel in the plane `z = 1`, of a pinhole.
    center: [f32; 2],
    pixel: [f32; 2],
    /// By pixel, row by row, `None` where the lens images nothing; empty for a pinhole.
    rays: Vec<Option<Ray>>,
    width: usize,
    measures_range: bool,
}

impl Lens {
    pub fn new(camera: &Camera, width: usize, height: usize) -> Self {
        let ray = |row: usize, column: usize| {
            let pixel = Point2::new(column as f64, row as f64);
            let direction = camera.bearing(pixel)?.into_inner();
            // As points at range 1 move with the pixel.
            let across = camera.with_depth(DepthAlong::Ray).across(&direction, 1.0)?;
            let across =
                [across.column(0).into_owned().cast(), across.column(1).into_owned().cast()];
            Some(Ray { direction: direction.cast(), across })
        };
        let rays = match camera.is_pinhole() && !camera.measures_range() {
            true => Vec::new(),
            false => (0..height)
                .flat_map(|row| (0..width).map(move |column| (row, column)))
                .map(|(row, column)| ray(row, column))
                .collect(),
        };
        let pinhole = camera.intrinsics();
        Self {
            center: [pinhole.cx as f32, pinhole.cy as f32],
            pixel: [1.0 / pinhole.fx as f32, 1.0 / pinhole.fy as f32],
            rays,
            width,
            measures_range: camera.measures_range(),
        }
    }

    /// Whether [`Ray::direction`] is a point of the plane `z = 1`.
    pub fn is_pinhole(&self) -> bool {
        self.rays.is_empty()
    }

    fn on_plane(&self, column: f32, row: f32) -> (f32, f32) {
        ((column - self.center[0]) * self.pixel[0], (row - self.center[1]) * self.pixel[1])
    }

    /// The ray of a place between pixels, to first order from the nearest one.
    #[inline]
    pub fn ray(&self, column: f32, row: f32) -> Option<Ray> {
        if self.is_pinhole() {
            let (x, y) = self.on_plane(column, row);
            let across = [Vector3::x() * self.pixel[0], Vector3::y() * self.pixel[1]];
            return Some(Ray { direction: Vector3::new(x, y, 1.0), across });
        }
        let last = |count: usize| count.saturating_sub(1) as f32;
        let x = column.round().clamp(0.0, last(self.width));
        let y = row.round().clamp(0.0, last(self.rays.len() / self.width));
        let nearest = self.rays.get(y as usize * self.width + x as usize).copied().flatten()?;
        let [along_x, along_y] = nearest.across;
        let direction = nearest.direction + along_x * (column - x) + along_y * (row - y);
        Some(Ray { direction, ..nearest })
    }

    /// Depth (m) as the camera measures it of what is `distance` lengths of the ray's direction away.
    pub fn depth(&self, ray: &Ray, distance: f32) -> f32 {
        let axial = !self.is_pinhole() && !self.measures_range;
        if axial { distance * ray.direction.z } else { distance }
    }

    /// Pixels by which a place moves in the image that is seen along a changing direction.
    pub fn motion(&self, ray: &Ray, change: &Vector3<f32>) -> [f32; 2] {
        if self.is_pinhole() {
            let (x, y) = (ray.direction.x, ray.direction.y);
            return [
                (change.x - x * change.z) / self.pixel[0],
                (change.y - y * change.z) / self.pixel[1],
            ];
        }
        // Across the ray: `change = across (du, dv)`, in the least squares sense.
        let [a, b] = &ray.across;
        let normal = Matrix2::new(a.dot(a), a.dot(b), a.dot(b), b.dot(b));
        let right = Vector2::new(a.dot(change), b.dot(change));
        normal.try_inverse().map_or([0.0; 2], |inverse| (inverse * right).into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::{CameraConfig, CameraModel};

    fn wide() -> Camera {
        let config = CameraConfig {
            model: CameraModel::Equidistant,
            fx: 40.0,
            fy: 41.0,
            cx: 79.5,
            cy: 59.5,
            distortion: vec![0.02, -0.004, 0.0, 0.0],
            ..CameraConfig::default()
        };
        Camera::new(&config).unwrap()
    }

    #[test]
    fn rays_between_pixels_are_those_of_the_camera() {
        let (camera, lens) = (wide(), Lens::new(&wide(), 160, 120));
        for (column, row) in [(80.0, 60.0), (30.3, 40.8), (159.2, 10.75)] {
            let ray = lens.ray(column, row).unwrap();
            let pixel = Point2::new(f64::from(column), f64::from(row));
            let exact = camera.bearing(pixel).unwrap();
            assert!(exact.angle(&ray.direction.cast()) < 2e-4, "{pixel}");
        }
    }

    /// A point that moves, against its pixels before and after.
    #[test]
    fn places_move_as_the_camera_images_them() {
        let (camera, lens) = (wide(), Lens::new(&wide(), 160, 120));
        let ray = lens.ray(20.0, 100.0).unwrap();
        let change = Vector3::new(2e-3, -1e-3, 3e-3_f32);
        let [du, dv] = lens.motion(&ray, &change);
        let moved = camera.project(&(ray.direction + change).cast()).unwrap();
        let expected = moved - Point2::new(20.0, 100.0);
        assert!((f64::from(du) - expected.x).hypot(f64::from(dv) - expected.y) < 2e-3);
    }
}
