use super::{ColorImage, DepthImage, Stamp};

/// A color image and the depth image registered to it.
#[derive(Debug, Clone, PartialEq)]
pub struct RgbdFrame {
    /// Header stamp of the color image.
    pub stamp: Stamp,
    pub color: ColorImage,
    pub depth: DepthImage,
    /// What further cameras showed at the same time, as taken, by their index less one; empty where
    /// there are none.
    pub others: Vec<ColorImage>,
}
