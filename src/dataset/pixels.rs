//! Pixels as they are logged, to [`ColorImage`] and [`DepthImage`].

use std::io::Cursor;

use image::{DynamicImage, ImageFormat, ImageReader, Limits};

use super::LogConfig;
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
const LARGEST_IMAGE: u64 = 150 << 20;

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

    fn is_packed(&self, pixel_size: usize) -> bool {
        self.step == 0 || self.step as usize == self.width as usize * pixel_size
    }

    /// All bytes in row order: one copy of the message.
    fn packed(&self, pixel_size: usize) -> Result<Vec<u8>, Rejection> {
        let rows = self.rows(pixel_size)?;
        let length = self.width as usize * self.height as usize * pixel_size;
        if self.is_packed(pixel_size) {
            return Ok(self.data[..length].to_vec());
        }
        let mut bytes = Vec::with_capacity(length);
        rows.for_each(|row| bytes.extend_from_slice(row));
        Ok(bytes)
    }
}

/// Channel layout of a color encoding; `None` if it is none that is read.
pub(super) fn color_format(encoding: &str, config: &LogConfig) -> Option<PixelFormat> {
    match encoding {
        "rgb8" => Some(PixelFormat::Rgb8),
        "bgr8" => Some(PixelFormat::Bgr8),
        "8UC3" if config.color_8uc3 == "rgb" => Some(PixelFormat::Rgb8),
        "8UC3" => Some(PixelFormat::Bgr8),
        "mono8" | "8UC1" => Some(PixelFormat::Mono8),
        _ => None,
    }
}

pub(super) fn is_depth_encoding(encoding: &str) -> bool {
    matches!(encoding, "16UC1" | "mono16" | "32FC1")
}

pub(super) fn raw_color(raw: &RawImage, config: &LogConfig) -> Result<ColorImage, Rejection> {
    let format = color_format(raw.encoding, config)
        .ok_or_else(|| Rejection::new("unsupported encoding", raw.encoding))?;
    let data = raw.packed(format.channels())?;
    new_color(raw.width, raw.height, format, data)
}

pub(super) fn raw_depth(raw: &RawImage, config: &LogConfig) -> Result<DepthImage, Rejection> {
    match raw.encoding {
        "16UC1" | "mono16" => {
            let read = if raw.big_endian { u16::from_be_bytes } else { u16::from_le_bytes };
            let mut data = values(raw, read)?;
            clear_invalid(&mut data, config);
            new_depth(raw.width, raw.height, config.depth_scale as f32, data)
        }
        "32FC1" => {
            let read = if raw.big_endian { f32::from_be_bytes } else { f32::from_le_bytes };
            let data = values(raw, |bytes| millimetres(read(bytes)))?;
            new_depth(raw.width, raw.height, FLOAT_DEPTH_SCALE, data)
        }
        other => Err(Rejection::new("unsupported encoding", other)),
    }
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

/// A JPEG or PNG file in memory.
pub(super) fn compressed_color(bytes: &[u8]) -> Result<ColorImage, Rejection> {
    let image = decompress(bytes)?;
    let (width, height) = (image.width(), image.height());
    match image {
        DynamicImage::ImageLuma8(grey) => {
            new_color(width, height, PixelFormat::Mono8, grey.into_raw())
        }
        DynamicImage::ImageRgb8(color) => {
            new_color(width, height, PixelFormat::Rgb8, color.into_raw())
        }
        DynamicImage::ImageRgba8(_) => {
            new_color(width, height, PixelFormat::Rgb8, image.into_rgb8().into_raw())
        }
        other => Err(Rejection::new("unsupported encoding", format!("{:?}", other.color()))),
    }
}

/// A PNG file of 16 bits in memory.
pub(super) fn compressed_depth(bytes: &[u8], config: &LogConfig) -> Result<DepthImage, Rejection> {
    let image = decompress(bytes)?;
    let (width, height) = (image.width(), image.height());
    let DynamicImage::ImageLuma16(depth) = image else {
        return Err(Rejection::new("unsupported encoding", format!("{:?}", image.color())));
    };
    let mut data = depth.into_raw();
    clear_invalid(&mut data, config);
    new_depth(width, height, config.depth_scale as f32, data)
}

/// Width and height of a JPEG or PNG file in memory, by its head.
pub(super) fn compressed_size(bytes: &[u8]) -> Option<(u32, u32)> {
    compressed(bytes).ok()?.into_dimensions().ok()
}

fn decompress(bytes: &[u8]) -> Result<DynamicImage, Rejection> {
    compressed(bytes)?
        .decode()
        .map_err(|error| Rejection::new("cannot be decompressed", error.to_string()))
}

fn compressed(bytes: &[u8]) -> Result<ImageReader<Cursor<&[u8]>>, Rejection> {
    let format = match bytes {
        [0xff, 0xd8, ..] => ImageFormat::Jpeg,
        [0x89, b'P', b'N', b'G', ..] => ImageFormat::Png,
        _ => return Err(Rejection::new("neither JPEG nor PNG", "")),
    };
    let mut limits = Limits::default();
    limits.max_alloc = Some(LARGEST_IMAGE);
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    reader.limits(limits);
    Ok(reader)
}

fn new_color(
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

    fn png(image: DynamicImage) -> Vec<u8> {
        let mut bytes = Cursor::new(Vec::new());
        image.write_to(&mut bytes, ImageFormat::Png).unwrap();
        bytes.into_inner()
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
        assert_eq!(color(raw("bayer_rggb8", (2, 2), &[0; 4])), "unsupported encoding");
        let narrow = RawImage { step: 5, ..raw("rgb8", (2, 2), &[0; 100]) };
        assert_eq!(color(narrow), "row step too short");
        assert_eq!(
            reason(raw_depth(&raw("rgb8", (1, 1), &[0; 3]), &config)),
            "unsupported encoding"
        );
        assert_eq!(reason(raw_depth(&raw("16UC1", (2, 2), &[0; 7]), &config)), "buffer too short");
    }

    #[test]
    fn png_and_jpeg_are_decompressed() {
        let config = LogConfig::default();
        let depth = image::ImageBuffer::from_vec(2, 1, vec![1000_u16, 65535]).unwrap();
        let file = png(DynamicImage::ImageLuma16(depth));
        assert_eq!(compressed_depth(&file, &config).unwrap().data(), [1000, 0]);
        assert_eq!(reason(compressed_color(&file)), "unsupported encoding");
        let color = image::RgbImage::from_pixel(8, 8, image::Rgb([200, 100, 50]));
        let file = png(DynamicImage::ImageRgb8(color.clone()));
        assert_eq!(compressed_color(&file).unwrap().data(), color.as_raw());
        let mut jpeg = Cursor::new(Vec::new());
        DynamicImage::ImageRgb8(color).write_to(&mut jpeg, ImageFormat::Jpeg).unwrap();
        let image = compressed_color(jpeg.get_ref()).unwrap();
        assert!(image.format() == PixelFormat::Rgb8 && image.data()[0].abs_diff(200) < 4);
    }

    #[test]
    fn damaged_files_are_rejected() {
        let grey = image::GrayImage::from_pixel(64, 64, image::Luma([9]));
        let file = png(DynamicImage::ImageLuma8(grey));
        assert_eq!(reason(compressed_color(&file[..40])), "cannot be decompressed");
        assert_eq!(reason(compressed_color(b"GIF89a")), "neither JPEG nor PNG");
        // A header that claims 65535 x 65535 pixels.
        let mut huge = file;
        huge[16..24].copy_from_slice(&[0, 0, 255, 255, 0, 0, 255, 255]);
        assert_eq!(reason(compressed_color(&huge)), "cannot be decompressed");
    }
}
