//! Knowing when the estimate is wrong.

use serde::{Deserialize, Serialize};

use super::{Note, NoteLevel};
use crate::inertial::{Belief, Stamp, block};

/// What is done about an estimate that has diverged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DivergencePolicy {
    /// Say so and go on.
    Continue,
    /// Say so and process no further frame.
    Stop,
}

/// When an estimate is taken to have diverged.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct HealthConfig {
    /// Faster than this the body does not move, m/s.
    pub max_speed: f64,
    /// A frame whose normalised innovation (1 when consistent) is above this is a bad one.
    pub max_innovation: f64,
    /// So many bad frames in a row are a divergence.
    pub max_bad_frames: u32,
    /// Largest standard deviation of the position that the estimate is good for, m.
    pub max_position_sd: f64,
    /// What is done then: continue or stop.
    pub on_divergence: DivergencePolicy,
}

impl Default for HealthConfig {
    fn default() -> Self {
        Self {
            max_speed: 15.0,
            max_innovation: 25.0,
            max_bad_frames: 15,
            max_position_sd: 5.0,
            on_divergence: DivergencePolicy::Continue,
        }
    }
}

/// What a run looks back on.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct HealthSummary {
    /// Time without vision, s, and the longest such interval.
    pub seconds_without_vision: f64,
    pub longest_without_vision: f64,
    /// Why the estimate was taken to have diverged, each time.
    pub divergences: Vec<String>,
}

/// Watches an estimate from frame to frame.
#[derive(Debug, Clone)]
pub(super) struct Health {
    config: HealthConfig,
    bad_frames: u32,
    lost_since: Option<Stamp>,
    diverged: bool,
    summary: HealthSummary,
}

impl Health {
    pub fn new(config: &HealthConfig) -> Self {
        Self {
            config: config.clone(),
            bad_frames: 0,
            lost_since: None,
            diverged: false,
            summary: HealthSummary::default(),
        }
    }

    pub fn is_lost(&self) -> bool {
        self.lost_since.is_some()
    }

    pub fn summary(&self) -> &HealthSummary {
        &self.summary
    }

    /// Whether no further frame is wanted.
    pub fn stops(&self) -> bool {
        self.diverged && self.config.on_divergence == DivergencePolicy::Stop
    }

    /// Takes note of whether a frame at which matches were `expected` corrected the belief.
    pub fn see(&mut self, stamp: Stamp, updated: bool, expected: bool) -> Option<Note> {
        match (updated, self.lost_since) {
            (false, None) if expected => {
                self.lost_since = Some(stamp);
                let text = format!("vision lost at {stamp} s: too few matches agree");
                Some(Note { level: NoteLevel::Warning, text })
            }
            (true, Some(since)) => {
                self.lost_since = None;
                let gap = stamp.seconds_since(since);
                self.summary.seconds_without_vision += gap;
                self.summary.longest_without_vision = self.summary.longest_without_vision.max(gap);
                let text = format!("vision back at {stamp} s, after {gap:.2} s without");
                Some(Note { level: NoteLevel::Info, text })
            }
            _ => None,
        }
    }

    /// Judges the belief after a frame; `innovation` is the normalised one, if there was any.
    /// Speaks once when the estimate diverges and once when it is sound again.
    pub fn judge(
        &mut self,
        stamp: Stamp,
        belief: &Belief,
        innovation: Option<f64>,
    ) -> Option<Note> {
        match innovation {
            Some(value) if value > self.config.max_innovation => self.bad_frames += 1,
            Some(_) => self.bad_frames = 0,
            None => {}
        }
        let reason = self.reason(belief);
        match (reason, self.diverged) {
            (Some(reason), false) => {
                self.diverged = true;
                let text = format!("diverged at {stamp} s: {reason}");
                self.summary.divergences.push(text.clone());
                Some(Note { level: NoteLevel::Warning, text })
            }
            (None, true) if self.config.on_divergence == DivergencePolicy::Continue => {
                self.diverged = false;
                let text = format!("sound again at {stamp} s");
                Some(Note { level: NoteLevel::Info, text })
            }
            _ => None,
        }
    }

    fn reason(&self, belief: &Belief) -> Option<String> {
        let config = &self.config;
        let speed = belief.state.velocity.norm();
        let position =
            belief.covariance.fixed_view::<3, 3>(block::POSITION, block::POSITION).into_owned();
        let sd = position.symmetric_eigenvalues().max().max(0.0).sqrt();
        if speed > config.max_speed {
            Some(format!("speed of {speed:.1} m/s (limit {:.1})", config.max_speed))
        } else if self.bad_frames >= config.max_bad_frames {
            let (frames, limit) = (self.bad_frames, config.max_innovation);
            Some(format!("normalised innovation above {limit:.1} in {frames} frames in a row"))
        } else if sd > config.max_position_sd {
            let limit = config.max_position_sd;
            Some(format!("standard deviation of the position {sd:.2} m (limit {limit:.2})"))
        } else {
            None
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::inertial::{NavCovariance, NavState};
    use nalgebra::{Isometry3, Vector3};

    fn belief(speed: f64, sd: f64) -> Belief {
        Belief {
            state: NavState {
                world_from_body: Isometry3::identity(),
                velocity: Vector3::x() * speed,
                gyro_bias: Vector3::zeros(),
                accel_bias: Vector3::zeros(),
            },
            covariance: NavCovariance::identity() * sd * sd,
        }
    }

    fn at(tenths: i64) -> Stamp {
        Stamp::from_nanos(tenths * 100_000_000)
    }

    #[test]
    fn loss_of_vision_is_told_once_and_timed() {
        let mut health = Health::new(&HealthConfig::default());
        assert_eq!(health.see(at(0), false, false), None);
        assert!(!health.is_lost());
        let lost = health.see(at(1), false, true).unwrap();
        assert!(lost.text.contains("0.100000000 s") && health.is_lost());
        assert_eq!(health.see(at(2), false, true), None);
        assert!(health.see(at(6), true, true).unwrap().text.contains("after 0.50 s"));
        assert!((health.summary().seconds_without_vision - 0.5).abs() < 1e-9);
        assert!(!health.is_lost());
    }

    #[test]
    fn each_divergence_is_named_and_ends() {
        let config = HealthConfig { max_bad_frames: 3, ..HealthConfig::default() };
        let mut health = Health::new(&config);
        assert_eq!(health.judge(at(0), &belief(1.0, 0.1), Some(1.0)), None);
        assert!(health.judge(at(1), &belief(40.0, 0.1), None).unwrap().text.contains("speed"));
        assert_eq!(health.judge(at(2), &belief(40.0, 0.1), None), None);
        assert!(health.judge(at(3), &belief(1.0, 0.1), None).unwrap().text.contains("sound again"));
        assert!(health.judge(at(4), &belief(1.0, 9.0), None).unwrap().text.contains("9.00 m"));
        assert!(health.judge(at(5), &belief(1.0, 0.1), Some(1.0)).is_some());
        for tenths in 6..8 {
            assert_eq!(health.judge(at(tenths), &belief(1.0, 0.1), Some(99.0)), None);
        }
        let bad = health.judge(at(8), &belief(1.0, 0.1), Some(99.0)).unwrap();
        assert!(bad.text.contains("3 frames in a row"), "{}", bad.text);
        assert_eq!(health.summary().divergences.len(), 3);
        assert!(!health.stops());
    }

    #[test]
    fn a_stop_is_for_good() {
        let on_divergence = DivergencePolicy::Stop;
        let mut health = Health::new(&HealthConfig { on_divergence, ..HealthConfig::default() });
        assert!(health.judge(at(0), &belief(99.0, 0.1), None).is_some());
        assert_eq!(health.judge(at(1), &belief(0.0, 0.1), None), None);
        assert!(health.stops());
    }
}
