//! ROS 2 messages as they are written: their fields in order, and the text of their definitions.

use nalgebra::{Isometry3, Quaternion, UnitQuaternion, Vector3};
use serde::{Serialize, Serializer};

use super::message::MessageType;
use crate::sensor::{CameraConfig, CameraModel, ColorImage, Stamp};

#[derive(Serialize)]
pub struct Header {
    seconds: i32,
    nanoseconds: u32,
    frame_id: &'static str,
}

impl Header {
    pub fn new(stamp: Stamp, frame_id: &'static str) -> Self {
        let nanos = stamp.nanos();
        Self {
            seconds: nanos.div_euclid(1_000_000_000) as i32,
            nanoseconds: nanos.rem_euclid(1_000_000_000) as u32,
            frame_id,
        }
    }
}

/// A sequence of bytes, written in one piece.
pub struct Bytes<'a>(pub &'a [u8]);

impl Serialize for Bytes<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_bytes(self.0)
    }
}

#[derive(Serialize)]
pub struct Image<'a> {
    pub header: Header,
    pub height: u32,
    pub width: u32,
    pub encoding: &'static str,
    pub is_bigendian: u8,
    pub step: u32,
    pub data: Bytes<'a>,
}

#[derive(Serialize)]
pub struct Vector {
    x: f64,
    y: f64,
    z: f64,
}

impl From<Vector3<f64>> for Vector {
    fn from(v: Vector3<f64>) -> Self {
        Self { x: v.x, y: v.y, z: v.z }
    }
}

#[derive(Serialize)]
pub struct Orientation {
    x: f64,
    y: f64,
    z: f64,
    w: f64,
}

impl From<UnitQuaternion<f64>> for Orientation {
    fn from(q: UnitQuaternion<f64>) -> Self {
        let q: Quaternion<f64> = q.into_inner();
        Self { x: q.i, y: q.j, z: q.k, w: q.w }
    }
}

/// `Pose` and `Transform` alike: a vector, then a quaternion.
#[derive(Serialize)]
pub struct Transform {
    translation: Vector,
    rotation: Orientation,
}

impl From<&Isometry3<f64>> for Transform {
    fn from(isometry: &Isometry3<f64>) -> Self {
        Self { translation: isometry.translation.vector.into(), rotation: isometry.rotation.into() }
    }
}

#[derive(Serialize)]
pub struct Imu {
    pub header: Header,
    pub orientation: Orientation,
    pub orientation_covariance: [f64; 9],
    pub angular_velocity: Vector,
    pub angular_velocity_covariance: [f64; 9],
    pub linear_acceleration: Vector,
    pub linear_acceleration_covariance: [f64; 9],
}

#[derive(Serialize)]
pub struct PoseStamped {
    pub header: Header,
    pub pose: Transform,
}

#[derive(Serialize)]
pub struct TransformStamped {
    pub header: Header,
    pub child_frame_id: &'static str,
    pub transform: Transform,
}

#[derive(Serialize)]
pub struct TfMessage {
    pub transforms: Vec<TransformStamped>,
}

#[derive(Serialize)]
struct RegionOfInterest {
    x_offset: u32,
    y_offset: u32,
    height: u32,
    width: u32,
    do_rectify: bool,
}

#[derive(Serialize)]
pub struct CameraInfo {
    header: Header,
    height: u32,
    width: u32,
    distortion_model: &'static str,
    d: Vec<f64>,
    k: [f64; 9],
    r: [f64; 9],
    p: [f64; 12],
    binning_x: u32,
    binning_y: u32,
    roi: RegionOfInterest,
}

impl CameraInfo {
    /// `model` is the name under which radial-tangential distortion is told, and its number of
    /// coefficients; those that the camera does not have are zero.
    pub fn new(
        header: Header,
        camera: &CameraConfig,
        image: &ColorImage,
        (model, coefficients): (&'static str, usize),
    ) -> Self {
        let CameraConfig { fx, fy, cx, cy, .. } = *camera;
        let mut d = camera.distortion.clone();
        let model = match camera.model {
            CameraModel::RadialTangential => {
                d.resize(coefficients, 0.0);
                model
            }
            other => distortion_model(other),
        };
        Self {
            header,
            height: image.height() as u32,
            width: image.width() as u32,
            distortion_model: model,
            d,
            k: [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
            r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            p: [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
            binning_x: 0,
            binning_y: 0,
            roi: RegionOfInterest {
                x_offset: 0,
                y_offset: 0,
                height: 0,
                width: 0,
                do_rectify: false,
            },
        }
    }
}

/// `sensor_msgs/distortion_models`; the models that it lacks by their own names.
fn distortion_model(model: CameraModel) -> &'static str {
    match model {
        CameraModel::RadialTangential => "plumb_bob",
        CameraModel::Rational => "rational_polynomial",
        other => other.name(),
    }
}

macro_rules! part {
    ($name:literal, $fields:literal) => {
        concat!(
            "================================================================================\n",
            "MSG: ",
            $name,
            "\n",
            $fields
        )
    };
}
macro_rules! header {
    () => {
        concat!(
            part!("std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id\n"),
            part!("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n")
        )
    };
}
macro_rules! quaternion {
    () => {
        part!("geometry_msgs/Quaternion", "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n")
    };
}
macro_rules! vector {
    () => {
        part!("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n")
    };
}

pub const IMAGE_DEFINITION: &str = concat!(
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n",
    "uint8 is_bigendian\nuint32 step\nuint8[] data\n",
    header!()
);
pub const IMU_DEFINITION: &str = concat!(
    "std_msgs/Header header\n",
    "geometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n",
    "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n",
    "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n",
    header!(),
    quaternion!(),
    vector!()
);
pub const CAMERA_INFO_DEFINITION: &str = concat!(
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\n",
    "float64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p\n",
    "uint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n",
    header!(),
    part!(
        "sensor_msgs/RegionOfInterest",
        "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n"
    )
);
pub const POSE_DEFINITION: &str = concat!(
    "std_msgs/Header header\ngeometry_msgs/Pose pose\n",
    header!(),
    part!(
        "geometry_msgs/Pose",
        "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
    ),
    part!("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z\n"),
    quaternion!()
);
pub const TF_DEFINITION: &str = concat!(
    "geometry_msgs/TransformStamped[] transforms\n",
    part!(
        "geometry_msgs/TransformStamped",
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"
    ),
    header!(),
    part!(
        "geometry_msgs/Transform",
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"
    ),
    vector!(),
    quaternion!()
);

/// The text that describes a type, where this module knows it.
pub fn definition(kind: MessageType) -> Option<&'static str> {
    match kind {
        MessageType::Image => Some(IMAGE_DEFINITION),
        MessageType::Imu => Some(IMU_DEFINITION),
        MessageType::PoseStamped => Some(POSE_DEFINITION),
        MessageType::CameraInfo => Some(CAMERA_INFO_DEFINITION),
        MessageType::Transforms => Some(TF_DEFINITION),
        _ => None,
    }
}
