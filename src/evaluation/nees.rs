use std::path::Path;

use nalgebra::{
    Cholesky, Isometry3, Matrix6, Quaternion, SMatrix, SVector, UnitQuaternion, Vector3, Vector6,
};
use serde::Serialize;
use statrs::distribution::{ChiSquared, ContinuousCDF};

use super::association::matches;
use super::guards::MIN_MATCHES;
use super::{
    Alignment, AssociationOptions, EvaluationError, PosePairs, RunBand, Statistics, Trajectory,
    align, guards,
};

/// Poses with what the estimator believes of their errors.
#[derive(Debug, Clone, PartialEq)]
pub struct BelievedTrajectory {
    pub trajectory: Trajectory,
    /// Of (rotation, position): rotation vector `e` of `R_true = R_est exp(e^)` in the body frame
    /// (rad), position in the estimate's world (m).
    pub covariances: Vec<Matrix6<f64>>,
}

/// Names under which the columns of `state.csv` are looked for; the first one is what `replay`
/// writes.
const STAMP: [&str; 3] = ["time", "timestamp", "t"];
const POSITION: [[&str; 3]; 3] = [["px", "py", "pz"], ["tx", "ty", "tz"], ["x", "y", "z"]];
const QUATERNION: [&str; 4] = ["qx", "qy", "qz", "qw"];

/// Reads stamp, pose and the columns `cov_pose_00` to `cov_pose_55` of a `state.csv`.
pub fn read_believed_trajectory(path: &Path) -> Result<BelievedTrajectory, EvaluationError> {
    let text = std::fs::read_to_string(path)
        .map_err(|error| EvaluationError::Io { path: path.to_owned(), error })?;
    let whole = |reason: String| EvaluationError::Format { path: path.to_owned(), reason };
    let mut lines = text.lines().zip(1..).filter(|(line, _)| !line.trim().is_empty());
    let (header, _) = lines.next().ok_or_else(|| whole("holds no header line".to_owned()))?;
    let columns = StateColumns::find(header).map_err(whole)?;
    let mut stamps = Vec::new();
    let mut poses = Vec::new();
    let mut covariances = Vec::new();
    for (line, number) in lines {
        let (stamp, pose, covariance) = columns.read(line).map_err(|reason| {
            EvaluationError::Parse { path: path.to_owned(), line: number, reason }
        })?;
        stamps.push(stamp);
        poses.push(pose);
        covariances.push(covariance);
    }
    let trajectory = Trajectory::new(stamps, poses).map_err(|e| whole(e.to_string()))?;
    Ok(BelievedTrajectory { trajectory, covariances })
}

/// Where in a line the numbers are.
struct StateColumns {
    stamp: usize,
    position: [usize; 3],
    quaternion: [usize; 4],
    covariance: [[usize; 6]; 6],
}

impl StateColumns {
    fn find(header: &str) -> Result<Self, String> {
        let names: Vec<&str> =
            header.trim_start_matches(['#', '\u{feff}', ' ']).split(',').map(str::trim).collect();
        let index = |name: &str| names.iter().position(|column| *column == name);
        let needed = |name: &str| index(name).ok_or_else(|| format!("has no column {name}"));
        let stamp = STAMP.into_iter().find_map(index);
        let position = POSITION.into_iter().find(|names| index(names[0]).is_some());
        let [x, y, z] = position.unwrap_or(POSITION[0]);
        let [qx, qy, qz, qw] = QUATERNION;
        let mut covariance = [[0; 6]; 6];
        for (i, row) in covariance.iter_mut().enumerate() {
            for (j, entry) in row.iter_mut().enumerate() {
                *entry = needed(&format!("cov_pose_{i}{j}"))?;
            }
        }
        Ok(Self {
            stamp: stamp.map_or_else(|| needed(STAMP[0]), Ok)?,
            position: [needed(x)?, needed(y)?, needed(z)?],
            quaternion: [needed(qx)?, needed(qy)?, needed(qz)?, needed(qw)?],
            covariance,
        })
    }

    fn read(&self, line: &str) -> Result<(f64, Isometry3<f64>, Matrix6<f64>), String> {
        let fields: Vec<&str> = line.split(',').map(str::trim).collect();
        let value = |index: usize| {
            let field = fields.get(index).ok_or("too few fields")?;
            let number = field.parse().map_err(|_| format!("{field:?} is not a number"))?;
            let finite = f64::is_finite(number);
            if finite { Ok(number) } else { Err(format!("{field} is not finite")) }
        };
        let [x, y, z] = self.position;
        let [qx, qy, qz, qw] = self.quaternion;
        let quaternion = Quaternion::new(value(qw)?, value(qx)?, value(qy)?, value(qz)?);
        let rotation = UnitQuaternion::try_new(quaternion, 0.5)
            .ok_or_else(|| "the quaternion is not of unit length".to_owned())?;
        let position = Vector3::new(value(x)?, value(y)?, value(z)?);
        let mut covariance = Matrix6::zeros();
        for (i, row) in self.covariance.iter().enumerate() {
            for (j, &index) in row.iter().enumerate() {
                covariance[(i, j)] = value(index)?;
            }
        }
        Ok((value(self.stamp)?, Isometry3::from_parts(position.into(), rotation), covariance))
    }
}

/// How the consistency of an estimate is judged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NeesOptions {
    pub association: AssociationOptions,
    /// Of the reference's world to the estimate's; not Sim(3), as a belief has no scale.
    pub alignment: Alignment,
    pub align_n: Option<usize>,
    /// Probability that a consistent error lies inside the reported band.
    pub confidence: f64,
}

/// Standard deviation of each component of the attitude below which it is known, rad.
const KNOWN_ATTITUDE: f64 = 0.2;
/// Verticals of two worlds that differ by more than this are not the same, degrees.
const SAME_VERTICAL_DEG: f64 = 5.0;

/// Whether what is up in one world is up in the other.
pub(crate) fn is_vertical(up: &Vector3<f64>) -> bool {
    up.angle(&Vector3::z()).to_degrees() < SAME_VERTICAL_DEG
}

impl NeesOptions {
    /// For an estimate whose vertical is that of gravity: heading and position of the first poses
    /// are put on each other, but not roll and pitch, whose error at the start is no property of
    /// the world, and is corrected. Where the reference's world is not z-up (its vertical differs
    /// from the estimate's by more than 5 degrees over the run), the whole poses are.
    pub fn levelled(
        reference: &Trajectory,
        estimate: &Trajectory,
        association: AssociationOptions,
    ) -> Result<Self, EvaluationError> {
        let up = matches(reference, estimate, &association)?
            .into_iter()
            .map(|(r, e)| (estimate.poses()[e].rotation, reference.poses()[r].rotation))
            .fold(Vector3::zeros(), |sum, (e, r)| sum + e * (r.inverse() * Vector3::z()));
        let (alignment, align_n) =
            if is_vertical(&up) { (Alignment::Yaw, Some(1)) } else { (Alignment::Origin, None) };
        Ok(Self { association, alignment, align_n, ..Self::default() })
    }
}

impl Default for NeesOptions {
    /// The first poses are put on each other: an odometry's world is fixed by where it starts.
    fn default() -> Self {
        Self {
            association: AssociationOptions::default(),
            alignment: Alignment::Origin,
            align_n: None,
            confidence: 0.95,
        }
    }
}

/// Normalised estimation error squared `e^T P^-1 e` over a run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NeesSummary {
    /// The mean of a consistent estimator.
    pub dof: usize,
    pub mean: f64,
    pub median: f64,
    /// Two-sided band of the chi-square distribution for a single error.
    pub band: [f64; 2],
    /// Fraction of the errors inside the band.
    pub inside: f64,
    /// Fraction of the errors above the band: overconfidence.
    pub above: f64,
    /// What the mean says, by how much the errors of the run have in common; where they are a run.
    #[serde(flatten)]
    pub run: Option<RunBand>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct NeesResult {
    pub matched: usize,
    pub reference_poses: usize,
    pub estimate_poses: usize,
    /// Pairs left out since their covariance is not positive definite.
    pub singular: usize,
    /// Stamps of the errors, s.
    pub stamps: Vec<f64>,
    /// Rotation vectors of `R_est^T R_true`, body frame, rad.
    pub rotation_errors: Vec<Vector3<f64>>,
    /// True minus estimated position in the estimate's world, m.
    pub position_errors: Vec<Vector3<f64>>,
    /// Standard deviations believed for each component: rotation (rad), position (m).
    pub rotation_sigmas: Vec<Vector3<f64>>,
    pub position_sigmas: Vec<Vector3<f64>>,
    pub attitude_nees: Vec<f64>,
    pub position_nees: Vec<f64>,
    pub joint_nees: Vec<f64>,
    pub attitude: NeesSummary,
    pub position: NeesSummary,
    pub joint: NeesSummary,
}

/// Judges the covariances of an estimate by its errors.
///
/// The reference is moved to the estimate's world, so that the covariances stay as they are. The
/// alignment begins where the attitude is known: before, an estimate that seeks the vertical has
/// no world yet.
pub fn nees(
    reference: &Trajectory,
    estimate: &BelievedTrajectory,
    options: &NeesOptions,
) -> Result<NeesResult, EvaluationError> {
    let confidence = options.confidence;
    if !(confidence > 0.0 && confidence < 1.0) {
        let (name, expected) = ("confidence", "between 0 and 1");
        return Err(EvaluationError::Option { name, expected, value: confidence });
    }
    if options.alignment == Alignment::Sim3 {
        return Err(EvaluationError::ScaledBelief);
    }
    let trajectory = &estimate.trajectory;
    let indices = matches(reference, trajectory, &options.association)?;
    if indices.len() < MIN_MATCHES {
        return Err(guards::too_few_matches(
            reference,
            trajectory,
            &options.association,
            indices.len(),
        ));
    }
    let covariance = |e: usize| estimate.covariances.get(e).copied().unwrap_or_else(Matrix6::zeros);
    let knows_attitude = |e: usize| {
        let rotation = covariance(e).fixed_view::<3, 3>(0, 0).into_owned();
        rotation.trace() < 3.0 * KNOWN_ATTITUDE.powi(2)
    };
    let first = indices.iter().position(|&(_, e)| knows_attitude(e)).unwrap_or(0);
    // Roles swapped: the reference is what gets aligned.
    let swapped = PosePairs {
        stamps: indices[first..].iter().map(|&(_, e)| trajectory.stamps()[e]).collect(),
        reference: indices[first..].iter().map(|&(_, e)| trajectory.poses()[e]).collect(),
        estimate: indices[first..].iter().map(|&(r, _)| reference.poses()[r]).collect(),
        reference_poses: trajectory.len(),
        estimate_poses: reference.len(),
        shared: 0,
    };
    let alignment = align(&swapped, options.alignment, options.align_n)?;
    let mut series = Series::default();
    for &(r, e) in &indices {
        let truth = alignment.apply(&reference.poses()[r]);
        series.push(trajectory.stamps()[e], &truth, &trajectory.poses()[e], &covariance(e));
    }
    let squares = |whitened: &[Vector3<f64>]| whitened.iter().map(Vector3::norm_squared).collect();
    let (Some(attitude), Some(position), Some(joint)) = (
        NeesSummary::of_run(&series.attitude, confidence),
        NeesSummary::of_run(&series.position, confidence),
        NeesSummary::of_run(&series.joint, confidence),
    ) else {
        return Err(EvaluationError::NoCovariance);
    };
    Ok(NeesResult {
        matched: indices.len(),
        reference_poses: reference.len(),
        estimate_poses: trajectory.len(),
        singular: indices.len() - series.stamps.len(),
        attitude,
        position,
        joint,
        stamps: series.stamps,
        rotation_errors: series.rotation_errors,
        position_errors: series.position_errors,
        rotation_sigmas: series.rotation_sigmas,
        position_sigmas: series.position_sigmas,
        attitude_nees: squares(&series.attitude),
        position_nees: squares(&series.position),
        joint_nees: series.joint.iter().map(Vector6::norm_squared).collect(),
    })
}

#[derive(Default)]
struct Series {
    stamps: Vec<f64>,
    rotation_errors: Vec<Vector3<f64>>,
    position_errors: Vec<Vector3<f64>>,
    rotation_sigmas: Vec<Vector3<f64>>,
    position_sigmas: Vec<Vector3<f64>>,
    /// In units of the covariances' roots, rotations about the axes of the estimate's world.
    attitude: Vec<Vector3<f64>>,
    position: Vec<Vector3<f64>>,
    joint: Vec<Vector6<f64>>,
}

impl Series {
    /// Leaves out errors whose covariance is not positive definite.
    fn push(
        &mut self,
        stamp: f64,
        truth: &Isometry3<f64>,
        estimate: &Isometry3<f64>,
        covariance: &Matrix6<f64>,
    ) {
        let rotation = (estimate.rotation.inverse() * truth.rotation).scaled_axis();
        let position = truth.translation.vector - estimate.translation.vector;
        let rotation_block = covariance.fixed_view::<3, 3>(0, 0).into_owned();
        let position_block = covariance.fixed_view::<3, 3>(3, 3).into_owned();
        // The axes of a body that turns would hide how long an error lasts.
        let mut turn = Matrix6::identity();
        let world_from_body = estimate.rotation.to_rotation_matrix().into_inner();
        turn.fixed_view_mut::<3, 3>(0, 0).copy_from(&world_from_body);
        let covariance = turn * covariance * turn.transpose();
        let world_rotation = world_from_body * rotation;
        let mut joint = Vector6::zeros();
        joint.fixed_rows_mut::<3>(0).copy_from(&world_rotation);
        joint.fixed_rows_mut::<3>(3).copy_from(&position);
        let (Some(attitude), Some(position_whitened), Some(joint)) = (
            whitened(&world_rotation, covariance.fixed_view::<3, 3>(0, 0).into_owned()),
            whitened(&position, position_block),
            whitened(&joint, covariance),
        ) else {
            return;
        };
        self.stamps.push(stamp);
        self.rotation_errors.push(rotation);
        self.position_errors.push(position);
        self.rotation_sigmas.push(rotation_block.diagonal().map(f64::sqrt));
        self.position_sigmas.push(position_block.diagonal().map(f64::sqrt));
        self.attitude.push(attitude);
        self.position.push(position_whitened);
        self.joint.push(joint);
    }
}

/// Mean, what it may be, and the share of the run inside the band of a single error.
impl std::fmt::Display for NeesSummary {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { dof, mean, inside, .. } = self;
        write!(f, "mean {mean:.1} ({dof} expected")?;
        if let Some(RunBand { mean_band: [low, high], verdict, .. }) = self.run {
            write!(f, ", {low:.1} to {high:.1} in a run like this: {}", verdict.name())?;
        }
        write!(f, "), {:.0} % of the time inside the band", 100.0 * inside)
    }
}

/// `e^T P^-1 e`; `None` unless `P` is positive definite.
pub fn normalised_square<const N: usize>(
    error: &SVector<f64, N>,
    covariance: SMatrix<f64, N, N>,
) -> Option<f64> {
    Some(whitened(error, covariance)?.norm_squared()).filter(|square| square.is_finite())
}

/// `L^-1 e`, `P = L L^T`; `None` unless `P` is positive definite.
fn whitened<const N: usize>(
    error: &SVector<f64, N>,
    covariance: SMatrix<f64, N, N>,
) -> Option<SVector<f64, N>> {
    let factor = Cholesky::new(covariance)?;
    let whitened = factor.l().solve_lower_triangular(error)?;
    whitened.iter().all(|x| x.is_finite()).then_some(whitened)
}

impl NeesSummary {
    /// `None` where there are no values.
    pub fn of(values: &[f64], dof: usize, confidence: f64) -> Option<Self> {
        let statistics = Statistics::of(values)?;
        let distribution = ChiSquared::new(dof as f64).ok()?;
        let tail = 0.5 * (1.0 - confidence);
        let band = [distribution.inverse_cdf(tail), distribution.inverse_cdf(1.0 - tail)];
        let fraction = |condition: &dyn Fn(f64) -> bool| {
            values.iter().filter(|value| condition(**value)).count() as f64 / values.len() as f64
        };
        Some(Self {
            dof,
            mean: statistics.mean,
            median: statistics.median,
            band,
            inside: fraction(&|value| band[0] <= value && value <= band[1]),
            above: fraction(&|value| value > band[1]),
            run: None,
        })
    }

    /// Of the errors of a run at equal steps, each in units of its covariance's root.
    fn of_run<const N: usize>(whitened: &[SVector<f64, N>], confidence: f64) -> Option<Self> {
        let squares: Vec<f64> = whitened.iter().map(SVector::norm_squared).collect();
        let run = RunBand::of(whitened, confidence);
        Some(Self { run, ..Self::of(&squares, N, confidence)? })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::AssociationRule;
    use approx::assert_relative_eq;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    /// A run whose errors are drawn from the covariances it reports, times `factor`.
    fn run(n: usize, factor: f64) -> (Trajectory, BelievedTrajectory) {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let root =
            Matrix6::from_fn(|i, j| if i == j { 0.05 } else { 0.01 * (i as f64 - j as f64).sin() });
        let covariance = root * root.transpose();
        let stamps: Vec<f64> = (0..n).map(|i| i as f64 * 0.1).collect();
        let mut truth = Vec::new();
        let mut estimate = Vec::new();
        for t in &stamps {
            let e: Vector6<f64> =
                root * Vector6::from_fn(|_, _| StandardNormal.sample(&mut rng)) * factor;
            let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(*t, -0.3 * t, 0.2));
            let position = Vector3::new(t.cos(), t.sin(), 0.1 * t);
            estimate.push(Isometry3::from_parts(position.into(), rotation));
            let error = UnitQuaternion::from_scaled_axis(e.fixed_rows::<3>(0).into_owned());
            let position = position + e.fixed_rows::<3>(3);
            truth.push(Isometry3::from_parts(position.into(), rotation * error));
        }
        let believed = BelievedTrajectory {
            trajectory: Trajectory::new(stamps.clone(), estimate).unwrap(),
            covariances: vec![covariance; n],
        };
        (Trajectory::new(stamps, truth).unwrap(), believed)
    }

    const SAME_WORLD: NeesOptions = NeesOptions {
        association: AssociationOptions {
            rule: AssociationRule::Nearest,
            max_diff: 0.01,
            time_offset: 0.0,
        },
        alignment: Alignment::None,
        align_n: None,
        confidence: 0.95,
    };

    #[test]
    fn a_consistent_run_has_the_mean_of_its_degrees_of_freedom() {
        let (truth, believed) = run(4000, 1.0);
        let result = nees(&truth, &believed, &SAME_WORLD).unwrap();
        assert_relative_eq!(result.attitude.mean, 3.0, max_relative = 0.05);
        assert_relative_eq!(result.position.mean, 3.0, max_relative = 0.05);
        assert_relative_eq!(result.joint.mean, 6.0, max_relative = 0.05);
        for summary in [&result.attitude, &result.position, &result.joint] {
            assert_relative_eq!(summary.inside, 0.95, epsilon = 0.015);
        }
        // Quantiles of the chi-square tables.
        assert_relative_eq!(result.attitude.band[1], 9.348404, epsilon = 1e-5);
        assert_relative_eq!(result.joint.band[0], 1.237344, epsilon = 1e-5);
    }

    #[test]
    fn an_overconfident_run_is_told() {
        let (truth, believed) = run(1000, 3.0);
        let result = nees(&truth, &believed, &SAME_WORLD).unwrap();
        assert_relative_eq!(result.joint.mean, 54.0, max_relative = 0.1);
        assert!(result.joint.above > 0.9);
    }

    #[test]
    fn covariances_that_are_not_positive_definite_are_counted() {
        let (truth, mut believed) = run(20, 1.0);
        believed.covariances[3] = Matrix6::zeros();
        assert_eq!(nees(&truth, &believed, &SAME_WORLD).unwrap().singular, 1);
        believed.covariances.fill(Matrix6::zeros());
        let error = nees(&truth, &believed, &SAME_WORLD).unwrap_err();
        assert!(matches!(error, EvaluationError::NoCovariance));
    }

    #[test]
    fn the_reference_may_live_in_another_world() {
        let (truth, believed) = run(500, 0.01);
        let motion = Isometry3::new(Vector3::new(5.0, -2.0, 1.0), Vector3::new(0.4, 1.2, -0.3));
        let moved = truth.poses().iter().map(|pose| motion * pose).collect();
        let moved = Trajectory::new(truth.stamps().to_vec(), moved).unwrap();
        let options = NeesOptions { alignment: Alignment::Se3, ..SAME_WORLD };
        let (here, there) = (nees(&truth, &believed, &options), nees(&moved, &believed, &options));
        assert_relative_eq!(
            here.unwrap().joint.mean,
            there.unwrap().joint.mean,
            max_relative = 1e-6
        );
    }

    /// The first pose is tilted by an error that the rest of the run does not have.
    #[test]
    fn an_error_of_the_first_tilt_does_not_tilt_the_world() {
        let (truth, mut believed) = run(500, 1.0);
        let mut poses = believed.trajectory.poses().to_vec();
        poses[0].rotation = UnitQuaternion::new(Vector3::x() * 0.3) * truth.poses()[0].rotation;
        poses[0].translation = truth.poses()[0].translation;
        let stamps = truth.stamps().to_vec();
        believed.trajectory = Trajectory::new(stamps.clone(), poses).unwrap();
        let levelled = |truth: &Trajectory| {
            NeesOptions::levelled(truth, &believed.trajectory, SAME_WORLD.association).unwrap()
        };
        let options = levelled(&truth);
        assert_eq!((options.alignment, options.align_n), (Alignment::Yaw, Some(1)));
        let attitude = nees(&truth, &believed, &options).unwrap().attitude.median;
        assert!(attitude < 4.0, "{attitude}");
        let default = nees(&truth, &believed, &NeesOptions::default()).unwrap();
        assert!(default.attitude.median > 20.0);

        let turn = UnitQuaternion::new(Vector3::y() * 1.5);
        let poses = truth.poses().iter().map(|pose| turn * pose).collect();
        let x_up = Trajectory::new(stamps, poses).unwrap();
        assert_eq!(levelled(&x_up).alignment, Alignment::Origin);
    }

    #[test]
    fn columns_are_found_by_name() {
        let names: Vec<String> = (0..36).map(|k| format!("cov_pose_{}{}", k / 6, k % 6)).collect();
        let header = format!("frame,qw,qx,qy,qz,timestamp,tx,ty,tz,{}", names.join(","));
        let values: Vec<String> =
            (0..36).map(|k| if k % 7 == 0 { "0.25" } else { "0" }.to_owned()).collect();
        let row = format!("7,1,0,0,0,12.5,1,2,3,{}", values.join(","));
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), format!("{header}\n{row}\n")).unwrap();
        let read = read_believed_trajectory(file.path()).unwrap();
        assert_eq!(read.trajectory.stamps(), [12.5]);
        assert_eq!(read.trajectory.poses()[0].translation.vector, Vector3::new(1.0, 2.0, 3.0));
        assert_eq!(read.covariances[0], Matrix6::identity() * 0.25);
        std::fs::write(file.path(), header.replace("cov_pose_45", "other")).unwrap();
        let error = read_believed_trajectory(file.path()).unwrap_err().to_string();
        assert!(error.contains("no column cov_pose_45"), "{error}");
        std::fs::write(file.path(), format!("{header}\n{}\n", row.replace("12.5", "x"))).unwrap();
        let error = read_believed_trajectory(file.path()).unwrap_err().to_string();
        assert!(error.contains("line 2"), "{error}");
    }
}
