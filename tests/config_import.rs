//! `config import`: calibrations of other programs, in files as those programs write them, and the
//! values that follow by hand.

mod support;

use std::fs;
use std::path::Path;

use mfg_vio::config::Config;
use support::{fail, mfg_vio, succeed, text};

/// Imports files of a folder: the configuration that comes of them, and what is said.
fn import(folder: &Path, files: &[&str], options: &[&str]) -> (toml::Table, String) {
    let out = folder.join("rig.toml");
    let files: Vec<_> = files.iter().map(|file| folder.join(file)).collect();
    let mut arguments = vec!["config", "import", "--out", text(&out)];
    arguments.extend(files.iter().map(|file| text(file)));
    arguments.extend(options);
    let words = succeed(&arguments);
    let written = fs::read_to_string(&out).unwrap();
    // What is written is a configuration.
    Config::from_toml(&written).unwrap_or_else(|error| panic!("{error}\n{written}"));
    (written.parse().unwrap(), words)
}

/// The message for files of a folder that cannot be imported.
fn refused(folder: &Path, files: &[&str]) -> String {
    let out = folder.join("rig.toml");
    let files: Vec<_> = files.iter().map(|file| folder.join(file)).collect();
    let mut arguments = vec!["config", "import", "--out", text(&out)];
    arguments.extend(files.iter().map(|file| text(file)));
    let message = fail(&arguments);
    assert!(!out.exists(), "{message}");
    message
}

fn numbers(value: &toml::Value) -> Vec<f64> {
    match value {
        toml::Value::Array(items) => items.iter().flat_map(numbers).collect(),
        toml::Value::Float(number) => vec![*number],
        toml::Value::Integer(number) => vec![*number as f64],
        other => panic!("{other}"),
    }
}

fn near(value: &toml::Value, expected: &[f64]) {
    let found = numbers(value);
    assert_eq!(found.len(), expected.len(), "{found:?}");
    for (found, expected) in found.iter().zip(expected) {
        assert!((found - expected).abs() < 1e-12, "{found} instead of {expected}");
    }
}

/// A quarter turn about z and a shift: `imu = R camera + t` with `R = [[0,-1,0],[1,0,0],[0,0,1]]`,
/// `t = (0.1, 0.2, 0.3)`; so `camera = R' imu - R' t` with `R' t = (0.2, -0.1, 0.3)`.
const IMU_FROM_CAMERA: [f64; 16] =
    [0.0, -1.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.2, 0.0, 0.0, 1.0, 0.3, 0.0, 0.0, 0.0, 1.0];
/// The same with another camera that sits 0.12 m along x of the first one's coordinates, which is
/// the IMU's y.
const IMU_FROM_SECOND: [f64; 16] =
    [0.0, -1.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.32, 0.0, 0.0, 1.0, 0.3, 0.0, 0.0, 0.0, 1.0];

const KALIBR: &str = "cam0:
  T_cam_imu:
  - [0.0, 1.0, 0.0, -0.2]
  - [-1.0, 0.0, 0.0, 0.1]
  - [0.0, 0.0, 1.0, -0.3]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [0.0034823894022493434, 0.0007150348452162257, -0.0020532361418706202,
    0.00020293673591811182]
  distortion_model: equidistant
  intrinsics: [190.97847715128717, 190.9733070521226, 254.93170605935475, 256.8974428996504]
  resolution: [512, 512]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: -0.0126
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.12]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: ds
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [-0.17, 0.59, 156.1, 156.2, 252.4, 255.0]
  resolution: [512, 512]
  rostopic: /cam1/image_raw
  timeshift_cam_imu: -0.0126
";

const KALIBR_IMU: &str = "#Accelerometers
accelerometer_noise_density: 1.86e-03   #Noise density (continuous-time)
accelerometer_random_walk:   4.33e-04   #Bias random walk

#Gyroscopes
gyroscope_noise_density:     1.87e-04   #Noise density (continuous-time)
gyroscope_random_walk:       2.66e-05   #Bias random walk

rostopic:                    /imu0      #the IMU ROS topic
update_rate:                 200.0      #Hz (for discretization of the values above)
";

#[test]
fn kalibr() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("camchain-imucam.yaml"), KALIBR).unwrap();
    fs::write(folder.path().join("imu.yaml"), KALIBR_IMU).unwrap();
    let (rig, words) = import(folder.path(), &["camchain-imucam.yaml", "imu.yaml"], &[]);
    let camera = &rig["camera"];
    assert_eq!(camera["model"].as_str(), Some("equidistant"));
    assert_eq!(camera["fx"].as_float(), Some(190.97847715128717));
    assert_eq!(camera["cy"].as_float(), Some(256.8974428996504));
    near(
        &camera["distortion"],
        &[
            0.0034823894022493434,
            0.0007150348452162257,
            -0.0020532361418706202,
            0.00020293673591811182,
        ],
    );
    near(&camera["imu_from_camera"], &IMU_FROM_CAMERA);
    assert_eq!(camera["time_offset"].as_float(), Some(-0.0126));
    let second = &rig["log"]["stereo"][1];
    assert_eq!(second["model"].as_str(), Some("double-sphere"));
    near(&second["distortion"], &[-0.17, 0.59]);
    assert_eq!(second["fx"].as_float(), Some(156.1));
    near(&second["imu_from_camera"], &IMU_FROM_SECOND);
    let imu = &rig["imu"];
    for (key, value) in [
        ("gyro_noise", 1.87e-4),
        ("accel_noise", 1.86e-3),
        ("gyro_bias_walk", 2.66e-5),
        ("accel_bias_walk", 4.33e-4),
    ] {
        assert_eq!(imu[key].as_float(), Some(value), "{key}");
    }
    for sentence in [
        "T_cam_imu maps IMU to camera coordinates; it was inverted",
        "t_imu = t_cam + shift",
        "/cam1/image_raw",
    ] {
        assert!(words.contains(sentence), "{words}");
    }
}

#[test]
fn kalibr_omni() {
    let folder = tempfile::tempdir().unwrap();
    let yaml = "cam0:\n  camera_model: omni\n  distortion_model: radtan\n  \
                intrinsics: [1.62, 700.1, 701.2, 320.3, 240.4]\n  \
                distortion_coeffs: [-0.12, 0.03, 0.001, -0.0006]\n  resolution: [640, 480]\n";
    fs::write(folder.path().join("cams.yaml"), yaml).unwrap();
    let (rig, _) = import(folder.path(), &["cams.yaml"], &[]);
    assert_eq!(rig["camera"]["model"].as_str(), Some("omnidirectional"));
    near(&rig["camera"]["distortion"], &[1.62, -0.12, 0.03, 0.001, -0.0006]);
    assert_eq!(rig["camera"]["cx"].as_float(), Some(320.3));
    assert!(rig["camera"].get("imu_from_camera").is_none());
}

#[test]
fn openvins() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, yaml: &str| fs::write(folder.path().join(name), yaml).unwrap();
    write(
        "estimator_config.yaml",
        "%YAML:1.0 # need to specify the file type at the top!\n\nverbosity: \"INFO\"\n\
         use_fej: true\ngravity_mag: 9.80766\ninit_window_time: 2.0\n\
         relative_config_imu: \"kalibr_imu_chain.yaml\"\n\
         relative_config_imucam: \"kalibr_imucam_chain.yaml\"\n",
    );
    write(
        "kalibr_imu_chain.yaml",
        "%YAML:1.0\n\nimu0:\n  T_i_b:\n    - [1.0, 0.0, 0.0, 0.0]\n    - [0.0, 1.0, 0.0, 0.0]\n    \
         - [0.0, 0.0, 1.0, 0.0]\n    - [0.0, 0.0, 0.0, 1.0]\n  \
         accelerometer_noise_density: 2.0000e-3\n  accelerometer_random_walk: 3.0000e-3\n  \
         gyroscope_noise_density: 1.6968e-04\n  gyroscope_random_walk: 1.9393e-05\n  \
         rostopic: /imu0\n  time_offset: 0.0\n  update_rate: 200.0\n  model: \"kalibr\"\n  Tw:\n    \
         - [ 1.0, 0.0, 0.0 ]\n    - [ 0.0, 1.0, 0.0 ]\n    - [ 0.0, 0.0, 1.0 ]\n",
    );
    write(
        "kalibr_imucam_chain.yaml",
        "%YAML:1.0\n\ncam0:\n  T_imu_cam: #rotation from camera to IMU, position of camera in IMU\n    \
         - [0.0, -1.0, 0.0, 0.1]\n    - [1.0, 0.0, 0.0, 0.2]\n    - [0.0, 0.0, 1.0, 0.3]\n    \
         - [0.0, 0.0, 0.0, 1.0]\n  cam_overlaps: [1]\n  camera_model: pinhole\n  \
         distortion_coeffs: [-0.28340811,0.07395907,0.00019359,1.76187114e-05]\n  \
         distortion_model: radtan\n  intrinsics: [458.654,457.296,367.215,248.375] #fu, fv, cu, cv\n  \
         resolution: [752, 480]\n  rostopic: /cam0/image_raw\n  timeshift_cam_imu: 0.005\n",
    );
    // The main file leads to the others; named beside it they are read once.
    for files in [
        &["estimator_config.yaml"][..],
        &["kalibr_imucam_chain.yaml", "estimator_config.yaml", "kalibr_imu_chain.yaml"],
    ] {
        let (rig, words) = import(folder.path(), files, &[]);
        assert_eq!(rig["camera"]["model"].as_str(), Some("radial-tangential"));
        near(&rig["camera"]["distortion"], &[-0.28340811, 0.07395907, 0.00019359, 1.76187114e-5]);
        near(&rig["camera"]["imu_from_camera"], &IMU_FROM_CAMERA);
        assert_eq!(rig["camera"]["time_offset"].as_float(), Some(0.005));
        assert_eq!(rig["imu"]["gravity"].as_float(), Some(9.80766));
        assert_eq!(rig["imu"]["gyro_noise"].as_float(), Some(1.6968e-4));
        assert!(words.contains("T_imu_cam maps camera to IMU coordinates"), "{words}");
    }
}

const VINS_MONO: &str = "%YAML:1.0

#common parameters
imu_topic: \"/imu0\"
image_topic: \"/cam0/image_raw\"
output_path: \"/home/user/output/\"

#camera calibration
model_type: PINHOLE
camera_name: camera
image_width: 752
image_height: 480
distortion_parameters:
   k1: -2.917e-01
   k2: 8.228e-02
   p1: 5.333e-05
   p2: -1.578e-04
projection_parameters:
   fx: 4.616e+02
   fy: 4.603e+02
   cx: 3.630e+02
   cy: 2.481e+02

estimate_extrinsic: 0   # 0  Have an accurate extrinsic parameters.
#Rotation from camera frame to imu frame, imu^R_cam
extrinsicRotation: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [0., -1., 0.,
          1., 0., 0.,
          0., 0., 1.]
#Translation from camera frame to imu frame, imu^T_cam
extrinsicTranslation: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [0.1, 0.2, 0.3]

acc_n: 0.08          # accelerometer measurement noise standard deviation. #0.2   0.04
gyr_n: 0.004         # gyroscope measurement noise standard deviation.     #0.05  0.004
acc_w: 0.00004         # accelerometer bias random work noise standard deviation.  #0.02
gyr_w: 2.0e-6       # gyroscope bias random work noise standard deviation.     #4.0e-5
g_norm: 9.81007     # gravity magnitude

td: -0.02                          # initial value of time offset. unit: s. readed image clock + td = real image clock (IMU clock)
rolling_shutter: 1                  # 0: global shutter camera, 1: rolling shutter camera
rolling_shutter_tr: 0.033           # unit: s. rolling shutter read out time per frame (from data sheet).
";

#[test]
fn vins_mono() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("euroc.yaml"), VINS_MONO).unwrap();
    let (rig, words) = import(folder.path(), &["euroc.yaml"], &[]);
    near(&rig["camera"]["distortion"], &[-0.2917, 0.08228, 5.333e-5, -1.578e-4, 0.0]);
    near(&rig["camera"]["imu_from_camera"], &IMU_FROM_CAMERA);
    for (key, value) in [
        ("fx", 461.6),
        ("fy", 460.3),
        ("cx", 363.0),
        ("time_offset", -0.02),
        ("readout_time", 0.033),
    ] {
        assert_eq!(rig["camera"][key].as_float(), Some(value), "{key}");
    }
    assert_eq!(rig["imu"]["gravity"].as_float(), Some(9.81007));
    assert_eq!(rig["imu"]["accel_noise"].as_float(), Some(0.08));
    assert!(words.contains("--imu-rate") && words.contains("t_image + td"), "{words}");

    let (rig, _) = import(folder.path(), &["euroc.yaml"], &["--imu-rate", "400"]);
    near(&rig["imu"]["accel_noise"], &[0.004]);
    near(&rig["imu"]["gyro_bias_walk"], &[1e-7]);
}

#[test]
fn vins_fusion() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, yaml: &str| fs::write(folder.path().join(name), yaml).unwrap();
    let pose = |y: f64| {
        format!(
            "!!opencv-matrix\n   rows: 4\n   cols: 4\n   dt: d\n   data: [0., -1., 0., 0.1,\n          \
             1., 0., 0., {y},\n          0., 0., 1., 0.3,\n          0., 0., 0., 1.]\n"
        )
    };
    let main = format!(
        "%YAML:1.0\n\nimu: 1\nnum_of_cam: 2\nimu_topic: \"/imu0\"\ncam0_calib: \"cam0_mei.yaml\"\n\
         cam1_calib: \"cam1_kb.yaml\"\nimage_width: 752\nbody_T_cam0: {}\nbody_T_cam1: {}\n\
         acc_n: 0.1\ngyr_n: 0.01\nacc_w: 0.001\ngyr_w: 0.0001\ng_norm: 9.81007\ntd: 0.003\n",
        pose(0.2),
        pose(0.32)
    );
    write("stereo_imu.yaml", &main);
    write(
        "cam0_mei.yaml",
        "%YAML:1.0\n---\nmodel_type: MEI\ncamera_name: camera\nimage_width: 752\nimage_height: 480\n\
         mirror_parameters:\n   xi: 3.6313355285286337e+00\ndistortion_parameters:\n   k1: -0.1\n   \
         k2: 0.2\n   p1: 0.003\n   p2: -0.004\nprojection_parameters:\n   gamma1: 2141.5\n   \
         gamma2: 2140.5\n   u0: 363.5\n   v0: 248.5\n",
    );
    write(
        "cam1_kb.yaml",
        "%YAML:1.0\n---\nmodel_type: KANNALA_BRANDT\ncamera_name: camera\nprojection_parameters:\n   \
         k2: -0.01\n   k3: 0.05\n   k4: -0.06\n   k5: 0.02\n   mu: 285.5\n   mv: 286.5\n   u0: 414.5\n   \
         v0: 396.5\n",
    );
    let (rig, words) = import(folder.path(), &["stereo_imu.yaml"], &[]);
    assert_eq!(rig["camera"]["model"].as_str(), Some("omnidirectional"));
    near(&rig["camera"]["distortion"], &[3.6313355285286337, -0.1, 0.2, 0.003, -0.004]);
    near(&rig["camera"]["imu_from_camera"], &IMU_FROM_CAMERA);
    assert_eq!(rig["camera"]["fx"].as_float(), Some(2141.5));
    let second = &rig["log"]["stereo"][1];
    assert_eq!(second["model"].as_str(), Some("equidistant"));
    near(&second["distortion"], &[-0.01, 0.05, -0.06, 0.02]);
    near(&second["imu_from_camera"], &IMU_FROM_SECOND);
    assert_eq!(second["time_offset"].as_float(), Some(0.003));
    assert!(words.contains("body_T_cam maps camera to IMU"), "{words}");
}

#[test]
fn opencv() {
    let folder = tempfile::tempdir().unwrap();
    let matrix = "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   \
                  data: [ 6.5746697944293521e+02, 0., 3.1950000000000000e+02, 0.,\n       \
                  6.5746697944293521e+02, 2.3950000000000000e+02, 0., 0., 1. ]\n";
    let radtan = format!(
        "%YAML:1.0\n---\ncalibration_time: \"Thu Jan  1 12:00:00 2026\"\nnr_of_frames: 23\n\
         image_width: 640\nimage_height: 480\nflags: 0\nfisheye_model: 0\n{matrix}\
         distortion_coefficients: !!opencv-matrix\n   rows: 5\n   cols: 1\n   dt: d\n   \
         data: [ -4.1802327176423804e-01, 5.0715244063187526e-01, 0., 0.,\n       \
         -5.7843597214487474e-01 ]\navg_reprojection_error: 1.96e-01\n"
    );
    fs::write(folder.path().join("out_camera_data.yml"), &radtan).unwrap();
    let (rig, _) = import(folder.path(), &["out_camera_data.yml"], &[]);
    assert_eq!(rig["camera"]["model"].as_str(), Some("radial-tangential"));
    assert_eq!(rig["camera"]["fy"].as_float(), Some(657.4669794429352));
    near(
        &rig["camera"]["distortion"],
        &[-0.41802327176423804, 0.5071524406318753, 0.0, 0.0, -0.5784359721448747],
    );

    let fisheye = radtan
        .replace("fisheye_model: 0", "fisheye_model: 1")
        .replace("rows: 5\n   cols: 1", "rows: 4\n   cols: 1")
        .replace(", 0., 0.,\n       -5.7843597214487474e-01 ]", ", 0.1, -0.01 ]");
    fs::write(folder.path().join("fisheye.yml"), fisheye).unwrap();
    let (rig, _) = import(folder.path(), &["fisheye.yml"], &[]);
    assert_eq!(rig["camera"]["model"].as_str(), Some("equidistant"));
    near(&rig["camera"]["distortion"], &[-0.41802327176423804, 0.5071524406318753, 0.1, -0.01]);

    // ROS's camera_calibration has the same keys and names the model.
    let ros = "image_width: 640\nimage_height: 480\ncamera_name: head\ncamera_matrix:\n  rows: 3\n  \
               cols: 3\n  data: [500.5, 0.0, 320.5, 0.0, 501.5, 240.5, 0.0, 0.0, 1.0]\n\
               distortion_model: rational_polynomial\ndistortion_coefficients:\n  rows: 1\n  cols: 8\n  \
               data: [0.5, -2.6, 0.0008, -0.0003, 1.4, 0.4, -2.4, 1.3]\n";
    fs::write(folder.path().join("head.yaml"), ros).unwrap();
    let (rig, _) = import(folder.path(), &["head.yaml"], &[]);
    assert_eq!(rig["camera"]["model"].as_str(), Some("rational"));
    near(&rig["camera"]["distortion"], &[0.5, -2.6, 0.0008, -0.0003, 1.4, 0.4, -2.4, 1.3]);
}

#[test]
fn orb_slam() {
    let folder = tempfile::tempdir().unwrap();
    let yaml = "%YAML:1.0\n\nFile.version: \"1.0\"\nCamera.type: \"KannalaBrandt8\"\n\
                Camera1.fx: 190.5\nCamera1.fy: 190.25\nCamera1.cx: 254.5\nCamera1.cy: 256.5\n\
                Camera1.k1: 0.003\nCamera1.k2: 0.0007\nCamera1.k3: -0.002\nCamera1.k4: 0.0002\n\
                Camera.width: 512\nIMU.T_b_c1: !!opencv-matrix\n  rows: 4\n  cols: 4\n  dt: f\n  \
                data: [0.0, -1.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.2, 0.0, 0.0, 1.0, 0.3, 0.0, 0.0, 0.0, 1.0]\n\
                IMU.NoiseGyro: 0.00016\nIMU.NoiseAcc: 0.0028\nIMU.GyroWalk: 0.000022\n\
                IMU.AccWalk: 0.00086\nIMU.Frequency: 200.0\n";
    fs::write(folder.path().join("tum_vi.yaml"), yaml).unwrap();
    let (rig, _) = import(folder.path(), &["tum_vi.yaml"], &[]);
    assert_eq!(rig["camera"]["model"].as_str(), Some("equidistant"));
    near(&rig["camera"]["distortion"], &[0.003, 0.0007, -0.002, 0.0002]);
    near(&rig["camera"]["imu_from_camera"], &IMU_FROM_CAMERA);
    assert_eq!(rig["imu"]["accel_bias_walk"].as_float(), Some(0.00086));
}

#[test]
fn what_is_of_no_use_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let broken = [
        ("cam0: {camera_model: eucm, intrinsics: [0.6, 1.1, 400, 400, 320, 240]}", "eucm", "ds"),
        (
            "cam0: {camera_model: pinhole, distortion_model: fov, intrinsics: [4, 4, 3, 2]}",
            "fov",
            "radtan",
        ),
        (
            "cam0: {camera_model: pinhole, intrinsics: [400, 400, 320]}",
            "cam0.intrinsics",
            "3 numbers",
        ),
        ("cam0: {camera_model: pinhole, intrinsics: [-400, 400, 320, 240]}", "fx", "positive"),
        (
            "cam0: {intrinsics: [4, 4, 3, 2], T_cam_imu: [[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}",
            "T_cam_imu",
            "rigid",
        ),
        ("model_type: SCARAMUZZA\nprojection_parameters: {a: 1}", "SCARAMUZZA", "PINHOLE"),
        (
            "model_type: PINHOLE\nprojection_parameters: {fx: 400}",
            "projection_parameters.fy",
            "missing",
        ),
        ("gyroscope_noise_density: .nan", "gyroscope_noise_density", "finite"),
        ("cam0_calib: absent.yaml", "absent.yaml", "No such file"),
        ("colour: red\nsize: 3", "colour, size", "Kalibr"),
        ("just words", "case.yaml", "no YAML"),
        ("cam0: [1, 2", "case.yaml", "no YAML"),
    ];
    for (yaml, place, reason) in broken {
        fs::write(folder.path().join("case.yaml"), yaml).unwrap();
        let message = refused(folder.path(), &["case.yaml"]);
        assert!(message.contains(place) && message.contains(reason), "{yaml}: {message}");
        assert_eq!(message.lines().count(), 1, "{message}");
    }
}

#[test]
fn what_is_read_is_not_written_over() {
    let folder = tempfile::tempdir().unwrap();
    let (file, link) = (folder.path().join("imu.yaml"), folder.path().join("rig.toml"));
    fs::write(&file, KALIBR_IMU).unwrap();
    fs::hard_link(&file, &link).unwrap();
    let output = mfg_vio(&["config", "import", text(&file), "--out", text(&link)]);
    assert_eq!(output.status.code(), Some(2));
    let message = String::from_utf8(output.stderr).unwrap();
    assert!(message.contains("imu.yaml") && message.contains("--out"), "{message}");
    assert_eq!(fs::read_to_string(&file).unwrap(), KALIBR_IMU);
}

#[test]
fn files_that_contradict_each_other_are_both_named() {
    let folder = tempfile::tempdir().unwrap();
    let camera =
        |fx: f64| format!("cam0: {{camera_model: pinhole, intrinsics: [{fx}, 400, 320, 240]}}");
    fs::write(folder.path().join("one.yaml"), camera(400.5)).unwrap();
    fs::write(folder.path().join("two.yaml"), camera(401.5)).unwrap();
    let message = refused(folder.path(), &["one.yaml", "two.yaml"]);
    for word in ["fx", "400.5", "401.5", "one.yaml", "two.yaml"] {
        assert!(message.contains(word), "{message}");
    }
}
