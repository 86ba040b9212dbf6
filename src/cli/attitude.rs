use std::path::PathBuf;

use super::terminal::{INTERRUPTED, catch_interrupts, progress};
use mfg_vio::filter::attitude::{AdaptiveConfig, AttitudeFilterKind};
use mfg_vio::replay::{AttitudeMetrics, AttitudeRequest, replay_attitude};

/// Estimate attitude and gyro bias from an IMU and a magnetometer.
///
/// The log is CSV with the columns t,gx,gy,gz,ax,ay,az[,mx,my,mz] (s, rad/s, m/s^2; the magnetic
/// field in any unit), MCAP or a ROS bag with an IMU. World z is up and y is magnetic north;
/// without a magnetometer the heading is arbitrary. With --out the directory receives
/// attitude.csv: time, quaternion (world_from_body), gyro bias (rad/s) and the singular values s1
/// s2 s3 of the matrix Fisher parameter, one line a sample.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  mfg-vio attitude imu.csv --filter mfgba --out runs/attitude")]
pub struct AttitudeArgs {
    /// The log.
    log: PathBuf,
    /// mfgia, mfgiu, mfgba, mfgbu, fnf-r, fnf-l, bf-mfd, bf-amfd, uae, mekf, iekf or ukf.
    #[arg(long, value_name = "NAME", default_value_t = AttitudeFilterKind::Mfgba)]
    filter: AttitudeFilterKind,
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
        config: AdaptiveConfig::default(),
        out: args.out.clone(),
        stop: &INTERRUPTED,
    };
    let bar = progress(None, "samples");
    let metrics = replay_attitude(&request, || bar.inc(1));
    bar.finish_and_clear();
    let metrics = metrics?;
    if args.json {
        println!("{}", serde_json::to_string(&metrics)?);
    } else {
        print_summary(&metrics);
        if let Some(out) = &args.out {
            println!("written: {}", out.join("attitude.csv").display());
        }
    }
    Ok(())
}

fn print_summary(m: &AttitudeMetrics) {
    println!("{} over {}", m.filter, m.log);
    println!(
        "{} samples in {:.1} s ({} with magnetic field, {} refused, {} gaps); {:.2} us a sample",
        m.samples,
        m.log_seconds,
        m.magnetic_samples,
        m.refused,
        m.gaps,
        m.step_time_ns * 1e-3
    );
    println!(
        "at rest {:.1} s, magnetically disturbed {:.1} s, failed steps {}{}",
        m.rest_seconds,
        m.disturbed_seconds,
        m.failed_steps,
        if m.interrupted { ", interrupted" } else { "" }
    );
    if let Some(last) = &m.last {
        println!("at {:.3} s: quaternion (x y z w) {:.6?}", last.time, last.quaternion);
        println!("  standard deviation {:.3?} deg", last.rotation_sd_deg);
        println!("  gyro bias {:.6?} rad/s, s {:.1?}", last.gyro_bias, last.s);
    }
}
