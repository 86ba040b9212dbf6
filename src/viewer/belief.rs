//! The belief made visible: the density of the attitude on the unit sphere, and how the
//! components of the pose are correlated.

use nalgebra::{Isometry3, Matrix6, Rotation3, Vector3};
use rerun::components::Radius;
use rerun::{
    Arrows3D, Boxes2D, Image, Points2D, Points3D, RecordingStream, RecordingStreamResult,
    ViewCoordinates,
};

use super::scene::point;
use super::sphere::Sphere;
use crate::distribution::matrix_fisher::MatrixFisher;
use crate::inertial::{Belief, pose_covariance};
use crate::odometry::StepReport;
use crate::so3::ProperSvd;

/// The sphere of the world's directions, colored by where the body axes may point: points, so that
/// one sees through to the far side.
pub(super) const ATTITUDE: &str = "belief/attitude";
const DENSITY: &str = "belief/attitude/density";
const ESTIMATE: &str = "belief/attitude/estimate";
const TRUTH: &str = "belief/attitude/truth";
/// Correlations of (rotation, position) as a picture of 6x6 pixels.
pub(super) const CORRELATION: &str = "belief/correlation";
const CORRELATION_IMAGE: &str = "belief/correlation/image";
const CORRELATION_NAMES: &str = "belief/correlation/names";
const CORRELATION_BLOCK: &str = "belief/correlation/rotation_with_position";

/// Edges of 4 degrees.
const DIVISIONS: u32 = 4;
/// Narrower densities are drawn with this standard deviation, so that they do not fall between
/// the vertices, rad.
const NARROWEST: f64 = 0.052;
/// Radii of the points where no axis may point and where one is most likely to.
const POINT_RADII: [f32; 2] = [0.006, 0.025];
/// Shades of the body's x, y and z axis.
const SHADES: [[f64; 3]; 3] = [[235.0, 80.0, 70.0], [90.0, 215.0, 90.0], [80.0, 140.0, 255.0]];
const SPHERE_COLOR: [f64; 3] = [52.0, 56.0, 66.0];
const TRUTH_COLOR: [u8; 3] = [235, 235, 235];
/// Lengths of the arrows, radii of the sphere.
const ESTIMATE_LENGTH: f64 = 1.25;
const TRUTH_LENGTH: f64 = 1.4;

const NEGATIVE: [f64; 3] = [60.0, 110.0, 240.0];
const NEUTRAL: [f64; 3] = [40.0, 42.0, 50.0];
const POSITIVE: [f64; 3] = [240.0, 90.0, 60.0];
/// Names of the components of (rotation, position): body axes, world axes.
const COMPONENTS: [&str; 6] = ["φx", "φy", "φz", "x", "y", "z"];

/// The sphere that densities are drawn on.
pub(super) fn sphere() -> Sphere {
    Sphere::icosahedral(DIVISIONS)
}

pub(super) fn log_styles(
    stream: &RecordingStream,
    sphere: &Sphere,
    truth: bool,
) -> RecordingStreamResult<()> {
    stream.log_static(ATTITUDE, &ViewCoordinates::RIGHT_HAND_Z_UP())?;
    let points = Points3D::update_fields().with_positions(sphere.vertices.iter().map(point));
    stream.log_static(DENSITY, &points)?;
    let arrows = Arrows3D::update_fields()
        .with_colors(SHADES.map(|shade| shade.map(|channel| channel as u8)))
        .with_radii([Radius::new_scene_units(0.012)])
        .with_labels(["x", "y", "z"]);
    stream.log_static(ESTIMATE, &arrows)?;
    if truth {
        let arrows = Arrows3D::update_fields()
            .with_colors([TRUTH_COLOR])
            .with_radii([Radius::new_scene_units(0.006)]);
        stream.log_static(TRUTH, &arrows)?;
    }
    log_correlation_styles(stream)
}

fn log_correlation_styles(stream: &RecordingStream) -> RecordingStreamResult<()> {
    let places = (0..6).map(|k| k as f32 + 0.5);
    let names =
        Points2D::new(places.clone().map(|y| [-0.5, y - 0.2]).chain(places.map(|x| [x, -0.7])))
            .with_labels(COMPONENTS.into_iter().chain(COMPONENTS))
            .with_show_labels(true)
            .with_radii([Radius::new_ui_points(0.0)]);
    stream.log_static(CORRELATION_NAMES, &names)?;
    let block = Boxes2D::from_mins_and_sizes([[3.0, 0.0]], [[3.0, 3.0]])
        .with_colors([TRUTH_COLOR])
        .with_radii([Radius::new_ui_points(1.0)]);
    stream.log_static(CORRELATION_BLOCK, &block)
}

/// Density, estimated and true axes, and correlations of a frame, at the stream's current time.
pub(super) fn log(
    stream: &RecordingStream,
    sphere: &Sphere,
    report: &StepReport,
    truth: Option<&Isometry3<f64>>,
) -> RecordingStreamResult<()> {
    if let Some(attitude) = attitude(report) {
        let densities = relative_densities(&displayed(&attitude), sphere);
        let points = Points3D::update_fields()
            .with_colors(densities.iter().map(blended))
            .with_radii(densities.iter().map(radius));
        stream.log(DENSITY, &points)?;
    }
    let estimate = report.state.world_from_body.rotation.to_rotation_matrix();
    stream.log(ESTIMATE, &axes(&estimate, ESTIMATE_LENGTH))?;
    if let Some(truth) = truth {
        stream.log(TRUTH, &axes(&truth.rotation.to_rotation_matrix(), TRUTH_LENGTH))?;
    }
    let correlations = correlations(&pose_covariance(&report.covariance));
    let pixels: Vec<u8> =
        correlations.transpose().iter().flat_map(|c| correlation_color(*c)).collect();
    stream.log(CORRELATION_IMAGE, &Image::from_rgb24(pixels, [6, 6]))
}

/// The filter's own matrix Fisher distribution; for Gaussian filters the one that matches.
fn attitude(report: &StepReport) -> Option<MatrixFisher> {
    match report.matrix_fisher {
        Some(svd) => MatrixFisher::from_svd(svd).ok(),
        None => Belief { state: report.state, covariance: report.covariance }.attitude(),
    }
}

fn axes(world_from_body: &Rotation3<f64>, length: f64) -> Arrows3D {
    let vectors = world_from_body.matrix().column_iter().map(|axis| point(&(axis * length)));
    Arrows3D::update_fields().with_vectors(vectors)
}

/// The distribution as wide as it can be drawn: concentrations above that of [`NARROWEST`] are
/// reduced to it.
fn displayed(attitude: &MatrixFisher) -> MatrixFisher {
    let svd = attitude.svd();
    let largest = NARROWEST.powi(-2);
    let s = svd.s;
    let [a, b, c] = [s[1] + s[2], s[0] + s[2], s[0] + s[1]].map(|sum| sum.min(largest));
    let s = 0.5 * Vector3::new(b + c - a, a + c - b, a + b - c);
    MatrixFisher::from_svd(ProperSvd { s, ..*svd }).unwrap_or(*attitude)
}

/// Marginal densities of the body axes at the sphere's vertices, each relative to its largest.
fn relative_densities(attitude: &MatrixFisher, sphere: &Sphere) -> Vec<[f64; 3]> {
    let mode = attitude.mode();
    let mut shares = vec![[0.0; 3]; sphere.vertices.len()];
    for axis in 0..3 {
        let centre = mode.matrix().column(axis).into_owned();
        let log_density = |r: &Vector3<f64>| attitude.log_axis_density(axis, r);
        // At most exp(-a (1 - cos)) of what it is at the mode, with the smallest concentration a:
        // nothing to be seen beyond this.
        let s = attitude.svd().s;
        let least_cosine = 1.0 - INVISIBLE / (s[1] + s[2]).max(1e-3);
        let logs: Vec<Option<f64>> = sphere
            .vertices
            .iter()
            .map(|r| (r.dot(&centre) >= least_cosine).then(|| log_density(r)))
            .collect();
        let largest = logs.iter().flatten().copied().fold(log_density(&centre), f64::max);
        for (share, log) in shares.iter_mut().zip(logs) {
            share[axis] = log.map_or(0.0, |log| (log - largest).exp());
        }
    }
    shares
}

/// Exponent at which a density has vanished to the eye.
const INVISIBLE: f64 = 12.0;

/// Each axis adds its shade in proportion to its share.
fn blended(shares: &[f64; 3]) -> [u8; 3] {
    let rest = shares.iter().fold(1.0, |rest, share| rest * (1.0 - share));
    std::array::from_fn(|channel| {
        let shades: f64 =
            shares.iter().zip(SHADES).map(|(share, shade)| share * shade[channel]).sum();
        (rest * SPHERE_COLOR[channel] + shades).round().clamp(0.0, 255.0) as u8
    })
}

fn radius(shares: &[f64; 3]) -> Radius {
    let [least, largest] = POINT_RADII;
    let share = shares.iter().copied().fold(0.0, f64::max) as f32;
    Radius::new_scene_units(least + share * (largest - least))
}

/// Correlation coefficients; zero where a variance is not positive.
fn correlations(covariance: &Matrix6<f64>) -> Matrix6<f64> {
    let sigma = covariance.diagonal().map(|variance| variance.max(0.0).sqrt());
    Matrix6::from_fn(|i, j| {
        let product = sigma[i] * sigma[j];
        if product > 0.0 { (covariance[(i, j)] / product).clamp(-1.0, 1.0) } else { 0.0 }
    })
}

fn correlation_color(correlation: f64) -> [u8; 3] {
    let end = if correlation < 0.0 { NEGATIVE } else { POSITIVE };
    let share = correlation.abs().min(1.0);
    std::array::from_fn(|channel| {
        (NEUTRAL[channel] + share * (end[channel] - NEUTRAL[channel])).round() as u8
    })
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::{Matrix3, SMatrix};

    use super::*;

    fn attitude(s: [f64; 3], mode: Rotation3<f64>) -> MatrixFisher {
        let v = Rotation3::identity();
        MatrixFisher::from_svd(ProperSvd { u: mode, s: s.into(), v }).unwrap()
    }

    /// The vertex nearest to `direction`.
    fn nearest(sphere: &Sphere, direction: &Vector3<f64>) -> usize {
        let cosine = |index: &usize| sphere.vertices[*index].dot(direction);
        (0..sphere.vertices.len()).max_by(|a, b| cosine(a).total_cmp(&cosine(b))).unwrap()
    }

    #[test]
    fn a_concentrated_attitude_is_three_spots_in_their_shades() {
        let sphere = Sphere::icosahedral(DIVISIONS);
        let mode = Rotation3::from_euler_angles(0.3, -0.5, 1.1);
        let attitude = displayed(&attitude([1e7, 8e6, 5e6], mode));
        let colors: Vec<_> = relative_densities(&attitude, &sphere).iter().map(blended).collect();
        for axis in 0..3 {
            let vertex = nearest(&sphere, &mode.matrix().column(axis).into_owned());
            let strongest = (0..3).max_by_key(|channel| colors[vertex][*channel]).unwrap();
            assert_eq!(strongest, axis);
        }
        let plain = colors.iter().filter(|color| **color == SPHERE_COLOR.map(|c| c as u8)).count();
        assert!(plain > sphere.vertices.len() * 9 / 10, "{plain}");
    }

    #[test]
    fn an_unknown_heading_is_a_ring_and_an_unknown_attitude_is_everywhere() {
        let sphere = Sphere::icosahedral(DIVISIONS);
        // Concentrated about x and y, free about z.
        let ring = attitude([500.0, 0.0, 0.0], Rotation3::identity());
        // s = (500, 0, 0) fixes the body's x axis: turn it up.
        let up = Rotation3::from_axis_angle(&Vector3::y_axis(), -std::f64::consts::FRAC_PI_2);
        let ring = MatrixFisher::new(&(up.matrix() * ring.parameter())).unwrap();
        let colors: Vec<_> =
            relative_densities(&displayed(&ring), &sphere).iter().map(blended).collect();
        let around =
            |angle: f64| colors[nearest(&sphere, &Vector3::new(angle.cos(), angle.sin(), 0.0))];
        let green = [0.0, 0.8, 1.6, 2.4, 3.2].map(|angle| around(angle)[1]);
        assert!(green.iter().all(|green| *green > 150), "{green:?}");
        assert_eq!(colors[nearest(&sphere, &Vector3::z())][0], 235);

        let everywhere = relative_densities(&displayed(&MatrixFisher::uniform()), &sphere);
        assert!(everywhere.iter().flatten().all(|share| (share - 1.0).abs() < 1e-12));
        assert_eq!(blended(&everywhere[0]), [255; 3]);
    }

    #[test]
    fn wide_distributions_are_drawn_as_they_are() {
        let wide = attitude([40.0, 20.0, -5.0], Rotation3::identity());
        assert_relative_eq!(displayed(&wide).svd().s, wide.svd().s, epsilon = 1e-12);
        let drawn = displayed(&attitude([1e9, 1e3, -9e2], Rotation3::identity()));
        let information = drawn.information();
        assert_relative_eq!(information[(0, 0)], 100.0, epsilon = 1e-6);
        assert_relative_eq!(information[(2, 2)], NARROWEST.powi(-2), epsilon = 1e-6);
    }

    #[test]
    fn correlations_are_those_of_the_covariance() {
        let root =
            SMatrix::<f64, 6, 6>::from_fn(|i, j| if i >= j { 1.0 + (i * j) as f64 } else { 0.0 });
        let covariance = root * root.transpose();
        let found = correlations(&covariance);
        assert_relative_eq!(found.diagonal(), SMatrix::from_element(1.0), epsilon = 1e-12);
        let scale = covariance[(1, 1)].sqrt() * covariance[(4, 4)].sqrt();
        assert_relative_eq!(found[(1, 4)] * scale, covariance[(1, 4)], epsilon = 1e-9);
        assert_eq!(correlations(&Matrix6::zeros()), Matrix6::zeros());
        let ends = [-1.0, 1.0].map(correlation_color);
        assert_eq!(ends, [NEGATIVE, POSITIVE].map(|end| end.map(|c| c as u8)));
        assert_eq!(Matrix3::<f64>::zeros().map(correlation_color)[(0, 0)], [40, 42, 50]);
    }
}
