//! The standard pictures of a run, from plain values.

use nalgebra::{Isometry3, Vector3};

use super::plot::{Band, BoxPanel, Curve, CurvePanel, Figure, Panel, PathPanel};
use super::statistics::quantile;
use super::{NeesResult, NeesSummary, PosePairs, SubTrajectoryError};

/// Lines are interrupted where stamps are further apart, s.
const GAP: f64 = 1.0;

/// Reference and estimate from above and from the side, the estimate coloured by `errors` (one a
/// pair, in `unit`); the world is taken to be z-up.
pub fn trajectory_figure(pairs: &PosePairs, errors: &[f64], unit: &str) -> Figure {
    let view = |title: &str, (x, y): (usize, usize)| {
        let axis = |k: usize| format!("{} (m)", ["x", "y", "z"][k]);
        let points = |poses: &[Isometry3<f64>]| -> Vec<[f64; 2]> {
            let starts_after_gap = |i: usize| i > 0 && pairs.stamps[i] - pairs.stamps[i - 1] > GAP;
            let point = |pose: &Isometry3<f64>| {
                let position = &pose.translation.vector;
                [position[x], position[y]]
            };
            poses
                .iter()
                .enumerate()
                .flat_map(|(i, pose)| {
                    starts_after_gap(i).then_some([f64::NAN; 2]).into_iter().chain([point(pose)])
                })
                .collect()
        };
        let estimate = points(&pairs.estimate);
        let mut next = errors.iter();
        let values = estimate.iter().map(|p| {
            if p[0].is_finite() { next.next().copied().unwrap_or(f64::NAN) } else { f64::NAN }
        });
        Panel::Path(PathPanel {
            title: title.to_owned(),
            x_label: axis(x),
            y_label: axis(y),
            reference: points(&pairs.reference),
            values: values.collect(),
            estimate,
            value_label: format!("error ({unit})"),
        })
    };
    Figure {
        title: "Trajectory (grey: reference)".to_owned(),
        panels: vec![view("from above", (0, 1)), view("from the side", (0, 2))],
        columns: 2,
    }
}

/// Errors over time.
pub fn error_figure(stamps: &[f64], errors: &[f64], unit: &str) -> Figure {
    let panel = CurvePanel {
        x_label: "time (s)".to_owned(),
        y_label: format!("error ({unit})"),
        curves: vec![Curve { name: "error".to_owned(), points: series(stamps, errors) }],
        ..Default::default()
    };
    Figure { title: "Error over time".to_owned(), panels: vec![Panel::Curves(panel)], columns: 1 }
}

/// The six components of the pose error between their believed three standard deviations.
pub fn belief_figure(result: &NeesResult) -> Figure {
    let names = ["x", "y", "z"];
    let component = |kind: &str,
                     unit: &str,
                     factor: f64,
                     errors: &[Vector3<f64>],
                     sigmas: &[Vector3<f64>],
                     axis: usize| {
        let errors: Vec<f64> = errors.iter().map(|e| factor * e[axis]).collect();
        let sigmas: Vec<f64> = sigmas.iter().map(|s| 3.0 * factor * s[axis]).collect();
        let points = series(&result.stamps, &sigmas);
        let largest = errors.iter().map(|error| error.abs()).fold(settled(&sigmas), f64::max);
        Panel::Curves(CurvePanel {
            title: format!("{kind} {}", names[axis]),
            x_label: "time (s)".to_owned(),
            y_label: format!("error ({unit})"),
            bands: vec![Band {
                name: "3 sigma".to_owned(),
                points: points.iter().map(|[t, s]| [*t, -s, *s]).collect(),
            }],
            curves: vec![Curve {
                name: "error".to_owned(),
                points: series(&result.stamps, &errors),
            }],
            limits: Some([-largest, largest]),
            ..Default::default()
        })
    };
    let degrees = 1.0_f64.to_degrees();
    let panels = (0..3).flat_map(|axis| {
        let (errors, sigmas) = (&result.rotation_errors, &result.rotation_sigmas);
        let rotation = component("rotation", "deg", degrees, errors, sigmas, axis);
        let (errors, sigmas) = (&result.position_errors, &result.position_sigmas);
        [rotation, component("position", "m", 1.0, errors, sigmas, axis)]
    });
    Figure {
        title: "Errors and believed 3 sigma (rotation: body frame, position: world)".to_owned(),
        panels: panels.collect(),
        columns: 2,
    }
}

/// Largest bound but for the widest twentieth: what a filter starts with falls by orders of
/// magnitude within a few frames, and would leave nothing to be seen of the rest.
fn settled(bounds: &[f64]) -> f64 {
    let mut sorted = bounds.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    quantile(&sorted, 0.95)
}

/// NEES over time with its chi-square band.
pub fn nees_figure(result: &NeesResult) -> Figure {
    let panel = |title: &str, values: &[f64], summary: &NeesSummary| {
        let ends = [result.stamps.first(), result.stamps.last()].into_iter().flatten();
        let start = result.stamps.first().copied().unwrap_or(0.0);
        let [low, high] = summary.band;
        Panel::Curves(CurvePanel {
            title: format!("{title}: mean {:.2}, {} expected", summary.mean, summary.dof),
            x_label: "time (s)".to_owned(),
            y_label: "NEES".to_owned(),
            bands: vec![Band {
                name: "consistent".to_owned(),
                points: ends.map(|t| [t - start, low, high]).collect(),
            }],
            curves: vec![Curve { name: "NEES".to_owned(), points: series(&result.stamps, values) }],
            limits: Some([0.0, 20.0 * high]),
            ..Default::default()
        })
    };
    Figure {
        title: "Normalised estimation error squared".to_owned(),
        panels: vec![
            panel("attitude", &result.attitude_nees, &result.attitude),
            panel("position", &result.position_nees, &result.position),
            panel("joint", &result.joint_nees, &result.joint),
        ],
        columns: 1,
    }
}

/// Box plots of relative errors over sub-trajectory lengths.
pub fn relative_error_figure(errors: &[SubTrajectoryError]) -> Figure {
    let panel = |title: &str, unit: &str, values: &dyn Fn(&SubTrajectoryError) -> &[f64]| {
        let group = |e: &SubTrajectoryError| (e.length.to_string(), values(e).to_vec());
        Panel::Boxes(BoxPanel {
            title: title.to_owned(),
            x_label: "length of the sub-trajectory (m)".to_owned(),
            y_label: format!("error ({unit})"),
            groups: errors.iter().map(group).collect(),
        })
    };
    Figure {
        title: "Relative error (median, quartiles, 5 % and 95 %)".to_owned(),
        panels: vec![
            panel("translation", "m", &|e| &e.translation_errors),
            panel("rotation", "deg", &|e| &e.rotation_errors),
        ],
        columns: 2,
    }
}

/// Box plots of named groups of values, such as the errors of several estimates.
pub fn groups_figure(title: &str, unit: &str, groups: Vec<(String, Vec<f64>)>) -> Figure {
    let panel = BoxPanel { y_label: unit.to_owned(), groups, ..Default::default() };
    Figure { title: title.to_owned(), panels: vec![Panel::Boxes(panel)], columns: 1 }
}

/// Time of the stages of a frame: `stages` are names and wall times (s), one a frame.
pub fn stage_times_figure(stages: &[(&str, Vec<f64>)]) -> Figure {
    let group = |(name, times): &(&str, Vec<f64>)| {
        ((*name).to_owned(), times.iter().map(|seconds| 1e3 * seconds).collect())
    };
    let title = "Time per frame and stage (median, quartiles, 5 % and 95 %)";
    groups_figure(title, "time (ms)", stages.iter().map(group).collect())
}

/// Numbers over time, such as features and inliers: names and values, one a stamp.
pub fn counts_figure(stamps: &[f64], counts: &[(&str, Vec<f64>)]) -> Figure {
    let curve = |(name, values): &(&str, Vec<f64>)| Curve {
        name: (*name).to_owned(),
        points: series(stamps, values),
    };
    let panel = CurvePanel {
        x_label: "time (s)".to_owned(),
        y_label: "number".to_owned(),
        curves: counts.iter().map(curve).collect(),
        ..Default::default()
    };
    let title = "Features over time".to_owned();
    Figure { title, panels: vec![Panel::Curves(panel)], columns: 1 }
}

/// Values over the time since the first stamp, interrupted at gaps.
fn series(stamps: &[f64], values: &[f64]) -> Vec<[f64; 2]> {
    let start = stamps.first().copied().unwrap_or(0.0);
    let mut points: Vec<[f64; 2]> = Vec::with_capacity(values.len());
    let mut previous = start;
    for (stamp, value) in stamps.iter().zip(values) {
        if stamp - previous > GAP {
            points.push([f64::NAN; 2]);
        }
        points.push([stamp - start, *value]);
        previous = *stamp;
    }
    points
}
