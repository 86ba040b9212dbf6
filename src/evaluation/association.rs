use nalgebra::Isometry3;
use serde::Serialize;

use super::guards::{self, MIN_MATCHES};
use super::{EvaluationError, Trajectory};

/// How a pose finds its counterpart.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum AssociationRule {
    /// Each pose of the trajectory with fewer poses takes the nearest of the other: `evo`.
    #[default]
    Nearest,
    /// Each pose of the estimate takes the nearest of the reference poses that come after those
    /// already taken: OpenVINS (`AlignUtils::perform_association`). Of two estimates with the
    /// same stamp the second gets the next reference pose; `evo`'s V102 has four such pairs.
    OpenVins,
}

/// Which poses belong together.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct AssociationOptions {
    pub rule: AssociationRule,
    /// Poses further apart in time than this are no pair, s.
    pub max_diff: f64,
    /// Added to the stamps of the estimate before they are compared, s.
    pub time_offset: f64,
}

impl Default for AssociationOptions {
    fn default() -> Self {
        Self { rule: AssociationRule::Nearest, max_diff: 0.01, time_offset: 0.0 }
    }
}

/// Poses of two trajectories that belong together, in the order of time.
#[derive(Debug, Clone, PartialEq)]
pub struct PosePairs {
    /// Stamps of the estimate's poses, in its own clock, s.
    pub stamps: Vec<f64>,
    pub reference: Vec<Isometry3<f64>>,
    pub estimate: Vec<Isometry3<f64>>,
    /// Poses of the reference before association.
    pub reference_poses: usize,
    /// Poses of the estimate before association.
    pub estimate_poses: usize,
    /// Pairs whose pose of the longer trajectory already belongs to the pair before: the longer
    /// one has a gap there, and the tolerance is wider than it should be.
    pub shared: usize,
}

impl PosePairs {
    pub fn len(&self) -> usize {
        self.stamps.len()
    }

    pub fn is_empty(&self) -> bool {
        self.stamps.is_empty()
    }
}

/// Pairs poses by time. The default pairs each pose of the trajectory with fewer poses with the
/// nearest of the other, if that is within the tolerance; the earlier of two that are equally
/// near.
///
/// The same rule, in the same arithmetic, as `evo` 1.38. Linear in the number of poses.
pub fn associate(
    reference: &Trajectory,
    estimate: &Trajectory,
    options: &AssociationOptions,
) -> Result<PosePairs, EvaluationError> {
    let indices = matches(reference, estimate, options)?;
    if indices.len() < MIN_MATCHES {
        return Err(guards::too_few_matches(reference, estimate, options, indices.len()));
    }
    let estimate_is_longer = estimate.len() > reference.len();
    let longer = |&(r, e): &(usize, usize)| if estimate_is_longer { e } else { r };
    Ok(PosePairs {
        stamps: indices.iter().map(|&(_, e)| estimate.stamps()[e]).collect(),
        reference: indices.iter().map(|&(r, _)| reference.poses()[r]).collect(),
        estimate: indices.iter().map(|&(_, e)| estimate.poses()[e]).collect(),
        reference_poses: reference.len(),
        estimate_poses: estimate.len(),
        shared: indices.windows(2).filter(|w| longer(&w[0]) == longer(&w[1])).count(),
    })
}

/// Indices into (reference, estimate).
pub(super) fn matches(
    reference: &Trajectory,
    estimate: &Trajectory,
    options: &AssociationOptions,
) -> Result<Vec<(usize, usize)>, EvaluationError> {
    let AssociationOptions { rule, max_diff, time_offset } = *options;
    if !(max_diff >= 0.0 && max_diff.is_finite()) {
        let (name, expected) = ("max-diff", "finite and not negative");
        return Err(EvaluationError::Option { name, expected, value: max_diff });
    }
    if !time_offset.is_finite() {
        let (name, expected) = ("time-offset", "finite");
        return Err(EvaluationError::Option { name, expected, value: time_offset });
    }
    if rule == AssociationRule::OpenVins {
        return Ok(in_the_manner_of_openvins(
            reference.stamps(),
            estimate.stamps(),
            time_offset,
            max_diff,
        ));
    }
    let estimate_is_longer = estimate.len() > reference.len();
    let (shorter, longer, offset) = if estimate_is_longer {
        (reference.stamps(), estimate.stamps(), time_offset)
    } else {
        (estimate.stamps(), reference.stamps(), -time_offset)
    };
    let order = |(s, l): (usize, usize)| if estimate_is_longer { (s, l) } else { (l, s) };
    Ok(nearest(shorter, longer, offset, max_diff).map(order).collect())
}

/// Indices into (shorter, longer); `offset` is added to the stamps of the longer one.
fn nearest(
    shorter: &[f64],
    longer: &[f64],
    offset: f64,
    max_diff: f64,
) -> impl Iterator<Item = (usize, usize)> {
    let shifted = move |index: usize| longer.get(index).map(|stamp| stamp + offset);
    // The first of the longer one that is later than the current stamp of the shorter one.
    let mut next = 0;
    shorter.iter().enumerate().filter_map(move |(index, &stamp)| {
        while shifted(next).is_some_and(|other| other <= stamp) {
            next += 1;
        }
        let previous = next.checked_sub(1);
        let after = shifted(next).map_or(f64::INFINITY, |other| other - stamp);
        let before = previous.and_then(shifted).map_or(f64::INFINITY, |other| stamp - other);
        if after <= max_diff && after < before {
            Some((index, next))
        } else if before <= max_diff && before <= after {
            previous.map(|other| (index, other))
        } else {
            None
        }
    })
}

/// Indices into (reference, estimate), by [`AssociationRule::OpenVins`].
fn in_the_manner_of_openvins(
    reference: &[f64],
    estimate: &[f64],
    offset: f64,
    max_diff: f64,
) -> Vec<(usize, usize)> {
    let mut next = 0;
    let partner = |stamp: f64| {
        let distance =
            |index: usize| reference.get(index).map(|other| (other - stamp, (other - stamp).abs()));
        while distance(next).is_some_and(|(signed, d)| signed < 0.0 && d > max_diff) {
            next += 1;
        }
        let (mut best, mut nearest) = (max_diff, None);
        while let Some((_, d)) = distance(next).filter(|(_, d)| *d <= max_diff && *d < best) {
            (best, nearest) = (d, Some(next));
            next += 1;
        }
        nearest
    };
    let partners: Vec<_> = estimate.iter().map(|stamp| stamp + offset).map(partner).collect();
    partners.into_iter().zip(0..).filter_map(|(r, e)| Some((r?, e))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn still(stamps: &[f64]) -> Trajectory {
        Trajectory::new(stamps.to_vec(), vec![Isometry3::identity(); stamps.len()]).unwrap()
    }

    fn pairs(
        reference: &[f64],
        estimate: &[f64],
        max_diff: f64,
        time_offset: f64,
    ) -> Vec<(usize, usize)> {
        let options = AssociationOptions { max_diff, time_offset, ..Default::default() };
        matches(&still(reference), &still(estimate), &options).unwrap()
    }

    #[test]
    fn the_nearest_within_the_tolerance_is_taken() {
        let reference = [0.0, 0.1, 0.2, 0.3, 0.4];
        assert_eq!(pairs(&reference, &[0.104, 0.296], 0.01, 0.0), [(1, 0), (3, 1)]);
        assert_eq!(pairs(&reference, &[0.12, 0.3], 0.01, 0.0), [(3, 1)]);
        // Two equally near: the earlier.
        assert_eq!(pairs(&[0.0, 0.25, 0.5], &[0.125], 1.0, 0.0), [(0, 0)]);
    }

    #[test]
    fn the_offset_moves_the_estimate_whichever_is_longer() {
        assert_eq!(pairs(&[10.0, 11.0, 12.0], &[0.0, 1.0], 0.01, 11.0), [(1, 0), (2, 1)]);
        assert_eq!(pairs(&[11.0, 12.0], &[0.0, 1.0, 2.0], 0.01, 11.0), [(0, 0), (1, 1)]);
    }

    #[test]
    fn a_pose_that_serves_twice_is_counted() {
        let options = AssociationOptions { max_diff: 0.5, ..Default::default() };
        let reference = still(&[0.0, 0.1, 5.0]);
        let pairs = associate(&reference, &still(&[0.2, 0.3, 4.9]), &options).unwrap();
        assert_eq!((pairs.len(), pairs.shared), (3, 1));
    }

    #[test]
    fn openvins_lets_a_reference_pose_serve_once() {
        let (reference, estimate) = ([0.0, 0.005, 0.01, 0.015], [0.005, 0.005, 0.012, 0.5]);
        let pairs = |rule, time_offset: f64| {
            let options = AssociationOptions { rule, max_diff: 0.02, time_offset };
            let moved: Vec<f64> = estimate.iter().map(|t| t - time_offset).collect();
            matches(&still(&reference), &still(&moved), &options).unwrap()
        };
        for offset in [0.0, 3.0] {
            assert_eq!(pairs(AssociationRule::Nearest, offset), [(1, 0), (1, 1), (2, 2)]);
            assert_eq!(pairs(AssociationRule::OpenVins, offset), [(1, 0), (2, 1), (3, 2)]);
        }
    }

    #[test]
    fn no_match_names_both_ranges() {
        let error = associate(&still(&[0.0, 1.0]), &still(&[7.0, 8.0]), &Default::default());
        let text = error.unwrap_err().to_string();
        assert!(text.contains("0.000 to 1.000 s") && text.contains("7.000 to 8.000 s"), "{text}");
    }

    proptest! {
        #[test]
        fn equal_to_an_exhaustive_search(
            mut reference in prop::collection::vec(0.0..10.0_f64, 1..40),
            mut estimate in prop::collection::vec(0.0..10.0_f64, 1..40),
            offset in -2.0..2.0_f64,
            max_diff in 0.0..0.5_f64,
        ) {
            reference.sort_by(f64::total_cmp);
            estimate.sort_by(f64::total_cmp);
            let estimate_is_longer = estimate.len() > reference.len();
            let (shorter, longer, sign) =
                if estimate_is_longer { (&reference, &estimate, 1.0) } else { (&estimate, &reference, -1.0) };
            let mut expected = Vec::new();
            for (i, stamp) in shorter.iter().enumerate() {
                let distance = |j: &usize| (longer[*j] + sign * offset - stamp).abs();
                let best = (0..longer.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap();
                if distance(&best) <= max_diff {
                    expected.push(if estimate_is_longer { (i, best) } else { (best, i) });
                }
            }
            prop_assert_eq!(pairs(&reference, &estimate, max_diff, offset), expected);
        }
    }
}
