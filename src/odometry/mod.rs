//! The pipeline that joins front end, map and filter.

mod report;

pub use report::{
    KeypointRole, KeypointView, MapPointView, Note, NoteLevel, StageTimes, StepCounts, StepReport,
};
