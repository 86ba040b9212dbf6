//! All monitors together: evidence in, faults out.

use nalgebra::{UnitQuaternion, Vector3};

use super::{
    AttitudeTrack, BiasEvidence, Biases, ClockJumps, Darkening, Decision, Divergence, Envelope,
    Episode, Fault, FaultConfig, FaultRecord, Finding, ForceEvidence, GyroscopeTrack, Intervals,
    Jittering, Losses, Monitor, NoiseBurst, Obstruction, PoseStep, Reading, Region, Repeats,
    SceneMotion, Sighting, Silence, Stream, TrackEvidence, TurnContradiction, Units, Verdict,
    ViewEvidence,
};
use crate::inertial::{ImuConfig, NavState};
use crate::sensor::{ImuSample, Stamp};

/// What is to be believed now.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Trust {
    /// IMU samples are worth no more than what bridges a gap.
    pub distrust_imu: bool,
    /// The turn that images show takes the place of the gyroscope's readings.
    pub replace_gyro: bool,
}

/// A stream's monitors.
#[derive(Debug, Clone)]
struct StreamMonitors {
    intervals: Intervals,
    losses: Losses,
    jitter: Jittering,
    repeats: Repeats,
    silence: Silence,
}

impl StreamMonitors {
    fn new(config: &FaultConfig, stream: Stream, longest: f64) -> Self {
        Self {
            intervals: Intervals::default(),
            losses: Losses::new(config),
            jitter: Jittering::new(config),
            repeats: Repeats::new(config),
            silence: Silence::new(stream, longest),
        }
    }
}

/// All monitors, what they suspect, and the record of faults.
///
/// The pipeline hands over evidence as it comes by, calls [`Self::decide`] once a frame, and does what that
/// and [`Self::trust`] say.
#[derive(Debug, Clone)]
pub struct Monitors {
    config: FaultConfig,
    imu_config: ImuConfig,
    imu: StreamMonitors,
    frames: StreamMonitors,
    gyroscope_noise: NoiseBurst,
    accelerometer_noise: NoiseBurst,
    units: Units,
    max_rate: f64,
    gyroscope: GyroscopeTrack,
    attitude: AttitudeTrack,
    turns: TurnContradiction,
    clock: ClockJumps,
    darkening: Darkening,
    obstruction: Obstruction,
    scene: SceneMotion,
    envelope: Envelope,
    gyro_bias: Biases,
    accel_bias: Biases,
    /// Since the last decision.
    verdicts: Vec<Verdict>,
    distrusted_until: Option<Stamp>,
    record: FaultRecord,
}

impl Monitors {
    /// Longer intervals are silence, whatever the stream, s.
    const LONGEST_INTERVAL: f64 = 0.5;
    /// The IMU is distrusted for so long after what spoke against it, s: as long as a burst or a step
    /// may go unnoticed again.
    const DISTRUST: f64 = 0.15;
    /// And after images have contradicted it.
    const CONTRADICTED: f64 = 0.3;
    /// Turns over more usual intervals than this are not compared: if a clock has jumped, they
    /// took less time.
    const REGULAR: f64 = 1.5;
    /// A bias that is unusual for so long is what it is, s: that of the gyroscope, which turns
    /// everything while it is being found, is then known.
    const LASTING: f64 = 0.5;
    /// Jitter that does no harm, s.
    const LEAST_JITTER: f64 = 1e-3;

    pub fn new(config: &FaultConfig, imu: &ImuConfig) -> Self {
        Self {
            config: config.clone(),
            imu_config: imu.clone(),
            imu: StreamMonitors::new(config, Stream::Imu, imu.max_gap),
            frames: StreamMonitors::new(config, Stream::Frames, config.stall_time),
            gyroscope_noise: NoiseBurst::new(config),
            accelerometer_noise: NoiseBurst::new(config),
            units: Units::new(config, imu.gravity),
            max_rate: config.max_rate,
            gyroscope: GyroscopeTrack::default(),
            attitude: AttitudeTrack::default(),
            turns: TurnContradiction::new(config, imu),
            clock: ClockJumps::new(config),
            darkening: Darkening::new(config),
            obstruction: Obstruction::new(config),
            scene: SceneMotion::new(config),
            envelope: Envelope::new(config),
            gyro_bias: Biases::new(config),
            accel_bias: Biases::new(config),
            verdicts: Vec::new(),
            distrusted_until: None,
            record: FaultRecord::new(config),
        }
    }

    /// What comes now is by other clocks: nothing that was usual counts any more.
    pub fn begin_anew(&mut self) {
        let fresh = Self::new(&self.config, &self.imu_config);
        self.record.close();
        *self = Self { record: self.record.clone(), ..fresh };
    }

    /// Keeps what a monitor says until the next decision: of one fault the strongest.
    fn hear(&mut self, verdict: Verdict) {
        let Some(finding) = verdict.finding() else { return };
        let same =
            |v: &&mut Verdict| v.finding().is_some_and(|f| f.fault.is_kind_of(&finding.fault));
        match self.verdicts.iter_mut().find(same) {
            Some(known) if known.finding().map(|f| f.statistic) >= Some(finding.statistic) => {}
            Some(known) => *known = verdict,
            None => self.verdicts.push(verdict),
        }
    }

    fn distrust(&mut self, until: Stamp) {
        self.distrusted_until = self.distrusted_until.max(Some(until));
    }

    /// A sample of the IMU, in order of time.
    pub fn imu(&mut self, sample: &ImuSample) {
        let at = sample.stamp;
        let silence = self.imu.silence.observe(at, &());
        if silence.confirmed().is_some() {
            self.gyroscope_noise.interrupt();
            self.accelerometer_noise.interrupt();
        }
        self.hear(silence);
        let repeats = self.imu.repeats.observe(at, &false);
        self.hear(repeats);
        if let Some(interval) = self.imu.intervals.next(at, Self::LONGEST_INTERVAL) {
            let losses = self.imu.losses.observe(at, &interval);
            let jitter = self.imu.jitter.observe(at, &interval);
            self.hear(losses);
            self.hear(jitter);
            self.clock.imu_interval(at, &interval);
        }
        self.gyroscope.push(*sample);
        if let Some(interval) = self.imu.intervals.usual() {
            self.readings(sample, interval);
        }
    }

    fn readings(&mut self, sample: &ImuSample, interval: f64) {
        let at = sample.stamp;
        let reading = |value, density: f64| Reading {
            value,
            interval,
            configured_sd: density / interval.sqrt(),
        };
        let rate = reading(sample.angular_velocity, self.imu_config.gyro_noise);
        let force = reading(sample.specific_force, self.imu_config.accel_noise);
        let force_evidence = ForceEvidence { specific_force: sample.specific_force, interval };
        let verdicts = [
            self.gyroscope_noise.observe(at, &rate),
            self.accelerometer_noise.observe(at, &force),
            self.units.observe(at, &force_evidence),
        ];
        let impossible = sample.angular_velocity.norm() > self.max_rate;
        if impossible || verdicts.iter().any(|verdict| verdict.finding().is_some()) {
            self.distrust(at.offset_by(Self::DISTRUST));
        }
        verdicts.into_iter().for_each(|verdict| self.hear(verdict));
    }

    /// A message that was there before, and is left out.
    pub fn repeated(&mut self, stream: Stream, at: Stamp) {
        let stream = match stream {
            Stream::Imu => &mut self.imu,
            Stream::Frames => &mut self.frames,
        };
        let verdict = stream.repeats.observe(at, &true);
        self.hear(verdict);
    }

    /// A frame, timed by the IMU's clock, in order of time.
    pub fn frame(&mut self, at: Stamp, features: usize) {
        let silence = self.frames.silence.observe(at, &());
        let repeats = self.frames.repeats.observe(at, &false);
        self.hear(silence);
        self.hear(repeats);
        if let Some(interval) = self.frames.intervals.next(at, Self::LONGEST_INTERVAL) {
            let losses = self.frames.losses.observe(at, &interval);
            let jitter = self.frames.jitter.observe(at, &interval);
            self.hear(losses);
            self.hear(jitter);
            self.clock.frame_interval(at, &interval);
        }
        let view = ViewEvidence { features, interval: self.frame_interval() };
        let verdict = self.darkening.observe(at, &view);
        self.hear(verdict);
    }

    /// The usual one, s; a common one until it is known.
    fn frame_interval(&self) -> f64 {
        self.frames.intervals.usual().unwrap_or(1.0 / 30.0)
    }

    /// What became of the points that were expected in each part of an image.
    pub fn regions(&mut self, at: Stamp, parts: Vec<Region>) {
        let interval = self.frame_interval();
        let verdict = self.obstruction.observe(at, &(parts, interval));
        self.hear(verdict);
    }

    /// What the tracks of an image agree on.
    pub fn tracks(&mut self, at: Stamp, matches: usize, inliers: usize, second: usize) {
        let interval = self.frame_interval();
        // The map may have been made while the IMU was wrong, and contradict itself.
        if self.gyroscope.newest().is_some() && !self.turns.knows_scale() {
            return;
        }
        let tracks = TrackEvidence { matches, inliers, second, interval };
        let verdict = self.scene.observe(at, &tracks);
        self.hear(verdict);
    }

    /// The attitude of the body that an image shows, if any, and the gyroscope's bias as estimated. Gives
    /// by how much frames are to be timed later from now on, if a clock has jumped, s.
    pub fn attitude(
        &mut self,
        at: Stamp,
        world_from_body: Option<UnitQuaternion<f64>>,
        gyro_bias: &Vector3<f64>,
    ) -> Option<f64> {
        let gyro_bias = self.turns.bias(gyro_bias);
        let regular = Self::REGULAR * self.frame_interval();
        if let Some(attitude) = world_from_body
            && let Some(turn) = self.attitude.turn(at, attitude, &self.gyroscope, &gyro_bias)
            && turn.seconds < regular
        {
            let verdict = self.turns.observe(at, &turn);
            self.hear(verdict);
            if verdict.finding().is_some() {
                self.distrust(at.offset_by(Self::DISTRUST));
            }
        }
        if let Some(offset) = self.turns.take_offset().filter(|_| !self.clock.is_in_doubt()) {
            self.clock.suspect(offset, at);
        }
        let sighting = Sighting {
            world_from_body,
            gyroscope: &self.gyroscope,
            gyro_bias,
            variance: self.turns.variance(),
        };
        let verdict = self.clock.observe(at, &sighting);
        self.hear(verdict);
        let Fault::ClockJump { offset } = verdict.confirmed()?.fault else { return None };
        self.frames.intervals = Intervals::default();
        self.attitude.interrupt();
        self.turns.interrupt();
        Some(offset)
    }

    /// Whether a body gets by itself to a pose that the map is seen from.
    pub fn is_reachable(&self, step: &PoseStep, at: Stamp) -> bool {
        self.envelope.excess(step, at) <= 1.0
    }

    /// The map is seen from where no body gets by itself.
    pub fn carried_off(&mut self, at: Stamp) {
        let finding = Finding { fault: Fault::Kidnapped, since: at, statistic: 1.0 };
        self.hear(Verdict::Confirmed(finding));
        self.attitude.interrupt();
        self.turns.interrupt();
    }

    /// Angular velocity of the body by the last images, rad/s.
    pub fn seen_rate(&self) -> Vector3<f64> {
        self.attitude.rate()
    }

    /// The world has been turned: attitudes before are others in it.
    pub fn turn_world(&mut self, turn: &UnitQuaternion<f64>) {
        self.attitude.turn_world(turn);
    }

    /// Images contradict what the IMU predicted.
    pub fn contradicted(&mut self, at: Stamp) {
        self.distrust(at.offset_by(Self::CONTRADICTED));
    }

    /// The state after an image.
    pub fn biases(&mut self, at: Stamp, state: &NavState) {
        let ImuConfig { gyro_bias_sd, accel_bias_sd, .. } = self.imu_config;
        let gyro = BiasEvidence { bias: state.gyro_bias, prior_sd: gyro_bias_sd };
        let accel = BiasEvidence { bias: state.accel_bias, prior_sd: accel_bias_sd };
        let verdicts = [self.gyro_bias.observe(at, &gyro), self.accel_bias.observe(at, &accel)];
        // At rest the bias of a gyroscope in other units is large, too.
        let told = self.turns.knows_scale();
        verdicts.into_iter().filter(|_| told).for_each(|verdict| self.hear(verdict));
    }

    /// Whether the accelerometer's bias has been none of the sensor's for long enough for all else to
    /// have settled.
    pub fn accel_bias_lasts(&self, at: Stamp) -> bool {
        self.accel_bias.since().is_some_and(|since| at.seconds_since(since) > Self::LASTING)
    }

    /// The estimate is of no use any more.
    pub fn diverged(&mut self, at: Stamp, by: Divergence) {
        let finding = Finding { fault: Fault::Divergence { by }, since: at, statistic: 1.0 };
        self.hear(Verdict::Confirmed(finding));
    }

    /// The estimate has been started anew, or the map been turned: what was compared with it is void.
    pub fn restarted(&mut self) {
        self.attitude.interrupt();
        self.turns.interrupt();
    }

    /// Names the fault that explains what was heard since the last decision, if it is a new one.
    pub fn decide(&mut self, at: Stamp) -> Option<Decision> {
        let silent = [self.imu.silence.at(at), self.frames.silence.at(at)];
        silent.into_iter().for_each(|verdict| self.hear(verdict));
        let verdicts = std::mem::take(&mut self.verdicts);
        self.record.observe(at, &verdicts)
    }

    pub fn trust(&self, at: Stamp) -> Trust {
        let recent = self.distrusted_until.is_some_and(|until| until > at);
        Trust {
            distrust_imu: recent || self.clock.is_in_doubt(),
            replace_gyro: self.turns.has_wrong_scale(),
        }
    }

    /// Standard deviation of the time between frame and IMU, s; 0 if it is that of any log.
    pub fn stamp_jitter(&self) -> f64 {
        let jitter = self.imu.jitter.sd().hypot(self.frames.jitter.sd());
        if jitter > Self::LEAST_JITTER { jitter } else { 0.0 }
    }

    /// What the jumps of clocks so far add to the time of a frame on the IMU's clock, s.
    pub fn clock_offset(&self) -> f64 {
        self.clock.offset()
    }

    /// The last samples of the IMU, for a frame that is timed anew.
    pub fn samples(&self) -> impl Iterator<Item = &ImuSample> {
        self.gyroscope.samples()
    }

    /// Faults so far, for `faults.json`.
    pub fn episodes(&self) -> Vec<Episode> {
        self.record.episodes()
    }
}
