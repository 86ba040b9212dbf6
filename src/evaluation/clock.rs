use super::{ApeOptions, AssociationOptions, EvaluationError, Trajectory, ape, associate};

/// How far the clock of an estimate is from that of the reference.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClockOffset {
    /// To be added to the stamps of the estimate, s.
    pub seconds: f64,
    /// Correlation of the angular speeds at this offset, at most 1.
    pub correlation: f64,
    /// Correlation at the offset the search started from; NaN where there is no overlap.
    pub correlation_at_start: f64,
}

/// Angular speeds are taken over at least this time: long enough to quieten the noise of a motion
/// capture system, short enough to keep what people and robots do, s.
const MIN_WINDOW: f64 = 0.1;
/// ... and over at least so many pose intervals: over one, the speeds of slow trajectories (10 Hz)
/// are aliased, which moved the maximum by 15 ms on VCU-RVI's lab_motion1.
const WINDOW_INTERVALS: f64 = 2.0;
/// Attitudes are not interpolated across intervals longer than this (s) and this many windows.
const MIN_GAP: f64 = 0.25;
const GAP_WINDOWS: f64 = 1.25;
/// Samples of the estimate that are compared.
const SAMPLES: usize = 4000;
/// An offset is considered where at least this fraction of the samples that can meet the reference
/// does: a reference that covers only begin and end of a run cannot meet most of them.
const MIN_OVERLAP: f64 = 0.3;
/// Steps of the coarse and the fine search, s.
const COARSE: f64 = 0.05;
const FINE: f64 = 0.005;
/// Without a clear maximum within this time the search goes on over all offsets, s.
const NEAR: f64 = 1.0;
/// A correlation that is clear.
const CLEAR: f64 = 0.8;
/// Less than this is no correlation at all.
const NONE: f64 = 0.4;

/// Finds the clock offset by cross-correlating angular speeds, which do not depend on the choice
/// of the world or of the frame on the body.
///
/// Looks within 1 s of no offset, then, if nothing there is clear, over every offset at which the
/// trajectories overlap enough.
pub fn estimate_clock_offset(
    reference: &Trajectory,
    estimate: &Trajectory,
) -> Result<ClockOffset, EvaluationError> {
    let signals = Signals::of(reference, estimate);
    let near = signals.search(0.0, -NEAR, NEAR);
    let clear = near.filter(|offset| offset.correlation >= CLEAR);
    let found = clear.or_else(|| {
        let ([r0, r1], [e0, e1]) = (reference.range(), estimate.range());
        let far = signals.search(0.0, r0 - e1, r1 - e0);
        far.into_iter().chain(near).max_by(|a, b| a.correlation.total_cmp(&b.correlation))
    });
    found.filter(|offset| offset.correlation >= NONE).ok_or(EvaluationError::NoClockOffset {
        correlation: found.map_or(0.0, |offset| offset.correlation),
    })
}

/// How far positions may move an offset that angular speeds tell, s. Further off they tell of drift.
const POSITION_WINDOW: f64 = 0.2;
/// Steps of the search by positions, s.
const POSITION_COARSE: f64 = 0.02;
const POSITION_FINE: f64 = 0.0025;
/// Offsets that lose more than a tenth of the pairs are not considered: fewer pairs err less.
const MIN_PAIRS: f64 = 0.9;

/// Within 0.2 s of `start` the offset (s, added to the stamps of the estimate) at which the absolute
/// error is least: the *best constant offset* of published position errors. For errors of attitude
/// the offset of [`estimate_clock_offset`] is the right one, since it does not know the error.
///
/// # Errors
/// Those of [`ape`] at `start`.
pub fn best_clock_offset(
    reference: &Trajectory,
    estimate: &Trajectory,
    start: f64,
    options: &ApeOptions,
) -> Result<f64, EvaluationError> {
    let at = |time_offset: f64| ApeOptions {
        association: AssociationOptions { time_offset, ..options.association },
        ..*options
    };
    let pairs = associate(reference, estimate, &at(start).association)?.len() as f64;
    let error = |offset: f64| {
        let result = ape(reference, estimate, &at(offset)).ok()?;
        (result.pairs.len() as f64 >= MIN_PAIRS * pairs).then_some(result.statistics.rmse)
    };
    let least = |middle: f64, window: f64, step: f64| {
        let count = (window / step).round() as i32;
        (-count..=count)
            .map(|k| middle + f64::from(k) * step)
            .filter_map(|offset| Some((offset, error(offset)?)))
            .min_by(|a, b| a.1.total_cmp(&b.1))
            .map_or(middle, |(offset, _)| offset)
    };
    let coarse = least(start, POSITION_WINDOW, POSITION_COARSE);
    Ok(least(coarse, POSITION_COARSE, POSITION_FINE))
}

/// The best offset within a second of `start`, `None` where the angular speeds tell nothing.
pub(super) fn nearby_clock_offset(
    reference: &Trajectory,
    estimate: &Trajectory,
    start: f64,
) -> Option<ClockOffset> {
    Signals::of(reference, estimate).search(start, start - NEAR, start + NEAR)
}

/// Angular speed over time, rad/s.
struct Signal {
    stamps: Vec<f64>,
    speeds: Vec<f64>,
    /// Longest interval between two stamps that is no gap, s.
    max_interval: f64,
}

struct Signals {
    reference: Signal,
    estimate: Signal,
    /// Fewest samples that must meet.
    min_samples: f64,
}

impl Signals {
    fn of(reference: &Trajectory, estimate: &Trajectory) -> Self {
        let interval = |trajectory: &Trajectory| trajectory.median_interval().unwrap_or(0.0);
        let slower = interval(reference).max(interval(estimate));
        let window = MIN_WINDOW.max(WINDOW_INTERVALS * slower);
        let stride = estimate.len().div_ceil(SAMPLES);
        let reference = Signal::of(reference, window, 1);
        let estimate = Signal::of(estimate, window, stride);
        let samples = estimate.stamps.len() as f64;
        let share = reference.covered() / estimate.covered().max(f64::MIN_POSITIVE);
        Self { reference, estimate, min_samples: MIN_OVERLAP * samples * share.min(1.0) }
    }

    /// The offset between `from` and `to` (s) where the correlation is largest.
    fn search(&self, start: f64, from: f64, to: f64) -> Option<ClockOffset> {
        let best = |from: f64, to: f64, step: f64| {
            let count = ((to - from) / step).ceil() as usize;
            (0..=count)
                .map(|k| from + k as f64 * step)
                .filter_map(|offset| Some((offset, self.correlation(offset)?)))
                .max_by(|a, b| a.1.total_cmp(&b.1))
        };
        let (coarse, _) = best(from, to, COARSE)?;
        let (fine, correlation) = best(coarse - COARSE, coarse + COARSE, FINE)?;
        let around = (self.correlation(fine - FINE), self.correlation(fine + FINE));
        let seconds = match around {
            (Some(before), Some(after)) => fine + FINE * vertex(before, correlation, after),
            _ => fine,
        };
        let correlation_at_start = self.correlation(start).unwrap_or(f64::NAN);
        Some(ClockOffset { seconds, correlation, correlation_at_start })
    }

    /// Pearson's correlation of the estimate's speeds and the reference's `offset` later; `None`
    /// where too few samples meet or nothing turns.
    fn correlation(&self, offset: f64) -> Option<f64> {
        let mut sums = [0.0; 5];
        let mut n = 0;
        let mut cursor = 0;
        for (stamp, e) in self.estimate.stamps.iter().zip(&self.estimate.speeds) {
            if let Some(r) = self.reference.at(stamp + offset, &mut cursor) {
                for (sum, term) in sums.iter_mut().zip([*e, r, e * e, r * r, e * r]) {
                    *sum += term;
                }
                n += 1;
            }
        }
        if n < 10 || (n as f64) < self.min_samples {
            return None;
        }
        let [e, r, ee, rr, er] = sums.map(|sum| sum / n as f64);
        let variance = (ee - e * e) * (rr - r * r);
        (variance > 0.0).then(|| (er - e * r) / variance.sqrt())
    }
}

/// Where between -1 and 1 the parabola through three equidistant values has its vertex.
fn vertex(before: f64, middle: f64, after: f64) -> f64 {
    let curvature = before - 2.0 * middle + after;
    if curvature < 0.0 { (0.5 * (before - after) / curvature).clamp(-1.0, 1.0) } else { 0.0 }
}

impl Signal {
    /// The angular speed over `window` (s) at every `stride`-th pose of which both ends of the
    /// window are known.
    fn of(trajectory: &Trajectory, window: f64, stride: usize) -> Self {
        let max_interval = MIN_GAP.max(GAP_WINDOWS * window);
        let (mut early, mut late) = (0, 0);
        let attitude = |stamp: f64, cursor: &mut usize| {
            let (i, fraction) = bracket(trajectory.stamps(), stamp, max_interval, cursor)?;
            let (a, b) = (trajectory.poses().get(i)?, trajectory.poses().get(i + 1)?);
            Some(a.rotation.rotation_to(&b.rotation).powf(fraction) * a.rotation)
        };
        let (stamps, speeds) = trajectory
            .stamps()
            .iter()
            .step_by(stride)
            .filter_map(|&stamp| {
                let start = attitude(stamp - window / 2.0, &mut early)?;
                let end = attitude(stamp + window / 2.0, &mut late)?;
                Some((stamp, start.angle_to(&end) / window))
            })
            .unzip();
        Self { stamps, speeds, max_interval }
    }

    /// Time without the gaps, s.
    fn covered(&self) -> f64 {
        let intervals = self.stamps.windows(2).map(|pair| pair[1] - pair[0]);
        intervals.filter(|interval| *interval <= self.max_interval).sum()
    }

    /// Linear between samples; stamps asked for with one `cursor` must ascend.
    fn at(&self, stamp: f64, cursor: &mut usize) -> Option<f64> {
        let (i, fraction) = bracket(&self.stamps, stamp, self.max_interval, cursor)?;
        Some(self.speeds[i] + (self.speeds[i + 1] - self.speeds[i]) * fraction)
    }
}

/// Index `i` and fraction such that `stamp` is that far from `stamps[i]` to `stamps[i + 1]`;
/// `None` outside and in intervals longer than `max_interval`.
fn bracket(
    stamps: &[f64],
    stamp: f64,
    max_interval: f64,
    cursor: &mut usize,
) -> Option<(usize, f64)> {
    while stamps.get(*cursor + 1).is_some_and(|next| *next < stamp) {
        *cursor += 1;
    }
    let (from, to) = (stamps.get(*cursor)?, stamps.get(*cursor + 1)?);
    let interval = to - from;
    let inside = *from <= stamp && stamp <= *to && interval > 0.0 && interval <= max_interval;
    inside.then(|| (*cursor, (stamp - from) / interval))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Isometry3, vector};
    use proptest::prelude::*;

    fn trajectory(rate: f64, duration: f64, clock: f64, start: f64) -> Trajectory {
        turning(0.13, rate, duration, clock, start)
    }

    /// The frequency of a part of the motion rises by `chirp / pi` in a second, Hz.
    fn turning(chirp: f64, rate: f64, duration: f64, clock: f64, start: f64) -> Trajectory {
        let count = (duration * rate) as usize;
        let (stamps, poses) = (0..count)
            .map(|i| {
                let t = start + i as f64 / rate;
                let turn = vector![
                    (1.1 * t).sin() + (chirp * t * t).cos(),
                    0.8 * (1.7 * t).cos(),
                    0.5 * t.sin()
                ];
                (t + clock, Isometry3::new(vector![t, 0.0, 0.0], turn))
            })
            .unzip();
        Trajectory::new(stamps, poses).unwrap()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(16))]
        #[test]
        fn an_offset_is_found_near_and_far(near in -0.9..0.9_f64, far in -5e3..5e3_f64) {
            let reference = trajectory(100.0, 30.0, 0.0, 0.0);
            for clock in [near, far] {
                let estimate = trajectory(20.0, 20.0, clock, 5.0);
                let found = estimate_clock_offset(&reference, &estimate).unwrap();
                prop_assert!((found.seconds + clock).abs() < 2e-3, "{:?} {}", found, clock);
                prop_assert!(found.correlation > 0.95);
            }
        }
    }

    /// A corridor: motion capture at both ends only.
    #[test]
    fn a_reference_at_both_ends_is_enough() {
        // 0.3 Hz at the end. A chirp of 0.13 would be at 8 Hz by then, beyond what poses at 10 Hz
        // can tell, and so fast that the next of its periods is 0.12 s away.
        let chirp = 0.005;
        let whole = turning(chirp, 100.0, 200.0, 0.0, 0.0);
        let ends = |stamp: f64| !(25.0..175.0).contains(&stamp);
        let kept = whole.stamps().iter().zip(whole.poses()).filter(|(stamp, _)| ends(**stamp));
        let (stamps, poses): (Vec<f64>, Vec<_>) = kept.map(|(s, p)| (*s, *p)).unzip();
        let reference = Trajectory::new(stamps, poses).unwrap();
        let estimate = turning(chirp, 10.0, 200.0, 0.17, 0.0);
        let found = estimate_clock_offset(&reference, &estimate).unwrap();
        assert!((found.seconds + 0.17).abs() < 5e-3 && found.correlation > 0.9, "{found:?}");
    }

    #[test]
    fn positions_move_an_offset_to_the_least_error() {
        let reference = trajectory(100.0, 30.0, 0.0, 0.0);
        let estimate = trajectory(20.0, 20.0, -0.1, 5.0);
        let options =
            ApeOptions { alignment: crate::evaluation::Alignment::None, ..Default::default() };
        // The nearest poses of the reference are the same within half of its interval, 5 ms, and so
        // are their errors.
        let plateau = 0.5 / 100.0 + 1e-9;
        for start in [0.0, 0.1, 0.25] {
            let found = best_clock_offset(&reference, &estimate, start, &options).unwrap();
            assert!((found - 0.1).abs() <= plateau, "{found}");
        }
        let found = best_clock_offset(&reference, &estimate, 0.5, &options).unwrap();
        assert!((found - 0.3).abs() < 0.021, "{found}");
    }

    #[test]
    fn without_rotation_there_is_nothing_to_find() {
        let stamps: Vec<f64> = (0..100).map(|i| f64::from(i) * 0.05).collect();
        let poses = stamps.iter().map(|t| Isometry3::translation(*t, 0.0, 0.0)).collect();
        let still = Trajectory::new(stamps, poses).unwrap();
        let error = estimate_clock_offset(&trajectory(100.0, 5.0, 0.0, 0.0), &still).unwrap_err();
        assert!(matches!(error, EvaluationError::NoClockOffset { .. }));
    }
}
