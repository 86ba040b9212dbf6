//! MCAP logs with ROS 2 messages.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use byteorder::LittleEndian;
use nalgebra::{Isometry3, UnitQuaternion};
use serde::{Deserialize, Serialize};

use super::definition::CDR_HEADER;
use super::layout::{Layout, Names};
use super::output::McapOutput;
use super::ros2;
use super::{Event, RgbdFrame, TruthPose};
use crate::sensor::{CameraConfig, ColorImage, DepthImage, ImuSample, PixelFormat, Stamp};

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
    /// Topics, frames and encodings: `"own"`, or `"d435i"`, `"oak-d"`, `"zed"`, `"azure-kinect"`,
    /// `"structure-core"` as the drivers of these devices have them, the calibration only in
    /// CameraInfo and transforms.
    pub layout: Layout,
    /// Name of the shipped configuration that fits the sensors, noted in the log; empty: none.
    #[serde(skip)]
    pub configuration: String,
}

impl Default for LogWriterOptions {
    fn default() -> Self {
        Self {
            quirks: Quirks::None,
            compression_level: 1,
            log_time_offset: 0.0,
            layout: Layout::Own,
            configuration: String::new(),
        }
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
    #[error("{path}: the log time {time} s is before the clock's origin")]
    BeforeOrigin { path: PathBuf, time: Stamp },
}

/// Number of messages in a finished log.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct WriteSummary {
    pub frames: u64,
    pub imu_samples: u64,
    pub truth_poses: u64,
}

const TRUTH: &str = "/truth/pose";
const TRANSFORM: &str = "/tf";
const STATIC_TRANSFORM: &str = "/tf_static";

/// Keys of the metadata of the channel of calibrations: the name of a shipped configuration that
/// fits, and the camera's calibration with its mounting, as JSON.
pub(super) const CONFIGURATION: &str = "mfg-vio:configuration";
pub(super) const CAMERA: &str = "mfg-vio:camera";

const WORLD_FRAME: &str = "world";

/// Writes a log message by message; what has been given is out of memory after each chunk of a
/// few megabytes. Without [`LogWriter::finish`] the file has no index.
pub struct LogWriter {
    path: PathBuf,
    output: McapOutput,
    options: LogWriterOptions,
    names: Names,
    camera: Option<CameraConfig>,
    channels: BTreeMap<&'static str, u16>,
    summary: WriteSummary,
    buffer: Vec<u8>,
}

impl LogWriter {
    pub fn create(path: &Path, options: LogWriterOptions) -> Result<Self, WriteError> {
        Ok(Self {
            path: path.to_owned(),
            output: McapOutput::create(path, options.compression_level)?,
            names: options.layout.names(),
            options,
            camera: None,
            channels: BTreeMap::new(),
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
        self.mounting(&body_from_camera, STATIC_TRANSFORM, stamp)
    }

    /// Writes those transforms of the mounting that go out on `topic`.
    fn mounting(
        &mut self,
        body_from_camera: &Isometry3<f64>,
        topic: &'static str,
        stamp: Stamp,
    ) -> Result<(), WriteError> {
        for ((frames, transform), is_repeated) in self.names.mounting(body_from_camera) {
            if is_repeated == (topic == TRANSFORM) {
                self.transform(topic, stamp, frames, &transform)?;
            }
        }
        Ok(())
    }

    pub fn imu(&mut self, sample: &ImuSample) -> Result<(), WriteError> {
        let scale = match self.options.quirks {
            Quirks::None => 1.0,
            Quirks::VcuRvi => -1.0 / 9.81,
        };
        // "No estimate" of the orientation, as the message's definition asks.
        let mut no_orientation = [0.0; 9];
        no_orientation[0] = -1.0;
        let message = ros2::Imu {
            header: ros2::Header::new(sample.stamp, self.names.imu_frame),
            orientation: UnitQuaternion::identity().into(),
            orientation_covariance: no_orientation,
            angular_velocity: sample.angular_velocity.into(),
            angular_velocity_covariance: [0.0; 9],
            linear_acceleration: (sample.specific_force * scale).into(),
            linear_acceleration_covariance: [0.0; 9],
        };
        self.summary.imu_samples += 1;
        self.write(self.names.imu, sample.stamp, &message)
    }

    /// Writes color and depth under the same stamp; depth that is logged in other units than
    /// millimetres as floating-point metres.
    pub fn frame(&mut self, frame: &RgbdFrame) -> Result<(), WriteError> {
        self.calibration(frame)?;
        self.color(frame.stamp, &frame.color)?;
        self.depth(frame.stamp, &frame.depth)?;
        self.summary.frames += 1;
        Ok(())
    }

    /// Writes what goes with a frame of the calibration, where it is known.
    fn calibration(&mut self, frame: &RgbdFrame) -> Result<(), WriteError> {
        let Some(camera) = self.camera.clone() else { return Ok(()) };
        let Names { color_info, depth_info, camera_frame, model, imu_on_tf, .. } = self.names;
        for topic in [Some(color_info), depth_info].into_iter().flatten() {
            let header = ros2::Header::new(frame.stamp, camera_frame);
            let message = ros2::CameraInfo::new(header, &camera, &frame.color, model);
            self.write(topic, frame.stamp, &message)?;
        }
        match camera.imu_from_camera() {
            Some(mounting) if imu_on_tf => self.mounting(&mounting, TRANSFORM, frame.stamp),
            _ => Ok(()),
        }
    }

    /// Writes a pose, and the same as a transform, by which viewers place the camera.
    pub fn truth(&mut self, pose: &TruthPose) -> Result<(), WriteError> {
        let message = ros2::PoseStamped {
            header: ros2::Header::new(pose.stamp, WORLD_FRAME),
            pose: (&pose.world_from_body).into(),
        };
        self.summary.truth_poses += 1;
        self.write(TRUTH, pose.stamp, &message)?;
        let frames = [WORLD_FRAME, self.names.imu_frame];
        self.transform(TRANSFORM, pose.stamp, frames, &pose.world_from_body)
    }

    fn transform(
        &mut self,
        topic: &'static str,
        stamp: Stamp,
        [parent, child]: [&'static str; 2],
        parent_from_child: &Isometry3<f64>,
    ) -> Result<(), WriteError> {
        let transform = ros2::TransformStamped {
            header: ros2::Header::new(stamp, parent),
            child_frame_id: child,
            transform: parent_from_child.into(),
        };
        self.write(topic, stamp, &ros2::TfMessage { transforms: vec![transform] })
    }

    pub fn event(&mut self, event: &Event) -> Result<(), WriteError> {
        match event {
            Event::Imu(sample) => self.imu(sample),
            Event::Frame(frame) => self.frame(frame),
            Event::Truth(pose) => self.truth(pose),
            Event::Repeated(..) => Ok(()),
        }
    }

    /// Writes the index; the log is complete only after this.
    pub fn finish(self) -> Result<WriteSummary, WriteError> {
        self.output.finish()?;
        Ok(self.summary)
    }

    fn color(&mut self, stamp: Stamp, image: &ColorImage) -> Result<(), WriteError> {
        let swapped;
        let encoded = self.names.color_format.encode(image.format(), image.data());
        let (encoding, data) = match (image.format(), self.options.quirks) {
            (PixelFormat::Mono8, _) => ("mono8", image.data()),
            (PixelFormat::Bgr8, Quirks::VcuRvi) => ("8UC3", image.data()),
            (PixelFormat::Rgb8, Quirks::VcuRvi) => {
                swapped = swap_red_and_blue(image.data());
                ("8UC3", swapped.as_slice())
            }
            (format, Quirks::None) => match (&encoded, format) {
                (Some((encoding, data)), _) => (*encoding, data.as_slice()),
                (None, PixelFormat::Bgr8) => ("bgr8", image.data()),
                (None, _) => ("rgb8", image.data()),
            },
        };
        let size = (image.width() as u32, image.height() as u32);
        self.image(self.names.color, stamp, size, (encoding, data))
    }

    fn depth(&mut self, stamp: Stamp, image: &DepthImage) -> Result<(), WriteError> {
        let in_millimetres = (f64::from(image.scale()) * 1000.0 - 1.0).abs() < 1e-6;
        let values = image.data().iter();
        let (encoding, data): (_, Vec<u8>) = match in_millimetres && !self.names.depth_in_metres {
            true => ("16UC1", values.flat_map(|raw| raw.to_le_bytes()).collect()),
            false => {
                let metres = |raw: &u16| (f32::from(*raw) * image.scale()).to_le_bytes();
                ("32FC1", values.flat_map(metres).collect())
            }
        };
        let size = (image.width() as u32, image.height() as u32);
        self.image(self.names.depth, stamp, size, (encoding, &data))
    }

    fn image(
        &mut self,
        topic: &'static str,
        stamp: Stamp,
        (width, height): (u32, u32),
        (encoding, data): (&'static str, &[u8]),
    ) -> Result<(), WriteError> {
        let message = ros2::Image {
            header: ros2::Header::new(stamp, self.names.camera_frame),
            height,
            width,
            encoding,
            is_bigendian: 0,
            // Without padding.
            step: (data.len() / height.max(1) as usize) as u32,
            data: ros2::Bytes(data),
        };
        self.write(topic, stamp, &message)
    }

    fn write<M: Serialize>(
        &mut self,
        topic: &'static str,
        stamp: Stamp,
        message: &M,
    ) -> Result<(), WriteError> {
        let channel = self.channel(topic)?;
        self.buffer.clear();
        self.buffer.extend(CDR_HEADER);
        cdr_encoding::to_writer::<_, LittleEndian, _>(&mut self.buffer, message).map_err(|e| {
            WriteError::Message { path: self.path.clone(), topic, reason: e.to_string() }
        })?;
        let log_time = stamp.offset_by(self.options.log_time_offset);
        self.output.write(channel, log_time, &self.buffer)
    }

    fn channel(&mut self, topic: &'static str) -> Result<u16, WriteError> {
        if let Some(id) = self.channels.get(topic) {
            return Ok(*id);
        }
        let names = self.names;
        let is_calibration = topic == names.color_info || Some(topic) == names.depth_info;
        let schema = match topic {
            _ if topic == names.imu => ("sensor_msgs/msg/Imu", ros2::IMU_DEFINITION),
            _ if is_calibration => ("sensor_msgs/msg/CameraInfo", ros2::CAMERA_INFO_DEFINITION),
            TRUTH => ("geometry_msgs/msg/PoseStamped", ros2::POSE_DEFINITION),
            TRANSFORM | STATIC_TRANSFORM => ("tf2_msgs/msg/TFMessage", ros2::TF_DEFINITION),
            _ => ("sensor_msgs/msg/Image", ros2::IMAGE_DEFINITION),
        };
        let mut metadata = BTreeMap::new();
        // Other recorders leave no notes.
        if topic == names.color_info && self.options.layout == Layout::Own {
            let camera = self.camera.as_ref().and_then(|c| serde_json::to_string(c).ok());
            metadata.extend(camera.map(|camera| (CAMERA.to_owned(), camera)));
            let configuration = &self.options.configuration;
            if !configuration.is_empty() {
                metadata.insert(CONFIGURATION.to_owned(), configuration.clone());
            }
        }
        let id = self.output.channel(topic, schema, &metadata)?;
        self.channels.insert(topic, id);
        Ok(id)
    }
}

fn swap_red_and_blue(data: &[u8]) -> Vec<u8> {
    let mut swapped = data.to_vec();
    swapped.chunks_exact_mut(3).for_each(|pixel| pixel.swap(0, 2));
    swapped
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

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
        RgbdFrame { stamp: Stamp::from_parts(12, 5), color, depth, others: Vec::new() }
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
        assert_eq!(body(&messages, "/cam0/color"), expected);
    }

    #[test]
    fn depth_in_millimetres_is_written_so_and_other_depth_in_metres() {
        let messages = written(LogWriterOptions::default());
        let depth = body(&messages, "/cam0/depth");
        assert!(depth.windows(6).any(|w| w == b"32FC1\0"));
        let metres = &depth[depth.len() - 8..];
        assert_eq!(metres, [1_f32.to_le_bytes(), 0_f32.to_le_bytes()].concat());

        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log.mcap");
        let mut log = LogWriter::create(&path, LogWriterOptions::default()).unwrap();
        let depth = DepthImage::new(2, 1, 0.001, vec![1000, 0]).unwrap();
        log.frame(&RgbdFrame { depth, ..frame() }).unwrap();
        log.finish().unwrap();
        let messages = super::tests::messages(&path);
        let depth = body(&messages, "/cam0/depth");
        assert!(depth.windows(6).any(|w| w == b"16UC1\0"));
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
            let imu = body(messages, "/imu");
            float(imu, imu.len() - 80)
        };
        let plain = written(LogWriterOptions::default());
        assert!((force(&plain) - 9.81).abs() < 1e-12);
        let quirky = LogWriterOptions { quirks: Quirks::VcuRvi, ..LogWriterOptions::default() };
        let quirky = written(quirky);
        assert!((force(&quirky) + 1.0).abs() < 1e-12);
        let color = body(&quirky, "/cam0/color");
        assert!(color.windows(5).any(|w| w == b"8UC3\0"));
        assert_eq!(color[color.len() - 6..], [3, 2, 1, 6, 5, 4]);
    }

    #[test]
    fn times_before_the_origin_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let options = LogWriterOptions { log_time_offset: -20.0, ..LogWriterOptions::default() };
        let mut log = LogWriter::create(&folder.path().join("log.mcap"), options).unwrap();
        let error = log.frame(&frame()).unwrap_err().to_string();
        assert!(error.contains("log.mcap") && error.contains("-7.999"), "{error}");
    }

    #[test]
    fn a_folder_that_is_not_there_is_named() {
        let path = Path::new("/nonexistent/log.mcap");
        let error = LogWriter::create(path, LogWriterOptions::default()).err().unwrap();
        assert!(error.to_string().contains("/nonexistent/log.mcap"));
    }
}
