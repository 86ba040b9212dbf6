//! Settings that follow from what a log holds.

use serde::Serialize;

use crate::vision::DepthRegistration;

/// A value of the configuration that follows from the log.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FoundSetting {
    /// `section.key`.
    pub key: String,
    pub value: toml::Value,
    pub source: FoundIn,
}

/// Where in the log a value is from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum FoundIn {
    /// A topic, or the frames of two.
    Log(String),
    /// A table of devices and chips, by the device that made the log.
    SensorClass(String),
}

impl FoundSetting {
    pub(super) fn new(key: &str, value: impl Into<toml::Value>, source: FoundIn) -> Self {
        Self { key: key.to_owned(), value: value.into(), source }
    }

    pub(super) fn from_log(key: &str, value: impl Into<toml::Value>, source: &str) -> Self {
        Self::new(key, value, FoundIn::Log(source.to_owned()))
    }
}

/// What a log tells of its calibration.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct FoundCalibration {
    pub settings: Vec<FoundSetting>,
    /// What the log tells and cannot be used, and why: sentences.
    pub problems: Vec<String>,
    /// The device that made the log, where its names tell.
    pub device: Option<String>,
    /// Where the depth image is not registered to color, how it can be.
    #[serde(skip)]
    pub registration: Option<DepthRegistration>,
}
