//! Logs in and out. Every reader yields the same time-ordered [`Event`]s behind [`Log`].
//!
//! [`open`] guesses the format. Containers ([`bag`] and [`mcap_file`], both read as [`records`])
//! yield messages, [`ros`] makes readings of them, folders ([`tum`], [`euroc`], [`seven_scenes`])
//! yield readings directly, and [`merge`] orders and pairs the readings. A log that is cut or damaged yields all that can still be read.

mod bag;
mod calibration;
mod compressed;
mod convert;
mod database;
mod decode;
mod definition;
mod demosaic;
mod encoding;
mod euroc;
mod event;
mod fault;
mod folder;
mod found;
mod imu_csv;
mod inertial_halves;
mod inspect;
mod layout;
mod mcap_file;
mod merge;
mod message;
mod navigation;
mod navigation_csv;
mod navigation_message;
mod nmea;
mod open;
mod openloris;
mod output;
mod pair;
mod pixels;
mod records;
mod registration;
mod ros;
mod ros2;
mod rosbag2;
mod rvl;
#[cfg(test)]
mod samples;
mod section;
mod seven_scenes;
mod stereo;
mod stray;
mod text_table;
mod topics;
mod tum;
mod write;

use crate::sensor::{Event, RgbdFrame, TruthPose};

pub use convert::{ConvertError, ConvertSummary, convert};
pub use event::{Log, LogConfig, LogError, LogSummary, ReadReport};
pub use fault::{Fault, FaultKind};
pub use found::{FoundCalibration, FoundIn, FoundSetting};
pub use imu_csv::{ImuCsv, ImuRow};
pub use inspect::{
    AccelerometerFit, AccelerometerUnit, Assumed, ColorInspection, DepthInspection, Evidence,
    Finding, Gap, GyroscopeUnit, ImuInspection, Inspection, LogClock, PairInspection, Severity,
    Sign, TURN_SPAN, Timing, TopicInspection, Trial, TurnInspection, Verdict, inspect,
};
pub use layout::Layout;
pub use navigation::{NavigationLog, NavigationTopics, read_navigation};
pub use navigation_csv::{Positions, is_kitti_table, read_imu_table, read_position_table};
pub use open::{detect, detect_with, open, open_with_faults};
pub use write::{LogWriter, LogWriterOptions, Quirks, WriteError, WriteSummary};
