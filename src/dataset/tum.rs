//! TUM RGB-D folders: `rgb.txt`, `depth.txt` and, where there is one, `groundtruth.txt`.
//!
//! Format: <https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats>. The poses are those
//! of the color camera. `accelerometer.txt` alone is no IMU and is not read.

use std::path::Path;

use super::folder::{Entry, Listing, read_text};
use super::message::isometry;
use super::pixels::Rejection;
use super::{LogConfig, LogError, LogSummary, TruthPose};
use crate::sensor::Stamp;

const COLOR_LIST: &str = "rgb.txt";
const DEPTH_LIST: &str = "depth.txt";
const TRUTH_LIST: &str = "groundtruth.txt";

pub(super) fn is_tum(folder: &Path) -> bool {
    folder.join(COLOR_LIST).is_file() || folder.join(DEPTH_LIST).is_file()
}

pub(super) fn list(folder: &Path, config: &LogConfig) -> Result<(LogSummary, Listing), LogError> {
    let mut listing = Listing::default();
    for (name, role) in [(COLOR_LIST, "color image list"), (DEPTH_LIST, "depth image list")] {
        if !folder.join(name).is_file() {
            let available = available(folder);
            return Err(LogError::MissingStream { path: folder.into(), role, available });
        }
    }
    read_list(folder, COLOR_LIST, &mut listing, |stamp, text| {
        image_path(folder, text).map(|path| (stamp, Entry::Color(path)))
    })?;
    read_list(folder, DEPTH_LIST, &mut listing, |stamp, text| {
        image_path(folder, text).map(|path| (stamp, Entry::Depth(path)))
    })?;
    let truth = config.truth_topic != "none" && folder.join(TRUTH_LIST).is_file();
    if truth {
        read_list(folder, TRUTH_LIST, &mut listing, |stamp, text| {
            pose(stamp, text).map(|pose| (stamp, Entry::Truth(pose)))
        })?;
    }
    let mut summary = LogSummary {
        kind: "TUM RGB-D folder".to_owned(),
        config_name: "tum_rgbd".to_owned(),
        has_truth: listing.has_truth(),
        frames: Some(listing.frames(config)),
        ..LogSummary::default()
    };
    for (role, name) in [("color", COLOR_LIST), ("depth", DEPTH_LIST), ("truth", TRUTH_LIST)] {
        if role != "truth" || summary.has_truth {
            summary.sources.insert(role.to_owned(), name.to_owned());
        }
    }
    Ok((summary, listing))
}

fn available(folder: &Path) -> String {
    let present: Vec<_> = [COLOR_LIST, DEPTH_LIST, TRUTH_LIST]
        .into_iter()
        .filter(|name| folder.join(name).is_file())
        .collect();
    present.join(", ")
}

/// Reads lines `stamp rest`; those that cannot be read are noted with their number.
pub(super) fn read_list(
    folder: &Path,
    name: &str,
    listing: &mut Listing,
    read: impl Fn(Stamp, &str) -> Result<(Stamp, Entry), Rejection>,
) -> Result<(), LogError> {
    let text = read_text(&folder.join(name))?;
    for (number, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let (stamp, rest) = line.split_once(char::is_whitespace).unwrap_or((line, ""));
        let entry = Stamp::parse_seconds(stamp)
            .ok_or_else(|| Rejection::new("no time stamp", stamp))
            .and_then(|stamp| read(stamp, rest.trim()));
        match entry {
            Ok(entry) => listing.entries.push(entry),
            Err(Rejection { reason, detail }) => listing
                .rejections
                .push((format!("{name}: {reason}"), format!("line {}: {detail}", number + 1))),
        }
    }
    Ok(())
}

pub(super) fn image_path(folder: &Path, text: &str) -> Result<std::path::PathBuf, Rejection> {
    if text.is_empty() {
        return Err(Rejection::new("no file name", text));
    }
    Ok(folder.join(text))
}

/// `tx ty tz qx qy qz qw`.
fn pose(stamp: Stamp, text: &str) -> Result<TruthPose, Rejection> {
    let numbers: Vec<f64> = text.split_whitespace().map_while(|n| n.parse().ok()).collect();
    let [tx, ty, tz, x, y, z, w] = numbers[..] else {
        return Err(Rejection::new("not a pose", text));
    };
    let world_from_body = isometry([tx, ty, tz].into(), [x, y, z, w])?;
    Ok(TruthPose { stamp, world_from_body })
}

#[cfg(test)]
mod tests {
    use super::super::samples::{self, read_all};
    use super::super::{Event, open};
    use super::*;
    use crate::inertial::ImuConfig;

    fn png(folder: &Path, name: &str, image: image::DynamicImage) {
        image.save_with_format(folder.join(name), image::ImageFormat::Png).unwrap();
    }

    fn color(folder: &Path, name: &str) {
        png(folder, name, image::RgbImage::from_pixel(4, 2, image::Rgb([1, 2, 3])).into());
    }

    fn depth(folder: &Path, name: &str) {
        let pixels = image::ImageBuffer::from_vec(2, 4, vec![5000_u16; 8]).unwrap();
        png(folder, name, image::DynamicImage::ImageLuma16(pixels).rotate90());
    }

    #[test]
    fn faulty_lines_and_files_are_left_out() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path();
        color(path, "c.png");
        depth(path, "d.png");
        let rgb = "# color\n10.0 c.png\r\nx c.png\n11.0\n12.0 absent.png\n10.5 c.png\n";
        samples::file(&folder, COLOR_LIST, rgb.as_bytes());
        samples::file(&folder, DEPTH_LIST, b"10.51 d.png\n10.01 d.png\n12.0 d.png\n");
        let truth = "10 1 2 3 0 0 0 1\n10.1 1 2 3 0 0 0 2\n10.2 1 2 3\n10.3 nan 2 3 0 0 0 1\n";
        samples::file(&folder, TRUTH_LIST, truth.as_bytes());
        let config = LogConfig { depth_scale: 0.0002, ..LogConfig::default() };
        let mut log = open(path, &config, &ImuConfig::default()).unwrap();
        assert_eq!(log.summary().frames, Some(3));
        let events = read_all(log.as_mut());
        assert_eq!((log.report().frames, log.report().truth_poses), (2, 1));
        assert!(matches!(&events[1], Event::Frame(frame)
            if frame.stamp == Stamp::from_parts(10, 0) && frame.depth.at(0, 0) == Some(1.0)));
        let skipped: Vec<_> = log.report().skipped.keys().map(String::as_str).collect();
        assert_eq!(
            skipped,
            [
                "color image: cannot be read",
                "depth image: no color image near enough in time",
                "groundtruth.txt: not a pose",
                "groundtruth.txt: not a unit quaternion",
                "groundtruth.txt: not finite",
                "rgb.txt: no file name",
                "rgb.txt: no time stamp",
            ]
        );
    }

    #[test]
    fn a_missing_list_is_named() {
        let folder = tempfile::tempdir().unwrap();
        samples::file(&folder, COLOR_LIST, b"");
        let opened = open(folder.path(), &LogConfig::default(), &ImuConfig::default());
        let error = opened.err().unwrap().to_string();
        assert!(error.ends_with("no depth image list in this log; it has: rgb.txt"), "{error}");
    }

    #[test]
    fn freiburg1_rpy_is_read_whole() {
        let Some(path) = samples::data("tum_fr1_rpy") else { return };
        let config = LogConfig { depth_scale: 0.0002, ..LogConfig::default() };
        let mut log = open(&path, &config, &ImuConfig::default()).unwrap();
        let summary = log.summary().clone();
        assert_eq!((summary.kind.as_str(), summary.frames), ("TUM RGB-D folder", Some(270)));
        assert_eq!(summary.config_name, "tum_rgbd");
        assert!(summary.has_truth && !summary.has_imu);
        let first = std::iter::from_fn(|| log.next_event()).find_map(|event| match event {
            Event::Frame(frame) => Some(frame),
            _ => None,
        });
        let frame = first.unwrap();
        assert_eq!(frame.stamp.to_string(), "1305031229.528748000");
        assert_eq!((frame.color.width(), frame.color.height()), (640, 480));
        let depths: Vec<_> = (0..640).filter_map(|column| frame.depth.at(column, 240)).collect();
        assert!(depths.len() > 300 && depths.iter().all(|depth| (0.3..10.0).contains(depth)));
    }
}
