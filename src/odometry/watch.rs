//! What is wrong with the sensors, told from their data alone.

use nalgebra::Vector3;

use super::report::{Note, NoteLevel};
use crate::inertial::{ImuConfig, NavState};
use crate::sensor::{ImuSample, Stamp};
use crate::vision::Feature;

/// An alarm is over when nothing has set it off for this long, s.
const QUIET: f64 = 1.0;
/// Intervals outside of these multiples of the usual one are irregular.
const REGULAR: std::ops::Range<f64> = 0.5..1.7;
/// The usual is learned from so many values before anything is held against it, and follows
/// later ones at the inverse rate.
const LEARNING: u32 = 20;
/// Noise of the IMU this many times the usual one is a burst.
const NOISE_BURST: f64 = 4.0;
/// A gyroscope with so many times the noise that its model has is another one, or in other units.
const NOISE_MODEL: f64 = 8.0;
/// For so long after a burst was noticed samples count as noisy, s.
const NOISE_MEMORY: f64 = 0.15;
/// For so long after IMU and images contradicted each other samples count as noisy, s.
const DISTRUST: f64 = 0.3;
/// Samples over which noise is averaged.
const NOISE_SAMPLES: usize = 12;
/// Parts of the image, across and down, in which features are counted.
const PARTS: (usize, usize) = (4, 3);
/// With features in less than this share of the usual number of parts the view is obstructed.
const OBSTRUCTED: f64 = 0.7;
/// A bias beyond this many of its standard deviations at the start is no bias of this sensor.
const UNUSUAL_BIAS: f64 = 5.0;
/// A bias that is unusual for so long is what it is, s: that of the gyroscope, which turns everything
/// while it is being found, is then known.
const LASTING: f64 = 0.5;
/// What no hand and no vehicle does, rad/s and m/s^2: units are wrong, or the sensor is.
pub(super) const MAX_RATE: f64 = 20.0;
pub(super) const MAX_FORCE: f64 = 150.0;
/// The mean specific force is compared with gravity over about this time, s, and within this factor.
const FORCE_TIME: f64 = 0.3;
const FORCE_FACTOR: f64 = 1.6;
/// With at least so many matches, and this share of those that disagree with the camera's pose,
/// agreeing on another one in so many frames in a row, something moves.
const MANY_ASTRAY: usize = 30;
const SHARE_ASTRAY: f64 = 0.2;
const FRAMES_ASTRAY: u32 = 2;

/// Speaks once when a condition is first met, and again only after it was absent for a while.
#[derive(Debug, Clone, Copy, Default)]
struct Alarm {
    since: Option<Stamp>,
    last: Option<Stamp>,
}

impl Alarm {
    fn tell(&mut self, stamp: Stamp, met: bool, text: impl FnOnce() -> String) -> Option<Note> {
        if !met {
            return None;
        }
        let new = self.last.is_none_or(|last| stamp.seconds_since(last) > QUIET);
        self.last = Some(stamp);
        if new {
            self.since = Some(stamp);
        }
        new.then(|| Note { level: NoteLevel::Warning, text: text() })
    }
}

/// A value's usual size.
#[derive(Debug, Clone, Default)]
struct Usual {
    mean: f64,
    count: u32,
}

impl Usual {
    /// `None` while it is being learned.
    fn value(&self) -> Option<f64> {
        (self.count >= LEARNING).then_some(self.mean)
    }

    fn learn(&mut self, value: f64) {
        self.count = (self.count + 1).min(LEARNING);
        self.mean += (value - self.mean) / f64::from(self.count);
    }
}

/// Whether the stamps of a stream follow each other as they usually do.
#[derive(Debug, Clone, Default)]
struct Regularity {
    last: Option<Stamp>,
    usual: Usual,
    alarm: Alarm,
}

impl Regularity {
    /// Whether more than `longest` seconds have passed since the last stamp.
    fn pauses(&self, stamp: Stamp, longest: f64) -> bool {
        self.last.is_some_and(|last| stamp.seconds_since(last) > longest)
    }

    /// Takes note of a stamp; intervals longer than `longest` are told of elsewhere.
    fn see(&mut self, stamp: Stamp, stream: &str, longest: f64) -> Option<Note> {
        let interval = stamp.seconds_since(self.last.replace(stamp)?);
        let usual = self.usual.value();
        let irregular = usual.filter(|usual| !REGULAR.contains(&(interval / usual)));
        let Some(usual) = irregular else {
            self.usual.learn(interval);
            return None;
        };
        self.alarm.tell(stamp, interval <= longest, || {
            format!(
                "irregular stamps of the {stream} at {stamp} s: an interval of {:.1} ms, usually \
                 {:.1} ms",
                1e3 * interval,
                1e3 * usual
            )
        })
    }
}

/// White noise of a stream of vectors, by second differences, in which motion all but cancels.
#[derive(Debug, Clone, Default)]
struct NoiseLevel {
    last: [Vector3<f64>; 2],
    seen: usize,
    squares: Vec<f64>,
    usual: Usual,
    alarm: Alarm,
}

impl NoiseLevel {
    /// `modelled`: the standard deviation that the configuration says, beyond many times of which
    /// none is usual.
    fn see(
        &mut self,
        stamp: Stamp,
        value: Vector3<f64>,
        modelled: f64,
        stream: &str,
    ) -> Option<Note> {
        let [before, last] = self.last;
        self.last = [last, value];
        self.seen += 1;
        if self.seen < 3 {
            return None;
        }
        // The second difference of white noise has six times its variance.
        self.squares.push((value - 2.0 * last + before).norm_squared() / 18.0);
        if self.squares.len() < NOISE_SAMPLES {
            return None;
        }
        let level = (self.squares.drain(..).sum::<f64>() / NOISE_SAMPLES as f64).sqrt();
        let usual = self.usual.value().filter(|usual| level > NOISE_BURST * usual);
        let (than, what) = match usual {
            Some(usual) => (usual, "usual"),
            None if level > NOISE_MODEL * modelled => (modelled, "configured one"),
            None => {
                self.usual.learn(level);
                return None;
            }
        };
        self.alarm.tell(stamp, true, || {
            format!("noise of the {stream} at {stamp} s is {:.0} times the {what}", level / than)
        })
    }
}

/// Watches the data of all sensors.
#[derive(Debug, Clone)]
pub(super) struct SensorWatch {
    imu: ImuConfig,
    imu_stamps: Regularity,
    /// Magnitude of the specific force, averaged over [`FORCE_TIME`], and the time of it; `None`
    /// before the first sample.
    force: Option<(Stamp, f64)>,
    units: Alarm,
    gyroscope: NoiseLevel,
    accelerometer: NoiseLevel,
    frame_stamps: Regularity,
    usual_parts: Usual,
    obstruction: Alarm,
    moving: Alarm,
    frames_astray: u32,
    contradiction: Alarm,
    gyro_bias: Alarm,
    accel_bias: Alarm,
}

/// What matching and conditioning made of a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Agreement {
    pub matches: usize,
    pub inliers: usize,
    /// Matches that agree on another pose.
    pub others: usize,
    /// Whether the inliers contradict the prediction.
    pub contradicted: bool,
}

impl SensorWatch {
    pub fn new(imu: &ImuConfig) -> Self {
        Self {
            imu: imu.clone(),
            imu_stamps: Regularity::default(),
            force: None,
            units: Alarm::default(),
            gyroscope: NoiseLevel::default(),
            accelerometer: NoiseLevel::default(),
            frame_stamps: Regularity::default(),
            usual_parts: Usual::default(),
            obstruction: Alarm::default(),
            moving: Alarm::default(),
            frames_astray: 0,
            contradiction: Alarm::default(),
            gyro_bias: Alarm::default(),
            accel_bias: Alarm::default(),
        }
    }

    pub fn imu(&mut self, sample: &ImuSample) -> impl Iterator<Item = Note> {
        let stamp = sample.stamp;
        if self.imu_stamps.pauses(stamp, self.imu.max_gap) {
            self.gyroscope.seen = 0;
            self.accelerometer.seen = 0;
        }
        let interval = self.imu_stamps.last.map_or(f64::INFINITY, |last| stamp.seconds_since(last));
        let stamps = self.imu_stamps.see(stamp, "IMU", self.imu.max_gap);
        let modelled = Some(self.imu.gyro_noise / interval.sqrt()).filter(|sd| *sd > 0.0);
        let modelled = modelled.unwrap_or(f64::INFINITY);
        let gyroscope = self.gyroscope.see(stamp, sample.angular_velocity, modelled, "gyroscope");
        let accelerometer =
            self.accelerometer.see(stamp, sample.specific_force, f64::INFINITY, "accelerometer");
        let implausible = self.implausible(sample);
        stamps.into_iter().chain(gyroscope).chain(accelerometer).chain(implausible)
    }

    /// Whether the IMU was unusually noisy, implausible or contradicted shortly before.
    pub fn is_noisy(&self, stamp: Stamp) -> bool {
        let alarms = [
            (&self.gyroscope.alarm, NOISE_MEMORY),
            (&self.accelerometer.alarm, NOISE_MEMORY),
            (&self.units, NOISE_MEMORY),
            (&self.contradiction, DISTRUST),
        ];
        let recent = |(alarm, memory): (&Alarm, f64)| {
            alarm.last.is_some_and(|last| stamp.seconds_since(last) < memory)
        };
        alarms.into_iter().any(recent)
    }

    /// Tells of readings that are none of a body on earth.
    fn implausible(&mut self, sample: &ImuSample) -> Option<Note> {
        let (stamp, gravity) = (sample.stamp, self.imu.gravity);
        let (rate, now) = (sample.angular_velocity.norm(), sample.specific_force.norm());
        let mean = self.force.map_or(now, |(last, mean)| {
            let share = (stamp.seconds_since(last) / FORCE_TIME).clamp(0.0, 1.0);
            mean + (now - mean) * share
        });
        self.force = Some((stamp, mean));
        let weight =
            gravity > 0.0 && !(gravity / FORCE_FACTOR..gravity * FORCE_FACTOR).contains(&mean);
        let implausible = weight || rate > MAX_RATE || now > MAX_FORCE;
        self.units.tell(stamp, implausible, || {
            format!(
                "implausible IMU readings at {stamp} s: {rate:.2} rad/s, specific force {mean:.2} \
                 m/s^2 on average (gravity is {gravity:.2}): check imu.gyroscope_scale and \
                 imu.accelerometer_scale"
            )
        })
    }

    /// Of an image of this size, width and height in pixels.
    pub fn frame(
        &mut self,
        stamp: Stamp,
        features: &[Feature],
        size: (usize, usize),
    ) -> impl Iterator<Item = Note> {
        let stamps = self.frame_stamps.see(stamp, "frames", f64::INFINITY);
        let parts = occupied_parts(features, size);
        let usual = self.usual_parts.value().filter(|u| (parts as f64) < OBSTRUCTED * u);
        let obstructed = match usual {
            Some(usual) => self.obstruction.tell(stamp, true, || {
                let all = PARTS.0 * PARTS.1;
                format!(
                    "view obstructed at {stamp} s: features in {parts} of {all} parts of the \
                     image, usually in {usual:.0}"
                )
            }),
            None => {
                self.usual_parts.learn(parts as f64);
                None
            }
        };
        stamps.into_iter().chain(obstructed)
    }

    pub fn agreement(&mut self, stamp: Stamp, seen: Agreement) -> impl Iterator<Item = Note> {
        let Agreement { matches, inliers, others, contradicted } = seen;
        let astray = matches.saturating_sub(inliers) as f64;
        let moves = others >= MANY_ASTRAY && others as f64 >= SHARE_ASTRAY * astray;
        self.frames_astray = if moves { self.frames_astray + 1 } else { 0 };
        let moving = self.moving.tell(stamp, self.frames_astray >= FRAMES_ASTRAY, || {
            format!(
                "something moves at {stamp} s: of {matches} matches {inliers} agree on the camera's \
                 pose and {others} on another"
            )
        });
        let predicted_by = if self.force.is_some() { "IMU" } else { "constant velocity" };
        let contradiction = self.contradiction.tell(stamp, contradicted, || {
            format!(
                "{predicted_by} and images contradict each other at {stamp} s: the prediction is \
                 distrusted"
            )
        });
        moving.into_iter().chain(contradiction)
    }

    pub fn gyro_bias(&mut self, stamp: Stamp, state: &NavState) -> Option<Note> {
        let (bias, sd) = (state.gyro_bias.amax(), self.imu.gyro_bias_sd);
        self.gyro_bias.tell(stamp, self.is_unusual(bias, sd), || {
            unusual_bias(stamp, &format!("gyroscope {bias:.3} rad/s"))
        })
    }

    pub fn accel_bias(&mut self, stamp: Stamp, state: &NavState) -> Option<Note> {
        let (bias, sd) = (state.accel_bias.amax(), self.imu.accel_bias_sd);
        self.accel_bias.tell(stamp, self.is_unusual(bias, sd), || {
            unusual_bias(stamp, &format!("accelerometer {bias:.2} m/s^2"))
        })
    }

    /// Of the largest component of a bias. Without an IMU the biases carry the motion of the
    /// constant-velocity model.
    fn is_unusual(&self, bias: f64, sd: f64) -> bool {
        self.force.is_some() && sd > 0.0 && bias > UNUSUAL_BIAS * sd
    }

    /// Whether the accelerometer's bias has been unusual for long enough for all else to have
    /// settled.
    pub fn accel_bias_lasts(&self, stamp: Stamp) -> bool {
        let Alarm { since, last } = self.accel_bias;
        last == Some(stamp) && since.is_some_and(|since| stamp.seconds_since(since) > LASTING)
    }
}

fn unusual_bias(stamp: Stamp, whose: &str) -> String {
    format!(
        "unusual bias at {stamp} s: {whose}, beyond {UNUSUAL_BIAS} times the configured standard \
         deviation"
    )
}

/// Parts of the image in which there are features.
fn occupied_parts(features: &[Feature], size: (usize, usize)) -> usize {
    let mut occupied = [false; PARTS.0 * PARTS.1];
    let part = |at: f64, length: usize, parts: usize| {
        let part = (at / length as f64 * parts as f64).max(0.0) as usize;
        part.min(parts - 1)
    };
    for feature in features {
        let column = part(feature.pixel.x, size.0, PARTS.0);
        let row = part(feature.pixel.y, size.1, PARTS.1);
        occupied[row * PARTS.0 + column] = true;
    }
    occupied.into_iter().filter(|occupied| *occupied).count()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: f64) -> Stamp {
        Stamp::default().offset_by(seconds)
    }

    #[test]
    fn irregular_stamps_are_told_once_an_episode() {
        let mut stamps = Regularity::default();
        let mut told = Vec::new();
        let mut time = 0.0;
        for k in 0..400 {
            // A sample is missing at 100, then every second one until 120, then one at 350.
            time += if k == 350 || (100..120).contains(&k) { 0.02 } else { 0.01 };
            told.extend(stamps.see(at(time), "IMU", 0.1).map(|_| k));
        }
        assert_eq!(told, [100, 350]);
        // A gap is not told here.
        assert_eq!(stamps.see(at(time + 3.0), "IMU", 0.1), None);
    }

    #[test]
    fn a_burst_of_noise_is_told_and_motion_is_not() {
        let mut level = NoiseLevel::default();
        let mut told = Vec::new();
        for k in 0..2000 {
            let t = k as f64 * 0.005;
            let noise = if (1000..1100).contains(&k) { 0.2 } else { 0.02 };
            let motion = if k > 500 { 3.0 * (6.0 * (t - 2.5)).sin().powi(2) } else { 0.0 };
            let alternating = if k % 2 == 0 { noise } else { -noise };
            let value = Vector3::new(motion + alternating, 0.0, 9.8);
            told.extend(level.see(at(t), value, f64::INFINITY, "accelerometer").map(|_| k));
        }
        assert!(told.len() == 1 && (1000..1030).contains(&told[0]), "{told:?}");

        let mut level = NoiseLevel::default();
        let mut tell = |k: i32, modelled: f64| {
            let value = Vector3::new(if k % 2 == 0 { 0.02 } else { -0.02 }, 0.0, 0.1);
            level.see(at(f64::from(k) * 0.005), value, modelled, "gyroscope")
        };
        // The second difference of alternating values is larger than that of noise of their size.
        assert!((0..50).all(|k| tell(k, 0.01).is_none()));
        assert!((50..70).any(|k| tell(k, 1e-3).is_some_and(|n| n.text.contains("configured"))));
    }

    #[test]
    fn disagreement_contradiction_and_biases_are_named() {
        let mut watch = SensorWatch::new(&ImuConfig::default());
        let sample = ImuSample {
            stamp: at(0.0),
            angular_velocity: Vector3::zeros(),
            specific_force: Vector3::z() * ImuConfig::default().gravity,
        };
        assert_eq!(watch.imu(&sample).count(), 0);
        let mut state = NavState {
            world_from_body: nalgebra::Isometry3::identity(),
            velocity: Vector3::zeros(),
            gyro_bias: Vector3::zeros(),
            accel_bias: Vector3::zeros(),
        };
        let mut told = |inliers, contradicted| -> Vec<String> {
            let others = if inliers < 80 { 40 } else { 10 };
            let seen = Agreement { matches: 100, inliers, others, contradicted };
            watch.agreement(at(0.0), seen).map(|note| note.text).collect()
        };
        assert!(told(90, false).is_empty());
        assert!(told(40, false).is_empty());
        assert!(told(40, false)[0].contains("40 on another"));
        assert!(told(40, true)[0].contains("contradict"));
        assert_eq!(watch.gyro_bias(at(0.0), &state), None);
        assert_eq!(watch.accel_bias(at(0.0), &state), None);
        state.gyro_bias.z = -6.0 * ImuConfig::default().gyro_bias_sd;
        assert!(watch.gyro_bias(at(0.0), &state).unwrap().text.contains("gyroscope 0.060"));
        assert_eq!(watch.accel_bias(at(0.0), &state), None);
        state.accel_bias.x = 6.0 * ImuConfig::default().accel_bias_sd;
        assert!(watch.accel_bias(at(0.0), &state).unwrap().text.contains("accelerometer 0.60"));
        assert!(!watch.accel_bias_lasts(at(0.0)));
        assert_eq!(watch.accel_bias(at(0.6), &state), None);
        assert!(watch.accel_bias_lasts(at(0.6)) && !watch.accel_bias_lasts(at(0.7)));

        let mut without_imu = SensorWatch::new(&ImuConfig::default());
        assert_eq!(without_imu.gyro_bias(at(0.0), &state), None);
        let seen = Agreement { matches: 100, inliers: 90, others: 0, contradicted: true };
        let told: Vec<_> = without_imu.agreement(at(0.0), seen).map(|note| note.text).collect();
        assert!(told[0].starts_with("constant velocity and images"), "{told:?}");
    }
}
