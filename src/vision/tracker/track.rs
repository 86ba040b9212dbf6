//! One point, and how it is found in the next frame.

use nalgebra::{Matrix2, Point2, Vector2};

use super::TrackerConfig;
use super::alignment::{Found, Refined, Search, Template, VIEW_RADIUS, View};
use super::levels::Levels;
use super::motion::ImageMotion;
use crate::vision::Mask;

/// Levels of a pyramid, at most.
pub(super) const MOST_LEVELS: usize = 6;
/// On the levels before the last, whose places are only the next start.
const COARSE: Search = Search { steps: 12, max_shift: 6.0, tolerance: 0.05, pads: true };
const FINE: Search = Search { steps: 15, max_shift: 6.0, tolerance: 0.02, pads: false };
/// Levels that suffice where the last motion is known.
const QUICK_LEVELS: usize = 2;
/// Correlation below which a coarse level tells nothing.
const LEAST_COARSE_CORRELATION: f32 = 0.6;
/// The last step corrects the place by the tilt of the surface; by more than this it is lost, px.
const LARGEST_CORRECTION: f32 = 1.0;
/// How much the warp may change from frame to frame, beyond what the turn does: scale and tilt of
/// a surface that is passed at 1 to 2 of its distances a second.
const WARP_CHANGE: f32 = 0.04;
/// A first view is of no use beyond this scale, larger or smaller.
const LARGEST_SCALE: f32 = 4.0;
/// Farther from the prediction than this, the way back is sought on the second level first, px.
const SHORT_WAY: f32 = 3.0;
/// A place is the same as another up to this chi-square of two degrees of freedom: 99.9 %.
const SAME_PLACE: f64 = 13.8;

/// The levels of a point's first view, as far as they fit into the image.
pub(super) type Views = [Option<View>; MOST_LEVELS];

/// A point that is followed.
#[derive(Debug, Clone)]
pub(super) struct Track {
    pub id: u64,
    views: Views,
    /// Offsets in the present image to those in the first view.
    pub warp: Matrix2<f32>,
    /// Where it is seen, or, while it is not, where it should be.
    pub pixel: Point2<f64>,
    pub covariance: Matrix2<f64>,
    /// Where it was seen in the frame before.
    pub former: Option<Point2<f64>>,
    /// Of `former`.
    pub former_covariance: Matrix2<f64>,
    /// Motion beyond what the turn does, px/s.
    drift: Vector2<f64>,
    /// Since it was last seen, s; 0 if it is.
    pub unseen: f64,
    /// Variance of the grey values where it was found last.
    pub noise_variance: f32,
    /// Where other cameras saw it last, 1/m; 0 at infinity.
    pub inverse_depth: Option<f64>,
    /// Whether it was found in the frame before, so that its motion is known.
    is_steady: bool,
}

/// What the points of a frame have in common.
pub(super) struct Frame<'a> {
    pub config: &'a TrackerConfig,
    pub mask: &'a Mask,
    pub present: &'a Levels,
    pub former: &'a Levels,
    pub motion: &'a ImageMotion,
    /// Variance of the grey values.
    pub noise_variance: f32,
}

impl Track {
    /// A point whose first view is that at `pixel`; `None` where that is too near to the border.
    pub fn begin(id: u64, pixel: Point2<f64>, levels: &Levels) -> Option<Self> {
        let place = pixel.coords.cast::<f32>();
        let reach = Vector2::repeat(VIEW_RADIUS as f32);
        if !levels.level(0).holds(place, reach) {
            return None;
        }
        let view = |level: usize| View::cut(levels.level(level), place / (1_u32 << level) as f32);
        let views: Views = std::array::from_fn(view);
        views[0].is_some().then(|| Self {
            id,
            views,
            warp: Matrix2::identity(),
            pixel,
            covariance: Matrix2::zeros(),
            former: None,
            former_covariance: Matrix2::zeros(),
            drift: Vector2::zeros(),
            unseen: 0.0,
            noise_variance: 0.0,
            inverse_depth: None,
            is_steady: false,
        })
    }

    pub fn is_seen(&self) -> bool {
        self.unseen == 0.0
    }

    /// Looks for the point in the present frame; whether it may be sought again.
    pub fn follow(&mut self, frame: &Frame) -> bool {
        let Some((turned, moved)) = frame.motion.turned(self.pixel) else { return false };
        let Some(back) = moved.try_inverse() else { return false };
        let predicted = turned + self.drift * frame.motion.seconds;
        let former = self.is_seen().then_some(self.pixel);
        (self.former, self.former_covariance) = (former, self.covariance);
        self.warp *= back.cast::<f32>();
        self.pixel = predicted;
        match self.find(frame, predicted, &moved) {
            Some(refined) => {
                self.pixel = refined.found.place.cast::<f64>().into();
                self.drift = (self.pixel - turned) / frame.motion.seconds;
                self.warp *= refined.warp_change;
                self.covariance = frame.covariance(&refined);
                self.noise_variance = refined.noise_variance;
                self.unseen = 0.0;
                self.is_steady = true;
            }
            None => {
                self.unseen += frame.motion.seconds;
                self.is_steady = false;
            }
        }
        let scale = self.warp.determinant().abs().sqrt();
        (1.0 / LARGEST_SCALE..=LARGEST_SCALE).contains(&scale)
            && self.unseen <= frame.config.patience
    }

    fn find(&self, frame: &Frame, predicted: Point2<f64>, moved: &Matrix2<f64>) -> Option<Refined> {
        let levels = frame.present.len();
        let quick = self.is_steady && levels > QUICK_LEVELS;
        let quickly = quick.then(|| self.find_from(frame, predicted, moved, QUICK_LEVELS));
        quickly.flatten().or_else(|| self.find_from(frame, predicted, moved, levels))
    }

    /// The same, beginning with level `top - 1`.
    fn find_from(
        &self,
        frame: &Frame,
        predicted: Point2<f64>,
        moved: &Matrix2<f64>,
        top: usize,
    ) -> Option<Refined> {
        let start = predicted.coords.cast::<f32>();
        let refined = self.locate(frame, frame.present, start, &self.warp, top)?;
        let Found { place, correlation } = refined.found;
        let is_masked = frame.mask.covers(f64::from(place.x), f64::from(place.y));
        if is_masked || f64::from(correlation) < frame.config.min_correlation {
            return None;
        }
        match self.former {
            Some(former) => {
                let covariance = frame.covariance(&refined);
                let back = self.way_back(frame, former, place, place - start, moved)?;
                let apart = (back - former.coords.cast::<f32>()).cast::<f64>();
                let variance = 0.5 * (covariance + self.former_covariance).trace()
                    + frame.config.pixel_sigma.powi(2);
                (apart.norm_squared() <= SAME_PLACE * variance).then_some(refined)
            }
            None => Some(refined),
        }
    }

    /// The place in `levels` that shows what the first view does, from `start` on, through `warp`,
    /// beginning with level `top - 1`.
    pub fn locate(
        &self,
        frame: &Frame,
        levels: &Levels,
        start: Vector2<f32>,
        warp: &Matrix2<f32>,
        top: usize,
    ) -> Option<Refined> {
        let mut place = start;
        for level in (1..top).rev() {
            let size = (1_u32 << level) as f32;
            let found = self
                .template(warp, level)
                .and_then(|template| template.find(levels.level(level), place / size, COARSE));
            if let Some(found) = found.filter(|f| f.correlation > LEAST_COARSE_CORRELATION) {
                place = found.place * size;
            }
        }
        let template = self.template(warp, 0)?;
        let image = levels.level(0);
        let found = template.find(image, place, FINE)?;
        let noise = frame.noise_variance;
        let refined = template.refine(image, found.place, WARP_CHANGE, noise)?;
        let corrected = (refined.found.place - found.place).norm();
        (corrected < LARGEST_CORRECTION).then_some(refined)
    }

    /// What a level of an image should show; of the level of the first view that is nearest in scale.
    pub fn template(&self, warp: &Matrix2<f32>, level: usize) -> Option<Template> {
        let scale = warp.determinant().abs().sqrt();
        let shift = scale.log2().round() as i32;
        let own = (level as i32 + shift).clamp(0, MOST_LEVELS as i32 - 1);
        let view = self.views[own as usize].as_ref()?;
        Template::of_view(view, &(warp * ((level as i32 - own) as f32).exp2()))
    }

    /// The place in the former image that shows what the present one does at `place`, from as far
    /// off as the prediction was.
    fn way_back(
        &self,
        frame: &Frame,
        former: Point2<f64>,
        place: Vector2<f32>,
        error: Vector2<f32>,
        moved: &Matrix2<f64>,
    ) -> Option<Vector2<f32>> {
        let moved = moved.cast::<f32>();
        let mut start = former.coords.cast::<f32>() + error;
        if error.norm() > SHORT_WAY {
            let template = Template::warped(frame.present.level(1), place / 2.0, &moved);
            let found = template.and_then(|t| t.find(frame.former.level(1), start / 2.0, COARSE));
            start = found.map_or(start, |found| found.place * 2.0);
        }
        let template = Template::warped(frame.present.level(0), place, &moved)?;
        Some(template.find(frame.former.level(0), start, FINE)?.place)
    }
}

impl Frame<'_> {
    /// Covariance of a place that was found, px^2.
    pub fn covariance(&self, refined: &Refined) -> Matrix2<f64> {
        let floor = self.config.pixel_sigma.powi(2);
        refined.covariance.cast::<f64>() + Matrix2::from_diagonal_element(floor)
    }
}
