//! A run over recorded IMU samples and position fixes.

use std::ops::ControlFlow;

use nalgebra::{Isometry3, Matrix3, UnitQuaternion, Vector3};

use super::consistency::ConsistencyMonitor;
use super::{
    Consistency, GnssConfig, GnssFilter, GnssFilterKind, InitialBelief, Innovation, OutageConfig,
};
use crate::filter::{FilterError, InertialStep};
use crate::inertial::{Belief, Coverage, ImuConfig, InitialAttitude, NavState, block};
use crate::sensor::{ImuSample, PositionFix, Stamp};

/// Why a run cannot start or go on.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum NavigationError {
    #[error("`{key}` must be {expected}")]
    Config { key: &'static str, expected: &'static str },
    #[error("stamps of {what} must increase, but {later} follows {earlier}")]
    Order { what: &'static str, earlier: Stamp, later: Stamp },
    /// No fix lies within the IMU samples.
    #[error(
        "no fix lies between IMU samples that are at most {max_gap} s apart (`imu.max_gap`): \
         {imu} IMU samples from {} to {}, {fixes} fixes from {} to {}",
        .imu_range[0], .imu_range[1], .fix_range[0], .fix_range[1]
    )]
    NoStart { max_gap: f64, imu: usize, fixes: usize, imu_range: [Stamp; 2], fix_range: [Stamp; 2] },
    #[error("there are no IMU samples or no fixes")]
    Empty,
    /// An artificial outage that no fix ends.
    #[error(
        "`outage` from {start} s for {length} s reaches beyond the last fix, {last:.1} s after the \
         first"
    )]
    Outage { start: f64, length: f64, last: f64 },
    #[error("the specific force after the first fix at {0} has no direction: free fall?")]
    Level(Stamp),
    #[error("at {stamp}: {source}")]
    Step { stamp: Stamp, source: FilterError },
}

/// What became of a fix.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FixUse {
    Used,
    /// Outside the gate.
    Rejected,
    /// Withheld, in the outage of this number.
    Outage(usize),
}

/// A fix beside its prediction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FixReport {
    pub fate: FixUse,
    pub innovation: Innovation,
    /// Share of the innovation's variance that is the noise of the fix.
    pub noise_share: f64,
}

/// The belief at one time; after the update at a fix.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NavigationStep {
    pub stamp: Stamp,
    pub belief: Belief,
    /// `S` of the attitude's matrix Fisher distribution.
    pub concentration: Option<Vector3<f64>>,
    pub fix: Option<FixReport>,
    /// What the last innovations say of the belief; `None` while there are too few.
    pub consistency: Option<Consistency>,
}

impl NavigationStep {
    /// Standard deviation of the rotation error about the vertical, rad.
    pub fn heading_sd(&self) -> f64 {
        let up = self.belief.state.world_from_body.rotation.inverse() * Vector3::z();
        let covariance = &self.belief.covariance;
        let rotation = covariance.fixed_view::<3, 3>(block::ROTATION, block::ROTATION);
        up.dot(&(rotation * up)).max(0.0).sqrt()
    }
}

/// Position error during one outage: distances of withheld fixes from their predictions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OutageReport {
    /// Of the first withheld fix, s after the first fix.
    pub start: f64,
    pub fixes: usize,
    /// Root mean square, m.
    pub rms: f64,
    /// Mean of the normalized squares, 3 if the belief is right.
    pub nis: f64,
    pub max: f64,
    /// At the last withheld fix, m.
    pub last: f64,
}

/// What a run amounts to.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct NavigationSummary {
    pub start: Stamp,
    pub imu_samples: usize,
    /// Intervals between samples longer than `imu.max_gap` since the start.
    pub gaps: usize,
    /// Such intervals that were filled in by interpolation.
    pub interpolated: usize,
    pub used: usize,
    pub rejected: usize,
    /// Fixes that enlarged the belief (`filter.surprise_probability`).
    pub surprises: usize,
    /// Normalized innovations squared of fixes that were used, and the time of each after the
    /// first fix, s.
    pub nis: Vec<(f64, f64)>,
    /// When the heading was first known to `start.converged_heading_sd` by a belief that agreed with
    /// its innovations, s after the first fix.
    pub heading_converged: Option<f64>,
    /// Since the heading's standard deviation was first that small.
    pub agreement: Agreement,
    pub outages: Vec<OutageReport>,
}

/// How often the belief agreed with its innovations.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Agreement {
    pub fixes: usize,
    /// Fixes at which the last innovations were larger, or smaller, than the belief allows for.
    pub larger: usize,
    pub smaller: usize,
    /// Sums over the fixes: of the normalised innovations squared, and of the share of the
    /// innovation's variance that is the noise of the fix.
    nis: f64,
    noise_share: f64,
}

impl Agreement {
    fn add(&mut self, consistency: &Consistency, fix: &FixReport) {
        self.fixes += 1;
        self.larger += usize::from(consistency.overconfident());
        self.smaller += usize::from(!consistency.holds() && !consistency.overconfident());
        self.nis += fix.innovation.nis;
        self.noise_share += fix.noise_share;
    }

    /// Whether the belief agreed with its innovations at most of the fixes.
    pub fn holds(&self) -> bool {
        2 * (self.larger + self.smaller) <= self.fixes
    }

    /// Mean of the normalised innovations squared.
    pub fn mean_nis(&self) -> f64 {
        self.nis / self.fixes as f64
    }

    /// Mean share of the innovation's variance that is the noise of the fix.
    pub fn noise_share(&self) -> f64 {
        self.noise_share / self.fixes as f64
    }
}

/// Longest step of the propagation: its error is of second order in the turn during a step. s
const MAX_STEP: f64 = 0.05;
/// Standard deviation of the position before the first fix, m.
const UNKNOWN_POSITION_SD: f64 = 1e4;

/// Runs a filter from the first fix that lies within the IMU samples to the last sample; samples
/// between two stamps are interpolated. `observe` ends the run early by breaking.
pub fn navigate(
    kind: GnssFilterKind,
    config: &GnssConfig,
    imu: &[ImuSample],
    fixes: &[PositionFix],
    observe: impl FnMut(&NavigationStep) -> ControlFlow<()>,
) -> Result<NavigationSummary, NavigationError> {
    let method = config.filter.attitude_update;
    let start = |imu: &ImuConfig, initial: &InitialBelief| kind.start(imu, method, initial);
    navigate_with(start, config, imu, fixes, observe)
}

/// [`navigate`] with the filter that `start` makes of what is known at the first fix.
pub fn navigate_with(
    start: impl FnOnce(&ImuConfig, &InitialBelief) -> Result<Box<dyn GnssFilter>, FilterError>,
    config: &GnssConfig,
    imu: &[ImuSample],
    fixes: &[PositionFix],
    mut observe: impl FnMut(&NavigationStep) -> ControlFlow<()>,
) -> Result<NavigationSummary, NavigationError> {
    if let Some((key, expected)) = config.first_mistake() {
        return Err(NavigationError::Config { key, expected });
    }
    check_order("IMU samples", imu.iter().map(|sample| sample.stamp))?;
    check_order("fixes", fixes.iter().map(|fix| fix.stamp))?;
    let coverage = Coverage::before_each(imu, config.imu.max_gap);
    let Start { origin, samples, coverage, fixes } = find_start(config, imu, &coverage, fixes)?;
    check_outage(config, fixes)?;
    let (mut run, first) = Run::start(start, config, &origin, samples, &fixes[0])?;
    let mut waiting = fixes[1..].iter().peekable();
    let mut now = origin;
    if observe(&first).is_break() {
        return Ok(run.finish());
    }
    for (sample, &coverage) in samples.iter().zip(coverage) {
        let sample = config.imu.in_si_units(sample);
        run.enter(coverage);
        while let Some(fix) = waiting.next_if(|fix| fix.stamp <= sample.stamp) {
            let at_fix = ImuSample::between(&now, &sample, fix.stamp);
            run.advance(&now, &at_fix)?;
            now = at_fix;
            if observe(&run.fix(fix)?).is_break() {
                return Ok(run.finish());
            }
        }
        run.advance(&now, &sample)?;
        now = sample;
        if let Some(step) = run.due(now.stamp)
            && observe(&step).is_break()
        {
            break;
        }
    }
    Ok(run.finish())
}

fn check_order(
    what: &'static str,
    mut stamps: impl Iterator<Item = Stamp>,
) -> Result<(), NavigationError> {
    let Some(mut earlier) = stamps.next() else { return Err(NavigationError::Empty) };
    for later in stamps {
        if later <= earlier {
            return Err(NavigationError::Order { what, earlier, later });
        }
        earlier = later;
    }
    Ok(())
}

fn check_outage(config: &GnssConfig, fixes: &[PositionFix]) -> Result<(), NavigationError> {
    let OutageConfig { start, length, .. } = config.outage;
    let last = match fixes {
        [first, .., last] => last.stamp.seconds_since(first.stamp),
        _ => 0.0,
    };
    if length > 0.0 && start + length > last {
        return Err(NavigationError::Outage { start, length, last });
    }
    Ok(())
}

/// Where a run begins.
struct Start<'a> {
    /// The IMU at the first fix.
    origin: ImuSample,
    /// Samples after it.
    samples: &'a [ImuSample],
    /// Of the interval before each of them.
    coverage: &'a [Coverage],
    /// The first fix and those after it; not empty.
    fixes: &'a [PositionFix],
}

fn find_start<'a>(
    config: &GnssConfig,
    imu: &'a [ImuSample],
    coverage: &'a [Coverage],
    fixes: &'a [PositionFix],
) -> Result<Start<'a>, NavigationError> {
    for (number, fix) in fixes.iter().enumerate() {
        let after = imu.partition_point(|sample| sample.stamp <= fix.stamp);
        let (Some(before), Some(next)) = (imu[..after].last(), imu.get(after)) else { continue };
        if coverage[after] != Coverage::Gap {
            let [before, next] = [before, next].map(|sample| config.imu.in_si_units(sample));
            return Ok(Start {
                origin: ImuSample::between(&before, &next, fix.stamp),
                samples: &imu[after..],
                coverage: &coverage[after..],
                fixes: &fixes[number..],
            });
        }
    }
    let (Some(first), Some(last)) = (imu.first(), imu.last()) else {
        return Err(NavigationError::Empty);
    };
    let (Some(first_fix), Some(last_fix)) = (fixes.first(), fixes.last()) else {
        return Err(NavigationError::Empty);
    };
    Err(NavigationError::NoStart {
        max_gap: config.imu.max_gap,
        imu: imu.len(),
        fixes: fixes.len(),
        imu_range: [first.stamp, last.stamp],
        fix_range: [first_fix.stamp, last_fix.stamp],
    })
}

struct Run<'a> {
    config: &'a GnssConfig,
    filter: Box<dyn GnssFilter>,
    gate: f64,
    surprise: f64,
    coverage: Coverage,
    monitor: ConsistencyMonitor,
    rejected_in_a_row: usize,
    last_output: Stamp,
    outages: OutageErrors,
    summary: NavigationSummary,
}

impl<'a> Run<'a> {
    /// A run that starts with a fix, and its first step.
    fn start(
        start: impl FnOnce(&ImuConfig, &InitialBelief) -> Result<Box<dyn GnssFilter>, FilterError>,
        config: &'a GnssConfig,
        origin: &ImuSample,
        samples: &[ImuSample],
        fix: &PositionFix,
    ) -> Result<(Self, NavigationStep), NavigationError> {
        let at = |source| NavigationError::Step { stamp: fix.stamp, source };
        let initial = initial_belief(config, origin, samples, fix)?;
        let mut filter = start(&config.imu, &initial).map_err(at)?;
        let position = config.receiver.measurement(fix, false);
        filter.update_position(&position).map_err(at)?;
        let mut run = Self {
            config,
            filter,
            gate: config.receiver.gate(),
            surprise: config.filter.surprise(),
            coverage: Coverage::Measured,
            monitor: ConsistencyMonitor::new(&config.consistency),
            rejected_in_a_row: 0,
            last_output: fix.stamp,
            outages: OutageErrors::default(),
            summary: NavigationSummary { start: fix.stamp, used: 1, ..Default::default() },
        };
        let step = run.step(fix.stamp, None);
        Ok((run, step))
    }

    /// Goes on to the next sample.
    fn enter(&mut self, coverage: Coverage) {
        self.summary.imu_samples += 1;
        self.summary.gaps += usize::from(coverage == Coverage::Gap);
        let filled_in = coverage == Coverage::Interpolated && self.coverage != coverage;
        self.summary.interpolated += usize::from(filled_in);
        self.coverage = coverage;
        self.filter.set_imu_gap(coverage != Coverage::Measured);
    }

    fn advance(&mut self, from: &ImuSample, to: &ImuSample) -> Result<(), NavigationError> {
        let seconds = to.stamp.seconds_since(from.stamp);
        let steps = (seconds / MAX_STEP).ceil();
        let step = InertialStep {
            seconds: seconds / steps,
            angular_velocity: (from.angular_velocity + to.angular_velocity) * 0.5,
            specific_force: Some((from.specific_force + to.specific_force) * 0.5),
            angle_covariance: Matrix3::zeros(),
        };
        for _ in 0..steps as usize {
            self.filter
                .propagate(&step)
                .map_err(|source| NavigationError::Step { stamp: to.stamp, source })?;
        }
        Ok(())
    }

    /// Uses a fix, or compares it with the prediction.
    fn fix(&mut self, fix: &PositionFix) -> Result<NavigationStep, NavigationError> {
        let at = |source| NavigationError::Step { stamp: fix.stamp, source };
        let elapsed = fix.stamp.seconds_since(self.summary.start);
        let interpolated = self.coverage == Coverage::Interpolated;
        let position = self.config.receiver.measurement(fix, interpolated);
        let innovation = self.filter.innovation(&position).map_err(at)?;
        let outage = self.config.outage.index_at(elapsed);
        if outage.is_none() {
            self.monitor.add(innovation.nis);
        }
        let fate = if let Some(number) = outage {
            self.outages.add(number, elapsed, &innovation);
            FixUse::Outage(number)
        } else if innovation.nis > self.gate
            && self.rejected_in_a_row < self.config.receiver.max_rejected
        {
            self.rejected_in_a_row += 1;
            self.summary.rejected += 1;
            FixUse::Rejected
        } else {
            if innovation.nis > self.surprise {
                let factor = innovation.enlargement(&position.covariance, self.surprise);
                factor.and_then(|factor| self.filter.enlarge(factor)).map_err(at)?;
                self.summary.surprises += 1;
            } else if innovation.nis > self.gate {
                // The position has jumped, not the rest of the state.
                self.filter.loosen_position(innovation.residual.norm_squared());
            }
            self.filter.update_position(&position).map_err(at)?;
            self.rejected_in_a_row = 0;
            self.summary.used += 1;
            self.summary.nis.push((elapsed, innovation.nis));
            FixUse::Used
        };
        let noise_share = position.covariance.trace() / innovation.covariance.trace();
        Ok(self.step(fix.stamp, Some(FixReport { fate, innovation, noise_share })))
    }

    /// The belief, if the last one is old enough.
    fn due(&mut self, stamp: Stamp) -> Option<NavigationStep> {
        let age = stamp.seconds_since(self.last_output);
        (age >= self.config.output.interval && age > 0.0).then(|| self.step(stamp, None))
    }

    fn step(&mut self, stamp: Stamp, fix: Option<FixReport>) -> NavigationStep {
        self.last_output = stamp;
        let consistency = self.monitor.verdict();
        let step = NavigationStep {
            stamp,
            belief: self.filter.belief(),
            concentration: self.filter.concentration(),
            fix,
            consistency,
        };
        let narrow = step.heading_sd().to_degrees() <= self.config.start.converged_heading_sd;
        let summary = &mut self.summary;
        if let (Some(verdict), Some(report)) = (&consistency, &fix)
            && (narrow || summary.agreement.fixes > 0)
            && !matches!(report.fate, FixUse::Outage(_))
        {
            summary.agreement.add(verdict, report);
        }
        let holds = consistency.is_none_or(|verdict| verdict.holds());
        if narrow && holds && summary.heading_converged.is_none() {
            summary.heading_converged = Some(stamp.seconds_since(summary.start));
        }
        step
    }

    fn finish(mut self) -> NavigationSummary {
        self.summary.outages = self.outages.reports();
        self.summary
    }
}

/// Levels the IMU over the window after the first fix.
fn initial_belief(
    config: &GnssConfig,
    origin: &ImuSample,
    samples: &[ImuSample],
    fix: &PositionFix,
) -> Result<InitialBelief, NavigationError> {
    let start = &config.start;
    let in_window =
        samples.iter().take_while(|s| s.stamp.seconds_since(origin.stamp) <= start.window);
    let window: Vec<ImuSample> =
        std::iter::once(*origin).chain(in_window.map(|s| config.imu.in_si_units(s))).collect();
    let (tilt_sd, heading_sd) = (start.tilt_sd.to_radians(), start.heading_sd.to_radians());
    let level = InitialAttitude::level(&window, Vector3::zeros(), tilt_sd, heading_sd)
        .ok_or(NavigationError::Level(fix.stamp))?;
    let heading = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), start.heading.to_radians());
    let rotation = if start.heading_known { heading } else { UnitQuaternion::identity() };
    Ok(InitialBelief {
        state: NavState {
            world_from_body: Isometry3::from_parts(
                fix.position.into(),
                rotation * level.world_from_body,
            ),
            velocity: Vector3::zeros(),
            gyro_bias: Vector3::zeros(),
            accel_bias: Vector3::zeros(),
        },
        tilt_sd,
        heading_sd: start.heading_known.then_some(heading_sd),
        velocity_sd: start.velocity_sd,
        position_sd: UNKNOWN_POSITION_SD,
        gyro_bias_sd: config.imu.gyro_bias_sd,
        accel_bias_sd: config.imu.accel_bias_sd,
    })
}

/// Withheld fixes by outage.
#[derive(Default)]
struct OutageErrors {
    outages: Vec<OutageError>,
}

struct OutageError {
    number: usize,
    start: f64,
    /// Distances of fixes from their predictions, and their normalized squares.
    errors: Vec<(f64, f64)>,
}

impl OutageErrors {
    fn add(&mut self, number: usize, elapsed: f64, innovation: &Innovation) {
        let error = (innovation.residual.norm(), innovation.nis);
        match self.outages.last_mut() {
            Some(last) if last.number == number => last.errors.push(error),
            _ => self.outages.push(OutageError { number, start: elapsed, errors: vec![error] }),
        }
    }

    fn reports(&self) -> Vec<OutageReport> {
        let report = |OutageError { start, errors, .. }: &OutageError| {
            let mean = |sum: f64| sum / errors.len() as f64;
            OutageReport {
                start: *start,
                fixes: errors.len(),
                rms: mean(errors.iter().map(|(distance, _)| distance * distance).sum()).sqrt(),
                nis: mean(errors.iter().map(|(_, nis)| nis).sum()),
                max: errors.iter().map(|(distance, _)| *distance).fold(0.0, f64::max),
                last: errors.last().map_or(0.0, |(distance, _)| *distance),
            }
        };
        self.outages.iter().map(report).collect()
    }
}
