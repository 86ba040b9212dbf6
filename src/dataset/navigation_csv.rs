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

use std::path::{Path, PathBuf};

use nalgebra::Vector3;

use crate::inertial::{ImuSample, PositionFix, Stamp};

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

/// Why a table cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum TableError {
    #[error("{path}: {source}")]
    Io { path: PathBuf, source: std::io::Error },
    #[error("{path}: is empty; its first line must name the columns")]
    Empty { path: PathBuf },
    #[error("{path}: no column for the {what}; expected one of {expected}, found {found}")]
    NoColumn { path: PathBuf, what: &'static str, expected: String, found: String },
    #[error("{path}, line {line}: {reason}")]
    Line { path: PathBuf, line: usize, reason: String },
}

/// IMU samples in the order of the file.
pub fn read_imu_table(path: &Path) -> Result<Vec<ImuSample>, TableError> {
    let text = read(path)?;
    let table = Table::new(path, &text)?;
    let stamp = table.column("stamp", STAMP)?;
    let rate = table.columns("angular velocity", RATE)?;
    let force = table.columns("specific force", FORCE)?;
    table.read(|row| {
        Ok(ImuSample {
            stamp: row.stamp(stamp)?,
            angular_velocity: row.vector(rate)?,
            specific_force: row.vector(force)?,
        })
    })
}

/// Position fixes in the order of the file.
pub fn read_position_table(path: &Path) -> Result<Vec<PositionFix>, TableError> {
    let text = read(path)?;
    let table = Table::new(path, &text)?;
    let stamp = table.column("stamp", STAMP)?;
    let position = table.columns("position", POSITION)?;
    table.read(|row| Ok(PositionFix { stamp: row.stamp(stamp)?, position: row.vector(position)? }))
}

fn read(path: &Path) -> Result<String, TableError> {
    std::fs::read_to_string(path).map_err(|source| TableError::Io { path: path.to_owned(), source })
}

/// Fields of a line; several blanks separate as one.
fn fields(line: &str) -> Vec<&str> {
    if line.contains([',', ';']) {
        line.split([',', ';']).map(str::trim).collect()
    } else {
        line.split_whitespace().collect()
    }
}

struct Table<'a> {
    path: &'a Path,
    names: Vec<String>,
    /// Number and text of each line that is neither empty nor a comment.
    lines: Vec<(usize, &'a str)>,
}

impl<'a> Table<'a> {
    fn new(path: &'a Path, text: &'a str) -> Result<Self, TableError> {
        let text = text.trim_start_matches('\u{feff}');
        let lines = text.lines().enumerate().map(|(number, line)| (number + 1, line.trim()));
        let mut lines = lines.filter(|(_, line)| !line.is_empty());
        let (_, header) =
            lines.next().ok_or_else(|| TableError::Empty { path: path.to_owned() })?;
        let names = fields(header.trim_start_matches(['#', ' ']));
        let names = names.iter().map(|name| name.to_lowercase()).collect();
        let lines = lines.filter(|(_, line)| !line.starts_with('#')).collect();
        Ok(Self { path, names, lines })
    }

    fn position(&self, name: &str) -> Option<usize> {
        self.names.iter().position(|column| column == name)
    }

    fn no_column(&self, what: &'static str, expected: Vec<String>) -> TableError {
        let path = self.path.to_owned();
        let found = self.names.join(" ");
        TableError::NoColumn { path, what, expected: expected.join(", "), found }
    }

    fn column(&self, what: &'static str, names: &[&str]) -> Result<usize, TableError> {
        let found = names.iter().find_map(|name| self.position(name));
        found.ok_or_else(|| {
            self.no_column(what, names.iter().map(|name| format!("`{name}`")).collect())
        })
    }

    fn columns(&self, what: &'static str, names: &[[&str; 3]]) -> Result<[usize; 3], TableError> {
        let all =
            |[x, y, z]: &[&str; 3]| Some([self.position(x)?, self.position(y)?, self.position(z)?]);
        let found = names.iter().find_map(all);
        found.ok_or_else(|| {
            self.no_column(what, names.iter().map(|n| format!("`{}`", n.join(" "))).collect())
        })
    }

    fn read<T>(&self, parse: impl Fn(&Row) -> Result<T, String>) -> Result<Vec<T>, TableError> {
        let one = |&(line, text): &(usize, &str)| {
            parse(&Row { fields: fields(text) }).map_err(|reason| TableError::Line {
                path: self.path.to_owned(),
                line,
                reason,
            })
        };
        self.lines.iter().map(one).collect()
    }
}

struct Row<'a> {
    fields: Vec<&'a str>,
}

impl Row<'_> {
    fn field(&self, column: usize) -> Result<&str, String> {
        let count = self.fields.len();
        let missing = || format!("{count} fields, but field {} is needed", column + 1);
        self.fields.get(column).copied().ok_or_else(missing)
    }

    fn stamp(&self, column: usize) -> Result<Stamp, String> {
        let text = self.field(column)?;
        Stamp::parse_seconds(text).ok_or_else(|| format!("`{text}` is no time in seconds"))
    }

    fn vector(&self, columns: [usize; 3]) -> Result<Vector3<f64>, String> {
        let mut vector = Vector3::zeros();
        for (value, column) in vector.iter_mut().zip(columns) {
            let text = self.field(column)?;
            let number: Option<f64> = text.parse().ok().filter(|x: &f64| x.is_finite());
            *value = number.ok_or_else(|| format!("`{text}` is no finite number"))?;
        }
        Ok(vector)
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
