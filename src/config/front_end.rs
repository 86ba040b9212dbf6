//! The front end that a configuration describes.

use super::Config;
use crate::filter::{FilterKind, MapTreatment};
use crate::vision::{OrbExtractor, Tracker, VisionError, VisualFrontEnd};

impl Config {
    /// The front end for a filter of this kind: points are followed, and looked at again, for one
    /// that holds points and past poses in its state.
    ///
    /// # Errors
    /// [`VisionError`] for values that cannot be, and a mask that cannot be read.
    pub fn front_end(&self, kind: FilterKind) -> Result<VisualFrontEnd, VisionError> {
        let mask = self.log.mask.load()?;
        let is_joint = kind.map_treatment() == MapTreatment::Correlated;
        let orb = OrbExtractor::new(&self.features, &self.camera, &self.depth)?
            .keeping_pyramid(self.search.seek_state_points && is_joint)
            .masked(mask.clone());
        if !(is_joint && self.tracker.points > 0) {
            return Ok(VisualFrontEnd::new(orb));
        }
        let Self { tracker, features, camera, depth, imu, .. } = self;
        let others = self.log.stereo.get(1..).unwrap_or_default();
        let tracker = Tracker::new(tracker, features, camera, depth, imu)?
            .masked(mask)
            .with_others(camera, others)?;
        Ok(VisualFrontEnd::new(orb).tracking(tracker))
    }
}
