//! ORB-SLAM2 and 3: `Camera.fx` or `Camera1.fx`, `Tbc` or `IMU.T_b_c1` (camera to IMU coordinates),
//! noises as densities.

use super::document::Document;
use super::{Import, ImportError};
use crate::sensor::CameraModel;

const NOISES: [(&str, &str); 4] = [
    ("gyro_noise", "IMU.NoiseGyro"),
    ("accel_noise", "IMU.NoiseAcc"),
    ("gyro_bias_walk", "IMU.GyroWalk"),
    ("accel_bias_walk", "IMU.AccWalk"),
];

pub(super) fn is(document: &Document) -> bool {
    ["Camera.fx", "Camera1.fx"].iter().any(|key| document.has(key))
}

pub(super) fn read(document: &Document, import: &mut Import) -> Result<(), ImportError> {
    read_lens(document, if document.has("Camera1.fx") { "Camera1" } else { "Camera" }, 0, import)?;
    if document.has("Camera2.fx") {
        read_lens(document, "Camera2", 1, import)?;
    }
    let path = document.path.display();
    for key in ["Tbc", "IMU.T_b_c1"] {
        if let Some(pose) = document.pose(key)? {
            import.mounting(0, document, key, &pose)?;
            import.note(format!("{path}: {key} maps camera to IMU coordinates"));
            if let Some(left_from_right) = document.pose("Stereo.T_c1_c2")? {
                import.mounting(1, document, "Stereo.T_c1_c2", &(pose * left_from_right))?;
            }
        }
    }
    for (ours, theirs) in NOISES {
        if let Some(noise) = document.number(theirs)? {
            import.imu_value(ours, document, theirs, noise)?;
        }
    }
    Ok(())
}

fn read_lens(
    document: &Document,
    prefix: &str,
    camera: usize,
    import: &mut Import,
) -> Result<(), ImportError> {
    let key = |name: &str| format!("{prefix}.{name}");
    let required = |name: &str| document.required(&key(name));
    let optional = |name: &str| -> Result<f64, ImportError> {
        Ok(document.number(&key(name))?.unwrap_or(0.0))
    };
    let intrinsics = [required("fx")?, required("fy")?, required("cx")?, required("cy")?];
    let (model, coefficients) = match document.text("Camera.type").unwrap_or("PinHole") {
        "PinHole" => {
            let k = ["k1", "k2", "p1", "p2", "k3"].map(optional);
            let k = k.into_iter().collect::<Result<Vec<_>, _>>()?;
            (CameraModel::RadialTangential, k)
        }
        "Rectified" => (CameraModel::RadialTangential, Vec::new()),
        "KannalaBrandt8" => {
            let k = ["k1", "k2", "k3", "k4"].map(required);
            (CameraModel::Equidistant, k.into_iter().collect::<Result<Vec<_>, _>>()?)
        }
        _ => {
            let supported = "PinHole, Rectified and KannalaBrandt8";
            return Err(document.unsupported("Camera.type", supported));
        }
    };
    let (focal, first) = (key("fx"), key("k1"));
    import.lens(camera, document, ["Camera.type", &focal, &first], model, intrinsics, coefficients)
}
