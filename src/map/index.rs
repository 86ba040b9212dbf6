use std::sync::OnceLock;

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::Vector3;

use super::point::MapPoint;

/// Radius queries over the points of a map, by a k-d tree that is built when it is first asked
/// after a change.
///
/// The tree is rebuilt whole: updates move nearly all points in view every frame, and kiddo's
/// mutable tree refuses more than 32 points that share a coordinate, as points on a wall do.
#[derive(Debug, Default)]
pub(super) struct SpatialIndex {
    tree: OnceLock<Option<Box<ImmutableKdTree<f64, 3>>>>,
}

impl SpatialIndex {
    /// To be called whenever a point was added, moved or removed.
    pub fn invalidate(&mut self) {
        self.tree.take();
    }

    /// Slots, in no useful order, of the points within `radius` (m) of `centre`.
    pub fn within(&self, points: &[MapPoint], centre: &Vector3<f64>, radius: f64) -> Vec<usize> {
        if !(radius >= 0.0 && centre.iter().all(|x| x.is_finite())) {
            return vec![];
        }
        let tree = self.tree.get_or_init(|| {
            let positions: Vec<[f64; 3]> = points.iter().map(|p| p.position.into()).collect();
            ImmutableKdTree::new_from_slice(&positions).ok().map(Box::new)
        });
        let Some(tree) = tree else { return (0..points.len()).collect() };
        let centre: [f64; 3] = (*centre).into();
        let query = tree.query(&centre).within::<SquaredEuclidean<f64>>(radius * radius);
        query.unsorted().execute().iter().map(|found| found.item as usize).collect()
    }
}
