//! Tables 5.9, 5.10, 5.14 and figure 5.3 of W22: the pose between two point sets.
//!
//! Map points are drawn anew in each run; the paper keeps one draw a table column ("with respect
//! to the random measurement noises"), which it does not print. Its columns therefore compare by
//! their ratio to that of least squares, which the reports note. In table 5.14 the points
//! themselves lie in the unit cube and the map errs about them: with their means there instead, as
//! the text has it, the map errors would be twice the printed ones.

use std::f64::consts::{FRAC_PI_2, PI};
use std::time::Instant;

use nalgebra::{Matrix3, Matrix6, Rotation3, Vector3, Vector6};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::study::normalized_square;
use super::{
    Observation, PaperValue, Report, Request, StepTime, Study, StudyError, Trial, monte_carlo,
};
use crate::alignment::{
    AlignmentError, LeastSquaresConfig, LeastSquaresPose, MapEstimate, PointPair, PosePosterior,
    WeightedPair, align, align_progressively, optimize_pose, weighted_kabsch,
};
use crate::distribution::progressive::ProgressiveConfig;
use crate::distribution::rotation_quadratic::vectorize;
use crate::evaluation::{Curve, Figure};
use crate::so3::{angle_between, log};

/// Sections 5.2.2 and 5.2.4 of W22 without filters.
pub const STUDIES: &[Study] = &[
    Study {
        name: "wang-5.9",
        title: "pose between two point sets, few points and much noise",
        runs: 1000,
        run: table_5_9,
    },
    Study {
        name: "wang-5.10",
        title: "pose from points close to a line; divergences of figure 5.3",
        runs: 1000,
        run: table_5_10,
    },
    Study {
        name: "wang-5.14",
        title: "pose and map with two levels of map uncertainty",
        runs: 1000,
        run: table_5_14,
    },
];

/// Samples of the posterior a run for each divergence.
const DIVERGENCE_SAMPLES: usize = 200;

fn table_5_9(request: &Request) -> Result<Report, StudyError> {
    let cases = [
        (20, "N=20"),
        (18, "N=18"),
        (16, "N=16"),
        (14, "N=14"),
        (12, "N=12"),
        (10, "N=10"),
        (8, "N=8"),
        (6, "N=6"),
        (4, "N=4"),
    ];
    study("wang-5.9", request, TABLE_5_9, |rng, trial| {
        cases.iter().try_for_each(|&(n, label)| Problem::scattered(n, rng).solve(label, trial))
    })
}

fn table_5_10(request: &Request) -> Result<Report, StudyError> {
    let cases = [(1.0, "a=1"), (0.1, "a=0.1"), (0.01, "a=0.01"), (0.0, "a=0")];
    let mut report = study("wang-5.10", request, TABLE_5_10, |rng, trial| {
        for (a, label) in cases {
            Problem::near_a_line(a, rng).solve(label, trial)?;
        }
        for (n, label, _) in FIGURE_5_3 {
            Problem::scattered(n, rng).diverge(label, rng, trial)?;
        }
        Ok(())
    })?;
    report.figures.push(figure_5_3(&report));
    report.notes.push(
        "kl_nats: divergence of each approximation from the exact posterior, which is sampled \
         exactly (importance sampling with equal weights); the paper's figure 5.3 lacks its \
         constant"
            .to_owned(),
    );
    Ok(report)
}

/// Numbers of points of figure 5.3.
const FIGURE_5_3: [(usize, &str, f64); 7] = [
    (3, "N=3", 3.0),
    (4, "N=4", 4.0),
    (6, "N=6", 6.0),
    (8, "N=8", 8.0),
    (10, "N=10", 10.0),
    (14, "N=14", 14.0),
    (20, "N=20", 20.0),
];

fn figure_5_3(report: &Report) -> Figure {
    let curve = |filter: &'static str| {
        let point = |&(_, label, n): &(usize, &str, f64)| {
            Some([n, report.row(label, filter, "kl_nats")?.mean])
        };
        Curve { name: filter.to_owned(), points: FIGURE_5_3.iter().filter_map(point).collect() }
    };
    Figure::logarithmic(
        "Figure 5.3: divergence from the posterior of the pose",
        "points",
        "KL divergence, nats",
        ["mfg", "mfg-paper", "lm"].map(curve).into(),
    )
}

fn table_5_14(request: &Request) -> Result<Report, StudyError> {
    let cases = [(10, "N1=10"), (8, "N1=8"), (6, "N1=6"), (4, "N1=4"), (2, "N1=2"), (0, "N1=0")];
    study("wang-5.14", request, TABLE_5_14, |rng, trial| {
        cases
            .iter()
            .try_for_each(|&(certain, label)| Problem::uncertain(certain, rng).solve(label, trial))
    })
}

/// The report on runs of `run`, with the paper's columns.
fn study(
    name: &str,
    request: &Request,
    paper: &[[PaperValue; 3]],
    run: impl Fn(&mut ChaCha8Rng, &mut Trial) -> Result<(), AlignmentError> + Sync,
) -> Result<Report, StudyError> {
    let trials = monte_carlo(request, |rng| {
        let mut trial = Trial::default();
        run(rng, &mut trial)?;
        Ok::<_, AlignmentError>(trial)
    })?;
    let mut report = Report::of(name, request.seed, &trials, paper.as_flattened());
    report.notes = ratios_to_least_squares(&report);
    Ok(report)
}

/// The paper's method over least squares, ours (the paper's): all that can be compared of columns
/// that stand for one unknown draw of map points each.
fn ratios_to_least_squares(report: &Report) -> Vec<String> {
    let line = |quantity: &&str| {
        let own = report.rows.iter().filter(|r| r.filter == "mfg-paper" && r.quantity == *quantity);
        let ratios = own.filter_map(|row| {
            let lm = report.row(&row.case, "lm", quantity)?;
            let paper = row.paper? / lm.paper?;
            Some(format!("{} {:.3} ({paper:.3})", row.case, row.mean / lm.mean))
        });
        let ratios = ratios.collect::<Vec<_>>().join(", ");
        (!ratios.is_empty()).then(|| format!("{quantity}, mfg-paper/lm (the paper's): {ratios}"))
    };
    QUANTITIES.iter().filter_map(line).collect()
}

/// What the tables list.
const QUANTITIES: [&str; 4] = ["attitude_deg", "position_m", "map_n1_m", "map_rest_m"];

/// One draw of points and noise, with the truth.
struct Problem {
    rotation: Rotation3<f64>,
    position: Vector3<f64>,
    /// Positions of the map points, world coordinates.
    map: Vec<Vector3<f64>>,
    pairs: Vec<PointPair>,
    /// The first so many map points are the certain ones; `None` if all are exact.
    certain: Option<usize>,
}

/// A pose that one of the methods found, and its map.
struct Found {
    rotation: Rotation3<f64>,
    position: Vector3<f64>,
    map: Vec<Vector3<f64>>,
    /// Covariances of the body-frame rotation vector and of the position.
    covariances: Option<(Matrix3<f64>, Matrix3<f64>)>,
    nanoseconds: f64,
}

impl Problem {
    /// Table 5.9: the unit cube around the body, noise of 0.5.
    fn scattered(n: usize, rng: &mut ChaCha8Rng) -> Self {
        let rotation = Rotation3::new(Vector3::z() * FRAC_PI_2);
        let position = Vector3::new(5.0, 0.0, 0.0);
        let map = (0..n).map(|_| position + uniform(rng, 0.0, 1.0)).collect();
        Self::measured(rotation, position, map, 0.5, |_| 0.0, rng)
    }

    /// Table 5.10: ten points within `a` of a line, noise of 0.1.
    fn near_a_line(a: f64, rng: &mut ChaCha8Rng) -> Self {
        let rotation =
            Rotation3::new(Vector3::x() * FRAC_PI_2) * Rotation3::new(Vector3::y() * FRAC_PI_2);
        let along = Vector3::new(5.0, 0.0, 0.0);
        let extent = Vector3::new(1.0, a, a);
        let map = (0..10).map(|_| along + uniform(rng, -1.0, 1.0).component_mul(&extent)).collect();
        Self::measured(rotation, Vector3::zeros(), map, 0.1, |_| 0.0, rng)
    }

    /// Table 5.14: ten points, the first `certain` known to 0.1 and the others to 1.
    fn uncertain(certain: usize, rng: &mut ChaCha8Rng) -> Self {
        let rotation = Rotation3::new(Vector3::z() * FRAC_PI_2);
        let position = Vector3::new(5.0, 0.0, 0.0);
        let map = (0..10).map(|_| position + uniform(rng, 0.0, 1.0)).collect();
        let sd = |i: usize| if i < certain { 0.1 } else { 1.0 };
        let problem = Self::measured(rotation, position, map, 0.1, sd, rng);
        Self { certain: Some(certain), ..problem }
    }

    /// The map knows point `i` to `map_sd(i)`.
    fn measured(
        rotation: Rotation3<f64>,
        position: Vector3<f64>,
        map: Vec<Vector3<f64>>,
        sd: f64,
        map_sd: impl Fn(usize) -> f64,
        rng: &mut ChaCha8Rng,
    ) -> Self {
        let pair = |(i, point): (usize, &Vector3<f64>)| PointPair {
            in_body: rotation.inverse() * (point - position) + normal(rng) * sd,
            body_covariance: Matrix3::identity() * sd.powi(2),
            in_world: point + normal(rng) * map_sd(i),
            world_covariance: Matrix3::identity() * map_sd(i).powi(2),
        };
        let pairs = map.iter().enumerate().map(pair).collect();
        Self { rotation, position, map, pairs, certain: None }
    }

    fn solve(&self, case: &'static str, trial: &mut Trial) -> Result<(), AlignmentError> {
        let methods: [(&'static str, Found); 4] = [
            ("mfg", self.posterior(align)?),
            ("mfg-paper", self.posterior(progressive)?),
            ("lm", self.least_squares()),
            ("kabsch", self.closed_form()),
        ];
        for (filter, found) in methods {
            let mut observe = |quantity, value| {
                trial.observations.push(Observation { case, filter, quantity, value });
            };
            observe("attitude_deg", angle_between(&found.rotation, &self.rotation).to_degrees());
            observe("position_m", (found.position - self.position).norm());
            if let Some(certain) = self.certain {
                let error = |range: std::ops::Range<usize>| {
                    let n = range.len() as f64;
                    range.map(|i| (found.map[i] - self.map[i]).norm()).sum::<f64>() / n
                };
                let all = self.map.len();
                for (quantity, range) in
                    [("map_m", 0..all), ("map_n1_m", 0..certain), ("map_rest_m", certain..all)]
                {
                    if !range.is_empty() {
                        observe(quantity, error(range));
                    }
                }
            }
            if let Some((attitude, position)) = found.covariances {
                let turn = log(&(found.rotation.inverse() * self.rotation));
                observe("nees_attitude", normalized_square(&turn, &attitude));
                let shift = self.position - found.position;
                observe("nees_position", normalized_square(&shift, &position));
            }
            let nanoseconds = found.nanoseconds;
            trial.step_times.push(StepTime { case, filter, nanoseconds });
        }
        Ok(())
    }

    fn posterior(
        &self,
        method: impl Fn(&[PointPair]) -> Result<PosePosterior, AlignmentError>,
    ) -> Result<Found, AlignmentError> {
        let clock = Instant::now();
        let posterior = method(&self.pairs)?;
        let nanoseconds = clock.elapsed().as_nanos() as f64;
        let map = self.pairs.iter().map(|pair| {
            posterior.map_point(pair).map_or(pair.in_world, |estimate| estimate.position)
        });
        let attitude = posterior.pose.attitude();
        Ok(Found {
            rotation: attitude.mode(),
            position: *posterior.pose.mu(),
            map: map.collect(),
            covariances: Some((
                attitude.rotation_covariance(),
                posterior.pose.moments().covariance,
            )),
            nanoseconds,
        })
    }

    fn least_squares(&self) -> Found {
        let clock = Instant::now();
        let pose = self.minimum();
        let nanoseconds = clock.elapsed().as_nanos() as f64;
        match pose {
            Some(pose) => self.point_estimate(pose.rotation, pose.position, nanoseconds),
            None => self.closed_form(),
        }
    }

    /// From the closed form, so that the global minimum is found.
    fn minimum(&self) -> Option<LeastSquaresPose> {
        let (rotation, position) = self.kabsch();
        optimize_pose(&self.pairs, &rotation, &position, &LeastSquaresConfig::default())
    }

    fn closed_form(&self) -> Found {
        let clock = Instant::now();
        let (rotation, position) = self.kabsch();
        self.point_estimate(rotation, position, clock.elapsed().as_nanos() as f64)
    }

    /// Where the points leave the rotation undetermined, the shortest that fits them: it turns
    /// the line of the measured points onto that of the map.
    fn kabsch(&self) -> (Rotation3<f64>, Vector3<f64>) {
        let weighted = |pair: &PointPair| WeightedPair {
            from: pair.in_body,
            to: pair.in_world,
            weight: 3.0 / (pair.body_covariance + pair.world_covariance).trace(),
        };
        if let Some(pose) = weighted_kabsch(self.pairs.iter().map(weighted)) {
            return (pose.rotation.to_rotation_matrix(), pose.translation.vector);
        }
        let n = self.pairs.len() as f64;
        let body = self.pairs.iter().map(|pair| pair.in_body).sum::<Vector3<f64>>() / n;
        let world = self.pairs.iter().map(|pair| pair.in_world).sum::<Vector3<f64>>() / n;
        let cross: Matrix3<f64> = self
            .pairs
            .iter()
            .map(|pair| (pair.in_world - world) * (pair.in_body - body).transpose())
            .sum();
        let svd = cross.svd(true, true);
        let line = svd.singular_values.imax();
        let rotation = match (svd.u, svd.v_t) {
            (Some(u), Some(v_t)) => {
                let (from, to) = (v_t.row(line).transpose(), u.column(line).into_owned());
                Rotation3::rotation_between(&from, &to)
            }
            _ => None,
        };
        let rotation = rotation.unwrap_or_else(Rotation3::identity);
        (rotation, world - rotation * body)
    }

    fn point_estimate(
        &self,
        rotation: Rotation3<f64>,
        position: Vector3<f64>,
        nanoseconds: f64,
    ) -> Found {
        let map = self.pairs.iter().map(|pair| {
            let seen = MapEstimate {
                position: rotation * pair.in_body + position,
                covariance: Matrix3::zeros(),
            };
            MapEstimate::posterior(pair, &rotation, &seen)
                .map_or(pair.in_world, |estimate| estimate.position)
        });
        let map = map.collect();
        Found { rotation, position, map, covariances: None, nanoseconds }
    }

    /// Divergences of the approximations from the exact posterior, and the errors that the
    /// Gaussian claims for itself.
    fn diverge(
        &self,
        case: &'static str,
        rng: &mut ChaCha8Rng,
        trial: &mut Trial,
    ) -> Result<(), AlignmentError> {
        let exact = align(&self.pairs)?;
        let paper = progressive(&self.pairs)?;
        let gaussian = self.minimum().and_then(TangentPose::new);
        let sampler = exact.pose.attitude().sampler();
        let root = exact.density.covariance.cholesky().map(|factor| factor.l());
        let mut sums = [0.0; 3];
        for _ in 0..DIVERGENCE_SAMPLES {
            let r: Rotation3<f64> = sampler.sample(rng);
            let mean = exact.density.offset + exact.density.slope * vectorize(r.matrix());
            let noise = normal(rng);
            let t = exact.origin + mean + root.map_or_else(Vector3::zeros, |root| root * noise);
            // Of the exact posterior: matrix Fisher, and Gaussian given the attitude.
            let log_root: f64 = root.map_or(0.0, |l| l.diagonal().map(f64::ln).sum());
            let log_exact = exact.pose.attitude().log_density(&r)
                - 0.5 * noise.norm_squared()
                - log_root
                - 1.5 * (2.0 * PI).ln();
            let others = [
                exact.pose.log_density(&r, &t),
                paper.pose.log_density(&r, &t),
                gaussian.as_ref().map_or(f64::NAN, |gaussian| gaussian.log_density(&r, &t)),
            ];
            for (sum, other) in sums.iter_mut().zip(others) {
                *sum += (log_exact - other) / DIVERGENCE_SAMPLES as f64;
            }
        }
        for (filter, value) in ["mfg", "mfg-paper", "lm"].into_iter().zip(sums) {
            trial.observations.push(Observation { case, filter, quantity: "kl_nats", value });
        }
        Ok(())
    }
}

/// The Gaussian of least squares, in the rotation vector and the position.
struct TangentPose {
    pose: LeastSquaresPose,
    log_root: f64,
}

impl TangentPose {
    fn new(pose: LeastSquaresPose) -> Option<Self> {
        let factor = pose.information.cholesky()?;
        let log_root = factor.l_dirty().diagonal().map(f64::ln).sum();
        Some(Self { pose, log_root })
    }

    /// With respect to the normalized Haar and Lebesgue measures.
    fn log_density(&self, r: &Rotation3<f64>, t: &Vector3<f64>) -> f64 {
        let turn = log(&(self.pose.rotation.inverse() * r));
        let shift = t - self.pose.position;
        let error = Vector6::new(turn.x, turn.y, turn.z, shift.x, shift.y, shift.z);
        let information: &Matrix6<f64> = &self.pose.information;
        // The Haar measure is (1 - cos a)/(4 pi^2 a^2) times that of the rotation vector.
        let angle = turn.norm();
        let ratio = if angle < 1e-4 { 2.0 } else { angle * angle / (1.0 - angle.cos()) };
        self.log_root - 0.5 * error.dot(&(information * error)) - 3.0 * (2.0 * PI).ln()
            + (4.0 * PI * PI * ratio).ln()
    }
}

fn progressive(pairs: &[PointPair]) -> Result<PosePosterior, AlignmentError> {
    align_progressively(pairs, &ProgressiveConfig::default())
}

fn uniform(rng: &mut ChaCha8Rng, low: f64, high: f64) -> Vector3<f64> {
    Vector3::from_fn(|_, _| rng.random_range(low..high))
}

fn normal(rng: &mut ChaCha8Rng) -> Vector3<f64> {
    Vector3::from_fn(|_, _| StandardNormal.sample(rng))
}

/// The paper's MFG stands beside both `mfg` and `mfg-paper`.
const fn printed(case: &'static str, quantity: &'static str, mfg: f64, lm: f64) -> [PaperValue; 3] {
    [
        PaperValue { case, filter: "mfg", quantity, mean: mfg },
        PaperValue { case, filter: "mfg-paper", quantity, mean: mfg },
        PaperValue { case, filter: "lm", quantity, mean: lm },
    ]
}

const TABLE_5_9: &[[PaperValue; 3]] = &[
    printed("N=20", "attitude_deg", 30.6, 28.7),
    printed("N=20", "position_m", 0.38, 0.37),
    printed("N=18", "attitude_deg", 29.47, 28.4),
    printed("N=18", "position_m", 0.38, 0.38),
    printed("N=16", "attitude_deg", 32.9, 31.8),
    printed("N=16", "position_m", 0.43, 0.43),
    printed("N=14", "attitude_deg", 35.1, 34.1),
    printed("N=14", "position_m", 0.46, 0.46),
    printed("N=12", "attitude_deg", 43.7, 42.1),
    printed("N=12", "position_m", 0.52, 0.53),
    printed("N=10", "attitude_deg", 47.8, 45.6),
    printed("N=10", "position_m", 0.53, 0.54),
    printed("N=8", "attitude_deg", 49.5, 48.5),
    printed("N=8", "position_m", 0.58, 0.61),
    printed("N=6", "attitude_deg", 57.1, 56.7),
    printed("N=6", "position_m", 0.67, 0.72),
    printed("N=4", "attitude_deg", 77.8, 77.7),
    printed("N=4", "position_m", 0.92, 1.04),
];

const TABLE_5_10: &[[PaperValue; 3]] = &[
    printed("a=1", "attitude_deg", 3.93, 3.93),
    printed("a=1", "position_m", 0.28, 0.28),
    printed("a=0.1", "attitude_deg", 24.0, 24.0),
    printed("a=0.1", "position_m", 0.36, 0.39),
    printed("a=0.01", "attitude_deg", 82.4, 80.7),
    printed("a=0.01", "position_m", 0.14, 0.39),
    printed("a=0", "attitude_deg", 90.1, 90.1),
    printed("a=0", "position_m", 0.11, 0.38),
];

const TABLE_5_14: &[[PaperValue; 3]] = &[
    printed("N1=10", "attitude_deg", 9.98, 9.96),
    printed("N1=10", "position_m", 0.173, 0.174),
    printed("N1=10", "map_n1_m", 0.1237, 0.1241),
    printed("N1=8", "attitude_deg", 10.7, 10.7),
    printed("N1=8", "position_m", 0.198, 0.197),
    printed("N1=8", "map_n1_m", 0.126, 0.127),
    printed("N1=8", "map_rest_m", 0.187, 0.191),
    printed("N1=6", "attitude_deg", 13.4, 13.0),
    printed("N1=6", "position_m", 0.237, 0.23),
    printed("N1=6", "map_n1_m", 0.13, 0.131),
    printed("N1=6", "map_rest_m", 0.205, 0.209),
    printed("N1=4", "attitude_deg", 16.5, 16.0),
    printed("N1=4", "position_m", 0.305, 0.294),
    printed("N1=4", "map_n1_m", 0.138, 0.138),
    printed("N1=4", "map_rest_m", 0.225, 0.23),
    printed("N1=2", "attitude_deg", 50.6, 48.6),
    printed("N1=2", "position_m", 0.755, 0.772),
    printed("N1=2", "map_n1_m", 0.149, 0.153),
    printed("N1=2", "map_rest_m", 0.501, 0.518),
    printed("N1=0", "attitude_deg", 77.1, 76.4),
    printed("N1=0", "position_m", 1.05, 1.17),
    printed("N1=0", "map_rest_m", 0.661, 0.708),
];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::Panel;
    use rand::SeedableRng;
    use std::sync::atomic::AtomicBool;

    fn report(study: fn(&Request) -> Result<Report, StudyError>, runs: usize) -> Report {
        let stop = AtomicBool::new(false);
        study(&Request { runs, seed: 2, stop: &stop, finished_run: &|| () }).unwrap()
    }

    fn mean(report: &Report, case: &str, filter: &str, quantity: &str) -> f64 {
        report.row(case, filter, quantity).unwrap().mean
    }

    #[test]
    fn the_posterior_mean_beats_the_optimum_where_the_pose_is_uncertain() {
        let report = report(table_5_9, 100);
        for case in ["N=20", "N=8", "N=4"] {
            let [mfg, lm] = ["mfg", "lm"].map(|filter| mean(&report, case, filter, "attitude_deg"));
            assert!((mfg - lm).abs() < 1e-4, "{case}: {mfg} {lm}");
            let [mfg, lm] = ["mfg", "lm"].map(|filter| mean(&report, case, filter, "position_m"));
            assert!(mfg < lm, "{case}: {mfg} {lm}");
        }
    }

    /// Its ratio to least squares is the paper's, within what one draw of map points differs from
    /// another. Other sigma points, or the printed (5.40), miss several of them.
    #[test]
    fn the_progressive_update_comes_out_as_in_the_paper() {
        let (few_points, line, two_levels) =
            (report(table_5_9, 150), report(table_5_10, 150), report(table_5_14, 150));
        for (report, case, quantity, paper, tolerance) in [
            (&few_points, "N=4", "position_m", 0.92 / 1.04, 0.05),
            (&few_points, "N=12", "position_m", 0.52 / 0.53, 0.05),
            (&line, "a=0.1", "position_m", 0.36 / 0.39, 0.05),
            (&line, "a=0.01", "position_m", 0.14 / 0.39, 0.07),
            (&two_levels, "N1=6", "attitude_deg", 13.4 / 13.0, 0.05),
            (&two_levels, "N1=6", "position_m", 0.237 / 0.230, 0.05),
            (&two_levels, "N1=0", "position_m", 1.05 / 1.17, 0.05),
        ] {
            let [ours, lm] = ["mfg-paper", "lm"].map(|filter| mean(report, case, filter, quantity));
            let ratio = ours / lm;
            assert!((ratio - paper).abs() < tolerance, "{case} {quantity}: {ratio} {paper}");
        }
    }

    #[test]
    fn points_on_a_line_leave_a_broad_posterior_and_a_good_position() {
        let report = report(table_5_10, 30);
        let [mfg, lm] = ["mfg", "lm"].map(|filter| mean(&report, "a=0", filter, "position_m"));
        assert!(mfg < 0.6 * lm, "{mfg} {lm}");
        let nees = mean(&report, "a=0", "mfg", "nees_position");
        // Below 3: the rotation about the line counts as unknown, and the error does not use it up.
        assert!((0.3..6.0).contains(&nees), "{nees}");
        let [mfg, lm] = ["mfg", "lm"].map(|filter| mean(&report, "N=3", filter, "kl_nats"));
        assert!(0.0 < mfg && mfg < lm, "{mfg} {lm}");
        let [Panel::Curves(panel)] = &report.figures[0].panels[..] else { panic!("one panel") };
        assert_eq!(panel.curves.len(), 3);
    }

    #[test]
    fn the_density_of_least_squares_integrates_to_one() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let problem = Problem::scattered(20, &mut rng);
        let mut pose = problem.minimum().unwrap();
        // Concentrated, so that the Gaussian ends before half a turn.
        pose.information *= 40.0;
        let gaussian = TangentPose::new(pose).unwrap();
        let box_sd = gaussian.pose.covariance().unwrap().diagonal().map(|v| 5.0 * v.sqrt());
        let n = 40_000;
        let mut sum = 0.0;
        for _ in 0..n {
            let e = Vector6::from_fn(|i, _| rng.random_range(-box_sd[i]..box_sd[i]));
            let turn: Vector3<f64> = e.fixed_rows::<3>(0).into_owned();
            let angle = turn.norm();
            let haar = (1.0 - angle.cos()) / (4.0 * PI * PI * angle * angle);
            let (r, t) =
                (pose.rotation * Rotation3::new(turn), pose.position + e.fixed_rows::<3>(3));
            sum += gaussian.log_density(&r, &t).exp() * haar / f64::from(n);
        }
        let volume: f64 = box_sd.iter().map(|sd| 2.0 * sd).product();
        assert!((sum * volume - 1.0).abs() < 0.25, "{}", sum * volume);
    }
}
