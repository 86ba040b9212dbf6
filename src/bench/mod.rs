//! Standard data sets: every sequence with every filter and seed, judged alike.
//!
//! [`Dataset`] knows what a data set looks like on disk, where it comes from and what is peculiar
//! about it; [`plan`] finds its sequences under a folder, or names the recipes of the simulated one;
//! [`execute`] runs what a [`Store`] does not hold yet, one run after the other; [`rows`]
//! summarises the runs over their seeds, and [`report`] shows them beside published figures.
//!
//! A run is recognised by what it is made of ([`RunKey`]): program, input, settings, filter and
//! seed. So an interrupted bench goes on where it was, and a changed program never shows the
//! figures of the one before.

mod dataset;
mod discovery;
mod error;
mod figures;
mod guard;
mod judge;
mod key;
mod plan;
mod published;
mod recipe;
mod record;
mod report;
mod run;
mod stereo_folder;
mod tables;

pub use dataset::{Clock, Dataset, Sequence, Source};
pub use discovery::{Found, find};
pub use error::BenchError;
pub use figures::{NeesMeans, Row, Spread, rows};
pub use guard::{Finding, Guard, StoredRow, findings_table};
pub use judge::{Estimated, Judged, Judging, coverage, judge};
pub use key::{RunKey, program_fingerprint};
pub use plan::{Axis, BenchRequest, Plan, PlannedRun, plan};
pub use published::{Published, published};
pub use recipe::{RECIPES, Recipe, Sensors};
pub use record::{Outcome, RunRecord, Store, Times};
pub use report::{BenchReport, report, sweep_figure};
pub use run::{Progress, Workshop, execute};
