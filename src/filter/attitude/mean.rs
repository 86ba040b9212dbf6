//! The mean `E[R]` of an attitude belief in principal axes or in polar form, and its propagation.
//!
//! A matrix Fisher distribution is determined by its mean. Between measurements the first-order
//! filter changes only the mean, and linearly (L-AMF 13), so that the parameter is needed only
//! where a measurement arrives: propagating the mean is the same filter at a fraction of the cost.
//! Isotropic noise and turns do not even change its principal axes in the world.

use nalgebra::{Matrix3, Rotation3, Vector3};

use crate::so3::{NotFinite, ProperSvd, exp, principal_axes, proper_svd, vee};

/// Newton steps of the polar decomposition of a matrix that is almost symmetric.
const POLAR_STEPS: usize = 4;
/// What a step of this size, rad, leaves behind is its square: below rounding.
const POLAR_TOLERANCE: f64 = 1e-8;
/// Smallest ratio of the least to the largest `d_j + d_k` for which Newton's step is used.
const POLAR_CONDITION: f64 = 1e-2;

/// `E[R] = U (I - diag g) V^T` with `g` ascending.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PrincipalMean {
    /// `U V^T`.
    pub mode: Rotation3<f64>,
    /// `U`.
    pub axes_in_world: Rotation3<f64>,
    /// `g`, which keeps its digits where the mean is close to a rotation.
    pub complement: Vector3<f64>,
}

impl PrincipalMean {
    /// The mean of a distribution with the axes of `fisher`.
    pub fn new(fisher: &ProperSvd, complement: Vector3<f64>) -> Self {
        Self { mode: fisher.rotation(), axes_in_world: fisher.u, complement }
    }

    /// `E[R]`.
    pub fn matrix(&self) -> Matrix3<f64> {
        let s = self.complement.map(|g| 1.0 - g);
        ProperSvd { u: self.axes_in_world, s, v: self.axes_in_body() }.matrix()
    }

    /// `V`.
    pub fn axes_in_body(&self) -> Rotation3<f64> {
        self.mode.inverse() * self.axes_in_world
    }

    /// The mean after a turn by `turn` in the body frame.
    pub fn turned(&self, turn: &Rotation3<f64>) -> Self {
        Self { mode: self.mode * turn, ..*self }
    }

    /// The mean after a turn by `turn` in the world frame.
    pub fn turned_in_world(&self, turn: &Rotation3<f64>) -> Self {
        Self { mode: turn * self.mode, axes_in_world: turn * self.axes_in_world, ..*self }
    }

    /// The mean after isotropic diffusion of `variance` rad^2 about each axis, in any frame:
    /// `E[R] exp(-variance)`.
    pub fn diffused(&self, variance: f64) -> Self {
        let lost = -(-variance).exp_m1();
        Self { complement: self.complement.map(|g| g + lost * (1.0 - g)), ..*self }
    }

    pub fn polar(&self) -> PolarMean {
        let v = self.axes_in_body();
        let complement = ProperSvd { u: v, s: self.complement, v }.matrix();
        PolarMean { mode: self.mode, complement }
    }
}

/// `E[R] = mode (I - complement)`: `complement` is symmetric, in body coordinates, and keeps its
/// digits where the mean is close to a rotation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PolarMean {
    pub mode: Rotation3<f64>,
    pub complement: Matrix3<f64>,
}

impl PolarMean {
    /// The principal axes.
    pub fn principal(&self) -> PrincipalMean {
        let (axes, negated) = principal_axes(&-self.complement);
        let axes_in_world = self.mode * axes;
        PrincipalMean { mode: self.mode, axes_in_world, complement: -negated }
    }

    /// The mean after diffusion with the covariance `q`, rad^2, of rotation vectors in the body
    /// frame: `E[R] (I + (q - tr(q) I)/2)`, to second order in `q` as a matrix exponential.
    pub fn diffused_in_body(&self, q: &Matrix3<f64>) -> Result<Self, NotFinite> {
        let loss = diffusion_loss(q);
        Self::from_deviation(&self.mode, &(self.complement + loss - self.complement * loss))
    }

    /// The same with `q` in world coordinates.
    pub fn diffused_in_world(&self, q: &Matrix3<f64>) -> Result<Self, NotFinite> {
        // (I - L) M (I - C) = M (I - C - L' + L' C) with L' = M^T L M.
        let m = self.mode.matrix();
        let loss = m.transpose() * diffusion_loss(q) * m;
        Self::from_deviation(&self.mode, &(self.complement + loss - loss * self.complement))
    }

    /// The polar form of `rotation (I - x)`.
    pub fn from_deviation(rotation: &Rotation3<f64>, x: &Matrix3<f64>) -> Result<Self, NotFinite> {
        let (mut mode, mut x) = (*rotation, *x);
        for _ in 0..POLAR_STEPS {
            let symmetric = Matrix3::identity() - 0.5 * (x + x.transpose());
            let Some(turn) = polar_step(&symmetric, &-vee(&x)) else { break };
            let rotation = exp(&turn);
            mode *= rotation;
            // I - exp(-turn) (I - x), without the identity that would swallow the digits of x.
            let back = rotation.inverse();
            x = (Matrix3::identity() - back.matrix()) + back.matrix() * x;
            if turn.amax() < POLAR_TOLERANCE {
                return Ok(Self { mode, complement: 0.5 * (x + x.transpose()) });
            }
        }
        let ProperSvd { u, s, v } = proper_svd(&(Matrix3::identity() - x))?;
        let centred = PrincipalMean::new(&ProperSvd { u, s, v }, s.map(|d| 1.0 - d)).polar();
        Ok(Self { mode: mode * centred.mode, ..centred })
    }
}

/// `I - E[exp(w^)]` for `w ~ N(0, q)`, to second order.
fn diffusion_loss(q: &Matrix3<f64>) -> Matrix3<f64> {
    let rate = 0.5 * (Matrix3::from_diagonal_element(q.trace()) - q);
    rate - 0.5 * rate * rate
}

/// The rotation vector `e` with `e^ K + K e^ = 2 a^`: a Newton step to the polar factor of
/// `K + a^`. `None` where the factor is close to not being unique.
fn polar_step(k: &Matrix3<f64>, a: &Vector3<f64>) -> Option<Vector3<f64>> {
    let curvature = Matrix3::from_diagonal_element(k.trace()) - k;
    let factor = curvature.cholesky()?;
    let diagonal = factor.l_dirty().diagonal();
    (diagonal.min() > POLAR_CONDITION * diagonal.max()).then(|| factor.solve(&(2.0 * a)))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn vector(bound: f64) -> impl Strategy<Value = Vector3<f64>> {
        prop::array::uniform3(-bound..bound).prop_map(Vector3::from)
    }

    proptest! {
        #[test]
        fn polar_form_is_the_proper_polar_decomposition(
            axes in vector(3.0),
            g in prop::array::uniform3(0.0..1.0f64),
            turn in vector(0.3),
            exponent in -8.0..0.0f64,
        ) {
            let scale = 10f64.powf(exponent);
            let v = exp(&axes);
            let mut g = g;
            g.sort_by(f64::total_cmp);
            let g = Vector3::from(g) * scale;
            let principal = PrincipalMean {
                mode: Rotation3::identity(), axes_in_world: v, complement: g,
            };
            let mean = principal.polar();
            let q = exp(&turn);
            let x = Matrix3::identity() - q.matrix() * (Matrix3::identity() - mean.complement);
            let found = PolarMean::from_deviation(&exp(&Vector3::new(1.0, 0.0, 2.0)), &x).unwrap();
            let expected = exp(&Vector3::new(1.0, 0.0, 2.0)) * q;
            prop_assert!((found.complement - mean.complement).amax() < 1e-12);
            prop_assert!((found.mode.matrix() - expected.matrix()).amax() < 1e-8);
            let again = found.principal().polar();
            prop_assert!((again.complement - mean.complement).amax() < 1e-12);
            prop_assert!((again.mode.matrix() - found.mode.matrix()).amax() == 0.0);
        }
    }

    #[test]
    fn diffusion_is_that_of_samples_on_a_small_sphere() {
        // E[exp(w^)] over the six points +-sqrt(3 q) e_i of equal weight, to fourth order in w.
        let q = Vector3::new(1e-3, 4e-3, 2e-3);
        let mut mean = Matrix3::zeros();
        for i in 0..3 {
            for sign in [1.0, -1.0] {
                let w = Vector3::<f64>::ith(i, sign * (3.0f64 * q[i]).sqrt());
                mean += exp(&w).matrix() / 6.0;
            }
        }
        let loss = diffusion_loss(&Matrix3::from_diagonal(&q));
        assert!((Matrix3::identity() - loss - mean).amax() < 2e-5);
    }
}
