//! Tables 5.11, 5.15 and 5.16 of W22: visual-inertial filters among known, uncertain and unknown
//! landmarks.
//!
//! As in the paper, filter and simulation share their noise parameters, biases are absent and not
//! estimated, and no measurement is left out or down-weighted. Errors are averaged over the IMU
//! samples of a drive from its start, so that the time until a reversed heading is corrected
//! counts. The map error is the mean over the landmarks seen so far, averaged over the frames.
//! The paper gives no positions of landmarks; ours are uniform in a box around the circle.
//!
//! Filters whose state holds the landmarks (`mfgs`, `mekfs`) use every second one, never forget it,
//! and are judged by the map of those. They start with a map and a known heading.

use std::time::Instant;

use nalgebra::{Isometry3, Matrix3, UnitQuaternion, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::landmarks::{LandmarkRun, Seen};
use super::study::normalized_square;
use super::{
    Observation, PaperValue, Report, Request, StepTime, Study, StudyError, Trial, monte_carlo,
};
use crate::distribution::matrix_fisher::{MatrixFisher, MatrixFisherError};
use crate::filter::{
    FilterConfig, FilterKind, MapEstimate, MapTreatment, UpdateMethod, VisualInertialFilter,
};
use crate::inertial::{Belief, ImuConfig, NavCovariance, NavState, Propagator, block};
use crate::map::MapConfig;
use crate::simulation::{BodyState, LandmarkFrame, LandmarkScene, LandmarkSceneConfig};

/// Section 5.2 of W22, filters.
pub const STUDIES: &[Study] = &[
    Study {
        name: "wang-5.11",
        title: "visual-inertial navigation, map known",
        runs: 100,
        run: |request| {
            study("wang-5.11", KNOWN_MAP, TABLE_5_11.as_flattened().as_flattened(), request)
        },
    },
    Study {
        name: "wang-5.15",
        title: "visual-inertial navigation, map uncertain",
        runs: 100,
        run: |request| {
            study("wang-5.15", UNCERTAIN_MAP, TABLE_5_15.as_flattened().as_flattened(), request)
        },
    },
    Study {
        name: "wang-5.16",
        title: "visual-inertial odometry, map uncertain in the first second and unknown after it",
        runs: 100,
        run: |request| {
            study("wang-5.16", UNKNOWN_MAP, TABLE_5_16.as_flattened().as_flattened(), request)
        },
    },
];

/// What is known of the landmarks beforehand.
#[derive(Debug, Clone, Copy, PartialEq)]
enum MapPrior {
    Exact,
    /// Standard deviation of each coordinate, m.
    All(f64),
    /// The same, but only for landmarks seen in the first second.
    FirstSecond(f64),
}

/// How well the initial attitude is known.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Heading {
    /// To 0.1 rad about each axis.
    Known,
    /// Off by half a turn about the vertical, and believed almost uniform.
    Reversed,
}

#[derive(Debug, Clone, Copy)]
struct Case {
    label: &'static str,
    prior: MapPrior,
    heading: Heading,
}

/// A filter and the name of its rows.
#[derive(Debug, Clone, Copy)]
struct Contender {
    name: &'static str,
    kind: FilterKind,
    update_method: UpdateMethod,
}

struct Drives {
    landmarks: usize,
    measurement_sd: f64,
    filters: &'static [&'static [Contender]],
    cases: &'static [Case],
}

const fn case(label: &'static str, prior: MapPrior, heading: Heading) -> Case {
    Case { label, prior, heading }
}

const fn contender(name: &'static str, kind: FilterKind, update_method: UpdateMethod) -> Contender {
    Contender { name, kind, update_method }
}

/// With a fixed map; the second is the paper's MFG filter, by sigma points.
const FIXED: &[Contender] = &[
    contender("mfgd", FilterKind::Mfgd, UpdateMethod::Exact),
    contender("mfgd-paper", FilterKind::Mfgd, UpdateMethod::SigmaPoints),
    contender("mekfd", FilterKind::Mekfd, UpdateMethod::Exact),
];

/// With a map that is refined.
const REFINED: &[Contender] = &[
    contender("mfgr", FilterKind::Mfgr, UpdateMethod::Exact),
    contender("mfgr-paper", FilterKind::Mfgr, UpdateMethod::SigmaPoints),
    contender("mekfr", FilterKind::Mekfr, UpdateMethod::Exact),
];

/// With map points in the state.
const CORRELATED: &[Contender] = &[
    contender("mfgs", FilterKind::Mfgs, UpdateMethod::Exact),
    contender("iekfs", FilterKind::Iekfs, UpdateMethod::Exact),
    contender("mekfs", FilterKind::Mekfs, UpdateMethod::Exact),
];

const KNOWN_MAP: &Drives = &Drives {
    landmarks: 100,
    measurement_sd: 1.0,
    filters: &[FIXED],
    cases: &[
        case("small", MapPrior::Exact, Heading::Known),
        case("large-initial", MapPrior::Exact, Heading::Reversed),
    ],
};

const UNCERTAIN_MAP: &Drives = &Drives {
    landmarks: 400,
    measurement_sd: 0.05,
    filters: &[REFINED],
    cases: &[
        case("normal", MapPrior::All(0.1), Heading::Known),
        case("large-map", MapPrior::All(1.0), Heading::Known),
        case("large-initial", MapPrior::All(0.1), Heading::Reversed),
    ],
};

const UNKNOWN_MAP: &Drives = &Drives {
    landmarks: 400,
    measurement_sd: 0.05,
    filters: &[REFINED, CORRELATED],
    cases: &[
        case("normal", MapPrior::FirstSecond(0.1), Heading::Known),
        case("large-map", MapPrior::FirstSecond(1.0), Heading::Known),
        case("large-initial", MapPrior::FirstSecond(0.1), Heading::Reversed),
    ],
};

/// Of so many landmarks one is taken by filters whose state holds them.
const STATE_STRIDE: usize = 2;
/// Standard deviation of each component of the initial rotation vector (rad), velocity (m/s) and
/// position (m).
const INITIAL_SD: f64 = 0.1;
/// Singular values of the almost uniform initial attitude.
const BROAD_S: f64 = 0.01;
/// The variance that stands for it in a Gaussian filter, rad^2.
const BROAD_VARIANCE: f64 = 1000.0;

fn study(
    name: &str,
    drives: &Drives,
    paper: &[PaperValue],
    request: &Request,
) -> Result<Report, StudyError> {
    let trials = monte_carlo(request, |rng| trial(drives, rng))?;
    Ok(Report::of(name, request.seed, &trials, paper))
}

/// Every filter in every case, on the same landmarks, motion and noise.
fn trial(drives: &Drives, rng: &mut ChaCha8Rng) -> Result<Trial, MatrixFisherError> {
    let config = LandmarkSceneConfig::paper(drives.landmarks, drives.measurement_sd);
    let scene = LandmarkScene::draw(&config, rng);
    let propagator = Propagator::inertial(&ImuConfig {
        gyro_noise: config.imu.gyro_noise,
        accel_noise: config.imu.accel_noise,
        gyro_bias_walk: config.imu.gyro_bias_walk,
        accel_bias_walk: config.imu.accel_bias_walk,
        gravity: config.imu.gravity,
        ..ImuConfig::default()
    });
    let state_points = drives.landmarks.div_ceil(STATE_STRIDE);
    let mut trial = Trial::default();
    for case in drives.cases {
        let map = prior_map(&scene, case.prior, rng);
        let (belief, attitude) = start(&scene, case.heading, rng)?;
        for contender in drives.filters.iter().copied().flatten() {
            let &Contender { kind, update_method, .. } = contender;
            let config = FilterConfig {
                update_method,
                huber: 0.0,
                gate_probability: 0.0,
                state_points,
                ..FilterConfig::default()
            };
            let filter = match &attitude {
                None => kind.start(&config, propagator.clone(), belief),
                Some(attitude) => kind.start_broad(&config, propagator.clone(), belief, attitude),
            };
            let errors = drive(contender, filter, &config, &scene, &map);
            errors.record(case, contender, &mut trial);
        }
    }
    Ok(trial)
}

/// The belief at the first sample, and the attitude's distribution where it is broad.
fn start(
    scene: &LandmarkScene,
    heading: Heading,
    rng: &mut ChaCha8Rng,
) -> Result<(Belief, Option<MatrixFisher>), MatrixFisherError> {
    let truth = &scene.truth[0];
    let rotation = truth.world_from_body.rotation;
    let draw = normal(rng) * INITIAL_SD;
    let (rotation, variance) = match heading {
        Heading::Known => (rotation * UnitQuaternion::new(draw), INITIAL_SD.powi(2)),
        Heading::Reversed => {
            let half_turn =
                UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::PI);
            (half_turn * rotation, BROAD_VARIANCE)
        }
    };
    let position = truth.world_from_body.translation.vector + normal(rng) * INITIAL_SD;
    let state = NavState {
        world_from_body: Isometry3::from_parts(position.into(), rotation),
        velocity: truth.velocity + normal(rng) * INITIAL_SD,
        gyro_bias: Vector3::zeros(),
        accel_bias: Vector3::zeros(),
    };
    let mut covariance = NavCovariance::zeros();
    for k in 0..3 {
        covariance[(block::ROTATION + k, block::ROTATION + k)] = variance;
        covariance[(block::VELOCITY + k, block::VELOCITY + k)] = INITIAL_SD.powi(2);
        covariance[(block::POSITION + k, block::POSITION + k)] = INITIAL_SD.powi(2);
    }
    let attitude = match heading {
        Heading::Known => None,
        Heading::Reversed => {
            let parameter = rotation.to_rotation_matrix().into_inner() * BROAD_S;
            Some(MatrixFisher::new(&parameter)?)
        }
    };
    Ok((Belief { state, covariance }, attitude))
}

/// What is believed of each landmark; `None` where nothing is.
type LandmarkMap = Vec<Option<MapEstimate>>;

fn prior_map(scene: &LandmarkScene, prior: MapPrior, rng: &mut ChaCha8Rng) -> LandmarkMap {
    let sd = match prior {
        MapPrior::Exact => 0.0,
        MapPrior::All(sd) | MapPrior::FirstSecond(sd) => sd,
    };
    let mut known = vec![!matches!(prior, MapPrior::FirstSecond(_)); scene.landmarks.len()];
    let start = scene.imu[0].stamp;
    let first_second = scene
        .frames
        .iter()
        .take_while(|frame| scene.imu[frame.sample].stamp.seconds_since(start) <= 1.0);
    for sighting in first_second.flat_map(|frame| &frame.sightings) {
        known[sighting.landmark] = true;
    }
    let estimate = |(position, known): (&Vector3<f64>, bool)| {
        // Drawn for unknown landmarks too, so that all cases see the same noise.
        let position = position + normal(rng) * sd;
        known.then(|| MapEstimate { position, covariance: Matrix3::identity() * sd.powi(2) })
    };
    scene.landmarks.iter().zip(known).map(estimate).collect()
}

fn normal(rng: &mut ChaCha8Rng) -> Vector3<f64> {
    Vector3::from_fn(|_, _| StandardNormal.sample(rng))
}

/// Sums over one drive.
#[derive(Debug, Clone, Default)]
struct DriveErrors {
    attitude_deg: Mean,
    velocity: Mean,
    position: Mean,
    map: Mean,
    nees_attitude: Mean,
    nees_velocity: Mean,
    nees_position: Mean,
    /// Of the filter, ns a frame, the IMU samples before it included.
    step: Mean,
}

#[derive(Debug, Clone, Copy, Default)]
struct Mean {
    sum: f64,
    count: usize,
}

impl Mean {
    fn add(&mut self, value: f64) {
        self.sum += value;
        self.count += 1;
    }

    fn value(&self) -> f64 {
        self.sum / self.count as f64
    }
}

/// The landmarks' errors do not depend on their age, and none is forgotten.
const EVERLASTING: MapConfig = MapConfig {
    min_distance: 0.0,
    max_distance: f64::INFINITY,
    max_view_angle_deg: 180.0,
    view_margin: 0.0,
    max_unseen_frames: u64::MAX,
    max_points: usize::MAX,
};

/// Whether a filter of this treatment takes a landmark.
fn takes(treatment: MapTreatment, landmark: usize) -> bool {
    treatment != MapTreatment::Correlated || landmark.is_multiple_of(STATE_STRIDE)
}

fn drive(
    contender: &Contender,
    filter: Box<dyn VisualInertialFilter>,
    config: &FilterConfig,
    scene: &LandmarkScene,
    map: &LandmarkMap,
) -> DriveErrors {
    let treatment = contender.kind.map_treatment();
    let max_gap = ImuConfig::default().max_gap;
    let mut run =
        LandmarkRun::start(contender.kind, filter, config, &EVERLASTING, &scene.imu, max_gap);
    for (landmark, known) in map.iter().enumerate().filter(|(l, _)| takes(treatment, *l)) {
        if let Some(known) = known {
            run.know(landmark, known);
        }
    }
    let mut errors = DriveErrors::default();
    let mut seen = vec![false; map.len()];
    let mut frames = scene.frames.iter().enumerate().peekable();
    let mut clock = Instant::now();
    errors.add_state(run.back_end.belief(), &scene.truth[0]);
    for (sample, reading) in scene.imu.iter().enumerate().skip(1) {
        run.propagate_to(reading.stamp);
        let truth = &scene.truth[sample];
        if let Some((number, frame)) = frames.next_if(|(_, frame)| frame.sample == sample) {
            run.see(|_| sightings(scene, frame, treatment));
            errors.step.add(clock.elapsed().as_nanos() as f64);
            for sighting in &frame.sightings {
                seen[sighting.landmark] = true;
            }
            errors.add_map(scene, &run, &seen);
            if 2 * number >= scene.frames.len() {
                errors.add_nees(run.back_end.belief(), truth);
            }
            clock = Instant::now();
        }
        errors.add_state(run.back_end.belief(), truth);
    }
    errors
}

fn sightings(scene: &LandmarkScene, frame: &LandmarkFrame, treatment: MapTreatment) -> Vec<Seen> {
    let body_covariance = scene.measurement_covariance();
    let taken = frame.sightings.iter().filter(|s| takes(treatment, s.landmark));
    taken.map(|s| Seen { landmark: s.landmark, in_body: s.in_body, body_covariance }).collect()
}

impl DriveErrors {
    fn add_state(&mut self, belief: &Belief, truth: &BodyState) {
        let (estimate, exact) = (&belief.state.world_from_body, &truth.world_from_body);
        self.attitude_deg.add(estimate.rotation.angle_to(&exact.rotation).to_degrees());
        self.velocity.add((belief.state.velocity - truth.velocity).norm());
        self.position.add((estimate.translation.vector - exact.translation.vector).norm());
    }

    fn add_map(&mut self, scene: &LandmarkScene, run: &LandmarkRun, seen: &[bool]) {
        let mut mean = Mean::default();
        for (landmark, truth) in scene.landmarks.iter().enumerate().filter(|(l, _)| seen[*l]) {
            if let Some(position) = run.position(landmark) {
                mean.add((position - truth).norm());
            }
        }
        if mean.count > 0 {
            self.map.add(mean.value());
        }
    }

    fn add_nees(&mut self, belief: &Belief, truth: &BodyState) {
        let (estimate, exact) = (&belief.state.world_from_body, &truth.world_from_body);
        let nees = |error: Vector3<f64>, start: usize| {
            let covariance = belief.covariance.fixed_view::<3, 3>(start, start).into_owned();
            normalized_square(&error, &covariance)
        };
        let turn = (estimate.rotation.inverse() * exact.rotation).scaled_axis();
        self.nees_attitude.add(nees(turn, block::ROTATION));
        let velocity = truth.velocity - belief.state.velocity;
        self.nees_velocity.add(nees(velocity, block::VELOCITY));
        let position = exact.translation.vector - estimate.translation.vector;
        self.nees_position.add(nees(position, block::POSITION));
    }

    fn record(&self, case: &Case, contender: &Contender, trial: &mut Trial) {
        let quantities = [
            ("attitude_deg", &self.attitude_deg),
            ("velocity_m_s", &self.velocity),
            ("position_m", &self.position),
            ("map_m", &self.map),
            ("nees_attitude", &self.nees_attitude),
            ("nees_velocity", &self.nees_velocity),
            ("nees_position", &self.nees_position),
        ];
        let (case, filter) = (case.label, contender.name);
        for (quantity, mean) in quantities {
            if quantity == "map_m" && contender.kind.map_treatment() == MapTreatment::Fixed {
                continue;
            }
            let value = mean.value();
            trial.observations.push(Observation { case, filter, quantity, value });
        }
        let nanoseconds = self.step.value();
        trial.step_times.push(StepTime { case, filter, nanoseconds });
    }
}

const QUANTITIES: [&str; 4] = ["attitude_deg", "velocity_m_s", "position_m", "map_m"];

/// A column of a table: the first of [`QUANTITIES`].
const fn column<const N: usize>(
    case: &'static str,
    filter: &'static str,
    means: [f64; N],
) -> [PaperValue; N] {
    let mut values = [PaperValue { case, filter, quantity: "", mean: 0.0 }; N];
    let mut i = 0;
    while i < N {
        values[i].quantity = QUANTITIES[i];
        values[i].mean = means[i];
        i += 1;
    }
    values
}

/// Columns of all filters: the paper's MFG stands beside both of ours.
const fn printed<const N: usize>(
    case: &'static str,
    filters: &'static [Contender],
    mfg: [f64; N],
    mekf: [f64; N],
) -> [[PaperValue; N]; 3] {
    [
        column(case, filters[0].name, mfg),
        column(case, filters[1].name, mfg),
        column(case, filters[2].name, mekf),
    ]
}

const TABLE_5_11: &[[[PaperValue; 3]; 3]] = &[
    printed("small", FIXED, [0.97, 0.208, 0.173], [0.90, 0.205, 0.172]),
    printed("large-initial", FIXED, [1.62, 0.235, 0.184], [75.0, 1.59, 2.37]),
];

const TABLE_5_15: &[[[PaperValue; 4]; 3]] = &[
    printed("normal", REFINED, [0.65, 0.078, 0.042, 0.044], [0.73, 0.079, 0.048, 0.051]),
    printed("large-map", REFINED, [4.36, 0.158, 0.314, 0.384], [5.12, 0.179, 0.355, 0.441]),
    printed("large-initial", REFINED, [1.07, 0.082, 0.041, 0.043], [101.64, 1.610, 5.033, 6.167]),
];

const TABLE_5_16: &[[[PaperValue; 4]; 3]] = &[
    printed("normal", REFINED, [1.16, 0.086, 0.103, 0.109], [1.25, 0.088, 0.108, 0.115]),
    printed("large-map", REFINED, [4.47, 0.161, 0.321, 0.393], [5.18, 0.180, 0.360, 0.448]),
    printed("large-initial", REFINED, [1.56, 0.090, 0.098, 0.104], [179.0, 2.328, 9.958, 11.55]),
];

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    fn one_run(drives: &Drives) -> impl Fn(&str, &str, &str) -> f64 {
        let trial = trial(drives, &mut ChaCha8Rng::seed_from_u64(5)).unwrap();
        move |case, filter, quantity| {
            let key = (case, filter, quantity);
            let found =
                trial.observations.iter().find(|o| (o.case, o.filter, o.quantity) == key).unwrap();
            found.value
        }
    }

    #[test]
    fn a_reversed_heading_is_corrected_at_the_first_frame() {
        let value = one_run(KNOWN_MAP);
        // Half a turn for 0.1 of 40 s is 0.45 degrees of the mean.
        let excess =
            value("large-initial", "mfgd", "attitude_deg") - value("small", "mfgd", "attitude_deg");
        assert!((0.2..0.8).contains(&excess), "{excess}");
        assert!(value("small", "mfgd", "position_m") < 0.25);
        assert!(value("small", "mekfd", "attitude_deg") < 2.0);
    }
}
