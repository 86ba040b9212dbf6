//! Parts of an image in which nothing is looked for: the robot's own body.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

/// Where a camera sees the body that carries it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "the name of an image file or a list of [left, top, width, height]")]
pub enum MaskConfig {
    /// An image of the color image's size; 0: masked.
    File(PathBuf),
    /// Rectangles: left, top, width and height, pixels.
    Regions(Vec<[u32; 4]>),
}

impl Default for MaskConfig {
    fn default() -> Self {
        Self::Regions(Vec::new())
    }
}

/// A mask that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum MaskError {
    #[error("log.mask: {path}: {source}")]
    File { path: PathBuf, source: image::ImageError },
}

/// The pixels of an image in which nothing is looked for.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Mask {
    regions: Vec<[u32; 4]>,
    /// Width, and whether each pixel is masked, row by row.
    pixels: Option<(usize, Vec<bool>)>,
}

impl MaskConfig {
    pub fn is_empty(&self) -> bool {
        match self {
            Self::File(path) => path.as_os_str().is_empty(),
            Self::Regions(regions) => regions.is_empty(),
        }
    }

    /// The same with a relative file name taken to be beside `file`.
    pub fn beside(self, file: &Path) -> Self {
        match (self, file.parent()) {
            (Self::File(path), Some(folder)) if !path.as_os_str().is_empty() => {
                Self::File(folder.join(path))
            }
            (other, _) => other,
        }
    }

    /// Reads the mask.
    ///
    /// # Errors
    /// [`MaskError::File`] if its image cannot be read.
    pub fn load(&self) -> Result<Mask, MaskError> {
        let path = match self {
            Self::Regions(regions) => {
                return Ok(Mask { regions: regions.clone(), pixels: None });
            }
            Self::File(path) if path.as_os_str().is_empty() => return Ok(Mask::default()),
            Self::File(path) => path,
        };
        let image = image::ImageReader::open(path)
            .map_err(image::ImageError::IoError)
            .and_then(|reader| {
                reader.with_guessed_format().map_err(image::ImageError::IoError)?.decode()
            })
            .map_err(|source| MaskError::File { path: path.clone(), source })?
            .into_luma8();
        let masked = image.as_raw().iter().map(|value| *value == 0).collect();
        Ok(Mask { regions: Vec::new(), pixels: Some((image.width() as usize, masked)) })
    }
}

impl Mask {
    pub fn is_empty(&self) -> bool {
        self.regions.is_empty() && self.pixels.is_none()
    }

    /// Whether a pixel is masked; those outside of the mask's image are not.
    pub fn covers(&self, x: f64, y: f64) -> bool {
        let (column, row) = (x.round(), y.round());
        if !(column >= 0.0 && row >= 0.0) {
            return false;
        }
        let (column, row) = (column as usize, row as usize);
        let within = |start: u32, length: u32, at: usize| {
            (start as usize..start.saturating_add(length) as usize).contains(&at)
        };
        let in_region = |[left, top, width, height]: &[u32; 4]| {
            within(*left, *width, column) && within(*top, *height, row)
        };
        let in_image = |(width, masked): &(usize, Vec<bool>)| {
            column < *width && masked.get(row * width + column).copied().unwrap_or(false)
        };
        self.regions.iter().any(in_region) || self.pixels.as_ref().is_some_and(in_image)
    }

    /// Width and height of the mask's image, where it is one.
    pub fn size(&self) -> Option<(usize, usize)> {
        let (width, masked) = self.pixels.as_ref()?;
        Some((*width, masked.len() / (*width).max(1)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rectangles_cover_their_pixels() {
        let mask = MaskConfig::Regions(vec![[10, 20, 5, 2], [100, 0, u32::MAX, u32::MAX]]);
        let mask = mask.load().unwrap();
        for (x, y, covered) in [
            (10.0, 20.0, true),
            (14.4, 21.4, true),
            (15.0, 20.0, false),
            (10.0, 22.0, false),
            (9.4, 20.0, false),
            (5000.0, 300.0, true),
            (-1.0, 20.0, false),
            (f64::NAN, 20.0, false),
        ] {
            assert_eq!(mask.covers(x, y), covered, "({x}, {y})");
        }
        assert!(MaskConfig::default().load().unwrap().is_empty());
    }

    #[test]
    fn black_pixels_of_an_image_are_masked() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("body.png");
        let image =
            image::GrayImage::from_fn(4, 3, |x, y| image::Luma([u8::from(x > 0 || y == 2)]));
        image.save(&path).unwrap();
        let config = MaskConfig::File("body.png".into()).beside(&folder.path().join("own.toml"));
        let mask = config.load().unwrap();
        assert_eq!(mask.size(), Some((4, 3)));
        assert!(mask.covers(0.0, 1.0) && !mask.covers(0.0, 2.0) && !mask.covers(1.0, 1.0));
        assert!(!mask.covers(4.0, 0.0) && !mask.covers(0.0, 9.0));
        let missing = MaskConfig::File("/nowhere/body.png".into()).load().unwrap_err();
        assert!(missing.to_string().contains("/nowhere/body.png"));
    }
}
