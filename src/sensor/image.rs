//! Images as plain values: what a log yields and a front end takes.

/// Order of the channels of a [`ColorImage`]; one byte a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PixelFormat {
    Mono8,
    Rgb8,
    Bgr8,
}

impl PixelFormat {
    pub const fn channels(self) -> usize {
        match self {
            Self::Mono8 => 1,
            Self::Rgb8 | Self::Bgr8 => 3,
        }
    }
}

/// A color or grey image, rows from the top, without padding.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ColorImage {
    width: usize,
    height: usize,
    format: PixelFormat,
    data: Vec<u8>,
}

impl ColorImage {
    /// `None` unless `data` holds exactly `width * height * channels` bytes and is not empty.
    pub fn new(width: usize, height: usize, format: PixelFormat, data: Vec<u8>) -> Option<Self> {
        let expected = width.checked_mul(height)?.checked_mul(format.channels())?;
        (expected > 0 && data.len() == expected).then_some(Self { width, height, format, data })
    }

    pub fn width(&self) -> usize {
        self.width
    }

    pub fn height(&self) -> usize {
        self.height
    }

    pub fn format(&self) -> PixelFormat {
        self.format
    }

    pub fn data(&self) -> &[u8] {
        &self.data
    }
}

/// A depth image registered pixel for pixel to its color image.
///
/// Values are kept as logged (16 bit) with the factor that makes them metres; 0 is "no depth".
#[derive(Debug, Clone, PartialEq)]
pub struct DepthImage {
    width: usize,
    height: usize,
    /// Metres per unit.
    scale: f32,
    data: Vec<u16>,
}

impl DepthImage {
    /// `None` unless `data` holds exactly `width * height` values, is not empty and `scale` is
    /// positive and finite.
    pub fn new(width: usize, height: usize, scale: f32, data: Vec<u16>) -> Option<Self> {
        let fits = width.checked_mul(height)? == data.len() && !data.is_empty();
        (fits && scale > 0.0 && scale.is_finite()).then_some(Self { width, height, scale, data })
    }

    pub fn width(&self) -> usize {
        self.width
    }

    pub fn height(&self) -> usize {
        self.height
    }

    /// Metres per unit of [`Self::data`].
    pub fn scale(&self) -> f32 {
        self.scale
    }

    pub fn data(&self) -> &[u16] {
        &self.data
    }

    /// Depth along the optical axis in metres; `None` outside the image or where there is none.
    pub fn at(&self, column: usize, row: usize) -> Option<f32> {
        if column >= self.width || row >= self.height {
            return None;
        }
        match self.data[row * self.width + column] {
            0 => None,
            raw => Some(f32::from(raw) * self.scale),
        }
    }
}
