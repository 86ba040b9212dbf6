//! A fine pattern laid over the larger textures.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::canvas::{Canvas, Shape, power_law_radius};
use super::mip;

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

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;

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
}
