//! Depth images of a camera beside the color camera, as the color camera would see them.

use nalgebra::{Isometry3, Point2};

use crate::sensor::{Camera, CameraConfig, DepthImage, PinholeCamera};

/// How depth images are brought to the color camera.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthRegistration {
    /// Of the depth images, which are without distortion.
    pub depth_camera: PinholeCamera,
    /// Of the color images as they are logged, of any model.
    pub color_camera: CameraConfig,
    pub color_from_depth: Isometry3<f64>,
    /// Width and height of the color images.
    pub color_size: (usize, usize),
}

/// A pixel of the depth image covers at most so many pixels of the color image along a side.
const LARGEST_BOX: f64 = 64.0;

impl DepthRegistration {
    /// The depth image registered pixel for pixel to the color image; `None` if the size or
    /// the calibration of the color image is none.
    ///
    /// Each pixel of `depth` covers in the color image the box around its projected corners, all at
    /// its own depth; where several meet the nearest wins. (So does librealsense's `align`.) Depths
    /// beyond the range of the image's unit are dropped. Linear in the pixels of `depth` and in
    /// those that are covered.
    pub fn apply(&self, depth: &DepthImage) -> Option<DepthImage> {
        let (width, height) = self.color_size;
        let lens = Camera::new(&self.color_camera).ok()?;
        let mut registered = vec![0_u16; width.checked_mul(height)?];
        let scale = f64::from(depth.scale());
        for (index, raw) in depth.data().iter().enumerate().filter(|(_, raw)| **raw != 0) {
            let (column, row) = (index % depth.width(), index / depth.width());
            let distance = f64::from(*raw) * scale;
            let corners = [-0.5, 0.5].map(|side| {
                let corner = Point2::new(column as f64 + side, row as f64 + side);
                self.color_from_depth
                    * nalgebra::Point3::from(self.depth_camera.unproject(corner, distance))
            });
            let [Some(first), Some(second)] = corners.map(|point| lens.project(&point.coords))
            else {
                continue;
            };
            // Boxes of points that all but touch the color camera would cover all of its image.
            if (first - second).amax() > LARGEST_BOX {
                continue;
            }
            let depths = corners.map(|point| lens.depth_of(&point.coords));
            let units = ((depths[0] + depths[1]) / 2.0 / scale).round();
            if !(units >= 1.0 && units <= f64::from(u16::MAX)) {
                continue;
            }
            let columns = covered(first.x, second.x, width);
            for row in covered(first.y, second.y, height) {
                for pixel in &mut registered[row * width..][columns.clone()] {
                    let nearest = if *pixel == 0 { u16::MAX } else { *pixel };
                    *pixel = nearest.min(units as u16);
                }
            }
        }
        DepthImage::new(width, height, depth.scale(), registered)
    }
}

/// Pixels whose centres are between two borders; at least the one nearest to their middle.
fn covered(first: f64, second: f64, count: usize) -> std::ops::Range<usize> {
    let (low, high) = (first.min(second), first.max(second));
    let middle = ((low + high) / 2.0).round();
    let from = low.ceil().min(middle).max(0.0);
    // A centre on the border between two pixels belongs to the second one.
    let to = high.ceil().max(middle + 1.0).min(count as f64);
    if from >= to || from.is_nan() || to.is_nan() {
        return 0..0;
    }
    from as usize..to as usize
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;

    fn registration(scale: f64, size: (usize, usize)) -> DepthRegistration {
        let depth_camera = PinholeCamera { fx: 50.0, fy: 50.0, cx: 19.5, cy: 14.5 };
        let color_camera = CameraConfig {
            fx: 50.0 * scale,
            fy: 50.0 * scale,
            cx: (19.5 + 0.5) * scale - 0.5,
            cy: (14.5 + 0.5) * scale - 0.5,
            ..CameraConfig::default()
        };
        DepthRegistration {
            depth_camera,
            color_camera,
            color_from_depth: Isometry3::identity(),
            color_size: size,
        }
    }

    fn image((width, height): (usize, usize), at: impl Fn(usize, usize) -> u16) -> DepthImage {
        let data = (0..width * height).map(|i| at(i % width, i / width)).collect();
        DepthImage::new(width, height, 0.001, data).unwrap()
    }

    #[test]
    fn the_same_camera_changes_nothing_and_a_finer_one_repeats_pixels() {
        let depth = image((40, 30), |column, row| (1000 + 10 * column + row) as u16);
        assert_eq!(registration(1.0, (40, 30)).apply(&depth).unwrap(), depth);
        let finer = registration(2.0, (80, 60)).apply(&depth).unwrap();
        let repeated = image((80, 60), |c, r| (1000 + 10 * (c / 2) + r / 2) as u16);
        assert_eq!(finer, repeated);
        let coarser = registration(0.5, (20, 15)).apply(&depth).unwrap();
        assert!(coarser.data().iter().all(|raw| *raw > 0));
    }

    /// A plane, seen by two cameras that look at it from different places and directions: what the
    /// second one would measure is known in closed form.
    #[test]
    fn a_plane_is_where_the_color_camera_sees_it() {
        let turn = UnitQuaternion::from_euler_angles(0.02, -0.03, 0.05);
        let color_from_depth = Isometry3::from_parts(Vector3::new(-0.06, 0.01, 0.02).into(), turn);
        let distortion = vec![0.05, -0.03, 0.001, -0.002, 0.0];
        let plain = registration(2.0, (80, 60));
        let color_camera = CameraConfig { distortion, ..plain.color_camera.clone() };
        let registration = DepthRegistration { color_from_depth, color_camera, ..plain };
        // The plane n . p = d of the depth camera.
        let (normal, d) = (Vector3::new(0.1, -0.2, 1.0).normalize(), 2.0);
        let depth = image((40, 30), |column, row| {
            let pixel = Point2::new(column as f64, row as f64);
            let ray = registration.depth_camera.unproject(pixel, 1.0);
            (d / normal.dot(&ray) * 1000.0).round() as u16
        });
        let registered = registration.apply(&depth).unwrap();
        let color_normal = color_from_depth.rotation * normal;
        let color_d = d + color_normal.dot(&color_from_depth.translation.vector);
        let pinhole = registration.color_camera.intrinsics();
        let lens = Camera::new(&registration.color_camera).unwrap();
        let mut checked = 0;
        for row in 0..60 {
            for column in 0..80 {
                let ideal = Point2::new(column as f64, row as f64);
                let ray = pinhole.unproject(ideal, 1.0);
                let pixel = lens.project(&ray).unwrap();
                let (c, r) = (pixel.x.round() as usize, pixel.y.round() as usize);
                let Some(measured) = registered.at(c, r) else { continue };
                let expected = color_d / color_normal.dot(&ray);
                // A pixel of the depth camera and the plane's slope.
                assert!((f64::from(measured) - expected).abs() < 0.01, "{measured} {expected}");
                checked += 1;
            }
        }
        assert!(checked > 3800, "{checked}");
    }

    #[test]
    fn the_nearer_surface_hides_the_other() {
        // A near object at the left half, seen from 0.2 m to the right of the depth camera.
        let depth = image((40, 30), |column, _| if column < 20 { 500 } else { 2000 });
        let moved = DepthRegistration {
            color_from_depth: Isometry3::translation(0.1, 0.0, 0.0),
            ..registration(1.0, (40, 30))
        };
        let registered = moved.apply(&depth).unwrap();
        // 0.1 m is 10 pixels at 0.5 m, 2.5 pixels at 2 m: the object now ends at column 29.5.
        assert_eq!(registered.at(28, 15), Some(0.5));
        assert_eq!(registered.at(31, 15), Some(2.0));
        assert_eq!(registered.at(2, 15), None);
    }

    #[test]
    fn what_is_behind_or_out_of_range_is_left_out() {
        let depth = image((40, 30), |_, _| 1000);
        let behind = DepthRegistration {
            color_from_depth: Isometry3::translation(0.0, 0.0, -1.5),
            ..registration(1.0, (40, 30))
        };
        assert!(behind.apply(&depth).unwrap().data().iter().all(|raw| *raw == 0));
        let far = DepthRegistration {
            color_from_depth: Isometry3::translation(0.0, 0.0, 70.0),
            ..registration(1.0, (40, 30))
        };
        assert!(far.apply(&depth).unwrap().data().iter().all(|raw| *raw == 0));
        assert_eq!(registration(1.0, (0, 30)).apply(&depth), None);
    }
}
