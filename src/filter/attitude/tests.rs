//! Laws that every attitude filter obeys, and brute force for those with moments.

use nalgebra::{Matrix3, Rotation3, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::mfg_propagation::{Belief, propagate};
use super::*;
use crate::distribution::matrix_fisher_gaussian::WeightedSample;
use crate::filter::{AttitudeMeasurement, Estimate, InertialStep, VectorMeasurement};
use crate::so3::{HaarQuadrature, exp, log, sample_haar};

/// One reading of a stream.
#[derive(Clone, Debug)]
enum Event {
    Step(InertialStep),
    Directions(Vec<VectorMeasurement>),
    Attitude(AttitudeMeasurement),
}

fn apply(filter: &mut dyn BayesFilter, event: &Event) {
    match event {
        Event::Step(step) => filter.propagate(step).unwrap(),
        Event::Directions(vectors) => filter.update_directions(vectors).unwrap(),
        Event::Attitude(attitude) => filter.update_attitude(attitude).unwrap(),
    }
}

fn normal(rng: &mut ChaCha8Rng, sd: f64) -> Vector3<f64> {
    Vector3::from_fn(|_, _| sd * Distribution::<f64>::sample(&StandardNormal, rng))
}

/// A stream with two vectors every fifth step and an attitude every twentieth, and the true
/// attitude at its end.
fn stream(seed: u64, steps: usize, sd: f64, bias: &Vector3<f64>) -> (Vec<Event>, Rotation3<f64>) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let (h, mut truth) = (0.02, Rotation3::identity());
    let mut events = Vec::new();
    for k in 1..=steps {
        let rate = Vector3::new((0.1 * k as f64).sin(), 1.0, 0.5 * (0.07 * k as f64).cos());
        truth *= exp(&(rate * h));
        let noise = normal(&mut rng, sd / h.sqrt());
        events.push(Event::Step(InertialStep::turning(rate + bias + noise, h)));
        if k % 5 == 0 {
            let vectors = [Vector3::x(), Vector3::new(0.0, 0.6, 0.8)].map(|a| {
                let b = truth.inverse() * a + normal(&mut rng, sd);
                let covariance = Matrix3::from_diagonal_element(sd * sd);
                VectorMeasurement { in_world: a, in_body: b, measured_in: Frame::Body, covariance }
            });
            events.push(Event::Directions(vectors.to_vec()));
        }
        if k % 20 == 0 {
            let measured = truth * exp(&normal(&mut rng, sd));
            let covariance = Matrix3::from_diagonal_element(sd * sd);
            let attitude = AttitudeMeasurement::from_covariance(measured, &covariance).unwrap();
            events.push(Event::Attitude(attitude));
        }
    }
    (events, truth)
}

fn prior(mode: Rotation3<f64>, s: [f64; 3]) -> AttitudePrior {
    let f = mode.matrix() * Matrix3::from_diagonal(&Vector3::from(s));
    AttitudePrior {
        gyro_bias_covariance: Matrix3::from_diagonal_element(0.01),
        ..AttitudePrior::matrix_fisher(&f).unwrap()
    }
}

const SD: f64 = 0.1;

fn run(kind: AttitudeFilterKind, prior: &AttitudePrior, events: &[Event], sd: f64) -> Estimate {
    let mut filter = kind.start(&GyroModel::isotropic(sd, 1e-3), prior).unwrap();
    for event in events {
        apply(filter.as_mut(), event);
    }
    filter.estimate()
}

fn angle(a: &Rotation3<f64>, b: &Rotation3<f64>) -> f64 {
    log(&(a.inverse() * b)).norm()
}

#[test]
fn beliefs_stay_on_so3_and_finite_and_converge() {
    let (events, truth) = stream(1, 300, SD, &Vector3::zeros());
    for kind in AttitudeFilterKind::ALL {
        // A wrong and diffuse start.
        let prior = prior(exp(&Vector3::new(1.0, -0.5, 0.3)), [2.0, 1.5, 1.0]);
        let estimate = run(kind, &prior, &events, SD);
        let r = estimate.world_from_body.into_inner();
        assert!((r.transpose() * r - Matrix3::identity()).amax() < 1e-12, "{kind}");
        assert!((r.determinant() - 1.0).abs() < 1e-12, "{kind}");
        let covariance = estimate.rotation_covariance;
        assert!(covariance.iter().all(|x| x.is_finite()), "{kind}");
        assert!(covariance.cholesky().is_some(), "{kind} {covariance}");
        let error = angle(&estimate.world_from_body, &truth);
        assert!(error < 0.25, "{kind} {error}");
        assert_eq!(estimate.gyro_bias.is_some(), kind.has_bias());
    }
}

#[test]
fn the_same_stream_gives_the_same_belief() {
    let (events, _) = stream(2, 60, SD, &Vector3::zeros());
    let prior = prior(Rotation3::identity(), [5.0, 4.0, 3.0]);
    for kind in AttitudeFilterKind::ALL {
        assert_eq!(run(kind, &prior, &events, SD), run(kind, &prior, &events, SD), "{kind}");
    }
}

#[test]
fn the_world_may_be_turned() {
    let (events, _) = stream(3, 60, SD, &Vector3::zeros());
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let turn = sample_haar(&mut rng);
    let turned: Vec<Event> = events
        .iter()
        .map(|event| match event.clone() {
            Event::Directions(vectors) => Event::Directions(
                vectors
                    .into_iter()
                    .map(|v| VectorMeasurement { in_world: turn * v.in_world, ..v })
                    .collect(),
            ),
            Event::Attitude(a) => Event::Attitude(AttitudeMeasurement {
                world_from_body: turn * a.world_from_body,
                ..a
            }),
            step => step,
        })
        .collect();
    for kind in AttitudeFilterKind::ALL {
        let prior = |mode| prior(mode, [6.0, 4.0, 3.0]);
        let expected = run(kind, &prior(Rotation3::identity()), &events, SD);
        let found = run(kind, &prior(turn), &turned, SD);
        let error = angle(&(turn * expected.world_from_body), &found.world_from_body);
        assert!(error < 1e-8, "{kind} {error}");
        let scale = expected.rotation_covariance.amax();
        let change = expected.rotation_covariance - found.rotation_covariance;
        assert!(change.amax() < 1e-7 * scale, "{kind} {change}");
    }
}

#[test]
fn the_body_may_be_turned() {
    let (events, _) = stream(3, 60, SD, &Vector3::zeros());
    let turn = exp(&Vector3::new(0.4, 1.3, -0.8));
    let back = turn.inverse();
    let turned: Vec<Event> = events
        .iter()
        .map(|event| match event.clone() {
            Event::Step(s) => {
                Event::Step(InertialStep { angular_velocity: back * s.angular_velocity, ..s })
            }
            Event::Directions(vectors) => Event::Directions(
                vectors
                    .into_iter()
                    .map(|v| VectorMeasurement { in_body: back * v.in_body, ..v })
                    .collect(),
            ),
            Event::Attitude(a) => Event::Attitude(AttitudeMeasurement {
                world_from_body: a.world_from_body * turn,
                ..a
            }),
        })
        .collect();
    for kind in AttitudeFilterKind::ALL {
        // Sigma points lie along the axes of the coordinates.
        let tolerance = match kind {
            AttitudeFilterKind::Ukf => 2e-2,
            AttitudeFilterKind::Mfgiu | AttitudeFilterKind::Mfgbu => 1e-6,
            _ => 1e-8,
        };
        let prior = |mode| prior(mode, [5.0; 3]);
        let expected = run(kind, &prior(Rotation3::identity()), &events, SD);
        let found = run(kind, &prior(turn), &turned, SD);
        let error = angle(&(expected.world_from_body * turn), &found.world_from_body);
        assert!(error < tolerance, "{kind} {error}");
    }
}

/// In the concentrated limit all distributions are one Gaussian and all filters one filter.
///
/// Except `uae`: its seven points of equal weight carry the parameter but not the first moment,
/// so that process noise counts with a weight of its own.
#[test]
fn in_the_concentrated_limit_all_filters_are_one() {
    let sd = 1e-3;
    let bias = Vector3::new(2e-3, -1e-3, 3e-3);
    let (events, truth) = stream(7, 200, sd, &bias);
    let mut prior = prior(exp(&Vector3::repeat(1e-3)), [5e5; 3]);
    prior.gyro_bias_covariance = Matrix3::from_diagonal_element(1e-5);
    for with_bias in [true, false] {
        if !with_bias {
            prior.gyro_bias = bias;
        }
        let reference = if with_bias { AttitudeFilterKind::Mekf } else { AttitudeFilterKind::Iekf };
        let (events, truth) =
            if with_bias { (events.clone(), truth) } else { stream(7, 200, sd, &Vector3::zeros()) };
        let expected = run(reference, &prior, &events, sd);
        assert!(angle(&expected.world_from_body, &truth) < 3.0 * sd);
        let kinds = AttitudeFilterKind::ALL.into_iter();
        for kind in kinds.filter(|kind| kind.has_bias() == with_bias) {
            let found = run(kind, &prior, &events, sd);
            let tolerance = if kind == AttitudeFilterKind::Uae { 0.1 } else { 0.01 };
            let error = angle(&expected.world_from_body, &found.world_from_body);
            assert!(error < tolerance * sd, "{kind} {error}");
            let change = expected.rotation_covariance - found.rotation_covariance;
            let relative = change.amax() / expected.rotation_covariance.amax();
            assert!(relative < tolerance, "{kind} {relative}");
            if let (Some(a), Some(b)) = (expected.gyro_bias, found.gyro_bias) {
                let sd = a.covariance[(0, 0)].sqrt();
                assert!((a.mean - b.mean).amax() < 0.05 * sd, "{kind}");
                let change = (a.covariance - b.covariance).amax() / a.covariance.amax();
                assert!(change < 0.02, "{kind} {change}");
            }
        }
    }
}

#[test]
fn what_cannot_be_used_is_refused_and_changes_nothing() {
    let prior = prior(Rotation3::identity(), [5.0, 4.0, 3.0]);
    let bad = Vector3::new(0.1, f64::NAN, 0.0);
    let vector = VectorMeasurement::of_world_direction(Vector3::x(), bad, 100.0);
    let zero = VectorMeasurement::of_world_direction(Vector3::x(), Vector3::zeros(), 100.0);
    let endless = VectorMeasurement::of_world_direction(Vector3::x(), Vector3::x(), 0.0);
    let attitude = AttitudeMeasurement {
        world_from_body: Rotation3::identity(),
        noise: Matrix3::from_diagonal_element(f64::INFINITY),
    };
    for kind in AttitudeFilterKind::ALL {
        let mut filter = kind.start(&GyroModel::isotropic(SD, 1e-3), &prior).unwrap();
        filter.propagate(&InertialStep::turning(Vector3::x(), 0.01)).unwrap();
        let before = filter.estimate();
        assert!(filter.propagate(&InertialStep::turning(bad, 0.01)).is_err(), "{kind}");
        for seconds in [0.0, -1.0, f64::INFINITY] {
            let step = InertialStep::turning(Vector3::x(), seconds);
            assert!(filter.propagate(&step).is_err(), "{kind}");
        }
        assert!(filter.update_directions(&[vector]).is_err(), "{kind}");
        assert!(filter.update_directions(&[endless]).is_err(), "{kind}");
        assert!(filter.update_attitude(&attitude).is_err(), "{kind}");
        // A vector of length zero has no direction; to a filter of vectors it is one of them.
        if filter.update_directions(&[zero]).is_err() {
            assert_eq!(filter.estimate(), before, "{kind}");
        }
        let position = crate::filter::PositionMeasurement {
            in_world: Vector3::zeros(),
            covariance: Matrix3::identity(),
            lever_arm: Vector3::zeros(),
        };
        let refused = filter.update_position(&position).unwrap_err().to_string();
        assert!(refused.contains(kind.name()), "{refused}");
    }
}

/// Readings that are finite but absurd: refused, or survived.
#[test]
fn no_reading_makes_a_belief_infinite() {
    let scales = [0.0, 1e-300, 1e-160, 1e-9, 1.0, 1e9, 1e160, 1e300];
    for kind in AttitudeFilterKind::ALL {
        let mut events = Vec::new();
        for x in scales {
            for y in scales {
                let step = InertialStep::turning(Vector3::new(x, -x, 0.5 * x), y);
                events.push(Event::Step(step));
                let covariance = Matrix3::from_diagonal(&Vector3::new(x, y, x));
                let step = InertialStep::turning(Vector3::repeat(0.1), 0.01);
                events.push(Event::Step(step.with_angle_covariance(covariance)));
                events.push(Event::Directions(vec![VectorMeasurement {
                    in_world: Vector3::z(),
                    in_body: Vector3::new(1.0, 0.0, 1.0) * x,
                    measured_in: Frame::Body,
                    covariance: Matrix3::from_diagonal_element(y),
                }]));
                let noise = Matrix3::from_diagonal(&Vector3::new(x, y, 1.0));
                let attitude = AttitudeMeasurement { world_from_body: exp(&Vector3::x()), noise };
                events.push(Event::Attitude(attitude));
            }
        }
        for (k, event) in events.iter().enumerate() {
            let p = prior(exp(&Vector3::new(0.3, 1.0, -0.4)), [30.0, 20.0, 5.0]);
            let mut filter = kind.start(&GyroModel::isotropic(SD, 1e-3), &p).unwrap();
            for event in [event, &events[(7 * k + 3) % events.len()], event] {
                let before = filter.attitude();
                let refused = match event {
                    Event::Step(step) => filter.propagate(step).is_err(),
                    Event::Directions(vectors) => filter.update_directions(vectors).is_err(),
                    Event::Attitude(attitude) => filter.update_attitude(attitude).is_err(),
                };
                let what = || format!("{kind}, {k}: {event:?}, refused: {refused}");
                assert!(is_finite(&filter.estimate()), "{}", what());
                assert!(!refused || filter.attitude() == before, "{}", what());
            }
        }
    }
}

fn is_finite(estimate: &Estimate) -> bool {
    let bias = estimate.gyro_bias.iter().flat_map(|b| b.mean.iter().chain(b.covariance.iter()));
    let attitude = estimate.world_from_body.matrix().iter();
    attitude.chain(estimate.rotation_covariance.iter()).chain(bias).all(|x| x.is_finite())
}

#[test]
fn names_are_read_back() {
    for kind in AttitudeFilterKind::ALL {
        assert_eq!(kind.name().parse(), Ok(kind));
        let prior = prior(Rotation3::identity(), [5.0, 4.0, 3.0]);
        let filter = kind.start(&GyroModel::isotropic(SD, 1e-3), &prior).unwrap();
        assert_eq!(filter.name(), kind.name());
    }
    assert!("mekff".parse::<AttitudeFilterKind>().unwrap_err().contains("mfgia"));
}

/// FNF-R and FNF-L are one filter in two coordinates.
#[test]
fn the_two_fast_filters_agree_to_rounding() {
    let (events, _) = stream(11, 300, 0.3, &Vector3::zeros());
    let prior = prior(exp(&Vector3::new(3.0, 0.0, 0.0)), [2.0, 1.0, 0.5]);
    let right = run(AttitudeFilterKind::FnfR, &prior, &events, 0.3);
    let left = run(AttitudeFilterKind::FnfL, &prior, &events, 0.3);
    assert!(angle(&right.world_from_body, &left.world_from_body) < 1e-10);
    assert!((right.rotation_covariance - left.rotation_covariance).amax() < 1e-10);
}

/// The mean is propagated for many steps as if the parameter had been formed after each.
#[test]
fn the_first_order_filter_may_wait_with_its_parameter() {
    let gyro = GyroModel {
        noise: Matrix3::from_diagonal(&Vector3::new(0.04, 0.3, 0.1)),
        ..GyroModel::isotropic(0.0, 0.0)
    };
    for frame in [Frame::Body, Frame::World] {
        let gyro = GyroModel { frame, ..gyro };
        let start = prior(exp(&Vector3::new(0.2, 1.0, 0.3)), [9.0, 5.0, -1.0]).attitude;
        let mut waiting = BayesFisher::new(MomentMap::Exact, &gyro, &start).unwrap();
        let mut eager = start;
        for k in 0..10 {
            let rate = Vector3::new(1.0, 0.3 * f64::from(k), -2.0);
            let step = InertialStep::turning(rate, 0.02);
            waiting.propagate(&step).unwrap();
            // L-AMF (13), with the parameter formed each time.
            let q = gyro.noise * 0.02;
            let loss = 0.5 * (Matrix3::from_diagonal_element(q.trace()) - q);
            let kept = Matrix3::identity() - loss + 0.5 * loss * loss;
            let turn = exp(&(rate * 0.02));
            let mean = match frame {
                Frame::Body => eager.mean() * kept * turn.matrix(),
                Frame::World => turn.matrix() * kept * eager.mean(),
            };
            eager = MatrixFisher::from_mean(&mean).unwrap();
        }
        let found = waiting.belief().unwrap();
        assert!((found.parameter() - eager.parameter()).amax() < 1e-8);
        assert!(angle(&waiting.attitude(), &eager.mode()) < 1e-8);
    }
}

/// From no knowledge at all, through one direction to a full attitude; the seven points of `uae`
/// do not represent the uniform distribution.
#[test]
fn an_unknown_attitude_becomes_known() {
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    let truth = sample_haar(&mut rng);
    let still = InertialStep::turning(Vector3::zeros(), 0.02);
    for kind in AttitudeFilterKind::ALL {
        let unknown = AttitudePrior::matrix_fisher(&Matrix3::zeros()).unwrap();
        let mut filter = kind.start(&GyroModel::isotropic(0.05, 1e-4), &unknown).unwrap();
        if filter.is_gaussian() || kind == AttitudeFilterKind::Uae {
            continue;
        }
        for axis in [Vector3::x(), Vector3::y()] {
            for _ in 0..20 {
                filter.propagate(&still).unwrap();
                let seen = truth.inverse() * axis;
                let measured = VectorMeasurement::of_world_direction(axis, seen, 100.0);
                filter.update_directions(&[measured]).unwrap();
            }
            let seen = filter.attitude() * (truth.inverse() * axis);
            assert!(seen.dot(&axis) > 0.999, "{kind} {seen}");
        }
        assert!(angle(&filter.attitude(), &truth) < 0.1, "{kind}");
    }
}

/// Noise of 2.5 rad about one axis says little about it, and must not spoil the others.
#[test]
fn an_attitude_measured_badly_about_one_axis_corrects_the_others() {
    use AttitudeFilterKind::{Iekf, IekfL, Mekf};
    let start = exp(&Vector3::new(0.4, -1.0, 0.7));
    let off = Vector3::new(0.0, 0.05, 0.0);
    let covariance = Matrix3::from_diagonal(&Vector3::new(10.0, 0.01, 0.01));
    let seen = start * exp(&off) * exp(&Vector3::new(2.5, 0.0, 0.0));
    let measured = AttitudeMeasurement::from_covariance(seen, &covariance).unwrap();
    for kind in [Iekf, IekfL, Mekf] {
        let prior = AttitudePrior {
            rotation_covariance: Some(Matrix3::from_diagonal_element(0.01)),
            ..AttitudePrior::matrix_fisher(&(start.matrix() * 50.0)).unwrap()
        };
        let mut filter = kind.start(&GyroModel::isotropic(0.01, 1e-4), &prior).unwrap();
        filter.update_attitude(&measured).unwrap();
        let left = log(&(filter.attitude().inverse() * start * exp(&off)));
        // As much is known before as is measured: half of the error or less is left.
        assert!(left.yz().norm() < 0.5 * off.norm(), "{kind} {left}");
    }
}

fn correlated_belief(correlation: Correlation, s: [f64; 3], scale: f64) -> Belief {
    let v = exp(&Vector3::new(-2.0, 0.3, 0.1));
    let u = exp(&Vector3::new(0.4, -1.0, 0.7));
    let f = u.matrix() * Matrix3::from_diagonal(&Vector3::from(s)) * v.matrix().transpose();
    let p = Matrix3::new(0.3, -0.1, 0.05, 0.2, 0.25, -0.1, 0.0, 0.1, -0.2) * scale;
    Belief::from_conditional(
        MatrixFisher::new(&f).unwrap(),
        Vector3::new(0.1, -0.2, 0.05),
        Matrix3::from_diagonal(&Vector3::new(0.5, 0.3, 0.4)) * (scale * scale),
        p,
        correlation,
    )
    .unwrap()
}

/// Against samples that take the exact step: the propagated distribution is that of the samples
/// to Monte Carlo error and second order in the step.
#[test]
fn moment_propagation_is_that_of_samples() {
    let gyro = GyroModel {
        noise: Matrix3::from_diagonal(&Vector3::new(0.2, 0.1, 0.3)),
        bias_walk: Matrix3::from_diagonal_element(0.4),
        frame: Frame::Body,
    };
    let step = InertialStep::turning(Vector3::new(1.0, -2.0, 0.5), 0.05);
    for correlation in [Correlation::World, Correlation::Body] {
        let belief = correlated_belief(correlation, [8.0, 5.0, 1.0], 0.5);
        let found = propagate(&belief, &gyro, &step).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let sampler = belief.sampler();
        let samples: Vec<_> = (0..200_000)
            .map(|_| {
                let (r, x) = sampler.sample(&mut rng);
                let root = gyro.noise.map(f64::sqrt);
                let noise = root * normal(&mut rng, 1.0) * step.seconds.sqrt();
                let angle = (step.angular_velocity - x) * step.seconds + noise;
                let walk = normal(&mut rng, (0.4 * step.seconds).sqrt());
                WeightedSample { weight: 1.0, attitude: r * exp(&angle), x: x + walk }
            })
            .collect();
        let fitted = Belief::from_samples(&samples, correlation).unwrap();
        let change = found.attitude().mean() - fitted.attitude().mean();
        assert!(change.amax() < 3e-3, "{change}");
        assert!((found.mu() - fitted.mu()).amax() < 5e-3);
        assert!((found.sigma() - fitted.sigma()).amax() < 1e-2);
        // The slope of x on the attitude, whatever principal axes it is written in.
        let slope = |b: &Belief| b.p() * b.regression();
        let difference = slope(&found) - slope(&fitted);
        assert!(difference.amax() < 0.02 * slope(&fitted).amax().max(0.5), "{difference}");
    }
}

/// A turn that depends on the attitude through the bias disperses it in the second order of the
/// step: the mean attitude against quadrature on SO(3), without noise.
#[test]
fn the_mean_of_a_long_step_is_of_second_order() {
    let grid = HaarQuadrature::of_degree(40);
    let gyro = GyroModel::isotropic(0.0, 0.0);
    let step = InertialStep::turning(Vector3::new(1.0, -2.0, 0.5), 0.1);
    for correlation in [Correlation::World, Correlation::Body] {
        let belief = correlated_belief(correlation, [6.0, 4.0, 1.0], 0.5);
        let spread = belief.conditional_factor() * 3f64.sqrt() * step.seconds;
        let mut mean = Matrix3::zeros();
        let mut total = 0.0;
        for (r, weight) in grid.nodes() {
            let weight = weight * belief.attitude().log_density(r).exp();
            let angle = (step.angular_velocity - belief.conditional_mean(r)) * step.seconds;
            for offset in spread.column_iter().flat_map(|c| [c.into_owned(), -c]) {
                mean += (r * exp(&(angle + offset))).matrix() * (weight / 6.0);
            }
            total += weight;
        }
        assert!((total - 1.0).abs() < 1e-9);
        let found = propagate(&belief, &gyro, &step).unwrap().attitude().mean();
        let kept = belief.attitude().mean() * exp(&(step.angular_velocity * 0.1)).matrix();
        let (error, change) = ((found - mean).amax(), (kept - mean).amax());
        assert!(error < 3e-4 && change > 3e-3, "{error} {change}");
    }
}

/// The step must matter in the test above: without it the slope differs by far more.
#[test]
fn a_step_builds_correlation_between_attitude_and_bias() {
    let gyro = GyroModel::isotropic(0.1, 0.0);
    let step = InertialStep::turning(Vector3::new(0.3, -0.2, 0.5), 0.01);
    let belief = Belief::new(
        MatrixFisher::new(&Matrix3::from_diagonal_element(50.0)).unwrap(),
        Vector3::zeros(),
        Matrix3::from_diagonal_element(0.01),
        Matrix3::zeros(),
        Correlation::Body,
    )
    .unwrap();
    let moved = propagate(&belief, &gyro, &step).unwrap();
    // Cov[x, e] = -h Sigma in the body frame.
    let cross = moved.to_gaussian().unwrap().cross;
    let turn = exp(&(step.angular_velocity * -step.seconds));
    let expected = Matrix3::from_diagonal_element(-1e-4) * turn.matrix();
    assert!((cross - expected).amax() < 3e-6, "{cross}");
}

/// Theorem 4.9 against quadrature on SO(3).
#[test]
fn the_update_is_bayes_rule_by_quadrature() {
    let grid = HaarQuadrature::of_degree(40);
    for correlation in [Correlation::World, Correlation::Body] {
        let belief = correlated_belief(correlation, [6.0, 4.0, 1.0], 1.0);
        let gyro = GyroModel::isotropic(0.1, 0.1);
        let moments = MfgPropagation::Moments;
        let mut filter = AttitudeMfg::from_belief(moments, &gyro, belief.clone()).unwrap();
        let direction = VectorMeasurement::of_world_direction(
            Vector3::new(0.6, 0.0, 0.8),
            Vector3::new(0.0, -0.8, 0.6),
            4.0,
        );
        filter.update_directions(&[direction]).unwrap();
        let f = belief.attitude().parameter() + direction.parameter().unwrap();
        // Six points at each node carry the covariance given the attitude.
        let spread = belief.conditional_factor() * 3f64.sqrt();
        let offsets: Vec<Vector3<f64>> =
            spread.column_iter().flat_map(|c| [c.into_owned(), -c]).collect();
        let samples: Vec<_> = grid
            .nodes()
            .iter()
            .flat_map(|(r, weight)| {
                let weight = weight * (f.dot(r.matrix()) - 20.0).exp();
                let x = belief.conditional_mean(r);
                offsets.iter().map(move |d| WeightedSample { weight, attitude: *r, x: x + d })
            })
            .collect();
        let fitted = Belief::from_samples(&samples, correlation);
        assert!(filter.belief().is_equivalent(&fitted.unwrap(), 1e-6), "{correlation:?}");
    }
}

#[test]
fn moments_and_sigma_points_propagate_alike_when_concentrated() {
    let gyro = GyroModel::isotropic(0.02, 1e-3);
    let step = InertialStep::turning(Vector3::new(1.0, -2.0, 0.5), 0.01);
    let belief = correlated_belief(Correlation::Body, [400.0, 300.0, 200.0], 0.01);
    let points = MfgPropagation::SigmaPoints;
    let mut filter = AttitudeMfg::from_belief(points, &gyro, belief.clone()).unwrap();
    filter.propagate(&step).unwrap();
    let moments = propagate(&belief, &gyro, &step).unwrap();
    let mean = moments.attitude().mean() - filter.belief().attitude().mean();
    assert!(mean.amax() < 1e-6, "{mean}");
    let relative = (moments.sigma() - filter.belief().sigma()).amax() / moments.sigma().amax();
    assert!(relative < 1e-3, "{relative}");
    let slope = |b: &Belief| b.p() * b.regression();
    let change = (slope(&moments) - slope(filter.belief())).amax() / slope(&moments).amax();
    assert!(change < 1e-2, "{change}");
}

/// Sigma points further than a right angle from the mode let the correlation of bias and attitude
/// feed on itself: a belief so broad is propagated by its moments.
#[test]
fn sigma_points_beyond_a_right_angle_are_not_used() {
    let gyro = GyroModel::isotropic(0.02, 1e-4);
    let step = InertialStep::turning(Vector3::new(0.3, -0.2, 0.5), 0.02);
    let propagated = |s: [f64; 3], propagation: MfgPropagation| {
        let belief = correlated_belief(Correlation::World, s, 0.1);
        let mut filter = AttitudeMfg::from_belief(propagation, &gyro, belief).unwrap();
        filter.propagate(&step).unwrap();
        filter.estimate()
    };
    let [points, moments] = [MfgPropagation::SigmaPoints, MfgPropagation::Moments];
    assert_eq!(propagated([2.0, 1.0, -0.5], points), propagated([2.0, 1.0, -0.5], moments));
    assert_ne!(propagated([20.0, 15.0, 10.0], points), propagated([20.0, 15.0, 10.0], moments));
}

/// The case in which that correlation grew: one direction for minutes, the turn about it unknown.
#[test]
fn the_bias_stays_bounded_where_the_turn_about_a_direction_is_unknown() {
    let (rate, bias) = (Vector3::new(0.6, -0.4, 1.0), Vector3::new(0.05, -0.05, 0.05));
    for kind in [AttitudeFilterKind::Mfgiu, AttitudeFilterKind::Mfgbu] {
        let prior = AttitudePrior {
            gyro_bias_covariance: Matrix3::from_diagonal_element(0.01),
            ..AttitudePrior::matrix_fisher(&Matrix3::identity()).unwrap()
        };
        let mut filter = kind.start(&GyroModel::isotropic(0.1, 1e-3), &prior).unwrap();
        let mut truth = Rotation3::identity();
        for k in 1..=4000 {
            filter.propagate(&InertialStep::turning(rate + bias, 0.05)).unwrap();
            truth *= exp(&(rate * 0.05));
            if k % 4 == 0 {
                let seen = truth.inverse() * Vector3::y();
                let measured = VectorMeasurement::of_world_direction(Vector3::y(), seen, 100.0);
                filter.update_directions(&[measured]).unwrap();
            }
        }
        let found = filter.estimate().gyro_bias.unwrap();
        assert!((found.mean - bias).norm() < 0.3, "{kind} {}", found.mean);
        assert!(found.covariance.trace() < 0.04, "{kind} {}", found.covariance);
    }
}

#[test]
fn wahba_finds_the_attitude_of_two_directions() {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let truth = sample_haar(&mut rng);
    let vectors = [Vector3::x(), Vector3::new(0.0, 0.6, 0.8)]
        .map(|a| VectorMeasurement::of_world_direction(a, truth.inverse() * a, 10.0));
    assert!(angle(&wahba(&vectors).unwrap(), &truth) < 1e-12);
}
