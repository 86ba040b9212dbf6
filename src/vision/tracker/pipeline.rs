use nalgebra::{Matrix2, Point2, Vector3};
use opencv::calib3d;
use opencv::core::{Mat, Point2d, Vector};
use opencv::prelude::*;

use super::TrackerConfig;
use super::across::{OtherCamera, OtherView};
use super::corners::{CornerFinder, Wanted};
use super::epipolar::{self, Pair};
use super::levels::Levels;
use super::motion::ImageMotion;
use super::track::{Frame, MOST_LEVELS, Track};
use super::turn::Gyroscope;
use crate::inertial::ImuConfig;
use crate::sensor::{Camera, CameraConfig, ImuSample, RgbdFrame, Stamp};
use crate::vision::orb::VisionError;
use crate::vision::{DepthConfig, FeatureConfig, Mask, TrackedFeature};

/// Smallest side of a level, pixels.
const LEAST_SIDE: usize = 50;
/// Nothing is followed over a longer time between two frames, s.
const LONGEST_INTERVAL: f64 = 0.5;
/// Points nearer to one another than this show the same, px.
const SAME_POINT: f64 = 5.0;
/// Standard deviation of the grey values before any point has told it, and the least that
/// quantisation and compression leave.
const FIRST_NOISE: f32 = 2.0;
const LEAST_NOISE: f32 = 0.7;

/// Follows points from frame to frame.
///
/// Frames and samples come in order of time; the result depends on them alone. A frame costs
/// `O(pixels + points)`.
pub struct Tracker {
    config: TrackerConfig,
    camera: Camera,
    readout_time: f64,
    depth: DepthConfig,
    mask: Mask,
    gyroscope: Option<Gyroscope>,
    others: Vec<OtherCamera>,
    corners: CornerFinder,
    present: Levels,
    former: Levels,
    tracks: Vec<Track>,
    last: Option<Stamp>,
    next_id: u64,
    frames: u64,
    /// Standard deviation of the grey values.
    noise: f32,
}

impl Tracker {
    /// # Errors
    /// [`VisionError`] for a camera or values that cannot be.
    pub fn new(
        config: &TrackerConfig,
        features: &FeatureConfig,
        camera: &CameraConfig,
        depth: &DepthConfig,
        imu: &ImuConfig,
    ) -> Result<Self, VisionError> {
        let check = |key: &'static str, value: f64, good: bool, expected: &'static str| {
            if good { Ok(()) } else { Err(VisionError::Tracker { key, value, expected }) }
        };
        let levels = f64::from(config.levels);
        check("levels", levels, (1..=MOST_LEVELS as u8).contains(&config.levels), "1 to 6")?;
        let cell = config.cell_size;
        check("cell_size", cell, cell == 0.0 || cell >= 4.0, "0, or at least 4 pixels")?;
        let least = config.min_correlation;
        check("min_correlation", least, (-1.0..1.0).contains(&least), "-1 to 1")?;
        for (key, value) in
            [("pixel_sigma", config.pixel_sigma), ("max_pixel_sigma", config.max_pixel_sigma)]
        {
            check(key, value, value > 0.0 && value.is_finite(), "above 0")?;
        }
        check("patience", config.patience, config.patience >= 0.0, "0 or more")?;
        opencv::core::set_num_threads(1)?;
        Ok(Self {
            config: config.clone(),
            camera: Camera::new(camera)?.with_depth(depth.along),
            readout_time: camera.readout_time,
            depth: depth.clone(),
            mask: Mask::default(),
            gyroscope: Gyroscope::new(camera, imu),
            others: Vec::new(),
            corners: CornerFinder::new(features)?,
            present: Levels::default(),
            former: Levels::default(),
            tracks: Vec::new(),
            last: None,
            next_id: 0,
            frames: 0,
            noise: FIRST_NOISE,
        })
    }

    /// The same, that follows nothing in a part of the image.
    pub fn masked(self, mask: Mask) -> Self {
        Self { mask, ..self }
    }

    /// The same for a body with further cameras, whose images come in
    /// [`others`](RgbdFrame::others); `first` is the one that the tracker was made for.
    ///
    /// # Errors
    /// [`VisionError`] for cameras that cannot be.
    pub fn with_others(
        self,
        first: &CameraConfig,
        others: &[CameraConfig],
    ) -> Result<Self, VisionError> {
        let others = others.iter().map(|other| OtherCamera::new(first, other));
        Ok(Self { others: others.collect::<Result<_, _>>()?, ..self })
    }

    /// The turn up to the next frame is predicted by it.
    pub fn imu(&mut self, sample: &ImuSample) {
        if let Some(gyroscope) = &mut self.gyroscope {
            gyroscope.push(sample);
        }
    }

    /// The points seen in a frame, those that are new in it included, in order of id and camera.
    ///
    /// # Errors
    /// [`VisionError`] if OpenCV refuses the image.
    pub fn track(&mut self, frame: &RgbdFrame) -> Result<Vec<TrackedFeature>, VisionError> {
        self.frames += 1;
        let (motion, continues) = self.advance(frame)?;
        match continues {
            true => {
                self.follow(&motion);
                self.drop_outliers(&motion)?;
                self.drop_coinciding();
                self.renew_noise();
            }
            false => self.tracks.clear(),
        }
        self.fill()?;
        self.report(frame, &motion)
    }

    /// Takes the images of a frame; how they follow on those before, and whether they do.
    fn advance(&mut self, frame: &RgbdFrame) -> Result<(ImageMotion, bool), VisionError> {
        std::mem::swap(&mut self.present, &mut self.former);
        let levels = usize::from(self.config.levels);
        self.present.fill(&frame.color, levels, LEAST_SIDE)?;
        let last = self.last.replace(frame.stamp);
        let (now, before) = (self.present.level(0), self.former.level(0));
        let is_alike = (now.width, now.height) == (before.width, before.height);
        let last = last.filter(|_| is_alike).unwrap_or(frame.stamp);
        let seconds = frame.stamp.seconds_since(last);
        let motion = ImageMotion {
            camera: self.camera,
            turn: self.gyroscope.as_ref().and_then(|gyro| gyro.turn(last, frame.stamp)),
            seconds,
            readout_time: self.readout_time,
            height: now.height as f64,
        };
        Ok((motion, seconds > 0.0 && seconds <= LONGEST_INTERVAL))
    }

    fn follow(&mut self, motion: &ImageMotion) {
        let mut tracks = std::mem::take(&mut self.tracks);
        let frame = self.frame(motion);
        tracks.retain_mut(|track| track.follow(&frame));
        self.tracks = tracks;
    }

    fn frame<'a>(&'a self, motion: &'a ImageMotion) -> Frame<'a> {
        Frame {
            config: &self.config,
            mask: &self.mask,
            present: &self.present,
            former: &self.former,
            motion,
            noise_variance: self.noise * self.noise,
        }
    }

    /// Drops points that do not move as most of them do.
    fn drop_outliers(&mut self, motion: &ImageMotion) -> Result<(), VisionError> {
        let focal = 0.5 * (self.camera.intrinsics().fx + self.camera.intrinsics().fy);
        let floor = self.config.pixel_sigma.powi(2);
        let variance =
            |covariance: &Matrix2<f64>| (0.5 * covariance.trace()).max(floor) / (focal * focal);
        let (mut pairs, mut followed) = (vec![], vec![]);
        for (index, track) in self.tracks.iter().enumerate().filter(|(_, track)| track.is_seen()) {
            let Some(former) = track.former else { continue };
            let Some([before, now]) = motion.directions(former, track.pixel) else { continue };
            let variances = [variance(&track.former_covariance), variance(&track.covariance)];
            pairs.push(Pair { before, now, variances });
            followed.push(index);
        }
        let known = motion.turn.as_ref();
        let agree = known.and_then(|turn| epipolar::agreeing(&pairs, turn.sigma, self.frames));
        let agree = match agree {
            Some(agree) => Some(agree),
            None => agreeing_by_five_points(&pairs)?,
        };
        let Some(agree) = agree else { return Ok(()) };
        let mut verdicts = followed.into_iter().zip(agree).peekable();
        let mut index = 0;
        self.tracks.retain(|_| {
            let verdict = verdicts.next_if(|(followed, _)| *followed == index);
            index += 1;
            verdict.is_none_or(|(_, agrees)| agrees)
        });
        Ok(())
    }

    /// Of points that have come to the same place the oldest stays.
    fn drop_coinciding(&mut self) {
        let mut kept: Vec<Point2<f64>> = Vec::with_capacity(self.tracks.len());
        self.tracks.retain(|track| {
            let is_new = kept.iter().all(|other| (other - track.pixel).norm() >= SAME_POINT);
            kept.push(track.pixel);
            is_new
        });
    }

    fn renew_noise(&mut self) {
        let seen = self.tracks.iter().filter(|track| track.is_seen());
        // Both images have it.
        let mut variances: Vec<f32> = seen.map(|track| 0.5 * track.noise_variance).collect();
        if variances.len() < epipolar::LEAST {
            return;
        }
        let middle = variances.len() / 2;
        let (_, median, _) = variances.select_nth_unstable_by(middle, f32::total_cmp);
        self.noise = median.sqrt().max(LEAST_NOISE);
    }

    fn fill(&mut self) -> Result<(), VisionError> {
        let taken: Vec<Point2<f64>> = self.tracks.iter().map(|track| track.pixel).collect();
        let image = self.present.level(0);
        let wanted = Wanted {
            cell: self.config.cell(image.width, image.height),
            count: self.config.points.saturating_sub(taken.len()),
            mask: &self.mask,
            max_sigma: self.config.max_pixel_sigma as f32,
            noise: self.noise,
        };
        if wanted.count == 0 {
            return Ok(());
        }
        for corner in self.corners.find(&self.present, &taken, &wanted)? {
            if let Some(track) = Track::begin(self.next_id, corner.pixel, &self.present) {
                self.tracks.push(track);
                self.next_id += 1;
            }
        }
        Ok(())
    }

    /// The points that are seen, by the first camera and by the others.
    fn report(
        &mut self,
        frame: &RgbdFrame,
        motion: &ImageMotion,
    ) -> Result<Vec<TrackedFeature>, VisionError> {
        let levels = usize::from(self.config.levels);
        let mut others = std::mem::take(&mut self.others);
        for (other, image) in others.iter_mut().zip(&frame.others) {
            other.take(image, levels, LEAST_SIDE)?;
        }
        let looks = &others[..others.len().min(frame.others.len())];
        let mut tracks = std::mem::take(&mut self.tracks);
        let shared = self.frame(motion);
        let mut found = Vec::with_capacity(tracks.len() * (1 + looks.len()));
        for track in tracks.iter_mut().filter(|track| track.is_seen()) {
            let feature = |camera: usize, pixel: Point2<f64>, covariance: Matrix2<f64>| {
                // A depth that the other cameras gave says nothing new.
                let has_depth = camera == 0 && looks.is_empty();
                let depth = has_depth.then(|| self.depth.read(&frame.depth, pixel)).flatten();
                let pixel_covariance = covariance;
                TrackedFeature {
                    id: track.id,
                    camera,
                    pixel,
                    pixel_covariance,
                    depth,
                    descriptor: None,
                }
            };
            found.push(feature(0, track.pixel, track.covariance));
            let mut inverse_depth = track.inverse_depth;
            for (index, other) in looks.iter().enumerate() {
                let Some(view) = other.find(&shared, track) else { continue };
                let OtherView { pixel, covariance, .. } = view;
                inverse_depth = Some(view.inverse_depth);
                found.push(feature(1 + index, pixel, covariance));
            }
            track.inverse_depth = inverse_depth;
        }
        (self.tracks, self.others) = (tracks, others);
        Ok(found)
    }
}

/// Which pairs agree with one turn and translation, neither of them known (Nister, 2004, by
/// OpenCV); those not ahead of the camera do. `None` where they are too few to tell.
fn agreeing_by_five_points(pairs: &[Pair]) -> Result<Option<Vec<bool>>, VisionError> {
    let is_ahead = |v: &Vector3<f64>| v.z > 0.2;
    let (mut before, mut now) = (Vector::<Point2d>::new(), Vector::<Point2d>::new());
    let (mut ahead, mut variances) = (vec![], vec![]);
    for (index, pair) in pairs.iter().enumerate() {
        if is_ahead(&pair.before) && is_ahead(&pair.now) {
            let image = |v: &Vector3<f64>| Point2d::new(v.x / v.z, v.y / v.z);
            before.push(image(&pair.before));
            now.push(image(&pair.now));
            ahead.push(index);
            variances.push(0.5 * (pair.variances[0] + pair.variances[1]));
        }
    }
    if ahead.len() < epipolar::LEAST {
        return Ok(None);
    }
    let middle = variances.len() / 2;
    let (_, variance, _) = variances.select_nth_unstable_by(middle, f64::total_cmp);
    // Distance of a point from its epipolar line, whose own error comes from the other point.
    let threshold = (2.0 * epipolar::GATE * *variance).sqrt();
    let mut inliers = Mat::default();
    calib3d::find_essential_mat(
        &before,
        &now,
        &Mat::eye(3, 3, opencv::core::CV_64F)?,
        calib3d::RANSAC,
        0.999,
        threshold,
        100,
        &mut inliers,
    )?;
    let inliers = inliers.data_bytes()?;
    let mut agree = vec![true; pairs.len()];
    for (index, is_inlier) in ahead.iter().zip(inliers) {
        agree[*index] = *is_inlier != 0;
    }
    let count = agree.iter().filter(|agrees| **agrees).count();
    Ok((inliers.len() == ahead.len() && 2 * count >= pairs.len()).then_some(agree))
}
