//! Every sequence of events is survived: late, repeated, contradictory, missing and absurd ones.

use nalgebra::{Isometry3, Point2, Translation3, UnitQuaternion, Vector2, Vector3};
use proptest::prelude::*;

use super::runner::new_run;
use super::{Odometry, OdometryConfig};
use crate::filter::FilterKind;
use crate::sensor::{
    Camera, ColorImage, DepthImage, ImuSample, PixelFormat, RgbdFrame, Stamp, Stream, TruthPose,
};
use crate::tracking::FrontEndFrame;
use crate::vision::{DepthReading, Descriptor, Extraction, Feature};

/// One call of the interface. Times are steps of a log's clock from the event before, s.
#[derive(Debug, Clone)]
enum Call {
    Imu {
        step: f64,
        angular_velocity: Vector3<f64>,
        specific_force: Vector3<f64>,
    },
    /// A plausible run of so many samples at 200 Hz.
    Rest {
        samples: u16,
    },
    /// `shift` moves all features, in pixels.
    Frame {
        step: f64,
        features: usize,
        shift: f64,
        depth: f64,
    },
    Truth {
        step: f64,
        position: f64,
        turn: f64,
    },
    Repeated {
        of_imu: bool,
    },
    NewRun,
    End,
}

/// Numbers as sensors have them, and as they should not.
fn number(usual: f64) -> impl Strategy<Value = f64> {
    prop_oneof![
        8 => (-1.0..1.0_f64).prop_map(move |x| x * usual),
        1 => Just(0.0),
        1 => prop_oneof![
            Just(f64::NAN), Just(f64::INFINITY), Just(1e300), Just(-1e18), Just(1e-300), Just(1e6)
        ],
    ]
}

fn step() -> impl Strategy<Value = f64> {
    prop_oneof![
        6 => Just(0.005),
        4 => Just(0.033),
        1 => Just(0.0),
        1 => Just(-0.02),
        1 => -5.0..5.0_f64,
        1 => prop_oneof![Just(3600.0), Just(-3600.0), Just(1e-9)],
    ]
}

fn vector(usual: f64) -> impl Strategy<Value = Vector3<f64>> {
    [number(usual), number(usual), number(usual)].prop_map(Vector3::from)
}

fn call() -> impl Strategy<Value = Call> {
    prop_oneof![
        4 => (step(), vector(2.0), vector(20.0)).prop_map(
            |(step, angular_velocity, specific_force)| Call::Imu {
                step, angular_velocity, specific_force
            }
        ),
        6 => (1..400_u16).prop_map(|samples| Call::Rest { samples }),
        10 => (step(), 0..60_usize, number(20.0), number(4.0)).prop_map(
            |(step, features, shift, depth)| Call::Frame { step, features, shift, depth }
        ),
        2 => (step(), number(3.0), number(3.0))
            .prop_map(|(step, position, turn)| Call::Truth { step, position, turn }),
        1 => any::<bool>().prop_map(|of_imu| Call::Repeated { of_imu }),
        1 => Just(Call::NewRun),
        1 => Just(Call::End),
    ]
}

/// An odometry, the clock of the events that it is given, and the reports that it has made.
struct Harness {
    odometry: Odometry,
    camera: Camera,
    now: f64,
    last: Option<Stamp>,
    reports: usize,
}

impl Harness {
    fn new(kind: FilterKind, has_imu: bool) -> Self {
        let config = OdometryConfig::default();
        let camera = Camera::new(&config.tracking().unwrap().camera).unwrap();
        let odometry = Odometry::new(&config, kind, 7, has_imu).unwrap();
        Self { odometry, camera, now: 1e3, last: None, reports: 0 }
    }

    fn advance(&mut self, step: f64) -> Stamp {
        self.now = (self.now + step).max(0.0);
        Stamp::from_seconds(self.now).unwrap()
    }

    /// The stamp of the next reading of a sensor; a new run begins where it does for a log.
    fn next_reading(&mut self, step: f64) -> Stamp {
        let stamp = self.advance(step);
        if let Some(reason) = self.last.and_then(|last| new_run(last, stamp)) {
            self.begin_new_run(reason);
        }
        self.last = Some(stamp);
        stamp
    }

    fn begin_new_run(&mut self, reason: String) {
        self.odometry.end();
        self.take_reports();
        self.odometry.begin_new_run(reason);
    }

    fn call(&mut self, call: &Call) {
        match *call {
            Call::Imu { step, angular_velocity, specific_force } => {
                let stamp = self.next_reading(step);
                self.odometry.push_imu(ImuSample { stamp, angular_velocity, specific_force });
            }
            Call::Rest { samples } => {
                for _ in 0..samples {
                    let stamp = self.next_reading(0.005);
                    let (angular_velocity, specific_force) =
                        (Vector3::zeros(), Vector3::z() * 9.81);
                    self.odometry.push_imu(ImuSample { stamp, angular_velocity, specific_force });
                }
            }
            Call::Frame { step, features, shift, depth } => {
                let stamp = self.next_reading(step);
                let frame = frame(&self.camera, stamp, features, shift, depth);
                self.odometry.push_frame(frame);
            }
            Call::Truth { step, position, turn } => {
                let stamp = self.advance(step);
                let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(turn, 0.1, -turn));
                let translation = Translation3::new(position, -position, 1.0);
                let world_from_body = Isometry3::from_parts(translation, rotation);
                self.odometry.push_truth(TruthPose { stamp, world_from_body });
            }
            Call::Repeated { of_imu } => {
                let stream = if of_imu { Stream::Imu } else { Stream::Frames };
                let stamp = self.advance(0.0);
                self.odometry.push_repeated(stream, stamp);
            }
            Call::NewRun => self.begin_new_run("all clocks were set".into()),
            Call::End => self.odometry.end(),
        }
        self.take_reports();
    }

    /// What is reported is finite, and its covariance one.
    fn take_reports(&mut self) {
        while let Some((report, _)) = self.odometry.step() {
            self.reports += 1;
            let pose = report.state.world_from_body;
            let numbers = pose.translation.vector.iter().chain(pose.rotation.coords.iter());
            let numbers = numbers.chain(report.state.velocity.iter());
            let numbers = numbers.chain(report.covariance.iter());
            assert!(numbers.copied().all(f64::is_finite), "{report:?}");
            let variances = report.covariance.diagonal();
            assert!(variances.iter().all(|variance| *variance >= 0.0), "{variances}");
        }
    }
}

/// A frame of features on a grid, each with a descriptor of its own.
fn frame(camera: &Camera, stamp: Stamp, features: usize, shift: f64, depth: f64) -> FrontEndFrame {
    let feature = |i: usize| {
        let (column, row) = ((i % 10) as f64, (i / 10) as f64);
        let pixel = Point2::new(40.0 + 50.0 * column + shift, 40.0 + 60.0 * row + 0.5 * shift);
        let reading = DepthReading {
            depth: depth.abs() + 0.1 * column,
            standard_deviation: 0.01,
            slope: Vector2::zeros(),
        };
        Some(Feature {
            pixel,
            bearing: camera.bearing(pixel)?,
            descriptor: Descriptor::from_bytes(&[(i * 37 % 251) as u8; Descriptor::BYTES]),
            response: 20.0,
            octave: 0,
            scale: 1.0,
            pixel_sigma: 0.7,
            patch: None,
            depth: (reading.depth > 0.0 && reading.depth.is_finite()).then_some(reading),
        })
    };
    let features = (0..features).filter_map(feature).collect();
    let color = ColorImage::new(8, 8, PixelFormat::Rgb8, vec![0; 192]).unwrap();
    let depth = DepthImage::new(8, 8, 0.001, vec![0; 64]).unwrap();
    FrontEndFrame {
        frame: Box::new(RgbdFrame { stamp, color, depth, others: Vec::new() }),
        extraction: Extraction { features, ..Extraction::default() },
        seconds: 0.0,
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    #[test]
    fn every_sequence_of_events_is_survived(
        calls in prop::collection::vec(call(), 1..80),
        kind in prop::sample::select(FilterKind::ALL.to_vec()),
        has_imu in any::<bool>(),
    ) {
        let mut harness = Harness::new(kind, has_imu);
        for call in &calls {
            harness.call(call);
        }
        harness.odometry.end();
        harness.take_reports();
        let counted = harness.odometry.stats().frames_processed;
        prop_assert!(counted >= harness.reports as u64);
    }
}

/// The events are no test where nothing ever starts.
#[test]
fn a_plain_sequence_is_processed() {
    for kind in FilterKind::ALL {
        let mut harness = Harness::new(kind, true);
        for _ in 0..40 {
            harness.call(&Call::Rest { samples: 7 });
            harness.call(&Call::Frame { step: 0.0, features: 60, shift: 0.0, depth: 2.0 });
        }
        harness.odometry.end();
        harness.take_reports();
        assert!(harness.reports > 5, "{kind}: {}", harness.reports);
    }
}
