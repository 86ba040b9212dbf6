//! Where surfaces are painted: shapes, strokes, print and noise.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::{Color, Level, Picture, Texture};

/// Radius with density proportional to `r^-3` between two limits.
pub(super) fn power_law_radius(rng: &mut ChaCha8Rng, min: f32, max: f32) -> f32 {
    let (a, b) = (min.powi(-2), max.powi(-2));
    (a + rng.random::<f32>() * (b - a)).powf(-0.5)
}

#[derive(Debug, Clone, Copy)]
pub(super) enum Shape {
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
    pub fn random(rng: &mut ChaCha8Rng) -> Self {
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
pub(super) struct Area {
    pub x: f32,
    pub y: f32,
    pub width: f32,
    pub height: f32,
}

impl Area {
    pub fn inset(self, margin: f32) -> Self {
        Self {
            x: self.x + margin,
            y: self.y + margin,
            width: (self.width - 2.0 * margin).max(0.0),
            height: (self.height - 2.0 * margin).max(0.0),
        }
    }
}

/// Where a surface is painted before its mip levels are made. Rows run along increasing `v`.
pub(super) struct Canvas<'a> {
    pub columns: usize,
    pub rows: usize,
    pub texel: f32,
    pub texels: Vec<[u8; 4]>,
    pub clip: Area,
    pub pictures: &'a [Picture],
}

impl<'a> Canvas<'a> {
    pub fn new(columns: usize, rows: usize, texel: f32, color: Color) -> Self {
        let clip =
            Area { x: 0.0, y: 0.0, width: columns as f32 * texel, height: rows as f32 * texel };
        let texels = vec![pack(color); columns * rows];
        Self { columns, rows, texel, texels, clip, pictures: &[] }
    }

    pub fn width(&self) -> f32 {
        self.columns as f32 * self.texel
    }

    pub fn height(&self) -> f32 {
        self.rows as f32 * self.texel
    }

    pub fn whole(&self) -> Area {
        Area { x: 0.0, y: 0.0, width: self.width(), height: self.height() }
    }

    pub fn finish(self) -> Texture {
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
    pub fn hang(&mut self, picture: &Picture, area: Area) {
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

    pub fn shape(
        &mut self,
        shape: Shape,
        center: [f32; 2],
        radius: f32,
        color: Color,
        opacity: f32,
    ) {
        let reach = radius * std::f32::consts::SQRT_2;
        self.fill(center, [reach; 2], color, opacity, |x, y| shape.distance(x, y, radius));
    }

    pub fn area(&mut self, area: Area, color: Color, opacity: f32) {
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
    pub fn leaves(&mut self, rng: &mut ChaCha8Rng, area: Area, leaves: &Leaves) {
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
    pub fn print(&mut self, rng: &mut ChaCha8Rng, area: Area, height: f32, color: Color) {
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
    pub fn grain(&mut self, rng: &mut ChaCha8Rng, period: f32, stretch: f32, amplitude: f32) {
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
pub(super) struct Palette(pub Vec<Color>);

impl Palette {
    /// `count` colors around one hue whose lightness spans `dark` to `light`.
    pub fn around(rng: &mut ChaCha8Rng, count: usize, dark: f32, light: f32) -> Self {
        let hue = rng.random::<f32>();
        let colors = (0..count.max(2)).map(|i| {
            let value = dark + (light - dark) * i as f32 / (count.max(2) - 1) as f32;
            let shift = rng.random_range(-0.15..0.15) + if i % 3 == 2 { 0.5 } else { 0.0 };
            from_hsv(hue + shift, rng.random_range(0.1..0.6), value)
        });
        Self(colors.collect())
    }

    pub fn pick(&self, rng: &mut ChaCha8Rng) -> Color {
        let color = self.0[rng.random_range(0..self.0.len())];
        let shade = rng.random_range(-18.0..18.0);
        color.map(|c| c + shade)
    }
}

/// Hue in turns, saturation 0 to 1, value 0 to 255.
pub(super) fn from_hsv(hue: f32, saturation: f32, value: f32) -> Color {
    [0.0, 2.0 / 3.0, 1.0 / 3.0].map(|offset| {
        let ramp = ((hue + offset).rem_euclid(1.0) * 6.0 - 3.0).abs() - 1.0;
        value * (1.0 - saturation + saturation * ramp.clamp(0.0, 1.0))
    })
}

/// Size range (m), amount and look of dead leaves.
pub(super) struct Leaves {
    pub min_radius: f32,
    pub max_radius: f32,
    /// Painted area per canvas area.
    pub coverage: f32,
    pub opacity: f32,
    pub palette: Palette,
}
