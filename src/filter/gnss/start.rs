use nalgebra::{Matrix3, Vector3};

use super::belief::{
    ACCEL_BIAS, Euclidean, EuclideanCovariance, GYRO_BIAS, NavigationBelief, POSITION, Slope,
    VELOCITY,
};
use crate::distribution::matrix_fisher::MatrixFisher;
use crate::filter::FilterError;
use crate::inertial::{Belief, NavCovariance, NavState, block};

/// Variance that stands for an unknown heading in a Gaussian filter, rad^2 (W22 5.1.4).
const UNKNOWN_HEADING_VARIANCE: f64 = 1000.0;

/// What is known at the start; the blocks are independent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InitialBelief {
    pub state: NavState,
    /// Standard deviation of the rotation error about each horizontal axis, rad.
    pub tilt_sd: f64,
    /// The same about the vertical; `None` if any heading is as likely as any other.
    pub heading_sd: Option<f64>,
    /// Per axis, m/s.
    pub velocity_sd: f64,
    /// Per axis, m.
    pub position_sd: f64,
    /// Per axis, rad/s.
    pub gyro_bias_sd: f64,
    /// Per axis, m/s^2.
    pub accel_bias_sd: f64,
}

impl InitialBelief {
    /// `tilt` on the horizontal axes and `heading` on the vertical, in the body frame.
    fn about_vertical(&self, tilt: f64, heading: f64) -> Matrix3<f64> {
        let up = self.state.world_from_body.rotation.inverse() * Vector3::z();
        let vertical = up * up.transpose();
        (Matrix3::identity() - vertical) * tilt + vertical * heading
    }

    fn variances(&self) -> [(usize, f64); 4] {
        [
            (VELOCITY, self.velocity_sd.powi(2)),
            (POSITION, self.position_sd.powi(2)),
            (GYRO_BIAS, self.gyro_bias_sd.powi(2)),
            (ACCEL_BIAS, self.accel_bias_sd.powi(2)),
        ]
    }

    fn check(&self) -> Result<(), FilterError> {
        let sds = [
            self.tilt_sd,
            self.heading_sd.unwrap_or(1.0),
            self.velocity_sd,
            self.position_sd,
            self.gyro_bias_sd,
            self.accel_bias_sd,
        ];
        if !self.state.is_finite() || !sds.iter().all(|sd| sd.is_finite()) {
            return Err(FilterError::NotFinite("initial belief"));
        }
        if sds.iter().all(|sd| *sd > 0.0) {
            Ok(())
        } else {
            Err(FilterError::NotPositive("covariance of the initial belief"))
        }
    }

    pub(super) fn matrix_fisher_gaussian(&self) -> Result<NavigationBelief, FilterError> {
        self.check()?;
        let heading = self.heading_sd.map_or(0.0, |sd| sd.powi(-2));
        let attitude = MatrixFisher::from_mode_and_information(
            self.state.world_from_body.rotation.to_rotation_matrix(),
            self.about_vertical(self.tilt_sd.powi(-2), heading),
        )?;
        let mut mean = Euclidean::zeros();
        let mut part = |start: usize, value: &Vector3<f64>| {
            mean.fixed_rows_mut::<3>(start).copy_from(value);
        };
        part(VELOCITY, &self.state.velocity);
        part(POSITION, &self.state.world_from_body.translation.vector);
        part(GYRO_BIAS, &self.state.gyro_bias);
        part(ACCEL_BIAS, &self.state.accel_bias);
        let mut conditional = EuclideanCovariance::zeros();
        for (start, variance) in self.variances() {
            conditional.fixed_view_mut::<3, 3>(start, start).fill_diagonal(variance);
        }
        Ok(NavigationBelief { attitude, mean, slope: Slope::zeros(), conditional })
    }

    pub(super) fn gaussian(&self) -> Result<Belief, FilterError> {
        self.check()?;
        let heading = self.heading_sd.map_or(UNKNOWN_HEADING_VARIANCE, |sd| sd.powi(2));
        let mut covariance = NavCovariance::zeros();
        covariance
            .fixed_view_mut::<3, 3>(block::ROTATION, block::ROTATION)
            .copy_from(&self.about_vertical(self.tilt_sd.powi(2), heading));
        for (start, variance) in self.variances() {
            let start = start + block::VELOCITY;
            covariance.fixed_view_mut::<3, 3>(start, start).fill_diagonal(variance);
        }
        Ok(Belief { state: self.state, covariance })
    }
}
