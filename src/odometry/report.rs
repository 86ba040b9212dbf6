//! What the pipeline tells of one camera frame: the only thing that viewers and writers see.

use nalgebra::{Isometry3, Matrix3};
use serde::Serialize;

use crate::fault::{Decision, Fault};
use crate::filter::{Calibration, Gating};
use crate::inertial::{NavCovariance, NavState};
use crate::map::{Map, MapPoint};
use crate::sensor::Stamp;
use crate::so3::ProperSvd;

/// What became of a key point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum KeypointRole {
    /// No usable depth.
    NoDepth,
    /// Depth, but neither matched nor inserted into the map.
    Unmatched,
    /// Matched to a map point and accepted by RANSAC and the gate.
    Inlier,
    /// Matched to a map point and rejected.
    Outlier,
    /// Became a new map point.
    New,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeypointView {
    /// Column and row, pixels.
    pub pixel: [f32; 2],
    /// Where the matched map point was predicted to appear, pixels.
    pub predicted: Option<[f32; 2]>,
    /// The map point that it was matched to.
    pub point: Option<u64>,
    pub role: KeypointRole,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapPointView {
    /// World coordinates, m.
    pub position: [f32; 3],
    /// Covariance of the position, world coordinates, m^2.
    pub covariance: Matrix3<f32>,
    /// Frames since the point was inserted.
    pub age: u32,
}

impl MapPointView {
    /// Root of the mean variance of the position, m.
    pub fn sigma(&self) -> f32 {
        (self.covariance.trace().max(0.0) / 3.0).sqrt()
    }
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct StepCounts {
    pub features: usize,
    pub with_depth: usize,
    /// Map points that passed the distance and viewing direction rules.
    pub candidates: usize,
    pub matches: usize,
    pub inliers: usize,
    pub new_points: usize,
    pub map_points: usize,
}

/// Wall time of the stages of one frame, s.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct StageTimes {
    pub features: f64,
    pub propagation: f64,
    pub matching: f64,
    pub ransac: f64,
    pub update: f64,
    pub map: f64,
}

impl StageTimes {
    /// Stage names and values in the order of processing.
    pub fn stages(&self) -> [(&'static str, f64); 6] {
        [
            ("features", self.features),
            ("propagation", self.propagation),
            ("matching", self.matching),
            ("ransac", self.ransac),
            ("update", self.update),
            ("map", self.map),
        ]
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum NoteLevel {
    Info,
    Warning,
}

/// An event worth a line in the log (initialised, gap, lost, recovered, ...).
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Note {
    pub level: NoteLevel,
    /// The fault that it tells of.
    pub fault: Option<Fault>,
    pub text: String,
}

impl Note {
    pub fn info(text: String) -> Self {
        Self { level: NoteLevel::Info, fault: None, text }
    }

    pub fn warning(text: String) -> Self {
        Self { level: NoteLevel::Warning, fault: None, text }
    }

    /// Of a fault that has just been named.
    pub fn of(decision: &Decision, at: Stamp) -> Self {
        let Decision { fault, reaction, since, statistic } = decision;
        let text = format!(
            "{fault} at {at} s, since {since} s (statistic {statistic:.1} of its threshold): \
             {reaction}"
        );
        Self { level: NoteLevel::Warning, fault: Some(*fault), text }
    }
}

/// The pipeline's account of one camera frame.
#[derive(Debug, Clone, PartialEq)]
pub struct StepReport {
    /// Number of the frame in the log, from 0.
    pub frame: u64,
    pub stamp: Stamp,
    pub state: NavState,
    pub covariance: NavCovariance,
    pub world_from_camera: Isometry3<f64>,
    /// The camera's calibration as estimated, if it is.
    pub calibration: Option<Calibration>,
    /// Parameter of the attitude's matrix Fisher part (`None` for Gaussian filters).
    pub matrix_fisher: Option<ProperSvd>,
    /// Normalised innovation squared (NIS) per degree of freedom; about 1 when consistent.
    pub nis: Option<f64>,
    /// What the gate found of the inliers.
    pub gating: Option<Gating>,
    pub counts: StepCounts,
    pub times: StageTimes,
    pub keypoints: Vec<KeypointView>,
    /// All points of the map; filled only when the pipeline is asked to, since it is a copy.
    pub map: Option<Vec<MapPointView>>,
    pub notes: Vec<Note>,
}

/// A map in order of insertion, as of a frame.
pub(super) fn map_views(map: &Map, frame: u64) -> Vec<MapPointView> {
    let view = |point: &MapPoint| MapPointView {
        position: [point.position.x as f32, point.position.y as f32, point.position.z as f32],
        covariance: point.covariance.cast(),
        age: frame.saturating_sub(point.first_seen).try_into().unwrap_or(u32::MAX),
    };
    map.points().iter().map(view).collect()
}
