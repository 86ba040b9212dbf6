//! From a broad attitude to map points in the state.

use nalgebra::{Rotation3, Vector3};

use super::body_points::BodyPoints;
use super::calibration::Calibration;
use super::config::FilterConfig;
use super::estimator::{PointState, PointUpdate, VisualInertialFilter};
use super::frame_change::FrameChange;
use super::kind::FilterKind;
use super::mfg::MfgFilter;
use super::slam::{AttitudeDensity, ErrorState, PoseWindow, SlamFilter};
use super::zero_velocity::ZeroVelocity;
use crate::alignment::PointPair;
use crate::distribution::matrix_fisher::MatrixFisher;
use crate::filter::core::{BayesFilter, Estimate, FilterError, InertialStep};
use crate::inertial::{Belief, NavCovariance, Propagator};
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
        let broad =
            MfgFilter::broad(FilterKind::Mfgs, config, propagator.clone(), belief, attitude);
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
        let error = ErrorState::RightInvariant { density: AttitudeDensity::MatrixFisher };
        let slam = SlamFilter::new(FilterKind::Mfgs, &self.config, error, propagator, belief);
        self.stage = Stage::Concentrated(Box::new(slam));
    }
}

impl BayesFilter for HandOver {
    fn name(&self) -> &'static str {
        self.filter().name()
    }

    fn propagate(&mut self, step: &InertialStep) -> Result<(), FilterError> {
        self.concentrate();
        self.filter_mut().propagate(step)
    }

    fn attitude(&self) -> Rotation3<f64> {
        self.filter().attitude()
    }

    fn estimate(&self) -> Estimate {
        self.filter().estimate()
    }

    fn gyro_bias(&self) -> Option<Vector3<f64>> {
        self.filter().gyro_bias()
    }
}

impl VisualInertialFilter for HandOver {
    fn belief(&self) -> &Belief {
        self.filter().belief()
    }

    fn set_imu_gap(&mut self, in_gap: bool) {
        self.propagator.set_imu_gap(in_gap);
        self.filter_mut().set_imu_gap(in_gap);
    }

    fn update_map_points(&mut self, pairs: &[PointPair]) -> Result<PointUpdate, FilterError> {
        self.filter_mut().update_map_points(pairs)
    }

    fn update_zero_velocity(&mut self, rest: &ZeroVelocity) -> Result<FrameChange, FilterError> {
        self.filter_mut().update_zero_velocity(rest)
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

    fn knows_vertical(&self) -> bool {
        self.filter().knows_vertical()
    }

    fn point_state(&self) -> Option<&dyn PointState> {
        self.filter().point_state()
    }

    fn point_state_mut(&mut self) -> Option<&mut dyn PointState> {
        self.filter_mut().point_state_mut()
    }

    fn pose_window(&self) -> Option<&dyn PoseWindow> {
        self.filter().pose_window()
    }

    fn pose_window_mut(&mut self) -> Option<&mut dyn PoseWindow> {
        self.filter_mut().pose_window_mut()
    }

    fn calibrate(&mut self, prior: &Calibration) -> Result<(), FilterError> {
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
    use crate::inertial::{ImuConfig, NavState};
    use crate::sensor::{ImuSample, Stamp};
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
        let update = filter.update_map_points(&pairs).unwrap();
        assert_eq!((update.points, update.refused.len()), (pairs.len(), 0));
        let sample = |nanos| ImuSample {
            stamp: Stamp::from_nanos(nanos),
            angular_velocity: zero,
            specific_force: truth.rotation.inverse() * Vector3::new(0.0, 0.0, 9.81),
        };
        filter.propagate(&InertialStep::between(&sample(0), &sample(5_000_000))).unwrap();
        assert!(filter.belief().state.world_from_body.rotation.angle_to(&truth.rotation) < 0.02);
        let known =
            MapEstimate { position: pairs[0].in_world, covariance: pairs[0].world_covariance };
        assert!(filter.point_state_mut().is_some_and(|points| points.admit_known(0, &known)));
    }
}
