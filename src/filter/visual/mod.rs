//! Visual-inertial filters: attitude, velocity, position and biases, corrected by points of a map.

mod body_points;
mod broad;
mod calibration;
mod config;
mod depthless_start;
mod estimator;
mod euclidean;
mod frame_change;
mod gate;
mod handover;
mod inverse_range;
mod kind;
mod map_points;
mod mekf;
mod mfg;
mod propagation;
mod selection;
mod slam;
mod start;
mod zero_velocity;

pub use body_points::BodyPoints;
pub use calibration::{Calibration, calibration_block};
pub use config::{FilterConfig, MapTreatment, UpdateMethod};
pub use depthless_start::{
    StartInput, StartPrior, StartSolution, StartTrack, StartView, start_block, start_without_depth,
};
pub use estimator::{
    Gating, PointObservation, PointState, PointUpdate, PoseSpread, VisualInertialFilter,
};
pub use frame_change::FrameChange;
pub use kind::FilterKind;
pub use map_points::{MapRefinement, point_by_pose};
pub use mekf::Mekf;
pub use mfg::MfgFilter;
pub use selection::{Candidate, choose_points};
pub use slam::{
    AttitudeDensity, CloneId, ClonedPose, ErrorState, MountedCamera, PoseWindow, SlamFilter,
    StartedFilter, Track, TrackDepth, TrackOutcome, TrackUpdate, TrackUse, TrackView,
};
pub use start::KnownAttitude;
pub use zero_velocity::ZeroVelocity;
