//! The front end on OpenCV: FAST corners on an image pyramid, ORB descriptors, depth.

use std::sync::Arc;

use nalgebra::{Point2, Vector2};
use opencv::boxed_ref::BoxedRef;
use opencv::core::{KeyPoint, Mat, Ptr, Rect, Size, Vector};
use opencv::features2d::{
    FastFeatureDetector, FastFeatureDetector_DetectorType, KeyPointsFilter, ORB, ORB_ScoreType,
};
use opencv::imgproc;
use opencv::prelude::*;

use super::pyramid::full_pixel;
use super::select::{Corner, spread};
use super::tracker::make_grey;
use super::{
    DepthConfig, Descriptor, Extraction, Feature, FeatureConfig, Mask, MaskError, Patch, Pyramid,
};
use crate::sensor::{Camera, CameraConfig, CameraError, RgbdFrame};

/// Radius of the patch that orientation and descriptor are computed from, pixels of the level.
const PATCH_RADIUS: usize = 15;
/// Corners closer to the border of their level than this have no patch.
const BORDER: usize = PATCH_RADIUS + 1;

/// Side of the blocks of a pyramid level that corners are sought in, pixels of the level.
const BLOCK: usize = 64;
/// FAST compares a pixel with a circle of this radius, and its score with that of the neighbours.
const FAST_MARGIN: usize = 4;
/// Corners taken from a block of one level, at most, as a multiple of its share of the features.
const SHARES_OF_BLOCK: usize = 2;

/// A corner within a block: column, row and FAST score.
struct BlockCorner {
    x: usize,
    y: usize,
    score: f32,
}

/// Start and length of the blocks along one side of a level, such that their corners lie inside
/// the border and on no two of them; neighbours overlap by the margin of the detector.
fn blocks(side: usize) -> impl Iterator<Item = (usize, usize)> + Clone {
    let inner = BORDER..side - BORDER;
    inner.clone().step_by(BLOCK).map(move |start| {
        let end = (start + BLOCK).min(inner.end);
        (start - FAST_MARGIN, end - start + 2 * FAST_MARGIN)
    })
}

/// Why a frame or a configuration gives no features.
#[derive(Debug, thiserror::Error)]
pub enum VisionError {
    #[error(
        "color image of {}x{} pixels, but depth image of {}x{}: they must be registered pixel for pixel",
        color.0, color.1, depth.0, depth.1
    )]
    SizeMismatch { color: (usize, usize), depth: (usize, usize) },
    #[error(
        "the image of log.mask has {}x{} pixels, the color image {}x{}: it must be of that size",
        mask.0, mask.1, color.0, color.1
    )]
    MaskSize { mask: (usize, usize), color: (usize, usize) },
    #[error("features.{key} = {value}: must be {expected}")]
    Config { key: &'static str, value: f64, expected: &'static str },
    #[error("tracker.{key} = {value}: must be {expected}")]
    Tracker { key: &'static str, value: f64, expected: &'static str },
    #[error("camera.imu_from_camera or that of a further camera is no rigid transform")]
    Mounting,
    #[error(transparent)]
    Mask(#[from] MaskError),
    #[error("camera.{0}")]
    Camera(#[from] CameraError),
    #[error("OpenCV: {0}")]
    OpenCv(#[from] opencv::Error),
}

/// Finds features and measures them with the depth image.
///
/// OpenCV runs on one thread, so that results do not depend on the machine.
pub struct OrbExtractor {
    config: FeatureConfig,
    camera: Camera,
    depth: DepthConfig,
    fast: Ptr<FastFeatureDetector>,
    /// With the lower threshold.
    sensitive: Ptr<FastFeatureDetector>,
    orb: Ptr<ORB>,
    keeps_pyramid: bool,
    mask: Mask,
}

impl OrbExtractor {
    /// Refuses configurations without a pyramid or with cells or spacings that are not positive.
    pub fn new(
        config: &FeatureConfig,
        camera: &CameraConfig,
        depth: &DepthConfig,
    ) -> Result<Self, VisionError> {
        check("levels", f64::from(config.levels), config.levels >= 1, "at least 1")?;
        let scale = config.scale_factor;
        check("scale_factor", scale, scale > 1.0 && scale.is_finite(), "above 1")?;
        check("cell_size", config.cell_size, config.cell_size >= 1.0, "at least 1 pixel")?;
        check("min_spacing", config.min_spacing, config.min_spacing >= 0.0, "0 or more")?;
        check("pixel_sigma", config.pixel_sigma, config.pixel_sigma > 0.0, "above 0")?;
        opencv::core::set_num_threads(1)?;
        let detector = |threshold: u8| {
            let kind = FastFeatureDetector_DetectorType::TYPE_9_16;
            FastFeatureDetector::create(i32::from(threshold), true, kind)
        };
        // Only describes: one level at a time, at key points that are already chosen.
        let orb = ORB::create(
            1,
            1.2,
            1,
            BORDER as i32,
            0,
            2,
            ORB_ScoreType::FAST_SCORE,
            2 * PATCH_RADIUS as i32 + 1,
            i32::from(config.fast_threshold),
        )?;
        Ok(Self {
            config: config.clone(),
            camera: Camera::new(camera)?,
            depth: depth.clone(),
            fast: detector(config.fast_threshold)?,
            sensitive: detector(config.min_fast_threshold.min(config.fast_threshold))?,
            orb,
            keeps_pyramid: false,
            mask: Mask::default(),
        })
    }

    /// The same, that finds nothing in a part of the image.
    pub fn masked(self, mask: Mask) -> Self {
        Self { mask, ..self }
    }

    /// The same, that gives the pyramid with the features, to be looked at again.
    pub fn keeping_pyramid(self, keeps_pyramid: bool) -> Self {
        Self { keeps_pyramid, ..self }
    }

    /// Features of one frame, ordered by octave, row and column. None in the dark is no error.
    pub fn extract(&mut self, frame: &RgbdFrame) -> Result<Extraction, VisionError> {
        let color = (frame.color.width(), frame.color.height());
        let depth = (frame.depth.width(), frame.depth.height());
        if color != depth {
            return Err(VisionError::SizeMismatch { color, depth });
        }
        if let Some(mask) = self.mask.size().filter(|mask| *mask != color) {
            return Err(VisionError::MaskSize { mask, color });
        }
        let pyramid = self.pyramid(frame)?;
        let mut corners = vec![];
        for (level, image) in pyramid.iter().enumerate() {
            self.detect(level as u8, image, color, &mut corners)?;
        }
        corners.retain(|corner| !self.mask.covers(corner.pixel.x, corner.pixel.y));
        let (cell, spacing) = (self.config.cell_size, self.config.min_spacing);
        let corners = spread(corners, color.0, color.1, cell, spacing, self.config.max_features);
        let described = self.describe(&pyramid, &corners)?;
        let features = self.measure(frame, &pyramid, &described)?;
        let pyramid = if self.keeps_pyramid { self.copied(&pyramid)? } else { Pyramid::default() };
        Ok(Extraction { features, tracks: Vec::new(), pyramid })
    }

    fn copied(&self, levels: &[Mat]) -> Result<Pyramid, VisionError> {
        let mut pyramid = Pyramid::default();
        for (octave, level) in levels.iter().enumerate() {
            let scale = self.config.scale_factor.powi(octave as i32);
            let (mut pixels, width) = (level.data_bytes()?.to_vec(), level.cols() as usize);
            self.blank(&mut pixels, width, scale);
            pyramid.push(pixels, width, scale);
        }
        Ok(pyramid)
    }

    /// Leaves nothing to be recognised in the masked part of a level.
    fn blank(&self, pixels: &mut [u8], width: usize, scale: f64) {
        if self.mask.is_empty() {
            return;
        }
        for (index, pixel) in pixels.iter_mut().enumerate() {
            let here = Point2::new((index % width) as f64, (index / width) as f64);
            let full = full_pixel(here, Vector2::repeat(scale));
            if self.mask.covers(full.x, full.y) {
                *pixel = 0;
            }
        }
    }

    /// The grey image and its reductions, as far as a patch fits into them.
    fn pyramid(&self, frame: &RgbdFrame) -> Result<Vec<Mat>, VisionError> {
        let (width, height) = (frame.color.width(), frame.color.height());
        let mut full = Mat::default();
        make_grey(&frame.color, &mut full)?;
        let mut levels = vec![full];
        for level in 1..self.config.levels {
            let scale = self.config.scale_factor.powi(i32::from(level));
            let size = |full: usize| (full as f64 / scale).round() as i32;
            let size = Size::new(size(width), size(height));
            if size.width.min(size.height) <= 2 * BORDER as i32 {
                break;
            }
            let mut image = Mat::default();
            imgproc::resize_def(&levels[levels.len() - 1], &mut image, size)?;
            levels.push(image);
        }
        Ok(levels)
    }

    fn detect(
        &mut self,
        level: u8,
        image: &Mat,
        (width, height): (usize, usize),
        corners: &mut Vec<Corner>,
    ) -> Result<(), VisionError> {
        let (columns, rows) = (image.cols() as usize, image.rows() as usize);
        if columns <= 2 * BORDER || rows <= 2 * BORDER {
            return Ok(());
        }
        let in_full_image = width.div_ceil(BLOCK) * height.div_ceil(BLOCK);
        let share = self.config.max_features.div_ceil(in_full_image);
        let scale = Vector2::new(width as f64 / columns as f64, height as f64 / rows as f64);
        for (left, across) in blocks(columns) {
            for (top, down) in blocks(rows) {
                let block = Rect::new(left as i32, top as i32, across as i32, down as i32);
                for point in self.detect_in(&image.roi(block)?, share)? {
                    let (column, row) = (left + point.x, top + point.y);
                    corners.push(Corner {
                        pixel: full_pixel(Point2::new(column as f64, row as f64), scale),
                        column,
                        row,
                        level,
                        score: point.score,
                    });
                }
            }
        }
        Ok(())
    }

    /// The strongest corners of a block; with the lower threshold where the higher one finds fewer
    /// than the block's `share` of all features.
    fn detect_in(
        &mut self,
        block: &BoxedRef<Mat>,
        share: usize,
    ) -> Result<Vec<BlockCorner>, VisionError> {
        let mut found = Vector::<KeyPoint>::new();
        self.fast.detect_def(block, &mut found)?;
        if found.len() < share {
            self.sensitive.detect_def(block, &mut found)?;
        }
        // Before the points cross over from OpenCV one by one.
        KeyPointsFilter::run_by_image_border(&mut found, block.size()?, FAST_MARGIN as i32)?;
        let most = i32::try_from(SHARES_OF_BLOCK * share).unwrap_or(i32::MAX);
        KeyPointsFilter::retain_best(&mut found, most)?;
        let corner = |point: KeyPoint| BlockCorner {
            x: point.pt().x as usize,
            y: point.pt().y as usize,
            score: point.response(),
        };
        Ok(found.into_iter().map(corner).collect())
    }

    /// Descriptor of each corner, level by level; `corners` are ordered by level.
    fn describe(
        &mut self,
        pyramid: &[Mat],
        corners: &[Corner],
    ) -> Result<Vec<(Corner, Descriptor)>, VisionError> {
        let mut described = Vec::with_capacity(corners.len());
        for group in corners.chunk_by(|a, b| a.level == b.level) {
            let Some(image) = pyramid.get(usize::from(group[0].level)) else { continue };
            let pixels = image.data_bytes()?;
            let mut points = Vector::<KeyPoint>::with_capacity(group.len());
            for (index, corner) in group.iter().enumerate() {
                points.push(KeyPoint::new_coords(
                    corner.column as f32,
                    corner.row as f32,
                    2.0 * PATCH_RADIUS as f32 + 1.0,
                    orientation(pixels, image.cols() as usize, corner),
                    corner.score,
                    0,
                    index as i32,
                )?);
            }
            let mut descriptors = Mat::default();
            self.orb.compute(image, &mut points, &mut descriptors)?;
            // OpenCV may leave points out; `class_id` tells which are left.
            for (point, row) in points.iter().zip(descriptors.data_bytes()?.as_chunks().0) {
                if let Some(corner) = group.get(point.class_id() as usize) {
                    described.push((*corner, Descriptor::from_bytes(row)));
                }
            }
        }
        Ok(described)
    }

    fn measure(
        &self,
        frame: &RgbdFrame,
        pyramid: &[Mat],
        described: &[(Corner, Descriptor)],
    ) -> Result<Vec<Feature>, VisionError> {
        let mut features = Vec::with_capacity(described.len());
        for (corner, descriptor) in described {
            // In the corners of the image a wide lens may show nothing.
            let Some(bearing) = self.camera.bearing(corner.pixel) else { continue };
            features.push(Feature {
                pixel: corner.pixel,
                bearing,
                descriptor: *descriptor,
                response: corner.score,
                octave: corner.level,
                scale: self.config.scale_factor.powi(i32::from(corner.level)),
                pixel_sigma: self.config.pixel_sigma_at(corner.level),
                patch: patch_around(pyramid, corner)?,
                depth: self.depth.read(&frame.depth, corner.pixel),
            });
        }
        Ok(features)
    }
}

fn check(
    key: &'static str,
    value: f64,
    good: bool,
    expected: &'static str,
) -> Result<(), VisionError> {
    if good { Ok(()) } else { Err(VisionError::Config { key, value, expected }) }
}

fn patch_around(pyramid: &[Mat], corner: &Corner) -> Result<Option<Arc<Patch>>, VisionError> {
    let Some(level) = pyramid.get(usize::from(corner.level)) else { return Ok(None) };
    let patch = Patch::cut(level.data_bytes()?, level.cols() as usize, corner.column, corner.row);
    Ok(patch.map(Arc::new))
}

/// Direction from the corner to the intensity centroid of the disc around it, degrees in
/// [0, 360) from the x axis to the y axis (Rublee et al., 2011, section 3.2).
fn orientation(pixels: &[u8], stride: usize, corner: &Corner) -> f32 {
    const RADIUS: isize = PATCH_RADIUS as isize;
    let (mut m10, mut m01) = (0, 0);
    for dy in -RADIUS..=RADIUS {
        let half_width = ((RADIUS * RADIUS - dy * dy) as f64).sqrt().round() as usize;
        let row = corner.row.saturating_add_signed(dy);
        let start = row * stride + corner.column - half_width;
        let Some(line) = pixels.get(start..=start + 2 * half_width) else { return 0.0 };
        let (mut sum, mut moment) = (0, 0);
        for (x, &value) in (-(half_width as i32)..).zip(line) {
            sum += i32::from(value);
            moment += x * i32::from(value);
        }
        m10 += moment;
        m01 += dy as i32 * sum;
    }
    (m01 as f32).atan2(m10 as f32).to_degrees().rem_euclid(360.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::{ColorImage, DepthImage, PixelFormat, Stamp};
    use crate::vision::{MaskConfig, MatchingConfig, match_descriptors};
    use opencv::calib3d;
    use opencv::core::{Point2d, TermCriteria, TermCriteria_Type};
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    const WIDTH: usize = 320;
    const HEIGHT: usize = 240;

    fn extractor() -> OrbExtractor {
        let depth = DepthConfig::default();
        OrbExtractor::new(&FeatureConfig::default(), &CameraConfig::default(), &depth).unwrap()
    }

    fn features(frame: &RgbdFrame) -> Vec<Feature> {
        extractor().extract(frame).unwrap().features
    }

    fn frame(width: usize, height: usize, grey: Vec<u8>) -> RgbdFrame {
        RgbdFrame {
            others: Vec::new(),
            stamp: Stamp::default(),
            color: ColorImage::new(width, height, PixelFormat::Mono8, grey).unwrap(),
            depth: DepthImage::new(width, height, 1e-3, vec![2000; width * height]).unwrap(),
        }
    }

    /// Overlapping rectangles of random brightness.
    fn collage(seed: u64) -> Vec<u8> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut image = vec![100; WIDTH * HEIGHT];
        for _ in 0..300 {
            let (x, y) = (rng.random_range(0..WIDTH), rng.random_range(0..HEIGHT));
            let (w, h) = (rng.random_range(5..40), rng.random_range(5..40));
            let value = rng.random_range(20..=240);
            for row in y..(y + h).min(HEIGHT) {
                image[row * WIDTH + x..row * WIDTH + (x + w).min(WIDTH)].fill(value);
            }
        }
        image
    }

    #[test]
    fn features_cover_the_image_in_a_stable_order() {
        let frame = frame(WIDTH, HEIGHT, collage(1));
        let found = features(&frame);
        assert!(found.len() > 300, "{}", found.len());
        assert_eq!(found, features(&frame));
        assert!(found.is_sorted_by_key(|f| f.octave));
        for f in &found {
            assert!((0.0..WIDTH as f64).contains(&f.pixel.x));
            assert!((0.0..HEIGHT as f64).contains(&f.pixel.y));
            assert!((f.depth.unwrap().depth - 2.0).abs() < 1e-9);
        }
    }

    #[test]
    fn nothing_is_found_in_the_masked_part() {
        let image = frame(WIDTH, HEIGHT, collage(1));
        let regions = MaskConfig::Regions(vec![[0, 160, 320, 80], [100, 0, 60, 240]]);
        let mask = regions.load().unwrap();
        let covered = |f: &&Feature| mask.covers(f.pixel.x, f.pixel.y);
        assert!(features(&image).iter().filter(covered).count() > 50);
        let mut masked = extractor().keeping_pyramid(true).masked(mask.clone());
        let Extraction { features, pyramid, .. } = masked.extract(&image).unwrap();
        assert!(features.len() > 100);
        assert_eq!(features.iter().filter(covered).count(), 0);
        // Nor is there anything to be recognised at a predicted place.
        let black = frame(WIDTH, HEIGHT, vec![0; WIDTH * HEIGHT]);
        let black = masked.extract(&black).unwrap().pyramid;
        let place = Point2::new(130.0, 200.0);
        let patch = |pyramid: &Pyramid| pyramid.look(place, 1.0).unwrap().patch;
        assert_eq!(patch(&pyramid), patch(&black));
    }

    #[test]
    fn darkness_and_tiny_images_have_no_features() {
        for (width, height) in [(1, 1), (640, 1), (33, 40), (WIDTH, HEIGHT)] {
            let black = frame(width, height, vec![0; width * height]);
            assert_eq!(features(&black), []);
        }
    }

    #[test]
    fn dim_images_keep_most_features() {
        let bright = features(&frame(WIDTH, HEIGHT, collage(2)));
        let dim = collage(2).into_iter().map(|v| (f64::from(v) * 0.5) as u8).collect();
        let dim = features(&frame(WIDTH, HEIGHT, dim));
        assert!(dim.len() * 10 > bright.len() * 8, "{} of {}", dim.len(), bright.len());
    }

    #[test]
    fn images_of_different_sizes_are_refused() {
        let mut broken = frame(WIDTH, HEIGHT, collage(1));
        broken.depth = DepthImage::new(2, 1, 1e-3, vec![1, 1]).unwrap();
        let error = extractor().extract(&broken).unwrap_err();
        assert!(error.to_string().contains("320x240") && error.to_string().contains("2x1"));
    }

    #[test]
    fn impossible_configurations_are_refused() {
        let default = FeatureConfig::default;
        for (key, config) in [
            ("levels", FeatureConfig { levels: 0, ..default() }),
            ("scale_factor", FeatureConfig { scale_factor: 1.0, ..default() }),
            ("cell_size", FeatureConfig { cell_size: f64::NAN, ..default() }),
            ("min_spacing", FeatureConfig { min_spacing: -1.0, ..default() }),
            ("pixel_sigma", FeatureConfig { pixel_sigma: 0.0, ..default() }),
        ] {
            let made =
                OrbExtractor::new(&config, &CameraConfig::default(), &DepthConfig::default());
            let error = made.err().unwrap().to_string();
            assert!(error.contains(key), "{error}");
        }
    }

    /// The orientation makes descriptors follow the image: those of an image turned by a
    /// quarter are found again at the turned places.
    #[test]
    fn descriptors_turn_with_the_image() {
        const SIDE: usize = HEIGHT;
        let image = collage(3);
        let at = |x: usize, y: usize| image[y * WIDTH + x];
        let square = (0..SIDE * SIDE).map(|i| at(i % SIDE, i / SIDE)).collect();
        // (x, y) goes to (SIDE - 1 - y, x).
        let turned = (0..SIDE * SIDE).map(|i| at(i / SIDE, SIDE - 1 - i % SIDE)).collect();
        let a = features(&frame(SIDE, SIDE, square));
        let b = features(&frame(SIDE, SIDE, turned));
        let descriptors = |f: &[Feature]| f.iter().map(|f| f.descriptor).collect::<Vec<_>>();
        let matches =
            match_descriptors(&descriptors(&a), &descriptors(&b), &MatchingConfig::default());
        let right = matches.iter().filter(|m| {
            let p = a[m.query].pixel;
            let expected = Point2::new(SIDE as f64 - 1.0 - p.y, p.x);
            (b[m.train].pixel - expected).norm() < 3.0
        });
        let right = right.count();
        assert!(right > 100 && right * 10 > matches.len() * 9, "{right} of {}", matches.len());
    }

    /// Our inverse against OpenCV's.
    #[test]
    fn bearings_are_those_of_undistorted_pixels() {
        let camera = CameraConfig {
            fx: 517.3,
            fy: 516.5,
            cx: 318.6,
            cy: 255.3,
            distortion: vec![0.2624, -0.9531, -0.0054, 0.0026, 1.1633],
            ..CameraConfig::default()
        };
        let CameraConfig { fx, fy, cx, cy, .. } = camera;
        let matrix = Mat::from_slice_2d(&[[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]).unwrap();
        let grid: Vector<Point2d> = (0..=16)
            .flat_map(|i| (0..=12).map(move |j| (f64::from(i), f64::from(j))))
            .map(|(i, j)| Point2d::new(40.0 * i, 40.0 * j))
            .collect();
        let mut undistorted = Vector::<Point2d>::new();
        calib3d::undistort_points_iter(
            &grid,
            &mut undistorted,
            &matrix,
            &Mat::from_slice(&camera.distortion).unwrap(),
            &opencv::core::no_array(),
            &opencv::core::no_array(),
            TermCriteria::new(TermCriteria_Type::COUNT as i32, 200, 0.0).unwrap(),
        )
        .unwrap();
        let camera = Camera::new(&camera).unwrap();
        for (pixel, expected) in grid.iter().zip(undistorted) {
            let bearing = camera.bearing(Point2::new(pixel.x, pixel.y)).unwrap();
            let off = bearing.xy() / bearing.z - Vector2::new(expected.x, expected.y);
            assert!(off.norm() < 1e-9, "{pixel:?} {expected:?} {bearing:?}");
        }
    }
}
