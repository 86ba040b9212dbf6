//! A satellite's orbit and the magnetic field along it.

use std::f64::consts::TAU;

use nalgebra::{Rotation3, Vector3};
use world_magnetic_model::GeomagneticField;
use world_magnetic_model::time::Date;
use world_magnetic_model::uom::si::angle::radian;
use world_magnetic_model::uom::si::f32::{Angle, Length};
use world_magnetic_model::uom::si::length::meter;
use world_magnetic_model::uom::si::magnetic_flux_density::nanotesla;

use crate::so3::exp;

/// The Earth's gravitational parameter, m^3/s^2 (WGS 84).
const GRAVITATIONAL_PARAMETER: f64 = 3.986_004_418e14;
/// The Earth's angular speed, rad/s.
const EARTH_RATE: f64 = 7.292_115e-5;
/// Semi-major axis, m, and flattening of the ellipsoid (WGS 84).
const EARTH_RADIUS: f64 = 6_378_137.0;
const FLATTENING: f64 = 1.0 / 298.257_223_563;
/// Angle from the vernal equinox to Greenwich at the midnight that began 2021, rad.
const GREENWICH: f64 = 100.846_f64 / 360.0 * TAU;
/// Iterations for the eccentric anomaly and for the latitude; each gains two digits at the
/// eccentricities of the Earth and of this orbit.
const FIXED_POINT_STEPS: usize = 10;

/// Elements of an orbit around the Earth; it starts at its perigee.
#[derive(Debug, Clone, Copy)]
pub(super) struct Orbit {
    /// m.
    pub semi_major_axis: f64,
    pub eccentricity: f64,
    /// rad.
    pub ascending_node: f64,
    /// Argument of the perigee, rad.
    pub perigee: f64,
    /// rad.
    pub inclination: f64,
}

impl Orbit {
    /// Duration of one revolution, s.
    pub fn period(&self) -> f64 {
        TAU * (self.semi_major_axis.powi(3) / GRAVITATIONAL_PARAMETER).sqrt()
    }

    /// Position after `t` seconds in the inertial frame (third axis to the north, first to the
    /// vernal equinox), m.
    pub fn position(&self, t: f64) -> Vector3<f64> {
        let e = self.eccentricity;
        let mean_anomaly = TAU * t / self.period();
        let kepler = |anomaly: f64| mean_anomaly + e * anomaly.sin();
        let anomaly = (0..FIXED_POINT_STEPS).fold(mean_anomaly, |anomaly, _| kepler(anomaly));
        let in_plane = Vector3::new(anomaly.cos() - e, (1.0 - e * e).sqrt() * anomaly.sin(), 0.0);
        let about_z = |angle: f64| exp(&Vector3::new(0.0, 0.0, angle));
        let plane = about_z(self.ascending_node)
            * exp(&Vector3::new(self.inclination, 0.0, 0.0))
            * about_z(self.perigee);
        plane * in_plane * self.semi_major_axis
    }

    /// The direction of the magnetic field after `t` seconds of the year 2021, in the inertial
    /// frame.
    pub fn magnetic_direction(&self, t: f64) -> Result<Vector3<f64>, FieldError> {
        let inertial_from_earth = exp(&Vector3::new(0.0, 0.0, GREENWICH + EARTH_RATE * t));
        let place = Geodetic::of(&inertial_from_earth.inverse_transform_vector(&self.position(t)));
        let field = inertial_from_earth * (place.earth_from_north_east_down() * place.field()?);
        field.try_normalize(0.0).ok_or(FieldError::NoField)
    }
}

#[derive(Debug, thiserror::Error)]
pub(super) enum FieldError {
    #[error("the world magnetic model has no field here: {0}")]
    Model(world_magnetic_model::Error),
    #[error("not a date: {0}")]
    Date(#[from] world_magnetic_model::time::error::ComponentRange),
    #[error("the magnetic field vanishes")]
    NoField,
}

/// A place by its coordinates on the ellipsoid.
#[derive(Debug, Clone, Copy)]
struct Geodetic {
    /// rad.
    latitude: f64,
    /// rad.
    longitude: f64,
    /// m.
    height: f64,
}

impl Geodetic {
    /// The place at `p`, m, in the frame fixed to the Earth.
    fn of(p: &Vector3<f64>) -> Self {
        let squared_eccentricity = FLATTENING * (2.0 - FLATTENING);
        let across = p.x.hypot(p.y);
        let normal = |sine: f64| EARTH_RADIUS / (1.0 - squared_eccentricity * sine * sine).sqrt();
        let latitude = (0..FIXED_POINT_STEPS).fold(p.z.atan2(across), |latitude, _| {
            let sine = latitude.sin();
            (p.z + squared_eccentricity * normal(sine) * sine).atan2(across)
        });
        let (sine, cosine) = latitude.sin_cos();
        let n = normal(sine);
        // Along the normal of the ellipsoid, which works at the poles too.
        let height = across * cosine + p.z * sine - n * (1.0 - squared_eccentricity * sine * sine);
        Self { latitude, longitude: p.y.atan2(p.x), height }
    }

    fn earth_from_north_east_down(&self) -> Rotation3<f64> {
        let quarter = 0.25 * TAU;
        exp(&Vector3::new(0.0, 0.0, self.longitude))
            * exp(&Vector3::new(0.0, -(self.latitude + quarter), 0.0))
    }

    /// The field of the World Magnetic Model on the first of January 2021: north, east, down, nT.
    fn field(&self) -> Result<Vector3<f64>, FieldError> {
        let field = GeomagneticField::new(
            Length::new::<meter>(self.height as f32),
            Angle::new::<radian>(self.latitude as f32),
            Angle::new::<radian>(self.longitude as f32),
            Date::from_ordinal_date(2021, 1)?,
        );
        let field = field.map_err(FieldError::Model)?;
        let components = [field.x(), field.y(), field.z()];
        Ok(Vector3::from(components.map(|b| f64::from(b.get::<nanotesla>()))))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ORBIT: Orbit = Orbit {
        semi_major_axis: 6.916e6,
        eccentricity: 0.02,
        ascending_node: 0.9,
        perigee: 0.3,
        inclination: 1.2,
    };

    #[test]
    fn the_orbit_obeys_newtons_law() {
        for t in [0.0, 1000.0, 4000.0] {
            let h = 1.0;
            let [before, now, after] = [t - h, t, t + h].map(|t| ORBIT.position(t));
            let acceleration = (after - now * 2.0 + before) / (h * h);
            let expected = -now * (GRAVITATIONAL_PARAMETER / now.norm().powi(3));
            assert!((acceleration - expected).norm() < 1e-5 * expected.norm());
        }
        assert!((ORBIT.position(0.0).norm() - 6.916e6 * 0.98).abs() < 1e-6);
    }

    #[test]
    fn a_place_is_at_its_height_along_the_normal() {
        for (latitude, longitude) in [(0.0, 1.0), (0.7, -2.5), (-1.5, 3.0), (1.57, 0.1)] {
            let e2 = FLATTENING * (2.0 - FLATTENING);
            let n = EARTH_RADIUS / (1.0 - e2 * f64::sin(latitude).powi(2)).sqrt();
            let across = (n + 5e5) * f64::cos(latitude);
            let z = (n * (1.0 - e2) + 5e5) * f64::sin(latitude);
            let p = Vector3::new(across * f64::cos(longitude), across * f64::sin(longitude), z);
            let found = Geodetic::of(&p);
            assert!((found.latitude - latitude).abs() < 1e-12);
            assert!((found.longitude - longitude).abs() < 1e-9);
            assert!((found.height - 5e5).abs() < 1e-6, "{}", found.height);
            let down = found.earth_from_north_east_down() * Vector3::z();
            let to_the_ground = p - down * -5e5;
            assert!((Geodetic::of(&to_the_ground).height).abs() < 1e-6);
        }
    }

    /// Away from the weak field of the South Atlantic it is close to that of a dipole that leans by
    /// ten degrees.
    #[test]
    fn the_field_is_roughly_a_dipole() {
        let pole = Vector3::new(0.05, -0.16, 0.986).normalize();
        for (latitude, longitude) in [(0.7, -1.6), (0.8, 2.0), (-0.3, 3.0)] {
            let place = Geodetic { latitude, longitude, height: 5e5 };
            let field = place.earth_from_north_east_down() * place.field().unwrap();
            let up = place.earth_from_north_east_down() * -Vector3::z();
            let dipole = pole - up * (3.0 * pole.dot(&up));
            assert!(field.angle(&dipole) < 0.35, "{latitude} {longitude} {}", field.angle(&dipole));
        }
    }
}
