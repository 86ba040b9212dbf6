//! Sub-pixel alignment of image patches: where exactly in this image lies the point whose
//! surroundings another image showed.
//!
//! A detector places a corner to about half a pixel, anew in every frame. Aligning what is around
//! it with what was around the same point when it entered the map is several times as exact, and
//! it does not drift, because the reference stays the same.

use nalgebra::{Matrix2, SMatrix, SVector, Vector2};
use serde::{Deserialize, Serialize};

/// Half the side of a stored patch, pixels of its pyramid level.
pub const PATCH_RADIUS: usize = 10;
const SIDE: usize = 2 * PATCH_RADIUS + 1;
/// Half the side of the window that is compared.
const WINDOW_RADIUS: usize = 4;
const WINDOW: usize = 2 * WINDOW_RADIUS + 1;
/// The window and the ring that its gradients need.
const TEMPLATE: usize = WINDOW + 2;
/// Steps of the search; it converges in three or four where it does.
const MAX_STEPS: usize = 12;
/// A step below this ends the search, pixels.
const STEP_TOLERANCE: f32 = 0.01;

/// When and how matched key points are aligned with the first view of their map point.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PatchConfig {
    /// Align matched key points to a fraction of a pixel.
    pub align: bool,
    /// A key point is moved by at most this, pixels of its pyramid level; further off is a
    /// failure.
    pub max_shift: f64,
    /// Smallest normalised cross-correlation of the patches, -1 to 1; below it the alignment has
    /// failed.
    pub min_correlation: f64,
    /// Standard deviation of an aligned position, pixels of its pyramid level a coordinate.
    pub pixel_sigma: f64,
    /// A reference seen at a scale that differs by more than this factor from the present one is
    /// replaced.
    pub max_scale_change: f64,
}

impl Default for PatchConfig {
    fn default() -> Self {
        Self {
            align: true,
            max_shift: 3.0,
            min_correlation: 0.8,
            pixel_sigma: 0.25,
            max_scale_change: 1.4,
        }
    }
}

/// The grey values around a pixel of a pyramid level.
#[derive(Clone, PartialEq)]
pub struct Patch([[u8; SIDE]; SIDE]);

impl std::fmt::Debug for Patch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Patch({SIDE}x{SIDE})")
    }
}

/// Where a patch was found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PatchAlignment {
    /// From the centre of the current patch to the reference point, pixels of its level.
    pub shift: Vector2<f64>,
    /// Normalised cross-correlation at that place.
    pub correlation: f64,
}

impl Patch {
    /// The surroundings of (`column`, `row`) in an image of `width` columns; `None` where they
    /// reach over its border.
    pub fn cut(pixels: &[u8], width: usize, column: usize, row: usize) -> Option<Self> {
        let left = column.checked_sub(PATCH_RADIUS)?;
        let top = row.checked_sub(PATCH_RADIUS)?;
        if left + SIDE > width {
            return None;
        }
        let mut patch = [[0; SIDE]; SIDE];
        for (line, y) in patch.iter_mut().zip(top..) {
            line.copy_from_slice(pixels.get(y * width + left..y * width + left + SIDE)?);
        }
        Some(Self(patch))
    }

    /// Bilinear value at an offset from the centre; `None` outside.
    fn at(&self, offset: Vector2<f32>) -> Option<f32> {
        let place = offset.add_scalar(PATCH_RADIUS as f32);
        // Also refuses NaN.
        let inside = |x: f32| x >= 0.0 && x < (SIDE - 1) as f32;
        if !(inside(place.x) && inside(place.y)) {
            return None;
        }
        let (x, y) = (place.x as usize, place.y as usize);
        let (fx, fy) = (place.x - x as f32, place.y - y as f32);
        let value = |x: usize, y: usize| f32::from(self.0[y][x]);
        let upper = value(x, y) + fx * (value(x + 1, y) - value(x, y));
        let lower = value(x, y + 1) + fx * (value(x + 1, y + 1) - value(x, y + 1));
        Some(upper + fy * (lower - upper))
    }

    /// Finds in this patch the point that `reference` shows at `offset` from its centre.
    ///
    /// `reference_from_current` maps offsets in this patch to offsets in the reference, both in
    /// pixels of their levels: rotation, scale and shear between the two views. Inverse
    /// compositional Gauss-Newton (Baker and Matthews, 2004) over shift, gain and brightness.
    /// `None` where the window leaves a patch, has no texture in two directions, or the search
    /// does not come to an end within `max_shift`.
    pub fn align(
        &self,
        reference: &Patch,
        offset: Vector2<f64>,
        reference_from_current: &Matrix2<f64>,
        max_shift: f64,
    ) -> Option<PatchAlignment> {
        let template = Template::warped(reference, offset, reference_from_current)?;
        let mut shift = Vector2::zeros();
        for _ in 0..MAX_STEPS {
            let (step, correlation) = template.step(self, shift)?;
            shift -= step;
            if !(f64::from(shift.norm()) <= max_shift) {
                return None;
            }
            if step.norm() < STEP_TOLERANCE {
                let correlation = f64::from(correlation);
                return Some(PatchAlignment { shift: shift.cast(), correlation });
            }
        }
        None
    }
}

/// The reference as the current view should see it, ready to be compared.
struct Template {
    values: [f32; WINDOW * WINDOW],
    /// Derivatives by shift (2), gain and brightness.
    jacobian: [SVector<f32, 4>; WINDOW * WINDOW],
    inverse: SMatrix<f32, 4, 4>,
    mean: f32,
    /// Root of the sum of squared differences from the mean.
    spread: f32,
}

impl Template {
    fn warped(
        reference: &Patch,
        offset: Vector2<f64>,
        reference_from_current: &Matrix2<f64>,
    ) -> Option<Self> {
        let (warp, offset) = (reference_from_current.cast::<f32>(), offset.cast::<f32>());
        let mut wide = [[0.0; TEMPLATE]; TEMPLATE];
        for (y, line) in wide.iter_mut().enumerate() {
            for (x, value) in line.iter_mut().enumerate() {
                let place =
                    Vector2::new(x as f32, y as f32).add_scalar(-(TEMPLATE as f32 / 2.0 - 0.5));
                *value = reference.at(offset + warp * place)?;
            }
        }
        let mut values = [0.0; WINDOW * WINDOW];
        for (i, value) in values.iter_mut().enumerate() {
            *value = wide[1 + i / WINDOW][1 + i % WINDOW];
        }
        let mean = values.iter().sum::<f32>() / values.len() as f32;
        let mut jacobian = [SVector::zeros(); WINDOW * WINDOW];
        let mut normal = SMatrix::<f32, 4, 4>::zeros();
        let mut squares = 0.0;
        for (i, row) in jacobian.iter_mut().enumerate() {
            let (x, y) = (1 + i % WINDOW, 1 + i / WINDOW);
            let along_x = 0.5 * (wide[y][x + 1] - wide[y][x - 1]);
            let along_y = 0.5 * (wide[y + 1][x] - wide[y - 1][x]);
            let centred = values[i] - mean;
            *row = SVector::<f32, 4>::new(along_x, along_y, centred, 1.0);
            normal += *row * row.transpose();
            squares += centred * centred;
        }
        let inverse = normal.cholesky()?.inverse();
        Some(Self { values, jacobian, inverse, mean, spread: squares.sqrt() })
    }

    /// How far `shift` is beyond the best one, to first order, and the correlation at `shift`.
    fn step(&self, current: &Patch, shift: Vector2<f32>) -> Option<(Vector2<f32>, f32)> {
        let mut right = SVector::<f32, 4>::zeros();
        let (mut sum, mut squares, mut product) = (0.0, 0.0, 0.0);
        for (i, (value, row)) in self.values.iter().zip(&self.jacobian).enumerate() {
            let place = Vector2::new((i % WINDOW) as f32, (i / WINDOW) as f32)
                .add_scalar(-(WINDOW_RADIUS as f32));
            let seen = current.at(place + shift)?;
            right += row * (seen - value);
            sum += seen;
            squares += seen * seen;
            product += seen * (value - self.mean);
        }
        let step = self.inverse * right;
        let spread = (squares - sum * sum / self.values.len() as f32).max(0.0).sqrt();
        let correlation = product / (spread * self.spread).max(f32::MIN_POSITIVE);
        // The gradients are those of the reference; where the current view has more or less
        // contrast, so have its own.
        let gain = (1.0 + step[2]).max(0.2);
        step.iter().all(|x| x.is_finite()).then(|| (step.fixed_rows::<2>(0) / gain, correlation))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A smooth texture without repetition, drawn at `centre + warp * offset`.
    fn view(warp: &Matrix2<f64>, centre: Vector2<f64>, gain: f64, brightness: f64) -> Patch {
        let mut patch = [[0; SIDE]; SIDE];
        for (y, line) in patch.iter_mut().enumerate() {
            for (x, value) in line.iter_mut().enumerate() {
                let place = Vector2::new(x as f64, y as f64).add_scalar(-(PATCH_RADIUS as f64));
                let p = centre + warp * place;
                let texture = (0.5 * p.x).sin()
                    + (0.43 * p.y + 1.0).sin()
                    + (0.31 * p.x - 0.37 * p.y + 0.5).cos();
                *value = (brightness + gain * texture).clamp(0.0, 255.0) as u8;
            }
        }
        Patch(patch)
    }

    proptest! {
        /// The reference point is the origin of the texture; the current view sees it turned,
        /// scaled, brighter and off-centre.
        #[test]
        fn planted_shifts_are_found(
            shift in [-2.0..2.0f64, -2.0..2.0], offset in [-1.0..1.0f64, -1.0..1.0],
            turn in -0.5..0.5f64, scale in 0.8..1.25f64,
            gain in 25.0..50.0f64, brightness in 110.0..140.0f64,
        ) {
            let (shift, offset) = (Vector2::from(shift), Vector2::from(offset));
            let reference = view(&Matrix2::identity(), -offset, 40.0, 125.0);
            let warp = Matrix2::new(turn.cos(), -turn.sin(), turn.sin(), turn.cos()) * scale;
            let current = view(&warp, -(warp * shift), gain, brightness);
            let found = current.align(&reference, offset, &warp, 4.0);
            prop_assume!(found.is_some());
            let found = found.unwrap();
            prop_assert!((found.shift - shift).norm() < 0.06, "{} {}", found.shift, shift);
            prop_assert!(found.correlation > 0.98);
        }
    }

    #[test]
    fn nearly_all_planted_shifts_come_to_an_end() {
        let reference = view(&Matrix2::identity(), Vector2::zeros(), 40.0, 125.0);
        let shifts = (0..100).map(|i| Vector2::new(f64::from(i % 10), f64::from(i / 10)) * 0.4);
        let found = shifts.filter(|shift| {
            let shift = shift.add_scalar(-1.8);
            let current = view(&Matrix2::identity(), -shift, 40.0, 125.0);
            current.align(&reference, Vector2::zeros(), &Matrix2::identity(), 4.0).is_some()
        });
        assert!(found.count() >= 95);
    }

    #[test]
    fn plain_patches_and_other_places_are_no_alignment() {
        let plain = Patch([[100; SIDE]; SIDE]);
        let identity = Matrix2::identity();
        let textured = view(&identity, Vector2::zeros(), 40.0, 125.0);
        assert_eq!(textured.align(&plain, Vector2::zeros(), &identity, 3.0), None);
        assert_eq!(textured.align(&textured, Vector2::repeat(f64::NAN), &identity, 3.0), None);
        assert_eq!(textured.align(&textured, Vector2::zeros(), &(identity * 9.0), 3.0), None);
        let far = view(&identity, Vector2::new(6.0, 0.0), 40.0, 125.0);
        let moved = far.align(&textured, Vector2::zeros(), &identity, 3.0);
        assert!(moved.is_none_or(|found| found.correlation < 0.8), "{moved:?}");
    }

    #[test]
    fn patches_do_not_reach_over_the_border() {
        let image = vec![7; 40 * 30];
        assert!(Patch::cut(&image, 40, 10, 10).is_some());
        assert!(Patch::cut(&image, 40, 29, 19).is_some());
        for (column, row) in [(9, 10), (10, 9), (30, 10), (10, 20), (usize::MAX, 10)] {
            assert!(Patch::cut(&image, 40, column, row).is_none(), "{column} {row}");
        }
    }
}
