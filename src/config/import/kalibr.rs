//! Kalibr's camchain and IMU files, and OpenVINS's, which have the same keys.
//!
//! `T_cam_imu` maps IMU to camera coordinates (Kalibr), `T_imu_cam` camera to IMU coordinates
//! (OpenVINS), `T_cn_cnm1` the coordinates of the camera before to those of this one. Both programs
//! have `t_imu = t_cam + timeshift_cam_imu`. Noises are densities.

use nalgebra::Matrix4;

use super::document::{Document, inverse};
use super::{Import, ImportError, ImportOptions};
use crate::sensor::CameraModel;

const NOISES: [(&str, &str); 4] = [
    ("gyro_noise", "gyroscope_noise_density"),
    ("accel_noise", "accelerometer_noise_density"),
    ("gyro_bias_walk", "gyroscope_random_walk"),
    ("accel_bias_walk", "accelerometer_random_walk"),
];

pub(super) fn is(document: &Document) -> bool {
    let structure = ["cam0", "imu0", "relative_config_imucam", "relative_config_imu"];
    structure.iter().chain(NOISES.map(|(_, key)| key).iter()).any(|key| document.has(key))
}

pub(super) fn read(
    document: &Document,
    options: &ImportOptions,
    import: &mut Import,
) -> Result<(), ImportError> {
    for key in ["relative_config_imu", "relative_config_imucam"] {
        if let Some(path) = document.reference(key) {
            import.read(&Document::read(&path)?, options)?;
        }
    }
    if let Some(gravity) = document.number("gravity_mag")? {
        import.imu_value("gravity", document, "gravity_mag", gravity)?;
    }
    let mut before = None;
    for camera in 0.. {
        if !document.has(&format!("cam{camera}")) {
            break;
        }
        before = read_camera(document, camera, before, import)?;
    }
    read_imu(document, import)
}

/// Returns the camera's pose in the IMU frame, if it is known.
fn read_camera(
    document: &Document,
    camera: usize,
    before: Option<Matrix4<f64>>,
    import: &mut Import,
) -> Result<Option<Matrix4<f64>>, ImportError> {
    let key = |name: &str| format!("cam{camera}.{name}");
    read_lens(document, camera, import)?;
    if let Some(shift) = document.number(&key("timeshift_cam_imu"))? {
        import.camera_value(camera, "time_offset", document, &key("timeshift_cam_imu"), shift)?;
        import.note(format!(
            "{}: timeshift_cam_imu is added to camera stamps: t_imu = t_cam + shift",
            document.path.display()
        ));
    }
    if let Some(topic) = document.text(&key("rostopic")) {
        import.note(format!("camera {camera} was calibrated on topic {topic}"));
    }
    let (to_camera, to_imu, chain) = (key("T_cam_imu"), key("T_imu_cam"), key("T_cn_cnm1"));
    let (pose, source, words) = if let Some(camera_from_imu) = document.pose(&to_camera)? {
        let words = "T_cam_imu maps IMU to camera coordinates; it was inverted";
        (inverse(&camera_from_imu), to_camera, words)
    } else if let Some(imu_from_camera) = document.pose(&to_imu)? {
        (imu_from_camera, to_imu, "T_imu_cam maps camera to IMU coordinates")
    } else if let (Some(from_previous), Some(previous)) = (document.pose(&chain)?, before) {
        let words = "T_cn_cnm1 maps the coordinates of the camera before to those of this one";
        (previous * inverse(&from_previous), chain, words)
    } else {
        return Ok(None);
    };
    import.note(format!("{}: {words}", document.path.display()));
    import.mounting(camera, document, &source, &pose)?;
    Ok(Some(pose))
}

fn read_lens(document: &Document, camera: usize, import: &mut Import) -> Result<(), ImportError> {
    let key = |name: &str| format!("cam{camera}.{name}");
    let (model, distortion) = (key("camera_model"), key("distortion_model"));
    let coefficients = key("distortion_coeffs");
    let source = key("intrinsics");
    let sources: [&str; 3] = [&model, &source, &coefficients];
    let is_distorted = match document.text(&distortion) {
        None | Some("none") => false,
        Some("radtan" | "equidistant" | "equi") => true,
        Some(_) => return Err(document.unsupported(&distortion, "radtan, equidistant and none")),
    };
    let four = || -> Result<[f64; 4], ImportError> {
        if is_distorted { document.list(&coefficients) } else { Ok([0.0; 4]) }
    };
    match document.text(&model).unwrap_or("pinhole") {
        "pinhole" => {
            let kind = match document.text(&distortion) {
                Some("equidistant" | "equi") => CameraModel::Equidistant,
                _ => CameraModel::RadialTangential,
            };
            let intrinsics = document.list(&source)?;
            import.lens(camera, document, sources, kind, intrinsics, four()?.to_vec())
        }
        "omni" => {
            if document.text(&distortion).is_some_and(|name| name.starts_with("equi")) {
                return Err(document.unsupported(&distortion, "radtan and none with omni"));
            }
            let [xi, fx, fy, cx, cy] = document.list(&source)?;
            let mut all = vec![xi];
            all.extend(four()?);
            let kind = CameraModel::Omnidirectional;
            import.lens(camera, document, sources, kind, [fx, fy, cx, cy], all)
        }
        "ds" => {
            let [xi, alpha, fx, fy, cx, cy] = document.list(&source)?;
            let kind = CameraModel::DoubleSphere;
            let sources: [&str; 3] = [&model, &source, &source];
            import.lens(camera, document, sources, kind, [fx, fy, cx, cy], vec![xi, alpha])
        }
        _ => Err(document.unsupported(&model, "pinhole, omni and ds")),
    }
}

fn read_imu(document: &Document, import: &mut Import) -> Result<(), ImportError> {
    let prefix = if document.has("imu0") { "imu0." } else { "" };
    for (ours, theirs) in NOISES {
        let theirs = format!("{prefix}{theirs}");
        if let Some(noise) = document.number(&theirs)? {
            import.imu_value(ours, document, &theirs, noise)?;
        }
    }
    if let Some(topic) = document.text(&format!("{prefix}rostopic")) {
        import.note(format!("the IMU was calibrated on topic {topic}"));
    }
    let path = document.path.display();
    let identity: Vec<f64> = nalgebra::Matrix3::<f64>::identity().iter().copied().collect();
    for name in ["Tw", "Ta", "R_IMUtoGYRO", "R_IMUtoACC"] {
        let matrix = document.numbers(&format!("{prefix}{name}"))?;
        if matrix.is_some_and(|matrix| matrix != identity) {
            import
                .note(format!("{path}: {name} (intrinsics of the IMU) has no key here; left out"));
        }
    }
    Ok(())
}
