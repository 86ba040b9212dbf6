//! Choice of key points so that they cover the image.

use nalgebra::Point2;

/// A corner that may become a feature.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Corner {
    /// Pixels of the full image.
    pub pixel: Point2<f64>,
    /// Column and row on its pyramid level.
    pub column: usize,
    pub row: usize,
    pub level: u8,
    pub score: f32,
}

/// At most `count` of `corners`, at least `spacing` px apart, shared out over square cells of
/// `cell` px: every cell gives its best corner before any gives its second best, and so on.
///
/// Cells without strong corners so keep their weak ones, whatever there is elsewhere. The order
/// of the result is by level, row and column; that of `corners` does not matter.
pub(super) fn spread(
    mut corners: Vec<Corner>,
    width: usize,
    height: usize,
    cell: f64,
    spacing: f64,
    count: usize,
) -> Vec<Corner> {
    // Best first; position breaks ties, so that the order is total.
    corners.sort_unstable_by(|a, b| {
        b.score.total_cmp(&a.score).then_with(|| a.place().cmp(&b.place()))
    });
    let columns = (width as f64 / cell) as usize + 1;
    let mut cells = vec![vec![]; columns * ((height as f64 / cell) as usize + 1)];
    for corner in corners {
        let index = (corner.pixel.x / cell) as usize + (corner.pixel.y / cell) as usize * columns;
        if let Some(members) = cells.get_mut(index) {
            members.push(corner);
        }
    }

    let mut taken = Occupancy::new(width, height, spacing);
    let mut queues: Vec<_> = cells.into_iter().map(Vec::into_iter).collect();
    let mut chosen = Vec::with_capacity(count);
    while chosen.len() < count {
        // A cell's best corner that is still free, for each cell.
        let mut round: Vec<Corner> = vec![];
        for queue in &mut queues {
            if let Some(corner) = queue.find(|corner| taken.is_free(corner.pixel)) {
                taken.take(corner.pixel);
                round.push(corner);
            }
        }
        if round.is_empty() {
            break;
        }
        // The last round goes to the strongest.
        round.sort_by(|a, b| b.score.total_cmp(&a.score));
        round.truncate(count - chosen.len());
        chosen.append(&mut round);
    }
    chosen.sort_unstable_by_key(Corner::place);
    chosen
}

impl Corner {
    fn place(&self) -> (u8, usize, usize) {
        (self.level, self.row, self.column)
    }
}

/// Which pixels are within the spacing of a chosen corner.
struct Occupancy {
    width: usize,
    height: usize,
    spacing: f64,
    taken: Vec<bool>,
}

impl Occupancy {
    fn new(width: usize, height: usize, spacing: f64) -> Self {
        Self { width, height, spacing, taken: vec![false; width * height] }
    }

    fn is_free(&self, pixel: Point2<f64>) -> bool {
        let (column, row) = (pixel.x.round() as usize, pixel.y.round() as usize);
        column < self.width && row < self.height && !self.taken[row * self.width + column]
    }

    fn take(&mut self, pixel: Point2<f64>) {
        let range = |centre: f64, size: usize| {
            let first = (centre - self.spacing).ceil().max(0.0) as usize;
            first..((centre + self.spacing).floor() as usize + 1).min(size)
        };
        let columns = range(pixel.x, self.width);
        for row in range(pixel.y, self.height) {
            for column in columns.clone() {
                let offset = Point2::new(column as f64, row as f64) - pixel;
                if offset.norm_squared() < self.spacing * self.spacing {
                    self.taken[row * self.width + column] = true;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn corner(column: usize, row: usize, score: f32) -> Corner {
        let pixel = Point2::new(column as f64, row as f64);
        Corner { pixel, column, row, level: 0, score }
    }

    fn corners() -> impl Strategy<Value = Vec<Corner>> {
        let one =
            (0..200usize, 0..100usize, 0..9u8).prop_map(|(x, y, s)| corner(x, y, f32::from(s)));
        prop::collection::vec(one, 0..200)
    }

    proptest! {
        #[test]
        fn chosen_corners_keep_their_distance(all in corners(), count in 0..60usize) {
            let chosen = spread(all.clone(), 200, 100, 40.0, 5.0, count);
            prop_assert!(chosen.len() <= count);
            for (i, a) in chosen.iter().enumerate() {
                prop_assert!(all.contains(a));
                for b in &chosen[..i] {
                    prop_assert!((a.pixel - b.pixel).norm() >= 5.0);
                }
            }
        }

        #[test]
        fn input_order_does_not_matter(all in corners(), count in 0..60usize) {
            let reversed = all.iter().rev().copied().collect();
            let chosen = spread(all, 200, 100, 40.0, 5.0, count);
            prop_assert_eq!(chosen, spread(reversed, 200, 100, 40.0, 5.0, count));
        }
    }

    #[test]
    fn weak_corners_of_poor_cells_come_before_the_rest_of_rich_ones() {
        let mut all: Vec<_> = (0..6).map(|i| corner(2 + 6 * i, 10, 100.0)).collect();
        all.push(corner(150, 50, 1.0));
        let chosen = spread(all, 200, 100, 40.0, 4.0, 3);
        assert_eq!(chosen.len(), 3);
        assert!(chosen.contains(&corner(150, 50, 1.0)));
    }

    #[test]
    fn strongest_corner_of_a_cell_wins() {
        let all = vec![corner(10, 10, 5.0), corner(12, 10, 6.0), corner(30, 30, 1.0)];
        assert_eq!(spread(all, 200, 100, 40.0, 4.0, 1), [corner(12, 10, 6.0)]);
    }
}
