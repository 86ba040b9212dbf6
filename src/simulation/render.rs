//! The RGB-D camera: rays through the world, then optics, noise and quantization.

use nalgebra::{Isometry3, Vector3};
use rand::RngCore;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use statrs::function::erf::erf_inv;

use super::lens::Lens;
use super::world::{Hit, Solid, View, World};
use crate::sensor::{Camera, ColorImage, DepthImage, PinholeCamera, PixelFormat};
use crate::vision::DepthConfig;

/// The color image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ImageConfig {
    /// Width of the images, pixels.
    pub width: usize,
    /// Height of the images, pixels.
    pub height: usize,
    /// Frames per second.
    pub rate: f64,
    /// Spans without frames: start and length, s.
    pub gaps: Vec<[f64; 2]>,
    /// Factor on the light that reaches the sensor.
    pub exposure: f64,
    /// Standard deviation of the noise of each channel at exposure 1, in steps of 1/255. The
    /// response is a square root, so photon noise is the same in light and shadow.
    pub noise: f64,
    /// Light lost in the corners of the image, as a fraction.
    pub vignetting: f64,
    /// Time over which the shutter is open, centred on the stamp, s; blurs what moves.
    pub shutter: f64,
}

impl Default for ImageConfig {
    fn default() -> Self {
        Self {
            width: 640,
            height: 480,
            rate: 30.0,
            gaps: Vec::new(),
            exposure: 1.2,
            noise: 2.0,
            vignetting: 0.2,
            shutter: 0.004,
        }
    }
}

/// Where the depth sensor returns nothing, besides its range.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DropoutConfig {
    /// Fraction of all pixels.
    pub anywhere: f64,
    /// Fraction of the pixels at edges (`depth.edge_fraction`).
    pub edges: f64,
    /// Surfaces seen at a cosine of incidence below this return nothing.
    pub grazing_cosine: f64,
}

impl Default for DropoutConfig {
    fn default() -> Self {
        Self { anywhere: 0.01, edges: 0.8, grazing_cosine: 0.1 }
    }
}

/// Where the camera is when the shutter opens, and how it moves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shot {
    pub world_from_camera: Isometry3<f64>,
    /// Camera coordinates, m/s.
    pub velocity: Vector3<f64>,
    /// Camera coordinates, rad/s.
    pub angular_velocity: Vector3<f64>,
    /// Seconds from the start; places what moves.
    pub time: f64,
    /// Factor on the light in the room.
    pub light: f64,
    /// Number of the frame; sets the noise.
    pub frame: u64,
}

/// Nothing nearer to the camera is seen, m.
const NEAR: f32 = 0.05;
/// Rows of a band (one task) and columns of a tile (one list of candidates).
const BAND: usize = 16;
const TILE: usize = 16;

/// What one ray met.
#[derive(Debug, Clone, Copy, Default)]
struct Sample {
    color: [f32; 3],
    /// In lengths of the ray's direction.
    distance: f32,
    /// Identifies box and face.
    surface: u32,
    /// Cosine of incidence.
    cosine: f32,
}

/// The world as seen from one pose.
struct Scene<'a> {
    world: &'a World,
    views: Vec<View>,
    bounds: Vec<Bounds>,
    /// No point of a box is nearer than this, in lengths of a ray's direction.
    nearest: Vec<f32>,
    /// Boxes by [`Self::nearest`], the room last.
    order: Vec<usize>,
    lens: &'a Lens,
}

/// Where in the image a box may be seen.
#[derive(Debug, Clone, Copy)]
enum Bounds {
    Nowhere,
    Everywhere,
    /// Left, top, right, bottom, pixels.
    Rectangle([f32; 4]),
    Cone(Cone),
}

/// Directions within an angle of an axis.
#[derive(Debug, Clone, Copy)]
struct Cone {
    /// Unit vector, camera coordinates.
    axis: Vector3<f32>,
    /// Of the angle, which is below 90 degrees.
    cosine: f32,
    sine: f32,
}

impl Cone {
    fn new(axis: Vector3<f32>, cosine: f32) -> Self {
        Self { axis, cosine, sine: (1.0 - cosine * cosine).max(0.0).sqrt() }
    }

    /// Around a box; `None` from within its sphere.
    fn around(solid: &Solid, camera_from_world: &Isometry3<f32>) -> Option<Self> {
        let center = solid.world_from_box.translation.vector.into();
        let center = camera_from_world.transform_point(&center).coords;
        let sine = solid.half.norm() / center.norm();
        (sine < 1.0).then(|| Self::new(center.normalize(), (1.0 - sine * sine).sqrt()))
    }

    fn meets(&self, other: &Self) -> bool {
        let apart = self.cosine * other.cosine - self.sine * other.sine;
        self.axis.dot(&other.axis) >= apart
    }
}

impl Scene<'_> {
    #[inline]
    fn trace(&self, column: f32, row: f32, candidates: &[usize]) -> Sample {
        let Some(ray) = self.lens.ray(column, row) else { return Sample::default() };
        let mut nearest: Option<(usize, Hit)> = None;
        for &index in candidates {
            if nearest.is_some_and(|(_, hit)| hit.distance < self.nearest[index]) {
                continue;
            }
            let hit = self.world.solids[index].hit_in_view(&self.views[index], &ray, NEAR);
            if let Some(hit) = hit.filter(|h| nearest.is_none_or(|(_, n)| h.distance < n.distance))
            {
                nearest = Some((index, hit));
            }
        }
        let Some((index, hit)) = nearest else { return Sample::default() };
        let (solid, view) = (&self.world.solids[index], &self.views[index]);
        Sample {
            color: solid.color(view, hit, &ray, &self.world.grain),
            distance: hit.distance,
            surface: (8 * index + hit.face + 1) as u32,
            cosine: Solid::incidence(view, hit, &ray),
        }
    }

    /// Around what is seen between two corners of the image, a pixel more on each side; `None` if
    /// part of it is not imaged.
    fn cone(&self, left: f32, top: f32, right: f32, bottom: f32) -> Option<Cone> {
        let direction = |x, y| Some(self.lens.ray(x, y)?.direction.normalize());
        let axis = direction(0.5 * (left + right), 0.5 * (top + bottom))?;
        let mut cosine = 1.0_f32;
        for x in [left - 1.0, right + 1.0] {
            for y in [top - 1.0, bottom + 1.0] {
                cosine = cosine.min(axis.dot(&direction(x, y)?));
            }
        }
        (cosine > 0.0).then(|| Cone::new(axis, cosine))
    }

    /// Boxes that may be seen between two corners of the image.
    fn candidates(&self, left: f32, top: f32, right: f32, bottom: f32, list: &mut Vec<usize>) {
        let cone = if self.lens.is_pinhole() { None } else { self.cone(left, top, right, bottom) };
        let is_inside = |index: &usize| match &self.bounds[*index] {
            Bounds::Nowhere => false,
            Bounds::Everywhere => true,
            Bounds::Rectangle(b) => b[0] <= right && b[2] >= left && b[1] <= bottom && b[3] >= top,
            Bounds::Cone(bounds) => cone.is_none_or(|cone| cone.meets(bounds)),
        };
        list.clear();
        list.extend(self.order.iter().copied().filter(is_inside));
    }
}

/// Renders frames of one world with a camera of any model; the same frame number gives the same
/// noise.
pub struct Renderer {
    world: World,
    camera: Camera,
    lens: Lens,
    image: ImageConfig,
    depth: DepthConfig,
    dropout: DropoutConfig,
    noise: ChaCha8Rng,
    quantiles: Vec<f32>,
    samples: Vec<Sample>,
    colors: Vec<[f32; 3]>,
}

impl Renderer {
    pub fn new(
        world: World,
        camera: Camera,
        image: ImageConfig,
        depth: DepthConfig,
        dropout: DropoutConfig,
        seed: u64,
    ) -> Self {
        let pixels = image.width * image.height;
        Self {
            world,
            camera,
            lens: Lens::new(&camera, image.width, image.height),
            image,
            depth,
            dropout,
            noise: ChaCha8Rng::seed_from_u64(seed),
            quantiles: quantiles(),
            samples: vec![Sample::default(); pixels],
            colors: vec![[0.0; 3]; pixels],
        }
    }

    /// Color and depth (mm; `z`, or the range where the camera measures that) of one shot; `None` if
    /// the image is empty.
    pub fn render(&mut self, shot: &Shot) -> Option<(ColorImage, DepthImage)> {
        let (width, height) = (self.image.width, self.image.height);
        self.world.advance(shot.time);
        let mut samples = std::mem::take(&mut self.samples);
        let mut colors = std::mem::take(&mut self.colors);
        let scene = self.scene(&shot.world_from_camera);
        samples.par_chunks_mut(width * BAND).enumerate().for_each(|(band, rows)| {
            trace_band(&scene, band * BAND, width, rows);
        });
        colors.par_chunks_mut(width).enumerate().for_each(|(row, colors)| {
            self.smooth_edges(&scene, &samples, row, colors);
        });
        let mut color = vec![0_u8; 3 * width * height];
        let mut depth = vec![0_u16; width * height];
        color.par_chunks_mut(3 * width).zip(depth.par_chunks_mut(width)).enumerate().for_each(
            |(row, (color, depth))| {
                let mut noise = self.noise.clone();
                noise.set_stream(shot.frame * height as u64 + row as u64);
                let blur = Blur::new(&self.lens, shot, self.image.shutter);
                let film = Film { samples: &samples, colors: &colors, blur, light: shot.light };
                self.expose(&film, row, noise, color, depth);
            },
        );
        drop(scene);
        (self.samples, self.colors) = (samples, colors);
        let color = ColorImage::new(width, height, PixelFormat::Rgb8, color)?;
        Some((color, DepthImage::new(width, height, 0.001, depth)?))
    }

    /// Copies the colors of one row, averaging finely where surfaces meet.
    fn smooth_edges(&self, scene: &Scene, samples: &[Sample], row: usize, colors: &mut [[f32; 3]]) {
        let mut candidates = Vec::new();
        for (column, color) in colors.iter_mut().enumerate() {
            let (sample, around) = self.neighbours(samples, column, row);
            *color = sample.color;
            if around.iter().any(|s| s.surface != sample.surface) {
                let (x, y) = (column as f32, row as f32);
                scene.candidates(x - 1.0, y - 1.0, x + 1.0, y + 1.0, &mut candidates);
                *color = supersampled(scene, x, y, &candidates);
            }
        }
    }

    /// The four samples next to one; at the border, the sample itself.
    #[inline(always)]
    fn neighbours<'a>(
        &self,
        samples: &'a [Sample],
        column: usize,
        row: usize,
    ) -> (&'a Sample, [&'a Sample; 4]) {
        let (width, height) = (self.image.width, self.image.height);
        let at = |x: usize, y: usize| &samples[y * width + x];
        let around = [
            at(column.saturating_sub(1), row),
            at((column + 1).min(width - 1), row),
            at(column, row.saturating_sub(1)),
            at(column, (row + 1).min(height - 1)),
        ];
        (at(column, row), around)
    }

    fn scene(&self, world_from_camera: &Isometry3<f64>) -> Scene<'_> {
        let pose: Isometry3<f32> = world_from_camera.cast();
        let camera_from_world = pose.inverse();
        let views: Vec<View> = self.world.solids.iter().map(|solid| solid.view(&pose)).collect();
        let bounds =
            self.world.solids.iter().map(|solid| self.bounds(solid, &camera_from_world)).collect();
        let nearest = |(solid, view): (&Solid, &View)| match self.lens.is_pinhole() {
            true => nearest_depth(solid, &camera_from_world),
            false => nearest_range(solid, view),
        };
        let nearest: Vec<f32> = self.world.solids.iter().zip(&views).map(nearest).collect();
        let key = |index: &usize| (self.world.solids[*index].inside_out, nearest[*index]);
        let mut order: Vec<usize> = (0..nearest.len()).collect();
        order.sort_by(|a, b| {
            let ((room_a, depth_a), (room_b, depth_b)) = (key(a), key(b));
            room_a.cmp(&room_b).then(depth_a.total_cmp(&depth_b))
        });
        Scene { world: &self.world, views, bounds, nearest, order, lens: &self.lens }
    }

    fn bounds(&self, solid: &Solid, camera_from_world: &Isometry3<f32>) -> Bounds {
        const EMPTY: [f32; 4] = [f32::MAX, f32::MAX, f32::MIN, f32::MIN];
        if solid.inside_out {
            return Bounds::Everywhere;
        }
        if !self.lens.is_pinhole() {
            let cone = Cone::around(solid, camera_from_world);
            return cone.map_or(Bounds::Everywhere, Bounds::Cone);
        }
        let PinholeCamera { fx, fy, cx, cy } = *self.camera.intrinsics();
        let corners = solid.corners().map(|c| camera_from_world * nalgebra::Point3::from(c));
        if corners.iter().all(|c| c.z <= NEAR) {
            return Bounds::Nowhere;
        }
        if corners.iter().any(|c| c.z <= NEAR) {
            return Bounds::Everywhere;
        }
        Bounds::Rectangle(corners.iter().fold(EMPTY, |b, c| {
            let x = c.x / c.z * fx as f32 + cx as f32;
            let y = c.y / c.z * fy as f32 + cy as f32;
            [b[0].min(x - 1.0), b[1].min(y - 1.0), b[2].max(x + 1.0), b[3].max(y + 1.0)]
        }))
    }

    /// Turns one row into pixel values.
    fn expose(
        &self,
        film: &Film,
        row: usize,
        mut noise: ChaCha8Rng,
        color: &mut [u8],
        depth: &mut [u16],
    ) {
        let (width, height) = (self.image.width, self.image.height);
        let gain = ((self.image.exposure * film.light) as f32).sqrt();
        let sd = self.image.noise as f32;
        let middle = [0.5 * (width as f32 - 1.0), 0.5 * (height as f32 - 1.0)];
        let corner = (middle[0] * middle[0] + middle[1] * middle[1]).max(1.0);
        for column in 0..width {
            let (sample, around) = self.neighbours(film.samples, column, row);
            let value = film.blurred(width, height, column, row, sample.distance);
            let (x, y) = (column as f32 - middle[0], row as f32 - middle[1]);
            let light = 1.0 - self.image.vignetting as f32 * (x * x + y * y) / corner;
            let factor = gain * light.max(0.0).sqrt();
            let random = noise.next_u64();
            for (k, value) in value.iter().enumerate() {
                let grain = sd * self.quantile(random >> (12 * k));
                color[3 * column + k] = (value * factor + grain + 0.5).clamp(0.0, 255.0) as u8;
            }
            let truth = self
                .lens
                .ray(column as f32, row as f32)
                .map_or(0.0, |ray| self.lens.depth(&ray, sample.distance));
            depth[column] = self.measured_depth(truth, sample, &around, random >> 36);
        }
    }

    /// Depth in mm of a sample at depth `truth` (m) from 28 random bits; 0 where there is none.
    fn measured_depth(
        &self,
        truth: f32,
        sample: &Sample,
        around: &[&Sample; 4],
        random: u64,
    ) -> u16 {
        let chance = ((random >> 12) & 0xffff) as f64 / 65536.0;
        let step = self.depth.edge_fraction as f32 * sample.distance;
        let edge = around
            .iter()
            .any(|s| s.surface != sample.surface && (s.distance - sample.distance).abs() > step);
        let lost = if edge { self.dropout.edges } else { self.dropout.anywhere };
        if chance < lost || f64::from(sample.cosine) < self.dropout.grazing_cosine {
            return 0;
        }
        let truth = f64::from(truth);
        let sigma = self.depth.standard_deviation(truth);
        let measured = truth + sigma * f64::from(self.quantile(random));
        let usable = measured >= self.depth.min && measured <= self.depth.max;
        // Millimetres; a cast from a float saturates, so a huge range cannot wrap.
        if usable { (measured * 1000.0).round() as u16 } else { 0 }
    }

    /// Standard normal value for the lowest 12 bits.
    fn quantile(&self, random: u64) -> f32 {
        self.quantiles[(random & 0xfff) as usize]
    }
}

/// 4096 equally likely values of the standard normal distribution, scaled to unit variance.
fn quantiles() -> Vec<f32> {
    let raw: Vec<f64> = (0..4096)
        .map(|i| std::f64::consts::SQRT_2 * erf_inv((f64::from(i) + 0.5) / 2048.0 - 1.0))
        .collect();
    let sd = (raw.iter().map(|x| x * x).sum::<f64>() / 4096.0).sqrt();
    raw.into_iter().map(|x| (x / sd) as f32).collect()
}

/// Depth of the nearest corner of a box, less what rounding may make of it.
fn nearest_depth(solid: &Solid, camera_from_world: &Isometry3<f32>) -> f32 {
    const ROUNDING: f32 = 1e-3;
    if solid.inside_out {
        return f32::MIN;
    }
    let depth = |corner| (camera_from_world * nalgebra::Point3::from(corner)).z;
    solid.corners().map(depth).into_iter().fold(f32::MAX, f32::min) - ROUNDING
}

/// Distance of a box, less what rounding may make of it.
fn nearest_range(solid: &Solid, view: &View) -> f32 {
    const ROUNDING: f32 = 1e-3;
    if solid.inside_out { f32::MIN } else { solid.distance(view) - ROUNDING }
}

fn trace_band(scene: &Scene, first_row: usize, width: usize, samples: &mut [Sample]) {
    let rows = samples.len() / width;
    let mut candidates = Vec::new();
    for left in (0..width).step_by(TILE) {
        let right = (left + TILE).min(width);
        let (top, bottom) = (first_row as f32, (first_row + rows) as f32);
        scene.candidates(left as f32, top, right as f32, bottom, &mut candidates);
        for row in 0..rows {
            for column in left..right {
                samples[row * width + column] =
                    scene.trace(column as f32, (first_row + row) as f32, &candidates);
            }
        }
    }
}

/// Mean over the four quarters of a pixel.
fn supersampled(scene: &Scene, x: f32, y: f32, candidates: &[usize]) -> [f32; 3] {
    let mut sum = [0.0_f32; 3];
    for (dx, dy) in [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)] {
        let sample = scene.trace(x + dx, y + dy, candidates);
        sum.iter_mut().zip(sample.color).for_each(|(s, c)| *s += 0.25 * c);
    }
    sum
}

/// Speed of image points, as far as the camera's motion makes it.
#[derive(Debug, Clone, Copy)]
struct Blur<'a> {
    lens: &'a Lens,
    /// Displacement of the camera while the shutter is open, m and rad.
    shift: Vector3<f32>,
    turn: Vector3<f32>,
}

impl<'a> Blur<'a> {
    fn new(lens: &'a Lens, shot: &Shot, shutter: f64) -> Self {
        let scaled = |v: Vector3<f64>| (v * shutter).cast::<f32>();
        Self { lens, shift: scaled(shot.velocity), turn: scaled(shot.angular_velocity) }
    }

    /// How far the point seen at a pixel moves while the shutter is open, pixels.
    fn path(&self, column: f32, row: f32, distance: f32) -> [f32; 2] {
        let Some(ray) = self.lens.ray(column, row) else { return [0.0; 2] };
        let change = -self.shift / distance.max(NEAR) - self.turn.cross(&ray.direction);
        self.lens.motion(&ray, &change)
    }
}

/// The traced image before exposure.
struct Film<'a> {
    samples: &'a [Sample],
    colors: &'a [[f32; 3]],
    blur: Blur<'a>,
    /// Factor on the light in the room.
    light: f64,
}

impl Film<'_> {
    /// Mean color along the path of the point at a pixel.
    fn blurred(&self, width: usize, height: usize, column: usize, row: usize, z: f32) -> [f32; 3] {
        const MAX_TAPS: f32 = 24.0;
        let path = self.blur.path(column as f32, row as f32, z);
        let taps = (path[0] * path[0] + path[1] * path[1]).sqrt().ceil().clamp(1.0, MAX_TAPS);
        if taps == 1.0 {
            return self.colors[row * width + column];
        }
        let mut sum = [0.0_f32; 3];
        for k in 0..taps as usize {
            let along = (k as f32 + 0.5) / taps - 0.5;
            let x = (column as f32 + along * path[0]).round().clamp(0.0, width as f32 - 1.0);
            let y = (row as f32 + along * path[1]).round().clamp(0.0, height as f32 - 1.0);
            let color = self.colors[y as usize * width + x as usize];
            sum.iter_mut().zip(color).for_each(|(s, c)| *s += c / taps);
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::super::world::{PeopleConfig, RoomConfig};
    use super::*;

    /// Coarsely textured, to be quick.
    fn small_room() -> RoomConfig {
        RoomConfig { size: [6.0, 5.0, 2.8], texel: 0.03, ..RoomConfig::default() }
    }

    fn renderer(noise: f64) -> Renderer {
        let room = RoomConfig { clutter: 4, ..small_room() };
        let world = World::furnished(&room, &PeopleConfig::default(), &[Vector3::zeros()], &[], 1);
        let camera = Camera::pinhole(PinholeCamera { fx: 120.0, fy: 120.0, cx: 79.5, cy: 59.5 });
        let image = ImageConfig { width: 160, height: 120, noise, ..ImageConfig::default() };
        Renderer::new(world, camera, image, DepthConfig::default(), DropoutConfig::default(), 7)
    }

    fn looking_ahead(frame: u64) -> Shot {
        let axes = nalgebra::Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0);
        let rotation = nalgebra::Rotation3::from_matrix_unchecked(axes);
        Shot {
            world_from_camera: Isometry3::from_parts(
                Vector3::new(0.0, 0.0, 1.4).into(),
                rotation.into(),
            ),
            velocity: Vector3::zeros(),
            angular_velocity: Vector3::zeros(),
            time: 0.0,
            light: 1.0,
            frame,
        }
    }

    #[test]
    fn frames_do_not_depend_on_the_number_of_threads() {
        let render = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| renderer(2.0).render(&looking_ahead(3)).unwrap())
        };
        assert_eq!(render(1), render(3));
    }

    #[test]
    fn an_empty_room_has_the_depth_of_its_walls() {
        let room = RoomConfig { clutter: 0, ..small_room() };
        let world = World::furnished(&room, &PeopleConfig::default(), &[], &[], 1);
        let mut renderer = Renderer { world, ..renderer(0.0) };
        renderer.dropout = DropoutConfig { anywhere: 0.0, edges: 0.0, grazing_cosine: 0.0 };
        let (_, depth) = renderer.render(&looking_ahead(0)).unwrap();
        // The wall ahead is at 3 m; the pixel 50 rows below the centre sees the floor.
        let ahead = depth.at(80, 60).unwrap();
        let law = DepthConfig::default();
        assert!((f64::from(ahead) - 3.0).abs() < 4.0 * law.standard_deviation(3.0) + 5e-4);
        let truth = 1.4 * 120.0 / (115.0 - 59.5);
        assert!((f64::from(depth.at(80, 115).unwrap()) - truth).abs() < 0.06, "{truth}");
    }

    #[test]
    fn noise_has_the_stated_spread() {
        let (clean, _) = renderer(0.0).render(&looking_ahead(3)).unwrap();
        let (noisy, _) = renderer(3.0).render(&looking_ahead(3)).unwrap();
        let differences: Vec<f64> = clean
            .data()
            .iter()
            .zip(noisy.data())
            .filter(|(c, _)| (20..235).contains(*c))
            .map(|(a, b)| f64::from(*b) - f64::from(*a))
            .collect();
        let n = differences.len() as f64;
        let variance = differences.iter().map(|d| d * d).sum::<f64>() / n;
        assert!(n > 1e4 && (variance.sqrt() - 3.0).abs() < 0.15, "{n} {variance}");
    }
}
