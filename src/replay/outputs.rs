//! The files of `replay --out DIR`: `trajectory.tum`, `state.csv`, `map.ply`, `faults.json`.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Vector3};

use super::error::ReplayError;
use crate::fault::Episode;
use crate::filter::{Calibration, calibration_block};
use crate::inertial::{NavCovariance, NavState, block};
use crate::odometry::{MapPointView, StepReport};
use crate::sensor::Stamp;

/// All files that a replay may leave in its directory, with its recording.
pub const RESULTS: [&str; 7] = [
    "trajectory.tum",
    "state.csv",
    "metrics.json",
    "map.ply",
    "run.rrd",
    "trajectory_optimized.tum",
    "faults.json",
];

/// Writes trajectory and state line by line, so that an interrupted run leaves valid files.
pub struct Outputs {
    trajectory: OutputFile,
    state: OutputFile,
    directory: PathBuf,
}

pub(super) struct OutputFile {
    path: PathBuf,
    writer: BufWriter<File>,
}

impl OutputFile {
    pub(super) fn create(path: PathBuf) -> Result<Self, ReplayError> {
        match File::create(&path) {
            Ok(file) => Ok(Self { path, writer: BufWriter::new(file) }),
            Err(source) => Err(ReplayError::Write { path, source }),
        }
    }

    pub(super) fn line(&mut self, line: &str) -> Result<(), ReplayError> {
        writeln!(self.writer, "{line}")
            .map_err(|source| ReplayError::Write { path: self.path.clone(), source })
    }

    pub(super) fn finish(mut self) -> Result<(), ReplayError> {
        self.writer.flush().map_err(|source| ReplayError::Write { path: self.path, source })
    }
}

impl Outputs {
    /// Creates `directory` and the files in it.
    pub fn create(directory: &Path) -> Result<Self, ReplayError> {
        std::fs::create_dir_all(directory)
            .map_err(|source| ReplayError::Write { path: directory.to_owned(), source })?;
        let trajectory = OutputFile::create(directory.join("trajectory.tum"))?;
        let mut state = OutputFile::create(directory.join("state.csv"))?;
        state.line(&state_columns().join(","))?;
        Ok(Self { trajectory, state, directory: directory.to_owned() })
    }

    pub fn step(&mut self, report: &StepReport) -> Result<(), ReplayError> {
        self.trajectory.line(&trajectory_line(report.stamp, &report.state.world_from_body))?;
        self.state.line(&state_line(report))
    }

    pub fn finish(self, map: &[MapPointView], faults: &[Episode]) -> Result<(), ReplayError> {
        write_map(&self.directory.join("map.ply"), map)?;
        write_faults(&self.directory.join("faults.json"), faults)?;
        self.trajectory.finish()?;
        self.state.finish()
    }
}

/// `timestamp tx ty tz qx qy qz qw` of the body.
pub(super) fn trajectory_line(stamp: Stamp, pose: &Isometry3<f64>) -> String {
    let (t, q) = (pose.translation.vector, pose.rotation.coords);
    format!("{stamp} {:.9} {:.9} {:.9} {:.9} {:.9} {:.9} {:.9}", t.x, t.y, t.z, q.x, q.y, q.z, q.w)
}

const AXES: [&str; 3] = ["x", "y", "z"];
const COVARIANCE_BLOCKS: [(&str, usize); 5] = [
    ("var_rot", block::ROTATION),
    ("var_vel", block::VELOCITY),
    ("var_pos", block::POSITION),
    ("var_gyro_bias", block::GYRO_BIAS),
    ("var_accel_bias", block::ACCEL_BIAS),
];
/// Indices of (rotation, position) in the covariance.
const POSE: [usize; 6] = [
    block::ROTATION,
    block::ROTATION + 1,
    block::ROTATION + 2,
    block::POSITION,
    block::POSITION + 1,
    block::POSITION + 2,
];

/// Names of the columns of `state.csv`, in order; see `docs` of the command for their meaning.
pub fn state_columns() -> Vec<String> {
    let mut columns = belief_columns();
    columns.extend(["innovation", "innovation_largest", "innovation_gate"].map(str::to_owned));
    columns.extend(
        ["features", "with_depth", "candidates", "matches", "inliers", "new_points", "map_points"]
            .map(str::to_owned),
    );
    columns.push("rejected".to_owned());
    let stages = crate::odometry::StageTimes::default().stages();
    columns.extend(stages.map(|(stage, _)| format!("time_{stage}")));
    columns.extend(calibration_columns());
    columns
}

/// The camera's calibration as estimated, and its variances; empty fields where it is not.
fn calibration_columns() -> Vec<String> {
    let axes = |stem: &str| AXES.map(|axis| format!("{stem}_{axis}"));
    let pose = ["px", "py", "pz", "qx", "qy", "qz", "qw"].map(|name| format!("camera_{name}"));
    let variances = [axes("var_camera_rot"), axes("var_camera_pos")].concat();
    let offset = ["camera_time_offset", "var_camera_time_offset"].map(str::to_owned);
    [&pose[..], &variances, &offset].concat()
}

/// The values of [`calibration_columns`].
fn calibration_fields(calibration: Option<&Calibration>) -> Vec<String> {
    let values = calibration.map(|calibration| {
        let pose = &calibration.body_from_camera;
        let mut values: Vec<f64> = pose.translation.vector.iter().copied().collect();
        values.extend(pose.rotation.coords.iter());
        let (of_mounting, of_offset) =
            (0..calibration_block::TIME_OFFSET, calibration_block::TIME_OFFSET);
        values.extend(of_mounting.map(|k| calibration.covariance[(k, k)]));
        values.extend([calibration.time_offset, calibration.covariance[(of_offset, of_offset)]]);
        values
    });
    let field = |k: usize| optional_field(values.as_ref().and_then(|v| v.get(k).copied()));
    (0..calibration_columns().len()).map(field).collect()
}

/// The columns of any filter's belief: stamp, state, covariances and `S`.
pub(super) fn belief_columns() -> Vec<String> {
    let axes = |stem: &str| AXES.map(|axis| format!("{stem}_{axis}")).to_vec();
    let mut columns = vec!["time".to_owned()];
    columns.extend(["px", "py", "pz", "qx", "qy", "qz", "qw"].map(str::to_owned));
    for stem in ["vel", "gyro_bias", "accel_bias"] {
        columns.extend(axes(stem));
    }
    for (stem, _) in COVARIANCE_BLOCKS {
        columns.extend(axes(stem));
    }
    for row in 0..6 {
        columns.extend((0..6).map(|column| format!("cov_pose_{row}{column}")));
    }
    columns.extend(["s1", "s2", "s3"].map(str::to_owned));
    columns
}

/// One line of `state.csv`; a value that a filter does not have is left empty.
fn state_line(report: &StepReport) -> String {
    let s = report.matrix_fisher.map(|svd| svd.s);
    let mut fields = belief_fields(report.stamp, &report.state, &report.covariance, s);
    let largest = report.gating.map(|gating| gating.largest);
    // Empty where nothing limits the distance.
    let gate = report.gating.map(|gating| gating.threshold).filter(|t| t.is_finite());
    fields.extend([report.nis, largest, gate].map(optional_field));
    let c = &report.counts;
    let counts =
        [c.features, c.with_depth, c.candidates, c.matches, c.inliers, c.new_points, c.map_points];
    fields.extend(counts.map(|count| count.to_string()));
    let rejected = report.gating.map(|gating| gating.rejected);
    fields.push(rejected.map(|count| count.to_string()).unwrap_or_default());
    fields.extend(report.times.stages().map(|(_, seconds)| format!("{seconds:.6}")));
    fields.extend(calibration_fields(report.calibration.as_ref()));
    fields.join(",")
}

/// The values of [`belief_columns`].
pub(super) fn belief_fields(
    stamp: Stamp,
    state: &NavState,
    covariance: &NavCovariance,
    matrix_fisher_s: Option<Vector3<f64>>,
) -> Vec<String> {
    let pose = &state.world_from_body;
    let mut values = Vec::with_capacity(96);
    values.extend(pose.translation.vector.iter().chain(pose.rotation.coords.iter()));
    for vector in [&state.velocity, &state.gyro_bias, &state.accel_bias] {
        values.extend(vector.iter());
    }
    for (_, start) in COVARIANCE_BLOCKS {
        values.extend((start..start + 3).map(|k| covariance[(k, k)]));
    }
    for row in POSE {
        values.extend(POSE.map(|column| covariance[(row, column)]));
    }
    let mut fields = vec![stamp.to_string()];
    fields.extend(values.iter().map(|value| format!("{value:.9e}")));
    fields.extend((0..3).map(|k| optional_field(matrix_fisher_s.map(|s| s[k]))));
    fields
}

fn optional_field(value: Option<f64>) -> String {
    value.map(|v| format!("{v:.9e}")).unwrap_or_default()
}

/// One JSON object: the faults of the run in order of their end.
fn write_faults(path: &Path, faults: &[Episode]) -> Result<(), ReplayError> {
    let failed = |source| ReplayError::Write { path: path.to_owned(), source };
    let object = serde_json::json!({ "faults": faults });
    let text = serde_json::to_string_pretty(&object).map_err(|error| failed(error.into()))?;
    crate::output::write(path, text + "\n").map_err(failed)
}

/// ASCII PLY of the map points: position (m, world), `sigma` (m), `age` (frames).
fn write_map(path: &Path, map: &[MapPointView]) -> Result<(), ReplayError> {
    let mut text = format!("ply\nformat ascii 1.0\nelement vertex {}\n", map.len());
    for property in ["float x", "float y", "float z", "float sigma", "uint age"] {
        text.push_str(&format!("property {property}\n"));
    }
    text.push_str("end_header\n");
    for point in map {
        let [x, y, z] = point.position;
        text.push_str(&format!("{x} {y} {z} {} {}\n", point.sigma(), point.age));
    }
    crate::output::write(path, text)
        .map_err(|source| ReplayError::Write { path: path.to_owned(), source })
}
