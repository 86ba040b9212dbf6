use std::fmt;
use std::path::Path;

use nalgebra::{Isometry3, Matrix3, Quaternion, Rotation3, UnitQuaternion, Vector3};

use super::{EvaluationError, Trajectory};

/// Layout of a text file of poses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrajectoryFormat {
    /// `t tx ty tz qx qy qz qw`, seconds; separated by blanks (or commas). The ground truth of
    /// VCU-RVI is of this kind too.
    Tum,
    /// `t,px,py,pz,qw,qx,qy,qz[,...]`, nanoseconds: EuRoC's ground truth, the output of VINS-Mono
    /// and its kin and of the VCU-RVI authors.
    Euroc,
    /// Twelve numbers a line, the upper three rows of the pose matrix; no stamps: the line number
    /// from 0 stands for the stamp.
    Kitti,
}

impl fmt::Display for TrajectoryFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Tum => "TUM",
            Self::Euroc => "EuRoC csv",
            Self::Kitti => "KITTI",
        })
    }
}

/// What was read.
#[derive(Debug, Clone, PartialEq)]
pub struct TrajectoryFile {
    pub trajectory: Trajectory,
    pub format: TrajectoryFormat,
    /// Poses that came before an earlier line's and were put in order.
    pub reordered: usize,
}

/// Reads a trajectory whose format is guessed from its first line of numbers.
///
/// Lines that are empty or start with `#` are left out, and one line of column names at the top.
/// Quaternions are normalised, rotation matrices re-orthonormalised; those far from it, numbers
/// that are not finite and lines of another length are errors with the line's number.
pub fn read_trajectory(path: &Path) -> Result<TrajectoryFile, EvaluationError> {
    let bytes = std::fs::read(path)
        .map_err(|error| EvaluationError::Io { path: path.to_owned(), error })?;
    let text = std::str::from_utf8(&bytes).map_err(|_| EvaluationError::Format {
        path: path.to_owned(),
        reason: "not a text file".to_owned(),
    })?;
    parse_trajectory(text).map_err(|e| match e {
        TextError::Line(line, reason) => {
            EvaluationError::Parse { path: path.to_owned(), line, reason }
        }
        TextError::Whole(reason) => EvaluationError::Format { path: path.to_owned(), reason },
    })
}

/// An error without the name of the file.
#[derive(Debug, PartialEq)]
enum TextError {
    Line(usize, String),
    Whole(String),
}

fn parse_trajectory(text: &str) -> Result<TrajectoryFile, TextError> {
    let text = text.trim_start_matches('\u{feff}');
    let mut layout = None;
    let mut header_seen = false;
    let (mut stamps, mut poses) = (Vec::new(), Vec::new());
    for (line, number) in text.lines().map(str::trim).zip(1..) {
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let here = |reason: String| TextError::Line(number, reason);
        let layout = match &layout {
            Some(known) => known,
            None if !header_seen && is_header(line) => {
                header_seen = true;
                continue;
            }
            None => layout.insert(Layout::guess(line).map_err(here)?),
        };
        let (stamp, pose) = layout.read(line, poses.len()).map_err(here)?;
        stamps.push(stamp);
        poses.push(pose);
    }
    let Some(layout) = layout else {
        return Err(TextError::Whole("holds no poses".to_owned()));
    };
    let reordered = stamps.windows(2).filter(|w| w[1] < w[0]).count();
    if reordered > 0 {
        let mut rows: Vec<(f64, Isometry3<f64>)> = stamps.into_iter().zip(poses).collect();
        rows.sort_by(|a, b| a.0.total_cmp(&b.0));
        (stamps, poses) = rows.into_iter().unzip();
    }
    let trajectory = Trajectory::new(stamps, poses).map_err(|e| TextError::Whole(e.to_string()))?;
    Ok(TrajectoryFile { trajectory, format: layout.format, reordered })
}

/// Column names: the first field does not start like a number.
fn is_header(line: &str) -> bool {
    let first = line.split([',', ' ', '\t']).next().unwrap_or_default();
    first.parse::<f64>().is_err() && first.starts_with(|c: char| c.is_alphabetic() || c == '"')
}

struct Layout {
    format: TrajectoryFormat,
    commas: bool,
    /// Fields a line.
    columns: usize,
}

/// Stamps from here on cannot be seconds (the year 5138); below, nanoseconds are told by having no
/// decimal point.
const NANOSECONDS_FROM: f64 = 1e11;

impl Layout {
    fn guess(line: &str) -> Result<Self, String> {
        let commas = line.contains(',');
        let fields: Vec<&str> = fields(line, commas).collect();
        let columns = fields.len();
        let integer_stamp = fields.first().is_some_and(|f| f.bytes().all(|b| b.is_ascii_digit()));
        let stamp = fields.first().and_then(|f| f.parse::<f64>().ok()).unwrap_or(0.0);
        let format = match (commas, columns) {
            (false, 12) => TrajectoryFormat::Kitti,
            (false, 8) => TrajectoryFormat::Tum,
            (true, 8..) if integer_stamp || stamp >= NANOSECONDS_FROM => TrajectoryFormat::Euroc,
            (true, 8) => TrajectoryFormat::Tum,
            _ => {
                return Err(format!(
                    "{columns} fields separated by {}: neither TUM (t x y z qx qy qz qw), EuRoC csv (t_ns,x,y,z,qw,qx,qy,qz,...) nor KITTI (12 numbers)",
                    if commas { "commas" } else { "blanks" }
                ));
            }
        };
        Ok(Self { format, commas, columns })
    }

    /// Stamp (s) and pose of a line; `index` is the number of poses before it.
    fn read(&self, line: &str, index: usize) -> Result<(f64, Isometry3<f64>), String> {
        // Only the first 12 fields can matter.
        let mut values = [0.0; 12];
        let mut count = 0;
        for field in fields(line, self.commas) {
            if let Some(value) = values.get_mut(count) {
                *value = number(field)?;
            }
            count += 1;
        }
        if count != self.columns {
            return Err(format!("{count} fields where the lines before have {}", self.columns));
        }
        let v = &values;
        let position = Vector3::new(v[1], v[2], v[3]);
        let (stamp, position, rotation) = match self.format {
            TrajectoryFormat::Tum => (v[0], position, unit_quaternion(v[7], v[4], v[5], v[6])?),
            TrajectoryFormat::Euroc => {
                (v[0] / 1e9, position, unit_quaternion(v[4], v[5], v[6], v[7])?)
            }
            TrajectoryFormat::Kitti => (
                index as f64,
                Vector3::new(v[3], v[7], v[11]),
                unit_rotation(&Matrix3::new(
                    v[0], v[1], v[2], v[4], v[5], v[6], v[8], v[9], v[10],
                ))?,
            ),
        };
        Ok((stamp, Isometry3::from_parts(position.into(), rotation)))
    }
}

/// A separator at the end of the line ends the last field and starts none.
fn fields(line: &str, commas: bool) -> impl Iterator<Item = &str> {
    let line = if commas { line.trim_end_matches(',') } else { line };
    let is_separator = move |c: char| if commas { c == ',' } else { c == ' ' || c == '\t' };
    line.split(is_separator).map(str::trim).filter(move |field| commas || !field.is_empty())
}

fn number(field: &str) -> Result<f64, String> {
    match field.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        Ok(_) => Err(format!("{field} is not finite")),
        Err(_) => Err(format!("{field:?} is not a number")),
    }
}

/// Largest accepted difference of a quaternion's norm from 1, and of `M^T M` from the identity
/// (Frobenius norm): more is a matter of wrong columns, not of digits.
const NORM_TOLERANCE: f64 = 0.1;

fn unit_quaternion(w: f64, x: f64, y: f64, z: f64) -> Result<UnitQuaternion<f64>, String> {
    let quaternion = Quaternion::new(w, x, y, z);
    let norm = quaternion.norm();
    if (norm - 1.0).abs() > NORM_TOLERANCE {
        return Err(format!(
            "the quaternion's norm is {norm:.3}, not 1: are the columns in order?"
        ));
    }
    Ok(UnitQuaternion::new_normalize(quaternion))
}

fn unit_rotation(matrix: &Matrix3<f64>) -> Result<UnitQuaternion<f64>, String> {
    let residual = (matrix.transpose() * matrix - Matrix3::identity()).norm();
    if residual > NORM_TOLERANCE || matrix.determinant() < 0.0 {
        return Err("the left 3x3 block of the pose is not a rotation".to_owned());
    }
    Ok(UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(matrix)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;

    #[test]
    fn tum_with_comments_blank_lines_and_windows_line_ends() {
        let file = parse_trajectory(
            "\u{feff}# t x y z qx qy qz qw\r\n\r\n1305031102.1753 1 2 3 0 0 0 1\r\n1305031102.2\t4  5 6 0.5 0.5 0.5 0.5 \r\n",
        )
        .unwrap();
        assert_eq!(file.format, TrajectoryFormat::Tum);
        assert_eq!(file.trajectory.stamps(), [1305031102.1753, 1305031102.2]);
        let pose = file.trajectory.poses()[1];
        assert_eq!(pose.translation.vector, Vector3::new(4.0, 5.0, 6.0));
        assert_relative_eq!(pose * Vector3::x(), Vector3::y(), epsilon = 1e-15);
    }

    #[test]
    fn euroc_in_nanoseconds_with_w_first() {
        let text = "#timestamp, p_RS_R_x [m], ...\n1403715524907143168,0.5,1.9,0.9,0,0,0,1,7,8,9\n";
        let file = parse_trajectory(text).unwrap();
        assert_eq!(file.format, TrajectoryFormat::Euroc);
        assert_eq!(file.trajectory.stamps(), [1_403_715_524.907_143]);
        assert_eq!(file.trajectory.poses()[0].rotation.quaternion().k, 1.0);
        // Time since the start of the device, and a comma at the end of the line.
        let text =
            "5636080283391,0.004,0.01,0.05,0.78888,0.17280,-0.56721,0.16150,0.0,-0.06,0.1,\n";
        let file = parse_trajectory(text).unwrap();
        assert_relative_eq!(file.trajectory.stamps()[0], 5636.080283391);
        assert_relative_eq!(
            file.trajectory.poses()[0].rotation.quaternion().w,
            0.78888,
            epsilon = 1e-5
        );
    }

    #[test]
    fn kitti_counts_lines() {
        let text = "1 0 0 4 0 0 -1 5 0 1 0 6\n1 0 0 4 0 1 0 5 0 0 1 6\n";
        let file = parse_trajectory(text).unwrap();
        assert_eq!(file.format, TrajectoryFormat::Kitti);
        assert_eq!(file.trajectory.stamps(), [0.0, 1.0]);
        let pose = file.trajectory.poses()[0];
        assert_eq!(pose.translation.vector, Vector3::new(4.0, 5.0, 6.0));
        assert_relative_eq!(pose * Vector3::y(), Vector3::z(), epsilon = 1e-15);
    }

    #[test]
    fn a_line_of_names_may_come_first() {
        let text = "timestamp tx ty tz qx qy qz qw\n0 1 2 3 0 0 0 1\n";
        assert_eq!(parse_trajectory(text).unwrap().trajectory.len(), 1);
    }

    #[test]
    fn poses_out_of_order_are_sorted_and_counted() {
        let text = "1 0 0 0 0 0 0 1\n3 3 0 0 0 0 0 1\n2 2 0 0 0 0 0 1\n";
        let file = parse_trajectory(text).unwrap();
        assert_eq!(file.reordered, 1);
        assert_eq!(file.trajectory.stamps(), [1.0, 2.0, 3.0]);
        assert_eq!(file.trajectory.poses()[1].translation.x, 2.0);
    }

    #[test]
    fn what_is_wrong_is_named_with_its_line() {
        let good = "0 1 2 3 0 0 0 1\n";
        for (bad, word) in [
            ("1 1 2 3 0 0 0", "7 fields"),
            ("1 1 2 x 0 0 0 1", "\"x\""),
            ("1 1 2 nan 0 0 0 1", "nan"),
            ("1 1 2 3 0 0 0 0", "norm is 0.000"),
            ("1 0 0 0 1 1 2 3", "norm"),
        ] {
            match parse_trajectory(&format!("{good}# comment\n{bad}\n")) {
                Err(TextError::Line(3, reason)) => assert!(reason.contains(word), "{reason}"),
                other => panic!("{bad}: {other:?}"),
            }
        }
        let twelve = "1 0 0 4 0 2 0 5 0 0 1 6\n";
        assert!(matches!(parse_trajectory(twelve), Err(TextError::Line(1, _))));
        assert!(matches!(parse_trajectory("1 2 3\n"), Err(TextError::Line(1, _))));
        assert!(matches!(parse_trajectory("# nothing\n"), Err(TextError::Whole(_))));
    }
}
