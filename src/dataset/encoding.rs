//! Encodings of raw images, by the names of ROS: which are read, and how their bytes lie.
//!
//! Names: `sensor_msgs/image_encodings.hpp`. They are compared without regard to case, as drivers
//! write `BGRA8` and `bgra8` alike.

use super::LogConfig;

/// How the pixels of a color or grey image lie.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ColorEncoding {
    /// Channels one after the other.
    Channels { order: Order, bytes: usize },
    /// One channel a pixel under a mosaic of color filters.
    Bayer { first: BayerPattern, bytes: usize },
    /// Two pixels share their chroma.
    Yuv422(YuvOrder),
    /// A plane of luminance, then one of chroma at half the size, U first or V first.
    Yuv420 { u_first: bool },
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Order {
    Grey,
    Rgb,
    Bgr,
    Rgba,
    Bgra,
}

/// Colors of the first two pixels of the first two rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum BayerPattern {
    Rggb,
    Bggr,
    Gbrg,
    Grbg,
}

/// Order of luminance and chroma bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum YuvOrder {
    Uyvy,
    Yuyv,
}

/// What a depth image's values are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum DepthEncoding {
    /// Unsigned, of the configured unit.
    U16,
    /// Metres.
    F32,
}

pub(super) const SUPPORTED_COLOR: &str = "rgb8, bgr8, rgba8, bgra8, rgb16, bgr16, rgba16, bgra16, \
    mono8, mono16, 8UC1, 8UC3, 8UC4, bayer_*8, bayer_*16, yuv422 (uyvy), yuv422_yuy2 (yuyv), nv12, \
    nv21, and JPEG and PNG";

pub(super) const SUPPORTED_DEPTH: &str = "16UC1, mono16, 32FC1, PNG of 16 bits, and \
    compressedDepth (PNG or RVL) of 16UC1 and 32FC1";

impl Order {
    pub fn channels(self) -> usize {
        match self {
            Self::Grey => 1,
            Self::Rgb | Self::Bgr => 3,
            Self::Rgba | Self::Bgra => 4,
        }
    }
}

impl ColorEncoding {
    /// `None` if it is none that is read as color or grey. `16UC1` is depth, and so is `mono16`
    /// where nothing else is: that is for the caller to tell.
    pub fn parse(name: &str, config: &LogConfig) -> Option<Self> {
        use Order::*;
        let is_rgb = config.color_8uc3 == "rgb";
        let name = name.trim().to_ascii_lowercase();
        let (order, bytes) = match name.as_str() {
            "rgb8" => (Rgb, 1),
            "bgr8" => (Bgr, 1),
            "8uc3" => (if is_rgb { Rgb } else { Bgr }, 1),
            "rgba8" => (Rgba, 1),
            "bgra8" => (Bgra, 1),
            "8uc4" => (if is_rgb { Rgba } else { Bgra }, 1),
            "mono8" | "8uc1" => (Grey, 1),
            "rgb16" => (Rgb, 2),
            "bgr16" => (Bgr, 2),
            "rgba16" => (Rgba, 2),
            "bgra16" => (Bgra, 2),
            "mono16" => (Grey, 2),
            other => return Self::subsampled(other),
        };
        Some(Self::Channels { order, bytes })
    }

    fn subsampled(name: &str) -> Option<Self> {
        if let Some(pattern) = name.strip_prefix("bayer_") {
            let (first, bytes) = match pattern.split_at_checked(4)? {
                (first, "8") => (first, 1),
                (first, "16") => (first, 2),
                _ => return None,
            };
            let first = match first {
                "rggb" => BayerPattern::Rggb,
                "bggr" => BayerPattern::Bggr,
                "gbrg" => BayerPattern::Gbrg,
                "grbg" => BayerPattern::Grbg,
                _ => return None,
            };
            return Some(Self::Bayer { first, bytes });
        }
        Some(match name {
            "yuv422" | "uyvy" => Self::Yuv422(YuvOrder::Uyvy),
            "yuv422_yuy2" | "yuyv" | "yuy2" => Self::Yuv422(YuvOrder::Yuyv),
            "nv12" => Self::Yuv420 { u_first: true },
            "nv21" => Self::Yuv420 { u_first: false },
            _ => return None,
        })
    }

    /// Whether it has no color.
    pub fn is_grey(self) -> bool {
        matches!(self, Self::Channels { order: Order::Grey, .. })
    }
}

impl DepthEncoding {
    /// `None` if it is none that is read as depth.
    pub fn parse(name: &str) -> Option<Self> {
        match name.trim().to_ascii_lowercase().as_str() {
            "16uc1" | "mono16" => Some(Self::U16),
            "32fc1" => Some(Self::F32),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_name_that_is_called_supported_is() {
        let config = LogConfig::default();
        let names = SUPPORTED_COLOR.split(", and").next().unwrap();
        for name in names.split(", ").flat_map(|name| name.split([' ', '(', ')'])) {
            for pattern in ["rggb", "bggr", "gbrg", "grbg"] {
                let name = name.trim().replace('*', pattern);
                let is_known = name.is_empty() || ColorEncoding::parse(&name, &config).is_some();
                assert!(is_known, "{name}");
                assert_eq!(
                    ColorEncoding::parse(&name.to_uppercase(), &config),
                    ColorEncoding::parse(&name, &config)
                );
            }
        }
        for name in ["16UC1", "mono16", "32FC1", "32fc1"] {
            assert!(DepthEncoding::parse(name).is_some());
        }
        for name in ["", "bayer_", "bayer_rggb12", "16SC1", "64FC1", "h264", "yuv444"] {
            assert_eq!(ColorEncoding::parse(name, &config), None, "{name}");
        }
    }
}
