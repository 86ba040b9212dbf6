//! A synthetic run, written and read back; also the way to look at the layout.

use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use nalgebra::{Isometry3, Matrix3, Point2, Rotation3, UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rerun::external::re_log_encoding::{Decodable as _, DecoderApp, StreamFooter};
use rerun::log::{Chunk, LogMsg};

use super::*;
use crate::inertial::{NavCovariance, NavState, block};
use crate::odometry::{
    KeypointRole, KeypointView, MapPointView, Note, StageTimes, StepCounts, StepReport,
};
use crate::sensor::{
    Camera, ColorImage, DepthImage, ImuSample, PinholeCamera, PixelFormat, RgbdFrame, Stamp,
};
use crate::so3::ProperSvd;

const SIZE: [usize; 2] = [320, 240];
const CAMERA: Camera =
    Camera::pinhole(PinholeCamera { fx: 260.0, fy: 260.0, cx: 159.5, cy: 119.5 });
const RATE: f64 = 30.0;

/// A walk around a room whose walls carry the map, with a slowly growing error.
struct Walk {
    map: Vec<Vector3<f64>>,
    rng: ChaCha8Rng,
}

impl Walk {
    fn new() -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let map = (0..2000)
            .map(|_| {
                let angle = rng.random_range(0.0..TAU);
                Vector3::new(4.0 * angle.cos(), 4.0 * angle.sin(), rng.random_range(0.0..2.5))
            })
            .collect();
        Self { map, rng }
    }

    /// Looks outward while it goes around once in 20 s.
    fn truth(time: f64) -> Isometry3<f64> {
        let angle = TAU * time / 20.0;
        let position = Vector3::new(1.5 * angle.cos(), 1.5 * angle.sin(), 1.2);
        let rotation = UnitQuaternion::from_euler_angles(0.05 * (3.0 * angle).sin(), 0.0, angle);
        Isometry3::from_parts(position.into(), rotation)
    }

    /// The camera looks along the body's x axis, the body's z axis points up.
    fn imu_from_camera() -> Isometry3<f64> {
        let rotation = Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0);
        let rotation = Rotation3::from_matrix_unchecked(rotation);
        Isometry3::from_parts(
            Vector3::new(0.03, 0.0, 0.01).into(),
            UnitQuaternion::from_rotation_matrix(&rotation),
        )
    }

    fn stamp(frame: u64) -> Stamp {
        Stamp::from_parts(5645, 180_000_000).offset_by(frame as f64 / RATE)
    }

    fn report(&mut self, frame: u64, with_map: bool) -> StepReport {
        let time = frame as f64 / RATE;
        let drift = Vector3::new(0.004, -0.003, 0.001) * time;
        let mut world_from_body = Self::truth(time);
        world_from_body.translation.vector += drift;
        let world_from_camera = world_from_body * Self::imu_from_camera();
        let keypoints = self.keypoints(&world_from_camera);
        let count = |role| keypoints.iter().filter(|keypoint| keypoint.role == role).count();
        let inliers = count(KeypointRole::Inlier);
        let mut notes = Vec::new();
        if frame == 0 {
            notes.push(Note::info("initialised at rest".to_owned()));
        }
        if frame == 40 {
            notes.push(Note::warning("IMU gap of 0.12 s".to_owned()));
        }
        StepReport {
            frame,
            stamp: Self::stamp(frame),
            state: NavState {
                world_from_body,
                velocity: Vector3::new(0.0, 0.47, 0.0),
                gyro_bias: Vector3::new(2e-3, -1e-3, 5e-4),
                accel_bias: Vector3::new(0.05, 0.02, -0.03),
            },
            covariance: Self::covariance(time),
            world_from_camera,
            calibration: None,
            matrix_fisher: Some(ProperSvd {
                u: world_from_body.rotation.to_rotation_matrix(),
                s: Vector3::new(4e5, 3e5, 2e5) / (1.0 + time),
                v: Rotation3::identity(),
            }),
            nis: Some(self.rng.random_range(0.7..1.3)),
            gating: None,
            counts: StepCounts {
                features: keypoints.len(),
                with_depth: keypoints.len() - count(KeypointRole::NoDepth),
                candidates: self.map.len() / 4,
                matches: inliers + count(KeypointRole::Outlier),
                inliers,
                new_points: count(KeypointRole::New),
                map_points: self.map.len(),
            },
            times: StageTimes {
                features: 0.006,
                propagation: 0.0002,
                matching: 0.002,
                ransac: self.rng.random_range(0.0005..0.002),
                update: 0.001,
                map: 0.0005,
            },
            map: with_map.then(|| self.map_view(time)),
            keypoints,
            notes,
        }
    }

    fn covariance(time: f64) -> NavCovariance {
        let mut covariance = NavCovariance::zeros();
        for (block, sigma) in [
            (block::ROTATION, 0.003 + 1e-4 * time),
            (block::VELOCITY, 0.02),
            (block::POSITION, 0.01 + 0.004 * time),
            (block::GYRO_BIAS, 1e-3 / (1.0 + time)),
            (block::ACCEL_BIAS, 0.1 / (1.0 + time)),
        ] {
            for (axis, factor) in [(0, 1.0), (1, 0.6), (2, 0.3)] {
                covariance[(block + axis, block + axis)] = (factor * sigma).powi(2);
            }
        }
        covariance
    }

    fn keypoints(&mut self, world_from_camera: &Isometry3<f64>) -> Vec<KeypointView> {
        let roles = [
            KeypointRole::Inlier,
            KeypointRole::Inlier,
            KeypointRole::Inlier,
            KeypointRole::Outlier,
            KeypointRole::New,
            KeypointRole::Unmatched,
            KeypointRole::NoDepth,
        ];
        let [width, height] = SIZE.map(|pixels| pixels as f64);
        let seen = |pixel: &Point2<f64>| {
            (0.0..width).contains(&pixel.x) && (0.0..height).contains(&pixel.y)
        };
        let mut keypoints = Vec::new();
        for ((id, point), &role) in (0..).zip(&self.map).zip(roles.iter().cycle()) {
            let in_camera = world_from_camera.inverse_transform_point(&(*point).into()).coords;
            let Some(predicted) = CAMERA.project(&in_camera).filter(seen) else { continue };
            let offset = if role == KeypointRole::Outlier { 20.0 } else { 2.0 };
            let mut scatter = || self.rng.random_range(-offset..offset) as f32;
            let predicted = [predicted.x as f32, predicted.y as f32];
            let matched = matches!(role, KeypointRole::Inlier | KeypointRole::Outlier);
            keypoints.push(KeypointView {
                pixel: [predicted[0] + scatter(), predicted[1] + scatter()],
                predicted: matched.then_some(predicted),
                point: matched.then_some(id),
                role,
            });
        }
        keypoints
    }

    fn map_view(&self, time: f64) -> Vec<MapPointView> {
        let seen = (self.map.len() as f64 * (time / 20.0).min(1.0)) as usize;
        let mut by_angle: Vec<_> = self.map.iter().collect();
        by_angle.sort_by(|a, b| {
            a.y.atan2(a.x).rem_euclid(TAU).total_cmp(&b.y.atan2(b.x).rem_euclid(TAU))
        });
        let points = by_angle.into_iter().take(seen).enumerate();
        points
            .map(|(index, point)| MapPointView {
                position: point.cast::<f32>().into(),
                covariance: Matrix3::identity() * (0.003 * 1.003_f32.powi(index as i32)).powi(2),
                age: 0,
            })
            .collect()
    }

    fn images(frame: u64) -> RgbdFrame {
        let [width, height] = SIZE;
        let pixels = || (0..height).flat_map(|row| (0..width).map(move |column| (column, row)));
        let shift = frame as usize;
        let color = pixels()
            .flat_map(|(column, row)| [(column + shift) as u8, row as u8, (column / 2) as u8])
            .collect();
        let depth = pixels().map(|(column, row)| (2000 + 4 * column + 2 * row) as u16).collect();
        RgbdFrame {
            others: Vec::new(),
            stamp: Self::stamp(frame),
            color: ColorImage::new(width, height, PixelFormat::Bgr8, color).unwrap(),
            depth: DepthImage::new(width, height, 0.001, depth).unwrap(),
        }
    }

    fn imu(sample: u64) -> ImuSample {
        let time = sample as f64 / 100.0;
        ImuSample {
            stamp: Stamp::from_parts(5645, 180_000_000).offset_by(time),
            angular_velocity: Vector3::new(0.1 * (3.0 * time).sin(), 0.02, TAU / 20.0),
            specific_force: Vector3::new(-0.15, 0.1 * time.cos(), 9.81),
        }
    }
}

/// One frame of the walk.
pub(super) fn frame(frame: u64) -> (StepReport, RgbdFrame) {
    (Walk::new().report(frame, false), Walk::images(frame))
}

fn record(path: &Path, frames: u64, config: &RecordingConfig) -> Result<(), ViewerError> {
    let contents = Contents { name: "walk".to_owned(), truth: true, imu: true };
    let mut recorder = Recorder::new(&[Sink::File(path.to_owned())], &contents, config)?;
    recorder.camera(&CAMERA, &Walk::imu_from_camera(), SIZE);
    let mut walk = Walk::new();
    let mut samples = 0;
    for frame in 0..frames {
        let time = frame as f64 / RATE;
        while (samples as f64) < 100.0 * time {
            recorder.imu(&Walk::imu(samples));
            samples += 1;
        }
        let report = walk.report(frame, config.wants_map(frame));
        recorder.frame(&report, &Walk::images(frame), Some(&Walk::truth(time)));
    }
    recorder.finish()
}

/// Rows of every entity of a recording, without the blueprint.
fn rows(path: &Path) -> BTreeMap<String, usize> {
    let mut rows = BTreeMap::new();
    for chunk in chunks(path) {
        *rows.entry(chunk.entity_path().to_string()).or_default() += chunk.num_rows();
    }
    rows
}

fn chunks(path: &Path) -> Vec<Chunk> {
    let file = BufReader::new(File::open(path).unwrap());
    DecoderApp::decode_eager(file)
        .unwrap()
        .filter_map(|message| match message.unwrap() {
            LogMsg::ArrowMsg(store, data) if store.is_recording() => {
                Some(Chunk::from_arrow_msg(&data).unwrap())
            }
            _ => None,
        })
        .collect()
}

#[test]
fn a_recording_holds_every_frame_and_is_complete() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("walk.rrd");
    record(&path, 60, &RecordingConfig::default()).unwrap();
    let rows = rows(&path);
    let count = |entity: &str| rows.get(entity).copied().unwrap_or(0);
    // One more row than frames: the static style of the entity.
    for entity in
        ["/plots/error/position", "/plots/nees", "/plots/timing", "/world/estimate/covariance"]
    {
        assert_eq!(count(entity), 60 + 1, "{entity} in {rows:?}");
    }
    assert_eq!(count("/world/estimate/body"), 60 + 1);
    assert_eq!(count("/world/truth/body"), 60 + 1);
    // Five pieces of ten steps and the nine steps that are left.
    assert_eq!(count("/world/estimate/trajectory"), 6 + 1);
    assert_eq!(count("/world/truth/trajectory"), 6 + 1);
    assert_eq!(count("/world/map"), 2 + 1);
    assert_eq!(count("/world/map/ellipsoids"), 2 + 1);
    for entity in ["density", "estimate", "truth"] {
        assert_eq!(count(&format!("/belief/attitude/{entity}")), 10 + 1, "{entity}");
    }
    assert_eq!(count("/belief/correlation/image"), 10);
    let image = "/world/estimate/body/camera/image";
    assert_eq!(count(image), 1);
    assert_eq!(count(&format!("{image}/color")), 20);
    assert_eq!(count(&format!("{image}/depth")), 1);
    for name in ["inliers", "outliers", "new", "unmatched", "no_depth", "matches", "tracks"] {
        assert_eq!(count(&format!("{image}/keypoints/{name}")), 20 + 1, "{name}");
    }
    assert_eq!(count("/plots/imu/gyro"), 99 + 1);
    assert_eq!(count("/log"), 2);
}

#[test]
fn streams_that_are_switched_off_are_absent() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("walk.rrd");
    let config = RecordingConfig {
        image_every: 0,
        depth_every: 0,
        map_every: 0,
        belief_every: 0,
        imu_every: 0,
        ..Default::default()
    };
    record(&path, 5, &config).unwrap();
    let rows = rows(&path);
    // Styles are there in any case.
    assert_eq!(rows["/world/map"], 1);
    assert_eq!(rows["/belief/attitude/density"], 1);
    assert_eq!(rows["/plots/imu/gyro"], 1);
    assert!(!rows.keys().any(|entity| entity.ends_with("/color") || entity.ends_with("/depth")));
    assert_eq!(rows["/plots/timing"], 6);
}

#[test]
fn the_same_run_makes_the_same_recording() {
    let folder = tempfile::tempdir().unwrap();
    let [first, second] = ["a", "b"].map(|name| {
        let path = folder.path().join(name);
        record(&path, 20, &RecordingConfig::default()).unwrap();
        chunks(&path)
    });
    assert_eq!(first.len(), second.len());
    for (a, b) in first.iter().zip(&second) {
        assert_eq!(a.entity_path(), b.entity_path());
        assert_eq!(a.timelines(), b.timelines());
        assert_eq!(a.components(), b.components());
    }
}

#[test]
fn size_grows_in_proportion_to_duration() {
    let folder = tempfile::tempdir().unwrap();
    let config = RecordingConfig { image_every: 0, depth_every: 0, ..Default::default() };
    let [short, long] = [150, 450].map(|frames| {
        let path = folder.path().join(format!("{frames}.rrd"));
        record(&path, frames, &config).unwrap();
        std::fs::metadata(&path).unwrap().len() as f64
    });
    assert!(long < 3.3 * short, "{short} bytes became {long}");
}

#[test]
fn a_recorder_that_is_dropped_leaves_a_complete_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("walk.rrd");
    let contents = Contents { name: "walk".to_owned(), truth: false, imu: false };
    let sinks = [Sink::File(path.clone())];
    let mut recorder = Recorder::new(&sinks, &contents, &RecordingConfig::default()).unwrap();
    recorder.frame(&Walk::new().report(0, false), &Walk::images(0), None);
    drop(recorder);
    let bytes = std::fs::read(&path).unwrap();
    let end = bytes.len() - StreamFooter::ENCODED_SIZE_BYTES;
    assert!(StreamFooter::from_rrd_bytes(&bytes[end..]).is_ok());
    assert_eq!(rows(&path)["/world/estimate/body"], 2);
}

#[test]
fn sinks_that_cannot_be_opened_are_named() {
    let contents = Contents { name: "walk".to_owned(), truth: false, imu: false };
    let error = |sinks: &[Sink]| {
        Recorder::new(sinks, &contents, &RecordingConfig::default()).unwrap_err().to_string()
    };
    let file = error(&[Sink::File("/nonexistent/run.rrd".into())]);
    assert!(file.starts_with("/nonexistent/run.rrd: cannot be created"), "{file}");
    let address = error(&[Sink::Connect("localhost:9876".to_owned())]);
    assert!(address.contains("\"localhost:9876\""), "{address}");
    // Nothing listens on the discard port.
    let silent = "rerun+http://127.0.0.1:9/proxy".to_owned();
    let unreachable = error(&[Sink::Connect(silent)]);
    assert!(unreachable.contains("127.0.0.1:9/proxy within"), "{unreachable}");
    error(&[]);
}
