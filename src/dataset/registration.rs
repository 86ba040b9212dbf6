//! Depth images of a camera beside the color camera: registered to it as they are read.

use super::ReadReport;
use super::merge::{Reading, ReadingSource};
use crate::vision::DepthRegistration;

/// Registers the depth images of a source.
pub(super) struct RegisteredSource<S> {
    source: S,
    registration: Option<DepthRegistration>,
}

impl<S: ReadingSource> RegisteredSource<S> {
    /// Without `registration` depth images stay as they are.
    pub fn new(source: S, registration: Option<DepthRegistration>) -> Self {
        Self { source, registration }
    }
}

impl<S: ReadingSource> ReadingSource for RegisteredSource<S> {
    fn next_reading(&mut self, report: &mut ReadReport) -> Option<Reading> {
        loop {
            let reading = self.source.next_reading(report)?;
            let (Reading::Depth(stamp, image), Some(registration)) = (&reading, &self.registration)
            else {
                return Some(reading);
            };
            match registration.apply(image) {
                Some(registered) => return Some(Reading::Depth(*stamp, registered)),
                None => report.skip_at("depth image: cannot be registered", *stamp),
            }
        }
    }
}
