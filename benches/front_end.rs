//! The front end on one thread, beside OpenCV's own ORB and Lucas-Kanade on the same images: points
//! followed at 640x480, and from pair to pair at 752x480.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use mfg_vio::inertial::ImuConfig;
use mfg_vio::sensor::{
    CameraConfig, ColorImage, DepthImage, ImuSample, PixelFormat, RgbdFrame, Stamp,
};
use mfg_vio::vision::{DepthConfig, FeatureConfig, OrbExtractor, Tracker, TrackerConfig};
use nalgebra::Vector3;
use opencv::core::{KeyPoint, Mat, Point2f, Size, TermCriteria, Vector, no_array};
use opencv::features2d::{ORB, ORB_ScoreType};
use opencv::prelude::*;
use opencv::video;

/// Frames that are gone through forth and back.
const FRAMES: usize = 20;
/// Shift from frame to frame, px.
const SHIFT: (f64, f64) = (3.3, 1.7);

/// Smooth noise of three sizes.
fn texture(x: f64, y: f64) -> f64 {
    let lattice = |x: f64, y: f64, octave: f64| {
        let value = ((x * 12.9898 + y * 78.233 + octave * 37.719).sin() * 43758.5453).fract();
        value.abs()
    };
    [40.0, 14.0, 5.0].iter().enumerate().fold(125.0, |sum, (octave, size)| {
        let (u, v) = (x / size, y / size);
        let (left, top) = (u.floor(), v.floor());
        let smooth = |f: f64| f * f * (3.0 - 2.0 * f);
        let (fx, fy) = (smooth(u - left), smooth(v - top));
        let at = |dx: f64, dy: f64| lattice(left + dx, top + dy, octave as f64);
        let upper = at(0.0, 0.0) + fx * (at(1.0, 0.0) - at(0.0, 0.0));
        let lower = at(0.0, 1.0) + fx * (at(1.0, 1.0) - at(0.0, 1.0));
        sum + 110.0 * (upper + fy * (lower - upper) - 0.5)
    })
}

/// A view of the texture moved by so many pixels.
fn view(width: usize, height: usize, x: f64, y: f64) -> ColorImage {
    let at = |i: usize| texture((i % width) as f64 + x, (i / width) as f64 + y);
    let pixels = (0..width * height).map(|i| at(i).clamp(0.0, 255.0) as u8).collect();
    ColorImage::new(width, height, PixelFormat::Mono8, pixels).expect("whole image")
}

/// What a camera that moves sideways before a wall at 2 m sees; with a second one 0.1 m beside it.
fn frames(width: usize, height: usize, has_pairs: bool) -> Vec<RgbdFrame> {
    let disparity = camera().fx * 0.1 / 2.0;
    (0..FRAMES)
        .map(|k| {
            let (x, y) = (500.0 + SHIFT.0 * k as f64, 500.0 + SHIFT.1 * k as f64);
            let others = has_pairs.then(|| view(width, height, x + disparity, y));
            RgbdFrame {
                stamp: Stamp::default(),
                color: view(width, height, x, y),
                depth: DepthImage::new(width, height, 1e-3, vec![2000; width * height])
                    .expect("whole"),
                others: others.into_iter().collect(),
            }
        })
        .collect()
}

fn camera() -> CameraConfig {
    CameraConfig { fx: 460.0, fy: 460.0, cx: 320.0, cy: 240.0, ..CameraConfig::default() }
}

fn tracker() -> Tracker {
    let (features, depth) = (FeatureConfig::default(), DepthConfig::default());
    let config = TrackerConfig { points: 200, ..TrackerConfig::default() };
    Tracker::new(&config, &features, &camera(), &depth, &ImuConfig::default()).expect("defaults")
}

/// Goes through the frames forth and back, 30 a second, as a log does.
struct Player {
    frames: Vec<RgbdFrame>,
    count: usize,
}

impl Player {
    fn next(&mut self, tracker: &mut Tracker) -> &RgbdFrame {
        let turn = self.count % (2 * FRAMES - 2);
        let index = turn.min(2 * FRAMES - 2 - turn);
        for sample in 0..4 {
            let seconds = self.count as f64 / 30.0 + f64::from(sample) / 120.0;
            tracker.imu(&ImuSample {
                stamp: Stamp::default().offset_by(seconds),
                angular_velocity: Vector3::zeros(),
                specific_force: Vector3::zeros(),
            });
        }
        self.count += 1;
        self.frames[index].stamp = Stamp::default().offset_by(self.count as f64 / 30.0);
        &self.frames[index]
    }
}

fn mat(image: &ColorImage) -> Mat {
    let (rows, columns) = (image.height() as i32, image.width() as i32);
    let view =
        Mat::new_rows_cols_with_bytes::<u8>(rows, columns, image.data()).expect("whole image");
    view.try_clone().expect("memory")
}

fn followed(c: &mut Criterion) {
    opencv::core::set_num_threads(1).expect("OpenCV");
    let mut group = c.benchmark_group("640x480");
    let images = frames(640, 480, false);
    let (former, present) = (mat(&images[0].color), mat(&images[1].color));

    let mut player = Player { frames: images.clone(), count: 0 };
    let mut follower = tracker();
    group.bench_function("tracker, 200 points", |b| {
        b.iter(|| {
            let frame = player.next(&mut follower).clone();
            follower.track(black_box(&frame)).expect("tracks")
        })
    });

    let first = tracker().track(&images[0]).expect("tracks");
    let points: Vector<Point2f> = first
        .iter()
        .map(|track| Point2f::new(track.pixel.x as f32, track.pixel.y as f32))
        .collect();
    let flow = |from: &Mat, to: &Mat, points: &Vector<Point2f>| {
        let (mut found, mut status, mut errors) =
            (Vector::new(), Vector::<u8>::new(), Vector::<f32>::new());
        let criteria = TermCriteria::new(3, 30, 0.01).expect("criteria");
        let size = Size::new(15, 15);
        video::calc_optical_flow_pyr_lk(
            from,
            to,
            points,
            &mut found,
            &mut status,
            &mut errors,
            size,
            3,
            criteria,
            0,
            1e-4,
        )
        .expect("flow");
        found
    };
    let name = format!("OpenCV LK forth and back, {} points", points.len());
    group.bench_function(name, |b| {
        b.iter(|| {
            let there: Vector<Point2f> = flow(black_box(&former), &present, &points);
            flow(&present, &former, &there)
        })
    });

    let mut orb =
        ORB::create(600, 1.44, 4, 16, 0, 2, ORB_ScoreType::HARRIS_SCORE, 31, 20).expect("ORB");
    group.bench_function("OpenCV ORB, 600 points", |b| {
        b.iter(|| {
            let (mut found, mut descriptors) = (Vector::<KeyPoint>::new(), Mat::default());
            orb.detect_and_compute(
                black_box(&present),
                &no_array(),
                &mut found,
                &mut descriptors,
                false,
            )
            .expect("ORB");
            descriptors
        })
    });

    let depth = DepthConfig::default();
    let mut own =
        OrbExtractor::new(&FeatureConfig::default(), &camera(), &depth).expect("defaults");
    group.bench_function("ORB front end, 600 points", |b| {
        b.iter(|| own.extract(black_box(&images[1])).expect("features"))
    });
}

fn pairs(c: &mut Criterion) {
    let mut other = camera();
    other.imu_from_camera[0][3] = 0.1;
    let mut player = Player { frames: frames(752, 480, true), count: 0 };
    let mut follower = tracker().with_others(&camera(), &[other]).expect("two cameras");
    c.bench_function("752x480 pairs/tracker, 200 points", |b| {
        b.iter(|| {
            let frame = player.next(&mut follower).clone();
            follower.track(black_box(&frame)).expect("tracks")
        })
    });
}

criterion_group!(benches, followed, pairs);
criterion_main!(benches);
