//! Messages of satellite receivers and magnetometers.

use nalgebra::Matrix3;

use super::message::Fields;
use super::nmea::NmeaReader;
use super::pixels::Rejection;
use crate::sensor::{FixQuality, GnssFix, MagneticSample};

/// `sensor_msgs/NavSatFix`.
pub(super) fn nav_sat_fix(mut fields: Fields) -> Result<GnssFix, Rejection> {
    let stamp = fields.header()?;
    let status = fields.u8()?.cast_signed();
    let _service = fields.u16()?;
    let [latitude, longitude, altitude] = fields.f64s()?;
    let covariance: [f64; 9] = fields.f64s()?;
    let covariance_kind = fields.u8()?;
    let quality = match status {
        0 => FixQuality::Autonomous,
        1 => FixQuality::Differential,
        2 => FixQuality::RtkFixed,
        _ => return Err(Rejection::new("no fix", format!("status {status} at {stamp} s"))),
    };
    let covariance = Matrix3::from_row_slice(&covariance);
    let fix = GnssFix {
        stamp,
        latitude,
        longitude,
        height: altitude.is_finite().then_some(altitude),
        quality,
        covariance: (covariance_kind != 0 && is_covariance(&covariance)).then_some(covariance),
        hdop: None,
        satellites: None,
    };
    check_position(&fix).map(|()| fix)
}

/// Whether it says anything: zeros stand for "unknown", too.
fn is_covariance(matrix: &Matrix3<f64>) -> bool {
    matrix.iter().all(|x| x.is_finite()) && matrix.diagonal().iter().all(|variance| *variance > 0.0)
}

/// Refuses what is no place on the earth.
pub(super) fn check_position(fix: &GnssFix) -> Result<(), Rejection> {
    let inside = fix.latitude.abs() <= 90.0 && fix.longitude.abs() <= 360.0;
    let detail = || format!("latitude {}, longitude {}", fix.latitude, fix.longitude);
    inside.then_some(()).ok_or_else(|| Rejection::new("no position on the earth", detail()))
}

/// `sensor_msgs/MagneticField`, `geometry_msgs/Vector3Stamped`.
pub(super) fn magnetic_field(mut fields: Fields) -> Result<MagneticSample, Rejection> {
    let stamp = fields.header()?;
    let field = fields.vector()?;
    if !field.iter().all(|x| x.is_finite()) {
        return Err(Rejection::new("not finite", format!("at {stamp} s")));
    }
    Ok(MagneticSample { stamp, field })
}

/// `nmea_msgs/Sentence`; `None` where the sentence completes no fix.
pub(super) fn nmea_sentence(
    mut fields: Fields,
    reader: &mut NmeaReader,
) -> Result<Option<GnssFix>, Rejection> {
    let stamp = fields.header()?;
    Ok(reader.read(fields.text()?)?.map(|fix| GnssFix { stamp, ..fix }))
}
