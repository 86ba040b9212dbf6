//! The pass by quadrature over `u = x2^2 + x3^2`.
//!
//! With `x = (sqrt(1-u) e^(i alpha), sqrt(u) e^(i beta))` on the pairs (0,1), (2,3), the uniform
//! measure of the sphere is `du d alpha d beta / (4 pi^2)`, the angles `2 alpha`, `2 beta` are von
//! Mises with concentrations `a1 (1-u)` and `b u`, `b = s2 - s3`, and
//!
//! ```text
//! c(S) exp(-tr S) = int_0^1 exp(-2 a2 u) I0e(a1 (1-u)) I0e(b u) du.
//! ```
//!
//! The integrand lives on the scales `1/a2` and `1/b`, with a tail like `u^(-1/2)` between them
//! where `b` is the larger. In `v = sqrt(u)` that tail is smooth; Gauss-Legendre panels whose
//! ends form a geometric sequence in `v` resolve both scales with a number of nodes that grows
//! with the logarithm of their ratio.

use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, FRAC_PI_8};
use std::num::NonZeroUsize;
use std::sync::LazyLock;

use gauss_quad::legendre::GaussLegendre;

use super::super::circle::CircleMoments;
use super::forms::{Basis, CUBICS};
use super::sums::{EvenMoments, Sums};

/// `exp(-2 a2 u)` is cut off where it falls below `exp(-CUTOFF)`.
const CUTOFF: f64 = 50.0;
/// Nodes of each panel.
const NODES: usize = 16;
/// Ratio in `v` of the ends of a panel.
const RATIO: f64 = 3.0;
/// The innermost panel ends where `u` times the largest rate is below this.
const INNERMOST: f64 = 4.0;

/// Nodes on `[0, 1]` and weights.
static RULE: LazyLock<[(f64, f64); NODES]> = LazyLock::new(|| {
    let rule = GaussLegendre::new(NonZeroUsize::MIN.saturating_add(NODES - 1));
    let mut pairs = rule.iter().map(|&(x, w)| (0.5 * (1.0 + x), 0.5 * w));
    std::array::from_fn(|_| pairs.next().unwrap_or_default())
});

pub(super) fn pass<const THIRD: bool>(sums: &Sums) -> EvenMoments {
    let mut integrals = Integrals::default();
    for (start, end) in panels(sums) {
        integrals.add_panel::<THIRD>(sums, start, end);
    }
    integrals.moments()
}

/// Panels in `v` from the cut-off down to zero.
fn panels(sums: &Sums) -> impl Iterator<Item = (f64, f64)> {
    let rate = f64::max(2.0 * sums.a[1], sums.difference);
    let mut end = (0.5 * CUTOFF / sums.a[1]).min(1.0).sqrt();
    std::iter::from_fn(move || {
        let panel_end = end;
        let innermost = end * end * rate <= INNERMOST;
        end = if innermost { 0.0 } else { end / RATIO };
        (panel_end > 0.0).then_some((end, panel_end))
    })
}

/// `E[eta_i^2]` of the rotation vector `eta = log Q`, whose length is `2 atan2(r, x0)`.
///
/// The angle `alpha` needs nodes of its own here, and `v = sin psi`, in which `x0` is smooth.
pub(super) fn rotation_vector_variances(sums: &Sums) -> [f64; 3] {
    const ALPHA_ENDS: [f64; 4] = [0.0, FRAC_PI_8, FRAC_PI_4, FRAC_PI_2];
    let (mut constant, mut variances) = (0.0, [0.0; 3]);
    for (start, end) in panels(sums).map(|(start, end)| (start.asin(), end.asin())) {
        for (x, weight) in RULE.iter() {
            let (v, cosine) = (start + (end - start) * x).sin_cos();
            let u = v * v;
            let second = CircleMoments::new(sums.difference * u);
            let measure = (end - start) * weight * v * cosine;
            let density = measure * second.scaled_i0 * (-2.0 * sums.a[1] * u).exp();
            let z = second.half_versine[0];
            for (from, to) in ALPHA_ENDS.iter().zip(&ALPHA_ENDS[1..]) {
                for (x, weight) in RULE.iter() {
                    let (sine, cosine_alpha) = (from + (to - from) * x).sin_cos();
                    let y1 = (cosine * sine).powi(2);
                    let density = density * (to - from) * weight * (-2.0 * sums.a[0] * y1).exp();
                    let r = (u + y1).sqrt();
                    let angle = 2.0 * r.atan2(cosine * cosine_alpha) / r;
                    constant += density;
                    let scaled = density * angle * angle;
                    for (variance, y) in variances.iter_mut().zip([y1, u * (1.0 - z), u * z]) {
                        *variance += scaled * y;
                    }
                }
            }
        }
    }
    variances.map(|v| v / constant)
}

/// Integrals of the moments, not yet divided by the constant.
#[derive(Debug, Default)]
struct Integrals {
    constant: f64,
    squares: [f64; 3],
    products: [[f64; 3]; 3],
    cubics: [f64; CUBICS],
}

impl Integrals {
    fn add_panel<const THIRD: bool>(&mut self, sums: &Sums, start: f64, end: f64) {
        let width = end - start;
        for (x, weight) in RULE.iter() {
            let v = start + width * x;
            let u = v * v;
            let rho = (1.0 - v) * (1.0 + v);
            let first = CircleMoments::up_to::<THIRD>(sums.a[0] * rho);
            let second = CircleMoments::up_to::<THIRD>(sums.difference * u);
            let measure = 2.0 * v * width * weight;
            let density =
                (-2.0 * sums.a[1] * u).exp() * first.scaled_i0 * second.scaled_i0 * measure;
            self.add_squares(density, rho, u, &first, &second);
            if THIRD {
                self.add_cubics(density, rho, u, &first, &second);
            }
        }
    }

    fn add_squares(
        &mut self,
        density: f64,
        rho: f64,
        u: f64,
        first: &CircleMoments,
        second: &CircleMoments,
    ) {
        self.constant += density;
        let [w, ww] = first.half_versine;
        let [z, zz] = second.half_versine;
        let (y1, y2, y3) = (density * rho * w, density * u * (1.0 - z), density * u * z);
        self.squares[0] += y1;
        self.squares[1] += y2;
        self.squares[2] += y3;
        self.products[0][0] += density * rho * rho * ww;
        self.products[0][1] += rho * w * y2;
        self.products[0][2] += rho * w * y3;
        self.products[1][1] += density * u * u * (1.0 - 2.0 * z + zz);
        self.products[1][2] += density * u * u * (z - zz);
        self.products[2][2] += density * u * u * zz;
    }

    fn add_cubics(
        &mut self,
        density: f64,
        rho: f64,
        u: f64,
        first: &CircleMoments,
        second: &CircleMoments,
    ) {
        let powers = [u * u * u, rho * u * u, rho * rho * u, rho * rho * rho];
        let mut cubics = self.cubics.iter_mut();
        for (p, power) in powers.into_iter().enumerate() {
            for c in &first.cosine[..=p] {
                let factor = density * power * c;
                for (cubic, e) in cubics.by_ref().take(4 - p).zip(&second.cosine) {
                    *cubic += factor * e;
                }
            }
        }
    }

    fn moments(self) -> EvenMoments {
        let scale = 1.0 / self.constant;
        let products = std::array::from_fn(|i| {
            std::array::from_fn(|j| self.products[i.min(j)][i.max(j)] * scale)
        });
        EvenMoments {
            log_c_scaled: self.constant.ln(),
            squares: self.squares.map(|y| y * scale),
            products,
            cubics: self.cubics.map(|c| c * scale),
            basis: Basis::Circles,
        }
    }
}
