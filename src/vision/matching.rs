use nalgebra::Point2;
use serde::{Deserialize, Serialize};

use super::{Descriptor, Feature};

/// When two descriptors are taken to be of the same point.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MatchingConfig {
    /// Most bits, of 256, in which matching descriptors may differ.
    pub max_distance: u32,
    /// A match is ambiguous, and dropped, if its distance is not below this fraction of the
    /// distance to the second best candidate; 1 or more keeps ambiguous matches.
    pub max_ratio: f64,
    /// Keep a match only if it is the best in both directions, so that nothing is matched twice
    /// (`Unique` of MATLAB's `matchFeatures`; W22, section 5.2.5).
    pub unique: bool,
}

impl Default for MatchingConfig {
    fn default() -> Self {
        Self { max_distance: 64, max_ratio: 0.8, unique: true }
    }
}

/// `query` and `train` are indices into the two slices that were matched.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Match {
    pub query: usize,
    pub train: usize,
    /// Bits that differ.
    pub distance: u32,
}

/// A known point that should be visible.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prediction {
    pub descriptor: Descriptor,
    /// Where it should appear in the image, pixels.
    pub pixel: Point2<f64>,
    /// How far from there it is looked for, pixels.
    pub radius: f64,
}

/// Matches every descriptor of `query` against every one of `train`, in order of `query`.
/// Of equal distances the lower index wins.
pub fn match_descriptors(
    query: &[Descriptor],
    train: &[Descriptor],
    config: &MatchingConfig,
) -> Vec<Match> {
    let mut best = Best::new(query.len(), train.len());
    for (q, a) in query.iter().enumerate() {
        for (t, b) in train.iter().enumerate() {
            best.offer(q, t, a.hamming(b));
        }
    }
    best.matches(config)
}

/// Like [`match_descriptors`], but a prediction is compared only with the features within its
/// radius; the second best of the ratio test is sought there too.
pub fn match_guided(
    predictions: &[Prediction],
    features: &[Feature],
    config: &MatchingConfig,
) -> Vec<Match> {
    let mut best = Best::new(predictions.len(), features.len());
    let grid = PixelGrid::new(features);
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("popcnt") {
        // SAFETY: the processor has the instruction.
        unsafe { offer_near_with_popcnt(predictions, &grid, &mut best) };
        return best.matches(config);
    }
    offer_near(predictions, &grid, &mut best);
    best.matches(config)
}

#[inline(always)]
fn offer_near(predictions: &[Prediction], grid: &PixelGrid, best: &mut Best) {
    for (q, prediction) in predictions.iter().enumerate() {
        grid.for_each_within(prediction.pixel, prediction.radius, |t| {
            best.offer(q, t, prediction.descriptor.hamming(&grid.features[t].descriptor));
        });
    }
}

/// [`offer_near`] compiled for processors that count bits in one instruction, which programs
/// built for every x86-64 must not assume.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "popcnt")]
fn offer_near_with_popcnt(predictions: &[Prediction], grid: &PixelGrid, best: &mut Best) {
    offer_near(predictions, grid, best);
}

const NO_MATCH: (u32, usize) = (u32::MAX, usize::MAX);

/// Best candidates met so far, in both directions.
struct Best {
    /// For each query: distance and index of the best, distance of the second best.
    forward: Vec<((u32, usize), u32)>,
    /// For each train: distance and index of the best query.
    backward: Vec<(u32, usize)>,
}

impl Best {
    fn new(queries: usize, trains: usize) -> Self {
        Self { forward: vec![(NO_MATCH, u32::MAX); queries], backward: vec![NO_MATCH; trains] }
    }

    /// Ordering by (distance, index) makes the outcome independent of the order of offers.
    #[inline(always)]
    fn offer(&mut self, query: usize, train: usize, distance: u32) {
        let (best, second) = &mut self.forward[query];
        if (distance, train) < *best {
            *second = best.0;
            *best = (distance, train);
        } else {
            *second = distance.min(*second);
        }
        let backward = &mut self.backward[train];
        *backward = (distance, query).min(*backward);
    }

    fn matches(self, config: &MatchingConfig) -> Vec<Match> {
        let accept = |(query, ((distance, train), second)): (usize, ((u32, usize), u32))| {
            let near = train != NO_MATCH.1 && distance <= config.max_distance;
            let clear = config.max_ratio >= 1.0
                || f64::from(distance) < config.max_ratio * f64::from(second);
            let accepted = near && clear && (!config.unique || self.backward[train].1 == query);
            accepted.then_some(Match { query, train, distance })
        };
        self.forward.iter().copied().enumerate().filter_map(accept).collect()
    }
}

/// Features sorted into square cells, for queries by pixel.
struct PixelGrid<'a> {
    features: &'a [Feature],
    origin: Point2<f64>,
    columns: usize,
    rows: usize,
    /// Cell `i` holds `items[starts[i]..starts[i + 1]]`.
    starts: Vec<usize>,
    items: Vec<usize>,
}

impl<'a> PixelGrid<'a> {
    /// Of the order of the usual search radius, pixels.
    const CELL: f64 = 20.0;
    /// Keeps the table small whatever the pixels; cells at the far border hold the rest.
    const MAX_CELLS_A_SIDE: usize = 256;

    fn new(features: &'a [Feature]) -> Self {
        let pixels = || features.iter().map(|f| f.pixel).filter(is_finite);
        let origin = pixels().reduce(|a, b| a.inf(&b)).unwrap_or_default();
        let end = pixels().reduce(|a, b| a.sup(&b)).unwrap_or_default();
        let cells = |extent: f64| ((extent / Self::CELL) as usize + 1).min(Self::MAX_CELLS_A_SIDE);
        let (columns, rows) = (cells(end.x - origin.x), cells(end.y - origin.y));
        let mut grid = Self {
            features,
            origin,
            columns,
            rows,
            starts: vec![0; columns * rows + 1],
            items: vec![],
        };

        let cell_of =
            |feature: &Feature| is_finite(&feature.pixel).then(|| grid.cell(feature.pixel));
        let cells: Vec<_> = features.iter().map(cell_of).collect();
        for cell in cells.iter().flatten() {
            grid.starts[cell.0 + cell.1 * columns + 1] += 1;
        }
        for i in 1..grid.starts.len() {
            grid.starts[i] += grid.starts[i - 1];
        }
        let mut next = grid.starts.clone();
        grid.items = vec![0; cells.iter().flatten().count()];
        for (index, cell) in cells.iter().enumerate() {
            if let Some((column, row)) = cell {
                let slot = &mut next[column + row * columns];
                grid.items[*slot] = index;
                *slot += 1;
            }
        }
        grid
    }

    /// Column and row of the cell that holds `pixel`, or of the nearest one. Casts saturate.
    fn cell(&self, pixel: Point2<f64>) -> (usize, usize) {
        let offset = (pixel - self.origin) / Self::CELL;
        ((offset.x as usize).min(self.columns - 1), (offset.y as usize).min(self.rows - 1))
    }

    #[inline(always)]
    fn for_each_within(&self, pixel: Point2<f64>, radius: f64, mut visit: impl FnMut(usize)) {
        if !(radius >= 0.0 && is_finite(&pixel)) {
            return;
        }
        let reach = nalgebra::Vector2::repeat(radius);
        let (first, last) = (self.cell(pixel - reach), self.cell(pixel + reach));
        for row in first.1..=last.1 {
            let cells = row * self.columns + first.0..row * self.columns + last.0 + 1;
            for &item in &self.items[self.starts[cells.start]..self.starts[cells.end]] {
                if (self.features[item].pixel - pixel).norm_squared() <= radius * radius {
                    visit(item);
                }
            }
        }
    }
}

fn is_finite(pixel: &Point2<f64>) -> bool {
    pixel.x.is_finite() && pixel.y.is_finite()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn descriptor() -> impl Strategy<Value = Descriptor> {
        // Few distinct bits, so that ties are common.
        any::<[u8; 2]>().prop_map(|b| {
            let mut bytes = [0; 32];
            bytes[..2].copy_from_slice(&b);
            Descriptor::from_bytes(&bytes)
        })
    }

    fn feature(x: f64, y: f64, descriptor: Descriptor) -> Feature {
        let pixel = Point2::new(x, y);
        Feature {
            pixel,
            bearing: nalgebra::Vector3::z_axis(),
            descriptor,
            response: 1.0,
            octave: 0,
            scale: 1.0,
            pixel_sigma: 1.0,
            patch: None,
            depth: None,
        }
    }

    fn with_bits(bits: u32) -> Descriptor {
        let mut bytes = [0; 32];
        (0..bits as usize).for_each(|i| bytes[i / 8] |= 1 << (i % 8));
        Descriptor::from_bytes(&bytes)
    }

    const ANY: MatchingConfig = MatchingConfig { max_distance: 256, max_ratio: 1.0, unique: false };

    proptest! {
        #[test]
        fn unique_matches_are_one_to_one_and_mutually_best(
            query in prop::collection::vec(descriptor(), 0..30),
            train in prop::collection::vec(descriptor(), 0..30),
        ) {
            let config = MatchingConfig { unique: true, ..ANY };
            let matches = match_descriptors(&query, &train, &config);
            for m in &matches {
                let d = query[m.query].hamming(&train[m.train]);
                prop_assert_eq!(d, m.distance);
                prop_assert!(train.iter().all(|t| query[m.query].hamming(t) >= d));
                prop_assert!(query.iter().all(|q| q.hamming(&train[m.train]) >= d));
            }
            let mut trains: Vec<_> = matches.iter().map(|m| m.train).collect();
            trains.sort_unstable();
            trains.dedup();
            prop_assert_eq!(trains.len(), matches.len());
            prop_assert!(query.is_empty() || train.is_empty() || !matches.is_empty());
        }

        #[test]
        fn an_unbounded_radius_equals_matching_all(
            query in prop::collection::vec(descriptor(), 0..20),
            train in prop::collection::vec((descriptor(), -50.0..700.0, -50.0..500.0), 0..20),
            max_ratio in 0.5..1.2f64,
            unique: bool,
        ) {
            let config = MatchingConfig { max_distance: 10, max_ratio, unique };
            let pixel = Point2::new(320.0, 240.0);
            let predictions: Vec<_> = query
                .iter()
                .map(|&descriptor| Prediction { descriptor, pixel, radius: f64::MAX })
                .collect();
            let features: Vec<_> = train.iter().map(|&(d, x, y)| feature(x, y, d)).collect();
            let descriptors: Vec<_> = train.iter().map(|t| t.0).collect();
            prop_assert_eq!(
                match_guided(&predictions, &features, &config),
                match_descriptors(&query, &descriptors, &config)
            );
        }

        #[test]
        fn the_grid_finds_what_a_scan_finds(
            points in prop::collection::vec((-1e4..1e4f64, -50.0..500.0f64), 0..60),
            x in -100.0..800.0f64, y in -100.0..600.0f64, radius in 0.0..2000.0f64,
        ) {
            let features: Vec<_> =
                points.iter().map(|&(x, y)| feature(x, y, with_bits(0))).collect();
            let pixel = Point2::new(x, y);
            let mut found = vec![];
            PixelGrid::new(&features).for_each_within(pixel, radius, |i| found.push(i));
            found.sort_unstable();
            let near = |i: &usize| (features[*i].pixel - pixel).norm_squared() <= radius * radius;
            let expected: Vec<_> = (0..features.len()).filter(near).collect();
            prop_assert_eq!(found, expected);
        }
    }

    #[test]
    fn rules_hold_at_their_borders() {
        let query = [with_bits(0)];
        let at = |bits: &[u32], config: &MatchingConfig| {
            let train: Vec<_> = bits.iter().map(|&b| with_bits(b)).collect();
            match_descriptors(&query, &train, config).first().map(|m| m.train)
        };
        let config = MatchingConfig { max_distance: 64, max_ratio: 0.8, unique: true };
        assert_eq!(at(&[64], &config), Some(0));
        assert_eq!(at(&[65], &config), None);
        assert_eq!(at(&[50, 40], &config), None, "40 is not below 0.8 x 50");
        assert_eq!(at(&[50, 39], &config), Some(1));
        assert_eq!(at(&[7, 7], &ANY), Some(0), "ties go to the lower index");
        assert_eq!(at(&[], &config), None);
    }

    #[test]
    fn a_match_lies_within_the_radius() {
        let features = [feature(10.0, 10.0, with_bits(0)), feature(14.0, 10.0, with_bits(9))];
        let at = |radius: f64| {
            let pixel = Point2::new(17.0, 10.0);
            let prediction = Prediction { descriptor: with_bits(0), pixel, radius };
            match_guided(&[prediction], &features, &ANY).first().map(|m| m.train)
        };
        assert_eq!(at(7.0), Some(0));
        assert_eq!(at(6.9), Some(1));
        assert_eq!(at(2.9), None);
        assert_eq!(at(f64::NAN), None);
    }

    #[test]
    fn pixels_that_are_no_numbers_match_nothing() {
        let features = [feature(f64::NAN, 1.0, with_bits(0)), feature(1e300, 1.0, with_bits(0))];
        let prediction =
            Prediction { descriptor: with_bits(0), pixel: Point2::new(1.0, 1.0), radius: 5.0 };
        assert_eq!(match_guided(&[prediction], &features, &ANY), []);
        let nowhere = Prediction { pixel: Point2::new(f64::NAN, 0.0), ..prediction };
        assert_eq!(match_guided(&[nowhere], &features, &ANY), []);
    }
}
