//! Procedural surfaces, painted once and read through mip maps.
//!
//! Patterns follow the "dead leaves" model of natural images (Lee, Mumford and Huang, 2001):
//! opaque shapes whose sizes obey a cubic power law, so that there are corners and edges at every
//! scale and no repetition. Colors are coded by their square root (gamma 2): light then still
//! multiplies, and photon noise has the same spread everywhere.

use std::path::Path;

use rand::Rng;
use rand_chacha::ChaCha8Rng;

/// Red, green, blue in gamma-2 coding, 0 to 255.
pub type Color = [f32; 3];

/// A painted rectangle with its mip levels; coordinates in metres from the first texel's corner.
#[derive(Debug, Clone)]
pub struct Texture {
    levels: Vec<Level>,
    /// Edge of a texel of the finest level, m.
    texel: f32,
}

#[derive(Debug, Clone)]
struct Level {
    width: usize,
    height: usize,
    texels: Vec<[u8; 4]>,
}

impl Level {
    fn halved(&self) -> Self {
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let mut texels = Vec::with_capacity(width * height);
        for row in 0..height {
            for column in 0..width {
                let mut sum = [2_u16; 4];
                for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                    let x = (2 * column + dx).min(self.width - 1);
                    let y = (2 * row + dy).min(self.height - 1);
                    let texel = self.texels[y * self.width + x];
                    sum.iter_mut().zip(texel).for_each(|(s, t)| *s += u16::from(t));
                }
                texels.push(sum.map(|s| (s / 4) as u8));
            }
        }
        Self { width, height, texels }
    }

    /// Bilinear value at texel coordinates (0 is the centre of the first texel), in steps of
    /// 1/256 of a texel. Integers, two channels to a word: this is where rendering spends its
    /// time.
    #[inline(always)]
    fn bilinear(&self, x: f32, y: f32) -> [f32; 3] {
        let (x, y) = ((x * 256.0) as i32, (y * 256.0) as i32);
        let (fx, fy) = ((x & 255) as u32, (y & 255) as u32);
        let (column, row) = (x >> 8, y >> 8);
        let index = |i: i32, len: usize| i.clamp(0, len as i32 - 1) as usize;
        let (x0, x1) = (index(column, self.width), index(column + 1, self.width));
        let (y0, y1) = (index(row, self.height), index(row + 1, self.height));
        let (upper, lower) = (&self.texels[y0 * self.width..], &self.texels[y1 * self.width..]);
        let ((rb0, g0), (rb1, g1)) = (line(upper, (x0, x1), fx), line(lower, (x0, x1), fx));
        let mix = |a: u32, b: u32| ((a & 0xffff) * (256 - fy) + (b & 0xffff) * fy) as f32;
        [mix(rb0, rb1), mix(g0, g1), mix(rb0 >> 16, rb1 >> 16)].map(|c| c / 65536.0)
    }
}

/// Between two texels of a row: red and blue, then green, in the halves of a word and weighted by
/// 256. Inlined by force, as what follows: calls would cost more than the arithmetic.
#[inline(always)]
fn line(row: &[[u8; 4]], (x0, x1): (usize, usize), fx: u32) -> (u32, u32) {
    const PAIR: u32 = 0x00ff_00ff;
    let (a, b) = (u32::from_le_bytes(row[x0]), u32::from_le_bytes(row[x1]));
    let pair = |a: u32, b: u32| (a & PAIR) * (256 - fx) + (b & PAIR) * fx;
    (pair(a, b), pair(a >> 8, b >> 8))
}

/// The level for a footprint of `ratio` texels, and the weight of the next coarser one.
#[inline(always)]
fn mip(ratio: f32, coarsest: usize) -> (usize, f32) {
    // Exponent and mantissa of the ratio are a good enough logarithm.
    let bits = ratio.max(1.0).to_bits();
    let fine = (bits >> 23) as usize - 127;
    // Blending only halfway between levels saves half of the second look-ups unseen.
    let blend = (2.0 * (bits & 0x7f_ffff) as f32 / 8_388_608.0 - 0.5).clamp(0.0, 1.0);
    let (level, blend) = if blend == 1.0 { (fine + 1, 0.0) } else { (fine, blend) };
    if level >= coarsest { (coarsest, 0.0) } else { (level, blend) }
}

impl Texture {
    /// The mean over the parallelogram spanned by `dx` and `dy` (m) around `(u, v)` (m), by up to
    /// three trilinear samples along its longer side.
    #[inline]
    pub fn sample(&self, u: f32, v: f32, dx: [f32; 2], dy: [f32; 2]) -> Color {
        const MAX_RATIO: f32 = 4.0;
        let length = |e: [f32; 2]| (e[0] * e[0] + e[1] * e[1]).sqrt();
        let (lx, ly) = (length(dx), length(dy));
        let (long, short) = (lx.max(ly), lx.min(ly));
        let axis = if lx > ly { dx } else { dy };
        let width = short.max(long / MAX_RATIO).max(1e-6);
        // Bilinear kernels overlap: three samples cover a footprint four times as long as wide.
        let samples = ((0.75 * long / width + 0.5) as usize).max(1);
        let step = 1.0 / samples as f32;
        let mut sum = [0.0_f32; 3];
        for i in 0..samples {
            let along = (i as f32 + 0.5) * step - 0.5;
            let value = self.trilinear(u + along * axis[0], v + along * axis[1], width);
            sum.iter_mut().zip(value).for_each(|(s, x)| *s += x * step);
        }
        sum
    }

    /// Value for a square footprint of `width` m, between the two nearest levels.
    #[inline(always)]
    fn trilinear(&self, u: f32, v: f32, width: f32) -> Color {
        let (level, blend) = mip(width / self.texel, self.levels.len() - 1);
        let a = self.bilinear(level, u, v);
        if blend == 0.0 {
            return a;
        }
        let b = self.bilinear(level + 1, u, v);
        std::array::from_fn(|k| a[k] + (b[k] - a[k]) * blend)
    }

    #[inline(always)]
    fn bilinear(&self, level: usize, u: f32, v: f32) -> Color {
        let scale = 1.0 / (self.texel * (1_u32 << level) as f32);
        self.levels[level].bilinear(u * scale - 0.5, v * scale - 0.5)
    }
}

/// A grey pattern of 2 cm shapes and below that wraps around; laid over the larger textures it
/// gives close views something to see.
#[derive(Debug, Clone)]
pub struct Grain {
    /// Squares of [`Self::SIDE`] texels, half of it, ...
    levels: Vec<Vec<u8>>,
}

impl Grain {
    /// Footprints above this see nothing of it, m.
    pub const LIMIT: f32 = 0.01;

    /// A power of two, so that wrapping around is a mask: a remainder would cost more than the rest
    /// of a look-up.
    const SIDE: usize = 512;
    /// Edge of a texel of the finest level, m.
    const TEXEL: f32 = 0.0006;

    pub fn new(rng: &mut ChaCha8Rng) -> Self {
        let mut canvas = Canvas::new(Self::SIDE, Self::SIDE, Self::TEXEL, [128.0; 3]);
        let side = canvas.width();
        for _ in 0..6000 {
            let radius = power_law_radius(rng, 0.0008, 0.02);
            let tone = 128.0 + rng.random_range(-70.0..70.0);
            let (x, y) = (rng.random_range(0.0..side), rng.random_range(0.0..side));
            let shape = Shape::random(rng);
            // Painted once more across each border, so that the pattern has no seam.
            for ox in [-side, 0.0, side] {
                for oy in [-side, 0.0, side] {
                    canvas.shape(shape, [x + ox, y + oy], radius, [tone; 3], 0.8);
                }
            }
        }
        let greys: Vec<f32> = canvas.texels.iter().map(|texel| f32::from(texel[0])).collect();
        let mean = greys.iter().sum::<f32>() / greys.len() as f32;
        let mut level: Vec<u8> =
            greys.iter().map(|grey| (grey - mean + 128.0).clamp(0.0, 255.0) as u8).collect();
        let mut levels = Vec::new();
        while level.len() > 1 {
            let next = Self::halved(&level);
            levels.push(std::mem::replace(&mut level, next));
        }
        levels.push(level);
        Self { levels }
    }

    fn halved(level: &[u8]) -> Vec<u8> {
        let side = level.len().isqrt();
        let at = |x: usize, y: usize| u16::from(level[y * side + x]);
        let mean = |x: usize, y: usize| {
            ((at(x, y) + at(x + 1, y) + at(x, y + 1) + at(x + 1, y + 1) + 2) / 4) as u8
        };
        let corners = (0..side).step_by(2);
        corners.clone().flat_map(|y| corners.clone().map(move |x| mean(x, y))).collect()
    }

    /// Factor on the brightness, 1 in the mean, for a square footprint of `width` m around
    /// coordinates in m.
    #[inline]
    pub fn factor(&self, u: f32, v: f32, width: f32) -> f32 {
        let (level, blend) = mip(width / Self::TEXEL, self.levels.len() - 1);
        let mut grey = self.bilinear(level, u, v);
        if blend > 0.0 {
            grey += (self.bilinear(level + 1, u, v) - grey) * blend;
        }
        grey / 128.0
    }

    /// As [`Level::bilinear`], but grey and wrapping around.
    #[inline(always)]
    fn bilinear(&self, level: usize, u: f32, v: f32) -> f32 {
        let (texels, side) = (&self.levels[level], Self::SIDE >> level);
        let scale = 256.0 / (Self::TEXEL * (1_u32 << level) as f32);
        let (x, y) = ((u * scale - 128.0) as i32, (v * scale - 128.0) as i32);
        let (fx, fy) = ((x & 255) as u32, (y & 255) as u32);
        let index = |i: i32| (i as usize) & (side - 1);
        let (x0, x1) = (index(x >> 8), index((x >> 8) + 1));
        let (y0, y1) = (index(y >> 8) * side, index((y >> 8) + 1) * side);
        let line =
            |y: usize| u32::from(texels[y + x0]) * (256 - fx) + u32::from(texels[y + x1]) * fx;
        (line(y0) * (256 - fy) + line(y1) * fy) as f32 / 65536.0
    }
}

/// Radius with density proportional to `r^-3` between two limits.
fn power_law_radius(rng: &mut ChaCha8Rng, min: f32, max: f32) -> f32 {
    let (a, b) = (min.powi(-2), max.powi(-2));
    (a + rng.random::<f32>() * (b - a)).powf(-0.5)
}

#[derive(Debug, Clone, Copy)]
enum Shape {
    Disc,
    /// Outward normals of the sides.
    Triangle([[f32; 2]; 3]),
    /// Direction of the long side; ratio of the sides.
    Rectangle {
        along: [f32; 2],
        aspect: f32,
    },
}

impl Shape {
    fn random(rng: &mut ChaCha8Rng) -> Self {
        const THIRD: f32 = std::f32::consts::TAU / 3.0;
        let angle = rng.random_range(0.0..std::f32::consts::TAU);
        let direction = |turn: f32| {
            let (s, c) = (angle + turn).sin_cos();
            [c, s]
        };
        match rng.random_range(0..4) {
            0 => Self::Disc,
            1 => Self::Triangle([0.0, THIRD, 2.0 * THIRD].map(direction)),
            _ => Self::Rectangle { along: direction(0.0), aspect: rng.random_range(0.25..1.0) },
        }
    }

    /// Signed distance (approximate outside of corners) to a shape of circumradius `radius`.
    fn distance(&self, x: f32, y: f32, radius: f32) -> f32 {
        match self {
            Self::Disc => (x * x + y * y).sqrt() - radius,
            Self::Triangle(normals) => {
                let farthest = normals.iter().map(|n| n[0] * x + n[1] * y).fold(f32::MIN, f32::max);
                farthest - 0.5 * radius
            }
            Self::Rectangle { along: [c, s], aspect } => {
                let (along, across) = (c * x + s * y, c * y - s * x);
                (along.abs() - radius).max(across.abs() - aspect * radius)
            }
        }
    }
}

/// A rectangle on a canvas, m.
#[derive(Debug, Clone, Copy)]
struct Area {
    x: f32,
    y: f32,
    width: f32,
    height: f32,
}

impl Area {
    fn inset(self, margin: f32) -> Self {
        Self {
            x: self.x + margin,
            y: self.y + margin,
            width: (self.width - 2.0 * margin).max(0.0),
            height: (self.height - 2.0 * margin).max(0.0),
        }
    }
}

/// An image file that hangs on walls and clothes boxes. Its coding is near enough to gamma 2.
#[derive(Debug, Clone)]
pub struct Picture {
    width: usize,
    height: usize,
    pixels: Vec<[u8; 3]>,
}

impl Picture {
    /// Reads a PNG or JPEG file.
    pub fn load(path: &Path) -> image::ImageResult<Self> {
        let image = image::ImageReader::open(path)?.with_guessed_format()?.decode()?.into_rgb8();
        let (width, height) = (image.width() as usize, image.height() as usize);
        let pixels = image.pixels().map(|pixel| pixel.0).collect();
        Ok(Self { width, height, pixels })
    }

    /// Mean color of the part between two corners, in fractions of width and height.
    fn mean(&self, [left, top]: [f32; 2], [right, bottom]: [f32; 2]) -> Color {
        let range = |from: f32, to: f32, count: usize| {
            let first = ((from * count as f32) as usize).min(count - 1);
            first..((to * count as f32).ceil() as usize).clamp(first + 1, count)
        };
        let (mut sum, mut number) = ([0.0_f32; 3], 0.0);
        for row in range(top, bottom, self.height) {
            for column in range(left, right, self.width) {
                let pixel = self.pixels[row * self.width + column];
                sum.iter_mut().zip(pixel).for_each(|(s, p)| *s += f32::from(p));
                number += 1.0;
            }
        }
        sum.map(|s| s / number)
    }
}

/// Where a surface is painted before its mip levels are made. Rows run along increasing `v`.
struct Canvas<'a> {
    columns: usize,
    rows: usize,
    texel: f32,
    texels: Vec<[u8; 4]>,
    clip: Area,
    pictures: &'a [Picture],
}

impl<'a> Canvas<'a> {
    fn new(columns: usize, rows: usize, texel: f32, color: Color) -> Self {
        let clip =
            Area { x: 0.0, y: 0.0, width: columns as f32 * texel, height: rows as f32 * texel };
        let texels = vec![pack(color); columns * rows];
        Self { columns, rows, texel, texels, clip, pictures: &[] }
    }

    fn width(&self) -> f32 {
        self.columns as f32 * self.texel
    }

    fn height(&self) -> f32 {
        self.rows as f32 * self.texel
    }

    fn whole(&self) -> Area {
        Area { x: 0.0, y: 0.0, width: self.width(), height: self.height() }
    }

    fn finish(self) -> Texture {
        let first = Level { width: self.columns, height: self.rows, texels: self.texels };
        let mut levels = vec![first];
        while let Some(last) = levels.last().filter(|l| l.width > 1 || l.height > 1) {
            let next = last.halved();
            levels.push(next);
        }
        Texture { levels, texel: self.texel }
    }

    /// Blends `color` in where `distance` (m, relative to `center`) is negative, with soft edges.
    fn fill(
        &mut self,
        center: [f32; 2],
        reach: [f32; 2],
        color: Color,
        opacity: f32,
        distance: impl Fn(f32, f32) -> f32,
    ) {
        let per_metre = 1.0 / self.texel;
        let range = |center: f32, reach: f32, low: f32, size: f32, count: usize| {
            let first = (center - reach).max(low) * per_metre;
            let last = (center + reach).min(low + size) * per_metre;
            (first.floor().max(0.0) as usize, (last.ceil().max(0.0) as usize).min(count))
        };
        let packed = pack(color);
        let clip = self.clip;
        let (x0, x1) = range(center[0], reach[0] + self.texel, clip.x, clip.width, self.columns);
        let (y0, y1) = range(center[1], reach[1] + self.texel, clip.y, clip.height, self.rows);
        for row in y0..y1 {
            let y = (row as f32 + 0.5) * self.texel - center[1];
            for column in x0..x1 {
                let x = (column as f32 + 0.5) * self.texel - center[0];
                let alpha = opacity * (0.5 - distance(x, y) * per_metre).clamp(0.0, 1.0);
                let texel = &mut self.texels[row * self.columns + column];
                if alpha >= 1.0 {
                    *texel = packed;
                } else if alpha > 0.0 {
                    blend(texel, color, alpha);
                }
            }
        }
    }

    /// Fills an area with the largest part of a picture that has its proportions.
    fn hang(&mut self, picture: &Picture, area: Area) {
        let aspect = (area.width / area.height) * picture.height as f32 / picture.width as f32;
        let part = [aspect.min(1.0), (1.0 / aspect).min(1.0)];
        let margin = part.map(|p| 0.5 * (1.0 - p));
        let cell = |start: f32, count: usize| {
            let first = (start / self.texel).round().max(0.0) as usize;
            first.min(count)
        };
        let (x0, x1) = (cell(area.x, self.columns), cell(area.x + area.width, self.columns));
        let (y0, y1) = (cell(area.y, self.rows), cell(area.y + area.height, self.rows));
        let at = |k: usize, axis: usize, count: usize| {
            margin[axis] + part[axis] * k as f32 / count as f32
        };
        for row in y0..y1 {
            // Rows of a canvas run upwards, those of a picture downwards.
            let down = y1 - 1 - row;
            for column in x0..x1 {
                let right = column - x0;
                let corner = [at(right, 0, x1 - x0), at(down, 1, y1 - y0)];
                let opposite = [at(right + 1, 0, x1 - x0), at(down + 1, 1, y1 - y0)];
                self.texels[row * self.columns + column] = pack(picture.mean(corner, opposite));
            }
        }
    }

    fn shape(&mut self, shape: Shape, center: [f32; 2], radius: f32, color: Color, opacity: f32) {
        let reach = radius * std::f32::consts::SQRT_2;
        self.fill(center, [reach; 2], color, opacity, |x, y| shape.distance(x, y, radius));
    }

    fn area(&mut self, area: Area, color: Color, opacity: f32) {
        let half = [area.width / 2.0, area.height / 2.0];
        let center = [area.x + half[0], area.y + half[1]];
        let distance = |x: f32, y: f32| (x.abs() - half[0]).max(y.abs() - half[1]);
        self.fill(center, half, color, opacity, distance);
    }

    /// A straight stroke.
    fn stroke(&mut self, from: [f32; 2], to: [f32; 2], thickness: f32, color: Color) {
        let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
        let length = dx.hypot(dy).max(1e-6);
        let (c, s) = (dx / length, dy / length);
        let center = [(from[0] + to[0]) / 2.0, (from[1] + to[1]) / 2.0];
        let reach = [dx.abs() / 2.0 + thickness, dy.abs() / 2.0 + thickness];
        self.fill(center, reach, color, 1.0, |x, y| {
            let (along, across) = (c * x + s * y, c * y - s * x);
            (along.abs() - length / 2.0).max(across.abs() - thickness / 2.0)
        });
    }

    /// Dead leaves over `area` until they would cover it `coverage` times.
    fn leaves(&mut self, rng: &mut ChaCha8Rng, area: Area, leaves: &Leaves) {
        let whole = self.clip;
        self.clip = area;
        let (min, max) = (leaves.min_radius, leaves.max_radius.min(area.width.max(area.height)));
        if max > min {
            let mean_square = 2.0 * (max / min).ln() / (min.powi(-2) - max.powi(-2));
            let covered = leaves.coverage * area.width * area.height;
            for _ in 0..(covered / (1.6 * mean_square)) as usize {
                let center = [
                    area.x + rng.random::<f32>() * area.width,
                    area.y + rng.random::<f32>() * area.height,
                ];
                let radius = power_law_radius(rng, min, max);
                let color = leaves.palette.pick(rng);
                self.shape(Shape::random(rng), center, radius, color, leaves.opacity);
            }
        }
        self.clip = whole;
    }

    /// Lines of strokes that look like print from afar.
    fn print(&mut self, rng: &mut ChaCha8Rng, area: Area, height: f32, color: Color) {
        let (advance, leading) = (0.75 * height, 1.6 * height);
        let lines = (area.height / leading) as usize;
        let columns = (area.width / advance) as usize;
        for line in 0..lines {
            let end = columns - (rng.random::<f32>() * 0.3 * columns as f32) as usize;
            for column in 0..end {
                if rng.random::<f32>() < 0.16 {
                    continue;
                }
                let x = area.x + column as f32 * advance;
                let y = area.y + line as f32 * leading;
                for _ in 0..3 {
                    let mut node = || {
                        let (i, j) = (rng.random_range(0..3), rng.random_range(0..3));
                        [x + 0.25 * height * i as f32, y + 0.5 * height * j as f32]
                    };
                    let (from, to) = (node(), node());
                    self.stroke(from, to, 0.16 * height, color);
                }
            }
        }
    }

    /// Multiplies by fractal value noise: four octaves of period `period`, half of it, ... (m),
    /// each weaker by 0.7; `stretch` lengthens it along `u`.
    fn grain(&mut self, rng: &mut ChaCha8Rng, period: f32, stretch: f32, amplitude: f32) {
        let mut factors = vec![0.0_f32; self.texels.len()];
        let (mut period, mut weight) = ((period / self.texel).max(1.5), amplitude);
        for _ in 0..4 {
            let (px, py) = (period * stretch, period);
            let columns = (self.columns as f32 / px) as usize + 2;
            let rows = (self.rows as f32 / py) as usize + 2;
            let lattice: Vec<f32> =
                (0..columns * rows).map(|_| rng.random_range(-weight..weight)).collect();
            for row in 0..self.rows {
                let y = row as f32 / py;
                let (j, fy) = (y as usize, smooth(y.fract()));
                let (upper, lower) = (&lattice[j * columns..], &lattice[(j + 1) * columns..]);
                let line = &mut factors[row * self.columns..(row + 1) * self.columns];
                for (column, factor) in line.iter_mut().enumerate() {
                    let x = column as f32 / px;
                    let (i, fx) = (x as usize, smooth(x.fract()));
                    let a = upper[i] + (upper[i + 1] - upper[i]) * fx;
                    let b = lower[i] + (lower[i + 1] - lower[i]) * fx;
                    *factor += a + (b - a) * fy;
                }
            }
            period = (period / 2.0).max(1.5);
            weight *= 0.7;
        }
        for (texel, factor) in self.texels.iter_mut().zip(factors) {
            *texel = texel.map(|t| (f32::from(t) * (1.0 + factor) + 0.5).clamp(0.0, 255.0) as u8);
        }
    }
}

fn smooth(x: f32) -> f32 {
    x * x * (3.0 - 2.0 * x)
}

fn pack(color: Color) -> [u8; 4] {
    let [r, g, b] = color.map(|c| c.clamp(0.0, 255.0) as u8);
    [r, g, b, 0]
}

fn blend(texel: &mut [u8; 4], color: Color, alpha: f32) {
    for (t, c) in texel.iter_mut().zip(color) {
        let value = f32::from(*t);
        *t = (value + (c - value) * alpha + 0.5).clamp(0.0, 255.0) as u8;
    }
}

/// A few colors that go together.
struct Palette(Vec<Color>);

impl Palette {
    /// `count` colors around one hue whose lightness spans `dark` to `light`.
    fn around(rng: &mut ChaCha8Rng, count: usize, dark: f32, light: f32) -> Self {
        let hue = rng.random::<f32>();
        let colors = (0..count.max(2)).map(|i| {
            let value = dark + (light - dark) * i as f32 / (count.max(2) - 1) as f32;
            let shift = rng.random_range(-0.15..0.15) + if i % 3 == 2 { 0.5 } else { 0.0 };
            from_hsv(hue + shift, rng.random_range(0.1..0.6), value)
        });
        Self(colors.collect())
    }

    fn pick(&self, rng: &mut ChaCha8Rng) -> Color {
        let color = self.0[rng.random_range(0..self.0.len())];
        let shade = rng.random_range(-18.0..18.0);
        color.map(|c| c + shade)
    }
}

/// Hue in turns, saturation 0 to 1, value 0 to 255.
fn from_hsv(hue: f32, saturation: f32, value: f32) -> Color {
    [0.0, 2.0 / 3.0, 1.0 / 3.0].map(|offset| {
        let ramp = ((hue + offset).rem_euclid(1.0) * 6.0 - 3.0).abs() - 1.0;
        value * (1.0 - saturation + saturation * ramp.clamp(0.0, 1.0))
    })
}

/// Size range (m), amount and look of dead leaves.
struct Leaves {
    min_radius: f32,
    max_radius: f32,
    /// Painted area per canvas area.
    coverage: f32,
    opacity: f32,
    palette: Palette,
}

/// What a face is made of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Material {
    /// Painted plaster with posters, notices and pictures.
    Wall,
    /// Suspended panels with lamps.
    Ceiling,
    /// Planks with rugs and stains.
    Floor,
    /// Cardboard with tape, labels and print.
    Carton,
    /// Grained wood, with drawers.
    Wood,
    /// Rows of book spines.
    Books,
    /// A busy print: cloth, pictures, screens.
    Print,
}

impl Material {
    /// Contrast of the fine grain laid over it, 0 to 1.
    pub fn grain_depth(self) -> f32 {
        match self {
            Self::Wall | Self::Ceiling => 0.12,
            Self::Books | Self::Print => 0.2,
            Self::Floor | Self::Carton | Self::Wood => 0.3,
        }
    }
}

/// Paints one face of `width` by `height` metres; `richness` from 0 (bare) to 1 (busy); pictures
/// are invented where none are given. Texels of
/// large faces have an edge of `texel` m (more beyond 16 million of them), those of small ones down
/// to half of it.
pub fn paint(
    material: Material,
    [width, height]: [f32; 2],
    texel: f32,
    richness: f32,
    pictures: &[Picture],
    rng: &mut ChaCha8Rng,
) -> Texture {
    const MAX_TEXELS: f32 = 16e6;
    let side = (width * height).sqrt();
    let texel = (side / 700.0).clamp(0.5 * texel, texel).max(side / MAX_TEXELS.sqrt());
    let columns = (width / texel).ceil().max(1.0) as usize;
    let rows = (height / texel).ceil().max(1.0) as usize;
    let mut canvas = Canvas { pictures, ..Canvas::new(columns, rows, texel, [128.0; 3]) };
    match material {
        Material::Wall => wall(&mut canvas, rng, richness),
        Material::Ceiling => ceiling(&mut canvas, rng),
        Material::Floor => floor(&mut canvas, rng, richness),
        Material::Carton => carton(&mut canvas, rng, richness),
        Material::Wood => wood(&mut canvas, rng, richness),
        Material::Books => books(&mut canvas, rng),
        Material::Print => {
            let whole = canvas.whole();
            picture(&mut canvas, rng, whole);
        }
    }
    canvas.finish()
}

fn wall(canvas: &mut Canvas, rng: &mut ChaCha8Rng, richness: f32) {
    let whole = canvas.whole();
    let tint = from_hsv(rng.random(), rng.random_range(0.03..0.2), rng.random_range(165.0..225.0));
    canvas.area(whole, tint, 1.0);
    let marks = Leaves {
        min_radius: 0.006,
        max_radius: 0.35,
        coverage: 0.35 * richness,
        opacity: 0.16,
        palette: Palette::around(rng, 5, 60.0, 240.0),
    };
    canvas.leaves(rng, whole, &marks);
    canvas.grain(rng, 0.8, 1.0, 0.05);
    if whole.width > 2.0 && whole.height > 2.2 {
        door(canvas, rng);
        window(canvas, rng);
    }
    let hung = (richness * 1.8 * whole.width * whole.height) as usize;
    for _ in 0..hung {
        let w = power_law_radius(rng, 0.18, 1.3).min(0.7 * whole.width);
        let h = (w * rng.random_range(0.6..1.5)).min(0.7 * whole.height);
        let area = Area {
            x: rng.random::<f32>() * (whole.width - w),
            y: rng.random::<f32>() * (whole.height - h),
            width: w,
            height: h,
        };
        canvas.area(Area { x: area.x + 0.012, y: area.y - 0.012, ..area }, [70.0; 3], 0.35);
        sheet(canvas, rng, area);
    }
}

fn door(canvas: &mut Canvas, rng: &mut ChaCha8Rng) {
    let x = rng.random_range(0.1..canvas.width() - 1.1);
    let leaf = Area { x, y: 0.0, width: 0.95, height: 2.05 };
    canvas.area(leaf, [225.0, 222.0, 215.0], 1.0);
    let paint = from_hsv(rng.random(), 0.35, rng.random_range(60.0..130.0));
    canvas.area(Area { x: x + 0.06, width: 0.83, height: 1.99, ..leaf }, paint, 1.0);
    for y in [0.15, 1.1] {
        let panel = Area { x: x + 0.18, y, width: 0.59, height: 0.8 };
        canvas.area(panel, paint.map(|c| 0.7 * c), 1.0);
        canvas.area(panel.inset(0.015), paint.map(|c| 1.15 * c), 1.0);
    }
    canvas.area(Area { x: x + 0.8, y: 1.0, width: 0.06, height: 0.1 }, [235.0; 3], 1.0);
}

/// Six bright panes, a little different each.
fn window(canvas: &mut Canvas, rng: &mut ChaCha8Rng) {
    let x = rng.random_range(0.1..canvas.width() - 1.5);
    let frame = Area { x, y: 0.95, width: 1.4, height: 1.1 };
    canvas.area(frame, [120.0, 112.0, 104.0], 1.0);
    for i in 0..3 {
        for j in 0..2 {
            let pane = Area {
                x: x + 0.04 + 0.445 * i as f32,
                y: 0.99 + 0.525 * j as f32,
                width: 0.42,
                height: 0.5,
            };
            canvas.area(pane, [rng.random_range(225.0..255.0); 3], 1.0);
        }
    }
}

/// A framed picture, a notice or a poster.
fn sheet(canvas: &mut Canvas, rng: &mut ChaCha8Rng, area: Area) {
    let frame = from_hsv(rng.random(), rng.random_range(0.0..0.5), rng.random_range(30.0..240.0));
    canvas.area(area, frame, 1.0);
    let inner = area.inset(rng.random_range(0.008..0.03));
    if inner.width < 0.6 && rng.random::<f32>() < 0.5 {
        canvas.area(inner, [rng.random_range(200.0..245.0); 3], 1.0);
        let ink = from_hsv(rng.random(), 0.5, rng.random_range(20.0..110.0));
        let height = rng.random_range(0.012..0.05_f32).min(inner.height / 3.0);
        canvas.print(rng, inner.inset(0.02), height, ink);
    } else {
        picture(canvas, rng, inner);
    }
}

fn picture(canvas: &mut Canvas, rng: &mut ChaCha8Rng, area: Area) {
    if !canvas.pictures.is_empty() {
        let chosen = &canvas.pictures[rng.random_range(0..canvas.pictures.len())];
        return canvas.hang(chosen, area);
    }
    let dark = rng.random_range(10.0..80.0);
    let light = rng.random_range(180.0..255.0);
    let palette = Palette::around(rng, 7, dark, light);
    canvas.area(area, palette.pick(rng), 1.0);
    let largest = 0.45 * area.width.max(area.height);
    let pattern =
        Leaves { min_radius: 0.005, max_radius: largest, coverage: 2.2, opacity: 0.95, palette };
    canvas.leaves(rng, area, &pattern);
}

fn ceiling(canvas: &mut Canvas, rng: &mut ChaCha8Rng) {
    let whole = canvas.whole();
    canvas.area(whole, [190.0, 190.0, 186.0], 1.0);
    let speckle = Leaves {
        min_radius: 0.004,
        max_radius: 0.05,
        coverage: 0.25,
        opacity: 0.3,
        palette: Palette(vec![[150.0; 3], [120.0; 3], [215.0; 3]]),
    };
    canvas.leaves(rng, whole, &speckle);
    let step = 0.6;
    for i in 0..(whole.width / step) as usize + 1 {
        for j in 0..(whole.height / step) as usize + 1 {
            let area = Area { x: i as f32 * step, y: j as f32 * step, width: step, height: step };
            match rng.random_range(0..12) {
                0 => canvas.area(area.inset(0.03), [253.0; 3], 1.0),
                1 => grille(canvas, area.inset(0.08)),
                _ => canvas.area(area, [rng.random_range(150.0..230.0); 3], 0.25),
            }
        }
    }
    lattice(canvas, step, 0.012, [110.0; 3]);
}

fn grille(canvas: &mut Canvas, area: Area) {
    canvas.area(area, [90.0; 3], 1.0);
    let slats = (area.height / 0.04) as usize;
    for k in 0..slats {
        let y = area.y + k as f32 * 0.04;
        canvas.area(Area { y, height: 0.016, ..area }, [205.0; 3], 1.0);
    }
}

fn lattice(canvas: &mut Canvas, step: f32, thickness: f32, color: Color) {
    let whole = canvas.whole();
    for i in 0..(whole.width / step) as usize + 1 {
        let x = i as f32 * step - thickness / 2.0;
        canvas.area(Area { x, width: thickness, ..whole }, color, 1.0);
    }
    for j in 0..(whole.height / step) as usize + 1 {
        let y = j as f32 * step - thickness / 2.0;
        canvas.area(Area { y, height: thickness, ..whole }, color, 1.0);
    }
}

fn floor(canvas: &mut Canvas, rng: &mut ChaCha8Rng, richness: f32) {
    let whole = canvas.whole();
    let hue = rng.random_range(0.05..0.11);
    let board = 0.14;
    for row in 0..(whole.height / board) as usize + 1 {
        let mut x = -rng.random::<f32>();
        while x < whole.width {
            let length = rng.random_range(0.5..1.3);
            let tone = from_hsv(hue, 0.4, rng.random_range(115.0..185.0));
            let area = Area { x, y: row as f32 * board, width: length, height: board };
            canvas.area(area, [55.0, 42.0, 34.0], 1.0);
            canvas.area(area.inset(0.003), tone, 1.0);
            x += length;
        }
    }
    canvas.grain(rng, 0.08, 8.0, 0.14);
    let rugs = (richness * whole.width * whole.height / 9.0) as usize;
    for _ in 0..rugs {
        let (w, h) = (rng.random_range(0.8..2.2), rng.random_range(0.6..1.6));
        let area = Area {
            x: rng.random::<f32>() * (whole.width - w).max(0.0),
            y: rng.random::<f32>() * (whole.height - h).max(0.0),
            width: w,
            height: h,
        };
        picture(canvas, rng, area);
    }
    let stains = Leaves {
        min_radius: 0.004,
        max_radius: 0.12,
        coverage: 0.25 * richness,
        opacity: 0.45,
        palette: Palette::around(rng, 6, 30.0, 220.0),
    };
    canvas.leaves(rng, whole, &stains);
}

fn carton(canvas: &mut Canvas, rng: &mut ChaCha8Rng, richness: f32) {
    let whole = canvas.whole();
    let base = from_hsv(rng.random_range(0.06..0.1), 0.42, rng.random_range(150.0..200.0));
    canvas.area(whole, base, 1.0);
    let scuffs = Leaves {
        min_radius: 0.003,
        max_radius: 0.08,
        coverage: 0.5 * richness,
        opacity: 0.3,
        palette: Palette::around(rng, 4, 50.0, 220.0),
    };
    canvas.leaves(rng, whole, &scuffs);
    canvas.grain(rng, 0.1, 1.0, 0.08);
    let tape = Area { y: 0.45 * whole.height, height: 0.05, ..whole };
    canvas.area(tape, [205.0, 190.0, 150.0], 0.7);
    for _ in 0..rng.random_range(1..4) {
        let w = rng.random_range(0.2..0.6) * whole.width;
        let h = rng.random_range(0.2..0.5) * whole.height;
        let area = Area {
            x: rng.random::<f32>() * (whole.width - w),
            y: rng.random::<f32>() * (whole.height - h),
            width: w,
            height: h,
        };
        sheet(canvas, rng, area);
    }
}

fn wood(canvas: &mut Canvas, rng: &mut ChaCha8Rng, richness: f32) {
    let whole = canvas.whole();
    let hue = rng.random_range(0.04..0.12);
    canvas.area(whole, from_hsv(hue, 0.45, rng.random_range(90.0..190.0)), 1.0);
    canvas.grain(rng, 0.05, 10.0, 0.2);
    let drawers = (whole.height / 0.3) as usize;
    for k in 0..drawers {
        let y = k as f32 * whole.height / drawers as f32;
        let area = Area { y, height: whole.height / drawers as f32, ..whole };
        canvas.area(Area { height: 0.008, ..area }, [40.0, 30.0, 24.0], 1.0);
        let handle = Area {
            x: 0.4 * whole.width,
            y: y + 0.45 * area.height,
            width: 0.2 * whole.width,
            height: 0.02,
        };
        canvas.area(handle, [215.0; 3], 1.0);
    }
    let marks = Leaves {
        min_radius: 0.003,
        max_radius: 0.1,
        coverage: 0.3 * richness,
        opacity: 0.5,
        palette: Palette::around(rng, 5, 30.0, 230.0),
    };
    canvas.leaves(rng, whole, &marks);
}

fn books(canvas: &mut Canvas, rng: &mut ChaCha8Rng) {
    let whole = canvas.whole();
    canvas.area(whole, [60.0, 46.0, 36.0], 1.0);
    let shelves = ((whole.height / 0.34) as usize).max(1);
    let pitch = whole.height / shelves as f32;
    for shelf in 0..shelves {
        let bottom = shelf as f32 * pitch + 0.025;
        let mut x = 0.02;
        while x < whole.width - 0.03 {
            let thickness = rng.random_range(0.015..0.06_f32).min(whole.width - 0.02 - x);
            let height = (pitch - 0.03) * rng.random_range(0.6..0.97);
            let spine = Area { x, y: bottom, width: thickness, height };
            let value = rng.random_range(40.0..235.0);
            canvas.area(spine, from_hsv(rng.random(), rng.random_range(0.1..0.8), value), 1.0);
            canvas.area(Area { width: 0.002, ..spine }, [20.0; 3], 0.8);
            let ink = if value > 130.0 { [25.0; 3] } else { [235.0; 3] };
            let title = Area {
                x: x + 0.2 * thickness,
                y: bottom + rng.random_range(0.1..0.3) * height,
                width: 0.6 * thickness,
                height: 0.5 * height,
            };
            canvas.print(rng, title, (0.5 * thickness).clamp(0.006, 0.02), ink);
            x += thickness + if rng.random::<f32>() < 0.08 { 0.08 } else { 0.001 };
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;

    #[test]
    fn a_wide_footprint_reads_the_mean() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let texture = paint(Material::Print, [1.0, 1.0], 0.005, 1.0, &[], &mut rng);
        let level = &texture.levels[0];
        let n = level.texels.len() as f32;
        let mean = level.texels.iter().map(|t| f32::from(t[1])).sum::<f32>() / n;
        let read = texture.sample(0.5, 0.5, [1.0, 0.0], [0.0, 1.0])[1];
        assert!((read - mean).abs() < 6.0, "{read} against {mean}");
    }

    #[test]
    fn a_small_footprint_reads_the_texel() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let texture = paint(Material::Carton, [0.5, 0.4], 0.005, 1.0, &[], &mut rng);
        let level = &texture.levels[0];
        let (column, row) = (37, 21);
        let (u, v) = ((column as f32 + 0.5) * texture.texel, (row as f32 + 0.5) * texture.texel);
        let read = texture.sample(u, v, [1e-4, 0.0], [0.0, 1e-4]);
        let texel = level.texels[row * level.width + column];
        assert!((read[0] - f32::from(texel[0])).abs() < 0.5);
    }

    #[test]
    fn grain_wraps_around_and_is_even_from_afar() {
        let grain = Grain::new(&mut ChaCha8Rng::seed_from_u64(5));
        let side = Grain::SIDE as f32 * Grain::TEXEL;
        for (u, v) in [(0.01, 0.02), (0.2, 0.3001), (0.1234, 0.0)] {
            let value = grain.factor(u, v, 1e-4);
            assert!((grain.factor(u + side, v - side, 1e-4) - value).abs() < 1e-2, "{u} {v}");
            assert!((grain.factor(u, v, 1.0) - 1.0).abs() < 0.02, "{u} {v}");
        }
        let values: Vec<f32> =
            (0..1000).map(|k| grain.factor(0.0013 * k as f32, 0.0007 * k as f32, 1e-4)).collect();
        let mean = values.iter().sum::<f32>() / 1000.0;
        let sd = (values.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / 1000.0).sqrt();
        assert!((mean - 1.0).abs() < 0.05 && sd > 0.1, "{mean} {sd}");
    }

    #[test]
    fn every_material_has_contrast() {
        for material in [
            Material::Wall,
            Material::Ceiling,
            Material::Floor,
            Material::Carton,
            Material::Wood,
            Material::Books,
            Material::Print,
        ] {
            let mut rng = ChaCha8Rng::seed_from_u64(9);
            let texture = paint(material, [0.9, 0.7], 0.005, 1.0, &[], &mut rng);
            let level = &texture.levels[0];
            let n = level.texels.len() as f32;
            let values = || level.texels.iter().map(|t| f32::from(t[1]));
            let mean = values().sum::<f32>() / n;
            let sd = (values().map(|v| (v - mean).powi(2)).sum::<f32>() / n).sqrt();
            assert!(sd > 8.0, "{material:?}: {sd}");
        }
    }

    #[test]
    fn pictures_hang_upright_and_in_proportion() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("quarters.png");
        // Red, green above blue, white; twice as wide as high.
        let quarter = |x: u32, y: u32| match (x < 40, y < 20) {
            (true, true) => image::Rgb([200, 10, 10]),
            (false, true) => image::Rgb([10, 200, 10]),
            (true, false) => image::Rgb([10, 10, 200]),
            (false, false) => image::Rgb([200, 200, 200]),
        };
        image::RgbImage::from_fn(80, 40, quarter).save(&path).unwrap();
        let picture = Picture::load(&path).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let texture = paint(Material::Print, [0.5, 0.5], 0.01, 1.0, &[picture], &mut rng);
        let at = |u, v| texture.sample(u, v, [1e-4, 0.0], [0.0, 1e-4]);
        for (u, v, color) in [
            (0.12, 0.38, [200.0, 10.0, 10.0]),
            (0.38, 0.38, [10.0, 200.0, 10.0]),
            (0.12, 0.12, [10.0, 10.0, 200.0]),
            (0.38, 0.12, [200.0, 200.0, 200.0]),
        ] {
            let seen = at(u, v);
            let near = seen.iter().zip(color).all(|(a, b): (&f32, f32)| (a - b).abs() < 3.0);
            assert!(near, "({u}, {v}): {seen:?} instead of {color:?}");
        }
        assert!(Picture::load(&folder.path().join("absent.png")).is_err());
    }
}
