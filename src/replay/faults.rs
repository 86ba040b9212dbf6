//! A replay under faults: what to inject, what each must be named, and how the estimate is judged.

use serde::Serialize;

use super::{LogEntry, Replayed};
use crate::dataset::{Fault as Injected, FaultKind};
use crate::evaluation::NeesResult;
use crate::fault::Fault;

/// Time after the end of a fault from which on the estimate should have recovered, s.
const RECOVERY: f64 = 1.0;
/// A frame may carry a note of what happened just before the fault, s.
const EARLY: f64 = 0.05;

/// The faults of a study that happen `at` seconds from the start of a log: darkness, covered
/// views, moving objects, gaps, bad stamps, lost and repeated messages, noise, units, biases,
/// kidnapping.
pub fn fault_grid(at: f64) -> Vec<Injected> {
    use FaultKind as Kind;
    let passing = [
        (Kind::Black, 0.2),
        (Kind::Black, 1.0),
        (Kind::Black, 5.0),
        (Kind::Covered, 2.0),
        (Kind::Object, 3.0),
        (Kind::ImuGap, 0.15),
        (Kind::ImuGap, 0.5),
        (Kind::ImuGap, 2.0),
        (Kind::ImuNoise, 1.0),
        (Kind::ImuStamps, 2.0),
        (Kind::FrameStamps, 2.0),
        (Kind::Jitter, 3.0),
        (Kind::Dropped, 3.0),
        (Kind::Repeated, 3.0),
        (Kind::Kidnapped, 1.0),
        (Kind::Bias, f64::INFINITY),
    ];
    let lasting = [Kind::Bias, Kind::AccelUnit, Kind::GyroUnit];
    passing
        .into_iter()
        .map(|(kind, length)| Injected::new(kind, at, length))
        .chain(lasting.into_iter().map(|kind| Injected::new(kind, 0.0, f64::INFINITY)))
        .collect()
}

/// What an injected fault must be named, as [`Fault::name`] has it.
pub fn expected_name(kind: FaultKind) -> &'static str {
    match kind {
        FaultKind::Black => "darkness",
        FaultKind::Covered => "occlusion",
        FaultKind::Object => "dynamic-scene",
        FaultKind::ImuGap => "imu-gap",
        FaultKind::ImuNoise => "imu-noise",
        FaultKind::Bias => "bias-step",
        FaultKind::AccelUnit => "accel-unit",
        FaultKind::GyroUnit => "gyro-scale",
        FaultKind::ImuStamps | FaultKind::FrameStamps => "clock-jump",
        FaultKind::Jitter => "jitter",
        FaultKind::Dropped => "dropped",
        FaultKind::Repeated => "repeated",
        FaultKind::Kidnapped => "kidnapped",
    }
}

/// What a fault did to an estimate.
#[derive(Debug, Clone, Serialize)]
pub struct FaultOutcome {
    /// As [`Injected`] is written; `None` for the run without one.
    pub fault: Option<String>,
    /// Its kind, and what that must be named.
    pub injected: Option<&'static str>,
    pub expected: Option<&'static str>,
    /// Whether the first fault that was named is that; `None` for the run without one.
    pub right: Option<bool>,
    /// Why the run ended with an error, if it did.
    pub failure: Option<String>,
    /// Length of the log by its stamps, s.
    pub seconds: f64,
    pub frames: u64,
    /// Whether every pose and covariance is finite and stamps increase.
    pub valid: bool,
    /// The first fault that was named from the injected one on; without one, from the start on: a
    /// false alarm.
    pub named: Option<Naming>,
    /// All faults that were named in the run, in order of time.
    pub all_named: Vec<Naming>,
    /// Of the poses from a second after the end of the fault on.
    pub recovered: Option<Recovered>,
    pub seconds_without_vision: f64,
    pub divergences: u64,
    pub reinitializations: u64,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Naming {
    /// s after the injected fault began; a silence is told of when it ends.
    pub delay: f64,
    pub kind: &'static str,
    pub fault: Fault,
    pub text: String,
}

/// Errors after the fault, heading and position of the first poses being put on each other.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Recovered {
    /// Root mean square, m.
    pub position: f64,
    /// Root mean square, degrees.
    pub attitude_deg: f64,
    /// Mean NEES; 3 when consistent.
    pub attitude_nees: f64,
    pub position_nees: f64,
}

impl FaultOutcome {
    pub fn of(fault: Option<&Injected>, replayed: &Replayed) -> Self {
        let health = &replayed.metrics.odometry.health;
        let consistency = replayed.evaluated.as_ref().and_then(|e| e.consistency.as_ref());
        let end = fault
            .map_or(0.0, |fault| if fault.end().is_finite() { fault.end() } else { fault.start });
        let settled = replayed.first_seconds + end + RECOVERY;
        let start = fault.map_or(0.0, |fault| fault.start);
        let all_named = namings(&replayed.metrics.notes, replayed.first_seconds + start);
        let named = all_named.iter().find(|n| fault.is_none() || n.delay >= -EARLY).cloned();
        let expected = fault.map(|fault| expected_name(fault.kind));
        Self {
            right: expected.map(|expected| named.as_ref().is_some_and(|n| n.kind == expected)),
            seconds: replayed.metrics.log_seconds,
            frames: replayed.metrics.odometry.frames_processed,
            valid: replayed.is_valid(),
            named,
            all_named,
            recovered: consistency.and_then(|result| Recovered::from(result, settled)),
            seconds_without_vision: health.seconds_without_vision,
            divergences: health.divergences.len() as u64,
            reinitializations: health.reinitializations,
            ..Self::blank(fault)
        }
    }

    /// Of a run that ended with an error.
    pub fn failed(fault: Option<&Injected>, failure: String) -> Self {
        let right = fault.map(|_| false);
        Self { failure: Some(failure), right, ..Self::blank(fault) }
    }

    fn blank(fault: Option<&Injected>) -> Self {
        Self {
            fault: fault.map(Injected::to_string),
            injected: fault.map(|fault| fault.kind.name()),
            expected: fault.map(|fault| expected_name(fault.kind)),
            right: None,
            failure: None,
            seconds: 0.0,
            frames: 0,
            valid: false,
            named: None,
            all_named: Vec::new(),
            recovered: None,
            seconds_without_vision: 0.0,
            divergences: 0,
            reinitializations: 0,
        }
    }
}

/// The faults that notes name, timed from `start` (s).
fn namings(notes: &[LogEntry], start: f64) -> Vec<Naming> {
    let naming = |note: &LogEntry| {
        let fault = note.fault?;
        let (delay, text) = (note.seconds - start, note.text.clone());
        Some(Naming { delay, kind: fault.name(), fault, text })
    };
    notes.iter().filter_map(naming).collect()
}

impl Recovered {
    /// `None` if there are no poses from `seconds` on.
    fn from(result: &NeesResult, seconds: f64) -> Option<Self> {
        let first = result.stamps.partition_point(|stamp| *stamp < seconds);
        let mean = |values: &mut dyn Iterator<Item = f64>| {
            let (sum, count) = values.fold((0.0, 0), |(sum, n), x| (sum + x, n + 1));
            (count > 0).then(|| sum / f64::from(count))
        };
        let after = |values: &[f64]| mean(&mut values.iter().skip(first).copied());
        let square = |values: &[nalgebra::Vector3<f64>]| {
            mean(&mut values.iter().skip(first).map(|v| v.norm_squared())).map(f64::sqrt)
        };
        Some(Self {
            position: square(&result.position_errors)?,
            attitude_deg: square(&result.rotation_errors)?.to_degrees(),
            attitude_nees: after(&result.attitude_nees)?,
            position_nees: after(&result.position_nees)?,
        })
    }
}

/// How often each injected kind was named what: rows of injected kind, name (`-`: none) and count, in
/// the order of first occurrence.
pub fn confusion(outcomes: &[FaultOutcome]) -> Vec<(&'static str, &'static str, usize)> {
    let mut rows: Vec<(&'static str, &'static str, usize)> = Vec::new();
    for outcome in outcomes {
        let Some(injected) = outcome.injected else { continue };
        let named = outcome.named.as_ref().map_or("-", |naming| naming.kind);
        match rows.iter_mut().find(|(i, n, _)| (*i, *n) == (injected, named)) {
            Some((_, _, count)) => *count += 1,
            None => rows.push((injected, named, 1)),
        }
    }
    rows
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::odometry::NoteLevel;

    #[test]
    fn the_grid_has_every_kind_and_each_has_a_name() {
        let grid = fault_grid(5.0);
        for kind in FaultKind::ALL {
            assert!(grid.iter().any(|fault| fault.kind == kind), "{}", kind.name());
            assert!(!expected_name(kind).is_empty());
        }
    }

    #[test]
    fn only_notes_that_tell_of_a_fault_name_one() {
        let note = |seconds, fault| LogEntry {
            seconds,
            level: NoteLevel::Warning,
            fault,
            text: "x".to_owned(),
        };
        let notes = [note(1.0, None), note(2.0, Some(Fault::Darkness))];
        let [naming] = &namings(&notes, 1.5)[..] else { panic!() };
        assert_eq!((naming.kind, naming.delay), ("darkness", 0.5));
    }

    #[test]
    fn confusion_counts_what_was_named() {
        let fault: Injected = "black:1:1".parse().unwrap();
        let outcome = |fault: Option<Fault>| FaultOutcome {
            named: fault.map(|fault| Naming {
                delay: 0.1,
                kind: fault.name(),
                fault,
                text: String::new(),
            }),
            ..FaultOutcome::blank(Some(&"black:1:1".parse().unwrap()))
        };
        let outcomes = [
            FaultOutcome::blank(None),
            outcome(Some(Fault::Darkness)),
            outcome(None),
            outcome(Some(Fault::Darkness)),
            FaultOutcome::failed(Some(&fault), "no".to_owned()),
        ];
        assert_eq!(confusion(&outcomes), [("black", "darkness", 2), ("black", "-", 2)]);
    }
}
