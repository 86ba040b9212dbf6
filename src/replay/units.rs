//! Units and signs that readings cannot have, told from gravity, from the sensors' ranges and from
//! the course over ground.

use nalgebra::Vector3;

use crate::filter::gnss::GnssConfig;
use crate::inertial::ImuConfig;
use crate::sensor::{ImuSample, PositionFix};

/// The mean specific force of a recording is that of gravity within this factor.
const GRAVITY_FACTOR: f64 = 1.5;
/// Units of an accelerometer, in m/s^2: g, mg, cm/s^2, mm/s^2.
const ACCELEROMETER_UNITS: [f64; 4] = [9.80665, 9.80665e-3, 1e-2, 1e-3];
/// Intervals of inertial sensors, s: 5 kHz to 2 Hz.
const INTERVALS: [f64; 2] = [2e-4, 0.5];
/// Units of time, in s.
const TIME_UNITS: [f64; 3] = [1e-3, 1e-6, 1e-9];
/// Largest range of gyroscopes on the market (4000 deg/s), rad/s.
const LARGEST_RATE: f64 = 70.0;
/// A turn of the course is told from noise if the way between fixes is so many standard deviations.
const NOISE_FACTOR: f64 = 20.0;
/// Shortest way (m) and longest time (s) between two fixes of a course.
const SHORTEST_WAY: f64 = 1.0;
const LONGEST_TIME: f64 = 5.0;
/// Turns that decide, and the correlation beyond which they do: standard deviations of that of as
/// many independent pairs, and the least.
const FEWEST_TURNS: usize = 20;
const DECISIVE_DEVIATIONS: f64 = 4.0;
const LEAST_DECISIVE: f64 = 0.5;

#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum UnitError {
    #[error(
        "IMU samples are {interval} s apart: stamps are in s, or in ns where the name of their \
         column says so (`t_ns`); these look like multiples of {unit:e} s"
    )]
    Time { interval: f64, unit: f64 },
    #[error(
        "the accelerometer reads {mean:.4} in the median where gravity is {gravity} m/s^2: set \
         `imu.accelerometer_scale={factor}`"
    )]
    Accelerometer { mean: f64, gravity: f64, factor: f64 },
    #[error(
        "the accelerometer reads {mean:.4} in the median, which is no gravity in any unit: set \
         `imu.accelerometer_scale`"
    )]
    NoGravity { mean: f64 },
    #[error(
        "the gyroscope reads up to {largest:.1}: not rad/s; set `imu.gyroscope_scale={factor:.8}`"
    )]
    Gyroscope { largest: f64, factor: f64 },
    #[error(
        "the course over ground turns by {ratio:.4} of what the gyroscope says: set \
         `imu.gyroscope_scale={factor:.8}`"
    )]
    Turns { ratio: f64, factor: f64 },
    #[error(
        "the course over ground turns against the gyroscope: positions with z down (set \
         `log.world_axes=\"ned\"`), or an accelerometer that reads gravity rather than specific \
         force (set `imu.accelerometer_scale={inverted}`)"
    )]
    Mirrored { inverted: f64 },
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    let middle = values.len() / 2;
    if values.is_empty() {
        return None;
    }
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Refuses stamps, accelerations and rates that are in other units than configured.
pub fn check_imu(imu: &[ImuSample], config: &ImuConfig) -> Result<(), UnitError> {
    let intervals = imu.windows(2).map(|pair| pair[1].stamp.seconds_since(pair[0].stamp));
    if let Some(interval) = median(intervals.collect())
        && interval > INTERVALS[1]
        && let Some(unit) = TIME_UNITS
            .into_iter()
            .find(|unit| (INTERVALS[0]..=INTERVALS[1]).contains(&(interval * unit)))
    {
        return Err(UnitError::Time { interval, unit });
    }
    let scaled = || imu.iter().map(|sample| config.in_si_units(sample));
    let near = |force: f64| {
        force > config.gravity / GRAVITY_FACTOR && force < config.gravity * GRAVITY_FACTOR
    };
    let force = median(scaled().map(|sample| sample.specific_force.norm()).collect());
    if let Some(mean) = force
        && !near(mean)
    {
        let unit = ACCELEROMETER_UNITS.into_iter().find(|unit| near(mean * unit));
        return Err(match unit {
            Some(unit) => UnitError::Accelerometer {
                mean,
                gravity: config.gravity,
                factor: unit * config.accelerometer_scale,
            },
            None => UnitError::NoGravity { mean },
        });
    }
    let largest = scaled().map(|sample| sample.angular_velocity.amax()).fold(0.0, f64::max);
    if largest > LARGEST_RATE {
        let factor = config.gyroscope_scale.to_radians();
        return Err(UnitError::Gyroscope { largest, factor });
    }
    Ok(())
}

/// Refuses a gyroscope in deg/s, and axes that mirror the motion, where the turns of the course over
/// ground follow the gyroscope's. A body that moves sideways (a drone) decides nothing.
pub fn check_course(
    imu: &[ImuSample],
    fixes: &[PositionFix],
    config: &GnssConfig,
) -> Result<(), UnitError> {
    let turns = turns(imu, fixes, config);
    if turns.len() < FEWEST_TURNS {
        return Ok(());
    }
    // About their means: a gyroscope's bias turns by as much in each.
    let n = turns.len() as f64;
    let seconds: f64 = turns.iter().map(|turn| turn.seconds).sum();
    let bias = turns.iter().map(|turn| turn.of_gyroscope).sum::<f64>() / seconds;
    let drift = turns.iter().map(|turn| turn.of_course).sum::<f64>() / n;
    let pairs: Vec<(f64, f64)> = turns
        .iter()
        .map(|turn| (turn.of_gyroscope - bias * turn.seconds, turn.of_course - drift))
        .collect();
    let sum = |f: fn(&(f64, f64)) -> f64| pairs.iter().map(f).sum::<f64>();
    let (xx, xy, yy) = (sum(|p| p.0 * p.0), sum(|p| p.0 * p.1), sum(|p| p.1 * p.1));
    let correlation = xy / (xx * yy).sqrt();
    let ratio = xy / xx;
    let degrees = 1.0_f64.to_radians();
    let decisive = LEAST_DECISIVE.max(DECISIVE_DEVIATIONS / n.sqrt());
    if correlation < -decisive {
        return Err(UnitError::Mirrored { inverted: -config.imu.accelerometer_scale });
    }
    if correlation > decisive && (0.5 * degrees..2.0 * degrees).contains(&ratio) {
        return Err(UnitError::Turns { ratio, factor: config.imu.gyroscope_scale * degrees });
    }
    Ok(())
}

/// A turn between two stretches of the way, rad.
struct Turn {
    of_course: f64,
    of_gyroscope: f64,
    seconds: f64,
}

fn turns(imu: &[ImuSample], fixes: &[PositionFix], config: &GnssConfig) -> Vec<Turn> {
    let sd = |fix: &PositionFix| {
        let told = fix.covariance.filter(|_| config.receiver.use_log_covariance);
        told.map_or(config.receiver.horizontal_noise, |c| (0.5 * (c[(0, 0)] + c[(1, 1)])).sqrt())
    };
    let gyroscope = VerticalTurn::new(imu, &config.imu);
    let mut marks: Vec<&PositionFix> = Vec::new();
    let mut courses: Vec<Option<(f64, f64)>> = Vec::new();
    for fix in fixes {
        let Some(last) = marks.last() else {
            marks.push(fix);
            continue;
        };
        let way = fix.position - last.position;
        let long = way.xy().norm() > SHORTEST_WAY.max(NOISE_FACTOR * sd(fix));
        let seconds = fix.stamp.seconds_since(last.stamp);
        if long || seconds > LONGEST_TIME {
            let middle = 0.5 * (gyroscope.seconds(fix) + gyroscope.seconds(last));
            courses.push((long && seconds <= LONGEST_TIME).then(|| (middle, way.y.atan2(way.x))));
            marks.push(fix);
        }
    }
    let pairs = courses.windows(2).filter_map(|pair| pair[0].zip(pair[1]));
    let turn = |((from, before), (to, after)): ((f64, f64), (f64, f64))| {
        let of_course = (after - before + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU)
            - std::f64::consts::PI;
        let of_gyroscope = gyroscope.between(from, to)?;
        Some(Turn { of_course, of_gyroscope, seconds: to - from })
    };
    pairs.filter_map(turn).collect()
}

/// The integral of the angular velocity about the mean direction of the specific force.
struct VerticalTurn {
    start: crate::sensor::Stamp,
    /// Time since the start (s), turn since then (rad).
    reached: Vec<(f64, f64)>,
}

impl VerticalTurn {
    fn new(imu: &[ImuSample], config: &ImuConfig) -> Self {
        let mean: Vector3<f64> =
            imu.iter().map(|sample| config.in_si_units(sample).specific_force).sum();
        let up = mean.try_normalize(0.0).unwrap_or_else(Vector3::z);
        let start = imu.first().map(|sample| sample.stamp).unwrap_or_default();
        let mut turned = 0.0;
        let mut reached = vec![(0.0, 0.0)];
        for pair in imu.windows(2) {
            let h = pair[1].stamp.seconds_since(pair[0].stamp);
            let rate = (pair[0].angular_velocity + pair[1].angular_velocity) * 0.5;
            turned += up.dot(&rate) * config.gyroscope_scale * h;
            reached.push((pair[1].stamp.seconds_since(start), turned));
        }
        Self { start, reached }
    }

    fn seconds(&self, fix: &PositionFix) -> f64 {
        fix.stamp.seconds_since(self.start)
    }

    fn between(&self, from: f64, to: f64) -> Option<f64> {
        let at = |time: f64| {
            let next = self.reached.partition_point(|(t, _)| *t < time);
            (next > 0).then(|| self.reached.get(next).map(|(_, turned)| *turned)).flatten()
        };
        Some(at(to)? - at(from)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::Stamp;

    /// A winding road at 8 m/s, the IMU at 100 Hz, fixes at 1 Hz.
    fn drive() -> (Vec<ImuSample>, Vec<PositionFix>) {
        let (mut position, mut imu, mut fixes) = (Vector3::zeros(), Vec::new(), Vec::new());
        for k in 0..12_000_i64 {
            let t = k as f64 * 0.01;
            let heading = 1.2 * (0.2 * t).sin();
            let rate = 0.24 * (0.2 * t).cos() + 0.05;
            let stamp = Stamp::from_nanos(k * 10_000_000);
            imu.push(ImuSample {
                stamp,
                angular_velocity: Vector3::z() * rate,
                specific_force: Vector3::new(0.1, 8.0 * rate, 9.8),
            });
            if k % 100 == 0 {
                fixes.push(PositionFix { stamp, position, covariance: None });
            }
            position += Vector3::new(heading.cos(), heading.sin(), 0.0) * 0.08;
        }
        (imu, fixes)
    }

    fn config() -> GnssConfig {
        let mut config = GnssConfig::default();
        config.receiver.horizontal_noise = 0.2;
        config
    }

    #[test]
    fn right_units_pass() {
        let (imu, fixes) = drive();
        assert_eq!(check_imu(&imu, &config().imu), Ok(()));
        assert_eq!(check_course(&imu, &fixes, &config()), Ok(()));
    }

    #[test]
    fn other_units_are_refused_with_the_factor() {
        let (mut imu, _) = drive();
        imu.iter_mut().for_each(|sample| sample.specific_force /= 9.80665);
        let error = check_imu(&imu, &config().imu).unwrap_err();
        assert!(error.to_string().contains("imu.accelerometer_scale=9.80665"), "{error}");

        let (mut imu, _) = drive();
        for sample in &mut imu {
            sample.stamp = Stamp::from_nanos(sample.stamp.nanos() * 1000);
        }
        let error = check_imu(&imu, &config().imu).unwrap_err();
        assert!(error.to_string().contains("multiples of 1e-3 s"), "{error}");
    }

    #[test]
    fn the_course_tells_degrees_and_mirrored_axes() {
        let (mut imu, mut fixes) = drive();
        imu.iter_mut().for_each(|sample| sample.angular_velocity *= 1.0_f64.to_degrees());
        let error = check_course(&imu, &fixes, &config()).unwrap_err();
        assert!(error.to_string().contains("imu.gyroscope_scale=0.01745"), "{error}");
        let (imu, _) = drive();
        for fix in &mut fixes {
            fix.position = Vector3::new(fix.position.y, fix.position.x, -fix.position.z);
        }
        let error = check_course(&imu, &fixes, &config()).unwrap_err();
        assert!(matches!(error, UnitError::Mirrored { inverted } if inverted == -1.0), "{error}");
    }
}
