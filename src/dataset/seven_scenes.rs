//! 7-Scenes folders: `frame-XXXXXX.color.png` (or `.jpg`), `.depth.png`, `.pose.txt`.
//!
//! Format: <https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/>. There are
//! no time stamps; frame `n` is stamped `n / 30` s.

use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Matrix3, Matrix4, Rotation3, Translation3, UnitQuaternion};

use super::folder::{Entry, Listing, read_text};
use super::pixels::Rejection;
use super::{LogConfig, LogError, LogSummary, TruthPose};
use crate::sensor::Stamp;

/// Nominal rate of the camera, Hz.
const FRAME_RATE: i64 = 30;

enum File {
    Color,
    Depth,
    Pose,
}

pub(super) fn is_seven_scenes(folder: &Path) -> bool {
    std::fs::read_dir(folder).is_ok_and(|files| {
        files.flatten().any(|file| file.file_name().to_str().is_some_and(|n| parse(n).is_some()))
    })
}

/// Frame number and kind of a file.
fn parse(name: &str) -> Option<(u32, File)> {
    let (number, kind) = name.strip_prefix("frame-")?.split_once('.')?;
    let kind = match kind {
        "color.png" | "color.jpg" => File::Color,
        "depth.png" => File::Depth,
        "pose.txt" => File::Pose,
        _ => return None,
    };
    Some((number.parse().ok()?, kind))
}

fn stamp(number: u32) -> Stamp {
    let rounded = (i64::from(number) * 1_000_000_000 + FRAME_RATE / 2) / FRAME_RATE;
    Stamp::from_nanos(rounded)
}

pub(super) fn list(folder: &Path, config: &LogConfig) -> Result<(LogSummary, Listing), LogError> {
    let mut listing = Listing::default();
    let (mut colors, mut depths) = (0, 0);
    for (number, kind, path) in files(folder)? {
        let stamp = stamp(number);
        match kind {
            File::Color => {
                colors += 1;
                listing.entries.push((stamp, Entry::Color(path)));
            }
            File::Depth => {
                depths += 1;
                listing.entries.push((stamp, Entry::Depth(path)));
            }
            File::Pose if config.truth_topic == "none" => {}
            File::Pose => match read_pose(&path, stamp) {
                Ok(pose) => listing.entries.push((stamp, Entry::Truth(pose))),
                Err(Rejection { reason, detail }) => listing
                    .rejections
                    .push((format!("truth: {reason}"), format!("{}: {detail}", path.display()))),
            },
        }
    }
    for (role, count) in [("color image", colors), ("depth image", depths)] {
        if count == 0 {
            let available = format!("{colors} color images, {depths} depth images");
            return Err(LogError::MissingStream { path: folder.into(), role, available });
        }
    }
    let mut summary = LogSummary {
        kind: "7-Scenes folder".to_owned(),
        config_name: "seven_scenes".to_owned(),
        has_truth: listing.has_truth(),
        frames: Some(listing.frames(config)),
        ..LogSummary::default()
    };
    for (role, name) in [("color", "color.*"), ("depth", "depth.png"), ("truth", "pose.txt")] {
        if role != "truth" || summary.has_truth {
            summary.sources.insert(role.to_owned(), format!("frame-*.{name}"));
        }
    }
    Ok((summary, listing))
}

/// By name, since the order of a directory is arbitrary.
fn files(folder: &Path) -> Result<Vec<(u32, File, PathBuf)>, LogError> {
    let failed = |source| LogError::Io { path: folder.to_path_buf(), source };
    let mut paths = Vec::new();
    for file in std::fs::read_dir(folder).map_err(failed)? {
        paths.push(file.map_err(failed)?.path());
    }
    paths.sort();
    let parsed = paths.into_iter().filter_map(|path| {
        let (number, kind) = parse(path.file_name()?.to_str()?)?;
        Some((number, kind, path))
    });
    Ok(parsed.collect())
}

/// A row-major 4x4 camera-to-world matrix whose rotation is only roughly orthonormal.
fn read_pose(path: &Path, stamp: Stamp) -> Result<TruthPose, Rejection> {
    let text = read_text(path).map_err(|e| Rejection::new("cannot be read", e.to_string()))?;
    let numbers: Vec<f64> = text.split_whitespace().map_while(|n| n.parse().ok()).collect();
    if numbers.len() != 16 || !numbers.iter().all(|x| x.is_finite()) {
        return Err(Rejection::new("not a finite 4x4 matrix", text.trim()));
    }
    let matrix = Matrix4::from_row_slice(&numbers);
    let rotation: Matrix3<f64> = matrix.fixed_view::<3, 3>(0, 0).into_owned();
    let residual = (rotation.transpose() * rotation - Matrix3::identity()).norm();
    if residual > 0.05 || rotation.determinant() <= 0.0 {
        return Err(Rejection::new("not a rigid motion", format!("residual {residual}")));
    }
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&rotation));
    let translation = Translation3::new(matrix[(0, 3)], matrix[(1, 3)], matrix[(2, 3)]);
    Ok(TruthPose { stamp, world_from_body: Isometry3::from_parts(translation, rotation) })
}

#[cfg(test)]
mod tests {
    use super::super::samples;
    use super::super::{Event, open};
    use super::*;
    use crate::inertial::ImuConfig;

    #[test]
    fn names_and_stamps() {
        assert!(matches!(parse("frame-000031.color.jpg"), Some((31, File::Color))));
        assert!(matches!(parse("frame-000000.depth.png"), Some((0, File::Depth))));
        for name in ["frame-1.txt", "frame-x.depth.png", "frame-99999999999.pose.txt", "camera.txt"]
        {
            assert!(parse(name).is_none(), "{name}");
        }
        assert_eq!(stamp(31).nanos(), 1_033_333_333);
        assert_eq!(stamp(2).nanos(), 66_666_667);
    }

    #[test]
    fn poses_that_are_no_rigid_motion_are_left_out() {
        let folder = tempfile::tempdir().unwrap();
        for (text, reason) in [
            ("1 0 0 5 0 1 0 6 0 0 1 7 0 0 0 1", None),
            ("1 0 0 5 0 1 0 6 0 0 -1 7 0 0 0 1", Some("not a rigid motion")),
            ("2 0 0 5 0 2 0 6 0 0 2 7 0 0 0 1", Some("not a rigid motion")),
            ("nan 0 0 5 0 1 0 6 0 0 1 7 0 0 0 1", Some("not a finite 4x4 matrix")),
            ("1 0 0", Some("not a finite 4x4 matrix")),
        ] {
            let path = samples::file(&folder, "pose.txt", text.as_bytes());
            let pose = read_pose(&path, Stamp::default());
            assert_eq!(pose.as_ref().err().map(|error| error.reason), reason);
            if let Ok(pose) = pose {
                assert_eq!(pose.world_from_body, Isometry3::translation(5.0, 6.0, 7.0));
            }
        }
    }

    #[test]
    fn a_folder_without_depth_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        samples::file(&folder, "frame-000000.color.png", b"");
        let opened = open(folder.path(), &LogConfig::default(), &ImuConfig::default());
        let error = opened.err().unwrap().to_string();
        assert!(
            error.ends_with("no depth image in this log; it has: 1 color images, 0 depth images")
        );
    }

    #[test]
    fn red_kitchen_is_read() {
        let Some(path) = samples::data("seven_scenes_redkitchen") else { return };
        let mut log = open(&path, &LogConfig::default(), &ImuConfig::default()).unwrap();
        assert_eq!(log.summary().config_name, "seven_scenes");
        assert_eq!((log.summary().frames, log.summary().has_truth), (Some(150), true));
        let Some(Event::Truth(pose)) = log.next_event() else { panic!("truth comes first") };
        assert_eq!(pose.stamp, Stamp::default());
        let Some(Event::Frame(frame)) = log.next_event() else { panic!("then the frame") };
        assert_eq!(frame.stamp, Stamp::default());
        assert!(frame.depth.data().iter().all(|raw| *raw < 65535));
        let mut events = 0;
        while log.next_event().is_some_and(|_| events < 10) {
            events += 1;
        }
        assert!(log.report().skipped.is_empty());
    }
}
