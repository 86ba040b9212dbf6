use super::{ColorImage, DepthImage, Stamp};

/// A color image and the depth image registered to it.
#[derive(Debug, Clone, PartialEq)]
pub struct RgbdFrame {
    /// Header stamp of the color image.
    pub stamp: Stamp,
    pub color: ColorImage,
    pub depth: DepthImage,
}
