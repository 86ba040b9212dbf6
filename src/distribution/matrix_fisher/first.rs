use nalgebra::Vector3;

use super::engine;
use super::sums::Sums;
use super::{InvalidSingularValues, check_singular_values};

/// First moments alone, and how they change with the singular values: what a filter needs that
/// carries `E[R]`, at a fraction of the cost of [`Moments`](super::Moments).
///
/// ```
/// # use mfg_vio::distribution::matrix_fisher::FirstMoments;
/// # use nalgebra::Vector3;
/// let moments = FirstMoments::new(&Vector3::new(60.0, 50.0, 40.0))?;
/// // The distribution whose mean is a little shorter.
/// let found = moments.neighbour(&(moments.complement() * 1.02))?;
/// let shorter = FirstMoments::new(&found)?;
/// assert!((shorter.complement() - moments.complement() * 1.02).norm() < 1e-14);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, Copy)]
pub struct FirstMoments {
    pub(super) sums: Sums,
    /// `E[x_i^2]`, `i = 1, 2, 3`, of the unit quaternion.
    pub(super) squares: [f64; 3],
    /// `E[x_i^2 x_j^2]`, `i, j = 1, 2, 3`.
    pub(super) products: [[f64; 3]; 3],
}

impl FirstMoments {
    /// The moments for `s1 >= s2 >= |s3|`.
    pub fn new(s: &Vector3<f64>) -> Result<Self, InvalidSingularValues> {
        check_singular_values(s)?;
        Ok(Self::of(Sums::of_singular_values(s)))
    }

    pub(super) fn of(sums: Sums) -> Self {
        let pass = engine::pass::<false>(&sums);
        Self { sums, squares: pass.squares, products: pass.products }
    }

    /// `1 - E[Q_ii]`.
    pub fn complement(&self) -> Vector3<f64> {
        let [y1, y2, y3] = self.squares;
        2.0 * Vector3::new(y2 + y3, y1 + y3, y1 + y2)
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Moments, s_from_complement};
    use super::*;

    #[test]
    fn first_moments_alone_are_those_of_the_full_pass() {
        for s in [[0.0; 3], [1e-3, 1e-4, -1e-4], [5.0, 3.0, -2.0], [50.0, 20.0, 4.0], [1e6; 3]] {
            let s = Vector3::from(s);
            let expected = Moments::new(&s).unwrap().complement();
            let found = FirstMoments::new(&s).unwrap().complement();
            assert!((found - expected).amax() <= 1e-13 * expected.amax(), "{s} {found}");
        }
        assert!(FirstMoments::new(&Vector3::new(1.0, 2.0, 0.0)).is_err());
    }

    /// However far the neighbour is.
    #[test]
    fn neighbours_are_solutions() {
        let cases = [[2.0, 1.0, -0.5], [50.0, 20.0, 4.0], [1e6; 3], [1e4, 3.0, -2.9]];
        for start in cases {
            let start = FirstMoments::new(&Vector3::from(start)).unwrap();
            for s in cases {
                let g = Moments::new(&Vector3::from(s)).unwrap().complement();
                let found = start.neighbour(&g).unwrap();
                let expected = s_from_complement(&g).unwrap();
                assert!((found - expected).amax() < 1e-9 * expected.amax(), "{found} {expected}");
            }
        }
    }
}
