use nalgebra::{
    Isometry3, Matrix2, Matrix2x3, Matrix3, Matrix4, Point2, Rotation3, UnitQuaternion, Vector3,
};
use serde::{Deserialize, Serialize};

/// Intrinsics and mounting of the color camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CameraConfig {
    /// Focal lengths, pixels.
    pub fx: f64,
    pub fy: f64,
    /// Principal point, pixels, the centre of the top left pixel being (0, 0).
    pub cx: f64,
    pub cy: f64,
    /// Radial-tangential distortion `k1 k2 p1 p2 k3` (OpenCV's order); zeros for none.
    pub distortion: [f64; 5],
    /// Row-major 4x4 matrix that maps camera to IMU coordinates; its rotation part is
    /// re-orthonormalised.
    pub imu_from_camera: [[f64; 4]; 4],
    /// Added to camera stamps to bring them to the IMU's clock, s.
    pub time_offset: f64,
    /// Time from the exposure of the first row to that of the last one, s: a rolling shutter, whose
    /// middle row is exposed at the stamp; 0: all rows at once.
    pub readout_time: f64,
}

impl Default for CameraConfig {
    fn default() -> Self {
        Self {
            fx: 525.0,
            fy: 525.0,
            cx: 319.5,
            cy: 239.5,
            distortion: [0.0; 5],
            imu_from_camera: Matrix4::identity().transpose().into(),
            time_offset: 0.0,
            readout_time: 0.0,
        }
    }
}

impl CameraConfig {
    /// Pose of the camera in the IMU frame; `None` if the matrix is not close to a rigid motion.
    pub fn imu_from_camera(&self) -> Option<Isometry3<f64>> {
        let m = Matrix4::from_fn(|row, column| self.imu_from_camera[row][column]);
        let rotation: Matrix3<f64> = m.fixed_view::<3, 3>(0, 0).into_owned();
        let residual = (rotation.transpose() * rotation - Matrix3::identity()).norm();
        let finite = m.iter().all(|x| x.is_finite());
        if !(finite && residual < 1e-2 && rotation.determinant() > 0.0) {
            return None;
        }
        let rotation = Rotation3::from_matrix(&rotation);
        let translation = Vector3::new(m[(0, 3)], m[(1, 3)], m[(2, 3)]);
        let quaternion = UnitQuaternion::from_rotation_matrix(&rotation);
        Some(Isometry3::from_parts(translation.into(), quaternion))
    }
}

impl CameraConfig {
    /// Where the camera images what a camera without distortion would image at `pixel`: the
    /// radial-tangential model of OpenCV's `calib3d`.
    pub fn distort(&self, pixel: Point2<f64>) -> Point2<f64> {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let (x, y) = ((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy);
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        Point2::new(
            self.fx * (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)) + self.cx,
            self.fy * (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y) + self.cy,
        )
    }
}

/// A pinhole camera without distortion (images and key points are undistorted before).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PinholeCamera {
    pub fx: f64,
    pub fy: f64,
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

    /// Covariance (px^2) of the pixel of a point (m) with `covariance` (m^2), both in camera
    /// coordinates, to first order; infinite or NaN at depth 0.
    pub fn pixel_covariance(
        &self,
        point: &Vector3<f64>,
        covariance: &Matrix3<f64>,
    ) -> Matrix2<f64> {
        let (u, v) = (self.fx / point.z, self.fy / point.z);
        let jacobian =
            Matrix2x3::new(u, 0.0, -u * point.x / point.z, 0.0, v, -v * point.y / point.z);
        jacobian * covariance * jacobian.transpose()
    }
}

impl From<&CameraConfig> for PinholeCamera {
    fn from(config: &CameraConfig) -> Self {
        Self { fx: config.fx, fy: config.fy, cx: config.cx, cy: config.cy }
    }
}
