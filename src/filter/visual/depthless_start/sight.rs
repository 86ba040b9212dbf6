//! What a pixel says of a point.

use nalgebra::{Isometry3, Matrix2, Matrix2x3, Matrix3, Point3, Vector2, Vector3};

use super::StartView;
use crate::filter::core::FilterError;
use crate::filter::visual::inverse_range::axes_along;
use crate::filter::visual::slam::MountedCamera;

/// A view with its camera and its direction.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sight {
    pub frame: usize,
    pub camera_from_body: Isometry3<f64>,
    /// Unit vector, camera coordinates.
    pub bearing: Vector3<f64>,
    /// Two unit vectors across it, as rows.
    across: Matrix2x3<f64>,
    /// Brings what is seen across the bearing, as a tangent, to white noise of variance one.
    pub weight: Matrix2<f64>,
}

impl Sight {
    pub fn of(
        view: &StartView,
        cameras: &[MountedCamera],
        frames: usize,
    ) -> Result<Self, FilterError> {
        let mounted = MountedCamera::among(cameras, view.camera)?;
        if view.frame >= frames {
            return Err(FilterError::UnknownClone(view.frame as u64));
        }
        let unseen = FilterError::NotFinite("direction of a view");
        let bearing = mounted.camera.bearing(view.pixel).ok_or(unseen)?.into_inner();
        let (_, by_point) = mounted.camera.project_with_jacobian(&bearing).ok_or(unseen)?;
        let across = axes_along(&bearing).fixed_columns::<2>(0).transpose();
        let not_positive = FilterError::NotPositive("covariance of a pixel");
        let root = view.pixel_covariance.cholesky().ok_or(not_positive)?.l();
        let weight = root.try_inverse().ok_or(not_positive)? * by_point * across.transpose();
        let camera_from_body = mounted.body_from_camera.inverse();
        Ok(Self { frame: view.frame, camera_from_body, bearing, across, weight })
    }

    pub fn in_camera(&self, in_body: &Vector3<f64>) -> Vector3<f64> {
        (self.camera_from_body * Point3::from(*in_body)).coords
    }

    /// Whitened residual of a point (body coordinates), and its derivative by the point:
    /// `e = B c / (b . c)`, `de = (B - e b^T) / (b . c) dc`; `None` where it is not in front.
    pub fn residual(&self, in_body: &Vector3<f64>) -> Option<(Vector2<f64>, Matrix2x3<f64>)> {
        let in_camera = self.in_camera(in_body);
        let along = self.bearing.dot(&in_camera);
        if along <= 0.0 {
            return None;
        }
        let seen = self.across * in_camera / along;
        let by_camera = (self.across - seen * self.bearing.transpose()) / along;
        let rotation = self.camera_from_body.rotation.to_rotation_matrix();
        Some((-(self.weight * seen), self.weight * by_camera * rotation.matrix()))
    }

    /// `[b]x c = [b]x (C c_b + s)`, linear in the point `c_b` in the body: matrix and constant.
    pub fn linear(&self) -> (Matrix3<f64>, Vector3<f64>) {
        let skew = self.bearing.cross_matrix();
        let rotation = self.camera_from_body.rotation.to_rotation_matrix();
        (skew * rotation.matrix(), skew * self.camera_from_body.translation.vector)
    }
}
