use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use nalgebra::Isometry3;
use rerun::external::re_log_encoding::{Decodable as _, StreamFooter};
use rerun::external::re_uri::RedapUri;
use rerun::log::ChunkBatcherConfig;
use rerun::sink::{FileSink, FileSinkError, GrpcSink, GrpcSinkConnectionState, LogSink};
use rerun::{RecordingStream, RecordingStreamBuilder, SpawnError, SpawnOptions};

use super::config::is_due;
use super::display::Display;
use super::keypoints::{self, Tracks};
use super::map::{self, MapLog};
use super::plots::{Moment, PlotLog};
use super::scene::{self, Scene};
use super::sphere::Sphere;
use super::timeline::{Clock, FRAME, TIME};
use super::{Contents, RecordingConfig, ViewerError, belief, blueprint, image, plots};
use crate::odometry::StepReport;
use crate::sensor::{Camera, ColorImage, DepthImage, ImuSample, RgbdFrame, Stamp};

/// Viewers keep the layout that a user has arranged by the application's name.
pub(super) const APPLICATION: &str = "mfg-vio";
/// How long a viewer may take to receive what is left at the end.
const VIEWER_TIMEOUT: Duration = Duration::from_secs(10);
/// How long a viewer that is said to run may take to answer.
const CONNECT_PATIENCE: Duration = Duration::from_secs(3);
/// How long a viewer may take to start and answer.
const SPAWN_PATIENCE: Duration = Duration::from_secs(30);

/// Frames whose plots are written together, into a file and to a viewer that shows them as they
/// come.
const FRAMES_PER_COLUMN: u64 = 150;
const FRAMES_PER_COLUMN_LIVE: u64 = 6;

/// Where a recording goes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Sink {
    /// An `.rrd` file; replaced if it exists.
    File(PathBuf),
    /// A running viewer, `rerun+http://HOST:PORT/proxy`.
    Connect(String),
    /// A viewer started for the purpose, or the one that already listens on the default port.
    Spawn,
}

/// Writes what the pipeline reports to a Rerun recording, on a thread of its own.
///
/// A recording that goes into a file is complete: when the writer cannot keep up, the caller
/// waits. One that only goes to a viewer loses images before it delays the caller. Problems met
/// on the way do not reach the caller before [`Recorder::finish`].
#[derive(Debug)]
pub struct Recorder {
    config: RecordingConfig,
    /// Whether images may be left out to keep up.
    lossy: bool,
    sender: Option<SyncSender<Message>>,
    writer: Option<JoinHandle<Result<(), ViewerError>>>,
    frames: u64,
    imu_samples: u64,
    imu: Vec<ImuSample>,
}

#[derive(Debug)]
enum Message {
    Camera { camera: Box<Camera>, imu_from_camera: Isometry3<f64>, size: [usize; 2] },
    Frame(Box<Frame>),
}

#[derive(Debug)]
struct Frame {
    report: StepReport,
    truth: Option<Isometry3<f64>>,
    imu: Vec<ImuSample>,
    color: Option<ColorImage>,
    depth: Option<DepthImage>,
    belief: bool,
}

impl Recorder {
    /// Opens the recording and starts its thread.
    ///
    /// # Errors
    /// If the configuration is out of range, no sink is given, a file cannot be created, an
    /// address is none of a viewer, no viewer answers there, or none can be started.
    pub fn new(
        sinks: &[Sink],
        contents: &Contents,
        config: &RecordingConfig,
    ) -> Result<Self, ViewerError> {
        config.validate()?;
        if sinks.is_empty() {
            return Err(ViewerError::NoSink);
        }
        let files: Vec<PathBuf> = sinks.iter().filter_map(Sink::file).collect();
        let lossy = files.is_empty();
        let stream = open(sinks, &contents.name)?;
        let live = sinks.iter().any(|sink| sink.file().is_none());
        let mut writer = Writer::new(stream, contents, config, live)?;
        let (sender, receiver) = sync_channel(config.queue_length);
        let writer = std::thread::Builder::new()
            .name("recorder".to_owned())
            .spawn(move || {
                writer.run(&receiver);
                writer.finish(&files)
            })
            .map_err(ViewerError::Thread)?;
        Ok(Self {
            config: config.clone(),
            lossy,
            sender: Some(sender),
            writer: Some(writer),
            frames: 0,
            imu_samples: 0,
            imu: Vec::new(),
        })
    }

    /// Intrinsics, mounting and image size (columns, rows) of the camera; once, before any frame.
    pub fn camera(&mut self, camera: &Camera, imu_from_camera: &Isometry3<f64>, size: [usize; 2]) {
        let (camera, imu_from_camera) = (Box::new(*camera), *imu_from_camera);
        self.send(Message::Camera { camera, imu_from_camera, size });
    }

    /// A sample of the IMU, bias and noise included, in the order of the stamps. It is recorded
    /// with the next frame.
    pub fn imu(&mut self, sample: &ImuSample) {
        if is_due(self.imu_samples, self.config.imu_every) {
            self.imu.push(*sample);
        }
        self.imu_samples += 1;
    }

    /// A frame that the pipeline has processed, and the true `world_from_body` at its stamp.
    pub fn frame(
        &mut self,
        report: &StepReport,
        images: &RgbdFrame,
        truth: Option<&Isometry3<f64>>,
    ) {
        let message = self.frame_message(report, images, truth);
        self.send(message);
    }

    /// Writes what is left and closes the recording; a file then has its footer.
    ///
    /// # Errors
    /// The first problem met since the recording was begun.
    pub fn finish(mut self) -> Result<(), ViewerError> {
        self.close()
    }

    fn frame_message(
        &mut self,
        report: &StepReport,
        images: &RgbdFrame,
        truth: Option<&Isometry3<f64>>,
    ) -> Message {
        let number = self.frames;
        self.frames += 1;
        Message::Frame(Box::new(Frame {
            report: report.clone(),
            truth: truth.copied(),
            imu: std::mem::take(&mut self.imu),
            color: is_due(number, self.config.image_every).then(|| images.color.clone()),
            depth: is_due(number, self.config.depth_every).then(|| images.depth.clone()),
            belief: is_due(number, self.config.belief_every),
        }))
    }

    /// A writer that is gone has a reason, which [`Self::close`] returns.
    fn send(&self, message: Message) {
        if let (Some(message), Some(sender)) = (self.try_send(message), &self.sender) {
            let _ = sender.send(message);
        }
    }

    /// Queues a message. If the queue is full, returns what of the message has to wait for it.
    fn try_send(&self, message: Message) -> Option<Message> {
        match self.sender.as_ref()?.try_send(message) {
            Err(TrySendError::Full(Message::Frame(frame))) if self.lossy => {
                Some(Message::Frame(Box::new(Frame { color: None, depth: None, ..*frame })))
            }
            Err(TrySendError::Full(message)) => Some(message),
            Ok(()) | Err(TrySendError::Disconnected(_)) => None,
        }
    }

    fn close(&mut self) -> Result<(), ViewerError> {
        let Some(writer) = self.writer.take() else { return Ok(()) };
        self.sender = None;
        writer.join().unwrap_or(Err(ViewerError::Panicked))
    }
}

impl Drop for Recorder {
    /// Closes a recording that was not finished, so that its file is complete.
    fn drop(&mut self) {
        if let Err(error) = self.close() {
            tracing::warn!("{error}");
        }
    }
}

impl Sink {
    fn file(&self) -> Option<PathBuf> {
        match self {
            Self::File(path) => Some(path.clone()),
            Self::Connect(_) | Self::Spawn => None,
        }
    }

    fn open(&self) -> Result<Box<dyn LogSink>, ViewerError> {
        match self {
            Self::File(path) => Ok(Box::new(create(path)?)),
            Self::Connect(url) => connect(url, CONNECT_PATIENCE),
            Self::Spawn => connect(&spawn()?, SPAWN_PATIENCE),
        }
    }
}

pub(super) fn create(path: &Path) -> Result<FileSink, ViewerError> {
    FileSink::new(path).map_err(|error| match error {
        FileSinkError::CreateFile { source, path } => ViewerError::Create { path, source },
        FileSinkError::SpawnThread(source) => ViewerError::Thread(source),
        other => ViewerError::Stream(Box::new(other.into())),
    })
}

/// Waits until the viewer answers: a sink without one would never end.
fn connect(url: &str, patience: Duration) -> Result<Box<dyn LogSink>, ViewerError> {
    let Ok(RedapUri::Proxy(address)) = url.parse() else {
        return Err(ViewerError::Address { url: url.to_owned() });
    };
    let sink = GrpcSink::new(address);
    let begin = Instant::now();
    while sink.status() != GrpcSinkConnectionState::Connected {
        if begin.elapsed() > patience {
            return Err(ViewerError::Unreachable { url: url.to_owned(), patience });
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    Ok(Box::new(sink))
}

/// Starts a viewer that only this machine can reach; returns its address.
fn spawn() -> Result<String, ViewerError> {
    let options = SpawnOptions {
        extra_args: vec!["--bind".to_owned(), "127.0.0.1".to_owned()],
        hide_welcome_screen: true,
        ..Default::default()
    };
    let viewer = rerun::spawn(&options).map_err(|error| match error {
        SpawnError::Io(source) => ViewerError::Spawn(source),
        SpawnError::ExecutableNotFoundInPath { .. } | SpawnError::ExecutableNotFound { .. } => {
            ViewerError::NoViewer { version: rerun::build_info().version.to_string() }
        }
    })?;
    Ok(format!("rerun+http://127.0.0.1:{}/proxy", viewer.port))
}

/// A stream into `sinks`, without a clock of its own.
pub(super) fn open(sinks: &[Sink], name: &str) -> Result<RecordingStream, ViewerError> {
    let opened: Vec<Box<dyn LogSink>> = sinks.iter().map(Sink::open).collect::<Result<_, _>>()?;
    let live = sinks.iter().any(|sink| sink.file().is_none());
    // Few large chunks: each costs a kilobyte and time in the viewer. In files they end by size
    // rather than by the clock, so that those of the same run are alike.
    let flush_tick = if live { Duration::from_millis(200) } else { Duration::from_secs(10) };
    let mut builder = RecordingStreamBuilder::new(APPLICATION)
        // Asking for a recording outweighs the environment's `RERUN=off`.
        .enabled(true)
        .batcher_config(ChunkBatcherConfig { flush_tick, ..ChunkBatcherConfig::DEFAULT });
    // A running viewer would merge runs of one identity.
    if !live {
        builder = builder.recording_id(name);
    }
    let stream = builder.set_sinks(opened)?;
    stream.set_log_time_enabled(false);
    stream.send_recording_name(name)?;
    Ok(stream)
}

/// The end of the queue that does the work.
struct Writer {
    stream: RecordingStream,
    jpeg_quality: u8,
    truth: bool,
    /// For cameras that are no pinholes.
    display: Option<Display>,
    clock: Option<Clock>,
    scene: Scene,
    map: MapLog,
    tracks: Tracks,
    sphere: Sphere,
    plots: PlotLog,
    /// Frames whose plots are written together, and those that wait.
    frames_per_column: u64,
    waiting: u64,
    last_frame: Option<Stamp>,
    problem: Option<ViewerError>,
}

impl Writer {
    /// Writes what does not depend on time.
    fn new(
        stream: RecordingStream,
        contents: &Contents,
        config: &RecordingConfig,
        live: bool,
    ) -> Result<Self, ViewerError> {
        let sphere = belief::sphere();
        blueprint::send(&stream, APPLICATION, contents, config)?;
        scene::log_styles(&stream)?;
        map::log_styles(&stream)?;
        keypoints::log_styles(&stream)?;
        belief::log_styles(&stream, &sphere, contents.truth)?;
        plots::log_styles(&stream)?;
        Ok(Self {
            stream,
            jpeg_quality: config.jpeg_quality,
            truth: contents.truth,
            display: None,
            clock: None,
            scene: Scene::default(),
            map: MapLog::new(config.map_color, config.map_ellipsoids),
            tracks: Tracks::default(),
            plots: PlotLog::default(),
            frames_per_column: if live { FRAMES_PER_COLUMN_LIVE } else { FRAMES_PER_COLUMN },
            waiting: 0,
            sphere,
            last_frame: None,
            problem: None,
        })
    }

    /// Writes until the queue is closed. A message that cannot be written is left out, for the
    /// rest of the recording is still of use.
    fn run(&mut self, receiver: &Receiver<Message>) {
        for message in receiver {
            let result = match message {
                Message::Camera { camera, imu_from_camera, size } => {
                    self.display = Display::new(&camera, size);
                    let shown = self.display.as_ref().map_or(*camera, Display::camera);
                    scene::log_camera(&self.stream, &shown, &imu_from_camera, size, self.truth)
                        .map_err(ViewerError::from)
                }
                Message::Frame(frame) => self.log_frame(&frame),
            };
            if let Err(error) = result {
                self.problem.get_or_insert(error);
            }
        }
    }

    fn log_frame(&mut self, frame: &Frame) -> Result<(), ViewerError> {
        let Frame { report, truth, imu, color, depth, belief } = frame;
        for sample in imu {
            self.plots.push_imu(sample);
        }
        let clock = *self.clock.get_or_insert_with(|| Clock::of(report.stamp));
        let number = i64::try_from(report.frame).unwrap_or(i64::MAX);
        self.stream.set_time(TIME, clock.cell(report.stamp));
        self.stream.set_time_sequence(FRAME, number);

        self.scene.log_report(&self.stream, report, truth.as_ref())?;
        if let Some(map) = &report.map {
            self.map.log(&self.stream, map)?;
        }
        if *belief {
            belief::log(&self.stream, &self.sphere, report, truth.as_ref())?;
        }
        let interval = self.last_frame.replace(report.stamp);
        let interval = interval.map(|last| report.stamp.seconds_since(last));
        let moment = Moment { stamp: report.stamp, frame: Some(number) };
        self.plots.push_report(moment, report, truth.as_ref(), interval);
        self.waiting += 1;
        if self.waiting >= self.frames_per_column {
            self.waiting = 0;
            self.plots.flush(&self.stream, clock)?;
        }
        scene::log_notes(&self.stream, &report.notes)?;
        self.log_images(report, color.as_ref(), depth.as_ref())
    }

    fn log_images(
        &mut self,
        report: &StepReport,
        color: Option<&ColorImage>,
        depth: Option<&DepthImage>,
    ) -> Result<(), ViewerError> {
        let display = self.display.as_ref();
        if let Some(color) = color {
            let shown = display.and_then(|display| display.color(color));
            let color = shown.as_ref().unwrap_or(color);
            let encoded = image::color(color, self.jpeg_quality, report.frame)?;
            self.stream.log(scene::COLOR, &encoded)?;
            let shown = display.map(|display| display.keypoints(&report.keypoints));
            let keypoints = shown.as_ref().unwrap_or(&report.keypoints);
            keypoints::log(&self.stream, keypoints, &mut self.tracks)?;
        }
        if let Some(depth) = depth {
            let shown = display.and_then(|display| display.depth(depth));
            let depth = shown.as_ref().unwrap_or(depth);
            self.stream.log(scene::DEPTH, &image::depth(depth, report.frame)?)?;
        }
        Ok(())
    }

    fn finish(mut self, files: &[PathBuf]) -> Result<(), ViewerError> {
        let clock = self.clock.unwrap_or(Clock::Start);
        let rest = self
            .scene
            .log_rest(&self.stream)
            .and_then(|()| self.plots.flush(&self.stream, clock))
            .map_err(ViewerError::from);
        let timeout = if files.is_empty() { VIEWER_TIMEOUT } else { Duration::MAX };
        let flushed = self.stream.flush_with_timeout(timeout).map_err(ViewerError::from);
        // Dropping the last handle writes the footers.
        drop(self.stream);
        if let Some(problem) = self.problem {
            return Err(problem);
        }
        rest.and(flushed)?;
        files.iter().try_for_each(|path| check_complete(path))
    }
}

/// Rerun tells of a failure to write only in its log; a footer tells that there was none.
pub(super) fn check_complete(path: &Path) -> Result<(), ViewerError> {
    use std::io::{Read, Seek, SeekFrom};

    let end = i64::try_from(StreamFooter::ENCODED_SIZE_BYTES).unwrap_or(i64::MAX);
    let mut bytes = Vec::new();
    let complete = std::fs::File::open(path)
        .and_then(|mut file| {
            file.seek(SeekFrom::End(-end))?;
            file.read_to_end(&mut bytes)
        })
        .is_ok_and(|_| StreamFooter::from_rrd_bytes(&bytes).is_ok());
    if complete { Ok(()) } else { Err(ViewerError::CutShort { path: path.to_owned() }) }
}

#[cfg(test)]
mod tests {
    use super::super::tests::frame;
    use super::*;

    /// What is left to be sent of a frame that meets a full queue: the frame, and its image.
    fn left_by_full_queue(lossy: bool) -> (bool, bool) {
        let (sender, _receiver) = sync_channel(1);
        let mut recorder = Recorder {
            config: RecordingConfig { image_every: 1, ..Default::default() },
            lossy,
            sender: Some(sender),
            writer: None,
            frames: 0,
            imu_samples: 0,
            imu: Vec::new(),
        };
        let (report, images) = frame(0);
        recorder.frame(&report, &images, None);
        let message = recorder.frame_message(&report, &images, None);
        match recorder.try_send(message) {
            Some(Message::Frame(frame)) => (true, frame.color.is_some()),
            _ => (false, false),
        }
    }

    #[test]
    fn a_full_queue_costs_a_live_view_images_but_no_frames() {
        assert_eq!(left_by_full_queue(true), (true, false));
    }

    #[test]
    fn a_full_queue_costs_a_file_nothing() {
        assert_eq!(left_by_full_queue(false), (true, true));
    }
}
