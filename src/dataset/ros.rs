//! ROS logs, whatever their container: which topic plays which role, and messages to readings.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;

use super::calibration::{Observed, Streams};
use super::compressed::CompressedHead;
use super::decode::Decoder;
use super::encoding::{ColorEncoding, DepthEncoding, SUPPORTED_COLOR, SUPPORTED_DEPTH};
use super::found::{FoundCalibration, FoundSetting};
use super::message::{self, Fields, MessageType, Serialization};
use super::navigation::NavigationTopics;
use super::pixels::Rejection;
use super::write::{CAMERA, CONFIGURATION};
use super::{LogConfig, LogError, LogSummary, ReadReport, topics};
use crate::inertial::ImuConfig;
use crate::sensor::{CameraConfig, Stamp};
use crate::vision::StereoRig;

/// A connection of a bag or a channel of an MCAP file.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Channel {
    pub topic: String,
    /// Name of the message type, as logged.
    pub schema: String,
    /// Text of the message type's definition, as logged.
    pub definition: String,
    /// `None` for a type that is not read.
    pub kind: Option<MessageType>,
    /// `None` for one that is not read.
    pub serialization: Option<Serialization>,
    /// Notes of whoever wrote the log.
    pub metadata: BTreeMap<String, String>,
}

impl Channel {
    /// Type and serialization of messages that are read.
    pub fn readable(&self) -> Option<(MessageType, Serialization)> {
        self.kind.zip(self.serialization)
    }
}

/// Where a message is in its file.
#[derive(Debug, Clone, Copy)]
pub(super) enum Place {
    /// Where its record begins, bytes.
    Record(u64),
    /// Where the chunk that contains it begins, bytes, and the number of its record there, from 1.
    Chunk(u64, u64),
    /// Its row in a database.
    Row(i64),
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Record(offset) => write!(f, "record at byte {offset}"),
            Self::Chunk(offset, record) => {
                write!(f, "record {record} of the chunk at byte {offset}")
            }
            Self::Row(row) => write!(f, "row {row}"),
        }
    }
}

/// A message as it is logged.
pub(super) struct Message<'a> {
    pub channel: &'a Channel,
    /// On the clock of whoever logged it.
    pub log_time: Stamp,
    /// Serialised.
    pub data: &'a [u8],
    pub place: Place,
}

pub(super) type Visitor<'a> = dyn FnMut(&Message, &mut ReadReport) + 'a;

/// The messages of a log in the order in which they were logged.
pub(super) trait MessageSource: Send {
    /// Channels met so far, or all where [`Self::is_indexed`].
    fn channels(&self) -> Vec<&Channel>;

    /// Whether the log's index listed its channels when it was opened.
    fn is_indexed(&self) -> bool;

    /// Passes over messages of other topics from now on.
    fn only(&mut self, topics: Vec<String>);

    /// Hands the next message to `visitor`; `false` at the end of what can be read.
    fn visit_next(&mut self, report: &mut ReadReport, visitor: &mut Visitor) -> bool;
}

/// What a stream of a log is used as.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Role {
    Color,
    Depth,
    /// The IMU, or its gyroscope where the accelerometer has a topic of its own.
    Imu,
    Accelerometer,
    Truth,
    /// The right one of two cameras.
    Right,
    Gnss,
    Magnetic,
}

impl Role {
    /// What odometry uses. A topic is chosen for the right camera once it is known that there is no
    /// depth, and for the accelerometer once that for the gyroscope is known.
    const ALL: [Self; 6] =
        [Self::Color, Self::Depth, Self::Right, Self::Imu, Self::Accelerometer, Self::Truth];

    /// Its key in [`LogSummary::sources`].
    pub fn key(self) -> &'static str {
        match self {
            Self::Color => "color",
            Self::Depth => "depth",
            Self::Imu => "imu",
            Self::Accelerometer => "accelerometer",
            Self::Truth => "truth",
            Self::Right => "right",
            Self::Gnss => "gnss",
            Self::Magnetic => "magnetic",
        }
    }

    /// The key of [`LogConfig`] with its topic.
    fn setting(self) -> String {
        match self {
            Self::Accelerometer => "accel_topic".to_owned(),
            role => format!("{}_topic", role.key()),
        }
    }

    pub fn is_image(self) -> bool {
        matches!(self, Self::Color | Self::Depth | Self::Right)
    }

    pub fn name(self) -> &'static str {
        match self {
            Self::Color => "color image",
            Self::Depth => "depth image",
            Self::Imu => "imu",
            Self::Accelerometer => "accelerometer",
            Self::Truth => "truth",
            Self::Right => "right image",
            Self::Gnss => "gnss",
            Self::Magnetic => "magnetic field",
        }
    }

    pub fn configured(self, config: &LogConfig) -> &str {
        match self {
            Self::Color => &config.color_topic,
            Self::Depth => &config.depth_topic,
            Self::Imu => &config.imu_topic,
            Self::Accelerometer => &config.accel_topic,
            Self::Truth => &config.truth_topic,
            Self::Right => &config.right_topic,
            Self::Gnss | Self::Magnetic => "none",
        }
    }

    pub fn takes(self, kind: MessageType) -> bool {
        use MessageType::*;
        match self {
            Self::Color | Self::Depth | Self::Right => matches!(kind, Image | CompressedImage),
            Self::Imu | Self::Accelerometer => kind == Imu,
            Self::Gnss => matches!(kind, NavSatFix | NmeaSentence),
            Self::Magnetic => matches!(kind, MagneticField | Vector3Stamped),
            Self::Truth => matches!(kind, PoseStamped | TransformStamped | Odometry),
        }
    }
}

/// How many messages, and bytes of them, are looked at before the topics are chosen.
const SURVEY_MESSAGES: usize = 10_000;
const SURVEY_BYTES: usize = 64 << 20;

/// IMU messages looked at to tell g from m/s^2, and which halves of an IMU they hold.
const SURVEY_IMU_SAMPLES: usize = 40;

/// Median specific force below this is taken for g, above for m/s^2.
const LARGEST_MEDIAN_IN_G: f64 = 4.0;

/// What the first messages tell of a topic.
#[derive(Debug, Clone)]
struct Topic {
    schema: String,
    kind: Option<MessageType>,
    /// Of the first image.
    image: Option<ImageHead>,
    /// Norms of the first accelerometer readings, as logged.
    accelerations: Vec<f64>,
    halves: Halves,
}

/// How many of a topic's first IMU messages hold which halves of an IMU; a half is not there if its
/// covariance says so, or if it is zero to the last bit.
#[derive(Debug, Clone, Copy, Default)]
struct Halves {
    both: usize,
    gyroscope: usize,
    accelerometer: usize,
}

/// What the messages of an IMU topic hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ImuContent {
    Whole,
    Gyroscope,
    Accelerometer,
    /// Now the one, now the other.
    Alternating,
}

impl Halves {
    fn count(&self) -> usize {
        self.both + self.gyroscope + self.accelerometer
    }

    fn content(&self) -> ImuContent {
        match self {
            Self { both: 0, gyroscope: 0, accelerometer: 1.. } => ImuContent::Accelerometer,
            Self { both: 0, gyroscope: 1.., accelerometer: 0 } => ImuContent::Gyroscope,
            Self { both: 0, gyroscope: 1.., accelerometer: 1.. } => ImuContent::Alternating,
            _ => ImuContent::Whole,
        }
    }
}

impl Topic {
    fn new(channel: &Channel) -> Self {
        Self {
            schema: channel.schema.clone(),
            kind: channel.readable().map(|(kind, _)| kind),
            image: None,
            accelerations: Vec::new(),
            halves: Halves::default(),
        }
    }

    fn size(&self) -> Option<(u32, u32)> {
        self.image.as_ref()?.size
    }

    fn is_image(&self) -> bool {
        matches!(self.kind, Some(MessageType::Image | MessageType::CompressedImage))
    }

    fn observe(&mut self, message: &Message) -> Result<(), Rejection> {
        match message.channel.readable() {
            Some((MessageType::Imu, serialization)) if self.halves.count() < SURVEY_IMU_SAMPLES => {
                let fields = Fields::new(message.data, serialization)?;
                let reading = message::imu(fields, &ImuConfig::default())?.without_zeros();
                let halves = &mut self.halves;
                match (reading.angular_velocity, reading.specific_force) {
                    (Some(_), Some(_)) => halves.both += 1,
                    (Some(_), None) => halves.gyroscope += 1,
                    (None, Some(_)) => halves.accelerometer += 1,
                    (None, None) => halves.both += 1,
                }
                self.accelerations.extend(reading.specific_force.map(|force| force.norm()));
            }
            _ if self.image.is_none() => self.image = ImageHead::of(message)?,
            _ => {}
        }
        Ok(())
    }

    /// How well it suits `role`, smaller being better; `None` if not at all.
    fn rank(&self, name: &str, role: Role, color_size: Option<(u32, u32)>) -> Option<u32> {
        let kind = self.kind.filter(|kind| role.takes(*kind))?;
        let raw = kind == MessageType::Image;
        match role {
            Role::Color => match self.image.as_ref()?.usage {
                ImageUsage::Color { is_grey } => {
                    Some(if is_grey { 2 } else { 0 } + u32::from(!raw))
                }
                ImageUsage::GreyOrDepth => Some(4),
                ImageUsage::Depth | ImageUsage::Unsupported => None,
            },
            Role::Depth => match self.image.as_ref()?.usage {
                ImageUsage::Depth if raw => Some(u32::from(self.size() != color_size)),
                ImageUsage::Depth => Some(2),
                ImageUsage::GreyOrDepth => Some(3),
                ImageUsage::Color { .. } | ImageUsage::Unsupported => None,
            },
            Role::Right => {
                self.rank(name, Role::Color, color_size).filter(|_| self.size() == color_size)
            }
            Role::Imu => Some(match self.halves.content() {
                _ if self.halves.count() == 0 => 4,
                ImuContent::Whole => 0,
                ImuContent::Alternating => 1,
                ImuContent::Gyroscope => 2,
                ImuContent::Accelerometer => 3,
            }),
            Role::Accelerometer => None,
            Role::Gnss => Some(u32::from(kind == MessageType::NmeaSentence)),
            // Vectors of any kind are published so.
            Role::Magnetic if kind == MessageType::Vector3Stamped => {
                name.to_lowercase().contains("mag").then_some(1)
            }
            Role::Magnetic => Some(0),
            Role::Truth if topics::is_no_reference(name) => None,
            Role::Truth => match kind {
                MessageType::PoseStamped => Some(0),
                MessageType::TransformStamped => Some(1),
                // Most odometry topics are estimates, not a reference.
                _ => topics::is_reference(name).then_some(2),
            },
        }
    }

    fn logs_g(&self) -> bool {
        let mut norms = self.accelerations.clone();
        norms.sort_by(f64::total_cmp);
        norms.get(norms.len() / 2).is_some_and(|median| *median < LARGEST_MEDIAN_IN_G)
    }
}

/// What an image message says of itself.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ImageHead {
    /// Name of the encoding or, of a compressed image, of its format.
    pub encoding: String,
    /// Width and height, where they are told.
    pub size: Option<(u32, u32)>,
    usage: ImageUsage,
}

/// What an image may be used as, by its encoding.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ImageUsage {
    Color {
        is_grey: bool,
    },
    Depth,
    /// `mono16`, which is both.
    GreyOrDepth,
    Unsupported,
}

impl ImageHead {
    /// `None` for a message of another type.
    pub fn of(message: &Message) -> Result<Option<Self>, Rejection> {
        let Some((kind, serialization)) = message.channel.readable() else { return Ok(None) };
        let fields = || Fields::new(message.data, serialization);
        Ok(match kind {
            MessageType::Image => {
                let (_, image) = message::image(fields()?)?;
                Some(Self::raw(image.encoding, (image.width, image.height)))
            }
            MessageType::CompressedImage => {
                let image = message::compressed_image(fields()?)?;
                Some(Self::compressed(CompressedHead::of(&image)?))
            }
            _ => None,
        })
    }

    fn raw(encoding: &str, size: (u32, u32)) -> Self {
        let color = ColorEncoding::parse(encoding, &LogConfig::default());
        let usage = match (color, DepthEncoding::parse(encoding)) {
            (Some(_), Some(_)) => ImageUsage::GreyOrDepth,
            (Some(color), None) => ImageUsage::Color { is_grey: color.is_grey() },
            (None, Some(_)) => ImageUsage::Depth,
            (None, None) => ImageUsage::Unsupported,
        };
        Self { encoding: encoding.to_owned(), size: Some(size), usage }
    }

    fn compressed(head: CompressedHead) -> Self {
        let usage = match (head.is_supported, head.is_depth) {
            (true, true) => ImageUsage::Depth,
            (true, false) => ImageUsage::Color { is_grey: head.encoding.contains("mono8") },
            (false, _) => ImageUsage::Unsupported,
        };
        Self { encoding: head.encoding, size: head.size, usage }
    }

    /// Whether it can be decoded for `role`.
    fn suits(&self, role: Role) -> bool {
        match self.usage {
            ImageUsage::Color { .. } => role != Role::Depth,
            ImageUsage::Depth => role == Role::Depth,
            ImageUsage::GreyOrDepth => true,
            ImageUsage::Unsupported => false,
        }
    }
}

/// Messages of each topic that has rivals that are looked at to tell their rates.
const SURVEY_RIVALS: u32 = 10;

/// Whether enough is known of topics that compete for a role, and of those with calibrations.
fn is_compared(topics: &BTreeMap<String, Topic>, observed: &Observed) -> bool {
    let rivals = |kind| topics.values().filter(|topic| topic.kind == Some(kind)).count();
    topics.iter().all(|(name, topic)| match topic.kind {
        Some(MessageType::CameraInfo) => observed.count(name) > 0,
        Some(MessageType::Transforms) => observed.has_transforms_of(name),
        Some(
            kind @ (MessageType::Imu
            | MessageType::Image
            | MessageType::CompressedImage
            | MessageType::PoseStamped),
        ) => rivals(kind) < 2 || observed.count(name) >= SURVEY_RIVALS,
        _ => true,
    })
}

/// The topics of a log, by name.
#[derive(Debug, Clone)]
pub(super) struct Survey {
    topics: BTreeMap<String, Topic>,
    /// As this program noted them when it wrote the log.
    configuration: Option<String>,
    camera: Option<CameraConfig>,
    observed: Observed,
}

impl Survey {
    /// Reads the first messages; `messages` is to be opened anew afterwards.
    pub fn new(messages: &mut dyn MessageSource) -> Self {
        let mut topics: BTreeMap<String, Topic> = BTreeMap::new();
        let (mut count, mut bytes) = (0, 0);
        let mut observed = Observed::default();
        for channel in messages.channels() {
            topics.entry(channel.topic.clone()).or_insert_with(|| Topic::new(channel));
        }
        // Faults are reported when the log is read in earnest.
        let mut unreported = ReadReport::default();
        while count < SURVEY_MESSAGES && bytes < SURVEY_BYTES {
            let more = messages.visit_next(&mut unreported, &mut |message, _| {
                let channel = message.channel;
                let topic =
                    topics.entry(channel.topic.clone()).or_insert_with(|| Topic::new(channel));
                let _ = topic.observe(message);
                if let Some(kind) = channel.readable() {
                    let _ = observed.observe(&channel.topic, kind, message.data);
                }
                count += 1;
                bytes += message.data.len();
            });
            let known = |topic: &Topic| {
                (!topic.is_image() || topic.image.is_some())
                    && (topic.kind != Some(MessageType::Imu)
                        || topic.halves.count() == SURVEY_IMU_SAMPLES)
            };
            let is_surveyed = topics.values().all(known) && is_compared(&topics, &observed);
            if !more || messages.is_indexed() && is_surveyed {
                break;
            }
        }
        let note = |key| messages.channels().iter().find_map(|c| c.metadata.get(key).cloned());
        let camera = note(CAMERA).and_then(|text| serde_json::from_str(&text).ok());
        Self { topics, configuration: note(CONFIGURATION), camera, observed }
    }

    /// Topics with their types and encodings, for messages to the user.
    fn describe(&self) -> String {
        let describe = |(name, topic): (&String, &Topic)| match &topic.image {
            Some(image) => format!("{name} ({} {})", topic.schema, image.encoding),
            None => format!("{name} ({})", topic.schema),
        };
        let topics: Vec<_> = self.topics.iter().map(describe).collect();
        if topics.is_empty() { "no topics".to_owned() } else { topics.join(", ") }
    }

    /// The topics that can play a role, the best first, beside the color image `chosen`.
    fn ranked(
        &self,
        role: Role,
        chosen: &BTreeMap<Role, String>,
        color_size: Option<(u32, u32)>,
    ) -> Vec<&String> {
        let color = chosen.get(&Role::Color).map(String::as_str);
        let depths: Vec<&str> = match role {
            Role::Color => self.playing(Role::Depth, color_size).map(|(_, name)| &**name).collect(),
            _ => Vec::new(),
        };
        let observed = &self.observed;
        let preference = |name: &str, rank: u32| match role {
            Role::Color | Role::Right => topics::color(observed, name, rank, &depths),
            Role::Depth => topics::depth(observed, name, rank, color),
            Role::Truth => topics::truth(observed, name, rank),
            _ => topics::imu(observed, name, rank, color),
        };
        let mut ranked: Vec<_> = self
            .playing(role, color_size)
            .map(|(rank, name)| (preference(name, rank), name))
            .collect();
        ranked.sort();
        ranked.into_iter().map(|(_, name)| name).collect()
    }

    /// The topics that can play a role and how well what they hold suits it.
    fn playing(
        &self,
        role: Role,
        color_size: Option<(u32, u32)>,
    ) -> impl Iterator<Item = (u32, &String)> {
        let usage = |topic: &Topic| topic.image.as_ref().map(|image| image.usage);
        let has_depth = self.topics.values().any(|topic| usage(topic) == Some(ImageUsage::Depth));
        // What may be either is depth unless something else is.
        let is_open = move |topic: &Topic| {
            has_depth || role != Role::Color || usage(topic) != Some(ImageUsage::GreyOrDepth)
        };
        let topics = self.topics.iter().filter(move |(_, topic)| is_open(topic));
        topics.filter_map(move |(name, topic)| {
            topic.rank(name, role, color_size).map(|rank| (rank, name))
        })
    }

    /// What was chosen and what else there is, a line for each role left open.
    pub fn choices(&self, chosen: &BTreeMap<Role, String>, config: &LogConfig) -> Vec<String> {
        let open = chosen.iter().filter(|(role, _)| role.configured(config).is_empty());
        let line = |(role, topic): (&Role, &String)| {
            let others = self.alternatives(*role, chosen);
            let others = match others.is_empty() {
                true => String::new(),
                false => format!("; not {} (log.{})", others.join(", "), role.setting()),
            };
            format!("{}: {}{others}", role.name(), self.with_rate(topic))
        };
        open.map(line).collect()
    }

    /// The other topics that could play a role, with their rates.
    fn alternatives(&self, role: Role, chosen: &BTreeMap<Role, String>) -> Vec<String> {
        let color = chosen.get(&Role::Color).and_then(|name| self.topics.get(name));
        let size = color.and_then(Topic::size);
        let others = self.ranked(role, chosen, size).into_iter();
        others
            .filter(|name| !chosen.values().any(|used| used == *name))
            .map(|name| self.with_rate(name))
            .collect()
    }

    fn with_rate(&self, topic: &str) -> String {
        match self.observed.rate(topic) {
            Some(rate) => format!("{topic} ({} Hz)", (rate * 100.0).round() / 100.0),
            None => topic.to_owned(),
        }
    }

    fn config_name(&self) -> &str {
        if let Some(name) = &self.configuration {
            return name;
        }
        let is = |name: &str, role: Role| {
            let topic = self.topics.get(name);
            topic.is_some_and(|topic| topic.kind.is_some_and(|kind| role.takes(kind)))
        };
        if is("/cam0/image_raw", Role::Color) && is("/cam1/image_raw", Role::Right) {
            return "euroc";
        }
        let layout = is("/cam0/color", Role::Color)
            && is("/cam0/depth", Role::Depth)
            && is("/imu", Role::Imu);
        // The same topics may come from a log that was converted to SI units, or from another
        // recorder, whose accelerometer in g need not be inverted as theirs is.
        let in_g = self.topics.get("/imu").is_some_and(Topic::logs_g);
        let image = self.topics.get("/cam0/color").and_then(|topic| topic.image.as_ref());
        let is_theirs = image.is_none_or(|image| image.encoding == "8UC3");
        match () {
            () if layout && in_g && is_theirs => "vcu_rvi",
            // This program's notes are in logs that it simulated.
            () if self.camera.is_some() => "sim",
            () => "generic",
        }
    }

    /// Chooses a topic for each role; `Err` names the first that is configured but not there.
    pub fn choose(&self, config: &LogConfig) -> Result<BTreeMap<Role, String>, Role> {
        let mut chosen: BTreeMap<Role, String> = BTreeMap::new();
        let mut color_size = None;
        let has_right = !["", "none"].contains(&config.right_topic.as_str());
        for role in Role::ALL {
            let name = match role.configured(config) {
                "none" => None,
                "" if role == Role::Depth && has_right => None,
                "" if role == Role::Right => self.partner(config, &chosen, color_size),
                "" if role == Role::Accelerometer => self.other_half(&chosen),
                "" => self.ranked(role, &chosen, color_size).first().copied(),
                wanted => Some(self.configured(role, wanted).ok_or(role)?),
            };
            if let Some(name) = name {
                if role == Role::Color {
                    color_size = self.topics.get(name).and_then(Topic::size);
                }
                chosen.insert(role, name.clone());
            }
        }
        if config.imu_topic.is_empty() && self.is_lone_gyroscope(&chosen) {
            chosen.remove(&Role::Imu);
        }
        Ok(chosen)
    }

    /// Whether the chosen IMU is a gyroscope without an accelerometer.
    fn is_lone_gyroscope(&self, chosen: &BTreeMap<Role, String>) -> bool {
        let imu = chosen.get(&Role::Imu);
        imu.is_some_and(|imu| self.imu_content(imu) == ImuContent::Gyroscope)
            && !chosen.contains_key(&Role::Accelerometer)
    }

    /// A topic of a gyroscope that cannot be used as no topic has the accelerometer.
    pub fn lone_gyroscope(&self) -> Option<&String> {
        let with = |content| self.topics.keys().find(|name| self.imu_content(name) == content);
        with(ImuContent::Gyroscope).filter(|_| with(ImuContent::Accelerometer).is_none())
    }

    /// The accelerometer that belongs to the chosen gyroscope: of several the one whose name begins
    /// like the gyroscope's.
    fn other_half(&self, chosen: &BTreeMap<Role, String>) -> Option<&String> {
        let gyroscope = chosen.get(&Role::Imu)?;
        if self.imu_content(gyroscope) != ImuContent::Gyroscope {
            return None;
        }
        let alike =
            |name: &str| name.bytes().zip(gyroscope.bytes()).take_while(|(a, b)| a == b).count();
        let halves =
            self.topics.keys().filter(|name| self.imu_content(name) == ImuContent::Accelerometer);
        halves.max_by_key(|name| (alike(name), std::cmp::Reverse(*name)))
    }

    /// What the messages of an IMU topic hold; [`ImuContent::Whole`] where that is not known.
    fn imu_content(&self, topic: &str) -> ImuContent {
        self.topics.get(topic).map_or(ImuContent::Whole, |topic| topic.halves.content())
    }

    /// How the chosen topics are to be decoded.
    pub fn decoder(
        &self,
        chosen: &BTreeMap<Role, String>,
        log: &LogConfig,
        imu: &ImuConfig,
    ) -> Decoder {
        let content = match chosen.get(&Role::Imu) {
            Some(_) if chosen.contains_key(&Role::Accelerometer) => ImuContent::Gyroscope,
            Some(topic) if self.imu_content(topic) == ImuContent::Alternating => {
                ImuContent::Alternating
            }
            _ => ImuContent::Whole,
        };
        Decoder::new(log, imu, content)
    }

    /// Topics of inertial, magnetic and satellite readings; `Err` names the role of a topic that is
    /// given and not there. Roles without a topic are left out.
    pub fn choose_navigation(
        &self,
        topics: &NavigationTopics,
    ) -> Result<BTreeMap<Role, String>, Role> {
        let mut chosen = BTreeMap::new();
        let wanted = [
            (Role::Imu, &topics.imu),
            (Role::Gnss, &topics.gnss),
            (Role::Magnetic, &topics.magnetic),
        ];
        for (role, wanted) in wanted {
            let name = match wanted.as_str() {
                "none" => None,
                "" => self.ranked(role, &chosen, None).first().copied(),
                wanted => Some(self.configured(role, wanted).ok_or(role)?),
            };
            chosen.extend(name.map(|name| (role, name.clone())));
        }
        let accelerometer = self.other_half(&chosen).cloned();
        chosen.extend(accelerometer.map(|name| (Role::Accelerometer, name)));
        Ok(chosen)
    }

    /// The topic `wanted`, if it is there and can play `role`.
    fn configured(&self, role: Role, wanted: &str) -> Option<&String> {
        let (name, topic) = self.topics.get_key_value(wanted)?;
        topic.kind.is_some_and(|kind| role.takes(kind)).then_some(name)
    }

    /// The second of two cameras, where depth is wanted and not logged.
    fn partner(
        &self,
        config: &LogConfig,
        chosen: &BTreeMap<Role, String>,
        color_size: Option<(u32, u32)>,
    ) -> Option<&String> {
        let color = chosen.get(&Role::Color)?;
        if chosen.contains_key(&Role::Depth) || !config.depth_topic.is_empty() {
            return None;
        }
        let encoding = |topic: &Topic| topic.image.as_ref().map(|image| image.encoding.clone());
        let color_encoding = encoding(self.topics.get(color)?);
        let is_like_color = |name: &&String| {
            *name != color
                && self.topics.get(*name).is_some_and(|topic| encoding(topic) == color_encoding)
        };
        self.ranked(Role::Right, chosen, color_size).into_iter().find(is_like_color)
    }

    /// The two cameras, where depth comes from them.
    pub fn rig(
        &self,
        path: &Path,
        chosen: &BTreeMap<Role, String>,
        config: &LogConfig,
    ) -> Result<Option<StereoRig>, LogError> {
        if !chosen.contains_key(&Role::Right) {
            return Ok(None);
        }
        let failed = |reason: String| LogError::Stereo { path: path.to_path_buf(), reason };
        let [left, right] = &config.stereo[..] else {
            return Err(failed("set their calibrations in `log.stereo`".to_owned()));
        };
        let color = chosen.get(&Role::Color).and_then(|name| self.topics.get(name));
        let Some((width, height)) = color.and_then(Topic::size) else {
            return Err(failed("no image of the left one could be read".to_owned()));
        };
        StereoRig::new(left, right, (width as usize, height as usize))
            .map(Some)
            .map_err(|error| failed(error.to_string()))
    }

    /// Without the demand that the log be complete.
    pub fn summary(&self, kind: &str, config: &LogConfig) -> LogSummary {
        let chosen = self.choose(config).unwrap_or_default();
        self.summary_of(kind, &chosen, None)
    }

    /// The error that `topic` cannot be decoded for `role`, if that is so.
    pub fn check_encoding(&self, path: &Path, role: Role, topic: &str) -> Result<(), LogError> {
        let image = self.topics.get(topic).and_then(|topic| topic.image.as_ref());
        match image.filter(|image| role.is_image() && !image.suits(role)) {
            Some(image) => Err(LogError::Encoding {
                path: path.to_path_buf(),
                topic: topic.to_owned(),
                encoding: image.encoding.trim().to_owned(),
                supported: if role == Role::Depth { SUPPORTED_DEPTH } else { SUPPORTED_COLOR },
            }),
            None => Ok(()),
        }
    }

    /// The error that depth images have other pixels than color images.
    pub fn check_sizes(
        &self,
        path: &Path,
        chosen: &BTreeMap<Role, String>,
    ) -> Result<(), LogError> {
        let stream = |role: Role| {
            let topic = chosen.get(&role)?;
            Some((topic.clone(), self.topics.get(topic)?.size()?))
        };
        match stream(Role::Color).zip(stream(Role::Depth)) {
            Some(((color, color_size), (depth, depth_size))) if color_size != depth_size => {
                let path = path.to_path_buf();
                Err(LogError::Unregistered { path, color, color_size, depth, depth_size })
            }
            _ => Ok(()),
        }
    }

    /// An image topic that would have been taken for `role`, were its encoding read.
    fn unreadable(&self, role: Role) -> Option<&String> {
        let is_depth = |name: &str, image: &ImageHead| {
            ["depth", "16uc1", "32fc1"].iter().any(|word| {
                name.to_lowercase().contains(word) || image.encoding.to_lowercase().contains(word)
            })
        };
        let mut topics = self.topics.iter().filter_map(|(name, topic)| {
            let image = topic.image.as_ref().filter(|i| i.usage == ImageUsage::Unsupported)?;
            (is_depth(name, image) == (role == Role::Depth)).then_some(name)
        });
        topics.next()
    }

    /// `role` is not there, or not in an encoding that is read.
    pub fn missing(&self, path: &Path, role: Role) -> LogError {
        let unreadable = self.unreadable(role).filter(|_| role.is_image());
        if let Some(Err(error)) = unreadable.map(|topic| self.check_encoding(path, role, topic)) {
            return error;
        }
        let available = self.describe();
        LogError::MissingStream { path: path.to_path_buf(), role: role.name(), available }
    }

    pub fn summary_of(
        &self,
        kind: &str,
        chosen: &BTreeMap<Role, String>,
        rig: Option<&StereoRig>,
    ) -> LogSummary {
        LogSummary {
            kind: kind.to_owned(),
            config_name: self.config_name().to_owned(),
            has_imu: chosen.contains_key(&Role::Imu),
            has_truth: chosen.contains_key(&Role::Truth),
            sources: chosen
                .iter()
                .map(|(role, name)| (role.key().to_owned(), name.clone()))
                .collect(),
            lone_gyroscope: self
                .lone_gyroscope()
                .filter(|_| !chosen.contains_key(&Role::Imu))
                .cloned(),
            frames: None,
            camera: rig.map(StereoRig::camera).or(self.camera.as_ref()).cloned(),
            stereo: rig.map(|rig| rig.cameras().to_vec()).unwrap_or_default(),
            calibration: self.calibration(chosen),
            others: chosen
                .keys()
                .map(|role| (role.key().to_owned(), self.alternatives(*role, chosen)))
                .filter(|(_, others)| !others.is_empty())
                .collect(),
        }
    }

    /// What the log tells of the calibration of the chosen topics.
    fn calibration(&self, chosen: &BTreeMap<Role, String>) -> FoundCalibration {
        let topic = |role| chosen.get(&role).map(String::as_str);
        let color = topic(Role::Color);
        let streams = Streams {
            color,
            color_size: color.and_then(|name| self.topics.get(name)?.size()),
            depth: topic(Role::Depth),
            depth_size: topic(Role::Depth).and_then(|name| self.topics.get(name)?.size()),
            right: topic(Role::Right),
            imu: topic(Role::Imu),
            truth: topic(Role::Truth),
        };
        let mut found = self.observed.settings(&streams);
        let in_g =
            topic(Role::Imu).filter(|name| self.topics.get(*name).is_some_and(Topic::logs_g));
        // A shipped configuration knows the unit.
        if let Some(name) = in_g.filter(|_| self.config_name() == "generic") {
            let source = format!("readings of {name} have the size of 1 g");
            let gravity = ImuConfig::default().gravity;
            let setting = FoundSetting::from_log("imu.accelerometer_scale", gravity, &source);
            found.settings.push(setting);
        }
        found
    }
}
