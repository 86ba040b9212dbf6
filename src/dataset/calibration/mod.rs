//! Calibration that a log of messages holds: `CameraInfo`, transforms, frames; and what its device
//! is known for.
//!
//! [`Observed`] watches the first messages. [`Observed::settings`] makes settings of what was seen,
//! each with where it is from; what is not in the log is left out, never guessed.

mod camera_info;
mod device;
mod transforms;

use std::collections::BTreeMap;

use nalgebra::Isometry3;

use self::camera_info::{CameraInfo, Intrinsics, Model, camera_info};
use self::device::Device;
use self::transforms::{TransformTree, frame, transforms};
use super::found::{FoundCalibration, FoundIn, FoundSetting};
use super::message::{Fields, MessageType, Serialization};
use super::pixels::Rejection;
use crate::inertial::SensorClass;
use crate::sensor::{CameraConfig, PinholeCamera, Stamp};
use crate::vision::DepthRegistration;

/// The topics whose calibration is wanted.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Streams<'a> {
    pub color: Option<&'a str>,
    /// Width and height of its images.
    pub color_size: Option<(u32, u32)>,
    pub depth: Option<&'a str>,
    pub depth_size: Option<(u32, u32)>,
    /// The right one of two cameras.
    pub right: Option<&'a str>,
    pub imu: Option<&'a str>,
    pub truth: Option<&'a str>,
}

/// What the first messages tell.
#[derive(Debug, Clone, Default)]
pub(super) struct Observed {
    /// By topic.
    headers: BTreeMap<String, Headers>,
    infos: BTreeMap<String, CameraInfo>,
    tree: TransformTree,
    /// Number of messages of each topic of transforms.
    transform_messages: BTreeMap<String, u32>,
}

/// Headers of a topic's first messages.
#[derive(Debug, Clone)]
struct Headers {
    frame: String,
    /// Of poses: whose they are.
    child: Option<String>,
    count: u32,
    first: Stamp,
    last: Stamp,
}

/// Rotation and translation of a mounting that only frame names tell are this uncertain, degrees
/// and m (one standard deviation); the filter estimates them while it runs.
const CONVENTION_ROTATION_SD: f64 = 0.5;
const CONVENTION_TRANSLATION_SD: f64 = 0.03;

/// So many messages on `/tf` are looked at: drivers send their part of it at 10 Hz or more.
const TRANSFORM_MESSAGES: u32 = 100;

/// Depth and color cameras nearer than this (m, rad) are at the same place.
const REGISTERED: f64 = 1e-3;

impl Observed {
    /// Takes note of a message of a type that is read.
    pub fn observe(
        &mut self,
        topic: &str,
        (kind, serialization): (MessageType, Serialization),
        data: &[u8],
    ) -> Result<(), Rejection> {
        let fields = || Fields::new(data, serialization);
        match kind {
            MessageType::Transforms => {
                *self.transform_messages.entry(topic.to_owned()).or_default() += 1;
                transforms(fields()?)?.into_iter().for_each(|t| self.tree.add(t));
                return Ok(());
            }
            MessageType::CameraInfo if !self.infos.contains_key(topic) => {
                self.infos.insert(topic.to_owned(), camera_info(fields()?)?);
            }
            _ => {}
        }
        let mut start = fields()?;
        let (stamp, frame_id) = start.header_and_frame()?;
        let headers = self.headers.entry(topic.to_owned()).or_insert_with(|| Headers {
            frame: frame(frame_id),
            child: None,
            count: 0,
            first: stamp,
            last: stamp,
        });
        if matches!(kind, MessageType::TransformStamped | MessageType::Odometry)
            && headers.child.is_none()
        {
            headers.child = start.text().ok().map(frame);
        }
        headers.count += 1;
        headers.first = headers.first.min(stamp);
        headers.last = headers.last.max(stamp);
        Ok(())
    }

    /// Whether a topic of transforms had enough messages for each of its publishers to have had one.
    pub fn has_transforms_of(&self, topic: &str) -> bool {
        // Static ones are all in one message, or in one a publisher.
        let enough = if topic.ends_with("static") { 1 } else { TRANSFORM_MESSAGES };
        self.transform_messages.get(topic).is_some_and(|count| *count >= enough)
    }

    /// Messages of a topic that were seen.
    pub fn count(&self, topic: &str) -> u32 {
        self.headers.get(topic).map_or(0, |headers| headers.count)
    }

    /// Messages a second among the first ones, by their stamps.
    pub fn rate(&self, topic: &str) -> Option<f64> {
        let headers = self.headers.get(topic)?;
        let span = headers.last.seconds_since(headers.first);
        (headers.count > 1 && span > 0.0).then(|| f64::from(headers.count - 1) / span)
    }

    /// The frame of a topic's messages, where it has a name.
    pub fn frame(&self, topic: &str) -> Option<&str> {
        self.headers.get(topic).map(|h| h.frame.as_str()).filter(|name| !name.is_empty())
    }

    /// Whether the frames of two topics are known to be fixed to one another.
    pub fn are_connected(&self, a: &str, b: &str) -> bool {
        let frames = self.frame(a).zip(self.frame(b));
        frames.is_some_and(|(a, b)| self.tree.between(a, b).is_some())
    }

    /// The message with the calibration of an image topic: the one in the topic's own name space,
    /// or else one of the same frame.
    pub fn info_of(&self, image: &str) -> Option<(&str, &CameraInfo)> {
        let depth = |info: &str| {
            let parent = info.rsplit_once('/').map_or("", |(parent, _)| parent);
            image
                .strip_prefix(parent)
                .is_some_and(|rest| rest.starts_with('/'))
                .then_some(parent.len())
        };
        let image_frame = self.frame(image);
        let fits = |(topic, info): (&'_ String, &'_ CameraInfo)| {
            let same_frame = image_frame.is_some_and(|name| name == frame(&info.frame));
            let near = depth(topic).filter(|length| *length > 0);
            // `/camera_info` beside `/image_raw` is in the root name space.
            let root = depth(topic).is_some() && image.matches('/').count() == 1;
            (same_frame || near.is_some() || root).then_some((near.unwrap_or(0), same_frame))
        };
        let ranked = self.infos.iter().filter_map(|(topic, info)| {
            fits((topic, info)).map(|rank| (rank, std::cmp::Reverse(topic), info))
        });
        let best = ranked.max_by(|a, b| (a.0, a.1).cmp(&(b.0, b.1)));
        best.map(|(_, topic, info)| (topic.0.as_str(), info))
    }

    /// Settings that follow for `streams`, the device's first.
    pub fn settings(&self, streams: &Streams) -> FoundCalibration {
        let mut found = FoundCalibration::default();
        let device = self.device(streams);
        found.device = device.map(|device| device.name.to_owned());
        self.sensor_classes(device, streams, &mut found);
        if let Some(color) = streams.color {
            self.camera(color, streams.color_size, &mut found);
            if let Some(imu) = streams.imu {
                self.mounting(color, imu, &mut found);
            }
        }
        if let Some((color, right)) = streams.color.zip(streams.right) {
            self.stereo(color, right, streams, &mut found);
        }
        if let Some((truth, imu)) = streams.truth.zip(streams.imu) {
            self.reference(truth, imu, &mut found);
        }
        found.registration = self.registration(streams);
        found
    }

    /// How the depth image is brought to the color image, where the log tells it and they are not
    /// of the same pixels.
    fn registration(&self, streams: &Streams) -> Option<DepthRegistration> {
        let (color, depth) = streams.color.zip(streams.depth)?;
        let (color_frame, depth_frame) = self.frame(color).zip(self.frame(depth))?;
        let color_from_depth = match color_frame == depth_frame {
            true => Isometry3::identity(),
            false => self.tree.between(color_frame, depth_frame)?,
        };
        let offset = color_from_depth.translation.vector.norm();
        let is_same_place = offset.max(color_from_depth.rotation.angle()) < REGISTERED;
        if is_same_place && streams.depth_size == streams.color_size {
            return None;
        }
        let (width, height) = streams.color_size?;
        let (_, info) = self.info_of(depth)?;
        let [fx, fy, cx, cy] = info.intrinsics(streams.depth_size, true).ok()?.pinhole;
        let (topic, info) = self.info_of(color)?;
        let seen = info.intrinsics(streams.color_size, is_rectified(color)).ok()?;
        let config: CameraConfig = camera_table(topic, &seen).try_into().ok()?;
        Some(DepthRegistration {
            depth_camera: PinholeCamera { fx, fy, cx, cy },
            color_camera: config,
            color_from_depth,
            color_size: (width as usize, height as usize),
        })
    }

    /// Both cameras, where depth is to come from them.
    fn stereo(&self, left: &str, right: &str, streams: &Streams, found: &mut FoundCalibration) {
        let Some((left_frame, right_frame)) = self.frame(left).zip(self.frame(right)) else {
            return;
        };
        let body = streams.imu.and_then(|imu| self.frame(imu)).unwrap_or(left_frame);
        let mounting = |name: &str| match name == body {
            true => Some(Isometry3::identity()),
            false => self.tree.between(body, name),
        };
        let Some(body_from_left) = mounting(left_frame) else { return };
        let baseline = self.info_of(right).and_then(|(_, info)| info.baseline());
        // By the convention of rectified pairs both images may be of the left frame.
        let body_from_right = match right_frame == left_frame {
            true => baseline.map(|x| body_from_left * Isometry3::translation(x, 0.0, 0.0)),
            false => mounting(right_frame),
        };
        let camera = |topic: &str, mounted: Option<Isometry3<f64>>| {
            let (info_topic, info) = self.info_of(topic)?;
            let camera = info.intrinsics(streams.color_size, is_rectified(topic)).ok()?;
            let mut table = camera_table(info_topic, &camera);
            table.insert("imu_from_camera".to_owned(), matrix(&mounted?));
            Some((info_topic.to_owned(), toml::Value::Table(table)))
        };
        match (camera(left, Some(body_from_left)), camera(right, body_from_right)) {
            (Some((a, left)), Some((b, right))) => {
                let source = format!("{a}, {b} and the transforms between their frames");
                let cameras = toml::Value::Array(vec![left, right]);
                found.settings.push(FoundSetting::from_log("log.stereo", cameras, &source));
            }
            _ => found.problems.push(format!(
                "depth from {left} and {right} needs the calibration of both and where the second \
                 one is: CameraInfo with a baseline in P, or /tf_static"
            )),
        }
    }

    fn device(&self, streams: &Streams) -> Option<Device> {
        let topics = [streams.color, streams.depth, streams.imu];
        let used = topics.into_iter().flatten();
        let frames = used.clone().filter_map(|topic| self.frame(topic));
        Device::of(used.chain(frames))
    }

    fn sensor_classes(
        &self,
        device: Option<Device>,
        streams: &Streams,
        found: &mut FoundCalibration,
    ) {
        let prefix = device.map(|device| format!("{}, ", device.name)).unwrap_or_default();
        if let Some(imu) = streams.imu {
            let names = [imu, self.frame(imu).unwrap_or_default()].join(" ");
            let class = SensorClass::mentioned(&names)
                .or_else(|| device.and_then(|device| device.imu()))
                .unwrap_or_else(SensorClass::generic);
            let source = FoundIn::SensorClass(format!("{prefix}{}", class.source()));
            let values =
                [("imu.gyro_noise", class.gyro_noise()), ("imu.accel_noise", class.accel_noise())];
            let settings = values.map(|(key, value)| FoundSetting::new(key, value, source.clone()));
            found.settings.extend(settings);
        }
        let Some(law) = device.and_then(|device| device.depth).filter(|_| streams.depth.is_some())
        else {
            return;
        };
        let source = FoundIn::SensorClass(format!("{prefix}{}", law.source));
        let values = [
            ("depth.min", law.min),
            ("depth.noise_floor", law.floor),
            ("depth.noise_quadratic", law.quadratic),
            ("depth.noise_linear", law.linear),
            ("depth.noise_constant", law.constant),
        ];
        let settings = values.map(|(key, value)| FoundSetting::new(key, value, source.clone()));
        found.settings.extend(settings);
    }

    fn camera(&self, color: &str, size: Option<(u32, u32)>, found: &mut FoundCalibration) {
        let Some((topic, info)) = self.info_of(color) else { return };
        match info.intrinsics(size, is_rectified(color)) {
            Ok(camera) => found.settings.extend(camera_settings(topic, &camera)),
            Err(reason) => found.problems.push(format!("{topic} {reason} ({color})")),
        }
    }

    fn mounting(&self, color: &str, imu: &str, found: &mut FoundCalibration) {
        let Some((camera_frame, imu_frame)) = self.frame(color).zip(self.frame(imu)) else {
            return;
        };
        if let Some(imu_from_camera) = self.tree.between(imu_frame, camera_frame) {
            let source = format!("transform from {camera_frame} to {imu_frame}");
            let value = matrix(&imu_from_camera);
            found.settings.push(FoundSetting::from_log("camera.imu_from_camera", value, &source));
            return;
        }
        if !share_optical_axes(camera_frame, imu_frame) {
            return;
        }
        let source = format!(
            "frames {camera_frame} and {imu_frame}: axes of one optical convention; their distance is \
             not in the log"
        );
        let values = [
            ("camera.imu_from_camera", matrix(&Isometry3::identity())),
            ("filter.camera_rotation_sd_deg", CONVENTION_ROTATION_SD.into()),
            ("filter.camera_translation_sd", CONVENTION_TRANSLATION_SD.into()),
        ];
        let settings = values.map(|(key, value)| FoundSetting::from_log(key, value, &source));
        found.settings.extend(settings);
    }

    /// Where the reference's body is on the IMU, if it is another one.
    fn reference(&self, truth: &str, imu: &str, found: &mut FoundCalibration) {
        let Some(imu_frame) = self.frame(imu) else { return };
        let named = self.headers.get(truth).and_then(|h| h.child.clone());
        let marker = || {
            let mut markers = self.tree.frames().into_iter().filter(|name| is_marker(name));
            // Two of them: which one the poses are of is not told.
            let first = markers.next().filter(|_| markers.next().is_none());
            first.map(str::to_owned)
        };
        let Some(body) = named.or_else(marker).filter(|body| body != imu_frame) else { return };
        let Some(body_from_imu) = self.tree.between(&body, imu_frame) else { return };
        let source = format!("transform from {imu_frame} to {body}, whose poses {truth} gives");
        let value = matrix(&body_from_imu);
        found.settings.push(FoundSetting::from_log("log.truth_body_from_imu", value, &source));
    }
}

fn is_marker(frame: &str) -> bool {
    let lower = frame.to_lowercase();
    ["mocap", "vicon", "marker", "optitrack", "qualisys"].iter().any(|word| lower.contains(word))
}

/// By the names of `image_proc`.
fn is_rectified(image: &str) -> bool {
    image.split('/').any(|part| part.starts_with("image_rect"))
}

/// Whether both frames are optical ones (x right, y down, z forward) of one device, which are
/// parallel: `camera_color_optical_frame` and `camera_imu_optical_frame`.
fn share_optical_axes(a: &str, b: &str) -> bool {
    let device = |name: &str| {
        let stem = name.strip_suffix("_optical_frame")?;
        stem.rsplit_once('_').map(|(device, _)| device.to_owned())
    };
    a != b && device(a).is_some() && device(a) == device(b)
}

fn matrix(isometry: &Isometry3<f64>) -> toml::Value {
    let matrix = isometry.to_homogeneous();
    let row = |row: usize| (0..4).map(|column| matrix[(row, column)]).collect::<Vec<f64>>();
    toml::Value::from((0..4).map(row).collect::<Vec<_>>())
}

/// The same as a section of a configuration.
fn camera_table(topic: &str, camera: &Intrinsics) -> toml::Table {
    let settings = camera_settings(topic, camera).into_iter();
    settings.map(|s| (s.key.trim_start_matches("camera.").to_owned(), s.value)).collect()
}

/// Intrinsics and distortion, from the message on `topic`.
fn camera_settings(topic: &str, camera: &Intrinsics) -> Vec<FoundSetting> {
    let note = camera.note.as_ref().map(|note| format!(", {note}")).unwrap_or_default();
    let source = format!("{topic}{note}");
    let mut coefficients = camera.coefficients.clone();
    if camera.model == Model::RadialTangential {
        coefficients.resize(5, 0.0);
    }
    let [fx, fy, cx, cy] = camera.pinhole;
    let mut settings: Vec<_> =
        [("camera.fx", fx), ("camera.fy", fy), ("camera.cx", cx), ("camera.cy", cy)]
            .map(|(key, value)| FoundSetting::from_log(key, value, &source))
            .into();
    settings.push(FoundSetting::from_log("camera.distortion", coefficients, &source));
    if camera.model != Model::RadialTangential {
        settings.push(FoundSetting::from_log("camera.model", camera.model.name(), &source));
    }
    settings
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};

    use super::transforms::Transform;
    use super::*;

    fn headers(frame: &str, count: u32, rate: f64) -> Headers {
        let last = Stamp::default().offset_by(f64::from(count - 1) / rate);
        Headers { frame: frame.to_owned(), child: None, count, first: Stamp::default(), last }
    }

    fn info(frame: &str, fx: f64) -> CameraInfo {
        CameraInfo {
            frame: frame.to_owned(),
            size: (640, 480),
            model: "plumb_bob".to_owned(),
            intrinsic: [fx, fx, 320.0, 240.0],
            ..CameraInfo::default()
        }
    }

    fn observed(topics: &[(&str, &str)], infos: &[(&str, &str, f64)]) -> Observed {
        let headers = topics.iter().map(|(t, f)| ((*t).to_owned(), headers(f, 11, 30.0))).collect();
        let infos = infos.iter().map(|(t, f, fx)| ((*t).to_owned(), info(f, *fx))).collect();
        Observed { headers, infos, ..Observed::default() }
    }

    fn value<'a>(found: &'a FoundCalibration, key: &str) -> Option<&'a FoundSetting> {
        found.settings.iter().find(|setting| setting.key == key)
    }

    #[test]
    fn the_calibration_beside_the_image_counts() {
        let seen = observed(
            &[
                ("/cam/color/image_raw", "color"),
                ("/cam/infra1/image_raw", "infra1"),
                ("/image", "x"),
            ],
            &[
                ("/cam/color/camera_info", "", 600.0),
                ("/cam/infra1/camera_info", "", 380.0),
                ("/elsewhere/info", "x", 100.0),
            ],
        );
        let focal = |topic: &str| seen.info_of(topic).map(|(_, info)| info.intrinsic[0]);
        assert_eq!(focal("/cam/color/image_raw"), Some(600.0));
        assert_eq!(focal("/cam/infra1/image_raw/compressed"), Some(380.0));
        // Not beside it, but of the same frame.
        assert_eq!(focal("/image"), Some(100.0));
        assert_eq!(focal("/other/image_raw"), None);
        let rate = seen.rate("/image").unwrap();
        assert!((rate - 30.0).abs() < 1e-6, "{rate}");
    }

    #[test]
    fn mountings_come_from_transforms_before_conventions() {
        let (color, imu) = ("camera_color_optical_frame", "camera_imu_optical_frame");
        let mut seen = observed(&[("/camera/color/image_raw", color), ("/camera/imu", imu)], &[]);
        let streams = Streams {
            color: Some("/camera/color/image_raw"),
            imu: Some("/camera/imu"),
            ..Streams::default()
        };
        let by_name = seen.settings(&streams);
        let setting = value(&by_name, "camera.imu_from_camera").unwrap();
        assert_eq!(setting.value, matrix(&Isometry3::identity()));
        // Their distance is not known, so it is estimated.
        assert!(value(&by_name, "filter.camera_translation_sd").is_some());
        let turn = UnitQuaternion::from_euler_angles(0.1, 0.2, 0.3);
        let imu_from_color = Isometry3::from_parts(Vector3::new(0.02, 0.0, 0.01).into(), turn);
        seen.tree.add(Transform {
            parent: imu.to_owned(),
            child: color.to_owned(),
            parent_from_child: imu_from_color,
        });
        let by_transform = seen.settings(&streams);
        let setting = value(&by_transform, "camera.imu_from_camera").unwrap();
        assert_eq!(setting.value, matrix(&imu_from_color));
        assert!(value(&by_transform, "filter.camera_translation_sd").is_none());
        assert_eq!(by_transform.device.as_deref(), Some("RealSense D400"));
        let FoundIn::SensorClass(source) = &value(&by_transform, "imu.gyro_noise").unwrap().source
        else {
            panic!("the log holds no noise")
        };
        assert!(source.contains("BMI055"), "{source}");
    }

    #[test]
    fn frames_of_different_devices_say_nothing_of_a_mounting() {
        assert!(share_optical_axes("cam_1_color_optical_frame", "cam_1_gyro_optical_frame"));
        assert!(!share_optical_axes("left_color_optical_frame", "right_imu_optical_frame"));
        assert!(!share_optical_axes("camera_color_optical_frame", "imu_link"));
        assert!(!share_optical_axes("camera", "camera"));
    }

    #[test]
    fn the_body_of_the_reference_is_brought_to_the_imu() {
        let mut seen = observed(&[("/imu", "imu"), ("/vicon/pose", "world")], &[]);
        seen.tree.add(Transform {
            parent: "base".to_owned(),
            child: "imu".to_owned(),
            parent_from_child: Isometry3::translation(0.1, 0.0, 0.0),
        });
        seen.tree.add(Transform {
            parent: "base".to_owned(),
            child: "vicon_marker".to_owned(),
            parent_from_child: Isometry3::translation(0.0, 0.2, 0.0),
        });
        let streams =
            Streams { imu: Some("/imu"), truth: Some("/vicon/pose"), ..Streams::default() };
        let found = seen.settings(&streams);
        let setting = value(&found, "log.truth_body_from_imu").unwrap();
        assert_eq!(setting.value, matrix(&Isometry3::translation(0.1, -0.2, 0.0)));
        // Poses that say whose they are need no guess.
        seen.headers.get_mut("/vicon/pose").unwrap().child = Some("imu".to_owned());
        assert!(value(&seen.settings(&streams), "log.truth_body_from_imu").is_none());
    }

    #[test]
    fn what_cannot_be_used_is_told() {
        let seen = observed(&[("/c/image_raw", "c")], &[("/c/camera_info", "c", 0.0)]);
        let streams = Streams { color: Some("/c/image_raw"), ..Streams::default() };
        let found = seen.settings(&streams);
        assert!(value(&found, "camera.fx").is_none());
        assert!(found.problems[0].starts_with("/c/camera_info is not calibrated"), "{found:?}");
    }
}
