//! ROS messages, as serialised by ROS 1 and as CDR (ROS 2).
//!
//! The two differ in alignment, the header's fields and the terminating zero of strings; the
//! order of the other fields is the same. Formats: <http://wiki.ros.org/ROS/Technical%20Overview>,
//! OMG DDS-XTypes 1.3, 7.4.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};

use super::TruthPose;
use super::pixels::{RawImage, Rejection};
use crate::inertial::ImuConfig;
use crate::sensor::Stamp;

/// How the messages of a channel are serialised.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Serialization {
    Ros1,
    Cdr,
}

/// Message types that are read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum MessageType {
    Image,
    CompressedImage,
    Imu,
    PoseStamped,
    TransformStamped,
    Odometry,
    CameraInfo,
    Transforms,
    NavSatFix,
    MagneticField,
    /// `geometry_msgs/Vector3Stamped`, by which older drivers publish the magnetic field.
    Vector3Stamped,
    NmeaSentence,
}

impl MessageType {
    /// From `sensor_msgs/Image` or `sensor_msgs/msg/Image`.
    pub fn from_name(name: &str) -> Option<Self> {
        match name.replace("/msg/", "/").as_str() {
            "sensor_msgs/Image" => Some(Self::Image),
            "sensor_msgs/CompressedImage" => Some(Self::CompressedImage),
            "sensor_msgs/Imu" => Some(Self::Imu),
            "geometry_msgs/PoseStamped" => Some(Self::PoseStamped),
            "geometry_msgs/TransformStamped" => Some(Self::TransformStamped),
            "nav_msgs/Odometry" => Some(Self::Odometry),
            "sensor_msgs/CameraInfo" => Some(Self::CameraInfo),
            "tf2_msgs/TFMessage" | "tf/tfMessage" => Some(Self::Transforms),
            "sensor_msgs/NavSatFix" => Some(Self::NavSatFix),
            "sensor_msgs/MagneticField" => Some(Self::MagneticField),
            "geometry_msgs/Vector3Stamped" => Some(Self::Vector3Stamped),
            "nmea_msgs/Sentence" => Some(Self::NmeaSentence),
            _ => None,
        }
    }
}

/// Fields of a message one after the other.
pub(super) struct Fields<'a> {
    data: &'a [u8],
    position: usize,
    layout: Layout,
}

#[derive(Clone, Copy)]
enum Layout {
    Ros1,
    Cdr { big_endian: bool, largest_alignment: usize },
}

impl<'a> Fields<'a> {
    pub fn new(data: &'a [u8], serialization: Serialization) -> Result<Self, Rejection> {
        if serialization == Serialization::Ros1 {
            return Ok(Self { data, position: 0, layout: Layout::Ros1 });
        }
        let Some((&[high, low, _, _], body)) = data.split_first_chunk() else {
            return Err(Rejection::new("message too short", format!("{} bytes", data.len())));
        };
        // Representation identifiers of plain CDR (XCDR 1: 0, 1; XCDR 2: 6, 7), odd: little endian.
        let largest_alignment = match (high, low) {
            (0, 0 | 1) => 8,
            (0, 6 | 7) => 4,
            _ => {
                let detail = format!("representation {high:#04x}{low:02x}");
                return Err(Rejection::new("unsupported serialization", detail));
            }
        };
        let layout = Layout::Cdr { big_endian: low % 2 == 0, largest_alignment };
        Ok(Self { data: body, position: 0, layout })
    }

    fn bytes(&mut self, count: usize) -> Result<&'a [u8], Rejection> {
        let end = self.position.checked_add(count);
        let Some(bytes) = end.and_then(|end| self.data.get(self.position..end)) else {
            let detail =
                format!("{count} bytes wanted at {} of {}", self.position, self.data.len());
            return Err(Rejection::new("message too short", detail));
        };
        self.position += count;
        Ok(bytes)
    }

    /// The next primitive, its first byte least significant.
    fn primitive<const N: usize>(&mut self) -> Result<[u8; N], Rejection> {
        if let Layout::Cdr { largest_alignment, .. } = self.layout {
            self.position = self.position.next_multiple_of(N.min(largest_alignment));
        }
        let mut value = [0; N];
        value.copy_from_slice(self.bytes(N)?);
        if matches!(self.layout, Layout::Cdr { big_endian: true, .. }) {
            value.reverse();
        }
        Ok(value)
    }

    pub fn u8(&mut self) -> Result<u8, Rejection> {
        self.primitive().map(u8::from_le_bytes)
    }

    pub fn u16(&mut self) -> Result<u16, Rejection> {
        self.primitive().map(u16::from_le_bytes)
    }

    pub fn u32(&mut self) -> Result<u32, Rejection> {
        self.primitive().map(u32::from_le_bytes)
    }

    pub fn f64(&mut self) -> Result<f64, Rejection> {
        self.primitive().map(f64::from_le_bytes)
    }

    pub fn f64s<const N: usize>(&mut self) -> Result<[f64; N], Rejection> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.f64()?;
        }
        Ok(values)
    }

    fn byte_sequence(&mut self) -> Result<&'a [u8], Rejection> {
        let length = self.u32()?;
        self.bytes(length as usize)
    }

    pub fn text(&mut self) -> Result<&'a str, Rejection> {
        let bytes = self.byte_sequence()?;
        let bytes = bytes.strip_suffix(&[0]).unwrap_or(bytes);
        std::str::from_utf8(bytes).map_err(|e| Rejection::new("text is not UTF-8", e.to_string()))
    }

    /// The stamp of a `std_msgs/Header`.
    pub fn header(&mut self) -> Result<Stamp, Rejection> {
        self.header_and_frame().map(|(stamp, _)| stamp)
    }

    /// `std_msgs/Header`; a frame that is no UTF-8 counts as none.
    pub fn header_and_frame(&mut self) -> Result<(Stamp, &'a str), Rejection> {
        let seconds = match self.layout {
            Layout::Ros1 => {
                let _sequence = self.u32()?;
                i64::from(self.u32()?)
            }
            Layout::Cdr { .. } => i64::from(self.u32()?.cast_signed()),
        };
        let nanos = self.u32()?;
        if nanos >= 1_000_000_000 {
            return Err(Rejection::new("invalid stamp", format!("{seconds} s and {nanos} ns")));
        }
        let frame = self.byte_sequence()?;
        let frame = std::str::from_utf8(frame.strip_suffix(&[0]).unwrap_or(frame));
        Ok((Stamp::from_parts(seconds, i64::from(nanos)), frame.unwrap_or_default()))
    }

    pub fn vector(&mut self) -> Result<Vector3<f64>, Rejection> {
        self.f64s::<3>().map(Vector3::from)
    }
}

pub(super) fn image<'a>(mut fields: Fields<'a>) -> Result<(Stamp, RawImage<'a>), Rejection> {
    let stamp = fields.header()?;
    let (height, width) = (fields.u32()?, fields.u32()?);
    let encoding = fields.text()?;
    let big_endian = fields.u8()? != 0;
    let step = fields.u32()?;
    let data = fields.byte_sequence()?;
    Ok((stamp, RawImage { width, height, encoding, big_endian, step, data }))
}

/// `sensor_msgs/CompressedImage`.
pub(super) struct CompressedImage<'a> {
    pub stamp: Stamp,
    /// Free text of the publisher (`"jpeg"`, `"16UC1; compressedDepth"`).
    pub format: &'a str,
    pub data: &'a [u8],
}

pub(super) fn compressed_image<'a>(
    mut fields: Fields<'a>,
) -> Result<CompressedImage<'a>, Rejection> {
    let stamp = fields.header()?;
    Ok(CompressedImage { stamp, format: fields.text()?, data: fields.byte_sequence()? })
}

/// What of a `sensor_msgs/Imu` is measured, in SI units; both or one of the two.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct InertialReading {
    pub stamp: Stamp,
    pub angular_velocity: Option<Vector3<f64>>,
    pub specific_force: Option<Vector3<f64>>,
}

impl InertialReading {
    /// Taking zeros, which no accelerometer reads, for what is not measured.
    pub fn without_zeros(self) -> Self {
        let nonzero = |value: &Vector3<f64>| *value != Vector3::zeros();
        Self {
            stamp: self.stamp,
            angular_velocity: self.angular_velocity.filter(nonzero),
            specific_force: self.specific_force.filter(nonzero),
        }
    }
}

/// `sensor_msgs/Imu`. Where the covariance of a quantity begins with -1, it is not measured by
/// definition of the message; zeros that stand for that are left to whoever knows the topic.
pub(super) fn imu(mut fields: Fields, config: &ImuConfig) -> Result<InertialReading, Rejection> {
    let stamp = fields.header()?;
    let _orientation: ([f64; 4], [f64; 9]) = (fields.f64s()?, fields.f64s()?);
    let mut measured = || -> Result<Option<Vector3<f64>>, Rejection> {
        let (value, covariance) = (fields.vector()?, fields.f64s::<9>()?);
        Ok((covariance[0] != -1.0).then_some(value))
    };
    let reading = InertialReading {
        stamp,
        angular_velocity: measured()?.map(|rate| rate * config.gyroscope_scale),
        specific_force: measured()?.map(|force| force * config.accelerometer_scale),
    };
    let [rate, force] = [reading.angular_velocity, reading.specific_force];
    if rate.is_none() && force.is_none() {
        let detail = format!("both covariances are -1 at {stamp} s");
        return Err(Rejection::new("neither gyroscope nor accelerometer in the message", detail));
    }
    if [rate, force].iter().flatten().any(|value| !value.iter().all(|x| x.is_finite())) {
        return Err(Rejection::new("not finite", format!("at {stamp} s")));
    }
    Ok(reading)
}

/// Pose of a `PoseStamped`, `TransformStamped` or `Odometry` message.
pub(super) fn pose(mut fields: Fields, kind: MessageType) -> Result<TruthPose, Rejection> {
    let stamp = fields.header()?;
    if matches!(kind, MessageType::TransformStamped | MessageType::Odometry) {
        let _child_frame = fields.byte_sequence()?;
    }
    let position = fields.vector()?;
    let [x, y, z, w] = fields.f64s()?;
    let world_from_body = isometry(position, [x, y, z, w])?;
    Ok(TruthPose { stamp, world_from_body })
}

/// From a position and a quaternion `x y z w` that is of unit length up to its printed digits.
pub(super) fn isometry(
    position: Vector3<f64>,
    [x, y, z, w]: [f64; 4],
) -> Result<Isometry3<f64>, Rejection> {
    let quaternion = Quaternion::new(w, x, y, z);
    let norm = quaternion.norm();
    if !position.iter().all(|x| x.is_finite()) || !norm.is_finite() {
        return Err(Rejection::new("not finite", format!("{position:?} {quaternion:?}")));
    }
    if (norm - 1.0).abs() > 0.05 {
        return Err(Rejection::new("not a unit quaternion", format!("{x} {y} {z} {w}")));
    }
    let rotation = UnitQuaternion::from_quaternion(quaternion);
    Ok(Isometry3::from_parts(Translation3::from(position), rotation))
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use proptest::prelude::*;

    use super::*;

    // Serialised by the Python package rosbags 0.11: stamp 5645 s 180000001 ns, frames of odd
    // lengths, so that alignment matters.
    const HEADER: &str = "0d1600000195ba0a";
    const POSE: &str = "000000000000f83f00000000000002c00000000000000840000000000000e03f\
                        000000000000e0bf000000000000e03f000000000000e03f";

    fn bytes(parts: &[&str]) -> Vec<u8> {
        let digits: Vec<u8> = parts.concat().bytes().collect();
        let byte = |pair: &[u8]| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16);
        digits.chunks(2).map(|pair| byte(pair).unwrap()).collect()
    }

    fn stamp() -> Stamp {
        Stamp::from_parts(5645, 180_000_001)
    }

    fn check_pose(data: &[u8], serialization: Serialization, kind: MessageType) {
        let pose = pose(Fields::new(data, serialization).unwrap(), kind).unwrap();
        assert_eq!(pose.stamp, stamp());
        assert_eq!(pose.world_from_body.translation.vector, Vector3::new(1.5, -2.25, 3.0));
        let expected = UnitQuaternion::from_quaternion(Quaternion::new(0.5, 0.5, -0.5, 0.5));
        assert_relative_eq!(pose.world_from_body.rotation, expected, epsilon = 1e-15);
    }

    #[test]
    fn poses_of_all_types_and_serializations() {
        use MessageType::*;
        use Serialization::*;
        for (start, serialization, kind) in [
            ("070000000d1600000195ba0a050000006f646f6d31", Ros1, PoseStamped),
            ("070000000d1600000195ba0a010000007704000000626f6479", Ros1, TransformStamped),
            ("070000000d1600000195ba0a01000000770100000062", Ros1, Odometry),
            ("000100000d1600000195ba0a060000006f646f6d3100000000000000", Cdr, PoseStamped),
            (
                "000100000d1600000195ba0a020000007700000005000000626f64790000000000000000",
                Cdr,
                TransformStamped,
            ),
            ("000100000d1600000195ba0a02000000770000000200000062000000", Cdr, Odometry),
        ] {
            check_pose(&bytes(&[start, POSE]), serialization, kind);
        }
        let big = "000000000000160d0aba9501000000066f646f6d31000000000000003ff8000000000000c002\
                   00000000000040080000000000003fe0000000000000bfe00000000000003fe0000000000000\
                   3fe0000000000000";
        check_pose(&bytes(&[big]), Cdr, PoseStamped);
    }

    #[test]
    fn images_of_all_serializations() {
        let ros1 = "070000000d1600000195ba0a0300000063616d02000000010000000400000038554333000400\
                    0000080000000102030004050600";
        let little = "000100000d1600000195ba0a0400000063616d00020000000100000005000000385543330000\
                      000004000000080000000102030004050600";
        let big = "000000000000160d0aba95010000000463616d00000000020000000100000005385543330000\
                   000000000004000000080102030004050600";
        for (data, serialization) in [
            (bytes(&[ros1]), Serialization::Ros1),
            (bytes(&[little]), Serialization::Cdr),
            (bytes(&[big]), Serialization::Cdr),
        ] {
            let (read, raw) = image(Fields::new(&data, serialization).unwrap()).unwrap();
            assert_eq!((read, raw.width, raw.height, raw.step), (stamp(), 1, 2, 4));
            assert_eq!((raw.encoding, raw.big_endian), ("8UC3", false));
            assert_eq!(raw.data, [1, 2, 3, 0, 4, 5, 6, 0]);
        }
    }

    #[test]
    fn compressed_images() {
        let ros1 = bytes(&["070000000d1600000195ba0a0100000063040000006a70656703000000090807"]);
        let cdr = bytes(&[
            "000100000d1600000195ba0a0200000063000000050000006a7065670000000003000000090807",
        ]);
        for (data, serialization) in [(ros1, Serialization::Ros1), (cdr, Serialization::Cdr)] {
            let image = compressed_image(Fields::new(&data, serialization).unwrap()).unwrap();
            assert_eq!((image.stamp, image.format, image.data), (stamp(), "jpeg", &[9, 8, 7][..]));
        }
    }

    /// The message of rosbags: angular velocity 0.1 0.2 0.3, acceleration -1 0 0.5.
    fn imu_message(frame: &str, covariance: &str) -> Vec<u8> {
        let zeros = "00".repeat(72);
        let rates = "9a9999999999b93f9a9999999999c93f333333333333d33f";
        let acceleration = "000000000000f0bf0000000000000000000000000000e03f";
        let orientation = format!("{}000000000000f03f", "00".repeat(24));
        let last = format!("{covariance}{}", "00".repeat(64));
        bytes(&[frame, &orientation, &zeros, rates, &zeros, acceleration, &last])
    }

    #[test]
    fn imu_in_both_serializations_with_its_units() {
        let config = ImuConfig { accelerometer_scale: -9.81, ..ImuConfig::default() };
        let ros1 = imu_message(&format!("07000000{HEADER}03000000696d75"), &"00".repeat(8));
        let cdr = imu_message(&format!("00010000{HEADER}04000000696d7500"), &"00".repeat(8));
        for (data, serialization) in [(ros1, Serialization::Ros1), (cdr, Serialization::Cdr)] {
            let sample = imu(Fields::new(&data, serialization).unwrap(), &config).unwrap();
            assert_eq!(sample.stamp, stamp());
            assert_eq!(sample.angular_velocity, Some(Vector3::new(0.1, 0.2, 0.3)));
            assert_relative_eq!(sample.specific_force.unwrap(), Vector3::new(9.81, 0.0, -4.905));
        }
    }

    #[test]
    fn covariance_minus_one_marks_what_is_not_measured() {
        let read = |data: &[u8]| {
            imu(Fields::new(data, Serialization::Ros1).unwrap(), &ImuConfig::default())
        };
        let mut data = imu_message(&format!("07000000{HEADER}00000000"), "000000000000f0bf");
        let reading = read(&data).unwrap();
        assert_eq!(reading.angular_velocity, Some(Vector3::new(0.1, 0.2, 0.3)));
        assert_eq!(reading.specific_force, None);
        let rate_covariance = 16 + 32 + 72 + 24;
        data[rate_covariance..rate_covariance + 8].copy_from_slice(&(-1_f64).to_le_bytes());
        let reason = read(&data).unwrap_err().reason;
        assert_eq!(reason, "neither gyroscope nor accelerometer in the message");
    }

    #[test]
    fn imu_with_nan_is_rejected() {
        let mut data = imu_message(&format!("07000000{HEADER}00000000"), &"00".repeat(8));
        let rates = 16 + 32 + 72;
        data[rates..rates + 8].copy_from_slice(&f64::NAN.to_le_bytes());
        let fields = Fields::new(&data, Serialization::Ros1).unwrap();
        assert_eq!(imu(fields, &ImuConfig::default()).unwrap_err().reason, "not finite");
    }

    #[test]
    fn lengths_beyond_the_message_are_rejected() {
        let data = bytes(&["07000000", HEADER, "ffffffff"]);
        let error = image(Fields::new(&data, Serialization::Ros1).unwrap()).unwrap_err();
        assert_eq!(error.reason, "message too short");
        let error = Fields::new(&[0, 3, 0, 0], Serialization::Cdr).err().unwrap();
        assert_eq!(error.reason, "unsupported serialization");
    }

    proptest! {
        #[test]
        fn any_bytes_are_read_or_rejected(data in prop::collection::vec(any::<u8>(), 0..400)) {
            for serialization in [Serialization::Ros1, Serialization::Cdr] {
                let fields = || Fields::new(&data, serialization).ok();
                let _ = fields().map(image);
                let _ = fields().map(|fields| imu(fields, &ImuConfig::default()));
                let _ = fields().map(|fields| pose(fields, MessageType::Odometry));
                let _ = fields().map(compressed_image);
            }
        }
    }
}
