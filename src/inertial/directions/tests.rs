use nalgebra::{Rotation3, Vector3};

use super::*;
use crate::sensor::Stamp;

const RATE: f64 = 100.0;
const FIELD: Vector3<f64> = Vector3::new(0.0, 16e-6, -42e-6);

/// A hand that turns a sensor about all axes.
fn turning(t: f64) -> Rotation3<f64> {
    Rotation3::from_euler_angles(
        1.1 * (1.3 * t).sin(),
        0.9 * (0.8 * t + 1.0).sin(),
        2.0 * (0.5 * t).sin(),
    )
}

fn still(_: f64) -> Vector3<f64> {
    Vector3::zeros()
}

fn shaken(t: f64) -> Vector3<f64> {
    let w = 2.0 * std::f64::consts::PI;
    3.0 * Vector3::new((w * t).sin(), (0.9 * w * t).cos(), 0.5 * (1.2 * w * t).sin())
}

/// What is simulated.
struct Scene {
    attitude: fn(f64) -> Rotation3<f64>,
    acceleration: fn(f64) -> Vector3<f64>,
    /// In body coordinates.
    iron: fn(f64) -> Vector3<f64>,
    gyro_bias: Vector3<f64>,
    /// Of the magnetometer, s.
    delay: f64,
}

const HELD: Scene = Scene {
    attitude: turning,
    acceleration: still,
    iron: still,
    gyro_bias: Vector3::new(0.0, 0.0, 0.0),
    delay: 0.0,
};

impl Scene {
    /// The directions found between two times, each with its time.
    fn run(&self, finder: &mut DirectionFinder, from: f64, to: f64) -> Vec<(f64, Directions)> {
        let h = RATE.recip();
        let samples = (from * RATE) as usize + 1..=(to * RATE) as usize;
        let gravity = Vector3::new(0.0, 0.0, 9.81);
        samples
            .filter_map(|k| {
                let t = k as f64 * h;
                let (before, now) = ((self.attitude)(t - h), (self.attitude)(t));
                let sample = ImuSample {
                    stamp: Stamp::from_nanos((t * 1e9) as i64),
                    angular_velocity: so3::log(&(before.inverse() * now)) / h + self.gyro_bias,
                    specific_force: now.inverse() * ((self.acceleration)(t) + gravity),
                };
                let delayed = (self.attitude)(t - self.delay);
                let field = delayed.inverse() * FIELD + (self.iron)(t);
                finder.push(&sample, Some(&field), h, &KNOWN_BIAS).map(|directions| (t, directions))
            })
            .collect()
    }

    /// Largest error of the direction that `world` should show, degrees.
    fn worst(
        &self,
        found: &[(f64, Directions)],
        world: Vector3<f64>,
        direction: fn(&Directions) -> Option<BodyDirection>,
    ) -> f64 {
        let error = |(t, directions): &(f64, Directions)| {
            let in_world = (self.attitude)(*t) * direction(directions).unwrap().in_body;
            in_world.angle(&world).to_degrees()
        };
        found.iter().map(error).fold(0.0, f64::max)
    }

    fn worst_up(&self, found: &[(f64, Directions)]) -> f64 {
        self.worst(found, Vector3::z(), |d| d.up)
    }

    fn worst_north(&self, found: &[(f64, Directions)]) -> f64 {
        self.worst(found, Vector3::y(), |d| d.north)
    }
}

const KNOWN_BIAS: Prediction = Prediction {
    gyro_bias: Vector3::new(0.0, 0.0, 0.0),
    gyro_bias_covariance: Matrix3::new(1e-10, 0.0, 0.0, 0.0, 1e-10, 0.0, 0.0, 0.0, 1e-10),
    up: None,
};

fn finder() -> DirectionFinder {
    DirectionFinder::new(&DirectionConfig::default(), 9.81)
}

#[test]
fn what_sensors_show_without_disturbance_is_exact() {
    let mut finder = finder();
    let found = HELD.run(&mut finder, 0.0, 20.0);
    assert_eq!(found.len(), 200);
    // Within an interval the body turns by up to ten degrees.
    assert!(HELD.worst_up(&found) < 0.01, "{}", HELD.worst_up(&found));
    assert!(HELD.worst_north(&found) < 0.2, "{}", HELD.worst_north(&found));
    assert!(found.iter().all(|(_, d)| !d.disturbed && d.resting_rate.is_none()));
}

#[test]
fn acceleration_averages_out_and_lowers_the_concentration() {
    let scene = Scene { acceleration: shaken, ..HELD };
    let found = scene.run(&mut finder(), 0.0, 20.0);
    let settled = &found[80..];
    // The acceleration alone tilts the specific force by up to 20 degrees.
    assert!(scene.worst_up(settled) < 1.0, "{}", scene.worst_up(settled));
    let calm = HELD.run(&mut finder(), 0.0, 20.0);
    let concentration = |found: &[(f64, Directions)]| found[150].1.up.unwrap().concentration;
    assert!(concentration(&found) < 0.8 * concentration(&calm));
}

#[test]
fn lasting_acceleration_is_not_taken_for_gravity() {
    let scene = Scene { acceleration: |_| Vector3::new(4.0, 0.0, 0.0), ..HELD };
    let found = scene.run(&mut finder(), 0.0, 2.0);
    let error = scene.worst_up(&found[..1]).to_radians();
    let first = found[0].1.up.unwrap();
    assert!(error * first.concentration.sqrt() < 2.0, "{error} {first:?}");
}

#[test]
fn iron_that_comes_is_noticed_and_learnt() {
    let scene = Scene {
        iron: |t| if t < 15.0 { Vector3::zeros() } else { Vector3::new(-7e-6, -1e-6, 58e-6) },
        ..HELD
    };
    let mut finder = finder();
    let found = scene.run(&mut finder, 0.0, 45.0);
    let (before, after) = found.split_at(150);
    assert!(before.iter().all(|(_, d)| !d.disturbed));
    assert!(after[0].1.disturbed);
    let settled = &after[200..];
    assert!(settled.iter().all(|(_, d)| !d.disturbed));
    assert!(scene.worst_north(settled) < 2.0, "{}", scene.worst_north(settled));
    let error = finder.iron() - (scene.iron)(45.0);
    assert!(error.norm() < 0.02 * FIELD.norm(), "{error:?}");
    // While it was unknown, north was hardly claimed.
    let claimed = |d: &Directions| d.north.map_or(0.0, |north| north.concentration);
    assert!(claimed(&after[0].1) < 0.01 * claimed(&before[149].1));
}

#[test]
fn the_delay_of_the_magnetometer_is_learnt() {
    let scene = Scene { attitude: |t| turning(3.0 * t), delay: 0.02, ..HELD };
    let worst = |delay_sd: f64| {
        let mut config = DirectionConfig::default();
        config.magnetic.delay_sd = delay_sd;
        // A field that varies by 3 % from place to place, for seconds, shows the delay slowly: of
        // the 20 ms, 12.8 are known after 10 s and 15.5 after 20 s (errors of 4.6 and 3.1 degrees).
        let found = scene.run(&mut DirectionFinder::new(&config, 9.81), 0.0, 40.0);
        scene.worst_north(&found[200..])
    };
    let (learnt, ignored) = (worst(MagneticConfig::default().delay_sd), worst(0.0));
    assert!(ignored > 10.0 && learnt < 0.25 * ignored, "{learnt} {ignored}");
}

/// Three seconds of samples that do not change but for the field, which turns at `field_rate`.
fn resting_rates(rate: f64, field_rate: f64, bias_sd: f64) -> Vec<(Vector3<f64>, f64)> {
    let mut finder = finder();
    let prediction = Prediction {
        gyro_bias_covariance: Matrix3::from_diagonal_element(bias_sd * bias_sd),
        ..KNOWN_BIAS
    };
    let shown = |k: i64| {
        let sample = ImuSample {
            stamp: Stamp::from_nanos(k * 10_000_000),
            angular_velocity: Vector3::new(0.0, 0.0, rate),
            specific_force: Vector3::new(0.0, 0.0, 9.81),
        };
        let field = so3::exp(&Vector3::new(0.0, 0.0, -field_rate * 0.01 * k as f64)) * FIELD;
        finder.push(&sample, Some(&field), 0.01, &prediction)
    };
    (1..=300).filter_map(shown).filter_map(|found| found.resting_rate).collect()
}

#[test]
fn a_resting_gyroscope_shows_its_bias_however_large() {
    for bias in [0.002, 0.15] {
        let found = resting_rates(bias, 0.0, 0.09);
        // Not before all intervals of the window are there.
        assert_eq!(found.len(), 16);
        for (rate, variance) in found {
            assert!((rate - Vector3::new(0.0, 0.0, bias)).norm() < 1e-12);
            assert!(variance.sqrt() < 2e-3, "{variance}");
        }
    }
}

#[test]
fn a_steady_turn_is_no_rest_if_the_field_or_the_known_bias_says_so() {
    // About the vertical only the horizontal part of the field turns, here 0.36 of it: it moves by
    // 5 % within the window from 0.33 rad/s on. The bias alone would not refuse that rate.
    assert!(resting_rates(0.4, 0.4, 0.09).is_empty());
    assert!(!resting_rates(0.4, 0.0, 0.09).is_empty());
    assert!(resting_rates(0.15, 0.0, 1e-4).is_empty());
    let found = HELD.run(&mut finder(), 0.0, 20.0);
    assert!(found.iter().all(|(_, d)| d.resting_rate.is_none()));
}

/// A slow sway: its rate passes for constant, but not for long.
#[test]
fn what_a_slow_motion_hides_is_counted() {
    let scene = Scene {
        attitude: |t| Rotation3::from_euler_angles(0.05 * (0.6 * t).sin(), 0.0, 0.0),
        ..HELD
    };
    for (t, found) in scene.run(&mut finder(), 0.0, 30.0) {
        let Some((rate, variance)) = found.resting_rate else { continue };
        assert!(rate.norm() < 3.0 * variance.sqrt(), "{rate} {variance} at {t}");
    }
}

#[test]
fn readings_of_one_error_add_up_to_what_the_best_of_them_is_worth() {
    let mut finder = finder();
    for gap in 0..2 {
        let found = HELD.run(&mut finder, 100.0 * f64::from(gap), 100.0 * f64::from(gap) + 1.0);
        for of in [|d: &Directions| d.up.unwrap(), |d: &Directions| d.north.unwrap()] {
            let sum: f64 = found.iter().map(|(_, d)| of(d).concentration).sum();
            let worth = found.iter().map(|(_, d)| of(d).variance.recip()).fold(0.0, f64::max);
            assert!((0.95..2.5).contains(&(sum / worth)), "{sum} {worth}");
        }
        finder.pass_gap(&Vector3::zeros(), 10.0);
    }
}

#[test]
fn a_bias_that_becomes_known_turns_what_was_read_before() {
    let bias = Vector3::new(0.02, -0.03, 0.01);
    let scene = Scene { gyro_bias: bias, ..HELD };
    let mut finder = finder();
    let wrong = scene.run(&mut finder, 0.0, 4.0);
    // 0.037 rad/s over the second and a half by which the low-passes lag behind by then.
    assert!(scene.worst_up(&wrong[30..]) > 2.0, "{}", scene.worst_up(&wrong[30..]));
    let t: f64 = 4.1;
    let h = t - 4.0;
    let (before, now) = (turning(4.0), turning(t));
    let sample = ImuSample {
        stamp: Stamp::from_nanos((t * 1e9) as i64),
        angular_velocity: so3::log(&(before.inverse() * now)) / h + bias,
        specific_force: now.inverse() * Vector3::new(0.0, 0.0, 9.81),
    };
    let known = Prediction { gyro_bias: bias, ..KNOWN_BIAS };
    let found = finder.push(&sample, None, h, &known).unwrap().up.unwrap();
    let error = (now * found.in_body).angle(&Vector3::z()).to_degrees();
    assert!(error < 0.6, "{error}");
}

/// A car that brakes: what is felt is not where up was expected, and is not believed.
#[test]
fn a_deviation_from_the_expected_direction_lowers_the_concentration() {
    let prediction = Prediction { up: Some((Vector3::z(), 1e-4)), ..KNOWN_BIAS };
    let mut finder = finder();
    let mut concentrations = Vec::new();
    for k in 1..=800 {
        let braking = if k > 400 { 3.0 } else { 0.0 };
        let sample = ImuSample {
            stamp: Stamp::from_nanos(k * 10_000_000),
            angular_velocity: Vector3::zeros(),
            specific_force: Vector3::new(braking, 0.0, 9.81),
        };
        let found = finder.push(&sample, None, 0.01, &prediction);
        concentrations.extend(found.and_then(|found| found.up).map(|up| up.concentration));
    }
    let (calm, braking) = (concentrations[35], concentrations[60]);
    assert!(braking < 0.01 * calm, "{braking} {calm}");
}

#[test]
fn sensors_that_show_no_direction_yield_none() {
    let sample = |force: f64| ImuSample {
        stamp: Stamp::from_nanos(0),
        angular_velocity: Vector3::zeros(),
        specific_force: Vector3::new(0.0, 0.0, force),
    };
    let zero = Vector3::zeros();
    let vertical = Vector3::new(0.0, 0.0, -4e-5);
    let falls = finder().push(&sample(0.0), Some(&FIELD), 0.1, &KNOWN_BIAS).unwrap();
    assert!(falls.up.is_none() && falls.north.is_none());
    for field in [None, Some(&zero), Some(&vertical)] {
        let found = finder().push(&sample(9.81), field, 0.1, &KNOWN_BIAS).unwrap();
        assert!(found.up.is_some() && found.north.is_none(), "{found:?}");
    }
}
