//! The grey image of a frame and its reductions, to be looked at again where map points should be.

use nalgebra::{Point2, Vector2};

use super::Patch;

/// Grey images of one frame, the first one being the full image, each smaller than the one before.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Pyramid(Vec<Level>);

#[derive(Debug, Clone, PartialEq)]
struct Level {
    /// Row by row.
    pixels: Vec<u8>,
    width: usize,
    /// Pixels of the full image a pixel of this one, as configured.
    scale: f64,
    /// The same by columns and rows, exactly: sides are whole numbers.
    ratio: Vector2<f64>,
}

/// A place of one level.
#[derive(Debug, Clone, PartialEq)]
pub struct Glimpse {
    pub patch: Patch,
    /// Centre of the patch, pixels of the full image.
    pub pixel: Point2<f64>,
    pub octave: u8,
    /// Pixels of the full image a pixel of the patch.
    pub scale: f64,
}

impl Pyramid {
    /// Adds the next smaller level: `pixels` row by row, `width` to a row.
    pub fn push(&mut self, pixels: Vec<u8>, width: usize, scale: f64) {
        let size = |level: &[u8], width: usize| {
            Vector2::new(width as f64, (level.len() / width.max(1)) as f64)
        };
        let own = size(&pixels, width);
        let full = self.0.first().map_or(own, |full| size(&full.pixels, full.width));
        self.0.push(Level { pixels, width, scale, ratio: full.component_div(&own) });
    }

    /// The surroundings of `pixel` (of the full image as taken) on the level nearest in scale to
    /// `scale` (pixels of the full image a pixel); `None` where they reach over its border.
    pub fn look(&self, pixel: Point2<f64>, scale: f64) -> Option<Glimpse> {
        let ratio_to = |level: &Level| (level.scale / scale).ln().abs();
        let nearest =
            |a: &(usize, &Level), b: &(usize, &Level)| ratio_to(a.1).total_cmp(&ratio_to(b.1));
        let (octave, level) = self.0.iter().enumerate().min_by(nearest)?;
        let place = level_pixel(pixel, level.ratio).coords.map(f64::round);
        if !(place.min() >= 0.0 && place.max() < f64::from(u32::MAX)) {
            return None;
        }
        let patch = Patch::cut(&level.pixels, level.width, place.x as usize, place.y as usize)?;
        Some(Glimpse {
            patch,
            pixel: full_pixel(place.into(), level.ratio),
            octave: octave.try_into().ok()?,
            scale: level.scale,
        })
    }
}

/// From pixels of a level to those of the full image, `ratio` times as large; pixel centres are
/// at integers on both.
pub(super) fn full_pixel(level_pixel: Point2<f64>, ratio: Vector2<f64>) -> Point2<f64> {
    Point2::from((level_pixel.coords.add_scalar(0.5)).component_mul(&ratio).add_scalar(-0.5))
}

/// The inverse of [`full_pixel`].
fn level_pixel(full_pixel: Point2<f64>, ratio: Vector2<f64>) -> Point2<f64> {
    Point2::from((full_pixel.coords.add_scalar(0.5)).component_div(&ratio).add_scalar(-0.5))
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;

    /// 90x60 and half of it.
    fn pyramid() -> Pyramid {
        let mut pyramid = Pyramid::default();
        pyramid.push((0..90 * 60).map(|i| (i % 90) as u8).collect(), 90, 1.0);
        pyramid.push((0..45 * 30).map(|i| (i % 45) as u8).collect(), 45, 2.0);
        pyramid
    }

    #[test]
    fn the_nearest_level_is_looked_at() {
        let pyramid = pyramid();
        let at = Point2::new(40.0, 30.0);
        for (scale, octave, pixel) in
            [(0.3, 0, 40.0), (1.3, 0, 40.0), (1.5, 1, 40.5), (9.0, 1, 40.5)]
        {
            let glimpse = pyramid.look(at, scale).unwrap();
            assert_eq!(glimpse.octave, octave);
            assert_relative_eq!(glimpse.pixel.x, pixel);
            let column = 40 >> octave;
            let row = 30 >> octave;
            let Level { pixels, width, .. } = &pyramid.0[usize::from(octave)];
            assert_eq!(Some(glimpse.patch), Patch::cut(pixels, *width, column, row));
        }
    }

    #[test]
    fn there_is_nothing_over_the_border_or_nowhere() {
        let pyramid = pyramid();
        for (x, y) in [(9.0, 30.0), (81.0, 30.0), (40.0, -1e300), (f64::NAN, 30.0)] {
            assert_eq!(pyramid.look(Point2::new(x, y), 1.0), None, "{x} {y}");
        }
        assert_eq!(Pyramid::default().look(Point2::new(40.0, 30.0), 1.0), None);
    }
}
