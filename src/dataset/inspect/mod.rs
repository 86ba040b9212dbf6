//! What is in a log, and whether it is fit for visual-inertial odometry.
//!
//! The whole log is read, but only one image in ten is decoded. What needs an estimator, which this
//! module does not know, is added by [`Inspection::with_camera_track`] and
//! [`Inspection::with_trial`].

mod accelerometer;
mod findings;
mod images;
mod inertial;
mod timing;
mod turns;

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::Isometry3;
use serde::Serialize;

use self::images::{ColorStatistics, DepthStatistics};
use self::inertial::Inertial;
use self::timing::Times;
use super::decode::Decoder;
use super::folder::{Listing, read_entry};
use super::inertial_halves::ImuUniter;
use super::merge::Reading;
use super::message::{Fields, MessageType};
use super::open::{Contents, MessageLog};
use super::pair::{Paired, Pairer};
use super::pixels::Rejection;
use super::ros::{ImageHead, ImuContent, Message, Role, Survey};
use super::{LogConfig, LogError, LogSummary, ReadReport, TruthPose};
use crate::inertial::ImuConfig;
use crate::sensor::{ColorImage, Stamp};
use crate::vision::StereoRig;

pub use findings::{Finding, Severity, Verdict};
pub use images::{ColorInspection, DepthInspection};
pub use inertial::{
    AccelerometerFit, AccelerometerUnit, Evidence, GyroscopeUnit, ImuInspection, Sign,
};
pub use timing::{Gap, LogClock, Timing};
pub use turns::TurnInspection;

/// One image in this many is decoded.
const STRIDE: u64 = 10;

/// The settings with which the log would be replayed; what the log says differently is advised.
#[derive(Debug, Clone)]
pub struct Assumed<'a> {
    pub log: &'a LogConfig,
    pub imu: &'a ImuConfig,
    /// Where it is known to be that of this log's camera.
    pub body_from_camera: Option<Isometry3<f64>>,
    /// Added to camera stamps to bring them to the IMU's clock, s.
    pub time_offset: f64,
    /// Keys of the calibration that nothing gives.
    pub missing: Vec<&'static str>,
}

impl<'a> Assumed<'a> {
    /// Of a log whose camera is not known.
    pub fn new(log: &'a LogConfig, imu: &'a ImuConfig) -> Self {
        Self { log, imu, body_from_camera: None, time_offset: 0.0, missing: Vec::new() }
    }
}

/// What came of starting the estimator on the log.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Trial {
    /// Frames that it was given.
    pub frames: u64,
    pub processed: u64,
    /// Why it processed none.
    pub reason: Option<String>,
    /// Advised settings with which it ran.
    pub settings: Vec<String>,
}

/// Length of the span over which the turns of images and gyroscope are to be compared, s.
pub const TURN_SPAN: f64 = inertial::LIVELY_SPAN;

/// What is in a log. Times are in seconds.
#[derive(Debug, Clone, Serialize)]
pub struct Inspection {
    #[serde(flatten)]
    pub summary: LogSummary,
    /// From the first to the last message of the streams that are used, s.
    pub duration: f64,
    pub topics: BTreeMap<String, TopicInspection>,
    pub color: Option<ColorInspection>,
    pub depth: Option<DepthInspection>,
    pub pairs: PairInspection,
    pub imu: Option<ImuInspection>,
    /// Turns of the images against those of the gyroscope.
    pub turns: Option<TurnInspection>,
    /// The estimator's start.
    pub trial: Option<Trial>,
    /// Messages that could not be used, by reason.
    pub skipped: BTreeMap<String, u64>,
    pub findings: Vec<Finding>,
    pub verdict: Verdict,
    #[serde(skip)]
    inertial: Inertial,
}

/// One topic, or one kind of file of a folder.
#[derive(Debug, Clone, Default, Serialize)]
pub struct TopicInspection {
    /// Message type, as logged.
    pub schema: String,
    /// Of the first image: encoding, width and height.
    pub encoding: Option<String>,
    pub size: Option<(u32, u32)>,
    pub messages: u64,
    /// Size of the messages; 0 for files.
    pub bytes: u64,
    /// Absent without messages.
    pub timing: Option<Timing>,
}

/// Which color and depth images belong together.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct PairInspection {
    pub frames: u64,
    /// Images without a partner within `log.max_pair_difference`.
    pub lone_color: u64,
    pub lone_depth: u64,
    /// Largest difference of the stamps of a pair, s.
    pub largest_difference: f64,
}

/// Reads a log through.
///
/// # Errors
/// As [`super::open`], but a log that lacks streams is no error.
pub fn inspect(path: &Path, assumed: &Assumed) -> Result<Inspection, LogError> {
    assumed.log.validate()?;
    let mut inspector = Inspector::new(assumed.log);
    let summary = match Contents::of(path, assumed.log)? {
        Contents::Folder(folder) => {
            let (summary, listing) = *folder;
            inspector.read_folder(listing);
            summary
        }
        Contents::Messages(messages) => inspector.read_messages(path, &messages, assumed.log)?,
    };
    Ok(inspector.finish(summary, assumed))
}

struct Inspector {
    topics: BTreeMap<String, (TopicInspection, Times)>,
    roles: BTreeMap<String, Role>,
    /// Settings that leave the values as they are logged.
    raw: LogConfig,
    decoder: Decoder,
    uniter: ImuUniter,
    color: ColorStatistics,
    depth: DepthStatistics,
    inertial: Inertial,
    pairing: Pairer<(), Stamp>,
    pairs: PairInspection,
    latest_image: Option<Stamp>,
    report: ReadReport,
    /// Of two cameras, and the left image that waits for the right one.
    stereo: Option<StereoRig>,
    left: Option<(Stamp, ColorImage)>,
}

impl Inspector {
    fn new(log: &LogConfig) -> Self {
        let raw = LogConfig { depth_invalid: Vec::new(), ..LogConfig::default() };
        Self {
            topics: BTreeMap::new(),
            roles: BTreeMap::new(),
            decoder: Decoder::new(&raw, &ImuConfig::default(), ImuContent::Whole),
            uniter: ImuUniter::new(&ImuConfig::default()),
            raw,
            color: ColorStatistics::default(),
            depth: DepthStatistics::default(),
            inertial: Inertial::default(),
            pairing: Pairer::new((log.max_pair_difference * 1e9).round() as i64),
            pairs: PairInspection::default(),
            latest_image: None,
            report: ReadReport::default(),
            stereo: None,
            left: None,
        }
    }

    fn read_messages(
        &mut self,
        path: &Path,
        log: &MessageLog,
        config: &LogConfig,
    ) -> Result<LogSummary, LogError> {
        let survey = Survey::new(log.messages().as_mut());
        let chosen = survey.choose(config).map_err(|role| survey.missing(path, role))?;
        if !config.stereo.is_empty() {
            self.stereo = survey.rig(path, &chosen, config)?;
        }
        let summary = survey.summary_of(log.kind(), &chosen, self.stereo.as_ref());
        self.decoder = survey.decoder(&chosen, &self.raw, &ImuConfig::default());
        self.roles = chosen.into_iter().map(|(role, topic)| (topic, role)).collect();
        let mut messages = log.messages();
        // Topics without messages are told too.
        for channel in messages.channels() {
            let topic = self.topics.entry(channel.topic.clone()).or_default();
            topic.0.schema.clone_from(&channel.schema);
        }
        let mut report = std::mem::take(&mut self.report);
        while messages.visit_next(&mut report, &mut |message, report| self.visit(message, report)) {
        }
        self.report = report;
        Ok(summary)
    }

    fn visit(&mut self, message: &Message, report: &mut ReadReport) {
        let channel = message.channel;
        let role = self.roles.get(&channel.topic).copied();
        let stamp = header_stamp(message);
        let (topic, times) = self.topics.entry(channel.topic.clone()).or_default();
        topic.schema.clone_from(&channel.schema);
        topic.messages += 1;
        topic.bytes += message.data.len() as u64;
        times.add(stamp, Some(message.log_time));
        if topic.encoding.is_none()
            && let Ok(Some(image)) = ImageHead::of(message)
        {
            (topic.encoding, topic.size) = (Some(image.encoding), image.size);
        }
        let (Some(role), Some(stamp)) = (role, stamp) else { return };
        let number = topic.messages;
        self.note_image(role, stamp);
        if role.is_image() && number % STRIDE != 1 {
            return;
        }
        let is_metres = topic_is_metres(self.topics.get(&channel.topic));
        match self.decoder.decode(role, message) {
            Ok(Some(reading)) => self.take(reading, is_metres, report),
            Ok(None) => {}
            Err(Rejection { reason, detail }) => report.skip(
                &format!("{}: {reason}", role.name()),
                format_args!("{}, {}: {detail}", channel.topic, message.place),
            ),
        }
    }

    fn read_folder(&mut self, mut listing: Listing) {
        listing.entries.sort_by_key(|(stamp, _)| *stamp);
        self.stereo = listing.stereo;
        for (reason, detail) in listing.rejections {
            self.report.skip(&reason, detail);
        }
        for (stamp, entry) in &listing.entries {
            let role = entry.role();
            let (topic, times) = self.topics.entry(role.name().to_owned()).or_default();
            topic.messages += 1;
            times.add(Some(*stamp), None);
            let number = topic.messages;
            self.note_image(role, *stamp);
            if role.is_image() && number % STRIDE != 1 {
                continue;
            }
            match read_entry(*stamp, entry, &self.raw, &ImuConfig::default()) {
                Ok(reading) => {
                    if let Some((topic, _)) = self.topics.get_mut(role.name()) {
                        topic.size = reading.image_size().or(topic.size);
                    }
                    let mut report = std::mem::take(&mut self.report);
                    self.take(reading, false, &mut report);
                    self.report = report;
                }
                Err(Rejection { reason, detail }) => {
                    self.report.skip(&format!("{}: {reason}", role.name()), detail);
                }
            }
        }
    }

    fn take(&mut self, reading: Reading, is_metres: bool, report: &mut ReadReport) {
        let mut whole = Vec::new();
        self.uniter.add(reading, &mut whole, report);
        for reading in whole {
            self.take_whole(reading, is_metres);
        }
    }

    fn take_whole(&mut self, reading: Reading, is_metres: bool) {
        match reading {
            Reading::Color(stamp, image) => {
                self.color.add(&image);
                self.left = self.stereo.is_some().then_some((stamp, image));
            }
            Reading::Right(stamp, right) => {
                let left = self.left.take().filter(|(left, _)| *left == stamp);
                if let (Some(rig), Some((_, left))) = (&self.stereo, left)
                    && let Some((_, depth)) = rig.measure(&left, &right)
                {
                    self.depth.add(&depth, true);
                }
            }
            Reading::Depth(_, image) => self.depth.add(&image, is_metres),
            Reading::Imu(sample) => self.inertial.add_sample(sample),
            Reading::Truth(pose) => self.inertial.add_truth(pose),
            Reading::Gyroscope(..)
            | Reading::Accelerometer(..)
            | Reading::Gnss(_)
            | Reading::Magnetic(_) => {}
        }
    }

    fn note_image(&mut self, role: Role, stamp: Stamp) {
        /// Images may come this much out of order, s.
        const DISORDER: f64 = 5.0;
        match role {
            Role::Color => self.pairing.add_color(stamp, ()),
            Role::Depth | Role::Right => self.pairing.add_depth(stamp, stamp),
            _ => return,
        };
        self.latest_image = self.latest_image.max(Some(stamp));
        if let Some(latest) = self.latest_image {
            self.settle(latest.offset_by(-DISORDER));
        }
    }

    fn settle(&mut self, until: Stamp) {
        let pairs = &mut self.pairs;
        self.pairing.settle(until, |paired| match paired {
            Paired::Pair(color, (), depth) => {
                pairs.frames += 1;
                let difference = depth.seconds_since(color).abs();
                pairs.largest_difference = pairs.largest_difference.max(difference);
            }
            Paired::LoneColor(..) => pairs.lone_color += 1,
            Paired::LoneDepth(..) => pairs.lone_depth += 1,
        });
    }

    fn finish(mut self, summary: LogSummary, assumed: &Assumed) -> Inspection {
        self.settle(Stamp::from_nanos(i64::MAX));
        let (mut rest, mut report) = (Vec::new(), std::mem::take(&mut self.report));
        self.uniter.finish(&mut rest, &mut report);
        self.report = report;
        for reading in rest {
            self.take_whole(reading, false);
        }
        let topics: BTreeMap<String, TopicInspection> = self
            .topics
            .into_iter()
            .map(|(name, (topic, times))| {
                (name, TopicInspection { timing: times.evaluate(), ..topic })
            })
            .collect();
        let used = |name: &String| self.roles.is_empty() || self.roles.contains_key(name);
        let timings = || {
            topics
                .iter()
                .filter(|(name, _)| used(name))
                .filter_map(|(_, topic)| topic.timing.as_ref())
        };
        let first = timings().map(|timing| timing.first).fold(f64::INFINITY, f64::min);
        let last = timings().map(|timing| timing.last).fold(f64::NEG_INFINITY, f64::max);
        self.inertial.sort();
        let imu = self.inertial.evaluate(assumed.body_from_camera.as_ref(), &[]);
        let mut inspection = Inspection {
            summary,
            duration: (last - first).max(0.0),
            topics,
            color: self.color.evaluate(),
            depth: self.depth.evaluate(),
            pairs: self.pairs,
            imu,
            turns: None,
            trial: None,
            skipped: self.report.skipped,
            findings: Vec::new(),
            verdict: Verdict::default(),
            inertial: self.inertial,
        };
        inspection.judge(assumed);
        inspection
    }
}

impl Inspection {
    fn judge(&mut self, assumed: &Assumed) {
        (self.findings, self.verdict) = findings::judge(self, assumed);
    }

    /// Adds what poses of the camera, found from its images alone, say of the IMU: they need not be
    /// of more than [`TURN_SPAN`].
    pub fn with_camera_track(mut self, camera: &[TruthPose], assumed: &Assumed) -> Self {
        self.turns = TurnInspection::of(camera, self.inertial.samples());
        let Some(turns) = &self.turns else { return self };
        let mounting = turns.mounting().map(|rotation| {
            let place = assumed.body_from_camera.map(|known| known.translation);
            Isometry3::from_parts(place.unwrap_or_default(), rotation)
        });
        if let Some(body_from_camera) = mounting {
            let seen: Vec<TruthPose> = camera
                .iter()
                .map(|pose| TruthPose {
                    stamp: pose.stamp.offset_by(turns.time_offset),
                    world_from_body: pose.world_from_body * body_from_camera.inverse(),
                })
                .collect();
            self.imu = self.inertial.evaluate(Some(&body_from_camera), &seen);
        }
        self.judge(assumed);
        self
    }

    /// Adds what came of starting the estimator.
    pub fn with_trial(mut self, trial: Trial, assumed: &Assumed) -> Self {
        self.trial = Some(trial);
        self.judge(assumed);
        self
    }

    /// What is known of the topic or list that plays a role (`color`, `depth`, `imu`, `truth`).
    pub fn topic(&self, role: &str) -> Option<&TopicInspection> {
        let source = self.summary.sources.get(role)?;
        // The files of a folder are told by their role.
        self.topics.get(source).or_else(|| self.topics.get(folder_topic(role)))
    }
}

fn folder_topic(role: &str) -> &str {
    match role {
        "color" => Role::Color.name(),
        "depth" => Role::Depth.name(),
        "right" => Role::Right.name(),
        other => other,
    }
}

fn topic_is_metres(topic: Option<&(TopicInspection, Times)>) -> bool {
    topic.is_some_and(|(topic, _)| topic.encoding.as_deref() == Some("32FC1"))
}

/// Of a message whose type begins with a header.
fn header_stamp(message: &Message) -> Option<Stamp> {
    let (kind, serialization) = message.channel.readable()?;
    if kind == MessageType::Transforms {
        return None;
    }
    Fields::new(message.data, serialization).ok()?.header().ok()
}

#[cfg(test)]
mod tests {
    use super::super::samples;
    use super::*;

    fn inspected(bytes: &[u8]) -> Inspection {
        let folder = tempfile::tempdir().unwrap();
        let path = samples::file(&folder, "log", bytes);
        let (log, imu) = (LogConfig::default(), ImuConfig::default());
        inspect(&path, &Assumed::new(&log, &imu)).unwrap()
    }

    #[test]
    fn every_container_gets_the_same_verdict() {
        let ros1 = samples::recording(false);
        let zstd = mcap::WriteOptions::new().compression(Some(mcap::Compression::Zstd));
        let first = inspected(&samples::bag(&ros1, "none", 8, true).0);
        assert!(first.verdict.fit, "{:?}", first.findings);
        let unit = first.imu.as_ref().unwrap().accelerometer_unit;
        assert_eq!(unit, AccelerometerUnit::StandardGravities);
        assert_eq!((first.pairs.frames, first.topics.len()), (5, 4));
        for (kind, bytes) in [
            ("ROS 1 bag", samples::bag(&ros1, "none", 8, false).0),
            ("ROS 1 bag", samples::bag(&ros1, "bz2", 8, true).0),
            ("ROS 1 bag", samples::bag(&ros1, "lz4", 8, true).0),
            ("MCAP", samples::mcap(&ros1, "ros1", zstd.clone())),
            ("MCAP", samples::mcap(&samples::recording(true), "cdr", zstd)),
        ] {
            let other = inspected(&bytes);
            assert_eq!(other.summary.kind, kind);
            let about_streams = |inspection: &Inspection| -> Vec<Finding> {
                // Log times, and with them the clocks, differ between the two sample formats.
                let findings = inspection.findings.iter();
                findings.filter(|f| !f.message.contains("clocks")).cloned().collect()
            };
            assert_eq!(about_streams(&other), about_streams(&first), "{kind}");
            assert_eq!(other.verdict, first.verdict);
        }
    }

    #[test]
    fn disorder_and_repetition_are_told() {
        let mut samples = samples::recording(false);
        let imu: Vec<usize> =
            (0..samples.len()).filter(|k| samples[*k].topic == samples::IMU).collect();
        samples.swap(imu[20], imu[21]);
        samples[imu[31]] = samples[imu[30]].clone();
        let found = inspected(&samples::bag(&samples, "none", 8, true).0);
        for part in ["1 messages out of order, by up to 0.010 s", "1 messages with the stamp of"] {
            let about = |f: &&Finding| f.subject == "imu" && f.message.contains(part);
            assert_eq!(found.findings.iter().filter(about).count(), 1, "{:?}", found.findings);
        }
    }
}
