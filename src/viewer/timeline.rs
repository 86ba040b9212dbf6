//! The two timelines of a recording.

use rerun::{TimeCell, TimeColumn};

use crate::sensor::Stamp;

/// Sensor time.
pub(super) const TIME: &str = "time";
/// Number of the camera frame.
pub(super) const FRAME: &str = "frame";

/// What the stamps of a log count from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Clock {
    /// The start of a device or of a simulation: shown as a duration.
    Start,
    /// 1970-01-01: shown as a date.
    Epoch,
}

impl Clock {
    /// No device has been up for this long (2001-09-09 as a date).
    const EARLIEST_DATE: Stamp = Stamp::from_parts(1_000_000_000, 0);

    pub(super) fn of(stamp: Stamp) -> Self {
        if stamp < Self::EARLIEST_DATE { Self::Start } else { Self::Epoch }
    }

    /// Of many stamps, on the timeline [`TIME`].
    pub(super) fn column(self, stamps: &[Stamp]) -> TimeColumn {
        let nanos = stamps.iter().map(|stamp| stamp.nanos());
        match self {
            Self::Start => TimeColumn::new_duration_nanos(TIME, nanos),
            Self::Epoch => TimeColumn::new_timestamp_nanos_since_epoch(TIME, nanos),
        }
    }

    pub(super) fn cell(self, stamp: Stamp) -> TimeCell {
        match self {
            Self::Start => TimeCell::from_duration_nanos(stamp.nanos()),
            Self::Epoch => TimeCell::from_timestamp_nanos_since_epoch(stamp.nanos()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uptime_and_dates_are_told_apart() {
        assert_eq!(Clock::of(Stamp::from_parts(5645, 180_000_000)), Clock::Start);
        assert_eq!(Clock::of(Stamp::from_parts(-1, 0)), Clock::Start);
        assert_eq!(Clock::of(Stamp::from_parts(1_305_031_102, 175_304_000)), Clock::Epoch);
    }
}
