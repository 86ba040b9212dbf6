//! An attitude filter with the measurement model that real sensors need.

use nalgebra::{Matrix3, Vector3};

use super::super::core::{
    BayesFilter, Estimate, FilterError, InertialStep, VectorEstimate, VectorMeasurement,
};
use super::{AttitudeFilterKind, AttitudePrior, GyroModel};
use crate::inertial::{BodyDirection, DirectionConfig, DirectionFinder, Directions};
use crate::sensor::{ImuSample, Stamp};

/// Settings of [`AdaptiveAttitude`].
#[derive(Debug, Clone, PartialEq)]
pub struct AdaptiveConfig {
    /// Noise of the gyroscope, rad/sqrt(s): white noise, and what scale and misalignment add
    /// in motion. (A consumer gyroscope at rest shows a tenth of it.)
    pub gyro_noise: f64,
    pub directions: DirectionConfig,
}

impl Default for AdaptiveConfig {
    fn default() -> Self {
        Self { gyro_noise: 2.5e-3, directions: DirectionConfig::default() }
    }
}

/// What became of a sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum AttitudeStep {
    /// It was no sample to use: numbers that are not finite, or a stamp that is not later than
    /// the one before.
    Refused,
    /// It is the first one, or the first one after a gap: it only starts the clock.
    Started,
    /// The belief, if there is one, was propagated.
    Propagated,
    /// The belief was then conditioned on directions, or began with them.
    Updated(Directions),
}

/// Any attitude filter of this crate behind the directions of a [`DirectionFinder`], which every
/// filter is given alike.
///
/// Nothing need be known at the start: the posterior of the uniform distribution given the first
/// directions is the matrix Fisher distribution with the parameter `sum k_i world_i body_i^T`,
/// and so the prior of the filter. Filters with a bias are given what the gyroscope shows at rest
/// as a measurement; for the others it is taken off the rate.
pub struct AdaptiveAttitude {
    kind: AttitudeFilterKind,
    config: AdaptiveConfig,
    finder: DirectionFinder,
    filter: Option<Box<dyn BayesFilter>>,
    last: Option<Stamp>,
}

impl AdaptiveAttitude {
    /// The estimator before the first sample.
    pub fn new(kind: AttitudeFilterKind, config: &AdaptiveConfig) -> Self {
        let finder = DirectionFinder::new(&config.directions);
        Self { kind, config: config.clone(), finder, filter: None, last: None }
    }

    /// Takes the next sample, whose readings hold for the time since the one before, and the
    /// magnetic field in any unit where there is one.
    ///
    /// # Errors
    /// If the filter could not take the step; the belief is then what it was before.
    pub fn step(
        &mut self,
        sample: &ImuSample,
        field: Option<&Vector3<f64>>,
    ) -> Result<AttitudeStep, FilterError> {
        if !sample.is_finite() {
            return Ok(AttitudeStep::Refused);
        }
        let field = field.filter(|field| field.iter().all(|x| x.is_finite()));
        let Some(last) = self.last else {
            self.last = Some(sample.stamp);
            return Ok(AttitudeStep::Started);
        };
        let seconds = sample.stamp.seconds_since(last);
        if seconds <= 0.0 {
            return Ok(AttitudeStep::Refused);
        }
        self.last = Some(sample.stamp);
        if seconds > self.config.directions.max_gap {
            self.finder.forget_attitude();
            self.filter = None;
            return Ok(AttitudeStep::Started);
        }
        if let Some(filter) = &mut self.filter {
            let rate = match self.kind.has_bias() {
                true => sample.angular_velocity,
                false => sample.angular_velocity - self.finder.gyro_bias().0,
            };
            filter.propagate(&InertialStep::turning(rate, seconds))?;
        }
        let Some(directions) = self.finder.push(sample, field, seconds) else {
            return Ok(AttitudeStep::Propagated);
        };
        self.take_in(&directions)?;
        Ok(AttitudeStep::Updated(directions))
    }

    /// The belief; `None` before the first directions. The gyro bias is that of the filter or, if
    /// it has none, the one seen at rest.
    pub fn estimate(&self) -> Option<Estimate> {
        let mut estimate = self.filter.as_ref()?.estimate();
        estimate.gyro_bias.get_or_insert_with(|| isotropic(self.finder.gyro_bias()));
        Some(estimate)
    }

    fn take_in(&mut self, directions: &Directions) -> Result<(), FilterError> {
        let Some(up) = &directions.up else { return Ok(()) };
        let up = measurement(Vector3::z(), up);
        match &directions.north {
            Some(north) => self.condition(&[up, measurement(Vector3::y(), north)])?,
            None => self.condition(&[up])?,
        }
        match (&mut self.filter, directions.resting_rate) {
            (Some(filter), Some(bias)) if self.kind.has_bias() => {
                filter.update_gyro_bias(&isotropic(bias))
            }
            _ => Ok(()),
        }
    }

    /// Conditions the filter's belief, or makes a filter with what the uniform distribution
    /// becomes.
    fn condition(&mut self, measured: &[VectorMeasurement]) -> Result<(), FilterError> {
        if let Some(filter) = &mut self.filter {
            return filter.update_directions(measured);
        }
        let parameter = VectorMeasurement::joint_parameter(measured)?;
        let bias = isotropic(self.finder.gyro_bias());
        let prior = AttitudePrior {
            gyro_bias: bias.mean,
            gyro_bias_covariance: bias.covariance,
            ..AttitudePrior::matrix_fisher(&parameter)?
        };
        let walk = self.config.directions.rest.bias_walk;
        let gyro = GyroModel::isotropic(self.config.gyro_noise, walk);
        self.filter = Some(self.kind.start(&gyro, &prior)?);
        Ok(())
    }
}

fn measurement(in_world: Vector3<f64>, found: &BodyDirection) -> VectorMeasurement {
    VectorMeasurement::of_world_direction(in_world, found.in_body, found.concentration)
}

fn isotropic((mean, variance): (Vector3<f64>, f64)) -> VectorEstimate {
    VectorEstimate { mean, covariance: Matrix3::from_diagonal_element(variance) }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Rotation3;

    use super::*;
    use crate::so3::{exp, log};

    const WITH_BIAS: [AttitudeFilterKind; 7] = [
        AttitudeFilterKind::Mekf,
        AttitudeFilterKind::MekfI,
        AttitudeFilterKind::Ukf,
        AttitudeFilterKind::Mfgia,
        AttitudeFilterKind::Mfgiu,
        AttitudeFilterKind::Mfgba,
        AttitudeFilterKind::Mfgbu,
    ];

    /// A concentrated belief, and after two seconds of turning with an unknown bias.
    fn filters(kind: AttitudeFilterKind) -> (Box<dyn BayesFilter>, Box<dyn BayesFilter>) {
        let f = exp(&Vector3::new(0.4, -1.0, 0.7)).matrix()
            * Matrix3::from_diagonal(&Vector3::new(9e3, 7e3, 4e3));
        let prior = AttitudePrior {
            gyro_bias_covariance: Matrix3::from_diagonal_element(1e-4),
            ..AttitudePrior::matrix_fisher(&f).unwrap()
        };
        let gyro = GyroModel::isotropic(1e-3, 1e-5);
        let mut turned = kind.start(&gyro, &prior).unwrap();
        for _ in 0..200 {
            let step = InertialStep::turning(Vector3::new(0.3, -0.2, 0.5), 0.01);
            turned.propagate(&step).unwrap();
        }
        (kind.start(&gyro, &prior).unwrap(), turned)
    }

    #[test]
    fn a_measured_bias_is_weighed_against_the_belief() {
        let measured = isotropic((Vector3::new(0.01, -0.004, 0.008), 1e-4));
        for kind in WITH_BIAS {
            let (mut filter, _) = filters(kind);
            let before = filter.attitude();
            filter.update_gyro_bias(&measured).unwrap();
            let bias = filter.estimate().gyro_bias.unwrap();
            assert_relative_eq!(bias.mean, measured.mean * 0.5, epsilon = 1e-9);
            let expected = measured.covariance * 0.5;
            assert_relative_eq!(bias.covariance, expected, epsilon = 1e-9);
            assert!(log(&(before.inverse() * filter.attitude())).norm() < 1e-9, "{kind}");
        }
    }

    #[test]
    fn a_measured_bias_turns_the_attitude_that_it_had_turned() {
        let measured = isotropic((Vector3::new(0.01, -0.004, 0.008), 1e-6));
        let turn_by = |kind: AttitudeFilterKind| {
            let (_, mut filter) = filters(kind);
            let before = filter.attitude();
            filter.update_gyro_bias(&measured).unwrap();
            let estimate = filter.estimate();
            (log(&(before.inverse() * filter.attitude())), estimate)
        };
        let (expected, reference) = turn_by(AttitudeFilterKind::Mekf);
        assert!(expected.norm() > 0.02);
        for kind in WITH_BIAS {
            let (turn, estimate) = turn_by(kind);
            assert_relative_eq!(turn, expected, epsilon = 0.02 * expected.norm());
            let (bias, other) = (estimate.gyro_bias.unwrap(), reference.gyro_bias.unwrap());
            assert_relative_eq!(bias.mean, other.mean, epsilon = 1e-4);
            let scale = reference.rotation_covariance.norm();
            assert_relative_eq!(
                estimate.rotation_covariance,
                reference.rotation_covariance,
                epsilon = 0.05 * scale
            );
        }
    }

    fn sample(seconds: f64) -> ImuSample {
        ImuSample {
            stamp: Stamp::from_seconds(seconds).unwrap(),
            angular_velocity: Vector3::zeros(),
            specific_force: Vector3::new(0.0, 0.0, 9.81),
        }
    }

    #[test]
    fn bad_samples_are_refused_and_gaps_begin_anew() {
        let kind = AttitudeFilterKind::Mfgba;
        let mut estimator = AdaptiveAttitude::new(kind, &AdaptiveConfig::default());
        let field = Vector3::new(0.0, 1.0, -2.0);
        let mut step = |sample: ImuSample| estimator.step(&sample, Some(&field)).unwrap();
        assert_eq!(step(sample(0.0)), AttitudeStep::Started);
        assert_eq!(step(sample(0.0)), AttitudeStep::Refused);
        let nan = ImuSample { angular_velocity: Vector3::repeat(f64::NAN), ..sample(0.05) };
        assert_eq!(step(nan), AttitudeStep::Refused);
        assert_eq!(step(sample(0.05)), AttitudeStep::Propagated);
        assert!(matches!(step(sample(0.1)), AttitudeStep::Updated(_)));
        assert_eq!(step(sample(5.0)), AttitudeStep::Started);
        assert_eq!(estimator.estimate(), None);
        for k in 1..=3 {
            estimator.step(&sample(5.0 + 0.05 * f64::from(k)), Some(&field)).unwrap();
        }
        let estimate = estimator.estimate().unwrap();
        assert!(estimate.world_from_body.angle_to(&Rotation3::identity()) < 1e-6);
        assert!(estimate.matrix_fisher_s.unwrap()[2] > 0.0);
    }
}
