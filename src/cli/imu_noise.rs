use std::fmt::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use mfg_vio::evaluation::noise_figure;
use mfg_vio::inertial::identification::{AxisNoise, Coefficient, ImuNoise};
use mfg_vio::output;
use mfg_vio::replay::{InertialInput, NoiseSettings, noise_of_log};

use super::argument::seconds;
use super::terminal::print;

/// Measure the noise of an IMU on a log of it at rest: Allan deviation, densities, vibrations.
///
/// The longest rest of the log is used; motors may run. For each axis: white noise N (the value a
/// second has the deviation N), bias instability B, random walk K, each with its standard deviation,
/// or the 95 % limit below which it is where the rest is too short to show it; and the vibrations that
/// stand out of the spectrum. Ten seconds show the white noise, minutes to hours the rest. The section
/// [imu] at the end is what to estimate with: the white noise of the noisiest axis as integrations
/// between a thirtieth of a second and a second see it, vibrations included. LOG is anything with an
/// IMU, or CSV with the columns t,gx,gy,gz,ax,ay,az.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Example:\n  mfg-vio imu-noise still.bag --plot allan.svg --write-config own.toml\n  \
                        mfg-vio replay flight.bag --config own.toml"
)]
pub struct Args {
    /// The log: a file or a folder.
    log: PathBuf,
    /// Configuration with the units of the IMU [default: by the log's layout].
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Override a key of the configuration, e.g. --set imu.accelerometer_scale=-9.81 (repeatable).
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Topic of the IMU [default: chosen by message type].
    #[arg(long, value_name = "TOPIC")]
    topic: Option<String>,
    /// Skip the first seconds.
    #[arg(long, value_name = "S", default_value_t = 0.0, value_parser = seconds)]
    start: f64,
    /// Use only this many seconds.
    #[arg(long, value_name = "S", default_value_t = f64::INFINITY, hide_default_value = true,
          value_parser = seconds)]
    duration: f64,
    /// Allan deviations as SVG or PNG.
    #[arg(long, value_name = "FILE")]
    plot: Option<PathBuf>,
    /// Write the configuration of the log with the measured noise, for --config.
    #[arg(long, value_name = "FILE")]
    write_config: Option<PathBuf>,
    /// Print everything as one JSON object.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let input = InertialInput {
        log: &args.log,
        config: args.config.as_deref(),
        overrides: &args.overrides,
        topic: args.topic.as_deref(),
    };
    let noise = noise_of_log(&input, args.start, args.duration)?;
    let settings = NoiseSettings::of(&noise);
    if let Some(file) = &args.plot {
        noise_figure(&noise).save(file)?;
    }
    if let Some(file) = &args.write_config {
        let text = settings.configuration(&input)?;
        output::write(file, text).with_context(|| format!("{}", file.display()))?;
    }
    if args.json {
        let mut object = serde_json::to_value(&noise)?;
        object["log"] = args.log.display().to_string().into();
        object["settings"] = settings.values().collect();
        return print(&serde_json::to_string_pretty(&object)?);
    }
    let mut text = String::new();
    describe(&mut text, &args.log, &noise)?;
    write!(text, "\n{}", settings.section())?;
    print(text.trim_end())
}

fn describe(out: &mut String, log: &Path, noise: &ImuNoise) -> fmt::Result {
    writeln!(
        out,
        "{}: at rest for {:.1} s, {:.3} s to {:.3} s (longest of {}); {} samples, {:.2} a second, {} \
         interpolated\n",
        log.display(),
        noise.rest.seconds(),
        noise.rest.start,
        noise.rest.end,
        noise.rests.len(),
        noise.samples,
        noise.rate,
        noise.interpolated
    )?;
    writeln!(
        out,
        "{:<16} {:>10} {:>10} {:>22} {:>22} {:>22} {:>10}",
        "axis",
        "mean",
        "rms",
        "white N (/sqrt(Hz))",
        "instability B",
        "walk K (sqrt(Hz))",
        "in use"
    )?;
    for axis in &noise.axes {
        writeln!(
            out,
            "{:<16} {:>10.5} {:>10.2e} {:>22} {:>22} {:>22} {:>10.2e}",
            name(axis),
            axis.mean,
            axis.rms,
            coefficient(&axis.white_noise),
            coefficient(&axis.bias_instability),
            coefficient(&axis.random_walk),
            axis.noise_in_use
        )?;
    }
    writeln!(out)?;
    for axis in &noise.axes {
        for vibration in &axis.vibrations {
            writeln!(
                out,
                "vibration: {:<14} {:>7.2} Hz, {:.1} Hz wide, rms {:.2e} {}",
                name(axis),
                vibration.frequency,
                vibration.width,
                vibration.rms,
                axis.unit
            )?;
        }
    }
    if noise.axes.iter().all(|axis| axis.vibrations.is_empty()) {
        writeln!(out, "no vibrations")?;
    }
    Ok(())
}

fn name(axis: &AxisNoise) -> String {
    format!("{:?} {}", axis.sensor, axis.axis).to_lowercase()
}

fn coefficient(c: &Coefficient) -> String {
    match c.significant {
        true => format!("{:.2e} +- {:.0e}", c.value, c.sd),
        false => format!("below {:.1e}", c.at_most),
    }
}
