//! The tracker on rendered images, whose points are known exactly.

use nalgebra::{Isometry3, Point2, Translation3, UnitQuaternion, Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::*;
use crate::inertial::ImuConfig;
use crate::sensor::{
    Camera, CameraConfig, ColorImage, DepthImage, ImuSample, PixelFormat, RgbdFrame, Stamp,
};
use crate::vision::{DepthConfig, FeatureConfig, Mask, MaskConfig, TrackedFeature};

const WIDTH: usize = 320;
const HEIGHT: usize = 240;
/// Between frames, s.
const STEP: f64 = 0.05;

fn camera() -> CameraConfig {
    CameraConfig { fx: 260.0, fy: 262.0, cx: 158.0, cy: 121.0, ..CameraConfig::default() }
}

fn on() -> TrackerConfig {
    TrackerConfig { points: 200, ..TrackerConfig::default() }
}

fn tracker(config: &TrackerConfig) -> Tracker {
    let (features, depth) = (FeatureConfig::default(), DepthConfig::default());
    Tracker::new(config, &features, &camera(), &depth, &ImuConfig::default()).unwrap()
}

/// Grey value between 0 and 1 of lattice points, the same at every call.
fn lattice(x: i64, y: i64, octave: i64) -> f64 {
    let mut hash = (x.wrapping_mul(0x9E37_79B9) ^ y.wrapping_mul(0x85EB_CA6B)) as u64;
    hash = (hash ^ (octave as u64) << 40).wrapping_mul(0xD6E8_FEB8_6659_FD93);
    hash = (hash ^ hash >> 32).wrapping_mul(0xD6E8_FEB8_6659_FD93);
    (hash >> 40) as f64 / (1 << 24) as f64
}

/// A texture of several sizes without repetition, of 255, at a place of the wall (m).
fn texture(place: Vector2<f64>) -> f64 {
    let mut value = 0.0;
    for (octave, (size, weight)) in [(0.31, 0.9), (0.11, 0.8), (0.04, 0.7)].iter().enumerate() {
        let scaled = place / *size;
        let (x, y) = (scaled.x.floor(), scaled.y.floor());
        let smooth = |f: f64| f * f * f * (f * (6.0 * f - 15.0) + 10.0);
        let (fx, fy) = (smooth(scaled.x - x), smooth(scaled.y - y));
        let at = |dx: i64, dy: i64| lattice(x as i64 + dx, y as i64 + dy, octave as i64);
        let upper = at(0, 0) + fx * (at(1, 0) - at(0, 0));
        let lower = at(0, 1) + fx * (at(1, 1) - at(0, 1));
        value += weight * (upper + fy * (lower - upper) - 0.5);
    }
    125.0 + 150.0 * value
}

/// A tilted wall ahead, and what is between it and the camera.
struct Scene {
    normal: Vector3<f64>,
    /// Along the normal, m.
    distance: f64,
    /// Centre (m) and half side of a square in front of the wall, at `depth`.
    screen: Option<(Vector3<f64>, f64)>,
    noise: f64,
}

impl Default for Scene {
    fn default() -> Self {
        let normal = Vector3::new(0.3, -0.2, 1.0).normalize();
        Self { normal, distance: 2.0, screen: None, noise: 1.5 }
    }
}

impl Scene {
    /// Where a ray meets the wall, and whether something is in front of it.
    fn hit(&self, pose: &Isometry3<f64>, ray: &Vector3<f64>) -> (Vector3<f64>, bool) {
        let (origin, direction) = (pose.translation.vector, pose.rotation * ray);
        let to = |range: f64| origin + direction * range;
        if let Some((centre, half)) = self.screen {
            let at = to((centre.z - origin.z) / direction.z);
            if (at - centre).xy().amax() < half {
                return (at, true);
            }
        }
        let range = (self.distance - self.normal.dot(&origin)) / self.normal.dot(&direction);
        (to(range), false)
    }

    fn render(&self, pose: &Isometry3<f64>, camera: &Camera, seed: u64) -> Vec<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut image = Vec::with_capacity(WIDTH * HEIGHT);
        for row in 0..HEIGHT {
            for column in 0..WIDTH {
                let pixel = Point2::new(column as f64, row as f64);
                let ray = camera.unproject(pixel, 1.0).unwrap();
                let (at, in_front) = self.hit(pose, &ray);
                let place = at.xy() + Vector2::repeat(if in_front { 40.0 } else { 0.0 });
                let noise: f64 = StandardNormal.sample(&mut rng);
                image.push(texture(place) + self.noise * noise);
            }
        }
        image
    }
}

fn grey(values: &[f64], gain: f64, brightness: f64) -> ColorImage {
    let pixels = values.iter().map(|v| (gain * v + brightness).round().clamp(0.0, 255.0) as u8);
    ColorImage::new(WIDTH, HEIGHT, PixelFormat::Mono8, pixels.collect()).unwrap()
}

fn frame(index: usize, color: ColorImage) -> RgbdFrame {
    let depth = DepthImage::new(WIDTH, HEIGHT, 1e-3, vec![2000; WIDTH * HEIGHT]).unwrap();
    RgbdFrame { stamp: stamp(index as f64 * STEP), color, depth, others: Vec::new() }
}

fn stamp(seconds: f64) -> Stamp {
    Stamp::default().offset_by(100.0 + seconds)
}

/// Handheld: swings of 0.2 m, turns of 10 degrees and a slow approach.
fn handheld(seconds: f64) -> Isometry3<f64> {
    let swing = |rate: f64, phase: f64| (rate * seconds + phase).sin() - phase.sin();
    let position = Vector3::new(0.2 * swing(2.0, 0.3), 0.12 * swing(2.9, 1.0), 0.15 * seconds);
    let turn = Vector3::new(0.08 * swing(3.1, 0.2), 0.17 * swing(2.3, 2.0), 0.12 * swing(1.7, 0.0));
    Isometry3::from_parts(Translation3::from(position), UnitQuaternion::from_scaled_axis(turn))
}

/// The rate of a motion, by differences, as a gyroscope measures it.
fn feed(tracker: &mut Tracker, motion: impl Fn(f64) -> Isometry3<f64>, until: f64) {
    for k in ((until - STEP).max(0.0) * 200.0) as i32..(until * 200.0) as i32 {
        let time = f64::from(k) / 200.0;
        let turn = motion(time - 5e-4).rotation.inverse() * motion(time + 5e-4).rotation;
        tracker.imu(&ImuSample {
            stamp: stamp(time),
            angular_velocity: turn.scaled_axis() / 1e-3,
            specific_force: Vector3::zeros(),
        });
    }
}

/// How far a view of a point is from where it should be.
struct Miss {
    age: usize,
    error: Vector2<f64>,
    /// Squared, over the covariance; `None` for the first view.
    chi_square: Option<f64>,
}

/// Follows a motion and compares each view of each point with where its first view should have gone.
fn misses(
    tracker: &mut Tracker,
    frames: usize,
    motion: impl Fn(f64) -> Isometry3<f64>,
    mut show: impl FnMut(usize, &Isometry3<f64>) -> (Scene, ColorImage),
    has_gyroscope: bool,
) -> Vec<Vec<Miss>> {
    let lens = Camera::new(&camera()).unwrap();
    let mut firsts: Vec<(u64, usize, Vector3<f64>)> = vec![];
    (0..frames)
        .map(|index| {
            let time = index as f64 * STEP;
            let pose = motion(time);
            let (scene, image) = show(index, &pose);
            if has_gyroscope {
                feed(tracker, &motion, time);
            }
            let tracks = tracker.track(&frame(index, image)).unwrap();
            let miss = |track: &TrackedFeature| {
                let known = firsts.iter().find(|(id, ..)| *id == track.id).copied();
                let (_, since, point) = known.unwrap_or_else(|| {
                    let ray = lens.unproject(track.pixel, 1.0).unwrap();
                    let first = (track.id, index, scene.hit(&pose, &ray).0);
                    firsts.push(first);
                    first
                });
                let expected = lens
                    .project(&pose.inverse_transform_vector(&(point - pose.translation.vector)));
                let error = track.pixel - expected.unwrap();
                let inverse = track.pixel_covariance.try_inverse();
                let chi_square = inverse.map(|inverse| (error.transpose() * inverse * error).x);
                Miss { age: index - since, error, chi_square }
            };
            tracks.iter().map(miss).collect()
        })
        .collect()
}

fn plain(scene: fn() -> Scene) -> impl FnMut(usize, &Isometry3<f64>) -> (Scene, ColorImage) {
    let lens = Camera::new(&camera()).unwrap();
    move |index, pose| {
        let image = scene().render(pose, &lens, index as u64);
        (scene(), grey(&image, 1.0, 0.0))
    }
}

fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values[((share * values.len() as f64) as usize).min(values.len() - 1)]
}

fn norms<'a>(misses: impl Iterator<Item = &'a Miss>) -> Vec<f64> {
    misses.map(|miss| miss.error.norm()).collect()
}

/// What is claimed of the error is what it is; it is the same for young points and for old ones.
#[test]
fn points_are_followed_without_drift() {
    // The wall is what the model of a point's surroundings takes it for.
    let config = TrackerConfig { pixel_sigma: 0.01, ..on() };
    let frames = misses(&mut tracker(&config), 60, handheld, plain(Scene::default), true);
    let later = || frames.iter().flatten().filter(|miss| miss.age > 0);
    let counts: Vec<usize> = frames.iter().map(Vec::len).collect();
    assert!(counts[1..].iter().all(|count| *count > 120), "{counts:?}");
    let errors = norms(later());
    assert!(quantile(errors.clone(), 0.5) < 0.05, "{}", quantile(errors.clone(), 0.5));
    assert!(quantile(errors.clone(), 0.99) < 0.25, "{}", quantile(errors, 0.99));
    let (young, old) =
        (norms(later().filter(|m| m.age < 6)), norms(later().filter(|m| m.age > 30)));
    assert!(old.len() > 1000, "{}", old.len());
    let growth = quantile(old, 0.5) / quantile(young, 0.5);
    assert!(growth < 1.4, "{growth}");
    let chi_squares: Vec<f64> = later().filter_map(|miss| miss.chi_square).collect();
    let mean = chi_squares.iter().sum::<f64>() / chi_squares.len() as f64 / 2.0;
    assert!((0.4..2.5).contains(&mean), "{mean}");
}

/// Exposure and gain change from frame to frame by up to a half.
#[test]
fn exposure_may_change() {
    let lens = Camera::new(&camera()).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let show = |index: usize, pose: &Isometry3<f64>| {
        let image = Scene::default().render(pose, &lens, index as u64);
        let gain = rng.random_range(0.5..1.0);
        (Scene::default(), grey(&image, gain, rng.random_range(-20.0..30.0)))
    };
    let frames = misses(&mut tracker(&on()), 30, handheld, show, true);
    let errors = norms(frames.iter().flatten().filter(|miss| miss.age > 0));
    let old = frames[29].iter().filter(|miss| miss.age > 20).count();
    assert!(old > 80, "{old}");
    assert!(quantile(errors.clone(), 0.5) < 0.07, "{}", quantile(errors.clone(), 0.5));
    assert!(quantile(errors.clone(), 0.99) < 0.5, "{}", quantile(errors, 0.99));
}

/// 2.2 rad/s: 29 pixels a frame. Without the gyroscope the pyramid has to bridge them.
#[test]
fn quick_turns_are_predicted() {
    let turn = |seconds: f64| {
        let turn = Vector3::new(0.0, 0.22 * (10.0 * seconds).sin(), 0.0);
        Isometry3::from_parts(Translation3::identity(), UnitQuaternion::from_scaled_axis(turn))
    };
    let config = TrackerConfig { levels: 2, ..on() };
    let kept = |has_gyroscope: bool| {
        let show = plain(Scene::default);
        let frames = misses(&mut tracker(&config), 8, turn, show, has_gyroscope);
        let errors = norms(frames[7].iter().filter(|miss| miss.age > 3));
        errors.iter().filter(|error| **error < 0.5).count()
    };
    let (with, without) = (kept(true), kept(false));
    assert!(with > 40 && without < with / 4, "{with} {without}");
}

/// A screen slides over the wall: what is behind it is not followed, and nothing is dragged along.
#[test]
fn what_is_covered_is_not_followed() {
    let lens = Camera::new(&camera()).unwrap();
    let scene = |index: usize| Scene {
        screen: Some((Vector3::new(-1.2 + 0.05 * index as f64, 0.0, 1.2), 0.3)),
        ..Scene::default()
    };
    let show = |index: usize, pose: &Isometry3<f64>| {
        let image = scene(index).render(pose, &lens, index as u64);
        (scene(index), grey(&image, 1.0, 0.0))
    };
    let frames = misses(&mut tracker(&on()), 40, handheld, show, true);
    let errors = norms(frames.iter().flatten().filter(|miss| miss.age > 0));
    let wrong = errors.iter().filter(|error| **error > 1.0).count();
    // Points of the screen itself move, and are outliers to the wall.
    assert!(wrong * 50 < errors.len(), "{wrong} of {}", errors.len());
}

#[test]
fn the_same_log_gives_the_same_points() {
    let lens = Camera::new(&camera()).unwrap();
    let run = || {
        let mut tracker = tracker(&on());
        let mut all = vec![];
        for index in 0..10 {
            let pose = handheld(index as f64 * STEP);
            feed(&mut tracker, handheld, index as f64 * STEP);
            let image = grey(&Scene::default().render(&pose, &lens, index as u64), 1.0, 0.0);
            all.push(tracker.track(&frame(index, image)).unwrap());
        }
        all
    };
    assert_eq!(run(), run());
}

#[test]
fn masks_jumps_and_the_dark_are_honoured() {
    let lens = Camera::new(&camera()).unwrap();
    let mask: Mask = MaskConfig::Regions(vec![[100, 60, 90, 70]]).load().unwrap();
    let mut tracker = tracker(&on()).masked(mask.clone());
    let mut show = |index: usize, number: usize| {
        let pose = handheld(index as f64 * STEP);
        let image = grey(&Scene::default().render(&pose, &lens, index as u64), 1.0, 0.0);
        tracker.track(&frame(number, image)).unwrap()
    };
    let first = show(0, 0);
    let second = show(1, 1);
    for track in first.iter().chain(&second) {
        assert!(!mask.covers(track.pixel.x, track.pixel.y));
    }
    let kept = second.iter().filter(|track| first.iter().any(|other| other.id == track.id));
    assert!(kept.count() > 60);
    let last = second.iter().map(|track| track.id).max().unwrap();
    // After a pause, and with a clock that is set back, all points are new.
    let later = show(2, 60);
    assert!(!later.is_empty() && later.iter().all(|track| track.id > last));
    let last = later.iter().map(|track| track.id).max().unwrap();
    let earlier = show(3, 4);
    assert!(!earlier.is_empty() && earlier.iter().all(|track| track.id > last));

    // A frame in the dark shows nothing; the points are found again behind it.
    let black = grey(&[0.0; WIDTH * HEIGHT], 1.0, 0.0);
    assert_eq!(tracker.track(&frame(5, black)).unwrap(), []);
    let pose = handheld(4.0 * STEP);
    let image = grey(&Scene::default().render(&pose, &lens, 4), 1.0, 0.0);
    let again = tracker.track(&frame(6, image)).unwrap();
    let found = again.iter().filter(|track| earlier.iter().any(|other| other.id == track.id));
    assert!(found.count() > 40);
}

#[test]
fn configurations_that_cannot_be_are_refused() {
    let refused = |config: TrackerConfig| {
        let (features, depth) = (FeatureConfig::default(), DepthConfig::default());
        let made = Tracker::new(&config, &features, &camera(), &depth, &ImuConfig::default());
        made.err().unwrap().to_string()
    };
    let default = on;
    assert!(refused(TrackerConfig { levels: 0, ..default() }).contains("tracker.levels = 0"));
    assert!(refused(TrackerConfig { levels: 7, ..default() }).contains("1 to 6"));
    assert!(refused(TrackerConfig { cell_size: 1.0, ..default() }).contains("cell_size"));
    assert!(refused(TrackerConfig { patience: f64::NAN, ..default() }).contains("patience"));
    assert!(refused(TrackerConfig { pixel_sigma: 0.0, ..default() }).contains("above 0"));
    assert!(refused(TrackerConfig { min_correlation: 1.0, ..default() }).contains("-1 to 1"));
}

/// Views of a pair of cameras: how far those of the second one are from the truth (px, and as
/// chi-square over the covariance), and how many points it was found for.
fn stereo_misses(other: &CameraConfig, frames: usize) -> (Vec<f64>, Vec<f64>, f64) {
    let config = TrackerConfig { pixel_sigma: 0.02, ..on() };
    let mut tracker = tracker(&config).with_others(&camera(), std::slice::from_ref(other)).unwrap();
    let (first, second) = (Camera::new(&camera()).unwrap(), Camera::new(other).unwrap());
    let mounting = other.imu_from_camera().unwrap();
    let scene = Scene::default();
    let (mut errors, mut chi_squares, mut seen) = (vec![], vec![], 0);
    for index in 0..frames {
        let pose = handheld(index as f64 * STEP);
        feed(&mut tracker, handheld, index as f64 * STEP);
        let pose_of_other = pose * mounting;
        let mut frame = frame(index, grey(&scene.render(&pose, &first, index as u64), 1.0, 0.0));
        let seed = 1000 + index as u64;
        frame.others = vec![grey(&scene.render(&pose_of_other, &second, seed), 0.8, 10.0)];
        let tracks = tracker.track(&frame).unwrap();
        seen += tracks.iter().filter(|track| track.camera == 0).count();
        for pair in tracks.windows(2).filter(|pair| pair[1].camera == 1) {
            assert_eq!(pair[0].id, pair[1].id);
            assert_eq!(pair[1].depth, None);
            let ray = first.unproject(pair[0].pixel, 1.0).unwrap();
            let point = scene.hit(&pose, &ray).0;
            let expected =
                second.project(&pose_of_other.inverse_transform_point(&point.into()).coords);
            let error = pair[1].pixel - expected.unwrap();
            errors.push(error.norm());
            let covariance = pair[1].pixel_covariance + pair[0].pixel_covariance;
            chi_squares.push((error.transpose() * covariance.try_inverse().unwrap() * error).x);
        }
    }
    let share = errors.len() as f64 / seen as f64;
    (errors, chi_squares, share)
}

fn mounted(camera: CameraConfig, position: Vector3<f64>, turn: Vector3<f64>) -> CameraConfig {
    let mounting =
        Isometry3::from_parts(Translation3::from(position), UnitQuaternion::from_scaled_axis(turn));
    let matrix = mounting.to_homogeneous();
    let imu_from_camera = std::array::from_fn(|i| std::array::from_fn(|j| matrix[(i, j)]));
    CameraConfig { imu_from_camera, ..camera }
}

/// Beside the first camera, wide apart, above it, turned towards it, with another lens.
#[test]
fn other_cameras_see_points_on_their_epipolar_lines() {
    let other_lens = CameraConfig {
        fx: 310.0,
        fy: 308.0,
        cx: 165.0,
        cy: 117.0,
        distortion: vec![-0.2, 0.04, 1e-3, -5e-4],
        ..camera()
    };
    for (what, other) in [
        ("beside", mounted(camera(), Vector3::new(0.11, 0.0, 0.0), Vector3::zeros())),
        ("wide", mounted(camera(), Vector3::new(0.4, 0.01, 0.0), Vector3::new(0.0, -0.1, 0.0))),
        ("above", mounted(camera(), Vector3::new(0.01, -0.12, 0.0), Vector3::new(0.0, 0.0, 0.02))),
        ("unequal", mounted(other_lens, Vector3::new(-0.1, 0.02, 0.01), Vector3::repeat(0.02))),
    ] {
        let (errors, chi_squares, share) = stereo_misses(&other, 12);
        let wrong =
            errors.iter().filter(|error| **error > 1.0).count() as f64 / errors.len() as f64;
        let (median, most) = (quantile(errors.clone(), 0.5), quantile(errors.clone(), 0.99));
        let chi_square = quantile(chi_squares, 0.5);
        eprintln!(
            "{what}: share {share:.2} median {median:.3} 99 % {most:.3} wrong {wrong:.4} chi {chi_square:.2}"
        );
        assert!(share > 0.6, "{what}: {share}");
        assert!(median < 0.08 && wrong < 0.005, "{what}: {median} {most} {wrong}");
        // The median of two degrees of freedom is 1.4.
        assert!((0.4..3.0).contains(&chi_square), "{what}: {chi_square}");
    }
}
