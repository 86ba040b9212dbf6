//! The scene of W22 5.2.2 and 5.2.4: a vehicle on a circle among point landmarks, whose positions
//! a stereo or RGB-D camera measures in the body frame. No images, no wrong matches.

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::config::ImuSensorConfig;
use super::inertial::ImuSimulator;
use super::motion::{BodyState, Motion, MotionConfig, MotionKind};
use crate::sensor::{ImuSample, Stamp};

/// Half the side of the square around the circle that landmarks lie in, m. The paper says "in a
/// rectangular shape" without its size.
const HALF_SIDE: f64 = 4.5;
/// Lowest and highest landmark, m; the vehicle moves between 0 and 1.
const HEIGHTS: (f64, f64) = (-0.5, 1.5);

/// What a [`LandmarkScene`] is drawn from.
#[derive(Debug, Clone, PartialEq)]
pub struct LandmarkSceneConfig {
    pub landmarks: usize,
    /// Standard deviation of each coordinate of a measured landmark, m.
    pub measurement_sd: f64,
    /// Landmarks within this distance of the body are measured, m.
    pub range: f64,
    /// IMU samples from one frame to the next.
    pub samples_per_frame: usize,
    /// s.
    pub duration: f64,
    pub imu: ImuSensorConfig,
}

impl LandmarkSceneConfig {
    /// W22 5.2.2: 0.1 deg/sqrt(s) and 0.1 m/s/sqrt(s) of white noise and no biases at 200 Hz,
    /// frames at 10 Hz, a range of 3 m, 40 s.
    pub fn paper(landmarks: usize, measurement_sd: f64) -> Self {
        Self {
            landmarks,
            measurement_sd,
            range: 3.0,
            samples_per_frame: 20,
            duration: 40.0,
            imu: ImuSensorConfig {
                rate: 200.0,
                gyro_noise: 0.1f64.to_radians(),
                accel_noise: 0.1,
                gyro_bias_walk: 0.0,
                accel_bias_walk: 0.0,
                gyro_bias_sd: 0.0,
                accel_bias_sd: 0.0,
                ..ImuSensorConfig::default()
            },
        }
    }
}

/// A landmark as seen from the body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LandmarkSighting {
    /// Index into [`LandmarkScene::landmarks`].
    pub landmark: usize,
    /// Measured position in body coordinates, m.
    pub in_body: Vector3<f64>,
}

/// The landmarks measured at one instant, in ascending order of their index.
#[derive(Debug, Clone, PartialEq)]
pub struct LandmarkFrame {
    /// Index of the IMU sample of the same instant.
    pub sample: usize,
    pub sightings: Vec<LandmarkSighting>,
}

/// Truth and measurements of one drive.
#[derive(Debug, Clone, PartialEq)]
pub struct LandmarkScene {
    /// World coordinates, m.
    pub landmarks: Vec<Vector3<f64>>,
    /// Standard deviation of each coordinate of a sighting, m.
    pub measurement_sd: f64,
    /// The state at each IMU sample.
    pub truth: Vec<BodyState>,
    pub imu: Vec<ImuSample>,
    /// The first is one frame interval after the first IMU sample.
    pub frames: Vec<LandmarkFrame>,
}

impl LandmarkScene {
    /// Landmarks, IMU noise and measurement noise are drawn anew; the motion is always the same.
    pub fn draw(config: &LandmarkSceneConfig, rng: &mut ChaCha8Rng) -> Self {
        let motion = MotionConfig {
            kind: MotionKind::Circle,
            standstill: 0.0,
            ramp: 0.0,
            ..MotionConfig::default()
        };
        let motion = Motion::built_in(&motion, &body_from_camera(), 0);
        let landmarks: Vec<_> = (0..config.landmarks).map(|_| landmark(rng)).collect();
        let mut simulator = ImuSimulator::new(config.imu.clone(), rng.random());
        let samples = (config.duration * config.imu.rate).round() as usize;
        let (mut truth, mut imu, mut frames) = (Vec::new(), Vec::new(), Vec::new());
        for sample in 0..=samples {
            let t = sample as f64 / config.imu.rate;
            let state = motion.state(t);
            imu.push(simulator.sample(Stamp::default().offset_by(t), &state));
            truth.push(state);
            if sample > 0 && sample.is_multiple_of(config.samples_per_frame) {
                let sightings = sightings(config, &landmarks, &state.world_from_body, rng);
                frames.push(LandmarkFrame { sample, sightings });
            }
        }
        Self { landmarks, measurement_sd: config.measurement_sd, truth, imu, frames }
    }

    /// Covariance of a sighting in body coordinates, m^2.
    pub fn measurement_covariance(&self) -> Matrix3<f64> {
        Matrix3::identity() * self.measurement_sd.powi(2)
    }
}

fn landmark(rng: &mut ChaCha8Rng) -> Vector3<f64> {
    Vector3::new(
        rng.random_range(-HALF_SIDE..HALF_SIDE),
        rng.random_range(-HALF_SIDE..HALF_SIDE),
        rng.random_range(HEIGHTS.0..HEIGHTS.1),
    )
}

fn sightings(
    config: &LandmarkSceneConfig,
    landmarks: &[Vector3<f64>],
    world_from_body: &Isometry3<f64>,
    rng: &mut ChaCha8Rng,
) -> Vec<LandmarkSighting> {
    let mut seen = Vec::new();
    for (landmark, position) in landmarks.iter().enumerate() {
        let exact = world_from_body.inverse_transform_point(&(*position).into()).coords;
        if exact.norm() <= config.range {
            let noise = Vector3::from_fn(|_, _| StandardNormal.sample(rng));
            seen.push(LandmarkSighting {
                landmark,
                in_body: exact + noise * config.measurement_sd,
            });
        }
    }
    seen
}

/// The first body axis points ahead, the second to the centre of the circle, the third up.
fn body_from_camera() -> Isometry3<f64> {
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[
        -Vector3::y(),
        -Vector3::z(),
        Vector3::x(),
    ]));
    Isometry3::from_parts(Translation3::identity(), UnitQuaternion::from_rotation_matrix(&rotation))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    #[test]
    fn the_scene_is_that_of_the_paper() {
        let config = LandmarkSceneConfig { duration: 4.0, ..LandmarkSceneConfig::paper(400, 0.05) };
        let scene = LandmarkScene::draw(&config, &mut ChaCha8Rng::seed_from_u64(1));
        assert_eq!((scene.imu.len(), scene.truth.len(), scene.frames.len()), (801, 801, 40));
        assert_eq!(scene.frames[0].sample, 20);
        let [first, second] = [0, 1].map(|sample| scene.truth[sample].velocity);
        assert!((second - first).norm() < 0.01 * first.norm(), "the drive starts in motion");
        let (mut squares, mut count) = (0.0, 0.0);
        for frame in &scene.frames {
            let pose = scene.truth[frame.sample].world_from_body;
            let ahead = pose.rotation * Vector3::x();
            let velocity = scene.truth[frame.sample].velocity;
            assert!(ahead.dot(&velocity) > 0.99 * velocity.norm());
            assert!((pose.rotation * Vector3::y()).z.abs() < 1e-12);
            assert!((pose.rotation * Vector3::y()).dot(&pose.translation.vector) < 0.0);
            for sighting in &frame.sightings {
                let seen = pose * nalgebra::Point3::from(sighting.in_body);
                squares += (seen.coords - scene.landmarks[sighting.landmark]).norm_squared();
                count += 3.0;
            }
        }
        assert!(count > 3.0 * 40.0 * 50.0, "{count}");
        assert!((f64::sqrt(squares / count) / 0.05 - 1.0).abs() < 0.05);
    }
}
