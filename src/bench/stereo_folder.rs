//! A simulated scene seen by two cameras side by side, as a EuRoC folder.

use std::fmt::Write as _;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use nalgebra::Isometry3;

use super::error::BenchError;
use super::recipe::simulation;
use crate::sensor::{CameraConfig, ColorImage, Event};
use crate::simulation::SceneConfig;

/// Distance of the right camera from the left one, m: EuRoC's.
const BASELINE: f64 = 0.11;

/// Renders `scene` once for each camera into `folder`. `watch` sees each event first and may end
/// it early.
pub(super) fn write(
    scene: &SceneConfig,
    folder: &Path,
    watch: &mut dyn FnMut(&Event) -> ControlFlow<()>,
) -> Result<(), BenchError> {
    let root = folder.join("mav0");
    for (name, x) in [("cam0", 0.0), ("cam1", BASELINE)] {
        let scene = SceneConfig { camera: moved(&scene.camera, x), ..scene.clone() };
        let mut camera = CameraFolder::create(&root.join(name), &scene)?;
        let (mut imu, mut truth) = (IMU_HEADER.to_owned(), TRUTH_HEADER.to_owned());
        for event in simulation(&scene)? {
            if watch(&event).is_break() {
                return Ok(());
            }
            match &event {
                Event::Frame(frame) => camera.push(frame.stamp.nanos(), &frame.color)?,
                other => push_row(other, &mut imu, &mut truth),
            }
        }
        camera.finish()?;
        save(&root.join("imu0").join("data.csv"), imu.as_bytes())?;
        save(&root.join("state_groundtruth_estimate0").join("data.csv"), truth.as_bytes())?;
    }
    Ok(())
}

const IMU_HEADER: &str = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],\
                          w_RS_S_z [rad s^-1],a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],\
                          a_RS_S_z [m s^-2]\n";
const TRUTH_HEADER: &str = "#timestamp,p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],\
                            q_RS_x [],q_RS_y [],q_RS_z []\n";

/// The camera `x` m further right.
fn moved(camera: &CameraConfig, x: f64) -> CameraConfig {
    let mount = camera.imu_from_camera().unwrap_or_default() * Isometry3::translation(x, 0.0, 0.0);
    let matrix = mount.to_homogeneous();
    let imu_from_camera = std::array::from_fn(|r| std::array::from_fn(|c| matrix[(r, c)]));
    CameraConfig { imu_from_camera, ..camera.clone() }
}

fn push_row(event: &Event, imu: &mut String, truth: &mut String) {
    // Writing to a string cannot fail.
    let _ = match event {
        Event::Imu(sample) => {
            let (w, a) = (sample.angular_velocity, sample.specific_force);
            let stamp = sample.stamp.nanos();
            writeln!(imu, "{stamp},{},{},{},{},{},{}", w.x, w.y, w.z, a.x, a.y, a.z)
        }
        Event::Truth(pose) => {
            let (p, q) = (pose.world_from_body.translation, pose.world_from_body.rotation);
            let stamp = pose.stamp.nanos();
            writeln!(truth, "{stamp},{},{},{},{},{},{},{}", p.x, p.y, p.z, q.w, q.i, q.j, q.k)
        }
        _ => Ok(()),
    };
}

fn save(path: &Path, bytes: &[u8]) -> Result<(), BenchError> {
    let folder = path.parent().unwrap_or(path);
    std::fs::create_dir_all(folder)
        .and_then(|()| std::fs::write(path, bytes))
        .map_err(|source| BenchError::Io { path: path.to_owned(), source })
}

/// The folder of one camera: `sensor.yaml`, `data.csv` and grey images in `data/`.
struct CameraFolder {
    folder: PathBuf,
    rows: String,
}

impl CameraFolder {
    fn create(folder: &Path, scene: &SceneConfig) -> Result<Self, BenchError> {
        let camera = &scene.camera;
        let mount: Vec<String> =
            camera.imu_from_camera.iter().flatten().map(|x| format!("{x:.12}")).collect();
        let CameraConfig { fx, fy, cx, cy, .. } = camera;
        let calibration = format!(
            "%YAML:1.0\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{}]\n\
             rate_hz: {}\nresolution: [{}, {}]\ncamera_model: pinhole\n\
             intrinsics: [{fx}, {fy}, {cx}, {cy}]\ndistortion_model: radial-tangential\n\
             distortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n",
            mount.join(", "),
            scene.image.rate,
            scene.image.width,
            scene.image.height,
        );
        save(&folder.join("sensor.yaml"), calibration.as_bytes())?;
        Ok(Self { folder: folder.to_owned(), rows: "#timestamp [ns],filename\n".to_owned() })
    }

    fn push(&mut self, stamp: i64, image: &ColorImage) -> Result<(), BenchError> {
        let name = format!("{stamp}.png");
        let path = self.folder.join("data").join(&name);
        // The green channel, as the response of a grey camera is nearest to it.
        let grey: Vec<u8> = image.data().chunks(3).map(|pixel| pixel[1]).collect();
        let mut png = Vec::new();
        PngEncoder::new_with_quality(&mut png, CompressionType::Fast, FilterType::Sub)
            .write_image(&grey, image.width() as u32, image.height() as u32, ExtendedColorType::L8)
            .map_err(|error| BenchError::Format {
                path: path.clone(),
                reason: error.to_string(),
            })?;
        save(&path, &png)?;
        self.rows += &format!("{stamp},{name}\n");
        Ok(())
    }

    fn finish(&self) -> Result<(), BenchError> {
        save(&self.folder.join("data.csv"), self.rows.as_bytes())
    }
}
