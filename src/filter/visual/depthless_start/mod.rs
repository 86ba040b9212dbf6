//! The start without depth: velocity, gravity and biases from what cameras saw of points and an IMU
//! felt over about a second.
//!
#![doc = include_str!("../../../../docs/theory/depthless_start.md")]
#![doc = include_str!("../../../../docs/math.html")]

mod motion;
mod normal;
mod sight;
#[cfg(test)]
mod tests;

use nalgebra::{Matrix2, Point2, Point3, SMatrix, Vector3};

use super::slam::MountedCamera;
use crate::filter::core::{FilterError, InertialStep, VectorEstimate};
use motion::{Motion, Sought, part};
use normal::{Chart, Normal, damped};
use sight::Sight;

/// Beyond this a whitened residual counts less: one in ninety of good ones.
const HUBER: f64 = 3.0;
/// Steps of the search; it takes four to eight.
const STEPS: usize = 30;
/// The search ends where the cost falls by less than this, relative to it.
const CONVERGED: f64 = 1e-9;
/// Standard deviation of the magnitude of gravity, relative to it.
const MAGNITUDE_SD: f64 = 1e-3;
/// The magnitude is used once gravity is known to this part of it along every axis: it has a direction.
const HAS_DIRECTION: f64 = 0.3;
/// Ranges of points at a start of which nothing better is known, m.
const RANGES: [f64; 3] = [3.0, 10.0, 1.0];
/// Squared residuals per degree of freedom of a search that has not ended beside the minimum: there
/// they are hundreds.
const FITS: f64 = 4.0;
/// Fewer points than this determine nothing: each leaves some rows, and twelve numbers are sought.
const FEWEST_POINTS: usize = 6;

/// First rows of what is sought: velocity at the first frame (m/s), gravity (m/s^2), biases of the
/// accelerometer (m/s^2) and of the gyroscope (rad/s).
pub mod start_block {
    pub const VELOCITY: usize = 0;
    pub const GRAVITY: usize = 3;
    pub const ACCEL_BIAS: usize = 6;
    pub const GYRO_BIAS: usize = 9;
}

/// What a camera showed of a point in one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StartView {
    /// Index of the frame.
    pub frame: usize,
    /// Index of the camera.
    pub camera: usize,
    /// In the image as taken, px.
    pub pixel: Point2<f64>,
    /// px^2.
    pub pixel_covariance: Matrix2<f64>,
}

/// What one point showed.
#[derive(Debug, Clone, PartialEq)]
pub struct StartTrack {
    pub id: u64,
    pub views: Vec<StartView>,
}

/// What a start is found from.
#[derive(Debug, Clone, Copy)]
pub struct StartInput<'a> {
    /// For each frame the IMU's steps since the one before it; none for the first.
    pub frames: &'a [Vec<InertialStep>],
    pub tracks: &'a [StartTrack],
    pub cameras: &'a [MountedCamera],
    pub prior: StartPrior,
}

/// What is known before: the biases, and the magnitude of gravity (m/s^2).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StartPrior {
    pub gyro_bias: VectorEstimate,
    pub accel_bias: VectorEstimate,
    pub gravity: f64,
}

/// What was found, in the frame of the first body.
#[derive(Debug, Clone, PartialEq)]
pub struct StartSolution {
    /// Velocity at the first frame, m/s.
    pub velocity: Vector3<f64>,
    /// m/s^2.
    pub gravity: Vector3<f64>,
    /// m/s^2.
    pub accel_bias: Vector3<f64>,
    /// rad/s.
    pub gyro_bias: Vector3<f64>,
    /// By [`start_block`]; what the pixels' errors and the biases leave open. The IMU's white noise is
    /// not in it: beyond a second it is a few times more.
    pub covariance: SMatrix<f64, 12, 12>,
    /// Standard deviation of the logarithm of the scale, of the same kind.
    pub scale_sd: f64,
    /// Points by their ids, m.
    pub points: Vec<(u64, Vector3<f64>)>,
    /// Sum of the squared residuals per degree of freedom; about 1 when consistent.
    pub nis: f64,
}

/// The frames and points of a start.
struct Problem<'a> {
    /// For each frame the IMU's steps since the one before it.
    frames: &'a [Vec<InertialStep>],
    prior: &'a StartPrior,
    sights: Vec<Vec<Sight>>,
    /// Of all sights whose residual is larger, only so much counts (Huber), in standard deviations.
    huber: f64,
}

/// A solution on its way.
struct Iterate {
    sought: Sought,
    /// At what is sought, a frame each.
    motions: Vec<Motion>,
    /// In the first body's frame, m.
    points: Vec<Vector3<f64>>,
    /// Their directions and ranges from where they were seen first.
    charts: Vec<Chart>,
    normal: Normal,
    cost: f64,
    uses_magnitude: bool,
}

impl Problem<'_> {
    fn motions(&self, sought: &Sought) -> Result<Vec<Motion>, FilterError> {
        let mut motion = Motion::START;
        let mut motions = Vec::with_capacity(self.frames.len());
        for steps in self.frames {
            for step in steps {
                motion = motion.after(step, sought)?;
            }
            motions.push(motion);
        }
        Ok(motions)
    }

    fn biases(&self) -> [(usize, &VectorEstimate); 2] {
        let prior = self.prior;
        [(start_block::ACCEL_BIAS, &prior.accel_bias), (start_block::GYRO_BIAS, &prior.gyro_bias)]
    }

    fn sought_of_prior(&self) -> Sought {
        let mut sought = Sought::zeros();
        for (start, bias) in self.biases() {
            sought.fixed_rows_mut::<3>(start).copy_from(&bias.mean);
        }
        sought
    }

    /// Adds what is known of the biases, and gives what it costs.
    fn add_biases(&self, normal: &mut Normal, sought: &Sought) -> Option<f64> {
        let mut cost = 0.0;
        for (start, bias) in self.biases() {
            let root = bias.covariance.cholesky()?.l().try_inverse()?;
            let residual = root * (bias.mean - part(sought, start));
            cost += residual.norm_squared();
            for k in 0..3 {
                normal.add_prior(start, &root.row(k).transpose(), residual[k]);
            }
        }
        Some(cost)
    }

    /// Adds the magnitude of gravity, `|g| + (g/|g|) . dg = G + noise`.
    fn add_magnitude(&self, normal: &mut Normal, sought: &Sought) -> Option<f64> {
        let gravity = part(sought, start_block::GRAVITY);
        let sd = MAGNITUDE_SD * self.prior.gravity;
        let residual = (self.prior.gravity - gravity.norm()) / sd;
        let direction = gravity.try_normalize(0.0)? / sd;
        normal.add_prior(start_block::GRAVITY, &direction, residual);
        Some(residual.powi(2))
    }

    /// The closed form (Dong-Si and Mourikis, Martinelli): `[b]x c` is linear in all but the
    /// gyroscope's bias. The noise of the directions is in its design and pulls the scale towards
    /// zero: it finds a place to start from, no more.
    fn closed_form(&self) -> Result<(Sought, Vec<Vector3<f64>>), FilterError> {
        let mut sought = self.sought_of_prior();
        let motions = self.motions(&sought)?;
        let mut normal = Normal::empty(self.sights.len());
        for (k, sights) in self.sights.iter().enumerate() {
            for sight in sights {
                let motion = &motions[sight.frame];
                let (skew, constant) = sight.linear();
                let deviations = sight.weight.norm() / std::f64::consts::SQRT_2;
                let in_body = motion.rotation.transpose() * -motion.position(&sought);
                let residual = -(skew * in_body + constant) * deviations;
                let by_point = skew * motion.rotation.transpose() * deviations;
                let mut by_sought = skew * motion.point_by_sought(&in_body) * deviations;
                by_sought.fixed_columns_mut::<3>(start_block::GYRO_BIAS).fill(0.0);
                normal.add(k, &residual, &by_point, &by_sought);
            }
        }
        let singular = FilterError::NoConvergence("the closed form of a start");
        self.add_biases(&mut normal, &sought).ok_or(singular)?;
        let (step, points) = normal.step(0.0).ok_or(singular)?;
        sought += step;
        Ok((sought, points))
    }

    /// The closed form as a start, where all its points are before the cameras.
    fn closed_start(&self) -> Option<Iterate> {
        let (sought, points) = self.closed_form().ok()?;
        self.at(sought, self.motions(&sought).ok()?, points, false)
    }

    /// A body at rest in the direction that the accelerometer says, its points at one range.
    fn resting_start(&self, range: f64) -> Option<Iterate> {
        let mut resting = self.sought_of_prior();
        let motions = self.motions(&resting).ok()?;
        let up = motions.last()?.speed.try_normalize(0.0)?;
        let gravity = up * -self.prior.gravity;
        resting.fixed_rows_mut::<3>(start_block::GRAVITY).copy_from(&gravity);
        let at_range = |sights: &Vec<Sight>| {
            let motion = &motions[sights[0].frame];
            let in_camera = Point3::from(sights[0].bearing * range);
            let in_body = sights[0].camera_from_body.inverse_transform_point(&in_camera).coords;
            motion.rotation * in_body + motion.position(&resting)
        };
        let points = self.sights.iter().map(at_range).collect();
        // Gravity is no part of what the IMU tells of the motion.
        self.at(resting, motions, points, false)
    }

    /// The best of what the search comes to from several starts; the first that fits ends it.
    fn search(&self) -> Option<Iterate> {
        let starts = std::iter::once_with(|| self.closed_start())
            .chain(RANGES.into_iter().map(|range| self.resting_start(range)));
        let mut best: Option<Iterate> = None;
        for found in starts.flatten().filter_map(|start| self.descend(start)) {
            if best.as_ref().is_none_or(|best| found.cost < best.cost) {
                best = Some(found);
            }
            if best.as_ref().is_some_and(|best| best.cost < FITS * self.freedom()) {
                break;
            }
        }
        best
    }

    /// Rows beyond what is sought.
    fn freedom(&self) -> f64 {
        let views: usize = self.sights.iter().map(Vec::len).sum();
        (2 * views).saturating_sub(3 * self.sights.len() + 12).max(1) as f64
    }

    /// Cost and normal equations; `None` where a point is behind a camera, or nothing is finite.
    fn at(
        &self,
        sought: Sought,
        motions: Vec<Motion>,
        points: Vec<Vector3<f64>>,
        uses_magnitude: bool,
    ) -> Option<Iterate> {
        let mut normal = Normal::empty(points.len());
        let mut cost = self.add_biases(&mut normal, &sought)?;
        if uses_magnitude {
            cost += self.add_magnitude(&mut normal, &sought)?;
        }
        let mut charts = Vec::with_capacity(points.len());
        for (k, point) in points.iter().enumerate() {
            charts.push(Chart::around(point, centre(&motions, &self.sights[k][0], &sought))?);
            for sight in &self.sights[k] {
                let motion = &motions[sight.frame];
                let in_body = in_body(&motions, sight, &sought, point);
                let (residual, by_body) = sight.residual(&in_body)?;
                let (loss, root) = huber(residual.norm(), self.huber);
                cost += loss;
                let by_body = by_body * root;
                let by_point = by_body * motion.rotation.transpose();
                let by_sought = by_body * motion.point_by_sought(&in_body);
                normal.add(k, &(residual * root), &by_point, &by_sought);
            }
        }
        let iterate = Iterate { sought, motions, points, charts, normal, cost, uses_magnitude };
        cost.is_finite().then_some(iterate)
    }

    /// The same with the magnitude of gravity, once it has a direction.
    fn with_magnitude(&self, iterate: Iterate) -> Option<Iterate> {
        if iterate.uses_magnitude {
            return Some(iterate);
        }
        let (information, _) = iterate.normal.reduced(0.0)?;
        let covariance = information.cholesky()?.inverse();
        let of_gravity =
            covariance.fixed_view::<3, 3>(start_block::GRAVITY, start_block::GRAVITY).into_owned();
        let sd = of_gravity.symmetric_eigenvalues().max().sqrt();
        if sd < HAS_DIRECTION * self.prior.gravity {
            return self.at(iterate.sought, iterate.motions, iterate.points, true);
        }
        Some(iterate)
    }

    /// The points after a step. One that it would take behind a camera keeps to its ray.
    fn moved_points(
        &self,
        iterate: &Iterate,
        sought: &Sought,
        motions: &[Motion],
        moves: &[Vector3<f64>],
    ) -> Vec<Vector3<f64>> {
        let charts = iterate.charts.iter().zip(moves).zip(&self.sights).zip(&iterate.points);
        let moved = charts.map(|(((chart, by), sights), point)| {
            let sees = |sight: &Sight| {
                let in_body = in_body(motions, sight, sought, &(point + by));
                sight.bearing.dot(&sight.in_camera(&in_body)) > 0.0
            };
            if sights.iter().all(sees) { point + by } else { chart.moved(by) }
        });
        moved.collect()
    }

    /// Levenberg's method from where `iterate` is.
    fn descend(&self, mut iterate: Iterate) -> Option<Iterate> {
        let mut damping = 1e-6;
        for _ in 0..STEPS {
            iterate = self.with_magnitude(iterate)?;
            let next = iterate.normal.step(damping).and_then(|(step, moves)| {
                let sought = iterate.sought + step;
                let motions = self.motions(&sought).ok()?;
                let points = self.moved_points(&iterate, &sought, &motions, &moves);
                self.at(sought, motions, points, iterate.uses_magnitude)
            });
            match next.filter(|next| next.cost <= iterate.cost) {
                Some(next) => {
                    let fell = iterate.cost - next.cost;
                    (iterate, damping) = (next, (0.1 * damping).max(1e-9));
                    if fell < CONVERGED * iterate.cost.max(1.0) {
                        return Some(iterate);
                    }
                }
                None if damping > 1e6 => return Some(iterate),
                None => damping = (damping * 10.0).max(1e-4),
            }
        }
        Some(iterate)
    }
}

/// A point as seen from the body in the frame of a view.
fn in_body(
    motions: &[Motion],
    sight: &Sight,
    sought: &Sought,
    point: &Vector3<f64>,
) -> Vector3<f64> {
    let motion = &motions[sight.frame];
    motion.rotation.transpose() * (point - motion.position(sought))
}

/// Where the camera of a view was.
fn centre(motions: &[Motion], sight: &Sight, sought: &Sought) -> Vector3<f64> {
    let motion = &motions[sight.frame];
    let in_body = sight.camera_from_body.inverse_transform_point(&Point3::origin());
    motion.rotation * in_body.coords + motion.position(sought)
}

/// Huber's loss of a residual of this length, and the root of the weight that it gets.
fn huber(length: f64, from: f64) -> (f64, f64) {
    if length <= from {
        (length * length, 1.0)
    } else {
        (from * (2.0 * length - from), (from / length).sqrt())
    }
}

/// Finds velocity, gravity, biases and points from frames of about a second.
///
/// Least squares on the pixels' residuals in the frame of the first body, its points eliminated:
/// `O(views)` a step, about six steps. From a start by the closed form it converges from a scale
/// that is twenty times too small.
///
/// # Errors
/// [`FilterError::NoMeasurement`] with fewer than six points seen in two frames or more,
/// [`FilterError::NoConvergence`] where nothing fits, and what is wrong with steps and views.
pub fn start_without_depth(input: &StartInput<'_>) -> Result<StartSolution, FilterError> {
    let StartInput { frames, tracks, cameras, prior } = input;
    let (mut ids, mut sights) = (Vec::new(), Vec::new());
    for track in tracks.iter().filter(|track| track.views.len() > 1) {
        let views = track.views.iter().map(|view| Sight::of(view, cameras, frames.len()));
        sights.push(views.collect::<Result<Vec<_>, _>>()?);
        ids.push(track.id);
    }
    if sights.len() < FEWEST_POINTS {
        return Err(FilterError::NoMeasurement);
    }
    let mut problem = Problem { frames, prior, sights, huber: f64::INFINITY };
    let failed = FilterError::NoConvergence("the start without depth");
    problem.motions(&problem.sought_of_prior())?;
    let coarse = problem.search().ok_or(failed)?;
    problem.huber = HUBER;
    let Iterate { sought, motions, points, uses_magnitude, .. } = coarse;
    let fine = problem.at(sought, motions, points, uses_magnitude).ok_or(failed)?;
    let fine = problem.descend(fine).ok_or(failed)?;
    problem.solution(&fine, &ids).ok_or(failed)
}

impl Problem<'_> {
    fn solution(&self, found: &Iterate, ids: &[u64]) -> Option<StartSolution> {
        let (information, _) = found.normal.reduced(0.0)?;
        let covariance = information.cholesky()?.inverse();
        let solution = StartSolution {
            velocity: part(&found.sought, start_block::VELOCITY),
            gravity: part(&found.sought, start_block::GRAVITY),
            accel_bias: part(&found.sought, start_block::ACCEL_BIAS),
            gyro_bias: part(&found.sought, start_block::GYRO_BIAS),
            covariance,
            scale_sd: scale_sd(found, &covariance)?,
            points: ids.iter().copied().zip(found.points.iter().copied()).collect(),
            nis: found.cost / self.freedom(),
        };
        let entries = solution.covariance.iter().chain(found.sought.iter());
        let finite = entries.chain(found.points.iter().flatten()).all(|x| x.is_finite());
        (finite && solution.scale_sd.is_finite()).then_some(solution)
    }
}

/// Of the mean logarithm of the points' ranges, which follow what is sought by
/// `dl = -H_ll^-1 H_lx dx`: what they have of their own is averaged away.
fn scale_sd(found: &Iterate, covariance: &SMatrix<f64, 12, 12>) -> Option<f64> {
    let mut mean = SMatrix::<f64, 1, 12>::zeros();
    for ((own, cross, _), chart) in found.normal.points.iter().zip(&found.charts) {
        let by_sought = damped(own, 0.0).cholesky()?.solve(cross) * -chart.inverse_range;
        mean += chart.ray.axes.column(2).transpose() * by_sought / found.points.len() as f64;
    }
    Some((mean * covariance * mean.transpose())[(0, 0)].sqrt())
}
