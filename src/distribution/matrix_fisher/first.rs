use nalgebra::Vector3;

use super::engine::{self, Sums};
use super::{InvalidSingularValues, check_singular_values};

/// `1 - E[Q_ii]` alone, for `s1 >= s2 >= |s3|`: what a filter needs that carries the first
/// moments, at a fraction of the cost of [`Moments`](super::Moments).
pub fn first_complement(s: &Vector3<f64>) -> Result<Vector3<f64>, InvalidSingularValues> {
    check_singular_values(s)?;
    let [y1, y2, y3] = engine::pass::<false>(&Sums::of_singular_values(s)).squares;
    Ok(2.0 * Vector3::new(y2 + y3, y1 + y3, y1 + y2))
}

#[cfg(test)]
mod tests {
    use super::super::Moments;
    use super::*;

    #[test]
    fn first_moments_alone_are_those_of_the_full_pass() {
        for s in [[0.0; 3], [1e-3, 1e-4, -1e-4], [5.0, 3.0, -2.0], [50.0, 20.0, 4.0], [1e6; 3]] {
            let s = Vector3::from(s);
            let expected = Moments::new(&s).unwrap().complement();
            let found = first_complement(&s).unwrap();
            assert!((found - expected).amax() <= 1e-13 * expected.amax(), "{s} {found}");
        }
        assert!(first_complement(&Vector3::new(1.0, 2.0, 0.0)).is_err());
    }
}
