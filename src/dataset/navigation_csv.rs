//! IMU samples and position fixes from text tables.
//!
//! The first line names the columns; fields are separated by commas, semicolons or blanks. Names
//! are compared without regard to case; columns that are not named below are ignored, among them
//! the `dt` of KITTI files, since intervals are differences of stamps.
//!
//! | value | names |
//! | --- | --- |
//! | stamp, s | `t`, `time`, `timestamp`, `stamp` |
//! | angular velocity, rad/s | `gx gy gz`, `wx wy wz`, `omegaX omegaY omegaZ`, `gyroX ...`, `gyro_x ...` |
//! | specific force, m/s^2 | `ax ay az`, `accelX accelY accelZ`, `acc_x ...`, `accel_x ...` |
//! | position, m, z up | `x y z`, `px py pz`, `tx ty tz`, `east north up` |

use std::path::Path;

use nalgebra::Vector3;

use super::LogError;
use super::text_table::{Row, TextTable, fields};
use crate::sensor::{ImuSample, PositionFix};

const STAMP: &[&str] = &["t", "time", "timestamp", "stamp"];
const RATE: &[[&str; 3]] = &[
    ["gx", "gy", "gz"],
    ["wx", "wy", "wz"],
    ["omegax", "omegay", "omegaz"],
    ["gyrox", "gyroy", "gyroz"],
    ["gyro_x", "gyro_y", "gyro_z"],
];
const FORCE: &[[&str; 3]] = &[
    ["ax", "ay", "az"],
    ["accelx", "accely", "accelz"],
    ["acc_x", "acc_y", "acc_z"],
    ["accel_x", "accel_y", "accel_z"],
];
const POSITION: &[[&str; 3]] =
    &[["x", "y", "z"], ["px", "py", "pz"], ["tx", "ty", "tz"], ["east", "north", "up"]];

/// IMU samples in the order of the file.
///
/// # Errors
/// [`LogError::Io`], or [`LogError::Corrupt`] with the column that is missing or the line that is
/// wrong.
pub fn read_imu_table(path: &Path) -> Result<Vec<ImuSample>, LogError> {
    let mut table = NamedTable::open(path)?;
    let stamp = table.column("stamp", STAMP)?;
    let rate = table.columns("angular velocity", RATE)?;
    let force = table.columns("specific force", FORCE)?;
    table.rows(|row| {
        Ok(ImuSample {
            stamp: row.stamp(stamp)?,
            angular_velocity: finite(row, rate)?,
            specific_force: finite(row, force)?,
        })
    })
}

/// Position fixes in the order of the file.
///
/// # Errors
/// As [`read_imu_table`].
pub fn read_position_table(path: &Path) -> Result<Vec<PositionFix>, LogError> {
    let mut table = NamedTable::open(path)?;
    let stamp = table.column("stamp", STAMP)?;
    let position = table.columns("position", POSITION)?;
    table.rows(|row| {
        Ok(PositionFix {
            stamp: row.stamp(stamp)?,
            position: finite(row, position)?,
            covariance: None,
        })
    })
}

fn finite(row: &Row, columns: [usize; 3]) -> Result<Vector3<f64>, String> {
    let vector = row.vector(columns)?;
    let bad = (0..3).find(|&i| !vector[i].is_finite());
    bad.map_or(Ok(vector), |i| Err(format!("`{}` is no finite number", row.field(columns[i])?)))
}

/// A table whose first line, which may begin with `#`, names the columns.
struct NamedTable {
    lines: TextTable,
    names: Vec<String>,
}

impl NamedTable {
    fn open(path: &Path) -> Result<Self, LogError> {
        let mut lines = TextTable::open(path)?;
        let header = lines.next_line()?.ok_or_else(|| {
            let reason = "is empty; its first line must name the columns".to_owned();
            LogError::Corrupt { path: path.to_path_buf(), reason }
        })?;
        let names = fields(header.trim_start_matches(['#', ' ']));
        let names = names.iter().map(|name| name.to_lowercase()).collect();
        Ok(Self { lines, names })
    }

    fn position(&self, name: &str) -> Option<usize> {
        self.names.iter().position(|column| column == name)
    }

    fn no_column(&self, what: &str, expected: &[String]) -> LogError {
        let (expected, found) = (expected.join(", "), self.names.join(" "));
        let reason = format!("no column for the {what}; expected one of {expected}, found {found}");
        self.lines.wrong_line(&reason)
    }

    fn column(&self, what: &str, names: &[&str]) -> Result<usize, LogError> {
        let found = names.iter().find_map(|name| self.position(name));
        found.ok_or_else(|| {
            let expected: Vec<String> = names.iter().map(|name| format!("`{name}`")).collect();
            self.no_column(what, &expected)
        })
    }

    fn columns(&self, what: &str, names: &[[&str; 3]]) -> Result<[usize; 3], LogError> {
        let all =
            |[x, y, z]: &[&str; 3]| Some([self.position(x)?, self.position(y)?, self.position(z)?]);
        let found = names.iter().find_map(all);
        found.ok_or_else(|| {
            let expected: Vec<String> =
                names.iter().map(|names| format!("`{}`", names.join(" "))).collect();
            self.no_column(what, &expected)
        })
    }

    fn rows<T>(&mut self, parse: impl Fn(&Row) -> Result<T, String>) -> Result<Vec<T>, LogError> {
        let mut rows = Vec::new();
        while let Some(line) = self.lines.next_line()? {
            if !line.starts_with('#') {
                let row = parse(&Row(&fields(&line)));
                rows.push(row.map_err(|reason| self.lines.wrong_line(&reason))?);
            }
        }
        Ok(rows)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(text: &str) -> tempfile::NamedTempFile {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        file
    }

    #[test]
    fn kitti_tables_are_read() {
        let imu = file(
            "Time dt accelX accelY accelZ omegaX omegaY omegaZ\n\
             46534.47837579 46534.47837579 1.5 0.25 9.75 -0.003 0.03 -0.006\n",
        );
        let samples = read_imu_table(imu.path()).unwrap();
        assert_eq!(samples.len(), 1);
        assert_eq!(samples[0].stamp.nanos(), 46_534_478_375_790);
        assert_eq!(samples[0].angular_velocity, Vector3::new(-0.003, 0.03, -0.006));
        assert_eq!(samples[0].specific_force, Vector3::new(1.5, 0.25, 9.75));
        let gps = file("Time,X,Y,Z\n46534.47,-6.5,-11.75,0.5\n\n# end\n");
        let fixes = read_position_table(gps.path()).unwrap();
        assert_eq!(fixes.len(), 1);
        assert_eq!(fixes[0].position, Vector3::new(-6.5, -11.75, 0.5));
    }

    #[test]
    fn mistakes_name_the_column_or_the_line() {
        let message = |text: &str| read_imu_table(file(text).path()).unwrap_err().to_string();
        assert!(message("").contains("is empty"));
        assert!(message("t,ax,ay,az\n").contains("angular velocity"));
        let header = "t,gx,gy,gz,ax,ay,az\n";
        let short = message(&format!("{header}1,0,0,0,0,0,9.8\n2,0,0,0,0\n"));
        assert!(short.contains("line 3") && short.contains("5 fields"), "{short}");
        let bad = message(&format!("{header}1,0,nan,0,0,0,9.8\n"));
        assert!(bad.contains("line 2") && bad.contains("`nan`"), "{bad}");
    }
}
