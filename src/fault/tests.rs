//! All monitors on one simulated body, as a pipeline would use them: which fault they name, and when.

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::*;
use crate::inertial::{ImuConfig, NavState};
use crate::sensor::ImuSample;

/// A body and its sensors.
#[derive(Debug, Clone, Copy)]
struct Setup {
    seed: u64,
    /// s; the first second at rest.
    seconds: f64,
    imu_rate: f64,
    frame_rate: f64,
    /// Of the motion: 1 is a hand without hurry.
    pace: f64,
    /// White noise of the accelerometer that stands for vibration, m/s^2; it swells and ebbs.
    vibration: f64,
    /// Standard deviation of the stamps, s, and share of messages that are lost.
    jitter: f64,
    lost: f64,
    /// Standard deviation of an attitude by an image, rad.
    attitude_sd: f64,
}

const USUAL: Setup = Setup {
    seed: 1,
    seconds: 12.0,
    imu_rate: 200.0,
    frame_rate: 30.0,
    pace: 1.0,
    vibration: 0.0,
    jitter: 5e-5,
    lost: 0.0,
    attitude_sd: 5e-4,
};

#[derive(Debug, Clone, Copy)]
enum Message {
    Imu(ImuSample),
    Frame { at: Stamp, attitude: Option<UnitQuaternion<f64>>, features: usize },
}

impl Message {
    fn stamp(&mut self) -> &mut Stamp {
        match self {
            Self::Imu(sample) => &mut sample.stamp,
            Self::Frame { at, .. } => at,
        }
    }
}

/// What is done to a message that is taken at a time: those that come of it.
type Injection<'a> = &'a dyn Fn(f64, Message, &mut ChaCha8Rng) -> Vec<Message>;

impl Setup {
    fn rate(&self, t: f64) -> Vector3<f64> {
        let (p, phase) = (self.pace, self.seed as f64);
        let moving = (t - 1.0).clamp(0.0, 1.0);
        Vector3::new(
            0.7 * (2.1 * p * t + phase).sin(),
            0.9 * (1.3 * p * t + 2.0 * phase).cos(),
            0.5 * (3.3 * p * t).sin() + 0.2,
        ) * (p * moving)
    }

    /// Messages in the order of their stamps, with those that come again at once behind the first.
    fn messages(&self, inject: Injection) -> Vec<Message> {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        let imu = ImuConfig::default();
        let (mut attitude, mut messages) = (UnitQuaternion::identity(), Vec::new());
        let (step, bias) = (5e-4, Vector3::new(4e-3, -3e-3, 2e-3));
        let (mut next_imu, mut next_frame) = (0.0, 0.005);
        let mut normal = |sd: f64| {
            let mut one = || -> f64 { StandardNormal.sample(&mut rng) };
            Vector3::new(one(), one(), one()) * sd
        };
        for k in 0..(self.seconds / step) as usize {
            let t = k as f64 * step;
            let late = normal(self.jitter).x;
            if t >= next_imu {
                next_imu += 1.0 / self.imu_rate;
                let sd = |density: f64| density * self.imu_rate.sqrt();
                let shaken = self.vibration * (0.5 + 0.5 * (t / 1.7).sin());
                let acceleration = Vector3::new((5.0 * t).sin(), (4.0 * t).cos(), 0.5) * self.pace;
                let force = attitude.inverse() * (acceleration + Vector3::z() * imu.gravity);
                messages.push((
                    t,
                    Message::Imu(ImuSample {
                        stamp: Stamp::default().offset_by(t + late),
                        angular_velocity: self.rate(t) + bias + normal(0.5 * sd(imu.gyro_noise)),
                        specific_force: force + normal(0.5 * sd(imu.accel_noise)) + normal(shaken),
                    }),
                ));
            }
            if t >= next_frame {
                next_frame += 1.0 / self.frame_rate;
                let error = UnitQuaternion::from_scaled_axis(normal(self.attitude_sd));
                let at = Stamp::default().offset_by(t + late);
                let seen = Some(attitude * error);
                messages.push((t, Message::Frame { at, attitude: seen, features: 300 }));
            }
            attitude *= UnitQuaternion::from_scaled_axis(self.rate(t + 0.5 * step) * step);
        }
        let mut changed: Vec<_> = messages
            .into_iter()
            .filter(|_| rng.random::<f64>() >= self.lost)
            .collect::<Vec<_>>()
            .into_iter()
            .flat_map(|(t, message)| inject(t, message, &mut rng))
            .collect();
        changed.sort_by_key(|message| *message.clone().stamp());
        changed
    }

    /// Faults named in the course of the messages, with their times, s.
    fn named(&self, inject: Injection) -> Vec<(f64, Fault)> {
        let mut monitors = Monitors::new(&FaultConfig::default(), &ImuConfig::default());
        let (mut named, mut waiting) = (Vec::new(), std::collections::VecDeque::new());
        let (mut last_imu, mut last_frame) = (None, None);
        let (mut at_rest, mut count) = (Vector3::zeros(), 0.0);
        for message in self.messages(inject) {
            match message {
                Message::Imu(sample) if last_imu == Some(sample.stamp) => {
                    monitors.repeated(Stream::Imu, sample.stamp);
                }
                Message::Imu(sample) => {
                    last_imu = Some(sample.stamp);
                    if sample.stamp.seconds() < 0.5 {
                        count += 1.0;
                        at_rest += (sample.angular_velocity - at_rest) / count;
                    }
                    monitors.imu(&sample);
                }
                Message::Frame { at, .. } if last_frame == Some(at) => {
                    monitors.repeated(Stream::Frames, at);
                }
                Message::Frame { at, attitude, features } => {
                    last_frame = Some(at);
                    waiting.push_back((at, attitude, features));
                }
            }
            while let Some((stamp, attitude, features)) = waiting.front().copied() {
                let at = stamp.offset_by(monitors.clock_offset());
                let silent = last_frame.is_some_and(|last| last.seconds_since(stamp) > 1.0);
                if last_imu.is_none_or(|last| last < at) && !silent {
                    break;
                }
                waiting.pop_front();
                monitors.frame(at, features);
                let seen = if features > 30 { attitude } else { None };
                if stamp.seconds() > 0.5 {
                    monitors.attitude(at, seen, &at_rest);
                    monitors.biases(at, &started(at_rest));
                }
                named.extend(monitors.decide(at).map(|decision| (stamp.seconds(), decision.fault)));
            }
        }
        named
    }
}

/// What a start at rest knows.
fn started(gyro_bias: Vector3<f64>) -> NavState {
    let zero = Vector3::zeros();
    NavState { world_from_body: Isometry3::identity(), velocity: zero, gyro_bias, accel_bias: zero }
}

fn unchanged(_: f64, message: Message, _: &mut ChaCha8Rng) -> Vec<Message> {
    vec![message]
}

/// Of samples only.
fn imu(
    change: impl Fn(&mut ImuSample, &mut ChaCha8Rng),
) -> impl Fn(Message, &mut ChaCha8Rng) -> Vec<Message> {
    move |mut message, rng| {
        if let Message::Imu(sample) = &mut message {
            change(sample, rng);
        }
        vec![message]
    }
}

fn moved(by: f64, mut message: Message) -> Vec<Message> {
    let stamp = message.stamp();
    *stamp = stamp.offset_by(by);
    vec![message]
}

/// What is injected, for how long, what it must be named as, and how soon, s.
type Case = (&'static str, f64, Fault, f64, Box<dyn Fn(Message, &mut ChaCha8Rng) -> Vec<Message>>);

fn cases() -> Vec<Case> {
    let normal = |rng: &mut ChaCha8Rng| -> f64 { StandardNormal.sample(rng) };
    let jump = Fault::ClockJump { offset: 0.0 };
    let is_imu = |message: &Message| matches!(message, Message::Imu(_));
    vec![
        (
            "imu-gap",
            0.15,
            Fault::ImuGap,
            0.65,
            Box::new(move |m, _| if is_imu(&m) { vec![] } else { vec![m] }),
        ),
        (
            "imu-gap",
            2.0,
            Fault::ImuGap,
            2.5,
            Box::new(move |m, _| if is_imu(&m) { vec![] } else { vec![m] }),
        ),
        (
            "imu-noise",
            1.0,
            Fault::ImuNoise,
            0.5,
            Box::new(imu(move |s, rng| {
                let root = 200f64.sqrt();
                s.angular_velocity +=
                    Vector3::new(normal(rng), normal(rng), normal(rng)) * 0.01 * root;
                s.specific_force +=
                    Vector3::new(normal(rng), normal(rng), normal(rng)) * 0.1 * root;
            })),
        ),
        (
            "bias",
            9.0,
            Fault::BiasStep,
            0.5,
            Box::new(imu(|s, _| {
                s.angular_velocity.add_scalar_mut(0.1);
                s.specific_force.add_scalar_mut(1.0);
            })),
        ),
        ("accel-unit", 9.0, Fault::AccelUnit, 0.6, Box::new(imu(|s, _| s.specific_force /= 9.81))),
        ("gyro-unit", 9.0, Fault::GyroScale, 0.5, Box::new(imu(|s, _| s.angular_velocity *= 57.3))),
        (
            "imu-stamps",
            2.0,
            jump,
            1.0,
            Box::new(move |m, _| if is_imu(&m) { moved(0.05, m) } else { vec![m] }),
        ),
        (
            "frame-stamps",
            2.0,
            jump,
            1.0,
            Box::new(move |m, _| if is_imu(&m) { vec![m] } else { moved(0.05, m) }),
        ),
        (
            "frame-stamps back",
            2.0,
            jump,
            1.0,
            Box::new(move |m, _| if is_imu(&m) { vec![m] } else { moved(-0.05, m) }),
        ),
        (
            "jitter",
            3.0,
            Fault::Jitter { sd: 0.0 },
            1.0,
            Box::new(move |m, rng| moved(0.002 * normal(rng), m)),
        ),
        (
            "dropped",
            3.0,
            Fault::Dropped,
            1.0,
            Box::new(|m, rng| if rng.random::<f64>() < 0.3 { vec![] } else { vec![m] }),
        ),
        (
            "repeated",
            3.0,
            Fault::Repeated,
            0.5,
            Box::new(|m, rng| if rng.random::<f64>() < 0.3 { vec![m, m] } else { vec![m] }),
        ),
        (
            "black",
            0.2,
            Fault::Darkness,
            0.5,
            Box::new(|mut m, _| {
                if let Message::Frame { features, .. } = &mut m {
                    *features = 0;
                }
                vec![m]
            }),
        ),
    ]
}

/// Each fault in the middle of a log is named first, as what it is, and soon.
#[test]
fn injected_faults_are_named_as_what_they_are() {
    let mut wrong = Vec::new();
    for (what, length, fault, soon, change) in cases() {
        for (seed, start) in [(1, 4.0), (2, 5.1), (3, 6.3), (4, 7.7), (5, 8.2), (6, 4.6), (7, 5.7)]
        {
            let setup = Setup { seed, ..USUAL };
            let named =
                setup.named(&|t, message, rng| match (start..start + length).contains(&t) {
                    true => change(message, rng),
                    false => vec![message],
                });
            let right = named.first().is_some_and(|(at, first)| {
                first.is_kind_of(&fault) && (start - 0.05..start + soon).contains(at)
            });
            if !right {
                wrong.push(format!("{what} at {start}: {named:.2?}"));
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// From the first message on: within two seconds of the first motion.
#[test]
fn faults_from_the_start_are_named_by_the_motion() {
    for (what, _, fault, _, change) in cases() {
        if !["bias", "accel-unit", "gyro-unit"].contains(&what) {
            continue;
        }
        for seed in 1..5 {
            let named = Setup { seed, ..USUAL }.named(&|_, message, rng| change(message, rng));
            let right =
                named.first().is_some_and(|(at, first)| first.is_kind_of(&fault) && *at < 3.0);
            assert!(right, "{what}: {named:.2?}");
        }
    }
}

/// A body that is carried off while the clocks stand still: the turn that nobody felt.
#[test]
fn a_body_turned_unseen_is_kidnapped() {
    for seed in 1..6 {
        let setup = Setup { seed, ..USUAL };
        let named = setup.named(&|t, message, _| match t {
            t if (5.0..6.0).contains(&t) => vec![],
            t if t >= 6.0 => moved(-1.0, message),
            _ => vec![message],
        });
        let first = named.first().map(|(at, fault)| (fault.name(), *at < 5.5));
        assert_eq!(first, Some(("kidnapped", true)), "{seed} {named:?}");
    }
}

/// Half an hour: twelve bodies and sensors, of which none has a fault.
#[test]
fn half_an_hour_without_fault_raises_no_alarm() {
    let usual = Setup { seconds: 150.0, ..USUAL };
    let setups = [
        usual,
        Setup { pace: 2.0, ..usual },
        Setup { pace: 0.3, ..usual },
        Setup { vibration: 0.35, imu_rate: 100.0, ..usual },
        Setup { vibration: 1.0, pace: 0.5, ..usual },
        Setup { vibration: 0.12, pace: 2.5, imu_rate: 100.0, ..usual },
        Setup { imu_rate: 400.0, frame_rate: 20.0, ..usual },
        Setup { imu_rate: 100.0, frame_rate: 15.0, ..usual },
        Setup { jitter: 5e-4, imu_rate: 100.0, ..usual },
        Setup { lost: 5e-3, ..usual },
        Setup { attitude_sd: 2e-3, ..usual },
        Setup { attitude_sd: 1e-4, pace: 1.5, ..usual },
    ];
    for (seed, setup) in setups.into_iter().enumerate() {
        let setup = Setup { seed: seed as u64 + 10, ..setup };
        assert_eq!(setup.named(&unchanged), [], "{setup:?}");
    }
}
