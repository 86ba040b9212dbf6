//! W22 tables 4.2, 4.6 and 4.7.

use std::f64::consts::PI;

use nalgebra::{Matrix3, Rotation3, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_distr::Distribution;

use super::super::{PaperValue, Report, Request, Study, StudyError, Trial, monte_carlo};
use super::scene::{GyroNoise, Measured, Motion, normal, simulate, tumbling};
use super::{AnyError, Case, Quantities};
use crate::distribution::VonMisesFisher;
use crate::distribution::matrix_fisher::MatrixFisher;
use crate::filter::attitude::{AttitudeFilterKind, AttitudePrior, GyroModel};
use crate::filter::{AttitudeMeasurement, Frame, VectorMeasurement};
use crate::so3::exp;

pub(super) const STUDIES: &[Study] = &[
    Study {
        name: "wang-4.2",
        title: "W22 table 4.2: observability with a single direction",
        runs: 100,
        run: table_4_2,
    },
    Study {
        name: "wang-4.6",
        title: "W22 table 4.6: attitude and gyro bias from measured attitudes",
        runs: 60,
        run: table_4_6,
    },
    Study {
        name: "wang-4.7",
        title: "W22 table 4.7: two directions, the second of falling accuracy",
        runs: 100,
        run: table_4_7,
    },
];

/// Gyroscope interval, s.
const INTERVAL: f64 = 1.0 / 150.0;
/// Gyroscope intervals between two measurements.
const EVERY: usize = 5;
/// Gyroscope white noise, rad/sqrt(s).
const GYRO_NOISE: f64 = PI / 18.0;
/// Gyroscope bias walk, 500 deg/h/sqrt(s), in rad/s/sqrt(s).
const BIAS_WALK: f64 = 500.0 / 3600.0 * PI / 180.0;

fn value(
    case: &'static str,
    filter: &'static str,
    quantity: &'static str,
    mean: f64,
) -> PaperValue {
    PaperValue { case, filter, quantity, mean }
}

/// The body turns about its third axis at 6 rad/s, and with it about the second axis of the world
/// at 1 rad/s.
fn coning(count: usize) -> Motion {
    Motion::of(INTERVAL, count, |t| {
        exp(&Vector3::new(0.0, t, 0.0)) * exp(&Vector3::new(0.0, 0.0, 6.0 * t))
    })
}

fn table_4_2(request: &Request) -> Result<Report, StudyError> {
    use Frame::{Body, World};
    const CONCENTRATION: f64 = 200.0;
    const KNOWN: Vector3<f64> = Vector3::new(1.0, 0.0, 0.0);
    const FIXED: &[Vector3<f64>] = &[KNOWN];
    const CASES: [(&str, Frame, Frame); 4] = [
        ("AVI_RVI", World, World),
        ("AVI_RVB", World, Body),
        ("AVB_RVI", Body, World),
        ("AVB_RVB", Body, Body),
    ];
    let paper = [
        value("AVI_RVI", "bf-mfd", "attitude_deg", 6.57),
        value("AVI_RVI", "mekf", "attitude_deg", 7.02),
        value("AVI_RVB", "bf-mfd", "attitude_deg", 90.0),
        value("AVI_RVB", "bf-mfd", "partial_attitude_deg", 3.33),
        value("AVI_RVB", "mekf", "attitude_deg", 135.0),
        value("AVI_RVB", "mekf", "partial_attitude_deg", 3.33),
        value("AVB_RVI", "bf-mfd", "attitude_deg", 90.0),
        value("AVB_RVI", "bf-mfd", "partial_attitude_deg", 3.34),
        value("AVB_RVI", "mekf", "attitude_deg", 89.0),
        value("AVB_RVI", "mekf", "partial_attitude_deg", 3.33),
        value("AVB_RVB", "bf-mfd", "attitude_deg", 5.71),
        value("AVB_RVB", "mekf", "attitude_deg", 6.06),
    ];
    let motion = coning(9000);
    let trial = |rng: &mut ChaCha8Rng| -> Result<Trial, AnyError> {
        let mut trial = Trial::default();
        for (case, rate, reference) in CASES {
            let noise = GyroNoise {
                white: Vector3::repeat(GYRO_NOISE),
                bias_walk: 0.0,
                initial_bias: Vector3::zeros(),
            };
            let mut failure = None;
            let mut scene = simulate(&motion, &noise, EVERY, rng, |_, truth, rng| {
                let seen = match reference {
                    World => truth.inverse() * KNOWN,
                    Body => truth * KNOWN,
                };
                let noisy = VonMisesFisher::new(seen, CONCENTRATION).map(|d| d.sample(rng));
                let noisy = noisy.unwrap_or_else(|error| {
                    failure = Some(error);
                    seen
                });
                Measured::directions(vec![match reference {
                    World => VectorMeasurement::of_world_direction(KNOWN, noisy, CONCENTRATION),
                    Body => VectorMeasurement::of_body_direction(KNOWN, noisy, CONCENTRATION),
                }])
            });
            if let Some(error) = failure {
                return Err(error.into());
            }
            if rate == World {
                for (step, start) in scene.steps.iter_mut().zip(&motion.attitudes) {
                    step.angular_velocity = start * step.angular_velocity;
                }
            }
            let gyro = GyroModel { frame: rate, ..GyroModel::isotropic(GYRO_NOISE, 0.0) };
            let prior = AttitudePrior::matrix_fisher(&Matrix3::zeros())?;
            let quantities = Quantities {
                partial: (rate != reference).then_some((reference, FIXED)),
                ..Quantities::default()
            };
            let mut column = Case { label: case, gyro, prior, scene: &scene, quantities };
            column.run(&mut trial, &[AttitudeFilterKind::BfMfd])?;
            // Half a turn about the reference, and next to no confidence.
            column.prior.attitude =
                MatrixFisher::new(&(1e-9 * exp(&Vector3::new(PI, 0.0, 0.0)).matrix()))?;
            column.prior.rotation_covariance = Some(Matrix3::from_diagonal_element(1e10));
            column.run_as(&mut trial, AttitudeFilterKind::IekfL, "mekf")?;
        }
        Ok(trial)
    };
    let trials = monte_carlo(request, trial)?;
    let mut report = Report::of("wang-4.2", request.seed, &trials, &paper);
    report.notes.push(
        "Without a bias the MEKF with its error in the body frame is the left-invariant filter."
            .into(),
    );
    Ok(report)
}

/// The Gaussian variance of each rotation vector component that `M(s I)` has, and reversely `s`.
fn matched_variance(s: f64) -> Result<f64, AnyError> {
    let fisher = MatrixFisher::new(&Matrix3::from_diagonal_element(s))?;
    Ok(fisher.rotation_covariance()[(0, 0)])
}

fn matched_concentration(sd: f64) -> Result<f64, AnyError> {
    // E[cos |e|] for e ~ N(0, sd^2 I).
    let variance = sd * sd;
    let cosine = (1.0 - variance) * (-0.5 * variance).exp();
    let mean = Matrix3::from_diagonal_element((1.0 + 2.0 * cosine) / 3.0);
    Ok(MatrixFisher::from_mean(&mean)?.svd().s[0])
}

fn table_4_6(request: &Request) -> Result<Report, StudyError> {
    use AttitudeFilterKind::{Mekf, Mfgia, Mfgiu};
    /// Label, and the noise as `M(s I)` or as the deviation of a rotation vector.
    const CASES: [(&str, Option<f64>, Option<f64>); 6] = [
        ("sigma_m=0.5", None, Some(0.5)),
        ("s_m=2.4", Some(2.4), None),
        ("sigma_m=0.2", None, Some(0.2)),
        ("s_m=12", Some(12.0), None),
        ("sigma_m=0.05", None, Some(0.05)),
        ("s_m=200", Some(200.0), None),
    ];
    /// Attitude and bias errors of MFGIA, MFGIU, MEKF.
    const PAPER: [([f64; 3], [f64; 3]); 6] = [
        ([11.94, 11.94, 11.88], [4.6, 4.6, 4.6]),
        ([12.00, 12.00, 12.13], [5.0, 4.9, 5.0]),
        ([7.285, 7.285, 7.284], [3.79, 3.79, 3.79]),
        ([7.449, 7.449, 7.450], [3.89, 3.89, 3.90]),
        ([3.54737, 3.54741, 3.54736], [3.356, 3.357, 3.356]),
        ([3.55406, 3.55414, 3.55409], [3.722, 3.726, 3.733]),
    ];
    const KINDS: [AttitudeFilterKind; 3] = [Mfgia, Mfgiu, Mekf];
    let mut paper = Vec::new();
    for ((case, _, _), (attitude, bias)) in CASES.into_iter().zip(PAPER) {
        for ((kind, attitude), bias) in KINDS.into_iter().zip(attitude).zip(bias) {
            paper.push(value(case, kind.name(), "attitude_deg", attitude));
            paper.push(value(case, kind.name(), "gyro_bias_deg_s", bias));
        }
    }
    let motion = tumbling(INTERVAL, 9000);
    let trial = |rng: &mut ChaCha8Rng| -> Result<Trial, AnyError> {
        let mut trial = Trial::default();
        for (case, s, sd) in CASES {
            let s_matched = match (s, sd) {
                (Some(s), _) => s,
                (None, Some(sd)) => matched_concentration(sd)?,
                (None, None) => 0.0,
            };
            let variance = match (s, sd) {
                (_, Some(sd)) => sd * sd,
                (s, None) => matched_variance(s.unwrap_or_default())?,
            };
            let sampler = MatrixFisher::new(&Matrix3::from_diagonal_element(s_matched))?.sampler();
            let error = |rng: &mut ChaCha8Rng| match sd {
                Some(sd) => exp(&(normal(rng) * sd)),
                None => sampler.sample(rng),
            };
            let noise = Matrix3::from_diagonal_element(s_matched);
            let gaussian = AttitudeMeasurement::from_covariance(
                Rotation3::identity(),
                &Matrix3::from_diagonal_element(variance),
            )?;
            let gyro_noise = GyroNoise {
                white: Vector3::repeat(GYRO_NOISE),
                bias_walk: BIAS_WALK,
                initial_bias: Vector3::zeros(),
            };
            let scene = simulate(&motion, &gyro_noise, EVERY, rng, |_, truth, rng| {
                let world_from_body = truth * error(rng);
                Measured::Attitude {
                    fisher: Box::new(AttitudeMeasurement { world_from_body, noise }),
                    gaussian: Box::new(AttitudeMeasurement { world_from_body, ..gaussian }),
                }
            });
            let start = motion.attitudes[0] * error(rng);
            let prior = AttitudePrior {
                attitude: MatrixFisher::new(&(start.matrix() * s_matched))?,
                rotation_covariance: Some(Matrix3::from_diagonal_element(variance)),
                gyro_bias: normal(rng) * 0.1,
                gyro_bias_covariance: Matrix3::from_diagonal_element(0.01),
            };
            let gyro = GyroModel::isotropic(GYRO_NOISE, BIAS_WALK);
            let quantities = Quantities { bias: true, ..Quantities::default() };
            Case { label: case, gyro, prior, scene: &scene, quantities }.run(&mut trial, &KINDS)?;
        }
        Ok(trial)
    };
    let trials = monte_carlo(request, trial)?;
    Ok(Report::of("wang-4.6", request.seed, &trials, &paper))
}

/// Variance of the second direction's noise and the paper's rows: full attitude, partial attitude
/// and bias errors, for MEKF, UKF, MFGIA, MFGIU, MFGBA, MFGBU.
struct Row47 {
    case: &'static str,
    variance: f64,
    full: Option<[f64; 6]>,
    partial: Option<[f64; 6]>,
    bias: [f64; 6],
}

const TABLE_4_7: [Row47; 8] = [
    Row47 {
        case: "sigma2=0.01",
        variance: 0.01,
        full: Some([5.05, 5.02, 4.82, 4.82, 4.82, 4.82]),
        partial: None,
        bias: [3.6, 2.5, 2.6, 2.6, 2.6, 2.6],
    },
    Row47 {
        case: "sigma2=0.1",
        variance: 0.1,
        full: Some([7.06, 6.95, 6.67, 6.67, 6.67, 6.67]),
        partial: None,
        bias: [4.0, 2.6, 2.8, 2.8, 2.8, 2.8],
    },
    Row47 {
        case: "sigma2=1",
        variance: 1.0,
        full: Some([13.8, 13.3, 10.1, 10.1, 10.1, 10.1]),
        partial: None,
        bias: [4.1, 2.6, 2.9, 2.9, 2.9, 2.9],
    },
    Row47 {
        case: "sigma2=5",
        variance: 5.0,
        full: Some([51.0, 44.4, 14.4, 14.4, 14.4, 14.4]),
        partial: None,
        bias: [5.6, 3.1, 3.0, 3.0, 2.9, 2.9],
    },
    Row47 {
        case: "sigma2=10",
        variance: 10.0,
        full: Some([75.0, 72.2, 17.0, 17.0, 17.0, 17.0]),
        partial: Some([4.19, 4.11, 4.00, 4.00, 4.00, 4.00]),
        bias: [6.7, 3.4, 3.0, 3.0, 3.0, 3.0],
    },
    Row47 {
        case: "sigma2=50",
        variance: 50.0,
        full: Some([85.0, 86.9, 25.6, 25.5, 25.3, 25.4]),
        partial: Some([4.19, 4.11, 4.01, 4.01, 4.00, 4.00]),
        bias: [6.5, 3.5, 3.3, 3.3, 3.1, 3.1],
    },
    Row47 {
        case: "sigma2=200",
        variance: 200.0,
        full: None,
        partial: Some([4.19, 4.11, 4.02, 4.01, 4.00, 4.00]),
        bias: [6.5, 3.5, 5.0, 4.3, 3.4, 3.4],
    },
    Row47 {
        case: "sigma2=inf",
        variance: f64::INFINITY,
        full: None,
        partial: Some([4.24, 4.10, 4.20, 4.16, 3.99, 3.99]),
        bias: [6.5, 3.7, 20.1, 18.7, 3.6, 3.7],
    },
];

const KINDS_4_7: [AttitudeFilterKind; 6] = [
    AttitudeFilterKind::Mekf,
    AttitudeFilterKind::Ukf,
    AttitudeFilterKind::Mfgia,
    AttitudeFilterKind::Mfgiu,
    AttitudeFilterKind::Mfgba,
    AttitudeFilterKind::Mfgbu,
];

fn paper_4_7() -> Vec<PaperValue> {
    let mut paper = Vec::new();
    for row in &TABLE_4_7 {
        for (i, kind) in KINDS_4_7.iter().enumerate() {
            let known = [
                ("attitude_deg", row.full.map(|v| v[i])),
                ("partial_attitude_deg", row.partial.map(|v| v[i])),
                ("gyro_bias_deg_s", Some(row.bias[i])),
            ];
            let known = known.into_iter().filter_map(|(quantity, mean)| Some((quantity, mean?)));
            paper.extend(known.map(|(quantity, m)| value(row.case, kind.name(), quantity, m)));
        }
    }
    paper
}

/// A measured direction of unit length, `in_body` noisy, and both models of its noise.
struct Direction {
    known: Vector3<f64>,
    variance: f64,
    concentration: f64,
}

impl Direction {
    fn new(known: Vector3<f64>, variance: f64) -> Result<Self, AnyError> {
        let matched = VonMisesFisher::from_projected_normal(known, variance)?;
        Ok(Self { known, variance, concentration: matched.concentration() })
    }

    fn measure(
        &self,
        truth: &Rotation3<f64>,
        rng: &mut ChaCha8Rng,
    ) -> (VectorMeasurement, VectorMeasurement) {
        let noisy = truth.inverse() * self.known + normal(rng) * self.variance.sqrt();
        let in_body = noisy.normalize();
        let model = |concentration| {
            VectorMeasurement::of_world_direction(self.known, in_body, concentration)
        };
        (model(self.concentration), model(self.variance.recip()))
    }
}

fn table_4_7(request: &Request) -> Result<Report, StudyError> {
    const STEPS: usize = 45_000;
    const FIRST: Vector3<f64> = Vector3::new(0.0, 1.0, 0.0);
    const FIXED: &[Vector3<f64>] = &[FIRST];
    let motion = tumbling(INTERVAL, STEPS);
    let trial = |rng: &mut ChaCha8Rng| -> Result<Trial, AnyError> {
        let mut trial = Trial::default();
        let start = motion.attitudes[0] * exp(&Vector3::new(PI, 0.0, 0.0));
        let prior = AttitudePrior {
            // The match of a rotation vector of infinite variance: an angle uniform on the
            // circle about a uniform axis, with the mean I/3.
            attitude: MatrixFisher::from_mean(&(start.matrix() / 3.0))?,
            // 1e10 in the paper: the same gains to six digits, but where the heading stays unknown
            // the covariance of the MEKF then loses all of its own.
            rotation_covariance: Some(Matrix3::from_diagonal_element(1e6)),
            gyro_bias: Vector3::repeat(0.2),
            gyro_bias_covariance: Matrix3::from_diagonal_element(0.01),
        };
        let gyro = GyroModel::isotropic(GYRO_NOISE, BIAS_WALK);
        let gyro_noise = GyroNoise {
            white: Vector3::repeat(GYRO_NOISE),
            bias_walk: BIAS_WALK,
            initial_bias: Vector3::zeros(),
        };
        for row in &TABLE_4_7 {
            let mut directions = vec![Direction::new(FIRST, 0.01)?];
            if row.variance.is_finite() {
                directions.push(Direction::new(Vector3::x(), row.variance)?);
            }
            let scene = simulate(&motion, &gyro_noise, EVERY, rng, |_, truth, rng| {
                let (fisher, gaussian) = directions.iter().map(|d| d.measure(truth, rng)).unzip();
                Measured::Directions { fisher, gaussian }
            });
            let partial = row.partial.map(|_| (Frame::World, FIXED));
            let quantities = Quantities { partial, bias: true, settling: 0 };
            let label = row.case;
            Case { label, gyro, prior, scene: &scene, quantities }.run(&mut trial, &KINDS_4_7)?;
        }
        Ok(trial)
    };
    let trials = monte_carlo(request, trial)?;
    Ok(Report::of("wang-4.7", request.seed, &trials, &paper_4_7()))
}
