use std::path::PathBuf;

use anyhow::Context;
use indicatif::ProgressBar;
use nalgebra::Isometry3;

use super::argument::seconds;
use super::terminal::{INTERRUPTED, catch_interrupts, print, progress};
use mfg_vio::config::{Config, Origin, Resolved};
use mfg_vio::dataset::{Fault, LogSummary};
use mfg_vio::filter::FilterKind;
use mfg_vio::odometry::{InitMode, StepReport};
use mfg_vio::replay::{Metrics, Observer, Replayed, Request, replay};
use mfg_vio::sensor::RgbdFrame;
#[cfg(feature = "viewer")]
use mfg_vio::sensor::{Camera, ImuSample};
use mfg_vio::viewer::{Contents, Purpose};
#[cfg(feature = "viewer")]
use mfg_vio::viewer::{Recorder, Sink};

/// Run the estimator over a log of RGB-D frames and IMU samples.
///
/// The format is guessed from the content: MCAP (ROS 1 or ROS 2 messages), ROS 1 bag, ROS 2 bag
/// (.db3, or the folder of a recording, split or compressed), and folders of TUM RGB-D, EuRoC,
/// OpenLORIS, Stray Scanner and 7-Scenes. With --out the directory receives trajectory.tum (pose of
/// the body: the IMU, or the camera where there is no IMU), state.csv, metrics.json, map.ply,
/// faults.json and run.rrd.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  mfg-vio replay lab_bumper1.bag --config configs/vcu_rvi.toml \
                        --filter mfgd --out runs/bumper1\n  rerun runs/bumper1/run.rrd")]
pub struct Args {
    /// The log: a file or a folder.
    log: PathBuf,
    #[command(flatten)]
    settings: Settings,
    /// Configuration of the sensor set-up; by default chosen by the log's layout.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Directory for the results.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Where to write the Rerun recording [default: run.rrd in --out].
    #[arg(long, value_name = "FILE")]
    rrd: Option<PathBuf>,
    /// Start the Rerun viewer and stream to it.
    #[arg(long)]
    spawn: bool,
    /// Stream to a running Rerun viewer, e.g. rerun+http://127.0.0.1:9876/proxy.
    #[arg(long, value_name = "URL")]
    connect: Option<String>,
    /// Write no recording.
    #[arg(long, conflicts_with_all = ["rrd", "spawn", "connect"])]
    no_recording: bool,
    /// Skip this much of the log, s.
    #[arg(long, value_name = "S", default_value_t = 0.0, value_parser = seconds)]
    start: f64,
    /// Use only this much of the log, s.
    #[arg(long, value_name = "S", default_value_t = f64::INFINITY, hide_default_value = true, value_parser = seconds)]
    duration: f64,
    /// Reference trajectory (TUM, EuRoC, KITTI or VCU-RVI format) instead of the log's.
    #[arg(long, value_name = "TRAJ")]
    truth: Option<PathBuf>,
    /// Inject a fault, KIND:START:LENGTH[:AMOUNT] with times in s after the log's first message,
    /// e.g. black:5:1 (repeatable). Kinds: black, covered, object, imu-gap, imu-noise, bias,
    /// accel-unit, gyro-unit, imu-stamps, frame-stamps, jitter, dropped, repeated, kidnapped.
    #[arg(long = "fault", value_name = "SPEC")]
    faults: Vec<Fault>,
    /// Print the metrics as one JSON object.
    #[arg(long)]
    json: bool,
}

/// What `replay` and `demo` have in common.
#[derive(Debug, Clone, clap::Args)]
pub struct Settings {
    /// mfgd, mekfd (map fixed), mfgr, mekfr (map points uncertain), mfgs, mekfs (map points
    /// correlated with the pose).
    #[arg(long, value_name = "NAME", default_value_t)]
    filter: FilterKind,
    /// auto, static, truth, unknown-heading or unknown [default: init.mode of the configuration].
    #[arg(long, value_name = "MODE")]
    init: Option<InitMode>,
    /// Seed of RANSAC.
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// 1: everything on one thread; more: stages overlap. Results are the same.
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=64))]
    threads: u32,
    /// What the recording opens with: overview, uncertainty or timing [default: recording.blueprint
    /// of the configuration].
    #[arg(long, value_name = "NAME")]
    blueprint: Option<Purpose>,
    /// Override a key of the configuration, e.g. --set imu.gyro_noise=1e-3 (repeatable).
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
}

impl Settings {
    pub fn overrides(&self) -> &[String] {
        &self.overrides
    }
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    catch_interrupts()?;
    let resolved = resolve(args)?;
    let config_origin = resolved.name();
    let Resolved { config, summary, .. } = resolved;
    let plan = Plan {
        log: &args.log,
        settings: &args.settings,
        config,
        config_origin,
        out: args.out.clone(),
        truth: args.truth.clone(),
        start: args.start,
        duration: args.duration,
        summary,
        recording: recording_targets(args),
        faults: args.faults.clone(),
    };
    let replayed = plan.execute()?;
    if args.json {
        print(&serde_json::to_string(&replayed.metrics)?)
    } else {
        print_summary(&replayed.metrics, args.out.as_deref())
    }
}

/// The configuration for the log; what is remarkable about it is told.
fn resolve(args: &Args) -> anyhow::Result<Resolved> {
    let resolved = Resolved::of(&args.log, args.config.as_deref(), &args.settings.overrides)?;
    resolved.require_calibration()?;
    let summary = &resolved.summary;
    if args.config.is_none() {
        tracing::info!("{}: using the shipped configuration `{}`", summary.kind, resolved.name());
    }
    let told = |origin: &Origin| matches!(origin, Origin::Log(_) | Origin::SensorClass(_));
    for setting in resolved.settings().iter().filter(|setting| told(&setting.origin)) {
        tracing::debug!("{} = {} ({})", setting.key, setting.value, setting.origin);
    }
    for conflict in &resolved.conflicts {
        tracing::warn!("{conflict}");
    }
    for problem in &summary.calibration.problems {
        tracing::warn!("{problem}");
    }
    Ok(resolved)
}

/// Where a recording goes.
#[derive(Debug, Clone)]
#[cfg_attr(not(feature = "viewer"), expect(dead_code, reason = "targets are only refused"))]
pub enum Target {
    File(PathBuf),
    Spawn,
    Connect(String),
}

impl Target {
    /// The recording `run.rrd` in a directory; nothing where the program cannot record.
    pub fn files(directory: &std::path::Path) -> Vec<Self> {
        let file = Self::File(directory.join("run.rrd"));
        if cfg!(feature = "viewer") { vec![file] } else { vec![] }
    }
}

fn recording_targets(args: &Args) -> Vec<Target> {
    let files = match (&args.rrd, &args.out) {
        (Some(rrd), _) => vec![Target::File(rrd.clone())],
        (None, Some(out)) if !args.no_recording => Target::files(out),
        _ => vec![],
    };
    let live = args.spawn.then_some(Target::Spawn);
    let connect = args.connect.clone().map(Target::Connect);
    files.into_iter().chain(live).chain(connect).collect()
}

/// A replay with its recording and progress bar.
pub struct Plan<'a> {
    pub log: &'a std::path::Path,
    pub settings: &'a Settings,
    pub config: Config,
    pub config_origin: String,
    pub out: Option<PathBuf>,
    pub truth: Option<PathBuf>,
    pub start: f64,
    pub duration: f64,
    pub summary: LogSummary,
    pub recording: Vec<Target>,
    pub faults: Vec<Fault>,
}

impl Plan<'_> {
    pub fn execute(mut self) -> anyhow::Result<Replayed> {
        if let Some(mode) = self.settings.init {
            self.config.init.mode = mode;
        }
        if let Some(purpose) = self.settings.blueprint {
            self.config.recording.blueprint = purpose;
        }
        if let Some(out) = &self.out {
            std::fs::create_dir_all(out).with_context(|| format!("{}", out.display()))?;
        }
        let filter = self.settings.filter;
        let mut front_end = self.config.front_end(filter)?;
        let contents = Contents {
            name: format!("{}, {}, seed {}", self.log.display(), filter, self.settings.seed),
            truth: self.truth.is_some() || self.summary.has_truth,
            imu: self.summary.has_imu,
        };
        let mut bar = Bar(progress(self.summary.frames, "frames"));
        let mut recording = Recording::start(&self.recording, &self.config, contents)?;
        let request = Request {
            log: self.log.to_owned(),
            config: self.config,
            config_origin: self.config_origin,
            filter,
            seed: self.settings.seed,
            threads: self.settings.threads as usize,
            start: self.start,
            duration: self.duration,
            out: self.out,
            truth: self.truth,
            faults: self.faults,
            stop: &INTERRUPTED,
        };
        let replayed = replay(&request, &mut front_end, &mut [&mut bar, &mut recording]);
        bar.0.finish_and_clear();
        recording.finish()?;
        Ok(replayed?)
    }
}

struct Bar(ProgressBar);

impl Observer for Bar {
    fn frame(&mut self, _: &StepReport, _: &RgbdFrame, _: Option<&Isometry3<f64>>) {
        self.0.inc(1);
    }
}

/// The Rerun recording of a run; nothing if none was asked for.
struct Recording {
    #[cfg(feature = "viewer")]
    recorder: Option<Recorder>,
    #[cfg(feature = "viewer")]
    map_every: u64,
    #[cfg(feature = "viewer")]
    camera: Option<(Camera, Isometry3<f64>)>,
}

#[cfg(feature = "viewer")]
impl Recording {
    fn start(targets: &[Target], config: &Config, contents: Contents) -> anyhow::Result<Self> {
        let sink = |target: &Target| match target {
            Target::File(path) => Sink::File(path.clone()),
            Target::Connect(url) => Sink::Connect(url.clone()),
            Target::Spawn => Sink::Spawn,
        };
        let sinks: Vec<_> = targets.iter().map(sink).collect();
        let recorder = match sinks.is_empty() {
            true => None,
            false => Some(Recorder::new(&sinks, &contents, &config.recording)?),
        };
        let mounting = if contents.imu { config.camera.imu_from_camera() } else { None };
        Ok(Self {
            recorder,
            map_every: config.recording.map_every,
            camera: Some((config.lens()?, mounting.unwrap_or_default())),
        })
    }

    fn finish(self) -> anyhow::Result<()> {
        Ok(self.recorder.map(Recorder::finish).transpose().map(|_| ())?)
    }
}

#[cfg(feature = "viewer")]
impl Observer for Recording {
    fn frame(&mut self, report: &StepReport, frame: &RgbdFrame, truth: Option<&Isometry3<f64>>) {
        let Some(recorder) = &mut self.recorder else { return };
        if let Some((camera, imu_from_camera)) = self.camera.take() {
            let size = [frame.color.width(), frame.color.height()];
            recorder.camera(&camera, &imu_from_camera, size);
        }
        recorder.frame(report, frame, truth);
    }

    fn imu(&mut self, sample: &ImuSample) {
        if let Some(recorder) = &mut self.recorder {
            recorder.imu(sample);
        }
    }

    fn map_every(&self) -> u64 {
        if self.recorder.is_some() { self.map_every } else { 0 }
    }
}

#[cfg(not(feature = "viewer"))]
impl Recording {
    fn start(targets: &[Target], _: &Config, _: Contents) -> anyhow::Result<Self> {
        anyhow::ensure!(
            targets.is_empty(),
            "this program was built without the feature `viewer`; use --no-recording"
        );
        Ok(Self {})
    }

    fn finish(self) -> anyhow::Result<()> {
        Ok(())
    }
}

#[cfg(not(feature = "viewer"))]
impl Observer for Recording {
    fn frame(&mut self, _: &StepReport, _: &RgbdFrame, _: Option<&Isometry3<f64>>) {}
}

/// The result table on stdout.
pub fn print_summary(metrics: &Metrics, out: Option<&std::path::Path>) -> anyhow::Result<()> {
    let mut lines = String::new();
    for (what, value) in metrics.summary() {
        lines.push_str(&format!("{what:<26} {value}\n"));
    }
    if let Some(out) = out {
        lines.push_str(&format!("{:<26} {}\n", "results in", out.display()));
    }
    print(&lines)
}
