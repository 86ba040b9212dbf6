//! Recorded trajectories as smooth motions.

use std::path::{Path, PathBuf};

use nalgebra::{
    Isometry3, Matrix3, Quaternion, SVector, SymmetricEigen, Translation3, UnitQuaternion, Vector3,
    Vector4,
};
use serde::{Deserialize, Serialize};

use super::motion::BodyState;
use super::spline::{Smoothing, Spline};
use crate::sensor::{Stamp, TruthPose};

/// A recorded trajectory to move along instead of a built-in motion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrajectoryConfig {
    /// Poses, one a line: `timestamp tx ty tz qx qy qz qw` (TUM). Empty: a built-in motion.
    pub file: PathBuf,
    /// Whose poses they are: `"imu"` or `"camera"`.
    pub of: Carrier,
    /// The direction in the file's world that points up; zeros: found from the camera being
    /// held upright and turned mostly about the vertical, to a few degrees.
    pub up: [f64; 3],
    /// Start within the file, s after its first pose.
    pub start: f64,
    /// Mean height of the sensor above the floor, m.
    pub height: f64,
    /// Motion above this frequency is smoothed away as noise of the recording, Hz.
    pub cutoff: f64,
    /// A gap between poses longer than this ends the trajectory; the curve bridges shorter ones, s.
    pub max_gap: f64,
}

impl Default for TrajectoryConfig {
    fn default() -> Self {
        Self {
            file: PathBuf::new(),
            of: Carrier::Imu,
            up: [0.0; 3],
            start: 0.0,
            height: 1.4,
            cutoff: 6.0,
            max_gap: 0.5,
        }
    }
}

/// What a trajectory is the trajectory of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Carrier {
    Imu,
    Camera,
}

/// A trajectory that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum TrajectoryError {
    #[error("{path}: {source}")]
    Io { path: PathBuf, source: std::io::Error },
    #[error("{path}:{line}: expected `timestamp tx ty tz qx qy qz qw`, found {found:?}")]
    Line { path: PathBuf, line: usize, found: String },
    #[error("{path}:{line}: time {stamp} s is not after the one before")]
    Order { path: PathBuf, line: usize, stamp: Stamp },
    #[error(
        "{path}: only {usable:.2} s without a gap longer than {max_gap} s after {start} s; at least 1 s is needed (trajectory.start, trajectory.max_gap)"
    )]
    TooShort { path: PathBuf, usable: f64, max_gap: f64, start: f64 },
    #[error("{path}: no smooth curve fits these poses (trajectory.cutoff = {cutoff} Hz)")]
    Fit { path: PathBuf, cutoff: f64 },
}

/// A curve through recorded poses with continuous fourth derivatives, in position and attitude.
#[derive(Debug, Clone)]
pub(super) struct Trajectory {
    position: Spline<3>,
    /// Quaternion `x y z w`, to be normalised.
    attitude: Spline<4>,
    /// Stamp of the recording at path time zero.
    origin: Stamp,
    /// Usable time, s.
    duration: f64,
    /// Time cut off at each end, where the spline has data on one side only, s.
    margin: f64,
}

/// Knots of the splines, s.
const KNOTS: f64 = 0.05;

/// Pauses between poses from here on are gaps that are told, s.
const GAP: f64 = 0.05;

impl Trajectory {
    /// Reads and fits the poses of the body in a z-up world whose origin lies on the floor below
    /// the middle of the path.
    pub fn load(
        config: &TrajectoryConfig,
        body_from_camera: &Isometry3<f64>,
    ) -> Result<Self, TrajectoryError> {
        let poses = body_poses(config, body_from_camera)?;
        let poses = uninterrupted(config, &poses)?;
        Self::fit(&leveled(config, poses, body_from_camera), config.cutoff).ok_or_else(|| {
            TrajectoryError::Fit { path: config.file.clone(), cutoff: config.cutoff }
        })
    }

    fn fit(poses: &[TruthPose], cutoff: f64) -> Option<Self> {
        const MARGIN: f64 = 0.2;
        let first = poses.first()?.stamp;
        let times: Vec<f64> = poses.iter().map(|p| p.stamp.seconds_since(first)).collect();
        let positions: Vec<Vector3<f64>> =
            poses.iter().map(|p| p.world_from_body.translation.vector).collect();
        let mut quaternions: Vec<Vector4<f64>> = Vec::with_capacity(poses.len());
        for pose in poses {
            let q = pose.world_from_body.rotation.coords;
            let same_side = quaternions.last().is_none_or(|last| last.dot(&q) >= 0.0);
            quaternions.push(if same_side { q } else { -q });
        }
        let how = |tolerance| Smoothing { step: KNOTS, cutoff, tolerance };
        Some(Self {
            position: Spline::fit(&times, &positions, how(0.004))?,
            attitude: Spline::fit(&times, &quaternions, how(0.006))?,
            origin: first.offset_by(MARGIN),
            duration: times.last()? - 2.0 * MARGIN,
            margin: MARGIN,
        })
    }

    pub fn duration(&self) -> f64 {
        self.duration
    }

    pub fn origin(&self) -> Stamp {
        self.origin
    }

    /// State at path time `tau` (s) if that passes at `pace` and `change` (its derivative).
    pub fn state(&self, tau: f64, pace: f64, change: f64) -> BodyState {
        let t = tau + self.margin;
        let [position, first, second] = self.position.at(t);
        let [q, rate, _] = self.attitude.at(t);
        let quaternion = |v: SVector<f64, 4>| Quaternion::from_vector(v);
        // The norm of the raw spline drops out of the vector part.
        let turn = quaternion(q).conjugate() * quaternion(rate) / q.norm_squared();
        let rotation = UnitQuaternion::from_quaternion(quaternion(q));
        BodyState {
            world_from_body: Isometry3::from_parts(Translation3::from(position), rotation),
            velocity: first * pace,
            acceleration: second * (pace * pace) + first * change,
            angular_velocity: turn.imag() * (2.0 * pace),
        }
    }
}

/// The poses of the body in the file's world.
pub(super) fn body_poses(
    config: &TrajectoryConfig,
    body_from_camera: &Isometry3<f64>,
) -> Result<Vec<TruthPose>, TrajectoryError> {
    let mut poses = read(&config.file)?;
    if config.of == Carrier::Camera {
        let camera_from_body = body_from_camera.inverse();
        poses.iter_mut().for_each(|p| p.world_from_body *= camera_from_body);
    }
    Ok(poses)
}

fn read(path: &Path) -> Result<Vec<TruthPose>, TrajectoryError> {
    let text = std::fs::read_to_string(path)
        .map_err(|source| TrajectoryError::Io { path: path.to_owned(), source })?;
    let mut poses: Vec<TruthPose> = Vec::new();
    for (number, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let pose = pose(line).ok_or_else(|| TrajectoryError::Line {
            path: path.to_owned(),
            line: number + 1,
            found: line.chars().take(80).collect(),
        })?;
        if poses.last().is_some_and(|last| pose.stamp <= last.stamp) {
            let (path, line, stamp) = (path.to_owned(), number + 1, pose.stamp);
            return Err(TrajectoryError::Order { path, line, stamp });
        }
        poses.push(pose);
    }
    Ok(poses)
}

fn pose(line: &str) -> Option<TruthPose> {
    let separator = |c: char| c.is_whitespace() || c == ',';
    let mut fields = line.split(separator).filter(|field| !field.is_empty());
    let stamp = Stamp::parse_seconds(fields.next()?)?;
    let mut number = || fields.next()?.parse::<f64>().ok().filter(|x| x.is_finite());
    let position = Vector3::new(number()?, number()?, number()?);
    let coords = Vector4::new(number()?, number()?, number()?, number()?);
    let rotation = UnitQuaternion::try_new(Quaternion::from_vector(coords), 1e-3)?;
    Some(TruthPose { stamp, world_from_body: Isometry3::from_parts(position.into(), rotation) })
}

/// The poses from the configured start to the first long gap.
fn uninterrupted<'a>(
    config: &TrajectoryConfig,
    poses: &'a [TruthPose],
) -> Result<&'a [TruthPose], TrajectoryError> {
    let origin = poses.first().map_or(Stamp::default(), |p| p.stamp);
    let skipped = poses.partition_point(|p| p.stamp.seconds_since(origin) < config.start);
    let rest = &poses[skipped..];
    let pause = |k: usize| rest[k + 1].stamp.seconds_since(rest[k].stamp);
    let pauses = 0..rest.len().saturating_sub(1);
    let end = pauses.clone().find(|k| pause(*k) > config.max_gap).map_or(rest.len(), |k| k + 1);
    let usable = match &rest[..end] {
        [first, .., last] => last.stamp.seconds_since(first.stamp),
        _ => 0.0,
    };
    let (file, max_gap, start) = (config.file.display(), config.max_gap, config.start);
    if usable < 1.0 {
        let path = config.file.clone();
        return Err(TrajectoryError::TooShort { path, usable, max_gap, start });
    }
    let bridged: Vec<f64> = pauses.take(end - 1).map(pause).filter(|s| *s > GAP).collect();
    if let Some(longest) = bridged.iter().copied().reduce(f64::max) {
        tracing::info!("{file}: {} gaps bridged, the longest of {longest:.3} s", bridged.len());
    }
    if end < rest.len() {
        tracing::warn!(
            "{file}: {usable:.1} s are used, up to a gap of {:.3} s; the rest begins at \
             trajectory.start = {:.1}",
            pause(end - 1),
            rest[end].stamp.seconds_since(origin)
        );
    }
    Ok(&rest[..end])
}

/// The poses in a world whose z axis points up.
fn leveled(
    config: &TrajectoryConfig,
    poses: &[TruthPose],
    body_from_camera: &Isometry3<f64>,
) -> Vec<TruthPose> {
    let given = Vector3::from(config.up);
    let up = if given.norm() > 0.0 { given } else { guessed_up(poses, body_from_camera) };
    let rotation = UnitQuaternion::rotation_between(&up, &Vector3::z()).unwrap_or_else(|| {
        UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI)
    });
    let turned: Vec<Vector3<f64>> =
        poses.iter().map(|p| rotation * p.world_from_body.translation.vector).collect();
    let corner = |pick: fn(f64, f64) -> f64| {
        turned.iter().skip(1).fold(turned[0], |c, p| c.zip_map(p, pick))
    };
    let mean = turned.iter().sum::<Vector3<f64>>() / turned.len() as f64;
    let mut origin = (corner(f64::min) + corner(f64::max)) / 2.0;
    // No lower than a robot's camera.
    origin.z = (mean.z - config.height).min(corner(f64::min).z - 0.25);
    let world_from_file = Isometry3::from_parts((-origin).into(), rotation);
    let move_pose = |pose: &TruthPose| TruthPose {
        stamp: pose.stamp,
        world_from_body: world_from_file * pose.world_from_body,
    };
    poses.iter().map(move_pose).collect()
}

/// The direction to which the rows of the image stay perpendicular and about which the sensor
/// turns most, with the sign that has the camera upright.
fn guessed_up(poses: &[TruthPose], body_from_camera: &Isometry3<f64>) -> Vector3<f64> {
    // Steps of a tenth of a second or so: longer than the noise, shorter than a turn.
    const STRIDE: usize = 12;
    let right = body_from_camera.rotation * Vector3::x();
    let down = body_from_camera.rotation * Vector3::y();
    let (mut level, mut turns) = (Matrix3::zeros(), Matrix3::zeros());
    let mut upright = Vector3::zeros();
    for (before, after) in poses.iter().zip(poses.iter().skip(STRIDE)) {
        let (before, after) = (before.world_from_body.rotation, after.world_from_body.rotation);
        let row = before * right;
        level += row * row.transpose();
        let turn = (after * before.inverse()).scaled_axis();
        turns += turn * turn.transpose();
        upright -= before * down;
    }
    let share = |m: Matrix3<f64>| m / m.trace().max(f64::MIN_POSITIVE);
    let eigen = SymmetricEigen::new(share(level) - share(turns));
    let axis = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
    if axis.dot(&upright) < 0.0 { -axis } else { axis }
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;

    #[test]
    fn lines_of_both_kinds_are_read() {
        let spaced = pose("12.5 1 2 3 0 0 0 1").unwrap();
        assert_eq!(spaced, pose("12.5,1,2,3,0,0,0,1").unwrap());
        assert_eq!(spaced.stamp.nanos(), 12_500_000_000);
        let origin = spaced.world_from_body * Point3::origin();
        assert_eq!(origin, Point3::new(1.0, 2.0, 3.0));
        for bad in ["1 2 3", "1 2 3 4 0 0 0 0", "x 1 2 3 0 0 0 1", "1 nan 2 3 0 0 0 1"] {
            assert!(pose(bad).is_none(), "{bad}");
        }
    }

    fn mount() -> Isometry3<f64> {
        super::super::SceneConfig::default().camera.imu_from_camera().unwrap()
    }

    /// A recording of the VCU-RVI benchmark, where the development data is at hand.
    fn recording(name: &str) -> Option<PathBuf> {
        let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
        let data = std::env::var_os("MFG_VIO_DATA").map_or(beside, PathBuf::from);
        let file = data.join("vcu_rvi/ground_truths").join(name);
        if !file.is_file() {
            eprintln!("SKIPPED: {} is not there (set MFG_VIO_DATA)", file.display());
            return None;
        }
        Some(file)
    }

    #[test]
    fn the_vertical_of_a_recording_is_found() {
        // From the gravity-aligned estimates of visual-inertial systems, or the plane of motion.
        for (name, up) in [
            ("lab_simple1_gt.csv", [0.985, 0.05, 0.16]),
            ("lab_simple3_gt.csv", [0.9775, 0.0488, 0.2004]),
            ("lab_bumper2_gt.csv", [0.9997, 0.0131, 0.0121]),
        ] {
            let Some(file) = recording(name) else { continue };
            let guess = guessed_up(&read(&file).unwrap(), &mount());
            let angle = guess.angle(&Vector3::from(up)).to_degrees();
            assert!(angle < 3.0, "{name}: {angle} deg");
        }
    }

    #[test]
    fn the_curve_stays_with_the_recording() {
        let Some(file) = recording("lab_bumper1_gt.csv") else { return };
        let config = TrajectoryConfig { file, start: 5.0, ..TrajectoryConfig::default() };
        let poses = read(&config.file).unwrap();
        let poses = leveled(&config, uninterrupted(&config, &poses).unwrap(), &mount());
        let curve = Trajectory::fit(&poses, config.cutoff).unwrap();
        let first = poses[0].stamp;
        let mut offsets: Vec<f64> = Vec::new();
        for pose in &poses {
            let tau = pose.stamp.seconds_since(first) - curve.margin;
            if (0.0..curve.duration()).contains(&tau) {
                let fitted = curve.state(tau, 1.0, 0.0).world_from_body;
                assert!(fitted.rotation.angle_to(&pose.world_from_body.rotation) < 0.05);
                let offset = fitted.translation.vector - pose.world_from_body.translation.vector;
                offsets.push(offset.norm());
            }
        }
        offsets.sort_by(f64::total_cmp);
        assert!(offsets.len() > 500 && offsets[offsets.len() / 2] < 1e-3, "{}", offsets.len());
    }

    #[test]
    fn gaps_end_a_trajectory() {
        let pose = |t: f64| TruthPose {
            stamp: Stamp::default().offset_by(t),
            world_from_body: Isometry3::identity(),
        };
        let late = |k: i32| 0.4 * f64::from(u8::from(k >= 120)) + f64::from(u8::from(k >= 250));
        let poses: Vec<TruthPose> = (0..400).map(|k| pose(0.01 * f64::from(k) + late(k))).collect();
        let config = TrajectoryConfig::default();
        assert_eq!(uninterrupted(&config, &poses).unwrap().len(), 250);
        let config = TrajectoryConfig { start: 2.4, ..config };
        let error = uninterrupted(&config, &poses).unwrap_err();
        assert!(matches!(error, TrajectoryError::TooShort { usable, .. } if usable < 0.6));
    }
}
