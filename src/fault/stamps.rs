//! Stamps of a stream: losses, repetitions, jitter, silence.

use super::sequential::{Cusum, cusum_threshold};
use super::{Fault, FaultConfig, Finding, Monitor, Stream, Verdict};
use crate::sensor::Stamp;

/// Intervals from which the usual one is learned.
const LEARNED_FROM: usize = 16;
/// The usual interval is the mean of about so many: a drifting clock is followed.
const MEMORY: f64 = 100.0;
/// So many irregular intervals in a row mean that the stream has another rate now.
const ANOTHER_RATE: u32 = 16;

/// From one message to the next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Interval {
    /// s.
    pub seconds: f64,
    /// The usual one, s.
    pub usual: f64,
    /// Whole number of usual intervals that it is nearest to, at least 1.
    pub whole: u32,
    /// Regular intervals just before it.
    pub steady: u32,
}

impl Interval {
    /// Distance from the nearest whole number of usual intervals, s.
    pub fn off(&self) -> f64 {
        self.seconds - f64::from(self.whole) * self.usual
    }

    /// Of one usual interval or so.
    pub fn is_regular(&self) -> bool {
        (0.5..1.5).contains(&(self.seconds / self.usual))
    }
}

/// Learns the usual interval of a stream.
///
/// At first it is the lower quartile of some intervals: with up to half of the messages lost most of the
/// shorter intervals are still single ones.
#[derive(Debug, Clone, Default)]
pub struct Intervals {
    last: Option<Stamp>,
    first: Vec<f64>,
    usual: Option<f64>,
    count: f64,
    steady: u32,
    irregular: u32,
}

impl Intervals {
    pub fn usual(&self) -> Option<f64> {
        self.usual
    }

    pub fn last(&self) -> Option<Stamp> {
        self.last
    }

    /// The interval that `stamp` ends, once the usual one is known. Those longer than `longest`
    /// seconds are silence, not losses.
    pub fn next(&mut self, stamp: Stamp, longest: f64) -> Option<Interval> {
        let seconds = stamp.seconds_since(self.last.replace(stamp)?);
        if seconds <= 0.0 || seconds > longest {
            return None;
        }
        let Some(usual) = self.usual else {
            self.first.push(seconds);
            if self.first.len() >= LEARNED_FROM {
                self.first.sort_unstable_by(f64::total_cmp);
                self.usual = self.first.get(LEARNED_FROM / 4).copied();
                self.count = 1.0;
                self.first.clear();
            }
            return None;
        };
        let whole = (seconds / usual).round().clamp(1.0, 1e6);
        let interval = Interval { seconds, usual, whole: whole as u32, steady: self.steady };
        if interval.is_regular() {
            (self.steady, self.irregular) = (self.steady.saturating_add(1), 0);
            self.count = (self.count + 1.0).min(MEMORY);
            self.usual = Some(usual + (seconds - usual) / self.count);
        } else {
            (self.steady, self.irregular) = (0, self.irregular + 1);
        }
        if self.irregular >= ANOTHER_RATE {
            *self = Self { last: self.last, ..Self::default() };
        }
        Some(interval)
    }
}

/// Tells lost messages.
///
/// An interval lacks messages with probability `p0` in a sound stream, `p1` in one that loses them:
/// `ln p1/p0` for each that does, `ln (1-p1)/(1-p0)` for each that does not. How many a single interval
/// lacks does not count: what is lost at once has one cause.
#[derive(Debug, Clone, Default)]
pub struct Losses {
    config: FaultConfig,
    sum: Cusum,
    /// Share of intervals that usually lack messages, and what it is known from.
    usual_share: f64,
    count: f64,
}

impl Losses {
    /// Of a sound stream one in a hundred (a busy USB bus); less is not told from it.
    const SOUND: f64 = 0.01;
    /// Of one that loses messages one in five, and at least so many times the usual.
    const LOSING: f64 = 0.2;
    const FACTOR: f64 = 4.0;
    /// Intervals that the usual share is the mean of.
    const MEMORY: f64 = 1000.0;

    pub fn new(config: &FaultConfig) -> Self {
        Self { config: config.clone(), ..Self::default() }
    }
}

impl Monitor for Losses {
    type Evidence = Interval;

    fn observe(&mut self, at: Stamp, interval: &Interval) -> Verdict {
        let lacks = interval.whole > 1;
        let sound = self.usual_share.max(Self::SOUND);
        let losing = (Self::FACTOR * sound).clamp(Self::LOSING, 0.9);
        let log_ratio = match lacks {
            true => (losing / sound).ln(),
            false => ((1.0 - losing) / (1.0 - sound)).ln(),
        };
        let threshold = cusum_threshold(self.config.false_alarms_per_hour, interval.usual);
        let statistic = self.sum.add(at, log_ratio, threshold);
        if statistic < 0.5 {
            self.count = (self.count + 1.0).min(Self::MEMORY);
            self.usual_share +=
                (f64::from(u8::from(lacks)) - self.usual_share) / self.count.max(100.0);
        }
        Verdict::by(statistic, Fault::Dropped, self.sum.since().unwrap_or(at))
    }
}

/// Tells stamps that scatter.
///
/// `off`, what an interval differs by from a whole number of usual ones, is t-distributed about 0 with
/// the usual deviation; with jitter with one that is [`Self::FACTOR`] times as large.
#[derive(Debug, Clone)]
pub struct Jittering {
    config: FaultConfig,
    sum: Cusum,
    /// Mean square, s^2: usual, and that of late.
    usual: f64,
    late: f64,
    count: f64,
}

impl Jittering {
    const FACTOR: f64 = 4.0;
    /// No stamp is expected to be better than this, s.
    const FLOOR: f64 = 2e-4;
    /// Most that one interval may tell: a clock that jumps leaves a few odd ones.
    const MOST: f64 = 3.0;
    /// Degrees of freedom: single intervals are off for many reasons.
    const DOF: f64 = 4.0;
    const MEMORY: f64 = 300.0;
    const LATE: f64 = 10.0;

    pub fn new(config: &FaultConfig) -> Self {
        Self { config: config.clone(), sum: Cusum::default(), usual: 0.0, late: 0.0, count: 0.0 }
    }

    /// Standard deviation of the intervals of late, s.
    pub fn sd(&self) -> f64 {
        self.late.sqrt()
    }
}

impl Monitor for Jittering {
    type Evidence = Interval;

    fn observe(&mut self, at: Stamp, interval: &Interval) -> Verdict {
        let square = interval.off().powi(2);
        let variance = self.usual.max(Self::FLOOR.powi(2));
        let term = |variance: f64| {
            -0.5 * (Self::DOF + 1.0) * (square / variance / Self::DOF).ln_1p() - 0.5 * variance.ln()
        };
        let log_ratio = (term(variance * Self::FACTOR.powi(2)) - term(variance)).min(Self::MOST);
        let threshold = cusum_threshold(self.config.false_alarms_per_hour, interval.usual);
        let statistic = self.sum.add(at, log_ratio, threshold);
        self.late += (square - self.late) / Self::LATE;
        if statistic < 0.5 {
            self.count = (self.count + 1.0).min(Self::MEMORY);
            // A clock that jumps is no jitter.
            let square = square.min(9.0 * variance);
            self.usual += (square - self.usual) / self.count;
        }
        let sd = self.sd();
        Verdict::by(statistic, Fault::Jitter { sd }, self.sum.since().unwrap_or(at))
    }
}

/// Tells messages that come again: `p0` in a sound stream, `p1` in one that repeats them.
#[derive(Debug, Clone)]
pub struct Repeats {
    config: FaultConfig,
    sum: Cusum,
}

impl Repeats {
    const SOUND: f64 = 1e-3;
    const REPEATING: f64 = 0.1;
    /// Messages come at least every so many seconds; a shorter one lowers the threshold little.
    const INTERVAL: f64 = 0.005;

    pub fn new(config: &FaultConfig) -> Self {
        Self { config: config.clone(), sum: Cusum::default() }
    }
}

impl Monitor for Repeats {
    /// Whether the message was there before.
    type Evidence = bool;

    fn observe(&mut self, at: Stamp, repeated: &bool) -> Verdict {
        let log_ratio = match repeated {
            true => (Self::REPEATING / Self::SOUND).ln(),
            false => ((1.0 - Self::REPEATING) / (1.0 - Self::SOUND)).ln(),
        };
        let threshold = cusum_threshold(self.config.false_alarms_per_hour, Self::INTERVAL);
        let statistic = self.sum.add(at, log_ratio, threshold);
        Verdict::by(statistic, Fault::Repeated, self.sum.since().unwrap_or(at))
    }
}

/// Tells a stream that is silent. Silence needs no test: its length is what is measured.
#[derive(Debug, Clone, Copy)]
pub struct Silence {
    stream: Stream,
    /// s.
    longest: f64,
    last: Option<Stamp>,
}

impl Silence {
    /// The IMU's is told after `longest` seconds: that of the configuration, `imu.max_gap`.
    pub fn new(stream: Stream, longest: f64) -> Self {
        Self { stream, longest, last: None }
    }

    pub fn last(&self) -> Option<Stamp> {
        self.last
    }

    /// Whether the stream has been silent for too long at this time.
    pub fn at(&self, now: Stamp) -> Verdict {
        let fault = match self.stream {
            Stream::Imu => Fault::ImuGap,
            Stream::Frames => Fault::Stalled,
        };
        match self.last {
            Some(last) if now.seconds_since(last) > self.longest => Verdict::Confirmed(Finding {
                fault,
                since: last,
                statistic: now.seconds_since(last) / self.longest,
            }),
            _ => Verdict::Nominal,
        }
    }
}

impl Monitor for Silence {
    type Evidence = ();

    /// Takes note of a message, and judges the silence that it ends.
    fn observe(&mut self, at: Stamp, (): &()) -> Verdict {
        let verdict = self.at(at);
        self.last = self.last.max(Some(at));
        verdict
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    fn at(seconds: f64) -> Stamp {
        Stamp::default().offset_by(seconds)
    }

    /// Times of the first confirmations of losses and jitter in a stream with such stamps.
    fn told(stamps: impl Iterator<Item = f64>) -> [Option<f64>; 2] {
        let config = FaultConfig::default();
        let mut intervals = Intervals::default();
        let (mut losses, mut jitter) = (Losses::new(&config), Jittering::new(&config));
        let mut told = [None, None];
        for seconds in stamps {
            let Some(interval) = intervals.next(at(seconds), 0.5) else { continue };
            let verdicts =
                [losses.observe(at(seconds), &interval), jitter.observe(at(seconds), &interval)];
            for (told, verdict) in told.iter_mut().zip(verdicts) {
                if verdict.confirmed().is_some() {
                    told.get_or_insert(seconds);
                }
            }
        }
        told
    }

    /// `count` stamps at `rate`, jittering by `sd` from `from` on and lost with `loss` there.
    fn stream(seed: u64, rate: f64, from: f64, sd: f64, loss: f64) -> Vec<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut stamps = Vec::new();
        for k in 0..(10.0 * rate) as usize {
            let t = k as f64 / rate;
            let (jitter, lost): (f64, f64) = (StandardNormal.sample(&mut rng), rng.random());
            let usual: f64 = StandardNormal.sample(&mut rng);
            let t = t + 1e-4 * usual;
            match t >= from {
                true if lost < loss => {}
                true => stamps.push(t + sd * jitter),
                false => stamps.push(t),
            }
        }
        stamps.sort_unstable_by(f64::total_cmp);
        stamps
    }

    #[test]
    fn losses_are_told_soon_at_any_rate() {
        for (seed, (rate, loss)) in
            [(500.0, 0.3), (100.0, 0.3), (30.0, 0.51)].into_iter().enumerate()
        {
            let [losses, jitter] = told(stream(seed as u64, rate, 4.0, 0.0, loss).into_iter());
            let losses = losses.unwrap();
            assert!((4.0..5.0).contains(&losses), "{rate} {losses}");
            assert_eq!(jitter, None, "{rate}");
        }
    }

    #[test]
    fn jitter_is_told_soon_at_any_rate_before_losses() {
        for (seed, rate) in [400.0, 200.0, 100.0, 30.0].into_iter().enumerate() {
            let [losses, jitter] = told(stream(seed as u64, rate, 4.0, 0.002, 0.0).into_iter());
            let Some(jitter) = jitter else { panic!("{rate}") };
            assert!((4.0..5.0).contains(&jitter), "{rate} {jitter}");
            assert!(losses.is_none_or(|losses| losses >= jitter), "{rate} {losses:?}");
        }
    }

    /// One in a hundred lost now and then, all for 0.2 s, one clock jump: no fault of these.
    #[test]
    fn what_happens_to_any_stream_is_neither() {
        for seed in 0..10 {
            let stamps = stream(seed, 100.0, 0.0, 0.0, 0.01);
            let moved = |t: f64| if t > 7.0 { t + 0.033 } else { t };
            let stamps = stamps.into_iter().filter(|t| !(5.0..5.2).contains(t)).map(moved);
            assert_eq!(told(stamps), [None, None]);
        }
    }

    /// Stamps in whole milliseconds of 30 Hz, and 32 and 36 ms as a Kinect has them.
    #[test]
    fn rounded_stamps_are_usual() {
        let rounded = (0..600).map(|k| (f64::from(k) / 30.0 * 1e3).round() * 1e-3);
        assert_eq!(told(rounded), [None, None]);
        let mut t = 0.0;
        let kinect = (0..600).map(|k| {
            t += if k % 3 == 2 { 0.036 } else { 0.032 };
            t
        });
        assert_eq!(told(kinect), [None, None]);
    }

    #[test]
    fn a_stream_that_changes_its_rate_is_learned_anew() {
        let mut intervals = Intervals::default();
        let slower = (0..60).map(|k| f64::from(k) / 30.0);
        let faster = (0..60).map(|k| 2.0 + f64::from(k) / 100.0);
        for t in slower.chain(faster) {
            intervals.next(at(t), 1.0);
        }
        assert!((intervals.usual().unwrap() - 0.01).abs() < 1e-4);
    }

    #[test]
    fn repetitions_are_told_unless_they_are_rare() {
        let mut repeats = Repeats::new(&FaultConfig::default());
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let mut first = |share: f64| {
            (0..20_000).find(|k| {
                let repeated = rng.random::<f64>() < share;
                repeats.observe(Stamp::from_nanos(*k), &repeated).confirmed().is_some()
            })
        };
        assert_eq!(first(5e-4), None);
        assert!(first(0.3).unwrap() < 40);
    }

    #[test]
    fn silence_is_told_by_its_length() {
        let mut imu = Silence::new(Stream::Imu, 0.1);
        assert_eq!(imu.at(at(5.0)), Verdict::Nominal);
        imu.observe(at(0.0), &());
        assert_eq!(imu.observe(at(0.1), &()), Verdict::Nominal);
        assert_eq!(imu.at(at(0.3)).confirmed().unwrap().fault, Fault::ImuGap);
        let ended = imu.observe(at(0.7), &());
        assert_eq!(ended.confirmed().unwrap().since, at(0.1));
        assert_eq!(imu.observe(at(0.71), &()), Verdict::Nominal);
    }
}
