//! Message definitions, and messages from ROS 1 serialization to CDR by them.
//!
//! The text of a definition holds one field a line, then, after lines of `=`, those of the types
//! that it mentions (<https://wiki.ros.org/msg>). ROS 2 has other names for times and constants
//! apart, its header lacks the sequence number, and names of fields are in lower case.

use std::collections::BTreeMap;
use std::fmt::Write;

use super::pixels::Rejection;

/// Types nested deeper than this, or of more types in all, are taken for damage.
const DEEPEST: usize = 16;
const MOST_TYPES: usize = 1000;

/// The encapsulation of plain little-endian CDR.
pub(super) const CDR_HEADER: [u8; 4] = [0, 1, 0, 0];

/// A message type whose layout is known.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Definition {
    /// In ROS 1: `sensor_msgs/Image`.
    name: String,
    fields: Vec<Field>,
}

#[derive(Debug, Clone, PartialEq)]
struct Field {
    name: String,
    kind: Kind,
    count: Count,
}

#[derive(Debug, Clone, PartialEq)]
enum Kind {
    /// Name in ROS 2 and size, bytes.
    Number(&'static str, usize),
    Text,
    /// `time` or `duration`, by its name in ROS 2: two numbers of four bytes.
    Moment(&'static str),
    /// Without the sequence number that ROS 1 puts first.
    Header,
    Nested(Definition),
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Count {
    One,
    Fixed(usize),
    Variable,
}

impl Definition {
    /// `name` as in ROS 1, with the text that describes it.
    pub fn parse(name: &str, text: &str) -> Result<Self, Rejection> {
        let mut parts: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
        let mut current = name;
        for line in text.lines() {
            let line = line.split('#').next().unwrap_or_default().trim();
            if let Some(next) = line.strip_prefix("MSG:") {
                current = next.trim();
                parts.entry(current).or_default();
            } else if !line.is_empty() && !line.starts_with('=') {
                parts.entry(current).or_default().push(line);
            }
        }
        Self::from_parts(name, &parts, (DEEPEST, &mut { MOST_TYPES }))
    }

    fn from_parts(
        name: &str,
        parts: &BTreeMap<&str, Vec<&str>>,
        (depth, types): (usize, &mut usize),
    ) -> Result<Self, Rejection> {
        let Some((depth, left)) = depth.checked_sub(1).zip(types.checked_sub(1)) else {
            return Err(Rejection::new("message type nested too deeply", name));
        };
        *types = left;
        let lines = parts
            .get(name)
            .ok_or_else(|| Rejection::new("no definition of the message type", name))?;
        let mut fields = Vec::new();
        for line in lines {
            let malformed = || Rejection::new("malformed message definition", *line);
            let (kind, rest) = line.split_once(char::is_whitespace).ok_or_else(malformed)?;
            // Constants are no part of a message.
            if rest.contains('=') {
                continue;
            }
            let (kind, count) = match kind.strip_suffix(']').and_then(|k| k.split_once('[')) {
                None => (kind, Count::One),
                Some((kind, "")) => (kind, Count::Variable),
                Some((kind, n)) => (kind, Count::Fixed(n.parse().map_err(|_| malformed())?)),
            };
            let kind = match Kind::built_in(kind) {
                Some(kind) => kind,
                None => {
                    let package = name.split_once('/').map_or("", |(package, _)| package);
                    let local = format!("{package}/{kind}");
                    let full = if kind.contains('/') { kind } else { &local };
                    Kind::Nested(Self::from_parts(full, parts, (depth, types))?)
                }
            };
            // A default value may follow in ROS 2.
            let name = rest.split_whitespace().next().unwrap_or_default().to_lowercase();
            fields.push(Field { name, kind, count });
        }
        Ok(Self { name: name.to_owned(), fields })
    }

    /// In ROS 2: `sensor_msgs/msg/Image`.
    pub fn ros2_name(&self) -> String {
        match self.name.as_str() {
            "tf/tfMessage" => "tf2_msgs/msg/TFMessage".to_owned(),
            name => name.replacen('/', "/msg/", 1),
        }
    }

    /// The definition in the form of ROS 2.
    pub fn ros2_text(&self) -> String {
        let mut parts = BTreeMap::new();
        self.collect(&mut parts);
        let mut text = self.ros2_fields();
        for (name, fields) in parts {
            let _ = write!(text, "{}\nMSG: {name}\n{fields}", "=".repeat(80));
        }
        text
    }

    fn ros2_fields(&self) -> String {
        let mut text = String::new();
        for Field { name, kind, count } in &self.fields {
            let kind = match kind {
                Kind::Number(kind, _) | Kind::Moment(kind) => kind,
                Kind::Text => "string",
                Kind::Header => "std_msgs/Header",
                Kind::Nested(definition) => definition.name.as_str(),
            };
            let count = match count {
                Count::One => String::new(),
                Count::Fixed(count) => format!("[{count}]"),
                Count::Variable => "[]".to_owned(),
            };
            let _ = writeln!(text, "{kind}{count} {name}");
        }
        text
    }

    /// The types that this one mentions, and theirs.
    fn collect(&self, parts: &mut BTreeMap<String, String>) {
        const MOMENT: &str = "int32 sec\nuint32 nanosec\n";
        for field in &self.fields {
            match &field.kind {
                Kind::Number(..) | Kind::Text => {}
                Kind::Moment(name) => {
                    parts.insert((*name).to_owned(), MOMENT.to_owned());
                }
                Kind::Header => {
                    let header = "builtin_interfaces/Time stamp\nstring frame_id\n".to_owned();
                    parts.insert("std_msgs/Header".to_owned(), header);
                    parts.insert("builtin_interfaces/Time".to_owned(), MOMENT.to_owned());
                }
                Kind::Nested(definition) => {
                    parts.insert(definition.name.clone(), definition.ros2_fields());
                    definition.collect(parts);
                }
            }
        }
    }

    /// A message in ROS 1 serialization as CDR, appended to `cdr`, which must be empty.
    pub fn transcode(&self, ros1: &[u8], cdr: &mut Vec<u8>) -> Result<(), Rejection> {
        cdr.extend(CDR_HEADER);
        let mut transcoder = Transcoder { ros1, position: 0, cdr };
        transcoder.message(self)?;
        let left = ros1.len() - transcoder.position;
        if left > 0 {
            let detail = format!("{left} bytes are left over");
            return Err(Rejection::new("message does not fit its definition", detail));
        }
        Ok(())
    }
}

impl Kind {
    fn built_in(name: &str) -> Option<Self> {
        Some(match name {
            "bool" => Self::Number("bool", 1),
            "int8" => Self::Number("int8", 1),
            "byte" => Self::Number("byte", 1),
            "uint8" | "char" => Self::Number("uint8", 1),
            "int16" => Self::Number("int16", 2),
            "uint16" => Self::Number("uint16", 2),
            "int32" => Self::Number("int32", 4),
            "uint32" => Self::Number("uint32", 4),
            "float32" => Self::Number("float32", 4),
            "int64" => Self::Number("int64", 8),
            "uint64" => Self::Number("uint64", 8),
            "float64" => Self::Number("float64", 8),
            "string" => Self::Text,
            "time" => Self::Moment("builtin_interfaces/Time"),
            "duration" => Self::Moment("builtin_interfaces/Duration"),
            "Header" | "std_msgs/Header" => Self::Header,
            _ => return None,
        })
    }
}

struct Transcoder<'a> {
    ros1: &'a [u8],
    position: usize,
    cdr: &'a mut Vec<u8>,
}

impl<'a> Transcoder<'a> {
    fn message(&mut self, definition: &Definition) -> Result<(), Rejection> {
        // CDR has no empty structures: a byte stands in for one.
        if definition.fields.is_empty() {
            self.cdr.push(0);
        }
        for field in &definition.fields {
            let count = match field.count {
                Count::One => 1,
                Count::Fixed(count) => count,
                Count::Variable => {
                    let length = self.take(4)?;
                    self.align(4);
                    self.cdr.extend(length);
                    u32::from_le_bytes(length.try_into().unwrap_or_default()) as usize
                }
            };
            self.items(&field.kind, count)?;
        }
        Ok(())
    }

    fn items(&mut self, kind: &Kind, count: usize) -> Result<(), Rejection> {
        match kind {
            Kind::Number(_, size) => {
                let bytes = self.take(count.saturating_mul(*size))?;
                if count > 0 {
                    self.align(*size);
                    self.cdr.extend(bytes);
                }
            }
            Kind::Moment(_) => {
                let bytes = self.take(count.saturating_mul(8))?;
                if count > 0 {
                    self.align(4);
                    self.cdr.extend(bytes);
                }
            }
            Kind::Text => {
                for _ in 0..count {
                    self.text()?;
                }
            }
            Kind::Header => {
                for _ in 0..count {
                    let _sequence = self.take(4)?;
                    self.items(&Kind::Moment(""), 1)?;
                    self.text()?;
                }
            }
            Kind::Nested(definition) => {
                for _ in 0..count {
                    let before = self.position;
                    self.message(definition)?;
                    // Empty items would let a few bytes claim any amount of memory.
                    if self.position == before && count > self.ros1.len() {
                        let detail = format!("{count} items");
                        return Err(Rejection::new("message too short", detail));
                    }
                }
            }
        }
        Ok(())
    }

    fn text(&mut self) -> Result<(), Rejection> {
        let length = u32::from_le_bytes(self.take(4)?.try_into().unwrap_or_default());
        let text = self.take(length as usize)?;
        self.align(4);
        self.cdr.extend(length.saturating_add(1).to_le_bytes());
        self.cdr.extend(text);
        self.cdr.push(0);
        Ok(())
    }

    fn take(&mut self, count: usize) -> Result<&'a [u8], Rejection> {
        let end = self.position.checked_add(count);
        let Some(bytes) = end.and_then(|end| self.ros1.get(self.position..end)) else {
            let detail =
                format!("{count} bytes wanted at {} of {}", self.position, self.ros1.len());
            return Err(Rejection::new("message too short", detail));
        };
        self.position += count;
        Ok(bytes)
    }

    /// Alignment counts from after the encapsulation header.
    fn align(&mut self, size: usize) {
        let body = self.cdr.len() - CDR_HEADER.len();
        let padding = body.next_multiple_of(size) - body;
        self.cdr.extend(std::iter::repeat_n(0, padding));
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::samples;
    use super::*;

    const HEADER: &str = "MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n";

    fn image() -> Definition {
        let text = format!(
            "# An image.\nuint8 UNUSED=1\nHeader header\nuint32 height # rows\nuint32 width\n\
             string encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n====\n{HEADER}"
        );
        Definition::parse("sensor_msgs/Image", &text).unwrap()
    }

    fn imu() -> Definition {
        let text = format!(
            "std_msgs/Header header\n\
             geometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n\
             geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n\
             geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n\
             ====\n{HEADER}====\nMSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\n\
             float64 w\n====\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
        );
        Definition::parse("sensor_msgs/Imu", &text).unwrap()
    }

    fn transcoded(definition: &Definition, ros1: &[u8]) -> Vec<u8> {
        let mut cdr = Vec::new();
        definition.transcode(ros1, &mut cdr).unwrap();
        cdr
    }

    #[test]
    fn messages_become_those_that_were_written_as_cdr() {
        let image_of = |cdr| samples::image(cdr, samples::COLOR, "8UC3", 3, 1234, 7).body;
        assert_eq!(transcoded(&image(), &image_of(false)), image_of(true));
        let imu_of = |cdr| samples::imu(cdr, 1234, -1.0).body;
        assert_eq!(transcoded(&imu(), &imu_of(false)), imu_of(true));
    }

    #[test]
    fn names_and_texts_are_those_of_ros_2() {
        assert_eq!(image().ros2_name(), "sensor_msgs/msg/Image");
        let text = image().ros2_text();
        assert!(text.starts_with("std_msgs/Header header\nuint32 height\n"), "{text}");
        assert!(text.contains("MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\n"), "{text}");
        assert!(text.contains("MSG: builtin_interfaces/Time\nint32 sec\n"), "{text}");
        assert!(!text.contains("seq\n") && !text.contains("UNUSED"), "{text}");
        let tf = Definition::parse("tf/tfMessage", "float64[9] K\n").unwrap();
        assert_eq!(tf.ros2_name(), "tf2_msgs/msg/TFMessage");
        assert_eq!(tf.ros2_text(), "float64[9] k\n");
    }

    #[test]
    fn arrays_of_structures_and_texts() {
        let text =
            "Point[] points\nstring[2] names\nduration d\n====\nMSG: a/Point\nint16 x\nbool y";
        let definition = Definition::parse("a/B", text).unwrap();
        let ros1 = b"\x02\0\0\0\x05\0\x01\x06\0\0\x01\0\0\0n\0\0\0\0\x07\0\0\0\x08\0\0\0";
        let cdr = b"\0\x01\0\0\x02\0\0\0\x05\0\x01\0\x06\0\0\0\x02\0\0\0n\0\0\0\x01\0\0\0\0\0\0\0\x07\0\0\0\x08\0\0\0";
        assert_eq!(transcoded(&definition, ros1), cdr);
        let empty = Definition::parse("std_msgs/Empty", "====\nMSG: std_msgs/Empty").unwrap();
        assert_eq!(transcoded(&empty, b""), [0, 1, 0, 0, 0]);
    }

    #[test]
    fn definitions_that_are_none_are_refused() {
        for (text, reason) in [
            ("", "no definition of the message type"),
            ("Point p", "no definition of the message type"),
            ("float64", "malformed message definition"),
            ("float64[x] y", "malformed message definition"),
            ("B b", "message type nested too deeply"),
            ("B b\nB c", "message type nested too deeply"),
        ] {
            assert_eq!(Definition::parse("a/B", text).unwrap_err().reason, reason, "{text}");
        }
    }

    #[test]
    fn absurd_lengths_take_no_memory() {
        let text = "Nothing[] many\n====\nMSG: a/Nothing\n";
        let definition = Definition::parse("a/B", text).unwrap();
        let mut cdr = Vec::new();
        let error = definition.transcode(b"\xff\xff\xff\xff", &mut cdr).unwrap_err();
        assert_eq!(error.reason, "message too short");
        assert!(cdr.len() < 64);
    }

    proptest! {
        #[test]
        fn no_bytes_panic(ros1 in proptest::collection::vec(any::<u8>(), 0..400)) {
            for definition in [image(), imu()] {
                let mut cdr = Vec::new();
                let _ = definition.transcode(&ros1, &mut cdr);
                prop_assert!(cdr.len() <= 2 * ros1.len() + 200);
            }
        }

        #[test]
        fn no_text_panics(text in "[a-z0-9/\\[\\] =#:\nMSG]{0,200}") {
            let _ = Definition::parse("a/B", &text);
        }
    }
}
