//! Knowing when the estimate is wrong.

use serde::{Deserialize, Serialize};

use super::report::Note;
use crate::fault::Divergence;
use crate::inertial::{Belief, block};
use crate::sensor::Stamp;

/// What is done about an estimate that has diverged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DivergencePolicy {
    /// Say so and go on.
    Continue,
    /// Say so and process no further frame.
    Stop,
    /// Say so and start anew from the IMU, where the estimate was last sound.
    Reinitialize,
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
    /// What is done then: continue, stop or reinitialize.
    pub on_divergence: DivergencePolicy,
}

impl Default for HealthConfig {
    fn default() -> Self {
        Self {
            max_speed: 15.0,
            max_innovation: 25.0,
            max_bad_frames: 15,
            max_position_sd: 5.0,
            on_divergence: DivergencePolicy::Reinitialize,
        }
    }
}

/// What a run looks back on.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct HealthSummary {
    /// Time without vision, s, and the longest such interval.
    pub seconds_without_vision: f64,
    pub longest_without_vision: f64,
    /// Time at rest, s.
    pub seconds_at_rest: f64,
    /// Why the estimate was taken to have diverged, each time.
    pub divergences: Vec<String>,
    /// How often the estimate was started anew.
    pub reinitializations: u64,
}

/// What a frame showed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Sight {
    /// Whether matches were to be expected.
    pub expected: bool,
    /// Whether there was enough to see.
    pub visible: bool,
    pub features: usize,
    pub matches: usize,
    pub inliers: usize,
    /// Whether they corrected the belief.
    pub updated: bool,
}

/// Watches an estimate from frame to frame.
#[derive(Debug, Clone)]
pub(super) struct Health {
    config: HealthConfig,
    bad_frames: u32,
    lost_since: Option<Stamp>,
    /// Whether there was enough to see when vision was lost.
    lost_in_sight: bool,
    diverged: Option<Divergence>,
    /// Standard deviation of the position at the start, above which it may grow by the limit, m.
    initial_position_sd: f64,
    summary: HealthSummary,
}

impl Health {
    pub fn new(config: &HealthConfig) -> Self {
        Self {
            config: config.clone(),
            bad_frames: 0,
            lost_since: None,
            lost_in_sight: false,
            diverged: None,
            initial_position_sd: 0.0,
            summary: HealthSummary::default(),
        }
    }

    pub fn is_lost(&self) -> bool {
        self.lost_since.is_some()
    }

    /// Whether vision was lost though there was enough to see.
    pub fn is_lost_in_sight(&self) -> bool {
        self.is_lost() && self.lost_in_sight
    }

    pub fn summary(&self) -> &HealthSummary {
        &self.summary
    }

    /// Whether no further frame is wanted.
    pub fn stops(&self) -> bool {
        self.diverged.is_some() && self.config.on_divergence == DivergencePolicy::Stop
    }

    /// In what way the estimate has diverged, if it has.
    pub fn divergence(&self) -> Option<Divergence> {
        self.diverged
    }

    /// In what way the estimate has diverged, if it is to be started anew for that.
    pub fn restarts(&self) -> Option<Divergence> {
        self.diverged.filter(|_| self.config.on_divergence == DivergencePolicy::Reinitialize)
    }

    /// Takes note of time at rest, s.
    pub fn rested(&mut self, seconds: f64) {
        self.summary.seconds_at_rest += seconds;
    }

    /// Takes note of a new start with this belief.
    pub fn restarted(&mut self, belief: &Belief) {
        self.diverged = None;
        self.bad_frames = 0;
        self.initial_position_sd = position_sd(belief);
        self.summary.reinitializations += 1;
    }

    /// What was wrong with the run before says nothing of the one that begins.
    pub fn new_run(&mut self) {
        (self.lost_since, self.lost_in_sight) = (None, false);
        (self.diverged, self.bad_frames) = (None, 0);
    }

    /// Takes note of whether a frame corrected the belief.
    pub fn see(&mut self, stamp: Stamp, sight: Sight) -> Option<Note> {
        match (sight.updated, self.lost_since) {
            (false, None) if sight.expected => {
                self.lost_since = Some(stamp);
                self.lost_in_sight = sight.visible;
                let Sight { features, matches, inliers, .. } = sight;
                let text = format!(
                    "vision lost at {stamp} s: {features} features, {matches} of them matched, \
                     {inliers} of those agree"
                );
                Some(Note::warning(text))
            }
            (true, Some(since)) => {
                self.lost_since = None;
                let gap = stamp.seconds_since(since);
                self.summary.seconds_without_vision += gap;
                self.summary.longest_without_vision = self.summary.longest_without_vision.max(gap);
                let text = format!("vision back at {stamp} s, after {gap:.2} s without");
                Some(Note::info(text))
            }
            _ => None,
        }
    }

    /// Takes note of the map being given up. After darkness the body is elsewhere, as the belief
    /// knows; but if vision was lost in plain sight, the belief is wrong.
    pub fn map_given_up(&mut self, stamp: Stamp) -> Note {
        let mut text = format!("map not found again at {stamp} s: new points take its place");
        if self.lost_in_sight && self.diverged.is_none() {
            self.diverged = Some(Divergence::View);
            text = format!("diverged at {stamp} s: {text}, though there was enough to see");
            self.summary.divergences.push(text.clone());
        }
        Note::warning(text)
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
        match (self.reason(belief), self.diverged) {
            (Some((divergence, reason)), None) => {
                self.diverged = Some(divergence);
                let text = format!("diverged at {stamp} s: {reason}");
                self.summary.divergences.push(text.clone());
                Some(Note::warning(text))
            }
            (None, Some(_)) if self.config.on_divergence == DivergencePolicy::Continue => {
                self.diverged = None;
                let text = format!("sound again at {stamp} s");
                Some(Note::info(text))
            }
            _ => None,
        }
    }

    /// Whether nothing speaks against the estimate after a frame of this innovation.
    pub fn is_sound(&self, innovation: Option<f64>) -> bool {
        self.diverged.is_none() && innovation.is_some_and(|i| i <= self.config.max_innovation)
    }

    fn reason(&self, belief: &Belief) -> Option<(Divergence, String)> {
        let config = &self.config;
        let speed = belief.state.velocity.norm();
        let sd = position_sd(belief) - self.initial_position_sd;
        if speed > config.max_speed {
            let limit = config.max_speed;
            Some((Divergence::Speed, format!("speed of {speed:.1} m/s (limit {limit:.1})")))
        } else if self.bad_frames >= config.max_bad_frames {
            let (frames, limit) = (self.bad_frames, config.max_innovation);
            let reason =
                format!("normalised innovation above {limit:.1} in {frames} frames in a row");
            Some((Divergence::Innovation, reason))
        } else if sd > config.max_position_sd {
            let limit = config.max_position_sd;
            let reason = format!("standard deviation of the position {sd:.2} m (limit {limit:.2})");
            Some((Divergence::Position, reason))
        } else {
            None
        }
    }
}

/// Largest standard deviation of the position in any direction, m.
fn position_sd(belief: &Belief) -> f64 {
    let position = belief.covariance.fixed_view::<3, 3>(block::POSITION, block::POSITION);
    position.into_owned().symmetric_eigenvalues().max().max(0.0).sqrt()
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
        let sight = |updated, expected| Sight {
            expected,
            visible: true,
            features: 40,
            matches: 12,
            inliers: if updated { 10 } else { 3 },
            updated,
        };
        assert_eq!(health.see(at(0), sight(false, false)), None);
        assert!(!health.is_lost());
        let lost = health.see(at(1), sight(false, true)).unwrap();
        assert!(lost.text.contains("0.100000000 s: 40 features, 12 of") && health.is_lost());
        assert_eq!(health.see(at(2), sight(false, true)), None);
        assert!(health.see(at(6), sight(true, true)).unwrap().text.contains("after 0.50 s"));
        assert!((health.summary().seconds_without_vision - 0.5).abs() < 1e-9);
        assert!(!health.is_lost());
    }

    #[test]
    fn each_divergence_is_named_and_ends() {
        let on_divergence = DivergencePolicy::Continue;
        let config = HealthConfig { max_bad_frames: 3, on_divergence, ..HealthConfig::default() };
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

    #[test]
    fn a_new_start_is_judged_by_itself() {
        let mut health = Health::new(&HealthConfig::default());
        assert_eq!(health.restarts(), None);
        assert!(health.judge(at(0), &belief(0.0, 6.0), Some(1.0)).is_some());
        assert_eq!(health.restarts(), Some(Divergence::Position));
        health.restarted(&belief(0.0, 7.0));
        assert_eq!(health.restarts(), None);
        assert_eq!(health.judge(at(1), &belief(0.0, 8.0), Some(1.0)), None);
        assert!(health.judge(at(2), &belief(0.0, 13.0), Some(1.0)).is_some());
        assert_eq!(health.summary().reinitializations, 1);
    }

    #[test]
    fn a_map_that_is_lost_in_plain_sight_is_a_divergence() {
        for visible in [false, true] {
            let mut health = Health::new(&HealthConfig::default());
            let (features, matches, inliers) = (40, 0, 0);
            let sight =
                Sight { expected: true, visible, features, matches, inliers, updated: false };
            assert!(health.see(at(0), sight).is_some());
            assert!(health.map_given_up(at(5)).text.contains("not found again"));
            assert_eq!(health.restarts(), visible.then_some(Divergence::View));
        }
    }
}
