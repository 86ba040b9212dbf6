//! Images that are logged compressed: JPEG, PNG, and what `compressedDepth` writes.

use std::io::Cursor;

use image::{DynamicImage, ImageFormat, ImageReader, Limits};

use super::encoding::{SUPPORTED_COLOR, SUPPORTED_DEPTH};
use super::message::CompressedImage;
use super::pixels::{
    LARGEST_IMAGE, Rejection, depth_of_metres, depth_of_units, new_color, unsupported,
};
use super::{LogConfig, rvl};
use crate::sensor::{ColorImage, DepthImage, PixelFormat};

/// What precedes the data of `compressedDepth`: a number of no meaning and two parameters.
const CONFIG_HEADER: usize = 12;

const PNG: &[u8] = b"\x89PNG";
const JPEG: &[u8] = b"\xff\xd8";

/// What a compressed image is, by its format's text and its first bytes.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct CompressedHead {
    /// As the publisher calls it, with what its bytes add.
    pub encoding: String,
    pub size: Option<(u32, u32)>,
    pub is_depth: bool,
    /// Whether it can be decoded as what it is.
    pub is_supported: bool,
}

impl CompressedHead {
    /// # Errors
    /// If there are too few bytes to tell.
    pub fn of(image: &CompressedImage) -> Result<Self, Rejection> {
        if image.data.len() < ENOUGH {
            let detail = format!("{} bytes", image.data.len());
            return Err(Rejection::new("buffer too short", detail));
        }
        let encoding = if image.format.is_empty() { "(none)" } else { image.format }.to_owned();
        if let Ok(depth) = DepthData::of(image) {
            let size = depth.size();
            return Ok(Self { encoding, size, is_depth: true, is_supported: true });
        }
        let is_depth = is_depth_format(image.format);
        let is_known = image.data.starts_with(PNG) || image.data.starts_with(JPEG);
        let size = file_size(image.data);
        Ok(Self { encoding, size, is_depth, is_supported: !is_depth && is_known })
    }
}

/// Bytes that hold the heads of all formats.
const ENOUGH: usize = CONFIG_HEADER + 26;

/// Whether a format's text speaks of depth: `16UC1; compressedDepth png`, `32FC1; png compressed`.
fn is_depth_format(format: &str) -> bool {
    ["compresseddepth", "16uc1", "32fc1"].iter().any(|word| format.to_lowercase().contains(word))
}

/// The data of a depth image.
enum DepthData<'a> {
    /// A PNG file of 16 bits.
    Png {
        file: &'a [u8],
        inverse: Option<InverseDepth>,
    },
    Rvl {
        data: &'a [u8],
        size: (u32, u32),
        inverse: Option<InverseDepth>,
    },
}

/// Depth is `numerator / (value - offset)`, m.
#[derive(Debug, Clone, Copy, PartialEq)]
struct InverseDepth {
    numerator: f32,
    offset: f32,
}

impl<'a> DepthData<'a> {
    /// From an image that is depth by its format's text, or a bare PNG file of 16 bits.
    fn of(image: &CompressedImage<'a>) -> Result<Self, Rejection> {
        let format = image.format.to_lowercase();
        let has_header = !image.data.starts_with(PNG);
        if has_header && !format.contains("compresseddepth") {
            return Err(unsupported(image.format, SUPPORTED_DEPTH));
        }
        let (header, data) = match has_header {
            true => image.data.split_at_checked(CONFIG_HEADER).ok_or_else(|| {
                Rejection::new("buffer too short", format!("{} bytes", image.data.len()))
            })?,
            false => image.data.split_at(0),
        };
        let inverse = format.starts_with("32fc1").then(|| InverseDepth::of(header)).flatten();
        if format.starts_with("32fc1") && inverse.is_none() {
            let detail = format!("{}: no parameters of the inverse depth", image.format);
            return Err(Rejection::new("buffer too short", detail));
        }
        if data.starts_with(PNG) {
            let is_deep = is_deep_png(data);
            let png = Self::Png { file: data, inverse };
            return is_deep
                .then_some(png)
                .ok_or_else(|| unsupported(image.format, SUPPORTED_DEPTH));
        }
        if format.contains("rvl") {
            let Some((size, data)) = data.split_first_chunk::<8>() else {
                return Err(Rejection::new("buffer too short", format!("{} bytes", data.len())));
            };
            let [a, b, c, d, e, f, g, h] = *size;
            let size = (u32::from_le_bytes([a, b, c, d]), u32::from_le_bytes([e, f, g, h]));
            return Ok(Self::Rvl { data, size, inverse });
        }
        Err(unsupported(image.format, SUPPORTED_DEPTH))
    }

    fn size(&self) -> Option<(u32, u32)> {
        match self {
            Self::Png { file, .. } => file_size(file),
            Self::Rvl { size, .. } => Some(*size),
        }
    }
}

impl InverseDepth {
    fn of(header: &[u8]) -> Option<Self> {
        let number = |at: usize| Some(f32::from_le_bytes(header.get(at..at + 4)?.try_into().ok()?));
        Some(Self { numerator: number(4)?, offset: number(8)? })
    }

    /// 0 stands for none.
    fn metres(self, value: u16) -> f32 {
        if value == 0 { 0.0 } else { self.numerator / (f32::from(value) - self.offset) }
    }
}

/// Grey of 16 bits, by the head of a PNG file.
fn is_deep_png(file: &[u8]) -> bool {
    file.get(24..26) == Some(&[16, 0])
}

/// The depth image of a message: `compressedDepth` by PNG or RVL, or a PNG file of 16 bits.
pub(super) fn depth_image(
    image: &CompressedImage,
    config: &LogConfig,
) -> Result<DepthImage, Rejection> {
    let (size, values, inverse) = match DepthData::of(image)? {
        DepthData::Png { file, inverse } => {
            let (size, values) = png_values(file)?;
            (size, values, inverse)
        }
        DepthData::Rvl { data, size: (width, height), inverse } => {
            let pixels = u64::from(width) * u64::from(height);
            if pixels == 0 || pixels > LARGEST_IMAGE / 2 {
                return Err(Rejection::new("absurd size", format!("{width}x{height}")));
            }
            ((width, height), rvl::decode(data, pixels as usize)?, inverse)
        }
    };
    match inverse {
        Some(inverse) => {
            depth_of_metres(size.0, size.1, values.into_iter().map(|value| inverse.metres(value)))
        }
        None => depth_of_units(size.0, size.1, values, config),
    }
}

/// The depth image of a PNG file of 16 bits.
pub(super) fn depth_file(bytes: &[u8], config: &LogConfig) -> Result<DepthImage, Rejection> {
    let ((width, height), values) = png_values(bytes)?;
    depth_of_units(width, height, values, config)
}

fn png_values(bytes: &[u8]) -> Result<((u32, u32), Vec<u16>), Rejection> {
    let image = decompress(bytes)?;
    let size = (image.width(), image.height());
    match image {
        DynamicImage::ImageLuma16(depth) => Ok((size, depth.into_raw())),
        other => Err(unsupported(&format!("{:?}", other.color()), SUPPORTED_DEPTH)),
    }
}

/// A JPEG or PNG file in memory.
pub(super) fn color_file(bytes: &[u8]) -> Result<ColorImage, Rejection> {
    let image = decompress(bytes)?;
    let (width, height) = (image.width(), image.height());
    let is_grey = !image.color().has_color();
    match image {
        DynamicImage::ImageLuma8(grey) => {
            new_color(width, height, PixelFormat::Mono8, grey.into_raw())
        }
        other if is_grey => {
            new_color(width, height, PixelFormat::Mono8, other.into_luma8().into_raw())
        }
        other => new_color(width, height, PixelFormat::Rgb8, other.into_rgb8().into_raw()),
    }
}

/// Width and height of a JPEG or PNG file in memory, by its head.
fn file_size(bytes: &[u8]) -> Option<(u32, u32)> {
    reader(bytes).ok()?.into_dimensions().ok()
}

fn decompress(bytes: &[u8]) -> Result<DynamicImage, Rejection> {
    reader(bytes)?
        .decode()
        .map_err(|error| Rejection::new("cannot be decompressed", error.to_string()))
}

fn reader(bytes: &[u8]) -> Result<ImageReader<Cursor<&[u8]>>, Rejection> {
    let format = match bytes {
        _ if bytes.starts_with(JPEG) => ImageFormat::Jpeg,
        _ if bytes.starts_with(PNG) => ImageFormat::Png,
        _ => {
            let start = bytes[..bytes.len().min(8)].escape_ascii();
            let detail = format!("it begins with `{start}`; supported are {SUPPORTED_COLOR}");
            return Err(Rejection::new("neither JPEG nor PNG", detail));
        }
    };
    let mut limits = Limits::default();
    limits.max_alloc = Some(LARGEST_IMAGE);
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    reader.limits(limits);
    Ok(reader)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::Stamp;

    fn reason<T: std::fmt::Debug>(result: Result<T, Rejection>) -> &'static str {
        result.unwrap_err().reason
    }

    fn png(image: impl Into<DynamicImage>) -> Vec<u8> {
        let mut bytes = Cursor::new(Vec::new());
        image.into().write_to(&mut bytes, ImageFormat::Png).unwrap();
        bytes.into_inner()
    }

    fn depth_png(values: Vec<u16>) -> Vec<u8> {
        let width = values.len() as u32;
        let pixels = image::ImageBuffer::from_vec(width, 1, values).unwrap();
        png(DynamicImage::ImageLuma16(pixels))
    }

    fn message<'a>(format: &'a str, data: &'a [u8]) -> CompressedImage<'a> {
        CompressedImage { stamp: Stamp::default(), format, data }
    }

    fn read(format: &str, data: &[u8]) -> Result<Vec<u16>, Rejection> {
        let config = LogConfig::default();
        depth_image(&message(format, data), &config).map(|depth| depth.data().to_vec())
    }

    fn with_header(parameters: [f32; 2], data: &[u8]) -> Vec<u8> {
        let parameters = parameters.map(f32::to_le_bytes);
        [&[0; 4][..], &parameters[0], &parameters[1], data].concat()
    }

    #[test]
    fn depth_is_read_under_every_name_of_its_format() {
        let file = depth_png(vec![1000, 0, 65535]);
        let compressed = with_header([0.0; 2], &file);
        for format in
            ["16UC1; compressedDepth", "16UC1; compressedDepth png", "mono16; compressedDepth"]
        {
            assert_eq!(read(format, &compressed).unwrap(), [1000, 0, 0], "{format}");
            // Some publishers leave the header out.
            assert_eq!(read(format, &file).unwrap(), [1000, 0, 0], "{format}");
        }
        for format in ["png", "16UC1; png compressed ", ""] {
            assert_eq!(read(format, &file).unwrap(), [1000, 0, 0], "{format}");
            assert!(CompressedHead::of(&message(format, &file)).unwrap().is_depth);
        }
    }

    #[test]
    fn rvl_is_read() {
        let size: Vec<u8> = [3_u32, 2].iter().flat_map(|side| side.to_le_bytes()).collect();
        let data = [&size[..], &0x23c2_4510_u32.to_le_bytes()].concat();
        let data = with_header([0.0; 2], &data);
        let format = "16UC1; compressedDepth rvl";
        assert_eq!(read(format, &data).unwrap(), [0, 0, 10, 12, 9, 0]);
        let longer = [&data[..], &[0; 30]].concat();
        let head = CompressedHead::of(&message(format, &longer)).unwrap();
        assert_eq!((head.size, head.is_depth, head.is_supported), (Some((3, 2)), true, true));
        assert_eq!(reason(CompressedHead::of(&message(format, &data))), "buffer too short");
        assert_eq!(reason(read(format, &data[..15])), "buffer too short");
        let huge = with_header([0.0; 2], &[0xff; 12]);
        assert_eq!(reason(read(format, &huge)), "absurd size");
    }

    /// With the parameters that the plugin of ROS chooses for 100 quantisation steps and 10 m:
    /// A = 100 * 101, B = 1 - A / 10; a depth of 2 m is round(A / 2 + B) = 4041.
    #[test]
    fn inverse_depth_is_undone() {
        let (a, b) = (10_100.0, 1.0 - 1010.0);
        let data = with_header([a, b], &depth_png(vec![4041, 0, 1]));
        let depth = read("32FC1; compressedDepth png", &data).unwrap();
        assert_eq!(depth, [2000, 0, 10_000]);
        assert_eq!(reason(read("32FC1; compressedDepth png", &data[12..])), "buffer too short");
        // Parameters without meaning make no depth.
        let data = with_header([f32::NAN, 0.0], &depth_png(vec![4041]));
        assert_eq!(read("32FC1; compressedDepth png", &data).unwrap(), [0]);
    }

    #[test]
    fn depth_that_is_lossy_is_refused() {
        let mut jpeg = Cursor::new(Vec::new());
        let grey = image::GrayImage::from_pixel(8, 8, image::Luma([9]));
        DynamicImage::from(grey.clone()).write_to(&mut jpeg, ImageFormat::Jpeg).unwrap();
        let message = message("16UC1; jpeg compressed ", jpeg.get_ref());
        let error = depth_image(&message, &LogConfig::default()).unwrap_err();
        assert_eq!(error.reason, "unsupported encoding");
        assert!(error.detail.starts_with("encoding 16UC1; jpeg compressed is not supported"));
        let head = CompressedHead::of(&message).unwrap();
        assert!(head.is_depth && !head.is_supported);
        assert_eq!(reason(read("16UC1; compressedDepth", &png(grey))), "unsupported encoding");
    }

    #[test]
    fn color_files_are_read() {
        let color = image::RgbImage::from_pixel(8, 8, image::Rgb([200, 100, 50]));
        let file = png(color.clone());
        assert_eq!(color_file(&file).unwrap().data(), color.as_raw());
        let mut jpeg = Cursor::new(Vec::new());
        DynamicImage::from(color).write_to(&mut jpeg, ImageFormat::Jpeg).unwrap();
        let image = color_file(jpeg.get_ref()).unwrap();
        assert!(image.format() == PixelFormat::Rgb8 && image.data()[0].abs_diff(200) < 4);
        let head =
            CompressedHead::of(&message("bgr8; jpeg compressed bgr8", jpeg.get_ref())).unwrap();
        assert_eq!((head.size, head.is_depth, head.is_supported), (Some((8, 8)), false, true));
        let transparent = image::RgbaImage::from_pixel(1, 1, image::Rgba([1, 2, 3, 0]));
        assert_eq!(color_file(&png(transparent)).unwrap().data(), [1, 2, 3]);
        assert_eq!(color_file(&depth_png(vec![65535, 257])).unwrap().data(), [255, 1]);
    }

    #[test]
    fn damaged_files_are_rejected() {
        let file = png(image::GrayImage::from_pixel(64, 64, image::Luma([9])));
        assert_eq!(reason(color_file(&file[..40])), "cannot be decompressed");
        assert_eq!(reason(color_file(b"GIF89a")), "neither JPEG nor PNG");
        // A header that claims 65535 x 65535 pixels.
        let mut huge = file;
        huge[16..24].copy_from_slice(&[0, 0, 255, 255, 0, 0, 255, 255]);
        assert_eq!(reason(color_file(&huge)), "cannot be decompressed");
    }

    proptest::proptest! {
        #[test]
        fn no_bytes_panic(data: Vec<u8>, rvl: bool) {
            let format = if rvl { "16UC1; compressedDepth rvl" } else { "32FC1; compressedDepth" };
            let _ = read(format, &data);
            let _ = CompressedHead::of(&message(format, &data));
        }
    }
}
