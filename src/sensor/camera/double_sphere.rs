//! The double sphere model.

use nalgebra::{Matrix2x3, RowVector3, UnitVector3, Vector2, Vector3};

/// Usenko, Demmel and Cremers, *The Double Sphere Camera Model*, 3DV 2018, eqs. 40 to 46:
///
/// ```text
/// d1 = |p|,  q = xi d1 + z,  d2 = sqrt(x^2 + y^2 + q^2)
/// image = (x, y) / (alpha d2 + (1 - alpha) q)
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct DoubleSphere {
    xi: f64,
    alpha: f64,
    /// Points with `z <= -w2 |p|` are not seen.
    w2: f64,
}

impl DoubleSphere {
    pub fn new(xi: f64, alpha: f64) -> Self {
        let w1 = if alpha > 0.5 { (1.0 - alpha) / alpha } else { alpha / (1.0 - alpha) };
        Self { xi, alpha, w2: (w1 + xi) / (2.0 * w1 * xi + xi * xi + 1.0).sqrt() }
    }

    pub fn image(&self, point: &Vector3<f64>) -> Option<Vector2<f64>> {
        let d1 = point.norm();
        // Also refuses NaN.
        let seen = d1 > 0.0 && point.z > -self.w2 * d1;
        let q = self.xi * d1 + point.z;
        let d2 = (point.xy().norm_squared() + q * q).sqrt();
        seen.then(|| point.xy() / (self.alpha * d2 + (1.0 - self.alpha) * q))
    }

    pub fn image_with_jacobian(
        &self,
        point: &Vector3<f64>,
    ) -> Option<(Vector2<f64>, Matrix2x3<f64>)> {
        let image = self.image(point)?;
        let d1 = point.norm();
        let q = self.xi * d1 + point.z;
        let d2 = (point.xy().norm_squared() + q * q).sqrt();
        let divisor = self.alpha * d2 + (1.0 - self.alpha) * q;
        let d_q = RowVector3::new(0.0, 0.0, 1.0) + point.transpose() * (self.xi / d1);
        let d_d2 = (RowVector3::new(point.x, point.y, 0.0) + d_q * q) / d2;
        let d_divisor = d_d2 * self.alpha + d_q * (1.0 - self.alpha);
        let jacobian = (Matrix2x3::identity() - image * d_divisor) / divisor;
        Some((image, jacobian))
    }

    pub fn bearing(&self, image: &Vector2<f64>) -> Option<UnitVector3<f64>> {
        let (xi, alpha) = (self.xi, self.alpha);
        let r2 = image.norm_squared();
        let root = 1.0 - (2.0 * alpha - 1.0) * r2;
        if root < 0.0 || root.is_nan() {
            return None;
        }
        let mz = (1.0 - alpha * alpha * r2) / (alpha * root.sqrt() + 1.0 - alpha);
        let inner = mz * mz + (1.0 - xi * xi) * r2;
        if inner < 0.0 || inner.is_nan() {
            return None;
        }
        let factor = (mz * xi + inner.sqrt()) / (mz * mz + r2);
        let ray = Vector3::new(factor * image.x, factor * image.y, factor * mz - xi);
        UnitVector3::try_new(ray, 1e-9)
    }
}
