//! Pixels as they are logged, to [`ColorImage`] and [`DepthImage`].

use super::LogConfig;
use super::demosaic::{bayer_to_rgb, yuv420_to_rgb, yuv422_to_rgb};
use super::encoding::{ColorEncoding, DepthEncoding, Order, SUPPORTED_COLOR, SUPPORTED_DEPTH};
use crate::sensor::{ColorImage, DepthImage, PixelFormat};

/// Why a message was left out: a fixed reason to count by, and what was wrong in this one.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Rejection {
    pub reason: &'static str,
    pub detail: String,
}

impl Rejection {
    pub fn new(reason: &'static str, detail: impl Into<String>) -> Self {
        Self { reason, detail: detail.into() }
    }
}

/// Raw pixels as in `sensor_msgs/Image`, borrowed from the message.
#[derive(Debug, Clone, Copy)]
pub(super) struct RawImage<'a> {
    pub width: u32,
    pub height: u32,
    pub encoding: &'a str,
    pub big_endian: bool,
    /// Bytes a row; 0 means no padding.
    pub step: u32,
    pub data: &'a [u8],
}

/// Decoded images may take at most this much memory, bytes (a color image of 50 megapixels).
pub(super) const LARGEST_IMAGE: u64 = 150 << 20;

/// Metres per unit of depth images that were logged in floating-point metres.
const FLOAT_DEPTH_SCALE: f32 = 0.001;

impl<'a> RawImage<'a> {
    /// The rows without their padding, once all are known to lie inside the buffer.
    fn rows(
        &self,
        pixel_size: usize,
    ) -> Result<impl Iterator<Item = &'a [u8]> + use<'a>, Rejection> {
        let (width, height) = (self.width as usize, self.height as usize);
        if width == 0 || height == 0 {
            return Err(Rejection::new("no pixels", format!("{width}x{height}")));
        }
        let size = || {
            let row = width.checked_mul(pixel_size)?;
            let step = if self.step == 0 { row } else { self.step as usize };
            Some((row, step, step.checked_mul(height - 1)?.checked_add(row)?))
        };
        let Some((row, step, needed)) = size() else {
            return Err(Rejection::new("absurd size", format!("{width}x{height}")));
        };
        // A step that contradicts the rest of the message is wrong where the rows fill it exactly.
        let step = if self.data.len() == row * height { row } else { step };
        if step < row {
            let detail = format!("step {step} for {width} pixels of {pixel_size} bytes");
            return Err(Rejection::new("row step too short", detail));
        }
        if self.data.len() < needed {
            let detail = format!("{} of {needed} bytes", self.data.len());
            return Err(Rejection::new("buffer too short", detail));
        }
        Ok(self.data.chunks(step).take(height).map(move |padded| &padded[..row]))
    }

    /// All bytes in row order: one copy of the message.
    fn packed(&self, pixel_size: usize) -> Result<Vec<u8>, Rejection> {
        let rows = self.rows(pixel_size)?;
        let length = self.width as usize * self.height as usize * pixel_size;
        let mut bytes = Vec::with_capacity(length);
        rows.for_each(|row| bytes.extend_from_slice(row));
        Ok(bytes)
    }
}

/// The reason to leave out an image of an encoding that is not read.
pub(super) fn unsupported(encoding: &str, supported: &str) -> Rejection {
    let detail =
        format!("encoding {} is not supported; supported are {supported}", encoding.trim());
    Rejection::new("unsupported encoding", detail)
}

pub(super) fn raw_color(raw: &RawImage, config: &LogConfig) -> Result<ColorImage, Rejection> {
    let encoding = ColorEncoding::parse(raw.encoding, config)
        .ok_or_else(|| unsupported(raw.encoding, SUPPORTED_COLOR))?;
    let size = (raw.width as usize, raw.height as usize);
    let (format, data) = match encoding {
        ColorEncoding::Channels { order, bytes } => channels(raw, order, bytes)?,
        ColorEncoding::Bayer { first, bytes } => {
            let mosaic = bytes_of(raw, 1, bytes)?;
            (PixelFormat::Rgb8, bayer_to_rgb(&mosaic, size, first))
        }
        ColorEncoding::Yuv422(order) => {
            require_even(raw, false)?;
            (PixelFormat::Rgb8, yuv422_to_rgb(&raw.packed(2)?, order))
        }
        ColorEncoding::Yuv420 { u_first } => {
            require_even(raw, true)?;
            let planes = RawImage { height: raw.height / 2 * 3, ..*raw }.packed(1)?;
            let (luminance, chroma) = planes.split_at(size.0 * size.1);
            (PixelFormat::Rgb8, yuv420_to_rgb(luminance, chroma, size.0, u_first))
        }
    };
    new_color(raw.width, raw.height, format, data)
}

fn require_even(raw: &RawImage, height_too: bool) -> Result<(), Rejection> {
    let is_even = raw.width.is_multiple_of(2) && (!height_too || raw.height.is_multiple_of(2));
    let detail = || format!("{}x{} pixels of {}", raw.width, raw.height, raw.encoding);
    is_even
        .then_some(())
        .ok_or_else(|| Rejection::new("odd size of an image with shared chroma", detail()))
}

/// Channels as they are, without an opaque fourth one.
fn channels(
    raw: &RawImage,
    order: Order,
    bytes: usize,
) -> Result<(PixelFormat, Vec<u8>), Rejection> {
    let data = bytes_of(raw, order.channels(), bytes)?;
    Ok(match order {
        Order::Grey => (PixelFormat::Mono8, data),
        Order::Rgb => (PixelFormat::Rgb8, data),
        Order::Bgr => (PixelFormat::Bgr8, data),
        Order::Rgba => (PixelFormat::Rgb8, first_three(&data)),
        Order::Bgra => (PixelFormat::Bgr8, first_three(&data)),
    })
}

fn first_three(data: &[u8]) -> Vec<u8> {
    let mut kept = Vec::with_capacity(data.len() / 4 * 3);
    for [first, second, third, _] in data.as_chunks::<4>().0 {
        kept.extend([*first, *second, *third]);
    }
    kept
}

/// One byte a channel; of values of 16 bits 65535 becomes 255.
fn bytes_of(raw: &RawImage, channels: usize, bytes: usize) -> Result<Vec<u8>, Rejection> {
    if bytes == 1 {
        return raw.packed(channels);
    }
    let read = if raw.big_endian { u16::from_be_bytes } else { u16::from_le_bytes };
    let values = raw.packed(2 * channels)?;
    Ok(values.as_chunks::<2>().0.iter().map(|value| to_byte(read(*value))).collect())
}

fn to_byte(value: u16) -> u8 {
    ((u32::from(value) * 255 + 32767) / 65535) as u8
}

pub(super) fn raw_depth(raw: &RawImage, config: &LogConfig) -> Result<DepthImage, Rejection> {
    match DepthEncoding::parse(raw.encoding) {
        Some(DepthEncoding::U16) => {
            let read = if raw.big_endian { u16::from_be_bytes } else { u16::from_le_bytes };
            depth_of_units(raw.width, raw.height, values(raw, read)?, config)
        }
        Some(DepthEncoding::F32) => {
            let read = if raw.big_endian { f32::from_be_bytes } else { f32::from_le_bytes };
            let data = values(raw, |bytes| millimetres(read(bytes)))?;
            new_depth(raw.width, raw.height, FLOAT_DEPTH_SCALE, data)
        }
        None => Err(unsupported(raw.encoding, SUPPORTED_DEPTH)),
    }
}

/// Depth in the configured unit, what means "none" there cleared.
pub(super) fn depth_of_units(
    width: u32,
    height: u32,
    mut data: Vec<u16>,
    config: &LogConfig,
) -> Result<DepthImage, Rejection> {
    clear_invalid(&mut data, config);
    new_depth(width, height, config.depth_scale as f32, data)
}

/// Depth in metres; what is no distance, or too far for 16 bits, becomes none.
pub(super) fn depth_of_metres(
    width: u32,
    height: u32,
    metres: impl Iterator<Item = f32>,
) -> Result<DepthImage, Rejection> {
    new_depth(width, height, FLOAT_DEPTH_SCALE, metres.map(millimetres).collect())
}

fn values<const N: usize>(
    raw: &RawImage,
    read: impl Fn([u8; N]) -> u16,
) -> Result<Vec<u16>, Rejection> {
    let rows = raw.rows(N)?;
    let mut values = Vec::with_capacity(raw.width as usize * raw.height as usize);
    for row in rows {
        values.extend(row.as_chunks::<N>().0.iter().map(|bytes| read(*bytes)));
    }
    Ok(values)
}

/// 0 for what is no distance (NaN, infinite, negative) or too far for 16 bits.
fn millimetres(metres: f32) -> u16 {
    let units = (metres / FLOAT_DEPTH_SCALE).round();
    if units >= 0.0 && units <= f32::from(u16::MAX) { units as u16 } else { 0 }
}

fn clear_invalid(data: &mut [u16], config: &LogConfig) {
    for invalid in &config.depth_invalid {
        for value in data.iter_mut() {
            *value = if *value == *invalid { 0 } else { *value };
        }
    }
}

pub(super) fn new_color(
    width: u32,
    height: u32,
    format: PixelFormat,
    data: Vec<u8>,
) -> Result<ColorImage, Rejection> {
    ColorImage::new(width as usize, height as usize, format, data)
        .ok_or_else(|| Rejection::new("absurd size", format!("{width}x{height}")))
}

fn new_depth(width: u32, height: u32, scale: f32, data: Vec<u16>) -> Result<DepthImage, Rejection> {
    DepthImage::new(width as usize, height as usize, scale, data)
        .ok_or_else(|| Rejection::new("absurd size", format!("{width}x{height}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn raw<'a>(encoding: &'a str, (width, height): (u32, u32), data: &'a [u8]) -> RawImage<'a> {
        RawImage { width, height, encoding, big_endian: false, step: 0, data }
    }

    fn reason<T: std::fmt::Debug>(result: Result<T, Rejection>) -> &'static str {
        result.unwrap_err().reason
    }

    #[test]
    fn channel_order_follows_the_encoding_and_8uc3_the_configuration() {
        let rgb = LogConfig { color_8uc3: "rgb".to_owned(), ..LogConfig::default() };
        for (encoding, config, format) in [
            ("rgb8", &LogConfig::default(), PixelFormat::Rgb8),
            ("bgr8", &LogConfig::default(), PixelFormat::Bgr8),
            ("8UC3", &LogConfig::default(), PixelFormat::Bgr8),
            ("8UC3", &rgb, PixelFormat::Rgb8),
        ] {
            let image = raw_color(&raw(encoding, (2, 1), &[1, 2, 3, 4, 5, 6]), config).unwrap();
            assert_eq!((image.format(), image.data()), (format, &[1, 2, 3, 4, 5, 6][..]));
        }
        for encoding in ["mono8", "8UC1"] {
            let image = raw_color(&raw(encoding, (2, 1), &[1, 2]), &LogConfig::default()).unwrap();
            assert_eq!(image.format(), PixelFormat::Mono8);
        }
    }

    #[test]
    fn wider_pixels_become_three_bytes_or_one() {
        let config = LogConfig::default();
        let check = |encoding: &str, size, data: &[u8], format, expected: &[u8]| {
            let image = raw_color(&raw(encoding, size, data), &config).unwrap();
            assert_eq!((image.format(), image.data()), (format, expected), "{encoding}");
        };
        check("bgra8", (2, 1), &[1, 2, 3, 9, 4, 5, 6, 9], PixelFormat::Bgr8, &[1, 2, 3, 4, 5, 6]);
        check("RGBA8", (1, 1), &[1, 2, 3, 9], PixelFormat::Rgb8, &[1, 2, 3]);
        check("8UC4", (1, 1), &[1, 2, 3, 9], PixelFormat::Bgr8, &[1, 2, 3]);
        // 65535 / 257 = 255, 0x0180 / 257 = 1.49.
        check("mono16", (2, 1), &[0xff, 0xff, 0x80, 0x01], PixelFormat::Mono8, &[255, 1]);
        check("rgb16", (1, 1), &[0, 0, 1, 1, 2, 2], PixelFormat::Rgb8, &[0, 1, 2]);
        check("bayer_rggb16", (1, 1), &[0, 7], PixelFormat::Rgb8, &[7; 3]);
        check("yuv422", (2, 1), &[128, 16, 128, 235], PixelFormat::Rgb8, &[0, 0, 0, 255, 255, 255]);
        check("nv21", (2, 2), &[16, 16, 16, 16, 128, 128], PixelFormat::Rgb8, &[0; 12]);
        let big = RawImage { big_endian: true, ..raw("mono16", (1, 1), &[7, 0]) };
        assert_eq!(raw_color(&big, &config).unwrap().data(), [7]);
    }

    #[test]
    fn row_padding_is_dropped() {
        let config = LogConfig::default();
        // The last row may lack its padding.
        let padded = RawImage { step: 4, ..raw("mono8", (3, 2), &[1, 2, 3, 0, 4, 5, 6]) };
        assert_eq!(raw_color(&padded, &config).unwrap().data(), [1, 2, 3, 4, 5, 6]);
        let padded = RawImage { step: 3, ..raw("16UC1", (1, 2), &[1, 0, 9, 2, 0, 9]) };
        assert_eq!(raw_depth(&padded, &config).unwrap().data(), [1, 2]);
    }

    #[test]
    fn depth_is_read_in_either_byte_order_and_invalid_values_are_cleared() {
        let config = LogConfig { depth_invalid: vec![65535, 7], ..LogConfig::default() };
        let little = raw("16UC1", (3, 1), &[0xe8, 0x03, 0xff, 0xff, 7, 0]);
        let depth = raw_depth(&little, &config).unwrap();
        assert_eq!((depth.data(), depth.at(0, 0)), (&[1000, 0, 0][..], Some(1.0)));
        let big = RawImage { big_endian: true, ..raw("mono16", (2, 1), &[3, 0xe8, 0, 7]) };
        assert_eq!(raw_depth(&big, &config).unwrap().data(), [1000, 0]);
    }

    #[test]
    fn float_depth_is_kept_to_the_millimetre() {
        let metres = [1.2344_f32, 65.535, 0.0004, f32::NAN, f32::INFINITY, -1.0, 65.536, f32::MIN];
        let bytes: Vec<u8> = metres.iter().flat_map(|m| m.to_le_bytes()).collect();
        // The factor of 16-bit images does not apply.
        let config = LogConfig { depth_scale: 0.0002, ..LogConfig::default() };
        let depth = raw_depth(&raw("32FC1", (8, 1), &bytes), &config).unwrap();
        assert_eq!(depth.data(), [1234, 65535, 0, 0, 0, 0, 0, 0]);
        assert_eq!(depth.scale(), 0.001);
    }

    #[test]
    fn images_that_do_not_fit_their_buffer_are_rejected() {
        let config = LogConfig::default();
        let color = |raw: RawImage| reason(raw_color(&raw, &config));
        assert_eq!(color(raw("rgb8", (2, 2), &[0; 11])), "buffer too short");
        assert_eq!(color(raw("rgb8", (u32::MAX, u32::MAX), &[0; 11])), "absurd size");
        assert_eq!(color(raw("mono8", (u32::MAX, 1), &[0; 11])), "buffer too short");
        assert_eq!(color(raw("rgb8", (0, 2), &[])), "no pixels");
        assert_eq!(color(raw("8SC3", (2, 2), &[0; 12])), "unsupported encoding");
        assert_eq!(color(raw("nv12", (2, 2), &[0; 5])), "buffer too short");
        for encoding in ["nv12", "yuv422"] {
            let odd = color(raw(encoding, (3, 2), &[0; 12]));
            assert_eq!(odd, "odd size of an image with shared chroma");
        }
        let narrow = RawImage { step: 5, ..raw("rgb8", (2, 2), &[0; 100]) };
        assert_eq!(color(narrow), "row step too short");
        // The rows alone fill the buffer: it is the step that is wrong.
        let pixels = [1, 0, 2, 0, 3, 0, 4, 0];
        let narrow = RawImage { step: 2, ..raw("16UC1", (2, 2), &pixels) };
        assert_eq!(raw_depth(&narrow, &config).unwrap().data(), [1, 2, 3, 4]);
        assert_eq!(
            reason(raw_depth(&raw("rgb8", (1, 1), &[0; 3]), &config)),
            "unsupported encoding"
        );
        assert_eq!(reason(raw_depth(&raw("16UC1", (2, 2), &[0; 7]), &config)), "buffer too short");
    }
}
