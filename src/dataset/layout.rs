//! Topics, frames and encodings of logs that are written: this program's own, or those of the ROS
//! drivers of common devices.

use nalgebra::{Isometry3, Matrix3, Rotation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::sensor::PixelFormat;

/// As whose recording a log is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Layout {
    /// The names of this program, with its notes on configuration and calibration.
    #[default]
    Own,
    /// Intel RealSense D435i by `realsense2_camera`, depth aligned to color, united IMU.
    D435i,
    /// Luxonis OAK-D by `depthai_ros_driver`.
    OakD,
    /// Stereolabs ZED by `zed_wrapper`, which sends the mounting of the IMU on `/tf`.
    Zed,
    /// Azure Kinect by `azure_kinect_ros_driver`.
    AzureKinect,
    /// Structure Core by the driver of its SDK.
    StructureCore,
}

/// What tells one layout from another.
#[derive(Debug, Clone, Copy)]
pub(super) struct Names {
    pub color: &'static str,
    pub color_info: &'static str,
    pub color_format: ColorFormat,
    pub depth: &'static str,
    /// Calibration of the depth image, which is that of color.
    pub depth_info: Option<&'static str>,
    pub depth_in_metres: bool,
    pub imu: &'static str,
    /// Frames of the images and of the IMU.
    pub camera_frame: &'static str,
    pub imu_frame: &'static str,
    /// Frame that both are fixed to; none: the camera is fixed to the IMU.
    pub link: Option<Link>,
    /// Distortion model and number of coefficients.
    pub model: (&'static str, usize),
    /// Whether the mounting of the IMU is sent again and again on `/tf`.
    pub imu_on_tf: bool,
}

/// The tree of a device's frames.
#[derive(Debug, Clone, Copy)]
pub(super) struct Link {
    pub frame: &'static str,
    /// Between the link and the optical frame of the camera, with axes forward, left, up.
    pub camera: &'static str,
    /// Between the link and the frame of the IMU, if that is an optical one.
    pub imu: Option<&'static str>,
}

/// Order of the bytes of a color image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ColorFormat {
    /// As the image is.
    Own,
    Bgr8,
    Bgra8,
}

const OWN: Names = Names {
    color: "/cam0/color",
    color_info: "/cam0/camera_info",
    color_format: ColorFormat::Own,
    depth: "/cam0/depth",
    depth_info: None,
    depth_in_metres: false,
    imu: "/imu",
    camera_frame: "camera",
    imu_frame: "imu",
    link: None,
    model: ("plumb_bob", 5),
    imu_on_tf: false,
};

impl Layout {
    pub(super) fn names(self) -> Names {
        match self {
            Self::Own => OWN,
            Self::D435i => Names {
                color: "/camera/camera/color/image_raw",
                color_info: "/camera/camera/color/camera_info",
                depth: "/camera/camera/aligned_depth_to_color/image_raw",
                depth_info: Some("/camera/camera/aligned_depth_to_color/camera_info"),
                imu: "/camera/camera/imu",
                camera_frame: "camera_color_optical_frame",
                imu_frame: "camera_imu_optical_frame",
                link: Some(Link {
                    frame: "camera_link",
                    camera: "camera_color_frame",
                    imu: Some("camera_imu_frame"),
                }),
                ..OWN
            },
            Self::OakD => Names {
                color: "/oak/rgb/image_raw",
                color_info: "/oak/rgb/camera_info",
                color_format: ColorFormat::Bgr8,
                depth: "/oak/stereo/image_raw",
                depth_info: Some("/oak/stereo/camera_info"),
                imu: "/oak/imu/data",
                camera_frame: "oak_rgb_camera_optical_frame",
                imu_frame: "oak_imu_frame",
                link: Some(Link { frame: "oak", camera: "oak_rgb_camera_frame", imu: None }),
                model: ("rational_polynomial", 8),
                ..OWN
            },
            Self::Zed => Names {
                color: "/zed/zed_node/rgb/image_rect_color",
                color_info: "/zed/zed_node/rgb/camera_info",
                color_format: ColorFormat::Bgra8,
                depth: "/zed/zed_node/depth/depth_registered",
                depth_info: Some("/zed/zed_node/depth/camera_info"),
                depth_in_metres: true,
                imu: "/zed/zed_node/imu/data",
                camera_frame: "zed_left_camera_optical_frame",
                imu_frame: "zed_imu_link",
                link: Some(Link {
                    frame: "zed_camera_center",
                    camera: "zed_left_camera_frame",
                    imu: None,
                }),
                imu_on_tf: true,
                ..OWN
            },
            Self::AzureKinect => Names {
                color: "/rgb/image_raw",
                color_info: "/rgb/camera_info",
                color_format: ColorFormat::Bgra8,
                depth: "/depth_to_rgb/image_raw",
                depth_info: Some("/depth_to_rgb/camera_info"),
                camera_frame: "rgb_camera_link",
                imu_frame: "imu_frame",
                // Its links have the axes of the cameras.
                link: None,
                model: ("rational_polynomial", 8),
                ..OWN
            },
            Self::StructureCore => Names {
                color: "/sc/rgb/image",
                color_info: "/sc/rgb/camera_info",
                depth: "/sc/depth_aligned/image",
                depth_info: Some("/sc/depth_aligned/camera_info"),
                depth_in_metres: true,
                imu: "/sc/imu/imu_msg",
                camera_frame: "sc_rgb_optical_frame",
                imu_frame: "sc_imu_frame",
                link: Some(Link { frame: "sc_link", camera: "sc_rgb_frame", imu: None }),
                ..OWN
            },
        }
    }
}

/// A transform with the names of parent and child.
pub(super) type NamedTransform = ([&'static str; 2], Isometry3<f64>);

impl Names {
    /// The transforms by which the mounting of the camera is told, and which of them go out on
    /// `/tf`, the rest on `/tf_static`.
    pub fn mounting(&self, imu_from_camera: &Isometry3<f64>) -> Vec<(NamedTransform, bool)> {
        let Some(link) = self.link else {
            return vec![(([self.imu_frame, self.camera_frame], *imu_from_camera), false)];
        };
        // A centimetre or two between link and camera, as in the devices.
        let link_from_body = Isometry3::translation(0.0, 0.015, 0.0);
        let link_from_camera = link_from_body * body_from_optical();
        let link_from_imu = link_from_camera * imu_from_camera.inverse();
        let mut all = vec![
            (([link.frame, link.camera], link_from_body), false),
            (([link.camera, self.camera_frame], body_from_optical()), false),
        ];
        match link.imu {
            Some(body) => {
                let body_from_imu = body_from_optical();
                let link_from_imu_body = link_from_imu * body_from_imu.inverse();
                all.push((([link.frame, body], link_from_imu_body), false));
                all.push((([body, self.imu_frame], body_from_imu), false));
            }
            None => all.push((([link.frame, self.imu_frame], link_from_imu), self.imu_on_tf)),
        }
        all
    }
}

/// From the axes of a camera (right, down, forward) to those of a body (forward, left, up):
/// REP 103.
fn body_from_optical() -> Isometry3<f64> {
    let matrix = Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0);
    let rotation = Rotation3::from_matrix_unchecked(matrix);
    let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
    Isometry3::from_parts(Vector3::zeros().into(), rotation)
}

impl ColorFormat {
    /// Encoding and bytes of an image of three channels in `format`.
    pub fn encode(self, format: PixelFormat, data: &[u8]) -> Option<(&'static str, Vec<u8>)> {
        let swap = match format {
            PixelFormat::Rgb8 => true,
            PixelFormat::Bgr8 => false,
            PixelFormat::Mono8 => return None,
        };
        let bgr = |pixel: &[u8]| match (swap, pixel) {
            (true, [r, g, b]) => [*b, *g, *r],
            (_, [b, g, r]) => [*b, *g, *r],
            _ => [0; 3],
        };
        let pixels = data.chunks_exact(3).map(bgr);
        match self {
            Self::Own => None,
            Self::Bgr8 => Some(("bgr8", pixels.flatten().collect())),
            Self::Bgra8 => Some(("bgra8", pixels.flat_map(|[b, g, r]| [b, g, r, 255]).collect())),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [Layout; 6] = [
        Layout::Own,
        Layout::D435i,
        Layout::OakD,
        Layout::Zed,
        Layout::AzureKinect,
        Layout::StructureCore,
    ];

    #[test]
    fn every_tree_leads_from_the_camera_to_the_imu() {
        let mounted = Isometry3::from_parts(
            Vector3::new(0.01, -0.02, 0.03).into(),
            UnitQuaternion::from_euler_angles(0.3, -0.2, 1.1),
        );
        for layout in ALL {
            let names = layout.names();
            let transforms = names.mounting(&mounted);
            // Up from both frames to the common one.
            let up = |frame: &str| {
                let (mut here, mut total) = (frame.to_owned(), Isometry3::identity());
                while let Some((([parent, _], step), _)) =
                    transforms.iter().find(|(([_, child], _), _)| *child == here)
                {
                    total = step * total;
                    (*parent).clone_into(&mut here);
                }
                (here, total)
            };
            let ((root, camera), (other, imu)) = (up(names.camera_frame), up(names.imu_frame));
            assert_eq!(root, other, "{layout:?}");
            let found = imu.inverse() * camera;
            assert!(
                (found.to_homogeneous() - mounted.to_homogeneous()).norm() < 1e-12,
                "{layout:?}"
            );
        }
    }

    #[test]
    fn optical_axes_are_those_of_the_convention() {
        let forward = body_from_optical() * Vector3::z();
        assert!((forward - Vector3::x()).norm() < 1e-12, "{forward}");
        let left = body_from_optical() * -Vector3::x();
        assert!((left - Vector3::y()).norm() < 1e-12, "{left}");
    }

    #[test]
    fn colors_keep_their_places() {
        let encode = |format: ColorFormat, pixels| format.encode(pixels, &[1, 2, 3]).unwrap();
        assert_eq!(encode(ColorFormat::Bgr8, PixelFormat::Rgb8), ("bgr8", vec![3, 2, 1]));
        assert_eq!(encode(ColorFormat::Bgra8, PixelFormat::Bgr8), ("bgra8", vec![1, 2, 3, 255]));
        assert!(ColorFormat::Own.encode(PixelFormat::Rgb8, &[1, 2, 3]).is_none());
    }
}
