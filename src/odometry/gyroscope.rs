//! A gyroscope that cannot be right: its readings against the turns that images see.

use nalgebra::{UnitQuaternion, Vector3};

use super::report::{Note, NoteLevel};
use super::watch::MAX_RATE;
use crate::sensor::{ImuSample, Stamp};

/// Turns smaller than this tell nothing, rad.
const LEAST_TURN: f64 = 0.02;
/// Frames further apart are not compared, s: a wrong gyroscope may have turned any number of times.
const LONGEST: f64 = 0.2;
/// Readings of more than so many times the turn of the images are too much, less than its inverse
/// too little.
const FACTOR: f64 = 3.0;

/// What a frame says of the readings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Verdict {
    TooMuch,
    /// So it seems, too, while a map is built that a levelling being corrected turns.
    TooLittle,
    Right,
}

impl Verdict {
    fn of(felt: f64, turn: f64) -> Self {
        if felt > FACTOR * turn {
            Self::TooMuch
        } else if turn > FACTOR * felt {
            Self::TooLittle
        } else {
            Self::Right
        }
    }

    /// Frames in a row that decide.
    fn patience(self) -> u32 {
        match self {
            Self::TooMuch => 3,
            Self::TooLittle => 15,
            Self::Right => 10,
        }
    }
}

/// Compares gyroscope and images, and puts the turn that images last saw in the place of readings
/// that are wrong.
#[derive(Debug, Clone, Default)]
pub(super) struct GyroscopeWatch {
    /// Integral of the readings since the attitude was last seen, rad.
    felt: Vector3<f64>,
    seen: Option<(Stamp, UnitQuaternion<f64>)>,
    /// Angular velocity of the body between the last two images, rad/s.
    rate: Vector3<f64>,
    /// What the last frames say, their number, and the sums of their turns by gyroscope and images,
    /// rad.
    verdict: Option<(Verdict, u32, (f64, f64))>,
    wrong: bool,
}

impl GyroscopeWatch {
    pub fn is_wrong(&self) -> bool {
        self.wrong
    }

    /// What to go by in place of a sample `seconds` after the one before, the gyroscope's bias being
    /// taken for `bias`.
    pub fn reading(&mut self, sample: ImuSample, seconds: f64, bias: &Vector3<f64>) -> ImuSample {
        self.felt += sample.angular_velocity * seconds;
        if self.wrong || sample.angular_velocity.norm() > MAX_RATE {
            ImuSample { angular_velocity: self.rate + bias, ..sample }
        } else {
            sample
        }
    }

    /// Takes note of the attitude of the body that an image shows.
    pub fn attitude(&mut self, stamp: Stamp, attitude: UnitQuaternion<f64>) -> Option<Note> {
        let felt = std::mem::take(&mut self.felt).norm();
        let (before, last) = self.seen.replace((stamp, attitude))?;
        let seconds = stamp.seconds_since(before);
        if !(seconds > 0.0 && seconds < LONGEST) {
            return None;
        }
        let turn = (last.inverse() * attitude).scaled_axis();
        self.rate = turn / seconds;
        let turn = turn.norm();
        if felt.max(turn) < LEAST_TURN {
            return None;
        }
        let verdict = Verdict::of(felt, turn);
        let so_far = self.verdict.filter(|(before, ..)| *before == verdict);
        let (_, frames, sums) = so_far.unwrap_or((verdict, 0, (0.0, 0.0)));
        let (frames, (felt, turn)) = (frames + 1, (sums.0 + felt, sums.1 + turn));
        self.verdict = Some((verdict, frames, (felt, turn)));
        let right = verdict == Verdict::Right;
        if frames < verdict.patience() || right != self.wrong {
            return None;
        }
        self.wrong = !right;
        Some(if right {
            let text = format!("gyroscope and images agree again at {stamp} s");
            Note { level: NoteLevel::Info, text }
        } else {
            let factor = felt / turn;
            let times = if factor > 1.0 {
                format!("{factor:.0}")
            } else {
                format!("1/{:.0}", 1.0 / factor)
            };
            let text = format!(
                "gyroscope wrong at {stamp} s: it reads some {times} times the turn that images show, \
                 which takes its place: check imu.gyroscope_scale (0.01745 for deg/s)"
            );
            Note { level: NoteLevel::Warning, text }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Half a second at rest, a second of turning, by a gyroscope that reads `factor` times the
    /// rate: notes with their times, and the last reading.
    fn run(
        watch: &mut GyroscopeWatch,
        factor: f64,
        from: f64,
    ) -> (Vec<(f64, String)>, Vector3<f64>) {
        let (axis, bias) = (Vector3::new(0.6, 0.0, 0.8), Vector3::repeat(0.01));
        let rate = |t: f64| if t < 0.5 { 0.0 } else { 3.0 * (t - 0.5) };
        let (mut notes, mut used) = (Vec::new(), Vector3::zeros());
        for k in 1..=150 {
            let t = f64::from(k) * 0.01;
            let stamp = Stamp::default().offset_by(from + t);
            let angular_velocity = axis * (factor * rate(t)) + bias;
            let sample = ImuSample { stamp, angular_velocity, specific_force: Vector3::zeros() };
            used = watch.reading(sample, 0.01, &bias).angular_velocity - bias;
            if k % 3 == 0 {
                let turned = 1.5 * (t - 0.5).max(0.0).powi(2);
                let attitude = UnitQuaternion::new(axis * turned);
                notes.extend(watch.attitude(stamp, attitude).map(|note| (t, note.text)));
            }
        }
        (notes, used)
    }

    #[test]
    fn a_gyroscope_in_other_units_is_named_and_replaced_until_it_is_right() {
        for (factor, soon) in [(57.3, 0.7), (1.0 / 57.3, 1.3)] {
            let mut watch = GyroscopeWatch::default();
            let (notes, used) = run(&mut watch, factor, 0.0);
            let [(time, text)] = notes.as_slice() else { panic!("{notes:?}") };
            assert!(*time < soon && text.contains("imu.gyroscope_scale"), "{time} {text}");
            // By the images half a frame to one and a half ago.
            assert!(watch.is_wrong() && (2.8..2.95).contains(&used.norm()), "{used}");
            let (notes, used) = run(&mut watch, 1.0, 2.0);
            assert!(notes.len() == 1 && notes[0].1.contains("agree again"), "{notes:?}");
            assert!(!watch.is_wrong() && (used.norm() - 3.0).abs() < 1e-9, "{used}");
        }
        let mut watch = GyroscopeWatch::default();
        assert!(run(&mut watch, 1.0, 0.0).0.is_empty());
        assert!(run(&mut watch, 2.0, 2.0).0.is_empty());
    }
}
