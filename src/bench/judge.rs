//! A run against the truth of its recording.

use nalgebra::{Isometry3, Matrix3, Matrix6, Vector3};

use super::dataset::Clock;
use super::figures::NeesMeans;
use crate::evaluation::{
    ApeOptions, AssociationOptions, EvaluationError, NeesOptions, NeesSummary, PosePairs,
    Similarity, Trajectory, align, ape, associate, best_clock_offset, estimate_clock_offset,
    normalised_square,
};
use crate::replay::evaluate;

/// How the truth of a recording is to be taken.
#[derive(Debug, Clone, Copy)]
pub struct Judging {
    pub clock: Clock,
    /// Whether gravity makes the estimate's world z-up.
    pub levelled: bool,
    /// Whether the truth is exact enough to be differentiated.
    pub exact: bool,
    /// First and last stamp of the images, s; truth outside is not asked for.
    pub span: Option<[f64; 2]>,
}

/// Poses with what the estimator believes of them, one entry a frame.
#[derive(Debug, Clone)]
pub struct Estimated {
    pub trajectory: Trajectory,
    /// Of (rotation, position): body-frame rotation error, position in the world.
    pub covariances: Vec<Matrix6<f64>>,
    /// World, m/s, and its covariance.
    pub velocities: Vec<(Vector3<f64>, Matrix3<f64>)>,
}

/// The figures of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Judged {
    pub matched: usize,
    /// Share of the truth's duration with an estimate.
    pub coverage: f64,
    /// RMSE after SE(3) alignment: m, degrees.
    pub ape_m: f64,
    pub attitude_deg: f64,
    /// RMSE of the position of the motion over 1 s, m; `None` for a shorter run.
    pub rpe_1s_m: Option<f64>,
    pub nees: Option<NeesMeans>,
    /// Added to the estimate's stamps to bring them to the truth's clock, s.
    pub clock_offset: Option<f64>,
}

/// Truth poses further apart than this have no truth between them, and estimates no estimate, s.
const MAX_GAP: f64 = 0.5;
const CONFIDENCE: f64 = 0.95;

/// Judges an estimate by the truth.
///
/// # Errors
/// If too few poses belong together, or the clocks cannot be compared.
pub fn judge(
    truth: &Trajectory,
    estimated: &Estimated,
    judging: &Judging,
) -> Result<Judged, EvaluationError> {
    let estimate = &estimated.trajectory;
    let clock_offset = match judging.clock {
        Clock::Shared => None,
        Clock::Apart => Some(estimate_clock_offset(truth, estimate)?.seconds),
    };
    let stamps = truth.stamps().iter().map(|stamp| stamp - clock_offset.unwrap_or(0.0)).collect();
    let truth = Trajectory::new(stamps, truth.poses().to_vec())?;
    let evaluation = evaluate(&truth, estimate, &estimated.covariances, judging.levelled)?.summary;
    let ape_m = match clock_offset {
        None => evaluation.ape_translation.rmse,
        // As published figures have it: positions at the offset that suits them best.
        Some(_) => {
            let options = ApeOptions::default();
            let time_offset = best_clock_offset(&truth, estimate, 0.0, &options)?;
            let association = AssociationOptions { time_offset, ..options.association };
            ape(&truth, estimate, &ApeOptions { association, ..options })?.statistics.rmse
        }
    };
    let velocity = match judging.exact {
        true => velocity_nees(&truth, estimated, judging.levelled)?,
        false => None,
    };
    Ok(Judged {
        matched: evaluation.matched,
        coverage: coverage(truth.stamps(), estimate.stamps(), judging.span),
        ape_m,
        attitude_deg: evaluation.ape_rotation_deg.rmse,
        rpe_1s_m: evaluation.rpe.map(|rpe| rpe.translation.rmse),
        nees: evaluation.nees.map(|nees| NeesMeans {
            attitude: Some(nees.attitude.mean),
            position: Some(nees.position.mean),
            velocity: velocity.map(|summary| summary.mean),
            inside_95: Some(nees.joint.inside),
        }),
        clock_offset,
    })
}

/// Share of the time that truth covers, within `span`, in which there is an estimate, too. Stamps
/// ascend, in s; between neighbours more than 0.5 s apart there is neither. 0 where there is no
/// truth. Linear.
pub fn coverage(truth: &[f64], estimate: &[f64], span: Option<[f64; 2]>) -> f64 {
    let [from, to] = span.unwrap_or([f64::NEG_INFINITY, f64::INFINITY]);
    let intervals = |stamps: &[f64]| -> Vec<[f64; 2]> {
        let pairs = stamps.windows(2).filter(|pair| pair[1] - pair[0] <= MAX_GAP);
        let inside = pairs.map(|pair| [pair[0].max(from), pair[1].min(to)]);
        inside.filter(|[start, end]| start < end).collect()
    };
    let (truth, estimate) = (intervals(truth), intervals(estimate));
    let duration: f64 = truth.iter().map(|[start, end]| end - start).sum();
    let mut covered = 0.0;
    let mut first = 0;
    for [start, end] in truth {
        while estimate.get(first).is_some_and(|other| other[1] <= start) {
            first += 1;
        }
        let meeting = estimate[first..].iter().take_while(|other| other[0] < end);
        covered += meeting.map(|other| other[1].min(end) - other[0].max(start)).sum::<f64>();
    }
    if duration > 0.0 { covered / duration } else { 0.0 }
}

/// NEES of the velocity, which the truth's positions tell where they are exact. `None` where there
/// is none to judge.
fn velocity_nees(
    truth: &Trajectory,
    estimated: &Estimated,
    levelled: bool,
) -> Result<Option<NeesSummary>, EvaluationError> {
    let estimate = &estimated.trajectory;
    let estimate_from_truth = first_pose_alignment(truth, estimate, levelled)?;
    let frames = estimate.stamps().iter().zip(&estimated.velocities);
    let squares: Vec<f64> = frames
        .filter_map(|(stamp, (velocity, covariance))| {
            let truth = estimate_from_truth.rotation * velocity_at(truth, *stamp)?;
            normalised_square(&(truth - velocity), *covariance)
        })
        .collect();
    Ok(NeesSummary::of(&squares, 3, CONFIDENCE))
}

/// From the truth's world to the estimate's, as [`nees`](crate::evaluation::nees) has it: by the
/// first poses.
fn first_pose_alignment(
    truth: &Trajectory,
    estimate: &Trajectory,
    levelled: bool,
) -> Result<Similarity, EvaluationError> {
    let association = AssociationOptions::default();
    let options = match levelled {
        true => NeesOptions::levelled(truth, estimate, association)?,
        false => NeesOptions::default(),
    };
    let pairs = associate(truth, estimate, &association)?;
    // The truth is what gets aligned.
    let swapped = PosePairs { reference: pairs.estimate, estimate: pairs.reference, ..pairs };
    align(&swapped, options.alignment, options.align_n)
}

/// Positions that are differentiated at once.
const POINTS: usize = 6;

/// The derivative at `stamp` of the polynomial through the six nearest positions, m/s: with exact
/// positions at 120 Hz it errs by less than 1e-6 of what the filters believe. `None` in gaps and
/// at the ends.
fn velocity_at(truth: &Trajectory, stamp: f64) -> Option<Vector3<f64>> {
    let stamps = truth.stamps();
    let after = stamps.partition_point(|other| *other < stamp);
    let first = after.checked_sub(POINTS / 2)?;
    let times = stamps.get(first..first + POINTS)?;
    let even = 2.0 * (times[POINTS - 1] - times[0]) / (POINTS - 1) as f64;
    if times.windows(2).any(|pair| !(pair[1] > pair[0] && pair[1] - pair[0] < even)) {
        return None;
    }
    let poses: &[Isometry3<f64>] = truth.poses().get(first..first + POINTS)?;
    let terms = (0..POINTS).map(|k| poses[k].translation.vector * lagrange_slope(times, k, stamp));
    Some(terms.sum())
}

/// Derivative at `t` of the polynomial that is 1 at `times[k]` and 0 at the others.
fn lagrange_slope(times: &[f64], k: usize, t: f64) -> f64 {
    let others = || (0..times.len()).filter(move |j| *j != k);
    let slope_of = |i: usize| {
        let product: f64 =
            others().filter(|j| *j != i).map(|j| (t - times[j]) / (times[k] - times[j])).product();
        product / (times[k] - times[i])
    };
    others().map(slope_of).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;
    use nalgebra::UnitQuaternion;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    fn every(step: f64, from: f64, to: f64) -> Vec<f64> {
        (0..=((to - from) / step).round() as usize).map(|k| from + step * k as f64).collect()
    }

    #[test]
    fn coverage_is_the_share_of_the_truths_duration() {
        let truth = every(0.01, 1.0, 11.0);
        let full = every(0.05, 0.0, 12.0);
        assert_relative_eq!(coverage(&truth, &full, None), 1.0, epsilon = 1e-12);
        let late = every(0.05, 3.5, 12.0);
        assert_relative_eq!(coverage(&truth, &late, None), 0.75, epsilon = 1e-9);
        let broken = [every(0.05, 0.0, 4.0), every(0.05, 6.0, 9.0)].concat();
        assert_relative_eq!(coverage(&truth, &broken, None), 0.6, epsilon = 1e-9);
        assert_eq!(coverage(&truth, &[], None), 0.0);
        assert_eq!(coverage(&[], &full, None), 0.0);
    }

    #[test]
    fn what_the_truth_or_the_images_lack_is_not_asked_for() {
        // Truth at both ends of a corridor.
        let truth = [every(0.01, 0.0, 2.0), every(0.01, 50.0, 53.0)].concat();
        assert_relative_eq!(coverage(&truth, &every(0.05, 0.0, 60.0), None), 1.0, epsilon = 1e-9);
        assert_relative_eq!(coverage(&truth, &every(0.05, 0.0, 51.0), None), 0.6, epsilon = 1e-9);
        let images = Some([0.0, 51.0]);
        assert_relative_eq!(coverage(&truth, &every(0.05, 0.0, 51.0), images), 1.0, epsilon = 1e-9);
    }

    fn position(t: f64) -> Vector3<f64> {
        Vector3::new((1.3 * t).sin(), 0.4 * t * t, (9.0 * t).cos() * 0.05)
    }

    fn velocity(t: f64) -> Vector3<f64> {
        Vector3::new(1.3 * (1.3 * t).cos(), 0.8 * t, -0.45 * (9.0 * t).sin())
    }

    fn trajectory(stamps: &[f64], world: &Isometry3<f64>) -> Trajectory {
        let pose = |t: &f64| {
            // Not periodic, and by far faster than the noise of attitudes 0.1 s apart (0.03 rad/s):
            // otherwise angular speeds tell a clock's offset only up to periods.
            let roll = 0.4 * (t + 0.01 * t * t).sin();
            let attitude = UnitQuaternion::from_euler_angles(roll, 0.2, 0.3 * t);
            world * Isometry3::from_parts(position(*t).into(), attitude)
        };
        Trajectory::new(stamps.to_vec(), stamps.iter().map(pose).collect()).unwrap()
    }

    #[test]
    fn exact_positions_tell_the_velocity() {
        let truth = trajectory(&every(1.0 / 120.0, 0.0, 5.0), &Isometry3::identity());
        for t in [0.5, 1.003, 2.703, 4.9] {
            let error = (velocity_at(&truth, t).unwrap() - velocity(t)).norm();
            assert!(error < 1e-7, "{error}");
        }
        assert_eq!(velocity_at(&truth, 0.0), None);
        assert_eq!(velocity_at(&truth, 5.1), None);
    }

    /// Errors drawn from the believed covariances, in a world turned by a heading, with the
    /// truth's clock a quarter of a second off.
    #[test]
    fn a_consistent_estimate_is_judged_consistent() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let world = Isometry3::new(Vector3::new(3.0, -2.0, 1.0), Vector3::z() * 0.8);
        let stamps = every(0.05, 1.0, 60.0);
        let exact = trajectory(&stamps, &world);
        let sds = [0.002, 0.01, 0.02];
        let mut draw = |sd: f64| {
            Vector3::from_fn(|_, _| {
                let x: f64 = StandardNormal.sample(&mut rng);
                sd * x
            })
        };
        let mut poses = Vec::new();
        let mut velocities = Vec::new();
        for (k, (t, pose)) in stamps.iter().zip(exact.poses()).enumerate() {
            // The first pose fixes the world.
            let scale = if k == 0 { 0.0 } else { 1.0 };
            let turn = UnitQuaternion::new(draw(sds[0]) * scale);
            let position = pose.translation.vector + draw(sds[1]) * scale;
            poses.push(Isometry3::from_parts(position.into(), pose.rotation * turn));
            velocities.push((
                world.rotation * velocity(*t) + draw(sds[2]),
                Matrix3::identity() * sds[2] * sds[2],
            ));
        }
        let mut covariance = Matrix6::identity();
        for k in 0..6 {
            covariance[(k, k)] = sds[k / 3] * sds[k / 3];
        }
        let estimated = Estimated {
            trajectory: Trajectory::new(stamps.clone(), poses).unwrap(),
            covariances: vec![covariance; stamps.len()],
            velocities,
        };
        let truth = trajectory(&every(1.0 / 120.0, 0.0, 61.0), &Isometry3::identity());
        let judging = Judging { clock: Clock::Shared, levelled: true, exact: true, span: None };
        let judged = judge(&truth, &estimated, &judging).unwrap();
        let nees = judged.nees.unwrap();
        for mean in [nees.attitude, nees.position, nees.velocity] {
            assert_relative_eq!(mean.unwrap(), 3.0, max_relative = 0.1);
        }
        assert_relative_eq!(nees.inside_95.unwrap(), 0.95, epsilon = 0.02);
        assert_relative_eq!(judged.ape_m, 0.01 * 3.0_f64.sqrt(), max_relative = 0.05);

        let late: Vec<f64> = truth.stamps().iter().map(|stamp| stamp + 0.25).collect();
        let late = Trajectory::new(late, truth.poses().to_vec()).unwrap();
        let apart = Judging { clock: Clock::Apart, ..judging };
        let judged = judge(&late, &estimated, &apart).unwrap();
        assert_relative_eq!(judged.clock_offset.unwrap(), 0.25, epsilon = 0.01);
    }
}
