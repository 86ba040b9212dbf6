//! Rooms full of boxes, and rays through them.

use std::path::PathBuf;

use nalgebra::{Isometry3, Matrix3, UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::texture::{Color, Grain, Material, Picture, Texture, paint};

/// The room and what stands in it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RoomConfig {
    /// Inner length (x), width (y) and height (z), m; enlarged where the path needs more. The
    /// origin is in the middle of the floor.
    pub size: [f64; 3],
    /// Number of pieces of furniture and piles of boxes; fewer where they do not fit.
    pub clutter: usize,
    /// Texture of the surfaces, from 0 (bare) to 1 (busy).
    pub richness: f64,
    /// Edge of a texel of the large surfaces, m; small ones have up to twice the resolution.
    /// Memory grows with its inverse square.
    pub texel: f64,
    /// Free space kept around the path, m.
    pub clearance: f64,
    /// Image files (PNG, JPEG) for posters, screens and printed boxes, as seen from the working
    /// directory; none: invented ones.
    pub images: Vec<PathBuf>,
}

impl Default for RoomConfig {
    fn default() -> Self {
        Self {
            size: [7.0, 6.0, 2.8],
            clutter: 26,
            richness: 0.8,
            texel: 0.005,
            clearance: 0.7,
            images: Vec::new(),
        }
    }
}

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

/// Width of the lens's and the color filter's blur spot, pixels.
const SPOT: f32 = 1.5;

/// Cells of baked light, m.
const LIGHT_CELL: f32 = 0.14;

/// One painted and lit face of a box.
#[derive(Debug)]
pub(super) struct Face {
    texture: Texture,
    /// Received light by cells of [`LIGHT_CELL`], square-root coded; rows along `v`.
    light: Vec<f32>,
    light_columns: usize,
    light_rows: usize,
    /// Offset of the fine grain, m, and its contrast.
    grain_offset: [f32; 2],
    grain_depth: f32,
}

impl Face {
    #[inline]
    fn light_at(&self, u: f32, v: f32) -> f32 {
        let x = (u / LIGHT_CELL - 0.5).clamp(0.0, (self.light_columns - 1) as f32);
        let y = (v / LIGHT_CELL - 0.5).clamp(0.0, (self.light_rows - 1) as f32);
        let (i, j) = (x as usize, y as usize);
        let (fx, fy) = (x - i as f32, y - j as f32);
        let (i1, j1) = ((i + 1).min(self.light_columns - 1), (j + 1).min(self.light_rows - 1));
        let at = |i: usize, j: usize| self.light[j * self.light_columns + i];
        let upper = at(i, j) + (at(i1, j) - at(i, j)) * fx;
        let lower = at(i, j1) + (at(i1, j1) - at(i, j1)) * fx;
        upper + (lower - upper) * fy
    }
}

/// A box, or the room seen from inside.
#[derive(Debug)]
pub(super) struct Solid {
    pub world_from_box: Isometry3<f32>,
    pub half: Vector3<f32>,
    /// Rays see the inner faces.
    pub inside_out: bool,
    /// By axis and sign: `-x +x -y +y -z +z`.
    faces: Vec<Face>,
}

/// A ray seen from one box: constant parts for a whole image.
#[derive(Debug, Clone, Copy)]
pub(super) struct View {
    origin: Vector3<f32>,
    /// Box coordinates of the camera's axes.
    axes: Matrix3<f32>,
}

/// Where a ray meets a box.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Hit {
    /// In lengths of the ray's direction.
    pub distance: f32,
    /// Index of the face, 0 to 5.
    pub face: usize,
}

impl Solid {
    pub fn view(&self, world_from_camera: &Isometry3<f32>) -> View {
        let box_from_camera = self.world_from_box.inv_mul(world_from_camera);
        View {
            origin: box_from_camera.translation.vector,
            axes: box_from_camera.rotation.to_rotation_matrix().into_inner(),
        }
    }

    /// First surface beyond `near` along `direction` (box coordinates).
    #[inline]
    fn hit(&self, origin: &Vector3<f32>, direction: &Vector3<f32>, near: f32) -> Option<Hit> {
        let mut entry = (f32::MIN, 0);
        let mut exit = (f32::MAX, 0);
        for k in 0..3 {
            let d = direction[k];
            let inverse = if d.abs() < 1e-9 { 1e9_f32.copysign(d) } else { 1.0 / d };
            let low = (-self.half[k] - origin[k]) * inverse;
            let high = (self.half[k] - origin[k]) * inverse;
            let (first, last, flip) = if d < 0.0 { (high, low, 1) } else { (low, high, 0) };
            if first > entry.0 {
                entry = (first, 2 * k + flip);
            }
            if last < exit.0 {
                exit = (last, 2 * k + 1 - flip);
            }
        }
        let (distance, face) = if self.inside_out { exit } else { entry };
        (entry.0 < exit.0 && distance > near).then_some(Hit { distance, face })
    }

    #[inline]
    pub fn hit_in_view(&self, view: &View, x: f32, y: f32, near: f32) -> Option<Hit> {
        let direction = view.axes * Vector3::new(x, y, 1.0);
        self.hit(&view.origin, &direction, near)
    }

    /// Color of a hit in a view: `x`, `y` are normalized image coordinates, `pixel` the size of a
    /// pixel in them.
    #[inline]
    pub fn color(
        &self,
        view: &View,
        hit: Hit,
        x: f32,
        y: f32,
        pixel: [f32; 2],
        grain: &Grain,
    ) -> Color {
        let direction = view.axes * Vector3::new(x, y, 1.0);
        let point = view.origin + direction * hit.distance;
        let (axis, u, v) = face_axes(hit.face);
        // The footprint of a pixel on the face: its edges, carried along the face's plane.
        let along = direction[axis];
        let along = if along.abs() < 1e-6 { 1e-6_f32.copysign(along) } else { along };
        let mut edges = [[0.0; 2]; 2];
        for (side, edge) in edges.iter_mut().enumerate() {
            let e = view.axes.column(side) * (SPOT * pixel[side] * hit.distance);
            let slide = e[axis] / along;
            *edge = [e[u] - direction[u] * slide, e[v] - direction[v] * slide];
        }
        let [dx, dy] = edges;
        let (s, t) = (point[u] + self.half[u], point[v] + self.half[v]);
        let face = &self.faces[hit.face];
        let base = face.texture.sample(s, t, dx, dy);
        let mut factor = face.light_at(s, t);
        let spread = (dx[0] * dy[1] - dx[1] * dy[0]).abs().sqrt();
        if spread < Grain::LIMIT {
            let [ds, dt] = face.grain_offset;
            factor *= 1.0 + face.grain_depth * (grain.factor(s + ds, t + dt, spread) - 1.0);
        }
        base.map(|c| c * factor)
    }

    /// Corners in world coordinates.
    pub fn corners(&self) -> [Vector3<f32>; 8] {
        std::array::from_fn(|i| {
            let sign = |bit: usize| if i >> bit & 1 == 1 { 1.0 } else { -1.0 };
            let corner = Vector3::new(sign(0), sign(1), sign(2)).component_mul(&self.half);
            self.world_from_box * nalgebra::Point3::from(corner)
        })
        .map(|p| p.coords)
    }

    /// Cosine between the ray and the normal of the face it hits.
    pub fn incidence(view: &View, hit: Hit, x: f32, y: f32) -> f32 {
        let direction = view.axes * Vector3::new(x, y, 1.0);
        direction[hit.face / 2].abs() / direction.norm()
    }
}

/// Normal axis and the two axes of a face's coordinates; `v` is vertical on upright faces.
fn face_axes(face: usize) -> (usize, usize, usize) {
    match face / 2 {
        0 => (0, 1, 2),
        1 => (1, 0, 2),
        _ => (2, 0, 1),
    }
}

/// Box geometry and materials before painting.
#[derive(Debug, Clone)]
struct Plan {
    center: Vector3<f64>,
    yaw: f64,
    size: Vector3<f64>,
    side: Material,
    top: Material,
    inside_out: bool,
}

/// Everything that the camera can see.
#[derive(Debug)]
pub struct World {
    pub(super) solids: Vec<Solid>,
    pub(super) grain: Grain,
    /// Rounds of the people, whose boxes are the last of `solids`, three each.
    rounds: Vec<Round>,
}

/// An ellipse on the floor, walked around at an even rate.
#[derive(Debug, Clone, Copy)]
struct Round {
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
    fn pose(&self, t: f64) -> Isometry3<f64> {
        let (s, c) = (self.rate * t + self.phase).sin_cos();
        let [long, short] = self.axes;
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), self.heading);
        let place = self.center + turn * Vector3::new(long * c, short * s, 0.0);
        let yaw = self.heading + (short * c).atan2(-long * s);
        let facing = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
        Isometry3::from_parts(place.into(), facing)
    }
}

impl World {
    /// Builds a furnished room that leaves `path` (positions of the sensor, m) free, with
    /// `pictures` on its posters.
    pub fn furnished(
        room: &RoomConfig,
        people: &PeopleConfig,
        path: &[Vector3<f64>],
        pictures: &[Picture],
        seed: u64,
    ) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut plans = vec![shell(room)];
        for _ in 0..room.clutter {
            furnish(&mut plans, room, path, &mut rng);
        }
        let grain = Grain::new(&mut rng);
        // People cast no shadows: light is baked once, without them.
        let bare: Vec<Solid> = plans.iter().map(Plan::solid).collect();
        let rounds: Vec<Round> =
            (0..people.count).filter_map(|_| round(&plans, room, people, path, &mut rng)).collect();
        for round in &rounds {
            plans.extend(person(round));
        }
        let lamps = lamps(room);
        let solids = plans
            .par_iter()
            .enumerate()
            .map(|(index, plan)| {
                let face = |face: usize| {
                    let mut rng = ChaCha8Rng::seed_from_u64(seed);
                    rng.set_stream((6 * index + face) as u64 + 1);
                    finished_face((plan, face), room, pictures, (&bare, &lamps), &mut rng)
                };
                Solid { faces: (0..6).into_par_iter().map(face).collect(), ..plan.solid() }
            })
            .collect();
        Self { solids, grain, rounds }
    }

    /// Moves what moves to where it is at `t` seconds.
    pub(super) fn advance(&mut self, t: f64) {
        let first = self.solids.len() - PERSON.len() * self.rounds.len();
        for (round, parts) in self.rounds.iter().zip(self.solids[first..].chunks_mut(PERSON.len()))
        {
            for (part, (height, size)) in parts.iter_mut().zip(PERSON) {
                let middle = Isometry3::translation(0.0, 0.0, height + 0.5 * size[2]);
                part.world_from_box = (round.pose(t) * middle).cast();
            }
        }
    }
}

/// Legs, trunk and head: height of the lower side and size (ahead, across, up), m.
const PERSON: [(f64, [f64; 3]); 3] =
    [(0.0, [0.24, 0.34, 0.85]), (0.85, [0.28, 0.48, 0.62]), (1.5, [0.2, 0.18, 0.24])];

fn person(round: &Round) -> Vec<Plan> {
    let pose = round.pose(0.0);
    let yaw = pose.rotation.euler_angles().2;
    let part = |(height, size): (f64, [f64; 3])| {
        let middle = Vector3::new(0.0, 0.0, height + 0.5 * size[2]);
        Plan::boxed(pose.translation.vector + middle, yaw, size.into(), Material::Print)
    };
    PERSON.map(part).to_vec()
}

/// A round that touches neither furniture nor the sensor's path, if one is found.
fn round(
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

impl Plan {
    fn solid(&self) -> Solid {
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), self.yaw as f32);
        Solid {
            world_from_box: Isometry3::from_parts(self.center.cast::<f32>().into(), rotation),
            half: (self.size * 0.5).cast(),
            inside_out: self.inside_out,
            faces: Vec::new(),
        }
    }

    fn material(&self, face: usize) -> Material {
        match face {
            5 if self.inside_out => Material::Ceiling,
            4 | 5 => self.top,
            _ => self.side,
        }
    }

    /// Distance from a point to its outline, seen from above; 0 inside.
    fn distance(&self, point: &Vector3<f64>) -> f64 {
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

    fn boxed(center: Vector3<f64>, yaw: f64, size: Vector3<f64>, material: Material) -> Self {
        Self { center, yaw, size, side: material, top: material, inside_out: false }
    }
}

fn shell(room: &RoomConfig) -> Plan {
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
fn furnish(plans: &mut Vec<Plan>, room: &RoomConfig, path: &[Vector3<f64>], rng: &mut ChaCha8Rng) {
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

/// Positions of the lamps: a grid under the ceiling, about one in six square metres.
fn lamps(room: &RoomConfig) -> Vec<Vector3<f32>> {
    let [length, width, height] = room.size;
    let count = |side: f64| (side / 2.5).round().max(1.0) as usize;
    let (nx, ny) = (count(length), count(width));
    let at = |i: usize, n: usize, side: f64| ((i as f64 + 0.5) / n as f64 - 0.5) * side;
    (0..nx * ny)
        .map(|k| Vector3::new(at(k % nx, nx, length), at(k / nx, ny, width), height - 0.02).cast())
        .collect()
}

fn finished_face(
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

#[cfg(test)]
mod tests {
    use parry3d::query::{Ray, RayCast};
    use parry3d::shape::Cuboid;
    use proptest::prelude::*;

    use super::*;

    fn vector(size: f32) -> impl Strategy<Value = Vector3<f32>> {
        [-size..size, -size..size, -size..size].prop_map(Vector3::from)
    }

    proptest! {
        /// The box test of this module, which is made for images, and that of a geometry library.
        #[test]
        fn rays_meet_boxes_where_parry_says(
            half in vector(1.0),
            origin in vector(4.0),
            target in vector(1.2),
        ) {
            let half = half.abs().add_scalar(0.1);
            let direction = target.component_mul(&half) - origin;
            let solid = Solid {
                world_from_box: Isometry3::identity(),
                half,
                inside_out: false,
                faces: Vec::new(),
            };
            let inside = origin.abs() < half;
            let ray = Ray::new(origin.into(), direction.into());
            let expected = Cuboid::new(half.into()).cast_local_ray_and_get_normal(&ray, 1e3, false);
            let solid = Solid { inside_out: inside, ..solid };
            let found = solid.hit(&origin, &direction, 0.0);
            match (found, expected) {
                (Some(hit), Some(expected)) => {
                    let tolerance = 1e-4 * (1.0 + expected.time_of_impact);
                    prop_assert!((hit.distance - expected.time_of_impact).abs() < tolerance);
                }
                (None, None) => {}
                // At an edge rounding decides.
                (found, expected) => {
                    let distance = found.map(|hit| hit.distance);
                    let distance = distance.or(expected.map(|hit| hit.time_of_impact));
                    let place = origin + direction * distance.unwrap_or_default();
                    let beyond = (place.abs() - half).map(f32::abs);
                    let edges = beyond.iter().filter(|x| **x < 1e-3).count();
                    prop_assert!(edges >= 2, "{found:?} {:?}", expected.map(|h| h.time_of_impact));
                }
            }
        }
    }
}
