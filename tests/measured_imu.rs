//! `simulate --imu`: a measured IMU beside rendered images.

mod support;

use std::fmt::Write;
use std::path::Path;

use mfg_vio::dataset::{LogConfig, open};
use mfg_vio::inertial::ImuConfig;
use mfg_vio::sensor::Event;
use nalgebra::{UnitQuaternion, Vector3};
use support::{fail, mfg_vio, succeed, text};

const FIRST: f64 = 5000.0;

/// A body that turns about its vertical and swings along it, in a world whose x axis is up: poses at
/// 100 Hz and an IMU at 200 Hz from `FIRST` on, with a mark in each sample that no simulator makes.
fn recorded(folder: &Path, seconds: f64) {
    let attitude = |t: f64| {
        let x_up = UnitQuaternion::rotation_between(&Vector3::z(), &Vector3::x()).unwrap();
        x_up * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 0.4 * t)
    };
    let (mut poses, mut imu) = (String::new(), String::from("t,gx,gy,gz,ax,ay,az\n"));
    for k in 0..(seconds * 200.0) as u32 {
        let t = f64::from(k) / 200.0;
        let (height, lift) = (0.1 * (2.0 * t).sin(), -0.4 * (2.0 * t).sin());
        if k % 2 == 0 {
            let q = attitude(t).coords;
            writeln!(poses, "{:.4} {height} 0 0 {} {} {} {}", FIRST + t, q.x, q.y, q.z, q.w)
                .unwrap();
        }
        writeln!(imu, "{:.4},{},0,0.4,0,0,{}", FIRST + t, f64::from(k) * 1e-7, 9.81 + lift)
            .unwrap();
    }
    std::fs::write(folder.join("path.tum"), poses).unwrap();
    std::fs::write(folder.join("imu.csv"), imu).unwrap();
    let scene = "[image]\nwidth = 64\nheight = 48\nrate = 10.0\n[camera]\nfx = 50.0\nfy = 50.0\ncx = 32.0\ncy = 24.0\n";
    std::fs::write(folder.join("scene.toml"), format!("duration = 3.0\n{scene}")).unwrap();
}

#[test]
fn a_measured_imu_is_written_beside_rendered_images() {
    let folder = tempfile::tempdir().unwrap();
    recorded(folder.path(), 5.0);
    let path = |name: &str| folder.path().join(name);
    let (imu, poses, scene, out) =
        (path("imu.csv"), path("path.tum"), path("scene.toml"), path("out.mcap"));
    let arguments = ["--trajectory", text(&poses), "--config", text(&scene), "--out", text(&out)];
    succeed(&[&["simulate", "--imu", text(&imu)][..], &arguments].concat());

    let mut log = open(&out, &LogConfig::default(), &ImuConfig::default()).unwrap();
    let (mut samples, mut frames, mut truth) = (Vec::new(), 0, Vec::new());
    while let Some(event) = log.next_event() {
        match event {
            Event::Imu(sample) => samples.push(sample),
            Event::Frame(_) => frames += 1,
            Event::Truth(pose) => truth.push(pose),
            _ => {}
        }
    }
    assert!((29..=31).contains(&frames), "{frames}");
    assert!((598..=601).contains(&samples.len()), "{}", samples.len());
    for sample in &samples {
        let k = (sample.stamp.seconds() - FIRST) * 200.0;
        assert!((k - k.round()).abs() < 1e-3, "{}", sample.stamp);
        assert!((sample.angular_velocity.x - k.round() * 1e-7).abs() < 1e-12, "{sample:?}");
    }
    // Up is where the measured force points.
    assert!(truth.len() > 300);
    for pose in truth {
        let up = pose.world_from_body.rotation * Vector3::z();
        assert!(up.angle(&Vector3::z()).to_degrees() < 0.2, "{up}");
    }
}

#[test]
fn an_imu_of_another_clock_or_without_trajectory_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    recorded(folder.path(), 4.0);
    let path = |name: &str| folder.path().join(name);
    let (imu, poses, out) = (path("imu.csv"), path("path.tum"), path("out.mcap"));
    let shifted = std::fs::read_to_string(&poses).unwrap().replace("\n500", "\n600");
    std::fs::write(path("later.tum"), shifted.replacen("500", "600", 1)).unwrap();
    let later = path("later.tum");
    let run = ["simulate", "--imu", text(&imu), "--out", text(&out), "--up", "1,0,0"];
    let told = fail(&[&run[..], &["--trajectory", text(&later)]].concat());
    assert!(told.contains("does not cover the trajectory"), "{told}");
    let told = fail(&run);
    assert!(told.contains("--trajectory"), "{told}");
    let wrong = mfg_vio(&[
        "simulate",
        "--imu",
        text(&imu),
        "--trajectory",
        text(&poses),
        "--out",
        text(&imu),
    ]);
    assert_eq!(wrong.status.code(), Some(2));
}
