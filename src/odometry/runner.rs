//! Drives a log through front end and pipeline, on one thread or on several.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread;
use std::time::Instant;

use super::pipeline::Odometry;
use super::report::StepReport;
use crate::sensor::{Event, ImuSample, RgbdFrame, Stamp};
use crate::tracking::FrontEndFrame;
use crate::vision::Extraction;

/// Finds the features of a log's frames, and may follow them from one frame to the next.
///
/// It is called on one thread, in order of the log, at any number of threads: what it makes depends
/// on the log alone, and nothing of the estimate comes back to it.
pub trait FrontEnd: Send {
    /// The turn between frames may be predicted by it. Samples come up to the stamp of the next
    /// frame, and possibly beyond or not quite as far: clocks differ.
    fn imu(&mut self, _sample: &ImuSample) {}

    /// # Errors
    /// A message that says why a frame has no features.
    fn features(&mut self, frame: &RgbdFrame) -> Result<Extraction, String>;
}

#[cfg(feature = "vision")]
impl FrontEnd for crate::vision::VisualFrontEnd {
    fn imu(&mut self, sample: &ImuSample) {
        self.imu(sample);
    }

    fn features(&mut self, frame: &RgbdFrame) -> Result<Extraction, String> {
        self.extract(frame).map_err(|error| error.to_string())
    }
}

/// How a run is driven.
#[derive(Debug, Clone, Copy)]
pub struct RunOptions<'a> {
    /// 1: everything in turn on the calling thread; more: reading, features and estimation
    /// overlap. The results are the same.
    pub threads: usize,
    /// Part of the log that is used, s after its first event and length.
    pub start: f64,
    pub duration: f64,
    /// Ends the run early, with what is there, once it is true.
    pub stop: &'a AtomicBool,
}

/// Frames and samples that may wait between two threads.
const QUEUE: usize = 16;

/// An event after the front end.
enum Prepared {
    Other(Event),
    Frame(FrontEndFrame),
}

impl Prepared {
    /// Of a sensor's own reading: a reference may be of any time, a repetition is of an old one.
    fn measured_at(&self) -> Option<Stamp> {
        match self {
            Self::Other(Event::Imu(sample)) => Some(sample.stamp),
            Self::Other(_) => None,
            Self::Frame(frame) => Some(frame.frame.stamp),
        }
    }
}

/// What a run shows while it goes on.
pub enum Observation<'a> {
    /// A sample, as it is read.
    Imu(&'a ImuSample),
    /// A frame that was processed, and the pipeline after it.
    Frame { report: &'a StepReport, frame: &'a RgbdFrame, odometry: &'a Odometry },
}

/// If no sensor says anything for this long, what follows is another run, s.
const LONGEST_SILENCE: f64 = 10.0;

/// Why an event at `stamp` cannot belong to the run whose last one was at `last`.
pub(super) fn new_run(last: Stamp, stamp: Stamp) -> Option<String> {
    let step = stamp.seconds_since(last);
    if step < 0.0 {
        Some(format!(
            "the stamps of all sensors jump back by {:.3} s at {last} s: a new run begins, whose \
             poses are written from there on",
            -step
        ))
    } else if step > LONGEST_SILENCE {
        Some(format!(
            "the stamps of all sensors jump ahead by {step:.3} s at {last} s: a new run begins"
        ))
    } else {
        None
    }
}

/// Shows `observe` the frames that can be processed.
fn show(odometry: &mut Odometry, observe: &mut impl FnMut(Observation)) {
    while let Some((report, frame)) = odometry.step() {
        observe(Observation::Frame { report: &report, frame: &frame, odometry });
    }
}

/// Runs all of `events` through `odometry` and shows `observe` what happens, in order of time. Where
/// their stamps jump back, or ahead by more than 10 s, a new run begins.
pub fn run(
    events: impl Iterator<Item = Event> + Send,
    front_end: &mut dyn FrontEnd,
    odometry: &mut Odometry,
    options: RunOptions,
    mut observe: impl FnMut(Observation),
) {
    let events = Clipped { events, options, first: None, started: false };
    let mut last = None;
    let mut feed = |prepared: Prepared| {
        let before = last;
        last = prepared.measured_at().or(last);
        if let Some(reason) = before.zip(last).and_then(|(last, stamp)| new_run(last, stamp)) {
            odometry.end();
            show(odometry, &mut observe);
            odometry.begin_new_run(reason);
        }
        match prepared {
            Prepared::Other(Event::Imu(sample)) => {
                observe(Observation::Imu(&sample));
                odometry.push_imu(sample);
            }
            Prepared::Other(Event::Truth(pose)) => odometry.push_truth(pose),
            Prepared::Other(Event::Repeated(stream, stamp)) => {
                odometry.push_repeated(stream, stamp);
            }
            Prepared::Other(Event::Frame(_)) => {}
            Prepared::Frame(frame) => odometry.push_frame(frame),
        }
        show(odometry, &mut observe);
    };
    if options.threads <= 1 {
        events.map(|event| prepare(event, front_end)).for_each(&mut feed);
    } else {
        thread::scope(|scope| {
            let (to_features, read) = sync_channel(QUEUE);
            let (to_estimator, prepared) = sync_channel(QUEUE);
            scope.spawn(move || send_all(events, &to_features));
            scope.spawn(move || prepare_all(&read, front_end, &to_estimator));
            prepared.iter().for_each(&mut feed);
        });
    }
    odometry.end();
    show(odometry, &mut observe);
}

fn send_all(events: impl Iterator<Item = Event>, to: &SyncSender<Event>) {
    for event in events {
        if to.send(event).is_err() {
            break;
        }
    }
}

fn prepare_all(from: &Receiver<Event>, front_end: &mut dyn FrontEnd, to: &SyncSender<Prepared>) {
    for event in from {
        if to.send(prepare(event, front_end)).is_err() {
            break;
        }
    }
}

fn prepare(event: Event, front_end: &mut dyn FrontEnd) -> Prepared {
    match event {
        Event::Frame(frame) => {
            let start = Instant::now();
            let extraction = front_end.features(&frame).unwrap_or_else(|reason| {
                tracing::warn!("frame at {} s: {reason}", frame.stamp);
                Extraction::default()
            });
            Prepared::Frame(FrontEndFrame {
                frame,
                extraction,
                seconds: start.elapsed().as_secs_f64(),
            })
        }
        other => {
            if let Event::Imu(sample) = &other {
                front_end.imu(sample);
            }
            Prepared::Other(other)
        }
    }
}

/// The part of a log between `start` and `start + duration`, until the stop flag is raised.
struct Clipped<'a, I> {
    events: I,
    options: RunOptions<'a>,
    first: Option<Stamp>,
    started: bool,
}

impl<I: Iterator<Item = Event>> Iterator for Clipped<'_, I> {
    type Item = Event;

    fn next(&mut self) -> Option<Event> {
        loop {
            if self.options.stop.load(Ordering::Relaxed) {
                return None;
            }
            let event = self.events.next()?;
            let stamp = event.stamp();
            let time = stamp.seconds_since(*self.first.get_or_insert(stamp));
            if time > self.options.start + self.options.duration {
                return None;
            }
            // The clocks may be set back later on.
            self.started |= time >= self.options.start;
            if self.started {
                return Some(event);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_ends_where_all_stamps_jump() {
        let at = |seconds: f64| Stamp::default().offset_by(seconds);
        for (last, stamp) in [(5.0, 5.0), (5.0, 5.005), (5.0, 14.9)] {
            assert_eq!(new_run(at(last), at(stamp)), None, "{last} {stamp}");
        }
        assert!(new_run(at(5.0), at(4.0)).unwrap().contains("back by 1.000 s at 5.0"));
        assert!(new_run(at(5.0), at(3605.0)).unwrap().contains("ahead by 3600.000 s at 5.0"));
    }
}
