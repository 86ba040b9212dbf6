//! Camera models: directions to pixels and back.
//!
//! A [`Lens`] maps a point to the plane of an ideal image; focal lengths and principal point scale
//! that to pixels. Pixels are always those of the image as taken: nothing is undistorted, so views of
//! 180 degrees and more are as good as narrow ones.

mod config;
mod double_sphere;
mod equidistant;
mod monotone;
mod omnidirectional;
mod pinhole;
mod polynomial;

use nalgebra::{Matrix2, Matrix2x3, Matrix3, Matrix3x2, Point2, UnitVector3, Vector2, Vector3};
use serde::{Deserialize, Serialize};

pub use config::{CameraConfig, CameraError, CameraModel};
use double_sphere::DoubleSphere;
use equidistant::Equidistant;
use omnidirectional::Omnidirectional;
pub use pinhole::PinholeCamera;
use polynomial::Polynomial;

/// What a depth image measures.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DepthAlong {
    /// The range for the models of wide lenses ([`CameraModel::is_wide`]), else `z`.
    #[default]
    Auto,
    /// Distance along the optical axis, `z`: what depth cameras and stereo write.
    Axis,
    /// Range, the distance along the ray: what is also defined at 90 degrees and beyond.
    Ray,
}

/// A calibrated camera: how it images points, and what its depth means.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    intrinsics: PinholeCamera,
    lens: Lens,
    /// Whether depth is the range, not `z`.
    measures_range: bool,
}

/// How points are imaged on the plane that a pinhole camera has at `z = 1`.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Lens {
    Pinhole,
    Polynomial(Polynomial),
    Equidistant(Equidistant),
    DoubleSphere(DoubleSphere),
    Omnidirectional(Omnidirectional),
}

/// Points nearer to the plane of a pinhole are not imaged, m.
const NEAREST: f64 = 1e-6;

impl Camera {
    /// The camera that a configuration describes; its depth is that usual for the model.
    ///
    /// # Errors
    /// See [`CameraConfig::validate`].
    pub fn new(config: &CameraConfig) -> Result<Self, CameraError> {
        config.validate()?;
        Ok(Self {
            intrinsics: config.intrinsics(),
            lens: Lens::new(config.model, &config.distortion),
            measures_range: config.model.is_wide(),
        })
    }

    /// A camera without distortion, with depth along the optical axis.
    pub const fn pinhole(intrinsics: PinholeCamera) -> Self {
        Self { intrinsics, lens: Lens::Pinhole, measures_range: false }
    }

    /// The same with depth of the stated kind.
    pub fn with_depth(self, along: DepthAlong) -> Self {
        match along {
            DepthAlong::Auto => self,
            DepthAlong::Axis => Self { measures_range: false, ..self },
            DepthAlong::Ray => Self { measures_range: true, ..self },
        }
    }

    /// A pinhole camera with the same focal lengths and principal point.
    pub fn intrinsics(&self) -> &PinholeCamera {
        &self.intrinsics
    }

    /// Whether it is a pinhole camera without distortion.
    pub fn is_pinhole(&self) -> bool {
        matches!(self.lens, Lens::Pinhole)
    }

    /// Whether its depth is the range along the ray; else it is `z`.
    pub fn measures_range(&self) -> bool {
        self.measures_range
    }

    /// Pixel of a point in camera coordinates (m); `None` where the lens does not image it.
    #[inline]
    pub fn project(&self, point: &Vector3<f64>) -> Option<Point2<f64>> {
        match &self.lens {
            Lens::Pinhole => self.intrinsics.project(point),
            lens => lens.image(point).map(|image| self.pixel(&image)),
        }
    }

    /// Pixel of a point (camera coordinates, m) and its derivative by the point, px/m.
    pub fn project_with_jacobian(
        &self,
        point: &Vector3<f64>,
    ) -> Option<(Point2<f64>, Matrix2x3<f64>)> {
        let PinholeCamera { fx, fy, .. } = self.intrinsics;
        if self.is_pinhole() {
            let pixel = self.intrinsics.project(point)?;
            let (u, v) = (fx / point.z, fy / point.z);
            let (du, dv) = (-u * point.x / point.z, -v * point.y / point.z);
            return Some((pixel, Matrix2x3::new(u, 0.0, du, 0.0, v, dv)));
        }
        let (image, mut jacobian) = self.lens.image_with_jacobian(point)?;
        jacobian.row_mut(0).scale_mut(fx);
        jacobian.row_mut(1).scale_mut(fy);
        Some((self.pixel(&image), jacobian))
    }

    /// Direction (camera coordinates) of what is imaged at a pixel; `None` outside of what the lens
    /// images.
    pub fn bearing(&self, pixel: Point2<f64>) -> Option<UnitVector3<f64>> {
        self.lens.bearing(&self.image(pixel))
    }

    /// Point (camera coordinates, m) at `pixel` with `depth` (m), which is `z` or the range; `None`
    /// outside of what the lens images, and for `z` at 90 degrees and beyond.
    #[inline]
    pub fn unproject(&self, pixel: Point2<f64>, depth: f64) -> Option<Vector3<f64>> {
        if self.is_pinhole() && !self.measures_range {
            return Some(self.intrinsics.unproject(pixel, depth));
        }
        Some(self.ray(pixel)? * depth)
    }

    /// The point that is seen at `pixel` at depth 1.
    fn ray(&self, pixel: Point2<f64>) -> Option<Vector3<f64>> {
        let bearing = self.bearing(pixel)?.into_inner();
        if self.measures_range {
            Some(bearing)
        } else {
            (bearing.z > NEAREST).then(|| bearing / bearing.z)
        }
    }

    /// Depth (m) of a point (camera coordinates, m): `z` or the range.
    #[inline]
    pub fn depth_of(&self, point: &Vector3<f64>) -> f64 {
        if self.measures_range { point.norm() } else { point.z }
    }

    /// Direction in which the depth of a point (camera coordinates, m) grows: the optical axis or
    /// the ray.
    #[inline]
    pub fn depth_direction(&self, point: &Vector3<f64>) -> Vector3<f64> {
        if self.measures_range { point.normalize() } else { Vector3::z() }
    }

    /// How the point at `depth` (m) on a ray moves with the pixel, m/px: a column each for columns
    /// and rows. `ray` is the point at depth 1 on it.
    ///
    /// The point moves with its image, `J dr = du`, and keeps its depth, `n dr = 0`, with `J` the
    /// derivative of the projection and `n` that of the depth.
    pub fn across(&self, ray: &Vector3<f64>, depth: f64) -> Option<Matrix3x2<f64>> {
        if self.is_pinhole() && !self.measures_range {
            let PinholeCamera { fx, fy, .. } = self.intrinsics;
            let columns = [Vector3::x() * (depth / fx), Vector3::y() * (depth / fy)];
            return Some(Matrix3x2::from_columns(&columns));
        }
        let (_, projection) = self.project_with_jacobian(ray)?;
        let along = self.depth_direction(ray).transpose();
        let rows = [projection.row(0).into_owned(), projection.row(1).into_owned(), along];
        let inverse = Matrix3::from_rows(&rows).try_inverse()?;
        Some(inverse.fixed_columns::<2>(0) * depth)
    }

    /// Covariance (px^2) of the pixel of a point (m) with `covariance` (m^2), both in camera
    /// coordinates, to first order; infinite where the lens does not image it.
    pub fn pixel_covariance(
        &self,
        point: &Vector3<f64>,
        covariance: &Matrix3<f64>,
    ) -> Matrix2<f64> {
        match self.project_with_jacobian(point) {
            Some((_, jacobian)) => jacobian * covariance * jacobian.transpose(),
            None => Matrix2::from_diagonal_element(f64::INFINITY),
        }
    }

    /// Pixels that a `length` (m) across the ray covers at a point (camera coordinates, m), the
    /// camera being taken for an evenly resolved one.
    #[inline]
    pub fn pixels_across(&self, length: f64, point: &Vector3<f64>) -> f64 {
        self.intrinsics.fx * length / self.depth_of(point)
    }

    fn pixel(&self, image: &Vector2<f64>) -> Point2<f64> {
        let PinholeCamera { fx, fy, cx, cy } = self.intrinsics;
        Point2::new(fx * image.x + cx, fy * image.y + cy)
    }

    fn image(&self, pixel: Point2<f64>) -> Vector2<f64> {
        let PinholeCamera { fx, fy, cx, cy } = self.intrinsics;
        Vector2::new((pixel.x - cx) / fx, (pixel.y - cy) / fy)
    }
}

impl Lens {
    /// Of coefficients that have been validated; any that lack are 0.
    fn new(model: CameraModel, distortion: &[f64]) -> Self {
        fn padded<const N: usize>(given: &[f64]) -> [f64; N] {
            std::array::from_fn(|k| given.get(k).copied().unwrap_or(0.0))
        }
        match model {
            CameraModel::RadialTangential | CameraModel::Rational => {
                if distortion.iter().all(|k| *k == 0.0) {
                    Self::Pinhole
                } else {
                    Self::Polynomial(Polynomial::new(padded(distortion)))
                }
            }
            CameraModel::Equidistant => Self::Equidistant(Equidistant::new(padded(distortion))),
            CameraModel::DoubleSphere => {
                let [xi, alpha] = padded(distortion);
                Self::DoubleSphere(DoubleSphere::new(xi, alpha))
            }
            CameraModel::Omnidirectional => {
                Self::Omnidirectional(Omnidirectional::new(padded(distortion)))
            }
        }
    }

    fn image(&self, point: &Vector3<f64>) -> Option<Vector2<f64>> {
        let plane = || (point.z > NEAREST).then(|| point.xy() / point.z);
        match self {
            Self::Pinhole => plane(),
            Self::Polynomial(lens) => lens.distort(&plane()?),
            Self::Equidistant(lens) => lens.image(point),
            Self::DoubleSphere(lens) => lens.image(point),
            Self::Omnidirectional(lens) => lens.image(point),
        }
    }

    fn image_with_jacobian(&self, point: &Vector3<f64>) -> Option<(Vector2<f64>, Matrix2x3<f64>)> {
        let plane = || {
            let inverse = (point.z > NEAREST).then(|| point.z.recip())?;
            let plane = point.xy() * inverse;
            let jacobian =
                Matrix2x3::new(inverse, 0.0, -inverse * plane.x, 0.0, inverse, -inverse * plane.y);
            Some((plane, jacobian))
        };
        match self {
            Self::Pinhole => plane(),
            Self::Polynomial(lens) => {
                let (plane, jacobian) = plane()?;
                Some((lens.distort(&plane)?, lens.jacobian(&plane) * jacobian))
            }
            Self::Equidistant(lens) => lens.image_with_jacobian(point),
            Self::DoubleSphere(lens) => lens.image_with_jacobian(point),
            Self::Omnidirectional(lens) => lens.image_with_jacobian(point),
        }
    }

    fn bearing(&self, image: &Vector2<f64>) -> Option<UnitVector3<f64>> {
        let ray = |plane: &Vector2<f64>| {
            let ray = Vector3::new(plane.x, plane.y, 1.0);
            ray.iter().all(|x| x.is_finite()).then(|| UnitVector3::new_normalize(ray))
        };
        match self {
            Self::Pinhole => ray(image),
            Self::Polynomial(lens) => ray(&lens.undistort(image)?),
            Self::Equidistant(lens) => lens.bearing(image),
            Self::DoubleSphere(lens) => lens.bearing(image),
            Self::Omnidirectional(lens) => lens.bearing(image),
        }
    }
}

#[cfg(test)]
mod tests;
