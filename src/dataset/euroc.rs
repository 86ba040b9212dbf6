//! EuRoC folders (`mav0`): two cameras, or one and depth, IMU and reference in csv files with stamps
//! in ns. TUM-VI and others export to the same layout, without calibrations.
//!
//! Format: <https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets>.

use std::path::{Path, PathBuf};

use nalgebra::Vector3;

use super::folder::{Entry, Listing, read_entry, read_text};
use super::imu_csv::imu_columns;
use super::message::isometry;
use super::pixels::Rejection;
use super::text_table::Row;
use super::{LogConfig, LogError, LogSummary, TruthPose};
use crate::dialect::{Dialect, PoseColumns, TimeUnit};
use crate::inertial::ImuConfig;
use crate::sensor::{CameraConfig, CameraModel, ImuSample, Stamp};
use crate::vision::StereoRig;

const LEFT: &str = "cam0";
const RIGHT: &str = "cam1";
/// Registered depth images, in folders of RGB-D cameras that keep to this layout.
const DEPTH: &str = "depth0";
const IMU: &str = "imu0";
/// Reference poses by their names in EuRoC, TUM-VI and the tools of others.
const TRUTH: [&str; 4] = ["state_groundtruth_estimate0", "mocap0", "gt0", "pose0"];

/// The folder that holds the sensors' folders.
fn root(folder: &Path) -> PathBuf {
    let inner = folder.join("mav0");
    if inner.is_dir() { inner } else { folder.to_path_buf() }
}

pub(super) fn is_euroc(folder: &Path) -> bool {
    has_table(&root(folder), LEFT)
}

fn has_table(root: &Path, sensor: &str) -> bool {
    root.join(sensor).join(TABLE).is_file()
}

const TABLE: &str = "data.csv";

pub(super) fn list(folder: &Path, config: &LogConfig) -> Result<(LogSummary, Listing), LogError> {
    let root = root(folder);
    let mut listing = Listing::default();
    let has_depth = has_table(&root, DEPTH);
    let (camera, second) = match has_depth {
        true => (calibrated(&root.join(LEFT))?.map(|(camera, _)| camera), DEPTH),
        false => {
            let rig = rig(&root, config)?;
            let camera = rig.camera().clone();
            listing.stereo = Some(rig);
            (Some(camera), RIGHT)
        }
    };
    read_rows(&root, LEFT, &mut listing, |_, row| Ok(Entry::Color(image(&root, LEFT, row)?)))?;
    read_rows(&root, second, &mut listing, |_, row| {
        let path = image(&root, second, row)?;
        Ok(if has_depth { Entry::Depth(path) } else { Entry::Right(path) })
    })?;
    let has_imu = config.imu_topic != "none" && has_sensor(&root, IMU);
    if has_imu {
        read_imu(&root, &mut listing)?;
    }
    let truth = TRUTH.into_iter().find(|name| has_sensor(&root, name));
    let truth = truth.filter(|_| config.truth_topic != "none");
    if let Some(name) = truth {
        read_truth(&root, name, &mut listing)?;
    }
    let mut sources = vec![("color", LEFT), (if has_depth { "depth" } else { "right" }, second)];
    sources.extend(has_imu.then_some(("imu", IMU)));
    sources.extend(truth.map(|name| ("truth", name)));
    let stereo = listing.stereo.as_ref().map(|rig| rig.cameras().to_vec()).unwrap_or_default();
    let summary = LogSummary {
        stereo,
        kind: if has_depth { "EuRoC-like RGB-D folder" } else { "EuRoC folder" }.to_owned(),
        config_name: if has_depth { "generic" } else { "euroc" }.to_owned(),
        has_imu,
        has_truth: truth.is_some(),
        sources: sources.into_iter().map(|(role, name)| (role.into(), name.into())).collect(),
        frames: Some(listing.frames(config)),
        camera,
        ..LogSummary::default()
    };
    Ok((summary, listing))
}

/// Whether a sensor that need not be there is; a folder without its table is told.
fn has_sensor(root: &Path, sensor: &str) -> bool {
    let has_table = has_table(root, sensor);
    if !has_table && root.join(sensor).is_dir() {
        tracing::warn!("{}: no {TABLE} in it: not used", root.join(sensor).display());
    }
    has_table
}

/// The two cameras by their `sensor.yaml`, or else by `log.stereo`.
fn rig(root: &Path, config: &LogConfig) -> Result<StereoRig, LogError> {
    if !has_table(root, RIGHT) {
        let available = format!("{LEFT}, neither {RIGHT} nor {DEPTH}");
        let role = "second camera or depth";
        return Err(LogError::MissingStream { path: root.to_path_buf(), role, available });
    }
    let failed = |reason: String| LogError::Stereo { path: root.to_path_buf(), reason };
    let calibrated = (calibrated(&root.join(LEFT))?, calibrated(&root.join(RIGHT))?);
    let (left, right, size) = match (calibrated, &config.stereo[..]) {
        ((Some((left, size)), Some((right, _))), _) => (left, right, size),
        (_, [left, right]) => (left.clone(), right.clone(), first_image_size(root)?),
        _ => {
            return Err(failed(format!(
                "no sensor.yaml in {LEFT} and {RIGHT}; set their calibrations in `log.stereo`, which \
                 `mfg-vio config import` makes of a Kalibr file"
            )));
        }
    };
    StereoRig::new(&left, &right, size)
        .map_err(|error| failed(format!("{LEFT} and {RIGHT}: {error}")))
}

/// Width and height of the first image of the left camera that can be read.
fn first_image_size(root: &Path) -> Result<(usize, usize), LogError> {
    let mut listing = Listing::default();
    read_rows(root, LEFT, &mut listing, |_, row| Ok(Entry::Color(image(root, LEFT, row)?)))?;
    let size = |(stamp, entry): &(Stamp, Entry)| {
        let reading = read_entry(*stamp, entry, &LogConfig::default(), &ImuConfig::default());
        reading.ok()?.image_size()
    };
    let first = listing.entries.iter().take(10).find_map(size);
    first.map(|(width, height)| (width as usize, height as usize)).ok_or_else(|| {
        let reason = "none of its first images can be read".to_owned();
        LogError::Corrupt { path: root.join(LEFT), reason }
    })
}

/// The image that a row names.
fn image(root: &Path, sensor: &str, row: &Row) -> Result<PathBuf, Rejection> {
    let file = row.field(1).map_err(|detail| Rejection::new("no file name", detail))?;
    Ok(root.join(sensor).join("data").join(file))
}

/// Reads the rows of a sensor's `data.csv`: stamps in ns, unless they have a decimal point.
fn read_rows(
    root: &Path,
    sensor: &str,
    listing: &mut Listing,
    read: impl Fn(Stamp, &Row) -> Result<Entry, Rejection>,
) -> Result<(), LogError> {
    let text = read_text(&root.join(sensor).join(TABLE))?;
    let mut layout = None;
    for (number, line) in text.trim_start_matches('\u{feff}').lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') || layout.is_none() && is_header(line) {
            continue;
        }
        let (dialect, unit) = *layout.get_or_insert_with(|| layout_of(line));
        let row = Row::new(line, dialect, unit);
        let entry = row
            .stamp(0)
            .map_err(|reason| Rejection::new("no time stamp", reason))
            .and_then(|stamp| Ok((stamp, read(stamp, &row)?)));
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

/// The line that names the columns of a sensor's table.
fn header(root: &Path, sensor: &str) -> Result<String, LogError> {
    let text = read_text(&root.join(sensor).join(TABLE))?;
    Ok(text.trim_start_matches('\u{feff}').lines().next().unwrap_or_default().to_owned())
}

/// Where the columns `names`, which are parts of the header's, are; `usual` where the header names
/// none of them.
fn columns<const N: usize>(
    root: &Path,
    sensor: &str,
    names: [&str; N],
    usual: [usize; N],
) -> Result<[usize; N], LogError> {
    let header = header(root, sensor)?;
    let titles: Vec<String> = header.split(',').map(|t| t.trim().to_lowercase()).collect();
    let position = |name: &str| titles.iter().position(|title| title.contains(name));
    let found: Vec<Option<usize>> = names.iter().map(|name| position(name)).collect();
    let mut columns = usual;
    if found.iter().all(Option::is_none) {
        return Ok(columns);
    }
    for ((column, found), name) in columns.iter_mut().zip(found).zip(names) {
        *column = found.ok_or_else(|| LogError::Corrupt {
            path: root.join(sensor).join(TABLE),
            reason: format!("line 1: no column `{name}` beside others in `{header}`"),
        })?;
    }
    Ok(columns)
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

/// Angular velocity (rad/s) and specific force (m/s^2).
fn read_imu(root: &Path, listing: &mut Listing) -> Result<(), LogError> {
    let names = ["w_rs_s_x", "w_rs_s_y", "w_rs_s_z", "a_rs_s_x", "a_rs_s_y", "a_rs_s_z"];
    let [wx, wy, wz, ax, ay, az] = match imu_columns(&header(root, IMU)?) {
        Some([_, imu @ ..]) => imu,
        None => columns(root, IMU, names, [1, 2, 3, 4, 5, 6])?,
    };
    read_rows(root, IMU, listing, |stamp, row| {
        Ok(Entry::Imu(ImuSample {
            stamp,
            angular_velocity: vector(row, [wx, wy, wz])?,
            specific_force: vector(row, [ax, ay, az])?,
        }))
    })
}

/// Position (m) and quaternion of the IMU.
fn read_truth(root: &Path, name: &str, listing: &mut Listing) -> Result<(), LogError> {
    let names = ["p_rs_r_x", "p_rs_r_y", "p_rs_r_z", "q_rs_x", "q_rs_y", "q_rs_z", "q_rs_w"];
    let [px, py, pz, qx, qy, qz, qw] = match PoseColumns::named(&header(root, name)?) {
        Some(PoseColumns { columns: [_, pose @ ..], .. }) => pose,
        None => columns(root, name, names, [1, 2, 3, 5, 6, 7, 4])?,
    };
    read_rows(root, name, listing, |stamp, row| {
        let [x, y, z]: [f64; 3] = vector(row, [qx, qy, qz])?.into();
        let w = vector(row, [qw; 3])?.x;
        let world_from_body = isometry(vector(row, [px, py, pz])?, [x, y, z, w])?;
        Ok(Entry::Truth(TruthPose { stamp, world_from_body }))
    })
}

/// A camera's calibration, and width and height of its images.
type SizedCamera = (CameraConfig, (usize, usize));

/// Calibration and size of a camera's images, where its folder tells them.
fn calibrated(folder: &Path) -> Result<Option<SizedCamera>, LogError> {
    folder.join(CALIBRATION).is_file().then(|| camera(folder)).transpose()
}

const CALIBRATION: &str = "sensor.yaml";

/// Calibration and size of the images from a camera's `sensor.yaml`.
fn camera(folder: &Path) -> Result<(CameraConfig, (usize, usize)), LogError> {
    let path = folder.join(CALIBRATION);
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
    // TUM-VI's folders have fisheye lenses.
    let model = [CameraModel::RadialTangential, CameraModel::Equidistant]
        .into_iter()
        .find(|model| text.contains(model.name()))
        .ok_or_else(|| missing("distortion_model: radial-tangential or equidistant"))?;
    let mount: [f64; 16] = of(list("data")).ok_or_else(|| missing("T_BS"))?;
    let [fx, fy, cx, cy] = of(list("intrinsics")).ok_or_else(|| missing("intrinsics"))?;
    let distortion: [f64; 4] =
        of(list("distortion_coefficients")).ok_or_else(|| missing("distortion_coefficients"))?;
    let [width, height] = of(list("resolution")).ok_or_else(|| missing("resolution"))?;
    let camera = CameraConfig {
        model,
        fx,
        fy,
        cx,
        cy,
        distortion: distortion.to_vec(),
        imu_from_camera: std::array::from_fn(|r| std::array::from_fn(|c| mount[4 * r + c])),
        ..CameraConfig::default()
    };
    Ok((camera, (width as usize, height as usize)))
}

#[cfg(test)]
mod tests {
    use super::super::samples::{self, read_all};
    use super::super::{Event, open};
    use super::*;

    fn table(root: &Path, sensor: &str, text: &str) {
        std::fs::create_dir_all(root.join(sensor).join("data")).unwrap();
        std::fs::write(root.join(sensor).join(TABLE), text).unwrap();
    }

    /// A folder of an RGB-D camera whose columns are in another order than EuRoC's.
    fn rgbd() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        for sensor in [LEFT, DEPTH] {
            table(root, sensor, "timestamp [ns],filename\n1000000000,a.png\n");
        }
        let color = image::RgbImage::from_pixel(4, 2, image::Rgb([1, 2, 3]));
        color.save(root.join("cam0/data/a.png")).unwrap();
        let depth = image::ImageBuffer::from_pixel(4, 2, image::Luma([1500_u16]));
        image::DynamicImage::ImageLuma16(depth).save(root.join("depth0/data/a.png")).unwrap();
        let imu = "#timestamp [ns],a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2],\
            w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1]\n1000000000,1,2,3,4,5,6\n";
        table(root, IMU, imu);
        let pose = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_x [],q_RS_y [],\
            q_RS_z [],q_RS_w []\n1000000000,7,8,9,0,0,1,0\n";
        table(root, "pose0", pose);
        folder
    }

    fn error(folder: &Path) -> String {
        let opened = open(folder, &LogConfig::default(), &ImuConfig::default());
        opened.err().unwrap().to_string()
    }

    #[test]
    fn columns_are_found_by_their_names() {
        let folder = rgbd();
        let mut log = open(folder.path(), &LogConfig::default(), &ImuConfig::default()).unwrap();
        assert_eq!(log.summary().kind, "EuRoC-like RGB-D folder");
        let events = read_all(log.as_mut());
        assert!(log.report().skipped.is_empty(), "{:?}", log.report());
        let [Event::Imu(sample), Event::Truth(pose), Event::Frame(frame)] = &events[..] else {
            panic!("{events:?}")
        };
        assert_eq!(sample.specific_force, Vector3::new(1.0, 2.0, 3.0));
        assert_eq!(sample.angular_velocity, Vector3::new(4.0, 5.0, 6.0));
        assert_eq!(pose.world_from_body.translation.vector, Vector3::new(7.0, 8.0, 9.0));
        assert_eq!(pose.world_from_body.rotation.k, 1.0);
        assert_eq!(frame.depth.data(), [1500; 8]);
    }

    #[test]
    fn a_header_that_lacks_a_column_is_an_error_and_an_optional_folder_without_table_none() {
        let folder = rgbd();
        table(folder.path(), IMU, "#timestamp,w_RS_S_x,w_RS_S_y,w_RS_S_z,a_RS_S_x,a_RS_S_y\n");
        assert!(error(folder.path()).contains("line 1: no column `a_rs_s_z`"));
        std::fs::remove_file(folder.path().join(IMU).join(TABLE)).unwrap();
        let log = open(folder.path(), &LogConfig::default(), &ImuConfig::default()).unwrap();
        assert!(!log.summary().has_imu && log.summary().has_truth);
    }

    #[test]
    fn cameras_without_calibration_are_told() {
        let folder = rgbd();
        std::fs::rename(folder.path().join(DEPTH), folder.path().join(RIGHT)).unwrap();
        let without = error(folder.path());
        assert!(without.contains("no sensor.yaml in cam0 and cam1"), "{without}");
        std::fs::remove_dir_all(folder.path().join(RIGHT)).unwrap();
        let alone = error(folder.path());
        assert!(alone.contains("neither cam1 nor depth0"), "{alone}");
    }

    #[test]
    fn the_real_excerpts_are_read() {
        let Some(path) = samples::data("openloris_4frames") else { return };
        let converted = path.join("sample_dataset_converted");
        let mut log = open(&converted, &LogConfig::default(), &ImuConfig::default()).unwrap();
        read_all(log.as_mut());
        let report = log.report();
        assert!(
            report.frames >= 3 && report.imu_samples > 10 && report.truth_poses > 3,
            "{report:?}"
        );
        assert!(report.skipped.is_empty(), "{report:?}");
    }
}
