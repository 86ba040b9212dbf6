//! Estimates beside their reference: the recording of `evaluate ape|rpe --rrd`.

use std::path::Path;

use nalgebra::Isometry3;
use rerun::components::Radius;
use rerun::external::re_sdk_types::blueprint::archetypes::LineGrid3D;
use rerun::external::re_sdk_types::blueprint::components::ContainerKind;
use rerun::external::re_sdk_types::blueprint::views::Spatial3DView;
use rerun::{
    Color, EntityPath, EntityPathPart, LineStrips3D, RecordingStream, RecordingStreamResult,
    Scalars, SeriesLines, TimeColumn, Transform3D, TransformAxes3D, ViewCoordinates,
};

use super::map::gradient;
use super::recorder::{APPLICATION, check_complete, open};
use super::timeline::Clock;
use super::{Sink, ViewerError, blueprint, layout, scene};
use crate::evaluation::{PosePairs, Trajectory};
use crate::sensor::Stamp;

const REFERENCE: &str = "world/reference";
const ERRORS: &str = "plots/error";
/// Poses without an error.
const PLAIN: [u8; 3] = [150, 150, 150];
/// Paths are interrupted where stamps are further apart, s.
const GAP: f64 = 1.0;
const AXES_LENGTH: f32 = 0.1;

/// An estimate that was compared with the reference.
#[derive(Debug, Clone, Copy)]
pub struct ComparedEstimate<'a> {
    /// Different for each estimate.
    pub name: &'a str,
    /// The matched poses, the estimate's aligned.
    pub pairs: &'a PosePairs,
    /// Added to the estimate's stamps to bring them to the reference's clock, s.
    pub time_offset: f64,
    /// Stamps of the errors, ascending, in the estimate's clock, s.
    pub stamps: &'a [f64],
    pub errors: &'a [f64],
}

/// Records the whole reference and the matched poses of `estimates`, whose paths are colored by
/// their error (in `unit`) from 0 (green) to the largest of all (magenta).
///
/// # Errors
/// If the file cannot be created or written to its end.
pub fn record_comparison(
    path: &Path,
    title: &str,
    unit: &str,
    reference: &Trajectory,
    estimates: &[ComparedEstimate],
) -> Result<(), ViewerError> {
    let stream = open(&[Sink::File(path.to_owned())], title)?;
    let errors = || estimates.iter().flat_map(|estimate| estimate.errors);
    let largest = errors().copied().fold(0.0, f64::max);
    layout::send(&stream, APPLICATION, title, |layout| {
        let world = layout.view::<Spatial3DView>(
            &format!("Reference grey; estimates by error from 0 to {largest:.3} {unit}"),
            scene::WORLD,
            &["+ $origin/**".to_owned()],
        )?;
        layout.property(&world, &blueprint::background())?;
        layout.property(&world, &LineGrid3D::new().with_visible(true))?;
        let plot =
            layout.time_series(&format!("Error [{unit}]"), ERRORS, &["+ $origin/**".to_owned()])?;
        layout.container(ContainerKind::Vertical, title, &[(world, 2.0), (plot, 1.0)])
    })?;
    stream.log_static(scene::WORLD, &ViewCoordinates::RIGHT_HAND_Z_UP())?;
    log_path(&stream, &REFERENCE.into(), reference.stamps(), reference.poses(), |_| None)?;
    for estimate in estimates {
        log_estimate(&stream, estimate, largest)?;
    }
    stream.flush_blocking()?;
    drop(stream);
    check_complete(path)
}

fn log_estimate(
    stream: &RecordingStream,
    estimate: &ComparedEstimate,
    largest: f64,
) -> Result<(), ViewerError> {
    let ComparedEstimate { name, pairs, time_offset, .. } = *estimate;
    let part = EntityPath::new(vec![EntityPathPart::new(name)]);
    let below = |parent: &str| EntityPath::from(parent).join(&part);
    let shifted = |stamps: &[f64]| stamps.iter().map(|t| t + time_offset).collect::<Vec<_>>();
    let error_at = |index: usize| {
        let stamp = pairs.stamps.get(index)?;
        let found = estimate.stamps.partition_point(|t| t < stamp);
        let exact = estimate.stamps.get(found).is_some_and(|t| t == stamp);
        if exact { estimate.errors.get(found).copied() } else { None }
    };
    let color =
        |index: usize| Some(gradient((error_at(index)? / largest.max(f64::MIN_POSITIVE)) as f32));
    log_path(stream, &below(scene::WORLD), &shifted(&pairs.stamps), &pairs.estimate, color)?;
    let plot = below(ERRORS);
    stream.log_static(plot.clone(), &SeriesLines::new().with_names([name]))?;
    let scalars = Scalars::new(estimate.errors.iter().copied()).columns_of_unit_batches();
    let scalars = scalars.map_err(rerun::RecordingStreamError::from)?;
    stream.send_columns(plot, [time_column(&shifted(estimate.stamps))], scalars)?;
    Ok(())
}

/// The path as a whole, each piece in the color of the pose where it ends, and the pose over time.
fn log_path(
    stream: &RecordingStream,
    entity: &EntityPath,
    stamps: &[f64],
    poses: &[Isometry3<f64>],
    color: impl Fn(usize) -> Option<Color>,
) -> RecordingStreamResult<()> {
    let position = |pose: &Isometry3<f64>| scene::point(&pose.translation.vector);
    let plain = Color::from_rgb(PLAIN[0], PLAIN[1], PLAIN[2]);
    let mut strips: Vec<Vec<[f32; 3]>> = Vec::new();
    let mut colors: Vec<Color> = Vec::new();
    for (index, (poses, stamps)) in poses.windows(2).zip(stamps.windows(2)).enumerate() {
        if stamps[1] - stamps[0] > GAP {
            continue;
        }
        let color = color(index + 1).unwrap_or(plain);
        let [from, to] = [position(&poses[0]), position(&poses[1])];
        match (strips.last_mut(), colors.last()) {
            (Some(strip), Some(last)) if *last == color && strip.last() == Some(&from) => {
                strip.push(to);
            }
            _ => {
                strips.push(vec![from, to]);
                colors.push(color);
            }
        }
    }
    let path =
        LineStrips3D::new(strips).with_colors(colors).with_radii([Radius::new_ui_points(1.5)]);
    stream.log_static(entity.join(&"trajectory".into()), &path)?;
    let body = entity.join(&"body".into());
    stream.log_static(body.clone(), &TransformAxes3D::new(AXES_LENGTH))?;
    let transforms = Transform3D::update_fields()
        .with_many_translation(poses.iter().map(position))
        .with_many_quaternion(poses.iter().map(|pose| scene::quaternion(&pose.rotation)));
    stream.send_columns(body, [time_column(stamps)], transforms.columns_of_unit_batches()?)
}

fn time_column(seconds: &[f64]) -> TimeColumn {
    let stamps: Vec<Stamp> =
        seconds.iter().map(|t| Stamp::from_seconds(*t).unwrap_or_default()).collect();
    Clock::of(stamps.first().copied().unwrap_or_default()).column(&stamps)
}
