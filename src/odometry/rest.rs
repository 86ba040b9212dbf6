//! Rest in the course of a run.

use std::collections::VecDeque;

use nalgebra::Vector3;

use super::report::Note;
use crate::filter::ZeroVelocity;
use crate::inertial::{ImuConfig, NavState, StandstillCheck, StandstillConfig};
use crate::sensor::{ImuSample, Stamp};

/// Share of the window at whose end motion is looked for, so that it is noticed soon.
const NEWEST: f64 = 0.2;
/// Rest ends at this many times the limits under which it begins: on the likelihood ratio, which
/// is quadratic, and on the speed of the features.
const END_RATIO: f64 = 4.0;
const END_SPEED: f64 = 2.0;
/// Fewer points seen in two frames do not tell how the features move.
const MIN_POINTS: usize = 10;

/// Points seen in a frame: id and place in body coordinates (m), ascending by id.
type Sighting = Vec<(u64, Vector3<f64>)>;

/// Tells rest from motion by the IMU and by the features together.
///
/// The IMU alone would take slow steady motion for rest. So rest begins only when the features
/// stand still as well; it lasts without them, since motion begins with an acceleration.
#[derive(Debug, Clone)]
pub(super) struct RestDetector {
    config: StandstillConfig,
    imu: ImuConfig,
    samples: VecDeque<ImuSample>,
    sightings: VecDeque<(Stamp, Sighting)>,
    /// Frame before the present one.
    last_frame: Option<Stamp>,
    resting_since: Option<Stamp>,
    /// Rest that is over, s.
    seconds: f64,
}

/// What speaks for and against rest.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Signs {
    /// Likelihood ratios of the IMU over the window and at its end.
    ratio: f64,
    newest_ratio: f64,
    /// At which the features seem to move, m/s; `None` if too few were seen twice.
    feature_speed: Option<f64>,
}

impl RestDetector {
    pub fn new(config: &StandstillConfig, imu: &ImuConfig) -> Self {
        Self {
            config: config.clone(),
            imu: imu.clone(),
            samples: VecDeque::new(),
            sightings: VecDeque::new(),
            last_frame: None,
            resting_since: None,
            seconds: 0.0,
        }
    }

    /// Time at rest until now, s.
    pub fn seconds(&self) -> f64 {
        let now = self.resting_since.zip(self.last_frame);
        self.seconds + now.map_or(0.0, |(since, now)| now.seconds_since(since))
    }

    pub fn push_imu(&mut self, sample: ImuSample) {
        let gap = |last: &ImuSample| sample.stamp.seconds_since(last.stamp) > self.imu.max_gap;
        if self.samples.back().is_some_and(gap) {
            self.samples.clear();
        }
        self.samples.push_back(sample);
    }

    /// Judges a frame by the IMU until then and by the points `seen` in it. Gives the measurement
    /// that rest is, and a note where rest begins or ends.
    pub fn judge(
        &mut self,
        stamp: Stamp,
        state: &NavState,
        mut seen: Sighting,
    ) -> (Option<ZeroVelocity>, Option<Note>) {
        seen.sort_unstable_by_key(|(id, _)| *id);
        let start = stamp.offset_by(-self.config.window);
        // One sample from before the window shows that it is covered.
        while self.samples.get(1).is_some_and(|second| second.stamp <= start) {
            self.samples.pop_front();
        }
        while self.sightings.front().is_some_and(|(at, _)| *at < start) {
            self.sightings.pop_front();
        }
        let signs = self.signs(stamp, state, &seen);
        self.sightings.push_back((stamp, seen));
        let note = self.decide(stamp, signs);
        let last = self.last_frame.replace(stamp);
        let rest = self.resting_since.and_then(|_| self.measurement(last?, stamp));
        (rest, note)
    }

    /// `None` while the window is not covered by samples.
    fn signs(&mut self, stamp: Stamp, state: &NavState, seen: &Sighting) -> Option<Signs> {
        let window = self.config.window;
        let covered = |s: &ImuSample| stamp.seconds_since(s.stamp) >= window;
        let recent = |s: &ImuSample| stamp.seconds_since(s.stamp) <= self.imu.max_gap;
        if !(self.samples.front().is_some_and(covered) && self.samples.back().is_some_and(recent)) {
            return None;
        }
        let samples = self.samples.make_contiguous();
        let since = |seconds: f64| {
            let first = samples.partition_point(|s| stamp.seconds_since(s.stamp) > seconds);
            let check = StandstillCheck::measure(samples.get(first..)?)?;
            let biases = (&state.gyro_bias, &state.accel_bias);
            Some(check.likelihood_ratio(biases.0, biases.1, self.imu.gravity, &self.config))
        };
        Some(Signs {
            ratio: since(window)?,
            newest_ratio: since(NEWEST * window)?,
            feature_speed: self.sightings.front().and_then(|(at, before)| {
                Some(displacement(before, seen)?.norm() / stamp.seconds_since(*at))
            }),
        })
    }

    fn decide(&mut self, stamp: Stamp, signs: Option<Signs>) -> Option<Note> {
        let limit = self.config.max_feature_speed;
        match (self.resting_since, signs) {
            (None, Some(Signs { ratio, newest_ratio, feature_speed: Some(speed) }))
                if ratio.max(newest_ratio) < 1.0 && speed < limit =>
            {
                self.resting_since = Some(stamp);
                let text = format!(
                    "at rest at {stamp} s: IMU likelihood ratio {ratio:.2} (limit 1), features \
                     move at {speed:.4} m/s (limit {limit})"
                );
                Some(Note::info(text))
            }
            (Some(since), signs) => {
                let reason = self.end(signs)?;
                self.resting_since = None;
                let length = stamp.seconds_since(since);
                self.seconds += length;
                let text = format!("moving again at {stamp} s, after {length:.2} s: {reason}");
                Some(Note::info(text))
            }
            _ => None,
        }
    }

    /// Why rest is over.
    fn end(&self, signs: Option<Signs>) -> Option<String> {
        let Some(Signs { ratio, newest_ratio, feature_speed }) = signs else {
            return Some("the IMU is silent".to_owned());
        };
        let largest = ratio.max(newest_ratio);
        let limit = END_SPEED * self.config.max_feature_speed;
        match feature_speed {
            _ if largest > END_RATIO => {
                Some(format!("IMU likelihood ratio {largest:.1} (limit {END_RATIO})"))
            }
            Some(speed) if speed > limit => {
                Some(format!("features move at {speed:.3} m/s (limit {limit})"))
            }
            _ => None,
        }
    }

    /// Rest over one interval between frames. Each has readings of its own; what the body
    /// trembles in one it takes back in others, so that their errors are no more than independent.
    fn measurement(&self, from: Stamp, to: Stamp) -> Option<ZeroVelocity> {
        let rates: Vec<_> = self
            .samples
            .iter()
            .filter(|sample| sample.stamp > from && sample.stamp <= to)
            .map(|sample| sample.angular_velocity)
            .collect();
        let mean = rates.iter().sum::<Vector3<f64>>() / rates.len() as f64;
        let StandstillConfig { velocity_sd, rate_sd, .. } = self.config;
        let rate_sd = rate_sd.hypot(self.imu.gyro_noise / to.seconds_since(from).sqrt());
        (!rates.is_empty()).then_some(ZeroVelocity { rate: mean, velocity_sd, rate_sd })
    }
}

/// By how much the points seen both before and now have moved: the median of each coordinate.
fn displacement(before: &Sighting, now: &Sighting) -> Option<Vector3<f64>> {
    let moved: Vec<Vector3<f64>> = now
        .iter()
        .filter_map(|(id, place)| {
            let index = before.binary_search_by_key(id, |(id, _)| *id).ok()?;
            Some(place - before.get(index)?.1)
        })
        .collect();
    let median = |axis: usize| {
        let mut values: Vec<f64> = moved.iter().map(|d| d[axis]).collect();
        values.sort_unstable_by(f64::total_cmp);
        values.get(values.len() / 2).copied()
    };
    let enough = moved.len() >= MIN_POINTS;
    enough.then(|| Some(Vector3::new(median(0)?, median(1)?, median(2)?))).flatten()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Isometry3;

    /// A body that moves along x with the speed `speed(t)`, judged thirty times a second.
    struct Body {
        detector: RestDetector,
        state: NavState,
        time: f64,
        place: f64,
    }

    impl Body {
        fn new() -> Self {
            let state = NavState {
                world_from_body: Isometry3::identity(),
                velocity: Vector3::zeros(),
                gyro_bias: Vector3::new(0.0, 0.02, 0.0),
                accel_bias: Vector3::zeros(),
            };
            let detector = RestDetector::new(&StandstillConfig::default(), &ImuConfig::default());
            Self { detector, state, time: 0.0, place: 0.0 }
        }

        /// Goes on for a frame; the texts of notes and whether rest was measured.
        fn frame(
            &mut self,
            speed: impl Fn(f64) -> f64,
            visible: bool,
        ) -> (Option<ZeroVelocity>, Option<String>) {
            for _ in 0..6 {
                let before = speed(self.time);
                self.time += 1.0 / 180.0;
                self.place += before / 180.0;
                let force = (speed(self.time) - before) * 180.0;
                self.detector.push_imu(ImuSample {
                    stamp: Stamp::default().offset_by(self.time),
                    angular_velocity: self.state.gyro_bias,
                    specific_force: Vector3::new(force, 0.0, ImuConfig::default().gravity),
                });
            }
            let count = if visible { 30 } else { 0 };
            let place = |id: u64| Vector3::new(id as f64 * 0.1 - self.place, 0.0, 2.0);
            let seen = (0..count).map(|id| (id, place(id))).collect();
            let stamp = Stamp::default().offset_by(self.time);
            let (rest, note) = self.detector.judge(stamp, &self.state, seen);
            (rest, note.map(|note| note.text))
        }
    }

    #[test]
    fn rest_is_told_when_it_begins_and_when_it_ends() {
        let mut body = Body::new();
        let notes: Vec<_> = (0..30).filter_map(|_| body.frame(|_| 0.0, true).1).collect();
        assert!(notes.len() == 1 && notes[0].starts_with("at rest at 0.5"), "{notes:?}");
        // It lasts without features, and gives the bias.
        let (rest, note) = body.frame(|_| 0.0, false);
        assert_eq!((rest.unwrap().rate, note), (body.state.gyro_bias, None));
        let start = body.time;
        let ends = (0..10).find_map(|_| body.frame(|t| 0.5 * (t - start), false).1).unwrap();
        assert!(ends.contains("moving again") && ends.contains("likelihood"), "{ends}");
        assert!(body.time - start < 0.1, "{}", body.time - start);
        assert!(body.detector.seconds() > 0.4);
    }

    #[test]
    fn steady_motion_is_no_rest_for_the_features() {
        let mut body = Body::new();
        for _ in 0..60 {
            assert_eq!(body.frame(|_| 0.1, true), (None, None));
        }
        // Nor is it without them.
        for _ in 0..60 {
            assert_eq!(body.frame(|_| 0.1, false), (None, None));
        }
    }

    #[test]
    fn a_silent_imu_ends_rest() {
        let mut body = Body::new();
        for _ in 0..30 {
            body.frame(|_| 0.0, true);
        }
        body.time += 1.0;
        let ends = body.frame(|_| 0.0, true).1.unwrap();
        assert!(ends.contains("silent"), "{ends}");
    }
}
