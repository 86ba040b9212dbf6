use std::path::PathBuf;

use super::Alignment;

/// Why a trajectory cannot be read or two of them cannot be compared.
#[derive(Debug, thiserror::Error)]
pub enum EvaluationError {
    #[error("{path}: {error}")]
    Io { path: PathBuf, error: std::io::Error },
    #[error("{path}: {reason}")]
    Format { path: PathBuf, reason: String },
    #[error("{path}, line {line}: {reason}")]
    Parse { path: PathBuf, line: usize, reason: String },
    #[error("a trajectory of {stamps} stamps and {poses} poses")]
    LengthMismatch { stamps: usize, poses: usize },
    #[error("a trajectory without poses")]
    Empty,
    #[error("pose {index} of the trajectory is not finite")]
    NotFinite { index: usize },
    #[error("pose {index} of the trajectory is earlier than the one before it")]
    Unordered { index: usize },
    #[error("{name} must be {expected}, not {value}")]
    Option { name: &'static str, expected: &'static str, value: f64 },
    #[error(
        "matched {matched} of {estimate_poses} poses within {max_diff} s, {needed} are needed: the reference covers {} s, the estimate {} s{}{hint}",
        range(.reference_range), range(.estimate_range), offset(*.time_offset)
    )]
    TooFewMatches {
        matched: usize,
        needed: usize,
        /// Poses of the estimate.
        estimate_poses: usize,
        max_diff: f64,
        /// Seconds that were added to the stamps of the estimate.
        time_offset: f64,
        /// First and last stamp as read, s.
        reference_range: [f64; 2],
        estimate_range: [f64; 2],
        /// What probably went wrong, empty or starting with `"; "`.
        hint: String,
    },
    #[error(
        "the {poses} poses to align do not determine {alignment} alignment: their positions lie in a point, or their attitudes have nothing in common; use origin or none"
    )]
    Degenerate { alignment: Alignment, poses: usize },
    #[error("a belief has no scale: use another alignment than sim3 for NEES")]
    ScaledBelief,
    #[error("no covariance is positive definite")]
    NoCovariance,
    #[error(
        "the angular speeds of the two trajectories correlate by {correlation:.2} at best: too little to find their clock offset"
    )]
    NoClockOffset { correlation: f64 },
    #[error(
        "no two poses are {delta} {unit} apart; the {poses} matched poses span {span}: use a smaller delta"
    )]
    NoPairs { delta: f64, unit: &'static str, poses: usize, span: String },
}

fn range(range: &[f64; 2]) -> String {
    format!("{:.3} to {:.3}", range[0], range[1])
}

fn offset(seconds: f64) -> String {
    if seconds == 0.0 { String::new() } else { format!(" before the offset of {seconds} s") }
}
