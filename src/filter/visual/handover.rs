//! From a broad attitude to map points in the state.

use nalgebra::UnitQuaternion;

use super::{
    BodyPoints, Calibration, Coordinates, FilterConfig, MfgFilter, PointState, Rest, SlamFilter,
    UpdateOutcome, VisualInertialFilter,
};
use crate::alignment::PointPair;
use crate::distribution::matrix_fisher::MatrixFisher;
use crate::inertial::{Belief, NavCovariance, Propagator};
use crate::sensor::ImuSample;
use crate::so3::ProperSvd;

/// `mfgs` where the attitude at the start is too uncertain for a covariance.
///
/// Until points of a known map have made it certain the belief is that of [`MfgFilter`], which
/// holds no points; from the next sample on it is that of a [`SlamFilter`]. The errors of the
/// points that made it certain are taken to be independent of it: what those few frames say of
/// the map is lost.
pub(super) struct HandOver {
    config: FilterConfig,
    propagator: Propagator,
    stage: Stage,
}

enum Stage {
    Broad(Box<MfgFilter>),
    Concentrated(Box<SlamFilter>),
}

impl HandOver {
    /// From an attitude that is independent of the rest of `belief`.
    pub fn new(
        config: &FilterConfig,
        propagator: Propagator,
        belief: Belief,
        attitude: &MatrixFisher,
    ) -> Self {
        let broad = MfgFilter::broad(config, propagator.clone(), belief, attitude);
        Self { config: config.clone(), propagator, stage: Stage::Broad(Box::new(broad)) }
    }

    fn filter(&self) -> &dyn VisualInertialFilter {
        match &self.stage {
            Stage::Broad(filter) => filter.as_ref(),
            Stage::Concentrated(filter) => filter.as_ref(),
        }
    }

    fn filter_mut(&mut self) -> &mut dyn VisualInertialFilter {
        match &mut self.stage {
            Stage::Broad(filter) => filter.as_mut(),
            Stage::Concentrated(filter) => filter.as_mut(),
        }
    }

    /// Hands the belief over if it has become certain.
    fn concentrate(&mut self) {
        let belief = match &self.stage {
            Stage::Broad(filter) if !filter.is_broad() => *filter.belief(),
            _ => return,
        };
        let propagator = self.propagator.clone();
        let slam = SlamFilter::new(&self.config, Coordinates::Group, propagator, belief);
        self.stage = Stage::Concentrated(Box::new(slam));
    }
}

impl VisualInertialFilter for HandOver {
    fn belief(&self) -> &Belief {
        self.filter().belief()
    }

    fn propagate(&mut self, from: &ImuSample, to: &ImuSample) -> bool {
        self.concentrate();
        self.filter_mut().propagate(from, to)
    }

    fn set_imu_gap(&mut self, in_gap: bool) {
        self.propagator.set_imu_gap(in_gap);
        self.filter_mut().set_imu_gap(in_gap);
    }

    fn coast(&mut self, seconds: f64) {
        self.concentrate();
        self.filter_mut().coast(seconds);
    }

    fn update(&mut self, pairs: &[PointPair]) -> Option<UpdateOutcome> {
        self.filter_mut().update(pairs)
    }

    fn rest(&mut self, rest: &Rest) -> bool {
        self.filter_mut().rest(rest)
    }

    fn doubt_levelling(&mut self, accel_bias_sd: f64) -> bool {
        self.filter_mut().doubt_levelling(accel_bias_sd)
    }

    fn passed(&self) -> &[bool] {
        self.filter().passed()
    }

    fn matrix_fisher(&self) -> Option<ProperSvd> {
        self.filter().matrix_fisher()
    }

    fn body_points(&self) -> BodyPoints {
        self.filter().body_points()
    }

    fn reported_covariance(&self) -> NavCovariance {
        self.filter().reported_covariance()
    }

    fn take_world_turn(&mut self) -> Option<UnitQuaternion<f64>> {
        self.filter_mut().take_world_turn()
    }

    fn point_state(&mut self) -> Option<&mut dyn PointState> {
        self.filter_mut().point_state()
    }

    fn calibrate(&mut self, prior: &Calibration) -> bool {
        self.filter_mut().calibrate(prior)
    }

    fn calibration(&self) -> Option<&Calibration> {
        self.filter().calibration()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::alignment::MapEstimate;
    use crate::filter::FilterKind;
    use crate::inertial::{ImuConfig, NavState};
    use crate::sensor::Stamp;
    use nalgebra::{Isometry3, Matrix3, Point3, Vector3};

    #[test]
    fn a_known_map_makes_a_broad_attitude_certain_and_is_then_held() {
        let truth = Isometry3::new(Vector3::new(0.3, -0.2, 1.0), Vector3::new(2.0, 1.0, -1.5));
        let zero = Vector3::zeros();
        let state = NavState {
            world_from_body: Isometry3::translation(0.3, -0.2, 1.0),
            velocity: zero,
            gyro_bias: zero,
            accel_bias: zero,
        };
        let belief = Belief { state, covariance: NavCovariance::identity() * 1e-2 };
        let attitude = MatrixFisher::new(&(Matrix3::identity() * 0.01)).unwrap();
        let config = FilterConfig::default();
        let propagator = Propagator::inertial(&ImuConfig::default());
        let mut filter = FilterKind::Mfgs.start_broad(&config, propagator, belief, &attitude);
        assert!(filter.point_state().is_none());
        let pairs: Vec<_> = (0..12)
            .map(|k| {
                let angle = f64::from(k);
                let in_body = Vector3::new(angle.sin(), (2.1 * angle).cos(), 0.3 * angle - 1.5);
                PointPair {
                    in_body,
                    body_covariance: Matrix3::identity() * 1e-4,
                    in_world: (truth * Point3::from(in_body)).coords,
                    world_covariance: Matrix3::identity() * 1e-4,
                }
            })
            .collect();
        assert!(filter.update(&pairs).is_some());
        assert_eq!(filter.passed().len(), pairs.len());
        let sample = |nanos| ImuSample {
            stamp: Stamp::from_nanos(nanos),
            angular_velocity: zero,
            specific_force: truth.rotation.inverse() * Vector3::new(0.0, 0.0, 9.81),
        };
        assert!(filter.propagate(&sample(0), &sample(5_000_000)));
        assert!(filter.belief().state.world_from_body.rotation.angle_to(&truth.rotation) < 0.02);
        let known =
            MapEstimate { position: pairs[0].in_world, covariance: pairs[0].world_covariance };
        assert!(filter.point_state().is_some_and(|points| points.admit_known(0, &known)));
    }
}
