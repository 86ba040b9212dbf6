//! Logs that are folders of image files, with stamps and poses in text.

use std::path::{Path, PathBuf};

use nalgebra::Vector3;

use super::compressed::{color_file, depth_file};
use super::merge::{Reading, ReadingSource};
use super::pair::{Paired, Pairer};
use super::pixels::Rejection;
use super::ros::Role;
use super::{LogConfig, LogError, ReadReport, TruthPose};
use crate::inertial::ImuConfig;
use crate::sensor::{ImuSample, Stamp};
use crate::vision::{DepthRegistration, StereoRig};

/// Files larger than this are not images of a log, bytes.
const LARGEST_FILE: u64 = 256 << 20;

#[derive(Debug, Clone, PartialEq)]
pub(super) enum Entry {
    /// The left one of two cameras, or the only one.
    Color(PathBuf),
    Right(PathBuf),
    Depth(PathBuf),
    /// As logged.
    Imu(ImuSample),
    /// As logged, without the other half.
    Gyroscope(Vector3<f64>),
    Accelerometer(Vector3<f64>),
    Truth(TruthPose),
}

/// What a folder contains, and what of it could not be used.
#[derive(Debug, Default)]
pub(super) struct Listing {
    pub entries: Vec<(Stamp, Entry)>,
    /// Reason and detail of each line or file left out.
    pub rejections: Vec<(String, String)>,
    /// Where depth comes from two cameras.
    pub stereo: Option<StereoRig>,
    /// Where depth images are not those of the color camera.
    pub registration: Option<DepthRegistration>,
}

impl Listing {
    pub fn has_truth(&self) -> bool {
        self.entries.iter().any(|(_, entry)| matches!(entry, Entry::Truth(_)))
    }

    /// Whether gyroscope and accelerometer come apart.
    pub fn has_split_imu(&self) -> bool {
        self.entries.iter().any(|(_, entry)| matches!(entry, Entry::Accelerometer(_)))
    }

    /// Number of color and depth pairs.
    pub fn frames(&self, config: &LogConfig) -> u64 {
        let mut pairer = Pairer::new((config.max_pair_difference * 1e9).round() as i64);
        for (stamp, entry) in &self.entries {
            match entry {
                Entry::Color(_) => pairer.add_color(*stamp, ()),
                Entry::Depth(_) | Entry::Right(_) => pairer.add_depth(*stamp, ()),
                _ => false,
            };
        }
        let mut frames = 0;
        pairer.settle(Stamp::from_nanos(i64::MAX), |paired| {
            frames += u64::from(matches!(paired, Paired::Pair(..)));
        });
        frames
    }
}

/// Reads the image files one by one, in order of their stamps.
pub(super) struct FolderSource {
    entries: std::vec::IntoIter<(Stamp, Entry)>,
    rejections: Vec<(String, String)>,
    config: LogConfig,
    imu: ImuConfig,
}

impl FolderSource {
    pub fn new(mut listing: Listing, config: &LogConfig, imu: &ImuConfig) -> Self {
        listing.entries.sort_by_key(|(stamp, _)| *stamp);
        Self {
            entries: listing.entries.into_iter(),
            rejections: listing.rejections,
            config: config.clone(),
            imu: imu.clone(),
        }
    }
}

impl ReadingSource for FolderSource {
    fn next_reading(&mut self, report: &mut ReadReport) -> Option<Reading> {
        for (reason, detail) in self.rejections.drain(..) {
            report.skip(&reason, detail);
        }
        for (stamp, entry) in self.entries.by_ref() {
            match read_entry(stamp, &entry, &self.config, &self.imu) {
                Ok(reading) => return Some(reading),
                Err(Rejection { reason, detail }) => {
                    report.skip(&format!("{}: {reason}", entry.role().name()), detail);
                }
            }
        }
        None
    }
}

impl Entry {
    pub fn role(&self) -> Role {
        match self {
            Self::Color(_) => Role::Color,
            Self::Depth(_) => Role::Depth,
            Self::Right(_) => Role::Right,
            Self::Imu(_) | Self::Gyroscope(_) => Role::Imu,
            Self::Accelerometer(_) => Role::Accelerometer,
            Self::Truth(_) => Role::Truth,
        }
    }
}

/// The pose or the image of an entry; a rejection names the file.
pub(super) fn read_entry(
    stamp: Stamp,
    entry: &Entry,
    config: &LogConfig,
    imu: &ImuConfig,
) -> Result<Reading, Rejection> {
    let (path, reading) = match entry {
        Entry::Truth(pose) => return Ok(Reading::Truth(*pose)),
        Entry::Imu(sample) => return Ok(Reading::Imu(imu.in_si_units(sample))),
        Entry::Gyroscope(rate) => {
            return Ok(Reading::Gyroscope(stamp, rate * imu.gyroscope_scale));
        }
        Entry::Accelerometer(force) => {
            return Ok(Reading::Accelerometer(stamp, force * imu.accelerometer_scale));
        }
        Entry::Color(path) => {
            let image = read_file(path).and_then(|bytes| color_file(&bytes));
            (path, image.map(|image| Reading::Color(stamp, image)))
        }
        Entry::Right(path) => {
            let image = read_file(path).and_then(|bytes| color_file(&bytes));
            (path, image.map(|image| Reading::Right(stamp, image)))
        }
        Entry::Depth(path) => {
            let image = read_file(path).and_then(|bytes| depth_file(&bytes, config));
            (path, image.map(|image| Reading::Depth(stamp, image)))
        }
    };
    reading.map_err(|Rejection { reason, detail }| {
        Rejection::new(reason, format!("{}: {detail}", path.display()))
    })
}

fn read_file(path: &Path) -> Result<Vec<u8>, Rejection> {
    let unreadable = |error: std::io::Error| Rejection::new("cannot be read", error.to_string());
    let size = std::fs::metadata(path).map_err(unreadable)?.len();
    if size > LARGEST_FILE {
        return Err(Rejection::new("absurd size", format!("{size} bytes")));
    }
    std::fs::read(path).map_err(unreadable)
}

pub(super) fn read_text(path: &Path) -> Result<String, LogError> {
    std::fs::read_to_string(path)
        .map_err(|source| LogError::Io { path: path.to_path_buf(), source })
}
