//! What all visual-inertial filters share: the trait, the map treatment, the point posteriors.

mod body_points;
mod broad;
mod calibration;
mod gate;
mod gravity;
mod handover;
mod mekf;
mod mfg;
mod regression;
mod rest;
mod selection;
mod slam;

use std::fmt;
use std::str::FromStr;

use nalgebra::{Isometry3, Matrix3, Matrix6, Rotation3, SMatrix, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::alignment::{MapEstimate, PointPair, PoseInformation, RobustKernel};
use crate::distribution::matrix_fisher::MatrixFisher;
use crate::inertial::{Belief, NavCovariance, Propagator, block, pose_covariance};
use crate::sensor::ImuSample;
use crate::so3::ProperSvd;

pub use body_points::BodyPoints;
pub use calibration::{Calibration, calibration_block};
use handover::HandOver;
pub use mekf::Mekf;
pub use mfg::MfgFilter;
pub use regression::Coordinates;
pub use rest::Rest;
pub use selection::{Candidate, choose_points};
pub use slam::SlamFilter;

/// What the filter assumes of map points once they are in the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MapTreatment {
    /// A point stays where it was inserted (`mfgd`, `mekfd`; W22 5.2.1).
    Fixed,
    /// A point is a Gaussian of its own, independent of the pose, and every measurement refines
    /// it (`mfgr`, `mekfr`; W22 5.2.3).
    Uncertain,
    /// Points in use are part of the filter's state (`mfgs`, `mekfs`); the others, out of which
    /// they are chosen, are treated as uncertain and do not touch the belief.
    Correlated,
}

/// The filters of `replay --filter`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FilterKind {
    Mfgd,
    Mfgr,
    #[default]
    Mfgs,
    Mekfd,
    Mekfr,
    Mekfs,
}

impl FilterKind {
    pub const ALL: [Self; 6] =
        [Self::Mfgr, Self::Mfgd, Self::Mfgs, Self::Mekfr, Self::Mekfd, Self::Mekfs];

    pub fn name(self) -> &'static str {
        match self {
            Self::Mfgd => "mfgd",
            Self::Mfgr => "mfgr",
            Self::Mfgs => "mfgs",
            Self::Mekfd => "mekfd",
            Self::Mekfr => "mekfr",
            Self::Mekfs => "mekfs",
        }
    }

    pub fn map_treatment(self) -> MapTreatment {
        match self {
            Self::Mfgd | Self::Mekfd => MapTreatment::Fixed,
            Self::Mfgr | Self::Mekfr => MapTreatment::Uncertain,
            Self::Mfgs | Self::Mekfs => MapTreatment::Correlated,
        }
    }

    /// A filter of this kind that starts from `belief`.
    pub fn start(
        self,
        config: &FilterConfig,
        propagator: Propagator,
        belief: Belief,
    ) -> Box<dyn VisualInertialFilter> {
        match self {
            Self::Mfgd | Self::Mfgr => Box::new(MfgFilter::new(config, propagator, belief)),
            Self::Mekfd | Self::Mekfr => Box::new(Mekf::new(config, propagator, belief)),
            Self::Mfgs => Box::new(SlamFilter::new(config, Coordinates::Group, propagator, belief)),
            Self::Mekfs => {
                Box::new(SlamFilter::new(config, Coordinates::Additive, propagator, belief))
            }
        }
    }

    /// The same where the attitude is too uncertain for a covariance: the MFG filters start from
    /// `attitude`, independent of the rest of `belief`; the Gaussian ones from `belief` alone.
    pub fn start_broad(
        self,
        config: &FilterConfig,
        propagator: Propagator,
        belief: Belief,
        attitude: &MatrixFisher,
    ) -> Box<dyn VisualInertialFilter> {
        match self {
            Self::Mfgd | Self::Mfgr => {
                Box::new(MfgFilter::broad(config, propagator, belief, attitude))
            }
            Self::Mfgs => Box::new(HandOver::new(config, propagator, belief, attitude)),
            Self::Mekfd | Self::Mekfr | Self::Mekfs => self.start(config, propagator, belief),
        }
    }
}

impl FilterKind {
    /// A filter of this kind that starts from `belief`, of whose attitude only `known` is known.
    ///
    /// Filters that hold no density but a Gaussian get the variance of what is unknown.
    pub fn start_knowing(
        self,
        known: KnownAttitude,
        config: &FilterConfig,
        propagator: Propagator,
        mut belief: Belief,
    ) -> Box<dyn VisualInertialFilter> {
        let slam =
            |propagator, belief| SlamFilter::new(config, Coordinates::Group, propagator, belief);
        match (self, known) {
            (_, KnownAttitude::All) => self.start(config, propagator, belief),
            (Self::Mfgs, KnownAttitude::Vertical) => {
                Box::new(slam(propagator, belief).with_free_heading())
            }
            (Self::Mfgs, KnownAttitude::Nothing { gravity }) => {
                Box::new(slam(propagator, belief).with_unknown_gravity(gravity))
            }
            (_, KnownAttitude::Vertical) => self.start(config, propagator, belief),
            (_, KnownAttitude::Nothing { .. }) => {
                belief
                    .covariance
                    .fixed_view_mut::<3, 3>(block::ROTATION, block::ROTATION)
                    .copy_from(&(Matrix3::identity() * gravity::UNIFORM_VARIANCE));
                self.start(config, propagator, belief)
            }
        }
    }
}

/// What is known of the attitude at the start.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum KnownAttitude {
    /// Heading and vertical, as well as the belief says.
    All,
    /// The vertical; the world's heading is arbitrary.
    Vertical,
    /// Nothing: the belief is in the frame of the body, where gravity (magnitude, m/s^2) has any
    /// direction.
    Nothing { gravity: f64 },
}

impl fmt::Display for FilterKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for FilterKind {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Self::ALL.into_iter().find(|kind| kind.name() == text).ok_or_else(|| {
            let names: Vec<_> = Self::ALL.iter().map(|kind| kind.name()).collect();
            format!("unknown filter `{text}`; there are: {}", names.join(", "))
        })
    }
}

/// How an MFG filter finds the matrix Fisher distribution of the attitude after an update.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum UpdateMethod {
    /// By mode and curvature of the exact marginal density where it is concentrated, by its mean
    /// elsewhere.
    Exact,
    /// By reweighting seven sigma points progressively (W22 tables 5.8, 5.13).
    SigmaPoints,
}

/// Settings of the measurement update and of the initial uncertainty.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FilterConfig {
    /// Mahalanobis distance beyond which the weight of a point falls (Huber); 0: never.
    pub huber: f64,
    /// Probability with which a point that fits the model passes the gate on its squared
    /// Mahalanobis distance (chi-square, 3 degrees of freedom); 0: no gate.
    pub gate_probability: f64,
    /// How the MFG filters match the attitude after an update.
    pub update_method: UpdateMethod,
    /// Times the attitude is re-linearised within one update of the MFG filters.
    pub relinearizations: usize,
    /// Factor on the covariance of every point measurement, for what the sensor model leaves out
    /// (errors shared by neighbouring points).
    pub measurement_inflation: f64,
    /// Most map points in the state of `mfgs` and `mekfs`.
    pub state_points: usize,
    /// Frames that a point must have been seen in to enter the state, while there are such.
    pub state_min_observations: u32,
    /// Points of the state not seen for more than this many frames make room for others.
    pub state_max_unseen_frames: u64,
    /// Standard deviation of the initial velocity, m/s.
    pub velocity_sd: f64,
    /// Standard deviation of the initial position, m.
    pub position_sd: f64,
    /// Standard deviation of the initial roll and pitch from a standing start, degrees.
    pub tilt_sd_deg: f64,
    /// The same from the mean of a moving start, degrees.
    pub moving_tilt_sd_deg: f64,
    /// Standard deviation of the initial heading, degrees.
    pub heading_sd_deg: f64,
    /// Standard deviation of each velocity component after a moving start, m/s.
    pub moving_velocity_sd: f64,
    /// Standard deviation about each axis of the configured rotation between camera and IMU,
    /// degrees. Above 0 `mfgs` and `mekfs` estimate it while running; so with the next two.
    pub camera_rotation_sd_deg: f64,
    /// The same of each component of the translation between them, m.
    pub camera_translation_sd: f64,
    /// The same of the offset between their clocks, s.
    pub camera_time_offset_sd: f64,
    /// White angular acceleration of the constant-velocity model (no IMU), rad/s^2/sqrt(Hz).
    pub angular_acceleration: f64,
    /// White acceleration of the constant-velocity model (no IMU), m/s^2/sqrt(Hz).
    pub acceleration: f64,
    /// Standard deviation of the initial angular velocity of the constant-velocity model, rad/s.
    pub angular_velocity_sd: f64,
}

impl Default for FilterConfig {
    fn default() -> Self {
        Self {
            huber: 2.0,
            gate_probability: 0.999_999,
            update_method: UpdateMethod::Exact,
            relinearizations: 2,
            measurement_inflation: 1.0,
            state_points: 100,
            state_min_observations: 5,
            state_max_unseen_frames: 5,
            velocity_sd: 0.1,
            position_sd: 1e-3,
            tilt_sd_deg: 1.0,
            moving_tilt_sd_deg: 5.0,
            heading_sd_deg: 0.1,
            moving_velocity_sd: 1.0,
            camera_rotation_sd_deg: 0.0,
            camera_translation_sd: 0.0,
            camera_time_offset_sd: 0.0,
            angular_acceleration: 3.0,
            acceleration: 3.0,
            angular_velocity_sd: 1.0,
        }
    }
}

impl FilterConfig {
    /// Whether improbable points are left out.
    pub fn has_gate(&self) -> bool {
        self.gate_probability > 0.0 && self.gate_probability < 1.0
    }

    pub(super) fn kernel(&self) -> RobustKernel {
        if self.huber > 0.0 {
            RobustKernel::Huber { scale: self.huber }
        } else {
            RobustKernel::None
        }
    }
}

/// What an update did, besides changing the belief.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UpdateOutcome {
    /// Squared normalised innovation per degree of freedom of the points that entered; about 1
    /// when consistent.
    pub innovation: f64,
    /// Pairs that entered.
    pub points: usize,
    pub screening: Screening,
}

impl UpdateOutcome {
    /// Whether the points contradict the prediction: an innovation that does not happen by chance,
    /// nor by a noise model that is somewhat too small.
    pub fn contradicts(&self) -> bool {
        const LARGE: f64 = 2.5;
        const DEVIATIONS: f64 = 5.0;
        // Of the mean of the squares of so many normal numbers.
        let deviation = (2.0 / (3.0 * self.points as f64)).sqrt();
        self.innovation > LARGE.max(1.0 + DEVIATIONS * deviation)
    }
}

/// What the gate found of the points before an update.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Screening {
    /// Largest squared Mahalanobis distance of a point from its prediction.
    pub largest: f64,
    /// The distance beyond which points are left out; infinite without a gate, or when it had to
    /// be opened because most points failed it.
    pub threshold: f64,
    /// Points left out.
    pub rejected: usize,
}

/// A recursive estimator of attitude, velocity, position and IMU biases that is corrected by
/// points measured in the body frame and matched to a map.
pub trait VisualInertialFilter: Send {
    /// The current belief, in the concentrated form of W22 Theorem 3.4.
    fn belief(&self) -> &Belief;

    /// Moves the belief from the time of `from` to that of `to`. False, and no change, if no
    /// finite belief follows from the samples.
    fn propagate(&mut self, from: &ImuSample, to: &ImuSample) -> bool;

    /// Says whether the next samples only stand in for those of a gap in the IMU's data.
    fn set_imu_gap(&mut self, in_gap: bool);

    /// Moves the belief on by `seconds` without an IMU.
    fn coast(&mut self, seconds: f64);

    /// Conditions the belief on matched points. `None`, and no change, without points or if no
    /// finite belief follows from them.
    fn update(&mut self, pairs: &[PointPair]) -> Option<UpdateOutcome>;

    /// Conditions the belief on the body standing still. False, and no change, if no finite belief
    /// follows.
    fn rest(&mut self, rest: &Rest) -> bool;

    /// Takes the accelerometer's bias for one of standard deviation `accel_bias_sd` (m/s^2), far
    /// more than was thought, by which the world was levelled wrongly: the direction of gravity
    /// becomes as uncertain, together with the bias. False, and no change, if the filter cannot
    /// estimate it or already does.
    fn doubt_levelling(&mut self, _accel_bias_sd: f64) -> bool {
        false
    }

    /// For each pair offered to the last update whether it passed the gate.
    fn passed(&self) -> &[bool];

    /// Parameter of the attitude's matrix Fisher part, if the filter has one.
    fn matrix_fisher(&self) -> Option<ProperSvd>;

    /// Where the belief has points that are fixed in the body.
    fn body_points(&self) -> BodyPoints {
        BodyPoints::of_belief(self.belief())
    }

    /// Covariance of the belief in an upright world, its heading being that of the state. Differs
    /// from that of [`Self::belief`] while it is not known which way is up.
    fn reported_covariance(&self) -> NavCovariance {
        self.belief().covariance
    }

    /// Whether the world is upright: false while the filter still looks for the direction of
    /// gravity in a world of its own.
    fn knows_vertical(&self) -> bool {
        true
    }

    /// The turn of the world about its origin since the last call, if it was turned: whatever is
    /// kept in world coordinates outside of the filter must follow.
    fn take_world_turn(&mut self) -> Option<UnitQuaternion<f64>> {
        None
    }

    /// The map points of the state, if the filter keeps any there.
    fn point_state(&mut self) -> Option<&mut dyn PointState> {
        None
    }

    /// Takes the camera's calibration into the state. From then on points are to be measured, and
    /// frames timed, by [`Self::calibration`]. False, and no change, if the filter cannot estimate
    /// it or already does.
    fn calibrate(&mut self, _prior: &Calibration) -> bool {
        false
    }

    /// The camera's calibration as estimated, if it is.
    fn calibration(&self) -> Option<&Calibration> {
        None
    }
}

/// A map point that a filter's state holds, or is to hold, seen from the body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeenPoint {
    pub id: u64,
    /// Body coordinates, m.
    pub in_body: Vector3<f64>,
    /// Covariance of the measurement in body coordinates, m^2.
    pub body_covariance: Matrix3<f64>,
}

/// Map points as part of a filter's state, correlated with the pose and with each other.
pub trait PointState {
    /// How many more points may be admitted.
    fn free_slots(&self) -> usize;

    /// The points held, in order of admission.
    fn ids(&self) -> Vec<u64>;

    /// Marginal of a point held.
    fn estimate(&self, id: u64) -> Option<MapEstimate>;

    /// Conditions the belief on points held that were seen again; others are passed over. `None`,
    /// and no change, without points or if no finite belief follows from them.
    fn measure(&mut self, seen: &[SeenPoint]) -> Option<UpdateOutcome>;

    /// Takes a point into the state by a measurement that the belief does not know of yet. False,
    /// and no change, if there is no room, it is held already, or it is not finite.
    fn admit(&mut self, point: &SeenPoint) -> bool;

    /// Takes a point into the state that is known independently of the belief. False, and no
    /// change, as for [`Self::admit`].
    fn admit_known(&mut self, id: u64, estimate: &MapEstimate) -> bool;

    /// Marginalizes a point out: what the belief learned by it stays. False if it is not held.
    fn release(&mut self, id: u64) -> bool;

    /// Takes the time of the belief to be uncertain by this standard deviation (s), while the body moves
    /// on.
    fn blur_time(&mut self, sd: f64);

    /// Moves the body by `way`, in body coordinates, which is known as well as `spread` says, and leaves
    /// it at rest there. Points, biases and calibration stay. The vertical must be known.
    fn carry_off(&mut self, way: &Isometry3<f64>, spread: &MotionSpread);
}

/// Standard deviations of each component of pose and velocity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionSpread {
    /// rad.
    pub turn: f64,
    /// m.
    pub shift: f64,
    /// m/s.
    pub velocity: f64,
}

impl dyn VisualInertialFilter + '_ {
    /// Covariance of (rotation, position), the blocks that a point measurement sees.
    pub fn pose_covariance(&self) -> Matrix6<f64> {
        pose_covariance(&self.belief().covariance)
    }

    /// A new map point from its measurement, by W22 (5.84), (5.85).
    ///
    /// For [`MapTreatment::Fixed`] the covariance is that of the measurement alone.
    pub fn insert(
        &self,
        treatment: MapTreatment,
        in_body: &Vector3<f64>,
        body_covariance: &Matrix3<f64>,
    ) -> MapEstimate {
        let rotation = self.belief().state.world_from_body.rotation.to_rotation_matrix();
        let measured = rotation.matrix() * body_covariance * rotation.matrix().transpose();
        let seen = self.body_points().at(in_body);
        let covariance = match treatment {
            MapTreatment::Fixed => measured,
            MapTreatment::Uncertain | MapTreatment::Correlated => measured + seen.covariance,
        };
        MapEstimate { position: seen.position, covariance }
    }

    /// What the updated pose says of the map points that it was updated with.
    pub fn map_refinement(&self) -> MapRefinement {
        let world_from_body = self.belief().state.world_from_body.rotation.to_rotation_matrix();
        MapRefinement { world_from_body, seen: self.body_points() }
    }
}

/// Posteriors of map points given one pose, see [`MapEstimate::posterior`].
#[derive(Debug, Clone, Copy)]
pub struct MapRefinement {
    world_from_body: Rotation3<f64>,
    seen: BodyPoints,
}

impl MapRefinement {
    /// Posterior of the map point of `pair`; `None` if the pair has no positive definite
    /// covariance.
    pub fn posterior(&self, pair: &PointPair) -> Option<MapEstimate> {
        MapEstimate::posterior(pair, &self.world_from_body, &self.seen.at(&pair.in_body))
    }
}

/// Derivative of `R p' + t` by (body-frame rotation error, position), 3x6.
pub fn point_by_pose(rotation: &Matrix3<f64>, in_body: &Vector3<f64>) -> SMatrix<f64, 3, 6> {
    let mut j = SMatrix::<f64, 3, 6>::zeros();
    j.fixed_view_mut::<3, 3>(0, 0).copy_from(&-(rotation * in_body.cross_matrix()));
    j.fixed_view_mut::<3, 3>(0, 3).copy_from(&Matrix3::identity());
    j
}

/// Squared normalised innovation per degree of freedom of `information` against the prior:
/// `(r^T W r - b^T P (I + Lambda P)^-1 b) / 3N`, the matrix inversion lemma's form of
/// `r^T (W^-1 + H P H^T)^-1 r`, so that it costs the same for any number of points.
pub(super) fn normalized_innovation(information: &PoseInformation, belief: &Belief) -> Option<f64> {
    let pose = &belief.state.world_from_body;
    let rotation = pose.rotation.to_rotation_matrix();
    let (lambda, vector) = information.linearized(&rotation);
    let prior = pose_covariance(&belief.covariance);
    let explained = prior * (Matrix6::identity() + lambda * prior).lu().solve(&vector)?;
    let total = information.cost(&rotation, &pose.translation.vector);
    let dof = 3.0 * information.points as f64;
    Some((total - vector.dot(&explained)).max(0.0) / dof)
}
