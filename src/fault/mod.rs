//! What can go wrong with sensors and estimate: detection, isolation, reaction.
//!
//! - **Detection.** Each [`Monitor`] weighs one kind of evidence by a sequential likelihood-ratio test
//!   ([`sequential`]). Its threshold follows from the false alarms allowed an hour, not from logs.
//! - **Isolation.** One cause sets off several monitors: [`isolate`] names the one that explains the
//!   others, and waits while such a cause is suspected but not confirmed.
//! - **Reaction.** [`policy`] is one table from fault to reaction.
//!
//! Monitors are plain values: they know neither pipeline nor files, and the same evidence gives the
//! same verdicts. Each takes constant time and memory an observation.

mod attitude;
mod bank;
mod biases;
mod causes;
mod clock;
mod episode;
mod force;
mod isolation;
mod kinematics;
mod noise;
mod scene;
pub mod sequential;
mod stamps;
#[cfg(test)]
mod tests;
mod turn;
mod view;

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::sensor::Stamp;
pub use crate::sensor::Stream;

pub use attitude::{AttitudeTrack, GyroscopeTrack};
pub use bank::{Monitors, Trust};
pub use biases::{BiasEvidence, Biases};
pub use clock::{ClockJumps, Sighting};
pub use episode::{Decision, Episode, FaultRecord};
pub use force::{ForceEvidence, Units};
pub use isolation::{explains, isolate, policy};
pub use kinematics::{Envelope, PoseStep};
pub use noise::{NoiseBurst, Reading};
pub use scene::{SceneMotion, TrackEvidence};
pub use stamps::{Interval, Intervals, Jittering, Losses, Repeats, Silence};
pub use turn::{Turn, TurnContradiction};
pub use view::{Darkening, Obstruction, Region, ViewEvidence};

/// In what way an estimate has diverged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Divergence {
    /// Faster than the body can move.
    Speed,
    /// Belief and map contradict each other.
    Innovation,
    /// The position is known too little to be of use.
    Position,
    /// All of a sudden nothing of the map was in view, though there was enough to see.
    View,
}

/// What has gone wrong.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Fault {
    /// The IMU is silent for longer than `imu.max_gap`.
    ImuGap,
    /// White noise of the IMU far above its usual and its configured level.
    ImuNoise,
    /// The gyroscope reads a multiple of the turns that images show.
    GyroScale,
    /// The accelerometer reads a multiple of gravity, or what no body on earth feels.
    AccelUnit,
    /// Stamps of one stream have moved against those of the other.
    ClockJump {
        /// To be added to the stamps of frames, s.
        offset: f64,
    },
    /// Stamps scatter about the times at which messages were taken.
    Jitter {
        /// Standard deviation of an interval, s.
        sd: f64,
    },
    /// Too few features to see by.
    Darkness,
    /// A bias that is none of this sensor, or that has changed at once.
    BiasStep,
    /// Messages are missing.
    Dropped,
    /// Messages come more than once.
    Repeated,
    /// Part of the view is covered.
    Occlusion,
    /// Much of the view moves by itself.
    DynamicScene,
    /// The body is suddenly elsewhere.
    Kidnapped,
    /// The camera is silent.
    Stalled,
    /// The estimate is of no use.
    Divergence {
        #[serde(rename = "by")]
        by: Divergence,
    },
}

impl Fault {
    /// As in files and tables.
    pub fn name(&self) -> &'static str {
        match self {
            Self::ImuGap => "imu-gap",
            Self::ImuNoise => "imu-noise",
            Self::GyroScale => "gyro-scale",
            Self::AccelUnit => "accel-unit",
            Self::ClockJump { .. } => "clock-jump",
            Self::Jitter { .. } => "jitter",
            Self::Darkness => "darkness",
            Self::BiasStep => "bias-step",
            Self::Dropped => "dropped",
            Self::Repeated => "repeated",
            Self::Occlusion => "occlusion",
            Self::DynamicScene => "dynamic-scene",
            Self::Kidnapped => "kidnapped",
            Self::Stalled => "stalled",
            Self::Divergence { .. } => "divergence",
        }
    }

    /// Whether both are of one kind, whatever their parameters.
    pub fn is_kind_of(&self, other: &Self) -> bool {
        std::mem::discriminant(self) == std::mem::discriminant(other)
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::ClockJump { offset } => write!(f, "clock jump of {:.1} ms", 1e3 * offset),
            Self::Jitter { sd } => write!(f, "stamp jitter of {:.1} ms", 1e3 * sd),
            Self::Divergence { by } => write!(f, "divergence ({by:?})"),
            other => f.write_str(other.name()),
        }
    }
}

/// What is done about a fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Reaction {
    /// IMU samples are trusted no more than what bridges a gap.
    InflateImu,
    /// The turn that images show takes the place of the gyroscope's readings.
    ReplaceGyro,
    /// Frames are timed anew.
    Retime,
    /// What the accelerometer said of the vertical is doubted.
    ReopenGravity,
    /// The map is looked for everywhere.
    Relocalise,
    /// The estimate starts anew.
    Restart,
    /// Gating and prediction see to it.
    Tolerate,
}

impl fmt::Display for Reaction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::InflateImu => "the IMU is trusted less",
            Self::ReplaceGyro => "the turns that images show take its place",
            Self::Retime => "stamps are corrected or trusted less",
            Self::ReopenGravity => "the vertical is sought anew",
            Self::Relocalise => "the map is looked for everywhere",
            Self::Restart => "the estimate is started anew if so configured",
            Self::Tolerate => "what is left is used",
        })
    }
}

/// What a monitor found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Finding {
    pub fault: Fault,
    /// Estimated time of the change.
    pub since: Stamp,
    /// Test statistic as a multiple of its threshold.
    pub statistic: f64,
}

/// What a monitor makes of the evidence so far.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub enum Verdict {
    #[default]
    Nominal,
    /// The evidence speaks for a fault, not yet enough.
    Suspected(Finding),
    Confirmed(Finding),
}

impl Verdict {
    /// By a statistic that is a multiple of its threshold.
    fn by(statistic: f64, fault: Fault, since: Stamp) -> Self {
        let finding = Finding { fault, since, statistic };
        if statistic >= 1.0 {
            Self::Confirmed(finding)
        } else if statistic > SUSPICIOUS {
            Self::Suspected(finding)
        } else {
            Self::Nominal
        }
    }

    /// What was found, confirmed or not.
    pub fn finding(&self) -> Option<&Finding> {
        match self {
            Self::Nominal => None,
            Self::Suspected(finding) | Self::Confirmed(finding) => Some(finding),
        }
    }

    pub fn confirmed(&self) -> Option<&Finding> {
        match self {
            Self::Confirmed(finding) => Some(finding),
            _ => None,
        }
    }
}

/// Share of its threshold from which on a statistic makes a suspicion: such a value is reached by
/// chance often, but not for long.
const SUSPICIOUS: f64 = 0.3;

/// Weighs one kind of evidence in order of time.
pub trait Monitor {
    type Evidence;

    fn observe(&mut self, at: Stamp, evidence: &Self::Evidence) -> Verdict;
}

/// How much is risked to find faults: section `[faults]` of the configuration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FaultConfig {
    /// False alarms allowed each monitor, an hour, while its model of the sound sensor holds.
    pub false_alarms_per_hour: f64,
    /// Probability of deciding wrongly between two faults, or of missing one that is tested for once.
    pub miss_probability: f64,
    /// A confirmed fault that another, suspected one would explain waits so long for it, s.
    pub isolation_time: f64,
    /// A fault is over when nothing has spoken for it for this long, s.
    pub quiet_time: f64,
    /// Fewer features than this are too few to see by.
    pub min_features: usize,
    /// The camera counts as stalled after this time without a frame, s.
    pub stall_time: f64,
    /// What no hand and no vehicle exceeds, rad/s and m/s^2.
    pub max_rate: f64,
    pub max_force: f64,
}

impl Default for FaultConfig {
    fn default() -> Self {
        Self {
            false_alarms_per_hour: 0.01,
            miss_probability: 0.01,
            isolation_time: 0.5,
            quiet_time: 1.0,
            min_features: 30,
            stall_time: 1.0,
            max_rate: 20.0,
            max_force: 150.0,
        }
    }
}
