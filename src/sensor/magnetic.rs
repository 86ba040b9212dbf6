use nalgebra::Vector3;

use super::Stamp;

/// A reading of a magnetometer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MagneticSample {
    pub stamp: Stamp,
    /// Magnetic field in sensor coordinates, as logged: tesla by the messages' definition, though
    /// drivers publish gauss and microtesla, too.
    pub field: Vector3<f64>,
}
