//! From readings in order of arrival to [`Event`]s in order of their stamps.

use std::collections::{BTreeMap, VecDeque};

use nalgebra::Vector3;

use super::pair::{Paired, Pairer};
use super::{Event, Log, LogConfig, LogSummary, ReadReport, RgbdFrame, TruthPose};
use crate::sensor::{ColorImage, DepthImage, GnssFix, ImuSample, MagneticSample, Stamp, Stream};

/// One message of a stream that is used, decoded.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Reading {
    Color(Stamp, ColorImage),
    /// Of the right one of two cameras; [`StereoSource`](super::stereo::StereoSource) gives it the
    /// stamp of the left one.
    Right(Stamp, ColorImage),
    Depth(Stamp, DepthImage),
    Imu(ImuSample),
    /// Angular velocity alone, rad/s; [`UnitedSource`](super::inertial_halves::UnitedSource) makes
    /// samples of the two halves.
    Gyroscope(Stamp, Vector3<f64>),
    /// Specific force alone, m/s^2.
    Accelerometer(Stamp, Vector3<f64>),
    Truth(TruthPose),
    Gnss(GnssFix),
    Magnetic(MagneticSample),
}

/// Readings in the order in which they were logged.
pub(super) trait ReadingSource: Send {
    /// The next one that can be read; messages that cannot are counted in `report`.
    fn next_reading(&mut self, report: &mut ReadReport) -> Option<Reading>;
}

impl Reading {
    pub fn stamp(&self) -> Stamp {
        match self {
            Self::Color(stamp, _) | Self::Right(stamp, _) | Self::Depth(stamp, _) => *stamp,
            Self::Gyroscope(stamp, _) | Self::Accelerometer(stamp, _) => *stamp,
            Self::Imu(sample) => sample.stamp,
            Self::Truth(pose) => pose.stamp,
            Self::Gnss(fix) => fix.stamp,
            Self::Magnetic(sample) => sample.stamp,
        }
    }

    /// Width and height of an image.
    pub fn image_size(&self) -> Option<(u32, u32)> {
        match self {
            Self::Color(_, image) | Self::Right(_, image) => {
                Some((image.width() as u32, image.height() as u32))
            }
            Self::Depth(_, image) => Some((image.width() as u32, image.height() as u32)),
            _ => None,
        }
    }

    fn stream(&self) -> usize {
        match self {
            Self::Color(..) => 0,
            Self::Depth(..) => 1,
            Self::Imu(_) | Self::Gyroscope(..) | Self::Accelerometer(..) => 2,
            Self::Truth(_) => 3,
            Self::Right(..) => 4,
            Self::Gnss(_) => 5,
            Self::Magnetic(_) => 6,
        }
    }

    /// Memory it takes in the buffer, bytes.
    fn size(&self) -> usize {
        match self {
            Self::Color(_, image) | Self::Right(_, image) => color_size(image),
            Self::Depth(_, image) => depth_size(image),
            _ => ENTRY_SIZE,
        }
    }
}

/// Generous size of an entry of the buffer without its pixels, bytes.
const ENTRY_SIZE: usize = 256;

fn color_size(image: &ColorImage) -> usize {
    ENTRY_SIZE + image.data().len()
}

fn depth_size(image: &DepthImage) -> usize {
    ENTRY_SIZE + 2 * image.data().len()
}

const STREAMS: [&str; 7] =
    ["color image", "depth image", "imu", "truth", "right image", "gnss", "magnetic field"];

/// A step of a stream's stamps longer than this is believed only when the next message confirms
/// it: one damaged stamp in the future would otherwise make all that follow it late.
const LONGEST_STEP: f64 = 10.0;

/// Readings wait for stragglers in at most this much memory, bytes.
const LARGEST_BUFFER: usize = 256 << 20;

/// All readings late over this time (s), and as many, mean that all clocks were set back.
const SET_BACK_SECONDS: f64 = 0.1;
const SET_BACK_READINGS: usize = 5;

/// Readings in a row that came too late: stragglers, unless all that follows is late, too.
#[derive(Default)]
struct Late(Vec<Reading>);

impl Late {
    /// Holds a reading; those that a straggler of its stream makes stragglers come back.
    fn hold(&mut self, reading: Reading) -> Vec<Reading> {
        let same = |held: &&Reading| held.stream() == reading.stream();
        let last = self.0.iter().rev().find(same).map(Reading::stamp);
        let stragglers = match last.is_some_and(|last| reading.stamp() <= last) {
            true => std::mem::take(&mut self.0),
            false => Vec::new(),
        };
        self.0.push(reading);
        stragglers
    }

    /// Whether they go on as if nothing had been before.
    fn is_new_run(&self) -> bool {
        let stamps = || self.0.iter().map(Reading::stamp);
        let span =
            stamps().max().zip(stamps().min()).map(|(last, first)| last.seconds_since(first));
        self.0.len() >= SET_BACK_READINGS && span.is_some_and(|span| span >= SET_BACK_SECONDS)
    }
}

/// Orders readings by stamp in a buffer of bounded time and memory, and pairs the images.
pub(super) struct MergedLog<S> {
    source: S,
    summary: LogSummary,
    report: ReadReport,
    gates: [StampGate; STREAMS.len()],
    buffer: ReorderBuffer,
    late: Late,
    finished: bool,
}

impl<S: ReadingSource> MergedLog<S> {
    pub fn new(source: S, summary: LogSummary, config: &LogConfig) -> Self {
        Self {
            source,
            summary,
            report: ReadReport::default(),
            gates: Default::default(),
            buffer: ReorderBuffer::new(config),
            late: Late::default(),
            finished: false,
        }
    }

    /// Takes a reading; where all that comes is late from some point on, the clocks were set back:
    /// what was before is released, and the stamps begin anew.
    fn accept(&mut self, reading: Reading) {
        if !self.buffer.is_late(reading.stamp()) {
            self.drop_late();
            self.order(reading);
            return;
        }
        for straggler in self.late.hold(reading) {
            self.buffer.add(straggler, &mut self.report);
        }
        if self.late.is_new_run() {
            self.release_all();
            self.gates = Default::default();
            self.buffer.begin_anew();
            let first = std::mem::take(&mut self.late);
            first.0.into_iter().for_each(|reading| self.order(reading));
        }
    }

    /// Stragglers are counted.
    fn drop_late(&mut self) {
        for straggler in std::mem::take(&mut self.late).0 {
            self.buffer.add(straggler, &mut self.report);
        }
    }

    fn order(&mut self, reading: Reading) {
        let stream = reading.stream();
        for reading in self.gates[stream].pass(reading, &mut self.report) {
            self.buffer.add(reading, &mut self.report);
        }
        let held = self.gates.iter().filter_map(|gate| gate.held.as_ref().map(Reading::stamp));
        self.buffer.advance(held, &mut self.report);
    }

    fn finish(&mut self) {
        self.finished = true;
        self.drop_late();
        self.release_all();
    }

    fn release_all(&mut self) {
        for gate in &mut self.gates {
            if let Some(reading) = gate.finish(&mut self.report) {
                self.buffer.add(reading, &mut self.report);
            }
        }
        self.buffer.release(Stamp::from_nanos(i64::MAX), &mut self.report);
    }
}

impl<S: ReadingSource> Log for MergedLog<S> {
    fn summary(&self) -> &LogSummary {
        &self.summary
    }

    fn next_event(&mut self) -> Option<Event> {
        loop {
            if let Some(event) = self.buffer.ready.pop_front() {
                let count = match event {
                    Event::Imu(_) => &mut self.report.imu_samples,
                    Event::Frame(_) => &mut self.report.frames,
                    Event::Truth(_) => &mut self.report.truth_poses,
                    Event::Repeated(..) => return Some(event),
                };
                *count += 1;
                return Some(event);
            }
            if self.finished {
                return None;
            }
            match self.source.next_reading(&mut self.report) {
                Some(reading) => self.accept(reading),
                None => self.finish(),
            }
        }
    }

    fn report(&self) -> &ReadReport {
        &self.report
    }
}

/// Holds back a reading whose stamp jumps until the next one of its stream confirms it.
#[derive(Default)]
struct StampGate {
    last: Option<Stamp>,
    held: Option<Reading>,
}

impl StampGate {
    fn pass(&mut self, reading: Reading, report: &mut ReadReport) -> Vec<Reading> {
        let stamp = reading.stamp();
        let follows = |earlier: Stamp| stamp.seconds_since(earlier) <= LONGEST_STEP;
        if self.last.is_some_and(follows) {
            self.last = self.last.max(Some(stamp));
            self.discard(report);
            return vec![reading];
        }
        match self.held.take() {
            Some(held) if held.stamp().seconds_since(stamp).abs() <= LONGEST_STEP => {
                self.last = Some(held.stamp().max(stamp));
                vec![held, reading]
            }
            held => {
                self.held = held;
                self.discard(report);
                self.held = Some(reading);
                Vec::new()
            }
        }
    }

    /// A stream of a single reading has nothing that contradicts it.
    fn finish(&mut self, report: &mut ReadReport) -> Option<Reading> {
        if self.last.is_none() {
            return self.held.take();
        }
        self.discard(report);
        None
    }

    fn discard(&mut self, report: &mut ReadReport) {
        if let Some(held) = self.held.take() {
            let reason = format!("{}: stamp far from its neighbours", STREAMS[held.stream()]);
            report.skip_at(&reason, held.stamp());
        }
    }
}

struct ReorderBuffer {
    /// Events of an instant come in this order: IMU, truth, frame.
    events: BTreeMap<(Stamp, u8), Event>,
    images: Pairer<ColorImage, DepthImage>,
    /// Stamped as the color image that they belong to.
    rights: BTreeMap<Stamp, ColorImage>,
    ready: VecDeque<Event>,
    /// How long a reading waits for others, ns.
    delay: i64,
    latest: Stamp,
    /// All up to here is released; what comes now from before is late.
    released: Option<Stamp>,
    size: usize,
}

impl ReorderBuffer {
    fn new(config: &LogConfig) -> Self {
        let pair_limit = (config.max_pair_difference * 1e9).round() as i64;
        let window = (config.reorder_window * 1e9).round() as i64;
        Self {
            events: BTreeMap::new(),
            images: Pairer::new(pair_limit),
            rights: BTreeMap::new(),
            ready: VecDeque::new(),
            delay: window.saturating_add(pair_limit.saturating_mul(2)),
            latest: Stamp::from_nanos(i64::MIN),
            released: None,
            size: 0,
        }
    }

    fn is_late(&self, stamp: Stamp) -> bool {
        self.released.is_some_and(|released| stamp <= released)
    }

    /// Forgets which stamps there were; everything must have been released.
    fn begin_anew(&mut self) {
        (self.latest, self.released) = (Stamp::from_nanos(i64::MIN), None);
    }

    fn add(&mut self, reading: Reading, report: &mut ReadReport) {
        let (stamp, size, stream) = (reading.stamp(), reading.size(), STREAMS[reading.stream()]);
        if self.is_late(stamp) {
            let reason = format!("{stream}: out of order beyond the reorder window, or repeated");
            report.skip_at(&reason, stamp);
            return;
        }
        let repeated = self.repeated(&reading);
        let new = match reading {
            Reading::Color(stamp, image) => self.images.add_color(stamp, image),
            Reading::Depth(stamp, image) => self.images.add_depth(stamp, image),
            Reading::Imu(sample) => self.add_event(0, Event::Imu(sample)),
            Reading::Truth(pose) => self.add_event(1, Event::Truth(pose)),
            Reading::Right(stamp, image) => self.rights.insert(stamp, image).is_none(),
            Reading::Gyroscope(..)
            | Reading::Accelerometer(..)
            | Reading::Gnss(_)
            | Reading::Magnetic(_) => {
                report.skip_at(&format!("{stream}: not used by odometry"), stamp);
                return;
            }
        };
        if !new {
            let reason = format!("{stream}: repeated stamp");
            report.skip_at(&reason, stamp);
            if let Some(stream) = repeated {
                self.add_event(3 + stream as u8, Event::Repeated(stream, stamp));
            }
            return;
        }
        self.size += size;
        self.latest = self.latest.max(stamp);
    }

    /// Releases what need not wait any longer, for stragglers or for the readings `held` back.
    fn advance(&mut self, held: impl Iterator<Item = Stamp>, report: &mut ReadReport) {
        let due = Stamp::from_nanos(self.latest.nanos().saturating_sub(self.delay));
        let believable = |held: &Stamp| self.latest.seconds_since(*held) <= LONGEST_STEP;
        let before = |held: Stamp| Stamp::from_nanos(held.nanos().saturating_sub(1));
        let mut until = held.filter(believable).map(before).fold(due, Stamp::min);
        if self.size > LARGEST_BUFFER {
            until = self.latest;
        }
        if self.oldest().is_some_and(|oldest| oldest <= until) {
            self.release(until, report);
        }
    }

    /// The stream of a reading that is the same as one that waits already. Another one of the same
    /// stamp is no repetition: a clock may have gone back.
    fn repeated(&self, reading: &Reading) -> Option<Stream> {
        match reading {
            Reading::Imu(sample) => {
                let before = self.events.get(&(sample.stamp, 0))?;
                matches!(before, Event::Imu(before) if before == sample).then_some(Stream::Imu)
            }
            Reading::Color(stamp, image) => {
                (self.images.color(*stamp)? == image).then_some(Stream::Frames)
            }
            _ => None,
        }
    }

    fn add_event(&mut self, rank: u8, event: Event) -> bool {
        let key = (event.stamp(), rank);
        let new = !self.events.contains_key(&key);
        if new {
            self.events.insert(key, event);
        }
        new
    }

    fn oldest(&self) -> Option<Stamp> {
        let event = self.events.keys().next().map(|key| key.0);
        event.into_iter().chain(self.images.oldest()).min()
    }

    fn release(&mut self, until: Stamp, report: &mut ReadReport) {
        let Self { images, rights, events, ready, size, .. } = self;
        images.settle(until, |paired| match paired {
            Paired::Pair(stamp, color, depth) => {
                *size = size.saturating_sub(color_size(&color) + depth_size(&depth));
                let others: Vec<ColorImage> = rights.remove(&stamp).into_iter().collect();
                *size = size.saturating_sub(others.iter().map(color_size).sum());
                if let Some(frame) = registered(stamp, color, depth, others, report) {
                    *size += ENTRY_SIZE;
                    events.insert((stamp, 2), Event::Frame(Box::new(frame)));
                }
            }
            Paired::LoneColor(stamp, color) => {
                *size = size.saturating_sub(color_size(&color));
                let reason = "color image: no depth image near enough in time";
                report.skip_at(reason, stamp);
            }
            Paired::LoneDepth(stamp, depth) => {
                *size = size.saturating_sub(depth_size(&depth));
                let reason = "depth image: no color image near enough in time";
                report.skip_at(reason, stamp);
            }
        });
        // Those whose color image never came.
        while let Some(entry) = rights.first_entry().filter(|entry| *entry.key() <= until) {
            *size = size.saturating_sub(color_size(&entry.remove()));
        }
        while let Some(entry) = events.first_entry() {
            if entry.key().0 > until {
                break;
            }
            *size = size.saturating_sub(ENTRY_SIZE);
            ready.push_back(entry.remove());
        }
        self.released = self.released.max(Some(until));
    }
}

/// `None`, and counted, if the images cannot be registered pixel for pixel.
fn registered(
    stamp: Stamp,
    color: ColorImage,
    depth: DepthImage,
    others: Vec<ColorImage>,
    report: &mut ReadReport,
) -> Option<RgbdFrame> {
    let (color_size, depth_size) =
        ((color.width(), color.height()), (depth.width(), depth.height()));
    if color_size != depth_size {
        let detail = format_args!("{color_size:?} and {depth_size:?} pixels at {stamp} s");
        report.skip("frame: color and depth differ in size", detail);
        return None;
    }
    Some(RgbdFrame { stamp, color, depth, others })
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Vector3};

    use super::super::samples::{read_all, read_runs};
    use super::*;
    use crate::sensor::PixelFormat;

    struct Readings(std::vec::IntoIter<Reading>);

    impl ReadingSource for Readings {
        fn next_reading(&mut self, _report: &mut ReadReport) -> Option<Reading> {
            self.0.next()
        }
    }

    fn at(millis: i64) -> Stamp {
        Stamp::from_nanos(millis * 1_000_000)
    }

    fn imu(millis: i64) -> Reading {
        let zero = Vector3::zeros();
        Reading::Imu(ImuSample { stamp: at(millis), angular_velocity: zero, specific_force: zero })
    }

    fn truth(millis: i64) -> Reading {
        Reading::Truth(TruthPose { stamp: at(millis), world_from_body: Isometry3::identity() })
    }

    fn color(millis: i64, width: usize) -> Reading {
        let data = vec![0; width];
        Reading::Color(at(millis), ColorImage::new(width, 1, PixelFormat::Mono8, data).unwrap())
    }

    fn depth(millis: i64, width: usize) -> Reading {
        Reading::Depth(at(millis), DepthImage::new(width, 1, 0.001, vec![1; width]).unwrap())
    }

    /// Kinds and milliseconds of the events, and the counts of what was left out.
    type Merged = (Vec<(char, i64)>, BTreeMap<String, u64>);

    /// Of one run, whose events are in order.
    fn merge(readings: Vec<Reading>, window: f64) -> Merged {
        merge_by(read_all, readings, window)
    }

    fn merge_by(
        read: fn(&mut dyn Log) -> Vec<Event>,
        readings: Vec<Reading>,
        window: f64,
    ) -> Merged {
        let config = LogConfig { reorder_window: window, ..LogConfig::default() };
        let source = Readings(readings.into_iter());
        let mut log = MergedLog::new(source, LogSummary::default(), &config);
        let events = read(&mut log).into_iter().map(|event| {
            let kind = match event {
                Event::Imu(_) => 'i',
                Event::Frame(_) => 'f',
                Event::Truth(_) => 't',
                Event::Repeated(..) => 'r',
            };
            (kind, event.stamp().nanos() / 1_000_000)
        });
        (events.collect(), log.report.skipped.clone())
    }

    #[test]
    fn events_are_ordered_across_streams_and_at_one_instant() {
        let readings = vec![
            color(10, 2),
            truth(10),
            imu(20),
            imu(10),
            depth(12, 2),
            imu(0),
            color(40, 2),
            depth(39, 2),
        ];
        let (events, skipped) = merge(readings, 0.5);
        let expected = [('i', 0), ('i', 10), ('t', 10), ('f', 10), ('i', 20), ('f', 40)];
        assert_eq!((events.as_slice(), skipped.len()), (&expected[..], 0));
    }

    /// The same again is told of; another message of the same stamp is only left out.
    #[test]
    fn repetitions_are_told_of() {
        let other = |millis| match imu(millis) {
            Reading::Imu(sample) => {
                Reading::Imu(ImuSample { angular_velocity: Vector3::x(), ..sample })
            }
            other => other,
        };
        let readings =
            vec![imu(0), imu(0), imu(10), other(10), color(20, 2), depth(20, 2), color(20, 2)];
        let (events, skipped) = merge(readings, 0.5);
        assert_eq!(events, [('i', 0), ('r', 0), ('i', 10), ('f', 20), ('r', 20)]);
        assert_eq!(skipped["imu: repeated stamp"], 2);
    }

    #[test]
    fn what_comes_later_than_the_window_is_left_out() {
        let readings = vec![imu(0), imu(100), imu(50), imu(400), imu(110), imu(450)];
        let (events, skipped) = merge(readings.clone(), 0.1);
        assert_eq!(events.len(), 5);
        assert_eq!(skipped["imu: out of order beyond the reorder window, or repeated"], 1);
        assert_eq!(merge(readings, 1.0).0.len(), 6);
    }

    #[test]
    fn clocks_that_are_set_begin_anew() {
        // Two streams at 100 Hz and 10 Hz, by 1 s back and by an hour ahead after 2 s.
        for jump in [-1000, -3_600_000, 3_600_000] {
            let clock = |millis: i64| if millis > 2000 { millis + jump } else { millis };
            let mut readings = Vec::new();
            for millis in (0..4000).step_by(10) {
                readings.push(imu(clock(millis)));
                if millis % 100 == 0 {
                    readings.extend([color(clock(millis), 2), depth(clock(millis), 2)]);
                }
            }
            let (events, skipped) = merge_by(read_runs, readings, 0.5);
            assert_eq!((events.len(), skipped.len()), (440, 0), "{jump}");
            let jumps: Vec<_> = events
                .windows(2)
                .map(|w| w[1].1 - w[0].1)
                .filter(|d| !(0..=10).contains(d))
                .collect();
            assert_eq!(jumps, [jump + 10], "{jump}");
        }
    }

    #[test]
    fn a_late_burst_among_others_is_no_new_run() {
        let mut readings: Vec<_> = (0..400).map(|n| imu(n * 10)).collect();
        let burst: Vec<_> = (0..30).map(|n| truth(1000 + 10 * n)).collect();
        for (n, late) in burst.into_iter().enumerate() {
            readings.insert(300 + 2 * n, late);
        }
        let (events, skipped) = merge(readings, 0.5);
        assert_eq!((events.len(), skipped.values().sum::<u64>()), (400, 30));
        assert!(events.windows(2).all(|w| w[0].1 < w[1].1));
    }

    #[test]
    fn one_damaged_stamp_does_not_make_the_rest_late() {
        for damaged in [9_000_000, -9_000_000] {
            let mut readings: Vec<_> = (0..100).map(|n| imu(n * 10)).collect();
            readings[50] = imu(damaged);
            let (events, skipped) = merge(readings, 0.1);
            assert_eq!((events.len(), skipped.values().sum::<u64>()), (99, 1), "{damaged}");
            let mut readings: Vec<_> = (0..100).map(|n| imu(n * 10)).collect();
            readings[0] = imu(damaged);
            assert_eq!(merge(readings, 0.1).0.len(), 99);
        }
    }

    #[test]
    fn a_slow_stream_is_not_late_while_its_first_stamp_waits_for_the_second() {
        let readings: Vec<_> = (0..300)
            .flat_map(|n| if n % 100 == 0 { vec![truth(n), imu(n)] } else { vec![imu(n)] })
            .collect();
        let (events, skipped) = merge(readings, 0.01);
        assert_eq!((events.len(), skipped.len()), (303, 0));
    }

    #[test]
    fn a_pause_of_the_recording_loses_nothing() {
        let readings: Vec<_> =
            (0..50).chain(60_000..60_050).flat_map(|n| [imu(n), truth(n)]).collect();
        let (events, skipped) = merge(readings, 0.1);
        assert_eq!((events.len(), skipped.len()), (200, 0));
        assert_eq!(merge(vec![imu(5)], 0.1).0, [('i', 5)]);
    }

    #[test]
    fn images_of_different_size_are_no_frame() {
        let (events, skipped) = merge(vec![color(0, 2), depth(0, 3)], 0.1);
        assert!(events.is_empty());
        assert_eq!(skipped["frame: color and depth differ in size"], 1);
    }

    #[test]
    fn memory_is_bounded_however_long_the_window() {
        let config = LogConfig { reorder_window: 1e6, ..LogConfig::default() };
        let mut buffer = ReorderBuffer::new(&config);
        let mut report = ReadReport::default();
        for n in 0..40 {
            buffer.add(color(n, 16 << 20), &mut report);
            buffer.advance(std::iter::empty(), &mut report);
            assert!(buffer.size <= LARGEST_BUFFER);
        }
    }
}
