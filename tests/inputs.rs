//! What recorders and drivers write: containers, messages, encodings and layouts, each read right or
//! refused in one sentence.

mod support;

use std::io::Cursor;
use std::path::{Path, PathBuf};

use image::{DynamicImage, ImageFormat};
use mfg_vio::dataset::{LogConfig, NavigationTopics, open, read_navigation};
use mfg_vio::inertial::ImuConfig;
use mfg_vio::sensor::{Event, ImuSample, PixelFormat, RgbdFrame};
use nalgebra::Vector3;
use support::ros2::{
    Message, camera_info, compressed, depth_bytes, image, imu, mcap_bytes, plain_color,
    plain_depth, plain_imu, recording, write_db3, write_mcap,
};
use support::{fail, json, mfg_vio, text};

fn events(path: &Path) -> Vec<Event> {
    let mut log = open(path, &LogConfig::default(), &ImuConfig::default()).unwrap();
    let events = std::iter::from_fn(|| log.next_event()).collect();
    assert!(log.report().skipped.is_empty(), "{}: {:?}", path.display(), log.report());
    events
}

fn plain() -> Vec<Message> {
    recording().messages(plain_color, plain_depth, plain_imu)
}

fn compress(bytes: &[u8]) -> Vec<u8> {
    zstd::encode_all(bytes, 1).unwrap()
}

/// The same recording under everything that `ros2 bag record` can leave.
#[test]
fn every_container_of_ros_2_yields_the_same_events() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| {
        let path = folder.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        path
    };
    let messages = plain();
    let (first, second) = messages.split_at(messages.len() / 2);
    let packed: Vec<Message> =
        messages.iter().map(|m| Message { body: compress(&m.body), ..m.clone() }).collect();
    let expected = events(&write_mcap(&path("plain.mcap"), &messages));

    write_db3(&path("database/rec_0.db3"), &messages);
    std::fs::write(path("database/metadata.yaml"), "rosbag2_bagfile_information:\n  version: 8\n")
        .unwrap();
    write_mcap(&path("split/rec_0.mcap"), first);
    write_mcap(&path("split/rec_1.mcap"), second);
    // The metadata of another recording.
    std::fs::write(path("split/metadata.yaml"), "a:\n  relative_file_paths:\n    - x.mcap\n")
        .unwrap();
    let database = write_db3(&path("part.db3"), first);
    std::fs::write(
        path("packed_files/rec_0.db3.zstd"),
        compress(&std::fs::read(database).unwrap()),
    )
    .unwrap();
    let rest = write_db3(&path("rest.db3"), second);
    std::fs::write(path("packed_files/rec_1.db3.zstd"), compress(&std::fs::read(rest).unwrap()))
        .unwrap();
    write_db3(&path("packed_messages/rec_0.db3"), &packed);
    std::fs::write(path("log.mcap.zst"), compress(&mcap_bytes(&messages))).unwrap();
    write_mcap(&path("killed/rec_0.mcap"), &messages);
    std::fs::write(path("killed/rec_1.mcap"), b"").unwrap();
    for name in [
        "database",
        "database/rec_0.db3",
        "split",
        "packed_files",
        "packed_messages",
        "log.mcap.zst",
        "killed",
    ] {
        assert!(events(&path(name)) == expected, "{name} differs");
    }
    // Nothing is left beside what was read.
    assert_eq!(std::fs::read_dir(path("database")).unwrap().count(), 2);
}

#[test]
fn a_damaged_database_yields_a_sentence() {
    let folder = tempfile::tempdir().unwrap();
    let whole = std::fs::read(write_db3(&folder.path().join("a.db3"), &plain()[..400])).unwrap();
    for cut in [1000, whole.len() / 2] {
        let path = folder.path().join("cut.db3");
        std::fs::write(&path, &whole[..cut]).unwrap();
        let output = mfg_vio(&["info", text(&path)]);
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() < Some(2) && !errors.contains("panicked"), "{errors}");
        if output.status.code() == Some(1) {
            assert!(errors.contains("cut.db3") && errors.trim().lines().count() == 1, "{errors}");
        }
    }
}

/// The IMU samples of a log of which the images are not wanted.
fn samples(path: &Path) -> Vec<ImuSample> {
    let log = read_navigation(path, &NavigationTopics::default(), &ImuConfig::default()).unwrap();
    assert!(log.report.skipped.is_empty(), "{:?}", log.report);
    log.imu
}

/// How an IMU's halves may be logged: at two rates on two topics, the accelerometer 1.3 ms late.
fn halves(marks: (f64, f64), every: usize) -> impl FnMut(&ImuSample) -> Vec<Message> {
    let mut count = 0;
    move |sample| {
        let ImuSample { stamp, angular_velocity, specific_force } = *sample;
        let zero = Vector3::zeros();
        let late = stamp.offset_by(1.3e-3);
        let gyro = imu("/camera/gyro/sample", stamp, (angular_velocity, marks.0), (zero, marks.1));
        let accel = imu("/camera/accel/sample", late, (zero, marks.1), (specific_force, marks.0));
        count += 1;
        if (count - 1) % every == 0 { vec![gyro, accel] } else { vec![gyro] }
    }
}

#[test]
fn an_imu_in_halves_is_united() {
    let folder = tempfile::tempdir().unwrap();
    let whole = &recording().imu;
    for (name, marks) in [("zeros", (0.01, 0.01)), ("marked", (0.01, -1.0))] {
        for every in [1, 3] {
            let messages = recording().messages(plain_color, plain_depth, halves(marks, every));
            let path = write_mcap(&folder.path().join("log.mcap"), &messages);
            let united = samples(&path);
            assert_eq!(united.len(), whole.len(), "{name}");
            for (whole, united) in whole.iter().zip(&united) {
                assert_eq!(whole.stamp, united.stamp);
                assert_eq!(whole.angular_velocity, united.angular_velocity);
                // As far as the force changes between two readings, noise included.
                let error = (whole.specific_force - united.specific_force).norm();
                assert!(error < 0.7, "{name}, one in {every}: {error} at {}", whole.stamp);
            }
        }
    }
}

#[test]
fn an_imu_in_halves_on_one_topic_is_united() {
    let folder = tempfile::tempdir().unwrap();
    for mark in [0.01, -1.0] {
        let mut split = halves((0.01, mark), 2);
        let one_topic = |sample: &ImuSample| {
            let topic = "/imu".to_owned();
            split(sample).into_iter().map(|m| Message { topic: topic.clone(), ..m }).collect()
        };
        let messages = recording().messages(plain_color, plain_depth, one_topic);
        let united = samples(&write_mcap(&folder.path().join("log.mcap"), &messages));
        assert_eq!(united.len(), recording().imu.len());
    }
}

#[test]
fn the_united_topic_is_preferred_and_a_lone_gyroscope_is_no_imu() {
    let folder = tempfile::tempdir().unwrap();
    let mut split = halves((0.01, 0.01), 3);
    let both = |sample: &ImuSample| [split(sample), plain_imu(sample)].concat();
    let messages = recording().messages(plain_color, plain_depth, both);
    let info =
        json(&["info", text(&write_mcap(&folder.path().join("a.mcap"), &messages)), "--json"]);
    assert_eq!(info["sources"]["imu"], "/imu");
    assert_eq!(info["sources"].get("accelerometer"), None);
    let lone: Vec<Message> =
        messages.into_iter().filter(|m| m.topic != "/imu" && !m.topic.contains("accel")).collect();
    let path = write_mcap(&folder.path().join("b.mcap"), &lone);
    let output = mfg_vio(&["replay", text(&path), "--json"]);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(errors.contains("/camera/gyro/sample has no accelerometer"), "{errors}");
}

/// The root mean square of the position error, m, and the frames that were processed.
fn replayed(path: &Path) -> (f64, u64) {
    // The fixtures have no CameraInfo.
    let metrics = json(&["replay", text(path), "--config", "configs/sim.toml", "--json"]);
    let error = metrics["evaluation"]["ape_translation"]["rmse"].as_f64();
    (error.unwrap_or_else(|| panic!("{metrics}")), metrics["frames_processed"].as_u64().unwrap())
}

#[test]
fn replay_of_an_imu_in_halves_is_as_good_as_of_a_whole_one() {
    let folder = tempfile::tempdir().unwrap();
    let (error, frames) = replayed(&write_mcap(&folder.path().join("whole.mcap"), &plain()));
    let messages = recording().messages(plain_color, plain_depth, halves((0.01, 0.01), 3));
    let split = replayed(&write_mcap(&folder.path().join("split.mcap"), &messages));
    assert_eq!(split.1, frames);
    // A third of the accelerometer's readings: its noise, not the method, may cost something.
    assert!(split.0 < 2.0 * error + 1e-3, "{split:?}, whole {error}");
}

fn rgb(frame: &RgbdFrame) -> impl Iterator<Item = [u8; 3]> {
    assert_eq!(frame.color.format(), PixelFormat::Rgb8);
    frame.color.data().as_chunks::<3>().0.iter().copied()
}

fn grey([r, g, b]: [u8; 3]) -> f64 {
    0.299 * f64::from(r) + 0.587 * f64::from(g) + 0.114 * f64::from(b)
}

/// The pixels of a frame in an encoding.
fn encoded(frame: &RgbdFrame, encoding: &str) -> Vec<u8> {
    let width = frame.color.width();
    let byte = |value: f64| value.round().clamp(0.0, 255.0) as u8;
    // ITU-R BT.601, 16 to 235.
    let luminance = |p: [u8; 3]| byte(16.0 + grey(p) * 219.0 / 255.0);
    let chroma = |p: [u8; 3]| {
        let scale = 224.0 / 255.0;
        let u = (f64::from(p[2]) - grey(p)) / 1.772;
        let v = (f64::from(p[0]) - grey(p)) / 1.402;
        [byte(128.0 + scale * u), byte(128.0 + scale * v)]
    };
    match encoding {
        "bgra8" | "8UC4" | "BGRA8" => rgb(frame).flat_map(|[r, g, b]| [b, g, r, 255]).collect(),
        "rgba8" => rgb(frame).flat_map(|[r, g, b]| [r, g, b, 255]).collect(),
        "bgr16" => rgb(frame).flat_map(|[r, g, b]| [b, b, g, g, r, r]).collect(),
        "mono8" => rgb(frame).map(|p| byte(grey(p))).collect(),
        "mono16" => rgb(frame).flat_map(|p| [byte(grey(p)); 2]).collect(),
        "yuv422" | "yuv422_yuy2" => {
            let pixels: Vec<[u8; 3]> = rgb(frame).collect();
            let pairs = pixels.as_chunks::<2>().0.iter().flat_map(|[first, second]| {
                let mean = std::array::from_fn(|c| first[c].midpoint(second[c]));
                let ([u, v], [a, b]) = (chroma(mean), [luminance(*first), luminance(*second)]);
                if encoding == "yuv422" { [u, a, v, b] } else { [a, u, b, v] }
            });
            pairs.collect()
        }
        _ => {
            let colors = match encoding {
                "bayer_rggb8" => [0, 1, 1, 2],
                "bayer_bggr8" => [2, 1, 1, 0],
                "bayer_gbrg8" => [1, 2, 0, 1],
                _ => [1, 0, 2, 1],
            };
            let pixel = |(i, p): (usize, [u8; 3])| p[colors[i / width % 2 * 2 + i % width % 2]];
            rgb(frame).enumerate().map(pixel).collect()
        }
    }
}

/// Mean difference of the grey values of two images.
fn difference(read: &RgbdFrame, original: &RgbdFrame) -> f64 {
    let count = original.color.width() * original.color.height();
    let greys: Vec<f64> = match read.color.format() {
        PixelFormat::Mono8 => read.color.data().iter().map(|v| f64::from(*v)).collect(),
        PixelFormat::Rgb8 => rgb(read).map(grey).collect(),
        PixelFormat::Bgr8 => {
            let pixels = read.color.data().as_chunks::<3>().0;
            pixels.iter().map(|[b, g, r]| grey([*r, *g, *b])).collect()
        }
    };
    let differences = greys.iter().zip(rgb(original)).map(|(read, p)| (read - grey(p)).abs());
    differences.sum::<f64>() / count as f64
}

/// The most that an encoding may change grey values by in the mean: rounding, or what it does not
/// hold at all (colors between those of a mosaic).
const ENCODINGS: [(&str, f64); 12] = [
    ("bgra8", 0.0),
    ("BGRA8", 0.0),
    ("8UC4", 0.0),
    ("rgba8", 0.0),
    ("bgr16", 0.0),
    ("mono8", 0.5),
    ("mono16", 0.5),
    ("yuv422", 1.0),
    ("yuv422_yuy2", 1.0),
    ("bayer_rggb8", 4.0),
    ("bayer_gbrg8", 4.0),
    ("bayer_bggr8", 4.0),
];

#[test]
fn every_encoding_of_color_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let original = &recording().frames[0];
    for (encoding, limit) in ENCODINGS {
        let color = &original.color;
        let size = (color.width(), color.height());
        let data = encoded(original, encoding);
        let messages =
            [image("/color", original.stamp, encoding, size, &data), plain_depth(original)];
        let read = events(&write_mcap(&folder.path().join("log.mcap"), &messages));
        let [Event::Frame(frame)] = &read[..] else { panic!("{encoding}: {read:?}") };
        let difference = difference(frame, original);
        assert!(difference <= limit, "{encoding}: {difference}");
    }
}

#[test]
fn replay_of_a_mosaic_and_of_shared_chroma_follows_the_camera() {
    let folder = tempfile::tempdir().unwrap();
    let (error, frames) = replayed(&write_mcap(&folder.path().join("rgb.mcap"), &plain()));
    for encoding in ["bayer_grbg8", "yuv422_yuy2"] {
        let color = |frame: &RgbdFrame| {
            let size = (frame.color.width(), frame.color.height());
            image("/cam0/color", frame.stamp, encoding, size, &encoded(frame, encoding))
        };
        let messages = recording().messages(color, plain_depth, plain_imu);
        let other = replayed(&write_mcap(&folder.path().join("other.mcap"), &messages));
        assert_eq!(other.1, frames, "{encoding}");
        // A mosaic resolves half as finely.
        assert!(other.0 < 2.0 * error + 1e-3, "{encoding}: {other:?}, rgb8 {error}");
    }
}

fn png_of(frame: &RgbdFrame, value: impl Fn(u16) -> u16) -> Vec<u8> {
    let (width, height) = (frame.depth.width() as u32, frame.depth.height() as u32);
    let values = frame.depth.data().iter().map(|raw| value(*raw)).collect();
    let pixels = image::ImageBuffer::from_vec(width, height, values).unwrap();
    let mut bytes = Cursor::new(Vec::new());
    DynamicImage::ImageLuma16(pixels).write_to(&mut bytes, ImageFormat::Png).unwrap();
    bytes.into_inner()
}

/// The reference encoder's rules: runs of zeros and others, differences as zigzag, nibbles.
fn rvl_of(frame: &RgbdFrame) -> Vec<u8> {
    let mut nibbles = Vec::new();
    let mut put = |mut value: u32| loop {
        let rest = value >> 3;
        nibbles.push((value & 7) | if rest > 0 { 8 } else { 0 });
        value = rest;
        if rest == 0 {
            break;
        }
    };
    let (mut values, mut previous) = (frame.depth.data(), 0_i32);
    while !values.is_empty() {
        let zeros = values.iter().take_while(|value| **value == 0).count();
        let others = values[zeros..].iter().take_while(|value| **value != 0).count();
        put(zeros as u32);
        put(others as u32);
        for value in &values[zeros..zeros + others] {
            let difference = i32::from(*value) - previous;
            put(((difference << 1) ^ (difference >> 31)).cast_unsigned());
            previous = i32::from(*value);
        }
        values = &values[zeros + others..];
    }
    nibbles.resize(nibbles.len().next_multiple_of(8), 0);
    let word = |nibbles: &[u32]| nibbles.iter().fold(0, |word, nibble| (word << 4) | nibble);
    let size = [frame.depth.width() as u32, frame.depth.height() as u32];
    let words = size.into_iter().chain(nibbles.chunks(8).map(word));
    words.flat_map(u32::to_le_bytes).collect()
}

#[test]
fn every_way_to_compress_depth_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let original = &recording().frames[0];
    let nothing = [0; 12];
    let png = png_of(original, |raw| raw);
    // 100 steps up to 10 m, as the plugin's defaults.
    let (a, b) = (10_100.0_f32, 1.0 - 1010.0_f32);
    let header = [[0; 4], a.to_le_bytes(), b.to_le_bytes()].concat();
    let inverse = png_of(original, |raw| match raw {
        0 => 0,
        raw => (a / (f32::from(raw) / 1000.0) + b).round() as u16,
    });
    let cases = [
        ("16UC1; compressedDepth", [&nothing[..], &png].concat(), 0.0),
        ("16UC1; compressedDepth png", [&nothing[..], &png].concat(), 0.0),
        ("png", png.clone(), 0.0),
        ("16UC1; png compressed ", png, 0.0),
        ("16UC1; compressedDepth rvl", [&nothing[..], &rvl_of(original)].concat(), 0.0),
        // Half a step of inverse depth: z^2 / (2 A).
        ("32FC1; compressedDepth png", [&header[..], &inverse].concat(), 0.5 / 10_100.0),
    ];
    for (format, data, step) in cases {
        let messages = [plain_color(original), compressed("/depth", original.stamp, format, &data)];
        let read = events(&write_mcap(&folder.path().join("log.mcap"), &messages));
        let [Event::Frame(frame)] = &read[..] else { panic!("{format}: {read:?}") };
        for (read, original) in frame.depth.data().iter().zip(original.depth.data()) {
            let metres = f64::from(*original) / 1000.0;
            let error = (f64::from(*read) / 1000.0 - metres).abs();
            // Both are rounded to millimetres.
            let limit = if step > 0.0 { 1.1e-3 + 1.1 * step * metres * metres } else { 0.0 };
            assert!(error <= limit, "{format}: {read} for {original}");
        }
    }
}

#[test]
fn encodings_that_are_not_read_are_named_with_those_that_are() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("log.mcap");
    let refused = |color: &dyn Fn(&RgbdFrame) -> Message, depth: &dyn Fn(&RgbdFrame) -> Message| {
        let messages = recording().messages(color, depth, plain_imu);
        fail(&["replay", text(&write_mcap(&path, &messages))])
    };
    let size = |frame: &RgbdFrame| (frame.color.width(), frame.color.height());
    let odd_color =
        |frame: &RgbdFrame| image("/c", frame.stamp, "8SC3", size(frame), frame.color.data());
    let error = refused(&odd_color, &plain_depth);
    assert!(
        error.contains("encoding 8SC3 of /c is not supported; supported are rgb8, "),
        "{error}"
    );
    let odd_depth =
        |frame: &RgbdFrame| image("/depth", frame.stamp, "16SC1", size(frame), &depth_bytes(frame));
    let error = refused(&plain_color, &odd_depth);
    let expected = "encoding 16SC1 of /depth is not supported; supported are 16UC1, ";
    assert!(error.contains(expected), "{error}");
    let lossy = |frame: &RgbdFrame| {
        let mut bytes = Cursor::new(Vec::new());
        let grey = image::GrayImage::from_pixel(64, 48, image::Luma([9]));
        DynamicImage::from(grey).write_to(&mut bytes, ImageFormat::Jpeg).unwrap();
        compressed("/d/compressed", frame.stamp, "16UC1; jpeg compressed ", bytes.get_ref())
    };
    let error = refused(&plain_color, &lossy);
    let expected = "encoding 16UC1; jpeg compressed of /d/compressed is not supported";
    assert!(error.contains(expected), "{error}");
    let stream = [&[0, 0, 0, 1, 0x67][..], &[0; 60]].concat();
    let video = |frame: &RgbdFrame| compressed("/c", frame.stamp, "h264", &stream);
    let error = refused(&video, &plain_depth);
    assert!(error.contains("encoding h264 of /c is not supported"), "{error}");
}

/// Depth of half as many pixels along a side as color.
fn half_depth(frame: &RgbdFrame) -> Message {
    let (width, height) = (frame.depth.width() / 2, frame.depth.height() / 2);
    let pixels = (0..width * height).map(|i| (i % width * 2, i / width * 2));
    let values = pixels.map(|(column, row)| frame.depth.data()[row * frame.depth.width() + column]);
    let data: Vec<u8> = values.flat_map(u16::to_le_bytes).collect();
    image("/depth/image_rect_raw", frame.stamp, "16UC1", (width, height), &data)
}

#[test]
fn depth_of_another_size_is_registered_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    let original = &recording().frames[0];
    let size = (original.color.width(), original.color.height());
    let color =
        |frame: &RgbdFrame| Message { topic: "/color/image_raw".to_owned(), ..plain_color(frame) };
    let messages = recording().messages(color, half_depth, plain_imu);
    let bare: Vec<Message> =
        messages.into_iter().filter(|m| !m.schema.contains("CameraInfo")).collect();
    let path = write_mcap(&folder.path().join("bare.mcap"), &bare);
    let opened = open(&path, &LogConfig::default(), &ImuConfig::default());
    let error = opened.err().unwrap().to_string();
    let expected = format!(
        "depth images of /depth/image_rect_raw ({}x{}) are not registered to color images of \
         /color/image_raw",
        size.0 / 2,
        size.1 / 2
    );
    assert!(error.contains(&expected), "{error}");
    let [fx, fy, cx, cy] = [460.0, 461.0, 330.0, 250.0];
    let half = [fx / 2.0, fy / 2.0, (cx + 0.5) / 2.0 - 0.5, (cy + 0.5) / 2.0 - 0.5];
    let stamp = original.stamp;
    let calibrated = [
        camera_info("/color/camera_info", stamp, size, [fx, fy, cx, cy]),
        camera_info("/depth/camera_info", stamp, (size.0 / 2, size.1 / 2), half),
        color(original),
        half_depth(original),
    ];
    let read = events(&write_mcap(&folder.path().join("calibrated.mcap"), &calibrated));
    let [Event::Frame(frame)] = &read[..] else { panic!("{read:?}") };
    for (index, depth) in frame.depth.data().iter().enumerate() {
        let (column, row) = (index % size.0 / 2 * 2, index / size.0 / 2 * 2);
        assert_eq!(*depth, original.depth.data()[row * size.0 + column], "pixel {index}");
    }
}

/// All files and folders of messages below a folder.
fn recordings(folder: &Path, found: &mut Vec<PathBuf>) {
    let mut entries: Vec<PathBuf> =
        std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    entries.sort();
    for path in entries {
        if path.is_dir() {
            found.push(path.clone());
            recordings(&path, found);
        } else {
            found.push(path);
        }
    }
}

#[test]
fn recordings_of_other_tools_end_in_a_report_or_in_one_sentence() {
    let Some(folder) = support::recording("ros_files") else { return };
    let mut found = Vec::new();
    recordings(&folder, &mut found);
    assert!(found.len() > 60, "{}", found.len());
    for path in found {
        for arguments in [["info", text(&path)], ["replay", text(&path)]] {
            let output = mfg_vio(&arguments);
            let errors = String::from_utf8_lossy(&output.stderr);
            assert!(!errors.contains("panicked"), "{arguments:?}: {errors}");
            let code = output.status.code();
            assert!(code == Some(0) || code == Some(1), "{arguments:?}: {code:?} {errors}");
            let is_error = |line: &&str| line.starts_with("mfg-vio:");
            if code == Some(1) {
                assert_eq!(errors.lines().filter(is_error).count(), 1, "{arguments:?}: {errors}");
            }
        }
    }
}

#[test]
fn satellite_and_magnetic_readings_of_real_recordings_are_read() {
    let read = |name: &str| {
        let path = support::recording("ros_files")?.join(name);
        Some(read_navigation(&path, &NavigationTopics::default(), &ImuConfig::default()).unwrap())
    };
    let Some(husky) = read("test1.bag") else { return };
    // 395 s at 2.5 Hz.
    assert!((900..1100).contains(&husky.fixes.len()), "{}", husky.fixes.len());
    assert!(husky.fixes.iter().all(|fix| fix.latitude.abs() > 1.0 && fix.height.is_some()));
    let drone = read("ardrone_imu.bag").unwrap();
    assert!(drone.magnetic.len() > 4000 && drone.imu.len() > 4000);
    let razor = read("sparkfun_razor.bag").unwrap();
    assert!(razor.magnetic.len() > 1500, "{}", razor.magnetic.len());
}
