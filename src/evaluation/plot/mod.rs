//! Plots as values: panels of curves, coloured paths and boxes, drawn to SVG or PNG.
//!
//! The only part of the module that mentions `plotters`.

mod axis;
mod canvas;

use std::path::{Path, PathBuf};
use std::sync::Once;

use image::ImageEncoder;
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use serde::Serialize;

use crate::output;
use canvas::Canvas;

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
const FONT: &str = "sans-serif";

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
            Some("svg") => output::write(path, self.to_svg()?),
            Some("png") => output::write(path, self.to_png()?),
            _ => return Err(PlotError::Extension { path: path.to_owned() }),
        }
        .map_err(|error| PlotError::Io { path: path.to_owned(), error })
    }

    fn to_png(&self) -> Result<Vec<u8>, PlotError> {
        let (width, height) = self.size();
        let (width, height) = (width * PNG_SCALE, height * PNG_SCALE);
        let mut pixels = vec![0; 3 * width as usize * height as usize];
        let root = BitMapBackend::with_buffer(&mut pixels, (width, height)).into_drawing_area();
        self.draw(&root, PNG_SCALE)?;
        drop(root);
        let mut png = Vec::new();
        image::codecs::png::PngEncoder::new(&mut png)
            .write_image(&pixels, width, height, image::ExtendedColorType::Rgb8)
            .map_err(|error| PlotError::Drawing(error.to_string()))?;
        Ok(png)
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
