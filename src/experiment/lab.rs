//! Consistency in odometry: a hand-held RGB-D camera and IMU in a lab, without images.
//!
//! The sensors, their noise and the motion are those of the simulator; what is left out is the
//! image: corners are points that are detected with a fixed probability and never mistaken.

use std::time::Instant;

use nalgebra::{Isometry3, Matrix3, Point2, Point3, UnitQuaternion, Vector2, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::study::{Observation, Report, Request, StepTime, Study, StudyError, Trial, monte_carlo};
use crate::alignment::PointPair;
use crate::evaluation::NeesSummary;
use crate::filter::{FilterConfig, FilterKind, MapTreatment, SeenPoint, VisualInertialFilter};
use crate::inertial::{
    Belief, ImuConfig, ImuSample, NavCovariance, NavState, Propagator, Stamp, block,
};
use crate::map::{Map, MapConfig, Sighting};
use crate::odometry::renew_state_points;
use crate::simulation::{BodyState, ImuSimulator, Motion, MotionConfig, SceneConfig, SceneError};
use crate::vision::{DepthReading, Descriptor, PinholeCamera, PointMeasurement};

/// Studies of this module.
pub const STUDIES: &[Study] = &[Study {
    name: "lab-nees",
    title: "NEES in odometry: 60 s of a hand-held camera in a lab, points without images",
    runs: 20,
    run: |request| study(request, &Lab::default()),
}];

const FILTERS: [FilterKind; 4] =
    [FilterKind::Mfgs, FilterKind::Mekfs, FilterKind::Mfgr, FilterKind::Mekfr];

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
        }
    }
}

#[derive(Debug, thiserror::Error)]
pub enum LabError {
    #[error(transparent)]
    Scene(#[from] SceneError),
    #[error("{filter}: the belief's covariance is not positive definite at {seconds:.2} s")]
    Covariance { filter: FilterKind, seconds: f64 },
}

fn study(request: &Request, lab: &Lab) -> Result<Report, StudyError> {
    let trials = monte_carlo(request, |rng| trial(lab, rng))?;
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

/// What all filters of a run are given.
struct Drive {
    truth: Vec<BodyState>,
    imu: Vec<ImuSample>,
    frames: Vec<Frame>,
    start: Belief,
    propagator: Propagator,
}

struct Frame {
    /// Index of the IMU sample of the same instant.
    sample: usize,
    seen: Vec<(usize, SeenPoint)>,
    camera: Vector3<f64>,
}

impl Drive {
    fn draw(lab: &Lab, rng: &mut ChaCha8Rng) -> Result<Self, LabError> {
        let scene = SceneConfig::default();
        let body_from_camera = scene.validate()?;
        let motion = MotionConfig { standstill: 0.0, ramp: 1.0, ..MotionConfig::default() };
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
        let (mut truth, mut imu, mut frames) = (Vec::new(), Vec::new(), Vec::new());
        for sample in 0..=samples {
            let t = sample as f64 / scene.imu.rate;
            let state = motion.state(t);
            imu.push(imu_simulator.sample(Stamp::default().offset_by(t), &state));
            truth.push(state);
            if sample.is_multiple_of(samples_per_frame) {
                let world_from_camera = state.world_from_body * body_from_camera;
                let seen = sightings(lab, &scene, &landmarks, &world_from_camera, rng)
                    .into_iter()
                    .map(|(landmark, m)| (landmark, in_body(&m, &body_from_camera)))
                    .collect();
                frames.push(Frame { sample, seen, camera: world_from_camera.translation.vector });
            }
        }
        let start = start(&truth[0], &config, rng);
        Ok(Self { truth, imu, frames, start, propagator: Propagator::inertial(&config) })
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
    let camera = PinholeCamera::from(&scene.camera);
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
        seen.push((landmark, PointMeasurement::new(&camera, pixel, lab.pixel_sd, &reading)));
    }
    seen
}

fn in_body(measurement: &PointMeasurement, body_from_camera: &Isometry3<f64>) -> SeenPoint {
    let rotation = body_from_camera.rotation.to_rotation_matrix();
    SeenPoint {
        id: 0,
        in_body: (body_from_camera * Point3::from(measurement.point)).coords,
        body_covariance: rotation.matrix() * measurement.covariance * rotation.matrix().transpose(),
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

fn trial(lab: &Lab, rng: &mut ChaCha8Rng) -> Result<Trial, LabError> {
    let drive = Drive::draw(lab, rng)?;
    let mut trial = Trial::default();
    for kind in FILTERS {
        let run = run(kind, &drive)?;
        let filter = kind.name();
        for (quantity, value) in QUANTITIES.into_iter().zip(run.means) {
            trial.observations.push(Observation { case: "lab", filter, quantity, value });
        }
        trial.step_times.push(StepTime { case: "lab", filter, nanoseconds: run.frame_ns });
    }
    Ok(trial)
}

const QUANTITIES: [&str; 6] = [
    "attitude_deg",
    "position_m",
    "velocity_m_s",
    "nees_attitude",
    "nees_position",
    "nees_velocity",
];

struct Run {
    /// Over the second half, in the order of [`QUANTITIES`].
    means: [f64; 6],
    /// Time of the filter and the map a frame, IMU samples included, ns.
    frame_ns: f64,
}

fn run(kind: FilterKind, drive: &Drive) -> Result<Run, LabError> {
    let config = FilterConfig { huber: 0.0, ..FilterConfig::default() };
    let mut filter = kind.start(&config, drive.propagator.clone(), drive.start);
    let mut tracks = Tracks::default();
    let (mut sums, mut count) = ([0.0; 6], 0);
    let mut last = 0;
    let clock = Instant::now();
    for (number, frame) in drive.frames.iter().enumerate() {
        for pair in drive.imu[last..=frame.sample].windows(2) {
            filter.propagate(&pair[0], &pair[1]);
        }
        last = frame.sample;
        tracks.see(filter.as_mut(), kind.map_treatment(), number as u64, frame, &config);
        if 2 * number >= drive.frames.len() {
            let truth = &drive.truth[frame.sample];
            let errors = errors(filter.belief(), truth).ok_or(LabError::Covariance {
                filter: kind,
                seconds: drive.imu[frame.sample].stamp.seconds(),
            })?;
            for (sum, error) in sums.iter_mut().zip(errors) {
                *sum += error;
            }
            count += 1;
        }
    }
    let frame_ns = clock.elapsed().as_nanos() as f64 / drive.frames.len() as f64;
    Ok(Run { means: sums.map(|sum| sum / f64::from(count)), frame_ns })
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

/// Which landmark is which point of the map; the map lives by the rules of the pipeline.
struct Tracks {
    map: Map,
    points: std::collections::BTreeMap<usize, u64>,
}

impl Default for Tracks {
    fn default() -> Self {
        Self { map: Map::new(&MapConfig::default()), points: Default::default() }
    }
}

impl Tracks {
    fn see(
        &mut self,
        filter: &mut dyn VisualInertialFilter,
        treatment: MapTreatment,
        number: u64,
        frame: &Frame,
        config: &FilterConfig,
    ) {
        let sighting = Sighting {
            frame: number,
            camera: frame.camera,
            descriptor: Descriptor::from_bytes(&[0; Descriptor::BYTES]),
            reference: None,
        };
        let (mut seen, mut fresh) = (Vec::new(), Vec::new());
        for &(landmark, point) in &frame.seen {
            let known = self.points.get(&landmark).filter(|id| self.map.get(**id).is_some());
            match known {
                Some(&id) => seen.push(SeenPoint { id, ..point }),
                None => fresh.push((landmark, point)),
            }
        }
        let pairs: Vec<_> = seen.iter().filter_map(|point| self.pair(point)).collect();
        let updated = match filter.point_state() {
            Some(points) => points.measure(&seen).is_some(),
            None => filter.update(&pairs).is_some(),
        };
        for (point, pair) in seen.iter().zip(&pairs) {
            let refined =
                filter.refine(pair).filter(|_| updated && treatment != MapTreatment::Fixed);
            if let Some(refined) = refined {
                self.map.relocate(point.id, refined.position, refined.covariance);
            }
            self.map.observe(point.id, &sighting);
        }
        for (landmark, point) in fresh {
            let estimate = filter.insert(treatment, &point.in_body, &point.body_covariance);
            let id = self.map.insert(estimate.position, estimate.covariance, &sighting);
            if let Some(id) = id {
                self.points.insert(landmark, id);
                seen.push(SeenPoint { id, ..point });
            }
        }
        if let Some(points) = filter.point_state() {
            renew_state_points(points, &mut self.map, &seen, number, config);
        }
        self.map.prune(number);
    }

    fn pair(&self, point: &SeenPoint) -> Option<PointPair> {
        let known = self.map.get(point.id)?;
        Some(PointPair {
            in_body: point.in_body,
            body_covariance: point.body_covariance,
            in_world: known.position,
            world_covariance: known.covariance,
        })
    }
}
