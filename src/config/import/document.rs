//! A YAML file, OpenCV's dialect included.

use std::path::{Path, PathBuf};

use nalgebra::Matrix4;
use saphyr::{LoadableYamlNode, Scalar, Yaml};
use serde_json::{Map, Number, Value};

use super::ImportError;
use crate::sensor::CameraConfig;

/// Keys by which a file names others, relative to itself: OpenVINS and VINS-Fusion.
const REFERENCES: [&str; 4] =
    ["relative_config_imu", "relative_config_imucam", "cam0_calib", "cam1_calib"];

/// A file and what is in it.
#[derive(Debug)]
pub(super) struct Document {
    pub path: PathBuf,
    root: Value,
}

impl Document {
    pub fn read(path: &Path) -> Result<Self, ImportError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| ImportError::Io { path: path.to_owned(), source })?;
        Self::parse(path, &text)
    }

    pub fn parse(path: &Path, text: &str) -> Result<Self, ImportError> {
        let syntax = |reason: String| ImportError::Syntax { path: path.to_owned(), reason };
        let documents =
            Yaml::load_from_str(&plain(text)).map_err(|error| syntax(error.to_string()))?;
        let root = documents.first().map_or(Value::Null, json);
        if !root.is_object() {
            return Err(syntax("no keys with values".to_owned()));
        }
        Ok(Self { path: path.to_owned(), root })
    }

    /// The file that `key` names.
    pub fn reference(&self, key: &str) -> Option<PathBuf> {
        let name = self.text(key)?;
        Some(self.path.parent().unwrap_or(Path::new("")).join(name))
    }

    pub fn references(&self) -> Vec<PathBuf> {
        REFERENCES.iter().filter_map(|key| self.reference(key)).collect()
    }

    /// Keys of the file itself, for messages.
    pub fn keys(&self) -> String {
        let keys: Vec<_> = self.root.as_object().into_iter().flatten().map(|(k, _)| &**k).collect();
        keys.join(", ")
    }

    /// The value at `key`, a path through tables; a key may have dots itself (`Camera.fx`).
    pub fn get(&self, key: &str) -> Option<&Value> {
        fn find<'a>(value: &'a Value, key: &str) -> Option<&'a Value> {
            let table = value.as_object()?;
            table.get(key).or_else(|| {
                let (first, rest) = key.split_once('.')?;
                find(table.get(first)?, rest)
            })
        }
        find(&self.root, key).filter(|value| !value.is_null())
    }

    pub fn has(&self, key: &str) -> bool {
        self.get(key).is_some()
    }

    pub fn text(&self, key: &str) -> Option<&str> {
        self.get(key)?.as_str()
    }

    fn wrong(&self, key: &str, message: &str) -> ImportError {
        let (path, key) = (self.path.clone(), key.to_owned());
        ImportError::Value { path, key, message: message.to_owned() }
    }

    fn missing(&self, key: &str) -> ImportError {
        ImportError::Missing { path: self.path.clone(), key: key.to_owned() }
    }

    pub fn unsupported(&self, key: &str, supported: &'static str) -> ImportError {
        let value =
            self.get(key).map(|value| value.as_str().map_or(value.to_string(), str::to_owned));
        let (path, key) = (self.path.clone(), key.to_owned());
        ImportError::Unsupported { path, key, value: value.unwrap_or_default(), supported }
    }

    /// A finite number, if there is one.
    pub fn number(&self, key: &str) -> Result<Option<f64>, ImportError> {
        let Some(value) = self.get(key) else { return Ok(None) };
        let number = value.as_f64().filter(|x| x.is_finite());
        number.map(Some).ok_or_else(|| self.wrong(key, "must be a finite number"))
    }

    pub fn required(&self, key: &str) -> Result<f64, ImportError> {
        self.number(key)?.ok_or_else(|| self.missing(key))
    }

    /// Numbers of a list, of nested lists row by row, or of an OpenCV matrix.
    pub fn numbers(&self, key: &str) -> Result<Option<Vec<f64>>, ImportError> {
        fn flatten(value: &Value, into: &mut Vec<f64>) -> Option<()> {
            match value {
                Value::Array(items) => items.iter().try_for_each(|item| flatten(item, into)),
                item => {
                    into.push(item.as_f64().filter(|x| x.is_finite())?);
                    Some(())
                }
            }
        }
        let Some(value) = self.get(key) else { return Ok(None) };
        let mut numbers = Vec::new();
        let list = value.get("data").unwrap_or(value);
        match (list.is_array(), flatten(list, &mut numbers)) {
            (true, Some(())) => Ok(Some(numbers)),
            _ => Err(self.wrong(key, "must be a list of finite numbers")),
        }
    }

    pub fn list<const N: usize>(&self, key: &str) -> Result<[f64; N], ImportError> {
        let numbers = self.numbers(key)?.ok_or_else(|| self.missing(key))?;
        let message = || format!("has {} numbers instead of {N}", numbers.len());
        numbers[..].try_into().map_err(|_| self.wrong(key, &message()))
    }

    /// A pose from a row-major 4x4 matrix, if there is one.
    pub fn pose(&self, key: &str) -> Result<Option<Matrix4<f64>>, ImportError> {
        if !self.has(key) {
            return Ok(None);
        }
        self.pose_of(key, &self.list(key)?).map(Some)
    }

    /// A pose from its row-major 3x3 and 3x1 parts, if there is one.
    pub fn pose_in_parts(
        &self,
        rotation: &str,
        translation: &str,
    ) -> Result<Option<Matrix4<f64>>, ImportError> {
        if !self.has(rotation) {
            return Ok(None);
        }
        let (r, t): ([f64; 9], [f64; 3]) = (self.list(rotation)?, self.list(translation)?);
        let rows = [0, 1, 2].map(|k| [r[3 * k], r[3 * k + 1], r[3 * k + 2], t[k]]);
        let matrix: Vec<f64> = rows.into_iter().flatten().chain([0.0, 0.0, 0.0, 1.0]).collect();
        let matrix: [f64; 16] = std::array::from_fn(|k| matrix[k]);
        self.pose_of(rotation, &matrix).map(Some)
    }

    fn pose_of(&self, key: &str, matrix: &[f64; 16]) -> Result<Matrix4<f64>, ImportError> {
        let matrix = Matrix4::from_row_slice(matrix);
        let camera =
            CameraConfig { imu_from_camera: matrix.transpose().into(), ..CameraConfig::default() };
        let bottom = [matrix.m41, matrix.m42, matrix.m43, matrix.m44];
        let is_rigid = camera.imu_from_camera().is_some() && bottom == [0.0, 0.0, 0.0, 1.0];
        if is_rigid { Ok(matrix) } else { Err(self.wrong(key, "is no rigid transform")) }
    }
}

/// Of a rigid transform, with the digits of its rotation.
pub(super) fn inverse(pose: &Matrix4<f64>) -> Matrix4<f64> {
    let rotation = pose.fixed_view::<3, 3>(0, 0).transpose();
    let translation = -(rotation * pose.fixed_view::<3, 1>(0, 3));
    let mut inverse = rotation.to_homogeneous();
    inverse.fixed_view_mut::<3, 1>(0, 3).copy_from(&translation);
    inverse
}

/// YAML 1.2 from OpenCV's: its first line is `%YAML:1.0`, its matrices are tagged.
fn plain(text: &str) -> String {
    let text = text.trim_start_matches('\u{feff}');
    let lines = text.lines().map(|line| {
        let is_directive = line.starts_with("%YAML");
        if is_directive { String::new() } else { line.replace("!!opencv-matrix", "") }
    });
    lines.collect::<Vec<_>>().join("\n")
}

fn json(yaml: &Yaml) -> Value {
    match yaml {
        Yaml::Value(scalar) => match scalar {
            Scalar::Boolean(value) => Value::Bool(*value),
            Scalar::Integer(value) => Value::Number((*value).into()),
            Scalar::FloatingPoint(value) => {
                // JSON has no infinities; as text they are refused where numbers are wanted.
                let number = Number::from_f64(value.into_inner()).map(Value::Number);
                number.unwrap_or_else(|| Value::String(value.to_string()))
            }
            Scalar::String(text) => Value::String(text.to_string()),
            Scalar::Null => Value::Null,
        },
        Yaml::Sequence(items) => Value::Array(items.iter().map(json).collect()),
        Yaml::Mapping(entries) => {
            let key = |yaml: &Yaml| match json(yaml) {
                Value::String(text) => text,
                other => other.to_string(),
            };
            Value::Object(entries.iter().map(|(k, v)| (key(k), json(v))).collect::<Map<_, _>>())
        }
        Yaml::Tagged(_, inner) => json(inner),
        Yaml::Representation(text, ..) => Value::String(text.to_string()),
        Yaml::Alias(_) | Yaml::BadValue => Value::Null,
    }
}
