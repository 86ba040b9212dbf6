use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

use clap::Args;

use super::terminal::{INTERRUPTED, catch_interrupts, print, progress};
use mfg_vio::dataset::{LogWriter, WriteSummary};
use mfg_vio::output::Files;
use mfg_vio::replay::{InertialInput, inertial_samples};
use mfg_vio::sensor::Event;
use mfg_vio::simulation::{MeasuredImu, SceneConfig, Simulation};

/// Render an RGB-D + IMU log with ground truth.
#[derive(Debug, Args)]
#[command(after_help = "Example:\n  mfg-vio simulate --out lab.mcap --duration 10 --seed 1\n  \
                        mfg-vio simulate --imu flight.bag --trajectory flight.tum --out rendered.mcap")]
pub struct SimulateArgs {
    /// The log to write (MCAP).
    #[arg(long, value_name = "LOG.mcap")]
    out: PathBuf,
    /// Scene file; see datasets/.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Move along a recorded trajectory (TUM format, poses of the IMU).
    #[arg(long, value_name = "TUM")]
    trajectory: Option<PathBuf>,
    /// A log with the IMU that was measured along the trajectory, on its clock (or CSV as for `attitude`):
    /// its samples take the place of simulated ones, and tell what is up.
    #[arg(long, value_name = "LOG")]
    imu: Option<PathBuf>,
    /// Direction that points up in the trajectory's world, or `auto`.
    #[arg(long, value_name = "X,Y,Z", default_value = "auto", allow_hyphen_values = true)]
    up: Up,
    /// Length of the log, s.
    #[arg(long, value_name = "S")]
    duration: Option<f64>,
    /// Seed of everything random.
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
}

/// The vertical of a recorded trajectory.
#[derive(Debug, Clone, Copy)]
enum Up {
    /// As the scene file says, else found from the motion.
    Auto,
    Given([f64; 3]),
}

impl std::str::FromStr for Up {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if text == "auto" {
            return Ok(Self::Auto);
        }
        let numbers: Result<Vec<f64>, _> = text.split(',').map(|x| x.trim().parse()).collect();
        let vector = numbers.ok().and_then(|v| <[f64; 3]>::try_from(v).ok());
        let usable = |v: &[f64; 3]| v.iter().all(|x| x.is_finite()) && v.iter().any(|x| *x != 0.0);
        vector.filter(usable).map(Self::Given).ok_or("expected `auto` or three numbers: 0,0,1")
    }
}

pub fn run(args: SimulateArgs) -> anyhow::Result<()> {
    let mut scene = match &args.config {
        Some(path) => SceneConfig::from_file(path)?,
        None => SceneConfig::default(),
    };
    if let Some(file) = args.trajectory {
        scene.trajectory.file = file;
        if args.config.is_none() {
            // All of it.
            scene.duration = 0.0;
        }
    }
    if let Up::Given(up) = args.up {
        scene.trajectory.up = up;
    }
    scene.duration = args.duration.unwrap_or(scene.duration);
    scene.seed = args.seed.unwrap_or(scene.seed);
    if !scene.trajectory.file.as_os_str().is_empty() {
        // It may be the scene file that names it.
        let mut files = Files::new();
        files.reads("trajectory", &scene.trajectory.file).writes("--out", &args.out).check()?;
    }
    catch_interrupts()?;
    let simulation = match &args.imu {
        Some(log) => {
            let input = InertialInput { log, config: None, overrides: &[], topic: None };
            Simulation::with_imu(scene, MeasuredImu::new(inertial_samples(&input)?))?
        }
        None => Simulation::new(scene)?,
    };
    let summary = write(simulation, &args.out)?;
    print(&format!(
        "{}: {} frames, {} IMU samples, {} truth poses",
        args.out.display(),
        summary.frames,
        summary.imu_samples,
        summary.truth_poses
    ))
}

/// Writes the log of a scene; an interrupted one is complete up to there.
pub fn render(scene: SceneConfig, out: &Path) -> anyhow::Result<WriteSummary> {
    write(Simulation::new(scene)?, out)
}

fn write(simulation: Simulation, out: &Path) -> anyhow::Result<WriteSummary> {
    let log = LogWriter::create(out, simulation.config().log.clone())?;
    let frames = simulation.config().duration * simulation.config().image.rate;
    let bar = progress(Some(frames as u64 + 1), "simulated frames");
    let summary = simulation.write(log, |event| {
        if matches!(event, Event::Frame(_)) {
            bar.inc(1);
        }
        match INTERRUPTED.load(Ordering::Relaxed) {
            true => ControlFlow::Break(()),
            false => ControlFlow::Continue(()),
        }
    })?;
    bar.finish_and_clear();
    anyhow::ensure!(
        !INTERRUPTED.load(Ordering::Relaxed),
        "interrupted; {} is complete up to there",
        out.display()
    );
    Ok(summary)
}
