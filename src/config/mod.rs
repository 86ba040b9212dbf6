//! The configuration of a run: one TOML file a sensor set-up, single keys overridden by `--set`.
//!
//! [`Resolved::of`] makes the configuration for a log, of layers: the defaults, the shipped file for
//! the log's layout, what the log tells of its sensors, a given file, the command line. Each value
//! knows its [`Origin`].

#[cfg(feature = "vision")]
mod front_end;
mod resolve;

pub mod import;

use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::dataset::{LogConfig, LogError};
use crate::fault::FaultConfig;
use crate::filter::FilterConfig;
use crate::filter::attitude::AdaptiveConfig;
use crate::filter::gnss::GnssConfig;
use crate::inertial::{ImuConfig, StandstillConfig};
use crate::map::MapConfig;
use crate::odometry::{HealthConfig, InitConfig, OdometryConfig, TruthConfig};
use crate::sensor::{Camera, CameraConfig, CameraError};
use crate::tracking::SearchConfig;
use crate::viewer::RecordingConfig;
use crate::vision::{
    DepthConfig, FeatureConfig, MatchingConfig, PatchConfig, RansacConfig, TrackerConfig,
};

pub use resolve::{Conflict, Origin, Resolved, Setting};

/// Everything a replay can be told, by section.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    pub log: LogConfig,
    pub imu: ImuConfig,
    pub camera: CameraConfig,
    pub depth: DepthConfig,
    pub features: FeatureConfig,
    pub search: SearchConfig,
    pub matching: MatchingConfig,
    pub patch: PatchConfig,
    pub tracker: TrackerConfig,
    pub ransac: RansacConfig,
    pub map: MapConfig,
    pub filter: FilterConfig,
    pub init: InitConfig,
    pub standstill: StandstillConfig,
    pub truth: TruthConfig,
    pub health: HealthConfig,
    pub faults: FaultConfig,
    pub recording: RecordingConfig,
}

/// The configurations that come with the program, by the name a log's layout asks for.
const SHIPPED: [(&str, &str); 6] = [
    ("vcu_rvi", include_str!("../../configs/vcu_rvi.toml")),
    ("tum_rgbd", include_str!("../../configs/tum_rgbd.toml")),
    ("seven_scenes", include_str!("../../configs/seven_scenes.toml")),
    ("euroc", include_str!("../../configs/euroc.toml")),
    ("sim", include_str!("../../configs/sim.toml")),
    (GENERIC, include_str!("../../configs/generic.toml")),
];

/// The configuration of sensors that are not known: without the calibration of a camera.
const GENERIC: &str = "generic";

/// The configurations of `gnss`, by the name that a log's layout asks for.
const GNSS: [(&str, &str); 2] = [
    ("gnss", include_str!("../../configs/gnss.toml")),
    ("kitti", include_str!("../../configs/kitti.toml")),
];

/// The configuration of `attitude` where none is given.
const ATTITUDE: &str = include_str!("../../configs/attitude.toml");

#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    #[error("{path}: {source}")]
    Io { path: PathBuf, source: std::io::Error },
    #[error("{origin}: {message}")]
    Syntax { origin: String, message: String },
    #[error("{origin}: unknown key `{key}`{}", suggestion(.nearest))]
    UnknownKey { origin: String, key: String, nearest: Option<String> },
    #[error("{origin}: `{key}`: {message}")]
    BadValue { origin: String, key: String, message: String },
    #[error("no configuration `{name}` is shipped; there are: {}", shipped_names().join(", "))]
    NotShipped { name: String },
    #[error("`--set {text}` is not of the form SECTION.KEY=VALUE")]
    Override { text: String },
    #[error(transparent)]
    Log(#[from] LogError),
    #[error("{log}: {reason}")]
    NoCalibration { log: PathBuf, reason: String },
}

fn suggestion(nearest: &Option<String>) -> String {
    nearest.as_ref().map(|key| format!("; did you mean `{key}`?")).unwrap_or_default()
}

pub fn shipped_names() -> Vec<&'static str> {
    SHIPPED.iter().map(|(name, _)| *name).collect()
}

impl Config {
    /// The configuration that is shipped under `name`, with `overrides` (`section.key=value`).
    pub fn shipped(name: &str, overrides: &[String]) -> Result<Self, ConfigError> {
        let origin = format!("configs/{name}.toml");
        parse::<Self>(shipped_text(name)?, &origin, overrides)?.checked(&origin)
    }

    /// A configuration file's text; keys that it leaves out have their defaults.
    pub fn from_toml(text: &str) -> Result<Self, ConfigError> {
        parse::<Self>(text, "configuration", &[])?.checked("configuration")
    }

    /// Itself if its cameras are possible ones.
    fn checked(self, origin: &str) -> Result<Self, ConfigError> {
        let check = |section: &str, camera: &CameraConfig| {
            camera.validate().map_err(|error| ConfigError::BadValue {
                origin: origin.to_owned(),
                key: format!("{section}.{}", error.key()),
                message: error.to_string(),
            })
        };
        check("camera", &self.camera)?;
        self.log.stereo.iter().try_for_each(|camera| check("log.stereo", camera))?;
        Ok(self)
    }

    /// The camera, with depth as it is measured.
    ///
    /// # Errors
    /// See [`CameraConfig::validate`].
    pub fn lens(&self) -> Result<Camera, CameraError> {
        Ok(Camera::new(&self.camera)?.with_depth(self.depth.along))
    }

    /// The sections that the pipeline behind the front end needs.
    pub fn odometry(&self) -> OdometryConfig {
        OdometryConfig {
            imu: self.imu.clone(),
            camera: self.camera.clone(),
            others: self.log.stereo.get(1..).unwrap_or_default().to_vec(),
            depth: self.depth.clone(),
            search: self.search.clone(),
            matching: self.matching.clone(),
            patch: self.patch.clone(),
            ransac: self.ransac.clone(),
            map: self.map.clone(),
            filter: self.filter.clone(),
            init: self.init.clone(),
            standstill: self.standstill.clone(),
            truth: self.truth.clone(),
            health: self.health.clone(),
            faults: self.faults.clone(),
        }
    }
}

fn shipped_text(name: &str) -> Result<&'static str, ConfigError> {
    let shipped = SHIPPED.iter().find(|(shipped, _)| *shipped == name);
    let (_, text) = shipped.ok_or_else(|| ConfigError::NotShipped { name: name.to_owned() })?;
    Ok(text)
}

impl GnssConfig {
    /// The configuration that is shipped under `name`, with `overrides` (`section.key=value`).
    pub fn shipped(name: &str, overrides: &[String]) -> Result<Self, ConfigError> {
        let shipped = GNSS.iter().find(|(shipped, _)| *shipped == name);
        let (_, text) = shipped.ok_or_else(|| ConfigError::NotShipped { name: name.to_owned() })?;
        parse(text, &format!("configs/{name}.toml"), overrides)
    }

    /// Reads `path` and applies `overrides` (`section.key=value`).
    pub fn load(path: &Path, overrides: &[String]) -> Result<Self, ConfigError> {
        parse(&read(path)?, &path.display().to_string(), overrides)
    }
}

impl AdaptiveConfig {
    /// `configs/attitude.toml`, with `overrides` (`section.key=value`).
    pub fn shipped(overrides: &[String]) -> Result<Self, ConfigError> {
        parse(ATTITUDE, "configs/attitude.toml", overrides)
    }

    /// Reads `path` and applies `overrides` (`section.key=value`). In a file of `replay` the
    /// sections of images and maps are passed over.
    pub fn load(path: &Path, overrides: &[String]) -> Result<Self, ConfigError> {
        let origin = path.display().to_string();
        let mut table = table(&read(path)?, &origin)?;
        let (own, of_replay) = (valid_keys::<Self>()?, valid_keys::<Config>()?);
        let is_own = |section: &str| own.iter().any(|key| key.split('.').next() == Some(section));
        let foreign: toml::Table = table
            .iter()
            .filter(|(name, _)| !is_own(name))
            .map(|(k, v)| (k.clone(), v.clone()))
            .collect();
        check_keys(&foreign, &[own.clone(), of_replay].concat(), &origin)?;
        table.retain(|section, _| is_own(section));
        parse_table(table, &origin, overrides)
    }
}

fn read(path: &Path) -> Result<String, ConfigError> {
    std::fs::read_to_string(path)
        .map_err(|source| ConfigError::Io { path: path.to_owned(), source })
}

/// A configuration of this type from TOML; keys that are not given have their defaults.
fn parse<T>(text: &str, origin: &str, overrides: &[String]) -> Result<T, ConfigError>
where
    T: Default + Serialize + DeserializeOwned,
{
    parse_table(table(text, origin)?, origin, overrides)
}

fn table(text: &str, origin: &str) -> Result<toml::Table, ConfigError> {
    text.parse().map_err(|error: toml::de::Error| ConfigError::Syntax {
        origin: origin.to_owned(),
        message: error.to_string(),
    })
}

/// The tables of a TOML text, once all of its keys are known.
fn table_of(text: &str, origin: &str, valid: &[String]) -> Result<toml::Table, ConfigError> {
    let table = table(text, origin)?;
    check_keys(&table, valid, origin)?;
    Ok(table)
}

fn parse_table<T>(
    mut table: toml::Table,
    origin: &str,
    overrides: &[String],
) -> Result<T, ConfigError>
where
    T: Default + Serialize + DeserializeOwned,
{
    let valid = valid_keys::<T>()?;
    check_keys(&table, &valid, origin)?;
    for text in overrides {
        let (key, value) = assignment(text, &valid)?;
        put(&mut table, &key, value);
    }
    typed(table, origin)
}

fn typed<T: DeserializeOwned>(table: toml::Table, origin: &str) -> Result<T, ConfigError> {
    serde_path_to_error::deserialize(toml::Value::Table(table)).map_err(|error| {
        ConfigError::BadValue {
            origin: origin.to_owned(),
            key: error.path().to_string(),
            // In one line: without another one that names the key again.
            message: error.inner().message().trim().to_owned(),
        }
    })
}

/// Every `section.key` there is, from the defaults.
fn valid_keys<T: Default + Serialize>() -> Result<Vec<String>, ConfigError> {
    let defaults = toml::Table::try_from(T::default()).map_err(|error| ConfigError::Syntax {
        origin: "defaults".to_owned(),
        message: error.to_string(),
    })?;
    Ok(flat_keys(&defaults))
}

fn flat_keys(table: &toml::Table) -> Vec<String> {
    let keys_of = |(section, value): (&String, &toml::Value)| match value {
        toml::Value::Table(keys) => {
            keys.keys().map(|key| format!("{section}.{key}")).collect::<Vec<_>>()
        }
        _ => vec![section.clone()],
    };
    table.iter().flat_map(keys_of).collect()
}

fn check_keys(table: &toml::Table, valid: &[String], origin: &str) -> Result<(), ConfigError> {
    flat_keys(table).iter().try_for_each(|key| check_key(key, valid, origin))
}

fn check_key(key: &str, valid: &[String], origin: &str) -> Result<(), ConfigError> {
    if valid.iter().any(|known| known == key) {
        return Ok(());
    }
    let nearest = valid
        .iter()
        .map(|known| (strsim::jaro_winkler(key, known), known))
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .filter(|(similarity, _)| *similarity > 0.7)
        .map(|(_, known)| known.clone());
    Err(ConfigError::UnknownKey { origin: origin.to_owned(), key: key.to_owned(), nearest })
}

/// What is no TOML: a number such as `-.5`, or else a string.
fn plain_value(text: &str) -> toml::Value {
    let number = text.parse().ok().filter(|number: &f64| number.is_finite());
    number.map_or_else(|| toml::Value::String(text.to_owned()), toml::Value::Float)
}

/// Key and value of `section.key=value`; a value that is neither TOML nor a number is taken as a
/// string.
fn assignment(text: &str, valid: &[String]) -> Result<(String, toml::Value), ConfigError> {
    let malformed = || ConfigError::Override { text: text.to_owned() };
    let (path, value) = text.split_once('=').ok_or_else(malformed)?;
    let path = path.trim();
    if !path.contains('.') {
        return Err(malformed());
    }
    check_key(path, valid, "--set")?;
    let value = format!("value = {value}")
        .parse::<toml::Table>()
        .ok()
        .and_then(|mut parsed| parsed.remove("value"))
        .unwrap_or_else(|| plain_value(value.trim()));
    Ok((path.to_owned(), value))
}

/// Sets `section.key` in a table of sections.
fn put(table: &mut toml::Table, path: &str, value: toml::Value) {
    let Some((section, key)) = path.split_once('.') else { return };
    let section =
        table.entry(section.to_owned()).or_insert_with(|| toml::Value::Table(toml::Table::new()));
    if let Some(section) = section.as_table_mut() {
        section.insert(key.to_owned(), value);
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    fn set(text: &str) -> Result<Config, ConfigError> {
        Config::shipped("sim", &[text.to_owned()])
    }

    #[test]
    fn every_shipped_file_is_valid_and_names_every_key() {
        let valid = valid_keys::<Config>().unwrap();
        for (name, text) in SHIPPED {
            Config::shipped(name, &[]).unwrap();
            let given = flat_keys(&text.parse().unwrap());
            let missing = valid.iter().filter(|key| !given.contains(key)).map(String::as_str);
            // What has to come from the log or from a file of one's own is not made up.
            let open = if name == GENERIC { resolve::CALIBRATION } else { &[][..] };
            let open: BTreeSet<&str> = open.iter().copied().collect();
            assert_eq!(missing.collect::<BTreeSet<_>>(), open, "{name}");
        }
        for (name, text) in GNSS {
            GnssConfig::shipped(name, &[]).unwrap();
            let given = flat_keys(&text.parse().unwrap());
            assert_eq!(given.len(), valid_keys::<GnssConfig>().unwrap().len(), "{given:?}");
        }
    }

    #[test]
    fn a_key_can_be_overridden() {
        assert_eq!(set("imu.gyro_noise=1e-3").unwrap().imu.gyro_noise, 1e-3);
        assert_eq!(set("imu.gravity=10").unwrap().imu.gravity, 10.0);
        assert_eq!(set("camera.time_offset=-.5").unwrap().camera.time_offset, -0.5);
        assert_eq!(set("log.color_topic=/my/image").unwrap().log.color_topic, "/my/image");
    }

    #[test]
    fn the_shipped_file_of_attitude_holds_the_defaults_and_shares_the_imu_with_replay() {
        assert_eq!(AdaptiveConfig::shipped(&[]).unwrap(), AdaptiveConfig::default());
        let given = flat_keys(&ATTITUDE.parse().unwrap());
        assert_eq!(given.len(), valid_keys::<AdaptiveConfig>().unwrap().len(), "{given:?}");

        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("both.toml");
        std::fs::write(&path, shipped_text("vcu_rvi").unwrap()).unwrap();
        let shared = AdaptiveConfig::load(&path, &["rest.reading_sd=1e-3".to_owned()]).unwrap();
        assert_eq!(shared.imu, Config::shipped("vcu_rvi", &[]).unwrap().imu);
        assert_eq!(shared.rest.reading_sd, 1e-3);
        for (text, key) in
            [("[camera]\nfy_ = 1.0", "camera.fy_"), ("[magnetic]\nnoize = 1", "magnetic.noize")]
        {
            std::fs::write(&path, text).unwrap();
            let message = AdaptiveConfig::load(&path, &[]).unwrap_err().to_string();
            assert!(message.contains(&format!("unknown key `{key}`; did you mean")), "{message}");
        }
    }

    #[test]
    fn mistakes_name_the_key_and_the_nearest_valid_one() {
        let message = set("imu.gyro_nois=1").unwrap_err().to_string();
        assert!(message.contains("imu.gyro_nois`") && message.contains("`imu.gyro_noise`"));
        let message = set("imu.gravity=fast").unwrap_err().to_string();
        assert!(message.contains("imu.gravity"), "{message}");
        assert!(matches!(set("imu.gravity"), Err(ConfigError::Override { .. })));
        assert!(matches!(set("gravity=1"), Err(ConfigError::Override { .. })));
        assert!(matches!(Config::shipped("nope", &[]), Err(ConfigError::NotShipped { .. })));
    }
}
