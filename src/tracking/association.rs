//! What a frame measures of map points: matched features and points sought in the image, placed to
//! a fraction of a pixel by aligning them with the first view of their point.

use std::sync::Arc;

use nalgebra::{Isometry3, Matrix2, Matrix3, Point2, Point3, Vector2, Vector3};

use super::shutter::Shutter;
use super::view::{FrontEndFrame, View};
use crate::map::{MapPoint, ReferenceView};
use crate::sensor::Camera;
use crate::vision::ransac::{Consensus, Reprojection};
use crate::vision::{Correspondence, DepthReading, Feature, PointMeasurement};

/// A feature and the map point that it looks like.
#[derive(Debug, Clone, Copy)]
pub struct Association {
    /// Index into the features of the frame.
    pub feature: usize,
    /// Id in the map.
    pub point: u64,
    pub predicted: Point2<f64>,
    pub correspondence: Correspondence,
    /// Whether the present view should serve as the reference of later ones.
    pub renews_reference: bool,
}

impl Association {
    pub fn new(feature: usize, point: &MapPoint, predicted: Point2<f64>, placed: Placed) -> Self {
        Self {
            feature,
            point: point.id,
            predicted,
            correspondence: Correspondence {
                measurement: placed.measurement,
                world: point.position,
                world_covariance: point.covariance,
            },
            renews_reference: placed.renews_reference,
        }
    }

    /// Takes the camera's motion, which was thought to be that of `before`, for that of `view`.
    pub fn reread(&mut self, features: &[Feature], before: &Shutter, view: &View) {
        let Some(feature) = features.get(self.feature) else { return };
        let point = &mut self.correspondence.measurement.point;
        let row = view.row(feature.pixel);
        *point = view.shutter.at_stamp(&before.at_row(point, row), row);
    }
}

/// A matched feature as a measurement of its map point.
pub struct Placed {
    pub measurement: PointMeasurement,
    pub renews_reference: bool,
}

/// Measures `point` where `feature` shows it, aligned with the reference view where that succeeds.
///
/// Without depth the feature measures a direction: a point at the predicted depth, as uncertain
/// along the ray as it is far. `None` where such features are not wanted.
pub fn place(
    feature: &Feature,
    point: &MapPoint,
    world_from_camera: &Isometry3<f64>,
    view: &View,
) -> Option<Placed> {
    let in_camera = world_from_camera.inverse_transform_point(&Point3::from(point.position));
    let predicted = view.camera.depth_of(&in_camera.coords);
    let direction_only =
        DepthReading { depth: predicted, slope: Vector2::zeros(), standard_deviation: predicted };
    let depth = match feature.depth {
        Some(depth) => depth,
        None if view.config.search.without_depth && predicted > 0.0 => direction_only,
        None => return None,
    };
    align(feature, &depth, point, world_from_camera, view).or_else(|| {
        let (shift, sigma) = (Vector2::zeros(), feature.pixel_sigma);
        let measurement = feature.measurement_with(&depth, view.camera, shift, sigma)?;
        let measurement = view.at_stamp(feature.pixel, measurement);
        Some(Placed { measurement, renews_reference: true })
    })
}

/// Measures `point` on the surface that `depth` describes where the surroundings of `feature` look
/// like those of the point in its reference view; `None` where they do not.
fn align(
    feature: &Feature,
    depth: &DepthReading,
    point: &MapPoint,
    world_from_camera: &Isometry3<f64>,
    view: &View,
) -> Option<Placed> {
    let config = &view.config.patch;
    let reference = point.reference.as_ref().filter(|_| config.align)?;
    let patch = feature.patch.as_ref()?;
    let warp = warp(reference, feature, depth, world_from_camera, view.camera)?;
    let found = patch.align(&reference.patch, reference.offset, &warp, config.max_shift)?;
    if found.correlation < config.min_correlation {
        return None;
    }
    let sigma = config.pixel_sigma * feature.scale;
    let shift = found.shift * feature.scale;
    let change = warp.determinant().abs().sqrt();
    let measurement = feature.measurement_with(depth, view.camera, shift, sigma)?;
    Some(Placed {
        measurement: view.at_stamp(feature.pixel, measurement),
        renews_reference: change.max(change.recip()) > config.max_scale_change,
    })
}

/// Looks for `point` where `world_from_camera` has it, whether or not there is a corner: what is
/// there as a feature, and its association with the point. `None` where something else is seen,
/// by its looks or its distance.
pub fn seek(
    point: &MapPoint,
    world_from_camera: &Isometry3<f64>,
    front: &FrontEndFrame,
    view: &View,
) -> Option<(Feature, Association)> {
    let reference = point.reference.as_ref()?;
    let position = Point3::from(point.position);
    let in_camera = world_from_camera.inverse_transform_point(&position).coords;
    let predicted = view.project(&in_camera)?;
    let then = reference.world_from_camera.inverse_transform_point(&position).coords;
    let nearer = view.camera.depth_of(&then) / view.camera.depth_of(&in_camera);
    let glimpse = front.extraction.pyramid.look(predicted, reference.scale * nearer)?;
    let depth = view.config.depth.read(&front.frame.depth, glimpse.pixel)?;
    let feature = Feature {
        pixel: glimpse.pixel,
        bearing: view.camera.bearing(glimpse.pixel)?,
        descriptor: point.descriptor,
        response: 0.0,
        octave: glimpse.octave,
        scale: glimpse.scale,
        pixel_sigma: view.config.patch.pixel_sigma * glimpse.scale,
        patch: Some(Arc::new(glimpse.patch)),
        depth: Some(depth),
    };
    let placed = align(&feature, &depth, point, world_from_camera, view)?;
    let next = front.extraction.features.len();
    let association = Association::new(next, point, predicted, placed);
    let agrees = Reprojection::new(view.camera, &view.config.ransac)
        .error(world_from_camera, &association.correspondence)
        <= 1.0;
    agrees.then_some((feature, association))
}

/// Maps offsets from the feature to offsets from where the reference view saw the same surface,
/// both in pixels of their pyramid levels, to first order.
fn warp(
    reference: &ReferenceView,
    feature: &Feature,
    depth: &DepthReading,
    world_from_camera: &Isometry3<f64>,
    camera: &Camera,
) -> Option<Matrix2<f64>> {
    /// Of the order of the window that is compared, pixels of the level.
    const STEP: f64 = 4.0;
    let reference_from_camera = reference.world_from_camera.inv_mul(world_from_camera);
    let seen = |offset: Vector2<f64>| {
        let depth = depth.depth + depth.slope.dot(&offset);
        let at = camera.unproject(feature.pixel + offset, depth)?;
        camera.project(&(reference_from_camera * Point3::from(at)).coords)
    };
    let column = |axis: Vector2<f64>| {
        let step = axis * (STEP * feature.scale);
        Some((seen(step)? - seen(-step)?) / (2.0 * STEP * reference.scale))
    };
    Some(Matrix2::from_columns(&[column(Vector2::x())?, column(Vector2::y())?]))
}

/// The view of a feature that becomes a map point.
pub fn first_reference(
    feature: &Feature,
    world_from_camera: &Isometry3<f64>,
) -> Option<ReferenceView> {
    let patch = feature.patch.clone()?;
    let (offset, scale) = (Vector2::zeros(), feature.scale);
    Some(ReferenceView { patch, offset, scale, world_from_camera: *world_from_camera })
}

/// The present view of `point`, which is where the belief has it by now.
pub fn reference(
    feature: &Feature,
    point: &MapPoint,
    world_from_camera: &Isometry3<f64>,
    view: &View,
) -> Option<ReferenceView> {
    let in_camera = world_from_camera.inverse_transform_point(&Point3::from(point.position));
    let offset = (view.project(&in_camera.coords)? - feature.pixel) / feature.scale;
    let near = offset.norm() <= view.config.patch.max_shift;
    let first = first_reference(feature, world_from_camera).filter(|_| near)?;
    Some(ReferenceView { offset, ..first })
}

/// A camera measurement in body coordinates, its covariance inflated as configured.
pub fn in_body(measurement: &PointMeasurement, view: &View) -> (Vector3<f64>, Matrix3<f64>) {
    let rotation = view.body_from_camera.rotation.to_rotation_matrix();
    let covariance = rotation.matrix() * measurement.covariance * rotation.matrix().transpose();
    let point = (view.body_from_camera * Point3::from(measurement.point)).coords;
    (point, covariance * view.config.measurement_inflation)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::{Map, MapConfig, Sighting};
    use crate::odometry::OdometryConfig;
    use crate::sensor::{ColorImage, DepthImage, PinholeCamera, PixelFormat, RgbdFrame, Stamp};
    use crate::vision::{Descriptor, Extraction, Pyramid};
    use nalgebra::UnitQuaternion;

    const SIZE: (usize, usize) = (320, 240);

    /// What a camera at `world_from_camera` sees of a wall at `z = distance`, without corners.
    fn wall(
        camera: &PinholeCamera,
        world_from_camera: &Isometry3<f64>,
        distance: f64,
        texture: impl Fn(f64, f64) -> f64,
    ) -> FrontEndFrame {
        let mut grey = Vec::new();
        let mut depths = Vec::new();
        for row in 0..SIZE.1 {
            for column in 0..SIZE.0 {
                let ray = camera.unproject(Point2::new(column as f64, row as f64), 1.0);
                let eye = world_from_camera.translation.vector;
                let ray = world_from_camera.rotation * ray;
                let depth = (distance - eye.z) / ray.z;
                let hit = eye + ray * depth;
                grey.push(texture(hit.x, hit.y) as u8);
                depths.push((depth * 1e4).round() as u16);
            }
        }
        let mut pyramid = Pyramid::default();
        pyramid.push(grey.clone(), SIZE.0, 1.0);
        let color = ColorImage::new(SIZE.0, SIZE.1, PixelFormat::Mono8, grey).unwrap();
        let depth = DepthImage::new(SIZE.0, SIZE.1, 1e-4, depths).unwrap();
        FrontEndFrame {
            frame: Box::new(RgbdFrame {
                stamp: Stamp::default(),
                color,
                depth,
                others: Vec::new(),
            }),
            extraction: Extraction { pyramid, ..Extraction::default() },
            seconds: 0.0,
        }
    }

    fn texture(x: f64, y: f64) -> f64 {
        125.0 + 35.0 * ((31.0 * x).sin() + (27.0 * y + 1.0).sin() + (19.0 * x - 23.0 * y).cos())
    }

    #[test]
    fn points_are_found_without_corners_and_not_where_something_else_is_seen() {
        let config = OdometryConfig::default();
        let camera = PinholeCamera { fx: 300.0, fy: 300.0, cx: 160.0, cy: 120.0 };
        let (fx, fy, cx, cy) = (300.0, 300.0, 160.0, 120.0);
        let config = OdometryConfig {
            camera: crate::sensor::CameraConfig { fx, fy, cx, cy, ..config.camera },
            ..config
        }
        .tracking()
        .unwrap();
        let view = View {
            config: &config,
            camera: &Camera::pinhole(camera),
            body_from_camera: Isometry3::identity(),
            size: SIZE,
            shutter: Shutter::default(),
            seed: 0,
        };
        let first = wall(&camera, &Isometry3::identity(), 2.0, texture);
        let glimpse = first.extraction.pyramid.look(Point2::new(140.0, 110.0), 1.0).unwrap();
        let reference = ReferenceView {
            patch: Arc::new(glimpse.patch),
            offset: Vector2::zeros(),
            scale: 1.0,
            world_from_camera: Isometry3::identity(),
        };
        let sighting = Sighting {
            frame: 0,
            camera: Vector3::zeros(),
            descriptor: Descriptor::from_bytes(&[0; 32]),
            reference: Some(reference),
        };
        let mut map = Map::new(&MapConfig::default());
        let position = camera.unproject(glimpse.pixel, 2.0);
        let id = map.insert(position, Matrix3::identity() * 1e-6, &sighting).unwrap();
        let point = map.get(id).unwrap();

        let turn = UnitQuaternion::new(Vector3::new(0.03, -0.02, 0.1));
        let pose = Isometry3::from_parts(Vector3::new(0.1, -0.05, 0.2).into(), turn);
        let now = wall(&camera, &pose, 2.0, texture);
        // A pose that is wrong by a pixel.
        let believed = pose * Isometry3::rotation(Vector3::new(0.002, -0.003, 0.0));
        let (feature, found) = seek(point, &believed, &now, &view).unwrap();
        let exact = pose.inverse_transform_point(&position.into()).coords;
        let pixel = |p: &Vector3<f64>| camera.project(p).unwrap();
        let measured = found.correspondence.measurement.point;
        let error = (pixel(&measured) - pixel(&exact)).norm();
        assert!(error < 0.1, "{error} px");
        assert!((measured.z - exact.z).abs() < 2e-3);
        assert!((found.predicted - pixel(&exact)).norm() > 0.5);
        assert_eq!((found.point, found.feature, feature.octave), (id, 0, 0));

        let nothing = |frame: &FrontEndFrame| {
            assert!(seek(point, &believed, frame, &view).is_none());
        };
        nothing(&wall(&camera, &pose, 2.0, |x, y| texture(y + 3.0, 2.0 * x)));
        nothing(&wall(&camera, &pose, 2.0, |_, _| 100.0));
        // The same surface pattern, but much nearer than the point.
        nothing(&wall(&camera, &pose, 1.2, |x, y| texture(x / 0.6, y / 0.6)));
        let behind = Isometry3::rotation(Vector3::new(0.0, 3.0, 0.0));
        assert!(seek(point, &behind, &now, &view).is_none());
    }
}
