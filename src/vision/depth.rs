use nalgebra::{Matrix3, Point2, Vector2, Vector3};
use serde::{Deserialize, Serialize};

use crate::sensor::{DepthAlong, DepthImage};

/// Half the side of the window that a surface is fitted to, pixels.
const WINDOW_RADIUS: isize = 2;
/// Readings that the window of 25 must hold.
const MIN_READINGS: usize = 13;

/// Range and noise of the depth sensor.
///
/// The standard deviation at depth `d` is
/// `max(noise_floor, noise_quadratic d^2 + noise_linear d + noise_constant)`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DepthConfig {
    /// What the depth images hold: distance along the optical axis (`"axis"`), range along the ray
    /// (`"ray"`), or the one usual for the camera's model (`"auto"`).
    pub along: DepthAlong,
    /// Depths below this are not used, m.
    pub min: f64,
    /// Depths above this are not used, m.
    pub max: f64,
    /// Smallest standard deviation, m.
    pub noise_floor: f64,
    pub noise_quadratic: f64,
    pub noise_linear: f64,
    pub noise_constant: f64,
    /// Neighbours of a key point that differ by more than this fraction of its depth make it an
    /// edge, and its depth is not used.
    pub edge_fraction: f64,
}

impl Default for DepthConfig {
    /// The Kinect v1 law of Khoshelham and Elberink (2012): `1.425e-3 d^2` m.
    fn default() -> Self {
        Self {
            along: DepthAlong::Auto,
            min: 0.4,
            max: 5.0,
            noise_floor: 1.0e-3,
            noise_quadratic: 1.425e-3,
            noise_linear: 0.0,
            noise_constant: 0.0,
            edge_fraction: 0.04,
        }
    }
}

impl DepthConfig {
    /// Standard deviation (m) of a depth reading `depth` (m).
    pub fn standard_deviation(&self, depth: f64) -> f64 {
        let polynomial =
            (self.noise_quadratic * depth + self.noise_linear) * depth + self.noise_constant;
        polynomial.max(self.noise_floor)
    }
}

/// Depth at a point of the image, and how it changes around it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthReading {
    /// Along the optical axis or the ray, as the camera measures it, m.
    pub depth: f64,
    /// Change of depth by column and by row, m/pixel.
    pub slope: Vector2<f64>,
    /// Of `depth` given the pixel, m.
    pub standard_deviation: f64,
}

impl DepthConfig {
    /// Depth at `pixel`, from a plane through the readings around it; planes are linear in
    /// inverse depth.
    ///
    /// The standard deviation is that of a single reading, because the errors of neighbours
    /// come from the same matching window and do not average out; where the surface is rougher
    /// than the sensor, that of the residuals. `None` at holes, depth edges, out of range, and
    /// where too few neighbours have a reading.
    pub fn read(&self, image: &DepthImage, pixel: Point2<f64>) -> Option<DepthReading> {
        let inside = |x: f64, size: usize| x > -0.5 && x < size as f64 - 0.5;
        if !(inside(pixel.x, image.width()) && inside(pixel.y, image.height())) {
            return None;
        }
        let (column, row) = (pixel.x.round() as isize, pixel.y.round() as isize);
        let at = |dx: isize, dy: isize| {
            let (x, y) = (column.checked_add(dx)?, row.checked_add(dy)?);
            image.at(usize::try_from(x).ok()?, usize::try_from(y).ok()?).map(f64::from)
        };
        let centre = at(0, 0)?;
        if !(self.min..=self.max).contains(&centre) {
            return None;
        }

        let mut fit = PlaneFit::default();
        for dy in -WINDOW_RADIUS..=WINDOW_RADIUS {
            for dx in -WINDOW_RADIUS..=WINDOW_RADIUS {
                let Some(depth) = at(dx, dy) else { continue };
                if (depth - centre).abs() > self.edge_fraction * centre {
                    return None;
                }
                let offset = Vector2::new((column + dx) as f64, (row + dy) as f64) - pixel.coords;
                fit.add(offset, depth.recip());
            }
        }
        let (plane, rms) = fit.solve()?;
        let depth = plane.x.recip();
        let derivative = -depth * depth;
        let sensor = self.standard_deviation(depth);
        (self.min..=self.max).contains(&depth).then(|| DepthReading {
            depth,
            slope: plane.yz() * derivative,
            standard_deviation: sensor.max(rms * derivative.abs()),
        })
    }
}

/// Least squares for `value = a + b x + c y`.
#[derive(Default)]
struct PlaneFit {
    count: usize,
    normal: Matrix3<f64>,
    right: Vector3<f64>,
    squares: f64,
}

impl PlaneFit {
    fn add(&mut self, offset: Vector2<f64>, value: f64) {
        let row = Vector3::new(1.0, offset.x, offset.y);
        self.count += 1;
        self.normal += row * row.transpose();
        self.right += row * value;
        self.squares += value * value;
    }

    /// `(a, b, c)` and the root mean square residual.
    fn solve(&self) -> Option<(Vector3<f64>, f64)> {
        if self.count < MIN_READINGS {
            return None;
        }
        let plane = self.normal.cholesky()?.solve(&self.right);
        let residual = (self.squares - plane.dot(&self.right)).max(0.0);
        let rms = (residual / (self.count - 3) as f64).sqrt();
        (plane.x > 0.0 && plane.iter().all(|x| x.is_finite())).then_some((plane, rms))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SCALE: f32 = 1e-4;

    /// Depth image of `depth(column, row)` in metres.
    fn image(width: usize, height: usize, depth: impl Fn(f64, f64) -> f64) -> DepthImage {
        let cells = (0..height).flat_map(|y| (0..width).map(move |x| (x as f64, y as f64)));
        let data = cells.map(|(x, y)| (depth(x, y) / f64::from(SCALE)).round() as u16).collect();
        DepthImage::new(width, height, SCALE, data).unwrap()
    }

    proptest! {
        #[test]
        fn a_slanted_plane_is_read_between_pixels(
            x in 3.0..28.0f64, y in 3.0..28.0f64,
            b in -0.002..0.002f64, c in -0.002..0.002f64,
        ) {
            let depth = |x: f64, y: f64| (0.6 + b * (x - 15.0) + c * (y - 15.0)).recip();
            let read = DepthConfig::default().read(&image(32, 32, depth), Point2::new(x, y));
            let read = read.unwrap();
            let truth = depth(x, y);
            prop_assert!((read.depth - truth).abs() < 1e-4, "{} {truth}", read.depth);
            let slope = Vector2::new(b, c) * -truth * truth;
            prop_assert!((read.slope - slope).norm() < 1e-4);
        }

        #[test]
        fn no_pixel_panics(x in proptest::num::f64::ANY, y in proptest::num::f64::ANY) {
            let image = image(7, 5, |_, _| 1.0);
            if let Some(read) = DepthConfig::default().read(&image, Point2::new(x, y)) {
                prop_assert!((read.depth - 1.0).abs() < 1e-3);
            }
        }
    }

    #[test]
    fn edges_holes_and_far_things_have_no_depth() {
        let config = DepthConfig::default();
        let step = image(32, 32, |x, _| if x < 16.0 { 1.0 } else { 1.1 });
        assert!(config.read(&step, Point2::new(16.0, 16.0)).is_none());
        assert!(config.read(&step, Point2::new(14.4, 16.0)).is_none());
        assert!(config.read(&step, Point2::new(13.4, 16.0)).is_some());

        let hole = image(32, 32, |x, y| if x == 16.0 && y == 16.0 { 0.0 } else { 1.0 });
        assert!(config.read(&hole, Point2::new(16.0, 16.0)).is_none());
        assert!(config.read(&hole, Point2::new(17.0, 16.0)).is_some());

        let sparse = image(32, 32, |x, _| if x < 16.0 { 1.0 } else { 0.0 });
        assert!(config.read(&sparse, Point2::new(15.0, 16.0)).is_some(), "15 readings");
        assert!(config.read(&sparse, Point2::new(0.0, 16.0)).is_some(), "15 readings");
        assert!(config.read(&sparse, Point2::new(0.0, 0.0)).is_none(), "9 readings");

        for depth in [0.39, 5.1] {
            assert!(config.read(&image(9, 9, |_, _| depth), Point2::new(4.0, 4.0)).is_none());
        }
        assert!(config.read(&image(1, 1, |_, _| 1.0), Point2::origin()).is_none());
    }

    #[test]
    fn roughness_raises_the_standard_deviation() {
        let rough = image(9, 9, |x, y| if (x + y) % 2.0 == 0.0 { 1.015 } else { 0.985 });
        let config = DepthConfig::default();
        let read = config.read(&rough, Point2::new(4.0, 4.0)).unwrap();
        assert!(read.standard_deviation > 0.014 && read.standard_deviation < 0.018);
        let smooth = config.read(&image(9, 9, |_, _| 1.0), Point2::new(4.0, 4.0)).unwrap();
        assert_eq!(smooth.standard_deviation, config.standard_deviation(smooth.depth));
    }
}
