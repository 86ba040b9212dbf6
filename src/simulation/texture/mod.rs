//! Procedural surfaces, painted once and read through mip maps.
//!
//! Patterns follow the "dead leaves" model of natural images (Lee, Mumford and Huang, 2001):
//! opaque shapes whose sizes obey a cubic power law, so that there are corners and edges at every
//! scale and no repetition. Colors are coded by their square root (gamma 2): light then still
//! multiplies, and photon noise has the same spread everywhere.

mod canvas;
mod grain;
mod material;
mod picture;

pub use grain::Grain;
pub use material::{Material, paint};
pub use picture::Picture;

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

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

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
}
