use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::mpsc::sync_channel;

use nalgebra::{Isometry3, Vector3};

use super::config::{SceneConfig, SceneError};
use super::imperfections::Imperfections;
use super::inertial::ImuSimulator;
use super::measured::{MeasuredImu, MeasuredImuError};
use super::motion::{BodyState, Motion, MotionConfig};
use super::render::{Renderer, Shot};
use super::texture::Picture;
use super::trajectory::body_poses;
use super::world::{RoomConfig, World};
use crate::dataset::{LogWriter, WriteError, WriteSummary};
use crate::sensor::{Event, RgbdFrame, Stamp, TruthPose};

/// Runs through a scene and yields what its sensors see, ordered by stamp.
pub struct Simulation {
    config: SceneConfig,
    motion: Motion,
    body_from_camera: Isometry3<f64>,
    renderer: Renderer,
    imu: ImuSimulator,
    imperfections: Imperfections,
    /// In place of the simulated IMU.
    measured: Option<MeasuredImu>,
    start: Stamp,
    imu_samples: Ticks,
    truth_poses: Ticks,
    frames: Ticks,
}

/// Times `k / rate` up to a duration, without those in gaps.
#[derive(Debug, Clone)]
struct Ticks {
    next: u64,
    rate: f64,
    duration: f64,
    /// Start and length, s.
    gaps: Vec<[f64; 2]>,
}

impl Ticks {
    fn new(rate: f64, duration: f64, gaps: &[[f64; 2]]) -> Self {
        let mut ticks = Self { next: 0, rate, duration, gaps: gaps.to_vec() };
        ticks.skip_gaps();
        ticks
    }

    /// Time of the next tick (s), infinite at the end.
    fn time(&self) -> f64 {
        let time = self.next as f64 / self.rate;
        if self.rate > 0.0 && time <= self.duration { time } else { f64::INFINITY }
    }

    /// Number of the next tick; goes on to the one after it.
    fn take(&mut self) -> u64 {
        let number = self.next;
        self.next += 1;
        self.skip_gaps();
        number
    }

    fn skip_gaps(&mut self) {
        let missing =
            |t: f64| self.gaps.iter().any(|[start, length]| t >= *start && t < start + length);
        while self.time().is_finite() && missing(self.time()) {
            self.next += 1;
        }
    }
}

impl Simulation {
    /// Builds the world; takes about a second for a furnished room.
    pub fn new(mut config: SceneConfig) -> Result<Self, SceneError> {
        let body_from_camera = config.validate()?;
        let start = Stamp::from_seconds(config.start_time).ok_or_else(|| SceneError::Value {
            key: "start_time",
            value: config.start_time.to_string(),
            requirement: "must fit into 64-bit nanoseconds",
        })?;
        let seed = |stream: u64| config.seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ stream;
        let motion = if config.trajectory.file.as_os_str().is_empty() {
            Motion::built_in(&config.motion, &body_from_camera, seed(1))
        } else {
            Motion::recorded(&config.motion, &config.trajectory, &body_from_camera)?
        };
        config.duration = duration(&config, &motion)?;
        let path: Vec<Vector3<f64>> = (0..(config.duration * 4.0) as usize + 1)
            .map(|k| motion.state(k as f64 / 4.0).world_from_body.translation.vector)
            .collect();
        config.room.size = room_around(&config.room, &path)?;
        let pictures = pictures(&config.room)?;
        let world = World::furnished(&config.room, &config.people, &path, &pictures, seed(2));
        let camera = config.lens()?;
        let renderer = Renderer::new(
            world,
            camera,
            config.image.clone(),
            config.depth.clone(),
            config.dropout.clone(),
            seed(3),
        );
        let imperfections = Imperfections::draw(config.imperfections.clone(), seed(5));
        let imu = ImuSimulator::imperfect(config.imu.clone(), imperfections.clone(), seed(4));
        let ticks = |rate, gaps| Ticks::new(rate, config.duration, gaps);
        let imu_samples = ticks(config.imu.rate, &config.imu.gaps);
        let truth_poses = ticks(config.truth.rate, &[]);
        let frames = ticks(config.image.rate, &config.image.gaps);
        Ok(Self {
            config,
            motion,
            body_from_camera,
            renderer,
            imu,
            imperfections,
            measured: None,
            start,
            imu_samples,
            truth_poses,
            frames,
        })
    }

    /// Renders what a camera would have seen along a recorded trajectory on which `imu` was measured,
    /// on their clock. Where `trajectory.up` is not given, up is where the IMU's mean force points.
    ///
    /// # Errors
    /// [`SceneError::Imu`] if the IMU does not cover the trajectory, or there is none.
    pub fn with_imu(mut config: SceneConfig, mut imu: MeasuredImu) -> Result<Self, SceneError> {
        if config.trajectory.file.as_os_str().is_empty() {
            return Err(MeasuredImuError::NoTrajectory.into());
        }
        let body_from_camera = config.validate()?;
        if config.trajectory.up == [0.0; 3] {
            let poses = body_poses(&config.trajectory, &body_from_camera)?;
            config.trajectory.up = imu.up(&poses)?.into();
        }
        // As fast as it was recorded, from the first moment on.
        config.motion = MotionConfig { standstill: 0.0, ramp: 0.0, speed: 1.0, ..config.motion };
        let mut simulation = Self::new(config)?;
        simulation.start = simulation.motion.origin().unwrap_or(simulation.start);
        imu.cut(simulation.start, simulation.start.offset_by(simulation.config.duration))?;
        simulation.measured = Some(imu);
        Ok(simulation)
    }

    pub fn config(&self) -> &SceneConfig {
        &self.config
    }

    /// What is wrong with the sensors.
    pub fn imperfections(&self) -> &Imperfections {
        &self.imperfections
    }

    /// Stamp of the first sample.
    pub fn start(&self) -> Stamp {
        self.start
    }

    /// The truth at a stamp.
    pub fn state(&self, stamp: Stamp) -> BodyState {
        self.motion.state(stamp.seconds_since(self.start))
    }

    /// Writes all of it to a log, compressing while the next frames are rendered. `watch` sees
    /// each event first and may end the log early; what was written until then is valid.
    pub fn write(
        self,
        mut log: LogWriter,
        mut watch: impl FnMut(&Event) -> ControlFlow<()>,
    ) -> Result<WriteSummary, WriteError> {
        // Five frames or so may wait for the disk.
        const WAITING: usize = 64;
        log.camera_info(&self.config.camera, self.start)?;
        let (sender, receiver) = sync_channel::<Event>(WAITING);
        std::thread::scope(|scope| {
            let writer = scope.spawn(move || {
                for event in receiver {
                    log.event(&event)?;
                }
                log.finish()
            });
            for event in self {
                // A writer that failed has hung up; its error comes from `join`.
                if watch(&event).is_break() || sender.send(event).is_err() {
                    break;
                }
            }
            drop(sender);
            writer.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
        })
    }

    /// Pose and motion of the camera at a stamp of the IMU's clock.
    fn shot(&self, stamp: Stamp, frame: u64) -> Shot {
        let time = stamp.seconds_since(self.start);
        let state = self.motion.state(time);
        let lever = self.body_from_camera.translation.vector;
        let body = state.world_from_body.rotation;
        let velocity = state.velocity + body * state.angular_velocity.cross(&lever);
        let camera_from_body = self.body_from_camera.rotation.inverse();
        Shot {
            world_from_camera: state.world_from_body * self.body_from_camera,
            velocity: camera_from_body * (body.inverse() * velocity),
            angular_velocity: camera_from_body * state.angular_velocity,
            time,
            light: self.config.light.at(time),
            frame,
        }
    }

    /// Time of the next sample of the IMU (s), infinite after the last.
    fn next_sample(&self) -> f64 {
        match &self.measured {
            Some(measured) => {
                measured.next_stamp().map_or(f64::INFINITY, |stamp| stamp.seconds_since(self.start))
            }
            None => self.imu_samples.time(),
        }
    }

    fn frame(&mut self, stamp: Stamp, number: u64) -> Option<RgbdFrame> {
        let shot = self.shot(stamp, number);
        let (color, depth) = self.renderer.render(&shot)?;
        let stamp = stamp.offset_by(self.camera_clock(number));
        Some(RgbdFrame { stamp, color, depth: self.imperfections.depth(depth), others: Vec::new() })
    }

    /// What a frame's stamp is later than its time on the IMU's clock, s. `time_offset` is added by the
    /// reader to get the IMU's clock, so it is taken off here.
    fn camera_clock(&self, frame: u64) -> f64 {
        self.imperfections.stamp_delay(frame) - self.config.camera.time_offset
    }
}

impl Iterator for Simulation {
    type Item = Event;

    fn next(&mut self) -> Option<Event> {
        let at_camera = self.frames.time() + self.camera_clock(self.frames.next);
        let (imu, truth) = (self.next_sample(), self.truth_poses.time());
        let earliest = imu.min(truth).min(at_camera);
        if !earliest.is_finite() {
            return None;
        }
        if imu == earliest {
            if let Some(measured) = &mut self.measured {
                return measured.take().map(Event::Imu);
            }
            self.imu_samples.take();
            let stamp = self.start.offset_by(imu);
            let state = self.state(stamp);
            return Some(Event::Imu(self.imu.sample(stamp, &state)));
        }
        if truth == earliest {
            self.truth_poses.take();
            let stamp = self.start.offset_by(truth);
            let world_from_body = self.state(stamp).world_from_body;
            return Some(Event::Truth(TruthPose { stamp, world_from_body }));
        }
        let stamp = self.start.offset_by(self.frames.time());
        let number = self.frames.take();
        self.frame(stamp, number).map(|frame| Event::Frame(Box::new(frame)))
    }
}

/// The configured duration, or all of the motion.
fn duration(config: &SceneConfig, motion: &Motion) -> Result<f64, SceneError> {
    const BUILT_IN: f64 = 10.0;
    let available = motion.duration();
    match (config.duration, available) {
        (wanted, Some(available)) if wanted > available => {
            Err(SceneError::TooLong { wanted, available })
        }
        (wanted, _) if wanted > 0.0 => Ok(wanted),
        (_, available) => Ok(available.unwrap_or(BUILT_IN)),
    }
}

/// The image files of a room.
fn pictures(room: &RoomConfig) -> Result<Vec<Picture>, SceneError> {
    let load = |path: &PathBuf| {
        Picture::load(path).map_err(|source| SceneError::Image { path: path.clone(), source })
    };
    room.images.iter().map(load).collect()
}

/// The size of the room, enlarged where the path and the furniture around it need more.
fn room_around(room: &RoomConfig, path: &[Vector3<f64>]) -> Result<[f64; 3], SceneError> {
    const FURNITURE: f64 = 0.6;
    const HEADROOM: f64 = 0.4;
    let reach = |axis: usize| path.iter().map(|p| p[axis].abs()).fold(0.0, f64::max);
    let side = |axis: usize| 2.0 * (reach(axis) + room.clearance + FURNITURE);
    let needed = [side(0), side(1), reach(2) + HEADROOM];
    let size = std::array::from_fn(|k| room.size[k].max(needed[k]));
    let limit = SceneConfig::MAX_ROOM;
    if size.iter().all(|s| *s <= limit) {
        Ok(size)
    } else {
        Err(SceneError::PathTooWide { size, limit })
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix2, Point2, Vector2};

    use super::*;
    use crate::sensor::{CameraModel, ColorImage};
    use crate::vision::DepthConfig;

    /// A quarter-size camera in a small room, without noise.
    fn small_scene() -> SceneConfig {
        let mut scene = SceneConfig { duration: 3.0, ..SceneConfig::default() };
        scene.room = RoomConfig { size: [4.5, 4.5, 2.6], clutter: 6, texel: 0.015, ..scene.room };
        scene.motion.standstill = 0.5;
        scene.image.width = 160;
        scene.image.height = 120;
        scene.image.rate = 10.0;
        scene.image.noise = 0.0;
        scene.image.vignetting = 0.0;
        scene.image.shutter = 0.0;
        scene.camera.fx = 115.0;
        scene.camera.fy = 115.0;
        scene.camera.cx = 79.5;
        scene.camera.cy = 59.5;
        scene.dropout.anywhere = 0.0;
        scene
    }

    fn frames(scene: &SceneConfig) -> Vec<RgbdFrame> {
        let simulation = Simulation::new(scene.clone()).unwrap();
        let frame = |event| match event {
            Event::Frame(frame) => Some(*frame),
            _ => None,
        };
        simulation.filter_map(frame).collect()
    }

    /// Green channel between pixels; `None` outside.
    fn green(image: &ColorImage, pixel: Point2<f64>) -> Option<f64> {
        let (x, y) = (pixel.x.floor(), pixel.y.floor());
        let inside = x >= 0.0
            && y >= 0.0
            && x + 1.0 < image.width() as f64
            && y + 1.0 < image.height() as f64;
        let at = |x: f64, y: f64| {
            f64::from(image.data()[3 * (y as usize * image.width() + x as usize) + 1])
        };
        let (fx, fy) = (pixel.x - x, pixel.y - y);
        inside.then(|| {
            (at(x, y) * (1.0 - fx) + at(x + 1.0, y) * fx) * (1.0 - fy)
                + (at(x, y + 1.0) * (1.0 - fx) + at(x + 1.0, y + 1.0) * fx) * fy
        })
    }

    /// The shift that brings a later image into agreement with what an earlier one shows, by
    /// Gauss-Newton steps; `matches` are pixels of the later image and the earlier one's colors.
    /// `None` where the texture does not determine it or runs out of the image.
    fn residual_shift(later: &ColorImage, matches: &[(Point2<f64>, f64)]) -> Option<Vector2<f64>> {
        let mut shift = Vector2::zeros();
        for _ in 0..6 {
            let (mut normal, mut right) = (Matrix2::zeros(), Vector2::zeros());
            for (pixel, color) in matches {
                let at = |x, y| green(later, pixel + shift + Vector2::new(x, y));
                let gradient =
                    Vector2::new(at(0.5, 0.0)? - at(-0.5, 0.0)?, at(0.0, 0.5)? - at(0.0, -0.5)?);
                normal += gradient * gradient.transpose();
                right += gradient * (color - at(0.0, 0.0)?);
            }
            let contrast = normal.symmetric_eigenvalues().min() / matches.len() as f64;
            if contrast < 30.0 {
                return None;
            }
            shift += normal.cholesky()?.solve(&right);
        }
        Some(shift)
    }

    #[test]
    fn events_are_ordered_and_complete() {
        let mut scene = small_scene();
        scene.duration = 1.0;
        scene.camera.time_offset = 0.02;
        scene.imu.gaps = vec![[0.5, 0.1]];
        let events: Vec<Event> = Simulation::new(scene).unwrap().collect();
        assert!(events.windows(2).all(|pair| pair[0].stamp() <= pair[1].stamp()));
        let count = |pick: fn(&Event) -> bool| events.iter().filter(|e| pick(e)).count();
        assert_eq!(count(|e| matches!(e, Event::Imu(_))), 181);
        assert_eq!(count(|e| matches!(e, Event::Truth(_))), 121);
        assert_eq!(count(|e| matches!(e, Event::Frame(_))), 11);
    }

    /// Pixels carried by depth and true poses to a later frame land where the same texture is,
    /// within half a pixel, at the same depth, within two sigma.
    #[test]
    fn truth_carries_pixels_from_frame_to_frame() {
        carries(&small_scene(), 800);
    }

    /// The same with a view of 180 degrees, whose depth is the range. More of it leaves the image
    /// between two frames, or is further away than depth reaches.
    #[test]
    fn truth_carries_pixels_of_a_fisheye() {
        let mut scene = small_scene();
        scene.camera.model = CameraModel::Equidistant;
        scene.camera.distortion = vec![0.0035, 0.0007, -0.002, 0.0002];
        (scene.camera.fx, scene.camera.fy) = (51.0, 51.0);
        carries(&scene, 600);
    }

    fn carries(scene: &SceneConfig, least_depths: u32) {
        let simulation = Simulation::new(scene.clone()).unwrap();
        let frames = frames(scene);
        let (first, later) = (&frames[20], &frames[23]);
        let mount = scene.camera.imu_from_camera().unwrap();
        let pose = |frame: &RgbdFrame| simulation.state(frame.stamp).world_from_body * mount;
        let later_from_first = pose(later).inv_mul(&pose(first));
        assert!(later_from_first.translation.vector.norm() > 0.03);
        let camera = scene.lens().unwrap();
        let law: &DepthConfig = &scene.depth;
        let carry = |pixel: Point2<f64>| {
            let depth = law.read(&first.depth, pixel)?.depth;
            let point = later_from_first * nalgebra::Point3::from(camera.unproject(pixel, depth)?);
            Some((camera.project(&point.coords)?, camera.depth_of(&point.coords)))
        };
        let (mut depths, mut deep) = (0, 0);
        let mut shifts = Vec::new();
        for (row, column) in
            (6..114).step_by(3).flat_map(|r| (6..154).step_by(3).map(move |c| (r, c)))
        {
            let pixel = Point2::new(f64::from(column), f64::from(row));
            let Some((landed, depth)) = carry(pixel) else { continue };
            let Some(found) = law.read(&later.depth, landed) else { continue };
            // The readings' noise, and the change of depth within half a pixel.
            let limit = 2.0 * law.standard_deviation(depth) + 0.5 * found.slope.norm();
            depths += 1;
            if (found.depth - depth).abs() > limit {
                continue;
            }
            deep += 1;
            let patch: Option<Vec<_>> = (-2..=2)
                .flat_map(|y| (-2..=2).map(move |x| Vector2::new(f64::from(x), f64::from(y))))
                .map(|offset| {
                    Some((carry(pixel + offset)?.0, green(&first.color, pixel + offset)?))
                })
                .collect();
            shifts.extend(patch.and_then(|patch| residual_shift(&later.color, &patch)));
        }
        assert!(depths > least_depths, "{depths}");
        // What is hidden in one of the frames may disagree.
        assert!(f64::from(deep) > 0.97 * f64::from(depths), "{deep} of {depths}");
        let mut lengths: Vec<f64> = shifts.iter().map(Vector2::norm).collect();
        lengths.sort_by(f64::total_cmp);
        assert!(lengths.len() > 150, "{}", lengths.len());
        let part = |percent: usize| lengths[lengths.len() * percent / 100];
        assert!(part(50) < 0.1 && part(95) < 0.5, "{} {}", part(50), part(95));
        let mean = shifts.iter().sum::<Vector2<f64>>() / shifts.len() as f64;
        assert!(mean.norm() < 0.05, "{mean}");
    }

    #[test]
    fn a_log_may_end_early_and_is_valid() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log.mcap");
        let simulation = Simulation::new(small_scene()).unwrap();
        let log = LogWriter::create(&path, simulation.config().log.clone()).unwrap();
        let until = simulation.start().offset_by(0.3);
        let watch = |event: &Event| {
            if event.stamp() < until { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
        };
        let summary = simulation.write(log, watch).unwrap();
        assert_eq!((summary.frames, summary.imu_samples, summary.truth_poses), (3, 60, 36));
        let bytes = std::fs::read(&path).unwrap();
        let statistics = mcap::Summary::read(&bytes).unwrap().unwrap().stats.unwrap();
        // The static transform, three messages a frame, one a reading, two a true pose.
        assert_eq!(statistics.message_count, 1 + 9 + 60 + 72);
    }

    #[test]
    fn the_seed_decides_everything() {
        let mut scene = small_scene();
        scene.duration = 0.2;
        let run = |scene: &SceneConfig| -> Vec<Event> {
            Simulation::new(scene.clone()).unwrap().collect()
        };
        let first = run(&scene);
        assert_eq!(first, run(&scene));
        scene.seed += 1;
        assert_ne!(first, run(&scene));
    }

    #[test]
    fn rooms_grow_around_the_path() {
        let room = RoomConfig { size: [3.0, 3.0, 2.0], clearance: 0.5, ..RoomConfig::default() };
        let path = [Vector3::new(-4.0, 0.0, 1.0), Vector3::new(2.0, 0.5, 1.9)];
        let size = room_around(&room, &path).unwrap();
        assert!((size[0] - 10.2).abs() < 1e-9 && (size[1] - 3.2).abs() < 1e-9, "{size:?}");
        assert!((size[2] - 2.3).abs() < 1e-9);
        assert!(room_around(&room, &[Vector3::new(80.0, 0.0, 1.0)]).is_err());
    }
}
