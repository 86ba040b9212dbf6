//! `convert` end to end: what goes in comes out again.

mod support;

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use mfg_vio::config::Config;
use mfg_vio::dataset::{LogConfig, open};
use mfg_vio::inertial::ImuConfig;
use mfg_vio::sensor::{CameraConfig, Event, RgbdFrame, Stamp};
use nalgebra::Isometry3;
use support::{json, mfg_vio, recording, simulated_log, succeed, text};

fn events(path: &Path, log: &LogConfig) -> Vec<Event> {
    let mut log = open(path, log, &ImuConfig::default()).unwrap();
    let events = std::iter::from_fn(|| log.next_event()).collect();
    assert!(log.report().skipped.is_empty(), "{:?}", log.report());
    events
}

/// Log times of a log by topic.
fn log_times(path: &Path) -> Vec<(String, u64, Vec<u8>)> {
    let bytes = std::fs::read(path).unwrap();
    let stream = mcap::MessageStream::new(&bytes).unwrap();
    stream
        .map(|message| {
            let message = message.unwrap();
            (message.channel.topic.clone(), message.log_time, message.data.to_vec())
        })
        .collect()
}

#[test]
fn a_log_of_ros_2_messages_stays_as_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let copy = folder.path().join("copy.mcap");
    let printed = succeed(&["convert", text(simulated_log()), text(&copy)]);
    assert!(printed.contains("/cam0/color"), "{printed}");
    assert!(log_times(simulated_log()) == log_times(&copy), "messages or log times differ");
}

#[test]
fn unnamed_channel_order_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, log, copy) = (
        folder.path().join("scene.toml"),
        folder.path().join("log.mcap"),
        folder.path().join("copy.mcap"),
    );
    let quirks = "duration = 0.2\n[log]\nquirks = \"vcu-rvi\"\nlog_time_offset = 1.5e9\n";
    std::fs::write(&scene, quirks).unwrap();
    succeed(&["simulate", "--config", text(&scene), "--out", text(&log)]);
    succeed(&["convert", text(&log), text(&copy)]);
    let encoding = |path: &Path| {
        json(&["info", text(path), "--json"])["topics"]["/cam0/color"]["encoding"].clone()
    };
    assert_eq!((encoding(&log), encoding(&copy)), ("8UC3".into(), "bgr8".into()));
    assert_eq!(events(&log, &LogConfig::default()), events(&copy, &LogConfig::default()));
    let (before, after) = (log_times(&log), log_times(&copy));
    assert!(before.iter().map(|m| m.1).eq(after.iter().map(|m| m.1)));
    assert!(before[0].1 > 1_500_000_000_000_000_000);
}

#[test]
fn a_folder_becomes_a_log_that_is_replayed_like_it() {
    let Some(folder) = recording("tum_fr1_rpy") else { return };
    let directory = tempfile::tempdir().unwrap();
    let copy = directory.path().join("tum.mcap");
    succeed(&["convert", text(&folder), text(&copy)]);
    let found = json(&["info", text(&copy), "--json"]);
    assert_eq!(found["config_name"], "tum_rgbd");
    assert_eq!(found["verdict"]["fit"], true, "{found:#}");
    assert_eq!(found["topics"]["/cam0/depth"]["encoding"], "32FC1");
    let config = LogConfig { depth_scale: 0.0002, ..LogConfig::default() };
    let (before, after) = (events(&folder, &config), events(&copy, &config));
    let stamps = |events: &[Event]| events.iter().map(Event::stamp).collect::<Vec<Stamp>>();
    assert_eq!(stamps(&before), stamps(&after));
    for (before, after) in before.iter().zip(&after) {
        match (before, after) {
            (Event::Frame(before), Event::Frame(after)) => {
                assert!(before.color == after.color);
                let agree =
                    |(x, y): (usize, usize)| match (before.depth.at(x, y), after.depth.at(x, y)) {
                        (Some(a), Some(b)) => (a - b).abs() < 0.000_51,
                        (a, b) => a.is_none() && b.is_none(),
                    };
                assert!((0..480).flat_map(|y| (0..640).map(move |x| (x, y))).all(agree));
            }
            (Event::Truth(before), Event::Truth(after)) => {
                let moved = before.world_from_body.inv_mul(&after.world_from_body);
                assert!(moved.translation.vector.norm() < 1e-12 && moved.rotation.angle() < 1e-7);
            }
            (before, after) => assert_eq!(before, after),
        }
    }
}

#[test]
fn failures_name_the_file() {
    let log = text(simulated_log());
    for (arguments, part) in [
        (["convert", log, "/nonexistent/out.mcap"], "/nonexistent/out.mcap"),
        (["convert", "/nonexistent/in.bag", "out.mcap"], "/nonexistent/in.bag"),
    ] {
        let output = mfg_vio(&arguments);
        let message = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{message}");
        assert!(message.lines().count() == 1 && message.contains(part), "{message}");
    }
    assert_eq!(mfg_vio(&["convert", log]).status.code(), Some(2));
}

/// A EuRoC folder of a simulated room, seen by two cameras side by side, and beside it the logs of
/// both, `cam0.mcap` and `cam1.mcap`, with the true depth. Made once for the tests of this file.
fn stereo_folder() -> &'static Path {
    static FOLDER: OnceLock<(tempfile::TempDir, PathBuf)> = OnceLock::new();
    let make = || {
        let directory = tempfile::tempdir().unwrap();
        let root = make_stereo_folder(directory.path());
        (directory, root)
    };
    &FOLDER.get_or_init(make).1
}

/// The left and the right camera.
fn cameras() -> [CameraConfig; 2] {
    [0.0, BASELINE].map(|x| {
        let mount = CameraConfig { imu_from_camera: MOUNT, ..CameraConfig::default() };
        let mount = mount.imu_from_camera().unwrap() * Isometry3::translation(x, 0.0, 0.0);
        let mount = mount.to_homogeneous();
        CameraConfig {
            fx: FOCAL,
            fy: FOCAL,
            cx: 159.5,
            cy: 119.5,
            imu_from_camera: std::array::from_fn(|r| std::array::from_fn(|c| mount[(r, c)])),
            ..CameraConfig::default()
        }
    })
}

fn make_stereo_folder(folder: &Path) -> PathBuf {
    const SCENE: &str = "duration = 3.0\n[room]\ntexel = 0.01\n[image]\nwidth = 320\nheight = 240\n\
                         rate = 20.0\n";
    let mounts = cameras().map(|camera| camera.imu_from_camera);
    let root = folder.join("mav0");
    for (name, mount) in ["cam0", "cam1"].iter().zip(mounts) {
        let rows = |row: usize| mount[row].map(|number| format!("{number:.9}")).join(", ");
        let camera = format!(
            "[camera]\nfx = {FOCAL}\nfy = {FOCAL}\ncx = 159.5\ncy = 119.5\n\
             imu_from_camera = [[{}], [{}], [{}], [{}]]\n",
            rows(0),
            rows(1),
            rows(2),
            rows(3)
        );
        let (scene, log) = (folder.join("scene.toml"), folder.join(format!("{name}.mcap")));
        std::fs::write(&scene, format!("{SCENE}{camera}")).unwrap();
        succeed(&["simulate", "--config", text(&scene), "--out", text(&log)]);
        let data = root.join(name).join("data");
        std::fs::create_dir_all(&data).unwrap();
        let matrix = (0..4).map(rows).collect::<Vec<_>>().join(",\n  ");
        let calibration = format!(
            "sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{matrix}]\nrate_hz: 20\n\
             resolution: [320, 240]\ncamera_model: pinhole\nintrinsics: [{FOCAL}, {FOCAL}, 159.5, \
             119.5]\ndistortion_model: radial-tangential\n\
             distortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n"
        );
        std::fs::write(root.join(name).join("sensor.yaml"), calibration).unwrap();
        let mut rows = "#timestamp [ns],filename\n".to_owned();
        for event in events(&log, &LogConfig::default()) {
            let Event::Frame(frame) = event else { continue };
            let file = format!("{}.png", frame.stamp.nanos());
            let grey = frame.color.data().chunks(3).map(|p| p[1]).collect();
            let grey = image::GrayImage::from_raw(320, 240, grey).unwrap();
            grey.save(data.join(&file)).unwrap();
            rows += &format!("{},{file}\n", frame.stamp.nanos());
        }
        std::fs::write(root.join(name).join("data.csv"), rows).unwrap();
    }
    let (mut imu, mut truth) = ("#timestamp [ns],w,a\n".to_owned(), "#timestamp,p,q\n".to_owned());
    for event in events(&folder.join("cam0.mcap"), &LogConfig::default()) {
        match event {
            Event::Imu(s) => {
                let (w, a) = (s.angular_velocity, s.specific_force);
                let t = s.stamp.nanos();
                imu += &format!("{t},{},{},{},{},{},{}\n", w.x, w.y, w.z, a.x, a.y, a.z);
            }
            Event::Repeated(..) => {}
            Event::Truth(pose) => {
                let (p, q) = (pose.world_from_body.translation, pose.world_from_body.rotation);
                let t = pose.stamp.nanos();
                truth +=
                    &format!("{t},{},{},{},{},{},{},{},0,0,0\n", p.x, p.y, p.z, q.w, q.i, q.j, q.k);
            }
            Event::Frame(_) => {}
        }
    }
    for (name, rows) in [("imu0", imu), ("state_groundtruth_estimate0", truth)] {
        std::fs::create_dir_all(root.join(name)).unwrap();
        std::fs::write(root.join(name).join("data.csv"), rows).unwrap();
    }
    root
}

const BASELINE: f64 = 0.11;
const FOCAL: f64 = 230.0;
const MOUNT: [[f64; 4]; 4] =
    [[0.0, -1.0, 0.0, -0.02], [-1.0, 0.0, 0.0, 0.03], [0.0, 0.0, -1.0, 0.01], [0.0, 0.0, 0.0, 1.0]];

fn frames(path: &Path, log: &LogConfig) -> Vec<RgbdFrame> {
    let frame = |event| match event {
        Event::Frame(frame) => Some(*frame),
        _ => None,
    };
    events(path, log).into_iter().filter_map(frame).collect()
}

#[test]
fn stereo_folders_have_the_depth_of_their_disparity() {
    let directory = tempfile::tempdir().unwrap();
    let folder = stereo_folder();
    let found = json(&["info", text(folder), "--json"]);
    assert_eq!((&found["kind"], &found["config_name"]), (&"EuRoC folder".into(), &"euroc".into()));
    assert_eq!(found["verdict"]["fit"], true, "{found:#}");
    assert_eq!(found["pairs"]["frames"], 61);

    let stereo = frames(folder, &LogConfig::default());
    // The cameras are parallel: the left image is rectified as it is.
    let truth = frames(&folder.with_file_name("cam0.mcap"), &LogConfig::default());
    assert_eq!(stereo.len(), 61);
    let mut errors = Vec::new();
    for (stereo, truth) in stereo.iter().zip(&truth).step_by(10) {
        for (row, column) in (0..240).flat_map(|row| (0..320).map(move |column| (row, column))) {
            let depths = (stereo.depth.at(column, row), truth.depth.at(column, row));
            let (Some(measured), Some(depth)) = depths else { continue };
            errors
                .push(FOCAL * BASELINE * (f64::from(measured).recip() - f64::from(depth).recip()));
        }
    }
    // In pixels of disparity; windows that span an edge err.
    errors.sort_by(|a, b| a.abs().total_cmp(&b.abs()));
    assert!(errors.len() > 40_000, "{}", errors.len());
    let part = |percent: usize| errors[errors.len() * percent / 100].abs();
    assert!(part(68) < 0.5 && part(90) < 2.0, "{} {}", part(68), part(90));

    let copy = directory.path().join("stereo.mcap");
    succeed(&["convert", text(folder), text(&copy)]);
    assert_eq!(frames(&copy, &LogConfig::default()), without_others(stereo));
    let again = json(&["info", text(&copy), "--json"]);
    assert_eq!(again["config_name"], "euroc");
    assert_eq!(again["camera"], found["camera"]);

    if cfg!(feature = "vision") {
        let metrics = json(&["replay", text(&copy), "--json"]);
        let rmse = metrics["evaluation"]["ape_translation"]["rmse"].as_f64().unwrap();
        assert!(rmse < 0.05, "{rmse}");
    }
}

/// What a copy holds of frames: color and depth.
fn without_others(frames: Vec<RgbdFrame>) -> Vec<RgbdFrame> {
    frames.into_iter().map(|frame| RgbdFrame { others: Vec::new(), ..frame }).collect()
}

/// The recording of [`stereo_folder`] with its images on two topics.
fn stereo_topics(path: &Path) {
    let mut messages = Vec::new();
    let topics = [
        ("cam0", "/cam0/color", "/cam0/image_raw"),
        ("cam1", "/cam0/color", "/cam1/image_raw"),
        ("cam0", "/imu", "/imu0"),
        ("cam0", "/truth/pose", "/truth/pose"),
    ];
    for (log, from, to) in topics {
        let bytes = std::fs::read(stereo_folder().with_file_name(format!("{log}.mcap"))).unwrap();
        for message in mcap::MessageStream::new(&bytes).unwrap() {
            let message = message.unwrap();
            if message.channel.topic == from {
                let data = message.data.to_vec();
                let schema = message.channel.schema.clone().unwrap();
                messages.push((
                    message.log_time,
                    to,
                    schema.name.clone(),
                    schema.data.to_vec(),
                    data,
                ));
            }
        }
    }
    messages.sort_by_key(|message| message.0);
    let mut writer = mcap::Writer::new(Cursor::new(Vec::new())).unwrap();
    for (log_time, topic, schema, definition, data) in messages {
        let schema = writer.add_schema(&schema, "ros2msg", &definition).unwrap();
        let channel_id = writer.add_channel(schema, topic, "cdr", &BTreeMap::new()).unwrap();
        let header = mcap::records::MessageHeader {
            channel_id,
            sequence: 0,
            log_time,
            publish_time: log_time,
        };
        writer.write_to_known_channel(&header, &data).unwrap();
    }
    writer.finish().unwrap();
    std::fs::write(path, writer.into_inner().into_inner()).unwrap();
}

#[test]
fn stereo_topics_have_the_depth_of_their_disparity() {
    let directory = tempfile::tempdir().unwrap();
    let (log, copy) = (directory.path().join("log.mcap"), directory.path().join("copy.mcap"));
    stereo_topics(&log);
    let mut config = Config::shipped("euroc", &[]).unwrap();
    config.log.stereo = cameras().into();
    let file = directory.path().join("rig.toml");
    std::fs::write(&file, toml::to_string(&config).unwrap()).unwrap();

    let found = json(&["info", text(&log), "--config", text(&file), "--json"]);
    assert_eq!(found["config_name"], "euroc");
    assert_eq!(found["verdict"]["fit"], true, "{found:#}");
    assert_eq!(found["pairs"]["frames"], 61);
    assert_eq!(found["camera"]["fx"], FOCAL);
    // As from the folder, whose images are grey.
    let stereo = frames(&log, &config.log);
    let in_folder = frames(stereo_folder(), &LogConfig::default());
    let measured = |frames: &[RgbdFrame]| {
        frames.iter().flat_map(|frame| frame.depth.data()).filter(|raw| **raw > 0).count() as f64
    };
    assert_eq!(stereo.len(), in_folder.len());
    assert!((measured(&stereo) / measured(&in_folder) - 1.0).abs() < 0.1);

    succeed(&["convert", text(&log), text(&copy), "--config", text(&file)]);
    assert_eq!(frames(&copy, &LogConfig::default()), without_others(stereo));
    if cfg!(feature = "vision") {
        let metrics = json(&["replay", text(&log), "--config", text(&file), "--json"]);
        let rmse = metrics["evaluation"]["ape_translation"]["rmse"].as_f64().unwrap();
        assert!(rmse < 0.05, "{rmse}");
    }

    // Without the calibrations.
    let naive = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/sim.toml");
    let found = json(&["info", text(&log), "--config", text(&naive), "--json"]);
    assert_eq!(found["verdict"]["fit"], false);
    assert!(found["verdict"]["text"].as_str().unwrap().contains("`log.stereo`"), "{found:#}");
    let error = open(&log, &LogConfig::default(), &ImuConfig::default()).err().unwrap();
    assert!(error.to_string().contains("`log.stereo`"), "{error}");
}

#[test]
#[cfg(unix)]
fn a_sensor_without_its_rows_is_a_warning() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("mav0");
    std::fs::create_dir(&root).unwrap();
    for camera in ["cam0", "cam1"] {
        std::os::unix::fs::symlink(stereo_folder().join(camera), root.join(camera)).unwrap();
    }
    for sensor in ["imu0", "state_groundtruth_estimate0"] {
        std::fs::create_dir(root.join(sensor)).unwrap();
    }
    let output = mfg_vio(&["info", text(folder.path())]);
    let errors = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(0), "{errors}");
    // The folder is named: it is there, and its file is not.
    assert!(errors.contains("WARN") && errors.contains("mav0/imu0: no data.csv in it"), "{errors}");
}
