//! From what was seen to what it means and what to do.

use nalgebra::Isometry3;
use serde::Serialize;

use super::{Assumed, Inspection, TopicInspection, Trial};

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    Ok,
    Note,
    Warning,
    Error,
}

/// One thing that was seen.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Finding {
    pub severity: Severity,
    /// `color`, `depth`, `imu`, `truth`, `frames` or `log`.
    pub subject: &'static str,
    pub message: String,
    /// What is to be set differently than assumed: `section.key=value`.
    pub setting: Option<String>,
}

/// Whether the log can be used, and how.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Verdict {
    pub fit: bool,
    pub text: String,
    /// For `--set`.
    pub settings: Vec<String>,
    /// Commands that can use the log: `replay`, `attitude`, `gnss`.
    pub fit_for: Vec<&'static str>,
}

/// An IMU slower than this leaves too much to interpolation, Hz.
const SLOWEST_IMU: f64 = 50.0;
/// Lost or lone images below this fraction do no harm.
const FEW: f64 = 0.02;
/// Depth images with fewer valid pixels than this leave too few features.
const SPARSE_DEPTH: f64 = 0.3;
/// Median depths outside this range are not those of a room, m.
const ROOM: std::ops::RangeInclusive<f64> = 0.2..=15.0;
/// Scales of a gyroscope within this fraction of a unit are of that unit.
const SAME_UNIT: f64 = 0.15;
/// Axes that differ by less than this are not turned: mountings are seldom better known, degrees.
const SAME_AXES_DEG: f64 = 10.0;
/// Clocks that differ by more than this spoil an estimate, s.
const LARGEST_CLOCK_ERROR: f64 = 0.01;
/// Intervals between messages of a sensor, s.
const USUAL_INTERVALS: std::ops::Range<f64> = 5e-5..20.0;
/// Two scales that differ by less than this are the same.
const SAME_SCALE: f64 = 0.01;
/// Channel means closer than this do not tell red from blue.
const CLEAR_RATIO: f64 = 1.05;

#[derive(Default)]
pub(super) struct Findings(pub Vec<Finding>);

impl Findings {
    pub fn add(&mut self, severity: Severity, subject: &'static str, message: String) {
        self.0.push(Finding { severity, subject, message, setting: None });
    }

    /// States what the log holds; if that is not what is assumed, how to set it.
    pub fn setting(
        &mut self,
        subject: &'static str,
        message: String,
        (key, value): (&str, String),
        is_assumed: bool,
    ) {
        let (severity, message, setting) = match is_assumed {
            true => (Severity::Ok, format!("{message}; `{key} = {value}` is set"), None),
            false => {
                let setting = format!("{key}={}", value.replace('"', ""));
                (Severity::Warning, format!("{message}, set `{key} = {value}`"), Some(setting))
            }
        };
        self.0.push(Finding { severity, subject, message, setting });
    }
}

pub(super) fn judge(inspection: &Inspection, assumed: &Assumed) -> (Vec<Finding>, Verdict) {
    let mut findings = Findings(Vec::new());
    streams(&mut findings, inspection);
    for subject in ["color", "depth", "right", "imu", "truth"] {
        if let Some(topic) = inspection.topic(subject) {
            timing(&mut findings, subject, topic, assumed);
        }
    }
    reordering(&mut findings, inspection, assumed);
    clocks(&mut findings, inspection);
    calibration(&mut findings, inspection, assumed);
    color(&mut findings, inspection, assumed);
    depth(&mut findings, inspection, assumed);
    pairs(&mut findings, inspection);
    if let Some(imu) = &inspection.imu {
        super::accelerometer::judge(&mut findings, imu, assumed);
    }
    gyroscope(&mut findings, inspection, assumed);
    turns(&mut findings, inspection, assumed);
    truth(&mut findings, inspection);
    trial(&mut findings, inspection);
    for (reason, count) in &inspection.skipped {
        findings.add(Severity::Warning, "log", format!("{reason}: {count}"));
    }
    let verdict = verdict(&findings.0, inspection);
    (findings.0, verdict)
}

fn verdict(findings: &[Finding], inspection: &Inspection) -> Verdict {
    let errors: Vec<&str> = findings
        .iter()
        .filter(|finding| finding.severity == Severity::Error)
        .map(|finding| finding.message.as_str())
        .collect();
    let mut settings: Vec<String> = Vec::new();
    for setting in findings.iter().filter_map(|finding| finding.setting.as_ref()) {
        if !settings.contains(setting) {
            settings.push(setting.clone());
        }
    }
    let purpose = if inspection.imu.is_some() { "VIO" } else { "RGB-D odometry (it has no IMU)" };
    let quoted = |setting: &String| match setting.contains([' ', '[']) {
        true => format!("'{setting}'"),
        false => setting.clone(),
    };
    let set = settings.iter().map(quoted).collect::<Vec<_>>().join(" --set ");
    let mut text = match (errors.is_empty(), settings.is_empty()) {
        (false, _) => format!("not fit for {purpose}: {}", errors.join("; ")),
        (true, true) => format!("fit for {purpose}"),
        (true, false) => format!("fit for {purpose} with --set {set}"),
    };
    let fit_for = fit_for(errors.is_empty(), inspection);
    if !errors.is_empty() && !fit_for.is_empty() {
        text += &format!("; fit for {}", fit_for.join(" and "));
    }
    Verdict { fit: errors.is_empty(), text, settings, fit_for }
}

/// Commands that can use the log.
fn fit_for(replay: bool, inspection: &Inspection) -> Vec<&'static str> {
    let has_imu = inspection.imu.as_ref().is_some_and(|imu| !imu.is_zero)
        && inspection.topic("imu").is_some_and(|topic| topic.messages > 1);
    let is_fix = |topic: &TopicInspection| {
        let kind = topic.schema.replace("/msg/", "/");
        topic.messages > 1
            && ["sensor_msgs/NavSatFix", "nmea_msgs/Sentence"].contains(&kind.as_str())
    };
    let has_fix = inspection.topics.values().any(is_fix);
    let all = [("replay", replay), ("attitude", has_imu), ("gnss", has_imu && has_fix)];
    all.into_iter().filter(|(_, fits)| *fits).map(|(name, _)| name).collect()
}

fn streams(findings: &mut Findings, inspection: &Inspection) {
    for (role, what) in [("color", "color images"), ("depth", "depth images")] {
        let count = |role| inspection.topic(role).map_or(0, |topic| topic.messages);
        let from_stereo = role == "depth" && count("right") > 0;
        if from_stereo && inspection.summary.camera.is_none() {
            let text = "depth has to come from two cameras: set `log.stereo`".to_owned();
            findings.add(Severity::Error, role, text);
        } else if count(role) == 0 && !from_stereo {
            findings.add(Severity::Error, role, format!("no {what}"));
        }
    }
    if inspection.topic("imu").is_none_or(|topic| topic.messages == 0) {
        if let Some(gyroscope) = &inspection.summary.lone_gyroscope {
            let text = format!(
                "{gyroscope} is not used: its accelerometer reads zero throughout, or is marked as \
                 absent, and no other topic has one"
            );
            findings.add(Severity::Warning, "imu", text);
        }
        let text = "no IMU: a constant-velocity model takes its place".to_owned();
        findings.add(Severity::Note, "imu", text);
    }
}

fn timing(
    findings: &mut Findings,
    subject: &'static str,
    topic: &TopicInspection,
    assumed: &Assumed,
) {
    let Some(timing) = &topic.timing else { return };
    let Some(rate) = timing.rate else {
        if subject != "truth" {
            findings.add(Severity::Error, subject, "fewer than two different stamps".to_owned());
        }
        return;
    };
    if subject == "imu" && rate < SLOWEST_IMU {
        let text = format!("{rate:.1} Hz is slow; {SLOWEST_IMU} Hz or more are needed");
        findings.add(Severity::Warning, subject, text);
    }
    if let Some(longest) = &timing.longest_gap {
        let what = match subject {
            "imu" => "samples missing",
            "truth" => "poses missing",
            _ => "frames dropped",
        };
        let text = format!(
            "{} {what} in {} gap{} ({rate:.1} Hz), the longest of {:.3} s after {:.3} s",
            timing.missing,
            timing.gaps,
            if timing.gaps == 1 { "" } else { "s" },
            longest.seconds,
            longest.after
        );
        let severe = match subject {
            "imu" => longest.seconds > assumed.imu.max_gap,
            "truth" => false,
            _ => timing.missing as f64 > FEW * topic.messages as f64,
        };
        let severity = if severe { Severity::Warning } else { Severity::Note };
        findings.add(severity, subject, text);
    }
    if timing.out_of_order > 0 {
        let text = format!(
            "{} messages out of order, by up to {:.3} s",
            timing.out_of_order, timing.largest_disorder
        );
        let (severity, fate) = match timing.largest_disorder {
            disorder if disorder <= assumed.log.reorder_window => {
                (Severity::Note, "sorted when read")
            }
            disorder if disorder <= LONGEST_REORDERING => {
                (Severity::Warning, "beyond the reorder window")
            }
            _ => (Severity::Warning, "left out"),
        };
        findings.add(severity, subject, format!("{text}: {fate}"));
    }
    if timing.set_back > 0 {
        let text = format!(
            "the clock is set back {}, by up to {:.3} s: where those of all sensors are, a new run \
             begins",
            if timing.set_back == 1 {
                "once".to_owned()
            } else {
                format!("{} times", timing.set_back)
            },
            timing.largest_set_back
        );
        findings.add(Severity::Warning, subject, text);
    }
    if timing.duplicates > 0 {
        let text = format!("{} messages with the stamp of another: left out", timing.duplicates);
        findings.add(Severity::Note, subject, text);
    }
    if let Some(clock) = timing.log_clock.filter(|clock| !clock.same) {
        let text = format!(
            "header stamps and log times are of different clocks ({:.3} s apart): header stamps \
             are used",
            clock.offset
        );
        findings.add(Severity::Note, subject, text);
    }
}

/// Longest time that messages are waited for: more is no disorder of a recorder, s.
const LONGEST_REORDERING: f64 = 10.0;

/// The window within which the messages of all topics can be sorted, where it is not that.
fn reordering(findings: &mut Findings, inspection: &Inspection, assumed: &Assumed) {
    let subjects = ["color", "depth", "right", "imu", "truth"].into_iter();
    let disorder = subjects
        .filter_map(|subject| inspection.topic(subject)?.timing.as_ref())
        .map(|timing| timing.largest_disorder)
        .filter(|disorder| *disorder <= LONGEST_REORDERING)
        .fold(0.0, f64::max);
    if disorder > assumed.log.reorder_window {
        let wanted = format!("{:.1}", (disorder * 10.0).ceil() / 10.0);
        let text = format!("messages are out of order by up to {disorder:.3} s");
        findings.setting("log", text, ("log.reorder_window", wanted), false);
    }
}

fn color(findings: &mut Findings, inspection: &Inspection, assumed: &Assumed) {
    let Some(color) = &inspection.color else { return };
    let encoding = inspection.topic("color").and_then(|topic| topic.encoding.as_deref());
    if encoding == Some("8UC3") {
        let ratio = color.last_over_first.unwrap_or(1.0);
        let seen = match () {
            () if ratio > CLEAR_RATIO => Some("bgr"),
            () if ratio < 1.0 / CLEAR_RATIO => Some("rgb"),
            () => None,
        };
        let configured = assumed.log.color_8uc3.as_str();
        let message = format!(
            "encoding `8UC3` does not tell the channel order; the last channel is {ratio:.2} times \
             as bright as the first, so it is {}",
            match seen {
                Some("bgr") => "probably red",
                Some(_) => "probably blue",
                None => "undecided",
            }
        );
        let order = seen.unwrap_or(configured);
        let setting = ("log.color_8uc3", format!("\"{order}\""));
        findings.setting("color", message, setting, order == configured);
    }
    if color.dark > 0.0 {
        let percent = 100.0 * color.dark;
        findings.add(Severity::Note, "color", format!("{percent:.0} % of the images are dark"));
    }
}

fn depth(findings: &mut Findings, inspection: &Inspection, assumed: &Assumed) {
    let Some(depth) = &inspection.depth else { return };
    let encoding = inspection.topic("depth").and_then(|topic| topic.encoding.as_deref());
    let is_sparse = inspection.topic("right").is_some();
    if encoding != Some("32FC1") && depth.valid > 0.0 && !is_sparse {
        let message = format!(
            "{} (median {} raw, {:.2} m)",
            if depth.scale == 0.001 { "millimetres" } else { "1/5000 m" },
            depth.raw_median,
            depth.median
        );
        let assumed = (assumed.log.depth_scale / depth.scale - 1.0).abs() < SAME_SCALE;
        let setting = ("log.depth_scale", depth.scale.to_string());
        findings.setting("depth", message, setting, assumed);
    }
    if depth.saturated > 0.0 {
        let message = format!("{:.1} % of the pixels are 65535", 100.0 * depth.saturated);
        let assumed = assumed.log.depth_invalid.contains(&65535);
        findings.setting("depth", message, ("log.depth_invalid", "[65535]".to_owned()), assumed);
    }
    let valid = format!("{:.0} % of the pixels have a depth", 100.0 * depth.valid);
    match depth.valid {
        0.0 => findings.add(Severity::Error, "depth", "no pixel has a depth".to_owned()),
        part if part < SPARSE_DEPTH && !is_sparse => {
            findings.add(Severity::Warning, "depth", valid)
        }
        _ => findings.add(Severity::Ok, "depth", valid),
    }
    if depth.valid > 0.0 && !ROOM.contains(&depth.median) {
        let text = format!("the median depth of {:.2} m is not that of a room", depth.median);
        findings.add(Severity::Warning, "depth", text);
    }
}

fn pairs(findings: &mut Findings, inspection: &Inspection) {
    let pairs = &inspection.pairs;
    if inspection.color.is_none() || inspection.depth.is_none() {
        return;
    }
    if pairs.frames == 0 {
        let text = "no color image has a depth image near enough in time".to_owned();
        findings.add(Severity::Error, "frames", text);
        return;
    }
    let text = format!(
        "{} pairs of color and depth, at most {:.1} ms apart; {} color and {} depth images have no \
         partner",
        pairs.frames,
        1000.0 * pairs.largest_difference,
        pairs.lone_color,
        pairs.lone_depth
    );
    let many = pairs.lone_color as f64 > FEW * pairs.frames as f64;
    findings.add(if many { Severity::Warning } else { Severity::Ok }, "frames", text);
}

fn gyroscope(findings: &mut Findings, inspection: &Inspection, assumed: &Assumed) {
    let by_truth = inspection.imu.as_ref().and_then(|imu| imu.gyroscope_scale());
    let unit = |scale: f64| match scale {
        s if (s - 1.0).abs() < SAME_UNIT => Some((1.0, "rad/s")),
        s if (s.to_degrees() - 1.0).abs() < SAME_UNIT => Some((1_f64.to_radians(), "deg/s")),
        _ => None,
    };
    let (scale, name, source) = match (by_truth.and_then(unit), &inspection.turns) {
        (Some((scale, name)), _) => (scale, name, "the reference"),
        (None, Some(turns)) => match unit(turns.gyroscope_scale) {
            Some((scale, name)) => (scale, name, "the images"),
            None => {
                let factor = turns.gyroscope_scale;
                let text = format!(
                    "the gyroscope reads {:.3} times the turns of the images; if they are right, set \
                     `imu.gyroscope_scale = {factor:.4}`",
                    1.0 / factor
                );
                return findings.add(Severity::Warning, "imu", text);
            }
        },
        (None, None) => return,
    };
    let is_assumed = (assumed.imu.gyroscope_scale / scale - 1.0).abs() < SAME_SCALE;
    let message = format!("gyroscope in {name} (by the turns of {source})");
    let value = toml::Value::Float(scale).to_string();
    findings.setting("imu", message, ("imu.gyroscope_scale", value), is_assumed);
}

/// What the turns that camera and gyroscope see say of the mounting and of the clocks.
fn turns(findings: &mut Findings, inspection: &Inspection, assumed: &Assumed) {
    let Some(turns) = &inspection.turns else { return };
    if turns.is_mirrored {
        let axes = turns.correction(&assumed.body_from_camera.unwrap_or_default());
        let text = format!(
            "the axes of the IMU are left-handed ({axes}): no mounting fits; negate the axis in the \
             driver, or swap the two that are confused"
        );
        return findings.add(Severity::Error, "imu", text);
    }
    let off = assumed.body_from_camera.and_then(|mounting| turns.angle_to(&mounting));
    let value = || mounting_value(turns.mounting().unwrap_or_default(), assumed);
    let key = "camera.imu_from_camera";
    match (off, &assumed.body_from_camera) {
        (Some(degrees), Some(_)) if degrees < SAME_AXES_DEG.max(5.0 * turns.sd_deg) => {
            let text = format!(
                "camera and gyroscope turn alike: the mounting is right to {degrees:.1} degrees (known \
                 to {:.1})",
                turns.sd_deg
            );
            findings.add(Severity::Ok, "imu", text);
        }
        (Some(degrees), Some(mounting)) => {
            let text = format!(
                "the axes of the IMU are not those of the mounting: turned by {degrees:.0} degrees, {} \
                 (by turns that images and gyroscope see, to {:.1} degrees)",
                turns.correction(mounting),
                turns.sd_deg
            );
            findings.setting("imu", text, (key, value()), false);
        }
        _ => {
            let text = format!(
                "the mounting of the camera on the IMU is not in the log; turns that both see give its \
                 rotation to {:.1} degrees",
                turns.sd_deg
            );
            findings.setting("imu", text, (key, value()), false);
        }
    }
    let late = turns.time_offset - assumed.time_offset;
    if late.abs() > LARGEST_CLOCK_ERROR {
        let text = format!(
            "the images are stamped {:.0} ms too {} for the gyroscope",
            1000.0 * late.abs(),
            if late > 0.0 { "early" } else { "late" }
        );
        let value = format!("{:.3}", turns.time_offset);
        findings.setting("imu", text, ("camera.time_offset", value), false);
    }
}

/// A row-major matrix with the found rotation and the assumed place.
fn mounting_value(rotation: nalgebra::UnitQuaternion<f64>, assumed: &Assumed) -> String {
    let place = assumed.body_from_camera.map(|mounting| mounting.translation).unwrap_or_default();
    let matrix = Isometry3::from_parts(place, rotation).to_homogeneous();
    let row = |row: usize| {
        let entries: Vec<_> =
            (0..4).map(|column| format!("{:.6}", matrix[(row, column)])).collect();
        format!("[{}]", entries.join(", "))
    };
    format!("[{}]", (0..4).map(row).collect::<Vec<_>>().join(", "))
}

/// Whether the streams are of the same time, and stamped in seconds.
fn clocks(findings: &mut Findings, inspection: &Inspection) {
    let spans = ["color", "depth", "imu"].into_iter().filter_map(|role| {
        let timing = inspection.topic(role)?.timing.as_ref()?;
        Some((role, inspection.summary.sources.get(role)?, timing))
    });
    let spans: Vec<_> = spans.collect();
    for (role, source, timing) in &spans {
        let interval = timing.rate.map_or(f64::NAN, |rate| 1.0 / rate);
        let unit = [("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)];
        let is_usual = |seconds: f64| USUAL_INTERVALS.contains(&seconds);
        let taken = unit.iter().find(|(_, per_second)| is_usual(interval / per_second));
        if let (Some((unit, _)), false) = (taken, is_usual(interval) || interval.is_nan()) {
            let text = format!(
                "stamps of {source} are {interval:.3e} s apart: they are {unit}, not seconds"
            );
            findings.add(Severity::Error, role, text);
        }
    }
    for (first, second) in [("imu", "color"), ("imu", "depth"), ("depth", "color")] {
        let of = |role: &str| spans.iter().find(|(name, _, _)| *name == role);
        let (Some((role, a, x)), Some((_, b, y))) = (of(first), of(second)) else { continue };
        if x.last < y.first || y.last < x.first {
            let text = format!(
                "stamps of {a} cover {:.3} to {:.3} s, of {b} {:.3} to {:.3} s: they do not overlap; \
                 they are of different clocks",
                x.first, x.last, y.first, y.last
            );
            findings.add(Severity::Error, role, text);
        }
    }
}

/// What is known of the camera, and whether depth is that of its pixels.
fn calibration(findings: &mut Findings, inspection: &Inspection, assumed: &Assumed) {
    for problem in &inspection.summary.calibration.problems {
        findings.add(Severity::Warning, "color", problem.clone());
    }
    let (intrinsics, mounting): (Vec<&str>, Vec<&str>) =
        assumed.missing.iter().copied().partition(|key| !key.ends_with("imu_from_camera"));
    if !intrinsics.is_empty() {
        let text = format!(
            "no calibration of the camera ({}): record its CameraInfo, or give it with --config or \
             --set",
            intrinsics.join(", ")
        );
        findings.add(Severity::Error, "color", text);
    }
    let is_found = inspection.turns.as_ref().is_some_and(|turns| !turns.is_mirrored);
    if !mounting.is_empty() && !is_found {
        let text = "no mounting of the camera on the IMU (camera.imu_from_camera): record the \
                    transforms (/tf_static), or give it with --config; a log in which the camera turns \
                    about several axes would tell its rotation";
        findings.add(Severity::Error, "imu", text.to_owned());
    }
    if let Some(registration) = &inspection.summary.calibration.registration {
        let offset = 1000.0 * registration.color_from_depth.translation.vector.norm();
        let text = format!(
            "the depth camera is {offset:.0} mm from the color camera: its images are registered to \
             those of color by both calibrations"
        );
        return findings.add(Severity::Note, "depth", text);
    }
    let sizes = ["color", "depth"].map(|role| inspection.topic(role).and_then(|topic| topic.size));
    if let [Some(color), Some(depth)] = sizes
        && color != depth
    {
        let text = format!(
            "depth images have {}x{} pixels, color images {}x{}: they are not registered",
            depth.0, depth.1, color.0, color.1
        );
        // Whether that can be mended shows in the trial.
        let is_mended = inspection.trial.as_ref().is_some_and(|trial| trial.processed > 0);
        let severity = if is_mended { Severity::Note } else { Severity::Error };
        findings.add(severity, "depth", text);
    }
}

/// What came of the estimator's start.
fn trial(findings: &mut Findings, inspection: &Inspection) {
    let Some(Trial { frames, processed, reason, settings }) = &inspection.trial else { return };
    let with = match settings.is_empty() {
        true => String::new(),
        false => " with these settings".to_owned(),
    };
    match (processed, reason) {
        (0, reason) => {
            let why = reason.clone().unwrap_or_else(|| "there are none".to_owned());
            let text = format!("replay{with} processes no frame: {why}");
            findings.add(Severity::Error, "frames", text);
        }
        (processed, _) => {
            let text = format!("replay{with} processes {processed} of the first {frames} frames");
            let severity = if *processed * 2 < *frames { Severity::Warning } else { Severity::Ok };
            findings.add(severity, "frames", text);
        }
    }
}

fn truth(findings: &mut Findings, inspection: &Inspection) {
    if let Some([x, y, z]) = inspection.imu.as_ref().and_then(|imu| imu.truth_up) {
        let severity = if z > 0.99 { Severity::Ok } else { Severity::Note };
        let text = format!("up is ({x:.2}, {y:.2}, {z:.2}) in the world of the reference");
        findings.add(severity, "truth", text);
    }
}
