//! How each filter starts.

use nalgebra::Matrix3;

use super::config::{FilterConfig, MapTreatment};
use super::depthless_start::{StartInput, StartSolution};
use super::estimator::VisualInertialFilter;
use super::handover::HandOver;
use super::kind::FilterKind;
use super::mekf::Mekf;
use super::mfg::MfgFilter;
use super::slam::{AttitudeDensity, ErrorState, SlamFilter, StartedFilter, UNIFORM_VARIANCE};
use crate::distribution::matrix_fisher::MatrixFisher;
use crate::filter::core::FilterError;
use crate::inertial::{Belief, Propagator, block};

/// What is known of the attitude at the start.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum KnownAttitude {
    /// Heading and vertical, as well as the belief says.
    All,
    /// The vertical; the world's heading is arbitrary.
    Vertical,
    /// Nothing: the belief is in the frame of the body, where gravity (magnitude, m/s^2) has any
    /// direction.
    Nothing { gravity: f64 },
}

impl FilterKind {
    /// A filter of this kind that starts from `belief`.
    pub fn start(
        self,
        config: &FilterConfig,
        propagator: Propagator,
        belief: Belief,
    ) -> Box<dyn VisualInertialFilter> {
        match self {
            Self::Mfgd | Self::Mfgr => Box::new(MfgFilter::new(self, config, propagator, belief)),
            Self::Mekfd | Self::Mekfr => Box::new(Mekf::new(self, config, propagator, belief)),
            Self::Mfgs | Self::Iekfs | Self::Mekfs => {
                Box::new(self.joint(config, propagator, belief))
            }
        }
    }

    /// A filter whose state holds map points.
    fn joint(self, config: &FilterConfig, propagator: Propagator, belief: Belief) -> SlamFilter {
        SlamFilter::new(self, config, self.error_state(), propagator, belief)
    }

    /// The coordinates of errors of a filter whose state holds map points.
    fn error_state(self) -> ErrorState {
        match self {
            Self::Mekfs => ErrorState::So3xRn,
            Self::Iekfs => ErrorState::RightInvariant { density: AttitudeDensity::Gaussian },
            _ => ErrorState::RightInvariant { density: AttitudeDensity::MatrixFisher },
        }
    }

    /// A filter that starts without depth, from what was found of its motion, with a window of the
    /// poses of the frames `kept`.
    ///
    /// # Errors
    /// [`FilterError::Unsupported`] for filters whose state holds no points, and those of
    /// [`SlamFilter::from_motion`].
    pub fn start_from_motion(
        self,
        config: &FilterConfig,
        propagator: Propagator,
        input: &StartInput<'_>,
        found: &StartSolution,
        kept: &[usize],
    ) -> Result<StartedFilter, FilterError> {
        if self.map_treatment() != MapTreatment::Correlated {
            return Err(FilterError::Unsupported { filter: self.name(), measurement: "track" });
        }
        SlamFilter::from_motion(self, self.error_state(), config, propagator, input, found, kept)
    }

    /// The same where the attitude is too uncertain for a covariance: the MFG filters start from
    /// `attitude`, independent of the rest of `belief`; the Gaussian ones from `belief` alone.
    pub fn start_broad(
        self,
        config: &FilterConfig,
        propagator: Propagator,
        belief: Belief,
        attitude: &MatrixFisher,
    ) -> Box<dyn VisualInertialFilter> {
        match self {
            Self::Mfgd | Self::Mfgr => {
                Box::new(MfgFilter::broad(self, config, propagator, belief, attitude))
            }
            Self::Mfgs => Box::new(HandOver::new(config, propagator, belief, attitude)),
            Self::Mekfd | Self::Mekfr | Self::Mekfs | Self::Iekfs => {
                self.start(config, propagator, belief)
            }
        }
    }

    /// A filter of this kind that starts from `belief`, of whose attitude only `known` is known.
    ///
    /// Filters whose state holds no points cannot estimate gravity: with an unknown attitude they get
    /// the variance of a uniform rotation.
    pub fn start_knowing(
        self,
        known: KnownAttitude,
        config: &FilterConfig,
        propagator: Propagator,
        mut belief: Belief,
    ) -> Box<dyn VisualInertialFilter> {
        let joint = self.map_treatment() == MapTreatment::Correlated;
        match known {
            KnownAttitude::Vertical if joint => {
                Box::new(self.joint(config, propagator, belief).with_free_heading())
            }
            KnownAttitude::Nothing { gravity } if joint => {
                Box::new(self.joint(config, propagator, belief).with_unknown_gravity(gravity))
            }
            KnownAttitude::All | KnownAttitude::Vertical => self.start(config, propagator, belief),
            KnownAttitude::Nothing { .. } => {
                belief
                    .covariance
                    .fixed_view_mut::<3, 3>(block::ROTATION, block::ROTATION)
                    .copy_from(&(Matrix3::identity() * UNIFORM_VARIANCE));
                self.start(config, propagator, belief)
            }
        }
    }
}
