//! OpenLORIS-Scene folders: lists of images like TUM's, gyroscope and accelerometer in files of
//! their own, calibrations in `sensors.yaml` and `trans_matrix.yaml`.
//!
//! Format: <https://lifelong-robotic-vision.github.io/dataset/scene.html>. Color and aligned depth
//! of the D435i are read with its IMU. The reference poses are those of the robot's base.

use std::path::Path;

use nalgebra::{Isometry3, Matrix4, Rotation3, UnitQuaternion, Vector3};

use super::folder::{Entry, Listing, read_text};
use super::message::isometry;
use super::pixels::Rejection;
use super::tum::{image_path, read_list};
use super::{LogConfig, LogError, LogSummary, TruthPose};
use crate::sensor::{CameraConfig, Stamp};

const COLOR_LIST: &str = "color.txt";
const DEPTH_LIST: &str = "aligned_depth.txt";
const GYROSCOPE: &str = "d400_gyroscope.txt";
const ACCELEROMETER: &str = "d400_accelerometer.txt";
const TRUTH_LIST: &str = "groundtruth.txt";
const SENSORS: &str = "sensors.yaml";
const TRANSFORMS: &str = "trans_matrix.yaml";

const BASE_FRAME: &str = "base_link";
const COLOR_FRAME: &str = "d400_color_optical_frame";
const IMU_FRAME: &str = "d400_gyroscope";

pub(super) fn is_openloris(folder: &Path) -> bool {
    let has = |name: &str| folder.join(name).is_file();
    has(COLOR_LIST) && (has(DEPTH_LIST) || has(GYROSCOPE) || has(SENSORS))
}

pub(super) fn list(folder: &Path, config: &LogConfig) -> Result<(LogSummary, Listing), LogError> {
    let has = |name: &str| folder.join(name).is_file();
    for (name, role) in [(COLOR_LIST, "color image list"), (DEPTH_LIST, "aligned depth image list")]
    {
        if !has(name) {
            let available = [COLOR_LIST, DEPTH_LIST, "depth.txt", GYROSCOPE, ACCELEROMETER]
                .into_iter()
                .filter(|name| has(name))
                .collect::<Vec<_>>()
                .join(", ");
            return Err(LogError::MissingStream { path: folder.into(), role, available });
        }
    }
    let transforms = Transforms::read(folder)?;
    let mut listing = Listing::default();
    read_list(folder, COLOR_LIST, &mut listing, |line, stamp| {
        image_path(folder, line.rest()).map(|path| vec![(stamp, Entry::Color(path))])
    })?;
    read_list(folder, DEPTH_LIST, &mut listing, |line, stamp| {
        image_path(folder, line.rest()).map(|path| vec![(stamp, Entry::Depth(path))])
    })?;
    let has_imu = config.imu_topic != "none" && has(GYROSCOPE) && has(ACCELEROMETER);
    if has_imu {
        read_list(folder, GYROSCOPE, &mut listing, |line, stamp| {
            vector(line.rest()).map(|rate| vec![(stamp, Entry::Gyroscope(rate))])
        })?;
        read_list(folder, ACCELEROMETER, &mut listing, |line, stamp| {
            vector(line.rest()).map(|force| vec![(stamp, Entry::Accelerometer(force))])
        })?;
    }
    let body_frame = if has_imu { IMU_FRAME } else { COLOR_FRAME };
    if let Some(base_from_body) = transforms.between(BASE_FRAME, body_frame)
        && config.truth_topic != "none"
        && has(TRUTH_LIST)
    {
        read_list(folder, TRUTH_LIST, &mut listing, |line, stamp| {
            pose(stamp, line.rest(), &base_from_body).map(|pose| vec![(stamp, Entry::Truth(pose))])
        })?;
    }
    let camera = camera(folder, &transforms)?;
    let mut summary = LogSummary {
        kind: "OpenLORIS folder".to_owned(),
        config_name: "generic".to_owned(),
        has_imu,
        has_truth: listing.has_truth(),
        frames: Some(listing.frames(config)),
        camera,
        ..LogSummary::default()
    };
    let mut sources = vec![("color", COLOR_LIST), ("depth", DEPTH_LIST)];
    sources.extend(
        has_imu
            .then_some([("imu", GYROSCOPE), ("accelerometer", ACCELEROMETER)])
            .into_iter()
            .flatten(),
    );
    sources.extend(summary.has_truth.then_some(("truth", TRUTH_LIST)));
    summary.sources =
        sources.into_iter().map(|(role, name)| (role.to_owned(), name.to_owned())).collect();
    Ok((summary, listing))
}

/// Three numbers.
fn vector(text: &str) -> Result<Vector3<f64>, Rejection> {
    let numbers: Vec<f64> = text.split_whitespace().map_while(|n| n.parse().ok()).collect();
    let [x, y, z] = numbers[..] else {
        return Err(Rejection::new("not three numbers", text));
    };
    let vector = Vector3::new(x, y, z);
    let is_finite = vector.iter().all(|x| x.is_finite());
    is_finite.then_some(vector).ok_or_else(|| Rejection::new("not finite", text))
}

/// `px py pz qx qy qz qw` of the base, to the pose of the body on it.
fn pose(stamp: Stamp, text: &str, base_from_body: &Isometry3<f64>) -> Result<TruthPose, Rejection> {
    let numbers: Vec<f64> = text.split_whitespace().map_while(|n| n.parse().ok()).collect();
    let [tx, ty, tz, x, y, z, w] = numbers[..] else {
        return Err(Rejection::new("not a pose", text));
    };
    let world_from_base = isometry([tx, ty, tz].into(), [x, y, z, w])?;
    Ok(TruthPose { stamp, world_from_body: world_from_base * base_from_body })
}

/// The color camera on the IMU; `None` where the folder does not tell both.
fn camera(folder: &Path, transforms: &Transforms) -> Result<Option<CameraConfig>, LogError> {
    let path = folder.join(SENSORS);
    let Some(imu_from_camera) =
        transforms.between(IMU_FRAME, COLOR_FRAME).filter(|_| path.is_file())
    else {
        return Ok(None);
    };
    let text = read_text(&path)?;
    let sensor = section(&text, COLOR_FRAME);
    let missing = |key: &str| LogError::Corrupt {
        path: path.clone(),
        reason: format!("no usable `{key}` of {COLOR_FRAME}"),
    };
    let matrix = |key: &str| numbers(sensor?.split_once(&format!("{key}:"))?.1);
    // In this order, whatever others do.
    let Some([fx, cx, fy, cy]) = matrix("intrinsics").and_then(|m| <[f64; 4]>::try_from(m).ok())
    else {
        return Err(missing("intrinsics"));
    };
    let distortion = matrix("distortion_coefficients").and_then(|m| <[f64; 5]>::try_from(m).ok());
    let Some(distortion) = distortion else { return Err(missing("distortion_coefficients")) };
    let mount = imu_from_camera.to_homogeneous();
    Ok(Some(CameraConfig {
        fx,
        fy,
        cx,
        cy,
        distortion: distortion.to_vec(),
        imu_from_camera: std::array::from_fn(|r| std::array::from_fn(|c| mount[(r, c)])),
        ..CameraConfig::default()
    }))
}

/// The lines under a key that is not indented.
fn section<'a>(text: &'a str, key: &str) -> Option<&'a str> {
    let start = text.find(&format!("\n{key}:"))? + key.len() + 2;
    let rest = &text[start..];
    let is_key = |at: &usize| !rest[at + 1..].starts_with([' ', '\n', '\r']);
    let end = rest.match_indices('\n').map(|(at, _)| at).skip(1).find(is_key);
    Some(&rest[..end.unwrap_or(rest.len())])
}

/// The numbers of the first list `data: [ ... ]` of OpenCV's matrices.
fn numbers(text: &str) -> Option<Vec<f64>> {
    let (_, rest) = text.split_once("data:")?;
    let (list, _) = rest.trim_start().strip_prefix('[')?.split_once(']')?;
    let numbers: Option<Vec<f64>> = list.split(',').map(|n| n.trim().parse().ok()).collect();
    numbers.filter(|numbers| numbers.iter().all(|x| x.is_finite()))
}

/// Mountings of frames on others.
struct Transforms(Vec<(String, String, Isometry3<f64>)>);

impl Transforms {
    /// Empty where the folder has none.
    fn read(folder: &Path) -> Result<Self, LogError> {
        let path = folder.join(TRANSFORMS);
        if !path.is_file() {
            return Ok(Self(Vec::new()));
        }
        let text = read_text(&path)?;
        let items = text.split("parent_frame:").skip(1).enumerate();
        let transforms = items.map(|(index, item)| {
            Self::item(item).ok_or_else(|| LogError::Corrupt {
                path: path.clone(),
                reason: format!("transform {} is no rigid motion between two frames", index + 1),
            })
        });
        transforms.collect::<Result<_, _>>().map(Self)
    }

    fn item(text: &str) -> Option<(String, String, Isometry3<f64>)> {
        let parent = text.lines().next()?.trim().to_owned();
        let child = text.split_once("child_frame:")?.1.lines().next()?.trim().to_owned();
        let matrix = Matrix4::from_row_iterator(<[f64; 16]>::try_from(numbers(text)?).ok()?);
        let rotation = matrix.fixed_view::<3, 3>(0, 0).into_owned();
        let residual = (rotation.transpose() * rotation - nalgebra::Matrix3::identity()).norm();
        let translation = matrix.fixed_view::<3, 1>(0, 3).into_owned();
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&rotation));
        let mount = Isometry3::from_parts(translation.into(), rotation);
        (residual < 1e-2 && matrix.determinant() > 0.0).then_some((parent, child, mount))
    }

    /// Over at most two links: all frames hang on the cameras, these on the base.
    fn between(&self, parent: &str, child: &str) -> Option<Isometry3<f64>> {
        let link = |from: &str, to: &str| {
            self.0.iter().find_map(|(parent, child, mount)| {
                match (parent == from && child == to, parent == to && child == from) {
                    (true, _) => Some(*mount),
                    (_, true) => Some(mount.inverse()),
                    _ => None,
                }
            })
        };
        link(parent, child).or_else(|| {
            let frames = self.0.iter().flat_map(|(parent, child, _)| [parent, child]);
            frames.into_iter().find_map(|via| Some(link(parent, via)? * link(via, child)?))
        })
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::super::samples::{self, read_all};
    use super::super::{Event, open};
    use super::*;
    use crate::inertial::ImuConfig;

    const YAML: &str = "%YAML:1.0\ntrans_matrix:\n   -\n      parent_frame: base_link\n      child_frame: \
        d400_color_optical_frame\n      matrix: !!opencv-matrix\n         rows: 4\n         data: [ 0., 0., 1., \
        0.5,\n   -1., 0., 0., 0., 0., -1., 0., 1., 0., 0., 0., 1. ]\n   -\n      parent_frame: \
        d400_color_optical_frame\n      child_frame: d400_gyroscope\n      matrix:\n         data: [1., 0., 0., \
        0.02, 0., 1., 0., 0.01, 0., 0., 1., 0., 0., 0., 0., 1.]\n";

    const SENSORS_YAML: &str = "%YAML:1.0\nother:\n   intrinsics:\n      data: [ 1., 2., 3., 4. ]\n\
        d400_color_optical_frame:\n   width: 8\n   intrinsics: !!opencv-matrix\n      rows: 1\n      data: [ \
        6.1e+02, 4.3e+02,\n          6.2e+02, 2.4e+02 ]\n   distortion_coefficients: !!opencv-matrix\n      \
        data: [ 0.1, 0., 0., 0., 0. ]\nlast:\n   fps: 30\n";

    fn folder() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path();
        image::RgbImage::from_pixel(4, 2, image::Rgb([1, 2, 3])).save(path.join("c.png")).unwrap();
        let depth = image::ImageBuffer::from_pixel(4, 2, image::Luma([1500_u16]));
        image::DynamicImage::ImageLuma16(depth).save(path.join("d.png")).unwrap();
        let list = |image: &str| format!("1.00 {image}\n1.05 {image}\n");
        samples::file(&folder, COLOR_LIST, list("c.png").as_bytes());
        samples::file(&folder, DEPTH_LIST, list("d.png").as_bytes());
        let imu = |step: f64, value: &str| {
            let rows = (0..30).map(|n| format!("{:.4} {value}\n", 0.95 + step * f64::from(n)));
            format!("#Time x y z\n{}", rows.collect::<String>())
        };
        samples::file(&folder, GYROSCOPE, imu(0.005, "0.1 0.2 0.3").as_bytes());
        samples::file(&folder, ACCELEROMETER, imu(0.004, "0.0 -9.8 0.1").as_bytes());
        samples::file(&folder, TRUTH_LIST, b"1.0 1 2 0 0 0 0 1\n");
        samples::file(&folder, TRANSFORMS, YAML.as_bytes());
        samples::file(&folder, SENSORS, SENSORS_YAML.as_bytes());
        folder
    }

    #[test]
    fn images_inertial_files_and_calibration_are_read() {
        let folder = folder();
        let mut log = open(folder.path(), &LogConfig::default(), &ImuConfig::default()).unwrap();
        let summary = log.summary().clone();
        assert_eq!((summary.kind.as_str(), summary.frames), ("OpenLORIS folder", Some(2)));
        let camera = summary.camera.as_ref().unwrap();
        assert_eq!([camera.fx, camera.cx, camera.fy, camera.cy], [610.0, 430.0, 620.0, 240.0]);
        assert_eq!(camera.distortion[0], 0.1);
        let mount = camera.imu_from_camera().unwrap();
        assert_relative_eq!(mount.translation.vector, Vector3::new(-0.02, -0.01, 0.0));
        let events = read_all(log.as_mut());
        assert_eq!((log.report().frames, log.report().skipped.len()), (2, 0), "{:?}", log.report());
        let samples: Vec<_> = events
            .iter()
            .filter_map(|event| match event {
                Event::Imu(sample) => Some(sample),
                _ => None,
            })
            .collect();
        // At the stamps of the accelerometer, which is the faster one.
        assert_eq!(samples.len(), 30);
        let rate = Vector3::new(0.1, 0.2, 0.3);
        assert!(samples.iter().all(|s| (s.angular_velocity - rate).norm() < 1e-12));
        let truth = events.iter().find_map(|event| match event {
            Event::Truth(pose) => Some(pose.world_from_body),
            _ => None,
        });
        // The base, then the camera half a metre ahead and one above, then the IMU 0.02 m to its
        // right and 0.01 m below.
        let position = truth.unwrap().translation.vector;
        assert_relative_eq!(position, Vector3::new(1.5, 1.98, 0.99), epsilon = 1e-12);
    }

    #[test]
    fn what_is_missing_or_damaged_is_named() {
        let error = |change: &dyn Fn(&Path)| {
            let folder = folder();
            change(folder.path());
            let opened = open(folder.path(), &LogConfig::default(), &ImuConfig::default());
            opened.err().unwrap().to_string()
        };
        let without_depth = error(&|folder| std::fs::remove_file(folder.join(DEPTH_LIST)).unwrap());
        assert!(without_depth.contains("no aligned depth image list"), "{without_depth}");
        let damaged = error(&|folder| {
            std::fs::write(folder.join(SENSORS), SENSORS_YAML.replace("6.1e+02", "x")).unwrap();
        });
        assert!(damaged.contains("no usable `intrinsics`"), "{damaged}");
        let damaged = error(&|folder| {
            std::fs::write(folder.join(TRANSFORMS), YAML.replace("0.5,", "0.5, 7,")).unwrap();
        });
        assert!(damaged.contains("transform 1 is no rigid motion"), "{damaged}");
    }

    #[test]
    fn the_real_excerpt_is_read() {
        let Some(path) = samples::data("openloris_4frames") else { return };
        let path = path.join("sample_dataset");
        let mut log = open(&path, &LogConfig::default(), &ImuConfig::default()).unwrap();
        assert_eq!(log.summary().frames, Some(4));
        read_all(log.as_mut());
        assert_eq!(log.report().frames, 4);
        assert!(log.report().imu_samples > 40, "{:?}", log.report());
        assert!(log.report().skipped.is_empty(), "{:?}", log.report());
        let camera = log.summary().camera.clone().unwrap();
        assert_relative_eq!(camera.fx, 611.450_988_769, epsilon = 1e-6);
        assert_relative_eq!(camera.cy, 249.473_022_460, epsilon = 1e-6);
    }
}
