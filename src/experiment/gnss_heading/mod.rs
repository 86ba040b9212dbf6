//! Unknown heading and unknown gyroscope bias with GNSS, on simulated drives.
//!
//! A car, a rover and a drone start at any heading with a gyroscope bias of up to 5 deg/s, drive for
//! a minute with fixes at 1, 5 or 10 Hz of 0.05 to 2 m, and go on for another minute without. Beside
//! `mfgi` and `mekf` run two that start from many headings: a bank of 24 extended Kalman filters and
//! a Rao-Blackwellised particle filter over heading and vertical bias ([`ensemble`]). All of them go
//! through [`navigate_with`], the levelling at the start and the running test of the innovations
//! included.

mod drive;
mod ensemble;

use std::ops::ControlFlow;
use std::sync::LazyLock;

use nalgebra::Vector3;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use self::drive::{Drive, Vehicle};
use self::ensemble::Ensemble;
use super::study::{
    Observation, Report, Request, StepTime, Study, StudyError, Trial, monte_carlo,
    normalized_square,
};
use crate::filter::FilterError;
use crate::filter::gnss::{
    GnssConfig, GnssFilter, GnssFilterKind, InitialBelief, NavigationError, NavigationStep,
    OutageConfig, navigate_with,
};
use crate::inertial::{ImuConfig, NavState, block};

pub const STUDIES: &[Study] = &[
    Study {
        name: "gnss-heading",
        title: "unknown heading and gyroscope bias with GNSS: car, rover, drone",
        runs: 50,
        run: |request| study(request, "gnss-heading", &CELLS),
    },
    Study {
        name: "gnss-heading-quick",
        title: "the same in a cell of each vehicle",
        runs: 10,
        run: |request| study(request, "gnss-heading-quick", &QUICK_CELLS),
    },
];

/// With fixes, s.
const GUIDED: f64 = 60.0;
/// Without, s, and when the position is compared with the truth.
const OUTAGE: f64 = 60.0;
/// All of it; a last fix after the last mark ends the outage.
const DURATION: f64 = GUIDED + OUTAGE + 1.0;
const OUTAGE_MARKS: [(f64, &str); 3] =
    [(10.0, "outage_10s_m"), (20.0, "outage_20s_m"), (60.0, "outage_60s_m")];
const RATES: [f64; 3] = [1.0, 5.0, 10.0];
const NOISES: [f64; 4] = [0.05, 0.2, 0.5, 2.0];
const FILTERS: [&str; 4] = ["mfgi", "mekf", "ekf-bank", "particles"];

/// A vehicle with a receiver.
#[derive(Debug, Clone)]
struct Cell {
    label: String,
    vehicle: Vehicle,
    /// Of the fixes, Hz.
    rate: f64,
    /// Of a fix along each axis, m.
    noise: f64,
}

fn cell(vehicle: Vehicle, rate: f64, noise: f64) -> Cell {
    Cell { label: format!("{} {rate} Hz {noise} m", vehicle.name()), vehicle, rate, noise }
}

static CELLS: LazyLock<Vec<Cell>> = LazyLock::new(|| {
    let all = Vehicle::ALL.into_iter().flat_map(|vehicle| {
        RATES.into_iter().flat_map(move |rate| NOISES.map(|noise| cell(vehicle, rate, noise)))
    });
    all.collect()
});

static QUICK_CELLS: LazyLock<Vec<Cell>> = LazyLock::new(|| {
    vec![
        cell(Vehicle::Car, 10.0, 0.5),
        cell(Vehicle::Rover, 5.0, 0.05),
        cell(Vehicle::Drone, 1.0, 0.5),
    ]
});

fn imu() -> ImuConfig {
    ImuConfig {
        gyro_noise: 3e-4,
        accel_noise: 1e-2,
        gyro_bias_walk: 2e-5,
        accel_bias_walk: 2e-4,
        gyro_bias_sd: 0.5 * drive::LARGEST_BIAS,
        accel_bias_sd: 0.1,
        ..ImuConfig::default()
    }
}

fn config(cell: &Cell) -> GnssConfig {
    let mut config = GnssConfig { imu: imu(), ..GnssConfig::default() };
    config.receiver.horizontal_noise = cell.noise;
    config.receiver.vertical_noise = cell.noise;
    // Accelerations of 1.7 m/s^2 while it is levelled.
    config.start.tilt_sd = 10.0;
    config.outage = OutageConfig { start: GUIDED, length: DURATION - GUIDED, period: 0.0 };
    config.output.interval = f64::MAX;
    config
}

fn study(request: &Request, name: &str, cells: &'static [Cell]) -> Result<Report, StudyError> {
    let trials = monte_carlo(request, |rng| trial(cells, rng))?;
    let mut report = Report::of(name, request.seed, &trials, &[]);
    report.notes.push(format!(
        "errors and NEES over {GUIDED} s with fixes; heading_found_s: when the heading was said to \
         be within 5 deg ({GUIDED} if never); nees_heading has 1 degree of freedom, the others 3."
    ));
    Ok(report)
}

fn trial(cells: &'static [Cell], rng: &mut ChaCha8Rng) -> Result<Trial, NavigationError> {
    let mut trial = Trial::default();
    for vehicle in Vehicle::ALL {
        let drive = Drive::new(vehicle, &imu(), DURATION, rng);
        let seed = rng.random();
        for cell in cells.iter().filter(|cell| cell.vehicle == vehicle) {
            for filter in FILTERS {
                run(cell, filter, &drive, seed, &mut trial)?;
            }
        }
    }
    Ok(trial)
}

fn start(
    filter: &str,
    config: &GnssConfig,
    seed: u64,
    initial: &InitialBelief,
) -> Result<Box<dyn GnssFilter>, FilterError> {
    let known =
        |kind: GnssFilterKind| kind.start(&config.imu, config.filter.attitude_update, initial);
    Ok(match filter {
        "mekf" => known(GnssFilterKind::Mekf)?,
        "ekf-bank" => Box::new(Ensemble::bank(&config.imu, initial)?),
        "particles" => Box::new(Ensemble::particles(&config.imu, initial, seed)?),
        _ => known(GnssFilterKind::Mfgi)?,
    })
}

/// Quantities over the part with fixes, in the order of [`Sums::values`].
const QUANTITIES: [&str; 9] = [
    "heading_deg",
    "attitude_deg",
    "velocity_m_s",
    "position_m",
    "gyro_bias_deg_s",
    "nees_heading",
    "nees_attitude",
    "nees_velocity",
    "nees_position",
];

fn run(
    cell: &'static Cell,
    filter: &'static str,
    drive: &Drive,
    seed: u64,
    trial: &mut Trial,
) -> Result<(), NavigationError> {
    let config = config(cell);
    let fixes = drive.fixes(cell.rate, cell.noise);
    let mut sums = Sums::default();
    let mut marks = [(f64::NAN, f64::NAN); OUTAGE_MARKS.len()];
    let clock = cpu_time::ThreadTime::now();
    let started = |_: &ImuConfig, initial: &InitialBelief| start(filter, &config, seed, initial);
    let summary = navigate_with(started, &config, &drive.imu, &fixes, |step| {
        if let Some(truth) = drive.truth_at(step.stamp) {
            let elapsed = step.stamp.seconds() - fixes[0].stamp.seconds();
            if elapsed > 0.0 && elapsed < GUIDED {
                sums.add(step, truth);
            }
            for (mark, (time, _)) in marks.iter_mut().zip(OUTAGE_MARKS) {
                if (elapsed - GUIDED - time).abs() < 0.5 / cell.rate {
                    *mark = errors(step, truth).position;
                }
            }
        }
        ControlFlow::Continue(())
    })?;
    let nanoseconds = clock.elapsed().as_secs_f64() / drive.imu.len() as f64 * 1e9;
    let mut push = |quantity, value| {
        let case = cell.label.as_str();
        trial.observations.push(Observation { case, filter, quantity, value });
    };
    for (quantity, sum) in QUANTITIES.into_iter().zip(sums.values) {
        push(quantity, sum / sums.steps as f64);
    }
    for ((error, nees), (_, name)) in marks.into_iter().zip(OUTAGE_MARKS) {
        push(name, error);
        if name == "outage_20s_m" {
            push("nees_outage_20s", nees);
        }
    }
    let nis: Vec<f64> = summary.nis.iter().map(|(_, nis)| *nis).collect();
    push("nis_position", nis.iter().sum::<f64>() / nis.len() as f64);
    let found = summary.heading_converged.filter(|t| *t < GUIDED);
    push("heading_found_s", found.unwrap_or(GUIDED));
    push("heading_not_found", f64::from(u8::from(found.is_none())));
    let label = cell.label.as_str();
    trial.step_times.push(StepTime { case: label, filter, nanoseconds });
    Ok(())
}

/// Sums over the fixes of a run.
#[derive(Default)]
struct Sums {
    values: [f64; QUANTITIES.len()],
    steps: usize,
}

impl Sums {
    fn add(&mut self, step: &NavigationStep, truth: &NavState) {
        let Errors { heading, attitude, velocity, position, gyro_bias } = errors(step, truth);
        let values = [
            heading.0.to_degrees(),
            attitude.0.to_degrees(),
            velocity.0,
            position.0,
            gyro_bias.to_degrees(),
            heading.1,
            attitude.1,
            velocity.1,
            position.1,
        ];
        self.steps += 1;
        self.values.iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
    }
}

/// Errors with their normalised squares.
struct Errors {
    heading: (f64, f64),
    attitude: (f64, f64),
    velocity: (f64, f64),
    position: (f64, f64),
    gyro_bias: f64,
}

fn errors(step: &NavigationStep, truth: &NavState) -> Errors {
    let state = &step.belief.state;
    let turn = state.world_from_body.rotation.inverse() * truth.world_from_body.rotation;
    let part = |error: Vector3<f64>, start: usize| {
        let covariance = step.belief.covariance.fixed_view::<3, 3>(start, start).into_owned();
        (error.norm(), normalized_square(&error, &covariance))
    };
    let up = state.world_from_body.rotation.inverse() * Vector3::z();
    let heading = up.dot(&turn.scaled_axis());
    let position = |state: &NavState| state.world_from_body.translation.vector;
    Errors {
        heading: (heading.abs(), (heading / step.heading_sd()).powi(2)),
        attitude: part(turn.scaled_axis(), block::ROTATION),
        velocity: part(truth.velocity - state.velocity, block::VELOCITY),
        position: part(position(truth) - position(state), block::POSITION),
        gyro_bias: (truth.gyro_bias - state.gyro_bias).norm(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    /// One drive of each vehicle: the heading is found, and the errors are as large as claimed.
    #[test]
    fn mfgi_finds_the_heading_of_every_vehicle() {
        let mut rng = ChaCha8Rng::seed_from_u64(12);
        for cell in QUICK_CELLS.iter() {
            let drive = Drive::new(cell.vehicle, &imu(), DURATION, &mut rng);
            let mut trial = Trial::default();
            run(cell, "mfgi", &drive, 0, &mut trial).unwrap();
            let value = |quantity: &str| {
                let found = trial.observations.iter().find(|o| o.quantity == quantity);
                found.map(|o| o.value).unwrap()
            };
            assert_eq!(value("heading_not_found"), 0.0, "{}", cell.label);
            for quantity in ["nees_heading", "nees_velocity", "nees_position"] {
                let nees = value(quantity);
                assert!(nees > 0.05 && nees < 10.0, "{} {quantity} {nees}", cell.label);
            }
        }
    }

    /// The sensors of a drive are those that the filters assume.
    #[test]
    fn a_drive_agrees_with_its_own_readings() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        for vehicle in Vehicle::ALL {
            let quiet = ImuConfig {
                gyro_noise: 0.0,
                accel_noise: 0.0,
                gyro_bias_walk: 0.0,
                accel_bias_walk: 0.0,
                accel_bias_sd: 0.0,
                ..imu()
            };
            let drive = Drive::new(vehicle, &quiet, 10.0, &mut rng);
            let mut state = drive.truth[0];
            for pair in drive.imu.windows(2) {
                let mean = |f: fn(&crate::sensor::ImuSample) -> Vector3<f64>| {
                    (f(&pair[0]) + f(&pair[1])) * 0.5
                };
                let turn = (mean(|s| s.angular_velocity) - state.gyro_bias) * drive::STEP;
                let middle = state.world_from_body.rotation
                    * nalgebra::UnitQuaternion::from_scaled_axis(turn * 0.5);
                let acceleration =
                    middle * mean(|s| s.specific_force) - Vector3::z() * quiet.gravity;
                let moved =
                    state.velocity * drive::STEP + acceleration * (0.5 * drive::STEP * drive::STEP);
                state.world_from_body.translation.vector += moved;
                state.velocity += acceleration * drive::STEP;
                state.world_from_body.rotation *= nalgebra::UnitQuaternion::from_scaled_axis(turn);
            }
            let last = drive.truth.last().unwrap();
            let apart = state.world_from_body.inverse() * last.world_from_body;
            assert!(apart.rotation.angle() < 2e-3, "{}", vehicle.name());
            assert!(apart.translation.vector.norm() < 0.1, "{}", vehicle.name());
        }
    }
}
