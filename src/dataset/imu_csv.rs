//! Inertial data as CSV: `t,gx,gy,gz,ax,ay,az[,mx,my,mz]` in SI units, with or without a line of
//! column names.

use std::path::Path;

use nalgebra::Vector3;

use super::LogError;
use super::text_table::{Row, TextTable, check_step};
use crate::dialect::{Dialect, TimeUnit, axis_of, is_stamp};
use crate::sensor::{ImuSample, Stamp};

/// Our names of the columns.
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
    /// Found at the first lines.
    layout: Option<Layout>,
    /// Of the line of names, if there was one.
    names: Option<Names>,
    last: Option<Stamp>,
    failed: bool,
}

/// What a line of names says: positions of [`COLUMNS`] and unit of the stamps.
#[derive(Debug)]
struct Names {
    positions: Vec<usize>,
    unit: Option<TimeUnit>,
}

impl ImuCsv {
    /// # Errors
    /// [`LogError::Io`] if the file cannot be opened.
    pub fn open(path: &Path) -> Result<Self, LogError> {
        let table = TextTable::open(path)?;
        Ok(Self { table, layout: None, names: None, last: None, failed: false })
    }

    /// The error that the last row is wrong.
    pub(super) fn wrong_row(&self, reason: &str) -> LogError {
        self.table.wrong_line(reason)
    }

    fn next_row(&mut self) -> Result<Option<ImuRow>, LogError> {
        while let Some(line) = self.table.next_line()? {
            let here = |reason: String| self.table.wrong_line(&reason);
            let layout = match &self.layout {
                _ if line.starts_with('#') && !names_columns(&line) => continue,
                Some(layout) => layout,
                None if self.names.is_none() && names_columns(&line) => {
                    self.names = Some(Names::of(&line).map_err(here)?);
                    continue;
                }
                None => {
                    let layout = Layout::of(&line, self.names.take()).map_err(here)?;
                    self.layout.insert(layout)
                }
            };
            let row = row(&layout.row(&line), &layout.positions).map_err(here)?;
            check_step(self.last, row.imu.stamp).map_err(here)?;
            self.last = Some(row.imu.stamp);
            return Ok(Some(row));
        }
        Ok(None)
    }
}

impl Names {
    fn of(line: &str) -> Result<Self, String> {
        let names = header_names(line);
        let positions = by_name(&names)?;
        let stamp = positions.first().and_then(|k| names.get(*k));
        Ok(Self { unit: stamp.and_then(|name| TimeUnit::of_name(name)), positions })
    }
}

/// How the rows are written.
#[derive(Debug)]
struct Layout {
    dialect: Dialect,
    unit: TimeUnit,
    positions: Vec<usize>,
}

impl Layout {
    /// Of the first row, with what the line of names said.
    fn of(line: &str, names: Option<Names>) -> Result<Self, String> {
        let dialect = Dialect::of(line);
        let fields: Vec<&str> = dialect.fields(line).collect();
        let Names { positions, unit } = match names {
            Some(names) => names,
            None => Names { positions: in_order(&fields)?, unit: None },
        };
        let stamp = positions.first().and_then(|k| fields.get(*k)).unwrap_or(&"");
        let unit = unit.unwrap_or_else(|| TimeUnit::of_stamp(stamp));
        Ok(Self { dialect, unit, positions })
    }

    fn row<'a>(&self, line: &'a str) -> Row<'a> {
        Row::new(line, self.dialect, self.unit)
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

/// Names by which programs know the columns: ours, of EuRoC, of `rostopic echo -p`, of words.
/// Of the angular velocity, the specific force and the magnetic field.
const SPELLINGS: [&[&str]; 3] = [
    &["g", "gyro", "gyr", "w", "omega", "w_rs_s", "angular_velocity"],
    &["a", "acc", "accel", "a_rs_s", "linear_acceleration"],
    &["m", "mag", "magnetic_field"],
];

/// Index into [`COLUMNS`] of a column of this name.
fn column(name: &str) -> Option<usize> {
    if is_stamp(name) {
        return Some(0);
    }
    let (axis, stem) = axis_of(name)?;
    let stem = stem.rsplit('.').next()?;
    let group = SPELLINGS.iter().position(|stems| stems.contains(&stem))?;
    let axis = ['x', 'y', 'z'].iter().position(|known| *known == axis)?;
    Some(1 + 3 * group + axis)
}

fn header_names(line: &str) -> Vec<String> {
    let line = line.trim_start_matches(['#', ' ']);
    Dialect::of(line).names(line)
}

/// Whether a line names columns, perhaps behind a `#`.
fn names_columns(line: &str) -> bool {
    let names = header_names(line);
    let known = names.iter().filter(|name| column(name).is_some()).count();
    let is_number = |field: &str| Dialect::of(line).number(field).is_some();
    let is_text = names.first().is_some_and(|first| !is_number(first));
    known >= INERTIAL_COLUMNS || is_text && !line.starts_with('#')
}

fn by_name(names: &[String]) -> Result<Vec<usize>, String> {
    let found: Vec<Option<usize>> = names.iter().map(|name| column(name)).collect();
    let position = |k: usize| found.iter().position(|column| *column == Some(k));
    let positions: Vec<usize> = (0..COLUMNS.len()).map_while(position).collect();
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

/// Positions of stamp, angular velocity and specific force, if `line` names all of them.
pub(super) fn imu_columns(line: &str) -> Option<[usize; INERTIAL_COLUMNS]> {
    by_name(&header_names(line)).ok()?.get(..INERTIAL_COLUMNS)?.try_into().ok()
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
    fn the_same_rows_in_every_spelling() {
        let numbers = "1403715524.5,1,2,3,4,5,6.5\n1403715524.505,1,-.5,3,4,5,6\n";
        let expected = read(numbers).unwrap();
        let nanoseconds =
            numbers.replace("524.505", "524505000000").replace("524.5", "524500000000");
        let swapped = "1403715524500000000,4,5,6.5,1,2,3\n1403715524505000000,4,5,6,1,-.5,3\n";
        let semicolons = numbers.replace(',', ";").replace('.', ",");
        for content in [
            numbers.replace(',', " "),
            numbers.replace(',', "\t").replace('.', ","),
            semicolons.clone(),
            format!("t;gx;gy;gz;ax;ay;az\n{semicolons}"),
            format!("\u{feff}t,gx,gy,gz,ax,ay,az\r\n{}", numbers.replace('\n', "\r\n")),
            nanoseconds.clone(),
            format!(
                "t [ns] gx [rad/s] gy [rad/s] gz [rad/s] ax [m s^-2] ay [m s^-2] az [m s^-2]\n{}",
                nanoseconds.replace(',', " ")
            ),
            format!("%time,w.x,w.y,w.z,field.linear_acceleration.x,acc_y,aZ\n{nanoseconds}"),
            format!(
                "#timestamp [ns],a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2],\
                 w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1]\n{swapped}"
            ),
        ] {
            assert_eq!(read(&content).as_ref(), Ok(&expected), "{content}");
        }
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
            ("5,1,2,3,4,5,6\n5000005,1,2,3,4,5,6\n", "line 2: 5000000 s from the line before"),
            ("t,gx,gy,gz,ax,ay,az\n0.5,1,2,3,4,5,6\n1403715524907143168,1,2,3,4,5,6\n", "line 3"),
            ("0,5,1,2,3,4,5,6,0,1,2,3,4,5\n", "line 1: 14 fields"),
        ] {
            let error = read(content).unwrap_err();
            assert!(error.contains(expected) && error.contains("imu.csv"), "{error}");
        }
    }
}
