use std::path::PathBuf;

use super::terminal::{INTERRUPTED, catch_interrupts, print, progress};
use mfg_vio::filter::attitude::AttitudeFilterKind;
use mfg_vio::replay::{AttitudeMetrics, AttitudeRequest, Reached, replay_attitude};

/// Estimate attitude and gyro bias from an IMU and a magnetometer.
///
/// The log is CSV with the columns t,gx,gy,gz,ax,ay,az[,mx,my,mz] (s, rad/s, m/s^2; the magnetic
/// field in any unit), MCAP or a ROS bag with an IMU. World z is up and y is magnetic north;
/// without a magnetometer the heading counts from where it began. With --out the directory receives
/// attitude.csv: time, quaternion (world_from_body), gyro bias (rad/s), the singular values s1 s2 s3
/// of the matrix Fisher parameter and the covariance of the body-frame rotation vector (rad^2), one
/// line a sample.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  mfg-vio attitude imu.csv --filter mfgba --out runs/attitude")]
pub struct AttitudeArgs {
    /// The log.
    log: PathBuf,
    /// mfgia, mfgiu, mfgba, mfgbu, fnf-r, fnf-l, bf-mfd, bf-amfd, uae, mekf, iekf or ukf.
    #[arg(long, value_name = "NAME", default_value_t = AttitudeFilterKind::Mfgba)]
    filter: AttitudeFilterKind,
    /// Configuration of the sensors; a file of `replay` serves as well, for its section [imu]
    /// [default: configs/attitude.toml, units by the log's layout].
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Override a key of the configuration, e.g. --set imu.gyro_bias_sd=0.01 (repeatable).
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Topic of the IMU [default: chosen by message type].
    #[arg(long, value_name = "TOPIC")]
    topic: Option<String>,
    /// Directory for attitude.csv.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Print the summary as one JSON object.
    #[arg(long)]
    json: bool,
}

pub fn run(args: &AttitudeArgs) -> anyhow::Result<()> {
    catch_interrupts()?;
    let request = AttitudeRequest {
        log: args.log.clone(),
        filter: args.filter,
        config: args.config.clone(),
        overrides: args.overrides.clone(),
        topic: args.topic.clone(),
        out: args.out.clone(),
        stop: &INTERRUPTED,
    };
    let bar = progress(None, "samples");
    let metrics = replay_attitude(&request, || bar.inc(1));
    bar.finish_and_clear();
    let metrics = metrics?;
    if args.json {
        return print(&serde_json::to_string(&metrics)?);
    }
    let mut lines = summary(&metrics);
    if let Some(out) = &args.out {
        lines.push(format!("written: {}", out.join("attitude.csv").display()));
    }
    print(&lines.join("\n"))
}

fn summary(m: &AttitudeMetrics) -> Vec<String> {
    let mut lines = vec![format!("{} over {}", m.filter, m.log)];
    lines.push(format!(
        "{} samples in {:.1} s ({} with magnetic field, {} refused, {} gaps); {:.2} us a sample",
        m.samples,
        m.log_seconds,
        m.magnetic_samples,
        m.refused,
        m.gaps,
        m.step_time_ns * 1e-3
    ));
    lines.push(format!(
        "in gaps {:.1} s, at rest {:.1} s, magnetically disturbed {:.1} s, failed steps {}{}",
        m.gap_seconds,
        m.rest_seconds,
        m.disturbed_seconds,
        m.failed_steps,
        if m.interrupted { ", interrupted" } else { "" }
    ));
    if let Some(limit) = m.gyro_limit {
        lines.push(format!(
            "gyroscope at the end of its range ({:.2} rad/s, {:.0} deg/s) in {} samples, which are \
             taken for uncertain",
            limit,
            limit.to_degrees(),
            m.clipped_samples
        ));
    }
    if let Some(last) = &m.last {
        let Reached { time, quaternion, rotation_sd_deg, gyro_bias, s, .. } = last;
        lines.push(format!("at {time:.3} s: quaternion (x y z w) {quaternion:.6?}"));
        lines.push(format!("  standard deviation {rotation_sd_deg:.3?} deg"));
        lines.push(format!("  gyro bias {gyro_bias:.6?} rad/s, s {s:.1?}"));
    }
    lines
}
