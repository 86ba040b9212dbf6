//! Miniature copies of public data sets in their real layouts, written from simulated logs.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use mfg_vio::dataset::{LogConfig, open};
use mfg_vio::inertial::ImuConfig;
use mfg_vio::sensor::{DepthImage, Event, ImuSample, RgbdFrame, TruthPose};
use nalgebra::{Isometry3, UnitQuaternion, Vector3};

use super::{succeed, text};

/// What a simulated log holds.
pub struct Recording {
    pub frames: Vec<RgbdFrame>,
    pub imu: Vec<ImuSample>,
    pub truth: Vec<TruthPose>,
}

/// Renders a scene; keys that `scene` leaves out keep their defaults.
pub fn render(scene: &str) -> Recording {
    let folder = tempfile::tempdir().unwrap();
    let (file, log) = (folder.path().join("scene.toml"), folder.path().join("log.mcap"));
    std::fs::write(&file, scene).unwrap();
    succeed(&["simulate", "--config", text(&file), "--out", text(&log)]);
    let mut log = open(&log, &LogConfig::default(), &ImuConfig::default()).unwrap();
    let mut recording = Recording { frames: Vec::new(), imu: Vec::new(), truth: Vec::new() };
    while let Some(event) = log.next_event() {
        match event {
            Event::Frame(frame) => recording.frames.push(*frame),
            Event::Imu(sample) => recording.imu.push(sample),
            Event::Repeated(..) => {}
            Event::Truth(pose) => recording.truth.push(pose),
        }
    }
    recording
}

pub fn save(path: &Path, content: impl AsRef<[u8]>) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(path, content).unwrap();
}

pub fn save_color(path: &Path, frame: &RgbdFrame) {
    let (width, height) = (frame.color.width() as u32, frame.color.height() as u32);
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    let image = image::RgbImage::from_raw(width, height, rgb(frame)).unwrap();
    image.save(path).unwrap();
}

pub fn save_grey(path: &Path, frame: &RgbdFrame) {
    let (width, height) = (frame.color.width() as u32, frame.color.height() as u32);
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    let grey = frame.color.data().chunks(3).map(|pixel| pixel[1]).collect();
    image::GrayImage::from_raw(width, height, grey).unwrap().save(path).unwrap();
}

fn rgb(frame: &RgbdFrame) -> Vec<u8> {
    frame.color.data().to_vec()
}

/// 16-bit depth, `scale` units a metre; `none` where there is no depth.
pub fn save_depth(path: &Path, depth: &DepthImage, scale: f64, none: u16) {
    let (width, height) = (depth.width() as u32, depth.height() as u32);
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    let pixels = raw_depth(depth, scale, none);
    let image = image::ImageBuffer::<image::Luma<u16>, _>::from_raw(width, height, pixels);
    image.unwrap().save(path).unwrap();
}

fn raw_depth(depth: &DepthImage, scale: f64, none: u16) -> Vec<u16> {
    let pixel = |x, y| depth.at(x, y).map_or(none, |m| (f64::from(m) * scale).round() as u16);
    (0..depth.height()).flat_map(|y| (0..depth.width()).map(move |x| pixel(x, y))).collect()
}

/// A line of a TUM trajectory.
pub fn tum_line(seconds: f64, pose: &Isometry3<f64>) -> String {
    let (t, q) = (pose.translation.vector, pose.rotation.coords);
    format!("{seconds:.9} {} {} {} {} {} {} {}\n", t.x, t.y, t.z, q.x, q.y, q.z, q.w)
}

/// The folder of a EuRoC sequence; truth begins `late` seconds after the images.
pub fn euroc(root: &Path, left: &Recording, right: &Recording, cameras: [&str; 2], late: f64) {
    let mav0 = root.join("mav0");
    for (name, camera, recording) in [("cam0", cameras[0], left), ("cam1", cameras[1], right)] {
        save(&mav0.join(name).join("sensor.yaml"), camera);
        let mut rows = "#timestamp [ns],filename\n".to_owned();
        for frame in &recording.frames {
            let file = format!("{}.png", frame.stamp.nanos());
            save_grey(&mav0.join(name).join("data").join(&file), frame);
            rows += &format!("{},{file}\n", frame.stamp.nanos());
        }
        save(&mav0.join(name).join("data.csv"), rows);
    }
    save(&mav0.join("imu0/data.csv"), euroc_imu(&left.imu));
    let start = left.frames[0].stamp;
    let mut rows = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], \
                    q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y, v_RS_R_z, b_w_RS_S_x, \
                    b_w_RS_S_y, b_w_RS_S_z, b_a_RS_S_x, b_a_RS_S_y, b_a_RS_S_z\n"
        .to_owned();
    let covered = left.truth.iter().filter(|pose| pose.stamp.seconds_since(start) >= late);
    for pose in covered {
        rows += &euroc_pose(pose);
        rows += ",0,0,0,0,0,0,0,0,0\n";
    }
    save(&mav0.join("state_groundtruth_estimate0/data.csv"), rows);
}

pub fn euroc_imu(samples: &[ImuSample]) -> String {
    let mut rows = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],\
                    a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n"
        .to_owned();
    for sample in samples {
        let (w, a) = (sample.angular_velocity, sample.specific_force);
        let stamp = sample.stamp.nanos();
        writeln!(rows, "{stamp},{},{},{},{},{},{}", w.x, w.y, w.z, a.x, a.y, a.z).unwrap();
    }
    rows
}

/// `ns,px,py,pz,qw,qx,qy,qz`
pub fn euroc_pose(pose: &TruthPose) -> String {
    let (p, q) = (pose.world_from_body.translation, pose.world_from_body.rotation);
    format!("{},{},{},{},{},{},{},{}", pose.stamp.nanos(), p.x, p.y, p.z, q.w, q.i, q.j, q.k)
}

/// A camera's `sensor.yaml`.
pub fn sensor_yaml(
    imu_from_camera: &Isometry3<f64>,
    size: [usize; 2],
    intrinsics: [f64; 4],
) -> String {
    let matrix = imu_from_camera.to_homogeneous();
    let rows: Vec<String> = matrix.transpose().iter().map(|x| format!("{x:.12}")).collect();
    format!(
        "%YAML:1.0\nsensor_type: camera\ncomment: VI-Sensor\nT_BS:\n  cols: 4\n  rows: 4\n  \
         data: [{}]\nrate_hz: 20\nresolution: {size:?}\ncamera_model: pinhole\nintrinsics: \
         {intrinsics:?} #fu, fv, cu, cv\ndistortion_model: radial-tangential\n\
         distortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n",
        rows.join(", ")
    )
}

/// A VCU-RVI bag with its truth: images called `8UC3` in BGR, the accelerometer in -g, log times of
/// another clock; truth in an x-up world that begins with the identity, by a clock `ahead` seconds
/// ahead, without the span `gap` (s after the start).
pub fn vcu_rvi(
    root: &Path,
    name: &str,
    recording: &Recording,
    ahead: f64,
    gap: [f64; 2],
) -> PathBuf {
    const LOG_TIME: f64 = 1.55e9;
    let mut messages = Vec::new();
    for frame in &recording.frames {
        let bgr: Vec<u8> = frame.color.data().chunks(3).flat_map(|p| [p[2], p[1], p[0]]).collect();
        let depth = raw_depth(&frame.depth, 1000.0, 0);
        let depth: Vec<u8> = depth.iter().flat_map(|d| d.to_le_bytes()).collect();
        let size = [frame.color.width() as u32, frame.color.height() as u32];
        let stamp = frame.stamp.nanos();
        messages.push((stamp, 0, ros_image(stamp, size, "8UC3", &bgr)));
        messages.push((stamp, 1, ros_image(stamp, size, "16UC1", &depth)));
    }
    for sample in &recording.imu {
        let stamp = sample.stamp.nanos();
        messages.push((stamp, 2, ros_imu(sample)));
    }
    messages.sort_by_key(|(stamp, topic, _)| (*stamp, *topic));
    let mut bag = b"#ROSBAG V2.0\n".to_vec();
    let counts = [("conn_count", 3_u32), ("chunk_count", 1)];
    let counts: Vec<_> = counts.iter().map(|(k, v)| (*k, v.to_le_bytes().to_vec())).collect();
    let header = [vec![("op", vec![3]), ("index_pos", vec![0; 8])], counts].concat();
    let length = record(&header, &[]).len();
    bag.extend(record(&header, &vec![b' '; 4096 - length]));
    let mut chunk = Vec::new();
    let topics = [
        ("/cam0/color", "sensor_msgs/Image"),
        ("/cam0/depth", "sensor_msgs/Image"),
        ("/imu", "sensor_msgs/Imu"),
    ];
    for (id, (topic, schema)) in topics.iter().enumerate() {
        let told = record(&[("type", schema.as_bytes().to_vec()), ("md5sum", b"*".to_vec())], &[]);
        let fields = [
            ("op", vec![7]),
            ("conn", (id as u32).to_le_bytes().to_vec()),
            ("topic", topic.as_bytes().to_vec()),
        ];
        chunk.extend(record(&fields, &told[4..told.len() - 4]));
    }
    for (stamp, topic, body) in &messages {
        let logged = stamp + (LOG_TIME * 1e9) as i64;
        let (seconds, nanos) = (logged / 1_000_000_000, logged % 1_000_000_000);
        let time = [(seconds as u32).to_le_bytes(), (nanos as u32).to_le_bytes()].concat();
        let conn = (*topic as u32).to_le_bytes().to_vec();
        chunk.extend(record(&[("op", vec![2]), ("conn", conn), ("time", time)], body));
    }
    let size = (chunk.len() as u32).to_le_bytes().to_vec();
    let fields = [("op", vec![5]), ("compression", b"none".to_vec()), ("size", size)];
    bag.extend(record(&fields, &chunk));
    let path = root.join(format!("{name}.bag"));
    save(&path, bag);
    let start = recording.truth[0].stamp;
    let first = recording.truth[0].world_from_body;
    let mut rows = String::new();
    for pose in &recording.truth {
        let seconds = pose.stamp.seconds_since(start);
        if seconds < gap[0] || seconds > gap[1] {
            let moved = first.inverse() * pose.world_from_body;
            rows += &tum_line(pose.stamp.seconds() + ahead, &moved);
        }
    }
    save(&root.join("ground_truths").join(format!("{name}_gt.csv")), rows);
    path
}

fn record(fields: &[(&str, Vec<u8>)], data: &[u8]) -> Vec<u8> {
    let mut header = Vec::new();
    for (name, value) in fields {
        let field = [name.as_bytes(), b"=", value].concat();
        header.extend((field.len() as u32).to_le_bytes());
        header.extend(field);
    }
    let lengths = [header.len() as u32, data.len() as u32].map(u32::to_le_bytes);
    [&lengths[0][..], &header, &lengths[1], data].concat()
}

fn ros_header(nanos: i64) -> Vec<u8> {
    let (seconds, rest) = ((nanos / 1_000_000_000) as u32, (nanos % 1_000_000_000) as u32);
    let numbers = [0, seconds, rest, 4].map(u32::to_le_bytes).concat();
    [&numbers[..], b"cam0"].concat()
}

fn ros_image(nanos: i64, [width, height]: [u32; 2], encoding: &str, data: &[u8]) -> Vec<u8> {
    let mut body = ros_header(nanos);
    body.extend(height.to_le_bytes());
    body.extend(width.to_le_bytes());
    body.extend((encoding.len() as u32).to_le_bytes());
    body.extend(encoding.as_bytes());
    body.push(0);
    body.extend((data.len() as u32 / height).to_le_bytes());
    body.extend((data.len() as u32).to_le_bytes());
    body.extend(data);
    body
}

fn ros_imu(sample: &ImuSample) -> Vec<u8> {
    let mut body = ros_header(sample.stamp.nanos());
    let acceleration: Vector3<f64> = sample.specific_force / -9.81;
    let mut numbers = vec![0.0; 13];
    numbers.extend(sample.angular_velocity.iter());
    numbers.extend([0.0; 9]);
    numbers.extend(acceleration.iter());
    numbers.extend([0.0; 9]);
    body.extend(numbers.iter().flat_map(|x| x.to_le_bytes()));
    body
}

/// A TUM RGB-D folder with the truth of the camera in a world of its own.
pub fn tum_rgbd(root: &Path, recording: &Recording, imu_from_camera: &Isometry3<f64>) {
    let world = Isometry3::new(Vector3::new(1.0, -2.0, 0.5), Vector3::z() * 0.7);
    let mut lists = [("rgb", String::new()), ("depth", String::new())];
    for frame in &recording.frames {
        let name = format!("{:.6}.png", frame.stamp.seconds());
        save_color(&root.join("rgb").join(&name), frame);
        save_depth(&root.join("depth").join(&name), &frame.depth, 5000.0, 0);
        for (folder, list) in &mut lists {
            *list += &format!("{:.6} {folder}/{name}\n", frame.stamp.seconds());
        }
    }
    for (folder, list) in lists {
        save(
            &root.join(format!("{folder}.txt")),
            format!("# images\n# file\n# timestamp filename\n{list}"),
        );
    }
    let poses = recording.truth.iter().map(|pose| {
        tum_line(pose.stamp.seconds(), &(world * pose.world_from_body * imu_from_camera))
    });
    save(&root.join("groundtruth.txt"), format!("# ground truth\n{}", poses.collect::<String>()));
}

/// A 7-Scenes folder: no stamps, depth in mm with 65535 for none, a matrix a frame.
pub fn seven_scenes(root: &Path, recording: &Recording, imu_from_camera: &Isometry3<f64>) {
    for (k, frame) in recording.frames.iter().enumerate() {
        let stem = root.join(format!("frame-{k:06}"));
        save_color(&stem.with_extension("color.png"), frame);
        save_depth(&stem.with_extension("depth.png"), &frame.depth, 1000.0, 65535);
        let nearest = recording
            .truth
            .iter()
            .min_by_key(|pose| (pose.stamp.nanos() - frame.stamp.nanos()).abs());
        let pose = nearest.unwrap().world_from_body * imu_from_camera;
        let matrix = pose.to_homogeneous();
        let row = |r: usize| (0..4).map(|c| format!("{:e}", matrix[(r, c)])).collect::<Vec<_>>();
        let rows: Vec<String> = (0..4).map(|r| row(r).join("\t ")).collect();
        save(&stem.with_extension("pose.txt"), rows.join("\t \n") + "\t \n");
    }
}

/// The mounting of the simulator's camera.
pub fn simulated_mount() -> Isometry3<f64> {
    let scene = mfg_vio::simulation::SceneConfig::default();
    scene.camera.imu_from_camera().unwrap()
}

/// A camera that looks along the body's x axis, `right` m to its right.
pub fn forward_mount(right: f64) -> Isometry3<f64> {
    let rotation = nalgebra::Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0);
    let rotation = nalgebra::Rotation3::from_matrix_unchecked(rotation);
    let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
    let left = Isometry3::from_parts(Vector3::new(0.05, 0.02, -0.01).into(), rotation);
    left * Isometry3::translation(right, 0.0, 0.0)
}

/// The `[camera]` section of a scene.
pub fn camera_section(mount: &Isometry3<f64>, [fx, fy, cx, cy]: [f64; 4]) -> String {
    let matrix = mount.to_homogeneous();
    let row =
        |r: usize| (0..4).map(|c| format!("{:.12}", matrix[(r, c)])).collect::<Vec<_>>().join(", ");
    let rows: Vec<String> = (0..4).map(|r| format!("[{}]", row(r))).collect();
    format!(
        "[camera]\nfx = {fx:?}\nfy = {fy:?}\ncx = {cx:?}\ncy = {cy:?}\nimu_from_camera = [{}]\n",
        rows.join(", ")
    )
}

/// An OpenLORIS-Scene package: gyroscope and accelerometer at two rates, truth of the robot's base
/// in a planar world of its own.
pub fn openloris(
    root: &Path,
    recording: &Recording,
    imu_from_camera: &Isometry3<f64>,
    intrinsics: [f64; 4],
) {
    let world = Isometry3::new(Vector3::new(21.4, 21.1, 0.0), Vector3::z() * -0.6);
    let base_from_imu =
        Isometry3::new(Vector3::new(0.23, -0.05, 0.9), Vector3::new(0.1, 1.4, -0.3));
    let mut lists = [("color", String::new()), ("aligned_depth", String::new())];
    for frame in &recording.frames {
        let seconds = frame.stamp.seconds();
        // Depth has a stamp of its own, microseconds apart.
        let names = [format!("{seconds:.6}.png"), format!("{:.6}.png", seconds - 7e-6)];
        save_color(&root.join("color").join(&names[0]), frame);
        save_depth(&root.join("aligned_depth").join(&names[1]), &frame.depth, 1000.0, 0);
        for ((folder, list), name) in lists.iter_mut().zip(&names) {
            *list += &format!("{} {folder}/{name}\n", name.trim_end_matches(".png"));
        }
    }
    for (folder, list) in lists {
        save(&root.join(format!("{folder}.txt")), list);
    }
    let row = |sample: &ImuSample, v: &Vector3<f64>| {
        format!("{:.8} {} {} {}\n", sample.stamp.seconds(), v.x, v.y, v.z)
    };
    let gyroscope = recording.imu.iter().map(|sample| row(sample, &sample.angular_velocity));
    let accelerometer =
        recording.imu.iter().step_by(2).map(|sample| row(sample, &sample.specific_force));
    let tables = [
        ("d400_gyroscope.txt", "#Time Gx Gy Gz\n", gyroscope.collect::<String>()),
        ("d400_accelerometer.txt", "#Time Ax Ay Az\n", accelerometer.collect()),
    ];
    for (name, header, rows) in tables {
        save(&root.join(name), format!("{header}{rows}"));
    }
    let poses = recording.truth.iter().map(|pose| {
        tum_line(pose.stamp.seconds(), &(world * pose.world_from_body * base_from_imu.inverse()))
    });
    let header = "#Time px py pz qx qy qz qw\n";
    save(&root.join("groundtruth.txt"), format!("{header}{}", poses.collect::<String>()));
    let [fx, fy, cx, cy] = intrinsics;
    let matrix = |rows: usize, cols: usize, data: &[f64]| {
        let data: Vec<String> = data.iter().map(|x| format!("{x:.16e}")).collect();
        format!(
            "!!opencv-matrix\n      rows: {rows}\n      cols: {cols}\n      dt: d\n      data: [ {} ]\n",
            data.join(", ")
        )
    };
    save(
        &root.join("sensors.yaml"),
        format!(
            "%YAML:1.0\nd400_color_optical_frame:\n   sensor_type: camera\n   fps: 30\n   model: \
             pinhole\n   intrinsics: {}   distortion_model: radial-tangential\n   \
             distortion_coefficients: {}",
            matrix(1, 4, &[fx, cx, fy, cy]),
            matrix(1, 5, &[0.0; 5])
        ),
    );
    let item = |parent: &str, child: &str, pose: &Isometry3<f64>| {
        let rows: Vec<f64> = pose.to_homogeneous().transpose().iter().copied().collect();
        let matrix = matrix(4, 4, &rows);
        format!(
            "   -\n      parent_frame: {parent}\n      child_frame: {child}\n      matrix: {matrix}"
        )
    };
    let color = "d400_color_optical_frame";
    let imu = imu_from_camera.inverse();
    let items = [
        item("base_link", color, &(base_from_imu * imu_from_camera)),
        item(color, "d400_accelerometer", &imu),
        item(color, "d400_gyroscope", &imu),
    ];
    save(&root.join("trans_matrix.yaml"), format!("%YAML:1.0\ntrans_matrix:\n{}", items.concat()));
}
