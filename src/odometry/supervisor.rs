//! What can go wrong with sensors and estimate, watched in one place: evidence in, trust and
//! reactions out.

use nalgebra::{Isometry3, UnitQuaternion, Vector3};

use super::health::{Health, HealthConfig, HealthSummary, Sight};
use super::recognition::confirms;
use super::report::Note;
use super::window::ImuWindow;
use crate::fault::{Divergence, Episode, FaultConfig, Monitors, PoseStep, Region, Trust};
use crate::filter::{PointUpdate, TrackUpdate};
use crate::inertial::{Belief, ImuConfig};
use crate::sensor::{ImuSample, Stamp, Stream};
use crate::tracking::{InView, Tracks};

/// Watches the sensors and the estimate.
pub(super) struct Supervisor {
    monitors: Monitors,
    has_imu: bool,
    max_rate: f64,
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
    pub followed: &'a Followed,
}

/// What points told of a frame that were followed through past poses.
#[derive(Debug, Clone, Default)]
pub(super) struct Followed {
    /// `None` if nothing of them was due.
    pub update: Option<TrackUpdate>,
    /// Whether enough of them tie the frame to such a pose.
    pub ties: bool,
}

impl FrameEvidence<'_> {
    /// Whether what was seen contradicts the prediction.
    pub fn contradicts(&self) -> bool {
        self.update.is_some_and(PointUpdate::contradicts)
            || self.followed.update.as_ref().is_some_and(|update| update.contradicted)
    }

    /// The normalised innovation squared of what was seen: of the map, if that was.
    pub fn nis(&self) -> Option<f64> {
        let followed = self.followed.update.as_ref().filter(|update| update.rows > 0);
        self.update.map(|update| update.nis).or(followed.map(|update| update.nis))
    }
}

/// Whether the pose that a frame's matches agree on is to be believed.
pub(super) enum PoseVerdict {
    Consistent,
    /// Far from where the body can be, and what should be in view there is not.
    Unconfirmed,
    /// Far from where the body can be: it was carried off.
    Kidnapped,
}

impl Supervisor {
    pub fn new(
        faults: &FaultConfig,
        imu: &ImuConfig,
        health: &HealthConfig,
        has_imu: bool,
    ) -> Self {
        Self {
            monitors: Monitors::new(faults, imu),
            has_imu,
            max_rate: faults.max_rate,
            health: Health::new(health),
            sound: None,
            notes: Vec::new(),
        }
    }

    /// What comes now is by other clocks: nothing that was usual counts any more.
    pub fn begin_anew(&mut self) {
        self.monitors.begin_anew();
        self.sound = None;
        self.health.new_run();
    }

    pub fn note(&mut self, note: Note) {
        self.notes.push(note);
    }

    pub fn warn(&mut self, text: String) {
        self.notes.push(Note::warning(text));
    }

    /// The notes of a frame.
    pub fn take_notes(&mut self) -> Vec<Note> {
        std::mem::take(&mut self.notes)
    }

    pub fn observe_imu(&mut self, sample: &ImuSample) {
        self.monitors.imu(sample);
    }

    pub fn observe_repeated(&mut self, stream: Stream, stamp: Stamp) {
        self.monitors.repeated(stream, stamp);
    }

    /// Of a frame, timed by the IMU's clock, and the number of its features.
    pub fn observe_frame(&mut self, time: Stamp, features: usize) {
        self.monitors.frame(time, features);
    }

    /// What the clocks are found to differ by beyond what is configured, s.
    pub fn clock_offset(&self) -> f64 {
        self.monitors.clock_offset()
    }

    /// Standard deviation of the stamps, s.
    pub fn stamp_jitter(&self) -> f64 {
        self.monitors.stamp_jitter()
    }

    /// Faults so far.
    pub fn episodes(&self) -> Vec<Episode> {
        self.monitors.episodes()
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
            self.note(Note::info(text));
        }
        let Trust { distrust_imu, replace_gyro, .. } = self.monitors.trust(window.end);
        let seen_rate = self.monitors.seen_rate() + gyro_bias;
        let mut trusted = window.clone();
        let mut before = None;
        for interval in &mut trusted.intervals {
            interval.from = before.unwrap_or(interval.from);
            interval.is_bridged |= distrust_imu || replace_gyro;
            if replace_gyro || interval.to.angular_velocity.norm() > self.max_rate {
                interval.to.angular_velocity = seen_rate;
            }
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
        let step = PoseStep {
            before: sound.state.world_from_body,
            velocity: sound.state.velocity,
            before_at: *before,
            after: *world_from_body,
            unseen: in_the_dark,
        };
        let reachable = self.monitors.is_reachable(&step, stamp);
        if !in_sight && reachable {
            return PoseVerdict::Consistent;
        }
        match in_view() {
            Some(seen) if confirms(&seen) && reachable => PoseVerdict::Consistent,
            Some(seen) if confirms(&seen) => PoseVerdict::Kidnapped,
            seen => {
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
        self.monitors.attitude(stamp, attitude, gyro_bias)
    }

    /// The body was carried off.
    pub fn observe_kidnapping(&mut self, stamp: Stamp) {
        self.monitors.carried_off(stamp);
    }

    /// What became of the points that were seen just before, by parts of the image.
    pub fn observe_regions(&mut self, stamp: Stamp, regions: Vec<Region>) {
        self.monitors.regions(stamp, regions);
    }

    /// The world was turned, and the map with it.
    pub fn observe_world_turn(&mut self, turn: Option<UnitQuaternion<f64>>) {
        turn.iter().for_each(|turn| self.monitors.turn_world(turn));
    }

    /// Judges sight, agreement and biases after an update. True if the levelling is to be doubted.
    pub fn observe_update(&mut self, evidence: &FrameEvidence, belief: &Belief) -> bool {
        let FrameEvidence { stamp, tracks, .. } = *evidence;
        let (matches, inliers) = (tracks.matches.len(), tracks.inliers.len());
        self.monitors.tracks(stamp, matches, inliers, tracks.second_motion);
        if evidence.contradicts() {
            self.monitors.contradicted(stamp);
        }
        // Without an IMU the biases carry the motion of the constant-velocity model.
        if !self.has_imu {
            return false;
        }
        self.monitors.biases(stamp, &belief.state);
        self.monitors.accel_bias_lasts(stamp) && !self.monitors.trust(stamp).distrust_imu
    }

    /// Takes note of whether a frame corrected the belief.
    pub fn observe_sight(&mut self, evidence: &FrameEvidence) {
        let sight = Sight {
            expected: evidence.expected,
            visible: evidence.visible,
            features: evidence.features,
            matches: evidence.tracks.matches.len(),
            inliers: evidence.tracks.inliers.len(),
            updated: evidence.update.is_some() || evidence.followed.ties,
        };
        self.notes.extend(self.health.see(evidence.stamp, sight));
    }

    /// Judges the belief after all that a frame told of it.
    pub fn judge_belief(&mut self, stamp: Stamp, belief: &Belief, nis: Option<f64>) {
        let judged = self.health.judge(stamp, belief, nis);
        if let Some(divergence) = self.health.divergence().filter(|_| judged.is_some()) {
            self.monitors.diverged(stamp, divergence);
        }
        self.notes.extend(judged);
        if self.health.is_sound(nis) {
            self.sound = Some((stamp, *belief));
        }
    }

    /// Takes note of the map being given up.
    pub fn observe_map_loss(&mut self, stamp: Stamp) {
        let note = self.health.map_given_up(stamp);
        self.notes.push(note);
        if self.health.divergence() == Some(Divergence::View) {
            self.monitors.diverged(stamp, Divergence::View);
        }
    }

    /// Names the fault that explains all that a frame told, if there is a new one.
    pub fn name_fault(&mut self, stamp: Stamp) {
        let decision = self.monitors.decide(stamp);
        self.notes.extend(decision.map(|decision| Note::of(&decision, stamp)));
    }

    /// Moves the memory of the last sound belief to another clock; gives the samples by it.
    pub fn retime(&mut self, offset: f64) -> impl Iterator<Item = ImuSample> {
        self.sound = self.sound.map(|(time, belief)| (time.offset_by(offset), belief));
        self.monitors.samples().copied()
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
        self.monitors.restarted();
    }

    pub fn rested(&mut self, seconds: f64) {
        self.health.rested(seconds);
    }

    pub fn health(&self) -> &HealthSummary {
        self.health.summary()
    }
}
