//! The discrete Fourier transform of series whose length is a power of two.

use std::f64::consts::PI;

use nalgebra::Complex;

/// Replaces `x` by `X_k = sum_j x_j exp(-2 pi i j k / n)` (Cooley and Tukey, Math. Comp. 19, 1965), in
/// place. The length is a power of two: others are left as they are. O(n log n).
pub(crate) fn transform(x: &mut [Complex<f64>]) {
    let n = x.len();
    if !n.is_power_of_two() || n < 2 {
        return;
    }
    let shift = usize::BITS - n.ilog2();
    for k in 0..n {
        let mirrored = k.reverse_bits() >> shift;
        if k < mirrored {
            x.swap(k, mirrored);
        }
    }
    let roots: Vec<Complex<f64>> =
        (0..n / 2).map(|k| Complex::from_polar(1.0, -2.0 * PI * k as f64 / n as f64)).collect();
    let mut half = 1;
    while half < n {
        for block in x.chunks_exact_mut(2 * half) {
            let (low, high) = block.split_at_mut(half);
            for (k, (a, b)) in low.iter_mut().zip(high).enumerate() {
                let turned = *b * roots[k * (n / (2 * half))];
                (*a, *b) = (*a + turned, *a - turned);
            }
        }
        half *= 2;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_transform_is_its_definition() {
        for n in [1_usize, 2, 8, 64] {
            let x: Vec<_> = (0..n)
                .map(|k| Complex::new((k as f64).sin() + 0.3, (1.7 * k as f64).cos()))
                .collect();
            let mut fast = x.clone();
            transform(&mut fast);
            for (k, value) in fast.iter().enumerate() {
                let term = |j: usize| {
                    x[j] * Complex::from_polar(1.0, -2.0 * PI * (j * k) as f64 / n as f64)
                };
                let sum: Complex<f64> = (0..n).map(term).sum();
                assert!((sum - value).norm() < 1e-11, "{n} {k}: {sum} {value}");
            }
        }
    }
}
