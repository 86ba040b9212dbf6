//! Rivals that start from many headings: a bank of extended Kalman filters and a particle filter.
//!
//! Both are ensembles of `mekf`, weighted by the evidence of their innovations. The bank has one
//! filter for each window of headings. The particle filter is Rao-Blackwellised: heading and bias
//! about the vertical are particles with a Gaussian kernel (Kotecha and Djuric 2003), all else is
//! Gaussian given them; it resamples where the weights degenerate, and is handed over to one filter
//! once the heading is known.

use nalgebra::{Matrix2, Rotation3, SMatrix, UnitQuaternion, Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use crate::filter::gnss::{
    GnssFilter, InitialBelief, Innovation, MekfGnss, combined_belief, combined_innovation,
};
use crate::filter::{BayesFilter, Estimate, FilterError, InertialStep, PositionMeasurement};
use crate::inertial::{Belief, ImuConfig, NavState, block};

/// Filters of the bank.
const BANK: usize = 24;
/// Particles.
const PARTICLES: usize = 400;
/// Standard deviation of a kernel about its particle, as a share of that of all particles: the
/// normal reference rule in two dimensions, `PARTICLES^(-1/6)`.
const KERNEL: f64 = 0.368;
/// Standard deviation of a kernel of the uniform heading, rad.
const HEADING_KERNEL: f64 = 5.0 * DEGREE;
/// One filter goes on below this standard deviation of the heading, rad.
const SINGLE_SD: f64 = 3.0 * DEGREE;
/// A member of a smaller weight is dropped.
const LEAST_WEIGHT: f64 = 1e-9;
const DEGREE: f64 = std::f64::consts::PI / 180.0;

/// Weighted filters.
#[derive(Debug, Clone)]
pub struct Ensemble {
    name: &'static str,
    imu: ImuConfig,
    members: Vec<(f64, MekfGnss)>,
    /// Of the resampling; a bank does none.
    rng: Option<ChaCha8Rng>,
}

impl Ensemble {
    /// Extended Kalman filters that start at headings 15 deg apart.
    pub fn bank(imu: &ImuConfig, initial: &InitialBelief) -> Result<Self, FilterError> {
        let spacing = std::f64::consts::TAU / BANK as f64;
        let members = (0..BANK).map(|k| {
            let heading = k as f64 * spacing;
            let start = turned(initial, heading, 0.5 * spacing);
            Ok((1.0 / BANK as f64, MekfGnss::new(imu, &start)?))
        });
        let members = members.collect::<Result<_, FilterError>>()?;
        Ok(Self { name: "ekf-bank", imu: imu.clone(), members, rng: None })
    }

    /// Particles of heading and vertical bias.
    pub fn particles(
        imu: &ImuConfig,
        initial: &InitialBelief,
        seed: u64,
    ) -> Result<Self, FilterError> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut members = Vec::with_capacity(PARTICLES);
        for k in 0..PARTICLES {
            let share = (k as f64 + rng.random::<f64>()) / PARTICLES as f64;
            let start = turned(initial, std::f64::consts::TAU * share, HEADING_KERNEL);
            let belief = MekfGnss::new(imu, &start)?.belief();
            // The bias is a draw from its prior, and the kernel what is left of it.
            let z: [f64; 2] = [0.0, rng.sample(StandardNormal)];
            let shrunk = shrunk(&belief, &Vector2::from(z), [0.0, 1.0 - KERNEL.powi(2)]);
            members.push((1.0 / PARTICLES as f64, MekfGnss::with_belief(imu, shrunk)));
        }
        Ok(Self { name: "particles", imu: imu.clone(), members, rng: Some(rng) })
    }

    fn weigh(&mut self, logs: &[f64]) -> Result<(), FilterError> {
        let largest = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        if !largest.is_finite() {
            return Err(FilterError::NotFinite("weights of the ensemble"));
        }
        for ((weight, _), log) in self.members.iter_mut().zip(logs) {
            *weight = (log - largest).exp();
        }
        self.members.retain(|(weight, _)| *weight > LEAST_WEIGHT);
        let total: f64 = self.members.iter().map(|(weight, _)| weight).sum();
        self.members.iter_mut().for_each(|(weight, _)| *weight /= total);
        Ok(())
    }

    /// Resamples, or hands over to one filter.
    fn renew(&mut self) {
        let Some(rng) = &mut self.rng else { return };
        if self.members.len() == 1 {
            return;
        }
        let parts: Vec<(f64, Belief)> =
            self.members.iter().map(|(weight, filter)| (*weight, filter.belief())).collect();
        let whole = combined(&parts);
        if marginal(&whole).1[(0, 0)] < SINGLE_SD.powi(2) {
            self.members = vec![(1.0, MekfGnss::with_belief(&self.imu, whole))];
            return;
        }
        let effective = 1.0 / parts.iter().map(|(weight, _)| weight * weight).sum::<f64>();
        if effective > 0.5 * PARTICLES as f64 {
            return;
        }
        let share = 1.0 / PARTICLES as f64;
        let (mut next, mut reached) = (rng.random::<f64>() * share, 0.0);
        let mut members = Vec::with_capacity(PARTICLES);
        for (weight, belief) in &parts {
            reached += weight;
            while next < reached && members.len() < PARTICLES {
                let z = Vector2::from_fn(|_, _| rng.sample::<f64, _>(StandardNormal));
                let moved = shrunk(belief, &z, [1.0 - KERNEL.powi(2); 2]);
                members.push((share, MekfGnss::with_belief(&self.imu, moved)));
                next += share;
            }
        }
        let total = members.len() as f64;
        members.iter_mut().for_each(|(weight, _)| *weight = 1.0 / total);
        self.members = members;
    }
}

fn turned(initial: &InitialBelief, heading: f64, sd: f64) -> InitialBelief {
    let mut turned = *initial;
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading);
    turned.state.world_from_body.rotation = turn * initial.state.world_from_body.rotation;
    turned.heading_sd = Some(sd);
    turned
}

/// Rows of heading and vertical bias in the error of a belief, and their covariance.
fn marginal(belief: &Belief) -> (SMatrix<f64, 2, 15>, Matrix2<f64>) {
    let up = belief.state.world_from_body.rotation.inverse() * Vector3::z();
    let mut rows = SMatrix::<f64, 2, 15>::zeros();
    rows.fixed_view_mut::<1, 3>(0, block::ROTATION).copy_from(&up.transpose());
    rows.fixed_view_mut::<1, 3>(1, block::GYRO_BIAS).copy_from(&up.transpose());
    (rows, rows * belief.covariance * rows.transpose())
}

/// The belief given a draw `z` (standard normal) of heading and bias that explains `explained` of
/// the variance of each.
fn shrunk(belief: &Belief, z: &Vector2<f64>, explained: [f64; 2]) -> Belief {
    let (rows, covariance) = marginal(belief);
    let scale = Matrix2::from_diagonal(&Vector2::from(explained.map(f64::sqrt)));
    let Some(factor) = covariance.cholesky() else { return *belief };
    let cross = belief.covariance * rows.transpose();
    // cross covariance^-1 = cross L^-T L^-1; the draw is L scale z.
    let Some(whitened) = factor.l().solve_lower_triangular(&cross.transpose()) else {
        return *belief;
    };
    let gain = whitened.transpose() * scale;
    let mut moved = *belief;
    moved.state = crate::filter::gnss::moved_state(&belief.state, &(gain * z));
    moved.covariance -= gain * gain.transpose();
    moved
}

fn combined(parts: &[(f64, Belief)]) -> Belief {
    let mut mean = nalgebra::Matrix3::zeros();
    for (weight, belief) in parts {
        mean += *belief.state.world_from_body.rotation.to_rotation_matrix().matrix() * *weight;
    }
    combined_belief(parts, &crate::so3::project_to_so3(&mean).unwrap_or_default())
}

impl BayesFilter for Ensemble {
    fn name(&self) -> &'static str {
        self.name
    }

    fn propagate(&mut self, step: &InertialStep) -> Result<(), FilterError> {
        self.members.iter_mut().try_for_each(|(_, filter)| filter.propagate(step))
    }

    fn update_position(&mut self, measured: &PositionMeasurement) -> Result<(), FilterError> {
        let mut logs = Vec::with_capacity(self.members.len());
        for (weight, filter) in &mut self.members {
            logs.push(weight.ln() + filter.innovation(measured)?.log_likelihood());
            filter.update_position(measured)?;
        }
        self.weigh(&logs)?;
        self.renew();
        Ok(())
    }

    fn attitude(&self) -> Rotation3<f64> {
        self.state().world_from_body.rotation.to_rotation_matrix()
    }

    fn estimate(&self) -> Estimate {
        crate::filter::gnss::estimate(&self.belief(), None)
    }
}

impl GnssFilter for Ensemble {
    fn innovation(&self, position: &PositionMeasurement) -> Result<Innovation, FilterError> {
        let parts = self.members.iter().map(|(w, filter)| Ok((*w, filter.innovation(position)?)));
        combined_innovation(&parts.collect::<Result<Vec<_>, FilterError>>()?)
    }

    fn loosen_position(&mut self, variance: f64) {
        self.members.iter_mut().for_each(|(_, filter)| filter.loosen_position(variance));
    }

    fn set_imu_gap(&mut self, in_gap: bool) {
        self.members.iter_mut().for_each(|(_, filter)| filter.set_imu_gap(in_gap));
    }

    fn enlarge(&mut self, factor: f64) -> Result<(), FilterError> {
        self.members.iter_mut().try_for_each(|(_, filter)| filter.enlarge(factor))
    }

    fn belief(&self) -> Belief {
        let parts: Vec<(f64, Belief)> =
            self.members.iter().map(|(weight, filter)| (*weight, filter.belief())).collect();
        match &parts[..] {
            [(_, single)] => *single,
            parts => combined(parts),
        }
    }

    fn state(&self) -> NavState {
        self.belief().state
    }
}
