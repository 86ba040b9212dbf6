use nalgebra::Vector3;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::config::ImuSensorConfig;
use super::imperfections::{ImperfectionConfig, Imperfections};
use super::motion::BodyState;
use crate::sensor::{ImuSample, Stamp};

/// Adds biases, noise and imperfections to the true motion, sample by sample.
#[derive(Debug, Clone)]
pub struct ImuSimulator {
    config: ImuSensorConfig,
    imperfections: Imperfections,
    /// Of the first reading.
    start: Option<Stamp>,
    rng: ChaCha8Rng,
    /// rad/s.
    gyro_bias: Vector3<f64>,
    /// m/s^2.
    accel_bias: Vector3<f64>,
    last: Option<Stamp>,
}

impl ImuSimulator {
    /// An IMU without imperfections.
    pub fn new(config: ImuSensorConfig, seed: u64) -> Self {
        Self::imperfect(config, Imperfections::draw(ImperfectionConfig::default(), seed), seed)
    }

    pub fn imperfect(config: ImuSensorConfig, imperfections: Imperfections, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let gyro_bias = normal(&mut rng) * config.gyro_bias_sd;
        let accel_bias = normal(&mut rng) * config.accel_bias_sd;
        Self { config, imperfections, start: None, rng, gyro_bias, accel_bias, last: None }
    }

    /// Biases of the latest sample: gyroscope (rad/s) and accelerometer (m/s^2).
    pub fn biases(&self) -> (Vector3<f64>, Vector3<f64>) {
        (self.gyro_bias, self.accel_bias)
    }

    /// The reading at `stamp` in the state `state`; the biases walk over the time since the
    /// previous reading.
    pub fn sample(&mut self, stamp: Stamp, state: &BodyState) -> ImuSample {
        let config = &self.config;
        let elapsed = self.last.map_or(0.0, |last| stamp.seconds_since(last).max(0.0));
        self.gyro_bias += normal(&mut self.rng) * (config.gyro_bias_walk * elapsed.sqrt());
        self.accel_bias += normal(&mut self.rng) * (config.accel_bias_walk * elapsed.sqrt());
        self.last = Some(stamp);
        let per_sample = config.rate.sqrt();
        let gyro_noise = normal(&mut self.rng) * (config.gyro_noise * per_sample);
        let accel_noise = normal(&mut self.rng) * (config.accel_noise * per_sample);
        let start = *self.start.get_or_insert(stamp);
        let mut sample = self.imperfections.felt(
            stamp.seconds_since(start),
            ImuSample {
                stamp,
                angular_velocity: state.angular_velocity,
                specific_force: state.specific_force(config.gravity),
            },
        );
        sample.angular_velocity =
            sample.angular_velocity * (1.0 + config.gyro_scale_error) + self.gyro_bias + gyro_noise;
        sample.specific_force = sample.specific_force * (1.0 + config.accel_scale_error)
            + self.accel_bias
            + accel_noise;
        self.imperfections.quantised(sample)
    }
}

fn normal(rng: &mut ChaCha8Rng) -> Vector3<f64> {
    Vector3::from_fn(|_, _| StandardNormal.sample(rng))
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, UnitQuaternion};

    use super::super::motion::{Motion, MotionConfig, MotionKind};
    use super::super::trajectory::{Carrier, TrajectoryConfig};
    use super::*;

    fn perfect() -> ImuSensorConfig {
        ImuSensorConfig {
            rate: 1000.0,
            gyro_noise: 0.0,
            accel_noise: 0.0,
            gyro_bias_walk: 0.0,
            accel_bias_walk: 0.0,
            gyro_bias_sd: 0.0,
            accel_bias_sd: 0.0,
            ..ImuSensorConfig::default()
        }
    }

    /// Integrates ten seconds of perfect readings by the trapezoidal rule; returns the errors of
    /// position (m) and attitude (rad) at the end.
    fn drift(motion: &Motion) -> (f64, f64) {
        let config = perfect();
        let mut imu = ImuSimulator::new(config.clone(), 1);
        let gravity = Vector3::new(0.0, 0.0, -config.gravity);
        let h = 1.0 / config.rate;
        let first = motion.state(0.0);
        let (mut rotation, mut velocity) = (first.world_from_body.rotation, first.velocity);
        let mut position = first.world_from_body.translation.vector;
        let mut last = imu.sample(Stamp::default(), &first);
        for k in 1..=10_000 {
            let t = f64::from(k) * h;
            let now = imu.sample(Stamp::default().offset_by(t), &motion.state(t));
            let turn = (last.angular_velocity + now.angular_velocity) * (0.5 * h)
                + last.angular_velocity.cross(&now.angular_velocity) * (h * h / 12.0);
            let turned = rotation * UnitQuaternion::from_scaled_axis(turn);
            let before = rotation * last.specific_force + gravity;
            let after = turned * now.specific_force + gravity;
            position += velocity * h + (before * 2.0 + after) * (h * h / 6.0);
            velocity += (before + after) * (0.5 * h);
            (rotation, last) = (turned, now);
        }
        let truth = motion.state(10.0).world_from_body;
        let offset = (position - truth.translation.vector).norm();
        (offset, rotation.angle_to(&truth.rotation))
    }

    fn mount() -> Isometry3<f64> {
        Isometry3::new(Vector3::new(0.05, -0.02, 0.1), Vector3::new(0.3, 1.2, -0.4))
    }

    #[test]
    fn perfect_readings_integrate_to_the_truth() {
        for kind in
            [MotionKind::LabSimple, MotionKind::LabMotion, MotionKind::LabBumper, MotionKind::Hall]
        {
            let config = MotionConfig { kind, ..MotionConfig::default() };
            let (offset, angle) = drift(&Motion::built_in(&config, &mount(), 3));
            assert!(offset < 1e-3 && angle.to_degrees() < 0.01, "{kind:?} {offset} {angle}");
        }
    }

    #[test]
    fn perfect_readings_along_a_recording_integrate_to_its_curve() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("recorded.tum");
        let source = Motion::built_in(&MotionConfig::default(), &mount(), 9);
        let line = |k: u32| {
            let t = f64::from(k) / 100.0;
            let pose = source.state(t).world_from_body;
            let (p, q) = (pose.translation.vector, pose.rotation.coords);
            format!("{t:.4} {} {} {} {} {} {} {}\n", p.x, p.y, p.z, q.x, q.y, q.z, q.w)
        };
        std::fs::write(&file, (0..1300).map(line).collect::<String>()).unwrap();
        let up = [0.0, 0.0, 1.0];
        let trajectory =
            TrajectoryConfig { file, of: Carrier::Imu, up, ..TrajectoryConfig::default() };
        let motion = Motion::recorded(&MotionConfig::default(), &trajectory, &mount()).unwrap();
        assert!(motion.duration().unwrap() > 12.0);
        let (offset, angle) = drift(&motion);
        assert!(offset < 1e-3 && angle.to_degrees() < 0.01, "{offset} {angle}");
    }

    #[test]
    fn noise_and_walks_have_the_stated_densities() {
        let config = ImuSensorConfig {
            rate: 100.0,
            gyro_noise: 1e-2,
            accel_noise: 0.0,
            gyro_bias_walk: 0.0,
            accel_bias_walk: 0.1,
            gyro_bias_sd: 0.0,
            accel_bias_sd: 0.0,
            ..ImuSensorConfig::default()
        };
        let still = Motion::built_in(
            &MotionConfig { standstill: 1e6, ..MotionConfig::default() },
            &Isometry3::identity(),
            1,
        );
        let mut imu = ImuSimulator::new(config, 5);
        let state = still.state(0.0);
        let (mut noise, mut steps, mut last) = (0.0, 0.0, Vector3::zeros());
        for k in 0..20_000_u32 {
            let stamp = Stamp::default().offset_by(f64::from(k) / 100.0);
            noise += imu.sample(stamp, &state).angular_velocity.norm_squared();
            let (_, bias) = imu.biases();
            steps += (bias - last).norm_squared();
            last = bias;
        }
        // Variance per axis: density^2 times the rate; walk^2 times the interval.
        let (noise, steps) = (noise / 60_000.0, steps / 60_000.0);
        assert!((noise / 1e-2 - 1.0).abs() < 0.03, "{noise}");
        assert!((steps / 1e-4 - 1.0).abs() < 0.03, "{steps}");
    }
}
