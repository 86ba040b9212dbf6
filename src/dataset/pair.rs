//! Which color image belongs to which depth image.

use std::collections::BTreeMap;

use crate::sensor::Stamp;

/// What became of an image.
#[derive(Debug, PartialEq)]
pub(super) enum Paired<C, D> {
    /// Stamped as the color image.
    Pair(Stamp, C, D),
    LoneColor(Stamp, C),
    LoneDepth(Stamp, D),
}

/// Pairs color and depth images one to one by nearest stamp, in order of the color stamps.
///
/// A depth image goes to the first color image within the limit for which it is the nearest one
/// left, unless a later color image is nearer to it and has no nearer depth image of its own.
#[derive(Debug)]
pub(super) struct Pairer<C, D> {
    colors: BTreeMap<Stamp, C>,
    depths: BTreeMap<Stamp, D>,
    /// Largest difference of the stamps of a pair, ns.
    limit: i64,
}

impl<C, D> Pairer<C, D> {
    /// `limit`: largest difference of the stamps of a pair, ns.
    pub fn new(limit: i64) -> Self {
        Self { colors: BTreeMap::new(), depths: BTreeMap::new(), limit: limit.max(0) }
    }

    /// `false` if there is a color image with this stamp already.
    pub fn add_color(&mut self, stamp: Stamp, color: C) -> bool {
        insert_new(&mut self.colors, stamp, color)
    }

    /// `false` if there is a depth image with this stamp already.
    pub fn add_depth(&mut self, stamp: Stamp, depth: D) -> bool {
        insert_new(&mut self.depths, stamp, depth)
    }

    /// The color image of this stamp, if it is held.
    pub fn color(&self, stamp: Stamp) -> Option<&C> {
        self.colors.get(&stamp)
    }

    /// Stamp of the oldest image held.
    pub fn oldest(&self) -> Option<Stamp> {
        let color = self.colors.keys().next();
        let depth = self.depths.keys().next();
        color.into_iter().chain(depth).min().copied()
    }

    /// Settles all color images up to `until`, and the depth images no later one can claim.
    ///
    /// Exact when all images up to `until` plus twice the limit have been added.
    pub fn settle(&mut self, until: Stamp, mut settled: impl FnMut(Paired<C, D>)) {
        while let Some(entry) = self.colors.first_entry() {
            let stamp = *entry.key();
            if stamp > until {
                break;
            }
            let color = entry.remove();
            let depth = self.choose(stamp).and_then(|chosen| self.depths.remove(&chosen));
            settled(match depth {
                Some(depth) => Paired::Pair(stamp, color, depth),
                None => Paired::LoneColor(stamp, color),
            });
        }
        while let Some(entry) = self.depths.first_entry() {
            if entry.key().nanos() > until.nanos().saturating_sub(self.limit) {
                break;
            }
            let (stamp, depth) = entry.remove_entry();
            settled(Paired::LoneDepth(stamp, depth));
        }
    }

    fn choose(&self, color: Stamp) -> Option<Stamp> {
        let mut candidates: Vec<Stamp> =
            self.depths.range(around(color, self.limit)).map(|(stamp, _)| *stamp).collect();
        candidates.sort_by_key(|depth| (distance(*depth, color), *depth));
        candidates.into_iter().find(|depth| !self.is_claimed(*depth, distance(*depth, color)))
    }

    /// Whether a color image still held is nearer than `limit` to `depth` and has no nearer one.
    fn is_claimed(&self, depth: Stamp, limit: i64) -> bool {
        self.colors.range(around(depth, limit)).any(|(color, _)| {
            let own = distance(depth, *color);
            let mut rivals = self.depths.range(around(*color, own));
            own < limit && rivals.all(|(rival, _)| distance(*rival, *color) >= own)
        })
    }
}

fn insert_new<T>(map: &mut BTreeMap<Stamp, T>, stamp: Stamp, value: T) -> bool {
    let free = !map.contains_key(&stamp);
    if free {
        map.insert(stamp, value);
    }
    free
}

fn around(stamp: Stamp, limit: i64) -> std::ops::RangeInclusive<Stamp> {
    let nanos = stamp.nanos();
    let (from, to) = (nanos.saturating_sub(limit), nanos.saturating_add(limit));
    Stamp::from_nanos(from)..=Stamp::from_nanos(to)
}

fn distance(a: Stamp, b: Stamp) -> i64 {
    a.nanos().saturating_sub(b.nanos()).saturating_abs()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn stamps(millis: &[i64]) -> Vec<Stamp> {
        millis.iter().map(|t| Stamp::from_nanos(t * 1_000_000)).collect()
    }

    /// Pairs as milliseconds, and the numbers of lone color and depth images.
    fn pair(colors: &[i64], depths: &[i64], limit: i64) -> (Vec<(i64, i64)>, usize, usize) {
        let mut pairer = Pairer::new(limit * 1_000_000);
        for (stamp, millis) in stamps(colors).into_iter().zip(colors) {
            pairer.add_color(stamp, *millis);
        }
        for (stamp, millis) in stamps(depths).into_iter().zip(depths) {
            pairer.add_depth(stamp, *millis);
        }
        let (mut pairs, mut lone_colors, mut lone_depths) = (Vec::new(), 0, 0);
        pairer.settle(Stamp::from_nanos(i64::MAX), |paired| match paired {
            Paired::Pair(_, color, depth) => pairs.push((color, depth)),
            Paired::LoneColor(..) => lone_colors += 1,
            Paired::LoneDepth(..) => lone_depths += 1,
        });
        (pairs, lone_colors, lone_depths)
    }

    #[test]
    fn nearest_depth_is_chosen_and_used_once() {
        assert_eq!(pair(&[0, 33, 66], &[1, 32, 70], 20), (vec![(0, 1), (33, 32), (66, 70)], 0, 0));
        assert_eq!(pair(&[0, 15], &[14], 20), (vec![(15, 14)], 1, 0));
        assert_eq!(pair(&[0], &[-3, 2, 30], 20), (vec![(0, 2)], 0, 2));
        assert_eq!(pair(&[0, 100], &[50], 20), (vec![], 2, 1));
    }

    #[test]
    fn a_depth_image_is_not_kept_for_a_color_image_that_has_a_nearer_one() {
        assert_eq!(pair(&[0, 25], &[15, 26], 20), (vec![(0, 15), (25, 26)], 0, 0));
    }

    #[test]
    fn second_stamps_are_refused() {
        let mut pairer = Pairer::<(), ()>::new(1);
        assert!(pairer.add_color(Stamp::default(), ()) && !pairer.add_color(Stamp::default(), ()));
        assert!(pairer.add_depth(Stamp::default(), ()) && !pairer.add_depth(Stamp::default(), ()));
    }

    proptest! {
        #[test]
        fn every_image_is_settled_once(
            colors in prop::collection::btree_set(0_i64..400, 0..30),
            depths in prop::collection::btree_set(0_i64..400, 0..30),
        ) {
            let colors: Vec<_> = colors.into_iter().collect();
            let depths: Vec<_> = depths.into_iter().collect();
            let (pairs, lone_colors, lone_depths) = pair(&colors, &depths, 20);
            prop_assert_eq!(pairs.len() + lone_colors, colors.len());
            prop_assert_eq!(pairs.len() + lone_depths, depths.len());
            prop_assert!(pairs.iter().all(|(color, depth)| (color - depth).abs() <= 20));
        }
    }
}
