//! IMU samples and position fixes from text tables.
//!
//! Columns are found by name (IMU samples as [`ImuCsv`] does); names are compared without regard
//! to case; columns that are not named below are ignored, among them the `dt` of KITTI files,
//! since intervals are differences of stamps.
//!
//! | value | names |
//! | --- | --- |
//! | stamp, s or ns | `t`, `time`, `timestamp`, `stamp` |
//! | position, m, z up | `x y z`, `px py pz`, `tx ty tz`, `east north up` |
//! | position, m, z down | `north east down` |
//! | place, degrees and m | `latitude longitude height`, `lat lon alt` and their mixtures |
//! | place, m | `ecef_x ecef_y ecef_z`, `x_ecef ...`, `ecefx ...` |
//! | standard deviations of a fix, m | `sd_e sd_n sd_u`, `sde sdn sdu`, `sd_x sd_y sd_z` |

use std::path::Path;

use nalgebra::{Matrix3, Vector3};

use super::imu_csv::ImuCsv;
use super::text_table::{Row, TextTable, check_step};
use super::{ImuRow, LogError};
use crate::dialect::{Dialect, TimeUnit};
use crate::sensor::{FixQuality, Geodetic, GnssFix, ImuSample, PositionFix, Stamp};

const STAMP: &[&str] = &["t", "time", "timestamp", "stamp"];
const POSITION: &[[&str; 3]] =
    &[["x", "y", "z"], ["px", "py", "pz"], ["tx", "ty", "tz"], ["east", "north", "up"]];
const POSITION_DOWN: &[[&str; 3]] = &[["north", "east", "down"]];
const LATITUDE: &[&str] = &["latitude", "lat"];
const LONGITUDE: &[&str] = &["longitude", "lon", "lng", "long"];
const HEIGHT: &[&str] = &["height", "altitude", "alt", "h", "ellipsoid_height"];
const ECEF: &[[&str; 3]] =
    &[["ecef_x", "ecef_y", "ecef_z"], ["x_ecef", "y_ecef", "z_ecef"], ["ecefx", "ecefy", "ecefz"]];
const DEVIATION: &[[&str; 3]] =
    &[["sd_e", "sd_n", "sd_u"], ["sde", "sdn", "sdu"], ["sd_x", "sd_y", "sd_z"]];
/// Columns of the IMU table in which GTSAM publishes a KITTI drive.
const KITTI: [&str; 8] = ["time", "dt", "accelx", "accely", "accelz", "omegax", "omegay", "omegaz"];

/// Positions of a table, in the order of the file.
#[derive(Debug, Clone, PartialEq)]
pub enum Positions {
    /// In a local frame, z up; `turned` if the table's z points down.
    Local { fixes: Vec<PositionFix>, turned: bool },
    /// On the earth.
    Geodetic(Vec<GnssFix>),
}

/// Whether the columns of an IMU table are those of GTSAM's KITTI drive.
///
/// # Errors
/// [`LogError::Io`] if it cannot be read, [`LogError::Corrupt`] if it is empty.
pub fn is_kitti_table(path: &Path) -> Result<bool, LogError> {
    Ok(NamedTable::open(path)?.names == KITTI)
}

/// IMU samples in the order of the file.
///
/// # Errors
/// [`LogError::Io`], or [`LogError::Corrupt`] with the column that is missing or the line that is
/// wrong.
pub fn read_imu_table(path: &Path) -> Result<Vec<ImuSample>, LogError> {
    let mut rows = ImuCsv::open(path)?;
    let mut samples = Vec::new();
    while let Some(row) = rows.next().transpose()? {
        let ImuRow { imu, .. } = row;
        let mut values = imu.angular_velocity.iter().chain(imu.specific_force.iter());
        if let Some(value) = values.find(|value| !value.is_finite()) {
            return Err(rows.wrong_row(&format!("`{value}` is no finite number")));
        }
        samples.push(imu);
    }
    if samples.is_empty() {
        return Err(empty(path));
    }
    Ok(samples)
}

fn empty(path: &Path) -> LogError {
    LogError::Corrupt { path: path.to_path_buf(), reason: "holds no rows of numbers".to_owned() }
}

/// Positions in the order of the file.
///
/// # Errors
/// As [`read_imu_table`].
pub fn read_position_table(path: &Path) -> Result<Positions, LogError> {
    let mut table = NamedTable::open(path)?;
    let time = table.column("stamp", STAMP)?;
    let deviation = table.columns("standard deviations", DEVIATION).ok();
    let positions = if let (Ok(latitude), Ok(longitude)) =
        (table.column("latitude", LATITUDE), table.column("longitude", LONGITUDE))
    {
        let columns = [latitude, longitude, table.column("height", HEIGHT)?];
        let fix = |row: &Row| geodetic(row.stamp(time)?, place(row, columns)?, row, deviation);
        Positions::Geodetic(table.rows(time, fix, |fix| fix.stamp)?)
    } else if let Ok(columns) = table.columns("place", ECEF) {
        let place = |row: &Row| Ok::<_, String>(Geodetic::from_ecef(&finite(row, columns)?));
        let fix = |row: &Row| geodetic(row.stamp(time)?, place(row)?, row, deviation);
        Positions::Geodetic(table.rows(time, fix, |fix| fix.stamp)?)
    } else {
        let down = table.columns("position", POSITION_DOWN).ok();
        let columns = down.map_or_else(|| table.columns("position", POSITION), Ok)?;
        let fix = |row: &Row| {
            let given = finite(row, columns)?;
            let up = Vector3::new(given.y, given.x, -given.z);
            let position = if down.is_some() { up } else { given };
            let covariance = covariance(row, deviation)?;
            Ok(PositionFix { stamp: row.stamp(time)?, position, covariance })
        };
        Positions::Local { fixes: table.rows(time, fix, |fix| fix.stamp)?, turned: down.is_some() }
    };
    let count = match &positions {
        Positions::Local { fixes, .. } => fixes.len(),
        Positions::Geodetic(fixes) => fixes.len(),
    };
    if count == 0 { Err(empty(path)) } else { Ok(positions) }
}

/// Of the columns of standard deviations, where there are any; zeros tell nothing.
fn covariance(row: &Row, columns: Option<[usize; 3]>) -> Result<Option<Matrix3<f64>>, String> {
    let Some(columns) = columns else { return Ok(None) };
    let variances = finite(row, columns)?.map(|sd| sd * sd);
    Ok(variances.iter().all(|variance| *variance > 0.0).then(|| Matrix3::from_diagonal(&variances)))
}

fn geodetic(
    stamp: Stamp,
    place: Geodetic,
    row: &Row,
    deviation: Option<[usize; 3]>,
) -> Result<GnssFix, String> {
    Ok(GnssFix {
        stamp,
        latitude: place.latitude,
        longitude: place.longitude,
        height: Some(place.height),
        quality: FixQuality::Autonomous,
        covariance: covariance(row, deviation)?,
        hdop: None,
        satellites: None,
    })
}

fn place(row: &Row, columns: [usize; 3]) -> Result<Geodetic, String> {
    let [latitude, longitude, height] = finite(row, columns)?.into();
    if latitude.abs() > 90.0 || longitude.abs() > 360.0 {
        return Err(format!("latitude {latitude}, longitude {longitude} is no place, in degrees"));
    }
    Ok(Geodetic { latitude, longitude, height })
}

fn finite(row: &Row, columns: [usize; 3]) -> Result<Vector3<f64>, String> {
    let vector = row.vector(columns)?;
    let bad = (0..3).find(|&i| !vector[i].is_finite());
    bad.map_or(Ok(vector), |i| Err(format!("`{}` is no finite number", row.field(columns[i])?)))
}

/// A table whose first line, which may begin with `#`, names the columns.
struct NamedTable {
    lines: TextTable,
    /// In lower case, without units.
    names: Vec<String>,
    /// What they say of the unit of time.
    units: Vec<Option<TimeUnit>>,
}

impl NamedTable {
    fn open(path: &Path) -> Result<Self, LogError> {
        let mut lines = TextTable::open(path)?;
        let header = lines.next_line()?.ok_or_else(|| {
            let reason = "is empty; its first line must name the columns".to_owned();
            LogError::Corrupt { path: path.to_path_buf(), reason }
        })?;
        let header = header.trim_start_matches(['#', ' ']);
        let plain =
            |name: &String| name.split(['[', '(']).next().unwrap_or_default().trim().to_lowercase();
        let names = Dialect::of(header).names(header);
        let units = names.iter().map(|name| TimeUnit::of_name(name)).collect();
        Ok(Self { lines, names: names.iter().map(plain).collect(), units })
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

    /// All rows; their stamps are in the column `stamp`.
    fn rows<T>(
        &mut self,
        stamp: usize,
        parse: impl Fn(&Row) -> Result<T, String>,
        stamp_of: impl Fn(&T) -> Stamp,
    ) -> Result<Vec<T>, LogError> {
        let mut rows = Vec::new();
        let mut layout = None;
        let mut last: Option<Stamp> = None;
        while let Some(line) = self.lines.next_line()? {
            if line.starts_with('#') {
                continue;
            }
            let (dialect, unit) = *layout.get_or_insert_with(|| {
                let dialect = Dialect::of(&line);
                let named = self.units.get(stamp).copied().flatten();
                let first = || TimeUnit::of_stamp(dialect.fields(&line).nth(stamp).unwrap_or(""));
                (dialect, named.unwrap_or_else(first))
            });
            let row = parse(&Row::new(&line, dialect, unit))
                .and_then(|row| check_step(last, stamp_of(&row)).map(|()| row))
                .map_err(|reason| self.lines.wrong_line(&reason))?;
            last = Some(stamp_of(&row));
            rows.push(row);
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
        assert!(is_kitti_table(imu.path()).unwrap());
        assert_eq!(samples[0].stamp.nanos(), 46_534_478_375_790);
        assert_eq!(samples[0].angular_velocity, Vector3::new(-0.003, 0.03, -0.006));
        assert_eq!(samples[0].specific_force, Vector3::new(1.5, 0.25, 9.75));
        let gps = file("Time,X,Y,Z\n46534.47,-6.5,-11.75,0.5\n\n# end\n");
        assert!(!is_kitti_table(gps.path()).unwrap());
        let read = read_position_table(gps.path()).unwrap();
        let Positions::Local { fixes, turned: false } = read else { panic!("{read:?}") };
        assert_eq!(fixes.len(), 1);
        assert_eq!(fixes[0].position, Vector3::new(-6.5, -11.75, 0.5));
    }

    #[test]
    fn fixes_in_every_spelling() {
        let read = |text: &str| read_position_table(file(text).path()).unwrap();
        let expected = read("t,x,y,z\n1403715524.5,1.5,2,-.5\n");
        for text in [
            "\u{feff}t;x;y;z\r\n1403715524,5;1,5;2;-,5\r\n",
            "Time [ns] X Y Z\n1403715524500000000 1.5 2 -0.5\n",
            "#timestamp,east [m],north [m],up [m]\n1403715524500000000,1.5,2,-0.5\n",
        ] {
            assert_eq!(read(text), expected, "{text}");
        }
    }

    #[test]
    fn places_on_the_earth_are_read_by_their_columns() {
        let angles = file("t,lat,lon,alt,sd_e,sd_n,sd_u\n1,48.8562,2.3508,67.4,0.5,0.5,1\n");
        let centred = file(
            "t ecef_x ecef_y ecef_z\n1 4200996.789553433 172460.3215373718 4780102.83087521\n",
        );
        for (file, told) in [(angles, true), (centred, false)] {
            let read = read_position_table(file.path()).unwrap();
            let Positions::Geodetic(fixes) = read else { panic!("{read:?}") };
            assert!((fixes[0].latitude - 48.8562).abs() < 1e-9);
            assert!((fixes[0].height.unwrap() - 67.4).abs() < 1e-6);
            assert_eq!(fixes[0].covariance.map(|c| c[(2, 2)]), told.then_some(1.0));
        }
        let down = file("t,north,east,down\n1,2,3,-4\n");
        let read = read_position_table(down.path()).unwrap();
        let Positions::Local { fixes, turned: true } = read else { panic!("{read:?}") };
        assert_eq!(fixes[0].position, Vector3::new(3.0, 2.0, 4.0));
        let absurd = file("t,lat,lon,alt\n1,148.8,2.3,0\n");
        let message = read_position_table(absurd.path()).unwrap_err().to_string();
        assert!(message.contains("line 2") && message.contains("148.8"), "{message}");
    }

    #[test]
    fn mistakes_name_the_column_or_the_line() {
        let message = |text: &str| read_imu_table(file(text).path()).unwrap_err().to_string();
        assert!(message("").contains("no rows"));
        assert!(message("t,gx,gy,gz,ax,ay,az\n").contains("no rows"));
        assert!(message("t,ax,ay,az\n").contains("line 1: no column `gx`"));
        let header = "t,gx,gy,gz,ax,ay,az\n";
        let short = message(&format!("{header}1,0,0,0,0,0,9.8\n2,0,0,0,0\n"));
        assert!(short.contains("line 3") && short.contains("5 fields"), "{short}");
        let bad = message(&format!("{header}1,0,nan,0,0,0,9.8\n"));
        assert!(bad.contains("line 2") && bad.contains("`NaN`"), "{bad}");
    }
}
