//! Events as they arrive: kept in order of time until everything up to a frame is there.

use std::collections::VecDeque;

use super::truth::{TruthConfig, TruthTrack};
use crate::sensor::{ImuSample, Stamp, TruthPose};
use crate::tracking::FrontEndFrame;

/// How long a frame waits for the IMU to reach it before the gap is bridged, and for the reference,
/// s.
pub(super) const PATIENCE: f64 = 1.0;

/// What has arrived and is not used up. A sample is stored here alone.
pub(super) struct EventBuffer {
    has_imu: bool,
    ended: bool,
    pub imu: VecDeque<ImuSample>,
    frames: VecDeque<(u64, FrontEndFrame)>,
    truth: TruthTrack,
    truth_offset: f64,
    frames_in: u64,
    /// Time of the newest event.
    now: Option<Stamp>,
    last_imu: Option<Stamp>,
    last_frame: Option<Stamp>,
    /// Frames and samples left out since they were no later than the one before.
    pub out_of_order: u64,
}

impl EventBuffer {
    pub fn new(has_imu: bool, truth: &TruthConfig) -> Self {
        Self {
            has_imu,
            ended: false,
            imu: VecDeque::new(),
            frames: VecDeque::new(),
            truth: TruthTrack::default(),
            truth_offset: truth.time_offset,
            frames_in: 0,
            now: None,
            last_imu: None,
            last_frame: None,
            out_of_order: 0,
        }
    }

    pub fn has_imu(&self) -> bool {
        self.has_imu
    }

    pub fn has_ended(&self) -> bool {
        self.ended
    }

    /// No more data will come.
    pub fn end(&mut self) {
        self.ended = true;
    }

    /// What comes now is by other clocks; what waited is dropped.
    pub fn begin_anew(&mut self) {
        self.imu.clear();
        self.frames.clear();
        self.truth = TruthTrack::default();
        (self.now, self.last_imu, self.last_frame) = (None, None, None);
        self.ended = false;
    }

    pub fn now(&self) -> Option<Stamp> {
        self.now
    }

    pub fn truth(&self) -> &TruthTrack {
        &self.truth
    }

    /// Keeps a sample; false if it is no later than the one before, or not possible.
    pub fn push_imu(&mut self, sample: ImuSample) -> bool {
        self.advance(sample.stamp);
        let keeps = follows(&mut self.last_imu, sample.stamp) && sample.is_possible();
        if keeps {
            self.imu.push_back(sample);
        }
        self.out_of_order += u64::from(!keeps);
        keeps
    }

    pub fn push_truth(&mut self, pose: TruthPose) {
        let stamp = pose.stamp.offset_by(self.truth_offset);
        self.advance(stamp);
        self.truth.push(TruthPose { stamp, ..pose });
    }

    /// Keeps a frame, whose stamp is `camera_offset` (s) behind the IMU's clock; false if it is no
    /// later than the one before.
    pub fn push_frame(&mut self, frame: FrontEndFrame, camera_offset: f64) -> bool {
        self.advance(frame.frame.stamp.offset_by(camera_offset));
        let keeps = follows(&mut self.last_frame, frame.frame.stamp);
        if keeps {
            self.frames.push_back((self.frames_in, frame));
        }
        self.out_of_order += u64::from(!keeps);
        self.frames_in += 1;
        keeps
    }

    fn advance(&mut self, stamp: Stamp) {
        self.now = Some(self.now.map_or(stamp, |now| now.max(stamp)));
    }

    /// Stamp of the oldest frame that waits.
    pub fn first_frame(&self) -> Option<Stamp> {
        self.frames.front().map(|(_, front)| front.frame.stamp)
    }

    pub fn pop_frame(&mut self) -> Option<(u64, FrontEndFrame)> {
        self.frames.pop_front()
    }

    /// Whether everything up to `time` is there, or has been waited for long enough.
    pub fn is_complete_until(&self, time: Stamp) -> bool {
        let imu = !self.has_imu || self.imu.back().is_some_and(|sample| sample.stamp >= time);
        // The reference is compared with the estimate at every frame.
        let reference = self.truth.newest().is_none_or(|newest| newest >= time);
        let late = self.now.is_some_and(|now| now.seconds_since(time) > PATIENCE);
        self.ended || late || imu && reference
    }
}

/// Whether a stamp is later than the last one of its stream, which it then takes the place of.
fn follows(last: &mut Option<Stamp>, stamp: Stamp) -> bool {
    let follows = last.is_none_or(|last| stamp > last);
    if follows {
        *last = Some(stamp);
    }
    follows
}
