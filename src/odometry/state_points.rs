//! Which map points the filter's state holds.

use crate::filter::{Candidate, FilterConfig, PointObservation, PointState, choose_points};
use crate::map::Map;

/// Renews the points of the state at the end of a frame, `seen` being the points of the map that
/// were measured in it: held points that have not been seen for long make room for better ones,
/// of which those are chosen that say most about the pose. The map follows the state.
pub fn renew_state_points(
    points: &mut dyn PointState,
    map: &mut Map,
    seen: &[PointObservation],
    frame: u64,
    config: &FilterConfig,
) {
    let held = points.ids();
    let tested = |point: &&PointObservation| {
        map.get(point.id).is_some_and(|p| p.observations >= config.state_min_observations)
    };
    let fresh = seen.iter().filter(|point| !held.contains(&point.id));
    // Points that have proven themselves go first; others only where room is left.
    let (first, rest): (Vec<_>, Vec<_>) = fresh.partition(tested);

    let mut unseen: Vec<_> = held
        .iter()
        .filter_map(|&id| Some((map.get(id)?.last_seen, id)))
        .filter(|(last_seen, _)| last_seen + config.state_max_unseen_frames < frame)
        .collect();
    unseen.sort_unstable();
    let excess = first.len().saturating_sub(points.free_slots());
    for (_, id) in unseen.into_iter().take(excess) {
        points.release(id);
        map.hold(id, false);
    }

    for group in [first, rest] {
        let in_use: Vec<_> = seen
            .iter()
            .filter(|point| points.estimate(point.id).is_some())
            .map(candidate)
            .collect();
        let candidates: Vec<_> = group.iter().map(candidate).collect();
        for index in choose_points(&in_use, &candidates, points.free_slots()) {
            if points.admit(&group[index]) {
                map.hold(group[index].id, true);
            }
        }
    }
    follow(points, map);
}

/// Moves the points of the map to where the state has them.
fn follow(points: &mut dyn PointState, map: &mut Map) {
    for id in points.ids() {
        if let Some(estimate) = points.estimate(id) {
            map.relocate(id, estimate.position, estimate.covariance);
        }
    }
}

fn candidate(point: &PointObservation) -> Candidate {
    Candidate { in_body: point.in_body, body_covariance: point.body_covariance }
}
