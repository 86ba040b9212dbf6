//! Which points move as a rigid scene does between two views whose turn is known.
//!
//! With the turn taken off, the directions `a`, `b` of a point in both views and the translation `t`
//! lie in one plane, `t . (a x b) = 0`, wherever the point is. Two points give `t`; a sample consensus
//! over pairs of them finds the one that most agree with. Errors `da`, `db` of the directions (one
//! standard deviation `s` a direction each) and `dr` of the turn (`s_r` a component) change the
//! residual by
//!
//! `de = da . (b x t) + db . (t x a) + dr . (a x (b x t))`, so
//! `var e = s_a^2 |b x t|^2 + s_b^2 |a x t|^2 + s_r^2 |a x (b x t)|^2`.

use nalgebra::{Matrix3, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A point is no outlier of this chi-square of one degree of freedom: one inlier in ten thousand is.
pub(super) const GATE: f64 = 15.1;
/// Translations tried. If half of the points are good, all of them fail with probability 1e-8.
const TRIALS: usize = 64;
/// Renewals of the translation by all that agree with it.
const RENEWALS: usize = 2;
/// Fewer points than this tell nothing.
pub(super) const LEAST: usize = 8;

/// Directions (unit vectors) of one point in two views.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pair {
    /// In the former view, turned into the latter.
    pub before: Vector3<f64>,
    pub now: Vector3<f64>,
    /// Variances of the directions, rad^2 an axis.
    pub variances: [f64; 2],
}

impl Pair {
    /// Squared residual over its variance.
    fn chi_square(&self, translation: &Vector3<f64>, turn_variance: f64) -> f64 {
        let across_now = self.now.cross(translation);
        let across_before = self.before.cross(translation);
        let variance = self.variances[0] * across_now.norm_squared()
            + self.variances[1] * across_before.norm_squared()
            + turn_variance * self.before.cross(&across_now).norm_squared();
        let residual = translation.dot(&self.before.cross(&self.now));
        // A point ahead in the direction of the translation agrees with anything.
        residual * residual / variance.max(f64::MIN_POSITIVE)
    }
}

/// Whether each pair agrees with the translation that most of them agree with; `None` where they
/// are too few, or where fewer than half agree with any: then the turn is not what it was taken for.
/// Costs `O(n)`.
pub(super) fn agreeing(pairs: &[Pair], turn_sigma: f64, seed: u64) -> Option<Vec<bool>> {
    if pairs.len() < LEAST {
        return None;
    }
    let turn_variance = turn_sigma * turn_sigma;
    let cost = |t: &Vector3<f64>| -> f64 {
        pairs.iter().map(|pair| pair.chi_square(t, turn_variance).min(GATE)).sum()
    };
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut best: Option<(f64, Vector3<f64>)> = None;
    let keep = |candidate: Option<Vector3<f64>>, best: &mut Option<(f64, Vector3<f64>)>| {
        let Some(translation) = candidate else { return };
        let cost = cost(&translation);
        if best.is_none_or(|(least, _)| cost < least) {
            *best = Some((cost, translation));
        }
    };
    for _ in 0..TRIALS {
        let normal = |k: usize| pairs[k].before.cross(&pairs[k].now);
        let (i, j) = (rng.random_range(0..pairs.len()), rng.random_range(0..pairs.len()));
        keep(normal(i).cross(&normal(j)).try_normalize(f64::MIN_POSITIVE), &mut best);
    }
    for _ in 0..RENEWALS {
        let renewed = best.and_then(|(_, t)| renewed(pairs, &t, turn_variance));
        keep(renewed, &mut best);
    }
    // Without any parallax every translation will do.
    let translation = best.map_or(Vector3::z(), |(_, translation)| translation);
    let agree: Vec<bool> =
        pairs.iter().map(|pair| pair.chi_square(&translation, turn_variance) <= GATE).collect();
    let count = agree.iter().filter(|agrees| **agrees).count();
    (2 * count >= pairs.len()).then_some(agree)
}

/// The translation that fits best to the pairs that agree with the present one.
fn renewed(pairs: &[Pair], translation: &Vector3<f64>, turn_variance: f64) -> Option<Vector3<f64>> {
    let mut sum = Matrix3::zeros();
    for pair in pairs {
        let normal = pair.before.cross(&pair.now);
        let chi_square = pair.chi_square(translation, turn_variance);
        let residual = translation.dot(&normal);
        if chi_square <= GATE && residual != 0.0 {
            // The inverse variance of the residual.
            sum += normal * normal.transpose() * (chi_square / (residual * residual));
        }
    }
    let eigen = sum.symmetric_eigen();
    let fits = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
    fits.iter().all(|x| x.is_finite()).then_some(fits)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::UnitQuaternion;
    use rand_distr::{Distribution, StandardNormal};

    const SIGMA: f64 = 0.5e-3;

    fn gaussian(rng: &mut ChaCha8Rng) -> Vector3<f64> {
        Vector3::from_fn(|_, _| StandardNormal.sample(rng))
    }

    /// Directions of points at 1 to 6 m, some of which move by themselves, under a translation.
    fn scene(seed: u64, translation: f64, turn_sigma: f64, movers: usize) -> Vec<Pair> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let moved = gaussian(&mut rng).normalize() * translation;
        let wrong = UnitQuaternion::from_scaled_axis(gaussian(&mut rng) * turn_sigma);
        (0..100)
            .map(|k| {
                let depth = rng.random_range(1.0..6.0);
                let before = Vector3::new(
                    depth * rng.random_range(-0.7..0.7),
                    depth * rng.random_range(-0.5..0.5),
                    depth,
                );
                let mut now = before - moved;
                if k < movers {
                    now += moved.cross(&before).normalize() * 0.03 * depth;
                }
                let mut seen =
                    |x: &Vector3<f64>| (x.normalize() + gaussian(&mut rng) * SIGMA).normalize();
                Pair {
                    before: wrong * seen(&before),
                    now: seen(&now),
                    variances: [SIGMA * SIGMA; 2],
                }
            })
            .collect()
    }

    #[test]
    fn what_moves_by_itself_is_told_from_the_rest() {
        let (mut lost, mut missed, mut seen) = (0, 0, 0);
        for seed in 0..200 {
            let agree = agreeing(&scene(seed, 0.05, 0.0, 30), 0.0, seed).unwrap();
            lost += agree[30..].iter().filter(|agrees| !**agrees).count();
            missed += agree[..30].iter().filter(|agrees| **agrees).count();
            seen += agree.len();
        }
        assert_eq!(seen, 20_000);
        assert!(lost < 14_000 / 300, "{lost}");
        // Some happen to move along their epipolar line.
        assert!(missed < 6_000 / 20, "{missed}");
    }

    #[test]
    fn a_turn_known_less_well_is_no_outlier() {
        let lost: usize = (0..200)
            .map(|seed| {
                let agree = agreeing(&scene(seed, 0.02, 2e-3, 0), 2e-3, seed).unwrap();
                agree.iter().filter(|agrees| !**agrees).count()
            })
            .sum();
        assert!(lost < 20_000 / 300, "{lost}");
    }

    #[test]
    fn standing_still_loses_nothing() {
        for seed in 0..50 {
            let pairs = scene(seed, 0.0, 0.0, 0);
            let agree = agreeing(&pairs, 1e-4, seed).unwrap();
            assert!(agree.iter().filter(|agrees| **agrees).count() >= 98);
        }
        let still = Pair { before: Vector3::z(), now: Vector3::z(), variances: [1e-6; 2] };
        assert_eq!(agreeing(&[still; 20], 0.0, 1), Some(vec![true; 20]));
        assert_eq!(agreeing(&[still; LEAST - 1], 0.0, 1), None);
    }

    #[test]
    fn a_turn_that_is_wrong_is_told() {
        let told = (0..100)
            .filter(|seed| agreeing(&scene(*seed, 0.01, 0.05, 0), 1e-4, *seed).is_none())
            .count();
        assert!(told > 80, "{told}");
    }
}
