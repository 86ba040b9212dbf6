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

    /// The rotation that maximises `tr(R^T covariance)` among those that the alignment may take;
    /// `None` where it is not unique.
    fn rotation(self, covariance: &Matrix3<f64>) -> Option<UnitQuaternion<f64>> {
        match self {
            Self::Yaw => yaw_rotation(covariance),
            _ => rotation(covariance),
        }
    }

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
/// the closed form of Zhang and Scaramuzza (2018), as in OpenVINS. What the positions leave open
/// (of points on a line the turn about it, of a single point all) is taken from the attitudes.
pub fn align(
    pairs: &PosePairs,
    alignment: Alignment,
    n: Option<usize>,
) -> Result<Similarity, EvaluationError> {
    Ok(Fit::new(pairs, alignment, n)?.similarity)
}

/// An alignment for the comparison of attitudes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AttitudeAlignment {
    pub similarity: Similarity,
    /// Root mean square attitude error under the alignment that fits the positions best, degrees,
    /// where that is not the one taken.
    pub by_positions: Option<f64>,
}

/// The alignment of positions ([`align`]), unless they do not determine it and the attitudes
/// contradict it: where reference and estimate share less than a quarter of the variance that
/// decides the rotation, and the rotation of least squares over positions *and* attitudes, each
/// weighted by its own residuals, more than halves the attitude error and makes the mean square
/// position error at most twice as large, that one is taken. So a run that stands still or goes
/// straight is not told an attitude error that only its alignment has.
pub fn align_attitudes(
    pairs: &PosePairs,
    alignment: Alignment,
    n: Option<usize>,
) -> Result<AttitudeAlignment, EvaluationError> {
    let fit = Fit::new(pairs, alignment, n)?;
    let plain = AttitudeAlignment { similarity: fit.similarity, by_positions: None };
    if fit.moments.shared_variance(alignment) >= DETERMINED {
        return Ok(plain);
    }
    let Some(joint) = fit.joint() else { return Ok(plain) };
    let (positions, attitudes) = (fit.residuals(&fit.similarity), fit.residuals(&joint));
    let is_better = 4.0 * attitudes.attitude < positions.attitude
        && attitudes.position <= 2.0 * positions.position;
    Ok(match is_better {
        true => AttitudeAlignment {
            similarity: joint,
            by_positions: Some(positions.attitude.sqrt().to_degrees()),
        },
        false => plain,
    })
}

/// An alignment and the pairs that it is of.
struct Fit<'a> {
    alignment: Alignment,
    reference: &'a [Isometry3<f64>],
    estimate: &'a [Isometry3<f64>],
    moments: PointMoments,
    similarity: Similarity,
}

/// Mean squares, m^2 and rad^2.
struct Residuals {
    position: f64,
    attitude: f64,
}

/// Share of the variance of the positions above which they determine a rotation. The published
/// results of VCU-RVI, which drift by more than their path is wide, share a third or more.
const DETERMINED: f64 = 0.25;
/// Weight of the attitudes where they decide only what the positions leave open.
const FAINT: f64 = 1e-9;
/// Mean square attitude errors below this are rounding, rad^2.
const ROUNDING: f64 = 1e-14;

impl<'a> Fit<'a> {
    fn new(
        pairs: &'a PosePairs,
        alignment: Alignment,
        n: Option<usize>,
    ) -> Result<Self, EvaluationError> {
        let used = n.unwrap_or(pairs.len()).min(pairs.len());
        let (estimate, reference) = (&pairs.estimate[..used], &pairs.reference[..used]);
        let (Some(first_estimate), Some(first_reference)) = (estimate.first(), reference.first())
        else {
            let (name, expected) = ("align-n", "at least 1");
            return Err(EvaluationError::Option { name, expected, value: used as f64 });
        };
        let moments = PointMoments::of(reference, estimate);
        let degenerate = || EvaluationError::Degenerate { alignment, poses: used };
        let similarity = match alignment {
            Alignment::None => Similarity::identity(),
            Alignment::Origin => {
                let motion = first_reference * first_estimate.inverse();
                let (rotation, translation) = (motion.rotation, motion.translation.vector);
                Similarity { rotation, translation, scale: 1.0 }
            }
            Alignment::Se3 | Alignment::Sim3 | Alignment::Yaw => {
                let positions = moments.covariance;
                let attitudes = attitude_covariance(reference, estimate);
                let filled = positions + attitudes * (FAINT * positions.norm());
                let rotation = [positions, filled, attitudes]
                    .iter()
                    .find_map(|covariance| alignment.rotation(covariance))
                    .ok_or_else(degenerate)?;
                moments.similarity(rotation, alignment).ok_or_else(degenerate)?
            }
        };
        Ok(Self { alignment, reference, estimate, moments, similarity })
    }

    /// Least squares over positions and attitudes; `None` where the alignment is not one of least
    /// squares.
    fn joint(&self) -> Option<Similarity> {
        if matches!(self.alignment, Alignment::None | Alignment::Origin) {
            return None;
        }
        let attitudes = attitude_covariance(self.reference, self.estimate);
        let by_attitudes =
            self.moments.similarity(self.alignment.rotation(&attitudes)?, self.alignment)?;
        // Variances of a component of the position and of the rotation vector.
        let position = self.residuals(&self.similarity).position / 3.0;
        let attitude = self.residuals(&by_attitudes).attitude.max(ROUNDING) / 3.0;
        let scale = self.similarity.scale;
        // tr(R^T C) falls by |e|^2 with a turn e of attitudes, by |e|^2 / 2 per m^2 of positions.
        let joint = self.moments.covariance * scale + attitudes * (position / (2.0 * attitude));
        self.moments.similarity(self.alignment.rotation(&joint)?, self.alignment)
    }

    fn residuals(&self, similarity: &Similarity) -> Residuals {
        let mut sum = Residuals { position: 0.0, attitude: 0.0 };
        for (reference, estimate) in self.reference.iter().zip(self.estimate) {
            let estimate = similarity.apply(estimate);
            let distance = estimate.translation.vector - reference.translation.vector;
            sum.position += distance.norm_squared();
            sum.attitude += estimate.rotation.angle_to(&reference.rotation).powi(2);
        }
        let n = self.reference.len() as f64;
        Residuals { position: sum.position / n, attitude: sum.attitude / n }
    }
}

/// Mean of `R_reference R_estimate^T`: the rotation nearest to it brings the attitudes together.
fn attitude_covariance(reference: &[Isometry3<f64>], estimate: &[Isometry3<f64>]) -> Matrix3<f64> {
    let turns = reference.iter().zip(estimate).map(|(r, e)| r.rotation * e.rotation.inverse());
    let sum = turns.fold(Matrix3::zeros(), |sum, turn| sum + *turn.to_rotation_matrix().matrix());
    sum / reference.len() as f64
}

/// First and second moments of two paired point sets.
pub(super) struct PointMoments {
    reference_mean: Vector3<f64>,
    estimate_mean: Vector3<f64>,
    /// Mean of `(reference - mean)(estimate - mean)^T`, m^2.
    covariance: Matrix3<f64>,
    reference_covariance: Matrix3<f64>,
    estimate_covariance: Matrix3<f64>,
}

impl PointMoments {
    pub(super) fn of(reference: &[Isometry3<f64>], estimate: &[Isometry3<f64>]) -> Self {
        let n = reference.len() as f64;
        let mean = |poses: &[Isometry3<f64>]| {
            poses.iter().fold(Vector3::zeros(), |sum, pose| sum + pose.translation.vector) / n
        };
        let (reference_mean, estimate_mean) = (mean(reference), mean(estimate));
        let [mut covariance, mut reference_covariance, mut estimate_covariance] =
            [Matrix3::zeros(); 3];
        for (r, e) in reference.iter().zip(estimate) {
            let r = r.translation.vector - reference_mean;
            let e = e.translation.vector - estimate_mean;
            covariance += r * e.transpose();
            reference_covariance += r * r.transpose();
            estimate_covariance += e * e.transpose();
        }
        Self {
            reference_mean,
            estimate_mean,
            covariance: covariance / n,
            reference_covariance: reference_covariance / n,
            estimate_covariance: estimate_covariance / n,
        }
    }

    /// The share of variance that reference and estimate have in common along the direction that
    /// decides the rotation: the second most extended one in space, the first one for the heading.
    fn shared_variance(&self, alignment: Alignment) -> f64 {
        let (dimensions, deciding) = if alignment == Alignment::Yaw { (2, 0) } else { (3, 1) };
        let part = |covariance: &Matrix3<f64>| {
            let part = covariance.view((0, 0), (dimensions, dimensions)).into_owned();
            part.singular_values()[deciding]
        };
        let variances = part(&self.reference_covariance) * part(&self.estimate_covariance);
        let share = part(&self.covariance).powi(2) / variances;
        if share.is_finite() { share } else { 0.0 }
    }

    pub(super) fn rotation(&self) -> Option<UnitQuaternion<f64>> {
        rotation(&self.covariance)
    }

    /// Least-squares scale for a given rotation (Umeyama 1991, eq. 42); NaN for a point.
    pub(super) fn scale(&self, rotation: &UnitQuaternion<f64>) -> f64 {
        let rotation = rotation.to_rotation_matrix();
        let covariance = rotation.matrix().transpose() * self.covariance;
        covariance.trace() / self.estimate_covariance.trace()
    }

    /// Centre on centre; `None` where a scale is wanted and not determined.
    fn similarity(
        &self,
        rotation: UnitQuaternion<f64>,
        alignment: Alignment,
    ) -> Option<Similarity> {
        let scale = if alignment == Alignment::Sim3 { self.scale(&rotation) } else { 1.0 };
        let translation = self.reference_mean - scale * (rotation * self.estimate_mean);
        let usable = scale > 0.0 && scale.is_finite();
        usable.then_some(Similarity { rotation, translation, scale })
    }
}

/// The proper rotation that maximises `tr(R^T covariance)`; `None` where it is not unique.
fn rotation(covariance: &Matrix3<f64>) -> Option<UnitQuaternion<f64>> {
    let c = covariance;
    let skew = Vector3::new(c[(2, 1)] - c[(1, 2)], c[(0, 2)] - c[(2, 0)], c[(1, 0)] - c[(0, 1)]);
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
fn yaw_rotation(covariance: &Matrix3<f64>) -> Option<UnitQuaternion<f64>> {
    let c = covariance;
    let (sine, cosine) = (c[(1, 0)] - c[(0, 1)], c[(0, 0)] + c[(1, 1)]);
    let determined = sine.hypot(cosine) > UNDETERMINED * c.norm() && c.norm() > f64::EPSILON;
    determined.then(|| UnitQuaternion::from_axis_angle(&Vector3::z_axis(), sine.atan2(cosine)))
}

/// A rotation counts as undetermined when turning it changes the fit by less than this fraction.
const UNDETERMINED: f64 = 1e-12;

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;
    use nalgebra::vector;
    use proptest::prelude::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

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

    /// Pairs like those of [`moved`], their positions scaled by each factor and disturbed.
    fn flattened(factors: Vector3<f64>, noise: f64) -> PosePairs {
        let motion = Similarity {
            rotation: UnitQuaternion::from_scaled_axis(vector![0.1, -0.2, 2.0]),
            translation: vector![5.0, -3.0, 1.0],
            scale: 1.0,
        };
        let mut pairs = moved(&motion, 200);
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut disturbed = |position: Vector3<f64>| {
            position + Vector3::from_fn(|_, _| noise * (rng.random::<f64>() - 0.5))
        };
        for (reference, estimate) in pairs.reference.iter_mut().zip(&mut pairs.estimate) {
            let exact = estimate.translation.vector.component_mul(&factors);
            estimate.translation.vector = disturbed(exact);
            let exact = motion.rotation * exact + motion.translation;
            reference.translation.vector = disturbed(exact);
        }
        pairs
    }

    fn attitude_rmse(pairs: &PosePairs, similarity: &Similarity) -> f64 {
        let angles = pairs.reference.iter().zip(&pairs.estimate).map(|(reference, estimate)| {
            similarity.apply(estimate).rotation.angle_to(&reference.rotation).powi(2)
        });
        (angles.sum::<f64>() / pairs.len() as f64).sqrt().to_degrees()
    }

    #[test]
    fn what_positions_leave_open_is_taken_from_the_attitudes() {
        let lines = [vector![0.0, 1.0, 0.0], vector![0.0, 0.0, 1.0], vector![0.0, 0.0, 0.0]];
        for (factors, noise) in lines.into_iter().flat_map(|f| [(f, 0.0), (f, 1e-4), (f, 1e-2)]) {
            let pairs = flattened(factors, noise);
            let aligned = align_attitudes(&pairs, Alignment::Se3, None).unwrap();
            let error = attitude_rmse(&pairs, &aligned.similarity);
            assert!(error < 0.1, "{factors:?}, {noise} m: {error} deg");
            let position = |similarity: &Similarity| {
                let fit = Fit::new(&pairs, Alignment::Se3, None).unwrap();
                fit.residuals(similarity).position.sqrt()
            };
            assert!(position(&aligned.similarity) < noise + 1e-6);
            // The best fit of positions stays the best fit of positions.
            let plain = align(&pairs, Alignment::Se3, None).unwrap();
            assert!(position(&plain) <= position(&aligned.similarity) + 1e-9);
        }
        let still = flattened(Vector3::zeros(), 0.0);
        assert!(matches!(
            align(&still, Alignment::Sim3, None),
            Err(EvaluationError::Degenerate { poses: 200, .. })
        ));
        assert!(matches!(
            align(&still, Alignment::Se3, Some(0)),
            Err(EvaluationError::Option { .. })
        ));
    }

    #[test]
    fn attitudes_do_not_move_what_positions_determine() {
        let mut pairs = flattened(vector![1.0, 1.0, 1.0], 1e-2);
        let plain = align(&pairs, Alignment::Se3, None).unwrap();
        // A mounting that nobody took into account: an error of the attitudes, not of the world.
        for pose in &mut pairs.estimate {
            pose.rotation *= UnitQuaternion::from_scaled_axis(vector![0.0, 0.3, 0.0]);
        }
        let aligned = align_attitudes(&pairs, Alignment::Se3, None).unwrap();
        assert_eq!((aligned.similarity, aligned.by_positions), (plain, None));
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
