use nalgebra::Isometry3;

use super::align::align_attitudes;
use super::{
    Alignment, AssociationOptions, EvaluationError, PosePairs, Similarity, Statistics, Trajectory,
    align, associate,
};

/// Which part of a pose difference is the error.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Relation {
    /// Length of the translation, m.
    #[default]
    Translation,
    /// Rotation angle, degrees.
    Angle,
}

impl Relation {
    pub fn name(self) -> &'static str {
        match self {
            Self::Translation => "trans",
            Self::Angle => "angle",
        }
    }

    pub fn unit(self) -> &'static str {
        match self {
            Self::Translation => "m",
            Self::Angle => "deg",
        }
    }

    /// The error of a pose that should be the identity.
    pub(super) fn of(self, difference: &Isometry3<f64>) -> f64 {
        match self {
            Self::Translation => difference.translation.vector.norm(),
            Self::Angle => difference.rotation.angle().to_degrees(),
        }
    }
}

/// How the absolute pose error is computed.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ApeOptions {
    pub association: AssociationOptions,
    pub alignment: Alignment,
    /// Align over the first so many pairs only; all if `None`.
    pub align_n: Option<usize>,
    pub relation: Relation,
}

/// The absolute pose error of one estimate.
#[derive(Debug, Clone, PartialEq)]
pub struct ApeResult {
    /// The matched poses, the estimate's aligned.
    pub pairs: PosePairs,
    /// What was applied to the estimate.
    pub alignment: Similarity,
    /// Of attitudes: their RMSE (degrees) under the rotation that fits the positions best, where
    /// that says more of the alignment than of the estimate and another one was taken.
    pub by_positions: Option<f64>,
    /// One error a pair: m or degrees.
    pub errors: Vec<f64>,
    pub statistics: Statistics,
}

/// Absolute pose error: how far each pose of the estimate, aligned, is from the reference.
pub fn ape(
    reference: &Trajectory,
    estimate: &Trajectory,
    options: &ApeOptions,
) -> Result<ApeResult, EvaluationError> {
    let pairs = associate(reference, estimate, &options.association)?;
    ape_of_pairs(pairs, options.alignment, options.align_n, options.relation)
}

/// [`ape`] of poses that are associated already.
pub fn ape_of_pairs(
    mut pairs: PosePairs,
    alignment: Alignment,
    align_n: Option<usize>,
    relation: Relation,
) -> Result<ApeResult, EvaluationError> {
    let (alignment, by_positions) = match relation {
        Relation::Translation => (align(&pairs, alignment, align_n)?, None),
        Relation::Angle => {
            let aligned = align_attitudes(&pairs, alignment, align_n)?;
            (aligned.similarity, aligned.by_positions)
        }
    };
    for pose in &mut pairs.estimate {
        *pose = alignment.apply(pose);
    }
    let errors = absolute_errors(&pairs, relation);
    let statistics = Statistics::of(&errors).ok_or(EvaluationError::Empty)?;
    Ok(ApeResult { pairs, alignment, by_positions, errors, statistics })
}

/// The error of each pair as it stands.
pub fn absolute_errors(pairs: &PosePairs, relation: Relation) -> Vec<f64> {
    let error = |(r, e): (&Isometry3<f64>, &Isometry3<f64>)| match relation {
        Relation::Translation => (e.translation.vector - r.translation.vector).norm(),
        Relation::Angle => (r.rotation.inverse() * e.rotation).angle().to_degrees(),
    };
    pairs.reference.iter().zip(&pairs.estimate).map(error).collect()
}
