//! Trajectory error and consistency.
//!
//! [`read_trajectory`] guesses a file's format, [`associate`] pairs poses by time, [`align`] takes
//! out what an estimator cannot know, [`ape`] measures what is left. Definitions are those of
//! `evo` 1.38 where it has them. Everything takes and returns plain values, so that a pipeline can
//! evaluate itself without files.

mod absolute;
mod align;
mod association;
mod clock;
mod compare;
mod error;
mod figures;
#[cfg(test)]
mod golden;
mod guards;
mod nees;
mod noise_figure;
mod plot;
mod relative;
mod report;
mod run_band;
mod statistics;
mod sub_trajectory;
mod table;
mod trajectory;
mod trajectory_file;

pub use absolute::{ApeOptions, ApeResult, Relation, absolute_errors, ape, ape_of_pairs};
pub use align::{Alignment, Similarity, align};
pub use association::{AssociationOptions, AssociationRule, PosePairs, associate};
pub use clock::{ClockOffset, best_clock_offset, estimate_clock_offset};
pub use compare::{Comparison, Method, PairedTest, Run, compare};
pub use error::EvaluationError;
pub use figures::{
    belief_figure, counts_figure, error_figure, groups_figure, nees_figure, relative_error_figure,
    stage_times_figure, trajectory_figure,
};
pub use guards::{Convention, Suspicion, Which, similarity_scale, suspicions};
pub(crate) use nees::is_vertical;
pub use nees::{
    BelievedTrajectory, NeesOptions, NeesResult, NeesSummary, nees, normalised_square,
    read_believed_trajectory,
};
pub use noise_figure::noise_figure;
pub use plot::{Band, BoxPanel, Curve, CurvePanel, Figure, Panel, PathPanel, PlotError, Scale};
pub use relative::{Delta, RpeOptions, RpeResult, rpe};
pub use report::{Report, write_html};
pub use run_band::{ConsistencyVerdict, RunBand};
pub use statistics::{Statistics, paired_t_test};
pub use sub_trajectory::{SubTrajectoryError, sub_trajectory_errors};
pub use table::{Cell, Table};
pub use trajectory::Trajectory;
pub use trajectory_file::{TrajectoryFile, TrajectoryFormat, read_trajectory};
