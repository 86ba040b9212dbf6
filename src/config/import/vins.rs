//! The configurations of VINS-Mono and VINS-Fusion, and the camera files of the latter.
//!
//! `body_T_cam0`, and `extrinsicRotation` with `extrinsicTranslation`, map camera to IMU
//! coordinates; `td` is added to image stamps. `acc_n` and the like are standard deviations of a
//! sample, not densities: over an interval `dt` they add `(acc_n dt)^2` to the variance of the
//! velocity, where a density adds `density^2 dt`.

use super::document::Document;
use super::{Import, ImportError, ImportOptions};
use crate::sensor::CameraModel;

const NOISES: [(&str, &str); 4] = [
    ("gyro_noise", "gyr_n"),
    ("accel_noise", "acc_n"),
    ("gyro_bias_walk", "gyr_w"),
    ("accel_bias_walk", "acc_w"),
];

pub(super) fn is(document: &Document) -> bool {
    ["projection_parameters", "body_T_cam0", "extrinsicRotation", "cam0_calib", "model_type"]
        .iter()
        .any(|key| document.has(key))
}

pub(super) fn read(
    document: &Document,
    options: &ImportOptions,
    import: &mut Import,
) -> Result<(), ImportError> {
    let path = document.path.display();
    for (camera, key) in ["cam0_calib", "cam1_calib"].into_iter().enumerate() {
        if let Some(path) = document.reference(key) {
            import.files.push(path.clone());
            read_lens(&Document::read(&path)?, camera, import)?;
        }
    }
    if document.has("projection_parameters") || document.has("model_type") {
        read_lens(document, 0, import)?;
    }
    for (camera, key) in ["body_T_cam0", "body_T_cam1"].into_iter().enumerate() {
        if let Some(pose) = document.pose(key)? {
            import.mounting(camera, document, key, &pose)?;
            import.note(format!("{path}: body_T_cam maps camera to IMU coordinates"));
        }
    }
    if let Some(pose) = document.pose_in_parts("extrinsicRotation", "extrinsicTranslation")? {
        import.mounting(0, document, "extrinsicRotation", &pose)?;
        import.note(format!("{path}: extrinsicRotation maps camera to IMU coordinates"));
    }
    if let Some(offset) = document.number("td")? {
        for camera in import.cameras.keys().copied().collect::<Vec<_>>() {
            import.camera_value(camera, "time_offset", document, "td", offset)?;
        }
        import.note(format!("{path}: td is added to image stamps: t_imu = t_image + td"));
    }
    if document.number("rolling_shutter")?.is_some_and(|on| on != 0.0) {
        let readout = document.required("rolling_shutter_tr")?;
        import.camera_value(0, "readout_time", document, "rolling_shutter_tr", readout)?;
    }
    if let Some(gravity) = document.number("g_norm")? {
        import.imu_value("gravity", document, "g_norm", gravity)?;
    }
    read_noise(document, options, import)
}

fn read_noise(
    document: &Document,
    options: &ImportOptions,
    import: &mut Import,
) -> Result<(), ImportError> {
    let scale = options.imu_rate.map_or(1.0, |rate| rate.sqrt().recip());
    for (ours, theirs) in NOISES {
        let Some(noise) = document.number(theirs)? else { continue };
        import.imu_value(ours, document, theirs, noise * scale)?;
        let path = document.path.display();
        import.note(match options.imu_rate {
            Some(rate) => format!(
                "{path}: acc_n, gyr_n, acc_w and gyr_w are standard deviations of a sample; divided \
                 by sqrt({rate} Hz) they are densities"
            ),
            None => format!(
                "{path}: acc_n, gyr_n, acc_w and gyr_w are standard deviations of a sample, copied \
                 as if they were densities, which is pessimistic; --imu-rate HZ converts them"
            ),
        });
    }
    Ok(())
}

fn read_lens(document: &Document, camera: usize, import: &mut Import) -> Result<(), ImportError> {
    let projection = |name: &str| document.required(&format!("projection_parameters.{name}"));
    let distortion = |name: &str| -> Result<f64, ImportError> {
        Ok(document.number(&format!("distortion_parameters.{name}"))?.unwrap_or(0.0))
    };
    let four = |names: [&str; 4]| -> Result<[f64; 4], ImportError> {
        let [a, b, c, d] = names;
        Ok([projection(a)?, projection(b)?, projection(c)?, projection(d)?])
    };
    let tangential = || -> Result<[f64; 4], ImportError> {
        Ok([distortion("k1")?, distortion("k2")?, distortion("p1")?, distortion("p2")?])
    };
    let sources = ["model_type", "projection_parameters", "distortion_parameters"];
    match document.text("model_type").unwrap_or("PINHOLE") {
        "PINHOLE" => {
            let mut coefficients = tangential()?.to_vec();
            coefficients.push(distortion("k3")?);
            let (model, intrinsics) =
                (CameraModel::RadialTangential, four(["fx", "fy", "cx", "cy"])?);
            import.lens(camera, document, sources, model, intrinsics, coefficients)
        }
        "MEI" => {
            let mut coefficients = vec![document.required("mirror_parameters.xi")?];
            coefficients.extend(tangential()?);
            let model = CameraModel::Omnidirectional;
            let intrinsics = four(["gamma1", "gamma2", "u0", "v0"])?;
            import.lens(camera, document, sources, model, intrinsics, coefficients)
        }
        // Its polynomial begins with the third power, so that `k2` is our `k1`.
        "KANNALA_BRANDT" => {
            let coefficients = four(["k2", "k3", "k4", "k5"])?.to_vec();
            let sources = ["model_type", "projection_parameters", "projection_parameters"];
            let (model, intrinsics) = (CameraModel::Equidistant, four(["mu", "mv", "u0", "v0"])?);
            import.lens(camera, document, sources, model, intrinsics, coefficients)
        }
        _ => Err(document.unsupported("model_type", "PINHOLE, MEI and KANNALA_BRANDT")),
    }
}
