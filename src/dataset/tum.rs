//! TUM RGB-D folders: `rgb.txt`, `depth.txt` (or a list of pairs) and, where there is one,
//! `groundtruth.txt`.
//!
//! Format: <https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats>. The poses are those
//! of the color camera. `accelerometer.txt` alone is no IMU and is not read.

use std::path::{Path, PathBuf};

use super::folder::{Entry, Listing, read_text};
use super::message::isometry;
use super::pixels::Rejection;
use super::text_table::stamp;
use super::{LogConfig, LogError, LogSummary, TruthPose};
use crate::dialect::{Dialect, Separator, TimeUnit};
use crate::sensor::Stamp;

const COLOR_LIST: &str = "rgb.txt";
const DEPTH_LIST: &str = "depth.txt";
const TRUTH_LIST: &str = "groundtruth.txt";

/// Files that list pairs, as `associate.py` of the benchmark writes them.
const PAIR_LISTS: [&str; 6] = [
    "associations.txt",
    "association.txt",
    "associate.txt",
    "associated.txt",
    "assoc.txt",
    "rgb_depth.txt",
];

pub(super) fn is_tum(folder: &Path) -> bool {
    let has = |name: &str| folder.join(name).is_file();
    has(COLOR_LIST) || has(DEPTH_LIST) || pair_list(folder).is_some()
}

fn pair_list(folder: &Path) -> Option<&'static str> {
    PAIR_LISTS.into_iter().find(|name| folder.join(name).is_file())
}

pub(super) fn list(folder: &Path, config: &LogConfig) -> Result<(LogSummary, Listing), LogError> {
    let mut listing = Listing::default();
    let has = |name: &str| folder.join(name).is_file();
    let sources = match pair_list(folder).filter(|_| !has(COLOR_LIST) || !has(DEPTH_LIST)) {
        Some(pairs) => {
            read_pairs(folder, pairs, &mut listing)?;
            [("color", pairs), ("depth", pairs)]
        }
        None => {
            read_images(folder, &mut listing)?;
            [("color", COLOR_LIST), ("depth", DEPTH_LIST)]
        }
    };
    if config.truth_topic != "none" && has(TRUTH_LIST) {
        read_list(folder, TRUTH_LIST, &mut listing, |row, stamp| {
            pose(row, stamp).map(|pose| vec![(stamp, Entry::Truth(pose))])
        })?;
    }
    let mut summary = LogSummary {
        kind: "TUM RGB-D folder".to_owned(),
        config_name: "tum_rgbd".to_owned(),
        has_truth: listing.has_truth(),
        frames: Some(listing.frames(config)),
        ..LogSummary::default()
    };
    let truth = summary.has_truth.then_some(("truth", TRUTH_LIST));
    for (role, name) in sources.into_iter().chain(truth) {
        summary.sources.insert(role.to_owned(), name.to_owned());
    }
    Ok((summary, listing))
}

fn read_images(folder: &Path, listing: &mut Listing) -> Result<(), LogError> {
    for (name, role) in [(COLOR_LIST, "color image list"), (DEPTH_LIST, "depth image list")] {
        if !folder.join(name).is_file() {
            let available = available(folder);
            return Err(LogError::MissingStream { path: folder.into(), role, available });
        }
    }
    read_list(folder, COLOR_LIST, listing, |row, stamp| {
        image_path(folder, row.rest()).map(|path| vec![(stamp, Entry::Color(path))])
    })?;
    read_list(folder, DEPTH_LIST, listing, |row, stamp| {
        image_path(folder, row.rest()).map(|path| vec![(stamp, Entry::Depth(path))])
    })
}

/// `stamp color stamp depth`, or the depth first, which then has `depth` in its name.
fn read_pairs(folder: &Path, name: &str, listing: &mut Listing) -> Result<(), LogError> {
    read_list(folder, name, listing, |row, stamp| {
        let [_, first, other, second] = row.fields()[..] else {
            return Err(Rejection::new("no pair of stamps and files", row.line));
        };
        let other = row.stamp(other)?;
        let (first, second) = (image_path(folder, first)?, image_path(folder, second)?);
        let is_depth = first.to_string_lossy().contains("depth");
        Ok(match is_depth {
            true => vec![(stamp, Entry::Depth(first)), (other, Entry::Color(second))],
            false => vec![(stamp, Entry::Color(first)), (other, Entry::Depth(second))],
        })
    })
}

fn available(folder: &Path) -> String {
    let present: Vec<_> = [COLOR_LIST, DEPTH_LIST, TRUTH_LIST]
        .into_iter()
        .filter(|name| folder.join(name).is_file())
        .collect();
    present.join(", ")
}

/// A line `stamp rest` of a list.
pub(super) struct Line<'a> {
    line: &'a str,
    dialect: Dialect,
    unit: TimeUnit,
}

impl<'a> Line<'a> {
    fn fields(&self) -> Vec<&'a str> {
        self.dialect.fields(self.line).collect()
    }

    /// All behind the stamp: a file's name may hold blanks.
    pub fn rest(&self) -> &'a str {
        let split = match self.dialect.separator {
            Separator::Blanks => self.line.split_once(char::is_whitespace),
            Separator::Commas => self.line.split_once(','),
            Separator::Semicolons => self.line.split_once(';'),
        };
        split.map_or("", |(_, rest)| rest.trim().trim_matches('"'))
    }

    fn stamp(&self, field: &str) -> Result<Stamp, Rejection> {
        stamp(field, self.dialect, self.unit)
            .map_err(|reason| Rejection::new("no time stamp", reason))
    }
}

/// Reads the lines of a list; those that cannot be read are noted with their number.
pub(super) fn read_list(
    folder: &Path,
    name: &str,
    listing: &mut Listing,
    read: impl Fn(&Line, Stamp) -> Result<Vec<(Stamp, Entry)>, Rejection>,
) -> Result<(), LogError> {
    let text = read_text(&folder.join(name))?;
    let mut layout = None;
    for (number, line) in text.trim_start_matches('\u{feff}').lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let (dialect, unit) = *layout.get_or_insert_with(|| {
            let dialect = Dialect::of(line);
            (dialect, TimeUnit::of_stamp(dialect.fields(line).next().unwrap_or("")))
        });
        let line = Line { line, dialect, unit };
        let first = dialect.fields(line.line).next().unwrap_or("");
        match line.stamp(first).and_then(|stamp| read(&line, stamp)) {
            Ok(entries) => listing.entries.extend(entries),
            Err(Rejection { reason, detail }) => listing
                .rejections
                .push((format!("{name}: {reason}"), format!("line {}: {detail}", number + 1))),
        }
    }
    Ok(())
}

/// The image that a list names, perhaps as another system would, or where it lay elsewhere.
pub(super) fn image_path(folder: &Path, name: &str) -> Result<PathBuf, Rejection> {
    if name.is_empty() {
        return Err(Rejection::new("no file name", name));
    }
    let plain = name.replace('\\', "/");
    let parts: Vec<&str> = plain.split('/').collect();
    let last = parts[parts.len().saturating_sub(2)..].join("/");
    let path = folder.join(name);
    let others = [folder.join(&plain), folder.join(last)];
    let found = || others.into_iter().find(|other| other.is_file());
    Ok(if path.is_file() { path } else { found().unwrap_or(path) })
}

/// `tx ty tz qx qy qz qw` behind the stamp.
fn pose(line: &Line, stamp: Stamp) -> Result<TruthPose, Rejection> {
    let fields = line.fields();
    let numbers = fields.iter().skip(1).map_while(|field| line.dialect.number(field));
    let [tx, ty, tz, x, y, z, w] = numbers.collect::<Vec<_>>()[..] else {
        return Err(Rejection::new("not a pose", line.line));
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
    fn lists_in_every_spelling() {
        let plain = [
            (COLOR_LIST, "10.5 rgb/c.png\n11.5 rgb/c d.png\n"),
            (DEPTH_LIST, "10.5 depth/d.png\n11.5 depth/d.png\n"),
            (TRUTH_LIST, "10.5 1 2 3 0 0 0 1\n"),
        ];
        let written = |write: &dyn Fn(&str) -> String| {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path();
            for name in ["rgb", "depth"] {
                std::fs::create_dir(path.join(name)).unwrap();
            }
            color(path, "rgb/c.png");
            color(path, "rgb/c d.png");
            depth(path, "depth/d.png");
            for (name, text) in plain {
                samples::file(&folder, name, write(text).as_bytes());
            }
            folder
        };
        let frames = |folder: &tempfile::TempDir| {
            let mut log =
                open(folder.path(), &LogConfig::default(), &ImuConfig::default()).unwrap();
            let stamps: Vec<_> = read_all(log.as_mut()).iter().map(Event::stamp).collect();
            assert_eq!((log.report().frames, log.report().truth_poses), (2, 1));
            stamps
        };
        let expected = frames(&written(&str::to_owned));
        // One second apart as before: no one confirms a step of more than ten.
        let stamps =
            |text: &str| text.replace("0.5 ", "0500000000000 ").replace("1.5 ", "0501000000000 ");
        let spellings: [&dyn Fn(&str) -> String; 6] = [
            &|text| format!("\u{feff}{}", text.replace('\n', "\r\n")),
            &|text| format!("\u{feff}# list\r\n{text}"),
            &|text| text.replace("c d.png", "c.png").replace(' ', ","),
            &|text| text.replace("c d.png", "c.png").replace(' ', ";"),
            &|text| text.replace("0.5", "0,5").replace("1.5", "1,5"),
            &|text| text.replace("rgb/", "C:\\data\\rgb\\").replace("depth/", "/elsewhere/depth/"),
        ];
        for write in spellings {
            assert_eq!(frames(&written(write)), expected, "{}", write(plain[0].1));
        }
        // 10 500 s after the device began.
        let late = frames(&written(&stamps));
        assert_eq!(late[0].nanos(), 10_500_000_000_000);
        assert_eq!(late.last().unwrap().nanos(), 10_501_000_000_000);
    }

    #[test]
    fn a_list_of_pairs_is_enough() {
        for pairs in ["10 c.png 10.01 depth.png\n", "# pairs\n10.01,depth.png,10,c.png\r\n"] {
            let folder = tempfile::tempdir().unwrap();
            color(folder.path(), "c.png");
            depth(folder.path(), "depth.png");
            samples::file(&folder, "associations.txt", pairs.as_bytes());
            let mut log =
                open(folder.path(), &LogConfig::default(), &ImuConfig::default()).unwrap();
            let events = read_all(log.as_mut());
            assert!(
                matches!(&events[..], [Event::Frame(frame)]
                if frame.stamp == Stamp::from_parts(10, 0)),
                "{pairs}"
            );
        }
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
