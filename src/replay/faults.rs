//! A replay under faults: what to inject, and how the estimate is judged by it.

use serde::Serialize;

use super::{LogEntry, Replayed};
use crate::dataset::{Fault, FaultKind};
use crate::evaluation::NeesResult;
use crate::odometry::NoteLevel;

/// Time after the end of a fault from which on the estimate should have recovered, s.
const RECOVERY: f64 = 1.0;
/// A frame may carry a note of what happened just before the fault, s.
const EARLY: f64 = 0.05;

/// The faults of a study that happen `at` seconds from the start of a log: darkness, covered
/// views, moving objects, gaps, bad stamps, lost and repeated messages, noise, units, biases,
/// kidnapping.
pub fn fault_grid(at: f64) -> Vec<Fault> {
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
        .map(|(kind, length)| Fault::new(kind, at, length))
        .chain(lasting.into_iter().map(|kind| Fault::new(kind, 0.0, f64::INFINITY)))
        .collect()
}

/// What a fault did to an estimate.
#[derive(Debug, Clone, Serialize)]
pub struct FaultOutcome {
    /// As [`Fault`] is written; `None` for the run without one.
    pub fault: Option<String>,
    /// Why the run ended with an error, if it did.
    pub failure: Option<String>,
    /// Length of the log by its stamps, s.
    pub seconds: f64,
    pub frames: u64,
    /// Whether every pose and covariance is finite and stamps increase.
    pub valid: bool,
    /// The first warning from the fault on.
    pub named: Option<Naming>,
    /// Of the poses from a second after the end of the fault on.
    pub recovered: Option<Recovered>,
    pub seconds_without_vision: f64,
    pub divergences: u64,
    pub reinitializations: u64,
}

#[derive(Debug, Clone, Serialize)]
pub struct Naming {
    /// s after the fault began.
    pub delay: f64,
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
    pub fn of(fault: Option<&Fault>, replayed: &Replayed) -> Self {
        let health = &replayed.metrics.odometry.health;
        let consistency = replayed.evaluated.as_ref().and_then(|e| e.consistency.as_ref());
        let end = fault
            .map_or(0.0, |fault| if fault.end().is_finite() { fault.end() } else { fault.start });
        let settled = replayed.first_seconds + end + RECOVERY;
        Self {
            fault: fault.map(Fault::to_string),
            failure: None,
            seconds: replayed.metrics.log_seconds,
            frames: replayed.metrics.odometry.frames_processed,
            valid: replayed.is_valid(),
            named: fault.and_then(|fault| {
                naming(&replayed.metrics.notes, replayed.first_seconds + fault.start)
            }),
            recovered: consistency.and_then(|result| Recovered::from(result, settled)),
            seconds_without_vision: health.seconds_without_vision,
            divergences: health.divergences.len() as u64,
            reinitializations: health.reinitializations,
        }
    }

    /// Of a run that ended with an error.
    pub fn failed(fault: Option<&Fault>, failure: String) -> Self {
        Self {
            fault: fault.map(Fault::to_string),
            failure: Some(failure),
            seconds: 0.0,
            frames: 0,
            valid: false,
            named: None,
            recovered: None,
            seconds_without_vision: 0.0,
            divergences: 0,
            reinitializations: 0,
        }
    }
}

fn naming(notes: &[LogEntry], start: f64) -> Option<Naming> {
    let first = notes
        .iter()
        .find(|note| note.level == NoteLevel::Warning && note.seconds >= start - EARLY)?;
    Some(Naming { delay: first.seconds - start, text: first.text.clone() })
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
