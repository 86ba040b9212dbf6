//! Values that several of the commands take.

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::{Args, ValueEnum};
use mfg_vio::evaluation::{
    self, Alignment, AssociationOptions, AssociationRule, Relation, Trajectory, TrajectoryFile,
    TrajectoryFormat,
};

#[derive(Debug, Args)]
pub(super) struct Matching {
    /// Align over the first N matched poses only
    #[arg(long, value_name = "N")]
    pub(super) align_n: Option<NonZeroUsize>,
    /// Largest time difference of poses that are compared, s
    #[arg(long, value_name = "S", default_value_t = 0.01, value_parser = non_negative)]
    pub(super) max_diff: f64,
    /// Which pose is compared with which
    #[arg(long, value_enum, default_value = "nearest")]
    pub(super) association: AssociationArg,
    /// Added to the stamps of the estimate, s; auto: found from angular rates, for absolute errors
    /// of position the offset of least error within 0.2 s of that
    #[arg(
        long,
        value_name = "S|auto",
        default_value = "0",
        allow_negative_numbers = true,
        value_parser = time_offset
    )]
    pub(super) time_offset: TimeOffset,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub(super) enum AlignArg {
    /// Rotation and translation
    Se3,
    /// Rotation, translation and scale
    Sim3,
    /// Heading and translation
    Yaw,
    /// First pose on first pose
    Origin,
    /// Nothing
    None,
}

impl From<AlignArg> for Alignment {
    fn from(value: AlignArg) -> Self {
        match value {
            AlignArg::Se3 => Self::Se3,
            AlignArg::Sim3 => Self::Sim3,
            AlignArg::Yaw => Self::Yaw,
            AlignArg::Origin => Self::Origin,
            AlignArg::None => Self::None,
        }
    }
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub(super) enum RelationArg {
    Trans,
    Angle,
}

impl From<RelationArg> for Relation {
    fn from(value: RelationArg) -> Self {
        match value {
            RelationArg::Trans => Self::Translation,
            RelationArg::Angle => Self::Angle,
        }
    }
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub(super) enum AssociationArg {
    /// With the nearest in time, as evo does
    Nearest,
    /// With the nearest that no earlier pose has taken, as OpenVINS does
    Openvins,
}

impl From<AssociationArg> for AssociationRule {
    fn from(value: AssociationArg) -> Self {
        match value {
            AssociationArg::Nearest => Self::Nearest,
            AssociationArg::Openvins => Self::OpenVins,
        }
    }
}

#[derive(Debug, Clone, Copy)]
pub(super) enum TimeOffset {
    Fixed(f64),
    Auto,
}

pub(super) fn time_offset(text: &str) -> Result<TimeOffset, String> {
    if text == "auto" { Ok(TimeOffset::Auto) } else { finite(text).map(TimeOffset::Fixed) }
}

pub(super) fn finite(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        _ => Err("not a finite number".to_owned()),
    }
}

pub(super) fn non_negative(text: &str) -> Result<f64, String> {
    finite(text).and_then(|x| if x >= 0.0 { Ok(x) } else { Err("must not be negative".to_owned()) })
}

pub(super) fn positive(text: &str) -> Result<f64, String> {
    finite(text).and_then(|x| if x > 0.0 { Ok(x) } else { Err("must be above 0".to_owned()) })
}

pub(super) fn plot_file(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
    match extension.as_deref() {
        Some("svg" | "png") => Ok(path),
        _ => Err("a plot is saved as .svg or .png".to_owned()),
    }
}

impl Matching {
    pub(super) fn association(
        &self,
        path: &Path,
        reference: &TrajectoryFile,
        estimate: &TrajectoryFile,
    ) -> anyhow::Result<AssociationOptions> {
        let without_stamps = estimate.format == TrajectoryFormat::Kitti;
        if without_stamps && matches!(self.time_offset, TimeOffset::Auto) {
            bail!("{}: KITTI poses have no stamps to find --time-offset from", path.display());
        }
        self.options(path, &reference.trajectory, &estimate.trajectory)
    }

    /// Whether the clock offset is to be found.
    pub(super) fn seeks_offset(&self) -> bool {
        matches!(self.time_offset, TimeOffset::Auto)
    }

    pub(super) fn options(
        &self,
        path: &Path,
        reference: &Trajectory,
        estimate: &Trajectory,
    ) -> anyhow::Result<AssociationOptions> {
        let time_offset = match self.time_offset {
            TimeOffset::Fixed(seconds) => seconds,
            TimeOffset::Auto => {
                evaluation::estimate_clock_offset(reference, estimate)
                    .with_context(|| path.display().to_string())?
                    .seconds
            }
        };
        Ok(AssociationOptions {
            rule: self.association.into(),
            max_diff: self.max_diff,
            time_offset,
        })
    }
}
