//! Clocks that jump: which of the stamps are to be believed, told by the turns that gyroscope and images
//! see.

use std::collections::VecDeque;

use nalgebra::{UnitQuaternion, Vector3};

use super::report::{Note, NoteLevel};
use crate::sensor::{ImuSample, Stamp};

/// Intervals within these multiples of the usual one are regular.
const REGULAR: std::ops::Range<f64> = 0.7..1.4;
/// So many regular intervals in a row make a stream steady; after as many others the usual one is learned
/// anew.
const STEADY: u32 = 10;
/// Shorter jumps do little harm, longer ones are gaps, s.
const JUMPS: std::ops::Range<f64> = 0.02..0.25;
/// An interval this close to a whole number of usual ones may mean lost messages, as a share of one.
const WHOLE: f64 = 0.1;
/// Intervals over which jitter is averaged.
const JITTER_MEMORY: f64 = 30.0;
/// Intervals whose mean is the usual one.
const MEAN_MEMORY: f64 = 100.0;
/// Less than this does no harm, s.
const LEAST_JITTER: f64 = 1e-3;
/// Samples that are kept, s.
const MEMORY: f64 = 2.0;
/// Turns are compared over at least this time, s.
const SPAN: f64 = 0.1;
/// Standard deviation of each component of a turn between two images, rad.
const TURN_SD: f64 = 2e-3;
/// Most that a single turn may tell: a pose may be wrong.
const MOST: f64 = 3.0;
/// Logarithm of the likelihood ratio at which it is decided.
const DECIDED: f64 = 6.0;
/// What is not decided by then stays as it is, s.
const PATIENCE: f64 = 2.0;

/// Stamps of a stream.
#[derive(Debug, Clone, Default)]
struct Stream {
    last: Option<Stamp>,
    /// The usual one, s.
    interval: f64,
    /// Intervals that it is the mean of.
    count: f64,
    /// Regular and irregular intervals since the last one of the other kind.
    regular: u32,
    irregular: u32,
    /// Of the intervals, but for lost messages, s^2.
    variance: f64,
}

impl Stream {
    /// By how much longer than usual (s) an interval was in a stream that had been steady.
    fn see(&mut self, stamp: Stamp) -> Option<f64> {
        let interval = stamp.seconds_since(self.last.replace(stamp)?);
        if self.interval == 0.0 || self.irregular >= STEADY {
            (self.interval, self.count, self.irregular) = (interval, 1.0, 0);
            return None;
        }
        let off = interval / self.interval;
        let jitter = (off - off.round()) * self.interval;
        self.variance += (jitter * jitter - self.variance) / JITTER_MEMORY;
        if REGULAR.contains(&off) {
            self.irregular = 0;
            self.regular += 1;
            self.count = (self.count + 1.0).min(MEAN_MEMORY);
            self.interval += (interval - self.interval) / self.count;
            return None;
        }
        self.irregular += 1;
        let steady = std::mem::take(&mut self.regular) >= STEADY;
        steady.then_some(interval - self.interval)
    }
}

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
    /// From, to (as timed at present), and the turn of the body as the images have it.
    turns: VecDeque<(Stamp, Stamp, UnitQuaternion<f64>)>,
    /// Logarithm of the likelihood ratio.
    score: f64,
}

impl Doubt {
    fn new(offset: f64, since: Stamp, jumped: bool) -> Self {
        Self { offset, since, jumped, last: None, turns: VecDeque::new(), score: 0.0 }
    }

    fn see(&mut self, stamp: Stamp, attitude: UnitQuaternion<f64>) {
        if stamp.offset_by(self.offset.min(0.0)) < self.since {
            return;
        }
        match self.last {
            Some((from, before)) if stamp.seconds_since(from) >= SPAN => {
                self.turns.push_back((from, stamp, before.inverse() * attitude));
                self.last = Some((stamp, attitude));
            }
            None => self.last = Some((stamp, attitude)),
            Some(_) => {}
        }
    }

    /// Weighs the turns that the samples cover.
    fn weigh(&mut self, samples: &VecDeque<ImuSample>, bias: &Vector3<f64>) {
        while let Some(&(from, to, turn)) = self.turns.front() {
            let newest = samples.back().map(|sample| sample.stamp);
            if newest.is_none_or(|newest| newest < to.offset_by(self.offset.max(0.0))) {
                break;
            }
            self.turns.pop_front();
            let misfit = |offset: f64| {
                let felt = turned(samples, from.offset_by(offset), to.offset_by(offset), bias)?;
                Some((felt.inverse() * turn).scaled_axis().norm_squared())
            };
            let Some((as_timed, moved)) = misfit(0.0).zip(misfit(self.offset)) else { continue };
            let ratio = (as_timed - moved) / (2.0 * TURN_SD * TURN_SD);
            self.score += ratio.clamp(-MOST, MOST);
            if !self.jumped {
                self.score = self.score.max(0.0);
            }
        }
    }
}

/// The turn of the body between two times by the gyroscope; `None` if the samples do not cover them.
fn turned(
    samples: &VecDeque<ImuSample>,
    from: Stamp,
    to: Stamp,
    bias: &Vector3<f64>,
) -> Option<UnitQuaternion<f64>> {
    if samples.front()?.stamp > from || samples.back()?.stamp < to {
        return None;
    }
    let mut turn = UnitQuaternion::identity();
    for (before, after) in samples.iter().zip(samples.iter().skip(1)) {
        let (start, end) = (before.stamp.max(from), after.stamp.min(to));
        let seconds = end.seconds_since(start);
        if seconds > 0.0 {
            let middle = ImuSample::between(before, after, start.offset_by(0.5 * seconds));
            turn *= UnitQuaternion::from_scaled_axis((middle.angular_velocity - bias) * seconds);
        }
    }
    Some(turn)
}

/// Watches the clocks of IMU and camera.
///
/// An interval that is longer than usual means lost messages, or that a clock has jumped. Until the
/// turns that the images see have told which, the IMU is in doubt. A few lost frames do not put it there.
#[derive(Debug, Clone, Default)]
pub(super) struct ClockWatch {
    imu: Stream,
    frames: Stream,
    samples: VecDeque<ImuSample>,
    doubt: Option<Doubt>,
    offset: f64,
}

impl ClockWatch {
    /// What the jumps so far add to the time of a frame on the IMU's clock, s.
    pub fn offset(&self) -> f64 {
        self.offset
    }

    /// Standard deviation of the time between two frames as stamps of frames and IMU have it, s; 0 if
    /// that is what any log has.
    pub fn jitter(&self) -> f64 {
        let jitter = (self.imu.variance + self.frames.variance).sqrt();
        if jitter > LEAST_JITTER { jitter } else { 0.0 }
    }

    /// Whether a jump has been seen of which it is not known yet what it was.
    pub fn is_in_doubt(&self) -> bool {
        self.doubt.as_ref().is_some_and(|doubt| doubt.jumped || doubt.score > 0.5 * DECIDED)
    }

    pub fn imu(&mut self, sample: ImuSample) {
        while self.samples.front().is_some_and(|s| sample.stamp.seconds_since(s.stamp) > MEMORY) {
            self.samples.pop_front();
        }
        self.samples.push_back(sample);
        if let Some(jump) = self.imu.see(sample.stamp) {
            self.suspect(jump, sample.stamp);
        }
    }

    /// Of a frame that is timed so by the IMU's clock.
    pub fn frame(&mut self, time: Stamp) {
        let Some(jump) = self.frames.see(time) else { return };
        let intervals = jump / self.frames.interval;
        if (intervals - intervals.round()).abs() > WHOLE {
            self.suspect(-jump, time.offset_by((-jump).min(0.0)));
        }
    }

    /// A jump of a clock that had jumped before takes it back: of stamps that repeat earlier ones the
    /// readers leave none.
    fn suspect(&mut self, offset: f64, since: Stamp) {
        if self.offset != 0.0 {
            self.doubt = Some(Doubt::new(-self.offset, since, true));
        } else if JUMPS.contains(&offset.abs()) {
            self.doubt = Some(Doubt::new(offset, since, true));
        }
    }

    /// Takes note of the attitude of the body that an image shows, and of the gyroscope's bias. If
    /// that tells that a clock has jumped: by how much frames are to be timed later from now on, and a
    /// note.
    pub fn attitude(
        &mut self,
        time: Stamp,
        attitude: Option<UnitQuaternion<f64>>,
        bias: &Vector3<f64>,
    ) -> Option<(f64, Note)> {
        if self.doubt.is_none() && self.offset != 0.0 {
            self.doubt = Some(Doubt::new(-self.offset, time, false));
        }
        let doubt = self.doubt.as_mut()?;
        if let Some(attitude) = attitude {
            doubt.see(time, attitude);
        }
        doubt.weigh(&self.samples, bias);
        let (offset, score) = (doubt.offset, doubt.score);
        let late = doubt.jumped && time.seconds_since(doubt.since) > PATIENCE;
        if late || doubt.jumped && score < -DECIDED || score > DECIDED {
            self.doubt = None;
        }
        if score <= DECIDED {
            return None;
        }
        self.offset += offset;
        self.frames = Stream::default();
        let text = format!(
            "a clock has jumped before {time} s: the turns seen fit the gyroscope if frames are timed \
             {:.1} ms {}",
            1e3 * offset.abs(),
            if offset > 0.0 { "later" } else { "earlier" }
        );
        Some((offset, Note { level: NoteLevel::Warning, text }))
    }

    /// The samples that are kept.
    pub fn samples(&self) -> impl Iterator<Item = &ImuSample> {
        self.samples.iter()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        let mut clock = ClockWatch::default();
        let mut offsets = Vec::new();
        let mut frames = VecDeque::new();
        let mut last = 0.0;
        for k in 1..1200 {
            let t = k as f64 * 0.005;
            if k % 6 == 0 {
                frames.push_back(t);
                clock.frame(at(frame_stamp(t) + clock.offset()));
            }
            if let Some(stamp) = imu_stamp(t).filter(|stamp| *stamp > last) {
                last = stamp;
                clock.imu(ImuSample {
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
                let attitude = UnitQuaternion::from_scaled_axis(Vector3::x() * angle(taken));
                let bias = Vector3::x() * 0.01;
                let found = clock.attitude(at(time), Some(attitude), &bias);
                offsets.extend(found.map(|(offset, _)| offset));
            }
        }
        (offsets, clock.is_in_doubt())
    }

    #[test]
    fn jitter_is_told_from_losses() {
        let jitter = |interval: fn(u32) -> f64| {
            let mut clock = ClockWatch::default();
            let mut time = 0.0;
            for k in 0..200 {
                time += interval(k);
                clock.frame(at(time));
            }
            clock.jitter()
        };
        // Every third frame is missing after a while.
        assert_eq!(jitter(|k| if k < 20 || k % 2 == 0 { 0.03 } else { 0.06 }), 0.0);
        let found = jitter(|k| if k % 2 == 0 { 0.032 } else { 0.028 });
        assert!((found - 0.002).abs() < 2e-4, "{found}");
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
