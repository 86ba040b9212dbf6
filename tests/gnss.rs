//! `mfg-vio gnss` end to end: a simulated drive always, the KITTI drive where it is present.

mod support;

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use mfg_vio::sensor::Stamp;
use nalgebra::{Rotation3, UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use support::ros2::{Body, Message};
use support::{fail, json, lines, recording, text};

const GRAVITY: f64 = 9.81;
const FIX_SD: f64 = 0.5;
/// Acceleration and angular velocity noise of one sample at 100 Hz, m/s^2 and rad/s.
const SAMPLE_SD: [f64; 2] = [0.1, 1e-3];
/// What the configuration must know of it (densities: sample noise times sqrt(0.01 s)).
const SETTINGS: [&str; 12] = [
    "--set",
    "imu.accel_noise=0.01",
    "--set",
    "imu.gyro_noise=1e-4",
    "--set",
    "imu.gravity=9.81",
    "--set",
    "receiver.horizontal_noise=0.5",
    "--set",
    "receiver.vertical_noise=0.5",
    "--set",
    "output.interval=1000",
];

/// A drive on a wavy road: `y = 30 sin(x / 25)` at a speed that varies between 4 and 12 m/s, the
/// body's x axis along the road.
struct Drive {
    imu: PathBuf,
    gps: PathBuf,
    _directory: tempfile::TempDir,
}

fn along(x: f64) -> (Vector3<f64>, f64) {
    let slope: f64 = 30.0 / 25.0 * (x / 25.0).cos();
    (Vector3::new(x, 30.0 * (x / 25.0).sin(), 0.0), slope.atan())
}

fn drive(seconds: usize) -> Drive {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let mut noise =
        |sd: f64| Vector3::<f64>::from_fn(|_, _| sd * rng.sample::<f64, _>(StandardNormal));
    let (mut imu, mut gps) = (String::from("t,gx,gy,gz,ax,ay,az\n"), String::from("t,x,y,z\n"));
    let (gyro_bias, accel_bias) =
        (Vector3::new(2e-3, -1e-3, 3e-3), Vector3::new(0.05, -0.03, 0.02));
    let h = 0.01;
    // Positions at five times around each sample give velocity and acceleration.
    let mut x = 0.0;
    let mut path = Vec::new();
    for k in 0..seconds * 100 + 3 {
        path.push(along(x));
        let (_, heading) = along(x);
        x += h * (8.0 + 4.0 * (0.25 * k as f64 * h).sin()) * heading.cos();
    }
    for k in 1..=seconds * 100 {
        let t = 100.0 + k as f64 * h;
        let (position, heading) = path[k];
        let acceleration = (path[k + 1].0 + path[k - 1].0 - position * 2.0) / (h * h);
        let rate = (path[k + 1].1 - path[k - 1].1) / (2.0 * h);
        let body = Rotation3::from_euler_angles(0.0, 0.0, heading);
        let force = body.inverse() * (acceleration + Vector3::z() * GRAVITY);
        let a = force + accel_bias + noise(SAMPLE_SD[0]);
        let w = Vector3::z() * rate + gyro_bias + noise(SAMPLE_SD[1]);
        writeln!(imu, "{t:.3},{},{},{},{},{},{}", w.x, w.y, w.z, a.x, a.y, a.z).unwrap();
        if k % 100 == 50 {
            let p = position + noise(FIX_SD);
            writeln!(gps, "{t:.3},{},{},{}", p.x, p.y, p.z).unwrap();
        }
    }
    let directory = tempfile::tempdir().unwrap();
    let [imu_file, gps_file] = ["imu.csv", "gps.csv"].map(|name| directory.path().join(name));
    std::fs::write(&imu_file, imu).unwrap();
    std::fs::write(&gps_file, gps).unwrap();
    Drive { imu: imu_file, gps: gps_file, _directory: directory }
}

fn arguments<'a>(imu: &'a Path, gps: &'a Path, filter: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    let mut arguments = vec!["gnss", "--imu", text(imu), "--gps", text(gps), "--filter", filter];
    arguments.extend_from_slice(more);
    arguments
}

/// Columns of a file by name.
fn columns(path: &Path, names: &[&str]) -> Vec<Vec<String>> {
    let lines = lines(path);
    let header: Vec<&str> = lines[0].split(',').collect();
    let index = |name: &&str| header.iter().position(|h| h == name).expect("a column");
    let indices: Vec<usize> = names.iter().map(index).collect();
    let row = |line: &String| {
        let fields: Vec<&str> = line.split(',').collect();
        indices.iter().map(|&i| fields[i].to_owned()).collect()
    };
    lines[1..].iter().map(row).collect()
}

#[test]
fn an_unknown_heading_is_found_and_kept_through_an_outage() {
    let drive = drive(120);
    let out = tempfile::tempdir().unwrap();
    for filter in ["mfgi", "mfgb"] {
        let directory = out.path().join(filter);
        let mut more = SETTINGS.to_vec();
        more.extend(["--outage", "60,20", "--json", "--out", text(&directory)]);
        let report = json(&arguments(&drive.imu, &drive.gps, filter, &more));
        let converged = report["heading_converged_s"].as_f64().expect("a time");
        assert!(converged > 0.0 && converged < 40.0, "{converged}");
        let nis = &report["nis"];
        let mean = nis["mean"].as_f64().unwrap();
        assert!(mean > 2.0 && mean < 4.0, "{nis}");
        let outage = &report["outages"][0];
        assert_eq!(outage["fixes"], 20);
        assert!(outage["max_m"].as_f64().unwrap() < 15.0, "{outage}");
        assert!(report["mekf"].is_object(), "{report}");

        let state = columns(&directory.join("state.csv"), &["qx", "qy", "qz", "qw", "px", "fix"]);
        assert_eq!(state.len(), 120);
        assert_eq!(state.iter().filter(|row| row[5] == "outage").count(), 20);
        let last: Vec<f64> = state[119][..5].iter().map(|x| x.parse().unwrap()).collect();
        let quaternion = nalgebra::Quaternion::new(last[3], last[0], last[1], last[2]);
        let forward = UnitQuaternion::from_quaternion(quaternion) * Vector3::x();
        let (_, heading) = along(last[4]);
        let error = forward.y.atan2(forward.x) - heading;
        assert!(error.abs().to_degrees() < 3.0, "{}", error.to_degrees());
        let trajectory = lines(&directory.join("trajectory.tum"));
        assert_eq!(trajectory.len(), 120);
        assert_eq!(trajectory[0].split(' ').count(), 8);
    }
}

#[test]
fn a_wrong_fix_is_rejected_and_a_lasting_jump_accepted() {
    let drive = drive(90);
    let mut fixes = lines(&drive.gps);
    let shifted = |line: &str, by: f64| {
        let mut fields: Vec<String> = line.split(',').map(str::to_owned).collect();
        fields[2] = (fields[2].parse::<f64>().unwrap() + by).to_string();
        fields.join(",")
    };
    fixes[40] = shifted(&fixes[40], 30.0);
    for line in &mut fixes[50..] {
        *line = shifted(line, 20.0);
    }
    std::fs::write(&drive.gps, fixes.join("\n")).unwrap();
    let out = tempfile::tempdir().unwrap();
    let mut more = SETTINGS.to_vec();
    more.extend(["--set", "receiver.gate_probability=0.9999", "--set", "receiver.max_rejected=3"]);
    more.extend(["--json", "--out", text(out.path())]);
    let report = json(&arguments(&drive.imu, &drive.gps, "mfgi", &more));
    // The line of each fix; the first one has none to be compared with.
    let fates: Vec<String> =
        columns(&out.path().join("state.csv"), &["fix"]).into_iter().flatten().collect();
    let rejected = fates.iter().filter(|fate| *fate == "rejected").count();
    assert_eq!(report["fixes_rejected"], rejected);
    assert_eq!(fates.len(), 90);
    let before = fates[1..49].iter().enumerate().filter(|(_, fate)| *fate == "rejected");
    assert_eq!(before.map(|(k, _)| k + 1).collect::<Vec<_>>(), [39]);
    assert!(fates[49..52].iter().all(|fate| fate == "rejected"), "{fates:?}");
    assert_eq!(fates[52], "used");
    assert!(fates[80..].iter().all(|fate| fate == "used"), "{fates:?}");
}

/// Samples within a stretch replaced by interpolation are no evidence.
#[test]
fn a_gap_that_was_filled_in_is_found_and_bridged() {
    let drive = drive(90);
    let table = lines(&drive.imu);
    let mut rows: Vec<Vec<f64>> = table[1..]
        .iter()
        .map(|line| line.split(',').map(|x| x.parse().unwrap()).collect())
        .collect();
    let (first, last) = (6000, 6700);
    for k in first + 1..last {
        let share = (k - first) as f64 / (last - first) as f64;
        let between = |(a, b): (&f64, &f64)| a * (1.0 - share) + b * share;
        let readings: Vec<_> = rows[first].iter().zip(&rows[last]).skip(1).map(between).collect();
        rows[k].splice(1.., readings);
    }
    let texts: Vec<String> = rows
        .iter()
        .map(|row| row.iter().map(f64::to_string).collect::<Vec<_>>().join(","))
        .collect();
    std::fs::write(&drive.imu, format!("{}\n{}\n", table[0], texts.join("\n"))).unwrap();
    for filter in ["mfgi", "mfgb"] {
        let run = |more: &[&str]| {
            let more = [&SETTINGS[..], more, &["--json"]].concat();
            json(&arguments(&drive.imu, &drive.gps, filter, &more))
        };
        let bridged = run(&[]);
        assert_eq!([&bridged["gaps"], &bridged["interpolated"]], [0, 1]);
        let believed = run(&["--set", "imu.max_gap=10"]);
        assert_eq!(believed["interpolated"], 0);
        let mean = |report: &serde_json::Value| report["nis"]["mean"].as_f64().unwrap();
        assert!(mean(&bridged) < 4.0 && mean(&believed) > 6.0, "{bridged} {believed}");
    }
}

#[test]
fn a_known_heading_needs_no_convergence() {
    let drive = drive(30);
    let heading = along(4.0).1.to_degrees();
    let heading = format!("start.heading={heading}");
    let mut more = SETTINGS.to_vec();
    more.extend(["--set", "start.heading_known=true", "--set", &heading, "--json"]);
    more.extend(["--set", "start.heading_sd=2", "--set", "imu.gyro_bias_sd=3e-3"]);
    more.extend(["--set", "start.converged_heading_sd=10"]);
    for filter in ["mfgi", "mekf"] {
        let report = json(&arguments(&drive.imu, &drive.gps, filter, &more));
        assert_eq!(report["heading_converged_s"], 0.0);
        assert!(report["nis"]["mean"].as_f64().unwrap() < 5.0, "{report}");
    }
}

#[test]
fn mistakes_are_told_in_one_line() {
    let drive = drive(3);
    let run = |more: &[&str]| fail(&arguments(&drive.imu, &drive.gps, "mfgi", more));
    let message = run(&["--set", "receiver.horizontl_noise=1"]);
    assert!(message.contains("receiver.horizontal_noise"), "{message}");
    let message = run(&["--set", "receiver.horizontal_noise=-1"]);
    assert!(message.contains("receiver.horizontal_noise") && message.contains("positive"));

    let missing = fail(&arguments(Path::new("nowhere.csv"), &drive.gps, "mfgi", &[]));
    assert!(missing.contains("nowhere.csv"), "{missing}");
    // The tables exchanged.
    let swapped = fail(&arguments(&drive.gps, &drive.imu, "mfgi", &[]));
    // By the name of the first column that is missed, as for every IMU table.
    assert!(swapped.contains("gps.csv") && swapped.contains("no column `gx`"), "{swapped}");
    std::fs::write(&drive.gps, "t,x,y,z\n5,0,0,0\n6,0,0,0\n").unwrap();
    let apart = run(&[]);
    assert!(apart.contains("no fix lies") && apart.contains("5.000000000"), "{apart}");
    assert_eq!(apart.trim_end().lines().count(), 1);
    std::fs::write(&drive.gps, "t,x,y,z\n101,0,0,0\n101,0,0,0\n").unwrap();
    let repeated = run(&[]);
    assert!(repeated.contains("must increase"), "{repeated}");
}

/// A real car: the heading is unknown, and the course over ground checks what comes out.
#[test]
fn kitti_heading_agrees_with_the_course() {
    let Some(data) = recording("kitti_imu_gps") else { return };
    let [imu, gps] = ["KittiEquivBiasedImu.txt", "KittiGps_converted.txt"].map(|f| data.join(f));
    let out = tempfile::tempdir().unwrap();
    let more = ["--out", text(out.path()), "--json"];
    let report = json(&arguments(&imu, &gps, "mfgi", &more));
    assert_eq!([&report["gaps"], &report["interpolated"]], [0, 8]);
    let mean = report["nis"]["mean"].as_f64().unwrap();
    assert!(mean > 2.0 && mean < 3.5, "{mean}");
    let converged = report["heading_converged_s"].as_f64().expect("a time");
    assert!(converged < 60.0, "{converged}");
    let names = ["time", "vel_x", "vel_y", "qx", "qy", "qz", "qw"];
    let state = columns(&out.path().join("state.csv"), &names);
    let start = report["start"].as_f64().unwrap() + converged;
    let mut deviations: Vec<f64> = state
        .iter()
        .map(|row| row.iter().map(|x| x.parse().unwrap()).collect::<Vec<f64>>())
        .filter(|row| row[0] > start && row[1].hypot(row[2]) > 3.0)
        .map(|row| {
            let quaternion = nalgebra::Quaternion::new(row[6], row[3], row[4], row[5]);
            let forward = UnitQuaternion::from_quaternion(quaternion) * Vector3::x();
            let cross = forward.x * row[2] - forward.y * row[1];
            let dot = forward.x * row[1] + forward.y * row[2];
            cross.atan2(dot).abs().to_degrees()
        })
        .collect();
    deviations.sort_by(f64::total_cmp);
    let median = deviations[deviations.len() / 2];
    assert!(median < 3.0, "median deviation of the heading from the course: {median} deg");
}

#[test]
fn studies_of_navigation_report_every_filter_and_their_consistency() {
    let report = json(&["experiment", "wang-5.5", "--runs", "2", "--seed", "3", "--json"]);
    let rows = report["rows"].as_array().unwrap();
    let mean = |filter: &str, quantity: &str| {
        let row = rows.iter().find(|r| r["filter"] == filter && r["quantity"] == quantity);
        row.expect("a row")["mean"].as_f64().unwrap()
    };
    assert!(rows.iter().all(|row| row["case"] == "large-initial"));
    for filter in ["mfgi", "mfgb"] {
        assert!(mean(filter, "attitude_deg") < 10.0);
        assert!(mean(filter, "attitude_deg") < mean("mekf", "attitude_deg"));
        for quantity in ["nees_attitude", "nees_position", "nees_velocity", "nis_position"] {
            let value = mean(filter, quantity);
            assert!(value > 1.0 && value < 6.0, "{filter} {quantity} {value}");
        }
    }
}

/// The rows of a table without its header.
fn rows(path: &Path) -> Vec<Vec<f64>> {
    let row = |line: &String| line.split(',').map(|x| x.parse().unwrap()).collect();
    lines(path)[1..].iter().map(row).collect()
}

/// Latitude and longitude (deg) of a place east and north of the origin by so little that the
/// earth's radii of curvature there do.
fn place(east: f64, north: f64) -> [f64; 2] {
    let (latitude, longitude) = (48.0_f64, 11.0);
    let e2 = 0.006_694_379_990_14;
    let w = 1.0 - e2 * latitude.to_radians().sin().powi(2);
    let meridian = 6_378_137.0 * (1.0 - e2) / w.powf(1.5);
    let normal = 6_378_137.0 / w.sqrt();
    [
        latitude + (north / meridian).to_degrees(),
        longitude + (east / (normal * latitude.to_radians().cos())).to_degrees(),
    ]
}

fn nmea(t: f64, [latitude, longitude]: [f64; 2], height: f64) -> String {
    let angle = |degrees: f64, width: usize| {
        let minutes = degrees.fract() * 60.0;
        format!("{:0width$}{minutes:011.8}", degrees.trunc())
    };
    let (hours, minutes) = ((t / 3600.0).floor(), (t / 60.0).floor() % 60.0);
    let body = format!(
        "GPGGA,{hours:02}{minutes:02}{:06.3},{},N,{},E,4,12,0.6,{height:.3},M,0.0,M,,",
        t % 60.0,
        angle(latitude, 2),
        angle(longitude, 3),
    );
    let sum = body.bytes().fold(0, |sum, byte| sum ^ byte);
    format!("${body}*{sum:02X}\n")
}

/// Local positions, z up and z down, places by angles, and NMEA sentences: the same drive.
#[test]
fn a_drive_in_other_coordinates_is_the_same_drive() {
    let drive = drive(60);
    let fixes = rows(&drive.gps);
    let mut tables = [
        String::from("t,north,east,down\n"),
        String::from("t,latitude,longitude,height\n"),
        String::new(),
    ];
    for fix in &fixes {
        let [t, x, y, z] = fix[..] else { panic!("{fix:?}") };
        let [latitude, longitude] = place(x, y);
        writeln!(tables[0], "{t},{y},{x},{}", -z).unwrap();
        writeln!(tables[1], "{t},{latitude:.11},{longitude:.11},{}", z + 500.0).unwrap();
        tables[2].push_str(&nmea(t, [latitude, longitude], z + 500.0));
    }
    let more = [&SETTINGS[..], &["--json"]].concat();
    let local = json(&arguments(&drive.imu, &drive.gps, "mfgi", &more));
    assert!(local["datum"].is_null());
    let mean = |report: &serde_json::Value| report["nis"]["mean"].as_f64().unwrap();
    for (table, earth) in tables.iter().zip([false, true, true]) {
        let gps = drive.gps.with_file_name("other.txt");
        std::fs::write(&gps, table).unwrap();
        let report = json(&arguments(&drive.imu, &gps, "mfgi", &more));
        assert_eq!(report["datum"].is_array(), earth);
        assert!((mean(&report) - mean(&local)).abs() < 0.05, "{} {}", mean(&report), mean(&local));
        assert_eq!(report["fixes_used"], local["fixes_used"]);
    }
}

/// One MCAP file with `Imu` and `NavSatFix` in place of two tables; the fixes' covariance counts.
#[test]
fn a_log_with_both_streams_is_navigated() {
    let drive = drive(60);
    let mut messages = Vec::new();
    for row in rows(&drive.imu) {
        let stamp = Stamp::from_seconds(row[0]).unwrap();
        let vector = |at: usize| Vector3::new(row[at], row[at + 1], row[at + 2]);
        messages.push(support::ros2::imu("/imu/data", stamp, (vector(1), 1e-6), (vector(4), 1e-2)));
    }
    for row in rows(&drive.gps) {
        let [latitude, longitude] = place(row[1], row[2]);
        messages.push(nav_sat_fix(row[0], [latitude, longitude, row[3] + 500.0], FIX_SD));
    }
    messages.sort_by_key(|message| message.time);
    let log = support::ros2::write_mcap(&drive.imu.with_file_name("drive.mcap"), &messages);
    let settings = &SETTINGS[..6];
    let more = ["--topic", "imu=/imu/data", "--topic", "gnss=/fix", "--json"];
    let report = json(&[&["gnss", text(&log)], settings, &more].concat());
    assert!(report["datum"].is_array());
    assert_eq!(report["fixes_used"], 60);
    assert!(report["assumed"]["receiver.horizontal_noise"].is_null(), "{report}");
    let mean = report["nis"]["mean"].as_f64().unwrap();
    assert!(mean > 2.0 && mean < 4.0, "{mean}");
    assert!(report["heading_converged_s"].is_number(), "{report}");
    let missing = fail(&["gnss", text(&log), "--topic", "gnss=/gps"]);
    assert!(missing.contains("drive.mcap") && missing.contains("/fix"), "{missing}");
}

fn nav_sat_fix(t: f64, place: [f64; 3], sd: f64) -> Message {
    let stamp = Stamp::from_seconds(t).unwrap();
    let variance = sd * sd;
    let body = Body::new(stamp, "gps")
        .number([0])
        .number(1_u16.to_le_bytes())
        .numbers(place)
        .numbers([variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance])
        .number([2]);
    Message::new("/fix", "NavSatFix", stamp, body)
}

/// A noise that is wrong by a factor of four, either way: nothing is said of the heading.
#[test]
fn a_heading_is_not_told_where_the_innovations_contradict_it() {
    let drive = drive(90);
    for (noise, too) in [("0.125", "small"), ("2", "large")] {
        let noise = [
            format!("receiver.horizontal_noise={noise}"),
            format!("receiver.vertical_noise={noise}"),
        ];
        let mut more = SETTINGS.to_vec();
        more.extend(["--set", &noise[0], "--set", &noise[1], "--json"]);
        let report = json(&arguments(&drive.imu, &drive.gps, "mfgi", &more));
        assert!(report["heading_converged_s"].is_null(), "{report}");
        assert_eq!(report["heading"]["consistent"], false);
        let advice = report["heading"]["advice"].as_str().unwrap();
        assert!(advice.contains(too) && advice.contains("noise"), "{advice}");
    }
}

#[test]
fn what_is_assumed_is_said() {
    let drive = drive(20);
    let report = json(&arguments(&drive.imu, &drive.gps, "mfgi", &["--json"]));
    assert_eq!(report["assumed"]["receiver.horizontal_noise"], 2.0);
    let set = ["--set", "receiver.horizontal_noise=0.5", "--json"];
    let report = json(&arguments(&drive.imu, &drive.gps, "mfgi", &set));
    assert!(report["assumed"]["receiver.horizontal_noise"].is_null(), "{report}");
    let said = support::succeed(&arguments(&drive.imu, &drive.gps, "mfgi", &[]));
    assert!(said.contains("assumed") && said.contains("receiver.vertical_noise"), "{said}");
}

#[test]
fn wrong_units_and_outages_are_refused_with_the_setting() {
    let drive = drive(60);
    let beyond = ["--outage", "50,20"];
    let message = fail(&arguments(&drive.imu, &drive.gps, "mfgi", &beyond));
    assert!(message.contains("outage") && message.contains("59.0 s"), "{message}");
    let table = lines(&drive.imu);
    let scaled = |factors: [f64; 7]| {
        let mut text = format!("{}\n", table[0]);
        for row in rows(&drive.imu) {
            let row: Vec<String> =
                row.iter().zip(factors).map(|(x, factor)| (x * factor).to_string()).collect();
            writeln!(text, "{}", row.join(",")).unwrap();
        }
        let path = drive.imu.with_file_name("scaled.csv");
        std::fs::write(&path, text).unwrap();
        path
    };
    let degrees = 1.0_f64.to_degrees();
    for (factors, setting) in [
        ([1.0, 1.0, 1.0, 1.0, 1.0 / 9.80665, 1.0 / 9.80665, 1.0 / 9.80665], "accelerometer_scale"),
        ([1.0, degrees, degrees, degrees, 1.0, 1.0, 1.0], "gyroscope_scale"),
        ([1e3, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0], "1e-3 s"),
    ] {
        let message = fail(&arguments(&scaled(factors), &drive.gps, "mfgi", &SETTINGS));
        assert!(message.contains(setting), "{message}");
        assert_eq!(message.trim_end().lines().count(), 1, "{message}");
    }
}
