//! Views of other lenses as a pinhole would have them: a viewer projects by pinholes only.
//!
//! For display alone. The estimator works on images as taken; of a view of 180 degrees a pinhole
//! shows the middle.

use nalgebra::{Point2, Vector3};

use crate::odometry::KeypointView;
use crate::sensor::{Camera, ColorImage, DepthImage, PinholeCamera};

/// Half the widest angle that is shown, rad: wider ones leave little in the middle.
const WIDEST: f64 = 1.05;

/// Turns images and key points of a camera into those of a pinhole.
pub(super) struct Display {
    camera: Camera,
    pinhole: PinholeCamera,
    width: usize,
    /// By pixel shown: index of the pixel as taken, and the factor from its depth to that shown.
    sources: Vec<Option<(u32, f32)>>,
}

impl Display {
    /// `None` for a pinhole, whose images are shown as they are.
    pub fn new(camera: &Camera, [width, height]: [usize; 2]) -> Option<Self> {
        if camera.is_pinhole() && !camera.measures_range() {
            return None;
        }
        let pinhole = shown(camera, width, height);
        let source = |row: usize, column: usize| {
            let ray = pinhole.unproject(Point2::new(column as f64, row as f64), 1.0);
            let taken = camera.project(&ray)?.coords.map(f64::round);
            let inside = taken.x >= 0.0
                && taken.y >= 0.0
                && taken.x < width as f64
                && taken.y < height as f64;
            let index = || (taken.y as usize * width + taken.x as usize) as u32;
            inside.then(|| (index(), camera.depth_of(&ray).recip() as f32))
        };
        let pixels = (0..height).flat_map(|row| (0..width).map(move |column| (row, column)));
        let sources = pixels.map(|(row, column)| source(row, column)).collect();
        Some(Self { camera: *camera, pinhole, width, sources })
    }

    pub fn camera(&self) -> Camera {
        Camera::pinhole(self.pinhole)
    }

    /// `None` if the image is not of the size that was stated.
    pub fn color(&self, image: &ColorImage) -> Option<ColorImage> {
        let channels = image.format().channels();
        let mut data = Vec::with_capacity(channels * self.sources.len());
        for source in &self.sources {
            match source {
                Some((index, _)) => {
                    let start = *index as usize * channels;
                    data.extend_from_slice(image.data().get(start..start + channels)?);
                }
                None => data.resize(data.len() + channels, 0),
            }
        }
        ColorImage::new(self.width, self.sources.len() / self.width, image.format(), data)
    }

    /// `z` of what is seen; `None` if the image is not of the size that was stated.
    pub fn depth(&self, image: &DepthImage) -> Option<DepthImage> {
        let raw = |source: &Option<(u32, f32)>| match source {
            Some((index, factor)) => {
                let raw = image.data().get(*index as usize)?;
                Some((f32::from(*raw) * factor).round() as u16)
            }
            None => Some(0),
        };
        let data = self.sources.iter().map(raw).collect::<Option<Vec<_>>>()?;
        DepthImage::new(self.width, self.sources.len() / self.width, image.scale(), data)
    }

    /// Those that the pinhole sees.
    pub fn keypoints(&self, keypoints: &[KeypointView]) -> Vec<KeypointView> {
        let shown = |[x, y]: [f32; 2]| {
            let bearing = self.camera.bearing(Point2::new(x.into(), y.into()))?;
            let pixel = self.pinhole.project(&bearing)?;
            Some([pixel.x as f32, pixel.y as f32])
        };
        let view = |keypoint: &KeypointView| {
            let pixel = shown(keypoint.pixel)?;
            Some(KeypointView { pixel, predicted: keypoint.predicted.and_then(shown), ..*keypoint })
        };
        keypoints.iter().filter_map(view).collect()
    }
}

/// The camera's own focal length where its view is narrow; else one that shows up to [`WIDEST`].
fn shown(camera: &Camera, width: usize, height: usize) -> PinholeCamera {
    let own = *camera.intrinsics();
    let (right, bottom) = (width as f64 - 1.0, height as f64 - 1.0);
    let sides = [
        Point2::new(0.0, own.cy),
        Point2::new(right, own.cy),
        Point2::new(own.cx, 0.0),
        Point2::new(own.cx, bottom),
    ];
    let angle = |side: Point2<f64>| {
        camera.bearing(side).map_or(f64::INFINITY, |bearing| bearing.angle(&Vector3::z()))
    };
    let widest = sides.into_iter().map(angle).fold(0.0, f64::max);
    if widest <= WIDEST {
        return own;
    }
    let (cx, cy) = (0.5 * right, 0.5 * bottom);
    let focal = cx.max(cy) / WIDEST.tan();
    PinholeCamera { fx: focal, fy: focal, cx, cy }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::odometry::KeypointRole;
    use crate::sensor::{CameraConfig, CameraModel, PixelFormat};

    const SIZE: [usize; 2] = [161, 121];

    fn fisheye() -> Camera {
        let config = CameraConfig {
            model: CameraModel::Equidistant,
            fx: 45.0,
            fy: 45.0,
            cx: 80.0,
            cy: 60.0,
            distortion: vec![0.0; 4],
            ..CameraConfig::default()
        };
        Camera::new(&config).unwrap()
    }

    #[test]
    fn a_wall_seen_by_a_fisheye_is_as_deep_everywhere() {
        let (camera, [width, height]) = (fisheye(), SIZE);
        let range = |index: usize| {
            let pixel = Point2::new((index % width) as f64, (index / width) as f64);
            let bearing = camera.bearing(pixel).unwrap();
            if bearing.z > 0.2 { (1000.0 / bearing.z) as u16 } else { 0 }
        };
        let data = (0..width * height).map(range).collect();
        let taken = DepthImage::new(width, height, 0.001, data).unwrap();
        let display = Display::new(&camera, SIZE).unwrap();
        let shown = display.depth(&taken).unwrap();
        for raw in shown.data() {
            // A pixel of the fisheye covers up to a tenth of the depth at the rim of the view.
            assert!(raw.abs_diff(1000) < 100, "{raw}");
        }
    }

    #[test]
    fn key_points_stay_on_what_they_are_of() {
        let (camera, [width, height]) = (fisheye(), SIZE);
        let mut data = vec![0; width * height];
        data[45 * width + 100] = 255;
        let taken = ColorImage::new(width, height, PixelFormat::Mono8, data).unwrap();
        let display = Display::new(&camera, SIZE).unwrap();
        let shown = display.color(&taken).unwrap();
        let view = |pixel| KeypointView {
            pixel,
            predicted: None,
            point: None,
            role: KeypointRole::Unmatched,
        };
        let found = display.keypoints(&[view([100.0, 45.0]), view([2.0, 60.0])]);
        let [only] = &found[..] else { panic!("what is at 100 degrees is not shown: {found:?}") };
        let [x, y] = only.pixel.map(|x| x.round() as usize);
        assert_eq!(shown.data()[y * width + x], 255);
    }

    #[test]
    fn pinholes_are_shown_as_they_are() {
        let pinhole = Camera::pinhole(*fisheye().intrinsics());
        assert!(Display::new(&pinhole, SIZE).is_none());
    }
}
