use serde::{Deserialize, Serialize};

/// Range and noise of the depth sensor.
///
/// The standard deviation at depth `d` is
/// `max(noise_floor, noise_quadratic d^2 + noise_linear d + noise_constant)`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DepthConfig {
    /// Depths below this are not used, m.
    pub min: f64,
    /// Depths above this are not used, m.
    pub max: f64,
    /// Smallest standard deviation, m.
    pub noise_floor: f64,
    pub noise_quadratic: f64,
    pub noise_linear: f64,
    pub noise_constant: f64,
    /// Neighbours of a key point that differ by more than this fraction of its depth make it an
    /// edge, and its depth is not used.
    pub edge_fraction: f64,
}

impl Default for DepthConfig {
    /// The Kinect v1 law of Khoshelham and Elberink (2012): `1.425e-3 d^2` m.
    fn default() -> Self {
        Self {
            min: 0.4,
            max: 5.0,
            noise_floor: 1.0e-3,
            noise_quadratic: 1.425e-3,
            noise_linear: 0.0,
            noise_constant: 0.0,
            edge_fraction: 0.04,
        }
    }
}

impl DepthConfig {
    /// Standard deviation (m) of a depth reading `depth` (m).
    pub fn standard_deviation(&self, depth: f64) -> f64 {
        let polynomial =
            (self.noise_quadratic * depth + self.noise_linear) * depth + self.noise_constant;
        polynomial.max(self.noise_floor)
    }
}
