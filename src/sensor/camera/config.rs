use nalgebra::{Isometry3, Matrix3, Matrix4, Rotation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use super::PinholeCamera;

/// How a lens images directions; the coefficients are those of [`CameraConfig::distortion`].
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum CameraModel {
    /// Pinhole with `k1 k2 p1 p2 [k3]` (OpenCV's order; `plumb_bob`); none or zeros: no distortion.
    #[default]
    RadialTangential,
    /// Pinhole with `k1 k2 p1 p2 k3 k4 k5 k6` (OpenCV's rational model).
    Rational,
    /// Kannala-Brandt with `k1 k2 k3 k4` (KB4; OpenCV's `fisheye`, Kalibr's `equi`).
    Equidistant,
    /// Double sphere with `xi alpha`.
    DoubleSphere,
    /// Mei's unified model with `xi k1 k2 p1 p2` (OpenCV's `omnidir`, Kalibr's `omni-radtan`).
    Omnidirectional,
}

impl CameraModel {
    /// Every model.
    pub const ALL: [Self; 5] = [
        Self::RadialTangential,
        Self::Rational,
        Self::Equidistant,
        Self::DoubleSphere,
        Self::Omnidirectional,
    ];

    /// Its name in configurations.
    pub fn name(self) -> &'static str {
        match self {
            Self::RadialTangential => "radial-tangential",
            Self::Rational => "rational",
            Self::Equidistant => "equidistant",
            Self::DoubleSphere => "double-sphere",
            Self::Omnidirectional => "omnidirectional",
        }
    }

    /// The names of its coefficients, in order.
    pub fn coefficients(self) -> &'static str {
        match self {
            Self::RadialTangential => "k1 k2 p1 p2 [k3]",
            Self::Rational => "k1 k2 p1 p2 k3 k4 k5 k6",
            Self::Equidistant => "k1 k2 k3 k4",
            Self::DoubleSphere => "xi alpha",
            Self::Omnidirectional => "xi k1 k2 p1 p2",
        }
    }

    /// Whether views of 180 degrees and more are usual: depth is then that along the ray.
    pub fn is_wide(self) -> bool {
        match self {
            Self::RadialTangential | Self::Rational => false,
            Self::Equidistant | Self::DoubleSphere | Self::Omnidirectional => true,
        }
    }
}

/// Intrinsics and mounting of the color camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CameraConfig {
    /// How the lens images directions.
    pub model: CameraModel,
    /// Focal lengths, pixels.
    pub fx: f64,
    pub fy: f64,
    /// Principal point, pixels, the centre of the top left pixel being (0, 0).
    pub cx: f64,
    pub cy: f64,
    /// Coefficients of `model`, in the order of [`CameraModel::coefficients`].
    pub distortion: Vec<f64>,
    /// Row-major 4x4 matrix that maps camera to IMU coordinates; its rotation part is
    /// re-orthonormalised.
    pub imu_from_camera: [[f64; 4]; 4],
    /// Added to camera stamps to bring them to the IMU's clock, s.
    pub time_offset: f64,
    /// Time from the exposure of the first row to that of the last one, s: a rolling shutter, whose
    /// middle row is exposed at the stamp; 0: all rows at once.
    pub readout_time: f64,
}

/// A calibration that describes no camera.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CameraError {
    /// A number that cannot be.
    #[error("{key} = {value}: {requirement}")]
    Value { key: &'static str, value: f64, requirement: &'static str },
    /// Not as many coefficients as the model has.
    #[error("distortion has {given} numbers; model \"{}\" takes {}", .model.name(), .model.coefficients())]
    Coefficients { model: CameraModel, given: usize },
}

impl CameraError {
    /// The key of [`CameraConfig`] at fault.
    pub fn key(&self) -> &'static str {
        match self {
            Self::Value { key, .. } => key,
            Self::Coefficients { .. } => "distortion",
        }
    }
}

impl Default for CameraConfig {
    fn default() -> Self {
        Self {
            model: CameraModel::default(),
            fx: 525.0,
            fy: 525.0,
            cx: 319.5,
            cy: 239.5,
            distortion: Vec::new(),
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

    /// A pinhole camera with the same focal lengths and principal point.
    pub fn intrinsics(&self) -> PinholeCamera {
        PinholeCamera { fx: self.fx, fy: self.fy, cx: self.cx, cy: self.cy }
    }

    /// Checks what describes the lens: [`Self::model`] to [`Self::distortion`].
    ///
    /// # Errors
    /// Names the first key with a number that no camera has.
    pub fn validate(&self) -> Result<(), CameraError> {
        let require = |key, value: f64, good: bool, requirement| {
            if good { Ok(()) } else { Err(CameraError::Value { key, value, requirement }) }
        };
        for (key, focal) in [("fx", self.fx), ("fy", self.fy)] {
            let good = focal > 0.0 && focal.is_finite();
            require(key, focal, good, "a focal length in pixels must be positive")?;
        }
        for (key, center) in [("cx", self.cx), ("cy", self.cy)] {
            require(key, center, center.is_finite(), "the principal point must be finite")?;
        }
        for k in &self.distortion {
            require("distortion", *k, k.is_finite(), "coefficients must be finite")?;
        }
        let wrong_number =
            || CameraError::Coefficients { model: self.model, given: self.distortion.len() };
        match (self.model, &self.distortion[..]) {
            (CameraModel::RadialTangential, [] | [_, _, _, _] | [_, _, _, _, _])
            | (CameraModel::Rational, [_, _, _, _, _, _, _, _])
            | (CameraModel::Equidistant, [_, _, _, _]) => Ok(()),
            (CameraModel::DoubleSphere, [xi, alpha]) => {
                require("distortion", *xi, xi.abs() < 1.0, "xi must be between -1 and 1")?;
                let good = (0.0..=1.0).contains(alpha);
                require("distortion", *alpha, good, "alpha must be from 0 to 1")
            }
            (CameraModel::Omnidirectional, [xi, _, _, _, _]) => {
                require("distortion", *xi, *xi >= 0.0, "xi must be 0 or more")
            }
            _ => Err(wrong_number()),
        }
    }
}
