//! Coordinates of charts: ranges, ticks, and what of a line they can show.

use plotters::coord::ranged1d::{DefaultFormatting, KeyPointHint, Ranged};
use plotters::coord::types::RangedCoordf64;

use super::Scale;

/// More points than this a line cannot be told apart.
pub(super) const MAX_POINTS: usize = 4000;

/// One coordinate of a chart.
#[derive(Clone, Copy)]
pub(super) struct Axis {
    pub range: [f64; 2],
    pub scale: Scale,
}

impl Axis {
    pub fn linear(range: [f64; 2]) -> Self {
        Self { range, scale: Scale::Linear }
    }

    /// The axis that holds `values`, its range extended by `pad` (of logarithms where they are
    /// laid out).
    pub fn of(
        values: impl Iterator<Item = f64>,
        scale: Scale,
        pad: fn([f64; 2]) -> [f64; 2],
    ) -> Self {
        let range = match scale {
            Scale::Linear => pad(extent(values)),
            Scale::Logarithmic => pad(extent(values.map(f64::log10))).map(|x| 10f64.powf(x)),
        };
        Self { range, scale }
    }

    /// The value, or NaN where the axis cannot show it.
    pub fn shown(&self, value: f64) -> f64 {
        if self.scale == Scale::Logarithmic && value <= 0.0 { f64::NAN } else { value }
    }
}

impl Ranged for Axis {
    type FormatOption = DefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, limit: (i32, i32)) -> i32 {
        let [low, high] = self.range;
        match self.scale {
            Scale::Linear => RangedCoordf64::from(low..high).map(value, limit),
            Scale::Logarithmic => {
                RangedCoordf64::from(low.log10()..high.log10()).map(&value.log10(), limit)
            }
        }
    }

    fn key_points<Hint: KeyPointHint>(&self, hint: Hint) -> Vec<f64> {
        let [low, high] = self.range;
        let decades = low.log10().ceil() as i32..=high.log10().floor() as i32;
        match self.scale {
            Scale::Logarithmic if decades.clone().count() > 1 => {
                let stride = decades.clone().count().div_ceil(hint.max_num_points().max(1));
                decades.step_by(stride).map(|decade| 10f64.powi(decade)).collect()
            }
            _ => RangedCoordf64::from(low..high).key_points(hint),
        }
    }

    fn range(&self) -> std::ops::Range<f64> {
        self.range[0]..self.range[1]
    }
}

pub(super) fn is_finite<const N: usize>(point: &[f64; N]) -> bool {
    point.iter().all(|x| x.is_finite())
}

/// The parts between NaN.
pub(super) fn runs<const N: usize>(points: &[[f64; N]]) -> impl Iterator<Item = &[[f64; N]]> {
    points.split(|point| !is_finite(point)).filter(|run| !run.is_empty())
}

/// At most [`MAX_POINTS`] points, the last one among them.
pub(super) fn thinned<const N: usize>(run: &[[f64; N]]) -> impl Iterator<Item = &[f64; N]> {
    let stride = run.len().div_ceil(MAX_POINTS).max(1);
    let last = run.last().filter(|_| !(run.len() - 1).is_multiple_of(stride));
    run.iter().step_by(stride).chain(last)
}

/// Smallest and largest finite value, apart from each other.
pub(super) fn extent(values: impl Iterator<Item = f64>) -> [f64; 2] {
    let [low, high] = values
        .filter(|value| value.is_finite())
        .fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], x| [low.min(x), high.max(x)]);
    let least = 1e-9 * low.abs().max(high.abs()).max(1e-3);
    match high - low {
        spread if spread > least => [low, high],
        spread if spread >= 0.0 => [low - least, high + least],
        _ => [0.0, 1.0],
    }
}

/// With room above and, unless the range starts at zero, below.
pub(super) fn padded([low, high]: [f64; 2]) -> [f64; 2] {
    let room = 0.05 * (high - low);
    let low = if (0.0..room).contains(&low) { 0.0 } else { low - room };
    [low, high + room]
}

/// Widens one of two ranges so that a metre is as long on both axes of `pixels`.
pub(super) fn equal_scales(ranges: [[f64; 2]; 2], pixels: [u32; 2]) -> [[f64; 2]; 2] {
    let per_pixel = |k: usize| (ranges[k][1] - ranges[k][0]) / f64::from(pixels[k]);
    let scale = 1.08 * per_pixel(0).max(per_pixel(1));
    [0, 1].map(|k| {
        let middle = 0.5 * (ranges[k][0] + ranges[k][1]);
        let half = 0.5 * scale * f64::from(pixels[k]);
        [middle - half, middle + half]
    })
}

/// Writes numbers with as many decimals as ticks on the axis need; decades as powers of ten.
pub(super) fn ticks(axis: Axis) -> impl Fn(&f64) -> String {
    let [low, high] = axis.range;
    let spread = (high - low).abs().max(f64::MIN_POSITIVE);
    // A step is at least a seventh of the range.
    let decimals = (0.8 - spread.log10()).ceil().clamp(0.0, 9.0) as usize;
    let tiny = 1e-9 * spread;
    move |value| {
        let exponent = value.log10();
        if axis.scale == Scale::Logarithmic && (exponent - exponent.round()).abs() < 1e-9 {
            return format!("10{}", superscript(exponent.round() as i32));
        }
        let value = if value.abs() < tiny { 0.0 } else { *value };
        format!("{value:.decimals$}")
    }
}

fn superscript(number: i32) -> String {
    const DIGITS: [char; 10] = ['⁰', '¹', '²', '³', '⁴', '⁵', '⁶', '⁷', '⁸', '⁹'];
    let raised = |c: char| c.to_digit(10).map_or('⁻', |digit| DIGITS[digit as usize]);
    number.to_string().chars().map(raised).collect()
}
