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

fn lying(_: f64) -> Rotation3<f64> {
    Rotation3::from_euler_angles(0.3, -0.5, 1.0)
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
                finder.push(&sample, Some(&field), h).map(|directions| (t, directions))
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

fn finder() -> DirectionFinder {
    DirectionFinder::new(&DirectionConfig::default())
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
        let found = scene.run(&mut DirectionFinder::new(&config), 0.0, 20.0);
        scene.worst_north(&found[100..])
    };
    let (learnt, ignored) = (worst(MagneticConfig::default().delay_sd), worst(0.0));
    assert!(ignored > 10.0 && learnt < 0.25 * ignored, "{learnt} {ignored}");
}

#[test]
fn a_resting_gyroscope_shows_its_bias() {
    let gyro_bias = Vector3::new(0.01, -0.02, 0.005);
    let rest = Scene { attitude: lying, gyro_bias, ..HELD };
    let mut finder = finder();
    let found = rest.run(&mut finder, 0.0, 10.0);
    // Not before all intervals of the window are alike.
    assert!(found[..14].iter().all(|(_, d)| d.resting_rate.is_none()));
    assert!(found[14..].iter().all(|(_, d)| d.resting_rate.is_some()));
    let (bias, variance) = finder.gyro_bias();
    assert!((bias - gyro_bias).norm() < 1e-4, "{bias:?}");
    assert!(variance.sqrt() < 5e-4);
    let moving = Scene { gyro_bias, ..HELD };
    let found = moving.run(&mut finder, 10.0, 20.0);
    assert!(found[15..].iter().all(|(_, d)| d.resting_rate.is_none()));
}

#[test]
fn the_first_direction_counts_in_full_and_again_after_a_gap() {
    let mut finder = finder();
    let found = HELD.run(&mut finder, 0.0, 1.0);
    let north = |found: &[(f64, Directions)], k: usize| found[k].1.north.unwrap().concentration;
    let up = |found: &[(f64, Directions)], k: usize| found[k].1.up.unwrap().concentration;
    assert!(north(&found, 0) > 50.0 * north(&found, 1));
    assert!(up(&found, 0) > 5.0 * up(&found, 1));
    finder.forget_attitude();
    let again = HELD.run(&mut finder, 100.0, 101.0);
    assert!(north(&again, 0) > 50.0 * north(&again, 1));
    assert!(HELD.worst_up(&again) < 0.01 && HELD.worst_north(&again) < 0.5);
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
    let falls = finder().push(&sample(0.0), Some(&FIELD), 0.1).unwrap();
    assert!(falls.up.is_none() && falls.north.is_none());
    for field in [None, Some(&zero), Some(&vertical)] {
        let found = finder().push(&sample(9.81), field, 0.1).unwrap();
        assert!(found.up.is_some() && found.north.is_none(), "{found:?}");
    }
}
