//! Where sensors are on a body: transforms between frames, from `/tf_static` and `/tf`.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use nalgebra::{Isometry3, Vector3};

use crate::dataset::message::{Fields, isometry};
use crate::dataset::pixels::Rejection;

/// A transform that changes by more than this (m, rad) is a joint or a pose, not a mounting.
const STILL: f64 = 1e-6;

/// Most transforms that a message may claim to have.
const MOST_TRANSFORMS: u32 = 10_000;

/// A frame and the one that it is mounted on.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::dataset) struct Transform {
    pub parent: String,
    pub child: String,
    pub parent_from_child: Isometry3<f64>,
}

/// The transforms of a `tf2_msgs/TFMessage`.
pub(in crate::dataset) fn transforms(mut fields: Fields) -> Result<Vec<Transform>, Rejection> {
    let count = fields.u32()?;
    if count > MOST_TRANSFORMS {
        return Err(Rejection::new("absurd size", format!("{count} transforms")));
    }
    (0..count).map(|_| transform(&mut fields)).collect()
}

fn transform(fields: &mut Fields) -> Result<Transform, Rejection> {
    let (_, parent) = fields.header_and_frame()?;
    let child = fields.text()?;
    let translation = Vector3::from(fields.f64s::<3>()?);
    let parent_from_child = isometry(translation, fields.f64s()?)?;
    Ok(Transform { parent: frame(parent), child: frame(child), parent_from_child })
}

/// Name of a frame without the slash that old drivers put before it.
pub(in crate::dataset) fn frame(name: &str) -> String {
    name.trim_start_matches('/').to_owned()
}

/// Frames and the fixed transforms between them.
#[derive(Debug, Clone, Default)]
pub(in crate::dataset) struct TransformTree {
    /// By child and parent. A frame has one parent, but whoever sends the poses of a body may give
    /// it another one beside the mount that it is fixed to.
    edges: BTreeMap<(String, String), Edge>,
}

#[derive(Debug, Clone)]
struct Edge {
    parent_from_child: Isometry3<f64>,
    moves: bool,
}

impl TransformTree {
    /// Notes a transform; one that was seen to be different before is no mounting.
    pub fn add(&mut self, transform: Transform) {
        let Transform { parent, child, parent_from_child } = transform;
        let first = Edge { parent_from_child, moves: false };
        let edge = self.edges.entry((child, parent)).or_insert(first);
        let change = edge.parent_from_child.inv_mul(&parent_from_child);
        let size = change.translation.vector.norm().max(change.rotation.angle());
        edge.moves |= size > STILL;
    }

    /// Whether a frame is named anywhere.
    pub fn knows(&self, name: &str) -> bool {
        self.edges.keys().any(|(child, parent)| child == name || parent == name)
    }

    pub fn frames(&self) -> BTreeSet<&str> {
        self.edges.keys().flat_map(|(child, parent)| [child.as_str(), parent.as_str()]).collect()
    }

    /// The transform that takes coordinates of `source` to those of `target`, through what does
    /// not move; `None` if they are not connected so. Time and memory grow with the number of
    /// frames.
    pub fn between(&self, target: &str, source: &str) -> Option<Isometry3<f64>> {
        if !(self.knows(source) && self.knows(target)) {
            return None;
        }
        let mut seen = BTreeSet::from([source]);
        let mut waiting = VecDeque::from([(source, Isometry3::identity())]);
        while let Some((name, here_from_source)) = waiting.pop_front() {
            if name == target {
                return Some(here_from_source);
            }
            for (next, next_from_here) in self.neighbours(name) {
                if seen.insert(next) {
                    waiting.push_back((next, next_from_here * here_from_source));
                }
            }
        }
        None
    }

    fn neighbours<'a>(&'a self, name: &'a str) -> Vec<(&'a str, Isometry3<f64>)> {
        let fixed = || self.edges.iter().filter(|(_, edge)| !edge.moves);
        let up = fixed()
            .filter(|((child, _), _)| child == name)
            .map(|((_, parent), edge)| (parent.as_str(), edge.parent_from_child));
        let down = fixed()
            .filter(|((_, parent), _)| parent == name)
            .map(|((child, _), edge)| (child.as_str(), edge.parent_from_child.inverse()));
        up.chain(down).collect()
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;

    use super::*;

    fn edge(parent: &str, child: &str, x: f64, yaw: f64) -> Transform {
        let rotation = UnitQuaternion::from_euler_angles(0.0, 0.0, yaw);
        let parent_from_child = Isometry3::from_parts(Vector3::new(x, 0.0, 0.0).into(), rotation);
        Transform { parent: parent.to_owned(), child: child.to_owned(), parent_from_child }
    }

    #[test]
    fn paths_go_up_and_down_the_tree() {
        let mut tree = TransformTree::default();
        let quarter = std::f64::consts::FRAC_PI_2;
        for (parent, child, x, yaw) in [
            ("link", "color", 0.1, 0.0),
            ("color", "optical", 0.0, quarter),
            ("link", "imu", 0.3, 0.0),
        ] {
            tree.add(edge(parent, child, x, yaw));
        }
        let found = tree.between("imu", "optical").unwrap();
        // The optical x axis is the link's y axis; its origin is 0.2 m behind the IMU.
        let point = found * nalgebra::Point3::new(1.0, 0.0, 0.0);
        assert!((point.coords - Vector3::new(-0.2, 1.0, 0.0)).norm() < 1e-12, "{point}");
        let back = tree.between("optical", "imu").unwrap();
        assert!((back * found).translation.vector.norm() < 1e-12);
        assert!(tree.between("imu", "elsewhere").is_none());
    }

    #[test]
    fn what_moves_is_no_mounting() {
        let mut tree = TransformTree::default();
        tree.add(edge("world", "imu", 0.0, 0.0));
        tree.add(edge("world", "camera", 0.0, 0.0));
        assert!(tree.between("imu", "camera").is_some());
        tree.add(edge("world", "imu", 0.5, 0.0));
        assert!(tree.between("imu", "camera").is_none());
    }

    /// The simulator's logs have it: poses of the IMU in the world beside the tree of the device.
    #[test]
    fn poses_of_a_body_do_not_take_it_off_its_mount() {
        let mut tree = TransformTree::default();
        tree.add(edge("link", "imu", 0.3, 0.0));
        tree.add(edge("link", "camera", 0.1, 0.0));
        tree.add(edge("world", "imu", 0.0, 0.0));
        tree.add(edge("world", "imu", 0.5, 0.0));
        let found = tree.between("imu", "camera").unwrap();
        assert!((found.translation.vector.x + 0.2).abs() < 1e-12, "{found}");
        assert!(tree.between("world", "camera").is_none());
    }
}
