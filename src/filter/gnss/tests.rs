use nalgebra::{Isometry3, Matrix3, Rotation3, SVector, Translation3, UnitQuaternion, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::belief::{Euclidean, EuclideanCovariance, NavigationBelief, Slope};
use super::*;
use crate::distribution::matrix_fisher::MatrixFisher;
use crate::filter::{AttitudeMeasurement, InertialStep, VectorMeasurement};
use crate::so3::{ProperSvd, exp};

pub(super) fn imu() -> ImuConfig {
    ImuConfig {
        gyro_noise: 0.3,
        accel_noise: 0.5,
        gyro_bias_walk: 0.1,
        accel_bias_walk: 0.2,
        gravity: 9.8,
        ..ImuConfig::default()
    }
}

/// A belief with an attitude known to a radian or so, all of whose other parts depend on it.
pub(super) fn diffuse_belief() -> NavigationBelief {
    let svd = ProperSvd {
        u: exp(&Vector3::new(0.4, -1.0, 0.3)),
        s: Vector3::new(5.0, 3.0, -0.5),
        v: exp(&Vector3::new(-0.7, 0.2, 1.4)),
    };
    let mut mean = Euclidean::zeros();
    mean.iter_mut().zip(1..).for_each(|(m, i)| *m = 0.3 * f64::from(i % 5) - 0.5);
    let root = EuclideanCovariance::from_fn(|i, j| {
        if i == j { 0.3 } else { 0.05 * ((i * 7 + j * 3) as f64).sin() }
    });
    NavigationBelief {
        attitude: MatrixFisher::from_svd(svd).unwrap(),
        mean,
        slope: Slope::from_fn(|i, j| 0.4 * ((3 * i + 5 * j) as f64).cos()),
        conditional: root * root.transpose(),
    }
}

pub(super) fn sampled(
    belief: &NavigationBelief,
    count: usize,
    rng: &mut ChaCha8Rng,
) -> Vec<(Rotation3<f64>, Euclidean)> {
    let sampler = belief.attitude.sampler();
    let root = belief.conditional.cholesky().unwrap().l();
    let (mean, _) = super::central::mean_and_covariance(belief.attitude.moments());
    let mut sample = || {
        let r = sampler.sample(rng);
        let q =
            SVector::<f64, 9>::from_column_slice(belief.attitude.centred(&r).matrix().as_slice());
        let normal = Euclidean::from_fn(|_, _| StandardNormal.sample(rng));
        (r, belief.mean + belief.slope * (q - mean) + root * normal)
    };
    (0..count).map(|_| sample()).collect()
}

fn initial() -> InitialBelief {
    let rotation = UnitQuaternion::from_euler_angles(0.3, -0.2, 1.1);
    InitialBelief {
        state: NavState {
            world_from_body: Isometry3::from_parts(Translation3::new(1.0, -2.0, 0.5), rotation),
            velocity: Vector3::new(2.0, -1.0, 0.3),
            gyro_bias: Vector3::new(0.01, -0.02, 0.03),
            accel_bias: Vector3::new(-0.1, 0.05, 0.2),
        },
        tilt_sd: 2e-3,
        heading_sd: Some(4e-3),
        velocity_sd: 0.05,
        position_sd: 0.3,
        gyro_bias_sd: 1e-3,
        accel_bias_sd: 0.02,
    }
}

fn quiet_imu() -> ImuConfig {
    ImuConfig { gyro_noise: 1e-4, accel_noise: 1e-2, gravity: 9.8, ..ImuConfig::default() }
}

fn step() -> InertialStep {
    InertialStep {
        seconds: 0.01,
        angular_velocity: Vector3::new(0.2, -0.1, 0.4),
        specific_force: Some(Vector3::new(0.5, -0.3, 9.9)),
        angle_covariance: Matrix3::zeros(),
    }
}

fn all(imu: &ImuConfig, initial: &InitialBelief) -> Vec<Box<dyn GnssFilter>> {
    let start = |kind: GnssFilterKind| kind.start(imu, AttitudeUpdate::Flow, initial).unwrap();
    GnssFilterKind::ALL.into_iter().map(start).collect()
}

/// Differences of two beliefs in standard deviations, and of their covariances.
fn assert_same(a: &Belief, b: &Belief, tolerance: f64) {
    let turn = a.state.world_from_body.rotation.inverse() * b.state.world_from_body.rotation;
    let position = |s: &NavState| s.world_from_body.translation.vector;
    let parts = [
        (block::ROTATION, turn.scaled_axis()),
        (block::VELOCITY, b.state.velocity - a.state.velocity),
        (block::POSITION, position(&b.state) - position(&a.state)),
        (block::GYRO_BIAS, b.state.gyro_bias - a.state.gyro_bias),
        (block::ACCEL_BIAS, b.state.accel_bias - a.state.accel_bias),
    ];
    for (start, difference) in parts {
        for k in 0..3 {
            let sd = a.covariance[(start + k, start + k)].sqrt();
            assert!(difference[k].abs() < tolerance * sd, "{start}: {difference} sd {sd}");
        }
    }
    for i in 0..15 {
        for j in 0..15 {
            let scale = (a.covariance[(i, i)] * a.covariance[(j, j)]).sqrt();
            let difference = (a.covariance[(i, j)] - b.covariance[(i, j)]) / scale;
            assert!(difference.abs() < tolerance, "({i}, {j}): {difference}");
        }
    }
}

/// Where the attitude is concentrated, all filters are the same filter.
#[test]
fn concentrated_filters_agree() {
    let (imu, initial) = (quiet_imu(), initial());
    let mut filters = all(&imu, &initial);
    let arm = Vector3::new(0.4, -0.2, 0.9);
    for filter in &mut filters {
        for k in 0..300 {
            filter.propagate(&step()).unwrap();
            if k % 50 == 49 {
                let at = filter.state().world_from_body;
                let shift = Vector3::new(0.1, -0.05, 0.08);
                let fix = PositionMeasurement {
                    in_world: at.translation.vector + at.rotation * arm + shift,
                    covariance: Matrix3::identity() * 0.04,
                    lever_arm: arm,
                };
                filter.update_position(&fix).unwrap();
            }
        }
        let up = VectorMeasurement::of_world_direction(
            Vector3::z(),
            filter.attitude().inverse() * exp(&Vector3::new(1e-3, -2e-3, 0.0)) * Vector3::z(),
            1e5,
        );
        filter.update_directions(&[up]).unwrap();
        let seen = filter.attitude() * exp(&Vector3::new(1e-3, 2e-3, -1e-3));
        let covariance = Matrix3::identity() * 1e-5;
        let attitude = AttitudeMeasurement::from_covariance(seen, &covariance).unwrap();
        filter.update_attitude(&attitude).unwrap();
    }
    let [mfgi, mfgb, mekf] = &filters[..] else { panic!("three filters") };
    assert_same(&mekf.belief(), &mfgi.belief(), 0.02);
    assert_same(&mekf.belief(), &mfgb.belief(), 0.02);
}

#[test]
fn innovations_agree_with_the_update() {
    let mut initial = initial();
    initial.heading_sd = None;
    let arm = Vector3::new(1.0, 0.5, 0.0);
    let filters = all(&quiet_imu(), &initial);
    let fix = PositionMeasurement {
        in_world: Vector3::new(1.5, -2.5, 1.0),
        covariance: Matrix3::identity() * 0.04,
        lever_arm: arm,
    };
    // Unknown heading: the arm is anywhere on a circle, which the Gaussian filter cannot say.
    let [mfgi, mfgb, mekf] = &filters[..] else { panic!("three filters") };
    let [mfgi, mfgb, mekf] = [mfgi, mfgb, mekf].map(|f| f.innovation(&fix).unwrap());
    assert!((mfgi.nis - mfgb.nis).abs() < 1e-9);
    let spread = mfgi.covariance[(0, 0)] - 0.09 - 0.04;
    assert!((spread - 0.5 * arm.norm_squared()).abs() < 0.15, "{spread}");
    assert!(mekf.covariance[(0, 0)] > 100.0);
}

#[test]
fn what_has_no_meaning_is_refused_and_changes_nothing() {
    let bad_step = |change: fn(&mut InertialStep)| {
        let mut bad = step();
        change(&mut bad);
        bad
    };
    let bad = [
        bad_step(|s| s.seconds = 0.0),
        bad_step(|s| s.seconds = f64::NAN),
        bad_step(|s| s.angular_velocity.x = f64::INFINITY),
        bad_step(|s| s.specific_force = Some(Vector3::repeat(f64::NAN))),
        bad_step(|s| s.specific_force = None),
        bad_step(|s| s.specific_force = Some(Vector3::repeat(1e300))),
    ];
    for mut filter in all(&quiet_imu(), &initial()) {
        let before = filter.belief();
        for step in &bad {
            assert!(filter.propagate(step).is_err(), "{}: {step:?}", filter.name());
        }
        let fix = PositionMeasurement {
            in_world: Vector3::repeat(f64::NAN),
            covariance: Matrix3::identity(),
            lever_arm: Vector3::zeros(),
        };
        assert!(filter.update_position(&fix).is_err());
        let flat = PositionMeasurement {
            in_world: Vector3::zeros(),
            covariance: Matrix3::identity() * -1e6,
            lever_arm: Vector3::zeros(),
        };
        assert!(filter.update_position(&flat).is_err());
        assert_eq!(filter.belief(), before, "{}", filter.name());
    }
}

#[test]
fn outages_repeat() {
    let once = OutageConfig { start: 60.0, length: 30.0, period: 0.0 };
    assert_eq!(once.index_at(59.9), None);
    assert_eq!(once.index_at(60.0), Some(0));
    assert_eq!(once.index_at(90.0), None);
    assert_eq!(once.index_at(160.0), None);
    let again = OutageConfig { period: 100.0, ..once };
    assert_eq!(again.index_at(175.0), Some(1));
    assert_eq!(again.index_at(195.0), None);
    assert_eq!(OutageConfig::default().index_at(0.0), None);
}
