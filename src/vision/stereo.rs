//! Depth from two cameras: rectification, and matching of textured points along the rows.
//!
//! A match at disparity `d` (pixels) lies at depth `z = f b / d`, so an error of the disparity by
//! `sigma_d` moves it by `sigma_z = z^2 sigma_d / (f b)`: the quadratic law of
//! [`DepthConfig`](super::DepthConfig), with `noise_quadratic = sigma_d / (f b)`.
//!
//! A pinhole shows only the middle of what a wide lens sees. There the rectified images serve for
//! matching alone: what is measured is the left image as taken, with the range where it was matched.

use std::ops::RangeInclusive;

use nalgebra::{Isometry3, Matrix3, Point2, Rotation3, Vector3};

use crate::sensor::{
    Camera, CameraConfig, CameraError, CameraModel, ColorImage, DepthImage, PinholeCamera,
    PixelFormat,
};

/// Half the sides of the window that is compared, pixels.
const HALF_WIDTH: usize = 5;
const HALF_HEIGHT: usize = 3;
/// One point is matched in each square cell of this side, pixels.
const CELL: usize = 6;
/// Half the side of the square of pixels to which a match gives its depth, pixels.
const SPLAT: usize = 3;
/// Mean absolute difference along the row below which a window has no texture, of 255.
const LEAST_CONTRAST: f32 = 3.0;
/// A match is unique if every other disparity costs more than this many times as much.
const UNIQUENESS: f32 = 1.25;
/// Mean absolute difference above which two windows do not show the same, of 255.
const LARGEST_COST: f32 = 14.0;
/// Disparities from left to right and back may differ by this, pixels.
const LARGEST_INCONSISTENCY: usize = 1;
/// Nearest and farthest depth that is matched, m.
const NEAREST: f64 = 0.4;
const FARTHEST: f64 = 20.0;
/// Metres per unit of the depth images.
const SCALE: f32 = 0.001;

/// Cameras that cannot be used together.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum StereoError {
    #[error("the mounting of the {0} camera is not a rigid transform")]
    Mounting(&'static str),
    #[error("the cameras are {0} m apart: no depth can be told from them")]
    Baseline(f64),
    #[error("the second camera is not to the right of the first")]
    Order,
    #[error("the {0} camera: {1}")]
    Camera(&'static str, CameraError),
    #[error("images of {0}x{1} pixels")]
    Size(usize, usize),
}

/// Two cameras, and how their images are turned so that rows correspond.
#[derive(Debug, Clone)]
pub struct StereoRig {
    size: (usize, usize),
    /// As given: left and right.
    cameras: [CameraConfig; 2],
    /// Of the images of [`Self::measure`].
    camera: CameraConfig,
    /// Of the images that are matched.
    rectified: PinholeCamera,
    baseline: f64,
    /// Of a wide left lens, whose images are left as taken.
    wide: Option<(Camera, Rotation3<f64>)>,
    /// By pixel of the rectified images: where in the image as taken.
    left: Vec<Point2<f32>>,
    right: Vec<Point2<f32>>,
}

/// The left camera as it would be if both looked straight across their baseline, rows of their
/// images corresponding, or, if its lens is a wide one, as it is: that of the images of
/// [`StereoRig::measure`]. Cameras with their mountings on a common body.
pub fn rectified_camera(
    left: &CameraConfig,
    right: &CameraConfig,
) -> Result<CameraConfig, StereoError> {
    Rectification::new(left, right).map(|rectification| rectification.camera)
}

struct Rectification {
    /// The rectified left camera, or a wide one as it is.
    camera: CameraConfig,
    rectified: PinholeCamera,
    baseline: f64,
    left_from_rectified: Rotation3<f64>,
    right_from_rectified: Rotation3<f64>,
}

impl Rectification {
    fn new(left: &CameraConfig, right: &CameraConfig) -> Result<Self, StereoError> {
        let body_from_left = left.imu_from_camera().ok_or(StereoError::Mounting("left"))?;
        let body_from_right = right.imu_from_camera().ok_or(StereoError::Mounting("right"))?;
        let left_from_right = body_from_left.inv_mul(&body_from_right);
        let offset = left_from_right.translation.vector;
        let baseline = offset.norm();
        if !(0.005..=5.0).contains(&baseline) {
            return Err(StereoError::Baseline(baseline));
        }
        if offset.x < 0.7 * baseline {
            return Err(StereoError::Order);
        }
        // The x axis along the baseline, the z axis as near as possible to both optical axes.
        let axis = Vector3::z() + left_from_right.rotation * Vector3::z();
        let x = offset / baseline;
        let y = axis.cross(&x).normalize();
        let left_from_rectified =
            Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, y, x.cross(&y)]));
        let right_from_rectified =
            left_from_right.rotation.to_rotation_matrix().inverse() * left_from_rectified;
        let focal = 0.25 * (left.fx + left.fy + right.fx + right.fy);
        let body_from_rectified =
            body_from_left * Isometry3::from_parts(Default::default(), left_from_rectified.into());
        let matrix = body_from_rectified.to_homogeneous();
        let rectified = CameraConfig {
            model: CameraModel::RadialTangential,
            fx: focal,
            fy: focal,
            cx: 0.5 * (left.cx + right.cx),
            cy: 0.5 * (left.cy + right.cy),
            distortion: Vec::new(),
            imu_from_camera: std::array::from_fn(|row| {
                std::array::from_fn(|column| matrix[(row, column)])
            }),
            time_offset: left.time_offset,
            readout_time: left.readout_time,
        };
        let pinhole = rectified.intrinsics();
        let camera = if left.model.is_wide() { left.clone() } else { rectified };
        Ok(Self { camera, rectified: pinhole, baseline, left_from_rectified, right_from_rectified })
    }
}

impl StereoRig {
    /// Cameras with their mountings on a common body, for images of `size` (width, height).
    pub fn new(
        left: &CameraConfig,
        right: &CameraConfig,
        size: (usize, usize),
    ) -> Result<Self, StereoError> {
        const SIDES: RangeInclusive<usize> = 16..=8192;
        if !(SIDES.contains(&size.0) && SIDES.contains(&size.1)) {
            return Err(StereoError::Size(size.0, size.1));
        }
        let lens = |side, config| Camera::new(config).map_err(|e| StereoError::Camera(side, e));
        let (left_lens, right_lens) = (lens("left", left)?, lens("right", right)?);
        let rectification = Rectification::new(left, right)?;
        let (rectified, baseline) = (rectification.rectified, rectification.baseline);
        let left_from_rectified = rectification.left_from_rectified;
        let map = |source: &Camera, rotation: &Rotation3<f64>| {
            let at = |row: usize, column: usize| {
                let pixel = Point2::new(column as f64, row as f64);
                let ray = rotation * rectified.unproject(pixel, 1.0);
                // What the lens does not image is not to be seen.
                source.project(&ray).map_or(Point2::new(-1.0, -1.0), |pixel| pixel.cast())
            };
            (0..size.1)
                .flat_map(|row| (0..size.0).map(move |column| (row, column)))
                .map(|(row, column)| at(row, column))
                .collect()
        };
        Ok(Self {
            size,
            cameras: [left.clone(), right.clone()],
            left: map(&left_lens, &left_from_rectified),
            right: map(&right_lens, &rectification.right_from_rectified),
            camera: rectification.camera,
            rectified,
            baseline,
            wide: left.model.is_wide().then_some((left_lens, left_from_rectified)),
        })
    }

    /// The left and the right camera, whose images are those as taken.
    pub fn cameras(&self) -> &[CameraConfig; 2] {
        &self.cameras
    }

    /// The camera of the images of [`Self::measure`]: see [`rectified_camera`].
    pub fn camera(&self) -> &CameraConfig {
        &self.camera
    }

    /// Focal length times baseline, pixel m.
    pub fn focal_baseline(&self) -> f64 {
        self.rectified.fx * self.baseline
    }

    /// The rectified left image and the depth (mm) of its points that were matched, 0 elsewhere; of
    /// a wide lens the image as taken, and the range. `None` if the images are not of the rig's size.
    pub fn measure(
        &self,
        left: &ColorImage,
        right: &ColorImage,
    ) -> Option<(ColorImage, DepthImage)> {
        let fits = |image: &ColorImage| (image.width(), image.height()) == self.size;
        if !fits(left) || !fits(right) {
            return None;
        }
        let taken = grey(left);
        let left = remap(&taken, self.size, &self.left);
        let right = remap(&grey(right), self.size, &self.right);
        let depth = self.depths(&left, &right);
        let (shown, depth) = match &self.wide {
            Some((lens, left_from_rectified)) => {
                (taken, self.ranges(&depth, lens, left_from_rectified))
            }
            None => (left, depth),
        };
        let (width, height) = self.size;
        let pixels = shown.iter().map(|value| value.round() as u8).collect();
        Some((
            ColorImage::new(width, height, PixelFormat::Mono8, pixels)?,
            DepthImage::new(width, height, SCALE, depth)?,
        ))
    }

    /// Depths of the rectified image as ranges of the left image as taken; the nearest one counts.
    fn ranges(
        &self,
        depths: &[u16],
        lens: &Camera,
        left_from_rectified: &Rotation3<f64>,
    ) -> Vec<u16> {
        let (width, height) = self.size;
        let mut ranges = vec![0_u16; width * height];
        for (index, depth) in depths.iter().enumerate().filter(|(_, depth)| **depth > 0) {
            let pixel = Point2::new((index % width) as f64, (index / width) as f64);
            let point = left_from_rectified * self.rectified.unproject(pixel, f64::from(*depth));
            let Some(seen) = lens.project(&point).map(|seen| seen.map(f64::round)) else {
                continue;
            };
            let inside =
                (0.0..width as f64).contains(&seen.x) && (0.0..height as f64).contains(&seen.y);
            let range = lens.depth_of(&point).round();
            if !inside || range > f64::from(u16::MAX) {
                continue;
            }
            let nearest = &mut ranges[seen.y as usize * width + seen.x as usize];
            if *nearest == 0 || (range as u16) < *nearest {
                *nearest = range as u16;
            }
        }
        ranges
    }

    fn depths(&self, left: &[f32], right: &[f32]) -> Vec<u16> {
        let (width, height) = self.size;
        let matcher = Matcher {
            width,
            left,
            right,
            least: (self.focal_baseline() / FARTHEST).floor() as usize,
            most: (self.focal_baseline() / NEAREST).ceil() as usize,
        };
        let mut depths = vec![0_u16; width * height];
        // Squared distance of each pixel from the match that gave it its depth.
        let mut distances = vec![usize::MAX; width * height];
        let (top, bottom) = (HALF_HEIGHT.max(SPLAT), height.saturating_sub(HALF_HEIGHT.max(SPLAT)));
        let (first, last) = (HALF_WIDTH + 1, width.saturating_sub(HALF_WIDTH + 1));
        for row in (top..bottom).step_by(CELL) {
            for column in (first..last).step_by(CELL) {
                let cell = (column, row, (column + CELL).min(last), (row + CELL).min(bottom));
                let Some((x, y)) = matcher.most_textured(cell) else { continue };
                let Some(disparity) = matcher.disparity(x, y) else { continue };
                let depth =
                    (self.focal_baseline() / f64::from(disparity) / f64::from(SCALE)).round();
                if !(1.0..=f64::from(u16::MAX)).contains(&depth) {
                    continue;
                }
                for (v, u) in (y - SPLAT..=y + SPLAT)
                    .flat_map(|v| (x - SPLAT..=x + SPLAT).map(move |u| (v, u)))
                {
                    let distance = u.abs_diff(x).pow(2) + v.abs_diff(y).pow(2);
                    let pixel = v * width + u;
                    if distance < distances[pixel] {
                        (distances[pixel], depths[pixel]) = (distance, depth as u16);
                    }
                }
            }
        }
        depths
    }
}

/// Compares windows of two rectified images of one size.
struct Matcher<'a> {
    width: usize,
    left: &'a [f32],
    right: &'a [f32],
    /// Disparities, pixels.
    least: usize,
    most: usize,
}

impl Matcher<'_> {
    /// The pixel of a cell (left, top, right, bottom) whose window changes most along the row.
    fn most_textured(
        &self,
        (left, top, right, bottom): (usize, usize, usize, usize),
    ) -> Option<(usize, usize)> {
        let mut best = (LEAST_CONTRAST, None);
        for y in top..bottom {
            for x in left..right {
                let contrast =
                    (self.left[y * self.width + x + 1] - self.left[y * self.width + x - 1]).abs();
                if contrast > best.0 {
                    best = (contrast, Some((x, y)));
                }
            }
        }
        best.1
    }

    /// Disparity of a pixel of the left image, to a fraction of a pixel.
    fn disparity(&self, x: usize, y: usize) -> Option<f32> {
        let most = self.most.min(x.checked_sub(HALF_WIDTH)?);
        let costs: Vec<f32> = (self.least..=most).map(|d| self.cost((x, y), (x - d, y))).collect();
        let best = lowest(&costs)?;
        // At the ends of the range the minimum may lie outside.
        let (before, cost, after) =
            (*costs.get(best.checked_sub(1)?)?, *costs.get(best)?, *costs.get(best + 1)?);
        let rival = costs
            .iter()
            .enumerate()
            .filter(|(d, _)| d.abs_diff(best) > 1)
            .fold(f32::INFINITY, |rival, (_, cost)| rival.min(*cost));
        if cost > LARGEST_COST || rival < UNIQUENESS * cost {
            return None;
        }
        let disparity = self.least + best;
        let back = self.disparity_back(x - disparity, y)?;
        if back.abs_diff(disparity) > LARGEST_INCONSISTENCY {
            return None;
        }
        // The absolute difference of windows is a tent near its minimum.
        let steepest = (before - cost).max(after - cost);
        let fraction = if steepest > 0.0 { 0.5 * (before - after) / steepest } else { 0.0 };
        Some(disparity as f32 + fraction)
    }

    /// Disparity of a pixel of the right image.
    fn disparity_back(&self, x: usize, y: usize) -> Option<usize> {
        let room = self.width.checked_sub(x + HALF_WIDTH + 1)?;
        let costs: Vec<f32> =
            (self.least..=self.most.min(room)).map(|d| self.cost((x + d, y), (x, y))).collect();
        lowest(&costs).map(|best| self.least + best)
    }

    /// Mean absolute difference of two windows after their means have been taken off.
    fn cost(&self, (x, y): (usize, usize), (u, v): (usize, usize)) -> f32 {
        const PIXELS: f32 = ((2 * HALF_WIDTH + 1) * (2 * HALF_HEIGHT + 1)) as f32;
        let row = |image: &'_ [f32], x: usize, y: usize| -> [f32; 2 * HALF_WIDTH + 1] {
            let start = y * self.width + x - HALF_WIDTH;
            std::array::from_fn(|k| image[start + k])
        };
        let mut sum = 0.0;
        let mut differences = [[0.0; 2 * HALF_WIDTH + 1]; 2 * HALF_HEIGHT + 1];
        for (k, differences) in differences.iter_mut().enumerate() {
            let (a, b) =
                (row(self.left, x, y + k - HALF_HEIGHT), row(self.right, u, v + k - HALF_HEIGHT));
            for (difference, (a, b)) in differences.iter_mut().zip(a.iter().zip(b)) {
                *difference = a - b;
                sum += a - b;
            }
        }
        let mean = sum / PIXELS;
        differences.iter().flatten().map(|difference| (difference - mean).abs()).sum::<f32>()
            / PIXELS
    }
}

fn lowest(costs: &[f32]) -> Option<usize> {
    costs.iter().enumerate().min_by(|a, b| a.1.total_cmp(b.1)).map(|(index, _)| index)
}

/// Brightness by pixel, of 255.
fn grey(image: &ColorImage) -> Vec<f32> {
    let [r, g, b] = match image.format() {
        PixelFormat::Mono8 => return image.data().iter().map(|value| f32::from(*value)).collect(),
        PixelFormat::Rgb8 => [0.299, 0.587, 0.114],
        PixelFormat::Bgr8 => [0.114, 0.587, 0.299],
    };
    let pixels = image.data().as_chunks::<3>().0.iter();
    pixels.map(|[x, y, z]| r * f32::from(*x) + g * f32::from(*y) + b * f32::from(*z)).collect()
}

/// Bilinear; black outside.
fn remap(image: &[f32], (width, height): (usize, usize), map: &[Point2<f32>]) -> Vec<f32> {
    let sample = |pixel: &Point2<f32>| {
        let inside = pixel.x >= 0.0
            && pixel.y >= 0.0
            && pixel.x < width as f32 - 1.0
            && pixel.y < height as f32 - 1.0;
        if !inside {
            return 0.0;
        }
        let (x, y) = (pixel.x as usize, pixel.y as usize);
        let (fx, fy) = (pixel.x - x as f32, pixel.y - y as f32);
        let at = |x: usize, y: usize| image[y * width + x];
        (at(x, y) * (1.0 - fx) + at(x + 1, y) * fx) * (1.0 - fy)
            + (at(x, y + 1) * (1.0 - fx) + at(x + 1, y + 1) * fx) * fy
    };
    map.iter().map(sample).collect()
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    fn camera(x: f64, turn: Vector3<f64>) -> CameraConfig {
        let pose = Isometry3::new(Vector3::new(x, 0.0, 0.0), turn).to_homogeneous();
        CameraConfig {
            fx: 200.0,
            fy: 202.0,
            cx: 99.0,
            cy: 72.0,
            distortion: vec![-0.2, 0.05, 1e-3, -5e-4, 0.0],
            imu_from_camera: std::array::from_fn(|r| std::array::from_fn(|c| pose[(r, c)])),
            ..CameraConfig::default()
        }
    }

    fn rig() -> (CameraConfig, CameraConfig, StereoRig) {
        let left = camera(0.0, Vector3::new(0.01, -0.02, 0.005));
        let right = camera(0.12, Vector3::new(-0.01, 0.015, -0.01));
        let rig = StereoRig::new(&left, &right, (200, 150)).unwrap();
        (left, right, rig)
    }

    /// Smooth noise on the plane `z = 1.5 + 0.3 x` of the body frame.
    fn texture(x: f64, y: f64) -> f64 {
        let waves = [(23.0, 7.0, 0.3), (-11.0, 31.0, 1.1), (47.0, -19.0, 2.0), (61.0, 43.0, 0.7)];
        let sum: f64 = waves.iter().map(|(a, b, c)| (a * x + b * y + c).sin()).sum();
        128.0 + 28.0 * sum
    }

    const SLOPE: f64 = 0.3;
    const DEPTH: f64 = 1.5;

    /// What a camera sees of the plane.
    fn view(camera: &CameraConfig) -> ColorImage {
        let body_from_camera = camera.imu_from_camera().unwrap();
        let lens = Camera::new(camera).unwrap();
        let color = |row: i32, column: i32| {
            let pixel = Point2::new(f64::from(column), f64::from(row));
            let ray = body_from_camera.rotation * lens.unproject(pixel, 1.0).unwrap();
            let origin = body_from_camera.translation.vector;
            let distance = (DEPTH + SLOPE * origin.x - origin.z) / (ray.z - SLOPE * ray.x);
            let point = origin + ray * distance;
            texture(point.x, point.y).round().clamp(0.0, 255.0) as u8
        };
        let data =
            (0..150).flat_map(|row| (0..200).map(move |c| (row, c))).map(|(r, c)| color(r, c));
        ColorImage::new(200, 150, PixelFormat::Mono8, data.collect()).unwrap()
    }

    #[test]
    fn a_point_is_seen_in_the_same_row_by_both_cameras() {
        let (left, right, rig) = rig();
        let pinhole = rig.camera().intrinsics();
        let body_from_rectified = rig.camera().imu_from_camera().unwrap();
        for pixel in [Point2::new(100.0, 75.0), Point2::new(60.0, 40.0), Point2::new(150.0, 110.0)]
        {
            let depth = 2.0;
            let point =
                body_from_rectified * nalgebra::Point3::from(pinhole.unproject(pixel, depth));
            let seen = |camera: &CameraConfig| {
                let local = camera.imu_from_camera().unwrap().inverse() * point;
                Camera::new(camera).unwrap().project(&local.coords).unwrap()
            };
            let index = |pixel: Point2<f64>| pixel.y as usize * 200 + pixel.x as usize;
            assert_relative_eq!(rig.left[index(pixel)].cast(), seen(&left), epsilon = 1e-3);
            // The right camera sees it shifted by the disparity; between pixels, interpolated.
            let x = pixel.x - rig.focal_baseline() / depth;
            let (before, part) = (index(Point2::new(x.floor(), pixel.y)), (x - x.floor()) as f32);
            let expected = rig.right[before].coords.lerp(&rig.right[before + 1].coords, part);
            assert_relative_eq!(expected.cast(), seen(&right).coords, epsilon = 1e-2);
        }
    }

    #[test]
    fn depths_of_a_slanted_plane_are_within_the_law_of_the_disparity() {
        let (left, right, rig) = rig();
        let (color, depth) = rig.measure(&view(&left), &view(&right)).unwrap();
        assert_eq!((color.width(), color.height(), color.format()), (200, 150, PixelFormat::Mono8));
        let pinhole = rig.camera().intrinsics();
        let body_from_rectified = rig.camera().imu_from_camera().unwrap();
        let mut errors = Vec::new();
        for (row, column) in (0..150).flat_map(|row| (0..200).map(move |column| (row, column))) {
            let Some(measured) = depth.at(column, row) else { continue };
            let ray = body_from_rectified.rotation
                * pinhole.unproject(Point2::new(column as f64, row as f64), 1.0);
            let origin = body_from_rectified.translation.vector;
            let truth = (DEPTH + SLOPE * origin.x - origin.z) / (ray.z - SLOPE * ray.x);
            // In units of disparity.
            errors.push(rig.focal_baseline() * (1.0 / f64::from(measured) - 1.0 / truth));
        }
        assert!(errors.len() > 8000, "{}", errors.len());
        errors.sort_by(|a, b| a.abs().total_cmp(&b.abs()));
        let part = |percent: usize| errors[errors.len() * percent / 100].abs();
        assert!(part(68) < 0.25 && part(95) < 0.6, "{} {}", part(68), part(95));
    }

    #[test]
    fn ranges_of_wide_lenses_are_those_of_their_images_as_taken() {
        let wide = |camera: CameraConfig| CameraConfig {
            model: CameraModel::Equidistant,
            fx: 110.0,
            fy: 110.0,
            distortion: vec![0.003, 0.0007, -0.002, 0.0002],
            ..camera
        };
        let left = wide(camera(0.0, Vector3::new(0.01, -0.02, 0.005)));
        let right = wide(camera(0.12, Vector3::new(-0.01, 0.015, -0.01)));
        let rig = StereoRig::new(&left, &right, (200, 150)).unwrap();
        assert_eq!((rig.camera(), &rectified_camera(&left, &right).unwrap()), (&left, &left));
        let taken = view(&left);
        let (color, ranges) = rig.measure(&taken, &view(&right)).unwrap();
        assert_eq!(color, taken);
        let lens = Camera::new(&left).unwrap();
        let body_from_left = left.imu_from_camera().unwrap();
        let mut errors = Vec::new();
        for (row, column) in (0..150).flat_map(|row| (0..200).map(move |column| (row, column))) {
            let Some(measured) = ranges.at(column, row) else { continue };
            let bearing = lens.bearing(Point2::new(column as f64, row as f64)).unwrap();
            let ray = body_from_left.rotation * bearing.into_inner();
            let origin = body_from_left.translation.vector;
            let truth = (DEPTH + SLOPE * origin.x - origin.z) / (ray.z - SLOPE * ray.x);
            errors.push((f64::from(measured) / truth - 1.0).abs());
        }
        assert!(errors.len() > 2000, "{}", errors.len());
        errors.sort_by(f64::total_cmp);
        let part = |percent: usize| errors[errors.len() * percent / 100];
        assert!(part(50) < 0.03 && part(90) < 0.12, "{} {}", part(50), part(90));
    }

    #[test]
    fn images_without_texture_have_no_depth() {
        let (_, _, rig) = rig();
        let flat = ColorImage::new(200, 150, PixelFormat::Mono8, vec![90; 30_000]).unwrap();
        let (_, depth) = rig.measure(&flat, &flat).unwrap();
        assert!(depth.data().iter().all(|raw| *raw == 0));
        let small = ColorImage::new(2, 1, PixelFormat::Mono8, vec![9; 2]).unwrap();
        assert!(rig.measure(&small, &flat).is_none());
    }

    #[test]
    fn cameras_that_do_not_go_together_are_refused() {
        let (left, right, _) = rig();
        assert_eq!(StereoRig::new(&right, &left, (200, 150)).unwrap_err(), StereoError::Order);
        let error = StereoRig::new(&left, &left, (200, 150)).unwrap_err();
        assert!(matches!(error, StereoError::Baseline(_)));
        let error = StereoRig::new(&left, &right, (usize::MAX, 150)).unwrap_err();
        assert_eq!(error, StereoError::Size(usize::MAX, 150));
    }
}
