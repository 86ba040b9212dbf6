//! NMEA 0183, the text that satellite receivers print: sentences to fixes.
//!
//! A fix is a `GGA` or `GNS` sentence; where a receiver sends neither, an `RMC` one. `RMC` and
//! `ZDA` tell the date, `GST` the standard deviations. The crate `nmea` reads single sentences;
//! what belongs together is told here.

use std::path::Path;

use chrono::{Datelike, NaiveDate, NaiveTime, Timelike};
use nalgebra::{Matrix3, Vector3};
use nmea::ParseResult;
use nmea::sentences::rmc::RmcStatusOfFix;
use nmea::sentences::{FixType, GgaData, GnsData, GstData, RmcData};

use super::navigation_message::check_position;
use super::pixels::Rejection;
use super::text_table::TextTable;
use super::{LogError, ReadReport};
use crate::sensor::{FixQuality, GnssFix, Stamp};

const DAY: i64 = 86_400_000_000_000;

/// Standard deviations older than this belong to another fix, ns.
const LONGEST_VALIDITY: i64 = 2_000_000_000;

/// Sentences of one receiver in their order; all stamps are UTC.
#[derive(Debug, Default)]
pub(super) struct NmeaReader {
    /// Day of the sentence read last, since 1970-01-01; 0 until a date is known.
    day: i64,
    has_date: bool,
    /// Time of day of the sentence read last and of the last fix, ns.
    time: Option<i64>,
    fixed_at: Option<i64>,
    /// With their time of day.
    deviations: Option<(i64, Vector3<f64>)>,
    /// `RMC` sentences since the last fix of a sentence that tells more.
    poor: usize,
}

/// What sentences tell of a fix, in the crate's units.
struct Fields {
    time: Option<NaiveTime>,
    place: Option<(f64, f64)>,
    quality: Option<FixQuality>,
    /// Above mean sea level and of that above the ellipsoid, m.
    altitude: Option<(f32, Option<f32>)>,
    hdop: Option<f32>,
    satellites: Option<u32>,
}

impl NmeaReader {
    /// The fix that `line` completes, if any, stamped with its own time.
    ///
    /// # Errors
    /// A reason if the sentence is damaged, or is a fix that lacks its place or its time.
    pub fn read(&mut self, line: &str) -> Result<Option<GnssFix>, Rejection> {
        let Some(sentence) = sentence(line) else { return Ok(None) };
        let failed = |error: nmea::Error| {
            Rejection::new("damaged NMEA sentence", format!("{error:?}: {sentence}"))
        };
        match nmea::parse_str(sentence).map_err(failed)? {
            ParseResult::GGA(data) => self.fix(gga(&data), sentence),
            ParseResult::GNS(data) => self.fix(gns(&data), sentence),
            ParseResult::RMC(data) => self.rmc(&data, sentence),
            ParseResult::ZDA(data) => {
                self.set_date(data.utc_date(), data.utc_time);
                Ok(None)
            }
            ParseResult::GST(data) => {
                self.deviations = deviations(&data).or(self.deviations);
                Ok(None)
            }
            _ => Ok(None),
        }
    }

    fn set_date(&mut self, date: Option<NaiveDate>, time: Option<NaiveTime>) {
        let (Some(date), Some(time)) = (date, time) else { return };
        self.day = days(date);
        self.has_date = true;
        self.time = Some(nanos(time));
    }

    fn rmc(&mut self, data: &RmcData, sentence: &str) -> Result<Option<GnssFix>, Rejection> {
        self.set_date(data.fix_date, data.fix_time);
        self.poor += 1;
        if self.poor < 2 {
            return Ok(None);
        }
        let count = self.poor;
        let fix = self.fix(rmc(data), sentence);
        self.poor = count;
        fix
    }

    fn fix(&mut self, fields: Fields, sentence: &str) -> Result<Option<GnssFix>, Rejection> {
        self.poor = 0;
        let no_fix = || Rejection::new("no fix", sentence);
        let quality = fields.quality.ok_or_else(no_fix)?;
        let (latitude, longitude) = fields.place.ok_or_else(no_fix)?;
        let time = nanos(fields.time.ok_or_else(no_fix)?);
        // The next day begins between two sentences.
        if self.time.is_some_and(|last| last - time > DAY / 2) {
            self.day += 1;
        }
        self.time = Some(time);
        if self.fixed_at.replace(time) == Some(time) {
            return Ok(None);
        }
        let deviations = self.deviations.filter(|(at, _)| (time - at).abs() <= LONGEST_VALIDITY);
        let height =
            fields.altitude.and_then(|(sea, geoid)| Some(f64::from(sea) + f64::from(geoid?)));
        let fix = GnssFix {
            stamp: Stamp::from_nanos(self.day * DAY + time),
            latitude,
            longitude,
            height: height.or(fields.altitude.map(|(sea, _)| f64::from(sea))),
            quality,
            covariance: deviations.map(|(_, sd)| Matrix3::from_diagonal(&sd.component_mul(&sd))),
            hdop: fields.hdop.map(f64::from),
            satellites: fields.satellites,
        };
        check_position(&fix).map(|()| Some(fix))
    }
}

/// From the `$` on, where it is of a kind that is read.
fn sentence(line: &str) -> Option<&str> {
    let (_, sentence) = line.split_once('$')?;
    let kind = sentence.get(2..5)?;
    let is_read = ["GGA", "GNS", "RMC", "ZDA", "GST"].contains(&kind);
    is_read.then(|| line[line.len() - sentence.len() - 1..].trim_end())
}

fn gga(data: &GgaData) -> Fields {
    Fields {
        time: data.fix_time,
        place: data.latitude.zip(data.longitude),
        quality: data.fix_type.and_then(quality),
        altitude: data.altitude.map(|sea| (sea, data.geoid_separation)),
        hdop: data.hdop,
        satellites: data.fix_satellites,
    }
}

fn gns(data: &GnsData) -> Fields {
    Fields {
        time: data.fix_time,
        place: data.lat.zip(data.lon),
        quality: quality(FixType::from(data.faa_modes)),
        altitude: data.alt.map(|sea| (sea, data.geoid_separation)),
        hdop: data.hdop,
        satellites: Some(data.nsattelites.into()),
    }
}

fn rmc(data: &RmcData) -> Fields {
    let quality = match data.status_of_fix {
        RmcStatusOfFix::Autonomous => Some(FixQuality::Autonomous),
        RmcStatusOfFix::Differential => Some(FixQuality::Differential),
        RmcStatusOfFix::Invalid => None,
    };
    Fields {
        time: data.fix_time,
        place: data.lat.zip(data.lon),
        quality,
        altitude: None,
        hdop: None,
        satellites: None,
    }
}

fn quality(kind: FixType) -> Option<FixQuality> {
    match kind {
        FixType::Invalid | FixType::Manual => None,
        FixType::Estimated => Some(FixQuality::Estimated),
        FixType::Gps | FixType::Pps | FixType::Simulation => Some(FixQuality::Autonomous),
        FixType::DGps => Some(FixQuality::Differential),
        FixType::FloatRtk => Some(FixQuality::RtkFloat),
        FixType::Rtk => Some(FixQuality::RtkFixed),
    }
}

/// East, north, up, m.
fn deviations(data: &GstData) -> Option<(i64, Vector3<f64>)> {
    let sd = [data.long_sd?, data.lat_sd?, data.alt_sd?].map(f64::from);
    let is_positive = sd.iter().all(|sd| *sd > 0.0 && sd.is_finite());
    is_positive.then_some((nanos(data.time?), sd.into()))
}

fn days(date: NaiveDate) -> i64 {
    /// Of 1970-01-01, counted from the first day of year 1 as chrono does.
    const EPOCH: i64 = 719_163;
    i64::from(date.num_days_from_ce()) - EPOCH
}

fn nanos(time: NaiveTime) -> i64 {
    i64::from(time.num_seconds_from_midnight()) * 1_000_000_000 + i64::from(time.nanosecond())
}

/// Whether a file that begins so holds NMEA sentences.
pub(super) fn is_nmea(start: &[u8]) -> bool {
    let start = start.strip_prefix(b"\xef\xbb\xbf").unwrap_or(start);
    let is_talker = |byte: &u8| byte.is_ascii_uppercase() || byte.is_ascii_digit();
    start.strip_prefix(b"$").is_some_and(|rest| rest.len() >= 5 && rest[..5].iter().all(is_talker))
}

/// The fixes of a file of sentences. Without a date in it stamps count from midnight.
///
/// # Errors
/// [`LogError::Io`] if it cannot be read, [`LogError::Corrupt`] if no fix is in it.
pub(super) fn read_nmea_file(
    path: &Path,
    report: &mut ReadReport,
) -> Result<Vec<GnssFix>, LogError> {
    let mut reader = NmeaReader::starting_on(first_date(path)?);
    let (mut table, mut fixes) = (TextTable::open(path)?, Vec::new());
    while let Some(line) = table.next_line()? {
        match reader.read(&line) {
            Ok(fix) => fixes.extend(fix),
            Err(Rejection { reason, detail }) => report.skip(
                &format!("gnss: {reason}"),
                format_args!("line {}: {detail}", table.line_number()),
            ),
        }
    }
    if fixes.is_empty() {
        let reason = "no GGA, GNS or RMC sentence with a fix".to_owned();
        return Err(LogError::Corrupt { path: path.to_path_buf(), reason });
    }
    if !reader.has_date {
        tracing::warn!(
            "{}: no RMC or ZDA sentence tells the date; stamps count from midnight UTC",
            path.display()
        );
    }
    Ok(fixes)
}

impl NmeaReader {
    fn starting_on(date: Option<(i64, i64)>) -> Self {
        let (day, time) = date.unzip();
        Self { day: day.unwrap_or(0), has_date: day.is_some(), time, ..Self::default() }
    }
}

/// The first date that the file tells, as the day on which its first sentence was sent.
fn first_date(path: &Path) -> Result<Option<(i64, i64)>, LogError> {
    let mut table = TextTable::open(path)?;
    let mut reader = NmeaReader::default();
    let mut first_time = None;
    while let Some(line) = table.next_line()? {
        let _ = reader.read(&line);
        first_time = first_time.or(reader.time);
        if let (true, Some(time), Some(first)) = (reader.has_date, reader.time, first_time) {
            // Midnight may have passed before the date was told.
            return Ok(Some((reader.day - i64::from(first > time), first)));
        }
    }
    Ok(None)
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    /// With the checksum that belongs to it.
    fn signed(body: &str) -> String {
        let sum = body.bytes().fold(0, |sum, byte| sum ^ byte);
        format!("${body}*{sum:02X}")
    }

    fn read(lines: &[String]) -> Result<(Vec<GnssFix>, ReadReport), String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("gps.nmea");
        std::fs::write(&path, lines.join("\r\n")).unwrap();
        let mut report = ReadReport::default();
        let fixes = read_nmea_file(&path, &mut report).map_err(|error| error.to_string())?;
        Ok((fixes, report))
    }

    /// The examples of the NMEA 0183 handbook, whose checksums are 47 and 6A.
    #[test]
    fn the_handbook_s_sentences_are_read() {
        let gga = "$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47".to_owned();
        let rmc = "$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A".to_owned();
        let (fixes, report) = read(&[gga, rmc]).unwrap();
        let [fix] = fixes[..] else { panic!("{fixes:?}") };
        assert!(report.skipped.is_empty(), "{report:?}");
        // 1994-03-23 12:35:19 UTC by `date -u +%s`.
        assert_eq!(fix.stamp, Stamp::from_parts(764_426_119, 0));
        assert_relative_eq!(fix.latitude, 48.0 + 7.038 / 60.0, epsilon = 1e-12);
        assert_relative_eq!(fix.longitude, 11.0 + 31.0 / 60.0, epsilon = 1e-12);
        assert_relative_eq!(fix.height.unwrap(), 592.3, epsilon = 1e-4);
        assert_eq!((fix.quality, fix.satellites), (FixQuality::Autonomous, Some(8)));
        assert_eq!(fix.covariance, None);
    }

    #[test]
    fn midnight_begins_a_new_day_and_deviations_go_with_their_fix() {
        let gga = |time: &str| {
            signed(&format!("GNGGA,{time},5530.5,S,00130.0,W,4,12,0.7,10.0,M,40.0,M,1.0,0001"))
        };
        let gst = signed("GNGST,235959.50,1.0,,,,0.02,0.03,0.05");
        let rmc = signed("GNRMC,235959.50,A,5530.5,S,00130.0,W,0.0,,311225,,,R");
        let (fixes, _) = read(&[gga("235959.50"), gst, rmc, gga("000000.00")]).unwrap();
        assert_eq!(fixes.len(), 2);
        assert_relative_eq!(fixes[1].stamp.seconds_since(fixes[0].stamp), 0.5);
        // 2026-01-01 00:00:00 UTC.
        assert_eq!(fixes[1].stamp, Stamp::from_parts(1_767_225_600, 0));
        assert_eq!(fixes[0].quality, FixQuality::RtkFixed);
        assert_relative_eq!(fixes[0].latitude, -55.508_333_333, epsilon = 1e-8);
        assert_relative_eq!(fixes[0].longitude, -1.5, epsilon = 1e-12);
        assert_eq!(fixes[0].covariance, None);
        // The standard deviations of half a second ago.
        let second = read(&[signed("GNGST,000000.00,1.0,,,,0.02,0.03,0.05"), gga("000000.00")]);
        let covariance = second.unwrap().0[0].covariance.unwrap();
        assert_relative_eq!(covariance[(0, 0)], 0.0009, epsilon = 1e-8);
        assert_relative_eq!(covariance[(1, 1)], 0.0004, epsilon = 1e-8);
        assert_relative_eq!(covariance[(2, 2)], 0.0025, epsilon = 1e-8);
    }

    #[test]
    fn rmc_is_a_fix_where_nothing_tells_more() {
        let rmc = |second: u32| {
            signed(&format!("GPRMC,1200{second:02}.0,A,4807.0,N,01131.0,E,0.0,0.0,010125,,,A"))
        };
        let (fixes, _) = read(&[rmc(0), rmc(1), rmc(2)]).unwrap();
        assert_eq!(fixes.len(), 2);
        assert_eq!(fixes[0].height, None);
    }

    #[test]
    fn what_is_no_fix_is_counted_and_a_file_without_any_refused() {
        let none = signed("GPGGA,120000.0,,,,,0,00,99.9,,M,,M,,");
        let good = signed("GPGGA,120001.0,4807.0,N,01131.0,E,1,08,0.9,545.4,M,46.9,M,,");
        let damaged = good.replace("4807", "4907");
        let (fixes, report) = read(&[none.clone(), damaged, good]).unwrap();
        assert_eq!(fixes.len(), 1);
        assert_eq!(report.skipped["gnss: no fix"], 1);
        assert_eq!(report.skipped["gnss: damaged NMEA sentence"], 1);
        let error = read(&[none]).unwrap_err();
        assert!(error.ends_with("no GGA, GNS or RMC sentence with a fix"), "{error}");
    }

    proptest::proptest! {
        #[test]
        fn no_text_panics(text in "\\PC{0,90}", body in "GP(GGA|RMC|GST|GNS|ZDA),[0-9A-Z.,]{0,60}") {
            let mut reader = NmeaReader::default();
            let _ = reader.read(&text);
            let _ = reader.read(&signed(&body));
        }
    }
}
