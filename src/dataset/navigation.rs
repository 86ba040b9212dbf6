//! Logs without their images: inertial, magnetic and satellite readings, each stream whole.

use std::collections::BTreeMap;
use std::path::Path;

use super::decode::RosSource;
use super::folder::FolderSource;
use super::inertial_halves::UnitedSource;
use super::merge::{Reading, ReadingSource};
use super::nmea::{is_nmea, read_nmea_file};
use super::open::Contents;
use super::ros::{Role, Survey};
use super::section::first_bytes;
use super::{LogConfig, LogError, ReadReport};
use crate::inertial::ImuConfig;
use crate::sensor::{GnssFix, ImuSample, MagneticSample, Stamp};

/// Topics of a log; empty: chosen by message type; `"none"`: not used.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct NavigationTopics {
    /// Of the IMU, or of its gyroscope where the accelerometer has a topic of its own, which is then
    /// found by what the messages hold.
    pub imu: String,
    /// Of `sensor_msgs/NavSatFix` or `nmea_msgs/Sentence`.
    pub gnss: String,
    /// Of `sensor_msgs/MagneticField` or `geometry_msgs/Vector3Stamped`.
    pub magnetic: String,
}

/// Streams of a log, each in order of its stamps, without repeated ones.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct NavigationLog {
    pub imu: Vec<ImuSample>,
    pub magnetic: Vec<MagneticSample>,
    pub fixes: Vec<GnssFix>,
    /// Topic or file by `imu`, `accelerometer`, `magnetic` and `gnss`, where there is one.
    pub sources: BTreeMap<String, String>,
    pub report: ReadReport,
}

/// Reads the streams of a bag, an MCAP file, a ROS 2 bag or a folder with an IMU, or the fixes of a
/// file of NMEA sentences. A stream that is not there is empty. Memory grows with these streams,
/// images are passed over.
///
/// # Errors
/// [`LogError::UnknownFormat`] if it is none of these, [`LogError::MissingStream`] if a topic that
/// is given is not there, [`LogError::Io`] if it cannot be read.
pub fn read_navigation(
    path: &Path,
    topics: &NavigationTopics,
    imu: &ImuConfig,
) -> Result<NavigationLog, LogError> {
    let mut log = NavigationLog::default();
    if path.is_file() && is_nmea(&first_bytes(path)?) {
        let fixes = read_nmea_file(path, &mut log.report)?;
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        log.sources.insert(Role::Gnss.key().to_owned(), name);
        log.fixes = fixes;
        log.order();
        return Ok(log);
    }
    let config = LogConfig { truth_topic: "none".to_owned(), ..LogConfig::default() };
    match Contents::of(path, &config)? {
        Contents::Folder(folder) => {
            let (summary, mut listing) = *folder;
            listing.entries.retain(|(_, entry)| !entry.role().is_image());
            log.sources = summary.sources;
            log.sources.retain(|role, _| ["imu", "accelerometer"].contains(&role.as_str()));
            log.collect(UnitedSource::new(FolderSource::new(listing, &config, imu), imu));
        }
        Contents::Messages(messages) => {
            let survey = Survey::new(messages.messages().as_mut());
            let missing = |role: Role| survey.missing(path, role);
            let chosen = survey.choose_navigation(topics).map_err(missing)?;
            let named = |(role, topic): (&Role, &String)| (role.key().to_owned(), topic.clone());
            log.sources = chosen.iter().map(named).collect();
            let decoder = survey.decoder(&chosen, &config, imu);
            let source = RosSource::of_topics(messages.messages(), chosen, decoder);
            log.collect(UnitedSource::new(source, imu));
        }
    }
    log.order();
    Ok(log)
}

impl NavigationLog {
    fn collect(&mut self, mut source: impl ReadingSource) {
        while let Some(reading) = source.next_reading(&mut self.report) {
            match reading {
                Reading::Imu(sample) => self.imu.push(sample),
                Reading::Gnss(fix) => self.fixes.push(fix),
                Reading::Magnetic(sample) => self.magnetic.push(sample),
                _ => {}
            }
        }
    }

    fn order(&mut self) {
        let Self { imu, magnetic, fixes, report, .. } = self;
        order(imu, |sample| sample.stamp, "imu", report);
        order(magnetic, |sample| sample.stamp, "magnetic field", report);
        order(fixes, |fix| fix.stamp, "gnss", report);
        report.imu_samples = imu.len() as u64;
    }
}

/// Sorts by stamp; of readings with one stamp the first that was logged stays.
fn order<T>(
    readings: &mut Vec<T>,
    stamp: impl Fn(&T) -> Stamp,
    stream: &str,
    report: &mut ReadReport,
) {
    readings.sort_by_key(&stamp);
    let mut last = None;
    readings.retain(|reading| {
        let here = stamp(reading);
        let is_new = last.replace(here) != Some(here);
        if !is_new {
            report.skip_at(&format!("{stream}: repeated stamp"), here);
        }
        is_new
    });
}
