use nalgebra::Isometry3;

use super::{ImuSample, RgbdFrame, Stamp};

/// A pose from motion capture or another reference, as logged: its world need not be z-up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TruthPose {
    pub stamp: Stamp,
    pub world_from_body: Isometry3<f64>,
}

/// What a log yields, in order of time.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    Imu(ImuSample),
    Frame(Box<RgbdFrame>),
    Truth(TruthPose),
}

impl Event {
    pub fn stamp(&self) -> Stamp {
        match self {
            Self::Imu(sample) => sample.stamp,
            Self::Frame(frame) => frame.stamp,
            Self::Truth(pose) => pose.stamp,
        }
    }
}
