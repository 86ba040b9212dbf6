//! What an IMU-GNSS run reads: two tables, a table and a file of NMEA sentences, or one log with
//! both, brought to the frames and units of the filters.

use std::fmt;
use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Vector3};

use super::units::{UnitError, check_course, check_imu};
use crate::config::ConfigError;
use crate::dataset::{
    LogError, NavigationTopics, Positions, is_kitti_table, read_imu_table, read_navigation,
    read_position_table,
};
use crate::filter::gnss::{GnssConfig, ImuAxes, WorldAxes};
use crate::sensor::{Datum, Geodetic, GnssFix, ImuSample, PositionFix};

/// Standard deviation of the height of a fix that tells none, m.
const UNKNOWN_HEIGHT_SD: f64 = 1e4;
/// A specific force with a larger part of it along one axis is that axis' up or down.
const ALONG_AXIS: f64 = 0.9;

/// Where samples and fixes come from.
#[derive(Debug, Clone)]
pub enum NavigationSource {
    /// A table of the IMU, and a table or NMEA sentences of the receiver.
    Tables { imu: PathBuf, gnss: PathBuf },
    /// A bag, an MCAP file or a folder that holds both.
    Log(PathBuf),
}

impl fmt::Display for NavigationSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Tables { imu, gnss } => write!(f, "{} and {}", imu.display(), gnss.display()),
            Self::Log(log) => write!(f, "{}", log.display()),
        }
    }
}

#[derive(Debug, thiserror::Error)]
pub enum NavigationInputError {
    #[error(transparent)]
    Log(#[from] LogError),
    #[error(transparent)]
    Config(#[from] ConfigError),
    #[error("{source_name}: no {what}; it has {found}")]
    Missing { source_name: String, what: &'static str, found: String },
    #[error("{source_name}: {error}")]
    Unit { source_name: String, error: UnitError },
}

/// What is read, before it is brought to frames and units.
pub struct NavigationLogs {
    source: NavigationSource,
    imu: Vec<ImuSample>,
    positions: Positions,
    /// Topic or file of the samples and of the fixes.
    names: [String; 2],
    is_kitti: bool,
}

/// Samples and fixes as the filters take them.
#[derive(Debug, Clone)]
pub struct NavigationInput {
    pub imu: Vec<ImuSample>,
    pub fixes: Vec<PositionFix>,
    /// Where the local frame lies on the earth, if the fixes tell it.
    pub datum: Option<Datum>,
    /// Topic or file of the samples and of the fixes.
    pub names: [String; 2],
    /// Whether every fix has a covariance of its own that is used.
    pub noise_told: bool,
    /// What was found and done, a sentence each.
    pub remarks: Vec<String>,
}

impl NavigationLogs {
    /// Reads the source; of the configuration topics and units count.
    pub fn read(
        source: NavigationSource,
        config: &GnssConfig,
    ) -> Result<Self, NavigationInputError> {
        match &source {
            NavigationSource::Tables { imu, gnss } => {
                let (samples, is_kitti) = (read_imu_table(imu)?, is_kitti_table(imu)?);
                let positions = if is_text_table(gnss)? {
                    read_position_table(gnss)?
                } else {
                    let read = read_navigation(gnss, &NavigationTopics::default(), &config.imu)?;
                    Positions::Geodetic(read.fixes)
                };
                let names = [imu, gnss].map(|path| path.display().to_string());
                Ok(Self { imu: samples, positions, names, is_kitti, source })
            }
            NavigationSource::Log(path) => {
                let topics = NavigationTopics {
                    imu: config.log.imu_topic.clone(),
                    gnss: config.log.gnss_topic.clone(),
                    magnetic: "none".to_owned(),
                };
                let read = read_navigation(path, &topics, &config.imu)?;
                let name = |role: &str| read.sources.get(role).cloned().unwrap_or_default();
                let names = [name("imu"), name("gnss")];
                let positions = Positions::Geodetic(read.fixes);
                Ok(Self { imu: read.imu, positions, names, is_kitti: false, source })
            }
        }
    }

    /// Name under `configs/` of the settings for this layout, and why.
    pub fn config_name(&self) -> (&'static str, &'static str) {
        if self.is_kitti {
            ("kitti", "by the columns of the IMU table, those of GTSAM's KITTI drive")
        } else {
            ("gnss", "of no sensor in particular")
        }
    }

    /// Brings samples and fixes to the frames and units of the filters.
    pub fn prepare(self, config: &GnssConfig) -> Result<NavigationInput, NavigationInputError> {
        let source_name = self.source.to_string();
        let Self { mut imu, positions, names, .. } = self;
        let missing = |what, names: &[String; 2]| NavigationInputError::Missing {
            source_name: source_name.clone(),
            what,
            found: match (&names[0][..], &names[1][..]) {
                ("", "") => "neither an IMU nor fixes".to_owned(),
                ("", fixes) => format!("fixes ({fixes})"),
                (imu, "") => format!("an IMU ({imu})"),
                (imu, fixes) => format!("{imu} and {fixes}, one of them empty"),
            },
        };
        if imu.is_empty() {
            return Err(missing("IMU samples", &names));
        }
        let unit = |error| NavigationInputError::Unit { source_name: source_name.clone(), error };
        check_imu(&imu, &config.imu).map_err(unit)?;
        let mut remarks = Vec::new();
        turn_imu(&mut imu, config, &mut remarks);
        let (fixes, datum) = local_fixes(positions, config.log.world_axes, &mut remarks);
        if fixes.is_empty() {
            return Err(missing("position fixes", &names));
        }
        check_course(&imu, &fixes, config).map_err(unit)?;
        let told = config.receiver.use_log_covariance;
        let noise_told = told && fixes.iter().all(|fix| fix.covariance.is_some());
        Ok(NavigationInput { imu, fixes, datum, names, noise_told, remarks })
    }
}

/// Whether a file is a table of text rather than NMEA sentences or a log.
fn is_text_table(path: &Path) -> Result<bool, LogError> {
    use std::io::Read;
    let io = |source| LogError::Io { path: path.to_path_buf(), source };
    let mut start = [0; 1];
    let mut file = std::fs::File::open(path).map_err(io)?;
    let read = file.read(&mut start).map_err(io)?;
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    Ok(read == 0 || (start[0] != b'$' && !["bag", "mcap"].contains(&extension)))
}

/// Turns samples of axes that point forward, right and down to forward, left and up.
fn turn_imu(imu: &mut [ImuSample], config: &GnssConfig, remarks: &mut Vec<String>) {
    let scale = config.imu.accelerometer_scale;
    let mean: Vector3<f64> = imu.iter().map(|sample| sample.specific_force * scale).sum();
    let down = mean.normalize().z < -ALONG_AXIS;
    let turned = match config.log.imu_axes {
        ImuAxes::Flu => false,
        ImuAxes::Frd => true,
        ImuAxes::Auto => down,
    };
    if config.log.imu_axes == ImuAxes::Auto && down {
        remarks.push(
            "the specific force points along -z of the IMU: its axes are taken for forward, right, \
             down (`log.imu_axes = \"flu\"` if they are not)"
                .to_owned(),
        );
    }
    if turned {
        let to_flu = |v: &mut Vector3<f64>| *v = Vector3::new(v.x, -v.y, -v.z);
        for sample in imu {
            to_flu(&mut sample.angular_velocity);
            to_flu(&mut sample.specific_force);
        }
    }
}

/// Positions in a local frame, z up, with the place of its origin where that is known.
fn local_fixes(
    positions: Positions,
    axes: WorldAxes,
    remarks: &mut Vec<String>,
) -> (Vec<PositionFix>, Option<Datum>) {
    match positions {
        Positions::Local { mut fixes, turned } => {
            if turned {
                remarks.push("columns north, east, down: turned to east, north, up".to_owned());
            } else if axes == WorldAxes::Ned {
                for fix in &mut fixes {
                    let swap = Matrix3::new(0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -1.0);
                    fix.position = swap * fix.position;
                    fix.covariance = fix.covariance.map(|c| swap * c * swap.transpose());
                }
            }
            (fixes, None)
        }
        Positions::Geodetic(fixes) => {
            let Some(first) = fixes.first() else { return (Vec::new(), None) };
            let known = fixes.iter().find_map(|fix| fix.height);
            if fixes.iter().any(|fix| fix.height.is_none()) {
                remarks.push("fixes without a height are placed at that of the origin".to_owned());
            }
            let height = known.unwrap_or_default();
            let datum = Datum::at(place(first, height));
            (fixes.iter().map(|fix| local_fix(fix, &datum, height)).collect(), Some(datum))
        }
    }
}

fn place(fix: &GnssFix, height: f64) -> Geodetic {
    Geodetic {
        latitude: fix.latitude,
        longitude: fix.longitude,
        height: fix.height.unwrap_or(height),
    }
}

fn local_fix(fix: &GnssFix, datum: &Datum, height: f64) -> PositionFix {
    let position = datum.enu(&place(fix, height).ecef());
    let mut covariance = fix.covariance;
    if let (Some(covariance), None) = (&mut covariance, fix.height) {
        covariance.fill_row(2, 0.0);
        covariance.fill_column(2, 0.0);
        covariance[(2, 2)] = UNKNOWN_HEIGHT_SD.powi(2);
    }
    PositionFix { stamp: fix.stamp, position, covariance }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::{FixQuality, Stamp};

    #[test]
    fn the_first_fix_is_the_origin_and_an_unknown_height_is_uncertain() {
        let fix = |seconds: i64, latitude: f64, height: Option<f64>| GnssFix {
            stamp: Stamp::from_nanos(seconds * 1_000_000_000),
            latitude,
            longitude: 8.0,
            height,
            quality: FixQuality::Autonomous,
            covariance: Some(Matrix3::identity()),
            hdop: None,
            satellites: None,
        };
        let mut remarks = Vec::new();
        let fixes = vec![fix(0, 49.0, Some(100.0)), fix(1, 49.001, None)];
        let (local, datum) = local_fixes(Positions::Geodetic(fixes), WorldAxes::Auto, &mut remarks);
        assert_eq!(datum.unwrap().place().height, 100.0);
        assert!(local[0].position.norm() < 1e-9);
        // A thousandth of a degree of the meridian.
        assert!((local[1].position.y - 111.2).abs() < 0.1, "{}", local[1].position);
        assert_eq!(local[1].covariance.unwrap()[(2, 2)], UNKNOWN_HEIGHT_SD.powi(2));
        assert_eq!(remarks.len(), 1);
    }
}
