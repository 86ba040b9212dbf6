use std::sync::Arc;

use nalgebra::{Matrix2, Matrix3, Point2, UnitVector3, Vector2, Vector3};
use serde::{Deserialize, Serialize};

use super::{DepthReading, Patch, Pyramid};
use crate::sensor::Camera;

/// A 256-bit binary descriptor (ORB, BRIEF, ...).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Descriptor([u64; 4]);

impl Descriptor {
    pub const BYTES: usize = 32;

    pub fn from_bytes(bytes: &[u8; Self::BYTES]) -> Self {
        let mut words = [0; 4];
        for (word, chunk) in words.iter_mut().zip(bytes.as_chunks::<8>().0) {
            *word = u64::from_le_bytes(*chunk);
        }
        Self(words)
    }

    pub fn to_bytes(self) -> [u8; Self::BYTES] {
        let mut bytes = [0; Self::BYTES];
        for (chunk, word) in bytes.as_chunks_mut::<8>().0.iter_mut().zip(self.0) {
            *chunk = word.to_le_bytes();
        }
        bytes
    }

    /// Number of bits that differ, 0..=256.
    #[inline(always)]
    pub fn hamming(&self, other: &Self) -> u32 {
        self.0.iter().zip(other.0).map(|(a, b)| (a ^ b).count_ones()).sum()
    }
}

/// Where a feature is in space, by the depth image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointMeasurement {
    /// Camera coordinates, m.
    pub point: Vector3<f64>,
    /// Covariance of `point` in camera coordinates, m^2.
    pub covariance: Matrix3<f64>,
}

impl PointMeasurement {
    /// Point and covariance at a `pixel` known with `pixel_sigma` (px, each axis); `None` outside of
    /// what the lens images.
    ///
    /// A pixel error moves the point along the surface, not along one of constant depth:
    /// `p(u, v) = d(u, v) r(u, v)` with depth `d` and `r` the point at depth 1, so
    /// `dp/du = d dr/du + dd/du r`.
    pub fn new(
        camera: &Camera,
        pixel: Point2<f64>,
        pixel_sigma: f64,
        reading: &DepthReading,
    ) -> Option<Self> {
        let point = camera.unproject(pixel, reading.depth)?;
        let ray = point / reading.depth;
        let across = camera.across(&ray, reading.depth)?;
        let along_u = across.column(0) + ray * reading.slope.x;
        let along_v = across.column(1) + ray * reading.slope.y;
        let lateral = along_u * along_u.transpose() + along_v * along_v.transpose();
        let covariance = lateral * pixel_sigma.powi(2)
            + ray * ray.transpose() * reading.standard_deviation.powi(2);
        Some(Self { point, covariance })
    }
}

/// A key point of one image.
#[derive(Debug, Clone, PartialEq)]
pub struct Feature {
    /// Position in the image as taken, pixels.
    pub pixel: Point2<f64>,
    /// Direction in which the camera sees it, camera coordinates.
    pub bearing: UnitVector3<f64>,
    pub descriptor: Descriptor,
    /// Strength of the corner: its FAST score, in grey levels.
    pub response: f32,
    /// Pyramid level it was found on, 0 being the full image.
    pub octave: u8,
    /// Pixels of the full image a pixel of that level.
    pub scale: f64,
    /// Standard deviation of `pixel`, pixels a coordinate.
    pub pixel_sigma: f64,
    /// Its surroundings on that level.
    pub patch: Option<Arc<Patch>>,
    /// `None` where the depth image has no reading that can be trusted.
    pub depth: Option<DepthReading>,
}

impl Feature {
    /// Where the feature is in space, as the detector placed it; `None` without depth.
    pub fn measurement(&self, camera: &Camera) -> Option<PointMeasurement> {
        let depth = self.depth.as_ref()?;
        self.measurement_with(depth, camera, Vector2::zeros(), self.pixel_sigma)
    }

    /// Where the feature is in space if it is really `shift` (px of the full image) beside
    /// [`Self::pixel`], known with `pixel_sigma` (px), on the surface that `depth` describes; `None`
    /// outside of what the lens images.
    pub fn measurement_with(
        &self,
        depth: &DepthReading,
        camera: &Camera,
        shift: Vector2<f64>,
        pixel_sigma: f64,
    ) -> Option<PointMeasurement> {
        let moved = DepthReading { depth: depth.depth + depth.slope.dot(&shift), ..*depth };
        PointMeasurement::new(camera, self.pixel + shift, pixel_sigma, &moved)
    }
}

/// Where one camera sees a point that is followed from frame to frame.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackedFeature {
    /// The point's: never given to another one, not even after it was lost.
    pub id: u64,
    /// Index of the camera, 0 being the first one.
    pub camera: usize,
    /// Position in the image as taken, px.
    pub pixel: Point2<f64>,
    /// Covariance of `pixel`, px^2. Zero in the first view: its surroundings are what all later
    /// views are aligned to, so that view defines the point and has no error of its own.
    pub pixel_covariance: Matrix2<f64>,
    /// `None` where the depth image has no reading that can be trusted.
    pub depth: Option<DepthReading>,
    /// Of the point's first view.
    pub descriptor: Option<Descriptor>,
}

/// What a front end makes of one frame.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Extraction {
    pub features: Vec<Feature>,
    /// Points that are followed from frame to frame, in order of id and camera: a point that two
    /// cameras see is in it twice. Empty where no tracker is on.
    pub tracks: Vec<TrackedFeature>,
    /// What they were found in; empty where it is not kept.
    pub pyramid: Pyramid,
}

/// How key points are found and how well they are localised.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FeatureConfig {
    /// Most features a frame.
    pub max_features: usize,
    /// Pyramid levels.
    pub levels: u8,
    /// Size ratio of consecutive pyramid levels, above 1.
    pub scale_factor: f64,
    /// FAST threshold in grey levels: how much the circle must differ from its centre.
    pub fast_threshold: u8,
    /// Threshold where the other one finds few corners: in dark, blurred or plain parts.
    pub min_fast_threshold: u8,
    /// Side of the cells that share out `max_features` over the image, pixels.
    pub cell_size: f64,
    /// No two features of a frame are closer than this, pixels.
    pub min_spacing: f64,
    /// Standard deviation of a key point's position at octave 0, pixels a coordinate; grows
    /// with the square root of the scale of the octave.
    pub pixel_sigma: f64,
}

impl Default for FeatureConfig {
    fn default() -> Self {
        Self {
            max_features: 600,
            levels: 4,
            scale_factor: 1.44,
            fast_threshold: 20,
            min_fast_threshold: 7,
            cell_size: 40.0,
            min_spacing: 4.0,
            pixel_sigma: 0.7,
        }
    }
}

impl FeatureConfig {
    /// Standard deviation of a key point's position on `octave`, pixels of the full image.
    ///
    /// The square root of the scale is what reprojection errors show on real recordings (TUM
    /// fr1_rpy: 0.67 px at octave 0, 1.27 px at octave 7 of scale 3.6; 7-Scenes: 0.52, 1.01).
    pub fn pixel_sigma_at(&self, octave: u8) -> f64 {
        self.pixel_sigma * self.scale_factor.powf(f64::from(octave) / 2.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::PinholeCamera;
    use nalgebra::Vector2;
    use proptest::prelude::*;

    fn naive_hamming(a: &[u8; 32], b: &[u8; 32]) -> u32 {
        let bit = |bytes: &[u8; 32], i: usize| bytes[i / 8] >> (i % 8) & 1;
        (0..256).filter(|&i| bit(a, i) != bit(b, i)).count() as u32
    }

    proptest! {
        #[test]
        fn hamming_counts_differing_bits(a: [u8; 32], b: [u8; 32]) {
            let (da, db) = (Descriptor::from_bytes(&a), Descriptor::from_bytes(&b));
            prop_assert_eq!(da.hamming(&db), naive_hamming(&a, &b));
            prop_assert_eq!(da.hamming(&db), db.hamming(&da));
            prop_assert_eq!(da.to_bytes(), a);
        }

        /// First-order propagation against central differences through the surface itself.
        #[test]
        fn covariance_follows_the_surface(
            u in 0.0..640.0f64, v in 0.0..480.0f64, depth in 0.5..5.0f64,
            slope_u in -0.01..0.01f64, slope_v in -0.01..0.01f64,
        ) {
            let pinhole = PinholeCamera { fx: 517.0, fy: 516.0, cx: 318.0, cy: 255.0 };
            let camera = Camera::pinhole(pinhole);
            let reading = DepthReading {
                depth, slope: Vector2::new(slope_u, slope_v), standard_deviation: 0.01,
            };
            let sigma = 0.8;
            let measured = PointMeasurement::new(&camera, Point2::new(u, v), sigma, &reading).unwrap();
            let at = |du: f64, dv: f64, dz: f64| {
                let z = depth + slope_u * du + slope_v * dv + dz;
                pinhole.unproject(Point2::new(u + du, v + dv), z)
            };
            let h = 1e-4;
            let columns = [
                (at(h, 0.0, 0.0) - at(-h, 0.0, 0.0)) * (sigma / (2.0 * h)),
                (at(0.0, h, 0.0) - at(0.0, -h, 0.0)) * (sigma / (2.0 * h)),
                (at(0.0, 0.0, h) - at(0.0, 0.0, -h)) * (0.01 / (2.0 * h)),
            ];
            let expected: Matrix3<f64> = columns.iter().map(|c| c * c.transpose()).sum();
            prop_assert!((measured.covariance - expected).norm() < 1e-6 * expected.norm());
            prop_assert!(measured.covariance.cholesky().is_some());
            // The surface does not matter to where the point is seen.
            let pixel = camera.pixel_covariance(&measured.point, &measured.covariance);
            prop_assert!((pixel - nalgebra::Matrix2::identity() * sigma * sigma).norm() < 1e-9);
        }
    }
}
