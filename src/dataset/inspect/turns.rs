//! How the IMU sits on the camera, and in which units it reads, from turns that both see.
//!
//! Over a span, the camera turns by `exp(c)` in its own axes and the IMU by `exp(g)` in its own; with
//! the mounting `R` (IMU from camera) `exp(g) = R exp(c) R^T`, so `g = R c`: the rotation between
//! two sets of vectors, by Kabsch's method (Umeyama 1991, equations 40 to 43).

use nalgebra::{Isometry3, Matrix3, Rotation3, UnitQuaternion, Vector3};
use serde::Serialize;

use crate::sensor::{ImuSample, Stamp, TruthPose};

/// Length of a span over which turns are compared, s.
const SPAN: f64 = 0.2;
/// Largest offset of the clocks that is looked for, and the step of the search, s.
const LARGEST_OFFSET: f64 = 0.1;
const OFFSET_STEP: f64 = 0.005;
/// Residuals beyond this many times their median are no measurement of the mounting.
const OUTLIER: f64 = 4.0;
/// Turns are seen as the same if all but this part of their squares is explained.
const LARGEST_RESIDUAL: f64 = 0.2;
/// Fewer spans than this tell nothing.
const FEWEST_SPANS: usize = 20;
/// A mounting that is known worse than this (one standard deviation) is not stated, rad.
const COARSEST: f64 = 0.05;

/// What turns that camera and gyroscope see tell.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TurnInspection {
    /// Rotation that maps camera to IMU coordinates.
    #[serde(serialize_with = "rows")]
    pub imu_from_camera: Matrix3<f64>,
    /// Its standard deviation about the worst axis, degrees.
    pub sd_deg: f64,
    /// The IMU's axes are left-handed: `imu_from_camera` is then a reflection.
    pub is_mirrored: bool,
    /// Factor that makes rad/s of the gyroscope's readings.
    pub gyroscope_scale: f64,
    /// Added to camera stamps it brings them to the IMU's clock, s.
    pub time_offset: f64,
    /// Part of the squares of the turns that is not explained.
    pub residual: f64,
}

fn rows<S: serde::Serializer>(matrix: &Matrix3<f64>, serializer: S) -> Result<S::Ok, S::Error> {
    let row = |r: usize| [matrix[(r, 0)], matrix[(r, 1)], matrix[(r, 2)]];
    [row(0), row(1), row(2)].serialize(serializer)
}

impl TurnInspection {
    /// From poses of the camera and readings of the IMU as logged, both in order of time; `None` if
    /// there are too few turns, or if they do not go together.
    ///
    /// Time `O((n + m) k)` for `n` poses, `m` samples and `k` offsets that are tried.
    pub fn of(camera: &[TruthPose], imu: &[ImuSample]) -> Option<Self> {
        let gyroscope = Heading::new(imu)?;
        let steps = (LARGEST_OFFSET / OFFSET_STEP).round() as i64;
        let fits: Vec<(f64, Fit)> = (-steps..=steps)
            .filter_map(|step| {
                let offset = step as f64 * OFFSET_STEP;
                Some((offset, Fit::new(&pairs(camera, &gyroscope, offset))?))
            })
            .collect();
        let best =
            (0..fits.len()).min_by(|a, b| fits[*a].1.residual.total_cmp(&fits[*b].1.residual))?;
        let offset = fits[best].0 + vertex(&fits, best);
        let fit = Fit::new(&pairs(camera, &gyroscope, offset))?;
        (fit.residual < LARGEST_RESIDUAL && fit.sd < COARSEST).then(|| Self {
            imu_from_camera: fit.rotation,
            sd_deg: fit.sd.to_degrees(),
            is_mirrored: fit.rotation.determinant() < 0.0,
            gyroscope_scale: fit.scale,
            time_offset: offset,
            residual: fit.residual,
        })
    }

    /// The mounting as a motion without translation; `None` where no rotation does it.
    pub fn mounting(&self) -> Option<UnitQuaternion<f64>> {
        let rotation = Rotation3::from_matrix_unchecked(self.imu_from_camera);
        (!self.is_mirrored).then(|| UnitQuaternion::from_rotation_matrix(&rotation))
    }

    /// Angle between this mounting and another one, degrees.
    pub fn angle_to(&self, imu_from_camera: &Isometry3<f64>) -> Option<f64> {
        Some(self.mounting()?.angle_to(&imu_from_camera.rotation).to_degrees())
    }

    /// What was done to the axes of an IMU that should be mounted as `expected`, in words; `None`
    /// for a mirrored one.
    pub fn correction(&self, expected: &Isometry3<f64>) -> String {
        let turned =
            self.imu_from_camera * expected.rotation.inverse().to_rotation_matrix().matrix();
        let axes = ["x", "y", "z"];
        let entry = |row: usize| {
            let column = (0..3).find(|column| turned[(row, *column)].abs() > 0.95)?;
            let sign = if turned[(row, column)] < 0.0 { "-" } else { "" };
            Some(format!("{} = {sign}{}", axes[row], axes[column]))
        };
        let entries: Option<Vec<_>> = (0..3).map(entry).collect();
        match entries {
            Some(entries) => format!("the logged {} of the configured axes", entries.join(", ")),
            None => "not about multiples of 90 degrees".to_owned(),
        }
    }
}

/// Attitude by the gyroscope alone, from an arbitrary start.
struct Heading {
    stamps: Vec<Stamp>,
    rates: Vec<Vector3<f64>>,
}

impl Heading {
    fn new(imu: &[ImuSample]) -> Option<Self> {
        (imu.len() >= FEWEST_SPANS).then(|| Self {
            stamps: imu.iter().map(|sample| sample.stamp).collect(),
            rates: imu.iter().map(|sample| sample.angular_velocity).collect(),
        })
    }

    /// Sum of the turns between two stamps in units of the readings times s; `None` where samples
    /// are missing.
    ///
    /// The sum, not the composition, since the unit is not known yet; for turns of a fifth of a
    /// second they differ by the square of the angle.
    fn turn(&self, from: Stamp, to: Stamp) -> Option<Vector3<f64>> {
        let first = self.stamps.partition_point(|stamp| *stamp < from);
        let last = self.stamps.partition_point(|stamp| *stamp <= to);
        let inside = last.checked_sub(first).filter(|count| *count >= 3)?;
        let covered = self.stamps[last - 1].seconds_since(self.stamps[first]);
        let wanted = to.seconds_since(from);
        if covered < 0.7 * wanted {
            return None;
        }
        let sum: Vector3<f64> = self.rates[first..last].iter().sum();
        Some(sum / inside as f64 * wanted)
    }
}

/// Turns of the camera and of the gyroscope over the same spans.
fn pairs(camera: &[TruthPose], gyroscope: &Heading, offset: f64) -> Vec<[Vector3<f64>; 2]> {
    let mut pairs = Vec::new();
    let mut rest = camera;
    while let Some(first) = rest.first() {
        let next = rest.iter().position(|pose| pose.stamp.seconds_since(first.stamp) >= SPAN);
        let Some(next) = next else { break };
        let last = &rest[next];
        let span = last.stamp.seconds_since(first.stamp);
        let shifted = |pose: &TruthPose| pose.stamp.offset_by(offset);
        if span < 1.5 * SPAN
            && let Some(turn) = gyroscope.turn(shifted(first), shifted(last))
        {
            let seen = first.world_from_body.rotation.inverse() * last.world_from_body.rotation;
            pairs.push([seen.scaled_axis(), turn]);
        }
        // Spans overlap, so that short logs have enough of them.
        rest = &rest[(next / 2).max(1)..];
    }
    pairs
}

/// The rotation and scale that take turns of the camera to those of the gyroscope.
struct Fit {
    rotation: Matrix3<f64>,
    scale: f64,
    residual: f64,
    /// rad
    sd: f64,
}

impl Fit {
    fn new(pairs: &[[Vector3<f64>; 2]]) -> Option<Self> {
        let first = Self::of(pairs)?;
        let errors: Vec<f64> = pairs.iter().map(|pair| first.error(pair).norm()).collect();
        let mut sorted = errors.clone();
        sorted.sort_by(f64::total_cmp);
        let limit = OUTLIER * sorted[sorted.len() / 2];
        let kept: Vec<_> =
            pairs.iter().zip(&errors).filter(|(_, e)| **e <= limit).map(|(p, _)| *p).collect();
        Self::of(&kept)
    }

    fn of(pairs: &[[Vector3<f64>; 2]]) -> Option<Self> {
        if pairs.len() < FEWEST_SPANS {
            return None;
        }
        let count = pairs.len() as f64;
        let mean = |k: usize| pairs.iter().map(|pair| pair[k]).sum::<Vector3<f64>>() / count;
        // The gyroscope's bias moves the mean.
        let (camera_mean, imu_mean) = (mean(0), mean(1));
        let (mut cross, mut spread, mut readings) = (Matrix3::zeros(), Matrix3::zeros(), 0.0);
        for [camera, imu] in pairs {
            let (c, g) = (camera - camera_mean, imu - imu_mean);
            cross += g * c.transpose();
            spread += c * c.transpose();
            readings += g.norm_squared();
        }
        let turns = spread.trace();
        if !(turns > 0.0 && readings > 0.0) {
            return None;
        }
        let scale = (turns / readings).sqrt();
        let svd = cross.svd(true, true);
        let (u, v_t) = (svd.u?, svd.v_t?);
        let handed = (u * v_t).determinant().signum();
        let kept = |sign: f64| {
            let signs = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign * handed));
            let explained = svd.singular_values.dot(&signs.diagonal());
            // |g|^2 + s^2 |c|^2 - 2 s sum of singular values, over |g|^2, at the best s.
            (u * signs * v_t, 1.0 - explained.powi(2) / (turns * readings))
        };
        let (proper, mirrored) = (kept(1.0), kept(-1.0));
        let smallest = spread.symmetric_eigenvalues().min();
        // Turns in a plane fit a reflection as well as a rotation.
        let is_mirrored = handed < 0.0
            && smallest > 0.02 * turns
            && mirrored.1 < 0.5 * LARGEST_RESIDUAL
            && mirrored.1 < 0.5 * proper.1;
        let (rotation, residual) = if is_mirrored { mirrored } else { proper };
        // Each turn tells the rotation about the axes across it.
        let information = Matrix3::identity() * turns - spread;
        let noise = (residual.max(0.0) * turns / (3.0 * count)).max(1e-12);
        let weakest = information.symmetric_eigenvalues().min();
        let sd = (noise / weakest.max(f64::MIN_POSITIVE)).sqrt();
        Some(Self { rotation, scale, residual: residual.max(0.0), sd })
    }

    fn error(&self, [camera, imu]: &[Vector3<f64>; 2]) -> Vector3<f64> {
        self.rotation * camera - imu * self.scale
    }
}

/// Where the parabola through a smallest residual and its neighbours has its vertex, from there, s.
fn vertex(fits: &[(f64, Fit)], best: usize) -> f64 {
    let at =
        |index: Option<usize>| index.and_then(|index| fits.get(index)).map(|fit| fit.1.residual);
    let (Some(before), Some(here), Some(after)) =
        (at(best.checked_sub(1)), at(Some(best)), at(Some(best + 1)))
    else {
        return 0.0;
    };
    let curvature = before + after - 2.0 * here;
    if curvature > 0.0 { 0.5 * (before - after) / curvature * OFFSET_STEP } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulation::{Motion, MotionConfig, MotionKind};

    /// 8 s of a hand-held motion: poses of a camera at 30 Hz with a little noise, and readings at
    /// 200 Hz of an IMU whose axes are `axes` times the body's.
    fn seen(
        camera: &UnitQuaternion<f64>,
        axes: &Matrix3<f64>,
        unit: f64,
        offset: f64,
    ) -> (Vec<TruthPose>, Vec<ImuSample>) {
        let config = MotionConfig { kind: MotionKind::LabMotion, ..MotionConfig::default() };
        let motion = Motion::built_in(&config, &Isometry3::identity(), 5);
        let at = |t: f64| Stamp::default().offset_by(t + 10.0);
        let poses = (0..240).map(|k| {
            let t = f64::from(k) / 30.0 + 1.0;
            let wobble = Vector3::new((37.0 * t).sin(), (51.0 * t).cos(), (43.0 * t).sin()) * 5e-4;
            let pose = motion.state(t).world_from_body;
            let rotation = pose.rotation * camera * UnitQuaternion::from_scaled_axis(wobble);
            let world_from_body = Isometry3::from_parts(pose.translation, rotation);
            TruthPose { stamp: at(t - offset), world_from_body }
        });
        let samples = (0..2000).map(|k| {
            let t = f64::from(k) / 200.0;
            let rate = motion.state(t).angular_velocity + Vector3::new(0.01, -0.02, 0.005);
            ImuSample {
                stamp: at(t),
                angular_velocity: axes * rate / unit,
                specific_force: Vector3::zeros(),
            }
        });
        (poses.collect(), samples.collect())
    }

    #[test]
    fn mounting_unit_and_offset_are_found() {
        for (angles, unit, offset) in [
            ([0.0, 0.0, 0.0], 1.0, 0.0),
            ([-1.57, 0.1, -1.5], 1.0, 0.033),
            ([3.0, 0.4, 1.0], 1_f64.to_radians(), -0.02),
        ] {
            let camera = UnitQuaternion::from_euler_angles(angles[0], angles[1], angles[2]);
            let (poses, samples) = seen(&camera, &Matrix3::identity(), unit, offset);
            let found = TurnInspection::of(&poses, &samples).unwrap();
            let error = found.mounting().unwrap().angle_to(&camera).to_degrees();
            assert!(error < 1.0 && error < 6.0 * found.sd_deg.max(0.1), "{error} {found:?}");
            assert!((found.gyroscope_scale / unit - 1.0).abs() < 0.03, "{found:?}");
            assert!((found.time_offset - offset).abs() < 0.004, "{found:?}");
        }
    }

    #[test]
    fn left_handed_axes_are_told() {
        let mirror = Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, 1.0));
        let swapped = Matrix3::new(0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
        for axes in [mirror, swapped] {
            let (poses, samples) = seen(&UnitQuaternion::identity(), &axes, 1.0, 0.0);
            let found = TurnInspection::of(&poses, &samples).unwrap();
            assert!(found.is_mirrored && found.mounting().is_none(), "{found:?}");
            assert!((found.imu_from_camera - axes).norm() < 0.05, "{found:?}");
        }
    }

    #[test]
    fn turned_axes_are_put_in_words() {
        let half = Matrix3::from_diagonal(&Vector3::new(-1.0, -1.0, 1.0));
        let (poses, samples) = seen(&UnitQuaternion::identity(), &half, 1.0, 0.0);
        let found = TurnInspection::of(&poses, &samples).unwrap();
        assert!(!found.is_mirrored);
        assert!((found.angle_to(&Isometry3::identity()).unwrap() - 180.0).abs() < 2.0);
        let words = found.correction(&Isometry3::identity());
        assert!(words.contains("x = -x, y = -y, z = z"), "{words}");
    }

    #[test]
    fn turns_that_do_not_go_together_tell_nothing() {
        let (poses, mut samples) =
            seen(&UnitQuaternion::identity(), &Matrix3::identity(), 1.0, 0.0);
        let rates: Vec<_> = samples.iter().rev().map(|s| s.angular_velocity).collect();
        samples.iter_mut().zip(rates).for_each(|(s, rate)| s.angular_velocity = rate);
        assert_eq!(TurnInspection::of(&poses, &samples), None);
        let still: Vec<_> = poses
            .iter()
            .map(|p| TruthPose { world_from_body: poses[0].world_from_body, ..*p })
            .collect();
        assert_eq!(TurnInspection::of(&still, &samples), None);
        assert_eq!(TurnInspection::of(&[], &[]), None);
    }
}
