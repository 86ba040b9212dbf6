use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};

/// Smallest ratio of the second to the first singular value of the cross-covariance at which
/// the rotation counts as determined; about the square of the point set's aspect ratio.
const MIN_CONDITION: f64 = 1e-7;

/// The same point in two frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WeightedPair {
    /// Coordinates in frame `b`, m.
    pub from: Vector3<f64>,
    /// Coordinates in frame `a`, m.
    pub to: Vector3<f64>,
    /// Inverse variance up to a common factor; pairs with weight 0 have no effect.
    pub weight: f64,
}

/// The pose `a_from_b` that minimises `sum w |to - R from - t|^2`, in closed form (Kabsch 1976;
/// the sign rule that excludes reflections is Umeyama's, 1991).
///
/// `None` if the rotation is not determined (fewer than three points that are not collinear),
/// or if a weight is negative or anything is not finite.
pub fn weighted_kabsch<I>(pairs: I) -> Option<Isometry3<f64>>
where
    I: IntoIterator<Item = WeightedPair>,
    I::IntoIter: Clone,
{
    let pairs = pairs.into_iter();
    let (mut total, mut from, mut to) = (0.0, Vector3::zeros(), Vector3::zeros());
    for pair in pairs.clone() {
        if pair.weight < 0.0 {
            return None;
        }
        total += pair.weight;
        from += pair.from * pair.weight;
        to += pair.to * pair.weight;
    }
    if !(total > 0.0 && total.is_finite()) {
        return None;
    }
    let (from, to) = (from / total, to / total);

    let mut cross = Matrix3::zeros();
    for pair in pairs {
        cross += (pair.to - to) * (pair.from - from).transpose() * (pair.weight / total);
    }
    let rotation = nearest_rotation(&cross)?;
    let translation = to - rotation * from;
    translation
        .iter()
        .all(|x| x.is_finite())
        .then(|| Isometry3::from_parts(Translation3::from(translation), rotation))
}

/// The rotation that maximises `tr(R^T m)`; `None` where it is not unique or `m` not finite.
fn nearest_rotation(m: &Matrix3<f64>) -> Option<UnitQuaternion<f64>> {
    if !m.iter().all(|x| x.is_finite()) {
        return None;
    }
    let mut svd = m.svd(true, true);
    svd.sort_by_singular_values();
    let (u, v_t) = (svd.u?, svd.v_t?);
    let sign = (u * v_t).determinant().signum();
    let s = svd.singular_values;
    let unique = s[1] + sign * s[2] > MIN_CONDITION * s[0];
    let rotation = u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t;
    let rotation = Rotation3::from_matrix_unchecked(rotation);
    unique.then(|| UnitQuaternion::from_rotation_matrix(&rotation))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;
    use proptest::prelude::*;

    fn pair(from: Vector3<f64>, to: Vector3<f64>, weight: f64) -> WeightedPair {
        WeightedPair { from, to, weight }
    }

    fn mapped(from: Vector3<f64>, pose: &Isometry3<f64>, weight: f64) -> WeightedPair {
        pair(from, (pose * Point3::from(from)).coords, weight)
    }

    fn vector(range: f64) -> impl Strategy<Value = Vector3<f64>> {
        [-range..range, -range..range, -range..range].prop_map(Vector3::from)
    }

    proptest! {
        #[test]
        fn planted_pose_is_recovered(
            points in prop::collection::vec((vector(3.0), 0.1..10.0f64), 4..40),
            axis_angle in vector(3.0),
            translation in vector(10.0),
        ) {
            let planted =
                Isometry3::from_parts(translation.into(), UnitQuaternion::new(axis_angle));
            let pairs = points.iter().map(|(p, w)| mapped(*p, &planted, *w));
            if let Some(found) = weighted_kabsch(pairs) {
                prop_assert!(found.rotation.angle_to(&planted.rotation) < 1e-5);
                prop_assert!((found.translation.vector - translation).norm() < 1e-4);
            }
        }
    }

    #[test]
    fn three_points_in_a_plane_suffice() {
        let pose = Isometry3::new(Vector3::new(1.0, -2.0, 0.5), Vector3::new(0.3, -2.0, 1.0));
        let corners = [Vector3::zeros(), Vector3::x() * 0.2, Vector3::y()];
        let found = weighted_kabsch(corners.map(|p| mapped(p, &pose, 1.0))).unwrap();
        assert!(found.rotation.angle_to(&pose.rotation) < 1e-9);
        assert!((found.translation.vector - pose.translation.vector).norm() < 1e-9);
    }

    #[test]
    fn mirrored_points_still_give_a_rotation() {
        let corners = [
            Vector3::new(1.0, 0.1, 0.0),
            Vector3::new(-0.4, 2.0, 0.3),
            Vector3::new(0.2, -0.3, 3.0),
            Vector3::new(-1.0, -1.0, -1.0),
        ];
        let mirrored = corners.map(|p| pair(p, Vector3::new(-p.x, p.y, p.z), 1.0));
        let found = weighted_kabsch(mirrored).unwrap();
        assert!((found.rotation.to_rotation_matrix().matrix().determinant() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn undetermined_rotations_are_refused() {
        let line: Vec<_> = (0..9).map(|i| Vector3::new(0.1, -0.2, 0.3) * f64::from(i)).collect();
        let point = Vector3::new(1.0, 2.0, 3.0);
        for points in [line, vec![point; 5], vec![point, Vector3::zeros()], vec![]] {
            assert_eq!(weighted_kabsch(points.iter().map(|p| pair(*p, *p, 1.0))), None);
        }
        let good = [Vector3::x(), Vector3::y(), Vector3::z()];
        assert_eq!(weighted_kabsch(good.map(|p| pair(p, p, 0.0))), None);
        assert_eq!(weighted_kabsch(good.map(|p| pair(p, p, -1.0))), None);
        assert_eq!(weighted_kabsch(good.map(|p| pair(p, p * f64::NAN, 1.0))), None);
        assert_eq!(weighted_kabsch(good.map(|p| pair(p, p, f64::INFINITY))), None);
    }

    #[test]
    fn a_weightless_outlier_has_no_effect() {
        let pose = Isometry3::new(Vector3::new(0.0, 1.0, 0.0), Vector3::new(0.0, 0.0, 0.7));
        let mut pairs: Vec<_> = [Vector3::x(), Vector3::y(), Vector3::z(), Vector3::zeros()]
            .map(|p| mapped(p, &pose, 1.0))
            .to_vec();
        pairs.push(pair(Vector3::new(5.0, 5.0, 5.0), Vector3::zeros(), 0.0));
        let found = weighted_kabsch(pairs).unwrap();
        assert!(found.rotation.angle_to(&pose.rotation) < 1e-9);
    }
}
