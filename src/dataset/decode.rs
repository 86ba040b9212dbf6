//! Messages of the chosen topics to readings.

use std::collections::BTreeMap;
use std::path::Path;

use super::compressed::{color_file, depth_image};
use super::merge::{Reading, ReadingSource};
use super::message::{self, Fields, InertialReading, MessageType};
use super::nmea::NmeaReader;
use super::pixels::{Rejection, raw_color, raw_depth};
use super::ros::{ImuContent, Message, MessageSource, Role, Survey};
use super::{LogConfig, LogError, LogSummary, ReadReport, navigation_message};
use crate::inertial::ImuConfig;
use crate::sensor::ImuSample;
use crate::vision::StereoRig;

/// Decodes messages by the roles of their topics.
pub(super) struct Decoder {
    log: LogConfig,
    imu: ImuConfig,
    /// What the messages of [`Role::Imu`] hold.
    content: ImuContent,
    nmea: NmeaReader,
}

impl Decoder {
    pub fn new(log: &LogConfig, imu: &ImuConfig, content: ImuContent) -> Self {
        Self { log: log.clone(), imu: imu.clone(), content, nmea: NmeaReader::default() }
    }

    /// The reading of a message that plays `role`; `None` for one that only completes others.
    pub fn decode(&mut self, role: Role, message: &Message) -> Result<Option<Reading>, Rejection> {
        let channel = message.channel;
        let Some((kind, serialization)) = channel.readable().filter(|(kind, _)| role.takes(*kind))
        else {
            return Err(Rejection::new("unexpected message type", &channel.schema));
        };
        let fields = Fields::new(message.data, serialization)?;
        match role {
            Role::Imu => inertial(message::imu(fields, &self.imu)?, self.content).map(Some),
            Role::Accelerometer => {
                inertial(message::imu(fields, &self.imu)?, ImuContent::Accelerometer).map(Some)
            }
            Role::Truth => Ok(Some(Reading::Truth(message::pose(fields, kind)?))),
            Role::Gnss if kind == MessageType::NmeaSentence => {
                let fix = navigation_message::nmea_sentence(fields, &mut self.nmea)?;
                Ok(fix.map(Reading::Gnss))
            }
            Role::Gnss => Ok(Some(Reading::Gnss(navigation_message::nav_sat_fix(fields)?))),
            Role::Magnetic => {
                Ok(Some(Reading::Magnetic(navigation_message::magnetic_field(fields)?)))
            }
            Role::Color | Role::Right | Role::Depth => {
                image(role, kind, fields, &self.log).map(Some)
            }
        }
    }
}

fn image(
    role: Role,
    kind: MessageType,
    fields: Fields,
    log: &LogConfig,
) -> Result<Reading, Rejection> {
    if kind == MessageType::Image {
        let (stamp, raw) = message::image(fields)?;
        return Ok(match role {
            Role::Depth => Reading::Depth(stamp, raw_depth(&raw, log)?),
            Role::Right => Reading::Right(stamp, raw_color(&raw, log)?),
            _ => Reading::Color(stamp, raw_color(&raw, log)?),
        });
    }
    let image = message::compressed_image(fields)?;
    let stamp = image.stamp;
    Ok(match role {
        Role::Depth => Reading::Depth(stamp, depth_image(&image, log)?),
        Role::Right => Reading::Right(stamp, color_file(image.data)?),
        _ => Reading::Color(stamp, color_file(image.data)?),
    })
}

/// The part of a message that its topic is used for.
fn inertial(reading: InertialReading, content: ImuContent) -> Result<Reading, Rejection> {
    let stamp = reading.stamp;
    let reading = match content {
        ImuContent::Alternating => reading.without_zeros(),
        _ => reading,
    };
    let (rate, force) = match content {
        ImuContent::Gyroscope => (reading.angular_velocity, None),
        ImuContent::Accelerometer => (None, reading.specific_force),
        ImuContent::Whole | ImuContent::Alternating => {
            (reading.angular_velocity, reading.specific_force)
        }
    };
    match (rate, force) {
        (Some(angular_velocity), Some(specific_force)) => {
            Ok(Reading::Imu(ImuSample { stamp, angular_velocity, specific_force }))
        }
        (Some(rate), None) => Ok(Reading::Gyroscope(stamp, rate)),
        (None, Some(force)) => Ok(Reading::Accelerometer(stamp, force)),
        (None, None) => {
            let detail = format!("covariance -1, or zeros, at {stamp} s");
            Err(Rejection::new("nothing measured in the message", detail))
        }
    }
}

/// Decodes the messages of the chosen topics.
pub(super) struct RosSource {
    messages: Box<dyn MessageSource>,
    roles: BTreeMap<String, Role>,
    decoder: Decoder,
}

impl RosSource {
    /// `messages` from the start, of which those of the `chosen` topics are read.
    pub fn of_topics(
        mut messages: Box<dyn MessageSource>,
        chosen: BTreeMap<Role, String>,
        decoder: Decoder,
    ) -> Self {
        messages.only(chosen.values().cloned().collect());
        let roles = chosen.into_iter().map(|(role, topic)| (topic, role)).collect();
        Self { messages, roles, decoder }
    }

    /// `messages` from the start; `path` and `kind` for errors and the summary. Where depth comes
    /// from two cameras, these too.
    pub fn new(
        messages: Box<dyn MessageSource>,
        survey: &Survey,
        (path, kind): (&Path, &str),
        log: &LogConfig,
        imu: &ImuConfig,
    ) -> Result<(Self, LogSummary, Option<StereoRig>), LogError> {
        let missing = |role: Role| survey.missing(path, role);
        let chosen = survey.choose(log).map_err(missing)?;
        for (role, topic) in &chosen {
            survey.check_encoding(path, *role, topic)?;
        }
        let rig = survey.rig(path, &chosen, log)?;
        for role in [Role::Color, Role::Depth] {
            let is_computed = role == Role::Depth && rig.is_some();
            if role.configured(log) != "none" && !chosen.contains_key(&role) && !is_computed {
                return Err(missing(role));
            }
        }
        survey.choices(&chosen, log).iter().for_each(|line| tracing::info!("{line}"));
        let summary = survey.summary_of(kind, &chosen, rig.as_ref());
        if let Some(topic) = &summary.lone_gyroscope {
            tracing::warn!("imu: {topic} has no accelerometer, and no other topic has: not used");
        }
        if rig.is_none() && summary.calibration.registration.is_none() {
            survey.check_sizes(path, &chosen)?;
        }
        let decoder = survey.decoder(&chosen, log, imu);
        Ok((Self::of_topics(messages, chosen, decoder), summary, rig))
    }
}

impl ReadingSource for RosSource {
    fn next_reading(&mut self, report: &mut ReadReport) -> Option<Reading> {
        let Self { messages, roles, decoder } = self;
        loop {
            let mut reading = None;
            let more = messages.visit_next(report, &mut |message, report| {
                let topic = &message.channel.topic;
                let Some(role) = roles.get(topic) else { return };
                match decoder.decode(*role, message) {
                    Ok(decoded) => reading = decoded,
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
