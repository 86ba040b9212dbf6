//! Turns of the body: those that images see against those that the gyroscope feels.

use nalgebra::Vector3;

use super::causes::{Cause, Contradiction, Explained};
use super::sequential::{Cusum, Decided, Sprt, cusum_threshold};
use super::{Fault, FaultConfig, Finding, Monitor, SUSPICIOUS, Verdict};
use crate::inertial::ImuConfig;
use crate::sensor::Stamp;

/// From one image to the next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Turn {
    /// s.
    pub seconds: f64,
    /// Rotation vector of the body by the images, in body coordinates, rad.
    pub seen: Vector3<f64>,
    /// The same by the gyroscope, its bias as known taken off, rad.
    pub felt: Vector3<f64>,
    /// Change of the gyroscope's readings from the first image to the second, rad/s.
    pub rate_change: Vector3<f64>,
}

impl Turn {
    pub(super) fn residual(&self) -> Vector3<f64> {
        self.seen - self.felt
    }
}

/// Tells what is wrong when gyroscope and images contradict each other.
///
/// **Detection.** The residual is `r ~ N(0, v I)` while all is sound, with a variance `v` that is learned;
/// its size adds to a [`Cusum`] with t-distributed densities of variance `v` and [`Self::RAISED`] `v`. A mean
/// that has shifted is seen in `|sum r|^2 / n v` of the last `n` frames, the largest of all `n` up to
/// [`Self::TRAILING`] (the likelihood ratio for a shift of unknown size and time).
///
/// **Isolation.** From then on the residuals are explained by each [`Cause`], by least squares;
/// one that beats all others by odds of `1 / miss_probability` is named. Without any for
/// [`Self::LONGEST`] seconds, none is.
///
/// The bias is the monitor's own: what the filter's does meanwhile depends on what it trusts.
#[derive(Debug, Clone)]
pub struct TurnContradiction {
    config: FaultConfig,
    /// White noise of the gyroscope, rad/s/sqrt(Hz).
    gyro_noise: f64,
    /// Of a component of the residual, rad^2, and the turns that it was learned from.
    variance: f64,
    count: f64,
    bias: Option<Vector3<f64>>,
    sum: Cusum,
    /// Before a contradiction begins: the last turns.
    window: Contradiction,
    since: Option<Stamp>,
    open: bool,
    /// Factor on the readings, and the test that ends it.
    wrong_scale: Option<(f64, Sprt)>,
    /// Sum of the squares of the turns that gyroscope and images agreed on, rad^2.
    agreed: f64,
    offset: Option<f64>,
}

impl TurnContradiction {
    /// Deviation of a component of a turn between images, before it is known, rad.
    const USUAL_SD: f64 = 2e-3;
    /// Turns from which it is learned, and those that the first guess is worth.
    const MEMORY: f64 = 300.0;
    const PRIOR: f64 = 20.0;
    /// Share of a turn that calibration, rolling shutter and clocks leave open.
    const SHARE: f64 = 0.03;
    /// Variance with a fault, as a multiple of the usual; degrees of freedom of both densities.
    const RAISED: f64 = 9.0;
    const DOF: f64 = 4.0;
    /// Frames in which a shift is looked for.
    const TRAILING: usize = 8;
    /// Frames from which a cause is looked for, and time after which none is, s.
    const SHORTEST: usize = 4;
    const LONGEST: f64 = 0.5;
    /// The scale is known when the turns that both agree on, squared, add up to so many times the variance
    /// of one (a deviation of the scale of 10 %): at rest a bias in other units is only a large bias.
    const KNOWN: f64 = 100.0;
    /// Time over which the bias is followed, s.
    const BIAS_TIME: f64 = 5.0;

    pub fn new(config: &FaultConfig, imu: &ImuConfig) -> Self {
        Self {
            config: config.clone(),
            gyro_noise: imu.gyro_noise,
            variance: Self::USUAL_SD.powi(2),
            count: Self::PRIOR,
            bias: None,
            sum: Cusum::default(),
            window: Contradiction { turns: Vec::new(), gyro_bias_sd: imu.gyro_bias_sd.max(1e-4) },
            since: None,
            open: false,
            wrong_scale: None,
            agreed: 0.0,
            offset: None,
        }
    }

    /// The gyroscope's bias, rad/s, taken for `filtered` before any turn was seen.
    pub fn bias(&mut self, filtered: &Vector3<f64>) -> Vector3<f64> {
        *self.bias.get_or_insert(*filtered)
    }

    /// Variance of a component of a turn between two images, rad^2.
    pub fn variance(&self) -> f64 {
        self.variance
    }

    /// Whether the body has turned enough to know that the gyroscope reads turns.
    pub fn knows_scale(&self) -> bool {
        self.agreed > Self::KNOWN * self.variance
    }

    pub fn has_wrong_scale(&self) -> bool {
        self.wrong_scale.is_some()
    }

    /// Stamps seem to be off by so much, s: once.
    pub fn take_offset(&mut self) -> Option<f64> {
        self.offset.take()
    }

    /// What was seen so far does not count: a clock was set, or the map was turned.
    pub fn interrupt(&mut self) {
        self.close();
    }

    fn close(&mut self) {
        self.window.turns.clear();
        self.since = None;
        self.open = false;
        self.sum.reset();
    }

    fn variance_of(&self, turn: &Turn) -> f64 {
        let share = Self::SHARE * turn.seen.norm().min(turn.felt.norm());
        self.variance + share * share + self.gyro_noise.powi(2) * turn.seconds
    }

    fn learn(&mut self, turn: &Turn) {
        let square = turn.residual().norm_squared() / 3.0;
        // Noise of the two is independent.
        self.agreed += turn.seen.dot(&turn.felt);
        self.count = (self.count + 1.0).min(Self::MEMORY);
        self.variance += (square.min(9.0 * self.variance) - self.variance) / self.count;
        self.variance = self.variance.max((0.05 * Self::USUAL_SD).powi(2));
        if let Some(bias) = &mut self.bias {
            *bias -= turn.residual() / Self::BIAS_TIME;
        }
    }

    /// `ln` of the ratio of t densities of three components for the fault and without.
    fn log_ratio(square: f64) -> f64 {
        let term = |square: f64| -0.5 * (Self::DOF + 3.0) * (square / Self::DOF).ln_1p();
        term(square / Self::RAISED) - term(square) - 1.5 * Self::RAISED.ln()
    }

    /// While the scale is wrong: whether it is right again.
    fn rescaled(&mut self, turn: &Turn) {
        let variance = self.variance_of(turn);
        let Some((scale, test)) = &mut self.wrong_scale else { return };
        let misfit = |scale: f64| {
            let variance = variance * scale.max(1.0).powi(2);
            ((turn.felt - scale * turn.seen).norm_squared() / variance).min(Contradiction::MOST)
        };
        if test.add(0.5 * (misfit(1.0) - misfit(*scale)).clamp(-3.0, 3.0)) == Some(Decided::Sound) {
            self.wrong_scale = None;
        } else if test.statistic() > 1.0 {
            *test = Sprt::new(self.config.miss_probability, self.config.miss_probability);
        }
    }

    fn finding(&self, fault: Fault, at: Stamp) -> Finding {
        Finding { fault, since: self.since.unwrap_or(at), statistic: 1.0 }
    }

    /// Odds, as twice a logarithm, that leave a wrong decision with `miss_probability`.
    fn odds(&self) -> f64 {
        -2.0 * self.config.miss_probability.ln()
    }

    /// What is not excluded yet, the worst first: a wrong scale makes all else look wrong.
    fn suspicion(&self, explained: &[Explained], at: Stamp) -> Verdict {
        let best = explained.first().map_or(0.0, |(_, cost)| *cost);
        let open = |is: fn(&Cause) -> bool| {
            explained.iter().any(|(cause, cost)| is(cause) && *cost < best + self.odds())
        };
        let fault = if open(|cause| matches!(cause, Cause::Scale(_))) {
            Fault::GyroScale
        } else if open(|cause| matches!(cause, Cause::Clock(_))) {
            Fault::ClockJump { offset: 0.0 }
        } else {
            return Verdict::Nominal;
        };
        Verdict::Suspected(Finding { statistic: 0.5, ..self.finding(fault, at) })
    }

    /// Names the cause if it is clear, and acts on it: it beats all others by the odds that a wrong
    /// decision leaves, and `Nothing` by those that false alarms leave.
    fn decide(&mut self, at: Stamp, threshold: f64) -> Verdict {
        let explained = self.window.explain();
        let [(cause, cost), (_, other), ..] = explained;
        let turned: f64 = self.window.turns.iter().map(|(turn, _)| turn.seen.norm_squared()).sum();
        let harmless = matches!(cause, Cause::Nothing | Cause::WrongAttitude);
        let told = match cause {
            Cause::Bias(_) => self.knows_scale() || turned > Self::KNOWN * self.variance,
            _ => true,
        };
        let nothing = self.window.cost(0, |_, turn| turn.residual());
        let likely = harmless || told && nothing - cost >= 2.0 * threshold;
        let enough = self.window.turns.len() >= Self::SHORTEST;
        let clear = enough && other - cost >= self.odds() && likely;
        let late =
            self.window.turns.iter().map(|(turn, _)| turn.seconds).sum::<f64>() >= Self::LONGEST;
        if !clear && !late {
            return self.suspicion(&explained, at);
        }
        let fault = match cause {
            Cause::Clock(offset) => {
                self.offset = Some(offset);
                None
            }
            Cause::Impulse => Some(Fault::Kidnapped),
            Cause::Bias(change) => {
                if let Some(bias) = self.bias.as_mut().filter(|_| clear) {
                    *bias += change;
                }
                Some(Fault::BiasStep)
            }
            Cause::Scale(scale) => {
                let miss = self.config.miss_probability;
                self.wrong_scale = clear.then(|| (scale, Sprt::new(miss, miss)));
                Some(Fault::GyroScale)
            }
            Cause::Nothing | Cause::WrongAttitude | Cause::Anything => None,
        };
        let finding = fault.filter(|_| clear).map(|fault| self.finding(fault, at));
        self.close();
        finding.map_or(Verdict::Nominal, Verdict::Confirmed)
    }
}

impl Monitor for TurnContradiction {
    type Evidence = Turn;

    fn observe(&mut self, at: Stamp, turn: &Turn) -> Verdict {
        if self.wrong_scale.is_some() {
            self.rescaled(turn);
            return match self.wrong_scale {
                Some(_) => Verdict::Confirmed(self.finding(Fault::GyroScale, at)),
                None => Verdict::Nominal,
            };
        }
        let variance = self.variance_of(turn);
        let square = turn.residual().norm_squared() / variance;
        let threshold = cusum_threshold(self.config.false_alarms_per_hour, turn.seconds);
        let statistic = self.sum.add(at, Self::log_ratio(square), threshold);
        self.window.turns.push((*turn, variance));
        if !self.open {
            let excess = self.window.turns.len().saturating_sub(Self::TRAILING);
            self.window.turns.drain(..excess);
            self.open_if_contradicted(at, statistic);
        }
        if self.open {
            return self.decide(at, threshold);
        }
        if self.sum.is_zero() {
            self.learn(turn);
        }
        Verdict::Nominal
    }
}

impl TurnContradiction {
    /// Opens the window at the frame from which on the residuals contradict, if they do.
    fn open_if_contradicted(&mut self, at: Stamp, statistic: f64) {
        let (mut sum, mut seconds) = (Vector3::zeros(), 0.0);
        let (mut largest, mut first) = (0.0, (0, at));
        for (k, (turn, variance)) in self.window.turns.iter().enumerate().rev() {
            sum += turn.residual() / variance.sqrt();
            let shift = sum.norm_squared() / (self.window.turns.len() - k) as f64;
            if shift > largest {
                (largest, first) = (shift, (k, at.offset_by(-seconds)));
            }
            seconds += turn.seconds;
        }
        if largest > Contradiction::SURPRISING || statistic >= SUSPICIOUS {
            self.open = true;
            self.since = Some(first.1);
            self.window.turns.drain(..first.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    const STEP: f64 = 1.0 / 30.0;

    fn rate(t: f64) -> Vector3<f64> {
        Vector3::new((2.0 * t).sin(), 0.7 * (3.0 * t + 1.0).cos(), 0.4 * (1.3 * t).sin())
    }

    fn integral(from: f64, to: f64) -> Vector3<f64> {
        let h = (to - from) / 20.0;
        (0..20).map(|k| rate(from + (f64::from(k) + 0.5) * h) * h).sum()
    }

    /// Faults confirmed, with their times, in 20 s of turns, of which `change` makes others.
    fn told(seed: u64, change: impl Fn(f64, &mut Turn)) -> Vec<(f64, Fault)> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let imu = ImuConfig::default();
        let mut monitor = TurnContradiction::new(&FaultConfig::default(), &imu);
        let bias = Vector3::new(0.003, -0.002, 0.001);
        monitor.bias(&Vector3::zeros());
        let mut told = Vec::new();
        let mut before = Vector3::zeros();
        for k in 1..600 {
            let (from, to) = (f64::from(k - 1) * STEP, f64::from(k) * STEP);
            let mut noise = || {
                Vector3::from_fn(|_, _| {
                    let normal: f64 = StandardNormal.sample(&mut rng);
                    4e-4 * normal
                })
            };
            let (last, now) = (before, noise());
            before = now;
            let turn = integral(from, to);
            let known = monitor.bias(&Vector3::zeros());
            let mut evidence = Turn {
                seconds: STEP,
                seen: turn + now - last,
                felt: turn + (bias - known) * STEP,
                rate_change: rate(to) - rate(from),
            };
            change(to, &mut evidence);
            let verdict = monitor.observe(Stamp::default().offset_by(to), &evidence);
            if let Some(finding) = verdict.confirmed()
                && told.last().is_none_or(|(_, fault): &(f64, Fault)| *fault != finding.fault)
            {
                told.push((to, finding.fault));
            }
        }
        told
    }

    fn only(told: &[(f64, Fault)], fault: Fault, within: std::ops::Range<f64>) {
        let [(time, found)] = told else { panic!("{fault}: {told:?}") };
        assert!(*found == fault && within.contains(time), "{fault}: {told:?}");
    }

    #[test]
    fn each_cause_is_told_as_what_it_is() {
        for seed in 0..8 {
            assert_eq!(told(seed, |_, _| {}), []);
            // From 8 s on.
            let step = Vector3::new(0.1, 0.1, 0.1) * STEP;
            only(
                &told(seed, |t, turn| {
                    if t > 8.0 {
                        turn.felt += step
                    }
                }),
                Fault::BiasStep,
                8.0..8.4,
            );
            for scale in [57.3, 3.0, 1.0 / 57.3, 0.3] {
                let scaled = told(seed, |t, turn| {
                    if t > 8.0 {
                        turn.felt *= scale
                    }
                });
                only(&scaled, Fault::GyroScale, 8.0..8.5);
                only(&told(seed, |_, turn| turn.felt *= scale), Fault::GyroScale, 0.0..1.5);
            }
            // Once.
            let turned = Vector3::new(0.1, -0.2, 0.1);
            let once = |t: f64| (8.0..8.0 + STEP).contains(&t);
            only(
                &told(seed, |t, turn| {
                    if once(t) {
                        turn.seen += turned
                    }
                }),
                Fault::Kidnapped,
                8.0..8.4,
            );
        }
    }

    #[test]
    fn a_wrong_attitude_and_a_clock_are_neither() {
        for seed in 0..8 {
            let error = Vector3::new(0.1, -0.2, 0.1);
            let wrong = told(seed, |t, turn| {
                if (8.0..8.0 + STEP).contains(&t) {
                    turn.seen += error;
                } else if (8.0..8.0 + 2.0 * STEP).contains(&t) {
                    turn.seen -= error;
                }
            });
            assert_eq!(wrong, []);
            let late = told(seed, |t, turn| {
                if t > 8.0 {
                    turn.felt = integral(t - STEP - 0.05, t - 0.05);
                    turn.rate_change = rate(t - 0.05) - rate(t - STEP - 0.05);
                }
            });
            assert_eq!(late, [], "{late:?}");
        }
    }

    #[test]
    fn a_gyroscope_that_is_right_again_is_trusted_again() {
        let imu = ImuConfig::default();
        let mut monitor = TurnContradiction::new(&FaultConfig::default(), &imu);
        monitor.bias(&Vector3::zeros());
        let mut wrong = Vec::new();
        for k in 1..600 {
            let (from, to) = (f64::from(k - 1) * STEP, f64::from(k) * STEP);
            let scale = if (5.0..10.0).contains(&to) { 57.3 } else { 1.0 };
            let (seen, rate_change) = (integral(from, to), rate(to) - rate(from));
            let turn = Turn { seconds: STEP, seen, felt: seen * scale, rate_change };
            monitor.observe(Stamp::default().offset_by(to), &turn);
            wrong.push(monitor.has_wrong_scale());
        }
        assert!(!wrong[140] && wrong[180] && wrong[290] && !wrong[330], "{wrong:?}");
    }
}
