//! A simulated body that follows points without depth, through the whole pipeline.

use nalgebra::{Isometry3, Matrix2, Point3, UnitQuaternion, Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::{InitConfig, InitMode, Odometry, OdometryConfig, StepReport};
use crate::filter::FilterKind;
use crate::inertial::block;
use crate::sensor::{
    Camera, ColorImage, DepthImage, ImuSample, PixelFormat, RgbdFrame, Stamp, TruthPose,
};
use crate::tracking::FrontEndFrame;
use crate::vision::{Extraction, TrackedFeature};

const IMU_RATE: f64 = 200.0;
/// IMU samples between two frames.
const SAMPLES: usize = 7;
const SECONDS: f64 = 6.0;
/// Standard deviation of what a patch is misplaced by in its later views, px.
const PIXEL_SD: f64 = 0.3;

/// The body's way, as a hand would carry it.
fn place(t: f64) -> Vector3<f64> {
    Vector3::new((0.9 * t).sin(), 0.8 * (0.7 * t).sin(), 0.3 * (1.3 * t).sin())
}

fn acceleration(t: f64) -> Vector3<f64> {
    Vector3::new(-0.81 * (0.9 * t).sin(), -0.392 * (0.7 * t).sin(), -0.507 * (1.3 * t).sin())
}

fn attitude(t: f64) -> UnitQuaternion<f64> {
    UnitQuaternion::from_euler_angles(0.2 * (1.1 * t).sin(), 0.25 * (0.8 * t).sin(), 0.4 * t)
}

fn pose(t: f64) -> Isometry3<f64> {
    Isometry3::from_parts(place(t).into(), attitude(t))
}

fn at(t: f64) -> Stamp {
    Stamp::from_seconds(100.0 + t).unwrap()
}

/// A body among points, of which each is followed from when it is first seen until it leaves the
/// image.
struct World {
    /// Of the IMU's noise, and of the pixels': the one does not depend on the other.
    rng: ChaCha8Rng,
    pixel_rng: ChaCha8Rng,
    points: Vec<Point3<f64>>,
    /// Whether a point was in view in the frame before, and the id of its track.
    followed: Vec<Option<u64>>,
    next_id: u64,
    body_from_camera: Isometry3<f64>,
    camera: Camera,
}

impl World {
    fn new(seed: u64, config: &OdometryConfig) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let points: Vec<_> = (0..600)
            .map(|_| {
                let direction =
                    Vector3::from_fn(|_, _| StandardNormal.sample(&mut rng)).normalize();
                Point3::from(direction * rng.random_range(5.0..15.0))
            })
            .collect();
        Self {
            rng,
            pixel_rng: ChaCha8Rng::seed_from_u64(seed + 1000),
            followed: vec![None; points.len()],
            points,
            next_id: 0,
            body_from_camera: config.camera.imu_from_camera().unwrap(),
            camera: Camera::new(&config.camera).unwrap(),
        }
    }

    fn normal(&mut self, sd: f64) -> Vector3<f64> {
        Vector3::from_fn(|_, _| StandardNormal.sample(&mut self.rng)) * sd
    }

    fn sample(&mut self, t: f64, config: &OdometryConfig) -> ImuSample {
        let turned = attitude(t - 1e-4).inverse() * attitude(t + 1e-4);
        let force = attitude(t).inverse() * (acceleration(t) + Vector3::z() * config.imu.gravity);
        let sd = IMU_RATE.sqrt();
        ImuSample {
            stamp: at(t),
            angular_velocity: turned.scaled_axis() / 2e-4 + self.normal(config.imu.gyro_noise * sd),
            specific_force: force + self.normal(config.imu.accel_noise * sd),
        }
    }

    fn tracks(&mut self, t: f64) -> Vec<TrackedFeature> {
        let camera_from_world = (pose(t) * self.body_from_camera).inverse();
        let mut tracks = Vec::new();
        for k in 0..self.points.len() {
            let seen = camera_from_world * self.points[k];
            let pixel = self.camera.project(&seen.coords).filter(|pixel| {
                seen.z > 0.5 && (0.0..640.0).contains(&pixel.x) && (0.0..480.0).contains(&pixel.y)
            });
            let Some(pixel) = pixel else {
                self.followed[k] = None;
                continue;
            };
            let sd = if self.followed[k].is_some() { PIXEL_SD } else { 0.0 };
            let id = *self.followed[k].get_or_insert_with(|| {
                self.next_id += 1;
                self.next_id
            });
            let error = Vector2::from_fn(|_, _| StandardNormal.sample(&mut self.pixel_rng)) * sd;
            tracks.push(TrackedFeature {
                id,
                camera: 0,
                pixel: pixel + error,
                pixel_covariance: Matrix2::from_diagonal_element(sd * sd),
                depth: None,
                descriptor: None,
            });
        }
        tracks.sort_by_key(|track| track.id);
        tracks
    }

    fn frame(&mut self, t: f64, follows: bool) -> FrontEndFrame {
        let tracks = if follows { self.tracks(t) } else { Vec::new() };
        let color = ColorImage::new(640, 480, PixelFormat::Mono8, vec![0; 640 * 480]).unwrap();
        let depth = DepthImage::new(8, 8, 0.001, vec![0; 64]).unwrap();
        FrontEndFrame {
            frame: Box::new(RgbdFrame { stamp: at(t), color, depth, others: Vec::new() }),
            extraction: Extraction { tracks, ..Extraction::default() },
            seconds: 0.0,
        }
    }
}

fn config() -> OdometryConfig {
    let init = InitConfig { mode: InitMode::Truth, ..InitConfig::default() };
    OdometryConfig { init, ..OdometryConfig::default() }
}

/// The reports of a run.
fn run(kind: FilterKind, seed: u64, config: &OdometryConfig, follows: bool) -> Vec<StepReport> {
    let mut world = World::new(seed, config);
    let mut odometry = Odometry::new(config, kind, 1, true).unwrap();
    let mut reports = Vec::new();
    for k in 0..(SECONDS * IMU_RATE) as usize {
        let t = k as f64 / IMU_RATE;
        odometry.push_truth(TruthPose { stamp: at(t), world_from_body: pose(t) });
        odometry.push_imu(world.sample(t, config));
        if k % SAMPLES == 0 {
            odometry.push_frame(world.frame(t, follows));
        }
        reports.extend(std::iter::from_fn(|| odometry.step()).map(|(report, _)| report));
    }
    reports
}

/// Position error (m) and the normalised squared error of the position at the end.
fn judged(reports: &[StepReport]) -> (f64, f64) {
    let last = reports.last().unwrap();
    let t = last.stamp.seconds_since(at(0.0));
    let error = last.state.world_from_body.translation.vector - place(t);
    let covariance = last.covariance.fixed_view::<3, 3>(block::POSITION, block::POSITION);
    let whitened = covariance.into_owned().cholesky().unwrap().solve(&error);
    (error.norm(), error.dot(&whitened))
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

#[test]
fn points_without_depth_hold_the_position() {
    for kind in [FilterKind::Mfgs, FilterKind::Iekfs, FilterKind::Mekfs] {
        let config = config();
        let of = |follows: bool| -> Vec<(f64, f64)> {
            (1..=5).map(|seed| judged(&run(kind, seed, &config, follows))).collect()
        };
        let (with, without) = (of(true), of(false));
        let error = |runs: &[(f64, f64)]| median(runs.iter().map(|run| run.0).collect());
        assert!(error(&with) < 0.5 * error(&without), "{kind}: {with:?} {without:?}");
        let nees = with.iter().map(|run| run.1).sum::<f64>() / with.len() as f64;
        assert!((0.3..9.0).contains(&nees), "{kind}: {with:?}");
    }
}

/// A run without tracks does not depend on how they would be used.
#[test]
fn without_tracks_nothing_changes() {
    let off = {
        let mut config = config();
        config.filter.track_poses = 0;
        config
    };
    let reports = |config: &OdometryConfig, follows: bool| {
        run(FilterKind::Mfgs, 1, config, follows).into_iter().map(|r| (r.state, r.covariance))
    };
    assert!(reports(&config(), false).eq(reports(&off, true)));
}
