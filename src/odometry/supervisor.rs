//! What can go wrong with sensors and estimate, watched in one place: evidence in, trust and
//! reactions out.

use nalgebra::{Isometry3, Vector3};

use super::clock::ClockWatch;
use super::gyroscope::GyroscopeWatch;
use super::health::{Divergence, Health, HealthConfig, HealthSummary, Sight};
use super::recognition::{Jump, confirms};
use super::report::{Note, NoteLevel};
use super::watch::{Agreement, SensorWatch};
use super::window::ImuWindow;
use crate::filter::PointUpdate;
use crate::inertial::{Belief, ImuConfig};
use crate::sensor::{ImuSample, Stamp};
use crate::tracking::{InView, Tracks};
use crate::vision::Feature;

/// Watches the sensors and the estimate.
pub(super) struct Supervisor {
    sensors: SensorWatch,
    clock: ClockWatch,
    gyroscope: GyroscopeWatch,
    health: Health,
    /// The last belief that nothing spoke against, and its time.
    sound: Option<(Stamp, Belief)>,
    /// Of the next frame.
    notes: Vec<Note>,
}

/// What a frame showed and what was made of it.
pub(super) struct FrameEvidence<'a> {
    pub stamp: Stamp,
    /// Whether matches were to be expected, and whether there was enough to see for them.
    pub expected: bool,
    pub visible: bool,
    pub features: usize,
    pub tracks: &'a Tracks,
    pub update: Option<&'a PointUpdate>,
}

/// Whether the pose that a frame's matches agree on is to be believed.
pub(super) enum PoseVerdict {
    Consistent,
    /// Far from where the body can be, and what should be in view there is not.
    Unconfirmed,
    /// Far from where the body can be: it was carried off.
    Kidnapped(Jump, InView),
}

impl Supervisor {
    pub fn new(imu: &ImuConfig, health: &HealthConfig) -> Self {
        Self {
            sensors: SensorWatch::new(imu),
            clock: ClockWatch::default(),
            gyroscope: GyroscopeWatch::default(),
            health: Health::new(health),
            sound: None,
            notes: Vec::new(),
        }
    }

    /// What comes now is by other clocks: nothing that was usual counts any more.
    pub fn begin_anew(&mut self, imu: &ImuConfig) {
        self.sensors = SensorWatch::new(imu);
        self.clock = ClockWatch::default();
        self.gyroscope = GyroscopeWatch::default();
        self.sound = None;
        self.health.new_run();
    }

    pub fn note(&mut self, note: Note) {
        self.notes.push(note);
    }

    pub fn warn(&mut self, text: String) {
        self.notes.push(Note { level: NoteLevel::Warning, text });
    }

    /// The notes of a frame.
    pub fn take_notes(&mut self) -> Vec<Note> {
        std::mem::take(&mut self.notes)
    }

    pub fn observe_imu(&mut self, sample: &ImuSample) {
        self.notes.extend(self.sensors.imu(sample));
        self.clock.imu(*sample);
    }

    /// Of a frame's time by the IMU's clock.
    pub fn observe_frame_time(&mut self, time: Stamp) {
        self.clock.frame(time);
    }

    pub fn observe_features(&mut self, stamp: Stamp, features: &[Feature], size: (usize, usize)) {
        self.notes.extend(self.sensors.frame(stamp, features, size));
    }

    /// What the clocks are found to differ by beyond what is configured, s.
    pub fn clock_offset(&self) -> f64 {
        self.clock.offset()
    }

    /// Standard deviation of the stamps, s.
    pub fn stamp_jitter(&self) -> f64 {
        self.clock.jitter()
    }

    pub fn is_lost(&self) -> bool {
        self.health.is_lost()
    }

    /// The window as it is to be trusted: readings of a gyroscope that is wrong replaced, doubtful
    /// ones taken for no more than those that bridge a gap. Gaps are noted.
    pub fn trusted(&mut self, window: &ImuWindow, gyro_bias: &Vector3<f64>) -> ImuWindow {
        for gap in &window.gaps {
            let text =
                format!("IMU gap of {:.3} s after {} s: bridged by vision", gap.length, gap.after);
            self.warn(text);
        }
        let doubtful = self.sensors.is_noisy(window.end) || self.clock.is_in_doubt();
        let mut trusted = window.clone();
        let mut before = None;
        for interval in &mut trusted.intervals {
            interval.from = before.unwrap_or(interval.from);
            interval.is_bridged |= doubtful || self.gyroscope.is_wrong();
            let seconds = interval.to.stamp.seconds_since(interval.from.stamp);
            interval.to = self.gyroscope.reading(interval.to, seconds, gyro_bias);
            before = Some(interval.to);
        }
        trusted
    }

    /// Judges the pose on which matches agree: one further from the last sound belief than a body
    /// moves, or found when vision was lost in plain sight, must show what should be in view there.
    pub fn judge_pose(
        &self,
        stamp: Stamp,
        world_from_body: &Isometry3<f64>,
        in_view: impl FnOnce() -> Option<InView>,
    ) -> PoseVerdict {
        let Some((before, sound)) = &self.sound else { return PoseVerdict::Consistent };
        let in_sight = self.health.is_lost_in_sight();
        let in_the_dark = self.is_lost() && !in_sight;
        let after = stamp.seconds_since(*before);
        let jump = Jump::between(&sound.state, world_from_body, after, in_the_dark);
        if !in_sight && jump.is_none() {
            return PoseVerdict::Consistent;
        }
        match (in_view(), jump) {
            (Some(seen), Some(jump)) if confirms(&seen) => PoseVerdict::Kidnapped(jump, seen),
            (Some(seen), None) if confirms(&seen) => PoseVerdict::Consistent,
            (seen, _) => {
                tracing::debug!("at {stamp} s {seen:?} do not confirm a pose");
                PoseVerdict::Unconfirmed
            }
        }
    }

    /// Compares the turns that images and gyroscope see. Gives how much the clocks turn out to
    /// differ, where that has changed.
    pub fn observe_attitude(
        &mut self,
        stamp: Stamp,
        world_from_body: Option<&Isometry3<f64>>,
        gyro_bias: &Vector3<f64>,
    ) -> Option<f64> {
        let attitude = world_from_body.map(|pose| pose.rotation);
        if let Some(attitude) = attitude {
            self.notes.extend(self.gyroscope.attitude(stamp, attitude));
        }
        let (offset, note) = self.clock.attitude(stamp, attitude, gyro_bias)?;
        self.notes.push(note);
        Some(offset)
    }

    /// Judges sight, agreement and biases after an update. True if the levelling is to be doubted.
    pub fn observe_update(&mut self, evidence: &FrameEvidence, belief: &Belief) -> bool {
        let FrameEvidence { stamp, tracks, update, .. } = *evidence;
        let agreement = Agreement {
            matches: tracks.matches.len(),
            inliers: tracks.inliers.len(),
            others: tracks.second_motion,
            contradicted: update.is_some_and(PointUpdate::contradicts),
        };
        self.notes.extend(self.sensors.agreement(stamp, agreement));
        self.notes.extend(self.sensors.gyro_bias(stamp, &belief.state));
        self.notes.extend(self.sensors.accel_bias(stamp, &belief.state));
        self.sensors.accel_bias_lasts(stamp) && !self.sensors.is_noisy(stamp)
    }

    /// Takes note of whether a frame corrected the belief.
    pub fn observe_sight(&mut self, evidence: &FrameEvidence) {
        let sight = Sight {
            expected: evidence.expected,
            visible: evidence.visible,
            features: evidence.features,
            matches: evidence.tracks.matches.len(),
            inliers: evidence.tracks.inliers.len(),
            updated: evidence.update.is_some(),
        };
        self.notes.extend(self.health.see(evidence.stamp, sight));
    }

    /// Judges the belief after all that a frame told of it.
    pub fn judge_belief(&mut self, stamp: Stamp, belief: &Belief, nis: Option<f64>) {
        self.notes.extend(self.health.judge(stamp, belief, nis));
        if self.health.is_sound(nis) {
            self.sound = Some((stamp, *belief));
        }
    }

    /// Takes note of the map being given up.
    pub fn observe_map_loss(&mut self, stamp: Stamp) {
        let note = self.health.map_given_up(stamp);
        self.notes.push(note);
    }

    /// Moves the memory of the last sound belief to another clock; gives the samples by it.
    pub fn retime(&mut self, offset: f64) -> impl Iterator<Item = ImuSample> {
        self.sound = self.sound.map(|(time, belief)| (time.offset_by(offset), belief));
        self.clock.samples().copied()
    }

    pub fn last_sound(&self) -> Option<&(Stamp, Belief)> {
        self.sound.as_ref()
    }

    /// Whether no further frame is wanted.
    pub fn stops(&self) -> bool {
        self.health.stops()
    }

    /// In what way the estimate has diverged, if it is to be started anew for that.
    pub fn restarts(&self) -> Option<Divergence> {
        self.health.restarts()
    }

    pub fn restarted(&mut self, belief: &Belief) {
        self.health.restarted(belief);
    }

    pub fn rested(&mut self, seconds: f64) {
        self.health.rested(seconds);
    }

    pub fn health(&self) -> &HealthSummary {
        self.health.summary()
    }
}
