//! Folders of other layouts: the first byte chooses one, the rest, cut at zero bytes, is its files.
#![no_main]

const OPENLORIS: [&str; 7] = [
    "color.txt",
    "aligned_depth.txt",
    "d400_gyroscope.txt",
    "d400_accelerometer.txt",
    "groundtruth.txt",
    "sensors.yaml",
    "trans_matrix.yaml",
];
const STRAY: [&str; 5] =
    ["camera_matrix.csv", "odometry.csv", "imu.csv", "rgb/000000.png", "depth/000000.png"];
const EUROC: [&str; 6] = [
    "cam0/data.csv",
    "depth0/data.csv",
    "cam0/sensor.yaml",
    "imu0/data.csv",
    "mocap0/data.csv",
    "cam0/data/a",
];
const ROSBAG2: [&str; 3] = ["metadata.yaml", "a_0.mcap", "a_1.db3"];

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let Some((choice, rest)) = bytes.split_first() else { return };
    let names: &[&str] = match choice % 4 {
        0 => &OPENLORIS,
        1 => &STRAY,
        2 => &EUROC,
        _ => &ROSBAG2,
    };
    let folder = tempfile::tempdir().expect("a temporary directory");
    let mut parts = rest.splitn(names.len(), |byte| *byte == 0);
    for name in names {
        let path = folder.path().join(name);
        std::fs::create_dir_all(path.parent().expect("a parent")).expect("a folder");
        std::fs::write(path, parts.next().unwrap_or_default()).expect("a temporary file");
    }
    mfg_vio_fuzz::read(folder.path());
});
