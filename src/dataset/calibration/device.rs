//! Which device made a log, by the names that its driver gives to topics and frames.

use crate::inertial::SensorClass;

/// A device, and what its maker tells of sensors whose noise logs do not hold.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::dataset) struct Device {
    pub name: &'static str,
    /// The IMU chip, where it is known.
    imu: Option<&'static str>,
    pub depth: Option<DepthLaw>,
}

/// Standard deviation of depth `d`: `max(floor, quadratic d^2 + linear d + constant)`, m.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::dataset) struct DepthLaw {
    pub quadratic: f64,
    pub linear: f64,
    pub constant: f64,
    pub floor: f64,
    pub min: f64,
    pub source: &'static str,
}

/// A matched disparity is off by so much, pixels (Intel's "Best known methods for tuning D400
/// depth cameras" measure 0.08 on textured targets).
const DISPARITY_SD: f64 = 0.08;

/// Law of stereo depth: `sd = d^2 disparity_sd / (f b)`; `focal` in pixels, `baseline` in m.
const fn stereo(focal: f64, baseline: f64, min: f64, source: &'static str) -> DepthLaw {
    DepthLaw {
        quadratic: DISPARITY_SD / (focal * baseline),
        linear: 0.0,
        constant: 0.0,
        floor: 0.001,
        min,
        source,
    }
}

/// Words of which one is in a topic or frame of the device's driver; the first match counts.
const DEVICES: [(&[&str], Device); 6] = [
    (&["fisheye1", "t265"], Device { name: "RealSense T265", imu: Some("BMI055"), depth: None }),
    (&["l515"], Device { name: "RealSense L515", imu: Some("BMI085"), depth: None }),
    (
        &[
            "realsense",
            "d435",
            "d435i",
            "d455",
            "d415",
            "aligned_depth_to_color",
            "infra1",
            "camera_color_optical_frame",
            "camera_gyro_optical_frame",
            "camera_imu_optical_frame",
        ],
        Device {
            name: "RealSense D400",
            imu: Some("BMI055"),
            depth: Some(stereo(
                385.0,
                0.05,
                0.28,
                "stereo of 50 mm and 385 pixels, disparity to 0.08 pixels",
            )),
        },
    ),
    (
        &["oak", "depthai"],
        Device {
            name: "OAK-D",
            imu: Some("BMI270"),
            depth: Some(stereo(
                441.0,
                0.075,
                0.35,
                "stereo of 75 mm and 441 pixels, disparity to 0.08 pixels",
            )),
        },
    ),
    (
        &["zed", "zed2", "zed2i", "zedm", "zedx"],
        Device {
            name: "ZED",
            imu: None,
            depth: Some(stereo(
                530.0,
                0.12,
                0.3,
                "stereo of 120 mm and 530 pixels, disparity to 0.08 pixels",
            )),
        },
    ),
    (
        &["depth_to_rgb", "rgb_to_depth", "k4a", "azure"],
        Device {
            name: "Azure Kinect",
            imu: Some("LSM6DSM"),
            depth: Some(DepthLaw {
                quadratic: 0.0,
                linear: 0.0005,
                constant: 0.001,
                floor: 0.001,
                min: 0.25,
                source: "time of flight, 1 mm and 0.5 mm a metre",
            }),
        },
    ),
];

/// Its noise law is that of the publications on VCU-RVI.
const STRUCTURE_CORE: (&[&str], Device) = (
    &["sc", "structure_core", "struct_core", "sc_flu"],
    Device {
        name: "Structure Core",
        imu: Some("BMI055"),
        depth: Some(DepthLaw {
            quadratic: 0.00155816,
            linear: -0.00362021,
            constant: 0.00452812,
            floor: 0.0007,
            min: 0.35,
            source: "Structure Core at the image centre (Zhang et al., VCU-RVI)",
        }),
    },
);

impl Device {
    /// By the names of topics and frames.
    pub fn of<'a>(names: impl Iterator<Item = &'a str>) -> Option<Self> {
        let words: Vec<String> = names.flat_map(words).collect();
        let known =
            |(keys, _): &&(&[&str], Self)| keys.iter().any(|key| words.iter().any(|w| w == key));
        DEVICES.iter().chain([&STRUCTURE_CORE]).find(known).map(|(_, device)| *device)
    }

    pub fn imu(&self) -> Option<SensorClass> {
        self.imu.and_then(SensorClass::named)
    }
}

/// The parts of `/oak/rgb/image_raw`, and of `oak_imu_frame` the whole and its beginning.
fn words(name: &str) -> Vec<String> {
    let lower = name.to_lowercase();
    let parts = lower.split('/').filter(|part| !part.is_empty());
    parts
        .flat_map(|part| {
            let first = part.split('_').next().unwrap_or(part);
            [part.to_owned(), first.to_owned()]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(names: &[&str]) -> Option<&'static str> {
        Device::of(names.iter().copied()).map(|device| device.name)
    }

    #[test]
    fn drivers_are_told_by_their_names() {
        assert_eq!(
            name(&["/camera/camera/aligned_depth_to_color/image_raw"]),
            Some("RealSense D400")
        );
        assert_eq!(name(&["/imu", "oak_imu_frame"]), Some("OAK-D"));
        assert_eq!(name(&["/zed2/zed_node/imu/data"]), Some("ZED"));
        assert_eq!(name(&["/depth_to_rgb/image_raw", "/imu"]), Some("Azure Kinect"));
        assert_eq!(name(&["/sc/rgb/image"]), Some("Structure Core"));
        assert_eq!(name(&["/camera/fisheye1/image_raw"]), Some("RealSense T265"));
        // A desk of oak wood, and a scene.
        assert_eq!(name(&["/oaken/image", "/scene/image", "/imu"]), None);
    }

    #[test]
    fn depth_of_a_wider_baseline_is_better() {
        let at = |words: &str| Device::of([words].into_iter()).unwrap().depth.unwrap().quadratic;
        assert!(at("zed") < at("oak") && at("oak") < at("d435"));
        assert!(Device::of(["d435"].into_iter()).unwrap().imu().is_some());
    }
}
