//! Noise of common IMU chips, for logs that do not tell that of theirs.
//!
//! Data sheets give the white noise of a sensor at rest on a bench. On a body that moves, vibration,
//! aliasing, scale and alignment errors come on top, which an estimator can only take for noise:
//! the densities are multiplied by [`INFLATION`] (the documentation of Kalibr and VINS-Mono
//! recommend factors from 2 to 20 for such chips). An Allan deviation of one's own device
//! is better than any of this.

use super::ImuConfig;

/// Factor on the white noise of a data sheet.
pub const INFLATION: f64 = 5.0;

/// White noise of an IMU chip by its data sheet (typical values).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SensorClass {
    pub name: &'static str,
    /// deg/s/sqrt(Hz).
    gyro_density: f64,
    /// micro-g/sqrt(Hz).
    accel_density: f64,
}

/// Name, gyroscope (deg/s/sqrt(Hz)), accelerometer (ug/sqrt(Hz)).
const CLASSES: [(&str, f64, f64); 18] = [
    // Bosch Sensortec.
    ("BMI055", 0.014, 150.0),
    ("BMI085", 0.014, 120.0),
    ("BMI088", 0.014, 175.0),
    ("BMI160", 0.007, 180.0),
    ("BMI270", 0.007, 160.0),
    // InvenSense, TDK.
    ("MPU-6000", 0.005, 400.0),
    ("MPU-6050", 0.005, 400.0),
    ("MPU-9250", 0.01, 300.0),
    ("ICM-20602", 0.004, 100.0),
    ("ICM-20689", 0.006, 150.0),
    ("ICM-20948", 0.015, 230.0),
    ("ICM-42688", 0.0028, 70.0),
    // STMicroelectronics, high-performance mode.
    ("LSM6DS3", 0.007, 90.0),
    ("LSM6DSL", 0.004, 90.0),
    ("LSM6DSM", 0.0038, 75.0),
    ("LSM6DSO", 0.0038, 70.0),
    // Analog Devices; EuRoC has the first.
    ("ADIS16448", 0.0135, 230.0),
    ("ADIS16470", 0.008, 160.0),
];

/// Where nothing tells the chip: the noisiest of the table but for the accelerometer of the MPU-6000
/// family.
const GENERIC: SensorClass =
    SensorClass { name: "MEMS of consumer cameras", gyro_density: 0.015, accel_density: 300.0 };

impl SensorClass {
    /// The chip of that name; case and hyphens do not matter.
    pub fn named(name: &str) -> Option<Self> {
        CLASSES
            .iter()
            .find(|(known, _, _)| plain(known) == plain(name))
            .map(|&(name, gyro_density, accel_density)| Self { name, gyro_density, accel_density })
    }

    /// The chip that a text (of topics and frames) names.
    pub fn mentioned(text: &str) -> Option<Self> {
        let text = plain(text);
        CLASSES
            .iter()
            .find(|(name, _, _)| text.contains(&plain(name)))
            .and_then(|c| Self::named(c.0))
    }

    pub fn generic() -> Self {
        GENERIC
    }

    /// Gyroscope white noise to estimate with, rad/s/sqrt(Hz).
    pub fn gyro_noise(&self) -> f64 {
        INFLATION * self.gyro_density.to_radians()
    }

    /// Accelerometer white noise to estimate with, m/s^2/sqrt(Hz).
    pub fn accel_noise(&self) -> f64 {
        INFLATION * self.accel_density * 1e-6 * ImuConfig::default().gravity
    }

    /// What the values are from, for people.
    pub fn source(&self) -> String {
        format!(
            "{}: {} deg/s/sqrt(Hz), {} ug/sqrt(Hz), times {INFLATION}",
            self.name, self.gyro_density, self.accel_density
        )
    }
}

fn plain(name: &str) -> String {
    name.chars().filter(char::is_ascii_alphanumeric).map(|c| c.to_ascii_lowercase()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chips_are_found_by_name_and_in_topics() {
        let chip = SensorClass::named("bmi055").unwrap();
        assert!((chip.gyro_noise() / 5.0 - 2.443e-4).abs() < 1e-7);
        assert!((chip.accel_noise() / 5.0 - 1.471e-3).abs() < 1e-6);
        assert_eq!(SensorClass::mentioned("/mpu_9250/imu").unwrap().name, "MPU-9250");
        assert_eq!(SensorClass::mentioned("/camera/imu"), None);
        assert_eq!(SensorClass::named("XYZ1"), None);
    }

    #[test]
    fn the_generic_class_is_no_better_than_the_chips() {
        let generic = SensorClass::generic();
        let quieter =
            |c: &&(&str, f64, f64)| c.1 <= generic.gyro_density && c.2 <= generic.accel_density;
        assert!(CLASSES.iter().filter(quieter).count() >= CLASSES.len() - 2);
        for (name, ..) in CLASSES {
            assert_eq!(SensorClass::named(name).unwrap().name, name);
        }
    }
}
