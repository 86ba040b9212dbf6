//! Smooth motions whose pose, velocity, acceleration and angular velocity are exact.

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::trajectory::{Trajectory, TrajectoryConfig, TrajectoryError};
use crate::sensor::Stamp;

/// Pose and derivatives of the body (IMU) at one instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BodyState {
    pub world_from_body: Isometry3<f64>,
    /// World coordinates, m/s.
    pub velocity: Vector3<f64>,
    /// World coordinates, m/s^2.
    pub acceleration: Vector3<f64>,
    /// Body coordinates, rad/s.
    pub angular_velocity: Vector3<f64>,
}

impl BodyState {
    /// What a perfect accelerometer reads: `R^T (a - g)` in body coordinates, m/s^2, with
    /// `gravity` the magnitude of the downward gravity.
    pub fn specific_force(&self, gravity: f64) -> Vector3<f64> {
        let force = self.acceleration + Vector3::new(0.0, 0.0, gravity);
        self.world_from_body.rotation.inverse_transform_vector(&force)
    }
}

/// The built-in motions, after the sequence families of VCU-RVI.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MotionKind {
    /// Held in the hand, looking around a room without hurry.
    LabSimple,
    /// Held in the hand, quick turns and shakes.
    LabMotion,
    /// On wheels along a circle, over speed bumps.
    LabBumper,
    /// As `lab-simple`; meant for scenes whose light changes.
    LabLight,
    /// As `lab-simple`; meant for scenes in which things move.
    LabDynamic,
    /// Walking along a corridor.
    Corridor,
    /// Walking around a hall.
    Hall,
    /// The circle of W22 5.2.2, radius 3 m, one metre up and down, looking along the path.
    Circle,
}

/// How the sensor moves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MotionConfig {
    /// Shape of the built-in motion, where no trajectory is given: `"lab-simple"`, `"lab-motion"`, `"lab-bumper"`, `"lab-light"`,
    /// `"lab-dynamic"`, `"corridor"`, `"hall"` or `"circle"`.
    pub kind: MotionKind,
    /// Factor on the pace: 2 runs through the same path twice as fast.
    pub speed: f64,
    /// Time at rest before the motion starts, s.
    pub standstill: f64,
    /// Time over which the pace grows from zero to `speed`, s.
    pub ramp: f64,
}

impl Default for MotionConfig {
    fn default() -> Self {
        Self { kind: MotionKind::LabSimple, speed: 1.0, standstill: 1.5, ramp: 1.5 }
    }
}

/// Value and first two derivatives.
type Jet = [f64; 3];

/// `offset + rate t`, plus sinusoids, plus bell-shaped bumps: smooth, with exact derivatives.
#[derive(Debug, Clone, Default)]
struct Signal {
    offset: f64,
    rate: f64,
    /// Amplitude, angular frequency (rad/s), phase (rad).
    waves: Vec<[f64; 3]>,
    /// Height, time (s), width (s).
    bumps: Vec<[f64; 3]>,
}

impl Signal {
    fn at(&self, t: f64) -> Jet {
        let mut jet = [self.offset + self.rate * t, self.rate, 0.0];
        for &[amplitude, frequency, phase] in &self.waves {
            let (s, c) = (frequency * t + phase).sin_cos();
            jet[0] += amplitude * s;
            jet[1] += amplitude * frequency * c;
            jet[2] -= amplitude * frequency * frequency * s;
        }
        for &[height, time, width] in &self.bumps {
            let x = (t - time) / width;
            let bell = height * (-0.5 * x * x).exp();
            jet[0] += bell;
            jet[1] -= bell * x / width;
            jet[2] += bell * (x * x - 1.0) / (width * width);
        }
        jet
    }

    fn offset(value: f64) -> Self {
        Self { offset: value, ..Self::default() }
    }

    fn drift(mut self, rate: f64) -> Self {
        self.rate = rate;
        self
    }

    /// Adds a sinusoid of `frequency` Hz.
    fn wave(mut self, amplitude: f64, frequency: f64, phase: f64) -> Self {
        self.waves.push([amplitude, frequency * std::f64::consts::TAU, phase]);
        self
    }
}

/// Position of the body and yaw, pitch, roll of the camera (forward, left, up axes) in time.
#[derive(Debug, Clone, Default)]
struct Path {
    position: [Signal; 3],
    /// Counterclockwise seen from above, rad; 0 looks along world x.
    yaw: Signal,
    /// Positive looks up, rad.
    pitch: Signal,
    /// Positive leans to the right, rad.
    roll: Signal,
}

/// A motion: a curve run through at a pace that starts from rest.
#[derive(Debug, Clone)]
pub struct Motion {
    curve: Curve,
    pace: Pace,
}

#[derive(Debug, Clone)]
enum Curve {
    BuiltIn {
        path: Box<Path>,
        /// Rotation of the IMU in the camera's forward-left-up frame.
        level_from_body: UnitQuaternion<f64>,
    },
    Recorded(Trajectory),
}

impl Motion {
    /// A built-in motion; `body_from_camera` tells how the body is held so that the camera looks
    /// ahead, `seed` sets the phases.
    pub fn built_in(config: &MotionConfig, body_from_camera: &Isometry3<f64>, seed: u64) -> Self {
        let path = Box::new(path(config.kind, &mut ChaCha8Rng::seed_from_u64(seed)));
        let level_from_body = level_from_camera() * body_from_camera.rotation.inverse();
        Self { curve: Curve::BuiltIn { path, level_from_body }, pace: Pace::new(config) }
    }

    /// Along a recorded trajectory.
    pub fn recorded(
        config: &MotionConfig,
        trajectory: &TrajectoryConfig,
        body_from_camera: &Isometry3<f64>,
    ) -> Result<Self, TrajectoryError> {
        let trajectory = Trajectory::load(trajectory, body_from_camera)?;
        Ok(Self { curve: Curve::Recorded(trajectory), pace: Pace::new(config) })
    }

    /// Seconds after which a recorded trajectory is at its end; `None` for built-in motions.
    pub fn duration(&self) -> Option<f64> {
        match &self.curve {
            Curve::BuiltIn { .. } => None,
            Curve::Recorded(trajectory) => Some(self.pace.time_of(trajectory.duration())),
        }
    }

    /// Stamp of the recording at the start of the path; `None` for built-in motions.
    pub(super) fn origin(&self) -> Option<Stamp> {
        match &self.curve {
            Curve::BuiltIn { .. } => None,
            Curve::Recorded(trajectory) => Some(trajectory.origin()),
        }
    }

    /// Pose and derivatives at `t` seconds from the start of the log.
    pub fn state(&self, t: f64) -> BodyState {
        let [tau, pace, change] = self.pace.at(t);
        match &self.curve {
            Curve::BuiltIn { path, level_from_body } => {
                path.state(tau, pace, change, level_from_body)
            }
            Curve::Recorded(trajectory) => trajectory.state(tau, pace, change),
        }
    }
}

impl Path {
    /// State at path time `tau` if that passes at `pace` and `change` (its derivative).
    fn state(
        &self,
        tau: f64,
        pace: f64,
        change: f64,
        level_from_body: &UnitQuaternion<f64>,
    ) -> BodyState {
        let [x, y, z] = &self.position;
        let jets = [x.at(tau), y.at(tau), z.at(tau)];
        let derivative = |k: usize| Vector3::from_fn(|i, _| jets[i][k]);
        let (position, first, second) = (derivative(0), derivative(1), derivative(2));
        let (world_from_level, level_rate) = self.attitude(tau);
        let rotation = world_from_level * level_from_body;
        BodyState {
            world_from_body: Isometry3::from_parts(Translation3::from(position), rotation),
            velocity: first * pace,
            acceleration: second * (pace * pace) + first * change,
            angular_velocity: level_from_body.inverse_transform_vector(&(level_rate * pace)),
        }
    }

    /// Attitude of the forward-left-up frame and its angular velocity in that frame.
    fn attitude(&self, tau: f64) -> (UnitQuaternion<f64>, Vector3<f64>) {
        let ([yaw, yaw_rate, _], [pitch, pitch_rate, _], [roll, roll_rate, _]) =
            (self.yaw.at(tau), self.pitch.at(tau), self.roll.at(tau));
        // A turn about +y (left) by a positive angle looks down, hence the sign.
        let (pitch, pitch_rate) = (-pitch, -pitch_rate);
        let rotation = UnitQuaternion::from_euler_angles(roll, pitch, yaw);
        let ((sr, cr), (sp, cp)) = (roll.sin_cos(), pitch.sin_cos());
        let rate = Vector3::new(
            roll_rate - yaw_rate * sp,
            pitch_rate * cr + yaw_rate * cp * sr,
            -pitch_rate * sr + yaw_rate * cp * cr,
        );
        (rotation, rate)
    }
}

/// Camera axes (right, down, forward) in forward-left-up coordinates.
fn level_from_camera() -> UnitQuaternion<f64> {
    let axes = Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0);
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes))
}

/// Path time as a function of log time: zero while at rest, then a rise of the pace whose first
/// four derivatives vanish at both ends, then constant pace.
#[derive(Debug, Clone, Copy)]
struct Pace {
    standstill: f64,
    ramp: f64,
    speed: f64,
}

impl Pace {
    fn new(config: &MotionConfig) -> Self {
        Self { standstill: config.standstill, ramp: config.ramp, speed: config.speed }
    }

    /// When path time `tau`, beyond the ramp, is reached.
    fn time_of(&self, tau: f64) -> f64 {
        self.standstill + 0.5 * self.ramp + tau / self.speed
    }

    fn at(&self, t: f64) -> Jet {
        let since = t - self.standstill;
        if since < 0.0 {
            return [0.0; 3];
        }
        // Without a ramp the motion has its pace from the first instant.
        if since >= self.ramp {
            return [self.speed * (since - 0.5 * self.ramp), self.speed, 0.0];
        }
        // The smoothest step of degree 9, its integral and its derivative.
        let u = since / self.ramp;
        let u4 = u.powi(4);
        let step = u4 * u * (126.0 + u * (-420.0 + u * (540.0 + u * (-315.0 + u * 70.0))));
        let slope = 630.0 * u4 * (1.0 - u).powi(4);
        let integral = u4 * u * u * (21.0 + u * (-60.0 + u * (67.5 + u * (-35.0 + u * 7.0))));
        [self.speed * self.ramp * integral, self.speed * step, self.speed * slope / self.ramp]
    }
}

/// Hand tremor: three incommensurate waves of `amplitude`.
fn shaken(mut signal: Signal, amplitude: f64, rng: &mut ChaCha8Rng) -> Signal {
    for (share, frequency) in [(0.6, 1.13), (0.3, 1.91), (0.15, 3.37)] {
        let phase = rng.random_range(0.0..std::f64::consts::TAU);
        signal = signal.wave(share * amplitude, frequency, phase);
    }
    signal
}

fn path(kind: MotionKind, rng: &mut ChaCha8Rng) -> Path {
    match kind {
        MotionKind::LabSimple | MotionKind::LabLight | MotionKind::LabDynamic => handheld(rng, 1.0),
        MotionKind::LabMotion => quick(rng),
        MotionKind::LabBumper => wheeled(rng),
        MotionKind::Corridor => corridor(rng),
        MotionKind::Hall => hall(rng),
        MotionKind::Circle => circle(),
    }
}

fn handheld(rng: &mut ChaCha8Rng, tremor: f64) -> Path {
    let mut phase = || rng.random_range(0.0..std::f64::consts::TAU);
    let x = Signal::offset(0.0).wave(0.75, 0.071, phase()).wave(0.18, 0.23, phase());
    let y = Signal::offset(0.0).wave(0.7, 0.083, phase()).wave(0.15, 0.29, phase());
    let z = Signal::offset(1.45).wave(0.15, 0.11, phase()).wave(0.05, 0.37, phase());
    let yaw = Signal::offset(phase()).drift(0.22).wave(0.35, 0.09, phase());
    let pitch = Signal::offset(-0.1).wave(0.16, 0.12, phase()).wave(0.05, 0.41, phase());
    let roll = Signal::offset(0.0).wave(0.08, 0.15, phase()).wave(0.03, 0.47, phase());
    Path {
        position: [x, y, z].map(|s| shaken(s, 0.004 * tremor, rng)),
        yaw: shaken(yaw, 0.008 * tremor, rng),
        pitch: shaken(pitch, 0.008 * tremor, rng),
        roll: shaken(roll, 0.008 * tremor, rng),
    }
}

fn quick(rng: &mut ChaCha8Rng) -> Path {
    let mut path = handheld(rng, 3.0);
    let mut phase = || rng.random_range(0.0..std::f64::consts::TAU);
    for axis in &mut path.position {
        *axis = std::mem::take(axis).wave(0.12, 0.53, phase()).wave(0.05, 0.97, phase());
    }
    path.yaw = path.yaw.wave(0.5, 0.31, phase()).wave(0.15, 0.83, phase());
    path.pitch = path.pitch.wave(0.2, 0.43, phase()).wave(0.08, 1.1, phase());
    path.roll = path.roll.wave(0.25, 0.37, phase()).wave(0.08, 0.9, phase());
    path
}

/// A robot on a circle of 1.1 m radius at 0.4 m/s, looking ahead; a bump every few seconds lifts
/// and pitches it.
fn wheeled(rng: &mut ChaCha8Rng) -> Path {
    let (radius, pace) = (1.1, 0.4);
    let start = rng.random_range(0.0..std::f64::consts::TAU);
    let turns = pace / radius / std::f64::consts::TAU;
    let quarter = std::f64::consts::FRAC_PI_2;
    let mut z = Signal::offset(0.45);
    let mut pitch = Signal::offset(0.05);
    let mut time = 2.0;
    while time < 600.0 {
        // Front and rear wheels pass one after the other: nose up, then down, lift in between.
        z.bumps.push([0.018, time, 0.12]);
        z.bumps.push([0.018, time + 0.6, 0.12]);
        pitch.bumps.push([0.07, time, 0.11]);
        pitch.bumps.push([-0.07, time + 0.6, 0.11]);
        time += rng.random_range(1.8..3.5);
    }
    let vibrating = |signal: Signal, rng: &mut ChaCha8Rng| {
        signal.wave(0.0006, 11.0, rng.random_range(0.0..6.0))
    };
    Path {
        position: [
            Signal::offset(0.0).wave(radius, turns, start + quarter),
            Signal::offset(0.0).wave(radius, turns, start),
            vibrating(z, rng),
        ],
        yaw: Signal::offset(start + quarter).drift(pace / radius).wave(0.02, 0.21, 0.0),
        pitch: vibrating(pitch, rng),
        roll: vibrating(Signal::offset(0.0).wave(0.01, 0.7, 0.0), rng),
    }
}

/// Bob and sway of steps at 1.8 Hz.
fn walking(mut path: Path, rng: &mut ChaCha8Rng) -> Path {
    let mut phase = || rng.random_range(0.0..std::f64::consts::TAU);
    let [x, y, z] = path.position;
    path.position = [x.wave(0.008, 0.9, phase()), y.wave(0.02, 0.9, phase()), z];
    path.position[2] = std::mem::take(&mut path.position[2]).wave(0.022, 1.8, phase());
    path.pitch = path.pitch.wave(0.015, 1.8, phase());
    path.roll = path.roll.wave(0.02, 0.9, phase());
    path.yaw = path.yaw.wave(0.03, 0.9, phase()).wave(0.12, 0.17, phase());
    path
}

/// From one end of a 24 m corridor to the other at 1 m/s or less.
fn corridor(rng: &mut ChaCha8Rng) -> Path {
    let path = Path {
        position: [
            Signal::offset(0.0).wave(9.5, 1.0 / 60.0, -std::f64::consts::FRAC_PI_2),
            Signal::offset(0.0).wave(0.2, 0.06, 0.0),
            Signal::offset(1.5),
        ],
        pitch: Signal::offset(-0.08).wave(0.05, 0.1, 0.0),
        ..Path::default()
    };
    walking(path, rng)
}

/// Along a circle of 5 m radius at 1.1 m/s, looking ahead and a little outward.
fn hall(rng: &mut ChaCha8Rng) -> Path {
    let (radius, pace) = (5.0, 1.1);
    let turns = pace / radius / std::f64::consts::TAU;
    let quarter = std::f64::consts::FRAC_PI_2;
    let path = Path {
        position: [
            Signal::offset(0.0).wave(radius, turns, quarter),
            Signal::offset(0.0).wave(radius, turns, 0.0),
            Signal::offset(1.5),
        ],
        yaw: Signal::offset(quarter - 0.4).drift(pace / radius).wave(0.3, 0.07, 0.0),
        pitch: Signal::offset(-0.05).wave(0.08, 0.08, 0.0),
        ..Path::default()
    };
    walking(path, rng)
}

/// W22 gives mean acceleration and angular velocity; a round in 16 s and two waves in it agree
/// with them. The path is raised by 1 m, so that the camera does not touch the floor.
fn circle() -> Path {
    let (radius, turns, waves, lift) = (3.0, 1.0 / 16.0, 1.0 / 8.0, 0.5);
    let quarter = std::f64::consts::FRAC_PI_2;
    // The slope is atan(s cos(phase)), whose Fourier series is in odd powers of r.
    let slope: f64 = lift * waves / (radius * turns);
    let r = ((1.0 + slope * slope).sqrt() - 1.0) / slope;
    let pitch = (0..5).fold(Signal::default(), |pitch, k| {
        let order = f64::from(2 * k + 1);
        let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
        pitch.wave(sign * 2.0 * r.powf(order) / order, order * waves, quarter)
    });
    Path {
        position: [
            Signal::default().wave(radius, turns, quarter),
            Signal::default().wave(radius, turns, 0.0),
            Signal::offset(1.5).wave(lift, waves, 0.0),
        ],
        yaw: Signal::offset(quarter).drift(turns * std::f64::consts::TAU),
        pitch,
        roll: Signal::default(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KINDS: [MotionKind; 6] = [
        MotionKind::Circle,
        MotionKind::LabSimple,
        MotionKind::LabMotion,
        MotionKind::LabBumper,
        MotionKind::Corridor,
        MotionKind::Hall,
    ];

    fn motion(kind: MotionKind) -> Motion {
        let mount = Isometry3::new(Vector3::new(0.1, -0.2, 0.3), Vector3::new(0.4, 1.0, -0.7));
        Motion::built_in(&MotionConfig { kind, ..MotionConfig::default() }, &mount, 5)
    }

    #[test]
    fn derivatives_are_those_of_the_pose() {
        let h = 1e-5;
        for kind in KINDS {
            let motion = motion(kind);
            for k in 0..40 {
                let t = 1.4 + 0.21 * f64::from(k);
                let (before, now, after) =
                    (motion.state(t - h), motion.state(t), motion.state(t + h));
                let step = after.world_from_body.translation.vector
                    - before.world_from_body.translation.vector;
                assert!((step / (2.0 * h) - now.velocity).norm() < 1e-6, "{kind:?} {t}");
                let change = (after.velocity - before.velocity) / (2.0 * h);
                assert!((change - now.acceleration).norm() < 1e-5, "{kind:?} {t}");
                let turn =
                    before.world_from_body.rotation.inverse() * after.world_from_body.rotation;
                let rate = turn.scaled_axis() / (2.0 * h);
                assert!((rate - now.angular_velocity).norm() < 1e-6, "{kind:?} {t}");
            }
        }
    }

    #[test]
    fn the_circle_looks_along_its_path_and_has_the_means_of_the_paper() {
        let config = MotionConfig {
            kind: MotionKind::Circle,
            standstill: 0.0,
            ramp: 0.0,
            ..MotionConfig::default()
        };
        let motion = Motion::built_in(&config, &Isometry3::identity(), 1);
        let (mut acceleration, mut rate) = (0.0, 0.0);
        for k in 0..1600 {
            let state = motion.state(0.01 * f64::from(k) + 1e-3);
            let ahead = state.world_from_body.rotation * Vector3::z();
            assert!(ahead.angle(&state.velocity) < 1e-5);
            acceleration += state.acceleration.norm() / 1600.0;
            rate += state.angular_velocity.norm().to_degrees() / 1600.0;
        }
        assert!((acceleration - 0.51_f64).abs() < 0.01, "{acceleration}");
        assert!((rate - 24.7).abs() < 1.0, "{rate}");
    }

    #[test]
    fn rest_is_rest() {
        let motion = motion(MotionKind::LabMotion);
        let (first, last) = (motion.state(0.0), motion.state(1.5));
        assert_eq!(first.world_from_body, last.world_from_body);
        assert_eq!(last.velocity.norm(), 0.0);
        assert!((last.specific_force(9.81).norm() - 9.81).abs() < 1e-12);
    }

    #[test]
    fn the_camera_starts_upright() {
        let mount = Isometry3::identity();
        let config = MotionConfig { kind: MotionKind::Corridor, ..MotionConfig::default() };
        let camera = Motion::built_in(&config, &mount, 1).state(0.0).world_from_body.rotation;
        let ahead = camera * Vector3::z();
        let down = camera * Vector3::y();
        assert!(ahead.x > 0.9 && down.z < -0.9, "{ahead} {down}");
    }
}
