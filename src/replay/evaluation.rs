//! A run against its reference: the errors themselves for figures, their statistics for
//! `metrics.json`.

use nalgebra::Matrix6;
use serde::Serialize;

use crate::evaluation::{
    Alignment, ApeOptions, ApeResult, AssociationOptions, BelievedTrajectory, Delta,
    EvaluationError, NeesOptions, NeesResult, NeesSummary, Relation, RpeOptions, Statistics,
    Trajectory, ape, nees, rpe,
};

/// Time over which relative errors are taken, s.
const RPE_SECONDS: f64 = 1.0;

/// The errors of a run.
#[derive(Debug, Clone)]
pub struct Evaluated {
    pub summary: Evaluation,
    /// Position errors after SE(3) alignment.
    pub translation: ApeResult,
    /// `None` where no covariance can be judged.
    pub consistency: Option<NeesResult>,
}

/// The truth block of `metrics.json`.
#[derive(Debug, Clone, Serialize)]
pub struct Evaluation {
    pub matched: usize,
    pub reference_poses: usize,
    pub estimate_poses: usize,
    /// Absolute position error after SE(3) alignment, m.
    pub ape_translation: Statistics,
    /// Absolute attitude error after SE(3) alignment, degrees.
    pub ape_rotation_deg: Statistics,
    /// `null` where the run is too short.
    pub rpe: Option<RelativeErrors>,
    /// `null` where no covariance is positive definite.
    pub nees: Option<Consistency>,
}

/// Relative pose error, as `evaluate rpe --delta 1 --unit s --all-pairs`.
#[derive(Debug, Clone, Serialize)]
pub struct RelativeErrors {
    pub seconds: f64,
    pub pairs: usize,
    /// m.
    pub translation: Statistics,
    pub rotation_deg: Statistics,
}

/// Normalised errors, as `evaluate nees`.
#[derive(Debug, Clone, Serialize)]
pub struct Consistency {
    /// How the worlds are put on each other, by the first poses: `yaw` (heading and position) or
    /// `origin` (all).
    pub alignment: &'static str,
    pub attitude: NeesSummary,
    pub position: NeesSummary,
    pub joint: NeesSummary,
    /// Poses left out since their covariance is not positive definite.
    pub singular: usize,
}

/// Errors of `estimate`, whose poses have these covariances of (rotation, position) and whose
/// vertical is that of gravity if `levelled`.
pub fn evaluate(
    reference: &Trajectory,
    estimate: &Trajectory,
    covariances: &[Matrix6<f64>],
    levelled: bool,
) -> Result<Evaluated, EvaluationError> {
    let absolute = |relation| {
        let options = ApeOptions { alignment: Alignment::Se3, relation, ..Default::default() };
        ape(reference, estimate, &options)
    };
    let (translation, rotation) = (absolute(Relation::Translation)?, absolute(Relation::Angle)?);
    let believed =
        BelievedTrajectory { trajectory: estimate.clone(), covariances: covariances.to_vec() };
    let options = match levelled {
        true => NeesOptions::levelled(reference, estimate, AssociationOptions::default())?,
        false => NeesOptions::default(),
    };
    let consistency = nees(reference, &believed, &options).ok();
    let summary = Evaluation {
        matched: translation.pairs.len(),
        reference_poses: translation.pairs.reference_poses,
        estimate_poses: translation.pairs.estimate_poses,
        ape_translation: translation.statistics,
        ape_rotation_deg: rotation.statistics,
        rpe: relative_errors(reference, estimate),
        nees: consistency.as_ref().map(|result| Consistency {
            alignment: options.alignment.name(),
            attitude: result.attitude.clone(),
            position: result.position.clone(),
            joint: result.joint.clone(),
            singular: result.singular,
        }),
    };
    Ok(Evaluated { summary, translation, consistency })
}

fn relative_errors(reference: &Trajectory, estimate: &Trajectory) -> Option<RelativeErrors> {
    let errors = |relation| {
        let delta = Delta::Seconds(RPE_SECONDS);
        rpe(
            reference,
            estimate,
            &RpeOptions { relation, delta, all_pairs: true, ..Default::default() },
        )
        .ok()
    };
    let (translation, rotation) = (errors(Relation::Translation)?, errors(Relation::Angle)?);
    Some(RelativeErrors {
        seconds: RPE_SECONDS,
        pairs: translation.links.len(),
        translation: translation.statistics,
        rotation_deg: rotation.statistics,
    })
}
