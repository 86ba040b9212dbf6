//! What is made of one frame after another: features of each, and points that are followed.

use super::{Extraction, OrbExtractor, Tracker, VisionError};
use crate::sensor::{ImuSample, RgbdFrame};

/// ORB features of each frame and, if they are wanted, points followed from one to the next.
pub struct VisualFrontEnd {
    orb: OrbExtractor,
    tracker: Option<Tracker>,
}

impl VisualFrontEnd {
    /// Without a tracker.
    pub fn new(orb: OrbExtractor) -> Self {
        Self { orb, tracker: None }
    }

    /// The same with one.
    pub fn tracking(self, tracker: Tracker) -> Self {
        Self { tracker: Some(tracker), ..self }
    }

    /// A sample up to the next frame, in order of time.
    pub fn imu(&mut self, sample: &ImuSample) {
        if let Some(tracker) = &mut self.tracker {
            tracker.imu(sample);
        }
    }

    /// Features and tracks of the next frame.
    ///
    /// # Errors
    /// [`VisionError`] for images that do not fit together, or that OpenCV refuses.
    pub fn extract(&mut self, frame: &RgbdFrame) -> Result<Extraction, VisionError> {
        let mut extraction = self.orb.extract(frame)?;
        if let Some(tracker) = &mut self.tracker {
            extraction.tracks = tracker.track(frame)?;
        }
        Ok(extraction)
    }
}
