//! Settings of the visual-inertial filters.

use serde::{Deserialize, Serialize};

use crate::alignment::RobustKernel;

/// What the filter assumes of map points once they are in the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MapTreatment {
    /// A point stays where it was inserted (`mfgd`, `mekfd`; W22 5.2.1).
    Fixed,
    /// A point is a Gaussian of its own, independent of the pose, and every measurement refines
    /// it (`mfgr`, `mekfr`; W22 5.2.3).
    Uncertain,
    /// Points in use are part of the filter's state (`mfgs`, `iekfs`, `mekfs`); the others, out of which
    /// they are chosen, are treated as uncertain and do not touch the belief.
    Correlated,
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
    /// Most map points in the state of `mfgs`, `iekfs` and `mekfs`.
    pub state_points: usize,
    /// Frames that a point must have been seen in to enter the state, while there are such.
    pub state_min_observations: u32,
    /// Points of the state not seen for more than this many frames make room for others.
    pub state_max_unseen_frames: u64,
    /// Past poses that `mfgs`, `iekfs` and `mekfs` keep in their state for tracks; below 2 tracks are
    /// not used.
    pub track_poses: usize,
    /// A pose is kept where tracks have moved by so much, in the median, since the last one that was,
    /// pixels.
    pub track_shift: f64,
    /// Or after this time, s.
    pub track_interval: f64,
    /// Most points of tracks in the state; they take slots of `state_points` that the map leaves free.
    pub track_points: usize,
    /// Most rows of tracks, after elimination of their points, in one update.
    pub track_rows: usize,
    /// Probability with which a track that fits the model is taken for improbable (chi-square of
    /// its rows); 0: never.
    pub track_false_alarm: f64,
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
    /// degrees. Above 0 `mfgs`, `iekfs` and `mekfs` estimate it while running; so with the next two.
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
            track_poses: 10,
            track_shift: 10.0,
            track_interval: 0.25,
            track_points: 30,
            track_rows: 150,
            track_false_alarm: 1e-3,
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
