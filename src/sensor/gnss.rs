//! What satellite receivers deliver.

use nalgebra::Matrix3;

use super::Stamp;

/// A position on the earth, measured by a satellite receiver (WGS 84).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GnssFix {
    pub stamp: Stamp,
    /// Geodetic latitude, degrees, north positive.
    pub latitude: f64,
    /// Longitude, degrees, east positive.
    pub longitude: f64,
    /// Height above the ellipsoid, m; `None` where the receiver tells none.
    pub height: Option<f64>,
    pub quality: FixQuality,
    /// Covariance of the position in east, north, up, m^2; `None` where the receiver tells none.
    pub covariance: Option<Matrix3<f64>>,
    /// Horizontal dilution of precision, where the receiver tells it.
    pub hdop: Option<f64>,
    /// Satellites used, where the receiver tells their number.
    pub satellites: Option<u32>,
}

/// How a fix was obtained, from the least to the most accurate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum FixQuality {
    /// Dead reckoning of the receiver without satellites.
    Estimated,
    /// Satellites alone.
    Autonomous,
    /// Corrected by a reference station or by satellites (DGPS, SBAS).
    Differential,
    /// Carrier phases, their ambiguities not solved as integers.
    RtkFloat,
    /// Carrier phases with integer ambiguities, or a ground-based augmentation of unnamed kind.
    RtkFixed,
}
