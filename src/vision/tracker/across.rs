//! The same points in the images of further cameras.
//!
//! A point at inverse depth `r` on the ray `b` of the first camera is seen by another one in the
//! direction `R b + r t`: along a curve, the epipolar line, whatever the lenses and wherever the other
//! camera is. A point whose depth was seen before is sought where that puts it, any other along the
//! whole line. What is found is aligned in both coordinates; how far it is from the line tells wrong
//! ones. Costs `O(points)`, and `O(length of the line)` for each point that is new.

use nalgebra::{Isometry3, Matrix2, Matrix3x2, Point2, Vector2, Vector3};

use super::alignment::Refined;
use super::levels::Levels;
use super::track::{Frame, Track};
use crate::sensor::{Camera, CameraConfig, ColorImage};
use crate::vision::orb::VisionError;

/// Nearest depth at which a point is sought, m.
const NEAREST: f64 = 0.2;
/// Steps along the line on the level on which it is searched, at most.
const MOST_STEPS: f64 = 48.0;
/// Candidates of a search that are aligned, at most.
const CANDIDATES: usize = 3;
/// Correlation below which a place on the line is no candidate.
const LEAST_CORRELATION: f32 = 0.6;
/// Another place that correlates as well, less this, makes a match ambiguous.
const UNIQUENESS: f32 = 0.03;
/// Places nearer than this are the same one, px.
const SAME_PLACE: f64 = 2.0;
/// What calibrations of two cameras leave across the epipolar line, px (EuRoC: 0.2 to 0.3).
const CALIBRATION_SIGMA: f64 = 0.3;
/// Chi-square of one degree of freedom, 99.99 %.
const GATE: f64 = 15.1;

/// Another camera of the body, and what it shows.
pub(super) struct OtherCamera {
    camera: Camera,
    other_from_first: Isometry3<f64>,
    levels: Levels,
}

/// The line on which a point must lie in the other image.
struct EpipolarLine<'a> {
    camera: &'a Camera,
    /// The ray of the first camera at depth 1, in the other one's coordinates, and its derivative by
    /// the pixel of the first camera.
    ray: Vector3<f64>,
    across: Matrix3x2<f64>,
    offset: Vector3<f64>,
}

impl EpipolarLine<'_> {
    /// Where a point at an inverse depth (1/m) is seen.
    fn at(&self, inverse_depth: f64) -> Option<Point2<f64>> {
        self.camera.project(&(self.ray + self.offset * inverse_depth))
    }

    /// The same and how it moves with the inverse depth and with the pixel of the first camera, for a
    /// surface of constant depth.
    fn around(&self, inverse_depth: f64) -> Option<(Point2<f64>, Vector2<f64>, Matrix2<f64>)> {
        let point = self.ray + self.offset * inverse_depth;
        let (pixel, projection) = self.camera.project_with_jacobian(&point)?;
        Some((pixel, projection * self.offset, projection * self.across))
    }

    /// The inverse depth whose place is nearest to `pixel`, from `start` on, and the squared distance
    /// from the line.
    fn nearest(&self, pixel: Point2<f64>, start: f64) -> Option<(f64, f64)> {
        let mut inverse_depth = start;
        for _ in 0..4 {
            let (at, along, _) = self.around(inverse_depth)?;
            inverse_depth += along.dot(&(pixel - at)) / along.norm_squared();
        }
        let distance = (pixel - self.at(inverse_depth)?).norm_squared();
        (inverse_depth.is_finite() && distance.is_finite()).then_some((inverse_depth, distance))
    }
}

/// Where another camera sees a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct OtherView {
    pub pixel: Point2<f64>,
    pub covariance: Matrix2<f64>,
    /// By both cameras, 1/m.
    pub inverse_depth: f64,
}

impl OtherCamera {
    /// `first` and `other` with their mountings on a common body.
    pub fn new(first: &CameraConfig, other: &CameraConfig) -> Result<Self, VisionError> {
        let mounting =
            |camera: &CameraConfig| camera.imu_from_camera().ok_or(VisionError::Mounting);
        Ok(Self {
            camera: Camera::new(other)?,
            other_from_first: mounting(other)?.inv_mul(&mounting(first)?),
            levels: Levels::default(),
        })
    }

    pub fn take(
        &mut self,
        image: &ColorImage,
        levels: usize,
        least: usize,
    ) -> Result<(), VisionError> {
        Ok(self.levels.fill(image, levels, least)?)
    }

    fn line(&self, first: &Camera, pixel: Point2<f64>) -> Option<EpipolarLine<'_>> {
        let ray = first.unproject(pixel, 1.0)?;
        let rotation = self.other_from_first.rotation.to_rotation_matrix();
        Some(EpipolarLine {
            camera: &self.camera,
            ray: rotation * ray,
            across: rotation * first.across(&ray, 1.0)?,
            offset: self.other_from_first.translation.vector,
        })
    }

    /// The view of a point that the first camera sees.
    pub fn find(&self, frame: &Frame, track: &Track) -> Option<OtherView> {
        let line = self.line(&frame.motion.camera, track.pixel)?;
        let expected = track.inverse_depth.and_then(|depth| {
            let view = self.align(frame, track, &line, depth, QUICK_LEVELS)?;
            self.checked(frame, track, &line, depth, view)
        });
        expected.or_else(|| self.search(frame, track, &line))
    }

    /// Aligns the first view with what is seen at an inverse depth.
    fn align(
        &self,
        frame: &Frame,
        track: &Track,
        line: &EpipolarLine,
        inverse_depth: f64,
        levels: usize,
    ) -> Option<Refined> {
        let (pixel, _, moved) = line.around(inverse_depth)?;
        let warp = track.warp * moved.try_inverse()?.cast::<f32>();
        let refined =
            track.locate(frame, &self.levels, pixel.coords.cast::<f32>(), &warp, levels)?;
        let is_alike = f64::from(refined.found.correlation) >= frame.config.min_correlation;
        is_alike.then_some(refined)
    }

    /// The view if it lies on the line, ahead.
    fn checked(
        &self,
        frame: &Frame,
        track: &Track,
        line: &EpipolarLine,
        start: f64,
        refined: Refined,
    ) -> Option<OtherView> {
        let pixel = Point2::from(refined.found.place.cast::<f64>());
        let covariance = frame.covariance(&refined);
        let (inverse_depth, distance) = line.nearest(pixel, start)?;
        let (at, along, moved) = line.around(inverse_depth)?;
        // What the error of the first camera's pixel does here.
        let total = covariance + moved * track.covariance * moved.transpose();
        let direction = (pixel - at).try_normalize(f64::MIN_POSITIVE);
        let own = direction.map_or(0.0, |d| (d.transpose() * total * d).x);
        let is_on_line = distance <= GATE * (own + CALIBRATION_SIGMA.powi(2));
        // Far points may come out behind infinity by their error.
        let sigma = (0.5 * total.trace()).sqrt() / along.norm();
        let is_ahead = inverse_depth > -4.0 * sigma && inverse_depth < 1.0 / NEAREST;
        (is_on_line && is_ahead).then(|| OtherView {
            pixel,
            covariance,
            inverse_depth: inverse_depth.max(0.0),
        })
    }

    /// The best place along the whole line, if no other one is as good.
    fn search(&self, frame: &Frame, track: &Track, line: &EpipolarLine) -> Option<OtherView> {
        let far = line.at(0.0)?;
        let near = self.near_end(line)?;
        let length = (line.at(near)? - far).norm();
        let level = (length / MOST_STEPS).max(1.0).log2().ceil() as usize;
        let level = level.min(self.levels.len().saturating_sub(1));
        let mut candidates = self.candidates(track, line, near, level);
        candidates.sort_by(|a, b| b.1.total_cmp(&a.1));
        candidates.truncate(CANDIDATES);
        let mut views: Vec<(f32, OtherView)> = vec![];
        for (inverse_depth, _) in candidates {
            let view =
                self.align(frame, track, line, inverse_depth, level + 1).and_then(|refined| {
                    let view = self.checked(frame, track, line, inverse_depth, refined)?;
                    Some((refined.found.correlation, view))
                });
            let is_known = |view: &(f32, OtherView)| {
                views.iter().any(|(_, other)| (other.pixel - view.1.pixel).norm() < SAME_PLACE)
            };
            if let Some(view) = view.filter(|view| !is_known(view)) {
                views.push(view);
            }
        }
        views.sort_by(|a, b| b.0.total_cmp(&a.0));
        let (best, view) = views.first()?;
        let rival = views.get(1).map_or(-1.0, |(correlation, _)| *correlation);
        (rival < best - UNIQUENESS).then_some(*view)
    }

    /// The largest inverse depth that is sought and that the lens images.
    fn near_end(&self, line: &EpipolarLine) -> Option<f64> {
        let halves = (0..6).map(|k| (1.0 / NEAREST) / f64::from(1 << k));
        halves.into_iter().find(|inverse_depth| line.at(*inverse_depth).is_some())
    }

    /// Inverse depths of the local maxima of the correlation along the line, on a level.
    fn candidates(
        &self,
        track: &Track,
        line: &EpipolarLine,
        near: f64,
        level: usize,
    ) -> Vec<(f64, f32)> {
        let image = self.levels.level(level);
        let size = (1_u32 << level) as f32;
        let mut found: Vec<(f64, f32)> = vec![];
        let mut profile: [(f64, f32); 3] = [(0.0, -1.0); 3];
        let mut inverse_depth = 0.0;
        let mut template = None;
        // A line of this many pixels of the level, as steps vary with the lens.
        for step in 0..4 * MOST_STEPS as usize {
            let Some((pixel, along, moved)) = line.around(inverse_depth) else { break };
            if step % TEMPLATE_STEPS == 0 {
                let warp = moved.try_inverse().map(|back| track.warp * back.cast::<f32>());
                template = warp.and_then(|warp| track.template(&warp, level));
            }
            let place = pixel.coords.cast::<f32>() / size;
            let correlation = template.as_ref().and_then(|t| t.correlation(image, place));
            profile = [profile[1], profile[2], (inverse_depth, correlation.unwrap_or(-1.0))];
            if profile[1].1 > LEAST_CORRELATION
                && profile[1].1 >= profile[0].1
                && profile[1].1 >= profile[2].1
            {
                found.push(profile[1]);
            }
            if inverse_depth >= near {
                break;
            }
            let pace = f64::from(size) / along.norm();
            inverse_depth = (inverse_depth + pace).min(near);
        }
        found
    }
}

/// Levels on which a point of known depth is sought.
const QUICK_LEVELS: usize = 2;
/// Steps along the line after which the view of the point is warped anew.
const TEMPLATE_STEPS: usize = 16;
