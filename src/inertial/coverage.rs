//! Gaps in the IMU's data, filled in or not.

use crate::sensor::ImuSample;

/// Whether the IMU was there between two samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Coverage {
    Measured,
    /// The samples are too far apart.
    Gap,
    /// A gap that was filled in: all samples of a stretch longer than a gap lie on straight lines.
    Interpolated,
}

/// Readings closer to the straight line than this lie on it, rad/s and m/s^2: three orders of
/// magnitude below the step of a good sensor, well above what decimals cut off.
const ON_LINE: f64 = 1e-6;

impl Coverage {
    /// Of the interval before each sample (the first has none and counts as measured), `max_gap`
    /// being the longest interval without samples that is no gap, s.
    ///
    /// Readings that do not change at all are no interpolation: so does a simulated body at rest.
    pub fn before_each(samples: &[ImuSample], max_gap: f64) -> Vec<Self> {
        let mut coverage = vec![Self::Measured; samples.len()];
        for (k, pair) in samples.windows(2).enumerate() {
            if seconds(pair) > max_gap {
                coverage[k + 1] = Self::Gap;
            }
        }
        let mut first = 0;
        for last in 1..samples.len() {
            if samples.get(last - 1..last + 2).is_some_and(straight) {
                continue;
            }
            let stretch = &samples[first..=last];
            if stretch.len() > 2 && seconds(stretch) > max_gap && !constant(stretch) {
                coverage[first + 1..=last].fill(Self::Interpolated);
            }
            first = last;
        }
        coverage
    }
}

fn seconds(stretch: &[ImuSample]) -> f64 {
    match stretch {
        [first, .., last] => last.stamp.seconds_since(first.stamp),
        _ => 0.0,
    }
}

/// Whether the middle one of three samples lies between the others.
fn straight(samples: &[ImuSample]) -> bool {
    let [before, sample, after] = samples else { return false };
    alike(sample, &ImuSample::between(before, after, sample.stamp))
}

fn constant(stretch: &[ImuSample]) -> bool {
    stretch.windows(2).all(|pair| alike(&pair[0], &pair[1]))
}

fn alike(a: &ImuSample, b: &ImuSample) -> bool {
    (a.angular_velocity - b.angular_velocity).amax() <= ON_LINE
        && (a.specific_force - b.specific_force).amax() <= ON_LINE
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::Stamp;
    use nalgebra::Vector3;

    /// At 100 Hz, with readings that are never straight.
    fn samples() -> Vec<ImuSample> {
        let sample = |k: u32| {
            let t = f64::from(k) * 0.01;
            ImuSample {
                stamp: Stamp::from_seconds(t).unwrap(),
                angular_velocity: Vector3::new((31.0 * t).sin(), (17.0 * t).cos(), 0.1),
                specific_force: Vector3::new(0.2, (23.0 * t).sin(), 9.8),
            }
        };
        (0..100).map(sample).collect()
    }

    fn found(samples: &[ImuSample], what: Coverage) -> Vec<usize> {
        let coverage = Coverage::before_each(samples, 0.1);
        (0..samples.len()).filter(|&k| coverage[k] == what).collect()
    }

    #[test]
    fn gaps_are_found_whether_filled_in_or_not() {
        let mut all = samples();
        assert!(found(&all, Coverage::Gap).is_empty());
        assert!(found(&all, Coverage::Interpolated).is_empty());
        let (from, to) = (all[40], all[60]);
        for sample in &mut all[41..60] {
            *sample = ImuSample::between(&from, &to, sample.stamp);
        }
        assert_eq!(found(&all, Coverage::Interpolated), (41..=60).collect::<Vec<_>>());
        all.drain(41..60);
        assert_eq!(found(&all, Coverage::Gap), [41]);
        assert!(found(&all, Coverage::Interpolated).is_empty());
    }

    #[test]
    fn short_or_constant_stretches_are_measured() {
        let mut all = samples();
        let (from, to) = (all[40], all[49]);
        for sample in &mut all[41..49] {
            *sample = ImuSample::between(&from, &to, sample.stamp);
        }
        for sample in &mut all[60..] {
            *sample = ImuSample { stamp: sample.stamp, ..from };
        }
        assert!(found(&all, Coverage::Interpolated).is_empty());
        assert!(found(&all, Coverage::Gap).is_empty());
        assert!(Coverage::before_each(&[], 0.1).is_empty());
        assert_eq!(Coverage::before_each(&all[..1], 0.1), [Coverage::Measured]);
    }
}
