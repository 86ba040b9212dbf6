//! Folders of the iOS app Stray Scanner: LiDAR depth, IMU, and the poses of ARKit as a reference.
//!
//! Format: <https://docs.strayrobots.io/apps/scanner/format.html>. Color is a video; its images are
//! read from a folder `rgb`, one file a frame, as `ffmpeg` writes them. Depth is smaller than color
//! and of the same camera. The accelerometer is Core Motion's, which reads -1 g along what points up.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Matrix3, Rotation3, UnitQuaternion, Vector3};

use super::folder::{Entry, Listing, read_entry, read_text};
use super::message::isometry;
use super::{LogConfig, LogError, LogSummary, TruthPose};
use crate::inertial::ImuConfig;
use crate::sensor::{CameraConfig, ImuSample, PinholeCamera, Stamp};
use crate::vision::DepthRegistration;

const CALIBRATION: &str = "camera_matrix.csv";
const POSES: &str = "odometry.csv";
const IMU: &str = "imu.csv";
const COLOR: &str = "rgb";
const VIDEO: &str = "rgb.mp4";
const DEPTH: &str = "depth";

/// Core Motion's g, m/s^2.
const GRAVITY: f64 = 9.80665;

/// Median specific force between these is in g, above in m/s^2; below gravity has been taken out.
const LEAST_MEDIAN_IN_G: f64 = 0.5;
const LARGEST_MEDIAN_IN_G: f64 = 4.0;

pub(super) fn is_stray(folder: &Path) -> bool {
    folder.join(CALIBRATION).is_file() && folder.join(POSES).is_file()
}

pub(super) fn list(folder: &Path, config: &LogConfig) -> Result<(LogSummary, Listing), LogError> {
    let missing = |role, available: String| LogError::MissingStream {
        path: folder.to_path_buf(),
        role,
        available,
    };
    let (colors, depths) = (numbered(&folder.join(COLOR)), numbered(&folder.join(DEPTH)));
    if colors.is_empty() && folder.join(VIDEO).is_file() {
        let available = format!(
            "{VIDEO}, a video; in its folder, `mkdir {COLOR}; ffmpeg -i {VIDEO} -fps_mode passthrough \
             -start_number 0 {COLOR}/%06d.jpg` writes the images"
        );
        return Err(missing("color images", available));
    }
    for (files, role) in [(&colors, "color images"), (&depths, "depth images")] {
        if files.is_empty() {
            return Err(missing(role, format!("{CALIBRATION}, {POSES}")));
        }
    }
    let mut listing = Listing::default();
    let has_imu = config.imu_topic != "none" && read_imu(folder, &mut listing)?;
    read_frames(folder, (&colors, &depths), (config, has_imu), &mut listing)?;
    let camera = camera(folder)?;
    listing.registration = registration(&camera, &listing);
    let mut summary = LogSummary {
        kind: "Stray Scanner folder".to_owned(),
        config_name: "generic".to_owned(),
        has_imu,
        has_truth: listing.has_truth(),
        frames: Some(listing.frames(config)),
        camera: Some(camera),
        ..LogSummary::default()
    };
    let mut sources = vec![("color", COLOR), ("depth", DEPTH)];
    sources.extend(has_imu.then_some(("imu", IMU)));
    sources.extend(summary.has_truth.then_some(("truth", POSES)));
    summary.sources =
        sources.into_iter().map(|(role, name)| (role.to_owned(), name.to_owned())).collect();
    Ok((summary, listing))
}

/// Image files by the number that is their name.
fn numbered(folder: &Path) -> BTreeMap<u32, PathBuf> {
    let Ok(files) = std::fs::read_dir(folder) else { return BTreeMap::new() };
    let paths = files.flatten().map(|file| file.path());
    let number = |path: PathBuf| {
        let is_image =
            ["png", "jpg", "jpeg"].iter().any(|end| path.extension().is_some_and(|e| e == *end));
        let number = path.file_stem()?.to_str()?.parse().ok()?;
        is_image.then_some((number, path))
    };
    paths.filter_map(number).collect()
}

/// The rows of numbers of a file, separated by commas, with their line; those that are none are
/// noted.
fn rows<const N: usize>(path: &Path, listing: &mut Listing) -> Result<Vec<[f64; N]>, LogError> {
    let text = read_text(path)?;
    let name = path.file_name().unwrap_or_default().display().to_string();
    let mut rows = Vec::new();
    for (index, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let numbers: Option<Vec<f64>> = line.split(',').map(|n| n.trim().parse().ok()).collect();
        let numbers = numbers.filter(|numbers| numbers.iter().all(|x| x.is_finite()));
        let row = numbers.and_then(|numbers| numbers.first_chunk::<N>().copied());
        match row {
            Some(row) => rows.push(row),
            // The names of the columns.
            None if index == 0 => {}
            None => listing
                .rejections
                .push((format!("{name}: not {N} numbers"), format!("line {}: {line}", index + 1))),
        }
    }
    Ok(rows)
}

fn stamp(seconds: f64) -> Stamp {
    Stamp::from_seconds(seconds).unwrap_or_default()
}

/// `timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z`; `false` if there is no IMU of use.
fn read_imu(folder: &Path, listing: &mut Listing) -> Result<bool, LogError> {
    let path = folder.join(IMU);
    if !path.is_file() {
        return Ok(false);
    }
    let rows = rows::<7>(&path, listing)?;
    let mut norms: Vec<f64> =
        rows.iter().map(|[_, x, y, z, ..]| Vector3::new(*x, *y, *z).norm()).collect();
    norms.sort_by(f64::total_cmp);
    let unit = match norms.get(norms.len() / 2) {
        None => return Ok(false),
        Some(median) if *median < LEAST_MEDIAN_IN_G => {
            tracing::warn!("{}: its accelerations lack gravity: not used", path.display());
            return Ok(false);
        }
        Some(median) if *median < LARGEST_MEDIAN_IN_G => GRAVITY,
        Some(_) => 1.0,
    };
    listing.entries.extend(rows.iter().map(|[t, ax, ay, az, wx, wy, wz]| {
        let stamp = stamp(*t);
        let sample = ImuSample {
            stamp,
            angular_velocity: Vector3::new(*wx, *wy, *wz),
            specific_force: Vector3::new(*ax, *ay, *az) * -unit,
        };
        (stamp, Entry::Imu(sample))
    }));
    Ok(true)
}

/// The camera's axes (right, down, forward) along the IMU's of a phone held upright (right, up,
/// towards the user): the sensor lies on its side.
fn imu_from_camera() -> Isometry3<f64> {
    let rotation = Matrix3::new(0.0, -1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0);
    let rotation = Rotation3::from_matrix_unchecked(rotation);
    Isometry3::from_parts(Vector3::zeros().into(), UnitQuaternion::from_rotation_matrix(&rotation))
}

/// `timestamp, frame, x, y, z, qx, qy, qz, qw` of the camera, in a world whose y axis points up.
fn read_frames(
    folder: &Path,
    (colors, depths): (&BTreeMap<u32, PathBuf>, &BTreeMap<u32, PathBuf>),
    (config, has_imu): (&LogConfig, bool),
    listing: &mut Listing,
) -> Result<(), LogError> {
    let upright = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::FRAC_PI_2);
    let camera_from_body =
        if has_imu { imu_from_camera().inverse() } else { Isometry3::identity() };
    for [t, frame, px, py, pz, x, y, z, w] in rows::<9>(&folder.join(POSES), listing)? {
        let (stamp, number) = (stamp(t), frame as u32);
        let color = colors.get(&number).map(|path| (stamp, Entry::Color(path.clone())));
        let depth = depths.get(&number).map(|path| (stamp, Entry::Depth(path.clone())));
        listing.entries.extend(color);
        listing.entries.extend(depth);
        if config.truth_topic == "none" {
            continue;
        }
        match isometry([px, py, pz].into(), [x, y, z, w]) {
            Ok(world_from_camera) => {
                let world_from_body = upright * world_from_camera * camera_from_body;
                listing.entries.push((stamp, Entry::Truth(TruthPose { stamp, world_from_body })));
            }
            Err(rejection) => listing
                .rejections
                .push((format!("{POSES}: {}", rejection.reason), rejection.detail)),
        }
    }
    Ok(())
}

fn camera(folder: &Path) -> Result<CameraConfig, LogError> {
    let path = folder.join(CALIBRATION);
    let rows = rows::<3>(&path, &mut Listing::default())?;
    let [[fx, _, cx], [_, fy, cy], _] = rows[..] else {
        let reason = "not a 3x3 matrix of numbers".to_owned();
        return Err(LogError::Corrupt { path, reason });
    };
    let mount = imu_from_camera().to_homogeneous();
    Ok(CameraConfig {
        fx,
        fy,
        cx,
        cy,
        imu_from_camera: std::array::from_fn(|r| std::array::from_fn(|c| mount[(r, c)])),
        ..CameraConfig::default()
    })
}

/// Depth of the color camera, in pixels as large as depth has them; `None` if no image can be read.
fn registration(camera: &CameraConfig, listing: &Listing) -> Option<DepthRegistration> {
    let size_of = |is_color: bool| {
        let images = listing.entries.iter().filter(|(_, entry)| match entry {
            Entry::Color(_) => is_color,
            Entry::Depth(_) => !is_color,
            _ => false,
        });
        images.take(10).find_map(|(stamp, entry)| {
            let reading = read_entry(*stamp, entry, &LogConfig::default(), &ImuConfig::default());
            reading.ok()?.image_size()
        })
    };
    let (color_size, depth_size) = (size_of(true)?, size_of(false)?);
    let scale = [
        f64::from(depth_size.0) / f64::from(color_size.0),
        f64::from(depth_size.1) / f64::from(color_size.1),
    ];
    // Centres of pixels have whole coordinates.
    let depth_camera = PinholeCamera {
        fx: camera.fx * scale[0],
        fy: camera.fy * scale[1],
        cx: (camera.cx + 0.5) * scale[0] - 0.5,
        cy: (camera.cy + 0.5) * scale[1] - 0.5,
    };
    Some(DepthRegistration {
        depth_camera,
        color_camera: camera.clone(),
        color_from_depth: Isometry3::identity(),
        color_size: (color_size.0 as usize, color_size.1 as usize),
    })
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::super::samples::{self, read_all};
    use super::super::{Event, open};
    use super::*;

    fn folder(images: &str) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path();
        for name in [images, DEPTH] {
            std::fs::create_dir(path.join(name)).unwrap();
        }
        let color = image::RgbImage::from_pixel(8, 6, image::Rgb([1, 2, 3]));
        color.save(path.join(images).join("000003.png")).unwrap();
        let depth = image::ImageBuffer::from_pixel(4, 3, image::Luma([1500_u16]));
        image::DynamicImage::ImageLuma16(depth).save(path.join("depth/000003.png")).unwrap();
        samples::file(&folder, CALIBRATION, b"6.0, 0.0, 3.5\n0.0, 6.0, 2.5\n0.0, 0.0, 1.0");
        let poses = "timestamp, frame, x, y, z, qx, qy, qz, qw\n10.5, 000003, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0\n";
        samples::file(&folder, POSES, poses.as_bytes());
        let imu = "timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\n10.49, 0.0, -1.0, 0.0, 0.1, 0.2, 0.3\nx\n";
        samples::file(&folder, IMU, imu.as_bytes());
        folder
    }

    fn opened(folder: &tempfile::TempDir) -> Result<Box<dyn super::super::Log>, LogError> {
        open(folder.path(), &LogConfig::default(), &ImuConfig::default())
    }

    #[test]
    fn all_streams_are_read_and_depth_is_brought_to_the_size_of_color() {
        let folder = folder(COLOR);
        let mut log = opened(&folder).unwrap();
        assert_eq!(log.summary().kind, "Stray Scanner folder");
        let events = read_all(log.as_mut());
        assert_eq!(log.report().skipped["imu.csv: not 7 numbers"], 1);
        let [Event::Imu(sample), Event::Truth(pose), Event::Frame(frame)] = &events[..] else {
            panic!("{events:?}")
        };
        // Held upright: what the phone feels points along its y axis.
        assert_relative_eq!(sample.specific_force, Vector3::new(0.0, GRAVITY, 0.0));
        assert_relative_eq!(pose.world_from_body.translation.vector, Vector3::new(1.0, -3.0, 2.0));
        assert_eq!(frame.depth.data(), [1500; 48]);
        assert_eq!(frame.color.width(), 8);
    }

    /// A camera that looks along the ground, its image upright, is a phone on its side.
    #[test]
    fn the_phone_s_axes_are_those_of_core_motion() {
        let camera_down = imu_from_camera() * Vector3::y();
        assert_relative_eq!(camera_down, -Vector3::x(), epsilon = 1e-12);
        assert_relative_eq!(imu_from_camera() * Vector3::z(), -Vector3::z(), epsilon = 1e-12);
    }

    #[test]
    fn a_video_alone_is_told_with_what_to_do() {
        let folder = folder("other");
        samples::file(&folder, VIDEO, b"");
        let error = opened(&folder).err().unwrap().to_string();
        assert!(error.contains("ffmpeg -i rgb.mp4"), "{error}");
    }

    #[test]
    fn accelerations_without_gravity_are_no_imu() {
        let folder = folder(COLOR);
        samples::file(&folder, IMU, b"10.49, 0.0, 0.01, 0.0, 0.1, 0.2, 0.3\n");
        assert!(!opened(&folder).unwrap().summary().has_imu);
    }
}
