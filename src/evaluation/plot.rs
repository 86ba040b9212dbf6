//! Plots as values: panels of curves, coloured paths and boxes, drawn to SVG or PNG.
//!
//! The only part of the module that mentions `plotters`.

use std::path::{Path, PathBuf};
use std::sync::Once;

use plotters::coord::Shift;
use plotters::coord::ranged1d::{DefaultFormatting, KeyPointHint, Ranged};
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use serde::Serialize;

use super::statistics::quantile;

/// A picture of several panels.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct Figure {
    pub title: String,
    pub panels: Vec<Panel>,
    /// Panels side by side.
    pub columns: usize,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub enum Panel {
    Path(PathPanel),
    Curves(CurvePanel),
    Boxes(BoxPanel),
}

/// Two paths in a plane, in equal scales; the second one coloured by a value.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct PathPanel {
    pub title: String,
    pub x_label: String,
    pub y_label: String,
    /// NaN interrupts the line.
    pub reference: Vec<[f64; 2]>,
    pub estimate: Vec<[f64; 2]>,
    /// One for each point of `estimate`.
    pub values: Vec<f64>,
    pub value_label: String,
}

/// How values are laid out along an axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub enum Scale {
    #[default]
    Linear,
    /// Decades of equal length; values that are not positive interrupt a line.
    Logarithmic,
}

/// Curves over a common axis.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct CurvePanel {
    pub title: String,
    pub x_label: String,
    pub y_label: String,
    /// Shaded below the curves.
    pub bands: Vec<Band>,
    pub curves: Vec<Curve>,
    /// Least and largest value shown, where curves or bands go far beyond what is of interest.
    pub limits: Option<[f64; 2]>,
    pub x_scale: Scale,
    pub y_scale: Scale,
}

#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct Curve {
    pub name: String,
    /// NaN interrupts the line.
    pub points: Vec<[f64; 2]>,
}

#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct Band {
    pub name: String,
    /// `[x, low, high]`; NaN interrupts the band.
    pub points: Vec<[f64; 3]>,
}

/// Distributions side by side: median, quartiles, 5 % and 95 % quantiles.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct BoxPanel {
    pub title: String,
    pub x_label: String,
    pub y_label: String,
    pub groups: Vec<(String, Vec<f64>)>,
}

/// Why a figure could not be drawn or saved.
#[derive(Debug, thiserror::Error)]
pub enum PlotError {
    #[error("{path}: a plot is saved as .svg or .png")]
    Extension { path: PathBuf },
    #[error("{path}: {error}")]
    Io { path: PathBuf, error: std::io::Error },
    #[error("drawing failed: {0}")]
    Drawing(String),
}

/// Size of a panel, pixels of the SVG.
const PANEL: (u32, u32) = (640, 400);
/// Height of the line for the figure's title.
const TITLE: u32 = 34;
/// Pixels of a PNG per pixel of the SVG.
const PNG_SCALE: u32 = 2;
/// More points than this a line cannot be told apart.
const MAX_POINTS: usize = 4000;
const FONT: &str = "sans-serif";
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

impl Figure {
    /// One panel of curves over logarithmic axes.
    pub fn logarithmic(title: &str, x_label: &str, y_label: &str, curves: Vec<Curve>) -> Self {
        let panel = CurvePanel {
            x_label: x_label.to_owned(),
            y_label: y_label.to_owned(),
            curves,
            x_scale: Scale::Logarithmic,
            y_scale: Scale::Logarithmic,
            ..Default::default()
        };
        Self { title: title.to_owned(), panels: vec![Panel::Curves(panel)], columns: 1 }
    }

    /// The same figure with `name` before its title.
    pub fn titled(mut self, name: &str) -> Self {
        self.title = format!("{name}: {}", self.title);
        self
    }

    /// Width and height, pixels.
    fn size(&self) -> (u32, u32) {
        let columns = self.columns.clamp(1, self.panels.len().max(1)) as u32;
        let rows = (self.panels.len() as u32).div_ceil(columns);
        (columns * PANEL.0, rows * PANEL.1 + TITLE)
    }

    /// The figure as an SVG document.
    pub fn to_svg(&self) -> Result<String, PlotError> {
        let mut svg = String::new();
        let root = SVGBackend::with_string(&mut svg, self.size()).into_drawing_area();
        self.draw(&root, 1)?;
        drop(root);
        Ok(svg)
    }

    /// Saves as SVG or PNG, by the extension of `path`.
    pub fn save(&self, path: &Path) -> Result<(), PlotError> {
        match path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase).as_deref() {
            Some("svg") => std::fs::write(path, self.to_svg()?)
                .map_err(|error| PlotError::Io { path: path.to_owned(), error }),
            Some("png") => {
                let (width, height) = self.size();
                let size = (width * PNG_SCALE, height * PNG_SCALE);
                let root = BitMapBackend::new(path, size).into_drawing_area();
                self.draw(&root, PNG_SCALE)
            }
            _ => Err(PlotError::Extension { path: path.to_owned() }),
        }
    }

    fn draw<DB: DrawingBackend>(
        &self,
        root: &DrawingArea<DB, Shift>,
        scale: u32,
    ) -> Result<(), PlotError> {
        register_font();
        let canvas = Canvas { scale };
        root.fill(&WHITE).map_err(drawing)?;
        let (title, body) = root.split_vertically(TITLE * scale);
        let style = canvas.text(17).pos(Pos::new(HPos::Center, VPos::Center));
        let (width, height) = title.dim_in_pixel();
        title
            .draw(&Text::new(self.title.as_str(), (width as i32 / 2, height as i32 / 2), style))
            .map_err(drawing)?;
        let columns = self.columns.clamp(1, self.panels.len().max(1));
        let areas = body.split_evenly((self.panels.len().div_ceil(columns), columns));
        for (panel, area) in self.panels.iter().zip(&areas) {
            match panel {
                Panel::Path(panel) => canvas.path(panel, area)?,
                Panel::Curves(panel) => canvas.curves(panel, area)?,
                Panel::Boxes(panel) => canvas.boxes(panel, area)?,
            }
        }
        root.present().map_err(drawing)
    }
}

fn drawing<E: std::error::Error + Send + Sync>(error: DrawingAreaErrorKind<E>) -> PlotError {
    PlotError::Drawing(error.to_string())
}

/// Without a font no size of a text is known, not even for SVG.
fn register_font() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        // Fails for broken font data only; then drawing says that the font is unavailable.
        let _ = plotters::style::register_font(FONT, FontStyle::Normal, dejavu::sans::regular());
    });
}

/// Sizes in pixels of the SVG, whatever is drawn on.
#[derive(Clone, Copy)]
struct Canvas {
    scale: u32,
}

type Chart<'a, DB> = ChartContext<'a, DB, Cartesian2d<Axis, Axis>>;

/// One coordinate of a chart.
#[derive(Clone, Copy)]
struct Axis {
    range: [f64; 2],
    scale: Scale,
}

impl Axis {
    fn linear(range: [f64; 2]) -> Self {
        Self { range, scale: Scale::Linear }
    }

    /// The axis that holds `values`, its range extended by `pad` (of logarithms where they are
    /// laid out).
    fn of(values: impl Iterator<Item = f64>, scale: Scale, pad: fn([f64; 2]) -> [f64; 2]) -> Self {
        let range = match scale {
            Scale::Linear => pad(extent(values)),
            Scale::Logarithmic => pad(extent(values.map(f64::log10))).map(|x| 10f64.powf(x)),
        };
        Self { range, scale }
    }

    /// The value, or NaN where the axis cannot show it.
    fn shown(&self, value: f64) -> f64 {
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

    fn text(self, size: u32) -> TextStyle<'static> {
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

    fn path<DB: DrawingBackend>(
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

    fn curves<DB: DrawingBackend>(
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

    fn boxes<DB: DrawingBackend>(
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

fn is_finite<const N: usize>(point: &[f64; N]) -> bool {
    point.iter().all(|x| x.is_finite())
}

/// The parts between NaN.
fn runs<const N: usize>(points: &[[f64; N]]) -> impl Iterator<Item = &[[f64; N]]> {
    points.split(|point| !is_finite(point)).filter(|run| !run.is_empty())
}

/// At most [`MAX_POINTS`] points, the last one among them.
fn thinned<const N: usize>(run: &[[f64; N]]) -> impl Iterator<Item = &[f64; N]> {
    let stride = run.len().div_ceil(MAX_POINTS).max(1);
    let last = run.last().filter(|_| !(run.len() - 1).is_multiple_of(stride));
    run.iter().step_by(stride).chain(last)
}

/// Smallest and largest finite value, apart from each other.
fn extent(values: impl Iterator<Item = f64>) -> [f64; 2] {
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
fn padded([low, high]: [f64; 2]) -> [f64; 2] {
    let room = 0.05 * (high - low);
    let low = if (0.0..room).contains(&low) { 0.0 } else { low - room };
    [low, high + room]
}

/// Widens one of two ranges so that a metre is as long on both axes of `pixels`.
fn equal_scales(ranges: [[f64; 2]; 2], pixels: [u32; 2]) -> [[f64; 2]; 2] {
    let per_pixel = |k: usize| (ranges[k][1] - ranges[k][0]) / f64::from(pixels[k]);
    let scale = 1.08 * per_pixel(0).max(per_pixel(1));
    [0, 1].map(|k| {
        let middle = 0.5 * (ranges[k][0] + ranges[k][1]);
        let half = 0.5 * scale * f64::from(pixels[k]);
        [middle - half, middle + half]
    })
}

/// Writes numbers with as many decimals as ticks on the axis need; decades as powers of ten.
fn ticks(axis: Axis) -> impl Fn(&f64) -> String {
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
