//! Calibrations of other programs as our configuration.
//!
//! Every reader turns its conventions into ours and says so in a note:
//!
//! - `camera.imu_from_camera` maps camera to IMU coordinates, `p_imu = imu_from_camera p_camera`;
//! - `camera.time_offset` is added to camera stamps, `t_imu = t_camera + time_offset`;
//! - noises are densities, `rad/s/sqrt(Hz)` and so on.

mod document;
mod kalibr;
mod opencv;
mod orb_slam;
mod vins;
mod write;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use document::Document;
use nalgebra::Matrix4;

use crate::sensor::{CameraConfig, CameraError, CameraModel};

/// A calibration that cannot be taken over.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    #[error("{path}: {source}")]
    Io { path: PathBuf, source: std::io::Error },
    #[error("{path}: no YAML: {reason}")]
    Syntax { path: PathBuf, reason: String },
    #[error(
        "{path}: no calibration of a kind that is known (Kalibr, OpenVINS, VINS, OpenCV, \
         ORB-SLAM); its keys: {keys}"
    )]
    Unknown { path: PathBuf, keys: String },
    #[error("{path}: `{key}` is missing")]
    Missing { path: PathBuf, key: String },
    #[error("{path}: `{key}`: {message}")]
    Value { path: PathBuf, key: String, message: String },
    #[error("{path}: `{key}` = \"{value}\" is not supported; supported are {supported}")]
    Unsupported { path: PathBuf, key: String, value: String, supported: &'static str },
    #[error("camera {camera} of {path}: {source}")]
    Camera { path: PathBuf, camera: usize, source: CameraError },
    #[error("`{key}` is {first} in {first_path}, but {second} in {second_path}")]
    Conflict {
        key: String,
        first: String,
        first_path: PathBuf,
        second: String,
        second_path: PathBuf,
    },
}

/// What is known of the world outside of the files.
#[derive(Debug, Clone, Copy, Default)]
pub struct ImportOptions {
    /// Samples of the IMU a second, for files whose noise is that of a sample (VINS).
    pub imu_rate: Option<f64>,
}

/// A value of our configuration and where it is from.
#[derive(Debug, Clone, PartialEq)]
pub struct ImportedValue {
    pub value: toml::Value,
    pub path: PathBuf,
    /// Key of the file.
    pub source: String,
}

/// What files tell of cameras and IMU.
#[derive(Debug, Clone, Default)]
pub struct Import {
    /// By camera, then by key of [`CameraConfig`].
    cameras: BTreeMap<usize, BTreeMap<&'static str, ImportedValue>>,
    /// By key of the section `imu`.
    imu: BTreeMap<&'static str, ImportedValue>,
    notes: Vec<String>,
    files: Vec<PathBuf>,
}

/// Reads all of `files` and what they refer to.
///
/// # Errors
/// Names the file and its key where a value is of no use, and both files where they contradict each
/// other.
pub fn import(files: &[PathBuf], options: &ImportOptions) -> Result<Import, ImportError> {
    let mut import = Import::default();
    let documents: Vec<Document> =
        files.iter().map(|path| Document::read(path)).collect::<Result<_, _>>()?;
    // A file that another one refers to is read by that one, which knows its camera.
    let referred: Vec<PathBuf> = documents.iter().flat_map(Document::references).collect();
    let is_referred = |path: &Path| {
        let canonical = |path: &Path| path.canonicalize().ok();
        referred.iter().any(|other| canonical(other) == canonical(path))
    };
    for document in documents.iter().filter(|document| !is_referred(&document.path)) {
        import.read(document, options)?;
    }
    import.check()?;
    Ok(import)
}

impl Import {
    fn read(&mut self, document: &Document, options: &ImportOptions) -> Result<(), ImportError> {
        self.files.push(document.path.clone());
        if orb_slam::is(document) {
            orb_slam::read(document, self)
        } else if vins::is(document) {
            vins::read(document, options, self)
        } else if kalibr::is(document) {
            kalibr::read(document, options, self)
        } else if opencv::is(document) {
            opencv::read(document, 0, self)
        } else {
            Err(ImportError::Unknown { path: document.path.clone(), keys: document.keys() })
        }
    }

    /// Every value by our key, `camera.fx` and the like (`log.stereo[1].fx` for a second camera).
    pub fn values(&self) -> Vec<(String, &ImportedValue)> {
        let of_cameras = self.cameras.iter().flat_map(|(camera, values)| {
            let section = match camera {
                0 => "camera".to_owned(),
                camera => format!("log.stereo[{camera}]"),
            };
            values.iter().map(move |(key, value)| (format!("{section}.{key}"), value))
        });
        let of_imu = self.imu.iter().map(|(key, value)| (format!("imu.{key}"), value));
        of_cameras.chain(of_imu).collect()
    }

    /// What a user has to know: conventions, and what was left out.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Every file that was read.
    pub fn files(&self) -> &[PathBuf] {
        &self.files
    }

    fn note(&mut self, text: String) {
        if !self.notes.contains(&text) {
            self.notes.push(text);
        }
    }

    fn imu_value(
        &mut self,
        key: &'static str,
        document: &Document,
        source: &str,
        value: f64,
    ) -> Result<(), ImportError> {
        insert(&mut self.imu, key, document, source, value.into())
    }

    fn camera_value(
        &mut self,
        camera: usize,
        key: &'static str,
        document: &Document,
        source: &str,
        value: impl Into<toml::Value>,
    ) -> Result<(), ImportError> {
        let values = self.cameras.entry(camera).or_default();
        insert(values, key, document, source, value.into())
    }

    /// Model, focal lengths and principal point, and coefficients, and the keys of the file that they
    /// are from.
    fn lens(
        &mut self,
        camera: usize,
        document: &Document,
        [of_model, of_intrinsics, of_distortion]: [&str; 3],
        model: CameraModel,
        [fx, fy, cx, cy]: [f64; 4],
        distortion: Vec<f64>,
    ) -> Result<(), ImportError> {
        self.camera_value(camera, "model", document, of_model, model.name())?;
        for (key, value) in [("fx", fx), ("fy", fy), ("cx", cx), ("cy", cy)] {
            self.camera_value(camera, key, document, of_intrinsics, value)?;
        }
        self.camera_value(camera, "distortion", document, of_distortion, distortion)
    }

    fn mounting(
        &mut self,
        camera: usize,
        document: &Document,
        source: &str,
        imu_from_camera: &Matrix4<f64>,
    ) -> Result<(), ImportError> {
        // Zeros without a sign.
        let row = |row: usize| imu_from_camera.row(row).iter().map(|x| x + 0.0).collect();
        let rows: Vec<Vec<f64>> = (0..4).map(row).collect();
        self.camera_value(camera, "imu_from_camera", document, source, rows)
    }

    /// The configuration of a camera, keys that no file has at their defaults.
    fn camera(&self, camera: usize) -> Option<CameraConfig> {
        let values = self.cameras.get(&camera)?;
        let table: toml::Table = values
            .iter()
            .map(|(key, imported)| ((*key).to_owned(), imported.value.clone()))
            .collect();
        table.try_into().ok()
    }

    fn check(&self) -> Result<(), ImportError> {
        for (camera, values) in &self.cameras {
            let (Some(config), Some(any)) = (self.camera(*camera), values.values().next()) else {
                continue;
            };
            // Files may know the mounting only.
            let known = if values.contains_key("fx") { config.validate() } else { Ok(()) };
            known.map_err(|source| ImportError::Camera {
                path: any.path.clone(),
                camera: *camera,
                source,
            })?;
        }
        Ok(())
    }
}

/// Two files may say the same.
fn insert(
    values: &mut BTreeMap<&'static str, ImportedValue>,
    key: &'static str,
    document: &Document,
    source: &str,
    value: toml::Value,
) -> Result<(), ImportError> {
    let path = document.path.clone();
    match values.get(key) {
        Some(known) if known.value != value => Err(ImportError::Conflict {
            key: key.to_owned(),
            first: known.value.to_string(),
            first_path: known.path.clone(),
            second: value.to_string(),
            second_path: path,
        }),
        Some(_) => Ok(()),
        None => {
            values.insert(key, ImportedValue { value, path, source: source.to_owned() });
            Ok(())
        }
    }
}
