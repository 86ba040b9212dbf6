use std::collections::BTreeMap;
use std::path::PathBuf;

use nalgebra::{Isometry3, Matrix4};
use serde::{Deserialize, Serialize};

use super::found::FoundCalibration;
use crate::sensor::{CameraConfig, Event, Stamp};
use crate::vision::MaskConfig;

/// What a reader met: counts that end up in `metrics.json`.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct ReadReport {
    pub frames: u64,
    pub imu_samples: u64,
    pub truth_poses: u64,
    /// Messages left out, by reason (`"color image: buffer too short"`).
    pub skipped: BTreeMap<String, u64>,
    /// When the first one was left out, where its stamp is known.
    #[serde(skip)]
    pub first_skipped: BTreeMap<String, Stamp>,
}

impl ReadReport {
    /// Counts a message left out that has a stamp.
    pub fn skip_at(&mut self, reason: &str, stamp: Stamp) {
        self.first_skipped.entry(reason.to_owned()).or_insert(stamp);
        self.skip(reason, format_args!("at {stamp} s"));
    }

    /// Counts a message left out; warns with `detail` the first time for each reason.
    pub fn skip(&mut self, reason: &str, detail: impl std::fmt::Display) {
        let count = self.skipped.entry(reason.to_owned()).or_default();
        *count += 1;
        if *count == 1 {
            tracing::warn!("skipped: {reason} ({detail}); further ones are only counted");
        }
    }
}

/// What a log turned out to be when it was opened.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct LogSummary {
    /// `"TUM RGB-D folder"`, `"ROS 1 bag"`, ...
    pub kind: String,
    /// Name under `configs/` (without `.toml`) that fits this layout.
    pub config_name: String,
    pub has_imu: bool,
    pub has_truth: bool,
    /// Chosen source for each role (`color`, `depth`, `imu`, `truth`): topic or file name.
    pub sources: BTreeMap<String, String>,
    /// Source of a gyroscope that is not used since nothing holds an accelerometer.
    pub lone_gyroscope: Option<String>,
    /// Number of frames, where the log knows it without being read through.
    pub frames: Option<u64>,
    /// Calibration of the color camera and its mounting on the IMU, where the log tells both.
    pub camera: Option<CameraConfig>,
    /// The left and the right camera, where depth comes from two.
    #[serde(skip)]
    pub stereo: Vec<CameraConfig>,
    /// What its messages tell of calibrations.
    pub calibration: FoundCalibration,
    /// For a role, the topics that could have played it, too, with their rates.
    pub others: BTreeMap<String, Vec<String>>,
}

impl LogSummary {
    /// Whether depth comes from two cameras.
    pub fn is_stereo(&self) -> bool {
        self.sources.contains_key("right")
    }
}

/// A log that is being read. Events come ordered by stamp; memory stays bounded.
///
/// A bad message is left out, counted in [`Log::report`] and warned of; it never ends the run.
pub trait Log: Send {
    fn summary(&self) -> &LogSummary;

    /// The next event, or `None` at the end.
    fn next_event(&mut self) -> Option<Event>;

    fn report(&self) -> &ReadReport;
}

/// Where the streams of a log are and how their numbers are to be read.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LogConfig {
    /// Topic of the color image; empty: chosen by message type; `"none"`: not used.
    pub color_topic: String,
    /// Topic of the depth image; empty: chosen by message type and encoding; `"none"`: not used.
    pub depth_topic: String,
    /// Topic of the right one of two cameras, of which `color_topic` is the left one; empty: a
    /// second image like the color image where there is no depth; `"none"`: not used.
    pub right_topic: String,
    /// Topic of the IMU, or of its gyroscope; empty: chosen by message type; `"none"`: not used.
    pub imu_topic: String,
    /// Topic of the accelerometer where it is apart from the gyroscope; empty: chosen by what the
    /// messages hold; `"none"`: not used.
    pub accel_topic: String,
    /// Topic of the reference poses; empty: chosen by message type; `"none"`: not used.
    pub truth_topic: String,
    /// Channel order of color images whose encoding is only `8UC3`: `"bgr"` or `"rgb"`.
    pub color_8uc3: String,
    /// Metres per unit of 16-bit depth (0.001 for millimetres, 0.0002 for TUM RGB-D).
    pub depth_scale: f64,
    /// Raw depth values, besides 0, that mean "none" (65535 in 7-Scenes).
    pub depth_invalid: Vec<u16>,
    /// Color and depth images further apart than this are no pair, s.
    pub max_pair_difference: f64,
    /// How far messages may arrive out of order before they are left out, s.
    pub reorder_window: f64,
    /// The left and the right camera as their topics are logged; empty where depth is logged.
    pub stereo: Vec<CameraConfig>,
    /// Row-major 4x4 matrix that maps IMU coordinates to those of the body whose poses the
    /// reference gives (a marker).
    pub truth_body_from_imu: [[f64; 4]; 4],
    /// Part of the color image without features: the robot's own body.
    pub mask: MaskConfig,
}

impl Default for LogConfig {
    fn default() -> Self {
        Self {
            color_topic: String::new(),
            depth_topic: String::new(),
            right_topic: String::new(),
            imu_topic: String::new(),
            accel_topic: String::new(),
            truth_topic: String::new(),
            color_8uc3: "bgr".to_owned(),
            depth_scale: 0.001,
            depth_invalid: vec![65535],
            max_pair_difference: 0.02,
            reorder_window: 0.5,
            stereo: Vec::new(),
            truth_body_from_imu: Matrix4::identity().into(),
            mask: MaskConfig::default(),
        }
    }
}

impl LogConfig {
    /// # Errors
    /// [`LogError::Config`] for a value without meaning.
    pub fn validate(&self) -> Result<(), LogError> {
        let error = |key, value: String, expected| Err(LogError::Config { key, value, expected });
        if !["bgr", "rgb"].contains(&self.color_8uc3.as_str()) {
            return error("color_8uc3", self.color_8uc3.clone(), "\"bgr\" or \"rgb\"");
        }
        if !(self.depth_scale as f32 > 0.0 && self.depth_scale.is_finite()) {
            return error("depth_scale", self.depth_scale.to_string(), "a positive number");
        }
        if ![0, 2].contains(&self.stereo.len()) {
            let count = format!("[{} cameras]", self.stereo.len());
            return error("stereo", count, "the left and the right camera, or none");
        }
        if rigid_motion(&self.truth_body_from_imu).is_none() {
            let matrix = format!("{:?}", self.truth_body_from_imu);
            return error("truth_body_from_imu", matrix, "a rigid motion (row-major 4x4)");
        }
        let times = [
            ("max_pair_difference", self.max_pair_difference),
            ("reorder_window", self.reorder_window),
        ];
        for (key, value) in times {
            if !(value >= 0.0 && value.is_finite()) {
                return error(key, value.to_string(), "seconds, not negative");
            }
        }
        Ok(())
    }
}

/// The motion of a row-major 4x4 matrix; `None` if it is not close to a rigid one.
pub(super) fn rigid_motion(matrix: &[[f64; 4]; 4]) -> Option<Isometry3<f64>> {
    // The check is that of a camera's mounting.
    CameraConfig { imu_from_camera: *matrix, ..CameraConfig::default() }.imu_from_camera()
}

/// A log that cannot be read at all.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    #[error("{path}: {source}")]
    Io { path: PathBuf, source: std::io::Error },
    #[error(
        "{path}: not a log this program reads ({reason}); it reads .mcap, ROS 1 .bag, ROS 2 bags (.db3 or folder), TUM RGB-D, EuRoC and 7-Scenes folders"
    )]
    UnknownFormat { path: PathBuf, reason: String },
    #[error("{path}: {reason}")]
    Corrupt { path: PathBuf, reason: String },
    #[error("{path}: no {role} in this log; it has: {available}")]
    MissingStream { path: PathBuf, role: &'static str, available: String },
    #[error("{path}: encoding {encoding} of {topic} is not supported; supported are {supported}")]
    Encoding { path: PathBuf, topic: String, encoding: String, supported: &'static str },
    #[error(
        "{path}: depth images of {depth} ({}x{}) are not registered to color images of {color} \
         ({}x{}); record depth aligned to color, or the CameraInfo of both and the transform between \
         their frames", .depth_size.0, .depth_size.1, .color_size.0, .color_size.1
    )]
    Unregistered {
        path: PathBuf,
        color: String,
        color_size: (u32, u32),
        depth: String,
        depth_size: (u32, u32),
    },
    #[error("{path}: no depth, and none from its two cameras: {reason}")]
    Stereo { path: PathBuf, reason: String },
    #[error("log.{key} = {value}: expected {expected}")]
    Config { key: &'static str, value: String, expected: &'static str },
}
