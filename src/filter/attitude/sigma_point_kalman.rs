//! The unscented Kalman filter of attitude and gyro bias.

use nalgebra::{Matrix3, Matrix3x6, Matrix6, Matrix6x3, Rotation3, SVector, Vector3, Vector6};

use super::super::core::{
    AttitudeMeasurement, BayesFilter, Estimate, FilterError, Frame, InertialStep, VectorEstimate,
    VectorMeasurement,
};
use super::gaussian::{GaussianBelief, joint_covariance};
use super::{AttitudePrior, GyroModel, information_of, symmetric};
use crate::so3::{exp, log};

/// Spread of the sigma points: they lie `sqrt(n + LAMBDA)` standard deviations out (the choice of
/// Crassidis and Markley's unscented filter, 2003).
const LAMBDA: f64 = 1.0;
/// Dimension of (rotation vector, bias).
const N: usize = 6;
const POINTS: usize = 2 * N + 1;
/// Angle from the centre, rad, beyond which a sigma point would come back from the other side and
/// make a belief narrow that is broad; the interval is then linearised.
const LONGEST_REACH: f64 = std::f64::consts::PI;

/// A Gaussian of the body-frame rotation vector and the bias, carried by thirteen sigma points:
/// Crassidis and Markley's filter, with rotation vectors for Rodrigues parameters.
#[derive(Debug, Clone, Copy)]
pub struct AttitudeUkf {
    gyro: GyroModel,
    belief: GaussianBelief,
}

impl AttitudeUkf {
    /// The filter that starts from `prior`.
    pub fn new(gyro: &GyroModel, prior: &AttitudePrior) -> Result<Self, FilterError> {
        super::requires_body_rate(gyro)?;
        Ok(Self { gyro: *gyro, belief: GaussianBelief::new(Frame::Body, prior)? })
    }

    /// Deviations of the sigma points, the centre first.
    fn deviations(&self, covariance: &Matrix6<f64>) -> Result<[Vector6<f64>; POINTS], FilterError> {
        let factor = covariance.cholesky().ok_or(FilterError::NotPositive("covariance"))?;
        let root = factor.l() * (N as f64 + LAMBDA).sqrt();
        Ok(std::array::from_fn(|i| match i {
            0 => Vector6::zeros(),
            i if i <= N => root.column(i - 1).into_owned(),
            i => -root.column(i - 1 - N),
        }))
    }

    /// Conditions on one three-dimensional measurement, given what each sigma point predicts of
    /// it less what was measured.
    fn correct(
        &mut self,
        deviations: &[Vector6<f64>; POINTS],
        residuals: &[Vector3<f64>; POINTS],
        noise: &Matrix3<f64>,
    ) -> Result<Vector6<f64>, FilterError> {
        let mean = weighted_mean(residuals);
        let (mut innovation, mut cross) = (*noise, Matrix6x3::zeros());
        for (i, (deviation, residual)) in deviations.iter().zip(residuals).enumerate() {
            let residual = residual - mean;
            innovation += residual * residual.transpose() * weight(i);
            cross += deviation * residual.transpose() * weight(i);
        }
        let inverse = innovation.try_inverse();
        let gain = cross * inverse.ok_or(FilterError::NotPositive("innovation covariance"))?;
        let covariance = self.belief.covariance - gain * innovation * gain.transpose();
        let covariance = 0.5 * (covariance + covariance.transpose());
        covariance.cholesky().ok_or(FilterError::NotPositive("posterior covariance"))?;
        let correction = -gain * mean;
        super::finite("correction", &[correction.norm_squared()])?;
        self.belief.covariance = covariance;
        Ok(correction)
    }
}

fn weight(i: usize) -> f64 {
    let total = N as f64 + LAMBDA;
    if i == 0 { LAMBDA / total } else { 0.5 / total }
}

fn weighted_mean<const D: usize>(values: &[SVector<f64, D>; POINTS]) -> SVector<f64, D> {
    values.iter().enumerate().map(|(i, v)| v * weight(i)).sum()
}

fn rotation_part(deviation: &Vector6<f64>) -> Rotation3<f64> {
    exp(&deviation.fixed_rows::<3>(0).into_owned())
}

impl BayesFilter for AttitudeUkf {
    fn name(&self) -> &'static str {
        "ukf"
    }

    /// By sigma points; where they would reach too far, linearised.
    fn propagate(&mut self, step: &InertialStep) -> Result<(), FilterError> {
        step.check()?;
        let h = step.seconds;
        let half = joint_covariance(&(self.gyro.angle_covariance(step) * 0.5), &Matrix3::zeros());
        let deviations = self.deviations(&(self.belief.covariance + half))?;
        let reach =
            |d: &Vector6<f64>| d.fixed_rows::<3>(0).norm() + d.fixed_rows::<3>(3).norm() * h;
        if deviations.iter().any(|d| reach(d) > LONGEST_REACH) {
            return self.belief.propagate(&self.gyro, step);
        }
        let turned = |d: &Vector6<f64>| {
            let rate = step.angular_velocity - self.belief.bias - d.fixed_rows::<3>(3);
            rotation_part(d) * exp(&(rate * h))
        };
        let centre = turned(&deviations[0]);
        let propagated = deviations.map(|d| {
            let error = log(&(centre.inverse() * turned(&d)));
            let mut deviation = d;
            deviation.fixed_rows_mut::<3>(0).copy_from(&error);
            deviation
        });
        let mean = weighted_mean(&propagated);
        let mut covariance = half;
        for (i, deviation) in propagated.iter().enumerate() {
            let deviation = deviation - mean;
            covariance += deviation * deviation.transpose() * weight(i);
        }
        covariance += joint_covariance(&Matrix3::zeros(), &(self.gyro.bias_walk * h));
        covariance.cholesky().ok_or(FilterError::NotPositive("covariance"))?;
        let attitude = self.belief.attitude * centre;
        super::finite_belief(&attitude, covariance.as_slice())?;
        self.belief.attitude = attitude;
        self.belief.covariance = 0.5 * (covariance + covariance.transpose());
        self.belief.apply(&mean);
        Ok(())
    }

    fn update_attitude(&mut self, measured: &AttitudeMeasurement) -> Result<(), FilterError> {
        measured.check()?;
        // Linear in the rotation vector: axis by axis in the principal frame of the noise, so
        // that an axis of which nothing is measured does not matter.
        let information = information_of(&symmetric(&measured.noise)).symmetric_eigen();
        let residual = log(&(self.belief.attitude.inverse() * measured.world_from_body));
        let axes = information.eigenvectors.transpose();
        let mut by_state = Matrix3x6::zeros();
        by_state.fixed_columns_mut::<3>(0).copy_from(&axes);
        let variance = information.eigenvalues.map(|a| a.max(1e-9).recip());
        let deviations = self.deviations(&self.belief.covariance)?;
        let residuals = deviations.map(|d| by_state * d - axes * residual);
        let noise = Matrix3::from_diagonal(&variance);
        let correction = self.correct(&deviations, &residuals, &noise)?;
        self.belief.apply(&correction);
        Ok(())
    }

    fn update_directions(&mut self, measured: &[VectorMeasurement]) -> Result<(), FilterError> {
        let before = *self;
        for m in measured {
            let corrected = m.check().and_then(|()| {
                let deviations = self.deviations(&self.belief.covariance)?;
                let residuals = deviations.map(|d| {
                    let attitude = self.belief.attitude * rotation_part(&d);
                    match m.measured_in {
                        Frame::Body => attitude.inverse() * m.in_world - m.in_body,
                        Frame::World => attitude * m.in_body - m.in_world,
                    }
                });
                self.correct(&deviations, &residuals, &m.covariance)
            });
            match corrected {
                Ok(correction) => self.belief.apply(&correction),
                Err(error) => {
                    *self = before;
                    return Err(error);
                }
            }
        }
        Ok(())
    }

    fn update_gyro_bias(&mut self, measured: &VectorEstimate) -> Result<(), FilterError> {
        self.belief.condition_on_bias(measured)
    }

    fn attitude(&self) -> Rotation3<f64> {
        self.belief.attitude
    }

    fn gyro_bias(&self) -> Option<Vector3<f64>> {
        Some(self.belief.bias)
    }

    fn is_gaussian(&self) -> bool {
        true
    }

    fn estimate(&self) -> Estimate {
        self.belief.estimate()
    }
}
