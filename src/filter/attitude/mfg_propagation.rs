//! Moment propagation of a matrix Fisher-Gaussian belief of attitude and gyro bias through the
//! gyroscope kinematics: theorems 4.5 and 4.6 of W22 without appendix E.
//!
//! Everything is linear in `r = vec(Q)`, the attitude in principal axes: `v_R = C^T r`, and given
//! the attitude the rotation over the step is `exp(d^) exp(h (w - mu)^)` with a small Gaussian `d`
//! whose mean is linear in `v_R`. To second order in `d`'s standard deviation the propagated `r`
//! is therefore quadratic in `r`, and every moment that theorem 3.6 asks for is a contraction of
//! the moments of `Q` up to order three with 9-vectors. In the first order in `d` the left
//! Jacobian makes this exact for any angle `h |w|`.

use std::sync::LazyLock;

use nalgebra::{Const, Matrix3, Rotation3, SMatrix, U3, Vector3};

use super::super::bayes::{FilterError, InertialStep};
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
/// A bilinear functional of `vec(Q)`.
type Bilinear = SMatrix<f64, 9, 9>;

/// `v_R` as functionals of `vec(Q)`, columns stacked.
pub(super) fn deviation_forms(correlation: Correlation, s: &Vector3<f64>) -> Forms {
    let mut forms = Forms::zeros();
    for (i, j, k) in [(0, 1, 2), (1, 2, 0), (2, 0, 1)] {
        let (kj, jk) = match correlation {
            Correlation::World => (s[j], s[k]),
            Correlation::Body => (s[k], s[j]),
        };
        forms[(k + 3 * j, i)] = kj;
        forms[(j + 3 * k, i)] = -jk;
    }
    forms
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

/// `vec(E[Q])`.
pub(super) fn first_vector(moments: &Moments) -> SMatrix<f64, 9, 1> {
    let mut r = SMatrix::zeros();
    for (i, d) in moments.first().iter().enumerate() {
        r[4 * i] = *d;
    }
    r
}

/// Positions in `vec(Q)` of the products of three entries that do not vanish.
static TRIPLES: LazyLock<Vec<[usize; 3]>> = LazyLock::new(|| {
    let entry = |e: usize| (e % 3, e / 3);
    // Signs: turns by pi about the axes flip entries; a moment that changes sign vanishes.
    let survives = |t: &[usize; 3]| {
        (0..3).all(|axis| {
            let flips = |e: &usize| (entry(*e).0 == axis) != (entry(*e).1 == axis);
            t.iter().filter(|e| flips(e)).count() % 2 == 0
        })
    };
    let all = (0..729).map(|n| [n % 9, n / 9 % 9, n / 81]);
    all.filter(survives).collect()
});

/// `E[<f, Q> r r^T]`.
fn third_contracted(moments: &Moments, f: &Vector9) -> Bilinear {
    let entry = |e: usize| (e % 3, e / 3);
    let mut contracted = Bilinear::zeros();
    for &[a, b, c] in TRIPLES.iter() {
        contracted[(b, c)] += f[a] * moments.third(entry(a), entry(b), entry(c));
    }
    contracted
}

type Vector9 = SMatrix<f64, 9, 1>;

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
    let scatter = to_axes * (gyro.noise * h + sigma_c * (h * h)) * to_axes.transpose();
    let loss = 0.5 * (Matrix3::from_diagonal_element(scatter.trace()) - scatter);

    let deviation = deviation_forms(belief.correlation(), &s);
    let second = moments.second_matrix();
    let with_deviation = second * deviation;
    let complement = Matrix3::from_diagonal(&moments.complement());
    let mut x = complement + loss - complement * loss;
    for l in 0..3 {
        let q_times_deviation = Matrix3::from_column_slice(with_deviation.column(l).as_slice());
        x -= q_times_deviation * hat(&slope.column(l).into_owned());
    }
    let mean = PolarMean::from_deviation(&Rotation3::identity(), &x)?.principal();
    let (turn_u, turn_v) = (mean.axes_in_world, mean.axes_in_body());
    let s_next = s_from_complement_near(&mean.complement, &s).map_err(MatrixFisherError::from)?;
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
    let by_slope: [Bilinear; 3] = std::array::from_fn(|axis| {
        third_contracted(moments, &(deviation * slope.row(axis).transpose()))
    });
    let mut turned = SMatrix::<f64, 9, 3>::zeros();
    for (bilinear, rate) in by_slope.iter().zip(&rates) {
        turned += bilinear * rate;
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
