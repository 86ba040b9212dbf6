//! Random sample consensus for the pose of the camera from pairs of 3D points.
//!
//! Three traits, free of each other: a [`Sampler`] picks data, an [`Estimator`] makes a model
//! of them, a [`Consensus`] says how well each datum agrees with it. [`estimate_pose`] joins
//! the ones that a visual-inertial filter needs.

use nalgebra::{Isometry3, Matrix3, Point3, Translation3, UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::PointMeasurement;
use crate::alignment::{WeightedPair, weighted_kabsch};
use crate::sensor::Camera;

/// Makes a model from some of the data.
pub trait Estimator {
    type Datum;
    type Model;
    /// Data that determine a model.
    const SAMPLE_SIZE: usize;

    /// The best model for the chosen data; `None` where they do not determine one.
    fn estimate(&self, data: &[Self::Datum], chosen: &[usize]) -> Option<Self::Model>;
}

/// Picks the data of a hypothesis.
pub trait Sampler {
    /// Fills `sample` with different indices below `population`, which is at least its length.
    fn draw(&mut self, population: usize, sample: &mut [usize]);
}

/// Judges how a datum agrees with a model.
pub trait Consensus<Datum, Model> {
    /// Squared error in units of the squared threshold: 0 is perfect agreement, above 1 is an
    /// outlier.
    fn error(&self, model: &Model, datum: &Datum) -> f64;
}

/// Uniform samples from a seeded generator.
#[derive(Debug, Clone)]
pub struct UniformSampler(ChaCha8Rng);

impl UniformSampler {
    pub fn new(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }
}

impl Sampler for UniformSampler {
    fn draw(&mut self, population: usize, sample: &mut [usize]) {
        for i in 0..sample.len() {
            sample[i] = loop {
                let index = self.0.random_range(0..population);
                if !sample[..i].contains(&index) {
                    break index;
                }
            };
        }
    }
}

/// A measured point and the map point that it is taken to be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Correspondence {
    pub measurement: PointMeasurement,
    /// World coordinates, m.
    pub world: Vector3<f64>,
    /// Covariance of `world` in world coordinates, m^2.
    pub world_covariance: Matrix3<f64>,
}

/// `world_from_camera` from three or more correspondences, weighted by their variance.
#[derive(Debug, Clone, Copy, Default)]
pub struct FullPose;

impl Estimator for FullPose {
    type Datum = Correspondence;
    type Model = Isometry3<f64>;
    const SAMPLE_SIZE: usize = 3;

    fn estimate(&self, data: &[Correspondence], chosen: &[usize]) -> Option<Isometry3<f64>> {
        weighted_kabsch(chosen.iter().filter_map(|&i| data.get(i)).map(|c| WeightedPair {
            from: c.measurement.point,
            to: c.world,
            weight: c.weight(),
        }))
    }
}

/// `world_from_camera` where its rotation is known: one correspondence is enough.
#[derive(Debug, Clone, Copy)]
pub struct KnownRotation(pub UnitQuaternion<f64>);

impl Estimator for KnownRotation {
    type Datum = Correspondence;
    type Model = Isometry3<f64>;
    const SAMPLE_SIZE: usize = 1;

    fn estimate(&self, data: &[Correspondence], chosen: &[usize]) -> Option<Isometry3<f64>> {
        let (mut sum, mut total) = (Vector3::zeros(), 0.0);
        for c in chosen.iter().filter_map(|&i| data.get(i)) {
            sum += (c.world - self.0 * c.measurement.point) * c.weight();
            total += c.weight();
        }
        let translation = sum / total;
        let finite = translation.iter().all(|x| x.is_finite());
        finite.then(|| Isometry3::from_parts(Translation3::from(translation), self.0))
    }
}

impl Correspondence {
    /// Inverse of the mean variance of the difference, whatever the rotation.
    fn weight(&self) -> f64 {
        3.0 / (self.measurement.covariance.trace() + self.world_covariance.trace())
    }
}

/// Agreement in the image and in depth, each against its own threshold: the
/// errors of a depth camera differ too much between the two for one distance in metres.
#[derive(Debug, Clone, Copy)]
pub struct Reprojection {
    pub camera: Camera,
    /// Standard deviations of the measured pixel.
    pub max_pixel_sigmas: f64,
    /// Standard deviations of measured and predicted depth together.
    pub max_depth_sigmas: f64,
}

impl Reprojection {
    pub fn new(camera: &Camera, config: &RansacConfig) -> Self {
        Self {
            camera: *camera,
            max_pixel_sigmas: config.max_pixel_sigmas,
            max_depth_sigmas: config.max_depth_sigmas,
        }
    }
}

impl Consensus<Correspondence, Isometry3<f64>> for Reprojection {
    fn error(&self, world_from_camera: &Isometry3<f64>, datum: &Correspondence) -> f64 {
        let measured = &datum.measurement.point;
        let expected = world_from_camera.inverse_transform_point(&Point3::from(datum.world)).coords;
        let (Some(a), Some(b)) = (self.camera.project(measured), self.camera.project(&expected))
        else {
            return f64::INFINITY;
        };
        let covariance = &datum.measurement.covariance;
        let in_camera = self.camera.depth_direction(measured);
        let in_world = world_from_camera.rotation * in_camera;
        let depth_variance = in_camera.dot(&(covariance * in_camera))
            + in_world.dot(&(datum.world_covariance * in_world));
        let pixel_variance = self.camera.pixel_covariance(measured, covariance).trace() / 2.0;
        // `max` below would let a NaN pass.
        if !(depth_variance > 0.0 && pixel_variance > 0.0) {
            return f64::INFINITY;
        }
        let pixel = (a - b).norm_squared() / (pixel_variance * self.max_pixel_sigmas.powi(2));
        let nearer = self.camera.depth_of(&expected) - self.camera.depth_of(measured);
        let depth = nearer.powi(2) / (depth_variance * self.max_depth_sigmas.powi(2));
        pixel.max(depth)
    }
}

/// How outliers are told from inliers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RansacConfig {
    /// Inliers reproject within this many standard deviations of the measured pixel (which
    /// grow with the octave).
    pub max_pixel_sigmas: f64,
    /// Inliers agree in depth within this many standard deviations (of measurement and map
    /// point together).
    pub max_depth_sigmas: f64,
    /// Probability of having drawn one sample free of outliers at which the search ends.
    pub confidence: f64,
    /// Most samples drawn.
    pub max_iterations: u32,
    /// A pose with fewer inliers is no pose.
    pub min_inliers: usize,
    /// If the known rotation (from the IMU) explains at least this fraction of the
    /// correspondences, poses of other rotations are not searched for; above 1 they always are.
    pub trust_rotation_fraction: f64,
}

impl Default for RansacConfig {
    fn default() -> Self {
        Self {
            max_pixel_sigmas: 5.0,
            max_depth_sigmas: 4.0,
            confidence: 0.999,
            max_iterations: 500,
            min_inliers: 8,
            trust_rotation_fraction: 0.5,
        }
    }
}

/// A model and the data that agree with it.
#[derive(Debug, Clone, PartialEq)]
pub struct Agreement<Model> {
    pub model: Model,
    /// Indices of the data that agree, ascending.
    pub inliers: Vec<usize>,
    /// Samples drawn.
    pub iterations: u32,
}

/// Searches for the model with the highest truncated-quadratic score (MSAC; Torr and Zisserman,
/// 2000), each better one being re-estimated from its inliers; `None` if no sample determines a
/// model that has `min_inliers`.
///
/// Ends once `confidence` is reached, after `max_iterations` at the latest.
pub fn ransac<E, S, C>(
    data: &[E::Datum],
    estimator: &E,
    sampler: &mut S,
    consensus: &C,
    config: &RansacConfig,
) -> Option<Agreement<E::Model>>
where
    E: Estimator,
    S: Sampler,
    C: Consensus<E::Datum, E::Model>,
{
    if data.len() < E::SAMPLE_SIZE.max(config.min_inliers) {
        return None;
    }
    let mut sample = vec![0; E::SAMPLE_SIZE];
    let mut best: Option<Scored<E::Model>> = None;
    let (mut iterations, mut needed) = (0, config.max_iterations);
    while iterations < needed {
        iterations += 1;
        sampler.draw(data.len(), &mut sample);
        let Some(model) = estimator.estimate(data, &sample) else { continue };
        let scored = Scored::new(model, data, consensus);
        if best.as_ref().is_some_and(|b| scored.score <= b.score) {
            continue;
        }
        let scored = scored.refined(data, estimator, consensus);
        needed = config.max_iterations.min(samples_needed::<E>(&scored.inliers, data, config));
        best = Some(scored);
    }
    let best = best?;
    (best.inliers.len() >= config.min_inliers).then_some(Agreement {
        model: best.model,
        inliers: best.inliers,
        iterations,
    })
}

/// Samples until one free of outliers has been drawn with the wanted confidence.
fn samples_needed<E: Estimator>(
    inliers: &[usize],
    data: &[E::Datum],
    config: &RansacConfig,
) -> u32 {
    let fraction = inliers.len() as f64 / data.len() as f64;
    let all_inliers = fraction.powi(E::SAMPLE_SIZE as i32);
    let samples = (1.0 - config.confidence).ln() / (-all_inliers).ln_1p();
    // NaN (confidence 1, all inliers) and negative values become 0 in the cast.
    samples.ceil() as u32
}

struct Scored<Model> {
    model: Model,
    inliers: Vec<usize>,
    score: f64,
}

impl<Model> Scored<Model> {
    /// Re-estimations from the inliers; the set settles within two or three.
    const REFINEMENTS: usize = 3;

    fn new<Datum>(model: Model, data: &[Datum], consensus: &impl Consensus<Datum, Model>) -> Self {
        let (mut inliers, mut score) = (vec![], 0.0);
        for (index, datum) in data.iter().enumerate() {
            let error = consensus.error(&model, datum);
            if error <= 1.0 {
                inliers.push(index);
                score += 1.0 - error;
            }
        }
        Self { model, inliers, score }
    }

    fn refined<E, C>(mut self, data: &[E::Datum], estimator: &E, consensus: &C) -> Self
    where
        E: Estimator<Model = Model>,
        C: Consensus<E::Datum, Model>,
    {
        for _ in 0..Self::REFINEMENTS {
            let Some(model) = estimator.estimate(data, &self.inliers) else { break };
            let refined = Self::new(model, data, consensus);
            if refined.score <= self.score {
                break;
            }
            self = refined;
        }
        self
    }
}

/// `world_from_camera` and the correspondences that agree with it.
///
/// With a `rotation_prior` (the IMU's), one-point hypotheses are tried first: they survive far
/// more outliers. Their rotation is then refined with the translation. Where too few agree, and
/// without a prior, three-point hypotheses follow, and the better of the two results is kept.
/// The same `seed` gives the same result.
pub fn estimate_pose(
    correspondences: &[Correspondence],
    camera: &Camera,
    rotation_prior: Option<&UnitQuaternion<f64>>,
    config: &RansacConfig,
    seed: u64,
) -> Option<Agreement<Isometry3<f64>>> {
    let consensus = Reprojection::new(camera, config);
    let mut sampler = UniformSampler::new(seed);
    let with_prior = rotation_prior.and_then(|rotation| {
        let estimator = KnownRotation(*rotation);
        let found = ransac(correspondences, &estimator, &mut sampler, &consensus, config)?;
        let scored = Scored::new(found.model, correspondences, &consensus).refined(
            correspondences,
            &FullPose,
            &consensus,
        );
        Some(Agreement {
            model: scored.model,
            inliers: scored.inliers,
            iterations: found.iterations,
        })
    });
    let enough = config.trust_rotation_fraction * correspondences.len() as f64;
    match with_prior {
        Some(found) if found.inliers.len() as f64 >= enough => Some(found),
        with_prior => {
            let free = ransac(correspondences, &FullPose, &mut sampler, &consensus, config);
            // Of equally many inliers, the one that agrees with the IMU.
            [free, with_prior].into_iter().flatten().max_by_key(|found| found.inliers.len())
        }
    }
}

/// Indices of the correspondences within `factor` times the tolerance of a pose.
pub fn agreeing(
    correspondences: &[Correspondence],
    camera: &Camera,
    world_from_camera: &Isometry3<f64>,
    factor: f64,
    config: &RansacConfig,
) -> Vec<usize> {
    let consensus = Reprojection {
        camera: *camera,
        max_pixel_sigmas: factor * config.max_pixel_sigmas,
        max_depth_sigmas: factor * config.max_depth_sigmas,
    };
    Scored::new(*world_from_camera, correspondences, &consensus).inliers
}

/// The pose near a predicted one that most correspondences agree on, and they: it is that of those
/// within twice the tolerance of the prediction. `None` if they do not determine one.
pub fn agree_near(
    correspondences: &[Correspondence],
    camera: &Camera,
    world_from_camera: &Isometry3<f64>,
    config: &RansacConfig,
) -> Option<Agreement<Isometry3<f64>>> {
    let near = agreeing(correspondences, camera, world_from_camera, 2.0, config);
    let model = FullPose.estimate(correspondences, &near)?;
    let inliers = agreeing(correspondences, camera, &model, 1.0, config);
    (inliers.len() >= config.min_inliers).then_some(Agreement { model, inliers, iterations: 1 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::PinholeCamera;
    use crate::vision::DepthConfig;
    use nalgebra::Point2;
    use rand_distr::{Distribution, StandardNormal};

    const PINHOLE: PinholeCamera = PinholeCamera { fx: 517.0, fy: 516.0, cx: 318.0, cy: 255.0 };
    const CAMERA: Camera = Camera::pinhole(PINHOLE);

    fn pose() -> Isometry3<f64> {
        Isometry3::new(Vector3::new(1.0, -0.3, 0.7), Vector3::new(0.2, -1.1, 0.4))
    }

    /// Noisy measurements of random points; of every ten, the first `outliers` are wrong.
    fn scene(count: usize, outliers: usize, seed: u64) -> Vec<Correspondence> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let depths = DepthConfig::default();
        let mut correspondence = |index: usize| {
            let pixel = Point2::new(rng.random_range(0.0..640.0), rng.random_range(0.0..480.0));
            let depth: f64 = rng.random_range(0.6..4.5);
            let truth = PINHOLE.unproject(pixel, depth);
            let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
            let noisy = Point2::new(pixel.x + 0.7 * normal(), pixel.y + 0.7 * normal());
            let standard_deviation = depths.standard_deviation(depth);
            let reading = crate::vision::DepthReading {
                depth: depth + standard_deviation * normal(),
                slope: nalgebra::Vector2::zeros(),
                standard_deviation,
            };
            let measurement = PointMeasurement::new(&CAMERA, noisy, 0.7, &reading).unwrap();
            let mut world = (pose() * Point3::from(truth)).coords;
            if index % 10 < outliers {
                world += Vector3::new(normal(), normal(), normal()).normalize()
                    * rng.random_range(0.3..3.0);
            }
            Correspondence { measurement, world, world_covariance: Matrix3::zeros() }
        };
        (0..count).map(&mut correspondence).collect()
    }

    fn pose_error(found: &Isometry3<f64>) -> (f64, f64) {
        let d = found.inverse() * pose();
        (d.rotation.angle().to_degrees(), d.translation.vector.norm())
    }

    #[test]
    fn sixty_percent_outliers_are_found_without_a_prior() {
        for seed in 0..20 {
            let data = scene(200, 6, seed);
            let found = estimate_pose(&data, &CAMERA, None, &RansacConfig::default(), seed);
            let found = found.unwrap();
            let right = found.inliers.iter().filter(|&i| i % 10 >= 6).count();
            assert!(right >= 76 && found.inliers.len() - right <= 4, "{right} of 80");
            let (angle, distance) = pose_error(&found.model);
            assert!(angle < 0.6 && distance < 0.02, "{angle} deg {distance} m");
        }
    }

    #[test]
    fn ninety_percent_outliers_are_found_with_the_rotation_known_to_a_degree() {
        let config = RansacConfig { max_pixel_sigmas: 11.0, ..RansacConfig::default() };
        for seed in 0..20 {
            let data = scene(300, 9, seed);
            let axis = nalgebra::Unit::new_normalize(Vector3::new(1.0, seed as f64 - 9.5, 0.3));
            let prior =
                pose().rotation * UnitQuaternion::from_axis_angle(&axis, 0.5f64.to_radians());
            let found = estimate_pose(&data, &CAMERA, Some(&prior), &config, seed).unwrap();
            let (angle, distance) = pose_error(&found.model);
            assert!(angle < 1.0 && distance < 0.05, "seed {seed}: {angle} deg {distance} m");
        }
    }

    #[test]
    fn a_wrong_prior_does_not_win() {
        let data = scene(100, 2, 7);
        let prior = pose().rotation * UnitQuaternion::new(Vector3::new(0.0, 0.3, 0.0));
        let found = estimate_pose(&data, &CAMERA, Some(&prior), &RansacConfig::default(), 7);
        assert!(pose_error(&found.unwrap().model).0 < 0.5);
    }

    #[test]
    fn the_seed_decides() {
        let data = scene(100, 5, 3);
        let run = |seed| estimate_pose(&data, &CAMERA, None, &RansacConfig::default(), seed);
        assert_eq!(run(1), run(1));
    }

    #[test]
    fn all_inliers_end_the_search_at_once() {
        let data = scene(100, 0, 3);
        let found = estimate_pose(&data, &CAMERA, None, &RansacConfig::default(), 1).unwrap();
        assert!(found.iterations < 20, "{}", found.iterations);
    }

    #[test]
    fn nonsense_gives_no_pose() {
        let config = RansacConfig::default();
        let none = |data: &[Correspondence]| {
            let prior = UnitQuaternion::identity();
            estimate_pose(data, &CAMERA, Some(&prior), &config, 1).is_none()
                && estimate_pose(data, &CAMERA, None, &config, 1).is_none()
        };
        let good = scene(20, 0, 1);
        assert!(none(&[]) && none(&good[..7]) && none(&scene(60, 10, 5)));
        let broken: Vec<_> =
            good.iter().map(|c| Correspondence { world: c.world * f64::NAN, ..*c }).collect();
        assert!(none(&broken));
    }

    #[test]
    fn samples_are_different_indices() {
        let mut sampler = UniformSampler::new(1);
        for population in 3..10 {
            let mut sample = [0; 3];
            sampler.draw(population, &mut sample);
            assert!(sample.iter().all(|&i| i < population));
            assert!(sample[0] != sample[1] && sample[1] != sample[2] && sample[0] != sample[2]);
        }
    }
}
