//! Faults injected into the messages of a log, before they are ordered and paired.

use std::collections::VecDeque;
use std::fmt;
use std::str::FromStr;

use nalgebra::Vector3;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::ReadReport;
use super::merge::{Reading, ReadingSource};
use crate::inertial::ImuConfig;
use crate::sensor::{ColorImage, DepthImage, ImuSample, Stamp};

/// What goes wrong. What the amount of a [`Fault`] means is in brackets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FaultKind {
    /// Color images are black.
    Black,
    /// The left part of color and depth images is covered (share of the width).
    Covered,
    /// A textured object passes through the left half of the view (speed, pixels/s).
    Object,
    /// The IMU is silent.
    ImuGap,
    /// White noise is added to the IMU (multiples of the configured densities).
    ImuNoise,
    /// A bias is added to each axis of the IMU (multiples of the configured standard deviations).
    Bias,
    /// The accelerometer reads in other units (factor on its readings).
    AccelUnit,
    /// The gyroscope reads in other units (factor on its readings).
    GyroUnit,
    /// Stamps of the IMU are off (s).
    ImuStamps,
    /// Stamps of images are off (s).
    FrameStamps,
    /// Stamps of IMU and images jitter (standard deviation, s).
    Jitter,
    /// Messages of IMU and images are lost (probability of each).
    Dropped,
    /// Messages of IMU and images come twice (probability of each).
    Repeated,
    /// All is silent, and the clocks stand still meanwhile: the body is suddenly elsewhere.
    Kidnapped,
}

impl FaultKind {
    pub const ALL: [Self; 14] = [
        Self::Black,
        Self::Covered,
        Self::Object,
        Self::ImuGap,
        Self::ImuNoise,
        Self::Bias,
        Self::AccelUnit,
        Self::GyroUnit,
        Self::ImuStamps,
        Self::FrameStamps,
        Self::Jitter,
        Self::Dropped,
        Self::Repeated,
        Self::Kidnapped,
    ];

    pub fn name(self) -> &'static str {
        match self {
            Self::Black => "black",
            Self::Covered => "covered",
            Self::Object => "object",
            Self::ImuGap => "imu-gap",
            Self::ImuNoise => "imu-noise",
            Self::Bias => "bias",
            Self::AccelUnit => "accel-unit",
            Self::GyroUnit => "gyro-unit",
            Self::ImuStamps => "imu-stamps",
            Self::FrameStamps => "frame-stamps",
            Self::Jitter => "jitter",
            Self::Dropped => "dropped",
            Self::Repeated => "repeated",
            Self::Kidnapped => "kidnapped",
        }
    }

    fn default_amount(self) -> f64 {
        match self {
            Self::Black | Self::ImuGap | Self::Kidnapped => 1.0,
            Self::Covered => 0.5,
            Self::Object => 100.0,
            Self::ImuNoise | Self::Bias => 10.0,
            Self::AccelUnit => 1.0 / 9.81,
            Self::GyroUnit => 1.0f64.to_degrees(),
            Self::ImuStamps | Self::FrameStamps => 0.05,
            Self::Jitter => 0.002,
            Self::Dropped | Self::Repeated => 0.3,
        }
    }
}

/// A fault and when it happens; written `KIND:START:LENGTH[:AMOUNT]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fault {
    pub kind: FaultKind,
    /// s after the first message of the log.
    pub start: f64,
    /// s; infinite: to the end.
    pub length: f64,
    /// See [`FaultKind`].
    pub amount: f64,
}

impl Fault {
    /// With the kind's usual amount.
    pub fn new(kind: FaultKind, start: f64, length: f64) -> Self {
        Self { kind, start, length, amount: kind.default_amount() }
    }

    /// When it is over by the stamps of the log that it makes, s after the first message.
    pub fn end(&self) -> f64 {
        if self.kind == FaultKind::Kidnapped { self.start } else { self.start + self.length }
    }

    /// What the clocks show `seconds` after the first message; `None` while all is silent.
    pub fn clock(&self, seconds: f64) -> Option<f64> {
        let silent = self.kind == FaultKind::Kidnapped && self.contains(seconds);
        let behind = self.kind == FaultKind::Kidnapped && seconds >= self.start;
        (!silent).then_some(if behind { seconds - self.length } else { seconds })
    }

    fn contains(&self, seconds: f64) -> bool {
        (self.start..self.start + self.length).contains(&seconds)
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { kind, start, length, amount } = self;
        write!(f, "{}:{start}:{length}", kind.name())?;
        if *amount == kind.default_amount() { Ok(()) } else { write!(f, ":{amount}") }
    }
}

impl FromStr for Fault {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let mut parts = text.split(':');
        let name = parts.next().unwrap_or_default();
        let kind =
            FaultKind::ALL.into_iter().find(|kind| kind.name() == name).ok_or_else(|| {
                let names: Vec<_> = FaultKind::ALL.iter().map(|kind| kind.name()).collect();
                format!("unknown fault `{name}`; there are: {}", names.join(", "))
            })?;
        let mut number = |what: &str| match parts.next() {
            None => Ok(None),
            Some(part) => match part.parse::<f64>() {
                Ok(value) if !value.is_nan() => Ok(Some(value)),
                _ => Err(format!("{what} of `{text}`: expected a number, not `{part}`")),
            },
        };
        let (start, length, amount) = (number("start")?, number("length")?, number("amount")?);
        let (Some(start), Some(length)) = (start, length) else {
            return Err(format!("expected KIND:START:LENGTH[:AMOUNT], not `{text}`"));
        };
        let fault = Self::new(kind, start, length);
        let fault = Self { amount: amount.unwrap_or(fault.amount), ..fault };
        let sound = start >= 0.0 && start.is_finite() && length >= 0.0 && fault.amount.is_finite();
        match (sound, parts.next()) {
            (true, None) => Ok(fault),
            (false, _) => Err(format!("`{text}`: times are in seconds, 0 or more")),
            (true, Some(rest)) => Err(format!("`{rest}` follows the amount of `{text}`")),
        }
    }
}

/// A source with faults. What is random in them is the same in every run.
pub(super) struct FaultySource<S> {
    inner: S,
    faults: Vec<Fault>,
    imu: ImuConfig,
    rng: ChaCha8Rng,
    first: Option<Stamp>,
    last_imu: Option<Stamp>,
    ready: VecDeque<Reading>,
}

impl<S: ReadingSource> FaultySource<S> {
    pub fn new(inner: S, faults: &[Fault], imu: &ImuConfig) -> Self {
        Self {
            inner,
            faults: faults.to_vec(),
            imu: imu.clone(),
            rng: ChaCha8Rng::seed_from_u64(1),
            first: None,
            last_imu: None,
            ready: VecDeque::new(),
        }
    }

    /// What becomes of a reading, `seconds` after the first.
    fn inject(&mut self, reading: Reading, seconds: f64) {
        let mut readings = vec![reading];
        for k in 0..self.faults.len() {
            let fault = self.faults[k];
            let injected = readings.into_iter().flat_map(|reading| {
                let behind = fault.clock(seconds).map_or(0.0, |clock| clock - seconds);
                match fault.contains(seconds) {
                    true => self.hit(&fault, reading, seconds),
                    false => vec![moved(reading, behind)],
                }
            });
            readings = injected.collect();
        }
        self.ready.extend(readings);
    }

    fn hit(&mut self, fault: &Fault, reading: Reading, seconds: f64) -> Vec<Reading> {
        use FaultKind as Kind;
        let amount = fault.amount;
        match (fault.kind, reading) {
            (Kind::Kidnapped, _) | (Kind::ImuGap, Reading::Imu(_)) => vec![],
            (_, truth @ Reading::Truth(_)) => vec![truth],
            (Kind::Black, Reading::Color(stamp, image)) => {
                vec![Reading::Color(stamp, painted(&image, 1.0, |_, _| 0))]
            }
            (Kind::Covered, Reading::Color(stamp, image)) => {
                vec![Reading::Color(stamp, painted(&image, amount, |_, _| 0))]
            }
            (Kind::Black, Reading::Right(stamp, image)) => {
                vec![Reading::Right(stamp, painted(&image, 1.0, |_, _| 0))]
            }
            (Kind::Covered, Reading::Depth(stamp, image)) => {
                vec![Reading::Depth(stamp, at_depth(&image, amount, 0.0))]
            }
            (Kind::Object, Reading::Color(stamp, image)) => {
                let passed = (amount * (seconds - fault.start)).round() as i64;
                let pattern =
                    |column: usize, row: usize| pattern(column as i64 - passed, row as i64);
                vec![Reading::Color(stamp, painted(&image, OBJECT_WIDTH, pattern))]
            }
            (Kind::Object, Reading::Depth(stamp, image)) => {
                vec![Reading::Depth(stamp, at_depth(&image, OBJECT_WIDTH, OBJECT_DEPTH))]
            }
            (Kind::ImuNoise | Kind::Bias | Kind::AccelUnit | Kind::GyroUnit, Reading::Imu(s)) => {
                vec![Reading::Imu(self.disturbed(fault, s))]
            }
            (Kind::ImuStamps, imu @ Reading::Imu(_)) => vec![moved(imu, amount)],
            (Kind::FrameStamps, imu @ Reading::Imu(_)) => vec![imu],
            (Kind::FrameStamps, image) => vec![moved(image, amount)],
            (Kind::Jitter, reading) => {
                let normal: f64 = StandardNormal.sample(&mut self.rng);
                vec![moved(reading, amount * normal)]
            }
            (Kind::Dropped, reading) => match self.rng.random::<f64>() < amount {
                true => vec![],
                false => vec![reading],
            },
            (Kind::Repeated, reading) => match self.rng.random::<f64>() < amount {
                true => vec![reading.clone(), reading],
                false => vec![reading],
            },
            (_, reading) => vec![reading],
        }
    }

    fn disturbed(&mut self, fault: &Fault, sample: ImuSample) -> ImuSample {
        let amount = fault.amount;
        let interval = self.last_imu.map_or(0.0, |last| sample.stamp.seconds_since(last));
        let mut noise = |density: f64| -> Vector3<f64> {
            let sd = if interval > 0.0 { amount * density / interval.sqrt() } else { 0.0 };
            Vector3::from_fn(|_, _| {
                let normal: f64 = StandardNormal.sample(&mut self.rng);
                sd * normal
            })
        };
        let (rate, force) = match fault.kind {
            FaultKind::ImuNoise => (
                sample.angular_velocity + noise(self.imu.gyro_noise),
                sample.specific_force + noise(self.imu.accel_noise),
            ),
            FaultKind::Bias => (
                sample.angular_velocity.add_scalar(amount * self.imu.gyro_bias_sd),
                sample.specific_force.add_scalar(amount * self.imu.accel_bias_sd),
            ),
            FaultKind::AccelUnit => (sample.angular_velocity, sample.specific_force * amount),
            FaultKind::GyroUnit => (sample.angular_velocity * amount, sample.specific_force),
            _ => (sample.angular_velocity, sample.specific_force),
        };
        ImuSample { angular_velocity: rate, specific_force: force, ..sample }
    }
}

impl<S: ReadingSource> ReadingSource for FaultySource<S> {
    fn next_reading(&mut self, report: &mut ReadReport) -> Option<Reading> {
        if self.faults.is_empty() {
            return self.inner.next_reading(report);
        }
        while self.ready.is_empty() {
            let reading = self.inner.next_reading(report)?;
            let stamp = reading.stamp();
            let is_imu = matches!(reading, Reading::Imu(_));
            let first = *self.first.get_or_insert(stamp);
            self.inject(reading, stamp.seconds_since(first));
            if is_imu {
                self.last_imu = Some(stamp);
            }
        }
        self.ready.pop_front()
    }
}

/// Share of the width that the passing object fills, and its distance, m.
const OBJECT_WIDTH: f64 = 0.5;
const OBJECT_DEPTH: f64 = 1.2;

/// Squares of ten pixels of random brightness.
fn pattern(column: i64, row: i64) -> u8 {
    let cell = |x: i64| x.div_euclid(10) as u64;
    let mixed = (cell(column).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ cell(row))
        .wrapping_mul(0xbf58_476d_1ce4_e5b9);
    (mixed >> 56) as u8
}

/// The image with the brightness of its left part replaced, by column and row.
fn painted(image: &ColorImage, share: f64, brightness: impl Fn(usize, usize) -> u8) -> ColorImage {
    let (width, channels) = (image.width(), image.format().channels());
    let covered = (share * width as f64).round() as usize;
    let mut data = image.data().to_vec();
    for (index, pixel) in data.chunks_exact_mut(channels).enumerate() {
        let (column, row) = (index % width, index / width);
        if column < covered {
            pixel.fill(brightness(column, row));
        }
    }
    ColorImage::new(width, image.height(), image.format(), data).unwrap_or_else(|| image.clone())
}

/// The image with its left part at a depth in metres; 0: none.
fn at_depth(image: &DepthImage, share: f64, depth: f64) -> DepthImage {
    let width = image.width();
    let covered = (share * width as f64).round() as usize;
    let raw = (depth / f64::from(image.scale())).round() as u16;
    let mut data = image.data().to_vec();
    for (index, value) in data.iter_mut().enumerate() {
        if index % width < covered {
            *value = raw;
        }
    }
    DepthImage::new(width, image.height(), image.scale(), data).unwrap_or_else(|| image.clone())
}

/// The reading with its stamp moved.
fn moved(mut reading: Reading, seconds: f64) -> Reading {
    let stamp = match &mut reading {
        Reading::Color(stamp, _) | Reading::Right(stamp, _) | Reading::Depth(stamp, _) => stamp,
        Reading::Gyroscope(stamp, _) | Reading::Accelerometer(stamp, _) => stamp,
        Reading::Imu(sample) => &mut sample.stamp,
        Reading::Truth(pose) => &mut pose.stamp,
        Reading::Gnss(fix) => &mut fix.stamp,
        Reading::Magnetic(sample) => &mut sample.stamp,
    };
    *stamp = stamp.offset_by(seconds);
    reading
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::PixelFormat;

    /// Two seconds of an IMU at 100 Hz and of images of 4x1 pixels at 10 Hz.
    struct Readings(std::vec::IntoIter<Reading>);

    impl ReadingSource for Readings {
        fn next_reading(&mut self, _: &mut ReadReport) -> Option<Reading> {
            self.0.next()
        }
    }

    fn readings() -> Vec<Reading> {
        let mut readings = Vec::new();
        for k in 0..200 {
            let stamp = Stamp::from_nanos(5_000_000_000 + k * 10_000_000);
            let (angular_velocity, specific_force) = (Vector3::x(), Vector3::z() * 9.81);
            readings.push(Reading::Imu(ImuSample { stamp, angular_velocity, specific_force }));
            if k % 10 == 0 {
                let color = ColorImage::new(4, 1, PixelFormat::Rgb8, vec![200; 12]).unwrap();
                let depth = DepthImage::new(4, 1, 0.001, vec![3000; 4]).unwrap();
                readings.push(Reading::Color(stamp, color));
                readings.push(Reading::Depth(stamp, depth));
            }
        }
        readings
    }

    fn injected(specification: &str) -> Vec<Reading> {
        let fault: Fault = specification.parse().unwrap();
        let source = Readings(readings().into_iter());
        let mut faulty = FaultySource::new(source, &[fault], &ImuConfig::default());
        let mut report = ReadReport::default();
        std::iter::from_fn(|| faulty.next_reading(&mut report)).collect()
    }

    /// Seconds from the first message at which a reading is not what it was.
    fn changed(specification: &str) -> Vec<f64> {
        let start = Stamp::from_nanos(5_000_000_000);
        let pairs = readings().into_iter().zip(injected(specification));
        pairs
            .filter(|(before, after)| before != after)
            .map(|(before, _)| before.stamp().seconds_since(start))
            .collect()
    }

    #[test]
    fn specifications_are_read_and_written() {
        for text in ["black:1:0.5", "imu-noise:0:inf:3", "kidnapped:2:1"] {
            assert_eq!(text.parse::<Fault>().unwrap().to_string(), text);
        }
        for (text, reason) in [
            ("blak:1:1", "there are: black"),
            ("black:1", "KIND:START"),
            ("black:1:x", "length"),
            ("black:-1:1", "0 or more"),
            ("black:1:1:1:1", "follows"),
        ] {
            let error = text.parse::<Fault>().unwrap_err();
            assert!(error.contains(reason), "{error}");
        }
    }

    #[test]
    fn faults_hit_their_interval_and_nothing_else() {
        for kind in ["black", "covered", "object", "imu-noise", "bias", "accel-unit", "gyro-unit"] {
            let times = changed(&format!("{kind}:1:0.5"));
            assert!(!times.is_empty(), "{kind}");
            assert!(times.iter().all(|t| (1.0..1.5).contains(t)), "{kind}: {times:?}");
        }
        assert!(changed("black:5:1").is_empty());
    }

    #[test]
    fn messages_are_lost_repeated_and_moved() {
        let count = readings().len();
        assert_eq!(injected("imu-gap:1:0.5").len(), count - 50);
        assert!(injected("dropped:0:inf:0.5").len() < count * 6 / 10);
        assert!(injected("repeated:0:inf:0.5").len() > count * 14 / 10);
        let moved = injected("imu-stamps:1:0.5:0.02");
        let last = |readings: &[Reading]| readings.last().unwrap().stamp();
        assert_eq!(last(&moved), last(&readings()));
        let kidnapped = injected("kidnapped:1:0.5");
        assert_eq!(kidnapped.len(), count - 60);
        assert_eq!(last(&kidnapped), last(&readings()).offset_by(-0.5));
    }
}
