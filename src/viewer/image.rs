//! Color images as JPEG, depth images as PNG.

use jpeg_encoder::{ColorType, SamplingFactor};
use png::{BitDepth, Compression, Filter};
use rerun::components::MediaType;
use rerun::{EncodedDepthImage, EncodedImage};

use super::ViewerError;
use crate::sensor::{ColorImage, DepthImage, PixelFormat};

/// Depths from 0 to this (m) share the color scale, so that a color means the same in all frames.
const DEPTH_COLOR_RANGE: f64 = 5.0;

type EncodeError = Box<dyn std::error::Error + Send + Sync>;

pub(super) fn color(
    image: &ColorImage,
    quality: u8,
    frame: u64,
) -> Result<EncodedImage, ViewerError> {
    let (width, height) = (image.width(), image.height());
    let bytes = jpeg(image, quality).map_err(|source| ViewerError::Image {
        kind: "color",
        frame,
        width,
        height,
        source,
    })?;
    Ok(EncodedImage::new(bytes).with_media_type(MediaType::JPEG))
}

pub(super) fn depth(image: &DepthImage, frame: u64) -> Result<EncodedDepthImage, ViewerError> {
    let (width, height) = (image.width(), image.height());
    let bytes = png(image).map_err(|source| ViewerError::Image {
        kind: "depth",
        frame,
        width,
        height,
        source,
    })?;
    // Rerun's `meter` counts units a metre.
    let units_per_metre = 1.0 / image.scale();
    Ok(EncodedDepthImage::new(bytes)
        .with_media_type(MediaType::PNG)
        .with_meter(units_per_metre)
        .with_depth_range([0.0, DEPTH_COLOR_RANGE * f64::from(units_per_metre)]))
}

fn jpeg(image: &ColorImage, quality: u8) -> Result<Vec<u8>, EncodeError> {
    let color_type = match image.format() {
        PixelFormat::Mono8 => ColorType::Luma,
        PixelFormat::Rgb8 => ColorType::Rgb,
        PixelFormat::Bgr8 => ColorType::Bgr,
    };
    let mut bytes = Vec::with_capacity(image.data().len() / 16);
    let mut encoder = jpeg_encoder::Encoder::new(&mut bytes, quality);
    encoder.set_sampling_factor(SamplingFactor::F_2_2);
    encoder.encode(
        image.data(),
        image.width().try_into()?,
        image.height().try_into()?,
        color_type,
    )?;
    Ok(bytes)
}

fn png(image: &DepthImage) -> Result<Vec<u8>, EncodeError> {
    let samples: Vec<u8> = image.data().iter().flat_map(|raw| raw.to_be_bytes()).collect();
    let mut bytes = Vec::with_capacity(samples.len() / 3);
    let mut encoder =
        png::Encoder::new(&mut bytes, image.width().try_into()?, image.height().try_into()?);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(BitDepth::Sixteen);
    // Twenty times as fast as the default level, for twice the size.
    encoder.set_compression(Compression::Fast);
    encoder.set_filter(Filter::Paeth);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&samples)?;
    writer.finish()?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A ramp with holes, which exercises every byte of the samples.
    fn ramp() -> DepthImage {
        let data = (0..64 * 48).map(|i| if i % 7 == 0 { 0 } else { i * 21 }).collect();
        DepthImage::new(64, 48, 0.001, data).unwrap()
    }

    #[test]
    fn depth_survives_exactly() {
        let image = ramp();
        let bytes = png(&image).unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
        let mut samples = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut samples).unwrap();
        assert_eq!((info.width, info.height, info.bit_depth), (64, 48, BitDepth::Sixteen));
        let decoded: Vec<u16> =
            samples.chunks_exact(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])).collect();
        assert_eq!(decoded, image.data());
    }

    #[test]
    fn every_pixel_format_becomes_a_jpeg() {
        for format in [PixelFormat::Mono8, PixelFormat::Rgb8, PixelFormat::Bgr8] {
            let data = vec![90; 17 * 11 * format.channels()];
            let bytes = jpeg(&ColorImage::new(17, 11, format, data).unwrap(), 75).unwrap();
            assert!(bytes.starts_with(&[0xff, 0xd8]) && bytes.ends_with(&[0xff, 0xd9]));
        }
    }

    #[test]
    fn an_image_too_wide_for_jpeg_is_an_error() {
        let image = ColorImage::new(70_000, 1, PixelFormat::Mono8, vec![0; 70_000]).unwrap();
        let message = color(&image, 75, 3).unwrap_err().to_string();
        assert!(message.contains("frame 3 (70000x1)"), "{message}");
    }
}
