//! EuRoC folders (`mav0`): two cameras, IMU and reference in csv files with stamps in ns.
//!
//! Format: <https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets>.

use std::path::{Path, PathBuf};

use nalgebra::Vector3;

use super::folder::{Entry, Listing, read_text};
use super::imu_csv::imu_columns;
use super::message::isometry;
use super::pixels::Rejection;
use super::text_table::Row;
use super::{LogConfig, LogError, LogSummary, TruthPose};
use crate::dialect::{Dialect, PoseColumns, TimeUnit};
use crate::sensor::{CameraConfig, ImuSample, Stamp};
use crate::vision::StereoRig;

const LEFT: &str = "cam0";
const RIGHT: &str = "cam1";
const IMU: &str = "imu0";
const TRUTH: &str = "state_groundtruth_estimate0";
/// The table in each sensor's folder.
const ROWS: &str = "data.csv";

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
    let image = |name: &str, row: &Row| match row.field(1) {
        Ok(file) => Ok(root.join(name).join("data").join(file)),
        Err(detail) => Err(Rejection::new("no file name", detail)),
    };
    read_rows(&root, LEFT, &mut listing, |_, row, _| Ok(Entry::Color(image(LEFT, row)?)))?;
    read_rows(&root, RIGHT, &mut listing, |_, row, _| Ok(Entry::Right(image(RIGHT, row)?)))?;
    let has = |name: &str, topic: &str| topic != "none" && has_rows(&root.join(name));
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

/// Whether an optional sensor is there; a folder of it without its rows is worth a word.
fn has_rows(sensor: &Path) -> bool {
    let rows = sensor.join(ROWS);
    if sensor.is_dir() && !rows.is_file() {
        tracing::warn!("{}: is not there; the log is read without it", rows.display());
    }
    rows.is_file()
}

/// Reads the rows of a sensor's `data.csv`: stamps in ns, unless they have a decimal point.
/// `read` is given the line of names, too.
fn read_rows(
    root: &Path,
    sensor: &str,
    listing: &mut Listing,
    read: impl Fn(Stamp, &Row, Option<&str>) -> Result<Entry, Rejection>,
) -> Result<(), LogError> {
    let text = read_text(&root.join(sensor).join(ROWS))?;
    let (mut names, mut layout) = (None, None);
    for (number, line) in text.trim_start_matches('\u{feff}').lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') || layout.is_none() && is_header(line) {
            names = names.or(Some(line));
            continue;
        }
        let (dialect, unit) = *layout.get_or_insert_with(|| layout_of(line));
        let row = Row::new(line, dialect, unit);
        let entry = row
            .stamp(0)
            .map_err(|reason| Rejection::new("no time stamp", reason))
            .and_then(|stamp| Ok((stamp, read(stamp, &row, names)?)));
        match entry {
            Ok(entry) => listing.entries.push(entry),
            Err(Rejection { reason, detail }) => listing
                .rejections
                .push((format!("{sensor}: {reason}"), format!("line {}: {detail}", number + 1))),
        }
    }
    Ok(())
}

fn is_header(line: &str) -> bool {
    line.starts_with(|c: char| c.is_alphabetic() || c == '"')
}

fn layout_of(line: &str) -> (Dialect, TimeUnit) {
    let dialect = Dialect::of(line);
    let stamp = dialect.fields(line).next().unwrap_or_default();
    let is_decimal = dialect.plain(stamp).contains('.');
    (dialect, if is_decimal { TimeUnit::Seconds } else { TimeUnit::Nanoseconds })
}

/// The first `N` of comma-separated numbers.
fn numbers<const N: usize>(text: &str) -> Result<[f64; N], Rejection> {
    let numbers: Vec<f64> = text.split(',').map_while(|n| n.trim().parse().ok()).take(N).collect();
    <[f64; N]>::try_from(numbers)
        .ok()
        .filter(|numbers| numbers.iter().all(|x| x.is_finite()))
        .ok_or_else(|| Rejection::new("not the numbers that belong here", text))
}

/// Three numbers.
fn vector(row: &Row, columns: [usize; 3]) -> Result<Vector3<f64>, Rejection> {
    let wrong = |detail: String| Rejection::new("not the numbers that belong here", detail);
    let vector = row.vector(columns).map_err(wrong)?;
    match vector.iter().all(|x| x.is_finite()) {
        true => Ok(vector),
        false => Err(wrong("not finite".to_owned())),
    }
}

/// Angular velocity (rad/s) and specific force (m/s^2), in the order that `names` tells, else in
/// this.
fn imu(stamp: Stamp, row: &Row, names: Option<&str>) -> Result<Entry, Rejection> {
    let named = names.and_then(imu_columns);
    let [_, wx, wy, wz, ax, ay, az] = named.unwrap_or([0, 1, 2, 3, 4, 5, 6]);
    Ok(Entry::Imu(ImuSample {
        stamp,
        angular_velocity: vector(row, [wx, wy, wz])?,
        specific_force: vector(row, [ax, ay, az])?,
    }))
}

/// Position and quaternion of the IMU, in the order that `names` tells, else w first.
fn truth(stamp: Stamp, row: &Row, names: Option<&str>) -> Result<Entry, Rejection> {
    let named = names.and_then(PoseColumns::named).map(|named| named.columns);
    let [_, px, py, pz, qx, qy, qz, qw] = named.unwrap_or([0, 1, 2, 3, 5, 6, 7, 4]);
    let [x, y, z]: [f64; 3] = vector(row, [qx, qy, qz])?.into();
    let w = vector(row, [qw; 3])?.x;
    let world_from_body = isometry(vector(row, [px, py, pz])?, [x, y, z, w])?;
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
