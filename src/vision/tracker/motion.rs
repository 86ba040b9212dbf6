//! How the image moves between two frames by the turn of the camera alone.

use nalgebra::{Matrix2, Point2, UnitQuaternion, Vector3};

use super::turn::Turn;
use crate::sensor::Camera;

/// From the former frame to the present one.
#[derive(Debug, Clone)]
pub(super) struct ImageMotion {
    pub camera: Camera,
    /// `None` where nothing tells it.
    pub turn: Option<Turn>,
    /// Between the frames, s.
    pub seconds: f64,
    /// From the exposure of the first row to that of the last, s.
    pub readout_time: f64,
    /// Rows of the image.
    pub height: f64,
}

impl ImageMotion {
    /// The turn between the exposures of a row of the former frame and one of the present frame.
    pub fn rotation(&self, turn: &Turn, rows: [f64; 2]) -> UnitQuaternion<f64> {
        if self.readout_time == 0.0 {
            return turn.rotation;
        }
        let late = |k: usize| (rows[k] / self.height - 0.5) * self.readout_time;
        let by = |k: usize| UnitQuaternion::from_scaled_axis(turn.rates[k] * late(k));
        by(1).inverse() * turn.rotation * by(0)
    }

    /// Where a pixel of the former frame comes to lie, and the derivative by it; `None` where the
    /// lens does not image it. Without a known turn it stays.
    pub fn turned(&self, pixel: Point2<f64>) -> Option<(Point2<f64>, Matrix2<f64>)> {
        let Some(turn) = &self.turn else { return Some((pixel, Matrix2::identity())) };
        let ray = self.camera.unproject(pixel, 1.0)?;
        let mut rotation = turn.rotation;
        if self.readout_time > 0.0 {
            let place = self.camera.project(&(rotation * ray))?;
            rotation = self.rotation(turn, [pixel.y, place.y]);
        }
        let (place, projection) = self.camera.project_with_jacobian(&(rotation * ray))?;
        let across = self.camera.across(&ray, 1.0)?;
        Some((place, projection * (rotation.to_rotation_matrix() * across)))
    }

    /// Directions of a point at `former` and `present`, the former one turned into the present frame
    /// if the turn is known.
    pub fn directions(
        &self,
        former: Point2<f64>,
        present: Point2<f64>,
    ) -> Option<[Vector3<f64>; 2]> {
        let before = self.camera.bearing(former)?.into_inner();
        let now = self.camera.bearing(present)?.into_inner();
        let before = match &self.turn {
            Some(turn) => self.rotation(turn, [former.y, present.y]) * before,
            None => before,
        };
        Some([before, now])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::PinholeCamera;

    fn motion(readout_time: f64) -> ImageMotion {
        let camera = Camera::pinhole(PinholeCamera { fx: 400.0, fy: 420.0, cx: 320.0, cy: 240.0 });
        let rate = Vector3::new(0.3, -0.5, 0.8);
        let rotation = UnitQuaternion::from_scaled_axis(rate * 0.05).inverse();
        let turn = Some(Turn { rotation, sigma: 0.0, rates: [rate; 2] });
        ImageMotion { camera, turn, seconds: 0.05, readout_time, height: 480.0 }
    }

    /// Against finite differences, and against points that are seen while the camera turns.
    #[test]
    fn a_point_is_predicted_with_its_derivative() {
        let motion = motion(0.0);
        let pixel = Point2::new(200.0, 150.0);
        let (place, derivative) = motion.turned(pixel).unwrap();
        for (axis, column) in derivative.column_iter().enumerate() {
            let mut beside = pixel;
            beside[axis] += 1e-4;
            let difference = (motion.turned(beside).unwrap().0 - place) / 1e-4;
            assert!((difference - column).norm() < 1e-5);
        }
        let [before, now] = motion.directions(pixel, place).unwrap();
        assert!((before - now).norm() < 1e-9);
    }

    #[test]
    fn rows_are_exposed_one_after_another() {
        let motion = motion(0.02);
        let rate = motion.turn.unwrap().rates[0];
        // The point's rays at the times when the rows that show it are exposed.
        let world = Vector3::new(-0.3, 0.35, 1.0);
        let seen_at = |frame: f64| {
            let mut pixel = Point2::new(320.0, 240.0);
            for _ in 0..30 {
                let time = frame + (pixel.y / 480.0 - 0.5) * 0.02;
                let turned = UnitQuaternion::from_scaled_axis(rate * time).inverse() * world;
                pixel = motion.camera.project(&turned).unwrap();
            }
            pixel
        };
        let (former, present) = (seen_at(0.0), seen_at(0.05));
        let (place, _) = motion.turned(former).unwrap();
        assert!((place - present).norm() < 0.02, "{place} {present}");
        let [before, now] = motion.directions(former, present).unwrap();
        assert!((before - now).norm() < 1e-9);
    }
}
