//! Panels on a drawing area.

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::super::statistics::quantile;
use super::axis::{
    Axis, MAX_POINTS, equal_scales, extent, is_finite, padded, runs, thinned, ticks,
};
use super::{BoxPanel, CurvePanel, FONT, PathPanel, PlotError, drawing};

/// Colours that stay apart for the colour-blind (Okabe and Ito).
const COLORS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(60, 60, 60),
];
const REFERENCE: RGBColor = RGBColor(130, 130, 130);
const GRID: RGBColor = RGBColor(225, 225, 225);

/// The colour map viridis (van der Walt and Smith), linear between nine of its colours; `fraction`
/// from 0 (dark blue) to 1 (yellow).
fn viridis(fraction: f64) -> RGBColor {
    const ANCHORS: [[u8; 3]; 9] = [
        [68, 1, 84],
        [71, 44, 122],
        [59, 81, 139],
        [44, 113, 142],
        [33, 144, 141],
        [39, 173, 129],
        [92, 200, 99],
        [170, 220, 50],
        [253, 231, 37],
    ];
    let position = fraction.clamp(0.0, 1.0) * (ANCHORS.len() - 1) as f64;
    let low = (position.floor() as usize).min(ANCHORS.len() - 2);
    let channel = |k: usize| {
        let (a, b) = (f64::from(ANCHORS[low][k]), f64::from(ANCHORS[low + 1][k]));
        (a + (b - a) * (position - low as f64)).round() as u8
    };
    RGBColor(channel(0), channel(1), channel(2))
}

/// Sizes in pixels of the SVG, whatever is drawn on.
#[derive(Clone, Copy)]
pub(super) struct Canvas {
    pub scale: u32,
}

type Chart<'a, DB> = ChartContext<'a, DB, Cartesian2d<Axis, Axis>>;

/// Room around the axes: top, right, bottom (labels), left (labels).
const MARGINS: [u32; 4] = [34, 20, 44, 64];
/// Room above a panel without title.
const BARE_TOP: u32 = 10;
/// Room left of a panel, so that its labels stay clear of its neighbour.
const SPACE: u32 = 14;
const COLOR_BAR: u32 = 84;

impl Canvas {
    fn px(self, length: u32) -> u32 {
        length * self.scale
    }

    pub fn text(self, size: u32) -> TextStyle<'static> {
        (FONT, self.px(size)).into_font().color(&BLACK)
    }

    fn line(self, color: impl Color, width: u32) -> ShapeStyle {
        color.to_rgba().stroke_width(self.px(width))
    }

    /// Axes with grid and labels; `named`: what stands along x is not numbers.
    fn chart<'a, DB: DrawingBackend + 'a>(
        self,
        area: &DrawingArea<DB, Shift>,
        title: &str,
        labels: [&str; 2],
        [x, y]: [Axis; 2],
        named: bool,
    ) -> Result<Chart<'a, DB>, PlotError> {
        let [top, right, bottom, left] = MARGINS.map(|margin| self.px(margin));
        let top = if title.is_empty() { self.px(BARE_TOP) } else { top };
        let (width, _) = area.dim_in_pixel();
        let style = self.text(14).pos(Pos::new(HPos::Center, VPos::Center));
        let centre = (self.px(SPACE) + left + width.saturating_sub(right)) / 2;
        let position = (centre as i32, self.px(18) as i32);
        area.draw(&Text::new(title.to_owned(), position, style)).map_err(drawing)?;
        let mut chart = ChartBuilder::on(area)
            .margin_top(top)
            .margin_right(right)
            .margin_left(self.px(SPACE))
            .x_label_area_size(bottom)
            .y_label_area_size(left)
            .build_cartesian_2d(x, y)
            .map_err(drawing)?;
        let mut mesh = chart.configure_mesh();
        if named {
            mesh.disable_x_mesh();
        }
        let (x_ticks, y_ticks) = (ticks(x), ticks(y));
        mesh.light_line_style(TRANSPARENT)
            .bold_line_style(self.line(GRID, 1))
            .axis_style(self.line(BLACK, 1))
            .label_style(self.text(12))
            .axis_desc_style(self.text(13))
            .x_labels(8)
            .y_labels(7)
            .x_desc(labels[0])
            .y_desc(labels[1])
            .x_label_formatter(&|value| if named { String::new() } else { x_ticks(value) })
            .y_label_formatter(&y_ticks)
            .draw()
            .map_err(drawing)?;
        Ok(chart)
    }

    fn legend<'a, DB: DrawingBackend + 'a>(
        self,
        chart: &mut Chart<'a, DB>,
    ) -> Result<(), PlotError> {
        chart
            .configure_series_labels()
            .position(SeriesLabelPosition::UpperRight)
            .background_style(WHITE.mix(0.85))
            .border_style(self.line(GRID, 1))
            .legend_area_size(self.px(24))
            .margin(self.px(6))
            .label_font(self.text(12))
            .draw()
            .map_err(drawing)
    }

    pub fn path<DB: DrawingBackend>(
        self,
        panel: &PathPanel,
        area: &DrawingArea<DB, Shift>,
    ) -> Result<(), PlotError> {
        let (width, height) = area.dim_in_pixel();
        let (left, right) = area.split_horizontally(width.saturating_sub(self.px(COLOR_BAR)));
        let [top, margin_right, bottom, margin_left] = MARGINS.map(|margin| self.px(margin));
        let inner = [
            width.saturating_sub(self.px(COLOR_BAR + SPACE) + margin_left + margin_right).max(1),
            height.saturating_sub(top + bottom).max(1),
        ];
        let points = || panel.reference.iter().chain(&panel.estimate);
        let ranges = equal_scales([0, 1].map(|k| extent(points().map(|p| p[k]))), inner);
        let labels = [panel.x_label.as_str(), panel.y_label.as_str()];
        let mut chart = self.chart(&left, &panel.title, labels, ranges.map(Axis::linear), false)?;
        for run in runs(&panel.reference) {
            let points = thinned(run).map(|p| (p[0], p[1]));
            chart.draw_series(LineSeries::new(points, self.line(REFERENCE, 1))).map_err(drawing)?;
        }
        let [low, high] = extent(panel.values.iter().copied());
        let stride = panel.estimate.len().div_ceil(MAX_POINTS).max(1);
        let kept: Vec<usize> = (0..panel.estimate.len()).step_by(stride).collect();
        let segments = kept.windows(2).filter_map(|w| {
            let (a, b) = (panel.estimate.get(w[0])?, panel.estimate.get(w[1])?);
            let value = panel.values.get(w[1])?;
            let unbroken = panel.estimate.get(w[0]..=w[1])?.iter().all(is_finite);
            let color = viridis((value - low) / (high - low));
            let style = self.line(color, 2);
            unbroken.then(|| PathElement::new(vec![(a[0], a[1]), (b[0], b[1])], style))
        });
        chart.draw_series(segments).map_err(drawing)?;
        self.color_bar(&right, [low, high], &panel.value_label)
    }

    fn color_bar<DB: DrawingBackend>(
        self,
        area: &DrawingArea<DB, Shift>,
        [low, high]: [f64; 2],
        label: &str,
    ) -> Result<(), PlotError> {
        const STEPS: i32 = 100;
        let (_, height) = area.dim_in_pixel();
        let (top, bottom) = (self.px(MARGINS[0]) as i32, (height - self.px(MARGINS[2])) as i32);
        let (left, right) = (self.px(4) as i32, self.px(18) as i32);
        let at = |step: i32| bottom + (top - bottom) * step / STEPS;
        for step in 0..STEPS {
            let color = viridis(f64::from(step) / f64::from(STEPS - 1));
            let corners = [(left, at(step + 1)), (right, at(step))];
            area.draw(&Rectangle::new(corners, color.filled())).map_err(drawing)?;
        }
        let format = ticks(Axis::linear([low, high]));
        let style = self.text(12).pos(Pos::new(HPos::Left, VPos::Center));
        for quarter in 0..=4 {
            let value = low + (high - low) * f64::from(quarter) / 4.0;
            let position = (right + self.px(4) as i32, at(quarter * STEPS / 4));
            area.draw(&Text::new(format(&value), position, style.clone())).map_err(drawing)?;
        }
        let style = self.text(12).pos(Pos::new(HPos::Left, VPos::Center));
        area.draw(&Text::new(label.to_owned(), (left, self.px(18) as i32), style)).map_err(drawing)
    }

    pub fn curves<DB: DrawingBackend>(
        self,
        panel: &CurvePanel,
        area: &DrawingArea<DB, Shift>,
    ) -> Result<(), PlotError> {
        let band_points = || panel.bands.iter().flat_map(|band| &band.points);
        let curve_points = || panel.curves.iter().flat_map(|curve| &curve.points);
        let x = band_points().map(|p| p[0]).chain(curve_points().map(|p| p[0]));
        let y = band_points().flat_map(|p| [p[1], p[2]]).chain(curve_points().map(|p| p[1]));
        let [least, largest] = panel.limits.unwrap_or([f64::NEG_INFINITY, f64::INFINITY]);
        let clip = |value: f64| value.clamp(least, largest);
        let x = Axis::of(x, panel.x_scale, |range| range);
        let y = Axis::of(y.map(clip), panel.y_scale, padded);
        let labels = [panel.x_label.as_str(), panel.y_label.as_str()];
        let mut chart = self.chart(area, &panel.title, labels, [x, y], false)?;
        let mut names = 0;
        for (band, color) in panel.bands.iter().zip(COLORS.iter().cycle()) {
            let color = color.mix(0.18);
            let clipped = |p: &[f64; 3]| [x.shown(p[0]), y.shown(clip(p[1])), y.shown(clip(p[2]))];
            let points: Vec<_> = band.points.iter().map(clipped).collect();
            for (k, run) in runs(&points).enumerate() {
                let upper = thinned(run).map(|p| (p[0], p[2]));
                let lower: Vec<_> = thinned(run).map(|p| (p[0], p[1])).collect();
                let outline: Vec<_> = upper.chain(lower.into_iter().rev()).collect();
                let shape = std::iter::once(Polygon::new(outline, color.filled()));
                let series = chart.draw_series(shape).map_err(drawing)?;
                if k == 0 && !band.name.is_empty() {
                    let size = self.px(16) as i32;
                    names += 1;
                    series.label(band.name.as_str()).legend(move |(x, y)| {
                        let half = size / 4;
                        Rectangle::new([(x, y - half), (x + size, y + half)], color.filled())
                    });
                }
            }
        }
        for (curve, color) in panel.curves.iter().zip(COLORS.iter().cycle()) {
            let style = self.line(*color, 1);
            let points: Vec<_> =
                curve.points.iter().map(|p| [x.shown(p[0]), y.shown(clip(p[1]))]).collect();
            for (k, run) in runs(&points).enumerate() {
                let points = thinned(run).map(|p| (p[0], p[1]));
                let series = chart.draw_series(LineSeries::new(points, style)).map_err(drawing)?;
                if k == 0 && !curve.name.is_empty() {
                    let size = self.px(16) as i32;
                    names += 1;
                    series
                        .label(curve.name.as_str())
                        .legend(move |(x, y)| PathElement::new(vec![(x, y), (x + size, y)], style));
                }
            }
        }
        if names > 1 { self.legend(&mut chart) } else { Ok(()) }
    }

    pub fn boxes<DB: DrawingBackend>(
        self,
        panel: &BoxPanel,
        area: &DrawingArea<DB, Shift>,
    ) -> Result<(), PlotError> {
        let quantiles: Vec<[f64; 5]> = panel
            .groups
            .iter()
            .map(|(_, values)| {
                let mut sorted = values.clone();
                sorted.sort_unstable_by(f64::total_cmp);
                [0.05, 0.25, 0.5, 0.75, 0.95].map(|p| quantile(&sorted, p))
            })
            .collect();
        let highest = extent(quantiles.iter().flatten().copied().chain([0.0]));
        let count = panel.groups.len().max(1) as f64;
        let [x, y] = [[0.0, count], padded(highest)].map(Axis::linear);
        let labels = [panel.x_label.as_str(), panel.y_label.as_str()];
        let mut chart = self.chart(area, &panel.title, labels, [x, y], true)?;
        let style = self.text(12).pos(Pos::new(HPos::Center, VPos::Top));
        let names = panel.groups.iter().enumerate().map(|(index, (name, _))| {
            let below = (0, self.px(8) as i32);
            EmptyElement::at((index as f64 + 0.5, y.range[0]))
                + Text::new(name.clone(), below, style.clone())
        });
        chart.draw_series(names).map_err(drawing)?;
        let color = COLORS[0];
        for (index, [low, first, median, third, high]) in quantiles.into_iter().enumerate() {
            if !median.is_finite() {
                continue;
            }
            let x = index as f64 + 0.5;
            let style = self.line(color, 1);
            let line = |from: (f64, f64), to| PathElement::new(vec![from, to], style);
            let whiskers = [
                line((x, low), (x, first)),
                line((x, third), (x, high)),
                line((x - 0.1, low), (x + 0.1, low)),
                line((x - 0.1, high), (x + 0.1, high)),
            ];
            let corners = [(x - 0.25, first), (x + 0.25, third)];
            let fill = Rectangle::new(corners, color.mix(0.25).filled());
            let frame = Rectangle::new(corners, style);
            chart.draw_series(whiskers).map_err(drawing)?;
            chart.draw_series([fill, frame]).map_err(drawing)?;
            let middle = PathElement::new(
                vec![(x - 0.25, median), (x + 0.25, median)],
                self.line(COLORS[1], 2),
            );
            chart.draw_series([middle]).map_err(drawing)?;
        }
        Ok(())
    }
}
