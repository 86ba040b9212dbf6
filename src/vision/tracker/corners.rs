//! New points where none is followed.

use nalgebra::{Matrix2, Point2, Vector2};
use opencv::core::{KeyPoint, Ptr, Rect, Vector};
use opencv::features2d::{FastFeatureDetector, FastFeatureDetector_DetectorType, KeyPointsFilter};
use opencv::prelude::*;

use super::alignment::{Template, VIEW_RADIUS};
use super::levels::Levels;
use crate::vision::{FeatureConfig, Mask};

/// FAST compares a pixel with a circle of this radius, and its score with that of the neighbours.
const FAST_MARGIN: usize = 4;
/// Corners of a cell that are judged by how well they can be aligned, at most: the strongest.
const JUDGED: i32 = 5;
/// A new point keeps this distance from others, as a share of the side of a cell.
const SPACING: f64 = 0.4;

/// A place that can be followed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Corner {
    pub pixel: Point2<f64>,
    /// Standard deviation of its position in its least certain direction, px.
    pub sigma: f32,
}

/// What new points must be like.
#[derive(Debug, Clone, Copy)]
pub(super) struct Wanted<'a> {
    /// Side of the cells, pixels.
    pub cell: f64,
    pub count: usize,
    pub mask: &'a Mask,
    pub max_sigma: f32,
    /// Of the grey values.
    pub noise: f32,
}

pub(super) struct CornerFinder {
    fast: Ptr<FastFeatureDetector>,
    /// With the lower threshold.
    sensitive: Ptr<FastFeatureDetector>,
    found: Vector<KeyPoint>,
    occupied: Vec<bool>,
}

impl CornerFinder {
    pub fn new(config: &FeatureConfig) -> Result<Self, opencv::Error> {
        let detector = |threshold: u8| {
            let kind = FastFeatureDetector_DetectorType::TYPE_9_16;
            FastFeatureDetector::create(i32::from(threshold), true, kind)
        };
        Ok(Self {
            fast: detector(config.fast_threshold)?,
            sensitive: detector(config.min_fast_threshold.min(config.fast_threshold))?,
            found: Vector::new(),
            occupied: Vec::new(),
        })
    }

    /// The corner of each cell without any of `taken` that can be aligned best, those that can be
    /// aligned best first. Costs `O(pixels of these cells)`.
    pub fn find(
        &mut self,
        levels: &Levels,
        taken: &[Point2<f64>],
        wanted: &Wanted,
    ) -> Result<Vec<Corner>, opencv::Error> {
        let (width, height) = (levels.level(0).width, levels.level(0).height);
        let columns = (width as f64 / wanted.cell).ceil() as usize;
        let rows = (height as f64 / wanted.cell).ceil() as usize;
        self.occupied.clear();
        self.occupied.resize(columns * rows, false);
        for pixel in taken {
            let cell =
                (pixel.y / wanted.cell) as usize * columns + (pixel.x / wanted.cell) as usize;
            if let Some(occupied) = self.occupied.get_mut(cell) {
                *occupied = true;
            }
        }
        let mut corners = vec![];
        for cell in 0..columns * rows {
            if self.occupied[cell] {
                continue;
            }
            let side = |index: usize, size: usize| {
                let edge = |k: usize| (k as f64 * wanted.cell).round() as usize;
                let border = VIEW_RADIUS + 1;
                (edge(index).max(border), edge(index + 1).min(size.saturating_sub(border)))
            };
            let (x, y) = (side(cell % columns, width), side(cell / columns, height));
            if x.0 < x.1 && y.0 < y.1 {
                corners.extend(self.best_of_cell(levels, (x, y), taken, wanted)?);
            }
        }
        let place = |corner: &Corner| (corner.pixel.y as usize, corner.pixel.x as usize);
        corners.sort_by(|a, b| a.sigma.total_cmp(&b.sigma).then(place(a).cmp(&place(b))));
        let spacing = SPACING * wanted.cell;
        let mut chosen: Vec<Corner> = Vec::with_capacity(corners.len().min(wanted.count));
        for corner in corners {
            let is_near = |other: &Corner| (other.pixel - corner.pixel).norm() < spacing;
            if chosen.len() < wanted.count && !chosen.iter().any(is_near) {
                chosen.push(corner);
            }
        }
        Ok(chosen)
    }

    /// `x`, `y`: first column and row, and those behind the last.
    fn best_of_cell(
        &mut self,
        levels: &Levels,
        (x, y): ((usize, usize), (usize, usize)),
        taken: &[Point2<f64>],
        wanted: &Wanted,
    ) -> Result<Option<Corner>, opencv::Error> {
        let Some(full) = levels.full() else { return Ok(None) };
        let start = (x.0 - FAST_MARGIN, y.0 - FAST_MARGIN);
        let size = |range: (usize, usize)| (range.1 - range.0 + 2 * FAST_MARGIN) as i32;
        let block = full.roi(Rect::new(start.0 as i32, start.1 as i32, size(x), size(y)))?;
        let spacing = SPACING * wanted.cell;
        for detector in [&mut self.fast, &mut self.sensitive] {
            detector.detect_def(&block, &mut self.found)?;
            KeyPointsFilter::run_by_image_border(
                &mut self.found,
                block.size()?,
                FAST_MARGIN as i32,
            )?;
            KeyPointsFilter::retain_best(&mut self.found, JUDGED)?;
            let corner = |point: KeyPoint| {
                let place = Vector2::new(point.pt().x, point.pt().y)
                    + Vector2::new(start.0 as f32, start.1 as f32);
                let pixel = Point2::from(place.cast::<f64>());
                let is_free = !wanted.mask.covers(pixel.x, pixel.y)
                    && taken.iter().all(|other| (other - pixel).norm() >= spacing);
                if !is_free {
                    return None;
                }
                let template = Template::warped(levels.level(0), place, &Matrix2::identity())?;
                let sigma = template.place_sigma(wanted.noise);
                (sigma <= wanted.max_sigma).then_some(Corner { pixel, sigma })
            };
            let better = |a: &Corner, b: &Corner| {
                let place = |corner: &Corner| (corner.pixel.y as usize, corner.pixel.x as usize);
                a.sigma.total_cmp(&b.sigma).then(place(a).cmp(&place(b)))
            };
            let best = self.found.iter().filter_map(corner).min_by(better);
            if best.is_some() {
                return Ok(best);
            }
        }
        Ok(None)
    }
}
