//! Guesses what a log is from its content.

use std::path::Path;

use nalgebra::Isometry3;

use super::bag::{Bag, BagFormat};
use super::database::{DatabaseFile, MAGIC};
use super::decode::RosSource;
use super::event::rigid_motion;
use super::fault::FaultySource;
use super::folder::{FolderSource, Listing};
use super::inertial_halves::UnitedSource;
use super::mcap_file::{McapFile, McapFormat};
use super::merge::{MergedLog, Reading, ReadingSource};
use super::nmea::is_nmea;
use super::records::Format as _;
use super::registration::RegisteredSource;
use super::ros::{MessageSource, Survey};
use super::rosbag2::{self, Chain, Unpacked, ZSTD_MAGIC};
use super::section::{LogFile, decompress, first_bytes};
use super::stereo::StereoSource;
use super::{
    Fault, Log, LogConfig, LogError, LogSummary, ReadReport, TruthPose, euroc, openloris,
    seven_scenes, stray, tum,
};
use crate::inertial::ImuConfig;
use crate::vision::StereoRig;

/// What a path turned out to be.
pub(super) enum Contents {
    Folder(Box<(LogSummary, Listing)>),
    Messages(MessageLog),
}

/// A file of messages, or several that follow one another.
pub(super) struct MessageLog {
    files: Vec<MessageFile>,
    kind: &'static str,
}

enum MessageFile {
    Bag(LogFile),
    Mcap(LogFile),
    Database(DatabaseFile),
}

impl MessageLog {
    pub fn kind(&self) -> &'static str {
        self.kind
    }

    /// The messages from the start.
    pub fn messages(&self) -> Box<dyn MessageSource> {
        let mut sources: Vec<_> = self.files.iter().map(MessageFile::messages).collect();
        match sources.len() {
            1 => sources.remove(0),
            _ => Box::new(Chain::new(sources)),
        }
    }

    /// The files of a ROS 2 bag that can be read; an error where none can.
    fn of_folder(folder: &Path) -> Result<Self, LogError> {
        let (mut files, mut failure) = (Vec::new(), None);
        for path in rosbag2::list(folder)? {
            match MessageFile::open(&path) {
                Ok(file) => files.push(file),
                // A recorder that was killed leaves an empty last file.
                Err(error) => {
                    tracing::warn!("left out: {error}");
                    failure = failure.or(Some(error));
                }
            }
        }
        match failure {
            Some(error) if files.is_empty() => Err(error),
            _ => Ok(Self { files, kind: "ROS 2 bag" }),
        }
    }
}

impl MessageFile {
    /// Guesses the format from the content.
    fn open(path: &Path) -> Result<Self, LogError> {
        let start = first_bytes(path)?;
        if !start.starts_with(ZSTD_MAGIC) {
            return Self::of_start(
                path,
                &start,
                || LogFile::open(path),
                || DatabaseFile::open(path),
            );
        }
        let failed = |source| LogError::Io { path: path.to_path_buf(), source };
        let mut file = tempfile::NamedTempFile::new().map_err(failed)?;
        decompress(path, file.as_file_mut())?;
        let start = first_bytes(file.path())?;
        let handle = file.reopen().map_err(failed)?;
        let name = file.into_temp_path();
        let database = || DatabaseFile::temporary(name, path);
        Self::of_start(path, &start, || LogFile::of(handle, path), database)
    }

    fn of_start(
        path: &Path,
        start: &[u8],
        file: impl FnOnce() -> Result<LogFile, LogError>,
        database: impl FnOnce() -> Result<DatabaseFile, LogError>,
    ) -> Result<Self, LogError> {
        let unknown =
            |reason: String| Err(LogError::UnknownFormat { path: path.to_path_buf(), reason });
        match () {
            () if start.starts_with(McapFormat::MAGIC) => file().map(Self::Mcap),
            () if start.starts_with(BagFormat::MAGIC) => file().map(Self::Bag),
            () if start.starts_with(MAGIC) => database().map(Self::Database),
            () if start.is_empty() => unknown("the file is empty".to_owned()),
            () if start.starts_with(b"#ROSBAG") => {
                unknown("a bag of a format before 2.0; `rosbag migrate` updates it".to_owned())
            }
            () if is_nmea(start) => {
                unknown("NMEA sentences, which `mfg-vio gnss` reads".to_owned())
            }
            () => {
                let start = start[..start.len().min(16)].escape_ascii();
                unknown(format!("it begins with `{start}`"))
            }
        }
    }

    fn kind(&self) -> &'static str {
        match self {
            Self::Bag(_) => "ROS 1 bag",
            Self::Mcap(_) => "MCAP",
            Self::Database(_) => "ROS 2 bag",
        }
    }

    fn messages(&self) -> Box<dyn MessageSource> {
        match self {
            Self::Bag(file) => Box::new(Bag::new(file.clone())),
            Self::Mcap(file) => Box::new(Unpacked::new(Box::new(McapFile::new(file.clone())))),
            Self::Database(file) => Box::new(Unpacked::new(Box::new(file.messages()))),
        }
    }
}

/// Opens a log for reading.
///
/// The format is guessed from the content: MCAP, ROS 1 bag, TUM RGB-D, EuRoC or 7-Scenes folder.
/// Where two cameras take the place of depth (a EuRoC folder, or image topics with `log.stereo`),
/// it comes from matching them. Topics that `log` leaves open are chosen by message type, which is
/// logged. `imu` gives the units of
/// the IMU. A log without IMU is allowed ([`LogSummary::has_imu`]); if `log.color_topic` and
/// `log.depth_topic` are `"none"`, so is one without images.
///
/// # Errors
/// [`LogError::UnknownFormat`] if it is none of these, [`LogError::MissingStream`] if color,
/// depth or a configured topic is not there, [`LogError::Encoding`] if their encoding is not read,
/// [`LogError::Unregistered`] if depth is of other pixels than color, [`LogError::Stereo`] if there
/// are two cameras that give no depth, [`LogError::Config`] if a key of `log` has no meaning,
/// [`LogError::Io`] if it cannot be read.
pub fn open(path: &Path, log: &LogConfig, imu: &ImuConfig) -> Result<Box<dyn Log>, LogError> {
    open_with_faults(path, log, imu, &[])
}

/// As [`open`], with faults injected into the messages before they are ordered and paired.
///
/// # Errors
/// Those of [`open`].
pub fn open_with_faults(
    path: &Path,
    log: &LogConfig,
    imu: &ImuConfig,
    faults: &[Fault],
) -> Result<Box<dyn Log>, LogError> {
    log.validate()?;
    Ok(match Contents::of(path, log)? {
        Contents::Folder(folder) => {
            let (summary, listing) = *folder;
            let stereo = listing.stereo.clone();
            let registration = listing.registration.clone();
            let is_split = listing.has_split_imu();
            let source = UnitedSource::new(FolderSource::new(listing, log, imu), imu);
            let source = RegisteredSource::new(source, registration);
            let source = FaultySource::new(ReferenceOfImu::new(source, log), faults, imu);
            match stereo {
                Some(rig) => stereo_log(source, summary, rig, log),
                None => {
                    // The entries are sorted already, unless their stamps were spoilt, or the halves
                    // of an IMU wait for each other while all else goes on.
                    let sorted = LogConfig { reorder_window: 0.0, ..log.clone() };
                    let order = if faults.is_empty() && !is_split { &sorted } else { log };
                    Box::new(MergedLog::new(source, summary, order))
                }
            }
        }
        Contents::Messages(messages) => {
            let survey = Survey::new(messages.messages().as_mut());
            let place = (path, messages.kind());
            let (source, summary, rig) =
                RosSource::new(messages.messages(), &survey, place, log, imu)?;
            let registration = summary.calibration.registration.clone();
            let source = RegisteredSource::new(UnitedSource::new(source, imu), registration);
            let source = FaultySource::new(ReferenceOfImu::new(source, log), faults, imu);
            match rig {
                Some(rig) => stereo_log(source, summary, rig, log),
                None => Box::new(MergedLog::new(source, summary, log)),
            }
        }
    })
}

/// Brings the poses of the reference's body to the IMU.
struct ReferenceOfImu<S> {
    source: S,
    body_from_imu: Isometry3<f64>,
}

impl<S> ReferenceOfImu<S> {
    fn new(source: S, log: &LogConfig) -> Self {
        let body_from_imu = rigid_motion(&log.truth_body_from_imu).unwrap_or_default();
        Self { source, body_from_imu }
    }
}

impl<S: ReadingSource> ReadingSource for ReferenceOfImu<S> {
    fn next_reading(&mut self, report: &mut ReadReport) -> Option<Reading> {
        let reading = self.source.next_reading(report)?;
        Some(match reading {
            Reading::Truth(pose) if self.body_from_imu != Isometry3::identity() => {
                let world_from_body = pose.world_from_body * self.body_from_imu;
                Reading::Truth(TruthPose { world_from_body, ..pose })
            }
            other => other,
        })
    }
}

fn stereo_log(
    source: impl ReadingSource + 'static,
    summary: LogSummary,
    rig: StereoRig,
    log: &LogConfig,
) -> Box<dyn Log> {
    Box::new(MergedLog::new(StereoSource::new(source, rig, log), summary, log))
}

/// Tells what a log is, and which configuration fits it, from its first messages.
///
/// Sources that are not there are left out of the summary; they are no error here.
///
/// # Errors
/// [`LogError::UnknownFormat`] if it is no log that is read, [`LogError::MissingStream`] if a
/// folder lacks its image lists, [`LogError::Io`] if it cannot be read.
pub fn detect(path: &Path) -> Result<LogSummary, LogError> {
    detect_with(path, &LogConfig::default())
}

/// As [`detect`], with the topics that `log` names.
///
/// # Errors
/// Those of [`detect`].
pub fn detect_with(path: &Path, log: &LogConfig) -> Result<LogSummary, LogError> {
    Ok(match Contents::of(path, log)? {
        Contents::Folder(folder) => folder.0,
        Contents::Messages(messages) => {
            Survey::new(messages.messages().as_mut()).summary(messages.kind(), log)
        }
    })
}

impl Contents {
    /// Guesses the format from the content.
    pub fn of(path: &Path, config: &LogConfig) -> Result<Self, LogError> {
        let failed = |source| LogError::Io { path: path.to_path_buf(), source };
        let unknown =
            |reason: String| Err(LogError::UnknownFormat { path: path.to_path_buf(), reason });
        let folder = |contents| Self::Folder(Box::new(contents));
        if std::fs::metadata(path).map_err(failed)?.is_dir() {
            return match () {
                () if openloris::is_openloris(path) => openloris::list(path, config).map(folder),
                () if stray::is_stray(path) => stray::list(path, config).map(folder),
                () if tum::is_tum(path) => tum::list(path, config).map(folder),
                () if seven_scenes::is_seven_scenes(path) => {
                    seven_scenes::list(path, config).map(folder)
                }
                () if euroc::is_euroc(path) => euroc::list(path, config).map(folder),
                () if path.ends_with("mav0") || path.join("mav0").is_dir() => {
                    unknown("a EuRoC folder without cam0/data.csv".to_owned())
                }
                () if rosbag2::is_rosbag2(path) => MessageLog::of_folder(path).map(Self::Messages),
                () => unknown("a folder without rgb.txt and without frame-*.color.*".to_owned()),
            };
        }
        let file = MessageFile::open(path)?;
        let kind = file.kind();
        Ok(Self::Messages(MessageLog { files: vec![file], kind }))
    }
}

#[cfg(test)]
mod tests {
    use std::ops::ControlFlow;
    use std::path::PathBuf;

    use super::super::samples::{self, Sample, read_all, read_runs};
    use super::super::{Assumed, Event, RgbdFrame, convert, inspect};
    use super::*;
    use crate::sensor::CameraConfig;

    fn open_default(path: &Path) -> Result<Box<dyn Log>, LogError> {
        open(path, &LogConfig::default(), &ImuConfig::default())
    }

    fn frames(events: &[Event]) -> Vec<&RgbdFrame> {
        let mut frames = Vec::new();
        for event in events {
            if let Event::Frame(frame) = event {
                frames.push(&**frame);
            }
        }
        frames
    }

    fn error(path: &Path) -> String {
        let opened = open_default(path).err().unwrap().to_string();
        assert_eq!(detect(path).unwrap_err().to_string(), opened);
        opened
    }

    fn bag(folder: &tempfile::TempDir, samples: &[Sample]) -> PathBuf {
        samples::file(folder, "log.bag", &samples::bag(samples, "none", 8, true).0)
    }

    #[test]
    fn all_containers_and_serializations_yield_the_same_events() {
        let folder = tempfile::tempdir().unwrap();
        let ros1 = samples::recording(false);
        let mcap = |compression, chunks| {
            mcap::WriteOptions::new()
                .compression(compression)
                .chunk_size(Some(700))
                .use_chunks(chunks)
        };
        let zstd = mcap(Some(mcap::Compression::Zstd), true);
        let lz4 = mcap(Some(mcap::Compression::Lz4), true);
        let logs = [
            ("ROS 1 bag", samples::bag(&ros1, "none", 8, true).0),
            ("ROS 1 bag", samples::bag(&ros1, "none", 8, false).0),
            ("ROS 1 bag", samples::bag(&ros1, "bz2", 8, true).0),
            ("ROS 1 bag", samples::bag(&ros1, "lz4", 1, false).0),
            ("MCAP", samples::mcap(&ros1, "ros1", zstd.clone())),
            ("MCAP", samples::mcap(&samples::recording(true), "cdr", lz4)),
            ("MCAP", samples::mcap(&ros1, "ros1", mcap(None, true))),
            ("MCAP", samples::mcap(&ros1, "ros1", mcap(None, false))),
            ("MCAP", samples::mcap(&ros1, "ros1", zstd.emit_summary_records(false))),
        ];
        let mut first: Option<Vec<Event>> = None;
        for (kind, bytes) in logs {
            let path = samples::file(&folder, "log", &bytes);
            let mut log = open_default(&path).unwrap();
            let summary = log.summary().clone();
            assert_eq!((summary.kind.as_str(), summary.config_name.as_str()), (kind, "vcu_rvi"));
            assert!(summary.has_imu && summary.has_truth);
            let expected = [samples::COLOR, samples::DEPTH, samples::IMU, samples::TRUTH];
            assert!(summary.sources.values().eq(expected));
            assert_eq!(detect(&path).unwrap(), summary);
            let events = read_all(log.as_mut());
            assert!(log.report().skipped.is_empty(), "{:?}", log.report());
            assert_eq!(log.report().imu_samples, 50);
            assert_eq!(log.report().truth_poses, 10);
            let frames = frames(&events);
            assert_eq!(frames.len(), 5);
            assert_eq!(frames[4].stamp, crate::sensor::Stamp::from_parts(1, 400_000_000));
            assert_eq!(frames[4].color.data(), [14; 24]);
            assert_eq!(frames[4].depth.data(), [14 * 257; 8]);
            assert!(first.as_ref().is_none_or(|first| *first == events));
            first = Some(events);
        }
    }

    #[test]
    fn a_log_cut_anywhere_yields_all_before_the_cut() {
        let folder = tempfile::tempdir().unwrap();
        let samples: Vec<_> = samples::recording(false).into_iter().take(40).collect();
        let (bytes, ends) = samples::bag(&samples, "none", 8, false);
        let only_imu = LogConfig {
            color_topic: "none".to_owned(),
            depth_topic: "none".to_owned(),
            ..LogConfig::default()
        };
        for cut in (13..bytes.len()).step_by(7) {
            let path = samples::file(&folder, "log.bag", &bytes[..cut]);
            let mut log = open(&path, &only_imu, &ImuConfig::default()).unwrap();
            let events = read_all(log.as_mut());
            let before = samples.iter().zip(&ends).filter(|(sample, end)| {
                **end <= cut && [samples::IMU, samples::TRUTH].contains(&sample.topic)
            });
            assert_eq!(events.len(), before.count(), "cut at {cut}");
        }
    }

    #[test]
    fn a_cut_mcap_file_yields_all_before_the_cut() {
        let folder = tempfile::tempdir().unwrap();
        let samples: Vec<_> = samples::recording(true).into_iter().take(30).collect();
        let options = mcap::WriteOptions::new()
            .compression(None)
            .chunk_size(Some(2000))
            .repeat_schemas(false);
        let bytes = samples::mcap(&samples, "cdr", options);
        let ends: Vec<_> = samples
            .iter()
            .map(|sample| {
                let found =
                    bytes.windows(sample.body.len()).position(|window| window == sample.body);
                found.unwrap() + sample.body.len()
            })
            .collect();
        let only_imu = LogConfig {
            color_topic: "none".to_owned(),
            depth_topic: "none".to_owned(),
            ..LogConfig::default()
        };
        for cut in (8..bytes.len()).step_by(7) {
            let path = samples::file(&folder, "log.mcap", &bytes[..cut]);
            let mut log = open(&path, &only_imu, &ImuConfig::default()).unwrap();
            let events = read_all(log.as_mut());
            let before = samples.iter().zip(&ends).filter(|(sample, end)| {
                **end <= cut && [samples::IMU, samples::TRUTH].contains(&sample.topic)
            });
            assert_eq!(events.len(), before.count(), "cut at {cut}");
        }
    }

    #[test]
    fn a_cut_compressed_log_yields_its_complete_chunks() {
        let folder = tempfile::tempdir().unwrap();
        let samples = samples::recording(false);
        for compression in ["bz2", "lz4"] {
            let (bytes, _) = samples::bag(&samples, compression, 8, true);
            let whole =
                open_default(&samples::file(&folder, "whole", &bytes)).unwrap().summary().clone();
            assert!(whole.has_imu);
            let path = samples::file(&folder, "cut", &bytes[..bytes.len() * 3 / 4]);
            let mut log = open_default(&path).unwrap();
            let count = read_all(log.as_mut()).len();
            assert!((35..65).contains(&count), "{compression}: {count}");
            assert!(!log.report().skipped.is_empty());
        }
    }

    #[test]
    fn flipped_bits_are_survived() {
        use rand::{Rng, SeedableRng};
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(3);
        let folder = tempfile::tempdir().unwrap();
        let samples = samples::recording(false);
        let zstd = mcap::WriteOptions::new().chunk_size(Some(2000));
        let logs = [
            samples::bag(&samples, "none", 8, true).0,
            samples::bag(&samples, "bz2", 8, true).0,
            samples::bag(&samples, "lz4", 8, true).0,
            samples::mcap(&samples, "ros1", zstd.clone().compression(None)),
            samples::mcap(&samples, "ros1", zstd.compression(Some(mcap::Compression::Zstd))),
        ];
        for bytes in logs {
            for _ in 0..150 {
                let mut damaged = bytes.clone();
                for _ in 0..random.random_range(1..4) {
                    let index = random.random_range(0..damaged.len());
                    damaged[index] ^= 1 << random.random_range(0..8);
                }
                let path = samples::file(&folder, "log", &damaged);
                if let Ok(mut log) = open_default(&path) {
                    // A damaged stamp can make all that follow it those of a new run.
                    assert!(read_runs(log.as_mut()).len() <= samples.len());
                }
                let (log, imu) = (LogConfig::default(), ImuConfig::default());
                let assumed = Assumed::new(&log, &imu);
                let _ = inspect(&path, &assumed);
                let output = path.with_extension("mcap");
                let go_on = || ControlFlow::Continue(());
                let _ = convert(&path, &output, &log, &CameraConfig::default(), go_on);
            }
        }
    }

    #[test]
    fn a_damaged_chunk_costs_only_its_own_messages() {
        let folder = tempfile::tempdir().unwrap();
        let samples = samples::recording(false);
        let (mut bytes, ends) = samples::bag(&samples, "none", 8, true);
        // The length of the first record header after the 20th message, inside a chunk.
        bytes[ends[20] + 3] = 0xff;
        let mut log = open_default(&samples::file(&folder, "log.bag", &bytes)).unwrap();
        assert_eq!(read_all(log.as_mut()).len(), 65 - 3);
        assert_eq!(log.report().skipped["bag: chunk damaged or cut short"], 1);
    }

    #[test]
    fn missing_streams_are_named_with_what_there_is() {
        let folder = tempfile::tempdir().unwrap();
        let samples: Vec<_> = samples::recording(false)
            .into_iter()
            .filter(|sample| sample.topic != samples::DEPTH)
            .collect();
        let path = bag(&folder, &samples);
        let error = open_default(&path).err().unwrap().to_string();
        assert!(
            error.ends_with(
                "no depth image in this log; it has: /cam0/color (sensor_msgs/Image 8UC3), \
                 /imu (sensor_msgs/Imu), /truth (geometry_msgs/PoseStamped)"
            ),
            "{error}"
        );
        assert!(!detect(&path).unwrap().sources.contains_key("depth"));
        let wrong = LogConfig { imu_topic: "/imu0".to_owned(), ..LogConfig::default() };
        let error = open(&path, &wrong, &ImuConfig::default()).err().unwrap();
        assert!(matches!(error, LogError::MissingStream { role: "imu", .. }));
    }

    #[test]
    fn an_imu_is_not_needed() {
        let folder = tempfile::tempdir().unwrap();
        let samples: Vec<_> = samples::recording(false)
            .into_iter()
            .filter(|sample| sample.topic != samples::IMU)
            .collect();
        let mut log = open_default(&bag(&folder, &samples)).unwrap();
        assert!(!log.summary().has_imu);
        assert_eq!(frames(&read_all(log.as_mut())).len(), 5);
    }

    #[test]
    fn color_in_three_channels_and_depth_that_is_nothing_else_are_preferred() {
        let folder = tempfile::tempdir().unwrap();
        let mut samples = vec![
            samples::image(false, "/a/mono", "mono8", 1, 1000, 1),
            samples::image(false, "/b/ir", "mono16", 2, 1000, 1),
        ];
        samples.extend(samples::recording(false));
        let summary = detect(&bag(&folder, &samples)).unwrap();
        assert_eq!(summary.sources["color"], samples::COLOR);
        assert_eq!(summary.sources["depth"], samples::DEPTH);
        let mono: Vec<_> =
            samples.into_iter().filter(|sample| sample.topic != samples::COLOR).collect();
        assert_eq!(detect(&bag(&folder, &mono)).unwrap().sources["color"], "/a/mono");
    }

    #[test]
    fn the_same_topics_in_si_units_are_not_taken_for_vcu_rvi() {
        let folder = tempfile::tempdir().unwrap();
        let mut samples = samples::recording(false);
        for (number, sample) in samples.iter_mut().enumerate() {
            if sample.topic == samples::IMU {
                *sample = samples::imu(false, 1000 + number as i64, 9.81);
            }
        }
        assert_eq!(detect(&bag(&folder, &samples)).unwrap().config_name, "generic");
    }

    #[test]
    fn bad_messages_are_left_out_and_counted() {
        let folder = tempfile::tempdir().unwrap();
        let mut samples = samples::recording(false);
        samples[0] = samples::imu(false, 1000, f64::NAN);
        samples[5].body.truncate(100);
        let repeated = samples[20].clone();
        samples.insert(21, repeated);
        samples.push(samples::image(false, samples::COLOR, "bayer", 1, 1450, 0));
        samples.push(samples::image(false, samples::COLOR, "8UC3", 3, 1470, 0));
        samples.push(samples::imu(false, 2900, -1.0));
        samples.push(samples::imu(false, 1455, -1.0));
        let mut log = open_default(&bag(&folder, &samples)).unwrap();
        let events = read_all(log.as_mut());
        assert_eq!(frames(&events).len(), 5);
        let skipped: Vec<_> =
            log.report().skipped.iter().map(|(reason, count)| (reason.as_str(), *count)).collect();
        assert_eq!(
            skipped,
            [
                ("color image: no depth image near enough in time", 1),
                ("color image: unsupported encoding", 1),
                ("imu: message too short", 1),
                ("imu: not finite", 1),
                ("imu: out of order beyond the reorder window, or repeated", 1),
                ("imu: repeated stamp", 1),
            ]
        );
    }

    #[test]
    fn other_files_and_folders_are_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str, bytes: &[u8]| samples::file(&folder, name, bytes);
        assert!(error(&file("a", b"")).contains("the file is empty"));
        assert!(error(&file("b", b"SQLite format 3\0")).contains("no ROS 2 bag that can be read"));
        assert!(error(&file("c", b"#ROSBAG V1.2\n")).contains("before 2.0"));
        assert!(error(&file("d", b"hello")).contains("it begins with `hello`"));
        assert!(error(&folder.path().join("absent")).contains("absent"));
        assert!(error(folder.path()).contains("a folder without rgb.txt"));
        std::fs::create_dir(folder.path().join("mav0")).unwrap();
        assert!(error(folder.path()).contains("EuRoC folder without cam0/data.csv"));
    }

    #[test]
    fn empty_containers_lack_streams() {
        let folder = tempfile::tempdir().unwrap();
        for bytes in [BagFormat::MAGIC, McapFormat::MAGIC] {
            let path = samples::file(&folder, "log", bytes);
            let error = open_default(&path).err().unwrap().to_string();
            assert!(error.ends_with("no color image in this log; it has: no topics"), "{error}");
        }
    }

    #[test]
    fn keys_without_meaning_are_refused() {
        let config = LogConfig { color_8uc3: "gbr".to_owned(), ..LogConfig::default() };
        let error = open(Path::new("x"), &config, &ImuConfig::default()).err().unwrap();
        assert_eq!(error.to_string(), "log.color_8uc3 = gbr: expected \"bgr\" or \"rgb\"");
        for config in [
            LogConfig { depth_scale: 0.0, ..LogConfig::default() },
            LogConfig { max_pair_difference: -1.0, ..LogConfig::default() },
            LogConfig { reorder_window: f64::NAN, ..LogConfig::default() },
        ] {
            assert!(config.validate().is_err());
        }
    }
}
