//! What color and depth images hold: channel order, darkness, depth unit, validity.

use serde::Serialize;

use crate::sensor::{ColorImage, DepthImage, PixelFormat};

/// Mean brightness below which an image is dark, of 255.
const DARK: f64 = 12.0;

/// Raw depths above this are no millimetres: RGB-D sensors do not see beyond 20 m.
const LARGEST_MILLIMETRES: usize = 20_000;

/// Nor is a median above this: most of what such sensors see is nearer than 4 m.
const LARGEST_MEDIAN_MILLIMETRES: usize = 4_000;

/// If more than this part of the depths are multiples of five, they were scaled by five from
/// millimetres, as TUM RGB-D does.
const SHARE_OF_FIVES: f64 = 0.9;

/// Color images as logged, one in several.
#[derive(Debug, Default)]
pub(super) struct ColorStatistics {
    images: u64,
    dark: u64,
    /// Sums of the means of the first and the last channel.
    first: f64,
    last: f64,
    brightness: f64,
}

/// Color images that were looked at, one in several.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ColorInspection {
    pub images: u64,
    /// Mean over pixels and channels, of 255.
    pub brightness: f64,
    /// Fraction of images with a brightness below 12.
    pub dark: f64,
    /// Mean of the last channel over that of the first: rooms are more red than blue, so above 1
    /// the order is blue, green, red. Absent for grey images.
    pub last_over_first: Option<f64>,
}

impl ColorStatistics {
    pub fn add(&mut self, image: &ColorImage) {
        let channels = image.format().channels();
        // One row in four is enough.
        let rows = image.data().chunks(image.width() * channels).step_by(4);
        let (mut sums, mut pixels) = ([0_u64; 3], 0_u64);
        for pixel in rows.flat_map(|row| row.chunks_exact(channels)) {
            sums.iter_mut().zip(pixel).for_each(|(sum, value)| *sum += u64::from(*value));
            pixels += 1;
        }
        let means = sums.map(|sum| sum as f64 / pixels.max(1) as f64);
        let brightness = means.iter().sum::<f64>() / channels as f64;
        self.images += 1;
        self.dark += u64::from(brightness < DARK);
        self.brightness += brightness;
        if image.format() != PixelFormat::Mono8 {
            self.first += means[0];
            self.last += means[2];
        }
    }

    pub fn evaluate(&self) -> Option<ColorInspection> {
        let images = self.images as f64;
        (self.images > 0).then(|| ColorInspection {
            images: self.images,
            brightness: self.brightness / images,
            dark: self.dark as f64 / images,
            last_over_first: (self.first > 0.0).then(|| self.last / self.first),
        })
    }
}

/// Depth images as logged, one in several.
#[derive(Debug, Default)]
pub(super) struct DepthStatistics {
    images: u64,
    pixels: u64,
    /// Number of pixels by raw value.
    counts: Vec<u64>,
    /// Whether the values were floating-point metres and are now millimetres.
    was_metres: bool,
}

/// Depth images that were looked at, one in several.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DepthInspection {
    pub images: u64,
    /// Fraction of pixels with a depth.
    pub valid: f64,
    /// Fraction of pixels that are 65535, which some sensors write for "none".
    pub saturated: f64,
    /// Median and 99th percentile of the raw values.
    pub raw_median: u64,
    pub raw_p99: u64,
    /// Metres per unit, as the values suggest.
    pub scale: f64,
    /// Median depth by that unit, m.
    pub median: f64,
}

impl DepthStatistics {
    /// `image` with its invalid values still in it.
    pub fn add(&mut self, image: &DepthImage, is_metres: bool) {
        self.counts.resize(1 << 16, 0);
        self.images += 1;
        self.was_metres |= is_metres;
        // One row in four is enough.
        for row in image.data().chunks(image.width()).step_by(4) {
            self.pixels += row.len() as u64;
            row.iter().for_each(|raw| self.counts[usize::from(*raw)] += 1);
        }
    }

    pub fn evaluate(&self) -> Option<DepthInspection> {
        if self.images == 0 {
            return None;
        }
        let part = |count: u64| count as f64 / self.pixels as f64;
        let saturated = self.counts[65535];
        let valid = self.pixels - self.counts[0] - saturated;
        let quantile = |fraction: f64| {
            let wanted = (fraction * valid as f64) as u64;
            let mut below = 0;
            (1..65535).find(|raw| {
                below += self.counts[*raw];
                below > wanted
            })
        };
        let (median, p99) = (quantile(0.5).unwrap_or(0), quantile(0.99).unwrap_or(0));
        let fives: u64 = (5..65535).step_by(5).map(|raw| self.counts[raw]).sum();
        let too_far = p99 > LARGEST_MILLIMETRES || median > LARGEST_MEDIAN_MILLIMETRES;
        let scaled = too_far || fives as f64 > SHARE_OF_FIVES * valid as f64;
        let scale = if scaled && valid > 0 && !self.was_metres { 0.0002 } else { 0.001 };
        Some(DepthInspection {
            images: self.images,
            valid: part(valid),
            saturated: part(saturated),
            raw_median: median as u64,
            raw_p99: p99 as u64,
            scale,
            median: median as f64 * scale,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn depth(values: impl Iterator<Item = u16>) -> DepthInspection {
        let data: Vec<u16> = values.collect();
        let mut statistics = DepthStatistics::default();
        let image = DepthImage::new(data.len(), 1, 0.001, data).unwrap();
        statistics.add(&image, false);
        statistics.evaluate().unwrap()
    }

    #[test]
    fn units_of_depth_are_told_apart() {
        let millimetres = depth((0..1000).map(|n| if n % 4 == 0 { 0 } else { 800 + 2 * n }));
        assert_eq!((millimetres.scale, millimetres.valid), (0.001, 0.75));
        assert!((millimetres.median - 1.8).abs() < 0.01);
        let scaled = depth((0..1000).map(|n| 5 * (800 + 2 * n)));
        assert_eq!(scaled.scale, 0.0002);
        assert!((scaled.median - 1.8).abs() < 0.01);
        assert_eq!(depth((0..1000).map(|n| 3001 + 37 * n)).scale, 0.0002);
        let invalid = depth([65535, 65535, 1000, 0].into_iter());
        assert_eq!((invalid.saturated, invalid.valid, invalid.raw_median), (0.5, 0.25, 1000));
    }

    #[test]
    fn an_image_without_depth_has_no_median() {
        let empty = depth([0; 16].into_iter());
        assert_eq!((empty.valid, empty.median, empty.scale), (0.0, 0.0, 0.001));
        assert!(DepthStatistics::default().evaluate().is_none());
    }

    #[test]
    fn channel_order_and_darkness_show_in_the_means() {
        let mut colors = ColorStatistics::default();
        for (value, count) in [([60, 80, 120], 3), ([3, 2, 4], 1)] {
            for _ in 0..count {
                let data = value.repeat(12);
                colors.add(&ColorImage::new(4, 3, PixelFormat::Rgb8, data).unwrap());
            }
        }
        let found = colors.evaluate().unwrap();
        assert_eq!((found.images, found.dark), (4, 0.25));
        assert!(found.last_over_first.unwrap() > 1.9);
        let mut grey = ColorStatistics::default();
        grey.add(&ColorImage::new(2, 1, PixelFormat::Mono8, vec![7, 9]).unwrap());
        assert_eq!(grey.evaluate().unwrap().last_over_first, None);
        assert_eq!(grey.evaluate().unwrap().brightness, 8.0);
    }
}
