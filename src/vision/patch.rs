//! Sub-pixel alignment of image patches: where exactly in this image lies the point whose
//! surroundings another image showed.
//!
//! A detector places a corner to about half a pixel, anew in every frame. Aligning what is around
//! it with what was around the same point when it entered the map is several times as exact, and
//! it does not drift, because the reference stays the same.

use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};
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
        if left.checked_add(SIDE)? > width {
            return None;
        }
        let mut patch = [[0; SIDE]; SIDE];
        for (line, y) in patch.iter_mut().zip(top..) {
            line.copy_from_slice(pixels.get(y * width + left..y * width + left + SIDE)?);
        }
        Some(Self(patch))
    }

    /// Bilinear value at a place counted from the first pixel; the last one inside where it is
    /// outside.
    fn at(&self, place: Vector2<f32>) -> f32 {
        const LAST: usize = SIDE - 2;
        // The casts saturate.
        let (x, y) = ((place.x as usize).min(LAST), (place.y as usize).min(LAST));
        let (fx, fy) = (place.x - x as f32, place.y - y as f32);
        let value = |x: usize, y: usize| f32::from(self.0[y][x]);
        let upper = value(x, y) + fx * (value(x + 1, y) - value(x, y));
        let lower = value(x, y + 1) + fx * (value(x + 1, y + 1) - value(x, y + 1));
        upper + fy * (lower - upper)
    }

    /// Bilinear values in the window moved by `shift` from the centre; `None` where it leaves the
    /// patch.
    fn window(&self, shift: Vector2<f32>) -> Option<Window> {
        let first = shift.add_scalar((PATCH_RADIUS - WINDOW_RADIUS) as f32);
        // Also refuses NaN.
        let inside = |x: f32| x >= 0.0 && x < (SIDE - WINDOW) as f32;
        if !(inside(first.x) && inside(first.y)) {
            return None;
        }
        let (left, top) = (first.x as usize, first.y as usize);
        let (fx, fy) = (first.x - left as f32, first.y - top as f32);
        let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
        let mut values = [0.0; WINDOW * WINDOW];
        for (y, line) in values.as_chunks_mut::<WINDOW>().0.iter_mut().enumerate() {
            let upper = &self.0[top + y][left..=left + WINDOW];
            let lower = &self.0[top + y + 1][left..=left + WINDOW];
            for (x, value) in line.iter_mut().enumerate() {
                *value = weights[0] * f32::from(upper[x])
                    + weights[1] * f32::from(upper[x + 1])
                    + weights[2] * f32::from(lower[x])
                    + weights[3] * f32::from(lower[x + 1]);
            }
        }
        Some(values)
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
            if f64::from(shift.norm()) > max_shift {
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

/// Grey values, row by row.
type Window = [f32; WINDOW * WINDOW];

/// The reference as the current view should see it, ready to be compared.
struct Template {
    /// Less their mean.
    values: Window,
    along_x: Window,
    along_y: Window,
    /// Of the normal equations by shift (2) and gain; the brightness is eliminated by taking
    /// means off.
    inverse: Matrix3<f32>,
    /// Root of the sum of the squared values.
    spread: f32,
}

impl Template {
    fn warped(
        reference: &Patch,
        offset: Vector2<f64>,
        reference_from_current: &Matrix2<f64>,
    ) -> Option<Self> {
        const HALF: f32 = (TEMPLATE / 2) as f32;
        let warp = reference_from_current.cast::<f32>();
        let centre = offset.cast::<f32>().add_scalar(PATCH_RADIUS as f32);
        // Half the sides of the box around the warped template.
        let reach = warp.abs() * Vector2::repeat(HALF);
        let inside = |x: f32, reach: f32| x - reach >= 0.0 && x + reach <= (SIDE - 1) as f32;
        if !(inside(centre.x, reach.x) && inside(centre.y, reach.y)) {
            return None;
        }
        let mut wide = [[0.0; TEMPLATE]; TEMPLATE];
        for (y, line) in wide.iter_mut().enumerate() {
            for (x, value) in line.iter_mut().enumerate() {
                let place = Vector2::new(x as f32 - HALF, y as f32 - HALF);
                *value = reference.at(centre + warp * place);
            }
        }
        let mut template = Self {
            values: [0.0; WINDOW * WINDOW],
            along_x: [0.0; WINDOW * WINDOW],
            along_y: [0.0; WINDOW * WINDOW],
            inverse: Matrix3::zeros(),
            spread: 0.0,
        };
        for i in 0..WINDOW * WINDOW {
            let (x, y) = (1 + i % WINDOW, 1 + i / WINDOW);
            template.values[i] = wide[y][x];
            template.along_x[i] = 0.5 * (wide[y][x + 1] - wide[y][x - 1]);
            template.along_y[i] = 0.5 * (wide[y + 1][x] - wide[y - 1][x]);
        }
        for row in [&mut template.along_x, &mut template.along_y, &mut template.values] {
            take_mean_off(row);
        }
        let rows = [&template.along_x, &template.along_y, &template.values];
        let normal = Matrix3::from_fn(|i, j| dot(rows[i], rows[j]));
        template.spread = normal.m33.sqrt();
        template.inverse = normal.cholesky()?.inverse();
        Some(template)
    }

    /// How far `shift` is beyond the best one, to first order, and the correlation at `shift`.
    fn step(&self, current: &Patch, shift: Vector2<f32>) -> Option<(Vector2<f32>, f32)> {
        let mut seen = current.window(shift)?;
        take_mean_off(&mut seen);
        let product = dot(&self.values, &seen);
        let right = Vector3::new(dot(&self.along_x, &seen), dot(&self.along_y, &seen), product);
        // `seen = gain (values + gradient * step)`; the gradients are those of the reference, so
        // that the step comes out as many times too long as there is more contrast.
        let fit = self.inverse * right;
        let gain = fit.z;
        let correlation = product / (dot(&seen, &seen).sqrt() * self.spread);
        let step = fit.xy() / gain;
        let sound = gain > 0.0 && step.iter().all(|x| x.is_finite()) && correlation.is_finite();
        sound.then_some((step, correlation))
    }
}

fn take_mean_off(values: &mut Window) {
    let mean = values.iter().sum::<f32>() / values.len() as f32;
    values.iter_mut().for_each(|value| *value -= mean);
}

/// In several lanes, which the compiler may not make of one sum by itself.
fn dot(a: &Window, b: &Window) -> f32 {
    const LANES: usize = 9;
    let mut lanes = [0.0; LANES];
    for (a, b) in a.as_chunks::<LANES>().0.iter().zip(b.as_chunks::<LANES>().0) {
        for (lane, (a, b)) in lanes.iter_mut().zip(a.iter().zip(b)) {
            *lane += a * b;
        }
    }
    lanes.iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Rotation2;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

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

    /// The reference point is the origin of the texture; the current view sees it turned, scaled,
    /// brighter and off-centre. Grey values are whole numbers and texture is weaker in some directions,
    /// so errors have a tail: what is bounded are their quantiles.
    #[test]
    fn planted_shifts_are_found() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut within = |limit: f64| rng.random_range(-limit..limit);
        let mut errors: Vec<f64> = (0..20_000)
            .filter_map(|_| {
                let shift = Vector2::new(within(2.0), within(2.0));
                let offset = Vector2::new(within(1.0), within(1.0));
                let (gain, brightness) = (28.0 + within(8.0), 127.0 + within(12.0));
                let reference = view(&Matrix2::identity(), -offset, 40.0, 125.0);
                let warp = Rotation2::new(within(0.5)).into_inner() * 1.25_f64.powf(within(1.0));
                let current = view(&warp, -(warp * shift), gain, brightness);
                let found = current.align(&reference, offset, &warp, 4.0)?;
                assert!(found.correlation > 0.98, "{}", found.correlation);
                Some((found.shift - shift).norm())
            })
            .collect();
        errors.sort_by(f64::total_cmp);
        let quantile = |share: f64| errors[(share * errors.len() as f64) as usize];
        assert!(errors.len() > 19_500, "{}", errors.len());
        assert!(quantile(0.5) < 0.011, "{}", quantile(0.5));
        assert!(quantile(0.99) < 0.04, "{}", quantile(0.99));
        assert!(errors[errors.len() - 1] < 0.15, "{}", errors[errors.len() - 1]);
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
