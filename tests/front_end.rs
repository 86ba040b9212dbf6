//! The front end on real RGB-D recordings, frame to frame against the truth.

#![cfg(feature = "vision")]

use std::path::{Path, PathBuf};
use std::time::Instant;

use mfg_vio::sensor::{
    Camera, CameraConfig, ColorImage, DepthImage, PixelFormat, RgbdFrame, Stamp,
};
use mfg_vio::vision::{
    Correspondence, DepthConfig, Descriptor, Feature, FeatureConfig, Match, MatchingConfig,
    OrbExtractor, Prediction, RansacConfig, estimate_pose, match_descriptors, match_guided,
};
use nalgebra::{
    Isometry3, Matrix3, Matrix6, Point3, Quaternion, Rotation3, Translation3, UnitQuaternion,
    Vector6,
};
use opencv::imgcodecs::{IMREAD_COLOR, IMREAD_UNCHANGED, imread};
use opencv::prelude::*;

struct Truth {
    frame: RgbdFrame,
    world_from_camera: Isometry3<f64>,
}

struct Sequence {
    name: &'static str,
    camera: CameraConfig,
    frames: Vec<Truth>,
}

fn data() -> Option<PathBuf> {
    let default = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let path = std::env::var_os("MFG_VIO_DATA").map_or(default, PathBuf::from);
    if !path.is_dir() {
        eprintln!("SKIPPED: no recordings at {} (set MFG_VIO_DATA)", path.display());
        return None;
    }
    Some(path)
}

fn load(color: &Path, depth: &Path, scale: f32, stamp: Stamp) -> RgbdFrame {
    let image = imread(color.to_str().unwrap(), IMREAD_COLOR).unwrap();
    let (width, height) = (image.cols() as usize, image.rows() as usize);
    let bytes = image.data_bytes().unwrap().to_vec();
    let color = ColorImage::new(width, height, PixelFormat::Bgr8, bytes).unwrap();
    let image = imread(depth.to_str().unwrap(), IMREAD_UNCHANGED).unwrap();
    let valid = |&raw: &u16| if raw == u16::MAX { 0 } else { raw };
    let values = image.data_typed::<u16>().unwrap().iter().map(valid).collect();
    let depth = DepthImage::new(image.cols() as usize, image.rows() as usize, scale, values);
    RgbdFrame { stamp, color, depth: depth.unwrap(), others: Vec::new() }
}

/// Rows of a TUM text file: stamp and the rest.
fn rows(path: PathBuf) -> Vec<(f64, Vec<String>)> {
    let text = std::fs::read_to_string(path).unwrap();
    let lines = text.lines().filter(|line| !line.starts_with('#') && !line.trim().is_empty());
    let parse = |line: &str| {
        let mut fields = line.split_whitespace().map(str::to_owned);
        (fields.next().unwrap().parse().unwrap(), fields.collect())
    };
    lines.map(parse).collect()
}

fn tum(range: std::ops::Range<usize>) -> Option<Sequence> {
    let dir = data()?.join("tum_fr1_rpy");
    let camera = CameraConfig {
        fx: 517.3,
        fy: 516.5,
        cx: 318.6,
        cy: 255.3,
        distortion: vec![0.2624, -0.9531, -0.0054, 0.0026, 1.1633],
        ..CameraConfig::default()
    };
    let (depth, truth) = (rows(dir.join("depth.txt")), rows(dir.join("groundtruth.txt")));
    let pose = |row: &(f64, Vec<String>)| {
        let v: Vec<f64> = row.1.iter().map(|x| x.parse().unwrap()).collect();
        let rotation = UnitQuaternion::from_quaternion(Quaternion::new(v[6], v[3], v[4], v[5]));
        Isometry3::from_parts(Translation3::new(v[0], v[1], v[2]), rotation)
    };
    let mut frames = vec![];
    for (stamp, color) in &rows(dir.join("rgb.txt"))[range] {
        let nearest = |a: &&(f64, Vec<String>), b: &&(f64, Vec<String>)| {
            (a.0 - stamp).abs().total_cmp(&(b.0 - stamp).abs())
        };
        let depth = depth.iter().min_by(nearest).unwrap();
        let after = truth.partition_point(|row| row.0 < *stamp);
        if (depth.0 - stamp).abs() > 0.02 || after == 0 || after == truth.len() {
            continue;
        }
        let (a, b) = (&truth[after - 1], &truth[after]);
        frames.push(Truth {
            frame: load(
                &dir.join(&color[0]),
                &dir.join(&depth.1[0]),
                0.0002,
                Stamp::from_seconds(*stamp).unwrap(),
            ),
            world_from_camera: pose(a)
                .lerp_slerp(&pose(b), ((stamp - a.0) / (b.0 - a.0)).clamp(0.0, 1.0)),
        });
    }
    Some(Sequence { name: "tum_fr1_rpy", camera, frames })
}

fn seven_scenes(range: std::ops::Range<usize>) -> Option<Sequence> {
    let dir = data()?.join("seven_scenes_redkitchen");
    let camera =
        CameraConfig { fx: 585.0, fy: 585.0, cx: 320.0, cy: 240.0, ..CameraConfig::default() };
    let frame = |index: usize| {
        let file = |kind: &str| dir.join(format!("frame-{index:06}.{kind}"));
        let stamp = Stamp::from_seconds(index as f64 / 30.0).unwrap();
        let text = std::fs::read_to_string(file("pose.txt")).unwrap();
        let m: Vec<f64> = text.split_whitespace().map(|x| x.parse().unwrap()).collect();
        let rotation = Matrix3::from_fn(|r, c| m[4 * r + c]);
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&rotation));
        Truth {
            frame: load(&file("color.jpg"), &file("depth.png"), 0.001, stamp),
            world_from_camera: Isometry3::from_parts(
                Translation3::new(m[3], m[7], m[11]),
                rotation,
            ),
        }
    };
    Some(Sequence { name: "seven_scenes_redkitchen", camera, frames: range.map(frame).collect() })
}

/// Gauss-Newton on the Mahalanobis distance between the two clouds.
fn refine(mut pose: Isometry3<f64>, data: &[Correspondence], inliers: &[usize]) -> Isometry3<f64> {
    for _ in 0..5 {
        let (mut h, mut g) = (Matrix6::zeros(), Vector6::zeros());
        let r = pose.rotation.to_rotation_matrix().into_inner();
        for c in inliers.iter().map(|&i| &data[i]) {
            let p = &c.measurement.point;
            let e = r * p + pose.translation.vector - c.world;
            let s = r * c.measurement.covariance * r.transpose() + c.world_covariance;
            let w = s.try_inverse().unwrap();
            let mut j = nalgebra::Matrix3x6::zeros();
            j.fixed_view_mut::<3, 3>(0, 0).copy_from(&(-r * p.cross_matrix()));
            j.fixed_view_mut::<3, 3>(0, 3).copy_from(&Matrix3::identity());
            // Cauchy weight.
            let robust = 1.0 / (1.0 + (e.dot(&(w * e))) / 9.0);
            h += j.transpose() * w * j * robust;
            g += j.transpose() * w * e * robust;
        }
        let d = -h.cholesky().unwrap().solve(&g);
        pose.rotation *= UnitQuaternion::new(d.fixed_rows::<3>(0).into_owned());
        pose.translation.vector += d.fixed_rows::<3>(3);
    }
    pose
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

/// Correspondences of matches whose two features have depth; the earlier frame is the world.
fn correspondences(
    camera: &Camera,
    world: &[Feature],
    now: &[Feature],
    matches: &[Match],
) -> Vec<(Match, Correspondence)> {
    let pair = |m: &Match| {
        let world = world[m.query].measurement(camera)?;
        let measurement = now[m.train].measurement(camera)?;
        let c =
            Correspondence { measurement, world: world.point, world_covariance: world.covariance };
        Some((*m, c))
    };
    matches.iter().filter_map(pair).collect()
}

#[derive(Default)]
struct Summary {
    features: Vec<f64>,
    with_depth: Vec<f64>,
    cells: Vec<f64>,
    extraction_ms: Vec<f64>,
    all_ms: Vec<f64>,
    guided_ms: Vec<f64>,
    ransac_ms: Vec<f64>,
    all_matches: Vec<f64>,
    all_inliers: Vec<f64>,
    guided_matches: Vec<f64>,
    guided_inliers: Vec<f64>,
    kabsch_deg: Vec<f64>,
    kabsch_mm: Vec<f64>,
    refined_deg: Vec<f64>,
    refined_mm: Vec<f64>,
    pixel_by_octave: Vec<Vec<f64>>,
    depth_sigmas: Vec<f64>,
}

fn run(sequence: &Sequence, config: &FeatureConfig) -> Summary {
    let camera = Camera::new(&sequence.camera).unwrap();
    let matching = MatchingConfig::default();
    let mut extractor =
        OrbExtractor::new(config, &sequence.camera, &DepthConfig::default()).unwrap();
    let mut s = Summary { pixel_by_octave: vec![vec![]; 12], ..Summary::default() };
    let mut previous: Option<(Vec<Feature>, Isometry3<f64>)> = None;
    for (index, Truth { frame, world_from_camera }) in sequence.frames.iter().enumerate() {
        let start = Instant::now();
        let now = extractor.extract(frame).unwrap().features;
        s.extraction_ms.push(start.elapsed().as_secs_f64() * 1e3);
        s.features.push(now.len() as f64);
        s.with_depth.push(now.iter().filter(|f| f.depth.is_some()).count() as f64);
        let mut cells = [[false; 16]; 12];
        for f in &now {
            let cell = |v: f64, n: usize| ((v / 40.0).max(0.0) as usize).min(n - 1);
            cells[cell(f.pixel.y, 12)][cell(f.pixel.x, 16)] = true;
        }
        s.cells.push(cells.as_flattened().iter().filter(|&&c| c).count() as f64);
        let Some((world, before)) = previous.take() else {
            previous = Some((now, *world_from_camera));
            continue;
        };
        let truth = before.inv_mul(world_from_camera);
        let descriptors =
            |f: &[Feature]| f.iter().map(|f| f.descriptor).collect::<Vec<Descriptor>>();
        let start = Instant::now();
        let matches = match_descriptors(&descriptors(&world), &descriptors(&now), &matching);
        s.all_ms.push(start.elapsed().as_secs_f64() * 1e3);
        let ransac = RansacConfig::default();
        let pairs = correspondences(&camera, &world, &now, &matches);
        let data: Vec<_> = pairs.iter().map(|p| p.1).collect();
        s.all_matches.push(data.len() as f64);
        let start = Instant::now();
        let found = estimate_pose(&data, &camera, None, &ransac, index as u64);
        s.ransac_ms.push(start.elapsed().as_secs_f64() * 1e3);
        s.all_inliers.push(found.map_or(0.0, |f| f.inliers.len() as f64));

        // As with an IMU: the rotation known, the translation zero.
        let predicted = Isometry3::from_parts(Translation3::identity(), truth.rotation);
        let prediction = |f: &Feature| {
            let point = f.measurement(&camera).map(|m| m.point);
            let point = point.or(camera.unproject(f.pixel, 2.0)).unwrap();
            let pixel = camera.project(&predicted.inverse_transform_point(&point.into()).coords);
            Prediction { descriptor: f.descriptor, pixel: pixel.unwrap_or_default(), radius: 20.0 }
        };
        let start = Instant::now();
        let predictions: Vec<_> = world.iter().map(prediction).collect();
        let matches = match_guided(&predictions, &now, &matching);
        s.guided_ms.push(start.elapsed().as_secs_f64() * 1e3);
        let pairs = correspondences(&camera, &world, &now, &matches);
        let data: Vec<_> = pairs.iter().map(|p| p.1).collect();
        s.guided_matches.push(data.len() as f64);
        let found = estimate_pose(&data, &camera, Some(&truth.rotation), &ransac, index as u64);
        let Some(found) = found else {
            s.guided_inliers.push(0.0);
            previous = Some((now, *world_from_camera));
            continue;
        };
        s.guided_inliers.push(found.inliers.len() as f64);
        let error = |pose: &Isometry3<f64>| {
            let d = pose.inv_mul(&truth);
            (d.rotation.angle().to_degrees(), d.translation.vector.norm() * 1e3)
        };
        let kabsch = error(&found.model);
        let refined = refine(found.model, &data, &found.inliers);
        let gn = error(&refined);
        s.kabsch_deg.push(kabsch.0);
        s.kabsch_mm.push(kabsch.1);
        s.refined_deg.push(gn.0);
        s.refined_mm.push(gn.1);
        for &i in &found.inliers {
            let (m, c) = &pairs[i];
            let (a, b) = (&world[m.query], &now[m.train]);
            let expected = refined.inverse_transform_point(&Point3::from(c.world)).coords;
            s.depth_sigmas.push(
                ((expected.z - c.measurement.point.z)
                    / (c.measurement.covariance.m33 + c.world_covariance.m33).sqrt())
                .abs(),
            );
            if a.octave == b.octave {
                let e = camera.project(&expected).unwrap() - b.pixel;
                s.pixel_by_octave[usize::from(a.octave)].extend([e.x.abs(), e.y.abs()]);
            }
        }
        previous = Some((now, *world_from_camera));
    }
    s
}

/// Standard deviation of one feature's coordinate from the differences of two.
fn sigma(differences: &[f64]) -> f64 {
    1.4826 * median(differences.to_vec()) / std::f64::consts::SQRT_2
}

fn print(sequence: &Sequence, s: &Summary) {
    let m = |values: &[f64]| median(values.to_vec());
    // The machine may be busy with other things.
    let fast = |values: &[f64]| values.iter().copied().fold(f64::INFINITY, f64::min);
    let low = |values: &[f64]| values.iter().copied().fold(f64::INFINITY, f64::min);
    println!("{}: {} frames", sequence.name, sequence.frames.len());
    println!(
        "  features {} (min {}), with depth {}, cells {} of 192 (min {}), extraction {:.2} ms",
        m(&s.features),
        low(&s.features),
        m(&s.with_depth),
        m(&s.cells),
        low(&s.cells),
        fast(&s.extraction_ms)
    );
    println!(
        "  all-pairs: matches {} inliers {} (min {}), {:.2} ms, ransac {:.2} ms",
        m(&s.all_matches),
        m(&s.all_inliers),
        low(&s.all_inliers),
        fast(&s.all_ms),
        fast(&s.ransac_ms)
    );
    println!(
        "  guided:    matches {} inliers {} (min {}), {:.2} ms",
        m(&s.guided_matches),
        m(&s.guided_inliers),
        low(&s.guided_inliers),
        fast(&s.guided_ms)
    );
    println!(
        "  relative pose: kabsch {:.3} deg {:.2} mm, refined {:.3} deg {:.2} mm; depth residual {:.2} sigma",
        m(&s.kabsch_deg),
        m(&s.kabsch_mm),
        m(&s.refined_deg),
        m(&s.refined_mm),
        1.4826 * m(&s.depth_sigmas)
    );
    let by_octave: Vec<_> = s
        .pixel_by_octave
        .iter()
        .filter(|e| e.len() > 20)
        .map(|e| format!("{:.2} ({})", sigma(e), e.len() / 2))
        .collect();
    println!("  pixel sigma by octave: {}", by_octave.join(", "));
}

#[test]
fn consecutive_frames_match_and_give_the_motion() {
    for sequence in [tum(0..60), seven_scenes(0..60)].into_iter().flatten() {
        let summary = run(&sequence, &FeatureConfig::default());
        print(&sequence, &summary);
        let m = |values: &[f64]| median(values.to_vec());
        assert!(m(&summary.guided_inliers) > 100.0);
        assert!(m(&summary.refined_deg) < 0.5 && m(&summary.refined_mm) < 10.0);
        assert!(m(&summary.cells) > 100.0);
        assert!(sigma(&summary.pixel_by_octave[0]) < 1.0);
    }
}
