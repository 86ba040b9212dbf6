//! Views and containers of a blueprint, written by hand: Rerun's own builder knows neither time
//! ranges of single entities nor properties of plots, and draws its identifiers at random.

use rerun::external::re_log_types::{BlueprintActivationCommand, EntityPath, StoreId, StoreKind};
use rerun::external::re_sdk_types::View;
use rerun::external::re_sdk_types::blueprint::archetypes::{
    ContainerBlueprint, EntityBehavior, PanelBlueprint, TimePanelBlueprint, ViewBlueprint,
    ViewContents, ViewportBlueprint, VisibleTimeRanges,
};
use rerun::external::re_sdk_types::blueprint::components::{
    ContainerKind, PanelState, PlayState, VisibleTimeRange,
};
use rerun::external::uuid::Uuid;
use rerun::{
    Archetype, AsComponents, RecordingStream, RecordingStreamBuilder, RecordingStreamResult,
};

use super::timeline::TIME;

/// A blueprint that is being written.
pub(super) struct Layout {
    stream: RecordingStream,
    nodes: u128,
}

/// A view or container that has been written.
pub(super) struct Node {
    id: Uuid,
    path: String,
}

/// Makes what `build` lays out part of the recording `name`, as the layout to open with; it
/// returns the outermost container.
pub(super) fn send(
    stream: &RecordingStream,
    application: &'static str,
    name: &str,
    build: impl FnOnce(&mut Layout) -> RecordingStreamResult<Node>,
) -> RecordingStreamResult<()> {
    let id = StoreId::new(StoreKind::Blueprint, application, name);
    let (blueprint, storage) = RecordingStreamBuilder::from_store_id(&id).enabled(true).memory()?;
    blueprint.set_log_time_enabled(false);
    blueprint.set_time_sequence("blueprint", 0);
    let mut layout = Layout { stream: blueprint, nodes: 0 };
    let root = build(&mut layout)?;
    layout.finish(&root)?;
    let activation =
        BlueprintActivationCommand { blueprint_id: id, make_active: true, make_default: true };
    stream.send_blueprint(storage.take(), activation);
    Ok(())
}

impl Layout {
    fn finish(self, root: &Node) -> RecordingStreamResult<()> {
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

    /// A view of the entities that `contents` selects, in the space of `origin`.
    pub(super) fn view<V: View>(
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
    pub(super) fn property<T: Archetype + AsComponents>(
        &self,
        view: &Node,
        property: &T,
    ) -> RecordingStreamResult<()> {
        self.stream.log(format!("{}/{}", view.path, T::name().short_name()), property)
    }

    /// Shows an entity over ranges of time.
    pub(super) fn time_ranges(
        &self,
        view: &Node,
        entity: &str,
        ranges: [VisibleTimeRange; 2],
    ) -> RecordingStreamResult<()> {
        let path = ViewContents::blueprint_base_visualizer_path_for_entity(view.id, &entity.into());
        self.stream.log(path, &VisibleTimeRanges::new(ranges))
    }

    /// Leaves an entity and all below it to be switched on by the user.
    pub(super) fn hide(&self, view: &Node, entity: &str) -> RecordingStreamResult<()> {
        let overrides = format!("{}/{}/overrides", view.path, ViewContents::name().short_name());
        let path = EntityPath::from(overrides).join(&entity.into());
        self.stream.log(path, &EntityBehavior::new().with_visible(false))
    }

    /// A container of nodes, each with its share of the space.
    pub(super) fn container(
        &mut self,
        kind: ContainerKind,
        name: &str,
        children: &[(Node, f32)],
    ) -> RecordingStreamResult<Node> {
        let shares = children.iter().map(|(_, share)| *share);
        let container = ContainerBlueprint::new(kind)
            .with_display_name(name)
            .with_contents(children.iter().map(|(child, _)| child.path.as_str()));
        self.add(&match kind {
            ContainerKind::Horizontal => container.with_col_shares(shares),
            ContainerKind::Vertical => container.with_row_shares(shares),
            ContainerKind::Tabs | ContainerKind::Grid => container,
        })
    }

    /// Nodes on top of each other, the one at `active` in front.
    pub(super) fn tabs(
        &mut self,
        name: &str,
        children: &[Node],
        active: usize,
    ) -> RecordingStreamResult<Node> {
        let container = ContainerBlueprint::new(ContainerKind::Tabs)
            .with_display_name(name)
            .with_contents(children.iter().map(|child| child.path.as_str()));
        self.add(&match children.get(active) {
            Some(child) => container.with_active_tab(child.path.as_str()),
            None => container,
        })
    }

    fn add(&mut self, container: &ContainerBlueprint) -> RecordingStreamResult<Node> {
        let node = self.node("container");
        self.stream.log(node.path.as_str(), container)?;
        Ok(node)
    }

    fn node(&mut self, kind: &str) -> Node {
        self.nodes += 1;
        let id = Uuid::from_u128(self.nodes);
        Node { id, path: format!("{kind}/{id}") }
    }
}
