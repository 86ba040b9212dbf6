use std::path::{Path, PathBuf};

use nalgebra::Isometry3;
use serde::{Deserialize, Serialize};

use super::imperfections::ImperfectionConfig;
use super::measured::MeasuredImuError;
use super::motion::MotionConfig;
use super::render::{DropoutConfig, ImageConfig};
use super::trajectory::{TrajectoryConfig, TrajectoryError};
use super::world::{PeopleConfig, RoomConfig};
use crate::dataset::LogWriterOptions;
use crate::sensor::{Camera, CameraConfig, CameraError};
use crate::vision::DepthConfig;

/// A scene: the world, the motion through it and the sensors. The defaults are a lab room and
/// the sensors of VCU-RVI.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SceneConfig {
    /// Seed of everything random; the same seed and scene give the same log.
    pub seed: u64,
    /// Length of the log, s; 0: all of the trajectory (10 s of a built-in motion).
    pub duration: f64,
    /// Stamp of the first sample on the sensor's clock, s.
    pub start_time: f64,
    pub room: RoomConfig,
    pub people: PeopleConfig,
    pub light: LightConfig,
    pub motion: MotionConfig,
    pub trajectory: TrajectoryConfig,
    /// Model, intrinsics and mounting of the camera. Depth of wide lenses is the range along the ray
    /// (`depth.along`).
    pub camera: CameraConfig,
    pub image: ImageConfig,
    /// Range and noise of the depth sensor. Where neighbours differ by more than `edge_fraction`,
    /// `dropout.edges` applies.
    pub depth: DepthConfig,
    pub dropout: DropoutConfig,
    pub imu: ImuSensorConfig,
    /// What calibration leaves wrong with the sensors.
    pub imperfections: ImperfectionConfig,
    pub truth: TruthConfig,
    pub log: LogWriterOptions,
}

impl Default for SceneConfig {
    fn default() -> Self {
        Self {
            seed: 1,
            duration: 10.0,
            start_time: 100.0,
            room: RoomConfig::default(),
            people: PeopleConfig::default(),
            light: LightConfig::default(),
            motion: MotionConfig::default(),
            trajectory: TrajectoryConfig::default(),
            camera: structure_core_camera(),
            image: ImageConfig::default(),
            depth: structure_core_depth(),
            dropout: DropoutConfig::default(),
            imu: ImuSensorConfig::default(),
            imperfections: ImperfectionConfig::default(),
            truth: TruthConfig::default(),
            log: LogWriterOptions::default(),
        }
    }
}

/// Rate, noise and biases of the simulated IMU: `measured = true + bias + noise`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ImuSensorConfig {
    /// Samples per second.
    pub rate: f64,
    /// Gyroscope white noise, rad/s/sqrt(Hz).
    pub gyro_noise: f64,
    /// Accelerometer white noise, m/s^2/sqrt(Hz).
    pub accel_noise: f64,
    /// Gyroscope bias random walk, rad/s^2/sqrt(Hz).
    pub gyro_bias_walk: f64,
    /// Accelerometer bias random walk, m/s^3/sqrt(Hz).
    pub accel_bias_walk: f64,
    /// Standard deviation of each gyroscope bias at the start, rad/s.
    pub gyro_bias_sd: f64,
    /// Standard deviation of each accelerometer bias at the start, m/s^2.
    pub accel_bias_sd: f64,
    /// Scale error of the gyroscope: `measured = (1 + error) true + ...`.
    pub gyro_scale_error: f64,
    /// Scale error of the accelerometer.
    pub accel_scale_error: f64,
    /// Spans without samples: start and length, s.
    pub gaps: Vec<[f64; 2]>,
    /// Magnitude of gravity, m/s^2.
    pub gravity: f64,
}

impl Default for ImuSensorConfig {
    /// The BMI055 of its data sheet (0.014 deg/s/sqrt(Hz), 150 ug/sqrt(Hz)), with the vibration
    /// of a hand-held rig left out.
    fn default() -> Self {
        Self {
            rate: 200.0,
            gyro_noise: 2.4e-4,
            accel_noise: 1.5e-3,
            gyro_bias_walk: 2.0e-5,
            accel_bias_walk: 1.0e-4,
            gyro_bias_sd: 3.0e-3,
            accel_bias_sd: 5.0e-2,
            gyro_scale_error: 0.0,
            accel_scale_error: 0.0,
            gaps: Vec::new(),
            gravity: 9.81,
        }
    }
}

/// How the light of the room, or the exposure of the camera, changes.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LightConfig {
    /// Pairs of time (s) and factor on the light, in the order of time, with smooth transitions;
    /// constant before the first and after the last. None: 1 throughout; 0: darkness.
    pub keys: Vec<[f64; 2]>,
}

impl LightConfig {
    /// Factor on the light at `t` seconds from the start.
    pub(super) fn at(&self, t: f64) -> f64 {
        let after = self.keys.partition_point(|[time, _]| *time <= t);
        match (after.checked_sub(1).and_then(|k| self.keys.get(k)), self.keys.get(after)) {
            (Some([t0, before]), Some([t1, after])) => {
                let u = (t - t0) / (t1 - t0);
                before + (after - before) * u * u * (3.0 - 2.0 * u)
            }
            (Some([_, level]), None) | (None, Some([_, level])) => *level,
            (None, None) => 1.0,
        }
    }
}

/// The reference poses in the log.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TruthConfig {
    /// Poses per second; 0 leaves them out.
    pub rate: f64,
}

impl Default for TruthConfig {
    fn default() -> Self {
        Self { rate: 120.0 }
    }
}

/// A scene that cannot be simulated.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    #[error("{path}: {source}")]
    Io { path: PathBuf, source: std::io::Error },
    #[error("scene: room.images: {path}: {source}")]
    Image { path: PathBuf, source: image::ImageError },
    #[error("{path}: {reason}")]
    Syntax { path: PathBuf, reason: String },
    #[error("scene: {key} = {value}: {requirement}")]
    Value { key: &'static str, value: String, requirement: &'static str },
    #[error("scene: duration = {wanted} s: the trajectory lasts for {available:.2} s")]
    TooLong { wanted: f64, available: f64 },
    #[error("scene: the path needs a room of {size:.1?} m; at most {limit} m a side are possible")]
    PathTooWide { size: [f64; 3], limit: f64 },
    #[error("scene: camera.{0}")]
    Camera(#[from] CameraError),
    #[error(transparent)]
    Trajectory(#[from] TrajectoryError),
    #[error(transparent)]
    Imu(#[from] MeasuredImuError),
}

impl SceneConfig {
    /// Longest side of a room, m; the textures of larger ones would not fit into memory.
    pub(super) const MAX_ROOM: f64 = 100.0;

    /// Reads a scene file; keys that it leaves out keep their defaults.
    pub fn from_file(path: &Path) -> Result<Self, SceneError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| SceneError::Io { path: path.to_owned(), source })?;
        let syntax = |reason| SceneError::Syntax { path: path.to_owned(), reason };
        Self::from_toml(&text).map_err(syntax)
    }

    /// As [`Self::from_file`], from text; the error is a line for the user.
    pub fn from_toml(text: &str) -> Result<Self, String> {
        Self::from_layers(&[text])
    }

    /// As [`Self::from_toml`], from several texts: keys of a later one replace those before.
    pub fn from_layers(texts: &[&str]) -> Result<Self, String> {
        let line = |e: toml::de::Error| e.to_string().trim().replace('\n', " ");
        let mut scene = toml::Table::try_from(Self::default()).map_err(|e| e.to_string())?;
        for text in texts {
            overlay(&mut scene, text.parse().map_err(line)?);
        }
        scene.try_into().map_err(line)
    }

    /// The camera, with depth as it is written.
    pub fn lens(&self) -> Result<Camera, SceneError> {
        Ok(Camera::new(&self.camera)?.with_depth(self.depth.along))
    }

    /// Checks values that no type can; returns the camera's pose in the body frame.
    pub fn validate(&self) -> Result<Isometry3<f64>, SceneError> {
        let positive = [
            ("motion.speed", self.motion.speed),
            ("trajectory.cutoff", self.trajectory.cutoff),
            ("trajectory.height", self.trajectory.height),
            ("image.rate", self.image.rate),
            ("imu.rate", self.imu.rate),
            ("imu.gravity", self.imu.gravity),
            ("room.texel", self.room.texel),
            ("room.size[0]", self.room.size[0]),
            ("room.size[1]", self.room.size[1]),
            ("room.size[2]", self.room.size[2]),
        ];
        for (key, value) in positive {
            require(value > 0.0 && value.is_finite(), key, value, "must be positive")?;
        }
        let not_negative = [
            ("start_time", self.start_time),
            ("truth.rate", self.truth.rate),
            ("people.speed", self.people.speed),
            ("duration", self.duration),
            ("room.clearance", self.room.clearance),
            ("trajectory.start", self.trajectory.start),
            ("trajectory.max_gap", self.trajectory.max_gap),
            ("motion.standstill", self.motion.standstill),
            ("motion.ramp", self.motion.ramp),
            ("imu.gyro_noise", self.imu.gyro_noise),
            ("imu.accel_noise", self.imu.accel_noise),
            ("imu.gyro_bias_walk", self.imu.gyro_bias_walk),
            ("imu.accel_bias_walk", self.imu.accel_bias_walk),
            ("imu.gyro_bias_sd", self.imu.gyro_bias_sd),
            ("imu.accel_bias_sd", self.imu.accel_bias_sd),
            ("image.exposure", self.image.exposure),
            ("image.noise", self.image.noise),
            ("image.shutter", self.image.shutter),
        ];
        for (key, value) in not_negative.into_iter().chain(self.imperfections.sizes()) {
            let valid = value >= 0.0 && value.is_finite();
            require(valid, key, value, "must be zero or more, and finite")?;
        }
        require(self.duration <= 86_400.0, "duration", self.duration, "must be at most a day")?;
        for (key, error) in [
            ("imu.gyro_scale_error", self.imu.gyro_scale_error),
            ("imu.accel_scale_error", self.imu.accel_scale_error),
        ] {
            require(error.abs() < 1.0, key, error, "must be between -1 and 1")?;
        }
        for (key, fraction) in [
            ("room.richness", self.room.richness),
            ("image.vignetting", self.image.vignetting),
            ("dropout.anywhere", self.dropout.anywhere),
            ("dropout.edges", self.dropout.edges),
            ("dropout.grazing_cosine", self.dropout.grazing_cosine),
        ] {
            require((0.0..=1.0).contains(&fraction), key, fraction, "must be from 0 to 1")?;
        }
        for (key, gaps) in [("imu.gaps", &self.imu.gaps), ("image.gaps", &self.image.gaps)] {
            let valid = gaps.iter().flatten().all(|x| *x >= 0.0 && x.is_finite());
            require(valid, key, format!("{gaps:?}"), "must be pairs of start and length in s")?;
        }
        let offset = self.log.log_time_offset;
        require(offset.is_finite(), "log.log_time_offset", offset, "must be finite")?;
        let texel = self.room.texel;
        require(texel >= 0.002, "room.texel", texel, "must be at least 0.002 m")?;
        let ordered = self.light.keys.windows(2).all(|pair| pair[0][0] < pair[1][0]);
        let usable = self.light.keys.iter().all(|[t, f]| t.is_finite() && *f >= 0.0 && *f < 1e3);
        let keys = format!("{:?}", self.light.keys);
        let rule = "must be pairs of increasing times and factors from 0 to 1000";
        require(ordered && usable, "light.keys", keys, rule)?;
        for side in self.room.size {
            let rule = "must be at most 100 m a side";
            require(side <= Self::MAX_ROOM, "room.size", side, rule)?;
        }
        for (key, pixels) in
            [("image.width", self.image.width), ("image.height", self.image.height)]
        {
            require((1..=4096).contains(&pixels), key, pixels, "must be from 1 to 4096 pixels")?;
        }
        let up = self.trajectory.up;
        let finite = up.iter().all(|x| x.is_finite());
        require(finite, "trajectory.up", format!("{up:?}"), "must be finite")?;
        self.lens()?;
        self.camera.imu_from_camera().ok_or_else(|| SceneError::Value {
            key: "camera.imu_from_camera",
            value: format!("{:?}", self.camera.imu_from_camera),
            requirement: "must be a rigid transform",
        })
    }
}

fn require(
    valid: bool,
    key: &'static str,
    value: impl ToString,
    requirement: &'static str,
) -> Result<(), SceneError> {
    let error = || SceneError::Value { key, value: value.to_string(), requirement };
    if valid { Ok(()) } else { Err(error()) }
}

/// Puts the values of `given` over those of `base`, table by table.
fn overlay(base: &mut toml::Table, given: toml::Table) {
    for (key, value) in given {
        match (base.get_mut(&key), value) {
            (Some(toml::Value::Table(inner)), toml::Value::Table(value)) => overlay(inner, value),
            (_, value) => {
                base.insert(key, value);
            }
        }
    }
}

/// Color camera of VCU-RVI and its mounting on the IMU.
fn structure_core_camera() -> CameraConfig {
    CameraConfig {
        fx: 459.357,
        fy: 459.764,
        cx: 332.695,
        cy: 258.998,
        imu_from_camera: [
            [0.00193013, -0.999997, 0.00115338, -0.00817048],
            [-0.999996, -0.0019327, -0.00223606, 0.015075],
            [0.00223829, -0.00114906, -0.999997, -0.0110795],
            [0.0, 0.0, 0.0, 1.0],
        ],
        ..CameraConfig::default()
    }
}

/// Noise law of the Structure Core at the image centre.
fn structure_core_depth() -> DepthConfig {
    DepthConfig {
        min: 0.3,
        max: 5.0,
        noise_floor: 0.0007,
        noise_quadratic: 0.00155816,
        noise_linear: -0.00362021,
        noise_constant: 0.00452812,
        ..DepthConfig::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_left_out_keep_their_defaults() {
        let scene = SceneConfig::from_toml("seed = 7\n[camera]\ntime_offset = 0.01\n").unwrap();
        assert_eq!(scene.seed, 7);
        assert_eq!(scene.camera.fx, structure_core_camera().fx);
        assert_eq!(scene.camera.time_offset, 0.01);
        assert_eq!(SceneConfig::from_toml("").unwrap(), SceneConfig::default());
    }

    #[test]
    fn every_recipe_is_a_valid_scene() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("datasets");
        let mut recipes = 0;
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.extension().is_some_and(|e| e == "toml") {
                SceneConfig::from_file(&path).unwrap().validate().unwrap();
                recipes += 1;
            }
        }
        assert!(recipes >= 9);
    }

    #[test]
    fn light_follows_its_keys() {
        let light = LightConfig { keys: vec![[2.0, 1.0], [4.0, 0.0]] };
        assert_eq!([0.0, 2.0, 3.0, 4.0, 9.0].map(|t| light.at(t)), [1.0, 1.0, 0.5, 0.0, 0.0]);
        assert_eq!(LightConfig::default().at(3.0), 1.0);
    }

    #[test]
    fn unknown_keys_are_named() {
        let error = SceneConfig::from_toml("[imu]\nraet = 100\n").unwrap_err();
        assert!(error.contains("raet") && error.contains("rate"), "{error}");
    }

    #[test]
    fn impossible_values_are_named() {
        for (text, key) in [
            ("duration = -1.0", "duration"),
            ("[imu]\nrate = nan", "imu.rate"),
            ("[image]\nwidth = 0", "image.width"),
            ("[light]\nkeys = [[2, 1], [1, 0]]", "light.keys"),
            ("[room]\nsize = [1e9, 5, 3]", "room.size"),
            ("[camera]\nmodel = \"equidistant\"\ndistortion = [0.1]", "camera.distortion"),
            ("[camera]\nfx = -1.0", "camera.fx"),
        ] {
            let error = SceneConfig::from_toml(text).unwrap().validate().unwrap_err();
            assert!(error.to_string().contains(key), "{error}");
        }
    }
}
