//! Where a track's point is, given the poses of its views, and what its rows are there.

use nalgebra::{
    Cholesky, DMatrix, DVector, Dyn, Isometry3, Matrix2, Matrix3, OMatrix, Point3, U3, Vector3,
};

use super::state::{Block, JointState};
use super::track::{MountedCamera, Track, TrackView};
use crate::alignment::MapEstimate;
use crate::filter::core::{FilterError, finite};
use crate::filter::visual::calibration::Calibration;
use crate::filter::visual::inverse_range::{LEAST_INVERSE_RANGE, Ray, axes_along};

/// Standard deviation of a pixel that defines the point, px: so far below what is measured of any
/// other that it counts as exact.
const DEFINING_SD: f64 = 1e-3;
/// Steps of the search; it takes three to six.
const STEPS: usize = 20;
/// The search ends where a step moves the point by less than this, rad and relative to its range.
const CONVERGED: f64 = 1e-11;
/// A step may raise the cost by what rounding makes of it, relative to it: near the end the cost no
/// longer tells steps apart that still come nearer.
const COST_ROUNDING: f64 = 1e-9;

/// A view of a track with its pose and its camera.
#[derive(Debug, Clone, Copy)]
struct PlacedView<'a> {
    world_from_body: Isometry3<f64>,
    mounted: &'a MountedCamera,
    view: &'a TrackView,
    /// Block of three of the pose's rotation among those of the track.
    block: usize,
}

/// A track whose views have their poses and cameras.
#[derive(Debug, Clone)]
pub(super) struct PlacedTrack<'a> {
    track: &'a Track,
    views: Vec<PlacedView<'a>>,
    /// Views that have a depth that counts.
    with_depth: Vec<usize>,
    /// Inverse Cholesky factors of the pixels' covariances.
    pixel_weights: Vec<Matrix2<f64>>,
    /// That of the depths' covariance, which are correlated.
    depth_root: Option<DMatrix<f64>>,
    /// The state's rows that its rows depend on, the first of each block of three.
    blocks: Vec<usize>,
    calibration: Option<Calibration>,
}

/// What a track measures, linearised at a point and at the poses of its views, its noise white with
/// variance one: `residual = jacobian e + by_point e_l + noise`.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct TrackRows {
    pub residual: DVector<f64>,
    /// By the state's errors as they are between updates, three columns a block.
    pub jacobian: DMatrix<f64>,
    /// By the point, world coordinates.
    pub by_point: OMatrix<f64, Dyn, U3>,
}

/// A point that fits a track best.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Triangulated {
    /// World coordinates, m, and the covariance that the track's errors alone leave, m^2.
    pub estimate: MapEstimate,
    /// Standard deviation of the inverse range from the first view, relative to it.
    pub relative_range_sd: f64,
}

impl<'a> PlacedTrack<'a> {
    /// Finds poses and cameras of a track; its depths count if `uses_depth`.
    pub fn new(
        track: &'a Track,
        state: &JointState,
        cameras: &'a [MountedCamera],
        uses_depth: bool,
    ) -> Result<Self, FilterError> {
        let mut placed = Self {
            track,
            views: Vec::with_capacity(track.views.len()),
            with_depth: Vec::new(),
            pixel_weights: Vec::with_capacity(track.views.len()),
            depth_root: None,
            blocks: Vec::new(),
            calibration: state.calibration,
        };
        for view in &track.views {
            placed.place(view, state, cameras)?;
            placed.pixel_weights.push(pixel_weight(view)?);
        }
        if uses_depth {
            placed.with_depth =
                (0..track.views.len()).filter(|k| track.views[*k].depth.is_some()).collect();
        }
        placed.depth_root = placed.root_of_depths()?;
        let calibration = state.calibration.iter().flat_map(|_| [0, 1]);
        placed.blocks.extend(calibration.map(|k| state.row(Block::Calibration(k))));
        Ok(placed)
    }

    fn place(
        &mut self,
        view: &'a TrackView,
        state: &JointState,
        cameras: &'a [MountedCamera],
    ) -> Result<(), FilterError> {
        let clone = view.clone.0;
        let slot = state.clone_slot(view.clone).ok_or(FilterError::UnknownClone(clone))?;
        let (camera, track) = (view.camera, self.track.id);
        let mounted = MountedCamera::among(cameras, camera)?;
        let seen_twice =
            self.views.iter().any(|v| (v.view.clone, v.view.camera) == (view.clone, camera));
        if seen_twice || state.clones[slot].has_used(track, camera) {
            return Err(FilterError::RowUsedTwice { track, clone });
        }
        finite("pixel of a track", view.pixel.coords.as_slice())?;
        let row = state.row(Block::Clone(slot));
        let known = self.blocks.iter().position(|block| *block == row);
        let block = known.unwrap_or(self.blocks.len());
        if known.is_none() {
            self.blocks.extend([row, row + 3]);
        }
        let world_from_body = state.clones[slot].world_from_body;
        self.views.push(PlacedView { world_from_body, mounted, view, block });
        Ok(())
    }

    /// Root of the covariance of the depths, `diag(sigma_w^2) + s s^T`.
    fn root_of_depths(&self) -> Result<Option<DMatrix<f64>>, FilterError> {
        let depths: Vec<_> =
            self.with_depth.iter().filter_map(|k| self.track.views[*k].depth).collect();
        if depths.is_empty() {
            return Ok(None);
        }
        for depth in &depths {
            finite("depth of a track", &[depth.depth])?;
        }
        let common = DVector::from_iterator(
            depths.len(),
            depths.iter().map(|depth| depth.common_variance.sqrt()),
        );
        let mut covariance = &common * common.transpose();
        for (k, depth) in depths.iter().enumerate() {
            covariance[(k, k)] += depth.variance;
        }
        let not_positive = FilterError::NotPositive("covariance of a track's depths");
        let root = covariance.cholesky().ok_or(not_positive)?.unpack();
        finite("covariance of a track's depths", root.as_slice())?;
        Ok(Some(root))
    }

    /// Rows of the track, before its point is eliminated.
    pub fn rows(&self) -> usize {
        2 * self.views.len() + self.with_depth.len()
    }

    /// First rows of the blocks of the state that the track's rows depend on.
    pub fn blocks(&self) -> &[usize] {
        &self.blocks
    }

    /// The views of each row.
    fn row_views(&self) -> impl Iterator<Item = (usize, &PlacedView<'a>)> {
        let pixels = (0..self.views.len()).flat_map(|k| [k, k]);
        pixels.chain(self.with_depth.iter().copied()).map(|k| &self.views[k]).enumerate()
    }

    /// Residuals at a point (world coordinates), and their derivative by it as seen from the bodies;
    /// `None` where a camera does not image it. With `c = C^T (R_k^T (l - p_k) - s)`
    ///
    /// `r = z - pi(c) = d pi/dc C^T dc_k + n`, `r_d = z_d - d(c) = d d/dc C^T dc_k + n_d`.
    fn by_body(&self, point: &Vector3<f64>) -> Option<(DVector<f64>, OMatrix<f64, Dyn, U3>)> {
        let mut residual = DVector::zeros(self.rows());
        let mut by_body = OMatrix::<f64, Dyn, U3>::zeros(self.rows());
        for (k, placed) in self.views.iter().enumerate() {
            let in_camera = placed.in_camera(point);
            let (pixel, by_camera) = placed.mounted.camera.project_with_jacobian(&in_camera)?;
            let by_pixel = by_camera * placed.camera_from_body();
            residual.fixed_rows_mut::<2>(2 * k).copy_from(&(placed.view.pixel - pixel));
            by_body.fixed_rows_mut::<2>(2 * k).copy_from(&by_pixel);
        }
        for (j, k) in self.with_depth.iter().enumerate() {
            let (placed, row) = (&self.views[*k], 2 * self.views.len() + j);
            let (camera, in_camera) = (&placed.mounted.camera, placed.in_camera(point));
            let measured = placed.view.depth?.depth;
            let along = camera.depth_direction(&in_camera).transpose();
            residual[row] = measured - camera.depth_of(&in_camera);
            by_body.fixed_rows_mut::<1>(row).copy_from(&(along * placed.camera_from_body()));
        }
        Some((residual, by_body))
    }

    /// Rows at a point of the world. With errors `e_k`, `e_pk` of the pose of a view and `e_l` of the
    /// point,
    ///
    /// `dc_k = R_k^T (e_l - e_pk) + c_k x e_k`,
    ///
    /// and a wrong mounting moves what a camera shows by minus what it moves points seen
    /// ([`Calibration`]). These are the errors between updates; those of an update follow by a linear
    /// change of coordinates at the same means.
    pub fn linearized(&self, point: &Vector3<f64>) -> Option<TrackRows> {
        let (mut residual, by_body) = self.by_body(point)?;
        let mut by_point = OMatrix::<f64, Dyn, U3>::zeros(self.rows());
        let mut jacobian = DMatrix::zeros(self.rows(), 3 * self.blocks.len());
        let mounting = 3 * (self.blocks.len() - if self.calibration.is_some() { 2 } else { 0 });
        for (row, placed) in self.row_views() {
            let by_body = by_body.row(row);
            let rotation = placed.world_from_body.rotation.to_rotation_matrix();
            let in_body = placed.world_from_body.inverse_transform_point(&Point3::from(*point));
            let by_world = by_body * rotation.matrix().transpose();
            let mut set = |column: usize, part: nalgebra::RowVector3<f64>| {
                jacobian.fixed_view_mut::<1, 3>(row, column).copy_from(&part);
            };
            set(3 * placed.block, by_body * in_body.coords.cross_matrix());
            set(3 * placed.block + 3, -by_world);
            if let Some(calibration) = &self.calibration {
                let [by_turn, by_shift] = calibration.by_mounting(&in_body.coords);
                set(mounting, -(by_body * by_turn));
                set(mounting + 3, -(by_body * by_shift));
            }
            by_point.set_row(row, &by_world);
        }
        self.whiten(&mut residual);
        jacobian.column_iter_mut().for_each(|column| self.whiten_column(column));
        by_point.column_iter_mut().for_each(|column| self.whiten_column(column));
        Some(TrackRows { residual, jacobian, by_point })
    }

    fn whiten(&self, residual: &mut DVector<f64>) {
        self.whiten_column(residual.column_mut(0));
    }

    /// Brings the rows of a column to white noise of variance one.
    fn whiten_column(&self, mut column: nalgebra::DVectorViewMut<'_, f64>) {
        for (k, weight) in self.pixel_weights.iter().enumerate() {
            let mut pixel = column.fixed_rows_mut::<2>(2 * k);
            let white = weight * &pixel;
            pixel.copy_from(&white);
        }
        if let Some(root) = &self.depth_root {
            let mut depths = column.rows_mut(2 * self.views.len(), self.with_depth.len());
            // A root that was found by Cholesky's method has no zero on its diagonal.
            root.solve_lower_triangular_unchecked_mut(&mut depths);
        }
    }

    /// The point that fits best.
    pub fn triangulate(&self) -> Result<Triangulated, FilterError> {
        let no_point = FilterError::NoPoint(self.track.id);
        let ray = self.ray().ok_or(no_point)?;
        let far = Vector3::new(0.0, 0.0, LEAST_INVERSE_RANGE);
        let near = self.start(&ray).and_then(|start| self.fit(&ray, start));
        let start = near.or_else(|| self.fit(&ray, far)).ok_or(no_point)?;
        let fit = self.descend(&ray, start);
        let normal = fit.by_ray.transpose() * &fit.by_ray;
        let covariance = inverse_of_normal(&normal).ok_or(no_point)?;
        let by_parameters = ray.derivative(&fit.parameters);
        let relative_range_sd = covariance[(2, 2)].sqrt() / fit.parameters.z;
        let covariance = by_parameters * covariance * by_parameters.transpose();
        let position = ray.point(&fit.parameters);
        Ok(Triangulated { estimate: MapEstimate { position, covariance }, relative_range_sd })
    }

    /// The ray of the view that defines the point, else of the first.
    fn ray(&self) -> Option<Ray> {
        let defines = |placed: &&PlacedView<'_>| placed.view.pixel_covariance == Matrix2::zeros();
        let anchor = self.views.iter().find(defines).or(self.views.first())?;
        Some(Ray { from: anchor.centre(), axes: axes_along(&anchor.bearing_in_world()?) })
    }

    /// Where along the ray the search starts: at the first depth that counts, else at the nearest
    /// point to the rays of all views, `sum (I - b b^T)(l - o) = 0`.
    fn start(&self, ray: &Ray) -> Option<Vector3<f64>> {
        let by_depth = self.with_depth.first().and_then(|k| self.views[*k].at_depth());
        let point = by_depth.or_else(|| {
            let (mut normal, mut side) = (Matrix3::zeros(), Vector3::zeros());
            for placed in &self.views {
                let bearing = placed.bearing_in_world()?;
                let across = Matrix3::identity() - bearing * bearing.transpose();
                normal += across;
                side += across * (placed.centre() - ray.from);
            }
            Some(ray.from + normal.cholesky()?.solve(&side))
        })?;
        let range = ray.axes.column(2).dot(&(point - ray.from));
        (range > 0.0).then(|| Vector3::new(0.0, 0.0, range.recip().max(LEAST_INVERSE_RANGE)))
    }

    fn fit(&self, ray: &Ray, parameters: Vector3<f64>) -> Option<Fit> {
        let point = ray.point(&parameters);
        let (mut residual, by_body) = self.by_body(&point)?;
        let mut by_ray = OMatrix::<f64, Dyn, U3>::zeros(self.rows());
        let by_parameters = ray.derivative(&parameters);
        for (row, placed) in self.row_views() {
            let rotation = placed.world_from_body.rotation.to_rotation_matrix();
            let by_point = by_body.row(row) * rotation.matrix().transpose();
            by_ray.set_row(row, &(by_point * by_parameters));
        }
        self.whiten(&mut residual);
        by_ray.column_iter_mut().for_each(|column| self.whiten_column(column));
        let cost = residual.norm_squared();
        cost.is_finite().then_some(Fit { parameters, residual, by_ray, cost })
    }

    /// Levenberg's method on the whitened residuals.
    fn descend(&self, ray: &Ray, start: Fit) -> Fit {
        let (mut fit, mut damping) = (start, 1e-4);
        for _ in 0..STEPS {
            let mut normal = fit.by_ray.transpose() * &fit.by_ray;
            for k in 0..3 {
                normal[(k, k)] += damping * normal[(k, k)] + f64::MIN_POSITIVE;
            }
            let Some(factor) = normal.cholesky() else { break };
            let step = factor.solve(&(fit.by_ray.transpose() * &fit.residual));
            let mut next = fit.parameters + step;
            next.z = next.z.max(LEAST_INVERSE_RANGE);
            let moved = next - fit.parameters;
            let settled = moved.xy().norm().max(moved.z.abs() / next.z) < CONVERGED;
            let bound = fit.cost * (1.0 + COST_ROUNDING);
            match self.fit(ray, next).filter(|found| found.cost <= bound) {
                Some(found) => (fit, damping) = (found, 0.1 * damping),
                None => damping *= 10.0,
            }
            if settled {
                break;
            }
        }
        fit
    }
}

/// How parameters of a ray fit, whitened.
struct Fit {
    parameters: Vector3<f64>,
    residual: DVector<f64>,
    by_ray: OMatrix<f64, Dyn, U3>,
    cost: f64,
}

impl PlacedView<'_> {
    fn camera_from_body(&self) -> Matrix3<f64> {
        self.mounted.body_from_camera.rotation.to_rotation_matrix().matrix().transpose()
    }

    fn in_camera(&self, point: &Vector3<f64>) -> Vector3<f64> {
        let in_body = self.world_from_body.inverse_transform_point(&Point3::from(*point));
        self.mounted.body_from_camera.inverse_transform_point(&in_body).coords
    }

    fn world_from_camera(&self) -> Isometry3<f64> {
        self.world_from_body * self.mounted.body_from_camera
    }

    fn centre(&self) -> Vector3<f64> {
        self.world_from_camera().translation.vector
    }

    fn bearing_in_world(&self) -> Option<Vector3<f64>> {
        let bearing = self.mounted.camera.bearing(self.view.pixel)?;
        Some(self.world_from_camera().rotation * bearing.into_inner())
    }

    /// The point that the view's own depth says, world coordinates.
    fn at_depth(&self) -> Option<Vector3<f64>> {
        let in_camera = self.mounted.camera.unproject(self.view.pixel, self.view.depth?.depth)?;
        Some((self.world_from_camera() * Point3::from(in_camera)).coords)
    }
}

/// `W` with `W^T W` the inverse of a pixel's covariance.
fn pixel_weight(view: &TrackView) -> Result<Matrix2<f64>, FilterError> {
    let covariance = match view.pixel_covariance {
        zero if zero == Matrix2::zeros() => Matrix2::from_diagonal_element(DEFINING_SD.powi(2)),
        given => given,
    };
    let not_positive = FilterError::NotPositive("covariance of a pixel");
    let root = Cholesky::new(covariance).ok_or(not_positive)?.l();
    let weight = root.try_inverse().ok_or(not_positive)?;
    finite("covariance of a pixel", weight.as_slice())?;
    Ok(weight)
}

/// The inverse of a normal matrix; the inverse range of a point that shows no parallax has a
/// standard deviation of 1/m.
fn inverse_of_normal(normal: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    let mut normal = *normal;
    normal[(2, 2)] += 1.0;
    Some(normal.cholesky()?.inverse())
}
