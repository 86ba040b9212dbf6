//! The equidistant model with a polynomial in the angle.

use std::f64::consts::PI;

use nalgebra::{Matrix2x3, UnitVector3, Vector2, Vector3};

use super::monotone::{first_below_zero, invert};

/// Kannala and Brandt, *A generic camera model and calibration method*, 2006, with four
/// coefficients (KB4; OpenCV's `fisheye`, Kalibr's `equi`):
///
/// ```text
/// t = atan2(sqrt(x^2 + y^2), z)
/// d(t) = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)
/// image = d(t) (x, y) / sqrt(x^2 + y^2)
/// ```
///
/// Angles above 90 degrees are valid, up to where `d` stops growing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Equidistant {
    coefficients: [f64; 4],
    /// Largest angle, rad, and its image's radius.
    limit: f64,
    rim: f64,
}

impl Equidistant {
    pub fn new(coefficients: [f64; 4]) -> Self {
        let mut lens = Self { coefficients, limit: PI, rim: f64::INFINITY };
        lens.limit = first_below_zero(|angle| lens.slope(angle), PI);
        lens.rim = lens.radius(lens.limit);
        lens
    }

    fn radius(&self, angle: f64) -> f64 {
        let [k1, k2, k3, k4] = self.coefficients;
        let t2 = angle * angle;
        angle * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    }

    fn slope(&self, angle: f64) -> f64 {
        let [k1, k2, k3, k4] = self.coefficients;
        let t2 = angle * angle;
        1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
    }

    pub fn image(&self, point: &Vector3<f64>) -> Option<Vector2<f64>> {
        let r = point.x.hypot(point.y);
        let angle = r.atan2(point.z);
        let scale = self.scale(r, angle, point.z)?;
        Some(point.xy() * scale)
    }

    /// Image radius by lateral distance `r`; `None` beyond the limit and straight behind.
    fn scale(&self, r: f64, angle: f64, z: f64) -> Option<f64> {
        if r > 0.0 {
            (angle <= self.limit).then(|| self.radius(angle) / r)
        } else {
            (z > 0.0).then(|| z.recip())
        }
    }

    /// Image and its derivative.
    pub fn image_with_jacobian(
        &self,
        point: &Vector3<f64>,
    ) -> Option<(Vector2<f64>, Matrix2x3<f64>)> {
        let (x, y, z) = (point.x, point.y, point.z);
        let r = x.hypot(y);
        let angle = r.atan2(z);
        let scale = self.scale(r, angle, z)?;
        let slope = self.slope(angle) / (r * r + z * z);
        // d scale / dx = x (d'(t) z / |p|^2 - scale) / r^2.
        let (cx, cy) = if r > 0.0 { (x / r, y / r) } else { (0.0, 0.0) };
        let bend = slope * z - scale;
        let jacobian = Matrix2x3::new(
            scale + cx * cx * bend,
            cx * cy * bend,
            -slope * x,
            cx * cy * bend,
            scale + cy * cy * bend,
            -slope * y,
        );
        Some((point.xy() * scale, jacobian))
    }

    /// `None` outside of the image circle.
    pub fn bearing(&self, image: &Vector2<f64>) -> Option<UnitVector3<f64>> {
        let radius = image.norm();
        if radius > self.rim || radius.is_nan() {
            return None;
        }
        let angle = invert(|t| self.radius(t), |t| self.slope(t), radius, self.limit);
        let (sine, cosine) = angle.sin_cos();
        let lateral = if radius > 0.0 { sine / radius } else { 1.0 };
        let ray = Vector3::new(image.x * lateral, image.y * lateral, cosine);
        Some(UnitVector3::new_normalize(ray))
    }
}
