//! MCAP logs with ROS 2 messages.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use byteorder::LittleEndian;
use mcap::records::MessageHeader;
use nalgebra::{Isometry3, Quaternion, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize, Serializer};

use super::{Event, RgbdFrame, TruthPose};
use crate::inertial::{ImuSample, Stamp};
use crate::vision::{CameraConfig, ColorImage, DepthImage, PixelFormat};

/// How a log departs from what the messages' definitions say.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Quirks {
    /// SI units, standard encodings.
    #[default]
    None,
    /// As the recordings of VCU-RVI: color is BGR called `8UC3`, the accelerometer reads in units
    /// of 9.81 m/s^2 with the sign inverted, and log times are of another clock than stamps.
    VcuRvi,
}

/// How a log is written.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LogWriterOptions {
    /// `"none"`, or `"vcu-rvi"` for color as `8UC3`, accelerometer in -g (9.81 m/s^2) and log
    /// times on another clock than the header stamps.
    pub quirks: Quirks,
    /// Level of the zstd compression, 1 (quick) to 19 (small). Images with noise hardly shrink.
    pub compression_level: u32,
    /// Log time minus header stamp, s.
    pub log_time_offset: f64,
}

impl Default for LogWriterOptions {
    fn default() -> Self {
        Self { quirks: Quirks::None, compression_level: 1, log_time_offset: 0.0 }
    }
}

/// A log that cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    #[error("{path}: {source}")]
    Io { path: PathBuf, source: std::io::Error },
    #[error("{path}: {source}")]
    Mcap { path: PathBuf, source: mcap::McapError },
    #[error("{path}: {topic}: {reason}")]
    Message { path: PathBuf, topic: &'static str, reason: String },
}

/// Number of messages in a finished log.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct WriteSummary {
    pub frames: u64,
    pub imu_samples: u64,
    pub truth_poses: u64,
}

const COLOR: &str = "/cam0/color";
const DEPTH: &str = "/cam0/depth";
const CAMERA_INFO: &str = "/cam0/camera_info";
const IMU: &str = "/imu";
const TRUTH: &str = "/truth/pose";
const TRANSFORM: &str = "/tf";
const STATIC_TRANSFORM: &str = "/tf_static";

const WORLD_FRAME: &str = "world";
const BODY_FRAME: &str = "imu";
const CAMERA_FRAME: &str = "camera";

/// Writes a log message by message; what has been given is out of memory after each chunk of a
/// few megabytes. Without [`LogWriter::finish`] the file has no index.
pub struct LogWriter {
    path: PathBuf,
    mcap: mcap::Writer<BufWriter<File>>,
    options: LogWriterOptions,
    camera: Option<CameraConfig>,
    channels: BTreeMap<&'static str, u16>,
    sequence: BTreeMap<u16, u32>,
    summary: WriteSummary,
    buffer: Vec<u8>,
}

impl LogWriter {
    pub fn create(path: &Path, options: LogWriterOptions) -> Result<Self, WriteError> {
        let io = |source| WriteError::Io { path: path.to_owned(), source };
        let file = BufWriter::new(File::create(path).map_err(io)?);
        let mcap = mcap::WriteOptions::new()
            .profile("ros2")
            .chunk_size(Some(4 << 20))
            .compression_level(options.compression_level)
            .compression_threads(1)
            .create(file)
            .map_err(|source| WriteError::Mcap { path: path.to_owned(), source })?;
        Ok(Self {
            path: path.to_owned(),
            mcap,
            options,
            camera: None,
            channels: BTreeMap::new(),
            sequence: BTreeMap::new(),
            summary: WriteSummary::default(),
            buffer: Vec::new(),
        })
    }

    /// Writes the mounting of the camera now (stamped `stamp`) and its intrinsics with each
    /// following frame.
    pub fn camera_info(&mut self, camera: &CameraConfig, stamp: Stamp) -> Result<(), WriteError> {
        let Some(body_from_camera) = camera.imu_from_camera() else {
            return Err(WriteError::Message {
                path: self.path.clone(),
                topic: STATIC_TRANSFORM,
                reason: "camera.imu_from_camera is not a rigid transform".to_owned(),
            });
        };
        self.camera = Some(camera.clone());
        self.transform(STATIC_TRANSFORM, stamp, [BODY_FRAME, CAMERA_FRAME], &body_from_camera)
    }

    pub fn imu(&mut self, sample: &ImuSample) -> Result<(), WriteError> {
        let scale = match self.options.quirks {
            Quirks::None => 1.0,
            Quirks::VcuRvi => -1.0 / 9.81,
        };
        // "No estimate" of the orientation, as the message's definition asks.
        let mut no_orientation = [0.0; 9];
        no_orientation[0] = -1.0;
        let message = message::Imu {
            header: message::Header::new(sample.stamp, BODY_FRAME),
            orientation: UnitQuaternion::identity().into(),
            orientation_covariance: no_orientation,
            angular_velocity: sample.angular_velocity.into(),
            angular_velocity_covariance: [0.0; 9],
            linear_acceleration: (sample.specific_force * scale).into(),
            linear_acceleration_covariance: [0.0; 9],
        };
        self.summary.imu_samples += 1;
        self.write(IMU, sample.stamp, &message)
    }

    /// Writes color and depth (as millimetres) under the same stamp.
    pub fn frame(&mut self, frame: &RgbdFrame) -> Result<(), WriteError> {
        if let Some(camera) = &self.camera {
            let message = message::CameraInfo::new(camera, frame.stamp, &frame.color);
            self.write(CAMERA_INFO, frame.stamp, &message)?;
        }
        self.color(frame.stamp, &frame.color)?;
        self.depth(frame.stamp, &frame.depth)?;
        self.summary.frames += 1;
        Ok(())
    }

    /// Writes a pose, and the same as a transform, by which viewers place the camera.
    pub fn truth(&mut self, pose: &TruthPose) -> Result<(), WriteError> {
        let message = message::PoseStamped {
            header: message::Header::new(pose.stamp, WORLD_FRAME),
            pose: (&pose.world_from_body).into(),
        };
        self.summary.truth_poses += 1;
        self.write(TRUTH, pose.stamp, &message)?;
        let frames = [WORLD_FRAME, BODY_FRAME];
        self.transform(TRANSFORM, pose.stamp, frames, &pose.world_from_body)
    }

    fn transform(
        &mut self,
        topic: &'static str,
        stamp: Stamp,
        [parent, child]: [&'static str; 2],
        parent_from_child: &Isometry3<f64>,
    ) -> Result<(), WriteError> {
        let transform = message::TransformStamped {
            header: message::Header::new(stamp, parent),
            child_frame_id: child,
            transform: parent_from_child.into(),
        };
        self.write(topic, stamp, &message::TfMessage { transforms: vec![transform] })
    }

    pub fn event(&mut self, event: &Event) -> Result<(), WriteError> {
        match event {
            Event::Imu(sample) => self.imu(sample),
            Event::Frame(frame) => self.frame(frame),
            Event::Truth(pose) => self.truth(pose),
        }
    }

    /// Writes the index; the log is complete only after this.
    pub fn finish(mut self) -> Result<WriteSummary, WriteError> {
        let finished = self.mcap.finish();
        finished.map_err(|source| WriteError::Mcap { path: self.path.clone(), source })?;
        let io = |source| WriteError::Io { path: self.path.clone(), source };
        self.mcap.into_inner().into_inner().map_err(|e| io(e.into_error()))?;
        Ok(self.summary)
    }

    fn color(&mut self, stamp: Stamp, image: &ColorImage) -> Result<(), WriteError> {
        let channels = image.format().channels();
        let swapped;
        let (encoding, data) = match (image.format(), self.options.quirks) {
            (PixelFormat::Mono8, _) => ("mono8", image.data()),
            (PixelFormat::Bgr8, Quirks::VcuRvi) => ("8UC3", image.data()),
            (PixelFormat::Rgb8, Quirks::VcuRvi) => {
                swapped = swap_red_and_blue(image.data());
                ("8UC3", swapped.as_slice())
            }
            (PixelFormat::Rgb8, Quirks::None) => ("rgb8", image.data()),
            (PixelFormat::Bgr8, Quirks::None) => ("bgr8", image.data()),
        };
        let message = message::Image {
            header: message::Header::new(stamp, CAMERA_FRAME),
            height: image.height() as u32,
            width: image.width() as u32,
            encoding,
            is_bigendian: 0,
            step: (image.width() * channels) as u32,
            data: message::Bytes(data),
        };
        self.write(COLOR, stamp, &message)
    }

    fn depth(&mut self, stamp: Stamp, image: &DepthImage) -> Result<(), WriteError> {
        let data = millimetres(image);
        let message = message::Image {
            header: message::Header::new(stamp, CAMERA_FRAME),
            height: image.height() as u32,
            width: image.width() as u32,
            encoding: "16UC1",
            is_bigendian: 0,
            step: 2 * image.width() as u32,
            data: message::Bytes(&data),
        };
        self.write(DEPTH, stamp, &message)
    }

    fn write<M: Serialize>(
        &mut self,
        topic: &'static str,
        stamp: Stamp,
        message: &M,
    ) -> Result<(), WriteError> {
        let refused =
            |reason: String| WriteError::Message { path: self.path.clone(), topic, reason };
        let log_time = stamp.offset_by(self.options.log_time_offset).nanos();
        let Ok(log_time) = u64::try_from(log_time) else {
            return Err(refused(format!("its time {stamp} s is before the clock's origin")));
        };
        let mut buffer = std::mem::take(&mut self.buffer);
        buffer.clear();
        // The encapsulation header: plain CDR, little endian.
        buffer.extend([0, 1, 0, 0]);
        cdr_encoding::to_writer::<_, LittleEndian, _>(&mut buffer, message)
            .map_err(|e| refused(e.to_string()))?;
        let written = self.channel(topic).and_then(|channel_id| {
            let sequence = self.sequence.entry(channel_id).or_default();
            let header =
                MessageHeader { channel_id, sequence: *sequence, log_time, publish_time: log_time };
            *sequence = sequence.wrapping_add(1);
            self.mcap.write_to_known_channel(&header, &buffer)
        });
        self.buffer = buffer;
        written.map_err(|source| WriteError::Mcap { path: self.path.clone(), source })
    }

    fn channel(&mut self, topic: &'static str) -> Result<u16, mcap::McapError> {
        if let Some(id) = self.channels.get(topic) {
            return Ok(*id);
        }
        let (name, definition) = match topic {
            IMU => ("sensor_msgs/msg/Imu", message::IMU_DEFINITION),
            CAMERA_INFO => ("sensor_msgs/msg/CameraInfo", message::CAMERA_INFO_DEFINITION),
            TRUTH => ("geometry_msgs/msg/PoseStamped", message::POSE_DEFINITION),
            TRANSFORM | STATIC_TRANSFORM => ("tf2_msgs/msg/TFMessage", message::TF_DEFINITION),
            _ => ("sensor_msgs/msg/Image", message::IMAGE_DEFINITION),
        };
        let schema = self.mcap.add_schema(name, "ros2msg", definition.as_bytes())?;
        let id = self.mcap.add_channel(schema, topic, "cdr", &BTreeMap::new())?;
        self.channels.insert(topic, id);
        Ok(id)
    }
}

fn swap_red_and_blue(data: &[u8]) -> Vec<u8> {
    let mut swapped = data.to_vec();
    swapped.chunks_exact_mut(3).for_each(|pixel| pixel.swap(0, 2));
    swapped
}

/// Little-endian millimetres; depths beyond 65.5 m become "none".
fn millimetres(image: &DepthImage) -> Vec<u8> {
    let factor = f64::from(image.scale()) * 1000.0;
    let exact = (factor - 1.0).abs() < 1e-6;
    let convert = |raw: u16| {
        let value = (f64::from(raw) * factor).round();
        if value <= f64::from(u16::MAX) { value as u16 } else { 0 }
    };
    let values = image.data().iter();
    values.flat_map(|raw| if exact { *raw } else { convert(*raw) }.to_le_bytes()).collect()
}

/// The messages' fields in their order, and the text of their definitions.
mod message {
    use super::*;

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
            Self {
                translation: isometry.translation.vector.into(),
                rotation: isometry.rotation.into(),
            }
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
        pub fn new(camera: &CameraConfig, stamp: Stamp, image: &ColorImage) -> Self {
            let CameraConfig { fx, fy, cx, cy, .. } = *camera;
            Self {
                header: Header::new(stamp, CAMERA_FRAME),
                height: image.height() as u32,
                width: image.width() as u32,
                distortion_model: "plumb_bob",
                d: camera.distortion.to_vec(),
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
            part!(
                "geometry_msgs/Quaternion",
                "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n"
            )
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
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Topic, schema name and CDR body of each message of a log.
    fn messages(path: &Path) -> Vec<(String, String, Vec<u8>)> {
        let bytes = std::fs::read(path).unwrap();
        let stream = mcap::MessageStream::new(&bytes).unwrap();
        stream
            .map(|message| {
                let message = message.unwrap();
                let channel = &message.channel;
                assert_eq!(channel.message_encoding, "cdr");
                let schema = channel.schema.as_ref().unwrap().name.clone();
                (channel.topic.clone(), schema, message.data.to_vec())
            })
            .collect()
    }

    fn frame() -> RgbdFrame {
        let color = ColorImage::new(2, 1, PixelFormat::Rgb8, vec![1, 2, 3, 4, 5, 6]).unwrap();
        let depth = DepthImage::new(2, 1, 0.0002, vec![5000, 0]).unwrap();
        RgbdFrame { stamp: Stamp::from_parts(12, 5), color, depth }
    }

    fn written(options: LogWriterOptions) -> Vec<(String, String, Vec<u8>)> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log.mcap");
        let mut log = LogWriter::create(&path, options).unwrap();
        log.camera_info(&CameraConfig::default(), Stamp::from_parts(12, 0)).unwrap();
        log.frame(&frame()).unwrap();
        let sample = ImuSample {
            stamp: Stamp::from_parts(12, 6),
            angular_velocity: Vector3::new(0.1, 0.2, 0.3),
            specific_force: Vector3::new(0.0, 0.0, 9.81),
        };
        log.event(&Event::Imu(sample)).unwrap();
        let pose = TruthPose {
            stamp: Stamp::from_parts(12, 7),
            world_from_body: Isometry3::translation(1.0, 2.0, 3.0),
        };
        log.truth(&pose).unwrap();
        let summary = log.finish().unwrap();
        assert_eq!(summary, WriteSummary { frames: 1, imu_samples: 1, truth_poses: 1 });
        messages(&path)
    }

    fn body<'a>(messages: &'a [(String, String, Vec<u8>)], topic: &str) -> &'a [u8] {
        let found = messages.iter().find(|(t, _, _)| t == topic).unwrap();
        &found.2
    }

    fn float(bytes: &[u8], offset: usize) -> f64 {
        f64::from_le_bytes(bytes[offset..offset + 8].try_into().unwrap())
    }

    #[test]
    fn images_have_the_bytes_of_their_definition() {
        let messages = written(LogWriterOptions::default());
        let mut expected = vec![0, 1, 0, 0, 12, 0, 0, 0, 5, 0, 0, 0];
        expected.extend([7, 0, 0, 0]);
        // The second zero is padding before the height.
        expected.extend(b"camera\0\0");
        expected.extend([1, 0, 0, 0, 2, 0, 0, 0]);
        expected.extend([5, 0, 0, 0]);
        expected.extend(b"rgb8\0");
        expected.push(0); // is_bigendian
        expected.extend([0, 0]); // padding before step
        expected.extend([6, 0, 0, 0]);
        expected.extend([6, 0, 0, 0]);
        expected.extend([1, 2, 3, 4, 5, 6]);
        assert_eq!(body(&messages, COLOR), expected);
    }

    #[test]
    fn depth_becomes_millimetres() {
        let messages = written(LogWriterOptions::default());
        let depth = body(&messages, DEPTH);
        assert_eq!(depth[depth.len() - 4..], [232, 3, 0, 0]);
    }

    #[test]
    fn every_stream_has_its_schema() {
        let messages = written(LogWriterOptions::default());
        let schemas: Vec<(&str, &str)> =
            messages.iter().map(|(topic, schema, _)| (topic.as_str(), schema.as_str())).collect();
        assert_eq!(
            schemas,
            [
                ("/tf_static", "tf2_msgs/msg/TFMessage"),
                ("/cam0/camera_info", "sensor_msgs/msg/CameraInfo"),
                ("/cam0/color", "sensor_msgs/msg/Image"),
                ("/cam0/depth", "sensor_msgs/msg/Image"),
                ("/imu", "sensor_msgs/msg/Imu"),
                ("/truth/pose", "geometry_msgs/msg/PoseStamped"),
                ("/tf", "tf2_msgs/msg/TFMessage"),
            ]
        );
    }

    #[test]
    fn quirks_change_units_and_encoding() {
        // Of an Imu message, the last 72 bytes are a covariance and the 8 before them az.
        let force = |messages: &[(String, String, Vec<u8>)]| {
            let imu = body(messages, IMU);
            float(imu, imu.len() - 80)
        };
        let plain = written(LogWriterOptions::default());
        assert!((force(&plain) - 9.81).abs() < 1e-12);
        let quirky = LogWriterOptions { quirks: Quirks::VcuRvi, ..LogWriterOptions::default() };
        let quirky = written(quirky);
        assert!((force(&quirky) + 1.0).abs() < 1e-12);
        let color = body(&quirky, COLOR);
        assert!(color.windows(5).any(|w| w == b"8UC3\0"));
        assert_eq!(color[color.len() - 6..], [3, 2, 1, 6, 5, 4]);
    }

    #[test]
    fn times_before_the_origin_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let options = LogWriterOptions { log_time_offset: -20.0, ..LogWriterOptions::default() };
        let mut log = LogWriter::create(&folder.path().join("log.mcap"), options).unwrap();
        let error = log.frame(&frame()).unwrap_err().to_string();
        assert!(error.contains(COLOR), "{error}");
    }

    #[test]
    fn a_folder_that_is_not_there_is_named() {
        let path = Path::new("/nonexistent/log.mcap");
        let error = LogWriter::create(path, LogWriterOptions::default()).err().unwrap();
        assert!(error.to_string().contains("/nonexistent/log.mcap"));
    }
}
