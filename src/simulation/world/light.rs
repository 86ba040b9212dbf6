//! Light of the lamps, baked into the faces.

use nalgebra::Vector3;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::RoomConfig;
use super::furniture::Plan;
use super::solid::{Face, Solid, face_axes};
use crate::simulation::texture::{Picture, paint};

/// Cells of baked light, m.
pub(super) const LIGHT_CELL: f32 = 0.14;

/// Positions of the lamps: a grid under the ceiling, about one in six square metres.
pub(super) fn lamps(room: &RoomConfig) -> Vec<Vector3<f32>> {
    let [length, width, height] = room.size;
    let count = |side: f64| (side / 2.5).round().max(1.0) as usize;
    let (nx, ny) = (count(length), count(width));
    let at = |i: usize, n: usize, side: f64| ((i as f64 + 0.5) / n as f64 - 0.5) * side;
    (0..nx * ny)
        .map(|k| Vector3::new(at(k % nx, nx, length), at(k / nx, ny, width), height - 0.02).cast())
        .collect()
}

pub(super) fn finished_face(
    (plan, face): (&Plan, usize),
    room: &RoomConfig,
    pictures: &[Picture],
    (scene, lamps): (&[Solid], &[Vector3<f32>]),
    rng: &mut ChaCha8Rng,
) -> Face {
    let (axis, u, v) = face_axes(face);
    let (width, height) = (plan.size[u] as f32, plan.size[v] as f32);
    let (texel, richness) = (room.texel as f32, room.richness as f32);
    let texture = paint(plan.material(face), [width, height], texel, richness, pictures, rng);
    let solid = plan.solid();
    let outward = if face % 2 == 1 { 1.0 } else { -1.0 };
    let sign = if plan.inside_out { -outward } else { outward };
    let mut normal = Vector3::zeros();
    normal[axis] = sign;
    let normal = solid.world_from_box.rotation * normal;
    let light_columns = ((width / LIGHT_CELL).ceil() as usize).max(1);
    let light_rows = ((height / LIGHT_CELL).ceil() as usize).max(1);
    let mut light = Vec::with_capacity(light_columns * light_rows);
    for row in 0..light_rows {
        for column in 0..light_columns {
            let mut point = Vector3::zeros();
            point[axis] = outward * solid.half[axis];
            point[u] = ((column as f32 + 0.5) * LIGHT_CELL).min(width) - solid.half[u];
            point[v] = ((row as f32 + 0.5) * LIGHT_CELL).min(height) - solid.half[v];
            let world = (solid.world_from_box * nalgebra::Point3::from(point)).coords;
            light
                .push(received_light(&(world + normal * 0.004), &normal, scene, lamps, rng).sqrt());
        }
    }
    Face {
        texture,
        light,
        light_columns,
        light_rows,
        grain_offset: [rng.random(), rng.random()],
        grain_depth: plan.material(face).grain_depth(),
    }
}

/// Direct light of the lamps with soft shadows, plus ambient light where the surroundings are open.
fn received_light(
    point: &Vector3<f32>,
    normal: &Vector3<f32>,
    scene: &[Solid],
    lamps: &[Vector3<f32>],
    rng: &mut ChaCha8Rng,
) -> f32 {
    const LAMP_SAMPLES: usize = 3;
    const AMBIENT_SAMPLES: usize = 8;
    let mut direct = 0.0;
    for lamp in lamps {
        for _ in 0..LAMP_SAMPLES {
            let jitter =
                Vector3::new(rng.random_range(-0.4..0.4), rng.random_range(-0.4..0.4), 0.0);
            let ray = lamp + jitter - point;
            let square = ray.norm_squared();
            let cosine = normal.dot(&ray) / square.sqrt();
            let down = ray.z / square.sqrt();
            if cosine > 0.0 && down > 0.0 && !occluded(point, &ray, scene) {
                direct += cosine * (0.3 + 0.7 * down) / (0.6 + square) / LAMP_SAMPLES as f32;
            }
        }
    }
    let mut open = 0.0;
    for _ in 0..AMBIENT_SAMPLES {
        let ray = normal + unit_vector(rng);
        if !occluded(point, &(ray * 0.8), &scene[1..]) {
            open += 1.0 / AMBIENT_SAMPLES as f32;
        }
    }
    (0.1 + 0.2 * open + 2.4 * direct).min(1.6)
}

fn unit_vector(rng: &mut ChaCha8Rng) -> Vector3<f32> {
    let z: f32 = rng.random_range(-1.0..1.0);
    let (s, c) = rng.random_range(0.0..std::f32::consts::TAU).sin_cos();
    let r = (1.0 - z * z).sqrt();
    Vector3::new(r * c, r * s, z)
}

/// Whether a box stands between `point` and `point + ray`; the room itself hides nothing.
fn occluded(point: &Vector3<f32>, ray: &Vector3<f32>, scene: &[Solid]) -> bool {
    let length = ray.norm();
    // Most boxes lie far from the ray.
    let near = |solid: &&Solid| {
        let offset = solid.world_from_box.translation.vector - point;
        let along = (offset.dot(ray) / length).clamp(0.0, length);
        (offset - ray * (along / length)).norm_squared() <= solid.half.norm_squared()
    };
    scene.iter().filter(|solid| !solid.inside_out).filter(near).any(|solid| {
        let origin = solid.world_from_box.inverse_transform_point(&(*point).into()).coords;
        let direction = solid.world_from_box.inverse_transform_vector(ray);
        solid.hit(&origin, &direction, 0.0).is_some_and(|hit| hit.distance < 1.0)
    })
}
