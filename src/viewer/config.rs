use serde::{Deserialize, Serialize};

#[cfg(feature = "viewer")]
use super::ViewerError;

/// What a recording is called and will hold.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Contents {
    /// Name in the viewer's list, and the identity of a recording in a file: viewers merge
    /// recordings of the same name.
    pub name: String,
    /// Whether there will be truth, and so errors to plot.
    pub truth: bool,
    /// Whether there will be IMU samples.
    pub imu: bool,
}

/// What one wants to see first when a recording is opened; the others are a click away.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Purpose {
    /// Where the run went and what the camera saw.
    #[default]
    Overview,
    /// What the filter believed, and whether it was right.
    Uncertainty,
    /// Where the time went.
    Timing,
}

impl Purpose {
    pub const ALL: [Self; 3] = [Self::Overview, Self::Uncertainty, Self::Timing];

    pub fn name(self) -> &'static str {
        match self {
            Self::Overview => "overview",
            Self::Uncertainty => "uncertainty",
            Self::Timing => "timing",
        }
    }
}

impl std::str::FromStr for Purpose {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Self::ALL.into_iter().find(|purpose| purpose.name() == text).ok_or_else(|| {
            let names = Self::ALL.map(Self::name);
            format!("unknown blueprint `{text}`; there are: {}", names.join(", "))
        })
    }
}

/// What the colors of map points tell.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MapColor {
    /// Standard deviation of the position.
    #[default]
    Sigma,
    /// Frames since the point was inserted.
    Age,
}

/// What goes into a recording, and how often.
///
/// The size of a recording is nearly all images: at 640x480 30 to 60 kB a color image and 150 to
/// 350 kB a depth image, the more the noisier; with the defaults 5 minutes at 30 Hz take less than
/// 300 MB.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RecordingConfig {
    /// What the recording opens with.
    pub blueprint: Purpose,
    /// Record the color image and the key points of every n-th frame; 0: of none.
    pub image_every: u64,
    /// JPEG quality of color images, 1 (smallest) to 100 (best).
    pub jpeg_quality: u8,
    /// Record the depth image of every n-th frame; 0: of none.
    pub depth_every: u64,
    /// Record the map at every n-th frame; 0: never.
    pub map_every: u64,
    /// What the colors of map points tell.
    pub map_color: MapColor,
    /// With the map, record the 3 sigma ellipsoids of so many of its newest points; 0: of none.
    pub map_ellipsoids: usize,
    /// Record the density of the attitude and the correlations of the pose at every n-th frame;
    /// 0: never.
    pub belief_every: u64,
    /// Record every n-th IMU sample; 0: none.
    pub imu_every: u64,
    /// Frames that may wait to be written, at least 1. When as many wait, a recording into a file
    /// holds the estimator up; a live view goes without the images of the frame instead.
    pub queue_length: usize,
}

impl Default for RecordingConfig {
    fn default() -> Self {
        Self {
            blueprint: Purpose::Overview,
            image_every: 3,
            jpeg_quality: 70,
            depth_every: 60,
            map_every: 30,
            map_color: MapColor::Sigma,
            map_ellipsoids: 300,
            belief_every: 6,
            imu_every: 2,
            queue_length: 16,
        }
    }
}

impl RecordingConfig {
    #[cfg(feature = "viewer")]
    /// Whether the report of frame number `frame` should carry the map.
    pub fn wants_map(&self, frame: u64) -> bool {
        is_due(frame, self.map_every)
    }

    /// # Errors
    /// [`ViewerError::Config`](super::ViewerError::Config) names the first value that is out of range.
    #[cfg(feature = "viewer")]
    pub fn validate(&self) -> Result<(), ViewerError> {
        if !(1..=100).contains(&self.jpeg_quality) {
            return Err(ViewerError::Config {
                key: "jpeg_quality",
                value: self.jpeg_quality.into(),
                expected: "1 to 100",
            });
        }
        if self.queue_length == 0 {
            return Err(ViewerError::Config {
                key: "queue_length",
                value: 0,
                expected: "at least 1",
            });
        }
        Ok(())
    }
}

/// Whether the `index`-th of a sequence is one of every `every`; `every = 0` is never.
#[cfg(feature = "viewer")]
pub(super) fn is_due(index: u64, every: u64) -> bool {
    every != 0 && index.is_multiple_of(every)
}

#[cfg(all(test, feature = "viewer"))]
mod tests {
    use super::*;

    #[test]
    fn zero_is_never_and_one_is_always() {
        assert!((0..10).all(|index| !is_due(index, 0) && is_due(index, 1)));
        assert_eq!((0..10).filter(|&index| is_due(index, 3)).count(), 4);
    }

    #[test]
    fn values_out_of_range_are_named() {
        for (config, key) in [
            (RecordingConfig { jpeg_quality: 0, ..Default::default() }, "recording.jpeg_quality"),
            (RecordingConfig { jpeg_quality: 101, ..Default::default() }, "recording.jpeg_quality"),
            (RecordingConfig { queue_length: 0, ..Default::default() }, "recording.queue_length"),
        ] {
            let message = config.validate().unwrap_err().to_string();
            assert!(message.contains(key), "{message}");
        }
        RecordingConfig::default().validate().unwrap();
    }
}
