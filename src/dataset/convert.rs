//! Logs of all kinds to MCAP files of ROS 2 messages.
//!
//! Messages keep their content, header stamps and log times; ROS 1 messages are serialised anew
//! by their definitions, whatever their type. Folders, and logs of two cameras without depth, become
//! the messages of [`LogWriter`], whose log times are their stamps.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::Path;

use serde::Serialize;

use super::definition::Definition;
use super::message::{self, Fields, MessageType, Serialization};
use super::open::{Contents, MessageLog};
use super::output::McapOutput;
use super::pixels::Rejection;
use super::ros::{Channel, Message, Role, Survey};
use super::ros2;
use super::{
    Event, LogConfig, LogError, LogWriter, LogWriterOptions, ReadReport, WriteError, open,
};
use crate::inertial::ImuConfig;
use crate::output::{Files, FilesError};
use crate::sensor::CameraConfig;

/// Level of the zstd compression: images hardly shrink further with higher ones.
const COMPRESSION_LEVEL: u32 = 1;

/// What was written.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct ConvertSummary {
    /// Number of messages by topic.
    pub messages: BTreeMap<String, u64>,
    /// Messages left out, by reason.
    pub skipped: BTreeMap<String, u64>,
}

/// A log that cannot be converted.
#[derive(Debug, thiserror::Error)]
pub enum ConvertError {
    #[error(transparent)]
    Read(#[from] LogError),
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error(transparent)]
    Files(#[from] FilesError),
}

/// Writes the log `input` as MCAP to `output`. `camera` goes with the images of folders
/// that do not know theirs. After
/// each message `progress` is asked whether to go on; the log is complete up to there.
///
/// Images whose encoding is only `8UC3` are marked with the channel order of `log.color_8uc3`,
/// without which other programs could not show them.
pub fn convert(
    input: &Path,
    output: &Path,
    log: &LogConfig,
    camera: &CameraConfig,
    progress: impl FnMut() -> ControlFlow<()>,
) -> Result<ConvertSummary, ConvertError> {
    log.validate()?;
    Files::new().reads("IN", input).writes("OUT", output).check()?;
    match Contents::of(input, log)? {
        Contents::Messages(messages) if !is_stereo(&messages, log) => {
            convert_messages(&messages, output, log, progress)
        }
        _ => convert_events(input, output, (log, camera), progress),
    }
}

/// Whether depth is to be computed from two cameras.
fn is_stereo(messages: &MessageLog, log: &LogConfig) -> bool {
    let chosen = Survey::new(messages.messages().as_mut()).choose(log);
    !log.stereo.is_empty() && chosen.is_ok_and(|chosen| chosen.contains_key(&Role::Right))
}

fn convert_events(
    input: &Path,
    output: &Path,
    (log, camera): (&LogConfig, &CameraConfig),
    mut progress: impl FnMut() -> ControlFlow<()>,
) -> Result<ConvertSummary, ConvertError> {
    let mut events = open(input, log, &ImuConfig::default())?;
    let configuration = events.summary().config_name.clone();
    let camera = events.summary().camera.clone().unwrap_or_else(|| camera.clone());
    let options = LogWriterOptions { configuration, ..LogWriterOptions::default() };
    let mut writer = LogWriter::create(output, options)?;
    let mut has_camera = false;
    while let Some(event) = events.next_event() {
        if !has_camera && matches!(event, Event::Frame(_)) {
            writer.camera_info(&camera, event.stamp())?;
            has_camera = true;
        }
        writer.event(&event)?;
        if progress().is_break() {
            break;
        }
    }
    let written = writer.finish()?;
    let messages = [
        ("frames", written.frames),
        ("IMU samples", written.imu_samples),
        ("truth poses", written.truth_poses),
    ];
    Ok(ConvertSummary {
        messages: messages.map(|(name, count)| (name.to_owned(), count)).into(),
        skipped: events.report().skipped.clone(),
    })
}

fn convert_messages(
    log: &MessageLog,
    output: &Path,
    config: &LogConfig,
    mut progress: impl FnMut() -> ControlFlow<()>,
) -> Result<ConvertSummary, ConvertError> {
    let mut converter = Converter {
        output: McapOutput::create(output, COMPRESSION_LEVEL)?,
        topics: BTreeMap::new(),
        color_encoding: if config.color_8uc3 == "rgb" { b"rgb8" } else { b"bgr8" },
        buffer: Vec::new(),
        summary: ConvertSummary::default(),
    };
    let mut source = log.messages();
    let mut report = ReadReport::default();
    loop {
        let mut failure = None;
        let more = source.visit_next(&mut report, &mut |message, report| {
            failure = converter.message(message, report).err();
        });
        if let Some(failure) = failure {
            return Err(failure.into());
        }
        if !more || progress().is_break() {
            break;
        }
    }
    converter.output.finish()?;
    Ok(ConvertSummary { skipped: report.skipped, ..converter.summary })
}

struct Converter {
    output: McapOutput,
    /// By topic, schema and serialization, since a topic may have several publishers.
    topics: BTreeMap<(String, String, bool), Result<Topic, Rejection>>,
    /// Takes the place of `8UC3`, which has as many letters.
    color_encoding: &'static [u8; 4],
    buffer: Vec<u8>,
    summary: ConvertSummary,
}

struct Topic {
    channel: u16,
    /// How messages of ROS 1 are to be serialised anew.
    definition: Option<Definition>,
}

impl Converter {
    fn message(&mut self, message: &Message, report: &mut ReadReport) -> Result<(), WriteError> {
        let channel = message.channel;
        let Some(serialization) = channel.serialization else {
            report.skip("serialization that is not read", &channel.topic);
            return Ok(());
        };
        let is_ros1 = serialization == Serialization::Ros1;
        let key = (channel.topic.clone(), channel.schema.clone(), is_ros1);
        if !self.topics.contains_key(&key) {
            let topic = Topic::declare(channel, is_ros1, &mut self.output)?;
            self.topics.insert(key.clone(), topic);
        }
        let skip = |report: &mut ReadReport, rejection: &Rejection| {
            let detail = format_args!("{}, {}: {}", channel.topic, message.place, rejection.detail);
            report.skip(rejection.reason, detail);
        };
        let topic = match self.topics.get(&key) {
            Some(Ok(topic)) => topic,
            Some(Err(rejection)) => {
                skip(report, rejection);
                return Ok(());
            }
            None => return Ok(()),
        };
        self.buffer.clear();
        match &topic.definition {
            Some(definition) => {
                if let Err(rejection) = definition.transcode(message.data, &mut self.buffer) {
                    skip(report, &rejection);
                    return Ok(());
                }
            }
            None => self.buffer.extend(message.data),
        }
        if channel.kind == Some(MessageType::Image) {
            name_channel_order(&mut self.buffer, self.color_encoding);
        }
        self.output.write(topic.channel, message.log_time, &self.buffer)?;
        *self.summary.messages.entry(channel.topic.clone()).or_default() += 1;
        Ok(())
    }
}

impl Topic {
    /// The inner error: messages of this type cannot be converted.
    fn declare(
        channel: &Channel,
        is_ros1: bool,
        output: &mut McapOutput,
    ) -> Result<Result<Self, Rejection>, WriteError> {
        // Some writers leave the definitions of common types out.
        let text = match channel.definition.trim() {
            "" => channel.kind.and_then(ros2::definition).unwrap_or_default(),
            text => text,
        };
        if !is_ros1 {
            let schema = (channel.schema.as_str(), text);
            let channel = output.channel(&channel.topic, schema, &channel.metadata)?;
            return Ok(Ok(Self { channel, definition: None }));
        }
        let definition = match Definition::parse(&channel.schema, text) {
            Ok(definition) => definition,
            Err(rejection) => return Ok(Err(rejection)),
        };
        let schema = (definition.ros2_name(), definition.ros2_text());
        let channel = output.channel(&channel.topic, (&schema.0, &schema.1), &channel.metadata)?;
        Ok(Ok(Self { channel, definition: Some(definition) }))
    }
}

/// Replaces the encoding `8UC3` of an image in CDR.
fn name_channel_order(image: &mut [u8], encoding: &[u8; 4]) {
    let position = Fields::new(image, Serialization::Cdr)
        .and_then(message::image)
        .ok()
        .filter(|(_, raw)| raw.encoding == "8UC3")
        .map(|(_, raw)| raw.encoding.as_ptr().addr() - image.as_ptr().addr());
    if let Some(place) = position.and_then(|start| image.get_mut(start..start + encoding.len())) {
        place.copy_from_slice(encoding);
    }
}
