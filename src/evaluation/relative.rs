use nalgebra::Isometry3;

use super::{
    Alignment, AssociationOptions, EvaluationError, PosePairs, Relation, Similarity, Statistics,
    Trajectory, align, associate,
};

/// How far the two poses of a relative error are apart, along the estimate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Delta {
    /// Matched poses.
    Frames(usize),
    /// Time.
    Seconds(f64),
    /// Length of the path between them.
    Metres(f64),
    /// Angle: summed along the path for consecutive pairs, between the two for all pairs.
    Degrees(f64),
}

impl Delta {
    fn value(self) -> f64 {
        match self {
            Self::Frames(n) => n as f64,
            Self::Seconds(x) | Self::Metres(x) | Self::Degrees(x) => x,
        }
    }

    pub fn unit(self) -> &'static str {
        match self {
            Self::Frames(_) => "frames",
            Self::Seconds(_) => "s",
            Self::Metres(_) => "m",
            Self::Degrees(_) => "deg",
        }
    }
}

/// How the relative pose error is computed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RpeOptions {
    pub association: AssociationOptions,
    /// Changes the error by its scale only.
    pub alignment: Alignment,
    pub align_n: Option<usize>,
    pub relation: Relation,
    pub delta: Delta,
    /// A pair from every pose instead of one pair after the other.
    pub all_pairs: bool,
}

impl Default for RpeOptions {
    fn default() -> Self {
        Self {
            association: AssociationOptions::default(),
            alignment: Alignment::None,
            align_n: None,
            relation: Relation::Translation,
            delta: Delta::Frames(1),
            all_pairs: false,
        }
    }
}

/// The relative pose error of one estimate.
#[derive(Debug, Clone, PartialEq)]
pub struct RpeResult {
    /// The matched poses, the estimate's aligned.
    pub pairs: PosePairs,
    pub alignment: Similarity,
    /// Indices into `pairs` of the two poses of each error.
    pub links: Vec<(usize, usize)>,
    /// One error a link: m or degrees.
    pub errors: Vec<f64>,
    pub statistics: Statistics,
}

/// Relative pose error (Sturm et al. 2012): by how much the estimate's motion between two poses
/// differs from the reference's.
pub fn rpe(
    reference: &Trajectory,
    estimate: &Trajectory,
    options: &RpeOptions,
) -> Result<RpeResult, EvaluationError> {
    let mut pairs = associate(reference, estimate, &options.association)?;
    let alignment = align(&pairs, options.alignment, options.align_n)?;
    for pose in &mut pairs.estimate {
        *pose = alignment.apply(pose);
    }
    let links = links(&pairs, options.delta, options.all_pairs)?;
    let errors: Vec<f64> =
        links.iter().map(|&link| options.relation.of(&relative_error(&pairs, link))).collect();
    let statistics = Statistics::of(&errors).ok_or(EvaluationError::Empty)?;
    Ok(RpeResult { pairs, alignment, links, errors, statistics })
}

/// `(reference motion)^-1 (estimated motion)` from pose `i` to pose `j`.
pub(super) fn relative_error(pairs: &PosePairs, (i, j): (usize, usize)) -> Isometry3<f64> {
    let reference = pairs.reference[i].inv_mul(&pairs.reference[j]);
    let estimate = pairs.estimate[i].inv_mul(&pairs.estimate[j]);
    reference.inv_mul(&estimate)
}

/// Path lengths and times of all pairs may differ from the delta by this fraction of it; the same
/// holds for angles.
const ALL_PAIRS_TOLERANCE: f64 = 0.1;

fn links(
    pairs: &PosePairs,
    delta: Delta,
    all_pairs: bool,
) -> Result<Vec<(usize, usize)>, EvaluationError> {
    let value = delta.value();
    let largest = if matches!(delta, Delta::Degrees(_)) { 180.0 } else { f64::MAX };
    if !(value > 0.0 && value <= largest) {
        let expected = match delta {
            Delta::Degrees(_) => "above 0 and at most 180 degrees",
            _ => "above 0",
        };
        return Err(EvaluationError::Option { name: "delta", expected, value });
    }
    let n = pairs.len();
    let tolerance = ALL_PAIRS_TOLERANCE * value;
    let links = match (delta, all_pairs) {
        (Delta::Frames(step), true) => (step..n).map(|j| (j - step, j)).collect(),
        (Delta::Frames(step), false) => (0..n).step_by(step).zip((step..n).step_by(step)).collect(),
        (Delta::Seconds(delta), all) => by_time(&pairs.stamps, delta, tolerance, all),
        (Delta::Metres(delta), true) => {
            let path = path_lengths(&pairs.estimate);
            let nearest = |i| nearest_after(&path, i, delta, tolerance).map(|j| (i, j));
            (0..n).filter_map(nearest).collect()
        }
        (Delta::Metres(delta), false) => by_sum(n, delta, |i, j| {
            (pairs.estimate[j].translation.vector - pairs.estimate[i].translation.vector).norm()
        }),
        (Delta::Degrees(delta), true) => {
            by_direct_angle(&pairs.estimate, delta.to_radians(), tolerance.to_radians())
        }
        (Delta::Degrees(delta), false) => by_sum(n, delta.to_radians(), |i, j| {
            pairs.estimate[i].rotation.angle_to(&pairs.estimate[j].rotation)
        }),
    };
    if links.is_empty() { Err(no_pairs(pairs, delta)) } else { Ok(links) }
}

fn no_pairs(pairs: &PosePairs, delta: Delta) -> EvaluationError {
    let duration = match (pairs.stamps.first(), pairs.stamps.last()) {
        (Some(first), Some(last)) => last - first,
        _ => 0.0,
    };
    let path = path_lengths(&pairs.estimate).last().copied().unwrap_or(0.0);
    EvaluationError::NoPairs {
        delta: delta.value(),
        unit: delta.unit(),
        poses: pairs.len(),
        span: format!("{duration:.1} s and {path:.3} m"),
    }
}

/// Consecutive links, each ending where the sum of `step` over neighbours reaches `delta`.
fn by_sum(n: usize, delta: f64, step: impl Fn(usize, usize) -> f64) -> Vec<(usize, usize)> {
    let mut links = Vec::new();
    let (mut start, mut sum) = (0, 0.0);
    for j in 1..n {
        sum += step(j - 1, j);
        if sum >= delta {
            links.push((start, j));
            (start, sum) = (j, 0.0);
        }
    }
    links
}

/// Links to the pose nearest to `delta` seconds later. Where there is none (a gap), consecutive
/// links resume from the next pose.
fn by_time(stamps: &[f64], delta: f64, tolerance: f64, all_pairs: bool) -> Vec<(usize, usize)> {
    let mut links = Vec::new();
    let mut i = 0;
    while i < stamps.len() {
        let link = nearest_after(stamps, i, delta, tolerance);
        links.extend(link.map(|j| (i, j)));
        i = if all_pairs { i + 1 } else { link.unwrap_or(i + 1) };
    }
    links
}

/// Index after `i` whose value is nearest to `values[i] + delta`, the first of equals, if it is
/// within `tolerance`; `values` ascend.
pub(super) fn nearest_after(values: &[f64], i: usize, delta: f64, tolerance: f64) -> Option<usize> {
    let from = values.get(i)?;
    let rest = values.get(i + 1..)?;
    let gap = |value: &f64| value - from;
    let above = rest.partition_point(|value| gap(value) < delta);
    let below = above.checked_sub(1).map(|k| {
        let reached = gap(&rest[k]);
        rest.partition_point(|value| gap(value) < reached)
    });
    let distance = |k: &usize| (gap(&rest[*k]) - delta).abs();
    let above = (above < rest.len()).then_some(above);
    let best = match (below, above) {
        (Some(b), Some(a)) => Some(if distance(&b) <= distance(&a) { b } else { a }),
        (one, other) => one.or(other),
    }?;
    (distance(&best) <= tolerance).then_some(i + 1 + best)
}

/// Every two poses whose angle is within the tolerance of `delta` (rad); quadratic, as the number
/// of links is.
fn by_direct_angle(poses: &[Isometry3<f64>], delta: f64, tolerance: f64) -> Vec<(usize, usize)> {
    let range = delta - tolerance..=delta + tolerance;
    // |q1 . q2| = cos(angle / 2) leaves out nearly all others without a transcendental function.
    let slack = 1e-9;
    let nearest = (range.start() / 2.0).cos() + slack;
    let furthest = (range.end() / 2.0).min(std::f64::consts::FRAC_PI_2).cos() - slack;
    let mut links = Vec::new();
    for (i, a) in poses.iter().enumerate() {
        for (j, b) in poses.iter().enumerate().skip(i + 1) {
            let cosine = a.rotation.coords.dot(&b.rotation.coords).abs();
            if (furthest..=nearest).contains(&cosine)
                && range.contains(&a.rotation.angle_to(&b.rotation))
            {
                links.push((i, j));
            }
        }
    }
    links
}

/// Length of the path from the first pose to each, m.
pub(super) fn path_lengths(poses: &[Isometry3<f64>]) -> Vec<f64> {
    let mut sum = 0.0;
    let first = poses.first().map(|_| 0.0);
    let steps = poses.windows(2).map(|w| {
        sum += (w[0].translation.vector - w[1].translation.vector).norm();
        sum
    });
    first.into_iter().chain(steps).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::vector;
    use proptest::prelude::*;

    fn line(stamps: &[f64]) -> PosePairs {
        let poses: Vec<_> = stamps.iter().map(|t| Isometry3::translation(*t, 0.0, 0.0)).collect();
        PosePairs {
            stamps: stamps.to_vec(),
            reference: poses.clone(),
            estimate: poses,
            reference_poses: stamps.len(),
            estimate_poses: stamps.len(),
            shared: 0,
        }
    }

    #[test]
    fn seconds_survive_rounding_and_gaps() {
        let stamps: Vec<f64> = (0..41).map(|i| 1.4e9 + f64::from(i) * 0.1).collect();
        let pairs = line(&stamps);
        let consecutive = links(&pairs, Delta::Seconds(1.0), false).unwrap();
        assert_eq!(consecutive, [(0, 10), (10, 20), (20, 30), (30, 40)]);
        assert_eq!(links(&pairs, Delta::Seconds(1.0), true).unwrap().len(), 32);
        let gap = line(&[0.0, 0.5, 1.0, 1.5, 7.0, 7.5, 8.0]);
        assert_eq!(links(&gap, Delta::Seconds(1.0), false).unwrap(), [(0, 2), (4, 6)]);
    }

    #[test]
    fn a_delta_without_pairs_is_an_error() {
        let pairs = line(&[0.0, 1.0, 2.0]);
        let deltas =
            [Delta::Frames(3), Delta::Seconds(9.0), Delta::Metres(5.0), Delta::Degrees(10.0)];
        for delta in deltas {
            for all_pairs in [false, true] {
                let error = links(&pairs, delta, all_pairs).unwrap_err();
                assert!(matches!(error, EvaluationError::NoPairs { .. }), "{delta:?}: {error}");
            }
        }
        for delta in [Delta::Frames(0), Delta::Metres(-1.0), Delta::Degrees(200.0)] {
            let error = links(&pairs, delta, true).unwrap_err();
            assert!(matches!(error, EvaluationError::Option { .. }), "{delta:?}: {error}");
        }
    }

    #[test]
    fn a_common_motion_of_the_estimate_does_not_matter() {
        let poses: Vec<_> = (0..50)
            .map(|i| {
                let t = f64::from(i) * 0.2;
                Isometry3::new(vector![t.sin(), t.cos(), 0.1 * t], vector![t, 0.2 * t, 0.0])
            })
            .collect();
        let stamps: Vec<f64> = (0..50).map(f64::from).collect();
        let motion = Isometry3::new(vector![3.0, -1.0, 2.0], vector![0.4, 1.0, -2.0]);
        let moved = poses.iter().map(|pose| motion * pose).collect();
        let reference = Trajectory::new(stamps.clone(), poses).unwrap();
        let estimate = Trajectory::new(stamps, moved).unwrap();
        for relation in [Relation::Translation, Relation::Angle] {
            let options = RpeOptions { relation, ..Default::default() };
            assert!(rpe(&reference, &estimate, &options).unwrap().statistics.max < 1e-7);
        }
    }

    proptest! {
        #[test]
        fn nearest_after_is_the_first_of_the_nearest(
            steps in prop::collection::vec(prop_oneof![Just(0.0), Just(0.25), 0.0..1.0_f64], 1..30),
            delta in 0.1..3.0_f64,
            tolerance in 0.0..1.0_f64,
        ) {
            let mut sum = 0.0;
            let values: Vec<f64> = steps.iter().map(|step| { sum += step; sum }).collect();
            for i in 0..values.len() {
                let distance = |j: &usize| (values[*j] - values[i] - delta).abs();
                let expected = (i + 1..values.len())
                    .min_by(|a, b| distance(a).total_cmp(&distance(b)))
                    .filter(|j| distance(j) <= tolerance);
                prop_assert_eq!(nearest_after(&values, i, delta, tolerance), expected);
            }
        }
    }
}
