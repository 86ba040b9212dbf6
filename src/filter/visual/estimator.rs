//! What all visual-inertial filters share: the trait, what it takes and what it returns.

use nalgebra::{Isometry3, Matrix3, Matrix6, Vector3};

use super::body_points::BodyPoints;
use super::calibration::Calibration;
use super::config::MapTreatment;
use super::frame_change::FrameChange;
use super::map_points::{self, MapRefinement};
use super::slam::PoseWindow;
use super::zero_velocity::ZeroVelocity;
use crate::alignment::{MapEstimate, PointPair};
use crate::filter::core::{BayesFilter, FilterError};
use crate::inertial::{Belief, NavCovariance, pose_covariance};
use crate::so3::ProperSvd;

/// A recursive estimator of attitude, velocity, position and IMU biases that is corrected by
/// points measured in the body frame and matched to a map.
///
/// A call that returns an error leaves the belief as it was.
pub trait VisualInertialFilter: BayesFilter {
    /// The current belief, in the concentrated form of W22 Theorem 3.4.
    fn belief(&self) -> &Belief;

    /// Says whether the next samples only stand in for those of a gap in the IMU's data.
    fn set_imu_gap(&mut self, in_gap: bool);

    /// Conditions the belief on matched points of a map that is independent of it.
    fn update_map_points(&mut self, pairs: &[PointPair]) -> Result<PointUpdate, FilterError>;

    /// Conditions the belief on the body standing still.
    fn update_zero_velocity(&mut self, rest: &ZeroVelocity) -> Result<FrameChange, FilterError>;

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

    /// The map points of the state, if the filter keeps any there.
    fn point_state(&self) -> Option<&dyn PointState> {
        None
    }

    /// The same, to be changed.
    fn point_state_mut(&mut self) -> Option<&mut dyn PointState> {
        None
    }

    /// The window of past poses of the state, if the filter keeps one.
    fn pose_window(&self) -> Option<&dyn PoseWindow> {
        None
    }

    /// The same, to be changed.
    fn pose_window_mut(&mut self) -> Option<&mut dyn PoseWindow> {
        None
    }

    /// Takes the camera's calibration into the state. From then on points are to be measured, and
    /// frames timed, by [`Self::calibration`].
    fn calibrate(&mut self, _prior: &Calibration) -> Result<(), FilterError> {
        Err(self.cannot_use("camera calibration"))
    }

    /// The camera's calibration as estimated, if it is.
    fn calibration(&self) -> Option<&Calibration> {
        None
    }
}

impl dyn VisualInertialFilter + '_ {
    /// Covariance of (rotation, position), the blocks that a point measurement sees.
    pub fn pose_covariance(&self) -> Matrix6<f64> {
        pose_covariance(&self.belief().covariance)
    }

    /// A new map point from its measurement in body coordinates (m, m^2).
    pub fn insert(
        &self,
        treatment: MapTreatment,
        in_body: &Vector3<f64>,
        body_covariance: &Matrix3<f64>,
    ) -> MapEstimate {
        let points = self.body_points();
        map_points::insert(self.belief(), &points, treatment, in_body, body_covariance)
    }

    /// What the updated pose says of the map points that it was updated with.
    pub fn map_refinement(&self) -> MapRefinement {
        MapRefinement::new(self.belief(), self.body_points())
    }
}

/// Map points as part of a filter's state, correlated with the pose and with each other.
pub trait PointState {
    /// How many more points may be admitted.
    fn free_slots(&self) -> usize;

    /// The points held, in order of admission.
    fn ids(&self) -> Vec<u64>;

    /// Marginal of a point held.
    fn estimate(&self, id: u64) -> Option<MapEstimate>;

    /// Conditions the belief on points held that were seen again; others are passed over.
    fn update_state_points(
        &mut self,
        seen: &[PointObservation],
    ) -> Result<PointUpdate, FilterError>;

    /// Takes a point into the state by a measurement that the belief does not know of yet. False,
    /// and no change, if there is no room, it is held already, or it is not finite.
    fn admit(&mut self, point: &PointObservation) -> bool;

    /// Takes a point into the state that is known independently of the belief. False, and no
    /// change, as for [`Self::admit`].
    fn admit_known(&mut self, id: u64, estimate: &MapEstimate) -> bool;

    /// Marginalizes a point out: what the belief learned by it stays. False if it is not held.
    fn release(&mut self, id: u64) -> bool;

    /// Reopens the alignment with gravity: takes the accelerometer's bias for one of standard
    /// deviation `accel_bias_sd` (m/s^2), far more than was thought, by which the world was
    /// levelled wrongly. The direction of gravity becomes as uncertain, together with the bias.
    /// False, and no change, without gravity or where its direction is open already.
    fn reopen_gravity(&mut self, accel_bias_sd: f64) -> bool;

    /// Adds the noise of a time stamp with this standard deviation (s) on a moving body.
    fn add_stamp_jitter(&mut self, sd: f64);

    /// Resets the pose after the body was carried off by `way`, in body coordinates, which is known
    /// as well as `spread` says, and leaves it at rest there. Points, biases and calibration stay.
    /// The vertical must be known.
    fn reset_pose(&mut self, way: &Isometry3<f64>, spread: &PoseSpread);
}

/// A map point that a filter's state holds, or is to hold, seen from the body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointObservation {
    pub id: u64,
    /// Body coordinates, m.
    pub in_body: Vector3<f64>,
    /// Covariance of the measurement in body coordinates, m^2.
    pub body_covariance: Matrix3<f64>,
}

/// What an update by points did, besides changing the belief.
#[derive(Debug, Clone, PartialEq)]
pub struct PointUpdate {
    /// Normalised innovation squared (NIS) per degree of freedom of the points that entered;
    /// about 1 when consistent.
    pub nis: f64,
    /// Points that entered.
    pub points: usize,
    pub gating: Gating,
    /// Indices of the points offered that did not enter, ascending.
    pub refused: Vec<usize>,
    pub frame: FrameChange,
}

impl PointUpdate {
    /// Whether the points contradict the prediction, see [`contradicts`].
    pub fn contradicts(&self) -> bool {
        contradicts(self.nis, self.points)
    }
}

/// Whether an NIS per degree of freedom of so many points does not happen by chance, nor by a noise
/// model that is somewhat too small.
pub(super) fn contradicts(nis: f64, points: usize) -> bool {
    const LARGE: f64 = 2.5;
    const DEVIATIONS: f64 = 5.0;
    // Of the mean of the squares of so many normal numbers.
    let deviation = (2.0 / (3.0 * points as f64)).sqrt();
    nis > LARGE.max(1.0 + DEVIATIONS * deviation)
}

/// What the gate found of the points before an update.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gating {
    /// Largest squared Mahalanobis distance of a point from its prediction.
    pub largest: f64,
    /// The distance beyond which points are left out; infinite without a gate, or when it had to
    /// be opened because most points failed it.
    pub threshold: f64,
    /// Points left out.
    pub rejected: usize,
}

/// Standard deviations of each component of pose and velocity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseSpread {
    /// rad.
    pub turn: f64,
    /// m.
    pub shift: f64,
    /// m/s.
    pub velocity: f64,
}
