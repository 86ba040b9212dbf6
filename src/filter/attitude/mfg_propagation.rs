//! Moment propagation of a matrix Fisher-Gaussian belief of attitude and gyro bias through the
//! gyroscope kinematics: theorems 4.5 and 4.6 of W22 without appendix E.
//!
//! Everything is linear in `r = vec(Q)`, the attitude in principal axes: `v_R = C^T r`, and given
//! the attitude the rotation over the step is `exp(d^) exp(h (w - mu)^)` with a small Gaussian `d`
//! whose mean is linear in `v_R`. To second order in `d`'s standard deviation the propagated `r`
//! is therefore quadratic in `r`, and every moment that theorem 3.6 asks for is a contraction of
//! the moments of `Q` up to order three with 9-vectors. In the first order in `d` the left
//! Jacobian makes this exact for any angle `h |w|`.

use nalgebra::{Const, Matrix3, Rotation3, SMatrix, U3, Vector3};

use super::super::core::{FilterError, InertialStep};
use super::super::third_moments::{ThirdMoments, Vector9};
use super::GyroModel;
use super::mean::PolarMean;
use crate::distribution::matrix_fisher::{
    MatrixFisher, MatrixFisherError, Moments, s_from_complement_near,
};
use crate::distribution::matrix_fisher_gaussian::{
    ConditionalMoments, Correlation, MatrixFisherGaussian,
};
use crate::so3::{ProperSvd, exp, hat, left_jacobian};

pub type Belief = MatrixFisherGaussian<Const<3>>;

/// Three linear functionals of `vec(Q)`, a column each.
type Forms = SMatrix<f64, 9, 3>;

/// `v_R` as functionals of `vec(Q)`.
pub(super) fn deviation_forms(correlation: Correlation, s: &Vector3<f64>) -> Forms {
    correlation.central_regression(s).transpose()
}

/// The functionals `<U C_i V^T, Q>` of the matrices `C_i` that `forms` holds.
pub(super) fn turned_forms(forms: &Forms, u: &Matrix3<f64>, v: &Matrix3<f64>) -> Forms {
    map_forms(forms, |c| u * c * v.transpose())
}

fn map_forms(forms: &Forms, f: impl Fn(Matrix3<f64>) -> Matrix3<f64>) -> Forms {
    let mut mapped = Forms::zeros();
    for i in 0..3 {
        let c = f(Matrix3::from_column_slice(forms.column(i).as_slice()));
        mapped.column_mut(i).copy_from_slice(c.as_slice());
    }
    mapped
}

/// The matrix of which `v` is the vector.
fn matrix(v: &Vector9) -> Matrix3<f64> {
    Matrix3::from_column_slice(v.as_slice())
}

/// `vec(E[Q])`.
pub(super) fn first_vector(moments: &Moments) -> Vector9 {
    let mut r = Vector9::zeros();
    for (i, d) in moments.first().iter().enumerate() {
        r[4 * i] = *d;
    }
    r
}

/// The belief one interval later.
pub(super) fn propagate(
    belief: &Belief,
    gyro: &GyroModel,
    step: &InertialStep,
) -> Result<Belief, FilterError> {
    let h = step.seconds;
    let ProperSvd { u, s, v } = *belief.attitude().svd();
    let moments = belief.attitude().moments();
    let (p, sigma_c) = (belief.p(), belief.conditional_covariance());
    let angle = (step.angular_velocity - belief.mu()) * h;
    let jacobian = left_jacobian(&angle);
    // In principal axes d = slope v_R + noise, noise ~ N(0, scatter).
    let to_axes = v.matrix().transpose() * jacobian;
    let slope = to_axes * p * -h;
    let scatter = to_axes * (gyro.angle_covariance(step) + sigma_c * (h * h)) * to_axes.transpose();
    let loss = 0.5 * (Matrix3::from_diagonal_element(scatter.trace()) - scatter);

    // d = by_r^T r + noise, and what its mean makes of the moments: E[d_l r r^T].
    let by_r = deviation_forms(belief.correlation(), &s) * slope.transpose();
    let second = moments.second_matrix();
    let third = ThirdMoments::of(moments);
    let with_rate = [0, 1, 2].map(|l| third.weighted(&by_r.column(l).into_owned()));
    let complement = Matrix3::from_diagonal(&moments.complement());
    let mut x = complement + loss - complement * loss;
    for (l, weighted) in with_rate.iter().enumerate() {
        let axis = hat(&Vector3::ith(l, 1.0));
        x -= matrix(&(second * by_r.column(l))) * axis;
        for m in 0..3 {
            x -= matrix(&(weighted * by_r.column(m))) * axis * hat(&Vector3::ith(m, 0.5));
        }
    }
    let mean = PolarMean::from_deviation(&Rotation3::identity(), &x)?.principal();
    let (turn_u, turn_v) = (mean.axes_in_world, mean.axes_in_body());
    let s_next =
        s_from_complement_near(&mean.complement, moments).map_err(MatrixFisherError::from)?;
    let svd = ProperSvd { u: u * turn_u, s: s_next, v: exp(&-angle) * v * turn_v };
    let attitude = MatrixFisher::from_svd(svd).map_err(MatrixFisherError::from)?;

    // v_R+ = kept^T r + sum_c d_c (rates_c^T r), with the same order of d as the mean above.
    let next = turned_forms(
        &deviation_forms(belief.correlation(), &s_next),
        turn_u.matrix(),
        turn_v.matrix(),
    );
    let kept = map_forms(&next, |c| c * (Matrix3::identity() - loss));
    let rates: [Forms; 3] = std::array::from_fn(|axis| {
        let generator = hat(&Vector3::ith(axis, 1.0));
        map_forms(&next, |c| c * generator.transpose())
    });
    let mut turned = Forms::zeros();
    for (weighted, rate) in with_rate.iter().zip(&rates) {
        turned += weighted * rate;
    }
    let mixed = kept.transpose() * turned;
    let mut deviation_covariance = kept.transpose() * second * kept + mixed + mixed.transpose();
    let mut drift = Matrix3::zeros();
    for (c, rate) in rates.iter().enumerate() {
        let weighted = second * rate;
        for (d, other) in rates.iter().enumerate() {
            deviation_covariance += other.transpose() * weighted * scatter[(d, c)];
        }
        drift.row_mut(c).copy_from(&(first_vector(moments).transpose() * rate));
    }
    // Noise of the bias given the attitude and the rotation that it causes.
    let bias_with_turn = sigma_c * to_axes.transpose() * -h;
    let deviation = deviation_forms(belief.correlation(), &s);
    let cross = p * (deviation.transpose() * (second * kept + turned)) + bias_with_turn * drift;
    let deviation_variance = Matrix3::from_diagonal(&belief.deviation_moments());
    let conditional = ConditionalMoments::<U3> {
        mean: *belief.mu(),
        deviation_mean: Vector3::zeros(),
        covariance: sigma_c + p * deviation_variance * p.transpose() + gyro.bias_walk * h,
        cross,
        deviation_covariance,
    };
    Ok(Belief::from_moments(attitude, belief.correlation(), &conditional)?)
}
