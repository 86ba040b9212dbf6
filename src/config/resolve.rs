//! The configuration for a log, of layers, and where each of its values is from.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::{
    Config, ConfigError, GENERIC, SHIPPED, assignment, flat_keys, put, read, shipped_text,
    table_of, typed, valid_keys,
};
use crate::dataset::{FoundIn, LogConfig, LogSummary, detect, detect_with, open};
use crate::sensor::CameraConfig;
use crate::vision::rectified_camera;

/// Keys without which images mean nothing; no default is right.
pub(super) const CALIBRATION: &[&str] =
    &["camera.fx", "camera.fy", "camera.cx", "camera.cy", MOUNTING];

/// Wanted where there is an IMU.
const MOUNTING: &str = "camera.imu_from_camera";

/// Two calibrations that agree to this fraction are of the same device.
const SAME_DEVICE: f64 = 1e-5;

/// Values that differ by less than this fraction do not contradict one another.
const SAME_VALUE: f64 = 1e-3;

/// Who set a value; a later one counts more than an earlier one.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(tag = "origin", content = "detail")]
pub enum Origin {
    /// No one.
    #[serde(rename = "default")]
    Default,
    /// A file that comes with the program.
    #[serde(rename = "shipped file")]
    Shipped(String),
    /// A table of devices and chips.
    #[serde(rename = "sensor class")]
    SensorClass(String),
    /// The log: a topic, a transform.
    #[serde(rename = "log")]
    Log(String),
    /// A file that the user gave.
    #[serde(rename = "file")]
    File(PathBuf),
    /// `--set`.
    #[serde(rename = "command line")]
    CommandLine,
}

impl std::fmt::Display for Origin {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Default => write!(f, "default"),
            Self::Shipped(name) => write!(f, "shipped file {name}"),
            Self::SensorClass(what) => write!(f, "sensor class {what}"),
            Self::Log(what) => write!(f, "log: {what}"),
            Self::File(path) => write!(f, "file {}", path.display()),
            Self::CommandLine => write!(f, "command line"),
        }
    }
}

/// One value of a configuration.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Setting {
    /// `section.key`.
    pub key: String,
    pub value: toml::Value,
    #[serde(flatten)]
    pub origin: Origin,
}

/// What the log says of a key differs from what the user wants.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Conflict {
    pub key: String,
    /// By the log; not used.
    pub log: Setting,
    /// By the user; used.
    pub used: Setting,
}

impl std::fmt::Display for Conflict {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{}: {} ({}) is used, since what is set by hand counts more; the log has {} ({})",
            self.key,
            self.used.value,
            self.used.origin,
            self.log.value,
            match &self.log.origin {
                Origin::Log(what) => what.clone(),
                other => other.to_string(),
            }
        )
    }
}

/// A configuration whose values know where they are from.
#[derive(Debug, Clone)]
pub struct Resolved {
    pub config: Config,
    /// The log that it is for.
    pub summary: LogSummary,
    pub conflicts: Vec<Conflict>,
    log: PathBuf,
    file: Option<PathBuf>,
    /// Of the shipped configuration that the rest was laid on.
    shipped: String,
    origins: BTreeMap<String, Origin>,
    table: toml::Table,
}

impl Resolved {
    /// The configuration for the log at `path`: the shipped one for its layout (all defaults under
    /// a `file`), what the log tells of its sensors, the `file`, and `overrides`
    /// (`section.key=value`), each over those before.
    ///
    /// # Errors
    /// [`ConfigError`] for a log that cannot be read, or a key or value that is not right. A
    /// calibration that nothing gives is no error here: see [`Self::require_calibration`].
    pub fn of(path: &Path, file: Option<&Path>, overrides: &[String]) -> Result<Self, ConfigError> {
        let valid = valid_keys::<Config>()?;
        let given = file.map(|file| Given::read(file, &valid)).transpose()?;
        let set = overrides.iter().map(|text| assignment(text, &valid));
        let set = set.collect::<Result<Vec<_>, _>>()?;

        let mut summary = detect(path)?;
        let log = log_section(&summary, given.as_ref(), &set)?;
        if log != LogConfig::default() {
            log.validate()?;
            summary = detect_with(path, &log)?;
        }
        summary.config_name = known_device(&summary)?.unwrap_or(summary.config_name);

        let mut layers = Layers::new()?;
        if given.is_none() {
            layers.shipped(&summary.config_name, &valid)?;
        }
        if given.is_some() || summary.config_name == GENERIC {
            layers.found(&summary, |source| matches!(source, FoundIn::SensorClass(_)), &valid);
        }
        layers.camera_of_log(&summary);
        layers.found(&summary, |source| matches!(source, FoundIn::Log(_)), &valid);
        if let Some(given) = given {
            let origin = Origin::File(given.path);
            layers.all(given.table, &origin);
        }
        layers.rectified(&summary, file)?;
        for (key, value) in set {
            layers.put(key, value, Origin::CommandLine);
        }
        layers.finish(path, file, summary)
    }

    /// Every value with its origin, by key.
    pub fn settings(&self) -> Vec<Setting> {
        let value = |key: &str| {
            let (section, key) = key.split_once('.')?;
            self.table.get(section)?.get(key).cloned()
        };
        self.origins
            .iter()
            .filter_map(|(key, origin)| {
                Some(Setting { key: key.clone(), value: value(key)?, origin: origin.clone() })
            })
            .collect()
    }

    /// Who set `key` (`section.key`).
    pub fn origin(&self, key: &str) -> &Origin {
        self.origins.get(key).unwrap_or(&Origin::Default)
    }

    /// What to call the configuration: the given file, or the shipped one by its short name.
    pub fn name(&self) -> String {
        self.file.as_ref().map_or_else(|| self.shipped.clone(), |file| file.display().to_string())
    }

    /// The given file, or the shipped one.
    pub fn file_name(&self) -> String {
        match &self.file {
            Some(file) => file.display().to_string(),
            None => format!("configs/{}.toml", self.shipped),
        }
    }

    /// Whether anything says how the camera is mounted on the IMU.
    pub fn has_mounting(&self) -> bool {
        *self.origin(MOUNTING) != Origin::Default
    }

    /// Keys of the calibration that nothing gives and that the log's streams need.
    pub fn missing(&self) -> Vec<&'static str> {
        let has_images = self.summary.sources.contains_key("color");
        let is_needed = |key: &str| has_images && (key != MOUNTING || self.summary.has_imu);
        let is_missing =
            |key: &&&'static str| is_needed(key) && *self.origin(key) == Origin::Default;
        CALIBRATION.iter().filter(is_missing).copied().collect()
    }

    /// # Errors
    /// [`ConfigError::NoCalibration`] with what is missing and what to do, if images cannot be used.
    pub fn require_calibration(&self) -> Result<(), ConfigError> {
        let missing = self.missing();
        if missing.is_empty() {
            return Ok(());
        }
        // A log that cannot be read at all is told of first.
        open(&self.log, &self.config.log, &self.config.imu)?;
        Err(ConfigError::NoCalibration { log: self.log.clone(), reason: self.what_to_do(&missing) })
    }

    fn what_to_do(&self, missing: &[&str]) -> String {
        let lacks = match &self.file {
            Some(file) => format!("{} lacks {} and", file.display(), missing.join(", ")),
            None => format!("no {}:", missing.join(", ")),
        };
        let problems = &self.summary.calibration.problems;
        let why = match problems.is_empty() {
            true => "the log has none".to_owned(),
            false => problems.join("; "),
        };
        let info = format!("mfg-vio info {} --write-config FILE", self.log.display());
        let help = if missing == [MOUNTING] {
            format!(
                "`{info}` finds the rotation from turns that camera and IMU both see; give its FILE \
                 with --config, or set {MOUNTING}; or use the images alone: --set log.imu_topic=none"
            )
        } else {
            format!(
                "give them with --config FILE (`{info}` writes what is known) or --set {}=...",
                missing.first().unwrap_or(&MOUNTING)
            )
        };
        format!("{lacks} {why}; {help}")
    }

    /// The configuration as a file: what is not a default, with its origin, under what was `found`
    /// besides (key, value as in `--set`, why). Where streams are is stated, too.
    ///
    /// # Errors
    /// [`ConfigError`] for a found value that is not right.
    pub fn to_toml(&self, found: &[(String, String, String)]) -> Result<String, ConfigError> {
        let valid = valid_keys::<Config>()?;
        let mut settings: BTreeMap<String, (toml::Value, String)> = self
            .settings()
            .into_iter()
            .filter(|setting| setting.origin != Origin::Default)
            .map(|setting| (setting.key, (setting.value, setting.origin.to_string())))
            .collect();
        for (role, topic) in self.summary.sources.iter().filter(|(_, topic)| topic.starts_with('/'))
        {
            let key = format!("log.{role}_topic");
            if valid.contains(&key) {
                settings.insert(key, (topic.clone().into(), "chosen among the topics".to_owned()));
            }
        }
        for (key, value, why) in found {
            let (key, value) = assignment(&format!("{key}={value}"), &valid)?;
            settings.insert(key, (value, format!("found: {why}")));
        }
        let mut text = format!("# {}\n", self.log.display());
        let mut section = "";
        for (path, (value, origin)) in &settings {
            let Some((head, key)) = path.split_once('.') else { continue };
            if head != section {
                text += &format!("\n[{head}]\n");
                section = head;
            }
            text += &format!("# {}\n{key} = {value}\n", origin.replace('\n', " "));
        }
        Ok(text)
    }
}

/// A file of the user.
struct Given {
    path: PathBuf,
    table: toml::Table,
}

impl Given {
    fn read(path: &Path, valid: &[String]) -> Result<Self, ConfigError> {
        let table = table_of(&read(path)?, &path.display().to_string(), valid)?;
        Ok(Self { path: path.to_owned(), table })
    }
}

/// The section that says where streams are, by which a log is looked at.
fn log_section(
    summary: &LogSummary,
    given: Option<&Given>,
    set: &[(String, toml::Value)],
) -> Result<LogConfig, ConfigError> {
    let mut layers = Layers::new()?;
    match given {
        Some(given) => layers.all(given.table.clone(), &Origin::File(given.path.clone())),
        None => layers.shipped(&summary.config_name, &valid_keys::<Config>()?)?,
    }
    for (key, value) in set {
        layers.put(key.clone(), value.clone(), Origin::CommandLine);
    }
    let section = layers.table.remove("log").and_then(|log| log.try_into().ok());
    // A value that is ill-typed is told of when all of them are read.
    Ok(section.unwrap_or_default())
}

/// The shipped configuration of the very camera that made a log of an unknown layout: a calibration
/// is that of one device.
fn known_device(summary: &LogSummary) -> Result<Option<String>, ConfigError> {
    if summary.config_name != GENERIC {
        return Ok(None);
    }
    let found = |key: &str| {
        let settings = &summary.calibration.settings;
        settings.iter().find(|setting| setting.key == key)?.value.as_float()
    };
    let is_same = |config: &Config| {
        let CameraConfig { fx, fy, cx, cy, .. } = config.camera;
        [("camera.fx", fx), ("camera.fy", fy), ("camera.cx", cx), ("camera.cy", cy)]
            .iter()
            .all(|(key, value)| found(key).is_some_and(|f| (f / value - 1.0).abs() < SAME_DEVICE))
    };
    for (name, _) in SHIPPED.iter().filter(|(name, _)| *name != GENERIC) {
        let config = Config::shipped(name, &[])?;
        // Where topics are named, the layout is another one.
        if config.log.color_topic.is_empty() && is_same(&config) {
            return Ok(Some((*name).to_owned()));
        }
    }
    Ok(None)
}

/// Values and their origins while layers are put over one another.
struct Layers {
    table: toml::Table,
    origins: BTreeMap<String, Origin>,
    conflicts: Vec<Conflict>,
    shipped: String,
}

impl Layers {
    fn new() -> Result<Self, ConfigError> {
        let table = toml::Table::try_from(Config::default()).map_err(|error| {
            ConfigError::Syntax { origin: "defaults".to_owned(), message: error.to_string() }
        })?;
        let origins = flat_keys(&table).into_iter().map(|key| (key, Origin::Default)).collect();
        Ok(Self { table, origins, conflicts: Vec::new(), shipped: GENERIC.to_owned() })
    }

    fn put(&mut self, key: String, value: toml::Value, origin: Origin) {
        let old = key.split_once('.').and_then(|(s, k)| self.table.get(s)?.get(k)).cloned();
        let is_by_hand = matches!(origin, Origin::File(_) | Origin::CommandLine);
        if let (Some(was @ Origin::Log(_)), Some(old), true) =
            (self.origins.get(&key), old, is_by_hand)
            && !is_alike(&old, &value)
        {
            let setting = |value: &toml::Value, origin: &Origin| Setting {
                key: key.clone(),
                value: value.clone(),
                origin: origin.clone(),
            };
            let (log, used) = (setting(&old, was), setting(&value, &origin));
            self.conflicts.push(Conflict { key: key.clone(), log, used });
        }
        put(&mut self.table, &key, value);
        self.origins.insert(key, origin);
    }

    fn all(&mut self, table: toml::Table, origin: &Origin) {
        for (section, values) in table {
            let toml::Value::Table(values) = values else { continue };
            for (key, value) in values {
                self.put(format!("{section}.{key}"), value, origin.clone());
            }
        }
    }

    fn shipped(&mut self, name: &str, valid: &[String]) -> Result<(), ConfigError> {
        let origin = format!("configs/{name}.toml");
        let table = table_of(shipped_text(name)?, &origin, valid)?;
        self.all(table, &Origin::Shipped(origin));
        name.clone_into(&mut self.shipped);
        Ok(())
    }

    fn found(&mut self, summary: &LogSummary, wanted: impl Fn(&FoundIn) -> bool, valid: &[String]) {
        let settings = summary.calibration.settings.iter();
        for found in settings.filter(|found| wanted(&found.source)) {
            let origin = match &found.source {
                FoundIn::Log(what) => Origin::Log(what.clone()),
                FoundIn::SensorClass(what) => Origin::SensorClass(what.clone()),
            };
            if valid.contains(&found.key) {
                self.put(found.key.clone(), found.value.clone(), origin);
            }
        }
    }

    /// The camera that a log of this program, or a folder, describes as a whole.
    fn camera_of_log(&mut self, summary: &LogSummary) {
        let Some(camera) = &summary.camera else { return };
        self.camera(camera, &Origin::Log(format!("calibration in the {}", summary.kind)));
    }

    fn camera(&mut self, camera: &CameraConfig, origin: &Origin) {
        let Ok(toml::Value::Table(keys)) = toml::Value::try_from(camera) else { return };
        for (key, value) in keys {
            self.put(format!("camera.{key}"), value, origin.clone());
        }
    }

    /// Where depth comes from two cameras, their rectified image has the calibration that follows
    /// from theirs, whatever else is given.
    fn rectified(&mut self, summary: &LogSummary, file: Option<&Path>) -> Result<(), ConfigError> {
        let log: LogConfig = match self.table.get("log") {
            Some(section) => section.clone().try_into().unwrap_or_default(),
            None => LogConfig::default(),
        };
        let is_named = !["", "none"].contains(&log.right_topic.as_str());
        let is_stereo = is_named || summary.is_stereo() && log.depth_topic.is_empty();
        let camera = match (&log.stereo[..], &summary.camera) {
            _ if !is_stereo => return Ok(()),
            (_, Some(camera)) if summary.is_stereo() => camera.clone(),
            ([left, right], _) => {
                rectified_camera(left, right).map_err(|error| ConfigError::BadValue {
                    origin: file.map_or_else(|| self.shipped.clone(), |f| f.display().to_string()),
                    key: "log.stereo".to_owned(),
                    message: error.to_string(),
                })?
            }
            _ => return Ok(()),
        };
        let before = self.conflicts.len();
        self.camera(&camera, &Origin::Log("rectified from the two cameras".to_owned()));
        if let [left, right] = &summary.stereo[..]
            && log.stereo != summary.stereo
            && let Ok(cameras) = toml::Value::try_from([left, right])
        {
            let origin = Origin::Log("calibrations of the two cameras".to_owned());
            self.put("log.stereo".to_owned(), cameras, origin);
        }
        self.conflicts.truncate(before);
        Ok(())
    }

    fn finish(
        self,
        log: &Path,
        file: Option<&Path>,
        summary: LogSummary,
    ) -> Result<Resolved, ConfigError> {
        let name = match file {
            Some(file) => file.display().to_string(),
            None => format!("configs/{}.toml", self.shipped),
        };
        let mut config = typed::<Config>(self.table.clone(), &name)?.checked(&name)?;
        if let Some(Origin::File(path)) = self.origins.get("log.mask") {
            config.log.mask = config.log.mask.beside(path);
        }
        Ok(Resolved {
            config,
            summary,
            conflicts: self.conflicts,
            log: log.to_owned(),
            file: file.map(Path::to_owned),
            shipped: self.shipped,
            origins: self.origins,
            table: self.table,
        })
    }
}

/// Whether two values say the same but for rounding.
fn is_alike(a: &toml::Value, b: &toml::Value) -> bool {
    let number = |value: &toml::Value| {
        value.as_float().or_else(|| value.as_integer().map(|integer| integer as f64))
    };
    match (a, b) {
        (toml::Value::Array(a), toml::Value::Array(b)) => {
            a.len() == b.len() && a.iter().zip(b).all(|(a, b)| is_alike(a, b))
        }
        _ => match (number(a), number(b)) {
            (Some(a), Some(b)) => (a - b).abs() <= SAME_VALUE * a.abs().max(b.abs()).max(1.0),
            _ => a == b,
        },
    }
}
