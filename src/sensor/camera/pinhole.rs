use nalgebra::{Point2, Vector3};

/// A pinhole camera without distortion: what a rectified or undistorted image was taken with.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PinholeCamera {
    /// Focal lengths, pixels.
    pub fx: f64,
    pub fy: f64,
    /// Principal point, pixels, the centre of the top left pixel being (0, 0).
    pub cx: f64,
    pub cy: f64,
}

impl PinholeCamera {
    /// Pixel of a point in camera coordinates (m); `None` at or behind the camera.
    pub fn project(&self, point: &Vector3<f64>) -> Option<Point2<f64>> {
        (point.z > 1e-6).then(|| {
            Point2::new(
                self.fx * point.x / point.z + self.cx,
                self.fy * point.y / point.z + self.cy,
            )
        })
    }

    /// Point in camera coordinates (m) at `pixel` with `depth` (m) along the optical axis.
    pub fn unproject(&self, pixel: Point2<f64>, depth: f64) -> Vector3<f64> {
        Vector3::new(
            (pixel.x - self.cx) / self.fx * depth,
            (pixel.y - self.cy) / self.fy * depth,
            depth,
        )
    }
}
