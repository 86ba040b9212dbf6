use nalgebra::Isometry3;
use serde::{Deserialize, Serialize};

use super::{ImuSample, RgbdFrame, Stamp};

/// A pose from motion capture or another reference, as logged: its world need not be z-up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TruthPose {
    pub stamp: Stamp,
    pub world_from_body: Isometry3<f64>,
}

/// A stream of messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Stream {
    Imu,
    Frames,
}

/// What a log yields, in order of time.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    Imu(ImuSample),
    Frame(Box<RgbdFrame>),
    Truth(TruthPose),
    /// A message of this stamp came again, the same as before, and is left out.
    Repeated(Stream, Stamp),
}

impl Event {
    pub fn stamp(&self) -> Stamp {
        match self {
            Self::Imu(sample) => sample.stamp,
            Self::Frame(frame) => frame.stamp,
            Self::Truth(pose) => pose.stamp,
            Self::Repeated(_, stamp) => *stamp,
        }
    }
}
