//! Time series: what is plotted, under which names and colors, and in which tab it appears.

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Vector3};
use rerun::{RecordingStream, RecordingStreamResult, Scalars, SeriesLines, TimeColumn};

use super::covariance::{diagonal_block, principal_axes, standard_deviations};
use super::timeline::{Clock, FRAME};
use crate::evaluation::normalised_square;
use crate::inertial::block;
use crate::odometry::StepReport;
use crate::sensor::{ImuSample, Stamp};

/// One plot: an entity whose every row holds one number a series.
pub(super) struct Plot {
    pub(super) entity: &'static str,
    pub(super) title: &'static str,
    series: &'static [Series],
}

struct Series {
    name: &'static str,
    color: [u8; 4],
    /// Points of the user interface.
    width: f32,
}

const fn line(name: &'static str, [r, g, b]: [u8; 3]) -> Series {
    Series { name, color: [r, g, b, 255], width: 1.5 }
}

/// A bound or a reference: thinner and fainter than the line it belongs to.
const fn bound(name: &'static str, [r, g, b]: [u8; 3]) -> Series {
    Series { name, color: [r, g, b, 170], width: 1.0 }
}

const X: [u8; 3] = [240, 90, 90];
const Y: [u8; 3] = [110, 210, 100];
const Z: [u8; 3] = [90, 150, 255];
const BLUE: [u8; 3] = [90, 170, 255];
const ORANGE: [u8; 3] = [255, 160, 60];
const YELLOW: [u8; 3] = [240, 220, 90];
const GREEN: [u8; 3] = [100, 220, 120];
const RED: [u8; 3] = [240, 80, 80];
const VIOLET: [u8; 3] = [190, 130, 255];
const CYAN: [u8; 3] = [90, 220, 220];
const GREY: [u8; 3] = [190, 190, 190];

const AXES: &[Series] = &[line("x", X), line("y", Y), line("z", Z)];
const AXES_WITH_BANDS: &[Series] = &[
    line("x", X),
    line("y", Y),
    line("z", Z),
    bound("x ± 3σ", X),
    bound("x ± 3σ", X),
    bound("y ± 3σ", Y),
    bound("y ± 3σ", Y),
    bound("z ± 3σ", Z),
    bound("z ± 3σ", Z),
];
const ERROR_AND_BOUND: &[Series] = &[line("error", ORANGE), bound("largest 3σ", GREY)];

const POSITION_ERROR: Plot = Plot {
    entity: "plots/error/position",
    title: "Position error [log10 m]",
    series: ERROR_AND_BOUND,
};
const ATTITUDE_ERROR: Plot = Plot {
    entity: "plots/error/attitude",
    title: "Attitude error [log10 deg]",
    series: ERROR_AND_BOUND,
};
const POSITION_SIGMA: Plot =
    Plot { entity: "plots/sigma/position", title: "Position σ, world [log10 m]", series: AXES };
const ATTITUDE_SIGMA: Plot =
    Plot { entity: "plots/sigma/attitude", title: "Attitude σ, body [log10 deg]", series: AXES };
const VELOCITY_SIGMA: Plot =
    Plot { entity: "plots/sigma/velocity", title: "Velocity σ, world [log10 m/s]", series: AXES };
const MATRIX_FISHER_S: Plot = Plot {
    entity: "plots/matrix_fisher/s",
    title: "Matrix Fisher S: sign(s) log10(1 + |s|)",
    series: &[line("s1", X), line("s2", Y), line("s3", Z)],
};
const INNOVATION: Plot = Plot {
    entity: "plots/innovation",
    title: "Squared innovation a degree of freedom",
    series: &[line("innovation", BLUE), bound("consistent", GREY)],
};
const ACCEPTED: Plot = Plot {
    entity: "plots/gate/accepted",
    title: "Matches accepted [%]",
    series: &[line("accepted", GREEN)],
};
const NEES: Plot = Plot {
    entity: "plots/nees",
    title: "log10 NEES of position and attitude, 95 % band",
    series: &[
        line("position", BLUE),
        line("attitude", ORANGE),
        bound("97.5 %", GREY),
        bound("2.5 %", GREY),
    ],
};
const FEATURES: Plot = Plot {
    entity: "plots/counts/features",
    title: "Key points and map points of a frame",
    series: &[
        line("features", GREY),
        line("with depth", YELLOW),
        line("candidates", VIOLET),
        line("matches", BLUE),
        line("inliers", GREEN),
        line("new", CYAN),
    ],
};
const MAP_SIZE: Plot = Plot {
    entity: "plots/counts/map",
    title: "Points in the map",
    series: &[line("map points", VIOLET)],
};
const VELOCITY: Plot =
    Plot { entity: "plots/velocity", title: "Velocity, world [m/s]", series: AXES };
const GYRO_BIAS: Plot =
    Plot { entity: "plots/bias/gyro", title: "Gyroscope bias [deg/s]", series: AXES_WITH_BANDS };
const ACCEL_BIAS: Plot = Plot {
    entity: "plots/bias/accel",
    title: "Accelerometer bias [m/s²]",
    series: AXES_WITH_BANDS,
};
const TIMING: Plot = Plot {
    entity: "plots/timing",
    title: "Processing time of a frame [ms]",
    series: &[
        line("features", YELLOW),
        line("propagation", CYAN),
        line("matching", VIOLET),
        line("ransac", GREEN),
        line("update", BLUE),
        line("map", RED),
        line("sum", GREY),
        bound("frame interval", ORANGE),
    ],
};
const ANGULAR_VELOCITY: Plot =
    Plot { entity: "plots/imu/gyro", title: "Gyroscope [deg/s]", series: AXES };
const SPECIFIC_FORCE: Plot =
    Plot { entity: "plots/imu/accel", title: "Accelerometer [m/s²]", series: AXES };

/// Plots that stand side by side under one name.
pub(super) struct Tab {
    pub(super) name: &'static str,
    pub(super) plots: &'static [Plot],
}

pub(super) const ERROR: Tab = Tab { name: "Error", plots: &[POSITION_ERROR, ATTITUDE_ERROR, NEES] };
pub(super) const UNCERTAINTY: Tab =
    Tab { name: "σ", plots: &[POSITION_SIGMA, ATTITUDE_SIGMA, VELOCITY_SIGMA] };
pub(super) const BELIEF: Tab =
    Tab { name: "Belief", plots: &[MATRIX_FISHER_S, INNOVATION, ACCEPTED] };
pub(super) const TRACKING: Tab = Tab { name: "Tracking", plots: &[FEATURES, MAP_SIZE] };
pub(super) const STATE: Tab = Tab { name: "State", plots: &[VELOCITY, GYRO_BIAS, ACCEL_BIAS] };
pub(super) const IMU: Tab = Tab { name: "IMU", plots: &[ANGULAR_VELOCITY, SPECIFIC_FORCE] };
pub(super) const TIMES: Tab = Tab { name: "Timing", plots: &[TIMING] };

const ALL: [Tab; 7] = [ERROR, UNCERTAINTY, BELIEF, TRACKING, STATE, IMU, TIMES];

/// Names and colors, once for the whole recording.
pub(super) fn log_styles(stream: &RecordingStream) -> RecordingStreamResult<()> {
    for plot in ALL.iter().flat_map(|tab| tab.plots) {
        let style = SeriesLines::new()
            .with_names(plot.series.iter().map(|series| series.name))
            .with_colors(plot.series.iter().map(|series| series.color))
            .with_widths(plot.series.iter().map(|series| series.width));
        stream.log_static(plot.entity, &style)?;
    }
    Ok(())
}

/// When values were measured: on the sensors' clock, and at which frame unless between two.
#[derive(Debug, Clone, Copy)]
pub(super) struct Moment {
    pub(super) stamp: Stamp,
    pub(super) frame: Option<i64>,
}

/// Values that wait to be written together: a column of many costs little more than one value.
#[derive(Default)]
pub(super) struct PlotLog {
    columns: BTreeMap<&'static str, Column>,
}

#[derive(Default)]
struct Column {
    stamps: Vec<Stamp>,
    /// One a stamp; empty for what falls between frames.
    frames: Vec<i64>,
    values: Vec<f64>,
}

impl PlotLog {
    /// The numbers of one frame; `interval` is the time since the frame before, s.
    pub(super) fn push_report(
        &mut self,
        moment: Moment,
        report: &StepReport,
        truth: Option<&Isometry3<f64>>,
        interval: Option<f64>,
    ) {
        let mut log = |plot: &Plot, values: &[f64]| self.push(plot, moment, values);
        let sigma = |block| standard_deviations(&report.covariance, block);
        let degrees = |radians: Vector3<f64>| radians.map(f64::to_degrees);

        if let Some(truth) = truth {
            let [position, attitude] = errors(report, truth);
            log(&POSITION_ERROR, &position.map(decades));
            log(&ATTITUDE_ERROR, &attitude.map(f64::to_degrees).map(decades));
            log(&NEES, &log_nees(report, truth));
        }
        log(&POSITION_SIGMA, sigma(block::POSITION).map(decades).as_slice());
        log(&ATTITUDE_SIGMA, degrees(sigma(block::ROTATION)).map(decades).as_slice());
        log(&VELOCITY_SIGMA, sigma(block::VELOCITY).map(decades).as_slice());
        if let Some(s) = report.matrix_fisher.map(|svd| svd.s) {
            log(&MATRIX_FISHER_S, s.map(signed_log).as_slice());
        }
        if let Some(nis) = report.nis {
            log(&INNOVATION, &[nis, 1.0]);
        }
        let counts = &report.counts;
        let of_frame = [
            counts.features,
            counts.with_depth,
            counts.candidates,
            counts.matches,
            counts.inliers,
            counts.new_points,
        ];
        log(&FEATURES, &of_frame.map(|count| count as f64));
        if counts.matches > 0 {
            log(&ACCEPTED, &[100.0 * counts.inliers as f64 / counts.matches as f64]);
        }
        log(&MAP_SIZE, &[counts.map_points as f64]);
        log(&VELOCITY, report.state.velocity.as_slice());
        let gyro_bias = degrees(report.state.gyro_bias);
        log(&GYRO_BIAS, &with_bands(gyro_bias, degrees(sigma(block::GYRO_BIAS))));
        log(&ACCEL_BIAS, &with_bands(report.state.accel_bias, sigma(block::ACCEL_BIAS)));
        log(&TIMING, &stage_milliseconds(report, interval));
    }

    /// A sample of the IMU.
    pub(super) fn push_imu(&mut self, sample: &ImuSample) {
        let moment = Moment { stamp: sample.stamp, frame: None };
        let turn = sample.angular_velocity.map(f64::to_degrees);
        self.push(&ANGULAR_VELOCITY, moment, turn.as_slice());
        self.push(&SPECIFIC_FORCE, moment, sample.specific_force.as_slice());
    }

    fn push(&mut self, plot: &Plot, moment: Moment, values: &[f64]) {
        debug_assert_eq!(plot.series.len(), values.len(), "{}", plot.entity);
        let column = self.columns.entry(plot.entity).or_default();
        column.stamps.push(moment.stamp);
        column.frames.extend(moment.frame);
        column.values.extend(values);
    }

    /// Writes what waits.
    pub(super) fn flush(
        &mut self,
        stream: &RecordingStream,
        clock: Clock,
    ) -> RecordingStreamResult<()> {
        for (entity, column) in std::mem::take(&mut self.columns) {
            let Column { stamps, frames, values } = column;
            let width = values.len() / stamps.len();
            let lengths = std::iter::repeat_n(width, stamps.len());
            let frames = (!frames.is_empty()).then(|| TimeColumn::new_sequence(FRAME, frames));
            let times = [clock.column(&stamps)].into_iter().chain(frames);
            stream.send_columns(entity, times, Scalars::new(values).columns(lengths)?)?;
        }
        Ok(())
    }
}

/// Error and largest 3 sigma of the position (m) and of the attitude (rad).
fn errors(report: &StepReport, truth: &Isometry3<f64>) -> [[f64; 2]; 2] {
    let estimate = &report.state.world_from_body;
    let largest = |block| match principal_axes(&diagonal_block(&report.covariance, block)) {
        Some((deviations, _)) => 3.0 * deviations.max(),
        None => f64::NAN,
    };
    let position = (estimate.translation.vector - truth.translation.vector).norm();
    let attitude = estimate.rotation.angle_to(&truth.rotation);
    [[position, largest(block::POSITION)], [attitude, largest(block::ROTATION)]]
}

/// Errors and standard deviations fall by decades in the first frames. What is zero but for
/// rounding, such as the error of the first pose, leaves a gap, as what is not finite.
fn decades(value: f64) -> f64 {
    const ROUNDING: f64 = 1e-9;
    if value > ROUNDING { value.log10() } else { f64::NAN }
}

/// `S` spans eight decades and has a sign; this shows all of it, zero at zero.
fn signed_log(s: f64) -> f64 {
    (1.0 + s.abs()).log10().copysign(s)
}

/// The order of [`AXES_WITH_BANDS`].
fn with_bands(value: Vector3<f64>, sigma: Vector3<f64>) -> [f64; 9] {
    let (low, high) = (value - 3.0 * sigma, value + 3.0 * sigma);
    [value.x, value.y, value.z, low.x, high.x, low.y, high.y, low.z, high.z]
}

/// Position and attitude errors squared over what is believed of them, and the two-sided 95 %
/// band of three degrees of freedom; common logarithms, since the errors of an overconfident
/// filter span decades.
fn log_nees(report: &StepReport, truth: &Isometry3<f64>) -> [f64; 4] {
    let estimate = &report.state.world_from_body;
    let position = truth.translation.vector - estimate.translation.vector;
    let attitude = (estimate.rotation.inverse() * truth.rotation).scaled_axis();
    let nees = |error, block| {
        normalised_square(error, diagonal_block(&report.covariance, block)).unwrap_or(f64::NAN)
    };
    let [lower, upper] = NEES_BAND;
    [nees(&position, block::POSITION), nees(&attitude, block::ROTATION), upper, lower].map(decades)
}

/// Quantiles of the chi-square distribution of three degrees of freedom.
const NEES_BAND: [f64; 2] = [0.215_795, 9.348_404];

/// The order of [`TIMING`].
fn stage_milliseconds(report: &StepReport, interval: Option<f64>) -> Vec<f64> {
    let stages = report.times.stages().map(|(_, seconds)| 1e3 * seconds);
    let last = [stages.iter().sum(), 1e3 * interval.unwrap_or(f64::NAN)];
    stages.into_iter().chain(last).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::NeesSummary;
    use crate::odometry::StageTimes;

    #[test]
    fn the_band_is_that_of_the_evaluation() {
        let summary = NeesSummary::of(&[1.0], 3, 0.95).unwrap();
        for (bound, expected) in NEES_BAND.iter().zip(summary.band) {
            assert!((bound - expected).abs() < 1e-6, "{bound} {expected}");
        }
    }

    #[test]
    fn stages_have_the_names_and_order_of_the_report() {
        let names: Vec<_> = TIMING.series.iter().map(|series| series.name).collect();
        let stages = StageTimes::default().stages().map(|(name, _)| name);
        assert_eq!(names[..stages.len()], stages);
        assert_eq!(names.len(), stages.len() + 2);
    }

    #[test]
    fn the_logarithm_of_s_keeps_sign_and_order() {
        let values = [-1e8, -3.0, -1e-9, 0.0, 1e-9, 3.0, 1e8].map(signed_log);
        assert!(values.is_sorted());
        assert_eq!(values[3], 0.0);
        assert_eq!(values[0], -values[6]);
    }
}
