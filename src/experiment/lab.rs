//! Consistency in odometry: a hand-held RGB-D camera and IMU in a lab, without images.
//!
//! The sensors, their noise and the motion are those of the simulator; what is left out is the
//! image: corners are points that are detected with a fixed probability and never mistaken.
//!
//! `lab-calibration` starts from a wrong mounting of the camera and a wrong offset of its clock,
//! once in motion and once at rest, where little of them can be seen.

use std::collections::BTreeMap;
use std::time::Instant;

use nalgebra::{Isometry3, Matrix3, Point2, Point3, UnitQuaternion, Vector2, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::landmarks::{LandmarkRun, Seen};
use super::study::{Observation, Report, Request, StepTime, Study, StudyError, Trial, monte_carlo};
use crate::evaluation::NeesSummary;
use crate::filter::{
    Calibration, FilterConfig, FilterError, FilterKind, VisualInertialFilter, calibration_block,
};
use crate::inertial::{Belief, ImuConfig, NavCovariance, NavState, Propagator, block};
use crate::map::MapConfig;
use crate::sensor::{Camera, ImuSample, Stamp};
use crate::simulation::{BodyState, ImuSimulator, Motion, MotionConfig, SceneConfig, SceneError};
use crate::vision::{DepthReading, PointMeasurement};

/// Studies of this module.
pub const STUDIES: &[Study] = &[
    Study {
        name: "lab-nees",
        title: "NEES in odometry: 60 s of a hand-held camera in a lab, points without images",
        runs: 20,
        run: |request| consistency(request, &Lab::default()),
    },
    Study {
        name: "lab-calibration",
        title: "calibration of the camera while running: 3 deg, 3 cm, 20 ms off, 30 s in a lab",
        runs: 20,
        run: |request| calibration(request, &Lab { duration: 30.0, ..Lab::default() }),
    },
];

const FILTERS: [FilterKind; 5] =
    [FilterKind::Mfgs, FilterKind::Iekfs, FilterKind::Mekfs, FilterKind::Mfgr, FilterKind::Mekfr];
const CALIBRATING: [FilterKind; 3] = [FilterKind::Mfgs, FilterKind::Iekfs, FilterKind::Mekfs];

/// The drive.
#[derive(Debug, Clone)]
struct Lab {
    duration: f64,
    /// Frames a second.
    frame_rate: f64,
    landmarks: usize,
    /// Probability that a point in view is detected in a frame.
    detected: f64,
    /// Standard deviation of a detected corner, pixels a coordinate.
    pixel_sd: f64,
    /// Size of the image, pixels.
    image: [f64; 2],
    /// Time at rest before the motion starts, s.
    standstill: f64,
}

impl Default for Lab {
    fn default() -> Self {
        Self {
            duration: 60.0,
            frame_rate: 30.0,
            landmarks: 500,
            detected: 0.7,
            pixel_sd: 0.7,
            image: [640.0, 480.0],
            standstill: 0.0,
        }
    }
}

#[derive(Debug, thiserror::Error)]
pub enum LabError {
    #[error(transparent)]
    Scene(#[from] SceneError),
    #[error(transparent)]
    Filter(FilterError),
    #[error("{filter}: the belief's covariance is not positive definite at {seconds:.2} s")]
    Covariance { filter: FilterKind, seconds: f64 },
}

fn consistency(request: &Request, lab: &Lab) -> Result<Report, StudyError> {
    let trials = monte_carlo(request, |rng| consistency_trial(lab, rng))?;
    let mut report = Report::of("lab-nees", request.seed, &trials, &[]);
    let dof = 3 * trials.len();
    if let Some(summary) = NeesSummary::of(&[0.0], dof, 0.95) {
        let [low, high] = summary.band.map(|bound| bound / trials.len() as f64);
        report.notes.push(format!(
            "NEES of a 3-vector, averaged over the second half of each run: consistent filters \
             have 3; the 95 % chi-square band of the mean over {} independent runs is \
             {low:.2} to {high:.2}. No images are rendered.",
            trials.len()
        ));
    }
    Ok(report)
}

fn calibration(request: &Request, lab: &Lab) -> Result<Report, StudyError> {
    let trials = monte_carlo(request, |rng| calibration_trial(lab, rng))?;
    let mut report = Report::of("lab-calibration", request.seed, &trials, &[]);
    report.notes.push(
        "Averages over the second half of each run. NEES of rotation and translation of a \
         consistent filter is 3, that of the time offset 1. sd: as the filter believes, root mean \
         square over the components."
            .to_owned(),
    );
    Ok(report)
}

/// What all filters of a run are given. The camera's clock is that of the IMU.
struct Drive {
    motion: Motion,
    imu: Vec<ImuSample>,
    frames: Vec<Frame>,
    start: Belief,
    propagator: Propagator,
    body_from_camera: Isometry3<f64>,
}

struct Frame {
    stamp: Stamp,
    seen: Vec<(usize, PointMeasurement)>,
}

impl Drive {
    fn draw(lab: &Lab, rng: &mut ChaCha8Rng) -> Result<Self, LabError> {
        let scene = SceneConfig::default();
        let body_from_camera = scene.validate()?;
        let standstill = lab.standstill;
        let motion = MotionConfig { standstill, ramp: 1.0, ..MotionConfig::default() };
        let motion = Motion::built_in(&motion, &body_from_camera, rng.random());
        let landmarks: Vec<_> =
            (0..lab.landmarks).map(|_| landmark(&scene.room.size, rng)).collect();
        let mut imu_simulator = ImuSimulator::new(scene.imu.clone(), rng.random());
        let config = ImuConfig {
            gyro_noise: scene.imu.gyro_noise,
            accel_noise: scene.imu.accel_noise,
            gyro_bias_walk: scene.imu.gyro_bias_walk,
            accel_bias_walk: scene.imu.accel_bias_walk,
            gyro_bias_sd: scene.imu.gyro_bias_sd,
            accel_bias_sd: scene.imu.accel_bias_sd,
            gravity: scene.imu.gravity,
            ..ImuConfig::default()
        };
        let samples_per_frame = (scene.imu.rate / lab.frame_rate).round().max(1.0) as usize;
        let samples = (lab.duration * scene.imu.rate).round() as usize;
        let (mut imu, mut frames) = (Vec::new(), Vec::new());
        for sample in 0..=samples {
            let t = sample as f64 / scene.imu.rate;
            let state = motion.state(t);
            let stamp = Stamp::default().offset_by(t);
            imu.push(imu_simulator.sample(stamp, &state));
            if sample.is_multiple_of(samples_per_frame) {
                let world_from_camera = state.world_from_body * body_from_camera;
                let seen = sightings(lab, &scene, &landmarks, &world_from_camera, rng);
                frames.push(Frame { stamp, seen });
            }
        }
        let start = start(&motion.state(0.0), &config, rng);
        let propagator = Propagator::inertial(&config);
        Ok(Self { motion, imu, frames, start, propagator, body_from_camera })
    }
}

/// Two of three on the walls, the others on what stands in the room.
fn landmark(room: &[f64; 3], rng: &mut ChaCha8Rng) -> Vector3<f64> {
    let [x, y, z] = *room;
    let mut point = Vector3::new(
        rng.random_range(-0.5..0.5) * x,
        rng.random_range(-0.5..0.5) * y,
        rng.random_range(0.0..z),
    );
    match rng.random_range(0..6) {
        0 => point.x = -0.5 * x,
        1 => point.x = 0.5 * x,
        2 => point.y = -0.5 * y,
        3 => point.y = 0.5 * y,
        _ => {}
    }
    point
}

fn sightings(
    lab: &Lab,
    scene: &SceneConfig,
    landmarks: &[Vector3<f64>],
    world_from_camera: &Isometry3<f64>,
    rng: &mut ChaCha8Rng,
) -> Vec<(usize, PointMeasurement)> {
    let camera = Camera::pinhole(scene.camera.intrinsics());
    let mut seen = Vec::new();
    for (landmark, position) in landmarks.iter().enumerate() {
        let exact = world_from_camera.inverse_transform_point(&Point3::from(*position)).coords;
        if !(scene.depth.min..scene.depth.max).contains(&exact.z) {
            continue;
        }
        let Some(pixel) = camera.project(&exact) else { continue };
        let inside =
            (0.0..lab.image[0]).contains(&pixel.x) && (0.0..lab.image[1]).contains(&pixel.y);
        if !inside || rng.random::<f64>() >= lab.detected {
            continue;
        }
        let noise = normal(rng);
        let pixel = Point2::new(pixel.x + lab.pixel_sd * noise.x, pixel.y + lab.pixel_sd * noise.y);
        let standard_deviation = scene.depth.standard_deviation(exact.z);
        let depth = exact.z + standard_deviation * noise.z;
        let reading = DepthReading { depth, slope: Vector2::zeros(), standard_deviation };
        let measured = PointMeasurement::new(&camera, pixel, lab.pixel_sd, &reading);
        seen.extend(measured.map(|measured| (landmark, measured)));
    }
    seen
}

fn in_body(landmark: usize, seen: &PointMeasurement, mounting: &Isometry3<f64>) -> Seen {
    let rotation = mounting.rotation.to_rotation_matrix();
    Seen {
        landmark,
        in_body: (mounting * Point3::from(seen.point)).coords,
        body_covariance: rotation.matrix() * seen.covariance * rotation.matrix().transpose(),
    }
}

/// A belief and an error drawn from it.
fn start(truth: &BodyState, imu: &ImuConfig, rng: &mut ChaCha8Rng) -> Belief {
    let filter = FilterConfig::default();
    let tilt = filter.tilt_sd_deg.to_radians();
    let heading = filter.heading_sd_deg.to_radians();
    let in_world = Vector3::new(tilt, tilt, heading);
    let rotation = truth.world_from_body.rotation;
    let turn = UnitQuaternion::new(normal(rng).component_mul(&in_world));
    let state = NavState {
        world_from_body: Isometry3::from_parts(
            (truth.world_from_body.translation.vector + normal(rng) * filter.position_sd).into(),
            turn * rotation,
        ),
        velocity: truth.velocity + normal(rng) * filter.velocity_sd,
        gyro_bias: Vector3::zeros(),
        accel_bias: Vector3::zeros(),
    };
    let body_from_world = state.world_from_body.rotation.inverse().to_rotation_matrix();
    let variance = Matrix3::from_diagonal(&in_world.component_mul(&in_world));
    let mut covariance = NavCovariance::zeros();
    covariance
        .fixed_view_mut::<3, 3>(block::ROTATION, block::ROTATION)
        .copy_from(&(body_from_world.matrix() * variance * body_from_world.matrix().transpose()));
    for (start, sd) in [
        (block::VELOCITY, filter.velocity_sd),
        (block::POSITION, filter.position_sd),
        (block::GYRO_BIAS, imu.gyro_bias_sd),
        (block::ACCEL_BIAS, imu.accel_bias_sd),
    ] {
        for k in start..start + 3 {
            covariance[(k, k)] = sd * sd;
        }
    }
    Belief { state, covariance }
}

fn normal(rng: &mut ChaCha8Rng) -> Vector3<f64> {
    Vector3::from_fn(|_, _| StandardNormal.sample(rng))
}

fn consistency_trial(lab: &Lab, rng: &mut ChaCha8Rng) -> Result<Trial, LabError> {
    let drive = Drive::draw(lab, rng)?;
    let mut trial = Trial::default();
    for kind in FILTERS {
        run(kind, &drive, None)?.record("lab", kind, &mut trial);
    }
    Ok(trial)
}

/// Errors of the calibration that a run starts with: rotation (rad), translation (m), clock (s).
const CALIBRATION_ERRORS: [f64; 3] = [3.0 * std::f64::consts::PI / 180.0, 0.03, 0.02];

fn calibration_trial(lab: &Lab, rng: &mut ChaCha8Rng) -> Result<Trial, LabError> {
    let at_rest = Lab { standstill: lab.duration, ..lab.clone() };
    let mut trial = Trial::default();
    for (case, lab) in [("motion", lab), ("rest", &at_rest)] {
        let drive = Drive::draw(lab, rng)?;
        let prior = wrong_calibration(&drive.body_from_camera, rng);
        for kind in CALIBRATING {
            run(kind, &drive, prior.as_ref())?.record(case, kind, &mut trial);
        }
    }
    Ok(trial)
}

/// The true calibration but for errors of the magnitudes [`CALIBRATION_ERRORS`] in any direction,
/// and a belief that expects as much.
fn wrong_calibration(truth: &Isometry3<f64>, rng: &mut ChaCha8Rng) -> Option<Calibration> {
    let [rotation, translation, offset] = CALIBRATION_ERRORS;
    let mut direction = || normal(rng).normalize();
    let turn = UnitQuaternion::new(direction() * rotation);
    let body_from_camera = Isometry3::from_parts(
        (truth.translation.vector + direction() * translation).into(),
        turn * truth.rotation,
    );
    let config = FilterConfig {
        camera_rotation_sd_deg: (rotation / 3f64.sqrt()).to_degrees(),
        camera_translation_sd: translation / 3f64.sqrt(),
        camera_time_offset_sd: offset,
        ..FilterConfig::default()
    };
    let offset = if rng.random() { offset } else { -offset };
    Calibration::prior(&config, &body_from_camera, offset)
}

const QUANTITIES: [&str; 6] = [
    "attitude_deg",
    "position_m",
    "velocity_m_s",
    "nees_attitude",
    "nees_position",
    "nees_velocity",
];
const CALIBRATION_QUANTITIES: [&str; 9] = [
    "camera_rotation_deg",
    "camera_translation_m",
    "camera_time_offset_s",
    "camera_rotation_sd_deg",
    "camera_translation_sd_m",
    "camera_time_offset_sd_s",
    "nees_camera_rotation",
    "nees_camera_translation",
    "nees_camera_time_offset",
];

#[derive(Default)]
struct Run {
    /// Sums over the frames of the second half, by quantity.
    sums: BTreeMap<&'static str, f64>,
    frames: usize,
    /// Time of the filter and the map a frame, IMU samples included, ns.
    frame_ns: f64,
}

impl Run {
    fn add<const N: usize>(&mut self, quantities: [&'static str; N], values: [f64; N]) {
        for (quantity, value) in quantities.into_iter().zip(values) {
            *self.sums.entry(quantity).or_default() += value;
        }
    }

    fn record(&self, case: &'static str, kind: FilterKind, trial: &mut Trial) {
        let filter = kind.name();
        for (&quantity, sum) in &self.sums {
            let value = sum / self.frames as f64;
            trial.observations.push(Observation { case, filter, quantity, value });
        }
        trial.step_times.push(StepTime { case, filter, nanoseconds: self.frame_ns });
    }
}

fn run(
    kind: FilterKind,
    drive: &Drive,
    calibration: Option<&Calibration>,
) -> Result<Run, LabError> {
    let config = FilterConfig { huber: 0.0, ..FilterConfig::default() };
    let mut filter = kind.start(&config, drive.propagator.clone(), drive.start);
    if let Some(prior) = calibration {
        filter.calibrate(prior).map_err(LabError::Filter)?;
    }
    let (map, max_gap) = (MapConfig::default(), ImuConfig::default().max_gap);
    let mut landmarks = LandmarkRun::start(kind, filter, &config, &map, &drive.imu, max_gap);
    let mut run = Run::default();
    let clock = Instant::now();
    for (number, frame) in drive.frames.iter().enumerate() {
        let offset = landmarks.calibration().map_or(0.0, |estimate| estimate.time_offset);
        let time = frame.stamp.offset_by(offset);
        if !landmarks.propagate_to(time) {
            continue;
        }
        landmarks.see(|back_end| {
            let mounting = mounting(back_end.filter(), &drive.body_from_camera);
            frame.seen.iter().map(|(l, m)| in_body(*l, m, &mounting)).collect()
        });
        if 2 * number >= drive.frames.len() {
            let degenerate = || LabError::Covariance { filter: kind, seconds: time.seconds() };
            let truth = drive.motion.state(time.seconds());
            let belief = landmarks.back_end.belief();
            run.add(QUANTITIES, errors(belief, &truth).ok_or_else(degenerate)?);
            if let Some(estimate) = landmarks.calibration() {
                let errors = calibration_errors(estimate, &drive.body_from_camera);
                run.add(CALIBRATION_QUANTITIES, errors.ok_or_else(degenerate)?);
            }
            run.frames += 1;
        }
    }
    run.frame_ns = clock.elapsed().as_nanos() as f64 / drive.frames.len() as f64;
    Ok(run)
}

/// In the order of [`CALIBRATION_QUANTITIES`].
fn calibration_errors(estimate: &Calibration, truth: &Isometry3<f64>) -> Option<[f64; 9]> {
    let found = &estimate.body_from_camera;
    let rotation = (truth.rotation * found.rotation.inverse()).scaled_axis();
    let translation = truth.translation.vector - found.translation.vector;
    let offset = estimate.time_offset;
    let block = |start: usize| estimate.covariance.fixed_view::<3, 3>(start, start).into_owned();
    let nees = |error: &Vector3<f64>, start: usize| {
        Some(error.dot(&block(start).cholesky()?.solve(error)))
    };
    let sd = |start: usize| (block(start).trace() / 3.0).sqrt();
    let of_offset = calibration_block::TIME_OFFSET;
    let offset_variance = estimate.covariance[(of_offset, of_offset)];
    Some([
        rotation.norm().to_degrees(),
        translation.norm(),
        offset.abs(),
        sd(calibration_block::ROTATION).to_degrees(),
        sd(calibration_block::TRANSLATION),
        offset_variance.sqrt(),
        nees(&rotation, calibration_block::ROTATION)?,
        nees(&translation, calibration_block::TRANSLATION)?,
        offset * offset / offset_variance,
    ])
}

/// In the order of [`QUANTITIES`].
fn errors(belief: &Belief, truth: &BodyState) -> Option<[f64; 6]> {
    let (estimate, exact) = (&belief.state.world_from_body, &truth.world_from_body);
    let turn = (estimate.rotation.inverse() * exact.rotation).scaled_axis();
    let position = exact.translation.vector - estimate.translation.vector;
    let velocity = truth.velocity - belief.state.velocity;
    let nees = |error: &Vector3<f64>, start: usize| {
        let covariance = belief.covariance.fixed_view::<3, 3>(start, start).into_owned();
        Some(error.dot(&covariance.cholesky()?.solve(error)))
    };
    Some([
        turn.norm().to_degrees(),
        position.norm(),
        velocity.norm(),
        nees(&turn, block::ROTATION)?,
        nees(&position, block::POSITION)?,
        nees(&velocity, block::VELOCITY)?,
    ])
}

/// Of the camera, as the filter has it, or as it is known.
fn mounting(filter: &dyn VisualInertialFilter, known: &Isometry3<f64>) -> Isometry3<f64> {
    filter.calibration().map_or(*known, |estimate| estimate.body_from_camera)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    #[test]
    fn motion_reveals_the_calibration() {
        let lab = Lab { duration: 10.0, frame_rate: 10.0, ..Lab::default() };
        let trial = calibration_trial(&lab, &mut ChaCha8Rng::seed_from_u64(3)).unwrap();
        let value = |case, quantity| {
            let key = (case, "mfgs", quantity);
            let found = trial.observations.iter().find(|o| (o.case, o.filter, o.quantity) == key);
            found.unwrap().value
        };
        assert!(value("motion", "camera_rotation_deg") < 0.3);
        assert!(value("motion", "camera_time_offset_s") < 2e-3);
        // A camera at rest shows nothing of its mounting, and the filter knows.
        assert!((2.5..3.5).contains(&value("rest", "camera_rotation_deg")));
        assert!(value("rest", "camera_rotation_sd_deg") > 1.3);
    }
}
