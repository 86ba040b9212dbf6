//! A frame, the camera that took it, and what is believed beforehand.

use nalgebra::{Isometry3, Point2, Vector3};

use super::config::TrackingConfig;
use super::shutter::{Shutter, given_pose};
use crate::inertial::Belief;
use crate::sensor::{Camera, RgbdFrame};
use crate::vision::{Extraction, PointMeasurement};

/// A frame after the front end.
#[derive(Debug)]
pub struct FrontEndFrame {
    pub frame: Box<RgbdFrame>,
    pub extraction: Extraction,
    /// Wall time that it took, s.
    pub seconds: f64,
}

impl FrontEndFrame {
    /// Width and height of the image, pixels.
    pub fn size(&self) -> (usize, usize) {
        (self.frame.color.width(), self.frame.color.height())
    }
}

/// What is believed before a frame is looked at.
#[derive(Debug, Clone, Copy)]
pub struct Prediction {
    pub belief: Belief,
    /// Angular velocity as last measured, body coordinates, rad/s; zero without an IMU.
    pub measured_rate: Vector3<f64>,
    pub body_from_camera: Isometry3<f64>,
    /// Whether an IMU carried the belief here.
    pub is_inertial: bool,
    /// Whether vision was lost before this frame.
    pub vision_lost: bool,
    /// Frames in which the map was seen.
    pub seeing_frames: u64,
}

impl Prediction {
    pub fn world_from_camera(&self) -> Isometry3<f64> {
        self.belief.state.world_from_body * self.body_from_camera
    }

    /// How the camera moves while it takes an image of so many rows: as the belief has it, or would
    /// have it if the camera were at `pose` (world from camera).
    pub fn shutter(
        &self,
        config: &TrackingConfig,
        rows: usize,
        pose: Option<&Isometry3<f64>>,
    ) -> Shutter {
        let body_from_camera = &self.body_from_camera;
        let given =
            pose.and_then(|pose| given_pose(&self.belief, &(pose * body_from_camera.inverse())));
        let state = given.unwrap_or(self.belief.state);
        Shutter::new(&config.camera, rows, body_from_camera, &state, &self.measured_rate)
    }
}

/// How the camera of a frame sees: its calibration, and its motion while rows are exposed.
#[derive(Debug, Clone, Copy)]
pub struct View<'a> {
    pub config: &'a TrackingConfig,
    pub camera: &'a Camera,
    pub body_from_camera: Isometry3<f64>,
    pub size: (usize, usize),
    pub shutter: Shutter,
    pub seed: u64,
}

impl<'a> View<'a> {
    /// Of a frame of this size (width and height in pixels), as the prediction has it. RANSAC draws
    /// by `seed`.
    pub fn predicted(
        config: &'a TrackingConfig,
        prediction: &Prediction,
        size: (usize, usize),
        seed: u64,
    ) -> Self {
        let (camera, body_from_camera) = (&config.lens, prediction.body_from_camera);
        let shutter = prediction.shutter(config, size.1, None);
        Self { config, camera, body_from_camera, size, shutter, seed }
    }

    /// Row of the image that shows what is at `pixel`.
    pub fn row(&self, pixel: Point2<f64>) -> f64 {
        pixel.y.clamp(0.0, self.size.1 as f64)
    }

    /// Pixel at which a point is seen that is at `in_camera` (m) at the stamp.
    pub fn project(&self, in_camera: &Vector3<f64>) -> Option<Point2<f64>> {
        let pixel = self.camera.project(in_camera)?;
        self.camera.project(&self.shutter.at_row(in_camera, self.row(pixel)))
    }

    /// A measurement of what is seen at `pixel`, moved to where that is at the stamp.
    pub fn at_stamp(&self, pixel: Point2<f64>, measured: PointMeasurement) -> PointMeasurement {
        let point = self.shutter.at_stamp(&measured.point, self.row(pixel));
        PointMeasurement { point, ..measured }
    }
}
