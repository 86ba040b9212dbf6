//! EuRoC folders (`mav0`): two cameras, IMU and reference in csv files with stamps in ns.
//!
//! Format: <https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets>.

use std::path::{Path, PathBuf};

use nalgebra::Vector3;

use super::folder::{Entry, Listing, read_text};
use super::message::isometry;
use super::pixels::Rejection;
use super::{LogConfig, LogError, LogSummary, TruthPose};
use crate::sensor::{CameraConfig, ImuSample, Stamp};
use crate::vision::StereoRig;

const LEFT: &str = "cam0";
const RIGHT: &str = "cam1";
const IMU: &str = "imu0";
const TRUTH: &str = "state_groundtruth_estimate0";

/// The folder that holds the sensors' folders.
fn root(folder: &Path) -> PathBuf {
    let inner = folder.join("mav0");
    if inner.is_dir() { inner } else { folder.to_path_buf() }
}

pub(super) fn is_euroc(folder: &Path) -> bool {
    root(folder).join(LEFT).join("sensor.yaml").is_file()
}

pub(super) fn list(folder: &Path, config: &LogConfig) -> Result<(LogSummary, Listing), LogError> {
    let root = root(folder);
    let (left, size) = camera(&root.join(LEFT))?;
    let (right, _) = camera(&root.join(RIGHT))?;
    let rig = StereoRig::new(&left, &right, size).map_err(|error| LogError::Corrupt {
        path: root.clone(),
        reason: format!("{LEFT} and {RIGHT}: {error}"),
    })?;
    let mut listing = Listing::default();
    let image = |name: &str, path: &str| root.join(name).join("data").join(path.trim());
    read_rows(&root, LEFT, &mut listing, |_, row| Ok(Entry::Color(image(LEFT, row))))?;
    read_rows(&root, RIGHT, &mut listing, |_, row| Ok(Entry::Right(image(RIGHT, row))))?;
    let has = |name: &str, topic: &str| topic != "none" && root.join(name).is_dir();
    let (has_imu, has_truth) = (has(IMU, &config.imu_topic), has(TRUTH, &config.truth_topic));
    if has_imu {
        read_rows(&root, IMU, &mut listing, imu)?;
    }
    if has_truth {
        read_rows(&root, TRUTH, &mut listing, truth)?;
    }
    let mut sources = vec![("color", LEFT), ("right", RIGHT)];
    sources.extend(has_imu.then_some(("imu", IMU)));
    sources.extend(has_truth.then_some(("truth", TRUTH)));
    let summary = LogSummary {
        kind: "EuRoC folder".to_owned(),
        config_name: "euroc".to_owned(),
        has_imu,
        has_truth,
        sources: sources.into_iter().map(|(role, name)| (role.into(), name.into())).collect(),
        frames: Some(listing.frames(config)),
        camera: Some(rig.camera().clone()),
    };
    listing.stereo = Some(rig);
    Ok((summary, listing))
}

/// Reads the rows `stamp,rest` of a sensor's `data.csv`.
fn read_rows(
    root: &Path,
    sensor: &str,
    listing: &mut Listing,
    read: impl Fn(Stamp, &str) -> Result<Entry, Rejection>,
) -> Result<(), LogError> {
    let text = read_text(&root.join(sensor).join("data.csv"))?;
    for (number, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let (stamp, rest) = line.split_once(',').unwrap_or((line, ""));
        let entry = stamp
            .trim()
            .parse()
            .map_err(|_| Rejection::new("no time stamp", stamp))
            .map(Stamp::from_nanos)
            .and_then(|stamp| Ok((stamp, read(stamp, rest)?)));
        match entry {
            Ok(entry) => listing.entries.push(entry),
            Err(Rejection { reason, detail }) => listing
                .rejections
                .push((format!("{sensor}: {reason}"), format!("line {}: {detail}", number + 1))),
        }
    }
    Ok(())
}

/// The first `N` of comma-separated numbers.
fn numbers<const N: usize>(text: &str) -> Result<[f64; N], Rejection> {
    let numbers: Vec<f64> = text.split(',').map_while(|n| n.trim().parse().ok()).take(N).collect();
    <[f64; N]>::try_from(numbers)
        .ok()
        .filter(|numbers| numbers.iter().all(|x| x.is_finite()))
        .ok_or_else(|| Rejection::new("not the numbers that belong here", text))
}

/// `wx,wy,wz` (rad/s), `ax,ay,az` (m/s^2).
fn imu(stamp: Stamp, row: &str) -> Result<Entry, Rejection> {
    let [wx, wy, wz, ax, ay, az] = numbers(row)?;
    Ok(Entry::Imu(ImuSample {
        stamp,
        angular_velocity: Vector3::new(wx, wy, wz),
        specific_force: Vector3::new(ax, ay, az),
    }))
}

/// `px,py,pz,qw,qx,qy,qz` of the IMU.
fn truth(stamp: Stamp, row: &str) -> Result<Entry, Rejection> {
    let [px, py, pz, w, x, y, z] = numbers(row)?;
    let world_from_body = isometry([px, py, pz].into(), [x, y, z, w])?;
    Ok(Entry::Truth(TruthPose { stamp, world_from_body }))
}

/// Calibration and size of the images from a camera's `sensor.yaml`.
fn camera(folder: &Path) -> Result<(CameraConfig, (usize, usize)), LogError> {
    let path = folder.join("sensor.yaml");
    let text = read_text(&path)?;
    let missing =
        |key: &str| LogError::Corrupt { path: path.clone(), reason: format!("no usable `{key}`") };
    // The lists of these files are flat, and their keys are their own.
    let list = |key: &str| {
        let (_, rest) = text.split_once(&format!("{key}:"))?;
        let (list, _) = rest.trim_start().strip_prefix('[')?.split_once(']')?;
        Some(list)
    };
    fn of<const N: usize>(list: Option<&str>) -> Option<[f64; N]> {
        numbers(list?).ok()
    }
    if !text.contains("radial-tangential") {
        return Err(missing("distortion_model: radial-tangential"));
    }
    let mount: [f64; 16] = of(list("data")).ok_or_else(|| missing("T_BS"))?;
    let [fx, fy, cx, cy] = of(list("intrinsics")).ok_or_else(|| missing("intrinsics"))?;
    let [k1, k2, p1, p2] =
        of(list("distortion_coefficients")).ok_or_else(|| missing("distortion_coefficients"))?;
    let [width, height] = of(list("resolution")).ok_or_else(|| missing("resolution"))?;
    let camera = CameraConfig {
        fx,
        fy,
        cx,
        cy,
        distortion: [k1, k2, p1, p2, 0.0],
        imu_from_camera: std::array::from_fn(|r| std::array::from_fn(|c| mount[4 * r + c])),
        time_offset: 0.0,
        readout_time: 0.0,
    };
    Ok((camera, (width as usize, height as usize)))
}
