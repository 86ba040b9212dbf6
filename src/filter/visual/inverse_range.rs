//! Points by their inverse range along a ray.

use nalgebra::{Matrix3, Matrix3x2, Vector3};

/// Points are looked for up to the distance of 10 km, 1/m: nothing that a camera of a body sees from
/// poses of some seconds tells it from infinity.
pub(super) const LEAST_INVERSE_RANGE: f64 = 1e-4;

/// A point by its direction from a place and its inverse range: `l = o + (x a_x + y a_y + a_z) / q`,
/// parameters `(x, y, q)`. In these a far point is as good as a near one.
#[derive(Debug, Clone, Copy)]
pub(super) struct Ray {
    /// In the frame of the point, as the axes are, m.
    pub from: Vector3<f64>,
    /// Columns: two axes across the direction, and the direction.
    pub axes: Matrix3<f64>,
}

impl Ray {
    pub fn point(&self, parameters: &Vector3<f64>) -> Vector3<f64> {
        self.from + self.axes * Vector3::new(parameters.x, parameters.y, 1.0) / parameters.z
    }

    pub fn derivative(&self, parameters: &Vector3<f64>) -> Matrix3<f64> {
        let across: Matrix3x2<f64> = self.axes.fixed_columns::<2>(0) / parameters.z;
        let along = (self.from - self.point(parameters)) / parameters.z;
        Matrix3::from_columns(&[across.column(0).into(), across.column(1).into(), along])
    }
}

/// Two axes across a unit vector and the vector itself, as columns.
pub(super) fn axes_along(direction: &Vector3<f64>) -> Matrix3<f64> {
    let across = direction.cross(&Vector3::ith(direction.iamin(), 1.0)).normalize();
    Matrix3::from_columns(&[across, direction.cross(&across), *direction])
}
