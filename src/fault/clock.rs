//! Clocks that jump: which of the stamps are to be believed, told by the turns that gyroscope and
//! images see.

use std::collections::VecDeque;
use std::ops::Range;

use nalgebra::{UnitQuaternion, Vector3};

use super::sequential::{Cusum, Decided, Sprt};
use super::{Fault, FaultConfig, Finding, GyroscopeTrack, Interval, Verdict};
use crate::sensor::Stamp;

/// An attitude of the body that an image shows.
#[derive(Debug, Clone)]
pub struct Sighting<'a> {
    /// `None`: the image shows none.
    pub world_from_body: Option<UnitQuaternion<f64>>,
    pub gyroscope: &'a GyroscopeTrack,
    /// rad/s.
    pub gyro_bias: Vector3<f64>,
    /// Of a component of a turn between two images, rad^2.
    pub variance: f64,
}

/// A turn of the body as the images have it.
type SeenTurn = (Stamp, Stamp, UnitQuaternion<f64>);

/// Whether frames were taken `offset` later by the IMU's clock than they are timed.
#[derive(Debug, Clone)]
struct Doubt {
    /// s.
    offset: f64,
    /// Turns before this (IMU's clock) say nothing of it.
    since: Stamp,
    /// A stream jumped, for all its stamps tell; else it may have gone back unnoticed.
    jumped: bool,
    last: Option<(Stamp, UnitQuaternion<f64>)>,
    turns: VecDeque<SeenTurn>,
    test: Sprt,
    watch: Cusum,
    statistic: f64,
    decided: Option<Decided>,
}

impl Doubt {
    fn new(offset: f64, since: Stamp, jumped: bool, config: &FaultConfig) -> Self {
        Self {
            offset,
            since,
            jumped,
            last: None,
            turns: VecDeque::new(),
            test: Sprt::new(ClockJumps::FALSE_ALARM, config.miss_probability),
            watch: Cusum::default(),
            statistic: 0.0,
            decided: None,
        }
    }

    fn see(&mut self, at: Stamp, attitude: UnitQuaternion<f64>) {
        if at.offset_by(self.offset.min(0.0)) < self.since {
            return;
        }
        match self.last {
            Some((from, before)) if at.seconds_since(from) >= ClockJumps::SPAN => {
                self.turns.push_back((from, at, before.inverse() * attitude));
                self.last = Some((at, attitude));
            }
            None => self.last = Some((at, attitude)),
            Some(_) => {}
        }
    }

    /// Weighs the turns that the samples cover.
    fn weigh(&mut self, sighting: &Sighting) {
        while let Some(&(from, to, turn)) = self.turns.front() {
            let newest = sighting.gyroscope.newest();
            if newest.is_none_or(|newest| newest < to.offset_by(self.offset.max(0.0))) {
                break;
            }
            self.turns.pop_front();
            let misfit = |offset: f64| {
                let (from, to) = (from.offset_by(offset), to.offset_by(offset));
                let felt = sighting.gyroscope.turned(from, to, &sighting.gyro_bias)?;
                Some((felt.inverse() * turn).scaled_axis().norm_squared())
            };
            let Some((as_timed, moved)) = misfit(0.0).zip(misfit(self.offset)) else { continue };
            let most = ClockJumps::MOST;
            let ratio = ((as_timed - moved) / (2.0 * sighting.variance)).clamp(-most, most);
            if self.jumped {
                self.decided = self.decided.or(self.test.add(ratio));
                self.statistic = self.test.statistic();
            } else {
                // A jump is usually taken back: the odds of one are those of a jump that was seen.
                let threshold = -ClockJumps::FALSE_ALARM.ln();
                self.statistic = self.watch.add(to, ratio, threshold);
                self.decided = (self.statistic >= 1.0).then_some(Decided::Fault);
            }
        }
    }
}

/// Tells clocks that jump.
///
/// An interval that is longer than usual means lost messages, or that a clock has jumped by its excess.
/// The turns `q` seen decide by an [`Sprt`]: of a turn between images at `s` and `t` the log-likelihood
/// ratio is `(|q - g(s, t)|^2 - |q - g(s + d, t + d)|^2) / 2 v`, where `g` is the turn by the gyroscope,
/// `d` the jump and `v` the variance of a turn by images.
#[derive(Debug, Clone)]
pub struct ClockJumps {
    config: FaultConfig,
    doubt: Option<Doubt>,
    offset: f64,
}

impl ClockJumps {
    /// Intervals within these multiples of the usual one are regular.
    const REGULAR: Range<f64> = 0.7..1.4;
    /// Regular intervals in a row that make a stream steady.
    const STEADY: u32 = 10;
    /// Shorter jumps do little harm, longer ones are gaps, s.
    const JUMPS: Range<f64> = 0.01..0.25;
    /// Shorter ones of the IMU's stamps are lost samples far more often, s.
    const LEAST_OF_IMU: f64 = 0.02;
    /// An interval this close to a whole number of usual ones may mean lost messages, as a share of one.
    const WHOLE: f64 = 0.1;
    /// Turns are compared over at least this time, s: poses scatter as much over any.
    const SPAN: f64 = 0.1;
    /// Most that a single turn may tell: a pose may be wrong.
    const MOST: f64 = 3.0;
    /// What is not decided by then stays as it is, s.
    const PATIENCE: f64 = 2.0;
    /// Probability that lost messages are taken for a jump.
    const FALSE_ALARM: f64 = 2.5e-3;

    pub fn new(config: &FaultConfig) -> Self {
        Self { config: config.clone(), doubt: None, offset: 0.0 }
    }

    /// What the jumps so far add to the time of a frame on the IMU's clock, s.
    pub fn offset(&self) -> f64 {
        self.offset
    }

    /// Whether a jump has been seen of which it is not known yet what it was.
    pub fn is_in_doubt(&self) -> bool {
        self.doubt.as_ref().is_some_and(|doubt| doubt.jumped || doubt.statistic > 0.5)
    }

    /// The time from which on a jump is in doubt.
    pub fn doubted_since(&self) -> Option<Stamp> {
        self.doubt.as_ref().filter(|doubt| doubt.jumped).map(|doubt| doubt.since)
    }

    /// By how much longer than usual an interval is in a stream that had been steady, s.
    fn excess(interval: &Interval) -> Option<f64> {
        let regular = Self::REGULAR.contains(&(interval.seconds / interval.usual));
        let steady = interval.steady >= Self::STEADY;
        (steady && !regular).then_some(interval.seconds - interval.usual)
    }

    pub fn imu_interval(&mut self, at: Stamp, interval: &Interval) {
        if let Some(jump) = Self::excess(interval).filter(|jump| *jump >= Self::LEAST_OF_IMU) {
            self.suspect(jump, at);
        }
    }

    /// Of frames, timed by the IMU's clock. A few lost ones are no reason to doubt.
    pub fn frame_interval(&mut self, at: Stamp, interval: &Interval) {
        let Some(jump) = Self::excess(interval) else { return };
        let intervals = jump / interval.usual;
        if (intervals - intervals.round()).abs() > Self::WHOLE {
            self.suspect(-jump, at.offset_by((-jump).min(0.0)));
        }
    }

    /// A jump of a clock that had jumped before takes it back: of stamps that repeat earlier ones the
    /// readers leave none.
    pub fn suspect(&mut self, offset: f64, since: Stamp) {
        if self.offset != 0.0 {
            self.doubt = Some(Doubt::new(-self.offset, since, true, &self.config));
        } else if Self::JUMPS.contains(&offset.abs()) {
            self.doubt = Some(Doubt::new(offset, since, true, &self.config));
        }
    }
}

impl ClockJumps {
    /// Weighs an image. What is confirmed counts at once: [`Self::offset`] is another from then on.
    pub fn observe(&mut self, at: Stamp, sighting: &Sighting) -> Verdict {
        if self.doubt.is_none() && self.offset != 0.0 {
            self.doubt = Some(Doubt::new(-self.offset, at, false, &self.config));
        }
        let Some(doubt) = self.doubt.as_mut() else { return Verdict::Nominal };
        if let Some(attitude) = sighting.world_from_body {
            doubt.see(at, attitude);
        }
        doubt.weigh(sighting);
        let fault = Fault::ClockJump { offset: doubt.offset };
        let finding = Finding { fault, since: doubt.since, statistic: doubt.statistic };
        let late = doubt.jumped && at.seconds_since(doubt.since) > Self::PATIENCE;
        match doubt.decided {
            Some(Decided::Fault) => {
                self.offset += doubt.offset;
                self.doubt = None;
                Verdict::Confirmed(finding)
            }
            Some(Decided::Sound) => {
                self.doubt = None;
                Verdict::Nominal
            }
            None if late => {
                self.doubt = None;
                Verdict::Nominal
            }
            None if doubt.jumped => Verdict::Suspected(finding),
            None => Verdict::by(doubt.statistic.min(0.99), fault, doubt.since),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::Intervals;
    use super::*;
    use crate::sensor::ImuSample;

    fn at(seconds: f64) -> Stamp {
        Stamp::default().offset_by(seconds)
    }

    /// Turned about x by this angle.
    fn angle(t: f64) -> f64 {
        0.4 * (2.0 * t).sin()
    }

    /// Offsets found, and whether there was a doubt in the end. `stamps` gives the stamps of sample
    /// and frame taken at a time, `None` if lost.
    fn told(
        imu_stamp: impl Fn(f64) -> Option<f64>,
        frame_stamp: impl Fn(f64) -> f64,
    ) -> (Vec<f64>, bool) {
        let mut clock = ClockJumps::new(&FaultConfig::default());
        let (mut imu, mut timed) = (Intervals::default(), Intervals::default());
        let mut gyroscope = GyroscopeTrack::default();
        let mut offsets = Vec::new();
        let mut frames = VecDeque::new();
        let mut last = 0.0;
        for k in 1..1200 {
            let t = k as f64 * 0.005;
            if k % 6 == 0 {
                frames.push_back(t);
                let time = at(frame_stamp(t) + clock.offset());
                if let Some(interval) = timed.next(time, 1.0) {
                    clock.frame_interval(time, &interval);
                }
            }
            if let Some(stamp) = imu_stamp(t).filter(|stamp| *stamp > last) {
                last = stamp;
                if let Some(interval) = imu.next(at(stamp), 1.0) {
                    clock.imu_interval(at(stamp), &interval);
                }
                gyroscope.push(ImuSample {
                    stamp: at(stamp),
                    angular_velocity: Vector3::x() * (0.8 * (2.0 * t).cos() + 0.01),
                    specific_force: Vector3::zeros(),
                });
            }
            while let Some(&taken) = frames.front() {
                let time = frame_stamp(taken) + clock.offset();
                if time > last {
                    break;
                }
                frames.pop_front();
                let sighting = Sighting {
                    world_from_body: Some(UnitQuaternion::from_scaled_axis(
                        Vector3::x() * angle(taken),
                    )),
                    gyroscope: &gyroscope,
                    gyro_bias: Vector3::x() * 0.01,
                    variance: 4e-6,
                };
                if let Some(finding) = clock.observe(at(time), &sighting).confirmed()
                    && let Fault::ClockJump { offset } = finding.fault
                {
                    offsets.push(offset);
                    timed = Intervals::default();
                }
            }
        }
        (offsets, clock.is_in_doubt())
    }

    #[test]
    fn jumps_are_told_from_losses_by_the_turns_seen() {
        let off = |t: f64| if (2.0..4.0).contains(&t) { 0.05 } else { 0.0 };
        let (offsets, in_doubt) = told(|t| Some(t + off(t)), |t| t);
        assert!(offsets.len() == 2 && !in_doubt, "{offsets:?}");
        assert!((offsets[0] - 0.05).abs() < 1e-3 && (offsets[1] + 0.05).abs() < 1e-3);

        let (offsets, _) = told(Some, |t| t + off(t));
        assert!(offsets.len() == 2, "{offsets:?}");
        assert!((offsets[0] + 0.05).abs() < 1e-3 && (offsets[1] - 0.05).abs() < 1e-3);

        let lost = |t: f64| (!(2.0..2.05).contains(&t)).then_some(t);
        assert_eq!(told(lost, |t| t), (vec![], false));
        assert_eq!(told(Some, |t| t), (vec![], false));
    }
}
