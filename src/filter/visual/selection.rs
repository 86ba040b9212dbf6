//! Which points are worth a place in the state.

use nalgebra::{Matrix3, Matrix6, SMatrix, Vector3};

use super::map_points::point_by_pose;

/// A point in view, as far as its worth goes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// Body coordinates, m.
    pub in_body: Vector3<f64>,
    /// Body coordinates, m^2.
    pub body_covariance: Matrix3<f64>,
}

/// Spread that the body's pose is given before any point is counted, rad and m: it makes the
/// information of few points regular and is negligible beside that of many.
const PRIOR_SD: f64 = 1.0;

/// Indices of at most `count` of `candidates` that, beside the points `held`, tell most about the
/// pose of the body: each choice maximizes the determinant of the pose's information. Points so
/// spread over the image by themselves, and near ones, whose depth is precise, go before far ones.
///
/// `O(count N)` for `N` candidates. Of equals the first wins.
pub fn choose_points(held: &[Candidate], candidates: &[Candidate], count: usize) -> Vec<usize> {
    let mut information = Matrix6::identity() / (PRIOR_SD * PRIOR_SD);
    for point in held {
        if let Some((by_pose, weight)) = seen(point) {
            information += by_pose.transpose() * weight * by_pose;
        }
    }
    let mut open: Vec<_> = candidates
        .iter()
        .enumerate()
        .filter_map(|(index, point)| Some((index, point, seen(point)?)))
        .collect();
    let mut chosen = Vec::with_capacity(count.min(open.len()));
    while chosen.len() < count {
        let Some(covariance) = information.cholesky().map(|c| c.inverse()) else { break };
        // By the determinant lemma the gain is that of a 3x3 matrix.
        let gain = |(_, point, (by_pose, _)): &(usize, &Candidate, Seen)| {
            let predicted = by_pose * covariance * by_pose.transpose();
            (predicted + point.body_covariance).determinant() / point.body_covariance.determinant()
        };
        let best = open
            .iter()
            .enumerate()
            .map(|(place, point)| (place, gain(point)))
            .reduce(|best, next| if next.1 > best.1 { next } else { best });
        let Some((place, _)) = best else { break };
        let (index, _, (by_pose, weight)) = open.remove(place);
        information += by_pose.transpose() * weight * by_pose;
        chosen.push(index);
    }
    chosen
}

type Seen = (SMatrix<f64, 3, 6>, Matrix3<f64>);

/// Derivative of the measurement by the pose, body coordinates, and its weight.
fn seen(point: &Candidate) -> Option<Seen> {
    let weight = point.body_covariance.cholesky()?.inverse();
    Some((point_by_pose(&Matrix3::identity(), &point.in_body), weight))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn candidates(count: usize) -> Vec<Candidate> {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let point = |_| Candidate {
            in_body: Vector3::from_fn(|_, _| rng.random_range(-3.0..3.0)),
            body_covariance: Matrix3::identity() * rng.random_range(1e-6..1e-3),
        };
        (0..count).map(point).collect()
    }

    fn information(points: impl Iterator<Item = Candidate>) -> f64 {
        let start: Matrix6<f64> = Matrix6::identity();
        points
            .filter_map(|point| seen(&point))
            .fold(start, |sum, (by_pose, weight)| sum + by_pose.transpose() * weight * by_pose)
            .determinant()
    }

    /// Each choice is the best one, by trying all.
    #[test]
    fn every_choice_adds_most_information() {
        let all = candidates(30);
        let held = &all[..2];
        let chosen = choose_points(held, &all[2..], 5);
        assert_eq!(chosen.len(), 5);
        let mut taken = held.to_vec();
        for (turn, &index) in chosen.iter().enumerate() {
            let with = |i: usize| information(taken.iter().copied().chain([all[2 + i]]));
            let open = (0..28).filter(|i| !chosen[..turn].contains(i));
            let best = open.map(with).fold(0.0, f64::max);
            assert!(with(index) > best * (1.0 - 1e-6));
            taken.push(all[2 + index]);
        }
    }

    #[test]
    fn no_more_than_there_are_and_none_without_a_covariance() {
        let mut all = candidates(3);
        all[1].body_covariance = Matrix3::zeros();
        let mut chosen = choose_points(&[], &all, 10);
        chosen.sort_unstable();
        assert_eq!(chosen, [0, 2]);
        assert!(choose_points(&[], &all, 0).is_empty());
    }
}
