//! The regression of the Euclidean state on the rotation, and how points condition it.

use std::ops::Range;

use nalgebra::{DMatrix, DVector, Dyn, Matrix3, OMatrix, Rotation3, SMatrix, SVector, U3, Vector3};

use super::error_state::{AttitudeDensity, BIASES, ErrorState};
use super::rows::UpdateRows;
use crate::distribution::rotation_quadratic::{
    RotationQuadratic, rotated_vector_by_rotation, vectorize,
};
use crate::so3;

/// The position's block of the Euclidean part.
const POSITION: usize = 1;
/// Points that are conditioned on at once. Their innovations are decorrelated by substitution,
/// whose cost grows with the size of the batch; all that follows is matrix products.
const BATCH: usize = 16;
/// The same in rows.
const BATCH_ROWS: usize = 3 * BATCH;
/// Columns of the covariance that are updated at once, a multiple of three.
const PANEL: usize = 96;

/// A point measured in the body frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Measurement {
    /// Body coordinates, m.
    pub in_body: Vector3<f64>,
    /// Body coordinates, m^2.
    pub body_covariance: Matrix3<f64>,
    pub target: Target,
}

/// What was measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Target {
    /// A block of the Euclidean part. Where the calibration is part of the state, too, such a
    /// block is the point as the camera sees it, mounted as estimated.
    State { block: usize },
    /// A point known independently of the state, world coordinates (m, m^2). It was placed by
    /// the same calibration, of which it therefore tells nothing.
    Known { position: Vector3<f64>, covariance: Matrix3<f64> },
}

/// Density of the rotation and the Euclidean part `x` given it (W22 chapter 3, with the
/// regression kept whole): with `y = (vec(R) - vec(R_hat), 1)` or `(e, 1)`,
///
/// `x = x_0(R) + slope y + noise(covariance)`, `-2 log p(R) = -2 log p_0(R) + y^T evidence y`.
///
/// `x_0` is that of [`ErrorState`]. A point measured at `p'` has the residual
/// `R p' + p - l = exp(t^) (q + J(t)^T (u_p - u_l))`, `u = B t + noise`, where `q` is the residual at
/// the estimate. As its covariance `A` turns with the body, it is weighed with `R` at the estimate
/// and without the first factor, and `q` says nothing about `R`. (Turning it under a weight that
/// does not turn would add information about `R` with every anisotropic measurement, whatever is
/// measured.) What `J(t)` adds is of second order, and taken from an [`Expansion`].
pub(super) struct Regression<'a> {
    error: ErrorState,
    prior: &'a Rotation3<f64>,
    prior_means: &'a [Vector3<f64>],
    /// Blocks of the calibration and of cloned poses, which are no vectors of the world either.
    unturned: Range<usize>,
    rotation_information: Matrix3<f64>,
    rotation_covariance: Matrix3<f64>,
    slope: DMatrix<f64>,
    /// Blocks of three on and above the diagonal; those below it are out of date.
    covariance: DMatrix<f64>,
    evidence: DMatrix<f64>,
}

/// Where terms of second order are taken from: what an update came to.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Expansion {
    pub mode: Rotation3<f64>,
    /// `u` of the blocks of the Euclidean part.
    pub moved: Vec<Vector3<f64>>,
}

impl Expansion {
    /// The prediction, where there are none.
    pub fn of_prior(prior: &Rotation3<f64>, blocks: usize) -> Self {
        Self { mode: *prior, moved: vec![Vector3::zeros(); blocks] }
    }
}

/// Mode of the rotation, the Euclidean part there, and the covariance of (body-frame rotation
/// error, Euclidean part).
pub(super) struct Posterior {
    pub means: Vec<Vector3<f64>>,
    pub covariance: DMatrix<f64>,
    pub expansion: Expansion,
}

impl<'a> Regression<'a> {
    /// Of a concentrated belief: the mode of the rotation, the means of the blocks of three of
    /// the Euclidean part (of which those in `unturned` are no vectors of the world), and the
    /// covariance of both. `None` if the rotation's is not positive definite.
    pub fn of_prior(
        error: ErrorState,
        prior: &'a Rotation3<f64>,
        prior_means: &'a [Vector3<f64>],
        unturned: Range<usize>,
        covariance: &DMatrix<f64>,
    ) -> Option<Self> {
        let n = covariance.ncols() - 3;
        let rotation_covariance = covariance.fixed_view::<3, 3>(0, 0).into_owned();
        let rotation_information = rotation_covariance.cholesky()?.inverse();
        let cross = covariance.view((3, 0), (n, 3));
        let mut by_rotation = cross * rotation_information;
        let mut conditional = DMatrix::zeros(n, n);
        conditional.copy_from(&covariance.view((3, 3), (n, n)));
        conditional.gemm(-1.0, &by_rotation, &cross.transpose(), 1.0);

        let mut sum = Self {
            error,
            prior,
            prior_means,
            unturned,
            rotation_information,
            rotation_covariance,
            slope: DMatrix::zeros(n, error.size()),
            covariance: conditional,
            evidence: DMatrix::zeros(error.size(), error.size()),
        };
        for (k, mean) in prior_means.iter().enumerate().filter(|(k, _)| sum.turns(*k)) {
            let in_body = prior.inverse() * mean;
            let mut rows = by_rotation.fixed_view_mut::<3, 3>(3 * k, 0);
            rows += prior.matrix() * in_body.cross_matrix();
        }
        if error.is_matrix_fisher() {
            let sine = tangent_coordinate(prior.matrix());
            sum.slope.columns_mut(0, 9).copy_from(&(by_rotation * sine));
        } else {
            sum.slope.columns_mut(0, 3).copy_from(&by_rotation);
        }
        Some(sum)
    }

    /// Whether a block of `x_0` turns with the body.
    fn turns(&self, block: usize) -> bool {
        self.error.is_invariant() && !BIASES.contains(&block) && !self.unturned.contains(&block)
    }

    /// Squared Mahalanobis distance of each measurement from what is expected of it.
    pub fn squared_distances(&self, measurements: &[Measurement]) -> Option<Vec<f64>> {
        let at_prior = self.error.at_prior();
        let derivative = self.error.derivative(self.prior);
        let expansion = Expansion::of_prior(self.prior, self.prior_means.len());
        measurements
            .iter()
            .map(|m| Some(self.noise(m, &expansion, 0.0, &at_prior, &derivative)?.1))
            .collect()
    }

    /// Bayes' rule, with terms of second order and the attitude by which noise is turned to the
    /// world taken from `expansion`. Covariances are inflated so that weights fall by Huber's law
    /// beyond a Mahalanobis distance of `huber` (0: never). Gives the squared normalised
    /// innovation per degree of freedom.
    pub fn condition(
        &mut self,
        measurements: &[Measurement],
        expansion: &Expansion,
        huber: f64,
    ) -> Option<f64> {
        let at_prior = self.error.at_prior();
        let derivative = self.error.derivative(self.prior);
        let noises: Vec<_> = measurements
            .iter()
            .map(|m| Some(self.noise(m, expansion, huber, &at_prior, &derivative)?.0))
            .collect::<Option<_>>()?;
        for (batch, noises) in measurements.chunks(BATCH).zip(noises.chunks(BATCH)) {
            self.condition_batch(batch, noises, expansion)?;
        }

        let squared = self.squared_innovation()?;
        Some(squared / (3.0 * measurements.len() as f64))
    }

    /// Squared Mahalanobis distance of all innovations so far.
    fn squared_innovation(&self) -> Option<f64> {
        let at_prior = self.error.at_prior();
        let derivative = self.error.derivative(self.prior);
        let total = (at_prior.transpose() * &self.evidence * &at_prior)[(0, 0)];
        let gradient = derivative.transpose() * &self.evidence * &at_prior;
        let explained = self.information().cholesky()?.solve(&gradient.fixed_view::<3, 1>(0, 0));
        let explained = gradient.fixed_view::<3, 1>(0, 0).dot(&explained);
        Some((total - explained).max(0.0))
    }

    /// Bayes' rule for rows that are linear in the error where `expansion` came to, with errors
    /// counted from the prediction: `0 = H (u - u_i) + H_e (e - e_i) - residual + noise`. Gives the
    /// squared Mahalanobis distance of all innovations so far.
    pub fn condition_rows(&mut self, rows: &UpdateRows, expansion: &Expansion) -> Option<f64> {
        let turned = so3::log(&(self.prior.inverse() * expansion.mode));
        let mut moved = DVector::zeros(rows.jacobian.ncols());
        for (k, block) in rows.blocks.iter().enumerate() {
            moved.fixed_rows_mut::<3>(3 * k).copy_from(&expansion.moved[*block]);
        }
        let expected = &rows.residual + &rows.jacobian * moved + &rows.by_rotation * turned;
        let count = rows.residual.len();
        for first in (0..count).step_by(BATCH_ROWS) {
            self.condition_row_batch(rows, &expected, first, BATCH_ROWS.min(count - first))?;
        }
        self.squared_innovation()
    }

    /// The same for some of the rows, of which the residuals are counted from the prediction.
    fn condition_row_batch(
        &mut self,
        rows: &UpdateRows,
        residual: &DVector<f64>,
        first: usize,
        len: usize,
    ) -> Option<()> {
        let h = rows.jacobian.rows(first, len);
        let by_rotation = rows.by_rotation.rows(first, len);
        let n = self.covariance.ncols();
        let mut columns = DMatrix::zeros(n, h.ncols());
        let mut slope = DMatrix::zeros(h.ncols(), self.error.size());
        for (k, block) in rows.blocks.iter().enumerate() {
            columns.fixed_columns_mut::<3>(3 * k).copy_from(&self.columns(*block));
            slope.rows_mut(3 * k, 3).copy_from(&self.slope.rows(3 * block, 3));
        }
        let cross = columns * h.transpose();
        let mut of_blocks = DMatrix::zeros(h.ncols(), len);
        for (k, block) in rows.blocks.iter().enumerate() {
            of_blocks.rows_mut(3 * k, 3).copy_from(&cross.rows(3 * block, 3));
        }
        let mut innovation = h * of_blocks;
        (0..len).for_each(|k| innovation[(k, k)] += 1.0);
        let mut design = h * slope;
        let mut by_coordinate = design.columns_mut(0, self.error.size() - 1);
        by_coordinate += by_rotation * self.coordinate_by_y();
        let mut constant = design.column_mut(self.error.size() - 1);
        constant -= residual.rows(first, len);
        self.absorb(cross, innovation, design)
    }

    /// Derivative by `y`, without its last entry, of the rotation error that the regression is on.
    fn coordinate_by_y(&self) -> OMatrix<f64, U3, Dyn> {
        let size = self.error.size() - 1;
        if self.error.is_matrix_fisher() {
            let sine = tangent_coordinate(self.prior.matrix());
            OMatrix::<f64, U3, Dyn>::from_fn(size, |i, j| sine[(i, j)])
        } else {
            OMatrix::<f64, U3, Dyn>::identity(size)
        }
    }

    /// Covariance of a measurement in world coordinates, as robust weighting leaves it, and its
    /// squared Mahalanobis distance.
    fn noise(
        &self,
        measurement: &Measurement,
        expansion: &Expansion,
        huber: f64,
        at_prior: &DMatrix<f64>,
        derivative: &DMatrix<f64>,
    ) -> Option<(Matrix3<f64>, f64)> {
        let turn = match measurement.target {
            Target::State { .. } if self.error.is_invariant() => self.prior.matrix(),
            _ => expansion.mode.matrix(),
        };
        let mut noise = turn * measurement.body_covariance * turn.transpose();
        if let Target::Known { covariance, .. } = measurement.target {
            noise += covariance;
        }
        let rows = self.design(measurement, expansion);
        let residual = (&rows * at_prior).fixed_view::<3, 1>(0, 0).into_owned();
        let by_rotation = (rows * derivative).fixed_view::<3, 3>(0, 0).into_owned();
        let spread = self.residual_covariance(measurement)
            + by_rotation * self.rotation_covariance * by_rotation.transpose()
            + noise;
        let squared = residual.dot(&spread.cholesky()?.solve(&residual));
        let distance = squared.sqrt();
        let robust = huber > 0.0 && distance > huber;
        Some((if robust { noise * (distance / huber) } else { noise }, squared))
    }

    /// Derivative by `y` of the residual `R p' + p - l`, the regression of `x` included (3 x c).
    fn design(&self, measurement: &Measurement, expansion: &Expansion) -> DMatrix<f64> {
        let position = self.prior_means[POSITION];
        let mut rows = self.slope.rows(3 * POSITION, 3).into_owned();
        let target = match measurement.target {
            Target::State { block } => {
                rows -= self.slope.rows(3 * block, 3);
                self.prior_means[block]
            }
            Target::Known { position, .. } => position,
        };
        let expected = self.prior.inverse() * (target - position);
        let last = rows.ncols() - 1;
        match (self.error, measurement.target) {
            // A point of the state turns with the body by itself, a known one stays.
            (ErrorState::RightInvariant { .. }, Target::State { .. }) => {}
            (ErrorState::RightInvariant { density: AttitudeDensity::MatrixFisher }, _) => {
                let in_body = self.prior.inverse() * target;
                for i in 0..3 {
                    for k in 0..3 {
                        rows[(i, 3 * k + i)] += in_body[k];
                    }
                }
            }
            (ErrorState::RightInvariant { density: AttitudeDensity::Gaussian }, _) => {
                let in_body = self.prior.inverse() * target;
                let mut turn = rows.fixed_view_mut::<3, 3>(0, 0);
                turn -= self.prior.matrix() * in_body.cross_matrix();
            }
            (ErrorState::So3xRn, _) => {
                let mut turn = rows.fixed_view_mut::<3, 3>(0, 0);
                turn -= self.prior.matrix() * expected.cross_matrix();
            }
        }
        let mut column = rows.fixed_view_mut::<3, 1>(0, last);
        column += self.prior * (measurement.in_body - expected);
        column += self.second_order(measurement, expansion);
        rows
    }

    /// What the residual has beyond its linear terms.
    fn second_order(&self, measurement: &Measurement, expansion: &Expansion) -> Vector3<f64> {
        let turn = so3::log(&(expansion.mode * self.prior.inverse()));
        let position = expansion.moved[POSITION];
        match (self.error, measurement.target) {
            (ErrorState::So3xRn, _) => Vector3::zeros(),
            (ErrorState::RightInvariant { .. }, Target::State { block }) => {
                let moved = position - expansion.moved[block];
                so3::right_jacobian(&turn) * moved - moved
            }
            (ErrorState::RightInvariant { .. }, Target::Known { .. }) => {
                so3::left_jacobian(&turn) * position - position
            }
        }
    }

    /// Covariance of the residual of a measurement given the rotation, without noise.
    fn residual_covariance(&self, measurement: &Measurement) -> Matrix3<f64> {
        let block = |i: usize, j: usize| self.covariance.fixed_view::<3, 3>(3 * i, 3 * j);
        let position = block(POSITION, POSITION);
        match measurement.target {
            Target::State { block: point } => {
                let cross = block(POSITION.min(point), POSITION.max(point));
                position + block(point, point) - cross - cross.transpose()
            }
            Target::Known { .. } => position.into_owned(),
        }
    }

    /// Covariance of `x` given the rotation with one of its blocks (n x 3).
    fn columns(&self, block: usize) -> OMatrix<f64, Dyn, U3> {
        let (n, start) = (self.covariance.nrows(), 3 * block);
        let above = start + 3;
        let mut columns = OMatrix::<f64, Dyn, U3>::zeros(n);
        columns.rows_mut(0, above).copy_from(&self.covariance.view((0, start), (above, 3)));
        let below = self.covariance.view((start, above), (3, n - above)).transpose();
        columns.rows_mut(above, n - above).copy_from(&below);
        columns
    }

    fn condition_batch(
        &mut self,
        batch: &[Measurement],
        noises: &[Matrix3<f64>],
        expansion: &Expansion,
    ) -> Option<()> {
        let (n, m) = (self.covariance.ncols(), 3 * batch.len());
        // Covariance of x and the innovations, columns of which are contiguous.
        let mut cross = DMatrix::zeros(n, m);
        let mut design = DMatrix::zeros(m, self.error.size());
        let position = self.columns(POSITION);
        for (i, measurement) in batch.iter().enumerate() {
            let mut columns = cross.fixed_columns_mut::<3>(3 * i);
            columns.copy_from(&position);
            if let Target::State { block } = measurement.target {
                columns -= self.columns(block);
            }
            design.rows_mut(3 * i, 3).copy_from(&self.design(measurement, expansion));
        }
        let mut innovation = DMatrix::zeros(m, m);
        for (i, (measurement, noise)) in batch.iter().zip(noises).enumerate() {
            let mut rows = innovation.rows_mut(3 * i, 3);
            rows += cross.rows(3 * POSITION, 3);
            if let Target::State { block } = measurement.target {
                rows -= cross.rows(3 * block, 3);
            }
            let mut own = innovation.fixed_view_mut::<3, 3>(3 * i, 3 * i);
            own += noise;
        }
        self.absorb(cross, innovation, design)
    }

    /// Bayes' rule for innovations of which the covariance with `x` given the rotation (n x m), their
    /// own, and the derivative by `y` are given.
    fn absorb(
        &mut self,
        mut cross: DMatrix<f64>,
        innovation: DMatrix<f64>,
        mut design: DMatrix<f64>,
    ) -> Option<()> {
        let m = innovation.ncols();
        let factor = innovation.cholesky()?.unpack();
        // Decorrelated innovations: the columns of `cross L^-T`.
        for j in 0..m {
            let (before, mut from_j) = cross.columns_range_pair_mut(0..j, j..m);
            let mut column = from_j.column_mut(0);
            for i in 0..j {
                column.axpy(-factor[(j, i)], &before.column(i), 1.0);
            }
            column /= factor[(j, j)];
        }
        factor.solve_lower_triangular_mut(&mut design).then_some(())?;

        subtract_square(&mut self.covariance, &cross);
        self.slope.gemm(-1.0, &cross, &design, 1.0);
        self.evidence += design.transpose() * &design;
        Some(())
    }

    /// Information about the body-frame rotation error, at the estimate.
    fn information(&self) -> Matrix3<f64> {
        let derivative = self.error.derivative(self.prior);
        let evidence = derivative.transpose() * &self.evidence * &derivative;
        self.rotation_information + evidence.fixed_view::<3, 3>(0, 0)
    }

    /// The concentrated belief around this density's mode.
    ///
    /// Errors of the posterior are taken for those of the prediction, in the group's coordinates:
    /// what cannot be observed is then the same before and after, whatever the update corrects.
    /// (The derivatives at the mode would mix it with the rest by terms of second order, which
    /// after a few updates is information about the heading.)
    pub fn posterior(self) -> Option<Posterior> {
        let mode = if self.error.is_matrix_fisher() {
            self.rotation_density().mode(self.prior)?.0
        } else {
            self.gaussian_mode()?
        };
        // Body coordinates of the mode to those of the estimate, by way of the world where the
        // error is the group's.
        let error = if self.error.is_invariant() {
            self.prior.inverse() * mode
        } else {
            Rotation3::identity()
        };
        let inverse = self.information().cholesky()?.inverse();
        let rotation_covariance = error.matrix().transpose() * inverse * error.matrix();
        let last = self.error.size() - 1;
        let slope = &self.slope * self.error.derivative(self.prior);
        let turn = so3::log(&(self.prior.inverse() * mode));
        let displacement = self.slope.column(last) + &slope * turn;
        let left_jacobian = so3::left_jacobian(&(self.prior * turn));

        let mut by_rotation = slope * error.matrix();
        let mut means = self.prior_means.to_vec();
        let mut moved = Vec::with_capacity(means.len());
        for (k, mean) in means.iter_mut().enumerate() {
            let by = displacement.fixed_rows::<3>(3 * k).into_owned();
            moved.push(by);
            if self.turns(k) {
                *mean = mode * (self.prior.inverse() * *mean) + left_jacobian * by;
                let mut rows = by_rotation.fixed_view_mut::<3, 3>(3 * k, 0);
                rows -= mode.matrix() * (mode.inverse() * *mean).cross_matrix();
            } else {
                *mean += by;
            }
        }

        let n = self.covariance.ncols();
        let cross = &by_rotation * rotation_covariance;
        let mut euclidean = self.covariance;
        euclidean.gemm(1.0, &cross, &by_rotation.transpose(), 1.0);
        let mut covariance = DMatrix::zeros(n + 3, n + 3);
        covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation_covariance);
        covariance.view_mut((0, 3), (3, n)).copy_from(&cross.transpose());
        covariance.view_mut((3, 3), (n, n)).copy_from(&euclidean);
        covariance.fill_lower_triangle_with_upper_triangle();
        Some(Posterior { means, covariance, expansion: Expansion { mode, moved } })
    }

    /// Matrix Fisher prior times the evidence.
    fn rotation_density(&self) -> RotationQuadratic {
        let prior = self.prior.matrix() * concentration(&self.rotation_information);
        let quadratic: SMatrix<f64, 9, 9> = self.evidence.fixed_view::<9, 9>(0, 0).into_owned();
        let linear: SVector<f64, 9> = vectorize(&prior)
            + quadratic * vectorize(self.prior.matrix())
            - self.evidence.fixed_view::<9, 1>(0, 9);
        RotationQuadratic { linear, quadratic }
    }

    fn gaussian_mode(&self) -> Option<Rotation3<f64>> {
        let gradient = self.evidence.fixed_view::<3, 1>(0, 3);
        let error = -self.information().cholesky()?.solve(&gradient);
        Some(self.prior * Rotation3::new(error))
    }
}

impl ErrorState {
    /// Length of `y`.
    fn size(self) -> usize {
        if self.is_matrix_fisher() { 10 } else { 4 }
    }

    /// `y` at the estimate.
    fn at_prior(self) -> DMatrix<f64> {
        let mut y = DMatrix::zeros(self.size(), 1);
        y[(self.size() - 1, 0)] = 1.0;
        y
    }

    /// Derivative of `y` by the body-frame rotation error.
    fn derivative(self, rotation: &Rotation3<f64>) -> DMatrix<f64> {
        let mut derivative = DMatrix::zeros(self.size(), 3);
        if self.is_matrix_fisher() {
            let by_turn = rotated_vector_by_rotation(rotation.matrix());
            derivative.fixed_view_mut::<9, 3>(0, 0).copy_from(&by_turn);
        } else {
            derivative.fill_with_identity();
        }
        derivative
    }
}

/// Subtracts `factor factor^T` from a symmetric matrix of which blocks on and above the diagonal
/// count: half the work of the whole product.
fn subtract_square(matrix: &mut DMatrix<f64>, factor: &DMatrix<f64>) {
    let n = matrix.ncols();
    for first in (0..n).step_by(PANEL) {
        let width = PANEL.min(n - first);
        let rows = first + width;
        let own = factor.rows(first, width).transpose();
        matrix.view_mut((0, first), (rows, width)).gemm(-1.0, &factor.rows(0, rows), &own, 1.0);
    }
}

/// `K` of a matrix Fisher density `F = M K` with the given information (minus the Hessian of its
/// logarithm at the mode): `K = tr(H)/2 I - H`.
fn concentration(information: &Matrix3<f64>) -> Matrix3<f64> {
    Matrix3::identity() * (0.5 * information.trace()) - information
}

/// The 3x9 matrix `L` with `L vec(R) = (M^T R - R^T M)^vee / 2`, the sine of the turn from the mode
/// `M` along its axis, body coordinates: the turn itself but for terms of third order.
///
/// `v_R` (W22 3.2) is as linear in `R`, but where the axes are known unequally well it has terms of
/// second order, `(k_i - k_j) e_i e_j`: through the slope of precisely measured points they bend
/// the density until its curvature says nothing of its width.
fn tangent_coordinate(mode: &Matrix3<f64>) -> SMatrix<f64, 3, 9> {
    let left = mode.transpose() * 0.5;
    let mut l = SMatrix::zeros();
    for (component, (i, j)) in [(2, 1), (0, 2), (1, 0)].into_iter().enumerate() {
        for k in 0..3 {
            l[(component, 3 * j + k)] += left[(i, k)];
            l[(component, 3 * i + k)] -= left[(j, k)];
        }
    }
    l
}
