use serde::{Deserialize, Serialize};

/// How points are followed from frame to frame.
///
/// What is not in here follows from these keys, the images and the noise of the gyroscope.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrackerConfig {
    /// Points that are followed at once, at most; 0: none are. 200 help where texture is weak; where it
    /// is good they cost time and do not make the estimate better.
    pub points: usize,
    /// Side of the square cells that hold one point each, pixels; 0: such that the image has
    /// `points` of them.
    pub cell_size: f64,
    /// Levels of the image pyramid, each half the size of the one before: how far a point may be
    /// from where the turn of the body and its last motion put it.
    pub levels: u8,
    /// Smallest normalised cross-correlation with the first view, -1 to 1; below it a point is not
    /// seen.
    pub min_correlation: f64,
    /// Standard deviation of a point's position that remains however strong its texture, pixels a
    /// coordinate: what surfaces do other than turn, tilt and change their brightness.
    pub pixel_sigma: f64,
    /// A corner whose position would be less certain than this is not followed, pixels.
    pub max_pixel_sigma: f64,
    /// A point that is not seen is looked for during this time, s.
    pub patience: f64,
}

impl Default for TrackerConfig {
    fn default() -> Self {
        Self {
            points: 0,
            cell_size: 0.0,
            levels: 4,
            min_correlation: 0.8,
            pixel_sigma: 0.1,
            max_pixel_sigma: 0.5,
            patience: 0.2,
        }
    }
}

impl TrackerConfig {
    /// Side of the cells of an image of `width` and `height`, pixels.
    pub fn cell(&self, width: usize, height: usize) -> f64 {
        if self.cell_size > 0.0 {
            return self.cell_size;
        }
        ((width * height) as f64 / self.points.max(1) as f64).sqrt()
    }
}
