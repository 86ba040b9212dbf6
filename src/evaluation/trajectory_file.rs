use std::fmt;
use std::path::Path;

use nalgebra::{Isometry3, Matrix3, Quaternion, Rotation3, UnitQuaternion, Vector3};

use super::{EvaluationError, Trajectory};
use crate::dialect::{Dialect, PoseColumns, Separator, TimeUnit};

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
    /// Poses left out since another line says the same.
    pub repeated: usize,
    /// Poses at the stamp of another pose, and the line of the first of them.
    pub contradicting: usize,
    pub first_contradiction: Option<usize>,
}

/// Reads a trajectory whose format is guessed from its first line of numbers, and its columns from
/// a line of names before it, where there is one that names all of them.
///
/// Lines that are empty or start with `#` are left out. Fields are separated by blanks, commas or
/// semicolons; whole numbers of eleven digits are stamps in nanoseconds. Quaternions are
/// normalised, rotation matrices re-orthonormalised; those far from it, numbers that are not
/// finite, lines of another length and stamps most of which repeat the one before are errors with
/// the line's number.
pub fn read_trajectory(path: &Path) -> Result<TrajectoryFile, EvaluationError> {
    let bytes = std::fs::read(path)
        .map_err(|error| EvaluationError::Io { path: path.to_owned(), error })?;
    let whole = |reason: &str| {
        let reason = reason.to_owned();
        EvaluationError::Format { path: path.to_owned(), reason }
    };
    if bytes.starts_with(&[0xff, 0xfe]) || bytes.starts_with(&[0xfe, 0xff]) {
        return Err(whole("is UTF-16: save it as UTF-8"));
    }
    let text = std::str::from_utf8(&bytes).map_err(|_| whole("not a text file"))?;
    parse_trajectory(text).map_err(|e| match e {
        TextError::Line(line, reason) => {
            EvaluationError::Parse { path: path.to_owned(), line, reason }
        }
        TextError::Whole(reason) => whole(&reason),
    })
}

/// An error without the name of the file.
#[derive(Debug, PartialEq)]
enum TextError {
    Line(usize, String),
    Whole(String),
}

/// A pose and where it stands.
struct Row {
    stamp: f64,
    pose: Isometry3<f64>,
    line: usize,
}

fn parse_trajectory(text: &str) -> Result<TrajectoryFile, TextError> {
    let text = text.trim_start_matches('\u{feff}');
    let mut layout: Option<Layout> = None;
    let mut header = None;
    let mut rows: Vec<Row> = Vec::new();
    for (line, number) in text.lines().map(str::trim).zip(1..) {
        if line.is_empty() || line.starts_with('#') {
            header = PoseColumns::named(line).or(header);
            continue;
        }
        let here = |reason: String| TextError::Line(number, reason);
        let layout = match &layout {
            Some(known) => known,
            None if rows.is_empty() && is_header(line) => {
                header = PoseColumns::named(line).or(header);
                continue;
            }
            None => layout.insert(Layout::guess(line, header).map_err(here)?),
        };
        let (stamp, pose) = layout.read(line, rows.len()).map_err(here)?;
        rows.push(Row { stamp, pose, line: number });
    }
    let Some(layout) = layout else {
        return Err(TextError::Whole("holds no poses".to_owned()));
    };
    if layout.unit == TimeUnit::Seconds && layout.format != TrajectoryFormat::Kitti {
        check_seconds(&mut rows)?;
    }
    in_order(rows, layout.format)
}

/// Poses are not a day apart: whole stamps that are count nanoseconds, others are refused.
const LONGEST_STEP: f64 = 86_400.0;
/// Seconds that nanoseconds in 64 bits can count.
const LARGEST_STAMP: f64 = 9.2e9;

fn check_seconds(rows: &mut [Row]) -> Result<(), TextError> {
    let mut steps: Vec<f64> = rows.windows(2).map(|w| (w[1].stamp - w[0].stamp).abs()).collect();
    steps.sort_unstable_by(f64::total_cmp);
    let is_long = steps.get(steps.len() / 2).is_some_and(|step| *step > LONGEST_STEP);
    if is_long && rows.iter().all(|row| row.stamp.fract() == 0.0) {
        rows.iter_mut().for_each(|row| row.stamp /= 1e9);
    }
    match rows.iter().find(|row| row.stamp.abs() > LARGEST_STAMP) {
        Some(Row { stamp, line, .. }) => {
            Err(TextError::Line(*line, format!("the stamp {stamp} is no time in s")))
        }
        None => Ok(()),
    }
}

/// Sorts the poses, and judges those that share a stamp.
fn in_order(mut rows: Vec<Row>, format: TrajectoryFormat) -> Result<TrajectoryFile, TextError> {
    let reordered = rows.windows(2).filter(|w| w[1].stamp < w[0].stamp).count();
    if reordered > 0 {
        rows.sort_by(|a, b| a.stamp.total_cmp(&b.stamp));
    }
    let read = rows.len();
    rows.dedup_by(|b, a| a.stamp == b.stamp && a.pose == b.pose);
    let repeated = read - rows.len();
    let equal = || rows.windows(2).filter(|w| w[0].stamp == w[1].stamp);
    let (contradicting, first) = (equal().count(), equal().next().map(|w| w[1].line));
    if let Some(line) = first.filter(|_| 2 * contradicting >= rows.len() - 1) {
        return Err(TextError::Line(
            line,
            format!(
                "{contradicting} of {} poses have the stamp of the pose before, here the first: \
                 were stamps written with too few digits?",
                rows.len()
            ),
        ));
    }
    let (stamps, poses) = rows.into_iter().map(|row| (row.stamp, row.pose)).unzip();
    let trajectory = Trajectory::new(stamps, poses).map_err(|e| TextError::Whole(e.to_string()))?;
    Ok(TrajectoryFile {
        trajectory,
        format,
        reordered,
        repeated,
        contradicting,
        first_contradiction: first,
    })
}

/// Column names: the first field does not start like a number.
fn is_header(line: &str) -> bool {
    let first = line.split([',', ';', ' ', '\t']).next().unwrap_or_default();
    first.parse::<f64>().is_err() && first.starts_with(|c: char| c.is_alphabetic() || c == '"')
}

const TUM_COLUMNS: [usize; 8] = [0, 1, 2, 3, 4, 5, 6, 7];
const EUROC_COLUMNS: [usize; 8] = [0, 1, 2, 3, 5, 6, 7, 4];

struct Layout {
    format: TrajectoryFormat,
    dialect: Dialect,
    /// As [`PoseColumns::columns`].
    columns: [usize; 8],
    unit: TimeUnit,
    /// Fields a line.
    fields: usize,
}

/// Fields beyond these are only counted.
const MOST_FIELDS: usize = 32;

/// Whole stamps of a table with commas below this are seconds: 10 ms of nanoseconds.
const SECONDS_BELOW: i64 = 10_000_000;

impl Layout {
    fn guess(line: &str, header: Option<PoseColumns>) -> Result<Self, String> {
        let dialect = Dialect::of(line);
        let (all, count) = fields(line, dialect);
        let unit = TimeUnit::of_stamp(all[0]);
        let is_table = dialect.separator != Separator::Blanks;
        let is_whole =
            all[0].parse::<i64>().is_ok_and(|stamp| stamp == 0 || stamp >= SECONDS_BELOW);
        let (format, columns, unit) = match (header, count) {
            (_, 12) if !is_table => (TrajectoryFormat::Kitti, TUM_COLUMNS, TimeUnit::Seconds),
            (Some(header), _) if header.columns.iter().all(|k| *k < count.min(MOST_FIELDS)) => {
                let unit = header.unit.unwrap_or(unit);
                let format = match header.columns {
                    EUROC_COLUMNS => TrajectoryFormat::Euroc,
                    _ => TrajectoryFormat::Tum,
                };
                (format, header.columns, unit)
            }
            (_, 8..) if is_table && (is_whole || unit == TimeUnit::Nanoseconds) => {
                (TrajectoryFormat::Euroc, EUROC_COLUMNS, TimeUnit::Nanoseconds)
            }
            (_, 8) => (TrajectoryFormat::Tum, TUM_COLUMNS, unit),
            _ => return Err(unknown_layout(count, dialect)),
        };
        Ok(Self { format, dialect, columns, unit, fields: count })
    }

    /// Stamp (s) and pose of a line; `index` is the number of poses before it.
    fn read(&self, line: &str, index: usize) -> Result<(f64, Isometry3<f64>), String> {
        let (all, count) = fields(line, self.dialect);
        if count != self.fields {
            return Err(format!("{count} fields where the lines before have {}", self.fields));
        }
        let value = |column: usize| number(all[column], self.dialect);
        if self.format == TrajectoryFormat::Kitti {
            let mut m = [0.0; 12];
            for (entry, column) in m.iter_mut().zip(0..) {
                *entry = value(column)?;
            }
            let turn = Matrix3::new(m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]);
            let position = Vector3::new(m[3], m[7], m[11]);
            let pose = Isometry3::from_parts(position.into(), unit_rotation(&turn)?);
            return Ok((index as f64, pose));
        }
        let [t, px, py, pz, qx, qy, qz, qw] = self.columns;
        let position = Vector3::new(value(px)?, value(py)?, value(pz)?);
        let rotation = unit_quaternion(value(qw)?, value(qx)?, value(qy)?, value(qz)?)?;
        Ok((self.stamp(all[t])?, Isometry3::from_parts(position.into(), rotation)))
    }

    fn stamp(&self, field: &str) -> Result<f64, String> {
        let stamp = number(field, self.dialect)?;
        match (self.unit, TimeUnit::of_stamp(field)) {
            (TimeUnit::Nanoseconds, _) => Ok(stamp / 1e9),
            (TimeUnit::Seconds, TimeUnit::Seconds) => Ok(stamp),
            (TimeUnit::Seconds, TimeUnit::Nanoseconds) => {
                Err(format!("the stamp {field} cannot be in seconds as those before"))
            }
        }
    }
}

fn unknown_layout(count: usize, dialect: Dialect) -> String {
    let separator = match dialect.separator {
        Separator::Blanks => "blanks",
        Separator::Commas => "commas",
        Separator::Semicolons => "semicolons",
    };
    format!(
        "{count} fields separated by {separator}: neither TUM (t x y z qx qy qz qw), EuRoC csv \
         (t_ns,x,y,z,qw,qx,qy,qz,...) nor KITTI (12 numbers)"
    )
}

/// The first fields of a line, and how many there are; a separator at the end of the line ends
/// the last field and starts none.
fn fields(line: &str, dialect: Dialect) -> ([&str; MOST_FIELDS], usize) {
    let line = match dialect.separator {
        Separator::Blanks => line,
        Separator::Commas => line.trim_end_matches(','),
        Separator::Semicolons => line.trim_end_matches(';'),
    };
    let mut all = [""; MOST_FIELDS];
    let mut count = 0;
    for field in dialect.fields(line) {
        if let Some(place) = all.get_mut(count) {
            *place = field;
        }
        count += 1;
    }
    (all, count)
}

fn number(field: &str, dialect: Dialect) -> Result<f64, String> {
    match dialect.number(field) {
        Some(value) if value.is_finite() => Ok(value),
        Some(_) => Err(format!("{field} is not finite")),
        None => Err(format!("{field:?} is not a number")),
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

    #[test]
    fn the_same_poses_in_every_spelling() {
        let plain = "1403715524.5 1 2 3 0.5 0.5 -0.5 0.5\n1403715525 1 2 3.5 0.5 0.5 -0.5 0.5\n";
        let expected = parse_trajectory(plain).unwrap().trajectory;
        let nanoseconds = plain
            .replace("1403715524.5", "1403715524500000000")
            .replace("1403715525", "1403715525000000000");
        let swapped = "w,x,y,z first\n# timestamp [ns], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m]\n\
                       1403715524500000000,0.5,0.5,0.5,-0.5,1,2,3\n1403715525000000000,0.5,0.5,0.5,-0.5,1,2,3.5\n";
        for text in [
            plain.replace(' ', "\t"),
            plain.replace(' ', ","),
            plain.replace(' ', ";"),
            plain.replace(' ', ";").replace('.', ","),
            plain.replace('.', ","),
            plain.replace('\n', "\r\n"),
            plain.replace("-0.5", "-.5"),
            format!("\u{feff}{plain}"),
            format!("timestamp;tx;ty;tz;qx;qy;qz;qw\n{}", plain.replace(' ', ";")),
            nanoseconds.clone(),
            format!("t_ns x y z qx qy qz qw\n{nanoseconds}"),
            swapped.to_owned(),
        ] {
            let read = parse_trajectory(&text).map(|file| file.trajectory);
            assert_eq!(read.as_ref(), Ok(&expected), "{text}");
        }
        let names = "timestamp qw qx qy qz tx ty tz\n";
        let values = "1403715524.5 0.5 0.5 0.5 -0.5 1 2 3\n";
        let file = parse_trajectory(&format!("{names}{values}")).unwrap();
        assert_eq!(file.trajectory.poses()[0], expected.poses()[0]);
        // Names that are none of a pose's change nothing.
        let comment = "# time of the recording: noon\n";
        assert_eq!(parse_trajectory(&format!("{comment}{plain}")).unwrap().trajectory, expected);
    }

    #[test]
    fn equal_stamps_are_told_or_refused() {
        let pose = |stamp: &str, x: f64| format!("{stamp} {x} 0 0 0 0 0 1\n");
        let twice: String = ["1", "1", "2", "2", "3", "3"].map(|t| pose(t, 5.0)).concat();
        let file = parse_trajectory(&twice).unwrap();
        assert_eq!((file.trajectory.len(), file.repeated, file.contradicting), (3, 3, 0));

        let one = pose("1", 0.0) + &pose("2", 1.0) + &pose("2", 2.0) + &pose("3", 3.0);
        let file = parse_trajectory(&(one + &pose("4", 4.0))).unwrap();
        assert_eq!((file.contradicting, file.first_contradiction), (1, Some(3)));

        for stamps in [["1.40372e+09"; 4], ["0"; 4], ["10.1", "10.1", "10.2", "10.2"]] {
            let text: String = (0..4).map(|i| pose(stamps[i], i as f64)).collect();
            match parse_trajectory(&text) {
                Err(TextError::Line(2, reason)) => assert!(reason.contains("digits"), "{reason}"),
                other => panic!("{stamps:?}: {other:?}"),
            }
        }
        let mixed = pose("10", 0.0) + &pose("1403715524500000000", 1.0);
        assert!(matches!(parse_trajectory(&mixed), Err(TextError::Line(2, _))));
    }
}
