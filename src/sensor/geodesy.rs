//! Places on the earth in a local frame: WGS 84, east-north-up.

use std::fmt;

use nalgebra::{Matrix3, Rotation3, Vector3};

/// Semi-major axis of WGS 84, m, and its flattening.
const SEMI_MAJOR_AXIS: f64 = 6_378_137.0;
const FLATTENING: f64 = 1.0 / 298.257_223_563;
/// Square of the first eccentricity.
const ECCENTRICITY_SQUARED: f64 = FLATTENING * (2.0 - FLATTENING);
/// Iterations of the latitude: each gains a factor of the eccentricity squared, 150.
const ITERATIONS: usize = 8;

/// A place by angles and height above the ellipsoid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Geodetic {
    /// Degrees, north positive.
    pub latitude: f64,
    /// Degrees, east positive.
    pub longitude: f64,
    /// m
    pub height: f64,
}

impl Geodetic {
    /// Earth-centred, earth-fixed coordinates, m.
    pub fn ecef(&self) -> Vector3<f64> {
        let (sin_lat, cos_lat) = self.latitude.to_radians().sin_cos();
        let (sin_lon, cos_lon) = self.longitude.to_radians().sin_cos();
        let normal = SEMI_MAJOR_AXIS / (1.0 - ECCENTRICITY_SQUARED * sin_lat * sin_lat).sqrt();
        let from_axis = (normal + self.height) * cos_lat;
        let along_axis = (normal * (1.0 - ECCENTRICITY_SQUARED) + self.height) * sin_lat;
        Vector3::new(from_axis * cos_lon, from_axis * sin_lon, along_axis)
    }

    /// The place with these coordinates; any direction for the centre of the earth.
    pub fn from_ecef(ecef: &Vector3<f64>) -> Self {
        let from_axis = ecef.x.hypot(ecef.y);
        let mut sine = ecef.z.atan2(from_axis * (1.0 - ECCENTRICITY_SQUARED)).sin();
        let mut latitude = sine.asin();
        for _ in 0..ITERATIONS {
            let normal = SEMI_MAJOR_AXIS / (1.0 - ECCENTRICITY_SQUARED * sine * sine).sqrt();
            latitude = (ecef.z + ECCENTRICITY_SQUARED * normal * sine).atan2(from_axis);
            sine = latitude.sin();
        }
        let root = (1.0 - ECCENTRICITY_SQUARED * sine * sine).sqrt();
        // Well-conditioned on the axis and on the equator.
        let height = from_axis * latitude.cos() + ecef.z * sine - SEMI_MAJOR_AXIS * root;
        Self {
            latitude: latitude.to_degrees(),
            longitude: ecef.y.atan2(ecef.x).to_degrees(),
            height,
        }
    }
}

/// The origin of a local frame, x east, y north, z up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Datum {
    place: Geodetic,
    ecef: Vector3<f64>,
    enu_from_ecef: Rotation3<f64>,
}

impl Datum {
    pub fn at(place: Geodetic) -> Self {
        let (sin_lat, cos_lat) = place.latitude.to_radians().sin_cos();
        let (sin_lon, cos_lon) = place.longitude.to_radians().sin_cos();
        let rows = Matrix3::new(
            -sin_lon,
            cos_lon,
            0.0,
            -sin_lat * cos_lon,
            -sin_lat * sin_lon,
            cos_lat,
            cos_lat * cos_lon,
            cos_lat * sin_lon,
            sin_lat,
        );
        let enu_from_ecef = Rotation3::from_matrix_unchecked(rows);
        Self { place, ecef: place.ecef(), enu_from_ecef }
    }

    pub fn place(&self) -> &Geodetic {
        &self.place
    }

    /// East, north, up from the origin, m.
    pub fn enu(&self, ecef: &Vector3<f64>) -> Vector3<f64> {
        self.enu_from_ecef * (ecef - self.ecef)
    }
}

impl fmt::Display for Datum {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Geodetic { latitude, longitude, height } = self.place;
        write!(f, "latitude {latitude:.8} deg, longitude {longitude:.8} deg, height {height:.3} m")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;

    /// Latitude, longitude, height beside what PROJ 9 makes of them (EPSG 4979 to 4978).
    const PLACES: [([f64; 3], [f64; 3]); 5] = [
        ([48.8562, 2.3508, 67.4], [4200996.789553433, 172460.3215373718, 4780102.83087521]),
        ([-33.8568, 151.2153, -12.5], [-4646959.539606897, 2553071.921808956, -3533260.1635010545]),
        ([0.0, 0.0, 0.0], [6378137.0, 0.0, 0.0]),
        ([89.9999, -120.0, 1000.0], [-5.585571642831939, -9.674493874700886, 6357752.31423543]),
        (
            [37.7749, -122.4194, 10000.0],
            [-2710412.4066359936, -4267731.820679001, 3891851.098479676],
        ),
    ];

    fn place([latitude, longitude, height]: [f64; 3]) -> Geodetic {
        Geodetic { latitude, longitude, height }
    }

    #[test]
    fn places_agree_with_proj() {
        for (angles, ecef) in PLACES {
            let ecef = Vector3::from(ecef);
            assert!((place(angles).ecef() - ecef).norm() < 1e-6);
            let back = Geodetic::from_ecef(&ecef);
            assert_relative_eq!(back.latitude, angles[0], epsilon = 1e-11);
            assert_relative_eq!(back.longitude, angles[1], epsilon = 1e-9);
            assert_relative_eq!(back.height, angles[2], epsilon = 1e-6);
        }
        let pole = Geodetic::from_ecef(&Vector3::new(0.0, 0.0, -6359752.314245179));
        assert_relative_eq!(pole.latitude, -90.0);
        assert_relative_eq!(pole.height, 3000.0, epsilon = 1e-6);
    }

    /// PROJ's `topocentric` about the first place.
    #[test]
    fn local_coordinates_agree_with_proj() {
        let datum = Datum::at(place(PLACES[0].0));
        for (at, enu) in [
            ([48.86, 2.36, 80.0], [675.0736751739521, 422.6326739923784, 12.550326431214387]),
            ([49.5, 2.0, 500.0], [-25412.57319423636, 71661.74534405455, -20.879613426688593]),
        ] {
            assert!((datum.enu(&place(at).ecef()) - Vector3::from(enu)).norm() < 1e-6);
        }
        assert!(datum.to_string().starts_with("latitude 48.85620000 deg"));
    }
}
