//! Sub-pixel alignment of what an image shows with the first view of a point.
//!
//! The reference seen through the predicted warp, `T(x) = I_0(x_0 + W x)`, is what the present image
//! should show around the point: `I(y + x) = g T(x) + c`. The place `y` is found by inverse
//! compositional Gauss-Newton (Baker and Matthews, 2004), gain `g` and brightness `c` with it. Then one
//! step more over place and warp, the warp with a prior, follows what turning does not explain: scale
//! and tilt. Costs `O(N)` in the pixels of the window, a step.

use nalgebra::{Matrix2, Matrix3, SMatrix, SVector, Vector2, Vector3};

use super::levels::Grey;

/// Half the side of the window that is compared.
const RADIUS: usize = 5;
const WINDOW: usize = 2 * RADIUS + 1;
const AREA: usize = WINDOW * WINDOW;
/// The window and the ring that its gradients need.
const RING: usize = WINDOW + 2;
/// The next multiple of the lanes that sums are made in.
const PADDED: usize = AREA.next_multiple_of(LANES);
const LANES: usize = 8;
/// Half the side of a stored view: a window turned by 45 degrees and reduced by 1.2 fits in.
pub(super) const VIEW_RADIUS: usize = 10;
const VIEW: usize = 2 * VIEW_RADIUS + 1;
/// Unknowns of the last step: place, warp and gain; the brightness is eliminated by taking means off.
const UNKNOWNS: usize = 7;

/// Grey values of the window, row by row, and zeros behind them.
type Window = [f32; PADDED];

/// The surroundings of a point on one level of its first view.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct View {
    pixels: [u8; VIEW * VIEW],
    /// From the first pixel to the point.
    centre: Vector2<f32>,
}

impl View {
    /// What `image` shows around `place`, its outermost pixels standing for what lies beyond; `None`
    /// for a place outside.
    pub fn cut(image: Grey, place: Vector2<f32>) -> Option<Self> {
        let nearest = place.map(f32::round);
        if !image.holds(nearest, Vector2::zeros()) {
            return None;
        }
        let first = |centre: f32| centre as isize - VIEW_RADIUS as isize;
        let (left, top) = (first(nearest.x), first(nearest.y));
        let mut pixels = [0; VIEW * VIEW];
        for (line, row) in pixels.as_chunks_mut::<VIEW>().0.iter_mut().zip(top..) {
            for (pixel, column) in line.iter_mut().zip(left..) {
                *pixel = image.nearest(column, row);
            }
        }
        Some(Self { pixels, centre: (place - nearest).add_scalar(VIEW_RADIUS as f32) })
    }

    fn grey(&self) -> Grey<'_> {
        Grey { pixels: &self.pixels, width: VIEW, height: VIEW }
    }
}

/// Where an image shows what a template does.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Found {
    pub place: Vector2<f32>,
    /// Normalised cross-correlation there.
    pub correlation: f32,
}

/// The same, with all that the last step tells.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Refined {
    pub found: Found,
    /// What the warp is to be multiplied by from the right.
    pub warp_change: Matrix2<f32>,
    /// Of the place, px^2.
    pub covariance: Matrix2<f32>,
    /// Of the grey values of both images together.
    pub noise_variance: f32,
}

/// How far and how finely to search.
#[derive(Debug, Clone, Copy)]
pub(super) struct Search {
    pub steps: usize,
    /// Farther from the start is a failure, px.
    pub max_shift: f32,
    /// A step below this ends the search, px.
    pub tolerance: f32,
    /// Whether the window may reach over the border, the outermost pixels standing for what lies
    /// beyond.
    pub pads: bool,
}

/// The reference as the present image should show it.
pub(super) struct Template {
    /// Less their mean.
    values: Window,
    along_x: Window,
    along_y: Window,
    /// Of the normal equations by place (2) and gain.
    inverse: Matrix3<f32>,
    /// Root of the sum of the squared values.
    spread: f32,
}

impl Template {
    /// A stored view, `warp` mapping offsets in the present image to offsets in it.
    pub fn of_view(view: &View, warp: &Matrix2<f32>) -> Option<Self> {
        Self::warped(view.grey(), view.centre, warp)
    }

    /// `None` where the window leaves the image or has no texture in two directions.
    pub fn warped(image: Grey, centre: Vector2<f32>, warp: &Matrix2<f32>) -> Option<Self> {
        const HALF: f32 = (RING / 2) as f32;
        if !image.holds(centre, warp.abs() * Vector2::repeat(HALF)) {
            return None;
        }
        let mut wide = [[0.0; RING]; RING];
        let along = warp.column(0).map(fixed);
        for (y, line) in wide.iter_mut().enumerate() {
            let mut place = (centre + warp * Vector2::new(-HALF, y as f32 - HALF)).map(fixed);
            for value in line {
                *value = bilinear(image, place);
                place += along;
            }
        }
        let mut template = Self {
            values: [0.0; PADDED],
            along_x: [0.0; PADDED],
            along_y: [0.0; PADDED],
            inverse: Matrix3::zeros(),
            spread: 0.0,
        };
        for y in 0..WINDOW {
            for x in 0..WINDOW {
                let i = y * WINDOW + x;
                template.values[i] = wide[y + 1][x + 1];
                template.along_x[i] = 0.5 * (wide[y + 1][x + 2] - wide[y + 1][x]);
                template.along_y[i] = 0.5 * (wide[y + 2][x + 1] - wide[y][x + 1]);
            }
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

    /// Standard deviation of the place in its least certain direction, px, if grey values have
    /// `noise` in both images (Shi and Tomasi, 1994: the smaller eigenvalue of the structure tensor).
    pub fn place_sigma(&self, noise: f32) -> f32 {
        let xx = dot(&self.along_x, &self.along_x);
        let yy = dot(&self.along_y, &self.along_y);
        let xy = dot(&self.along_x, &self.along_y);
        let smaller = 0.5 * (xx + yy - (xx - yy).hypot(2.0 * xy));
        noise * (2.0 / smaller.max(f32::MIN_POSITIVE)).sqrt()
    }

    /// Normalised cross-correlation with the window around `place`; `None` over the border.
    pub fn correlation(&self, image: Grey, place: Vector2<f32>) -> Option<f32> {
        let mut seen = window(image, place)?;
        take_mean_off(&mut seen);
        let correlation = dot(&self.values, &seen) / (dot(&seen, &seen).sqrt() * self.spread);
        correlation.is_finite().then_some(correlation)
    }

    /// The place nearest to `start` that shows the same. `None` where the window leaves the image or
    /// the search does not come to an end.
    pub fn find(&self, image: Grey, start: Vector2<f32>, search: Search) -> Option<Found> {
        let mut place = start;
        let mut last = (f32::INFINITY, -1.0);
        for _ in 0..search.steps {
            let (step, correlation) = self.step(image, place, search.pads)?;
            place -= step;
            if (place - start).norm() > search.max_shift {
                return None;
            }
            last = (step.norm(), correlation);
            if last.0 < search.tolerance {
                break;
            }
        }
        // Where texture is weak, noise keeps the steps from becoming smaller still.
        let (step, correlation) = last;
        (step < 4.0 * search.tolerance).then_some(Found { place, correlation })
    }

    /// How far `place` is beyond the best one, to first order, and the correlation at `place`.
    fn step(&self, image: Grey, place: Vector2<f32>, pads: bool) -> Option<(Vector2<f32>, f32)> {
        let mut seen = if pads { padded_window(image, place) } else { window(image, place) }?;
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

    /// One step from where [`Self::find`] came to, over place `d` and warp `B` together:
    ///
    /// `I(y + x) = g T(x - d - B x) + c = g T(x) - g T'(x) (d + B x) + c`,
    ///
    /// with the prior that the elements of `B` have standard deviation `warp_sigma`, grey values
    /// having `noise_variance`.
    pub fn refine(
        &self,
        image: Grey,
        place: Vector2<f32>,
        warp_sigma: f32,
        noise_variance: f32,
    ) -> Option<Refined> {
        let mut seen = window(image, place)?;
        take_mean_off(&mut seen);
        let rows = self.rows();
        // Lengths in half windows, so that all unknowns are of one size.
        let mut normal = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::zeros();
        let mut right = SVector::<f64, UNKNOWNS>::zeros();
        for i in 0..UNKNOWNS {
            right[i] = f64::from(dot(&rows[i], &seen));
            for j in i..UNKNOWNS {
                normal[(i, j)] = f64::from(dot(&rows[i], &rows[j]));
                normal[(j, i)] = normal[(i, j)];
            }
        }
        let prior = f64::from(noise_variance / (warp_sigma * RADIUS as f32).powi(2));
        for i in 2..6 {
            normal[(i, i)] += prior;
        }
        let inverse = normal.cholesky()?.inverse();
        let fit = inverse * right;
        let gain = fit[6];
        let mut left = seen;
        for (row, factor) in rows.iter().zip(fit.iter()) {
            for (left, value) in left.iter_mut().zip(row) {
                *left -= *factor as f32 * value;
            }
        }
        let noise = f64::from(dot(&left, &left)) / (AREA - 1 - UNKNOWNS) as f64;
        let moved = fit.fixed_rows::<2>(0) / -gain;
        let b = |k: usize| -fit[k] / (gain * RADIUS as f64);
        let change = Matrix2::identity() - Matrix2::new(b(2), b(3), b(4), b(5));
        let covariance = inverse.fixed_view::<2, 2>(0, 0) * (noise / (gain * gain));
        let correlation = dot(&self.values, &seen) / (dot(&seen, &seen).sqrt() * self.spread);
        let sound = gain > 0.0 && fit.iter().all(|x| x.is_finite()) && correlation.is_finite();
        sound.then(|| Refined {
            found: Found { place: place + moved.cast::<f32>(), correlation },
            warp_change: change.cast(),
            covariance: covariance.cast(),
            noise_variance: noise as f32,
        })
    }

    /// Derivatives by place, warp (row by row, in half windows) and gain.
    fn rows(&self) -> [Window; UNKNOWNS] {
        let across = |k: usize| (k as f32 - RADIUS as f32) / RADIUS as f32;
        let scaled = |values: &Window, by: fn(usize) -> usize| {
            let mut scaled = *values;
            scaled.iter_mut().enumerate().for_each(|(i, value)| *value *= across(by(i)));
            take_mean_off(&mut scaled);
            scaled
        };
        [
            self.along_x,
            self.along_y,
            scaled(&self.along_x, |i| i % WINDOW),
            scaled(&self.along_x, |i| i / WINDOW),
            scaled(&self.along_y, |i| i % WINDOW),
            scaled(&self.along_y, |i| i / WINDOW),
            self.values,
        ]
    }
}

/// In steps of 2^-16, whose whole and broken parts cost no rounding.
fn fixed(length: f32) -> i32 {
    (length * 65536.0) as i32
}

/// Bilinear value at a place (2^-16 px) that lies inside, with a pixel to spare.
fn bilinear(image: Grey, place: Vector2<i32>) -> f32 {
    let (x, y) = ((place.x >> 16) as usize, (place.y >> 16) as usize);
    let part = |length: i32| (length & 0xFFFF) as f32 / 65536.0;
    let start = y * image.width + x;
    let Some(&[a, b]) = image.pixels.get(start..start + 2) else { return 0.0 };
    let below = start + image.width;
    let Some(&[c, d]) = image.pixels.get(below..below + 2) else { return 0.0 };
    let [a, b, c, d] = [a, b, c, d].map(f32::from);
    let fx = part(place.x);
    let (upper, lower) = (a + fx * (b - a), c + fx * (d - c));
    upper + part(place.y) * (lower - upper)
}

/// Bilinear values around `centre`; `None` over the border.
fn window(image: Grey, centre: Vector2<f32>) -> Option<Window> {
    if !image.holds(centre, Vector2::repeat(RADIUS as f32)) {
        return None;
    }
    let first = centre.add_scalar(-(RADIUS as f32));
    let (left, top) = (first.x as usize, first.y as usize);
    let (fx, fy) = (first.x - left as f32, first.y - top as f32);
    let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
    let line = |row: usize| {
        let start = row * image.width + left;
        image.pixels.get(start..=start + WINDOW)?.as_array::<{ WINDOW + 1 }>()
    };
    let mut values = [0.0; PADDED];
    let mut upper = line(top)?;
    for (to, row) in values.as_chunks_mut::<WINDOW>().0.iter_mut().zip(top..) {
        let lower = line(row + 1)?;
        for x in 0..WINDOW {
            to[x] = weights[0] * f32::from(upper[x])
                + weights[1] * f32::from(upper[x + 1])
                + weights[2] * f32::from(lower[x])
                + weights[3] * f32::from(lower[x + 1]);
        }
        upper = lower;
    }
    Some(values)
}

/// The same, the outermost pixels standing for what lies beyond; `None` for a place outside.
fn padded_window(image: Grey, centre: Vector2<f32>) -> Option<Window> {
    if let Some(inside) = window(image, centre) {
        return Some(inside);
    }
    if !image.holds(centre, Vector2::zeros()) {
        return None;
    }
    let (left, top) = (centre.x as isize, centre.y as isize);
    let (fx, fy) = (centre.x - left as f32, centre.y - top as f32);
    let mut values = [0.0; PADDED];
    for (i, value) in values[..AREA].iter_mut().enumerate() {
        let x = left + (i % WINDOW) as isize - RADIUS as isize;
        let y = top + (i / WINDOW) as isize - RADIUS as isize;
        let at = |x: isize, y: isize| f32::from(image.nearest(x, y));
        let upper = at(x, y) + fx * (at(x + 1, y) - at(x, y));
        let lower = at(x, y + 1) + fx * (at(x + 1, y + 1) - at(x, y + 1));
        *value = upper + fy * (lower - upper);
    }
    Some(values)
}

fn take_mean_off(values: &mut Window) {
    let mean = sum(values) / AREA as f32;
    values[..AREA].iter_mut().for_each(|value| *value -= mean);
}

fn sum(values: &Window) -> f32 {
    let mut lanes = [0.0; LANES];
    for chunk in values.as_chunks::<LANES>().0 {
        for (lane, value) in lanes.iter_mut().zip(chunk) {
            *lane += value;
        }
    }
    lanes.iter().sum()
}

/// In several lanes, which the compiler may not make of one sum by itself.
fn dot(a: &Window, b: &Window) -> f32 {
    let mut lanes = [0.0; LANES];
    for (a, b) in a.as_chunks::<LANES>().0.iter().zip(b.as_chunks::<LANES>().0) {
        for (lane, (a, b)) in lanes.iter_mut().zip(a.iter().zip(b)) {
            *lane += a * b;
        }
    }
    lanes.iter().sum()
}
