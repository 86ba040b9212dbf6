//! Distortion by polynomials in the image plane, as OpenCV's `calib3d` has it.

use nalgebra::{Matrix2, Vector2};

use super::monotone::{first_below_zero, invert};

/// Radial (a ratio of polynomials) and tangential distortion of a point `(x, y)` of the plane `z = 1`:
///
/// ```text
/// x' = x R + 2 p1 x y + p2 (r^2 + 2 x^2)      R = 1 + k1 r^2 + k2 r^4 + k3 r^6
/// y' = y R + p1 (r^2 + 2 y^2) + 2 p2 x y          ----------------------------
///                                                 1 + k4 r^2 + k5 r^4 + k6 r^6
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Polynomial {
    numerator: [f64; 3],
    denominator: [f64; 3],
    tangential: [f64; 2],
    /// Square of the radius up to which the radial part grows: beyond it the model folds back and
    /// images nothing.
    limit: f64,
}

impl Polynomial {
    /// Radius in the plane `z = 1` up to which the model is examined: 87 degrees off the axis.
    const FARTHEST: f64 = 20.0;

    /// From `k1 k2 p1 p2 k3 k4 k5 k6`, OpenCV's order.
    pub fn new([k1, k2, p1, p2, k3, k4, k5, k6]: [f64; 8]) -> Self {
        let mut lens = Self {
            numerator: [k1, k2, k3],
            denominator: [k4, k5, k6],
            tangential: [p1, p2],
            limit: Self::FARTHEST.powi(2),
        };
        lens.limit = first_below_zero(|radius| lens.slope(radius), Self::FARTHEST).powi(2);
        lens
    }

    /// Derivative of the imaged radius by the radius.
    fn slope(&self, radius: f64) -> f64 {
        let (radial, derivative) = self.radial(radius * radius);
        radial + 2.0 * radius * radius * derivative
    }

    /// `R` at a squared radius, and its derivative by the squared radius.
    fn radial(&self, r2: f64) -> (f64, f64) {
        let value = |[a, b, c]: [f64; 3]| 1.0 + r2 * (a + r2 * (b + r2 * c));
        let slope = |[a, b, c]: [f64; 3]| a + r2 * (2.0 * b + r2 * 3.0 * c);
        let (above, below) = (value(self.numerator), value(self.denominator));
        let radial = above / below;
        (radial, (slope(self.numerator) - radial * slope(self.denominator)) / below)
    }

    /// Where a point of the plane is imaged; `None` beyond the limit.
    pub fn distort(&self, point: &Vector2<f64>) -> Option<Vector2<f64>> {
        let r2 = point.norm_squared();
        // Also refuses NaN.
        (r2 <= self.limit).then(|| self.image(point, r2))
    }

    fn image(&self, point: &Vector2<f64>, r2: f64) -> Vector2<f64> {
        let (x, y) = (point.x, point.y);
        let ([p1, p2], (radial, _)) = (self.tangential, self.radial(r2));
        Vector2::new(
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        )
    }

    /// Derivative of [`Self::distort`].
    pub fn jacobian(&self, point: &Vector2<f64>) -> Matrix2<f64> {
        let (x, y) = (point.x, point.y);
        let ([p1, p2], (radial, slope)) = (self.tangential, self.radial(point.norm_squared()));
        let mixed = 2.0 * (slope * x * y + p1 * x + p2 * y);
        Matrix2::new(
            radial + 2.0 * slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
            mixed,
            mixed,
            radial + 2.0 * slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
        )
    }

    /// The point of the plane that is imaged at `image`; `None` where there is none within the limit.
    ///
    /// The radial part is inverted first; Newton's method in two dimensions adds the small rest.
    pub fn undistort(&self, image: &Vector2<f64>) -> Option<Vector2<f64>> {
        const MAX_STEPS: usize = 20;
        const STEP: f64 = 1e-14;
        const TOLERANCE: f64 = 1e-10;
        let imaged = |radius: f64| radius * self.radial(radius * radius).0;
        let radius = image.norm();
        let start = invert(imaged, |r| self.slope(r), radius, self.limit.sqrt());
        let mut point = if radius > 0.0 { image * (start / radius) } else { *image };
        let error = |point: &Vector2<f64>| self.image(point, point.norm_squared()) - image;
        for _ in 0..MAX_STEPS {
            let step = self.jacobian(&point).try_inverse()? * error(&point);
            point -= step;
            if step.norm() <= STEP * (1.0 + point.norm()) {
                break;
            }
        }
        // Also refuses NaN, and where the steps have led nowhere.
        let found = error(&point).norm() <= TOLERANCE * (1.0 + image.norm());
        (found && point.norm_squared() <= self.limit).then_some(point)
    }
}
