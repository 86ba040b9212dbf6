use std::fmt;

use nalgebra::{
    Isometry3, Matrix3, Matrix4, Quaternion, SymmetricEigen, UnitQuaternion, Vector3, Vector4,
};
use serde::ser::{Serialize, SerializeStruct, Serializer};

use super::{EvaluationError, PosePairs};

/// Which freedom is taken from the estimate before it is compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Alignment {
    /// Rotation and translation, least squares over positions.
    #[default]
    Se3,
    /// Rotation, translation and scale, least squares over positions.
    Sim3,
    /// Rotation about the vertical (z) and translation, least squares over positions: what
    /// visual-inertial odometry cannot know. Both worlds must be z-up.
    Yaw,
    /// Puts the first pose of the estimate on that of the reference.
    Origin,
    /// Nothing.
    None,
}

impl Alignment {
    pub const ALL: [Self; 5] = [Self::Se3, Self::Sim3, Self::Yaw, Self::Origin, Self::None];

    pub fn name(self) -> &'static str {
        match self {
            Self::Se3 => "se3",
            Self::Sim3 => "sim3",
            Self::Yaw => "yaw",
            Self::Origin => "origin",
            Self::None => "none",
        }
    }
}

impl fmt::Display for Alignment {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

/// `p -> scale * rotation * p + translation`, from the estimate's world to the reference's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    pub rotation: UnitQuaternion<f64>,
    /// m.
    pub translation: Vector3<f64>,
    pub scale: f64,
}

impl Similarity {
    pub fn identity() -> Self {
        Self { rotation: UnitQuaternion::identity(), translation: Vector3::zeros(), scale: 1.0 }
    }

    /// Rotation about z of [`Self::rotation`], rad.
    pub fn yaw(&self) -> f64 {
        let rotation = self.rotation.to_rotation_matrix();
        (rotation[(1, 0)] - rotation[(0, 1)]).atan2(rotation[(0, 0)] + rotation[(1, 1)])
    }

    pub fn apply(&self, pose: &Isometry3<f64>) -> Isometry3<f64> {
        let position = self.scale * (self.rotation * pose.translation.vector) + self.translation;
        Isometry3::from_parts(position.into(), self.rotation * pose.rotation)
    }
}

/// `rotation` as three rows, `translation`, `scale`.
impl Serialize for Similarity {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let rotation = self.rotation.to_rotation_matrix().matrix().transpose();
        let mut fields = serializer.serialize_struct("Similarity", 3)?;
        fields.serialize_field("rotation", &<[[f64; 3]; 3]>::from(rotation))?;
        fields.serialize_field("translation", &<[f64; 3]>::from(self.translation))?;
        fields.serialize_field("scale", &self.scale)?;
        fields.end()
    }
}

/// Aligns the estimate to the reference over the first `n` pairs, all if `None`.
///
/// The least-squares solutions are those of Umeyama (1991), with the rotation from Horn's
/// quaternion (1987), whose eigenvalue gap says whether the positions determine it; yaw-only is
/// the closed form of Zhang and Scaramuzza (2018), as in OpenVINS, for one pair from its attitude.
pub fn align(
    pairs: &PosePairs,
    alignment: Alignment,
    n: Option<usize>,
) -> Result<Similarity, EvaluationError> {
    let used = n.unwrap_or(pairs.len()).min(pairs.len());
    let (estimate, reference) = (&pairs.estimate[..used], &pairs.reference[..used]);
    let (Some(first_estimate), Some(first_reference)) = (estimate.first(), reference.first())
    else {
        let (name, expected) = ("align-n", "at least 1");
        return Err(EvaluationError::Option { name, expected, value: used as f64 });
    };
    let degenerate = || EvaluationError::Degenerate { alignment, poses: used };
    let moments = || PointMoments::of(reference, estimate);
    match alignment {
        Alignment::None => Ok(Similarity::identity()),
        Alignment::Origin => {
            let motion = first_reference * first_estimate.inverse();
            Ok(Similarity {
                rotation: motion.rotation,
                translation: motion.translation.vector,
                scale: 1.0,
            })
        }
        Alignment::Se3 => {
            let moments = moments();
            Ok(moments.similarity(moments.rotation().ok_or_else(degenerate)?, 1.0))
        }
        Alignment::Sim3 => {
            let moments = moments();
            let rotation = moments.rotation().ok_or_else(degenerate)?;
            let scale = moments.scale(&rotation);
            let usable = scale > 0.0 && scale.is_finite();
            if usable { Ok(moments.similarity(rotation, scale)) } else { Err(degenerate()) }
        }
        Alignment::Yaw => {
            let mut moments = moments();
            if used == 1 {
                let relative = first_reference.rotation * first_estimate.rotation.inverse();
                moments.covariance = relative.to_rotation_matrix().into_inner();
            }
            Ok(moments.similarity(moments.yaw_rotation().ok_or_else(degenerate)?, 1.0))
        }
    }
}

/// First and second moments of two paired point sets.
pub(super) struct PointMoments {
    reference_mean: Vector3<f64>,
    estimate_mean: Vector3<f64>,
    /// Mean of `(reference - mean)(estimate - mean)^T`, m^2.
    covariance: Matrix3<f64>,
    /// Mean of `|estimate - mean|^2`, m^2.
    estimate_variance: f64,
}

impl PointMoments {
    pub(super) fn of(reference: &[Isometry3<f64>], estimate: &[Isometry3<f64>]) -> Self {
        let n = reference.len() as f64;
        let mean = |poses: &[Isometry3<f64>]| {
            poses.iter().fold(Vector3::zeros(), |sum, pose| sum + pose.translation.vector) / n
        };
        let (reference_mean, estimate_mean) = (mean(reference), mean(estimate));
        let mut covariance = Matrix3::zeros();
        let mut estimate_variance = 0.0;
        for (r, e) in reference.iter().zip(estimate) {
            let e = e.translation.vector - estimate_mean;
            covariance += (r.translation.vector - reference_mean) * e.transpose();
            estimate_variance += e.norm_squared();
        }
        Self {
            reference_mean,
            estimate_mean,
            covariance: covariance / n,
            estimate_variance: estimate_variance / n,
        }
    }

    /// The proper rotation that maximises `tr(R^T covariance)`; `None` where it is not unique.
    pub(super) fn rotation(&self) -> Option<UnitQuaternion<f64>> {
        let c = &self.covariance;
        let skew =
            Vector3::new(c[(2, 1)] - c[(1, 2)], c[(0, 2)] - c[(2, 0)], c[(1, 0)] - c[(0, 1)]);
        let trace = c.trace();
        let mut horn = Matrix4::zeros();
        horn[(0, 0)] = trace;
        horn.fixed_view_mut::<3, 1>(1, 0).copy_from(&skew);
        horn.fixed_view_mut::<1, 3>(0, 1).copy_from(&skew.transpose());
        let block = c + c.transpose() - Matrix3::identity() * trace;
        horn.fixed_view_mut::<3, 3>(1, 1).copy_from(&block);
        let eigen = SymmetricEigen::new(horn);
        let largest = eigen.eigenvalues.imax();
        let others = (0..4).filter(|i| *i != largest).map(|i| eigen.eigenvalues[i]);
        let gap = eigen.eigenvalues[largest] - others.fold(f64::NEG_INFINITY, f64::max);
        let determined = gap > UNDETERMINED * eigen.eigenvalues.amax() && gap > f64::EPSILON;
        let q: Vector4<f64> = eigen.eigenvectors.column(largest).into_owned();
        determined.then(|| UnitQuaternion::from_quaternion(Quaternion::new(q[0], q[1], q[2], q[3])))
    }

    /// The rotation about z that maximises `tr(R^T covariance)`; `None` where it is not unique.
    fn yaw_rotation(&self) -> Option<UnitQuaternion<f64>> {
        let c = &self.covariance;
        let (sine, cosine) = (c[(1, 0)] - c[(0, 1)], c[(0, 0)] + c[(1, 1)]);
        let determined = sine.hypot(cosine) > UNDETERMINED * c.norm() && c.norm() > f64::EPSILON;
        determined.then(|| UnitQuaternion::from_axis_angle(&Vector3::z_axis(), sine.atan2(cosine)))
    }

    /// Least-squares scale for a given rotation (Umeyama 1991, eq. 42); NaN for a point.
    pub(super) fn scale(&self, rotation: &UnitQuaternion<f64>) -> f64 {
        let rotation = rotation.to_rotation_matrix();
        (rotation.matrix().transpose() * self.covariance).trace() / self.estimate_variance
    }

    fn similarity(&self, rotation: UnitQuaternion<f64>, scale: f64) -> Similarity {
        let translation = self.reference_mean - scale * (rotation * self.estimate_mean);
        Similarity { rotation, translation, scale }
    }
}

/// A rotation counts as undetermined when turning it changes the fit by less than this fraction.
const UNDETERMINED: f64 = 1e-12;

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;
    use nalgebra::vector;
    use proptest::prelude::*;

    /// Pairs whose estimate is a curve and whose reference is `motion` of it.
    fn moved(motion: &Similarity, n: usize) -> PosePairs {
        let pose = |i: usize| {
            let t = i as f64 * 0.1;
            let position = vector![t.sin() * 3.0, t * 0.4, (2.0 * t).cos()];
            let rotation = UnitQuaternion::from_scaled_axis(vector![t, 0.3 * t, -t]);
            Isometry3::from_parts(position.into(), rotation)
        };
        let estimate: Vec<_> = (0..n).map(pose).collect();
        PosePairs {
            stamps: (0..n).map(|i| i as f64).collect(),
            reference: estimate.iter().map(|p| motion.apply(p)).collect(),
            estimate,
            reference_poses: n,
            estimate_poses: n,
            shared: 0,
        }
    }

    fn assert_recovers(motion: &Similarity, alignment: Alignment, n: Option<usize>) {
        let found = align(&moved(motion, 60), alignment, n).unwrap();
        assert_relative_eq!(found.translation, motion.translation, epsilon = 1e-9);
        assert!(found.rotation.angle_to(&motion.rotation) < 1e-9, "{alignment}");
        assert_relative_eq!(found.scale, motion.scale, max_relative = 1e-9);
    }

    proptest! {
        #[test]
        fn each_alignment_recovers_its_own_group(
            axis in prop::array::uniform3(-3.0..3.0_f64),
            t in prop::array::uniform3(-10.0..10.0_f64),
            scale in 0.1..10.0_f64,
            yaw in -3.1..3.1_f64,
        ) {
            let rotation = UnitQuaternion::from_scaled_axis(Vector3::from(axis));
            let translation = Vector3::from(t);
            let rigid = Similarity { rotation, translation, scale: 1.0 };
            assert_recovers(&rigid, Alignment::Se3, None);
            assert_recovers(&rigid, Alignment::Se3, Some(20));
            assert_recovers(&rigid, Alignment::Origin, None);
            assert_recovers(&Similarity { scale, ..rigid }, Alignment::Sim3, None);
            let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
            let level = Similarity { rotation, translation, scale: 1.0 };
            assert_recovers(&level, Alignment::Yaw, None);
            assert_recovers(&level, Alignment::Yaw, Some(1));
            prop_assert!((level.yaw() - yaw).abs() < 1e-12);
        }
    }

    #[test]
    fn a_reflection_yields_a_proper_rotation() {
        let mut pairs = moved(&Similarity::identity(), 60);
        for pose in &mut pairs.reference {
            pose.translation.x *= -1.0;
        }
        let found = align(&pairs, Alignment::Se3, None).unwrap();
        let determinant = found.rotation.to_rotation_matrix().matrix().determinant();
        assert_relative_eq!(determinant, 1.0, epsilon = 1e-12);
    }

    #[test]
    fn positions_on_a_line_are_refused() {
        let mut pairs = moved(&Similarity::identity(), 60);
        for pose in pairs.reference.iter_mut().chain(&mut pairs.estimate) {
            pose.translation.vector = Vector3::new(1.0, 2.0, 3.0) * pose.translation.y;
        }
        for alignment in [Alignment::Se3, Alignment::Sim3] {
            let error = align(&pairs, alignment, None).unwrap_err();
            assert!(matches!(error, EvaluationError::Degenerate { poses: 60, .. }), "{error}");
        }
        assert!(align(&pairs, Alignment::Yaw, None).is_ok());
        assert!(align(&pairs, Alignment::Origin, None).is_ok());
        assert!(matches!(
            align(&pairs, Alignment::Se3, Some(0)),
            Err(EvaluationError::Option { .. })
        ));
    }

    #[test]
    fn a_similarity_is_written_as_rows() {
        let rotation =
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::FRAC_PI_2);
        let similarity = Similarity { rotation, ..Similarity::identity() };
        let json = serde_json::to_value(similarity).unwrap();
        assert_relative_eq!(json["rotation"][0][1].as_f64().unwrap(), -1.0);
        assert_relative_eq!(json["rotation"][1][0].as_f64().unwrap(), 1.0);
        assert_eq!(json["scale"], 1.0);
    }
}
