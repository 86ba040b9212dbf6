//! Least squares of which the points are eliminated.

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

use super::motion::{BySought, Sought};
use crate::filter::visual::inverse_range::{LEAST_INVERSE_RANGE, Ray, axes_along};

/// Information of a point along what it does not show, relative to that along what it does.
const LEAST_INFORMATION: f64 = 1e-12;

/// A point on the ray from where it was seen first. What moves it by the ray's parameters keeps it
/// before that camera.
#[derive(Debug, Clone, Copy)]
pub(super) struct Chart {
    pub ray: Ray,
    pub inverse_range: f64,
}

impl Chart {
    /// Around a point as seen from a place; `None` at that place.
    pub fn around(point: &Vector3<f64>, from: Vector3<f64>) -> Option<Self> {
        let along = (point - from).try_normalize(0.0)?;
        let ray = Ray { from, axes: axes_along(&along) };
        Some(Self { ray, inverse_range: (point - from).norm().recip() })
    }

    /// The point after a step of its place, to first order.
    pub fn moved(&self, by: &Vector3<f64>) -> Vector3<f64> {
        let by = self.ray.axes.transpose() * by * self.inverse_range;
        let inverse_range = (self.inverse_range * (1.0 - by.z)).max(LEAST_INVERSE_RANGE);
        self.ray.point(&Vector3::new(by.x, by.y, inverse_range))
    }
}

/// Normal equations of a least-squares problem in what is sought, all points eliminated.
pub(super) struct Normal {
    information: SMatrix<f64, 12, 12>,
    gradient: Sought,
    /// For each point what makes it follow: its own information, its part with what is sought, and
    /// its own gradient.
    pub points: Vec<(Matrix3<f64>, BySought, Vector3<f64>)>,
}

impl Normal {
    pub fn empty(points: usize) -> Self {
        Self {
            information: SMatrix::zeros(),
            gradient: Sought::zeros(),
            points: vec![(Matrix3::zeros(), BySought::zeros(), Vector3::zeros()); points],
        }
    }

    /// Adds rows `residual = by_point dl + by_sought dx + noise`.
    pub fn add<const N: usize>(
        &mut self,
        point: usize,
        residual: &SVector<f64, N>,
        by_point: &SMatrix<f64, N, 3>,
        by_sought: &SMatrix<f64, N, 12>,
    ) {
        self.information += by_sought.transpose() * by_sought;
        self.gradient += by_sought.transpose() * residual;
        let (own, cross, gradient) = &mut self.points[point];
        *own += by_point.transpose() * by_point;
        *cross += by_point.transpose() * by_sought;
        *gradient += by_point.transpose() * residual;
    }

    /// Adds `residual = direction . dx + noise` of a part of what is sought.
    pub fn add_prior(&mut self, start: usize, direction: &Vector3<f64>, residual: f64) {
        let mut information = self.information.fixed_view_mut::<3, 3>(start, start);
        information += direction * direction.transpose();
        let mut gradient = self.gradient.fixed_rows_mut::<3>(start);
        gradient += direction * residual;
    }

    /// Information and gradient without the points, each damped by so much of its own information.
    pub fn reduced(&self, damping: f64) -> Option<(SMatrix<f64, 12, 12>, Sought)> {
        let (mut information, mut gradient) = (self.information, self.gradient);
        (0..12).for_each(|k| information[(k, k)] *= 1.0 + damping);
        for (own, cross, of_point) in &self.points {
            let factor = damped(own, damping).cholesky()?;
            information -= cross.transpose() * factor.solve(cross);
            gradient -= cross.transpose() * factor.solve(of_point);
        }
        Some((information, gradient))
    }

    /// The step of what is sought and of all points.
    pub fn step(&self, damping: f64) -> Option<(Sought, Vec<Vector3<f64>>)> {
        let (information, gradient) = self.reduced(damping)?;
        let step = information.cholesky()?.solve(&gradient);
        let of_point = |(own, cross, gradient): &(Matrix3<f64>, BySought, Vector3<f64>)| {
            Some(damped(own, damping).cholesky()?.solve(&(gradient - cross * step)))
        };
        Some((step, self.points.iter().map(of_point).collect::<Option<_>>()?))
    }
}

pub(super) fn damped(information: &Matrix3<f64>, damping: f64) -> Matrix3<f64> {
    let mut damped = *information;
    let least = LEAST_INFORMATION * information.trace();
    (0..3).for_each(|k| damped[(k, k)] += damping * damped[(k, k)] + least);
    damped
}
