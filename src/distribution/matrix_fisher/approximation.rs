//! Closed-form approximations of the constant and the first moments.
//!
//! They are the textbook limits of the exact pass, kept for comparison and for the figures of
//! W22 chapter 2; the pass is fast enough that nothing else here needs them. Errors stated are
//! measured maxima over the stated range (`1 - d_i` relative, `c` relative).

use nalgebra::Vector3;

use super::super::circle::CircleMoments;
use super::engine::Sums;
use super::{InvalidSingularValues, check_singular_values};

/// An approximate constant and approximate first moments of `M(S)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ApproximateMoments {
    /// `log(c(S) exp(-tr S))`.
    pub log_c_scaled: f64,
    /// `1 - d`.
    pub complement: Vector3<f64>,
}

impl ApproximateMoments {
    /// Near the uniform distribution, `s1 << 1` (L-AMF 33, 34): the relative error of `c` is
    /// below `0.05 s1^4` and that of `d` below `0.2 s1^2`.
    pub fn near_uniform(s: &Vector3<f64>) -> Result<Self, InvalidSingularValues> {
        check_singular_values(s)?;
        let products = Vector3::new(s[1] * s[2], s[0] * s[2], s[0] * s[1]);
        let c = 1.0 + s.norm_squared() / 6.0 + s.product() / 6.0;
        let d = (s / 3.0 + products / 6.0) / c;
        Ok(Self { log_c_scaled: c.ln() - s.sum(), complement: d.map(|d| 1.0 - d) })
    }

    /// Concentrated about all three axes, `s2 + s3 >> 1` (2.59, 2.60; L-AMF 37, 38): relative
    /// errors below `0.6/(s2 + s3)` from `s2 + s3 = 5` on.
    pub fn concentrated(s: &Vector3<f64>) -> Result<Self, InvalidSingularValues> {
        check_singular_values(s)?;
        let a = Vector3::from(Sums::of_singular_values(s).a);
        let logs: f64 = a.iter().map(|a| a.ln()).sum();
        let variance = a.map(f64::recip);
        let complement = variance.map(|v| 0.5 * (variance.sum() - v));
        let log_c_scaled = -0.5 * ((8.0 * std::f64::consts::PI).ln() + logs);
        Ok(Self { log_c_scaled, complement })
    }

    /// Concentrated about two axes, `s1 + s3 >> 1`, with any dispersion about the first
    /// (2.62-2.64): relative errors below `1.5 (1 + s2)/(s1 + s3)` from `s1 + s3 = 20 (1 + s2)`
    /// on.
    pub fn concentrated_about_two_axes(s: &Vector3<f64>) -> Result<Self, InvalidSingularValues> {
        check_singular_values(s)?;
        let [a1, a2, a3] = Sums::of_singular_values(s).a;
        let circle = CircleMoments::new(a1);
        let versine = 2.0 * circle.half_versine[0];
        let complement = Vector3::new(0.5 / a3 + 0.5 / a2, versine + 0.5 / a3, versine + 0.5 / a2);
        // exp(s1) I0(s2 + s3)/(2 sqrt(a2 a3)), times exp(-tr S).
        let log_c_scaled = circle.scaled_i0.ln() - (2.0 * (a2 * a3).sqrt()).ln();
        Ok(Self { log_c_scaled, complement })
    }
}

/// `S = 3 D`, the estimate near the uniform distribution (L-AMF 35).
pub fn s_near_uniform(d: &Vector3<f64>) -> Vector3<f64> {
    3.0 * d
}

/// The estimate for a concentrated distribution from `1 - d` (L-AMF 39): `s_j + s_k` is the
/// inverse of `(1 - d_j) + (1 - d_k) - (1 - d_i)`.
///
/// `None` if one of these is not positive.
pub fn s_concentrated(complement: &Vector3<f64>) -> Option<Vector3<f64>> {
    let g = complement;
    let a = [g[1] + g[2] - g[0], g[0] + g[2] - g[1], g[0] + g[1] - g[2]];
    a.iter().all(|m| *m > 0.0).then(|| Sums::new(a.map(f64::recip)).singular_values())
}
