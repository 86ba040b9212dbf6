//! The unified omnidirectional model with distortion.

use nalgebra::{Matrix2x3, RowVector3, UnitVector3, Vector2, Vector3};

use super::polynomial::Polynomial;

/// Mei and Rives, *Single view point omnidirectional camera calibration from planar grids*, ICRA
/// 2007 (OpenCV's `omnidir`, Kalibr's `omni-radtan`): the point on the unit sphere is seen from `xi`
/// behind its centre, and the image distorted as that of a
/// [radial-tangential](Polynomial) camera:
///
/// ```text
/// image = distort((x, y) / (z + xi |p|))
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Omnidirectional {
    xi: f64,
    distortion: Polynomial,
    /// Points with `z <= -w |p|` are not seen.
    w: f64,
}

impl Omnidirectional {
    pub fn new([xi, k1, k2, p1, p2]: [f64; 5]) -> Self {
        let distortion = Polynomial::new([k1, k2, p1, p2, 0.0, 0.0, 0.0, 0.0]);
        Self { xi, distortion, w: if xi > 1.0 { xi.recip() } else { xi } }
    }

    /// On the plane, before the distortion.
    fn plane(&self, point: &Vector3<f64>) -> Option<Vector2<f64>> {
        let distance = point.norm();
        // Also refuses NaN.
        let seen = distance > 0.0 && point.z > -self.w * distance;
        seen.then(|| point.xy() / (point.z + self.xi * distance))
    }

    pub fn image(&self, point: &Vector3<f64>) -> Option<Vector2<f64>> {
        self.distortion.distort(&self.plane(point)?)
    }

    pub fn image_with_jacobian(
        &self,
        point: &Vector3<f64>,
    ) -> Option<(Vector2<f64>, Matrix2x3<f64>)> {
        let plane = self.plane(point)?;
        let image = self.distortion.distort(&plane)?;
        let distance = point.norm();
        let divisor = point.z + self.xi * distance;
        let d_divisor = RowVector3::new(0.0, 0.0, 1.0) + point.transpose() * (self.xi / distance);
        let jacobian = (Matrix2x3::identity() - plane * d_divisor) / divisor;
        Some((image, self.distortion.jacobian(&plane) * jacobian))
    }

    pub fn bearing(&self, image: &Vector2<f64>) -> Option<UnitVector3<f64>> {
        let plane = self.distortion.undistort(image)?;
        let r2 = plane.norm_squared();
        let root = 1.0 + (1.0 - self.xi * self.xi) * r2;
        if root < 0.0 || root.is_nan() {
            return None;
        }
        let factor = (self.xi + root.sqrt()) / (1.0 + r2);
        let ray = Vector3::new(factor * plane.x, factor * plane.y, factor - self.xi);
        UnitVector3::try_new(ray, 1e-9)
    }
}
