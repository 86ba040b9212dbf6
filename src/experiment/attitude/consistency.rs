//! Errors and innovations against the covariances that filters report.

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::scene::Modelled;
use crate::filter::{AttitudeMeasurement, Estimate, Frame, VectorMeasurement};
use crate::so3::{hat, log};

/// Degrees of freedom to which normalised innovations are scaled: those of a 3-vector's error.
const DEGREES: f64 = 3.0;
/// A measured vector whose length is one to within this has noise only across it.
const UNIT_LENGTH: f64 = 1e-9;

/// `e^T P^-1 e`; none where `P` has no inverse.
pub(super) fn normalized(error: &Vector3<f64>, covariance: &Matrix3<f64>) -> Option<f64> {
    covariance.cholesky().map(|factor| error.dot(&factor.solve(error)))
}

/// The square of a measurement's deviation from the prediction, against its covariance under the
/// belief before the update, scaled to three degrees of freedom; none without information.
///
/// With residuals `r_i = H_i e` and noise of covariance `W_i^-1` it is, for the covariance `P` of the
/// rotation vector `e`,
///
/// ```text
/// sum r_i^T W_i r_i - b^T P (I + A P)^-1 b,   A = sum H_i^T W_i H_i,   b = sum H_i^T W_i r_i.
/// ```
pub(super) fn normalized_innovation(belief: &Estimate, measured: Modelled) -> Option<f64> {
    let Linearized { square, information, vector, degrees } = match measured {
        Modelled::Attitude(attitude) => of_attitude(&belief.world_from_body, attitude),
        Modelled::Directions(vectors) => of_vectors(&belief.world_from_body, vectors)?,
    };
    let p = belief.rotation_covariance;
    let inverse = (Matrix3::identity() + information * p).try_inverse()?;
    let explained = vector.dot(&(p * inverse * vector));
    (degrees > 0.0).then_some((square - explained) * DEGREES / degrees)
}

/// A measurement as a function of the body-frame rotation vector of the attitude.
struct Linearized {
    /// `sum r_i^T W_i r_i`.
    square: f64,
    information: Matrix3<f64>,
    vector: Vector3<f64>,
    degrees: f64,
}

fn of_attitude(belief: &Rotation3<f64>, measured: &AttitudeMeasurement) -> Linearized {
    let noise = 0.5 * (measured.noise + measured.noise.transpose());
    let information = Matrix3::from_diagonal_element(noise.trace()) - noise;
    let residual = log(&(belief.inverse() * measured.world_from_body));
    let vector = information * residual;
    let eigenvalues = information.symmetric_eigenvalues();
    let known = eigenvalues.iter().filter(|&&x| x > 1e-9 * eigenvalues.amax()).count();
    Linearized { square: residual.dot(&vector), information, vector, degrees: known as f64 }
}

fn of_vectors(belief: &Rotation3<f64>, measured: &[VectorMeasurement]) -> Option<Linearized> {
    let mut sum = Linearized {
        square: 0.0,
        information: Matrix3::zeros(),
        vector: Vector3::zeros(),
        degrees: 0.0,
    };
    for m in measured {
        let weight = m.covariance.try_inverse()?;
        let (predicted, h) = match m.measured_in {
            Frame::Body => {
                let predicted = belief.inverse_transform_vector(&m.in_world);
                (predicted, hat(&predicted))
            }
            Frame::World => (belief * m.in_body, -belief.matrix() * hat(&m.in_body)),
        };
        let residual = m.measured() - predicted;
        let weighted = h.transpose() * weight;
        sum.square += residual.dot(&(weight * residual));
        sum.information += weighted * h;
        sum.vector += weighted * residual;
        let is_unit = (m.measured().norm() - 1.0).abs() < UNIT_LENGTH;
        sum.degrees += if is_unit { 2.0 } else { 3.0 };
    }
    Some(sum)
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::super::scene::normal;
    use super::*;
    use crate::so3::exp;

    /// Over draws of the truth from the belief and of the noise, the mean is the number of degrees
    /// of freedom.
    #[test]
    fn a_consistent_filter_has_three() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let root = Vector3::new(0.02, 0.05, 0.01);
        let attitude = exp(&Vector3::new(0.3, -2.0, 1.0));
        let covariance = Matrix3::from_diagonal(&root.component_mul(&root));
        let belief = Estimate::of_attitude(attitude, covariance);
        let noise_root = Vector3::new(0.04, 0.02, 0.03);
        let noise = Matrix3::from_diagonal(&noise_root.component_mul(&noise_root));
        let (mut vectors, mut attitudes, mut directions) = (0.0, 0.0, 0.0);
        let count = 4000;
        for _ in 0..count {
            let truth = attitude * exp(&root.component_mul(&normal(&mut rng)));
            let in_body = Vector3::new(1.0, 2.0, -0.5);
            let measured = [Frame::Body, Frame::World].map(|measured_in| {
                let (mut in_world, mut in_body) = (truth * in_body, in_body);
                let error = noise_root.component_mul(&normal(&mut rng));
                match measured_in {
                    Frame::Body => in_body += error,
                    Frame::World => in_world += error,
                }
                VectorMeasurement { in_world, in_body, measured_in, covariance: noise }
            });
            vectors += normalized_innovation(&belief, Modelled::Directions(&measured)).unwrap();
            let world_from_body = truth * exp(&noise_root.component_mul(&normal(&mut rng)));
            let measured = AttitudeMeasurement::from_covariance(world_from_body, &noise).unwrap();
            attitudes += normalized_innovation(&belief, Modelled::Attitude(&measured)).unwrap();
            let seen = (truth.inverse() * Vector3::y() + normal(&mut rng) * 0.03).normalize();
            let measured =
                [VectorMeasurement::of_world_direction(Vector3::y(), seen, 0.03f64.powi(-2))];
            directions += normalized_innovation(&belief, Modelled::Directions(&measured)).unwrap();
        }
        // Standard deviations of the means: 0.027, 0.039, 0.047.
        for (sum, margin) in [(vectors, 0.1), (attitudes, 0.13), (directions, 0.15)] {
            assert!((sum / f64::from(count) - 3.0).abs() < margin, "{}", sum / f64::from(count));
        }
    }
}
