//! People who walk about.

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::RoomConfig;
use super::furniture::Plan;
use crate::simulation::texture::Material;

/// People who walk about; each is three boxes on an elongated round.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PeopleConfig {
    /// Number of people; fewer where there is no free round for them.
    pub count: usize,
    /// Mean walking speed, m/s.
    pub speed: f64,
}

impl Default for PeopleConfig {
    fn default() -> Self {
        Self { count: 0, speed: 0.8 }
    }
}

/// An ellipse on the floor, walked around at an even rate.
#[derive(Debug, Clone, Copy)]
pub(super) struct Round {
    center: Vector3<f64>,
    /// Direction of the long axis, rad.
    heading: f64,
    /// Half axes, m.
    axes: [f64; 2],
    /// rad/s and rad.
    rate: f64,
    phase: f64,
}

impl Round {
    /// Pose of the walker's feet, x ahead, at `t` seconds.
    pub fn pose(&self, t: f64) -> Isometry3<f64> {
        let (s, c) = (self.rate * t + self.phase).sin_cos();
        let [long, short] = self.axes;
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), self.heading);
        let place = self.center + turn * Vector3::new(long * c, short * s, 0.0);
        let yaw = self.heading + (short * c).atan2(-long * s);
        let facing = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
        Isometry3::from_parts(place.into(), facing)
    }
}

/// Legs, trunk and head: height of the lower side and size (ahead, across, up), m.
pub(super) const PERSON: [(f64, [f64; 3]); 3] =
    [(0.0, [0.24, 0.34, 0.85]), (0.85, [0.28, 0.48, 0.62]), (1.5, [0.2, 0.18, 0.24])];

pub(super) fn person(round: &Round) -> Vec<Plan> {
    let pose = round.pose(0.0);
    let yaw = pose.rotation.euler_angles().2;
    let part = |(height, size): (f64, [f64; 3])| {
        let middle = Vector3::new(0.0, 0.0, height + 0.5 * size[2]);
        Plan::boxed(pose.translation.vector + middle, yaw, size.into(), Material::Print)
    };
    PERSON.map(part).to_vec()
}

/// A round that touches neither furniture nor the sensor's path, if one is found.
pub(super) fn round(
    plans: &[Plan],
    room: &RoomConfig,
    people: &PeopleConfig,
    path: &[Vector3<f64>],
    rng: &mut ChaCha8Rng,
) -> Option<Round> {
    const BODY: f64 = 0.3;
    let [length, width, _] = room.size;
    let trial = |rng: &mut ChaCha8Rng| {
        let x = rng.random_range(-0.5..0.5) * (length - 1.5);
        let y = rng.random_range(-0.5..0.5) * (width - 1.5);
        let axes = [rng.random_range(0.5..1.8), rng.random_range(0.2..0.4)];
        Round {
            center: Vector3::new(x, y, 0.0),
            heading: rng.random_range(0.0..std::f64::consts::PI),
            axes,
            // The mean speed along a slender ellipse is nearly that along its long axis.
            rate: people.speed * std::f64::consts::TAU / (4.0 * axes[0].hypot(axes[1])),
            phase: rng.random_range(0.0..std::f64::consts::TAU),
        }
    };
    let free = |round: &Round| {
        (0..24).all(|k| {
            let t = f64::from(k) / 24.0 * std::f64::consts::TAU / round.rate.max(1e-6);
            let p = round.pose(t).translation.vector;
            let inside =
                p.x.abs() < 0.5 * length - BODY - 0.1 && p.y.abs() < 0.5 * width - BODY - 0.1;
            let beside = plans.iter().skip(1).all(|plan| plan.distance(&p) > BODY);
            let away = path.iter().all(|q| (q.xy() - p.xy()).norm() > room.clearance + BODY);
            inside && beside && away
        })
    };
    (0..400).map(|_| trial(rng)).find(free)
}
