//! Which points an update may use.

use nalgebra::{Matrix3, Rotation3};
use statrs::distribution::{ChiSquared, ContinuousCDF};

use super::{FilterConfig, Screening};
use crate::alignment::{MapEstimate, PointPair};

/// Coordinates of a point.
const DEGREES_OF_FREEDOM: f64 = 3.0;

/// Leaves out points whose innovation is improbable.
///
/// If most points fail, it is the prediction that is wrong and not they: then all pass, to be
/// weighed by the robust kernel alone.
#[derive(Debug, Clone)]
pub struct Gate {
    /// Squared Mahalanobis distance.
    threshold: f64,
    /// Kept between updates, so that they do not allocate.
    accepted: Vec<PointPair>,
    /// For each pair offered whether it was accepted.
    passed: Vec<bool>,
}

impl Gate {
    pub fn new(config: &FilterConfig) -> Self {
        let distribution = ChiSquared::new(DEGREES_OF_FREEDOM).ok();
        let threshold = distribution
            .filter(|_| config.has_gate())
            .map_or(f64::INFINITY, |chi_squared| chi_squared.inverse_cdf(config.gate_probability));
        Self { threshold, accepted: Vec::new(), passed: Vec::new() }
    }

    /// Sorts out the points; `world_from_body` turns their covariances, `predicted` gives mean
    /// and covariance of a point measured exactly.
    pub fn screen(
        &mut self,
        pairs: &[PointPair],
        world_from_body: &Rotation3<f64>,
        predicted: impl Fn(&PointPair) -> MapEstimate,
    ) -> Screening {
        let distance = |pair: &PointPair| {
            let seen = predicted(pair);
            let map =
                PointPair { world_covariance: pair.world_covariance + seen.covariance, ..*pair };
            // A pair without a positive definite covariance is refused by the update anyway.
            let weight = map.weight(world_from_body.matrix()).unwrap_or_else(Matrix3::zeros);
            let innovation = pair.in_world - seen.position;
            innovation.dot(&(weight * innovation))
        };
        let screening = self.judge(pairs.iter().map(distance));
        let passed = pairs.iter().zip(&self.passed).filter(|(_, passed)| **passed);
        self.accepted.clear();
        self.accepted.extend(passed.map(|(pair, _)| *pair));
        screening
    }

    /// Says of points at these squared Mahalanobis distances from their predictions which pass.
    pub fn judge(&mut self, distances: impl Iterator<Item = f64>) -> Screening {
        let mut largest: f64 = 0.0;
        self.passed.clear();
        for distance in distances {
            largest = largest.max(distance);
            self.passed.push(distance <= self.threshold);
        }
        let rejected = self.passed.iter().filter(|passed| !**passed).count();
        if 2 * rejected > self.passed.len() {
            self.passed.fill(true);
            return Screening { largest, threshold: f64::INFINITY, rejected: 0 };
        }
        Screening { largest, threshold: self.threshold, rejected }
    }

    /// For each pair last offered whether it passed.
    pub fn passed(&self) -> &[bool] {
        &self.passed
    }

    /// The points that passed.
    pub fn accepted(&self) -> &[PointPair] {
        &self.accepted
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    fn pair(error: f64) -> PointPair {
        PointPair {
            in_body: Vector3::x(),
            body_covariance: Matrix3::identity() * 0.01,
            in_world: Vector3::new(1.0, error, 0.0),
            world_covariance: Matrix3::identity() * 0.02,
        }
    }

    fn screen(gate: &mut Gate, pairs: &[PointPair]) -> Screening {
        gate.screen(pairs, &Rotation3::identity(), |pair| MapEstimate {
            position: pair.in_body,
            covariance: Matrix3::identity() * 0.01,
        })
    }

    #[test]
    fn improbable_points_stay_out() {
        let mut gate = Gate::new(&FilterConfig::default());
        // Variance 0.04, distance 1.2 is 36 = 6 standard deviations squared.
        let found = screen(&mut gate, &[pair(0.1), pair(-0.2), pair(1.2)]);
        assert_eq!((found.rejected, gate.accepted().len()), (1, 2));
        assert!((found.largest - 36.0).abs() < 1e-9 && (found.threshold - 30.7).abs() < 0.1);
    }

    #[test]
    fn a_wrong_prediction_opens_the_gate() {
        let mut gate = Gate::new(&FilterConfig::default());
        let found = screen(&mut gate, &[pair(3.0), pair(2.0), pair(0.0)]);
        assert_eq!((found.rejected, gate.accepted().len()), (0, 3));
        assert_eq!(found.threshold, f64::INFINITY);
        let mut none =
            Gate::new(&FilterConfig { gate_probability: 0.0, ..FilterConfig::default() });
        assert_eq!(screen(&mut none, &[pair(0.0), pair(9.0)]).rejected, 0);
    }
}
