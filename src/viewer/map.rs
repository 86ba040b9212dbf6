//! Map points and, on demand, the ellipsoids of their uncertainty.

use rerun::components::{FillMode, Radius};
use rerun::{Color, Ellipsoids3D, Points3D, RecordingStream, RecordingStreamResult};

use super::covariance::principal_axes;
use super::{MapColor, scene};
use crate::odometry::MapPointView;

pub(super) const POINTS: &str = "world/map";
pub(super) const ELLIPSOIDS: &str = "world/map/ellipsoids";

/// A map of so many points is written at every request, a larger one at proportionally fewer.
const POINTS_PER_REQUEST: usize = 10_000;
/// Standard deviations (m) and ages (frames) at the two ends of the color scale.
const SIGMA_RANGE: [f32; 2] = [0.003, 0.3];
const AGE_RANGE: [f32; 2] = [1.0, 1000.0];

impl MapColor {
    /// What the colors mean, for the title of a view.
    pub(super) fn legend(self) -> &'static str {
        match self {
            Self::Sigma => "map by σ from 3 mm (green) to 0.3 m (magenta)",
            Self::Age => "map by age from 1 frame (green) to 1000 (magenta)",
        }
    }

    fn of(self, point: &MapPointView) -> Color {
        match self {
            Self::Sigma => scale_color(point.sigma(), SIGMA_RANGE),
            Self::Age => scale_color(point.age as f32, AGE_RANGE),
        }
    }
}

pub(super) fn log_styles(stream: &RecordingStream) -> RecordingStreamResult<()> {
    let style = Points3D::update_fields().with_radii([Radius::new_ui_points(1.5)]);
    stream.log_static(POINTS, &style)?;
    let style = Ellipsoids3D::update_fields().with_fill_mode(FillMode::MajorWireframe);
    stream.log_static(ELLIPSOIDS, &style)
}

/// Writes maps, the larger the more rarely.
pub(super) struct MapLog {
    color: MapColor,
    ellipsoids: usize,
    to_skip: usize,
}

impl MapLog {
    /// With the ellipsoids of so many of the newest points.
    pub(super) fn new(color: MapColor, ellipsoids: usize) -> Self {
        Self { color, ellipsoids, to_skip: 0 }
    }

    /// `map` is in order of insertion.
    pub(super) fn log(
        &mut self,
        stream: &RecordingStream,
        map: &[MapPointView],
    ) -> RecordingStreamResult<()> {
        if self.to_skip > 0 {
            self.to_skip -= 1;
            return Ok(());
        }
        self.to_skip = map.len() / POINTS_PER_REQUEST;
        let points = Points3D::update_fields()
            .with_positions(map.iter().map(|point| point.position))
            .with_colors(map.iter().map(|point| self.color.of(point)));
        stream.log(POINTS, &points)?;
        let newest = map.get(map.len().saturating_sub(self.ellipsoids)..).unwrap_or(&[]);
        if self.ellipsoids == 0 {
            return Ok(());
        }
        let axes: Vec<_> = newest
            .iter()
            .filter_map(|point| Some((point, principal_axes(&point.covariance.cast())?)))
            .collect();
        let ellipsoids = Ellipsoids3D::update_fields()
            .with_centers(axes.iter().map(|(point, _)| point.position))
            .with_half_sizes(axes.iter().map(|(_, (sigma, _))| scene::point(&(3.0 * sigma))))
            .with_quaternions(axes.iter().map(|(_, (_, rotation))| scene::quaternion(rotation)))
            .with_colors(axes.iter().map(|(point, _)| self.color.of(point)));
        stream.log(ELLIPSOIDS, &ellipsoids)
    }
}

/// In proportion to the logarithm; no value, or none that has one, falls to one of the ends.
fn scale_color(value: f32, [low, high]: [f32; 2]) -> Color {
    let position = (value / low).ln() / (high / low).ln();
    gradient(position)
}

/// From green at 0 over yellow to magenta at 1 and beyond; NaN is the end.
pub(super) fn gradient(position: f32) -> Color {
    const SCALE: [[f32; 3]; 3] = [[60.0, 220.0, 120.0], [250.0, 210.0, 70.0], [230.0, 60.0, 160.0]];
    let position = if position.is_nan() { 1.0 } else { position.clamp(0.0, 1.0) };
    let [from, to, share] = if position < 0.5 {
        [SCALE[0], SCALE[1], [2.0 * position; 3]]
    } else {
        [SCALE[1], SCALE[2], [2.0 * position - 1.0; 3]]
    };
    let [r, g, b] = std::array::from_fn(|i| (from[i] + share[i] * (to[i] - from[i])).round() as u8);
    Color::from_rgb(r, g, b)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colors_are_defined_for_every_value() {
        let ends = SIGMA_RANGE.map(|sigma| scale_color(sigma, SIGMA_RANGE));
        assert_ne!(ends[0], ends[1]);
        for (sigma, expected) in [
            (0.0, ends[0]),
            (-0.0, ends[0]),
            (1e-9, ends[0]),
            (1e9, ends[1]),
            (f32::INFINITY, ends[1]),
            (f32::NAN, ends[1]),
        ] {
            assert_eq!(scale_color(sigma, SIGMA_RANGE), expected, "{sigma}");
        }
    }
}
