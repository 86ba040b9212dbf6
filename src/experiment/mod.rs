//! The papers' numerical studies: scenes x estimators x statistics.
//!
//! A [`Study`] is an entry of [`studies`]; it draws its runs with [`monte_carlo`] and sums them up
//! in a [`Report`], where each figure stands beside the paper's.

mod alignment;
mod attitude;
mod gnss;
mod gnss_heading;
mod lab;
mod landmarks;
pub mod matrix_fisher;
mod study;
mod visual;

pub use study::{
    Observation, PaperValue, Report, Request, Row, StepTime, Study, StudyError, Trial, monte_carlo,
};

/// Every study, in the order of `experiment --list`.
pub fn studies() -> impl Iterator<Item = &'static Study> {
    let studies = [
        matrix_fisher::STUDIES,
        gnss::STUDIES,
        gnss_heading::STUDIES,
        alignment::STUDIES,
        visual::STUDIES,
        lab::STUDIES,
    ];
    studies.into_iter().chain(attitude::STUDIES).flatten()
}

/// The study called `name`.
pub fn find(name: &str) -> Option<&'static Study> {
    studies().find(|study| study.name == name)
}
