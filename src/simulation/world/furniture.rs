//! The room and what stands in it, as boxes before they are painted.

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::RoomConfig;
use super::solid::Solid;
use crate::simulation::texture::Material;

/// Box geometry and materials before painting.
#[derive(Debug, Clone)]
pub(super) struct Plan {
    pub center: Vector3<f64>,
    yaw: f64,
    pub size: Vector3<f64>,
    side: Material,
    top: Material,
    pub inside_out: bool,
}

impl Plan {
    pub fn solid(&self) -> Solid {
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), self.yaw as f32);
        Solid {
            world_from_box: Isometry3::from_parts(self.center.cast::<f32>().into(), rotation),
            half: (self.size * 0.5).cast(),
            inside_out: self.inside_out,
            faces: Vec::new(),
        }
    }

    pub fn material(&self, face: usize) -> Material {
        match face {
            5 if self.inside_out => Material::Ceiling,
            4 | 5 => self.top,
            _ => self.side,
        }
    }

    /// Distance from a point to its outline, seen from above; 0 inside.
    pub fn distance(&self, point: &Vector3<f64>) -> f64 {
        let offset = point - self.center;
        let (s, c) = self.yaw.sin_cos();
        let along = (c * offset.x + s * offset.y).abs() - 0.5 * self.size.x;
        let across = (c * offset.y - s * offset.x).abs() - 0.5 * self.size.y;
        along.max(0.0).hypot(across.max(0.0))
    }

    /// Radius of the circle around its outline, seen from above.
    fn reach(&self) -> f64 {
        0.5 * self.size.xy().norm()
    }

    pub fn boxed(center: Vector3<f64>, yaw: f64, size: Vector3<f64>, material: Material) -> Self {
        Self { center, yaw, size, side: material, top: material, inside_out: false }
    }
}

pub(super) fn shell(room: &RoomConfig) -> Plan {
    let [length, width, height] = room.size;
    Plan {
        center: Vector3::new(0.0, 0.0, 0.5 * height),
        yaw: 0.0,
        size: Vector3::new(length, width, height),
        side: Material::Wall,
        top: Material::Floor,
        inside_out: true,
    }
}

/// Adds one piece of furniture or pile of boxes, if a free place is found in a few trials.
pub(super) fn furnish(
    plans: &mut Vec<Plan>,
    room: &RoomConfig,
    path: &[Vector3<f64>],
    rng: &mut ChaCha8Rng,
) {
    for _ in 0..30 {
        let piece = piece(room, rng);
        let free = piece.iter().all(|part| {
            let clear = path.iter().all(|p| part.distance(p) > room.clearance);
            let apart = plans.iter().skip(1).all(|other| {
                let gap = (other.center.xy() - part.center.xy()).norm();
                gap > 0.8 * (other.reach() + part.reach())
            });
            clear && apart
        });
        if free {
            plans.extend(piece);
            return;
        }
    }
}

fn piece(room: &RoomConfig, rng: &mut ChaCha8Rng) -> Vec<Plan> {
    let [length, width, _] = room.size;
    let along_wall = rng.random::<f64>() < 0.6;
    if !along_wall {
        let x = rng.random_range(-0.5..0.5) * (length - 1.2);
        let y = rng.random_range(-0.5..0.5) * (width - 1.2);
        return pile(rng, x, y);
    }
    // A place along one of the four walls, as (position, yaw) with the back to the wall.
    let depth = rng.random_range(0.3..0.45);
    let span = rng.random_range(0.6..1.4);
    let wall = rng.random_range(0..4);
    let (run, off) = if wall % 2 == 0 { (length, width) } else { (width, length) };
    let s = rng.random_range(-0.5..0.5) * (run - span - 0.1).max(0.0);
    let t = 0.5 * (off - depth) - 0.02;
    let (x, y, yaw) = match wall {
        0 => (s, t, 0.0),
        1 => (t, s, std::f64::consts::FRAC_PI_2),
        2 => (s, -t, 0.0),
        _ => (-t, s, std::f64::consts::FRAC_PI_2),
    };
    let tall = (rng.random_range(1.2..2.1_f64)).min(room.size[2] - 0.1);
    let place = |height: f64, z: f64, size: Vector3<f64>, material| {
        Plan::boxed(Vector3::new(x, y, z + 0.5 * height), yaw, size, material)
    };
    match rng.random_range(0..3) {
        0 => vec![Plan {
            top: Material::Wood,
            ..place(tall, 0.0, Vector3::new(span, depth, tall), Material::Books)
        }],
        1 => {
            let low = rng.random_range(0.7..1.1);
            let case = place(low, 0.0, Vector3::new(span, depth, low), Material::Wood);
            let height = rng.random_range(0.15..0.4);
            let size = Vector3::new(0.5 * span, 0.7 * depth, height);
            vec![case, place(height, low, size, Material::Carton)]
        }
        _ => {
            // A table with a screen on it.
            let top = 0.74;
            let board = place(0.05, top - 0.05, Vector3::new(span, depth, 0.05), Material::Wood);
            let stand = Vector3::new(0.85 * span, 0.5 * depth, top - 0.05);
            let legs = place(top - 0.05, 0.0, stand, Material::Carton);
            let screen = place(0.34, top, Vector3::new(0.55, 0.06, 0.34), Material::Print);
            vec![board, legs, screen]
        }
    }
}

fn pile(rng: &mut ChaCha8Rng, x: f64, y: f64) -> Vec<Plan> {
    let mut parts = Vec::new();
    let mut z = 0.0;
    let mut side = rng.random_range(0.35..0.7);
    for _ in 0..rng.random_range(1..4) {
        let height = rng.random_range(0.25..0.55);
        let material = match rng.random_range(0..4) {
            0 => Material::Print,
            1 => Material::Wood,
            _ => Material::Carton,
        };
        let size = Vector3::new(side, side * rng.random_range(0.6..1.0), height);
        let yaw = rng.random_range(0.0..std::f64::consts::TAU);
        parts.push(Plan::boxed(Vector3::new(x, y, z + 0.5 * height), yaw, size, material));
        z += height;
        side *= rng.random_range(0.65..0.95);
    }
    parts
}
