//! Time on the sensors' clock.

use std::fmt;

/// A point in time on the sensor's header clock, in nanoseconds.
///
/// An integer, so that stamps compare, sort and print exactly; differences are taken before
/// the conversion to seconds, so that no digits are lost on epoch-based clocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Stamp(i64);

impl Stamp {
    pub const fn from_nanos(nanos: i64) -> Self {
        Self(nanos)
    }

    /// From ROS-style seconds and nanoseconds.
    pub const fn from_parts(seconds: i64, nanos: i64) -> Self {
        Self(seconds.saturating_mul(1_000_000_000).saturating_add(nanos))
    }

    /// Rounded to the nearest nanosecond; `None` if not finite or out of range.
    pub fn from_seconds(seconds: f64) -> Option<Self> {
        let nanos = (seconds * 1e9).round();
        (nanos.abs() < i64::MAX as f64).then_some(Self(nanos as i64))
    }

    /// Reads decimal seconds (`1305031102.175304`) without going through a float; `None` if that is
    /// none or out of range.
    pub fn parse_seconds(text: &str) -> Option<Self> {
        let text = text.trim();
        let (whole, fraction) = text.split_once('.').unwrap_or((text, ""));
        let plain = fraction.bytes().all(|b| b.is_ascii_digit());
        let exact = plain && !whole.is_empty() && !whole.starts_with(['+', '-']);
        match (exact, whole.parse::<i64>()) {
            (true, Ok(seconds)) => {
                let digits: String = fraction.chars().chain("000000000".chars()).take(9).collect();
                let nanos: i64 = digits.parse().ok()?;
                seconds.checked_mul(1_000_000_000)?.checked_add(nanos).map(Self)
            }
            _ => Self::from_seconds(text.parse().ok()?),
        }
    }

    pub const fn nanos(self) -> i64 {
        self.0
    }

    /// Seconds since the clock's origin; for display and files, not for differences.
    pub fn seconds(self) -> f64 {
        self.0 as f64 * 1e-9
    }

    /// `self - earlier` in seconds; negative if `earlier` is later.
    pub fn seconds_since(self, earlier: Self) -> f64 {
        self.0.saturating_sub(earlier.0) as f64 * 1e-9
    }

    /// This stamp moved by `seconds` (rounded to nanoseconds).
    pub fn offset_by(self, seconds: f64) -> Self {
        Self(self.0.saturating_add((seconds * 1e9).round() as i64))
    }
}

/// Seconds with nine decimals, the format of `trajectory.tum`.
impl fmt::Display for Stamp {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let sign = if self.0 < 0 { "-" } else { "" };
        let nanos = self.0.unsigned_abs();
        let text = format!("{sign}{}.{:09}", nanos / 1_000_000_000, nanos % 1_000_000_000);
        f.pad(&text)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decimal_seconds_are_read_exactly() {
        let stamp = Stamp::parse_seconds("1305031102.175304").unwrap();
        assert_eq!(stamp.nanos(), 1_305_031_102_175_304_000);
        assert_eq!(stamp.to_string(), "1305031102.175304000");
        assert_eq!(Stamp::parse_seconds("12").unwrap().nanos(), 12_000_000_000);
        assert_eq!(Stamp::parse_seconds("1e-3").unwrap().nanos(), 1_000_000);
        assert_eq!(Stamp::parse_seconds("-0.5").unwrap().to_string(), "-0.500000000");
    }

    #[test]
    fn text_that_is_no_time_is_refused() {
        for text in
            ["", "nan", "inf", "1.2.3", "abc", "1e300", "1403715524907143168", "9223372036.9"]
        {
            assert_eq!(Stamp::parse_seconds(text), None, "{text}");
        }
    }
}
