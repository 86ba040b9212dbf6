//! The camera's mounting and clock as part of the state.
//!
#![doc = include_str!("../../../docs/theory/calibration.md")]
#![doc = include_str!("../../../docs/math.html")]

use nalgebra::{Isometry3, Matrix3, SMatrix, UnitQuaternion, Vector3};

use super::config::FilterConfig;

/// Blocks of three of a state that a [`Calibration`] takes.
pub(super) const CALIBRATION_BLOCKS: usize = 3;

/// Where in the covariance of a [`Calibration`] its parts are.
pub mod calibration_block {
    /// Rotation vector about the body's axes, rad.
    pub const ROTATION: usize = 0;
    /// Body coordinates, m.
    pub const TRANSLATION: usize = 3;
    /// s.
    pub const TIME_OFFSET: usize = 6;
}

/// How the camera is mounted and how its clock differs from the IMU's, as far as is known.
///
/// With `C` the rotation of the camera in the body, the errors are those of `exp(e^) C`, of the
/// translation and of the offset. A point seen at `p'` in the body moves with them by
/// `-(p' - t)^ e + dt + (w x p' + R^T v) d_tau`, as a frame later by `d_tau` shows a body that
/// has turned by `w d_tau` and moved by `v d_tau` (Li and Mourikis, 2014).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Calibration {
    /// Camera to body coordinates.
    pub body_from_camera: Isometry3<f64>,
    /// Added to camera stamps to bring them to the IMU's clock, s.
    pub time_offset: f64,
    /// Its blocks are those of [`calibration_block`].
    pub covariance: SMatrix<f64, 7, 7>,
}

impl Calibration {
    /// The configured calibration, as uncertain as `config` says; `None` where all of it is known.
    pub fn prior(
        config: &FilterConfig,
        body_from_camera: &Isometry3<f64>,
        time_offset: f64,
    ) -> Option<Self> {
        let rotation = config.camera_rotation_sd_deg.to_radians().powi(2);
        let translation = config.camera_translation_sd.powi(2);
        let time = config.camera_time_offset_sd.powi(2);
        let mut covariance = SMatrix::<f64, 7, 7>::zeros();
        for k in 0..3 {
            let of_rotation = calibration_block::ROTATION + k;
            let of_translation = calibration_block::TRANSLATION + k;
            covariance[(of_rotation, of_rotation)] = rotation;
            covariance[(of_translation, of_translation)] = translation;
        }
        covariance[(calibration_block::TIME_OFFSET, calibration_block::TIME_OFFSET)] = time;
        let body_from_camera = *body_from_camera;
        (covariance.trace() > 0.0).then_some(Self { body_from_camera, time_offset, covariance })
    }

    /// Standard deviations in the order of [`calibration_block`].
    pub fn standard_deviations(&self) -> [f64; 7] {
        std::array::from_fn(|k| self.covariance[(k, k)].max(0.0).sqrt())
    }

    /// Means of its blocks of the state: an error of the rotation, the translation, and the time
    /// offset in the first of three numbers.
    pub(super) fn blocks(&self) -> [Vector3<f64>; CALIBRATION_BLOCKS] {
        let offset = Vector3::new(self.time_offset, 0.0, 0.0);
        [Vector3::zeros(), self.body_from_camera.translation.vector, offset]
    }

    /// The same with the means that an update found for its blocks.
    pub(super) fn moved(&self, blocks: [Vector3<f64>; CALIBRATION_BLOCKS]) -> Self {
        let [turn, translation, offset] = blocks;
        let rotation = UnitQuaternion::from_scaled_axis(turn) * self.body_from_camera.rotation;
        let rotation = UnitQuaternion::new_normalize(rotation.into_inner());
        let body_from_camera = Isometry3::from_parts(translation.into(), rotation);
        Self { body_from_camera, time_offset: offset.x, ..*self }
    }

    /// Derivative of a point seen in the body by the blocks.
    pub(super) fn derivatives(
        &self,
        in_body: &Vector3<f64>,
        motion: &BodyMotion,
    ) -> [Matrix3<f64>; CALIBRATION_BLOCKS] {
        let [by_turn, by_shift] = self.by_mounting(in_body);
        let mut by_offset = Matrix3::zeros();
        by_offset.set_column(0, &motion.of(in_body));
        [by_turn, by_shift, by_offset]
    }

    /// The same by the mounting alone. All cameras of the body are mounted on the first.
    pub(super) fn by_mounting(&self, in_body: &Vector3<f64>) -> [Matrix3<f64>; 2] {
        let from_camera = in_body - self.body_from_camera.translation.vector;
        [-from_camera.cross_matrix(), Matrix3::identity()]
    }

    /// Where a point is in the body that was read off with another calibration, at `in_body`.
    pub(super) fn reread(
        &self,
        before: &Self,
        in_body: &Vector3<f64>,
        motion: &BodyMotion,
    ) -> Vector3<f64> {
        let (from, to) = (&before.body_from_camera, &self.body_from_camera);
        let turn = to.rotation * from.rotation.inverse();
        let seen = turn * (in_body - from.translation.vector) + to.translation.vector;
        seen + motion.of(in_body) * (self.time_offset - before.time_offset)
    }
}

/// Motion of the body in body coordinates, rad/s and m/s.
#[derive(Debug, Clone, Copy)]
pub(super) struct BodyMotion {
    pub angular_velocity: Vector3<f64>,
    pub velocity: Vector3<f64>,
}

impl BodyMotion {
    /// Slower than this (rad/s, m/s) the estimates are little more than noise.
    const STILL: f64 = 0.1;

    /// The motion, each part zero where it is slow. Noise differs from frame to frame, and taken
    /// for motion it would seem to reveal an offset of the clock that cannot be seen at rest.
    pub fn beyond_noise(&self) -> Self {
        let real = |v: &Vector3<f64>| if v.norm() > Self::STILL { *v } else { Vector3::zeros() };
        Self { angular_velocity: real(&self.angular_velocity), velocity: real(&self.velocity) }
    }

    /// How fast a point at rest comes towards the body, m/s.
    fn of(&self, in_body: &Vector3<f64>) -> Vector3<f64> {
        let motion = self.beyond_noise();
        motion.angular_velocity.cross(in_body) + motion.velocity
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// What a camera saw of a landmark, read with a calibration near the true one: where the
        /// landmark seems to be off in the body, by central differences through the motion.
        #[test]
        fn derivatives_are_those_of_what_is_seen(
            turn in [-1.0..1.0f64, -1.0..1.0, -1.0..1.0], in_camera in [-2.0..2.0f64, -2.0..2.0, 0.5..4.0],
            rate in [-2.0..2.0f64, -2.0..2.0, -2.0..2.0], velocity in [-1.0..1.0f64, -1.0..1.0, -1.0..1.0],
        ) {
            let (turn, in_camera) = (Vector3::from(turn), Vector3::from(in_camera));
            prop_assume!(Vector3::from(rate).norm() > 0.2 && Vector3::from(velocity).norm() > 0.2);
            let motion = BodyMotion {
                angular_velocity: Vector3::from(rate),
                velocity: Vector3::from(velocity),
            };
            let truth = Calibration {
                body_from_camera: Isometry3::new(Vector3::new(0.1, -0.2, 0.05), turn),
                time_offset: 0.01,
                covariance: SMatrix::zeros(),
            };
            // Body coordinates at the true time.
            let landmark = truth.body_from_camera * nalgebra::Point3::from(in_camera);
            let off = |calibration: &Calibration| {
                let later = calibration.time_offset - truth.time_offset;
                let from_body = Isometry3::new(motion.velocity * later, motion.angular_velocity * later);
                let seen = calibration.body_from_camera * nalgebra::Point3::from(in_camera);
                from_body * seen - landmark
            };
            let analytic = truth.derivatives(&landmark.coords, &motion);
            let step = 1e-5;
            for (block, derivative) in analytic.iter().enumerate() {
                for axis in 0..3 {
                    let at = |by: f64| {
                        let mut blocks = truth.blocks();
                        blocks[block][axis] += by;
                        off(&truth.moved(blocks))
                    };
                    let column = (at(step) - at(-step)) / (2.0 * step);
                    prop_assert!((column - derivative.column(axis)).norm() < 1e-6, "{block} {axis}");
                }
            }
        }
    }

    #[test]
    fn a_calibration_without_uncertainty_is_no_part_of_the_state() {
        let mounting = Isometry3::identity();
        let certain = FilterConfig::default();
        assert_eq!(Calibration::prior(&certain, &mounting, 0.0), None);
        let config = FilterConfig { camera_time_offset_sd: 0.01, ..certain };
        let prior = Calibration::prior(&config, &mounting, 0.02).unwrap();
        assert_eq!(prior.standard_deviations(), [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.01]);
        assert_eq!(prior.time_offset, 0.02);
    }
}
