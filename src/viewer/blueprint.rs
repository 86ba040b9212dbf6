//! How a recording opens in the viewer: one tab for each purpose.

use rerun::RecordingStream;
use rerun::RecordingStreamResult;
use rerun::datatypes;
use rerun::external::re_sdk_types::blueprint::archetypes::{
    Background, EyeControls3D, LineGrid3D, PlotLegend, TextLogColumns, TimeAxis, VisualBounds2D,
};
use rerun::external::re_sdk_types::blueprint::components::{
    BackgroundKind, ContainerKind, Corner2D, TimeRange, VisibleTimeRange,
};
use rerun::external::re_sdk_types::blueprint::datatypes::{
    TextLogColumn, TextLogColumnKind, TimelineColumn,
};
use rerun::external::re_sdk_types::blueprint::views::{
    Spatial2DView, Spatial3DView, TextLogView, TimeSeriesView,
};

use super::layout::{self, Layout, Node};
use super::plots::{self, Plot, Tab};
use super::timeline::{FRAME, TIME};
use super::{Contents, MapColor, Purpose, RecordingConfig};
use super::{belief, keypoints, map, scene};

const BACKGROUND: [u8; 3] = [18, 20, 26];
/// How far back the tracks of key points are shown, in time and in frames.
const TRACK_NANOS: i64 = 250_000_000;
const TRACK_FRAMES: i64 = 8;

/// Makes the layout part of the recording, as the one to open with.
pub(super) fn send(
    stream: &RecordingStream,
    application: &'static str,
    contents: &Contents,
    config: &RecordingConfig,
) -> RecordingStreamResult<()> {
    layout::send(stream, application, &contents.name, |layout| {
        let mut pages = Vec::new();
        for purpose in Purpose::ALL {
            pages.push(match purpose {
                Purpose::Overview => layout.overview(contents, config.map_color)?,
                Purpose::Uncertainty => layout.uncertainty(contents, config.map_color)?,
                Purpose::Timing => layout.timing()?,
            });
        }
        let active = Purpose::ALL.iter().position(|purpose| *purpose == config.blueprint);
        layout.tabs("mfg-vio", &pages, active.unwrap_or(0))
    })
}

impl Layout {
    fn overview(&mut self, contents: &Contents, color: MapColor) -> RecordingStreamResult<Node> {
        let world = self.world(color)?;
        self.hide(&world, map::ELLIPSOIDS)?;
        let camera = self.camera()?;
        let depth =
            self.view::<Spatial2DView>("Depth", scene::IMAGE, &[format!("+ {}", scene::DEPTH)])?;
        let images =
            self.container(ContainerKind::Vertical, "Images", &[(camera, 1.2), (depth, 1.0)])?;
        let spatial =
            self.container(ContainerKind::Horizontal, "Space", &[(world, 3.0), (images, 2.0)])?;

        let truth = contents.truth.then_some(&plots::ERROR);
        let imu = contents.imu.then_some(&plots::IMU);
        let always = [&plots::UNCERTAINTY, &plots::BELIEF, &plots::TRACKING, &plots::STATE];
        let mut tabs = Vec::new();
        for tab in truth.into_iter().chain(always).chain(imu).chain([&plots::TIMES]) {
            tabs.push(self.tab(tab)?);
        }
        let plots = self.tabs("Plots", &tabs, 0)?;
        let log = self.log_view()?;
        let below = [(plots, 3.0), (log, 1.0)];
        let below = self.container(ContainerKind::Horizontal, "Plots and log", &below)?;
        let rows = [(spatial, 5.0), (below, 3.0)];
        self.container(ContainerKind::Vertical, Purpose::Overview.title(), &rows)
    }

    fn uncertainty(&mut self, contents: &Contents, color: MapColor) -> RecordingStreamResult<Node> {
        let attitude = self.attitude()?;
        let correlation = self.correlation()?;
        let world = self.world(color)?;
        let above = [(attitude, 3.0), (correlation, 2.0), (world, 4.0)];
        let above = self.container(ContainerKind::Horizontal, "Belief", &above)?;
        let truth = contents.truth.then_some(&plots::ERROR);
        let mut rows = vec![(above, 2.0)];
        for tab in truth.into_iter().chain([&plots::UNCERTAINTY]) {
            rows.push((self.tab(tab)?, 1.0));
        }
        let belief = self.tab(&plots::BELIEF)?;
        let state = self.tab(&plots::STATE)?;
        rows.push((self.tabs("Belief and state", &[belief, state], 0)?, 1.1));
        self.container(ContainerKind::Vertical, Purpose::Uncertainty.title(), &rows)
    }

    fn timing(&mut self) -> RecordingStreamResult<Node> {
        let times = self.tab(&plots::TIMES)?;
        let tracking = self.tab(&plots::TRACKING)?;
        let camera = self.camera()?;
        let log = self.log_view()?;
        let below = [(tracking, 4.0), (camera, 2.0), (log, 2.0)];
        let below = self.container(ContainerKind::Horizontal, "Work", &below)?;
        let rows = [(times, 1.2), (below, 1.0)];
        self.container(ContainerKind::Vertical, Purpose::Timing.title(), &rows)
    }

    fn world(&mut self, color: MapColor) -> RecordingStreamResult<Node> {
        // Depth is recorded less often than poses: in space it would trail behind the camera.
        let world = self.view::<Spatial3DView>(
            &format!("World: estimate orange, truth blue; {}", color.legend()),
            scene::WORLD,
            &[
                "+ $origin/**".to_owned(),
                format!("- {}", scene::DEPTH),
                format!("- {}/**", scene::KEYPOINTS),
            ],
        )?;
        self.property(&world, &background())?;
        self.property(&world, &LineGrid3D::new().with_visible(true))?;
        // By itself the eye takes in the whole map, and a few far points of it leave the body outside.
        let eye = EyeControls3D::new().with_tracking_entity(scene::ESTIMATE_BODY);
        self.property(&world, &eye)?;
        for trajectory in scene::TRAJECTORIES {
            self.time_ranges(&world, trajectory, [TIME, FRAME].map(up_to_cursor))?;
        }
        Ok(world)
    }

    fn camera(&mut self) -> RecordingStreamResult<Node> {
        let camera = self.view::<Spatial2DView>(
            "Camera: inliers green, outliers red, new blue, others grey; tracks yellow",
            scene::IMAGE,
            &["+ $origin/**".to_owned(), format!("- {}", scene::DEPTH)],
        )?;
        let ranges = [(TIME, TRACK_NANOS), (FRAME, TRACK_FRAMES)];
        self.time_ranges(&camera, keypoints::TRACKS, ranges.map(|(t, back)| recent(t, back)))?;
        Ok(camera)
    }

    fn attitude(&mut self) -> RecordingStreamResult<Node> {
        let sphere = self.view::<Spatial3DView>(
            "Where the body axes x, y, z may point (at least 3° wide); truth white",
            belief::ATTITUDE,
            &["+ $origin/**".to_owned()],
        )?;
        self.property(&sphere, &background())?;
        self.property(&sphere, &LineGrid3D::new().with_visible(false))?;
        let eye = EyeControls3D::new()
            .with_position([2.6, 2.0, 1.5])
            .with_look_target([0.0, 0.0, 0.0])
            .with_eye_up([0.0, 0.0, 1.0]);
        self.property(&sphere, &eye)?;
        Ok(sphere)
    }

    fn correlation(&mut self) -> RecordingStreamResult<Node> {
        let correlation = self.view::<Spatial2DView>(
            "Correlation of rotation φ and position: −1 blue, +1 red",
            belief::CORRELATION,
            &["+ $origin/**".to_owned()],
        )?;
        let range = datatypes::Range2D { x_range: [-1.2, 6.2].into(), y_range: [-1.0, 6.2].into() };
        self.property(&correlation, &VisualBounds2D::new(range))?;
        Ok(correlation)
    }

    fn log_view(&mut self) -> RecordingStreamResult<Node> {
        let log = self.view::<TextLogView>("Log", scene::LOG, &["+ $origin/**".to_owned()])?;
        // Not the entity's path, which is always the same.
        let columns = [TextLogColumnKind::LogLevel, TextLogColumnKind::Body];
        let columns = columns.map(|kind| TextLogColumn { visible: true.into(), kind });
        let frame = TimelineColumn { visible: true.into(), timeline: FRAME.into() };
        let columns =
            TextLogColumns::new().with_timeline_columns([frame]).with_text_log_columns(columns);
        self.property(&log, &columns)?;
        Ok(log)
    }

    fn tab(&mut self, tab: &Tab) -> RecordingStreamResult<Node> {
        let plots: Vec<(Node, f32)> = tab
            .plots
            .iter()
            .map(|plot| Ok((self.plot(plot)?, 1.0)))
            .collect::<RecordingStreamResult<_>>()?;
        self.container(ContainerKind::Horizontal, tab.name, &plots)
    }

    fn plot(&mut self, plot: &Plot) -> RecordingStreamResult<Node> {
        self.time_series(plot.title, plot.entity, &["+ $origin".to_owned()])
    }

    /// A plot over the whole time.
    pub(super) fn time_series(
        &mut self,
        title: &str,
        origin: &str,
        contents: &[String],
    ) -> RecordingStreamResult<Node> {
        let view = self.view::<TimeSeriesView>(title, origin, contents)?;
        let whole = TimeRange(datatypes::TimeRange::EVERYTHING);
        self.property(&view, &TimeAxis::new().with_view_range(whole))?;
        self.property(&view, &PlotLegend::new().with_corner(Corner2D::LeftTop))?;
        Ok(view)
    }
}

impl Purpose {
    fn title(self) -> &'static str {
        match self {
            Self::Overview => "Overview",
            Self::Uncertainty => "Uncertainty",
            Self::Timing => "Timing",
        }
    }
}

pub(super) fn background() -> Background {
    Background::new(BackgroundKind::SolidColor).with_color(BACKGROUND)
}

/// All that was logged until the time that the viewer shows.
fn up_to_cursor(timeline: &str) -> VisibleTimeRange {
    visible(timeline, datatypes::TimeRangeBoundary::Infinite)
}

/// What was logged within `back` before the time that the viewer shows.
fn recent(timeline: &str, back: i64) -> VisibleTimeRange {
    visible(timeline, datatypes::TimeRangeBoundary::CursorRelative(datatypes::TimeInt(-back)))
}

fn visible(timeline: &str, start: datatypes::TimeRangeBoundary) -> VisibleTimeRange {
    let end = datatypes::TimeRangeBoundary::CursorRelative(datatypes::TimeInt(0));
    VisibleTimeRange(datatypes::VisibleTimeRange {
        timeline: timeline.into(),
        range: datatypes::TimeRange { start, end },
    })
}
