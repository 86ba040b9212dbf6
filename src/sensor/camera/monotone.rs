//! Radial distortion: how far it is one-to-one, and its inverse.

/// The first zero in `(0, end]` of a function that is positive at 0; `end` if it has none.
pub(super) fn first_below_zero(function: impl Fn(f64) -> f64, end: f64) -> f64 {
    /// Polynomials of the degrees used here do not cross zero twice within a step.
    const STEPS: u32 = 2000;
    const HALVINGS: usize = 50;
    let at = |k: u32| end * f64::from(k) / f64::from(STEPS);
    // Written so that NaN counts as below zero.
    let is_positive = |x: f64| function(x) > 0.0;
    let Some(k) = (1..=STEPS).find(|k| !is_positive(at(*k))) else { return end };
    let (mut low, mut high) = (at(k - 1), at(k));
    for _ in 0..HALVINGS {
        let middle = 0.5 * (low + high);
        if is_positive(middle) { low = middle } else { high = middle }
    }
    low
}

/// Where in `[0, end]` an increasing function, 0 at 0, has the value `target` (0 or more): Newton's
/// method, bracketed. `end` if the function stays below.
pub(super) fn invert(
    function: impl Fn(f64) -> f64,
    slope: impl Fn(f64) -> f64,
    target: f64,
    end: f64,
) -> f64 {
    const MAX_STEPS: usize = 80;
    const TOLERANCE: f64 = 1e-15;
    let (mut low, mut high) = (0.0, end);
    let mut x = target.min(end);
    for _ in 0..MAX_STEPS {
        let error = function(x) - target;
        if error > 0.0 {
            high = x;
        } else {
            low = x;
        }
        // Where the function is nearly flat a step may leave what is known to hold the place.
        let newton = x - error / slope(x);
        let next = if newton >= low && newton <= high { newton } else { 0.5 * (low + high) };
        let step = (next - x).abs();
        x = next;
        if step <= TOLERANCE * (1.0 + x) {
            break;
        }
    }
    x
}
