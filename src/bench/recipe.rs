//! The data set that ships as recipes: scenes that are rendered on demand, one log a seed.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use super::error::BenchError;
use super::key::digest;
use super::stereo_folder;
use crate::dataset::LogWriter;
use crate::sensor::Event;
use crate::simulation::{SceneConfig, SceneError, Simulation};

/// What the estimator gets to see of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sensors {
    /// Color and depth images, IMU: an MCAP log.
    Rgbd,
    /// Two grey cameras side by side, IMU: a EuRoC folder.
    Stereo,
    /// The left one of these alone.
    Mono,
}

/// A sequence of the simulated data set.
#[derive(Debug, Clone, Copy)]
pub struct Recipe {
    pub name: &'static str,
    /// Scene file.
    scene: &'static str,
    /// Keys that differ from the scene file.
    changes: &'static str,
    pub sensors: Sensors,
    /// What the estimator believes of the sensors where that is not what they are, as
    /// `SECTION.KEY=VALUE`.
    pub settings: &'static [&'static str],
    /// Faults injected into the log.
    pub faults: &'static [&'static str],
    /// Spans, s after the first message, in which the scene itself is hard enough to be warned of.
    pub disturbed: &'static [[f64; 2]],
    /// Whether `--quick` runs it.
    pub quick: bool,
}

const LAB_SIMPLE: &str = include_str!("../../datasets/lab-simple.toml");
const LAB_MOTION: &str = include_str!("../../datasets/lab-motion.toml");
const LAB_BUMPER: &str = include_str!("../../datasets/lab-bumper.toml");
const LAB_LIGHT: &str = include_str!("../../datasets/lab-light.toml");
const LAB_DYNAMIC: &str = include_str!("../../datasets/lab-dynamic.toml");
const CORRIDOR: &str = include_str!("../../datasets/corridor.toml");
const HALL: &str = include_str!("../../datasets/hall.toml");
const CIRCLE: &str = include_str!("../../datasets/circle.toml");

/// A consumer sensor: scale errors of the IMU, more noise in images, more holes in depth.
const IMPERFECT: &str = "[imu]\ngyro_scale_error = 0.005\naccel_scale_error = 0.005\n\
                         [image]\nnoise = 4.0\n[dropout]\nanywhere = 0.05\nedges = 0.8\n";
/// Camera and IMU are calibrated to 3 ms, a third of a degree and 3 mm.
const MISCALIBRATED: &[&str] = &[
    "camera.time_offset=0.003",
    "camera.imu_from_camera=[[0.00194312, -0.99998676, -0.00466435, -0.00517048], [-0.99999600, -0.00193270, -0.00223606, 0.01507500], [0.00222702, 0.00466867, -0.99998679, -0.01107950], [0.0, 0.0, 0.0, 1.0]]",
];
/// The IMU is the simulator's, whatever the layout of the log suggests.
const SIMULATED_IMU: &[&str] = &[
    "imu.gyro_noise=1e-3",
    "imu.accel_noise=1e-2",
    "imu.gyro_bias_walk=1e-4",
    "imu.accel_bias_walk=1e-3",
    "imu.gyro_bias_sd=1e-2",
    "imu.accel_bias_sd=1e-1",
];
const ALL_OF_IT: &[[f64; 2]] = &[[0.0, f64::INFINITY]];

const fn recipe(name: &'static str, scene: &'static str) -> Recipe {
    Recipe {
        name,
        scene,
        changes: "",
        sensors: Sensors::Rgbd,
        settings: &[],
        faults: &[],
        disturbed: &[],
        quick: false,
    }
}

const fn fault(name: &'static str, faults: &'static [&'static str]) -> Recipe {
    Recipe { faults, ..recipe(name, LAB_SIMPLE) }
}

/// The sequences of `bench sim`; those that share a scene are neighbours, and share its logs.
pub const RECIPES: &[Recipe] = &[
    Recipe { quick: true, ..recipe("lab-simple", LAB_SIMPLE) },
    Recipe { settings: MISCALIBRATED, ..recipe("lab-simple-miscalibrated", LAB_SIMPLE) },
    Recipe { quick: true, ..fault("lab-simple-black", &["black:4:1"]) },
    Recipe { quick: true, ..fault("lab-simple-imu-gap", &["imu-gap:4:0.5"]) },
    fault("lab-simple-imu-noise", &["imu-noise:4:1"]),
    fault("lab-simple-frame-stamps", &["frame-stamps:4:2"]),
    fault("lab-simple-kidnapped", &["kidnapped:4:1"]),
    fault("lab-simple-bias", &["bias:4:1e9"]),
    Recipe { quick: true, ..recipe("lab-motion", LAB_MOTION) },
    Recipe { quick: true, ..recipe("lab-bumper", LAB_BUMPER) },
    Recipe { disturbed: &[[4.0, 22.5]], ..recipe("lab-light", LAB_LIGHT) },
    Recipe { disturbed: ALL_OF_IT, ..recipe("lab-dynamic", LAB_DYNAMIC) },
    Recipe { quick: true, ..recipe("corridor", CORRIDOR) },
    Recipe { quick: true, ..recipe("hall", HALL) },
    recipe("circle", CIRCLE),
    Recipe { changes: IMPERFECT, ..recipe("lab-simple-imperfect", LAB_SIMPLE) },
    Recipe { changes: IMPERFECT, ..recipe("lab-motion-imperfect", LAB_MOTION) },
    Recipe { changes: IMPERFECT, ..recipe("corridor-imperfect", CORRIDOR) },
    Recipe { sensors: Sensors::Stereo, ..recipe("lab-simple-stereo", LAB_SIMPLE) },
    Recipe { sensors: Sensors::Mono, ..recipe("lab-simple-mono", LAB_SIMPLE) },
    Recipe { sensors: Sensors::Stereo, ..recipe("lab-motion-stereo", LAB_MOTION) },
    Recipe { sensors: Sensors::Mono, ..recipe("lab-motion-mono", LAB_MOTION) },
    Recipe { sensors: Sensors::Stereo, ..recipe("corridor-stereo", CORRIDOR) },
    Recipe { sensors: Sensors::Mono, ..recipe("corridor-mono", CORRIDOR) },
];

/// Motion along a trajectory that is given, through a room as large as it needs.
pub const ALONG: Recipe = recipe("along", LAB_SIMPLE);

/// A scene with its seed and length, and where its log belongs.
#[derive(Debug, Clone)]
pub struct SeededScene {
    name: String,
    seed: u64,
    scene: SceneConfig,
    sensors: Sensors,
    digest: String,
}

impl Recipe {
    /// Settings of the estimator for what the sensors are.
    pub fn settings(&self) -> Vec<String> {
        let of_sensors: &[&[&str]] = match self.sensors {
            Sensors::Rgbd => &[],
            Sensors::Stereo => &[SIMULATED_IMU],
            Sensors::Mono => &[SIMULATED_IMU, &["log.right_topic=none"]],
        };
        let all = of_sensors.iter().copied().chain([self.settings]).flatten();
        all.map(|setting| (*setting).to_owned()).collect()
    }

    /// The scene of a seed, `duration` s long, along `trajectory` where one is given.
    ///
    /// # Errors
    /// [`BenchError::Format`] if the recipe is no scene.
    pub fn scene(
        &self,
        name: &str,
        seed: u64,
        duration: f64,
        trajectory: Option<&Path>,
        program: &str,
    ) -> Result<SeededScene, BenchError> {
        let format = |reason| BenchError::Format { path: name.into(), reason };
        let mut scene = SceneConfig::from_layers(&[self.scene, self.changes]).map_err(format)?;
        scene.seed = seed;
        scene.duration = duration;
        let mut input = String::new();
        if let Some(file) = trajectory {
            scene.trajectory.file = file.to_owned();
            let io = |source| BenchError::Io { path: file.to_owned(), source };
            input = digest(&std::fs::read(file).map_err(io)?);
        }
        let text = toml::to_string(&scene).map_err(|error| format(error.to_string()))?;
        let text = format!("{program}\n{:?}\n{input}\n{text}", self.sensors != Sensors::Rgbd);
        let digest = digest(text.as_bytes());
        Ok(SeededScene { name: name.to_owned(), seed, scene, sensors: self.sensors, digest })
    }
}

impl SeededScene {
    /// Frames per second.
    pub fn frame_rate(&self) -> f64 {
        self.scene.image.rate
    }

    pub fn digest(&self) -> &str {
        &self.digest
    }

    /// Where its log lies in a cache.
    pub fn log(&self, cache: &Path) -> PathBuf {
        let Self { seed, digest, .. } = self;
        let motion = self.scene_name();
        match self.sensors {
            Sensors::Rgbd => cache.join(format!("{motion}-{seed}-{digest}.mcap")),
            Sensors::Stereo | Sensors::Mono => cache.join(format!("{motion}-{seed}-{digest}")),
        }
    }

    /// Recipes that share a scene share its log.
    fn scene_name(&self) -> String {
        let motion = toml::Value::try_from(self.scene.motion.kind).ok();
        let built_in = motion.and_then(|kind| kind.as_str().map(str::to_owned));
        match self.scene.trajectory.file.as_os_str().is_empty() {
            true => built_in.unwrap_or_else(|| self.name.clone()),
            false => self.name.clone(),
        }
    }

    /// Renders the log unless it is there. `frame` is told of each frame; `stop` ends it, and what
    /// was rendered so far is dropped.
    ///
    /// # Errors
    /// If the scene is impossible or the log cannot be written; [`ControlFlow::Break`] if stopped.
    pub fn render(
        &self,
        cache: &Path,
        stop: &AtomicBool,
        frame: &mut dyn FnMut(),
    ) -> Result<ControlFlow<(), PathBuf>, BenchError> {
        let log = self.log(cache);
        if log.exists() {
            return Ok(ControlFlow::Continue(log));
        }
        let io = |source| BenchError::Io { path: cache.to_owned(), source };
        std::fs::create_dir_all(cache).map_err(io)?;
        let part = cache.join(format!("part-{}-{}", std::process::id(), self.digest));
        let mut watch = |event: &Event| {
            if matches!(event, Event::Frame(_)) {
                frame();
            }
            match stop.load(Ordering::Relaxed) {
                true => ControlFlow::Break(()),
                false => ControlFlow::Continue(()),
            }
        };
        let rendered = match self.sensors {
            Sensors::Rgbd => simulation(&self.scene).and_then(|simulation| {
                let options = simulation.config().log.clone();
                simulation.write(LogWriter::create(&part, options)?, &mut watch)?;
                Ok(())
            }),
            Sensors::Stereo | Sensors::Mono => stereo_folder::write(&self.scene, &part, &mut watch),
        };
        if rendered.is_err() || stop.load(Ordering::Relaxed) {
            remove(&part);
            return rendered.map(|()| ControlFlow::Break(()));
        }
        std::fs::rename(&part, &log).map_err(io)?;
        Ok(ControlFlow::Continue(log))
    }
}

/// The scene's simulation; of a trajectory that is shorter than asked for, all.
pub(super) fn simulation(scene: &SceneConfig) -> Result<Simulation, BenchError> {
    match Simulation::new(scene.clone()) {
        Err(SceneError::TooLong { .. }) => {
            Ok(Simulation::new(SceneConfig { duration: 0.0, ..scene.clone() })?)
        }
        simulation => Ok(simulation?),
    }
}

/// Removes a log, file or folder; one that is not there is no error.
pub(super) fn remove(log: &Path) {
    let removed = match log.is_dir() {
        true => std::fs::remove_dir_all(log),
        false => std::fs::remove_file(log),
    };
    if let Err(error) = removed
        && error.kind() != std::io::ErrorKind::NotFound
    {
        tracing::warn!("{}: {error}", log.display());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::Fault;

    #[test]
    fn every_recipe_is_a_scene_with_valid_faults_and_settings() {
        for recipe in RECIPES {
            let scene = recipe.scene(recipe.name, 3, 8.0, None, "p").unwrap();
            scene.scene.validate().unwrap();
            assert_eq!((scene.scene.seed, scene.scene.duration), (3, 8.0));
            for fault in recipe.faults {
                fault.parse::<Fault>().unwrap();
            }
            crate::config::Config::shipped("sim", &recipe.settings()).unwrap();
        }
        let mut names: Vec<_> = RECIPES.iter().map(|recipe| recipe.name).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), RECIPES.len());
    }

    #[test]
    fn recipes_that_share_a_scene_share_its_log() {
        let log = |name: &str, seed, program: &str| {
            let recipe = RECIPES.iter().find(|recipe| recipe.name == name).unwrap();
            recipe.scene(name, seed, 8.0, None, program).unwrap().log(Path::new("c"))
        };
        assert_eq!(log("lab-simple", 1, "p"), log("lab-simple-black", 1, "p"));
        assert_eq!(log("lab-simple-stereo", 1, "p"), log("lab-simple-mono", 1, "p"));
        assert_ne!(log("lab-simple", 1, "p"), log("lab-simple", 2, "p"));
        assert_ne!(log("lab-simple", 1, "p"), log("lab-simple", 1, "q"));
        assert_ne!(log("lab-simple", 1, "p"), log("lab-simple-imperfect", 1, "p"));
    }
}
