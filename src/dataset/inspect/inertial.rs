//! Units of an IMU and the sign of its accelerometer, from what it read.

use nalgebra::{Isometry3, Matrix4, UnitQuaternion, Vector3, Vector4};
use serde::Serialize;

use crate::sensor::{ImuSample, TruthPose};

/// Samples and poses beyond this number are not looked at.
const MOST_SAMPLES: usize = 100_000;

/// Standard gravity, m/s^2: one g.
const STANDARD_GRAVITY: f64 = 9.80665;

/// Length of the span whose turns are compared with those of the images, s.
pub(super) const LIVELY_SPAN: f64 = 8.0;

/// Length of a window in which the IMU may be at rest, s.
const REST_WINDOW: f64 = 0.5;
/// At rest the angular velocity is below this (rms about its mean plus the mean), rad/s.
const REST_RATE: f64 = 0.05;
/// At rest the accelerometer deviates from its mean by less than this fraction (rms).
const REST_DEVIATION: f64 = 0.02;

/// Half the window over which accelerometer and reference positions are compared, s.
const HALF_WINDOW: f64 = 0.25;
/// Reference poses further apart than this are not interpolated, s.
const LONGEST_STEP: f64 = 0.1;
/// A fit to the reference is believed if it explains all but this part of the variance.
const LARGEST_RESIDUAL: f64 = 0.2;
/// A fitted scale that is known worse than this, as a fraction, tells nothing.
const LARGEST_SCALE_SD: f64 = 0.1;
/// Less gravity than this in the readings is none, m/s^2.
pub(super) const LEAST_GRAVITY: f64 = 0.3;
/// Readings within this factor of a unit are of that unit.
const TOLERANCE: f64 = 0.15;

/// IMU samples as logged and the reference poses, in order of arrival.
#[derive(Debug, Clone, Default)]
pub(super) struct Inertial {
    samples: Vec<ImuSample>,
    truth: Vec<TruthPose>,
}

/// What the IMU reads.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ImuInspection {
    /// Whether it stood still for half a second at least; what follows is of the quietest such
    /// span.
    pub at_rest: bool,
    /// Stamp at the middle of the quietest span, s.
    pub quietest: f64,
    /// Mean accelerometer reading then, as logged.
    pub acceleration: [f64; 3],
    /// Its norm; over the whole log if the IMU never stood still.
    pub acceleration_norm: f64,
    /// Mean gyroscope reading then (rad/s if the unit is right): the bias, at rest.
    pub angular_velocity: [f64; 3],
    pub accelerometer_unit: AccelerometerUnit,
    pub gravity_sign: Sign,
    /// How the sign was found.
    pub sign_from: Evidence,
    pub gyroscope_unit: GyroscopeUnit,
    /// Direction that points up in the world of the reference poses, where a fit finds it.
    pub truth_up: Option<[f64; 3]>,
    /// Every reading of the accelerometer is zero.
    pub is_zero: bool,
    /// By the accelerations of the reference, or of the images.
    pub fit: Option<AccelerometerFit>,
    /// Where the eight seconds with the fastest turns begin, s.
    pub liveliest: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub enum AccelerometerUnit {
    #[serde(rename = "m/s^2")]
    MetresPerSecondSquared,
    #[serde(rename = "g")]
    StandardGravities,
    #[serde(rename = "unknown")]
    Unknown,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub enum GyroscopeUnit {
    #[serde(rename = "rad/s")]
    RadiansPerSecond,
    #[serde(rename = "deg/s")]
    DegreesPerSecond,
    /// Without reference poses there is nothing to compare it with.
    #[serde(rename = "unknown")]
    Unknown,
}

/// Whether the accelerometer reads specific force (up at rest) or its opposite.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Sign {
    Regular,
    Inverted,
    Unknown,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Evidence {
    /// Accelerations of the reference positions.
    Truth,
    /// Accelerations of the camera, by its images.
    Images,
    /// A camera that is mounted as configured and held upright.
    CameraMounting,
    None,
}

impl ImuInspection {
    /// The factor that makes rad/s of the gyroscope's readings; `None` if undecided.
    pub fn gyroscope_scale(&self) -> Option<f64> {
        match self.gyroscope_unit {
            GyroscopeUnit::RadiansPerSecond => Some(1.0),
            GyroscopeUnit::DegreesPerSecond => Some(1_f64.to_radians()),
            GyroscopeUnit::Unknown => None,
        }
    }
}

impl Inertial {
    pub fn add_sample(&mut self, sample: ImuSample) {
        if self.samples.len() < MOST_SAMPLES {
            self.samples.push(sample);
        }
    }

    pub fn add_truth(&mut self, pose: TruthPose) {
        if self.truth.len() < MOST_SAMPLES {
            self.truth.push(pose);
        }
    }

    /// Samples and reference poses in order of time.
    pub fn sort(&mut self) {
        self.samples.sort_by_key(|sample| sample.stamp);
        self.truth.sort_by_key(|pose| pose.stamp);
    }

    pub fn samples(&self) -> &[ImuSample] {
        &self.samples
    }

    /// What the samples, once sorted, say. `body_from_camera`: the mounting of the camera, where it
    /// is known; `seen`: poses of the IMU by the images. `None` without samples.
    pub fn evaluate(
        &self,
        body_from_camera: Option<&Isometry3<f64>>,
        seen: &[TruthPose],
    ) -> Option<ImuInspection> {
        let quietest = self.quietest_window()?;
        let mean_norm = self.samples.iter().map(|s| s.specific_force.norm()).sum::<f64>()
            / self.samples.len() as f64;
        let at_rest = quietest.is_rest();
        let acceleration_norm = if at_rest { quietest.acceleration.norm() } else { mean_norm };
        let by_truth = AccelerometerFit::new(&self.samples, &self.truth);
        let by_images = || AccelerometerFit::new(&self.samples, seen);
        let fit = by_truth.clone().map(|fit| (fit, Evidence::Truth));
        let fit = fit.or_else(|| by_images().map(|fit| (fit, Evidence::Images)));
        let (gravity_sign, sign_from) = match (&fit, body_from_camera) {
            (Some((fit, evidence)), _) => (Sign::of(fit.scale), *evidence),
            (None, Some(mounting)) => sign_by_mounting(&quietest.acceleration, mounting),
            (None, None) => (Sign::Unknown, Evidence::None),
        };
        Some(ImuInspection {
            at_rest,
            quietest: quietest.middle,
            acceleration: quietest.acceleration.into(),
            acceleration_norm,
            angular_velocity: quietest.angular_velocity.into(),
            accelerometer_unit: accelerometer_unit(acceleration_norm),
            gravity_sign,
            sign_from,
            gyroscope_unit: gyroscope_unit(&self.samples, &self.truth),
            truth_up: by_truth.filter(AccelerometerFit::feels_gravity).map(|fit| fit.up.into()),
            is_zero: self.samples.iter().all(|sample| sample.specific_force.norm() == 0.0),
            fit: fit.map(|(fit, _)| fit),
            liveliest: self.liveliest(),
        })
    }

    /// Stamp (s) at which the span with the most turns begins.
    fn liveliest(&self) -> f64 {
        let energy = |sample: &ImuSample| sample.angular_velocity.norm_squared();
        let (mut last, mut sum, mut best) = (0, 0.0, (0.0, 0));
        for (first, sample) in self.samples.iter().enumerate() {
            let inside = |s: &ImuSample| s.stamp.seconds_since(sample.stamp) < LIVELY_SPAN;
            while let Some(next) = self.samples.get(last).filter(|next| inside(next)) {
                sum += energy(next);
                last += 1;
            }
            if sum > best.0 {
                best = (sum, first);
            }
            sum -= energy(sample);
        }
        self.samples.get(best.1).map_or(0.0, |sample| sample.stamp.seconds())
    }

    fn quietest_window(&self) -> Option<Window> {
        let mut best: Option<Window> = None;
        let mut rest = self.samples.as_slice();
        while let Some(first) = rest.first() {
            let inside = |s: &ImuSample| s.stamp.seconds_since(first.stamp) < REST_WINDOW;
            let (window, later) = rest.split_at(rest.partition_point(inside));
            rest = later;
            let window = Window::new(window);
            if best.as_ref().is_none_or(|best| window.unrest() < best.unrest()) {
                best = Some(window);
            }
        }
        best
    }
}

/// Means and spreads of the samples of a span.
struct Window {
    middle: f64,
    count: usize,
    angular_velocity: Vector3<f64>,
    acceleration: Vector3<f64>,
    /// Rms of the angular velocity about its mean, and of the acceleration, as a fraction.
    rate_deviation: f64,
    acceleration_deviation: f64,
}

/// Fewer samples than this say nothing about rest.
const FEWEST_SAMPLES: usize = 10;

impl Window {
    fn new(samples: &[ImuSample]) -> Self {
        let count = samples.len();
        let mean = |of: fn(&ImuSample) -> Vector3<f64>| {
            samples.iter().map(of).sum::<Vector3<f64>>() / count as f64
        };
        let (angular_velocity, acceleration) =
            (mean(|s| s.angular_velocity), mean(|s| s.specific_force));
        let rms = |of: fn(&ImuSample) -> Vector3<f64>, mean: &Vector3<f64>| {
            let squares: f64 = samples.iter().map(|s| (of(s) - mean).norm_squared()).sum();
            (squares / count as f64).sqrt()
        };
        Self {
            middle: samples.get(count / 2).map_or(0.0, |sample| sample.stamp.seconds()),
            count,
            rate_deviation: rms(|s| s.angular_velocity, &angular_velocity),
            acceleration_deviation: rms(|s| s.specific_force, &acceleration)
                / acceleration.norm().max(f64::MIN_POSITIVE),
            angular_velocity,
            acceleration,
        }
    }

    /// Below 1 at rest.
    fn unrest(&self) -> f64 {
        if self.count < FEWEST_SAMPLES {
            return f64::INFINITY;
        }
        let rate = self.angular_velocity.norm() + self.rate_deviation;
        (rate / REST_RATE).max(self.acceleration_deviation / REST_DEVIATION)
    }

    fn is_rest(&self) -> bool {
        self.unrest() < 1.0
    }
}

fn accelerometer_unit(norm: f64) -> AccelerometerUnit {
    let is = |unit: f64| (norm / unit - 1.0).abs() < TOLERANCE;
    match () {
        () if is(STANDARD_GRAVITY) => AccelerometerUnit::MetresPerSecondSquared,
        () if is(1.0) => AccelerometerUnit::StandardGravities,
        () => AccelerometerUnit::Unknown,
    }
}

impl Sign {
    fn of(scale: f64) -> Self {
        if scale < 0.0 { Self::Inverted } else { Self::Regular }
    }
}

/// Specific force at rest points up, so in an upright image it points against the rows.
fn sign_by_mounting(
    acceleration: &Vector3<f64>,
    body_from_camera: &Isometry3<f64>,
) -> (Sign, Evidence) {
    let down = body_from_camera.rotation * Vector3::y();
    let cosine = acceleration.dot(&down) / acceleration.norm().max(f64::MIN_POSITIVE);
    // Held on its side the camera tells nothing.
    if cosine.abs() < 0.5 {
        return (Sign::Unknown, Evidence::None);
    }
    (Sign::of(-cosine), Evidence::CameraMounting)
}

/// The pose between two reference poses.
fn pose_at(truth: &[TruthPose], stamp: crate::sensor::Stamp) -> Option<Isometry3<f64>> {
    let after = truth.partition_point(|pose| pose.stamp <= stamp);
    let (before, after) = (truth.get(after.checked_sub(1)?)?, truth.get(after)?);
    let step = after.stamp.seconds_since(before.stamp);
    let part = stamp.seconds_since(before.stamp) / step;
    (step <= LONGEST_STEP)
        .then(|| before.world_from_body.try_lerp_slerp(&after.world_from_body, part, 1e-9))
        .flatten()
}

/// `acceleration = scale * reading + gravity`, in the world of the reference, fitted to second
/// differences of its positions:
///
/// `p(t + h) - 2 p(t) + p(t - h) = integral of (h - |s|) (scale R a(t + s) + g) ds`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AccelerometerFit {
    /// Factor that makes m/s^2 of the readings.
    pub scale: f64,
    /// Its standard deviation.
    pub scale_sd: f64,
    /// What the readings contain of gravity, m/s^2.
    pub gravity: f64,
    /// Unit vector against gravity.
    #[serde(skip)]
    up: Vector3<f64>,
}

impl AccelerometerFit {
    /// `None` without a reference that these readings explain.
    fn new(samples: &[ImuSample], truth: &[TruthPose]) -> Option<Self> {
        let (mut normal, mut right) = (Matrix4::zeros(), Vector4::zeros());
        let (mut squares, mut sum, mut count) = (0.0, Vector3::zeros(), 0.0);
        let mut rest = samples;
        while let Some(first) = rest.first() {
            let inside = |s: &ImuSample| s.stamp.seconds_since(first.stamp) < 2.0 * HALF_WINDOW;
            let (window, later) = rest.split_at(rest.partition_point(inside));
            rest = later;
            let Some((reading, change)) = averages(window, truth) else { continue };
            // Rows of the three axes: unknowns are the scale and gravity.
            for axis in 0..3 {
                let mut row = Vector4::zeros();
                row[0] = reading[axis];
                row[axis + 1] = 1.0;
                normal += row * row.transpose();
                right += row * change[axis];
            }
            squares += change.norm_squared();
            sum += change;
            count += 1.0;
        }
        if count < 8.0 {
            return None;
        }
        let solution = normal.cholesky()?.solve(&right);
        let residual = squares - solution.dot(&right);
        let variance = squares - sum.norm_squared() / count;
        let gravity = Vector3::new(solution[1], solution[2], solution[3]);
        // Three equations a window, four unknowns.
        let noise = residual.max(0.0) / (3.0 * count - 4.0);
        let scale_sd = (noise * normal.try_inverse()?[(0, 0)]).sqrt();
        (residual < LARGEST_RESIDUAL * variance && scale_sd < LARGEST_SCALE_SD * solution[0].abs())
            .then(|| Self {
                scale: solution[0],
                scale_sd,
                gravity: gravity.norm(),
                up: -gravity.normalize(),
            })
    }

    /// Whether its direction of gravity means something.
    fn feels_gravity(&self) -> bool {
        self.gravity > LEAST_GRAVITY
    }
}

/// Over a window, weighted by a triangle: the reading turned into the world, and the
/// acceleration of the reference.
fn averages(window: &[ImuSample], truth: &[TruthPose]) -> Option<(Vector3<f64>, Vector3<f64>)> {
    let (first, last) = (window.first()?.stamp, window.last()?.stamp);
    let length = last.seconds_since(first);
    if window.len() < FEWEST_SAMPLES || length < 1.8 * HALF_WINDOW {
        return None;
    }
    let half = length / 2.0;
    let middle = first.offset_by(half);
    let (mut reading, mut weights) = (Vector3::zeros(), 0.0);
    for sample in window {
        let weight = half - sample.stamp.seconds_since(middle).abs();
        reading += pose_at(truth, sample.stamp)?.rotation * sample.specific_force * weight;
        weights += weight;
    }
    let position = |stamp| Some(pose_at(truth, stamp)?.translation.vector);
    let change = position(last)? - position(middle)? * 2.0 + position(first)?;
    Some((reading / weights, change / (half * half)))
}

/// Compares turns of the reference with the integrated gyroscope.
fn gyroscope_unit(samples: &[ImuSample], truth: &[TruthPose]) -> GyroscopeUnit {
    let (mut product, mut squares, mut turns) = (0.0, 0.0, 0.0);
    for pair in samples.windows(2) {
        let (Some(before), Some(after)) =
            (pose_at(truth, pair[0].stamp), pose_at(truth, pair[1].stamp))
        else {
            continue;
        };
        let turn: UnitQuaternion<f64> = before.rotation.rotation_to(&after.rotation);
        // `rotation_to` acts in the world.
        let turn = before.rotation.inverse() * turn.scaled_axis();
        let seconds = pair[1].stamp.seconds_since(pair[0].stamp);
        let reading = (pair[0].angular_velocity + pair[1].angular_velocity) * (0.5 * seconds);
        product += turn.dot(&reading);
        squares += reading.norm_squared();
        turns += turn.norm_squared();
    }
    let scale = product / squares;
    let explained = product * product > (1.0 - LARGEST_RESIDUAL) * squares * turns;
    match () {
        () if !explained => GyroscopeUnit::Unknown,
        () if (scale - 1.0).abs() < TOLERANCE => GyroscopeUnit::RadiansPerSecond,
        () if (scale.to_degrees() - 1.0).abs() < TOLERANCE => GyroscopeUnit::DegreesPerSecond,
        () => GyroscopeUnit::Unknown,
    }
}

#[cfg(test)]
mod tests {
    use super::super::findings::Findings;
    use super::super::{Assumed, LogConfig, Severity, accelerometer};
    use super::*;
    use crate::inertial::ImuConfig;
    use crate::sensor::Stamp;
    use crate::simulation::{Motion, MotionConfig, MotionKind};

    /// 10 s of a motion: samples times `scales` (accelerometer, gyroscope), reference in a world
    /// that is turned by `world`.
    fn recorded(kind: MotionKind, scales: [f64; 2], world: UnitQuaternion<f64>) -> Inertial {
        recorded_under(9.81, kind, scales, world)
    }

    /// The same under another gravity, m/s^2.
    fn recorded_under(
        gravity: f64,
        kind: MotionKind,
        scales: [f64; 2],
        world: UnitQuaternion<f64>,
    ) -> Inertial {
        let config = MotionConfig { kind, ..MotionConfig::default() };
        let motion = Motion::built_in(&config, &Isometry3::identity(), 3);
        let mut inertial = Inertial::default();
        for k in 0..1000 {
            let t = f64::from(k) * 0.01;
            let (state, stamp) = (motion.state(t), Stamp::default().offset_by(t));
            inertial.add_sample(ImuSample {
                stamp,
                angular_velocity: state.angular_velocity * scales[1],
                specific_force: state.specific_force(gravity) * scales[0],
            });
            let world_from_body =
                Isometry3::from_parts(Default::default(), world) * state.world_from_body;
            inertial.add_truth(TruthPose { stamp, world_from_body });
        }
        inertial
    }

    #[test]
    fn units_and_signs_are_found_from_the_reference() {
        let upside = UnitQuaternion::from_euler_angles(0.3, 1.4, -2.0);
        for (scale, unit, sign) in [
            (1.0, AccelerometerUnit::MetresPerSecondSquared, Sign::Regular),
            (-1.0, AccelerometerUnit::MetresPerSecondSquared, Sign::Inverted),
            (1.0 / 9.81, AccelerometerUnit::StandardGravities, Sign::Regular),
            (-1.0 / 9.81, AccelerometerUnit::StandardGravities, Sign::Inverted),
        ] {
            for kind in [MotionKind::LabSimple, MotionKind::LabMotion, MotionKind::LabBumper] {
                let found = recorded(kind, [scale, 1.0], upside).evaluate(None, &[]).unwrap();
                assert_eq!(
                    (found.accelerometer_unit, found.gravity_sign),
                    (unit, sign),
                    "{kind:?}"
                );
                assert_eq!(found.sign_from, Evidence::Truth);
                let up = Vector3::from(found.truth_up.unwrap());
                assert!(up.angle(&(upside * Vector3::z())) < 0.03, "{up}");
                let fit = found.fit.unwrap();
                assert!((fit.scale * scale - 1.0).abs() < 0.05 && (fit.gravity - 9.81).abs() < 0.3);
            }
        }
    }

    /// What is said, and what is to be set, for readings of accelerations under a gravity.
    fn judged(gravity: f64, scale: f64, imu: &ImuConfig) -> (Severity, Vec<String>, String) {
        let identity = UnitQuaternion::identity();
        let inertial = recorded_under(gravity, MotionKind::LabMotion, [scale, 1.0], identity);
        let found = inertial.evaluate(None, &[]).unwrap();
        let mut findings = Findings::default();
        accelerometer::judge(&mut findings, &found, &Assumed::new(&LogConfig::default(), imu));
        let settings = findings.0.iter().filter_map(|finding| finding.setting.clone()).collect();
        let worst = findings.0.iter().map(|finding| finding.severity).max().unwrap();
        let text = findings.0.iter().map(|f| f.message.clone()).collect::<Vec<_>>().join("; ");
        (worst, settings, text)
    }

    #[test]
    fn another_gravity_is_told_from_another_unit_by_accelerations() {
        let earth = ImuConfig { gravity: 9.81, ..ImuConfig::default() };
        let moon = ImuConfig { gravity: 1.62, ..ImuConfig::default() };
        assert_eq!(judged(9.81, 1.0, &earth).1, [""; 0]);
        assert_eq!(judged(1.62, 1.0, &moon).1, [""; 0]);
        let (_, settings, text) = judged(1.62, 1.0, &earth);
        assert_eq!(settings, ["imu.gravity=1.62"], "{text}");
        // A scale of six has the same norm at rest.
        let (_, settings, text) = judged(9.81, 1.62 / 9.81, &earth);
        assert_eq!(settings, ["imu.accelerometer_scale=6.056"], "{text}");
        let (_, settings, text) = judged(9.81, 1.04, &earth);
        assert_eq!(settings, ["imu.accelerometer_scale=0.9615"], "{text}");
        let (worst, _, text) = judged(0.0, 1.0, &earth);
        assert!(worst == Severity::Error && text.contains("gravity has been taken out"), "{text}");
    }

    #[test]
    fn degrees_are_told_from_radians() {
        for (scale, unit) in [
            (1.0, GyroscopeUnit::RadiansPerSecond),
            (1_f64.to_degrees(), GyroscopeUnit::DegreesPerSecond),
            (3.0, GyroscopeUnit::Unknown),
        ] {
            let identity = UnitQuaternion::identity();
            let inertial = recorded(MotionKind::LabMotion, [1.0, scale], identity);
            assert_eq!(inertial.evaluate(None, &[]).unwrap().gyroscope_unit, unit);
        }
    }

    #[test]
    fn without_a_reference_the_mounting_tells_the_sign() {
        let mut inertial =
            recorded(MotionKind::LabSimple, [-1.0 / 9.81, 1.0], UnitQuaternion::identity());
        inertial.truth.clear();
        let samples = inertial.samples.clone();
        // The simulated camera starts upright.
        let found = inertial.evaluate(Some(&Isometry3::identity()), &[]).unwrap();
        assert!(found.at_rest && (found.acceleration_norm - 1.0).abs() < 0.01);
        assert_eq!(
            (found.gravity_sign, found.sign_from),
            (Sign::Inverted, Evidence::CameraMounting)
        );
        assert_eq!(found.gyroscope_unit, GyroscopeUnit::Unknown);
        let unmounted = Inertial { samples, truth: Vec::new() }.evaluate(None, &[]).unwrap();
        assert_eq!((unmounted.gravity_sign, unmounted.sign_from), (Sign::Unknown, Evidence::None));
    }

    #[test]
    fn a_reference_that_does_not_fit_tells_nothing() {
        let mut inertial = recorded(MotionKind::LabMotion, [1.0, 1.0], UnitQuaternion::identity());
        // Poses of another recording.
        let other = recorded(MotionKind::Corridor, [1.0, 1.0], UnitQuaternion::identity());
        inertial.truth = other.truth;
        let found = inertial.evaluate(None, &[]).unwrap();
        assert_eq!(
            (found.sign_from, found.gyroscope_unit),
            (Evidence::None, GyroscopeUnit::Unknown)
        );
    }

    #[test]
    fn a_moving_imu_is_not_at_rest() {
        let mut inertial = recorded(MotionKind::LabMotion, [1.0, 1.0], UnitQuaternion::identity());
        inertial.samples.drain(..400);
        let found = inertial.evaluate(None, &[]).unwrap();
        assert!(!found.at_rest);
        assert_eq!(found.accelerometer_unit, AccelerometerUnit::MetresPerSecondSquared);
        assert!(Inertial::default().evaluate(None, &[]).is_none());
    }
}
