//! Inertial data as CSV: `t,gx,gy,gz,ax,ay,az[,mx,my,mz]` in SI units, with or without a line of
//! column names.

use std::path::Path;

use nalgebra::Vector3;

use super::LogError;
use super::text_table::{Row, TextTable, fields};
use crate::sensor::ImuSample;

const COLUMNS: [&str; 10] = ["t", "gx", "gy", "gz", "ax", "ay", "az", "mx", "my", "mz"];
/// Columns that must be there.
const INERTIAL_COLUMNS: usize = 7;

/// A line of the file.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImuRow {
    /// May hold NaN where the file does.
    pub imu: ImuSample,
    /// In the file's unit; `None` without these columns or where one of them is empty.
    pub magnetic_field: Option<Vector3<f64>>,
}

/// The rows of a file, in its order.
///
/// Where there are column names, columns are found by them and others are passed over. Empty
/// lines and lines that begin with `#` are left out. After an error there are no more rows.
#[derive(Debug)]
pub struct ImuCsv {
    table: TextTable,
    /// Position of each of [`COLUMNS`]; found at the first line.
    positions: Option<Vec<usize>>,
    failed: bool,
}

impl ImuCsv {
    /// # Errors
    /// [`LogError::Io`] if the file cannot be opened.
    pub fn open(path: &Path) -> Result<Self, LogError> {
        Ok(Self { table: TextTable::open(path)?, positions: None, failed: false })
    }

    fn next_row(&mut self) -> Result<Option<ImuRow>, LogError> {
        while let Some(line) = self.table.next_line()? {
            if line.starts_with('#') {
                continue;
            }
            let here = |reason: String| self.table.wrong_line(&reason);
            let fields = fields(&line);
            let positions = match &self.positions {
                Some(positions) => positions,
                None => {
                    let named = fields.first().is_some_and(|first| first.parse::<f64>().is_err());
                    let positions = if named { by_name(&fields) } else { in_order(&fields) };
                    let positions = self.positions.insert(positions.map_err(here)?);
                    if named {
                        continue;
                    }
                    positions
                }
            };
            return row(&Row(&fields), positions).map(Some).map_err(here);
        }
        Ok(None)
    }
}

impl Iterator for ImuCsv {
    type Item = Result<ImuRow, LogError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.failed {
            return None;
        }
        let next = self.next_row();
        self.failed = next.is_err();
        next.transpose()
    }
}

fn by_name(names: &[&str]) -> Result<Vec<usize>, String> {
    let position = |column: &&str| names.iter().position(|name| name == column);
    let positions: Vec<usize> = COLUMNS.iter().map_while(position).collect();
    match COLUMNS.get(positions.len()) {
        Some(missing) if positions.len() < INERTIAL_COLUMNS => Err(format!(
            "no column `{missing}` in `{}`; the columns are {}",
            names.join(","),
            COLUMNS.join(",")
        )),
        Some(missing) if positions.len() > INERTIAL_COLUMNS => {
            Err(format!("no column `{missing}` beside the other two of the magnetometer"))
        }
        _ => Ok(positions),
    }
}

fn in_order(fields: &[&str]) -> Result<Vec<usize>, String> {
    match fields.len() {
        7 | 10 => Ok((0..fields.len()).collect()),
        count => Err(format!("{count} fields, not the 7 or 10 of {}", COLUMNS.join(","))),
    }
}

/// `positions` are those of the time, of the inertial columns and perhaps of the magnetometer.
fn row(row: &Row, positions: &[usize]) -> Result<ImuRow, String> {
    let (inertial, magnetic) = positions.split_at(INERTIAL_COLUMNS.min(positions.len()));
    let &[t, gx, gy, gz, ax, ay, az] = inertial else {
        return Err(format!("{} columns are too few", positions.len()));
    };
    let imu = ImuSample {
        stamp: row.stamp(t)?,
        angular_velocity: row.vector([gx, gy, gz])?,
        specific_force: row.vector([ax, ay, az])?,
    };
    let measured = |column: &usize| row.field(*column).is_ok_and(|text| !text.is_empty());
    let magnetic_field = match magnetic {
        &[x, y, z] if magnetic.iter().all(measured) => Some(row.vector([x, y, z])?),
        _ => None,
    };
    Ok(ImuRow { imu, magnetic_field })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(content: &str) -> Result<Vec<ImuRow>, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("imu.csv");
        std::fs::write(&path, content).unwrap();
        ImuCsv::open(&path).unwrap().map(|row| row.map_err(|e| e.to_string())).collect()
    }

    #[test]
    fn columns_are_found_by_name_or_by_order() {
        let named = "# made by hand\nt,ax,ay,az,gx,gy,gz,temperature\n0.01,4,5,6,1,2,3,20\n\n";
        let plain = "0.01,1,2,3,4,5,6\n";
        let rows = read(named).unwrap();
        assert_eq!(rows, read(plain).unwrap());
        assert_eq!(rows[0].imu.stamp.nanos(), 10_000_000);
        assert_eq!(rows[0].imu.angular_velocity, Vector3::new(1.0, 2.0, 3.0));
        assert_eq!(rows[0].imu.specific_force, Vector3::new(4.0, 5.0, 6.0));
        assert_eq!(rows[0].magnetic_field, None);
    }

    #[test]
    fn a_slow_magnetometer_leaves_fields_empty() {
        let rows = read("0,1,2,3,4,5,6,7e-6,8e-6,9e-6\n0.01,1,2,3,4,5,6,,,\n").unwrap();
        assert_eq!(rows[0].magnetic_field, Some(Vector3::new(7e-6, 8e-6, 9e-6)));
        assert_eq!(rows[1].magnetic_field, None);
    }

    #[test]
    fn bad_lines_are_named() {
        for (content, expected) in [
            ("t,gx,gy,gz,ax,ay\n", "line 1: no column `az`"),
            ("t,gx,gy,gz,ax,ay,az,mx\n", "line 1: no column `my`"),
            ("0,1,2\n", "line 1: 3 fields, not the 7 or 10"),
            ("0,1,2,3,4,5,6\n0.1,1,2,3,4,5\n", "line 2: 6 fields are too few"),
            ("0,1,2,3,4,5,six\n", "line 1: `six` is no number"),
            ("0,1,2,3,4,5,6,7,8,north\n", "line 1: `north` is no number"),
            ("1e300,1,2,3,4,5,6\n", "line 1: `1e300` is no time in s"),
        ] {
            let error = read(content).unwrap_err();
            assert!(error.contains(expected) && error.contains("imu.csv"), "{error}");
        }
    }
}
