//! What commonly goes wrong before a trajectory error is computed, and how to tell.

use std::fmt;

use nalgebra::{Isometry3, Quaternion, UnitQuaternion, Vector3};

use super::align::PointMoments;
use super::clock::nearby_clock_offset;
use super::statistics::quantile;
use super::{
    Alignment, ApeOptions, AssociationOptions, EvaluationError, PosePairs, Relation, Statistics,
    Trajectory, absolute_errors, align,
};

/// Fewer pairs than this are no trajectory.
pub(super) const MIN_MATCHES: usize = 3;

/// A sign that the numbers do not mean what they seem to; computed all the same.
#[derive(Debug, Clone, PartialEq)]
pub enum Suspicion {
    /// Only a small part of the estimate has a counterpart.
    FewMatches { matched: usize, of: usize },
    /// Poses of the longer trajectory that belong to two of the shorter one.
    SharedMatches { count: usize },
    /// The quaternions of one trajectory make sense if read in another way.
    QuaternionOrder { which: Which, instead: Convention },
    /// The estimate's vertical differs from the reference's, though the alignment keeps it.
    NotGravityAligned { tilt_deg: f64 },
    /// The estimate fits best when scaled.
    Scale { scale: f64 },
    /// The two trajectories turn at different times.
    ClockOffset { seconds: f64 },
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Which {
    Reference,
    Estimate,
}

/// How else a rotation may have been written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Convention {
    /// The scalar first (`w x y z`) where it is expected last.
    ScalarFirst,
    /// The scalar last (`x y z w`) where it is expected first.
    ScalarLast,
    /// From world to body, or in the JPL convention.
    Inverse,
}

impl fmt::Display for Suspicion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::FewMatches { matched, of } => write!(
                f,
                "only {matched} of {of} poses of the estimate matched: the error is that of a small part"
            ),
            Self::SharedMatches { count } => write!(
                f,
                "{count} matches share a pose with their neighbour: --max-diff bridges gaps"
            ),
            Self::QuaternionOrder { which, instead } => {
                let which = match which {
                    Which::Reference => "reference",
                    Which::Estimate => "estimate",
                };
                let instead = match instead {
                    Convention::ScalarFirst => "written w x y z, not x y z w",
                    Convention::ScalarLast => "written x y z w, not w x y z",
                    Convention::Inverse => "those of the inverse rotation (world to body, or JPL)",
                };
                write!(f, "the quaternions of the {which} look as if they were {instead}")
            }
            Self::NotGravityAligned { tilt_deg } => write!(
                f,
                "the worlds are tilted by {tilt_deg:.1} deg against each other, which yaw alignment keeps: is z up in both?"
            ),
            Self::Scale { scale } => write!(
                f,
                "the estimate fits best when scaled by {scale:.3}: drift, or a wrong unit or calibration (compare --align sim3)"
            ),
            Self::ClockOffset { seconds } => write!(
                f,
                "the clocks seem to differ: --time-offset {seconds:.3} fits the angular rates best"
            ),
        }
    }
}

/// Fewer matches than this fraction of the estimate's poses are worth a word.
const FEW: f64 = 0.1;
/// Smallest tilt (deg) and largest ratio of the RMSE of full to that of yaw-only alignment that
/// make a tilted world.
const TILT_DEG: f64 = 3.0;
const TILT_GAIN: f64 = 0.5;
/// Relative difference of the scale from 1, and ratio of the RMSE with to that without it.
const SCALE_DIFFERENCE: f64 = 0.1;
const SCALE_GAIN: f64 = 0.7;
/// Smallest offset (s) worth a word, the correlation it must reach, and by how much that must be
/// more than without an offset.
const OFFSET: f64 = 0.03;
const OFFSET_CORRELATION: f64 = 0.9;
const OFFSET_GAIN: f64 = 0.01;

/// Looks for the classic mistakes; `pairs` are the associated poses before alignment.
pub fn suspicions(
    reference: &Trajectory,
    estimate: &Trajectory,
    pairs: &PosePairs,
    options: &ApeOptions,
) -> Vec<Suspicion> {
    let mut found = Vec::new();
    let (matched, of) = (pairs.len(), pairs.estimate_poses);
    let possible = of.min(pairs.reference_poses) as f64;
    if (matched as f64) < FEW * possible {
        found.push(Suspicion::FewMatches { matched, of });
    }
    if pairs.shared > 0 {
        found.push(Suspicion::SharedMatches { count: pairs.shared });
    }
    found.extend(quaternion_order(pairs));
    if options.alignment == Alignment::Yaw {
        found.extend(tilt(pairs));
    }
    if options.alignment != Alignment::Sim3 {
        found.extend(scale(pairs));
    }
    found.extend(clock_offset(reference, estimate, &options.association));
    found
}

/// Root mean square distance of the positions after `alignment`.
fn aligned_rmse(pairs: &PosePairs, alignment: Alignment) -> Option<f64> {
    let similarity = align(pairs, alignment, None).ok()?;
    let estimate = pairs.estimate.iter().map(|pose| similarity.apply(pose)).collect();
    let aligned = PosePairs { estimate, ..pairs.clone() };
    Some(Statistics::of(&absolute_errors(&aligned, Relation::Translation))?.rmse)
}

fn tilt(pairs: &PosePairs) -> Option<Suspicion> {
    let full = align(pairs, Alignment::Se3, None).ok()?;
    let tilt_deg = (full.rotation * Vector3::z()).angle(&Vector3::z()).to_degrees();
    let gain = aligned_rmse(pairs, Alignment::Se3)? / aligned_rmse(pairs, Alignment::Yaw)?;
    (tilt_deg > TILT_DEG && gain < TILT_GAIN).then_some(Suspicion::NotGravityAligned { tilt_deg })
}

/// The scale that Sim(3) alignment would find; `None` where the positions do not determine it.
pub fn similarity_scale(pairs: &PosePairs) -> Option<f64> {
    let moments = PointMoments::of(&pairs.reference, &pairs.estimate);
    let scale = moments.scale(&moments.rotation()?);
    (scale.is_finite() && scale > 0.0).then_some(scale)
}

fn scale(pairs: &PosePairs) -> Option<Suspicion> {
    let scale = similarity_scale(pairs)?;
    if scale.ln().abs() < SCALE_DIFFERENCE {
        return None;
    }
    let gain = aligned_rmse(pairs, Alignment::Sim3)? / aligned_rmse(pairs, Alignment::Se3)?;
    (gain < SCALE_GAIN).then_some(Suspicion::Scale { scale })
}

fn clock_offset(
    reference: &Trajectory,
    estimate: &Trajectory,
    association: &AssociationOptions,
) -> Option<Suspicion> {
    let offset = nearby_clock_offset(reference, estimate, association.time_offset)?;
    let remaining = offset.seconds - association.time_offset;
    let convincing = offset.correlation > OFFSET_CORRELATION
        && offset.correlation - offset.correlation_at_start > OFFSET_GAIN;
    (remaining.abs() > OFFSET && convincing)
        .then_some(Suspicion::ClockOffset { seconds: offset.seconds })
}

/// Relative rotations of at least this angle tell conventions apart, rad.
const TURN: f64 = 0.5;
/// Poses between which relative rotations are compared.
const TURNS: usize = 200;
/// A convention fits if the median angle between relative rotations is below this (rad), and
/// another convention's at least three times as large.
const FITTING: f64 = 0.35;

/// Relative rotations `R_i^T R_j` do not depend on the worlds; a wrong convention turns them into
/// something else.
fn quaternion_order(pairs: &PosePairs) -> Option<Suspicion> {
    let stride = (pairs.len() / TURNS).max(1);
    let indices: Vec<usize> = (0..pairs.len()).step_by(stride).collect();
    let turns: Vec<(usize, usize)> = indices
        .iter()
        .filter_map(|&i| {
            let turned = |j: &&usize| {
                pairs.reference[i].rotation.angle_to(&pairs.reference[**j].rotation) > TURN
            };
            let later = &indices[indices.partition_point(|&j| j <= i)..];
            later.iter().find(turned).map(|&j| (i, j))
        })
        .collect();
    let disagreement = |reference: Option<Convention>, estimate: Option<Convention>| {
        let relative = |poses: &[Isometry3<f64>], convention, (i, j): (usize, usize)| {
            reread(&poses[i].rotation, convention).inverse()
                * reread(&poses[j].rotation, convention)
        };
        let mut angles: Vec<f64> = turns
            .iter()
            .map(|&turn| {
                relative(&pairs.reference, reference, turn).angle_to(&relative(
                    &pairs.estimate,
                    estimate,
                    turn,
                ))
            })
            .collect();
        angles.sort_unstable_by(f64::total_cmp);
        quantile(&angles, 0.5)
    };
    let as_read = disagreement(None, None);
    let fits = |other: f64| other < FITTING && as_read > 3.0 * other && as_read > FITTING;
    let conventions = [Convention::ScalarFirst, Convention::ScalarLast, Convention::Inverse];
    let candidates = conventions
        .into_iter()
        .flat_map(|convention| [(Which::Estimate, convention), (Which::Reference, convention)]);
    let scored = candidates.map(|(which, instead)| {
        let score = match which {
            Which::Reference => disagreement(Some(instead), None),
            Which::Estimate => disagreement(None, Some(instead)),
        };
        (score, which, instead)
    });
    scored
        .filter(|(score, ..)| fits(*score))
        .min_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, which, instead)| Suspicion::QuaternionOrder { which, instead })
}

/// The rotation that was meant if the numbers were read in the wrong convention.
fn reread(rotation: &UnitQuaternion<f64>, convention: Option<Convention>) -> UnitQuaternion<f64> {
    let q = rotation.quaternion();
    match convention {
        None => *rotation,
        // Read as (x y z w) what was (w x y z), and the other way round.
        Some(Convention::ScalarFirst) => {
            UnitQuaternion::new_unchecked(Quaternion::new(q.i, q.j, q.k, q.w))
        }
        Some(Convention::ScalarLast) => {
            UnitQuaternion::new_unchecked(Quaternion::new(q.k, q.w, q.i, q.j))
        }
        Some(Convention::Inverse) => rotation.inverse(),
    }
}

/// The error of too few matches, with the probable cause where the stamps show one.
pub(super) fn too_few_matches(
    reference: &Trajectory,
    estimate: &Trajectory,
    options: &AssociationOptions,
    matched: usize,
) -> EvaluationError {
    let hint = time_unit_hint(reference, estimate).unwrap_or_else(|| {
        let ([r0, r1], [e0, e1]) = (reference.range(), estimate.range());
        let (e0, e1) = (e0 + options.time_offset, e1 + options.time_offset);
        let apart = e0 > r1 || r0 > e1;
        if apart {
            "they do not overlap: set --time-offset (or auto) if the clocks differ".to_owned()
        } else {
            "they overlap: raise --max-diff or set --time-offset".to_owned()
        }
    });
    EvaluationError::TooFewMatches {
        matched,
        needed: MIN_MATCHES,
        estimate_poses: estimate.len(),
        max_diff: options.max_diff,
        time_offset: options.time_offset,
        reference_range: reference.range(),
        estimate_range: estimate.range(),
        hint: format!("; {hint}"),
    }
}

/// Says so if the stamps of one or both look like milli-, micro- or nanoseconds.
fn time_unit_hint(reference: &Trajectory, estimate: &Trajectory) -> Option<String> {
    let thousands = |a: f64, b: f64| ((a / b).log10() / 3.0).round() as i32;
    let duration = |t: &Trajectory| t.range()[1] - t.range()[0];
    let by_interval = thousands(estimate.median_interval()?, reference.median_interval()?);
    let by_duration = thousands(duration(estimate), duration(reference));
    let (who, power) = match (by_interval, by_duration) {
        (0, 0) => ("both trajectories", thousands(reference.median_interval()?, TYPICAL_INTERVAL)),
        (a, b) if a == b && a > 0 => ("the estimate", a),
        (a, b) if a == b => ("the reference", -a),
        _ => return None,
    };
    let unit = match power {
        1 => "milliseconds",
        2 => "microseconds",
        3 => "nanoseconds",
        _ => return None,
    };
    Some(format!("the stamps of {who} look like {unit}: convert them to seconds"))
}

/// Geometric middle of usual pose intervals (1 ms to 1 s), s.
const TYPICAL_INTERVAL: f64 = 0.03;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::associate;
    use nalgebra::vector;

    /// A curve with turns about all axes, moved by hand through a room.
    fn pose(t: f64) -> Isometry3<f64> {
        let position = vector![2.0 * (0.7 * t).sin(), 1.5 * (0.9 * t).cos(), 0.4 * (1.3 * t).sin()];
        let rotation = vector![0.8 * t.sin(), 0.7 * (0.6 * t).cos(), 0.9 * (0.8 * t).sin()];
        Isometry3::from_parts(position.into(), UnitQuaternion::from_scaled_axis(rotation))
    }

    fn trajectory(f: impl Fn(f64) -> (f64, Isometry3<f64>)) -> Trajectory {
        let (stamps, poses) = (0..600).map(|i| f(f64::from(i) * 0.05)).unzip();
        Trajectory::new(stamps, poses).unwrap()
    }

    /// Small errors that no guard may take for a mistake.
    fn honest(t: f64) -> (f64, Isometry3<f64>) {
        let drift =
            Isometry3::new(vector![0.01 * t, -0.005 * t, 0.002 * t], Vector3::z() * 0.002 * t);
        (t + 0.003, drift * pose(t))
    }

    fn found(estimate: &Trajectory, alignment: Alignment, max_diff: f64) -> Vec<Suspicion> {
        let reference = trajectory(|t| (t, pose(t)));
        let association = AssociationOptions { max_diff, ..Default::default() };
        let options = ApeOptions { association, alignment, ..Default::default() };
        let pairs = associate(&reference, estimate, &association).unwrap();
        suspicions(&reference, estimate, &pairs, &options)
    }

    #[test]
    fn an_honest_estimate_raises_no_suspicion() {
        for alignment in Alignment::ALL {
            assert_eq!(found(&trajectory(honest), alignment, 0.01), []);
        }
    }

    #[test]
    fn few_matches() {
        let sparse = trajectory(|t| {
            let (stamp, pose) = honest(t);
            (if t < 1.0 { stamp } else { stamp + 0.02 }, pose)
        });
        let found = found(&sparse, Alignment::Se3, 0.01);
        assert!(found.contains(&Suspicion::FewMatches { matched: 20, of: 600 }), "{found:?}");
    }

    #[test]
    fn wrong_time_unit() {
        let reference = trajectory(|t| (100.0 + t, pose(t)));
        for (factor, unit) in [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")] {
            let wrong = trajectory(|t| ((100.0 + t) * factor, pose(t)));
            let name = |a, b| associate(a, b, &Default::default()).unwrap_err().to_string();
            let text = name(&reference, &wrong);
            assert!(text.contains(&format!("the estimate look like {unit}")), "{text}");
            let text = name(&wrong, &reference);
            assert!(text.contains(&format!("the reference look like {unit}")), "{text}");
            let later = trajectory(|t| ((500.0 + t) * factor, pose(t)));
            let text = name(&wrong, &later);
            assert!(text.contains(&format!("both trajectories look like {unit}")), "{text}");
        }
        let elsewhere = trajectory(|t| (500.0 + t, pose(t)));
        let text = associate(&reference, &elsewhere, &Default::default()).unwrap_err().to_string();
        assert!(text.contains("do not overlap") && text.contains("--time-offset"), "{text}");
    }

    #[test]
    fn wrong_quaternion_order() {
        let misread = |convention: Convention| {
            trajectory(move |t| {
                let (stamp, pose) = honest(t);
                let q = pose.rotation.quaternion();
                let q = match convention {
                    Convention::ScalarFirst => Quaternion::new(q.k, q.w, q.i, q.j),
                    Convention::ScalarLast => Quaternion::new(q.i, q.j, q.k, q.w),
                    Convention::Inverse => q.conjugate(),
                };
                let rotation = UnitQuaternion::new_normalize(q);
                (stamp, Isometry3::from_parts(pose.translation, rotation))
            })
        };
        for instead in [Convention::ScalarFirst, Convention::ScalarLast, Convention::Inverse] {
            let which = Which::Estimate;
            let found = found(&misread(instead), Alignment::Se3, 0.01);
            assert!(found.contains(&Suspicion::QuaternionOrder { which, instead }), "{found:?}");
        }
    }

    #[test]
    fn worlds_that_are_not_gravity_aligned() {
        let tilted = trajectory(|t| {
            let (stamp, pose) = honest(t);
            (stamp, Isometry3::rotation(Vector3::y() * 1.5) * pose)
        });
        let tilt = |alignment| {
            found(&tilted, alignment, 0.01).into_iter().find_map(|s| match s {
                Suspicion::NotGravityAligned { tilt_deg } => Some(tilt_deg),
                _ => None,
            })
        };
        assert!((tilt(Alignment::Yaw).unwrap() - 85.9).abs() < 3.0);
        assert_eq!(tilt(Alignment::Se3), None);
    }

    #[test]
    fn scale_far_from_one() {
        let scaled = trajectory(|t| {
            let (stamp, mut pose) = honest(t);
            pose.translation.vector *= 0.5;
            (stamp, pose)
        });
        let scale = |alignment| {
            found(&scaled, alignment, 0.01).into_iter().find_map(|s| match s {
                Suspicion::Scale { scale } => Some(scale),
                _ => None,
            })
        };
        assert!((scale(Alignment::Se3).unwrap() - 2.0).abs() < 0.1);
        assert_eq!(scale(Alignment::Sim3), None);
    }

    #[test]
    fn clock_offset_between_the_trajectories() {
        let late = trajectory(|t| {
            let (stamp, pose) = honest(t);
            (stamp + 0.15, pose)
        });
        let found = found(&late, Alignment::Se3, 0.01);
        let offset = found.iter().find_map(|s| match s {
            Suspicion::ClockOffset { seconds } => Some(*seconds),
            _ => None,
        });
        assert!((offset.unwrap() + 0.153).abs() < 0.005, "{found:?}");
    }

    #[test]
    fn matches_that_bridge_gaps() {
        let reference = trajectory(|t| (if t > 10.0 { t + 1.0 } else { t }, pose(t)));
        let estimate = trajectory(|t| (t, pose(t)));
        let association = AssociationOptions { max_diff: 0.3, ..Default::default() };
        let pairs = associate(&reference, &estimate, &association).unwrap();
        let options = ApeOptions { association, ..Default::default() };
        let found = suspicions(&reference, &estimate, &pairs, &options);
        assert!(found.iter().any(|s| matches!(s, Suspicion::SharedMatches { .. })), "{found:?}");
    }
}
