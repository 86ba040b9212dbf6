//! From what was seen to what it means and what to do.

use serde::Serialize;

use super::{AccelerometerUnit, GyroscopeUnit};
use super::{Assumed, Evidence, Inspection, Sign, TopicInspection};

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
}

/// An IMU slower than this leaves too much to interpolation, Hz.
const SLOWEST_IMU: f64 = 50.0;
/// Lost or lone images below this fraction do no harm.
const FEW: f64 = 0.02;
/// Depth images with fewer valid pixels than this leave too few features.
const SPARSE_DEPTH: f64 = 0.3;
/// Median depths outside this range are not those of a room, m.
const ROOM: std::ops::RangeInclusive<f64> = 0.2..=15.0;
/// Two scales that differ by less than this are the same.
const SAME_SCALE: f64 = 0.01;
/// Channel means closer than this do not tell red from blue.
const CLEAR_RATIO: f64 = 1.05;

struct Findings(Vec<Finding>);

impl Findings {
    fn add(&mut self, severity: Severity, subject: &'static str, message: String) {
        self.0.push(Finding { severity, subject, message, setting: None });
    }

    /// States what the log holds; if that is not what is assumed, how to set it.
    fn setting(
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
    color(&mut findings, inspection, assumed);
    depth(&mut findings, inspection, assumed);
    pairs(&mut findings, inspection);
    imu(&mut findings, inspection, assumed);
    truth(&mut findings, inspection);
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
    let text = match (errors.is_empty(), settings.is_empty()) {
        (false, _) => format!("not fit for {purpose}: {}", errors.join("; ")),
        (true, true) => format!("fit for {purpose}"),
        (true, false) => format!("fit for {purpose} with --set {}", settings.join(" --set ")),
    };
    Verdict { fit: errors.is_empty(), text, settings }
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

fn imu(findings: &mut Findings, inspection: &Inspection, assumed: &Assumed) {
    let Some(imu) = &inspection.imu else { return };
    let [x, y, z] = imu.acceleration;
    let state = match imu.at_rest {
        true => format!("at rest (at {:.2} s) the accelerometer reads", imu.quietest),
        false => "never at rest for half a second; at its quietest the accelerometer reads".into(),
    };
    let reads = format!("{state} ({x:.3}, {y:.3}, {z:.3}), norm {:.3}", imu.acceleration_norm);
    let unit = match imu.accelerometer_unit {
        AccelerometerUnit::MetresPerSecondSquared => "m/s^2",
        AccelerometerUnit::StandardGravities => "g",
        AccelerometerUnit::Unknown => {
            let text = format!("{reads}: neither m/s^2 nor g");
            findings.add(Severity::Error, "imu", text);
            return;
        }
    };
    let source = match imu.sign_from {
        Evidence::Truth => " (by the accelerations of the reference)",
        Evidence::CameraMounting => " (by the camera's mounting, if it is held upright)",
        Evidence::None => "",
    };
    let sign = match imu.gravity_sign {
        Sign::Regular => "sign regular",
        Sign::Inverted => "sign inverted",
        Sign::Unknown => "sign unknown",
    };
    let message = format!("{reads}: {unit}, {sign}{source}");
    match imu.accelerometer_scale() {
        Some(scale) => {
            let is_assumed = (assumed.imu.accelerometer_scale / scale - 1.0).abs() < SAME_SCALE;
            let value = toml::Value::Float(scale).to_string();
            findings.setting("imu", message, ("imu.accelerometer_scale", value), is_assumed);
        }
        None => {
            let text = format!(
                "{message}; with the IMU upright its vertical axis must read +1 g, else negate \
                 `imu.accelerometer_scale`"
            );
            findings.add(Severity::Warning, "imu", text);
        }
    }
    if let Some(scale) = imu.gyroscope_scale() {
        let unit = match imu.gyroscope_unit {
            GyroscopeUnit::DegreesPerSecond => "deg/s",
            GyroscopeUnit::RadiansPerSecond | GyroscopeUnit::Unknown => "rad/s",
        };
        let is_assumed = (assumed.imu.gyroscope_scale / scale - 1.0).abs() < SAME_SCALE;
        let message = format!("gyroscope in {unit} (by the turns of the reference)");
        let value = toml::Value::Float(scale).to_string();
        findings.setting("imu", message, ("imu.gyroscope_scale", value), is_assumed);
    }
}

fn truth(findings: &mut Findings, inspection: &Inspection) {
    if let Some([x, y, z]) = inspection.imu.as_ref().and_then(|imu| imu.truth_up) {
        let severity = if z > 0.99 { Severity::Ok } else { Severity::Note };
        let text = format!("up is ({x:.2}, {y:.2}, {z:.2}) in the world of the reference");
        findings.add(severity, "truth", text);
    }
}
