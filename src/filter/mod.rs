//! Estimators: beliefs over attitude, velocity, position and biases, and how measurements
//! change them.

pub mod attitude;
mod core;
pub mod gnss;
mod linear;
mod third_moments;
mod visual;

pub use crate::alignment::MapEstimate;
pub use core::{
    AttitudeMeasurement, BayesFilter, Estimate, FilterError, Frame, InertialStep,
    PositionMeasurement, VectorEstimate, VectorMeasurement,
};
pub use linear::{Correction, LinearMeasurement};
pub use visual::{
    AttitudeDensity, BodyPoints, Calibration, Candidate, CloneId, ClonedPose, ErrorState,
    FilterConfig, FilterKind, FrameChange, Gating, KnownAttitude, MapRefinement, MapTreatment,
    Mekf, MfgFilter, MountedCamera, PointObservation, PointState, PointUpdate, PoseSpread,
    PoseWindow, SlamFilter, StartInput, StartPrior, StartSolution, StartTrack, StartView,
    StartedFilter, Track, TrackDepth, TrackOutcome, TrackUpdate, TrackUse, TrackView, UpdateMethod,
    VisualInertialFilter, ZeroVelocity, calibration_block, choose_points, point_by_pose,
    start_block, start_without_depth,
};
