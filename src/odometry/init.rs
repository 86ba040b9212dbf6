//! From the first seconds of a log to a first belief.

use std::fmt;
use std::str::FromStr;

use nalgebra::{Isometry3, Matrix3, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use super::truth::{TruthConfig, TruthTrack, Up, z_up_from_reference};
use crate::filter::{FilterConfig, KnownAttitude};
use crate::inertial::{
    Belief, ImuConfig, InitialAttitude, NavCovariance, NavState, StandstillCheck, StandstillConfig,
    block,
};
use crate::sensor::{ImuSample, Stamp};

/// Where the first attitude comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum InitMode {
    /// The first reference pose.
    Truth,
    /// Gravity and gyro bias from a standing start, heading zero; waits for the IMU to rest.
    Static,
    /// `static` if the IMU stands still at first, else gravity from the mean of the first window.
    Auto,
    /// Gravity as `auto` finds it, heading uniform.
    UnknownHeading,
    /// Attitude uniform; starts with the first frame.
    Unknown,
}

impl InitMode {
    pub const ALL: [Self; 5] =
        [Self::Auto, Self::Static, Self::Truth, Self::UnknownHeading, Self::Unknown];

    pub fn name(self) -> &'static str {
        match self {
            Self::Truth => "truth",
            Self::Static => "static",
            Self::Auto => "auto",
            Self::UnknownHeading => "unknown-heading",
            Self::Unknown => "unknown",
        }
    }
}

impl fmt::Display for InitMode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for InitMode {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Self::ALL.into_iter().find(|mode| mode.name() == text).ok_or_else(|| {
            let names: Vec<_> = Self::ALL.iter().map(|mode| mode.name()).collect();
            format!("unknown initialisation `{text}`; there are: {}", names.join(", "))
        })
    }
}

/// How a run starts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct InitConfig {
    /// `auto`, `static`, `truth`, `unknown-heading` or `unknown`; `--init` overrides it.
    pub mode: InitMode,
    /// Length of IMU data that a moving start is levelled with, s.
    pub moving_window: f64,
    /// Longest wait for reference poses around the first frame (`truth`), s.
    pub truth_wait: f64,
}

impl Default for InitConfig {
    fn default() -> Self {
        Self { mode: InitMode::Auto, moving_window: 0.5, truth_wait: 2.0 }
    }
}

/// What an attempt to initialise led to.
#[derive(Debug, Clone, PartialEq)]
pub enum Attempt {
    /// More data are needed.
    Wait,
    /// This frame cannot be the first one; the text says why.
    NextFrame(String),
    Ready {
        belief: Box<Belief>,
        known: KnownAttitude,
        how: String,
    },
}

/// Everything an attempt may look at.
pub struct Evidence<'a> {
    /// IMU samples since shortly before the first frame; `None` if the log has no IMU.
    pub imu: Option<&'a [ImuSample]>,
    pub truth: &'a TruthTrack,
    /// Stamp of the frame that is to be the first.
    pub first_frame: Stamp,
    /// Stamp of the newest event.
    pub now: Stamp,
    pub ended: bool,
    /// For a new start in the course of a run: the attitude that the gyroscope has carried on.
    pub attitude: Option<UnitQuaternion<f64>>,
}

/// Settings that the start depends on.
#[derive(Debug, Clone)]
pub struct Initializer {
    pub init: InitConfig,
    pub standstill: StandstillConfig,
    pub truth: TruthConfig,
    pub imu: ImuConfig,
    pub filter: FilterConfig,
    /// Attitude of a level body that has no IMU to find gravity with: the mounting of a camera
    /// that looks ahead.
    pub level_without_imu: UnitQuaternion<f64>,
}

impl Initializer {
    /// The same for a new start in the course of a run.
    pub fn anew(&self) -> Self {
        Self { init: InitConfig { mode: InitMode::Auto, ..self.init.clone() }, ..self.clone() }
    }

    pub fn attempt(&self, evidence: &Evidence) -> Attempt {
        match self.init.mode {
            InitMode::Truth => self.with_truth(evidence),
            InitMode::Static | InitMode::Auto => match evidence.imu {
                Some(imu) => self.with_imu(evidence, imu),
                None => self.without_imu(),
            },
            InitMode::UnknownHeading | InitMode::Unknown => match evidence.imu {
                None => Attempt::NextFrame(
                    "without an IMU nothing tells which way is up; use `--init auto`".to_owned(),
                ),
                Some(imu) if self.init.mode == InitMode::UnknownHeading => {
                    self.with_imu(evidence, imu)
                }
                Some(_) => self.in_first_body_frame(),
            },
        }
    }

    fn with_truth(&self, evidence: &Evidence) -> Attempt {
        let first = evidence.first_frame;
        let enough = first.offset_by(0.5 * VELOCITY_SPAN);
        let reached = evidence.truth.newest().is_some_and(|newest| newest >= enough);
        let waited = evidence.now.seconds_since(first);
        if !reached && waited < self.init.truth_wait && !evidence.ended {
            return Attempt::Wait;
        }
        let Some(pose) = evidence.truth.at(first, self.truth.max_gap) else {
            return Attempt::NextFrame(format!(
                "no reference pose at the first frame ({first} s){}",
                evidence
                    .truth
                    .newest()
                    .map(|t| format!(", newest is at {t} s"))
                    .unwrap_or_default()
            ));
        };
        let Some((z_up, tilt_sd_deg)) = self.z_up_from_truth(evidence, &pose) else {
            let reason = "`truth.up` has no direction, or is \"auto\" without an IMU";
            return Attempt::NextFrame(reason.to_owned());
        };
        let world_from_body = Isometry3::from_parts(Translation3::identity(), z_up) * pose;
        let velocity = evidence
            .truth
            .velocity(first, VELOCITY_SPAN, self.truth.max_gap)
            .map(|velocity| z_up * velocity);
        let velocity_sd = match velocity {
            Some(_) => self.filter.velocity_sd,
            None => self.filter.moving_velocity_sd,
        };
        let body_from_world = world_from_body.rotation.inverse().to_rotation_matrix();
        let (tilt, heading) = (tilt_sd_deg.to_radians(), self.filter.heading_sd_deg.to_radians());
        let variances =
            Matrix3::from_diagonal(&Vector3::new(tilt.powi(2), tilt.powi(2), heading.powi(2)));
        let attitude = InitialAttitude {
            world_from_body: world_from_body.rotation,
            gyro_bias: Vector3::zeros(),
            covariance: body_from_world.matrix() * variances * body_from_world.matrix().transpose(),
        };
        let mut belief = self.belief(&attitude, velocity_sd, evidence.imu.is_some());
        belief.state.world_from_body = world_from_body;
        belief.state.velocity = velocity.unwrap_or_default();
        let how = format!("from the reference pose at {first} s");
        Attempt::Ready { belief: Box::new(belief), known: KnownAttitude::All, how }
    }

    /// What turns the reference's world z-up, and the standard deviation of the tilt that is
    /// left, degrees.
    fn z_up_from_truth(
        &self,
        evidence: &Evidence,
        world_from_body: &Isometry3<f64>,
    ) -> Option<(UnitQuaternion<f64>, f64)> {
        match self.truth.up {
            Up::Vector(up) => {
                Some((z_up_from_reference(&Vector3::from(up))?, self.filter.tilt_sd_deg))
            }
            Up::Auto(_) => {
                // The first attitude maps the specific force of the window well enough: the
                // window is short and the mean acceleration in it small beside gravity.
                let felt = StandstillCheck::measure(evidence.imu?)?;
                let z_up = z_up_from_reference(&(world_from_body.rotation * felt.accel_mean))?;
                let still = felt.stands_still(&self.standstill);
                let filter = &self.filter;
                Some((z_up, if still { filter.tilt_sd_deg } else { filter.moving_tilt_sd_deg }))
            }
        }
    }

    fn with_imu(&self, evidence: &Evidence, imu: &[ImuSample]) -> Attempt {
        let first = evidence.first_frame;
        let until = |seconds: f64| first.offset_by(seconds);
        let covered = |seconds: f64| imu.last().is_some_and(|s| s.stamp >= until(seconds));
        let window = |seconds: f64| {
            let end = imu.partition_point(|s| s.stamp <= until(seconds));
            let start = imu.partition_point(|s| s.stamp < first);
            imu.get(start..end).unwrap_or_default()
        };
        if !covered(self.standstill.window) {
            let reason =
                format!("the IMU data end within {} s of this frame", self.standstill.window);
            return match (evidence.ended, evidence.attitude) {
                (false, _) => Attempt::Wait,
                (true, Some(attitude)) => self.carried_on(attitude, &reason),
                (true, None) => Attempt::NextFrame(reason),
            };
        }
        let Some(check) = StandstillCheck::measure(window(self.standstill.window)) else {
            return Attempt::NextFrame("no IMU samples after this frame".to_owned());
        };
        if check.stands_still(&self.standstill) {
            let still = window(self.standstill.window);
            return self.levelled(still, &check, true);
        }
        let explained = check.explain(&self.standstill);
        if self.init.mode == InitMode::Static {
            return Attempt::NextFrame(format!("the IMU does not stand still: {explained}"));
        }
        if !covered(self.init.moving_window) && !evidence.ended {
            return Attempt::Wait;
        }
        self.levelled(window(self.init.moving_window), &check, false)
    }

    /// Where it is too late to be levelled.
    fn carried_on(&self, attitude: UnitQuaternion<f64>, reason: &str) -> Attempt {
        let attitude = InitialAttitude {
            world_from_body: attitude,
            gyro_bias: Vector3::zeros(),
            covariance: Matrix3::identity() * self.filter.moving_tilt_sd_deg.to_radians().powi(2),
        };
        Attempt::Ready {
            belief: Box::new(self.belief(&attitude, self.filter.moving_velocity_sd, true)),
            known: KnownAttitude::All,
            how: format!("{reason}: the attitude is the old one"),
        }
    }

    fn levelled(&self, samples: &[ImuSample], check: &StandstillCheck, still: bool) -> Attempt {
        let (bias, tilt_deg, velocity_sd) = if still {
            (check.gyro_mean, self.filter.tilt_sd_deg, self.filter.velocity_sd)
        } else {
            let filter = &self.filter;
            (Vector3::zeros(), filter.moving_tilt_sd_deg, filter.moving_velocity_sd)
        };
        let heading = self.filter.heading_sd_deg.to_radians();
        let level = InitialAttitude::level(samples, bias, tilt_deg.to_radians(), heading);
        let Some(attitude) = level else {
            return Attempt::NextFrame("the accelerometer shows no gravity".to_owned());
        };
        let mut belief = self.belief(&attitude, velocity_sd, true);
        if still {
            let rate_sd = self.standstill.max_gyro_deviation / (check.samples as f64).sqrt();
            set_variance(&mut belief.covariance, block::GYRO_BIAS, rate_sd);
        }
        let magnitude = check.accel_mean.norm();
        let explained = check.explain(&self.standstill);
        let how = if still {
            format!("standing still: {explained}; gravity reads {magnitude:.3} m/s^2")
        } else {
            format!("moving ({explained}): levelled by the mean of the specific force")
        };
        let known = match self.init.mode {
            InitMode::UnknownHeading => KnownAttitude::Vertical,
            _ => KnownAttitude::All,
        };
        Attempt::Ready { belief: Box::new(belief), known, how }
    }

    fn without_imu(&self) -> Attempt {
        let attitude = InitialAttitude {
            world_from_body: self.level_without_imu,
            gyro_bias: Vector3::zeros(),
            covariance: Matrix3::identity() * self.filter.heading_sd_deg.to_radians().powi(2),
        };
        let belief = self.belief(&attitude, self.filter.moving_velocity_sd, false);
        Attempt::Ready {
            belief: Box::new(belief),
            known: KnownAttitude::All,
            how: "no IMU: level, at the origin".to_owned(),
        }
    }

    /// The world is the body's frame at the first frame; its attitude there is known but for the
    /// standard deviation that any start gives the heading.
    fn in_first_body_frame(&self) -> Attempt {
        let attitude = InitialAttitude {
            world_from_body: UnitQuaternion::identity(),
            gyro_bias: Vector3::zeros(),
            covariance: Matrix3::identity() * self.filter.heading_sd_deg.to_radians().powi(2),
        };
        Attempt::Ready {
            belief: Box::new(self.belief(&attitude, self.filter.moving_velocity_sd, true)),
            known: KnownAttitude::Nothing { gravity: self.imu.gravity },
            how: "attitude unknown: in the frame of the body until gravity is found".to_owned(),
        }
    }

    /// Belief at the origin with the given attitude.
    fn belief(&self, attitude: &InitialAttitude, velocity_sd: f64, has_imu: bool) -> Belief {
        let mut covariance = NavCovariance::zeros();
        covariance
            .fixed_view_mut::<3, 3>(block::ROTATION, block::ROTATION)
            .copy_from(&attitude.covariance);
        set_variance(&mut covariance, block::VELOCITY, velocity_sd);
        set_variance(&mut covariance, block::POSITION, self.filter.position_sd);
        let (gyro_sd, accel_sd) = if has_imu {
            (self.imu.gyro_bias_sd, self.imu.accel_bias_sd)
        } else {
            (self.filter.angular_velocity_sd, 0.0)
        };
        set_variance(&mut covariance, block::GYRO_BIAS, gyro_sd);
        set_variance(&mut covariance, block::ACCEL_BIAS, accel_sd);
        let state = NavState {
            world_from_body: Isometry3::from_parts(
                Translation3::identity(),
                attitude.world_from_body,
            ),
            velocity: Vector3::zeros(),
            gyro_bias: attitude.gyro_bias,
            accel_bias: Vector3::zeros(),
        };
        Belief { state, covariance }
    }
}

/// Span of the difference that gives the first velocity from reference poses, s.
const VELOCITY_SPAN: f64 = 0.1;

fn set_variance(covariance: &mut NavCovariance, start: usize, sd: f64) {
    for k in start..start + 3 {
        covariance[(k, k)] = sd * sd;
    }
}
