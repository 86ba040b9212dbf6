//! Image files on walls and boxes.

use std::path::Path;

use super::Color;

/// An image file that hangs on walls and clothes boxes. Its coding is near enough to gamma 2.
#[derive(Debug, Clone)]
pub struct Picture {
    pub width: usize,
    pub height: usize,
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
    pub fn mean(&self, [left, top]: [f32; 2], [right, bottom]: [f32; 2]) -> Color {
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
