//! Unit, sign and size of what an accelerometer reads, against how it would be read.

use super::findings::Findings;
use super::inertial::LEAST_GRAVITY;
use super::{AccelerometerUnit, Assumed, Evidence, ImuInspection, Severity, Sign};

/// Biases larger than this many of their standard deviations do not happen.
const SDS: f64 = 3.0;
/// A reading at rest that is off by more than this fraction is of another unit.
const LARGEST_SCALE_ERROR: f64 = 0.35;
/// Two scales that differ by less than this are the same.
const SAME_SCALE: f64 = 0.01;

/// The factor that makes m/s^2 of the readings, without its sign, and the gravity that they contain.
struct Reading {
    scale: f64,
    gravity: f64,
    unit: String,
}

/// Says what the accelerometer reads, and what is to be set for it.
pub(super) fn judge(findings: &mut Findings, imu: &ImuInspection, assumed: &Assumed) {
    if imu.is_zero {
        let text = "the accelerometer reads zero throughout: there is none in this topic";
        findings.add(Severity::Error, "imu", text.to_owned());
        return;
    }
    let [x, y, z] = imu.acceleration;
    let state = match imu.at_rest {
        true => format!("at rest (at {:.2} s) the accelerometer reads", imu.quietest),
        false => "never at rest for half a second; at its quietest the accelerometer reads".into(),
    };
    let reads = format!("{state} ({x:.3}, {y:.3}, {z:.3}), norm {:.3}", imu.acceleration_norm);
    let reading = match Reading::of(imu, assumed) {
        Ok(reading) => reading,
        Err(what) => return findings.add(Severity::Error, "imu", format!("{reads}: {what}")),
    };
    let source = match imu.sign_from {
        Evidence::Truth => " (by the accelerations of the reference)",
        Evidence::Images => " (by the accelerations that the images show)",
        Evidence::CameraMounting => " (by the camera's mounting, if it is held upright)",
        Evidence::None => "",
    };
    let (sign, factor) = match imu.gravity_sign {
        Sign::Regular => ("sign regular", Some(1.0)),
        Sign::Inverted => ("sign inverted", Some(-1.0)),
        Sign::Unknown => ("sign unknown", None),
    };
    let message = format!("{reads}: {}, {sign}{source}", reading.unit);
    let gravity_is_assumed = (reading.gravity / assumed.imu.gravity - 1.0).abs() < SAME_SCALE;
    if !gravity_is_assumed {
        let text = format!("gravity is {:.3} m/s^2 by the accelerometer at rest", reading.gravity);
        let value = toml::Value::Float(reading.gravity).to_string();
        findings.setting("imu", text, ("imu.gravity", value), false);
    }
    match factor {
        Some(factor) => {
            let scale = factor * reading.scale;
            let is_assumed = (assumed.imu.accelerometer_scale / scale - 1.0).abs() < SAME_SCALE;
            let value = toml::Value::Float(scale).to_string();
            let key = ("imu.accelerometer_scale", value);
            findings.setting("imu", message, key, is_assumed);
        }
        None => {
            let text = format!(
                "{message}; with the IMU upright its vertical axis must read +1 g, else negate \
                 `imu.accelerometer_scale`"
            );
            findings.add(Severity::Warning, "imu", text);
        }
    }
}

impl Reading {
    /// An error says what the readings are instead.
    fn of(imu: &ImuInspection, assumed: &Assumed) -> Result<Self, String> {
        let (norm, gravity) = (imu.acceleration_norm, assumed.imu.gravity);
        let configured = assumed.imu.accelerometer_scale.abs();
        let as_configured = Self { scale: configured, gravity, unit: unit(imu) };
        // A bias is no error of the scale; away from rest accelerations come on top.
        let tolerance = match imu.at_rest {
            true => SDS * assumed.imu.accel_bias_sd / gravity,
            false => LARGEST_SCALE_ERROR,
        };
        let off = norm * configured / gravity - 1.0;
        if off.abs() < tolerance {
            return Ok(as_configured);
        }
        if imu.accelerometer_unit == AccelerometerUnit::StandardGravities {
            // The recordings with which this program is concerned divided by 9.81.
            return Ok(Self { scale: 9.81, ..as_configured });
        }
        let scale = rounded(gravity / norm);
        // Another gravity is told from another scale by accelerations only.
        let fits = |scale: f64| {
            imu.fit.as_ref().is_some_and(|fit| {
                (fit.scale.abs() / scale - 1.0).abs() < SDS * (fit.scale_sd / scale).max(SAME_SCALE)
            })
        };
        let contained = imu.fit.as_ref().map_or(norm, |fit| fit.gravity.min(norm));
        if contained < LEAST_GRAVITY {
            return Err("gravity has been taken out of it; estimation needs the accelerometer as \
                        it is (often the topic ends in `_raw`)"
                .to_owned());
        }
        if fits(1.0) && !fits(scale) && imu.at_rest {
            let unit = format!("m/s^2 (by accelerations), gravity {norm:.3}");
            return Ok(Self { scale: 1.0, gravity: rounded(norm), unit });
        }
        let near_si = norm / gravity - 1.0;
        if near_si.abs() < LARGEST_SCALE_ERROR {
            let unit = format!(
                "m/s^2, but {:.1} % too {} for a gravity of {gravity} m/s^2 (imu.gravity)",
                100.0 * near_si.abs(),
                if near_si > 0.0 { "large" } else { "small" }
            );
            return Ok(Self { scale, gravity, unit });
        }
        if fits(scale) {
            let unit = format!("units of {scale} m/s^2 (by accelerations)");
            return Ok(Self { scale, gravity, unit });
        }
        if (norm / 1000.0 - 1.0).abs() < 0.15 {
            return Ok(Self { scale, gravity, unit: "thousandths of g".to_owned() });
        }
        Err(format!(
            "neither m/s^2 nor g; if gravity is {gravity} m/s^2, set imu.accelerometer_scale={}, if \
             these are m/s^2, set imu.gravity={}",
            scale,
            rounded(norm)
        ))
    }
}

fn unit(imu: &ImuInspection) -> String {
    match imu.accelerometer_unit {
        AccelerometerUnit::MetresPerSecondSquared => "m/s^2".to_owned(),
        AccelerometerUnit::StandardGravities => "g".to_owned(),
        AccelerometerUnit::Unknown => "as configured".to_owned(),
    }
}

/// Four digits are more than such a scale is known to.
fn rounded(value: f64) -> f64 {
    // Nothing and infinity, which damaged readings lead to, have infinite logarithms.
    let digits = 3.0 - value.abs().log10().floor();
    let unit = 10_f64.powi(digits.clamp(0.0, 12.0) as i32);
    (value * unit).round() / unit
}
