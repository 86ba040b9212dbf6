use nalgebra::Vector3;
use rand::Rng;
use rand_distr::Distribution;
use statrs::function::erf::erf;

/// Below this the mean resultant length comes from its series.
const SERIES: f64 = 0.05;
/// Steps of the inversion; it needs at most 6.
const MAX_STEPS: usize = 40;

/// Parameters that define no von Mises-Fisher distribution.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum VonMisesFisherError {
    /// The mean direction is zero or not finite.
    #[error("the mean direction {0:?} has no direction")]
    Direction([f64; 3]),
    /// The concentration is negative or not finite.
    #[error("the concentration must be finite and not negative, not {0}")]
    Concentration(f64),
    /// A mean resultant length that no distribution has.
    #[error("the mean resultant length must lie in [0, 1), not {0}")]
    ResultantLength(f64),
}

/// The von Mises-Fisher distribution on the sphere S^2, with density `exp(k m^T y)` up to a
/// constant: a measured direction (4.3, 4.4).
///
/// ```
/// # use mfg_vio::distribution::VonMisesFisher;
/// # use nalgebra::Vector3;
/// let direction = VonMisesFisher::new(Vector3::z(), 200.0)?;
/// assert!((direction.mean_resultant_length() - 0.995).abs() < 1e-12);
/// let matched = VonMisesFisher::from_mean(&(0.995 * Vector3::z()))?;
/// assert!((matched.concentration() - 200.0).abs() < 1e-9);
/// # Ok::<(), mfg_vio::distribution::VonMisesFisherError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VonMisesFisher {
    mean: Vector3<f64>,
    concentration: f64,
}

impl VonMisesFisher {
    /// `mean` need not be normalized.
    pub fn new(mean: Vector3<f64>, concentration: f64) -> Result<Self, VonMisesFisherError> {
        let direction = mean
            .try_normalize(0.0)
            .filter(|m| m.iter().all(|x| x.is_finite()))
            .ok_or(VonMisesFisherError::Direction(mean.into()))?;
        if !(concentration >= 0.0 && concentration.is_finite()) {
            return Err(VonMisesFisherError::Concentration(concentration));
        }
        Ok(Self { mean: direction, concentration })
    }

    /// The MLE from the mean of unit vectors.
    pub fn from_mean(mean: &Vector3<f64>) -> Result<Self, VonMisesFisherError> {
        Self::new(*mean, concentration_of_resultant(mean.norm())?)
    }

    /// The match of the direction of `r' ~ N(r, variance I)`, a projected normal distribution
    /// (5.39, 5.40).
    pub fn from_projected_normal(
        r: Vector3<f64>,
        variance: f64,
    ) -> Result<Self, VonMisesFisherError> {
        let resultant = projected_normal_resultant(r.norm() / variance.sqrt());
        Self::new(r, concentration_of_complement(resultant)?)
    }

    /// The unit mean direction.
    pub fn mean(&self) -> Vector3<f64> {
        self.mean
    }

    pub fn concentration(&self) -> f64 {
        self.concentration
    }

    /// Logarithm of the density at the unit vector `y` with respect to the uniform distribution
    /// on the sphere.
    pub fn log_density(&self, y: &Vector3<f64>) -> f64 {
        let k = self.concentration;
        // 1 - m^T y = |m - y|^2/2; k/sinh(k) = 2 k exp(-k)/(1 - exp(-2k)).
        let log_constant = if k < SERIES {
            k - (k * k / 6.0 - k.powi(4) / 180.0)
        } else {
            (2.0 * k).ln() - (-(-2.0 * k).exp_m1()).ln()
        };
        log_constant - 0.5 * k * (self.mean - y).norm_squared()
    }

    /// `|E[y]| = coth k - 1/k`.
    pub fn mean_resultant_length(&self) -> f64 {
        resultant_of_concentration(self.concentration)
    }
}

impl Distribution<Vector3<f64>> for VonMisesFisher {
    fn sample<R: Rng + ?Sized>(&self, rng: &mut R) -> Vector3<f64> {
        // 1 - cos of the angle to the mean by inversion of its distribution function.
        let k = self.concentration;
        let uniform: f64 = rng.random();
        let versine = if k < 1e-8 {
            2.0 * uniform
        } else {
            (-(uniform * (-2.0 * k).exp_m1()).ln_1p() / k).clamp(0.0, 2.0)
        };
        let sine = (versine * (2.0 - versine)).max(0.0).sqrt();
        let azimuth = std::f64::consts::TAU * rng.random::<f64>();
        let axis = Vector3::ith(self.mean.iamin(), 1.0);
        let x = (axis - self.mean * self.mean.dot(&axis)).normalize();
        let y = self.mean.cross(&x);
        self.mean * (1.0 - versine) + (x * azimuth.cos() + y * azimuth.sin()) * sine
    }
}

/// `coth k - 1/k`.
fn resultant_of_concentration(k: f64) -> f64 {
    if k < SERIES {
        let kk = k * k;
        k * (1.0 / 3.0 - kk * (1.0 / 45.0 - kk * (2.0 / 945.0 - kk / 4725.0)))
    } else {
        1.0 - complement_of_concentration(k)
    }
}

/// `1 - (coth k - 1/k)`, to full relative accuracy for large `k`.
fn complement_of_concentration(k: f64) -> f64 {
    1.0 / k - 2.0 / (2.0 * k).exp_m1()
}

/// A mean resultant length and its difference from one.
#[derive(Debug, Clone, Copy)]
struct Resultant {
    length: f64,
    complement: f64,
}

fn concentration_of_resultant(length: f64) -> Result<f64, VonMisesFisherError> {
    concentration_of_complement(Resultant { length, complement: 1.0 - length })
}

/// Newton's method on `1/(1 - A(k)) = 1/(1 - A)`, which is almost linear in `k`.
fn concentration_of_complement(target: Resultant) -> Result<f64, VonMisesFisherError> {
    let Resultant { length, complement } = target;
    if !(length >= 0.0 && complement > 0.0) {
        return Err(VonMisesFisherError::ResultantLength(length));
    }
    let mut k = length * (3.0 - length * length) / (complement * (1.0 + length));
    for _ in 0..MAX_STEPS {
        let a = resultant_of_concentration(k);
        let rest = if k < SERIES { 1.0 - a } else { complement_of_concentration(k) };
        let slope = slope_of_resultant(k, a);
        let residual = if k < 1.0 { length - a } else { rest - complement };
        let step = residual * rest / (complement * slope);
        k = (k + step).max(0.0);
        if step.abs() <= 1e-15 * k {
            break;
        }
    }
    Ok(k)
}

/// `A'(k) = 1 - A^2 - 2 A/k`.
fn slope_of_resultant(k: f64, a: f64) -> f64 {
    if k < SERIES {
        1.0 / 3.0 - k * k / 15.0
    } else if k > 20.0 {
        1.0 / (k * k)
    } else {
        1.0 - a * a - 2.0 * a / k
    }
}

/// The mean resultant length of the direction of `N(m, I)` with `|m| = gamma`, right-hand side
/// of (5.40).
fn projected_normal_resultant(gamma: f64) -> Resultant {
    let density = (-0.5 * gamma * gamma).exp() / std::f64::consts::TAU.sqrt();
    if gamma < 0.1 {
        // (2/3) sqrt(2/pi) gamma 1F1(1/2; 5/2; -gamma^2/2).
        let square = gamma * gamma;
        let series = 1.0 - square / 10.0 + square * square * (3.0 / 280.0 - square / 1008.0);
        let length = 4.0 / 3.0 * gamma * series / std::f64::consts::TAU.sqrt();
        return Resultant { length, complement: 1.0 - length };
    }
    let inverse_square = 1.0 / (gamma * gamma);
    let tail = statrs::function::erf::erfc(gamma * std::f64::consts::FRAC_1_SQRT_2);
    let spread = 2.0 * density / gamma;
    let complement = inverse_square + (1.0 - inverse_square) * tail - spread;
    let central = erf(gamma * std::f64::consts::FRAC_1_SQRT_2);
    Resultant { length: spread + (1.0 - inverse_square) * central, complement }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use proptest::prelude::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    proptest! {
        #[test]
        fn estimation_inverts_the_resultant_length(exponent in -6.0..7.0f64) {
            let k = 10f64.powf(exponent);
            let length = resultant_of_concentration(k);
            let complement = if k < SERIES { 1.0 - length } else { complement_of_concentration(k) };
            let found = concentration_of_complement(Resultant { length, complement }).unwrap();
            prop_assert!((found - k).abs() < 1e-11 * k, "{found} {k}");
        }

        #[test]
        fn projected_normal_is_matched_in_its_limits(exponent in -4.0..4.0f64) {
            let gamma = 10f64.powf(exponent);
            let direction = VonMisesFisher::from_projected_normal(Vector3::x() * gamma, 1.0).unwrap();
            let k = direction.concentration();
            if gamma > 50.0 {
                prop_assert!((k / (gamma * gamma) - 1.0).abs() < 1e-3);
            }
            if gamma < 0.01 {
                let small = 4.0 * gamma / std::f64::consts::TAU.sqrt();
                prop_assert!((k / small - 1.0).abs() < 1e-3);
            }
        }
    }

    #[test]
    fn resultant_of_a_projected_normal_is_that_of_samples() {
        use rand_distr::StandardNormal;
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        for gamma in [0.05, 0.5, 1.0, 3.0] {
            let n = 100_000;
            let mean: f64 = (0..n)
                .map(|_| {
                    let noise = Vector3::from_fn(|_, _| StandardNormal.sample(&mut rng));
                    (Vector3::x() * gamma + noise).normalize().x / f64::from(n)
                })
                .sum();
            let expected = projected_normal_resultant(gamma).length;
            assert!((mean - expected).abs() < 5.0 / f64::from(n).sqrt(), "{gamma}");
        }
        assert_relative_eq!(
            projected_normal_resultant(0.1 - 1e-12).length,
            projected_normal_resultant(0.1).length,
            max_relative = 1e-10
        );
    }

    #[test]
    fn samples_have_the_mean_and_the_density_integrates_to_one() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for k in [0.0, 0.01, 1.0, 30.0, 1e6] {
            let direction = VonMisesFisher::new(Vector3::new(1.0, -2.0, 0.5), k).unwrap();
            let n = 20_000;
            let mean: Vector3<f64> =
                direction.sample_iter(&mut rng).take(n).sum::<Vector3<f64>>() / n as f64;
            let expected = direction.mean() * direction.mean_resultant_length();
            assert!((mean - expected).norm() < 4.0 / (n as f64 * (1.0 + k)).sqrt(), "{k} {mean}");
            // By the midpoint rule in 1 - cos, density being constant on parallels.
            let steps = 20_000;
            let cut = 2f64.min(60.0 / k.max(1e-9));
            let frame = Vector3::new(2.0, 1.0, 0.0).normalize();
            let integral: f64 = (0..steps)
                .map(|i| {
                    let versine = cut * (i as f64 + 0.5) / steps as f64;
                    let sine = (versine * (2.0 - versine)).sqrt();
                    let y = direction.mean() * (1.0 - versine) + frame * sine;
                    direction.log_density(&y).exp() * cut / (2 * steps) as f64
                })
                .sum();
            assert!((integral - 1.0).abs() < 1e-4, "{k} {integral}");
        }
    }

    #[test]
    fn parameters_without_meaning_are_refused() {
        assert!(VonMisesFisher::new(Vector3::zeros(), 1.0).is_err());
        assert!(VonMisesFisher::new(Vector3::x(), -1.0).is_err());
        assert!(VonMisesFisher::new(Vector3::x(), f64::NAN).is_err());
        assert!(VonMisesFisher::from_mean(&Vector3::x()).is_err());
        assert!(VonMisesFisher::from_projected_normal(Vector3::x(), 0.0).is_err());
    }
}
