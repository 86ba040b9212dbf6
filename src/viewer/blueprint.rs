//! How a recording opens in the viewer: the world on the left, the camera on the right, plots in
//! tabs and the log below.
//!
//! Written by hand, because Rerun's own builder knows neither time ranges of single entities nor
//! properties of plots, and draws its identifiers at random.

use rerun::external::re_log_types::{BlueprintActivationCommand, StoreId, StoreKind};
use rerun::external::re_sdk_types::View;
use rerun::external::re_sdk_types::blueprint::archetypes::{
    Background, ContainerBlueprint, LineGrid3D, PanelBlueprint, PlotLegend, TextLogColumns,
    TimeAxis, TimePanelBlueprint, ViewBlueprint, ViewContents, ViewportBlueprint,
    VisibleTimeRanges,
};
use rerun::external::re_sdk_types::blueprint::components::{
    BackgroundKind, ContainerKind, Corner2D, PanelState, PlayState, TimeRange, VisibleTimeRange,
};
use rerun::external::re_sdk_types::blueprint::datatypes::{
    TextLogColumn, TextLogColumnKind, TimelineColumn,
};
use rerun::external::re_sdk_types::blueprint::views::{
    Spatial2DView, Spatial3DView, TextLogView, TimeSeriesView,
};
use rerun::external::uuid::Uuid;
use rerun::{
    Archetype, AsComponents, RecordingStream, RecordingStreamBuilder, RecordingStreamResult,
    datatypes,
};

use super::Contents;
use super::plots::{self, Plot, Tab};
use super::scene;
use super::timeline::{FRAME, TIME};

const BACKGROUND: [u8; 3] = [18, 20, 26];

/// Makes the layout part of the recording, as the one to open with.
pub(super) fn send(
    stream: &RecordingStream,
    application: &'static str,
    contents: &Contents,
) -> RecordingStreamResult<()> {
    let id = StoreId::new(StoreKind::Blueprint, application, contents.name.as_str());
    let (blueprint, storage) = RecordingStreamBuilder::from_store_id(&id).enabled(true).memory()?;
    blueprint.set_log_time_enabled(false);
    blueprint.set_time_sequence("blueprint", 0);
    Layout { stream: blueprint, nodes: 0 }.log(contents)?;
    let activation =
        BlueprintActivationCommand { blueprint_id: id, make_active: true, make_default: true };
    stream.send_blueprint(storage.take(), activation);
    Ok(())
}

struct Layout {
    stream: RecordingStream,
    nodes: u128,
}

/// A view or container that has been written.
struct Node {
    id: Uuid,
    path: String,
}

impl Layout {
    fn log(mut self, contents: &Contents) -> RecordingStreamResult<()> {
        let world = self.world()?;
        let camera = self.view::<Spatial2DView>(
            "Camera: inliers green, outliers red, new blue, others grey",
            scene::IMAGE,
            &["+ $origin/**".to_owned(), format!("- {}", scene::DEPTH)],
        )?;
        let depth =
            self.view::<Spatial2DView>("Depth", scene::IMAGE, &[format!("+ {}", scene::DEPTH)])?;
        let images =
            self.container(ContainerKind::Vertical, "Images", &[(camera, 1.2), (depth, 1.0)])?;
        let spatial =
            self.container(ContainerKind::Horizontal, "Space", &[(world, 3.0), (images, 2.0)])?;

        let mut tabs = Vec::new();
        if contents.truth {
            tabs.push((self.tab(&plots::ERROR)?, 1.0));
        }
        for tab in [&plots::UNCERTAINTY, &plots::BELIEF, &plots::TRACKING, &plots::STATE] {
            tabs.push((self.tab(tab)?, 1.0));
        }
        if contents.imu {
            tabs.push((self.tab(&plots::IMU)?, 1.0));
        }
        tabs.push((self.tab(&plots::TIMES)?, 1.0));
        let plots = self.container(ContainerKind::Tabs, "Plots", &tabs)?;
        let log = self.log_view()?;
        let below = self.container(
            ContainerKind::Horizontal,
            "Plots and log",
            &[(plots, 3.0), (log, 1.0)],
        )?;

        let root =
            self.container(ContainerKind::Vertical, "mfg-vio", &[(spatial, 5.0), (below, 3.0)])?;
        let viewport = ViewportBlueprint::new()
            .with_root_container(root.id)
            .with_auto_layout(false)
            .with_auto_views(false);
        self.stream.log("viewport", &viewport)?;
        for panel in ["blueprint_panel", "selection_panel"] {
            self.stream.log(panel, &PanelBlueprint::new().with_state(PanelState::Collapsed))?;
        }
        // At the end of a file the whole run is in sight; a live view keeps up.
        let time_panel = TimePanelBlueprint::new()
            .with_state(PanelState::Collapsed)
            .with_timeline(TIME)
            .with_play_state(PlayState::Following);
        self.stream.log("time_panel", &time_panel)
    }

    fn world(&mut self) -> RecordingStreamResult<Node> {
        // Depth is recorded less often than poses: in space it would trail behind the camera.
        let world = self.view::<Spatial3DView>(
            "World: estimate orange, truth blue; map by σ from 3 mm (green) to 0.3 m (magenta)",
            scene::WORLD,
            &[
                "+ $origin/**".to_owned(),
                format!("- {}", scene::DEPTH),
                format!("- {}/**", scene::KEYPOINTS),
            ],
        )?;
        self.property(&world, &Background::new(BackgroundKind::SolidColor).with_color(BACKGROUND))?;
        self.property(&world, &LineGrid3D::new().with_visible(true))?;
        for trajectory in scene::TRAJECTORIES {
            let path = ViewContents::blueprint_base_visualizer_path_for_entity(
                world.id,
                &trajectory.into(),
            );
            self.stream.log(path, &VisibleTimeRanges::new([TIME, FRAME].map(up_to_cursor)))?;
        }
        Ok(world)
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
        let view =
            self.view::<TimeSeriesView>(plot.title, plot.entity, &["+ $origin".to_owned()])?;
        let whole = TimeRange(datatypes::TimeRange::EVERYTHING);
        self.property(&view, &TimeAxis::new().with_view_range(whole))?;
        self.property(&view, &PlotLegend::new().with_corner(Corner2D::LeftTop))?;
        Ok(view)
    }

    fn view<V: View>(
        &mut self,
        name: &str,
        origin: &str,
        contents: &[String],
    ) -> RecordingStreamResult<Node> {
        let node = self.node("view");
        let view = ViewBlueprint::new(V::identifier().as_str())
            .with_display_name(name)
            .with_space_origin(origin);
        self.stream.log(node.path.as_str(), &view)?;
        self.property(&node, &ViewContents::new(contents.iter().map(String::as_str)))?;
        Ok(node)
    }

    /// Sets a property of a view.
    fn property<T: Archetype + AsComponents>(
        &self,
        view: &Node,
        property: &T,
    ) -> RecordingStreamResult<()> {
        self.stream.log(format!("{}/{}", view.path, T::name().short_name()), property)
    }

    /// A container of nodes, each with its share of the space.
    fn container(
        &mut self,
        kind: ContainerKind,
        name: &str,
        children: &[(Node, f32)],
    ) -> RecordingStreamResult<Node> {
        let node = self.node("container");
        let shares = children.iter().map(|(_, share)| *share);
        let container = ContainerBlueprint::new(kind)
            .with_display_name(name)
            .with_contents(children.iter().map(|(child, _)| child.path.as_str()));
        let container = match kind {
            ContainerKind::Horizontal => container.with_col_shares(shares),
            ContainerKind::Vertical => container.with_row_shares(shares),
            ContainerKind::Tabs | ContainerKind::Grid => container,
        };
        self.stream.log(node.path.as_str(), &container)?;
        Ok(node)
    }

    fn node(&mut self, kind: &str) -> Node {
        self.nodes += 1;
        let id = Uuid::from_u128(self.nodes);
        Node { id, path: format!("{kind}/{id}") }
    }
}

/// All that was logged until the time that the viewer shows.
fn up_to_cursor(timeline: &str) -> VisibleTimeRange {
    VisibleTimeRange(datatypes::VisibleTimeRange {
        timeline: timeline.into(),
        range: datatypes::TimeRange {
            start: datatypes::TimeRangeBoundary::Infinite,
            end: datatypes::TimeRangeBoundary::CursorRelative(datatypes::TimeInt(0)),
        },
    })
}
