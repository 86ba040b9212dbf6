//! Grey images in halves of halves, to be compared with windows of a fixed size.

use nalgebra::Vector2;
use opencv::core::{Mat, Vec3b};
use opencv::imgproc;
use opencv::prelude::*;

use crate::sensor::{ColorImage, PixelFormat};

/// Grey values row by row, without padding.
#[derive(Debug, Clone, Copy)]
pub(super) struct Grey<'a> {
    pub pixels: &'a [u8],
    pub width: usize,
    pub height: usize,
}

impl Grey<'_> {
    /// Whether a box of half side `reach` around `centre` lies inside, with what a bilinear value at
    /// its edge needs.
    pub fn holds(&self, centre: Vector2<f32>, reach: Vector2<f32>) -> bool {
        let inside = |x: f32, reach: f32, size: usize| {
            // Also refuses NaN.
            x - reach >= 0.0 && x + reach < size as f32 - 1.0
        };
        inside(centre.x, reach.x, self.width) && inside(centre.y, reach.y, self.height)
    }

    /// The pixel nearest to a place that may lie outside; 0 in an image without pixels.
    pub fn nearest(&self, column: isize, row: isize) -> u8 {
        let inside = |x: isize, size: usize| x.clamp(0, (size as isize - 1).max(0)) as usize;
        let index = inside(row, self.height) * self.width + inside(column, self.width);
        self.pixels.get(index).copied().unwrap_or(0)
    }
}

/// An image and its reductions by 2, 4, ...: pixel `(x, y)` of one level is `(2x, 2y)` of the level
/// before. Its memory is used again for the next image.
#[derive(Default)]
pub(super) struct Levels(Vec<Mat>);

impl Levels {
    /// Takes an image, and reduces it as long as a level has sides of at least `least` pixels.
    pub fn fill(
        &mut self,
        image: &ColorImage,
        levels: usize,
        least: usize,
    ) -> Result<(), opencv::Error> {
        let reductions = |side: usize| (side / least.max(1)).max(1).ilog2() as usize;
        let side = image.width().min(image.height());
        let levels = levels.clamp(1, 1 + reductions(side));
        self.0.resize_with(levels, Mat::default);
        if let Some(full) = self.0.first_mut() {
            make_grey(image, full)?;
        }
        for level in 1..levels {
            let (larger, smaller) = self.0.split_at_mut(level);
            if let (Some(from), Some(to)) = (larger.last(), smaller.first_mut()) {
                imgproc::pyr_down_def(from, to)?;
            }
        }
        Ok(())
    }

    pub fn len(&self) -> usize {
        self.0.len()
    }

    pub fn full(&self) -> Option<&Mat> {
        self.0.first()
    }

    /// A level; one without pixels where there is none.
    pub fn level(&self, level: usize) -> Grey<'_> {
        let grey = |image: &Mat| (image.cols() as usize, image.rows() as usize);
        let image =
            self.0.get(level).and_then(|image| Some((image.data_bytes().ok()?, grey(image))));
        let (pixels, (width, height)) = image.unwrap_or_default();
        Grey { pixels, width, height }
    }
}

/// Grey copy of a color image, into `grey`.
pub(in crate::vision) fn make_grey(
    image: &ColorImage,
    grey: &mut Mat,
) -> Result<(), opencv::Error> {
    let (rows, columns) = (image.height() as i32, image.width() as i32);
    let code = match image.format() {
        PixelFormat::Mono8 => {
            return Mat::new_rows_cols_with_bytes::<u8>(rows, columns, image.data())?.copy_to(grey);
        }
        PixelFormat::Rgb8 => imgproc::COLOR_RGB2GRAY,
        PixelFormat::Bgr8 => imgproc::COLOR_BGR2GRAY,
    };
    let color = Mat::new_rows_cols_with_bytes::<Vec3b>(rows, columns, image.data())?;
    imgproc::cvt_color_def(&color, grey, code)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pixel_of_a_level_is_twice_as_far_on_the_one_before() {
        let at = |x: usize, y: usize| (x + 2 * y) as u8;
        let pixels = (0..64 * 48).map(|i| at(i % 64, i / 64)).collect();
        let image = ColorImage::new(64, 48, PixelFormat::Mono8, pixels).unwrap();
        let mut levels = Levels::default();
        levels.fill(&image, 8, 12).unwrap();
        assert_eq!(levels.len(), 3);
        for level in 0..3 {
            let grey = levels.level(level);
            assert_eq!((grey.width, grey.height), (64 >> level, 48 >> level));
            assert_eq!(grey.pixels[5 * grey.width + 7], at(7 << level, 5 << level), "{level}");
        }
        assert!(levels.level(3).pixels.is_empty());
        assert!(!levels.level(3).holds(Vector2::zeros(), Vector2::zeros()));
        let holds = |x: f32| levels.level(0).holds(Vector2::new(x, 20.0), Vector2::repeat(5.0));
        assert!(holds(5.0) && holds(57.9) && !holds(4.9) && !holds(58.0) && !holds(f32::NAN));
    }

    #[test]
    fn colors_become_grey() {
        let image = |format| ColorImage::new(1, 1, format, vec![255, 0, 0]).unwrap();
        for (format, value) in [(PixelFormat::Rgb8, 76), (PixelFormat::Bgr8, 29)] {
            let mut levels = Levels::default();
            levels.fill(&image(format), 3, 1).unwrap();
            assert_eq!(levels.level(0).pixels, [value]);
        }
    }
}
