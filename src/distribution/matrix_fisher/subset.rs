use std::f64::consts::PI;

use nalgebra::{Rotation3, Vector3};

use super::MatrixFisher;
use crate::so3::hat;

/// Mean angle and concentration of a distribution along `R0 exp(theta w^)`, the rotations of
/// `R0` about one body axis (FNF definitions III.1-III.3).
///
/// For a matrix Fisher distribution the density there is von Mises, `exp(k cos(theta - mean))`
/// (theorem III.1); for a concentrated Gaussian it is Gaussian with variance `1/k` (III.2).
///
/// ```
/// # use mfg_vio::distribution::matrix_fisher::MatrixFisher;
/// # use mfg_vio::so3::exp;
/// # use nalgebra::{Matrix3, Rotation3, Vector3};
/// // FNF, figure 1 (c): F = exp(pi/4 w^) 50 I.
/// let axis = Vector3::new(0.0, 1.0, 1.0).normalize();
/// let turned = exp(&(axis * std::f64::consts::FRAC_PI_4));
/// let fisher = MatrixFisher::new(&(50.0 * turned.into_inner()))?;
/// let subset = fisher.on_subset(&Rotation3::identity(), &axis);
/// assert!((subset.concentration - 100.0).abs() < 1e-12);
/// assert!((subset.mean_angle - std::f64::consts::FRAC_PI_4).abs() < 1e-14);
/// # Ok::<(), mfg_vio::distribution::matrix_fisher::MatrixFisherError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SubsetConcentration {
    /// The most probable angle, rad, in (-pi, pi].
    pub mean_angle: f64,
    /// Concentration about it, 1/rad^2.
    pub concentration: f64,
}

impl SubsetConcentration {
    /// After Bayes' rule with another matrix Fisher distribution on the same subset (FNF theorem
    /// III.3): concentrations add like phasors, so that conflicting evidence disperses.
    pub fn fuse_fisher(&self, other: &Self) -> Self {
        let phasor = |s: &Self| (s.mean_angle.cos(), s.mean_angle.sin(), s.concentration);
        let ((c, s, k), (c2, s2, k2)) = (phasor(self), phasor(other));
        let (x, y) = (k * c + k2 * c2, k * s + k2 * s2);
        Self { mean_angle: y.atan2(x), concentration: x.hypot(y) }
    }

    /// After Bayes' rule with another concentrated Gaussian on the same subset (FNF theorem
    /// III.4): precisions add, whatever the conflict.
    pub fn fuse_gaussian(&self, other: &Self) -> Self {
        let concentration = self.concentration + other.concentration;
        let offset = wrap(other.mean_angle - self.mean_angle);
        let share = if concentration > 0.0 { other.concentration / concentration } else { 0.0 };
        Self { mean_angle: wrap(self.mean_angle + share * offset), concentration }
    }
}

/// The angle in (-pi, pi].
fn wrap(angle: f64) -> f64 {
    PI - (PI - angle).rem_euclid(2.0 * PI)
}

impl MatrixFisher {
    /// The distribution along `origin exp(theta axis^)` for a unit `axis` in the body frame (FNF
    /// theorem III.1).
    ///
    /// The subset need not contain the mean attitude: along any of them the density is von
    /// Mises.
    pub fn on_subset(&self, origin: &Rotation3<f64>, axis: &Vector3<f64>) -> SubsetConcentration {
        // tr(F^T R0 exp(theta w^)) = const + x cos(theta) + y sin(theta).
        let k = self.parameter().transpose() * origin.matrix();
        let x = k.trace() - axis.dot(&(k * axis));
        let y = (k * hat(axis)).trace();
        SubsetConcentration { mean_angle: y.atan2(x), concentration: x.hypot(y) }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix3;
    use proptest::prelude::*;

    use super::*;
    use crate::so3::exp;

    fn fisher() -> impl Strategy<Value = MatrixFisher> {
        prop::array::uniform9(-20.0..20.0f64)
            .prop_map(|f| MatrixFisher::new(&Matrix3::from_iterator(f)).unwrap())
    }

    fn vector() -> impl Strategy<Value = Vector3<f64>> {
        prop::array::uniform3(-3.0..3.0f64)
            .prop_map(Vector3::from)
            .prop_filter("not zero", |v| v.norm() > 0.1)
    }

    proptest! {
        /// FNF theorem III.1.
        #[test]
        fn density_along_a_subset_is_von_mises(
            fisher in fisher(), origin in vector(), axis in vector(), angle in -3.0..3.0f64,
        ) {
            let (origin, axis) = (exp(&origin), axis.normalize());
            let subset = fisher.on_subset(&origin, &axis);
            let at = |theta: f64| fisher.log_density(&(origin * exp(&(axis * theta))));
            let expected = subset.concentration * ((angle - subset.mean_angle).cos() - 1.0);
            prop_assert!((at(angle) - at(subset.mean_angle) - expected).abs() < 1e-11);
        }

        /// FNF theorem III.3.
        #[test]
        fn fusion_on_a_subset_is_that_of_the_distributions(
            first in fisher(), second in fisher(), origin in vector(), axis in vector(),
        ) {
            let (origin, axis) = (exp(&origin), axis.normalize());
            let [a, b] = [&first, &second].map(|f| f.on_subset(&origin, &axis));
            let fused = first.fuse(&second).unwrap().on_subset(&origin, &axis);
            let found = a.fuse_fisher(&b);
            prop_assert!((found.concentration - fused.concentration).abs() < 1e-11);
            let angle = (found.mean_angle - fused.mean_angle).sin() * fused.concentration;
            prop_assert!(angle.abs() < 1e-11);
        }
    }

    /// FNF theorem III.4: products of Gaussians on a line, the shorter way around.
    #[test]
    fn gaussians_fuse_by_precision_across_the_cut() {
        let at = |mean_angle, concentration| SubsetConcentration { mean_angle, concentration };
        let fused = at(3.0, 1.0).fuse_gaussian(&at(-3.0, 3.0));
        assert_eq!(fused.concentration, 4.0);
        let offset = 2.0 * PI - 6.0;
        assert!((fused.mean_angle - (3.0 + 0.75 * offset - 2.0 * PI)).abs() < 1e-14);
        let none = at(1.0, 0.0).fuse_gaussian(&at(2.0, 0.0));
        assert_eq!(none, at(1.0, 0.0));
    }
}
