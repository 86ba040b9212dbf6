//! ROS logs, whatever their container: which topic plays which role, and messages to readings.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;

use super::merge::{Reading, ReadingSource};
use super::message::{self, Fields, MessageType, Serialization};
use super::pixels::{
    Rejection, color_format, compressed_color, compressed_depth, compressed_size,
    is_depth_encoding, raw_color, raw_depth,
};
use super::write::{CAMERA, CONFIGURATION};
use super::{LogConfig, LogError, LogSummary, ReadReport};
use crate::inertial::ImuConfig;
use crate::sensor::{CameraConfig, PixelFormat, Stamp};
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

/// Where a record is in its file.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place {
    /// Of the record, or of the chunk that contains it, bytes.
    pub offset: u64,
    /// Number of the record in its chunk, from 1.
    pub record: Option<u64>,
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.record {
            Some(record) => write!(f, "record {record} of the chunk at byte {}", self.offset),
            None => write!(f, "record at byte {}", self.offset),
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
    Imu,
    Truth,
    /// The right one of two cameras.
    Right,
}

impl Role {
    /// A topic is chosen for the right camera once it is known that there is no depth.
    const ALL: [Self; 5] = [Self::Color, Self::Depth, Self::Right, Self::Imu, Self::Truth];

    /// Its key in [`LogSummary::sources`].
    fn key(self) -> &'static str {
        match self {
            Self::Color => "color",
            Self::Depth => "depth",
            Self::Imu => "imu",
            Self::Truth => "truth",
            Self::Right => "right",
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
            Self::Truth => "truth",
            Self::Right => "right image",
        }
    }

    fn configured(self, config: &LogConfig) -> &str {
        match self {
            Self::Color => &config.color_topic,
            Self::Depth => &config.depth_topic,
            Self::Imu => &config.imu_topic,
            Self::Truth => &config.truth_topic,
            Self::Right => &config.right_topic,
        }
    }

    fn takes(self, kind: MessageType) -> bool {
        use MessageType::*;
        match self {
            Self::Color | Self::Depth | Self::Right => matches!(kind, Image | CompressedImage),
            Self::Imu => kind == Imu,
            Self::Truth => matches!(kind, PoseStamped | TransformStamped | Odometry),
        }
    }
}

/// How many messages, and bytes of them, are looked at before the topics are chosen.
const SURVEY_MESSAGES: usize = 10_000;
const SURVEY_BYTES: usize = 64 << 20;

/// IMU samples looked at to tell g from m/s^2.
const SURVEY_IMU_SAMPLES: usize = 10;

/// Median specific force below this is taken for g, above for m/s^2.
const LARGEST_MEDIAN_IN_G: f64 = 4.0;

/// What the first messages tell of a topic.
#[derive(Debug, Clone)]
struct Topic {
    schema: String,
    kind: Option<MessageType>,
    /// Of the first image, and its width and height where they are known.
    encoding: Option<String>,
    size: Option<(u32, u32)>,
    /// Norms of the first accelerometer readings, as logged.
    accelerations: Vec<f64>,
}

impl Topic {
    fn new(channel: &Channel) -> Self {
        Self {
            schema: channel.schema.clone(),
            kind: channel.readable().map(|(kind, _)| kind),
            encoding: None,
            size: None,
            accelerations: Vec::new(),
        }
    }

    fn is_image(&self) -> bool {
        matches!(self.kind, Some(MessageType::Image | MessageType::CompressedImage))
    }

    fn observe(&mut self, message: &Message) -> Result<(), Rejection> {
        match message.channel.readable() {
            Some((MessageType::Imu, serialization))
                if self.accelerations.len() < SURVEY_IMU_SAMPLES =>
            {
                let fields = Fields::new(message.data, serialization)?;
                let sample = message::imu(fields, &ImuConfig::default())?;
                self.accelerations.push(sample.specific_force.norm());
            }
            _ if self.encoding.is_none() => {
                (self.encoding, self.size) = encoding_and_size(message)?;
            }
            _ => {}
        }
        Ok(())
    }

    /// How well it suits `role`, smaller being better; `None` if not at all.
    fn rank(&self, name: &str, role: Role, color_size: Option<(u32, u32)>) -> Option<u32> {
        let kind = self.kind.filter(|kind| role.takes(*kind))?;
        let encoding = self.encoding.as_deref();
        match role {
            Role::Color if kind == MessageType::Image => {
                color_format(encoding?, &LogConfig::default())
                    .map(|format| if format == PixelFormat::Mono8 { 2 } else { 0 })
            }
            Role::Color => match encoding? {
                format if message::is_depth_format(format) => None,
                format => Some(if format.contains("mono8") { 3 } else { 1 }),
            },
            Role::Depth if kind == MessageType::Image => {
                is_depth_encoding(encoding?).then_some(u32::from(self.size != color_size))
            }
            Role::Depth => message::is_depth_format(encoding?).then_some(2),
            Role::Right => {
                self.rank(name, Role::Color, color_size).filter(|_| self.size == color_size)
            }
            Role::Imu => Some(u32::from(self.accelerations.is_empty())),
            Role::Truth => match kind {
                MessageType::PoseStamped => Some(0),
                MessageType::TransformStamped => Some(1),
                // Most odometry topics are estimates, not a reference.
                _ => ["truth", "gt", "mocap", "vicon"]
                    .iter()
                    .any(|word| name.contains(word))
                    .then_some(2),
            },
        }
    }

    fn logs_g(&self) -> bool {
        let mut norms = self.accelerations.clone();
        norms.sort_by(f64::total_cmp);
        norms.get(norms.len() / 2).is_some_and(|median| *median < LARGEST_MEDIAN_IN_G)
    }
}

type EncodingAndSize = (Option<String>, Option<(u32, u32)>);

/// Encoding, width and height of an image, as far as the message tells them.
pub(super) fn encoding_and_size(message: &Message) -> Result<EncodingAndSize, Rejection> {
    let Some((kind, serialization)) = message.channel.readable() else { return Ok((None, None)) };
    let fields = Fields::new(message.data, serialization)?;
    Ok(match kind {
        MessageType::Image => {
            let (_, image) = message::image(fields)?;
            (Some(image.encoding.to_owned()), Some((image.width, image.height)))
        }
        MessageType::CompressedImage => {
            let image = message::compressed_image(fields)?;
            (Some(image.format.to_owned()), compressed_size(image.data))
        }
        _ => (None, None),
    })
}

/// The topics of a log, by name.
#[derive(Debug, Clone)]
pub(super) struct Survey {
    topics: BTreeMap<String, Topic>,
    /// As this program noted them when it wrote the log.
    configuration: Option<String>,
    camera: Option<CameraConfig>,
}

impl Survey {
    /// Reads the first messages; `messages` is to be opened anew afterwards.
    pub fn new(messages: &mut dyn MessageSource) -> Self {
        let mut topics: BTreeMap<String, Topic> = BTreeMap::new();
        let (mut count, mut bytes) = (0, 0);
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
                count += 1;
                bytes += message.data.len();
            });
            let known = |topic: &Topic| {
                (!topic.is_image() || topic.encoding.is_some())
                    && (topic.kind != Some(MessageType::Imu)
                        || topic.accelerations.len() == SURVEY_IMU_SAMPLES)
            };
            if !more || messages.is_indexed() && topics.values().all(known) {
                break;
            }
        }
        let note = |key| messages.channels().iter().find_map(|c| c.metadata.get(key).cloned());
        let camera = note(CAMERA).and_then(|text| serde_json::from_str(&text).ok());
        Self { topics, configuration: note(CONFIGURATION), camera }
    }

    /// Topics with their types and encodings, for messages to the user.
    fn describe(&self) -> String {
        let describe = |(name, topic): (&String, &Topic)| match &topic.encoding {
            Some(encoding) => format!("{name} ({} {encoding})", topic.schema),
            None => format!("{name} ({})", topic.schema),
        };
        let topics: Vec<_> = self.topics.iter().map(describe).collect();
        if topics.is_empty() { "no topics".to_owned() } else { topics.join(", ") }
    }

    fn best(&self, role: Role, color_size: Option<(u32, u32)>) -> Option<&String> {
        let ranked = self.topics.iter().filter_map(|(name, topic)| {
            topic.rank(name, role, color_size).map(|rank| (rank, name))
        });
        ranked.min().map(|(_, name)| name)
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
        // The same topics may come from a log that was converted to SI units.
        let in_g = self.topics.get("/imu").is_some_and(Topic::logs_g);
        if layout && in_g { "vcu_rvi" } else { "sim" }
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
                "" => self.best(role, color_size),
                wanted => match self.topics.get_key_value(wanted) {
                    Some((name, topic)) if topic.kind.is_some_and(|kind| role.takes(kind)) => {
                        Some(name)
                    }
                    _ => return Err(role),
                },
            };
            if let Some(name) = name {
                if role == Role::Color {
                    color_size = self.topics.get(name).and_then(|topic| topic.size);
                }
                chosen.insert(role, name.clone());
            }
        }
        Ok(chosen)
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
        let encoding = &self.topics.get(color)?.encoding;
        let is_like_color = |name: &String, topic: &Topic| {
            name != color
                && topic.encoding == *encoding
                && topic.rank(name, Role::Right, color_size).is_some()
        };
        self.topics.iter().find(|(name, topic)| is_like_color(name, topic)).map(|(name, _)| name)
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
        let Some((width, height)) = color.and_then(|topic| topic.size) else {
            return Err(failed("no image of the left one could be read".to_owned()));
        };
        StereoRig::new(left, right, (width as usize, height as usize))
            .map(Some)
            .map_err(|error| failed(error.to_string()))
    }

    /// Without the demand that the log be complete.
    pub fn summary(&self, kind: &str) -> LogSummary {
        let chosen = self.choose(&LogConfig::default()).unwrap_or_default();
        self.summary_of(kind, &chosen, None)
    }

    /// `role` is not there.
    pub fn missing(&self, path: &Path, role: Role) -> LogError {
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
            frames: None,
            camera: rig.map(StereoRig::camera).or(self.camera.as_ref()).cloned(),
        }
    }
}

/// Decodes the messages of the chosen topics.
pub(super) struct RosSource {
    messages: Box<dyn MessageSource>,
    roles: BTreeMap<String, Role>,
    log: LogConfig,
    imu: ImuConfig,
}

impl RosSource {
    /// `messages` from the start; `path` and `kind` for errors and the summary. Where depth comes
    /// from two cameras, these too.
    pub fn new(
        mut messages: Box<dyn MessageSource>,
        survey: &Survey,
        (path, kind): (&Path, &str),
        log: &LogConfig,
        imu: &ImuConfig,
    ) -> Result<(Self, LogSummary, Option<StereoRig>), LogError> {
        let missing = |role: Role| survey.missing(path, role);
        let chosen = survey.choose(log).map_err(missing)?;
        let rig = survey.rig(path, &chosen, log)?;
        for role in [Role::Color, Role::Depth] {
            let is_computed = role == Role::Depth && rig.is_some();
            if role.configured(log) != "none" && !chosen.contains_key(&role) && !is_computed {
                return Err(missing(role));
            }
        }
        for (role, topic) in &chosen {
            if role.configured(log).is_empty() {
                tracing::info!("{}: {topic} (chosen by message type)", role.name());
            }
        }
        messages.only(chosen.values().cloned().collect());
        let summary = survey.summary_of(kind, &chosen, rig.as_ref());
        let roles = chosen.into_iter().map(|(role, topic)| (topic, role)).collect();
        Ok((Self { messages, roles, log: log.clone(), imu: imu.clone() }, summary, rig))
    }
}

impl ReadingSource for RosSource {
    fn next_reading(&mut self, report: &mut ReadReport) -> Option<Reading> {
        let Self { messages, roles, log, imu } = self;
        loop {
            let mut reading = None;
            let more = messages.visit_next(report, &mut |message, report| {
                let topic = &message.channel.topic;
                let Some(role) = roles.get(topic) else { return };
                match decode(*role, message, log, imu) {
                    Ok(decoded) => reading = Some(decoded),
                    Err(Rejection { reason, detail }) => report.skip(
                        &format!("{}: {reason}", role.name()),
                        format_args!("{topic}, {}: {detail}", message.place),
                    ),
                }
            });
            if reading.is_some() || !more {
                return reading;
            }
        }
    }
}

/// The reading of a message that plays `role`.
pub(super) fn decode(
    role: Role,
    message: &Message,
    log: &LogConfig,
    imu: &ImuConfig,
) -> Result<Reading, Rejection> {
    let channel = message.channel;
    let Some((kind, serialization)) = channel.readable().filter(|(kind, _)| role.takes(*kind))
    else {
        return Err(Rejection::new("unexpected message type", &channel.schema));
    };
    let fields = Fields::new(message.data, serialization)?;
    match (role, kind) {
        (Role::Imu, _) => message::imu(fields, imu).map(Reading::Imu),
        (Role::Truth, _) => message::pose(fields, kind).map(Reading::Truth),
        (Role::Color, MessageType::Image) => {
            let (stamp, raw) = message::image(fields)?;
            raw_color(&raw, log).map(|image| Reading::Color(stamp, image))
        }
        (Role::Right, MessageType::Image) => {
            let (stamp, raw) = message::image(fields)?;
            raw_color(&raw, log).map(|image| Reading::Right(stamp, image))
        }
        (Role::Right, _) => {
            let image = message::compressed_image(fields)?;
            compressed_color(image.data).map(|color| Reading::Right(image.stamp, color))
        }
        (Role::Color, _) => {
            let image = message::compressed_image(fields)?;
            compressed_color(image.data).map(|color| Reading::Color(image.stamp, color))
        }
        (Role::Depth, MessageType::Image) => {
            let (stamp, raw) = message::image(fields)?;
            raw_depth(&raw, log).map(|image| Reading::Depth(stamp, image))
        }
        (Role::Depth, _) => {
            let image = message::compressed_image(fields)?;
            compressed_depth(image.depth_file()?, log)
                .map(|depth| Reading::Depth(image.stamp, depth))
        }
    }
}
